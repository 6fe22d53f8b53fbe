"""Start the compensator and the simulated machine: ``ros2 launch hexapod_comp machine.launch.py``.

``--show-args`` lists the arguments. For a real machine add ``simulate:=false geometry:=/path/mine.yaml``.
"""

import os
import shlex
import sys
from collections.abc import Callable
from pathlib import Path
from tempfile import NamedTemporaryFile
from typing import Any

import yaml
from ament_index_python.packages import PackageNotFoundError, get_package_prefix
from launch import LaunchContext, LaunchDescription
from launch.actions import DeclareLaunchArgument, OpaqueFunction
from launch.substitutions import EnvironmentVariable, LaunchConfiguration
from launch_ros.actions import Node

from hexapod_comp.formats.paths import config_file
from hexapod_comp.virtual.instruments import LIVE

FLAG = ["true", "false"]
# Parameters of the compensator that mover and adapter also have
MOVER_PARAMETERS = ("autostart", "use_sim_time", "base_frame", "work_frame", "frame_prefix")
ADAPTER_PARAMETERS = ("autostart", "use_sim_time", "geometry_file")
RANGES = ["LOCALHOST", "SUBNET", "OFF", "SYSTEM_DEFAULT"]
DESCRIBED = f"{shlex.quote(sys.executable)} -m hexapod_comp.ros.described"
"""Command that starts robot_state_publisher with the URDF that the compensator publishes."""

LOCAL_UNLESS_SET = EnvironmentVariable("ROS_AUTOMATIC_DISCOVERY_RANGE", default_value="LOCALHOST")


def generate_launch_description() -> LaunchDescription:
    """Return the launch description: its arguments, then the nodes."""
    argument = DeclareLaunchArgument
    arguments = [
        argument("namespace", default_value="", description="Namespace of this machine's nodes and topics."),
        argument("geometry", default_value="", description="Geometry file; empty: the default of the nodes."),
        argument("model", default_value="", description="Model file; empty: the model ideal, which corrects nothing."),
        argument(
            "model_folder", default_value="", description="Folder of allowed models; empty: the model file's folder."
        ),
        argument(
            "truth", default_value="", description="Errors of the simulated machine (truth_file); empty: the default."
        ),
        argument("params_file", default_value="", description="Parameters of all nodes (YAML)."),
        argument(
            "autostart",
            default_value="",
            choices=["", *FLAG],
            description="Activate the nodes at their start; empty: the nodes' default.",
        ),
        argument("simulate", default_value="true", choices=FLAG, description="Start strut_drive, a simulated machine."),
        argument("mover", default_value="false", choices=FLAG, description="Start mover too, which moves the tool."),
        argument("adapter", default_value="false", choices=FLAG, description="Start adapter too, which calibrates."),
        argument(
            "instrument",
            default_value="",
            choices=["", *LIVE],
            description="Virtual instrument to start; empty: none.",
        ),
        argument("description", default_value="false", choices=FLAG, description="Start robot_state_publisher."),
        argument("rviz", default_value="false", choices=FLAG, description="Start RViz and robot_state_publisher."),
        argument(
            "frame_prefix", default_value="", description="Text before the names of all frames: left/ gives left/base."
        ),
        argument("use_sim_time", default_value="false", choices=FLAG, description="Use the time on /clock."),
        argument("log_level", default_value="info", description="debug, info, warn or error."),
        argument("enclaves", default_value="/hexapod_comp", description="Folder of the nodes' SROS 2 enclaves."),
        argument(
            "discovery_range",
            default_value=LOCAL_UNLESS_SET,
            choices=RANGES,
            description="Discovery range of the nodes (ROS_AUTOMATIC_DISCOVERY_RANGE); LOCALHOST if it is not set.",
        ),
    ]
    known = {declared.name for declared in arguments}
    return LaunchDescription(
        [OpaqueFunction(function=_refuse_unknown, args=[known]), *arguments, OpaqueFunction(function=_nodes)]
    )


def _refuse_unknown(context: LaunchContext, known: set[str]) -> None:
    """Raise a ValueError if the command line that starts this launch file has an unknown (misspelt) argument."""
    if not any(Path(word).name == Path(__file__).name for word in sys.argv):
        return  # another launch file includes this one, so the arguments of the command line are that file's
    unknown = sorted({word.partition(":=")[0] for word in context.argv if ":=" in word} - known)
    if unknown:
        raise ValueError(f"unknown argument {', '.join(unknown)}; known arguments: {', '.join(sorted(known))}")


