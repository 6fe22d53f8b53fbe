"""How far a converged fit may be trusted: its predicted tool error, its χ², and the causes of doubt.

A covariance of parameters is right if the model is. Three terms allow for a wrong model. A *cluster jackknife* over
runs compares the change of the tool's error without each run, in the linear problem, with the covariance's prediction,
since errors within a run are not independent. A *discrepancy*: residuals beyond the instruments' noise and the
repeatability are an error of the machine that no parameter describes (Kennedy & O'Hagan 2001). And a *drift*: a scale
of all lengths that changes over the campaign is a parameter with its own prior, included in the fit if the evidence
supports it. The scale of an instrument, which no reading shows, is stated.
"""

from __future__ import annotations

from dataclasses import replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
from scipy.special import gammaincinv, ndtr

from ..machine.arrays import different_rows
from ..measurements.readings import (
    ANGULAR_KINDS,
    BACKWARD,
    DEFAULT_UNCERTAINTY,
    FORWARD,
    KINDS,
    UNKNOWN,
    MeasurementSet,
)
from .assumptions import ASSUMED
from .blocks import EXPECTED
from .estimator import (
    MEDIAN_TO_SIGMA,
    DesignMatrix,
    Estimation,
    Omitted,
    Solution,
    jackknife,
    whitened_precision,
)
from .mistakes import FAMILIES, family_of_run
from .parameters import FitSettings, ParameterSpace
from .posterior import FirstOrder, box_errors
from .promise import Scatter, Unexplained

TILT = np.radians(10.0)
"""Tilt at which the report states the tool error of a tilted tool."""

WITHOUT_EFFECT = 1e-4
"""Share of the tool's squared error that the jackknife omits."""

DRIFT_RUNS, DRIFT_TERMS = 6, 2
"""Fewest runs that read lengths for a drift, two each way; its degree in time, enough for settling."""

LEAST_PAIRS, LEAST_LEFT, LEAST_FREE = 30, 0.25, 3.0
"""Fewest pairs, or repeats, that tell a variance (to 26 %); least share of a discrepancy that parameters leave; fewest
degrees of freedom of a χ² that is listed."""

HELD = 0.5
"""Largest share of a predicted error that may depend on the priors."""

FIELDS = ("field displacement", "field rotation")


class ChiSquare(NamedTuple):
    """Residuals of one part of the readings."""

    kind: str  # of KINDS
    part: str  # a family of lines, a direction, or a run's name
    readings: int
    value: float  # squared residuals over the stated variance, per degree of freedom


class Residuals:
    """A converged fit's residuals, cell by cell, over the estimated noise, and the resulting tool error."""

    def __init__(
        self,
        estimation: Estimation,
        solution: Solution,
        # (C, terms): effect of a drift of the scale on cells, over their noise, in its prior's standard deviations
        drifting: np.ndarray | None = None,
        # Change of the scale from the first to the last reading and its standard deviation, m/m; zeros: no drift
        drift: tuple[float, float] = (0.0, 0.0),
    ) -> None:
        self.estimation, self.solution, self.drift = estimation, solution, drift
        self.drifting = np.zeros((len(estimation.cells.kind), 0)) if drifting is None else drifting
        problem, posterior, cells, m = solution.problem, solution.posterior, estimation.cells, estimation.measurements
        scale = 1.0 / posterior.noise[problem.kind]
        # Derivatives by the parameters in use, in their priors' standard deviations
        self.rows: DesignMatrix = problem.rows.using(posterior.used, scale, posterior.spread)
        self.residual = scale * problem.target - self.rows.times(posterior.y / posterior.spread)
        self.run, self.direction = m.run[cells.first], m.direction[cells.first]

    @cached_property
    def taken(self) -> np.ndarray:
        """Share of each cell that parameters and unknowns of the instruments explain, shape (C,)."""
        every = np.arange(len(self.residual))
        return self.shared(every, every) + self.estimation.shares_of_nuisance()

    @cached_property
    def level(self) -> FirstOrder | None:
        """The tool's errors in the measured box, with a level tool."""
        return box_errors(self.estimation.space, self.solution.x)

    @cached_property
    def metrics(self) -> tuple[np.ndarray, np.ndarray]:
        """M of displacement and rotation: yᵀ·M·y is the tool's mean squared error in the box; zero without a box."""
        space, used = self.estimation.space, self.solution.posterior.used
        if self.level is None:
            return np.zeros((len(used),) * 2), np.zeros((len(used),) * 2)
        displacement, rotation = (space.whitened(space.whitened(m).T) for m in self.level.mean_squares)
        return displacement[np.ix_(used, used)], rotation[np.ix_(used, used)]

    @property
    def expected(self) -> float:
        """Expected mean squared error of the tool by the covariance, m²."""
        return float(np.vdot(self.metrics[0], self.solution.posterior.covariance))

    @cached_property
    def omitted(self) -> list[Omitted]:
        """The effect of leaving out each fold on the tool, by the eigenvectors of its squared error."""
        spread, terms = self.solution.posterior.spread, self.drifting.shape[1]
        values, vectors = np.linalg.eigh(spread[:, None] * self.metrics[0] * spread)
        # ascending: directions that the priors exclude are omitted
        kept = np.cumsum(values) > WITHOUT_EFFECT * self.expected
        kept[-1] = True
        effects = np.pad(vectors[:, kept] * np.sqrt(np.maximum(values[kept], 0.0)), ((0, terms), (0, 0)))
        precision = whitened_precision(self.solution.problem, self.solution.posterior)
        cross, own = self.rows.transposed_times(self.drifting), np.eye(terms)
        precision = np.block([[precision, cross], [cross.T, own + self.drifting.T @ self.drifting]])
        rows = self.rows.beside(self.drifting)
        return jackknife(rows, self.residual, precision, self.estimation.cells.fold, effects)

    @cached_property
    def held_out(self) -> np.ndarray:
        """Errors at cells whose fold was left out of the fit, over the stated standard deviations, shape (C,)."""
        problem, posterior = self.solution.problem, self.solution.posterior
        errors = np.empty(len(self.residual))
        for fold in self.omitted:
            errors[fold.cells] = fold.errors
        return errors * posterior.noise[problem.kind]

    def shared(self, first: np.ndarray, second: np.ndarray) -> np.ndarray:
        """Return the anticorrelation of pairs of cells by fitting: the contribution of both to the parameters."""
        posterior = self.solution.posterior
        return self.rows.between(posterior.covariance / np.outer(posterior.spread, posterior.spread), first, second)


