"""Measurements: the readings of all instruments, the readers of measured files, campaigns, and ISO 230 evaluation."""
