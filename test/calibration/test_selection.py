"""Choice of blocks: evidence as a dense normal distribution has it; what few readings keep, and what they let go."""

from itertools import pairwise
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.stats import multivariate_normal

from hexapod_comp.calibration.estimator import Alike, DesignMatrix, LinearProblem, log_evidence, solve
from hexapod_comp.calibration.selection import log_bayes_factor, select

SIZES = {"structure": 3, "map": 12}
FOLDS, CELLS = 8, 3


def two_blocks() -> SimpleNamespace:
    """Return a space of a structure and a map, both of tolerance 1, as far as a linear problem asks it."""
    ends = np.cumsum([0, *SIZES.values()]).tolist()
    blocks = [SimpleNamespace(name=name, part=slice(a, b)) for name, (a, b) in zip(SIZES, pairwise(ends), strict=True)]
    return SimpleNamespace(
        blocks=blocks,
        parts=[block.part for block in blocks],
        spread=lambda tolerances: np.repeat(tolerances, list(SIZES.values())),
        start_tolerances=lambda: np.ones(len(SIZES)),
    )


def problem_of(rows: np.ndarray, target: np.ndarray) -> LinearProblem:
    """Return readings of one kind, as many to a fold."""
    count, every = len(target), np.arange(len(target))
    cells = DesignMatrix(rows.shape, [Alike(every, np.arange(rows.shape[1]), rows)])
    normal, moment = (rows.T @ rows)[None], (rows.T @ target)[None]
    one = np.array([float(count)])
    kind, fold = np.zeros(count, int), every // CELLS
    return LinearProblem(target, cells, kind, fold, normal, moment, np.array([target @ target]), one, 1e-3 * one)


def drawn(rng: np.random.Generator, size_of_map: float) -> LinearProblem:
    """Return readings of a drawn machine, of noise 0.3."""
    rows = rng.standard_normal((FOLDS * CELLS, sum(SIZES.values())))
    truth = rng.standard_normal(rows.shape[1]) * np.repeat([1.0, size_of_map], list(SIZES.values()))
    return problem_of(rows, rows @ truth + 0.3 * rng.standard_normal(len(rows)))


def test_evidence_is_that_of_the_readings_distribution() -> None:
    """Truth: scipy's normal density of covariance A·T²·Aᵀ + noise², to rounding; differences, since the density's
    constant is left out. With and without the map its ratio is what Savage and Dickey take from the posterior alone."""
    space, problem = two_blocks(), drawn(np.random.default_rng(2), 1.0)
    rows = problem.rows.dense()

    def both(tolerances: tuple[float, float], noise: float) -> tuple[float, float]:
        posterior = solve(space, problem, np.array(tolerances), np.array([noise]), rounds=0)
        covariance = (rows * np.repeat(tolerances, list(SIZES.values())) ** 2) @ rows.T + noise**2 * np.eye(len(rows))
        truth = multivariate_normal(np.zeros(len(rows)), covariance).logpdf(problem.target)
        return log_evidence(problem, posterior), float(truth)

    ours, dense = np.array([both((1.0, 0.5), 0.3), both((2.0, 0.0), 0.7), both((1.0, 0.0), 0.3)]).T
    np.testing.assert_allclose(np.diff(ours), np.diff(dense), rtol=1e-9)
    posterior = solve(space, problem, np.array([1.0, 0.5]), np.array([0.3]), rounds=0)
    assert log_bayes_factor(space, posterior, "map") == pytest.approx(dense[0] - dense[2], rel=1e-9)


def test_few_readings_keep_what_is_there_and_let_go_what_is_not() -> None:
    """Eight folds of three readings, fifteen parameters: of 40 machines each, nine of ten with a map keep it.

    One of ten without may: two standard errors, from one side, let 2 % pass. The folds alone keep 31 of 40.
    """
    space, rng = two_blocks(), np.random.default_rng(4)

    def kept(size_of_map: float) -> bool:
        (decision,), _, _ = select(space, drawn(rng, size_of_map), np.ones(1), lambda text: None)
        return decision.kept

    assert sum(kept(1.0) for _ in range(40)) >= 36
    assert sum(kept(0.0) for _ in range(40)) <= 4
