"""Corrections of the node by external inputs: gravity, wrench, external quantities, and a pose instrument.

The truth is the machine model under this load, which test/machine/test_machine.py checks by energy and closed forms.
"""

from __future__ import annotations

import math
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from geometry_msgs.msg import PoseStamped, PoseWithCovarianceStamped, Vector3Stamped, WrenchStamped
from node_helpers import HOME, RELIABLE, Rig, closed_form_lengths, geometry_file, model_file
from node_stories import warm
from rclpy.parameter import Parameter
from sensor_msgs.msg import JointState
from std_srvs.srv import Trigger

from hexapod_comp.machine.geometry import load_geometry
from hexapod_comp.machine.load import Load, Loading
from hexapod_comp.machine.model import MachineModel, ModelOrigin, RealMachine
from hexapod_comp.machine.model_file import save_model
from hexapod_comp.machine.outside import OutsideTable
from hexapod_comp.machine.struts import StrutErrors
from hexapod_comp.machine.temperatures import LateGrowth
from hexapod_comp.pose import Pose
from hexapod_comp.ros.base import ERROR, OK, WARN
from hexapod_comp.ros.messages import pose_message

MODEL = MachineModel("paper", load=Load(stiffness=np.full(6, 20e6), mass=30.0), origin=ModelOrigin("2026-11-24"))


def commands(loading: Loading, pose: Pose) -> np.ndarray:
    return RealMachine(load_geometry("paper"), MODEL, loading=loading).commands_for(pose)[0]


def started(rig: Rig, folder: Path, model: MachineModel = MODEL, **parameters: object) -> None:
    save_model(model, folder / "model.yaml")
    rig.compensator(model_file=str(folder / "model.yaml"), command_timeout=0.0, ramp_rate=1.0, **parameters)


def publish_gravity(rig: Rig, *vector: float, frame: str = "base") -> None:
    message = Vector3Stamped()
    message.header.frame_id = frame
    message.vector.x, message.vector.y, message.vector.z = vector
    rig.publish("gravity", message)
    rig.barrier()


def publish_wrench(rig: Rig, numbers: list[float], frame: str = "platform") -> None:
    message = WrenchStamped()
    message.header.frame_id = frame
    force, torque = message.wrench.force, message.wrench.torque
    force.x, force.y, force.z, torque.x, torque.y, torque.z = numbers
    rig.publish("wrench", message)
    rig.barrier()


def settled(rig: Rig) -> np.ndarray:
    rig.settle(HOME)
    return rig.ask(HOME).lengths


def test_the_struts_follow_gravity_and_wrench(rig: Rig, tmp_path: Path) -> None:
    """Gravity and wrench by parameter or topic, at platform or tool, and while held, give the model's commands."""
    tilted, wrench = (0.0, 5.0, -8.4), [40.0, -20.0, 60.0, 0.0, 3.0, 0.0]
    started(rig, tmp_path, gravity=[1.0, 0.0, -9.7], outside_timeout=0.3)
    pose = load_geometry("paper").platform_pose(HOME)
    np.testing.assert_array_equal(settled(rig), commands(Loading.of([1.0, 0.0, -9.7]), pose))
    publish_gravity(rig, *tilted)
    np.testing.assert_array_equal(settled(rig), commands(Loading.of(tilted), pose))
    publish_wrench(rig, [0.0] * 6)
    publish_wrench(rig, wrench)  # within 10 ms
    rig.step(0.1)
    pulled = settled(rig)
    np.testing.assert_array_equal(pulled, commands(Loading.of(tilted, wrench), pose))
    rig.until(lambda: rig.values().get("gravity_m_s2") == "0.000, 5.000, -8.400", "the gravity in use")
    values = rig.values()
    assert (values["wrench_N_Nm"], values["payload"]) == (
        "40.00, -20.00, 60.00, 0.00, 3.00, 0.00",
        "0 kg at (0, 0, 0) mm in platform",
    )
    rig.nodes[0].set_parameters([Parameter("outside_hold", value=True)])
    publish_gravity(rig, 0.0, 0.0, -9.8)
    np.testing.assert_array_equal(settled(rig), pulled)
    rig.nodes[0].set_parameters([Parameter("outside_hold", value=False)])
    np.testing.assert_array_equal(settled(rig), commands(Loading.of([0.0, 0.0, -9.8], wrench), pose))
    rig.nodes[0].set_parameters([Parameter("gravity_dead_band", value=0.1)])
    publish_gravity(rig, 0.05, 0.0, -9.8)
    rig.until_status(WARN, "gravity, wrench stale")
    np.testing.assert_array_equal(settled(rig), commands(Loading.of([0.0, 0.0, -9.8], wrench), pose))


