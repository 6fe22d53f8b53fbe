"""The live page and its shells: messages become the right picture, and nothing is published."""

from __future__ import annotations

import socket
import sys
from collections.abc import Iterator
from http.client import HTTPConnection
from unittest.mock import MagicMock

import numpy as np
import pytest
import rclpy
from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticStatus, KeyValue
from node_helpers import HOME, closed_form_lengths, model_file, near
from sensor_msgs.msg import JointState
from test_workspace_pictures import RINGS, SECTORS, mesh
from visualization_msgs.msg import Marker, MarkerArray

from hexapod_comp.cli import main
from hexapod_comp.errors import GeometryError, HexapodError
from hexapod_comp.machine.geometry import load_geometry
from hexapod_comp.pose import Pose
from hexapod_comp.ros.base import LATCHED_QOS
from hexapod_comp.ros.process import QUIET
from hexapod_comp.viewer import page as watching
from hexapod_comp.viewer import shells
from hexapod_comp.viewer.page import View, Watcher, WatchPage, same_site, strut_colours, strut_ends, view_html
from hexapod_comp.viewer.shells import shell_markers, triangles
from hexapod_comp.workspace.shells import TRANSLATION, Layer

OFFSETS = np.array([-100.0, -50.0, 0.0, 50.0, 100.0, 200.0])
"""Offsets of the struts, µm: actual = command + offset, so the corrections are −offset."""


def watched(rig, geometry: str = "paper.yaml") -> Watcher:
    node = rclpy.create_node("hexapod_comp_watch", context=rig.context, namespace=rig.namespace, **QUIET)
    return Watcher(load_geometry(geometry), rig.host(node))


def test_what_is_heard_becomes_the_picture(rig, tmp_path):
    """The truth is the struts between hexagon and triangle of Song et al. at the commanded pose, by plane geometry.

    Corrections are minus the offsets. The estimate comes from the node's own commands, to the solver's tolerance of
    1e-9 m."""
    rig.compensator(model_file=model_file(tmp_path, struts={"offset_um": OFFSETS.tolist()}), ramp_rate=1.0)
    watcher, pose = watched(rig), near(HOME, (0.02, -0.01, 0.03), 4.0)
    rig.settle(pose)

    def there() -> bool:
        rig.ask(pose)
        view = watcher.view()
        return bool(view.delays) and view.corrections is not None and view.left is not None

    rig.until(there, "the picture of the pose")
    view = watcher.view()
    assert view.platform is not None
    assert view.commanded is not None
    ends = strut_ends(load_geometry("paper.yaml"), view.platform)
    np.testing.assert_allclose(np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1), closed_form_lengths(pose), atol=2e-9)
    tips = np.deg2rad([60.0, 60.0, 180.0, 180.0, 300.0, 300.0])
    triangle = 0.3 / np.sqrt(3.0) * np.stack([np.cos(tips), np.sin(tips), 0.0 * tips], axis=1)
    np.testing.assert_allclose(ends[:, 1], pose.position + triangle @ pose.rotation.T, atol=2e-9)
    np.testing.assert_allclose(view.commanded.position, pose.position, atol=2e-9)
    np.testing.assert_allclose(view.corrections, -1e-6 * OFFSETS, atol=1e-12)
    assert view.left is not None
    assert np.abs(view.left.displacement).max() < 2e-9
    assert 0.0 < min(view.delays) <= max(view.delays) < 5.0


def test_the_error_left_is_along_the_axes_of_work(rig):
    """The measured struts are distances between joints with the platform 20 µm off along base x, by plain closure; in
    work this is the first row of the frame's rotation. Closure omits the rotation of screws, 0.2 % of the motion."""
    geometry, close = "example_6_6.yaml", 5e-8
    rig.remove_publisher("strut_states")
    rig.add_publisher("strut_states")
    machine = load_geometry(geometry)
    watcher, home = watched(rig, geometry), machine.home

    def measured(pose: Pose) -> np.ndarray:
        tops = pose.position + machine.platform_joints @ pose.rotation.T
        return np.linalg.norm(tops - machine.base_joints, axis=1)

    rig.compensator(geometry_file=geometry, model_file="ideal")
    rig.feed(measured(home))
    rig.barrier()
    shift = np.array([20e-6, 0.0, 0.0])

    def there() -> bool:
        rig.feed(measured(Pose(home.position + shift, home.rotation)))
        rig.ask(home @ machine.tool)
        left = watcher.view().left
        return left is not None and np.abs(left.displacement - machine.work.rotation.T @ shift).max() < close

    rig.until(there, "the error left")
    view = watcher.view()
    assert view.left is not None
    assert view.left.turn < 1e-7
    np.testing.assert_allclose(view.measured, measured(Pose(home.position + shift, home.rotation)), atol=1e-12)


