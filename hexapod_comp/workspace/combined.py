"""All errors together: worst case, root sum of squares, Monte Carlo; and the allowed size of each error."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import brentq
from scipy.stats import binom

from ..errors import CalibrationError, ModelError
from .budget import SingleErrors

RSS, WORST_CASE = "rss", "worst_case"  # How an allocation adds the errors up
UNIFORM, NORMAL = "uniform", "normal"  # Distributions of u: uniform within ±1, or normal with a standard deviation of 1
CHUNK = 512  # Poses handled together: bounds the memory of all combinations of signs
LARGEST_FACTOR = 1e9  # A source that may grow by more has no significant effect


def worst_case(errors: SingleErrors, vectors: np.ndarray) -> np.ndarray:
    """Return the largest effect of errors within their bounds together, shape (N, 2)."""
    return _worst(_along_struts(errors, vectors).sum(axis=3))


def root_sum_of_squares(vectors: np.ndarray) -> np.ndarray:
    """Return the root sum of squares of all effects, shape (N, 2)."""
    squares = (vectors**2).sum(axis=1)
    return np.sqrt(np.stack([squares[:, :3].sum(axis=1), squares[:, 3:].max(axis=1)], axis=1))


def covariance_factor(covariance: np.ndarray) -> np.ndarray:
    """Return A with A·Aᵀ = a covariance, shape (P, P): independent errors of one sigma each."""
    scale = np.sqrt(np.abs(np.diag(covariance)))
    scale = np.where(scale > 0.0, scale, 1.0)
    normalised = covariance / np.outer(scale, scale)  # parameters of µm and of rad/m in one matrix
    if not (np.isfinite(covariance).all() and np.allclose(normalised, normalised.T, atol=1e-8)):
        raise CalibrationError("covariance", "must be finite and symmetric")
    values, directions = np.linalg.eigh(normalised)
    if values[0] < -1e-8 * len(covariance):
        raise CalibrationError("covariance", f"must not be negative in any direction, eigenvalue {values[0]:.3g}")
    return scale[:, None] * directions * np.sqrt(np.maximum(values, 0.0))


@dataclass(frozen=True)
class MonteCarlo:
    """Percentiles of the combined error over many machines, with their confidence bounds."""

    percentiles: tuple[float, ...]  # Q percentages
    # (Q, N, 2): at each pose: percentile, and bounds between which the true one lies with the confidence asked for
    values: np.ndarray
    low: np.ndarray
    high: np.ndarray
    # (Q, 2): the same for each machine's largest error over all poses: machines differ in their worst place
    worst_values: np.ndarray
    worst_low: np.ndarray
    worst_high: np.ndarray
    draws: int  # How many machines
    confidence: float  # Of the bounds, 0…1


def monte_carlo(
    vectors: np.ndarray,
    draws: int = 10_000,
    percentiles: Sequence[float] = (50.0, 95.0, 99.0),
    confidence: float = 0.95,
    seed: int = 1,
    distribution: str = UNIFORM,
) -> MonteCarlo:
    """Draw machines within their errors and return percentiles of the tool's error."""
    ranks = np.array([_ranks(draws, percentile, confidence) for percentile in percentiles])
    deviates = _deviates(vectors.shape[1], draws, distribution, seed)
    worst = np.zeros((2, draws))
    drawn = np.empty((len(vectors), 2, *ranks.shape))
    for n, effects in enumerate(vectors):
        errors = effects.T @ deviates
        sizes = np.stack([np.sqrt((errors[:3] ** 2).sum(axis=0)), np.abs(errors[3:]).max(axis=0)])
        np.maximum(worst, sizes, out=worst)
        drawn[n] = np.partition(sizes, np.unique(ranks), axis=1)[:, ranks]
    values, low, high = np.transpose(drawn, (3, 2, 0, 1))
    of_worst = np.transpose(np.sort(worst, axis=1)[:, ranks], (2, 1, 0))
    return MonteCarlo(tuple(percentiles), values, low, high, of_worst[0], of_worst[1], of_worst[2], draws, confidence)


