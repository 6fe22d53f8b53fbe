"""The length errors of the real struts: offset, pitch, screw waves, length map, backlash, growth, screw rotation."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from ..core import MOST_HARMONICS
from ..core.batch import screw_twists
from ..errors import ModelError
from .geometry import HexapodGeometry
from .temperatures import EXPANSION
from .terms import TINY, term, validate_terms

# Largest slope of the length error over the command, m per m, for which Newton's method finds the command
STEEPEST_ERROR = 0.2
STRUT_LENGTH = 0.1  # Largest error of a strut's length, m; every encoder's zero is known within 0.1 m
# Largest growth from 0 to 100 % humidity, as a share of the length: nylon has 0.03, carbon fibre 1e-4
MOISTURE = 0.1
WAVE_PARTS, MAP_PARTS = ("cosine", "sine"), ("map_knots", "map_values", "map_backlash")
# Arguments of `term` for arrays with a column per harmonic, or per knot, whose shape StrutErrors checks
WAVE: dict[str, Any] = {"default": np.zeros((6, 1)), "largest": STRUT_LENGTH, "checked": False}
MAP: dict[str, Any] = {"shape": (6, None), "largest": STRUT_LENGTH, "checked": False}


@dataclass(frozen=True)
class StrutErrors:
    """Length errors of the six struts: waves (6, harmonics), maps (6, knots), `map_knots` (knots,), all others (6,)."""

    offset: np.ndarray = term("struts", "um", "constant length error, actual − commanded", largest=STRUT_LENGTH)
    pitch: np.ndarray = term("struts", "ppm", "relative error of the screw's pitch")
    reference_length: np.ndarray = term("struts", "mm", "command at which the pitch error adds no length")
    backlash: np.ndarray = term("struts", "um", "lost motion on reversal", least=0.0, largest=STRUT_LENGTH)
    expansion: np.ndarray = term("struts", "ppm_per_K", "thermal expansion of the strut", largest=EXPANSION)
    moisture: np.ndarray = term(
        "struts", "ppm_per_percent", "growth per percent of relative humidity above 50 %", largest=MOISTURE
    )
    cosine: np.ndarray = term("struts.wave", "um", "screw wave: amplitude of cos(2πc/period) of command c", **WAVE)
    sine: np.ndarray = term("struts.wave", "um", "screw wave: amplitude of sin(2πc/period) of command c", **WAVE)
    period: np.ndarray = term("struts.wave", "mm", "change of length per screw turn", default=0.01, least=TINY)
    map_knots: np.ndarray = term("struts.map", "mm", "strut commands at the knots, increasing", (None,), key="knots")
    map_values: np.ndarray = term(
        "struts.map", "um", "length error at each knot: cubic spline, constant beyond the ends", key="values", **MAP
    )
    map_backlash: np.ndarray = term(
        "struts.map", "um", "lost motion at each knot, in addition to `backlash_um`", key="backlash", **MAP
    )

    def __post_init__(self) -> None:
        for name in WAVE_PARTS:
            if np.shape(getattr(self, name)) == (6,):
                object.__setattr__(self, name, np.array(getattr(self, name), dtype=float)[:, None])
        validate_terms(self)
        self._trim_waves()
        self._check_map()
        slope = self._steepest()
        if slope.max() > STEEPEST_ERROR:
            index = int(slope.argmax())
            problem = f"length error changes by {slope[index]:.3g} m per m of command, allowed {STEEPEST_ERROR}"
            raise ModelError(f"struts[{index}]", problem)

    def _trim_waves(self) -> None:
        """Check the shapes of the wave arrays, and drop the highest harmonics if they are zero in all struts."""
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
        if not self.map_backlash.any():
            object.__setattr__(self, "map_backlash", np.zeros((6, len(knots))))
        for name in MAP_PARTS[1:]:
            shape = getattr(self, name).shape
            if shape != (6, len(knots)):
                problem = f"must have shape (6, {knots.size}), one value per knot, not {shape}"
                raise ModelError(f"struts.{name}", problem)
        if len(knots) == 1 or (np.diff(knots) <= 0.0).any():
            raise ModelError("struts.map_knots", "needs at least two increasing lengths", knots.tolist())

    @property
    def harmonics(self) -> np.ndarray:
        """Number of periods per screw turn for each column of `cosine` and `sine`: 1, 2, …, n."""
        return np.arange(1, self.cosine.shape[1] + 1)

    def _steepest(self) -> np.ndarray:
        """Return for each strut an upper bound of |dL/dc − 1|, with the actual length L at the command c."""
        waves = 2.0 * np.pi / self.period * (np.hypot(self.cosine, self.sine) @ self.harmonics)
        steep = np.abs(self.pitch) + waves
        if len(self.map_knots):
            cubic, square, linear, _ = np.moveaxis(self.spline_coefficients().reshape(6, -1, 2, 4), 3, 0)
            along = np.linspace(0.0, 1.0, 20)[:, None, None, None] * np.diff(self.map_knots)[:, None]
            slopes = (3.0 * cubic * along + 2.0 * square) * along + linear
            lengths, backlash = np.abs(slopes).max(axis=(0, 2)).T
            steep = steep + lengths + 0.5 * backlash
        return steep

    @property
    def largest_backlash(self) -> np.ndarray:
        """Largest lost motion of each strut over its stroke, m, shape (6,)."""
        return self.backlash + self.map_backlash.max(axis=1, initial=0.0)

    def spline_coefficients(self) -> np.ndarray:
        """Return 4 coefficients of the length map, then 4 of the backlash map, between n knots, (6, n − 1, 8)."""
        if not len(self.map_knots):
            return np.zeros((6, 0, 8))
        pieces = natural_spline(self.map_knots, np.vstack([self.map_values, self.map_backlash]).T)
        lengths, backlash = np.split(np.transpose(pieces, (2, 1, 0)), 2)
        return np.ascontiguousarray(np.concatenate([lengths, backlash], axis=2))

    def members(self, geometry: HexapodGeometry) -> list[dict[str, Any]]:
        """Return for each strut the C struct ``hc_strut`` as values by member name."""
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
            "twist_home": home_twists(geometry) if geometry.screw_lead.any() else np.zeros(6),
            "expansion": self.expansion,
            "moisture": self.moisture,
            "wave": wave,
        }
        return [{name: column[i] for name, column in columns.items()} for i in range(6)]


def natural_spline(knots: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Return the coefficients, (4, n − 1, k), of k natural cubic splines through values, (n, k), at knots, (n,).

    Between two knots a spline is a polynomial in x minus the first of these knots, with the cubic coefficient first.
    SciPy's CubicSpline gives the same, but its import needs 50 MB of memory.
    """
    width, slope = np.diff(knots)[:, None], np.diff(values, axis=0) / np.diff(knots)[:, None]
    bends = np.zeros(values.shape)  # second derivatives at the knots, zero at both ends
    inner, beside = np.arange(len(knots) - 2), np.diff(knots)[1:-1]
    matrix = np.diag(2.0 * (knots[2:] - knots[:-2]))
    matrix[inner[:-1], inner[1:]] = matrix[inner[1:], inner[:-1]] = beside
    bends[1:-1] = np.linalg.solve(matrix, 6.0 * np.diff(slope, axis=0))
    first, last = bends[:-1], bends[1:]
    return np.stack(
        [(last - first) / (6.0 * width), 0.5 * first, slope - width * (2.0 * first + last) / 6.0, values[:-1]]
    )


def home_twists(geometry: HexapodGeometry) -> np.ndarray:
    """Return the angles, (6,), rad, about each strut between the cardan axes of its two joints at home. At home the
    length correction for the screw's rotation is zero.
    """
    body = *geometry.kernel_joints, *geometry.kernel_axes
    return screw_twists(*body, geometry.home.position[None], geometry.home.rotation[None])[0]


def turns_of_screws(geometry: HexapodGeometry, positions: np.ndarray, rotations: np.ndarray) -> np.ndarray:
    """Return by how many revolutions, −½…½, cardan joints turn six screws from home to N platform poses, (N, 6)."""
    twists = screw_twists(*geometry.kernel_joints, *geometry.kernel_axes, positions, rotations)
    turns = (twists - home_twists(geometry)) / (2.0 * np.pi)
    return turns - np.round(turns)
