"""Processes that a process starts and that must not outlive it."""

from __future__ import annotations

import ctypes
import signal

LIBC = ctypes.CDLL(None)

PR_SET_PDEATHSIG = 1
"""From Linux's <sys/prctl.h>."""


def end_with_parent(number: signal.Signals = signal.SIGTERM) -> None:
    """Ask the system to send this process a signal when its parent dies, however it dies."""
    LIBC.prctl(PR_SET_PDEATHSIG, number)
