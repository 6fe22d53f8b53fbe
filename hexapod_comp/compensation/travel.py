"""The travel of a tool: how far it can move from a pose in each direction until a limit is reached."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ..core import Status, Struct
from ..core.batch import go
from ..errors import HexapodError
from ..formats.texts import aligned, number
from ..machine.model import RealMachine
from ..pose import Pose
from .compensator import pack_pose, refusal

COORDINATES = ("x", "y", "z", "alpha", "beta", "gamma")
STEPS = 500  # The search step is the longest strut's length / STEPS; a narrower forbidden region may be missed
TURN_STEP, LONGEST_TURN = math.radians(0.5), math.pi  # Search step and largest travel of rotations, rad


@dataclass(frozen=True)
class Travel:
    coordinate: str  # One of :data:`COORDINATES`; the other coordinates are fixed
    sign: int  # 1 or −1
    distance: float  # The largest distance at which no limit is broken, m or rad
    error: HexapodError | None  # The limit that ends the travel; None: a rotation by π breaks no limit

    @property
    def way(self) -> str:
        return f"{'+' if self.sign > 0 else '-'}{self.coordinate}"

    @property
    def unit(self) -> str:
        return "deg" if self.coordinate in COORDINATES[3:] else "mm"

    @property
    def key(self) -> str:
        return f"{self.way}_{self.unit}"

    @property
    def shown(self) -> float:
        return self.distance * (1e3 if self.unit == "mm" else 180.0 / math.pi)


def travel(
    machine: RealMachine, tool_pose: Pose, frame: Pose | None = None, compensates: bool = True
) -> tuple[Travel, ...]:
    """Return how far the tool can move from `tool_pose`, both ways in each coordinate of `frame` (default: work)."""
    geometry, state = machine.geometry, Struct("hc_state")
    state.copy_from(machine.state)
    state.view["last"]["enabled"] = compensates
    start, work = pack_pose(tool_pose), pack_pose(geometry.work if frame is None else frame)
    _, beta, _ = tool_pose.angles()
    # R = Ry(β)·Rx(α)·Rz(γ): α turns about the x axis rotated by Ry(β), β about y, and γ about the tool's own z.
    turns = np.array([[math.cos(beta), 0.0, -math.sin(beta)], [0.0, 1.0, 0.0], tool_pose.rotation[:, 2]])
    stroke, none, ways = float(geometry.limits.stroke.max()), np.zeros(3), []
    for coordinate, axis in zip(COORDINATES, (*np.eye(3), *turns), strict=True):
        turning = coordinate in COORDINATES[3:]
        step, longest = (TURN_STEP, LONGEST_TURN) if turning else (stroke / STEPS, 4.0 * stroke)
        for sign in (1, -1):
            shift, turn = (none, sign * axis) if turning else (sign * axis, none)
            way = go(state.at, start.at, work.at, shift, turn, step, longest)
            error = None
            if way.refused.status != Status.OK:
                error = refusal(way.refused, geometry, machine.model)
                if way.outside == 0.0:
                    raise error
            ways.append(Travel(coordinate, sign, way.inside, error))
    return tuple(ways)


def travel_text(ways: Sequence[Travel]) -> str:
    """Return a table with the direction, distance and limit of each travel."""
    if not ways:
        return ""
    rows = [[one.way, number(one.shown, 3), one.unit, str(one.error or "no limit")] for one in ways]
    return aligned(["way", "travel", "unit", ""], rows)
