"""The misprints of Song, Mou and King: each formula as printed and as mended, on the poses of their Table 1.

Truth: the paper's own drawing (its Figure 3) and its Table 2, by NumPy alone; nothing of the package is asked. The
figures that come of the printed formulas are the ones that stand in section 21 of doc/theory.md.
"""

from __future__ import annotations

import csv
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest

ROOT = Path(__file__).resolve().parents[2]
A, B, D = 300.0, 572.0, 243.0  # mm: side of the platform's triangle, long and short sides of the base
S3 = np.sqrt(3.0)
TOP = np.array([[np.cos(angle), np.sin(angle), 0.0] for angle in np.radians([60.0, 180.0, -60.0])]) * A / S3
ROUNDING = 1e-11  # mm or degrees: some hundred roundings of squares of 600 mm, divided by lengths of 300 mm
MENDED = ("Xp3", "4", "Yp3")  # what the second of the three combined equations needs


class Case(NamedTuple):
    """A pose of Table 1: angles, degrees; top joints and what the paper calls L, p, h, X_p, Y_p, mm."""

    angles: np.ndarray
    top: np.ndarray
    lengths: np.ndarray
    p: np.ndarray
    h: np.ndarray
    xp: np.ndarray
    yp: np.ndarray


def base_joints(b5: float = B - D) -> np.ndarray:
    """Return the base joints, mm; `b5` is the bracket in X_B5."""
    x = S3 / 6.0 * np.array([2 * B + D, -(B - D), -(B + 2 * D), -(B + 2 * D), -b5, 2 * B + D])
    return np.column_stack([x, np.array([D, B + D, B, -B, -(B + D), -D]) / 2.0, np.zeros(6)])


def rotation(alpha: float, beta: float, gamma: float) -> np.ndarray:
    """Return Ry(β)·Rx(α)·Rz(γ), angles in degrees."""
    (ca, cb, cg), (sa, sb, sg) = (f(np.radians([alpha, beta, gamma])) for f in (np.cos, np.sin))
    about_y = np.array([[cb, 0, sb], [0, 1, 0], [-sb, 0, cb]])
    about_x = np.array([[1, 0, 0], [0, ca, -sa], [0, sa, ca]])
    return about_y @ about_x @ np.array([[cg, -sg, 0], [sg, cg, 0], [0, 0, 1]])


def distances(top: np.ndarray, base: np.ndarray) -> np.ndarray:
    return np.linalg.norm(np.repeat(top, 2, axis=0) - base, axis=1)


def case(angles: list[float], position: list[float]) -> Case:
    top = np.array(position) + TOP @ rotation(*angles).T
    lengths = distances(top, base_joints())
    p = (B**2 + lengths[::2] ** 2 - lengths[1::2] ** 2) / (2 * B)
    xp = S3 / 6.0 * np.array([2 * B + D - 3 * p[0], -(B + 2 * D), -(B - D - 3 * p[2])])
    yp = np.array([D + p[0], B - 2 * p[1], -(B + D - p[2])]) / 2.0
    return Case(np.array(angles), top, lengths, p, np.sqrt(lengths[::2] ** 2 - p**2), xp, yp)


def column(row: dict[str, str], *names: str) -> list[float]:
    return [float(row[name]) for name in names]


ANGLES, POSITION = ("alpha_deg", "beta_deg", "gamma_deg"), ("x_mm", "y_mm", "z_mm")
with open(ROOT / "config" / "table1.csv", encoding="utf-8") as stream:
    CASES = [case(column(row, *ANGLES), column(row, *POSITION)) for row in csv.DictReader(stream)]
TABLE_2_POSE_1 = (509.192, 509.192, 509.192, 509.192, 509.192, 509.192)  # mm, as the paper prints them


