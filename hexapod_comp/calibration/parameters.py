"""The parameters of a joint calibration: which there are, how large they may be, what machine they make.

Parameters come in blocks. Each block has a prior: zero mean and a covariance of known shape whose size, the
block's *tolerance*, is estimated with the rest. The prior fixes what the data cannot see (the gauge) at the
nominal machine and keeps the smooth blocks smooth; where the data speak it is far too weak to be heard.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.interpolate import CubicSpline

from ..errors import CalibrationError, ModelError
from ..machine.field import GridField, no_field
from ..machine.geometry import STRUT_NAMES, HexapodGeometry, first_of_same
from ..machine.kinematics import Structure, strut_lengths
from ..machine.late import PARTS, LateGrowth
from ..machine.model import MachineModel
from ..machine.region import Region
from ..machine.struts import StrutErrors
from ..machine.temperatures import REFERENCE_HUMIDITY, REFERENCE_TEMPERATURE
from ..measurements.readings import AXES, MeasurementSet, Stations, spans
from .smooth_field import COMPONENT_UNITS, SmoothField, map_knots, map_root, wear_knots

MOST_BEYOND = 0.05
"""Encoders may read this far beyond the stroke, m: their zeros are not the geometry's."""

LARGEST_EXPANSION, LARGEST_MOISTURE = 100e-6, 1e-2
"""No machine is built of anything that grows more, 1/K, or from dry air to damp, m/m."""

LEAST_WARMING = 0.5
"""Temperatures that change by less, K, show no expansion: 3 µm on half a metre of steel, a sensor's drift included."""

LEAST_DAMPING = 0.1
"""Humidity that changes by less shows no swelling: 5 µm on half a metre of carbon fibre of 1 ppm per %."""

STRUTS_ALIKE, STRUTS_WARMED_ALIKE = 0.998, 0.9
"""Correlation of the struts' expansions by their own thermometers, of one material; and by another part's, late or not,
since they may be loaded and cooled differently."""

TOLERANCES = {
    "structure": 100e-6,
    "pitch": 100e-6,
    "wave": 5e-6,
    "wave 2": 1e-6,
    "wave 3": 1e-6,
    "wave 4": 1e-6,
    "backlash": 5e-6,
    "map": 5e-6,
    "backlash map": 2e-6,
    "field displacement": 5e-6,
    "field rotation": 20e-6,
    "field reversal": 1e-6,
    "expansion": 10e-6,
    "moisture": 1e-4,
    "late": 10e-6,
}
"""First guess of the blocks' standard deviations, m, m/m, rad or 1/K; the fit goes on from there."""

BLOCKS = tuple(TOLERANCES)

WAVES = {"wave": 1, "wave 2": 2, "wave 3": 3, "wave 4": 4}
"""Blocks of the screw waves, and how often a turn each repeats."""

SHORTEST_LEAD, LONGEST_LEAD = 0.1e-3, 1.0
"""Leads that a screw can have, m; below them no measuring line could show a period."""


