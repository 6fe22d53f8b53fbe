"""The LinuxCNC bridge and its guard, with a stand-in for LinuxCNC's ``hal`` module and a real compensator.

The stand-in has typed pins, and refuses a name that is taken, like ``hal``; test_linuxcnc.py uses the real module. The
truth is SciPy's rotations for poses, a closed form of the paper's machine for struts, the compensator's topics for
pins, the geometry file and the paper's Table 2 for the configuration, and rigidly moved machines, whose tool error is
known.
"""

from __future__ import annotations

import configparser
import math
import os
import re
import signal
import subprocess
import sys
import time
from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest.mock import MagicMock

import numpy as np
import pytest
import rclpy
from geometry_msgs.msg import PoseStamped
from hal_stand_in import StandInHal
from hypothesis import example, given, settings
from hypothesis import strategies as st
from linuxcnc_helpers import OURS
from node_helpers import CONFIG, HOME, RELIABLE, Bench, closed_form_lengths, near
from scipy.spatial.transform import Rotation
from sensor_msgs.msg import JointState

from hexapod_comp.core import lib
from hexapod_comp.errors import CommandError
from hexapod_comp.linuxcnc import hal as hal_component
from hexapod_comp.linuxcnc import machine as module
from hexapod_comp.linuxcnc.bridge import (
    CompensatorReset,
    CorrectionGuard,
    GuardStatus,
    LinuxcncBridgeNode,
)
from hexapod_comp.linuxcnc.hal import HalComponent, HalError, dead_components, load_module, pins
from hexapod_comp.linuxcnc.machine import MachineComponent, main
from hexapod_comp.machine.geometry import STRUT_NAMES, HexapodGeometry, load_geometry
from hexapod_comp.machine.model import MachineModel, RealMachine
from hexapod_comp.pose import Pose
from hexapod_comp.ros.base import ERROR, OK
from hexapod_comp.ros.process import autostart

NODE = "linuxcnc_bridge"

RATE = 250.0  # Hz; all share one Python with the compensator and the witness

# A busy computer may pause a test for longer than the 0.1 s after which a compensator counts as lost
SLOW = {"rate": RATE, "timeout": 1.0}