def second_equation(at: Case, *mends: str) -> float:
    """Return what the second combined equation (joints 1 and 3) leaves, divided by a: mm."""
    x, xp, yp, h2 = at.top[:, 0], at.xp, at.yp, at.h**2
    subtracted = xp[2] if "Xp3" in mends else xp[0]
    other = yp[2] if "Yp3" in mends else yp[1]
    factor = 4.0 if "4" in mends else 1.0
    root = np.sqrt((h2[0] - 4 * (x[0] - xp[0]) ** 2) * (h2[2] - factor * (x[2] - xp[2]) ** 2))
    linear = 2 * x[0] * (xp[0] - 3 * subtracted + S3 * (yp[0] - other))
    linear += 2 * x[2] * (-3 * xp[0] + xp[2] + S3 * (yp[0] - yp[2]))
    square = (S3 * (xp[0] + xp[2]) - yp[0] + yp[2]) ** 2 + h2[0] + h2[2] - 4 * xp[0] ** 2 - 4 * xp[2] ** 2
    return float(A**2 - 4 * x[0] * x[2] - linear - square + 2 * root) / A


def equations_with_2(at: Case, k: int) -> float:
    """Return what the first (joints 1 and 2, k = 0) or third (3 and 2, k = 2) leaves as printed: mm."""
    x, xp, yp, h2 = at.top[:, 0], at.xp, at.yp, at.h**2
    across = yp[0] - yp[1] if k == 0 else yp[1] - yp[2]
    root = np.sqrt((h2[k] - 4 * (x[k] - xp[k]) ** 2) * (h2[1] - (x[1] - xp[1]) ** 2))
    linear = 2 * x[k] * (xp[k] + S3 * across) + 2 * xp[1] * x[1]
    square = (S3 * xp[k] - across) ** 2 + h2[k] + h2[1] - 4 * xp[k] ** 2 - xp[1] ** 2
    return float(A**2 + 2 * x[k] * x[1] - linear - square + 2 * root) / A


def printed_yp2(at: Case) -> float:
    return (D - 2 * at.p[0]) / 2.0


def alpha(at: Case, sign: float) -> float:
    """Return α' less the pose's α, degrees; `sign` is that of X'_T3 (Z'_T1 − Z'_T2)."""
    (x1, x2, x3), (y1, y2, y3), (z1, z2, z3) = at.top.T
    gamma = np.radians(at.angles[2])
    over = -2 * (x1 * (z3 - z2) + x2 * (z1 - z3) + sign * x3 * (z1 - z2))
    under = A * (y1 - 2 * y2 + y3) * np.sin(gamma) + S3 * A * (y1 - y3) * np.cos(gamma)
    return float(np.degrees(np.arctan(over / under))) - at.angles[0]


def y_t1(at: Case, sign: float) -> float:
    return S3 * at.top[0, 0] + sign / B * (at.lengths[0] ** 2 - at.lengths[1] ** 2) - at.top[0, 1]


def y_t2(at: Case, sign: float) -> float:
    return sign / (2 * B) * (at.lengths[3] ** 2 - at.lengths[2] ** 2) - at.top[1, 1]


def y_t3(at: Case, sign: float) -> float:
    return -S3 * at.top[2, 0] + sign * (S3 * at.xp[2] + sign * at.yp[2]) - at.top[2, 1]


def z_t2(at: Case, factor: float) -> float:
    return np.sqrt(at.h[1] ** 2 - factor * (at.top[1, 0] - at.xp[1]) ** 2) - at.top[1, 2]


# How far off the printed form is at a pose; how far the mended one is; how section 21 says it.
MISPRINTS = {
    "Y_p2": (lambda at: printed_yp2(at) - at.top[1, 1], lambda at: at.yp[1] - at.top[1, 1], "off by 172 mm"),
    "Y_T3": (lambda at: y_t3(at, -1.0), lambda at: y_t3(at, 1.0), "off by 595 mm"),
    "closure": (second_equation, lambda at: second_equation(at, *MENDED), "residual of 542 mm"),
    "closure, without (Y_p1 − Y_p3)": (
        lambda at: second_equation(at, "Xp3", "4"),
        lambda at: second_equation(at, *MENDED),
        "without the last mend 378 mm",
    ),
    "Y'_T1": (lambda at: y_t1(at, -1.0), lambda at: y_t1(at, 1.0), "off by 113 mm"),
    "Y'_T2": (lambda at: y_t2(at, -1.0), lambda at: y_t2(at, 1.0), "off by 50 mm"),
    "Z'_T2": (lambda at: z_t2(at, 4.0), lambda at: z_t2(at, 1.0), "off by 93 mm"),
    "α'": (lambda at: alpha(at, 1.0), lambda at: alpha(at, -1.0), "off by 4.1°"),
}


