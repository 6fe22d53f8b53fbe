"""Mix-ups: are the readings more probable if they were taken another way than their file says?

Each mistake of the table in :mod:`.mistakes` is weighed against the model as fitted by one likelihood ratio, the ratio
of the marginal likelihoods (evidence) of the same readings under the same blocks of parameters, and is named where that
exceeds one prior odds. To describe readings that were mixed up a fit needs blocks that cost evidence; to describe the
corrected ones it does not.

The linear problem is that of the nominal machine. Of each block only the principal components stay that the uncorrected
readings determine better than the prior does: the prior of a block is isotropic, so any orthonormal basis of it has the
same prior. Signs and units change the values alone, and labels a few rows of the design matrix, so the problem is
linearised anew only for mistakes that change the poses. All sets of reversed groups of cells (a channel of a run) are
quadratic forms of one Gram matrix; coordinate descent finds the most probable set of reversed runs.
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
from .mistakes import Mistake, family_of_run, mistakes, mistakes_of_place, sign_reversed
from .observations import Nuisance
from .parameters import TOLERANCES, Components, FitSettings, ParameterSpace
from .promise import STEEL
from .sensitivity import Prediction, Slopes, predict

MOST_READINGS, FEW_READINGS = 2500, 400  # at stations drawn at random to weigh mistakes; of runs, to try places first
FINALISTS = 6  # mistakes for which sizes of priors are estimated until they settle
LEAST_DETERMINED = 1.0  # information over the prior's of components that stay
MODE_ROUNDS = 3  # in which priors are estimated with a mistake that all readings share
ONLY_CHANCE = 0.2
"""Log likelihood ratio that a right label gains by chance where its reversal fits better, at most: max E⟨ratio⟩₊.

