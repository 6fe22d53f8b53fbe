"""The virtual machine: six stepper drives with hidden errors and faults, their encoders, and a tracker.

A drive moves a reference x towards its command c by x″ + 4/lag·x′ + 4/lag²·x = 4/lag²·c, a critically damped response
with a following error of lag·x′, within the limits of speed and acceleration. The motor is at x rounded to steps;
the encoder reads the motor. The nut follows the motor at a distance of half the backlash, and does not move while the
motor is nearer; (motor − nut) / (half the backlash) is the strut's sense of motion. Motor positions and senses of
motion determine the true pose of the hidden `RealMachine`.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass, replace

import numpy as np

from ..core import Status, Struct
from ..core.batch import follow_point, run_drives
from ..errors import CommandError, ModelError
from ..machine.geometry import STRUT_NAMES, HexapodGeometry
from ..machine.kinematics import forward_error
from ..machine.model import MotionState, RealMachine
from ..pose import Pose

LONGEST_ADVANCE = 60.0  # s; a longer time is probably in another unit
LONGEST_TICK = 0.25e-3  # longest integration step, s; the step is lag / 40 if this is shorter
LEAST_LAG = 1e-3  # shortest nonzero lag, s: its integration step is 25 µs
LONGEST_DELAY = 10.0  # feedback delay, s


@dataclass(frozen=True)
class DriveParameters:
    step: float = 0.1e-6  # m; 0: no steps
    max_speed: float | None = None  # of the motor, m/s; None: the geometry's limit; ``inf``: no limit
    max_acceleration: float = 10.0  # of the motor, m/s²; ``inf``: no limit
    # Following error / speed at constant speed, s. Above a speed of max_acceleration·lag/2 the following error
    # is the stopping distance. Commands with a period T add T/2 to the mean lag. On a circle of radius r the tool runs
    # (lag·speed)²/4r inside the circle. A drive with lag 0 reaches each command at once; max_speed and
    # max_acceleration must then be ``inf``.
    lag: float = 0.005
    # (6, 2): shortest and longest length of each strut, at its mechanical stops, m; None: the geometry's stroke
    stops: np.ndarray | None = None
    encoder_resolution: float = 0.1e-6  # length of one encoder count, m; 0: no counts
    encoder_noise: float = 0.05e-6  # 1 σ of a reading before it is rounded to counts, m
    tracker_noise: float = 0.0  # 1 σ of each coordinate of the tool position, m
    # (6,): motor positions at the start, m; None: the commands that bring the real machine to its home pose
    initial_lengths: np.ndarray | None = None

    def __post_init__(self) -> None:
        for name in ("step", "lag", "encoder_resolution", "encoder_noise", "tracker_noise"):
            value = getattr(self, name)
            if not 0.0 <= value < math.inf:
                raise ModelError(f"drive.{name}", "must be finite and not negative", value)
        for name in ("max_speed", "max_acceleration"):
            value = getattr(self, name)
            if value is not None and not value > 0.0:
                raise ModelError(f"drive.{name}", "must be above zero, or inf for no limit", value)
        if 0.0 < self.lag < LEAST_LAG or self.lag > 1.0:
            raise ModelError("drive.lag", f"must be 0, or lie within {LEAST_LAG:g}…1 s", self.lag)
        if self.lag == 0.0 and not (self.max_speed == math.inf and self.max_acceleration == math.inf):
            problem = "0 means a drive without dynamics: max_speed and max_acceleration must then be inf"
            raise ModelError("drive.lag", problem, [self.max_speed, self.max_acceleration])

    @staticmethod
    def ideal() -> DriveParameters:
        """Return drives that reach each command at once and exactly, and noiseless instruments."""
        return DriveParameters(0.0, math.inf, math.inf, lag=0.0, encoder_resolution=0.0, encoder_noise=0.0)

    def completed(self, machine: RealMachine) -> DriveParameters:
        """Return a checked copy, with `machine`'s max_speed, stops and initial_lengths where these are None."""
        limits, home = machine.geometry.limits, machine.geometry.home
        initial = self.initial_lengths
        if initial is None:
            initial, _, _ = machine.commands_for(home, MotionState())
        stops = _array(limits.stroke if self.stops is None else self.stops, (6, 2), "drive.stops")
        initial = _array(initial, (6,), "drive.initial_lengths")
        for name, length, (low, high) in zip(STRUT_NAMES, initial, stops, strict=True):
            if not 0.0 < low < high:
                raise ModelError(f"drive.stops of {name}", "must be two increasing lengths, m", [low, high])
            if not low <= length <= high:
                problem = f"must lie between the stops {low:.6f}…{high:.6f} m"
                raise ModelError(f"drive.initial_lengths of {name}", problem, float(length))
        speed = limits.speed if self.max_speed is None else self.max_speed
        return replace(self, max_speed=speed, stops=stops, initial_lengths=initial)