def _nodes(context: LaunchContext) -> list[Node]:
    """Return the actions that start the nodes; an empty launch argument keeps the default of the node."""

    def given(name: str) -> str:
        return LaunchConfiguration(name).perform(context)

    files = [str(config_file(given("params_file")))] if given("params_file") else []
    clock = {"use_sim_time": True} if given("use_sim_time") == "true" else {}
    common: dict[str, Any] = {"autostart": given("autostart") == "true"} if given("autostart") else {}
    common |= clock
    prefix, rviz = given("frame_prefix"), given("rviz") == "true"
    if rviz and prefix and not prefix.endswith("/"):
        wanted = "must end with a slash if RViz is started, since its RobotModel puts a slash behind the prefix"
        raise ValueError(f"frame_prefix:={prefix} {wanted}: frame_prefix:={prefix}/")
    common |= {"base_frame": f"{prefix}base"} if prefix else {}
    common |= {"geometry_file": given("geometry")} if given("geometry") else {}
    model = {"model_file": given("model")} if given("model") else {}
    model |= {"model_folder": given("model_folder")} if given("model_folder") else {}
    model |= {"work_frame": f"{prefix}work", "frame_prefix": prefix} if prefix else {}
    truth = {"truth_file": given("truth")} if given("truth") else {}
    nodes = [_node("compensator", given, [*files, common | model])]
    if given("simulate") == "true":
        nodes.append(_node("strut_drive", given, [*files, common | truth]))
    if given("mover") == "true":
        frames = {key: value for key, value in (common | model).items() if key in MOVER_PARAMETERS}
        frames |= {"tool_frame": f"{prefix}tool"} if prefix else {}
        nodes.append(_node("mover", given, [*files, frames]))
    if given("adapter") == "true":
        nodes.append(_node("adapter", given, [*files, {k: v for k, v in common.items() if k in ADAPTER_PARAMETERS}]))
    if given("instrument"):
        nodes.append(_node("instrument", given, [*files, common | {"kind": given("instrument")}]))
    if rviz or given("description") == "true":
        nodes.append(_helper("robot_state_publisher", given, [{"frame_prefix": prefix, **clock}], prefix=DESCRIBED))
    if rviz:
        nodes.append(_helper("rviz2", given, [clock], arguments=["-d", _view(prefix)]))
    return nodes


def _node(executable: str, given: Callable[[str], str], parameters: list) -> Node:
    """Return the action that starts one node; the discovery range is set only in this node's environment."""
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


def _helper(package: str, given: Callable[[str], str], parameters: list, **others: Any) -> Node:
    """Return the action that starts another package's node; raise a RuntimeError if this package is not installed."""
    try:
        program = Path(get_package_prefix(package), "lib", package, package)
    except PackageNotFoundError:
        program = None
    if program is None or not os.access(program, os.X_OK):
        name = f"ros-{os.environ.get('ROS_DISTRO', 'jazzy')}-{package.replace('_', '-')}"
        raise RuntimeError(f"{package} is not installed, so nothing was started: sudo apt install {name}")
    return Node(
        package=package,
        executable=package,
        namespace=given("namespace"),
        parameters=parameters,
        additional_env={"ROS_AUTOMATIC_DISCOVERY_RANGE": given("discovery_range")},
        output="screen",
        **others,
    )


def _view(prefix: str) -> str:
    """Return the path of RViz's shipped configuration, or with a prefix of a temporary copy with prefixed frames."""
    shipped = config_file("views/machine.rviz")
    if not prefix:
        return str(shipped)
    view = yaml.safe_load(shipped.read_text(encoding="utf-8"))
    view["Visualization Manager"]["Global Options"]["Fixed Frame"] = f"{prefix}base"
    for display in view["Visualization Manager"]["Displays"]:
        if "TF Prefix" in display:
            display["TF Prefix"] = prefix.removesuffix("/")  # RViz adds the slash itself
        if "Frames" in display:
            display["Frames"] = {name if " " in name else prefix + name: on for name, on in display["Frames"].items()}
    with NamedTemporaryFile("w", suffix=".rviz", delete=False, encoding="utf-8") as copy:
        yaml.safe_dump(view, copy, sort_keys=False)
    return copy.name