@dataclass(frozen=True)
class FitSettings:
    """What a joint fit is told besides the measurements.

    Parameters
    ----------
    blocks : tuple of str
        Blocks that may be used, of :data:`BLOCKS`; the structure belongs to every fit.
    shared_platform_joints : bool
        Platform joints that coincide nominally are one ball joint: the paper's machine then has 33 structure
        parameters instead of 42.
    lead : float or None
        Period of the screws' errors, m; None: the geometry's leads; where there are none, what the readings show, and
        no wave block when they do not.
    field_degree : int
        Degree of the field's polynomials along the longest side of its box.
    strut_expansion, base_expansion, platform_expansion : float
        Thermal expansion as stated, 1/K: where readings were taken while temperatures changed, the fit starts from it.
    strut_moisture : float or None
        Growth of the struts by relative humidity, m/m from 0 to 1: as `strut_expansion`; None: they do not swell.
    thermometer : str
        The part whose sensor stands for all; empty: the one that has readings of its own, if only one has.
    time_constants : tuple of float or None
        How late parts follow their thermometers, s; None: sought from the readings.
    tolerances : dict
        Standard deviations to start from, by block.
    robust : bool
        Give readings that disagree with the rest less weight.
    scale, alignment : float or None
        Standard deviations of what no reading shows: of the instruments' scale, m/m, and of the angle between a laser's
        beam and its line, rad. None: of their class (:func:`~hexapod_comp.calibration.misfit.stated_scale`).
    """

    blocks: tuple[str, ...] = BLOCKS
    shared_platform_joints: bool = True
    lead: float | None = None
    field_degree: int = 6
    strut_expansion: float = 0.0
    base_expansion: float = 0.0
    platform_expansion: float = 0.0
    strut_moisture: float | None = None
    thermometer: str = ""
    time_constants: tuple[float, ...] | None = None
    tolerances: tuple[tuple[str, float], ...] = tuple(TOLERANCES.items())
    robust: bool = True
    scale: float | None = None
    alignment: float | None = None

    def __post_init__(self) -> None:
        unknown = set(self.blocks) - set(BLOCKS)
        if unknown:
            raise ModelError("blocks", f"must be of {', '.join(BLOCKS)}", sorted(unknown))
        if self.lead is not None and not SHORTEST_LEAD <= self.lead <= LONGEST_LEAD:
            allowed = f"{SHORTEST_LEAD * 1e3:g} mm to {LONGEST_LEAD * 1e3:g} mm"
            raise ModelError("lead", f"must be {allowed}", self.lead * 1e3)
        for name, value in self.tolerances:
            if not 0.0 < value < np.inf:
                raise ModelError(f"tolerance of {name}", "must be finite and above zero", value)
        growths = {f"{body}_expansion": (LARGEST_EXPANSION, 1e6, "ppm/K") for body in ("strut", "base", "platform")}
        growths["strut_moisture"] = LARGEST_MOISTURE, 1e4, "ppm per % of relative humidity"
        for name, (largest, factor, unit) in growths.items():
            value = getattr(self, name) or 0.0
            if not 0.0 <= value <= largest:
                raise ModelError(name.replace("_", " "), f"must be 0…{largest * factor:g} {unit}", value * factor)
        constants = self.time_constants or ()
        LateGrowth(tuple(constants), np.zeros((len(PARTS), len(constants))), self.thermometer)  # refuses what cannot be
        for name, given, most, unit in (("scale", self.scale, 1e-2, "m/m"), ("alignment", self.alignment, 0.1, "rad")):
            if given is not None and not 0.0 <= given <= most:
                raise ModelError(name, f"must be 0…{most:g} {unit}", given)
        if not 1 <= self.field_degree <= 8:
            raise ModelError("field_degree", "must be 1…8", self.field_degree)


@dataclass(frozen=True)
class Extent:
    """What was measured, as far as parameters depend on it: all that is left of readings once they are fitted.

    Attributes
    ----------
    commands : ndarray, shape (2,)
        Lowest and highest strut command, m.
    box : ndarray, shape (2, 3)
        Lowest and highest commanded place of the measured point, m in ``base``: where the field is.
    work_box : ndarray, shape (2, 3)
        The same, m in the work frame, in which campaigns are boxes: where the model holds.
    level : ndarray, shape (3, 3)
        Attitude of the platform, in ``base``, with a level tool (:meth:`MeasurementSet.level`).
    probe : ndarray, shape (3,)
        The measured point in ``platform``, m.
    """

    commands: np.ndarray
    box: np.ndarray
    work_box: np.ndarray
    level: np.ndarray
    probe: np.ndarray

    @staticmethod
    def of(measurements: MeasurementSet) -> Extent:
        """Return where a set was measured."""
        commands, points, work = measurements.stations.commands, measurements.points(), measurements.geometry.work
        _check_commands(measurements.geometry, commands)
        in_work = (points - work.position) @ work.rotation
        return Extent(
            commands=np.array([commands.min(), commands.max()]),
            box=np.array([points.min(axis=0), points.max(axis=0)]),
            work_box=np.array([in_work.min(axis=0), in_work.max(axis=0)]),
            level=measurements.level(),
            probe=measurements.probe,
        )


