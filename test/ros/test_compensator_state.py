"""The nodes' parameters, quality of service, security policy, views and launch file, against what the nodes open.

The truth is the tables of parameters and rcl's reading of the files, DDS's rule of requests and offers, and the ROS
graph of nodes with all options. The policy has the form of sros2's policy.xsd, version 0.2.0."""

from __future__ import annotations

import contextlib
import json
import re
import runpy
import sys
import xml.etree.ElementTree as ET
from collections.abc import Sequence
from itertools import product
from pathlib import Path
from typing import Any

import pytest
import yaml
from hal_stand_in import StandInHal
from launch_stand_in import LaunchFile
from node_helpers import BEST_EFFORT, CONFIG, HOME, Bench, Rig, model_file
from rcl_interfaces.msg import ParameterType
from rcl_interfaces.srv import DescribeParameters
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy, qos_check_compatible
from std_msgs.msg import UInt64

from hexapod_comp.formats.paths import config_file
from hexapod_comp.linuxcnc.bridge import LinuxcncBridgeNode
from hexapod_comp.machine.geometry import STRUT_NAMES, load_geometry
from hexapod_comp.ros import described
from hexapod_comp.ros.adapter import AdapterNode
from hexapod_comp.ros.client import LoopClient
from hexapod_comp.ros.compensator import CompensatorNode
from hexapod_comp.ros.instrument import InstrumentNode
from hexapod_comp.ros.mover import MoverNode
from hexapod_comp.ros.parameters import ParameterError, Taken
from hexapod_comp.ros.process import QUIET, RosSession
from hexapod_comp.ros.recorder import BagRecorder
from hexapod_comp.ros.strut_drive import StrutDriveNode
from hexapod_comp.viewer.page import Watcher

MAKER = runpy.run_path(str(CONFIG.parent / "tools" / "make_parameter_files.py"))
TABLES = MAKER["TABLES"]
NODES: dict[str, tuple[type, dict[str, object], set[str]]] = {
    "compensator": (
        CompensatorNode,
        {"publish_array": True},
        {"/robot_description", *(f"/compensator/{name}" for name in ("files", "journal", "stopped", "tool"))},
    ),
    "strut_drive": (StrutDriveNode, {}, set()),
    "mover": (MoverNode, {}, {"/mover/state"}),
    "instrument": (InstrumentNode, {"kind": "tracker"}, set()),
    "adapter": (AdapterNode, {}, {"/adapter/state"}),
    "linuxcnc_bridge": (LinuxcncBridgeNode, {}, set()),
}
"""By node: its class, the options with which it opens all its topics, and its latched topics."""

PARAMETRISED = [name for name in NODES if name != "linuxcnc_bridge"]


def made(rig: Bench, name: str, start: bool = True, arguments: Sequence[str] = (), **parameters: object) -> Any:
    """Return a node of a kind; once started, its topics are open."""
    hal = {"hal": StandInHal()} if name == "linuxcnc_bridge" else {}
    return rig.add(NODES[name][0], start, parameters, cli_args=["--ros-args", *arguments], **hal)


COMPENSATOR = "compensator"


def test_what_is_taken_at_configure_is_refused_until_a_cleanup(rig):
    rig.compensator()
    refused = rig.set_parameter(COMPENSATOR, "work_frame", "table")
    assert not refused.successful
    said = "parameter work_frame: is applied at configure, and the node is active; set it after a cleanup"
    assert refused.reason == said
    assert rig.set_parameter(COMPENSATOR, "work_frame", "work").successful, "it is so already"
    assert rig.change("deactivate")
    assert "the node is inactive" in rig.set_parameter(COMPENSATOR, "work_frame", "table").reason
    assert rig.change("cleanup")
    assert rig.set_parameter(COMPENSATOR, "work_frame", "table").successful
    assert rig.change("configure")
    assert rig.change("activate")
    rig.until(rig.matched, "discovery")
    rig.ask(HOME, "table")


