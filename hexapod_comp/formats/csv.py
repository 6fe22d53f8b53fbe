"""CSV files with units in the column names; errors name the line and the column.

Columns are separated by commas if the header has a comma, otherwise by semicolons if it has a semicolon, otherwise by
tabs. Numbers in a file with semicolons or tabs may have decimal commas, which spreadsheets of many countries write.
"""

from __future__ import annotations

import codecs
import csv
import hashlib
import io
import itertools
import math
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from decimal import Decimal
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import numpy as np

from ..errors import InputFileError
from .files import MAX_CSV_BYTES, open_input, too_large
from .schema import LARGEST, UNITS, Choice, Integer, decimal_shift, spellings
from .texts import DECIMAL_COMMA, MICRO_ERRORS, THOUSANDS, did_you_mean, number_hint, plain_number

LABEL_COLUMNS = ("sequence", "name")

SAME_NODE = 1e-9  # two coordinates of a grid that differ by at most this fraction of the axis' span are one node
MAX_ROWS = 2_000_000  # largest number of rows: one hour's path at 500 Hz has 1,800,000
MAX_COLUMNS = 1000  # largest number of columns; files of other laboratories have a few dozen
MAX_CELLS = 40_000_000  # largest number of cells; each cell takes about 60 bytes of memory

# Longest line, in characters; without this limit a file without line ends would be read into memory completely
MAX_LINE = 1_000_000

# Encodings that a columns file may state. If none is stated, a CSV file with the byte order mark of UTF-16 is read as
# UTF-16, a file of valid UTF-8 as UTF-8, and every other file as Windows-1252. If Windows-1252 is wrong, letters of
# names may be wrong, but numbers are right.
ENCODINGS = ("utf-8", "utf-16", "windows-1252", "latin-1")

MOST_SKIPPED = 1000  # largest number of rows that may be skipped above the header, and below the header

# Separators of columns, and their names in messages; a file uses the first of these separators that its header contains
SEPARATORS = {",": "commas", ";": "semicolons", "\t": "tabs"}

QUOTED = re.compile(r'"[^"]*"')  # quoted text; a comma in quoted text does not separate columns
MARK = "'"  # written before a text that begins like a formula, so that a spreadsheet does not execute the text
FORMULA = re.compile(f"[{MARK} ]*[-=+@\t\r]")  # beginning of cells that a spreadsheet executes as formulas


def csv_text(rows: Iterable[Sequence[Any]]) -> str:
    """Return rows as CSV with line feeds; MARK precedes each text that a spreadsheet would execute as a formula."""
    stream = io.StringIO()
    csv.writer(stream, lineterminator="\n").writerows([_marked(cell) for cell in row] for row in rows)
    return stream.getvalue()


def _marked(cell: Any) -> Any:
    dangerous = isinstance(cell, str) and FORMULA.match(cell) and math.isnan(plain_number(cell))
    return MARK + cell if dangerous else cell


def unmarked(cell: str) -> str:
    """Return a cell without the MARK that :func:`csv_text` has written before the cell's text."""
    return cell[1:] if cell.startswith(MARK) and _marked(cell[1:]) == cell else cell


@dataclass(frozen=True)
class Row:
    line: int  # number of the row's line in the file, from 1
    label: str  # cell in the column ``sequence`` or ``name``; in a file without these columns the number of the row


@dataclass(frozen=True)
class Layout:
    """Properties of a CSV file that cannot be detected from its header."""

    encoding: Annotated[str, Choice(*ENCODINGS)] = ""  # encoding of the text; empty: detect the encoding
    rows_above_header: Annotated[int, Integer(0, MOST_SKIPPED)] = 0  # number of skipped lines, empty lines included
    rows_below_header: Annotated[int, Integer(0, MOST_SKIPPED)] = 0  # number of skipped rows, such as a row of units


DEFAULT_LAYOUT = Layout()


