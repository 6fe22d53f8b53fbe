"""URDF and MJCF of machines, each read by a program of its own kind.

Truth: the closed form of a strut's ends, on foreign machines and at random poses. URDF is walked by a reader of the
test's own, in the words of its specification (each joint: origin, then a motion about or along its axis), MJCF by
MuJoCo.
"""

from __future__ import annotations

import xml.etree.ElementTree as ET
from pathlib import Path

import numpy as np
import pytest
import yaml
from foreign_machines import machines, with_frames
from scipy.spatial.transform import Rotation

from hexapod_comp.cli import main
from hexapod_comp.export.robot_description import joint_positions, mjcf, urdf
from hexapod_comp.formats.paths import config_file
from hexapod_comp.machine.geometry import STRUT_NAMES, HexapodGeometry, load_geometry
from hexapod_comp.machine.kinematics import strut_lengths
from hexapod_comp.pose import Pose

SAME = 1e-9
"""m; angles of a URDF are rounded to doubles, on machines of half a metre 1e-16 m."""


def poses(geometry: HexapodGeometry, count: int = 20) -> list[Pose]:
    """Return home and poses around it: as far as a fifth of the stroke, and some 10°."""
    rng, home = np.random.default_rng(8), geometry.home
    far = 0.2 * np.abs(geometry.limits.stroke - strut_lengths(geometry, home)[:, None]).min()
    shifts, turns = rng.uniform(-far, far, (count, 3)), Rotation.from_rotvec(rng.uniform(-far, far, (count, 3)))
    return [home, *(Pose(home.position + s, t @ home.rotation) for s, t in zip(shifts, turns.as_matrix(), strict=True))]


def transform(position: np.ndarray, rotation: np.ndarray) -> np.ndarray:
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = rotation, position
    return matrix


def links(robot: ET.Element, positions: dict[str, float]) -> dict[str, np.ndarray]:
    """Return where each link is in ``base``, (4, 4), walking the tree as the URDF specification has it."""
    placed, joints = {"base": np.eye(4)}, robot.findall("joint")
    while joints:
        joint = next(j for j in joints if j.find("parent").get("link") in placed)
        joints.remove(joint)
        origin, motion = np.eye(4), np.eye(4)
        if (at := joint.find("origin")) is not None:
            xyz, rpy = (np.array(at.get(key).split(), dtype=float) for key in ("xyz", "rpy"))
            origin = transform(xyz, Rotation.from_euler("xyz", rpy).as_matrix())
        if joint.get("type") != "fixed":
            axis, value = np.array(joint.find("axis").get("xyz").split(), dtype=float), positions[joint.get("name")]
            low, high = (float(joint.find("limit").get(key)) for key in ("lower", "upper"))
            assert low <= value <= high, joint.get("name")
            if joint.get("type") == "prismatic":
                motion = transform(value * axis, np.eye(3))
            else:
                motion = transform(np.zeros(3), Rotation.from_rotvec(value * axis).as_matrix())
        placed[joint.find("child").get("link")] = placed[joint.find("parent").get("link")] @ origin @ motion
    return placed


@pytest.mark.parametrize("name", machines())
def test_urdf_places_struts_platform_tool_and_work(name: str, tmp_path: Path):
    geometry = load_geometry(machines()[name].write(tmp_path / "machine.yaml"))
    robot = ET.fromstring(urdf(geometry).encode())
    assert {link.get("name") for link in robot.findall("link")} == set(
        links(robot, joint_positions(geometry, geometry.home))
    )
    for pose in poses(geometry):
        placed = links(robot, joint_positions(geometry, pose))
        np.testing.assert_allclose(placed["platform"], transform(pose.position, pose.rotation), rtol=0, atol=SAME)
        ends = pose.position + geometry.platform_joints @ pose.rotation.T
        rods = np.array([placed[f"{strut}_rod"][:3, 3] for strut in STRUT_NAMES])
        np.testing.assert_allclose(rods, ends, rtol=0, atol=SAME)
        tool = pose @ geometry.tool
        np.testing.assert_allclose(placed["tool"], transform(tool.position, tool.rotation), rtol=0, atol=SAME)
        work = transform(geometry.work.position, geometry.work.rotation)
        np.testing.assert_allclose(placed["work"], work, rtol=0, atol=SAME)