@pytest.mark.parametrize(
    ("name", "value", "reason"),
    [
        ("ramp_rate", 2.0, "Min: 1e-06, Max: 1.0, value: 2.0"),
        ("ramp_rate", 2, "must lie in 1e-06 to 1 m/s, not 2"),
        ("ramp_rate", "fast", "must be float, not 'fast'"),
        ("ramp_rate", None, "must be float, not None"),
        ("autostart", False, "read-only"),
        ("work_frame", "base", "work_frame: must differ from base_frame"),
        ("use_sim_time", True, "use_sim_time: stays false while the node runs; set it at the start"),
    ],
)
def test_a_value_that_is_not_allowed_is_refused_and_changes_nothing(rig, name, value, reason):
    """None is the value by which ``ros2 param delete`` asks."""
    node = rig.compensator(start=False)
    before = node.get_parameter(name).value
    result = rig.set_parameter(COMPENSATOR, name, value)
    assert not result.successful
    assert reason in result.reason
    assert node.get_parameter(name).value == before


@pytest.mark.parametrize(
    ("kind", "parameters", "text"),
    [
        (CompensatorNode, {"ramp_rate": 2}, "parameter ramp_rate: must lie in 1e-06 to 1 m/s, not 2"),
        (CompensatorNode, {"ramp_rate": 5.0}, "^parameter ramp_rate: must lie in 1e-06 to 1 m/s, not 5.0$"),
        (CompensatorNode, {"require_feedback": "yes"}, "parameter require_feedback: must be bool, not 'yes'"),
        (CompensatorNode, {"marker_rate": True}, "parameter marker_rate: must be float, not True"),
        (CompensatorNode, {"model_folder": "/nowhere"}, "parameter model_folder: '/nowhere' is not a folder"),
        (CompensatorNode, {"base_frame": "a", "work_frame": "a"}, "work_frame: must differ from base_frame, 'a'"),
        (CompensatorNode, {"command_input": "both"}, "command_input: must be one of poses, struts, not 'both'"),
        (CompensatorNode, {"joint_names": ["a"] * 6}, "joint_names: must be 6 different names"),
        (StrutDriveNode, {"fault_stuck_strut": 9}, "parameter fault_stuck_strut"),
        (InstrumentNode, {"stands_at": [1.0]}, "stands_at: must be 3 numbers, each in -100 to 100 m, not .1.0."),
        (InstrumentNode, {"stands_at": [0.0, 0.0, 101.0]}, "stands_at: must be 3 numbers, each in -100 to 100 m"),
        (LinuxcncBridgeNode, {"units": "cm"}, "parameter units: must be one of mm, inch, not 'cm'"),
    ],
)
def test_what_cannot_be_does_not_start(rig, kind, parameters, text):
    with pytest.raises(ParameterError, match=text):
        rig.add(kind, False, parameters, **({"hal": StandInHal()} if kind is LinuxcncBridgeNode else {}))


def test_rates_and_timeouts_change_at_once(rig):
    rig.compensator(heartbeat_rate=0.0, command_timeout=0.0)
    beats = rig.listen(UInt64, "compensator/heartbeat")
    rig.until(rig.matched, "discovery")
    rig.ask(HOME)
    rig.barrier()
    assert not beats
    assert rig.set_parameter(COMPENSATOR, "heartbeat_rate", 200.0).successful
    rig.until(lambda: len(beats) > 5, "heartbeats")
    assert rig.set_parameter(COMPENSATOR, "command_timeout", 0.01).successful
    rig.until(lambda: "no new command" in rig.message(), "the command to be stale")


def test_another_model_is_taken_by_reload(rig, tmp_path):
    """The model must be in the folder fixed at the start: a parameter must not give access to the whole disk."""
    node = rig.compensator(model_file=model_file(tmp_path))
    other = tmp_path / "other.yaml"
    other.write_text((tmp_path / "model.yaml").read_text().replace("written by a test", "the other"))
    assert rig.set_parameter(COMPENSATOR, "model_file", str(other)).successful
    assert node.compensator.model.name == "written by a test"
    assert rig.trigger("reload_model").success
    assert node.compensator.model.name == "the other"
    secret = model_file(tmp_path.parent, "secret.yaml")
    assert rig.set_parameter(COMPENSATOR, "model_file", secret).successful
    answer = rig.trigger("reload_model")
    assert not answer.success
    assert "see the parameter model_folder" in answer.message
    assert node.compensator.model.name == "the other"


def test_descriptors_say_range_and_when(rig):
    for name in PARAMETRISED:
        made(rig, name, False)
        table = TABLES[name]
        request = DescribeParameters.Request(names=[p.name for p in table])
        told = rig.call(DescribeParameters, f"{name}/describe_parameters", request).descriptors
        for parameter, descriptor in zip(table, told, strict=True):
            assert descriptor.description
            assert descriptor.additional_constraints.endswith(f"applied {parameter.taken.value}")
            assert descriptor.read_only == (parameter.taken is Taken.START)
            ranges = [*descriptor.floating_point_range, *descriptor.integer_range]
            number = descriptor.type in (ParameterType.PARAMETER_DOUBLE, ParameterType.PARAMETER_INTEGER)
            assert len(ranges) == number
            assert all(r.from_value <= parameter.default <= r.to_value for r in ranges)


