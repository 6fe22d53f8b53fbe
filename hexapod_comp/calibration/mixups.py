"""Mix-ups: are the readings more probable if they were taken another way than their file says?

A sign, a unit, two channels, a frame, a direction or a machine may have been mixed up. Each such alternative is weighed
against the model as fitted by one likelihood ratio, the ratio of the marginal likelihoods (evidence) of the same
readings under the same blocks of parameters, and is named where that exceeds one prior odds. Blocks that the fit needs
to describe readings that were mixed up cost evidence, which the right way to take them does not have to pay.

Signs change no derivative: with v the values of a group of cells (a channel of a run), all sets of reversed groups are
quadratic forms of one Gram matrix, and the most probable set of reversed runs is found by coordinate descent. The
linear problem is that of the nominal machine.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator
from dataclasses import dataclass, replace
from functools import partial
from itertools import combinations, permutations, product
from typing import NamedTuple

import numpy as np
from scipy.linalg import cho_factor, cho_solve
from scipy.spatial.transform import Rotation

from ..errors import HexapodError
from ..formats.paths import config_file
from ..machine.geometry import HexapodGeometry, load_geometry
from ..machine.kinematics import Structure, strut_lengths_batch
from ..machine.model import MachineModel
from ..machine.passes import Passes
from ..machine.temperatures import REFERENCE_TEMPERATURE
from ..measurements.readings import ANGULAR_KINDS, AXES, CHANNELS, KINDS, LINE_KINDS, UNKNOWN, MeasurementSet, Run
from ..measurements.runs import GEOMETRIES
from ..pose import angles_from_rotation
from ..virtual.instruments import compensated
from .assumptions import ASSUMED
from .blocks import EXPECTED
from .estimator import (
    FEW_ROUNDS,
    ROUNDS,
    Estimation,
    LinearProblem,
    Posterior,
    log_evidence,
    solve,
    whitened_precision,
)
from .parameters import TOLERANCES, FitSettings, ParameterSpace
from .promise import STEEL
from .sensitivity import Prediction, predict

PARALLEL = 0.999  # cosine from which a line is parallel to an axis
MOST_READINGS, FEW_READINGS = 2500, 400  # drawn at random to weigh mix-ups, and to try frames first
FINALISTS = 3  # alternatives of a sort for which sizes of priors are estimated
MODE_ROUNDS = 3  # in which priors are estimated with a mistake that all readings share
STRANGE, PLAUSIBLE, AS_GOOD = 100.0, 10.0, 3.0  # χ² per number of misread checks, of right ones, over the best

FAMILIES = ("x lines", "y lines", "z lines", "other lines", "other runs")
"""Families of runs, by direction in the work frame."""

UNITS = {
    "length": (("µinch", 0.0254), ("0.1 µm", 0.1), ("0.01 mm", 10.0), ("mm", 1e3), ("nm", 1e-3)),
    "angle": (("arcsec", np.pi / 0.648), ("mrad", 1e3), ("mdeg", np.pi / 0.18)),
}
"""Units in which readings may stand that are said to be µm or µrad."""

SWAPPED = "forward and backward look swapped, or the sign of all readings reversed"
UNIT = {"mm": 1e-3, "mrad": 1e-3, "ppm": 1e-6, "µm": 1e-6}
SCALED = ("linear", "length", "position")
"""Kinds of channel whose instrument has a scale."""

FORCE = "correct it, or write the model all the same (--force) if the machine is so"
TURNS = ((1, "by 90°"), (2, "by 180°"), (3, "by -90°"))


@dataclass(frozen=True)
class Alternative:
    """Another way to take the readings."""

    name: str  # "x lines, linear: sign reversed"
    gain: float  # logarithm of the likelihood ratio to the readings as they are
    better: float  # how many times smaller the noise of the kind that gains most becomes
    text: str = ""  # what to print in place of both


class Mode(NamedTuple):
    """What all readings, or all parts of the machine, may have in common, by a mistake rather than by chance."""

    name: str
    causes: str  # what it looks like, and what to do
    unit: str
    effect: np.ndarray  # (C,): what a unit of it, SI, adds to cells' values
    usual: float  # standard deviation of a machine and an instrument with no mistake, SI
    block: str = ""  # whose tolerance, as fitted without the mode, is as usual; empty: none


def family_of_run(measurements: MeasurementSet) -> np.ndarray:
    """Return the index into :data:`FAMILIES` of each run."""
    axes = np.array([run.axis for run in measurements.runs]).reshape(-1, 3) @ measurements.geometry.work.rotation
    parallel = np.abs(axes) > PARALLEL
    family = np.where(parallel.any(axis=1), parallel.argmax(axis=1), 3)
    return np.where(axes.any(axis=1), family, 4)


def mixups(
    everything: Estimation,
    problem: LinearProblem,
    blocks: Collection[str],
    progress: Callable[[str], object] = lambda text: None,
) -> list[str]:
    """Return by name how the readings must have been taken; the best and those that nothing tells from it; or none.

    Parameters
    ----------
    everything, problem
        The readings against all parameters that may be used, linearised at the nominal machine.
    blocks
        Names of the blocks that the fit uses beside the structure.
    progress
        Called with what is tried.
    """
    m = everything.measurements
    if len(m) > MOST_READINGS:
        m = _thinned(m, MOST_READINGS)
        everything = Estimation(m, everything.space, alone=False)
        problem, _ = everything.linearise(np.zeros(everything.space.size), np.ones(len(m)))
    progress("are the readings more probable, taken another way?")
    try:
        # What every screw has belongs to readings taken rightly, though a fit may do without where they are mixed up.
        blocks = {*blocks, *(name for name in EXPECTED if everything.space.block(name))}
        model = _Fitted(everything, problem, blocks)
        found = [*model.common_modes(), *model.other_directions()]
        if not blocks <= set(EXPECTED) or (model.posterior.noise[model.kinds] >= ASSUMED.misfit[0]).any():
            # Otherwise a machine and its screws alone describe the readings.
            found += [*model.reversed_signs(), *model.other_units(), *model.otherwise(_relabelled(m))]
            found += _elsewhere(m, model, blocks)
    except (HexapodError, np.linalg.LinAlgError):
        return []
    best = max((other.gain for other in found), default=0.0)
    odds = np.log(ASSUMED.mixup_odds)
    named = [other for other in found if other.gain > max(odds, best - odds)]
    return [n.text or f"{n.name} fits {n.better:.3g} times better" for n in sorted(named, key=lambda n: -n.gain)]


def swapped_directions(everything: Estimation, problem: LinearProblem, blocks: Collection[str]) -> bool:
    """Return whether most struts have a backlash clearly below zero: no nut leads its screw."""
    block = everything.space.block("backlash")
    if block is None:
        return False
    space, posterior = everything.space, _Fitted(everything, problem, {*blocks, "backlash"}).posterior
    y = np.zeros(space.size)
    y[posterior.used] = posterior.y
    backlash = space.physical(y)[block.part]
    deviation = np.sqrt(np.diag(posterior.covariance))[
        np.searchsorted(posterior.used, np.arange(space.size)[block.part])
    ]
    return bool((backlash < -ASSUMED.surely * deviation).sum() > len(backlash) // 2)


class _Way(NamedTuple):
    """A common mode under one prior."""

    amplitude: float  # the most probable one, SI
    deviation: float  # the prior's, SI
    evidence: float  # logarithm


class _Fitted:
    """The fitted model's linear problem, and how probable readings that were taken otherwise are under it."""

    def __init__(
        self, estimation: Estimation, problem: LinearProblem, blocks: Collection[str], start: _Fitted | None = None
    ) -> None:
        self.estimation, self.problem, self._blocks = estimation, problem, set(blocks)
        self.space = space = estimation.space
        kept = np.array([n == 0 or block.name in blocks for n, block in enumerate(space.blocks)])
        self._first_guess = np.where(kept, space.start_tolerances(), 0.0)
        if start is None:
            self.posterior = solve(space, problem, self._first_guess, np.ones(len(KINDS)), ROUNDS)
        else:
            known = dict(zip([b.name for b in start.space.blocks], start.posterior.tolerances, strict=True))
            tolerances = np.array([known[block.name] for block in space.blocks])
            self.posterior = solve(space, problem, tolerances, start.posterior.noise, FEW_ROUNDS)
        self.kinds = np.unique(problem.kind)
        self.evidence = self.evidence_early = log_evidence(problem, self.posterior)
        if start is None:
            few = solve(space, problem, self._first_guess, np.ones(len(KINDS)), FEW_ROUNDS)
            self.evidence_early = log_evidence(problem, few)
        self._rows = problem.rows.dense()[:, self.posterior.used]

    def compared(
        self, name: str, problem: LinearProblem, scale: np.ndarray, rounds: int, choices: float = 0.0
    ) -> Alternative:
        """Return an alternative by its linear problem; values that were scaled have their density scaled (Jacobian).

        After few rounds it is compared with the readings as they are after as few.
        `choices` is the logarithm of how many equally probable alternatives this one was chosen from.
        """
        p = self.posterior
        # From the first guess on, as the fit itself: noise that a mix-up has blown up can hold its own ground.
        tried = solve(self.space, problem, self._first_guess, np.ones(len(KINDS)), rounds)
        jacobian = float(problem.freedom[self.kinds] @ np.log(scale[self.kinds]))
        as_read = self.evidence if rounds == ROUNDS else self.evidence_early
        gain = log_evidence(problem, tried) + jacobian - as_read - choices
        return Alternative(name, gain, float((p.noise * scale / tried.noise)[self.kinds].max()))

    def common_modes(self) -> list[Alternative]:
        """Return what is more probably a mistake that all readings share than a machine whose parts err alike.

        The amplitude a of a mode d has the prior N(0, σ²): σ is usual for a right machine, or `mistaken` times that.
        With K the readings' covariance without it, h = dᵀK⁻¹t and I = dᵀK⁻¹d, it changes their log evidence by
        ½h²σ²/(1 + σ²I) − ½log(1 + σ²I). Parts that shift alike blow their block's tolerance up, which hides the mode:
        tolerances and noise are estimated anew under either prior.
        """
        found = []
        modes = list(common_modes(self.estimation, self.space))
        effects = self.estimation.free_of_nuisance(np.column_stack([mode.effect for mode in modes]))
        # A mistake shows where the tolerances are those of a right machine, if it does not where it has blown them up.
        usual_machine = solve(self.space, self.problem, self._first_guess, self.posterior.noise, rounds=0)
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
            gain = mistaken.evidence - usual.evidence
            found.append(Alternative(mode.name, gain, 1.0, f"{mode.name}: {size}: {mode.causes}"))
        return found

    def _with_mode(self, effect: np.ndarray, mode: Mode, times: float, posterior: Posterior) -> tuple[_Way, Posterior]:
        """Return the evidence with a mode, by tolerances and noise that are estimated with it, and the posterior."""
        for _ in range(MODE_ROUNDS):
            way = self._by_mode(effect, mode, times, posterior)
            rest = self.with_target(self.problem.target - way.amplitude * effect, np.ones(len(KINDS)))
            posterior = solve(self.space, rest, posterior.tolerances, posterior.noise, FEW_ROUNDS)
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
        plain = solve(self.space, self.problem, posterior.tolerances, posterior.noise, rounds=0)
        tolerances = dict(zip([b.name for b in self.space.blocks], plain.tolerances, strict=True))
        deviation = times * max(mode.usual, tolerances.get(mode.block, 0.0))
        (_, h), (_, information) = self._gram(np.column_stack([self.problem.target, effect]), plain)
        grown = 1.0 + deviation**2 * information
        gain = 0.5 * h**2 * deviation**2 / grown - 0.5 * np.log(grown)
        return _Way(deviation**2 * h / grown, deviation, log_evidence(self.problem, plain) + gain)

    def other_directions(self) -> list[Alternative]:
        """Return readings taken the other way than labelled, each by its own likelihood ratio, if any are.

        A strut's backlash moves a reading by Δ or, taken the other way, by −Δ. Readings that the other way explains
        better are relabelled and the model is fitted again, for wrong labels have hidden a part of the backlash. Which
        they are is one choice of 2ⁿ.
        """
        block, m = self.space.block("backlash"), self.estimation.measurements
        if block is None or not (m.direction != UNKNOWN).any():
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
            ratio = np.bincount(group.ravel(), known * model._reversal_ratio(block.part))
            if np.maximum(ratio, 0.0).sum() < np.log(ASSUMED.mixup_odds):
                break
            flipped ^= ratio > 0.0
            if 2 * flipped.sum() > len(flipped):  # the majority is right: all of them swapped is another alternative
                flipped = ~flipped
            other = _turned_back(m, flipped[group.ravel()])
            problem = _linearised(other, self.space, None)
            if problem is None:
                return []
            estimation = Estimation(other, self.space, alone=False)
            model = _Fitted(estimation, problem, [b.name for b in self.space.blocks if b.name in self._blocks])
        if model is self:
            return []
        gain = model.evidence - self.evidence - len(groups) * np.log(2.0)
        better = float((self.posterior.noise / model.posterior.noise)[self.kinds].max())
        counts = f"direction of {int(flipped.sum())} of {len(flipped)} readings: forward and backward exchanged"
        return [Alternative(counts, gain, better)]

    def _reversal_ratio(self, backlash: slice) -> np.ndarray:
        """Return the log likelihood ratio of each reading, taken in the other direction than labelled, (N,)."""
        m, c, p = self.estimation.measurements, self.estimation.cells, self.posterior
        scale = np.sqrt(np.bincount(c.of_reading, self.estimation.uncertainty**-2))
        of_backlash = (p.used >= backlash.start) & (p.used < backlash.stop)
        moved = (self._rows[:, of_backlash] @ p.y[of_backlash] / scale)[c.of_reading]
        left = ((self.problem.target - self._rows @ p.y) / scale)[c.of_reading]
        left = left + m.value - self._cell_values(m.value)[c.of_reading]
        sigma = self.estimation.uncertainty * p.noise[m.kind]
        return 0.5 * (left**2 - (left + 2.0 * moved) ** 2) / sigma**2

    def with_target(self, target: np.ndarray, scale: np.ndarray) -> LinearProblem:
        """Return the problem of values that were changed, but not where they were taken."""
        problem = self.problem
        square, moment = problem.square.copy(), problem.moment.copy()
        for k in self.kinds:
            members = problem.kind == k
            scatter = square[k] - problem.target[members] @ problem.target[members]
            square[k] = scale[k] ** 2 * scatter + target[members] @ target[members]
            moment[k] = 0.0
            moment[k][self.posterior.used] = self._rows[members].T @ target[members]
        return replace(problem, target=target, moment=moment, square=square)

    def reversed_signs(self) -> list[Alternative]:
        """Return sets of cells whose sign is more probably reversed: families, channels, and runs as they come out."""
        m, cells, unscaled = self.estimation.measurements, self.estimation.cells, np.ones(len(KINDS))
        run, first = m.run[cells.first], cells.first
        groups, group = np.unique(np.stack([run, cells.channel]), axis=1, return_inverse=True)
        group = group.ravel()
        values = self._cell_values(m.value)
        change = np.zeros((len(group), groups.shape[1]))
        change[np.arange(len(group)), group] = -2.0 * values
        change = self.estimation.free_of_nuisance(change)
        gram = self._gram(np.column_stack([self.problem.target, change]))

        def target(flipped: np.ndarray) -> np.ndarray:
            return self.problem.target + change @ flipped

        tried = []
        for name, members in _parts(m):
            flipped = np.zeros(groups.shape[1])
            flipped[group[members[first]]] = 1.0
            if 0.0 < flipped.sum() < len(flipped):
                tried.append((_screened(gram, flipped), 0.0, f"{name}: sign reversed", flipped))
        family = family_of_run(m)
        names = [("", np.ones(groups.shape[1], dtype=bool))]
        channels = np.unique(groups[1])
        names += [(f"{CHANNELS[c]} of ", groups[1] == c) for c in channels if len(channels) > 1]
        for what, members in names:
            by_run = np.zeros((groups.shape[1], len(m.runs)))
            by_run[np.arange(groups.shape[1]), groups[0]] = members
            runs = np.flatnonzero(by_run.any(axis=0))
            chosen = self._most_probable(gram, by_run[:, runs], family[runs], bool(what))
            if not what and 2.0 * chosen.sum() > len(runs):  # all channels may as well be reversed in the others
                chosen = 1.0 - chosen
            if any(len(np.unique(chosen[family[runs] == n])) > 1 for n in np.unique(family[runs])):
                listed = [m.runs[n].name for n in runs[chosen > 0.0]]
                title = ", ".join(listed[:3]) + (", …" if len(listed) > 3 else "")
                flipped = by_run[:, runs] @ chosen
                name = f"{what}{len(listed)} of {len(runs)} runs ({title}): sign reversed"
                tried.append((_screened(gram, flipped), len(runs) * np.log(2.0), name, flipped))
        tried = sorted((t for t in tried if t[0] > 0.0), key=lambda t: -t[0])[:FINALISTS]
        rounds = ROUNDS
        return [
            self.compared(name, self.with_target(target(flipped), unscaled), unscaled, rounds, choices)
            for _, choices, name, flipped in tried
        ]

    def _most_probable(self, gram: np.ndarray, by_run: np.ndarray, family: np.ndarray, single: bool) -> np.ndarray:
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

    def other_units(self) -> list[Alternative]:
        """Return kinds of channel that are more probably in another unit."""
        m = self.estimation.measurements
        values, tried = self._cell_values(m.value), []
        for name, kinds, factor in _in_other_units(m):
            scale = np.ones(len(KINDS))
            scale[kinds] = factor
            change = self.estimation.free_of_nuisance(((scale[self.problem.kind] - 1.0) * values)[:, None])[:, 0]
            problem = self.with_target(self.problem.target + change, scale)
            tried.append((self.compared(name, problem, scale, FEW_ROUNDS), problem, scale))
        tried = sorted((t for t in tried if t[0].gain > 0.0), key=lambda t: -t[0].gain)[:1]
        return [self.compared(t.name, problem, scale, ROUNDS) for t, problem, scale in tried]

    def otherwise(self, others: Iterator[tuple[str, MeasurementSet]]) -> list[Alternative]:
        """Return alternatives with other derivatives, the most probable ones."""
        tried, unscaled = [], np.ones(len(KINDS))
        here = self.estimation.measurements.stations
        prediction = predict(self.space, np.zeros(self.space.size), here)
        for name, measurements in others:
            problem = _linearised(measurements, self.space, prediction if measurements.stations is here else None)
            if problem is not None:
                tried.append((self.compared(name, problem, unscaled, FEW_ROUNDS), problem))
        tried = sorted((t for t in tried if t[0].gain > 0.0), key=lambda t: -t[0].gain)[:FINALISTS]
        return [self.compared(t.name, problem, unscaled, ROUNDS) for t, problem in tried]

    def _cell_values(self, values: np.ndarray) -> np.ndarray:
        of_reading, weights = self.estimation.cells.of_reading, self.estimation.uncertainty**-2
        return np.bincount(of_reading, weights * values) / np.bincount(of_reading, weights)

    def _gram(self, columns: np.ndarray, posterior: Posterior | None = None) -> np.ndarray:
        """Return columnsᵀ·K⁻¹·columns, K the covariance of the cells by priors and noise."""
        p = posterior or self.posterior
        weights = p.noise[self.problem.kind] ** -1.0
        columns, rows = weights[:, None] * columns, weights[:, None] * self._rows * p.spread
        factor = cho_factor(whitened_precision(self.problem, p), lower=True)
        explained = rows.T @ columns
        return columns.T @ columns - explained.T @ cho_solve(factor, explained)


