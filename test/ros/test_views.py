"""What RViz, Foxglove, PlotJuggler, diagnostic_aggregator and launch are given names what the nodes really publish.

The truth is the ROS graph of running nodes. The files' forms are those that the programs write; no test runs them.
"""

from __future__ import annotations

import json
import re
import xml.etree.ElementTree as ET
from pathlib import Path
from typing import Any

import pytest
import yaml
from launch_stand_in import LaunchFile
from node_helpers import CONFIG, Bench
from rclpy.qos import ReliabilityPolicy

from hexapod_comp.machine.geometry import load_geometry
from hexapod_comp.machine.robot_description import urdf
from hexapod_comp.ros import described
from hexapod_comp.ros.compensator import CompensatorNode

VIEWS = CONFIG / "views"

DESCRIPTION = "robot_description"
"""Of the compensator; RViz's display of it names no type."""

SHOWS = {"MarkerArray": "MarkerArray", "Pose": "PoseStamped", "RobotModel": "String"}
"""What RViz's displays take."""

FRAMES = {"base", "work", "platform", "tool"}


def rviz() -> dict[str, Any]:
    """Return what RViz shows, by display."""
    return yaml.safe_load((VIEWS / "machine.rviz").read_text(encoding="utf-8"))["Visualization Manager"]


def topics_of(rig: Bench) -> dict[str, Any]:
    """Return the publishers and subscriptions of the nodes by topic, publishers first."""
    return {end.topic_name: end for node in rig.nodes for end in (*node.subscriptions, *node.publishers)}


def test_views_name_what_the_nodes_publish(rig: Bench) -> None:
    """Topics, types, fields and reliability; a listener that wants more than is offered hears nothing."""
    rig.machine(model="paper_machine.yaml")
    ends = topics_of(rig)
    for display in rviz()["Displays"]:
        topic = next((value for key, value in display.items() if key.endswith("Topic")), None)
        if topic is None or topic["Value"] == DESCRIPTION:
            continue
        end = ends["/" + topic["Value"]]
        assert end.msg_type.__name__ == SHOWS[display["Class"].rpartition("/")[2]]
        offered = end.qos_profile.reliability if end in [p for node in rig.nodes for p in node.publishers] else None
        assert topic["Reliability Policy"] == "Best Effort" or offered in (None, ReliabilityPolicy.RELIABLE)
    layout = json.loads((VIEWS / "foxglove.json").read_text(encoding="utf-8"))
    scene = layout["configById"]["3D!machine"]
    drawn = {layer["topic"] for layer in scene["layers"].values() if "topic" in layer}
    assert drawn == {f"/{DESCRIPTION}"}
    named = {*scene["topics"], *(panel.get("topicToRender") for panel in layout["configById"].values())} - {None}
    assert named <= {*ends, "/rosout"}
    paths = [path["value"] for panel in layout["configById"].values() for path in panel.get("paths", [])]
    assert len(paths) == 12
    for path in paths:
        topic, field, number = re.fullmatch(r"(/\w+)\.(\w+)\[(\d)\]", path).groups()
        assert field in ends[topic].msg_type.get_fields_and_field_types()
        assert int(number) < 6
    curves = [curve.get("name") for curve in ET.parse(VIEWS / "plotjuggler.xml").iter("curve")]
    assert len(curves) == len(set(curves)) == 30
    for curve in curves:
        topic, *parts = curve.split("/")[1:]
        kind = ends[f"/{topic}"].msg_type.__name__
        if kind == "JointState":  # PlotJuggler puts the joint's name before its value
            assert parts[0] in {f"strut_{n}" for n in range(1, 7)}
            assert parts[1] in ("position", "velocity")
        else:
            assert (kind, parts[:2]) == ("PoseStamped", ["pose", "position"])


