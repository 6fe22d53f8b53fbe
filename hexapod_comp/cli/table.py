"""One table for people, for spreadsheets and for programs: rows of values whose names end in their units."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

from ..formats import csv
from ..formats.texts import aligned, number

# Digits after the point in CSV files, by unit: a picometre, and less than that at the platform's edge
DECIMALS = {"mm": 9, "deg": 9, "um": 6, "urad": 6}

SHOWN = {"mm": 6, "deg": 6}  # the same for people, who otherwise get three


def unit_of(name: str) -> str:
    """Return the unit in which a column's name ends."""
    return name.rpartition("_")[2]


class Table:
    """Rows with the same columns; a value is text, a whole number, a number in its column's unit, or missing."""

    def __init__(self, rows: Sequence[Mapping[str, Any]]) -> None:
        self.rows = rows

    def csv(self) -> str:
        """Return the rows as CSV; what is missing or not finite stays empty."""
        names = list(self.rows[0])

        def cell(name: str, value: Any) -> Any:
            if not isinstance(value, float):
                return value
            return number(value, DECIMALS.get(unit_of(name), 6)) if math.isfinite(value) else ""

        return csv.csv_text([names, *([cell(name, row[name]) for name in names] for row in self.rows)])

    def text(self, names: Sequence[str] = (), digits: Mapping[str, int] | None = None) -> str:
        """Return some columns, or all, aligned; with other digits after the point where they are given by name."""
        names = names or list(self.rows[0])

        def cell(name: str, value: Any) -> str:
            if not isinstance(value, float):
                return "–" if value is None else str(value)
            places = (digits or {}).get(name, SHOWN.get(unit_of(name), 3))
            return number(value, places) if math.isfinite(value) else "–"

        return aligned(names, [[cell(name, row[name]) for name in names] for row in self.rows])
