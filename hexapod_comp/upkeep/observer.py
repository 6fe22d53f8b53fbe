"""A robust observer: the median of several observations at each stop, so that outliers have no effect."""

from __future__ import annotations

import numpy as np

from ..measurements.collect import MeasuredMachine, Observation
from ..measurements.readings import of_median
from ..pose import Pose, middle_pose

FEWEST = 3  # smallest number of observations with a pose at each stop; more follow until a majority agrees
MOST = 8  # largest number of observations at each stop
AGREE = 5.0  # an observation agrees if it differs from the median by at most this many of its standard deviations
FINEST = 1e-7  # smallest standard deviation, m and rad, since the resolution of strut readings is 0.1 µm


class MedianObserver:
    """A measured machine: each of its observations is the median of several observations by `machine`."""

    def __init__(self, machine: MeasuredMachine) -> None:
        self._machine = machine

    def move(self, pose: Pose) -> object:
        return self._machine.move(pose)

    def observe(self) -> Observation | None:
        """Return the median of FEWEST to MOST observations; None if fewer than FEWEST have a pose."""
        read, poses = list[Observation](), list[Pose]()
        for _ in range(MOST):
            if (o := self._machine.observe()) is None or o.pose is None:
                continue
            read.append(o)
            poses.append(o.pose)
            middle, off = middle_pose(poses)
            stated = np.nanmax([np.median([o.uncertainty for o in read], axis=0), np.full(6, FINEST)], axis=0)
            agree = (np.abs(off) <= AGREE * stated).all(axis=1)
            if len(read) >= FEWEST and 2 * agree.sum() > len(read):
                break
        if len(read) < FEWEST:
            return None
        return read[-1]._replace(pose=middle, uncertainty=np.maximum(of_median(stated, len(read)), FINEST))
