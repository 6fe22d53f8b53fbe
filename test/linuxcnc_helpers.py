"""Running the real LinuxCNC from a test: as an ordinary user, without a screen, one at a time, and to its end.

LinuxCNC refuses root, asks on a terminal, and keeps state under fixed shared-memory keys and in one lock file, which
remain after a crash. This module handles all of that.
"""

from __future__ import annotations

import json
import os
import pwd
import re
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from hexapod_comp.linuxcnc.hal import HalError, load_module
from hexapod_comp.ros import end_with_parent

ROOT = Path(__file__).resolve().parents[1]
CONFIG = ROOT / "config" / "linuxcnc"
OURS = Path(__file__).resolve().parent / "data" / "linuxcnc"

LOCK = Path("/tmp/linuxcnc.lock")

KEYS = {0x48414C32, 0x48484C34, 0x64, *range(0x3E9, 0x3F3)}
"""Keys of shared memory of HAL, RTAPI, motion and NML: rtapi.h, hal_priv.h, config.h and linuxcnc.nml of 2.9."""

ALONE_WITHIN = 120.0  # longest wait for the end of another LinuxCNC on this computer, s
START_WITHIN, STOP_WITHIN = 180.0, 30.0  # longest start and stop on a busy computer, s

DELAY = 3
"""Servo cycles by which the struts follow the commanded axes, for motion's cubic interpolation and the drive.

Found by comparison: with it both agree to 0.07 µm at 50 mm/s.
"""


def why_not() -> str | None:
    """Return the reason why LinuxCNC cannot run here, or None."""
    if not os.environ.get("LINUXCNC_TESTS"):
        return "not asked for: make test-linuxcnc"
    missing = [name for name in ("linuxcnc", "halsampler", "script", "setpriv") if shutil.which(name) is None]
    if missing:
        return f"{missing[0]} is not installed; Debian: apt-get install linuxcnc-uspace"
    try:
        load_module("hal")
    except HalError as error:
        return str(error)
    return None


# ---- an ordinary user ----


def as_ordinary_user() -> list[str]:
    """Return the prefix of a command that runs it as an ordinary user who can read the interpreter and the sources."""
    # Root becomes nobody. If interpreter or sources are under /root, the process keeps the capability to read any file,
    # which does not make it root.
    if os.geteuid() != 0:
        return []
    nobody = pwd.getpwnam("nobody")
    switch = ["setpriv", f"--reuid={nobody.pw_uid}", f"--regid={nobody.pw_gid}", "--clear-groups", "--pdeathsig=TERM"]
    said = ""
    for capability in ("", "dac_read_search", "dac_override"):
        extra = [f"--inh-caps=+{capability}", f"--ambient-caps=+{capability}"] if capability else []
        trial = [*switch, *extra, sys.executable, "-c", "import hexapod_comp.linuxcnc.bridge"]
        done = subprocess.run(trial, env=environment(Path("/nonexistent")), cwd="/", capture_output=True, text=True)
        if done.returncode == 0:
            return [*switch, *extra]
        said = done.stderr
    raise RuntimeError(f"nobody can run {sys.executable} with {ROOT}: {said}")


def environment(home: Path) -> dict[str, str]:
    """Return the environment of all started processes: this test's ROS domain, an own home folder, no screen."""
    kept = ("ROS_DOMAIN_ID", "ROS_AUTOMATIC_DISCOVERY_RANGE", "LANG", "LC_ALL", "LD_LIBRARY_PATH")
    return {
        **{name: os.environ[name] for name in kept if name in os.environ},
        "HOME": str(home),
        "PATH": "/usr/local/bin:/usr/bin:/bin:/usr/sbin:/sbin",
        "PYTHONPATH": str(ROOT),
        "PYTHONDONTWRITEBYTECODE": "1",
        "ROS_LOG_DIR": str(home / "ros"),
        "OPENBLAS_NUM_THREADS": "1",
        "OMP_NUM_THREADS": "1",
    }


def give(path: Path) -> None:
    """Make the ordinary user the owner of a folder and its content."""
    if os.geteuid() == 0:
        nobody = pwd.getpwnam("nobody")
        for entry in (path, *path.rglob("*")):
            os.chown(entry, nobody.pw_uid, nobody.pw_gid)