class Machine:
    """LinuxCNC's side: positions of the axes, and drives that are at their commands."""

    def __init__(self, rig: Bench, metres: float = 1e-3, **parameters: object) -> None:
        self.rig, self.hal, self._metres = rig, StandInHal(), metres
        self.node = rig.add(LinuxcncBridgeNode, False, {**SLOW, **parameters}, hal=self.hal)
        for topic in ("tool_pose_command", "strut_states"):  # the compensator accepts one publisher only
            rig.remove_publisher(topic)
        self.poses = rig.listen(PoseStamped, "tool_pose_command")
        self.place(HOME)

    def start(self, on: bool = True) -> Machine:
        """Activate the bridge with LinuxCNC on and compensation enabled."""
        assert autostart(self.node)
        self.hal["machine-on"] = self.hal["enable"] = on
        return self

    def place(self, pose: Pose, angles: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> None:
        """Set axes and struts to a pose whose A, B, C are `angles`."""
        for name, value in zip("xyz", pose.position, strict=True):
            self.hal[name] = float(value) / self._metres
        for name, value in zip("abc", angles, strict=True):
            self.hal[name] = value
        for n, length in enumerate(closed_form_lengths(pose)):
            self.hal[f"joint-fb.{n}"] = float(length) / self._metres

    def until_status(self, status: GuardStatus) -> None:
        self.rig.until(lambda: self.hal["status"] == status, f"status {status.name}, not {self.hal['status']}")

    def until_sent(self, count: int = 1) -> PoseStamped:
        """Wait until poses are published from now on; return the last."""
        seen = len(self.poses)
        self.rig.until(lambda: len(self.poses) >= seen + count, "poses")
        return self.poses[-1]


@pytest.fixture
def speak(rig):
    """Provide a function that publishes corrections as a compensator does, with the present stamp by default.

    `speak.steadily` publishes at most 100 times a second."""
    publisher = rig.witness.create_publisher(JointState, "strut_corrections", RELIABLE)

    def send(values: list[float], stamp: Any = None, names: tuple[str, ...] = STRUT_NAMES) -> None:
        rig.until(publisher.get_subscription_count, "the bridge's subscription")
        message = JointState(name=list(names), position=[float(v) for v in values], velocity=[0.0] * len(values))
        message.header.stamp = rig.now() if stamp is None else stamp
        publisher.publish(message)

    def steadily(values: list[float]) -> None:
        if time.monotonic() - spoken[-1] > 0.01:
            spoken.append(time.monotonic())
            send(values)

    spoken, send.steadily = [0.0], steadily
    return send


def stamped(message: JointState | PoseStamped) -> float:
    return message.header.stamp.sec + 1e-9 * message.header.stamp.nanosec


def assert_never_steps(hal: StandInHal, metres: float = 1e-3, ramp_rate: float = 1e-3) -> None:
    """Check that consecutive values of each correction differ by at most the ramp over the longest cycle."""
    for n in range(6):
        steps = [abs(b - a) * metres for a, b in pairwise(hal.history(f"correction.{n}"))]
        assert max(steps) <= ramp_rate * lib.LONGEST_RAMP_STEP + 1e-15
        assert all(map(math.isfinite, hal.history(f"correction.{n}")))


# ---- from LinuxCNC to ROS ----


@pytest.mark.parametrize(
    ("units", "metres", "angles"), [("mm", 1e-3, (5.0, -7.0, 30.0)), ("inch", 0.0254, (-170.0, 12.0, 260.0))]
)
def test_pose_and_struts_are_sent_in_metres_and_the_axes_as_a_quaternion(rig, units, metres, angles):
    """R = Rz(C)·Ry(B)·Rx(A), as in genhexkins; SciPy composes it from three rotations, with 1e-15 of rounding."""
    machine = Machine(rig, metres, units=units)
    for name, value in zip("xyzabc", (10.0, -20.0, 15.0, *angles), strict=True):
        machine.hal[name] = value
    before = time.time()
    message = machine.start().until_sent()
    p, q = message.pose.position, message.pose.orientation
    np.testing.assert_allclose([p.x, p.y, p.z], np.array([10.0, -20.0, 15.0]) * metres, rtol=1e-15)
    rx, ry, rz = (Rotation.from_euler(axis, turn, degrees=True) for axis, turn in zip("xyz", angles, strict=True))
    turned = Rotation.from_quat([q.x, q.y, q.z, q.w]).as_matrix()
    np.testing.assert_allclose(turned, (rz * ry * rx).as_matrix(), rtol=0.0, atol=1e-15)
    assert message.header.frame_id == "work"
    assert before <= stamped(message) <= time.time()
    rig.until(lambda: len(rig.seen["strut_states"]) > 2, "strut_states")
    np.testing.assert_allclose(rig.seen["strut_states"][-1].position, closed_form_lengths(HOME), rtol=1e-15)


def test_struts_that_move_are_told_only_to_a_compensator_that_follows(rig, speak):
    """Moving struts are published only once the compensator sends corrections; before, it would correct their lag."""
    machine = Machine(rig)
    hal, states = machine.start().hal, rig.seen["strut_states"]

    def move() -> None:
        hal["joint-fb.0"] = 500.0 + 10.0 * math.sin(20.0 * time.monotonic())

    def moved(poses: int) -> bool:
        move()
        return len(machine.poses) > poses

    rig.until(lambda: moved(round(RATE)), "a second of motion")
    assert states == []
    rig.until(lambda: states, "struts that stand")

    def told() -> bool:
        move()
        speak.steadily([0.0] * 6)
        return len(states) > seen + 50

    seen = len(states)
    rig.until(told, "struts that move, with a compensator")
    # A velocity is the change since the last message, over the difference of the stamps.
    pairs = [(one, other) for one, other in pairwise(states) if other.velocity[0]]
    ratios = [(b.position[0] - a.position[0]) / (b.velocity[0] * (stamped(b) - stamped(a))) for a, b in pairs]
    assert np.median(ratios) == pytest.approx(1.0, abs=0.02)


def test_while_the_machine_is_off_only_the_heart_beats(rig, monkeypatch):
    """Axes mean nothing before homing, so nothing but the heartbeat is sent: 50 beats at 100 Hz last 0.5 s."""
    monkeypatch.setattr("hal_stand_in.time", rig.clock)
    machine = Machine(rig, rate=100.0).start(on=False)
    rig.until_status(OK, "machine off", NODE)
    beats = machine.hal.pins["heartbeat"].written
    rig.until(lambda: len(beats) > 60, "60 beats")
    assert all(one[1] != other[1] for one, other in pairwise(beats))
    assert beats[55][0] - beats[5][0] == pytest.approx(0.5, abs=0.01)
    assert (machine.poses, rig.seen["strut_states"]) == ([], [])
    machine.hal["machine-on"] = True
    machine.until_sent()
    rig.until(lambda: rig.seen["strut_states"], "measured struts")


@pytest.mark.parametrize("value", [math.nan, 1000000.1])
def test_an_axis_that_is_no_number_is_not_sent(rig, value):
    """The struts are still published, diagnostics name the pin, and poses follow again when the pin is valid."""
    machine = Machine(rig).start()
    machine.until_sent()
    machine.hal["b"] = value
    rig.barrier()
    sent, states = len(machine.poses), len(rig.seen["strut_states"])
    values = rig.until_status(ERROR, "unusable pins: b", NODE)
    rig.until(lambda: len(rig.seen["strut_states"]) > states + 20, "measured struts")
    assert len(machine.poses) <= sent + 1
    assert values["last_bad_pins"] == f"pins that are not finite or exceed ±1e+06: b = {value}"
    machine.hal["b"] = 1e6
    machine.until_sent()
    assert all(math.isfinite(m.pose.orientation.w) for m in machine.poses)


# ---- from the compensator to LinuxCNC ----


def test_corrections_of_a_real_compensator_arrive_stop_with_it_and_return(rig):
    """At standstill the pins equal the compensator's corrections, in inches.

    The pin ``stopped``, which holds LinuxCNC's feed, is true until the compensator is received, while it refuses
    commands, and while it sends nothing."""
    machine = Machine(rig, 0.0254, units="inch")
    hal = machine.hal
    rig.until(lambda: hal["heartbeat"], "a cycle")
    assert hal["stopped"] is True
    rig.compensator()
    machine.start()
    rig.until(lambda: hal["stopped"] is False, "the compensator to be received")
    machine.until_status(GuardStatus.COMPENSATING)
    seen = rig.seen["strut_corrections"]
    rig.until(lambda: len(seen) > 5 and seen[-1].position == seen[-5].position, "the compensator's own ramp to end")
    published = np.array(seen[-1].position)
    assert np.abs(published).max() > 10e-6
    rig.until(lambda: np.allclose(hal.corrections * 0.0254, published, rtol=0.0, atol=1e-15), "the correction")
    assert hal["largest"] == pytest.approx(np.abs(published).max() / 0.0254, abs=1e-12)
    assert hal["compensating"] is True
    assert 0.0 <= hal["age"] < SLOW["timeout"]
    assert 0 < hal["updates"] <= len(machine.poses) + 100
    assert (hal["rejected"], hal["resets"]) == (0, 0)
    said = f"{np.abs(published).max():.9f}"
    rig.until(lambda: rig.values(NODE).get("largest_correction_m") == said, f"{said} in the diagnostics")

    assert rig.change("deactivate")
    rig.until(lambda: hal["stopped"] is True, "an inactive compensator")
    machine.until_status(GuardStatus.WAITING)
    rig.until_status(ERROR, "compensator lost, corrections are zero", NODE)
    assert hal["age"] > SLOW["timeout"]
    assert hal["compensating"] is False
    assert not hal.corrections.any()
    assert rig.change("activate")
    machine.until_status(GuardStatus.COMPENSATING)
    assert hal.corrections.any()
    rig.until(lambda: hal["stopped"] is False, "an active one")
    assert_never_steps(hal, 0.0254)
    assert rig.set_parameter("compensator", "heartbeat_rate", 0.0).successful  # the latched message stays
    rig.until(lambda: hal["stopped"] is True, "one that hangs")


def test_bad_corrections_are_never_applied(rig, speak):
    machine = Machine(rig).start()
    hal = machine.hal
    bad = [
        (([1e-6, math.nan, 0.0, 0.0, 0.0, 0.0],), "not_finite"),
        (([1e-6] * 5 + [math.inf],), "not_finite"),
        (([501e-6] + [0.0] * 5,), "correction"),
        (([1e-6] * 5, None, STRUT_NAMES[:5]), "strut_names"),
        (([1e-6] * 6, None, ("a", *STRUT_NAMES[1:])), "strut_names"),
        (([1e-6] * 6, rig.stamp(-5.0)), "stamp_past"),
        (([1e-6] * 6, rig.stamp(100.0)), "stamp_future"),
    ]
    for count, (arguments, reason) in enumerate(bad, start=1):
        speak(*arguments)  # corrections with other stamps are at least five seconds old, however long the test takes
        rig.until(lambda count=count: hal["rejected"] == count, f"refusal of {reason}")
        rig.until_status(ERROR, f"refusing corrections: {reason}", NODE)
    assert (hal["updates"], hal["age"], hal["status"]) == (0, 1e9, GuardStatus.WAITING)
    for n in range(6):
        assert set(hal.history(f"correction.{n}")) == {0.0}
    rig.until(lambda: rig.values(NODE)["refused"] == "7", "the sum in the diagnostics")
    assert rig.values(NODE)["refused.stamp_past"] == rig.values(NODE)["refused.stamp_future"] == "1"


def test_two_that_correct_are_refused(rig):
    machine = Machine(rig)
    rig.compensator()
    machine.start().until_status(GuardStatus.COMPENSATING)
    other = rclpy.create_node("other", context=rig.context)
    rig.nodes.append(other)
    other.create_publisher(JointState, "strut_corrections", RELIABLE)
    rig.until_status(ERROR, "refusing corrections: several_publishers", NODE)
    machine.until_status(GuardStatus.WAITING)
    rig.until(lambda: "/other" in rig.values(NODE)["last_refusal"], "the name of the second")
    assert not machine.hal.corrections.any()
    assert_never_steps(machine.hal)


def test_asks_a_compensator_that_refuses_to_start_anew(bench):
    """After 20 mm of motion while off, commands are refused (limit 2 mm) until the bridge calls reset."""
    machine = Machine(bench)
    bench.compensator()
    machine.start().until_status(GuardStatus.COMPENSATING)
    machine.hal["machine-on"] = False
    machine.until_status(GuardStatus.OFF)
    machine.place(near(HOME, (0.0, 0.0, 0.02)))
    machine.hal["machine-on"] = True
    # refused as a step or as a following error, whichever message comes first
    bench.until(lambda: bench.values().get("refused", "0") != "0", "a refused command")
    bench.until(lambda: machine.hal["resets"] >= 1, "a reset")
    updates = machine.hal["updates"]
    bench.until(lambda: machine.hal["updates"] > updates + 10, "corrections")
    machine.until_status(GuardStatus.COMPENSATING)
    assert bench.logged("its reset was requested")
    assert_never_steps(machine.hal)


def test_when_a_reset_is_requested():
    """Corrections are missing for 0.1 + 0.15 s, the last request was 0.5 s ago, the last error less than 1.2 s ago."""
    calls: list[float] = []
    service = SimpleNamespace(call_async=calls.append, service_is_ready=lambda: ready, remove_pending_request=len)
    node = SimpleNamespace(
        get_namespace=lambda: "/",
        subscribe=lambda *_: None,
        create_client=lambda *_: service,
        log_warning=lambda *_: None,
    )
    reset, ready = CompensatorReset(node, {"timeout": 0.1}), True

    def requested(now: float, received: float = -math.inf) -> bool:
        return reset.request(10.0, received, now)

    assert not requested(11.0), "no error was reported"
    reset._reported_at = 11.0
    assert [requested(now) for now in (10.249, 10.25, 10.749)] == [False, True, False]
    assert not reset.unanswered
    service.remove_pending_request = calls.remove
    reset._pending = calls[0]
    assert requested(10.75)
    assert (reset.unanswered, len(calls)) == (True, 1), "the old request is withdrawn"
    ready = False
    assert not requested(11.5), "a service that is not ready is tried again after 0.5 s"
    ready = True
    assert [requested(now) for now in (11.99, 12.0, 12.3)] == [False, True, False]
    assert not requested(12.6), "the error is too old"
    reset._reported_at = 13.0
    assert not requested(13.35, received=13.05), "a correction has arrived since the error"
    assert not reset.unanswered


# ---- activation, deactivation, end ----


def test_pins_are_those_of_the_agreement(rig):
    hal = Machine(rig).hal
    inputs = {name for name, direction in hal.directions.items() if direction == "IN"}
    feedback = {f"joint-fb.{n}" for n in range(6)}
    assert inputs == {"x", "y", "z", "a", "b", "c", "tool-offset", "machine-on", "enable"} | feedback
    assert set(hal.pins) - inputs == {f"correction.{n}" for n in range(6)} | {
        *("status", "compensating", "age", "heartbeat", "stopped", "updates", "rejected", "resets", "largest")
    }
    assert hal.is_ready
    outputs = {name: hal[name] for name in set(hal.pins) - inputs}
    assert outputs == dict.fromkeys(outputs, 0) | {"age": 1e9, "stopped": True}, "nothing is corrected yet"


def until_compensating(machine: Machine, speak: Any) -> None:

    def there() -> bool:
        speak.steadily([50e-6] * 6)
        return machine.hal["status"] == GuardStatus.COMPENSATING

    machine.rig.until(there, "compensation")


def test_deactivating_ramps_out_and_the_heart_goes_on(rig, speak):
    machine = Machine(rig).start()
    until_compensating(machine, speak)
    assert rig.change("deactivate", NODE)
    machine.until_status(GuardStatus.OFF)
    assert not machine.hal.corrections.any()
    beats = len(machine.hal.history("heartbeat"))
    rig.until(lambda: len(machine.hal.history("heartbeat")) > beats + 10, "more beats")
    assert rig.change("cleanup", NODE)
    assert rig.change("configure", NODE)
    assert rig.change("activate", NODE)
    until_compensating(machine, speak)


@pytest.mark.parametrize(("ramp_rate", "left"), [(1e-3, 0.0), (10e-6, 0.05)])
def test_end_ramps_out_what_is_quick(rig, speak, ramp_rate, left):
    """At 1 mm/s 50 µm ramp out in 0.05 s; at 10 µm/s it would take 5 s, so they stay, for LinuxCNC's watchdog."""
    machine = Machine(rig, ramp_rate=1e-3, timeout=30.0).start()
    until_compensating(machine, speak)
    assert rig.set_parameter(NODE, "ramp_rate", ramp_rate).successful
    machine.node.publish_last_status()
    np.testing.assert_allclose(machine.hal.corrections, left, rtol=1e-9)
    stay = "the node ends and leaves its corrections on the pins"
    assert rig.logged(stay) == ([f"{stay}: a ramp to zero would take more than 1 s"] if left else [])
    assert_never_steps(machine.hal)


PROCESS_HAL = """
import signal
signal.signal(signal.SIGTERM, signal.default_int_handler)  # as the real one does
HAL_FLOAT, HAL_BIT, HAL_S32, HAL_U32, HAL_IN, HAL_OUT = range(6)
class error(Exception): pass
class component:
    value = 0
    def __init__(self, name): pass
    def newpin(self, name, kind, direction): return self
    def get(self): return 0.0
    def set(self, value): pass
    def ready(self): print("ready", flush=True)
    def exit(self): print("left", flush=True)
"""


def test_a_signal_ends_the_process_in_order(isolated_ros, tmp_path):
    (tmp_path / "hal.py").write_text(PROCESS_HAL)
    path = os.pathsep.join([str(tmp_path), str(CONFIG.parent), os.environ.get("PYTHONPATH", "")])
    command = [sys.executable, "-m", "hexapod_comp.linuxcnc.bridge"]
    with subprocess.Popen(
        command, env={**os.environ, "PYTHONPATH": path}, text=True, stdout=subprocess.PIPE, stderr=subprocess.PIPE
    ) as process:
        assert process.stdout is not None
        assert process.stderr is not None
        assert process.stdout.readline() == "ready\n"
        while "machine off" not in (line := process.stderr.readline()):
            assert line, "it ended by itself"
        process.send_signal(signal.SIGTERM)
        said, complaints = process.communicate(timeout=30.0)
    assert (process.returncode, said) == (0, "left\n"), complaints


# ---- the module hal ----


@pytest.fixture
def packages(tmp_path, monkeypatch):
    """Provide a folder in place of Debian's packages, and a Python without ``hal``."""
    monkeypatch.setattr(hal_component, "DEBIAN_PACKAGES", tmp_path)
    for name in ("hal", "_hal"):
        monkeypatch.delitem(sys.modules, name, raising=False)
    monkeypatch.setattr(sys, "path", [folder for folder in sys.path if "dist-packages" not in folder])
    yield tmp_path
    for name in ("hal", "_hal"):
        sys.modules.pop(name, None)


@pytest.mark.parametrize(
    ("files", "problem"),
    [
        ({}, r"neither on this Python's path nor in .*apt install linuxcnc-uspace"),
        (
            {"hal.py": "import _hal\n", "_hal.cpython-27-x86_64-linux-gnu.so": ""},
            "is built for cpython-27-x86_64-linux-gnu, but this Python is CPython {}.{}".format(*sys.version_info),
        ),
    ],
    ids=["not installed", "for another Python"],
)
def test_why_the_module_does_not_load(packages, files, problem):
    for name, text in files.items():
        (packages / name).write_text(text)
    with pytest.raises(HalError, match=problem):
        load_module()


def test_found_in_debians_folder_without_leaving_a_trace(packages):
    """Afterwards the folder, which has an old NumPy, is not on the path, nor does hal's SIGTERM handler stay."""
    (packages / "hal.py").write_text("import signal\nsignal.signal(signal.SIGTERM, signal.default_int_handler)\n")
    path, handler = list(sys.path), signal.getsignal(signal.SIGTERM)
    assert load_module().__file__ == str(packages / "hal.py")
    assert sys.path == path
    assert signal.getsignal(signal.SIGTERM) is handler


def test_a_refused_component_is_named():
    hal = StandInHal()
    HalComponent("twice", pins("in", "float", "x"), hal)
    with pytest.raises(HalError, match="HAL refuses the component 'twice': Invalid component name twice"):
        HalComponent("twice", {}, hal)


# ---- the guard of the corrections ----

RULES = {"limit": 500e-6, "ramp_rate": 1e-3, "timeout": 0.1, "on_loss": "zero"}
LIMIT, SLACK = 500e-6, 1e-15
TARGET = [100e-6, -50e-6, 0.0, 25e-6, -100e-6, 75e-6]

ANY_NUMBER = st.floats(width=64, allow_nan=True, allow_infinity=True)
USUAL = st.floats(-1.2 * LIMIT, 1.2 * LIMIT)
PAUSE = st.floats(0.0, 0.5) | st.sampled_from([0.0, 1e-3, 0.1, 1e9, -0.01, math.inf, math.nan])
EVENT = st.tuples(
    PAUSE,
    st.none() | st.lists(ANY_NUMBER | USUAL, min_size=6, max_size=6) | st.lists(USUAL, min_size=6, max_size=6),
    st.booleans(),
)


@settings(deadline=None)
@given(st.lists(EVENT, max_size=60), st.sampled_from(["zero", "hold"]), st.floats(1e-6, 1.0))
@example([(0.1, [0.0] * 5 + [math.nan], True)], "zero", 1e-3)
def test_never_too_fast_too_far_or_not_a_number(events, on_loss, ramp_rate):
    """Outputs keep limit and ramp for any corrections and any clock. A refused correction changes nothing, not even the
    age, so a compensator that sends only invalid ones counts as lost."""
    subject, now = CorrectionGuard(RULES | {"on_loss": on_loss, "ramp_rate": ramp_rate}), 100.0
    before, updated_at = list(subject.output), -math.inf
    for pause, correction, enabled in events:
        now = now + pause if math.isfinite(now + pause) else pause
        if correction is not None and all(abs(value) <= LIMIT for value in correction):
            subject.offer(correction, now)
        elif correction is not None:
            known = subject.accepted, subject._newest, subject._accepted_at
            with pytest.raises(CommandError, match=r"strut [1-6]: correction .* is larger than ±500 µm"):
                subject.offer(correction, now)
            assert (subject.accepted, subject._newest, subject._accepted_at) == known
        output = list(subject.update(now, enabled))
        assert all(math.isfinite(value) and abs(value) <= LIMIT + SLACK for value in output)
        passed = now - updated_at
        allowed = ramp_rate * min(passed, lib.LONGEST_RAMP_STEP) if 0.0 < passed < math.inf else 0.0
        assert max(abs(b - a) for a, b in zip(before, output, strict=True)) <= allowed + SLACK
        assert subject.status in GuardStatus
        before, updated_at = output, now
        now = now if math.isfinite(now) else 100.0
    with pytest.raises(CommandError, match=r"^strut 2: correction -600\.000 µm is larger than ±500 µm$"):
        subject.offer([0.0, -6e-4, 0.0, 1.0, 0.0, 0.0], now)


class Loop:
    """A guard in a loop of 1 kHz whose compensator, while alive, asks for the same correction in every cycle."""

    def __init__(self, on_loss: str = "zero") -> None:
        self.guard, self.now = CorrectionGuard(RULES | {"on_loss": on_loss}), 100.0
        self.alive, self.enabled, self.target = True, True, TARGET
        self.run(1)  # the first cycle has no duration

    def run(self, cycles: int) -> list[list[float]]:
        """Return the outputs of some cycles."""
        outputs = []
        for _ in range(cycles):
            self.now += 1e-3
            if self.alive:
                self.guard.offer(self.target, self.now)
            outputs.append(list(self.guard.update(self.now, self.enabled)))
        return outputs


def test_corrections_ramp_in_and_out_in_proportion():
    """100 µm at 1 µm per cycle take 100 cycles in and 100 out; all six targets have the same share at any time."""
    loop = Loop()
    shares = np.arange(1, 101) / 100.0
    np.testing.assert_allclose(loop.run(100), np.outer(shares, TARGET), rtol=1e-9, atol=SLACK)
    for share, status in ((1.05, GuardStatus.COMPENSATING), (1.5, GuardStatus.RAMPING)):  # the target moves by 5 µm
        loop.target = [share * value for value in TARGET]
        loop.run(1)
        assert loop.guard.status is status
    loop.target = TARGET
    loop.run(4)
    loop.enabled = False
    np.testing.assert_allclose(loop.run(99), np.outer(shares[98::-1], TARGET), rtol=1e-9, atol=SLACK)
    assert loop.guard.status is GuardStatus.RETURNING
    assert loop.run(2)[-1] == [0.0] * 6
    assert loop.guard.status is GuardStatus.OFF
    loop.enabled, loop.target = True, [0.05 * value for value in TARGET]
    loop.run(1)
    assert loop.guard.status is GuardStatus.RAMPING


@pytest.mark.parametrize(("on_loss", "status"), [("zero", GuardStatus.WAITING), ("hold", GuardStatus.HOLDING)])
def test_a_compensator_that_is_lost_half_way_and_comes_back(on_loss, status):
    """Corrections stay at the last target for 0.1 s, then return to zero or stay; a new target is approached from there
    at 1 µm per cycle."""
    loop = Loop(on_loss)
    silent = CorrectionGuard(loop.guard._rules)
    silent.update(0.0, True)
    assert silent.status is GuardStatus.WAITING, "nothing was accepted yet"
    loop.run(50)
    assert loop.guard.status is GuardStatus.RAMPING
    loop.target = list(loop.guard.output)
    loop.run(1)
    loop.alive = False
    assert loop.run(99)[-1] == loop.target
    left = loop.run(61)[-1]
    assert left == (loop.target if on_loss == "hold" else [0.0] * 6)
    assert loop.guard.status is status
    loop.alive, loop.target = True, [-value for value in TARGET]
    back = np.array([left, *loop.run(160)])
    assert np.abs(np.diff(back, axis=0)).max() == pytest.approx(1e-6)
    assert back[-1].tolist() == loop.target


# ---- the shipped configuration, and the machine behind it ----

LINUXCNC = CONFIG / "linuxcnc"


@pytest.fixture(scope="module")
def geometry() -> HexapodGeometry:
    return load_geometry(CONFIG / "paper.yaml")


@pytest.fixture(scope="module")
def ini() -> configparser.ConfigParser:
    parser = configparser.ConfigParser(strict=False)  # the file has several HALFILE
    parser.read(LINUXCNC / "hexapod.inc", encoding="utf-8")
    return parser


# The configuration


def test_genhexkins_has_the_nominal_joints(geometry: HexapodGeometry) -> None:
    """Within a picometre, the digits of the file, since corrections are differences to nominal lengths."""
    setp = dict(re.findall(r"^setp genhexkins\.(\S+) (\S+)$", (LINUXCNC / "genhexkins.hal").read_text(), re.MULTILINE))
    assert float(setp.pop("screw-lead")) == 0.0
    for body, joints in (("base", geometry.base_joints), ("platform", geometry.platform_joints)):
        told = [[float(setp.pop(f"{body}.{n}.{axis}")) for axis in "xyz"] for n in range(6)]
        np.testing.assert_allclose(told, joints * 1e3, rtol=0.0, atol=1e-9)
    assert not setp


def test_home_and_limits_are_the_geometrys(geometry: HexapodGeometry, ini: configparser.ConfigParser) -> None:
    """Home's lengths equal Table 2's first row to its last digit, and the geometry's to a nanometre. LinuxCNC's limits
    equal those at which the compensator refuses; bridge and realtime chain have the same, in m and in mm."""
    legs = geometry.home.position + geometry.platform_joints @ geometry.home.rotation.T - geometry.base_joints
    for n in range(6):
        joint = ini[f"JOINT_{n}"]
        for value in (float(joint["HOME"]), ini["DRIVES"].getfloat(f"PARKED_{n}")):
            assert value == pytest.approx(np.linalg.norm(legs[n]) * 1e3, abs=1e-6)
            assert value == pytest.approx(509.192, abs=0.5e-3)
        assert (joint["HOME_OFFSET"], joint["HOME_ABSOLUTE_ENCODER"]) == ("0", "1")
        stroke = [float(joint[key]) * 1e-3 for key in ("MIN_LIMIT", "MAX_LIMIT")]
        np.testing.assert_allclose(stroke, geometry.limits.stroke[n])
        assert float(joint["MAX_VELOCITY"]) * 1e-3 == pytest.approx(geometry.limits.speed)
    position = [float(word) for word in ini["TRAJ"]["HOME"].split()]
    np.testing.assert_allclose(position, [*geometry.home.position * 1e3, 0.0, 0.0, 0.0])
    section = ini["HEXAPOD_COMP"]
    assert float(section["LIMIT"]) * 1e-3 <= geometry.limits.correction
    bridge = dict(re.findall(r"-p (\w+):=(\S+)", section["BRIDGE"]))
    assert float(bridge["limit"]) == pytest.approx(float(section["LIMIT"]) * 1e-3)
    assert float(bridge["ramp_rate"]) == pytest.approx(float(section["RAMP_RATE"]) * 1e-3)
    assert bridge["units"] == ini["TRAJ"]["LINEAR_UNITS"]
    assert bridge["on_loss"] == {"0": "zero", "1": "hold"}[section["HOLD"]]


@pytest.mark.parametrize(("name", "least"), [("hexapod.hal", 20), ("bridge.hal", 2), ("machine.hal", 1)])
def test_struts_are_wired_alike(name: str, least: int) -> None:
    """A line that contains the number of one strut exists for each of the six."""
    number = re.compile(r"(?<=[._-])[0-5](?=[. ]|-[a-z]|$)")
    other = re.compile("#|loadrt|$|.*(comp-missing.in|iocontrol)")
    lines = [line for line in (LINUXCNC / name).read_text().splitlines() if not other.match(line)]
    named = [(set(number.findall(line)), number.sub("N", line)) for line in lines]
    of_strut = [sorted(line for numbers, line in named if numbers == {f"{n}"}) for n in range(6)]
    assert len(of_strut[0]) >= least
    for wiring in of_strut[1:]:
        assert wiring == of_strut[0]


# The true tool


def lengths(geometry: HexapodGeometry, axes: list[float], tool_length: float = 0.0) -> np.ndarray:
    """Return the strut lengths of genhexkins, m, for axes in m and degrees, by its source code."""
    turn = Rotation.from_euler("ZYX", axes[5:2:-1], degrees=True).as_matrix()
    up = np.array([0.0, 0.0, tool_length])
    base, platform = geometry.base_joints + up, geometry.platform_joints + up
    return np.linalg.norm(np.array(axes[:3]) + platform @ turn.T - base, axis=1)


TILTED = [0.02, -0.03, 0.42, 6.0, -5.0, 4.0]


def machine_component(geometry: HexapodGeometry, truth: MachineModel, metres: float, tool_length: float) -> StandInHal:
    """Return the pins after one cycle at a tilted pose with the lengths of genhexkins."""
    hal = StandInHal()
    units = {1e-3: "mm", 0.0254: "inch"}[metres]
    component = MachineComponent(RealMachine(geometry, truth), units, "hexapod_machine", hal)
    component.cycle()
    assert hal["valid"] is False  # lengths of zero
    for name, value in zip("xyzabc", TILTED, strict=True):
        hal[name] = value / metres if name in "xyz" else value
    for n, length in enumerate(lengths(geometry, TILTED, tool_length)):
        hal[f"strut.{n}"] = length / metres
    hal["tool-offset"] = tool_length / metres
    component.cycle()
    assert hal["valid"] is True
    return hal


@pytest.mark.parametrize(("metres", "tool_length"), [(1e-3, 0.0), (0.0254, 0.05)])
def test_a_machine_that_is_off_as_a_whole(geometry: HexapodGeometry, metres: float, tool_length: float) -> None:
    """A moved base moves the tool with it; moved platform joints move the tool the other way, in its own frame."""
    moved, left = np.array([100e-6, -50e-6, 30e-6]), np.array([20e-6, 40e-6, -60e-6])
    truth = MachineModel("paper", base_deviation=np.tile(moved, (6, 1)), platform_deviation=np.tile(left, (6, 1)))
    hal = machine_component(geometry, truth, metres, tool_length)
    turn = Rotation.from_euler("ZYX", TILTED[5:2:-1], degrees=True).as_matrix()
    error = np.array([hal[f"error-{axis}"] for axis in "xyz"]) * metres
    np.testing.assert_allclose(error, moved - turn @ left, atol=1e-9)
    assert hal["error"] * metres == pytest.approx(np.linalg.norm(error), rel=1e-12)
    true = np.array([hal[f"true-{axis}"] for axis in "xyzabc"])
    np.testing.assert_allclose(true[:3] * metres, TILTED[:3] + error, atol=1e-9)
    np.testing.assert_allclose(true[3:], TILTED[3:], atol=1e-6)


@pytest.mark.parametrize("rate", ["0.09", "1000.1", "nan"])
def test_a_wrong_option_and_a_missing_truth_end_it(rate: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        main(["--rate", rate])
    assert f"argument --rate: must be a number from 0.1 to 1000 Hz, not {rate}" in capsys.readouterr().err
    parsed = [module._parser().parse_args(words).rate for words in ([], ["--rate", "0.1"], ["--rate", "1000"])]
    assert parsed == [50.0, 0.1, 1000.0]
    assert main(["--truth", "nowhere.yaml"]) == 1
    assert capsys.readouterr().err.startswith("cannot start: nowhere.yaml: there is no such file")


def test_the_loop_keeps_its_rate_and_sleeps_in_pieces(monkeypatch: pytest.MonkeyPatch) -> None:
    """At 4 Hz, with a pause of 1 s in the fourth cycle, after which no cycle is made up for; a signal ends the loop.

    The clock stands still except in `sleep`, so a loop without sleep would not end.
    """
    clock, slept, cycles, signals, hal = [1000.0], [], [], [], StandInHal()

    def sleep(seconds: float) -> None:
        slept.append(seconds)
        clock[0] += seconds
        signals.extend([signal.SIGTERM] if clock[0] >= 1002.5 else [])
        assert len(slept) < 100

    def cycle(self: MachineComponent) -> None:
        cycles.append(clock[0] - 1000.0)
        clock[0] += len(cycles) == 4
        assert hal.is_ready is (len(cycles) > 1), "the pins have values before LinuxCNC continues"

    monkeypatch.setattr(module, "time", SimpleNamespace(monotonic=lambda: clock[0], sleep=sleep))
    monkeypatch.setattr(module, "received_signals", lambda: signals)
    monkeypatch.setattr(hal_component, "load_module", lambda: hal)
    monkeypatch.setattr(MachineComponent, "cycle", cycle)
    assert main(["--rate", "4"]) == 0
    np.testing.assert_allclose(cycles, [0.0, 0.0, 0.25, 0.5, 1.5, 1.75, 2.0, 2.25], atol=1e-9)
    np.testing.assert_allclose(slept, [0.1, 0.1, 0.05] * 6, atol=1e-9)
    assert hal.has_left


# Components of dead processes


def test_only_dead_components_are_found(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """The listing has the form of halcmd 2.9; the dead process has just ended."""
    gone = subprocess.Popen([sys.executable, "-c", ""])
    gone.wait()
    listing = (OURS / "components.txt").read_text().format(own=os.getpid(), gone=gone.pid)
    assert dead_components(listing, "hexapod_comp") == [60]
    assert dead_components(listing, "alive") == []
    assert dead_components(listing, "missing") == []
    with monkeypatch.context() as hidden:  # a /proc that shows no process of others
        hidden.setattr(hal_component, "open", MagicMock(side_effect=FileNotFoundError), raising=False)
        assert [dead_components(listing, name) for name in ("hexapod_comp", "alive")] == [[60], []]
    # The executable, with a stand-in for halcmd and for HAL's library
    (tmp_path / "halcmd").write_text(f"#!/bin/sh\ncat <<'END'\n{listing}END\n")
    (tmp_path / "halcmd").chmod(0o755)
    monkeypatch.setenv("PATH", f"{tmp_path}:{os.environ['PATH']}")
    removed: list[int] = []
    codes = {"init": 7, "exit": 0}
    library = SimpleNamespace(
        hal_init=lambda name: codes["init"], hal_exit=lambda n: removed.append(n) or codes["exit"]
    )
    monkeypatch.setattr(hal_component.ctypes, "CDLL", lambda name: library)
    for change, code, said in (
        ({}, 0, "hal_sweep: component hexapod_comp of a dead process removed\n"),
        ({"exit": -22}, 1, "hal_sweep: [Errno 22] hal_exit refused\n"),
        ({"init": -1}, 1, "hal_sweep: no HAL is running\n"),
    ):
        codes |= change
        assert (hal_component.main(["hexapod_comp"]), capsys.readouterr().err) == (code, said)
    assert removed == [60, 60]
