"""The nodes as processes: their start, the loop between them, every way to end, and a log that is not read."""

from __future__ import annotations

import contextlib
import importlib
import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticArray
from hal_stand_in import StandInHal
from helpers import beside
from node_helpers import HOME, closed_form_lengths, near
from sensor_msgs.msg import JointState

from hexapod_comp.errors import NoAnswerError, printable
from hexapod_comp.linuxcnc.bridge import LinuxcncBridgeNode
from hexapod_comp.loop.processes import NodeProcess
from hexapod_comp.loop.session import connect
from hexapod_comp.pose import Pose
from hexapod_comp.ros import PROFILE_VARIABLES, avoid_shared_memory, received_signals
from hexapod_comp.ros.client import LISTENER_QOS, LoopClient, Sent
from hexapod_comp.ros.compensator import main as start_compensator
from hexapod_comp.ros.process import ENDED_WITHIN, LogRelay

PROGRAMS = beside(__file__)
STOP_WITHIN = 5.0  # s; from the signal to the end of the process: then ros2 launch sends the next signal


@pytest.fixture(scope="module")
def running(isolated_ros) -> Iterator[list[LoopClient | NodeProcess]]:
    """Provide what `pair` has started and no test has ended yet: client, compensator, strut drive."""
    made: list[LoopClient | NodeProcess] = []
    yield made
    end(made)


def end(made: list[LoopClient | NodeProcess]) -> None:
    while made:
        one = made.pop()
        one.close() if isinstance(one, LoopClient) else one.stop()


@pytest.fixture
def pair(running) -> list[NodeProcess]:
    """Provide connected compensator, strut drive and client, restarted if a test has ended one of them."""
    if not running or any(node.exit_code() is not None for node in running[1:]):
        end(running)
        running += [LoopClient(), compensator(), NodeProcess("strut_drive", {})]
        connect(running[0], running[1:])
    return running[1:]


def compensator() -> NodeProcess:
    """Start a compensator; the struts start at their measured lengths, so a correction is complete at command two."""
    return NodeProcess("compensator", {"model_file": "paper_machine.yaml", "ramp_rate": 1.0})


@pytest.fixture
def client(running, pair) -> LoopClient:
    return running[0]


def ask(client: LoopClient, pose: Pose) -> Sent:
    """Send one command and wait for its answer."""
    entry = client.send(pose)
    client.wait(lambda: answered(entry), 5.0, "the answer to a command")
    return entry


def answered(entry: Sent) -> bool:
    return bool(np.isfinite(entry.command[0]) and np.isfinite(entry.correction[0]))


def said(client: LoopClient) -> list[str]:
    """Return the list to which messages of the compensator's statuses are appended from now on."""
    messages: list[str] = []

    def listen(array: DiagnosticArray) -> None:
        messages.extend(status.message for status in array.status if status.name.startswith("compensator:"))

    client.node.create_subscription(DiagnosticArray, "/diagnostics", listen, 10)
    return messages


def assert_ends_well(node: NodeProcess, *signals: signal.Signals) -> None:
    """Send signals in turn; check that the process ends in time with code 0 and without a traceback."""
    began = time.monotonic()
    for number in signals:
        node.send(number)
    while node.exit_code() is None and time.monotonic() - began < 30.0:
        time.sleep(0.01)
    assert node.exit_code() == 0, node.output()
    assert time.monotonic() - began < STOP_WITHIN
    assert "Traceback" not in node.output()


# These tests leave nodes running for the next test; the last one ends them.


def test_a_refused_command_is_said_with_its_reason(client, pair):
    """The refusal of a command half a metre up is reported at once, not only when an answer is overdue."""
    ask(client, HOME)
    entry = client.send(near(HOME, (0.0, 0.0, 0.5)))
    with pytest.raises(NoAnswerError, match=r"a command was refused: strut_\d: nominal length .* outside the stroke"):
        client.wait_for_answer(entry, timeout=60.0)


def dropped(pid: int) -> int:
    """Return how many datagrams were dropped at a process's full UDP sockets: the last column of /proc/net/udp."""
    links = [os.readlink(link) for link in Path(f"/proc/{pid}/fd").iterdir() if link.is_symlink()]
    own = {link[len("socket:[") : -1] for link in links if link.startswith("socket:[")}
    rows = [line.split() for line in Path("/proc/net/udp").read_text(encoding="ascii").splitlines()[1:]]
    return sum(int(row[12]) for row in rows if row[9] in own)


