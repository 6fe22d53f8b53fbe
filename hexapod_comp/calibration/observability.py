"""What measurements determine and what they do not: rank, indices, weak directions, the tool error to expect."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from ..machine.passes import Passes, random_directions
from ..machine.size import rms
from ..machine.temperatures import REFERENCE_TEMPERATURE, Temperatures
from ..measurements.readings import AXES, Stations
from ..pose import rotation_from_angles
from ..virtual.trial import without_datum
from .estimator import Estimation, LinearProblem, Posterior, at_once, physical_covariance
from .parameters import ParameterSpace
from .promise import Unexplained
from .sensitivity import Prediction, derivatives, predict

SEEN = 1.0
"""A direction is observable when its tolerance changes the readings by more than so many standard deviations."""

WEAK = 5.0
"""Observable directions below so many standard deviations are called weak."""

NOT_READ = 1e-6
"""An error that changes the readings by less, standard deviations, changes none: rounding."""

UNSEEN_SHARE = 0.5
"""A parameter is called unobservable when more than this share of it lies in directions nobody sees."""

POINTS, DRAWS, SEED = 300, 300, 7
"""Random points and draws of the parameters behind an expected tool error."""

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
"""Machine errors in the field's terms (component, term), by the names under which machinists know them."""


@dataclass(frozen=True)
class BlockSight:
    """How well the data see one block.

    Attributes
    ----------
    name, unit : str
        Block and SI unit.
    parameters : int
        How many.
    determined : float
        How many of them the data determine; the prior the rest.
    tolerance : float
        Standard deviation of the block's prior.
    error : float
        Median standard error of its parameters.
    """

    name: str
    unit: str
    parameters: int
    determined: float
    tolerance: float
    error: float


@dataclass(frozen=True)
class Observability:
    """What the data determine.

    Attributes
    ----------
    blocks : tuple of BlockSight
        Block by block.
    structure_rank, structure_size : int
        Directions of the structure that the data see, and how many there are.
    rank, size : int
        The same of all parameters.
    condition : float
        Largest over smallest singular value of what is seen, each parameter in its tolerance.
    indices : dict of str to float
        Observability indices of the seen directions: O1 (Borm and Menq: geometric mean over √readings), O2 (Driels
        and Pathre: 1/condition), O3 (Nahvi: smallest), O4 (Nahvi and Hollerbach: smallest²/largest).
    weak : tuple of (float, str)
        Strength, in standard deviations, and main parameters of directions that are only just seen.
    unseen : tuple of str
        Structure parameters that the data do not see.
    tilt : float
        Furthest that the tool was tilted from level in the readings, rad.
    """

    blocks: tuple[BlockSight, ...]
    structure_rank: int
    structure_size: int
    rank: int
    size: int
    condition: float
    indices: dict[str, float]
    weak: tuple[tuple[float, str], ...]
    unseen: tuple[str, ...]
    tilt: float


def observe(space: ParameterSpace, problem: LinearProblem, posterior: Posterior, tilt: float = 0.0) -> Observability:
    """Return what a linear problem's data determine.

    Parameters
    ----------
    space : ParameterSpace
        Names and priors.
    problem : LinearProblem
        The data's derivatives.
    posterior : Posterior
        Tolerances, noise and covariance, all blocks in use.
    tilt : float
        Furthest that the tool was tilted from level, rad.
    """
    spread = space.spread(posterior.tolerances)
    information = spread[:, None] * np.tensordot(posterior.noise**-2, problem.normal, 1) * spread
    singular, vectors = _singular(information)
    seen = singular[singular > SEEN]
    errors = np.sqrt(np.diag(physical_covariance(space, posterior)))
    structure = space.blocks[0]
    alone, directions = _singular(information[structure.part, structure.part])
    hidden = (directions[:, alone <= SEEN] ** 2).sum(axis=1) > UNSEEN_SHARE
    return Observability(
        blocks=tuple(_sight(space, posterior, n, errors) for n in range(len(space.blocks))),
        structure_rank=int((alone > SEEN).sum()),
        structure_size=len(structure.labels),
        rank=len(seen),
        size=space.size,
        condition=float(seen[0] / seen[-1]) if len(seen) else np.inf,
        indices=_indices(seen, len(problem.target)),
        weak=tuple(_weak(space, singular, vectors)),
        unseen=tuple(label for label, is_hidden in zip(structure.labels, hidden, strict=True) if is_hidden),
        tilt=tilt,
    )


