"""Check a model by a few readings: decide whether it is still valid, name the most probable change, update it."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from datetime import date
from typing import Any

import numpy as np

from ..errors import CalibrationError, HexapodError, ModelError
from ..formats.texts import aligned, number, significant, with_error
from ..machine.arrays import rms
from ..machine.load import Payload, beyond_loads
from ..machine.model import MachineModel
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
from .design import Settling, distinguishing_readings, um
from .estimator import Estimation
from .mistakes import mistakes_of_check
from .posterior import FirstOrder, FittedParameters, box_errors, box_stations, expected_error
from .promise import Unexplained
from .sensitivity import predict

VALID, NAMED, UNDECIDED, UNEXPLAINED = "valid", "named", "undecided", "unexplained"  # verdicts

ADVICE = {
    PAYLOAD: "the payload has probably changed ({}): state its mass (payload_kg in the readings or mass_kg of the "
    "tool) and the struts' stiffness, or measure a campaign and fit again",
    READING: "a single reading is probably wrong: {}; take this reading again",
    OTHER: "the change is not identified: take the readings that verify proposes, then verify all readings together",
}
"""What the user should do if the most probable change is of a kind that a check cannot correct; {}: its name."""


@dataclass(frozen=True)
class Candidate:
    """A possible change of the machine that explains the readings of a check."""

    change: Change
    probability: float  # posterior probability of this change, given that exactly one change has happened
    scale: float  # the most probable one of Change.scales
    coefficients: np.ndarray  # (k,): estimated θ of the change, in the order of Change.shown, SI
    deviations: np.ndarray  # (k,): standard errors of the coefficients, SI

    @property
    def family(self) -> str:
        return self.change.family

    @property
    def name(self) -> str:
        return self.change.name

    @property
    def sizes(self) -> list[dict[str, Any]]:
        """For JSON and reports: name, value, standard_error and unit of each coefficient."""
        return [
            {"name": label, "value": value * factor, "standard_error": deviation * factor, "unit": unit}
            for (label, factor, unit), value, deviation in zip(
                self.change.shown, self.coefficients, self.deviations, strict=True
            )
        ]


@dataclass(frozen=True)
class Verification:
    """Result of a check of a model by a few readings.

    Attributes
    ----------
    model : MachineModel
        The checked model.
    measurements : MeasurementSet
        The check readings.
    independent : int
        Number of readings minus number of unknowns of their instruments (zeros, slopes, frames).
    chi_square : float
        χ² of the readings minus the model's prediction, divided by `independent`; about 1 for an unchanged machine.
    p_value : float
        Share of checks of an unchanged machine whose readings deviate at least as much as these readings.
    false_alarms : float
        Significance level: the machine counts as changed if `p_value` is at most `false_alarms`.
    families : dict of str to float
        Probability of each kind of change, given that one change has happened.
    candidates : tuple of Candidate
        Most probable change of each kind; the most probable kind comes first.
    visible : dict of str to float
        For each kind of change the smallest size from which checks with readings at these places miss at most the share
        `false_alarms` of every change of the kind: ``datum``, m; ``strut``, m; ``temperature``, m/m. Infinite if
        readings at these places do not show some change of the kind.
    tool : tuple of float or None
        RMS displacement of the tool by the most probable change, absolute and after best-fit alignment, m. None if the
        most probable explanation is a wrong reading or scatter, or if the model has no box.
    settling : tuple of Settling
        Further readings that would best distinguish the two most probable kinds of change; only if undecided.
    doubts : tuple of str
        Possible mistakes in the file (a wrong unit, a wrong sign, …), without which the readings show no change.
    """

    model: MachineModel
    measurements: MeasurementSet
    independent: int
    chi_square: float
    p_value: float
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
        if self.p_value > self.false_alarms:
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
    """Return whether a model is still valid and, if not, the most probable change of the machine.

    Parameters
    ----------
    model, fitted : MachineModel, FittedParameters
        The model, and the parameters of its fit with their covariance (:func:`~.posterior.load_posterior`).
    measurements : MeasurementSet
        Check readings, preferably 12 to 24, spread over the box.
    false_alarms : float
        Share of unchanged machines that may be reported as changed.

    Raises
    ------
    CalibrationError
        If the check measured another point of the tool than the fit, if the unknowns of the instruments explain all
        readings, or if there are more than 500 readings.
    ModelError
        If `false_alarms` is not between 0 and 1.
    """
    if not 0.0 < false_alarms < 1.0:
        raise ModelError("false_alarms", "must be above 0 and below 1", false_alarms)
    wide = widened(fitted, readings=measurements)
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
        p_value=evidence.p_value(check.residuals),
        false_alarms=false_alarms,
        families=families,
        candidates=candidates,
        visible=_detectable(evidence, false_alarms),
    )
    if result.verdict == VALID:
        return result
    doubts = tuple(_mistakes_in_file(check, wide, evidence, model, measurements))
    first, second = (Explanation.of(check, wide, c.change, c.scale) for c in candidates[:2])
    tool = None if candidates[0].change.columns is None else _tool_error(wide, first)
    undecided = result.verdict == UNDECIDED
    settling = distinguishing_readings(wide, measurements, (first, second)) if undecided else ()
    return replace(result, tool=tool, settling=settling, doubts=doubts)


def _beyond_loads(model: MachineModel, fitted: FittedParameters, readings: MeasurementSet) -> list[str]:
    """Return a note on each load of the check that no reading of the fit had, with the tool error under this load."""
    found, usual = dict[str, str](), Unexplained(believed=ASSUMED.jackknife_prior)
    for row in measured_loads(model.load, readings.geometry, readings.stations):
        load = beyond_loads(model.origin.loads, Payload(row[0], (row[1], row[2], row[3])), row[4:])
        if load and load not in found:
            errors = box_errors(fitted.space, fitted.x, load=row) if model.load.stiffness.all() else None
            error = expected_error(errors, fitted.covariance, beyond=usual)
            found[load] = (
                "" if error is None else f"; predicted tool error under this load: up to {um(error.high)} (95 %)"
            )
    return [
        f"no reading of the model's fit was taken under the load of these readings: {load}{promise}"
        for load, promise in found.items()
    ]


def _mistakes_in_file(
    check: CheckReadings, fitted: FittedParameters, evidence: Evidence, model: MachineModel, m: MeasurementSet
) -> list[str]:
    """Return, as text, the mistakes in a file that explain its readings better than a change of the machine does.

    The Bayes factor of a mistake is p(corrected readings | unchanged machine) / p(readings in the file | machine that
    may have changed). A mistake is listed if its Bayes factor exceeds ASSUMED.mixup_odds, and is at most that many
    times smaller than the largest Bayes factor of all mistakes.
    """
    as_read = check.log_density(fitted.covariance) + evidence.log_evidence(check.residuals)
    most = check.log_density(fitted.covariance, np.zeros(len(check.residuals))) - as_read
    odds, found = math.log(ASSUMED.mixup_odds), []
    of_lines = bool(np.isin(m.kind, [KINDS.index(kind) for kind in LINE_KINDS]).all())
    for mistake in mistakes_of_check(m, model):
        jacobian = float(check.freedom @ np.log(mistake.factor))
        if most + jacobian < odds:  # the Bayes factor would be too small even if all residuals became zero
            continue
        try:
            tried = mistake.corrected()
            if tried is None:
                continue
            if of_lines and tried.stations is m.stations and tried.channel is m.channel:
                other = check.changed_by(tried.value - m.value)
            else:
                other = CheckReadings.of(fitted, tried)
        except HexapodError:  # the corrected poses are out of reach
            continue
        gain = other.log_density(fitted.covariance) + jacobian - as_read
        better = math.sqrt(check.chi_square(fitted.covariance) / other.chi_square(fitted.covariance))
        found.append((gain, f"{mistake.name} fits {better:.3g} times better"))
    best = max((gain for gain, _ in found), default=0.0)
    return [text for gain, text in sorted(found, reverse=True) if gain > max(odds, best - odds)]


def _candidates(
    check: CheckReadings, fitted: FittedParameters, evidence: Evidence
) -> tuple[dict[str, float], tuple[Candidate, ...]]:
    """Return the probability of each kind of change, and each kind's most probable change, likeliest kind first."""
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