def test_a_command_for_which_a_socket_had_no_room_is_repeated_at_once(client, pair):
    """A stopped process's socket is full of readings and loses a command, which must be repeated at once."""
    # Fast DDS repeats lost messages after a heartbeat of the writer, by default every 3 s: too late for a command. No
    # later command brings a heartbeat earlier here.
    compensator, _ = pair
    ask(client, HOME)
    compensator.send(signal.SIGSTOP)
    try:
        client.wait(lambda: dropped(compensator.pid), 10.0, "the socket to be full")
        entry = client.send(HOME)
    finally:
        compensator.send(signal.SIGCONT)
    client.wait(lambda: answered(entry), 5.0, "the answer to a command that was lost")


def test_loop_between_processes(client, pair):
    """A command's answer is near the closed form, the tool moves there, the estimate agrees; all by UDP only."""
    # Three commands, since at the first no strut has a direction of motion yet
    pose = near(HOME, (0.0005, -0.0003, 0.0008))
    accepted, refused = client.counted()
    for share in (0.2, 0.6, 1.0):
        entry = ask(client, near(HOME, (0.0005 * share, -0.0003 * share, 0.0008 * share)))
    np.testing.assert_allclose(entry.command - entry.correction, closed_form_lengths(pose), rtol=0.0, atol=1e-12)
    client.wait(client.settled(), 5.0, "the tool to rest")
    # 0.1 µm steps, 0.05 µm noise and J⁻¹ below 3 give a fraction of a micrometre; without correction it is 100 µm
    assert np.abs(client.true_pose.position - pose.position).max() < 0.5e-6
    assert np.abs(client.estimate.position - pose.position).max() < 2e-6
    assert client.counted() == (accepted + 3, refused)
    for node in pair:
        assert "ready" in node.output()
        # A process killed in another's shared-memory port, which is in /dev/shm/fastrtps_port…, stalls it for seconds
        maps = Path(f"/proc/{node.pid}/maps").read_text(encoding="ascii")
        assert "libfastrtps" in maps
        assert "/dev/shm/fastrtps_port" not in maps
        assert not re.search(r"/(scipy|matplotlib|mujoco)\b", maps), "SciPy takes 40 MB and half a second of a start"
        assert os.getsid(node.pid) == node.pid, "Ctrl-C does not reach it"


def test_compensator_survives_the_end_of_the_drive(client, pair, running):
    """After kill -9 of the drive the compensator continues, reports it, and accepts a new drive."""
    states = said(client)

    def goes_on(state: str) -> bool:
        entry = client.send(HOME)
        client.wait(lambda: answered(entry) or time.monotonic() > entry.sent_at + 0.2, 5.0, "an answer")
        return answered(entry) and states[-1:] == [state]

    client.wait(lambda: goes_on("running"), 10.0, "feedback")
    pair[1].send(signal.SIGKILL)
    client.wait(lambda: goes_on("feedback lost, pose estimated from own commands"), 10.0, "the loss to be said")
    pair[1].stop()
    assert not pair[1].log.exists()
    running[2] = NodeProcess("strut_drive", {})
    client.wait(lambda: goes_on("running"), 20.0, "the new drive to be heard")


