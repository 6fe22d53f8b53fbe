"""How a node's process runs: its arguments, the spin loop, signals, its end."""

from __future__ import annotations

import functools
import gc
import os
import signal
import sys
import threading
from collections.abc import Callable, Sequence

import rclpy
from rclpy.experimental import EventsExecutor
from rclpy.lifecycle import LifecycleNode, TransitionCallbackReturn
from rclpy.signals import SignalHandlerOptions

from ..errors import LONGEST_TEXT, HexapodError, printable
from .arguments import Program
from .log_relay import LogRelay
from .middleware import avoid_shared_memory
from .runtime import MachineNode

SPIN_PERIOD = 0.1
"""Longest wait of one spin, s: how soon a signal is noticed (EventsExecutor.spin itself never returns)."""


def autostart(node: LifecycleNode) -> bool:
    """Configure and activate a node; return whether both went well."""
    done = TransitionCallbackReturn.SUCCESS
    return node.trigger_configure() == done and node.trigger_activate() == done


def keep_discovery_local() -> None:
    """Keep discovery to this machine, and out of shared memory, unless the user's environment says otherwise."""
    avoid_shared_memory()
    if "ROS_STATIC_PEERS" not in os.environ:
        os.environ.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")


def run(make_node: Callable[[], MachineNode], program: Program, argv: Sequence[str] | None = None) -> int:
    """Run a node until SIGINT or SIGTERM.

    Signals only set a flag, since rclpy's own handling loses the last message and exits non-zero on a
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
    stop = threading.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: stop.set())
    with LogRelay():
        return _run_until(stop, make_node, arguments)


def _run_until(stop: threading.Event, make_node: Callable[[], MachineNode], arguments: list[str]) -> int:
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
    executor = EventsExecutor()
    executor.add_node(node)
    try:
        if node.wants_autostart and not autostart(node):
            return 1
        # What is loaded by now stays; the collector need not look at it again while the machine moves.
        gc.collect()
        gc.freeze()
        spin = node.guard.around("spinning", functools.partial(executor.spin_once, timeout_sec=SPIN_PERIOD))
        while not stop.is_set() and rclpy.ok():
            spin()
        node.say_goodbye()
        return 0
    finally:
        executor.shutdown()
        node.destroy_node()
        rclpy.try_shutdown()
        # Python puts its own handlers back while it shuts down; a second Ctrl-C would then end us with -2.
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, signal.SIG_IGN)
