"""Search for mix-ups: mistakes in a file of readings, such as a wrong sign, unit, label or frame.

Each mistake of :mod:`.mistakes` is corrected in the readings. The likelihood ratio of a mistake is the marginal
likelihood (evidence) of the corrected readings, divided by the marginal likelihood of the readings in the file. Both
likelihoods have the same blocks of parameters. A mistake is reported if its likelihood ratio exceeds the odds
`mixup_odds` (assumptions.py). A model can often be fitted to wrong readings as well, but it needs more blocks of
parameters, and each block lowers the evidence.

The problem is linearised at the nominal machine. The parameters of each block are replaced by principal components. A
component is dropped if its prior contains more information than the readings in the file. The prior of a block is
isotropic, so the components have the same prior as the parameters. A wrong sign or unit changes only the values of
readings. A wrong label changes only a few rows of the design matrix. Only mistakes that change the poses need a new
linearisation. If the signs of some runs are reversed, the log evidence is a quadratic form with a constant Gram matrix,
and coordinate descent finds the most probable set of reversed runs.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from contextlib import suppress
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

MOST_READINGS = 2500  # mistakes are compared on at most this number of readings, at random stations
FEW_READINGS = 400  # mistakes that change the poses are preselected on at most this number of readings, of random runs
FINALISTS = 6  # number of mistakes for which tolerances and noise are estimated until convergence
LEAST_DETERMINED = (
    1.0  # a component is kept if the readings' information on it exceeds its prior's information by this factor
)
MODE_ROUNDS = 3  # number of rounds; each estimates a common mode, then tolerances (or direction labels, then the model)
ONLY_CHANCE = 0.2
"""Upper bound of the mean of max(0, r), where r is the log likelihood ratio of reversing a correct direction label.

