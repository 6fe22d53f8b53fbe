"""The virtual instruments as nodes, and collect with them, over DDS.

Truth: what :func:`measure` makes of the errors that the drive hides; the true poses that a test publishes itself.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path
from threading import Thread
from typing import Any

import numpy as np
import pytest
from geometry_msgs.msg import PoseStamped
from helpers import long_test
from node_helpers import HOME, Bench, Rig, Voice, near
from sensor_msgs.msg import JointState

from hexapod_comp.machine.geometry import load_geometry
from hexapod_comp.machine.model import RealMachine
from hexapod_comp.measurements.campaign import Campaign, line_run, template
from hexapod_comp.measurements.collect import Collected, collect
from hexapod_comp.measurements.readings import KINDS
from hexapod_comp.pose import best_motion
from hexapod_comp.ros.client import Machine, MoveError
from hexapod_comp.ros.collector import WatchedMachine
from hexapod_comp.ros.instrument import InstrumentNode
from hexapod_comp.ros.messages import message_pose, pose_message
from hexapod_comp.ros.mover import MoverNode
from hexapod_comp.virtual.instruments import measure
from hexapod_comp.virtual.named import find_model

EXACT = {"length_noise": 0.0, "angle_noise": 0.0, "beam_slope": 0.0, "centre_off": 0.0}


class Seen:
    """A rig with an instrument, and the true tool that it watches."""

    def __init__(self, rig: Rig, kind: str, **parameters: object) -> None:
        rig.add(InstrumentNode, True, {"kind": kind, **EXACT, **parameters})
        self.rig, self.heard = rig, list[Any]()
        topic = "/instrument/pose" if kind == "tracker" else "/instrument/readings"
        rig.listeners.append((topic, self.heard.append))
        self.tool = Voice(rig, "tool_pose_true", PoseStamped, "/strut_drive")
        self.line = Voice(rig, "instrument_set_up", PoseStamped, "/collect")

    def read(self, *offset: float) -> Any:
        """Return the newest message, with the tool beside home, m."""
        self.heard.clear()
        for _ in range(5):
            self.tool.publish(pose_message(near(HOME, offset or (0.0, 0.0, 0.0)), "base"))
            self.rig.step(0.02)
        return self.heard[-1]

    def channels(self, *offset: float) -> dict[str, float]:
        message: JointState = self.read(*offset)
        return dict(zip(message.name, message.position, strict=True))


def test_a_laser_counts_from_where_it_was_set_up_and_anew_after_a_broken_beam(rig: Rig) -> None:
    seen = Seen(rig, "laser")
    seen.line.publish(pose_message(HOME, "base"))
    assert set(seen.channels().values()) == {0.0}
    moved = seen.channels(1e-3, 2e-4, 0.0)
    assert moved["linear"] == pytest.approx(1e-3, abs=1e-12)
    assert moved["straightness_y"] == pytest.approx(2e-4, abs=1e-12)
    assert set(moved) == {"linear", "straightness_y", "straightness_z", "rotation_y", "rotation_z"}
    assert rig.set_parameter("instrument", "fault_break", 3600.0).successful
    assert np.isnan(list(seen.channels(1e-3, 2e-4, 0.0).values())).all()
    assert rig.set_parameter("instrument", "fault_break", 0.0).successful
    assert set(seen.channels(1e-3, 2e-4, 0.0).values()) == {0.0}
    assert rig.set_parameter("instrument", "fault_silent", True).successful
    seen.heard.clear()
    rig.step(0.2)
    assert seen.heard == []
    rig.until(lambda: "nobody publishes tool_pose_true" in rig.message("instrument"), "diagnostics", 5.0)


def test_a_ball_bar_reads_distances_and_wild_ones(rig: Rig) -> None:
    """A 3-4-5 triangle: 4 mm to the side of a centre that is 3 mm away is 2 mm further."""
    seen = Seen(rig, "ball_bar", wild_size=0.5)
    seen.line.publish(pose_message(near(HOME, (0.0, 0.0, -0.003)), "base"))
    assert seen.channels() == {"length": 0.0}
    assert seen.channels(0.004, 0.0, 0.0)["length"] == pytest.approx(0.002, abs=1e-12)
    assert rig.set_parameter("instrument", "wild_share", 1.0).successful
    assert abs(seen.channels(0.004, 0.0, 0.0)["length"]) > 0.49


def test_a_tracker_reads_in_its_own_frame(rig: Rig) -> None:
    """It stands 1 m along x of the base, turned by 90° about z (the paper's γ): its x is the base's y."""
    seen = Seen(rig, "tracker", stands_at=[1.0, 0.0, 0.0], stands_turned=[0.0, 0.0, np.pi / 2.0], frame_id="tracker")
    message = seen.read(0.0, 0.002, 0.0)
    assert message.header.frame_id == "tracker"
    x, y, z = HOME.position
    assert message_pose(message).position == pytest.approx([y + 0.002, 1.0 - x, z], abs=1e-12)


@pytest.mark.parametrize(
    ("reasons", "ends"), [(["refusal"] * 2, ""), (["refusal"] * 3, "refusal"), (["limit"], "limit")]
)
def test_a_move_that_a_busy_computer_had_refused_is_asked_for_again(
    reasons: list[str], ends: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    machine, left = object.__new__(WatchedMachine), list(reasons)

    def move(*_: object) -> str:
        if left:
            raise MoveError(left.pop(), "command is stamped 0.501 s old")
        return "arrived"

    monkeypatch.setattr(Machine, "move", move)
    monkeypatch.setattr(WatchedMachine, "_spin", lambda *_: None)
    if not ends:
        assert machine.move(HOME) == "arrived"
        return
    with pytest.raises(MoveError) as caught:
        machine.move(HOME)
    assert (caught.value.reason, left) == (ends, [])


def collected(bench: Bench, path: Path, campaign: Campaign, kind: str, frame: str = "known", **options: Any) -> Any:
    """Run collect on a bench's machine; return what it returned or raised."""
    ended: list[Any] = []
    topics = (
        {"topic": "instrument/pose"}
        if kind == "tracker"
        else {"topic": "tool_pose_true", "readings": "instrument/readings"}
    )

    def client() -> None:
        try:
            with WatchedMachine(samples=9, tracker_frame=frame, **topics) as machine:
                geometry = load_geometry("paper")
                ended.append(collect(campaign, geometry, machine, path, tracker_frame=frame, **options))
        except Exception as error:
            ended.append(error)

    thread = Thread(target=client)
    thread.start()
    bench.until(lambda: not thread.is_alive(), "the campaign", timeout=120.0)
    return ended[0]


def machine(bench: Bench, kind: str, **parameters: object) -> Callable[[Campaign], np.ndarray]:
    """Add a machine with hidden errors, a mover and an instrument; return what that should read of a campaign."""
    bench.machine(truth="random:3")
    bench.add(MoverNode, True, {})
    bench.add(InstrumentNode, True, {"kind": kind, **EXACT, **parameters})
    geometry = load_geometry("paper")
    truth = RealMachine(geometry, find_model("random:3", geometry))
    return lambda campaign: measure(template(campaign, geometry), campaign, truth, 0).value


def small(**more: Any) -> Campaign:
    box = load_geometry("paper").home.position + np.array([[-0.01, -0.01, -0.01], [0.01, 0.01, 0.01]])
    kept = {"cell": 0.02, "step": 0.01, "instrument": None, "diagonals": 0, "noise": (0.0,) * len(KINDS), **more}
    return Campaign(box, **kept)


def broken_at(bench: Bench, stop: int) -> Callable[[int, int, str], None]:
    """Return a progress that breaks the instrument's beam for 0.3 s on the way to a stop, once."""
    node = next(node for node in bench.nodes if isinstance(node, InstrumentNode))
    visited: list[int] = []

    def progress(done: int, of: int, where: str) -> None:
        visited.append(done)
        if len(visited) == stop:
            node._broken_until = time.monotonic() + 0.3

    return progress


@long_test
def test_a_laser_that_reads_wildly_and_whose_beam_breaks_is_collected(bench: Bench, tmp_path: Path) -> None:
    """A line there and back; the beam is broken on the way to the third stop: the run begins anew."""
    known, box = machine(bench, "laser", wild_share=0.1), small(poses=1).box
    campaign = small(runs=(line_run("diagonal", "linear", box, 4, np.eye(3)),))
    done = collected(bench, tmp_path / "out.csv", campaign, "laser", progress=broken_at(bench, 3))
    assert isinstance(done, Collected), done
    off = np.abs(done.measurements.value - known(campaign))
    assert done.missing == ()
    assert off.max() < 6e-6, "half of a backlash of 4 µm, steps of the drives, and wild ones within a median"


def test_a_tracker_that_stands_anywhere_is_collected_in_two_calls(bench: Bench, tmp_path: Path) -> None:
    """Up to one rigid motion, which six poses leave open, the file is that of a tracker in base."""
    known = machine(bench, "tracker", stands_at=[2.0, -1.0, 0.5], stands_turned=[0.3, 1.0, 2.5], frame_id="tracker")
    campaign, path, left = small(poses=6, tilt=0.05), tmp_path / "out.csv", [True] * 6
    collected(bench, path, campaign, "tracker", "free", going_on=lambda: left.pop() if left else False)
    done = collected(bench, path, campaign, "tracker", "free")
    assert isinstance(done, Collected), done
    assert done.resumed > 3
    assert len(done.measurements) == 36
    points = done.measurements.points()
    places = [points + value.reshape(-1, 2, 3)[:, 0] for value in (done.measurements.value, known(campaign))]
    motion = best_motion(*places)
    assert motion is not None
    assert np.abs(places[0] @ motion.rotation.T + motion.position - places[1]).max() < 6e-6
