"""The posterior: a fit's parameters x with their covariance Σ, and the tool error e(x) = e₀ + J·δx, to first order.

Covariance of e: J·Σ·Jᵀ; mean square of e − e₀ over a box: tr(M·Σ), with M the mean of JᵀJ over the box. *Best-fit
alignment* subtracts the shift and rotation that best explain the displacements, and the mean of the rotations, as
setting a workpiece zero does.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np

from ..core import Status
from ..errors import CalibrationError
from ..formats.texts import significant
from ..machine.kinematics import Structure, strut_lengths_batch
from ..machine.model import FOLLOWED, RealMachine
from ..machine.passes import Passes, Poses, level_attitude, random_directions
from ..machine.surroundings import Surroundings
from ..measurements.readings import AXES, Stations
from ..pose import attitude_error, rotation_from_angles
from .assumptions import ASSUMED
from .blocks.block import Linkage
from .blocks.load import complete_loads, stated_load, unsettled_lengths
from .datum import HeldDatum
from .estimator import Estimation, LinearProblem, physical_covariance
from .estimator import Posterior as Estimate
from .parameters import ParameterSpace
from .promise import Unexplained
from .sensitivity import Prediction, carried, derivatives, predict

COMPONENTS = ("x", "y", "z", "rx", "ry", "rz")
"""Components of the tool error: displacement along and rotation about x, y, z of the work frame."""

POINTS, DRAWS, SEED = 300, 300, 7
"""For an expected tool error: number of random points in the box, number of parameter vectors drawn from Σ, seed."""

OTHER_MASS = 10.0
"""A fit also predicts the error of a tool that is heavier by this, kg, than the heaviest tool of its readings."""

CHUNK = 256
"""Number of poses computed at once: limits the memory for the derivatives of their tool errors."""


@dataclass(frozen=True)
class FittedParameters:
    space: ParameterSpace  # meaning of the parameters
    x: np.ndarray  # (size,), most probable parameters, SI
    covariance: np.ndarray  # (size, size), of x
    tolerances: np.ndarray  # (blocks,), prior σ of each block
    noise: np.ndarray  # (kinds,), estimated / stated σ
    held: HeldDatum | None = None  # its motion is in the model, not in x; None in old files


# The tool's error to first order


class Alignment(NamedTuple):
    """What best-fit alignment subtracts: a rigid motion from the displacements, the mean rotation from rotations."""

    centre: np.ndarray  # (3,): point about which `motion` rotates, m
    motion: np.ndarray  # (6, 1 + size): shift, m, and rotation vector, rad; then their derivatives by the parameters
    rotation: np.ndarray  # (3, 1 + size): mean rotation vector, rad; then its derivatives by the parameters


@dataclass(frozen=True)
class FirstOrder:
    """The tool's errors at N places, m and rad, and their derivatives by the parameters."""

    places: np.ndarray  # (N, 3): points at which the displacement is counted, m
    columns: np.ndarray  # (N, 6, 1 + size): displacement and rotation vector; then their derivatives
    # RMS displacement, m, and rotation, rad, due to struts at an unknown end of their clearance
    unsettled: tuple[float, float] = (0.0, 0.0)

    @staticmethod
    def of(space: ParameterSpace, prediction: Prediction, stations: Stations) -> FirstOrder:
        slopes, unsettled = derivatives(space, prediction, stations), (0.0, 0.0)
        places = stations.positions + stations.rotations @ space.probe
        if prediction.load.lost_motion.any():
            linkage = Linkage(prediction, space.probe, stations)
            squares = ((linkage.per_length * unsettled_lengths(linkage)[:, None]) ** 2).sum(axis=2).mean(axis=0)
            unsettled = math.sqrt(squares[:3].sum()), math.sqrt(squares[3:].sum())
        return FirstOrder(places, np.concatenate([prediction.errors[:, :, None], slopes], axis=2), unsettled)

    @property
    def values(self) -> np.ndarray:  # (N, 6): tool errors, m and rad
        return self.columns[:, :, 0]

    @property
    def slopes(self) -> np.ndarray:  # (N, 6, size): derivatives of the tool errors by the parameters
        return self.columns[:, :, 1:]

    def alignment(self) -> Alignment:
        """Return the rigid motion that best explains all displacements (least squares), and the mean rotation."""
        centre = self.places.mean(axis=0)
        unit = np.tile(np.eye(6), (len(self.places), 1, 1))
        explain = np.linalg.pinv(carried(unit, self.places - centre)[:, :3].reshape(-1, 6))
        motion = explain @ self.columns[:, :3].reshape(len(explain[0]), -1)
        return Alignment(centre, motion, self.columns[:, 3:].mean(axis=0))

    def aligned(self, alignment: Alignment | None = None) -> FirstOrder:
        """Subtract an alignment from the errors and their derivatives: by default their own :meth:`alignment`."""
        best = self.alignment() if alignment is None else alignment
        whole = carried(best.motion[None], self.places - best.centre)
        whole[:, 3:] = best.rotation
        return FirstOrder(self.places, self.columns - whole, self.unsettled)

    @cached_property
    def mean_squares(self) -> tuple[np.ndarray, np.ndarray]:
        """Matrices M (size, size) for displacement and rotation: δx causes the mean square tool error δxᵀ·M·δx."""
        count, size = len(self.places), self.slopes.shape[2]
        parts = (self.slopes[:, rows].reshape(-1, size) for rows in (slice(3), slice(3, 6)))
        return tuple(part.T @ part / count for part in parts)  # type: ignore[return-value]

    def known(self, covariance: np.ndarray | None, moved: np.ndarray | float = 0.0) -> PredictedError:
        """Return the errors with the covariance J·Σ·Jᵀ + h·hᵀ; Σ = `covariance`, h = `moved` (N, 6)."""
        if covariance is None:
            return PredictedError(self.values, None)
        moves = np.broadcast_to(moved, self.values.shape)
        spread = self.slopes @ covariance @ np.swapaxes(self.slopes, 1, 2)
        return PredictedError(self.values, spread + moves[:, :, None] * moves[:, None, :])


