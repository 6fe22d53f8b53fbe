"""The strut-drive node over real DDS: a believable machine, seen through its topics."""

from __future__ import annotations

import math
import sys
import time

import numpy as np
import pytest
from geometry_msgs.msg import PoseStamped
from node_helpers import HOME, Bench, closed_form_lengths, geometry_file, model_file, near
from rcl_interfaces.msg import Parameter as ParameterMessage
from rcl_interfaces.msg import ParameterType, ParameterValue, SetParametersResult
from rcl_interfaces.srv import SetParameters
from rclpy.qos import HistoryPolicy, ReliabilityPolicy
from sensor_msgs.msg import JointState

from hexapod_comp.machine.geometry import STRUT_NAMES
from hexapod_comp.pose import Pose
from hexapod_comp.ros.messages import message_pose
from hexapod_comp.ros.status import ERROR, OK, WARN

NODE = "strut_drive"

EXACT = {"truth_file": "ideal", "step": 0.0, "encoder_resolution": 0.0, "encoder_noise": 0.0}
"""A machine without errors: where its struts are is where they were sent."""

TARGET = near(HOME, (0.0003, -0.0002, 0.0005))


def command(rig: Bench, lengths: np.ndarray, names: tuple[str, ...] = STRUT_NAMES) -> None:
    """Publish strut commands."""
    message = JointState(name=list(names), position=[float(value) for value in lengths])
    rig.publish("strut_commands", message)


def newest(rig: Bench) -> np.ndarray:
    """Return the encoder lengths last published, m."""
    return np.array(rig.seen["strut_states"][-1].position)


def until_at(rig: Bench, lengths: np.ndarray, tolerance: float) -> None:
    """Wait until the encoders read some lengths within a tolerance, m."""
    rig.until(lambda: np.abs(newest(rig) - lengths).max() <= tolerance, f"the struts to reach {lengths}")


def true_pose(rig: Bench) -> Pose:
    """Return the true tool pose last published."""
    return message_pose(rig.seen["tool_pose_true"][-1])


def stamped(message: JointState | PoseStamped) -> float:
    return message.header.stamp.sec + 1e-9 * message.header.stamp.nanosec


def set_fault(rig: Bench, name: str, value: float) -> SetParametersResult:
    """Set a fault parameter by service, as ``ros2 param set`` does."""
    if isinstance(value, int):
        wire = ParameterValue(type=ParameterType.PARAMETER_INTEGER, integer_value=value)
    else:
        wire = ParameterValue(type=ParameterType.PARAMETER_DOUBLE, double_value=value)
    request = SetParameters.Request(parameters=[ParameterMessage(name=name, value=wire)])
    (result,) = rig.call(SetParameters, f"{NODE}/set_parameters", request).results
    return result


# ---- what it publishes ----


def test_readings_are_named_stamped_and_in_metres(rig):
    """It starts at home: 509.192 mm (the paper's Table 2, row 1), by the closed form."""
    before = rig.now()
    rig.drive(**EXACT)
    rig.until(lambda: rig.seen["strut_states"] and rig.seen["tool_pose_true"], "readings")
    states = rig.seen["strut_states"][0]
    assert states.name == [f"strut_{i}" for i in range(1, 7)]
    np.testing.assert_allclose(states.position, closed_form_lengths(HOME), rtol=0.0, atol=1e-12)
    assert list(states.velocity) == [0.0] * 6
    assert stamped(states) >= before.sec + 1e-9 * before.nanosec
    true = rig.seen["tool_pose_true"][0]
    assert true.header.frame_id == "base"
    assert stamped(true) >= before.sec + 1e-9 * before.nanosec
    np.testing.assert_allclose(message_pose(true).position, HOME.position, rtol=0.0, atol=1e-12)


def test_moves_where_it_is_told_with_speeds_between(rig):
    """Names in any order; at the end the true tool is where the closed form says, within Newton's 1e-13 m."""
    rig.drive(**EXACT)
    rig.until(lambda: rig.seen["strut_states"], "readings")
    lengths, order = closed_form_lengths(TARGET), [5, 3, 1, 0, 2, 4]
    command(rig, lengths[order], tuple(STRUT_NAMES[i] for i in order))
    until_at(rig, lengths, 1e-12)
    rig.until(lambda: np.abs(true_pose(rig).position - TARGET.position).max() < 1e-11, "the tool to be there")
    speeds = np.array([message.velocity for message in rig.seen["strut_states"]])
    change = lengths - closed_form_lengths(HOME)
    assert (np.abs(speeds).max(axis=0) > 0.0).all()
    assert (np.sign(np.sum(speeds, axis=0)) == np.sign(change)).all()


