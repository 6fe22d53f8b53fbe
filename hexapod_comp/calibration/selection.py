"""Selection of the blocks of parameters that a fit keeps, by Bayes factors (backward elimination).

The fit starts with all blocks, so that none is kept only because it was tried first. The block with the smallest log
Bayes factor is dropped, and the fit is solved again, until no block has one below ASSUMED.least_evidence.
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
"""To save time, later fits omit a parameter whose prior variance the readings lower by a smaller share than this."""


@dataclass(frozen=True)
class Decision:
    block: str
    kept: bool
    evidence: float  # log Bayes factor for the block, in the last fit that contained it


def select(
    space: ParameterSpace, problem: LinearProblem, noise: np.ndarray, progress: Callable[[str], object]
) -> tuple[list[Decision], Posterior, Posterior]:
    """Decide which blocks to keep (the structure always); return the decisions, the posterior of all blocks, and the
    posterior of the kept blocks.

    Blocks with a stated tolerance are kept, as are blocks that a kept block extends (marginality).
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
    """Return the log Bayes factor for a block: prior / posterior density of its parameters at zero (Savage–Dickey)."""
    part = next(block.part for block in space.blocks if block.name == name)
    members = np.flatnonzero(posterior.within(part))
    if not len(members):  # all were omitted by SILENT
        return 0.0
    spread = posterior.spread[members]
    relative = posterior.covariance[np.ix_(members, members)] / (spread[:, None] * spread)
    factor, failed = dpotrf(relative, lower=1)
    if failed:  # singular: some parameters are known exactly
        return np.inf
    scaled = dtrtrs(factor, posterior.y[members] / spread, lower=1)[0]
    return float(0.5 * scaled @ scaled + np.log(np.diag(factor)).sum())