def unexplained(r: Residuals, settings: FitSettings, averaged: float) -> Unexplained:
    """Return the unexplained errors of a converged fit; `averaged` is the factor on the tool's error by averaging over
    blocks that may have been left out wrongly."""
    ratio, freedom = variance_ratio(r)
    clear = freedom > 0.0 and ratio > 2.0 * gammaincinv(0.5 * freedom, 1.0 - 2.0 * ndtr(-ASSUMED.clear)) / freedom
    factor = np.sqrt(ratio) if clear else 1.0
    prior, prior_of_rotation = (_of_priors(r, metric) for metric in r.metrics)
    displacement, rotation = discrepancy(r)
    return Unexplained(
        factor=float(factor),
        believed=ASSUMED.jackknife_prior,
        prior=prior,
        prior_rotation=prior_of_rotation,
        displacement=displacement,
        rotation=rotation,
        drift=r.drift[0],
        drift_error=r.drift[1],
        scale=stated_scale(r.estimation.measurements, settings),
        ratio=ratio,
        freedom=freedom,
        averaged=averaged,
    )


def stated_scale(measurements: MeasurementSet, settings: FitSettings) -> float:
    """Return the standard deviation of the scale of all readings, m/m, as stated or by their instruments' class.

    The best instrument for lengths is used. A beam that is off its line by an angle θ reads θ²/2 too little.
    """
    kinds = {KINDS[k] for k in np.unique(measurements.kind)}
    known = [value for kind, value in ASSUMED.scales if kind in kinds]
    scale = settings.scale if settings.scale is not None else min(known, default=0.0)
    angle = settings.alignment if settings.alignment is not None else ASSUMED.alignment
    return float(np.hypot(scale, 0.5 * angle**2 if "linear" in kinds else 0.0))


# The jackknife, and drift


def variance_ratio(r: Residuals) -> tuple[float, float]:
    """Return the ratio of the tool's squared changes without each run to the expected ones, and its degrees of freedom.

    By Satterthwaite the sum over runs is about a χ² whose degrees of freedom follow from its variance; of G clusters,
    at most G − 1 are independent.
    """
    if not r.expected > 0.0 or len(r.omitted) < 2:
        return 1.0, 0.0
    sums = [(o.moved @ o.moved, np.trace(o.covariance), np.vdot(o.covariance, o.covariance)) for o in r.omitted]
    shown, expected, squares = np.transpose(sums).sum(axis=1)
    return float(shown / expected), float(min(expected**2 / squares, len(r.omitted) - 1))