def test_a_compensator_restarted_under_a_stream_waits_for_the_struts(client, pair, running):
    """A restarted compensator never commands more than a step of 2 mm from the struts, while commands move on by 120
    mm.

    It must receive commands before readings. This happens by chance at times; here the drive is stopped until the first
    answer or refusal.
    """
    old, drive = pair
    published, came, risen = [], [], 0

    def listen(message: JointState) -> None:
        published.append(np.array(message.position))
        came.append(time.monotonic())

    listening = client.node.create_subscription(JointState, "strut_commands", listen, LISTENER_QOS)
    heights = iter(np.clip(np.arange(0.02, 60.0, 4e-4), 0.0, 0.12))  # 100 mm/s at 250 Hz, then constant

    def higher() -> Pose:
        return near(HOME, (0.0, 0.0, next(heights)))

    def behind_the_answers() -> Pose:  # on a busy computer more than a step of commands or answers may come late
        nonlocal risen
        risen = min(risen + 1, len(published), 50)
        return near(HOME, (0.0, 0.0, 4e-4 * risen))

    def stream(until: Callable[[], object], pose: Callable[[], Pose] = higher) -> None:
        end = time.monotonic() + 60.0
        while not until():
            assert time.monotonic() < end, str(client.diagnostics)
            rest = client.send(pose()).sent_at + 0.004
            client.wait(lambda rest=rest: time.monotonic() >= rest, 1.0, "the next command to be due")

    stream(lambda: len(published) > 50, behind_the_answers)
    old.send(signal.SIGKILL)
    stream(lambda: old.exit_code() is not None and time.monotonic() > came[-1] + 0.2)  # its answers have come
    drive.send(signal.SIGSTOP)
    before, last = len(published), published[-1]
    client.diagnostics = {}
    old.stop()
    running[1] = compensator()
    try:
        stream(lambda: "refused.no_feedback" in client.diagnostics or len(published) > before)
        drive.send(signal.SIGCONT)
        stream(lambda: "refused.step" in client.diagnostics or len(published) > before)
        steps = np.abs(np.diff(published, axis=0)).max(axis=1)
        assert steps.max() <= 2e-3 + 1e-9, f"it stepped by {steps.max() * 1e3:.1f} mm"
        client.wait(client.settled(), 5.0, "the tool to rest")
        here = client.estimate
        stream(lambda: len(published) > before, lambda: here)
        assert np.abs(published[-1] - last).max() <= 2e-3 + 1e-9
    finally:
        drive.send(signal.SIGCONT)
        client.node.destroy_subscription(listening)


def test_signals_end_both_with_0(client, pair, running):
    """Both nodes end with code 0, also after a double SIGINT as from ``ros2 launch``; the last status is received.

    The drive is stopped meanwhile: the compensator must not wait for the acknowledgements of a process that hangs.
    """
    states = said(client)
    client.wait(client.settled(), 5.0, "the tool to rest")
    ask(client, client.estimate)
    client.wait(lambda: bool(states), 5.0, "a status")
    pair[1].send(signal.SIGSTOP)
    try:
        ask(client, client.estimate)
        assert_ends_well(pair[0], signal.SIGINT, signal.SIGINT)
    finally:
        pair[1].send(signal.SIGCONT)
    client.wait(lambda: states[-1] == "not active", 2.0, "the compensator's last status")
    assert_ends_well(pair[1], signal.SIGHUP, signal.SIGTERM)
    end(running)


def test_a_bad_start_ends_with_1_and_a_clear_word(isolated_ros):
    """A file that is missing is noticed by a node that runs, a value above its range before the node is made."""
    bad = {
        "compensator": ("geometry_file:=nowhere.yaml", ["cannot configure", "nowhere.yaml", "paper.yaml"]),
        "strut_drive": ("strut_drive:lag:=50", ["cannot start: parameter", "s, not 50"]),
    }
    started = {
        name: program([f"-mhexapod_comp.ros.{name}", "--ros-args", "-p", word]) for name, (word, _) in bad.items()
    }
    for name, process in started.items():
        said, _ = process.communicate(timeout=60.0)
        assert process.returncode == 1, said
        assert all(text in said for text in bad[name][1]), said
        assert "Traceback" not in said


# Executables: module, and texts of their help
EXECUTABLES = {
    "compensator": ("ros.compensator", "model_file  [ideal]", "tool_pose_command"),
    "strut_drive": ("ros.strut_drive", "truth_file  [paper_machine.yaml]", "strut_commands"),
    "linuxcnc_bridge": ("linuxcnc.bridge", "units  [mm]", "strut_corrections"),
}


@pytest.mark.parametrize("name", EXECUTABLES)
def test_help_lists_every_parameter_and_the_topics(name, capsys):
    module = importlib.import_module(f"hexapod_comp.{EXECUTABLES[name][0]}")
    assert module.PROGRAM.refusal(["--help"]) == 0
    out, err = capsys.readouterr()
    assert err == ""
    assert out.startswith(f"usage: {name} ")
    assert all(text in out for text in EXECUTABLES[name][1:])
    assert all(f"  {parameter.name}  [" in out for parameter in module.PROGRAM.parameters)
    assert max(map(len, out.splitlines())) <= 120