def test_what_is_old_or_no_machine_is_not_known(rig, monkeypatch):
    """Struts without names, NaN before a controller is active, and invalid bytes show nothing, without an error."""
    watcher = watched(rig)
    names = [f"strut_{n}" for n in range(1, 7)]
    for message in (JointState(), JointState(name=names, position=[float("nan")] * 6)):
        rig.publish("strut_states", message)
        rig.until(lambda: "strut_states" in watcher._newest, "a message")
        assert watcher.view() == View()
        watcher._newest.clear()
    watcher._newest["tool_pose_estimate"] = (b"\0\1\0", np.inf)
    assert watcher.view() == View()
    rig.feed(closed_form_lengths(HOME))
    rig.until(lambda: watcher.view().measured is not None, "measured struts")
    monkeypatch.setattr(watching, "SILENT_AFTER", 0.0)
    assert watcher.view() == View()


def test_words_are_escaped_and_another_machine_is_named():
    values = [KeyValue(key="model", value="<script>alert(1)</script>"), KeyValue(key="refused.<b>", value="3")]
    status = DiagnosticStatus(level=b"\2", name="compensator: state", message="<img src=x>", values=values)
    status.hardware_id = "left/other"
    text = view_html(View(states={"compensator": status}), "paper")
    assert "<script" not in text
    assert "<img" not in text
    assert "&lt;script&gt;" in text
    assert "refused: &lt;b&gt;" in text
    assert "runs the machine left/other, not paper" in text
    for same in ("left/paper", "paper", ""):
        status.hardware_id = same
        assert "runs the machine" not in view_html(View(states={"compensator": status}), "paper")


def test_colours_of_corrections():
    """The truth is the legend: blue −100 µm, white 0, red +100 µm, grey if not known."""
    colours = strut_colours(np.array([-100e-6, -50e-6, 0.0, 50e-6, 100e-6, 1.0]))
    assert colours[:, 0].tolist() == [
        [0, 0, 255],
        [128, 128, 255],
        [255, 255, 255],
        [255, 128, 128],
        [255, 0, 0],
        [255, 0, 0],
    ]
    assert (colours[:, 0] == colours[:, 1]).all()
    assert np.unique(strut_colours(None).reshape(-1, 3), axis=0).shape == (1, 3)


def test_without_viser_the_verb_says_what_to_install(monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "viser", None)
    assert main(["watch"]) == 2
    assert "pip install viser" in capsys.readouterr().err


@pytest.fixture
def page() -> Iterator[WatchPage]:
    pytest.importorskip("viser", reason="the page needs viser")
    with socket.create_server(("127.0.0.1", 0)) as server:
        free_port = int(server.getsockname()[1])
    made = WatchPage(load_geometry("paper.yaml"), port=free_port)
    yield made
    made.close()


def test_a_page_shows_the_machine_and_an_address_that_cannot_be_had_is_named(page: WatchPage):
    """No other address is taken in its place, and nothing blocks."""
    geometry, port = load_geometry("paper.yaml"), int(page.address.rpartition(":")[2])
    assert page._server.request_share_url() is None
    shown = View(platform=Pose([0.0, 0.0, 0.5], np.eye(3)), corrections=1e-6 * OFFSETS)
    page.show(shown)
    np.testing.assert_allclose(page._struts.points, strut_ends(geometry, shown.platform), atol=1e-6)
    assert page._struts.colors[0].tolist() == [[0, 0, 255]] * 2, "-100 µm is blue"
    assert "-100.0 µm" in page._text.content
    page.show(View())
    assert len(np.unique(page._struts.colors.reshape(-1, 3), axis=0)) == 1, "grey, where it was"
    with pytest.raises(HexapodError, match=f"cannot serve on 127.0.0.1, port {port}: .*in use"):
        WatchPage(geometry, port=port)
    with pytest.raises(HexapodError, match="cannot serve on no such host"):
        WatchPage(geometry, host="no such host")


@pytest.mark.parametrize(
    ("asked", "origin", "served"),
    [
        ("127.0.0.1:8080", None, True),
        ("localhost:9000", "http://localhost:9000", True),  # through a tunnel
        ("[::1]:8080", "http://[::1]:8080", True),
        ("192.168.0.7:8080", "http://192.168.0.7:8080", True),  # with --host 0.0.0.0
        ("machine.shop:8080", "http://machine.shop:8080", True),  # with --host machine.shop
        ("127.0.0.1:8080", "http://evil.example", False),
        ("127.0.0.1:8080", "http://127.0.0.1:3000", False),  # another server on this computer
        ("evil.example:8080", "http://evil.example:8080", False),  # a foreign name that resolves to 127.0.0.1
        ("[::1", None, False),
    ],
)
def test_only_the_page_s_own_site_is_served(asked, origin, served):
    headers = {"Host": asked} | ({} if origin is None else {"Origin": origin})
    assert same_site(headers, "machine.shop") is served