class Table:
    """The header and the rows of a CSV file, without empty rows and comments."""

    def __init__(self, path: str | Path, layout: Layout = DEFAULT_LAYOUT) -> None:
        self.path = path
        self.header: list[str] = []
        self.rows: list[tuple[int, list[str]]] = []  # of each row: line number in the file, and cells
        self.comments: list[str] = []  # lines above the header that begin with #, at most `MOST_SKIPPED`
        self.sha256, self._separator = "", ","
        self.notes: list[str] = []
        self._read(layout)
        if not self.rows:
            raise InputFileError(path, "", "has a header but no rows" if self.header else "has no header")
        if self._separator != ",":
            self._point_decimals()
        self._known: set[str] = {name for name in LABEL_COLUMNS if name in self.header}

    # ---- reading ----

    def _read(self, layout: Layout) -> None:
        """Read the file; if the layout gives no encoding and the file is not valid UTF-8, read it as Windows-1252."""
        with open_input(self.path, MAX_CSV_BYTES) as file:
            again = not layout.encoding and file.seekable()
            start = file.read(2) if again else b""
            encoding = layout.encoding or ("utf-16" if start in (codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE) else "utf-8")
            for attempt in (encoding, "windows-1252"):
                if again:
                    file.seek(0)
                try:
                    self._decode(file, layout, attempt)
                    return
                except UnicodeDecodeError as error:
                    if attempt != "utf-8" or not again:
                        problem = f"is not {attempt.upper()} text"
                        if not layout.encoding:
                            problem += "; in a spreadsheet choose 'CSV UTF-8' when saving"
                        raise InputFileError(self.path, "", problem) from error

    def _decode(self, file: io.FileIO, layout: Layout, encoding: str) -> None:
        source, self.rows, self.comments = _Hashed(file, self.path, MAX_CSV_BYTES), [], []
        options = {"utf-8": ("utf-8-sig", MICRO_ERRORS), "windows-1252": ("cp1252", "replace")}
        codec, errors = options.get(encoding, (encoding, "strict"))
        stream = io.TextIOWrapper(io.BufferedReader(source), newline="", encoding=codec, errors=errors)
        text, lines = self._bounded_lines(stream), None
        before = sum(1 for _ in itertools.islice(text, layout.rows_above_header))
        try:
            header = ""  # the first line below the skipped rows that is neither empty nor a comment
            for line in text:
                if line.strip() and not line.lstrip().startswith(("#", '"#')):
                    header = line
                    break
                if line.strip() and len(self.comments) < MOST_SKIPPED:
                    self.comments.append(line.strip().strip('",;\t'))
                before += 1
            self._separator = next((mark for mark in SEPARATORS if mark in QUOTED.sub("", header)), ",")
            lines = csv.reader(itertools.chain([header], text), delimiter=self._separator, skipinitialspace=True)
            self._parse_header(next(lines, []))
            for _ in itertools.islice(lines, layout.rows_below_header):
                pass
            for row in lines:
                if row and not row[0].startswith("#"):
                    self._parse_row(before + lines.line_num, row)
        except csv.Error as error:
            line_number = before + (lines.line_num if lines else 0)
            raise InputFileError(self.path, f"line {line_number}", f"is not CSV: {error}") from error
        except OSError as error:
            raise InputFileError(self.path, "", f"cannot be read: {error.strerror}") from error
        if encoding == "windows-1252" and not layout.encoding:
            self.notes = [f"{self.path}: is not UTF-8; it was read as Windows-1252"]
        self.sha256 = source.sha256.hexdigest()

    def _bounded_lines(self, stream: io.TextIOWrapper) -> Iterator[str]:
        """Yield the lines of a stream; refuse a line of more than `MAX_LINE` characters, or with a zero byte."""
        for number, line in enumerate(iter(partial(stream.readline, MAX_LINE + 1), ""), start=1):
            if len(line) > MAX_LINE:
                problem = f"is longer than the allowed {MAX_LINE} characters"
                raise InputFileError(self.path, f"line {number}", problem)
            if "\0" in line:
                raise InputFileError(self.path, f"line {number}", "is not text: it contains a zero byte")
            yield line

    def _parse_header(self, cells: list[str]) -> None:
        if len(cells) > MAX_COLUMNS:
            raise InputFileError(self.path, "header", f"has {len(cells)} columns, at most {MAX_COLUMNS} are allowed")
        self.header = [name.strip() for name in cells]
        twice = next((name for name in self.header if name and self.header.count(name) > 1), None)
        if twice is not None:
            raise InputFileError(self.path, "header", "column is given twice", twice)

    def _parse_row(self, line: int, cells: list[str]) -> None:
        if len(cells) != len(self.header):
            hint, own = "", SEPARATORS[self._separator]
            others = [name for mark, name in SEPARATORS.items() if name != own and any(mark in cell for cell in cells)]
            if len(self.header) == 1:
                hint = "; if this line is the header, begin each line above with #, or give rows_above_header in a"
                hint += " columns file"
            elif others:
                hint = f"; the header separates its columns by {own}, but this line also contains {others[0]}"
            elif own == "commas":
                hint = "; if some commas are decimal commas, separate the columns by semicolons"
            problem = f"has {len(cells)} columns, the header has {len(self.header)}{hint}"
            raise InputFileError(self.path, f"line {line}", problem)
        if len(self.rows) >= MAX_ROWS:
            raise InputFileError(self.path, "", f"has more than the allowed {MAX_ROWS} rows")
        if len(self.rows) * len(cells) >= MAX_CELLS:
            raise InputFileError(self.path, "", f"has more than the allowed {MAX_CELLS} cells")
        self.rows.append((line, cells))

    def _point_decimals(self) -> None:
        """Replace decimal commas by decimal points; refuse a file in which a comma is ambiguous."""
        commas = [
            (line, row, k)
            for line, row in self.rows
            for k, cell in enumerate(row)
            if "," in cell and DECIMAL_COMMA.fullmatch(cell.strip())
        ]
        if not commas:
            return
        first, row, k = commas[0]
        where, cell = f"line {first}, column {self.header[k]}", row[k]
        for line, row in self.rows:
            if any("." in cell and not math.isnan(plain_number(cell)) for cell in row):
                problem = f"has a decimal comma, but line {line} has a decimal point; write decimal points only"
                raise InputFileError(self.path, where, problem, cell)
        if all(THOUSANDS.fullmatch(row[k].strip()) for _, row, k in commas):
            problem = "has a comma that may be a decimal comma or a thousands separator; write a decimal point"
            raise InputFileError(self.path, where, problem, cell)
        for _, row, k in commas:
            row[k] = row[k].replace(",", ".")

    # ---- columns ----

    def column(self, name: str, dimension: str | None) -> tuple[int, float] | None:
        """Return a column's index and the size of its unit in SI; None if the file does not have this column."""
        wanted = {name: 1.0} if dimension is None else {f"{name}_{u}": s for u, s in spellings(dimension).items()}
        keys = [key for key in wanted if key in self.header]
        if len(keys) > 1:
            raise InputFileError(self.path, "header", f"{name} is given twice", keys)
        self._known.update(wanted)
        if not keys:
            return None
        return self.header.index(keys[0]), wanted[keys[0]]

    def columns(self, names: tuple[str, ...], dimension: str | None) -> list[tuple[int, float]] | None:
        """Return :meth:`column` of each name, or None if all are missing; refuse a file that has only some of them."""
        columns = [self.column(name, dimension) for name in names]
        if all(entry is None for entry in columns):
            return None
        for name, entry in zip(names, columns, strict=True):
            if entry is None:
                raise self._missing(name, dimension)
        return [entry for entry in columns if entry is not None]

    def required(self, names: tuple[str, ...], dimension: str | None) -> list[tuple[int, float]]:
        """Return :meth:`column` of each name; raise an InputFileError if a column is missing."""
        columns = self.columns(names, dimension)
        if columns is None:
            raise self._missing(names[0], dimension)
        return columns

    def _missing(self, name: str, dimension: str | None) -> InputFileError:
        named = name if dimension is None else " or ".join(f"{name}_{unit}" for unit in UNITS[dimension])
        problem = f"column {named} is missing"
        if len(self.header) > 1:
            return InputFileError(self.path, "header", problem)
        problem += f"; columns must be separated by {' or '.join(SEPARATORS.values())}, but only one column was found"
        return InputFileError(self.path, "header", problem, self.header[0])

    @property
    def unknown(self) -> list[str]:
        """Names of the file's columns that no call of :meth:`column` has named so far."""
        return [name for name in self.header if name and name not in self._known]

    def refuse_unknown(self) -> None:
        for name in self.header:
            if name not in self._known:
                problem = f"is not a known column{did_you_mean(name, self._known)}"
                raise InputFileError(self.path, "header", problem, name)

    def numbers(self, columns: list[tuple[int, float]]) -> np.ndarray:
        """Return in SI the finite numbers of columns that :meth:`required` has found; shape (rows, columns)."""
        return np.stack([self.values(index, unit) for index, unit in columns], axis=1)

    def values(self, index: int, unit: float, blank: bool = False) -> np.ndarray:
        """Return a column's finite numbers in SI. If `blank` is True, blank cells become NaN; else they are refused."""
        known: dict[str, float] = {}  # from a cell's text to its number: texts repeat, and conversion is slow
        for line, row in self.rows:
            text = row[index]
            if text not in known:
                empty = blank and not text.strip()
                known[text] = math.nan if empty else si_from_text(text, self.number(line, index, text), unit)
        return np.array([known[row[index]] for _, row in self.rows])

    def texts(self, name: str) -> list[str]:
        """Return the cells of a required column without leading and trailing spaces."""
        index = self.required((name,), None)[0][0]
        cells = [row[index] for _, row in self.rows]
        known = {cell: unmarked(cell.strip()) for cell in set(cells)}
        return [known[cell] for cell in cells]

    def meanings(self, name: str, texts: list[str], meanings: Mapping[str, Any], allowed: str) -> list[Any]:
        """Look up each of a column's `texts` in `meanings`, and return the values found; refuse other texts."""
        for (line, _), text in zip(self.rows, texts, strict=True):
            if text not in meanings:
                raise InputFileError(self.path, f"line {line}, column {name}", f"must be {allowed}", text)
        return [meanings[text] for text in texts]

    def number(self, line: int, index: int, text: str) -> float:
        return number_in(self.path, f"line {line}, column {self.header[index]}", text)

    def labels(self) -> list[Row]:
        columns = [self.header.index(name) for name in LABEL_COLUMNS if name in self.header]
        return [
            Row(line, unmarked(row[columns[0]].strip()) if columns else str(n + 1))
            for n, (line, row) in enumerate(self.rows)
        ]


