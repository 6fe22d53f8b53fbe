"""The parameters of a joint fit, in blocks, and its settings.

Each block has a prior N(0, tolerance² · known correlation), whose tolerance the fit estimates. If readings do not
determine a combination of parameters, the prior keeps it near nominal. Priors also keep functions of position smooth.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from ..core import MOST_HARMONICS
from ..errors import CalibrationError, ModelError
from ..machine.arrays import different_rows
from ..machine.geometry import HexapodGeometry, first_of_same
from ..machine.kinematics import Structure, strut_lengths
from ..machine.load import MOST_LOADS, Load
from ..machine.model import MachineModel
from ..machine.region import Region
from ..machine.struts import StrutErrors
from ..machine.temperatures import PARTS, LateGrowth
from ..measurements.readings import MeasurementSet, spans
from .blocks import ERRORS, Block
from .blocks.block import Draft, Facts
from .blocks.field import SmoothField
from .blocks.growth import used_thermometer
from .blocks.load import stated_load

LEADS = 0.1e-3, 1.0  # smallest and largest allowed lead of a screw, m
# Largest expansion, 1/K (three times zinc's), and growth from 0 to 100 % humidity, m/m (more than wood's)
LARGEST_EXPANSION, LARGEST_MOISTURE = 100e-6, 1e-2
BEYOND_STROKE = 50e-3  # strut readings may exceed the stroke by this, m, because encoders have their own zeros

TOLERANCES = {block.name: block.tolerance for block in ERRORS}
"""First guess of the prior standard deviation of each block's parameters, in the block's unit."""

BLOCKS = tuple(TOLERANCES)


@dataclass(frozen=True)
class FitSettings:
    """Inputs of a joint fit besides the measurements.

    Parameters
    ----------
    blocks : tuple of str
        Blocks that the fit may use, from :data:`BLOCKS`; the structure belongs to every fit.
    shared_platform_joints : bool
        Platform joints that coincide nominally are one ball joint: the paper's machine then has 33 structure
        parameters instead of 42.
    lead : float or None
        Period of the screws' errors, m. None: the lead of the geometry; if the geometry states none, the lead detected
        in the readings; if none is detected, the fit has no wave block.
    field_degree : int
        Degree of the error field's polynomials along the longest side of its box.
    strut_expansion, base_expansion, platform_expansion : float
        Stated thermal expansion, 1/K. The fit estimates deviations from the stated value if temperatures changed by
        0.5 K or more.
    strut_moisture : float or None
        Stated growth of the struts from 0 to 100 % relative humidity, m/m; the fit estimates the deviation as for
        `strut_expansion`. None: the struts do not swell.
    thermometer : str
        Part whose thermometer is used for all parts. Empty: if only one part has readings of a
        thermometer, these are used for all parts; otherwise each part's own are used.
    time_constants : tuple of float or None
        Delays with which parts follow their thermometers, s; None: estimated from the readings.
    load : tuple of float
        Stated behaviour of elastic struts under weight (:meth:`hexapod_comp.machine.load.Load.numbers`); empty: the
        struts are rigid. The fit estimates by how much the struts differ from these values if the
        readings were taken under several loads.
    tolerances : tuple of (str, float)
        First guess of the prior standard deviation of a block's parameters, if it differs from :data:`TOLERANCES`.
    robust : bool
        Reduce the weight of outliers (Huber).
    tracker_frame : str
        ``free``: the tracker's frame is unknown, and differs in each run. ``known``: the tracker's frame is the work
        frame, so the readings determine the datum of the machine.
    scale, alignment : float or None
        Standard deviations of errors that no reading shows: the instruments' scale, m/m, and the angle between a
        laser's beam and its line, rad. None: the usual value for the instruments' class
        (:func:`~hexapod_comp.calibration.trust.stated_scale`).
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
    load: tuple[float, ...] = ()
    tolerances: tuple[tuple[str, float], ...] = ()
    robust: bool = True
    scale: float | None = None
    alignment: float | None = None
    tracker_frame: str = "free"

    def __post_init__(self) -> None:
        unknown = set(self.blocks) - set(BLOCKS)
        if unknown:
            raise ModelError("blocks", f"must be of {', '.join(BLOCKS)}", sorted(unknown))
        if self.lead is not None and not LEADS[0] <= self.lead <= LEADS[1]:
            raise ModelError("lead", f"must be {LEADS[0] * 1e3:g} mm to {LEADS[1] * 1e3:g} mm", self.lead * 1e3)
        for name, value in self.tolerances:
            if name not in BLOCKS:
                raise ModelError("tolerances", f"must be of {', '.join(BLOCKS)}", name)
            if not 0.0 < value < np.inf:
                raise ModelError(f"tolerance of {name}", "must be finite and above zero", value)
        growths = {f"{body}_expansion": (LARGEST_EXPANSION, 1e6, "ppm/K") for body in ("strut", "base", "platform")}
        growths["strut_moisture"] = LARGEST_MOISTURE, 1e4, "ppm per % of relative humidity"
        for name, (largest, factor, unit) in growths.items():
            value = getattr(self, name) or 0.0
            if not abs(value) <= largest:  # carbon fibre shrinks when it becomes warmer
                raise ModelError(name.replace("_", " "), f"must be within ±{largest * factor:g} {unit}", value * factor)
        if self.load:
            Load.from_numbers(self.load)  # validates them
        constants = self.time_constants or ()
        LateGrowth(tuple(constants), np.zeros((len(PARTS), len(constants))), self.thermometer)  # validates them
        for name, given, most, unit in (("scale", self.scale, 1e-2, "m/m"), ("alignment", self.alignment, 0.1, "rad")):
            if given is not None and not 0.0 <= given <= most:
                raise ModelError(name, f"must be 0…{most:g} {unit}", given)
        if self.tracker_frame not in ("free", "known"):
            raise ModelError("tracker_frame", "must be free or known", self.tracker_frame)
        if not 1 <= self.field_degree <= 8:
            raise ModelError("field_degree", "must be 1…8", self.field_degree)


