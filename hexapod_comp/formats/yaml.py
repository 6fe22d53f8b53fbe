"""YAML files with units in their key names, read strictly: what is unknown, missing or not finite is refused.

A quantity's key ends in its unit (``stroke_mm``, ``lead_in``); :class:`Section` turns it into SI and
remembers where it stood, so that every complaint names file, key and value.
"""

from __future__ import annotations

import difflib
import math
import re
from collections.abc import Iterator
from decimal import Decimal
from functools import cache
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from ..errors import InputFileError, shorten
from .files import read_text
from .texts import number_hint

MAX_DEPTH = 32
"""Deeper nested YAML is refused: a model needs five levels, and the parser's own stack ends at some thousand."""

MAX_NODES = 200_000
"""YAML of more values, keys and lists is refused: each takes 10 µs and 600 bytes. A field of 20 × 20 lines along each
axis, forward and backward, with six polynomials of the fifth order, has 120,000."""

MOST_NEIGHBOURS = 1000
"""Keys looked through for the one that a misspelt key may mean: in a hostile file that would take minutes."""

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
    "time": {"s": 1.0, "ms": 1e-3},
    "pressure": {"Pa": 1.0, "hPa": 1e2, "kPa": 1e3},
}
"""Unit suffixes per kind of quantity, and their size in SI (temperatures stay in degrees Celsius)."""

LARGEST = 1e12
"""No number of a file is larger, in whatever unit: products of several stay finite."""

MICROS = "\N{MICRO SIGN}\N{GREEK SMALL LETTER MU}"
"""They look alike, and either may be on a keyboard: both stand for the u of um and urad."""


@cache
def spellings(dimension: str) -> dict[str, float]:
    """Return the units of a kind of quantity with their sizes, by every spelling: µm and μm too, where um is."""
    units = UNITS[dimension]
    return units | {micro + unit[1:]: size for unit, size in units.items() if unit[0] == "u" for micro in MICROS}


AMBIGUOUS_NUMBER = re.compile(r"[-+]?0[0-9A-Za-z]|.*[:_]")
"""Numbers that YAML 1.1 takes for something else than people do: 0400 is 256, 1:30 is 90, 0x10 is 16."""


class _StrictLoader(getattr(yaml, "CSafeLoader", yaml.SafeLoader)):  # type: ignore[misc]
    """Safe loader that refuses a key given twice, and numbers that mislead."""


def _mapping_without_duplicates(loader: Any, node: yaml.MappingNode) -> dict:
    seen: set[Any] = set()
    for key_node, _ in node.value:
        key = loader.construct_object(key_node, deep=True)
        if not isinstance(key, str):
            raise _complaint(f"key {shorten(key)} is not text", key_node)
        if key in seen:
            raise _complaint(f"key {shorten(key)} is given twice", key_node)
        seen.add(key)
    return loader.construct_mapping(node, deep=True)


def _complaint(problem: str, node: yaml.Node | yaml.Event) -> yaml.YAMLError:
    """Return (not raise) an error that says where in the text it is."""
    return yaml.constructor.ConstructorError(None, None, problem, node.start_mark)


def _plain_number(loader: Any, node: yaml.ScalarNode) -> int | float:
    text = loader.construct_scalar(node)
    if AMBIGUOUS_NUMBER.match(text):
        raise _complaint(f"{shorten(text)} is not a plain decimal number", node)
    try:
        return int(text) if node.tag.endswith(":int") else loader.construct_yaml_float(node)
    except ValueError as error:  # Python reads no whole number of more than 4300 digits
        raise _complaint(f"{shorten(text)} is too long for a number", node) from error


def _date(loader: Any, node: yaml.ScalarNode) -> Any:
    try:
        return loader.construct_yaml_timestamp(node)
    except ValueError as error:
        raise _complaint(f"{shorten(node.value)} is no date: {error}", node) from error


_StrictLoader.add_constructor(yaml.resolver.BaseResolver.DEFAULT_MAPPING_TAG, _mapping_without_duplicates)
_StrictLoader.add_constructor("tag:yaml.org,2002:timestamp", _date)
for _tag in ("tag:yaml.org,2002:int", "tag:yaml.org,2002:float"):
    _StrictLoader.add_constructor(_tag, _plain_number)


def read_yaml(path: str | Path, file_format: str, version: int) -> Section:
    """Read a YAML file as :func:`parse_yaml` does its text."""
    return parse_yaml(read_text(path), path, file_format, version)


def parse_yaml(text: str, name: str | Path, file_format: str, version: int) -> Section:
    """Parse YAML with the safe loader and check its `format` and `version` lines.

    Parameters
    ----------
    text : str
        All of it.
    name : str or Path
        Where it comes from, for messages.
    file_format : str
        Expected value of the key ``format``.
    version : int
        Expected value of the key ``version``.

    Returns
    -------
    Section
        The top level, from which ``format`` and ``version`` have been taken.

    Raises
    ------
    InputFileError
        Not YAML, another format or version.
    """
    content = yaml_content(text, name)
    if not isinstance(content, dict):
        raise InputFileError(name, "", "must hold keys and values at its top level", content)
    section = Section(name, "", content)
    given = section.text("format")
    if given != file_format:
        raise section.error("format", f"must be {file_format!r}", given)
    given_version = section.take("version")
    if type(given_version) is not int or given_version != version:
        raise section.error("version", f"only version {version} is understood", given_version)
    return section


