"""Possible changes of a machine since its fit, compared by the Bayes factors of a few check readings r.

Without a change, r − prediction ~ N(0, S), S = J·Σ·Jᵀ + noise covariance, J = ∂r/∂x, Σ: covariance of the fitted
parameters x. A change moves x by A·θ, θ ~ N(0, s²·1), s unknown: then r − prediction ~ N(0, S + s²·J·A·Aᵀ·Jᵀ).
"""

from __future__ import annotations

import copy
import math
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from scipy.optimize import brentq, minimize
from scipy.sparse import csr_array
from scipy.special import chdtr, chdtrc, ndtri

from ..errors import CalibrationError
from ..machine.geometry import STRUT_NAMES
from ..measurements.readings import AXES, CHANNELS, KINDS, MeasurementSet
from .assumptions import ASSUMED
from .blocks.block import Linkage
from .blocks.load import complete_loads, stated_load
from .estimator import Estimation
from .parameters import BLOCKS, ParameterSpace, distinct_loads
from .posterior import FittedParameters, box_stations
from .sensitivity import derivatives, predict
from .trust import FIELDS, TILT

MOST_READINGS = 500  # largest number of mean readings of a check; with more readings, fit a new model
UNCHANGED_DRAWS = 4000  # simulated checks of an unchanged machine: a p-value of 1 % has a standard error of 0.16 %
DATUM, STRUT, TEMPERATURE, PAYLOAD = "datum", "strut", "temperature", "payload"
AGEING, READING, OTHER = "ageing", "reading", "other"
# Kinds of change and their names
FAMILIES = {
    DATUM: "the datum has moved",
    STRUT: "a strut's offset has changed",
    TEMPERATURE: "a temperature has changed",
    PAYLOAD: "the payload has changed",
    AGEING: "the whole machine has aged",
    READING: "a single reading is wrong",
    OTHER: "the machine has changed in another way",
}

HEAVIER = "heavier or lighter"  # name of a change of the payload's mass that does not move its centre of mass
# Ridge / trace of the normal matrix: keeps parameters small that would hardly reduce the misfit to a payload's effect
RIDGE = 1e-8
LEAST_MASS = 1e-3  # smallest mass of the platform after a change of the payload, kg
ROUNDING = 1e-9  # counts as zero up to this: a distance, m; a singular value / the largest; a variance / their mean


@dataclass(frozen=True)
class Change:
    """A possible change of a machine: the machine's parameters x change by `columns`·θ, θ ~ N(0, scale²·1)."""

    family: str  # kind of change, a key of FAMILIES
    name: str
    scales: np.ndarray  # (m,): possible standard deviations of θ, all equally probable
    columns: np.ndarray | None = None  # (size, k), SI; None: the readings are wrong, the machine has not changed
    # For reports: label, factor from SI and unit of each component of θ; empty if θ has no physical meaning
    shown: tuple[tuple[str, float, str], ...] = ()
    group: str = ""  # name shared by similar changes; the groups of one kind of change are equally probable a priori


def widened(
    fitted: FittedParameters, blocks: tuple[str, ...] = BLOCKS, readings: MeasurementSet | None = None
) -> FittedParameters:
    """Return fitted parameters extended by further `blocks`, whose values and covariance are zero.

    The result's `space.loads` are the loads of `readings` or, if None, those of the readings of the fit.
    """
    old = fitted.space
    kept = {block.name for block in old.blocks}
    settings = replace(old.settings, blocks=tuple(name for name in BLOCKS if name in kept or name in blocks))
    space = ParameterSpace((old.geometry, old.region), settings)
    space.loads = old.loads if readings is None else distinct_loads(readings)
    places = np.concatenate([np.arange(b.part.start, b.part.stop) for b in space.blocks if b.name in kept])
    covariance = np.zeros((space.size, space.size))
    covariance[np.ix_(places, places)] = fitted.covariance
    x, tolerances = space.carried_over(old, fitted.x, fitted.tolerances)
    return FittedParameters(space, x, covariance, tolerances, fitted.noise, fitted.held)


