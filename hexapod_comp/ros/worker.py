"""One process beside a node, for what must not stop its loop: loading a model, the predicted error, how far it may go.

Parsing YAML keeps Python's lock for tens of milliseconds, derivatives for as long, and a file on a dead network mount
is waited for without end: meanwhile no command would be answered. So the node asks a process, which it starts when it
first needs it: ``python -m hexapod_comp.ros.worker``. A job and its answer are a line of JSON each, on its stdin and
stdout; jobs are done in turn. It ends with its input, so that it never outlives the node.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from queue import Empty, SimpleQueue
from typing import Any

import numpy as np

from ..compensation.journal import LARGEST_SOURCE, Source
from ..errors import HexapodError
from ..formats.json import json_text
from ..formats.paths import confined_file, confined_opener
from ..machine.field import GridField
from ..machine.model import Datum, MachineModel, ModelOrigin, RealMachine
from ..machine.region import Region
from ..machine.struts import StrutErrors
from ..machine.temperatures import LateGrowth, Temperatures
from ..pose import Pose

NICENESS = 10
"""Commands come first."""

IDLE_AFTER = 10.0
"""Without a job for this long the process is ended, s: it holds a hundred megabytes; a new one takes a second."""

PACKAGE_ROOT = Path(__file__).resolve().parents[2]
"""Where the process runs: Python also imports from the folder it runs in, which must not be just any."""


class WorkerError(HexapodError):
    """A job failed; the message is the process's, or says what became of it."""

    reason = "bad_file"


@dataclass
class Job:
    """What the process is asked for."""

    task: str  # load_model, predict or travel
    arguments: dict[str, Any]  # for JSON
    done: Callable[[Any], None]  # called with the result, from Worker.look
    failed: Callable[[WorkerError], None]
    machine: dict[str, Any] | None = None  # which one, as Machine takes it
    read: Callable[[Any], Any] = lambda answer: answer  # makes the result of the answer, in a thread of its own
    within: float = float("inf")  # s, from its beginning; then the process is given up
    late: str = ""  # the error's text then
    began: float = float("inf")

    def line(self, machine: dict[str, Any] | None) -> str:
        """Return the job as a line of JSON; `machine`: None where the process knows it already."""
        return json.dumps({"task": self.task, "machine": machine, "asked": self.arguments}) + "\n"

    def result(self, line: str) -> Any:
        """Return what an answer holds, or its error."""
        answer = json.loads(line)
        if "problem" in answer:
            return WorkerError(answer["problem"])
        try:
            return self.read(answer)
        except HexapodError as error:
            return WorkerError(str(error))


class Worker:
    """The node's end: sends one job at a time to the process; `look` calls back with the results that have come."""

    def __init__(self) -> None:
        self._waiting: deque[Job] = deque()
        self._running: Job | None = None
        self._helper: _Helper | None = None
        self._done_at = 0.0

    @property
    def process(self) -> subprocess.Popen[str] | None:
        """The process; None before it was started, and after it was ended."""
        return None if self._helper is None else self._helper.process

    def ask(self, job: Job) -> None:
        """Have a job done."""
        self._waiting.append(job)
        self._next()

    def look(self, now: float) -> None:
        """Call back with a result; give up a job after `within`, and end a process that is idle for IDLE_AFTER."""
        job, helper = self._running, self._helper
        if helper is None or job is None:
            if helper is not None and now - self._done_at > IDLE_AFTER:
                self._end(kill=False)
            return
        try:
            answer = helper.answers.get_nowait()
        except Empty:
            if now - job.began > job.within:
                self._end(kill=True)
                self._settle(job, WorkerError(job.late))
            return
        if helper.ended:
            self._end(kill=False)
        self._settle(job, answer)

    def close(self) -> None:
        """Give up all jobs and let the process end, by force where it is at work."""
        self._waiting.clear()
        self._end(kill=self._running is not None)
        self._running = None

    def _settle(self, job: Job, answer: Any) -> None:
        self._running, self._done_at = None, time.monotonic()
        self._next()
        if isinstance(answer, WorkerError):
            job.failed(answer)
        else:
            job.done(answer)

    def _next(self) -> None:
        if self._running is None and self._waiting:
            self._running = job = self._waiting.popleft()
            if self.process is not None and self.process.poll() is not None:
                self._end(kill=False)  # it was killed while it had nothing to do
            self._helper, job.began = self._helper or _Helper(), time.monotonic()
            self._helper.jobs.put(job)

    def _end(self, kill: bool) -> None:
        helper, self._helper = self._helper, None
        if helper is not None:
            helper.jobs.put(None)
            if kill and helper.process is not None:
                helper.process.kill()


