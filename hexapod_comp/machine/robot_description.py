"""Descriptions of the machine for robot programs: URDF for robot_state_publisher and ros2_control, MJCF for MuJoCo.

URDF describes trees only, and a hexapod has closed loops. So the tree has seven branches: the platform, on six joints
that give its pose, and six struts, each on two crossed hinges at its base joint and with a slide whose position is its
length. :func:`joint_positions` gives all of them for one pose, so that each strut ends where its platform joint is.
MJCF closes the loops by constraints.
"""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections.abc import Sequence

import numpy as np

from ..core.batch import quaternion_of
from ..pose import Pose, roll_pitch_yaw
from .geometry import BASE, STRUT_NAMES, HexapodGeometry
from .kinematics import strut_lengths

# In their order from base to platform: R = Ry(β)·Rx(α)·Rz(γ) (Song et al., T_BASE^TOP)
PLATFORM_JOINTS = ("platform_x", "platform_y", "platform_z", "platform_beta", "platform_alpha", "platform_gamma")
_AXES = np.array([[1, 0, 0], [0, 1, 0], [0, 0, 1], [0, 1, 0], [1, 0, 0], [0, 0, 1]], dtype=float)
STRUT_RADIUS, JOINT_RADIUS, PLATE = 0.01, 0.018, 0.01  # Drawn sizes, m: struts, joints, and the platform's thickness
HARDWARE = (
    ("joint_commands_topic", "strut_setpoints"),
    ("joint_states_topic", "nominal_strut_states"),
    ("trigger_joint_command_threshold", "-1"),
)
"""Parameters of ros2_control's JointStateTopicSystem; the last one makes it send commands near the readings too."""

# Density of the drawn bodies, kg/m³, in MJCF; a machine file has no masses. A platform of 0.35 m weighs 7 kg
STEEL = 7850.0
SCREW_INERTIA, HINGE_INERTIA = 200.0, 0.01
"""Armature of a strut's slide, kg, 1.3e-4 kg m² turning on a screw of 5 mm lead; and of a hinge at its foot, kg m².

Light bodies with stiff drives need short steps: the armature gives the slides inertia without weight.
"""

# Of a strut's drive: N/m, a steel rod of 20 mm over 0.6 m; N s/m, critical with :data:`SCREW_INERTIA`
STIFFNESS, DAMPING = 1e8, 2.8e5
FASTEST = 1.0
"""Speed, m/s, to which the damping holds a strut under its drive's largest force, where the machine's limit is higher.

Without a limit of force, a `ctrl` that was not set, 0, would throw the platform.
"""

TIMESTEP, TIED = 1e-3, {"solref": "0.002 1", "solimp": "0.9999 0.9999 0.001"}
"""MuJoCo's step, s; struts' ends are tied as stiffly as that allows (two steps), and gravity separates them by 0.1
µm."""

LOOSE = 1e3  # Limit of effort and speed of joints without motor; readers of URDF require one


def joint_positions(
    geometry: HexapodGeometry, platform: Pose, joint_names: Sequence[str] = STRUT_NAMES
) -> dict[str, float]:
    """Return the position of every joint of :func:`urdf` at a pose."""
    alpha, beta, gamma = platform.angles()
    values = dict(zip(PLATFORM_JOINTS, (*platform.position, beta, alpha, gamma), strict=True))
    ends = platform.position + geometry.platform_joints @ platform.rotation.T
    lengths = strut_lengths(geometry, platform)
    along = (ends - geometry.base_joints) / lengths[:, None]
    x, y, z = np.einsum("nji,nj->in", foot_frames(geometry), along)
    for name, about_y, about_x in zip(joint_names, np.arctan2(x, z), -np.arcsin(np.clip(y, -1.0, 1.0)), strict=True):
        values |= {f"{name}_foot_1": about_y, f"{name}_foot_2": about_x}
    values |= dict(zip(joint_names, lengths, strict=True))
    return {name: float(value) for name, value in values.items()}


