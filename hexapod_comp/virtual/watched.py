"""A virtual machine for :func:`~hexapod_comp.measurements.collect.collect`, without ROS.

A tracker reads the tool at each stop; noise, outliers and broken beams are drawn at random.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from ..compensation.compensator import Compensator
from ..errors import LimitError
from ..machine.geometry import HexapodGeometry
from ..machine.model import MachineModel, RealMachine
from ..machine.temperatures import Temperatures
from ..machine.trajectory import commanded_in_base
from ..measurements.collect import Observation
from ..pose import Pose, attitude_error, rotation_from_vector
from .machine import DriveParameters, StrutDrive

# Share of a move's path at each of its commands; with these, each strut arrives in the direction of a continuous move
FRACTIONS = (0.5, 0.75, 0.875, 0.94, 0.97, 0.99, 1.0)
LONGEST_STEP = 1.0  # of the compensator, m; it is large, because the commands of a move are far apart
REST = 0.05  # time in which the drives come to rest, s: ten times their lag
SAMPLES = 25  # tracker samples whose mean is an observation


@dataclass(frozen=True)
class Instrument:
    """Noise and faults of a virtual tracker."""

    position: float = 1e-6  # 1 σ of each coordinate of a sample, m
    rotation: float = 1e-6  # 1 σ of a sample's rotation about each axis, rad
    wild: float = 0.0  # probability of an outlier (1 σ: 200 µm and 200 µrad)
    broken: float = 0.0  # probability of a broken beam


class VirtualMachine:
    """A machine with hidden errors, compensated with a model and measured by a tracker."""

    def __init__(
        self,
        geometry: HexapodGeometry,
        truth: MachineModel,
        instrument: Instrument | None = None,
        seed: int = 0,
        parameters: DriveParameters | None = None,
    ) -> None:
        self.geometry, self.truth, self.instrument = geometry, truth, instrument or Instrument()
        self.stops = 0
        self._rng, self._in_base = np.random.default_rng([seed, 30]), commanded_in_base(geometry)
        # Commands without time stamps have no acceleration.
        far = replace(self._in_base.limits, step=LONGEST_STEP, acceleration=0.0)
        self._in_base = replace(self._in_base, limits=far)
        self._core = Compensator(self._in_base, MachineModel(geometry.name))
        self._at = geometry.home @ geometry.tool
        self._drive = StrutDrive(RealMachine(self._in_base, truth), parameters, seed)

    def move(self, pose: Pose) -> None:
        """Move straight to ``pose_tool_in_work`` and stop; a broken limit raises a LimitError with reason ``limit``."""
        target, start = self.geometry.work @ pose, self._at
        travel = target.position - start.position
        turn = attitude_error(target.rotation, start.rotation)
        for share in FRACTIONS:
            place = start.position + share * travel
            before = Pose(place, rotation_from_vector(share * turn) @ start.rotation)
            try:
                self._send(target if share == 1.0 else before)
            except LimitError as error:
                error.reason = "limit"  # the reason that `ros/mover.py` reports
                raise
            self._at = target if share == 1.0 else before
        self.stops += 1

    @property
    def tool(self) -> Pose:
        """True pose of the tool in ``base``."""
        return self._drive.true_tool_pose()

    def _send(self, tool_in_base: Pose) -> None:
        command = self._core.step_to(tool_in_base)
        longest = float(np.abs(command - self._drive.motor_lengths()).max())
        self._drive.set_command(command)
        self._drive.advance(longest / self._drive.parameters.max_speed + REST)  # type: ignore[operator]

    def observe(self) -> Observation | None:
        """Return the tracker's observation of the tool; None if its beam is broken."""
        draws, instrument = self._rng.uniform(size=2), self.instrument
        noise = self._rng.standard_normal((2, 3)) / np.sqrt(SAMPLES)
        jump = self._rng.standard_normal((2, 3)) * 200e-6
        if draws[0] < instrument.broken:
            return None
        true, sigma = self.tool, np.array([instrument.position, instrument.rotation])
        off = noise * sigma[:, None] + (draws[1] < instrument.wild) * jump
        seen = Pose(true.position + off[0], rotation_from_vector(off[1]) @ true.rotation)
        temperatures = tuple(self._drive.machine.temperatures.at(name) for name in Temperatures.NAMES)
        struts = tuple(self._drive.motor_lengths().tolist())
        return Observation(seen, np.repeat(sigma, 3) / np.sqrt(SAMPLES), struts, temperatures, float(self.stops))

    def reload(self, model: MachineModel) -> None:
        """Replace the compensation's model at once, without a ramp, because a move has only a few commands."""
        self._core = Compensator(self._in_base, model)

    def knock(self, strut: int, distance: float) -> None:
        """Lengthen a strut of the real machine by `distance`, m, but not that of the compensation's model."""
        offset = self.truth.struts.offset.copy()
        offset[strut] += distance
        self.become(replace(self.truth, struts=replace(self.truth.struts, offset=offset)))

    def become(self, truth: MachineModel) -> None:
        """Replace the hidden errors by `truth`; the drives keep their commands."""
        parameters = replace(self._drive.parameters, initial_lengths=self._drive.commands)
        self.truth = truth
        self._drive = StrutDrive(RealMachine(self._in_base, truth, self._drive.machine.temperatures), parameters)
