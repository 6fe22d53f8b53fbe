"""What Song, Mou & King print: their tables, digit by digit, from the shipped files table1.csv to table5.csv."""

from __future__ import annotations

from decimal import Decimal
from functools import cache

import numpy as np

from ..formats.csv import Table
from ..formats.paths import config_file
from .comparing import numbers

DIGITS = 6
"""Significant digits of their numbers. Zeros at the end are left out in print: 5 stands for 5.00000."""

LENGTHS = tuple(f"L{i}_mm" for i in range(1, 7))
POSE = ("alpha_deg", "beta_deg", "gamma_deg", "x_mm", "y_mm", "z_mm")


@cache
def table(number: int) -> tuple[tuple[str, ...], ...]:
    """Return the ten rows of Table 1 to 5 without their sequence numbers, each number as printed: mm and degrees."""
    file = Table(config_file(f"table{number}.csv"))
    names = LENGTHS if number in (2, 4) else POSE
    return tuple(zip(*(file.texts(name) for name in names), strict=True))


def values(number: int) -> np.ndarray:
    """Return the numbers of a table, shape (10, 6), mm and degrees."""
    return numbers(table(number))


def roundings(printed: tuple[tuple[str, ...], ...]) -> np.ndarray:
    """Return half of the last digit of printed numbers: what rounding allows, in their units."""
    return np.array([[_rounding(Decimal(cell)) for cell in row] for row in printed])


def _rounding(number: Decimal) -> float:
    last = number.adjusted() - DIGITS + 1
    exponent = number.as_tuple().exponent
    written = exponent if isinstance(exponent, int) else 0
    return 0.5 * 10.0 ** (last if abs(number) >= 1 else written)
