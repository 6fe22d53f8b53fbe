"""Nodes that run as separate processes, and a private ROS domain for these processes."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import TracebackType

from ..ros import avoid_shared_memory, end_with_parent

# The UDP ports of DDS are 7400 + 250 · domain + offset, with the offsets 0 and 1 for multicast and from 10 for
# participants. The ports of domains above 101 are Linux's ephemeral ports.
DOMAINS = range(1, 102)
RESERVED_OFFSET = 5
FIRST_PARTICIPANT_OFFSET = 10

STOP_TIMEOUT = 5.0  # Time from SIGTERM to SIGKILL, s


def reserve_domain() -> tuple[int, socket.socket]:
    """Return the id of a free ROS domain, and a socket that reserves this domain while the socket is open."""
    # the socket's port, which DDS does not use, shows other sessions that the domain is in use; a crash frees the port
    start = os.getpid() % len(DOMAINS)
    for domain in (*DOMAINS[start:], *DOMAINS[:start]):
        base = 7400 + 250 * domain
        reservation = _bind(base + RESERVED_OFFSET)
        if reservation is None:
            continue
        probe = _bind(base + FIRST_PARTICIPANT_OFFSET)
        if probe is not None:
            probe.close()
            return domain, reservation
        reservation.close()
    raise RuntimeError(f"all ROS domains from {DOMAINS[0]} to {DOMAINS[-1]} are in use on this computer")


def _bind(port: int) -> socket.socket | None:
    udp = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    try:
        udp.bind(("0.0.0.0", port))
    except OSError:
        udp.close()
        return None
    return udp


class PrivateDomain:
    """Context in which this process and its children use a private ROS domain, so that no real machine moves."""

    def __enter__(self) -> int:
        self._before = dict(os.environ)
        domain, self._reservation = reserve_domain()
        os.environ["ROS_DOMAIN_ID"] = str(domain)
        os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
        for name in ("ROS_STATIC_PEERS", "ROS_DISCOVERY_SERVER", "ROS_LOCALHOST_ONLY"):
            os.environ.pop(name, None)
        avoid_shared_memory()
        return domain

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        os.environ.clear()
        os.environ.update(self._before)
        self._reservation.close()


class NodeProcess:
    """A node in a child process, which is killed when this process ends; the node's output goes to a file."""

    def __init__(
        self,
        module: str,
        parameters: dict[str, object],
        remaps: Mapping[str, str] | None = None,
        wrapper: Sequence[str] = (),
    ) -> None:
        self.name = module
        handle, path = tempfile.mkstemp(prefix=f"hexapod_comp_{module}_", suffix=".log")
        self.log = Path(path)
        arguments = ros_arguments(parameters, remaps)
        command = [*wrapper, sys.executable, "-m", f"hexapod_comp.ros.{module}", *arguments]
        with os.fdopen(handle, "wb") as log:
            self._process = subprocess.Popen(
                command,
                stdout=log,
                stderr=subprocess.STDOUT,
                stdin=subprocess.DEVNULL,
                start_new_session=True,  # so that Ctrl-C does not reach the node, which `stop` ends
                preexec_fn=end_with_parent,
            )

    @property
    def pid(self) -> int:
        return self._process.pid

    def exit_code(self) -> int | None:
        """Return the exit code; None while the process runs."""
        return self._process.poll()

    def send(self, number: signal.Signals) -> None:
        self._process.send_signal(number)

    def output(self) -> str:
        return self.log.read_text(encoding="utf-8", errors="replace") if self.log.exists() else ""

    def stop(self) -> tuple[int, str]:
        """End the process by SIGTERM, or after STOP_TIMEOUT by SIGKILL; return exit code and output."""
        # not by SIGINT, which a shell's background job ignores until the job sets a handler
        if self._process.poll() is None:
            self.send(signal.SIGTERM)
        try:
            code = self._process.wait(STOP_TIMEOUT)
        except subprocess.TimeoutExpired:
            self._process.kill()
            code = self._process.wait()
        output = self.output()
        self.log.unlink(missing_ok=True)
        return code, output


def ros_arguments(parameters: Mapping[str, object], remaps: Mapping[str, str] | None = None) -> Sequence[str]:
    arguments = []
    for name, value in parameters.items():
        text = str(value).lower() if isinstance(value, bool) else str(value)
        arguments += ["-p", f"{name}:={text}"]
    for name, other in (remaps or {}).items():
        arguments += ["-r", f"{name}:={other}"]
    return ["--ros-args", *arguments] if arguments else []