def with_drift(estimation: Estimation, solution: Solution) -> Residuals:
    """Return what a fit leaves, with a drift of the scale as additional parameters if the evidence supports it.

    A machine that warms, or a laser's air that changes: over the campaign all lengths from the middle of the box grow
    by a polynomial in time. Exact for the linear problem, with fixed priors of the blocks and fixed noise.
    """
    m, cells = estimation.measurements, estimation.cells
    posterior, problem = solution.posterior, solution.problem
    r = Residuals(estimation, solution)
    lengths = ~np.isin(cells.kind, [KINDS.index(kind) for kind in (*ANGULAR_KINDS, "straightness")])
    if len(np.unique(r.run[lengths])) < DRIFT_RUNS:
        return r
    count = np.bincount(cells.of_reading)
    place = np.bincount(cells.of_reading, np.arange(len(m))) / count
    time = 2.0 * place / max(len(m) - 1, 1) - 1.0
    points = m.points()[cells.station]
    growth = np.where(lengths, np.einsum("ci,ci->c", cells.directions[:, :3], points - points.mean(axis=0)), 0.0)
    legendre = np.polynomial.legendre.legvander(time, DRIFT_TERMS)[:, 1:]
    trust = problem.scale / np.sqrt(np.bincount(cells.of_reading, estimation.uncertainty**-2))
    trust /= posterior.noise[cells.kind]
    columns = trust[:, None] * estimation.free_of_nuisance(ASSUMED.drift * growth[:, None] * legendre)
    cross = r.rows.transposed_times(columns) / posterior.spread[:, None]
    gain = posterior.covariance @ cross
    precision = np.eye(columns.shape[1]) + columns.T @ columns - cross.T @ gain
    covariance = np.linalg.inv(precision)
    shown = columns.T @ r.residual
    values = covariance @ shown
    if shown @ values < np.linalg.slogdet(precision)[1]:
        return r
    moved = -gain @ values
    change = r.rows.times(moved / posterior.spread) + columns @ values
    known = replace(posterior, y=posterior.y + moved, covariance=posterior.covariance + gain @ covariance @ gain.T)
    of_cells = posterior.noise[problem.kind]
    target = problem.target - of_cells * (columns @ values)
    residuals = solution.residuals - (of_cells * change / problem.scale)[cells.of_reading]
    settled = replace(
        solution,
        problem=replace(problem, target=target),
        posterior=known,
        x=estimation.space.physical(known.every(estimation.space.size)),
        residuals=residuals,
    )
    size, error = 2.0 * ASSUMED.drift * np.array([abs(values[0]), covariance[0, 0] ** 0.5])
    return Residuals(estimation, settled, columns, (float(size), float(error)))


# The discrepancy


class LackOfFit(NamedTuple):
    """Variances of one kind of readings beyond its stated noise, m² or rad²; 0 where it may be chance."""

    alike: float = 0.0  # common to readings in both directions, with the part that the parameters have absorbed
    most_alike: float = 0.0  # detection threshold
    unlike: float = 0.0  # in neither that nor repeats
    stops: float = 0.0  # pure error: of readings repeated at one place
    most_stops: float = 0.0


def discrepancy(r: Residuals) -> tuple[Scatter, Scatter]:
    """Return the tool's displacement and rotation, from residuals, that no parameter describes.

    Repeats show the pure error; the rest beyond the stated noise is lack of fit (Draper & Smith 1998): an error of the
    machine, such as lost motion by friction, also where it differs between directions.

    A field that is rougher than its terms is seen first in the kind of reading in which it is large compared with the
    noise, usually in rotations. The same lack is then assumed for displacements, in proportion to the fitted sizes of
    both, unless it would have been seen there as well.
    """
    kinds = np.unique(r.estimation.cells.kind)
    found = []
    for angular in (False, True):
        some = [k for k in kinds if (KINDS[k] in ANGULAR_KINDS) == angular]
        cells = [int((r.estimation.cells.kind == k).sum()) for k in some]
        # The mean variance of an axis, three times.
        mean = np.average([lack_of_fit(r, k) for k in some], 0, cells) if some else np.zeros(len(LackOfFit._fields))
        found.append(LackOfFit(*np.sqrt(3.0 * mean).tolist()))
    displacement, rotation = found
    space, sizes = r.estimation.space, r.solution.posterior.tolerances
    fields = {b.name: size for b, size in zip(space.blocks, sizes, strict=True) if b.name in FIELDS and size > 0.0}
    shifted, turned = displacement.alike, rotation.alike
    if len(fields) == len(FIELDS):
        ratio = float(fields[FIELDS[0]] / fields[FIELDS[1]])
        shifted = max(shifted, min(rotation.alike * ratio, displacement.most_alike))
        turned = max(turned, min(displacement.alike / ratio, rotation.most_alike))
    lacks = np.linalg.norm([shifted, displacement.unlike, _unread_backlash(r)]), np.hypot(turned, rotation.unlike)
    return tuple(  # type: ignore[return-value]
        Scatter(float(lack), part.stops, part.most_stops) for lack, part in zip(lacks, found, strict=True)
    )