def test_page_and_file_are_those_of_the_tables():
    """If this fails: ``python tools/make_parameter_files.py``."""
    for path, made in ((MAKER["PAGE"], MAKER["page"](MAKER["PAGE"].read_text())), (MAKER["FILE"], MAKER["file"]())):
        assert path.read_text(encoding="utf-8") == made, path


def in_force(node: Any) -> dict[str, Any]:
    """Return a node's parameters as ROS reports them."""
    return {p.name: node.get_parameter(p.name).value for p in TABLES[node.get_name()]}


@pytest.mark.parametrize("name", PARAMETRISED)
def test_the_shipped_file_gives_the_defaults_in_any_namespace(rig, name):
    rig.namespace = "/left/cell"
    node = made(rig, name, False, ["--params-file", str(MAKER["FILE"])])
    assert in_force(node) == {p.name: p.default for p in TABLES[name]}
    assert not rig.logged("there is no parameter")


def other_value(parameter: Any) -> Any:
    """Return an allowed value that is not the default."""
    if isinstance(parameter.default, list) and isinstance(parameter.default[0], float):
        return [0.1 * parameter.range[1]] * len(parameter.default)
    if parameter.range:
        low, high = (type(parameter.default)(end) for end in parameter.range)
        return high if parameter.default != high else low
    if parameter.choices:
        return parameter.choices[-1]
    if isinstance(parameter.default, list):
        return parameter.default[::-1]
    return not parameter.default if isinstance(parameter.default, bool) else f"{parameter.default}x"


@pytest.mark.parametrize("name", PARAMETRISED)
def test_a_file_of_other_values_is_loaded_also_through_the_launch_file(rig, monkeypatch, tmp_path, name):
    """The launch file passes its own arguments after the file; launch_ros writes them into files, as this test does."""
    others = {p.name: other_value(p) for p in TABLES[name] if p.name != "model_folder"}
    path = tmp_path / "mine.yaml"
    path.write_text(yaml.safe_dump({f"/**/{name}": {"ros__parameters": others}}))
    node = made(rig, name, False, ["--params-file", str(path)])
    assert {key: value for key, value in in_force(node).items() if key in others} == others
    arguments = f"params_file:={path}", "model:=table.yaml", "mover:=true", "instrument:=laser", "adapter:=true"
    given = LaunchFile(monkeypatch).start(*arguments)[name]
    arguments, given = [], given["parameters"]
    for number, part in enumerate(given):
        if isinstance(part, dict):
            (tmp_path / f"{number}.yaml").write_text(yaml.safe_dump({"/**": {"ros__parameters": part}}))
            part = str(tmp_path / f"{number}.yaml")
        arguments += ["--params-file", part]
    values = in_force(made(rig, name, False, arguments))
    assert values == in_force(node) | {k: v for k, v in given[-1].items() if k in others}
    assert values.get("command_timeout", 3600.0) == 3600.0
    assert values.get("model_file", "table.yaml") == "table.yaml"


# ---- quality of service ----


RELIABLE = ReliabilityPolicy.RELIABLE

COMMANDS = {"/strut_setpoints", "/strut_commands", "/strut_corrections", "/strut_commands_array"}
READINGS = {"/strut_states", "/temperatures", "/humidity", "/gravity", "/wrench", "/outside"}
STATES = {"/strut_states", "/tool_pose_estimate", "/nominal_strut_states", "/tool_pose_true"}


