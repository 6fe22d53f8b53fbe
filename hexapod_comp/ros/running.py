"""How a node's process runs: its arguments, the spin loop, signals, its end."""

from __future__ import annotations

import ctypes
import faulthandler
import functools
import gc
import os
import signal
import sys
from collections.abc import Callable, Sequence
from contextlib import ExitStack, suppress
from typing import TextIO

import rclpy
from rclpy.experimental import EventsExecutor
from rclpy.lifecycle import LifecycleNode, TransitionCallbackReturn
from rclpy.signals import SignalHandlerOptions

from ..errors import LONGEST_TEXT, HexapodError, printable
from . import heard_signals, open_streams
from .arguments import Program
from .log_relay import LogRelay
from .middleware import avoid_shared_memory
from .runtime import MachineNode

SPIN_PERIOD = 0.1
"""Longest wait of one spin, s: how soon a signal is noticed (EventsExecutor.spin itself never returns)."""


M_MMAP_THRESHOLD, LARGEST_KEPT = -3, 1 << 20
"""Parameter of glibc's ``mallopt``; blocks from this size on, byte, go back to the system when they are freed."""

ENDED_WITHIN = 4.0
"""What the end of a process may take from its signal on, s; usually it is a fraction of a second."""


def autostart(node: LifecycleNode, heard: Sequence[int] = ()) -> bool:
    """Configure and activate a node, unless a signal is `heard` meanwhile; return whether what was done went well."""
    for step in (node.trigger_configure, node.trigger_activate):
        if heard:
            break
        if step() != TransitionCallbackReturn.SUCCESS:
            return False
    return True


def keep_discovery_local() -> None:
    """Keep discovery to this machine, and out of shared memory, unless the user's environment says otherwise."""
    avoid_shared_memory()
    if "ROS_STATIC_PEERS" not in os.environ:
        os.environ.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")


def discovery() -> str:
    """Return who may find this process's nodes, and how to change that."""
    reach, peers = os.environ.get("ROS_AUTOMATIC_DISCOVERY_RANGE", ""), os.environ.get("ROS_STATIC_PEERS", "")
    hint = " (SUBNET finds other computers)" if reach == "LOCALHOST" else ""
    also = f" and of {printable(peers)}" if peers else ""
    domain = printable(os.environ.get("ROS_DOMAIN_ID", "0"))
    return f"domain {domain}; ROS_AUTOMATIC_DISCOVERY_RANGE={printable(reach)}{hint}{also}"


def run(
    make_node: Callable[[], MachineNode],
    program: Program,
    argv: Sequence[str] | None = None,
) -> int:
    """Run a node until SIGINT, SIGTERM or SIGHUP.

    Signals are only noted, since rclpy's own handling loses the last message and exits non-zero on a
    second Ctrl-C, which ``ros2 launch`` sends.

    Parameters
    ----------
    make_node : callable
        Makes the node, once ROS runs.
    program : Program
        What its arguments may be.
    argv : sequence of str, optional
        Arguments after the program's name; those of this process by default.

    Returns
    -------
    int
        0 after a signal or ``--help``, 1 when the node could not start, 2 where an argument is not understood.
    """
    arguments = sys.argv[1:] if argv is None else list(argv)
    refusal = program.refusal(arguments)
    if refusal is not None:
        return refusal
    open_streams()
    give_blocks_back()
    heard = heard_signals()
    with _own_stderr() as stderr:
        with LogRelay():
            code = _run_until(heard, make_node, arguments, stderr)
        if argv is None:
            # Python's own end waits for threads of DDS, which now and then never end, though all has been closed.
            for stream in filter(None, (sys.stdout, sys.stderr)):  # None: it was closed from the beginning
                with suppress(OSError):
                    stream.flush()
            os._exit(code)
        faulthandler.cancel_dump_traceback_later()
        signal.setitimer(signal.ITIMER_REAL, 0.0)
    return code


def give_blocks_back() -> None:
    """Let large blocks go back to the system as soon as they are freed, where the C library is glibc.

    Left alone, its threshold grows with the largest block that was ever freed, and long messages leave holes.
    """
    with suppress(OSError, AttributeError):
        ctypes.CDLL(None).mallopt(M_MMAP_THRESHOLD, LARGEST_KEPT)


def _own_stderr() -> TextIO:
    """Return stderr as it is now, whatever will stand in its place."""
    try:
        return open(os.dup(sys.stderr.fileno()), "w")
    except (AttributeError, OSError):  # closed, or a test's
        return open(os.devnull, "w")


def _run_until(
    heard: Sequence[int],
    make_node: Callable[[], MachineNode],
    arguments: list[str],
    stderr: TextIO,
) -> int:
    try:
        rclpy.init(args=arguments, signal_handler_options=SignalHandlerOptions.NO)
    except (rclpy.exceptions.ROSInterruptException, RuntimeError, ValueError) as error:
        print(printable(f"cannot start ROS: {error}", LONGEST_TEXT), file=sys.stderr)
        return 1
    try:
        node = make_node()
    except HexapodError as error:
        print(f"cannot start: {error}", file=sys.stderr)
        rclpy.try_shutdown()
        return 1
    node.get_logger().info(discovery())
    executor = EventsExecutor()
    executor.add_node(node)
    spin = node.guard.around("spinning", functools.partial(executor.spin_once, timeout_sec=SPIN_PERIOD))
    with ExitStack() as ending:  # the last is called first
        for end in (rclpy.try_shutdown, node.destroy_node, executor.shutdown, node.say_goodbye):
            ending.callback(end)
        ending.callback(_end_within, ENDED_WITHIN, stderr)
        if node.wants_autostart and node.unconfigured and not autostart(node, heard):
            return 1
        # What is loaded by now stays; the collector need not look at it again while the machine moves.
        gc.collect()
        gc.freeze()
        while not heard and rclpy.ok():
            spin()
    return 0


def _end_within(seconds: float, stderr: TextIO) -> None:
    """End this process by force in so many seconds, saying where every thread hangs: DDS may wait for ever.

    Python's lock is not needed for either: whoever hangs may hold it. Where nobody takes what is said, the system's
    alarm ends the process a second later.
    """
    faulthandler.dump_traceback_later(seconds, exit=True, file=stderr)
    signal.signal(signal.SIGALRM, signal.SIG_DFL)
    signal.setitimer(signal.ITIMER_REAL, seconds + 1.0)