def possible_changes(space: ParameterSpace, modelled: Sequence[str]) -> list[Change]:
    """Return possible changes of a machine as changes of parameters; ageing changes the `modelled` blocks only."""
    geometry, unit = space.geometry, np.eye(space.size)
    start, count = space.blocks[0].part.start, int(space.platform_groups.max()) + 1
    base = start + np.arange(18).reshape(6, 3)
    platform = start + 18 + np.arange(3 * count).reshape(count, 3)
    offsets = np.arange(space.size)[space.offsets]
    lengths, growths = np.array(ASSUMED.moved), np.array(ASSUMED.grown)

    def shown(names: Sequence[str], factor: float = 1e6, what: str = "µm") -> tuple[tuple[str, float, str], ...]:
        return tuple((name, factor, what) for name in names)

    # Rotations of the datum are about the box's centre; their θ is the displacement of the box's corners, m
    size = 0.5 * float(np.linalg.norm(np.ptp(space.work_box, axis=0))) or 1.0
    arms, rigid = geometry.base_joints - space.places(space.work_box.mean(axis=0)), np.zeros((space.size, 6))
    for n, axis in enumerate(geometry.work.rotation.T):
        rigid[base, n], rigid[base, 3 + n] = axis, np.cross(axis, arms) / size
    turns = shown([f"about {a}" for a in AXES], 1e6 / size, "µrad")
    changes = [Change(DATUM, "base or workpiece, in the work frame", lengths, rigid, shown(AXES) + turns)]

    for name, place in zip(STRUT_NAMES, offsets, strict=True):
        changes.append(Change(STRUT, name, lengths, unit[:, [place]], shown([name])))
    changes.append(Change(STRUT, "several struts", lengths, unit[:, offsets], shown(STRUT_NAMES)))

    grown, bodies = np.zeros((space.size, 3)), ("struts", "base", "platform")
    grown[offsets, 0] = space.home_lengths
    if pitch := space.block("pitch"):
        grown[pitch.part, 0] = 1.0
    grown[base, 1], grown[platform[space.platform_groups], 2] = geometry.base_joints, geometry.platform_joints
    for name, labels, columns in (
        ("struts", ["struts"], grown[:, :1]),
        ("base", ["base"], grown[:, 1:2]),
        ("all parts equally", ["all"], grown.sum(axis=1, keepdims=True)),
        ("each part separately", bodies, grown),
    ):
        changes.append(Change(TEMPERATURE, name, growths, columns, shown(labels, 1e6, "ppm")))

    changes += payload_changes(space)

    # Ageing and a smooth bend of the field change the readings in similar ways
    prior = space.physical(np.diag(space.spread(space.start_tolerances())))
    aged, bend = (prior[:, space.members(blocks)] for blocks in (modelled, FIELDS))
    changes.append(Change(AGEING, "small changes of all parameters", np.array(ASSUMED.aged), aged))
    for body, joints in (("base", base), ("platform", platform)):
        for n, places in enumerate(joints, start=1):
            changes.append(Change(OTHER, f"{body} joint {n}", lengths, unit[:, places], shown(AXES), "joints"))
    for name, ends, what in (("pitch", ASSUMED.worn_pitch, "ppm"), ("backlash", ASSUMED.worn_backlash, "µm")):
        for strut, column in zip(STRUT_NAMES, unit.T[space.members([name])], strict=False):  # none without the block
            label = shown([strut], 1e6, what)
            changes.append(Change(OTHER, f"{name} of {strut}", np.array(ends), column[:, None], label, "screws"))
    changes.append(Change(OTHER, "a smooth bend in space", np.array(ASSUMED.bent), bend, group="bend"))
    return changes


