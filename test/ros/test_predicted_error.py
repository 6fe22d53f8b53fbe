"""The topics of the predicted error: value, frame, covariance, and no computation without subscribers.

The value is compared with the machine's own forward run; tests of calibration check the covariance.
"""

from __future__ import annotations

import math
import os
from concurrent.futures import wait

import calibration_helpers as small
import numpy as np
import pytest
from geometry_msgs.msg import PoseWithCovarianceStamped
from node_helpers import RELIABLE
from scipy.spatial.transform import Rotation

from hexapod_comp.machine.kinematics import Structure, strut_lengths
from hexapod_comp.machine.model import RealMachine
from hexapod_comp.machine.model_file import load_model
from hexapod_comp.pose import Pose
from hexapod_comp.ros import requests
from hexapod_comp.ros.base import WARN
from hexapod_comp.ros.worker import Worker

STANDING, ALIGNED = "compensator/predicted_error", "compensator/predicted_error_aligned"
UM = 1e-6
STARTED = 60.0  # s; the process imports for one second on an idle processor


@pytest.fixture
def clock_waits(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let the test's clock wait for the worker, whose answers otherwise depend on how busy the computer is."""
    poll = Worker.poll

    def poll_answered(worker: Worker, now: float) -> None:
        wait([job for _, job, *_ in worker._jobs], STARTED)
        poll(worker, now)

    monkeypatch.setattr(Worker, "poll", poll_answered)


def test_the_topics_say_what_the_machine_would_do_and_how_well_that_is_known(rig, tmp_path, clock_waits):
    """Struts too long by d lift a level platform at home by d·L/h, without a rotation, in closed form.

    Struts and joints known to 2 µm give a covariance of about as much; the datum takes most of it.
    """
    rig.compensator(model_file=str(small.fitted_model(tmp_path)), ramp_rate=1.0)
    geometry = small.paper()
    answer = rig.ask(geometry.home)
    seen, moved = (rig.listen(PoseWithCovarianceStamped, topic) for topic in (STANDING, ALIGNED))
    rig.until(lambda: seen and moved, "predicted errors", STARTED)
    count = len(seen)
    rig.step(1.05)
    assert len(seen) - count == 5
    standing, aligned = seen[0], moved[0]
    for message in (standing, aligned):
        assert message.header.frame_id == "work"
        assert message.header.stamp == answer.command.header.stamp
        covariance = np.array(message.pose.covariance).reshape(6, 6)
        assert (np.linalg.eigvalsh(covariance / 1e-12) > -1e-6).all()
    lengths = strut_lengths(Structure.of(geometry), geometry.home)
    lift = 30 * UM * lengths[0] / geometry.home.position[2]
    position, orientation = standing.pose.pose.position, standing.pose.pose.orientation
    # second order: 37 µm squared over half a metre
    np.testing.assert_allclose([position.x, position.y, position.z], [0.0, 0.0, lift], atol=5e-9)
    np.testing.assert_allclose([orientation.x, orientation.y, orientation.z, orientation.w], [0, 0, 0, 1], atol=1e-8)
    sigma, left = (np.sqrt(np.diag(np.array(m.pose.covariance).reshape(6, 6))[:3]) for m in (standing, aligned))
    assert ((sigma > 0.5 * UM) & (sigma < 10 * UM)).all()
    assert (left < 0.5 * sigma).all()
    small.fitted_model(tmp_path, 60 * UM)
    loaded = rig.begin("reload_model")
    rig.until(loaded.done, "the new model", STARTED)
    assert loaded.result().success
    rig.until(lambda: seen[-1].pose.pose.position.z > 1.5 * position.z, "the new error", STARTED)
    assert seen[-1].pose.pose.position.z == pytest.approx(2.0 * position.z, rel=1e-3)
    assert not math.isnan(seen[-1].pose.covariance[0])  # from its own posterior, not from the old model's


def test_without_a_fit_the_covariance_is_nan_never_zero(rig):
    """The shipped virtual machine has no posterior, so its covariance is NaN, also in other poses."""
    rig.compensator(model_file="paper_machine.yaml", ramp_rate=1.0)
    pose = small.paper().home @ Pose.from_angles([0.0, 0.0, 0.0005], [0.001, 0.0, 0.0])
    rig.ask(pose)
    seen = rig.listen(PoseWithCovarianceStamped, STANDING)
    rig.until(lambda: seen, "predicted error", STARTED)
    message = seen[0]
    assert all(math.isnan(value) for value in message.pose.covariance)
    machine = RealMachine(small.paper(), load_model("paper_machine", small.paper()))
    went, _ = machine.pose_for(strut_lengths(Structure.of(small.paper()), pose), guess=pose)
    p, q = message.pose.pose.position, message.pose.pose.orientation
    np.testing.assert_allclose([p.x, p.y, p.z], went.position - pose.position, atol=1e-12)
    turn = Rotation.from_matrix(went.rotation @ pose.rotation.T).as_quat()
    np.testing.assert_allclose([q.x, q.y, q.z, q.w], turn, atol=1e-12)


def test_a_process_begins_with_a_listener_is_started_anew_when_it_dies_and_ends_with_the_last(
    bench, tmp_path, monkeypatch
):
    """The process runs while there are subscribers; if it dies it is started again, without a message if idle."""
    monkeypatch.setattr(requests, "TRY_AGAIN_AFTER", 0.3)
    node = bench.compensator(model_file=str(small.fitted_model(tmp_path)), ramp_rate=1.0)
    bench.ask(small.paper().home)
    beside, seen = node._requests._worker, bench.seen[STANDING]
    assert beside._idle_after == 10.0
    beside._idle_after = 0.5
    node._requests.update(1e12)
    assert beside.process is None
    subscription = bench.witness.create_subscription(PoseWithCovarianceStamped, STANDING, seen.append, RELIABLE)
    bench.until(lambda: seen, "predicted error", STARTED)
    first = beside.process.pid
    assert os.getsid(first) == first, "Ctrl-C does not interrupt it"

    def warned() -> bool:
        if beside.busy("predict") and beside.process is not None:
            beside.process.kill()
        return "no predicted error: the worker process" in bench.message()

    bench.until(warned, "the warning", STARTED)
    assert bench.status().level == WARN
    bench.ask(small.paper().home)
    before = len(seen)
    bench.until(lambda: len(seen) > before, "predicted errors again", STARTED)
    process = beside.process
    assert process.pid != first
    bench.until(lambda: "no predicted error" not in bench.message(), "the end of the warning")
    bench.witness.destroy_subscription(subscription)
    bench.until(lambda: process.poll() is not None, "the end of the process")
    assert beside.process is None
