"""Effects of all errors together, as worst case and by Monte Carlo simulation; allowed sizes of errors."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import bdtr

from ..errors import CalibrationError, ModelError
from .budget import SingleErrors

CONFIDENCE = 0.95  # level of the bounds of percentiles
CHUNK = 512  # poses per block; limits the memory for all combinations of signs
LARGEST_FACTOR = 1e9  # an error type whose size may be multiplied by more than this factor has no effect


def worst_case(errors: SingleErrors, vectors: np.ndarray) -> np.ndarray:
    """Return displacement, m, and largest rotation about an axis, rad, (N, 2), by effects (N, E, 6), worst signs."""
    return _worst(_along_struts(errors, vectors).sum(axis=3))


def root_sum_of_squares(vectors: np.ndarray) -> np.ndarray:
    """Return RMS displacement, m, and largest RMS rotation about an axis, rad, (N, 2), by 1 σ effects (N, E, 6)."""
    squares = (vectors**2).sum(axis=1)
    return np.sqrt(np.stack([squares[:, :3].sum(axis=1), squares[:, 3:].max(axis=1)], axis=1))


def covariance_factor(covariance: np.ndarray) -> np.ndarray:
    """Return A, (P, P), with A·Aᵀ = covariance; the columns of A are the 1 σ effects of P independent errors."""
    scale = np.sqrt(np.abs(np.diag(covariance)))
    scale = np.where(scale > 0.0, scale, 1.0)
    normalised = covariance / np.outer(scale, scale)  # correlations: comparable between m and rad
    if not (np.isfinite(covariance).all() and np.allclose(normalised, normalised.T, atol=1e-8)):
        raise CalibrationError("covariance", "must be finite and symmetric")
    values, directions = np.linalg.eigh(normalised)
    if values[0] < -1e-8 * len(covariance):
        raise CalibrationError("covariance", f"must not have negative eigenvalues; smallest {values[0]:.3g}")
    return scale[:, None] * directions * np.sqrt(np.maximum(values, 0.0))


@dataclass(frozen=True)
class MonteCarlo:
    """Percentiles over random machines of the tool error that each machine has at its worst pose."""

    percentiles: tuple[float, ...]  # Q percentages
    values: np.ndarray  # (Q, 2): m, and rad about the worst axis
    low: np.ndarray  # (Q, 2): lower end of the interval that contains the true percentile with CONFIDENCE
    high: np.ndarray  # (Q, 2): its upper end
    draws: int


def monte_carlo(
    vectors: np.ndarray, draws: int, percentiles: Sequence[float] = (50.0, 95.0, 99.0), seed: int = 1,
    normal: bool = False,
) -> MonteCarlo:  # fmt: skip
    """Simulate `draws` machines with random factors on E errors; return percentiles over the machines.

    `vectors`, (N, E, 6), has the effects at N poses if all factors are 1. Factors are uniform in −1…1 or, if `normal`,
    normal with σ = 1.
    """
    rng, size = np.random.default_rng(seed), (vectors.shape[1], draws)
    deviates = rng.standard_normal(size) if normal else rng.uniform(-1.0, 1.0, size)
    worst = np.zeros((2, draws))
    for effects in vectors:
        errors = effects.T @ deviates
        sizes = np.stack([np.sqrt((errors[:3] ** 2).sum(axis=0)), np.abs(errors[3:]).max(axis=0)])
        np.maximum(worst, sizes, out=worst)
    ranks = np.array([_ranks(draws, percentile) for percentile in percentiles])
    values, low, high = np.transpose(np.sort(worst, axis=1)[:, ranks], (2, 1, 0))
    return MonteCarlo(tuple(percentiles), values, low, high, draws)


def _ranks(draws: int, percentile: float) -> tuple[int, int, int]:
    """Return the indices, in a sorted list of `draws` values, of a percentile and of its confidence interval."""
    share, rest = percentile / 100.0, 0.5 * (1.0 - CONFIDENCE)
    # Quantiles of the binomial distribution; scipy.stats has them, but takes a second to load
    low, high = np.searchsorted(bdtr(np.arange(draws + 1), draws, share), [rest, 1.0 - rest]).tolist()
    if low < 1 or high >= draws:
        problem = f"are too few for bounds of the {percentile:g}th percentile with {CONFIDENCE:.0%} confidence"
        raise ModelError("draws", problem, draws)
    return int(np.ceil(share * draws)) - 1, low - 1, high


@dataclass(frozen=True)
class Allocation:
    """Allowed sizes of K error types for an allowed tool error, if all errors add up with the worst signs."""

    allowed: float  # tool error at the worst pose, m
    combined: float  # tool error by the whole budget at the worst pose, m
    pose: int  # index of the worst pose
    scale: float  # factor by which all sizes together may be multiplied
    # (K,): allowed factor of one type if the others keep their sizes; ∞: no effect; NaN: the others exceed `allowed`
    alone: np.ndarray
    only: np.ndarray  # (K,): tool error by one type at its worst pose, m
    without: np.ndarray  # (K,): tool error by all other types at their worst pose, m
    # (K,): allowed factor of each type if all types with an effect cause equal shares of `allowed`
    equal: np.ndarray


def allocate(errors: SingleErrors, vectors: np.ndarray, allowed: float) -> Allocation:
    """Return how large the errors may be so that they displace the tool by at most `allowed`, m, at each of N poses."""
    if not 0.0 < allowed < np.inf:
        raise ModelError("allowed", "must be above zero", allowed)
    if not len(vectors):
        raise ModelError("poses", "must include a pose of the workspace, but the workspace is empty", 0)
    from scipy.optimize import brentq  # here, as loading it takes half a second

    types, parts = len(errors.kinds), _along_struts(errors, vectors)

    def combined(factors: np.ndarray) -> np.ndarray:
        """Return the tool error at each pose, (N,), with type k's size times `factors[k]`."""
        return _worst(parts @ factors)[:, 0]

    def largest_factor(kind: int) -> float:
        """Return the factor on one error type's size at which the largest tool error equals `allowed`."""

        def excess(factor: float) -> float:
            return float(combined(np.where(np.arange(types) == kind, factor, 1.0)).max()) - allowed

        if excess(0.0) > 0.0:
            return np.nan
        high = 1.0
        while excess(high) < 0.0:
            high *= 4.0
            if high > LARGEST_FACTOR:
                return np.inf
        return float(brentq(excess, 0.0, high, rtol=1e-10))

    now = combined(np.ones(types))
    most, pose = float(now.max()), int(np.argmax(now))
    only, without = (np.array([combined(row).max() for row in rows]) for rows in (np.eye(types), 1.0 - np.eye(types)))
    acting = only > 0.0
    return Allocation(
        allowed=allowed,
        combined=most,
        pose=pose,
        scale=allowed / most if most > 0.0 else np.inf,
        alone=np.array([largest_factor(kind) for kind in range(types)]),
        only=only,
        without=without,
        equal=np.where(acting, allowed / max(int(acting.sum()), 1) / np.where(acting, only, 1.0), np.inf),
    )


