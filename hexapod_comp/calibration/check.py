"""Is a model still valid? Check readings are weighed by the Bayes factor of each possible change.

The readings of an unchanged machine scatter about its model by N(0, S), S = J·Σ·Jᵀ + noise. A change moves parameters
by A·θ, θ ~ N(0, s²), with several scales s, equally likely: under it they are N(0, S + s²·J·A·Aᵀ·Jᵀ).
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from datetime import date
from typing import Any

import numpy as np

from ..errors import CalibrationError, ModelError
from ..formats.texts import aligned, number
from ..machine.arrays import rms
from ..machine.geometry import STRUT_NAMES
from ..machine.load import Payload, beyond_loads
from ..machine.model import MachineModel, RealMachine
from ..machine.region import region_json, region_text
from ..measurements.readings import ABSOLUTE_KINDS, AXES, BACKWARD, CHANNELS, KINDS, MeasurementSet
from .assumptions import ASSUMED
from .blocks.block import DIGITS, Linkage
from .blocks.load import measured_loads, stated_load
from .datum import hold, unseen_part
from .design import TILTS, information, laid_out
from .estimator import Estimation
from .mixups import best_alternative_reading
from .parameters import BLOCKS, ParameterSpace
from .posterior import ErrorPredictor, FittedParameters, box_stations
from .sensitivity import derivatives, predict
from .trust import TILT

MOST_READINGS = 500  # of a check; more are a calibration
UNCHANGED_DRAWS = 4000  # machines drawn to find the false alarms: 1 % to ± 0.16 %

DATUM, STRUT, TEMPERATURE, PAYLOAD = "datum", "strut", "temperature", "payload"
AGEING, READING, OTHER = "ageing", "reading", "other"
# Kinds of change with their names. Few readings can repair all but payload and the last two.
FAMILIES = {
    DATUM: "the datum has moved",
    STRUT: "a strut's offset has changed",
    TEMPERATURE: "a temperature acts",
    PAYLOAD: "the payload has changed",
    AGEING: "the whole machine has aged",
    READING: "a single reading is wrong",
    OTHER: "it has changed in a way that none of these explains",
}

HEAVIER = "heavier or lighter"  # the name of a change of the payload in its centre
# weight relative to the trace: parameters that represent a payload then stay small at the corners of the box too
RIDGE = 1e-8
ROUNDING = 1e-9  # directions of readings or effects that are smaller, relative to the largest, are rounding


@dataclass(frozen=True)
class Change:
    """One possible change: parameters move by `columns`·θ, θ ~ N(0, scale²)."""

    family: str  # of FAMILIES
    name: str
    scales: np.ndarray  # (m,): standard deviations of θ
    columns: np.ndarray | None = None  # (size, k), SI; None: readings have changed, not the machine
    # label, factor, unit of each θ; empty: they have no meaning one by one
    shown: tuple[tuple[str, float, str], ...] = ()
    group: str = ""  # similar changes of a kind; all groups of a kind are equally likely beforehand


def widened(fitted: FittedParameters, blocks: tuple[str, ...] = BLOCKS) -> FittedParameters:
    """Return a fit's result in a space with more blocks; these are zero and, so far, certain."""
    old = fitted.space
    kept = {block.name for block in old.blocks}
    settings = replace(old.settings, blocks=tuple(name for name in BLOCKS if name in kept or name in blocks))
    space = ParameterSpace((old.geometry, old.region), settings)
    places = np.concatenate([np.arange(b.part.start, b.part.stop) for b in space.blocks if b.name in kept])
    x, covariance = np.zeros(space.size), np.zeros((space.size, space.size))
    x[places], covariance[np.ix_(places, places)] = fitted.x, fitted.covariance
    known = {block.name: value for block, value in zip(old.blocks, fitted.tolerances, strict=True)}
    start = space.start_tolerances()
    tolerances = np.array([known.get(b.name, value) for b, value in zip(space.blocks, start, strict=True)])
    return FittedParameters(space, x, covariance, tolerances, fitted.noise, fitted.held)


