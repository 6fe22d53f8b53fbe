"""Alias of :mod:`hexapod_comp.ros` from version 0.2, kept for one version: its modules can be imported from here."""

from __future__ import annotations

from .ros import __path__, open_streams, received_signals, start

__all__ = ["__path__", "open_streams", "received_signals", "start"]
