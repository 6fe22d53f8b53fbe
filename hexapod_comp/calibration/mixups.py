"""Mix-ups: does a file of readings contain a mistake, such as a wrong sign, unit, label or frame?

The readings corrected for each mistake of :mod:`.mistakes` are compared with the readings in the file by the ratio of
their marginal likelihoods (evidence) under the same blocks of parameters. A mistake is reported if the ratio exceeds
the prior odds `mixup_odds`. A fit to mixed-up readings needs additional blocks, which cost evidence; a fit to the
corrected readings does not.

The problem is linearised at the nominal machine. Of each block only those principal components are kept that the
readings in the file determine better than the prior does. This changes no prior: the prior of a block is isotropic.
A wrong sign or unit changes only the values, a wrong label only a few rows of the design matrix. Only mistakes that
change the poses need a new linearisation. The evidence of reversed signs is a quadratic form of a Gram matrix;
coordinate descent finds the most probable set of reversed runs.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import replace
from functools import cached_property, partial
from itertools import pairwise, product
from typing import NamedTuple

import numpy as np
from scipy.linalg import cho_factor, cho_solve

from ..errors import HexapodError
from ..machine.temperatures import REFERENCE_TEMPERATURE
from ..measurements.readings import AXES, CHANNELS, KINDS, UNKNOWN, MeasurementSet
from .assumptions import ASSUMED
from .blocks import EXPECTED
from .estimator import (
    FEW_ROUNDS,
    ROUNDS,
    DesignMatrix,
    Estimation,
    LinearProblem,
    Posterior,
    log_evidence,
    solve,
    whitened_precision,
)
from .mistakes import Mistake, family_of_run, mistakes, mistakes_of_poses, sign_reversed
from .observations import Nuisance
from .parameters import TOLERANCES, Components, FitSettings, ParameterSpace
from .promise import STEEL
from .sensitivity import Prediction, Slopes, predict

# Largest number of readings: at random stations, to compare mistakes; of random runs, to preselect mistakes of poses
MOST_READINGS, FEW_READINGS = 2500, 400
FINALISTS = 6  # number of suspected mistakes whose tolerances and noise are estimated until convergence
LEAST_DETERMINED = 1.0  # a component is kept if its information from the readings exceeds the prior's by this factor
MODE_ROUNDS = 3  # rounds in which tolerances and noise are estimated together with a common mode, or with new labels
ONLY_CHANCE = 0.2
"""Upper bound of the mean of max(0, r), where r is the log likelihood ratio of reversing a correct direction label.

