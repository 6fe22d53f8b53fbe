"""A stand-in for the parts of LinuxCNC's module ``hal`` that the bridge uses, for tests without LinuxCNC."""

from __future__ import annotations

import time
from typing import Any

import numpy as np


class StandInPin:
    """A pin with its type's checks; `written` has all values written to it, as (monotonic time, value)."""

    def __init__(self, kind: str) -> None:
        self.value: Any = {"FLOAT": 0.0, "BIT": False}.get(kind, 0)
        self._kind = kind
        self.written: list[tuple[float, Any]] = []

    def get(self) -> Any:
        return self.value

    def set(self, value: Any) -> None:
        if self._kind == "U32" and not 0 <= value < 2**32:
            raise OverflowError(value)
        self.value = {"FLOAT": float, "BIT": bool}.get(self._kind, int)(value)
        self.written.append((time.monotonic(), self.value))


class StandInHal:
    """A stand-in for the module ``hal``; `pins` has the pins of the last component."""

    class error(Exception):
        """The exception of the module ``hal``."""

    HAL_FLOAT, HAL_BIT, HAL_S32, HAL_U32, HAL_IN, HAL_OUT = "FLOAT", "BIT", "S32", "U32", "IN", "OUT"

    def __init__(self) -> None:
        self.pins: dict[str, StandInPin] = {}
        self.directions: dict[str, str] = {}
        self.taken: set[str] = set()
        self.is_ready = self.has_left = False

    def component(self, name: str) -> StandInHal:
        if name in self.taken:
            raise self.error(f"Invalid component name {name}")
        self.taken.add(name)
        return self

    def newpin(self, name: str, kind: str, direction: str) -> StandInPin:
        self.pins[name], self.directions[name] = StandInPin(kind), direction
        return self.pins[name]

    def ready(self) -> None:
        self.is_ready = True

    def exit(self) -> None:
        self.has_left = True

    # ---- for tests ----

    def __getitem__(self, name: str) -> Any:
        return self.pins[name].value

    def __setitem__(self, name: str, value: Any) -> None:
        self.pins[name].value = value

    @property
    def corrections(self) -> np.ndarray:
        return np.array([self[f"correction.{n}"] for n in range(6)])

    def history(self, name: str) -> list[Any]:
        return [value for _, value in self.pins[name].written]