@dataclass(frozen=True)
class PredictedError:
    """The error of the tool's tip at N poses if nominal strut lengths are commanded, in ``work``, m and rad."""

    values: np.ndarray  # (N, 6), displacement and rotation, actual minus commanded; NaN at unreachable poses
    covariance: np.ndarray | None  # (N, 6, 6); None: not known

    @property
    def deviations(self) -> np.ndarray | None:
        """Standard deviations (N, 6) of the errors; None if their covariance is not known."""
        if self.covariance is None:
            return None
        return np.sqrt(np.maximum(np.diagonal(self.covariance, axis1=1, axis2=2), 0.0))


class ErrorPredictor:
    """Predicts the tool error without compensation at any pose, for a model and the temperatures of its machine.

    For motions of the whole machine that the readings do not show, Σ is the priors' covariance. To hold the datum, the
    fit removed an unseen motion h, which may be real: so absolute errors have the covariance J·Σ·Jᵀ + h·hᵀ.
    """

    def __init__(self, machine: RealMachine, fitted: FittedParameters | None) -> None:
        self._machine, self._fitted = machine, fitted
        self._alignment = self._find_alignment()

    def predict(self, poses: Poses, senses: np.ndarray | None = None) -> tuple[PredictedError, PredictedError | None]:
        """Return the errors at N poses: absolute, and after best-fit alignment over the measured box (None: no box).

        `senses` (N, 9) are directions of motion as in :class:`~hexapod_comp.machine.model.MotionState`. If `senses` is
        None, the directions are unknown, and backlash and the error field's reversal have their mean effect, zero.
        """
        count, covariance = len(poses[0]), None if self._fitted is None else self._fitted.covariance
        absolute, aligned = [], []
        for start in range(0, max(count, 1), CHUNK):
            part = slice(start, start + CHUNK)
            errors = self._errors((poses[0][part], poses[1][part]), None if senses is None else senses[part])
            absolute.append(errors.known(covariance, self._held_motion(errors.places)))
            if self._alignment is not None:
                aligned.append(errors.aligned(self._alignment).known(covariance))
        return _joined(absolute), _joined(aligned) if aligned else None

    def slopes(self, poses: Poses) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Return commanded tips (N, 3) in ``work``, m, then the errors' derivatives by x, absolute and aligned.

        The last array (N, 6) is the motion of the tips when the model was moved until its error at the datum was zero.
        Each pose is passed in a random direction: without one, backlash and the field's reversal have no effect.
        """
        if self._fitted is None or self._alignment is None:
            raise CalibrationError("model", "has no covariance of its parameters, or no measured box that is reachable")
        directions = random_directions(np.random.default_rng(SEED), len(poses[0]))
        errors = self._errors(poses, Passes(self._machine.geometry, *poses, directions).senses())
        return errors.places, errors.slopes, errors.aligned(self._alignment).slopes, self._held_motion(errors.places)

    def _errors(self, poses: Poses, senses: np.ndarray | None = None) -> FirstOrder:
        """Return the errors of the tool's tip along the axes of ``work``; NaN at poses that the model cannot reach."""
        machine, fitted, count = self._machine, self._fitted, len(poses[0])
        geometry, structure, work = machine.geometry, machine.structure, machine.geometry.work.rotation
        positions, rotations = (np.ascontiguousarray(part, dtype=float) for part in poses)
        nominal = strut_lengths_batch(Structure.of(geometry), positions, rotations)
        senses = np.zeros((count, FOLLOWED)) if senses is None else np.ascontiguousarray(senses, dtype=float)
        modelled, actual = (positions.copy(), rotations.copy()), (np.empty_like(positions), np.empty_like(rotations))
        outcomes = np.empty(count, np.intc)
        machine.forward_many(nominal, senses, *modelled, *actual, outcomes, np.empty(count))
        solved = outcomes == Status.OK
        displacements = actual[0] - positions + (actual[1] - rotations) @ geometry.tool.position
        columns = np.full((count, 6, 1 + (0 if fitted is None else fitted.space.size)), np.nan)
        columns[solved, :3, 0] = displacements[solved] @ work
        columns[solved, 3:, 0] = attitude_error(actual[1][solved], rotations[solved]) @ work
        if fitted is not None and solved.any():
            space, reached = fitted.space, int(solved.sum())
            stations = Stations(
                **vars(Surroundings.of(machine, reached)),
                positions=positions[solved],
                rotations=rotations[solved],
                commands=nominal[solved],
                sense=senses[solved],
            )
            there = modelled[0][solved], modelled[1][solved]
            base, platform = (np.tile(j, (reached, 1, 1)) for j in (structure.base_joints, structure.platform_joints))
            found = Prediction(np.zeros((reached, 6)), *there, base, platform, machine.model.load, geometry)
            rows = derivatives(space, found, stations)
            rows = carried(rows, there[1] @ (geometry.tool.position - space.probe))
            columns[solved, :, 1:] = np.concatenate([work.T @ rows[:, :3], work.T @ rows[:, 3:]], axis=1)
        return FirstOrder(geometry.tool_poses(positions, rotations)[0], columns)

    def _held_motion(self, tips: np.ndarray) -> np.ndarray:
        """Return the motion (N, 6) of N tool tips, m and rad, that made the tool error at the datum zero."""
        if self._fitted is None or self._fitted.held is None:
            return np.zeros((len(tips), 6))
        geometry, held = self._machine.geometry, self._fitted.held
        return held.moved(tips - geometry.tool_pose(held.pose).position, geometry.work.rotation)

    def _find_alignment(self) -> Alignment | None:
        """Return the best-fit alignment over the measured box; None if fewer than three places in it are reachable."""
        geometry, region = self._machine.geometry, self._machine.model.measured
        if region is None:
            return None
        if self._fitted is not None:
            level = self._fitted.space.level
        else:
            level = geometry.work.rotation @ level_attitude(geometry) @ geometry.tool.rotation.T
        places = np.stack(np.meshgrid(*(np.linspace(low, high, 3) for low, high in region.box.T)), axis=-1)
        errors = self._errors(region.poses(places.reshape(-1, 3), level))
        reached = np.isfinite(errors.columns).all(axis=(1, 2))
        return FirstOrder(errors.places[reached], errors.columns[reached]).alignment() if reached.sum() >= 3 else None