def yaml_content(text: str, name: str | Path, most_nodes: int = MAX_NODES) -> Any:
    """Return what YAML holds: plain values, lists and mappings, not too many and not too deep.

    Raises
    ------
    InputFileError
        Not YAML; with references or tags; a key given twice or no text; too large. Names the line.
    """
    try:
        _refuse_tricks(text, most_nodes)
        return yaml.load(text, Loader=_StrictLoader)
    except (yaml.YAMLError, ValueError, RecursionError) as error:
        problem = getattr(error, "problem", None) or type(error).__name__
        mark = getattr(error, "problem_mark", None)
        where = f"line {mark.line + 1}" if mark is not None else ""
        if mark is not None and "".join(text.split("\n")[mark.line : mark.line + 1]).lstrip(" ").startswith("\t"):
            problem += "; YAML is indented by spaces, not by tabs"
        raise InputFileError(name, where, f"is not valid YAML: {problem}") from error


def _refuse_tricks(text: str, most_nodes: int) -> None:
    """Raise on what lets a short file stand for something else, before anything is made of it.

    Nested references (``*name``) stand for more values than memory holds, and so do short lists; nesting overflows the
    parser's stack and ends the process, a tag (``!!float``) makes the loader read a value as another type.
    """
    depth = nodes = 0
    for event in yaml.parse(text, Loader=_StrictLoader):
        if isinstance(event, yaml.AliasEvent):
            raise _complaint(f"reference *{event.anchor} is not understood; write the value out", event)
        if getattr(event, "tag", None) is not None:
            raise _complaint(f"tag {shorten(event.tag)} is not understood; write the plain value", event)
        depth += isinstance(event, yaml.CollectionStartEvent) - isinstance(event, yaml.CollectionEndEvent)
        nodes += isinstance(event, yaml.NodeEvent)
        if nodes > most_nodes:
            raise _complaint(f"holds more than the allowed {most_nodes} values", event)
        if depth > MAX_DEPTH:
            raise _complaint(f"is nested more than {MAX_DEPTH} deep", event)