@dataclass(frozen=True)
class Extent:
    """The region of a measurement set: the domain of length maps and error field."""

    commands: np.ndarray  # (2,): smallest and largest strut command, m: domain of the length maps
    box: np.ndarray  # (2, 3): range of the measured point's commanded positions in base, m: domain of the field
    work_box: np.ndarray  # (2, 3): the same in the work frame: the model's measured box
    level: np.ndarray  # (3, 3): attitude of the platform in base with a level tool
    probe: np.ndarray  # (3,): the measured point in platform, m

    @staticmethod
    def of(measurements: MeasurementSet) -> Extent:
        """Return the region of readings; refuse strut readings more than BEYOND_STROKE outside the stroke."""
        commands, points, work = measurements.stations.commands, measurements.points(), measurements.geometry.work
        stroke = measurements.geometry.limits.stroke
        low, high = stroke.min() - BEYOND_STROKE, stroke.max() + BEYOND_STROKE
        if not (low <= commands.min() and commands.max() <= high):
            span = f"{commands.min():.4g}…{commands.max():.4g} m"
            problem = f"are {span}, but the struts allow {low:.4g}…{high:.4g} m; check the units"
            raise CalibrationError("strut readings", problem)
        in_work = (points - work.position) @ work.rotation
        return Extent(
            commands=np.array([commands.min(), commands.max()]),
            box=np.array([points.min(axis=0), points.max(axis=0)]),
            work_box=np.array([in_work.min(axis=0), in_work.max(axis=0)]),
            level=measurements.level(),
            probe=measurements.probe,
        )


class Components(NamedTuple):
    """Blocks of independent parameters with the prior N(0, tolerance²), for :func:`~.estimator.solve`."""

    parts: tuple[slice, ...]  # indices of each block's parameters
    first: np.ndarray  # (blocks,): first guess of the tolerances
    stated: tuple[bool, ...]  # of each block: the tolerance stays at its first guess

    def start_tolerances(self) -> np.ndarray:
        return self.first

    def spread(self, tolerances: np.ndarray) -> np.ndarray:
        """Return the prior σ of each of the parameters: the tolerance of its block."""
        return np.repeat(tolerances, [part.stop - part.start for part in self.parts])


