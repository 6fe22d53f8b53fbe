"""A machine observed with care: the median of three observations at each stop, so that a single wild one is nothing."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from ..measurements.collect import MeasuredMachine, Observation
from ..pose import Pose

LOOKS = 3  # that read something, at each stop; one of them may be wild
MOST = 6  # looks at a stop: a beam that is broken more often is broken
FINEST = 1e-7  # No stop is stated to be read better, m and rad: struts are counted to a tenth of a micrometre


class Careful:
    """Passes moves on, and observes with care."""

    def __init__(self, machine: MeasuredMachine) -> None:
        self._machine = machine

    def move(self, pose: Pose) -> object:
        """Have the machine move."""
        return self._machine.move(pose)

    def observe(self) -> Observation | None:
        """Return the median of three observations; None where fewer read anything: of two nobody knows the wild one."""
        seen = list[tuple[Observation, Pose]]()
        for _ in range(MOST):
            if (o := self._machine.observe()) is not None and o.pose is not None:
                seen.append((o, o.pose))
            if len(seen) == LOOKS:
                break
        else:
            return None
        first = seen[0][1]
        turns = [Rotation.from_matrix(pose.rotation @ first.rotation.T).as_rotvec() for _, pose in seen]
        numbers = np.array([np.concatenate([pose.position, turn]) for (_, pose), turn in zip(seen, turns, strict=True)])
        middle = np.median(numbers, axis=0)
        stated = np.nanmax([np.median([o.uncertainty for o, _ in seen], axis=0), np.full(6, FINEST)], axis=0)
        turned = Rotation.from_rotvec(middle[3:]).as_matrix() @ first.rotation
        return seen[-1][0]._replace(pose=Pose(middle[:3], turned), uncertainty=stated)
