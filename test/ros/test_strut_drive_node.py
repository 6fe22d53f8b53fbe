"""The strut-drive node: a realistic machine, as seen through its topics."""

from __future__ import annotations

import sys

import numpy as np
import pytest
from node_helpers import HOME, Bench, Rig, closed_form_lengths, equal, geometry_file, model_file, near
from node_stories import ERROR, OK, WARN, change, play, says, setting, tell
from sensor_msgs.msg import JointState

from hexapod_comp.machine.geometry import STRUT_NAMES
from hexapod_comp.pose import Pose
from hexapod_comp.ros.messages import message_pose, nanoseconds_of
from hexapod_comp.virtual.machine import Faults
from hexapod_comp.virtual.named import find_model

NODE = "strut_drive"
EXACT = {"truth_file": "ideal", "step": 0.0, "encoder_resolution": 0.0, "encoder_noise": 0.0}
"""Parameters of a machine without errors, whose struts are where they were commanded."""

TARGET = near(HOME, (0.0003, -0.0002, 0.0005))
AT_HOME, AT_TARGET = closed_form_lengths(HOME), closed_form_lengths(TARGET)
ROUNDING = 1e-12


def command(rig: Bench, lengths: np.ndarray, names: tuple[str, ...] = STRUT_NAMES) -> None:
    rig.publish("strut_commands", JointState(name=list(names), position=[float(value) for value in lengths]))


def newest(rig: Bench) -> np.ndarray:
    return np.array(rig.seen["strut_states"][-1].position)


def until_at(rig: Bench, lengths: np.ndarray, tolerance: float = ROUNDING) -> None:
    rig.until(lambda: np.abs(newest(rig) - lengths).max() <= tolerance, f"the struts to reach {lengths}")


def true_pose(rig: Bench) -> Pose:
    return message_pose(rig.seen["tool_pose_true"][-1])


def until_tool_at(rig: Bench, place: np.ndarray, tolerance: float = 1e-11) -> None:
    rig.until(lambda: np.abs(true_pose(rig).position - place).max() < tolerance, f"the tool to be at {place}")


@pytest.fixture
def machine(rig: Rig) -> Rig:
    """Provide a rig with an exact drive that has published."""
    rig.drive(**EXACT)
    rig.until(lambda: rig.seen["strut_states"] and rig.seen["tool_pose_true"], "readings")
    return rig


# ---- what it publishes ----


def test_readings_are_named_stamped_and_in_metres(machine):
    """At the start it is at home: 509.192 mm (the paper's Table 2, row 1), by the closed form."""
    states, true = machine.seen["strut_states"][0], machine.seen["tool_pose_true"][0]
    assert (list(states.name), list(states.velocity)) == (list(STRUT_NAMES), [0.0] * 6)
    equal(states.position, AT_HOME)
    assert true.header.frame_id == "base"
    equal(message_pose(true).position, HOME.position)
    for message in (states, true):
        assert 0 <= nanoseconds_of(machine.now()) - nanoseconds_of(message.header.stamp) < 10**8


def test_moves_where_it_is_told_with_speeds_between(machine):
    """Names may have any order; the true tool ends at the closed form, within Newton's 1e-13 m."""
    order = [5, 3, 1, 0, 2, 4]
    command(machine, AT_TARGET[order], tuple(STRUT_NAMES[i] for i in order))
    until_at(machine, AT_TARGET)
    until_tool_at(machine, TARGET.position)
    speeds = np.array([message.velocity for message in machine.seen["strut_states"]])
    assert (np.abs(speeds).max(axis=0) > 0.0).all()
    assert (np.sign(np.sum(speeds, axis=0)) == np.sign(AT_TARGET - AT_HOME)).all()


def test_after_a_pause_of_the_process_the_machine_does_not_leap(rig):
    """The clock goes on by a second while no timer runs; the simulated time goes on by 0.25 s."""
    drive = rig.drive(**EXACT).drive
    rig.step(0.1)
    before = drive.time
    rig.clock.sleep(1.0)
    rig.step(0.002)
    assert drive.time - before == pytest.approx(0.25)


