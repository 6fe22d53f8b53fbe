"""What the compensator node is told of gravity and other forces: parameter and topic ``gravity``, topic ``wrench``."""

from __future__ import annotations

import math

import numpy as np
from geometry_msgs.msg import Vector3Stamped, WrenchStamped

from ..compensation.compensator import Compensator
from ..errors import CommandError, shorten
from ..machine.geometry import BASE
from ..machine.load import EARTH, Loading, wrench_on_platform
from .base import MachineNode
from .sensors import SensorTopic
from .status import CompensatorStatus

WRENCH_PERIOD = 0.01  # A wrench that comes sooner after the last one, s, is left out: each ramps in, and is journalled


class Loads:
    """Gravity and wrench, from who may tell of them, to the compensator."""

    def __init__(
        self, node: MachineNode, compensator: Compensator, status: CompensatorStatus, ids: dict[str, str]
    ) -> None:
        self._compensator, self._status, self._base = compensator, status, ids[BASE]
        self._gravity: tuple[float, ...] | None = None  # as published; None: the parameter's, or the model's
        self._wrench = Loading().wrench
        self._topics = {
            "gravity": SensorTopic(node, status, "gravity", Vector3Stamped, self._on_gravity),
            "wrench": SensorTopic(node, status, "wrench", WrenchStamped, self._on_wrench, period=WRENCH_PERIOD),
        }
        status.loads = self
        self.apply()

    def close(self) -> None:
        """Close the subscriptions."""
        self._status.loads = None
        for topic in self._topics.values():
            topic.close()

    def apply(self) -> None:
        """Give the compensator what counts now, unless ``load_hold`` holds what it has."""
        if self._status.options["load_hold"]:
            return
        stated = self._status.options["gravity"]
        gravity = self._gravity or (stated if any(stated) else None)
        self._compensator.set_load(Loading.of(gravity, self._wrench))

    def stale(self, now: float) -> str:
        """Return what was published, but not for longer than ``load_timeout``."""
        timeout = self._status.options["load_timeout"]
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

    def values(self) -> dict[str, str]:
        """Return what acts at present, as key and value of diagnostics."""
        compensator = self._compensator
        gravity = compensator.loading.gravity or tuple(compensator.model.load.gravity.tolist())
        return {
            "load": "held" if self._status.options["load_hold"] else "followed",
            "gravity_m_s2": ", ".join(f"{value:.3f}" for value in gravity),
            "wrench_N_Nm": ", ".join(f"{value:.2f}" for value in compensator.loading.wrench),
            "payload": str(compensator.geometry.payload),
        }