def make_folder() -> Path:
    """Make a folder, with a home folder in it, for one LinuxCNC."""
    folder = Path(tempfile.mkdtemp(prefix="hexapod_linuxcnc_", dir="/tmp"))
    home = folder / "home"
    (home / "ros").mkdir(parents=True)
    return folder


# ---- one at a time ----


@dataclass(frozen=True)
class Segment:
    number: str
    owner: int
    attached: int


def segments() -> list[Segment]:
    rows = [line.split() for line in Path("/proc/sysvipc/shm").read_text().splitlines()[1:]]
    return [Segment(r[1], int(r[7]), int(r[6])) for r in rows if int(r[0]) & 0xFFFFFFFF in KEYS]


def clean_up_after_a_crash() -> None:
    """Remove unused segments and files that a crashed LinuxCNC of our user has left."""
    end = time.monotonic() + ALONE_WITHIN
    while any(segment.attached for segment in segments()):
        if time.monotonic() > end:
            raise RuntimeError(f"another LinuxCNC has been running on this machine for {ALONE_WITHIN:g} s")
        time.sleep(0.5)
    us = pwd.getpwnam("nobody").pw_uid if os.geteuid() == 0 else os.geteuid()
    for segment in segments():
        if segment.owner != us:
            raise RuntimeError(f"user {segment.owner} has left LinuxCNC's shared memory: ipcrm -m {segment.number}")
        subprocess.run(["ipcrm", "-m", segment.number], check=True)
    if LOCK.exists():
        if LOCK.stat().st_uid != us:
            raise RuntimeError(f"{LOCK} is left by user {LOCK.stat().st_uid}: remove it")
        LOCK.unlink()


# ---- LinuxCNC ----


def give_real_time() -> None:
    """Give LinuxCNC's realtime threads the priority that they have on a realtime kernel, if we may (as root).

    Without it other processes stop the servo thread at times.
    """
    with suppress(PermissionError):
        for task in Path("/proc").glob("[0-9]*/task/*"):
            if _name(task).startswith("rtapi_app:T#"):
                os.sched_setscheduler(int(task.name), os.SCHED_FIFO, os.sched_param(50))


def _name(task: Path) -> str:
    try:
        return (task / "comm").read_text()
    except OSError:  # the process has ended
        return ""


class Process:
    """A process of the ordinary user, with its output in a file."""

    def __init__(self, command: Sequence[str], folder: Path, log: str, switch: Sequence[str]) -> None:
        self.log = folder / log
        with self.log.open("ab") as output:
            self._process = subprocess.Popen(
                [*switch, *command],
                cwd=folder,
                env=environment(folder / "home"),
                stdin=subprocess.DEVNULL,
                stdout=output,
                stderr=subprocess.STDOUT,
                start_new_session=True,
                preexec_fn=end_with_parent,
            )

    @property
    def pid(self) -> int:
        return self._process.pid

    def running(self) -> bool:
        return self._process.poll() is None

    def end(self, number: signal.Signals = signal.SIGTERM, timeout: float = 10.0) -> int:
        """Send a signal and wait; kill the process if it does not end. Return the exit code."""
        if self.running():
            self._process.send_signal(number)
        try:
            return self._process.wait(timeout)
        except subprocess.TimeoutExpired:
            self._process.kill()
            return self._process.wait()

    def text(self) -> str:
        return self.log.read_text(errors="replace")


def until(condition: Callable[[], Any], what: str, timeout: float, log: Callable[[], str] = str) -> None:
    end = time.monotonic() + timeout
    while not condition():
        if time.monotonic() > end:
            raise TimeoutError(f"waited {timeout:g} s in vain for {what}\n{log()[-3000:]}")
        time.sleep(0.02)