def grid_order(table: Table, coordinates: np.ndarray, names: str) -> tuple[list[np.ndarray], np.ndarray]:
    """Return the coordinates of a grid's nodes along each axis, and the indices that sort the table's rows by node.

    Each row of the table is a node with its own `coordinates`, shape (axes, rows). Raise an InputFileError if a
    node of the grid is missing or given twice; its message calls the axes `names`.
    """
    nodes, places = [], []
    for values in coordinates:
        found = np.unique(values)
        slack = SAME_NODE * np.ptp(found)
        nodes.append(found[np.append(True, np.diff(found) > slack)])
        places.append(np.searchsorted(nodes[-1], values + slack, side="right") - 1)
    where = np.ravel_multi_index(tuple(places), [len(axis) for axis in nodes])
    given, first, repeats = np.unique(where, return_index=True, return_counts=True)
    if (repeats > 1).any():
        again = np.flatnonzero(where == given[repeats > 1][0])[1]
        raise InputFileError(table.path, f"line {table.rows[again][0]}", f"{names} are given twice")
    if len(given) != (count := math.prod(len(axis) for axis in nodes)):
        problem = f"has {len(given)} rows, its grid needs {count}: one for every {names}"
        raise InputFileError(table.path, f"lines {table.rows[first.min()][0]}…{table.rows[-1][0]}", problem)
    return nodes, np.argsort(where)


