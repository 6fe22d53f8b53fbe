"""Descriptions of the machine for robot programs: URDF for robot_state_publisher and ros2_control, MJCF for MuJoCo.

URDF describes trees only, so the machine becomes a tree of seven branches: the platform on six joints that give its
pose, and six struts, each with two crossed hinges at its base joint and a slide whose position is the strut's length.
Nothing in URDF ties the struts to the platform; :func:`joint_positions` returns joint positions at which they meet.
MJCF ties the struts to the platform by constraints.
"""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections.abc import Sequence
from typing import Any

import numpy as np

from ..core.batch import quaternion_of
from ..pose import Pose, roll_pitch_yaw
from .geometry import BASE, STRUT_NAMES, HexapodGeometry
from .kinematics import strut_lengths

# The platform's joints in order from base to platform, as in R = Ry(β)·Rx(α)·Rz(γ) (Song et al., T_BASE^TOP)
PLATFORM_JOINTS = ("platform_x", "platform_y", "platform_z", "platform_beta", "platform_alpha", "platform_gamma")
X, Y, Z = "1.0 0.0 0.0", "0.0 1.0 0.0", "0.0 0.0 1.0"
STRUT_RADIUS, JOINT_RADIUS, PLATE = 0.01, 0.018, 0.01  # Drawn sizes, m: struts, joints, and the platform's thickness
# Hardware plugin of ros2_control and its parameters. The threshold -1 makes the plugin send every command, even one
# equal to the reading. The joints need a velocity state: without one, the plugin exits when a message has velocities
TOPICS = (
    "joint_state_topic_hardware_interface/JointStateTopicSystem",
    {
        "joint_commands_topic": "strut_setpoints",
        "joint_states_topic": "nominal_strut_states",
        "trigger_joint_command_threshold": "-1",
    },
)
MOCK: tuple[str, dict[str, str]] = ("mock_components/GenericSystem", {})
# Density of the bodies in MJCF, kg/m³, as a machine file has no masses. A platform of 0.35 m then weighs 7 kg
STEEL = 7850.0
# MuJoCo's armature of a strut's slide, kg (1.3e-4 kg m² on a screw of 5 mm lead), and of a hinge at its foot, kg m².
# Armature is inertia without weight. Without armature, stiff drives on light bodies would need a shorter time step
SCREW_INERTIA, HINGE_INERTIA = 200.0, 0.01
# Stiffness of a strut's drive, N/m (a steel rod of 20 mm, 0.6 m long), and damping, N s/m: critical for SCREW_INERTIA
STIFFNESS, DAMPING = 1e8, 2.8e5
# The drive's largest force is DAMPING times this speed, m/s, or times the machine's limit of speed if that is smaller.
# Without a limit of force, a `ctrl` that was never set, 0 m, would accelerate the platform without bound
FASTEST = 1.0
# MuJoCo's time step, s, and the stiffest constraints for it (time constant 2 steps): gravity opens joints by 0.1 µm
TIMESTEP, TIED = 1e-3, {"solref": "0.002 1", "solimp": "0.9999 0.9999 0.001"}
LOOSE = 1e3  # Limit of effort and speed of joints without a motor, as readers of URDF require a limit


def joint_positions(
    geometry: HexapodGeometry, platform: Pose, joint_names: Sequence[str] = STRUT_NAMES
) -> dict[str, float]:
    """Return by name the positions, m or rad, of all joints of :func:`urdf` when the platform is at a pose."""
    alpha, beta, gamma = platform.angles()
    values = dict(zip(PLATFORM_JOINTS, (*platform.position, beta, alpha, gamma), strict=True))
    ends = platform.transform(geometry.platform_joints)
    lengths = strut_lengths(geometry, platform)
    along = (ends - geometry.base_joints) / lengths[:, None]
    x, y, z = np.einsum("nji,nj->in", foot_frames(geometry), along)
    for name, about_y, about_x in zip(joint_names, np.arctan2(x, z), -np.arctan2(y, np.hypot(x, z)), strict=True):
        values |= {f"{name}_foot_1": about_y, f"{name}_foot_2": about_x}
    values |= dict(zip(joint_names, lengths, strict=True))
    return {name: float(value) for name, value in values.items()}


