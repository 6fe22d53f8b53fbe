"""The machine's limits for nominal and compensated commands; a command beyond a limit is refused, not clamped."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Annotated

import numpy as np

from ..core import Status, ffi, lib
from ..errors import GeometryError, KinematicsError, LimitError, NotFiniteError, TooEarlyError
from ..formats.schema import PAIRS_PER_STRUT, PER_STRUT, Numbers

STRUT_NAMES = tuple(f"strut_{i}" for i in range(1, 7))  # Names of the six struts, in the geometry file's order
# Names of the core's statuses, by their number; diagnostics count refused commands by these names
REASONS = tuple(ffi.string(lib.hc_reason(status)).decode() for status in range(Status.ACCELERATION + 1))
STAGES = ("nominal", "compensated")
TINY = np.finfo(float).tiny


@dataclass(frozen=True)
class Limits:
    """Limits of the machine; a command beyond a limit is refused, never clamped.

    Parameters
    ----------
    stroke : ndarray, shape (6, 2)
        Shortest and longest strut length, m.
    base_cone, platform_cone : ndarray, shape (6,)
        Largest angle between each strut and its joint's neutral direction, rad.
    condition : float
        Largest condition number of the Jacobian (see :func:`hexapod_comp.machine.kinematics.condition_number`).
    correction : float
        Largest magnitude of a strut correction, m.
    step : float
        Largest change of a strut's length from one command to the next, m.
    speed : float
        Largest strut speed, m/s.
    clearance : float, optional
        Smallest distance between the axes of two struts without a common joint, m; 0: not limited.
    acceleration : float, optional
        Largest strut acceleration, m/s²; 0: not limited. The acceleration is the derivative of the strut speed
        after low-pass filtering with a time constant of 20 ms (SMOOTHED_OVER in the core).
    jerk : float, optional
        Largest strut jerk of planned motions, m/s³; 0: not limited. The jerk of commands is not checked.
    """

    stroke: Annotated[np.ndarray, Numbers("mm", PAIRS_PER_STRUT)]
    base_cone: Annotated[np.ndarray, Numbers("deg", PER_STRUT)]
    platform_cone: Annotated[np.ndarray, Numbers("deg", PER_STRUT)]
    condition: Annotated[float, Numbers("", key="condition_number")]
    correction: Annotated[float, Numbers("um")]
    step: Annotated[float, Numbers("mm")]
    speed: Annotated[float, Numbers("mm_s")]
    clearance: Annotated[float, Numbers("mm")] = 0.0
    acceleration: Annotated[float, Numbers("mm_s2")] = 0.0
    jerk: Annotated[float, Numbers("mm_s3")] = 0.0
    cone_cosines: np.ndarray = field(init=False, repr=False)
    """Cosines of `base_cone` and `platform_cone`, shape (2, 6)."""

    def __post_init__(self) -> None:
        for name, shape in (("stroke", (6, 2)), ("base_cone", (6,)), ("platform_cone", (6,))):
            object.__setattr__(self, name, frozen_array(getattr(self, name), shape, f"limits.{name}"))
        for index, (shortest, longest) in enumerate(self.stroke):
            if not 0.0 < shortest < longest:
                problem = "shortest length must be positive and below the longest"
                raise GeometryError(f"limits.stroke[{index}]", problem, [float(shortest), float(longest)])
        for name in ("base_cone", "platform_cone"):
            for index, angle in enumerate(getattr(self, name)):
                if not 0.0 < angle <= np.pi:
                    raise GeometryError(f"limits.{name}[{index}]", "must be above 0 and at most 180°", float(angle))
        for name, least in (("condition", 1.0), ("correction", 0.0), ("step", 0.0), ("speed", 0.0)):
            value = getattr(self, name)
            if not (np.isfinite(value) and value > least):
                raise GeometryError(f"limits.{name}", f"must be finite and above {least:g}", value)
        for name in ("clearance", "acceleration", "jerk"):
            if not 0.0 <= getattr(self, name) < np.inf:
                raise GeometryError(f"limits.{name}", "must be finite and not negative", getattr(self, name))
        object.__setattr__(self, "cone_cosines", np.cos(np.array([self.base_cone, self.platform_cone])))

    def margins(self, quantities: np.ndarray) -> dict[str, tuple[np.ndarray, np.ndarray]]:
        """Return by limit name: the margins (negative if the limit is broken), and the values that the limit bounds."""
        angles, condition = np.arccos(np.clip(quantities["cosines"], -1.0, 1.0)), quantities["condition"][..., None]
        cones = np.array([self.base_cone, self.platform_cone]) - angles
        # As in the core, the cosines decide whether an angle is within its limit, because arccos rounds
        cones = np.where(quantities["cosines"] >= self.cone_cosines, np.maximum(cones, 0.0), np.minimum(cones, -TINY))
        stroke = np.minimum(quantities["lengths"] - self.stroke[:, 0], self.stroke[:, 1] - quantities["lengths"])
        margins = {
            "stroke": (stroke, quantities["lengths"]),
            "base_cone": (cones[..., 0, :], angles[..., 0, :]),
            "platform_cone": (cones[..., 1, :], angles[..., 1, :]),
            "condition": (self.condition - condition, condition),
        }
        if self.clearance:
            margins["clearance"] = (quantities["distances"] - self.clearance, quantities["distances"])
        return margins

    def error(self, code: int, strut: int, stage: int, value: float) -> LimitError | KinematicsError:
        """Return the error for a status of the core; its message has limit, strut, found value and allowed value."""
        which, name, mm = STAGES[stage], STRUT_NAMES[strut] if strut >= 0 else "", value * 1e3
        low, high = self.stroke[strut]
        allowed = 0.0
        if code == Status.NOT_FINITE:
            return NotFiniteError(f"the {which} strut lengths at this pose are not finite")
        if code == Status.EARLY:
            text = f"{name}: the command is {mm:.3g} ms too early for the speed limit of {self.speed * 1e3:g} mm/s"
            return TooEarlyError(text, value, self.speed, strut)
        if code in (Status.STROKE_SHORT, Status.STROKE_LONG):
            allowed = low if value < low else high
            stroke = f"{low * 1e3:.3f}…{high * 1e3:.3f} mm"
            text = f"{name}: {which} length {mm:.4f} mm is outside the stroke {stroke}"
        elif code in (Status.BASE_CONE, Status.PLATFORM_CONE):
            body, cones = ("base", self.base_cone) if code == Status.BASE_CONE else ("platform", self.platform_cone)
            allowed = cones[strut]
            found, most = math.degrees(value), math.degrees(allowed)
            text = f"{name}: {body} joint at {found:.3f}° from its neutral direction ({which}), allowed {most:g}°"
        elif code == Status.ASSEMBLY:
            text = f"the {which} pose belongs to another assembly mode than home"
        else:
            if code in (Status.SPEED, Status.ACCELERATION):
                which = "compensated"
            allowed = getattr(self, REASONS[code])
            most = allowed * 1e3
            text = {
                Status.CLEARANCE: f"{name}: {mm:.3f} mm from the nearest strut ({which}), must be at least {most:g} mm",
                Status.CONDITION: f"condition number {value:.4g} of the {which} pose is above {allowed:g}: "
                "near a singularity",
                Status.CORRECTION: f"{name}: correction {value * 1e6:.3f} µm is larger than ±{allowed * 1e6:g} µm",
                Status.STEP: f"{name}: the {which} length would change by {mm:.4f} mm in one command, "
                f"allowed {most:g} mm",
                Status.SPEED: f"{name}: speed {mm:.4g} mm/s by time stamps, allowed {most:g} mm/s",
                Status.ACCELERATION: f"{name}: acceleration {mm:.4g} mm/s² by time stamps, allowed {most:g} mm/s²",
            }[Status(code)]
        return LimitError(REASONS[code], text, value, float(allowed), strut if strut >= 0 else None, which)


def frozen_array(values: object, shape: tuple[int, ...], key: str) -> np.ndarray:
    array = np.array(values, dtype=float, order="C")
    if array.shape != shape:
        raise GeometryError(key, f"must have shape {shape}, not {array.shape}")
    if not np.isfinite(array).all():
        raise GeometryError(key, "must be finite", array.tolist())
    array.flags.writeable = False
    return array