def urdf(geometry: HexapodGeometry, joint_names: Sequence[str] = STRUT_NAMES, ros2_control: bool = True) -> str:
    """Return the machine as URDF: links ``base``, ``work``, ``platform``, ``tool``, the struts', the named frames'."""
    robot = ET.Element("robot", name=geometry.name)
    _link(robot, "base", [_ball(joint) for joint in geometry.base_joints])
    for name, pose in geometry.work_frames.items():
        if name != BASE:
            _fixed(robot, name, pose)
    _platform(robot, geometry)
    for name, pose in geometry.tools.items():
        _fixed(robot, name, pose, "platform")
    for n, name in enumerate(joint_names):
        _strut(robot, geometry, n, name)
    if ros2_control:
        _control(robot, joint_names)
    return _text(robot)


def mjcf(geometry: HexapodGeometry, joint_names: Sequence[str] = STRUT_NAMES) -> str:
    """Return the machine as MJCF, loops closed: a free platform, each strut's end tied to it, drives on the slides.

    Sites ``base_joint_N``, ``strut_end_N`` and ``platform_joint_N`` mark both ends of a strut, ``tool`` and other
    names the tools. The reference position is home, and so is the keyframe ``home``, whose `ctrl` holds the machine
    there; a drive's `ctrl` is the length of its strut. Gravity acts along −z of the base.
    """
    root = ET.Element("mujoco", model=geometry.name)
    ET.SubElement(root, "compiler", angle="radian", autolimits="true")
    # Damping is integrated implicitly: explicit steps would have to be shorter than a light body's settling time.
    ET.SubElement(root, "option", integrator="implicitfast", timestep=_number(TIMESTEP))
    default = ET.SubElement(root, "default")
    # Struts begin and end inside each other's joints and the plate: nothing collides.
    ET.SubElement(default, "geom", density=_number(STEEL), contype="0", conaffinity="0")
    ET.SubElement(default, "equality", TIED)
    world = ET.SubElement(root, "worldbody")
    home = geometry.home
    platform = _body(world, "platform", home.position, home.rotation)
    ET.SubElement(platform, "freejoint", name="platform")
    _plate_geom(platform, geometry)
    for n, joint in enumerate(geometry.platform_joints):
        ET.SubElement(platform, "site", name=f"platform_joint_{n + 1}", pos=_numbers(joint))
    for name, pose in geometry.tools.items():
        _site(platform, name, pose)
    equality, actuator, keyframe = (ET.Element(name) for name in ("equality", "actuator", "keyframe"))
    lengths, push = strut_lengths(geometry, home), DAMPING * min(geometry.limits.speed, FASTEST)
    for n, (name, length) in enumerate(zip(joint_names, lengths, strict=True)):
        foot = _body(world, f"{name}_body", geometry.base_joints[n], foot_frames(geometry)[n])
        for hinge, axis in (("foot_1", "0 1 0"), ("foot_2", "1 0 0")):
            ET.SubElement(foot, "joint", name=f"{name}_{hinge}", axis=axis, armature=_number(HINGE_INERTIA))
        short = geometry.limits.stroke[n, 0]
        ET.SubElement(
            foot, "geom", type="cylinder", size=f"{STRUT_RADIUS * 1.5}", fromto=f"0 0 0 0 0 {_number(0.5 * short)}"
        )
        ET.SubElement(foot, "site", name=f"base_joint_{n + 1}")
        rod = _body(foot, f"{name}_rod", np.array([0.0, 0.0, length]), np.eye(3))
        reach = _numbers(geometry.limits.stroke[n])
        # MuJoCo adds a joint's position to the place of its body: `ref` makes it the length.
        slide = ET.SubElement(rod, "joint", name=name, type="slide", axis="0 0 1", ref=_number(length), range=reach)
        slide.attrib |= {"armature": _number(SCREW_INERTIA), "damping": _number(DAMPING)}
        ET.SubElement(rod, "geom", type="cylinder", size=f"{STRUT_RADIUS}", fromto=f"0 0 {_number(-0.6 * short)} 0 0 0")
        ET.SubElement(rod, "site", name=f"strut_end_{n + 1}")
        ends = f"strut_end_{n + 1}", f"platform_joint_{n + 1}"
        ET.SubElement(equality, "connect", name=f"{name}_end", site1=ends[0], site2=ends[1])
        drive = ET.SubElement(actuator, "position", name=name, joint=name, kp=_number(STIFFNESS), ctrlrange=reach)
        drive.set("forcerange", _numbers([-push, push]))
    at_home = [
        _numbers(home.position),
        _quaternion(home.rotation),
        *(f"0.0 0.0 {_number(length)}" for length in lengths),
    ]
    ET.SubElement(keyframe, "key", name="home", qpos=" ".join(at_home), ctrl=_numbers(lengths))
    root.extend((equality, actuator, keyframe))
    return _text(root)


