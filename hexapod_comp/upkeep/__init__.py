"""Upkeep of a running machine: calibration, checks and repair, step by step, with readings that the machine takes."""