def _detectable(evidence: Evidence, false_alarms: float) -> dict[str, float]:
    """Return by kind the least size, SI, from which checks miss at most the share `false_alarms` of each change."""
    sizes: dict[str, float] = {}
    for hypothesis in evidence.hypotheses:
        family = hypothesis.change.family
        if family == DATUM or (family in (STRUT, TEMPERATURE) and len(hypothesis.change.shown) == 1):
            sizes[family] = max(evidence.detectable(hypothesis, false_alarms), sizes.get(family, 0.0))
    return sizes


def _tool_error(fitted: FittedParameters, change: Explanation) -> tuple[float, float] | None:
    """Return the tool's RMS displacement by `change` in the measured box, m: absolute, and after best-fit alignment.

    The tool passes each place in both directions, because the effect of backlash depends on the direction.
    """
    space, stations = fitted.space, box_stations(fitted.space)
    if space.measured is None or stations is None:
        return None
    errors = FirstOrder.of(space, predict(space, fitted.x, stations), stations)
    parts = (errors.slopes, errors.aligned().slopes)
    absolute, aligned = (rms(np.linalg.norm(slopes[:, :3] @ change.mean, axis=1)) for slopes in parts)
    return absolute, aligned


@dataclass(frozen=True)
class Update:
    model: MachineModel
    fitted: FittedParameters
    chi_square: float  # χ² of (readings − new prediction) per independent value, with the readings' noise only


