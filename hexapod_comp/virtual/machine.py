"""The virtual machine: six stepper-driven struts with hidden errors, their encoders, and a tracker.

Commands go through the drives (:mod:`hexapod_comp.virtual.drives`) into motor positions and nut plays;
:class:`hexapod_comp.machine.model.RealMachine`, the hidden truth, computes from those the platform's true pose. Faults
can be set while it runs.
"""

from __future__ import annotations

import math
from collections import deque

import numpy as np

from ..core import Status, Struct
from ..core.batch import follow_point, run_drives
from ..errors import CommandError, ModelError
from ..machine.geometry import STRUT_NAMES, HexapodGeometry
from ..machine.kinematics import forward_error
from ..machine.model import MotionState, RealMachine
from ..pose import Pose
from .drives import DriveParameters, Faults, to_step

__all__ = ["DriveParameters", "Faults", "StrutDrive"]

LONGEST_ADVANCE = 60.0  # Longest time advanced in one call, s; more is a unit error
LONGEST_TICK = 0.25e-3  # Integration step of the drives, s; shorter for a shorter lag


class StrutDrive:
    """A machine that moves: commands in, encoder readings and the true pose out.

    Time passes only in :meth:`advance`. The same seed and the same calls give the same readings.
    """

    def __init__(self, machine: RealMachine, parameters: DriveParameters | None = None, seed: int = 0) -> None:
        self.machine = machine
        self.parameters = (parameters or DriveParameters()).completed(machine)
        self._rng = np.random.default_rng(seed)
        self._tick = min(LONGEST_TICK, self.parameters.lag / 40.0) or LONGEST_TICK
        self._left_over, self._time = 0.0, 0.0
        self._set_up_struts()
        self._set_up_pose(machine.geometry)
        self._under_way: deque[tuple[float, np.ndarray, np.ndarray]] = deque()
        self._last_reading = np.full(6, np.nan)
        self.feedback_arrived = True
        self.faults = Faults()
        self._follow_commanded_point()
        self._run(0, 0.0)
        self._read_encoders(0.0)

    def _set_up_struts(self) -> None:
        p = self.parameters
        self._commands = np.array(p.initial_lengths)
        at_rest = {
            "tick": self._tick,
            "lag": p.lag,
            "max_speed": p.max_speed,
            "max_acceleration": p.max_acceleration,
            "step": p.step,
            "stops": p.stops,
            "half_play": 0.5 * self.machine.model.struts.largest_backlash,
            "position": self._commands,
            "motor": to_step(self._commands, p.step),
        }
        self._drives = Struct("hc_drives", at_rest)
        drives = self._drives.view
        self._position, self._speed, self._motor = drives["position"], drives["speed"], drives["motor"]
        self._play, self._stuck, self._stopped = drives["play"], drives["stuck"], drives["stopped"]

    def _set_up_pose(self, geometry: HexapodGeometry) -> None:
        self._motion = MotionState()
        self._model_pose = geometry.home.position.copy(), geometry.home.rotation.copy()
        self._true_pose = geometry.home.position.copy(), geometry.home.rotation.copy()
        self._commanded_pose = geometry.home.position.copy(), geometry.home.rotation.copy()
        self._outcome, self._condition = Status.OK, math.nan
        machine = self.machine  # directions of motion follow what is commanded, and that neither bends nor oscillates
        self._rigid = RealMachine(machine.geometry, machine.model, machine.temperatures, machine.loading)
        work = geometry.work.inverse()
        self._work = work.position, work.rotation
        self._tool = geometry.tool.position, geometry.tool.rotation

    @property
    def faults(self) -> Faults:
        """The present faults; a jump happens when it is set."""
        return self._faults

    @faults.setter
    def faults(self, faults: Faults) -> None:
        self._faults = faults
        self._stuck[:] = False
        if faults.stuck is not None:
            self._stuck[faults.stuck] = True
            self._speed[faults.stuck] = 0.0
        if faults.jump is not None:
            index, distance = faults.jump
            self._position[index] += distance

    @property
    def time(self) -> float:
        """Time advanced since the start, s."""
        return self._time

    @property
    def commands(self) -> np.ndarray:
        """The commands in force, m, shape (6,)."""
        return self._commands.copy()

    @property
    def stopped(self) -> np.ndarray:
        """Motors that the last advance found at a stop, commanded or displaced beyond it; bool, shape (6,)."""
        return self._stopped != 0

    def set_command(self, lengths: np.ndarray) -> None:
        """Set six strut commands; lengths beyond a stop are accepted, and reported by :attr:`stopped`."""
        lengths = np.asarray(lengths, dtype=float)
        if lengths.shape != (6,):
            raise CommandError("strut_count", f"six strut lengths are needed, not shape {lengths.shape}")
        if not np.isfinite(lengths).all():
            index = int(np.argmin(np.isfinite(lengths)))
            problem = f"{STRUT_NAMES[index]}: length must be finite, not {lengths[index]} m"
            raise CommandError("not_finite", problem)
        self._commands[:] = lengths
        self._follow_commanded_point()

    def advance(self, dt: float) -> None:
        """Advance time by dt, s, and read the encoders once at its end."""
        if not 0.0 <= dt <= LONGEST_ADVANCE:
            raise ModelError("dt", f"must lie within 0…{LONGEST_ADVANCE:g} s", dt)
        self._left_over += dt
        ticks = int(self._left_over / self._tick + 1e-6)
        self._left_over -= ticks * self._tick
        if self.parameters.lag == 0.0:
            ticks = 1
        if ticks > 0:
            self._stopped[:] = False
            self._run(ticks, dt if self.parameters.lag == 0.0 else ticks * self._tick)
        self._time += dt
        self._read_encoders(dt)

    def _run(self, ticks: int, seconds: float) -> None:
        """Run the drives for some ticks, then compute the platform's pose."""
        run_drives(self._drives, self._commands, ticks, self._motion.sense)
        went = self._motor, self._motion.sense, self._model_pose, self._true_pose
        self._outcome, self._condition = self.machine.advance(seconds, *went)

    def _follow_commanded_point(self) -> None:
        """Set the field's directions from the commanded motion.

        A reversal value belongs to the side from which a target is approached. Following errors and backlash being
        taken up also move the tool along axes at rest; they have no direction.
        """
        model, motion, nowhere = self.machine.model, self._motion, (np.empty(3), np.empty((3, 3)))
        outcome, _ = self._rigid.forward(self._commands, motion.sense, self._commanded_pose, nowhere)
        if outcome == Status.OK:
            threshold, probe = model.field.reversal_threshold, model.field.probe
            follow_point(*self._commanded_pose, probe, threshold, motion.low, motion.sense)

    def _read_encoders(self, dt: float) -> None:
        """Read the encoders; deliver the readings whose delay has passed."""
        p, faults = self.parameters, self._faults
        reading = self._motor
        if p.encoder_noise:
            reading = reading + p.encoder_noise * self._rng.standard_normal(6)
        reading = to_step(reading, p.encoder_resolution)
        speeds = (reading - self._last_reading) / dt if dt > 0.0 else np.zeros(6)
        self._last_reading = reading
        if faults.feedback_drop == 0.0 or self._rng.uniform() >= faults.feedback_drop:
            self._under_way.append((self._time, reading, speeds))
        self.feedback_arrived = False
        due = self._time - faults.feedback_delay + 1e-9
        while self._under_way and self._under_way[0][0] <= due:
            _, self._lengths, self._speeds = self._under_way.popleft()
            self.feedback_arrived = True

    def _blanked(self, values: np.ndarray) -> np.ndarray:
        values = values.copy()
        if self._faults.encoder_lost is not None:
            values[self._faults.encoder_lost] = np.nan
        return values

    def encoder_lengths(self) -> np.ndarray:
        """Return the newest encoder readings that have arrived, m, shape (6,); NaN where one is lost.

        :attr:`feedback_arrived` says whether the last :meth:`advance` brought a new one.
        """
        return self._blanked(self._lengths)

    def encoder_speeds(self) -> np.ndarray:
        """Return the difference quotient of the last two readings, m/s, shape (6,)."""
        return self._blanked(self._speeds)

    def motor_lengths(self) -> np.ndarray:
        """Return the true positions of the motors, as a perfect encoder would read them, m, shape (6,)."""
        return self._motor.copy()

    def play(self) -> np.ndarray:
        """Return motor minus nut position, m, shape (6,), within ± half the backlash."""
        return self._play.copy()

    def true_pose(self) -> Pose:
        """Return the true ``pose_platform_in_base``."""
        self._refuse_impossible()
        return Pose(*self._true_pose)

    def true_tool_pose(self) -> Pose:
        """Return the true ``pose_tool_in_work``."""
        return self._tool_pose(np.zeros(3))

    def tracker_pose(self) -> Pose:
        """Return ``pose_tool_in_work`` as a laser tracker reads it: the truth, its position with noise."""
        return self._tool_pose(self.parameters.tracker_noise * self._rng.standard_normal(3))

    def _tool_pose(self, noise: np.ndarray) -> Pose:
        self._refuse_impossible()
        (position, rotation), (offset, turn) = self._true_pose, self._tool
        origin, axes = self._work
        return Pose(origin + axes @ (position + rotation @ offset) + noise, axes @ rotation @ turn)

    def _refuse_impossible(self) -> None:
        if self._outcome != Status.OK:
            raise forward_error(self._outcome, self._condition, self.machine.structure.max_condition)
