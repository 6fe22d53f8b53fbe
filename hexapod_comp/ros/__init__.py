"""The ROS side: nodes and what they share."""

from __future__ import annotations

import ctypes
import importlib
import os
import signal
import sys
from collections.abc import Callable
from types import FrameType

# Where Fast DDS looks for a user's profile: up to version 2 (ROS 2 Jazzy), and from version 3
PROFILE_VARIABLES = ("FASTRTPS_DEFAULT_PROFILES_FILE", "FASTDDS_DEFAULT_PROFILES_FILE")

_LIBC = ctypes.CDLL(None)  # at once: end_with_parent runs between fork and exec


def start(module: str) -> int:
    """Run a program's module; without the compiled core it ends with one line that says how to build it.

    A signal while the module is loaded ends the process at once: there is nothing yet to put in order.
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
    """Return a list that SIGINT, SIGTERM and SIGHUP are added to, from now on, in place of their usual effect.

    Not an event: setting one takes its lock, and the signal may have interrupted whoever holds that, a main thread
    about to wait for the event or another signal's handler. Then the process waits for itself for ever.
    """
    heard: list[int] = []
    _handle_stop_signals(lambda number, _: heard.append(number))
    return heard


def _handle_stop_signals(handler: Callable[[int, FrameType | None], object]) -> None:
    """Let a function handle the signals that end a program, from now on; a hang-up that nohup ignores stays ignored."""
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        if number is not signal.SIGHUP or signal.getsignal(number) != signal.SIG_IGN:
            signal.signal(number, handler)


def open_streams() -> None:
    """Open what was closed of stdin, stdout and stderr when the process began: rclpy's executor wants a stderr.

    Else the next file or socket would get its number, and what a library prints.
    """
    for number in (0, 1, 2):
        try:
            os.fstat(number)
        except OSError:
            os.open(os.devnull, os.O_RDWR)  # the lowest number that is free
    for name in ("stdout", "stderr"):
        if getattr(sys, name) is None:
            setattr(sys, name, os.fdopen(os.open(os.devnull, os.O_WRONLY), "w"))


def avoid_shared_memory() -> None:
    """Let Fast DDS receive by UDP only, unless the user has a profile of their own.

    A process killed while it holds a lock in the shared memory of another stalls that other for seconds.
    The environment of this process, and so of its children, is changed, before ROS is initialised in it.
    """
    from ..formats.paths import config_folder

    if not any(os.environ.get(name) for name in PROFILE_VARIABLES):
        os.environ[PROFILE_VARIABLES[0]] = str(config_folder() / "fastdds.xml")
        # Without it ROS overrules what a profile says of memory.
        os.environ.setdefault("RMW_FASTRTPS_USE_QOS_FROM_XML", "1")


def keep_discovery_local() -> None:
    """Keep discovery to this machine, and out of shared memory, unless the user's environment says otherwise."""
    avoid_shared_memory()
    if "ROS_STATIC_PEERS" not in os.environ:
        os.environ.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")


def end_with_parent(number: signal.Signals = signal.SIGTERM) -> None:
    """Ask Linux to send this process a signal when its parent dies, however it dies."""
    _LIBC.prctl(1, number)  # PR_SET_PDEATHSIG


def start_compensator() -> int:
    """Run the executable ``compensator``."""
    return start("hexapod_comp.ros.compensator")


def start_strut_drive() -> int:
    """Run the executable ``strut_drive``."""
    return start("hexapod_comp.ros.strut_drive")


def start_mover() -> int:
    """Run the executable ``mover``."""
    return start("hexapod_comp.ros.mover")


def start_instrument() -> int:
    """Run the executable ``instrument``."""
    return start("hexapod_comp.ros.instrument")
