"""What the compensator node is told of gravity and other forces: parameter and topic ``gravity``, topic ``wrench``."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from typing import Any

import numpy as np
from geometry_msgs.msg import Vector3Stamped, WrenchStamped

from ..compensation.compensator import Compensator
from ..compensation.guards import Sample
from ..errors import CommandError, HexapodError, shorten
from ..machine.geometry import BASE
from ..machine.load import EARTH, Loading, wrench_on_platform
from .base import SENSOR_QOS, MachineNode
from .messages import read_message
from .status import CompensatorStatus

WRENCH_PERIOD = 0.01  # A wrench that comes sooner after the last one, s, is left out: each ramps in, and is journalled


class Loads:
    """Gravity and wrench, from who may tell of them, to the compensator."""

    def __init__(
        self,
        node: MachineNode,
        compensator: Compensator,
        status: CompensatorStatus,
        ids: dict[str, str],
        ignore: Callable[[str, str, str, str, float], None],
    ) -> None:
        self._compensator, self._status, self._base, self._ignore = compensator, status, ids[BASE], ignore
        self._gravity: tuple[float, ...] | None = None  # as heard; None: the parameter's, or the model's
        self._wrench = Loading().wrench
        self.last = dict.fromkeys(("gravity", "wrench"), math.nan)  # when each was heard, s
        self._ends = []
        update = lambda: status.update(time.monotonic())  # noqa: E731
        handlers: dict[str, tuple[type, Callable[[Any, float], None]]] = {
            "gravity": (Vector3Stamped, self._on_gravity),
            "wrench": (WrenchStamped, self._on_wrench),
        }
        for topic, (kind, handler) in handlers.items():
            receive = self._receiver(topic, kind, handler)
            end = node.subscribe_exclusive(kind, topic, receive, update, qos=SENSOR_QOS)
            status.sensing[topic] = node.sender_of(end, bool(status.options["allow_several_publishers"]))
            self._ends.append(end)
        status.loads = self
        self.apply()

    def close(self, node: MachineNode) -> None:
        """Hear no more."""
        for topic in self.last:
            self._status.sensing.pop(topic, None)
        self._status.loads = None
        node.close_ends(*self._ends)

    def apply(self) -> None:
        """Give the compensator what counts now, unless ``load_hold`` holds what it has."""
        if self._status.options["load_hold"]:
            return
        stated = self._status.options["gravity"]
        gravity = self._gravity or (stated if any(stated) else None)
        self._compensator.set_load(Loading.of(gravity, self._wrench))

    def stale(self, now: float) -> str:
        """Return what nobody has told of for longer than ``load_timeout``, though somebody did before."""
        timeout = self._status.options["load_timeout"]
        return ", ".join(topic for topic, heard in self.last.items() if 0.0 < timeout < now - heard)

    def _receiver(self, topic: str, kind: type, handler: Callable[[Any, float], None]) -> Callable[..., None]:
        def receive(data: bytes, number: int | None) -> None:
            now, sender = time.monotonic(), self._status.sensing[topic]
            try:
                if sender.receive(number, now):
                    self._status.update(now)
                sender.check(Sample(now))
                handler(read_message(data, kind), now)
            except CommandError as error:
                self._ignore(topic, error.reason, f"{topic} ignored: {error}", str(error), now)
            except HexapodError as error:
                self._ignore(topic, topic, f"{topic} ignored: {error}", str(error), now)

        return receive

    def _on_gravity(self, message: Vector3Stamped, now: float) -> None:
        if message.header.frame_id != self._base:
            problem = f"frame_id must be {self._base}, not {shorten(message.header.frame_id)}"
            raise CommandError("gravity", f"gravity: {problem}")
        vector = message.vector.x, message.vector.y, message.vector.z
        size = math.hypot(*vector)
        if not EARTH[0] <= size <= EARTH[1]:
            allowed = "{:g}…{:g} m/s²".format(*EARTH)
            raise CommandError("gravity", f"gravity: must be {allowed} in all, not {size:.4g}")
        self.last["gravity"] = now
        moved = np.inf if self._gravity is None else math.dist(vector, self._gravity)
        if moved > self._status.options["gravity_dead_band"]:
            self._gravity = vector
            self.apply()

    def _on_wrench(self, message: WrenchStamped, now: float) -> None:
        if now - self.last["wrench"] < WRENCH_PERIOD:
            return
        parts = message.wrench.force, message.wrench.torque
        force, torque = (np.array([part.x, part.y, part.z]) for part in parts)
        self._wrench = wrench_on_platform(self._compensator.geometry, message.header.frame_id, force, torque)
        self.last["wrench"] = now
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
