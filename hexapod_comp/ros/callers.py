"""Who may have called a service: rclpy gives a callback no more of its caller than the number of the request."""

from __future__ import annotations

from rclpy.node import Node
from rclpy.service import Service

from .command_source import full_name
from .guarding import described


def callers(node: Node, service: Service) -> str:
    """Return the nodes that have a client of a service, for the log: one of them has called.

    A client's requests are a topic of DDS, and the graph tells who publishes it.
    """
    try:
        infos = node.get_publishers_info_by_topic(f"rq{service.service_name}Request", no_mangle=True)
        names = sorted({full_name(info) for info in infos})
    except Exception as error:  # of many kinds: what the graph holds is others' doing
        return f"somebody unknown ({described(error)})"
    return " or ".join(names) or "somebody who has left"