def refusal(verification: Verification) -> str:
    """Return the reason why the check readings cannot update the model; empty if they can."""
    best = verification.candidates[0].change
    if verification.doubts:
        return f"the readings may contain a mistake: {verification.doubts[0]}"
    if verification.verdict == VALID:
        return ""
    if verification.verdict == UNEXPLAINED:
        return "the machine has changed in a way that few readings cannot correct: measure a campaign and fit again"
    return ADVICE.get(best.family, "").format(best.name)


def update_model(
    model: MachineModel, fitted: FittedParameters, measurements: MeasurementSet, verification: Verification
) -> Update:
    """Return a model updated by check readings.

    Parameters
    ----------
    model, fitted : MachineModel, FittedParameters
        The old model, and the parameters of its fit with their covariance.
    measurements : MeasurementSet
        The check readings.
    verification : Verification
        The result of :func:`verify_model` for these readings.

    Raises
    ------
    CalibrationError
        If the model already contains some of the readings.
    """
    counted = {digest for _, digest in model.origin.sources}
    for name, digest in measurements.files:
        if digest in counted:
            raise CalibrationError("measurements", f"{name}: these readings are in the model and would count twice")
    negligible, changed = 1e-4, verification.verdict != VALID
    warm = changed and verification.families[TEMPERATURE] > negligible
    prior = widened(fitted, ("pitch",) if warm else ())
    changes = possible_changes(prior.space, [block.name for block in fitted.space.blocks]) if changed else []
    repairable = [c for c in changes if c.family not in ADVICE]
    x = prior.x
    for _ in range(3):  # Gauss–Newton: for a change of 0.1 mm, two steps converge
        check = CheckReadings.of(prior, measurements, x)
        answer = _mixture(check, prior, repairable, negligible)
        x = prior.x + answer.mean
    known = replace(prior, x=x, covariance=answer.covariance)
    best = verification.candidates[0].change
    reason = f"{FAMILIES[best.family]}: {best.name}" if changed else "the old model was valid"
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
    if known.held is not None:  # hold the datum in directions that neither the old nor the new readings show
        estimation = Estimation(measurements, known.space, check_count=False)
        problem, _ = estimation.linearise(x, np.ones(len(measurements)))
        part = unseen_part(estimation, problem, known.tolerances[0], known.noise, known.held.pose, known.held.part)
        new, held = hold(known.space.geometry, new, known.held.pose, part)
        known = replace(known, held=held)
    return Update(new, known, CheckReadings.of(known, measurements).chi_square())


