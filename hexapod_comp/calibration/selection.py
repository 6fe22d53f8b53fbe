"""Selection of the blocks of parameters that a fit keeps: blocks with enough evidence.

At first all blocks are in the fit, so that no block explains an error only because it was tried first. The evidence for
a block is the log Bayes factor of the fit with the block over the fit without it. It is computed by the Savage–Dickey
ratio: the prior density of the block's parameters at zero, divided by their posterior density at zero. The block with
the least evidence is dropped and the fit is solved again, until every remaining block has an evidence of
`least_evidence` or more.
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
"""After the first fit, a parameter is omitted if the readings determine less than this share of it, to save time."""


@dataclass(frozen=True)
class Decision:
    """The decision to keep or to drop one block."""

    block: str
    kept: bool
    evidence: float  # log Bayes factor for the block in the last fit with this block


def select(
    space: ParameterSpace, problem: LinearProblem, noise: np.ndarray, progress: Callable[[str], object]
) -> tuple[list[Decision], Posterior, Posterior]:
    """Return a decision for each block except the structure, the posterior with all blocks, and with the kept blocks.

    A block whose tolerance is stated is always kept. A block that a kept block extends is kept, too (marginality).
    """
    everything = fit = solve(space, problem, space.start_tolerances(), noise, ROUNDS)
    silent = everything.used[everything.determined < SILENT]
    kept = [block.name for block in space.blocks[1:]]
    evidence: dict[str, float] = {}
    while kept:
        evidence |= {name: log_bayes_factor(space, fit, name) for name in kept}
        extended = {block.extends for block in space.blocks if block.name in kept}
        doubtful = [b.name for b in space.blocks if b.name in kept and not b.stated and b.name not in extended]
        if not doubtful:
            break
        least = min(doubtful, key=lambda name: evidence[name])
        if evidence[least] >= ASSUMED.least_evidence:
            break
        progress(f"dropping block {least}: its evidence is {evidence[least]:.1f}")
        kept.remove(least)
        kept_in = np.array([block.name in ("structure", *kept) for block in space.blocks])
        fit = solve(space, problem, kept_in * fit.tolerances, fit.noise, FEW_ROUNDS, silent)
    return [Decision(b.name, b.name in kept, evidence[b.name]) for b in space.blocks[1:]], everything, fit


def log_bayes_factor(space: ParameterSpace, posterior: Posterior, name: str) -> float:
    """Return the log Bayes factor (Savage–Dickey) for a block; tolerances and noise are the same without the block."""
    part = next(block.part for block in space.blocks if block.name == name)
    members = np.flatnonzero((posterior.used >= part.start) & (posterior.used < part.stop))
    if not len(members):  # the block's parameters were omitted (SILENT)
        return 0.0
    spread = posterior.spread[members]
    relative = posterior.covariance[np.ix_(members, members)] / (spread[:, None] * spread)
    factor, failed = dpotrf(relative, lower=1)
    if failed:  # the covariance is singular to rounding: some parameters are known exactly
        return np.inf
    scaled = dtrtrs(factor, posterior.y[members] / spread, lower=1)[0]
    return float(0.5 * scaled @ scaled + np.log(np.diag(factor)).sum())
