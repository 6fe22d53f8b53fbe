"""Loads on the machine (weight of platform and tool, gravity, other forces) and the stiffness of the struts."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from ..errors import FrameError, ModelError, shorten
from ..formats.schema import PER_STRUT
from .terms import term, validate_terms

if TYPE_CHECKING:
    from .geometry import HexapodGeometry

STANDARD_GRAVITY = 9.80665  # m/s²
DOWN = (0.0, 0.0, -STANDARD_GRAVITY)
EARTH = (9.0, 10.6)  # Range of gravity on Earth as accelerometers read it, m/s²; a value outside has another unit
LEAST_STIFFNESS = 1e5  # Smallest stiffness of a strut, N/m; a smaller number is most likely in another unit
LARGEST_MASS = 1e5  # Largest mass of a tool or platform, kg
MOST_LOADS = 50  # Largest number of measured loads in a model file
# Tolerated difference between a load and the measured loads: of mass, kg and as a share of the mass (the larger value
# counts), and of gravity's direction, rad
TOLERATED_MASS, TOLERATED_TILT = (0.5, 0.05), math.radians(5.0)


@dataclass(frozen=True)
class Payload:
    mass: float = 0.0  # kg
    centre: tuple[float, float, float] = (0.0, 0.0, 0.0)  # centre of mass in ``platform``, m

    def __post_init__(self) -> None:
        centre = tuple(float(value) for value in self.centre)
        if not 0.0 <= self.mass <= LARGEST_MASS:
            raise ModelError("mass", f"must be 0…{LARGEST_MASS:g} kg", self.mass)
        if len(centre) != 3 or not all(math.isfinite(value) for value in centre):
            raise ModelError("centre", "must be three finite numbers, m", list(centre))
        object.__setattr__(self, "centre", centre)

    def __str__(self) -> str:
        centre = ", ".join(f"{1e3 * value:g}" for value in self.centre)
        return f"{self.mass:g} kg at ({centre}) mm in platform"


NOTHING = Payload()


def beyond_loads(loads: Sequence[Sequence[float]], payload: Payload, gravity: Sequence[float]) -> str:
    """Return as text how payload and gravity differ from the loads during a model's measurement; empty if similar."""
    if not loads:
        return ""
    rows, problems = np.array(loads), []
    low, high = float(rows[:, 0].min()), float(rows[:, 0].max())
    slack = max(TOLERATED_MASS[0], TOLERATED_MASS[1] * high)
    if not low - slack <= payload.mass <= high + slack:
        measured = f"{low:g} kg" if low == high else f"{low:g}…{high:g} kg"
        problems.append(f"the tool weighs {payload.mass:g} kg, but the model was measured with tools of {measured}")
    down = np.unique(rows[:, 4:] / np.linalg.norm(rows[:, 4:], axis=1, keepdims=True), axis=0)
    now = np.array(gravity) / np.linalg.norm(gravity)
    away = float(np.arccos(np.clip(down @ now, -1.0, 1.0)).min())
    between = np.arccos(np.clip(down @ down.T, -1.0, 1.0)) + 4.0 * np.eye(len(down))
    # Gravity may point between two measured directions, so half of the largest angle between neighbours is allowed too
    allowed = TOLERATED_TILT + (0.5 * float(between.min(axis=1).max()) if len(down) > 1 else 0.0)
    if away > allowed:
        found, most = math.degrees(away), math.degrees(allowed)
        problems.append(f"gravity is {found:.0f}° from the nearest measured direction, allowed at most {most:.0f}°")
    return "; ".join(problems)


def check_gravity(key: str, vector: ArrayLike) -> tuple[float, float, float]:
    g = np.array(vector, dtype=float)
    if g.shape != (3,) or not EARTH[0] <= np.linalg.norm(g) <= EARTH[1]:
        allowed = "three numbers of magnitude {:g}…{:g} m/s²".format(*EARTH)
        raise ModelError(key, f"must be {allowed}; is the unit right?", g.tolist())
    return float(g[0]), float(g[1]), float(g[2])


class Loading(NamedTuple):
    """Gravity, and a force and torque that act on the platform in addition to weight."""

    gravity: tuple[float, float, float] | None = None  # in ``base``, m/s²; None: the model's gravity
    wrench: tuple[float, ...] = (0.0,) * 6  # in ``platform``: force, N, and torque about its origin, N m

    @classmethod
    def of(cls, gravity: ArrayLike | None = None, wrench: ArrayLike | None = None) -> Loading:
        w = np.zeros(6) if wrench is None else np.array(wrench, dtype=float)
        if w.shape != (6,) or not np.isfinite(w).all():
            raise ModelError("wrench", "must be six finite numbers: force, N, and torque, N m", w.tolist())
        return cls(None if gravity is None else check_gravity("gravity", gravity), tuple(w.tolist()))

    def numbers(self) -> list[float | None]:
        """Return gravity, force and torque as nine numbers; the first three are None if gravity is None."""
        return [*(self.gravity or (None,) * 3), *self.wrench]

    @classmethod
    def from_numbers(cls, numbers: Sequence[float | None]) -> Loading:
        """Make the loading from the nine numbers that :meth:`numbers` returns."""
        given = list(numbers)
        if len(given) != 9:
            raise ModelError("loading", "must be nine numbers: gravity, force and torque", given)
        values = np.array(given, dtype=float)  # None becomes NaN
        return cls.of(None if given[0] is None else values[:3], values[3:])