def payload_changes(space: ParameterSpace) -> list[Change]:
    """Return two possible changes of the payload: of its mass, and of mass and centre; none if the fit has no box.

    The fit has no parameter for the payload. Its change is therefore expressed by the most probable changes of the
    parameters that cause the same tool errors in the box as the added weight, for a level and for a tilted tool.
    The masses in the report assume the stated stiffness, whose error is not in their standard errors, or the stiffness
    ASSUMED.stiffness if none is stated.
    """
    stations = [box_stations(space, tilt) for tilt in (0.0, TILT)]
    if stations[0] is None or stations[1] is None:
        return []
    load, zero, parts = stated_load(space.settings), np.zeros(space.size), []
    compliance = load.compliance if load.stiffness.all() else np.full(6, 1.0 / ASSUMED.stiffness)
    aside = perpendicular_to_gravity(space)
    for both_ways in filter(None, stations):
        at = both_ways.select(slice(len(both_ways) // 2))  # neither depends on the direction of motion
        prediction = predict(space, zero, at)
        linkage = Linkage(prediction, space.probe, at)
        _, centre, gravity = np.split(complete_loads(load, space.geometry, at.loads), [1, 4], axis=1)
        forces = [np.hstack([gravity, np.cross(np.einsum("mij,mj->mi", at.rotations, centre), gravity)])]
        forces += [np.hstack([0.0 * gravity, np.cross(arm, gravity)]) for arm in aside]
        stretched = [compliance * linkage.tensions(force) for force in forces]
        errors = linkage.per_length @ np.stack(stretched, axis=2)
        parts.append((derivatives(space, prediction, at), errors))
    rows, errors = (np.concatenate(each) for each in zip(*parts, strict=True))
    rows[:, 3:] *= space.geometry.characteristic_length
    errors[:, 3:] *= space.geometry.characteristic_length
    # Blocks whose errors depend neither on load nor on temperature
    smooth = ("structure", "pitch", "map", *FIELDS)
    prior = space.physical(np.diag(space.spread(space.start_tolerances())))[:, space.members(smooth)]
    design = rows.reshape(-1, space.size) @ prior
    square = design.T @ design
    square[np.diag_indices(len(square))] += RIDGE * np.trace(square)
    columns = prior @ np.linalg.solve(square, design.T @ errors.reshape(-1, len(aside) + 1))
    unit, sizes = f"kg at {1e-6 / compliance.mean():.3g} N/µm", np.array(ASSUMED.loaded)
    radius = space.geometry.characteristic_length
    shown = (("mass", 1.0, unit), *((f"moment {n}", radius, unit.replace("kg", "kg m", 1)) for n in (1, 2)))
    return [
        Change(PAYLOAD, HEAVIER, sizes, columns[:, :1], shown[:1]),
        Change(PAYLOAD, "mass and its centre", sizes, columns, shown),
    ]


def with_payload_change(space: ParameterSpace, change: np.ndarray) -> ParameterSpace:
    """Return the parameter space after a change of payload; `change` is θ of one of :func:`payload_changes`."""
    load, aside = stated_load(space.settings), np.append(change[1:], np.zeros(3 - len(change)))
    mass = max(load.mass + change[0], LEAST_MASS)
    centre = complete_loads(load, space.geometry, space.loads)[:, 1:4].mean(axis=0)
    moment = load.mass * load.centre + change[0] * centre + space.level.T @ (perpendicular_to_gravity(space).T @ aside)
    other = copy.copy(space)
    other.settings = replace(space.settings, load=replace(load, mass=mass, centre=moment / mass).numbers())
    return other


def perpendicular_to_gravity(space: ParameterSpace) -> np.ndarray:
    """Return two vectors (2, 3) in base, of characteristic length, m, perpendicular to gravity and to each other."""
    gravity = complete_loads(stated_load(space.settings), space.geometry, space.loads)[:, 4:].mean(axis=0)
    return np.asarray(space.geometry.characteristic_length * np.linalg.svd(gravity[None])[2][1:])


def consistency(cut: float) -> float:
    """Return E[min(|z|, cut)²], z ~ N(0, 1): the variance of normal residuals clipped at `cut`."""
    return float(chdtr(3, cut**2) + cut**2 * chdtrc(1, cut**2))


def reading_noise(fitted: FittedParameters) -> np.ndarray:
    """Return estimated / stated σ of a single reading of each kind of channel, corrected for Huber's clipping."""
    return fitted.noise / np.sqrt(consistency(ASSUMED.huber) if fitted.space.settings.robust else 1.0)


@dataclass(frozen=True)
class CheckReadings:
    """Check readings as n contrasts, compared with their prediction by a fit.

    Contrasts are orthonormal linear combinations of the mean readings, each over its stated σ, that do not depend on
    the instruments' unknowns (zeros, slopes, frames).
    """

    residuals: np.ndarray  # (n,): contrasts minus their prediction
    rows: np.ndarray  # (n, size): derivatives of the contrasts by the parameters
    noise: np.ndarray  # (n, n): covariance of the contrasts by noise alone
    single: np.ndarray  # (n, means): change of the contrasts by an error of one σ in each mean reading
    names: tuple[str, ...]  # of each mean reading, for reports
    seen: np.ndarray = field(repr=False)  # (n, means): coefficients of the contrasts
    kind: np.ndarray  # (means,): kind of channel
    weights: csr_array = field(repr=False)  # (means, N): weight of each reading in its mean / σ of the mean
    # Returns the change of the contrasts by a payload's change θ; None: the change is linear, without lost motion
    loaded: Callable[[np.ndarray], np.ndarray] | None = field(default=None, repr=False)

    @staticmethod
    def of(fitted: FittedParameters, measurements: MeasurementSet, x: np.ndarray | None = None) -> CheckReadings:
        """Return readings without the instruments' unknowns, linearised at parameters `x` (default: fitted ones)."""
        space = fitted.space
        away = float(np.abs(measurements.probe - space.probe).max())
        if away > ROUNDING:
            where = f"were taken at a point of the tool {away * 1e3:.4g} mm from"
            problem = f"{where} the point of the fit's readings: read that point (--probe-mm states it for tidy files)"
            raise CalibrationError("measurements", problem)
        estimation = Estimation(measurements, space, check_count=False)
        means = estimation.means
        if len(means.kind) > MOST_READINGS:
            problem = f"{len(means.kind)} readings at distinct places are too many for a check"
            raise CalibrationError("measurements", f"{problem} (at most {MOST_READINGS}); fit a model to them")
        linear, _ = estimation.linearise(fitted.x if x is None else x, np.ones(len(measurements)), unsettled=False)
        free, sizes, _ = np.linalg.svd(linear.free_of_nuisance(np.eye(len(means.kind))))
        seen = free[:, sizes > ROUNDING * sizes.max(initial=0.0)].T
        if not len(seen):
            problem = "determine nothing: the runs' unknown zeros explain all readings; read more places in each run"
            raise CalibrationError("measurements", problem)
        rows, sigma = seen @ space.unwhitened(linear.rows.dense()), reading_noise(fitted)[means.kind]
        m = measurements
        names = tuple(f"{m.sources[n]}: {CHANNELS[m.channel[n]]} of run {m.runs[m.run[n]].name}" for n in means.first)
        precision = estimation.uncertainty**-2
        scale = np.sqrt(np.bincount(means.of_reading, precision))
        entries = precision / scale[means.of_reading], (means.of_reading, np.arange(len(m)))
        weights = csr_array(entries, shape=(len(scale), len(m)))
        residuals = seen @ linear.target - rows @ fitted.x
        noise, prediction = (seen * sigma**2) @ seen.T, predict(space, fitted.x, m.stations)
        gains, *deviations = estimation.of_unsettled(fitted.x, prediction)
        if (ends := gains * np.hypot(*deviations)).any():
            # Readings of one station share an error: a strut stays at one end of its lost motion and its backlash
            at = means.station[:, None] == np.unique(means.station)
            ends = np.einsum("cn,cs->cns", at, ends).reshape(len(means.kind), -1)
            unsettled = seen @ linear.free_of_nuisance(ends)
            noise += unsettled @ unsettled.T

        def loaded(change: np.ndarray) -> np.ndarray:
            moved = predict(with_payload_change(space, change), fitted.x, m.stations).errors - prediction.errors
            of_means = (means.directions * moved[means.station]).sum(axis=1)
            return seen @ linear.free_of_nuisance(of_means[:, None])[:, 0]

        return CheckReadings(
            residuals,
            rows,
            noise,
            seen * sigma,
            names,
            seen,
            means.kind,
            weights,
            loaded if prediction.load.lost_motion.any() else None,
        )

    def changed_by(self, values: np.ndarray) -> CheckReadings:
        """Return the check with `values` (N,) added to its readings, whose kinds must all be in LINE_KINDS."""
        return replace(self, residuals=self.residuals + self.seen @ (self.weights @ values))

    def covariance(self, of_parameters: np.ndarray) -> np.ndarray:
        return self.noise + self.rows @ of_parameters @ self.rows.T

    def chi_square(self, of_parameters: np.ndarray | float = 0.0) -> float:
        """Return χ² / n of the residuals for this covariance of the parameters (0: the parameters are exact)."""
        covariance = self.noise if np.isscalar(of_parameters) else self.covariance(np.asarray(of_parameters))
        return float(self.residuals @ np.linalg.solve(covariance, self.residuals)) / len(self.residuals)

    def log_density(self, of_parameters: np.ndarray, residuals: np.ndarray | None = None) -> float:
        """Return the log density of `residuals`, by default those of the check, for an unchanged machine."""
        covariance, r = self.covariance(of_parameters), self.residuals if residuals is None else residuals
        square = float(r @ np.linalg.solve(covariance, r))
        return -0.5 * (square + float(np.linalg.slogdet(covariance)[1]) + len(r) * math.log(2.0 * math.pi))

    @property
    def freedom(self) -> np.ndarray:
        """Degrees of freedom (kinds,) of each kind of channel; their sum is the number of contrasts."""
        return np.bincount(self.kind, (self.seen**2).sum(axis=0), len(KINDS))

    def effects(self, changes: Sequence[Change], of_parameters: np.ndarray) -> Iterator[tuple[Change, np.ndarray]]:
        """Yield all `changes` and :func:`wrong_readings`, with their derivatives (n, k) of the contrasts by sizes θ."""
        for change in changes:
            effect = self.rows @ change.columns
            if change.family == PAYLOAD and self.loaded is not None:
                effect = self._secant(change, effect, self.covariance(of_parameters), self.loaded)
            yield change, effect
        yield from wrong_readings(self.single, self.names)

    def _secant(
        self, change: Change, slope: np.ndarray, covariance: np.ndarray, exact: Callable[[np.ndarray], np.ndarray]
    ) -> np.ndarray:
        """Return `slope`, ∂contrasts/∂θ (n, k), corrected (Broyden): slope · θ = `exact`(θ) at the most probable θ.

        Nelder and Mead's method finds the most probable θ from the best of several starts, because the likelihood has
        steps and several maxima where the force of a strut changes its sign.
        """
        inverse, most = np.linalg.inv(covariance), float(change.scales.max())

        def minus_twice_log(theta: np.ndarray) -> float:
            residuals = self.residuals - exact(theta)
            return float(residuals @ inverse @ residuals + theta @ theta / most**2)

        weighted = slope.T @ inverse
        starts = [np.linalg.solve(weighted @ slope + np.eye(len(weighted)) / most**2, weighted @ self.residuals)]
        first = np.eye(len(weighted))[0]
        starts += [way * size * first for size in (*change.scales, 0.5 * most) for way in (-1.0, 1.0)]
        best = min(starts, key=minus_twice_log)
        simplex = best + np.vstack([np.zeros(len(best)), np.eye(len(best))])
        theta = minimize(
            minus_twice_log, best, method="Nelder-Mead",
            options={"initial_simplex": simplex, "xatol": 0.05, "fatol": 0.5, "maxfev": 150},
        ).x  # fmt: skip
        return slope + np.outer(exact(theta) - slope @ theta, theta) / (theta @ theta)


def wrong_readings(single: np.ndarray, names: Sequence[str]) -> Iterator[tuple[Change, np.ndarray]]:
    """Yield changes and their effect on the contrasts: each mean reading alone is wrong; then, all scatter more."""
    for name, column in zip(names, single.T, strict=True):
        yield Change(READING, name, np.array(ASSUMED.wrong_reading)), column[:, None]
    yield Change(OTHER, "larger scatter of all readings", np.array(ASSUMED.scattered), group="scatter"), single


@dataclass(frozen=True)
class Hypothesis:
    """The effect of a change on the whitened contrasts z of check readings; z ~ N(0, 1) if the machine is unchanged."""

    change: Change
    directions: np.ndarray  # (n, k): orthonormal directions of z that the change moves
    gains: np.ndarray  # (k,): change of z along each direction, per unit of θ
    least_gain: float  # smallest |change of z| by any θ of length 1
    log_prior: float  # log prior probability of the change with one of its scales

    @staticmethod
    def of(change: Change, effect: np.ndarray, log_prior: float) -> Hypothesis:
        if effect.shape[1] == 1:  # most changes have a single column, which needs no decomposition
            gains = np.linalg.norm(effect, axis=0)
            directions = effect / np.maximum(gains, ROUNDING)  # a gain below ROUNDING is dropped below
        else:
            directions, gains, _ = np.linalg.svd(effect, full_matrices=False)
        kept = gains > ROUNDING * max(gains.max(initial=0.0), 1.0)
        least = float(gains.min(initial=np.inf)) if kept.sum() == effect.shape[1] else 0.0
        return Hypothesis(change, directions[:, kept], gains[kept], least, log_prior)

    def log_bayes_factors(self, z: np.ndarray) -> np.ndarray:
        """Return log(p(z | change) / p(z | no change)), (N, m), for each row of `z` and each of the m `change.scales`.

        Each row of `z` (N, n) has the whitened contrasts of one check.
        """
        grown = np.outer(self.change.scales**2, self.gains**2)
        along = (z @ self.directions) ** 2
        return 0.5 * (along @ (grown / (1.0 + grown)).T - np.log1p(grown).sum(axis=1))


class Evidence:
    """Bayes factors of changes, from their `effects` and the `covariance` of an unchanged machine's residuals."""

    def __init__(self, covariance: np.ndarray, effects: Iterable[tuple[Change, np.ndarray]]) -> None:
        self._whitening = np.linalg.inv(np.linalg.cholesky(covariance))
        self.hypotheses, self.effects = [], list(effects)
        groups = Counter((change.family, change.group) for change, _ in self.effects)
        in_kind = Counter(family for family, _ in groups)
        odds = dict(ASSUMED.prior_odds)
        for change, effect in self.effects:
            alike = in_kind[change.family] * groups[change.family, change.group] * len(change.scales)
            log_prior = float(np.log(odds[change.family] / sum(odds.values()) / alike))
            self.hypotheses.append(Hypothesis.of(change, self._whitening @ effect, log_prior))

    def log_weights(self, residuals: np.ndarray) -> list[np.ndarray]:
        """Return per change log(prior · Bayes factor) of its m sizes, (N, m), for `residuals` (N, n) of N checks."""
        return self._of_whitened(residuals @ self._whitening.T)

    def log_evidence(self, residuals: np.ndarray) -> float:
        """Return log(p(residuals | change with probability 1/2) / p(residuals | no change))."""
        weights = np.concatenate(self.log_weights(residuals[None]), axis=1)[0]
        return float(np.logaddexp.reduce([0.0, *weights])) - math.log(2.0)

    def _of_whitened(self, z: np.ndarray) -> list[np.ndarray]:
        return [h.log_bayes_factors(z) + h.log_prior for h in self.hypotheses]

    def _odds(self, z: np.ndarray) -> np.ndarray:  # log odds of a change, (N,), for each row of `z`
        return np.asarray(np.logaddexp.reduce(np.concatenate(self._of_whitened(z), axis=1), axis=1))

    @cached_property
    def _unchanged(self) -> np.ndarray:  # log odds of a change in simulated checks of an unchanged machine, ascending
        z = np.random.default_rng(11).standard_normal((UNCHANGED_DRAWS, len(self._whitening)))
        return np.sort(self._odds(z))

    def p_value(self, residuals: np.ndarray) -> float:
        """Return the share of simulated checks of an unchanged machine with at least this check's odds of a change."""
        odds = self._odds((self._whitening @ residuals)[None])
        return float(1 + (self._unchanged >= odds).sum()) / (1 + UNCHANGED_DRAWS)

    def detectable(self, hypothesis: Hypothesis, false_alarms: float) -> float:
        """Return the size |θ| from which at most the share `false_alarms` of changes remains undetected.

        The change moves z in the direction in which θ moves it least. Log odds are convex and even in z, so they grow
        along this direction, and noise across it does not lower them on average: only noise along it, of σ = 1, hides
        the change. Infinite if the readings miss some change of this kind.
        """
        higher = math.floor(false_alarms * (1 + UNCHANGED_DRAWS)) - 1  # draws with higher odds than a detected check
        if higher < 0 or not hypothesis.least_gain > 0.0:
            return math.inf
        limit, least, end = self._unchanged[-1 - higher], hypothesis.directions[:, -1:].T, 1.0

        def beyond(moved: float) -> float:
            return float(self._odds(moved * least)[0] - limit)

        while beyond(end) < 0.0:
            end *= 2.0
        moved = brentq(beyond, 0.0, end, xtol=1e-3) - ndtri(false_alarms)
        return max(float(moved), 0.0) / hypothesis.least_gain


@dataclass(frozen=True)
class Explanation:
    """Posterior of parameters − fitted parameters, given a check and the hypothesis that one change happened."""

    mean: np.ndarray  # (size,), SI
    covariance: np.ndarray  # (size, size), SI

    @staticmethod
    def of(check: CheckReadings, fitted: FittedParameters, change: Change | None, scale: float = 0.0) -> Explanation:
        """Return the posterior if the machine has made a `change` (None: none); θ of the change has the σ `scale`."""
        prior = fitted.covariance
        if change is not None and change.columns is not None:
            prior = prior + scale**2 * change.columns @ change.columns.T
        reached = check.rows @ prior
        gain = np.linalg.solve(check.covariance(prior), reached).T
        return Explanation(gain @ check.residuals, prior - gain @ reached)