def _mixture(check: CheckReadings, prior: FittedParameters, changes: list[Change], negligible: float) -> Explanation:
    """Return mean and covariance of the mixture of the posteriors for `changes`, weighted by their probabilities."""
    if not changes:
        return Explanation.of(check, prior, None)
    evidence = Evidence(check.covariance(prior.covariance), check.effects(changes, prior.covariance))
    weights = [logs[0] for logs in evidence.log_weights(check.residuals[None])[: len(changes)]]
    whole = np.logaddexp.reduce(np.concatenate(weights))
    weighted = [
        (share, Explanation.of(check, prior, change, scale))
        for change, logs in zip(changes, weights, strict=True)
        for scale, share in zip(change.scales, np.exp(logs - whole), strict=True)
        if share > negligible
    ]
    shares = np.array([share for share, _ in weighted]) / sum(share for share, _ in weighted)
    parts = [part for _, part in weighted]
    mean = shares @ np.array([part.mean for part in parts])
    away = np.array([part.mean - mean for part in parts])
    covariance = (away * shares[:, None]).T @ away
    for share, part in zip(shares, parts, strict=True):
        covariance += share * part.covariance
    return Explanation(mean, covariance)


# Reports


def verification_report(result: Verification) -> str:
    m, region = result.measurements, result.model.measured
    parts = [
        f"machine {m.geometry.name}, model {result.model.name!r}: {len(m)} check readings of {len(np.unique(m.run))} "
        f"runs, {result.independent} independent values (readings minus unknowns of the instruments)\n"
        f"{region_text(region, m.geometry)}",
        "\n".join(_verdict(result)),
    ]
    if result.doubts:
        parts.insert(0, "IN DOUBT:\n" + "\n".join(f"  {doubt}" for doubt in result.doubts))
    slack = 1e-3  # m: a place up to this far outside the box counts as inside
    inside = region is None or region.contains(m.stations.positions, m.stations.rotations, slack)
    if not np.all(inside):
        outside = np.logical_not(inside)
        parts.append(f"{outside.sum()} of {outside.size} places lie outside the box in which the model was fitted")
    if m.notes:
        parts.append("\n".join(f"note: {note}" for note in m.notes))
    if result.verdict != VALID:
        least = 0.001  # smallest probability of a kind of change that is listed
        rows = [
            (FAMILIES[c.family], number(100.0 * result.families[c.family], 1), described(c))
            for c in result.candidates
            if result.families[c.family] >= least
        ]
        parts.append(aligned(("kind of change", "%", "best explanation"), rows))
    if result.settling:
        first, second = (FAMILIES[c.family] for c in result.candidates[:2])
        reads = [(s.name, str(s.readings), ", ".join(s.channels), _odds(s.odds)) for s in result.settling]
        table = aligned(("line or pose", "readings", "channels", "expected odds"), reads)
        parts.append(f'readings that best distinguish "{first}" from "{second}", with these instruments:\n{table}')
    return "\n\n".join([*parts, "\n".join(_visible_text(result))]) + "\n"