# ---- the true machine ----


def test_a_plant_with_physics_gives_under_its_weight(rig):
    """30 kg on six struts of 20 N/µm sag by mg / Σ k sin² at home, and elsewhere; the encoders do not show it."""
    pytest.importorskip("mujoco", reason="no mujoco-core (make test: from Python 3.11 on)")
    rig.drive(**EXACT, plant="mujoco", **{"physics.payload_mass": 10.0, "physics.damping": 0.5})
    rig.until(lambda: rig.seen["tool_pose_true"], "a pose")
    for goal in (HOME, TARGET):
        lengths = closed_form_lengths(goal)
        command(rig, lengths)
        sag = 30.0 * 9.80665 / (20e6 * np.square(goal.position[2] / lengths).sum())
        until_tool_at(rig, goal.position - [0.0, 0.0, sag], 3e-8)
        until_at(rig, lengths)


def test_true_pose_is_in_base_whatever_the_work_frame(rig, tmp_path):
    """With a tool of 80 mm and any work frame, the tool at home is 480 mm above the base."""
    work = {"position_mm": [50.0, 20.0, 10.0], "rotation_deg": [0.0, 0.0, 90.0]}
    tool = {"position_mm": [0.0, 0.0, 80.0]}
    rig.drive(geometry_file=geometry_file(tmp_path, work=work, tool=tool), base_frame="machine", **EXACT)
    rig.until(lambda: rig.seen["tool_pose_true"], "a pose")
    assert rig.seen["tool_pose_true"][-1].header.frame_id == "machine"
    equal(true_pose(rig).position, [0.0, 0.0, 0.48])
    equal(true_pose(rig).rotation, np.eye(3))


# ---- what it refuses and reports ----


def test_travel_stop_is_reported(rig, tmp_path):
    """Strut 3 is commanded 20 mm beyond its longest, 520 mm; the drive stays at the travel stop and reports it."""
    geometry = geometry_file(tmp_path, {"stroke_mm": [330.0, 520.0], "step_mm": 33.0})
    rig.drive(geometry_file=geometry, **EXACT)
    play(rig, [tell(0, {3: 0.54 - AT_HOME[2]}), says(ERROR, "at the travel stop: strut_3", NODE)])
    rig.until(lambda: newest(rig)[2] == pytest.approx(0.52, abs=1e-6), "strut 3 at its stop")
    rig.until(lambda: tell(0)(rig) or rig.status(NODE).level == OK, "the way back, no longer than a step")
    assert rig.message(NODE) == "running"
    assert newest(rig)[2] < 0.52


# ---- faults and errors, whose effects test_drives.py checks ----


DRIVES = {"step": 1e-6, "max_speed": 0.02, "max_acceleration": 5.0, "lag": 0.01, "encoder_resolution": 4e-6}
DRIVES |= {"encoder_noise": 2e-6, "tracker_noise": 3e-6}
FAULTS = {"feedback_delay": 0.1, "feedback_drop": 1.0, "longer": (0.0, 2e-5, 0.0, 0.0, 0.0, 0.0)}


