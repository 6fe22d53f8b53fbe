"""Schemas of YAML files. A key ends in its unit; numbers are read in SI, and written with the digits that were read.

The schema of a file is a dataclass. A field whose annotation contains a :class:`KeyType` is a key, which is optional if
it has a default. The caller gives the values of all other fields: ``read(Campaign, top, level=...)``. Example::

    @dataclass(frozen=True)
    class Struts:
        stroke: Annotated[np.ndarray, Numbers("mm", (2,))]         # stroke_mm, stroke_in, …; required
        offset: Annotated[np.ndarray, Numbers("um", PER_STRUT)] = field(default_factory=lambda: np.zeros(6))
        outside: Annotated[str, Choice("hold", "refuse")] = "hold"
        wave: Wave | None = None               # a section; Wave is its schema

    struts = read_whole(Struts, section)       # refuses unknown and missing keys, NaN, infinity, wrong shapes
"""

from __future__ import annotations

import difflib
import math
import re
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

from ..errors import GeometryError, InputFileError, ModelError
from .texts import did_you_mean, number_hint

# Largest number of keys that a missing key is compared with: the comparison with half a million keys takes 17 s
MOST_NEIGHBOURS = 1000

POUND = 0.45359237  # kg
POUND_FORCE = POUND * 9.80665  # N
# Unit suffixes of each kind of quantity, and the size of each unit in SI (temperatures remain in degrees Celsius)
UNITS: dict[str, dict[str, float]] = {
    "length": {"m": 1.0, "mm": 1e-3, "um": 1e-6, "in": 0.0254},
    "angle": {"rad": 1.0, "mrad": 1e-3, "urad": 1e-6, "deg": np.pi / 180.0, "arcsec": np.pi / 648000.0},
    "ratio": {"ppm": 1e-6, "percent": 1e-2},
    "expansion": {"ppm_per_K": 1e-6},
    "moisture": {"ppm_per_percent": 1e-4},
    "temperature": {"degC": 1.0},
    "difference": {"K": 1.0},
    "speed": {"m_s": 1.0, "mm_s": 1e-3, "m_min": 1.0 / 60.0, "in_s": 0.0254, "in_min": 0.0254 / 60.0},
    "acceleration": {"m_s2": 1.0, "mm_s2": 1e-3, "in_s2": 0.0254},
    "jerk": {"m_s3": 1.0, "mm_s3": 1e-3, "in_s3": 0.0254},
    "time": {"s": 1.0, "ms": 1e-3},
    "force": {"N": 1.0, "kN": 1e3, "lbf": POUND_FORCE},
    "torque": {"N_m": 1.0},
    "mass": {"kg": 1.0, "g": 1e-3, "lb": POUND},
    "stiffness": {"N_per_um": 1e6, "N_per_mm": 1e3, "lbf_per_in": POUND_FORCE / 0.0254},
    "pressure": {"Pa": 1.0, "hPa": 1e2, "kPa": 1e3},
}

DIMENSIONS = {unit: dimension for dimension, units in UNITS.items() for unit in units}  # kind of quantity of each unit
LARGEST = 1e12  # largest magnitude of a number in a file, in any unit, so that products of numbers remain finite

# Two Unicode characters that look like µ; a file may have either character in place of the u in um and urad
MICROS = "\N{MICRO SIGN}\N{GREEK SMALL LETTER MU}"

INDICES = re.compile(r"(\[\d+\])+$")  # indices into an array at the end of a quantity's name

PER_STRUT = "per strut"  # shape of six numbers, for which a file may give one number for all struts
PAIRS_PER_STRUT = "pairs per strut"  # shape of six pairs, for which a file may give one pair for all struts
Shape = tuple[int | None, ...]  # lengths of an array's axes; None allows any length


@cache
def spellings(dimension: str) -> dict[str, float]:
    """Return the size in SI of each unit of a `dimension`, such as "length", by the unit's name (um also as µm)."""
    units = UNITS[dimension]
    return units | {micro + unit[1:]: size for unit, size in units.items() if unit[0] == "u" for micro in MICROS}


@cache
def decimal_shift(factor: float) -> int:
    """Return the exponent n if `factor` is the power 10ⁿ, otherwise 0."""
    digits = round(math.log10(factor))
    return digits if 10.0**digits == factor else 0