def _joined(parts: list[PredictedError]) -> PredictedError:
    covariances = [part.covariance for part in parts if part.covariance is not None]
    return PredictedError(
        np.concatenate([part.values for part in parts]), np.concatenate(covariances) if covariances else None
    )


# Over the measured box


@dataclass(frozen=True)
class ToolError:
    """The tool error before and after compensation, RMS in the measured box, after best-fit alignment."""

    before: float  # displacement if nominal lengths are commanded, m
    after: float  # displacement expected with the model, m
    low: float  # ends of the 95 % interval of `after`, m; the upper end includes errors that readings may not show
    high: float
    rotation_before: float  # the same for the tool's rotation, rad
    rotation_after: float
    rotation_low: float | None  # None: the readings do not show the tool's roll
    rotation_high: float | None
    rotation_unknown: str = ""  # names of the roll errors that the readings do not show


def box_stations(space: ParameterSpace, tilt: float = 0.0, load: Sequence[float] | None = None) -> Stations | None:
    """Return random stations in the measured box, first all forward, then all backward; None if none is reachable.

    The tool is tilted by `tilt`, rad, about random axes in the x-y plane of the work frame. `load` (7,) is as in
    :attr:`.Surroundings.loads`; without it, the stations take turns with the loads of the readings.
    """
    rng = np.random.default_rng(SEED)
    points = space.places(rng.uniform(space.work_box[0], space.work_box[1], (POINTS, 3)))
    directions = random_directions(rng, POINTS)
    headings = rng.uniform(0.0, 2.0 * np.pi, POINTS)
    angles = tilt * np.stack([np.cos(headings), np.sin(headings), np.zeros(POINTS)], axis=1)
    work = space.geometry.work.rotation
    rotations = work @ rotation_from_angles(angles) @ work.T @ space.level
    every = Passes(space.geometry, points - rotations @ space.probe, rotations, directions)
    reachable = every.reachable()
    if not reachable.any():
        return None
    loads = np.resize(space.loads if load is None else load, (int(reachable.sum()), 7))
    return replace(stations_of(every.select(reachable).both_ways()), loads=np.tile(loads, (2, 1)))