def common_modes(estimation: Estimation, space: ParameterSpace) -> Iterator[Mode]:
    """Yield what readings may have in common: rigid motions of platform and base, scales of instruments, all screws."""
    m, cells = estimation.measurements, estimation.cells
    stations, directions = m.stations, cells.directions
    points, place = m.points(), max(TOLERANCES["structure"], dict(space.settings.tolerances)["structure"])

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


def _turned_back(m: MeasurementSet, readings: np.ndarray) -> MeasurementSet:
    """Return a set in which some readings, (N,), were taken in the other direction."""
    twice = m.stations.select(np.tile(np.arange(len(m.stations)), 2))
    sense = twice.sense.copy()
    sense[len(m.stations) :] *= -1.0
    direction = np.where(readings, -m.direction, m.direction)
    stations = replace(twice, sense=sense)
    return replace(m, stations=stations, station=m.station + len(m.stations) * readings, direction=direction)


def _screened(gram: np.ndarray, flipped: np.ndarray) -> float:
    """Return the logarithm of the likelihood ratio of reversed groups of cells, noise and priors as they are."""
    return float(-0.5 * (2.0 * flipped @ gram[1:, 0] + flipped @ gram[1:, 1:] @ flipped))


def _linearised(m: MeasurementSet, space: ParameterSpace, prediction: Prediction | None) -> LinearProblem | None:
    """Return the problem of readings taken otherwise; None where no machine could have taken them so."""
    try:
        return Estimation(m, space, alone=False).linearise(np.zeros(space.size), np.ones(len(m)), prediction)[0]
    except (HexapodError, np.linalg.LinAlgError):
        return None


