"""One process beside a node, for work that must not stop its loop: loading a model, predicted error, travel.

Parsing YAML holds Python's lock for tens of milliseconds, derivatives do for as long, and a file on a dead network
mount blocks without end: meanwhile no command would be answered. So the node uses a process, which it starts when it
first needs it: ``python -m hexapod_comp.cli.jobs``; the nodes themselves import nothing of calibration. Jobs and
results are sent pickled through a socket between the two; jobs are done in turn. The process ends when the node's end
of the socket closes, so it never outlives the node.
"""

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

from ..errors import HexapodError

# Without a job for this long the process is ended, s: it holds a hundred megabytes; a new one takes a second
IDLE_AFTER = 10.0

JOBS = "hexapod_comp.cli.jobs"  # the module that it runs

# Working directory of the process: Python also imports from it, so it must not be an arbitrary one
PACKAGE_ROOT = Path(__file__).resolve().parents[2]


class WorkerError(HexapodError):
    """A job failed; the message is the process's, or describes its end."""

    reason = "bad_file"


class Worker:
    """The node's side: a thread sends one job at a time to the process; `poll` calls back with the results."""

    def __init__(self, idle_after: float = IDLE_AFTER) -> None:
        self._idle_after = idle_after
        self._process, self._thread = _Process(), ThreadPoolExecutor(1, "worker")
        self._jobs: deque[tuple[str, Future[Any], Callable[[Any], None], Callable[[WorkerError], None]]] = deque()
        self._done_at = 0.0

    @property
    def process(self) -> subprocess.Popen[bytes] | None:
        """The process; None before it was started, and after it was ended."""
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
        """Have a task (load_model, predict, travel, plan_move) done for machine and model; `poll` passes its result to
        `done`. After `within`, s, the process is killed, and the error is `late`."""
        job = self._thread.submit(self._process.do, task, arguments, machine, within, late)
        self._jobs.append((task, job, done, failed))

    def busy(self, task: str) -> bool:
        """Return whether such a task was asked for and has not been answered."""
        return any(job[0] == task for job in self._jobs)

    def poll(self, now: float) -> None:
        """Call back with a result; end a process that is idle for `idle_after`, s."""
        if self._jobs and self._jobs[0][1].done():
            _, job, done, failed = self._jobs.popleft()
            self._done_at = time.monotonic()
            error = job.exception()
            if error is None:
                done(job.result())
            else:
                failed(error if isinstance(error, WorkerError) else WorkerError(str(error)))
        elif not self._jobs and self.process is not None and now - self._done_at > self._idle_after:
            self._process.end()

    def close(self) -> None:
        """Abandon all jobs and end the process, whatever it does."""
        self._thread.shutdown(wait=False, cancel_futures=True)
        self._jobs.clear()
        self._process.end()


class _Process:
    """The process and its socket; `do` waits in the worker's thread, where Python's lock is free."""

    def __init__(self) -> None:
        self.popen: subprocess.Popen[bytes] | None = None
        self._connection: Connection | None = None
        self._machine: dict[str, Any] | None = None  # known to the process already

    def do(
        self, task: str, arguments: dict[str, Any], machine: dict[str, Any] | None, within: float | None, late: str
    ) -> Any:
        """Return the result of a task, or raise a WorkerError."""
        if self.popen is None or self.popen.poll() is not None:  # it may have been killed while it was idle
            self._machine = None
        news = None if machine == self._machine else machine
        self._machine = machine or self._machine
        try:
            answer = self.exchange((task, news, arguments), within)
        except (EOFError, ConnectionError):
            answer = "the process beside the node ended", None
        except OSError as error:
            answer = f"the process beside the node failed: {error}", None
        if answer is None or answer[0]:
            if answer is None or self.popen is None or self.popen.poll() is not None:
                self.end()
            raise WorkerError(late if answer is None else answer[0])
        return answer[1]

    def exchange(self, request: tuple[Any, ...], within: float | None) -> tuple[str, Any] | None:
        """Return problem and result of a request, None if neither arrives within a time, s."""
        if self.popen is None or self.popen.poll() is not None:
            self._start()
        connection = self._connection
        connection.send(request)  # type: ignore[union-attr]
        return connection.recv() if connection.poll(within) else None  # type: ignore[union-attr, no-any-return]

    def _start(self) -> None:
        self._connection, theirs = Pipe()
        alone = {**os.environ, "OPENBLAS_NUM_THREADS": "1"}  # the other cores are the loop's
        with theirs:
            self.popen = subprocess.Popen(
                [sys.executable, "-m", JOBS, str(theirs.fileno())],
                cwd=PACKAGE_ROOT,
                env=alone,
                pass_fds=[theirs.fileno()],
                stdin=subprocess.DEVNULL,
                start_new_session=True,  # so that Ctrl-C does not interrupt it
            )

    def end(self) -> None:
        """End the process; a thread waits for its end, since a process that waits for a dead disk cannot even be
        killed."""
        popen, self.popen, self._machine = self.popen, None, None
        if popen is not None:
            popen.kill()
            threading.Thread(target=popen.wait, name="end of the worker", daemon=True).start()
