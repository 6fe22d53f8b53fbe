"""Fault campaign: a moving machine, something goes wrong, a judge who belongs to neither. See doc/faults.md."""
