#!/usr/bin/python3
"""LinuxCNC without a screen: switch on, home, then run a program and end, or without a program stay until Ctrl-C.

The variable HEXAPOD_PROGRAM, or [DISPLAY]PROGRAM of the ini file, names the program. LinuxCNC's messages for the
operator are printed. To control LinuxCNC in another way, use its Python interface as this file does.
"""

import os
import signal
import sys
import time

import linuxcnc

JOINTS = 6
TIMEOUT = 60.0  # longest wait for LinuxCNC to be on, homed or running, s


class Stopped(Exception):
    """SIGINT, SIGTERM or SIGHUP was received."""


def stop(*_):
    raise Stopped


class Screen:
    """The first steps of an operator: switch on, home, run a program, read messages."""

    def __init__(self):
        self.command, self.stat, self.errors = linuxcnc.command(), linuxcnc.stat(), linuxcnc.error_channel()

    def print_messages(self):
        """Print the messages that LinuxCNC has for its operator."""
        while message := self.errors.poll():
            print(message[1].strip(), flush=True)

    def wait_until(self, condition, what, timeout=TIMEOUT):
        """Wait until a condition on linuxcnc.stat() is true; RuntimeError after the timeout, s."""
        end = time.monotonic() + timeout
        self.stat.poll()
        while not condition(self.stat):
            if time.monotonic() > end:
                raise RuntimeError(f"LinuxCNC is not {what} after {timeout:g} s")
            time.sleep(0.05)
            self.print_messages()
            self.stat.poll()

    def prepare(self):
        """Switch LinuxCNC on and home all joints."""
        self.command.state(linuxcnc.STATE_ESTOP_RESET)
        self.command.wait_complete()
        self.command.state(linuxcnc.STATE_ON)
        self.command.wait_complete()
        self.wait_until(lambda stat: stat.enabled, "on")
        self.command.mode(linuxcnc.MODE_MANUAL)
        self.command.wait_complete()
        self.command.home(-1)
        self.wait_until(lambda stat: all(stat.homed[:JOINTS]) and stat.inpos, "homed")
        print("on and homed", flush=True)

    def run(self, path):
        """Run a program; return whether LinuxCNC is still on at its end."""
        self.command.mode(linuxcnc.MODE_AUTO)
        self.command.wait_complete()
        self.command.program_open(os.path.abspath(path))
        self.command.auto(linuxcnc.AUTO_RUN, 0)
        self.wait_until(lambda stat: stat.interp_state != linuxcnc.INTERP_IDLE, f"running {path}")
        print(f"running {path}", flush=True)
        self.wait_until(lambda stat: stat.interp_state == linuxcnc.INTERP_IDLE and stat.inpos, "done", float("inf"))
        self.print_messages()
        print("done" if self.stat.enabled else "stopped: LinuxCNC is off", flush=True)
        return self.stat.enabled

    def stay(self):
        """Print LinuxCNC's messages until a signal raises Stopped."""
        while True:
            time.sleep(0.2)
            self.print_messages()


def main():
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, stop)
    screen = Screen()
    ini = linuxcnc.ini(sys.argv[sys.argv.index("-ini") + 1])
    program = os.environ.get("HEXAPOD_PROGRAM") or ini.find("DISPLAY", "PROGRAM")
    try:
        screen.prepare()
        if program:
            return 0 if screen.run(program) else 1
        screen.stay()
    except Stopped:
        return 0
    except (RuntimeError, linuxcnc.error) as error:
        screen.print_messages()
        print(error, flush=True)
        return 1


if __name__ == "__main__":
    sys.exit(main())