def _deviates(count: int, draws: int, distribution: str, seed: int) -> np.ndarray:
    """Return each machine's errors in units of their sizes, shape (count, draws)."""
    rng = np.random.default_rng(seed)
    if distribution == UNIFORM:
        return rng.uniform(-1.0, 1.0, (count, draws))
    if distribution == NORMAL:
        return rng.standard_normal((count, draws))
    raise ModelError("distribution", f"must be {UNIFORM} or {NORMAL}", distribution)


def _ranks(draws: int, percentile: float, confidence: float) -> tuple[int, int, int]:
    """Return the indices, in ascending order of draws, of a percentile and of its confidence bounds."""
    if not 0.0 < percentile < 100.0:
        raise ModelError("percentiles", "must lie within (0, 100)", percentile)
    if not 0.0 < confidence < 1.0:
        raise ModelError("confidence", "must lie within (0, 1)", confidence)
    if draws < 1:
        raise ModelError("draws", "must be at least 1", draws)
    share, rest = 0.01 * percentile, 0.5 * (1.0 - confidence)
    low, high = (int(binom.ppf(q, draws, share)) for q in (rest, 1.0 - rest))
    if low < 1 or high >= draws:
        problem = f"are too few for bounds of the {percentile:g}th percentile with {confidence:.0%} confidence"
        raise ModelError("draws", problem, draws)
    return min(draws - 1, int(np.ceil(share * draws)) - 1), low - 1, high


@dataclass(frozen=True)
class Allocation:
    """The allowed errors, given the allowed error of the tool."""

    method: str  # ``rss`` or ``worst_case``
    allowed: float  # Allowed error of the tool at the worst pose, m
    combined: float  # combined error of the unchanged budget there, m
    pose: int  # number of the worst pose
    scale: float  # Largest factor that all sizes may be multiplied by
    # (K,): largest factor of each type with the others unchanged: ∞ if it has no effect, NaN if the others alone are
    # too much
    alone: np.ndarray
    # (K,): the sum of each type alone, and of all others without it, m or rad, each
    # at its own worst pose
    only: np.ndarray
    without: np.ndarray
    # (K,): factors with which every type uses the same part of the allowed error, and all together no more than all of
    # it; ∞ where a type has no effect
    equal: np.ndarray


def allocate(errors: SingleErrors, vectors: np.ndarray, allowed: float, method: str = RSS) -> Allocation:
    """Return the allowed size of each source so that the tool's displacement stays within what is allowed, m, at every
    pose."""
    if not 0.0 < allowed < np.inf:
        raise ModelError("allowed", "must be above zero", allowed)
    if method not in (RSS, WORST_CASE):
        raise ModelError("method", f"must be {RSS} or {WORST_CASE}", method)
    if not len(vectors):
        raise ModelError("poses", "there are none: the workspace is empty", 0)
    types = len(errors.kinds)
    if method == RSS:
        parts = (vectors[..., :3] ** 2).sum(axis=2) @ np.eye(types)[errors.kind]  # squared, (N, K)
    else:
        parts = _along_struts(errors, vectors)

    def combined(factors: np.ndarray) -> np.ndarray:
        """Return the combined error at each pose with each type's size multiplied, shape (N,)."""
        if method == RSS:
            return np.sqrt(parts @ factors**2)
        return _worst(parts @ factors)[:, 0]

    now = combined(np.ones(types))
    pose = int(np.argmax(now))
    alone = np.array([_alone(combined, types, k, allowed) for k in range(types)])
    scale = allowed / float(now[pose]) if now[pose] > 0.0 else np.inf
    only, without = (np.array([combined(row).max() for row in rows]) for rows in (np.eye(types), 1.0 - np.eye(types)))
    return Allocation(
        method, allowed, float(now[pose]), pose, scale, alone, only, without, _equal_parts(only, allowed, method)
    )


