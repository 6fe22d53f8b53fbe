"""What each block of a machine model costs in the compensator's loop, µs.

The same commands, a small circle that turns and comes back, go through compensators that differ by one block, in turn.
A block's cost is what it adds to a command, and to an estimate of the pose, of the ideal machine: called from Python,
processor time of the thread, the least of the rounds, since others on the machine can only add.
"""

from __future__ import annotations

import argparse
import dataclasses
import sys
import time
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from hexapod_comp.compensation.compensator import Compensator
from hexapod_comp.formats.paths import config_file
from hexapod_comp.machine.geometry import HexapodGeometry, load_geometry
from hexapod_comp.machine.load import Load
from hexapod_comp.machine.model import MachineModel
from hexapod_comp.machine.model_file import load_model
from hexapod_comp.machine.outside import OutsideTable
from hexapod_comp.machine.struts import StrutErrors

from . import table

COMMANDS = 500
PERIOD = 1e-3  # Between two commands, s

LEAD = 5e-3  # Of the screws where their rotation is looked at, m


@dataclass(frozen=True)
class Block:
    """What a block adds to a command and to an estimate, µs; for ``ideal``, what these take without any."""

    name: str
    what: str
    command_us: float
    estimate_us: float


def commands(geometry: HexapodGeometry) -> list[tuple[float, ...]]:
    """Return tool poses as messages have them: a circle of 10 mm about home, tilted by ±3°, there and back."""
    angles = np.linspace(0.0, np.pi, COMMANDS // 2)
    turns = Rotation.from_euler("xyz", np.deg2rad(3.0) * np.column_stack([np.sin(angles), np.cos(angles), angles]))
    circle = np.column_stack([np.sin(angles), np.cos(angles), 0.2 * np.sin(2.0 * angles)])
    tool = geometry.tool_pose(geometry.home)
    rows = np.hstack([tool.position + 0.01 * circle, (turns * Rotation.from_matrix(tool.rotation)).as_quat()])
    return [tuple(row) for row in np.vstack([rows, rows[::-1]]).tolist()]


def cardan(geometry: HexapodGeometry) -> HexapodGeometry:
    """Return a machine whose screws turn with their cardan joints."""
    across = np.cross(geometry.platform_joints - geometry.base_joints, [0.0, 0.0, 1.0])
    axes = across / np.linalg.norm(across, axis=1, keepdims=True)
    return dataclasses.replace(geometry, base_axes=axes, platform_axes=axes, screw_lead=np.full(6, LEAD))


def compensators(geometry: HexapodGeometry) -> dict[tuple[str, str], Compensator]:
    """Return one compensator per block, by name and description; first the ideal machine's, last the whole model's."""
    whole, ideal = load_model(config_file("paper_machine.yaml"), geometry), MachineModel(geometry.name)
    errors, knots = whole.struts, np.linspace(0.42, 0.62, 21)
    waves = dataclasses.replace(StrutErrors(), cosine=errors.cosine, sine=errors.sine, period=errors.period)
    scale = dataclasses.replace(StrutErrors(), offset=errors.offset, pitch=errors.pitch, backlash=errors.backlash)
    values = 5e-6 * np.sin(np.outer(np.arange(1.0, 7.0), 40.0 * knots))
    curved = dataclasses.replace(StrutErrors(), map_knots=knots, map_values=values)
    grown = dataclasses.replace(StrutErrors(), expansion=np.full(6, 11.5e-6))
    joints = {"base_deviation": whole.base_deviation, "platform_deviation": whole.platform_deviation}

    def with_block(**changes: object) -> Compensator:
        return Compensator(geometry, dataclasses.replace(ideal, **changes))

    warm = with_block(struts=grown, base_expansion=11.5e-6, platform_expansion=11.5e-6)
    for name in ("strut_1", "strut_4", "base", "platform"):
        warm.set_temperature(name, 23.0)
    edges, sag = np.radians([0.0, 90.0]), 30e-6 * np.ones((4, 3))
    over = OutsideTable(("elevation", "rotation"), ("deg", "deg"), (edges, edges), sag, sag)
    bent, beside = with_block(outside=over), with_block(field=whole.field, outside=over)
    for one in (bent, beside):
        one.set_outside({"elevation": 0.7, "rotation": 0.1})
    turning, weight = cardan(geometry), Load(stiffness=np.full(6, 20e6), lost_motion=np.full(6, 1e-6), mass=30.0)
    rubbing = dataclasses.replace(weight, friction=np.full(6, 0.5))
    return {
        ("ideal", "the whole command, or estimate, without errors"): with_block(),
        ("structure", "twelve joints where they really are"): with_block(**joints),
        ("struts: scale", "offset, pitch error, backlash"): with_block(struts=scale),
        ("struts: waves", "screw waves"): with_block(struts=waves),
        ("struts: map", "length map, 21 knots"): with_block(struts=curved),
        ("screw rotation", "cardan joints turn the screws, a lead"): Compensator(turning, ideal),
        ("thermal", "struts, base and platform at their temperatures"): warm,
        ("field", "three families of lines, cubic, six components"): with_block(field=whole.field),
        ("load", "stiffness and lost motion under weight"): with_block(load=weight),
        ("load, friction", "the same, and bearings that rub"): with_block(load=rubbing),
        ("outside", "a table over elevation and rotation"): bent,
        ("field, outside", "both"): beside,
        ("all of them", "the shipped model: structure, scale, waves, field"): Compensator(geometry, whole),
    }


def one_round(compensator: Compensator, told: list[tuple[float, ...]]) -> tuple[float, float]:
    """Return what a command and an estimate take, µs."""
    compensator.reset()
    began = time.thread_time()
    for number, numbers in enumerate(told):
        compensator.step(numbers, PERIOD * number)
    stepped = time.thread_time()
    readings = compensator.command.copy()
    compensator.estimate(readings)
    estimated = time.thread_time()
    for _ in told:
        compensator.estimate(readings)
    ended = time.thread_time()
    return (stepped - began) / len(told) * 1e6, (ended - estimated) / len(told) * 1e6


def measure(rounds: int) -> list[Block]:
    """Return every block's cost."""
    geometry = load_geometry(config_file("paper.yaml"))
    told, everybody = commands(geometry), compensators(geometry)
    for compensator in everybody.values():  # the first command is another one
        one_round(compensator, told)
    times = np.array([[one_round(c, told) for c in everybody.values()] for _ in range(rounds)])
    least = times.min(axis=0)
    added = least - least[0]
    added[0] = least[0]
    return [Block(*names, *row) for names, row in zip(everybody, added.tolist(), strict=True)]


def report(blocks: list[Block]) -> str:
    """Return the table."""
    rows = []
    for b in blocks:
        sign = "" if b.name == "ideal" else "+"
        rows.append([b.name, f"{b.command_us:{sign}.2f}", f"{b.estimate_us:{sign}.2f}", b.what])
    return table(["block", "command, µs", "estimate, µs", ""], rows)


def main() -> int:
    """Print the table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--rounds", type=int, default=25, help="runs of everybody (default %(default)s)")
    print(report(measure(parser.parse_args().rounds)))
    return 0


if __name__ == "__main__":
    sys.exit(main())
