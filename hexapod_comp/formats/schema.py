"""Schemas of YAML files: keys that end in their unit, read strictly into SI, and written back to the same numbers.

A file's schema is a dataclass. The annotation of a field defines its key; a field with a default is optional::

    @dataclass(frozen=True)
    class Struts:
        stroke: Annotated[np.ndarray, Numbers("mm", (2,))]         # stroke_mm, stroke_in, …; required
        offset: Annotated[np.ndarray, Numbers("um", PER_STRUT)] = field(default_factory=lambda: np.zeros(6))
        outside: Annotated[str, Choice("hold", "refuse")] = "hold"
        wave: Wave | None = None               # a section with a schema of its own

    struts = read(Struts, section) # unknown, missing, not finite values and those of another shape are refused

Fields without an annotation of this module are not keys: ``read(Campaign, top, level=...)`` gives them, and may give
others in place of the file. :class:`Section` is the mapping that is read: values are taken out, and a remaining key is
an error.
"""

from __future__ import annotations

import difflib
import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import MISSING, dataclass, fields, is_dataclass
from decimal import Decimal
from functools import cache
from itertools import islice
from pathlib import Path
from types import UnionType
from typing import Annotated, Any, TypeVar, Union, get_args, get_origin, get_type_hints

import numpy as np

from ..errors import GeometryError, InputFileError
from .texts import number_hint

# Keys compared with a misspelt key: in a hostile file more would take minutes
MOST_NEIGHBOURS = 1000

# Unit suffixes per kind of quantity, and their size in SI (temperatures stay in degrees Celsius)
UNITS: dict[str, dict[str, float]] = {
    "length": {"m": 1.0, "mm": 1e-3, "um": 1e-6, "in": 0.0254},
    "angle": {"rad": 1.0, "mrad": 1e-3, "urad": 1e-6, "deg": np.pi / 180.0, "arcsec": np.pi / 648000.0},
    "ratio": {"ppm": 1e-6, "percent": 1e-2},
    "expansion": {"ppm_per_K": 1e-6},
    "moisture": {"ppm_per_percent": 1e-4},
    "temperature": {"degC": 1.0},
    "difference": {"K": 1.0},
    "speed": {"m_s": 1.0, "mm_s": 1e-3, "m_min": 1.0 / 60.0},
    "acceleration": {"m_s2": 1.0, "mm_s2": 1e-3},
    "jerk": {"m_s3": 1.0, "mm_s3": 1e-3},
    "time": {"s": 1.0, "ms": 1e-3},
    "force": {"N": 1.0, "kN": 1e3},
    "torque": {"N_m": 1.0},
    "mass": {"kg": 1.0, "g": 1e-3},
    "stiffness": {"N_per_um": 1e6, "N_per_mm": 1e3},
    "pressure": {"Pa": 1.0, "hPa": 1e2, "kPa": 1e3},
}

DIMENSIONS = {unit: dimension for dimension, units in UNITS.items() for unit in units}  # kind of quantity of each unit
LARGEST = 1e12  # bound of the numbers in a file, in any unit: products of several stay finite

# They look alike, and either may be on a keyboard: both replace the u of um and urad
MICROS = "\N{MICRO SIGN}\N{GREEK SMALL LETTER MU}"

PER_STRUT = "per strut"  # shape of six numbers that may be given as one for all
PAIRS_PER_STRUT = "pairs per strut"  # and of six pairs that may be given as one
Shape = tuple[int | None, ...]  # lengths of an array's axes; None leaves one free


@cache
def spellings(dimension: str) -> dict[str, float]:
    """Return a quantity's units with their sizes in SI: those with the prefix u also with both characters µ."""
    units = UNITS[dimension]
    return units | {micro + unit[1:]: size for unit, size in units.items() if unit[0] == "u" for micro in MICROS}


def in_si(values: Any, factor: float) -> Any:
    """Return numbers in SI from their unit's size, by moving the decimal point where that suffices."""
    # So 12.3 µm in a file is the float 12.3e-6 of source code, not its neighbour.
    digits = round(math.log10(factor))
    if digits == 0 or 10.0**digits != factor:
        return values * factor
    array = np.asarray(values, dtype=float)
    moved = [float(Decimal(repr(number)).scaleb(digits)) for number in array.ravel().tolist()]
    return np.array(moved).reshape(array.shape)[()]


