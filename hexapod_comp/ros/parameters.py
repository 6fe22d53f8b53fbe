"""Parameters of a node: their present values, and the table from which they are declared, checked and described."""

from __future__ import annotations

import argparse
import math
import re
import sys
import textwrap
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from enum import Enum
from typing import Any

import yaml
from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor, SetParametersResult
from rclpy.lifecycle import LifecycleNode
from rclpy.parameter import Parameter as RosParameter
from rclpy.utilities import remove_ros_args

from ..errors import LONGEST_TEXT, HexapodError, printable, shorten
from ..formats.texts import did_you_mean, run_with_plain_streams
from .rclpy_compat import lifecycle_state, overrides

USE_SIM_TIME = "use_sim_time"


class ParameterError(HexapodError):
    """A parameter's value is not allowed, or cannot be set in the node's present state."""

    reason = "bad_parameter"


class Taken(Enum):
    """When a node applies a parameter's new value."""

    ALWAYS = "at any time"
    RELOAD = "at configure and at ~/reload_model"
    CONFIGURE = "at configure"
    START = "at the start"


AUTOSTART = "autostart | true |  | start | configure and activate when the process starts"
RANGE = re.compile(r"(\S+) to (\S+) ?(\S*)")


@dataclass(frozen=True)
class Parameter:
    name: str
    default: bool | int | float | str | list[str] | list[float]
    # a range with its unit, as ``0 to 1 m``; choices, as ``zero, hold``; ``not NAME`` if the value must differ from the
    # parameter NAME; empty: any value of the default's type
    allowed: str
    taken: Taken
    meaning: str  # description for help and pages

    @property
    def range(self) -> tuple[float, float] | None:
        match = RANGE.fullmatch(self.allowed)
        return (float(match[1]), float(match[2])) if match else None

    @property
    def differs_from(self) -> str:
        """Name of another parameter whose value this parameter must not have; empty if there is no such rule."""
        return self.allowed.removeprefix("not ") if self.allowed.startswith("not ") else ""

    @property
    def choices(self) -> list[str]:
        return [] if self.range or self.differs_from or not self.allowed else self.allowed.split(", ")

    def described(self) -> str:
        text = f"{self.meaning} ({self.allowed})" if self.allowed else self.meaning
        return text.replace("`", "")

    def descriptor(self) -> ParameterDescriptor:
        result = ParameterDescriptor(
            description=self.meaning.replace("`", ""),
            additional_constraints="; ".join(filter(None, (self.allowed, f"applied {self.taken.value}"))),
            read_only=self.taken is Taken.START,
            dynamic_typing=True,
        )
        if self.range and isinstance(self.default, float):
            result.floating_point_range = [FloatingPointRange(from_value=self.range[0], to_value=self.range[1])]
        elif self.range and isinstance(self.default, int):
            result.integer_range = [IntegerRange(from_value=int(self.range[0]), to_value=int(self.range[1]))]
        return result

    def checked(self, value: Any) -> Any:
        """Return `value` in the type of the parameter's default; raise a ParameterError if it is not allowed."""
        if isinstance(self.default, list) and isinstance(self.default[0], float):
            return self._checked_numbers(value)
        if isinstance(self.default, list):
            names, count = list(value) if isinstance(value, list | tuple) else [], len(self.default)
            named = all(isinstance(name, str) and name for name in names)
            if len(names) != count or not named or len(set(names)) != count:
                raise self.refusal(f"must be {count} different names, not {shorten(value)}")
            return names
        wanted: Any = type(self.default)
        if wanted is float and type(value) is int:
            value = float(value)
        if type(value) is not wanted:
            raise self.refusal(f"must be {wanted.__name__}, not {shorten(value)}")
        if self.choices and value not in self.choices:
            raise self.refusal(f"must be one of {self.allowed}, not {shorten(value)}")
        low, high = self.range or (value, value)
        if not low <= value <= high:
            raise self.refusal(f"must lie in {self.allowed}, not {value!r}")
        return value

    def _checked_numbers(self, value: Any) -> list[float]:
        count, (low, high) = len(self.default), self.range or (-math.inf, math.inf)  # type: ignore[arg-type]
        numbers = [] if isinstance(value, str) or not isinstance(value, Iterable) else list(value)
        well = len(numbers) == count and all(type(number) in (int, float) for number in numbers)
        if not (well and all(low <= number <= high for number in numbers)):
            raise self.refusal(f"must be {count} numbers, each in {self.allowed}, not {shorten(numbers or value)}")
        return [float(number) for number in numbers]

    def refusal(self, problem: str) -> ParameterError:
        return ParameterError(f"parameter {self.name}: {problem}")


def read_table(text: str) -> tuple[Parameter, ...]:
    """Return a node's parameters: `autostart`, which every node has, and one parameter for each row of `text`."""
    rows = re.sub(r"\n\s+", " ", f"{AUTOSTART}\n{text.strip()}").splitlines()
    cells = ([cell.strip() for cell in row.split("|")] for row in rows)
    return tuple(
        Parameter(name, yaml.safe_load(default), allowed, Taken[taken.upper()], meaning)
        for name, default, allowed, taken, meaning in cells
    )


def shown(value: bool | int | float | str | list[str] | list[float]) -> str:
    """Return a parameter's default as a user would write it on the command line."""
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, list):
        return "[" + ", ".join(map(str, value)) + "]"
    return f"{value:g}" if isinstance(value, float) else str(value) or "''"