def stations_of(passes: Passes) -> Stations:
    """Return the machine's stops at the poses of `passes`, with nominal strut commands, at 20 °C."""
    return Stations(
        **vars(Surroundings.usual(len(passes))),
        positions=passes.positions,
        rotations=passes.rotations,
        commands=passes.nominal_commands(),
        sense=passes.senses(),
    )


def box_errors(
    space: ParameterSpace, x: np.ndarray, tilt: float = 0.0, load: Sequence[float] | None = None
) -> FirstOrder | None:
    """Return the tool errors at :func:`box_stations` after best-fit alignment; None if no station is reachable."""
    stations = box_stations(space, tilt, load)
    return None if stations is None else FirstOrder.of(space, predict(space, x, stations), stations).aligned()


def about_other_loads(space: ParameterSpace, x: np.ndarray, covariance: np.ndarray, beyond: Unexplained) -> str:
    """Return a note on the expected error without tool, with a tool heavier by OTHER_MASS, and with turned gravity.

    The note is empty if the stiffness of a strut is not stated.
    """
    load = stated_load(space.settings)
    if not load.stiffness.all():
        return ""
    measured = complete_loads(load, space.geometry, space.loads)
    mass, *at = measured[measured[:, 0].argmax()].tolist()
    centre, down = np.array(at[:3]), np.array(at[3:])
    heavier, across = mass + OTHER_MASS, np.linalg.svd(down[None])[2][1] * np.linalg.norm(down)
    loads = {"no tool": (0.0, 0.0, 0.0, 0.0, *down)} if measured[:, 0].min() > 0.0 else {}
    loads |= {
        f"{heavier:g} kg": (heavier, *(mass * centre / heavier), *down),
        "gravity turned by 90°": (mass, *centre, *across),
    }
    found = []
    for name, row in loads.items():
        error = expected_error(box_errors(space, x, load=row), covariance, beyond=beyond)
        if error is not None:
            after, high = (significant(1e6 * size, 2) for size in (error.after, error.high))
            found.append(f"{name} {after} µm (95 %: up to {high})")
    title = "expected error of a level tool under other loads, if the compensator knows them"
    return f"{title}: {', '.join(found)}" if found else ""