def urdf(
    geometry: HexapodGeometry,
    joint_names: Sequence[str] = STRUT_NAMES,
    ros2_control: bool = True,
    hardware: tuple[str, dict[str, str]] = TOPICS,
) -> str:
    """Return the machine as URDF, with a link for each body, strut, tool and work frame.

    The part ``ros2_control`` connects the struts to topics; with the hardware :data:`MOCK` it simulates ideal drives.
    """
    robot = ET.Element("robot", name=geometry.name)
    span, half = float(np.abs(geometry.home.position).max() + geometry.limits.stroke.max()), 0.5 * np.pi
    _draw_joints(_add(robot, "link", name="base"), geometry.base_joints)
    for name, pose in geometry.work_frames.items():
        if name != BASE:
            _fix(robot, "base", name, pose)
    parent = "base"
    for name, axis, limit in zip(PLATFORM_JOINTS, (X, Y, Z, Y, X, Z), [span] * 3 + [np.pi] * 3, strict=True):
        child = "platform" if name == PLATFORM_JOINTS[-1] else f"{name}_link"
        kind = "prismatic" if limit == span else "revolute"
        _move(_join(robot, name, kind, parent, child), axis, (-limit, limit))
        parent, link = child, _add(robot, "link", name=child)
    middle, radius = _plate(geometry)
    _draw(link, middle, "cylinder", radius=radius, length=PLATE)
    _draw_joints(link, geometry.platform_joints)
    for name, pose in geometry.tools.items():
        _fix(robot, "platform", name, pose)
    feet = map(Pose, geometry.base_joints, foot_frames(geometry))
    for name, foot, (short, long) in zip(joint_names, feet, geometry.limits.stroke, strict=True):
        hinge, body, rod = f"{name}_hinge", f"{name}_body", f"{name}_rod"
        _move(_join(robot, f"{name}_foot_1", "revolute", "base", hinge, foot), Y, (-half, half))
        _add(robot, "link", name=hinge)
        _move(_join(robot, f"{name}_foot_2", "revolute", hinge, body), X, (-half, half))
        link = _add(robot, "link", name=body)
        _draw(link, [0.0, 0.0, 0.25 * short], "cylinder", radius=1.5 * STRUT_RADIUS, length=0.5 * short)
        _move(_join(robot, name, "prismatic", body, rod), Z, (short, long), geometry.limits.speed)
        link = _add(robot, "link", name=rod)
        _draw(link, [0.0, 0.0, -0.3 * short], "cylinder", radius=STRUT_RADIUS, length=0.6 * short)
    if ros2_control:
        _add_control(robot, geometry, joint_names, *hardware)
    return _text(robot)


def _add_control(
    robot: ET.Element, geometry: HexapodGeometry, joint_names: Sequence[str], plugin: str, parameters: dict[str, str]
) -> None:
    control = _add(robot, "ros2_control", name=geometry.name, type="system")
    hardware = _add(control, "hardware")
    _add(hardware, "plugin").text = plugin
    for name, value in parameters.items():
        _add(hardware, "param", name=name).text = value
    for name, length in zip(joint_names, strut_lengths(geometry, geometry.home), strict=True):
        joint = _add(control, "joint", name=name)
        _add(joint, "command_interface", name="position")
        position = _add(joint, "state_interface", name="position")
        if plugin == MOCK[0]:
            _add(position, "param", name="initial_value").text = _numbers(length)
        else:
            _add(joint, "state_interface", name="velocity")


