"""Printed numbers beside computed ones: which are met, by how much the others differ, and why.

The numbers stay in the units in which they are printed; every column names its own.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

if TYPE_CHECKING:
    from matplotlib.figure import Figure

MET, WRONG, OPEN, MISSED, SHOWN = "met", "wrong in print", "cannot be met", "not met", "shown"
"""What can be said of a printed number: it is met; the right one is another, as the text beside it says; what would
be needed for it is not printed; or it could be met, and is not: a fault of this package. Or the paper prints nothing to
compare with, and the number is only shown."""

VERDICTS = (MET, WRONG, OPEN, MISSED, SHOWN)


class Column(NamedTuple):
    """A column of printed numbers.

    Attributes
    ----------
    name, unit : str
        As printed.
    difference_unit : str
        In which differences are shown.
    factor : float
        From the column's unit to that.
    digits : int
        Digits after the point of a computed number.
    """

    name: str
    unit: str
    difference_unit: str
    factor: float
    digits: int


def lengths_mm(*names: str) -> tuple[Column, ...]:
    """Return columns in mm, with differences in µm."""
    return tuple(Column(name, "mm", "µm", 1e3, 5) for name in names)


def angles_deg(*names: str) -> tuple[Column, ...]:
    """Return columns in degrees, with differences in thousandths of one."""
    return tuple(Column(name, "°", "m°", 1e3, 6) for name in names)


@dataclass(frozen=True)
class NumberTable:
    """A printed table beside its computed numbers.

    Attributes
    ----------
    title, note : str
        What it is, and what its computed numbers are.
    columns : tuple of Column
        C of them.
    rows : tuple of str
        Names of the R rows.
    printed : tuple of tuple of str
        The numbers as printed.
    computed, verdicts : ndarray, shape (R, C)
        Numbers in the columns' units, and one of :data:`VERDICTS` for each.
    """

    title: str
    note: str
    columns: tuple[Column, ...]
    rows: tuple[str, ...]
    printed: tuple[tuple[str, ...], ...]
    computed: np.ndarray
    verdicts: np.ndarray

    @property
    def differences(self) -> np.ndarray:
        """Computed minus printed in the columns' units, shape (R, C)."""
        return self.computed - numbers(self.printed)

    def largest_differences(self) -> dict[str, float]:
        """Return the largest magnitude by unit of difference."""
        scaled = np.abs(self.differences) * [column.factor for column in self.columns]
        units = np.array([column.difference_unit for column in self.columns])
        return {unit: float(scaled[:, units == unit].max()) for unit in dict.fromkeys(units.tolist())}


def numbers(printed: tuple[tuple[str, ...], ...]) -> np.ndarray:
    """Return printed numbers, shape (R, C); "≈ 0" counts as 0."""
    return np.array([[float(cell.removeprefix("≈ ")) for cell in row] for row in printed])


def judged(met: np.ndarray, otherwise: str | np.ndarray) -> np.ndarray:
    """Return :data:`MET` where numbers are met, and what is said of the others."""
    return np.where(met, MET, otherwise).astype(object)


def small(value: float) -> str:
    """Return what rounding has left, as text."""
    return f"{value:.0e}" if value else "0"


class Statement(NamedTuple):
    """Something that a paper says, or shows, beside what is found.

    Attributes
    ----------
    what, printed, computed : str
        The quantity; as the paper has it; as computed here.
    verdict : str
        One of :data:`VERDICTS`.
    why : str
        What explains a difference, or how it was found.
    """

    what: str
    printed: str
    computed: str
    verdict: str
    why: str = ""


@dataclass(frozen=True)
class Exhibit:
    """A table or figure of a paper.

    Attributes
    ----------
    title, text : str
        Which one, and what is to be seen.
    tables : tuple of NumberTable
    statements : tuple of Statement
    figures : mapping of str to Figure
        Pictures by what they show.
    """

    title: str
    text: str
    tables: tuple[NumberTable, ...] = ()
    statements: tuple[Statement, ...] = ()
    figures: Mapping[str, Figure] = field(default_factory=dict)

    def verdicts(self) -> Iterator[str]:
        """Yield the verdict of every number and statement."""
        for table in self.tables:
            yield from table.verdicts.ravel().tolist()
        yield from (statement.verdict for statement in self.statements)


@dataclass(frozen=True)
class Paper:
    """A paper and everything of it that was computed.

    Attributes
    ----------
    short, title : str
        Its authors, as they are named everywhere, and its title.
    exhibits : tuple of Exhibit
    """

    short: str
    title: str
    exhibits: tuple[Exhibit, ...]

    def count(self) -> Counter[str]:
        """Return how often each verdict was given."""
        return Counter(verdict for exhibit in self.exhibits for verdict in exhibit.verdicts())
