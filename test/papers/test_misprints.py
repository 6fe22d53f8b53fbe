"""The misprints of Song, Mou and King: each formula as printed and corrected, on the poses of their Table 1.

The corrected formulas close the loops of the paper's own drawing (its Figure 3) to rounding, and give its Table 2. The
errors of the printed formulas are the figures in section 21 of doc/theory.md.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from helpers import table_lengths
from scipy.spatial.transform import Rotation

from examples.papers.comparing import table
from examples.papers.misprints import (
    CORRECTIONS,
    MISPRINTS,
    A,
    B,
    D,
    base_joints,
    cases,
    distances,
    equations_with_2,
    printed_angles,
    second_equation,
)

ROOT = Path(__file__).resolve().parents[2]
CASES = cases()
ROUNDING = 1e-11  # mm or degrees: about a hundred roundings of squares of 600 mm, divided by lengths of 300 mm
# The texts in section 21, with other figures of it that a test below computes
IN_THE_TEXT = {
    "Y_p2": "off by 172 mm",
    "Y_T3": "off by 595 mm",
    "second combined equation": "differ by 542 mm",
    "second combined equation, third misprint alone": "by 378 mm with the first two corrections",
    "Y′_T1": "off by 113 mm",
    "Y′_T2": "off by 50 mm",
    "Z′_T2": "off by 93 mm",
    "Z′_T": r"$+\frac12(Z'_{B,2i-1}+Z'_{B,2i})$",
    "α′": "off by 4.1°",
}


@pytest.fixture(scope="module")
def section() -> str:
    """Return section 21 of doc/theory.md."""
    text = (ROOT / "doc" / "theory.md").read_text(encoding="utf-8")
    return text.partition("## 21. Misprints")[2].partition("### The other two papers")[0]


def test_the_poses_are_the_papers_machine():
    """The drawing has an equilateral top of side a; the printed matrix is SciPy's; the lengths are Table 2's."""
    for at, printed in zip(CASES, table_lengths() * 1e3, strict=True):
        sides = np.linalg.norm(at.top - np.roll(at.top, 1, axis=0), axis=1)
        np.testing.assert_allclose(sides, A, rtol=0, atol=ROUNDING)
        alpha, beta, gamma = at.angles
        turned = Rotation.from_euler("YXZ", [beta, alpha, gamma], degrees=True).as_matrix()
        np.testing.assert_allclose(at.rotation, turned, rtol=0, atol=1e-15)
        np.testing.assert_allclose(at.lengths, printed, rtol=0, atol=5e-4)  # three digits are printed


@pytest.mark.parametrize("misprint", MISPRINTS, ids=lambda misprint: misprint.name)
def test_a_printed_formula_is_off_by_what_the_documentation_says_and_the_mended_one_is_exact(misprint, section: str):
    off, left = misprint.worst()
    assert left < (ROUNDING if misprint.unit in ("mm", "°") else 1e3 * ROUNDING)  # other units are µm
    assert off > 1.0
    words = IN_THE_TEXT.get(misprint.name, "")
    assert words in section
    if words.startswith(("off", "differ", "by")):
        figure = next(word.rstrip("°") for word in words.split() if word[0].isdigit())
        assert f"{off:.{len(figure.partition('.')[2])}f}" == figure


def test_every_mend_of_the_closure_is_needed():
    for missing in CORRECTIONS:
        left = [name for name in CORRECTIONS if name != missing]
        assert max(abs(second_equation(at, *left)) for at in CASES) > 40.0, missing  # mm
    for k in (0, 2):
        assert max(abs(equations_with_2(at, k)) for at in CASES) < ROUNDING


def test_base_joint_5_as_printed_breaks_the_hexagon_and_struts_5_and_6_do_not_meet_top_joint_2(section: str):
    right, printed = base_joints(), base_joints(B + D)
    sides = [np.linalg.norm(joints[i] - joints[i + 1]) for joints in (right, printed) for i in (3, 4)]
    np.testing.assert_allclose(sides[:2], [D, B], rtol=0, atol=ROUNDING)
    off = [abs(distances(at.top, printed)[4] - at.lengths[4]) for at in CASES]
    wrong = [distances(at.top[[0, 1, 1]], right)[4:] for at in CASES]
    nearest = min(np.abs(lengths - at.lengths[4:]).min() for lengths, at in zip(wrong, CASES, strict=True))
    computed = {
        "becomes 140.3 mm": f"becomes {sides[2]:.1f} mm",
        "697.0 instead": f"{sides[3]:.1f} instead",
        "59 to 70 mm": f"{min(off):.0f} to {max(off):.0f} mm",
        "576.3 and 709.8 mm": "{:.1f} and {:.1f} mm".format(*wrong[0]),
        "at least 28 mm": f"at least {np.floor(nearest):.0f} mm",
    }
    for words, found in computed.items():
        assert found == words
        assert words in section


def test_all_17_angles_of_table_3_to_the_last_digit_and_gamma_goes_into_beta(section: str):
    printed = [cell for row in table(3) for cell in row[:3]]
    tanh = np.array([printed_angles(at.top, np.tanh) for at in CASES]).ravel()
    right = np.array([at.angles for at in CASES]).ravel()
    assert np.count_nonzero(right) == 17
    for cell, value, angle in zip(printed, tanh, right, strict=True):
        assert not angle or f"{value:.6g}" == cell
    np.testing.assert_allclose([printed_angles(at.top) for at in CASES], right.reshape(10, 3), rtol=0, atol=ROUNDING)
    # With the right γ row 5 would have 9.99938, since about one axis tanh turns α into tanh(tan α)
    assert printed[13] == "9.99937"
    assert f"{np.degrees(np.tanh(np.tan(np.radians(10.0)))):.5f}" == "9.99938"
    assert "tanh in place of arctan" in section
    assert "9.99808°" in section
