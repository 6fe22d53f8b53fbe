"""Compiled: direction of motion with a reversal threshold."""

from __future__ import annotations

import math

from .compiling import compiled


@compiled
def follow(value, threshold, low, sense, index):
    """Update window and direction number `index` for a new value and return the direction."""
    if math.isnan(low[index]):
        low[index] = value - 0.5 * threshold
    elif value > low[index] + threshold:
        low[index] = value - threshold
        sense[index] = 1.0
    elif value < low[index]:
        low[index] = value
        sense[index] = -1.0
    return sense[index]