def in_si(values: Any, factor: float) -> Any:
    """Multiply numbers by `factor`, the size of their unit in SI; a `factor` of 10ⁿ causes no rounding."""
    # Without rounding, 12.3 µm in a file becomes exactly the float 12.3e-6.
    digits = decimal_shift(factor)
    if not digits:
        return values * factor
    array = np.asarray(values, dtype=float)
    moved = [float(Decimal(repr(number)).scaleb(digits)) for number in array.ravel().tolist()]
    return np.array(moved).reshape(array.shape)[()]


def in_unit(values: Any, unit: str) -> Any:
    """Convert SI values to a unit, as nested lists of the shortest floats that :func:`in_si` converts back exactly."""
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
        if result is None:  # no float in this unit is read back as `value`: take the float next to `value`
            result = exact(float(in_si(value / factor, factor)))
        return value / factor if result is None else result

    return converted(np.asarray(values, dtype=float).tolist())


class Section:
    """A mapping in a file. Each method that reads a value removes its key; :meth:`finish` refuses remaining keys."""

    def __init__(self, path: str | Path, key: str, content: Any):
        self.path, self.key = path, key  # for messages: the file, and the mapping's key ("" for the whole file)
        if not isinstance(content, dict):
            raise InputFileError(path, key, "must be a mapping of keys to values", content)
        self._remaining = dict(content)
        self._known: set[str] = set()
        # From the name of a quantity in a GeometryError to the quantity's key, unit and value in the file
        self.written: dict[str, tuple[str, str, Any]] = {}

    def __contains__(self, key: str) -> bool:
        self._known.add(key)
        return key in self._remaining

    def where(self, key: str) -> str:
        return f"{self.key}.{key}" if self.key else key

    def error(self, key: str, problem: str, value: Any = None) -> InputFileError:
        """Return (do not raise) an error that names `key`."""
        return InputFileError(self.path, self.where(key), problem, value)

    def require(self, key: str) -> Any:
        """Return the value of a required key without a check of its type."""
        if key not in self:
            raise self.error(key, f"is missing{self._misspelt([key], 0.6)}")
        return self._remaining.pop(key)

    def _misspelt(self, keys: list[str], likeness: float) -> str:
        """Return the question whether a given key is a misspelling of one of `keys`; "" if none is similar."""
        remaining = list(islice(self._remaining, MOST_NEIGHBOURS))
        near = [result for key in keys for result in difflib.get_close_matches(key, remaining, 1, likeness)]
        return f"; is {near[0]!r} a misspelling of it?" if near else ""

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
        return self._inner(self.where(key), self.require(key))

    def _inner(self, key: str, content: Any) -> Section:
        section = Section(self.path, key, content)
        section.written = self.written
        return section

    def sections(self, key: str) -> Iterator[Section]:
        value = self.require(key)
        if not isinstance(value, list):
            raise self.error(key, "must be a list", value)
        for index, item in enumerate(value):
            yield self._inner(f"{self.where(key)}[{index}]", item)

    def array(self, key: str, shape: Shape = ()) -> np.ndarray:
        """Return the finite numbers of a required key; refuse a wrong shape and numbers beyond ±LARGEST."""
        value = self.require(key)
        stack = [(key, value)]  # items of the nested lists that have not been checked yet
        while stack:
            where, item = stack.pop()
            if isinstance(item, list):
                stack.extend((f"{where}[{i}]", part) for i, part in enumerate(item))
            elif isinstance(item, bool) or not isinstance(item, int | float):
                hint = number_hint(item) if isinstance(item, str) else ""
                raise self.error(where, f"must be a number{hint}", item)
        wanted = f"must be {_shape_text(shape)}"
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
        """Return the section's key that is `name` and a unit of `dimension`, as ``stroke_mm``; None if it has none."""
        usual = [f"{name}_{unit}" for unit in UNITS[dimension]]
        self._known.update(usual)
        keys = [f"{name}_{unit}" for unit in spellings(dimension) if f"{name}_{unit}" in self._remaining]
        if name in self._remaining:
            raise self.error(name, f"has no unit; write one of {', '.join(usual)}", self._remaining[name])
        if len(keys) > 1:
            raise self.error(keys[0], f"is given twice, also as {keys[1]}")
        return keys[0] if keys else None

    def quantity(self, name: str, dimension: str, shape: Shape = (), default: Any = None) -> np.ndarray:
        """Return in SI the numbers of the key ``NAME_UNIT`` (``stroke_mm``); `default` if this key is missing."""
        key = self.quantity_key(name, dimension)
        if key is None:
            if default is not None:
                return np.array(default, dtype=float)
            usual = [f"{name}_{unit}" for unit in UNITS[dimension]]
            raise self.error(name, f"is missing; write one of {', '.join(usual)}{self._misspelt(usual, 0.8)}")
        unit, value = key[len(name) + 1 :], self._remaining[key]
        self.written[self.where(name)] = self.where(key), unit, value
        return in_si(self.array(key, shape), spellings(dimension)[unit])

    def per_strut(self, name: str, dimension: str, default: float | None = None) -> np.ndarray:
        """Return one number per strut, shape (6,), SI; the file has one number for all struts, or six numbers."""
        key = self.quantity_key(name, dimension)
        if key is not None and isinstance(self._remaining[key], list):
            return self.quantity(name, dimension, (6,))
        return np.full(6, self.quantity(name, dimension, (), default))

    def pairs_per_strut(self, name: str, dimension: str) -> np.ndarray:
        """Return two numbers per strut, shape (6, 2), SI; the file has one pair for all struts, or six pairs."""
        key = self.quantity_key(name, dimension)
        given = None if key is None else self._remaining[key]
        if isinstance(given, list) and any(isinstance(item, list) for item in given):
            return self.quantity(name, dimension, (6, 2))
        return np.tile(self.quantity(name, dimension, (2,)), (6, 1))

    def as_written(self, error: GeometryError) -> tuple[str, Any]:
        """Return as the file states them the key and value of the quantity that `error`, an exception, states in SI."""
        name = INDICES.sub("", error.key)
        index = error.key.removeprefix(name)
        key, unit, written = self.written.get(self.where(name)) or self.written.get(name) or (name, "", None)
        value = error.value
        if unit and isinstance(value, float | list):
            value = in_unit(value, unit.translate(dict.fromkeys(map(ord, MICROS), "u")))
            if not isinstance(written, list):  # one number for all struts
                return key, written
            if index and isinstance(written[0], list) != isinstance(value, list):  # one pair for all struts
                return key, value
        return key + index, value

    def remaining(self) -> list[str]:
        return list(self._remaining)

    def finish(self) -> None:
        """Raise an InputFileError if a key has not been read, because this key may be misspelt."""
        if self._remaining:
            key = next(iter(self._remaining))
            problem = f"is not a known key here{did_you_mean(key, self._known)}"
            raise self.error(key, problem, self._remaining[key])


