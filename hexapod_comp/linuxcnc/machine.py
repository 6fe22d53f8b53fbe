"""A HAL component that simulates a machine with hidden errors behind LinuxCNC's simulated drives, without ROS. Load the
component from a HAL file with ``loadusr -Wn hexapod_machine linuxcnc_machine --truth mine.yaml``."""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Sequence
from typing import Any

import numpy as np

from ..core.batch import follow_nine
from ..errors import HexapodError, KinematicsError
from ..formats.texts import plain_number
from ..machine.geometry import load_geometry
from ..machine.model import MotionState, RealMachine
from ..pose import Pose, roll_pitch_yaw
from ..ros import received_signals
from ..virtual.named import find_model
from .hal import METRES, HalComponent, pins, quaternion_from_axes

AXES = ("x", "y", "z", "a", "b", "c")
STRUTS = tuple(f"strut.{n}" for n in range(6))
TRUE = tuple(f"true-{axis}" for axis in AXES)
ERRORS = ("error", "error-x", "error-y", "error-z")

PINS = (
    pins("in", "float", *STRUTS, *AXES, "tool-offset")
    | pins("out", "float", *TRUE, *ERRORS)
    | pins("out", "bit", "valid")
)

LONGEST_SLEEP = 0.1  # Longest time between two checks for signals, s


class MachineComponent:
    """A HAL component that reads strut lengths and commanded axes, and writes the tool's true pose and error.

    Without a tool length, XYZ and R = Rz(C)·Ry(B)·Rx(A) (genhexkins) are the pose of the geometry's tool frame in its
    work frame. With a tool length T the tip is at T on the tool frame's −z axis, and Z is the tip's height plus T.
    """

    def __init__(self, machine: RealMachine, units: str = "mm", name: str = "hexapod_machine", hal: Any = None):
        self._machine, self._metres = machine, METRES[units]
        self._motion, self._guess = MotionState(), machine.geometry.home
        self._base_in_work, self._platform_in_tool = machine.geometry.work.inverse(), machine.geometry.tool.inverse()
        self.component = HalComponent(name, PINS, hal)
        self._read = self.component.reader(*STRUTS, "tool-offset", *AXES)
        self._write, self._write_valid = self.component.writer(*TRUE, *ERRORS), self.component.writer("valid")

    def cycle(self) -> None:
        """Read the pins; write true pose and error, or, if no pose has these strut lengths, only clear ``valid``."""
        read = np.array(self._read())
        struts, up = read[:6] * self._metres, np.array([0.0, 0.0, read[6] * self._metres])
        command = Pose.from_quaternion(read[7:10] * self._metres, np.array(quaternion_from_axes(*read[10:])))
        geometry, field = self._machine.geometry, self._machine.model.field
        commanded = Pose(command.position - up + command.rotation @ up, command.rotation)
        wanted = geometry.work @ commanded @ self._platform_in_tool
        # directions of motion, on which backlash and error field depend
        point = np.concatenate([wanted.position + wanted.rotation @ field.probe, struts])
        thresholds = field.reversal_threshold, self._machine.model.reversal_threshold
        follow_nine(point, *thresholds, self._motion.low, self._motion.sense)
        try:
            platform, self._guess = self._machine.pose_for(struts, self._motion.sense, self._guess)
        except KinematicsError:
            self._write_valid([False])
            return
        tool = self._base_in_work @ platform @ geometry.tool
        position = tool.position - tool.rotation @ up + up
        error = position - command.position
        lengths = np.concatenate([position, [np.linalg.norm(error)], error]) / self._metres
        degrees = np.degrees(roll_pitch_yaw(tool.rotation))
        self._write([*lengths[:3], *degrees, *lengths[3:]])
        self._write_valid([True])


def main(argv: Sequence[str] | None = None) -> int:
    """Run the executable ``linuxcnc_machine`` until a signal ends it; return an exit code."""
    options = _parser().parse_args(argv)
    try:
        geometry = load_geometry(options.geometry)
        machine = RealMachine(geometry, find_model(options.truth, geometry))
        component = MachineComponent(machine, options.units, options.name)
    except HexapodError as error:
        print(f"cannot start: {error}", file=sys.stderr)
        return 1
    component.cycle()  # so that the pins have values before LinuxCNC continues
    signals = received_signals()
    component.component.ready()
    period, due = 1.0 / options.rate, time.monotonic()
    while not signals:
        if (now := time.monotonic()) < due:
            time.sleep(min(due - now, LONGEST_SLEEP))
            continue
        component.cycle()
        due = max(due + period, time.monotonic())
    component.component.exit()
    return 0


def _parser() -> argparse.ArgumentParser:
    text = "HAL component of a simulated machine: it writes the tool's true pose and error."
    parser = argparse.ArgumentParser(prog="linuxcnc_machine", description=text)
    parser.add_argument("--geometry", default="paper.yaml", metavar="FILE", help="geometry file (default: paper.yaml)")
    text = "hidden errors of the machine: a model file, ideal for none, random or random:SEED"
    parser.add_argument("--truth", default="paper_machine.yaml", metavar="FILE", help=text)
    parser.add_argument("--units", choices=tuple(METRES), default="mm", help="LinuxCNC's length unit (default: mm)")
    parser.add_argument("--rate", type=_rate, default=50.0, metavar="HZ", help="cycles per second (default: 50)")
    parser.add_argument("--name", default="hexapod_machine", help="the component's name (default: hexapod_machine)")
    return parser


def _rate(text: str) -> float:
    value = plain_number(text)
    if not 0.1 <= value <= 1000.0:
        raise argparse.ArgumentTypeError(f"must be a number from 0.1 to 1000 Hz, not {text}")
    return value


if __name__ == "__main__":
    sys.exit(main())