class Section:
    """One mapping of a YAML file; values are taken out, and whatever stays behind is an error.

    Parameters
    ----------
    path : str or Path
        File, for messages.
    key : str
        Key path of this mapping inside the file, empty at the top.
    content : dict
        The mapping.
    """

    def __init__(self, path: str | Path, key: str, content: Any):
        self.path, self.key = path, key
        if not isinstance(content, dict):
            raise InputFileError(path, key, "must be a mapping of keys to values", content)
        self._left = dict(content)
        self._known: set[str] = set()

    def __contains__(self, key: str) -> bool:
        self._known.add(key)
        return key in self._left

    def where(self, key: str) -> str:
        """Return the full key path of `key`."""
        return f"{self.key}.{key}" if self.key else key

    def error(self, key: str, problem: str, value: Any = None) -> InputFileError:
        """Return (not raise) an error about `key`."""
        return InputFileError(self.path, self.where(key), problem, value)

    def _meant(self, name: str, dimension: str) -> str:
        """Return which key may mean a quantity, to follow the complaint that it is missing."""
        wanted = [f"{name}_{unit}" for unit in UNITS[dimension]]
        left = list(islice(self._left, MOST_NEIGHBOURS))
        near = [key for one in wanted for key in difflib.get_close_matches(one, left, 1, 0.8)]
        return f"; did you mean it by {near[0]!r}?" if near else ""

    def take(self, key: str) -> Any:
        """Take a required value of any kind."""
        self._known.add(key)
        if key not in self._left:
            near = difflib.get_close_matches(key, islice(self._left, MOST_NEIGHBOURS), 1)
            raise self.error(key, "is missing" + (f"; did you mean it by {near[0]!r}?" if near else ""))
        return self._left.pop(key)

    def text(self, key: str) -> str:
        """Take a required non-empty string."""
        value = self.take(key)
        if not isinstance(value, str) or not value.strip():
            raise self.error(key, "must be text", value)
        return value

    def choice(self, key: str, allowed: tuple[str, ...], default: str | None = None) -> str:
        """Take one of the `allowed` words."""
        if default is not None and key not in self._left:
            return default
        value = self.take(key)
        if value not in allowed:
            raise self.error(key, f"must be one of {', '.join(allowed)}", value)
        return value

    def unit(self, key: str, dimension: str) -> float:
        """Take the name of a unit; return its size in SI."""
        value = self.take(key)
        if not isinstance(value, str) or value not in spellings(dimension):
            raise self.error(key, f"must be one of {', '.join(UNITS[dimension])}", value)
        return spellings(dimension)[value]

    def integer(self, key: str, default: int) -> int:
        """Take an optional whole number."""
        self._known.add(key)
        value = self._left.pop(key, default)
        if type(value) is not int:
            raise self.error(key, "must be a whole number", value)
        return value

    def section(self, key: str) -> Section:
        """Take a required sub-mapping."""
        return Section(self.path, self.where(key), self.take(key))

    def sections(self, key: str) -> Iterator[Section]:
        """Take a list of sub-mappings."""
        value = self.take(key)
        if not isinstance(value, list):
            raise self.error(key, "must be a list", value)
        for index, item in enumerate(value):
            yield Section(self.path, f"{self.where(key)}[{index}]", item)

    def array(self, key: str, shape: tuple[int | None, ...] = ()) -> np.ndarray:
        """Take finite numbers of a given shape (``None`` leaves a length free).

        Raises
        ------
        InputFileError
            Not numbers, NaN, infinite, or another shape.
        """
        value = self.take(key)
        _refuse_non_numbers(self, key, value)
        try:
            array = np.array(value, dtype=float)
        except (TypeError, ValueError, OverflowError) as error:
            raise self.error(key, f"must be numbers of shape {_shape_text(shape)}", value) from error
        if array.ndim != len(shape) or any(n is not None and n != m for n, m in zip(shape, array.shape, strict=True)):
            raise self.error(key, f"must be numbers of shape {_shape_text(shape)}, not {_shape_text(array.shape)}")
        if not np.isfinite(array).all():
            bad = np.argwhere(~np.isfinite(array))[0]
            index = "".join(f"[{i}]" for i in bad)
            raise self.error(key + index, "must be finite", float(array[tuple(bad)]))
        if (np.abs(array) > LARGEST).any():
            raise self.error(key, f"must be numbers within ±{LARGEST:g}", float(array.flat[np.abs(array).argmax()]))
        return array

    def quantity_key(self, name: str, dimension: str) -> str | None:
        """Return the key that carries `name` with a unit of `dimension`, or None when there is none."""
        self._known.update(f"{name}_{unit}" for unit in UNITS[dimension])
        keys = [f"{name}_{unit}" for unit in spellings(dimension) if f"{name}_{unit}" in self._left]
        if name in self._left:
            units = ", ".join(f"{name}_{unit}" for unit in UNITS[dimension])
            raise self.error(name, f"has no unit; write one of {units}", self._left[name])
        if len(keys) > 1:
            raise self.error(keys[0], f"is given twice, also as {keys[1]}")
        return keys[0] if keys else None

    def quantity(
        self,
        name: str,
        dimension: str,
        shape: tuple[int | None, ...] = (),
        default: Any = None,
    ) -> np.ndarray:
        """Take numbers with a unit and return them in SI.

        Parameters
        ----------
        name : str
            Key without its unit: ``stroke`` finds ``stroke_mm``, ``stroke_m``, …
        dimension : str
            Key of :data:`UNITS`.
        shape : tuple
            Expected shape; ``None`` leaves a length free.
        default : array_like, optional
            Returned (in SI) when no such key is there; without it the key is required.
        """
        key = self.quantity_key(name, dimension)
        if key is None:
            if default is not None:
                return np.array(default, dtype=float)
            units = ", ".join(f"{name}_{unit}" for unit in UNITS[dimension])
            raise self.error(name, f"is missing; write one of {units}{self._meant(name, dimension)}")
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
        """Return the keys that nobody has asked for yet."""
        return list(self._left)

    def finish(self) -> None:
        """Raise if keys are left that nobody asked for: a misspelt key must not be lost in silence."""
        if self._left:
            key = next(iter(self._left))
            near = difflib.get_close_matches(key, sorted(self._known), 1)
            hint = f"; did you mean {near[0]!r}?" if near else ""
            raise self.error(key, f"is not a known key here{hint}", self._left[key])


def in_si(values: Any, factor: float) -> Any:
    """Return numbers in SI from their unit's size, moving the decimal point where that is all there is to do.

    So 12.3 µm in a file is the very float that 12.3e-6 is in source code, not its neighbour.
    """
    digits = round(math.log10(factor))
    if digits == 0 or 10.0**digits != factor:
        return values * factor
    array = np.asarray(values, dtype=float)
    moved = [float(Decimal(repr(number)).scaleb(digits)) for number in array.ravel().tolist()]
    return np.array(moved).reshape(array.shape)[()]


def _refuse_non_numbers(section: Section, key: str, value: Any) -> None:
    """Raise on text, booleans or mappings anywhere inside nested lists."""
    stack = [(key, value)]
    while stack:
        where, item = stack.pop()
        if isinstance(item, list):
            stack.extend((f"{where}[{i}]", part) for i, part in enumerate(item))
        elif isinstance(item, bool) or not isinstance(item, int | float):
            hint = number_hint(item) if isinstance(item, str) else ""
            raise section.error(where, f"must be a number{hint}", item)


def _shape_text(shape: tuple[int | None, ...]) -> str:
    return "×".join("n" if n is None else str(n) for n in shape) or "a single number"