@pytest.mark.parametrize("name", NODES)
def test_default_subscribers_hear_all_that_is_published(rig: Rig, name: str) -> None:
    """Commands are reliable with a queue of a hundred messages; of states only the newest is kept."""
    by_struts = {"command_input": "struts"} if name == "compensator" else {}
    node = made(rig, name, **NODES[name][1], **by_struts)
    for end in node.publishers:
        for wanted in (QoSProfile(depth=10), BEST_EFFORT):
            assert "ERROR" not in str(qos_check_compatible(end.qos_profile, wanted)[0]), end.topic_name
        assert end.qos_profile.reliability == RELIABLE, end.topic_name
    for end in (*node.publishers, *node.subscriptions):
        if end.topic_name in COMMANDS | STATES:
            queue = 100 if end.topic_name in COMMANDS else 1
            assert (end.qos_profile.depth, end.qos_profile.history) == (queue, HistoryPolicy.KEEP_LAST), end.topic_name
    for end in node.subscriptions:
        if name == "compensator" and end.topic_name in READINGS:
            assert "ERROR" not in str(qos_check_compatible(BEST_EFFORT, end.qos_profile)[0]), end.topic_name
        elif end.topic_name in COMMANDS:
            assert end.qos_profile.reliability == RELIABLE, end.topic_name
    kept = {end.topic_name for end in node.publishers if end.qos_profile.durability == DurabilityPolicy.TRANSIENT_LOCAL}
    assert kept == NODES[name][2]


def test_what_is_named_can_be_overridden_and_nothing_else(rig: Rig) -> None:
    overrides = {
        "qos_overrides./strut_states.subscription.reliability": "reliable",
        "qos_overrides./strut_commands.publisher.depth": 7,
    }
    node = made(rig, "compensator", **overrides)
    ends = {end.topic_name: end.qos_profile for end in (*node.publishers, *node.subscriptions)}
    assert ends["/strut_states"].reliability == RELIABLE
    assert ends["/strut_commands"].depth == 7
    assert ends["/strut_corrections"].depth == 100


# ---- the security policy ----


POLICY = Path(__file__).resolve().parents[2] / "config" / "security" / "policy.xml"

RIGHTS = ("publish", "subscribe", "reply", "request")

TOOLS = "_ros2cli_*"  # names of the ``ros2`` tools' nodes, as a pattern (POSIX fnmatch) in DDS permissions

MAY_COMMAND = {
    "/tool_pose_command": {"commander", "linuxcnc_bridge", "mover"},
    "/select_tool": {"commander"},
    "/strut_commands": {"compensator"},
}
"""Enclaves that may move the machine."""


def read_policy(namespace: str = "") -> dict[str, tuple[str, dict[str, set[str]]]]:
    """Return, by the last part of its path, each enclave of the shipped policy: its node in a namespace, and the
    absolute names that it may use, by right."""
    builder = ET.TreeBuilder(insert_comments=True)
    root = ET.parse(POLICY, ET.XMLParser(target=builder)).getroot()
    found = {}
    for enclave in root.find("enclaves"):
        profiles = enclave.findall("profiles/profile")
        allowed: dict[str, set[str]] = {right: set() for right in RIGHTS}
        for profile in profiles:
            node = profile.get("node")
            place = "" if node == TOOLS else namespace
            for group in profile:
                rights = [right for right in group.attrib if group.get(right) == "ALLOW"]
                for name, right in product(group, rights):
                    whole = name.text if name.text.startswith("/") else f"{place}/{name.text.replace('~', node, 1)}"
                    allowed[right].add(whole)
        found[enclave.get("path").rpartition("/")[2]] = profiles[0].get("node"), allowed
    return found


def opened(witness: Node, node: str, namespace: str) -> dict[str, set[str]]:
    """Return the topics and services that a node has opened, by the ROS graph."""
    asked = {
        "publish": witness.get_publisher_names_and_types_by_node,
        "subscribe": witness.get_subscriber_names_and_types_by_node,
        "reply": witness.get_service_names_and_types_by_node,
        "request": witness.get_client_names_and_types_by_node,
    }
    return {right: {name for name, _ in ask(node, namespace or "/")} for right, ask in asked.items()}


def test_nobody_else_may_move_the_machine() -> None:
    for topic, allowed in MAY_COMMAND.items():
        may = {name for name, (_, rights) in read_policy().items() if topic in rights["publish"]}
        assert may == allowed, topic


@pytest.mark.parametrize("name", NODES)
def test_lifecycle_nodes_open_what_the_policy_allows(name: str, bench: Bench) -> None:
    bench.namespace = "/guarded"  # a separate namespace: the graph may still have nodes of other tests
    node = made(bench, name, **NODES[name][1])
    enclave, allowed = read_policy(bench.namespace)[name]
    assert enclave == name
    allowed["publish"] -= {"/guarded/instrument/readings"}  # published by a laser; a tracker publishes a pose
    with contextlib.suppress(TimeoutError):  # the comparison names what is missing
        bench.until(lambda: opened(node, name, bench.namespace) == allowed, "the graph to be complete", 1.0)
    assert opened(node, name, bench.namespace) == allowed