def test_speed_limit_is_kept(rig, tmp_path):
    """At 20 mm/s it takes the time that it must, and most readings show just that speed.

    Not all: the drives run in ticks of 0.125 ms, and a reading after a short interval may hold one more.
    """
    rig.drive(geometry_file=geometry_file(tmp_path, {"step_mm": 10.0}), max_speed=0.02, **EXACT)
    lengths = closed_form_lengths(near(HOME, (0.0, 0.0, 0.005)))
    rig.until(lambda: rig.seen["strut_states"], "readings")
    began, asked = time.monotonic(), time.time()
    # The drive obeys a command from its last reading on, which under load may be long before the command.
    rig.until(lambda: stamped(rig.seen["strut_states"][-1]) > asked, "a reading")
    command(rig, lengths)
    until_at(rig, lengths, 1e-6)
    assert time.monotonic() - began >= (lengths - closed_form_lengths(HOME)).max() / 0.02
    speeds = np.array([message.velocity for message in rig.seen["strut_states"]])[:, 0]
    assert np.median(speeds[speeds > 1e-3]) == pytest.approx(0.02, rel=0.02)


def test_readings_are_quantised(rig):
    """Steps of 10 µm, counts of 4 µm: a reading is a multiple of 4 µm near a multiple of 10 µm."""
    rig.drive(truth_file="ideal", step=10e-6, encoder_resolution=4e-6, encoder_noise=0.0)
    rig.until(lambda: rig.seen["strut_states"], "readings")
    reading = newest(rig)
    np.testing.assert_allclose(reading / 4e-6, np.rint(reading / 4e-6), atol=1e-6)
    motor = np.rint(closed_form_lengths(HOME) / 10e-6) * 10e-6
    np.testing.assert_allclose(reading, motor, rtol=0.0, atol=2e-6 + 1e-12)


def test_rate(rig):
    """100 Hz: over ten readings, 90 ms by their stamps, give or take a busy machine."""
    rig.drive(rate=100.0, **EXACT)
    rig.until(lambda: len(rig.seen["strut_states"]) > 10, "eleven readings")
    first, last = (stamped(rig.seen["strut_states"][i]) for i in (1, 10))
    assert 0.08 < last - first < 0.5


def test_noise_has_the_size_that_was_asked_for(rig):
    """100 readings of six struts: their spread is known to 3 % (1σ of 600 values); 5σ are allowed."""
    rig.drive(truth_file="ideal", step=0.0, encoder_resolution=0.0, encoder_noise=1e-6, rate=1000.0)
    rig.until(lambda: len(rig.seen["strut_states"]) > 100, "100 readings")
    readings = np.array([message.position for message in rig.seen["strut_states"][:100]])
    assert np.std(readings - closed_form_lengths(HOME)) == pytest.approx(1e-6, rel=0.15)


def test_tracker_noise_is_on_the_true_pose_only(rig):
    rig.drive(tracker_noise=1e-4, rate=1000.0, **EXACT)
    rig.until(lambda: len(rig.seen["tool_pose_true"]) > 50, "50 poses")
    positions = np.array([message_pose(m).position for m in rig.seen["tool_pose_true"][:50]])
    assert np.std(positions - HOME.position) == pytest.approx(1e-4, rel=0.3)  # 150 values: 6 %; 5σ
    np.testing.assert_allclose(newest(rig), closed_form_lengths(HOME), rtol=0.0, atol=1e-12)


# ---- the hidden truth ----


def test_truth_from_a_file(rig, tmp_path):
    """All struts 100 µm longer than told lift a level platform by 100 µm · L/z, to first order."""
    truth = model_file(tmp_path, struts={"offset_um": 100.0})
    rig.drive(**{**EXACT, "truth_file": truth})
    rig.until(lambda: rig.seen["tool_pose_true"], "a pose")
    command(rig, closed_form_lengths(HOME))
    lift = 100e-6 * closed_form_lengths(HOME)[0] / 0.4
    rig.until(lambda: abs(true_pose(rig).position[2] - 0.4 - lift) < 1e-7, "the platform to be lifted")


