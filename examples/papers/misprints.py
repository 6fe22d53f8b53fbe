"""The misprints in the formulas of Song, Mou & King, as printed and as corrected, at the poses of the paper's Table 1.

The formulas are computed with NumPy from the paper's drawing (its Figure 3), in its symbols, mm and degrees, without
code of the package. A corrected formula is right if it closes the machine's kinematic loops.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import NamedTuple

import numpy as np

from .comparing import values

A, B, D = 300.0, 572.0, 243.0
"""Side of the platform's triangle, long side and short side of the base, mm; they follow from Table 2."""

S3 = np.sqrt(3.0)
TOP = np.array([[np.cos(angle), np.sin(angle), 0.0] for angle in np.radians([60.0, 180.0, -60.0])]) * A / S3

CORRECTIONS = ("Xp3", "4", "Yp3")  # The three corrections that the second combined equation needs

SIGNS = np.array([[1, 1, 1]] * 2 + [[-1, 1, 1]] + [[-1, -1, 1]] * 2 + [[1, -1, 1]], dtype=float)
"""Signs of δX_B, δY_B and δZ_B for each strut, as printed."""

DEVIATION = 0.01  # Error of a joint's coordinate for testing the formulas of the real structure, mm


class Case(NamedTuple):
    """A pose of Table 1: angles, °; rotation matrix; top joints and the paper's L, p, h, X_p and Y_p, mm."""

    angles: np.ndarray
    rotation: np.ndarray
    top: np.ndarray
    lengths: np.ndarray
    p: np.ndarray
    h: np.ndarray
    xp: np.ndarray
    yp: np.ndarray


class Misprint(NamedTuple):
    """A misprint: the affected part of a formula as printed and as corrected, and the error of both at a Case."""

    name: str
    printed: str
    corrected: str
    unit: str  # unit of the errors
    printed_error: Callable[[Case], float]
    corrected_error: Callable[[Case], float]

    def worst(self) -> tuple[float, float]:
        """Return the largest error over the ten poses of the printed form and of the corrected form."""
        forms = self.printed_error, self.corrected_error
        printed, corrected = (max(abs(float(form(at))) for at in cases()) for form in forms)
        return printed, corrected


def base_joints(b5: float = B - D) -> np.ndarray:
    """Return the base joints, mm; `b5` is the expression in brackets in X_B5."""
    x = S3 / 6.0 * np.array([2 * B + D, -(B - D), -(B + 2 * D), -(B + 2 * D), -b5, 2 * B + D])
    return np.column_stack([x, np.array([D, B + D, B, -B, -(B + D), -D]) / 2.0, np.zeros(6)])


def printed_rotation(alpha: float, beta: float, gamma: float) -> np.ndarray:
    """Return the rotation matrix with the entries that the paper prints; angles in degrees."""
    (ca, cb, cg), (sa, sb, sg) = (f(np.radians([alpha, beta, gamma])) for f in (np.cos, np.sin))
    return np.array(
        [
            [cb * cg + sa * sb * sg, -cb * sg + sa * sb * cg, ca * sb],
            [ca * sg, ca * cg, -sa],
            [-sb * cg + sa * cb * sg, sb * sg + sa * cb * cg, ca * cb],
        ]
    )


def distances(top: np.ndarray, base: np.ndarray) -> np.ndarray:
    """Return the six strut lengths between three top joints and six base joints, mm."""
    return np.linalg.norm(np.repeat(top, 2, axis=0) - base, axis=1)


@cache
def cases() -> tuple[Case, ...]:
    """Return the ten poses of Table 1."""
    return tuple(_case(row[:3], row[3:]) for row in values(1))


def _case(angles: np.ndarray, position: np.ndarray) -> Case:
    rotation = printed_rotation(*angles)
    top = position + TOP @ rotation.T
    lengths = distances(top, base_joints())
    p = (B**2 + lengths[::2] ** 2 - lengths[1::2] ** 2) / (2 * B)
    xp = S3 / 6.0 * np.array([2 * B + D - 3 * p[0], -(B + 2 * D), -(B - D - 3 * p[2])])
    yp = np.array([D + p[0], B - 2 * p[1], -(B + D - p[2])]) / 2.0
    return Case(angles, rotation, top, lengths, p, np.sqrt(lengths[::2] ** 2 - p**2), xp, yp)


def second_equation(at: Case, *corrections: str) -> float:
    """Return the residual of the second combined equation (joints 1 and 3), divided by a, mm."""
    x, xp, yp, h2 = at.top[:, 0], at.xp, at.yp, at.h**2
    subtracted = xp[2] if "Xp3" in corrections else xp[0]
    other = yp[2] if "Yp3" in corrections else yp[1]
    factor = 4.0 if "4" in corrections else 1.0
    root = np.sqrt((h2[0] - 4 * (x[0] - xp[0]) ** 2) * (h2[2] - factor * (x[2] - xp[2]) ** 2))
    linear = 2 * x[0] * (xp[0] - 3 * subtracted + S3 * (yp[0] - other))
    linear += 2 * x[2] * (-3 * xp[0] + xp[2] + S3 * (yp[0] - yp[2]))
    square = (S3 * (xp[0] + xp[2]) - yp[0] + yp[2]) ** 2 + h2[0] + h2[2] - 4 * xp[0] ** 2 - 4 * xp[2] ** 2
    return float(A**2 - 4 * x[0] * x[2] - linear - square + 2 * root) / A


