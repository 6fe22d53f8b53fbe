"""How far the tool may go from where the machine is: once a second on a topic, and whenever somebody asks."""

from __future__ import annotations

from concurrent.futures import Future, ThreadPoolExecutor

import numpy as np
from diagnostic_msgs.msg import DiagnosticStatus
from std_srvs.srv import Trigger

from ..compensation.compensator import Compensator
from ..errors import CommandError, HexapodError
from ..machine.geometry import WORK, pose_text
from ..pose import Pose
from ..workspace.travel import Travel, travel, travel_text
from .callbacks import LateAnswer
from .compensator_status import CompensatorStatus
from .health import ERROR, OK, status_of
from .runtime import EVENT_QOS, MachineNode

PERIOD = 1.0
"""Between two messages, s."""

LONGEST = 200
"""Characters of what stands in the way."""


class TravelReports:
    """``~/travel`` while somebody subscribes, and ``~/get_travel`` of a configured compensator.

    It is worked out in a thread of its own, by the core, which leaves Python to the commands.

    Parameters
    ----------
    node : MachineNode
        Publishes and answers.
    compensator : Compensator
        Knows where the machine was sent last.
    status : CompensatorStatus
        Knows whether struts are measured, and the frame of the last command.
    frame_ids : dict of str to str
        By the machine's names of its work frames.
    """

    def __init__(
        self, node: MachineNode, compensator: Compensator, status: CompensatorStatus, frame_ids: dict[str, str]
    ) -> None:
        self._node, self._compensator, self._status = node, compensator, status
        self._names = {frame_id: name for name, frame_id in frame_ids.items()}
        self._default = frame_ids[WORK]
        self._publisher = node.create_publisher(DiagnosticStatus, "~/travel", EVENT_QOS)
        self._late = LateAnswer(node.create_service(Trigger, "~/get_travel", self._on_request))
        self._thread = ThreadPoolExecutor(max_workers=1, thread_name_prefix="travel")
        self._work: Future[tuple[Travel, ...]] | None = None
        self._where, self._asked, self._due = "", False, 0.0

    def close(self) -> None:
        """Stop, and leave no request without an answer."""
        self._thread.shutdown(cancel_futures=True)
        self._answer(False, "the node was cleaned up")
        self._node.destroy_service(self._late.service)
        self._node.destroy_publisher(self._publisher)

    def look(self, now: float) -> None:
        """Hand on what has been worked out, and begin anew when it is due, at the monotonic time `now`, s."""
        if self._work is not None and self._work.done():
            work, self._work = self._work, None
            try:
                self._tell(OK, self._where, work.result())
            except HexapodError as error:
                self._tell(ERROR, f"{self._where}: {error}", ())
        if self._work is None and now >= self._due and self._publisher.get_subscription_count():
            self._due = now + PERIOD
            try:
                self._begin()
            except CommandError as error:
                self._tell(ERROR, str(error), ())

    def _on_request(self, _: Trigger.Request, __: Trigger.Response) -> Trigger.Response | None:
        if self._asked and self._work is not None:
            raise CommandError("busy", "it is being worked out already")
        if self._work is None:
            self._begin()
        self._asked = True
        return None

    def _begin(self) -> None:
        """Begin to work it out at the last command, or before the first one where the struts were measured last."""
        compensator, frame_id = self._compensator, self._status.frame_id
        if frame_id not in self._names:  # before the first command
            frame_id = self._default
        if np.isfinite(compensator.nominal).all():
            platform = compensator.platform
        elif self._status.feedback.count:
            platform = Pose(*compensator.platform_estimate)
        else:
            raise CommandError("no_feedback", "no command and no strut_states yet: where the machine is is not known")
        geometry = compensator.geometry.using(work=self._names[frame_id])
        pose = geometry.tool_pose(platform)
        self._where = f"tool {geometry.tool_name} in {frame_id} at {pose_text(pose)}"
        self._work = self._thread.submit(travel, compensator.machine, pose, geometry.work, compensator.enabled)

    def _tell(self, level: bytes, text: str, ways: tuple[Travel, ...]) -> None:
        self._answer(level == OK, "\n".join(filter(None, (text, travel_text(ways)))))
        if self._publisher.get_subscription_count():
            values = {one.key: f"{one.shown:.6f}" for one in ways}
            values |= {f"{one.way} stops at": str(one.error or "") for one in ways}
            name = f"{self._node.get_fully_qualified_name()[1:]}: travel"
            self._publisher.publish(status_of(name, self._node.hardware_id, level, text, values, LONGEST))

    def _answer(self, success: bool, text: str) -> None:
        if self._asked:
            self._asked = False
            self._late.answer(Trigger.Response(success=success, message=text))
