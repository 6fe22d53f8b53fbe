"""The errors that the package raises on bad input; each message contains the refused value and what is allowed."""

from __future__ import annotations

from pathlib import Path
from typing import Any

LONGEST_TEXT = 2000  # characters; a longer message, log line or diagnostics value is cut
LONGEST_PATH = 500  # characters; a longer file name is cut, so that the problem still fits into the message


class HexapodError(Exception):
    """Base class of all errors that this package raises deliberately.

    A message may quote text from a file or the network, so every message passes through :func:`printable`.

    Parameters
    ----------
    text : str
        What is wrong, with the value found and what is allowed.

    Attributes
    ----------
    reason : str
        Short name of the cause; diagnostics count refused commands by this name.
    """

    reason = "error"

    def __init__(self, text: str = ""):
        super().__init__(printable(text, LONGEST_TEXT))

    def __str__(self) -> str:
        return str(self.args[0])  # the __str__ of a second base class, such as ImportError, is not used

    def __reduce__(self) -> tuple[Any, ...]:
        """Let pickle rebuild the error without its constructor, as subclasses have constructors of their own."""
        return _unpickled, (type(self), self.args), self.__dict__

    def with_lines(self, lines: str) -> HexapodError:
        """Append text with line breaks to the message, such as the log of a process of this package."""
        self.args = (f"{self}\n{lines}",)
        return self


def _unpickled(kind: type[HexapodError], args: tuple[Any, ...]) -> HexapodError:
    error = kind.__new__(kind)
    error.args = args
    return error


def _found(value: Any) -> str:
    return "" if value is None else f" (found {shorten(value)})"


class InputFileError(HexapodError):
    """A file that cannot be used. `key` is the place, such as ``line 3, column x_mm``; it is empty for a whole file."""

    reason = "bad_file"

    def __init__(self, path: str | Path, key: str, problem: str, value: Any = None):
        self.path, self.key, self.value, self.problem = str(path), key, value, problem
        file = printable(str(path), LONGEST_PATH)
        where = f"{file}: {printable(key)}" if key else file
        super().__init__(f"{where}: {problem}{_found(value)}")


class GeometryError(HexapodError):
    """A geometry with a value that no hexapod can have; the message has the quantity, its value and what is allowed."""

    reason = "bad_geometry"

    def __init__(self, key: str, problem: str, value: Any = None):
        self.key, self.problem, self.value = key, problem, value
        super().__init__(f"{key}: {problem}{_found(value)}")


class FrameError(HexapodError):
    """A name that belongs to no tool or work frame of the machine; the message lists the valid names."""

    reason = "unknown_frame"


class ModelError(GeometryError):
    """A machine model with an invalid value, or with a value that no machine can have."""

    reason = "bad_model"


class CalibrationError(HexapodError):
    """Measurements or settings that a fit cannot use: `what` names the measurement or setting, `problem` the fault."""

    reason = "bad_measurements"

    def __init__(self, what: str, problem: str):
        self.what, self.problem = what, problem
        super().__init__(f"{what}: {problem}")


class TooFewReadingsError(CalibrationError):
    """Too few readings for a fit: the only :class:`CalibrationError` that more readings can remove."""


class PoseError(HexapodError):
    """A pose with a number that is not finite, an angle beyond its limit, or a matrix that is no rotation."""

    def __init__(self, problem: str, value: Any = None, reason: str = "bad_pose"):
        self.value, self.reason = value, reason
        super().__init__(f"{problem}{_found(value)}")


class BoundError(HexapodError):
    """A quantity outside its bound. `value` is the quantity and `limit` its bound; either is None if unknown."""

    def __init__(self, problem: str, value: Any = None, limit: Any = None):
        self.value, self.limit = value, limit
        super().__init__(problem)


class KinematicsError(BoundError):
    """An error of forward or inverse kinematics: the problem has no usable solution."""

    reason = "kinematics"


class NotFiniteError(KinematicsError):
    """A length or pose that is NaN or infinite, or a length that is not positive."""

    reason = "not_finite"


class NotConvergedError(KinematicsError):
    """An iteration that did not converge within `limit` steps; by default, the inversion of the error field."""

    reason = "not_converged"

    def __init__(
        self,
        problem: str = "the iteration that inverts the error field does not converge at this pose",
        value: Any = None,
        limit: Any = None,
    ):
        super().__init__(problem, value, limit)


class SingularError(KinematicsError):
    """A pose at which the Jacobian is singular or has a condition number above the machine's limit."""

    reason = "singular"


class UnreachableError(KinematicsError):
    """Strut lengths for which the machine has no pose."""

    reason = "unreachable"


class OtherAssemblyModeError(KinematicsError):
    """A solution of forward kinematics that is not in the machine's working assembly mode."""

    reason = "other_assembly_mode"


class LimitError(HexapodError):
    """A command that breaks a machine limit; the command is refused, never clamped.

    ``reason`` is ``stroke``, ``base_cone``, ``platform_cone``, ``clearance``, ``condition``, ``correction``, ``step``,
    ``speed``, ``acceleration`` or ``assembly``. ``value`` and ``limit`` are in SI units. ``strut`` is the strut's
    index, 0…5, or None. ``stage`` names the command that breaks the limit: ``nominal`` or ``compensated``.
    """

    def __init__(self, reason: str, problem: str, value: float, limit: float, strut: int | None, stage: str):
        self.reason, self.value, self.limit, self.strut, self.stage = reason, value, limit, strut, stage
        super().__init__(problem)


class TooEarlyError(LimitError):
    """A command that needs a strut speed above `limit`, m/s; `wait` seconds later the same command is allowed."""

    def __init__(self, problem: str, wait: float, limit: float, strut: int):
        self.wait = wait
        super().__init__("speed", problem, wait, limit, strut, "compensated")


class OutsideFieldError(BoundError):
    """A pose outside the box of an error field with ``outside: refuse``."""

    reason = "outside_field"


class OutsideTableError(OutsideFieldError):
    """An external quantity, such as elevation, outside the range of a table with ``beyond: refuse``."""

    reason = "outside_table"


class CommandError(HexapodError):
    """A rejected command message. `reason` names the broken rule; diagnostics count rejections by reason."""

    def __init__(self, reason: str, problem: str):
        self.reason = reason
        super().__init__(problem)


def shorten(value: Any, limit: int = 80) -> str:
    """Return ``repr(value)``, cut to `limit` characters, for a message."""
    if isinstance(value, str | bytes) and len(value) > limit:
        return repr(value[:limit])[: limit - 1] + "…"  # repr of a huge value would need much memory
    text = repr(value)
    return text if len(text) <= limit else text[: limit - 1] + "…"


def printable(text: str, limit: int = 200) -> str:
    """Return a text as one line of at most `limit` characters, with control characters written as escapes.

    Text from a file, a message or the network passes through this function before it is shown. An unescaped line break
    could forge a line of the log, an escape code move the terminal's cursor, and a text of megabytes fill the log.
    """
    if len(text) <= limit and text.isprintable():
        return text
    shown = "".join(c if c.isprintable() else repr(c)[1:-1] for c in text[: limit + 1])
    return shown if len(shown) <= limit else shown[: limit - 1] + "…"


class NoAnswerError(HexapodError):
    """A timeout: an expected answer or event did not come in time."""

    reason = "timeout"
