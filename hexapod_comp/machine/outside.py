"""Tables of the tool's error as a function of one or two external quantities: the block ``outside`` of a model."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import InputFileError, ModelError, OutsideTableError
from ..formats.csv import LABEL_COLUMNS, Table, grid_order
from ..formats.schema import DIMENSIONS, Section, in_si, in_unit, spellings
from .field import OUTSIDE_POLICIES
from .terms import read_terms, term, validate_terms, write_terms

# A value outside its table by more than this share of the table's span is refused: it is probably in another unit. For
# example, a table over 0 to 90° refuses values above 1.96 rad, so it refuses most values in degrees
BELIEVED_BEYOND = 0.25
ON_THE_EDGE = 1e-6  # A value outside by less than this share of the span counts as inside, as the values may be rounded
UNIT_NAMES = {name: size for dimension in set(DIMENSIONS.values()) for name, size in spellings(dimension).items()}
MOST_NODES = 10_000  # Largest number of nodes of a table; a table with more nodes is probably a mistake
POSITION, ROTATION = ("x", "y", "z"), ("rx", "ry", "rz")


@dataclass(frozen=True)
class OutsideTable:
    """Table of the tool's error at a grid of values of one or two external quantities, such as a telescope's elevation.

    The table's error applies at the tool's measured point, as the error field's does; the errors of both are added.

    Parameters
    ----------
    names : tuple of str
        Names of the one or two quantities; empty if there is no table.
    units : tuple of str
        Unit of each quantity in files and messages: ``deg``, ``degC``, ….
    nodes : tuple of ndarray
        Increasing values of each quantity, SI or °C.
    displacement, rotation : ndarray, shape (nodes, 3)
        Displacement, m, and rotation vector, rad, in ``base`` for each node; the last quantity varies fastest.
    beyond : str
        For quantities outside the table, ``hold`` uses the error at the table's edge, and ``refuse`` refuses commands.

    Raises
    ------
    ModelError
        A value is invalid; the message names key, value and what is allowed.
    """

    names: tuple[str, ...] = ()
    units: tuple[str, ...] = ()
    nodes: tuple[np.ndarray, ...] = ()
    displacement: np.ndarray = term(
        "outside", "um", "displacement of the measured point, in base: a row per node", (None, 3), largest=0.05
    )
    rotation: np.ndarray = term(
        "outside", "urad", "rotation vector about the measured point, in base: a row per node", (None, 3), largest=0.1
    )
    beyond: str = "hold"

    def __post_init__(self) -> None:
        nodes = tuple(np.array(axis, dtype=float) for axis in self.nodes)
        if not len(self.names) == len(self.units) == len(nodes) <= 2 or len(set(self.names)) != len(self.names):
            raise ModelError("outside.axes", "must be one or two, each with its own name and unit", list(self.names))
        for name, unit, axis in zip(self.names, self.units, nodes, strict=True):
            if unit not in DIMENSIONS:
                raise ModelError(f"outside.{name}", f"must be in one of {', '.join(DIMENSIONS)}", unit)
            if axis.ndim != 1 or len(axis) < 2 or not (np.isfinite(axis).all() and (np.diff(axis) > 0.0).all()):
                raise ModelError(f"outside.{name}", "needs at least two increasing nodes", axis.tolist())
        if self.beyond not in OUTSIDE_POLICIES:
            raise ModelError("outside.beyond", f"must be one of {', '.join(OUTSIDE_POLICIES)}", self.beyond)
        object.__setattr__(self, "nodes", nodes)
        validate_terms(self)
        rows = math.prod(len(axis) for axis in nodes) if nodes else 0
        if rows > MOST_NODES:
            raise ModelError("outside.axes", f"must have at most {MOST_NODES} nodes together", rows)
        for key in ("displacement", "rotation"):
            if len(getattr(self, key)) != rows:
                raise ModelError(f"outside.{key}", f"must have {rows} rows, one per node", len(getattr(self, key)))

    def shown(self, name: str, value: float) -> str:
        """Return a quantity's value, SI or °C, as text in the table's unit: ``elevation 45 deg``."""
        unit = self.units[self.names.index(name)]
        return f"{name} {in_unit(value, unit):.6g} {unit}"

    def _beyond(self, name: str, value: float) -> float:
        """Return how far a value lies outside the table, divided by the span of the table; 0 inside."""
        axis = self.nodes[self.names.index(name)]
        return max(float(axis[0]) - value, value - float(axis[-1]), 0.0) / float(axis[-1] - axis[0])

    def validate(self, numbers: Mapping[str, float]) -> None:
        """Raise an error if the value of a quantity of this table is invalid; ignore values of other quantities.

        Raises
        ------
        ModelError
            A value is not finite, or outside the table by more than a quarter of its span (probably another unit).
        OutsideTableError
            A value is outside a table whose `beyond` is ``refuse``.
        """
        for name in self.names:
            if name in numbers and not self._beyond(name, numbers[name]) <= BELIEVED_BEYOND:
                raise ModelError(f"outside.{name}", f"{self._covers(name)}; is the unit right?", numbers[name])
        for name, axis in zip(self.names, self.nodes, strict=True):
            if self.beyond == "refuse" and name in numbers and self._beyond(name, numbers[name]) > ON_THE_EDGE:
                value = numbers[name]
                raise OutsideTableError(f"{self.shown(name, value)}: {self._covers(name)}", value, (axis[0], axis[-1]))

    def _covers(self, name: str) -> str:
        index = self.names.index(name)
        low, high = in_unit(self.nodes[index][[0, -1]], self.units[index])
        return f"the table covers {name} {low:.6g} to {high:.6g} {self.units[index]}"

    def held(self, numbers: Mapping[str, float]) -> str:
        """Return as text the values outside the table, which have the error at its edge; empty: all are inside."""
        known = [name for name in self.names if name in numbers]
        return ", ".join(self.shown(n, numbers[n]) for n in known if self._beyond(n, numbers[n]) > ON_THE_EDGE)

    def missing(self, numbers: Mapping[str, float]) -> str:
        """Return as text the table's quantities without a value in `numbers`; any such quantity disables the table."""
        return ", ".join(name for name in self.names if name not in numbers)

    def numbers_of(self, typed: Mapping[str, float]) -> dict[str, float]:
        """Convert values with keys such as ``elevation_deg`` to SI values by name; raise if a quantity is missing."""
        found = {}
        for key, value in typed.items():
            name, unit = unit_of(key)
            if name not in self.names or DIMENSIONS.get(unit) != DIMENSIONS[self.units[self.names.index(name)]]:
                allowed = ", ".join(f"{one}_{unit}" for one, unit in zip(self.names, self.units, strict=True))
                problem = f"the model's table needs {allowed}" if allowed else "the model has no table `outside`"
                raise ModelError(f"outside.{key}", problem, value)
            found[name] = float(in_si(value, UNIT_NAMES[unit]))
        if missing := self.missing(found):
            raise ModelError("outside", f"needs {missing} too", list(typed))
        self.validate(found)
        return found

    def evaluate(self, numbers: Mapping[str, float]) -> np.ndarray:
        """Return the table's error, (6,), m and rad, bilinear between nodes; zero if a quantity has no value."""
        if not self.names or self.missing(numbers):
            return np.zeros(6)
        counts = [len(axis) for axis in self.nodes]
        value = np.hstack([self.displacement, self.rotation]).reshape(*counts, 6)
        for name, axis in zip(self.names, self.nodes, strict=True):
            index = min(max(int(np.searchsorted(axis, numbers[name], side="right")) - 1, 0), len(axis) - 2)
            low, high = axis[index], axis[index + 1]
            weight = min(max((numbers[name] - low) / (high - low), 0.0), 1.0)
            value = (1.0 - weight) * value[index] + weight * value[index + 1]
        return value

    def negated(self) -> OutsideTable:
        """Return the table with all signs reversed: a table of corrections becomes a table of errors."""
        return replace(self, displacement=-self.displacement, rotation=-self.rotation)

    def without(self, numbers: Mapping[str, float]) -> OutsideTable:
        """Return the table minus its error at `numbers`, the external quantities during the calibration."""
        error = self.evaluate(numbers)
        return replace(self, displacement=self.displacement - error[:3], rotation=self.rotation - error[3:])