def test_views_name_frames_of_the_description() -> None:
    """And RViz looks from the frame that the markers are in, by the node's own default."""
    links = {link.get("name") for link in ET.fromstring(urdf(load_geometry("paper"))).iter("link")}
    assert links >= FRAMES
    shown = next(display["Frames"] for display in rviz()["Displays"] if "Frames" in display)
    assert set(shown) - {"All Enabled"} == FRAMES
    assert rviz()["Global Options"]["Fixed Frame"] == "base"
    scene = json.loads((VIEWS / "foxglove.json").read_text(encoding="utf-8"))["configById"]["3D!machine"]
    assert {name.removeprefix("frame:") for name in scene["transforms"]} == FRAMES
    assert scene["followTf"] == scene["layers"]["grid"]["frameId"] == "base"


def test_the_aggregator_waits_for_what_the_nodes_say(rig: Bench) -> None:
    """From the first status, before the node knows its machine, to the last: one name."""
    rig.machine()
    rig.until(lambda: rig.status() and rig.status("strut_drive"), "statuses")
    said = {status.name for array in rig.seen["/diagnostics"] for status in array.status}
    groups = yaml.safe_load((VIEWS / "diagnostics.yaml").read_text(encoding="utf-8"))["analyzers"]["ros__parameters"]
    waited = {
        name
        for group in groups.values()
        if isinstance(group, dict)
        for name in (*group.get("expected", []), *group.get("startswith", []))
    }
    assert said == {"compensator: state", "strut_drive: state"}
    assert waited == {*said, "linuxcnc_bridge: state"}


# ---- the launch file ----


@pytest.fixture
def launch_file(monkeypatch: pytest.MonkeyPatch) -> LaunchFile:
    return LaunchFile(monkeypatch)


def install(package: str, prefix: Path) -> None:
    """Install a node of another package below `prefix`, as ament does: an entry in the index, and a program."""
    index = prefix / "share" / "ament_index" / "resource_index" / "packages"
    program = prefix / "lib" / package / package
    for path in (index / package, program):
        path.parent.mkdir(parents=True, exist_ok=True)
        path.touch()
    program.chmod(0o755)