With a backlash of m standard deviations, 2m(φ(m) − mΦ(−m)), largest at m = 0.6."""

SWAPPED = "forward and backward look swapped, or the sign of all readings reversed"
UNIT = {"mm": 1e-3, "mrad": 1e-3, "ppm": 1e-6, "µm": 1e-6}
SCALED = ("linear", "length", "position")
"""Kinds of channel whose instrument has a scale."""

FORCE = "correct it, or write the model all the same (--force) if the machine is so"
ALIKE = np.ones(len(KINDS))


class Alternative(NamedTuple):
    """Another way to take the readings."""

    gain: float  # logarithm of the likelihood ratio to the readings as they are
    text: str  # what is reported of it: "x lines, linear: sign reversed fits 29.8 times better"


class Mode(NamedTuple):
    """A change that all readings, or all parts of the machine, share: more probably by a mistake than by chance."""

    name: str
    causes: str  # what it looks like, and what to do
    unit: str
    effect: np.ndarray  # (C,): what a unit of it, SI, adds to cells' values
    usual: float  # standard deviation of a machine and an instrument with no mistake, SI
    block: str = ""  # whose tolerance, as fitted without the mode, is as usual; empty: none


def mixups(
    everything: Estimation, blocks: Collection[str], progress: Callable[[str], object] = lambda text: None
) -> list[str]:
    """Return the names of the most probable mix-up and of those that the readings do not distinguish from it; or none.

    `everything` are the readings against all parameters that may be used, `blocks` those that the fit uses beside the
    structure.
    """
    progress("are the readings more probable, taken another way?")
    try:
        # What every screw has belongs to readings taken rightly, though a fit may do without where they are mixed up.
        blocks = {*blocks, *(name for name in EXPECTED if everything.space.block(name))}
        space = everything.space
        described = ParameterSpace((space.geometry, space.region), replace(space.settings, blocks=tuple(blocks)))
        model = _Fitted(Estimation(_some_stations(everything.measurements), described, alone=False))
        found = [*model.common_modes(), *model.other_directions()]
        if not blocks <= set(EXPECTED) or (model.posterior.noise[model.kinds] >= ASSUMED.misfit[0]).any():
            # Otherwise a machine and its screws alone describe the readings.
            found += model.mistakes()
    except (HexapodError, np.linalg.LinAlgError):
        return []
    best = max((other.gain for other in found), default=0.0)
    odds = np.log(ASSUMED.mixup_odds)
    named = [other for other in found if other.gain > max(odds, best - odds)]
    return [other.text for other in sorted(named, key=lambda other: -other.gain)]


class _Way(NamedTuple):
    """A common mode under one prior."""

    amplitude: float  # the most probable one, SI
    deviation: float  # the prior's, SI
    evidence: float  # logarithm


class _Fitted:
    """The linear problem of readings by components, the model fitted to it, and readings taken otherwise under it."""

    def __init__(self, estimation: Estimation, bases: dict[str, np.ndarray] | None = None) -> None:
        self.estimation, self.space = estimation, estimation.space
        nominal = np.zeros(self.space.size)
        problem, _ = estimation.linearise(nominal, np.ones(len(estimation.measurements)))
        self.bases = _principal(self.space, problem) if bases is None else bases
        ends = np.cumsum([0, *(self._basis(n).shape[1] for n in range(len(self.space.blocks)))]).tolist()
        parts = tuple(slice(start, stop) for start, stop in pairwise(ends))
        self.components = Components(parts, self.space.start_tolerances(), self.space.stated)
        self.problem = _with(problem, problem.target, ALIKE, self._reduced(problem.rows.dense()))
        self.kinds = np.unique(problem.kind)

    @cached_property
    def posterior(self) -> Posterior:
        """The model of these readings."""
        return solve(self.components, self.problem, self.components.first, ALIKE, ROUNDS)

    @cached_property
    def early(self) -> Posterior:
        """The same after few rounds of the estimation of tolerances and noise."""
        return solve(self.components, self.problem, self.components.first, ALIKE, FEW_ROUNDS)

    @cached_property
    def rows(self) -> np.ndarray:
        """Derivatives of the cells by components, over their noise, free of the instruments' unknowns, (C, n)."""
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
        """One over the stated noise of each cell, (C,)."""
        return np.sqrt(np.bincount(self.estimation.cells.of_reading, self.estimation.uncertainty**-2))

    @cached_property
    def _read(self) -> tuple[np.ndarray, np.ndarray]:
        """Directions of the cells, (C, 6), and their rows with the instruments' unknowns still in them, (C, n)."""
        directions = self._seen(self.estimation.measurements)[0]
        return directions, self._along(np.arange(len(directions)), directions)

    def _basis(self, block: int) -> np.ndarray:
        """Return the components of a block's parameters; all of them where other commands give a map other knots."""
        name, size = self.space.blocks[block].name, len(self.space.blocks[block].labels)
        basis = self.bases.get(name, np.eye(size))
        return basis if len(basis) == size else np.eye(size)

    def _reduced(self, rows: np.ndarray) -> np.ndarray:
        """Return derivatives (n, size) by the parameters as derivatives by the components."""
        return np.hstack([rows[:, block.part] @ self._basis(n) for n, block in enumerate(self.space.blocks)])

    def _along(self, cells: np.ndarray, directions: np.ndarray) -> np.ndarray:
        """Return the derivatives of cells if they were read along `directions` (n, 6), over their stated noise."""
        rows = np.empty((len(cells), self.space.size))
        along = self._scale[cells, None] * directions
        self._slopes.write(rows, self.estimation.cells.station[cells], along, np.arange(6))
        return self._reduced(rows)

    def _seen(self, other: MeasurementSet) -> tuple[np.ndarray, np.ndarray, list[Nuisance]]:
        """Return directions and targets of the cells of readings taken otherwise, and the instruments' unknowns."""
        e = self.estimation
        directions, values = other.directions()[e.cells.first], self._cell_values(other.value)
        errors = self._prediction.errors[e.cells.station]
        expected, unknowns = e.unknowns(directions, errors, values, self._scale)
        target = self._scale * (values - expected)
        for part in unknowns:
            part.project_out(target)
        return directions, target, unknowns

    def _undone(self, wrong: Sequence[Mistake]) -> Iterator[tuple[Mistake, LinearProblem]]:
        """Yield the mistakes that leave the poses as they are, each with the linear problem of the corrected readings.

        Where only values differ, all targets are cleared of the instruments' unknowns at once; of other channels, only
        their rows are new.
        """
        m, read = self.estimation.measurements, self._cell_values(self.estimation.measurements.value)
        others = [mistake.undone() for mistake in wrong]
        alone = [o is not None and o.channel is m.channel and self.estimation.fixed_unknowns for o in others]
        changes = [self._cell_values(o.value) - read for o, only in zip(others, alone, strict=True) if o and only]
        cleared = self.estimation.free_of_nuisance(np.column_stack(changes)) if changes else np.zeros((len(read), 0))
        targets = iter((self.problem.target[:, None] + cleared).T)
        for mistake, other, only in zip(wrong, others, alone, strict=True):
            if only:
                yield mistake, _with(self.problem, next(targets), mistake.factor)
            elif other is not None:
                try:
                    directions, target, unknowns = self._seen(other)
                except HexapodError:
                    continue
                as_read, raw = self._read
                rows, changed = raw.copy(), np.flatnonzero((directions != as_read).any(axis=1))
                if len(changed):
                    rows[changed] = self._along(changed, directions[changed])
                for unknown in unknowns:
                    unknown.project_out(rows)
                yield mistake, _with(self.problem, target, mistake.factor, rows if len(changed) else None)

    def _weighed(
        self, mistake: Mistake, problem: LinearProblem, components: Components, early: bool = False
    ) -> Alternative:
        """Return an alternative from its linear problem, in which the mistake is corrected; the density of scaled
        values is scaled too (Jacobian).

        It starts from the first guess, as the fit does: from noise that a mistake has inflated it might not find back.
        With `early`, both this alternative and the readings as they are get :data:`FEW_ROUNDS` rounds of estimation.
        """
        as_read, rounds = (self.early, FEW_ROUNDS) if early else (self.posterior, ROUNDS)
        tried = solve(components, problem, components.first, ALIKE, rounds)
        jacobian = float(problem.freedom[self.kinds] @ np.log(mistake.factor[self.kinds]))
        gain = log_evidence(problem, tried) + jacobian - log_evidence(self.problem, as_read) - mistake.choices
        # How many times smaller the noise of the kind that gains most becomes; the same residuals by a machine with
        # smaller errors are more probable too
        better = float((as_read.noise * mistake.factor / tried.noise)[self.kinds].max())
        fits = f"{better:.3g} times better" if better > 1.005 else "as well, by smaller errors of the machine"
        return Alternative(gain, f"{mistake.name} fits {fits}")

    def mistakes(self) -> list[Alternative]:
        """Return the most probable mistakes of the table, and of single runs."""
        tried = self._elsewhere()
        for mistake, problem in self._undone([*mistakes(self.estimation.measurements), *self._runs_reversed()]):
            gain = self._weighed(mistake, problem, self.components, early=True).gain
            tried.append((gain, mistake, problem, self.components))
        best = sorted((t for t in tried if t[0] > 0.0), key=lambda t: -t[0])[:FINALISTS]
        return [self._weighed(mistake, problem, components) for _, mistake, problem, components in best]

    def _elsewhere(self) -> list[tuple[float, Mistake, LinearProblem, Components]]:
        """Return the mistakes that change the poses, tried on some runs first, as the gain grows with the readings.

        The first trial fits joints and screws alone: a field that hides a wrong pose is of no use at the right one.
        """
        m, found = self.estimation.measurements, []
        alone = replace(self.space.settings, blocks=tuple(b for b in self.space.settings.blocks if b in EXPECTED))
        few = _some_runs(m)
        as_read = _elsewhere_fitted(few, alone, {})
        if as_read is None or (as_read.early.noise[as_read.kinds] < ASSUMED.misfit[0]).all():
            return []  # nothing is left to be explained
        everywhere = {mistake.name: mistake for mistake in mistakes_of_place(m)}
        for mistake in mistakes_of_place(few):
            there = _elsewhere_fitted(mistake.undone(), alone, {})
            if there is None:
                continue
            gain = log_evidence(there.problem, there.early) - log_evidence(as_read.problem, as_read.early)
            if gain > np.log(ASSUMED.mixup_odds):
                other = _elsewhere_fitted(everywhere[mistake.name].undone(), self.space.settings, self.bases)
                if other is not None:
                    found.append((gain * len(m) / len(few), mistake, other.problem, other.components))
        return found

    def common_modes(self) -> list[Alternative]:
        """Return what is more probably a mistake that all readings share than a machine whose parts err alike.

        The amplitude a of a mode d has the prior N(0, σ²): σ is usual for a right machine, or `mistaken` times that.
        With K the readings' covariance without it, h = dᵀK⁻¹t and I = dᵀK⁻¹d, it changes their log evidence by ½h²σ²/(1
        + σ²I) − ½log(1 + σ²I). Parts that shift alike inflate their block's tolerance, which hides the mode: tolerances
        and noise are estimated anew under either prior.
        """
        found = []
        modes = list(common_modes(self.estimation, self.space))
        effects = self.estimation.free_of_nuisance(np.column_stack([mode.effect for mode in modes]))
        # A mistake shows where the tolerances are those of a right machine, if it does not where it has blown them up.
        usual_machine = solve(self.components, self.problem, self.components.first, self.posterior.noise, rounds=0)
        suspect = self._suspect(effects, modes, self.posterior) | self._suspect(effects, modes, usual_machine)
        for n in np.flatnonzero(suspect):
            mode, effect = modes[n], effects[:, n]
            usual, posterior = self._with_mode(effect, mode, 1.0, self.posterior)
            if abs(usual.amplitude) < usual.deviation:
                continue
            mistaken, without = self._with_mode(effect, mode, ASSUMED.mistaken, posterior)
            # Tolerances that the mode has not blown up may suit a right machine as well.
            usual = max(usual, self._by_mode(effect, mode, 1.0, without), key=lambda way: way.evidence)
            amplitude = mistaken.amplitude / UNIT[mode.unit]
            size = f"{amplitude:+.3g} {mode.unit}, {abs(mistaken.amplitude) / usual.deviation:.1f} times what is usual"
            found.append(Alternative(mistaken.evidence - usual.evidence, f"{mode.name}: {size}: {mode.causes}"))
        return found

    def _with_mode(self, effect: np.ndarray, mode: Mode, times: float, posterior: Posterior) -> tuple[_Way, Posterior]:
        """Return the evidence with a mode, by tolerances and noise that are estimated with it, and the posterior."""
        for _ in range(MODE_ROUNDS):
            way = self._by_mode(effect, mode, times, posterior)
            rest = _with(self.problem, self.problem.target - way.amplitude * effect)
            posterior = solve(self.components, rest, posterior.tolerances, posterior.noise, FEW_ROUNDS)
        return self._by_mode(effect, mode, times, posterior), posterior

    def _suspect(self, effects: np.ndarray, modes: list[Mode], posterior: Posterior) -> np.ndarray:
        """Return which modes (columns), allowed to be mistakes, exceed what is usual under a posterior's tolerances."""
        gram = self._gram(np.column_stack([self.problem.target, effects]), posterior)
        tolerances = dict(zip([b.name for b in self.space.blocks], posterior.tolerances, strict=True))
        usual = np.array([max(mode.usual, tolerances.get(mode.block, 0.0)) for mode in modes])
        precision = (ASSUMED.mistaken * usual) ** -2.0
        return np.asarray(np.abs(gram[0, 1:]) >= usual * (precision + np.diag(gram)[1:]))

    def _by_mode(self, effect: np.ndarray, mode: Mode, times: float, posterior: Posterior) -> _Way:
        """Return amplitude, prior and evidence of a mode, by the tolerances and the noise of a posterior."""
        plain = solve(self.components, self.problem, posterior.tolerances, posterior.noise, rounds=0)
        tolerances = dict(zip([b.name for b in self.space.blocks], plain.tolerances, strict=True))
        deviation = times * max(mode.usual, tolerances.get(mode.block, 0.0))
        (_, h), (_, information) = self._gram(np.column_stack([self.problem.target, effect]), plain)
        grown = 1.0 + deviation**2 * information
        gain = 0.5 * h**2 * deviation**2 / grown - 0.5 * np.log(grown)
        return _Way(deviation**2 * h / grown, deviation, log_evidence(self.problem, plain) + gain)

    def other_directions(self) -> list[Alternative]:
        """Return readings whose direction of motion is probably mislabelled, each by its own likelihood ratio.

        A strut's backlash moves a reading by Δ or, taken the other way, by −Δ. Readings that the other way explains
        better are relabelled and the model is fitted again, for wrong labels have hidden a part of the backlash. The
        relabelled set is one of 2ⁿ.
        """
        m = self.estimation.measurements
        if self.space.block("backlash") is None or not (m.direction != UNKNOWN).any():
            return []
        order = np.lexsort((m.channel, m.station, m.run))
        key = np.column_stack([m.run, m.station, m.channel])[order]
        start = np.flatnonzero(np.r_[True, (np.diff(key, axis=0) != 0).any(axis=1)])
        time = np.empty(len(m), dtype=int)  # numbers the readings of a channel at a station
        time[order] = np.arange(len(m)) - np.repeat(start, np.diff(np.r_[start, len(m)]))
        groups, group = np.unique(np.column_stack([m.run, m.station, time]), axis=0, return_inverse=True)
        known = m.direction != UNKNOWN
        flipped, model = np.zeros(len(groups), dtype=bool), self
        for _ in range(MODE_ROUNDS):
            ratio = np.bincount(group.ravel(), known * model._reversal_ratio())
            if np.maximum(ratio, 0.0).sum() < np.log(ASSUMED.mixup_odds) + ONLY_CHANCE * len(groups):
                break
            flipped ^= ratio > 0.0
            if 2 * flipped.sum() > len(flipped):  # the majority is right: all of them swapped is another alternative
                flipped = ~flipped
            try:
                turned = flipped[group.ravel()]
                twice = m.stations.select(np.tile(np.arange(len(m.stations)), 2))  # the second time the other way
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
        return [self._weighed(relabelled, model.problem, model.components)]

    def _reversal_ratio(self) -> np.ndarray:
        """Return the log likelihood ratio of each reading, taken in the other direction than labelled, (N,)."""
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
        """Yield the most probable set of runs of which all channels, or one of them, have the other sign."""
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
            if not what and 2.0 * chosen.sum() > len(runs):  # all channels may as well be reversed in the others
                chosen = 1.0 - chosen
            if any(len(np.unique(chosen[family[runs] == n])) > 1 for n in np.unique(family[runs])):
                listed = [m.runs[n].name for n in runs[chosen > 0.0]]
                title = ", ".join(listed[:3]) + (", …" if len(listed) > 3 else "")
                flipped = (by_run[:, runs] @ chosen)[group][cells.of_reading] > 0.0
                name = f"{what}{len(listed)} of {len(runs)} runs ({title}): sign reversed"
                yield Mistake(name, partial(sign_reversed, m, flipped), choices=len(runs) * np.log(2.0))

    def _most_probable(self, gram: np.ndarray, by_run: np.ndarray, family: np.ndarray) -> np.ndarray:
        """Return which runs (columns of by_run) are most probably reversed, by coordinate descent."""
        present = np.unique(family)
        starts = [np.isin(family, [n for n, way in zip(present, ways, strict=True) if way]).astype(float)
                  for ways in product((0, 1), repeat=len(present))]  # fmt: skip
        linear, square = by_run.T @ gram[1:, 0], by_run.T @ gram[1:, 1:] @ by_run
        # Alternating signs are further from every family than descent can go: half of each starts reversed too.
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
        """Return columnsᵀ·K⁻¹·columns, K the covariance of the cells by priors and noise."""
        weights = p.noise[self.problem.kind] ** -1.0
        columns, rows = weights[:, None] * columns, weights[:, None] * self.rows * p.spread
        factor = cho_factor(whitened_precision(self.problem, p), lower=True)
        explained = rows.T @ columns
        return columns.T @ columns - explained.T @ cho_solve(factor, explained)


