"""What a real strut does with its command: offset, pitch, screw waves, length map, backlash, growth, rotation.

One strut, command c (what its encoder counts, m) to actual length L (m):

    L = (1 + g) · (c + o + p·(c − c₀) + A·cos(kc) + B·sin(kc) + map(c) − s·b/2 + l·θ/2π)

with offset o, pitch error p about the length c₀, screw waves A, B of period 2π/k, length map, backlash b by
the sense of motion s, screw lead l times the rotation θ that the cardan joints force on the screw since
home, and thermal growth g. The compensator solves it for c.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, fields

import numpy as np
from scipy.interpolate import CubicSpline

from .compiling import compiled
from .errors import ModelError
from .geometry import HexapodGeometry
from .kernels import strut_vector

OFFSET, PITCH, REFERENCE, COSINE, SINE, WAVENUMBER, BACKLASH, LEAD, TWIST_HOME, GROWTH = range(10)
"""Columns of the table of strut parameters that the kernels read."""
PARAMETERS = 10

STEEPEST_ERROR = 0.2
"""Largest slope of the strut error against the command: below it, undoing the error is a contraction."""


@dataclass(frozen=True)
class StrutErrors:
    """Errors of the six struts; every array has shape (6,) unless it says otherwise, every default is zero.

    Parameters
    ----------
    offset : ndarray
        Length at a zero command error, m.
    pitch : ndarray
        Relative pitch error, m per m.
    reference_length : ndarray
        Command at which the pitch error is zero, m.
    cosine, sine : ndarray
        Screw wave amplitudes, m.
    period : ndarray
        Screw wave period, usually the lead, m; required above zero where an amplitude is not zero.
    backlash : ndarray
        Lost motion on reversal, m.
    expansion : ndarray
        Thermal expansion of the struts, 1/K.
    map_knots : ndarray, shape (n,)
        Commands of the length map, m, increasing; empty for none.
    map_values : ndarray, shape (6, n)
        Length error at the knots, m; a natural cubic spline runs between, the end values hold outside.

    Raises
    ------
    ModelError
        Shapes, signs or slopes that no strut can have.
    """

    offset: np.ndarray = field(default_factory=lambda: np.zeros(6))
    pitch: np.ndarray = field(default_factory=lambda: np.zeros(6))
    reference_length: np.ndarray = field(default_factory=lambda: np.zeros(6))
    cosine: np.ndarray = field(default_factory=lambda: np.zeros(6))
    sine: np.ndarray = field(default_factory=lambda: np.zeros(6))
    period: np.ndarray = field(default_factory=lambda: np.full(6, 0.01))
    backlash: np.ndarray = field(default_factory=lambda: np.zeros(6))
    expansion: np.ndarray = field(default_factory=lambda: np.zeros(6))
    map_knots: np.ndarray = field(default_factory=lambda: np.zeros(0))
    map_values: np.ndarray = field(default_factory=lambda: np.zeros((6, 0)))

    def __post_init__(self) -> None:
        for entry in fields(self):
            array = np.array(getattr(self, entry.name), dtype=float)
            if not np.isfinite(array).all():
                raise ModelError(f"struts.{entry.name}", "must be finite", array.tolist())
            if not entry.name.startswith("map_") and array.shape != (6,):
                raise ModelError(f"struts.{entry.name}", f"must have shape (6,), not {array.shape}")
            array.flags.writeable = False
            object.__setattr__(self, entry.name, array)
        if (self.backlash < 0.0).any():
            raise ModelError("struts.backlash", "must not be negative", self.backlash.tolist())
        if (self.period <= 0.0).any():
            raise ModelError("struts.period", "must be above zero", self.period.tolist())
        self._check_map()
        slope = self._steepest()
        if slope.max() > STEEPEST_ERROR:
            index = int(slope.argmax())
            problem = f"strut error changes by {slope[index]:.3g} m per m, allowed {STEEPEST_ERROR}"
            raise ModelError(f"struts[{index}]", problem)

    def _check_map(self) -> None:
        knots = self.map_knots
        if knots.ndim != 1 or self.map_values.shape != (6, len(knots)):
            problem = f"must have shape (6, {knots.size}), one value per knot, not {self.map_values.shape}"
            raise ModelError("struts.map_values", problem)
        if len(knots) == 1 or (np.diff(knots) <= 0.0).any():
            raise ModelError("struts.map_knots", "needs at least two increasing lengths", knots.tolist())

    def _steepest(self) -> np.ndarray:
        """Return a bound of |dL/dc − 1| per strut."""
        waves = 2.0 * np.pi / self.period * np.hypot(self.cosine, self.sine)
        steep = np.abs(self.pitch) + waves
        if len(self.map_knots):
            spline = CubicSpline(self.map_knots, self.map_values, axis=1, bc_type="natural").derivative()
            dense = np.linspace(self.map_knots[0], self.map_knots[-1], 20 * len(self.map_knots))
            steep = steep + np.abs(spline(dense)).max(axis=1)
        return steep

    def spline_coefficients(self) -> np.ndarray:
        """Return the map's cubic pieces, shape (6, n − 1, 4), highest power first, about each left knot."""
        if not len(self.map_knots):
            return np.zeros((6, 0, 4))
        spline = CubicSpline(self.map_knots, self.map_values, axis=1, bc_type="natural")
        return np.ascontiguousarray(np.transpose(spline.c, (2, 1, 0)))

    def parameter_table(self, geometry: HexapodGeometry, growth: np.ndarray) -> np.ndarray:
        """Return the kernels' table, shape (6, PARAMETERS), for a thermal growth (6,) of the struts."""
        table = np.zeros((6, PARAMETERS))
        table[:, OFFSET], table[:, PITCH], table[:, REFERENCE] = self.offset, self.pitch, self.reference_length
        table[:, COSINE], table[:, SINE] = self.cosine, self.sine
        table[:, WAVENUMBER] = 2.0 * np.pi / self.period
        table[:, BACKLASH] = self.backlash
        table[:, LEAD] = geometry.screw_lead
        table[:, TWIST_HOME] = home_twists(geometry)
        table[:, GROWTH] = growth
        return table


