"""The machine as RViz or Foxglove markers: joints, platform, and struts coloured by their correction."""

from __future__ import annotations

import numpy as np
from builtin_interfaces.msg import Duration, Time
from geometry_msgs.msg import Point
from std_msgs.msg import ColorRGBA
from visualization_msgs.msg import Marker, MarkerArray

from ..machine.geometry import HexapodGeometry

STRUT_DIAMETER = 0.02
JOINT_DIAMETER = 0.035
LIFETIME = Duration(sec=1)
"""A machine that nobody updates disappears instead of standing there as if it were alive."""

GREY = ColorRGBA(r=0.5, g=0.5, b=0.55, a=1.0)
STEEL = ColorRGBA(r=0.3, g=0.35, b=0.45, a=0.9)


def machine_markers(
    geometry: HexapodGeometry,
    position: np.ndarray,
    rotation: np.ndarray,
    correction: np.ndarray,
    frame_id: str,
    stamp: Time,
) -> MarkerArray:
    """Return the machine at a platform pose.

    Parameters
    ----------
    geometry : HexapodGeometry
        Nominal joints.
    position, rotation : ndarray, shape (3,), (3, 3)
        ``pose_platform_in_base``, m.
    correction : ndarray, shape (6,)
        Strut corrections, m; blue −100 µm, white 0, red +100 µm.
    frame_id, stamp
        Header of the markers.
    """
    base = geometry.base_joints
    platform = position + geometry.platform_joints @ rotation.T
    struts = _marker(frame_id, stamp, 0, Marker.LINE_LIST, STRUT_DIAMETER)
    for start, end, amount in zip(base, platform, correction, strict=True):
        struts.points += [_point(start), _point(end)]
        struts.colors += [correction_colour(amount)] * 2
    joints = _marker(frame_id, stamp, 1, Marker.SPHERE_LIST, JOINT_DIAMETER, GREY)
    joints.points = [_point(joint) for joint in (*base, *platform)]
    outline = _marker(frame_id, stamp, 2, Marker.LINE_STRIP, STRUT_DIAMETER, STEEL)
    outline.points = [_point(joint) for joint in (*platform, platform[0])]
    frame = _marker(frame_id, stamp, 3, Marker.LINE_STRIP, STRUT_DIAMETER, GREY)
    frame.points = [_point(joint) for joint in (*base, base[0])]
    tool = _marker(frame_id, stamp, 4, Marker.ARROW, STRUT_DIAMETER, STEEL)
    tool.points = [_point(position), _point(position + rotation @ geometry.tool.position + 0.1 * rotation[:, 2])]
    return MarkerArray(markers=[struts, joints, outline, frame, tool])


def correction_colour(correction: float, full: float = 100e-6) -> ColorRGBA:
    """Return blue for −`full`, white for 0, red for +`full` metres and beyond."""
    share = max(-1.0, min(1.0, correction / full))
    rest = 1.0 - abs(share)
    return ColorRGBA(r=1.0 if share > 0 else rest, g=rest, b=1.0 if share < 0 else rest, a=1.0)


def _marker(frame_id: str, stamp: Time, number: int, kind: int, size: float, colour: ColorRGBA | None = None) -> Marker:
    marker = Marker(ns="hexapod", id=number, type=kind, action=Marker.ADD, lifetime=LIFETIME)
    marker.header.frame_id = frame_id
    marker.header.stamp = stamp
    marker.pose.orientation.w = 1.0
    marker.scale.x = marker.scale.y = marker.scale.z = size
    if colour is not None:
        marker.color = colour
    else:
        marker.color.a = 1.0
    return marker


def _point(values: np.ndarray) -> Point:
    return Point(x=float(values[0]), y=float(values[1]), z=float(values[2]))
