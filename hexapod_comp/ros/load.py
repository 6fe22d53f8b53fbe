"""External inputs of the compensator node: gravity, other forces, outside numbers of the model's table."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np
from geometry_msgs.msg import Vector3Stamped, WrenchStamped
from sensor_msgs.msg import JointState

from ..compensation.compensator import Compensator
from ..compensation.guards import Guard
from ..errors import CommandError, HexapodError, OutsideTableError, shorten
from ..machine.geometry import BASE
from ..machine.load import EARTH, Loading, wrench_on_platform
from ..machine.outside import read_numbers
from .base import MachineNode
from .sensors import SensorTopic
from .status import CompensatorStatus

WRENCH_PERIOD = 0.01  # A wrench that arrives sooner after the last one, s, is ignored: each ramps in, and is journalled


class Loads:
    """Passes gravity, wrench and outside numbers from their single publishers to the compensator."""

    def __init__(
        self, node: MachineNode, compensator: Compensator, status: CompensatorStatus, ids: dict[str, str]
    ) -> None:
        self._node, self._compensator, self._status, self._base = node, compensator, status, ids[BASE]
        self._gravity: tuple[float, ...] | None = None  # as published; None: the parameter's, or the model's
        self._wrench = Loading().wrench
        self._numbers: dict[str, float] = {}  # as published; the compensator has those that count
        self._table = Guard()  # of a table that refuses numbers outside
        self._table.reason = OutsideTableError.reason
        status.standing = (*status.standing, self._table)
        self._topics = {
            "gravity": SensorTopic(node, status, "gravity", Vector3Stamped, self._on_gravity),
            "wrench": SensorTopic(node, status, "wrench", WrenchStamped, self._on_wrench, period=WRENCH_PERIOD),
            "outside": SensorTopic(node, status, "outside", JointState, self._on_numbers),
        }
        status.loads = self
        self.apply()

    def apply(self) -> None:
        """Pass the present gravity and wrench to the compensator, unless ``outside_hold`` holds the previous ones."""
        if self._status.options["outside_hold"]:
            return
        stated = self._status.options["gravity"]
        gravity = self._gravity or (stated if any(stated) else None)
        self._compensator.set_load(Loading.of(gravity, self._wrench))

    def update(self) -> None:
        """Pass the newest outside numbers to the compensator: periodically, as each change makes a model."""
        compensator, options = self._compensator, self._status.options
        if options["outside_hold"] or self._table.problem or self._numbers.items() <= compensator.outside.items():
            return
        table, known = compensator.model.outside, compensator.outside | self._numbers
        change = table.evaluate(known) - table.evaluate(compensator.outside)
        moved = np.linalg.norm(change[:3]) + np.linalg.norm(change[3:]) * compensator.geometry.characteristic_length
        if table.missing(compensator.outside) or moved > options["outside_dead_band"]:
            try:
                compensator.set_outside(self._numbers)
            except HexapodError as error:
                self._node.ignore("outside", error, self._status.bad_feedback, "outside")

    def stale(self, now: float) -> str:
        """Return the published value, but not for longer than ``outside_timeout``."""
        timeout = self._status.options["outside_timeout"]
        return ", ".join(name for name, topic in self._topics.items() if topic.stale(now, timeout))

    def _on_gravity(self, message: Vector3Stamped, _: float) -> None:
        if message.header.frame_id != self._base:
            problem = f"frame_id must be {self._base}, not {shorten(message.header.frame_id)}"
            raise CommandError("gravity", f"gravity: {problem}")
        vector = message.vector.x, message.vector.y, message.vector.z
        size = math.hypot(*vector)
        if not EARTH[0] <= size <= EARTH[1]:
            allowed = "{:g}…{:g} m/s²".format(*EARTH)
            raise CommandError("gravity", f"gravity: must be {allowed} in all, not {size:.4g}")
        moved = np.inf if self._gravity is None else math.dist(vector, self._gravity)
        if moved > self._status.options["gravity_dead_band"]:
            self._gravity = vector
            self.apply()

    def _on_wrench(self, message: WrenchStamped, _: float) -> None:
        parts = message.wrench.force, message.wrench.torque
        force, torque = (np.array([part.x, part.y, part.z]) for part in parts)
        self._wrench = wrench_on_platform(self._compensator.geometry, message.header.frame_id, force, torque)
        self.apply()

    def _on_numbers(self, message: JointState, _: float) -> None:
        table = self._compensator.model.outside
        if len(message.name) != len(message.position):
            problem = f"has {len(message.name)} names for {len(message.position)} positions"
            raise CommandError("outside", f"outside: {problem}")
        told = read_numbers({n: v for n, v in zip(message.name, message.position, strict=True) if n in table.names})
        if table.names and not told:
            found = shorten(", ".join(message.name))
            raise CommandError("outside", f"outside: must name {' or '.join(table.names)}, not {found}")
        try:
            table.validate(told)
        except OutsideTableError as error:
            self._table.problem = str(error)
            raise
        self._numbers |= told
        self._table.problem = ""

    def findings(self) -> Iterator[str]:
        """Yield warnings about the model's table of outside numbers."""
        table, numbers = self._compensator.model.outside, self._compensator.outside
        if missing := table.missing(numbers):
            yield f"the model's table does not count: not known is {missing}"
        elif held := table.held(numbers):
            yield f"running, outside the model's table, whose edge holds: {held}"

    def values(self) -> dict[str, str]:
        """Return the loads in use, as key and value of diagnostics, as far as the model uses them."""
        compensator, model = self._compensator, self._compensator.model
        values = {}
        if model.load.bends or model.outside.names:
            values["outside_hold"] = str(self._status.options["outside_hold"]).lower()
        if model.outside.names:
            error = 1e6 * model.outside.evaluate(compensator.outside)
            known = {name: value for name, value in compensator.outside.items() if name in model.outside.names}
            values["outside"] = ", ".join(model.outside.shown(*one) for one in known.items()) or "not known"
            values["outside_um"] = ", ".join(f"{value:.3f}" for value in error[:3])
            values["outside_urad"] = ", ".join(f"{value:.3f}" for value in error[3:])
        if not model.load.bends:
            return values
        gravity = compensator.loading.gravity or tuple(model.load.gravity.tolist())
        return values | {
            "gravity_m_s2": ", ".join(f"{value:.3f}" for value in gravity),
            "wrench_N_Nm": ", ".join(f"{value:.2f}" for value in compensator.loading.wrench),
            "payload": str(compensator.geometry.payload),
        }