For a backlash of m standard deviations the mean is 2m(φ(m) − mΦ(−m)), which is largest at m = 0.6."""

SWAPPED = "forward and backward look swapped, or the sign of all readings reversed"
UNIT = {"mm": 1e-3, "mrad": 1e-3, "ppm": 1e-6}
SCALED = ("linear", "length", "position")
"""Kinds of channel whose instrument has a scale."""

FORCE = "correct it; if the machine is really so, write the model with --force"
SAME_UNITS = np.ones(len(KINDS))


class Alternative(NamedTuple):
    """A possible mistake, compared with the readings in the file."""

    gain: float  # logarithm of the likelihood ratio: corrected readings over readings in the file
    text: str  # line of the report: "x lines, linear: sign reversed fits 29.8 times better"


class Mode(NamedTuple):
    """A change common to all readings, or to all parts of the machine, such as a wrong tool length."""

    name: str
    causes: str  # probable causes and remedy, for the report
    unit: str
    effect: np.ndarray  # (C,): change of the cells' values by 1 m, 1 rad or a ratio of 1
    usual: float  # standard deviation of the mode's amplitude without a mistake: m, rad or ratio
    block: str = ""  # block whose fitted tolerance replaces `usual` where it is larger; empty: none


def mixups(
    everything: Estimation, blocks: Collection[str], progress: Callable[[str], object] = lambda text: None
) -> list[str]:
    """Return report lines of the most probable mix-up and of all mix-ups within `mixup_odds` of it; empty: no mix-up.

    `everything` estimates all parameters that may be used; `blocks` are the blocks that the fit uses, without the
    structure.
    """
    progress("checking the readings for mix-ups of signs, units, labels and frames")
    try:
        # A fit to mixed-up readings may have dropped blocks of errors that every machine has.
        blocks = {*blocks, *(name for name in EXPECTED if everything.space.block(name))}
        space = everything.space
        described = ParameterSpace((space.geometry, space.region), replace(space.settings, blocks=tuple(blocks)))
        model = _Fitted(Estimation(_some_stations(everything.measurements), described, alone=False))
        found = [*model.common_modes(), *model.other_directions()]
        if not blocks <= set(EXPECTED) or (model.posterior.noise[model.kinds] >= ASSUMED.misfit[0]).any():
            # Otherwise structure and screws alone describe the readings within their noise: no mistake is likely.
            found += model.mistakes()
    except (HexapodError, np.linalg.LinAlgError):
        return []
    best = max((other.gain for other in found), default=0.0)
    odds = np.log(ASSUMED.mixup_odds)
    named = [other for other in found if other.gain > max(odds, best - odds)]
    return [other.text for other in sorted(named, key=lambda other: -other.gain)]


class _ModeFit(NamedTuple):
    """The amplitude of a common mode, estimated under one prior."""

    amplitude: float  # most probable amplitude: m, rad or ratio
    deviation: float  # standard deviation of the prior: m, rad or ratio
    evidence: float  # log evidence of the readings


class _Fitted:
    """The linear problem of readings in principal components, with its posterior; methods compare mistakes with it."""

    def __init__(self, estimation: Estimation, bases: dict[str, np.ndarray] | None = None) -> None:
        self.estimation, self.space = estimation, estimation.space
        nominal = np.zeros(self.space.size)
        problem, _ = estimation.linearise(nominal, np.ones(len(estimation.measurements)))
        self.bases = _principal(self.space, problem) if bases is None else bases
        ends = np.cumsum([0, *(self._basis(n).shape[1] for n in range(len(self.space.blocks)))]).tolist()
        parts = tuple(slice(start, stop) for start, stop in pairwise(ends))
        self.components = Components(parts, self.space.start_tolerances(), self.space.stated)
        self.problem = _replaced(problem, problem.target, SAME_UNITS, self._reduced(problem.rows.dense()))
        self.kinds = np.unique(problem.kind)

    @cached_property
    def posterior(self) -> Posterior:
        """Posterior of these readings, tolerances and noise estimated until convergence."""
        return solve(self.components, self.problem, self.components.first, SAME_UNITS, ROUNDS)

    @cached_property
    def early(self) -> Posterior:
        """Posterior of these readings after FEW_ROUNDS rounds of estimating tolerances and noise."""
        return solve(self.components, self.problem, self.components.first, SAME_UNITS, FEW_ROUNDS)

    @cached_property
    def rows(self) -> np.ndarray:
        """Cells' derivatives by the components over their stated noise, nuisance parameters projected out, (C, n)."""
        return self.problem.rows.dense()

    @cached_property
    def _slopes(self) -> Slopes:
        stations = self.estimation.measurements.stations
        return Slopes(self.space, self._prediction, stations, whitened=True)

    @cached_property
    def _prediction(self) -> Prediction:
        return predict(self.space, np.zeros(self.space.size), self.estimation.measurements.stations)

    @cached_property
    def _scale(self) -> np.ndarray:
        """Reciprocal of the stated noise of each cell, (C,)."""
        return np.sqrt(np.bincount(self.estimation.cells.of_reading, self.estimation.uncertainty**-2))

    @cached_property
    def _uncleared(self) -> tuple[np.ndarray, np.ndarray]:
        """Directions of the cells, (C, 6), and their rows before nuisance parameters are projected out, (C, n)."""
        directions = self._reinterpreted(self.estimation.measurements)[0]
        return directions, self._along(np.arange(len(directions)), directions)

    def _basis(self, block: int) -> np.ndarray:
        """Return the basis (size, n) of a block's components; the identity if the basis is of another size."""
        name, size = self.space.blocks[block].name, len(self.space.blocks[block].labels)
        basis = self.bases.get(name, np.eye(size))
        return basis if len(basis) == size else np.eye(size)

    def _reduced(self, rows: np.ndarray) -> np.ndarray:
        """Convert rows of derivatives by the parameters to rows of derivatives by the components."""
        return np.hstack([rows[:, block.part] @ self._basis(n) for n, block in enumerate(self.space.blocks)])

    def _along(self, cells: np.ndarray, directions: np.ndarray) -> np.ndarray:
        """Return derivatives by the components, divided by stated noise, of n cells read along `directions`, (n, 6)."""
        rows = np.empty((len(cells), self.space.size))
        along = self._scale[cells, None] * directions
        self._slopes.write(rows, self.estimation.cells.station[cells], along, np.arange(6))
        return self._reduced(rows)

    def _reinterpreted(self, corrected: MeasurementSet) -> tuple[np.ndarray, np.ndarray, list[Nuisance]]:
        """Return the directions and targets of the corrected readings' cells, and the nuisance parameters."""
        e = self.estimation
        directions, values = corrected.directions()[e.cells.first], self._cell_values(corrected.value)
        errors = self._prediction.errors[e.cells.station]
        expected, unknowns = e.unknowns(directions, errors, values, self._scale)
        target = self._scale * (values - expected)
        for part in unknowns:
            part.project_out(target)
        return directions, target, unknowns

    def _corrected_problems(self, wrong: Sequence[Mistake]) -> Iterator[tuple[Mistake, LinearProblem]]:
        """Yield mistakes that do not change the poses, each with the linear problem of the corrected readings.

        If only values change, nuisance parameters are projected out of all targets at once. If channels change, only
        the rows of these channels are computed again.
        """
        m, in_file = self.estimation.measurements, self._cell_values(self.estimation.measurements.value)
        sets = [mistake.corrected() for mistake in wrong]
        quick = [s is not None and s.channel is m.channel and self.estimation.fixed_unknowns for s in sets]
        changes = [self._cell_values(s.value) - in_file for s, values in zip(sets, quick, strict=True) if s and values]
        cleared = self.estimation.free_of_nuisance(np.column_stack(changes)) if changes else np.zeros((len(in_file), 0))
        targets = iter((self.problem.target[:, None] + cleared).T)
        for mistake, corrected, values in zip(wrong, sets, quick, strict=True):
            if values:
                yield mistake, _replaced(self.problem, next(targets), mistake.factor)
            elif corrected is not None:
                try:
                    directions, target, unknowns = self._reinterpreted(corrected)
                except HexapodError:
                    continue
                directions_in_file, rows_in_file = self._uncleared
                rows, changed = rows_in_file.copy(), np.flatnonzero((directions != directions_in_file).any(axis=1))
                if len(changed):
                    rows[changed] = self._along(changed, directions[changed])
                for unknown in unknowns:
                    unknown.project_out(rows)
                yield mistake, _replaced(self.problem, target, mistake.factor, rows if len(changed) else None)

    def _compared(
        self, mistake: Mistake, problem: LinearProblem, components: Components, early: bool = False
    ) -> Alternative:
        """Return the comparison of corrected readings, given by their linear problem, with the readings in the file.

        The estimation starts from the first tolerances, as the fit does, because the noise found with the mistake is
        too large. With `early`, both estimations stop after :data:`FEW_ROUNDS` rounds.
        """
        in_file, rounds = (self.early, FEW_ROUNDS) if early else (self.posterior, ROUNDS)
        tried = solve(components, problem, components.first, SAME_UNITS, rounds)
        # A probability density scales with the unit of its values (Jacobian)
        jacobian = float(problem.freedom[self.kinds] @ np.log(mistake.factor[self.kinds]))
        gain = log_evidence(problem, tried) + jacobian - log_evidence(self.problem, in_file) - mistake.choices
        # Noise before over noise after the correction, for the kind that improves most. If no kind improves, the
        # corrected readings may still be more probable, because smaller errors of the machine explain them
        better = float((in_file.noise * mistake.factor / tried.noise)[self.kinds].max())
        fits = f"{better:.3g} times better" if better > 1.005 else "equally well, with smaller errors of the machine"
        return Alternative(gain, f"{mistake.name} fits {fits}")

    def mistakes(self) -> list[Alternative]:
        """Return the FINALISTS most probable mistakes: those of :mod:`.mistakes`, and reversed signs of single runs."""
        tried = self._mistakes_of_poses()
        wrong = [*mistakes(self.estimation.measurements), *self._runs_reversed()]
        for mistake, problem in self._corrected_problems(wrong):
            gain = self._compared(mistake, problem, self.components, early=True).gain
            tried.append((gain, mistake, problem, self.components))
        best = sorted((t for t in tried if t[0] > 0.0), key=lambda t: -t[0])[:FINALISTS]
        return [self._compared(mistake, problem, components) for _, mistake, problem, components in best]

    def _mistakes_of_poses(self) -> list[tuple[float, Mistake, LinearProblem, Components]]:
        """Return the mistakes that change the poses, with gain, linear problem and components.

        They are preselected on some runs, with structure and screws only: a field could hide wrong poses. The gain is
        then scaled to all readings.
        """
        m, found = self.estimation.measurements, []
        screws = replace(self.space.settings, blocks=tuple(b for b in self.space.settings.blocks if b in EXPECTED))
        few = _some_runs(m)
        in_file = _fitted_or_none(few, screws, {})
        if in_file is None or (in_file.early.noise[in_file.kinds] < ASSUMED.misfit[0]).all():
            return []  # the poses in the file fit within the noise
        of_all_runs = {mistake.name: mistake for mistake in mistakes_of_poses(m)}
        for mistake in mistakes_of_poses(few):
            fitted = _fitted_or_none(mistake.corrected(), screws, {})
            if fitted is None:
                continue
            gain = log_evidence(fitted.problem, fitted.early) - log_evidence(in_file.problem, in_file.early)
            if gain > np.log(ASSUMED.mixup_odds):
                whole = _fitted_or_none(of_all_runs[mistake.name].corrected(), self.space.settings, self.bases)
                if whole is not None:
                    found.append((gain * len(m) / len(few), mistake, whole.problem, whole.components))
        return found

    def common_modes(self) -> list[Alternative]:
        """Return the common modes that may be mistakes, such as a wrong tool length, with their gain over usual errors.

        The amplitude of a mode d has the prior N(0, σ²), with the usual σ or, for a mistake, `mistaken` times the usual
        σ. With K the readings' covariance without the mode, t the targets, h = dᵀK⁻¹t and I = dᵀK⁻¹d, the mode changes
        the log evidence by ½h²σ²/(1 + σ²I) − ½log(1 + σ²I). A mode shared by all parts of a block also raises the
        block's tolerance, which hides the mode. So tolerances and noise are estimated anew under either prior.
        """
        found = []
        modes = list(common_modes(self.estimation, self.space))
        effects = self.estimation.free_of_nuisance(np.column_stack([mode.effect for mode in modes]))
        # The first tolerances reveal a mode that is hidden because it has raised the estimated tolerances.
        first_guess = solve(self.components, self.problem, self.components.first, self.posterior.noise, rounds=0)
        suspect = self._suspect(effects, modes, self.posterior) | self._suspect(effects, modes, first_guess)
        for n in np.flatnonzero(suspect):
            mode, effect = modes[n], effects[:, n]
            usual, posterior = self._with_mode(effect, mode, 1.0, self.posterior)
            if abs(usual.amplitude) < usual.deviation:
                continue
            mistaken, without = self._with_mode(effect, mode, ASSUMED.mistaken, posterior)
            # The tolerances estimated with the wide prior may suit the usual deviation as well: take the better ones.
            usual = max(usual, self._mode_fit(effect, mode, 1.0, without), key=lambda fit: fit.evidence)
            amplitude = mistaken.amplitude / UNIT[mode.unit]
            times = abs(mistaken.amplitude) / usual.deviation
            text = f"{mode.name}: {amplitude:+.3g} {mode.unit}, {times:.1f} times the usual size: {mode.causes}"
            found.append(Alternative(mistaken.evidence - usual.evidence, text))
        return found

    def _with_mode(self, effect: np.ndarray, mode: Mode, times: float, p: Posterior) -> tuple[_ModeFit, Posterior]:
        """Return a mode's fit, and the posterior with tolerances and noise estimated without the mode's effect."""
        for _ in range(MODE_ROUNDS):
            fit = self._mode_fit(effect, mode, times, p)
            without = _replaced(self.problem, self.problem.target - fit.amplitude * effect)
            p = solve(self.components, without, p.tolerances, p.noise, FEW_ROUNDS)
        return self._mode_fit(effect, mode, times, p), p

    def _suspect(self, effects: np.ndarray, modes: list[Mode], posterior: Posterior) -> np.ndarray:
        """Return which modes, with a mistake's prior, have a larger amplitude than their usual deviation, (modes,)."""
        gram = self._gram(np.column_stack([self.problem.target, effects]), posterior)
        tolerances = dict(zip([b.name for b in self.space.blocks], posterior.tolerances, strict=True))
        usual = np.array([max(mode.usual, tolerances.get(mode.block, 0.0)) for mode in modes])
        precision = (ASSUMED.mistaken * usual) ** -2.0
        return np.asarray(np.abs(gram[0, 1:]) >= usual * (precision + np.diag(gram)[1:]))

    def _mode_fit(self, effect: np.ndarray, mode: Mode, times: float, posterior: Posterior) -> _ModeFit:
        """Return the fit of a mode with `times` its usual deviation, under a posterior's tolerances and noise."""
        plain = solve(self.components, self.problem, posterior.tolerances, posterior.noise, rounds=0)
        tolerances = dict(zip([b.name for b in self.space.blocks], plain.tolerances, strict=True))
        deviation = times * max(mode.usual, tolerances.get(mode.block, 0.0))
        (_, h), (_, information) = self._gram(np.column_stack([self.problem.target, effect]), plain)
        grown = 1.0 + deviation**2 * information
        gain = 0.5 * h**2 * deviation**2 / grown - 0.5 * np.log(grown)
        return _ModeFit(deviation**2 * h / grown, deviation, log_evidence(self.problem, plain) + gain)

    def other_directions(self) -> list[Alternative]:
        """Return the mistake that some readings have the wrong direction of motion; empty if no such mistake is likely.

        Backlash changes a reading by Δ forward and by −Δ backward. Readings that fit better in the other direction are
        relabelled, and the model is fitted again, since wrong labels hide a part of the backlash. The gain is reduced
        by the logarithm of the 2ⁿ ways to label n readings.
        """
        m = self.estimation.measurements
        if self.space.block("backlash") is None or not (m.direction != UNKNOWN).any():
            return []
        order = np.lexsort((m.channel, m.station, m.run))
        key = np.column_stack([m.run, m.station, m.channel])[order]
        start = np.flatnonzero(np.r_[True, (np.diff(key, axis=0) != 0).any(axis=1)])
        time = np.empty(len(m), dtype=int)  # counts the repeated readings of a channel at a station
        time[order] = np.arange(len(m)) - np.repeat(start, np.diff(np.r_[start, len(m)]))
        groups, group = np.unique(np.column_stack([m.run, m.station, time]), axis=0, return_inverse=True)
        known = m.direction != UNKNOWN
        flipped, model = np.zeros(len(groups), dtype=bool), self
        for _ in range(MODE_ROUNDS):
            ratio = np.bincount(group.ravel(), known * model._reversal_ratio())
            if np.maximum(ratio, 0.0).sum() < np.log(ASSUMED.mixup_odds) + ONLY_CHANCE * len(groups):
                break
            flipped ^= ratio > 0.0
            if 2 * flipped.sum() > len(flipped):  # assume that most labels are right; SWAPPED reports all swapped
                flipped = ~flipped
            try:
                turned = flipped[group.ravel()]
                twice = m.stations.select(
                    np.tile(np.arange(len(m.stations)), 2)
                )  # the copies get the opposite direction
                senses = twice.sense * np.repeat([1.0, -1.0], len(m.stations))[:, None]
                station = m.station + len(m.stations) * turned
                direction = np.where(turned, -m.direction, m.direction)
                other = replace(m, stations=replace(twice, sense=senses), station=station, direction=direction)
                model = _Fitted(Estimation(other, self.space, alone=False), self.bases)
            except (HexapodError, np.linalg.LinAlgError):
                return []
        if model is self:
            return []
        counts = f"direction of {int(flipped.sum())} of {len(flipped)} readings: forward and backward exchanged"
        relabelled = Mistake(counts, lambda: other, choices=len(groups) * np.log(2.0))
        return [self._compared(relabelled, model.problem, model.components)]

    def _reversal_ratio(self) -> np.ndarray:
        """Return each reading's log likelihood ratio of the opposite direction over the labelled direction, (N,)."""
        m, c, p = self.estimation.measurements, self.estimation.cells, self.posterior
        backlash = next(
            part for b, part in zip(self.space.blocks, self.components.parts, strict=True) if b.name == "backlash"
        )
        moved = (self.rows[:, backlash] @ p.y[backlash] / self._scale)[c.of_reading]
        left = ((self.problem.target - self.rows @ p.y) / self._scale)[c.of_reading]
        left = left + m.value - self._cell_values(m.value)[c.of_reading]
        sigma = self.estimation.uncertainty * p.noise[m.kind]
        return 0.5 * (left**2 - (left + 2.0 * moved) ** 2) / sigma**2

    def _runs_reversed(self) -> Iterator[Mistake]:
        """Yield the most probable sets of runs with reversed signs: in all channels, and in each channel alone."""
        m, cells = self.estimation.measurements, self.estimation.cells
        groups, group = np.unique(np.stack([m.run[cells.first], cells.channel]), axis=1, return_inverse=True)
        group = group.ravel()
        change = np.zeros((len(group), groups.shape[1]))
        change[np.arange(len(group)), group] = -2.0 * self._cell_values(m.value)
        change = self.estimation.free_of_nuisance(change)
        gram = self._gram(np.column_stack([self.problem.target, change]), self.posterior)
        family, channels = family_of_run(m), np.unique(groups[1])
        names = [("", np.ones(groups.shape[1], dtype=bool))]
        names += [(f"{CHANNELS[c]} of ", groups[1] == c) for c in channels if len(channels) > 1]
        for what, members in names:
            by_run = np.zeros((groups.shape[1], len(m.runs)))
            by_run[np.arange(groups.shape[1]), groups[0]] = members
            runs = np.flatnonzero(by_run.any(axis=0))
            chosen = self._most_probable(gram, by_run[:, runs], family[runs])
            if not what and 2.0 * chosen.sum() > len(runs):  # reversing all other runs is the same up to one sign
                chosen = 1.0 - chosen
            if any(len(np.unique(chosen[family[runs] == n])) > 1 for n in np.unique(family[runs])):
                listed = [m.runs[n].name for n in runs[chosen > 0.0]]
                title = ", ".join(listed[:3]) + (", …" if len(listed) > 3 else "")
                flipped = (by_run[:, runs] @ chosen)[group][cells.of_reading] > 0.0
                name = f"{what}{len(listed)} of {len(runs)} runs ({title}): sign reversed"
                yield Mistake(name, partial(sign_reversed, m, flipped), choices=len(runs) * np.log(2.0))

    def _most_probable(self, gram: np.ndarray, by_run: np.ndarray, family: np.ndarray) -> np.ndarray:
        """Return which runs, columns of by_run, are most probably reversed (1) or not (0), by coordinate descent."""
        present = np.unique(family)
        starts = [np.isin(family, [n for n, way in zip(present, ways, strict=True) if way]).astype(float)
                  for ways in product((0, 1), repeat=len(present))]  # fmt: skip
        linear, square = by_run.T @ gram[1:, 0], by_run.T @ gram[1:, 1:] @ by_run
        # Descent does not reach alternating signs from whole families: start also with every second run reversed.
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

    def _gram(self, columns: np.ndarray, p: Posterior) -> np.ndarray:
        """Return columnsᵀ·K⁻¹·columns with K, the cells' covariance from the posterior's priors and noise."""
        weights = p.noise[self.problem.kind] ** -1.0
        columns, rows = weights[:, None] * columns, weights[:, None] * self.rows * p.spread
        factor = cho_factor(whitened_precision(self.problem, p), lower=True)
        explained = rows.T @ columns
        return columns.T @ columns - explained.T @ cho_solve(factor, explained)