# ---- external quantities (parameter and topic `outside`) ----

SAG = np.radians([0.0, 90.0, 0.0, 90.0]).reshape(2, 2), np.outer([10e-6, 15e-6, 40e-6, 50e-6], [0.2, 0.0, -1.0])
TABLE = OutsideTable(("elevation", "rotator"), ("deg", "deg"), tuple(SAG[0]), SAG[1], 0.3 * SAG[1])


BENT = MachineModel("paper", outside=TABLE, origin=ModelOrigin("2026-11-25"))


def tell(rig: Rig, **numbers: float) -> None:
    rig.publish("outside", JointState(name=list(numbers), position=[float(value) for value in numbers.values()]))
    rig.barrier()


def at(**numbers: float) -> np.ndarray:
    geometry = load_geometry("paper")
    model = MachineModel("paper", outside=TABLE).at(numbers)
    return RealMachine(geometry, model).commands_for(geometry.platform_pose(HOME))[0]


def reached(rig: Rig, wanted: np.ndarray) -> bool:
    return bool(np.array_equal(settled(rig), wanted))


def test_the_struts_follow_outside_numbers(rig: Rig, tmp_path: Path) -> None:
    """Values arrive one by one, among other joints, beyond the table, in the dead band, held, and expired."""
    started(rig, tmp_path, BENT)
    nominal = settled(rig)
    tell(rig, elevation=0.5)
    values = rig.until_status(WARN, "the model's table is not applied: rotator")
    assert (values["outside"], values["outside_um"]) == ("elevation 28.6479 deg", "0.000, 0.000, 0.000")
    np.testing.assert_array_equal(settled(rig), nominal)
    tell(rig, azimuth=9.0, rotator=0.2)
    rig.until(lambda: reached(rig, at(elevation=0.5, rotator=0.2)), "the table's correction")
    rig.step(1.1)  # between the corners, by hand: 20.389 µm times (0.2, 0, -1)
    told = (rig.values()["outside_um"], rig.values()["outside_urad"])
    assert told == ("4.078, 0.000, -20.389", "1.223, 0.000, -6.117")
    tell(rig, elevation=1.7)
    rig.until(lambda: reached(rig, at(elevation=1.7, rotator=0.2)), "the correction at the table's edge")
    assert "97.4028 deg" in rig.until_status(WARN, "running, outside the model's table: elevation 97")["outside"]
    rig.nodes[0].set_parameters([Parameter("outside_hold", value=True)])
    tell(rig, elevation=0.1)
    for _ in range(3):
        np.testing.assert_array_equal(settled(rig), at(elevation=1.7, rotator=0.2))
    rig.nodes[0].set_parameters([Parameter("outside_hold", value=False), Parameter("outside_dead_band", value=4.20e-6)])
    rig.until(lambda: reached(rig, at(elevation=0.1, rotator=0.2)), "what came while it was held")
    tell(rig, elevation=0.3)  # moves the point by 3.978 µm and turns it by 1.193 µrad, at 173.2 mm
    for _ in range(3):
        np.testing.assert_array_equal(settled(rig), at(elevation=0.1, rotator=0.2))
    rig.nodes[0].set_parameters([Parameter("outside_dead_band", value=4.17e-6)])
    rig.until(lambda: reached(rig, at(elevation=0.3, rotator=0.2)), "a correction beyond the dead band")


def named(rig: Rig, names: list[str], numbers: list[float]) -> None:
    rig.publish("outside", JointState(name=names, position=numbers))
    rig.barrier()


