"""The compensator: it computes six strut commands from a commanded tool pose, and checks every limit.

The core (``compensation.c``) computes the platform's pose in ``base`` and the nominal strut lengths at this pose. The
inverted model gives the corrections, whose changes are ramped; a command is nominal length + correction. Last, all
limits are checked, for the nominal lengths and for the commands.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from enum import Enum
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from ..core import Status, Struct, ffi, lib
from ..core.batch import backwards, given, solve_linear
from ..errors import (
    HexapodError,
    LimitError,
    ModelError,
    NotConvergedError,
    NotFiniteError,
    OutsideFieldError,
    PoseError,
)
from ..machine.geometry import STRUT_NAMES, HexapodGeometry, pose_text
from ..machine.kinematics import forward_error, jacobian
from ..machine.load import FREE, Loading, beyond_loads
from ..machine.model import MachineModel, MotionState, RealMachine, core_model, write_loading, write_temperatures
from ..machine.outside import read_numbers
from ..machine.region import box_text
from ..machine.temperatures import HUMIDITY, PARTS, Lag, Temperatures, check_part
from ..pose import Pose, rotation_from_vector

DEFAULT_RAMP_RATE = 1e-3  # Largest strut speed, m/s, that the ramp after a change (model, temperature, on/off) adds

DRIFT_STATES = 12  # Number of values of a drift: six of the base's pose, and six strut offsets, as in :func:`drifted`

# For each value of a snapshot that is no number of the core, by key: the function that reads the value from JSON
BESIDE: dict[str, Callable[[Any], Any]] = {
    "temperatures": lambda found: {str(name): float(value) for name, value in found.items()},
    "lags": lambda found: {str(name): [float(value) for value in values] for name, values in found.items()},
    "tool": str,
    "drift": lambda found: [float(value) for value in found],
    "loading": lambda found: Loading.from_numbers(found).numbers(),
    "outside": read_numbers,
}


@dataclass(frozen=True)
class Correction:
    """Full record of one compensated command.

    Attributes
    ----------
    tool : str
        Name of the tool in use.
    tool_pose : Pose
        Commanded ``pose_tool_in_work``.
    platform_pose : Pose
        The command as ``pose_platform_in_base``.
    model_pose : Pose
        Pose q with q ∘ E(q) = platform_pose, for which the real structure's strut lengths were computed.
    sense : ndarray, shape (9,)
        Directions of motion used: x, y, z of the measured point, six struts.
    temperatures : dict of str to float
        Readings used, °C, and ``humidity``, a fraction. Without a reading, 20 °C or a humidity of 0.5 is used.
    nominal : ndarray, shape (6,)
        Strut lengths of the nominal machine, m.
    correction : ndarray, shape (6,)
        command − nominal, m.
    command : ndarray, shape (6,)
        Commanded strut lengths, m.
    predicted_error : ndarray, shape (6,)
        Error that the tool would have with nominal strut lengths: displacement (m) and rotation (rad) along the axes
        of ``base``; to first order −J⁻¹ · (the model's full corrections), J: Jacobian.
    condition : float
        Condition number of the nominal pose.
    enabled : bool
        Compensation was on.
    ramping : bool
        A change of model, temperature or on/off state is still ramping in.
    outside_field : bool
        The error field's value was held at the boundary of the field's box.
    outside_box : bool
        The command is outside the region in which the model was measured.
    """

    tool: str
    tool_pose: Pose
    platform_pose: Pose
    model_pose: Pose
    sense: np.ndarray
    temperatures: dict[str, float]
    nominal: np.ndarray
    correction: np.ndarray
    command: np.ndarray
    predicted_error: np.ndarray
    condition: float
    enabled: bool
    ramping: bool
    outside_field: bool
    outside_box: bool


class Phase(Enum):
    """Phases of a compensator: they differ in where the next command may start. :data:`TRANSITIONS` has the changes."""

    FIRST = "the next command, the first after a start or reset, must be within one step of the struts' known lengths"
    RESUMED = "the next command starts at the measured strut lengths; the later ones ramp to the compensated lengths"
    NEW_TOOL = "the next command must keep the struts' present lengths, because another tool was selected"
    RAMPING = "the next command starts at the last command; the corrections still ramp after a change"
    RUNNING = "the next command starts at the last command"


_ALWAYS = {"reset": Phase.FIRST, "reset to struts": Phase.RESUMED, "command": Phase.RUNNING, "ramped": Phase.RAMPING}
# The phase after each event. ``change``: model, temperature, humidity or `enabled` has changed. ``command``: a
# command was accepted and no change is ramping after it. ``ramped``: a command was accepted and a change is still
# ramping. A refused command changes nothing. doc/states.md shows TRANSITIONS, and tests compare the core with it.
TRANSITIONS = {
    Phase.FIRST: {**_ALWAYS, "tool": Phase.FIRST, "change": Phase.FIRST},
    Phase.RESUMED: {**_ALWAYS, "tool": Phase.RESUMED, "change": Phase.RESUMED},
    Phase.NEW_TOOL: {**_ALWAYS, "tool": Phase.NEW_TOOL, "change": Phase.NEW_TOOL},
    Phase.RAMPING: {**_ALWAYS, "tool": Phase.NEW_TOOL, "change": Phase.RAMPING},
    Phase.RUNNING: {**_ALWAYS, "tool": Phase.NEW_TOOL, "change": Phase.RAMPING},
}


def drifted(geometry: HexapodGeometry, model: MachineModel, drift: np.ndarray) -> MachineModel:
    """Return the model of a machine that has drifted by `drift` since `model` was fitted.

    `drift` has twelve numbers, m: the base's displacement along the axes of ``base`` (3), the base's rotation vector
    about the platform's home position times the machine's characteristic length (3), and, for each strut, its length
    minus its encoder reading (6).
    """
    if not drift.any():
        return model
    centre, turn = geometry.home.position, drift[3:6] / geometry.characteristic_length
    joints = geometry.base_joints + model.base_deviation
    moved = centre + drift[:3] + (joints - centre) @ rotation_from_vector(turn).T
    return replace(
        model,
        base_deviation=model.base_deviation + (moved - joints),
        base_axes_turn=model.base_axes_turn + turn,
        struts=replace(model.struts, offset=model.struts.offset + drift[6:]),
    )


def pack_pose(pose: Pose) -> Struct:
    return Struct("hc_pose", {"position": pose.position, "rotation": pose.rotation})


class Compensator:
    """Converter of commanded tool poses into compensated strut commands for one machine.

    Parameters
    ----------
    geometry : HexapodGeometry
        Nominal machine and limits.
    model : MachineModel
        Deviations of the real machine from the nominal machine.
    ramp_rate : float, optional
        Largest rate, m/s, at which a strut's correction follows a change of model, temperature or on/off state.

    Raises
    ------
    ModelError
        The model belongs to another machine.

    Notes
    -----
    The C core applies all rules; this class keeps the core's ``hc_state`` between two commands, and turns refusals into
    errors. A control loop calls :meth:`step`, which returns only strut commands; :meth:`correct` returns the full
    record.

    Attributes
    ----------
    geometry : HexapodGeometry
        The machine with the tool in use.
    model : MachineModel
        The model in use.
    command, nominal, correction : ndarray, shape (6,)
        Strut commands, nominal lengths and corrections of the last accepted command, m; the next command overwrites
        these arrays. NaN before the first command; a reset to measured struts sets `command` to the measured lengths.
    condition : float
        Condition number of the last nominal pose.
    outside_field : bool
        At the last command the error field's value was held at the boundary of the field's box.
    motion : MotionState
        Directions of motion after the last command.
    on_change : callable
        Called after each change of an input, with its name and value: ``temperature`` (name, °C, time), ``humidity``
        (fraction, time), ``load`` (:meth:`.Loading.numbers`), ``outside`` (all external quantities by their names),
        ``model``, ``drift`` (twelve, m), ``enable`` (bool), ``tool`` (name), ``ramp_rate`` (m/s), ``reset`` (measured
        struts or None). Commanded poses and all changes of inputs suffice to compute all strut commands again.
    """

    def __init__(self, geometry: HexapodGeometry, model: MachineModel, ramp_rate: float = DEFAULT_RAMP_RATE) -> None:
        self.geometry, self.model = geometry, model
        self.condition, self.outside_field = math.nan, False
        self.on_change: Callable[[str, Any], None] = lambda what, value: None
        self._constants, self._state = core_model(geometry, model), Struct("hc_state")
        self._at, self._answer = self._state.at, ffi.new("hc_answer *")
        self._time, self._estimated = ffi.new("hc_time *"), ffi.new("hc_estimated *")
        lib.hc_init(self._at, self._constants.at, ramp_rate)
        self._sensed: set[str] = set()
        self.loading = FREE
        self.outside: dict[str, float] = {}
        self.drift: np.ndarray = np.zeros(DRIFT_STATES)
        self._machine: RealMachine | None = None
        self._parts = parts = named_parts(self._state)
        self.command, self.nominal, self.correction = (parts[name] for name in ("command", "nominal", "correction"))
        # The arrays `command` and `correction` as C pointers
        self.command_at, self.correction_at = self._at.last.command, self._at.last.correction
        self.motion = MotionState(parts["motion_low"], parts["motion_sense"])
        self._tool_pose = np.frombuffer(ffi.buffer(ffi.addressof(self._estimated.tool)), dtype=float)

    @property
    def platform(self) -> Pose:
        """``pose_platform_in_base`` of the last command; before the first command, the home pose."""
        return pose_of(self._at.last.platform)

    @property
    def ramping(self) -> bool:
        """Whether the corrections still ramp after a change of model, temperature or on/off state."""
        return bool(self._parts["ramp"].any() or self._at.last.changed)

    @property
    def phase(self) -> Phase:
        if self._at.last.resumes:
            return Phase.RESUMED if self._at.last.resumes == lib.HC_FROM_MEASURED else Phase.NEW_TOOL
        if math.isnan(self._at.last.nominal[0]):
            return Phase.FIRST
        return Phase.RAMPING if self.ramping else Phase.RUNNING

    @property
    def enabled(self) -> bool:
        return bool(self._at.last.enabled)

    @property
    def unread(self) -> tuple[str, ...]:
        """Names of parts, and ``humidity``, whose readings the model needs but which were never set."""
        return tuple(name for name in self.model.sensors if name not in self._sensed)

    @property
    def temperatures(self) -> Temperatures:
        """Temperatures and humidity in use, and how far parts with time constants lag behind their sensors."""
        view = self._state.view
        values = {name: float(view["temperatures"][n]) for n, name in enumerate(PARTS) if name in self._sensed}
        if HUMIDITY in self._sensed:
            values[HUMIDITY] = float(view["humidity"])
        late, lags = range(self._constants.at.late.count), {}
        for n, name in enumerate(PARTS):
            if late and not math.isnan(view["began"][n]):
                behind = [float(view["behind"][n][k]) for k in late]
                lags[name] = Lag(float(view["began"][n]), float(view["newest"][n]), behind)
        return Temperatures(values, lags)

    @property
    def machine(self) -> RealMachine:
        """The machine in use, with its model, at the present temperatures."""
        if self._machine is None:
            model = self._at_present(self.model, self.outside, self.drift)
            self._machine = RealMachine(self.geometry, model, self.temperatures, self.loading)
        return self._machine

    def _at_present(self, model: MachineModel, outside: Mapping[str, float], drift: np.ndarray) -> MachineModel:
        return drifted(self.geometry, model.at(outside), drift)

    def set_drift(self, drift: np.ndarray) -> None:
        """Set the machine's drift since its model was fitted, see :func:`drifted`; the corrections ramp to new values.

        Raise the errors of :meth:`set_model`, and a ModelError if `drift` is not twelve finite numbers. After an error
        the previous drift stays in use.
        """
        drift = read_drift("drift", drift)
        if not np.array_equal(drift, self.drift):
            self._replace_model(self.model, self.outside, drift)
            self.on_change("drift", drift.tolist())

    def set_outside(self, numbers: Mapping[str, float]) -> None:
        """Set external quantities, such as elevation, by name, in SI or °C; the corrections ramp to their new values.

        Quantities that are not in `numbers` keep their values. Quantities that the model's table does not use are
        stored for the next model. The model's table has no effect until each of its quantities was set. Raise the
        errors of :meth:`set_model`; a ModelError if a number is not finite, or so far outside the table's range that it
        must be in another unit; an OutsideTableError if a number is outside a table whose `beyond` is ``refuse``. After
        an error all external quantities keep their values.
        """
        outside = self.outside | read_numbers(numbers)
        if outside != self.outside:
            table = self.model.outside
            table.validate(outside)
            if np.array_equal(table.evaluate(outside), table.evaluate(self.outside)):
                self.outside = outside
            else:
                self._replace_model(self.model, outside, self.drift)
            self.on_change("outside", outside)

    def set_model(self, model: MachineModel) -> None:
        """Replace the model, and set the drift to zero; the corrections ramp from the old model's to the new model's.

        Raise a ModelError if the model belongs to another machine. Raise a LimitError, KinematicsError or
        OutsideFieldError if, after the ramp, the new corrections would break a limit at the last commanded pose (before
        the first command: at home). After an error the old model stays in use.
        """
        model.outside.validate(self.outside)
        self._replace_model(model, self.outside, np.zeros(DRIFT_STATES))
        self.on_change("model", model)

    def _replace_model(self, model: MachineModel, outside: dict[str, float], drift: np.ndarray) -> None:
        constants = core_model(self.geometry, self._at_present(model, outside, drift))
        if lib.hc_check(self._at, constants.at, self._answer):
            raise refusal(self._answer, self.geometry, model)
        lib.hc_set_model(self._at, constants.at)
        self._constants, self.model, self._machine = constants, model, None
        self.outside, self.drift = outside, drift

    def check(self) -> None:
        """Raise an error if the model's full corrections break a limit at the last commanded pose, see `set_model`."""
        if lib.hc_check(self._at, self._constants.at, self._answer):
            raise refusal(self._answer, self.geometry, self.model)

    def set_temperature(self, name: str, value: float, time: float = math.nan) -> None:
        """Set a temperature, °C, of a strut, ``base`` or ``platform``; the corrections ramp to their new values.

        Filter readings first, for example with :class:`.TemperatureFilter`, because their noise moves the struts. If
        the model has time constants, `time` must be the reading's time on a monotonic clock, s. Raise a ModelError if
        the name is unknown, if the value is outside the allowed range, or if the model needs a time and `time` is NaN.
        """
        check_part(name)
        if lib.hc_set_temperature(self._at, PARTS.index(name), value, time):
            Temperatures().set(name, value)  # raises an error if the value is out of range
            raise ModelError(f"time of the temperature of {name}", "must be finite: the model has time constants")
        self._sensed.add(name)
        self._machine = None
        self.on_change("temperature", (name, float(value), time))

    def set_humidity(self, value: float, time: float = math.nan) -> None:
        """Set the air's relative humidity, a fraction, read at `time`, s; the corrections ramp to their new values.
        Raise a ModelError if the value is outside the allowed range.
        """
        if lib.hc_set_humidity(self._at, value):
            Temperatures().set(HUMIDITY, value)
        self._sensed.add(HUMIDITY)
        self._machine = None
        self.on_change("humidity", (float(value), time))

    def set_load(self, loading: Loading) -> None:
        """Set gravity, and the wrench of all forces on the platform except weight; the corrections ramp to new values.

        If the model has no stiffness (block ``load``), gravity and wrench are only stored, for the next model. Raise
        the errors of :meth:`.Loading.of`.
        """
        loading = Loading.of(*loading)
        if loading != self.loading:
            lib.hc_set_load(self._at, loading.gravity or (math.nan,) * 3, loading.wrench)
            self.loading, self._machine = loading, None
            self.on_change("load", loading.numbers())

    def set_tool(self, name: str) -> None:
        """Select another tool by its name; the struts do not move. From the next command on, the corrections ramp to
        their values for the new tool's weight.

        The next command must be the new tool's pose at the struts' present lengths. Every other command is refused, so
        that a command for the old tool cannot move the struts; a reset or another selection removes this rule. Raise a
        FrameError if the machine has no tool of this name; then the old tool stays selected.
        """
        self._use_geometry(self.geometry.using(tool=name))
        self.on_change("tool", name)

    def _use_geometry(self, geometry: HexapodGeometry) -> None:
        constants = core_model(geometry, self._at_present(self.model, self.outside, self.drift))
        lib.hc_set_tool(self._at, constants.at)
        self.geometry, self._constants, self._machine = geometry, constants, None

    def enable(self, enabled: bool) -> None:
        """Switch compensation on or off; corrections ramp from or to 0. Switching on may raise `set_model`'s errors."""
        if enabled != self.enabled:
            if enabled:
                self.check()
            lib.hc_enable(self._at, enabled)
            self.on_change("enable", enabled)

    def set_ramp_rate(self, ramp_rate: float) -> None:
        """Set the ramp rate, m/s; raise a HexapodError if it is not positive and finite."""
        if not 0.0 < ramp_rate < math.inf:
            raise HexapodError(f"ramp_rate must be positive and finite, m/s, not {ramp_rate!r}")
        if ramp_rate != self._at.ramp_rate:
            self._at.ramp_rate = ramp_rate
            self.on_change("ramp_rate", ramp_rate)

    def reset(self, measured: np.ndarray | None = None) -> None:
        """Forget the last command and all directions of motion.

        Without `measured`, the struts must not have moved: the corrections ramp from their last values. `measured` are
        six measured lengths, m: the next command may be one `step` (a limit) from them, and the corrections ramp from
        `measured` − (nominal lengths of this command), if this difference is within the limit `correction`.
        """
        if measured is None:
            lib.hc_reset(self._at, ffi.NULL)
        else:
            measured = np.array(measured, dtype=float)
            if measured.shape != (6,) or lib.hc_reset(self._at, given("measured", measured, 6)):
                raise NotFiniteError("measured strut lengths must be six finite numbers, m", measured.tolist())
        self.on_change("reset", None if measured is None else measured.tolist())

    def snapshot(self) -> dict[str, Any]:
        """Return as a dict the state that, with geometry and model, determines the strut commands for the next pose.

        The keys are ``temperatures`` (°C by part; also ``humidity``), ``lags`` of parts with time constants, ``tool``,
        ``drift``, ``loading``, ``outside`` and the names of :func:`named_parts`; arrays are lists, matrices row by row.
        """
        return {
            **{name: np.ravel(part).astype(float).tolist() for name, part in self._parts.items()},
            **self.temperatures.snapshot(),
            "tool": self.geometry.tool_name,
            "drift": self.drift.tolist(),
            "loading": self.loading.numbers(),
            "outside": dict(self.outside),
        }

    def restore(self, snapshot: Mapping[str, Any]) -> None:
        """Restore a :meth:`snapshot` of a compensator with this geometry and model.

        Raise a ModelError if a key is missing or unknown, if a list has the wrong length, or if a temperature is not in
        the allowed range. Raise a FrameError if the machine does not have the snapshot's tool.
        """
        for name in sorted({*self._parts, *BESIDE} ^ {*snapshot}):
            raise ModelError(f"snapshot.{name}", "is unknown to this release" if name in snapshot else "is missing")
        constants = self.model.late_growth.time_constants
        temperatures = Temperatures.restored(snapshot["temperatures"], snapshot["lags"], len(constants))
        drift, loading = read_drift("snapshot.drift", snapshot["drift"]), Loading.from_numbers(snapshot["loading"])
        outside = read_numbers(snapshot["outside"])
        self.model.outside.validate(outside)
        parts = {name: np.asarray(snapshot[name], dtype=float) for name in self._parts}
        for name, part in self._parts.items():
            if parts[name].shape != (part.size,):
                raise ModelError(f"snapshot.{name}", f"must be {part.size} numbers", parts[name].size)
            largest = lib.HC_WITH_NEW_TOOL if name == "resumes" else 1
            if part.dtype.kind == "i" and parts[name][0] not in range(largest + 1):
                raise ModelError(f"snapshot.{name}", f"must be a whole number, 0…{largest}", float(parts[name][0]))
        geometry = self.geometry.using(tool=snapshot["tool"])
        lib.hc_init(self._at, self._constants.at, 0.0)
        write_temperatures(self._state, temperatures)
        write_loading(self._state, loading)
        self._sensed, self.drift, self.loading, self.outside = set(temperatures.values), drift, loading, outside
        self._use_geometry(geometry)
        for name, part in self._parts.items():
            part[...] = parts[name].reshape(part.shape)

    def step(
        self, numbers: tuple[float, ...], time: float, frame: Struct | None = None, received: float = math.nan
    ) -> np.ndarray:
        """Compensate one commanded tool pose; a control loop calls this method for each command.

        Parameters
        ----------
        numbers : tuple of seven float
            Position x, y, z, m, and quaternion x, y, z, w of the tool in `frame`.
        time : float
            Time at which the command was made, s: the node passes the stamp in nanoseconds × 1e-9. Only the
            differences between the times of commands are used; a ramp advances by at most 20 ms per command. So the
            same commands with the same times give the same strut commands bit for bit, and a step of a clock cannot
            move the struts. If `time` is NaN (unknown), `received` is used instead.
        frame : Struct, optional
            Pose of the command's frame in ``base``, packed by
            :func:`pack_pose`; the geometry's work frame by default.
        received : float, optional
            Time of receipt, s, on a monotonic clock. If it is NaN (unknown), the speed is computed from `time` alone.

        Returns
        -------
        ndarray, shape (6,)
            Strut commands, m; this compensator's own array, valid until the next call.

        Raises
        ------
        PoseError, LimitError, KinematicsError, OutsideFieldError
            The command was refused and changed nothing. After a :class:`~hexapod_comp.errors.TooEarlyError` the same
            command may be tried again later.
        """
        if len(numbers) != 7:
            raise PoseError(f"position and quaternion are seven numbers, not {len(numbers)}", list(numbers))
        made, answer = self._time, self._answer
        made.made, made.received = time, received
        where = ffi.NULL if frame is None else frame.at
        if lib.hc_command(self._at, numbers, made[0], where, answer):
            raise refusal(answer, self.geometry, self.model, numbers, self.platform)
        self.condition, self.outside_field = answer.condition, bool(answer.outside_field)
        return self.command

    def published(self, time: float) -> None:
        """Set the time, s, at which the last strut commands were published, on the clock of `received` in :meth:`step`.

        The limit of strut speed applies between publications: after a late publication, the next one must be later too.
        """
        lib.hc_published(self._at, time)

    def estimate(self, struts: np.ndarray | tuple[float, ...]) -> np.ndarray:
        """Return the tool's pose that the model predicts for six encoder readings or strut commands, m.

        The result is ``pose_tool_in_base`` as twelve numbers: position, m, then rotation matrix row by row. The next
        call of `estimate` overwrites the result. Raise a KinematicsError if no pose has these lengths; the next
        estimate then iterates from the last successful estimate.
        """
        at = struts if isinstance(struts, tuple) and len(struts) == 6 else given("struts", np.asarray(struts), 6)
        status = lib.hc_estimate(self._at, at, self._estimated)
        if status:
            raise forward_error(status, self._estimated.condition, self.geometry.limits.condition)
        return self._tool_pose

    @property
    def platform_estimate(self) -> tuple[np.ndarray, np.ndarray]:
        """Pose of the platform in ``base`` at the last estimate, without the error field: position (m) and rotation."""
        estimate = self._state.view["estimate"]
        return estimate["position"], estimate["rotation"]

    def correct(self, tool_pose: Pose, time: float = math.nan) -> Correction:
        """Compensate one commanded tool pose, ``pose_tool_in_work``, and return the full record.

        Ramps and speed limits use the command's `time`, s, as in :meth:`step`. If `time` is NaN, ramps do not advance
        and speeds are not limited. Raise the errors of :meth:`step`; a refused command changes nothing.
        """
        self.step_to(tool_pose, time)
        return self.record(tool_pose)

    def step_to(self, tool_pose: Pose, time: float = math.nan) -> np.ndarray:
        """Compensate one tool pose as :meth:`correct` does; return only the strut commands, as :meth:`step` does."""
        made = self._time
        made.made, made.received = time, math.nan
        if lib.hc_command_pose(self._at, pack_pose(tool_pose).at, made[0], ffi.NULL, self._answer):
            raise refusal(self._answer, self.geometry, self.model, (), self.platform)
        self.condition, self.outside_field = self._answer.condition, bool(self._answer.outside_field)
        return self.command

    def record(self, tool_pose: Pose) -> Correction:
        """Return the record of the last accepted command, whose tool pose in the work frame was `tool_pose`."""
        return Correction(
            tool=self.geometry.tool_name,
            tool_pose=tool_pose,
            platform_pose=self.platform,
            model_pose=pose_of(self._at.last.model),
            sense=self.motion.sense.copy(),
            temperatures=dict(self.temperatures.values),
            nominal=self.nominal.copy(),
            correction=self.correction.copy(),
            command=self.command.copy(),
            predicted_error=self.predicted_error(),
            condition=self.condition,
            enabled=self.enabled,
            ramping=self.ramping,
            outside_field=self.outside_field,
            outside_box=self.outside_box,
        )

    @property
    def outside_box(self) -> bool:
        """Whether the last command is outside the region in which the model was measured."""
        platform, region = self.platform, self.model.measured
        return region is not None and not region.contains(platform.position, platform.rotation)

    @property
    def outside_load(self) -> str:
        """Text on a present payload or gravity that differs from those of the model's readings; empty if none does."""
        gravity = self.loading.gravity or tuple(self.model.load.gravity.tolist())
        return beyond_loads(self.model.origin.loads, self.geometry.payload, gravity)

    def predicted_error(self) -> np.ndarray:
        """Return the error, (6,), that the tool would have at the last commanded pose with nominal strut lengths."""
        platform, low, sense = self.platform, self.motion.low.copy(), self.motion.sense.copy()
        given_rows = (array[None] for array in (platform.position, platform.rotation, low, sense))
        _, _, (commands,), (outcome,) = backwards(self._state, *given_rows)
        if outcome == Status.NOT_CONVERGED:
            raise NotConvergedError()
        twist = self.nominal - commands  # −1 × the full correction, even while the correction ramps or is off
        solve_linear(jacobian(self.geometry, platform), twist)
        twist[:3] += np.cross(twist[3:], platform.rotation @ self.geometry.tool.position)
        return twist


def named_parts(state: Struct) -> dict[str, np.ndarray]:
    """Return by name views of the numbers of `state` that a snapshot contains: the ramp rate and the members of
    ``hc_last``, where a pose has two views, position and rotation.
    """
    last, parts = state.view["last"], {"ramp_rate": state.view["ramp_rate"]}
    for name in last.dtype.names or ():
        pose = last.dtype[name].names
        parts |= {f"{name}_{part}": last[name][part] for part in pose} if pose else {name: last[name]}
    return parts


def read_drift(key: str, drift: ArrayLike) -> np.ndarray:
    numbers = np.array(drift, dtype=float)
    if numbers.shape != (DRIFT_STATES,) or not np.isfinite(numbers).all():
        raise ModelError(key, f"must be {DRIFT_STATES} finite numbers, m", numbers.tolist())
    return numbers


def refusal(
    answer: Any,
    geometry: HexapodGeometry,
    model: MachineModel,
    numbers: Sequence[float] = (),
    present: Pose | None = None,
) -> HexapodError:
    """Return the error that describes why the core has refused a command.

    `numbers` are the refused position and quaternion; `present` is the platform's pose in ``base`` at the last command.
    """
    status = answer.status
    if status == Status.QUATERNION:
        norm = math.hypot(*numbers[3:])
        problem = f"quaternion must have norm 1 within {lib.QUATERNION_TOLERANCE:g}, not {norm:.6g}"
        return PoseError(problem, list(numbers[3:]), "quaternion")
    if status == Status.NOT_FINITE and answer.strut < 0:
        return PoseError("pose must be finite", list(numbers), "not_finite")
    if status == Status.NOT_CONVERGED:
        return NotConvergedError()
    if status == Status.OUTSIDE_FIELD:
        platform, box = pose_of(answer.platform), model.field.box
        point = (platform.position + platform.rotation @ model.field.probe) * 1e3
        problem = f"the measured point ({point[0]:.3f}, {point[1]:.3f}, {point[2]:.3f}) mm is outside the field's box"
        return OutsideFieldError(f"{problem} {box_text(box)}, in base", point, box * 1e3)
    if status == Status.TOOL_CHANGED:
        problem = (
            f"after the change to tool {geometry.tool_name!r} the first command must not move the struts: "
            f"{STRUT_NAMES[answer.strut]} would move by {answer.value * 1e3:.4f} mm, "
            f"allowed {lib.SAME_PLACE * 1e3:g} mm; in {geometry.work_name} the tool is at "
            f"{pose_text(geometry.tool_pose(present or geometry.home))}"
        )
        return LimitError("tool_changed", problem, answer.value, lib.SAME_PLACE, answer.strut, "nominal")
    return geometry.limits.error(status, answer.strut, answer.compensated, answer.value)


def pose_of(pose: Any) -> Pose:
    numbers = np.frombuffer(ffi.buffer(ffi.addressof(pose)), dtype=float)
    return Pose(numbers[:3], numbers[3:].reshape(3, 3))
