"""Readings of every instrument, and every reader of measured files."""
