"""Gravity and wrench through the node: what moves the struts, what is refused, held, or stale.

Truth: the machine model at that load, whose arithmetic test/machine/test_load.py holds against energy and closed forms.
"""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("rclpy")

from geometry_msgs.msg import Vector3Stamped, WrenchStamped
from node_helpers import HOME, Rig
from rclpy.parameter import Parameter

from hexapod_comp.machine.geometry import load_geometry
from hexapod_comp.machine.load import Load, Loading
from hexapod_comp.machine.model import MachineModel, ModelOrigin, RealMachine
from hexapod_comp.machine.model_file import save_model
from hexapod_comp.pose import Pose
from hexapod_comp.ros.status import ERROR, WARN

MODEL = MachineModel("paper", load=Load(stiffness=np.full(6, 20e6), mass=30.0), origin=ModelOrigin("2026-11-24"))


def commands(loading: Loading, pose: Pose) -> np.ndarray:
    return RealMachine(load_geometry("paper"), MODEL, loading=loading).commands_for(pose)[0]


def started(rig: Rig, folder: Path, **parameters: object) -> None:
    save_model(MODEL, folder / "model.yaml")
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
    """Parameter, topic, force at the platform and the same at the tool, hold: each ends where the model says."""
    tilted, wrench = (0.0, 5.0, -8.4), [40.0, -20.0, 60.0, 0.0, 3.0, 0.0]
    started(rig, tmp_path, gravity=[1.0, 0.0, -9.7])
    pose = load_geometry("paper").platform_pose(HOME)
    np.testing.assert_array_equal(settled(rig), commands(Loading.of([1.0, 0.0, -9.7]), pose))
    publish_gravity(rig, *tilted)
    np.testing.assert_array_equal(settled(rig), commands(Loading.of(tilted), pose))
    publish_wrench(rig, wrench)
    pulled = settled(rig)
    np.testing.assert_array_equal(pulled, commands(Loading.of(tilted, wrench), pose))
    rig.until(lambda: rig.values().get("gravity_m_s2") == "0.000, 5.000, -8.400", "the gravity in use")
    assert rig.values()["wrench_N_Nm"].startswith("40.00, -20.00, 60.00")
    assert rig.values()["payload"].startswith("0 kg")
    rig.nodes[0].set_parameters([Parameter("load_hold", value=True)])
    publish_gravity(rig, 0.0, 0.0, -9.8)
    np.testing.assert_array_equal(settled(rig), pulled)
    rig.nodes[0].set_parameters([Parameter("load_hold", value=False)])
    np.testing.assert_array_equal(settled(rig), commands(Loading.of([0.0, 0.0, -9.8], wrench), pose))
    rig.nodes[0].set_parameters([Parameter("gravity_dead_band", value=0.1)])
    publish_gravity(rig, 0.05, 0.0, -9.8)
    np.testing.assert_array_equal(settled(rig), commands(Loading.of([0.0, 0.0, -9.8], wrench), pose))


@pytest.mark.parametrize(
    ("topic", "numbers", "frame", "text"),
    [
        ("gravity", [0.0, 0.0, -1.0], "base", "gravity: must be 9…10.6 m/s² in all, not 1"),
        ("gravity", [0.0, 0.0, -9.8], "work", "gravity: frame_id must be base, not 'work'"),
        ("gravity", [0.0, 0.0, math.nan], "base", "gravity: must be 9…10.6 m/s² in all, not nan"),
        ("wrench", [math.inf, 0.0, 0.0, 0.0, 0.0, 0.0], "platform", "wrench: must be six finite numbers"),
        ("wrench", [0.0] * 6, "base", "wrench: frame_id must be platform or tool, not 'base'"),
    ],
)
def test_what_cannot_be_is_ignored_and_named(
    rig: Rig, tmp_path: Path, topic: str, numbers: list[float], frame: str, text: str
) -> None:
    started(rig, tmp_path)
    before = settled(rig)
    publish_gravity(rig, *numbers, frame=frame) if topic == "gravity" else publish_wrench(rig, numbers, frame)
    values = rig.until_status(ERROR, "bad feedback")
    assert text in values["last_bad_feedback"]
    np.testing.assert_array_equal(settled(rig), before)


def test_gravity_that_falls_silent_is_said_and_stays(rig: Rig, tmp_path: Path) -> None:
    started(rig, tmp_path, load_timeout=0.3)
    publish_gravity(rig, 0.0, 5.0, -8.4)
    tilted = settled(rig)
    assert rig.until_status(WARN, "load stale: gravity")["gravity_m_s2"] == "0.000, 5.000, -8.400"
    np.testing.assert_array_equal(settled(rig), tilted)