class Linuxcnc:
    """A LinuxCNC with the shipped configuration, controlled through console.py.

    `changes` replaces texts of hexapod.inc; `files` are additional files of the configuration, or replace its files.
    """

    def __init__(self, changes: dict[str, str] | None = None, files: dict[str, str] | None = None) -> None:
        self._switch = as_ordinary_user()
        clean_up_after_a_crash()
        self.folder = make_folder()
        self._processes: list[Process] = []
        self._closed, self._started = False, 0
        self._write_configuration(changes or {}, files or {})
        self._process = self.start_process(["script", "-qec", "linuxcnc -v headless.ini", "/dev/null"], "linuxcnc.log")
        socket_path = self.folder / "console.sock"
        try:
            until(lambda: socket_path.exists() or not self._process.running(), "LinuxCNC", START_WITHIN, self.said)
            self._socket = socket.socket(socket.AF_UNIX)
            self._socket.connect(str(socket_path))
        except (TimeoutError, OSError) as error:
            said = self.said()  # before its folder is deleted
            self.close()
            raise RuntimeError(f"LinuxCNC did not start: {error}\n{said}") from error
        self._lines = self._socket.makefile("rw", encoding="utf-8")
        give_real_time()

    def _write_configuration(self, changes: dict[str, str], files: dict[str, str]) -> None:
        for source in (*CONFIG.iterdir(), OURS / "console.py", OURS / "recorder.hal"):
            shutil.copy(source, self.folder)
        run = f"{sys.executable} -m hexapod_comp"
        edits = {
            "BRIDGE = linuxcnc_bridge": f"BRIDGE = {run}.linuxcnc.bridge",
            "SWEEP = hal_sweep": f"SWEEP = {run}.linuxcnc.hal",
            "MACHINE = linuxcnc_machine": f"MACHINE = {run}.linuxcnc.machine",
            "HALFILE = machine.hal\n": "HALFILE = machine.hal\nHALFILE = recorder.hal\n",
            **changes,
        }
        self._edit("hexapod.inc", edits)
        self._edit("headless.ini", {"./headless.py": "./console.py"})
        for name, text in files.items():
            (self.folder / name).write_text(text)
        give(self.folder)

    def _edit(self, name: str, edits: dict[str, str]) -> None:
        path = self.folder / name
        text = path.read_text()
        for old, new in edits.items():
            assert old in text, f"{name} has no {old!r}"
            text = text.replace(old, new)
        path.write_text(text)

    # ---- processes ----

    def start_process(self, command: Sequence[str], log: str) -> Process:
        """Start a process of the same user in the same folder and ROS domain; it ends with LinuxCNC."""
        self._started += 1
        process = Process(command, self.folder, log, self._switch)
        self._processes.append(process)
        return process

    def compensator(self, model: str, **parameters: object) -> Process:
        """Start a compensator with a model file and wait until it is ready."""
        # During a motion the bridge would not publish the moving struts to it: see doc/linuxcnc.md.
        given = {"model_file": model, "start_without_feedback_after": 0.5, **parameters}
        words = [f"{name}:={value}" for name, value in given.items()]
        options = [word for text in words for word in ("-p", text)]
        command = [sys.executable, "-m", "hexapod_comp.ros.compensator", "--ros-args", *options]
        process = self.start_process(command, f"compensator_{self._started}.log")
        self.newest_compensator = process
        until(lambda: ": ready" in process.text() or not process.running(), "compensator", START_WITHIN, process.text)
        assert process.running(), process.text()
        return process

    def halcmd(self, *words: str) -> str:
        process = self.start_process(["halcmd", *words], f"halcmd_{self._started}.log")
        # A pipe would stay open, since processes that a HAL file loads continue to run.
        until(lambda: not process.running(), f"halcmd {' '.join(words)}", START_WITHIN, process.text)
        self._processes.remove(process)
        assert process.end() == 0, process.text()
        return process.text()

    def pid_of(self, component: str) -> int:
        row = re.search(rf"^\s*\d+\s+User\s+{component}\s+(\d+)", self.halcmd("show", "comp"), re.MULTILINE)
        assert row, f"no component {component}"
        return int(row[1])

    def give_file(self, name: str, text: str) -> str:
        """Write a file that LinuxCNC's user can read and return its path."""
        path = self.folder / name
        path.write_text(text)
        path.chmod(0o644)
        return str(path)

    def said(self) -> str:
        return self._process.text()

    # ---- the console ----

    def ask(self, name: str, *arguments: Any) -> Any:
        """Call a function of console.py and return its result."""
        self._lines.write(json.dumps([name, *arguments]) + "\n")
        self._lines.flush()
        line = self._lines.readline()
        assert line, f"LinuxCNC has ended\n{self.said()[-3000:]}"
        answer = json.loads(line)
        if "error" in answer:
            raise RuntimeError(answer["error"])
        return answer["ok"]

    def get(self, *names: str) -> Any:
        values = self.ask("get", *names)
        return values[0] if len(names) == 1 else values

    def struts(self) -> np.ndarray:
        return np.array(self.get(*(f"strut-{i}-fb" for i in range(6))))

    def enable(self, on: bool) -> None:
        self.halcmd("sets", "comp-enable", str(int(on)))
        self.until_pin("comp-status", 2 if on else 0)
        time.sleep(0.05)  # the chain's own ramp may be a few cycles late

    def until_pin(self, name: str, value: Any, timeout: float = 10.0) -> None:
        """Wait until a HAL value equals `value`."""
        until(lambda: self.get(name) == value, f"{name} = {value}; now {self.get(name)}", timeout, self.said)

    @contextmanager
    def recording(self) -> Iterator[Record]:
        """Record every servo cycle inside the with block."""
        record = Record()
        paths = [self.folder / f"record{n}.txt" for n in range(2)]
        words = [f"halsampler -t -c {n} > {path.name}" for n, path in enumerate(paths)]
        readers = [self.start_process(["sh", "-c", f"exec {word}"], "halsampler.log") for word in words]
        self.halcmd("sets", "record", "1")
        try:
            yield record
        finally:
            self.halcmd("sets", "record", "0")
            until(lambda: self.get("sampler.0.curr-depth", "sampler.1.curr-depth") == [0, 0], "the record", 10.0)
            for reader in readers:
                reader.end(signal.SIGINT)
        record.fill(*(np.loadtxt(path, comments="overrun", ndmin=2) for path in paths))
        assert self.get("sampler.0.overruns", "sampler.1.overruns") == [0, 0]

    def close(self) -> None:
        if self._closed:
            return
        self._closed = True
        others = [process for process in self._processes if process is not self._process]
        for process in others:
            process.end()
        if hasattr(self, "_lines"):
            self._lines.write('["quit"]\n')
            self._lines.flush()
            self._lines.close()
            self._socket.close()
        try:
            until(lambda: not self._process.running(), "LinuxCNC's end", STOP_WITHIN, self.said)
        except TimeoutError:
            self._kill_all()
            raise
        finally:
            shutil.rmtree(self.folder, ignore_errors=True)

    def _kill_all(self) -> None:
        """Kill every process whose environment has this LinuxCNC's home folder."""
        mark = f"HOME={self.folder / 'home'}\0".encode()
        for path in Path("/proc").glob("[0-9]*/environ"):
            try:
                if mark in path.read_bytes():
                    os.kill(int(path.parent.name), signal.SIGKILL)
            except OSError:
                continue
        time.sleep(0.5)
        clean_up_after_a_crash()

    def __enter__(self) -> Linuxcnc:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


class Record:
    """The record of the realtime sampler in each servo cycle; lengths in mm, angles in degrees."""

    def fill(self, rows: np.ndarray, side: np.ndarray) -> None:
        """Store the columns of recorder.hal (`rows`) and those of `side`: cycle number, then six following errors."""
        self.side, delayed = side, np.maximum(np.arange(len(rows)) - DELAY, 0)
        self.axes = rows[delayed, 1:7]  # X, Y, Z, A, B, C of the tool by LinuxCNC
        self.struts, self.corrections = rows[:, 7:13], rows[:, 13:19]  # lengths at the drives; corrections in force
        self.alive, self.status = rows[:, 19] > 0.5, rows[:, 20]  # heartbeat changes; its pin `status`
        self.following_error = float(np.abs(side[:, 1:7]).max())
        assert (np.diff(rows[:, 0]) == 1.0).all(), "cycles are missing"
        self.largest_step = float(np.abs(np.diff(self.corrections, axis=0)).max())  # between servo cycles
