"""Compensator and virtual machine run together, for ``demo`` and ``run``."""
