"""ISO 230-2 figures: one test worked out by hand, formula by formula, and what must hold for every test.

No published example with readings and all figures could be quoted freely, so the numbers here are our own,
chosen so that a pencil is enough. All deviations of the example are in µm.
"""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from strategies import fixed, seeds

from hexapod_comp.errors import ModelError
from hexapod_comp.measurements.iso230 import PositioningTest, evaluate, report

TARGETS = np.array([0.004, 0.103, 0.196, 0.305, 0.398, 0.501])  # Six targets, m, unevenly spaced

# Five readings of which two lie c below a mean, one on it, two c above it: their mean is that mean, and
# s² = (c² + c² + 0 + c² + c²)/(5 − 1) = c², so s = c. Which cycle has which differs from target to target.
#
#   target            1     2     3     4     5     6
#   mean ↑            0     2     5     3    −1     1
#   c = s ↑          0.5    1     1    0.5    2    0.5
#   mean ↓            3     4     9     8     1     4
#   c = s ↓          0.5    1    0.5   1.5  0.25   0.5
#
UP = np.array(
    [
        # cycle 1, 2, …: one row each
        [-0.5, 3.0, 5.0, 3.5, -3.0, 0.5],
        [0.5, 1.0, 4.0, 2.5, 1.0, 1.5],
        [0.0, 2.0, 6.0, 3.0, -1.0, 1.0],
        [-0.5, 1.0, 4.0, 3.5, -3.0, 1.5],
        [0.5, 3.0, 6.0, 2.5, 1.0, 0.5],
    ]
)
DOWN = np.array(
    [
        [3.5, 4.0, 8.5, 6.5, 0.75, 4.0],
        [2.5, 5.0, 9.5, 9.5, 1.25, 3.5],
        [3.0, 3.0, 9.0, 8.0, 0.75, 4.5],
        [2.5, 5.0, 8.5, 6.5, 1.25, 3.5],
        [3.5, 3.0, 9.5, 9.5, 1.0, 4.5],
    ]
)
MICROMETRE = 1e-6

EXACT = {"abs": 1e-18}  # The numbers are exact in decimal; what is left is rounding of 10 µm


@pytest.fixture(scope="module")
def example() -> PositioningTest:
    return evaluate(TARGETS, np.array([UP, DOWN]) * MICROMETRE)


def um(*values: float) -> object:
    """Return what figures in m must be near to, from µm."""
    return pytest.approx([v * MICROMETRE for v in values], **EXACT)


# One figure at a time, each with its arithmetic.


def test_figures_of_each_target(example: PositioningTest) -> None:
    """Target 5 ↑: (−3 + 1 − 1 − 3 + 1)/5 = −1; from it −2, 2, 0, −2, 2, and (4 + 4 + 0 + 4 + 4)/4 = 4: s is 2.

    Repeatability: four times s; and the largest of 2s↑ + 2s↓ + |B|, R↑, R↓ at each target.
    1: 1 + 1 + 3 = 5.    2: 2 + 2 + 2 = 6.      3: 2 + 1 + 4 = 7.
    4: 1 + 3 + 5 = 9.    5: 4 + 0.5 + 2 = 6.5, less than R↑ = 8: 8.    6: 1 + 1 + 3 = 5.
    """
    assert example.mean[0].tolist() == um(0, 2, 5, 3, -1, 1)
    assert example.mean[1].tolist() == um(3, 4, 9, 8, 1, 4)
    assert example.standard_deviation[0].tolist() == um(0.5, 1, 1, 0.5, 2, 0.5)
    assert example.standard_deviation[1].tolist() == um(0.5, 1, 0.5, 1.5, 0.25, 0.5)
    assert example.reversal.tolist() == um(-3, -2, -4, -5, -2, -3)
    assert example.repeatability[0].tolist() == um(2, 4, 4, 2, 8, 2)
    assert example.repeatability[1].tolist() == um(2, 4, 2, 6, 1, 2)
    assert example.repeatability[2].tolist() == um(5, 6, 7, 9, 8, 5)
    assert (example.notes, example.cycles) == ((), 5)


