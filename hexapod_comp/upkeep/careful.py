"""A machine observed with care: at each stop the median of several observations, so that wild ones do not count."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from ..measurements.collect import MeasuredMachine, Observation
from ..pose import Pose, attitude_error

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
        seen = list[tuple[Observation, Pose]]()
        for _ in range(MOST):
            if (o := self._machine.observe()) is None or o.pose is None:
                continue
            seen.append((o, o.pose))
            first = seen[0][1]
            turns = [attitude_error(pose.rotation, first.rotation) for _, pose in seen]
            numbers = np.array([[*pose.position, *turn] for (_, pose), turn in zip(seen, turns, strict=True)])
            middle = np.median(numbers, axis=0)
            stated = np.nanmax([np.median([o.uncertainty for o, _ in seen], axis=0), np.full(6, FINEST)], axis=0)
            agree = (np.abs(numbers - middle) <= AGREE * stated).all(axis=1)
            if len(seen) >= LOOKS and 2 * agree.sum() > len(seen):
                break
        if len(seen) < LOOKS:
            return None
        turned = Rotation.from_rotvec(middle[3:]).as_matrix() @ first.rotation
        return seen[-1][0]._replace(pose=Pose(middle[:3], turned), uncertainty=stated)
