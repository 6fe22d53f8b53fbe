"""The error field of 001: weights, polynomials, directions, and what happens outside the measured box."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from strategies import UNEVEN_GRID, fixed, random_field, seeds

from hexapod_comp.errors import ModelError
from hexapod_comp.machine.field import CROSS_AXES, GridField

FORWARD = np.ones(3)


def empty_lines(grid):
    """Return three families that were not measured."""
    return [np.zeros((2, len(grid[a]), len(grid[b]), 6, 0)) for a, b in CROSS_AXES]


def inside(rng):
    """Return a point of the uneven grid's box."""
    return np.array([rng.uniform(nodes[0], nodes[-1]) for nodes in UNEVEN_GRID])


# One cell, x from −100 to 100 mm, y from 0 to 100 mm, z from 0 to 200 mm, in micrometres.
CELL = (np.array([-0.1, 0.1]), np.array([0.0, 0.1]), np.array([0.0, 0.2]))
ALONG_X = {(0, 0): [1, 2, 0], (0, 1): [3, 0, 0], (1, 0): [5, -4, 8], (1, 1): [7, 1, 0]}
ALONG_Y = {(0, 0): [2, 0, 0], (0, 1): [4, 10, 0], (1, 0): [0, 0, 0], (1, 1): [8, 0, 0]}
ALONG_Z = {(0, 0): [1, 0, 4], (0, 1): [0, 0, 0], (1, 0): [6, 2, 0], (1, 1): [10, 0, 0]}


def test_hand_worked_cell():
    """At (25, 30, 50) mm. Truth: worked by hand from 001, W_xi and Δx; every number is below.

    u = 25/100 = 0.25, v = 2·30/100 − 1 = −0.4, w = 2·50/200 − 1 = −0.5; shares of the way through the cell:
    x 125/200 = 0.625, y 0.3, z 0.25.

    dx: lines at (y, z) low-low, low-high, high-low, high-high are worth 1.5, 3, 5 − 1 + 0.5 = 4.5, 7.25 and
        weigh 0.7·0.75 = 0.525, 0.7·0.25 = 0.175, 0.3·0.75 = 0.225, 0.3·0.25 = 0.075:
        0.7875 + 0.525 + 1.0125 + 0.54375 = 2.86875.
    dy: (x, z): 2, 4 − 4 = 0, 0, 8 weigh 0.375·0.75 = 0.28125, 0.09375, 0.46875, 0.625·0.25 = 0.15625:
        0.5625 + 0 + 0 + 1.25 = 1.8125.
    dz: (x, y): 1 + 4·0.25 = 2, 0, 6 − 1 = 5, 10 weigh 0.375·0.7 = 0.2625, 0.1125, 0.4375, 0.1875:
        0.525 + 0 + 2.1875 + 1.875 = 4.5875.
    Tolerance: a few roundings of 1e-16 relative.
    """
    lines = [np.zeros((2, 2, 2, 6, 3)) for _ in range(3)]
    for component, worked in enumerate((ALONG_X, ALONG_Y, ALONG_Z)):
        for (first, second), coefficients in worked.items():
            lines[component][:, first, second, component] = np.array(coefficients) * 1e-6
    error, outside = GridField(CELL, tuple(lines)).evaluate([0.025, 0.030, 0.050], FORWARD)
    np.testing.assert_allclose(error[:3], [2.86875e-6, 1.8125e-6, 4.5875e-6], rtol=1e-14)
    assert not error[3:].any()
    assert outside is False


def paper_weights(p, q, corners):
    """Return W_1 … W_4 of 001 for the point (p, q): the corner opposite to i is k = Mod(i + 2).

    The denominators |P_1 − P_4| and |P_1 − P_2| say how the corners are numbered: 1 → 2 along the second
    axis, 1 → 4 along the first.
    """
    area = abs(corners[1][0] - corners[4][0]) * abs(corners[1][1] - corners[2][1])
    opposite = {1: 3, 2: 4, 3: 1, 4: 2}
    return {i: abs(p - corners[k][0]) * abs(q - corners[k][1]) / area for i, k in opposite.items()}


@fixed
@given(seeds, st.booleans())
def test_equals_the_papers_formula(seed, on_a_line):
    """Truth: 001, W_xi, W_yi, W_zi and Δx, Δy, Δz, written out here over the four corners; np.polyval.

    The paper's lines carry one component each, here they carry six; the three families add up. On a grid line only
    that line weighs, whichever cell is asked. Tolerance: 1e-14 of some 1e-4.
    """
    rng = np.random.default_rng(seed)
    field = random_field(rng)
    point, sense = inside(rng), rng.choice([-1.0, 1.0], 3)
    if on_a_line:
        for axis in CROSS_AXES[rng.integers(3)]:
            point[axis] = rng.choice(UNEVEN_GRID[axis])
    truth = np.zeros(6)
    for axis, (a, b) in enumerate(CROSS_AXES):
        i = max(int(np.searchsorted(UNEVEN_GRID[a], point[a])) - 1, 0)
        j = max(int(np.searchsorted(UNEVEN_GRID[b], point[b])) - 1, 0)
        at = {1: (i, j), 2: (i, j + 1), 3: (i + 1, j + 1), 4: (i + 1, j)}
        corners = {n: (UNEVEN_GRID[a][m], UNEVEN_GRID[b][k]) for n, (m, k) in at.items()}
        middle = (UNEVEN_GRID[axis][0] + UNEVEN_GRID[axis][-1]) / 2
        u = (point[axis] - middle) / (UNEVEN_GRID[axis][-1] - middle)
        weights = paper_weights(point[a], point[b], corners)
        for n, (m, k) in at.items():
            truth += weights[n] * np.polyval(field.lines[axis][0 if sense[axis] > 0 else 1, m, k, :, ::-1].T, u)
    error, outside = field.evaluate(point, sense)
    np.testing.assert_allclose(error, truth, atol=1e-18)
    assert not outside