def test_figures_by_symbol(example: PositioningTest) -> None:
    """E: means ↑ from −1 to 5, ↓ from 1 to 9, together from −1 to 9. R: the largest. B̄: −(3 + 2 + 4 + 5 + 2 + 3)/6.

    A, mean ± 2s: ↑ −1…1, 0…4, 3…7, 2…4, −5…3, 0…2: from −5 to 7; ↓ 2…4, 2…6, 8…10, 5…11, 0.5…1.5, 3…5: from 0.5 to 11.
    M, of the mean of both directions, 1.5, 3, 7, 5.5, 0, 2.5: 7 − 0.
    """
    expected = {"A": 16, "A_up": 12, "A_down": 10.5, "E": 10, "E_up": 6, "E_down": 8}
    expected |= {"R": 9, "R_up": 8, "R_down": 6, "M": 7, "B": 5, "B_mean": -19 / 6}
    assert example.figures == pytest.approx({k: v * MICROMETRE for k, v in expected.items()}, **EXACT)


# What holds for every test. Figures of up to 100 µm in double precision: 1e-18 m is a hundred roundings.


def drawn(seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Return targets and deviations of a test with systematic, reversing and random parts."""
    rng = np.random.default_rng(seed)
    cycles, count = rng.integers(2, 7), rng.integers(1, 12)
    systematic, reversal = rng.normal(0.0, 10e-6, count), rng.normal(0.0, 3e-6, count)
    noise = rng.normal(0.0, 2e-6, (2, cycles, count)) * rng.uniform(0.0, 2.0, (2, 1, count))
    return np.sort(rng.uniform(0.0, 0.5, count)), systematic + noise + np.array([[reversal], [-reversal]]) / 2.0


def same(figures: dict[str, float], scale: float = 1.0) -> object:
    return pytest.approx({name: scale * value for name, value in figures.items()}, abs=1e-18)


@fixed
@given(seeds, st.floats(-1e-4, 1e-4))
def test_a_shift_of_the_zero_moves_the_means_alone(seed: int, shift: float) -> None:
    targets, deviations = drawn(seed)
    before, after = evaluate(targets, deviations), evaluate(targets, deviations + shift)
    assert after.figures == same(before.figures)
    assert after.mean[0] == pytest.approx(before.mean[0] + shift, abs=1e-18)


@fixed
@given(seeds)
def test_order_of_cycles_and_targets_does_not_matter(seed: int) -> None:
    targets, deviations = drawn(seed)
    rng = np.random.default_rng(seed)
    targets_too = rng.permutation(len(targets))
    shuffled = rng.permuted(deviations, axis=1)[:, :, targets_too]
    assert evaluate(targets[targets_too], shuffled).figures == same(evaluate(targets, deviations).figures)


@fixed
@given(seeds)
def test_seen_from_the_other_end(seed: int) -> None:
    """With the axis pointing the other way, up is down and deviations change sign; the machine is the same."""
    targets, deviations = drawn(seed)
    figures = evaluate(targets, deviations).figures
    swapped = {"_up": "_down", "_down": "_up"}
    expected = {name[0] + swapped.get(name[1:], name[1:]): value for name, value in figures.items()}
    assert evaluate(-targets, -deviations[::-1]).figures == same(expected)


@fixed
@given(seeds)
def test_intervals_contain_each_other(seed: int) -> None:
    """A figure that looks at more cannot be smaller; and R at a target is what its two intervals span together."""
    test, rounding = evaluate(*drawn(seed)), 1e-18
    f = test.figures
    assert f["A"] + rounding >= max(f["A_up"], f["A_down"], f["R"])
    assert f["A"] + rounding >= f["E"] >= f["M"] - rounding
    assert f["R"] + rounding >= f["B"] >= abs(f["B_mean"]) - rounding
    edges = np.concatenate([test.mean + way * test.standard_deviation for way in (-2.0, 2.0)])
    assert test.repeatability[2] == pytest.approx(np.ptp(edges, axis=0), abs=rounding)


# Notes: what departs from the standard is said, not refused.


def notes(targets: object, deviations: np.ndarray) -> str:
    return "; ".join(evaluate(targets, deviations).notes)


def test_notes_on_the_plan() -> None:
    """The standard: five cycles, five targets per metre and at least five, travels to 2 m, uneven spacing."""
    deviations = np.array([UP, DOWN]) * MICROMETRE
    assert "2 cycles; the standard asks for 5" in notes(TARGETS, deviations[:, :2])
    assert "4 targets over 301 mm; the standard asks for 5" in notes(TARGETS[:4], deviations[:, :, :4])
    assert "6 targets over 1988 mm; the standard asks for 10" in notes(4 * TARGETS, deviations)
    assert "travel of 2.485 m" in notes(5 * TARGETS, deviations)
    assert "targets every 25.4 mm" in notes(0.0254 * np.arange(6), deviations)


def test_swapped_directions_are_flagged() -> None:
    """Play makes Bᵢ negative; the same readings with the directions exchanged are noticed.

    A reversal of +0.1 µm at every target is chance, where the mean of six has a standard error of
    √(2·6.75/5)/6 = 0.27 µm.
    """
    assert "swapped" in notes(TARGETS, np.array([DOWN, UP]) * MICROMETRE)
    assert "swapped" not in notes(TARGETS, np.array([UP, UP - 0.1]) * MICROMETRE)
    assert "swapped" in notes(TARGETS, np.array([np.ones((5, 6)), np.zeros((5, 6))]) * MICROMETRE)


# Refused: what cannot be computed.


@pytest.mark.parametrize(
    ("targets", "deviations", "says"),
    [
        (TARGETS, np.zeros((2, 1, 6)), "at least two cycles"),
        (TARGETS, np.zeros((2, 5, 5)), "2 directions, cycles, 6 targets"),
        (TARGETS, np.zeros((5, 6)), "2 directions, cycles, 6 targets"),
        (TARGETS, [[[0.0] * 6] * 5, [[0.0] * 5] * 5], "same number of readings"),
        ([0.0, 0.1, 0.1], np.zeros((2, 5, 3)), r"may be there once \(found 0.1\)"),
        ([0.0, np.nan], np.zeros((2, 5, 2)), "targets: must be a list of finite"),
        ([], np.zeros((2, 5, 0)), "targets: must be a list of finite"),
    ],
)
def test_what_cannot_be_computed_is_refused(targets, deviations, says: str) -> None:
    with pytest.raises(ModelError, match=says):
        evaluate(targets, deviations)


def test_a_missing_reading_is_named() -> None:
    deviations = np.array([UP, DOWN]) * MICROMETRE
    deviations[1, 2, 3] = np.nan
    with pytest.raises(ModelError, match="deviations, down, cycle 3, target 4: must be a finite number"):
        evaluate(TARGETS, deviations)


def test_report(example: PositioningTest) -> None:
    """Truth: the figures worked out above, in µm, line by line; widths in characters, not bytes."""
    lines = report(example).splitlines()
    assert lines[0] == "ISO 230-2:2014: 6 targets over 497 mm, 5 cycles ↑↓; µm"
    table = [line.split() for line in lines[3:9]]
    assert table[3] == ["305.0000", "3.000", "8.000", "0.500", "1.500", "2.000", "6.000", "-5.000", "9.000"]
    assert [line.split()[-3:] for line in lines[11:14]] == [
        ["16.000", "12.000", "10.500"],
        ["10.000", "6.000", "8.000"],
        ["9.000", "8.000", "6.000"],
    ]
    assert [line.split()[-1] for line in lines[14:17]] == ["7.000", "5.000", "-3.167"]
    assert "note" not in report(example)