def _elsewhere_fitted(m: MeasurementSet | None, settings: FitSettings, bases: dict[str, np.ndarray]) -> _Fitted | None:
    """Return the model fitted to readings at other poses; None where no machine can have been there."""
    if m is None:
        return None
    try:
        return _Fitted(Estimation(m, ParameterSpace(m, settings), alone=False), bases)
    except (HexapodError, np.linalg.LinAlgError):
        return None


def _principal(space: ParameterSpace, problem: LinearProblem) -> dict[str, np.ndarray]:
    """Return the components of each block that readings determine, in columns: eigenvectors of their information."""
    posterior = solve(space, problem, space.start_tolerances(), ALIKE)
    weights = np.where(np.isin(np.arange(len(KINDS)), problem.kind), posterior.noise**-2.0, 0.0)
    bases = {}
    for block, tolerance in zip(space.blocks, posterior.tolerances, strict=True):
        information = np.tensordot(weights, problem.normal[:, block.part, block.part], 1) * tolerance**2
        values, vectors = np.linalg.eigh(information)
        bases[block.name] = vectors[:, values > LEAST_DETERMINED]
    return bases


def _with(
    problem: LinearProblem, target: np.ndarray, factor: np.ndarray = ALIKE, rows: np.ndarray | None = None
) -> LinearProblem:
    """Return a problem with other targets, in other units by a factor of each kind, and other rows if given.

    The scatter about a cell's mean is scaled with its kind.
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
    """Return the readings at stations drawn at random, few enough to weigh mistakes."""
    order = np.random.default_rng(0).permutation(len(m.stations))
    count = np.cumsum(np.bincount(m.station, minlength=len(m.stations))[order])
    return m.select(np.isin(m.station, order[count <= max(MOST_READINGS, count[0])]))


def _some_runs(m: MeasurementSet) -> MeasurementSet:
    """Return the readings of runs drawn at random from each family in turn, few enough to try places first."""
    family, drawn = family_of_run(m), np.random.default_rng(0).permutation(len(m.runs))
    rank = np.array([(family[drawn[:n]] == family[run]).sum() for n, run in enumerate(drawn)])
    order = drawn[np.argsort(rank, kind="stable")]
    count = np.cumsum(np.bincount(m.run, minlength=len(m.runs))[order])
    return m.select(np.isin(m.run, order[count <= max(FEW_READINGS, count[0])]))


def common_modes(estimation: Estimation, space: ParameterSpace) -> Iterator[Mode]:
    """Yield what readings may have in common: rigid motions of platform and base, scales of instruments, all screws."""
    m, cells = estimation.measurements, estimation.cells
    stations, directions = m.stations, cells.directions
    points, place = m.points(), max(TOLERANCES["structure"], space.start_tolerances()[0])

    def read(motions: np.ndarray) -> np.ndarray:
        """Return what motions of the measured points, (M, 6), add to cells."""
        return np.einsum("ci,ci->c", directions, motions[cells.station])

    turned = stations.rotations @ m.geometry.tool.rotation
    for axis, name in enumerate(AXES):
        along = turned[:, :, axis]
        causes = f"looks like a probe, or a tool, of which the file has another length or offset than was used; {FORCE}"
        moved = np.hstack([along, np.zeros_like(along)])
        yield Mode(f"measured point along the tool's {name}", causes, "mm", read(moved), place, "structure")
        causes = f"looks like a target or a tool that was mounted turned, or angles with another zero; {FORCE}"
        lever = np.cross(along, points - stations.positions)
        size = place / m.geometry.characteristic_length
        yield Mode(f"platform turned about the tool's {name}", causes, "mrad", read(np.hstack([lever, along])), size)
        causes = f"looks like a work frame, or an instrument's, that is not where the file has it; {FORCE}"
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
        causes = "looks like a laser without compensation of the air, a temperature off 20 °C, or a stated lead "
        causes += f"that is wrong for all screws; {FORCE}"
        scaled = np.where(members, np.einsum("ci,ci->c", directions[:, :3], away), 0.0)
        yield Mode(f"scale of all {kind} readings", causes, "ppm", scaled, usual)