NO_TABLE = OutsideTable()


def unit_of(key: str) -> tuple[str, str]:
    """Split a key such as ``elevation_deg`` into a name and a unit; the unit is empty if the key has none."""
    spelt = max((name for name in UNIT_NAMES if key.endswith(f"_{name}")), key=len, default="")
    return key.removesuffix(f"_{spelt}"), spelt if spelt in DIMENSIONS else "u" + spelt[1:] if spelt else ""


def read_numbers(numbers: Mapping[str, Any]) -> dict[str, float]:
    """Return external quantities as floats by name; raise ModelError if a value is not finite."""
    found = {str(name): float(value) for name, value in numbers.items()}
    for name, value in found.items():
        if not math.isfinite(value):
            raise ModelError(f"outside.{name}", "must be finite, in SI units or °C", value)
    return found


def load_outside(path: str | Path) -> OutsideTable:
    """Read from CSV a table of the tool's error as a function of one or two external quantities, such as elevation.

    Columns x, y, z are displacements, rx, ry, rz rotation vectors, and one or two other columns external quantities.

    Parameters
    ----------
    path : str or Path
        CSV file whose column names end in a unit: ``elevation_deg``, ``rotation_deg``, ``x_um``, …, ``rz_urad``; one
        row for every node of the grid, in any order.

    Returns
    -------
    OutsideTable
        The file's values, read as errors (actual = commanded ∘ error). If the file has corrections (commanded −
        nominal), call :meth:`.negated` on this table.

    Raises
    ------
    InputFileError
        The file cannot be used; the message names line, column and what is allowed.
    """
    table = Table(path)
    displacement, rotation = table.required(POSITION, "length"), table.required(ROTATION, "angle")
    known = {table.header[index] for index, _ in (*displacement, *rotation)} | {*LABEL_COLUMNS}
    keys = [name for name in table.header if name not in known]
    if not 1 <= len(keys) <= 2:
        problem = "must have one or two columns of external quantities beside x, y, z, rx, ry, rz"
        raise InputFileError(path, "header", problem, keys)
    names, units, columns = [], [], []
    for key in keys:
        name, unit = unit_of(key)
        if not unit:
            raise InputFileError(path, "header", "must end in a unit, such as _deg", key)
        names.append(name)
        units.append(unit)
        columns += table.required((name,), DIMENSIONS[unit])
    table.refuse_unknown()
    numbers = table.numbers(columns)
    nodes, order = grid_order(table, numbers.T, " and ".join(names))
    values = table.numbers(displacement)[order], table.numbers(rotation)[order]
    try:
        return OutsideTable(tuple(names), tuple(units), tuple(nodes), *values)
    except ModelError as error:
        raise InputFileError(path, error.key, error.problem, error.value) from error