@dataclass(frozen=True)
class Block:
    """A block of parameters x = root · y; the prior of every y is N(0, tolerance²).

    Attributes
    ----------
    name : str
        One of :data:`BLOCKS`.
    part : slice
        Where it stands in the parameter vector.
    root : ndarray, shape (n, n)
        Root of the prior's correlation.
    labels : tuple of str
        Names of the parameters.
    unit : str
        SI unit of the parameters.
    """

    name: str
    part: slice
    root: np.ndarray
    labels: tuple[str, ...]
    unit: str


class ParameterSpace:
    """All parameters of a joint fit, in SI, and the machine that a vector of them makes.

    Parameters
    ----------
    measurements : MeasurementSet or (HexapodGeometry, Extent)
        Tells which commands the length map, and which box the field must cover.
    settings : FitSettings
        Which blocks.

    Attributes
    ----------
    region : Extent
        What was measured; its boxes, ``level`` and ``probe`` are here too.
    blocks : tuple of Block
        In the order of the vector.
    size : int
        Length of the vector.
    platform_groups : ndarray of int, shape (6,)
        Which ball joint each strut ends in.
    periods : ndarray, shape (6,)
        Screw wave period, m.
    knots : dict of ndarray, shape (n,)
        Commands of the knots of the length map and of the backlash map, m.
    field : SmoothField
        The field's basis.
    """

    def __init__(self, measurements: MeasurementSet | tuple[HexapodGeometry, Extent], settings: FitSettings) -> None:
        if isinstance(measurements, MeasurementSet):
            settings = as_warmed(settings, measurements.stations)
            measurements = measurements.geometry, Extent.of(measurements)
        self.geometry, self.region = geometry, region = measurements
        self.settings = settings
        self.home_lengths = strut_lengths(Structure.of(geometry), geometry.home)
        self.platform_groups = _groups(geometry, settings.shared_platform_joints)
        self.periods = _periods(geometry, settings.lead)
        knots = map_knots(*region.commands)
        self.knots = {"map": knots, "backlash map": wear_knots(knots)}
        self.box, self.work_box = region.box, region.work_box
        self.level, self.probe = region.level, region.probe
        self.field = SmoothField(self.box, settings.field_degree)
        self.blocks = tuple(self._make_blocks())
        self.size = self.blocks[-1].part.stop
        self._cardinal = {n: CubicSpline(k, np.eye(len(k)), bc_type="natural") for n, k in self.knots.items()}

    def places(self, in_work: np.ndarray) -> np.ndarray:
        """Return points (n, 3) of the work frame in ``base``, m."""
        work = self.geometry.work
        return work.position + in_work @ work.rotation.T

    @property
    def measured(self) -> Region | None:
        """Where a model of these parameters holds; None where no box was measured."""
        return Region.of(self.work_box, self.probe, self.geometry.work) if spans(self.work_box) else None

    def _make_blocks(self) -> list[Block]:
        names = [name for name in BLOCKS if self._has(name)]
        blocks, start = [], 0
        for name in names:
            root, labels, unit = self._describe(name)
            blocks.append(Block(name, slice(start, start + len(labels)), root, labels, unit))
            start += len(labels)
        return blocks

    def _has(self, name: str) -> bool:
        if name == "structure":
            return True
        if name in WAVES and not np.isfinite(self.periods).all():
            return False
        if (name == "late" and not self.settings.time_constants) or (name == "moisture" and not self.swells):
            return False
        return name in self.settings.blocks

    def _describe(self, name: str) -> tuple[np.ndarray, tuple[str, ...], str]:
        """Return root, labels and unit of a block."""
        if name == "structure":
            labels = [f"base {i + 1} {a}" for i in range(6) for a in AXES]
            labels += [f"platform {g + 1} {a}" for g in range(self.platform_groups.max() + 1) for a in AXES]
            labels += [f"{s} offset" for s in STRUT_NAMES]
            return np.eye(len(labels)), tuple(labels), "m"
        if name in WAVES:
            labels = [f"{s} {name} {part}" for s in STRUT_NAMES for part in ("cosine", "sine")]
            return np.eye(12), tuple(labels), "m"
        if name in self.knots:
            root = np.kron(np.eye(6), map_root(self.knots[name]))
            labels = [f"{s} {name} at {1e3 * k:.0f} mm" for s in STRUT_NAMES for k in self.knots[name]]
            return root, tuple(labels), "m"
        if name == "field reversal":
            terms = self.field.reversal_terms
            labels = [f"{c} {t} reversal {a}" for a in AXES for c, _ in COMPONENT_UNITS for t in terms]
            return np.diag(np.tile(self.field.reversal_prior, 18)), tuple(labels), "m, rad"
        if name.startswith("field"):
            which = 0 if name.endswith("displacement") else 3
            terms = self.field.terms
            labels = [f"{COMPONENT_UNITS[which + c][0]} {t}" for c in range(3) for t in terms]
            return np.diag(np.tile(self.field.prior, 3)), tuple(labels), "m" if which == 0 else "rad"
        if name == "expansion":
            alike = STRUTS_WARMED_ALIKE if self.settings.thermometer else STRUTS_ALIKE
            return growth_root(1, alike), tuple(f"{part} expansion beyond the stated" for part in PARTS), "1/K"
        if name == "late":
            constants = self.settings.time_constants or ()
            labels = [f"{part} late by {constant:.0f} s" for part in PARTS for constant in constants]
            return growth_root(len(constants)), tuple(labels), "1/K"
        if name == "moisture":
            return np.eye(1), ("moisture of the struts beyond the stated",), "1"
        labels = [f"{s} {name}" for s in STRUT_NAMES]
        return np.eye(6), tuple(labels), "m/m" if name == "pitch" else "m"

    @property
    def offsets(self) -> slice:
        """Where the struts' offsets stand; they move the tool as any error of length does."""
        end = self.blocks[0].part.stop
        return slice(end - 6, end)

    @property
    def labels(self) -> tuple[str, ...]:
        """Names of all parameters."""
        return tuple(label for block in self.blocks for label in block.labels)

    def block(self, name: str) -> Block | None:
        """Return a block by name, None when this fit has none."""
        return next((b for b in self.blocks if b.name == name), None)

    def start_tolerances(self) -> np.ndarray:
        """Return the blocks' first tolerances, shape (number of blocks,)."""
        known = dict(self.settings.tolerances)
        return np.array([known.get(b.name, TOLERANCES[b.name]) for b in self.blocks])

    def spread(self, tolerances: np.ndarray) -> np.ndarray:
        """Return each parameter's tolerance from its block's, shape (size,)."""
        return np.repeat(tolerances, [len(b.labels) for b in self.blocks])

    def whitened(self, rows: np.ndarray) -> np.ndarray:
        """Return derivatives (n, size) by x as derivatives by y, with x = root·y block by block."""
        result = np.empty_like(rows)
        for block in self.blocks:
            part, sizes = rows[:, block.part], np.diag(block.root)
            diagonal = np.count_nonzero(block.root) == np.count_nonzero(sizes)
            result[:, block.part] = part * sizes if diagonal else part @ block.root
        return result

    def unwhitened(self, rows: np.ndarray) -> np.ndarray:
        """Return derivatives (n, size) by y as derivatives by x: undoes :meth:`whitened`."""
        return np.hstack([np.linalg.solve(b.root.T, rows[:, b.part].T).T for b in self.blocks])

    def physical(self, y: np.ndarray) -> np.ndarray:
        """Return x = root·y for y of shape (size, …)."""
        return np.concatenate([b.root @ y[b.part] for b in self.blocks])

    def whitened_parameters(self, x: np.ndarray) -> np.ndarray:
        """Return y of x = root·y: undoes :meth:`physical`."""
        return np.concatenate([np.linalg.solve(b.root, x[b.part]) for b in self.blocks])

    def prior_covariance(self, tolerances: np.ndarray) -> np.ndarray:
        """Return the prior's covariance of x, shape (size, size), SI."""
        return self.physical(self.physical(np.diag(self.spread(tolerances) ** 2)).T)

    def spline_weights(self, commands: np.ndarray, name: str = "map") -> np.ndarray:
        """Return what each value at a map's knots adds at some commands (n,), shape (n, knots)."""
        return self._cardinal[name](np.clip(commands, *self.knots[name][[0, -1]]))

    def model(self, x: np.ndarray, name: str = "joint calibration", with_field: bool = True) -> MachineModel:
        """Return the machine that a parameter vector means.

        Negative backlash, which noise can make of a small one, is taken as none; the fit has by then
        refused what is more than noise.

        Parameters
        ----------
        x : ndarray, shape (size,)
            Parameters, SI.
        name : str
            Name of the model.
        with_field : bool
            False leaves the field out: the fit adds it from its own basis.
        """
        joints, offset = np.split(self._values(x, "structure"), [-6])
        structure = joints.reshape(-1, 3)
        waves = np.stack([self._values(x, name, 12).reshape(6, 2) for name in WAVES], axis=1)
        lengths, backlash = (self._values(x, name, 6 * len(k)).reshape(6, -1) for name, k in self.knots.items())
        knots = self.knots["map"] if lengths.any() or backlash.any() else np.zeros(0)
        expansion = self.stated_expansion + self._values(x, "expansion", len(PARTS))
        struts = StrutErrors(
            offset=offset,
            pitch=self._values(x, "pitch", 6),
            reference_length=self.home_lengths,
            cosine=waves[..., 0],
            sine=waves[..., 1],
            period=np.where(np.isfinite(self.periods), self.periods, 0.01),
            backlash=np.maximum(self._values(x, "backlash", 6), 0.0),
            expansion=expansion[:6],
            moisture=np.full(6, (self.settings.strut_moisture or 0.0) + self._values(x, "moisture", 1)[0]),
            map_knots=knots,
            map_values=lengths[:, : len(knots)],
            map_backlash=backlash @ self.spline_weights(knots, "backlash map").T,
        )
        return MachineModel(
            machine=self.geometry.name,
            name=name,
            base_deviation=structure[:6],
            platform_deviation=structure[6:][self.platform_groups],
            struts=struts,
            field=self._grid_field(x) if with_field else no_field(),
            base_expansion=float(expansion[6]),
            platform_expansion=float(expansion[7]),
            late_growth=self._late_growth(x, bool(expansion.any())),
            region=self.measured,
        )

    @property
    def swells(self) -> bool:
        """Whether humidity acts on the struts."""
        return self.settings.strut_moisture is not None

    @property
    def stated_expansion(self) -> np.ndarray:
        """Expansion of struts 1–6, base and platform as stated, 1/K."""
        s = self.settings
        return np.array([*[s.strut_expansion] * 6, s.base_expansion, s.platform_expansion])

    def _late_growth(self, x: np.ndarray, grows: bool) -> LateGrowth:
        values = self._values(x, "late").reshape(len(PARTS), -1)
        constants = (self.settings.time_constants or ()) if values.size else ()
        return LateGrowth(tuple(constants), values, self.settings.thermometer if grows or constants else "")

    def field_coefficients(self, x: np.ndarray) -> np.ndarray:
        """Return the field's coefficients, shape (6, terms), m and rad."""
        count = 3 * len(self.field.terms)
        parts = [self._values(x, f"field {kind}", count) for kind in ("displacement", "rotation")]
        return np.concatenate(parts).reshape(6, -1)

    def field_reversal(self, x: np.ndarray) -> np.ndarray:
        """Return the field's forward minus backward, shape (3, 6, reversal terms), m and rad."""
        count = len(self.field.reversal_terms)
        return self._values(x, "field reversal", 18 * count).reshape(3, 6, count)

    def field_errors(self, x: np.ndarray, points: np.ndarray, sense: np.ndarray) -> np.ndarray:
        """Return the field at points (n, 3), m, passed in directions (n, 3), shape (n, 6), m and rad."""
        return self.field.evaluate(self.field_coefficients(x), self.field_reversal(x), points, sense)

    def _grid_field(self, x: np.ndarray) -> GridField:
        coefficients, reversal = self.field_coefficients(x), self.field_reversal(x)
        if not (coefficients.any() or reversal.any()):
            return no_field()
        return replace(self.field.as_grid(coefficients, reversal), probe=self.probe)

    def _values(self, x: np.ndarray, name: str, missing: int = 0) -> np.ndarray:
        """Return the parameters of a block, zeros where there is none."""
        block = self.block(name)
        return x[block.part] if block is not None else np.zeros(missing)


