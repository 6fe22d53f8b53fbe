"""Is a model still valid? A few check readings, weighed against what may have happened since the fit."""

from __future__ import annotations

from dataclasses import dataclass, replace
from datetime import date

import numpy as np

from ..errors import CalibrationError, ModelError
from ..machine.arrays import rms
from ..machine.model import MachineModel, RealMachine
from ..measurements.readings import MeasurementSet
from .assumptions import ASSUMED
from .blocks.block import DIGITS
from .changes import (
    DATUM,
    FAMILIES,
    OTHER,
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
from .estimator import Estimation
from .follow_up import Settling, settle
from .mixups import misread
from .posterior import ErrorPredictor, FittedParameters

VALID, NAMED, UNDECIDED, UNEXPLAINED = "valid", "named", "undecided", "unexplained"  # verdicts


@dataclass(frozen=True)
class Candidate:
    """What may have happened, and how well the readings bear it out."""

    change: Change
    probability: float  # among all changes, given that there is one
    scale: float  # the most probable of its scales
    coefficients: np.ndarray  # (k,): how large each θ of Change.shown is, SI; empty where they mean nothing one by one
    deviations: np.ndarray  # (k,): how well that is known

    @property
    def family(self) -> str:
        """Its kind, of FAMILIES."""
        return self.change.family

    @property
    def name(self) -> str:
        """The change's name."""
        return self.change.name


@dataclass(frozen=True)
class Verification:
    """What check readings say of a model.

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
    """Return whether a model still holds, and if not, what has probably happened.

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
    check = CheckReadings.of(wide, measurements)
    changes = possible_changes(wide.space, [block.name for block in fitted.space.blocks])
    evidence = Evidence(check.covariance(wide.covariance), check.effects(changes))
    families, candidates = _candidates(check, wide, evidence)
    chi_square = check.chi_square(wide.covariance)
    doubts = misread(
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
    """Return the smallest change of a kind that is surely seen, whichever strut, body or direction it is of."""
    sizes: dict[str, float] = {}
    for hypothesis in evidence.hypotheses:
        family = hypothesis.change.family
        if family == DATUM or (family in (STRUT, TEMPERATURE) and len(hypothesis.change.shown) == 1):
            size = ASSUMED.surely / hypothesis.least_gain if hypothesis.least_gain > 0.0 else np.inf
            sizes[family] = max(size, sizes.get(family, 0.0))
    return sizes


def _tool(model: MachineModel, fitted: FittedParameters, change: Explanation) -> tuple[float, float] | None:
    """Return how far a change moves the tool in the measured box, RMS, as it stands and with the datum aligned, m."""
    space, region = fitted.space, model.measured
    if region is None:  # no box in which a datum could be aligned
        return None
    places = np.random.default_rng(5).uniform(region.box[0], region.box[1], (100, 3))
    try:
        _, *slopes, _ = ErrorPredictor(RealMachine(space.geometry, model), fitted).slopes(
            region.poses(places, space.level)
        )
    except CalibrationError:  # hardly a pose of the box can be reached
        return None
    standing, aligned = (np.linalg.norm(part[:, :3] @ change.mean, axis=1) for part in slopes)
    return rms(standing[np.isfinite(standing)]), rms(aligned[np.isfinite(aligned)])


@dataclass(frozen=True)
class Update:
    """A renewed model."""

    model: MachineModel
    fitted: FittedParameters  # what is known of its parameters now
    chi_square: float  # squared differences of the readings from it over their noise, per independent number


def refusal(verification: Verification) -> str:
    """Return why few readings cannot renew a model; empty where they can."""
    best = verification.candidates[0].change
    if verification.doubts:
        return f"the readings may be others than they are taken for: {verification.doubts[0]}"
    if verification.verdict == VALID:
        return ""
    if verification.verdict == UNEXPLAINED:
        return "the machine has changed in a way that few readings cannot repair: measure a campaign and fit anew"
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
    repairable = [c for c in changes if c.family not in (READING, OTHER)]
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