def _verdict(result: Verification) -> Iterator[str]:
    share = result.p_value
    percent = f"{'fewer than ' if share < 1e-3 else ''}{100.0 * share:.2g} %"
    usual = f"{percent} of checks of an unchanged machine deviate at least as much as this check (p-value)"
    if result.verdict == VALID:
        yield f"VALID: {usual}"
    else:
        yield f"CHANGED: {change_text(result)}"
        yield usual
        doubted = [c.name for c in result.candidates[: 1 + (result.verdict == UNDECIDED)] if c.family == READING]
        yield from (f"take {name} again: perhaps only this reading is wrong" for name in doubted)
    yield f"χ² {result.chi_square:.3g} per independent value; about 1 is expected of an unchanged machine"
    if result.tool is not None:
        absolute, best_fit = (1e6 * size for size in result.tool)
        text = f"{absolute:.3g} µm RMS in the measured box, {best_fit:.3g} µm after best-fit alignment"
        yield f"tool error due to the most probable change: {text}"


def change_text(result: Verification) -> str:
    """Return a text that names the most probable change or, if the check does not decide, the two most probable."""
    if result.verdict == VALID:
        return "no change"
    if result.verdict == UNDECIDED:
        return f"either {', or '.join(FAMILIES[c.family] for c in result.candidates[:2])}"
    best = result.candidates[0]
    if result.verdict == NAMED and best.probability >= ASSUMED.sure:
        return f"{FAMILIES[best.family]}: {described(best)}"
    return f"{FAMILIES[best.family]} (most probable, {100.0 * best.probability:.0f} %: {described(best)})"


def described(candidate: Candidate) -> str:
    """Return the name of a change and its estimated sizes as text, for example "strut_3 by +20 ± 2 µm"."""
    sizes = {s["name"]: f"{with_error(s['value'], s['standard_error'])} {s['unit']}" for s in candidate.sizes}
    if len(sizes) < 2:
        return " by ".join((candidate.name, *sizes.values()))
    return f"{candidate.name}: " + ", ".join(f"{label} {size}" for label, size in sizes.items())


def _odds(logarithm: float) -> str:
    most = 1e6  # larger odds are reported as "over a million : 1"
    return f"{math.exp(logarithm):.3g} : 1" if logarithm < math.log(most) else "over a million : 1"


def _visible_text(result: Verification) -> Iterator[str]:
    most = 1e-3  # m or m/m: a change that is detected reliably only if it is larger counts as not detected
    for family, name, unit in (
        (STRUT, "a change of any strut's offset", "µm"),
        (TEMPERATURE, "growth by temperature", "ppm"),
    ):
        size = result.visible.get(family, math.inf)
        if size > most:
            yield f"these readings do not reliably detect {name}"
        else:
            least, share = significant(1e6 * size, 2), 100.0 * (1.0 - result.false_alarms)
            yield f"these readings detect {name} of {least} {unit} or more in at least {share:g} % of checks"
    if result.visible.get(DATUM, math.inf) > most:
        yield "these readings do not detect every displacement and rotation of the base or workpiece as a whole"


def update_report(update: Update, written: str) -> str:
    """Return the report of an updated model; `written` is the name of the model's file."""
    size, held = f"{update.chi_square:.3g}", update.fitted.held
    head = f"renewed; χ² of readings minus new prediction: {size} per independent value (noise of the readings only)"
    return "\n\n".join([head, *([held.report()] if held else []), f"model: {written}\n"])


def verification_json(result: Verification) -> dict:
    return {
        "machine": result.measurements.geometry.name,
        "model": result.model.name,
        "verdict": result.verdict,
        "measured_box": region_json(result.model.measured, result.measurements.geometry),
        "readings": len(result.measurements),
        "independent": result.independent,
        "chi_square": result.chi_square,
        "p_value": result.p_value,
        "false_alarms": result.false_alarms,
        "probabilities": result.families,
        "candidates": [
            {"kind": c.family, "name": c.name, "probability": c.probability, "sizes": c.sizes}
            for c in result.candidates
        ],
        "tool_m": None if result.tool is None else {"absolute": result.tool[0], "aligned": result.tool[1]},
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
