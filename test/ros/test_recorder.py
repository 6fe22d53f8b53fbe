"""``record`` on a disk that becomes full and in a folder that disappears, and the verb ``echo``.

The truth is the messages sent, a simulated disk, what rosbags reads back, and units converted by hand."""

from __future__ import annotations

import json
import math
import shutil
import signal
import subprocess
import sys
import threading
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import rclpy
from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from geometry_msgs.msg import PoseStamped, PoseWithCovarianceStamped, Vector3
from node_helpers import HOME, Bench, near
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.serialization import serialize_message
from replay_helpers import RecordedMachine
from sensor_msgs.msg import JointState, RelativeHumidity, Temperature, TimeReference
from std_msgs.msg import Float64MultiArray, String

from hexapod_comp import cli
from hexapod_comp.errors import InputFileError
from hexapod_comp.machine.geometry import STRUT_NAMES
from hexapod_comp.pose import Pose
from hexapod_comp.replay.bag import Recording, read_recording
from hexapod_comp.replay.replay import BEFORE, IDENTICAL, Replay, replay_recording
from hexapod_comp.ros import recorder
from hexapod_comp.ros.echo import Echo, EchoedMessage, MessageField, MessageIntervals, message_fields
from hexapod_comp.ros.recorder import RESERVE, BagRecorder, BagWriter


def replayed(bag: Path, namespace: str | None = None) -> tuple[Recording, Replay]:
    recording = read_recording(bag, namespace)
    return recording, replay_recording(recording)


def along(n: int) -> Pose:
    """Return pose number `n` of a motion that reverses struts, slow enough for a command every millisecond."""
    return near(
        HOME, (6e-4 * np.sin(0.1 * n), 4e-4 * np.sin(0.13 * n), 2e-4 * np.sin(0.07 * n)), 0.06 * np.sin(0.1 * n)
    )


def wait_for_page(rig: Bench) -> None:
    """Wait for a page of the journal that begins from now on; pages come with the diagnostics."""
    pages = len(rig.seen["/diagnostics"])
    rig.until(lambda: len(rig.seen["/diagnostics"]) > pages + 1, "another page of the journal")


def test_what_the_verb_records_is_replayed_and_a_folder_that_is_there_is_left_alone(bench, tmp_path):
    """The recorder runs in a process, as for a user, beside a compensator that is already moving."""
    bench.compensator()
    answers = [bench.ask(along(n)) for n in range(20)]
    command = [sys.executable, "-m", "hexapod_comp", "record", "--out", str(tmp_path / "run")]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    journal = next(p for p in bench.nodes[0].publishers if p.topic_name.endswith("/journal"))
    bench.until(journal.get_subscription_count, "the recorder", timeout=60.0)
    commands = next(p for p in bench.nodes[0].publishers if p.topic_name == "/strut_commands")
    bench.until(lambda: commands.get_subscription_count() > 1, "the recorder of commands")
    wait_for_page(bench)  # earlier commands cannot be compared
    answers += [bench.ask(along(n)) for n in range(20, 60)]
    wait_for_page(bench)
    process.send_signal(signal.SIGINT)
    output, errors = process.communicate(timeout=30.0)
    assert process.returncode == 0, errors
    assert "/compensator/journal" in output
    recording, result = replayed(tmp_path / "run")
    judged = result.outcome[result.outcome != BEFORE]
    assert (judged == IDENTICAL).all()
    assert len(judged) >= 40
    assert recording.recorded >= 40
    with pytest.raises(InputFileError, match="exists already"):
        BagRecorder(tmp_path / "run")


# ---- the disk ----


def record(bag: BagWriter, machine: RecordedMachine, times: int) -> None:
    """Write a machine's messages, and as many bytes of other messages."""
    for _, topic, kind, raw in machine.messages:
        bag.write(topic, kind, raw)
    for _ in range(times):
        bag.write("/padding", "std_msgs/msg/String", b"\0\1\0\0" + (100_000).to_bytes(4, "little") + b"x" * 100_000)