def read_outside(section: Section) -> dict[str, Any]:
    """Read the block ``outside`` of a model file as ``{"outside": table}``, an argument of :class:`MachineModel`."""
    names, units, nodes = [], [], []
    for axis in section.sections("axes"):
        names.append(axis.text("name"))
        key = next((key for key in axis.remaining() if key.startswith("nodes_")), "nodes")
        name, unit = unit_of(key)
        if name != "nodes" or not unit:
            raise axis.error(key, f"must be nodes_UNIT with one of {', '.join(DIMENSIONS)}")
        units.append(unit)
        nodes.append(axis.quantity("nodes", DIMENSIONS[unit], (None,)))
        axis.finish()
    beyond = section.choice("beyond", OUTSIDE_POLICIES, "hold")
    values = read_terms(OutsideTable, section, "outside")
    return {"outside": OutsideTable(tuple(names), tuple(units), tuple(nodes), **values, beyond=beyond)}


def outside_block(table: OutsideTable) -> dict[str, Any]:
    if not table.names:
        return {}
    axes = [
        {"name": name, f"nodes_{unit}": in_unit(axis, unit)}
        for name, unit, axis in zip(table.names, table.units, table.nodes, strict=True)
    ]
    return {"beyond": table.beyond, "axes": axes, **write_terms(table, "outside", whole=True)}