@dataclass(frozen=True)
class Faults:
    """Faults of the virtual machine; struts are given by their index 0…5."""

    stuck: int | None = None  # strut whose motor does not move
    encoder_lost: int | None = None  # strut whose encoder reads NaN
    feedback_delay: float = 0.0  # time from an encoder reading to its arrival, s
    feedback_drop: float = 0.0  # share of the encoder readings that are lost, 0…1
    # Strut and distance, m: the strut's motor jumps by it once, when the fault is set; the encoder measures the jump,
    # and the drive moves the motor back.
    jump: tuple[int, float] | None = None
    # true length of each strut minus the length measured by its encoder, m, as after a crash
    longer: tuple[float, ...] = (0.0,) * 6

    def __post_init__(self) -> None:
        struck = None if self.jump is None else self.jump[0]
        for name, index in (("stuck", self.stuck), ("encoder_lost", self.encoder_lost), ("jump", struck)):
            if index is not None and not (isinstance(index, int | np.integer) and 0 <= index < 6):
                raise ModelError(f"faults.{name}", "must be a strut's index, 0…5, or None", index)
        if not 0.0 <= self.feedback_delay <= LONGEST_DELAY:
            problem = f"must lie within 0…{LONGEST_DELAY:g} s"
            raise ModelError("faults.feedback_delay", problem, self.feedback_delay)
        if not 0.0 <= self.feedback_drop <= 1.0:
            raise ModelError("faults.feedback_drop", "must lie within 0…1", self.feedback_drop)
        if self.jump is not None and not math.isfinite(self.jump[1]):
            raise ModelError("faults.jump", "must be a finite distance, m", self.jump[1])
        _array(self.longer, (6,), "faults.longer")


def _array(values: object, shape: tuple[int, ...], name: str) -> np.ndarray:
    array = np.array(values, dtype=float)
    if array.shape != shape or not np.isfinite(array).all():
        raise ModelError(name, f"must be finite numbers of shape {shape}, m", array.tolist())
    return array


def to_step(values: np.ndarray, step: float) -> np.ndarray:
    """Round values to multiples of `step`; copy them if `step` is zero."""
    return np.rint(values / step) * step if step > 0.0 else values.copy()


