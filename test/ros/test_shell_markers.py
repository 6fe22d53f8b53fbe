"""Shells as ROS markers: the triangles are the mesh, the colours the values, and late subscribers see them."""

from __future__ import annotations

import numpy as np
import pytest
from builtin_interfaces.msg import Time
from test_workspace_pictures import RINGS, SECTORS, layers, mesh
from visualization_msgs.msg import Marker, MarkerArray

from hexapod_comp.errors import GeometryError
from hexapod_comp.testing.bench import spin_until
from hexapod_comp.viewer.shells import SHELL_QOS, TOPIC, publish_shells, shell_markers, triangles
from hexapod_comp.workspace.shells import TRANSLATION, Layer

STAMP = Time(sec=7)


def markers() -> list[Marker]:
    return shell_markers(layers(), TRANSLATION, "pitch, strut 1", "work", STAMP).markers


def test_triangles_enclose_the_mesh_and_look_outwards():
    """Truth: a ball of 50 mm: the sum of the tetrahedra to its centre is its volume, from below by the 6 % that
    so coarse a mesh cuts off; inward triangles would count negative. Poles have one triangle a sector."""
    points = mesh(0.05)
    found = triangles(points)
    assert len(found) == 2 * (RINGS - 1) * SECTORS - 2 * SECTORS
    a, b, c = np.moveaxis(points.reshape(-1, 3)[found] - [0.0, 0.0, 0.25], 1, 0)
    each = np.einsum("ni,ni->n", a, np.cross(b, c)) / 6.0
    assert (each > 0.0).all()
    assert 0.9 < each.sum() / (4.0 / 3.0 * np.pi * 0.05**3) < 1.0


def test_what_the_markers_hold():
    """Truth: viridis runs from (0.267, 0.005, 0.329) to (0.993, 0.906, 0.144) (its published table)."""
    clear, *shells, text = markers()
    assert clear.action == Marker.DELETEALL
    assert [shell.type for shell in shells] == [Marker.TRIANGLE_LIST] * 3
    assert [shell.id for shell in shells] == [0, 1, 2]
    for shell, layer in zip(shells, layers(), strict=True):
        assert (shell.header.frame_id, shell.header.stamp, shell.action) == ("work", STAMP, Marker.ADD)
        corners = np.array([[point.x, point.y, point.z] for point in shell.points])
        np.testing.assert_array_equal(corners, layer.points.reshape(-1, 3)[triangles(layer.points).ravel()])
        assert len(shell.colors) == len(shell.points)
    alpha = [shell.colors[0].a for shell in shells]
    assert alpha[0] == 1.0 > alpha[1] > alpha[2] > 0.2
    outer = shells[-1]
    far = int(np.argmax([abs(point.x) for point in outer.points]))
    near = int(np.argmin([abs(point.x) for point in outer.points]))
    for index, colour in ((far, (0.993, 0.906, 0.144)), (near, (0.267, 0.005, 0.329))):
        found = outer.colors[index]
        assert (found.r, found.g, found.b) == pytest.approx(colour, abs=2e-3)
    assert text.type == Marker.TEXT_VIEW_FACING
    assert text.text == "pitch, strut 1\ntranslation of the tool, µm: 1 (dark) … 3.5 (yellow)"
    assert text.pose.position.z > 0.3


@pytest.mark.parametrize("wrong", [[], [Layer(mesh(), np.full((RINGS, SECTORS + 1), np.nan))]])
def test_no_markers_of_nothing(wrong):
    with pytest.raises(GeometryError, match="layers: must be at least one, with finite values"):
        shell_markers(wrong, TRANSLATION, "", "work", STAMP)


def test_who_comes_late_sees_the_shells(ros_context):
    """Truth: a subscription made after the one message was sent receives it."""
    import rclpy
    from rclpy.experimental import EventsExecutor

    sender = rclpy.create_node("shells", context=ros_context)
    publisher = publish_shells(sender, MarkerArray(markers=markers()))
    assert publisher.topic_name == f"/{TOPIC}"
    late = rclpy.create_node("late", context=ros_context)
    seen: list[MarkerArray] = []
    late.create_subscription(MarkerArray, TOPIC, seen.append, SHELL_QOS)
    executor = EventsExecutor(context=ros_context)
    for node in (sender, late):
        executor.add_node(node)
    spin_until(executor, lambda: seen, timeout=20.0, what="the latched shells")
    assert [marker.type for marker in seen[0].markers] == [marker.type for marker in markers()]
    executor.shutdown()
    for node in (late, sender):
        node.destroy_node()
