"""The old name of :mod:`hexapod_comp.ros`, for one version: its modules are found under this name too."""

from __future__ import annotations

from .ros import __path__, open_streams, received_signals, start

__all__ = ["__path__", "open_streams", "received_signals", "start"]