def in_unit(values: Any, unit: str) -> Any:
    """Return SI values in a unit, as nested lists of the shortest floats that read back to the same values."""
    factor = UNITS[DIMENSIONS[unit]][unit]

    def exact(value: float) -> float | None:
        quotient = value / factor
        candidates = [float(f"{quotient:.{digits}g}") for digits in (15, 16, 17)]
        candidates += [math.nextafter(quotient, math.inf), math.nextafter(quotient, -math.inf)]
        return next((number + 0.0 for number in candidates if in_si(number, factor) == value), None)

    def converted(value: Any) -> Any:
        if isinstance(value, list):
            return [converted(item) for item in value]
        result = exact(value)
        if result is None:  # no float reads back as this one: the neighbour that will be read instead
            result = exact(float(in_si(value / factor, factor)))
        return value / factor if result is None else result

    return converted(np.asarray(values, dtype=float).tolist())


class Section:
    """One mapping of a file: values are taken out by key, and a remaining key is an error."""

    def __init__(self, path: str | Path, key: str, content: Any):
        self.path, self.key = path, key  # file and place in it, for messages; no place at its top
        if not isinstance(content, dict):
            raise InputFileError(path, key, "must be a mapping of keys to values", content)
        self._left = dict(content)
        self._known: set[str] = set()

    def __contains__(self, key: str) -> bool:
        self._known.add(key)
        return key in self._left

    def where(self, key: str) -> str:
        return f"{self.key}.{key}" if self.key else key

    def error(self, key: str, problem: str, value: Any = None) -> InputFileError:
        """Return (not raise) an error about `key`."""
        return InputFileError(self.path, self.where(key), problem, value)

    def require(self, key: str) -> Any:
        """Take a required value of any kind."""
        if key not in self:
            raise self.error(key, f"is missing{self._meant([key], 0.6)}")
        return self._left.pop(key)

    def _meant(self, keys: list[str], likeness: float) -> str:
        """Return the missing key that was probably meant, to append to a message."""
        left = list(islice(self._left, MOST_NEIGHBOURS))
        near = [result for key in keys for result in difflib.get_close_matches(key, left, 1, likeness)]
        return f"; did you mean it by {near[0]!r}?" if near else ""

    def text(self, key: str) -> str:
        value = self.require(key)
        if not isinstance(value, str) or not value.strip():
            raise self.error(key, "must be text", value)
        return value

    def choice(self, key: str, allowed: tuple[Any, ...], default: Any = None) -> Any:
        if default is not None and key not in self:
            return default
        value = self.require(key)
        if not any(value == one and type(value) is type(one) for one in allowed):
            raise self.error(key, f"must be one of {', '.join(map(str, allowed))}", value)
        return value

    def unit(self, key: str, dimension: str) -> float:
        value = self.require(key)
        if not isinstance(value, str) or value not in spellings(dimension):
            raise self.error(key, f"must be one of {', '.join(UNITS[dimension])}", value)
        return spellings(dimension)[value]

    def integer(self, key: str, default: int | None = None) -> int:
        value = default if default is not None and key not in self else self.require(key)
        if type(value) is not int:
            raise self.error(key, "must be a whole number", value)
        return value

    def section(self, key: str) -> Section:
        return Section(self.path, self.where(key), self.require(key))

    def sections(self, key: str) -> Iterator[Section]:
        value = self.require(key)
        if not isinstance(value, list):
            raise self.error(key, "must be a list", value)
        for index, item in enumerate(value):
            yield Section(self.path, f"{self.where(key)}[{index}]", item)

    def array(self, key: str, shape: Shape = ()) -> np.ndarray:
        """Take finite numbers of a given shape."""
        value = self.require(key)
        stack = [(key, value)]  # text, booleans or mappings anywhere inside nested lists are refused
        while stack:
            where, item = stack.pop()
            if isinstance(item, list):
                stack.extend((f"{where}[{i}]", part) for i, part in enumerate(item))
            elif isinstance(item, bool) or not isinstance(item, int | float):
                hint = number_hint(item) if isinstance(item, str) else ""
                raise self.error(where, f"must be a number{hint}", item)
        wanted = f"must be numbers of shape {_shape_text(shape)}"
        try:
            array = np.array(value, dtype=float)
        except (TypeError, ValueError, OverflowError) as error:
            raise self.error(key, wanted, value) from error
        if array.ndim != len(shape) or any(n not in (None, m) for n, m in zip(shape, array.shape, strict=True)):
            raise self.error(key, f"{wanted}, not {_shape_text(array.shape)}")
        if not np.isfinite(array).all():
            bad = np.argwhere(~np.isfinite(array))[0]
            raise self.error(key + "".join(f"[{i}]" for i in bad), "must be finite", float(array[tuple(bad)]))
        if (np.abs(array) > LARGEST).any():
            raise self.error(key, f"must be numbers within ±{LARGEST:g}", float(array.flat[np.abs(array).argmax()]))
        return array

    def quantity_key(self, name: str, dimension: str) -> str | None:
        """Return the key that carries `name` with a unit of `dimension`, or None when there is none."""
        usual = [f"{name}_{unit}" for unit in UNITS[dimension]]
        self._known.update(usual)
        keys = [f"{name}_{unit}" for unit in spellings(dimension) if f"{name}_{unit}" in self._left]
        if name in self._left:
            raise self.error(name, f"has no unit; write one of {', '.join(usual)}", self._left[name])
        if len(keys) > 1:
            raise self.error(keys[0], f"is given twice, also as {keys[1]}")
        return keys[0] if keys else None

    def quantity(self, name: str, dimension: str, shape: Shape = (), default: Any = None) -> np.ndarray:
        """Take numbers with a unit: ``stroke`` finds ``stroke_mm``, …; in SI; the default if they are absent."""
        key = self.quantity_key(name, dimension)
        if key is None:
            if default is not None:
                return np.array(default, dtype=float)
            usual = [f"{name}_{unit}" for unit in UNITS[dimension]]
            raise self.error(name, f"is missing; write one of {', '.join(usual)}{self._meant(usual, 0.8)}")
        return in_si(self.array(key, shape), spellings(dimension)[key[len(name) + 1 :]])

    def per_strut(self, name: str, dimension: str, default: float | None = None) -> np.ndarray:
        """Take a quantity given once for all struts or as a list of six; return shape (6,), SI."""
        key = self.quantity_key(name, dimension)
        if key is not None and isinstance(self._left[key], list):
            return self.quantity(name, dimension, (6,))
        return np.full(6, self.quantity(name, dimension, (), default))

    def pairs_per_strut(self, name: str, dimension: str) -> np.ndarray:
        """Take one pair for all struts or six pairs; return shape (6, 2), SI."""
        key = self.quantity_key(name, dimension)
        given = None if key is None else self._left[key]
        if isinstance(given, list) and any(isinstance(item, list) for item in given):
            return self.quantity(name, dimension, (6, 2))
        return np.tile(self.quantity(name, dimension, (2,)), (6, 1))

    def left(self) -> list[str]:
        return list(self._left)

    def finish(self) -> None:
        """Raise if keys remain: a misspelt key must not be ignored silently."""
        if self._left:
            key = next(iter(self._left))
            near = difflib.get_close_matches(key, sorted(self._known), 1)
            hint = f"; did you mean {near[0]!r}?" if near else ""
            raise self.error(key, f"is not a known key here{hint}", self._left[key])