def _elsewhere(m: MeasurementSet, model: _Fitted, blocks: Collection[str]) -> list[Alternative]:
    """Return alternatives in which the machine stood elsewhere, of as many readings as tell; by all where one does."""
    if not np.allclose(m.stations.commands, _nominal(m.geometry, m), rtol=0.0, atol=1e-9):
        return []
    few = _thinned(m, FEW_READINGS)
    settings = replace(model.space.settings, blocks=tuple(blocks))
    small = _of(few, settings, blocks, model)
    clear = []
    for name, moved in _moved_machines():
        try:
            there = moved(few)
        except HexapodError:  # no machine stands there
            continue
        if (other := _of(there, settings, blocks, model)) is not None and small is not None:
            gain = other.evidence - small.evidence
            if gain > np.log(ASSUMED.mixup_odds):
                clear.append((gain, name, moved))
    found = []
    for _, name, moved in sorted(clear, key=lambda c: -c[0])[:FINALISTS]:
        if (other := _of(moved(m), settings, blocks)) is not None:
            better = float((model.posterior.noise / other.posterior.noise)[model.kinds].max())
            found.append(Alternative(name, other.evidence - model.evidence, better))
    return found


def _of(
    m: MeasurementSet | None, settings: FitSettings, blocks: Collection[str], start: _Fitted | None = None
) -> _Fitted | None:
    """Return the fitted model of readings with stations of their own; None where no machine can have taken them."""
    if m is None:
        return None
    try:
        estimation = Estimation(m, ParameterSpace(m, settings), alone=False)
        problem, _ = estimation.linearise(np.zeros(estimation.space.size), np.ones(len(m)))
        return _Fitted(estimation, problem, blocks, start)
    except (HexapodError, np.linalg.LinAlgError):
        return None