def possible_changes(space: ParameterSpace, modelled: Sequence[str]) -> list[Change]:
    """Return the possible changes of a machine, in a space that has all blocks; those of its fit, `modelled`, age."""
    geometry, unit = space.geometry, np.eye(space.size)
    start, count = space.blocks[0].part.start, int(space.platform_groups.max()) + 1
    base = start + np.arange(18).reshape(6, 3)
    platform = start + 18 + np.arange(3 * count).reshape(count, 3)
    offsets = np.arange(space.size)[space.offsets]
    lengths, growths = np.array(ASSUMED.moved), np.array(ASSUMED.grown)

    def shown(names: Sequence[str], factor: float = 1e6, what: str = "µm") -> tuple[tuple[str, float, str], ...]:
        return tuple((name, factor, what) for name in names)

    # The datum turns about the box's centre; a turn is counted by how far it moves the box's corners.
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
        ("all alike", ["all"], grown.sum(axis=1, keepdims=True)),
        ("each by itself", bodies, grown),
    ):
        changes.append(Change(TEMPERATURE, name, growths, columns, shown(labels, 1e6, "ppm")))

    changes += payload_changes(space)

    # Ageing and a bend can represent each other: if one's scales were coarser, the other would win, whichever is true.
    prior = space.physical(np.diag(space.spread(space.start_tolerances())))
    owner = np.repeat([block.name for block in space.blocks], [len(block.labels) for block in space.blocks])
    aged, bend = prior[:, np.isin(owner, modelled)], prior[:, np.isin(owner, ("field displacement", "field rotation"))]
    changes.append(Change(AGEING, "all of it, a little", np.array(ASSUMED.aged), aged))
    for body, joints in (("base", base), ("platform", platform)):
        for n, places in enumerate(joints, start=1):
            changes.append(Change(OTHER, f"{body} joint {n}", lengths, unit[:, places], shown(AXES), "joints"))
    for name, ends, what in (("pitch", ASSUMED.worn_pitch, "ppm"), ("backlash", ASSUMED.worn_backlash, "µm")):
        for strut, column in zip(STRUT_NAMES, unit.T[owner == name], strict=False):  # no such block: none
            screw = Change(
                OTHER, f"{name} of {strut}", np.array(ends), column[:, None], shown([strut], 1e6, what), "screws"
            )
            changes.append(screw)
    changes.append(Change(OTHER, "a smooth bend in space", np.array(ASSUMED.bent), bend, group="bend"))
    return changes


def payload_changes(space: ParameterSpace) -> list[Change]:
    """Return a change of the payload, in the machine's centre or beside it, as parameters with the same effect.

    The stretch of struts under a weight is a smooth function of the pose; over the measured box, level and tilted, the
    most probable parameters with that effect represent it. Where no stiffness is stated, all struts have an assumed
    one, and masses are so many kg at that.
    """
    stations = [box_stations(space, tilt) for tilt in (0.0, TILT)]
    if stations[0] is None or stations[1] is None:
        return []
    load, zero, parts = stated_load(space.settings), np.zeros(space.size), []
    known = bool(load.stiffness.all())
    compliance = load.compliance if known else np.full(6, 1.0 / ASSUMED.stiffness)
    aside = space.geometry.characteristic_length * np.linalg.svd(load.gravity[None])[2][1:]  # lie across gravity
    for at in filter(None, stations):
        prediction = predict(space, zero, at)
        linkage = Linkage(prediction, space.probe, at)
        forces = [np.concatenate([load.gravity, np.zeros(3)])]
        forces += [np.concatenate([np.zeros(3), np.cross(arm, load.gravity)]) for arm in aside]
        stretched = [compliance * linkage.tensions(np.tile(force, (len(at), 1))) for force in forces]
        errors = linkage.per_length @ np.stack(stretched, axis=2)
        parts.append((derivatives(space, prediction, at), errors))
    rows, errors = (np.concatenate(each) for each in zip(*parts, strict=True))
    rows[:, 3:] *= space.geometry.characteristic_length
    errors[:, 3:] *= space.geometry.characteristic_length
    # none that depends on load or warmth
    smooth = ("structure", "pitch", "map", "field displacement", "field rotation")
    owner = np.repeat([block.name for block in space.blocks], [len(block.labels) for block in space.blocks])
    prior = space.physical(np.diag(space.spread(space.start_tolerances())))[:, np.isin(owner, smooth)]
    design = rows.reshape(-1, space.size) @ prior
    square = design.T @ design
    square[np.diag_indices(len(square))] += RIDGE * np.trace(square)
    columns = prior @ np.linalg.solve(square, design.T @ errors.reshape(-1, len(aside) + 1))
    unit, sizes = "kg" if known else f"kg at {ASSUMED.stiffness * 1e-6:g} N/µm", np.array(ASSUMED.loaded)
    radius = space.geometry.characteristic_length
    shown = (("mass", 1.0, unit), *((f"moment {n}", radius, unit.replace("kg", "kg m", 1)) for n in (1, 2)))
    return [
        Change(PAYLOAD, HEAVIER, sizes, columns[:, :1], shown[:1]),
        Change(PAYLOAD, "with its centre elsewhere too", sizes, columns, shown),
    ]