WITHOUT_ROS_ARGS = ["-p model_file:=mine.yaml", "model_file:=mine.yaml", "--model mine.yaml", "--hel", "mine\n\x1b[2J"]
BEHIND = ["-p autostart:=false -- late", "-p no_assignment", "--parms-file x.yaml"]


@pytest.mark.parametrize("typed", [*WITHOUT_ROS_ARGS, *(f"--ros-args {words}" for words in BEHIND)])
def test_an_argument_that_nobody_reads_ends_with_2_and_is_named(typed, capsys, monkeypatch):
    arguments = typed.split(" ")
    monkeypatch.setattr(sys, "argv", ["compensator", *arguments])
    assert start_compensator() == 2
    out, err = capsys.readouterr()
    assert out == ""
    said = err.splitlines()[-1]
    assert said.startswith("compensator: error: ")
    assert said.isprintable()
    assert printable(arguments[-1]) in said


@pytest.mark.parametrize("name", ["a parent", "a study"])
def test_processes_end_when_their_parent_is_killed(isolated_ros, name):
    """kill -9 of a demonstration must leave no machine running, and of `classify` no processes that wait for ever."""
    parent = program(["-c", PROGRAMS[name]])
    pid = int(parent.stdout.readline())
    parent.kill()
    parent.wait()
    end = time.monotonic() + 20.0
    while runs(pid) and time.monotonic() < end:
        time.sleep(0.05)
    assert not runs(pid)


def runs(pid: int) -> bool:
    """Return whether a process is running; a zombie is not."""
    try:
        with open(f"/proc/{pid}/stat") as stat:
            return stat.read().rsplit(")", 1)[1].split()[0] != "Z"
    except (FileNotFoundError, ProcessLookupError):
        return False


@pytest.mark.parametrize("variable", PROFILE_VARIABLES)
def test_the_users_own_fast_dds_profile_stays(monkeypatch, variable):
    for name in PROFILE_VARIABLES:
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv(variable, "/own.xml")
    avoid_shared_memory()
    assert {name: os.environ[name] for name in PROFILE_VARIABLES if name in os.environ} == {variable: "/own.xml"}


# ---- begin and end of a program ----

GONE_WITHIN = 5.0
"""Longest time from a signal to the end of a process on a busy computer, s; on an idle one it is 0.2 s."""


def program(arguments: list[str], **options: object) -> subprocess.Popen[str]:
    """Start Python; return the process, whose stdout and stderr are one pipe."""
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.STDOUT, "text": True}
    return subprocess.Popen([sys.executable, *arguments], **pipes | options)


@pytest.mark.parametrize(
    ("hangs", "code", "said"),
    [
        ("ctypes.PyDLL(None).sleep(60)", 1, "in destroy_node"),  # as DDS does at times, holding Python's lock
        ("threading.Thread(target=threading.Event().wait, args=(60,)).start()", 0, ""),  # this blocks the end of Python
    ],
    ids=["holding Python's lock", "a thread that never ends"],
)
def test_an_end_that_hangs_is_cut_short_and_says_where(isolated_ros, tmp_path, hangs, code, said):
    """One compensator in 390 did not end, as a signal only sets a flag; now it is cut short and its place logged."""
    made = program(["-c", PROGRAMS["hanging"].format(hangs=hangs)], cwd=tmp_path)
    try:
        assert "alive\n" in [made.stdout.readline() for _ in range(3)]  # in any order
        made.send_signal(signal.SIGTERM)
        began = time.monotonic()
        rest, _ = made.communicate(timeout=30.0)
        assert time.monotonic() - began < 0.5 + GONE_WITHIN
        assert made.returncode == code, rest
        assert said in rest
    finally:
        made.kill()
    assert ENDED_WITHIN < 5.0  # after 5 s ros2 launch sends another signal, and then kills


def test_a_signal_while_modules_load_ends_a_program_without_a_traceback(tmp_path: Path):
    """Loading takes seconds on a busy computer; here it never ends, in small steps as in reality.

    Python handles signals between steps, so in one long wait a signal just before it would be lost.
    """
    (tmp_path / "endless.py").write_text("import time\nprint('loading', flush=True)\nwhile True: time.sleep(0.01)\n")
    process = program(["-c", "from hexapod_comp.ros import start; start('endless')"], cwd=tmp_path)  # with `endless`
    assert process.stdout.readline() == "loading\n"
    process.send_signal(signal.SIGTERM)
    rest, _ = process.communicate(timeout=GONE_WITHIN)
    assert (process.returncode, rest) == (0, "")


