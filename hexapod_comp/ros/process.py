"""A node's process: spin loop, signals, shutdown, and a log that never blocks; a ROS session for other programs."""

from __future__ import annotations

import faulthandler
import fcntl
import functools
import gc
import os
import signal
import stat
import sys
import threading
import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack, suppress
from typing import Any, TextIO, TypeVar

import rclpy
from rclpy.experimental import EventsExecutor
from rclpy.lifecycle import LifecycleNode, TransitionCallbackReturn
from rclpy.node import Node
from rclpy.parameter import Parameter as RosParameter
from rclpy.signals import SignalHandlerOptions

from ..errors import LONGEST_TEXT, CommandError, HexapodError, NoAnswerError, printable
from . import keep_discovery_local, open_streams, received_signals
from .base import MachineNode
from .parameters import Program

# Longest wait of one spin_once, s, after which signals are checked; EventsExecutor.spin would never return
SPIN_PERIOD = 0.1

ENDED_WITHIN = 4.0  # Longest time from a signal to the end of the process, s; a fraction of a second is usual
STREAMS = (1, 2)  # stdout and stderr; ROS writes its log to stdout if RCUTILS_LOGGING_USE_STDOUT is 1, else to stderr
BUFFER_SIZE = 1 << 20  # Size of the log's pipe, byte, for thousands of lines: Linux's limit for unprivileged users
LEAVING_WITHIN = 0.5  # Longest wait at the process's end until the last log lines are read, s

# Options of a node that offers no services and publishes no log
QUIET: dict[str, Any] = {
    "start_parameter_services": False,
    "enable_rosout": False,
    "parameter_overrides": [RosParameter("start_type_description_service", value=False)],
}


def autostart(node: LifecycleNode, signals: Sequence[int] = ()) -> bool:
    """Configure and activate the node, unless a signal has arrived; return false if one of these steps has failed."""
    steps = node.trigger_configure, node.trigger_activate
    return all(signals or step() == TransitionCallbackReturn.SUCCESS for step in steps)


def discovery() -> str:
    reach, peers = os.environ.get("ROS_AUTOMATIC_DISCOVERY_RANGE", ""), os.environ.get("ROS_STATIC_PEERS", "")
    hint = " (SUBNET finds other computers)" if reach == "LOCALHOST" else ""
    also = f" and of {printable(peers)}" if peers else ""
    domain = printable(os.environ.get("ROS_DOMAIN_ID", "0"))
    return f"domain {domain}; ROS_AUTOMATIC_DISCOVERY_RANGE={printable(reach)}{hint}{also}"


def run(make_node: Callable[[], MachineNode], program: Program) -> int:
    """Run a node until SIGINT, SIGTERM or SIGHUP, then end this process; return an exit code for bad arguments.

    rclpy's signal handling would lose the last message, and would fail at the second Ctrl-C that ros2 launch sends.
    """
    keep_discovery_local()
    arguments = sys.argv[1:]
    if (refusal := program.refusal(arguments)) is not None:
        return refusal
    open_streams()
    signals = received_signals()
    try:  # a copy of the real stderr, before LogRelay replaces it
        stderr = os.fdopen(os.dup(sys.stderr.fileno()), "w")
    except (AttributeError, OSError):  # stderr is closed
        stderr = os.fdopen(os.open(os.devnull, os.O_WRONLY), "w")
    with LogRelay():
        code = _run_until(signals, make_node, arguments, stderr)
    for stream in filter(None, (sys.stdout, sys.stderr)):  # None: the stream was closed when the process began
        with suppress(OSError):
            stream.flush()
    os._exit(code)  # sys.exit would wait for threads of DDS, which sometimes never end