def expected_error(
    errors: FirstOrder | None,
    covariance: np.ndarray,
    prior: np.ndarray | None = None,
    beyond: Unexplained | None = None,
) -> ToolError | None:
    """Return the expected tool error of machines drawn from the parameters' covariance; None if `errors` is None.

    `errors` are the :func:`box_errors` of the fitted machine. The error before compensation is that of the fitted
    machine; with `prior` (for a plan) it is the RMS error of machines whose parameters have this covariance.
    """
    if errors is None:
        return None
    beyond = (beyond or Unexplained()).beside(*errors.unsettled)
    squares, drawn = errors.mean_squares, _drawn(covariance)
    if prior is None:
        parts = errors.values[:, :3], errors.values[:, 3:]
        before = [float(np.sqrt((part**2).sum(axis=1).mean())) for part in parts]
    else:
        before = [float(np.sqrt((square * prior).sum())) for square in squares]
    before = [float(np.linalg.norm([own, s.lack, s.stops])) for own, s in zip(before, beyond.scatters, strict=True)]
    sizes = [np.sqrt(np.maximum(np.einsum("id,id->d", drawn, square @ drawn), 0.0)) for square in squares]  # RMS, (D,)
    return ToolError(
        before[0],
        *beyond.promised(sizes[0], errors.places),
        before[1],
        *beyond.promised_rotation(sizes[1]),
    )


def _drawn(covariance: np.ndarray) -> np.ndarray:
    """Draw errors (size, DRAWS) of the parameters by the symmetric square root of their covariance.

    Other square roots are not repeatable: they contain eigenvectors of equal eigenvalues, which depend on rounding, and
    so on the threads of BLAS.
    """
    values, vectors = np.linalg.eigh(covariance)
    z = np.random.default_rng(SEED).standard_normal((len(covariance), DRAWS))
    return np.asarray(vectors @ (np.sqrt(np.maximum(values, 0.0))[:, None] * (vectors.T @ z)))


# What the readings determine


@dataclass(frozen=True)
class BlockObservability:
    name: str
    unit: str
    parameters: int
    determined: float  # number of parameters that the readings, not the prior, determine
    tolerance: float  # estimated prior σ of a parameter
    error: float  # median standard error of a parameter


@dataclass(frozen=True)
class Observability:
    """Which parameters the readings determine."""

    blocks: tuple[BlockObservability, ...]
    structure_rank: int  # number of observable combinations of the structure's parameters
    structure_size: int
    rank: int  # the same for all parameters
    size: int
    condition: float  # largest / smallest observable singular value of the derivatives by parameter / tolerance
    indices: dict[str, float]  # O1 … O4, of the observable combinations
    unseen: tuple[str, ...]  # unobservable structure parameters
    tilt: float  # largest tilt of the tool in the readings, rad


def observe(space: ParameterSpace, problem: LinearProblem, estimate: Estimate, tilt: float = 0.0) -> Observability:
    """Return which parameters the readings determine; `tilt` is the largest tilt of the tool in the readings, rad.

    Observability indices from the singular values: O1 (Borm and Menq) their geometric mean / √readings, O2 (Driels and
    Pathre) smallest / largest, O3 (Nahvi) smallest, O4 (Nahvi and Hollerbach) smallest² / largest.
    """
    spread = space.spread(estimate.tolerances)
    information = spread[:, None] * np.tensordot(estimate.noise**-2, problem.normal, 1) * spread
    seen, _ = _observable(information)
    errors = np.sqrt(np.diag(physical_covariance(space, estimate)))
    structure = space.blocks[0]
    alone, unseen = _observable(information[structure.part, structure.part])
    hidden = (unseen**2).sum(axis=1) > 0.5
    indices = {}
    if len(seen):
        indices["O1"] = float(np.exp(np.log(seen).mean()) / np.sqrt(len(problem.target)))
        indices |= {"O2": float(seen[-1] / seen[0]), "O3": float(seen[-1]), "O4": float(seen[-1] ** 2 / seen[0])}
    blocks = tuple(
        BlockObservability(
            name=block.name,
            unit=block.unit,
            parameters=len(block.labels),
            determined=float(estimate.determined[block.part].sum()),
            tolerance=float(tolerance),
            error=float(np.median(errors[block.part])),
        )
        for block, tolerance in zip(space.blocks, estimate.tolerances, strict=True)
    )
    return Observability(
        blocks=blocks,
        structure_rank=len(alone),
        structure_size=len(structure.labels),
        rank=len(seen),
        size=space.size,
        condition=float(seen[0] / seen[-1]) if len(seen) else np.inf,
        indices=indices,
        unseen=tuple(label for label, is_hidden in zip(structure.labels, hidden, strict=True) if is_hidden),
        tilt=tilt,
    )


