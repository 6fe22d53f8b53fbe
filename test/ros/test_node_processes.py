"""How a program of a node begins and ends: signals at any time, closed streams, topics that cannot be opened, a log
that nobody reads; and what it loads."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import textwrap
import time
from pathlib import Path

import pytest
from hal_stand_in import StandInHal
from rclpy.context import Context

from hexapod_comp.linuxcnc import bridge as bridge_module
from hexapod_comp.linuxcnc.bridge import LinuxcncBridgeNode
from hexapod_comp.ros import compensator as compensator_module
from hexapod_comp.ros import received_signals
from hexapod_comp.ros.compensator import CompensatorNode
from hexapod_comp.ros.process import ENDED_WITHIN

ROOT = Path(__file__).resolve().parents[2]

STOP_WITHIN = 5.0
"""From a signal to the end of a process, s, on a machine under heavy load: alone it is 0.2 s."""


HEARS_SIGINT = "import signal; signal.signal(signal.SIGINT, signal.default_int_handler)\n"
"""The background jobs of a shell, these tests perhaps, ignore it, and so do their children."""


def script(text: str, folder: Path) -> subprocess.Popen[str]:
    """Start a program of ours."""
    environment = {**os.environ, "PYTHONPATH": f"{ROOT}{os.pathsep}{ROOT / 'test'}"}
    command = [sys.executable, "-c", HEARS_SIGINT + textwrap.dedent(text)]
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.STDOUT, "text": True}
    return subprocess.Popen(command, cwd=folder, env=environment, **pipes)


HANGING = """
import ctypes, sys, threading
from hexapod_comp.ros import process
from hexapod_comp.ros.parameters import Program
from hexapod_comp.ros.base import MachineNode

process.ENDED_WITHIN = 0.5

class Hanging(MachineNode):
    wants_autostart = False

    def __init__(self):
        super().__init__("hanging")
        self.every(0.05, self.speak)

    def speak(self):
        print("alive\\n", end="", flush=True)  # in one piece: the log writes beside it

    def destroy_node(self):
        {hangs}
        super().destroy_node()

sys.argv[:] = ["hanging"]
sys.exit(process.run(Hanging, Program("hanging", "Hangs.", ())))
"""


@pytest.mark.parametrize(
    ("hangs", "code", "said"),
    [
        ("ctypes.PyDLL(None).sleep(60)", 1, "in destroy_node"),  # as DDS does now and then: with Python's lock
        ("threading.Event().wait(60)", 1, "in destroy_node"),
        ("threading.Thread(target=threading.Event().wait, args=(60,)).start()", 0, ""),  # hangs the end of Python
    ],
    ids=["holding Python's lock", "waiting", "a thread that never ends"],
)
def test_an_end_that_hangs_is_cut_short_and_says_where(isolated_ros, tmp_path, hangs, code, said):
    """One compensator in 390 did not end: a signal only sets a flag that nobody looks at any more."""
    made = script(HANGING.format(hangs=hangs), tmp_path)
    try:
        assert "alive\n" in [made.stdout.readline() for _ in range(3)]  # in any order
        made.send_signal(signal.SIGTERM)
        began = time.monotonic()
        rest, _ = made.communicate(timeout=30.0)
        assert time.monotonic() - began < 0.5 + STOP_WITHIN
        assert made.returncode == code, rest
        assert said in rest
    finally:
        made.kill()
    assert ENDED_WITHIN < 5.0  # after which ros2 launch asks again, and then kills


def test_a_node_without_anybody_to_print_to_ends_in_order(isolated_ros):
    """As a service manager may start it; a failed start ends with 1, as with a terminal."""
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    command = f"{sys.executable} -m hexapod_comp.ros.compensator --ros-args -p geometry_file:=nowhere.yaml >&- 2>&-"
    assert subprocess.run(["sh", "-c", command], env=environment, timeout=60.0, check=False).returncode == 1


def test_a_signal_while_modules_load_ends_a_program_without_a_traceback(tmp_path: Path):
    """Loading takes seconds on a busy computer; here it takes for ever, in small steps as there.

    In one long wait a signal would be lost that came just before it: Python looks at it between two steps only.
    """
    (tmp_path / "endless.py").write_text("import time\nprint('loading', flush=True)\nwhile True: time.sleep(0.01)\n")
    program = "from hexapod_comp.ros import start; start('endless')"
    process = script(program, tmp_path)  # where `endless` is
    assert process.stdout.readline() == "loading\n"
    process.send_signal(signal.SIGTERM)
    rest, _ = process.communicate(timeout=STOP_WITHIN)
    assert (process.returncode, rest) == (0, "")


def test_a_signal_within_anothers_handler_does_not_wait_for_it():
    """``ros2 launch`` and its terminal send one each. At every line that Python runs for the first comes a second."""
    program = """
import signal, sys
from hexapod_comp.ros import received_signals

def second(*_):
    signal.raise_signal(signal.SIGTERM)
    return second

