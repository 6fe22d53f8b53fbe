"""What a node does before it may be configured: it answers, and says that its kernels are being compiled."""

from __future__ import annotations

from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState

from ..errors import HexapodError
from .callbacks import LateAnswer
from .health import OK, WARN
from .runtime import MachineNode
from .warming import Warming

CONFIGURE = "configure"


class NotReadyError(HexapodError):
    """A request that must be made again later."""

    reason = "not_ready"


class Starting:
    """Keeps a node unconfigured until its kernels are there.

    All requests are answered meanwhile, but one to configure a node that does not do so by itself: as every transition
    it is answered when it has been made.

    Parameters
    ----------
    node : MachineNode
        Nobody may have configured it yet.
    warming : Warming
        The kernels on their way.
    """

    def __init__(self, node: MachineNode, warming: Warming) -> None:
        self._node, self._warming = node, warming
        service = next(s for s in node.services if s.srv_type is ChangeState)
        self._change = service.callback
        service.callback = node.guard.answering(service.srv_name, ChangeState, self._on_change)
        self._late = LateAnswer(service)
        self._waiting: ChangeState.Request | None = None
        self._logged = self._done = False

    def look(self) -> bool:
        """Say how far it is; when the kernels are there, answer who has waited, and return True from then on."""
        if self._done:
            return True
        self._done = self._warming.done
        if self._warming.compiling:
            self._say()
        if self._done and self._waiting is not None:
            self._late.answer(self._change(self._waiting, ChangeState.Response()))
        return self._done

    def _say(self) -> None:
        node, warming = self._node, self._warming
        if not self._logged:
            self._logged = True
            node.get_logger().info("compiling kernels, once after an installation or update; it takes up to a minute")
        values = {"compiling_s": f"{warming.seconds:.0f}"}
        if not self._done:
            node.tell(WARN, "compiling kernels", lambda: values)
            return
        if warming.problem:
            node.warn_of("compiling", warming.problem)
        node.get_logger().info(f"kernels compiled in {warming.seconds:.0f} s")
        node.tell(OK, "kernels compiled", lambda: values)

    def _on_change(self, request: ChangeState.Request, response: ChangeState.Response) -> ChangeState.Response | None:
        wanted = request.transition
        configures = wanted.label == CONFIGURE or (not wanted.label and wanted.id == Transition.TRANSITION_CONFIGURE)
        if self._done or not configures:
            return self._change(request, response)
        if self._node.wants_autostart or self._waiting is not None:
            raise NotReadyError("the node is configured as soon as its kernels are there, as it was told before")
        self._waiting = request
        return None

    def close(self) -> None:
        """End what has not been finished."""
        self._warming.give_up()
        if not self._done:
            self._late.answer(ChangeState.Response(success=False))