def mjcf(geometry: HexapodGeometry, joint_names: Sequence[str] = STRUT_NAMES) -> str:
    """Return the machine as MJCF: a free platform, six struts tied to it, and a drive on each strut's slide.

    Sites ``base_joint_N``, ``strut_end_N`` and ``platform_joint_N`` mark the ends of strut N; a site with a tool's name
    marks the tool. A drive's `ctrl` is the commanded length of its strut, m. MuJoCo's reference position is home. The
    keyframe ``home`` also sets `ctrl`, so that the drives hold the machine at home. Gravity acts along −z of the base.
    """
    home, (middle, radius) = geometry.home, _plate(geometry)
    lengths, push = strut_lengths(geometry, home), DAMPING * min(geometry.limits.speed, FASTEST)
    root = ET.Element("mujoco", model=geometry.name)
    _add(root, "compiler", angle="radian", autolimits="true")
    # MuJoCo integrates damping implicitly; explicit steps would have to be shorter than a light body's settling time
    _add(root, "option", integrator="implicitfast", timestep=TIMESTEP)
    default = _add(root, "default")
    # Collisions are off, as the drawn struts overlap the plate, and each other at shared joints
    _add(default, "geom", density=STEEL, contype="0", conaffinity="0")
    _add(default, "equality", **TIED)
    world, ties, drives = _add(root, "worldbody"), _add(root, "equality"), _add(root, "actuator")
    platform = _add(world, "body", name="platform", **_place(home.position, home.rotation))
    _add(platform, "freejoint", name="platform")
    _add(platform, "geom", type="cylinder", size=[radius, 0.5 * PLATE], pos=middle)
    for n, joint in enumerate(geometry.platform_joints, 1):
        _add(platform, "site", name=f"platform_joint_{n}", pos=joint)
    for name, pose in geometry.tools.items():
        _add(platform, "site", name=name, **_place(pose.position, pose.rotation))
    at_rest = joint_positions(geometry, home)
    bent = [at_rest[f"{name}_foot_2"] for name in STRUT_NAMES]
    feet = map(Pose, geometry.base_joints, foot_frames(geometry))
    rows = zip(joint_names, lengths, geometry.limits.stroke, feet, bent, strict=True)
    for n, (name, length, reach, foot, angle) in enumerate(rows, 1):
        # `ref` is the joint's position, length or angle, in MuJoCo's reference pose, which is home
        c, s, short = np.cos(angle), np.sin(angle), reach[0]
        turned = foot.rotation @ np.array([[1.0, 0.0, 0.0], [0.0, c, -s], [0.0, s, c]])
        body = _add(world, "body", name=f"{name}_body", **_place(foot.position, turned))
        _add(body, "joint", name=f"{name}_foot_1", axis=[0.0, c, -s], armature=HINGE_INERTIA)
        _add(body, "joint", name=f"{name}_foot_2", axis="1 0 0", ref=angle, armature=HINGE_INERTIA)
        _add(body, "geom", type="cylinder", size=STRUT_RADIUS * 1.5, fromto=f"0 0 0 0 0 {_numbers(0.5 * short)}")
        _add(body, "site", name=f"base_joint_{n}")
        rod = _add(body, "body", name=f"{name}_rod", **_place([0.0, 0.0, length], np.eye(3)))
        _add(rod, "joint", name=name, type="slide", axis="0 0 1", ref=length, range=reach, armature=SCREW_INERTIA,
             damping=DAMPING)  # fmt: skip
        _add(rod, "geom", type="cylinder", size=STRUT_RADIUS, fromto=f"0 0 {_numbers(-0.6 * short)} 0 0 0")
        _add(rod, "site", name=f"strut_end_{n}")
        _add(ties, "connect", name=f"{name}_end", site1=f"strut_end_{n}", site2=f"platform_joint_{n}")
        _add(drives, "position", name=name, joint=name, kp=STIFFNESS, ctrlrange=reach, forcerange=[-push, push])
    struts = np.stack([np.zeros(6), bent, lengths], axis=1).ravel()
    place = [*home.position, *_quaternion(home.rotation), *struts]
    _add(_add(root, "keyframe"), "key", name="home", qpos=place, ctrl=lengths)
    return _text(root)


