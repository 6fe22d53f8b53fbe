"""The ROS nodes, and the code that several nodes share."""

from __future__ import annotations

import ctypes
import importlib
import os
import signal
import sys
from collections.abc import Callable
from functools import partial
from types import FrameType

# Environment variables with the path of the user's XML profile: for Fast DDS 2 (ROS 2 Jazzy), and for Fast DDS 3
PROFILE_VARIABLES = ("FASTRTPS_DEFAULT_PROFILES_FILE", "FASTDDS_DEFAULT_PROFILES_FILE")

_LIBC = ctypes.CDLL(None)  # loaded here, since end_with_parent runs between fork and exec, where loading may deadlock


def start(module: str) -> int:
    """Run the function `main` of `module` and return its exit code; a signal during the import ends with code 0."""
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
    """Return a list to which SIGINT, SIGTERM and SIGHUP are appended from now on, instead of their usual effect."""
    received: list[int] = []  # no threading.Event, whose lock the interrupted code may hold: a deadlock
    _handle_stop_signals(lambda number, _: received.append(number))
    return received


def _handle_stop_signals(handler: Callable[[int, FrameType | None], object]) -> None:
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        if number is not signal.SIGHUP or signal.getsignal(number) != signal.SIG_IGN:  # nohup ignores SIGHUP
            signal.signal(number, handler)


def open_streams() -> None:
    """Connect closed standard streams with /dev/null. rclpy's executor needs a stderr; and a file or socket opened
    later would get the number of a closed stream, so that libraries would print into it."""
    for number in (0, 1, 2):
        try:
            os.fstat(number)
        except OSError:
            os.open(os.devnull, os.O_RDWR)  # open() takes the lowest free number, which is the closed stream's
    for name in ("stdout", "stderr"):
        if getattr(sys, name) is None:
            setattr(sys, name, os.fdopen(os.open(os.devnull, os.O_WRONLY), "w"))


def avoid_shared_memory() -> None:
    """Have Fast DDS receive by UDP only, unless the user has set a profile; call this before ROS is initialised.

    With shared memory, a process that is killed while it holds a lock stalls other processes for seconds.
    """
    from ..formats.paths import config_folder

    if not any(os.environ.get(name) for name in PROFILE_VARIABLES):
        os.environ[PROFILE_VARIABLES[0]] = str(config_folder() / "fastdds.xml")
        # without this variable ROS overrides the settings of shared memory in fastdds.xml
        os.environ.setdefault("RMW_FASTRTPS_USE_QOS_FROM_XML", "1")


def keep_discovery_local() -> None:
    """Limit ROS discovery to this computer and avoid shared memory, unless the user's environment sets otherwise."""
    avoid_shared_memory()
    if "ROS_STATIC_PEERS" not in os.environ:
        os.environ.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")


def end_with_parent(number: signal.Signals = signal.SIGTERM) -> None:
    """Have Linux send this process the signal `number` when its parent process dies."""
    signal.signal(number, signal.SIG_DFL)  # background jobs of a shell script start with SIGINT ignored
    _LIBC.prctl(1, number)  # PR_SET_PDEATHSIG


# Entry points of the executables that setup.py installs
start_compensator, start_strut_drive, start_mover, start_instrument, start_adapter = (
    partial(start, f"{__name__}.{node}") for node in ("compensator", "strut_drive", "mover", "instrument", "adapter")
)