@pytest.fixture(scope="module")
def section() -> str:
    """Return section 21 of doc/theory.md."""
    text = (ROOT / "doc" / "theory.md").read_text(encoding="utf-8")
    return text.partition("## 21. Misprints")[2].partition("### The other two papers")[0]


@pytest.mark.parametrize("name", MISPRINTS)
def test_a_printed_formula_is_off_by_what_the_documentation_says_and_the_mended_one_is_exact(name: str, section: str):
    printed, mended, words = MISPRINTS[name]
    figure = next(word.rstrip("°") for word in words.split() if word[0].isdigit())
    worst = max(abs(printed(at)) for at in CASES)
    assert f"{worst:.{len(figure.partition('.')[2])}f}" == figure
    assert words in section
    assert max(abs(mended(at)) for at in CASES) < ROUNDING


def test_every_mend_of_the_closure_is_needed():
    for missing in MENDED:
        left = [name for name in MENDED if name != missing]
        assert max(abs(second_equation(at, *left)) for at in CASES) > 40.0, missing  # mm
    for k in (0, 2):
        assert max(abs(equations_with_2(at, k)) for at in CASES) < ROUNDING


def test_base_joint_5_as_printed_breaks_the_hexagon_and_table_2(section: str):
    right, printed = base_joints(), base_joints(B + D)
    sides = [np.linalg.norm(joints[i] - joints[i + 1]) for joints in (right, printed) for i in (3, 4)]
    np.testing.assert_allclose(sides[:2], [D, B], rtol=0, atol=ROUNDING)
    assert f"{sides[2]:.1f}" == "140.3"
    assert f"{sides[3]:.1f}" == "697.0"
    assert "becomes 140.3 mm" in section
    assert "697.0 instead" in section
    np.testing.assert_allclose(CASES[0].lengths, TABLE_2_POSE_1, rtol=0, atol=5e-4)  # three digits are printed
    off = [abs(distances(at.top, printed)[4] - at.lengths[4]) for at in CASES]
    assert f"{min(off):.0f} to {max(off):.0f} mm" == "59 to 70 mm"
    assert "59 to 70 mm" in section


def test_struts_5_and_6_do_not_meet_top_joint_2(section: str):
    wrong = [distances(at.top[[0, 1, 1]], base_joints())[4:] for at in CASES]
    assert "{:.1f} and {:.1f} mm".format(*wrong[0]) == "576.3 and 709.8 mm"
    assert "576.3 and 709.8 mm" in section
    nearest = min(np.abs(lengths - at.lengths[4:]).min() for lengths, at in zip(wrong, CASES, strict=True))
    assert 28.0 <= nearest < 29.0
    assert "nearer than 28 mm" in section


def test_heights_of_the_base_joints_are_lost_on_the_way_to_the_real_structure(section: str):
    """h' measures from the mean height of two base joints, Z'_T as printed does not go back to it."""
    lifted = base_joints()
    lifted[:, 2] = np.repeat([0.010, -0.004, 0.007], 2)  # mm
    heights = (lifted[::2, 2] + lifted[1::2, 2]) / 2.0
    for at in CASES:
        along, height = at.top - np.column_stack([at.xp, at.yp, heights]), at.top[:, 2]
        h = np.linalg.norm(along, axis=1)
        printed = np.sqrt(h**2 - np.array([4.0, 1.0, 4.0]) * along[:, 0] ** 2)  # with T_2's factor mended
        np.testing.assert_allclose(height - printed, heights, rtol=0, atol=ROUNDING)
    assert r"$+\frac12(Z'_{B,2i-1}+Z'_{B,2i})$" in section
