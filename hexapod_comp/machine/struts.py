"""What a real strut does with its command: offset, pitch, screw waves, length map, backlash, growth, rotation.

One strut, command c (what its encoder counts, m) to actual length L (m):

    L = (1 + g) · (c + o + p·(c − c₀) + Σ (Aₙ·cos(nkc) + Bₙ·sin(nkc)) + map(c) − s·b(c)/2 + l·θ/2π)

with offset o, pitch error p about the length c₀, screw waves Aₙ, Bₙ of period 2π/k and its harmonics n = 1…4, length
map, backlash b by the sense of motion s, which may change along a worn screw, screw lead l times the rotation θ that
the cardan joints force on the screw since home, and growth g, by heat and by humidity. The compensator solves it for c.
"""

from __future__ import annotations

from dataclasses import dataclass, field, fields
from typing import TYPE_CHECKING, Any

import numpy as np

from ..core import MOST_HARMONICS
from ..core.batch import screw_twists
from ..errors import ModelError
from .geometry import HexapodGeometry

if TYPE_CHECKING:
    from scipy.interpolate import CubicSpline

STEEPEST_ERROR = 0.2
"""Largest slope of the strut error against the command: below it, undoing the error is a contraction."""

WAVE_PARTS, MAP_PARTS = ("cosine", "sine"), ("map_knots", "map_values", "map_backlash")