class _Helper:
    """A process, and the thread that talks with it, which keeps no lock while it waits."""

    def __init__(self) -> None:
        self.jobs: SimpleQueue[Job | None] = SimpleQueue()
        self.answers: SimpleQueue[Any] = SimpleQueue()
        self.process: subprocess.Popen[str] | None = None
        self.ended = False
        self._machine: dict[str, Any] | None = None  # that it knows already
        threading.Thread(target=self._run, name="worker", daemon=True).start()

    def _run(self) -> None:
        command, pipe = [sys.executable, "-m", __name__], subprocess.PIPE
        alone = {**os.environ, "OPENBLAS_NUM_THREADS": "1", "PYTHONUTF8": "1"}  # the other cores are the loop's
        problem = "the process beside the node ended"
        try:
            with subprocess.Popen(
                command, cwd=PACKAGE_ROOT, env=alone, stdin=pipe, stdout=pipe, encoding="utf-8", start_new_session=True
            ) as self.process:  # of a session of its own, so that Ctrl-C does not interrupt it
                while (job := self.jobs.get()) is not None:
                    if (answer := self._talk(job)) is None:
                        break
                    self.answers.put(answer)
        except (OSError, ValueError) as error:
            if not isinstance(error, BrokenPipeError):
                problem = f"the process beside the node failed: {error}"
        self.ended = True
        self.answers.put(WorkerError(problem))

    def _talk(self, job: Job) -> Any:
        """Return the result of a job, or its error; None where the process has ended."""
        into, out = self.process.stdin, self.process.stdout  # type: ignore[union-attr]
        machine = None if job.machine == self._machine else job.machine
        self._machine = job.machine or self._machine
        into.write(job.line(machine))  # type: ignore[union-attr]
        into.flush()  # type: ignore[union-attr]
        line = out.readline()  # type: ignore[union-attr]
        return job.result(line) if line else None


def model_json(model: MachineModel) -> str:
    """Return a model as JSON; its numbers come back bit for bit."""
    return json_text(model, indent=None)


def model_of(data: dict[str, Any]) -> MachineModel:
    """Return the model of a :func:`model_json`; a ModelError where its numbers cannot describe a machine."""
    field, origin = data["field"], data["origin"]
    origin["sources"] = tuple(tuple(source) for source in origin["sources"])
    origin["posterior"] = None if origin["posterior"] is None else tuple(origin["posterior"])
    origin["datum"] = None if origin["datum"] is None else Datum(**origin["datum"])
    data["late_growth"] = LateGrowth(**data["late_growth"])
    data["struts"] = StrutErrors(**data["struts"])
    data["field"] = GridField(**{**field, "grid": tuple(field["grid"]), "lines": tuple(field["lines"])})
    data["origin"] = ModelOrigin(**origin)
    data["region"] = None if data["region"] is None else Region(**data["region"])
    return MachineModel(**data)


def loaded_model(answer: dict[str, Any]) -> tuple[MachineModel, Source]:
    """Return what :func:`load_model` has found."""
    return model_of(answer["model"]), Source(**answer["source"])


# ---- the process ----


def load_model(name: str, place: str, folder: str | None, machine: str) -> dict[str, Any]:
    """Find and read a machine's model file, relative to a place, in a folder; return the model and its source, without
    the text where that is too long for the journal."""
    os.chdir(place)
    inside = None if folder is None else Path(folder)
    source = Source.read(confined_file(name, inside, "model"), confined_opener(inside))
    model = source.model(machine)
    text = source.text if len(source.text or "") <= LARGEST_SOURCE else None
    return {"source": {"name": source.name, "text": text, "sha256": source.sha256}, "model": model}


