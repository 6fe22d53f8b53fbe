"""What a settled fit promises, what is wrong with it, and whether its model may be written."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from ..measurements.readings import ANGULAR_KINDS, DEFAULT_UNCERTAINTY, KINDS, MeasurementSet
from .assumptions import ASSUMED
from .estimator import Estimation, Solution, physical_covariance
from .misfit import ChiSquare, chi_squares, held_by_priors, stated_scale, unexplained
from .parameters import FitSettings, ParameterSpace
from .posterior import Allowed, ToolError, expected_error
from .promise import Unexplained
from .residuals import Residuals

DOUBTFUL = 3.0
"""Readings whose noise is estimated so many times as large as stated put the whole fit in doubt."""

MISFIT = 10.0
"""Readings whose noise is estimated so many times as large as stated are not described: units, instrument or machine
are others than said."""

TILT = np.radians(10.0)
"""Tilt at which the report says what the model is worth for a tilted tool."""


@dataclass(frozen=True)
class Verdict:
    """What a fit promises.

    Attributes
    ----------
    level, tilted : ToolError or None
        The tool error to expect, for a level tool and for one tilted by :data:`TILT`, allowing for what is unexplained;
        None where nothing can be promised.
    unexplained : Unexplained
        What the readings show that no parameter describes.
    chi_squares, worst_runs : tuple of ChiSquare
        χ² by channel, of families of lines and of directions; and of single runs, the worst first.
    refusals : tuple of str
        Why the model is not to be written without force.
    doubts : tuple of str
        What else is wrong.
    remarks : tuple of str
        What else a reader must know.
    """

    level: ToolError | None
    tilted: ToolError | None
    unexplained: Unexplained
    chi_squares: tuple[ChiSquare, ...]
    worst_runs: tuple[ChiSquare, ...]
    refusals: tuple[str, ...]
    doubts: tuple[str, ...]
    remarks: tuple[str, ...]

    def without_rotation(self, why: str) -> Verdict:
        """Return the same with no interval for the tool's rotation, of which the priors alone would speak."""
        level, tilted = (
            None if error is None else replace(error, rotation_low=None, rotation_high=None, rotation_unknown=why)
            for error in (self.level, self.tilted)
        )
        return replace(self, level=level, tilted=tilted)


def judge(
    estimation: Estimation,
    solution: Solution,
    allowed: Allowed,
    everything: Callable[[], tuple[Residuals, np.ndarray]],
    settings: FitSettings,
    noise: Mapping[int, float],
    mixed_up: Sequence[str] = (),
) -> Verdict:
    """Return what a settled fit promises and what is wrong with it.

    Parameters
    ----------
    estimation, solution : Estimation, Solution
        The fit.
    allowed : Allowed
        What the readings do not rule out.
    everything : callable
        As for :func:`~.misfit.unexplained`.
    settings : FitSettings
        Of the fit, with all blocks that it might have used.
    noise : mapping of int to float
        Standard deviation that was estimated for each kind of channel, m or rad.
    mixed_up : sequence of str
        How the readings must have been taken to be more probable.
    """
    measurements, space = estimation.measurements, estimation.space
    residuals = Residuals.of(estimation, solution)
    beyond = unexplained(residuals, stated_scale(measurements, settings), everything)
    covariance = physical_covariance(space, solution.posterior)
    level_only = _is_level_only(measurements, space)
    level, tilted = (
        None if level_only and tilt else expected_error(space, solution.x, covariance, tilt, None, allowed, beyond)
        for tilt in (0.0, TILT)
    )
    families, runs = chi_squares(residuals)
    far_off, doubtful = measurements.misfit(noise, MISFIT), measurements.misfit(noise, DOUBTFUL)
    doubts = [*([] if far_off else [doubtful]), *beyond.doubts(), _unsettled(solution)]
    refusals = [far_off, _useless(level), _held(residuals), *mixed_up]
    remarks = [*beyond.remarks(), _unstated(measurements), NOT_TILTED if level_only else ""]
    listed = (tuple(filter(None, part)) for part in (refusals, doubts, remarks))
    return Verdict(level, tilted, beyond, families, runs, *listed)


NOT_TILTED = "a field was needed, and measured with a level tool alone: nothing is promised for a tilted one"


def _is_level_only(measurements: MeasurementSet, space: ParameterSpace) -> bool:
    """Return whether a field is needed that was measured with a level tool alone: it says nothing of a tilted one."""
    return space.block("field displacement") is not None and measurements.tilt() < 0.5 * TILT


def _unstated(m: MeasurementSet) -> str:
    """Return a remark on lengths whose noise is assumed, for the machine's own may hide in it; empty if none is."""
    unstated = np.unique(m.kind[~np.isfinite(m.uncertainty)])
    listed = [
        f"{KINDS[k]} {DEFAULT_UNCERTAINTY[KINDS[k]] * 1e6:g} µm" for k in unstated if KINDS[k] not in ANGULAR_KINDS
    ]
    if not listed:
        return ""
    problem = f"no uncertainty is stated ({', '.join(listed)} assumed)"
    return f"{problem}: what the machine's own repeatability has of that is not in the expected tool error"


def _useless(level: ToolError | None) -> str:
    """Return a remark on a model that is expected to do harm; empty if it is not."""
    if level is None or level.after <= level.before:
        return ""
    return "the model is not expected to help: the readings determine too little of this machine"


def _held(residuals: Residuals) -> str:
    """Return a remark on a model that the readings hardly determine; empty if they do."""
    if not held_by_priors(residuals):
        return ""
    size, count = residuals.estimation.space.size, len(residuals.estimation.measurements)
    return f"{count} readings do not determine the {size} parameters: what they say of the tool comes from the priors"


def _unsettled(solution: Solution) -> str:
    """Return a remark on parameters that still moved when the steps were used up; empty if none did."""
    if solution.change < ASSUMED.settled:
        return ""
    moved = f"a parameter still moves by {solution.change:.2g} standard deviations"
    return f"the fit has not settled: after {solution.steps} steps {moved}"
