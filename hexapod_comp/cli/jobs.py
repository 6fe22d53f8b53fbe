"""The worker process of a node, ``python -m hexapod_comp.cli.jobs FD``, for jobs that would block the node."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import numpy as np

from ..compensation.checks import check
from ..compensation.journal import LARGEST_SOURCE, Source
from ..compensation.travel import travel, travel_text
from ..errors import CommandError, HexapodError, InputFileError
from ..formats.paths import confined_file, confined_opener
from ..machine.geometry import BASE
from ..machine.load import Loading
from ..machine.model import MachineModel, RealMachine
from ..machine.path import Motion, StrutRates, plan_motion, plan_program
from ..machine.temperatures import Temperatures
from ..machine.trajectory import join
from ..pose import Pose, stacked

Situation = tuple[str, Temperatures, Loading, dict[str, float]]  # tool, temperatures, load, external quantities


def load_model(name: str, place: str, folder: str | None, machine: str) -> tuple[MachineModel, Source]:
    """Return the model in the file `name`, and its source (without the text if this is too long for the journal). The
    path `name` is relative to `place`; the file must be in `folder`, unless `folder` is None."""
    os.chdir(place)
    inside = None if folder is None else Path(folder)
    source = Source.read(confined_file(name, inside, "model"), confined_opener(inside))
    model = source.model(machine)
    return model, source if len(source.text or "") <= LARGEST_SOURCE else Source(source.name, None, source.sha256)


class Machine:
    """A machine and its model, from the geometry file and model file in use."""

    def __init__(self, geometry: Source, model: Source, folder: str | None) -> None:
        self._opener = confined_opener(None if folder is None else Path(folder))
        self._source = model
        if model.text is None:  # too long for the journal
            self._source = Source.read(model.name, self._opener)
            if self._source.sha256 != model.sha256:
                raise InputFileError(model.name, "", "has changed since it was loaded")
        self.geometry = geometry.geometry()
        self.model = self._source.model(self.geometry.name)
        self._fitted: Any = None
        self._at: Any = None

    def real(self, now: Situation, work: str | None = None) -> RealMachine:
        """Return the machine with tool, temperatures, load and external quantities of `now`, and the frame `work`."""
        tool, warmth, loading, outside = now
        return RealMachine(self.geometry.using(tool, work), self.model.at(outside), warmth, loading)

    def predict(self, platform: Pose, sense: np.ndarray, now: Situation) -> dict[str, Any]:
        """Return the tool errors ``absolute`` and ``aligned`` (after best-fit alignment) that the model predicts: for
        each its values and its covariance, or None if unknown."""
        from ..calibration.posterior import ErrorPredictor  # takes 1 s
        from ..calibration.posterior_file import load_posterior

        if self._fitted is None:
            self._fitted = load_posterior(self.model, self.geometry, self._source.name, self._opener)
        tool, warmth, *others = now
        if self._at != (at := (tool, warmth.snapshot(), *others)):
            self._predictor, self._at = ErrorPredictor(self.real(now), self._fitted[0]), at
        errors = self._predictor.predict((platform.position[None], platform.rotation[None]), sense[None])
        found: dict[str, Any] = dict.fromkeys(("absolute", "aligned"))
        for name, error in zip(found, errors, strict=True):
            if error is not None:
                found[name] = error.values[0], None if error.covariance is None else error.covariance[0]
        return found

    def travel(self, pose: Pose, work: str, enabled: bool, now: Situation) -> tuple[str, dict]:
        """Return how far the tool can move from `pose` in the frame `work`: as a table, and as distances and limits."""
        machine = self.real(now, work)
        ways = travel(machine, pose, machine.geometry.work, enabled)
        stops = {f"{one.way} stops at": str(one.error or "") for one in ways}
        return travel_text(ways), {**{one.key: f"{one.shown:.6f}" for one in ways}, **stops}

    def plan_move(
        self, poses: list[Pose], times: list[float], pivot: np.ndarray, tool: str, rate: float, share: float
    ) -> list[Motion]:
        """Return the motions through poses in ``base``; raise a CommandError (``limit``) if a motion breaks a limit.

        If `times` is empty, the tool stops at each pose. With `times`, s, the tool stops only at the first, second and
        last pose, and reaches each pose after the second at its time or later."""
        geometry = self.geometry.using(tool, BASE)

        def refuse(model: MachineModel, path: Any, mode: str, where: Callable[[int], str]) -> None:
            for first in check(geometry, model, path, mode, rate).breaches[:1]:
                place = ", ".join(f"{1e3 * value:.3f}" for value in path[0][first.row])
                raise CommandError("limit", f"{first.error}, {where(first.row)}, at x, y, z {place} mm in base")

        # first the targets alone, without errors: the path to a target that was typed in mm has a million poses
        nominal, targets = MachineModel(machine=geometry.name), poses[1:]
        refuse(nominal, stacked(targets), "poses", lambda row: f"target {row + 1} of {len(targets)}")
        rates = StrutRates.of(geometry, rate, share)
        if times:
            motions = plan_motion(geometry, poses[:2], rates, pivot)
            motions.append(plan_program(geometry, targets, times, rates))
        else:
            motions = plan_motion(geometry, poses, rates, pivot)
        if motions:
            path = join([motion.sample(rate) for motion in motions])
            ways = path.positions, path.rotations
            move = f"the start of a move with limit_share {share:g}"
            refuse(self.model, ways, "stream", lambda row: f"{row / rate:.2f} s after {move}")
        return motions


class Jobs:
    """Runner of jobs; a job without a machine uses the machine of the previous job."""

    def __init__(self) -> None:
        self._made_of: dict[str, Any] = {}
        self._machine: Machine | None = None

    def do(self, task: str, machine: dict[str, Any] | None, arguments: dict[str, Any]) -> tuple[str, str, Any]:
        """Run a job; return the reason and the text of its error, both empty after a success, and the job's result."""
        if machine is not None:
            self._made_of, self._machine = machine, None
        try:
            if task == "load_model":
                return "", "", load_model(**arguments)
            self._machine = self._machine or Machine(**self._made_of)
            return "", "", getattr(self._machine, task)(**arguments)  # task: predict, travel or plan_move
        except HexapodError as error:
            return error.reason, str(error), None
        except OSError as error:
            return InputFileError.reason, str(error), None
        except Exception as error:  # an uncaught exception would end the process without an answer
            return HexapodError.reason, f"{task}: {type(error).__name__}: {error}", None


def main() -> int:
    """Run jobs from the socket until the node closes the socket."""
    os.dup2(2, 1)  # text that libraries print on stdout goes to stderr, which is the node's log
    jobs = Jobs()
    with Connection(int(sys.argv[1])) as connection:
        while True:
            try:
                connection.send(jobs.do(*connection.recv()))
            except (EOFError, ConnectionError):
                return 0


if __name__ == "__main__":
    sys.exit(main())
