"""Direction of motion with a reversal threshold, so that noise at standstill does not flip a backlash.

Nine values are followed: the measured point's x, y, z and the six struts. Each drags a window as wide as
the threshold behind it, like a nut its lost motion; only a value that leaves its window has a direction.
"""

from __future__ import annotations

import math

import numpy as np

FOLLOWED = 9
"""Three axes of the measured point, then six struts."""


DIRECTIONS = {"forward": 1.0, "midway": 0.0, "backward": -1.0}
"""The sense of all axes and all struts that were approached in one direction; midway: not known."""


class MotionState:
    """Windows and directions of motion of the nine followed values.

    Given arrays are used in place; without them the state is that before the first value.
    """

    __slots__ = ("low", "sense")

    def __init__(self, low: np.ndarray | None = None, sense: np.ndarray | None = None) -> None:
        self.low = np.full(FOLLOWED, math.nan) if low is None else low
        self.sense = np.zeros(FOLLOWED) if sense is None else sense

    def copy_from(self, other: MotionState) -> None:
        """Take over the state of another."""
        self.low[:] = other.low
        self.sense[:] = other.sense