def foot_frames(geometry: HexapodGeometry) -> np.ndarray:
    """Return a frame at each base joint, (6, 3, 3), its z along the strut at home: far from the hinges' singularity."""
    home = geometry.home
    along = home.position + geometry.platform_joints @ home.rotation.T - geometry.base_joints
    z = along / np.linalg.norm(along, axis=1)[:, None]
    least = np.eye(3)[np.abs(z).argmin(axis=1)]
    x = np.cross(least, z)
    x /= np.linalg.norm(x, axis=1)[:, None]
    return np.stack([x, np.cross(z, x), z], axis=2)


# ---- URDF ----


def _platform(robot: ET.Element, geometry: HexapodGeometry) -> None:
    """Add the six joints of the platform's pose, and the platform."""
    span = float(np.abs(geometry.home.position).max() + geometry.limits.stroke.max())
    parent = "base"
    for name, axis, kind in zip(PLATFORM_JOINTS, _AXES, ["prismatic"] * 3 + ["revolute"] * 3, strict=True):
        child = "platform" if name == PLATFORM_JOINTS[-1] else f"{name}_link"
        limit = span if kind == "prismatic" else np.pi
        _joint(robot, name, kind, (parent, child), axis=axis, limits=(-limit, limit))
        if child != "platform":
            _link(robot, child)
        parent = child
    middle, radius = _plate(geometry)
    plate = ("cylinder", {"radius": _number(radius), "length": _number(PLATE)}, middle)
    _link(robot, "platform", [plate, *(_ball(joint) for joint in geometry.platform_joints)])


def _strut(robot: ET.Element, geometry: HexapodGeometry, n: int, name: str) -> None:
    """Add a strut: two hinges at its foot, its body, and its rod, whose frame is the strut's end."""
    short, long = (float(value) for value in geometry.limits.stroke[n])
    at = Pose(geometry.base_joints[n], foot_frames(geometry)[n])
    hinge, body, rod = f"{name}_hinge", f"{name}_body", f"{name}_rod"
    half = (-0.5 * np.pi, 0.5 * np.pi)
    _joint(robot, f"{name}_foot_1", "revolute", ("base", hinge), at, _AXES[1], half)
    _link(robot, hinge)
    _joint(robot, f"{name}_foot_2", "revolute", (hinge, body), axis=_AXES[0], limits=half)
    _link(robot, body, [_rod(1.5 * STRUT_RADIUS, 0.5 * short, 0.25 * short)])
    _joint(robot, name, "prismatic", (body, rod), axis=_AXES[2], limits=(short, long), speed=geometry.limits.speed)
    _link(robot, rod, [_rod(STRUT_RADIUS, 0.6 * short, -0.3 * short)])