def _along_struts(errors: SingleErrors, vectors: np.ndarray) -> np.ndarray:
    """Sum effects (N, E, 6) by group and type, (N, G, 6, types); a group: one strut's errors, or one other error."""
    count = errors.struts.sum(axis=1)
    members = [np.flatnonzero(errors.struts[:, strut] & (count == 1)) for strut in range(6)]
    members = [chosen for chosen in members if len(chosen)] + [np.array([n]) for n in np.flatnonzero(count != 1)]
    result = np.zeros((len(vectors), len(members), 6, len(errors.kinds)))
    for group, chosen in enumerate(members):
        one = vectors[:, chosen]  # parallel vectors if the errors change only one strut
        longest = np.argmax((one**2).sum(axis=2), axis=1)
        direction = one[np.arange(len(one)), longest]
        ways = np.where(np.einsum("nec,nc->ne", one, direction) < 0.0, -1.0, 1.0)
        for n, error in enumerate(chosen):
            result[:, group, :, errors.kind[error]] += ways[:, n, None] * one[:, n]
    return result


def _worst(groups: np.ndarray) -> np.ndarray:
    """Return displacement, m, and largest rotation about an axis, rad, (N, 2), by effects (N, G, 6), worst signs."""
    parts = [groups[start : start + CHUNK] for start in range(0, len(groups), CHUNK)]
    farthest = np.concatenate([_farthest(part[..., :3]) for part in parts])
    turns = np.abs(groups[..., 3:]).sum(axis=1).max(axis=1)  # each axis has its own worst signs
    return np.stack([farthest, turns], axis=1)


def _farthest(ways: np.ndarray) -> np.ndarray:
    """Return the length, (N,), of the sum of G vectors (N, G, 3) with the signs that make the sum longest."""
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
