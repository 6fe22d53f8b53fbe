"""What ``run`` and ``demo`` do with the loop: start it, send poses, judge the result."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from tqdm import tqdm

from ..compensation.checks import check
from ..errors import GeometryError, HexapodError, InputFileError
from ..formats.csv import Row, length_values
from ..formats.paths import config_file
from ..formats.texts import CODES, own_terminal
from ..machine.geometry import HexapodGeometry
from ..machine.model_file import load_model
from ..machine.size import rms
from ..machine.trajectory import Path, circle, commanded_in_base, join, move, pocket
from ..pose import Pose
from . import session
from .processes import NodeProcess
from .records import PathRecord, PoseRecord, SessionResult, Track

if TYPE_CHECKING:
    from ..nodes.client import LoopClient

RATES = (1.0, 1000.0)
"""Commands per second that make sense over DDS from Python, Hz."""

DEMO_FEED = 0.02
"""Tool speed of the demo's path, m/s: the simulated drives follow it without reaching their acceleration."""


def checked_rate(rate: float) -> float:
    """Return a command rate, Hz, or refuse it."""
    if not RATES[0] <= rate <= RATES[1]:
        raise GeometryError("--rate-hz", f"must lie in {RATES[0]:g}…{RATES[1]:g} Hz", rate)
    return rate


def demo_path(geometry: HexapodGeometry, rate: float) -> Path:
    """Return the demo's milling path about home: a circle of 24 mm, then a zigzag pocket of 24 × 8 mm, in ``base``."""
    geometry = commanded_in_base(geometry)
    home = geometry.home @ geometry.tool
    ring = circle(home, radius=0.012, feed=DEMO_FEED, rate=rate)
    corner = home @ Pose(np.array([-0.012, -0.004, 0.0]), np.eye(3))
    rows = pocket(geometry, corner, (0.024, 0.008), pitch=0.004, feed=DEMO_FEED, rate=rate)
    to_corner = move(geometry, ring.pose(len(ring) - 1), corner, rate, DEMO_FEED)
    return join([ring, to_corner, rows])


def refuse_broken_limits(path: str, geometry: HexapodGeometry, model: str, rows: list[Row], poses: list[Pose]) -> None:
    """Check poses and the way between them before anything moves.

    Raises
    ------
    InputFileError
        A limit is broken; names the first pose and says how to see them all.
    """
    known = load_model(model, geometry)
    breaches = check(geometry, known, poses).breaches
    if breaches:
        row = rows[breaches[0].row]
        problem = f"pose {row.label}: {breaches[0].error}; `hexapod_comp check` lists all {len(breaches)} breaches"
        raise InputFileError(path, f"line {row.line}", problem)


def simulated(
    geometry: HexapodGeometry, machine: str, model: str, truth: str
) -> AbstractContextManager[Sequence[NodeProcess]]:
    """Start compensator and strut drive as two processes in a ROS domain of their own."""

    def checked(name: str, *words: str) -> str:
        """Return a model as the nodes take it, refused here rather than in a process of its own."""
        if name in words:
            return name
        load_model(config_file(name), geometry)
        return str(config_file(name).resolve())

    geometry_file = str(config_file(machine).resolve())
    model_file, truth_file = checked(model, "ideal"), checked(truth, "ideal", "random")
    from ..nodes.warming import warm

    print("preparing; the first run on a machine compiles its kernels, which takes up to a minute", file=sys.stderr)
    warm()
    return session.simulated_machine(
        {"geometry_file": geometry_file, "model_file": model_file},
        {"geometry_file": geometry_file, "truth_file": truth_file},
    )


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

    The result's poses are in the work frame, as the user's file says them; the nodes are told, and tell, ``base``.
    """
    client = _client(namespace)
    try:
        session.connect(client, nodes)
        with _progress() as bar:
            targets = [geometry.work @ pose for pose in poses]
            result = session.run_session(client, geometry, targets, path, rate, compare, bar.update, _announce)
        result.poses = [record.seen_from(geometry.work) for record in result.poses]
        return result
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
        from ..nodes.client import LoopClient
    except ImportError as error:
        raise HexapodError(
            f"ROS 2 is needed for this ({error}); install hexapod_comp[ros], or source a ROS 2 installation"
        ) from error
    return LoopClient(namespace=namespace)


@dataclass(frozen=True)
class Bars:
    """What a run with the simulated machine's true model may leave, m.

    Parameters
    ----------
    rest : float
        Largest error at a pose where the machine rests: steps and encoder counts of 0.1 µm.
    path : float
        RMS distance to the path.
    passing : float
        Largest distance to the path: a backlash of some µm shows while a strut takes it up.
    """

    rest: float = 1e-6
    path: float = 0.5e-6
    passing: float = 10e-6


def complaints(result: SessionResult, bars: Bars | None) -> list[str]:
    """Return what was not as it should be, empty when all was well.

    Parameters
    ----------
    result : SessionResult
        A compared run.
    bars : Bars or None
        What may be left; None asks only that compensation reduces the RMS error.
    """
    listed = []
    if result.lost:
        listed.append(f"{result.lost} commands were lost")
    if result.refused:
        listed.append(f"{result.refused} commands were refused: {result.refusals}")
    pairs = [record.errors() for record in result.poses]
    before = np.array([pair[0][0] for pair in pairs if pair[0]])
    after = np.array([pair[1][0] for pair in pairs if pair[1]])
    listed += _left("poses", before, after, None if bars is None else (bars.rest, bars.rest))
    if result.path is not None:
        tracks = (result.path.without, result.path.compensated)
        before, after = (np.zeros(0) if track is None else track.deviation for track in tracks)
        listed += _left("path", before, after, None if bars is None else (bars.path, bars.passing))
    return listed


def _left(name: str, before: np.ndarray, after: np.ndarray, bars: tuple[float, float] | None) -> list[str]:
    """Return complaints about errors, m, before and after, given bars of RMS and maximum."""
    if not len(before) or not len(after):
        return [f"{name}: the true tool pose was not seen"]
    if rms(after) >= rms(before):
        return [f"{name}: compensation does not reduce the error"]
    if bars is None or (rms(after) <= bars[0] and after.max() <= bars[1]):
        return []
    left = f"RMS {rms(after) * 1e6:.3f} µm, largest {after.max() * 1e6:.3f} µm"
    return [f"{name}: {left}; allowed {bars[0] * 1e6:g} and {bars[1] * 1e6:g} µm"]


def as_json(rows: list[Row], result: SessionResult) -> dict[str, object]:
    """Return what is told of a session: tool poses in ``work``."""
    return {
        "frame": "work",
        "model": result.model,
        "sent": result.sent,
        "lost": result.lost,
        "refused": result.refused,
        "latency_median_ms": np.median(result.latencies) * 1e3 if len(result.latencies) else None,
        "poses": [_pose_json(row, record) for row, record in zip(rows, result.poses, strict=True)],
        "path": None if result.path is None else _path_json(result.path),
    }


def _path_json(record: PathRecord) -> dict[str, object]:
    def distance(track: Track | None) -> dict[str, float] | None:
        deviation = None if track is None else track.deviation * 1e6
        return None if deviation is None else {"rms_um": rms(deviation), "max_um": float(deviation.max())}

    without, compensated = distance(record.without), distance(record.compensated)
    sent = {"poses": len(record.path), "rate_hz": record.path.rate}
    return {**sent, "distance_without": without, "distance_with": compensated}


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
