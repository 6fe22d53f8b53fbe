"""A private end of ROS for programs that speak with nodes and are none."""

from __future__ import annotations

from types import TracebackType
from typing import Any

import rclpy
from rclpy.experimental import EventsExecutor
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.signals import SignalHandlerOptions

from . import open_streams
from .middleware import avoid_shared_memory

QUIET: dict[str, Any] = {
    "start_parameter_services": False,
    "enable_rosout": False,
    "parameter_overrides": [Parameter("start_type_description_service", value=False)],
}
"""Options of a node that publishes nothing and offers nothing."""


class RosSession:
    """A private context of ROS with an executor and one node: for programs that speak with nodes; signals are theirs.

    Parameters
    ----------
    name : str
        Of the node.
    namespace : str
        Of the node.
    **options
        Others of ``rclpy.create_node``.
    """

    def __init__(self, name: str, namespace: str = "", **options: Any) -> None:
        open_streams()
        avoid_shared_memory()
        self._context = rclpy.Context()
        rclpy.init(args=[], context=self._context, signal_handler_options=SignalHandlerOptions.NO)
        self.node: Node = rclpy.create_node(name, namespace=namespace, context=self._context, **options)
        self._executor = EventsExecutor(context=self._context)
        self._executor.add_node(self.node)

    def __enter__(self) -> RosSession:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def spin_once(self, timeout: float) -> None:
        """Handle what has come, or the first to come within so many seconds."""
        self._executor.spin_once(timeout_sec=timeout)

    def close(self) -> None:
        """Leave ROS."""
        self._executor.shutdown()
        self.node.destroy_node()
        rclpy.try_shutdown(context=self._context)
