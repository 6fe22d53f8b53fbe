"""Start the compensator and the simulated machine: ``ros2 launch hexapod_comp machine.launch.py``.

``--show-args`` lists the arguments. With a real machine: ``simulate:=false geometry:=/path/mine.yaml``.
"""

from collections.abc import Callable
from typing import Any

from launch import LaunchContext, LaunchDescription
from launch.actions import DeclareLaunchArgument, OpaqueFunction
from launch.substitutions import EnvironmentVariable, LaunchConfiguration
from launch_ros.actions import Node

from hexapod_comp.export.robot_description import urdf
from hexapod_comp.formats.paths import config_file
from hexapod_comp.machine.geometry import load_geometry

FLAG = ["true", "false"]
RANGES = ["LOCALHOST", "SUBNET", "OFF", "SYSTEM_DEFAULT"]
LOCAL_UNLESS_SET = EnvironmentVariable("ROS_AUTOMATIC_DISCOVERY_RANGE", default_value="LOCALHOST")


def generate_launch_description() -> LaunchDescription:
    """Return the launch description: its arguments, then the nodes."""
    argument = DeclareLaunchArgument
    return LaunchDescription(
        [
            argument("namespace", default_value="", description="Holds this machine's nodes and topics."),
            argument("geometry", default_value="", description="Geometry file; empty: as in the node."),
            argument("model", default_value="", description="Model file; empty: ideal, corrects nothing."),
            argument("truth", default_value="", description="What strut_drive hides; empty: as in the node."),
            argument("params_file", default_value="", description="Parameters of both nodes (YAML)."),
            argument("autostart", default_value="true", choices=FLAG, description="Activate unasked."),
            argument("simulate", default_value="true", choices=FLAG, description="Start strut_drive too."),
            argument("description", default_value="false", choices=FLAG, description="Start robot_state_publisher."),
            argument("frame_prefix", default_value="", description="In front of all frames, as left_ of left_base."),
            argument("use_sim_time", default_value="false", choices=FLAG, description="Take time from /clock."),
            argument("log_level", default_value="info", description="debug, info, warn or error."),
            argument("enclaves", default_value="/hexapod_comp", description="Folder of the nodes' SROS 2 enclaves."),
            argument(
                "discovery_range",
                default_value=LOCAL_UNLESS_SET,
                choices=RANGES,
                description="Who may find the nodes: what the environment says, else LOCALHOST.",
            ),
            OpaqueFunction(function=_nodes),
        ]
    )


def _nodes(context: LaunchContext) -> list[Node]:
    """Return the nodes for the arguments given; what is left empty stays at the node's own default."""

    def given(name: str) -> str:
        return LaunchConfiguration(name).perform(context)

    files = [str(config_file(given("params_file")))] if given("params_file") else []
    clock = {"use_sim_time": True} if given("use_sim_time") == "true" else {}
    common: dict[str, Any] = {"autostart": given("autostart") == "true", **clock}
    if prefix := given("frame_prefix"):
        common |= {"base_frame": f"{prefix}base"}
    common |= {"geometry_file": given("geometry")} if given("geometry") else {}
    model = {"model_file": given("model")} if given("model") else {}
    model |= {"work_frame": f"{prefix}work"} if prefix else {}
    truth = {"truth_file": given("truth")} if given("truth") else {}
    nodes = [_node("compensator", given, [*files, common | model])]
    if given("simulate") == "true":
        nodes.append(_node("strut_drive", given, [*files, common | truth]))
    if given("description") == "true":
        nodes.append(_publisher(given, {"frame_prefix": prefix, **clock}))
    return nodes


def _node(executable: str, given: Callable[[str], str], parameters: list) -> Node:
    """Return the action that starts one node; its environment alone carries the discovery range."""
    return Node(
        package="hexapod_comp",
        executable=executable,
        name=executable,
        namespace=given("namespace"),
        parameters=parameters,
        additional_env={"ROS_AUTOMATIC_DISCOVERY_RANGE": given("discovery_range")},
        ros_arguments=["--log-level", given("log_level"), "--enclave", f"{given('enclaves')}/{executable}"],
        output="screen",
    )


def _publisher(given: Callable[[str], str], parameters: dict[str, Any]) -> Node:
    """Return the action that starts robot_state_publisher, a package of its own, with the machine's URDF."""
    geometry = load_geometry(config_file(given("geometry") or "paper.yaml", "geometry"))
    return Node(
        package="robot_state_publisher",
        executable="robot_state_publisher",
        namespace=given("namespace"),
        parameters=[{"robot_description": urdf(geometry), **parameters}],
        additional_env={"ROS_AUTOMATIC_DISCOVERY_RANGE": given("discovery_range")},
        output="screen",
    )