def test_a_plant_with_physics_gives_under_its_weight(bench):
    """30 kg on six struts of 20 N/µm: mg / Σ k sin² at home, then elsewhere; the encoders see nothing of it."""
    pytest.importorskip("mujoco", reason="no mujoco-core (make test: from Python 3.11 on)")
    spindle = {"physics.payload_mass": 10.0, "physics.damping": 0.5}
    bench.drive(**EXACT, plant="mujoco", **spindle)
    for goal in (HOME, TARGET):
        lengths = closed_form_lengths(goal)
        bench.until(lambda: bench.seen["tool_pose_true"], "a pose")
        command(bench, lengths)
        sag = 30.0 * 9.80665 / (20e6 * np.square(goal.position[2] / lengths).sum())
        place = goal.position - [0.0, 0.0, sag]
        bench.until(
            lambda place=place: np.abs(true_pose(bench).position - place).max() < 3e-8, f"the tool to be at {place}"
        )
        until_at(bench, lengths, 1e-12)


def test_a_plant_with_physics_needs_mujoco(rig, monkeypatch):
    monkeypatch.setitem(sys.modules, "mujoco", None)
    rig.drive(start=False, plant="mujoco")
    assert not rig.change("configure", NODE)
    assert rig.logged("cannot configure: a machine with physics needs MuJoCo")


def test_random_truth_is_the_seeds(ros_context, capfd):
    """Commanded home, three machines of two seeds stand at two places, some 100 µm off."""
    places = []
    for seed in (1, 1, 2):
        with Bench(ros_context, capfd) as rig:
            rig.drive(**{**EXACT, "truth_file": "random"}, truth_seed=seed)
            rig.until(lambda rig=rig: rig.seen["strut_states"], "readings")
            command(rig, closed_form_lengths(HOME))
            until_at(rig, closed_form_lengths(HOME), 1e-12)
            rig.seen["tool_pose_true"].clear()
            rig.until(lambda rig=rig: rig.seen["tool_pose_true"], "a pose")
            places.append(true_pose(rig).position)
    np.testing.assert_allclose(places[0], places[1], rtol=0.0, atol=1e-9)
    assert np.abs(places[0] - places[2]).max() > 1e-6
    assert 1e-6 < np.abs(places[0] - HOME.position).max() < 1e-3


def test_true_pose_is_in_base_whatever_the_work_frame(rig, tmp_path):
    """A tool 80 mm long, a work frame somewhere: the tool at home is 480 mm above the base."""
    work = {"position_mm": [50.0, 20.0, 10.0], "rotation_deg": [0.0, 0.0, 90.0]}
    tool = {"position_mm": [0.0, 0.0, 80.0]}
    rig.drive(geometry_file=geometry_file(tmp_path, work=work, tool=tool), base_frame="machine", **EXACT)
    rig.until(lambda: rig.seen["tool_pose_true"], "a pose")
    assert rig.seen["tool_pose_true"][-1].header.frame_id == "machine"
    np.testing.assert_allclose(true_pose(rig).position, [0.0, 0.0, 0.48], rtol=0.0, atol=1e-12)
    np.testing.assert_allclose(true_pose(rig).rotation, np.eye(3), rtol=0.0, atol=1e-12)


# ---- what it refuses and reports ----

BAD = {
    "NaN": (np.array([0.5, math.nan, 0.5, 0.5, 0.5, 0.5]), STRUT_NAMES, "not_finite"),
    "infinite": (np.array([0.5, 0.5, 0.5, 0.5, 0.5, math.inf]), STRUT_NAMES, "not_finite"),
    "other names": (np.full(6, 0.5), tuple("abcdef"), "strut_names"),
    "a name twice": (np.full(6, 0.5), ("strut_2", *STRUT_NAMES[1:]), "strut_names"),
    "no names": (np.full(6, 0.5), (), "strut_names"),
    "five names": (np.full(6, 0.5), STRUT_NAMES[:5], "strut_names"),
    "five positions": (np.full(5, 0.5), STRUT_NAMES, "strut_count"),
}


@pytest.mark.parametrize("case", BAD)
def test_bad_commands_are_refused_counted_and_logged(rig, case):
    lengths, names, reason = BAD[case]
    rig.drive(**EXACT)
    rig.until(lambda: rig.seen["strut_states"], "readings")
    command(rig, lengths, names)
    values = rig.until_status(ERROR, f"refusing commands: {reason}", NODE)
    assert (values["refused"], values[f"refused.{reason}"], values["commands"]) == ("1", "1", "0")
    assert len(rig.logged(f"command refused ({reason})")) == 1
    np.testing.assert_allclose(newest(rig), closed_form_lengths(HOME), rtol=0.0, atol=1e-12)
    command(rig, closed_form_lengths(TARGET))
    until_at(rig, closed_form_lengths(TARGET), 1e-12)