def number_in(path: str | Path, where: str, text: str) -> float:
    value = plain_number(text)
    if math.isnan(value):
        raise InputFileError(path, where, f"must be a finite number{number_hint(text)}", text)
    if abs(value) > LARGEST:
        raise InputFileError(path, where, f"must be a number within ±{LARGEST:g}", text)
    return value


class _Hashed(io.RawIOBase):
    """A byte stream from a file or pipe that computes the SHA-256 of its bytes and refuses more than `most` bytes."""

    def __init__(self, file: io.FileIO, path: str | Path, most: int) -> None:
        self._file, self._path, self._left, self._most = file, path, most, most
        self.sha256 = hashlib.sha256()

    def readable(self) -> bool:
        return True

    def readinto(self, buffer: Any) -> int:
        count = self._file.readinto(buffer) or 0
        self._left -= count
        if self._left < 0:
            raise too_large(self._path, self._most)
        self.sha256.update(memoryview(buffer)[:count])
        return count


def si_from_text(text: str, number: float, unit: float) -> float:
    """Return in SI the number that `text` contains; `number` is its float, `unit` the size of its unit in SI."""
    # A unit of a power of ten causes no rounding: 203.2 mm becomes 0.2032, and a number with all digits is restored.
    digits = decimal_shift(unit)
    if not digits:
        return unit * number
    return float(exact(text, number).scaleb(digits)) if "e" in text.lower() else float(f"{text.strip()}e{digits}")


def exact(text: str, number: float) -> Decimal:
    """Return a text's number as a Decimal with all its digits or, if it has an exponent, the digits of its float."""
    return Decimal(repr(number)) if "e" in text.lower() else Decimal(text)
