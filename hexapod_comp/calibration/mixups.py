"""Search for mix-ups: mistakes in a file of readings, such as a wrong sign, unit, label or frame.

A mix-up is reported if p(corrected readings) / p(readings in the file), marginal likelihoods with equal blocks, exceeds
`mixup_odds`: a fit to wrong readings needs more blocks, each of which lowers its likelihood.
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
from ..machine.geometry import STRUT_NAMES
from ..machine.struts import turns_of_screws
from ..machine.temperatures import REFERENCE_TEMPERATURE, STEEL
from ..measurements.readings import AXES, CHANNELS, KINDS, UNKNOWN, MeasurementSet
from .assumptions import ASSUMED
from .blocks import EXPECTED, MAPS
from .blocks.block import Linkage
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

MOST_READINGS = 2500  # at random stations, at most, with which mistakes are compared
FEW_READINGS = 400  # of random runs, at most, that preselect mistakes in the poses
FINALISTS = 6  # mistakes compared with converged tolerances and noise
LEAST_DETERMINED = 1.0  # a component is kept if information from readings / from its prior exceeds this
MODE_ROUNDS = 3  # estimates of a common mode, then tolerances; or of direction labels, then the model
ONLY_CHANCE = 0.2
"""Bound of the mean of max(0, r), with r the log likelihood ratio of reversing a right direction label: for a backlash
of m standard deviations 2m(φ(m) − mΦ(−m)), which is largest at m = 0.6.
"""

SWAPPED = "forward and backward look swapped, or the sign of all readings reversed"
UNIT = {"mm": 1e-3, "mrad": 1e-3, "ppm": 1e-6}
SCALED = ("linear", "length", "position")
"""Kinds of channel that a wrong scale changes."""

FORCE = "correct the cause; if the machine really has this error, write the model with --force"
SAME_UNITS = np.ones(len(KINDS))
NO_FIT = (HexapodError, np.linalg.LinAlgError)  # of a fit to impossible readings


class Alternative(NamedTuple):
    """A possible mistake in the file."""

    gain: float  # log(p(corrected readings) / p(readings in the file))
    text: str  # "x lines, linear: sign reversed fits 29.8 times better"


class Mode(NamedTuple):
    """A common mode: one cause that changes all readings, such as a wrong tool length."""

    name: str
    causes: str  # probable causes and remedy, for the report
    unit: str  # of the amplitude in the report: a key of UNIT
    effect: np.ndarray  # (C,): change of the cells by an amplitude of 1, SI
    usual: float  # standard deviation of the amplitude without a mistake, SI
    block: str = ""  # `usual` is at least this block's fitted tolerance


def mixups(
    everything: Estimation, blocks: Collection[str], progress: Callable[[str], object] = lambda text: None
) -> list[str]:
    """Return report lines on the most probable mix-up, and on mix-ups at most `mixup_odds` times less probable.

    `everything` has all parameters that the settings allow, `blocks` are those of the fit. A comparison that fails is
    omitted.
    """
    progress("checking the readings for mix-ups of signs, units, labels and frames")
    # A fit to wrong readings may have dropped errors that every machine has
    blocks = {*blocks, *(name for name in EXPECTED if everything.space.block(name))}
    space, found = everything.space, list[Alternative]()
    try:
        described = ParameterSpace((space.geometry, space.region), replace(space.settings, blocks=tuple(blocks)))
        model = _Fitted(Estimation(_some_stations(everything.measurements), described, check_count=False))
        noisy = (model.posterior.noise[model.kinds] >= ASSUMED.misfit[0]).any()
    except NO_FIT:
        return []
    comparisons: list[Callable[[], Iterable[Alternative]]] = [model.common_modes, model.other_directions]
    if noisy or blocks & set(MAPS):
        # Else structure and screws describe the readings within their noise: signs and units are right
        comparisons.append(model.mistakes)
    for compare in comparisons:
        with suppress(*NO_FIT):
            found += compare()
    best = max((other.gain for other in found), default=0.0)
    odds = np.log(ASSUMED.mixup_odds)
    named = [other for other in found if other.gain > max(odds, best - odds)]
    return [other.text for other in sorted(named, key=lambda other: -other.gain)]


class _ModeFit(NamedTuple):
    """The most probable amplitude of a common mode."""

    amplitude: float  # SI
    deviation: float  # of its prior, SI
    evidence: float  # log evidence of the readings with this mode


class _Fitted:
    """The linear problem of a file's readings at the nominal machine, compared with problems of corrected readings.

    The parameters of each block are replaced by those principal components on which the readings have more information
    than the prior; the prior of a block is isotropic, so it is also the components' prior.
    """

    def __init__(self, estimation: Estimation, bases: dict[str, np.ndarray] | None = None) -> None:
        self.estimation, self.space = estimation, estimation.space
        nominal = np.zeros(self.space.size)
        # Not the variance of unsettled struts: it depends on the poses, and all corrections need the same noise
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
        """Derivatives of the cells by the components, over the stated noise, free of instruments' unknowns, (C, n)."""
        return self.problem.rows.dense()

    @cached_property
    def _slopes(self) -> Slopes:
        stations = self.estimation.measurements.stations
        return Slopes(self.space, self._prediction, stations, whitened=True)

    @cached_property
    def _prediction(self) -> Prediction:
        return predict(self.space, np.zeros(self.space.size), self.estimation.measurements.stations)

    @cached_property
    def _unprojected(self) -> tuple[np.ndarray, np.ndarray]:
        """Directions of the cells, (C, 6), and `rows` before the instruments' unknowns are projected out."""
        directions = self._reinterpreted(self.estimation.measurements)[0]
        return directions, self._along(np.arange(len(directions)), directions)

    def _basis(self, block: int) -> np.ndarray:
        """Return the principal components of a block, (size, n), or the identity if `bases` has none of its size."""
        name, size = self.space.blocks[block].name, len(self.space.blocks[block].labels)
        basis = self.bases.get(name, np.eye(size))
        return basis if len(basis) == size else np.eye(size)

    def _reduced(self, rows: np.ndarray) -> np.ndarray:
        """Convert derivatives by the parameters, (C, size), to derivatives by the components, (C, n)."""
        return np.hstack([rows[:, block.part] @ self._basis(n) for n, block in enumerate(self.space.blocks)])

    def _along(self, cells: np.ndarray, directions: np.ndarray) -> np.ndarray:
        """Return derivatives by the components, over the stated noise, if `cells` are read along `directions`."""
        rows = np.empty((len(cells), self.space.size))
        along = self.problem.scale[cells, None] * directions
        self._slopes.write(rows, self.estimation.cells.station[cells], along, np.arange(6))
        return self._reduced(rows)

    def _reinterpreted(self, corrected: MeasurementSet) -> tuple[np.ndarray, np.ndarray, list[Nuisance]]:
        """Return directions, (C, 6), target, (C,), and instruments' unknowns of corrected readings."""
        e = self.estimation
        directions, values = corrected.directions()[e.cells.first], self._cell_values(corrected.value)
        errors = self._prediction.errors[e.cells.station]
        expected, unknowns = e.unknowns(directions, errors, values, self.problem.scale)
        target = self.problem.scale * (values - expected)
        for part in unknowns:
            part.project_out(target)
        return directions, target, unknowns

    def _corrected_problems(self, wrong: Sequence[Mistake]) -> Iterator[tuple[Mistake, LinearProblem]]:
        """Yield mistakes that leave the poses right, each with the linear problem of the corrected readings.

        Only rows of changed channels are computed again; unknowns are projected out of all changes of values together.
        """
        m, in_file = self.estimation.measurements, self._cell_values(self.estimation.measurements.value)
        sets = [mistake.corrected() for mistake in wrong]
        quick = [s is not None and s.channel is m.channel and self.estimation.fixed_unknowns for s in sets]
        changes = [self._cell_values(s.value) - in_file for s, values in zip(sets, quick, strict=True) if s and values]
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
        """Return the comparison of the file with its correction, the linear `problem`; gain −∞ if no fit is possible.

        The fit to corrected readings starts at the first tolerances and noise, because a mistake enlarges the estimated
        noise. `early`: both estimations stop after FEW_ROUNDS updates.
        """
        in_file, rounds = (self.early, FEW_ROUNDS) if early else (self.posterior, ROUNDS)
        try:
            tried = solve(components, problem, components.first, SAME_UNITS, rounds)
        except NO_FIT:
            return Alternative(-np.inf, "")
        if (tried.tolerances > np.maximum(ASSUMED.mistaken * components.first, in_file.tolerances)).any():
            return Alternative(-np.inf, "")  # no machine has the errors that the corrected readings show
        # Density of the values in the file: × factor (Jacobian)
        jacobian = float(problem.freedom[self.kinds] @ np.log(mistake.factor[self.kinds]))
        gain = log_evidence(problem, tried) + jacobian - log_evidence(self.problem, in_file) - mistake.choices
        # Noise before / after the correction, of the kind that improves most
        better = float((in_file.noise * mistake.factor / tried.noise)[self.kinds].max())
        fits = f"{better:.3g} times better" if better > 1.005 else "equally well, with smaller errors of the machine"
        return Alternative(gain, f"{mistake.name} fits {fits}")

    def mistakes(self) -> list[Alternative]:
        """Return the FINALISTS most probable mistakes, among them reversed signs of runs."""
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
        """Yield mistakes in the poses, each with its gain, linear problem and components.

        Fits to some of the runs preselect the mistakes; the gain of such a fit is scaled to all readings. These fits
        have structure and screws only: a field could hide wrong poses.
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

    def common_modes(self) -> Iterator[Alternative]:
        """Yield common modes that are ASSUMED.mistaken times larger than usual, such as a wrong tool length.

        Effect d, amplitude ~ N(0, σ²): the log evidence grows by ½h²σ²/(1 + σ²I) − ½log(1 + σ²I), with h = dᵀK⁻¹t, I =
        dᵀK⁻¹d, target t, and K the covariance of t without the mode. The gain is the log evidence with the σ of a
        mistake minus the log evidence with the usual σ.
        """
        modes = list(possible_modes(self.estimation, self._prediction))
        effects = self.problem.free_of_nuisance(np.column_stack([mode.effect for mode in modes]))
        # A large mode enlarges the estimated tolerances, which makes it look usual: try the first tolerances too
        first_guess = solve(self.components, self.problem, self.components.first, self.posterior.noise, rounds=0)
        suspect = self._suspect(effects, modes, self.posterior) | self._suspect(effects, modes, first_guess)
        for n in np.flatnonzero(suspect):
            mode, effect = modes[n], effects[:, n]
            usual, posterior = self._with_mode(effect, mode, 1.0, self.posterior)
            if abs(usual.amplitude) < usual.deviation:
                continue
            # Each σ has its own tolerances, because a tolerance can imitate a mode that moves a whole block
            mistaken, without = self._with_mode(effect, mode, ASSUMED.mistaken, posterior)
            # The tolerances of the mistake may suit the usual σ better than its own
            usual = max(usual, self._mode_fit(effect, mode, 1.0, without), key=lambda fit: fit.evidence)
            amplitude = mistaken.amplitude / UNIT[mode.unit]
            times = abs(mistaken.amplitude) / usual.deviation
            text = f"{mode.name}: {amplitude:+.3g} {mode.unit}, {times:.1f} times the usual size: {mode.causes}"
            yield Alternative(mistaken.evidence - usual.evidence, text)

    def _with_mode(self, effect: np.ndarray, mode: Mode, times: float, p: Posterior) -> tuple[_ModeFit, Posterior]:
        """Return a mode's fit, and the posterior of the readings minus the mode."""
        for _ in range(MODE_ROUNDS):
            fit = self._mode_fit(effect, mode, times, p)
            without = _replaced(self.problem, self.problem.target - fit.amplitude * effect)
            p = solve(self.components, without, p.tolerances, p.noise, FEW_ROUNDS)
        return self._mode_fit(effect, mode, times, p), p

    def _suspect(self, effects: np.ndarray, modes: list[Mode], posterior: Posterior) -> np.ndarray:
        """Return which modes have an amplitude, estimated with a mistake's σ, of at least their usual σ, (modes,)."""
        of_modes = Further.of(self.problem, posterior, effects)
        tolerances = dict(zip([b.name for b in self.space.blocks], posterior.tolerances, strict=True))
        usual = np.array([max(mode.usual, tolerances.get(mode.block, mode.usual)) for mode in modes])
        precision = (ASSUMED.mistaken * usual) ** -2.0
        return np.asarray(np.abs(of_modes.moment) >= usual * (precision + np.diag(of_modes.information)))

    def _mode_fit(self, effect: np.ndarray, mode: Mode, times: float, posterior: Posterior) -> _ModeFit:
        """Return a mode's fit with `times` its usual σ, and with tolerances and noise of `posterior`."""
        plain = solve(self.components, self.problem, posterior.tolerances, posterior.noise, rounds=0)
        tolerances = dict(zip([b.name for b in self.space.blocks], plain.tolerances, strict=True))
        deviation = times * max(mode.usual, tolerances.get(mode.block, mode.usual))
        found = Further.of(self.problem, plain, deviation * effect[:, None])
        return _ModeFit(deviation * float(found.mean[0]), deviation, log_evidence(self.problem, plain) + found.gain)

    def other_directions(self) -> list[Alternative]:
        """Return the mistake that readings are labelled with the opposite direction of motion; empty if it is not
        likely.

        Readings that the fitted backlash makes more probable with the opposite label are relabelled, and the model is
        fitted again, since wrong labels hide a part of the backlash. The gain is reduced by log(2ⁿ) for n labels.
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
        for _ in range(MODE_ROUNDS):
            ratio = np.bincount(group.ravel(), known * model._reversal_ratio())
            if np.maximum(ratio, 0.0).sum() < np.log(ASSUMED.mixup_odds) + ONLY_CHANCE * len(groups):
                break
            flipped ^= ratio > 0.0
            if 2 * flipped.sum() > len(flipped):  # most labels are right; fit.py tests if all are wrong
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
        """Return log(p(reading | opposite direction) / p(reading | its label)), (N,)."""
        m, c, p = self.estimation.measurements, self.estimation.cells, self.posterior
        backlash = next(
            part for b, part in zip(self.space.blocks, self.components.parts, strict=True) if b.name == "backlash"
        )
        moved = (self.rows[:, backlash] @ p.y[backlash] / self.problem.scale)[c.of_reading]
        residuals = ((self.problem.target - self.rows @ p.y) / self.problem.scale)[c.of_reading]
        residuals = residuals + m.value - self._cell_values(m.value)[c.of_reading]
        sigma = self.estimation.uncertainty * p.noise[m.kind]
        return 0.5 * (residuals**2 - (residuals + 2.0 * moved) ** 2) / sigma**2

    def _runs_reversed(self) -> Iterator[Mistake]:
        """Yield the most probable set of runs with reversed signs, for all channels and for each channel alone.

        The log evidence is a quadratic form in the vector of runs (1 reversed, 0 not), with the same Gram matrix for
        all sets.
        """
        m, cells = self.estimation.measurements, self.estimation.cells
        groups, group = np.unique(np.stack([m.run[cells.first], cells.channel]), axis=1, return_inverse=True)
        group = group.ravel()
        change = np.zeros((len(group), groups.shape[1]))
        change[np.arange(len(group)), group] = -2.0 * self._cell_values(m.value)
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
            if any(np.ptp(chosen[family[runs] == n]) for n in np.unique(family[runs])):  # not whole families
                listed = [m.runs[n].name for n in runs[chosen > 0.0]]
                title = ", ".join(listed[:3]) + (", …" if len(listed) > 3 else "")
                flipped = (by_run[:, runs] @ chosen)[group][cells.of_reading] > 0.0
                name = f"{what}{len(listed)} of {len(runs)} runs ({title}): sign reversed"
                yield Mistake(name, partial(sign_reversed, m, flipped), choices=len(runs) * np.log(2.0))

    def _most_probable(self, further: Further, by_run: np.ndarray, family: np.ndarray) -> np.ndarray:
        """Return the most probable set of reversed runs, by coordinate descent: 1 reversed, 0 not, (runs,)."""
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

    def _cell_values(self, values: np.ndarray) -> np.ndarray:
        of_reading, weights = self.estimation.cells.of_reading, self.estimation.uncertainty**-2
        return np.bincount(of_reading, weights * values) / np.bincount(of_reading, weights)


def _fitted(m: MeasurementSet, settings: FitSettings, bases: dict[str, np.ndarray]) -> _Fitted:
    return _Fitted(Estimation(m, ParameterSpace(m, settings), check_count=False), bases)


def _principal(space: ParameterSpace, problem: LinearProblem) -> dict[str, np.ndarray]:
    """Return for each block the principal components on which the readings have enough information."""
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
    """Return the problem with another `target`, (C,), and perhaps other `rows`, (C, n).

    `factor`, (kinds,), multiplies the scatter of repeated readings.
    """
    values = problem.rows.parts[0].values if rows is None else rows
    normal = problem.normal if rows is None else np.zeros((len(KINDS), values.shape[1], values.shape[1]))
    moment, square = np.zeros((len(KINDS), values.shape[1])), problem.square.copy()
    for k in np.unique(problem.kind):
        members = problem.kind == k
        scatter = square[k] - problem.target[members] @ problem.target[members]
        square[k] = factor[k] ** 2 * scatter + target[members] @ target[members]
        moment[k] = target[members] @ values[members]
        if rows is not None:
            normal[k] = values[members].T @ values[members]
    return replace(problem, target=target, rows=DesignMatrix.of(values), normal=normal, moment=moment, square=square)


def _some_stations(m: MeasurementSet) -> MeasurementSet:
    """Return the readings at random stations: at least one, with at most MOST_READINGS readings."""
    order = np.random.default_rng(0).permutation(len(m.stations))
    count = np.cumsum(np.bincount(m.station, minlength=len(m.stations))[order])
    return m.select(np.isin(m.station, order[count <= max(MOST_READINGS, count[0])]))


def _some_runs(m: MeasurementSet) -> MeasurementSet:
    """Return random runs, one of each family in turn: at least one, with at most FEW_READINGS readings."""
    family, drawn = family_of_run(m), np.random.default_rng(0).permutation(len(m.runs))
    rank = np.array([(family[drawn[:n]] == family[run]).sum() for n, run in enumerate(drawn)])
    order = drawn[np.argsort(rank, kind="stable")]
    count = np.cumsum(np.bincount(m.run, minlength=len(m.runs))[order])
    return m.select(np.isin(m.run, order[count <= max(FEW_READINGS, count[0])]))


def possible_modes(estimation: Estimation, prediction: Prediction) -> Iterator[Mode]:
    """Yield rigid motions of tool, platform and base, leads by which joints turn screws, and scales of instruments."""
    m, cells, space = estimation.measurements, estimation.cells, estimation.space
    stations, directions = m.stations, cells.directions
    points, place = m.points(), max(TOLERANCES["structure"], space.start_tolerances()[0])

    def read(motions: np.ndarray) -> np.ndarray:
        """Return by how much each cell, (C,), changes if the measured point moves by `motions`, (M, 6)."""
        return np.einsum("ci,ci->c", directions, motions[cells.station])

    turned = stations.rotations @ m.geometry.tool.rotation
    for axis, name in enumerate(AXES):
        along = turned[:, :, axis]
        causes = f"looks like a probe or a tool whose length or offset is wrong in the file; {FORCE}"
        moved = np.hstack([along, np.zeros_like(along)])
        yield Mode(f"measured point along the tool's {name}", causes, "mm", read(moved), place, "structure")
        causes = f"looks like a target or a tool that is mounted with a rotation, or a wrong zero of angles; {FORCE}"
        lever = np.cross(along, points - stations.positions)
        size = place / m.geometry.characteristic_length
        yield Mode(f"platform turned about the tool's {name}", causes, "mrad", read(np.hstack([lever, along])), size)
        causes = f"looks like a work frame, or an instrument's frame, that differs from the file; {FORCE}"
        still, unit = np.zeros_like(points), np.tile(m.geometry.work.rotation[:, axis], (len(points), 1))
        yield Mode(f"base moved along {name}", causes, "mm", read(np.hstack([unit, still])), place, "structure")
        about = np.hstack([np.cross(unit, points - m.geometry.work.position), unit])
        yield Mode(f"base turned about {name}", causes, "mrad", read(about), size)
    if m.geometry.base_axes is not None:
        causes = "looks like a lead of wrong size or sign in the file, wrong joint_axes, or a screw that its joints do "
        causes += f"not turn (lead 0); {FORCE}"
        turns = turns_of_screws(m.geometry, stations.positions, stations.rotations)
        turned = Linkage(prediction, space.probe, stations).per_length * turns[:, None]
        handed = np.where(m.geometry.screw_lead < 0.0, -1.0, 1.0)
        for name, share in (("all screws", handed), *zip(STRUT_NAMES, np.eye(6), strict=True)):
            yield Mode(f"lead of {name}", causes, "mm", read(turned @ share), ASSUMED.usual_lead)
    warmth = float(np.abs(stations.temperatures - REFERENCE_TEMPERATURE).mean())
    usual = np.hypot(ASSUMED.usual_scale, 0.0 if space.stated_expansion.any() else STEEL * warmth)
    centre = np.nan_to_num(m.centre[cells.first])
    for kind in SCALED:
        members = cells.kind == KINDS.index(kind)
        away = points[cells.station] - (centre if kind == "length" else points.mean(axis=0))
        causes = "looks like a laser without compensation of the air, a temperature other than 20 °C, or a stated lead "
        causes += f"that is wrong for all screws; {FORCE}"
        scaled = np.where(members, np.einsum("ci,ci->c", directions[:, :3], away), 0.0)
        yield Mode(f"scale of all {kind} readings", causes, "ppm", scaled, usual)
