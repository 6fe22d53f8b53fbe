"""The machine's limits, checked on nominal and on compensated values; a breach refuses, nothing is clamped."""

from __future__ import annotations

import math

import numpy as np

from .errors import KinematicsError, LimitError, NotFiniteError
from .geometry import STRUT_NAMES, HexapodGeometry
from .limit_kernels import (
    ASSEMBLY,
    BASE_CONE,
    CLEARANCE,
    CONDITION,
    CORRECTION,
    NOT_FINITE,
    PLATFORM_CONE,
    STEP,
    STROKE,
    WITHIN,
    check_stage,
)

REASONS = (
    "",
    "not_finite",
    "stroke",
    "base_cone",
    "platform_cone",
    "clearance",
    "condition",
    "assembly",
    "correction",
    "step",
)
"""Names of the findings, as counted in diagnostics."""

STAGES = ("nominal", "compensated")


class LimitTable:
    """A geometry's limits as arrays for the kernels.

    Parameters
    ----------
    geometry : HexapodGeometry
        The machine.

    Attributes
    ----------
    arrays : tuple of ndarray
        Stroke (6, 2), cone axes (2, 6, 3), cone cosines (2, 6), pairs of struts that are apart (6, 6), and the other
        limits: what :func:`~hexapod_comp.limit_kernels.check_stage` takes.
    """

    def __init__(self, geometry: HexapodGeometry) -> None:
        limits = geometry.limits
        self.geometry = geometry
        cone_axes = np.array([geometry.base_cone_axes, geometry.platform_cone_axes])
        cone_cosines = np.cos(np.array([limits.base_cone, limits.platform_cone]))
        scalars = np.array(
            [
                limits.condition,
                limits.correction,
                limits.step,
                geometry.characteristic_length,
                geometry.home_sign,
                limits.clearance,
            ]
        )
        self.arrays = (limits.stroke.copy(), cone_axes, cone_cosines, geometry.struts_apart, scalars)

    def refusal(
        self, position: np.ndarray, rotation: np.ndarray, lengths: np.ndarray
    ) -> LimitError | KinematicsError | None:
        """Return why the nominal machine may not stand in a pose with its strut lengths, or None if it may."""
        joints = self.geometry.kernel_joints
        finding, strut, value, _ = check_stage(*joints, position, rotation, lengths, self.arrays)
        return None if finding == WITHIN else self.error(finding, strut, 0, value)

    def error(self, code: int, strut: int, stage: int, value: float) -> LimitError | KinematicsError:
        """Return the error for a finding: which limit, which strut, found and allowed value with units."""
        limits, which = self.geometry.limits, STAGES[stage]
        if code == NOT_FINITE:
            return NotFiniteError(f"the {which} values at this pose are not finite")
        name = STRUT_NAMES[strut] if strut >= 0 else ""
        low, high = limits.stroke[strut]
        cone = (limits.base_cone if code == BASE_CONE else limits.platform_cone)[strut]
        allowed, text = {
            STROKE: (
                low if value < low else high,
                f"{name}: {which} length {value * 1e3:.4f} mm is outside the stroke "
                f"{low * 1e3:.3f}…{high * 1e3:.3f} mm",
            ),
            BASE_CONE: (cone, _cone_text(name, which, "base", value, cone)),
            PLATFORM_CONE: (cone, _cone_text(name, which, "platform", value, cone)),
            CLEARANCE: (
                limits.clearance,
                f"{name}: {value * 1e3:.3f} mm from the nearest other strut ({which}), "
                f"allowed {limits.clearance * 1e3:g} mm",
            ),
            CONDITION: (
                limits.condition,
                f"condition number {value:.4g} of the {which} pose is above {limits.condition:g}: near a singularity",
            ),
            ASSEMBLY: (0.0, f"the {which} pose belongs to another assembly mode than home"),
            CORRECTION: (
                limits.correction,
                f"{name}: correction {value * 1e6:.3f} µm is larger than ±{limits.correction * 1e6:g} µm",
            ),
            STEP: (
                limits.step,
                f"{name}: the {which} length would change by {value * 1e3:.4f} mm in one command, "
                f"allowed {limits.step * 1e3:g} mm",
            ),
        }[code]
        return LimitError(REASONS[code], text, value, float(allowed), strut if strut >= 0 else None, which)


def _cone_text(name: str, which: str, body: str, value: float, limit: float) -> str:
    return (
        f"{name}: {body} joint at {math.degrees(value):.3f}° ({which}), allowed {math.degrees(limit):g}° "
        "from its neutral direction"
    )