def _shape_text(shape: Shape) -> str:
    return "×".join("n" if n is None else str(n) for n in shape) + " numbers" if shape else "a single number"


@contextmanager
def file_errors(file: str | Path | Section) -> Iterator[None]:
    """Convert a GeometryError into an InputFileError; for a Section, its message has key and unit as in the file."""
    try:
        yield
    except GeometryError as error:
        if not isinstance(file, Section):
            raise InputFileError(file, error.key, error.problem, error.value) from error
        key, value = file.as_written(error)
        raise InputFileError(file.path, key, error.problem, value) from error


class KeyType:
    """A type of key in a file: `read_value` takes a section and a key's name, and returns the key's checked value."""

    def __init__(self, read_value: Callable[[Section, str], Any]) -> None:
        self.read_value = read_value

    def read(self, section: Section, name: str, default: Any) -> Any:
        """Return the value of a key, or `default` if the key is absent; a key with the default MISSING is required."""
        return default if default is not MISSING and name not in section else self.read_value(section, name)


@dataclass(frozen=True)
class Numbers(KeyType):
    """A key whose value is a finite number or an array, read in SI; the key's name ends in any unit of the quantity."""

    unit: str  # unit in which the numbers are written to a file; "": the numbers have no unit
    shape: Shape | str = ()  # lengths of the array's axes, or PER_STRUT, or PAIRS_PER_STRUT
    key: str = ""  # name of the key in the file; empty: the name of the field
    positive: bool = False  # whether all numbers must be above 0

    def read(self, section: Section, name: str, default: Any) -> Any:
        if self.key:
            section.written[section.where(name)] = section.where(self.key), "", None
        name = self.key or name
        if default is not MISSING and self.unit and section.quantity_key(name, DIMENSIONS[self.unit]) is None:
            return default
        return super().read(section, name, MISSING if self.unit else default)

    def read_value(self, section: Section, name: str) -> Any:  # type: ignore[override]
        dimension, shape = DIMENSIONS.get(self.unit, ""), self.shape
        if isinstance(shape, str):
            values = (section.per_strut if shape == PER_STRUT else section.pairs_per_strut)(name, dimension)
        else:
            values = section.quantity(name, dimension, shape) if self.unit else section.array(name, shape)
        if self.positive and not (values > 0.0).all():
            raise ModelError(section.where(name), "must be above 0", float(values.min()))
        return values if np.ndim(values) else float(values)

    def write(self, name: str, value: Any) -> tuple[str, Any]:
        if self.shape == PER_STRUT and (value == value[0]).all():
            value = value[0]
        return (f"{name}_{self.unit}", in_unit(value, self.unit)) if self.unit else (name, np.asarray(value).tolist())