def _thinned(m: MeasurementSet, count: int) -> MeasurementSet:
    """Return so many readings, drawn at random."""
    if len(m) <= count:
        return m
    chosen = np.zeros(len(m), dtype=bool)
    chosen[np.random.default_rng(0).choice(len(m), count, replace=False)] = True
    return m.select(chosen)


def _parts(m: MeasurementSet) -> Iterator[tuple[str, np.ndarray]]:
    """Yield name and mask of parts whose sign somebody may have reversed: families, their kinds, and channels."""
    family = family_of_run(m)[m.run]
    for number, name in enumerate(FAMILIES):
        members = family == number
        kinds = np.unique(m.kind[members])
        if members.any() and not members.all():
            yield name, members
        if len(kinds) > 1:
            for k in kinds:
                yield f"{name}, {KINDS[k]}", members & (m.kind == k)
    for channel in np.unique(m.channel):
        members = m.channel == channel
        if not members.all():
            yield CHANNELS[channel], members
        for number in np.unique(family[members]):
            if KINDS[m.kind[members][0]] != "linear":
                yield f"{FAMILIES[number]}, {CHANNELS[channel]}", members & (family == number)


def _in_other_units(m: MeasurementSet) -> Iterator[tuple[str, np.ndarray, float]]:
    """Yield name, kinds and factor of each kind in each other unit, those of lines together, and all."""
    present = np.unique(m.kind)
    angular = np.array([KINDS[k] in ANGULAR_KINDS for k in present])
    for which, meant, kinds in (("length", "µm", present[~angular]), ("angle", "µrad", present[angular])):
        together = [(f"all {which}s", kinds)] if len(kinds) > 1 else []
        of_lines = [k for k in kinds if KINDS[k] in LINE_KINDS]
        if 1 < len(of_lines) < len(kinds):
            together.append((" and ".join(KINDS[k] for k in of_lines), np.array(of_lines)))
        for (name, members), (unit, factor) in product([*together, *((KINDS[k], [k]) for k in kinds)], UNITS[which]):
            yield f"{name}: {unit} in place of {meant}", np.asarray(members), factor