def _control(robot: ET.Element, joint_names: Sequence[str]) -> None:
    """Add ros2_control's block: the struts' positions, through topics.

    The hardware exits at a reading with velocities, which ours have, unless each joint has a state for them.
    """
    control = ET.SubElement(robot, "ros2_control", name=robot.get("name", ""), type="system")
    system = ET.SubElement(control, "hardware")
    ET.SubElement(system, "plugin").text = "joint_state_topic_hardware_interface/JointStateTopicSystem"
    for name, value in HARDWARE:
        ET.SubElement(system, "param", name=name).text = value
    for name in joint_names:
        joint = ET.SubElement(control, "joint", name=name)
        ET.SubElement(joint, "command_interface", name="position")
        for state in ("position", "velocity"):
            ET.SubElement(joint, "state_interface", name=state)


Shape = tuple[str, dict[str, str], np.ndarray]  # Kind, sizes and centre of the drawn bodies


def _ball(middle: np.ndarray) -> Shape:
    return "sphere", {"radius": _number(JOINT_RADIUS)}, middle


def _rod(radius: float, length: float, height: float) -> Shape:
    return "cylinder", {"radius": _number(radius), "length": _number(length)}, np.array([0.0, 0.0, height])


def _plate(geometry: HexapodGeometry) -> tuple[np.ndarray, float]:
    """Return middle and radius of a disc through the platform's joints."""
    joints = geometry.platform_joints
    middle = joints.mean(axis=0)
    return middle, float(np.linalg.norm((joints - middle)[:, :2], axis=1).mean())


def _link(robot: ET.Element, name: str, shapes: Sequence[Shape] = ()) -> None:
    link = ET.SubElement(robot, "link", name=name)
    for kind, sizes, middle in shapes:
        visual = ET.SubElement(link, "visual")
        ET.SubElement(visual, "origin", xyz=_numbers(middle))
        ET.SubElement(ET.SubElement(visual, "geometry"), kind, sizes)


def _fixed(robot: ET.Element, name: str, pose: Pose, parent: str = "base") -> None:
    _joint(robot, f"{name}_mount", "fixed", (parent, name), pose)
    _link(robot, name)


def _joint(
    robot: ET.Element,
    name: str,
    kind: str,
    links: tuple[str, str],
    at: Pose | None = None,
    axis: np.ndarray | None = None,
    limits: tuple[float, float] | None = None,
    speed: float = LOOSE,
) -> None:
    joint = ET.SubElement(robot, "joint", name=name, type=kind)
    if at is not None:
        ET.SubElement(joint, "origin", xyz=_numbers(at.position), rpy=_numbers(roll_pitch_yaw(at.rotation)))
    for role, link in zip(("parent", "child"), links, strict=True):
        ET.SubElement(joint, role, link=link)
    if axis is not None:
        ET.SubElement(joint, "axis", xyz=_numbers(axis))
    if limits is not None:
        low, high = (_number(value) for value in limits)
        ET.SubElement(joint, "limit", lower=low, upper=high, effort=_number(LOOSE), velocity=_number(min(speed, LOOSE)))


# ---- MJCF ----


def _body(parent: ET.Element, name: str, position: np.ndarray, rotation: np.ndarray) -> ET.Element:
    return ET.SubElement(parent, "body", name=name, pos=_numbers(position), quat=_quaternion(rotation))


def _site(parent: ET.Element, name: str, pose: Pose) -> None:
    ET.SubElement(parent, "site", name=name, pos=_numbers(pose.position), quat=_quaternion(pose.rotation))


def _plate_geom(platform: ET.Element, geometry: HexapodGeometry) -> None:
    middle, radius = _plate(geometry)
    size = f"{_number(radius)} {_number(0.5 * PLATE)}"
    ET.SubElement(platform, "geom", type="cylinder", size=size, pos=_numbers(middle))


def _quaternion(rotation: np.ndarray) -> str:
    x, y, z, w = quaternion_of(rotation)
    return _numbers([w, x, y, z])


# ---- both ----


def _number(value: float) -> str:
    return repr(float(value))


def _numbers(values: Sequence[float] | np.ndarray) -> str:
    return " ".join(_number(value) for value in values)


def _text(root: ET.Element) -> str:
    ET.indent(root)
    return ET.tostring(root, encoding="unicode", xml_declaration=True) + "\n"
