"""config/security/policy.xml against what the running nodes really open.

The truth is the ROS graph of nodes that run with everything switched on. The form is that of sros2's
policy.xsd, version 0.2.0; sros2 takes a comment among the enclaves for one and ends in a traceback.
"""

from __future__ import annotations

import contextlib
import xml.etree.ElementTree as ET
from collections.abc import Iterator
from dataclasses import dataclass, field
from itertools import product
from pathlib import Path

import pytest
import rclpy
from hal_stand_in import StandInHal
from launch_stand_in import LaunchFile
from lifecycle_msgs.srv import ChangeState, GetAvailableTransitions, GetState
from node_helpers import Bench, Rig
from rclpy.context import Context
from rclpy.node import Node
from rclpy.parameter_client import AsyncParameterClient
from std_srvs.srv import SetBool, Trigger

from hexapod_comp.formats.paths import config_file
from hexapod_comp.linuxcnc.bridge import LinuxcncBridgeNode
from hexapod_comp.machine.geometry import load_geometry
from hexapod_comp.ros.adapter import AdapterNode
from hexapod_comp.ros.client import LoopClient
from hexapod_comp.ros.instrument import InstrumentNode
from hexapod_comp.ros.mover import MoverNode
from hexapod_comp.ros.process import QUIET, RosSession
from hexapod_comp.ros.recorder import BagRecorder
from hexapod_comp.viewer.page import Watcher

POLICY = Path(__file__).resolve().parents[2] / "config" / "security" / "policy.xml"

RIGHTS = ("publish", "subscribe", "reply", "request")

TOOLS = "_ros2cli_*"
"""Names of the nodes that the ``ros2`` tools make; permissions of DDS take patterns (POSIX fnmatch)."""

COMMANDS = {
    "/tool_pose_command": {"commander", "linuxcnc_bridge", "mover"},
    "/select_tool": {"commander"},
    "/strut_commands": {"compensator"},
}
"""Who alone may move the machine."""


@dataclass
class Enclave:
    """What one enclave may do, as absolute names by right."""

    node: str
    allowed: dict[str, set[str]] = field(default_factory=lambda: {right: set() for right in RIGHTS})


def read_policy(namespace: str = "") -> dict[str, Enclave]:
    """Return the enclaves of the shipped policy by the last part of their path, for a machine in a namespace."""
    builder = ET.TreeBuilder(insert_comments=True)
    root = ET.parse(POLICY, ET.XMLParser(target=builder)).getroot()
    found = {}
    for enclave in root.find("enclaves"):
        profiles = enclave.findall("profiles/profile")
        entry = Enclave(profiles[0].get("node"))
        for profile in profiles:
            node = profile.get("node")
            place = "" if node == TOOLS else namespace
            for group in profile:
                rights = [right for right in group.attrib if group.get(right) == "ALLOW"]
                for name, right in product(group, rights):
                    entry.allowed[right].add(absolute(name.text, node, place))
        found[enclave.get("path").rpartition("/")[2]] = entry
    return found


def absolute(name: str, node: str, namespace: str) -> str:
    """Return a policy's name as the graph shows it, for a profile whose ns is `namespace`."""
    return name if name.startswith("/") else f"{namespace}/{name.replace('~', node, 1)}"


def opened(witness: Node, node: str, namespace: str) -> dict[str, set[str]]:
    """Return what the graph says that a node has opened."""
    asked = {
        "publish": witness.get_publisher_names_and_types_by_node,
        "subscribe": witness.get_subscriber_names_and_types_by_node,
        "reply": witness.get_service_names_and_types_by_node,
        "request": witness.get_client_names_and_types_by_node,
    }
    return {right: {name for name, _ in ask(node, namespace or "/")} for right, ask in asked.items()}


