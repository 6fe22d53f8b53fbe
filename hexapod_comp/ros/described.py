"""Start a program with the URDF that the compensator publishes: ``python -m hexapod_comp.ros.described PROGRAM ...``.

robot_state_publisher needs the URDF as a parameter when it starts, but only the compensator knows the URDF.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Sequence
from tempfile import NamedTemporaryFile

import yaml
from std_msgs.msg import String

from .base import LATCHED_QOS
from .parameters import USAGE_ERROR
from .process import SPIN_PERIOD, RosSession

TOPIC = "robot_description"

WARN_AFTER = 5.0  # Period, s, of a warning in the log while no URDF has arrived


def wait_for_description(arguments: Sequence[str]) -> str:
    """Wait for the URDF on ``robot_description`` and return it; `arguments` may set namespace and remappings."""
    found: list[String] = []
    with RosSession("description_listener", arguments=arguments, start_parameter_services=False) as session:
        node = session.node
        node.create_subscription(String, TOPIC, found.append, LATCHED_QOS)
        missing = f"no URDF yet: waiting for a compensator to publish {node.resolve_topic_name(TOPIC)}"
        node.create_timer(WARN_AFTER, lambda: node.get_logger().warning(missing))
        while not found:
            session.spin_once(SPIN_PERIOD)
    return found[0].data


def main(argv: Sequence[str] | None = None) -> int:
    """Wait for the URDF, then replace this process by the program `argv[0]` with its arguments and the URDF."""
    words = list(sys.argv[1:] if argv is None else argv)
    if not words or not os.access(words[0], os.X_OK):
        found = repr(words[0]) if words else "nothing"
        print(f"error: the first argument must be an executable file, not {found}", file=sys.stderr)
        return USAGE_ERROR
    try:
        text = wait_for_description(words)
    except KeyboardInterrupt:
        return 0
    parameters = {"/**": {"ros__parameters": {TOPIC: text}}}
    with NamedTemporaryFile("w", prefix="description_", suffix=".yaml", delete=False, encoding="utf-8") as file:
        yaml.safe_dump(parameters, file)
    own_topic = ["-r", f"{TOPIC}:=~/{TOPIC}"]  # since only the compensator may publish on TOPIC
    os.execv(words[0], [*words, "--ros-args", *own_topic, "--params-file", file.name])


if __name__ == "__main__":
    sys.exit(main())