def test_the_machine_has_the_errors_and_faults_of_the_parameters(rig):
    """Faults may also be set while the node runs, and then last until they are set again; all readings are dropped."""
    random = {"truth_file": "random", "truth_seed": 7}
    node = rig.drive(rate=100.0, **random, fault_longer=list(FAULTS["longer"]), fault_feedback_delay=0.1, **DRIVES)
    assert {name: getattr(node.drive.parameters, name) for name in DRIVES} == DRIVES
    assert node.drive.faults == Faults(feedback_delay=0.1, longer=FAULTS["longer"])
    truth = find_model("random:7", node.drive.machine.geometry)
    assert rig.logged(f"configured machine 'paper', whose true errors are the model {truth.name!r}")
    np.testing.assert_array_equal(node.drive.machine.model.base_deviation, truth.base_deviation)
    first = len(rig.seen["tool_pose_true"])
    rig.step(1.0)
    assert len(rig.seen["tool_pose_true"]) - first == pytest.approx(100, abs=1)
    for name, value in (("stuck_strut", 2), ("encoder_lost", 4), ("feedback_drop", 1.0)):
        play(rig, [setting(f"fault_{name}", value, NODE)])
    assert node.drive.faults == Faults(stuck=1, encoder_lost=3, **FAULTS)
    rig.step(0.15)  # readings that are under way arrive
    count = len(rig.seen["strut_states"])
    rig.step(1.0)
    assert len(rig.seen["strut_states"]) == count
    for name in ("stuck_strut", "encoder_lost"):
        play(rig, [setting(f"fault_{name}", 0, NODE)])
    assert node.drive.faults == Faults(**FAULTS)


def test_jump_knocks_once_and_is_pulled_back(machine):
    command(machine, AT_HOME)
    play(machine, [setting("fault_jump_strut", 6, NODE), setting("fault_jump", 1e-3, NODE)])
    machine.until(lambda: newest(machine)[5] - AT_HOME[5] > 0.2e-3, "strut 6 to be knocked away")
    until_at(machine, AT_HOME, 1e-9)
    play(machine, [setting("fault_stuck_strut", 1, NODE)])  # another fault does not repeat the knock
    machine.seen["strut_states"].clear()
    machine.until(lambda: len(machine.seen["strut_states"]) > 5, "readings")
    assert all(abs(message.position[5] - AT_HOME[5]) < 1e-9 for message in machine.seen["strut_states"])


# ---- lifecycle ----


def test_lifecycle_goes_round_and_an_inactive_drive_is_silent_and_stands_still(rig):
    rig.drive(start=False, **EXACT)
    for _ in range(3):
        play(rig, [change("configure", node=NODE), tell(0.5), says(WARN, "not active", NODE)])
        assert not rig.seen["strut_states"]
        play(rig, [change("activate", node=NODE)])
        rig.until(lambda: len(rig.seen["strut_states"]) > 20, "readings")
        equal(newest(rig), AT_HOME)
        play(rig, [change("deactivate", "cleanup", node=NODE)])
        rig.seen["strut_states"].clear()
    assert rig.state(NODE) == "unconfigured"


def test_destroyed_node_offers_no_lifecycle_services(rig):
    """They must go although the node is still referenced: nothing would answer, and clients would find two of each."""
    node = rig.drive(start=False, **EXACT)
    rig.nodes.remove(node)
    assert any("change_state" in service.srv_name for service in node.services)
    node.destroy_node()
    assert not list(node.services)


@pytest.mark.parametrize("case", ["a bad file", "struts too short", "no MuJoCo"])
def test_what_cannot_be_configured_says_why_and_may_be_mended(rig, tmp_path, monkeypatch, case):
    """A machine whose struts are 3 mm too short cannot be at home with a stroke that ends 1 mm above it."""
    offset, said = {
        "a bad file": ("a lot", "struts.offset_um"),
        "struts too short": (-3000.0, "drive.initial_lengths of strut_1"),
        "no MuJoCo": (0.0, "a machine with physics needs MuJoCo"),
    }[case]
    monkeypatch.setitem(sys.modules, "mujoco", None)
    truth = model_file(tmp_path, struts={"offset_um": offset})
    plant = {"plant": "mujoco"} if case == "no MuJoCo" else {}
    geometry = geometry_file(tmp_path, {"stroke_mm": [330.0, 510.0]})
    node = rig.drive(start=False, truth_file=truth, geometry_file=geometry, **plant)
    assert not rig.change("configure", NODE)
    assert rig.state(NODE) == "unconfigured"
    (line,) = rig.logged("cannot configure")
    assert said in line
    assert truth in line or case != "a bad file"
    node.publish_last_status()
    model_file(tmp_path)
    assert rig.change("configure", NODE) is not bool(plant)