def _shape_text(shape: Shape) -> str:
    return "×".join("n" if n is None else str(n) for n in shape) or "a single number"


@contextmanager
def file_errors(path: str | Path) -> Iterator[None]:
    """Convert a dataclass's error about its values (GeometryError, ModelError) into one that names the file."""
    try:
        yield
    except GeometryError as error:
        raise InputFileError(path, error.key, error.problem, error.value) from error


# What a key holds.


class Kind:
    """How a key's value is taken from a section; `take` gets the section and the key's name."""

    def __init__(self, take: Callable[[Section, str], Any]) -> None:
        self.take = take

    def read(self, section: Section, name: str, default: Any) -> Any:
        """Return the value of a key; the default if it is absent, unless that is MISSING."""
        return default if default is not MISSING and name not in section else self.take(section, name)


@dataclass(frozen=True)
class Numbers(Kind):
    """Finite numbers: in SI where they have a unit, and read in any unit of its kind; plain ones with unit ""."""

    unit: str  # in which it is written
    shape: Shape | str = ()  # or PER_STRUT, PAIRS_PER_STRUT
    key: str = ""  # key in the file, where it is not the field's name

    def read(self, section: Section, name: str, default: Any) -> Any:
        name = self.key or name
        if default is not MISSING and self.unit and section.quantity_key(name, DIMENSIONS[self.unit]) is None:
            return default
        return super().read(section, name, MISSING if self.unit else default)

    def take(self, section: Section, name: str) -> Any:  # type: ignore[override]
        if isinstance(self.shape, str):
            read_in = section.per_strut if self.shape == PER_STRUT else section.pairs_per_strut
            return read_in(name, DIMENSIONS[self.unit])
        values = (
            section.quantity(name, DIMENSIONS[self.unit], self.shape) if self.unit else section.array(name, self.shape)
        )
        return values if np.ndim(values) else float(values)

    def write(self, name: str, value: Any) -> tuple[str, Any]:
        if self.shape == PER_STRUT and (value == value[0]).all():
            value = value[0]
        return (f"{name}_{self.unit}", in_unit(value, self.unit)) if self.unit else (name, np.asarray(value).tolist())


