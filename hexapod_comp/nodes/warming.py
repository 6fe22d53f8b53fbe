"""Kernels before they are needed: loaded from their cache, or compiled into it by a process of its own.

Compiling takes up to a minute, once after an installation or an update, and keeps Python's lock for most of it. A node
that did it itself would hear neither a request nor a signal. So the node goes on, in a thread beside it waits for
``python -m hexapod_comp.nodes.warming``, and then takes the kernels from the cache within a fraction of a second.
"""

from __future__ import annotations

import fcntl
import os
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable
from contextlib import ExitStack, suppress

import numba
import numpy as np
from geometry_msgs.msg import PoseStamped
from rclpy.serialization import serialize_message

from ..compensation.compensator import Compensator
from ..errors import LONGEST_TEXT, printable
from ..formats.paths import config_file
from ..kernels.compiling import NotCompiledError, cache_folder, from_cache_only
from ..machine.geometry import load_geometry
from ..machine.model import RealMachine
from ..machine.model_file import load_model
from ..machine.struts import home_twists
from ..virtual.machine import StrutDrive
from ..workspace.travel import travel
from .children import end_with_parent
from .following import Following
from .messages import StrutMessage, write_pose
from .wire import StrutBytes, read_pose_bytes

LOCK = "compiling.lock"
"""In the cache's folder: of two nodes that start at once one compiles, the other waits and finds all there."""


def warm() -> None:
    """Run every kernel that the nodes use."""
    warm_compensator()
    warm_drive()


def warm_compensator() -> None:
    """Run every kernel that the compensator uses, on a machine of every block, so that none compiles later."""
    machine = _every_block()
    warm_up(compensator := Compensator(machine.geometry, machine.model))
    following = Following(1.0)
    following.note(compensator.command, 0.0)
    following.check(compensator.command, 0.0)


def warm_drive() -> None:
    """Run every kernel that the strut drive uses, in the same way."""
    drive = StrutDrive(_every_block())
    drive.advance(0.01)
    drive.tracker_pose()
    warm_messages()


def warm_messages() -> None:
    """Run every kernel that writes messages."""
    write_pose(PoseStamped(), np.zeros(3), np.eye(3))
    StrutMessage().write(np.zeros(6))


def _every_block() -> RealMachine:
    home_twists(load_geometry(config_file("example_6_6.yaml")))  # its screws have a lead
    geometry = load_geometry(config_file("paper.yaml"))
    return RealMachine(geometry, load_model(config_file("paper_machine.yaml"), geometry))


def warm_up(compensator: Compensator) -> None:
    """Run every kernel of a compensator's loop once."""
    trial = Compensator(compensator.geometry, compensator.model)
    home = trial.geometry.tool_pose(trial.geometry.home)
    message = PoseStamped()
    write_pose(message, home.position, home.rotation)
    _, _, numbers = read_pose_bytes(serialize_message(message))
    trial.step(numbers, 0.0)
    trial.estimate(trial.command)
    trial.set_model(trial.model)
    travel(trial.machine, home)
    StrutBytes().write(trial.command)


class Warming:
    """Kernels on their way, in a thread that waits for the process which compiles them where that is needed.

    Parameters
    ----------
    kernels : callable
        Runs all that this process needs; the other process compiles those of all nodes.

    Attributes
    ----------
    compiling : bool
        Whether kernels are missing in the cache, and are being compiled.
    problem : str
        Why the process could not do it, empty otherwise: the kernels were then compiled here.
    """

    def __init__(self, kernels: Callable[[], None] = warm) -> None:
        self._kernels = kernels
        self.compiling, self.problem = False, ""
        self._began = time.monotonic()
        self._process: subprocess.Popen[bytes] | None = None
        self._given_up = threading.Event()
        self._thread = threading.Thread(target=self._run, name="kernels", daemon=True)
        self._thread.start()

    @property
    def done(self) -> bool:
        """Whether the kernels are there."""
        return not self._thread.is_alive()

    @property
    def seconds(self) -> float:
        """Time since the beginning, s."""
        return time.monotonic() - self._began

    def give_up(self) -> None:
        """End the process, if there is one."""
        self._given_up.set()
        if self._process is not None:
            self._process.kill()

    def _run(self) -> None:
        try:
            with from_cache_only():
                self._kernels()
            return
        except NotCompiledError:
            self.compiling = True
        try:
            self._compile()
        except OSError as error:
            self.problem = f"no process to compile in: {error}"
        if not self._given_up.is_set():
            self._kernels()

    def _compile(self) -> None:
        root = str(cache_folder(numba.config.CACHE_DIR).parent.absolute())
        begin = f"import sys; sys.path[:] = {sys.path!r}; from {__name__} import main; sys.exit(main())"
        with tempfile.TemporaryFile() as output:
            self._process = subprocess.Popen(
                [sys.executable, "-c", begin],
                env={**os.environ, "NUMBA_CACHE_DIR": root},
                stdin=subprocess.DEVNULL,
                stdout=output,
                stderr=output,
            )
            if self._given_up.is_set():
                self._process.kill()
            if code := self._process.wait():
                output.seek(0)
                last = output.read().decode(errors="replace").strip().rpartition("\n")[2]
                self.problem = printable(f"the compiling process ended with {code}: {last}", LONGEST_TEXT)


def main() -> int:
    """Compile what is not in the cache; the process that :class:`Warming` starts."""
    end_with_parent(signal.SIGKILL)
    with ExitStack() as stack, suppress(OSError):  # a file system without locks: two processes compile the same
        lock = stack.enter_context(open(cache_folder(numba.config.CACHE_DIR) / LOCK, "w"))
        fcntl.flock(lock, fcntl.LOCK_EX)
        warm()
        return 0
    warm()
    return 0


if __name__ == "__main__":
    sys.exit(main())