def _relabelled(m: MeasurementSet) -> Iterator[tuple[str, MeasurementSet]]:
    """Yield two channels of a kind exchanged, everywhere and in one family of runs; and other directions."""
    family, present = family_of_run(m)[m.run], np.unique(m.channel)
    for a, b in combinations(present, 2):
        if CHANNELS[a].partition("_")[0] != CHANNELS[b].partition("_")[0]:
            continue
        both = (m.channel == a) | (m.channel == b)
        common = [n for n in np.unique(family[both]) if {a, b} <= set(m.channel[family == n].tolist())]
        for name, where in [("", both), *((f"{FAMILIES[n]}, ", both & (family == n)) for n in common)]:
            if where is both and CHANNELS[a].startswith("straightness") and (family[both] < 3).any():
                continue  # along its own line it is none
            title = f"{name}{CHANNELS[a]} and {CHANNELS[b]}: exchanged"
            yield title, replace(m, channel=np.where(where, a + b - m.channel, m.channel))
    swapped = replace(m.stations, sense=-m.stations.sense)
    yield "forward and backward: swapped", replace(m, direction=-m.direction, stations=swapped)


Moved = Callable[[MeasurementSet], MeasurementSet | None]


def _moved_machines() -> Iterator[tuple[str, Moved]]:
    """Yield other places where the machine may have stood: frames exchanged, mirrored and turned, angles, machines."""
    for a, b in combinations(range(3), 2):
        order = np.eye(3)
        order[[a, b]] = order[[b, a]]
        yield f"{AXES[a]} and {AXES[b]}: exchanged", partial(in_frame, frame=order)
    for a, axis in enumerate(AXES):
        mirror = np.diag(1.0 - 2.0 * np.eye(3)[a])
        yield f"{axis}: mirrored", partial(in_frame, frame=mirror)
        yield f"{axis}: mirrored, rotations as well", partial(in_frame, frame=mirror, axial=True)
        for quarters, name in TURNS:
            turn = Rotation.from_rotvec(0.5 * np.pi * quarters * np.eye(3)[a]).as_matrix().round()
            yield f"the work frame: turned about {axis} {name}", partial(in_frame, frame=turn)
    for axes in permutations(AXES):
        if axes != ("y", "x", "z"):  # R = Ry(β)·Rx(α)·Rz(γ)
            yield f"angles: turned about {', '.join(axes)} in turn", partial(_in_order, order="".join(axes).upper())
    for name in GEOMETRIES:
        geometry = load_geometry(config_file(name))
        yield f"the geometry of {geometry.name}", partial(_of_machine, geometry=geometry)