BAD_LOADS = [
    (publish_gravity, (0.0, 0.0, -1.0), "gravity: must be three numbers of magnitude 9…10.6 m/s²; is the"),
    (partial(publish_gravity, frame="work"), (0.0, 0.0, -9.8), "gravity: frame_id must be base, not 'work'"),
    (publish_wrench, ([math.inf] + [0.0] * 5,), "wrench: must be six finite numbers"),
    (publish_wrench, ([0.0] * 6, "base"), "wrench: frame_id must be platform or tool, not 'base'"),
    (named, (["elevation"], [45.0]), "outside.elevation: the table covers elevation 0 to 90 deg; is the unit right?"),
    (named, (["elevation", "rotator"], [0.3]), "outside: the message has 2 names, but 1 positions"),
    (named, (["elevation", "elevation"], [0.3, 0.4]), "outside: the message has elevation more than once"),
    (named, (["azimuth"], [0.3]), "outside: the message must name elevation or rotator, not 'azimuth'"),
]


@pytest.mark.parametrize(("publish", "values", "text"), BAD_LOADS)
def test_what_cannot_be_is_ignored_and_named(rig: Rig, tmp_path: Path, publish, values: tuple, text: str) -> None:
    started(rig, tmp_path, replace(MODEL, outside=TABLE))
    tell(rig, elevation=0.5, rotator=0.2)
    rig.step(0.1)
    before = settled(rig)
    publish(rig, *values)
    assert text in rig.until_status(ERROR, "bad feedback")["last_bad_feedback"]
    np.testing.assert_array_equal(settled(rig), before)


def test_a_table_that_refuses_stops_the_machine(rig: Rig, tmp_path: Path) -> None:
    started(rig, tmp_path, replace(BENT, outside=replace(TABLE, beyond="refuse")))
    tell(rig, elevation=0.5, rotator=0.2)
    rig.until(lambda: reached(rig, at(elevation=0.5, rotator=0.2)), "the table's correction")
    tell(rig, elevation=1.6)
    rig.until_status(ERROR, "refusing commands: outside_table: elevation 91.6732 deg: the table covers elevation 0 to")
    assert rig.logged("refusing commands: elevation 91.6732 deg: the table covers elevation 0 to 90 deg")
    tell(rig, elevation=1.5)
    rig.until(lambda: reached(rig, at(elevation=1.5, rotator=0.2)), "the number inside")
    rig.nodes[0].set_parameters([Parameter("outside_hold", value=True)])
    tell(rig, elevation=1.6)
    rig.step(0.2)
    np.testing.assert_array_equal(settled(rig), at(elevation=1.5, rotator=0.2))
    rig.nodes[0].set_parameters([Parameter("outside_hold", value=False)])
    rig.until_status(ERROR, "refusing commands: outside_table")
    save_model(BENT, tmp_path / "model.yaml")  # a table that holds its edge
    assert rig.call(Trigger, "compensator/reload_model").success
    rig.step(0.2)
    rig.until(lambda: reached(rig, at(elevation=1.6, rotator=0.2)), "the value at the edge, without another message")


def test_growth_that_follows_late_is_uncertain_for_three_time_constants(rig: Rig, tmp_path: Path) -> None:
    struts, late = StrutErrors(expansion=np.full(6, 12e-6)), np.array([[12e-6]] * 6 + [[0.0]] * 2)
    started(rig, tmp_path, MachineModel("paper", struts=struts, late_growth=LateGrowth((600.0,), late, "base"),
                                        origin=ModelOrigin("2026-11-26")))  # fmt: skip
    warm("base", 21.0)(rig)
    settled(rig)
    rig.step(6.0)  # and a status is up to a second old
    told = "thermal growth uncertain for another {} s: past temperatures not known"
    assert rig.values()["late_parts"] in {told.format(1794), told.format(1795)}


# ---- a pose instrument ----


AT_HOME = closed_form_lengths(HOME)
TOPIC = "tool_pose_measured"
DRIFT = ("um", "turn_urad", "struts_um", "deviation_um")