@dataclass(frozen=True)
class StrutErrors:
    """Errors of the six struts; every array has shape (6,) unless it says otherwise, every default is zero."""

    offset: np.ndarray = field(default_factory=lambda: np.zeros(6))  # Length at a zero command error, m
    pitch: np.ndarray = field(default_factory=lambda: np.zeros(6))  # Relative pitch error, m per m
    # Command at which the pitch error is zero, m
    reference_length: np.ndarray = field(default_factory=lambda: np.zeros(6))
    # (6, n): screw wave amplitudes, m: of the harmonics 1 to n per turn, n up to 4; of shape (6,), of the first alone.
    # They are kept as (6, n)
    cosine: np.ndarray = field(default_factory=lambda: np.zeros((6, 1)))
    # (6,): screw wave amplitudes, m: of the harmonics 1 to n per turn, n up to 4; of shape (6,), of the first alone.
    # They are kept as (6, n)
    sine: np.ndarray = field(default_factory=lambda: np.zeros((6, 1)))
    # Screw wave period, usually the lead, m; required above zero where an amplitude is not zero
    period: np.ndarray = field(default_factory=lambda: np.full(6, 0.01))
    backlash: np.ndarray = field(default_factory=lambda: np.zeros(6))  # Lost motion on reversal, m
    expansion: np.ndarray = field(default_factory=lambda: np.zeros(6))  # Thermal expansion of the struts, 1/K
    # Growth of the struts by the air's relative humidity, m/m from 0 to 1
    moisture: np.ndarray = field(default_factory=lambda: np.zeros(6))
    # (n,): commands of the length map, m, increasing; empty for none
    map_knots: np.ndarray = field(default_factory=lambda: np.zeros(0))
    # (6, n): length error at the knots, m; a natural cubic spline runs between, the end values hold outside
    map_values: np.ndarray = field(default_factory=lambda: np.zeros((6, 0)))
    # (6, n): by how much the lost motion on reversal is larger at the knots than `backlash`, m; in the same way. Left
    # out, it is the same everywhere
    map_backlash: np.ndarray = field(default_factory=lambda: np.zeros((6, 0)))

    def __post_init__(self) -> None:
        for entry in fields(self):
            array = np.array(getattr(self, entry.name), dtype=float)
            if not np.isfinite(array).all():
                raise ModelError(f"struts.{entry.name}", "must be finite", array.tolist())
            if entry.name in WAVE_PARTS and array.shape == (6,):
                array = array[:, None]
            if entry.name not in (*WAVE_PARTS, *MAP_PARTS) and array.shape != (6,):
                raise ModelError(f"struts.{entry.name}", f"must have shape (6,), not {array.shape}")
            array.flags.writeable = False
            object.__setattr__(self, entry.name, array)
        if (self.backlash < 0.0).any():
            raise ModelError("struts.backlash", "must not be negative", self.backlash.tolist())
        if (self.period <= 0.0).any():
            raise ModelError("struts.period", "must be above zero", self.period.tolist())
        self._settle_waves()
        self._check_map()
        slope = self._steepest()
        if slope.max() > STEEPEST_ERROR:
            index = int(slope.argmax())
            problem = f"strut error changes by {slope[index]:.3g} m per m, allowed {STEEPEST_ERROR}"
            raise ModelError(f"struts[{index}]", problem)

    def _settle_waves(self) -> None:
        """Check the waves' shapes; leave out the last harmonics where no strut has them."""
        shape = self.cosine.shape
        if len(shape) != 2 or shape[0] != 6 or not 1 <= shape[1] <= MOST_HARMONICS or self.sine.shape != shape:
            problem = (
                f"must both have shape (6, n) with n = 1…{MOST_HARMONICS} harmonics, not {shape} and {self.sine.shape}"
            )
            raise ModelError("struts.cosine, struts.sine", problem)
        used = (self.cosine != 0.0).any(axis=0) | (self.sine != 0.0).any(axis=0)
        count = int((used * self.harmonics).max(initial=1))
        for name in WAVE_PARTS:
            object.__setattr__(self, name, getattr(self, name)[:, :count])

    def _check_map(self) -> None:
        knots = self.map_knots
        if knots.ndim == 1 and not self.map_backlash.any():
            object.__setattr__(self, "map_backlash", np.zeros((6, len(knots))))
        for name in MAP_PARTS[1:]:
            shape = getattr(self, name).shape
            if knots.ndim != 1 or shape != (6, len(knots)):
                problem = f"must have shape (6, {knots.size}), one value per knot, not {shape}"
                raise ModelError(f"struts.{name}", problem)
        if len(knots) == 1 or (np.diff(knots) <= 0.0).any():
            raise ModelError("struts.map_knots", "needs at least two increasing lengths", knots.tolist())

    @property
    def harmonics(self) -> np.ndarray:
        """How often per turn each column of the screw waves repeats, shape (n,): 1, 2, …."""
        return np.arange(1, self.cosine.shape[1] + 1)

    def _steepest(self) -> np.ndarray:
        """Return a bound of |dL/dc − 1| per strut."""
        waves = 2.0 * np.pi / self.period * (np.hypot(self.cosine, self.sine) @ self.harmonics)
        steep = np.abs(self.pitch) + waves
        if len(self.map_knots):
            spline = self._spline().derivative()
            dense = np.linspace(self.map_knots[0], self.map_knots[-1], 20 * len(self.map_knots))
            lengths, backlash = np.abs(spline(dense)).reshape(2, 6, -1).max(axis=2)
            steep = steep + lengths + 0.5 * backlash
        return steep

    @property
    def largest_backlash(self) -> np.ndarray:
        """Lost motion where it is largest, m, shape (6,)."""
        return self.backlash + self.map_backlash.max(axis=1, initial=0.0)

    def _spline(self) -> CubicSpline:
        """Return the length errors of struts 1–6, and then the changes of their backlash."""
        from scipy.interpolate import CubicSpline  # 14 MB with all that it needs, which a node without a map does not

        return CubicSpline(self.map_knots, np.vstack([self.map_values, self.map_backlash]), axis=1, bc_type="natural")

    def spline_coefficients(self) -> np.ndarray:
        """Return the cubic pieces of the map and of the backlash's change, shape (6, n − 1, 8).

        Of each four, the highest power comes first; they are about each left knot.
        """
        if not len(self.map_knots):
            return np.zeros((6, 0, 8))
        lengths, backlash = np.split(np.transpose(self._spline().c, (2, 1, 0)), 2)
        return np.ascontiguousarray(np.concatenate([lengths, backlash], axis=2))

    def members(self, geometry: HexapodGeometry) -> list[dict[str, Any]]:
        """Return what hc_strut holds of each strut, by name."""
        count = (((self.cosine != 0.0) | (self.sine != 0.0)) * self.harmonics).max(axis=1)
        wave = np.zeros((6, MOST_HARMONICS, 2))
        wave[:, : self.cosine.shape[1]] = np.stack([self.cosine, self.sine], axis=2)
        columns = {
            "offset": self.offset,
            "pitch": self.pitch,
            "reference": self.reference_length,
            "wavenumber": 2.0 * np.pi / self.period,
            "harmonics": count.astype(float),
            "backlash": self.backlash,
            "lead": geometry.screw_lead,
            "twist_home": home_twists(geometry),
            "expansion": self.expansion,
            "moisture": self.moisture,
            "wave": wave,
        }
        return [{name: column[i] for name, column in columns.items()} for i in range(6)]


def home_twists(geometry: HexapodGeometry) -> np.ndarray:
    """Return the screw rotation of each strut at home, rad, shape (6,): the zero of the correction."""
    if not geometry.screw_lead.any():
        return np.zeros(6)
    body = *geometry.kernel_joints, *geometry.kernel_axes
    return screw_twists(*body, geometry.home.position[None], geometry.home.rotation[None])[0]