def test_form() -> None:
    """What sros2 wants: its version, enclaves only, and every right an ALLOW."""
    root = ET.parse(POLICY, ET.XMLParser(target=ET.TreeBuilder(insert_comments=True))).getroot()
    assert root.tag == "policy"
    assert root.get("version") == "0.2.0"
    assert [child.tag for child in root] == ["enclaves"]
    assert {child.tag for child in root.find("enclaves")} == {"enclave"}
    groups = root.findall(".//topics") + root.findall(".//services")
    assert {value for group in groups for value in group.attrib.values()} == {"ALLOW"}


def test_nobody_else_may_move_the_machine() -> None:
    for topic, allowed in COMMANDS.items():
        may = {name for name, enclave in read_policy().items() if topic in enclave.allowed["publish"]}
        assert may == allowed, topic


def test_operators_and_thermometers_hear_and_ask_only_what_there_is() -> None:
    """A misspelt name in a policy is a right that nobody has, or a refusal that nobody understands."""
    policy = read_policy()
    nodes = [policy[name].allowed for name in ("compensator", "strut_drive", "linuxcnc_bridge", "commander")]
    heard = {name for allowed in nodes for right in ("publish", "subscribe") for name in allowed[right]}
    answered = {name for allowed in nodes for name in allowed["reply"]}
    for name in ("operator", "thermometers"):
        allowed = policy[name].allowed
        assert allowed["publish"] | allowed["subscribe"] <= heard
        assert allowed["request"] <= answered
        assert all(reply.startswith(f"/{TOOLS}/") for reply in allowed["reply"])


@pytest.mark.parametrize("name", ["compensator", "strut_drive", "mover", "instrument", "adapter", "linuxcnc_bridge"])
def test_lifecycle_nodes_open_what_the_policy_allows(name: str, rig: Rig) -> None:
    """Nothing more, nothing less, with every optional topic switched on."""
    rig.namespace = "/guarded"  # of its own: the graph still knows nodes of these names from other tests
    node = {
        "compensator": lambda: rig.compensator(publish_array=True),
        "strut_drive": rig.drive,
        "mover": lambda: rig.add(MoverNode, True, {}),
        "instrument": lambda: rig.add(InstrumentNode, True, {"kind": "tracker"}),
        "adapter": lambda: rig.add(AdapterNode, True, {}),
        "linuxcnc_bridge": lambda: rig.add(LinuxcncBridgeNode, True, {}, hal=StandInHal()),
    }[name]()
    enclave = read_policy(rig.namespace)[name]
    assert enclave.node == name
    enclave.allowed["publish"] -= {"/guarded/instrument/readings"}  # a laser's, in place of a tracker's pose
    with contextlib.suppress(TimeoutError):  # the comparison says what is missing
        rig.until(lambda: opened(node, name, rig.namespace) == enclave.allowed, "the graph to be complete", 1.0)
    assert opened(node, name, rig.namespace) == enclave.allowed


def test_the_client_opens_what_the_policy_allows() -> None:
    client = LoopClient()
    try:
        enclave = read_policy()["commander"]
        assert client.node.get_name() == enclave.node
        found = opened(client.node, enclave.node, "")
        found["publish"] |= {"/select_tool"}  # for controllers that change tools
        assert found == enclave.allowed
    finally:
        client.close()


def test_who_only_listens_may_and_opens_nothing_more(tmp_path: Path) -> None:
    """``record`` and ``watch``, as they run; of ``echo`` its node, and that every topic of the nodes is there."""
    policy = read_policy()
    opens: dict[str, set[str]] = {right: set() for right in RIGHTS}

    def look(node: Node) -> None:
        for right, names in opened(node, node.get_name(), "").items():
            opens[right] |= names

    with BagRecorder(tmp_path / "bag") as recorder:
        look(recorder._session.node)
    with RosSession("hexapod_comp_watch", **QUIET) as session:
        Watcher(load_geometry(config_file("paper.yaml")), session.node)
        look(session.node)
    with RosSession("hexapod_comp_echo", **QUIET) as session:
        look(session.node)
    witness = policy["witness"].allowed
    assert opens["subscribe"] <= witness["subscribe"]
    assert {right: opens[right] for right in RIGHTS[:1] + RIGHTS[2:]} == {
        right: witness[right] for right in RIGHTS[:1] + RIGHTS[2:]
    }
    said = {
        name for name in policy["compensator"].allowed["publish"] if not name.endswith(("_event", "_events", "rosout"))
    }
    others = {"/strut_states", "/tool_pose_true", "/tool_pose_command", "/select_tool", "/temperatures", "/humidity"}
    others |= {"/gravity", "/wrench", "/outside"}
    by_input = {"/strut_setpoints", "/nominal_strut_states"}  # with command_input: struts
    assert witness["subscribe"] == said | others | by_input