def in_frame(m: MeasurementSet, frame: np.ndarray, axial: bool = False) -> MeasurementSet:
    """Return a set whose poses, lines and channels stand in axes that are columns of a signed permutation.

    A mirrored file has the signs of its columns reversed, rotations among them, unless these are `axial` vectors.
    """
    tips, tools = m.geometry.tool_poses(m.stations.positions, m.stations.rotations)
    handed = round(float(np.linalg.det(frame)))
    turned = frame @ tools @ frame.T
    if handed < 0 and not axial:
        turned = np.swapaxes(turned, 1, 2)
    work = m.geometry.work
    in_base = work.rotation @ frame @ work.rotation.T
    to, sign = np.abs(frame).argmax(axis=0), frame.sum(axis=0)
    channel, factor = np.arange(len(CHANNELS)), np.ones(len(CHANNELS))
    for index, name in enumerate(CHANNELS):
        kind, _, axis = name.partition("_")
        if axis:
            a = AXES.index(axis)
            channel[index] = CHANNELS.index(f"{kind}_{AXES[to[a]]}")
            factor[index] = sign[a] * (handed if axial and kind in ANGULAR_KINDS else 1)
    centre = work.position + (m.centre - work.position) @ in_base.T
    value = factor[m.channel] * m.value
    renamed = replace(m, channel=channel[m.channel], value=value, centre=centre, runs=_turned_runs(m, in_base))
    return _sent(renamed, m.geometry, *m.geometry.platform_poses(tips @ frame.T, turned), in_base)


