"""Which blocks of parameters a fit keeps: those with enough evidence.

All blocks are in at first, so that a field cannot explain an error that a length map describes better only because it
was tried first. The evidence for each is the logarithm of the Bayes factor with against without it: by the
Savage–Dickey density ratio, the prior's density of "all its parameters are zero" over the posterior's. The block with
the least evidence is dropped, and the fit is solved again, until all remaining ones have enough.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.linalg.lapack import dpotrf, dtrtrs

from .assumptions import ASSUMED
from .estimator import FEW_ROUNDS, ROUNDS, LinearProblem, Posterior, solve
from .parameters import ParameterSpace

SILENT = 1e-9
"""Parameters with a smaller share determined by readings are omitted: they change nothing."""


@dataclass(frozen=True)
class Decision:
    """The decision on one block."""

    block: str
    kept: bool
    evidence: float  # log Bayes factor with against without it, given the blocks that were in when it was decided on


def select(
    space: ParameterSpace, problem: LinearProblem, noise: np.ndarray, progress: Callable[[str], object]
) -> tuple[list[Decision], Posterior, Posterior]:
    """Return a decision for each block but the structure; the posterior with all blocks in, and with those kept.

    A block whose size is stated is always kept.
    """
    everything = fit = solve(space, problem, space.start_tolerances(), noise, ROUNDS)
    silent = everything.used[everything.determined < SILENT]
    kept = [block.name for block in space.blocks[1:]]
    evidence: dict[str, float] = {}
    doubtful = [block.name for block in space.blocks[1:] if not block.stated]
    while kept:
        evidence |= {name: log_bayes_factor(space, fit, name) for name in kept}
        if not doubtful:
            break
        least = min(doubtful, key=lambda name: evidence[name])
        if evidence[least] >= ASSUMED.least_evidence:
            break
        progress(f"without {least}: its evidence is {evidence[least]:.1f}")
        kept.remove(least)
        doubtful.remove(least)
        kept_in = np.array([block.name in ("structure", *kept) for block in space.blocks])
        fit = solve(space, problem, kept_in * fit.tolerances, fit.noise, FEW_ROUNDS, silent)
    return [Decision(b.name, b.name in kept, evidence[b.name]) for b in space.blocks[1:]], everything, fit


def log_bayes_factor(space: ParameterSpace, posterior: Posterior, name: str) -> float:
    """Return log p(readings | with a block) − log p(without) (Savage–Dickey), all hyperparameters alike."""
    part = next(block.part for block in space.blocks if block.name == name)
    members = np.flatnonzero((posterior.used >= part.start) & (posterior.used < part.stop))
    if not len(members):  # the readings have no information on it
        return 0.0
    spread = posterior.spread[members]
    relative = posterior.covariance[np.ix_(members, members)] / (spread[:, None] * spread)
    factor, failed = dpotrf(relative, lower=1)
    if failed:  # to rounding, some parameters are known exactly
        return np.inf
    met = dtrtrs(factor, posterior.y[members] / spread, lower=1)[0]
    return float(0.5 * met @ met + np.log(np.diag(factor)).sum())
