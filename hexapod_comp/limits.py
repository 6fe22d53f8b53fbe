"""The machine's limits, checked on nominal and on compensated values; a breach refuses, nothing is clamped."""

from __future__ import annotations

import math

import numpy as np

from .compiling import compiled
from .errors import KinematicsError, LimitError, NotFiniteError
from .geometry import STRUT_NAMES, HexapodGeometry
from .kernels import condition_one, strut_vector

WITHIN, NOT_FINITE, STROKE, BASE_CONE, PLATFORM_CONE, CONDITION, ASSEMBLY, CORRECTION, STEP = range(9)
"""What a check found; the order is the order of the checks."""

REASONS = (
    "",
    "not_finite",
    "stroke",
    "base_cone",
    "platform_cone",
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
    """

    def __init__(self, geometry: HexapodGeometry) -> None:
        limits = geometry.limits
        self.geometry = geometry
        self.stroke = limits.stroke.copy()
        self.cone_axes = np.array([geometry.base_cone_axes, geometry.platform_cone_axes])
        self.cone_cosines = np.cos(np.array([limits.base_cone, limits.platform_cone]))
        self.scalars = np.array(
            [
                limits.condition,
                limits.correction,
                limits.step,
                geometry.characteristic_length,
                geometry.home_sign,
            ]
        )

    def refusal(
        self, position: np.ndarray, rotation: np.ndarray, lengths: np.ndarray
    ) -> LimitError | KinematicsError | None:
        """Return why the nominal machine may not stand in a pose with its strut lengths, or None if it may."""
        arrays = (self.stroke, self.cone_axes, self.cone_cosines, self.scalars)
        joints = self.geometry.kernel_joints
        finding, strut, value, _ = check_stage(*joints, position, rotation, lengths, arrays)
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


@compiled
def joint_cosines(base, platform, position, rotation, cone_axes, i):
    """Return the cosines of strut `i`'s angles to the neutral directions of its base and platform joints."""
    sx, sy, sz = strut_vector(base, platform, position, rotation, i)
    length = math.sqrt(sx * sx + sy * sy + sz * sz)
    at_base = (sx * cone_axes[0, i, 0] + sy * cone_axes[0, i, 1] + sz * cone_axes[0, i, 2]) / length
    at_platform = 0.0
    for k in range(3):
        along = rotation[0, k] * sx + rotation[1, k] * sy + rotation[2, k] * sz
        at_platform += along * cone_axes[1, i, k]
    return at_base, at_platform / length


@compiled
def check_stage(base, platform, position, rotation, lengths, limits):
    """Check lengths and pose of one stage; return (finding, strut, value, condition number).

    `limits` holds stroke, cone axes, cone cosines and scalars, as in :class:`LimitTable`.
    """
    stroke, cone_axes, cone_cosines, scalars = limits
    for i in range(6):
        if not math.isfinite(lengths[i]):
            return NOT_FINITE, i, lengths[i], math.nan
        if lengths[i] < stroke[i, 0] or lengths[i] > stroke[i, 1]:
            return STROKE, i, lengths[i], math.nan
    for i in range(6):
        at_base, at_platform = joint_cosines(base, platform, position, rotation, cone_axes, i)
        if not at_base >= cone_cosines[0, i]:
            return BASE_CONE, i, math.acos(max(-1.0, min(1.0, at_base))), math.nan
        if not at_platform >= cone_cosines[1, i]:
            return PLATFORM_CONE, i, math.acos(max(-1.0, min(1.0, at_platform))), math.nan
    condition, sign = condition_one(base, platform, position, rotation, scalars[3])
    if not condition <= scalars[0]:
        return CONDITION, -1, condition, condition
    if sign != scalars[4]:
        return ASSEMBLY, -1, sign, condition
    return WITHIN, -1, 0.0, condition


@compiled
def check_change(lengths, previous, largest, finding):
    """Check six values against the previous six; return (finding or WITHIN, strut, change)."""
    for i in range(6):
        change = lengths[i] - previous[i]
        if abs(change) > largest:  # a NaN in `previous` means that there is none
            return finding, i, change
    return WITHIN, -1, 0.0