@pytest.mark.parametrize("name", machines())
def test_mujoco_agrees_and_closes_the_loops(name: str, tmp_path: Path):
    mujoco = pytest.importorskip("mujoco")
    geometry = load_geometry(machines()[name].write(tmp_path / "machine.yaml"))
    model = mujoco.MjModel.from_xml_string(mjcf(geometry))
    data = mujoco.MjData(model)
    for pose in poses(geometry):
        quaternion = Rotation.from_matrix(pose.rotation).as_quat(canonical=True)
        data.joint("platform").qpos[:] = [*pose.position, quaternion[3], *quaternion[:3]]
        for joint, value in joint_positions(geometry, pose).items():
            if not joint.startswith("platform"):
                data.joint(joint).qpos[:] = value
        mujoco.mj_forward(model, data)
        for n in range(1, 7):
            end, joint = (data.site(f"{what}_{n}").xpos for what in ("strut_end", "platform_joint"))
            np.testing.assert_allclose(end, joint, rtol=0, atol=SAME)
            length = np.linalg.norm(joint - data.site(f"base_joint_{n}").xpos)
            assert abs(length - data.joint(f"strut_{n}").qpos[0]) < SAME
        tool = pose @ geometry.tool
        np.testing.assert_allclose(data.site("tool").xpos, tool.position, rtol=0, atol=SAME)
        tied = data.efc_type == mujoco.mjtConstraint.mjCNSTR_EQUALITY
        assert tied.sum() == 18
        assert np.abs(data.efc_pos[tied]).max() < SAME


@pytest.mark.parametrize("name", ["framed", "hanging", "inches", "mirror"])
def test_named_tools_and_work_frames_are_there(name: str, tmp_path: Path):
    """Truth: the zoo's own frames; the tools' poses in the platform are where MJCF's sites stand."""
    machine = with_frames(name)
    geometry = load_geometry(machine.write(tmp_path / "machine.yaml"))
    placed = links(ET.fromstring(urdf(geometry).encode()), joint_positions(geometry, geometry.home))
    for tool, frame in machine.tools.items():
        in_base = transform(geometry.home.position, np.eye(3)) @ transform(np.array(frame.position), frame.matrix)
        np.testing.assert_allclose(placed[tool], in_base, rtol=0, atol=SAME)
        site = ET.fromstring(mjcf(geometry).encode()).find(f".//site[@name='{tool}']")
        np.testing.assert_allclose(np.array(site.get("pos").split(), dtype=float), frame.position, rtol=0, atol=SAME)
    fixture = machine.work_frames["fixture"]
    wanted = transform(np.array(fixture.position), fixture.matrix)
    np.testing.assert_allclose(placed["fixture"], wanted, rtol=0, atol=SAME)


def test_export_writes_both_without_a_model(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    files = [str(tmp_path / name) for name in ("machine.urdf", "machine.xml")]
    assert main(["export", "--machine", "example_6_6.yaml", "--urdf", files[0], "--mjcf", files[1]]) == 0
    assert f"written: {', '.join(files)}" in capsys.readouterr().out
    robot, mujoco = (ET.parse(file).getroot() for file in files)
    assert [joint.get("name") for joint in robot.find("ros2_control").findall("joint")] == list(STRUT_NAMES)
    topics = {param.get("name"): param.text for param in robot.find("ros2_control").iter("param")}
    assert topics["joint_commands_topic"] == "strut_setpoints"
    assert topics["joint_states_topic"] == "nominal_strut_states"  # measured ones would be corrected once more
    for joint in robot.find("ros2_control").findall("joint"):  # JointStateTopicSystem ends at what has no interface
        assert [state.get("name") for state in joint.findall("state_interface")] == ["position", "velocity"]
    controllers = yaml.safe_load(config_file("ros2_control.yaml").read_text())
    for name in ("joint_trajectory_controller", "forward_command_controller"):
        assert name in controllers["controller_manager"]["ros__parameters"]
        assert controllers[name]["ros__parameters"]["joints"] == list(STRUT_NAMES)
    assert [connect.get("name") for connect in mujoco.find("equality")] == [f"{strut}_end" for strut in STRUT_NAMES]


def test_a_machine_that_is_drawn_becomes_c_too(tmp_path: Path):
    assert main(["export", "--model", "random:7", "--c", str(tmp_path)]) == 0
    assert "hexapod_model.h" in {path.name for path in tmp_path.iterdir()}