def test_travel_stop_is_reported(rig, tmp_path):
    """Strut 3 is sent 20 mm beyond its longest of 520 mm; the drive stands at the stop and says so."""
    geometry = geometry_file(tmp_path, {"stroke_mm": [330.0, 520.0], "step_mm": 33.0})
    rig.drive(geometry_file=geometry, **EXACT)
    rig.until(lambda: rig.seen["strut_states"], "readings")
    lengths = closed_form_lengths(HOME)
    lengths[2] = 0.54
    command(rig, lengths)
    rig.until_status(ERROR, "at the travel stop: strut_3", NODE)
    rig.until(lambda: newest(rig)[2] == pytest.approx(0.52, abs=1e-6), "strut 3 at its stop")

    def well() -> bool:
        """The way back is no longer than a step."""
        command(rig, closed_form_lengths(HOME))
        rig.barrier()
        return rig.status(NODE).level == OK

    rig.until(well, "the way back")
    assert rig.status(NODE).message == "running"
    assert newest(rig)[2] < 0.52


# ---- faults ----


def test_stuck_strut(rig):
    rig.drive(fault_stuck_strut=2, **EXACT)
    rig.until(lambda: rig.seen["strut_states"], "readings")
    lengths = closed_form_lengths(TARGET)
    command(rig, lengths)
    lengths[1] = closed_form_lengths(HOME)[1]
    until_at(rig, lengths, 1e-12)
    assert set_fault(rig, "fault_stuck_strut", 0).successful
    until_at(rig, closed_form_lengths(TARGET), 1e-12)


def test_lost_encoder_reads_nan_and_the_machine_goes_on(rig):
    rig.drive(**EXACT)
    rig.until(lambda: rig.seen["strut_states"], "readings")
    assert set_fault(rig, "fault_encoder_lost", 4).successful
    rig.until(lambda: np.isnan(newest(rig)).any(), "the encoder to be lost")
    lost = [name for name, value in zip(STRUT_NAMES, newest(rig), strict=True) if math.isnan(value)]
    assert lost == ["strut_4"]
    command(rig, closed_form_lengths(TARGET))
    rig.until(lambda: np.abs(true_pose(rig).position - TARGET.position).max() < 1e-11, "the tool to be there")


def test_dropped_feedback(rig):
    rig.drive(fault_feedback_drop=1.0, **EXACT)
    rig.until(lambda: len(rig.seen["tool_pose_true"]) > 10, "true poses")
    assert not rig.seen["strut_states"]
    assert set_fault(rig, "fault_feedback_drop", 0.0).successful
    rig.until(lambda: rig.seen["strut_states"], "readings")


def test_delayed_feedback_is_old(rig):
    """With a delay of 100 ms, the encoders still read home when the tool has long begun to move."""
    rig.drive(fault_feedback_delay=0.1, **EXACT)
    rig.until(lambda: rig.seen["strut_states"], "readings")
    command(rig, closed_form_lengths(TARGET))
    rig.until(lambda: np.abs(true_pose(rig).position - HOME.position).max() > 1e-4, "the tool to move")
    np.testing.assert_allclose(newest(rig), closed_form_lengths(HOME), rtol=0.0, atol=1e-12)
    until_at(rig, closed_form_lengths(TARGET), 1e-12)


def test_jump_knocks_once_and_is_pulled_back(rig):
    rig.drive(**EXACT)
    rig.until(lambda: rig.seen["strut_states"], "readings")
    home = closed_form_lengths(HOME)
    command(rig, home)
    assert set_fault(rig, "fault_jump_strut", 6).successful
    assert set_fault(rig, "fault_jump", 1e-3).successful
    rig.until(lambda: newest(rig)[5] - home[5] > 0.2e-3, "strut 6 to be knocked away")
    until_at(rig, home, 1e-9)
    assert set_fault(rig, "fault_stuck_strut", 1).successful  # another fault does not knock again
    rig.seen["strut_states"].clear()
    rig.until(lambda: len(rig.seen["strut_states"]) > 5, "readings")
    until_at(rig, home, 1e-9)
    assert all(abs(message.position[5] - home[5]) < 1e-9 for message in rig.seen["strut_states"])


@pytest.mark.parametrize(
    ("name", "value", "text"),
    [
        ("fault_stuck_strut", 7, "Min: 0, Max: 6, value: 7"),
        ("fault_feedback_drop", 1.5, "fault_feedback_drop"),
        ("fault_feedback_delay", math.nan, "fault_feedback_delay"),
        ("fault_jump", 0.2, "fault_jump"),
        ("fault_encoder_lost", 2.0, "must be int, not 2.0"),
    ],
)
def test_impossible_fault_is_refused(rig, name, value, text):
    rig.drive(**EXACT)
    result = set_fault(rig, name, value)
    assert not result.successful
    assert text in result.reason
    rig.until(lambda: rig.seen["strut_states"], "readings: nothing has changed")