def Integer(low: int, high: int) -> Kind:
    """Return the kind of whole numbers within bounds."""

    def take(section: Section, name: str) -> int:
        value = section.integer(name)
        if not low <= value <= high:
            raise section.error(name, f"must be {low} to {high}", value)
        return value

    return Kind(take)


def Choice(*words: Any) -> Kind:
    """Return the kind of what must be one of the listed words or numbers."""
    return Kind(lambda section, name: section.choice(name, words))


def Text() -> Kind:
    """Return the kind of texts that are not empty."""
    return Kind(Section.text)


def Names(*counts: int, what: str = "column names") -> Kind:
    """Return the kind of lists of names, as of columns; where counts are given, of one of these lengths."""

    def take(section: Section, name: str) -> tuple[str, ...]:
        given = section.require(name)
        well = isinstance(given, list) and given and all(isinstance(text, str) and text.strip() for text in given)
        if not well or (counts and len(given) not in counts):
            count = f"{' or '.join(map(str, counts))} " if counts else ""
            raise section.error(name, f"must be a list of {count}{what}", given)
        return tuple(given)

    return Kind(take)


def Unit(dimension: str) -> Kind:
    """Return the kind of names of units; a unit's size in SI is stored."""
    return Kind(lambda section, name: section.unit(name, dimension))


def _nested(schema: Any) -> Kind:
    return Kind(lambda section, name: read_whole(schema, section.section(name)))


@cache
def keys_of(schema: type) -> dict[str, tuple[Any, Any]]:
    """Return the kind of each field of a schema, by its annotation, and its default (MISSING: the key is required)."""
    hints, keys = get_type_hints(schema, include_extras=True), {}
    for one in fields(schema):
        if (kind := _kind(hints[one.name])) is not None:
            keys[one.name] = kind, one.default if one.default_factory is MISSING else one.default_factory()
    return keys


def _kind(hint: Any) -> Any:
    """Return the meaning of an annotation: a kind, a schema, or None or one of these; else None."""
    if get_origin(hint) is Annotated:
        return next((kind for kind in get_args(hint)[1:] if isinstance(kind, Kind)), None)
    if get_origin(hint) in (Union, UnionType):
        return next((kind for part in get_args(hint) if (kind := _kind(part)) is not None), None)
    return _nested(hint) if is_dataclass(hint) and keys_of(hint) else None  # type: ignore[arg-type]


T = TypeVar("T")


def read(schema: Callable[..., T], section: Section, **given: Any) -> T:
    """Return the content of a section; fields that are `given` are not read from it."""
    keys: dict[str, tuple[Any, Any]] = keys_of(schema)  # type: ignore[arg-type]
    values = {name: kind.read(section, name, default) for name, (kind, default) in keys.items() if name not in given}
    with file_errors(section.path):
        return schema(**values, **given)


def read_whole(schema: Callable[..., T], section: Section, **given: Any) -> T:
    """Return the content of a section, as :func:`read`; unknown keys are refused."""
    result = read(schema, section, **given)
    section.finish()
    return result
