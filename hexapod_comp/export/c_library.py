"""The C core as a shared library, with the face of the Python compensator: what a controller will answer, seen here.

The library is one machine with one model: ``hexapod_comp.c`` and ``hexapod_library.c`` of an export, compiled. Its
state is the caller's, so it lies here, field by field as in ``hexapod_comp.h``.
"""

from __future__ import annotations

import ctypes
import math
from collections.abc import Mapping
from ctypes import Structure, byref, c_char_p, c_double, c_int, c_void_p
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import HexapodError, InputFileError, ModelError
from ..kernels.compensation import SIZES, State
from ..machine.geometry import HexapodGeometry
from ..machine.late import MOST_TIME_CONSTANTS, PARTS
from ..machine.model import MachineModel
from ..machine.temperatures import HUMIDITY, REFERENCE_TEMPERATURE, Temperatures
from .c_code import STATUS


class CPose(Structure):
    """hc_pose: position, m, and rotation matrix by rows."""

    _fields_ = (("position", c_double * 3), ("rotation", c_double * 9))


class CLast(Structure):
    """hc_last: what one command leaves behind."""

    _fields_ = (
        ("motion_low", c_double * 9),
        ("motion_sense", c_double * 9),
        ("nominal", c_double * 6),
        ("correction", c_double * 6),
        ("command", c_double * 6),
        ("ramp", c_double * 6),
        ("time", c_double),
        ("platform", CPose),
        ("model", CPose),
        ("enabled", c_int),
        ("changed", c_int),
        ("resumes", c_int),
        ("received", c_double),
        ("published", c_double),
        ("ahead_by_stamp", c_double * 6),
        ("ahead_by_receipt", c_double * 6),
        ("smooth_speed", c_double * 6),
    )


class CTime(Structure):
    """hc_time: when a command was made and received, s."""

    _fields_ = (("made", c_double), ("received", c_double))


class CState(Structure):
    """hc_state: a compensator at work."""

    _fields_ = (
        ("model", c_void_p),
        ("ramp_rate", c_double),
        ("temperatures", c_double * 8),
        ("began", c_double * 8),
        ("newest", c_double * 8),
        ("behind", (c_double * MOST_TIME_CONSTANTS) * 8),
        ("base_joints", c_double * 18),
        ("platform_joints", c_double * 18),
        ("growth", c_double * 6),
        ("humidity", c_double),
        ("last", CLast),
        ("estimate", CPose),
    )


class CAnswer(Structure):
    """hc_answer: what came of a command."""

    _fields_ = (
        ("status", c_int),
        ("strut", c_int),
        ("compensated", c_int),
        ("value", c_double),
        ("condition", c_double),
        ("outside_field", c_int),
        ("platform", CPose),
        ("nominal", c_double * 6),
        ("correction", c_double * 6),
        ("command", c_double * 6),
    )


class CEstimated(Structure):
    """hc_estimated: where the tool is."""

    _fields_ = (("status", c_int), ("condition", c_double), ("tool", CPose))


class CHead(Structure):
    """The first members of hc_model."""

    _fields_ = tuple((name, c_char_p) for name in ("machine", "model", "date", "geometry_sha256", "model_sha256"))


class CRefusal(HexapodError):
    """The core refuses; `reason` is the name that the Python compensator gives to the same refusal."""

    def __init__(self, status: int, reason: str) -> None:
        self.status, self.reason = status, reason
        super().__init__(f"the C core refuses: {STATUS[status]}")