@dataclass(frozen=True)
class CheckReadings:
    """Check readings with the prediction of a model and its fit, as n numbers free of the instruments' unknowns."""

    residuals: np.ndarray  # (n,): deviations from the fit's prediction, in standard deviations
    rows: np.ndarray  # (n, size): derivatives by the parameters
    noise: np.ndarray  # (n, n): their covariance if the machine is known
    single: np.ndarray  # (n, places): effect of one reading that is wrong by one of its standard deviations
    names: tuple[str, ...]  # of the places
    seen: np.ndarray = field(repr=False)  # (n, places): the numbers, as orthonormal combinations of the places

    @staticmethod
    def of(fitted: FittedParameters, measurements: MeasurementSet, x: np.ndarray | None = None) -> CheckReadings:
        """Return readings with a fit in a space that has all blocks; linearised at `x` if given."""
        space = fitted.space
        away = float(np.abs(measurements.probe - space.probe).max())
        if away > ROUNDING:
            problem = f"are of a point {away * 1e3:.4g} mm from that of the fit; give its place (--probe-mm)"
            raise CalibrationError("measurements", problem)
        estimation = Estimation(measurements, space, alone=False)
        cells = estimation.cells
        if len(cells.kind) > MOST_READINGS:
            problem = f"{len(cells.kind)} readings at distinct places are no check"
            raise CalibrationError("measurements", f"{problem} (at most {MOST_READINGS}); fit them")
        linear, _ = estimation.linearise(fitted.x if x is None else x, np.ones(len(measurements)))
        free, sizes, _ = np.linalg.svd(estimation.free_of_nuisance(np.eye(len(cells.kind))))
        seen = free[:, sizes > ROUNDING * sizes.max(initial=0.0)].T
        if not len(seen):
            problem = "determine nothing: the zeros of their runs account for all of them; read more places of each run"
            raise CalibrationError("measurements", problem)
        rows, sigma = seen @ space.unwhitened(linear.rows.dense()), fitted.noise[cells.kind]
        m = measurements
        names = tuple(f"{m.sources[n]}: {CHANNELS[m.channel[n]]} of run {m.runs[m.run[n]].name}" for n in cells.first)
        residuals = seen @ linear.target - rows @ fitted.x
        return CheckReadings(residuals, rows, (seen * sigma**2) @ seen.T, seen * sigma, names, seen)

    def covariance(self, of_parameters: np.ndarray) -> np.ndarray:
        """Return the readings' covariance for a covariance of the parameters, shape (n, n)."""
        return self.noise + self.rows @ of_parameters @ self.rows.T

    def chi_square(self, of_parameters: np.ndarray | float = 0.0) -> float:
        """Return the squared deviations over the expected ones for a covariance of the parameters, per number."""
        covariance = self.noise if np.isscalar(of_parameters) else self.covariance(np.asarray(of_parameters))
        return float(self.residuals @ np.linalg.solve(covariance, self.residuals)) / len(self.residuals)

    def effects(self, changes: Sequence[Change]) -> Iterator[tuple[Change, np.ndarray]]:
        """Yield the possible explanations with their effects (n, k): changes, one wrong reading, or more scatter in
        all."""
        for change in changes:
            yield change, self.rows @ change.columns
        yield from wrong_readings(self.single, self.names)


def wrong_readings(single: np.ndarray, names: Sequence[str]) -> Iterator[tuple[Change, np.ndarray]]:
    """Yield that one of some readings is wrong, or all scatter, by the effect (n, places) of a standard deviation."""
    for name, column in zip(names, single.T, strict=True):
        yield Change(READING, name, np.array(ASSUMED.wrong_reading)), column[:, None]
    yield Change(OTHER, "each reading by itself", np.array(ASSUMED.scattered), group="scatter"), single


@dataclass(frozen=True)
class Hypothesis:
    """A change in coordinates in which the readings of an unchanged machine are N(0, 1)."""

    change: Change
    directions: np.ndarray  # (n, k), orthonormal
    gains: np.ndarray  # (k,): effect of θ = 1 along them
    least_gain: float  # of all θ; 0 where one moves no reading
    log_prior: float = 0.0  # of each of its scales

    @staticmethod
    def of(change: Change, effect: np.ndarray, log_prior: float = 0.0) -> Hypothesis:
        """Return a change with its effect (n, k) on whitened readings."""
        if effect.shape[1] == 1:  # most of them: no need to decompose
            gains = np.linalg.norm(effect, axis=0)
            directions = effect / (gains or 1.0)
        else:
            directions, gains, _ = np.linalg.svd(effect, full_matrices=False)
        felt = gains > ROUNDING * max(gains.max(initial=0.0), 1.0)
        least = float(gains.min(initial=np.inf)) if felt.sum() == effect.shape[1] else 0.0
        return Hypothesis(change, directions[:, felt], gains[felt], least, log_prior)

    def log_bayes_factors(self, z: np.ndarray) -> np.ndarray:
        """Return log evidence over that of no change for whitened readings (N, n), scale by scale: (N, m)."""
        grown = np.outer(self.change.scales**2, self.gains**2)
        along = (z @ self.directions) ** 2
        return 0.5 * (along @ (grown / (1.0 + grown)).T - np.log1p(grown).sum(axis=1))