For a backlash of m standard deviations the mean is 2m(φ(m) − mΦ(−m)), which is largest at m = 0.6."""

SWAPPED = "forward and backward look swapped, or the sign of all readings reversed"
UNIT = {"mm": 1e-3, "mrad": 1e-3, "ppm": 1e-6}
SCALED = ("linear", "length", "position")
"""Kinds of channel whose instrument may have a wrong scale factor."""

FORCE = "correct the cause; if the machine really has this error, write the model with --force"
SAME_UNITS = np.ones(len(KINDS))
NO_FIT = (HexapodError, np.linalg.LinAlgError)  # errors of a fit to readings that no machine could give


class Alternative(NamedTuple):
    """A possible mistake, and how much more probable its correction makes the readings."""

    gain: float  # log likelihood ratio of the corrected readings over the readings in the file
    text: str  # line of the report: "x lines, linear: sign reversed fits 29.8 times better"


class Mode(NamedTuple):
    """A common mode: one error with the same cause in all readings, such as a wrong tool length."""

    name: str
    causes: str  # probable causes and remedy, for the report
    unit: str  # unit of the amplitude in the report: a key of UNIT
    effect: np.ndarray  # (C,): change of the cells' values by an amplitude of 1 m, 1 rad or a ratio of 1
    usual: float  # standard deviation of the amplitude if no mistake was made: m, rad or ratio
    block: str = ""  # block whose fitted tolerance replaces `usual` if the tolerance is larger; empty: no block


def mixups(
    everything: Estimation, blocks: Collection[str], progress: Callable[[str], object] = lambda text: None
) -> list[str]:
    """Return report lines on the most probable mix-up, and on mix-ups at most `mixup_odds` times less probable.

    `everything` estimates all parameters that the settings allow. `blocks` are the blocks that the fit uses besides
    the structure. The list is empty if no mix-up is likely. A comparison that fails is left out.
    """
    progress("checking the readings for mix-ups of signs, units, labels and frames")
    # A fit to wrong readings may have dropped blocks of errors that every machine has: add them.
    blocks = {*blocks, *(name for name in EXPECTED if everything.space.block(name))}
    space, found = everything.space, list[Alternative]()
    try:
        described = ParameterSpace((space.geometry, space.region), replace(space.settings, blocks=tuple(blocks)))
        model = _Fitted(Estimation(_some_stations(everything.measurements), described, check_count=False))
        noisy = (model.posterior.noise[model.kinds] >= ASSUMED.misfit[0]).any()
    except NO_FIT:
        return []
    comparisons: list[Callable[[], Iterable[Alternative]]] = [model.common_modes, model.other_directions]
    if noisy or not blocks <= set(EXPECTED):
        # If structure and screws alone describe the readings within their noise, a wrong sign or unit is not likely.
        comparisons.append(model.mistakes)
    for compare in comparisons:
        with suppress(*NO_FIT):
            found += compare()
    best = max((other.gain for other in found), default=0.0)
    odds = np.log(ASSUMED.mixup_odds)
    named = [other for other in found if other.gain > max(odds, best - odds)]
    return [other.text for other in sorted(named, key=lambda other: -other.gain)]


class _ModeFit(NamedTuple):
    """The estimated amplitude of a common mode, and the evidence of the readings with it."""

    amplitude: float  # most probable amplitude: m, rad or ratio
    deviation: float  # standard deviation of the amplitude's prior: m, rad or ratio
    evidence: float  # log evidence of the readings


class _Fitted:
    """The linear problem of readings in principal components, and comparisons with problems of corrected readings."""

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
        """Posterior of these readings; tolerances and noise are estimated until convergence."""
        return solve(self.components, self.problem, self.components.first, SAME_UNITS, ROUNDS)

    @cached_property
    def early(self) -> Posterior:
        """Posterior of these readings after FEW_ROUNDS rounds of estimating tolerances and noise."""
        return solve(self.components, self.problem, self.components.first, SAME_UNITS, FEW_ROUNDS)

    @cached_property
    def rows(self) -> np.ndarray:
        """Cells' derivatives by the components, divided by stated noise, without nuisance parameters, (C, n)."""
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
    def _unprojected(self) -> tuple[np.ndarray, np.ndarray]:
        """Directions of the cells, (C, 6), and `rows` as they are before nuisance parameters are projected out."""
        directions = self._reinterpreted(self.estimation.measurements)[0]
        return directions, self._along(np.arange(len(directions)), directions)

    def _basis(self, block: int) -> np.ndarray:
        """Return the basis (size, n) of a block's components; the identity if `bases` has none for this block size."""
        name, size = self.space.blocks[block].name, len(self.space.blocks[block].labels)
        basis = self.bases.get(name, np.eye(size))
        return basis if len(basis) == size else np.eye(size)

    def _reduced(self, rows: np.ndarray) -> np.ndarray:
        """Convert derivatives by the parameters, (C, parameters), to derivatives by the components, (C, n)."""
        return np.hstack([rows[:, block.part] @ self._basis(n) for n, block in enumerate(self.space.blocks)])

    def _along(self, cells: np.ndarray, directions: np.ndarray) -> np.ndarray:
        """Return the derivatives of `cells`, read along `directions`, by the components, divided by stated noise."""
        rows = np.empty((len(cells), self.space.size))
        along = self._scale[cells, None] * directions
        self._slopes.write(rows, self.estimation.cells.station[cells], along, np.arange(6))
        return self._reduced(rows)

    def _reinterpreted(self, corrected: MeasurementSet) -> tuple[np.ndarray, np.ndarray, list[Nuisance]]:
        """Return the cells' directions (C, 6), the problem's target (C,) and nuisance parameters after a correction."""
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

        For all mistakes that change only values, nuisance parameters are projected out together. For a mistake that
        changes channels, only the rows of these channels are computed again.
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
        """Return the comparison of corrected readings with the readings in the file; gain −∞ if no fit is possible.

        `problem` is the linear problem of the corrected readings. The estimation starts at the first tolerances and
        noise, because a mistake in the file makes the estimated noise too large. With `early`, the estimations for both
        sets of readings stop after :data:`FEW_ROUNDS` rounds.
        """
        in_file, rounds = (self.early, FEW_ROUNDS) if early else (self.posterior, ROUNDS)
        try:
            tried = solve(components, problem, components.first, SAME_UNITS, rounds)
        except NO_FIT:
            return Alternative(-np.inf, "")
        # A probability density scales with the unit of its values (Jacobian)
        jacobian = float(problem.freedom[self.kinds] @ np.log(mistake.factor[self.kinds]))
        gain = log_evidence(problem, tried) + jacobian - log_evidence(self.problem, in_file) - mistake.choices
        # Ratio of the noise before and after the correction, for the kind of readings that improves most
        better = float((in_file.noise * mistake.factor / tried.noise)[self.kinds].max())
        fits = f"{better:.3g} times better" if better > 1.005 else "equally well, with smaller errors of the machine"
        return Alternative(gain, f"{mistake.name} fits {fits}")

    def mistakes(self) -> list[Alternative]:
        """Return the FINALISTS most probable mistakes of :mod:`.mistakes` and of reversed signs of single runs."""
        tried = list[tuple[float, Mistake, LinearProblem, Components]]()
        with suppress(*NO_FIT):
            tried += self._mistakes_of_poses()
        wrong = [*mistakes(self.estimation.measurements), *self._runs_reversed()]
        for mistake, problem in self._corrected_problems(wrong):
            gain = self._compared(mistake, problem, self.components, early=True).gain
            tried.append((gain, mistake, problem, self.components))
        best = sorted((t for t in tried if t[0] > 0.0), key=lambda t: -t[0])[:FINALISTS]
        return [self._compared(mistake, problem, components) for _, mistake, problem, components in best]

    def _mistakes_of_poses(self) -> Iterator[tuple[float, Mistake, LinearProblem, Components]]:
        """Yield mistakes that change the poses, each with its gain, linear problem and components.

        The readings of some runs preselect the mistakes; a gain from them is scaled to the number of all readings. The
        models have structure and screws only, because a field could hide wrong poses.
        """
        m = self.estimation.measurements
        screws = replace(self.space.settings, blocks=tuple(b for b in self.space.settings.blocks if b in EXPECTED))
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
        """Yield the common modes that may be mistakes, such as a wrong tool length.

        The amplitude of a mode with effect d has the prior N(0, σ²). Here σ is the usual deviation or, for a mistake,
        ASSUMED.mistaken times the usual deviation; the gain is the log evidence with the mistake's prior minus that
        with the usual prior. A mode changes the log evidence by ½h²σ²/(1 + σ²I) − ½log(1 + σ²I), with h = dᵀK⁻¹t, I
        = dᵀK⁻¹d; K is the readings' covariance without the mode, and t is the target. If a mode moves all parts of a
        block, the fit explains it by a larger tolerance. Therefore each prior gets its own tolerances and noise.
        """
        modes = list(common_modes(self.estimation, self.space))
        effects = self.estimation.free_of_nuisance(np.column_stack([mode.effect for mode in modes]))
        # A large mode also raises the estimated tolerances and then looks usual: test it with the first tolerances too.
        first_guess = solve(self.components, self.problem, self.components.first, self.posterior.noise, rounds=0)
        suspect = self._suspect(effects, modes, self.posterior) | self._suspect(effects, modes, first_guess)
        for n in np.flatnonzero(suspect):
            mode, effect = modes[n], effects[:, n]
            usual, posterior = self._with_mode(effect, mode, 1.0, self.posterior)
            if abs(usual.amplitude) < usual.deviation:
                continue
            mistaken, without = self._with_mode(effect, mode, ASSUMED.mistaken, posterior)
            # The usual prior may have more evidence with the tolerances of the mistake: use the larger evidence.
            usual = max(usual, self._mode_fit(effect, mode, 1.0, without), key=lambda fit: fit.evidence)
            amplitude = mistaken.amplitude / UNIT[mode.unit]
            times = abs(mistaken.amplitude) / usual.deviation
            text = f"{mode.name}: {amplitude:+.3g} {mode.unit}, {times:.1f} times the usual size: {mode.causes}"
            yield Alternative(mistaken.evidence - usual.evidence, text)

    def _with_mode(self, effect: np.ndarray, mode: Mode, times: float, p: Posterior) -> tuple[_ModeFit, Posterior]:
        """Return a mode's fit, and the posterior after the mode's effect is subtracted from the readings."""
        for _ in range(MODE_ROUNDS):
            fit = self._mode_fit(effect, mode, times, p)
            without = _replaced(self.problem, self.problem.target - fit.amplitude * effect)
            p = solve(self.components, without, p.tolerances, p.noise, FEW_ROUNDS)
        return self._mode_fit(effect, mode, times, p), p

    def _suspect(self, effects: np.ndarray, modes: list[Mode], posterior: Posterior) -> np.ndarray:
        """Return which modes, estimated with a mistake's prior, reach at least their usual deviation, (modes,)."""
        gram = self._gram(np.column_stack([self.problem.target, effects]), posterior)
        tolerances = dict(zip([b.name for b in self.space.blocks], posterior.tolerances, strict=True))
        usual = np.array([max(mode.usual, tolerances.get(mode.block, 0.0)) for mode in modes])
        precision = (ASSUMED.mistaken * usual) ** -2.0
        return np.asarray(np.abs(gram[0, 1:]) >= usual * (precision + np.diag(gram)[1:]))

    def _mode_fit(self, effect: np.ndarray, mode: Mode, times: float, posterior: Posterior) -> _ModeFit:
        """Return a mode's fit with a prior of `times` its usual deviation and a posterior's tolerances and noise."""
        plain = solve(self.components, self.problem, posterior.tolerances, posterior.noise, rounds=0)
        tolerances = dict(zip([b.name for b in self.space.blocks], plain.tolerances, strict=True))
        deviation = times * max(mode.usual, tolerances.get(mode.block, 0.0))
        (_, h), (_, information) = self._gram(np.column_stack([self.problem.target, effect]), plain)
        grown = 1.0 + deviation**2 * information
        gain = 0.5 * h**2 * deviation**2 / grown - 0.5 * np.log(grown)
        return _ModeFit(deviation**2 * h / grown, deviation, log_evidence(self.problem, plain) + gain)

    def other_directions(self) -> list[Alternative]:
        """Return the mistake that some readings have the wrong direction of motion; empty if it is not likely.

        Backlash changes a reading by Δ in forward motion and by −Δ in backward motion. Readings that fit better with
        the opposite direction are relabelled. Then the model is fitted again, since wrong labels hide a part of the
        backlash. The gain is reduced by the logarithm of 2ⁿ, the number of ways to label n readings.
        """
        m = self.estimation.measurements
        if self.space.block("backlash") is None or not (m.direction != UNKNOWN).any():
            return []
        order = np.lexsort((m.channel, m.station, m.run))
        key = np.column_stack([m.run, m.station, m.channel])[order]
        start = np.flatnonzero(np.r_[True, (np.diff(key, axis=0) != 0).any(axis=1)])
        repeat = np.empty(len(m), dtype=int)  # number of earlier readings of the same channel at the same station
        repeat[order] = np.arange(len(m)) - np.repeat(start, np.diff(np.r_[start, len(m)]))
        groups, group = np.unique(np.column_stack([m.run, m.station, repeat]), axis=0, return_inverse=True)
        known = m.direction != UNKNOWN
        flipped, model = np.zeros(len(groups), dtype=bool), self
        for _ in range(MODE_ROUNDS):
            ratio = np.bincount(group.ravel(), known * model._reversal_ratio())
            if np.maximum(ratio, 0.0).sum() < np.log(ASSUMED.mixup_odds) + ONLY_CHANCE * len(groups):
                break
            flipped ^= ratio > 0.0
            if 2 * flipped.sum() > len(flipped):  # assume that most labels are right; fit.py tests if all are wrong
                flipped = ~flipped
            try:
                turned = flipped[group.ravel()]
                # List every station twice, the second time with the opposite direction of motion.
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
        """Return each reading's log likelihood with the opposite direction minus that with its label, (N,)."""
        m, c, p = self.estimation.measurements, self.estimation.cells, self.posterior
        backlash = next(
            part for b, part in zip(self.space.blocks, self.components.parts, strict=True) if b.name == "backlash"
        )
        moved = (self.rows[:, backlash] @ p.y[backlash] / self._scale)[c.of_reading]
        residuals = ((self.problem.target - self.rows @ p.y) / self._scale)[c.of_reading]
        residuals = residuals + m.value - self._cell_values(m.value)[c.of_reading]
        sigma = self.estimation.uncertainty * p.noise[m.kind]
        return 0.5 * (residuals**2 - (residuals + 2.0 * moved) ** 2) / sigma**2

    def _runs_reversed(self) -> Iterator[Mistake]:
        """Yield the most probable set of runs with reversed signs, for all channels and for each channel alone."""
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
            if not what and 2.0 * chosen.sum() > len(runs):  # reversing all other runs fits equally well
                chosen = 1.0 - chosen
            if any(len(np.unique(chosen[family[runs] == n])) > 1 for n in np.unique(family[runs])):
                listed = [m.runs[n].name for n in runs[chosen > 0.0]]
                title = ", ".join(listed[:3]) + (", …" if len(listed) > 3 else "")
                flipped = (by_run[:, runs] @ chosen)[group][cells.of_reading] > 0.0
                name = f"{what}{len(listed)} of {len(runs)} runs ({title}): sign reversed"
                yield Mistake(name, partial(sign_reversed, m, flipped), choices=len(runs) * np.log(2.0))

    def _most_probable(self, gram: np.ndarray, by_run: np.ndarray, family: np.ndarray) -> np.ndarray:
        """Return which runs, the columns of by_run, are most probably reversed: 1 reversed, 0 not, (runs,)."""
        present = np.unique(family)
        starts = [np.isin(family, [n for n, way in zip(present, ways, strict=True) if way]).astype(float)
                  for ways in product((0, 1), repeat=len(present))]  # fmt: skip
        linear, square = by_run.T @ gram[1:, 0], by_run.T @ gram[1:, 1:] @ by_run
        # Descent from reversed families misses the case that every second run is reversed: start there too.
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
        """Return columnsᵀ·K⁻¹·columns; K is the cells' covariance for the tolerances and noise of the posterior `p`."""
        weights = p.noise[self.problem.kind] ** -1.0
        columns, rows = weights[:, None] * columns, weights[:, None] * self.rows * p.spread
        factor = cho_factor(whitened_precision(self.problem, p), lower=True)
        explained = rows.T @ columns
        return columns.T @ columns - explained.T @ cho_solve(factor, explained)


def _fitted(m: MeasurementSet, settings: FitSettings, bases: dict[str, np.ndarray]) -> _Fitted:
    return _Fitted(Estimation(m, ParameterSpace(m, settings), check_count=False), bases)


def _principal(space: ParameterSpace, problem: LinearProblem) -> dict[str, np.ndarray]:
    """Return each block's basis, in columns: the components on which the readings contain enough information."""
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
    """Return a linear problem with the given `target` (C,) and, unless None, the derivatives `rows` (C, n).

    `factor`, (kinds,), multiplies the scatter of the readings of each kind about their cells' means.
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
    """Return the readings at randomly drawn stations: at most MOST_READINGS readings, but at least one station."""
    order = np.random.default_rng(0).permutation(len(m.stations))
    count = np.cumsum(np.bincount(m.station, minlength=len(m.stations))[order])
    return m.select(np.isin(m.station, order[count <= max(MOST_READINGS, count[0])]))


def _some_runs(m: MeasurementSet) -> MeasurementSet:
    """Return the readings of random runs, one from each family in turn: at most FEW_READINGS, but at least one run."""
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
        """Return the change of the cells' values, (C,), for motions of the measured point at each station, (M, 6)."""
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