FREE = Loading()  # The model's gravity, and no other force


def wrench_on_platform(
    geometry: HexapodGeometry, frame: str, force: np.ndarray, torque: np.ndarray
) -> tuple[float, ...]:
    """Convert a force, N, and a torque, N m, in `frame` to a wrench in ``platform``, about the platform's origin."""
    if frame not in ("platform", geometry.tool_name):
        raise FrameError(f"wrench: frame_id must be platform or {geometry.tool_name}, not {shorten(frame)}")
    if frame == geometry.tool_name:
        tool = geometry.tool
        force, torque = tool.rotation @ force, tool.rotation @ torque + np.cross(tool.position, tool.rotation @ force)
    return Loading.of(None, [*force, *torque]).wrench


def reciprocal(values: np.ndarray) -> np.ndarray:
    """Convert stiffnesses, N/m, to compliances, m/N, or back; for a rigid strut, 0 stands for both."""
    return np.divide(1.0, values, out=np.zeros(6), where=values > 0.0)


@dataclass(frozen=True)
class Load:
    """How the struts stretch under load; all other terms of a model describe the machine without load."""

    stiffness: np.ndarray = term(
        "load", "N_per_um", "axial stiffness of a strut with both joints; 0: rigid", PER_STRUT, least=0.0, largest=1e12
    )
    lost_motion: np.ndarray = term(
        "load", "um", "length of a strut when pulled minus length when pushed", PER_STRUT, largest=1e-3
    )
    take_up: float = term(
        "load", "N", "axial force that takes up a strut's lost motion completely", (), 1.0, least=1e-3, largest=1e6
    )
    mass: float = term(
        "load", "kg", "mass of platform and upper strut halves, without tools", (), largest=LARGEST_MASS, least=0.0
    )
    centre: np.ndarray = term("load", "mm", "centre of the mass `mass_kg`, in `platform`", (3,), largest=100.0)
    gravity: np.ndarray = term(
        "load", "m_s2", "gravity in `base`; nodes can replace it", (3,), np.array(DOWN), largest=EARTH[1]
    )
    friction: np.ndarray = term(
        "load", "N_m", "friction torque in each bearing of a strut's joints", PER_STRUT, largest=1e3
    )

    def __post_init__(self) -> None:
        validate_terms(self)
        soft = (self.stiffness > 0.0) & (self.stiffness < LEAST_STIFFNESS)
        if soft.any():
            problem = f"must be 0, which means rigid, or at least {LEAST_STIFFNESS * 1e-6:g} N/µm; is the unit right?"
            raise ModelError("load.stiffness", problem, float(f"{1e-6 * self.stiffness[soft][0]:.6g}"))
        check_gravity("load.gravity", self.gravity)

    @property
    def compliance(self) -> np.ndarray:
        """Lengthening of each strut per newton of tension, m/N, shape (6,)."""
        return reciprocal(self.stiffness)

    @property
    def bends(self) -> bool:
        """Whether any strut has a stiffness or a lost motion, so that its length depends on its force."""
        return bool(self.stiffness.any() or self.lost_motion.any())

    def numbers(self) -> tuple[float, ...]:
        """Return all terms of the load as 26 numbers in SI, with compliances in place of stiffnesses."""
        return (
            *(*self.compliance.tolist(), *self.lost_motion.tolist(), self.take_up, self.mass),
            *(*self.centre.tolist(), *self.gravity.tolist(), *self.friction.tolist()),
        )

    @classmethod
    def from_numbers(cls, numbers: Sequence[float]) -> Load:
        """Make the load from the 26 numbers that :meth:`numbers` returns."""
        if len(numbers) != 26:
            raise ModelError("load", "must be 26 numbers", list(numbers))
        n = np.array(numbers, dtype=float)
        return cls(reciprocal(n[:6]), n[6:12], float(n[12]), float(n[13]), n[14:17], n[17:20], n[20:])

    def members(self, geometry: HexapodGeometry) -> dict[str, Any]:
        """Return the C struct ``hc_load`` as values by member name; mass and moment include the tool in use."""
        tool = geometry.payload
        return {
            "bends": int(self.bends),
            "compliance": self.compliance,
            "play": self.lost_motion,
            "friction": self.friction,
            "take_up": self.take_up,
            "mass": self.mass + tool.mass,
            "moment": self.mass * self.centre + tool.mass * np.array(tool.centre),
            "gravity": self.gravity,
        }
