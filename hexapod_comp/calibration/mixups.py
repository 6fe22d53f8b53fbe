"""Search for mix-ups: mistakes in a file of readings, such as a wrong sign, unit, label or frame.

A mix-up is reported if p(corrected readings) / p(readings in the file), a ratio of marginal likelihoods with the same
blocks, exceeds ASSUMED.mixup_odds. Only larger machine errors, which are less probable, explain wrong readings.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import cached_property, partial
from itertools import pairwise, product
from typing import NamedTuple

import numpy as np

from ..errors import HexapodError
from ..machine.arrays import rms
from ..machine.geometry import STRUT_NAMES
from ..machine.struts import turns_of_screws
from ..machine.temperatures import REFERENCE_TEMPERATURE, STEEL
from ..measurements.readings import AXES, CHANNELS, KINDS, UNKNOWN, MeasurementSet
from .assumptions import ASSUMED
from .blocks import EXPECTED, MAPS
from .estimator import (
    FEW_ROUNDS,
    ROUNDS,
    DesignMatrix,
    Estimation,
    Further,
    LinearProblem,
    Posterior,
    log_evidence,
    solve,
)
from .mistakes import Mistake, family_of_run, mistakes_of_poses, mistakes_of_values, sign_reversed
from .observations import Nuisance
from .parameters import TOLERANCES, Components, FitSettings, ParameterSpace
from .sensitivity import Prediction, Slopes, predict

MOST_READINGS = 2500  # largest number of readings, at random stations, with which mistakes are compared
FEW_READINGS = 400  # largest number of readings, of random runs, that preselect mistakes in the poses
FINALISTS = 6  # number of preselected mistakes that are compared with converged tolerances and noise
LEAST_DETERMINED = 1.0  # a principal component is kept if information from readings / from the prior exceeds this
ALTERNATIONS = 3  # estimates, in turn, of a common error and the tolerances; of direction labels and the model
ONLY_CHANCE = 0.2
"""Upper bound of the mean of max(0, r), with r the log likelihood ratio for reversing a correct direction label: for a
backlash of m standard deviations it is 2m(φ(m) − mΦ(−m)), which is largest at m = 0.6.
"""

SWAPPED = "forward and backward look swapped, or the sign of all readings reversed"
UNIT = {"mm": 1e-3, "mrad": 1e-3, "ppm": 1e-6}
SCALED = ("linear", "length", "position")
"""A wrong scale of an instrument changes the readings of these kinds of channel."""

FORCE = "correct the cause; if the machine really has this error, write the model with --force"
SAME_UNITS = np.ones(len(KINDS))
NO_FIT = (HexapodError, np.linalg.LinAlgError)  # errors of a fit to impossible readings


class Alternative(NamedTuple):
    """A possible mistake in the file."""

    gain: float  # log Bayes factor: log(p(corrected readings) / p(readings in the file))
    text: str  # for example "x lines, linear: sign reversed fits 29.8 times better"


class CommonError(NamedTuple):
    """An error with one cause, such as a wrong tool length, that changes all readings; its amplitude ~ N(0, σ²)."""

    name: str
    causes: str  # probable causes and remedy, for the report
    unit: str  # of the amplitude in the report: a key of UNIT
    effect: np.ndarray  # (C,): change of the mean readings by an amplitude of 1, SI
    usual: float  # σ without a mistake, SI
    block: str = ""  # if given, σ without a mistake is at least the fitted tolerance of this block


def mixups(
    everything: Estimation, blocks: Collection[str], progress: Callable[[str], object] = lambda text: None
) -> list[str]:
    """Return report lines on the most probable mix-up and on those at most ASSUMED.mixup_odds times less probable.

    `everything` has the readings and all parameters that the settings allow; `blocks` names the blocks that the fit has
    kept. A mix-up is not reported if a fit that its comparison needs fails.
    """
    progress("checking the readings for mix-ups of signs, units, labels and frames")
    # A fit to wrong readings may have dropped errors that every machine has
    blocks = {*blocks, *(name for name in EXPECTED if everything.space.block(name))}
    space, found = everything.space, list(_left_handed(everything))
    comparisons = list[Callable[[], Iterable[Alternative]]]()
    with suppress(*NO_FIT):
        described = ParameterSpace((space.geometry, space.region), replace(space.settings, blocks=tuple(blocks)))
        model = _Fitted(Estimation(_some_stations(everything.measurements), described, check_count=False))
        noisy = (model.posterior.noise[model.kinds] >= ASSUMED.misfit[0]).any()
        comparisons += [model.common_errors, model.other_directions]
        if noisy or (blocks & set(MAPS) and not model.compensated):
            # Otherwise structure and screws alone describe the readings within their noise: signs and units are right.
            # Struts that compensation has moved show the machine's errors, and the small errors that they leave change
            # the evidence by chance only, or favour a larger unit
            comparisons.append(model.mistakes)
    for compare in comparisons:
        with suppress(*NO_FIT):
            found += compare()
    best = max((other.gain for other in found), default=0.0)
    odds = np.log(ASSUMED.mixup_odds)
    named = [other for other in found if other.gain > max(odds, best - odds)]
    return [other.text for other in sorted(named, key=lambda other: -other.gain)]


def _left_handed(estimation: Estimation) -> Iterator[Alternative]:
    """Yield the mistake that trackers' coordinates are left-handed, with the machine's errors as noise of unknown size.

    No rotation of a tracker's frame corrects this mistake.
    """
    m, gain, count, wrong = estimation.measurements, 0.0, 0, list[str]()
    largest = ASSUMED.mistaken * estimation.space.start_tolerances()[0]
    for rows, as_read, mirrored in estimation.means.mirrored(m, estimation.frames):
        if mirrored < min(as_read, largest):
            gain += rows.size * np.log(as_read / mirrored)
            count += rows.size
            wrong += [m.runs[n].name for n in np.unique(m.run[rows])]
    if wrong:
        name = f"coordinates of {_some_names(wrong)}: left-handed, since an axis is mirrored or two are exchanged,"
        yield Alternative(gain, f"{name} fits {np.exp(gain / count):.3g} times better")


def _some_names(names: Sequence[str]) -> str:
    return ", ".join(names[:3]) + (", …" if len(names) > 3 else "")


class _Amplitude(NamedTuple):
    """The most probable amplitude of a common error."""

    value: float  # SI
    deviation: float  # σ of its prior, SI
    evidence: float  # log evidence of the readings with this error


class _Fitted:
    """A file's readings, linearised at the nominal machine, and their comparison with corrected readings.

    The parameters of each block are replaced by those principal components that readings determine better than the
    prior does. A block's prior is isotropic, so all its components have the same prior σ.
    """

    def __init__(self, estimation: Estimation, bases: dict[str, np.ndarray] | None = None) -> None:
        self.estimation, self.space = estimation, estimation.space
        nominal = np.zeros(self.space.size)
        # Without the variance of unsettled struts, which depends on the poses: all corrections need the same noise
        problem, _ = estimation.linearise(nominal, np.ones(len(estimation.measurements)), unsettled=False)
        self.bases = _principal(self.space, problem) if bases is None else bases
        ends = np.cumsum([0, *(self._basis(n).shape[1] for n in range(len(self.space.blocks)))]).tolist()
        parts = tuple(slice(start, stop) for start, stop in pairwise(ends))
        self.components = Components(parts, self.space.start_tolerances(), self.space.stated)
        self.problem = _replaced(problem, problem.target, SAME_UNITS, self._reduced(problem.rows.dense()))
        self.kinds = np.unique(problem.kind)

    @cached_property
    def posterior(self) -> Posterior:
        """Posterior with converged tolerances and noise."""
        return solve(self.components, self.problem, self.components.first, SAME_UNITS, ROUNDS)

    @cached_property
    def early(self) -> Posterior:
        """Posterior after FEW_ROUNDS updates of tolerances and noise."""
        return solve(self.components, self.problem, self.components.first, SAME_UNITS, FEW_ROUNDS)

    @cached_property
    def rows(self) -> np.ndarray:
        """Derivatives, (C, n), of C mean readings / stated σ by n principal components, with unknowns projected out."""
        return self.problem.rows.dense()

    @cached_property
    def _values(self) -> np.ndarray:
        """The C mean readings in the file, divided by the stated σ, with the instruments' unknowns projected out."""
        return self.problem.free_of_nuisance(self._averaged(self.estimation.measurements.value)[:, None])[:, 0]

    @property
    def compensated(self) -> bool:
        """Whether the tool errors that were read are less than half of those that the nominal struts would cause."""
        return rms(self._values) < 0.5 * rms(self.problem.target)

    @cached_property
    def _slopes(self) -> Slopes:
        stations = self.estimation.measurements.stations
        return Slopes(self.space, self._prediction, stations, whitened=True)

    @cached_property
    def _prediction(self) -> Prediction:
        return predict(self.space, np.zeros(self.space.size), self.estimation.measurements.stations)

    @cached_property
    def _unprojected(self) -> tuple[np.ndarray, np.ndarray]:
        """Directions (C, 6) of the mean readings, and :attr:`rows` before instruments' unknowns are projected out."""
        directions = self._reinterpreted(self.estimation.measurements)[0]
        return directions, self._along(np.arange(len(directions)), directions)

    def _basis(self, block: int) -> np.ndarray:
        """Return the principal components of a block, as columns; if `bases` has none of its size, the identity."""
        name, size = self.space.blocks[block].name, len(self.space.blocks[block].labels)
        basis = self.bases.get(name, np.eye(size))
        return basis if len(basis) == size else np.eye(size)

    def _reduced(self, rows: np.ndarray) -> np.ndarray:
        """Convert derivatives by the parameters (C, size) to derivatives by the principal components (C, n)."""
        return np.hstack([rows[:, block.part] @ self._basis(n) for n, block in enumerate(self.space.blocks)])

    def _along(self, means: np.ndarray, directions: np.ndarray) -> np.ndarray:
        """Return the derivatives, by the components, that `means` / stated σ would have if read along `directions`."""
        rows = np.empty((len(means), self.space.size))
        along = self.problem.scale[means, None] * directions
        self._slopes.write(rows, self.estimation.means.station[means], along, np.arange(6))
        return self._reduced(rows)

    def _reinterpreted(self, corrected: MeasurementSet) -> tuple[np.ndarray, np.ndarray, list[Nuisance]]:
        """Return the corrected readings' directions (C, 6), target (C,) of the fit, and the instruments' unknowns."""
        e = self.estimation
        directions, values = corrected.directions()[e.means.first], self._averaged(corrected.value)
        errors = self._prediction.errors[e.means.station]
        expected, unknowns = e.unknowns(directions, errors, values, self.problem.scale)
        target = self.problem.scale * (values - expected)
        for part in unknowns:
            part.project_out(target)
        return directions, target, unknowns

    def _corrected_problems(self, wrong: Sequence[Mistake]) -> Iterator[tuple[Mistake, LinearProblem]]:
        """Yield mistakes that do not concern the poses, each with the linear problem of the corrected readings.

        To save time, only rows of changed channels are computed anew, and instruments' unknowns are projected out of
        all changed values at once.
        """
        m, in_file = self.estimation.measurements, self._averaged(self.estimation.measurements.value)
        sets = [mistake.corrected() for mistake in wrong]
        quick = [s is not None and s.channel is m.channel and self.estimation.fixed_unknowns for s in sets]
        changes = [self._averaged(s.value) - in_file for s, values in zip(sets, quick, strict=True) if s and values]
        cleared = self.problem.free_of_nuisance(np.column_stack(changes)) if changes else np.zeros((len(in_file), 0))
        targets = iter((self.problem.target[:, None] + cleared).T)
        for mistake, corrected, values in zip(wrong, sets, quick, strict=True):
            if values:
                yield mistake, _replaced(self.problem, next(targets), mistake.factor)
            elif corrected is not None:
                try:
                    directions, target, unknowns = self._reinterpreted(corrected)
                except HexapodError:
                    continue
                directions_in_file, rows_in_file = self._unprojected
                rows, changed = rows_in_file.copy(), np.flatnonzero((directions != directions_in_file).any(axis=1))
                if len(changed):
                    rows[changed] = self._along(changed, directions[changed])
                for unknown in unknowns:
                    unknown.project_out(rows)
                yield mistake, _replaced(self.problem, target, mistake.factor, rows if len(changed) else None)

    def _compared(
        self, mistake: Mistake, problem: LinearProblem, components: Components, early: bool = False
    ) -> Alternative:
        """Compare the file with its correction, to which `problem` is the linearised fit; gain −∞: not plausible.

        The fit to corrected readings starts from the first guess of tolerances and noise, because the mistake has
        enlarged the fitted ones. With `early`, both fits stop after FEW_ROUNDS updates of tolerances and noise.
        """
        in_file, rounds = (self.early, FEW_ROUNDS) if early else (self.posterior, ROUNDS)
        try:
            tried = solve(components, problem, components.first, SAME_UNITS, rounds)
        except NO_FIT:
            return Alternative(-np.inf, "")
        structure = max(ASSUMED.mistaken * components.first[0], in_file.tolerances[0])
        if tried.tolerances[0] > structure:
            return Alternative(-np.inf, "")  # no machine has joints so far off as the corrected readings show
        of_values = components is self.components
        if of_values and self._noise_alone(problem, mistake.factor, tried.noise):
            return Alternative(-np.inf, "")
        # The density of corrected values times this Jacobian is a density of the values in the file
        jacobian = float(problem.freedom[self.kinds] @ np.log(mistake.factor[self.kinds]))
        gain = log_evidence(problem, tried) + jacobian - log_evidence(self.problem, in_file) - mistake.choices
        # Noise before / after the correction, of the kind that improves most
        better = float((in_file.noise * mistake.factor / tried.noise)[self.kinds].max())
        fits = f"{better:.3g} times better" if better > 1.005 else "equally well, with smaller errors of the machine"
        return Alternative(gain, f"{mistake.name} fits {fits}")

    def _noise_alone(self, problem: LinearProblem, factor: np.ndarray, noise: np.ndarray) -> bool:
        """Return whether the values that a correction changes are, once corrected, at most their `noise` (RMS).

        Values within their noise, of a compensated machine for example, show no mistake: their residuals come from the
        strut readings and do not grow when the values are multiplied, so any larger unit would seem to fit better.
        """
        changed = ~np.isclose(problem.target, self.problem.target)
        return bool(changed.any()) and rms((self._values * (factor / noise)[problem.kind])[changed]) <= 1.0

    def mistakes(self) -> list[Alternative]:
        """Return the FINALISTS most probable mistakes in values or poses, each compared with the file as it is."""
        tried = list[tuple[float, Mistake, LinearProblem, Components]]()
        with suppress(*NO_FIT):
            tried += self._mistakes_of_poses()
        wrong = [*mistakes_of_values(self.estimation.measurements), *self._runs_reversed()]
        for mistake, problem in self._corrected_problems(wrong):
            gain = self._compared(mistake, problem, self.components, early=True).gain
            tried.append((gain, mistake, problem, self.components))
        best = sorted((t for t in tried if t[0] > 0.0), key=lambda t: -t[0])[:FINALISTS]
        return [self._compared(mistake, problem, components) for _, mistake, problem, components in best]

    def _mistakes_of_poses(self) -> Iterator[tuple[float, Mistake, LinearProblem, Components]]:
        """Yield probable mistakes in the poses, each with its estimated gain and the linearised fit to its correction.

        Fits to some of the runs preselect the mistakes; their gain is multiplied by all readings / readings of these
        runs. These fits have no length maps and no error field, which could describe the effect of wrong poses.
        """
        m = self.estimation.measurements
        screws = replace(self.space.settings, blocks=tuple(b for b in self.space.settings.blocks if b not in MAPS))
        few = _some_runs(m)
        in_file = _fitted(few, screws, {})
        if (in_file.early.noise[in_file.kinds] < ASSUMED.misfit[0]).all():
            return  # the readings agree with the poses in the file within their noise
        for mistake, of_all_runs in zip(mistakes_of_poses(few), mistakes_of_poses(m), strict=True):
            with suppress(*NO_FIT):
                if (corrected := mistake.corrected()) is None:
                    continue
                fitted = _fitted(corrected, screws, {})
                gain = log_evidence(fitted.problem, fitted.early) - log_evidence(in_file.problem, in_file.early)
                if gain > np.log(ASSUMED.mixup_odds) and (corrected := of_all_runs.corrected()) is not None:
                    whole = _fitted(corrected, self.space.settings, self.bases)
                    yield gain * len(m) / len(few), mistake, whole.problem, whole.components

    def common_errors(self) -> Iterator[Alternative]:
        """Yield common errors that are far larger than usual, such as a wrong tool length.

        An error of effect d and amplitude ~ N(0, σ²) raises the log evidence by ½h²σ²/(1 + σ²I) − ½log(1 + σ²I), with
        h = dᵀK⁻¹t, I = dᵀK⁻¹d, target t, and K the covariance of t without the error. The gain is the log evidence with
        the σ of a mistake, ASSUMED.mistaken times the usual σ, minus the log evidence with the usual σ.
        """
        errors = list(possible_common_errors(self.estimation, self.problem))
        effects = self.problem.free_of_nuisance(np.column_stack([error.effect for error in errors]))
        # A large error enlarges the estimated tolerances, and so looks usual: try the first tolerances too
        first_guess = solve(self.components, self.problem, self.components.first, self.posterior.noise, rounds=0)
        suspect = self._suspect(effects, errors, self.posterior) | self._suspect(effects, errors, first_guess)
        for n in np.flatnonzero(suspect):
            error, effect = errors[n], effects[:, n]
            usual, posterior = self._alternating_fit(effect, error, 1.0, self.posterior)
            if abs(usual.value) < usual.deviation:
                continue
            # Tolerances are estimated for each σ, as a larger tolerance can explain an error that moves a whole block
            mistaken, without = self._alternating_fit(effect, error, ASSUMED.mistaken, posterior)
            # The tolerances estimated with the mistake's σ may give a larger evidence for the usual σ than its own
            usual = max(usual, self._amplitude_fit(effect, error, 1.0, without), key=lambda fit: fit.evidence)
            amplitude = mistaken.value / UNIT[error.unit]
            times = abs(mistaken.value) / usual.deviation
            text = f"{error.name}: {amplitude:+.3g} {error.unit}, {times:.1f} times the usual size: {error.causes}"
            yield Alternative(mistaken.evidence - usual.evidence, text)

    def _alternating_fit(
        self, effect: np.ndarray, error: CommonError, times: float, p: Posterior
    ) -> tuple[_Amplitude, Posterior]:
        """Estimate in turn the amplitude of `error` (prior σ multiplied by `times`), and tolerances and noise."""
        for _ in range(ALTERNATIONS):
            fit = self._amplitude_fit(effect, error, times, p)
            without = _replaced(self.problem, self.problem.target - fit.value * effect)
            p = solve(self.components, without, p.tolerances, p.noise, FEW_ROUNDS)
        return self._amplitude_fit(effect, error, times, p), p

    def _suspect(self, effects: np.ndarray, errors: list[CommonError], posterior: Posterior) -> np.ndarray:
        """Return which of `errors` have an amplitude, under the wide prior of a mistake, of at least their usual σ."""
        of_errors = Further.of(self.problem, posterior, effects)
        tolerances = dict(zip([b.name for b in self.space.blocks], posterior.tolerances, strict=True))
        usual = np.array([max(error.usual, tolerances.get(error.block, error.usual)) for error in errors])
        precision = (ASSUMED.mistaken * usual) ** -2.0
        return np.asarray(np.abs(of_errors.moment) >= usual * (precision + np.diag(of_errors.information)))

    def _amplitude_fit(self, effect: np.ndarray, error: CommonError, times: float, posterior: Posterior) -> _Amplitude:
        """Fit `error` with `times` its prior σ without a mistake, at the tolerances and noise of `posterior`."""
        plain = solve(self.components, self.problem, posterior.tolerances, posterior.noise, rounds=0)
        tolerances = dict(zip([b.name for b in self.space.blocks], plain.tolerances, strict=True))
        deviation = times * max(error.usual, tolerances.get(error.block, error.usual))
        found = Further.of(self.problem, plain, deviation * effect[:, None])
        return _Amplitude(deviation * float(found.mean[0]), deviation, log_evidence(self.problem, plain) + found.gain)

    def other_directions(self) -> list[Alternative]:
        """Compare the file with a copy in which labels that look wrong are reversed; [] if no label looks wrong.

        Readings that the fitted backlash makes more probable with the opposite label are relabelled, and the model is
        fitted again, because wrong labels make the fitted backlash too small. As any of n
        labels may be wrong, log(2ⁿ) is subtracted from the gain.
        """
        m = self.estimation.measurements
        if self.space.block("backlash") is None or not (m.direction != UNKNOWN).any():
            return []
        order = np.lexsort((m.channel, m.station, m.run))
        key = np.column_stack([m.run, m.station, m.channel])[order]
        start = np.flatnonzero(np.r_[True, (np.diff(key, axis=0) != 0).any(axis=1)])
        repeat = np.empty(len(m), dtype=int)  # number of earlier readings of this channel here
        repeat[order] = np.arange(len(m)) - np.repeat(start, np.diff(np.r_[start, len(m)]))
        groups, group = np.unique(np.column_stack([m.run, m.station, repeat]), axis=0, return_inverse=True)
        known = m.direction != UNKNOWN
        flipped, model = np.zeros(len(groups), dtype=bool), self
        for _ in range(ALTERNATIONS):
            ratio = np.bincount(group.ravel(), known * model._reversal_ratio())
            if np.maximum(ratio, 0.0).sum() < np.log(ASSUMED.mixup_odds) + ONLY_CHANCE * len(groups):
                break
            flipped ^= ratio > 0.0
            if 2 * flipped.sum() > len(flipped):  # most labels are right; whether all are wrong, fit.py tests
                flipped = ~flipped
            try:
                turned = flipped[group.ravel()]
                # Every station a second time, with the opposite direction of motion
                twice = m.stations.select(np.tile(np.arange(len(m.stations)), 2))
                senses = twice.sense * np.repeat([1.0, -1.0], len(m.stations))[:, None]
                station = m.station + len(m.stations) * turned
                direction = np.where(turned, -m.direction, m.direction)
                other = replace(m, stations=replace(twice, sense=senses), station=station, direction=direction)
                model = _Fitted(Estimation(other, self.space, check_count=False), self.bases)
            except NO_FIT:
                return []
        if model is self:
            return []
        counts = f"direction of {int(flipped.sum())} of {len(flipped)} readings: forward and backward exchanged"
        relabelled = Mistake(counts, lambda: other, choices=len(groups) * np.log(2.0))
        return [self._compared(relabelled, model.problem, model.components)]

    def _reversal_ratio(self) -> np.ndarray:
        """Return log(p(reading | opposite direction label) / p(reading | its direction label)) for N readings."""
        m, c, p = self.estimation.measurements, self.estimation.means, self.posterior
        backlash = next(
            part for b, part in zip(self.space.blocks, self.components.parts, strict=True) if b.name == "backlash"
        )
        moved = (self.rows[:, backlash] @ p.y[backlash] / self.problem.scale)[c.of_reading]
        residuals = ((self.problem.target - self.rows @ p.y) / self.problem.scale)[c.of_reading]
        residuals = residuals + m.value - self._averaged(m.value)[c.of_reading]
        sigma = self.estimation.uncertainty * p.noise[m.kind]
        return 0.5 * (residuals**2 - (residuals + 2.0 * moved) ** 2) / sigma**2

    def _runs_reversed(self) -> Iterator[Mistake]:
        """Yield the most probable set of runs with reversed signs, for all channels and for each channel alone.

        The log evidence is a quadratic function of the vector that has 1 for each reversed run and 0 for all others.
        """
        m, means = self.estimation.measurements, self.estimation.means
        groups, group = np.unique(np.stack([m.run[means.first], means.channel]), axis=1, return_inverse=True)
        group = group.ravel()
        change = np.zeros((len(group), groups.shape[1]))
        change[np.arange(len(group)), group] = -2.0 * self._averaged(m.value)
        change = self.problem.free_of_nuisance(change)
        further = Further.of(self.problem, self.posterior, change)
        family, channels = family_of_run(m), np.unique(groups[1])
        names = [("", np.ones(groups.shape[1], dtype=bool))]
        names += [(f"{CHANNELS[c]} of ", groups[1] == c) for c in channels if len(channels) > 1]
        for what, members in names:
            by_run = np.zeros((groups.shape[1], len(m.runs)))
            by_run[np.arange(groups.shape[1]), groups[0]] = members
            runs = np.flatnonzero(by_run.any(axis=0))
            chosen = self._most_probable(further, by_run[:, runs], family[runs])
            if not what and 2.0 * chosen.sum() > len(runs):  # the other runs fit equally well
                chosen = 1.0 - chosen
            # Reversed whole families are tried elsewhere
            if any(np.ptp(chosen[family[runs] == n]) for n in np.unique(family[runs])):
                listed = [m.runs[n].name for n in runs[chosen > 0.0]]
                flipped = (by_run[:, runs] @ chosen)[group][means.of_reading] > 0.0
                name = f"{what}{len(listed)} of {len(runs)} runs ({_some_names(listed)}): sign reversed"
                yield Mistake(name, partial(sign_reversed, m, flipped), choices=len(runs) * np.log(2.0))

    def _most_probable(self, further: Further, by_run: np.ndarray, family: np.ndarray) -> np.ndarray:
        """Find by coordinate descent the most probable set of reversed runs; return 1 for reversed, 0 for others."""
        present = np.unique(family)
        starts = [np.isin(family, [n for n, way in zip(present, ways, strict=True) if way]).astype(float)
                  for ways in product((0, 1), repeat=len(present))]  # fmt: skip
        linear, square = by_run.T @ further.moment, by_run.T @ further.information @ by_run
        # Also start with every second run reversed, which descent from families misses
        starts += [np.abs(start - np.arange(len(family)) % 2) for start in starts]
        best, least = starts[0], 0.0
        for chosen in starts:
            for _ in range(4 * len(chosen)):
                steps = (1.0 - 2.0 * chosen) * (2.0 * linear + 2.0 * square @ chosen) + np.diag(square)
                n = int(steps.argmin())
                if steps[n] >= 0.0:
                    break
                chosen[n] = 1.0 - chosen[n]
            value = float(2.0 * linear @ chosen + chosen @ square @ chosen)
            if value < least:
                best, least = chosen, value
        return best

    def _averaged(self, values: np.ndarray) -> np.ndarray:
        of_reading, weights = self.estimation.means.of_reading, self.estimation.uncertainty**-2
        return np.bincount(of_reading, weights * values) / np.bincount(of_reading, weights)


