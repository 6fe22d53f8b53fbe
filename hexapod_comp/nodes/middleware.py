"""How the nodes' DDS is set up, before ROS is initialised in a process; and a private end of ROS for who is no node."""

from __future__ import annotations

import os
from types import TracebackType
from typing import Any

import rclpy
from rclpy.experimental import EventsExecutor
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions

from ..formats.paths import config_folder

PROFILE_VARIABLES = ("FASTRTPS_DEFAULT_PROFILES_FILE", "FASTDDS_DEFAULT_PROFILES_FILE")
"""Where Fast DDS looks for a user's profile: up to version 2 (ROS 2 Jazzy), and from version 3."""

PROFILE = "fastdds.xml"

TAKE_PROFILE_WHOLE = "RMW_FASTRTPS_USE_QOS_FROM_XML"
"""Without it ROS overrules what a profile says of memory."""


def avoid_shared_memory() -> None:
    """Let Fast DDS receive by UDP only, unless the user has a profile of their own.

    A process killed while it holds a lock in the shared memory of another stalls that other for seconds.
    The environment of this process, and so of its children, is changed.
    """
    if not any(os.environ.get(name) for name in PROFILE_VARIABLES):
        os.environ[PROFILE_VARIABLES[0]] = str(config_folder() / PROFILE)
        os.environ.setdefault(TAKE_PROFILE_WHOLE, "1")


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
