"""How a program of a node ends: by a signal, at any time; and what it loads."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import textwrap
import time
from pathlib import Path

import pytest

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
        assert "alive\n" in [made.stdout.readline() for _ in range(2)]  # and its domain, whichever comes first
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


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_while_modules_load_ends_a_program_without_a_traceback(tmp_path: Path, number: int):
    """Loading takes seconds on a busy computer; here it takes for ever, in small steps as there.

    In one long wait a signal would be lost that came just before it: Python looks at it between two steps only.
    """
    (tmp_path / "endless.py").write_text("import time\nprint('loading', flush=True)\nwhile True: time.sleep(0.01)\n")
    program = "from hexapod_comp.ros import start; start('endless')"
    process = subprocess.Popen(
        [sys.executable, "-c", program],
        env={**os.environ, "PYTHONPATH": f"{ROOT}:{tmp_path}"},
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )
    assert process.stdout.readline() == "loading\n"
    process.send_signal(number)
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