LIFECYCLE = ("change_state", "get_state", "get_available_transitions", "get_transition_graph")
"""What ``ros2 lifecycle`` (ros2cli 0.32, Jazzy) asks nodes for: ``list`` the third, with -a the last; ``set`` the
third, then the first; ``get`` the second."""


def tool_nodes(context: Context, machines: tuple[str, ...]) -> Iterator[Node]:
    """Make what the tools of Jazzy make: its name, its services, and its clients.

    ``ros2 topic``, ``node``, ``lifecycle`` and ``param``: ros2cli/node/direct.py; ``ros2 param``'s client is rclpy's
    own. ``ros2 service call``: ros2service/verb/call.py, named after the service's type.
    """
    direct = rclpy.create_node(TOOLS.replace("*", "4711"), context=context, start_parameter_services=False)
    for machine in machines:
        AsyncParameterClient(direct, machine)
        for name in LIFECYCLE:
            kind = {"change_state": ChangeState, "get_state": GetState}.get(name, GetAvailableTransitions)
            direct.create_client(kind, f"{machine}/{name}")
    yield direct
    for kind in (SetBool, Trigger):
        yield rclpy.create_node(TOOLS.replace("*", f"requester_std_srvs_{kind.__name__}"), context=context)


def test_the_operator_may_all_that_the_ros2_tools_open(ros_context: Context, capfd: pytest.CaptureFixture[str]) -> None:
    """Nothing less: a tool ends when one of its clients cannot be made. Nothing more: what else nobody asks for."""
    operator = read_policy()["operator"].allowed
    machines = ("compensator", "strut_drive", "linuxcnc_bridge")
    wanted: dict[str, set[str]] = {right: set() for right in RIGHTS}
    with Bench(ros_context, capfd) as rig:
        for node in tool_nodes(ros_context, machines):
            rig.until(lambda node=node: "/rosout" in opened(rig.witness, node.get_name(), "")["publish"], "a tool")
            for right, names in opened(rig.witness, node.get_name(), "").items():
                wanted[right] |= {name.replace(f"/{node.get_name()}/", f"/{TOOLS}/") for name in names}
            node.destroy_node()
    own = {f"/compensator/{name}" for name in ("enable_compensation", "reload_model", "reset", "get_travel")}
    assert wanted["request"] == operator["request"] - own
    assert wanted["publish"] == operator["publish"]
    assert wanted["reply"] == operator["reply"]


def test_the_launch_file_names_the_enclaves_of_the_policy(monkeypatch: pytest.MonkeyPatch) -> None:
    """Each node's ``--enclave`` is in the policy, by default."""
    launch_file = LaunchFile(monkeypatch)
    root = ET.parse(POLICY).getroot()
    paths = {enclave.get("path") for enclave in root.iter("enclave")}
    for folder, known in ((launch_file.defaults["enclaves"], True), ("/mine", False)):
        arguments = [node["ros_arguments"] for node in launch_file.start(f"enclaves:={folder}").values()]
        asked = [words[words.index("--enclave") + 1] for words in arguments]
        assert asked == [f"{folder}/compensator", f"{folder}/strut_drive"]
        assert paths.issuperset(asked) is known
