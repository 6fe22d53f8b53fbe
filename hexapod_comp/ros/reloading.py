"""The service that takes a new model while the machine moves."""

from __future__ import annotations

import time

from rclpy.service import Service
from std_srvs.srv import Trigger

from ..compensation.compensator import Compensator
from ..errors import HexapodError
from .callbacks import LateAnswer
from .callers import callers
from .health import Refusals
from .machine_files import MachineFiles
from .model_loading import Loading
from .runtime import MachineNode


class ReloadService:
    """``~/reload_model``: answers when the file has been read elsewhere, and keeps the old model if that fails.

    Parameters
    ----------
    node : MachineNode
        Where the service is.
    files : MachineFiles
        Where the model is read.
    compensator : Compensator
        Takes the model.
    failures : Refusals
        Where failures are counted.
    """

    def __init__(
        self,
        node: MachineNode,
        files: MachineFiles,
        compensator: Compensator,
        failures: Refusals,
    ) -> None:
        self._node, self._files, self._compensator, self._failures = node, files, compensator, failures
        self._loading: Loading | None = None
        self._late = LateAnswer(node.create_service(Trigger, "~/reload_model", self._on_request))

    @property
    def service(self) -> Service:
        """The service itself."""
        return self._late.service

    def _on_request(self, _: Trigger.Request, __: Trigger.Response) -> Trigger.Response | None:
        self._node.note("reload", f"reload: asked for by {callers(self._node, self.service)}")
        if self._loading is not None:
            return Trigger.Response(success=False, message="the model is being loaded already")
        self._loading = self._files.begin_loading(self._compensator.geometry.name)
        return None

    def look(self) -> None:
        """Take a model that has been loaded in the meantime, and answer."""
        loading = self._loading
        if loading is None or not loading.done:
            return
        self._loading = None
        sources = self._files.sources
        before = sources["model"]
        try:
            model, sources["model"] = loading.result()  # the source first: the journal notes it with the change
            self._compensator.set_model(model)
        except HexapodError as error:
            sources["model"] = before
            self._late.answer(self._failed(error))
            return
        self._late.answer(Trigger.Response(success=True, message=f"model {model.name!r} ramps in"))

    def close(self) -> None:
        """Give up what is being loaded."""
        self._loading = None
        self._late.answer(Trigger.Response(success=False, message="the old model stays: the node was cleaned up"))
        self._node.destroy_service(self.service)

    def _failed(self, error: HexapodError) -> Trigger.Response:
        self._failures.add(error.reason, str(error), time.monotonic())
        self._node.get_logger().warning(f"the old model stays: {error}")
        return Trigger.Response(success=False, message=f"the old model stays: {error}")