def test_the_client_opens_what_the_policy_allows() -> None:
    client = LoopClient()
    try:
        name, allowed = read_policy()["commander"]
        assert client.node.get_name() == name
        found = opened(client.node, name, "")
        found["publish"] |= {"/select_tool"}  # controllers that change tools need this
        assert found == allowed
    finally:
        client.close()


def test_who_only_listens_may_and_opens_nothing_more(tmp_path: Path) -> None:
    """``record`` and ``watch`` open only what the policy allows; the node of ``echo`` may read every topic."""
    policy = read_policy()
    opens: dict[str, set[str]] = {right: set() for right in RIGHTS}

    def look(node: Node) -> None:
        for right, names in opened(node, node.get_name(), "").items():
            opens[right] |= names

    with BagRecorder(tmp_path / "bag") as recorder:
        look(recorder.node)
        subscriptions = {one.topic_name: one.qos_profile for one in recorder.node.subscriptions}
    with RosSession("hexapod_comp_watch", **QUIET) as session:
        Watcher(load_geometry(config_file("paper.yaml")), session.node)
        look(session.node)
    with RosSession("hexapod_comp_echo", **QUIET) as session:
        look(session.node)
    lossless = {"tool_pose_command", "strut_setpoints", "strut_commands", "strut_corrections", "diagnostics"}
    kept = {"/compensator/journal", "/compensator/files"}
    latched = DurabilityPolicy.TRANSIENT_LOCAL
    assert {n for n, qos in subscriptions.items() if qos.reliability == RELIABLE} == {f"/{n}" for n in lossless} | kept
    assert {n for n, qos in subscriptions.items() if qos.durability == latched} == kept
    _, witness = policy["witness"]
    assert opens["subscribe"] <= witness["subscribe"]
    assert opens | {"subscribe": witness["subscribe"]} == witness
    said = {n for n in policy["compensator"][1]["publish"] if not n.endswith(("_event", "_events", "rosout"))}
    others = {"/tool_pose_true", "/tool_pose_command", "/select_tool", *READINGS}
    by_input = {"/strut_setpoints", "/nominal_strut_states"}  # with command_input: struts
    assert witness["subscribe"] == said | others | by_input


def test_the_launch_file_names_the_enclaves_of_the_policy(monkeypatch: pytest.MonkeyPatch) -> None:
    launch_file = LaunchFile(monkeypatch)
    root = ET.parse(POLICY).getroot()
    paths = {enclave.get("path") for enclave in root.iter("enclave")}
    for folder, known in ((launch_file.defaults["enclaves"], True), ("/mine", False)):
        arguments = [node["ros_arguments"] for node in launch_file.start(f"enclaves:={folder}").values()]
        asked = [words[words.index("--enclave") + 1] for words in arguments]
        assert asked == [f"{folder}/compensator", f"{folder}/strut_drive"]
        assert paths.issuperset(asked) is known


# ---- views and launch ----

VIEWS = CONFIG / "views"

DESCRIPTION = "robot_description"  # topic of the compensator; RViz's display of it states no type

SHOWS = {"MarkerArray": "MarkerArray", "Pose": "PoseStamped", "RobotModel": "String"}
"""Type of topic of each RViz display."""

FRAMES = {"base", "work", "platform", "tool"}


def rviz() -> dict[str, Any]:
    return yaml.safe_load((VIEWS / "machine.rviz").read_text(encoding="utf-8"))["Visualization Manager"]


def topics_of(rig: Bench) -> dict[str, Any]:
    """Return the publishers and subscriptions of the nodes by topic, publishers first."""
    return {end.topic_name: end for node in rig.nodes for end in (*node.subscriptions, *node.publishers)}


def test_views_name_what_the_nodes_publish(rig: Bench) -> None:
    """Topics, types, fields and reliability match; a subscription that wants more than the offer gets nothing."""
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
    curves = [curve.get("name") for curve in ET.parse(VIEWS / "plotjuggler.xml").iter("curve")]
    assert (len(paths), len(curves)) == (12, 30)
    for shown in (*paths, *curves):
        topic, *parts = re.split(r"[/.\[\]]+", shown.strip("/]"))
        fields = {*ends[f"/{topic}"].msg_type.get_fields_and_field_types(), *STRUT_NAMES}  # names by joint
        assert parts[0] in fields, shown


