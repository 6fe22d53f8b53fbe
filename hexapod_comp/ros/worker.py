"""A node's worker process, ``python -m hexapod_comp.cli.jobs``, for jobs that would block the node: parsing YAML or
computing derivatives holds Python's lock for tens of milliseconds, and a file on a dead network mount blocks for ever.
Jobs and results are pickled and sent through a socket; the process ends when the node closes the socket or dies."""

from __future__ import annotations

import os
import subprocess
import sys
import threading
import time
from collections import deque
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from multiprocessing.connection import Connection, Pipe
from pathlib import Path
from typing import Any

from ..errors import HexapodError, NoAnswerError

# Time after which an idle process is ended, s: the process holds 100 MB of memory, and a new process starts in 1 s
IDLE_AFTER = 10.0

JOBS = "hexapod_comp.cli.jobs"  # module that the process runs
NICENESS = 10  # niceness of processes beside a node; the node has priority, because the node answers commands

# Working directory of the process: Python imports modules from it, so other users must not be able to write into it
PACKAGE_ROOT = Path(__file__).resolve().parents[2]


def start_beside(module: str, *words: str, environment: dict[str, str], **options: Any) -> subprocess.Popen[bytes]:
    """Start a Python module as a process of low priority beside a node; further options are those of Popen."""
    process = subprocess.Popen(
        [sys.executable, "-m", module, *words],
        env={**os.environ, "OPENBLAS_NUM_THREADS": "1", **environment},  # the node needs the other cores
        stdin=subprocess.DEVNULL,
        start_new_session=True,  # so that Ctrl-C does not interrupt the process
        **options,
    )
    os.setpriority(os.PRIO_PROCESS, process.pid, NICENESS)
    return process


class WorkerError(HexapodError):
    """A failed job, with the error's `reason` and text, or with the reason ``worker`` if the process failed."""

    def __init__(self, reason: str, text: str) -> None:
        self.reason = reason
        super().__init__(text)


class Worker:
    """The queue of a node's jobs: a thread sends one job after the other to the worker process."""

    def __init__(self, idle_after: float = IDLE_AFTER) -> None:
        self._idle_after = idle_after
        self._process, self._thread = _Process(), ThreadPoolExecutor(1, "worker")
        self._jobs: deque[tuple[str, Future[Any], Callable[[Any], None], Callable[[WorkerError], None]]] = deque()
        self._done_at = 0.0

    @property
    def process(self) -> subprocess.Popen[bytes] | None:
        return self._process.popen

    def ask(
        self,
        task: str,
        arguments: dict[str, Any],
        done: Callable[[Any], None],
        failed: Callable[[WorkerError], None],
        machine: dict[str, Any] | None = None,
        within: float | None = None,
        late: str = "",
    ) -> None:
        """Queue a task: load_model, predict, travel or plan_move; :meth:`poll` calls `done` or `failed` later.

        A job that takes more than `within` seconds fails with the text `late`, and the process is killed. `machine`
        holds the texts of the geometry file and of the model file.
        """
        job = self._thread.submit(self._process.do, task, arguments, machine, within, late)
        self._jobs.append((task, job, done, failed))

    def busy(self, task: str) -> bool:
        return any(job[0] == task for job in self._jobs)

    def poll(self, now: float) -> None:
        """If the oldest job is done, call its `done` or `failed`; end the process after `idle_after` idle seconds."""
        if self._jobs and self._jobs[0][1].done():
            _, job, done, failed = self._jobs.popleft()
            self._done_at = time.monotonic()
            error = job.exception()
            if error is None:
                done(job.result())
            else:
                failed(error if isinstance(error, WorkerError) else WorkerError("worker", str(error)))
        elif not self._jobs and self.process is not None and now - self._done_at > self._idle_after:
            self._process.end()

    def close(self) -> None:
        self._thread.shutdown(wait=False, cancel_futures=True)
        self._jobs.clear()
        self._process.end()


class _Process:
    """The worker process and its socket; the methods run in the worker's thread, which waits without Python's lock."""

    def __init__(self) -> None:
        self.popen: subprocess.Popen[bytes] | None = None
        self._connection: Connection | None = None
        self._machine: dict[str, Any] | None = None  # the machine that was last sent to the process

    def do(
        self, task: str, arguments: dict[str, Any], machine: dict[str, Any] | None, within: float | None, late: str
    ) -> Any:
        if self.popen is None or self.popen.poll() is not None:  # the process may have been killed while it was idle
            self._machine = None
        changed = None if machine == self._machine else machine
        self._machine = machine or self._machine
        try:
            answer = self.exchange((task, changed, arguments), within)
        except (EOFError, ConnectionError):
            answer = "worker", "the worker process ended", None
        except OSError as error:
            answer = "worker", f"the worker process failed: {error}", None
        reason, text, result = answer or (NoAnswerError.reason, late, None)
        if reason:
            if answer is None or self.popen is None or self.popen.poll() is not None:
                self.end()
            raise WorkerError(reason, text)
        return result

    def exchange(self, request: tuple[Any, ...], within: float | None) -> tuple[str, str, Any] | None:
        """Send a job; return its error's reason and text (both "": no error) and its result; None after `within` s."""
        if self.popen is None or self.popen.poll() is not None:
            self._start()
        connection = self._connection
        connection.send(request)  # type: ignore[union-attr]
        return connection.recv() if connection.poll(within) else None  # type: ignore[union-attr, no-any-return]

    def _start(self) -> None:
        self._connection, theirs = Pipe()
        with theirs:
            fd = theirs.fileno()
            self.popen = start_beside(JOBS, str(fd), environment={}, cwd=PACKAGE_ROOT, pass_fds=[fd])

    def end(self) -> None:
        """Kill the process; a thread waits for its end, which a dead disk can delay for ever."""
        popen, self.popen, self._machine = self.popen, None, None
        if popen is not None:
            popen.kill()
            threading.Thread(target=popen.wait, name="end of the worker", daemon=True).start()
