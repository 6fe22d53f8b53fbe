"""From a commanded tool pose to six compensated strut commands, with every limit checked on what is sent.

Data flow of one command: tool pose in the work frame → platform pose in ``base`` → nominal lengths; → model
run backwards → corrections → ramp → commands → limits on nominal and on compensated values → `Correction`.
A refused command leaves the compensator exactly as it was.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from . import kernels
from .compiling import compiled
from .errors import HexapodError, NotConvergedError, NotFiniteError, OutsideFieldError
from .geometry import HexapodGeometry
from .limits import CORRECTION, STEP, WITHIN, LimitTable, check_change, check_stage
from .machine import MachineModel, RealMachine, Temperatures, command_one
from .motion import MotionState
from .pose import Pose

DEFAULT_RAMP_RATE = 1e-3
"""How fast a change of model, temperature or enabling moves a strut, m/s."""

LONGEST_RAMP_STEP = 0.02
"""A pause between commands counts as no more than this in a ramp, s: a late command must not step."""

SOLVED, UNSOLVED, OUTSIDE = range(3)


@dataclass(frozen=True)
class Correction:
    """Everything about one compensated command.

    Attributes
    ----------
    tool_pose : Pose
        Commanded ``pose_tool_in_work``.
    platform_pose : Pose
        The same as ``pose_platform_in_base``.
    model_pose : Pose
        Pose q with q ∘ E(q) = platform_pose, for which the real structure's lengths were taken.
    sense : ndarray, shape (9,)
        Directions of motion used: x, y, z of the measured point, six struts.
    temperatures : dict of str to float
        Readings used, °C; parts without one are at 20 °C.
    nominal : ndarray, shape (6,)
        Strut lengths of the nominal machine, m.
    correction : ndarray, shape (6,)
        command − nominal, m.
    command : ndarray, shape (6,)
        What the struts are told, m.
    predicted_error : ndarray, shape (6,)
        Displacement (m) and rotation (rad) of the tool along the axes of ``base`` that nominal lengths
        would leave, to first order in the corrections: J⁻¹ times minus the model's correction.
    condition : float
        Condition number of the nominal pose.
    enabled : bool
        Compensation was on.
    ramping : bool
        A change of model, temperature or enabling has not been fully taken up yet.
    outside_field : bool
        The field's value was held at the boundary of its box.
    outside_box : bool
        The platform is outside the box for which the model was measured.
    """

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
    """

    def __init__(
        self, geometry: HexapodGeometry, model: MachineModel, ramp_rate: float = DEFAULT_RAMP_RATE
    ) -> None:
        self.geometry = geometry
        self.ramp_rate = ramp_rate
        self.limits = LimitTable(geometry)
        self.temperatures = Temperatures()
        self.machine = RealMachine(geometry, model)
        self.enabled = True
        self.command = np.empty(6)
        self.nominal = np.empty(6)
        self.correction = np.empty(6)
        self.condition = math.nan
        self.outside_field = False
        self.motion, self._next_motion = MotionState(), MotionState()
        self._tool_inverse = geometry.tool.inverse()
        self._platform = np.empty(3), np.empty((3, 3))
        self._model = np.empty(3), np.empty((3, 3))
        self._findings = np.empty(4)
        self._next = np.empty((3, 6))  # nominal, correction, command of a command under way
        self._forget()

    @property
    def model(self) -> MachineModel:
        """The model in use."""
        return self.machine.model

    @property
    def ramping(self) -> bool:
        """Whether a change has not been fully taken up yet."""
        return bool(self._bump.any()) or self._changed

    def set_model(self, model: MachineModel) -> None:
        """Replace the model; the corrections ramp from the old one's to the new one's."""
        self.machine = RealMachine(self.geometry, model, self.temperatures)
        self._changed = True

    def set_temperature(self, name: str, value: float) -> None:
        """Take a temperature reading, °C, of a strut, ``base`` or ``platform``; its effect ramps in.

        Raises
        ------
        ModelError
            Unknown name or a value outside the allowed range.
        """
        self.temperatures.set(name, value)
        self.set_model(self.model)

    def enable(self, enabled: bool) -> None:
        """Switch compensation on or off; the corrections ramp."""
        if enabled != self.enabled:
            self.enabled = enabled
            self._changed = True

    def reset(self, measured: np.ndarray | None = None) -> None:
        """Forget the last command and all directions of motion.

        Parameters
        ----------
        measured : array_like, shape (6,), optional
            Where the struts are, m: the next command may be at most one allowed step away from it.
        """
        self._forget()
        if measured is not None:
            measured = np.array(measured, dtype=float)
            if measured.shape != (6,) or not np.isfinite(measured).all():
                raise NotFiniteError("measured strut lengths must be six finite numbers, m", measured.tolist())
            self._previous[1] = measured

    def _forget(self) -> None:
        self.motion = MotionState()
        self._previous = np.full((2, 6), math.nan)  # last nominal and compensated lengths
        self._bump = np.zeros(6)
        self._next_bump = np.zeros(6)
        self._changed = False
        self._last_time = math.nan
        self.command[:] = math.nan

    def step(
        self, position: np.ndarray, rotation: np.ndarray, time: float, frame: Pose | None = None
    ) -> np.ndarray:
        """Compensate one commanded tool pose.

        Parameters
        ----------
        position, rotation : ndarray, shape (3,), (3, 3)
            Tool pose in `frame`; trusted to be a pose (see :class:`~hexapod_comp.pose.Pose`).
        time : float
            Monotonic clock, s; only its differences matter, for ramps.
        frame : Pose, optional
            Frame of the commanded pose, seen from ``base``; the geometry's work frame by default.

        Returns
        -------
        ndarray, shape (6,)
            Strut commands, m; this compensator's own array, valid until the next call.

        Raises
        ------
        LimitError, KinematicsError, OutsideFieldError
            The command is refused and nothing has changed.
        """
        geometry, tool, machine, limits = self.geometry, self._tool_inverse, self.machine, self.limits
        frame = geometry.work if frame is None else frame
        ramp = 0.0 if math.isnan(self._last_time) else min(time - self._last_time, LONGEST_RAMP_STEP)
        status, finding, strut, stage = compensate_one(
            position,
            rotation,
            frame.position,
            frame.rotation,
            tool.position,
            tool.rotation,
            geometry.kernel_joints[0],
            geometry.kernel_joints[1],
            machine.structure.base_joints,
            machine.structure.platform_joints,
            machine.axes[0],
            machine.axes[1],
            *machine.strut_arrays,
            *machine.field_arrays,
            machine.thresholds,
            1.0 if self.enabled else 0.0,
            self._changed,
            max(ramp, 0.0) * self.ramp_rate,
            self.motion.low,
            self.motion.sense,
            self._next_motion.low,
            self._next_motion.sense,
            self.correction,
            self._bump,
            self._next_bump,
            self._previous,
            limits.stroke,
            limits.cone_axes,
            limits.cone_cosines,
            limits.scalars,
            self._platform[0],
            self._platform[1],
            self._model[0],
            self._model[1],
            self._next,
            self._findings,
        )
        if status == UNSOLVED:
            raise NotConvergedError("the error field is too steep to be undone at this pose")
        if status == OUTSIDE and machine.model.field.outside == "refuse":
            raise self._outside_error()
        if finding != WITHIN:
            raise limits.error(finding, strut, stage, self._findings[0])
        self._accept(time, status == OUTSIDE)
        return self.command

    def _accept(self, time: float, outside: bool) -> None:
        """Make the command under way the last one."""
        self.motion, self._next_motion = self._next_motion, self.motion
        self._bump, self._next_bump = self._next_bump, self._bump
        self.nominal[:], self.correction[:], self.command[:] = self._next
        self._previous[0], self._previous[1] = self.nominal, self.command
        self.condition = float(self._findings[1])
        self.outside_field = outside
        self._changed = False
        self._last_time = time

    def _outside_error(self) -> HexapodError:
        box = self.model.field.box * 1e3
        point = (self._platform[0] + self._platform[1] @ self.model.field.probe) * 1e3
        low, high = (", ".join(f"{v:g}" for v in corner) for corner in box)
        problem = f"the measured point ({point[0]:.3f}, {point[1]:.3f}, {point[2]:.3f}) mm is outside the field's box"
        return OutsideFieldError(f"{problem} ({low})…({high}) mm", point, box)

    def correct(self, tool_pose: Pose, time: float = 0.0) -> Correction:
        """Compensate one commanded tool pose and return the full record.

        Parameters
        ----------
        tool_pose : Pose
            ``pose_tool_in_work``.
        time : float, optional
            Monotonic clock, s, for ramps.

        Raises
        ------
        LimitError, KinematicsError, OutsideFieldError
            The command is refused and nothing has changed.
        """
        self.step(tool_pose.position, tool_pose.rotation, time)
        return self.record(tool_pose)

    def record(self, tool_pose: Pose) -> Correction:
        """Return the record of the command just accepted for `tool_pose`."""
        platform = Pose(*self._platform)
        box = self.model.valid_box
        outside_box = box is not None and bool(
            (platform.position < box[0]).any() or (platform.position > box[1]).any()
        )
        return Correction(
            tool_pose=tool_pose,
            platform_pose=platform,
            model_pose=Pose(*self._model),
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
        kernels.jacobian_one(*self.geometry.kernel_joints, *self._platform, matrix)
        kernels.solve_six(matrix, twist)
        lever = self._platform[1] @ self.geometry.tool.position
        twist[:3] += np.cross(twist[3:], lever)
        return twist

    def _model_correction(self) -> np.ndarray:
        """Return what the model would correct at the last command, ramp and switch left aside."""
        motion = MotionState()
        motion.copy_from(self.motion)
        commands, _, _ = self.machine.commands_for(Pose(*self._platform), motion)
        return commands - self.nominal

    def platform_pose(self, tool_pose: Pose) -> Pose:
        """Return ``pose_platform_in_base`` for a ``pose_tool_in_work``."""
        return self.geometry.work @ tool_pose @ self._tool_inverse

    def tool_pose(self, platform_pose: Pose) -> Pose:
        """Return ``pose_tool_in_work`` for a ``pose_platform_in_base``."""
        return self.geometry.work.inverse() @ platform_pose @ self.geometry.tool


@compiled
def compose(p1, r1, p2, r2, position, rotation):
    """Write the pose product (p1, r1) ∘ (p2, r2)."""
    for i in range(3):
        position[i] = p1[i] + r1[i, 0] * p2[0] + r1[i, 1] * p2[1] + r1[i, 2] * p2[2]
        for j in range(3):
            rotation[i, j] = r1[i, 0] * r2[0, j] + r1[i, 1] * r2[1, j] + r1[i, 2] * r2[2, j]


@compiled
def compensate_one(
    position,
    rotation,
    frame_position,
    frame_rotation,
    tool_inverse_position,
    tool_inverse_rotation,
    nominal_base,
    nominal_platform,
    base,
    platform,
    base_axes,
    platform_axes,
    table,
    knots,
    pieces,
    probe,
    gx,
    gy,
    gz,
    lx,
    ly,
    lz,
    thresholds,
    share,
    changed,
    ramp,
    low,
    sense,
    next_low,
    next_sense,
    last_correction,
    bump,
    next_bump,
    previous,
    stroke,
    cone_axes,
    cone_cosines,
    scalars,
    platform_position,
    platform_rotation,
    model_position,
    model_rotation,
    result,
    findings,
):
    """Run the whole chain for one command; return (status, finding, strut, stage).

    Inputs stay as they are; `next_*`, the two poses, `result` (nominal, correction, command) and
    `findings` (offending value, condition number) are written, and count only when nothing was found.
    """
    half_position, half_rotation = np.empty(3), np.empty((3, 3))
    compose(frame_position, frame_rotation, position, rotation, half_position, half_rotation)
    compose(
        half_position,
        half_rotation,
        tool_inverse_position,
        tool_inverse_rotation,
        platform_position,
        platform_rotation,
    )
    nominal, correction, command = result[0], result[1], result[2]
    kernels.strut_lengths_one(nominal_base, nominal_platform, platform_position, platform_rotation, nominal)
    finding, strut, value, condition = check_stage(
        nominal_base,
        nominal_platform,
        platform_position,
        platform_rotation,
        nominal,
        stroke,
        cone_axes,
        cone_cosines,
        scalars,
    )
    findings[0], findings[1] = value, condition
    if finding != WITHIN:
        return SOLVED, finding, strut, 0
    next_low[:] = low
    next_sense[:] = sense
    solved, outside = command_one(
        platform_position,
        platform_rotation,
        thresholds,
        next_low,
        next_sense,
        base,
        platform,
        base_axes,
        platform_axes,
        table,
        knots,
        pieces,
        probe,
        gx,
        gy,
        gz,
        lx,
        ly,
        lz,
        model_position,
        model_rotation,
        command,
    )
    if not solved:
        return UNSOLVED, WITHIN, -1, 1
    status = OUTSIDE if outside else SOLVED
    for i in range(6):
        correction[i] = share * (command[i] - nominal[i])
    ramp_bump(correction, last_correction, previous, bump, next_bump, changed, ramp)
    for i in range(6):
        correction[i] += next_bump[i]
        command[i] = nominal[i] + correction[i]
    finding, strut, value, stage = check_command(
        nominal, correction, command, previous, scalars
    )
    if finding == WITHIN:
        stage = 1
        finding, strut, value, _ = check_stage(
            base,
            platform,
            model_position,
            model_rotation,
            command,
            stroke,
            cone_axes,
            cone_cosines,
            scalars,
        )
    findings[0] = value
    return status, finding, strut, stage


@compiled
def check_command(nominal, correction, command, previous, scalars):
    """Check correction and steps; return (finding, strut, value, stage)."""
    for i in range(6):
        if not abs(correction[i]) <= scalars[1]:
            return CORRECTION, i, correction[i], 1
    finding, strut, value = check_change(nominal, previous[0], scalars[2], STEP)
    if finding != WITHIN:
        return finding, strut, value, 0
    finding, strut, value = check_change(command, previous[1], scalars[2], STEP)
    return finding, strut, value, 1


@compiled
def ramp_bump(correction, last_correction, previous, bump, next_bump, changed, ramp):
    """Write the part of the last correction that has not been given up yet.

    When model, temperatures or enabling have changed since the last command, the bump takes up the whole
    difference, so that the command does not move; it then shrinks in proportion, its largest element by at
    most `ramp` metres a command.
    """
    largest = 0.0
    for i in range(6):
        next_bump[i] = bump[i]
        if changed and not math.isnan(previous[0, i]):
            next_bump[i] = last_correction[i] - correction[i]
        largest = max(largest, abs(next_bump[i]))
    keep = 0.0 if largest <= ramp else 1.0 - ramp / largest
    for i in range(6):
        next_bump[i] *= keep