def lack_of_fit(r: Residuals, kind: int) -> LackOfFit:
    """Return the variances of one kind of readings: all in the stated noise's, except the result."""
    m, estimated = r.estimation.measurements, float(r.solution.posterior.noise[kind] ** 2)
    readings, cells = int((m.kind == kind).sum()), int((r.estimation.cells.kind == kind).sum())
    # Readings about their cell's mean, in the stated noise
    members, of_reading = np.flatnonzero(m.kind == kind), r.estimation.cells.of_reading
    cell, weights = of_reading[members], r.solution.weights[members]
    values = r.solution.residuals[members] / r.estimation.uncertainty[members]
    mean = np.bincount(cell, weights * values)[cell] / np.bincount(cell, weights)[cell]
    freedom = float(readings - cells)
    repeated = float(((weights * (values - mean)) ** 2).sum()) / max(freedom, 1.0)
    pure, error = (repeated, repeated * np.sqrt(2.0 / freedom)) if freedom >= LEAST_PAIRS else (1.0, 0.0)
    stops = pure - 1.0 if pure - 1.0 > ASSUMED.clear * error else 0.0
    # The cells that were read forward, and those read backward at the same places
    stations, every = m.stations, r.estimation.cells
    poses = np.hstack([stations.positions, stations.rotations.reshape(-1, 9)]).round(9)
    pose = different_rows(poses)[1][every.station]
    key = different_rows(np.stack([r.run, every.channel, pose], axis=1))[1]
    ways = [np.flatnonzero((every.kind == kind) & (r.direction == way)) for way in (FORWARD, BACKWARD)]
    _, first, second = np.intersect1d(key[ways[0]], key[ways[1]], return_indices=True)
    there, back = ways[0][first], ways[1][second]
    unlike, of_readings = estimated - 1.0 - stops, estimated * np.sqrt(2.0 / readings)
    if len(there) >= LEAST_PAIRS:
        # Residuals of cells count in their means' noise, which is smaller than a reading's.
        shared, kept = _likeness(r, there, back)
        share, of_pairs = cells / readings, estimated / np.sqrt(len(there))
        alike, clear = shared * estimated * share / kept, ASSUMED.clear * of_pairs * share / kept
        unlike -= shared * estimated * share
        of_readings = np.hypot(of_readings, of_pairs)
    else:  # whether it is the same in both directions is not known
        alike, clear, unlike = unlike, ASSUMED.clear * of_readings, 0.0
    found = LackOfFit(
        alike=alike if alike > clear else 0.0,
        most_alike=max(alike, clear),
        unlike=unlike if unlike > ASSUMED.clear * np.hypot(of_readings, error) else 0.0,
        stops=stops,
        most_stops=stops + 2.0 * error if stops else 0.0,
    )
    return LackOfFit(*(m.stated_of(kind) ** 2 * np.array(found)).tolist())


def _likeness(r: Residuals, there: np.ndarray, back: np.ndarray) -> tuple[float, float]:
    """Return the error variance common to both directions, over that of the noise, and its share that a fit leaves.

    Fitting makes the noise of a pair anticorrelated, by the contribution of both to the parameters and to the run's
    unknowns; and it absorbs the same share of their common error. Residuals are cut off at 2 σ, since an instrument
    that slips falsifies many readings; of the covariance of normal residuals (P(|x| < 2))² remains.
    """
    # Means of repeated readings are off by more than their noise if each place has its own error.
    size = 2.0 * max(1.0, MEDIAN_TO_SIGMA * float(np.median(np.abs(r.residual[there]))))
    cut = np.clip(r.residual, -size, size)
    groups = r.estimation.cells.group
    sizes = np.bincount(groups + 1)[groups[there] + 1]
    unlike = r.shared(there, back) + np.where(groups[there] < 0, 0.0, 1.0 / sizes)
    shared = (cut[there] * cut[back] / 0.911 + unlike).mean()
    return float(shared), float(max(1.0 - (r.taken[there] + unlike).mean(), LEAST_LEFT))