class Machine:
    """A machine and its model, made of the texts in use: what else is needed of them is made when it is."""

    def __init__(self, geometry: dict[str, Any], model: dict[str, Any], folder: str | None) -> None:
        self._opener = confined_opener(None if folder is None else Path(folder))
        self._source = Source(**model)
        if self._source.text is None:  # it was too long to be kept
            again = Source.read(self._source.name, self._opener)
            if again.sha256 != self._source.sha256:
                raise WorkerError(f"{self._source.name}: has changed since it was loaded")
            self._source = again
        self.geometry = Source(**geometry).geometry()
        self.model = self._source.model(self.geometry.name)
        self._fitted: Any = None
        self._at: Any = None

    def predict(self, position: list, rotation: list, sense: list, tool: str, warmth: list[dict]) -> dict[str, Any]:
        """Return the errors at a pose; `warmth`: temperatures, and how far what follows them late is behind."""
        from ..calibration.posterior import ErrorPredictor
        from ..calibration.posterior_file import load_posterior

        if self._fitted is None:
            self._fitted = load_posterior(self.model, self.geometry, self._source.name, self._opener)
        if (tool, warmth) != self._at:
            machine = RealMachine(self.geometry.using(tool=tool), self.model, self._restored(warmth))
            self._predictor, self._at = ErrorPredictor(machine, self._fitted[0]), (tool, warmth)
        errors = self._predictor.predict((np.array([position]), np.array([rotation])), np.array([sense]))
        result: dict[str, Any] = {"unknown": self._fitted[1]}
        for name, error in zip(("standing", "aligned"), errors, strict=True):
            covariance = None if error is None or error.covariance is None else error.covariance[0].ravel()
            result[name] = None if error is None else {"values": error.values[0], "covariance": covariance}
        return result

    def travel(
        self, position: list, rotation: list, tool: str, work: str, warmth: list[dict], enabled: bool
    ) -> dict[str, Any]:
        """Return how far a tool may go from a pose in a frame: a text, and values by their keys."""
        from ..compensation.travel import travel, travel_text

        geometry = self.geometry.using(tool, work)
        machine = RealMachine(geometry, self.model, self._restored(warmth))
        ways = travel(machine, Pose(np.array(position), np.array(rotation)), geometry.work, enabled)
        stops = {f"{one.way} stops at": str(one.error or "") for one in ways}
        return {"text": travel_text(ways), "values": {**{one.key: f"{one.shown:.6f}" for one in ways}, **stops}}

    def _restored(self, warmth: list[dict]) -> Temperatures:
        values, lags = warmth
        return Temperatures.restored(values, lags, len(self.model.late_growth.time_constants))


class Jobs:
    """Does one job after another; the machine that they are about stays until another is given."""

    def __init__(self) -> None:
        self._made_of: dict[str, Any] = {}
        self._machine: Machine | None = None

    def answer(self, line: str) -> str:
        """Return the answer to a job, each a line of JSON."""
        job = json.loads(line)
        task, asked = job["task"], job["asked"]
        if job["machine"] is not None:
            self._made_of, self._machine = job["machine"], None
        try:
            if task == "load_model":
                answer = load_model(**asked)
            else:
                self._machine = self._machine or Machine(**self._made_of)
                answer = (self._machine.predict if task == "predict" else self._machine.travel)(**asked)
        except (HexapodError, OSError) as error:
            answer = {"problem": str(error)}
        except Exception as error:  # else the process would end, and nobody know why
            answer = {"problem": f"{task}: {type(error).__name__}: {error}"}
        return json_text(answer, indent=None).replace("\n", " ") + "\n"


def main() -> int:
    """Answer until the input ends."""
    os.nice(NICENESS)
    answers = os.fdopen(os.dup(1), "w", encoding="utf-8")
    os.dup2(2, 1)  # what a library prints is no answer
    jobs = Jobs()
    for line in sys.stdin:
        answers.write(jobs.answer(line))
        answers.flush()
    return 0


if __name__ == "__main__":
    sys.exit(main())