def as_warmed(settings: FitSettings, stations: Stations) -> FitSettings:
    """Return settings for some stations: the thermometer that they had; no growth that they did not show."""
    temperatures = stations.temperatures
    seen = np.flatnonzero((temperatures != REFERENCE_TEMPERATURE).any(axis=0))
    thermometer = settings.thermometer or (PARTS[seen[0]] if len(seen) == 1 else "")
    seen = np.array([PARTS.index(thermometer)]) if thermometer else np.arange(len(PARTS))
    warmed = bool(np.ptp(temperatures[:, seen], axis=0).max() >= LEAST_WARMING)
    damped = bool(np.ptp(np.nan_to_num(stations.humidity, nan=REFERENCE_HUMIDITY)) >= LEAST_DAMPING)
    timed = bool(np.isfinite(stations.times).all())
    fits = {"expansion": warmed, "moisture": damped, "late": warmed and timed}
    blocks = tuple(name for name in settings.blocks if fits.get(name, True))
    return replace(settings, thermometer=thermometer, blocks=blocks)


def growth_root(terms: int, struts: float = STRUTS_WARMED_ALIKE) -> np.ndarray:
    """Return the root of the prior's correlation between the parts' growth, shape (8·terms, 8·terms)."""
    alike = np.eye(len(PARTS))
    alike[:6, :6] += struts * (1.0 - np.eye(6))
    return np.kron(np.linalg.cholesky(alike), np.eye(terms))


def _groups(geometry: HexapodGeometry, shared: bool) -> np.ndarray:
    """Return which ball joint of the platform each strut ends in, numbered in order, shape (6,)."""
    if not shared:
        return np.arange(6)
    return np.unique(first_of_same(geometry.platform_joints), return_inverse=True)[1]


def _periods(geometry: HexapodGeometry, lead: float | None) -> np.ndarray:
    """Return the periods of the screws' errors, m; NaN where the screw is not known."""
    if lead is not None:
        return np.full(6, lead)
    return np.where(geometry.screw_lead != 0.0, np.abs(geometry.screw_lead), np.nan)


def _check_commands(geometry: HexapodGeometry, commands: np.ndarray) -> None:
    """Refuse strut readings that are no lengths of this machine's struts."""
    low, high = geometry.limits.stroke.min() - MOST_BEYOND, geometry.limits.stroke.max() + MOST_BEYOND
    if not (low <= commands.min() and commands.max() <= high):
        span = f"{commands.min():.4g}…{commands.max():.4g} m"
        problem = f"run over {span}, the struts over {low:.4g}…{high:.4g} m; do units fit?"
        raise CalibrationError("strut readings", problem)
