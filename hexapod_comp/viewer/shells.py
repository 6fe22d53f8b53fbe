"""Nested surfaces in the workspace (shells) as markers for RViz and Foxglove, on a latched topic."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress

import numpy as np
from builtin_interfaces.msg import Time
from geometry_msgs.msg import Point
from std_msgs.msg import ColorRGBA
from visualization_msgs.msg import Marker, MarkerArray

from ..errors import GeometryError
from ..ros.base import LATCHED_QOS
from ..ros.process import SPIN_PERIOD, RosSession
from ..workspace.pictures import shades
from ..workspace.shells import Layer, Quantity

TOPIC, FRAME = "workspace/shells", "work"
NAMESPACE = "workspace_shells"
TEXT_SHARE = 0.06  # Height of the text divided by the width of the outermost surface
OPACITY = (1.0, 0.35)  # Opacity of the innermost and of the outermost surface


def shell_markers(layers: Sequence[Layer], quantity: Quantity, title: str, stamp: Time) -> MarkerArray:
    """Return markers of the surfaces, coloured by their values, and of a title that states the range of the values."""
    values = np.concatenate([layer.values.ravel() for layer in layers]) if layers else np.array([np.nan])
    if not np.isfinite(values).all():
        raise GeometryError("layers", "must be at least one surface with finite values")
    low, high = float(values.min()), float(values.max())
    clear = Marker(ns=NAMESPACE, action=Marker.DELETEALL)
    clear.header.frame_id, clear.header.stamp = FRAME, stamp
    markers = [clear]
    for number, (layer, opacity) in enumerate(zip(layers, np.linspace(*OPACITY, len(layers)), strict=True)):
        marker = _marker(stamp, number, Marker.TRIANGLE_LIST)
        shares = (layer.values.ravel() - low) / (high - low if high > low else 1.0)
        colours = [ColorRGBA(r=r, g=g, b=b, a=opacity) for r, g, b, _ in shades(shares).tolist()]
        points = [Point(x=x, y=y, z=z) for x, y, z in layer.points.reshape(-1, 3).tolist()]
        corners = triangles(layer.points).ravel().tolist()
        marker.points = [points[corner] for corner in corners]
        marker.colors = [colours[corner] for corner in corners]
        markers.append(marker)
    text = _marker(stamp, len(layers), Marker.TEXT_VIEW_FACING)
    values_shown = f"{low * quantity.factor:.4g} (dark) … {high * quantity.factor:.4g} (yellow)"
    text.text = f"{title}\n{quantity.label}: {values_shown}"
    below, above = (end(layers[-1].points.reshape(-1, 3), axis=0) for end in (np.min, np.max))
    centre, text.scale.z = 0.5 * (below + above), TEXT_SHARE * float(above[0] - below[0])
    text.pose.position = Point(x=float(centre[0]), y=float(centre[1]), z=float(above[2]) + 3.0 * text.scale.z)
    text.color = ColorRGBA(r=0.9, g=0.9, b=0.9, a=1.0)
    markers.append(text)
    return MarkerArray(markers=markers)


def show_shells(layers: Sequence[Layer], quantity: Quantity, title: str) -> None:
    """Publish the surfaces once on a latched topic of a new node, which runs until Ctrl-C."""
    with RosSession("workspace_shells") as session:
        publisher = session.node.create_publisher(MarkerArray, TOPIC, LATCHED_QOS)
        stamp = session.node.get_clock().now().to_msg()
        publisher.publish(shell_markers(layers, quantity, title, stamp))
        with suppress(KeyboardInterrupt):
            while True:
                session.spin_once(SPIN_PERIOD)


def triangles(points: np.ndarray) -> np.ndarray:
    """Return the triangles of a mesh of H × A points as three indices each into its H·A points. A triangle's corners
    are counter-clockwise seen from outside; triangles that a pole of the mesh reduces to a line are omitted."""
    number = np.arange(points.shape[0] * points.shape[1]).reshape(points.shape[:2])
    a, b, c, d = (part.ravel() for part in (number[:-1, :-1], number[:-1, 1:], number[1:, 1:], number[1:, :-1]))
    facets = np.concatenate([np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)])
    corners = points.reshape(-1, 3)[facets]
    return facets[(corners != np.roll(corners, 1, axis=1)).any(axis=2).all(axis=1)]


def _marker(stamp: Time, number: int, kind: int) -> Marker:
    marker = Marker(ns=NAMESPACE, id=number, type=kind, action=Marker.ADD)
    marker.header.frame_id, marker.header.stamp = FRAME, stamp
    marker.pose.orientation.w = 1.0
    marker.scale.x = marker.scale.y = marker.scale.z = 1.0
    marker.color.a = 1.0
    return marker