def _equal_parts(only: np.ndarray, allowed: float, method: str) -> np.ndarray:
    """Return the factors (K,) with which types, given their sums alone, use the same part."""
    acting = only > 0.0
    part = allowed / (np.sqrt(acting.sum()) if method == RSS else acting.sum())
    return np.where(acting, part / np.where(acting, only, 1.0), np.inf)


def _alone(combined: Callable[[np.ndarray], np.ndarray], types: int, kind: int, allowed: float) -> float:
    """Return the largest factor of one type: the combined error increases with it, so that a bracket is easily
    found."""

    def excess(factor: float) -> float:
        factors = np.ones(types)
        factors[kind] = factor
        return float(combined(factors).max()) - allowed

    if excess(0.0) > 0.0:
        return np.nan
    high = 1.0
    while excess(high) < 0.0:
        high *= 4.0
        if high > LARGEST_FACTOR:
            return np.inf
    return float(brentq(excess, 0.0, high, rtol=1e-10))


def _along_struts(errors: SingleErrors, vectors: np.ndarray) -> np.ndarray:
    """Return the combined effects of the errors of one direction, type by type, shape (N, G, 6, K)."""
    count = errors.struts.sum(axis=1)
    members = [np.flatnonzero(errors.struts[:, strut] & (count == 1)) for strut in range(6)]
    members = [chosen for chosen in members if len(chosen)] + [np.array([n]) for n in np.flatnonzero(count != 1)]
    result = np.zeros((len(vectors), len(members), 6, len(errors.kinds)))
    for group, chosen in enumerate(members):
        one = vectors[:, chosen]
        longest = np.argmax((one**2).sum(axis=2), axis=1)
        direction = one[np.arange(len(one)), longest]
        ways = np.where(np.einsum("nec,nc->ne", one, direction) < 0.0, -1.0, 1.0)
        for n, error in enumerate(chosen):
            result[:, group, :, errors.kind[error]] += ways[:, n, None] * one[:, n]
    return result


def _worst(groups: np.ndarray) -> np.ndarray:
    """Return the largest |Σ ± w| over all signs, (N, G, 6) → (N, 2)."""
    parts = [groups[start : start + CHUNK] for start in range(0, len(groups), CHUNK)]
    farthest = np.concatenate([_farthest(part[..., :3]) for part in parts])
    return np.stack([farthest, _turns(groups)], axis=1)


def _farthest(ways: np.ndarray) -> np.ndarray:
    """Return the largest |Σ ± w| of vectors in space over all signs, (N, G, 3) → (N,)."""
    count = ways.shape[1]
    if count < 2:
        return np.linalg.norm(ways.sum(axis=1), axis=1)
    one, other = np.triu_indices(count, 1)
    aside = np.sin(np.arange(1.0, 3 * count + 1.0)).reshape(count, 3)
    split = ways + 1e-9 * np.linalg.norm(ways, axis=2).max(axis=1)[:, None, None] * aside
    normals = np.cross(split[:, one], split[:, other])
    signs = np.where(normals @ split.swapaxes(1, 2) < 0.0, -1.0, 1.0)  # (N, faces, G)
    pairs = np.arange(len(one))
    signs[:, pairs, one] = signs[:, pairs, other] = 0.0
    rest = signs @ ways
    corners = [rest + ways[:, one] + turn * ways[:, other] for turn in (1.0, -1.0)]
    corners += [rest - ways[:, one] + turn * ways[:, other] for turn in (1.0, -1.0)]
    return np.sqrt(np.max([(corner**2).sum(axis=2).max(axis=1) for corner in corners], axis=0))


def _turns(vectors: np.ndarray) -> np.ndarray:
    """Return the largest possible rotation about an axis, shape (N,): the signs are chosen for each axis."""
    return np.abs(vectors[..., 3:]).sum(axis=1).max(axis=1)
