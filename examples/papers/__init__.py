"""Comparison of every table and figure of the papers behind this package with computed values."""
