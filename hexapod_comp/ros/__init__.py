"""The ROS side: nodes and what they share."""

from __future__ import annotations

import ctypes
import importlib
import os
import signal
import sys
from collections.abc import Callable
from functools import partial
from types import FrameType

# Where Fast DDS looks for a user's profile: up to version 2 (ROS 2 Jazzy), and from version 3
PROFILE_VARIABLES = ("FASTRTPS_DEFAULT_PROFILES_FILE", "FASTDDS_DEFAULT_PROFILES_FILE")

_LIBC = ctypes.CDLL(None)  # at import: end_with_parent runs between fork and exec


def start(module: str) -> int:
    """Run a program's module; without the compiled core print one line that tells how to build it.

    A signal while the module is loaded ends the process at once: nothing needs to be closed yet.
    """
    _handle_stop_signals(lambda *_: os._exit(0))
    try:
        main = importlib.import_module(module).main
    except ImportError as error:
        if error.name != "hexapod_comp.core._core":
            raise
        print(f"cannot start: {error}", file=sys.stderr)
        return 1
    return int(main())


def received_signals() -> list[int]:
    """Return a list to which SIGINT, SIGTERM and SIGHUP are appended, from now on, instead of their usual effect.

    Not an event: setting one acquires its lock, and the signal may have interrupted the holder, a main thread about to
    wait for the event or another signal's handler. Then the process would deadlock.
    """
    received: list[int] = []
    _handle_stop_signals(lambda number, _: received.append(number))
    return received


def _handle_stop_signals(handler: Callable[[int, FrameType | None], object]) -> None:
    """Let a function handle the signals that end a program; a hang-up that nohup ignores stays ignored."""
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        if number is not signal.SIGHUP or signal.getsignal(number) != signal.SIG_IGN:
            signal.signal(number, handler)


def open_streams() -> None:
    """Open those of stdin, stdout and stderr that were closed when the process began: rclpy's executor needs a stderr.

    Otherwise the next file or socket would get the number of a closed one, and with it the output of libraries.
    """
    for number in (0, 1, 2):
        try:
            os.fstat(number)
        except OSError:
            os.open(os.devnull, os.O_RDWR)  # the lowest free number
    for name in ("stdout", "stderr"):
        if getattr(sys, name) is None:
            setattr(sys, name, os.fdopen(os.open(os.devnull, os.O_WRONLY), "w"))


def avoid_shared_memory() -> None:
    """Let Fast DDS receive by UDP only, unless the user has a profile of their own.

    A process killed while it holds a lock in another's shared memory stalls that other for seconds.
    The environment of this process, and so of its children, is changed, before ROS is initialised in it.
    """
    from ..formats.paths import config_folder

    if not any(os.environ.get(name) for name in PROFILE_VARIABLES):
        os.environ[PROFILE_VARIABLES[0]] = str(config_folder() / "fastdds.xml")
        # Without it ROS overrides a profile's settings of shared memory.
        os.environ.setdefault("RMW_FASTRTPS_USE_QOS_FROM_XML", "1")


def keep_discovery_local() -> None:
    """Keep discovery to this machine, and out of shared memory, unless the user's environment says otherwise."""
    avoid_shared_memory()
    if "ROS_STATIC_PEERS" not in os.environ:
        os.environ.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")


def end_with_parent(number: signal.Signals = signal.SIGTERM) -> None:
    """Have Linux send this process a signal when its parent dies, for any reason."""
    _LIBC.prctl(1, number)  # PR_SET_PDEATHSIG


# The executables of setup.py
start_compensator, start_strut_drive, start_mover, start_instrument, start_adapter = (
    partial(start, f"{__name__}.{node}") for node in ("compensator", "strut_drive", "mover", "instrument", "adapter")
)