@pytest.fixture(scope="module")
def machine() -> RecordedMachine:
    made = RecordedMachine()
    made.wave(20)
    made.page()
    return made


@pytest.mark.parametrize("room", [0.5, 17.0])
def test_a_recording_ends_while_its_disk_has_room_to_close_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, machine: RecordedMachine, room: float
) -> None:
    """The disk's free space above the reserve, MB, shrinks by the size of the bag's file; the truth is a replay."""
    run = tmp_path / "run"

    def usage(folder: Path) -> SimpleNamespace:
        return SimpleNamespace(free=RESERVE + room * 1e6 - sum(path.stat().st_size for path in folder.iterdir()))

    monkeypatch.setattr(recorder.shutil, "disk_usage", usage)
    bag = BagWriter(run)
    record(bag, machine, 600)
    bag.close()
    assert (
        bag.problem
        == "less than 64 MB are free on its disk; all messages received until then are recorded and can be replayed"
    )
    assert bag.counts["/padding"] * 0.1 < room + 18.0, "some 16 MB and a chunk after the last look at the latest"
    result = replay_recording(read_recording(run))
    assert result.identical
    assert result.compared == 20


def test_a_disk_without_room_is_refused_at_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(recorder.shutil, "disk_usage", lambda _: SimpleNamespace(free=RESERVE - 1))
    with pytest.raises(InputFileError, match="run: cannot be made: less than 64 MB are free on its disk"):
        BagWriter(tmp_path / "run")
    assert not (tmp_path / "run").exists()


def test_a_bag_that_was_removed_is_noticed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    machine = RecordedMachine()
    bag = BagWriter(tmp_path / "run")
    record(bag, machine, 1)
    monkeypatch.setattr(recorder, "CHECK_PERIOD", 0.0)
    bag.check_disk()
    assert not bag.problem
    shutil.rmtree(tmp_path / "run")
    bag.check_disk()
    assert bag.problem == "was removed or moved while it was written"
    bag.close()


def test_progress_counts_the_messages_of_each_spin() -> None:
    """A recording goes on until it is told to end, or until its bag has a problem."""
    recorder, told, seen = object.__new__(BagRecorder), list[int](), iter([2, 0, 3, 4])
    recorder._bag, recorder.counts = SimpleNamespace(problem="", check_disk=lambda: None), {"/a": 0}

    def spin_once(seconds: float) -> None:
        recorder.counts["/a"] += next(seen)

    recorder.spin_once, going_on = spin_once, iter([True] * 3 + [False, True])  # type: ignore[method-assign]
    recorder.run(lambda: next(going_on), told.append)
    recorder._bag.problem = "full"
    recorder.run(lambda: next(going_on), told.append)
    assert told == [2, 0, 3]


def test_a_folder_that_was_moved_keeps_a_whole_file(tmp_path: Path, machine: RecordedMachine) -> None:
    bag = BagWriter(tmp_path / "run")
    record(bag, machine, 1)
    (tmp_path / "run").rename(tmp_path / "elsewhere")
    bag.close()
    assert "metadata.yaml could not be written" in bag.problem
    assert replay_recording(read_recording(tmp_path / "elsewhere")).identical


# ---- the verb echo ----


def keyed(topic: str, message: object) -> dict[str, object]:
    return {row.key: row.value for row in message_fields(topic, message)}


def struts(*lengths: float) -> JointState:
    return JointState(name=list(STRUT_NAMES), position=list(lengths), velocity=[0.0] * 6)


