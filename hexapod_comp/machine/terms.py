"""The terms of a machine model: each dataclass field carries its key in files, its unit, shape and allowed range."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import MISSING, dataclass, field, fields
from typing import Any

import numpy as np

from ..errors import ModelError
from ..formats.schema import DIMENSIONS, PER_STRUT, UNITS, Numbers, Section, Shape

# For a unit of model files: the unit in which messages show a bound, and the factor from SI to that unit
SHOWN = {
    "um": ("mm", 1e3),
    "urad": ("mrad", 1e3),
    "N_m": ("N m", 1.0),
    "N_per_um": ("N/µm", 1e-6),
    "m_s2": ("m/s²", 1.0),
    "ppm_per_percent": ("ppm per % of relative humidity", 1e4),
}


TINY = float(np.finfo(float).tiny)  # the smallest allowed value of a term that must be above zero


@dataclass(frozen=True)
class Row:
    """How one term of a model is read, written, checked and documented."""

    place: str  # section of the file, such as struts.wave
    key: str  # key in that section, without its unit; empty: the dataclass field's name
    numbers: Numbers  # unit and shape in the file
    checked: bool  # True: `validate_terms` checks the shape; False: the dataclass that contains the term checks it
    least: float  # smallest allowed value, SI
    largest: float  # largest allowed magnitude, SI: no machine exceeds it
    meaning: str  # text for the table in doc/model_file.md

    def where(self, name: str) -> str:
        """Return the name that messages use for the dataclass field `name`, such as ``struts.pitch``."""
        section = self.place.partition(".")[0]
        name = self.key if self.key and section == self.place else name
        return f"{section}.{name}" if section else name

    def shown(self, value: float) -> str:
        unit = self.numbers.unit
        name, factor = SHOWN.get(unit, (unit.replace("_per_", " per "), 1.0 / UNITS[DIMENSIONS[unit]][unit]))
        return f"{value * factor:g} {name}"

    @property
    def least_text(self) -> str:
        """The smallest allowed value as a condition, such as "≥ 0"; empty if no smallest value is set."""
        if not math.isfinite(self.least):
            return ""
        return "> 0" if self.least == TINY else f"≥ {self.shown(self.least) if self.least else 0}"


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
    """Return a dataclass field with its :class:`Row`: a float if `shape` is (), else an array filled with `default`."""
    row = Row(place, key, Numbers(unit, shape), checked, least, largest, meaning)
    if shape == () or default is MISSING:
        return field(default=default, metadata={"row": row})
    lengths = (6,) if isinstance(shape, str) else tuple(length or 0 for length in shape)
    return field(default_factory=lambda: np.full(np.shape(default) or lengths, default), metadata={"row": row})


def rows(schema: Any) -> Iterator[tuple[str, Row, Any]]:
    """Yield field name, row and default of each term of a dataclass; for a required term the default is MISSING."""
    for one in fields(schema):
        if "row" in one.metadata:
            made = one.default if one.default_factory is MISSING else one.default_factory()
            yield one.name, one.metadata["row"], made


def validate_terms(value: Any) -> None:
    """Convert a dataclass's terms to read-only arrays or floats; raise ModelError on a wrong shape or value."""
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
            problem = f"must be {row.least_text}" if row.least else "must not be negative"
            raise ModelError(row.where(name), problem, array.tolist())
        array.flags.writeable = False
        object.__setattr__(value, name, array if shape else float(array))


def check_magnitudes(value: Any, place: str | None = None) -> None:
    """Raise ModelError if a term of the file section `place`, or of any section, exceeds its allowed magnitude."""
    for name, row, _ in rows(type(value)):
        if place in (None, row.place):
            check_magnitude(row.where(name), getattr(value, name), row.largest, row.shown(row.largest))


def check_magnitude(where: str, values: Any, largest: float, bound: str) -> None:
    """Raise ModelError if a value's magnitude exceeds `largest`, SI; the message shows this limit as `bound`."""
    found = float(np.abs(np.asarray(values)).max(initial=0.0))
    if not found <= largest:
        raise ModelError(where, f"must stay within ±{bound}; is the unit right?", found)


def read_terms(schema: Any, section: Section, place: str) -> dict[str, Any]:
    """Read all terms of the file section `place`; return values by field name. A missing key gives the default."""
    values = {}
    for name, row, made in rows(schema):
        if row.place == place:
            key = row.key or name
            values[name] = row.numbers.read(section, key, made)
            if (written := section.written.get(section.where(key))) is not None:
                section.written[row.where(name)] = written
    return values


def write_terms(value: Any, place: str, whole: bool = False) -> dict[str, Any]:
    """Return the content of the file section `place`: the terms that differ from their defaults; if `whole`, all."""
    content: dict[str, Any] = {}
    for name, row, made in rows(type(value)):
        own = getattr(value, name)
        if row.place == place and (whole or made is MISSING or not np.array_equal(own, made)):
            content |= [row.numbers.write(row.key or name, own)]
    return content


def table_text(*schemas: Any) -> str:
    """Return the terms of the given dataclasses as the Markdown table of doc/model_file.md."""
    lines = ["| section | key | shape | default | allowed | meaning |", "|---|---|---|---|---|---|"]
    for name, row, made in (row for schema in schemas for row in rows(schema)):
        shape = row.numbers.shape
        size = shape if isinstance(shape, str) else " × ".join(str(n or "n") for n in shape) or "one number"
        size_in_si = UNITS[DIMENSIONS[row.numbers.unit]][row.numbers.unit]
        usual = np.ravel(0.0 if made is MISSING else made)
        values = usual if len(set(usual.tolist())) > 1 else usual[:1]
        listed = ", ".join(f"{value / size_in_si:g}" for value in values)
        default = "required" if made is MISSING else listed or "none"
        most = f"±{row.shown(row.largest)}" if math.isfinite(row.largest) else ""
        bounds = ", ".join(filter(None, [row.least_text, most]))
        keys = ", ".join(f"`{key}_{row.numbers.unit}`" for key in (row.key or name).split(", "))
        lines.append(f"| {row.place or '–'} | {keys} | {size} | {default} | {bounds} | {row.meaning} |")
    return "\n".join(lines) + "\n"
