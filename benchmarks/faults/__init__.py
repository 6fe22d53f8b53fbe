"""Fault campaign: faults are injected into a moving machine, and a judge independent of the nodes evaluates it."""