class Evidence:
    """Changes with their effects (n, k) on readings whose covariance is known for an unchanged machine."""

    def __init__(self, covariance: np.ndarray, effects: Iterable[tuple[Change, np.ndarray]]) -> None:
        self._whitening = np.linalg.inv(np.linalg.cholesky(covariance))
        self.hypotheses, effects = [], list(effects)
        groups = Counter((change.family, change.group) for change, _ in effects)
        in_kind = Counter(family for family, _ in groups)
        odds = dict(zip(FAMILIES, ASSUMED.prior_odds, strict=True))
        for change, effect in effects:
            alike = in_kind[change.family] * groups[change.family, change.group] * len(change.scales)
            log_prior = float(np.log(odds[change.family] / sum(odds.values()) / alike))
            self.hypotheses.append(Hypothesis.of(change, self._whitening @ effect, log_prior))

    def log_weights(self, readings: np.ndarray) -> list[np.ndarray]:
        """Return the log weight of each hypothesis over that of no change for sets of readings (N, n): (N, m) each."""
        return self._of_whitened(readings @ self._whitening.T)

    def _of_whitened(self, z: np.ndarray) -> list[np.ndarray]:
        return [h.log_bayes_factors(z) + h.log_prior for h in self.hypotheses]

    def probability_unchanged(self, readings: np.ndarray) -> float:
        """Return the share of checks in which an unchanged machine's readings deviate as much as these, or more."""
        z = np.random.default_rng(11).standard_normal((UNCHANGED_DRAWS, len(readings)))
        z = np.vstack([self._whitening @ readings, z])
        changed = np.logaddexp.reduce(np.concatenate(self._of_whitened(z), axis=1), axis=1)
        return float((changed >= changed[0]).mean())


@dataclass(frozen=True)
class Explanation:
    """Mean and covariance of the parameters' difference from the fit's under one explanation of the readings."""

    mean: np.ndarray  # (size,), SI
    covariance: np.ndarray  # (size, size)

    @staticmethod
    def of(check: CheckReadings, fitted: FittedParameters, change: Change | None, scale: float = 0.0) -> Explanation:
        """Return the parameters' posterior given the readings and a change of one scale; None: no change."""
        prior = fitted.covariance
        if change is not None and change.columns is not None:
            prior = prior + scale**2 * change.columns @ change.columns.T
        reached = check.rows @ prior
        gain = np.linalg.solve(check.covariance(prior), reached).T
        return Explanation(gain @ check.residuals, prior - gain @ reached)


# Readings that distinguish two explanations


def places(readings: MeasurementSet) -> Iterator[tuple[str, tuple[str, ...], np.ndarray]]:
    """Yield each line and each scattered pose of readings: place, channels, and the readings' numbers."""
    on_line = np.array([run.is_line for run in readings.runs])[readings.run]
    key = np.where(on_line, -1 - readings.run, readings.station)
    tips, _ = readings.geometry.tool_poses(readings.stations.positions, readings.stations.rotations)
    for group in dict.fromkeys(key.tolist()):
        members = np.flatnonzero(key == group)
        run = readings.runs[readings.run[members[0]]]
        at = [", ".join(f"{1e3 * v:.1f}" for v in tips[s] + 0.0) for s in dict.fromkeys(readings.station[members])]
        where = f"{run.name}: {at[0]} – {at[-1]} mm" if run.is_line else f"pose {at[0]} mm"
        yield where, tuple(dict.fromkeys(CHANNELS[c] for c in readings.channel[members])), members


@dataclass(frozen=True)
class Settling:
    """Readings that would distinguish two explanations."""

    name: str  # a line with its ends, or a pose
    channels: tuple[str, ...]  # what to read there
    readings: int
    odds: float  # expected log odds for the true explanation over the wrong one, for the worse case


def settle(
    fitted: FittedParameters, measured: MeasurementSet, explanations: tuple[Explanation, Explanation]
) -> list[Settling]:
    """Return the three readings that would best distinguish two explanations of `measured`, with its instruments."""
    space, kinds = fitted.space, np.unique(measured.kind)
    by_pose = np.isin(np.array(KINDS)[kinds], ABSOLUTE_KINDS)
    sets = [laid_out(space, lines=2)] if not by_pose.all() else []
    sets += [laid_out(space, poses=8, tilts=(*TILTS, 0.0))] if by_pose.any() else []
    proposals = []
    for readings, _ in sets:
        readings = readings.select(np.isin(readings.kind, kinds) & (readings.direction != BACKWARD))
        if not len(readings):
            continue
        rows, cells = information(space, readings, fitted.x)
        rows = space.unwhitened(rows)
        for where, channels, members in places(readings):
            chosen = np.unique(cells.of_reading[members])
            noise, a = np.diag(fitted.noise[cells.kind[chosen]] ** 2), rows[chosen]
            difference = a @ (explanations[0].mean - explanations[1].mean)
            first, second = (noise + a @ e.covariance @ a.T for e in explanations)
            odds = min(_divergence(difference, first, second), _divergence(difference, second, first))
            proposals.append(Settling(where, channels, len(chosen), odds))
    return sorted(proposals, key=lambda p: -p.odds)[:3]


