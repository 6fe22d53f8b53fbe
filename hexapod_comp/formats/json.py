"""Conversion of results to JSON, and reading of JSON."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from datetime import date
from os import PathLike, fspath
from types import UnionType
from typing import Any, Union, get_args, get_origin

import numpy as np

from ..errors import HexapodError
from .files import MAX_FILE_BYTES
from .texts import CODES


def json_content(text: str, most: int = MAX_FILE_BYTES) -> Any:
    """Return the content of a JSON text.

    Raise a ValueError if the text has more than `most` characters, is nested deeper than Python's recursion limit,
    contains NaN or infinity, or is not JSON.
    """
    if len(text) > most:
        raise ValueError(f"has {len(text)} characters, at most {most} are allowed")
    try:
        return json.loads(text, parse_constant=_refuse_constant)
    except RecursionError as error:
        raise ValueError("is nested too deeply") from error


def _refuse_constant(name: str) -> None:
    raise ValueError(f"{name} is not valid JSON")


def has_type(value: Any, hint: Any, largest: float, most: int) -> bool:
    """Return whether a value from JSON has the type `hint`: str, bool, int, float, None, a tuple, or a union of these.

    A float may be an int in JSON; its magnitude must be at most `largest`. A tuple is a list in JSON; it must have at
    most `most` entries.
    """
    if get_origin(hint) in (Union, UnionType):
        return any(has_type(value, one, largest, most) for one in get_args(hint))
    if get_origin(hint) is tuple:
        kinds = get_args(hint)
        if not isinstance(value, list) or len(value) > most:
            return False
        kinds = kinds[:1] * len(value) if kinds[-1] is Ellipsis else kinds
        return len(value) == len(kinds) and all(
            has_type(entry, kind, largest, most) for entry, kind in zip(value, kinds, strict=True)
        )
    if hint is float:
        return type(value) in (int, float) and abs(value) <= largest
    return type(value) is hint


def json_text(result: Any, indent: int | None = 1) -> str:
    """Return a result as JSON text that ends with a line break; :func:`plain` converts the result."""
    text = json.dumps(plain(result), indent=indent, ensure_ascii=False, allow_nan=False)
    return CODES.sub(lambda code: f"\\u{ord(code[0]):04x}", text) + "\n"


def plain(value: Any) -> Any:
    """Convert a result to JSON types; NaN and infinity become null, all other numbers keep their exact value."""
    if isinstance(value, str | int | None):
        return value
    if isinstance(value, float):
        return float(value) if math.isfinite(value) else None
    if isinstance(value, np.ndarray | np.generic):
        listed = value.tolist()
        exact = value.dtype.kind in "iubU" or (value.dtype.kind == "f" and np.isfinite(value).all())
        return listed if exact else plain(listed)
    if isinstance(value, Mapping):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple) and not hasattr(value, "_asdict"):
        return [plain(item) for item in value]
    return plain(_parts(value))


def _parts(value: Any) -> Any:
    if hasattr(value, "as_columns"):  # a pose
        return value.as_columns()
    if isinstance(value, tuple):
        return value._asdict()  # type: ignore[attr-defined]
    if is_dataclass(value) and not isinstance(value, type):
        return {part.name: getattr(value, part.name) for part in fields(value) if part.init}
    if isinstance(value, set | frozenset):
        return sorted(value)
    if isinstance(value, HexapodError):
        return {"reason": value.reason, "problem": str(value)}
    if isinstance(value, date):
        return value.isoformat()
    if isinstance(value, PathLike):
        return fspath(value)
    raise TypeError(f"{type(value).__name__} cannot be converted to JSON")