def _in_order(m: MeasurementSet, order: str) -> MeasurementSet | None:
    """Return a set whose angles were applied in another order; None where the tool was level."""
    tips, tools = m.geometry.tool_poses(m.stations.positions, m.stations.rotations)
    angles = angles_from_rotation(tools)
    if (np.abs(angles) > 1e-6).sum(axis=1).max() < 2:
        return None
    by_axis = angles[:, ["XYZ".index(axis) for axis in order]]
    turned = Rotation.from_euler(order, by_axis).as_matrix()
    return _sent(m, m.geometry, *m.geometry.platform_poses(tips, turned), np.eye(3))


def _of_machine(m: MeasurementSet, geometry: HexapodGeometry) -> MeasurementSet | None:
    """Return a set as if another machine's tool had gone the same way in its work frame."""
    if geometry.name == m.geometry.name:
        return None
    tips, tools = m.geometry.tool_poses(m.stations.positions, m.stations.rotations)
    turn = geometry.work.rotation @ m.geometry.work.rotation.T
    moved = replace(m, runs=_turned_runs(m, turn), geometry=geometry, probe=geometry.tool.position)
    return _sent(moved, geometry, *geometry.platform_poses(tips, tools), turn)


def _turned_runs(m: MeasurementSet, turn: np.ndarray) -> tuple[Run, ...]:
    return tuple(replace(run, axis=turn @ run.axis) for run in m.runs)


