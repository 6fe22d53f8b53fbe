"""Is a model still valid? A few check readings, weighed against what may have happened since the fit.

The fit's posterior says by how much the readings of an unchanged machine may differ from its model; each change adds a
few directions. Probabilities follow from marginal likelihoods, the rate of false alarms from machines drawn unchanged.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..errors import CalibrationError, ModelError
from ..machine.model import MachineModel, RealMachine
from ..machine.size import rms
from ..measurements.readings import MeasurementSet
from .changes import DATUM, FAMILIES, OTHER, STRUT, TEMPERATURE, Change, possible_changes, widened
from .check_readings import CheckReadings, explained, weigh
from .evidence import Evidence
from .posterior import ErrorPredictor, FittedParameters
from .settling import Settling, settle
from .suspicions import misread

FALSE_ALARMS = 0.01
"""Share of unchanged machines that may be called changed."""

SURE = 0.9
"""A kind of change, also the one that nothing explains, is stated when it has this share of the probability of all."""

CLEAR = 4.0
"""A change of so many standard deviations is surely seen."""

POSES, SEED = 100, 5
"""Random places of the measured box at which the tool is looked at."""

VALID, NAMED, UNDECIDED, UNEXPLAINED = "valid", "named", "undecided", "unexplained"
"""Verdicts."""


@dataclass(frozen=True)
class Candidate:
    """What may have happened, and how well the readings bear it out.

    Attributes
    ----------
    family, name : str
        As of a :class:`~.changes.Change`.
    probability : float
        Among all changes, given that there is one.
    change : Change or None
        None: nothing of the machine's.
    scale : float
        The most probable of its scales.
    coefficients, deviations : ndarray, shape (k,)
        How large it is, in the coefficients that :attr:`Change.shown` tells of, SI, and how well that is known; empty
        where they mean nothing one by one.
    """

    family: str
    name: str
    probability: float
    change: Change | None
    scale: float
    coefficients: np.ndarray
    deviations: np.ndarray


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
    tool: tuple[float, float] | None
    settling: tuple[Settling, ...]
    doubts: tuple[str, ...] = ()

    @property
    def verdict(self) -> str:
        """:data:`VALID`, :data:`NAMED`, :data:`UNDECIDED` or :data:`UNEXPLAINED`."""
        return _verdict(self.usual > self.false_alarms, self.families)


def _verdict(valid: bool, families: dict[str, float]) -> str:
    best = max(families, key=lambda family: families[family])
    if valid:
        return VALID
    if families[best] < SURE:
        return UNDECIDED
    return UNEXPLAINED if best == OTHER else NAMED


def verify_model(
    model: MachineModel,
    fitted: FittedParameters,
    measurements: MeasurementSet,
    false_alarms: float = FALSE_ALARMS,
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
    check = CheckReadings(wide, measurements)
    changes = possible_changes(wide.space, tuple(block.name for block in fitted.space.blocks))
    evidence = weigh(check, wide, changes, measurements)
    families, candidates = _candidates(check, wide, changes, evidence)
    usual, chi_square = evidence.probability_unchanged(check.residuals), _chi_square(wide, check)
    verdict = _verdict(usual > false_alarms, families)
    doubts = misread(measurements, model, chi_square, lambda tried: _chi_square(wide, CheckReadings(wide, tried)))
    return Verification(
        model=model,
        measurements=measurements,
        independent=len(check.residuals),
        chi_square=chi_square,
        usual=usual,
        false_alarms=false_alarms,
        families=families,
        candidates=candidates,
        visible=_visible(evidence),
        tool=None if verdict == VALID else _tool(model, wide, check, candidates[0]),
        settling=_settling(wide, check, measurements, candidates) if verdict == UNDECIDED else (),
        doubts=tuple(doubts),
    )


def _chi_square(fitted: FittedParameters, check: CheckReadings) -> float:
    """Return the squared differences of readings from what is expected of an unchanged machine, per number."""
    solved = np.linalg.solve(check.covariance(fitted.covariance), check.residuals)
    return float(check.residuals @ solved) / len(solved)


def _candidates(
    check: CheckReadings, fitted: FittedParameters, changes: list[Change], evidence: Evidence
) -> tuple[dict[str, float], tuple[Candidate, ...]]:
    """Return the probability of each kind, and its best explanation, the most probable kind first."""
    weights = evidence.weights(check.residuals)
    kinds = np.array([hypothesis.family for hypothesis in evidence.hypotheses])
    shares = np.exp(np.array([np.logaddexp.reduce(w) for w in weights]) - np.logaddexp.reduce(np.concatenate(weights)))
    families = {family: float(shares[kinds == family].sum()) for family in FAMILIES}
    candidates = []
    for family in sorted(families, key=lambda name: -families[name]):
        number = int(np.where(kinds == family, shares, -1.0).argmax())
        hypothesis = evidence.hypotheses[number]
        change = changes[number] if number < len(changes) else None
        scale = float(hypothesis.scales[weights[number].argmax()])
        sizes = _sizes(check, fitted, change, scale)
        candidates.append(Candidate(family, hypothesis.name, float(shares[number]), change, scale, *sizes))
    return families, tuple(candidates)


def _sizes(
    check: CheckReadings, fitted: FittedParameters, change: Change | None, scale: float
) -> tuple[np.ndarray, np.ndarray]:
    """Return a change's coefficients by the readings, and their standard deviations."""
    if change is None or not change.shown:
        return np.zeros(0), np.zeros(0)
    effect = check.rows @ change.columns
    covariance = check.covariance(fitted.covariance) + scale**2 * effect @ effect.T
    solved = scale**2 * np.linalg.solve(covariance, effect)
    variance = scale**2 - scale**2 * np.diag(effect.T @ solved)
    return solved.T @ check.residuals, np.sqrt(np.maximum(variance, 0.0))