def _divergence(difference: np.ndarray, right: np.ndarray, wrong: np.ndarray) -> float:
    """Return the Kullback–Leibler divergence of two normal distributions."""
    solved = np.linalg.solve(wrong, np.column_stack([right, difference]))
    logs = np.linalg.slogdet(wrong)[1] - np.linalg.slogdet(right)[1]
    return 0.5 * float(np.trace(solved[:, :-1]) - len(right) + difference @ solved[:, -1] + logs)


# Verify and update

VALID, NAMED, UNDECIDED, UNEXPLAINED = "valid", "named", "undecided", "unexplained"  # verdicts


@dataclass(frozen=True)
class Candidate:
    """A possible change, and its probability given the readings."""

    change: Change
    probability: float  # among all changes, given that there is one
    scale: float  # the most probable of its scales
    coefficients: np.ndarray  # (k,): size of each θ of Change.shown, SI; empty where they have no meaning one by one
    deviations: np.ndarray  # (k,): their standard errors

    @property
    def family(self) -> str:
        """Its kind, of FAMILIES."""
        return self.change.family

    @property
    def name(self) -> str:
        """The change's name."""
        return self.change.name

    @property
    def sizes(self) -> list[dict[str, Any]]:
        """Each displayed θ: name, value, standard_error and unit, for JSON and text."""
        return [
            {"name": label, "value": value * factor, "standard_error": deviation * factor, "unit": unit}
            for (label, factor, unit), value, deviation in zip(
                self.change.shown, self.coefficients, self.deviations, strict=True
            )
        ]


@dataclass(frozen=True)
class Verification:
    """Result of check readings for a model.

    Attributes
    ----------
    model : MachineModel
        The model.
    measurements : MeasurementSet
        The readings.
    independent : int
        How many numbers they are without what their instruments do not know.
    chi_square : float
        Their squared differences from the model over those to expect of an unchanged machine, per number.
    usual : float
        In which share of checks an unchanged machine reads as strangely as this.
    false_alarms : float
        It is called changed where that is no more than this.
    families : dict of str to float
        Probability of each kind of change, given that there is one.
    candidates : tuple of Candidate
        The best of each kind, the most probable kind first.
    visible : dict of str to float
        Smallest change that is surely seen, of the datum and a strut, m, and by a temperature, m/m; infinite where
        some are not seen at all.
    tool : tuple of float or None
        What the most probable change does to the tool: RMS displacement as the machine stands and with the datum
        aligned, m; None where it is no change of the machine, or the model has no box.
    settling : tuple of Settling
        Where it is undecided: readings that would tell the two most probable kinds apart.
    doubts : tuple of str
        What the readings may be instead, by name: of an unchanged machine, in another unit, with another sign, ….
    """

    model: MachineModel
    measurements: MeasurementSet
    independent: int
    chi_square: float
    usual: float
    false_alarms: float
    families: dict[str, float]
    candidates: tuple[Candidate, ...]
    visible: dict[str, float]
    tool: tuple[float, float] | None = None
    settling: tuple[Settling, ...] = ()
    doubts: tuple[str, ...] = ()

    @property
    def verdict(self) -> str:
        """:data:`VALID`, :data:`NAMED`, :data:`UNDECIDED` or :data:`UNEXPLAINED`."""
        best = max(self.families, key=lambda family: self.families[family])
        if self.usual > self.false_alarms:
            return VALID
        if self.families[best] < ASSUMED.sure:
            return UNDECIDED
        return UNEXPLAINED if best == OTHER else NAMED


def verify_model(
    model: MachineModel,
    fitted: FittedParameters,
    measurements: MeasurementSet,
    false_alarms: float = ASSUMED.false_alarms,
) -> Verification:
    """Return whether a model still holds, and if not, the most probable change.

    Parameters
    ----------
    model, fitted : MachineModel, FittedParameters
        The model, and what its fit knows (:func:`~.posterior.load_posterior`).
    measurements : MeasurementSet
        Check readings, at best 6 to 20, spread over the box.
    false_alarms : float
        Share of unchanged machines that may be called changed.

    Raises
    ------
    CalibrationError
        Readings of another point than the fit's, such that tell nothing, or too many of them.
    ModelError
        A share of false alarms that is none.
    """
    if not 0.0 < false_alarms < 1.0:
        raise ModelError("false_alarms", "must be above 0 and below 1", false_alarms)
    wide = widened(fitted)
    measurements = replace(measurements, notes=(*measurements.notes, *_beyond_loads(model, measurements)))
    check = CheckReadings.of(wide, measurements)
    changes = possible_changes(wide.space, [block.name for block in fitted.space.blocks])
    evidence = Evidence(check.covariance(wide.covariance), check.effects(changes))
    families, candidates = _candidates(check, wide, evidence)
    chi_square = check.chi_square(wide.covariance)
    doubts = best_alternative_reading(
        measurements, model, chi_square, lambda tried: CheckReadings.of(wide, tried).chi_square(wide.covariance)
    )
    result = Verification(
        model=model,
        measurements=measurements,
        independent=len(check.residuals),
        chi_square=chi_square,
        usual=evidence.probability_unchanged(check.residuals),
        false_alarms=false_alarms,
        families=families,
        candidates=candidates,
        visible=_visible(evidence),
        doubts=tuple(doubts),
    )
    if result.verdict == VALID:
        return result
    first, second = (Explanation.of(check, wide, c.change, c.scale) for c in candidates[:2])
    tool = None if candidates[0].change.columns is None else _tool(model, wide, first)
    settling = tuple(settle(wide, measurements, (first, second))) if result.verdict == UNDECIDED else ()
    return replace(result, tool=tool, settling=settling)