def _sent(
    m: MeasurementSet, geometry: HexapodGeometry, positions: np.ndarray, rotations: np.ndarray, turn: np.ndarray
) -> MeasurementSet:
    """Return a set with other poses, the lengths that its machine is sent there with, and directions turned alike."""
    moving = Passes(geometry, positions, rotations, m.stations.sense[:, :3] @ turn.T)
    stations = replace(
        m.stations, positions=positions, rotations=rotations, commands=moving.nominal_commands(), sense=moving.senses()
    )
    return replace(m, stations=stations)


def _nominal(geometry: HexapodGeometry, m: MeasurementSet) -> np.ndarray:
    return strut_lengths_batch(Structure.of(geometry), m.stations.positions, m.stations.rotations)


def best_alternative_reading(
    m: MeasurementSet, model: MachineModel, as_they_are: float, chi_square: Callable[[MeasurementSet], float]
) -> list[str]:
    """Return by name how check readings must be taken to be those of a machine that has not changed; the best, or none.

    Parameters
    ----------
    m, model
        The readings, and the model that they check.
    as_they_are
        Their χ² per number.
    chi_square
        Returns χ² per number of readings against the model and what its fit knows.
    """
    if as_they_are < STRANGE:
        return []
    clear = []
    for name, tried in _checked_otherwise(m, model):
        try:
            value = chi_square(tried())
        except HexapodError:  # out of reach that way
            continue
        if value < PLAUSIBLE:
            clear.append((value, name))
    best = min(clear, default=(0.0, ""))[0]
    times = [(value, f"{name} fits {np.sqrt(as_they_are / value):.3g} times better") for value, name in sorted(clear)]
    return [text for value, text in times if value <= AS_GOOD * best]


def _checked_otherwise(m: MeasurementSet, model: MachineModel) -> Iterator[tuple[str, Callable[[], MeasurementSet]]]:
    """Yield other ways to take check readings."""
    if np.allclose(m.stations.commands, _nominal(m.geometry, m), rtol=0.0, atol=1e-9):
        yield "taken with this model running (--compensated)", lambda: compensated(m, model)
        for a, b in combinations(range(3), 2):
            order = np.eye(3)
            order[[a, b]] = order[[b, a]]
            yield f"{AXES[a]} and {AXES[b]}: exchanged", partial(in_frame, m, order)
    else:
        off = replace(m, stations=replace(m.stations, commands=_nominal(m.geometry, m)))
        yield "taken with the compensation off", lambda: off
    yield "all readings: sign reversed", lambda: m.with_values(-m.value)
    for name, members in _parts(m):
        yield f"{name}: sign reversed", partial(m.with_values, np.where(members, -m.value, m.value))
    for name, kinds, factor in _in_other_units(m):
        yield name, partial(m.with_values, np.where(np.isin(m.kind, kinds), factor, 1.0) * m.value)
    for name, other in _relabelled(m):
        if "exchanged" in name:
            yield name, partial(replace, other)