def _unread_backlash(r: Residuals) -> float:
    """Return the RMS displacement, m, by half the backlash of a machine whose readings have no direction."""
    m, space = r.estimation.measurements, r.estimation.space
    if (m.direction != UNKNOWN).any() or space.block("backlash") is not None:
        return 0.0
    alone = ParameterSpace((space.geometry, space.region), replace(space.settings, blocks=("backlash",)))
    errors, block = box_errors(alone, np.zeros(alone.size)), alone.block("backlash")
    if errors is None or block is None:
        return 0.0
    sizes = np.diag(errors.mean_squares[0])[block.part] * block.tolerance**2
    return float(np.sqrt(sizes.sum()))


# Priors, and χ²


def _of_priors(r: Residuals, metric: np.ndarray) -> float:
    """Return the uncertainty of the logarithm of an expected tool error, as the sizes of priors are estimates.

    A size that n parameters determine is known to 1/√(2n) of itself, and moves the squared error by its prior's share
    of it: with C = (N + T⁻²)⁻¹, tr(M·C·T⁻²·C)/tr(M·C). For a length map or a field, the readings determine the coarse
    terms; the fine terms are assumed to scale with them.
    """
    posterior = r.solution.posterior
    expected = float(np.vdot(metric, posterior.covariance))
    if not expected > 0.0:
        return 0.0
    held = np.einsum("ij,ji->i", posterior.covariance @ metric, posterior.covariance) / posterior.spread**2
    variance = 0.0
    for block in r.estimation.space.blocks:
        members = (posterior.used >= block.part.start) & (posterior.used < block.part.stop)
        share = held[members].sum() / expected
        variance += 0.5 * share**2 / max(posterior.determined[members].sum(), 1.0)
        general = block.name not in (*EXPECTED, "structure") and not block.name.startswith("wave")
        variance += (share * ASSUMED.fine_terms) ** 2 if general else 0.0
    return float(np.sqrt(variance))


def held_by_priors(r: Residuals) -> bool:
    """Return whether the expected tool error follows from the priors rather than from the readings."""
    metric, posterior, m = r.metrics[0], r.solution.posterior, r.estimation.measurements
    if not metric.any():
        return False
    prior, left = (np.sqrt(np.trace(metric @ part)) for part in (np.diag(posterior.spread**2), posterior.covariance))
    noise = r.estimation.uncertainty * posterior.noise[m.kind]
    lengths = ~np.isin(m.kind, [KINDS.index(kind) for kind in ANGULAR_KINDS])
    return bool(left > HELD * prior and (not lengths.any() or left > np.median(noise[lengths])))


def unstated(m: MeasurementSet) -> str:
    """Return a note on lengths whose noise is assumed, since the machine's own may be part of it; empty if none is."""
    unstated = np.unique(m.kind[~np.isfinite(m.uncertainty)])
    listed = [
        f"{KINDS[k]} {DEFAULT_UNCERTAINTY[KINDS[k]] * 1e6:g} µm" for k in unstated if KINDS[k] not in ANGULAR_KINDS
    ]
    if not listed:
        return ""
    problem = f"no uncertainty is stated ({', '.join(listed)} assumed)"
    return f"{problem}: what the machine's own repeatability has of that is not in the expected tool error"


def chi_squares(r: Residuals) -> tuple[tuple[ChiSquare, ...], tuple[ChiSquare, ...]]:
    """Return χ² per degree of freedom of each kind of channel: by line family and by direction of motion; and by run.

    The runs are sorted by χ², the largest first.
    """
    m, solution, of_reading = r.estimation.measurements, r.solution, r.estimation.cells.of_reading
    freedom = 1.0 - (r.taken / np.bincount(of_reading))[of_reading]
    squares = (solution.weights * solution.residuals / r.estimation.uncertainty) ** 2
    groups = (
        (family_of_run(m)[m.run], dict(enumerate(FAMILIES))),
        (m.direction, {FORWARD: "forward", BACKWARD: "backward"}),
        (m.run, dict(enumerate(run.name for run in m.runs))),
    )
    parts: list[list[ChiSquare]] = [[], [], []]
    for part, (numbers, names) in zip(parts, groups, strict=True):
        for k in np.unique(m.kind):
            for number, name in names.items():
                members = (m.kind == k) & (numbers == number)
                if freedom[members].sum() > LEAST_FREE:
                    value = float(squares[members].sum() / freedom[members].sum())
                    part.append(ChiSquare(KINDS[k], name, int(members.sum()), value))
    return (*parts[0], *parts[1]), tuple(sorted(parts[2], key=lambda part: -part.value))