class Parameters(dict[str, Any]):
    """The present values of a node's parameters by name, updated while the node runs."""

    def __init__(
        self,
        node: LifecycleNode,
        table: Sequence[Parameter],
        check: Callable[[dict[str, Any]], None],
        changed: Callable[[set[str]], None],
    ) -> None:
        self._node, self._check, self._changed = node, check, changed
        self._table, given = {parameter.name: parameter for parameter in table}, overrides(node)
        for name, parameter in self._table.items():
            if name in given:
                parameter.checked(given[name].value)  # names the unit, which the error of rclpy does not
            value = node.declare_parameter(name, parameter.default, parameter.descriptor()).value
            self[name] = parameter.checked(value)
        self._check_differences(self)
        declared = set(node.get_parameters_by_prefix(""))
        for name in given:  # a name that the node has not declared is probably misspelt
            if name not in declared and not name.startswith("qos_overrides."):
                hint = did_you_mean(name, declared)
                node.get_logger().warning(f"there is no parameter {name}, so its value is ignored{hint}")
        # rclpy calls `_validate` before its own callback, which applies use_sim_time
        node.add_on_set_parameters_callback(self._validate)
        node.add_post_set_parameters_callback(self._apply)

    def _check_differences(self, values: dict[str, Any]) -> None:
        for parameter in self._table.values():
            other = parameter.differs_from
            if other and values[parameter.name] == values[other]:
                raise parameter.refusal(f"must differ from {other}, {shorten(values[other])}")

    def _known(self, parameters: Iterable[RosParameter]) -> dict[str, Any]:
        return {p.name: self._table[p.name].checked(p.value) for p in parameters if p.name in self._table}

    def _validate(self, parameters: list[RosParameter]) -> SetParametersResult:
        """Refuse parameter values that are not allowed, or that the node can apply only at `configure` or at its start.

        ``use_sim_time`` can change only at the start: stamps, ramps and the order of commands depend on the clock.
        """
        try:
            wanted, state = self._known(parameters), lifecycle_state(self._node)[1]
            for name, value in wanted.items():
                at_configure = self._table[name].taken is Taken.CONFIGURE and state != "unconfigured"
                if at_configure and value != self[name]:
                    problem = f"is applied at configure, and the node is {state}; set it after a cleanup"
                    raise self._table[name].refusal(problem)
            self._check_differences({**self, **wanted})
            clock = self._node.get_parameter(USE_SIM_TIME).value
            if any(parameter.name == USE_SIM_TIME and parameter.value is not clock for parameter in parameters):
                problem = f"stays {str(clock).lower()} while the node runs; set it at the start"
                raise ParameterError(f"parameter {USE_SIM_TIME}: {problem}")
            self._check(wanted)
        except ParameterError as error:
            return SetParametersResult(successful=False, reason=str(error))
        return SetParametersResult(successful=True)

    def _apply(self, parameters: list[RosParameter]) -> None:
        if known := self._known(parameters):  # rclpy's own parameters are not known
            self.update(known)
            self._changed(set(known))


# ---- the program ----


ROS_ARGUMENTS = "--ros-args"

USAGE_ERROR = 2

WIDTH = 118  # Width of the help text, characters


@dataclass(frozen=True)
class Program:
    """A node's executable: its name, its parameters and the parts of its help text."""

    name: str
    summary: str
    parameters: Sequence[Parameter]
    topics: str = ""
    example: str = "-p autostart:=false"  # arguments that follow ``--ros-args`` in the help's example

    def refusal(self, arguments: Sequence[str]) -> int | None:
        """Return None if the program may start with these arguments; else print help or error and return the exit code.

        Without this check rcl would take ``name:=value`` outside --ros-args for a remapping, and ignore other words.
        """
        return run_with_plain_streams(lambda: self._refusal(arguments))

    def _refusal(self, arguments: Sequence[str]) -> int | None:
        lines = ["parameters (-p NAME:=VALUE after --ros-args; default in brackets):"]
        for parameter in self.parameters:
            text = f"{parameter.name}  [{shown(parameter.default)}]  {parameter.described()}"
            lines += textwrap.wrap(text, WIDTH, initial_indent="  ", subsequent_indent="      ")
        if self.topics:
            lines += ["", "topics and services:", *textwrap.indent(self.topics.strip(), "  ").splitlines()]
        example = f"{self.name} {ROS_ARGUMENTS} {self.example}"
        parser = argparse.ArgumentParser(
            self.name,
            usage=f"{self.name} [-h] [--ros-args -p NAME:=VALUE … -r TOPIC:=OTHER … --params-file FILE …]",
            description=self.summary,
            epilog="\n".join([*lines, "", f"example: {example}"]),
            formatter_class=argparse.RawDescriptionHelpFormatter,
            allow_abbrev=False,
        )
        try:
            _, strange = parser.parse_known_args(remove_ros_args(list(arguments)))
            if strange:
                listed = printable(" ".join(strange), LONGEST_TEXT)
                parser.error(f"arguments not understood: {listed}. Parameters follow --ros-args: {example}")
        except (RuntimeError, ValueError) as error:  # ValueError: bytes that are not UTF-8
            parser.print_usage(sys.stderr)
            text = f"{self.name}: error: ROS arguments not understood: {error}"
            print(printable(text, LONGEST_TEXT), file=sys.stderr)
            return USAGE_ERROR
        except SystemExit as leaving:
            return leaving.code if isinstance(leaving.code, int) else USAGE_ERROR
        return None