def instrument(rig: Rig, kind: type = PoseWithCovarianceStamped) -> SimpleNamespace:
    """Return a pose instrument: ``say`` publishes a shift from home, m; further options are its parameters."""
    voice = rig.witness.create_publisher(kind, TOPIC, RELIABLE)

    def say(shift: float = 0.0, frame_id: str = "base", late: float = 0.0, **changes: object) -> None:
        now = rig.ros_clock.now().nanoseconds
        pose = pose_message(Pose(HOME.position + np.array([0.0, 0.0, shift]), np.eye(3)), frame_id)
        pose.header.stamp.sec, pose.header.stamp.nanosec = divmod(now - round(late * 1e9), 10**9)
        pose.pose.orientation.w = float(changes.get("w", 1.0))
        pose.pose.position.x += float(changes.get("x", 0.0))
        message = pose
        if kind is PoseWithCovarianceStamped:
            message = PoseWithCovarianceStamped(header=pose.header)
            message.pose.pose = pose.pose
            message.pose.covariance[0] = float(changes.get("variance", 0.0))
        voice.publish(message)

    return SimpleNamespace(say=say, voice=voice)


def fused(rig: Rig, tmp_path, **parameters: object) -> None:
    """Start a compensator of an ideal machine at home, whose struts are measured with each command."""
    defaults = {"fusion.enabled": True, "fusion.initial_deviation": 2e-5, "fusion.timeout": 2.0}
    rig.compensator(
        model_file=model_file(tmp_path), command_timeout=0.0, feedback_timeout=60.0, **{**defaults, **parameters}
    )
    rig.feed(AT_HOME)
    rig.ask(HOME)


def measured(rig: Rig, say, count: int, shift: float = 0.0, **changes: object) -> None:
    """Publish a number of tool poses between measured struts, while the same command is repeated."""
    for _ in range(count):
        rig.feed(AT_HOME)
        rig.step(0.02)
        say(shift, **changes)
        rig.step(0.02)
        rig.feed(AT_HOME)
        rig.ask(HOME)


def off(rig: Rig) -> float:
    """Return by how much the newest estimate of the tool is above home, m."""
    return rig.seen["tool_pose_estimate"][-1].pose.position.z - HOME.position[2]


@pytest.mark.parametrize("kind", [PoseWithCovarianceStamped, PoseStamped])
def test_the_estimate_weighs_struts_and_instrument(rig, tmp_path, kind):
    message = "pose" if kind is PoseStamped else "pose_with_covariance"
    fused(rig, tmp_path, **{"fusion.message": message})
    before = rig.seen["strut_commands"][-1].position
    measured(rig, instrument(rig, kind).say, 40, 1e-5, late=0.015)
    assert off(rig) == pytest.approx(1e-5, abs=1e-6)
    np.testing.assert_allclose(rig.seen["strut_commands"][-1].position, before, atol=1e-12)  # only estimated
    rig.step(1.1)
    values = rig.values()
    told = {key: values[key] for key in ("fusion", "measured_poses", "rejected_poses", "measured_pose_age_s")}
    wanted = {"fusion": "estimating", "measured_poses": "40", "rejected_poses": "0", "measured_pose_age_s": "0.554"}
    assert told == wanted
    drift, turn, struts, deviation = ([float(n) for n in values[f"drift_{k}"].split(", ")] for k in DRIFT)
    # struts longer by d lift the tool by d·L/h
    assert drift[2] + struts[0] * AT_HOME[0] / HOME.position[2] == pytest.approx(10.0, abs=0.1)
    assert (turn, drift[:2], struts) == ([0.0] * 3, [0.0] * 2, [struts[0]] * 6)
    assert 9.0 < min(deviation) < max(deviation) < 16.0, "20 at the start"
    assert values["drift_compensated_um"] == ", ".join(["0.00"] * 12)