class StrutDrive:
    """A virtual machine that takes strut commands and returns encoder readings and the true pose.

    Time advances only in :meth:`advance`. Equal seeds and equal calls give equal readings.
    """

    def __init__(self, machine: RealMachine, parameters: DriveParameters | None = None, seed: int = 0) -> None:
        self.machine = machine
        self.parameters = (parameters or DriveParameters()).completed(machine)
        self._rng = np.random.default_rng(seed)
        self._tick = min(LONGEST_TICK, self.parameters.lag / 40.0) or LONGEST_TICK
        self._left_over, self._time = 0.0, 0.0
        self._set_up_struts()
        self._set_up_pose(machine.geometry)
        self._undelivered: deque[tuple[float, np.ndarray, np.ndarray]] = deque()
        self._last_reading = np.full(6, np.nan)
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
        self._stuck, self._stopped = drives["stuck"], drives["stopped"]

    def _set_up_pose(self, geometry: HexapodGeometry) -> None:
        self._motion = MotionState()
        self._model_pose = geometry.home.position.copy(), geometry.home.rotation.copy()
        self._true_pose = geometry.home.position.copy(), geometry.home.rotation.copy()
        self._commanded_pose = geometry.home.position.copy(), geometry.home.rotation.copy()
        self._outcome, self._condition = Status.OK, math.nan
        machine = self.machine  # this copy without weight and forces computes the commanded pose
        self._rigid = RealMachine(machine.geometry, machine.model, machine.temperatures, machine.loading)
        work = geometry.work.inverse()
        self._work = work.position, work.rotation
        self._tool = geometry.tool.position, geometry.tool.rotation

    @property
    def faults(self) -> Faults:
        """Present faults; assigning faults that contain a jump displaces the motor at once."""
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
        """Simulated time since the start, s."""
        return self._time

    @property
    def commands(self) -> np.ndarray:
        return self._commands.copy()

    @property
    def stopped(self) -> np.ndarray:
        """Whether each motor was at a mechanical stop at any time of the last :meth:`advance`; bool, shape (6,)."""
        return self._stopped != 0

    def set_command(self, lengths: np.ndarray) -> None:
        """Set six strut commands, m; commands beyond a mechanical stop are accepted, see :attr:`stopped`."""
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
        """Advance the simulated time by `dt`, s, then read the encoders once."""
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
        """Run the drives for `ticks` integration steps, which take `seconds`, then compute the platform's pose."""
        run_drives(self._drives, self._commands, ticks, self._motion.sense)
        moved = self._motor + self._faults.longer, self._motion.sense, self._model_pose, self._true_pose
        self._outcome, self._condition = self.machine.advance(seconds, *moved)

    def _follow_commanded_point(self) -> None:
        """Update the error field's directions of motion along x, y and z from the commanded pose.

        The actual pose is not used, because following errors and backlash move the actual tool along all axes.
        """
        model, motion, nowhere = self.machine.model, self._motion, (np.empty(3), np.empty((3, 3)))
        outcome, _ = self._rigid.forward(self._commands, motion.sense, self._commanded_pose, nowhere)
        if outcome == Status.OK:
            threshold, probe = model.field.reversal_threshold, model.field.probe
            follow_point(*self._commanded_pose, probe, threshold, motion.low, motion.sense)

    def _read_encoders(self, dt: float) -> None:
        """Read the encoders now; deliver all readings whose delay has passed."""
        p, faults = self.parameters, self._faults
        reading = self._motor
        if p.encoder_noise:
            reading = self._rng.normal(reading, p.encoder_noise)
        reading = to_step(reading, p.encoder_resolution)
        speeds = (reading - self._last_reading) / dt if dt > 0.0 else np.zeros(6)
        self._last_reading = reading
        if faults.feedback_drop == 0.0 or self._rng.uniform() >= faults.feedback_drop:
            self._undelivered.append((self._time, reading, speeds))
        self.feedback_arrived = False
        due = self._time - faults.feedback_delay + 1e-9
        while self._undelivered and self._undelivered[0][0] <= due:
            _, self._lengths, self._speeds = self._undelivered.popleft()
            self.feedback_arrived = True

    def _blanked(self, values: np.ndarray) -> np.ndarray:
        values = values.copy()
        if self._faults.encoder_lost is not None:
            values[self._faults.encoder_lost] = np.nan
        return values

    def encoder_lengths(self) -> np.ndarray:
        """Return the newest encoder readings that have arrived, m, shape (6,); NaN for a lost encoder.

        :attr:`feedback_arrived` is True if readings arrived in the last :meth:`advance`.
        """
        return self._blanked(self._lengths)

    def encoder_speeds(self) -> np.ndarray:
        """Return the struts' speeds from the last two encoder readings, m/s, shape (6,)."""
        return self._blanked(self._speeds)

    def motor_lengths(self) -> np.ndarray:
        """True positions of the motors, m, shape (6,)."""
        return self._motor.copy()

    def true_pose(self) -> Pose:
        self._refuse_impossible()
        return Pose(*self._true_pose)

    def true_tool_pose(self) -> Pose:
        return self._tool_pose(np.zeros(3))

    def tracker_pose(self) -> Pose:
        """Return ``pose_tool_in_work`` as a laser tracker reads it, with noise on the position."""
        return self._tool_pose(self.parameters.tracker_noise * self._rng.standard_normal(3))

    def _tool_pose(self, noise: np.ndarray) -> Pose:
        self._refuse_impossible()
        (position, rotation), (offset, turn) = self._true_pose, self._tool
        origin, axes = self._work
        return Pose(origin + axes @ (position + rotation @ offset) + noise, axes @ rotation @ turn)

    def _refuse_impossible(self) -> None:
        if self._outcome != Status.OK:
            raise forward_error(self._outcome, self._condition, self.machine.structure.max_condition)
