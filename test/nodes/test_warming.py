"""The start of a node whose kernels are not compiled yet, and the end of one that hangs."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import textwrap
import time
from pathlib import Path

import pytest
from lifecycle_msgs.srv import ChangeState, GetState
from node_helpers import TRANSITIONS, Bench
from rcl_interfaces.srv import GetParameters

from hexapod_comp.nodes.health import OK, WARN
from hexapod_comp.nodes.running import ENDED_WITHIN, SPIN_PERIOD
from hexapod_comp.nodes.starting import Starting

ROOT = Path(__file__).resolve().parents[2]

ANSWERED_WITHIN = 1.0
"""What issue and user ask for, s; it takes some milliseconds."""

STOP_WITHIN = 5.0
"""From a signal to the end of a process, s, on a machine under heavy load: alone it is 0.2 s, compiling takes 25."""


class Kernels:
    """Stands for a :class:`~hexapod_comp.nodes.warming.Warming` that ends when a test says so."""

    def __init__(self) -> None:
        self.compiling, self.done, self.problem, self.seconds, self.given_up = True, False, "", 12.0, False

    def give_up(self) -> None:
        self.given_up = True


def begin(bench: Bench, kernels: Kernels, **parameters: object) -> Starting:
    """Return a compensator's start; it looks at its kernels in each round, as in a process of its own."""
    node = bench.compensator(start=False, **parameters)
    starting = Starting(node, kernels)
    bench.witness.create_timer(SPIN_PERIOD, starting.look)
    return starting


def configure(bench: Bench) -> object:
    """Ask for the transition and return the future of its answer."""
    request = ChangeState.Request()
    request.transition.id = TRANSITIONS["configure"]
    return bench._client(ChangeState, "compensator/change_state").call_async(request)


def test_a_node_answers_and_speaks_while_its_kernels_are_compiled(bench):
    kernels = Kernels()
    begin(bench, kernels)
    values = bench.until_status(WARN, "compiling kernels")
    assert values["compiling_s"] == "12"
    began = time.monotonic()
    assert bench.state() == "unconfigured"
    names = GetParameters.Request(names=["ramp_rate"])
    assert bench.call(GetParameters, "compensator/get_parameters", names).values[0].double_value == 1e-3
    assert not bench.change("configure")  # it does so itself
    assert time.monotonic() - began < ANSWERED_WITHIN
    assert bench.logged("compiling kernels, once after an installation")
    assert bench.logged("the node is configured as soon as its kernels are there")
    kernels.done = True
    bench.until_status(OK, "kernels compiled")
    assert bench.change("configure")


def test_a_request_to_configure_is_answered_when_it_has_been_done(bench):
    """A lifecycle manager neither fails nor blocks others because this machine compiles."""
    kernels = Kernels()
    begin(bench, kernels, autostart=False)
    waiting = configure(bench)
    for _ in range(3):
        assert bench.state() == "unconfigured"
    assert not waiting.done()
    assert not bench.change("configure")  # one is enough
    kernels.done = True
    bench.until(waiting.done, "the answer")
    assert waiting.result().success
    assert bench.state() == "inactive"
    assert bench.change("activate")


def test_a_request_that_waits_is_refused_when_the_node_ends(bench):
    kernels = Kernels()
    starting = begin(bench, kernels, autostart=False)
    waiting = configure(bench)
    bench.barrier()
    starting.close()
    bench.until(waiting.done, "the answer")
    assert not waiting.result().success
    assert kernels.given_up


def test_a_node_that_is_shut_down_while_its_kernels_are_compiled_is_not_started(bench):
    begin(bench, Kernels())
    request = ChangeState.Request()
    request.transition.label = "shutdown"
    assert bench.call(ChangeState, "compensator/change_state", request).success
    assert bench.call(GetState, "compensator/get_state").current_state.label == "finalized"
    assert not bench.nodes[0].unconfigured


HEARS_SIGINT = "import signal; signal.signal(signal.SIGINT, signal.default_int_handler)\n"
"""The background jobs of a shell, these tests perhaps, ignore it, and so do their children."""


def script(text: str, folder: Path, **environment: str) -> subprocess.Popen[str]:
    """Start a program of ours, with an empty cache of kernels unless `environment` has another."""
    paths = {"NUMBA_CACHE_DIR": str(folder), "PYTHONPATH": f"{ROOT}{os.pathsep}{ROOT / 'test'}"}
    environment = {**os.environ, **paths, **environment}
    command = [sys.executable, "-c", HEARS_SIGINT + textwrap.dedent(text)]
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.STDOUT, "text": True}
    return subprocess.Popen(command, cwd=folder, env=environment, **pipes)