def test_the_compensation_follows_without_a_step_and_a_reset_takes_it_back(rig, tmp_path):
    """A tool measured 20 µm too high is lowered; no strut moves faster than the ramp of 0.1 mm/s."""
    fused(rig, tmp_path, **{"fusion.compensate": True, "ramp_rate": 1e-4})
    say, height = instrument(rig).say, 2e-5
    rows = []
    for _ in range(60):
        measured(rig, say, 1, height + float(np.mean(rig.seen["strut_corrections"][-1].position)))
        rows.append(rig.seen["strut_corrections"][-1].position.tolist())
    assert max(rows[-1]) < -5e-6
    assert np.abs(np.diff(rows, axis=0)).max() <= 1e-4 * 0.02 + 1e-12
    assert rig.values()["fusion"] == "compensating"
    rig.step(0.3)
    assert rig.call(Trigger, "compensator/reset").success
    assert not rig.nodes[0].compensator.drift.any(), "at once"
    for _ in range(60):
        rig.step(0.02)
        rig.ask(HOME)
    np.testing.assert_allclose(rig.seen["strut_corrections"][-1].position, 0.0, atol=1e-12)
    rig.step(1.1)
    assert rig.values()["drift_um"] == "0.00, 0.00, 0.00"


@pytest.mark.parametrize(
    ("reason", "changes"),
    [
        ("frame_id", {"frame_id": "nowhere"}),
        ("stamp_past", {"late": 5.0}),
        ("bad_pose", {"x": math.nan}),
        ("covariance", {"variance": -1.0}),
        ("wild_pose", {"x": 1e-3}),
    ],
)
def test_what_is_no_reading_moves_nothing_and_is_named(rig, tmp_path, reason, changes):
    fused(rig, tmp_path, **{"fusion.compensate": True})
    say = instrument(rig).say
    measured(rig, say, 20)
    before, estimate = rig.seen["strut_commands"][-1].position, off(rig)
    measured(rig, say, 1, **changes)
    rig.until_status(WARN, f"measured poses rejected: {reason}")
    assert rig.values()["rejected_poses"] == "1"
    measured(rig, say, 1)
    assert off(rig) == pytest.approx(estimate, abs=1e-7)
    np.testing.assert_allclose(rig.seen["strut_commands"][-1].position, before, atol=1e-7)
    rig.until_status(OK, "running")


def test_a_drift_beyond_the_limit_is_held_and_an_instrument_that_falls_silent_is_said(rig, tmp_path):
    fused(rig, tmp_path, **{"fusion.limit": 5e-6})
    say = instrument(rig).say
    measured(rig, say, 30, 3e-5)
    rig.until_status(WARN, "the drift would be")
    assert abs(off(rig)) < 1e-5
    measured(rig, say, 3, off(rig))
    rig.until_status(WARN, "no measured pose accepted")


def test_a_drift_whose_correction_would_break_a_limit_is_not_compensated(rig, tmp_path):
    limited = geometry_file(tmp_path, {"correction_um": 2.0})
    fused(rig, tmp_path, **{"fusion.compensate": True, "geometry_file": limited})
    measured(rig, instrument(rig).say, 30, 2e-5)
    text = "drift not compensated: correction: strut_"
    assert rig.until_status(WARN, text)["drift_compensated_um"] == ", ".join(["0.00"] * 12)
    assert rig.logged(text)


def test_an_overtaken_reading_and_a_second_instrument_stop_nothing(rig, tmp_path, stranger):
    fused(rig, tmp_path)
    say = instrument(rig).say
    measured(rig, say, 3)
    say()
    say(late=0.1)
    rig.until_status(WARN, "measured poses rejected: stamp_order")
    stranger.create_publisher(PoseWithCovarianceStamped, TOPIC, RELIABLE)
    rig.until(lambda: "tool_pose_measured ignored: several_publishers" in rig.status().message, "both named")
    rig.ask(HOME)


def test_a_machine_without_feedback_is_measured_beside_its_commands(rig, tmp_path):
    rig.compensator(
        model_file=model_file(tmp_path), command_timeout=0.0,
        **{"fusion.enabled": True, "fusion.initial_deviation": 2e-5},
    )  # fmt: skip
    say = instrument(rig).say
    rig.ask(HOME)
    for _ in range(40):
        rig.step(0.05)
        say(1e-5)
        rig.ask(HOME)
    rig.step(0.1)
    assert off(rig) == pytest.approx(1e-5, abs=1e-6)