class CCompensator:
    """The C core of one machine; its methods are those of the Python ``Compensator`` of the same names.

    Parameters
    ----------
    library : str or Path
        The shared library.
    geometry, model : HexapodGeometry, MachineModel
        What it was made of.
    ramp_rate : float
        Largest strut speed at which changes are taken up, m/s.

    Raises
    ------
    InputFileError
        It cannot be loaded, is not such a library, or is one of another machine or model.
    """

    def __init__(
        self, library: str | Path, geometry: HexapodGeometry, model: MachineModel, ramp_rate: float = 1e-3
    ) -> None:
        self.geometry, self.model = geometry, model
        self._path = str(library)
        self._library = load_library(library)
        head = CHead.from_address(self._library.hc_machine())
        made_of = (head.machine.decode(), head.model.decode())
        if made_of != (geometry.name, model.name):
            wanted = f"{geometry.name!r} with model {model.name!r}"
            raise InputFileError(
                self._path, "", f"is of machine {made_of[0]!r} with model {made_of[1]!r}, not {wanted}"
            )
        self.hashes = head.geometry_sha256.decode(), head.model_sha256.decode()
        self.state, self.answer, self.estimated = CState(), CAnswer(), CEstimated()
        self._temperatures: dict[str, float] = {}
        self._library.hc_init(byref(self.state), self._library.hc_machine(), c_double(ramp_rate))

    @property
    def command(self) -> np.ndarray:
        """Strut commands last accepted, m."""
        return np.array(self.state.last.command)

    @property
    def correction(self) -> np.ndarray:
        """Corrections of the last command, m."""
        return np.array(self.state.last.correction)

    def step(
        self, numbers: tuple[float, ...], time: float, frame: np.ndarray | None = None, received: float = math.nan
    ) -> np.ndarray:
        """Compensate one tool pose: position, m, and quaternion, seen from `frame`; return strut commands, m."""
        seen_from = None if frame is None else byref(CPose(tuple(frame[:3]), tuple(frame[3:])))
        pose, times = (c_double * 7)(*numbers), CTime(time, received)
        self._check(self._library.hc_command(byref(self.state), pose, times, seen_from, byref(self.answer)))
        return self.command

    def step_lengths(self, nominal: np.ndarray, time: float) -> np.ndarray:
        """Compensate nominal strut lengths, m; return strut commands, m."""
        lengths, times = (c_double * 6)(*nominal), CTime(time, math.nan)
        self._check(self._library.hc_command_lengths(byref(self.state), lengths, times, byref(self.answer)))
        return self.command

    def published(self, time: float) -> None:
        """Take notice that the last command had gone out at a time, s."""
        self._library.hc_published(byref(self.state), c_double(time))

    def estimate(self, struts: np.ndarray) -> np.ndarray:
        """Return ``pose_tool_in_base`` for strut readings, m: position, then the rotation matrix by rows."""
        lengths = (c_double * 6)(*struts)
        self._check(self._library.hc_estimate(byref(self.state), lengths, byref(self.estimated)))
        tool = self.estimated.tool
        return np.array([*tool.position, *tool.rotation])

    def enable(self, enabled: bool) -> None:
        """Switch compensation on or off."""
        self._check(self._library.hc_enable(byref(self.state), int(enabled)))

    def set_ramp_rate(self, ramp_rate: float) -> None:
        """Let ramps go on at another speed, m/s."""
        self.state.ramp_rate = ramp_rate

    def set_temperature(self, name: str, value: float, time: float = math.nan) -> None:
        """Take a temperature, °C, read at a `time`, s."""
        index = Temperatures.NAMES.index(name)
        self._check(self._library.hc_set_temperature(byref(self.state), index, c_double(value), c_double(time)))
        self._temperatures[name] = value

    def set_humidity(self, value: float, time: float = math.nan) -> None:
        """Take a relative humidity, a fraction: it acts on nothing, since struts that swell are not exported."""
        self._temperatures[HUMIDITY] = value

    def set_model(self, model: MachineModel) -> None:
        """Refuse: the model is compiled in."""
        raise ModelError("model", f"is compiled into {self._path}; the recording goes on with {model.name!r}")

    def set_tool(self, name: str) -> None:
        """Refuse another tool: that of the geometry file is compiled in."""
        if name != self.geometry.tool_name:
            raise ModelError("tool", f"{self.geometry.tool_name!r} is compiled into {self._path}; not {name!r}")

    def reset(self, measured: np.ndarray | None = None) -> None:
        """Forget the last command; with measured struts, m, start from them."""
        self._check(self._library.hc_reset(byref(self.state), None if measured is None else (c_double * 6)(*measured)))

    def snapshot(self) -> dict[str, Any]:
        """Return what decides the next answer, by the names of the Python compensator's snapshot."""
        last = self.state.last
        parts = {
            name: np.ravel(getattr(last, name)).tolist()
            for name in State._fields
            if name.partition("_")[0] not in ("platform", "model") and name != "ramp_rate"
        }
        for name in ("platform", "model"):
            pose = getattr(last, name)
            parts |= {f"{name}_position": list(pose.position), f"{name}_rotation": list(pose.rotation)}
        warmth = {"temperatures": dict(self._temperatures), "lags": self._lags()}
        return {**parts, "ramp_rate": [self.state.ramp_rate], **warmth, "tool": self.geometry.tool_name}

    def _lags(self) -> dict[str, list[float]]:
        state, count = self.state, len(self.model.late_growth.time_constants)
        heard = [n for n in range(len(PARTS)) if count and not math.isnan(state.began[n])]
        return {PARTS[n]: [state.began[n], state.newest[n], *state.behind[n][:count]] for n in heard}

    def restore(self, snapshot: Mapping[str, Any]) -> None:
        """Take over a snapshot of either compensator."""
        self.set_tool(snapshot.get("tool", self.geometry.tool_name))
        values, lags = snapshot["temperatures"], snapshot.get("lags", {})
        for name in PARTS:
            self.set_temperature(name, values.get(name, REFERENCE_TEMPERATURE), 0.0)
        for n, name in enumerate(PARTS):
            began, newest, *behind = lags.get(name, [math.nan, math.nan])
            self.state.began[n], self.state.newest[n] = began, newest
            self.state.behind[n][: len(behind)] = behind
        for name in lags:  # once more, by nothing and after no time: the core places its machine
            self.set_temperature(name, values[name], lags[name][1])
        self._temperatures = dict(snapshot["temperatures"])
        last = self.state.last
        for name, size in zip(State._fields, SIZES, strict=True):
            values = np.asarray(snapshot[name], dtype=float).tolist()
            body, _, part = name.partition("_")
            if name == "ramp_rate":
                self.state.ramp_rate = values[0]
            elif body in ("platform", "model"):
                setattr(getattr(last, body), part, (c_double * size)(*values))
            elif name in ("enabled", "changed", "resumes"):
                setattr(last, name, int(values[0]))
            else:
                setattr(last, name, values[0] if size == 1 else (c_double * size)(*values))

    def _check(self, status: int) -> None:
        if status:
            raise CRefusal(status, self._library.hc_reason(status).decode())


def load_library(path: str | Path) -> Any:
    """Return a compiled export, its functions declared.

    Raises
    ------
    InputFileError
        It cannot be loaded, lacks a function, or its state is not laid out as here.
    """
    try:
        library = ctypes.CDLL(str(Path(path).resolve()))
        library.hc_state_size.restype = ctypes.c_size_t
        library.hc_machine.restype = library.hc_reason.restype = c_void_p
        size = library.hc_state_size()
        library.hc_reason.restype = c_char_p
        library.hc_init.restype = library.hc_published.restype = None
        library.hc_init.argtypes = (c_void_p, c_void_p, c_double)
    except (OSError, AttributeError) as error:
        raise InputFileError(str(path), "", f"is no library made of an export --c: {error}") from error
    if size != ctypes.sizeof(CState):
        raise InputFileError(
            str(path), "", f"has a state of {size} bytes, not {ctypes.sizeof(CState)}: another release's"
        )
    return library
