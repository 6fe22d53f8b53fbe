"""How far a tool may go from where it is, one way after the other, until a limit stands."""

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
STEPS = 500  # Into so many steps the longest strut is divided; what is narrower than one may be stepped over
TURN_STEP, LONGEST_TURN = math.radians(0.5), math.pi  # The same for turns, rad, and how far they are followed


@dataclass(frozen=True)
class Travel:
    """How far a tool may go one way."""

    coordinate: str  # One of :data:`COORDINATES`; the others stay
    sign: int  # 1 or −1
    distance: float  # The furthest that all limits allow, m or rad
    error: HexapodError | None  # What stands beyond; None where a turn ends at π

    @property
    def way(self) -> str:
        """``+x``, ``-alpha``."""
        return f"{'+' if self.sign > 0 else '-'}{self.coordinate}"

    @property
    def unit(self) -> str:
        """Of what is shown: mm or deg."""
        return "deg" if self.coordinate in COORDINATES[3:] else "mm"

    @property
    def key(self) -> str:
        """What :attr:`shown` is called: way and unit."""
        return f"{self.way}_{self.unit}"

    @property
    def shown(self) -> float:
        """The distance in the unit shown."""
        return self.distance * (1e3 if self.unit == "mm" else 180.0 / math.pi)


def travel(
    machine: RealMachine, tool_pose: Pose, frame: Pose | None = None, compensates: bool = True
) -> tuple[Travel, ...]:
    """Return how far the tool may go from a pose, by each of its six coordinates, forward and backward."""
    start = _Outset(machine, tool_pose, machine.geometry.work if frame is None else frame, compensates)
    return tuple(start.travel(coordinate, sign) for coordinate in COORDINATES for sign in (1, -1))


class _Outset:
    """Where a machine's tool starts from, as the core takes it."""

    def __init__(self, machine: RealMachine, tool_pose: Pose, frame: Pose, compensates: bool) -> None:
        self._machine = machine
        self._frame, self._start, self._state = pack_pose(frame), pack_pose(tool_pose), Struct("hc_state")
        self._state.copy_from(machine.state)
        self._state.view["last"]["enabled"] = compensates
        _, beta, _ = tool_pose.angles()
        # R = Ry(β)·Rx(α)·Rz(γ): α turns about x as Ry(β) leaves it, β about y, γ about the tool's own z.
        axes = np.array([[math.cos(beta), 0.0, -math.sin(beta)], [0.0, 1.0, 0.0], tool_pose.rotation[:, 2]])
        self._axes = np.concatenate([np.eye(3), axes])

    def travel(self, coordinate: str, sign: int) -> Travel:
        """Return how far the tool may go; raise what is wrong with where it starts."""
        index = COORDINATES.index(coordinate)
        turns, axis = index >= 3, sign * self._axes[index]
        shift, turn = (np.zeros(3), axis) if turns else (axis, np.zeros(3))
        stroke = float(self._machine.geometry.limits.stroke.max())
        step, longest = (TURN_STEP, LONGEST_TURN) if turns else (stroke / STEPS, 4.0 * stroke)
        way = go(self._state.at, self._start.at, self._frame.at, shift, turn, step, longest)
        if way.refused.status == Status.OK:
            return Travel(coordinate, sign, way.inside, None)
        error = refusal(way.refused, self._machine.geometry, self._machine.model)
        if way.outside == 0.0:
            raise error
        return Travel(coordinate, sign, way.inside, error)


def travel_text(ways: Sequence[Travel]) -> str:
    """Return a table: way, how far, and what stands there; empty without ways."""
    if not ways:
        return ""
    rows = [[one.way, number(one.shown, 3), one.unit, str(one.error or "no limit")] for one in ways]
    return aligned(["way", "travel", "unit", ""], rows)
