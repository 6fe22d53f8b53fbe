#!/usr/bin/python3
"""LinuxCNC without a screen: switch on, home, run a program if one is given, stay until Ctrl-C.

The program is [DISPLAY]PROGRAM of the ini file, or the variable HEXAPOD_PROGRAM; with a program LinuxCNC ends when the
program has. Messages for the operator are printed. For one's own steering, see LinuxCNC's Python interface.
"""

import os
import signal
import sys
import time

import linuxcnc

JOINTS = 6
PATIENCE = 60.0


class Stopped(Exception):
    """Somebody has asked for the end."""


def stop(*_):
    raise Stopped


class Screen:
    """What an operator does first."""

    def __init__(self):
        self.command, self.stat, self.errors = linuxcnc.command(), linuxcnc.stat(), linuxcnc.error_channel()

    def say(self):
        """Print what LinuxCNC tells its operator."""
        while message := self.errors.poll():
            print(message[1].strip(), flush=True)

    def until(self, condition, what, patience=PATIENCE):
        """Wait for a condition on linuxcnc.stat()."""
        end = time.monotonic() + patience
        self.stat.poll()
        while not condition(self.stat):
            if time.monotonic() > end:
                raise RuntimeError(f"not {what} within {patience:g} s")
            time.sleep(0.05)
            self.say()
            self.stat.poll()

    def prepare(self):
        """Switch on and home."""
        self.command.state(linuxcnc.STATE_ESTOP_RESET)
        self.command.wait_complete()
        self.command.state(linuxcnc.STATE_ON)
        self.command.wait_complete()
        self.until(lambda stat: stat.enabled, "on")
        self.command.mode(linuxcnc.MODE_MANUAL)
        self.command.wait_complete()
        self.command.home(-1)
        self.until(lambda stat: all(stat.homed[:JOINTS]) and stat.inpos, "homed")
        print("on and homed", flush=True)

    def run(self, path):
        """Run a program to its end; return whether it came there."""
        self.command.mode(linuxcnc.MODE_AUTO)
        self.command.wait_complete()
        self.command.program_open(os.path.abspath(path))
        self.command.auto(linuxcnc.AUTO_RUN, 0)
        self.until(lambda stat: stat.interp_state != linuxcnc.INTERP_IDLE, f"running {path}")
        print(f"running {path}", flush=True)
        self.until(lambda stat: stat.interp_state == linuxcnc.INTERP_IDLE and stat.inpos, "done", float("inf"))
        self.say()
        print("done" if self.stat.enabled else "stopped: LinuxCNC is off", flush=True)
        return self.stat.enabled

    def stay(self):
        """Print messages for ever."""
        while True:
            time.sleep(0.2)
            self.say()


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
        screen.say()
        print(error, flush=True)
        return 1


if __name__ == "__main__":
    sys.exit(main())
