"""Descriptions of the machine for robot programs: URDF for robot_state_publisher and ros2_control, MJCF for MuJoCo.

URDF describes trees only, and a hexapod has closed loops. So the tree has seven branches: the platform, on six joints
that give its pose, and six struts, each on two crossed hinges at its base joint and with a slide whose position is its
length. :func:`joint_positions` gives all of them for one pose, so that each strut ends where its platform joint is.
MJCF closes the loops by constraints.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from xml.sax.saxutils import escape

import numpy as np

from ..core.batch import quaternion_of
from ..pose import Pose, roll_pitch_yaw
from .geometry import BASE, STRUT_NAMES, HexapodGeometry
from .kinematics import strut_lengths

# In their order from base to platform: R = Ry(β)·Rx(α)·Rz(γ) (Song et al., T_BASE^TOP)
PLATFORM_JOINTS = ("platform_x", "platform_y", "platform_z", "platform_beta", "platform_alpha", "platform_gamma")
X, Y, Z = "1.0 0.0 0.0", "0.0 1.0 0.0", "0.0 0.0 1.0"
STRUT_RADIUS, JOINT_RADIUS, PLATE = 0.01, 0.018, 0.01  # Drawn sizes, m: struts, joints, and the platform's thickness
# Parameters of ros2_control's JointStateTopicSystem: the last one makes it send commands near the readings too. It
# exits at a reading with velocities, which ours have, unless each joint has a state for them
TOPICS = """
      <plugin>joint_state_topic_hardware_interface/JointStateTopicSystem</plugin>
      <param name="joint_commands_topic">strut_setpoints</param>
      <param name="joint_states_topic">nominal_strut_states</param>
      <param name="trigger_joint_command_threshold">-1</param>"""
MOCK = """
      <plugin>mock_components/GenericSystem</plugin>"""
# Density of the drawn bodies, kg/m³, in MJCF; a machine file has no masses. A platform of 0.35 m weighs 7 kg
STEEL = 7850.0
# Armature of a strut's slide, kg, 1.3e-4 kg m² turning on a screw of 5 mm lead; and of a hinge at its foot, kg m².
# Light bodies with stiff drives need short steps: the armature gives the slides inertia without weight
SCREW_INERTIA, HINGE_INERTIA = 200.0, 0.01
# Of a strut's drive: N/m, a steel rod of 20 mm over 0.6 m; N s/m, critical with :data:`SCREW_INERTIA`
STIFFNESS, DAMPING = 1e8, 2.8e5
# Speed, m/s, to which the damping holds a strut under its drive's largest force, where the machine's limit is higher.
# Without a limit of force, a `ctrl` that was not set, 0, would throw the platform
FASTEST = 1.0
# MuJoCo's step, s; struts' ends are tied as stiffly as that allows (two steps): gravity separates them by 0.1 µm
TIMESTEP, TIED = 1e-3, 'solref="0.002 1" solimp="0.9999 0.9999 0.001"'
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


def urdf(
    geometry: HexapodGeometry,
    joint_names: Sequence[str] = STRUT_NAMES,
    ros2_control: bool = True,
    hardware: str = TOPICS,
) -> str:
    """Return the machine as URDF: links ``base``, ``work``, ``platform``, ``tool``, the struts', the named frames'.

    ros2_control's block moves the struts through topics, or simulates drives at home with the hardware :data:`MOCK`.
    """
    span, half = float(np.abs(geometry.home.position).max() + geometry.limits.stroke.max()), 0.5 * np.pi
    parts = [_link("base", map(_ball, geometry.base_joints))]
    for name, pose in geometry.work_frames.items():
        if name != BASE:
            parts += [_joint(f"{name}_mount", "fixed", ("base", name), pose), _link(name)]
    parent = "base"
    for name, axis, limit in zip(PLATFORM_JOINTS, (X, Y, Z, Y, X, Z), [span] * 3 + [np.pi] * 3, strict=True):
        child = "platform" if name == PLATFORM_JOINTS[-1] else f"{name}_link"
        kind = "prismatic" if limit == span else "revolute"
        parts.append(_joint(name, kind, (parent, child), axis=axis, limits=(-limit, limit)))
        parts += [_link(child)] * (child != "platform")
        parent = child
    middle, radius = _plate(geometry)
    parts.append(_link("platform", [_cylinder(radius, PLATE, middle), *map(_ball, geometry.platform_joints)]))
    for name, pose in geometry.tools.items():
        parts += [_joint(f"{name}_mount", "fixed", ("platform", name), pose), _link(name)]
    feet = map(Pose, geometry.base_joints, foot_frames(geometry))
    for name, foot, (short, long) in zip(joint_names, feet, geometry.limits.stroke, strict=True):
        hinge, body, rod = f"{name}_hinge", f"{name}_body", f"{name}_rod"
        parts += [_joint(f"{name}_foot_1", "revolute", ("base", hinge), foot, Y, (-half, half)), _link(hinge)]
        parts.append(_joint(f"{name}_foot_2", "revolute", (hinge, body), axis=X, limits=(-half, half)))
        parts.append(_link(body, [_cylinder(1.5 * STRUT_RADIUS, 0.5 * short, [0.0, 0.0, 0.25 * short])]))
        parts.append(_joint(name, "prismatic", (body, rod), axis=Z, limits=(short, long), speed=geometry.limits.speed))
        parts.append(_link(rod, [_cylinder(STRUT_RADIUS, 0.6 * short, [0.0, 0.0, -0.3 * short])]))
    if ros2_control:
        parts.append(_control(geometry, joint_names, hardware))
    body = "".join(parts)
    return f'{HEAD}<robot name="{_text(geometry.name)}">{body}\n</robot>\n'


def _control(geometry: HexapodGeometry, joint_names: Sequence[str], hardware: str) -> str:
    """Return ros2_control's block: commands and states of the struts."""
    joints = ""
    for name, length in zip(joint_names, strut_lengths(geometry, geometry.home), strict=True):
        states = """
      <state_interface name="position" />
      <state_interface name="velocity" />"""
        if hardware == MOCK:
            states = f"""
      <state_interface name="position">
        <param name="initial_value">{_number(length)}</param>
      </state_interface>"""
        joints += f"""
    <joint name="{_text(name)}">
      <command_interface name="position" />{states}
    </joint>"""
    return f"""
  <ros2_control name="{_text(geometry.name)}" type="system">
    <hardware>{hardware}
    </hardware>{joints}
  </ros2_control>"""