def test_directions():
    """Truth: constants. Forward 1, 2, 4 µm along x, y, z, backward ten times that; unknown is the mean.

    Every axis goes by its own direction of motion.
    """
    lines = [np.zeros((2, len(UNEVEN_GRID[a]), len(UNEVEN_GRID[b]), 6, 1)) for a, b in CROSS_AXES]
    for axis, size in enumerate((1e-6, 2e-6, 4e-6)):
        lines[axis][0, :, :, axis], lines[axis][1, :, :, axis] = size, 10 * size
    field = GridField(UNEVEN_GRID, tuple(lines))
    for sense, truth in {
        (1, 1, 1): (1, 2, 4),
        (-1, -1, -1): (10, 20, 40),
        (0, 0, 0): (5.5, 11, 22),
        (1, -1, 0): (1, 20, 22),
    }.items():
        error, _ = field.evaluate([0.0, 0.0, 0.4], sense)
        np.testing.assert_allclose(error[:3] * 1e6, truth, rtol=1e-14)


@fixed
@given(seeds)
def test_outside_holds_the_boundary_value_and_says_so(seed):
    """Truth: the value at the nearest point of the box, bit for bit."""
    rng = np.random.default_rng(seed)
    field = random_field(rng)
    low, high = field.box
    beyond = inside(rng)
    axis, upwards = rng.integers(3), rng.integers(2)
    beyond[axis] = (low, high)[upwards][axis] + (2 * upwards - 1) * rng.uniform(1e-9, 10.0)
    assert np.isnan(field.evaluate([0.0, np.nan, 0.4], FORWARD)[0]).all()
    held, outside = field.evaluate(beyond, FORWARD)
    on_boundary, still_inside = field.evaluate(np.clip(beyond, low, high), FORWARD)
    assert outside is True
    assert still_inside is False
    np.testing.assert_array_equal(held, on_boundary)


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_continuous_across_the_boundary_and_the_nodes(axis):
    """Truth: the step over 1 nm may be no more than the field's slope allows.

    A line is worth at most 4·20 µm, so two neighbours differ by at most 160 µm over the narrowest cell of
    30 mm, and three families add up: 1 nm · 3 · 160 µm/30 mm = 2e-11. A jump to wrong lines would be 1e-5.
    """
    rng = np.random.default_rng(4)
    field = random_field(rng)
    for node in UNEVEN_GRID[axis]:
        for _ in range(20):
            point = inside(rng)
            before, after = point.copy(), point.copy()
            before[axis], after[axis] = node - 5e-10, node + 5e-10
            step = field.evaluate(after, FORWARD)[0] - field.evaluate(before, FORWARD)[0]
            assert np.abs(step).max() < 1e-10


def _family(values, axis):
    """Return families of zeros but one, which is as given."""
    return [values if a == axis else lines for a, lines in enumerate(empty_lines(UNEVEN_GRID))]


@pytest.mark.parametrize(
    ("axis", "nodes", "lines", "key"),
    [
        (0, UNEVEN_GRID[0], _family(np.full((2, 4, 3, 6, 1), np.nan), 1), "field.lines_y"),
        (0, UNEVEN_GRID[0], _family(np.zeros((2, len(UNEVEN_GRID[1]) + 1, 3, 6, 1)), 0), "field.lines_x"),
        (0, UNEVEN_GRID[0][:1], empty_lines(UNEVEN_GRID), "field.grid_x"),
        (2, UNEVEN_GRID[2][::-1], empty_lines(UNEVEN_GRID), "field.grid_z"),
        (1, UNEVEN_GRID[1][[0, 1, 1]], empty_lines(UNEVEN_GRID), "field.grid_y"),
        (0, np.array([-np.inf, 0.0, 0.1, 0.2]), empty_lines(UNEVEN_GRID), "field.grid_x"),
    ],
)
def test_refuses_what_is_no_field(axis, nodes, lines, key):
    grid = [nodes if a == axis else given for a, given in enumerate(UNEVEN_GRID)]
    with pytest.raises(ModelError, match=key):
        GridField(tuple(grid), tuple(lines))
    for change in ({"probe": [0, 0]}, {"probe": [0, np.nan, 0]}, {"outside": "guess"}):
        with pytest.raises(ModelError, match=f"field.{next(iter(change))}"):
            GridField(UNEVEN_GRID, tuple(empty_lines(UNEVEN_GRID)), **change)