def _beyond_loads(model: MachineModel, readings: MeasurementSet) -> list[str]:
    """Return notes on readings taken under loads outside the model's."""
    loads = measured_loads(model.load, readings.geometry, readings.stations)
    said = (beyond_loads(model.origin.loads, Payload(row[0], (row[1], row[2], row[3])), row[4:]) for row in loads)
    return [f"read under another load than the model: {text}" for text in dict.fromkeys(said) if text]


def _candidates(
    check: CheckReadings, fitted: FittedParameters, evidence: Evidence
) -> tuple[dict[str, float], tuple[Candidate, ...]]:
    """Return the probability of each kind, and its best explanation, the most probable kind first."""
    weights = [logs[0] for logs in evidence.log_weights(check.residuals[None])]
    shares = np.exp(np.array([np.logaddexp.reduce(w) for w in weights]) - np.logaddexp.reduce(np.concatenate(weights)))
    changes = [hypothesis.change for hypothesis in evidence.hypotheses]
    kinds = np.array([change.family for change in changes])
    families = {family: float(shares[kinds == family].sum()) for family in FAMILIES}
    candidates = []
    for family in sorted(families, key=lambda name: -families[name]):
        best = int(np.where(kinds == family, shares, -1.0).argmax())
        change, scale = changes[best], float(changes[best].scales[weights[best].argmax()])
        coefficients, deviations = np.zeros((2, 0))
        if change.shown:
            effect = check.rows @ change.columns
            covariance = check.covariance(fitted.covariance) + scale**2 * effect @ effect.T
            solved = scale**2 * np.linalg.solve(covariance, effect)
            coefficients = solved.T @ check.residuals
            deviations = np.sqrt(np.maximum(scale**2 - scale**2 * np.diag(effect.T @ solved), 0.0))
        candidates.append(Candidate(change, float(shares[best]), scale, coefficients, deviations))
    return families, tuple(candidates)


def _visible(evidence: Evidence) -> dict[str, float]:
    """Return the smallest change of a kind that is certainly detected, for any strut, body or direction."""
    sizes: dict[str, float] = {}
    for hypothesis in evidence.hypotheses:
        family = hypothesis.change.family
        if family == DATUM or (family in (STRUT, TEMPERATURE) and len(hypothesis.change.shown) == 1):
            size = ASSUMED.surely / hypothesis.least_gain if hypothesis.least_gain > 0.0 else np.inf
            sizes[family] = max(size, sizes.get(family, 0.0))
    return sizes


def _tool(model: MachineModel, fitted: FittedParameters, change: Explanation) -> tuple[float, float] | None:
    """Return the tool's displacement in the measured box by a change, RMS, as it stands and with the datum aligned,
    m."""
    space, region = fitted.space, model.measured
    if region is None:  # no box in which a datum could be aligned
        return None
    places = np.random.default_rng(5).uniform(region.box[0], region.box[1], (100, 3))
    try:
        _, *slopes, _ = ErrorPredictor(RealMachine(space.geometry, model), fitted).slopes(
            region.poses(places, space.level)
        )
    except CalibrationError:  # hardly any pose of the box can be reached
        return None
    standing, aligned = (np.linalg.norm(part[:, :3] @ change.mean, axis=1) for part in slopes)
    return rms(standing[np.isfinite(standing)]), rms(aligned[np.isfinite(aligned)])


@dataclass(frozen=True)
class Update:
    """A renewed model."""

    model: MachineModel
    fitted: FittedParameters  # the new posterior of its parameters
    chi_square: float  # squared residuals over their noise, per independent number


def refusal(verification: Verification) -> str:
    """Return why few readings cannot renew a model; empty if they can."""
    best = verification.candidates[0].change
    if verification.doubts:
        return f"the readings may be others than they are taken for: {verification.doubts[0]}"
    if verification.verdict == VALID:
        return ""
    if verification.verdict == UNEXPLAINED:
        return "the machine has changed in a way that few readings cannot repair: measure a campaign and fit anew"
    if best.family == PAYLOAD:
        advice = (
            "state what it weighs now (payload_kg in the readings, mass_kg of the tool) beside the struts' stiffness"
        )
        return f"the payload has probably changed, {best.name}: {advice}, or measure with it and fit anew"
    if best.family == READING:
        return f"a single reading is probably wrong: {best.name}; take it again"
    if best.family == OTHER:
        return "it is open whether few readings can repair what has changed: take those that verify proposes as well"
    return ""