def test_struts_are_in_mm_and_corrections_in_um():
    def rows(what: str, *values: float) -> dict[str, object]:
        return pytest.approx({f"strut_{n}_{what}": value for n, value in enumerate(values, 1)})

    message = struts(0.5, 0.6, 0.7, 0.8, 0.9, 1.0)
    assert keyed("/strut_commands", message) == rows("mm", 500.0, 600.0, 700.0, 800.0, 900.0, 1000.0)
    message = struts(1e-6, 2e-6, -3e-6, 0.0, 0.0, 0.0)  # struts at rest have no speeds
    assert keyed("/m1/strut_corrections", message) == rows("um", 1.0, 2.0, -3.0, 0.0, 0.0, 0.0)
    message.velocity = [0.0, 0.012, 0.0, 0.0, 0.0, 0.0]
    speeds = dict(list(keyed("/strut_commands", message).items())[6:])
    assert speeds == rows("speed_mm_s", 0.0, 12.0, 0.0, 0.0, 0.0, 0.0)
    others = JointState(name=["strut_1", "strut_1_universal"], position=[0.5, 0.1])
    assert keyed("/joint_states", others)["position[1]"] == 0.1
    assert keyed("/strut_commands_array", Float64MultiArray(data=[0.5] * 6))["strut_6_mm"] == pytest.approx(500.0)


def test_a_pose_is_in_mm_and_the_papers_angles():
    message = PoseStamped()
    message.header.frame_id = "work"
    message.pose.position.x = -0.0125
    half = math.radians(5.0) / 2.0
    message.pose.orientation.x, message.pose.orientation.w = math.sin(half), math.cos(half)  # α: about x
    shown = EchoedMessage("/pose", message_fields("/pose", message), 1.5, 0.0123, 99.96)
    assert f"{shown.text()}\n" == Path(__file__).with_name("echoed_pose.txt").read_text(encoding="utf-8")
    angles = {"alpha_deg": pytest.approx(5.0), "beta_deg": 0.0, "gamma_deg": 0.0}
    head = {"topic": "/pose", "stamp_s": 1.5, "age_ms": pytest.approx(12.3), "rate_hz": 99.96, "frame": "work"}
    assert shown.record() == {**head, "x_mm": -12.5, "y_mm": 0.0, "z_mm": 0.0, **angles}
    rows = [MessageField("x", 0.0, unit) for unit in ["mm", "um", "deg", "urad", "mm_s", "degC", "percent", "s", "kg"]]
    shown = [line.split()[1] for line in EchoedMessage("/x", rows, *[math.nan] * 3).text().splitlines()[1:]]
    assert [len(number.partition(".")[2]) for number in shown] == [6, 3, 6, 3, 3, 2, 1, 6, 9]
    first = EchoedMessage("/pose", [], math.nan, math.nan, math.nan)
    assert first.text() == "/pose, no stamp"
    message.pose.orientation.w = 3.0  # not a rotation: shown as sent
    assert keyed("/tool_pose_estimate", message)["qw"] == 3.0


UNITS = [("x", "um"), ("y", "um"), ("z", "um"), ("rx", "urad"), ("ry", "urad"), ("rz", "urad")]


def test_a_predicted_error_is_a_vector_with_deviations():
    message = PoseWithCovarianceStamped()
    message.pose.pose.position.y = 7e-6
    message.pose.pose.orientation.z, message.pose.pose.orientation.w = math.sin(-10e-6), math.cos(-10e-6)
    message.pose.covariance[7] = (2e-6) ** 2
    message.pose.covariance[35] = math.nan
    rows = keyed("/compensator/predicted_error", message)
    names = [f"{axis}{what}_{unit}" for axis, unit in UNITS for what in ("", "_sigma")]
    wanted = dict.fromkeys(names, 0.0) | {"frame": "", "y_um": 7.0, "y_sigma_um": 2.0, "rz_urad": -20.0}
    assert rows == pytest.approx(wanted | {"rz_sigma_urad": math.nan}, nan_ok=True)


def test_what_has_no_unit_of_ours_is_named_by_its_fields():
    assert keyed("/x", Vector3(y=2.0)) == {"x": 0.0, "y": 2.0, "z": 0.0}
    many = keyed("/array", Float64MultiArray(data=[0.0] * 14))
    assert list(many)[-13:] == [*(f"data[{n}]" for n in range(12)), "data"]
    assert many["data"] == "… 14 items"
    valid = TimeReference(source="/strut_commands", time_ref=Time(sec=8, nanosec=100_000_000))
    valid.header.stamp.sec = 8
    assert keyed("/validity", valid) == {"valid_for_s": pytest.approx(0.1), "source": "/strut_commands"}
    assert keyed("/temperatures", Temperature(temperature=21.5)) == {"temperature_degC": 21.5}
    assert keyed("/humidity", RelativeHumidity(relative_humidity=0.45))["humidity_percent"] == pytest.approx(45.0)
    status = DiagnosticStatus(
        level=b"\x02", name="compensator: state", message="stopped", values=[KeyValue(key="refused", value="3")]
    )
    rows = keyed("/diagnostics", DiagnosticArray(status=[status]))
    assert rows == {"compensator: state": "ERROR: stopped", "  refused": "3"}


