"""A machine observed with care: at each stop the median of several observations, so that wild ones do not count."""

from __future__ import annotations

import numpy as np

from ..measurements.collect import MeasuredMachine, Observation
from ..pose import Pose, middle_pose

LOOKS = 3  # that read something, at each stop, at least; more where no majority of them agrees
MOST = 8  # looks at a stop: a beam that is broken more often is broken
AGREE = 5.0  # Looks agree that differ from their median by up to this many stated standard deviations
FINEST = 1e-7  # No stop is stated to be read better, m and rad: struts are counted to a tenth of a micrometre


class Careful:
    """Passes moves on, and observes with care."""

    def __init__(self, machine: MeasuredMachine) -> None:
        self._machine = machine

    def move(self, pose: Pose) -> object:
        """Have the machine move."""
        return self._machine.move(pose)

    def observe(self) -> Observation | None:
        """Return the median of three observations or more; None where fewer read anything."""
        seen, poses = list[Observation](), list[Pose]()
        for _ in range(MOST):
            if (o := self._machine.observe()) is None or o.pose is None:
                continue
            seen.append(o)
            poses.append(o.pose)
            middle, off = middle_pose(poses)
            stated = np.nanmax([np.median([o.uncertainty for o in seen], axis=0), np.full(6, FINEST)], axis=0)
            agree = (np.abs(off) <= AGREE * stated).all(axis=1)
            if len(seen) >= LOOKS and 2 * agree.sum() > len(seen):
                break
        if len(seen) < LOOKS:
            return None
        return seen[-1]._replace(pose=middle, uncertainty=stated)