def update_model(
    model: MachineModel, fitted: FittedParameters, measurements: MeasurementSet, verification: Verification
) -> Update:
    """Return a model renewed from few readings.

    Parameters
    ----------
    model, fitted : MachineModel, FittedParameters
        The model so far, and what its fit knows.
    measurements : MeasurementSet
        The readings.
    verification : Verification
        What :func:`verify_model` makes of them.

    Raises
    ------
    CalibrationError
        Readings that were counted before.
    """
    counted = {digest for _, digest in model.origin.sources}
    for name, digest in measurements.files:
        if digest in counted:
            raise CalibrationError("measurements", f"{name} is in this model already; its readings would count twice")
    negligible, changed = 1e-4, verification.verdict != VALID
    warm = changed and verification.families[TEMPERATURE] > negligible
    prior = widened(fitted, ("pitch",) if warm else ())
    changes = possible_changes(prior.space, [block.name for block in fitted.space.blocks]) if changed else []
    repairable = [c for c in changes if c.family not in (PAYLOAD, READING, OTHER)]
    x = prior.x
    for _ in range(3):  # Gauss–Newton: a change of a tenth of a millimetre settles in two steps
        check = CheckReadings.of(prior, measurements, x)
        answer = _mixture(check, prior, repairable, negligible)
        x = prior.x + answer.mean
    known = replace(prior, x=x, covariance=answer.covariance)
    best = verification.candidates[0].change
    reason = f"{FAMILIES[best.family]}: {best.name}" if changed else "it held"
    origin = replace(
        model.origin,
        date=date.today().isoformat(),
        sources=(*model.origin.sources, *measurements.files),
        held_out_residual=None,
        note=f"renewed from {len(measurements)} readings ({reason}). {model.origin.note}",
        posterior=None,
    )
    new = replace(
        known.space.model(x.round(DIGITS), model.name),
        reversal_threshold=model.reversal_threshold,
        outside=model.outside,
        origin=origin,
    )
    if known.held is not None:  # the datum stays where neither old nor new readings show it
        estimation = Estimation(measurements, known.space, alone=False)
        part = unseen_part(estimation, known.tolerances[0], known.noise, known.held.pose, known.held.part)
        new, held = hold(known.space.geometry, new, known.held.pose, part)
        known = replace(known, held=held)
    return Update(new, known, CheckReadings.of(known, measurements).chi_square())


def _mixture(check: CheckReadings, prior: FittedParameters, changes: list[Change], negligible: float) -> Explanation:
    """Return mean and covariance of the parameters over all changes by their probabilities; none: nothing changed."""
    if not changes:
        return Explanation.of(check, prior, None)
    evidence = Evidence(check.covariance(prior.covariance), check.effects(changes))
    weights = [logs[0] for logs in evidence.log_weights(check.residuals[None])[: len(changes)]]
    whole = np.logaddexp.reduce(np.concatenate(weights))
    weighed = [
        (share, Explanation.of(check, prior, change, scale))
        for change, logs in zip(changes, weights, strict=True)
        for scale, share in zip(change.scales, np.exp(logs - whole), strict=True)
        if share > negligible
    ]
    shares = np.array([share for share, _ in weighed]) / sum(share for share, _ in weighed)
    parts = [part for _, part in weighed]
    mean = shares @ np.array([part.mean for part in parts])
    away = np.array([part.mean - mean for part in parts])
    covariance = (away * shares[:, None]).T @ away
    for share, part in zip(shares, parts, strict=True):
        covariance += share * part.covariance
    return Explanation(mean, covariance)


# What they print


def verification_report(result: Verification) -> str:
    """Return the result of a check as text."""
    m, region = result.measurements, result.model.measured
    parts = [
        f"machine {m.geometry.name}, model {result.model.name!r}: {len(m)} check readings of {len(np.unique(m.run))} "
        f"runs, {result.independent} numbers without what the instruments leave open\n"
        f"{region_text(region, m.geometry)}",
        "\n".join(_verdict(result)),
    ]
    if result.doubts:
        parts.insert(0, "IN DOUBT:\n" + "\n".join(f"  {doubt}" for doubt in result.doubts))
    slack = 1e-3  # m: so far outside the box is still in it
    inside = region is None or region.contains(m.stations.positions, m.stations.rotations, slack)
    if not np.all(inside):
        outside = np.logical_not(inside)
        parts.append(f"{outside.sum()} of {outside.size} places lie outside the box in which the model was fitted")
    if m.notes:
        parts.append("\n".join(f"note: {note}" for note in m.notes))
    if result.verdict != VALID:
        least = 0.001  # kinds of change less probable than this are not listed
        rows = [
            (FAMILIES[c.family], number(100.0 * result.families[c.family], 1), _described(c))
            for c in result.candidates
            if result.families[c.family] >= least
        ]
        parts.append(aligned(("kind of change", "%", "its best explanation"), rows))
    if result.settling:
        first, second = (FAMILIES[c.family] for c in result.candidates[:2])
        reads = [(s.name, str(s.readings), ", ".join(s.channels), _odds(s.odds)) for s in result.settling]
        table = aligned(("read", "readings", "channels", "odds to expect"), reads)
        parts.append(f'to tell "{first}" from "{second}", with the instruments used so far\n{table}')
    return "\n\n".join([*parts, "\n".join(_visible_text(result))]) + "\n"


