"""A model renewed from few readings: its old posterior is the prior, widened by what may have happened since.

The answer is a mixture over all changes that parameters can follow, each with its probability; where one of them is
certain it is that one's.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from datetime import date

import numpy as np

from ..errors import CalibrationError
from ..machine.model import MachineModel
from ..measurements.readings import MeasurementSet
from .assumptions import ASSUMED
from .changes import FAMILIES, OTHER, READING, REPAIRABLE, TEMPERATURE, Change, possible_changes, widened
from .check_readings import CheckReadings, Explanation, explained, weigh
from .datum import hold, unseen_part
from .estimator import Estimation
from .posterior import FittedParameters
from .verification import UNEXPLAINED, VALID, Verification

STEPS = 3
"""Gauss–Newton steps: a change of a tenth of a millimetre settles in two."""

NEGLIGIBLE = 1e-4
"""Explanations less probable than this are left out of the mixture."""


@dataclass(frozen=True)
class Update:
    """A renewed model.

    Attributes
    ----------
    model : MachineModel
        The new model.
    fitted : FittedParameters
        What is known of its parameters now.
    chi_square : float
        Squared differences of the readings from it over their noise, per independent number.
    """

    model: MachineModel
    fitted: FittedParameters
    chi_square: float


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
        What :func:`~.verification.verify_model` makes of them.

    Raises
    ------
    CalibrationError
        Readings that were counted before.
    """
    counted = {digest for _, digest in model.origin.sources}
    for name, digest in measurements.files:
        if digest in counted:
            raise CalibrationError("measurements", f"{name} is in this model already; its readings would count twice")
    modelled = tuple(block.name for block in fitted.space.blocks)
    warm = verification.verdict != VALID and verification.families[TEMPERATURE] > NEGLIGIBLE
    prior = widened(fitted, ("pitch",) if warm else ())
    changes = [c for c in possible_changes(prior.space, modelled) if c.family in REPAIRABLE]
    x = prior.x
    for _ in range(STEPS):
        check = CheckReadings(prior, measurements, x)
        answer = _mixture(check, prior, [] if verification.verdict == VALID else changes, measurements)
        x = prior.x + answer.mean
    renewed = _held(model, replace(prior, x=x, covariance=answer.covariance), measurements, verification)
    left = CheckReadings(renewed[1], measurements)
    return Update(*renewed, float(left.residuals @ np.linalg.solve(left.noise, left.residuals)) / len(left.residuals))


def _mixture(
    check: CheckReadings, prior: FittedParameters, changes: list[Change], measurements: MeasurementSet
) -> Explanation:
    """Return mean and covariance of the parameters over all changes, none of them meaning no change."""
    if not changes:
        return explained(check, prior, None, 0.0)
    weights = weigh(check, prior, changes, measurements).weights(check.residuals)[: len(changes)]
    whole = np.logaddexp.reduce(np.concatenate(weights))
    parts, shares = [], []
    for change, logs in zip(changes, weights, strict=True):
        for scale, share in zip(change.scales, np.exp(logs - whole), strict=True):
            if share > NEGLIGIBLE:
                parts.append(explained(check, prior, change, scale))
                shares.append(share)
    share = np.array(shares) / sum(shares)
    mean = sum(s * part.mean for s, part in zip(share, parts, strict=True))
    away = [part.mean - mean for part in parts]
    covariance = sum(s * (part.covariance + np.outer(a, a)) for s, part, a in zip(share, parts, away, strict=True))
    return Explanation(np.asarray(mean), np.asarray(covariance))


def _held(
    old: MachineModel, fitted: FittedParameters, measurements: MeasurementSet, verification: Verification
) -> tuple[MachineModel, FittedParameters]:
    """Return the model of new parameters with its origin, and these; the datum stays where it is not seen."""
    origin = replace(
        old.origin,
        date=date.today().isoformat(),
        sources=(*old.origin.sources, *measurements.files),
        held_out_residual=None,
        note=f"renewed from {len(measurements)} readings ({_reason(verification)}). {old.origin.note}",
        posterior=None,
    )
    space, before = fitted.space, fitted.held
    model = replace(
        space.model(fitted.x.round(ASSUMED.digits), old.name), reversal_threshold=old.reversal_threshold, origin=origin
    )
    if before is None:
        return model, fitted
    estimation = Estimation(measurements, space, alone=False)
    part = unseen_part(estimation, fitted.tolerances[0], fitted.noise, before.pose, before.part)
    model, held = hold(space.geometry, model, before.pose, part)
    return model, replace(fitted, held=held)


def _reason(verification: Verification) -> str:
    """Return why a model was renewed."""
    best = verification.candidates[0]
    return "it held" if verification.verdict == VALID else f"{FAMILIES[best.family]}: {best.name}"


def refusal(verification: Verification) -> str:
    """Return why few readings cannot renew a model; empty where they can."""
    if verification.doubts:
        return f"the readings may be others than they are taken for: {verification.doubts[0]}"
    if verification.verdict == UNEXPLAINED:
        return "the machine has changed in a way that few readings cannot repair: measure a campaign and fit anew"
    best = verification.candidates[0]
    if verification.verdict != VALID and best.family == READING:
        return f"a single reading is probably wrong: {best.name}; take it again"
    if verification.verdict != VALID and best.family == OTHER:
        return "it is open whether few readings can repair what has changed: take those that verify proposes as well"
    return ""
