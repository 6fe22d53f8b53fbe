"""Parameters of a node: their table, their check, and what is said of those that nobody knows."""

from __future__ import annotations

import difflib
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import rclpy
from rcl_interfaces.msg import FloatingPointRange, ParameterDescriptor
from rclpy.lifecycle import LifecycleNode

from ..errors import HexapodError
from ..machine.geometry import STRUT_NAMES


class ParameterError(HexapodError):
    """A parameter's value is not allowed."""

    reason = "bad_parameter"


@dataclass(frozen=True)
class Parameter:
    """One parameter of a node.

    Parameters
    ----------
    name : str
        Its name.
    default : bool, int, float, str or list of str
        Default, which also fixes the type; an int is accepted for a float. A list holds as many different names.
    description : str
        What it means, with its unit.
    low, high : float, optional
        Allowed range of a number.
    read_only : bool
        Fixed at start; the others may be set while the node runs.
    choices : tuple of str, optional
        All that is allowed.
    """

    name: str
    default: bool | int | float | str | list[str]
    description: str
    low: float | None = None
    high: float | None = None
    read_only: bool = True
    choices: tuple[str, ...] = ()


JOINT_NAMES = Parameter("joint_names", list(STRUT_NAMES), "the struts' names in JointState messages, in strut order")


def declare(node: LifecycleNode, parameters: Sequence[Parameter]) -> dict[str, Any]:
    """Declare parameters and return their checked values.

    Raises
    ------
    ParameterError
        Wrong type or out of range; names parameter, value and what is allowed.
    """
    values = {}
    for parameter in parameters:
        descriptor = ParameterDescriptor(
            description=described(parameter), read_only=parameter.read_only, dynamic_typing=True
        )
        if isinstance(parameter.default, float) and parameter.low is not None:
            bounds = FloatingPointRange(from_value=float(parameter.low), to_value=float(parameter.high or 1e9))
            descriptor.floating_point_range = [bounds]
        try:
            value = node.declare_parameter(parameter.name, parameter.default, descriptor).value
        except rclpy.exceptions.InvalidParameterValueException as error:
            raise ParameterError(f"parameter {parameter.name}: {error}") from error
        values[parameter.name] = checked(parameter, value)
    _warn_of_strangers(node)
    return values


def described(parameter: Parameter) -> str:
    """Return what a parameter means, with its allowed range."""
    if parameter.low is None:
        return parameter.description
    upper = "" if parameter.high is None else f" to {parameter.high:g}"
    return f"{parameter.description} (from {parameter.low:g}{upper})"


def checked(parameter: Parameter, value: Any) -> Any:
    """Return `value` as the parameter's type, or refuse it.

    Raises
    ------
    ParameterError
        Wrong type or out of range; an int is taken for a float.
    """
    wanted = type(parameter.default)
    if wanted is list:
        return _checked_names(parameter, value)
    if wanted is float and type(value) is int:
        value = float(value)
    if type(value) is not wanted:
        raise ParameterError(f"parameter {parameter.name}: must be {wanted.__name__}, not {value!r}")
    if parameter.choices and value not in parameter.choices:
        allowed = ", ".join(parameter.choices)
        raise ParameterError(f"parameter {parameter.name}: must be one of {allowed}, not {value!r}")
    if isinstance(value, int | float) and wanted is not bool:
        low = -float("inf") if parameter.low is None else parameter.low
        high = float("inf") if parameter.high is None else parameter.high
        if not low <= value <= high:
            raise ParameterError(f"parameter {parameter.name}: must lie in {low:g}…{high:g}, not {value!r}")
    return value


def _checked_names(parameter: Parameter, value: Any) -> list[str]:
    """Return a list of names, or refuse it."""
    names = list(value) if isinstance(value, list | tuple) else []
    count = len(parameter.default) if isinstance(parameter.default, list) else 0
    if len(set(names)) != count or len(names) != count or not all(isinstance(name, str) and name for name in names):
        raise ParameterError(f"parameter {parameter.name}: must be {count} different names, not {value!r}")
    return names


def _warn_of_strangers(node: LifecycleNode) -> None:
    """Warn of overrides that no declared parameter takes: most likely misspelt."""
    declared = set(node.get_parameters_by_prefix(""))
    for name in getattr(node, "_parameter_overrides", {}):
        if name not in declared and not name.startswith("qos_overrides."):
            near = difflib.get_close_matches(name, declared, 1)
            hint = f"; did you mean {near[0]}?" if near else ""
            node.get_logger().warning(f"there is no parameter {name}, it is ignored{hint}")