def _visible(evidence: Evidence) -> dict[str, float]:
    """Return the smallest change of a kind that is surely seen, whichever strut, body or direction it is of."""
    sizes: dict[str, float] = {}
    for hypothesis in evidence.hypotheses:
        if hypothesis.family == DATUM or (hypothesis.coefficients == 1 and hypothesis.family in (STRUT, TEMPERATURE)):
            least = hypothesis.least_gain
            size = CLEAR / least if least > 0.0 else np.inf
            sizes[hypothesis.family] = max(size, sizes.get(hypothesis.family, 0.0))
    return sizes


def _tool(
    model: MachineModel, fitted: FittedParameters, check: CheckReadings, candidate: Candidate
) -> tuple[float, float] | None:
    """Return how far a change moves the tool in the measured box, RMS, as it stands and with the datum aligned, m."""
    if candidate.change is None:
        return None
    space, region = fitted.space, model.measured
    if region is None:  # no box in which a datum could be aligned
        return None
    places = np.random.default_rng(SEED).uniform(region.box[0], region.box[1], (POSES, 3))
    predictor = ErrorPredictor(RealMachine(space.geometry, model), fitted)
    try:
        _, *slopes, _ = predictor.slopes(region.poses(places, space.level))
    except CalibrationError:  # hardly a pose of the box can be reached
        return None
    mean = explained(check, fitted, candidate.change, candidate.scale).mean
    moved = [np.linalg.norm(part[:, :3] @ mean, axis=1) for part in slopes]
    return rms(moved[0][np.isfinite(moved[0])]), rms(moved[1][np.isfinite(moved[1])])


def _settling(
    fitted: FittedParameters, check: CheckReadings, measurements: MeasurementSet, candidates: tuple[Candidate, ...]
) -> tuple[Settling, ...]:
    """Return readings that would tell the two most probable kinds of change apart."""
    explanations = [explained(check, fitted, c.change, c.scale) for c in candidates[:2]]
    return tuple(settle(fitted, measurements, (explanations[0], explanations[1])))