def distinct_loads(measurements: MeasurementSet) -> np.ndarray:
    """Return the first MOST_LOADS distinct rows (n, 7) of the readings' :attr:`.Surroundings.loads`."""
    loads = measurements.stations.loads
    return loads[np.sort(different_rows(np.nan_to_num(loads))[0])[:MOST_LOADS]]


class ParameterSpace:
    """The parameters x (size,) of a joint fit, SI, in blocks x = root·y of independent y; makes machine models from x.

    `loads` (n, 7) are the distinct :attr:`.Surroundings.loads` of the readings; NaN if there are no readings.
    """

    def __init__(self, measurements: MeasurementSet | tuple[HexapodGeometry, Extent], settings: FitSettings) -> None:
        self.loads = np.full((1, 7), np.nan)
        if isinstance(measurements, MeasurementSet):
            stations = measurements.stations
            shown = {error.name for error in ERRORS if error.shown(settings, measurements.geometry, stations)}
            blocks = tuple(name for name in settings.blocks if name in shown)
            settings = replace(settings, thermometer=used_thermometer(settings, stations), blocks=blocks)
            self.loads = distinct_loads(measurements)
            measurements = measurements.geometry, Extent.of(measurements)
        self.geometry, self.region = geometry, region = measurements
        self.settings = settings
        self.box, self.work_box, self.level, self.probe = region.box, region.work_box, region.level, region.probe
        self.home_lengths = strut_lengths(Structure.of(geometry), geometry.home)
        shared = np.unique(first_of_same(geometry.platform_joints), return_inverse=True)[1]
        self.platform_groups = shared if settings.shared_platform_joints else np.arange(6)
        led = np.where(geometry.screw_lead != 0.0, np.abs(geometry.screw_lead), np.nan)
        self.periods = led if settings.lead is None else np.full(6, settings.lead)
        self.field = SmoothField(region.box, settings.field_degree)
        facts = Facts(geometry, region, settings, self.home_lengths, self.platform_groups, self.periods, self.field)
        made = [error.of(facts) for error in ERRORS if error.name in ("structure", *settings.blocks)]
        self.blocks: tuple[Block, ...] = tuple(block for block in made if block is not None)
        self.size = 0
        for block in self.blocks:
            block.part = slice(self.size, self.size + len(block.labels))
            self.size = block.part.stop
        self.labels = tuple(label for block in self.blocks for label in block.labels)

    def places(self, in_work: np.ndarray) -> np.ndarray:
        """Transform points (n, 3), m, from the work frame to ``base``."""
        work = self.geometry.work
        return work.transform(in_work)

    @property
    def parts(self) -> tuple[slice, ...]:
        return tuple(block.part for block in self.blocks)

    @property
    def stated(self) -> tuple[bool, ...]:
        return tuple(block.stated for block in self.blocks)

    @property
    def measured(self) -> Region | None:
        """Box in which the readings were taken; None if the readings lie in a plane or on a line."""
        return Region.of(self.work_box, self.probe, self.geometry.work) if spans(self.work_box) else None

    @property
    def offsets(self) -> slice:
        """Indices of the six struts' offsets in the parameter vector: the last six of the structure."""
        end = self.blocks[0].part.stop
        return slice(end - 6, end)

    def block(self, name: str) -> Block | None:
        return next((b for b in self.blocks if b.name == name), None)

    def members(self, blocks: Collection[str]) -> np.ndarray:
        """Return for each of the parameters whether its block has one of these names."""
        return np.repeat([block.name in blocks for block in self.blocks], [len(b.labels) for b in self.blocks])

    def carried_over(self, old: ParameterSpace, x: np.ndarray, tolerances: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Convert `x` and `tolerances` of an `old` space to this one; parameters of blocks new in this one are 0."""
        own, sizes = np.zeros(self.size), self.start_tolerances()
        for n, block in enumerate(self.blocks):
            for m, same in enumerate(old.blocks):
                if same.name == block.name:
                    own[block.part], sizes[n] = x[same.part], tolerances[m]
        return own, sizes

    def start_tolerances(self) -> np.ndarray:
        known = dict(self.settings.tolerances)
        return np.array([known.get(b.name, b.tolerance) for b in self.blocks])

    def spread(self, tolerances: np.ndarray) -> np.ndarray:
        """Return the prior σ of y for each of the parameters: the tolerance of its block."""
        return np.repeat(tolerances, [len(b.labels) for b in self.blocks])

    def whitened(self, rows: np.ndarray) -> np.ndarray:
        """Convert derivatives (n, size) by x to derivatives by y, with x = root·y in each block."""
        return np.hstack([rows[:, b.part] @ b.root for b in self.blocks])

    def unwhitened(self, rows: np.ndarray) -> np.ndarray:
        """Convert derivatives (n, size) by y to derivatives by x, with x = root·y in each block."""
        return np.hstack([np.linalg.solve(b.root.T, rows[:, b.part].T).T for b in self.blocks])

    def physical(self, y: np.ndarray) -> np.ndarray:
        """Return the parameters x = root·y of each block for `y` (size, …)."""
        return np.concatenate([b.root @ y[b.part] for b in self.blocks])

    def whitened_parameters(self, x: np.ndarray) -> np.ndarray:
        """Return y for x = root·y."""
        return np.concatenate([np.linalg.solve(b.root, x[b.part]) for b in self.blocks])

    def prior_covariance(self, tolerances: np.ndarray) -> np.ndarray:
        """Return the prior covariance (size, size) of the parameters x, SI."""
        return self.physical(self.physical(np.diag(self.spread(tolerances) ** 2)).T)

    @property
    def swells(self) -> bool:
        return self.settings.strut_moisture is not None

    @property
    def stated_expansion(self) -> np.ndarray:
        """Stated thermal expansion (8,) of struts 1–6, base and platform, 1/K."""
        s = self.settings
        return np.array([*[s.strut_expansion] * 6, s.base_expansion, s.platform_expansion])

    def _draft(self, x: np.ndarray) -> Draft:
        """Return the draft of a model, into which each block has written its parameters."""
        waves = {part: np.zeros((6, MOST_HARMONICS)) for part in ("cosine", "sine")}
        struts = {
            "reference_length": self.home_lengths,
            "period": np.where(np.isfinite(self.periods), self.periods, 0.01),
            "moisture": np.full(6, self.settings.strut_moisture or 0.0),
        }
        draft = Draft(
            machine={},
            struts={**struts, **waves},
            growth=self.stated_expansion,
            late=np.zeros((len(PARTS), 0)),
            load=stated_load(self.settings),
            field=np.zeros((6, len(self.field.terms))),
            reversal=np.zeros((3, 6, len(self.field.reversal_terms))),
        )
        for block in self.blocks:
            block.into(draft, x[block.part])
        return draft

    def model(self, x: np.ndarray, name: str = "joint calibration", with_field: bool = True) -> MachineModel:
        draft = self._draft(x)
        machine = draft.machine
        if with_field and (draft.field.any() or draft.reversal.any()):
            machine["field"] = replace(self.field.as_grid(draft.field, draft.reversal), probe=self.probe)
        constants = (self.settings.time_constants or ()) if draft.late.size else ()
        thermometer = self.settings.thermometer if draft.growth.any() or constants else ""
        knots = draft.struts.get("map_knots", np.zeros(0))
        empty = {part: np.zeros((6, len(knots))) for part in ("map_values", "map_backlash")}
        return MachineModel(
            machine=self.geometry.name,
            name=name,
            struts=StrutErrors(**{**empty, **draft.struts, "expansion": draft.growth[:6]}),
            base_expansion=float(draft.growth[6]),
            platform_expansion=float(draft.growth[7]),
            late_growth=LateGrowth(tuple(constants), draft.late, thermometer),
            region=self.measured,
            load=draft.load,
            **machine,
        )

    def field_errors(self, x: np.ndarray, points: np.ndarray, sense: np.ndarray) -> np.ndarray:
        """Return the error field (n, 6), m and rad, at `points` (n, 3), m in base, for directions of motion (n, 3)."""
        draft = self._draft(x)
        return self.field.evaluate(draft.field, draft.reversal, points, sense)