def _fitted_or_none(m: MeasurementSet | None, settings: FitSettings, bases: dict[str, np.ndarray]) -> _Fitted | None:
    """Return the model fitted to readings; None if `m` is None, or if the machine cannot reach the poses."""
    if m is None:
        return None
    try:
        return _Fitted(Estimation(m, ParameterSpace(m, settings), alone=False), bases)
    except (HexapodError, np.linalg.LinAlgError):
        return None


def _principal(space: ParameterSpace, problem: LinearProblem) -> dict[str, np.ndarray]:
    """Return for each block the basis, in columns, of the components that readings determine (LEAST_DETERMINED)."""
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
    """Return the linear problem with other targets and, if given, other rows.

    `factor`, (kinds,), scales the scatter of readings about their cell's mean, of each kind.
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
    """Return the readings at stations drawn at random: at most MOST_READINGS, but at least one station."""
    order = np.random.default_rng(0).permutation(len(m.stations))
    count = np.cumsum(np.bincount(m.station, minlength=len(m.stations))[order])
    return m.select(np.isin(m.station, order[count <= max(MOST_READINGS, count[0])]))


def _some_runs(m: MeasurementSet) -> MeasurementSet:
    """Return the readings of runs drawn at random from each family in turn: at most FEW_READINGS, at least one run."""
    family, drawn = family_of_run(m), np.random.default_rng(0).permutation(len(m.runs))
    rank = np.array([(family[drawn[:n]] == family[run]).sum() for n, run in enumerate(drawn)])
    order = drawn[np.argsort(rank, kind="stable")]
    count = np.cumsum(np.bincount(m.run, minlength=len(m.runs))[order])
    return m.select(np.isin(m.run, order[count <= max(FEW_READINGS, count[0])]))


def common_modes(estimation: Estimation, space: ParameterSpace) -> Iterator[Mode]:
    """Yield the common modes of readings: rigid motions of tool, platform and base, and scales of instruments."""
    m, cells = estimation.measurements, estimation.cells
    stations, directions = m.stations, cells.directions
    points, place = m.points(), max(TOLERANCES["structure"], space.start_tolerances()[0])

    def read(motions: np.ndarray) -> np.ndarray:
        """Return the change of the cells' values, (C,), by motions of the measured points, (M, 6)."""
        return np.einsum("ci,ci->c", directions, motions[cells.station])

    turned = stations.rotations @ m.geometry.tool.rotation
    for axis, name in enumerate(AXES):
        along = turned[:, :, axis]
        causes = f"looks like a probe or a tool whose length or offset is wrong in the file; {FORCE}"
        moved = np.hstack([along, np.zeros_like(along)])
        yield Mode(f"measured point along the tool's {name}", causes, "mm", read(moved), place, "structure")
        causes = f"looks like a target or a tool mounted with a rotation, or like another zero of angles; {FORCE}"
        lever = np.cross(along, points - stations.positions)
        size = place / m.geometry.characteristic_length
        yield Mode(f"platform turned about the tool's {name}", causes, "mrad", read(np.hstack([lever, along])), size)
        causes = f"looks like a work frame, or an instrument's frame, that differs from the file; {FORCE}"
        still, unit = np.zeros_like(points), np.tile(m.geometry.work.rotation[:, axis], (len(points), 1))
        yield Mode(f"base moved along {name}", causes, "mm", read(np.hstack([unit, still])), place, "structure")
        about = np.hstack([np.cross(unit, points - m.geometry.work.position), unit])
        yield Mode(f"base turned about {name}", causes, "mrad", read(about), size)
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