def equations_with_2(at: Case, k: int) -> float:
    """Return the residual, divided by a, mm, of the first (joints 1, 2; k = 0) or third equation (3, 2; k = 2)."""
    x, xp, yp, h2 = at.top[:, 0], at.xp, at.yp, at.h**2
    across = yp[0] - yp[1] if k == 0 else yp[1] - yp[2]
    root = np.sqrt((h2[k] - 4 * (x[k] - xp[k]) ** 2) * (h2[1] - (x[1] - xp[1]) ** 2))
    linear = 2 * x[k] * (xp[k] + S3 * across) + 2 * xp[1] * x[1]
    square = (S3 * xp[k] - across) ** 2 + h2[k] + h2[1] - 4 * xp[k] ** 2 - xp[1] ** 2
    return float(A**2 + 2 * x[k] * x[1] - linear - square + 2 * root) / A


def fifth_length(at: Case, b5: float) -> float:
    """Return L_5, computed with `b5` in X_B5, minus the length that closes the loop, mm."""
    return float(distances(at.top, base_joints(b5))[4] - at.lengths[4])


def last_lengths(at: Case, joint: int) -> float:
    """Return the larger error of L'_5 and L'_6, computed to top joint number `joint`, mm."""
    top = at.top[[0, 1, joint - 1]]
    return float(np.abs(distances(top, base_joints()) - at.lengths)[4:].max())


def base_errors(at: Case, signs: np.ndarray) -> float:
    """Return the largest strut length error, µm, if an error of a base joint is entered with the given signs."""
    right, entered = base_joints(), base_joints()
    worst = 0.0
    for axis in range(3):
        shift = DEVIATION * np.eye(3)[axis]
        off = distances(at.top, entered + signs[:, axis, None] * shift) - distances(at.top, right + shift)
        worst = max(worst, float(np.abs(off).max()))
    return worst * 1e3


def top_errors(at: Case, printed: bool) -> float:
    """Return the largest strut length error, µm, if an error of a top joint is entered as printed, or as corrected.

    The printed form multiplies a/√3 + 2δ by an expression in brackets, for one coordinate at a time.
    """
    brackets = (at.top - _position(at)) / (A / S3)
    worst = 0.0
    for axis in range(3):
        along = np.zeros((3, 3))
        along[:, axis] = 2.0 * DEVIATION * brackets[:, axis]
        right = DEVIATION * at.rotation[:, axis]
        entered = along if printed else np.tile(right, (3, 1))
        off = distances(at.top + entered, base_joints()) - distances(at.top + right, base_joints())
        worst = max(worst, float(np.abs(off).max()))
    return worst * 1e3


def _position(at: Case) -> np.ndarray:
    return at.top.mean(axis=0)


def y_t1(at: Case, sign: float) -> float:
    """Return Y'_T1 minus the joint's y, mm; `sign` is the sign of the last term of the formula of Y'_T1."""
    return float(S3 * at.top[0, 0] + sign / B * (at.lengths[0] ** 2 - at.lengths[1] ** 2) - at.top[0, 1])


def y_t2(at: Case, sign: float) -> float:
    """Return Y'_T2 minus the joint's y, mm; `sign` is the sign of the only term of the formula of Y'_T2."""
    return float(sign / (2 * B) * (at.lengths[3] ** 2 - at.lengths[2] ** 2) - at.top[1, 1])


def y_t3(at: Case, sign: float) -> float:
    """Return Y_T3 minus the joint's y, mm; `sign` is the sign of the term with X_p3 in the formula of Y_T3."""
    return float(-S3 * at.top[2, 0] + sign * (S3 * at.xp[2] + sign * at.yp[2]) - at.top[2, 1])


def z_t2(at: Case, factor: float) -> float:
    """Return Z'_T2 minus the joint's z, mm; `factor` is the factor under the root in the formula of Z'_T2."""
    return float(np.sqrt(at.h[1] ** 2 - factor * (at.top[1, 0] - at.xp[1]) ** 2) - at.top[1, 2])


def heights(at: Case, back: bool) -> float:
    """Return the largest error of Z'_T, µm, for base joints at heights of 10, −4 and 7 µm.

    h' is measured from the mean height of two base joints; the printed Z'_T omits this height (`back` adds it).
    """
    lifted = np.array([0.010, -0.004, 0.007])
    along = at.top - np.column_stack([at.xp, at.yp, lifted])
    heights = np.sqrt((along**2).sum(axis=1) - np.array([4.0, 1.0, 4.0]) * along[:, 0] ** 2)
    return float(np.abs(heights + (lifted if back else 0.0) - at.top[:, 2]).max() * 1e3)


