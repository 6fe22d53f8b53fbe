"""Rows kept in parts against the same matrix kept whole: NumPy's products, to rounding."""

import numpy as np
import pytest

from hexapod_comp.calibration.estimator import Alike, DesignMatrix
from hexapod_comp.calibration.observations import Zeros

SHAPE = (40, 12)


@pytest.fixture
def rows() -> DesignMatrix:
    """Three parts of cells that are mixed up, moved by parameters of which some are common."""
    rng = np.random.default_rng(1)
    cells = np.split(rng.permutation(SHAPE[0]), [15, 27])
    columns = (np.arange(7), np.array([0, 1, 5, 9]), np.array([2, 10, 11]))
    return DesignMatrix(
        SHAPE, [Alike(c, k, rng.standard_normal((len(c), len(k)))) for c, k in zip(cells, columns, strict=True)]
    )


def close(ours: np.ndarray, wanted: np.ndarray) -> None:
    """Compare sums of forty products of numbers near one."""
    np.testing.assert_allclose(ours, wanted, rtol=0.0, atol=1e-12)


def test_products(rows: DesignMatrix):
    rng, whole = np.random.default_rng(2), rows.dense()
    y, v = rng.standard_normal((12, 3)), rng.standard_normal((40, 3))
    close(rows.times(y), whole @ y)
    close(rows.times(y[:, 0]), whole @ y[:, 0])
    close(rows.transposed_times(v), whole.T @ v)
    close(DesignMatrix.of(whole).times(y), whole @ y)


def test_pairs_of_any_parts(rows: DesignMatrix):
    rng, whole = np.random.default_rng(3), rows.dense()
    matrix, first, second = rng.standard_normal((12, 12)), *rng.integers(0, 40, (2, 60))
    close(rows.between(matrix, first, second), np.diag(whole[first] @ matrix @ whole[second].T))


def test_some_cells_and_some_parameters(rows: DesignMatrix):
    whole, cells, used = rows.dense(), np.random.default_rng(4).permutation(40)[:17], np.array([0, 2, 5, 6, 10])
    close(rows.select(cells).dense(), whole[cells])
    factors = np.linspace(0.5, 2.0, 40)
    close(rows.using(used, factors).dense(), factors[:, None] * whole[:, used])
    close(rows.using(used, factors, factors[:5]).dense(), factors[:, None] * whole[:, used] * factors[:5])
    close(rows.select(cells).using(used, factors[cells]).dense(), (factors[:, None] * whole)[np.ix_(cells, used)])


def test_further_columns(rows: DesignMatrix):
    columns = np.random.default_rng(6).standard_normal((40, 2))
    close(rows.beside(columns).dense(), np.hstack([rows.dense(), columns]))


def test_a_zero_is_taken_off_the_cells_of_its_part_alone(rows: DesignMatrix):
    """What is left of cells of equal noise is what their mean leaves."""
    wanted, members = rows.dense(), np.sort(rows.parts[1].cells[3:9])
    rows.project_out(Zeros([members], np.full(40, np.nan)).unknowns(np.ones(40)))
    wanted[members] -= wanted[members].mean(axis=0)
    close(rows.dense(), wanted)
