"""Comparison of printed with computed numbers, with verdicts and differences, as text and as CSV rows.

The numbers are in the units of the papers; every column names its unit.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from decimal import Decimal
from functools import cache
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from hexapod_comp.formats.csv import Table
from hexapod_comp.formats.paths import config_file

if TYPE_CHECKING:
    from matplotlib.figure import Figure

MET, WRONG, OPEN, MISSED, SHOWN = VERDICTS = ("met", "wrong in print", "cannot be met", "not met", "shown")
"""Verdicts on a printed number. met: equal within rounding. wrong in print: the paper's number is wrong; the text gives
the right one. cannot be met: the paper does not print the data to compute it. not met: a fault of this package. shown:
computed only; the paper prints no number."""


class Column(NamedTuple):
    """A column of printed numbers."""

    name: str
    unit: str
    difference_unit: str  # unit in which differences are shown
    factor: float  # number of difference units in one unit of the column
    digits: int  # digits of a computed number after the decimal point


def lengths_mm(*names: str) -> tuple[Column, ...]:
    """Return columns of lengths in mm, with differences in µm."""
    return tuple(Column(name, "mm", "µm", 1e3, 5) for name in names)


def angles_deg(*names: str) -> tuple[Column, ...]:
    """Return columns of angles in degrees, with differences in thousandths of a degree."""
    return tuple(Column(name, "°", "m°", 1e3, 6) for name in names)


@dataclass(frozen=True)
class NumberTable:
    """A printed table with its computed numbers: R rows, C columns."""

    title: str
    note: str  # how the computed numbers were obtained
    columns: tuple[Column, ...]
    rows: tuple[str, ...]
    printed: tuple[tuple[str, ...], ...]
    computed: np.ndarray  # (R, C), in the columns' units
    verdicts: np.ndarray  # (R, C), members of VERDICTS

    @property
    def differences(self) -> np.ndarray:
        """Computed minus printed in the columns' units, shape (R, C)."""
        return self.computed - numbers(self.printed)

    def difference_text(self, row: int, column: int) -> str:
        """Return computed minus printed as text with its sign, in the column's unit of difference."""
        value = float(self.differences[row, column]) * self.columns[column].factor
        return f"{value:+.4f}" if abs(value) >= 5e-5 or value == 0.0 else f"{value:+.0e}"

    def summary(self) -> str:
        """Return title, count of numbers that are met, verdicts on the other numbers, and largest differences."""
        met = self.verdicts == MET
        others = ", ".join(sorted(set(self.verdicts[~met].tolist())))
        rest = f", the other numbers: {others}" if others else ""
        scaled = np.abs(self.differences) * [column.factor for column in self.columns]
        units = np.array([column.difference_unit for column in self.columns])
        largest = ", ".join(f"{scaled[:, units == u].max():.3g} {u}" for u in dict.fromkeys(units.tolist()))
        return f"{self.title}: {met.sum()} of {met.size} met{rest}; largest difference {largest}"


class Statement(NamedTuple):
    """A statement of a paper with the computed result."""

    what: str
    printed: str
    computed: str
    verdict: str
    why: str = ""  # cause of a difference, or how the result was computed


@dataclass(frozen=True)
class Exhibit:
    """A table or figure of a paper, with its comparison."""

    title: str
    text: str
    tables: tuple[NumberTable, ...] = ()
    statements: tuple[Statement, ...] = ()
    figures: Mapping[str, Figure] = field(default_factory=dict)  # by title

    def verdicts(self) -> Iterator[str]:
        """Yield the verdict on every number and every statement."""
        for table in self.tables:
            yield from table.verdicts.ravel().tolist()
        yield from (statement.verdict for statement in self.statements)


@dataclass(frozen=True)
class Paper:
    """A paper with the comparisons of all its tables and figures."""

    short: str  # authors
    title: str
    exhibits: tuple[Exhibit, ...]

    def count(self) -> Counter[str]:
        """Return the number of numbers and statements for each verdict."""
        return Counter(verdict for exhibit in self.exhibits for verdict in exhibit.verdicts())

    def headline(self) -> str:
        """Return the number of numbers and statements for each verdict as text."""
        counted = self.count()
        return ", ".join(f"{counted[verdict]} {verdict}" for verdict in VERDICTS if counted[verdict])