def printed_angles(top: np.ndarray, inverse: Callable[[float], float] = np.arctan, sign: float = -1.0) -> np.ndarray:
    """Return α', β', γ' by the paper's formulas, °; the formulas of α' and β' contain γ'.

    `inverse` is the function used for arctan; `sign` is the sign of X'_T3 (Z'_T1 − Z'_T2), printed as +.
    """
    (x1, x2, x3), (y1, y2, y3), (z1, z2, z3) = top.T
    gamma = inverse((y1 - 2 * y2 + y3) / (S3 * (y1 - y3)))
    s, c = np.sin(gamma), np.cos(gamma)
    over = -2 * (x1 * (z3 - z2) + x2 * (z1 - z3) + sign * x3 * (z1 - z2))
    alpha = inverse(over / (A * (y1 - 2 * y2 + y3) * s + S3 * A * (y1 - y3) * c))
    over = -(z1 - 2 * z2 + z3) * c + S3 * (z1 - z3) * s
    beta = inverse(over / ((x1 - 2 * x2 + x3) * c - S3 * (x1 - x3) * s))
    return np.degrees([alpha, beta, gamma])


def alpha(at: Case, sign: float) -> float:
    """Return α' minus the pose's α, °."""
    return float((printed_angles(at.top, sign=sign) - at.angles)[0])


MISPRINTS = (
    Misprint(
        *("X_B5", "−√3/6 (b + d)", "−√3/6 (b − d)", "mm"),
        lambda at: fifth_length(at, B + D),
        lambda at: fifth_length(at, B - D),
    ),
    Misprint(*("L′5, L′6", "to T2", "to T3", "mm"), lambda at: last_lengths(at, 2), lambda at: last_lengths(at, 3)),
    Misprint(
        *("Y_p2", "½ (d − 2 p1)", "½ (b − 2 p2)", "mm"),
        lambda at: float((D - 2 * at.p[0]) / 2.0 - at.top[1, 1]),
        lambda at: float(at.yp[1] - at.top[1, 1]),
    ),
    Misprint(
        *("Y_T3", "−√3 X_T3 − (√3 X_p3 − Y_p3)", "−√3 X_T3 + (√3 X_p3 + Y_p3)", "mm"),
        lambda at: y_t3(at, -1.0),
        lambda at: y_t3(at, 1.0),
    ),
    Misprint(
        "second combined equation",
        "X_p1 − 3 X_p1; h3² − (X_T3 − X_p3)²; √3 (Y_p1 − Y_p2) beside X_T1",
        "X_p1 − 3 X_p3; h3² − 4 (X_T3 − X_p3)²; √3 (Y_p1 − Y_p3)",
        "mm",
        second_equation,
        lambda at: second_equation(at, *CORRECTIONS),
    ),
    Misprint(
        *("second combined equation, third misprint alone", "√3 (Y_p1 − Y_p2) beside X_T1", "√3 (Y_p1 − Y_p3)", "mm"),
        lambda at: second_equation(at, "Xp3", "4"),
        lambda at: second_equation(at, *CORRECTIONS),
    ),
    Misprint(
        "X′_B, Y′_B from joint 3 on",
        "X_Bi − δX_Bi (i = 3, 4, 5), Y_Bi − δY_Bi (i = 4, 5, 6)",
        "+ δ throughout",
        "µm for an error of 10",
        lambda at: base_errors(at, SIGNS),
        lambda at: base_errors(at, np.ones((6, 3))),
    ),
    Misprint(
        *("X′_T, Y′_T, Z′_T", "P + (a/√3 + 2 δ) [bracket]", "P + R (t + δt)", "µm for an error of 10"),
        lambda at: top_errors(at, printed=True),
        lambda at: top_errors(at, printed=False),
    ),
    Misprint(
        *("Y′_T1", "√3 X′_T1 − (L″1² − L″2²)/b′1", "√3 X′_T1 + (L″1² − L″2²)/b′1", "mm"),
        lambda at: y_t1(at, -1.0),
        lambda at: y_t1(at, 1.0),
    ),
    Misprint(
        *("Y′_T2", "−(L″4² − L″3²)/(2 b′2)", "+(L″4² − L″3²)/(2 b′2)", "mm"),
        lambda at: y_t2(at, -1.0),
        lambda at: y_t2(at, 1.0),
    ),
    Misprint(
        *("Z′_T2", "√(h′2² − 4 (X′_T2 − X′_P2)²)", "√(h′2² − (X′_T2 − X′_P2)²)", "mm"),
        lambda at: z_t2(at, 4.0),
        lambda at: z_t2(at, 1.0),
    ),
    Misprint(
        "Z′_T",
        "√(h′² − …)",
        "+ ½ (Z′_B,2i−1 + Z′_B,2i), the height from which h′ is measured",
        "µm for heights of up to 10",
        lambda at: heights(at, back=False),
        lambda at: heights(at, back=True),
    ),
    Misprint(
        *("α′", "… + X′_T3 (Z′_T1 − Z′_T2)", "… + X′_T3 (Z′_T2 − Z′_T1)", "°"),
        lambda at: alpha(at, 1.0),
        lambda at: alpha(at, -1.0),
    ),
)
"""All misprints, in the order of the paper."""
