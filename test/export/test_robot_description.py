"""URDF and MJCF of machines, both read by MuJoCo, which also simulates the MJCF.

The truth is the closed form of a strut's ends, on foreign machines and at random poses.
"""

from __future__ import annotations

import os
import re
import xml.etree.ElementTree as ET
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from foreign_machines import machines, with_frames
from helpers import ALL_TESTS
from scipy.spatial.transform import Rotation

from hexapod_comp.cli import main
from hexapod_comp.machine.geometry import STRUT_NAMES, HexapodGeometry, load_geometry
from hexapod_comp.machine.kinematics import strut_lengths
from hexapod_comp.machine.robot_description import MOCK, joint_positions, mjcf, urdf
from hexapod_comp.pose import Pose
from hexapod_comp.virtual.physics import find_mujoco

FOREIGN = list(machines()) if ALL_TESTS else ["framed", "hanging", "inches"]
MACHINES = ["example_6_6", "positioning_unit", *(FOREIGN if ALL_TESTS else ["hanging"])]

SAME = 1e-9  # m; both are rounded to doubles, 1e-16 m on machines of half a metre


def poses(geometry: HexapodGeometry, count: int = 20, share: float = 0.2) -> list[Pose]:
    """Return home and poses around it, up to a share of the stroke and of 1 rad per metre of it."""
    rng, home = np.random.default_rng(8), geometry.home
    far = share * np.abs(geometry.limits.stroke - strut_lengths(geometry, home)[:, None]).min()
    shifts, turns = rng.uniform(-far, far, (count, 3)), Rotation.from_rotvec(rng.uniform(-far, far, (count, 3)))
    return [home, *(Pose(home.position + s, t @ home.rotation) for s, t in zip(shifts, turns.as_matrix(), strict=True))]


def shipped_or_foreign(name: str, folder: Path) -> HexapodGeometry:
    return load_geometry(machines()[name].write(folder / "machine.yaml") if name in machines() else name)


@pytest.fixture
def mujoco() -> ModuleType:
    pytest.importorskip("mujoco", reason="no mujoco-core (make test: from Python 3.11 on)")
    return find_mujoco()


@pytest.mark.parametrize("name", FOREIGN)
def test_mujoco_reads_the_urdf(name: str, mujoco: ModuleType, tmp_path: Path):
    """MuJoCo's reader finds strut ends and named frames where the closed form and the zoo have them.

    It needs masses, which a URDF without inertia lacks, and an option to keep fixed links. The named tools are also
    sites of the MJCF.
    """
    machine = with_frames(name)
    geometry = load_geometry(machine.write(tmp_path / "machine.yaml"))
    told = '<compiler discardvisual="false" fusestatic="false" boundmass="0.001" boundinertia="0.001"/>'
    model = mujoco.MjModel.from_xml_string(urdf(geometry).replace("</robot>", f"<mujoco>{told}</mujoco></robot>"))
    data = mujoco.MjData(model)
    for pose in poses(geometry):
        for joint, value in joint_positions(geometry, pose).items():
            data.joint(joint).qpos[0] = value
            low, high = model.joint(joint).range
            assert low <= value <= high or not model.joint(joint).limited, joint
        mujoco.mj_kinematics(model, data)
        ends = pose.position + geometry.platform_joints @ pose.rotation.T
        rods = np.array([data.body(f"{strut}_rod").xpos for strut in STRUT_NAMES])
        np.testing.assert_allclose(rods, ends, rtol=0, atol=SAME)
        frames = {"platform": pose, "tool": pose @ geometry.tool, "work": geometry.work}
        frames |= {tool: pose @ Pose(frame.position, frame.matrix) for tool, frame in machine.tools.items()}
        frames |= {work: Pose(frame.position, frame.matrix) for work, frame in machine.work_frames.items()}
        for link, wanted in frames.items():
            np.testing.assert_allclose(data.body(link).xpos, wanted.position, rtol=0, atol=SAME)
            np.testing.assert_allclose(data.body(link).xmat.reshape(3, 3), wanted.rotation, rtol=0, atol=SAME)

    for tool, frame in machine.tools.items():
        site = ET.fromstring(mjcf(geometry).encode()).find(f".//site[@name='{tool}']")
        np.testing.assert_allclose(np.array(site.get("pos").split(), dtype=float), frame.position, rtol=0, atol=SAME)


def off_pose(mujoco: ModuleType, data: Any, pose: Pose) -> tuple[float, float]:
    """Return the distance and angle of MuJoCo's platform from a pose, m and rad."""
    body = data.body("platform")
    turn = Rotation.from_matrix(body.xmat.reshape(3, 3)) * Rotation.from_matrix(pose.rotation).inv()
    return float(np.abs(body.xpos - pose.position).max()), float(turn.magnitude())