def judged(met: np.ndarray, otherwise: str | np.ndarray) -> np.ndarray:
    """Return :data:`MET` for each number that is met, and `otherwise` for each number that is not."""
    return np.where(met, MET, otherwise).astype(object)


def within(met: bool) -> str:
    """Return :data:`MET` if a bound is met, else :data:`MISSED`."""
    return MET if met else MISSED


def small(value: float) -> str:
    """Return a rounding error as text with one digit."""
    return f"{value:.0e}" if value else "0"


# --- The printed tables of Song, Mou & King: shipped files table1.csv to table5.csv ------------------------------

SIGNIFICANT = 6  # Significant digits of the printed numbers. The paper leaves out trailing zeros: 5 means 5.00000


@cache
def table(number: int) -> tuple[tuple[str, ...], ...]:
    """Return the ten rows of Table `number` (1 to 5) without sequence numbers, as printed, in mm and degrees."""
    file = Table(config_file(f"table{number}.csv"))
    pose = ("alpha_deg", "beta_deg", "gamma_deg", "x_mm", "y_mm", "z_mm")
    names = [f"L{i}_mm" for i in range(1, 7)] if number in (2, 4) else pose
    return tuple(zip(*(file.texts(name) for name in names), strict=True))


def numbers(printed: tuple[tuple[str, ...], ...]) -> np.ndarray:
    """Return the values of printed numbers, shape (R, C); "≈ 0" counts as 0."""
    return np.array([[float(cell.removeprefix("≈ ")) for cell in row] for row in printed])


def values(number: int) -> np.ndarray:
    """Return the numbers of Table `number` (1 to 5), shape (10, 6), mm and degrees."""
    return numbers(table(number))


def roundings(printed: tuple[tuple[str, ...], ...]) -> np.ndarray:
    """Return the largest rounding error of each printed number, half a unit of its last digit, in its unit."""
    return np.array([[_rounding(Decimal(cell)) for cell in row] for row in printed])


def _rounding(number: Decimal) -> float:
    exponent = number.as_tuple().exponent
    written = exponent if isinstance(exponent, int) else 0
    return 0.5 * 10.0 ** (number.adjusted() - SIGNIFICANT + 1 if abs(number) >= 1 else written)


# --- Text and CSV rows -------------------------------------------------------------------------------------------


def report(papers: Sequence[Paper]) -> str:
    """Return the report: the verdict on each table and figure, the differences, and their causes."""
    lines = []
    for paper in papers:
        lines += [f"{paper.short}: {paper.title}", paper.headline(), ""]
        for exhibit in paper.exhibits:
            lines += [f"  {exhibit.title}", *(f"    {one.summary()}" for one in exhibit.tables)]
            for one in exhibit.statements:
                said = {"paper": one.printed, "found": one.computed, "why": one.why}
                lines.append(f"    {one.what}: {one.verdict}")
                lines += [f"      {name:<5}  {text}" for name, text in said.items() if text]
            lines.append("")
    return "\n".join(lines[:-1])


def records(papers: Sequence[Paper]) -> Iterator[dict[str, Any]]:
    """Yield a CSV row for each printed number and each statement."""
    for paper in papers:
        for exhibit in paper.exhibits:
            for one in exhibit.tables:
                for r, name in enumerate(one.rows):
                    for c, column in enumerate(one.columns):
                        yield {
                            "paper": paper.short,
                            "where": one.title,
                            "what": f"{column.name}, row {name}",
                            "unit": column.unit,
                            "printed": one.printed[r][c],
                            "computed": f"{one.computed[r, c]:.12g}",
                            "difference": f"{one.differences[r, c]:.6g}",
                            "verdict": one.verdicts[r, c],
                            "why": "",
                        }
            for said in exhibit.statements:
                yield {
                    "paper": paper.short,
                    "where": exhibit.title,
                    "what": said.what,
                    "unit": "",
                    "printed": said.printed,
                    "computed": said.computed,
                    "difference": "",
                    "verdict": said.verdict,
                    "why": said.why,
                }