def test_the_machine_stays_the_same_while_it_runs(rig):
    rig.drive(**EXACT)
    result = set_fault(rig, "rate", 10.0)
    assert not result.successful
    assert result.reason == "parameter rate: is taken at configure, and the node is active; set it after a cleanup"


# ---- lifecycle, parameters, topics ----


def test_inactive_drive_is_silent_and_stands_still(rig):
    rig.drive(start=False, **EXACT)
    assert rig.change("configure", NODE)
    rig.until(rig.matched, "discovery")
    command(rig, closed_form_lengths(TARGET))
    rig.barrier()
    rig.until_status(WARN, "not active", NODE)
    assert not rig.seen["strut_states"]
    assert rig.change("activate", NODE)
    rig.until(lambda: len(rig.seen["strut_states"]) > 20, "readings")
    np.testing.assert_allclose(newest(rig), closed_form_lengths(HOME), rtol=0.0, atol=1e-12)


def test_lifecycle_goes_round(rig):
    rig.drive(start=False, **EXACT)
    for _ in range(3):
        assert rig.change("configure", NODE)
        assert rig.change("activate", NODE)
        rig.seen["strut_states"].clear()
        rig.until(lambda: rig.seen["strut_states"], "readings")
        assert rig.change("deactivate", NODE)
        assert rig.change("cleanup", NODE)
    assert rig.state(NODE) == "unconfigured"


def test_destroyed_node_offers_no_lifecycle_services(bench):
    """Not even while somebody still refers to it: nobody would answer, and clients would find two of each."""
    node = bench.drive(start=False, **EXACT)

    def offered() -> bool:
        return (f"/{NODE}/change_state", ["lifecycle_msgs/srv/ChangeState"]) in services()

    services = bench.witness.get_service_names_and_types
    bench.until(offered, "a service to change its state")
    bench.executor.remove_node(node)
    node.destroy_node()
    bench.until(lambda: not offered(), "the service to be gone")


def test_bad_truth_file_fails_and_names_file_and_key(rig, tmp_path):
    truth = model_file(tmp_path, struts={"offset_um": "a lot"})
    node = rig.drive(start=False, truth_file=truth)
    assert not rig.change("configure", NODE)
    assert rig.state(NODE) == "unconfigured"
    (line,) = rig.logged("cannot configure")
    assert truth in line
    assert "struts.offset_um" in line
    node.publish_last_status()
    model_file(tmp_path)
    assert rig.change("configure", NODE)


def test_drive_that_cannot_be_fails_and_says_why(rig, tmp_path):
    """A truth whose struts are 3 mm too short cannot stand at home with a stroke that ends 1 mm above it."""
    truth = model_file(tmp_path, struts={"offset_um": -3000.0})
    geometry = geometry_file(tmp_path, {"stroke_mm": [330.0, 510.0]})
    node = rig.drive(start=False, truth_file=truth, geometry_file=geometry)
    assert not rig.change("configure", NODE)
    (line,) = rig.logged("cannot configure")
    assert "drive.initial_lengths of strut_1" in line
    node.publish_last_status()


def test_quality_of_service(rig):
    """Commands in a queue of a hundred; states the newest only; all reliable, so that default subscribers hear them."""
    node = rig.drive(**EXACT)
    ends = {end.topic_name: end.qos_profile for end in (*node.publishers, *node.subscriptions)}
    for name in ("strut_commands", "strut_states", "tool_pose_true"):
        qos = ends[f"/{name}"]
        commanded = name == "strut_commands"
        assert (qos.depth, qos.history) == (100 if commanded else 1, HistoryPolicy.KEEP_LAST), name
        assert qos.reliability == ReliabilityPolicy.RELIABLE, name
    assert ends["/diagnostics"].reliability == ReliabilityPolicy.RELIABLE


def test_works_in_a_namespace(ros_context, capfd):
    with Bench(ros_context, capfd, "/left") as left, Bench(ros_context, capfd) as other:
        left.drive(**EXACT)
        left.until(lambda: left.seen["strut_states"], "readings")
        command(left, closed_form_lengths(TARGET))
        until_at(left, closed_form_lengths(TARGET), 1e-12)
        assert not other.seen["strut_states"]
        left.until(lambda: left.status(NODE), "a status")
        status = left.status(NODE)
        assert (status.name, status.hardware_id) == ("left/strut_drive: state", "left/paper")