def _run_until(
    signals: Sequence[int], make_node: Callable[[], MachineNode], arguments: list[str], stderr: TextIO
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
    with ExitStack() as ending:  # the last callback is called first
        for end in (rclpy.try_shutdown, node.destroy_node, executor.shutdown, node.publish_last_status):
            ending.callback(end)
        ending.callback(_end_within, ENDED_WITHIN, stderr)
        if node.wants_autostart and node.unconfigured and not autostart(node, signals):
            return 1
        # a garbage collection of the 45,000 objects that now exist would take 17 ms
        gc.collect()
        gc.freeze()
        while not signals and rclpy.ok():
            spin()
    return 0


def _end_within(seconds: float, stderr: TextIO) -> None:
    """After `seconds`, print the stacks of all threads and end this process: DDS may block the shutdown for ever.

    faulthandler and SIGALRM do not need Python's lock, which a blocked thread may hold.
    """
    faulthandler.dump_traceback_later(seconds, exit=True, file=stderr)
    signal.signal(signal.SIGALRM, signal.SIG_DFL)  # ends the process if faulthandler's printing blocks
    signal.setitimer(signal.ITIMER_REAL, seconds + 1.0)


# ---- the log ----


class LogRelay:
    """Context manager in which writing to stdout and stderr never blocks: a terminal stopped with Ctrl-S, or a pipe
    that is not read, would block the node. A thread forwards the output from a pipe; output that does not fit into
    this pipe is lost."""

    def __enter__(self) -> LogRelay:
        self._relays: list[tuple[int, int, threading.Thread]] = []
        for stream in STREAMS:
            try:
                if stat.S_ISREG(os.fstat(stream).st_mode):
                    continue  # writing to a file never blocks
            except OSError:  # the stream is closed
                continue
            real, (source, sink) = os.dup(stream), os.pipe()
            with suppress(OSError):  # the pipe keeps its size if the system does not allow BUFFER_SIZE
                fcntl.fcntl(sink, fcntl.F_SETPIPE_SZ, BUFFER_SIZE)
            os.set_blocking(sink, False)
            os.dup2(sink, stream)
            os.close(sink)
            thread = threading.Thread(target=_forward, args=(source, real), name=f"log of stream {stream}", daemon=True)
            thread.start()
            self._relays.append((stream, real, thread))
        return self

    def __exit__(self, *_: object) -> None:
        for stream, real, thread in self._relays:
            os.dup2(real, stream)
            thread.join(LEAVING_WITHIN)  # the thread forwards the rest of the pipe


def _forward(source: int, real: int) -> None:
    """Copy bytes from a pipe to the real stream until all writers have closed; discard bytes that nobody can read."""
    while data := os.read(source, 1 << 16):
        with suppress(OSError):
            while data:
                data = data[os.write(real, data) :]


# ---- other programs ----


AnySession = TypeVar("AnySession", bound="RosSession")


class RosSession:
    """A node with its own ROS context and executor, for a program that talks to nodes and handles signals itself."""

    def __init__(self, name: str, namespace: str = "", arguments: Sequence[str] = (), **options: Any) -> None:
        open_streams()
        keep_discovery_local()
        self._context = rclpy.Context()
        rclpy.init(args=list(arguments), context=self._context, signal_handler_options=SignalHandlerOptions.NO)
        self.node: Node = rclpy.create_node(name, namespace=namespace, context=self._context, **options)
        self._executor = EventsExecutor(context=self._context)
        self._executor.add_node(self.node)

    def __enter__(self: AnySession) -> AnySession:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def spin_once(self, timeout: float) -> None:
        """Handle the messages that have arrived, or wait up to `timeout` seconds for a message."""
        self._executor.spin_once(timeout_sec=timeout)

    def catch_up(self) -> None:
        """Handle all messages that have arrived, for example during a long computation; wait for no further message."""
        last = self._executor.create_task(lambda: None)
        while not last.done():
            self.spin_once(0.02)

    def wait(self, condition: Callable[[], object], timeout: float, what: str) -> None:
        """Handle messages until `condition()` is true; after `timeout` seconds raise a NoAnswerError naming `what`."""
        end = time.monotonic() + timeout
        while not condition():
            if (left := end - time.monotonic()) <= 0.0:
                raise NoAnswerError(f"waited {timeout:g} s in vain for {what}")
            self.spin_once(min(left, 0.02))

    def call(self, client: Any, request: Any, timeout: float) -> Any:
        """Return a service's answer; raise CommandError if it is a refusal, NoAnswerError after `timeout` seconds."""
        future = client.call_async(request)
        self.wait(future.done, timeout, f"the answer of {client.srv_name}")
        answer = future.result()
        if not getattr(answer, "success", True):
            raise CommandError("refused", f"{client.srv_name}: {answer.message}")
        return answer

    def close(self) -> None:
        self._executor.shutdown()
        self.node.destroy_node()
        rclpy.try_shutdown(context=self._context)