def test_the_aggregator_waits_for_what_the_nodes_say(rig: Bench) -> None:
    """A node's status has one name from the first to the last, also before the node knows its machine."""
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
    """Install the programs that show a machine."""
    for package in ("robot_state_publisher", "rviz2"):
        install(package, tmp_path)
    monkeypatch.setenv("AMENT_PREFIX_PATH", str(tmp_path))


def parameters(node: dict[str, Any]) -> dict[str, Any]:
    return node["parameters"][-1]


@pytest.mark.usefixtures("shown")
def test_arguments_reach_the_nodes(launch_file: LaunchFile) -> None:
    words = ["geometry:=example_6_6.yaml", "model:=m.yaml", "truth:=t.yaml", "autostart:=false", "use_sim_time:=true"]
    nodes = launch_file.start(*words, "frame_prefix:=left/", "namespace:=left", "rviz:=true", "mover:=true")
    both = {"autostart": False, "use_sim_time": True, "base_frame": "left/base", "geometry_file": "example_6_6.yaml"}
    own = {"model_file": "m.yaml", "work_frame": "left/work", "frame_prefix": "left/"}
    assert parameters(nodes["compensator"]) == {**both, **own}
    assert parameters(nodes["strut_drive"]) == {**both, "truth_file": "t.yaml"}
    assert parameters(nodes["mover"]).items() >= {"work_frame": "left/work", "tool_frame": "left/tool"}.items()
    assert {node["namespace"] for node in nodes.values()} == {"left"}
    assert parameters(nodes["robot_state_publisher"]) == {"frame_prefix": "left/", "use_sim_time": True}
    assert all(parameters(nodes[name])["use_sim_time"] for name in ("robot_state_publisher", "rviz2"))


def test_without_robot_state_publisher_nothing_starts(
    launch_file: LaunchFile, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """launch searches each program only at its turn; the compensator would then be running already."""
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
    """The geometry is in a parameter file only; the truth is its machine name, and the joint names in the files.

    The program that the launch file puts before robot_state_publisher runs until it would replace itself by it.
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
    described.main([sys.executable, "--ros-args", "-r", "__node:=robot_state_publisher"])
    program, *words, file = started[0]
    assert (program, words[:2]) == (sys.executable, [sys.executable, "--ros-args"])
    remapped = ["-r", f"{DESCRIPTION}:=~/{DESCRIPTION}"]  # otherwise two nodes would publish it
    assert words[-4:] == ["--ros-args", *remapped, "--params-file"]
    given = yaml.safe_load(Path(file).read_text(encoding="utf-8"))["/**"]["ros__parameters"]
    Path(file).unlink()
    robot = ET.fromstring(given[DESCRIPTION])
    assert robot.get("name") == "example_6_6"
    assert {joint.get("name") for joint in robot.iter("joint")} >= set(names)
    assert robot.find("ros2_control") is None  # nothing subscribes to strut_setpoints


@pytest.mark.parametrize("words", [[], ["nowhere/robot_state_publisher"]])
def test_a_program_that_cannot_be_started_is_refused_at_once(words: list[str], capsys) -> None:
    assert described.main(words) == 2
    assert "must be an executable file" in capsys.readouterr().err


def test_the_description_can_be_left_to_another_node(rig: Bench) -> None:
    """ros2_control's joint_state_broadcaster, for example, publishes ``joint_states``."""
    rig.compensator(publish_description=False, command_input="struts")
    assert not {"/joint_states", f"/{DESCRIPTION}"} & set(topics_of(rig))


@pytest.mark.usefixtures("shown")
def test_rviz_shows_the_machine_with_its_prefix(launch_file: LaunchFile) -> None:
    """RViz's RobotModel joins prefix and link by a slash; topics are relative, and so in RViz's namespace."""
    with pytest.raises(ValueError, match="frame_prefix:=left must end with a slash if RViz is started"):
        launch_file.start("rviz:=true", "frame_prefix:=left")
    assert parameters(launch_file.start("frame_prefix:=left_")["compensator"])["base_frame"] == "left_base"
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
    """They are refused in a command line of this file; a file that includes it may have other arguments."""
    with pytest.raises(ValueError, match=r"unknown argument modle; known arguments: .*\bmodel\b"):
        launch_file.start("modle:=paper_machine.yaml")
    assert launch_file.start("modle:=paper_machine.yaml", by="/else/cell.launch.py")
