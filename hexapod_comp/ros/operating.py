"""What an operator asks of a compensator: compensation on or off, a reset."""

from __future__ import annotations

import time
from collections.abc import Callable

from std_srvs.srv import SetBool, Trigger

from ..compensation.compensator import Compensator
from .callers import callers
from .compensator_status import CompensatorStatus
from .runtime import MachineNode


class OperatorServices:
    """``~/enable_compensation`` and ``~/reset`` of a configured compensator; who may have called is logged.

    Parameters
    ----------
    node : MachineNode
        Where the services are.
    compensator : Compensator
        Is switched.
    status : CompensatorStatus
        Knows whether the machine stands, and holds the following error.
    forget : callable
        Forgets the last command.
    """

    def __init__(
        self, node: MachineNode, compensator: Compensator, status: CompensatorStatus, forget: Callable[[], None]
    ) -> None:
        self._node, self._compensator, self._status, self._forget = node, compensator, status, forget
        self._enable = node.create_service(SetBool, "~/enable_compensation", self._on_enable)
        self._reset = node.create_service(Trigger, "~/reset", self._on_reset)

    def close(self) -> None:
        """Destroy the services."""
        for service in (self._enable, self._reset):
            self._node.destroy_service(service)

    def _on_enable(self, request: SetBool.Request, response: SetBool.Response) -> SetBool.Response:
        self._compensator.enable(request.data)
        response.success = True
        response.message = f"compensation ramps {'in' if request.data else 'out'}"
        self._node.note("enable", f"{response.message}: asked for by {callers(self._node, self._enable)}")
        return response

    def _on_reset(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        """Forget the last command and a following error, if the machine stands."""
        who = callers(self._node, self._reset)
        moving = self._status.standing.moving(time.monotonic())
        if moving:
            response.message = f"refused while the machine moves: {moving}"
            self._status.refused_resets.add("moving", response.message, time.monotonic())
            self._node.warn_of("reset", f"reset {response.message}; asked for by {who}")
            return response
        self._forget()
        self._status.following.release()
        response.success = True
        response.message = "the next command may be one allowed step from where the struts were known to be last"
        self._node.note("reset", f"reset: asked for by {who}")
        return response