def test_nothing_compiles_while_modules_load_and_nodes_are_made(isolated_ros, tmp_path):
    """Before its first spin a node hears no signal and no request; the bridge's loop beats from the beginning on."""
    made = script(
        """
        import importlib, pkgutil, rclpy
        import hexapod_comp
        from hal_stand_in import StandInHal
        from hexapod_comp.kernels.compiling import from_cache_only
        with from_cache_only():
            for room in ("nodes", "linuxcnc", "loop"):
                package = importlib.import_module(f"hexapod_comp.{room}")
                for module in pkgutil.iter_modules(package.__path__, f"{package.__name__}."):
                    importlib.import_module(module.name)
            rclpy.init()
            hexapod_comp.nodes.compensator.CompensatorNode()
            hexapod_comp.nodes.strut_drive.StrutDriveNode()
            hexapod_comp.linuxcnc.bridge.LinuxcncBridgeNode(StandInHal())._cycle()
        print("fine")
        """,
        tmp_path,
    )
    said, _ = made.communicate(timeout=60.0)
    assert said.endswith("fine\n"), said


def test_after_warming_no_kernel_is_asked_for_with_other_types(tmp_path):
    """Numba compiles for each combination of types. Another machine, model, fault or reading must bring no new one."""
    made = script(
        """
        import pkgutil, importlib, sys
        from pathlib import Path
        import numpy as np
        from numba.core.dispatcher import Dispatcher
        import hexapod_comp as hc
        from foreign_machines import machines
        from hexapod_comp import kernels
        from hexapod_comp.compensation.compensator import NO_SHIFT
        from hexapod_comp.compensation.state import pack_pose
        from hexapod_comp.machine.model import MachineModel, RealMachine
        from hexapod_comp.nodes.messages import StrutMessage, pose_message, pose_numbers
        from hexapod_comp.nodes.warming import warm
        from hexapod_comp.virtual.imperfections import ImperfectionBounds, draw_model
        from hexapod_comp.virtual.machine import Faults, StrutDrive

        def known():
            names = [module.name for module in pkgutil.iter_modules(kernels.__path__, f"{kernels.__name__}.")]
            rooms = [importlib.import_module(name) for name in names]
            return {
                (kernel, types)
                for room in rooms for kernel in vars(room).values() if isinstance(kernel, Dispatcher)
                for types in kernel.signatures
            }

        def use(geometry, model):
            compensator = hc.Compensator(geometry, MachineModel(geometry.name))
            at = geometry.tool_pose(geometry.home)
            compensator.reset(np.array(geometry.limits.stroke).mean(axis=1))
            compensator.reset()
            for n in range(4):
                for pose, frame in ((at, None), (at, pack_pose(geometry.work)), (geometry.work @ at, NO_SHIFT)):
                    compensator.step(pose_numbers(pose_message(pose, "base")), 0.01 * n, frame)
                compensator.estimate(compensator.command)
                compensator.set_temperature("strut_1", 20.5 + n)
                compensator.enable(n != 1)
                compensator.set_model(model)
            drive = StrutDrive(RealMachine(geometry, model))
            drive.set_command(compensator.command)
            for fault in ({"stuck": 1}, {"encoder_lost": 2}, {"jump": (3, 1e-3)}, {"feedback_delay": 0.01}):
                drive.faults = Faults(**fault)
                drive.advance(0.02)
                drive.tracker_pose(), drive.true_tool_pose(), drive.encoder_lengths(), drive.stopped
            StrutMessage().write(compensator.command, 0.01)

        warm()
        before = known()
        assert len(before) > 10
        for name, machine in machines().items():
            geometry = hc.load_geometry(machine.write(Path(f"{machine.name}.yaml")))
            use(geometry, draw_model(geometry, ImperfectionBounds(), 1, "drawn"))
        geometry = hc.load_geometry("paper")
        for model in ("paper_machine", "paper_lines_model"):
            use(geometry, hc.load_model(model, geometry))
        print(*(f"{kernel.__name__}{types}" for kernel, types in known() - before), "fine", sep="\\n")
        """,
        tmp_path,
        NUMBA_CACHE_DIR=os.environ.get("NUMBA_CACHE_DIR", ""),
    )
    said, _ = made.communicate(timeout=120.0)
    assert said.strip() == "fine", said


