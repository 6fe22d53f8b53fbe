"""The table of a machine's model: each field of a model carries its name in files, unit, shape and allowed range."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import MISSING, dataclass, field, fields
from typing import Any

import numpy as np

from ..errors import ModelError
from ..formats.schema import DIMENSIONS, PER_STRUT, UNITS, Numbers, Section, Shape

# Units in which bounds are shown, and their number in an SI unit, where it is not the file's own
SHOWN = {
    "um": ("mm", 1e3),
    "urad": ("mrad", 1e3),
    "N_m": ("N m", 1.0),
    "ppm_per_percent": ("ppm per % of relative humidity", 1e4),
}


@dataclass(frozen=True)
class Row:
    """One term as it appears in files and in the documentation."""

    place: str  # section of the file, such as struts.wave
    key: str  # there, without its unit; empty: the field's name
    numbers: Numbers  # unit and shape in the file
    checked: bool  # the shape is the file's too; else the dataclass checks it
    least: float  # smallest allowed value, SI
    largest: float  # largest allowed value, SI: no machine exceeds it
    meaning: str

    def where(self, name: str) -> str:
        """Return the term's name in messages."""
        section = self.place.partition(".")[0]
        name = self.key if self.key and section == self.place else name
        return f"{section}.{name}" if section else name

    @property
    def bound(self) -> str:
        """The largest value, for people."""
        unit = self.numbers.unit
        name, factor = SHOWN.get(unit, (unit.replace("_per_", " per "), 1.0 / UNITS[DIMENSIONS[unit]][unit]))
        return f"{self.largest * factor:g} {name}"


def term(
    place: str,
    unit: str,
    meaning: str,
    shape: Shape | str = PER_STRUT,
    default: Any = 0.0,
    key: str = "",
    least: float = -math.inf,
    largest: float = math.inf,
    checked: bool = True,
) -> Any:
    """Return a field with its row: one number where the shape is (), else an array filled with the default."""
    row = Row(place, key, Numbers(unit, shape), checked, least, largest, meaning)
    if shape == () or default is MISSING:
        return field(default=default, metadata={"row": row})
    lengths = (6,) if isinstance(shape, str) else tuple(length or 0 for length in shape)
    return field(default_factory=lambda: np.full(np.shape(default) or lengths, default), metadata={"row": row})


def rows(schema: Any) -> Iterator[tuple[str, Row, Any]]:
    """Yield name, row and default (MISSING: required) of the terms of a dataclass."""
    for one in fields(schema):
        if "row" in one.metadata:
            made = one.default if one.default_factory is MISSING else one.default_factory()
            yield one.name, one.metadata["row"], made


def settle(value: Any) -> None:
    """Make a dataclass's terms read-only arrays, or numbers."""
    for name, row, _ in rows(type(value)):
        array = np.array(getattr(value, name), dtype=float)
        shape = (6,) if isinstance(row.numbers.shape, str) else row.numbers.shape
        fits = array.ndim == len(shape) and all(n in (None, m) for n, m in zip(shape, array.shape, strict=True))
        if row.checked and not fits:
            raise ModelError(row.where(name), f"must have shape {shape}, not {array.shape}", array.tolist())
        if not np.isfinite(array).all():
            raise ModelError(
                row.where(name), f"must be finite, in SI units ({row.numbers.unit} in files)", array.tolist()
            )
        if (array < row.least).any():
            problem = "must not be negative" if row.least == 0.0 else "must be above zero"
            raise ModelError(row.where(name), problem, array.tolist())
        array.flags.writeable = False
        object.__setattr__(value, name, array if shape else float(array))


def check_magnitudes(value: Any, place: str | None = None) -> None:
    """Refuse terms, all or those of one section, that no machine has: an error of units, or a fit gone astray."""
    for name, row, _ in rows(type(value)):
        if place in (None, row.place):
            check_magnitude(row.where(name), getattr(value, name), row.largest, row.bound)


def check_magnitude(where: str, values: Any, largest: float, bound: str) -> None:
    """Refuse values beyond ± a bound."""
    found = float(np.abs(np.asarray(values)).max(initial=0.0))
    if not found <= largest:
        raise ModelError(where, f"must stay within ±{bound}; is the unit right?", found)


def read_terms(schema: Any, section: Section, place: str) -> dict[str, Any]:
    """Return the terms that stand in a section, by field; those left out have their default."""
    return {
        name: row.numbers.read(section, row.key or name, made) for name, row, made in rows(schema) if row.place == place
    }


def write_terms(value: Any, place: str, whole: bool = False) -> dict[str, Any]:
    """Return the content of a section: terms that differ from their default, or the `whole` of them."""
    content: dict[str, Any] = {}
    for name, row, made in rows(type(value)):
        own = getattr(value, name)
        if row.place == place and (whole or made is MISSING or not np.array_equal(own, made)):
            content |= [row.numbers.write(row.key or name, own)]
    return content


def table_text(*schemas: Any) -> str:
    """Return the rows of some dataclasses as a Markdown table, as doc/model_file.md has it."""
    lines = ["| section | key | shape | default | allowed | meaning |", "|---|---|---|---|---|---|"]
    for name, row, made in (row for schema in schemas for row in rows(schema)):
        shape = row.numbers.shape
        size = shape if isinstance(shape, str) else " × ".join(str(n or "n") for n in shape) or "one number"
        size_in_si = UNITS[DIMENSIONS[row.numbers.unit]][row.numbers.unit]
        usual = np.ravel(0.0 if made is MISSING else made)
        values = usual if len(set(usual.tolist())) > 1 else usual[:1]
        listed = ", ".join(f"{value / size_in_si:g}" for value in values)
        default = "required" if made is MISSING else listed or "none"
        bounds = (
            ["≥ 0"] * (row.least == 0.0) + ["> 0"] * (row.least > 0.0) + [f"±{row.bound}"] * math.isfinite(row.largest)
        )
        key = f"{row.key or name}_{row.numbers.unit}"
        lines.append(f"| {row.place or '–'} | `{key}` | {size} | {default} | {', '.join(bounds)} | {row.meaning} |")
    return "\n".join(lines) + "\n"