def _fitted(m: MeasurementSet, settings: FitSettings, bases: dict[str, np.ndarray]) -> _Fitted:
    return _Fitted(Estimation(m, ParameterSpace(m, settings), check_count=False), bases)


def _principal(space: ParameterSpace, problem: LinearProblem) -> dict[str, np.ndarray]:
    """Return as columns each block's principal components with information / prior information > LEAST_DETERMINED."""
    posterior = solve(space, problem, space.start_tolerances(), SAME_UNITS)
    weights = np.where(np.isin(np.arange(len(KINDS)), problem.kind), posterior.noise**-2.0, 0.0)
    bases = {}
    for block, tolerance in zip(space.blocks, posterior.tolerances, strict=True):
        information = np.tensordot(weights, problem.normal[:, block.part, block.part], 1) * tolerance**2
        values, vectors = np.linalg.eigh(information)
        bases[block.name] = vectors[:, values > LEAST_DETERMINED]
    return bases


def _replaced(
    problem: LinearProblem, target: np.ndarray, factor: np.ndarray = SAME_UNITS, rows: np.ndarray | None = None
) -> LinearProblem:
    """Return the problem with another `target` (C,) and, if given, other `rows` (C, n).

    `factor` (kinds,) multiplies the deviations of repeated readings from their mean.
    """
    square = problem.square.copy()
    for k in np.unique(problem.kind):
        members = problem.kind == k
        scatter = square[k] - problem.target[members] @ problem.target[members]
        square[k] = factor[k] ** 2 * scatter + target[members] @ target[members]
    if rows is None:
        return problem.with_target(target, square)
    return replace(problem, target=target, square=square, rows=DesignMatrix.of(rows))


