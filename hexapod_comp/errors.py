"""Every error that the package raises on bad input, each with the offending value and what is allowed."""

from __future__ import annotations

from pathlib import Path
from typing import Any

LONGEST_TEXT = 2000  # longest message, log line or value in diagnostics, whatever was received
LONGEST_PATH = 500  # a file's name is shown up to this length, so that the problem still fits into the message


class HexapodError(Exception):
    """Root of all errors that this package raises deliberately.

    Its text may quote foreign text, so all are made :func:`printable` here.

    Parameters
    ----------
    text : str
        What is wrong, with the value found and what is allowed.

    Attributes
    ----------
    reason : str
        Short name of the cause; diagnostics count refused commands under it.
    """

    reason = "error"

    def __init__(self, text: str = ""):
        super().__init__(printable(text, LONGEST_TEXT))

    def __str__(self) -> str:
        return str(self.args[0])  # also where a parent class has a text of its own, as ImportError

    def __reduce__(self) -> tuple[Any, ...]:
        """Return what pickle needs: text and attributes, independent of the class's constructor."""
        return _remade, (type(self), self.args), self.__dict__

    def with_lines(self, lines: str) -> HexapodError:
        """Return the error with lines appended unchanged: the log of our own process."""
        self.args = (f"{self}\n{lines}",)
        return self


def _remade(kind: type[HexapodError], args: tuple[Any, ...]) -> HexapodError:
    """Return an error with its text; pickle adds the attributes."""
    error = kind.__new__(kind)
    error.args = args
    return error


def _found(value: Any) -> str:
    """Return the offending value, to append to a message."""
    return "" if value is None else f" (found {shorten(value)})"


class InputFileError(HexapodError):
    """A file cannot be used: file, key path or ``row 3, column x_mm`` (empty: the whole file), problem and value."""

    reason = "bad_file"

    def __init__(self, path: str | Path, key: str, problem: str, value: Any = None):
        self.path, self.key, self.value, self.problem = str(path), key, value, problem
        file = printable(str(path), LONGEST_PATH)
        where = f"{file}: {printable(key)}" if key else file
        super().__init__(f"{where}: {problem}{_found(value)}")


class GeometryError(HexapodError):
    """A geometry that no hexapod can have: quantity, value, and what is allowed."""

    reason = "bad_geometry"

    def __init__(self, key: str, problem: str, value: Any = None):
        self.key, self.problem, self.value = key, problem, value
        super().__init__(f"{key}: {problem}{_found(value)}")


class FrameError(HexapodError):
    """A machine has no tool or work frame of that name; lists the valid names."""

    reason = "unknown_frame"


class ModelError(GeometryError):
    """A machine model whose numbers cannot describe a machine."""

    reason = "bad_model"


class CalibrationError(HexapodError):
    """Measurements from which no model can be fitted: which part of them, and what is needed."""

    reason = "bad_measurements"

    def __init__(self, what: str, problem: str):
        self.what, self.problem = what, problem
        super().__init__(f"{what}: {problem}")


class PoseError(HexapodError):
    """A pose that is invalid: not finite, or its rotation is not a rotation."""

    def __init__(self, problem: str, value: Any = None, reason: str = "bad_pose"):
        self.value, self.reason = value, reason
        super().__init__(f"{problem}{_found(value)}")


class BoundError(HexapodError):
    """A quantity that breaks a bound; both are attributes, where they are known."""

    def __init__(self, problem: str, value: Any = None, limit: Any = None):
        self.value, self.limit = value, limit
        super().__init__(problem)


class KinematicsError(BoundError):
    """Forward or inverse kinematics has no usable answer."""

    reason = "kinematics"


class NotFiniteError(KinematicsError):
    """A length or pose is NaN, infinite, or a length is not positive."""

    reason = "not_finite"


class NotConvergedError(KinematicsError):
    """Newton did not converge within the allowed number of iterations."""

    reason = "not_converged"


class SingularError(KinematicsError):
    """The Jacobian is singular, or its condition number is above the limit."""

    reason = "singular"


class UnreachableError(KinematicsError):
    """No pose of the machine has these strut lengths."""

    reason = "unreachable"


class OtherAssemblyModeError(KinematicsError):
    """The pose found belongs to another assembly mode than the machine's working one."""

    reason = "other_assembly_mode"


class LimitError(HexapodError):
    """A command breaks a machine limit; it is refused, never clamped.

    ``reason`` is ``stroke``, ``base_cone``, ``platform_cone``, ``clearance``, ``condition``, ``correction``, ``step``,
    ``speed``, ``acceleration`` or ``assembly``; ``value`` and ``limit`` are in SI, ``strut`` is an index 0…5 or None,
    ``stage`` ``nominal`` or ``compensated``: which of the two values broke the limit.
    """

    def __init__(self, reason: str, problem: str, value: float, limit: float, strut: int | None, stage: str):
        self.reason, self.value, self.limit, self.strut, self.stage = reason, value, limit, strut, stage
        super().__init__(problem)


class TooEarlyError(LimitError):
    """A command is too early: a strut would exceed its largest speed, m/s; it is allowed after ``wait``, s."""

    def __init__(self, problem: str, wait: float, limit: float, strut: int):
        self.wait = wait
        super().__init__("speed", problem, wait, limit, strut, "compensated")


class OutsideFieldError(BoundError):
    """A pose lies outside the measured box of a field that refuses extrapolation."""

    reason = "outside_field"


class OutsideTableError(OutsideFieldError):
    """An outside number, elevation say, lies outside a table that refuses what it does not hold."""

    reason = "outside_table"


class CommandError(HexapodError):
    """A command message that is rejected; `reason` names the rule that it broke, under which diagnostics count it."""

    def __init__(self, reason: str, problem: str):
        self.reason = reason
        super().__init__(problem)


def shorten(value: Any, limit: int = 80) -> str:
    """Return ``repr(value)`` cut to `limit` characters, so that a message stays readable."""
    if isinstance(value, str | bytes) and len(value) > limit:
        return repr(value[:limit])[: limit - 1] + "…"  # the rest, of any size, is never copied
    text = repr(value)
    return text if len(text) <= limit else text[: limit - 1] + "…"


def printable(text: str, limit: int = 200) -> str:
    """Return a text on one line, of at most `limit` characters, without codes for the terminal.

    Text from outside (a file, a message, the network's names) passes here before it is shown: a line break would forge
    lines of the log, an escape code moves the cursor, and ten megabytes are too long.
    """
    if len(text) <= limit and text.isprintable():
        return text
    shown = "".join(c if c.isprintable() else repr(c)[1:-1] for c in text[: limit + 1])
    return shown if len(shown) <= limit else shown[: limit - 1] + "…"


class NoAnswerError(HexapodError):
    """An expected event has not happened in time."""

    reason = "timeout"