heard = received_signals()
sys.settrace(second)
signal.raise_signal(signal.SIGINT)
sys.settrace(None)
print(*sorted(set(heard)))
"""
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=60.0, check=False)
    assert (done.returncode, done.stdout) == (0, "2 15\n"), done.stderr


def test_a_node_loads_no_scipy():
    """40 MB a node, and half a second of its start: what needs SciPy is loaded where it is used."""
    program = """
import sys
import hexapod_comp.ros.compensator
import hexapod_comp.ros.strut_drive
from hexapod_comp.compensation.compensator import Compensator
from hexapod_comp.machine.geometry import load_geometry
from hexapod_comp.machine.model_file import load_model

geometry = load_geometry("paper")
compensator = Compensator(geometry, load_model("paper_machine", geometry))
home = geometry.tool_pose(geometry.home)
compensator.step((*home.position, *home.quaternion()), 0.0)
compensator.estimate(compensator.command)
print(*sorted(name for name in sys.modules if name.partition(".")[0] in ("scipy", "matplotlib", "mujoco")))
"""
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=100)
    assert (done.returncode, done.stdout) == (0, "\n"), done.stderr


# ---- streams and topics that cannot be had ----


def test_closed_streams_are_opened_again() -> None:
    """rclpy's executor switches faulthandler on, which raises without a stderr: the node ended after "ready"."""
    program = (
        "import os, sys\n"
        "from hexapod_comp.ros import open_streams\n"
        "open_streams()\n"
        "import faulthandler\n"
        "faulthandler.enable()\n"
        "print('lost', file=sys.stderr)\n"
        "pipe = os.pipe()\n"
        "sys.exit(7 if min(pipe) > 2 else 1)\n"
    )
    done = subprocess.run(["sh", "-c", 'exec "$0" -c "$1" 0>&- 1>&- 2>&-', sys.executable, program], check=False)
    assert done.returncode == 7


def test_a_hang_up_ends_a_node_as_other_signals_do_unless_it_is_ignored() -> None:
    """As nohup has it."""
    before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)}
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


NO_MORE = {
    "requests": (CompensatorNode, compensator_module, "Requests"),
    "a bridge's reset": (LinuxcncBridgeNode, bridge_module, "CompensatorReset"),
}


@pytest.mark.parametrize("part", NO_MORE)
def test_a_topic_that_cannot_be_opened_is_said_and_leaves_nothing_open(
    part: str, ros_context: Context, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    """The node's goodbye had hidden the reason behind an AttributeError. It may be configured once more."""
    kind, module, name = NO_MORE[part]
    node = kind(context=ros_context, **({"hal": StandInHal()} if kind is LinuxcncBridgeNode else {}))

    def ends() -> list[int]:
        return [len(list(all_of)) for all_of in (node.publishers, node.subscriptions, node.services, node.timers)]

    def fails(*_: object) -> None:
        raise RuntimeError("no more topics")

    before = ends()
    with monkeypatch.context() as patch:
        patch.setattr(module, name, fails)
        node.trigger_configure()
    assert "RuntimeError: no more topics" in capfd.readouterr().err
    assert ends() == before
    node.publish_last_status()
    assert node.unconfigured
    node.trigger_configure()
    assert not node.unconfigured
    node.publish_last_status()
    node.destroy_node()


# ---- a log that nobody reads ----

RELAYED = """
import os, sys, time
from hexapod_comp.ros.process import LogRelay

def write(stream, text):
    try:
        return os.write(stream, text.encode())
    except BlockingIOError:
        return 0

with LogRelay():
    {body}
"""


def relayed(body: str, **streams: object) -> subprocess.Popen[bytes]:
    """Run a few lines within a LogRelay in a process of its own."""
    return subprocess.Popen([sys.executable, "-c", RELAYED.format(body=body)], **streams)


def test_all_lines_arrive_in_order() -> None:
    body = "os.write(1, b'out'); [write(2, f'{i}\\n') for i in range(20000)]"
    child = relayed(body, stdout=subprocess.PIPE, stderr=subprocess.PIPE)
    out, said = child.communicate(timeout=60)
    assert (child.returncode, out) == (0, b"out")
    assert said.split() == [b"%d" % i for i in range(20000)]


def test_a_reader_that_does_not_read_stops_nobody() -> None:
    """16 MB into a pipe that takes 64 kB: without the relay the process would wait for ever."""
    reading, writing = os.pipe()
    body = "for i in range(16384): write(2, 'x' * 1023 + '\\n')"
    try:
        child = relayed(body, stderr=writing)
        assert child.wait(60) == 0
    finally:
        os.close(reading)
        os.close(writing)


def test_a_closed_stream_and_a_file_are_left_alone(tmp_path) -> None:
    path = tmp_path / "log"
    with path.open("wb") as log:
        child = relayed("os.write(2, b'straight')", stderr=log, preexec_fn=lambda: os.close(1))
        assert child.wait(60) == 0
    assert path.read_bytes() == b"straight"