PROGRAMS = {
    "compensator": "from hexapod_comp.nodes.compensator import main",
    "strut_drive": "from hexapod_comp.nodes.strut_drive import main",
    "linuxcnc_bridge": "from hexapod_comp.linuxcnc.bridge import main",
    "linuxcnc_machine": "from hexapod_comp.linuxcnc.watch import main",
}


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM], ids=["SIGINT", "SIGTERM"])
@pytest.mark.parametrize("program", PROGRAMS)
def test_a_program_that_compiles_ends_when_told(isolated_ros, tmp_path, program, number):
    """Before, it compiled to the end, a minute, and then became active all the same."""
    made = script(
        f"""
        import sys, types
        import hal_stand_in
        sys.modules["hal"] = hal_stand_in.StandInHal()
        {PROGRAMS[program]}
        print("compiling kernels soon", file=sys.stderr, flush=True)
        sys.argv[:] = ["{program}"]
        sys.exit(main())
        """,
        tmp_path,
    )
    heard = ""
    is_node = program != "linuxcnc_machine"
    try:
        while ("once after an installation" if is_node else "soon") not in heard:
            line = made.stdout.readline()
            assert line, heard
            heard += line
        made.send_signal(number)
        began = time.monotonic()
        rest, _ = made.communicate(timeout=30.0)
        assert time.monotonic() - began < STOP_WITHIN
    finally:
        made.kill()
    if is_node:
        assert made.returncode == 0, heard + rest
        assert "Traceback" not in rest
        assert "ready" not in rest


HANGING = """
import ctypes, sys, threading
from hexapod_comp.nodes import running
from hexapod_comp.nodes.arguments import Program
from hexapod_comp.nodes.runtime import MachineNode

running.ENDED_WITHIN = 0.5

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
sys.exit(running.run(Hanging, Program("hanging", "Hangs.", ())))
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
    made = script(HANGING.format(hangs=hangs), tmp_path, NUMBA_CACHE_DIR=os.environ.get("NUMBA_CACHE_DIR", ""))
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
    command = f"{sys.executable} -m hexapod_comp.nodes.compensator --ros-args -p geometry_file:=nowhere.yaml >&- 2>&-"
    assert subprocess.run(["sh", "-c", command], env=environment, timeout=60.0, check=False).returncode == 1


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_while_modules_load_ends_a_program_without_a_traceback(tmp_path: Path, number: int):
    """Loading takes seconds on a busy computer; here it takes for ever, in small steps as there.

    In one long wait a signal would be lost that came just before it: Python looks at it between two steps only.
    """
    (tmp_path / "endless.py").write_text("import time\nprint('loading', flush=True)\nwhile True: time.sleep(0.01)\n")
    program = "from hexapod_comp.nodes import start; start('endless')"
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
from hexapod_comp.nodes import heard_signals

def second(*_):
    signal.raise_signal(signal.SIGTERM)
    return second

heard = heard_signals()
sys.settrace(second)
signal.raise_signal(signal.SIGINT)
sys.settrace(None)
print(*sorted(set(heard)))
"""
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=60.0, check=False)
    assert (done.returncode, done.stdout) == (0, "2 15\n"), done.stderr


def test_a_node_loads_no_scipy_that_it_does_not_need():
    """27 MB a node: rotations at the edges are closed forms, and what turns others is loaded where it is used."""
    program = """
import sys
import scipy.linalg  # Numba needs it, and SciPy 1.15, for one, loads scipy.sparse with it
spared = {"scipy.spatial", "scipy.sparse", "scipy.optimize", "scipy.interpolate"} - set(sys.modules)
import hexapod_comp.nodes.compensator, hexapod_comp.nodes.strut_drive
from hexapod_comp.nodes.warming import warm
warm()
print(*sorted(spared & set(sys.modules)))
"""
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=100)
    assert (done.returncode, done.stdout) == (0, "\n"), done.stderr


def test_the_compilers_code_leaves_memory_and_comes_back_where_it_is_needed():
    """By what the system counts for LLVM's library: over 20 MB before; what relocations have written is kept."""
    program = """
import re
import llvmlite.binding as llvm
from pathlib import Path
from hexapod_comp.nodes.memory import give_code_back

def resident():
    areas = re.split(r"\\n(?=[0-9a-f]+-[0-9a-f]+ )", Path("/proc/self/smaps").read_text())
    return sum(int(re.search(r"Rss: +(\\d+)", area)[1]) for area in areas if "libllvmlite" in area)

before = resident()
give_code_back()
after = resident()
llvm.parse_assembly("define i64 @one() { ret i64 1 }").verify()
print(before, after, resident())
"""
    done = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, check=True, timeout=60.0, cwd=ROOT
    )
    before, after, again = map(int, done.stdout.split())
    assert before > 20_000 > 4_000 > after
    assert again > after
