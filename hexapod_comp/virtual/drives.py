"""One strut's drive: its limits, its faults, and its compiled inner loop.

A command c is processed in this order:

1. A position loop moves the reference x towards c. Its speed is wanted(c − x), its acceleration
   (wanted − ẋ)·4/lag, both limited. Within the limits this is x″ + 4/lag·x′ + 4/lag²·x = 4/lag²·c: two equal
   real poles, no overshoot, and a distance of lag·ẋ behind a steadily moving command. All six struts lag equally: the
   tool stays near its path, only later.
2. The stepper stands at the step nearest to x: the motor position, which the encoder counts.
3. The nut follows the motor with play: it stays until the motor has crossed half the backlash to either
   side. motor − nut, as a share of half the backlash, is the strut's sense of motion in the model.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from ..errors import ModelError
from ..machine.geometry import STRUT_NAMES
from ..machine.model import MotionState, RealMachine

LEAST_LAG = 1e-3  # Shortest nonzero lag of a drive, s: below, too many integration steps would be needed
LONGEST_DELAY = 10.0  # Longest feedback delay, s


@dataclass(frozen=True)
class DriveParameters:
    """Capabilities of the six drives and the instruments."""

    step: float = 0.1e-6  # length of one motor step, m; 0 for none
    max_speed: float | None = None  # largest motor speed, m/s; None: the geometry's limit; ``inf`` for none
    max_acceleration: float = 10.0  # largest motor acceleration, m/s²; ``inf`` for none
    # distance behind a steadily moving command, per speed, s. Holds up to a speed of max_acceleration·lag/2; faster,
    # the drive keeps the distance in which it can stop. A command that comes in steps of a period T lags T/2 more on
    # average. On a circle of radius r the tool runs (lag·speed)²/4r inside it. 0 is a drive without dynamics, which is
    # on its command at once; speed and acceleration must then be ``inf``.
    lag: float = 0.005
    # (6, 2), or None: lengths at which the motors are stopped, m; None: the geometry's stroke
    stops: np.ndarray | None = None
    encoder_resolution: float = 0.1e-6  # length of one encoder count, m; 0 for none
    encoder_noise: float = 0.05e-6  # standard deviation of an encoder reading, before it is counted, m
    tracker_noise: float = 0.0  # standard deviation of each coordinate of the tracker's tool position, m
    # (6,), or None: motor positions at the start, m; None: those that bring the real machine home
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
            problem = "0 is a drive without dynamics; max_speed and max_acceleration must then be inf"
            raise ModelError("drive.lag", problem, [self.max_speed, self.max_acceleration])

    @staticmethod
    def ideal() -> DriveParameters:
        """Return a drive that stands on its command at once, exactly, with perfect instruments."""
        return DriveParameters(0.0, math.inf, math.inf, 0.0, None, 0.0, 0.0, 0.0)

    def completed(self, machine: RealMachine) -> DriveParameters:
        """Return a copy in which the defaults that depend on the machine are filled in and checked."""
        limits, home = machine.geometry.limits, machine.geometry.home
        initial = self.initial_lengths
        if initial is None:
            initial, _, _ = machine.commands_for(home, MotionState())
        stops = _array(limits.stroke if self.stops is None else self.stops, (6, 2), "stops")
        initial = _array(initial, (6,), "initial_lengths")
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
    """Faults; struts are counted 0…5."""

    stuck: int | None = None  # strut whose motor does not move
    encoder_lost: int | None = None  # strut whose encoder reads NaN
    feedback_delay: float = 0.0  # age of the encoder readings when they arrive, s
    feedback_drop: float = 0.0  # share of the readings that never arrive, 0…1
    # strut and distance, m, by which its motor is displaced, once, when the fault is set. The encoder measures it and
    # the drive pulls the motor back.
    jump: tuple[int, float] | None = None

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


def _array(values: object, shape: tuple[int, ...], name: str) -> np.ndarray:
    array = np.array(values, dtype=float)
    if array.shape != shape or not np.isfinite(array).all():
        raise ModelError(f"drive.{name}", f"must be finite numbers of shape {shape}, m", array.tolist())
    return array


def to_step(values: np.ndarray, step: float) -> np.ndarray:
    """Return the multiples of `step` nearest to the values, a copy of the values when it is zero."""
    return np.rint(values / step) * step if step > 0.0 else values.copy()