def mjcf(geometry: HexapodGeometry, joint_names: Sequence[str] = STRUT_NAMES) -> str:
    """Return the machine as MJCF, loops closed: a free platform, each strut's end tied to it, drives on the slides.

    Sites ``base_joint_N``, ``strut_end_N`` and ``platform_joint_N`` mark both ends of a strut, ``tool`` and other
    names the tools. The reference position is home, and so is the keyframe ``home``, whose `ctrl` holds the machine
    there; a drive's `ctrl` is the length of its strut. Gravity acts along −z of the base.
    """
    home, (middle, radius) = geometry.home, _plate(geometry)
    lengths, push = strut_lengths(geometry, home), DAMPING * min(geometry.limits.speed, FASTEST)
    sites = "".join(
        f"""
      <site name="platform_joint_{n}" pos="{_numbers(joint)}" />"""
        for n, joint in enumerate(geometry.platform_joints, 1)
    )
    for name, pose in geometry.tools.items():
        sites += f"""
      <site name="{name}" {_place(pose.position, pose.rotation)} />"""
    struts = ties = drives = ""
    force = _numbers([-push, push])
    feet, at_rest = foot_frames(geometry), joint_positions(geometry, home)
    bent = [at_rest[f"{name}_foot_2"] for name in STRUT_NAMES]
    rows = zip(joint_names, lengths, geometry.limits.stroke, geometry.base_joints, feet, bent, strict=True)
    for n, (given, length, stroke, joint, foot, angle) in enumerate(rows, 1):
        name, short, reach = _text(given), stroke[0], _numbers(stroke)
        # MuJoCo adds a joint's position to the place of its body: `ref` makes it the length, or the angle
        c, s = np.cos(angle), np.sin(angle)
        struts += f"""
    <body name="{name}_body" {_place(joint, foot @ np.array([[1.0, 0.0, 0.0], [0.0, c, -s], [0.0, s, c]]))}>
      <joint name="{name}_foot_1" axis="{_numbers([0.0, c, -s])}" armature="{HINGE_INERTIA}" />
      <joint name="{name}_foot_2" axis="1 0 0" ref="{_number(angle)}" armature="{HINGE_INERTIA}" />
      <geom type="cylinder" size="{STRUT_RADIUS * 1.5}" fromto="0 0 0 0 0 {_number(0.5 * short)}" />
      <site name="base_joint_{n}" />
      <body name="{name}_rod" {_place([0.0, 0.0, length], np.eye(3))}>
        <joint name="{name}" type="slide" axis="0 0 1" ref="{_number(length)}" range="{reach}" \
armature="{SCREW_INERTIA}" damping="{DAMPING}" />
        <geom type="cylinder" size="{STRUT_RADIUS}" fromto="0 0 {_number(-0.6 * short)} 0 0 0" />
        <site name="strut_end_{n}" />
      </body>
    </body>"""
        ties += f"""
    <connect name="{name}_end" site1="strut_end_{n}" site2="platform_joint_{n}" />"""
        drives += f"""
    <position name="{name}" joint="{name}" kp="{STIFFNESS}" ctrlrange="{reach}" forcerange="{force}" />"""
    at_home = f"{_numbers(home.position)} {_quaternion(home.rotation)}"
    at_home += "".join(f" 0.0 {_number(angle)} {_number(length)}" for angle, length in zip(bent, lengths, strict=True))
    # Damping is integrated implicitly: explicit steps would have to be shorter than a light body's settling time.
    # Struts begin and end inside each other's joints and the plate: nothing collides
    return f"""\
{HEAD}<mujoco model="{_text(geometry.name)}">
  <compiler angle="radian" autolimits="true" />
  <option integrator="implicitfast" timestep="{TIMESTEP}" />
  <default>
    <geom density="{STEEL}" contype="0" conaffinity="0" />
    <equality {TIED} />
  </default>
  <worldbody>
    <body name="platform" {_place(home.position, home.rotation)}>
      <freejoint name="platform" />
      <geom type="cylinder" size="{_numbers([radius, 0.5 * PLATE])}" pos="{_numbers(middle)}" />{sites}
    </body>{struts}
  </worldbody>
  <equality>{ties}
  </equality>
  <actuator>{drives}
  </actuator>
  <keyframe>
    <key name="home" qpos="{at_home}" ctrl="{_numbers(lengths)}" />
  </keyframe>
</mujoco>
"""


