"""Structure: deviations of the twelve joints from their nominal positions, and the struts' length offsets."""

from __future__ import annotations

import numpy as np

from ...machine.geometry import STRUT_NAMES
from ...measurements.readings import AXES
from .block import Block, Columns, Draft, Errors, Facts, Linkage


class Structure(Block):
    """Deviations (x, y, z), m, of the six base joints and of each platform joint, then six offsets of strut lengths."""

    name, unit, tolerance = "structure", "m", 100e-6

    def __init__(self, groups: np.ndarray) -> None:  # (6,): index of each strut's platform joint
        count = int(groups.max()) + 1
        labels = [f"base {i + 1} {a}" for i in range(6) for a in AXES]
        labels += [f"platform {g + 1} {a}" for g in range(count) for a in AXES]
        self.labels = tuple(labels + [f"{s} offset" for s in STRUT_NAMES])
        self.root, self._groups = np.eye(len(self.labels)), groups
        self._shared = groups[:, None] == np.arange(count)

    @classmethod
    def of(cls, facts: Facts) -> Structure:
        return cls(facts.platform_groups)

    def design(self, linkage: Linkage, whitened: bool) -> Columns:
        """A base joint displaced by d along u acts like a strut longer by d, a platform joint like one shorter by d."""
        u = linkage.directions
        in_platform = -np.einsum("nij,nki->nkj", linkage.rotations, u)

        def columns(errors: Errors) -> np.ndarray:
            each, n = errors.gains[..., None], len(errors.at)
            base, arms = (each * part[errors.at] for part in (u, in_platform))
            joined = np.einsum("nsk,sg->ngk", arms, self._shared.astype(float))
            return np.concatenate([base.reshape(n, -1), joined.reshape(n, -1), errors.gains], axis=1)

        return columns

    def into(self, draft: Draft, x: np.ndarray) -> None:
        """Write the joints' deviations: struts that share a platform joint get the same deviation of this joint."""
        joints = x[:-6].reshape(-1, 3)
        draft.machine |= {"base_deviation": joints[:6], "platform_deviation": joints[6:][self._groups]}
        draft.struts["offset"] = x[-6:]