def test_a_signal_within_anothers_handler_does_not_wait_for_it():
    """``ros2 launch`` and its terminal send one signal each: here the second comes at every line of the handler."""
    process = program(["-c", PROGRAMS["second signal"]])
    assert process.communicate(timeout=60.0)[0] == "2 15\n"


# ---- streams and topics that are not available ----


def test_closed_streams_are_opened_again() -> None:
    """rclpy's executor enables faulthandler, which raises an error without stderr: the node ended after "ready"."""
    done = subprocess.run(
        ["sh", "-c", 'exec "$0" -c "$1" 0>&- 1>&- 2>&-', sys.executable, PROGRAMS["closed streams"]], check=False
    )
    assert done.returncode == 7


def test_a_hang_up_ends_a_node_as_other_signals_do_unless_it_is_ignored() -> None:
    """SIGHUP ends a node, unless it is ignored as under nohup."""
    before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)}
    signal.signal(signal.SIGHUP, signal.SIG_DFL)  # pytest itself may run under nohup
    try:
        heard = received_signals()
        signal.raise_signal(signal.SIGHUP)
        assert heard == [signal.SIGHUP]
        signal.signal(signal.SIGHUP, signal.SIG_IGN)
        heard = received_signals()
        signal.raise_signal(signal.SIGHUP)
        signal.raise_signal(signal.SIGTERM)
        assert heard == [signal.SIGTERM]
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def test_a_topic_that_cannot_be_opened_is_said_and_leaves_nothing_open(rig, monkeypatch) -> None:
    """The reason is reported (an AttributeError had hidden it), and the node may be configured again."""
    node = rig.add(LinuxcncBridgeNode, False, {}, hal=StandInHal())
    rig.may_catch = True

    def ends() -> list[int]:
        return [len(list(all_of)) for all_of in (node.publishers, node.subscriptions, node.services, node.timers)]

    def fails(*_: object) -> None:
        raise RuntimeError("no more topics")

    before = ends()
    with monkeypatch.context() as patch:
        patch.setattr("hexapod_comp.linuxcnc.bridge.CompensatorReset", fails)
        node.trigger_configure()
    assert rig.logged("RuntimeError: no more topics")
    assert ends() == before
    node.publish_last_status()
    assert node.unconfigured
    node.trigger_configure()
    assert not node.unconfigured


# ---- a log that is not read ----


def test_all_lines_arrive_in_order(monkeypatch) -> None:
    pipes = [os.pipe() for _ in range(2)]
    monkeypatch.setattr("hexapod_comp.ros.process.STREAMS", [sink for _, sink in pipes])

    def read(source: int) -> bytes:
        found = b""
        while not found.endswith(b"end"):
            found += os.read(source, 1 << 16)
        return found.removesuffix(b"end")

    with ThreadPoolExecutor() as pool:
        out, said = [pool.submit(read, source) for source, _ in pipes]
        with LogRelay():
            os.write(pipes[0][1], b"out")
            for n in range(20000):
                os.write(pipes[1][1], b"%d\n" % n)
        for _, sink in pipes:
            assert os.get_blocking(sink)  # the pipe itself again
            os.write(sink, b"end")
    assert out.result() == b"out"
    assert said.result().split() == [b"%d" % n for n in range(20000)]


def test_a_reader_that_does_not_read_stops_nobody(monkeypatch) -> None:
    """16 MB go to a pipe of 64 kB; without the relay the process would wait for ever."""
    reading, writing = os.pipe()
    monkeypatch.setattr("hexapod_comp.ros.process.STREAMS", [writing])
    with LogRelay():
        for _ in range(16384):
            with contextlib.suppress(BlockingIOError):
                os.write(writing, b"x" * 1023 + b"\n")
    os.close(reading)  # which ends the relay's thread


def test_a_closed_stream_and_a_file_are_left_alone(monkeypatch, tmp_path) -> None:
    with (tmp_path / "log").open("wb") as log:
        closed, _ = ends = os.pipe()
        for one in ends:
            os.close(one)
        monkeypatch.setattr("hexapod_comp.ros.process.STREAMS", [closed, log.fileno()])
        with LogRelay():
            assert os.path.samestat(os.fstat(log.fileno()), (tmp_path / "log").stat())