def foot_frames(geometry: HexapodGeometry) -> np.ndarray:
    """Return a frame at each base joint, (6, 3, 3): y along the first hinge, z nearest to the strut at home.

    The hinge is the cardan joint's axis in the base where the geometry states it, else one across the strut, far from
    the hinges' singularity.
    """
    home = geometry.home
    along = home.position + geometry.platform_joints @ home.rotation.T - geometry.base_joints
    z = along / np.linalg.norm(along, axis=1)[:, None]
    if geometry.base_axes is None:
        x = np.cross(np.eye(3)[np.abs(z).argmin(axis=1)], z)
    else:
        x = np.cross(geometry.base_axes, z)
    x /= np.linalg.norm(x, axis=1)[:, None]
    y = np.cross(z, x) if geometry.base_axes is None else geometry.base_axes
    return np.stack([x, y, np.cross(x, y)], axis=2)


HEAD = "<?xml version='1.0' encoding='utf-8'?>\n"


def _ball(middle: np.ndarray) -> str:
    return _visual(f'sphere radius="{JOINT_RADIUS}"', middle)


def _cylinder(radius: float, length: float, middle: Sequence[float] | np.ndarray) -> str:
    return _visual(f'cylinder radius="{_number(radius)}" length="{_number(length)}"', middle)


def _visual(shape: str, middle: Sequence[float] | np.ndarray) -> str:
    return f"""
    <visual>
      <origin xyz="{_numbers(middle)}" />
      <geometry>
        <{shape} />
      </geometry>
    </visual>"""


def _link(name: str, visuals: Iterable[str] = ()) -> str:
    drawn = "".join(visuals)
    return f'\n  <link name="{_text(name)}"' + (f">{drawn}\n  </link>" if drawn else " />")


def _joint(
    name: str,
    kind: str,
    links: tuple[str, str],
    at: Pose | None = None,
    axis: str = "",
    limits: tuple[float, float] = (0.0, 0.0),
    speed: float = LOOSE,
) -> str:
    origin = limit = ""
    if at is not None:
        origin = f"""
    <origin xyz="{_numbers(at.position)}" rpy="{_numbers(roll_pitch_yaw(at.rotation))}" />"""
    if axis:
        low, high = map(_number, limits)
        limit = f"""
    <axis xyz="{axis}" />
    <limit lower="{low}" upper="{high}" effort="{LOOSE}" velocity="{_number(min(speed, LOOSE))}" />"""
    return f"""
  <joint name="{_text(name)}" type="{kind}">{origin}
    <parent link="{_text(links[0])}" />
    <child link="{_text(links[1])}" />{limit}
  </joint>"""


def _plate(geometry: HexapodGeometry) -> tuple[np.ndarray, float]:
    """Return middle and radius of a disc through the platform's joints."""
    joints = geometry.platform_joints
    middle = joints.mean(axis=0)
    return middle, float(np.linalg.norm((joints - middle)[:, :2], axis=1).mean())


def _place(position: Sequence[float] | np.ndarray, rotation: np.ndarray) -> str:
    return f'pos="{_numbers(position)}" quat="{_quaternion(rotation)}"'


def _quaternion(rotation: np.ndarray) -> str:
    x, y, z, w = quaternion_of(rotation)
    return _numbers([w, x, y, z])


def _text(name: str) -> str:
    return escape(name, {'"': "&quot;"})


def _number(value: float) -> str:
    return repr(float(value))


def _numbers(values: Sequence[float] | np.ndarray) -> str:
    return " ".join(map(_number, values))