def _verdict(result: Verification) -> Iterator[str]:
    """Yield whether the model is valid, and the most probable change."""
    best, percent = result.candidates[0], f"{100.0 * result.usual:.2g} %"
    if result.verdict == VALID:
        yield f"VALID: a machine that has not changed reads as strangely as this in {percent} of checks"
    else:
        nothing = "in a way that no motion of the datum, strut, temperature, payload or ageing explains"
        yield "CHANGED: " + {
            NAMED: f"{FAMILIES[best.family]}: {_described(best)}",
            UNDECIDED: f"either {', or '.join(FAMILIES[c.family] for c in result.candidates[:2])}",
        }.get(result.verdict, f"{nothing} (nearest: {_described(best)})")
        share = f"in {'fewer than ' if result.usual < 1e-3 else ''}{percent}"
        yield f"a machine that has not changed reads as strangely as this {share} of checks"
        doubted = [c.name for c in result.candidates[: 1 + (result.verdict == UNDECIDED)] if c.family == READING]
        yield from (f"take {name} again: the machine itself need not have changed" for name in doubted)
    yield f"χ² {result.chi_square:.3g} per number against the model and what its fit knows"
    if result.tool is not None:
        standing, with_datum = (1e6 * size for size in result.tool)
        text = f"{standing:.3g} µm RMS in the measured box, {with_datum:.3g} µm with the datum aligned"
        yield f"what the most probable change does to the tool: {text}"


def _described(candidate: Candidate) -> str:
    """Return a candidate's name, with sizes where they have a meaning."""
    sizes = {s["name"]: f"{s['value']:+.3g} ± {s['standard_error']:.2g} {s['unit']}" for s in candidate.sizes}
    if len(sizes) < 2:
        return " by ".join((candidate.name, *sizes.values()))
    return f"{candidate.name}: " + ", ".join(f"{label} {size}" for label, size in sizes.items())


def _odds(logarithm: float) -> str:
    most = 1e6  # odds above this are all the same to a reader
    return f"{math.exp(logarithm):.3g} : 1" if logarithm < math.log(most) else "over a million : 1"


def _visible_text(result: Verification) -> Iterator[str]:
    """Yield the smallest changes that these readings certainly show."""
    most = 1e-3  # m or m/m: larger ones are not worth listing
    for family, name, unit in ((STRUT, "any strut's offset", "µm"), (TEMPERATURE, "growth by temperature", "ppm")):
        size = result.visible.get(family, math.inf)
        if size > most:
            yield f"these readings do not surely show {name}"
        else:
            yield f"these readings surely show {name} from {1e6 * size:.2g} {unit} on"
    if result.visible.get(DATUM, math.inf) > most:
        yield "where base and workpiece stand as a whole these readings do not show, or not in all directions"


def update_report(update: Update, written: str) -> str:
    """Return the result of a renewal as text."""
    head = (
        f"renewed; χ² of the readings against the new model: {update.chi_square:.3g} per number, by their noise alone"
    )
    held = update.fitted.held
    return "\n\n".join([head, *([held.report()] if held else []), f"model: {written}\n"])


def verification_json(result: Verification) -> dict:
    """Return a check as plain numbers; units are in the keys, or beside numbers as ``unit``."""
    return {
        "machine": result.measurements.geometry.name,
        "model": result.model.name,
        "verdict": result.verdict,
        "measured_box": region_json(result.model.measured, result.measurements.geometry),
        "readings": len(result.measurements),
        "independent": result.independent,
        "chi_square": result.chi_square,
        "unchanged_reads_so": result.usual,
        "false_alarms": result.false_alarms,
        "probabilities": result.families,
        "candidates": [
            {"kind": c.family, "name": c.name, "probability": c.probability, "sizes": c.sizes}
            for c in result.candidates
        ],
        "tool_m": None if result.tool is None else {"standing": result.tool[0], "aligned": result.tool[1]},
        "surely_seen": {
            f"{kind}{'' if kind == TEMPERATURE else '_m'}": size if math.isfinite(size) else None
            for kind, size in result.visible.items()
        },
        "settling": [
            {"read": s.name, "channels": s.channels, "readings": s.readings, "log_odds": s.odds}
            for s in result.settling
        ],
        "doubts": result.doubts,
        "notes": result.measurements.notes,
    }
