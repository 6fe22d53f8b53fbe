"""Nominal strut lengths as commands: are they answered as the tool poses that they belong to?

Machines of test/foreign_machines.py, with random errors, follow straight lines between random poses of their measured
boxes, tilted by up to 3°. One compensator gets the tool poses, another the messages with the strut lengths of the
machine without errors, by the zoo's own kinematics, and works out the poses first.

Usage: python -m benchmarks.strut_input [--poses 100000]

Exits 1 when any answer differs by more than 1 nm, or one way refuses what the other takes.
"""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from rclpy.serialization import serialize_message
from scipy.spatial.transform import Rotation, Slerp
from sensor_msgs.msg import JointState
from tqdm import tqdm

from benchmarks import table
from hexapod_comp.compensation.compensator import Compensator, pack_pose
from hexapod_comp.compensation.guards import Sample
from hexapod_comp.errors import HexapodError
from hexapod_comp.machine.geometry import STRUT_NAMES, load_geometry
from hexapod_comp.pose import Pose
from hexapod_comp.ros.interface import StrutInput
from hexapod_comp.virtual.named import find_model

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "test"))
from foreign_machines import Machine, machines

BAR = 1e-9  # Largest difference, m

NO_SHIFT = pack_pose(Pose.identity())  # frame of poses that are in ``base`` already

TILT, PER_LINE = 3.0, 200  # Of a pose about each axis, degrees; poses from one random pose to the next


@dataclass(frozen=True)
class Difference:
    """How far the answers to lengths and to poses are apart."""

    machine: str
    taken: int  # Poses that both ways took, and that both refused for the same reason
    refused: int
    unlike: int  # Poses that only one way took, or that were refused for different reasons
    largest: float  # Largest difference of a strut command, and of a nominal length to the one that was sent, m
    nominal: float

    @property
    def kept(self) -> bool:
        """Whether the bar is kept."""
        return self.taken > 0 and not self.unlike and max(self.largest, self.nominal) <= BAR


def walk(machine: Machine, count: int, rng: np.random.Generator) -> tuple[np.ndarray, Rotation]:
    """Return tips in work, (N, 3), m, and attitudes of the tool in work, on straight lines from the middle."""
    corners = -(-count // PER_LINE) + 1
    tips = rng.uniform(*machine.box, (corners, 3))
    turns = Rotation.from_rotvec(np.radians(rng.uniform(-TILT, TILT, (corners, 3))))
    tips[0] = machine.middle
    where = np.arange(count) / PER_LINE
    at = np.arange(corners)
    places = np.stack([np.interp(where, at, column) for column in tips.T], axis=1)
    return places, Slerp(at, turns)(where)


def difference(machine: Machine, count: int, seed: int, folder: Path) -> Difference:
    """Send a walk both ways to a machine with random errors, and compare the answers."""
    geometry = load_geometry(machine.write(folder / f"{machine.name}.yaml"))
    model = find_model(f"random:{seed}", geometry)
    by_pose, by_struts = (Compensator(geometry, model) for _ in range(2))
    given = StrutInput(by_struts, list(STRUT_NAMES), "base")

    def read(data: bytes) -> tuple[float, ...]:
        given.read(data, sample := Sample(0.0))
        return sample.values or ()

    tips, tools = walk(machine, count, np.random.default_rng(seed))
    lengths = machine.lengths(*machine.platform_poses(tips, tools.as_matrix()))
    taken = refused = unlike = 0
    largest = nominal = 0.0
    for tip, tool, length in zip(tips, tools.as_quat(), lengths, strict=True):
        data = serialize_message(JointState(name=list(STRUT_NAMES), position=length.tolist()))
        wanted = _answer(lambda tip=tip, tool=tool: by_pose.step((*tip, *tool), math.nan))
        got = _answer(lambda data=data: by_struts.step(read(data), math.nan, NO_SHIFT))
        if isinstance(wanted, str) or isinstance(got, str):
            same = isinstance(wanted, str) and isinstance(got, str) and wanted == got
            refused, unlike = refused + same, unlike + (not same)
            continue
        taken += 1
        largest = max(largest, float(np.abs(got - wanted).max()))
        nominal = max(nominal, float(np.abs(by_struts.nominal - length).max()))
    return Difference(machine.name, taken, refused, unlike, largest, nominal)


def _answer(run: Callable[[], np.ndarray]) -> np.ndarray | str:
    """Return strut commands, m, or why there are none."""
    try:
        return run()
    except HexapodError as error:
        return error.reason


def main(argv: list[str] | None = None) -> int:
    """Print the differences of each machine; exit 1 when the bar is missed."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--poses", type=int, default=100_000, help="of all machines (default 100000)")
    options = parser.parse_args(argv)
    with TemporaryDirectory() as folder:
        zoo = tqdm(machines().values(), disable=None)
        each = -(-options.poses // len(zoo))
        rows = [difference(machine, each, 3, Path(folder)) for machine in zoo]
    lines = ((r.machine, r.taken, r.refused, r.unlike, f"{r.largest:.1e}", f"{r.nominal:.1e}") for r in rows)
    print(table(["machine", "taken", "refused", "unlike", "commands, m", "nominal, m"], lines))
    return 0 if all(row.kept for row in rows) else 1


if __name__ == "__main__":
    sys.exit(main())