def home_twists(geometry: HexapodGeometry) -> np.ndarray:
    """Return the screw rotation of each strut at home, rad, shape (6,): the zero of the correction."""
    if not geometry.screw_lead.any():
        return np.zeros(6)
    position, rotation = geometry.home.position, geometry.home.rotation
    base, platform = geometry.kernel_joints
    axes = geometry.kernel_axes
    return np.array([screw_twist(base, platform, *axes, position, rotation, i) for i in range(6)])


@compiled
def screw_twist(base, platform, base_axes, platform_axes, position, rotation, i):
    """Return the angle about strut `i` from the base's cardan axis to the platform's, rad.

    Both axes are seen along the strut, i.e. projected perpendicular to it. Where the angle stays within
    ±90°, its sine is the one in LinuxCNC's genhexkins.
    """
    sx, sy, sz = strut_vector(base, platform, position, rotation, i)
    length = math.sqrt(sx * sx + sy * sy + sz * sz)
    ux, uy, uz = sx / length, sy / length, sz / length
    bx, by, bz = base_axes[i, 0], base_axes[i, 1], base_axes[i, 2]
    ax, ay, az = platform_axes[i, 0], platform_axes[i, 1], platform_axes[i, 2]
    px = rotation[0, 0] * ax + rotation[0, 1] * ay + rotation[0, 2] * az
    py = rotation[1, 0] * ax + rotation[1, 1] * ay + rotation[1, 2] * az
    pz = rotation[2, 0] * ax + rotation[2, 1] * ay + rotation[2, 2] * az
    sine = bx * (py * uz - pz * uy) + by * (pz * ux - px * uz) + bz * (px * uy - py * ux)
    cosine = bx * px + by * py + bz * pz - (bx * ux + by * uy + bz * uz) * (px * ux + py * uy + pz * uz)
    return math.atan2(sine, cosine)


@compiled
def screw_shift(base, platform, base_axes, platform_axes, position, rotation, table, i):
    """Return −l·θ/2π: how much longer the command of strut `i` must be for its screw's rotation, m.

    A platform that turns by θ about the strut turns the screw in its nut. A right-hand screw then advances
    by l·θ/2π by itself, wherever its nut sits, and the command must be shorter by as much.
    """
    lead = table[i, LEAD]
    if lead == 0.0:
        return 0.0
    twist = screw_twist(base, platform, base_axes, platform_axes, position, rotation, i)
    turns = (twist - table[i, TWIST_HOME]) / (2.0 * math.pi)
    return -lead * (turns - math.floor(turns + 0.5))


@compiled
def smooth_error(command, table, knots, pieces, i):
    """Return (error, slope) of the part that depends on the command alone: offset, pitch, waves, map."""
    k = table[i, WAVENUMBER]
    error = table[i, OFFSET] + table[i, PITCH] * (command - table[i, REFERENCE])
    slope = table[i, PITCH]
    if table[i, COSINE] != 0.0 or table[i, SINE] != 0.0:
        c, s = math.cos(k * command), math.sin(k * command)
        error += table[i, COSINE] * c + table[i, SINE] * s
        slope += k * (table[i, SINE] * c - table[i, COSINE] * s)
    last = knots.shape[0] - 1
    if last > 0:
        held = min(knots[last], max(knots[0], command))
        piece = min(np.searchsorted(knots, held, side="right") - 1, last - 1)
        x = held - knots[piece]
        a, b, c3, d = pieces[i, piece, 0], pieces[i, piece, 1], pieces[i, piece, 2], pieces[i, piece, 3]
        error += ((a * x + b) * x + c3) * x + d
        if held == command:
            slope += (3.0 * a * x + 2.0 * b) * x + c3
    return error, slope


@compiled
def actual_length(command, sense, shift, table, knots, pieces, i):
    """Return the real length of strut `i` for a command, m; `sense` is its direction of motion, −1…1."""
    error, _ = smooth_error(command, table, knots, pieces, i)
    return (1.0 + table[i, GROWTH]) * (command + error - 0.5 * sense * table[i, BACKLASH] - shift)


@compiled
def command_for_length(length, sense, shift, table, knots, pieces, i):
    """Return the command that gives strut `i` a real length, m: the inverse of :func:`actual_length`."""
    wanted = length / (1.0 + table[i, GROWTH]) + 0.5 * sense * table[i, BACKLASH] + shift
    command = wanted
    for _ in range(8):
        error, slope = smooth_error(command, table, knots, pieces, i)
        step = (wanted - command - error) / (1.0 + slope)
        command += step
        if abs(step) < 1e-9:  # Newton squares it: the rest is below rounding
            break
    return command