def Integer(low: int, high: int) -> KeyType:
    """A key whose value is a whole number from `low` to `high`."""

    def read_value(section: Section, name: str) -> int:
        value = section.integer(name)
        if not low <= value <= high:
            raise section.error(name, f"must be {low} to {high}", value)
        return value

    return KeyType(read_value)


def Choice(*words: Any) -> KeyType:
    """A key whose value is one of `words`."""
    return KeyType(lambda section, name: section.choice(name, words))


def Text() -> KeyType:
    """A key whose value is a text that is not empty."""
    return KeyType(Section.text)


def Names(*counts: int, what: str = "column names") -> KeyType:
    """A key whose value is a list of names; `counts` has the allowed numbers of names, () allows any above 0."""

    def read_value(section: Section, name: str) -> tuple[str, ...]:
        given = section.require(name)
        well = isinstance(given, list) and given and all(isinstance(text, str) and text.strip() for text in given)
        if not well or (counts and len(given) not in counts):
            count = f"{' or '.join(map(str, counts))} " if counts else ""
            raise section.error(name, f"must be a list of {count}{what}", given)
        return tuple(given)

    return KeyType(read_value)


def Unit(dimension: str) -> KeyType:
    """A key whose value is the name of a unit; reading the key returns the size of this unit in SI."""
    return KeyType(lambda section, name: section.unit(name, dimension))


def _nested(schema: Any) -> KeyType:
    return KeyType(lambda section, name: read_whole(schema, section.section(name)))


@cache
def keys_of(schema: type) -> dict[str, tuple[Any, Any]]:
    """Return type and default of each key of a schema by field name; a key with the default MISSING is required."""
    hints, keys = get_type_hints(schema, include_extras=True), {}
    for one in fields(schema):
        if (key_type := _key_type(hints[one.name])) is not None:
            keys[one.name] = key_type, one.default if one.default_factory is MISSING else one.default_factory()
    return keys


def _key_type(hint: Any) -> Any:
    """Return the KeyType in a field's annotation; None if the field is not a key of the file."""
    if get_origin(hint) is Annotated:
        return next((found for found in get_args(hint)[1:] if isinstance(found, KeyType)), None)
    if get_origin(hint) in (Union, UnionType):
        return next((found for part in get_args(hint) if (found := _key_type(part)) is not None), None)
    return _nested(hint) if is_dataclass(hint) and keys_of(hint) else None  # type: ignore[arg-type]


T = TypeVar("T")


def read(schema: Callable[..., T], section: Section, **given: Any) -> T:
    """Return an instance of `schema`; a field's value is that in `given` or, if it is not given, that in `section`."""
    keys: dict[str, tuple[Any, Any]] = keys_of(schema)  # type: ignore[arg-type]
    with file_errors(section):
        own = {name: one.read(section, name, default) for name, (one, default) in keys.items() if name not in given}
        return schema(**own, **given)


def read_whole(schema: Callable[..., T], section: Section, **given: Any) -> T:
    """Read a section as :func:`read` does, and refuse unknown keys."""
    result = read(schema, section, **given)
    section.finish()
    return result