def test_the_server_refuses_what_other_sites_ask_for(page: WatchPage):
    """The server decides by the browser's headers, for the page and for its connection."""
    upgrade = {
        "Connection": "Upgrade",
        "Upgrade": "websocket",
        "Sec-WebSocket-Version": "13",
        "Sec-WebSocket-Key": "AAAAAAAAAAAAAAAAAAAAAA==",
        "Sec-WebSocket-Protocol": "viser-v1.1.1",
    }
    own = page.address.removeprefix("http://")
    for headers, status in (
        ({"Host": own}, 200),
        ({"Host": "evil.example"}, 403),
        ({"Host": own, "Origin": page.address, **upgrade}, 101),
        ({"Host": own, "Origin": "http://evil.example", **upgrade}, 403),
        ({"Host": "evil.example", "Origin": "http://evil.example", **upgrade}, 403),
    ):
        connection = HTTPConnection(own, timeout=20.0)
        connection.request("GET", "/", headers=headers)
        assert connection.getresponse().status == status, headers
        connection.close()


# ---- shells ----


STAMP = Time(sec=7)
LAYERS = [Layer(mesh(radius), 1e-6 + 1e-3 * mesh(radius)[..., 0] ** 2) for radius in (0.02, 0.035, 0.05)]


def test_triangles_enclose_the_mesh_and_look_outwards():
    """The tetrahedra to the centre of a ball of 50 mm sum to its volume less 6 %, which so coarse a mesh cuts off.

    Triangles that look inwards would count as negative. Poles have one triangle per sector."""
    points = mesh(0.05)
    found = triangles(points)
    assert len(found) == 2 * (RINGS - 1) * SECTORS - 2 * SECTORS
    a, b, c = np.moveaxis(points.reshape(-1, 3)[found] - [0.0, 0.0, 0.25], 1, 0)
    each = np.einsum("ni,ni->n", a, np.cross(b, c)) / 6.0
    assert (each > 0.0).all()
    assert 0.9 < each.sum() / (4.0 / 3.0 * np.pi * 0.05**3) < 1.0


def test_what_the_markers_hold():
    """The truth is viridis' published table, from (0.267, 0.005, 0.329) to (0.993, 0.906, 0.144)."""
    clear, *shells, text = shell_markers(LAYERS, TRANSLATION, "pitch, strut 1", STAMP).markers
    assert clear.action == Marker.DELETEALL
    assert [shell.type for shell in shells] == [Marker.TRIANGLE_LIST] * 3
    assert [shell.id for shell in shells] == [0, 1, 2]
    for shell, layer in zip(shells, LAYERS, strict=True):
        assert (shell.header.frame_id, shell.header.stamp, shell.action) == ("work", STAMP, Marker.ADD)
        corners = np.array([[point.x, point.y, point.z] for point in shell.points])
        np.testing.assert_array_equal(corners, layer.points.reshape(-1, 3)[triangles(layer.points).ravel()])
        assert len(shell.colors) == len(shell.points)
    assert [shell.colors[0].a for shell in shells] == pytest.approx([1.0, 0.675, 0.35])
    outer = shells[-1]
    far = int(np.argmax([abs(point.x) for point in outer.points]))
    near = int(np.argmin([abs(point.x) for point in outer.points]))
    for index, colour in ((far, (0.993, 0.906, 0.144)), (near, (0.267, 0.005, 0.329))):
        found = outer.colors[index]
        assert (found.r, found.g, found.b) == pytest.approx(colour, abs=2e-3)
    outermost = LAYERS[-1].points.reshape(-1, 3)
    low, high = outermost.min(axis=0), outermost.max(axis=0)
    size = 0.06 * (high[0] - low[0])
    assert text.type == Marker.TEXT_VIEW_FACING
    assert text.text == "pitch, strut 1\ntranslation of the tool, µm: 1 (dark) … 3.5 (yellow)"
    assert text.scale.z == pytest.approx(size)
    at = text.pose.position
    assert [at.x, at.y, at.z] == pytest.approx([*(0.5 * (low + high))[:2], high[2] + 3.0 * size])
    assert (text.color.r, text.color.g, text.color.b) == pytest.approx((0.9,) * 3)
    for marker in (*shells, text):
        assert (marker.ns, marker.pose.orientation.w, marker.color.a) == ("workspace_shells", 1.0, 1.0)


def test_shells_are_published_once_and_stay_until_ctrl_c(monkeypatch):
    session = MagicMock()
    session.__enter__.return_value = session
    session.node.get_clock.return_value.now.return_value.to_msg.return_value = STAMP
    session.spin_once.side_effect = [None, KeyboardInterrupt]
    monkeypatch.setattr(shells, "RosSession", lambda name: session)
    shells.show_shells(LAYERS[:1], TRANSLATION, "pitch")
    session.node.create_publisher.assert_called_once_with(MarkerArray, "workspace/shells", LATCHED_QOS)
    publish = session.node.create_publisher.return_value.publish
    publish.assert_called_once_with(shell_markers(LAYERS[:1], TRANSLATION, "pitch", STAMP))
    assert [marker.colors[0].a for marker in publish.call_args.args[0].markers[1:-1]] == [1.0], "the only shell"
    assert session.spin_once.call_count == 2


@pytest.mark.parametrize("wrong", [[], [Layer(mesh(), np.full((RINGS, SECTORS + 1), np.nan))]])
def test_no_markers_of_nothing(wrong):
    with pytest.raises(GeometryError, match="layers: must be at least one surface with finite values"):
        shell_markers(wrong, TRANSLATION, "", STAMP)