def foot_frames(geometry: HexapodGeometry) -> np.ndarray:
    """Return the rotation, (6, 3, 3), of a frame at each base joint: y along the strut's first hinge, z near the strut.

    A strut's first hinge is the cardan axis that is fixed to the base. If the geometry gives no cardan axes, a strut's
    first hinge is perpendicular to the strut at home.
    """
    home = geometry.home
    along = home.transform(geometry.platform_joints) - geometry.base_joints
    z = along / np.linalg.norm(along, axis=1)[:, None]
    if geometry.base_axes is None:
        x = np.cross(np.eye(3)[np.abs(z).argmin(axis=1)], z)
    else:
        x = np.cross(geometry.base_axes, z)
    x /= np.linalg.norm(x, axis=1)[:, None]
    y = np.cross(z, x) if geometry.base_axes is None else geometry.base_axes
    return np.stack([x, y, np.cross(x, y)], axis=2)


HEAD = "<?xml version='1.0' encoding='utf-8'?>\n"


def _text(root: ET.Element) -> str:
    ET.indent(root)
    return f"{HEAD}{ET.tostring(root, encoding='unicode')}\n"


def _add(parent: ET.Element, tag: str, **attributes: Any) -> ET.Element:
    """Add an XML element whose attributes are texts, numbers or arrays of numbers."""
    texts = {name: value if isinstance(value, str) else _numbers(value) for name, value in attributes.items()}
    return ET.SubElement(parent, tag, texts)


def _numbers(values: Any) -> str:
    return " ".join(repr(float(value)) for value in np.ravel(values))


def _draw_joints(link: ET.Element, joints: np.ndarray) -> None:
    for joint in joints:
        _draw(link, joint, "sphere", radius=JOINT_RADIUS)


def _draw(link: ET.Element, middle: Any, shape: str, **size: float) -> None:
    visual = _add(link, "visual")
    _add(visual, "origin", xyz=middle)
    _add(_add(visual, "geometry"), shape, **size)


def _join(robot: ET.Element, name: str, kind: str, parent: str, child: str, at: Pose | None = None) -> ET.Element:
    joint = _add(robot, "joint", name=name, type=kind)
    if at is not None:
        _add(joint, "origin", xyz=at.position, rpy=roll_pitch_yaw(at.rotation))
    _add(joint, "parent", link=parent)
    _add(joint, "child", link=child)
    return joint


def _fix(robot: ET.Element, parent: str, name: str, at: Pose) -> None:
    """Add a link without a body, fixed to the link `parent` at the pose `at`."""
    _join(robot, f"{name}_mount", "fixed", parent, name, at)
    _add(robot, "link", name=name)


def _move(joint: ET.Element, axis: str, limits: tuple[float, float], speed: float = LOOSE) -> None:
    """Set a joint's axis of motion, its position limits, m or rad, and its speed limit."""
    _add(joint, "axis", xyz=axis)
    _add(joint, "limit", lower=limits[0], upper=limits[1], effort=LOOSE, velocity=min(speed, LOOSE))


def _plate(geometry: HexapodGeometry) -> tuple[np.ndarray, float]:
    """Return centre and radius, m, of the disc that represents the platform."""
    joints = geometry.platform_joints
    middle = joints.mean(axis=0)
    return middle, float(np.linalg.norm((joints - middle)[:, :2], axis=1).mean())


def _place(position: Any, rotation: np.ndarray) -> dict[str, Any]:
    return {"pos": position, "quat": _quaternion(rotation)}


def _quaternion(rotation: np.ndarray) -> list[float]:
    x, y, z, w = quaternion_of(rotation)
    return [w, x, y, z]
