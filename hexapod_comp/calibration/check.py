"""Is a model still valid, and if not: what has happened, and can few readings renew the model?"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from datetime import date
from typing import Any

import numpy as np

from ..errors import CalibrationError, HexapodError, ModelError
from ..formats.texts import aligned, number
from ..machine.arrays import rms
from ..machine.load import Payload, beyond_loads
from ..machine.model import MachineModel, RealMachine
from ..machine.region import region_json, region_text
from ..measurements.readings import KINDS, LINE_KINDS, MeasurementSet
from .assumptions import ASSUMED
from .blocks.block import DIGITS
from .blocks.load import measured_loads
from .changes import (
    DATUM,
    FAMILIES,
    OTHER,
    PAYLOAD,
    READING,
    STRUT,
    TEMPERATURE,
    Change,
    CheckReadings,
    Evidence,
    Explanation,
    possible_changes,
    widened,
)
from .datum import hold, unseen_part
from .design import Settling, settle, um
from .estimator import Estimation
from .mistakes import mistakes_of_check
from .posterior import ErrorPredictor, FittedParameters, box_errors, expected_error
from .promise import Unexplained

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
        """The change's kind, one of FAMILIES."""
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
        Number of independent values: readings minus their instruments' unknowns (zeros, slopes, frames).
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
        Readings of another point than the fit's, readings that determine nothing, or too many of them.
    ModelError
        A share of false alarms that is none.
    """
    if not 0.0 < false_alarms < 1.0:
        raise ModelError("false_alarms", "must be above 0 and below 1", false_alarms)
    wide = widened(fitted)
    measurements = replace(measurements, notes=(*measurements.notes, *_beyond_loads(model, fitted, measurements)))
    check = CheckReadings.of(wide, measurements)
    changes = possible_changes(wide.space, [block.name for block in fitted.space.blocks])
    evidence = Evidence(check.covariance(wide.covariance), check.effects(changes, wide.covariance))
    families, candidates = _candidates(check, wide, evidence)
    chi_square = check.chi_square(wide.covariance)
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
    )
    if result.verdict == VALID:
        return result
    doubts = tuple(_misread(check, wide, evidence, model, measurements))
    first, second = (Explanation.of(check, wide, c.change, c.scale) for c in candidates[:2])
    tool = None if candidates[0].change.columns is None else _tool(model, wide, first)
    settling = tuple(settle(wide, measurements, (first, second))) if result.verdict == UNDECIDED else ()
    return replace(result, tool=tool, settling=settling, doubts=doubts)


def _beyond_loads(model: MachineModel, fitted: FittedParameters, readings: MeasurementSet) -> list[str]:
    """Return notes on readings taken under loads outside the model's, with the tool error predicted there."""
    found, usual = dict[str, str](), Unexplained(believed=ASSUMED.jackknife_prior)
    for row in measured_loads(model.load, readings.geometry, readings.stations):
        said = beyond_loads(model.origin.loads, Payload(row[0], (row[1], row[2], row[3])), row[4:])
        if said and said not in found:
            errors = box_errors(fitted.space, fitted.x, load=row) if model.load.stiffness.all() else None
            there = expected_error(errors, fitted.covariance, beyond=usual)
            found[said] = "" if there is None else f"; there the model, told so, leaves up to {um(there.high)} (95 %)"
    return [f"read under another load than the model: {said}{promised}" for said, promised in found.items()]


def _misread(
    check: CheckReadings, fitted: FittedParameters, evidence: Evidence, model: MachineModel, m: MeasurementSet
) -> list[str]:
    """Return the names of mistakes after whose correction the readings are probably those of an unchanged machine.

    Each is judged by its Bayes factor over the uncorrected readings of a machine that may have changed. The best is
    returned with those that the readings do not distinguish from it, as in :func:`.mixups.mixups`.
    """
    as_read = check.log_density(fitted.covariance) + evidence.log_evidence(check.residuals)
    most = check.log_density(fitted.covariance, np.zeros(len(check.residuals))) - as_read
    odds, found = math.log(ASSUMED.mixup_odds), []
    of_lines = bool(np.isin(m.kind, [KINDS.index(kind) for kind in LINE_KINDS]).all())
    for mistake in mistakes_of_check(m, model):
        jacobian = float(check.freedom @ np.log(mistake.factor))
        if most + jacobian < odds:  # though all readings were as expected
            continue
        try:
            tried = mistake.corrected()
            if tried is None:
                continue
            if of_lines and tried.stations is m.stations and tried.channel is m.channel:
                other = check.changed_by(tried.value - m.value)
            else:
                other = CheckReadings.of(fitted, tried)
        except HexapodError:  # out of reach that way
            continue
        gain = other.log_density(fitted.covariance) + jacobian - as_read
        better = math.sqrt(check.chi_square(fitted.covariance) / other.chi_square(fitted.covariance))
        found.append((gain, f"{mistake.name} fits {better:.3g} times better"))
    best = max((gain for gain, _ in found), default=0.0)
    return [text for gain, text in sorted(found, reverse=True) if gain > max(odds, best - odds)]


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
            effect = evidence.effects[best][1]
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
    evidence = Evidence(check.covariance(prior.covariance), check.effects(changes, prior.covariance))
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
        f"runs, {result.independent} independent values without the instruments' unknowns\n"
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
        yield "these readings do not show, or not in all directions, where base and workpiece stand as a whole"


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
