"""A running machine that calibrates itself: measured, braked when a person stops it, its model reloaded."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

from rcl_interfaces.msg import Parameter, ParameterType, ParameterValue
from rcl_interfaces.srv import GetParameters, SetParameters
from std_srvs.srv import Trigger

from ..errors import CommandError
from ..formats.paths import folder_of
from ..measurements.collect import Observation
from ..pose import Pose
from .client import MoveError, MoveState
from .collector import WatchedMachine

ANSWERED_WITHIN = 60.0  # A model is read within 30 s, or refused


class AdaptedMachine(WatchedMachine):
    """A machine with mover, compensator and an instrument that publishes poses of its tool; `going_on` false brakes."""

    def __init__(
        self,
        topic: str,
        namespace: str = "",
        mover: str = "mover",
        compensator: str = "compensator",
        samples: int = 25,
        going_on: Callable[[], bool] = lambda: True,
    ) -> None:
        super().__init__(topic, namespace, mover, samples)
        self._going_on, self._compensator = going_on, compensator
        self._arrived: MoveState | None = None  # at the target of the newest move,
        self._target: tuple[Pose, tuple[Any, ...], dict[str, Any]]  # which was asked for so
        node = self.node
        self._reload_model = node.create_client(Trigger, f"{compensator}/reload_model")
        self._set = node.create_client(SetParameters, f"{compensator}/set_parameters")
        self._get = node.create_client(GetParameters, f"{compensator}/get_parameters")

    def move(self, pose: Pose, *arguments: Any, **options: Any) -> MoveState:
        """Move the tool and return when it has arrived; brake when it shall not go on: a MoveError, ``person``.

        Where another client has the tool moved, wait until that has ended, and ask again.
        """
        braked = False

        def watch(state: MoveState) -> None:
            nonlocal braked
            if not braked and not self._going_on():
                braked = True
                self._stop.call_async(Trigger.Request())

        while True:
            try:
                self._arrived = super().move(pose, *arguments, **{"progress": watch, **options})
            except MoveError as error:
                if error.reason != "replaced":
                    raise
                self._wait_for_others()
            else:
                self._target = pose, arguments, options
                return self._arrived

    def _wait_for_others(self) -> None:
        self.node.get_logger().warning("another client moves the tool: waiting until it stands")
        while self.last.state not in ("idle", "arrived", "stopped"):
            if not self._going_on():
                raise MoveError("person", "stopped while another client moved the tool")
            self.spin_once(0.02)

    def observe(self) -> Observation | None:
        """Observe as a watched machine; anew where another client has moved the tool meanwhile."""
        while True:
            seen = super().observe()
            if self._arrived is None or self.last.request == self._arrived.request:
                return seen
            self._wait_for_others()
            pose, arguments, options = self._target
            self.move(pose, *arguments, **options)

    def reload(self, path: Path) -> None:
        """Have the compensator run a model file, by its ramp; where it refuses, the old model and its name stay."""
        (before,) = self._parameters("model_file")
        for client in (self._reload_model, self._set):
            self.wait(client.service_is_ready, 10.0, f"the services of {self._compensator}")
        wanted = str(path.resolve())
        self._name_model(wanted)
        answer = self._call(self._reload_model, Trigger.Request())
        if not answer.success:
            self._name_model(before)
            raise CommandError("reload", f"{self._compensator} did not take {wanted}: {answer.message}")

    def refuse_unreadable(self, path: Path) -> None:
        """Refuse a model file that the compensator would not open, before anything is measured for it.

        Whether names that are relative to its own folder lead there is not known here: then its reload tells.
        """
        folder, model = self._parameters("model_folder", "model_file")
        name = folder or model
        own = Path(folder).expanduser() if folder else folder_of(model)
        if own is not None and (
            not Path(name).expanduser().is_absolute() or path.resolve().is_relative_to(own.resolve())
        ):
            return
        places = "shipped models alone" if own is None else f"models in {own} alone"
        advice = f"start it with -p model_folder:=FOLDER, in which {path.resolve()} and its geometry file are"
        raise CommandError("reload", f"{self._compensator} reads {places}: {advice}")

    def runs(self, path: Path) -> bool:
        """Return whether the compensator's model is the one of a file."""
        return self._parameters("model_file") == [str(path.resolve())]

    def _parameters(self, *names: str) -> list[str]:
        self.wait(self._get.service_is_ready, 10.0, f"the services of {self._compensator}")
        return [str(value.string_value) for value in self._call(self._get, GetParameters.Request(names=names)).values]

    def _name_model(self, name: str) -> None:
        value = ParameterValue(type=ParameterType.PARAMETER_STRING, string_value=name)
        request = SetParameters.Request(parameters=[Parameter(name="model_file", value=value)])
        (result,) = self._call(self._set, request).results
        if not result.successful:
            raise CommandError("reload", f"{self._compensator} keeps its model_file: {result.reason}")

    def _call(self, client: Any, request: Any) -> Any:
        future = client.call_async(request)
        self.wait(future.done, ANSWERED_WITHIN, f"the answer of {client.srv_name}")
        return future.result()