def test_the_rate_is_of_the_last_messages_and_the_mean_of_all():
    """After ten messages a second for 5 s and two a second for 2 s, the last 2 s have five messages."""
    intervals = MessageIntervals()
    told = [(intervals.recent_rate, intervals.text())]
    for time in (0.0, 0.1, 0.4):
        intervals.add(time)
        told.append((intervals.recent_rate, intervals.text()))
    texts = ["0", "1", "2, 10.00 Hz, 100.0 to 100.0 ms apart", "3, 5.00 Hz, 100.0 to 300.0 ms apart"]
    assert [text.removeprefix("messages: ") for _, text in told] == texts
    assert [rate for rate, _ in told] == pytest.approx([math.nan, math.nan, 10.0, 5.0], nan_ok=True)
    times = {"shortest_ms": 100.0, "longest_ms": 300.0}
    assert intervals.record() == pytest.approx({"messages": 3, "rate_hz": 5.0, **times})
    intervals = MessageIntervals()
    for time in [0.1 * n for n in range(51)] + [5.0 + 0.5 * n for n in range(1, 7)]:
        intervals.add(time)
    assert intervals.recent_rate == pytest.approx(2.0)
    assert intervals.rate == pytest.approx(56 / 8.0)


@pytest.fixture
def node(hexapod_context: Any) -> Iterator[Node]:
    made = rclpy.create_node("publishing", context=hexapod_context)
    yield made
    made.destroy_node()


def test_what_cannot_be_read_is_said_and_does_not_end_it(node):
    received: list[EchoedMessage] = []
    node.create_publisher(String, "said", 1)
    echo = Echo(node, lambda seconds: None, "said", received.append)
    for data in (b"\x00", *(serialize_message(String(data=count * "x")) for count in (1_000_000, 1))):
        echo._on_message(bytes(data))
    assert "cannot be read" in received[0].text()
    assert "must not have more than 262144 bytes" in received[1].record()["problem"]
    assert received[2].record()["data"] == "x"
    assert echo.intervals.count == 3


@pytest.mark.parametrize("latched", [False, True], ids=["best_effort", "latched"])
def test_the_verb_prints_what_is_published(node, capfd, latched):
    """The subscription follows the offered QoS (best effort, latched); otherwise nothing would be received."""
    qos = QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT)
    if latched:
        qos = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
    publisher = node.create_publisher(String, "named", qos)
    publisher.publish(String(data="probe"))
    done = threading.Event()

    def repeat() -> None:
        while not (latched or done.wait(0.02)):
            publisher.publish(String(data="probe"))

    thread = threading.Thread(target=repeat)
    thread.start()
    try:
        assert cli.main(["echo", "named", "--count", "1", "--seconds", "20", "--json"]) == 0
    finally:
        done.set()
        thread.join()
    assert json.loads(capfd.readouterr().out)["data"] == "probe"


def test_a_topic_that_nobody_publishes_is_refused_with_a_close_one(node, capfd, monkeypatch):
    monkeypatch.setattr("hexapod_comp.ros.echo.DISCOVERY_TIME", 1.0)
    node.create_publisher(String, "strut_commands", 1)
    assert cli.main(["echo", "strut_comands"]) == 2
    error = capfd.readouterr().err
    assert "no node publishes /strut_comands" in error
    assert "did you mean /strut_commands" in error
    assert cli.main(["echo", "strut commands"]) == 2
    assert "'strut commands' is not a valid topic name" in capfd.readouterr().err