def _singular(information: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the singular values of the whitened derivatives, largest first, and their directions."""
    values, vectors = np.linalg.eigh(information)
    return np.sqrt(np.maximum(values[::-1], 0.0)), vectors[:, ::-1]


def _sight(space: ParameterSpace, posterior: Posterior, n: int, errors: np.ndarray) -> BlockSight:
    """Return how well block n is seen; `errors` are the standard errors of all parameters, SI."""
    block = space.blocks[n]
    return BlockSight(
        name=block.name,
        unit=block.unit,
        parameters=len(block.labels),
        determined=float(posterior.determined[block.part].sum()),
        tolerance=float(posterior.tolerances[n]),
        error=float(np.median(errors[block.part])),
    )


def _indices(seen: np.ndarray, readings: int) -> dict[str, float]:
    """Return the four observability indices of some singular values."""
    if not len(seen):
        return {}
    return {
        "O1": float(np.exp(np.log(seen).mean()) / np.sqrt(readings)),
        "O2": float(seen[-1] / seen[0]),
        "O3": float(seen[-1]),
        "O4": float(seen[-1] ** 2 / seen[0]),
    }


def _weak(space: ParameterSpace, singular: np.ndarray, vectors: np.ndarray) -> list[tuple[float, str]]:
    """Return strength and main parameters of the weakest seen directions, at most five."""
    labels = space.labels
    chosen = np.flatnonzero((singular > SEEN) & (singular < WEAK))[::-1][:5]
    weak = []
    for n in chosen:
        main = np.argsort(-np.abs(vectors[:, n]))[:3]
        weak.append((float(singular[n]), ", ".join(f"{vectors[i, n]:+.2f} {labels[i]}" for i in main)))
    return weak


class UnseenError(NamedTuple):
    """An error of a machine that its readings do not show: name, and by how much it changes them.

    The change is the root sum of squares over all readings, free of what instruments do not know, of an error of the
    field's tolerance, in standard deviations of the stated noise.
    """

    name: str
    trace: float

    @property
    def reason(self) -> str:
        """Why it is not seen."""
        if self.trace <= NOT_READ:
            return "no reading shows it"
        return f"below the noise: it changes all readings together by {self.trace:.2g} σ, seen from {SEEN:g} on"


def listed(errors: Iterable[UnseenError]) -> str:
    """Return errors in words, those together that are not seen for the same reason."""
    by_reason: dict[str, list[str]] = {}
    for error in errors:
        by_reason.setdefault(error.reason, []).append(error.name)
    return "; ".join(f"{', '.join(names)} ({reason})" for reason, names in by_reason.items())


def without_trace(estimation: Estimation) -> tuple[UnseenError, ...]:
    """Return the machine errors that readings do not show above their noise; none when their space has no field.

    Parameters
    ----------
    estimation : Estimation
        The readings, against parameters with the field's blocks.
    """
    space, cells, measurements = estimation.space, estimation.cells, estimation.measurements
    points, still = measurements.points(), np.zeros((len(measurements.stations), 3))
    index = {label: n for n, label in enumerate(space.labels)}
    tolerances, half = space.spread(space.start_tolerances()), np.ptp(space.box, axis=0)
    seen: dict[str, np.ndarray] = {}
    for name, parts in MACHINE_ERRORS.items():
        wanted = [index[label] for label in (f"{c} {term}" for c, term in parts) if label in index]
        if len(wanted) < len(parts):
            continue
        # A shear or a size is the same per length, and the terms run from -1 to 1 over sides of the box.
        x = np.zeros(space.size)
        x[wanted] = [np.prod([half[AXES.index(letter)] for letter in term if letter in AXES]) for _, term in parts]
        y = space.whitened_parameters(x)
        x *= (tolerances / np.abs(y).max())[np.abs(y).argmax()]
        errors = space.field_errors(x, points, still)
        seen[name] = np.einsum("ci,ci->c", cells.directions, errors[cells.station])
    if not seen:
        return ()
    traces = np.linalg.norm(estimation.free_of_nuisance(np.stack([*seen.values()], axis=1)), axis=0)
    return tuple(UnseenError(name, float(t)) for name, t in zip(seen, traces, strict=True) if t <= SEEN)


@dataclass(frozen=True)
class ToolError:
    """The tool error of a machine before and after compensation, the datum aligned, in a box.

    Attributes
    ----------
    before : float
        RMS 3-D error of the machine as fitted, told nominal lengths, m.
    after : float
        RMS 3-D error to expect with the model, m.
    low, high : float
        Between these it lies with a probability of 95 %, m; the upper end also allows for errors of which the
        readings do not tell whether the machine has them.
    rotation_before, rotation_after : float
        The same of the rotation, rad.
    rotation_low, rotation_high : float or None
        None where the readings do not show how the tool rolls: the priors alone would say it.
    rotation_unknown : str
        Why they are None.
    """

    before: float
    after: float
    low: float
    high: float
    rotation_before: float
    rotation_after: float
    rotation_low: float | None
    rotation_high: float | None
    rotation_unknown: str = ""


Allowed = tuple[ParameterSpace, np.ndarray, np.ndarray]
"""A larger space, the way from a fit's parameters to its most probable ones, and their covariance."""


def expected_error(
    space: ParameterSpace,
    x: np.ndarray,
    covariance: np.ndarray,
    tilt: float = 0.0,
    prior: np.ndarray | None = None,
    allowed: Allowed | None = None,
    beyond: Unexplained | None = None,
) -> ToolError | None:
    """Return the tool error that the parameters' covariance leaves, at random points, both directions.

    Machines are drawn from the parameters' distribution, to first order, and the datum is aligned. None where no
    machine takes such poses.

    Parameters
    ----------
    space, x, covariance : ParameterSpace, ndarray, shape (size,), ndarray, shape (size, size)
        The parameters, their values and their covariance.
    tilt : float
        Tilt of the tool, rad, in random directions.
    prior : ndarray, shape (size, size), optional
        The error before is that of machines of this covariance, not of x.
    allowed : (ParameterSpace, ndarray, ndarray), optional
        A larger space with nothing ruled out, the way from x to its most probable parameters, and their covariance:
        what may hide there widens the interval upwards.
    beyond : Unexplained, optional
        What else does.
    """
    stations = box_stations(space, tilt)
    if stations is None:
        return None
    prediction = predict(space, x, stations)
    points = stations.positions + stations.rotations @ space.probe
    errors = prediction.errors[:, :, None]
    if prior is not None:
        errors = derivatives(space, prediction, stations) @ _drawn(prior)
    before, rotation_before = _aligned_rms(points, errors)
    left, possible = left_errors(space, prediction, stations, covariance, allowed)
    beyond = beyond or Unexplained()
    (sizes, rotation_sizes), (widest, rotation_widest) = (_aligned_rms(points, part) for part in (left, possible))
    return ToolError(
        float(np.hypot(rms(before), beyond.displacement.stops)),
        *beyond.promised(sizes, widest, points),
        float(np.hypot(rms(rotation_before), beyond.rotation.stops)),
        *beyond.promised_rotation(rotation_sizes, rotation_widest),
    )


def left_errors(
    space: ParameterSpace,
    prediction: Prediction,
    stations: Stations,
    covariance: np.ndarray,
    allowed: Allowed | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """Return errors that a model may leave at stations, by machines drawn from its covariance, and the possible ones.

    Parameters
    ----------
    space, covariance, allowed
        As for :func:`expected_error`.
    prediction, stations : Prediction, Stations
        The fitted machine at some stations.

    Returns
    -------
    left, possible : ndarray, shape (M, 6, D)
        m and rad; possible ones also have what the readings do not rule out.
    """
    slopes = derivatives(space, prediction, stations)
    if allowed is None:
        left = slopes @ _drawn(covariance)
        return left, left
    wide_space, shift, wide_covariance = allowed
    drawn, wide = at_once(_drawn, (covariance, wide_covariance))
    return slopes @ drawn, derivatives(wide_space, prediction, stations) @ (shift[:, None] + wide)


def _aligned_rms(points: np.ndarray, errors: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return RMS displacement and rotation, shape (D,) each, of errors (M, 6, D) after aligning the datum."""
    turned = errors[:, 3:] - errors[:, 3:].mean(axis=0)
    squares = (without_datum(points, errors[:, :3]) ** 2).sum(axis=1), (turned**2).sum(axis=1)
    return np.sqrt(squares[0].mean(axis=0)), np.sqrt(squares[1].mean(axis=0))


def errors_in_space(
    space: ParameterSpace, x: np.ndarray, covariance: np.ndarray, points: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return the errors in space without compensation, and what RMS error is left with it, at points, shape (n,), m.

    As :func:`expected_error`, for a level tool, the datum aligned over these points; NaN where the machine does
    not reach.

    Parameters
    ----------
    space, x, covariance
        As for :func:`expected_error`.
    points : ndarray, shape (n, 3)
        Places of the measured point, m in ``base``.
    """
    level = np.tile(space.level, (len(points), 1, 1))
    along_x = np.tile(space.geometry.work.rotation[:, 0], (len(points), 1))
    every = Passes(space.geometry, points - space.level @ space.probe, level, along_x)
    reachable = every.reachable()
    before, left = np.full((2, len(points)), np.nan)
    if not reachable.any():
        return before, left
    stations = stations_of(every.select(reachable).both_ways())
    prediction = predict(space, x, stations)
    places = np.tile(points[reachable], (2, 1))

    def sizes(errors: np.ndarray) -> np.ndarray:
        squares = (without_datum(places, errors) ** 2).sum(axis=1).mean(axis=1)
        return np.sqrt(squares.reshape(2, -1).mean(axis=0))

    before[reachable] = sizes(prediction.errors[:, :3, None])
    left[reachable] = sizes(derivatives(space, prediction, stations)[:, :3] @ _drawn(covariance))
    return before, left


def _drawn(covariance: np.ndarray) -> np.ndarray:
    """Return draws of parameters with a covariance, shape (size, DRAWS)."""
    values, vectors = np.linalg.eigh(covariance)
    z = np.random.default_rng(SEED).standard_normal((len(covariance), DRAWS))
    return vectors @ (np.sqrt(np.maximum(values, 0.0))[:, None] * z)


def box_stations(space: ParameterSpace, tilt: float = 0.0) -> Stations | None:
    """Return random reachable stations in the measured box, each passed there and back in a random direction.

    The box is the work frame's. First all there, then all back. The tool is tilted by `tilt`, rad, from level,
    each time about another horizontal axis of the work frame.
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
    return stations_of(every.select(reachable).both_ways()) if reachable.any() else None


def stations_of(passes: Passes) -> Stations:
    """Return the stations of some passes, told nominal lengths, at 20 °C."""
    return Stations(
        positions=passes.positions,
        rotations=passes.rotations,
        commands=passes.nominal_commands(),
        sense=passes.senses(),
        temperatures=np.full((len(passes), len(Temperatures.NAMES)), REFERENCE_TEMPERATURE),
        times=np.full(len(passes), np.nan),
        humidity=np.full(len(passes), np.nan),
    )
