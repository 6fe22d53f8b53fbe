"""The ROS side: nodes and what they share."""

from __future__ import annotations

import importlib
import os
import signal
import sys
from collections.abc import Callable
from types import FrameType


def start(module: str) -> int:
    """Run a program's module; without the compiled core it ends with one line that says how to build it.

    A signal while the module is loaded ends the process at once: there is nothing yet to put in order.

    Parameters
    ----------
    module : str
        Full name of a module with a function ``main``.
    """
    _at_the_end(lambda *_: os._exit(0))
    try:
        main = importlib.import_module(module).main
    except ImportError as error:
        if error.name != "hexapod_comp.core._core":
            raise
        print(f"cannot start: {error}", file=sys.stderr)
        return 1
    return int(main())


def heard_signals() -> list[int]:
    """Return a list that SIGINT, SIGTERM and SIGHUP are added to, from now on, in place of their usual effect.

    Not an event: setting one takes its lock, and the signal may have interrupted whoever holds that, a main thread
    about to wait for the event or another signal's handler. Then the process waits for itself for ever.
    """
    heard: list[int] = []
    _at_the_end(lambda number, _: heard.append(number))
    return heard


def _at_the_end(handler: Callable[[int, FrameType | None], object]) -> None:
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


def start_compensator() -> int:
    """Run the executable ``compensator``."""
    return start("hexapod_comp.ros.compensator")


def start_strut_drive() -> int:
    """Run the executable ``strut_drive``."""
    return start("hexapod_comp.ros.strut_drive")