@pytest.mark.parametrize("name", MACHINES)
def test_mujoco_stands_and_moves(name: str, mujoco: ModuleType, tmp_path: Path):
    """With the lengths of inverse kinematics MuJoCo's platform reaches a pose, and then stays at home for 10 s under
    gravity.

    Tolerance: the sag of six drives of 1e8 N/m. The heaviest machine, 330 kg, sags by 6 µm, the others, below 30 kg, by
    less than 2 µm. The struts' ends part by less than 0.1 µm. After half a second the platform stays within 1 µm.
    """
    geometry = shipped_or_foreign(name, tmp_path)
    model = mujoco.MjModel.from_xml_string(mjcf(geometry))
    data = mujoco.MjData(model)
    allowed = max(2e-6, 2e-8 * model.body_mass.sum())
    assert allowed == 2e-6 or name == "mirror"
    mujoco.mj_resetDataKeyframe(model, data, model.key("home").id)
    for goal, seconds in zip(poses(geometry, 1, 0.1)[::-1], (0.5, 10.0), strict=True):
        data.ctrl[:] = strut_lengths(geometry, goal)
        steps, places = round(seconds / model.opt.timestep), []
        for _ in range(steps):
            mujoco.mj_step(model, data)
            places.append(data.body("platform").xpos.copy())
        place, turn = off_pose(mujoco, data, goal)
        assert place < allowed
        assert turn < 5.0 * allowed  # joints of these machines are 0.06 to 0.5 m from the platform's centre
        assert np.abs(data.efc_pos[data.efc_type == mujoco.mjtConstraint.mjCNSTR_EQUALITY]).max() < 1e-7
    assert np.linalg.norm(np.array(places[steps // 20 :]) - places[-1], axis=1).max() < 1e-6
    assert data.time == pytest.approx(10.5)
    assert sum(warning.number for warning in data.warning) == 0


@pytest.mark.parametrize("name", ["paper", "hanging"])
def test_who_forgets_the_drives_input_throws_nothing(name: str, mujoco: ModuleType, tmp_path: Path):
    """Without input MuJoCo's `ctrl` is 0: the struts shorten to their stops, and not faster than their limit."""
    geometry = shipped_or_foreign(name, tmp_path)
    model = mujoco.MjModel.from_xml_string(mjcf(geometry))
    data, fastest = mujoco.MjData(model), 0.0
    for _ in range(300):
        mujoco.mj_step(model, data)
        fastest = max(fastest, max(abs(data.joint(strut).qvel[0]) for strut in STRUT_NAMES))
    assert sum(warning.number for warning in data.warning) == 0
    assert 0.01 < fastest < 1.05 * min(geometry.limits.speed, 1.0)  # the weight adds a little


@pytest.mark.parametrize("name", MACHINES)
def test_mujoco_agrees_and_closes_the_loops(name: str, mujoco: ModuleType, tmp_path: Path):
    geometry = shipped_or_foreign(name, tmp_path)
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


def test_export_writes_both_without_a_model(tmp_path: Path):
    files = [str(tmp_path / name) for name in ("machine.urdf", "machine.xml")]
    assert main(["export", "--machine", "example_6_6.yaml", "--urdf", files[0], "--mjcf", files[1]]) == 0
    robot, mujoco = (ET.parse(file).getroot() for file in files)
    assert [joint.get("name") for joint in robot.find("ros2_control").findall("joint")] == list(STRUT_NAMES)
    topics = {param.get("name"): param.text for param in robot.find("ros2_control").iter("param")}
    assert topics["joint_commands_topic"] == "strut_setpoints"
    assert topics["joint_states_topic"] == "nominal_strut_states"  # measured ones would be corrected twice
    # JointStateTopicSystem fails for a joint without interfaces
    for joint in robot.find("ros2_control").findall("joint"):
        assert [state.get("name") for state in joint.findall("state_interface")] == ["position", "velocity"]
    assert [connect.get("name") for connect in mujoco.find("equality")] == [f"{strut}_end" for strut in STRUT_NAMES]


def test_descriptions_are_as_recorded():
    """A person has read the file: drawn sizes, inertias, drives and limits. ``RENEW_REPORTS=1`` writes it.

    The URDF's struts 2 to 6, which are made like strut 1, are left out; MuJoCo finds where they are."""
    geometry, record = load_geometry("example_6_6"), Path(__file__).with_name("descriptions.txt")
    robot, mock = (urdf(geometry, **more).partition("  <ros2_control") for more in ({}, {"hardware": MOCK}))
    assert robot[0] == mock[0]
    whole = "".join(robot + mock[1:]) + mjcf(geometry)
    # One line for each link, joint and body; numbers to the nanometre, without a minus before zero
    lines = re.sub(r"\n\s*\n", "\n", re.sub(r"\n {4,}|</(link|joint|body|visual|geometry)>", "", whole))
    lines = re.sub(r'  <(joint|link) name="strut_[2-6].*\n', "", lines)
    pattern = r"(?<=[\" ])-?\d+\.\d+(e-\d+)?"
    text = re.sub(pattern, lambda number: f"{round(float(number[0]), 9) + 0.0:.12g}", lines)
    if os.environ.get("RENEW_REPORTS"):
        record.write_text(text, encoding="utf-8")
    assert text == record.read_text(encoding="utf-8")