@pytest.fixture
def shown(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Install what shows a machine."""
    for package in ("robot_state_publisher", "rviz2"):
        install(package, tmp_path)
    monkeypatch.setenv("AMENT_PREFIX_PATH", str(tmp_path))


def parameters(node: dict[str, Any]) -> dict[str, Any]:
    return node["parameters"][-1]


def test_what_is_not_given_stays_at_the_nodes_own_default(launch_file: LaunchFile) -> None:
    """So that a parameter file counts: what launch gives comes after it."""
    nodes = launch_file.start(f"params_file:={CONFIG / 'fastdds.xml'}")
    assert set(nodes) == {"compensator", "strut_drive"}
    for node in nodes.values():
        assert node["parameters"] == [str(CONFIG / "fastdds.xml"), {}]


@pytest.mark.usefixtures("shown")
def test_arguments_reach_the_nodes(launch_file: LaunchFile) -> None:
    words = ["geometry:=example_6_6.yaml", "model:=m.yaml", "truth:=t.yaml", "autostart:=false", "use_sim_time:=true"]
    nodes = launch_file.start(*words, "frame_prefix:=left/", "namespace:=left", "rviz:=true")
    both = {"autostart": False, "use_sim_time": True, "base_frame": "left/base", "geometry_file": "example_6_6.yaml"}
    own = {"model_file": "m.yaml", "work_frame": "left/work", "frame_prefix": "left/"}
    assert parameters(nodes["compensator"]) == {**both, **own}
    assert parameters(nodes["strut_drive"]) == {**both, "truth_file": "t.yaml"}
    assert {node["namespace"] for node in nodes.values()} == {"left"}
    assert parameters(nodes["robot_state_publisher"]) == {"frame_prefix": "left/", "use_sim_time": True}
    assert all(parameters(nodes[name])["use_sim_time"] for name in ("robot_state_publisher", "rviz2"))


def test_without_robot_state_publisher_nothing_starts(
    launch_file: LaunchFile, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """launch looks for each program when it is its turn: the compensator would run already, and stay."""
    monkeypatch.setenv("AMENT_PREFIX_PATH", str(tmp_path))
    with pytest.raises(RuntimeError, match=r"nothing was started: sudo apt install ros-[a-z]+-robot-state-publisher"):
        launch_file.start("description:=true")
    install("robot_state_publisher", tmp_path)
    assert "robot_state_publisher" in launch_file.start("description:=true")
    (tmp_path / "lib" / "robot_state_publisher" / "robot_state_publisher").unlink()
    with pytest.raises(RuntimeError, match="robot_state_publisher is not installed"):
        launch_file.start("description:=true")


def test_the_description_is_of_the_machine_that_runs(
    bench: Bench, launch_file: LaunchFile, shown: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The geometry stands in a parameter file alone. Truth: the name and the joints' names that the files hold.

    The program that the launch file puts in front of robot_state_publisher is run up to where it would become that.
    """
    names = [f"leg_{n}" for n in range(1, 7)]
    values = {"geometry_file": "example_6_6.yaml", "joint_names": names}
    mine = tmp_path / "mine.yaml"
    mine.write_text(yaml.safe_dump({"/**/compensator": {"ros__parameters": values}}))
    node = launch_file.start(f"params_file:={mine}", "description:=true")["robot_state_publisher"]
    assert node["prefix"].endswith(f" -m {described.__name__}")
    bench.add(CompensatorNode, True, {}, cli_args=["--ros-args", "--params-file", str(mine)])
    started: list[list[str]] = []
    monkeypatch.setattr(described.os, "execv", lambda program, words: started.append([program, *words]))
    with pytest.raises(AssertionError, match="execv"):
        described.main(["/lib/rsp", "--ros-args", "-r", "__node:=robot_state_publisher"])
    program, *words, file = started[0]
    assert (program, words[:2]) == ("/lib/rsp", ["/lib/rsp", "--ros-args"])
    remapped = ["-r", f"{DESCRIPTION}:=~/{DESCRIPTION}"]  # else two nodes would publish it
    assert words[-4:] == ["--ros-args", *remapped, "--params-file"]
    given = yaml.safe_load(Path(file).read_text(encoding="utf-8"))["/**"]["ros__parameters"]
    Path(file).unlink()
    robot = ET.fromstring(given[DESCRIPTION])
    assert robot.get("name") == "example_6_6"
    assert {joint.get("name") for joint in robot.iter("joint")} >= set(names)
    assert robot.find("ros2_control") is None  # nobody listens to strut_setpoints


def test_the_description_can_be_left_to_another_node(rig: Bench) -> None:
    """As where ros2_control's joint_state_broadcaster publishes ``joint_states``."""
    rig.compensator(publish_description=False, command_input="struts")
    assert not {"/joint_states", f"/{DESCRIPTION}"} & set(topics_of(rig))


@pytest.mark.usefixtures("shown")
def test_rviz_shows_the_machine_with_its_prefix(launch_file: LaunchFile) -> None:
    """RViz's RobotModel puts a slash between prefix and link; topics are relative, and so in RViz's namespace."""
    plain = launch_file.start("rviz:=true")["rviz2"]["arguments"]
    assert plain == ["-d", str(VIEWS / "machine.rviz")]
    copy = Path(launch_file.start("rviz:=true", "frame_prefix:=left/")["rviz2"]["arguments"][1])
    view = yaml.safe_load(copy.read_text(encoding="utf-8"))["Visualization Manager"]
    copy.unlink()
    assert view["Global Options"]["Fixed Frame"] == "left/base"
    displays = {display["Name"]: display for display in view["Displays"]}
    assert displays["RobotModel"]["TF Prefix"] == "left"
    assert set(displays["TF"]["Frames"]) == {"All Enabled", *(f"left/{frame}" for frame in FRAMES)}
    for display in displays.values():
        topic = next((value["Value"] for key, value in display.items() if key.endswith("Topic")), "relative")
        assert not topic.startswith("/")


def test_misspelt_arguments_are_refused(launch_file: LaunchFile) -> None:
    """Of a command line that starts this file; one that another file includes is not given all that it was."""
    with pytest.raises(ValueError, match=r"no argument modle; there are .*\bmodel\b"):
        launch_file.start("modle:=paper_machine.yaml")
    assert launch_file.start("modle:=paper_machine.yaml", by="/else/cell.launch.py")


# ---- two machines ----
