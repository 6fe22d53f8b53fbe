#!/usr/bin/python3
"""DISPLAY program of the tests' LinuxCNC: run what a test asks for through console.sock beside the ini file.

A request is one line of JSON, [function name, arguments…]; the answer is {"ok": result} or {"error": text}. The program
runs under Debian's own Python, whose modules linuxcnc and hal it needs; the test may run under another version.
"""

from __future__ import annotations

import json
import os
import socket
import sys
import time
from typing import Any

import hal
import linuxcnc

JOINTS = 6


class Console:
    """The functions of LinuxCNC that a test may call."""

    def __init__(self) -> None:
        self._command, self._stat = linuxcnc.command(), linuxcnc.stat()
        self._errors = linuxcnc.error_channel()
        self._component = hal.component("console")
        self._component.ready()

    def on(self) -> None:
        """Leave the emergency stop and switch on."""
        self._command.state(linuxcnc.STATE_ESTOP_RESET)
        self._wait()
        self._command.state(linuxcnc.STATE_ON)
        self._wait()

    def off(self) -> None:
        """Switch off."""
        self._command.state(linuxcnc.STATE_OFF)
        self._wait()

    def home(self, timeout: float = 20.0) -> None:
        """Home all joints, then go to world coordinates."""
        self._mode(linuxcnc.MODE_MANUAL)
        self._command.teleop_enable(False)
        self._command.home(-1)
        self._until(lambda: all(self._stat.homed[:JOINTS]) and self._stat.inpos, timeout, "homed")
        self._command.teleop_enable(True)
        self._wait()

    def mdi(self, line: str, timeout: float = 120.0) -> None:
        """Run a line of G-code to its end."""
        self.start(line)
        self.finish(timeout)

    def start(self, line: str) -> None:
        """Begin a line of G-code without waiting for its end."""
        self._mode(linuxcnc.MODE_MDI)
        self._command.mdi(line)

    def finish(self, timeout: float = 120.0) -> None:
        """Wait for the end of the line or program that was begun."""
        self._wait(timeout)
        self._until(lambda: self._stat.interp_state == linuxcnc.INTERP_IDLE and self._stat.inpos, timeout, "idle")

    def abort(self) -> None:
        """Abort the line or program that was begun."""
        self._command.abort()
        self._wait()

    def jog(self, axis: int, speed: float, distance: float) -> None:
        """Jog an axis by a distance in world coordinates and wait for the end."""
        self._mode(linuxcnc.MODE_MANUAL)
        self._command.teleop_enable(True)
        self._wait()
        self._command.jog(linuxcnc.JOG_INCREMENT, False, axis, speed, distance)
        self._wait()
        self._until(lambda: self._stat.inpos, 20.0, "there")

    def program(self, path: str) -> None:
        """Begin a file of G-code without waiting for its end."""
        self._mode(linuxcnc.MODE_AUTO)
        self._command.program_open(path)
        self._wait()
        self._command.auto(linuxcnc.AUTO_RUN, 0)
        self._until(lambda: self._stat.interp_state != linuxcnc.INTERP_IDLE, 10.0, "running")

    def stat(self, *names: str) -> list[Any]:
        """Return members of linuxcnc.stat()."""
        self._stat.poll()
        return [getattr(self._stat, name) for name in names]

    def errors(self) -> list[str]:
        """Return the messages of LinuxCNC to its operator since the last call."""
        found = []
        while message := self._errors.poll():
            found.append(message[1].strip())
        return found

    def get(self, *names: str) -> list[Any]:
        """Return values of HAL pins, signals and parameters."""
        return [hal.get_value(name) for name in names]

    def set(self, name: str, value: str) -> None:
        """Set an unconnected HAL pin or a parameter."""
        hal.set_p(name, value)

    def _mode(self, mode: int) -> None:
        self._stat.poll()
        if self._stat.task_mode != mode:
            self._command.mode(mode)
            self._wait()

    def _wait(self, timeout: float = 10.0) -> None:
        outcome = self._command.wait_complete(timeout)
        if outcome != linuxcnc.RCS_DONE:
            raise RuntimeError(f"LinuxCNC refused or did not end in {timeout} s ({outcome}): {self.errors()}")

    def _until(self, condition: Any, timeout: float, what: str) -> None:
        end = time.monotonic() + timeout
        while True:
            self._stat.poll()
            if condition():
                return
            if time.monotonic() > end:
                raise RuntimeError(f"not {what} within {timeout} s: {self.errors()}")
            time.sleep(0.01)


def serve(console: Console, server: socket.socket) -> None:
    """Answer one client after the other, until one sends "quit"."""
    while True:
        connection = server.accept()[0]
        with connection, connection.makefile("rw", encoding="utf-8") as lines:
            for line in lines:
                name, *arguments = json.loads(line)
                if name == "quit":
                    return
                try:
                    answer = {"ok": getattr(console, name)(*arguments)}
                except (RuntimeError, linuxcnc.error, AttributeError, TypeError) as error:
                    answer = {"error": f"{name}: {error}"}
                lines.write(json.dumps(answer) + "\n")
                lines.flush()


def main() -> None:
    """Open the socket beside the ini file, then serve."""
    path = os.path.join(os.path.dirname(os.path.abspath(sys.argv[sys.argv.index("-ini") + 1])), "console.sock")
    with socket.socket(socket.AF_UNIX) as server:
        console = Console()
        server.bind(path + ".new")
        server.listen()
        os.rename(path + ".new", path)  # who sees the path can connect
        serve(console, server)


if __name__ == "__main__":
    main()