def _observable(information: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return √eigenvalues of `information` above ASSUMED.seen, largest first, and the eigenvectors of the rest."""
    values, vectors = np.linalg.eigh(information)
    observable = values > ASSUMED.seen**2
    return np.sqrt(values[observable])[::-1], vectors[:, ~observable]


MACHINE_ERRORS: dict[str, tuple[tuple[str, str], ...]] = {
    "squareness xy": (("dx", "y1"), ("dy", "x1")),
    "squareness xz": (("dx", "z1"), ("dz", "x1")),
    "squareness yz": (("dy", "z1"), ("dz", "y1")),
    "twist dx ~ y z": (("dx", "y1z1"),),
    "twist dy ~ x z": (("dy", "x1z1"),),
    "twist dz ~ x y": (("dz", "x1y1"),),
    "size": (("dx", "x1"), ("dy", "y1"), ("dz", "z1")),
    "roll of x": (("rx", "x1"),),
    "roll of y": (("ry", "y1"),),
    "roll of z": (("rz", "z1"),),
}
"""Geometric errors by their names in metrology; each is a sum of terms of the error field: (component, term)."""


class UnseenError(NamedTuple):
    name: str
    trace: float  # √Σ (change of a reading / σ)² if the error has the size of the field's tolerance

    @property
    def reason(self) -> str:
        if self.trace <= 1e-6:  # rounding
            return "no reading shows it"
        changed = f"an error of the usual size changes the readings by {self.trace:.2g} σ (root sum of squares)"
        return f"below the noise: {changed}; more than {ASSUMED.seen:g} σ is observable"


def listed(errors: Iterable[UnseenError]) -> str:
    """Return the errors as text, grouped by the reason why no reading shows them."""
    by_reason: dict[str, list[str]] = {}
    for error in errors:
        by_reason.setdefault(error.reason, []).append(error.name)
    return "; ".join(f"{', '.join(names)} ({reason})" for reason, names in by_reason.items())


def without_trace(space: ParameterSpace, estimation: Estimation, problem: LinearProblem) -> tuple[UnseenError, ...]:
    """Return the MACHINE_ERRORS that would change the readings by less than their noise (ASSUMED.seen)."""
    means, measurements = estimation.means, estimation.measurements
    points, still = measurements.points(), np.zeros((len(measurements.stations), 3))
    index = {label: n for n, label in enumerate(space.labels)}
    tolerances, half = space.spread(space.start_tolerances()), np.ptp(space.box, axis=0)
    seen: dict[str, np.ndarray] = {}
    for name, parts in MACHINE_ERRORS.items():
        wanted = [index[label] for label in (f"{c} {term}" for c, term in parts) if label in index]
        if len(wanted) < len(parts):
            continue
        # Terms are -1…1 over the box: multiplied by its sides, all terms of an error have the same slope per metre
        x = np.zeros(space.size)
        x[wanted] = [np.prod([half[AXES.index(letter)] for letter in term if letter in AXES]) for _, term in parts]
        y = space.whitened_parameters(x)
        x *= (tolerances / np.abs(y).max())[np.abs(y).argmax()]
        errors = space.field_errors(x, points, still)
        seen[name] = np.einsum("ci,ci->c", means.directions, errors[means.station])
    if not seen:
        return ()
    traces = np.linalg.norm(problem.free_of_nuisance(np.stack([*seen.values()], axis=1)), axis=0)
    return tuple(UnseenError(name, float(t)) for name, t in zip(seen, traces, strict=True) if t <= ASSUMED.seen)
