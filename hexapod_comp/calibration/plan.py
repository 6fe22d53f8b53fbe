"""What a campaign will determine, and what it will not, before anyone measures."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..measurements.campaign import Campaign
from ..measurements.readings import DEFAULT_UNCERTAINTY, KINDS, MeasurementSet
from .estimator import Estimation, physical_covariance, solve
from .fit import unseen_errors
from .parameters import FitSettings, ParameterSpace
from .posterior import Observability, ToolError, UnseenError, expected_error, observe
from .promise import Scatter, Unexplained
from .verdict import TILT


@dataclass(frozen=True)
class Plan:
    """What may be expected of a campaign.

    Attributes
    ----------
    measurements : MeasurementSet
        Its readings, without values.
    space : ParameterSpace
        The parameters to be fitted.
    observability : Observability
        What the readings will determine.
    unseen_errors : tuple of UnseenError
        Machine errors that they will not show.
    level, tilted : ToolError or None
        The tool error to expect after a fit, the machine's repeatability included; `before` is that of machines within
        the tolerances.
    stops : float
        The machine's repeatability as stated, RMS over all three axes, m; 0 where none is.
    """

    measurements: MeasurementSet
    space: ParameterSpace
    observability: Observability
    unseen_errors: tuple[UnseenError, ...]
    level: ToolError | None
    tilted: ToolError | None
    stops: float


def plan(measurements: MeasurementSet, campaign: Campaign, settings: FitSettings) -> Plan:
    """Return what a campaign's readings would determine on a machine within the settings' tolerances.

    Parameters
    ----------
    measurements : MeasurementSet
        The campaign's template.
    campaign : Campaign
        Tells the instruments' noise and the machine's repeatability.
    settings : FitSettings
        Blocks and tolerances.
    """
    space = ParameterSpace(measurements, settings)
    estimation = Estimation(measurements, space)
    problem, _ = estimation.linearise(np.zeros(space.size), np.ones(len(measurements)))
    noise = np.array([noise_factor(campaign, kind) for kind in KINDS])
    posterior = solve(space, problem, space.start_tolerances(), noise, rounds=0)
    covariance, x = physical_covariance(space, posterior), np.zeros(space.size)
    prior = space.prior_covariance(space.start_tolerances())
    beyond = Unexplained(displacement=Scatter(stops=campaign.stops, most_stops=campaign.stops))
    level, tilted = (expected_error(space, x, covariance, tilt, prior, None, beyond) for tilt in (0.0, TILT))
    return Plan(
        measurements=measurements,
        space=space,
        observability=observe(space, problem, posterior, measurements.tilt()),
        unseen_errors=unseen_errors(measurements, settings),
        level=level,
        tilted=tilted,
        stops=campaign.stops,
    )


def noise_factor(campaign: Campaign, kind: str) -> float:
    """Return the noise of a kind of channel over the default, the machine's repeatability included."""
    noise = campaign.noise[KINDS.index(kind)]
    if kind not in ("rotation", "attitude"):
        noise = float(np.hypot(noise, campaign.repeatability))
    return max(noise, 1e-3 * DEFAULT_UNCERTAINTY[kind]) / DEFAULT_UNCERTAINTY[kind]
