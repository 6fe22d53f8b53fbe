"""The tool and the frame in which a compensator takes its commands, by name."""

from __future__ import annotations

import time
from typing import Any

from rcl_interfaces.msg import SetParametersResult
from rclpy.parameter import Parameter
from std_msgs.msg import String

from ..compensation.compensator import Compensator
from ..errors import CommandError, HexapodError
from ..machine.geometry import BASE, WORK, HexapodGeometry
from .command_source import CommandSource
from .compensator_status import CompensatorStatus
from .messages import read_message
from .parameters import ParameterError
from .runtime import MachineNode
from .vital_signs import LATCHED_QOS


def frame_ids(geometry: HexapodGeometry, options: dict[str, Any]) -> dict[str, str]:
    """Return the ``frame_id`` of poses in each frame of a machine, by the machine's names.

    Raises
    ------
    ParameterError
        Another work frame's is that of the base or the usual work frame.
    """
    ids = {BASE: options["base_frame"], WORK: options["work_frame"]}
    for name in geometry.work_frames:
        frame_id = ids.setdefault(name, f"{options['frame_prefix']}{name}")
        if name not in (BASE, WORK) and frame_id in (ids[BASE], ids[WORK]):
            raise ParameterError(f"parameter frame_prefix: with it work frame {name!r} has the frame_id of another")
    return ids


class ToolChoice:
    """The tool in use: the parameter ``tool`` and the topic ``select_tool`` choose it, ``~/tool`` says which it is.

    The topic is for controllers: it sets the parameter. Only one node may publish on it, and only a machine that stands
    takes another tool.

    Parameters
    ----------
    node : MachineNode
        Has the parameter.
    compensator : Compensator
        Takes the tool.
    status : CompensatorStatus
        Knows whether the machine stands; counts what was refused.
    """

    def __init__(self, node: MachineNode, compensator: Compensator, status: CompensatorStatus) -> None:
        self._node, self._compensator, self._status = node, compensator, status
        self._selected = node.obey(String, "select_tool", self._on_message, self._look_at_publishers)
        several = bool(node.get_parameter("allow_several_publishers").value)
        selected = self._selected
        self._source = CommandSource(node, selected.topic_name, selected.get_publisher_count, several)
        status.sensing["select_tool"] = self._source
        self._publisher = node.create_publisher(String, "~/tool", LATCHED_QOS)
        node.add_on_set_parameters_callback(self._look)
        node.add_post_set_parameters_callback(self._take)
        self._publish()

    def close(self) -> None:
        """Take no more tools."""
        self._node.remove_on_set_parameters_callback(self._look)
        self._node.remove_post_set_parameters_callback(self._take)
        self._status.sensing.pop("select_tool", None)
        self._node.destroy_subscription(self._selected)
        self._node.destroy_publisher(self._publisher)

    def _look(self, parameters: list[Parameter]) -> SetParametersResult:
        """Refuse a tool that there is not, and any while the machine moves."""
        try:
            for name in _tools(parameters):
                self._refuse(name)
        except HexapodError as error:
            return SetParametersResult(successful=False, reason=f"parameter tool: {error}")
        return SetParametersResult(successful=True)

    def _refuse(self, name: object) -> None:
        geometry = self._compensator.geometry
        if not isinstance(name, str):
            raise CommandError("tool", f"must be str, not {name!r}")
        geometry.using(tool=name)
        moving = self._status.standing.moving(time.monotonic())
        if moving and name != geometry.tool_name:
            raise CommandError("tool", f"stays {geometry.tool_name!r} while the machine moves: {moving}")

    def _take(self, parameters: list[Parameter]) -> None:
        for name in _tools(parameters):
            if name != self._compensator.geometry.tool_name:
                self._compensator.set_tool(name)
                self._node.note("tool", f"tool {name!r}: the next command must be where the struts are")
                self._publish()

    def _look_at_publishers(self) -> None:
        self._source.look(time.monotonic())

    def _on_message(self, data: bytes, number: int | None) -> None:
        now = time.monotonic()
        self._source.look(now)  # who has just come may have spoken already
        self._source.hear(number, now)
        try:
            if self._source.problem:
                raise CommandError(self._source.reason, self._source.problem)
            self._select(read_message(data, String).data)
        except CommandError as error:
            self._status.refused_tools.add(error.reason, str(error), now)
            self._node.warn_of("tool", f"select_tool refused: {error}")

    def _select(self, name: str) -> None:
        """Take a tool as the parameter would; where the commander's is refused, its next command must be where the
        struts are: commands for the tool that it did not get may follow. Whoever else asks in vain stops nothing."""
        result = self._node.set_parameters([Parameter("tool", value=name)])[0]
        if result.successful:
            return
        commands = set(self._source.names) <= set(self._status.source.names)
        if commands and not self._status.standing.moving(time.monotonic()):
            self._compensator.set_tool(self._compensator.geometry.tool_name)
        raise CommandError("tool", result.reason)

    def _publish(self) -> None:
        self._publisher.publish(String(data=self._compensator.geometry.tool_name))


def _tools(parameters: list[Parameter]) -> list:
    return [parameter.value for parameter in parameters if parameter.name == "tool"]
