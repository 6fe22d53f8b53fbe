"""From a commanded tool pose to six compensated strut commands, with every limit checked on what is sent.

Data flow of one command: tool pose in the work frame → platform pose in ``base`` → nominal lengths; → model
run backwards → corrections → ramp → commands → limits on nominal and on compensated values → `Correction`.
A refused command leaves the compensator exactly as it was.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from ..errors import HexapodError, ModelError, NotConvergedError, NotFiniteError
from ..kernels import kinematics as kernels
from ..kernels.compensation import OUTSIDE, compensate_one, compensate_quaternion, estimate_one
from ..kernels.pose import quaternion_of
from ..machine.frames import TOOL
from ..machine.geometry import HexapodGeometry
from ..machine.kinematics import forward_error, strut_lengths
from ..machine.model import MachineModel, RealMachine
from ..machine.motion import MotionState
from ..machine.temperatures import HUMIDITY, Temperatures, check_part
from ..pose import Pose
from .findings import refuse, refuse_motion
from .state import TOOL_CHANGED, CommandState, Correction, pack_fixed, pack_pose, read_state

DEFAULT_RAMP_RATE = 1e-3
"""How fast a change of model, temperature or enabling moves a strut, m/s."""

NO_SHIFT = np.concatenate([np.zeros(3), np.eye(3).ravel()])  # as pack_pose, but nothing compiles while modules load
"""Frame of poses that are in ``base`` already."""


class Compensator:
    """Turns commanded tool poses into compensated strut commands for one machine.

    Parameters
    ----------
    geometry : HexapodGeometry
        Nominal machine and limits.
    model : MachineModel
        What the real machine does differently.
    ramp_rate : float, optional
        Largest strut speed at which a change of model, temperatures or enabling is taken up, m/s.

    Raises
    ------
    ModelError
        The model belongs to another machine.

    Notes
    -----
    :meth:`step` is the loop's entry: it works on preallocated arrays and returns nothing but what must be
    sent. :meth:`correct` does the same and gives the full record.

    Attributes
    ----------
    geometry : HexapodGeometry
        The machine with the tool in use.
    on_change : callable
        Called after each change from outside, with its name and value: ``temperature`` (name, °C, time), ``humidity``
        (fraction, time), ``model``, ``enable`` (bool), ``tool`` (name), ``ramp_rate`` (m/s), ``reset`` (measured struts
        or None). Together with the commands these decide all answers.
    """

    def __init__(self, geometry: HexapodGeometry, model: MachineModel, ramp_rate: float = DEFAULT_RAMP_RATE) -> None:
        self.geometry = geometry
        self.temperatures = Temperatures()
        self.machine = RealMachine(geometry, model)
        self.condition = math.nan
        self.outside_field = False
        self._work = pack_pose(geometry.work)
        self._last, self._next = CommandState(ramp_rate), CommandState(ramp_rate)
        self._take_machine(RealMachine(geometry, model))
        self._model_pose, self._tool_pose = np.empty(12), np.empty(12)
        self.on_change: Callable[[str, Any], None] = lambda what, value: None
        self._forget()

    @property
    def command(self) -> np.ndarray:
        """Strut commands last accepted, m; NaN before the first, the measured struts after a reset."""
        return self._last.state.command

    @property
    def nominal(self) -> np.ndarray:
        """Nominal strut lengths of the last command, m; NaN before the first."""
        return self._last.state.nominal

    @property
    def correction(self) -> np.ndarray:
        """Corrections of the last command, m; NaN before the first."""
        return self._last.state.correction

    @property
    def platform(self) -> Pose:
        """``pose_platform_in_base`` of the last command; not finite before the first."""
        return self._last.platform

    @property
    def motion(self) -> MotionState:
        """Directions of motion after the last command."""
        return self._last.motion

    @property
    def model(self) -> MachineModel:
        """The model in use."""
        return self.machine.model

    @property
    def ramping(self) -> bool:
        """Whether a change has not been fully taken up yet."""
        return bool(self._last.state.ramp.any() or self._last.state.changed[0])

    @property
    def enabled(self) -> bool:
        """Whether it compensates."""
        return bool(self._last.state.enabled[0])

    def set_model(self, model: MachineModel) -> None:
        """Replace the model; the corrections ramp from the old one's to the new one's.

        Raises
        ------
        ModelError
            The model belongs to another machine.
        LimitError, KinematicsError, OutsideFieldError
            What it would correct at the last command, before the first one at home, breaks a limit: the ramp would
            drag the struts there and be refused on its way. The old model stays.
        """
        temperatures = self.temperatures
        if model.late_growth.time_constants != self.model.late_growth.time_constants:
            temperatures = Temperatures(temperatures.values)  # other lags begin anew, at rest
        self._check_whole(RealMachine(self.geometry, model, temperatures))
        self.temperatures = temperatures
        self._renew(model)
        self.on_change("model", model)

    def _renew(self, model: MachineModel) -> None:
        """Take a model at the present temperatures."""
        machine = RealMachine(self.geometry, model, self.temperatures)
        before, after = self._followed(self.machine), self._followed(machine)
        if before is not None and after is not None:
            # The model's lengths jump, the struts do not: without this the jump would count as a motion,
            # turn directions round, and a backlash would step when they turn back.
            self.motion.low[:] += after - before
        self._take_machine(machine)
        self._last.state.changed[:] = 1.0

    def _check_whole(self, machine: RealMachine) -> None:
        """Raise when a machine's whole correction, without ramp or switch, breaks a limit at the last command."""
        trial, tried = CommandState(0.0), CommandState(0.0)
        home = not np.isfinite(self.nominal).all()
        platform = self.geometry.home if home else self._last.platform
        trial.motion.copy_from(self.motion)
        tool = platform @ self.geometry.tool
        # By the kernel of :meth:`step`, which is loaded anyway: each costs a node 4 MB.
        pose, times = (*tool.position, *quaternion_of(tool.rotation)), (math.nan, math.nan)
        outcome = compensate_quaternion(*pose, *times, NO_SHIFT, pack_fixed(machine), trial.numbers, tried.numbers)
        refuse(outcome, tried, machine)

    def _followed(self, machine: RealMachine) -> np.ndarray | None:
        """Return the nine values whose directions are followed, at the last command, under a machine's model.

        None before the first command, and where the model's field cannot be undone: it is refused there.
        """
        if not np.isfinite(self.nominal).all():
            return None
        platform, motion = self._last.platform, MotionState()
        motion.copy_from(self.motion)
        try:
            _, model_pose, _ = machine.commands_for(platform, motion)
        except NotConvergedError:
            return None
        point = platform.position + platform.rotation @ machine.model.field.probe
        return np.concatenate([point, strut_lengths(machine.structure, model_pose)])

    def _take_machine(self, machine: RealMachine) -> None:
        self.machine, self._fixed = machine, pack_fixed(machine)

    def set_temperature(self, name: str, value: float, time: float = math.nan) -> None:
        """Take a temperature, °C, of a strut, ``base`` or ``platform``; its effect ramps in.

        Filter it, or its noise moves the struts: :class:`~hexapod_comp.compensation.thermal.TemperatureFilter`.
        A model with time constants needs the `time`, s, when it was read, on a clock that is never set.

        Raises
        ------
        ModelError
            Unknown name, a value outside the allowed range, or no time where it is needed.
        """
        check_part(name)
        self._take_reading(name, value, time)
        self.on_change("temperature", (name, self.temperatures.values[name], time))

    def set_humidity(self, value: float, time: float = math.nan) -> None:
        """Take the air's relative humidity, a fraction, read at a time, s; its effect on struts that swell ramps in.

        Raises
        ------
        ModelError
            A value outside the allowed range.
        """
        self._take_reading(HUMIDITY, value, time)
        self.on_change("humidity", (self.temperatures.values[HUMIDITY], time))

    def _take_reading(self, name: str, value: float, time: float) -> None:
        self.temperatures.follow(name, value, time, self.model.late_growth.time_constants)
        self._renew(self.model)

    def set_tool(self, name: str) -> None:
        """Take another tool by its name; nothing moves, nothing ramps.

        The next command must be where the struts are, with this tool. Until one is, and another tool or a reset may
        come first, each is refused: what was on its way for the old tool cannot step the struts.

        Raises
        ------
        FrameError
            The machine has no such tool; the old one stays.
        """
        self._use(self.geometry.using(tool=name))
        if np.isfinite(self.nominal).all():
            self._last.state.resumes[:] = TOOL_CHANGED
        self.on_change("tool", name)

    def _use(self, geometry: HexapodGeometry) -> None:
        self.geometry = geometry
        self._take_machine(RealMachine(self.geometry, self.model, self.temperatures))

    def enable(self, enabled: bool) -> None:
        """Switch compensation on or off; the corrections ramp.

        Raises
        ------
        LimitError, KinematicsError, OutsideFieldError
            As for :meth:`set_model`, when it is switched on.
        """
        if enabled != self.enabled:
            if enabled:
                self._check_whole(self.machine)
            self._last.state.enabled[:] = float(enabled)
            self._last.must_ramp()
            self.on_change("enable", enabled)

    def set_ramp_rate(self, ramp_rate: float) -> None:
        """Let ramps go on at another speed, m/s.

        Raises
        ------
        HexapodError
            It is not positive and finite.
        """
        if not 0.0 < ramp_rate < math.inf:
            raise HexapodError(f"ramp_rate must be positive and finite, m/s, not {ramp_rate!r}")
        if ramp_rate != self._last.state.ramp_rate[0]:
            self._last.state.ramp_rate[:] = ramp_rate
            self.on_change("ramp_rate", ramp_rate)

    def reset(self, measured: np.ndarray | None = None) -> None:
        """Forget the last command and all directions of motion.

        What was corrected last is not forgotten, since the struts still stand there: the next command
        starts from it and ramps.

        Parameters
        ----------
        measured : array_like, shape (6,), optional
            Where the struts are, m. When the next command's nominal lengths lie within the allowed correction
            of it, that command starts from there and ramps: the struts do not step. Elsewhere it may be at
            most one allowed step away.
        """
        if measured is None:
            self._forget()
            self.on_change("reset", None)
            return
        measured = np.array(measured, dtype=float)
        if measured.shape != (6,) or not np.isfinite(measured).all():
            raise NotFiniteError("measured strut lengths must be six finite numbers, m", measured.tolist())
        self._forget()
        self._last.state.command[:], self._last.state.resumes[:] = measured, 1.0
        self.on_change("reset", measured)

    def snapshot(self) -> dict[str, Any]:
        """Return what, beside geometry and model, decides the next answer, by name.

        ``temperatures``, °C by name, and ``humidity`` among them, ``lags`` of what follows them late, ``tool``, and
        each field of :class:`~hexapod_comp.kernels.compensation.State`: a list of numbers, matrices by rows.
        """
        return {**self._last.snapshot(), **self.temperatures.snapshot(), "tool": self.geometry.tool_name}

    def restore(self, snapshot: Mapping[str, Any]) -> None:
        """Take over a :meth:`snapshot` of a compensator with this geometry and model.

        Raises
        ------
        ModelError
            It does not have the names that a snapshot has, or under one of them not as many numbers; or a
            temperature is not allowed.
        FrameError
            The machine has not its tool.
        """
        if "temperatures" not in snapshot:
            raise ModelError("snapshot.temperatures", "is missing")
        constants = self.model.late_growth.time_constants
        temperatures = Temperatures.restored(snapshot["temperatures"], snapshot.get("lags", {}), len(constants))
        numbers, geometry = read_state(snapshot), self.geometry.using(tool=snapshot.get("tool", TOOL))
        self.temperatures = temperatures
        self._use(geometry)
        self._last.numbers[:] = numbers

    def _forget(self) -> None:
        home = self.geometry.home
        self._last.clear()
        self._model_pose[:3], self._model_pose[3:] = home.position, home.rotation.ravel()

    def step(
        self, numbers: tuple[float, ...], time: float, frame: np.ndarray | None = None, received: float = math.nan
    ) -> np.ndarray:
        """Compensate one commanded tool pose: the loop's entry.

        Parameters
        ----------
        numbers : tuple of seven float
            Position x, y, z, m, and quaternion x, y, z, w of the tool in `frame`.
        time : float
            When the command was made, s: the node gives its stamp in nanoseconds × 1e-9. Only differences
            matter: for the struts' speed, and for ramps, there no more than 20 ms forwards; so the same commands
            with the same times give the same answers bit for bit, and no jump of a clock can step. NaN: not
            known, then the time of receipt counts.
        frame : ndarray, shape (12,), optional
            Frame of the commanded pose seen from ``base``, packed by
            :func:`~hexapod_comp.compensation.state.pack_pose`; the geometry's work frame by default.
        received : float, optional
            When the command came, s, on a clock that nobody sets; NaN: not known, the speed is then limited by
            `time` alone.

        Returns
        -------
        ndarray, shape (6,)
            Strut commands, m; this compensator's own array, valid until the next call.

        Raises
        ------
        PoseError, LimitError, KinematicsError, OutsideFieldError
            The command is refused and nothing has changed. Of a
            :class:`~hexapod_comp.errors.TooEarlyError` the same command may be tried again later.
        """
        if self._last.state.resumes[0]:
            return self._resume(lambda: self._run_numbers(numbers, time, frame, received), numbers)
        return self._finish(self._run_numbers(numbers, time, frame, received), numbers)

    def published(self, time: float) -> None:
        """Take notice that the last command had gone out at a time, s, on the clock of its receipt.

        The struts' speed is limited between publications: after one that was held up, the next must not come sooner.
        """
        self._last.state.published[0] = time

    def _run_numbers(self, numbers: tuple[float, ...], time: float, frame: np.ndarray | None, received: float) -> tuple:
        """Work out the next command from a message's numbers; what it is worth, :meth:`_finish` says."""
        frame = self._work if frame is None else frame
        states = self._last.numbers, self._next.numbers
        return compensate_quaternion(*numbers, time, received, frame, self._fixed, *states)

    def _resume(self, run: Callable[[], tuple], numbers: tuple[float, ...] = ()) -> np.ndarray:
        """Take the first command after a change of tool, or after a reset to measured struts, from where they stand.

        What they differ from the command's nominal lengths counts as the correction that they stand at, if it
        could be one; the first command is then the measured struts, and ramps. A trial run finds the nominal
        lengths.
        """
        last = self._last.state
        if last.resumes[0] == TOOL_CHANGED:
            refuse_motion(outcome := run(), self._last, self._next, self.geometry)
            return self._finish(outcome, numbers)
        before = last.correction.copy(), last.changed.copy()
        run()
        standing = last.command - self._next.state.nominal
        if (np.abs(standing) <= self.geometry.limits.correction).all():
            last.correction[:], last.changed[:] = standing, 1.0
        try:
            return self._finish(run(), numbers)
        except HexapodError:
            last.correction[:], last.changed[:] = before
            raise

    def _finish(self, outcome: tuple, numbers: tuple[float, ...] = ()) -> np.ndarray:
        """Accept the command under way, or raise what was found."""
        refuse(outcome, self._next, self.machine, numbers)
        self._last, self._next = self._next, self._last
        self.condition, self.outside_field = outcome[-1], outcome[0] == OUTSIDE
        return self._last.state.command

    def estimate(self, struts: np.ndarray) -> np.ndarray:
        """Return where the tool is when the struts read `struts`, through the model.

        Parameters
        ----------
        struts : ndarray, shape (6,)
            Encoder readings, or commands, m.

        Returns
        -------
        ndarray, shape (12,)
            ``pose_tool_in_base``: position, m, then the rotation matrix by rows; this compensator's own
            array, valid until the next call.

        Raises
        ------
        KinematicsError
            There is no such pose; the next estimate starts from the last good one.
        """
        tool = self.geometry.tool
        outcome, condition = estimate_one(
            struts,
            self._last.numbers,
            self._fixed,
            tool.position,
            tool.rotation,
            self._model_pose,
            self._tool_pose,
        )
        if outcome != kernels.OK:
            raise forward_error(outcome, condition, self.geometry.limits.condition)
        return self._tool_pose

    @property
    def platform_estimate(self) -> tuple[np.ndarray, np.ndarray]:
        """Position (3,) and rotation (3, 3) of the platform in ``base`` by the last estimate, field left out."""
        return self._model_pose[:3], self._model_pose[3:].reshape((3, 3))

    def correct(self, tool_pose: Pose, time: float = math.nan) -> Correction:
        """Compensate one commanded tool pose and return the full record.

        Parameters
        ----------
        tool_pose : Pose
            ``pose_tool_in_work``.
        time : float, optional
            When the command was made, s, for ramps and speeds, as in :meth:`step`; without it neither counts.

        Raises
        ------
        LimitError, KinematicsError, OutsideFieldError
            The command is refused and nothing has changed.
        """
        if self._last.state.resumes[0]:
            self._resume(lambda: self._run_pose(tool_pose, time))
        else:
            self._finish(self._run_pose(tool_pose, time))
        return self.record(tool_pose)

    def _run_pose(self, tool_pose: Pose, time: float) -> tuple:
        """Work out the next command from a pose."""
        pose = tool_pose.position, tool_pose.rotation
        states = self._last.numbers, self._next.numbers
        return compensate_one(*pose, time, math.nan, self._work, self._fixed, *states)

    def record(self, tool_pose: Pose) -> Correction:
        """Return the record of the command just accepted for `tool_pose`."""
        platform = self._last.platform
        box = self.model.valid_box
        outside_box = box is not None and bool((platform.position < box[0]).any() or (platform.position > box[1]).any())
        return Correction(
            tool=self.geometry.tool_name,
            tool_pose=tool_pose,
            platform_pose=platform,
            model_pose=self._last.model,
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
            outside_box=outside_box,
        )

    def predicted_error(self) -> np.ndarray:
        """Return the tool error that nominal lengths would leave at the last command (see `Correction`)."""
        matrix, twist = np.empty((6, 6)), self._model_correction() * -1.0
        platform = self._last.platform
        kernels.jacobian_one(*self.geometry.kernel_joints, platform.position, platform.rotation, matrix)
        kernels.solve_six(matrix, twist)
        lever = platform.rotation @ self.geometry.tool.position
        twist[:3] += np.cross(twist[3:], lever)
        return twist

    def _model_correction(self) -> np.ndarray:
        """Return what the model would correct at the last command, ramp and switch left aside."""
        motion = MotionState()
        motion.copy_from(self.motion)
        commands, _, _ = self.machine.commands_for(self._last.platform, motion)
        return commands - self.nominal