def _some_stations(m: MeasurementSet) -> MeasurementSet:
    """Return the readings at random stations: at most MOST_READINGS readings, but at least those of one station."""
    order = np.random.default_rng(0).permutation(len(m.stations))
    count = np.cumsum(np.bincount(m.station, minlength=len(m.stations))[order])
    return m.select(np.isin(m.station, order[count <= max(MOST_READINGS, count[0])]))


def _some_runs(m: MeasurementSet) -> MeasurementSet:
    """Return random runs, from each family of lines in turn: one run, and more up to FEW_READINGS readings in all."""
    family, drawn = family_of_run(m), np.random.default_rng(0).permutation(len(m.runs))
    rank = np.array([(family[drawn[:n]] == family[run]).sum() for n, run in enumerate(drawn)])
    order = drawn[np.argsort(rank, kind="stable")]
    count = np.cumsum(np.bincount(m.run, minlength=len(m.runs))[order])
    return m.select(np.isin(m.run, order[count <= max(FEW_READINGS, count[0])]))


def possible_common_errors(estimation: Estimation, problem: LinearProblem) -> Iterator[CommonError]:
    """Yield small rigid motions of tool, platform and base; wrong leads of screws turned by joints; wrong scales."""
    m, means, space = estimation.measurements, estimation.means, estimation.space
    stations, directions = m.stations, means.directions
    points, place = m.points(), max(TOLERANCES["structure"], space.start_tolerances()[0])

    def read(motions: np.ndarray) -> np.ndarray:
        """Return the changes (C,) of the mean readings if the measured point moves by `motions` (M, 6)."""
        return np.einsum("ci,ci->c", directions, motions[means.station])

    turned = stations.rotations @ m.geometry.tool.rotation
    for axis, name in enumerate(AXES):
        along = turned[:, :, axis]
        causes = f"looks like a probe or a tool whose length or offset is wrong in the file; {FORCE}"
        moved = np.hstack([along, np.zeros_like(along)])
        yield CommonError(f"measured point along the tool's {name}", causes, "mm", read(moved), place, "structure")
        causes = f"looks like a target or a tool that is mounted with a rotation, or a wrong zero of angles; {FORCE}"
        lever = np.cross(along, points - stations.positions)
        size = place / m.geometry.characteristic_length
        turning = read(np.hstack([lever, along]))
        yield CommonError(f"platform turned about the tool's {name}", causes, "mrad", turning, size)
        causes = f"looks like a work frame, or an instrument's frame, that differs from the file; {FORCE}"
        still, unit = np.zeros_like(points), np.tile(m.geometry.work.rotation[:, axis], (len(points), 1))
        yield CommonError(f"base moved along {name}", causes, "mm", read(np.hstack([unit, still])), place, "structure")
        about = np.hstack([np.cross(unit, points - m.geometry.work.position), unit])
        yield CommonError(f"base turned about {name}", causes, "mrad", read(about), size)
    if m.geometry.base_axes is not None:
        causes = "looks like a lead of wrong size or sign in the file, wrong joint_axes, or a screw that no joint "
        causes += f"turns (lead 0); {FORCE}"
        turns = turns_of_screws(m.geometry, stations.positions, stations.rotations)
        by_turns = problem.per_length / problem.scale[:, None] * turns[means.station]
        handed = np.where(m.geometry.screw_lead < 0.0, -1.0, 1.0)
        for name, share in (("all screws", handed), *zip(STRUT_NAMES, np.eye(6), strict=True)):
            yield CommonError(f"lead of {name}", causes, "mm", by_turns @ share, ASSUMED.usual_lead)
    warmth = float(np.abs(stations.temperatures - REFERENCE_TEMPERATURE).mean())
    usual = np.hypot(ASSUMED.usual_scale, 0.0 if space.stated_expansion.any() else STEEL * warmth)
    centre = np.nan_to_num(m.centre[means.first])
    for kind in SCALED:
        members = means.kind == KINDS.index(kind)
        away = points[means.station] - (centre if kind == "length" else points.mean(axis=0))
        causes = "looks like a laser without compensation of the air, a temperature other than 20 °C, or a stated lead "
        causes += f"that is wrong for all screws; {FORCE}"
        scaled = np.where(members, np.einsum("ci,ci->c", directions[:, :3], away), 0.0)
        yield CommonError(f"scale of all {kind} readings", causes, "ppm", scaled, usual)
