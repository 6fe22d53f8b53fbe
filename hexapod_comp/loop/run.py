"""What ``run`` and ``demo`` do with the loop: start it, send poses, judge the result."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from datetime import date
from typing import TYPE_CHECKING

import numpy as np
from tqdm import tqdm

from ..compensation.checks import check
from ..errors import GeometryError, HexapodError, InputFileError, NoAnswerError
from ..formats.csv import Row, length_values
from ..formats.paths import config_file
from ..formats.texts import CODES, own_terminal
from ..machine.arrays import rms
from ..machine.geometry import HexapodGeometry
from ..machine.model import MachineModel
from ..machine.model_file import save_model
from ..machine.trajectory import Path
from ..pose import Pose
from . import session
from .processes import NodeProcess
from .records import PoseRecord, SessionResult
from .report import ALIGNED, ErrorRow, busy_text

if TYPE_CHECKING:
    from ..ros.client import LoopClient

RATES = (1.0, 1000.0)
"""Commands per second that make sense over DDS from Python, Hz."""


PATIENCE = {"following_error_limit": 0.02, "max_command_age": 5.0}
"""What a simulated machine's compensator lets pass, m and s: drives and clocks are sound, but wait for a processor at
times, and the usual 2 mm are 20 ms of that."""


def checked_rate(rate: float) -> float:
    """Return a command rate, Hz, or refuse it."""
    if not RATES[0] <= rate <= RATES[1]:
        raise GeometryError("--rate-hz", f"must lie in {RATES[0]:g}…{RATES[1]:g} Hz", rate)
    return rate


def refuse_broken_limits(
    path: str, geometry: HexapodGeometry, model: MachineModel, rows: list[Row], poses: list[Pose]
) -> None:
    """Check poses and the way between them before anything moves."""
    breaches = check(geometry, model, poses).breaches
    if breaches:
        row = rows[breaches[0].row]
        problem = f"pose {row.label}: {breaches[0].error}; `hexapod_comp check` lists all {len(breaches)} breaches"
        raise InputFileError(path, f"line {row.line}", problem)


@contextmanager
def simulated(machine: str, model: MachineModel, truth: MachineModel) -> Iterator[Sequence[NodeProcess]]:
    """Start compensator and strut drive as two processes in a ROS domain of their own."""
    geometry_file = str(config_file(machine, "geometry", beside=True).resolve())
    with tempfile.TemporaryDirectory(prefix="hexapod_comp_") as folder:
        model_file, truth_file = (f"{folder}/{name}.yaml" for name in ("model", "truth"))
        save_model(_portable(model), model_file)
        save_model(_portable(truth), truth_file)
        with session.simulated_machine(
            {"geometry_file": geometry_file, "model_file": model_file, **PATIENCE},
            {"geometry_file": geometry_file, "truth_file": truth_file},
        ) as nodes:
            yield nodes


def _portable(model: MachineModel) -> MachineModel:
    """Return a model that can be written elsewhere: with a date, and without what lies beside its own file."""
    origin = replace(model.origin, date=model.origin.date or date.today().isoformat(), posterior=None)
    return replace(model, origin=origin)


def witnessed(
    geometry: HexapodGeometry,
    nodes: Sequence[NodeProcess],
    poses: list[Pose],
    path: Path | None,
    rate: float,
    compare: bool,
    namespace: str = "",
) -> SessionResult:
    """Run poses of the work frame and a path in ``base`` through the loop, with a progress bar.

    The result is in the work frame, as the user's file has it; the nodes are told, and tell, ``base``.
    """
    client = _client(namespace)
    try:
        session.connect(client, nodes)
        watch = session.Watch(nodes)
        with _progress() as bar:
            targets = [geometry.work @ pose for pose in poses]
            try:
                result = session.run_session(client, geometry, targets, path, rate, compare, bar.update, _announce)
            except NoAnswerError as error:
                busy = busy_text(watch.answering(client, rate))
                raise NoAnswerError(f"{error}; {busy}" if busy else str(error)) from error
        result.answering = watch.answering(client, rate, result.answering.latencies)
        return result.seen_from(geometry.work)
    finally:
        client.close()


def _announce(text: str) -> None:
    """Say on stderr what happens now, without tearing the progress bar."""
    tqdm.write(CODES.sub("", text), file=own_terminal())


@contextmanager
def _progress():
    """A bar on a terminal, nothing elsewhere."""
    with tqdm(unit=" commands", disable=None, leave=False, mininterval=0.5) as bar:
        yield bar


def _client(namespace: str) -> LoopClient:
    """Return a client of the nodes, with a clear word where there is no ROS."""
    try:
        from ..ros.client import LoopClient
    except ImportError as error:
        raise HexapodError(
            f"ROS 2 is needed for this ({error}): source a ROS 2 installation, or where there is none run "
            "`pip install '.[ros]'` in the source tree (doc/install.md)"
        ) from error
    return LoopClient(namespace=namespace)


def complaints(result: SessionResult, rows: Sequence[ErrorRow]) -> list[str]:
    """Return what was not as it should be, and whether a busy computer may be the cause; empty when all was well."""
    listed = []
    if result.lost:
        listed.append(f"{result.lost} commands were lost")
    if result.refused:
        listed.append(f"{result.refused} commands were refused: {result.refusals}")
    if not rows:
        listed.append("the true tool pose was not seen")
    judged = [row for row in rows if row.datum == ALIGNED] or rows
    listed += [problem for row in judged if (problem := _too_much(row))]
    busy = busy_text(result.answering)
    return [*listed, busy] if listed and busy else listed


def _too_much(row: ErrorRow) -> str:
    """Return what is wrong with an error that is left, m; empty when nothing is."""
    left, name = rms(row.compensated), f"{row.what}, {row.datum}"
    if row.without is not None and left >= rms(row.without):
        return f"{name}: compensation does not reduce the error"
    if row.promised is None or left <= row.promised[1]:
        return ""
    return f"{name}: {left * 1e6:.3f} µm RMS are left; at most {row.promised[1] * 1e6:.3f} were promised"


def as_json(rows: list[Row], result: SessionResult, errors: Sequence[ErrorRow]) -> dict[str, object]:
    """Return what is told of a session: tool poses in ``work``, and its :func:`~.report.error_rows`."""
    answering = result.answering
    return {
        "frame": "work",
        "model": result.model,
        "sent": result.sent,
        "lost": result.lost,
        "refused": result.refused,
        "latency_median_ms": np.median(answering.latencies) * 1e3 if len(answering.latencies) else None,
        "late_answers": answering.late,
        "longest_latency_ms": answering.longest * 1e3,
        "waited_for_processor_s": answering.waited,
        "errors": [_row_json(row) for row in errors],
        "poses": [_pose_json(row, record) for row, record in zip(rows, result.poses, strict=True)],
        "path": None if result.path is None else {"poses": len(result.path.path), "rate_hz": result.path.path.rate},
    }


def _row_json(row: ErrorRow) -> dict[str, object]:
    def size(errors: np.ndarray | None) -> dict[str, float] | None:
        return None if errors is None else {"rms_um": rms(errors) * 1e6, "max_um": float(errors.max()) * 1e6}

    return {
        "what": row.what,
        "datum": row.datum,
        "without": size(row.without),
        "with": size(row.compensated),
        "promised_rms_um": None if row.promised is None else [v * 1e6 for v in row.promised],
    }


def _pose_json(row: Row, record: PoseRecord) -> dict[str, object]:
    def error(pair: tuple[float, float] | None) -> dict[str, float] | None:
        return None if pair is None else {"position_um": pair[0] * 1e6, "rotation_urad": pair[1] * 1e6}

    without, compensated = record.errors()
    return {
        "pose": row.label,
        "commanded": record.target,
        "struts": length_values(record.command),
        "correction_um": record.correction * 1e6,
        "estimated": record.estimate,
        "true": record.true_with,
        "error_without": error(without),
        "error_with": error(compensated),
    }
