"""What a witnessed run prints: one block per pose, a table of errors, how the loop answered, and what was wrong."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import numpy as np

from ..formats.csv import Row, length_values
from ..formats.texts import aligned, number
from ..machine.arrays import rms
from ..machine.trajectory import Path, feet_on
from ..pose import Pose, best_motion, rotation_angle

if TYPE_CHECKING:
    pass


FEWEST_ALIGNED = 6  # a datum takes six numbers away, two poses' worth: from fewer poses hardly anything would be left

# A computer is called busy when more of its answers are late, or when its processes wait for more of the time
LATE_SHARE, WAITED_SHARE = 0.02, 0.2


@dataclass
class PoseRecord:
    """What happened at one commanded pose; m, rotation matrices; all poses in one frame, ``base`` at first."""

    target: Pose  # commanded pose of the tool
    # (6,): compensated strut commands and their correction, m
    command: np.ndarray = field(default_factory=lambda: np.full(6, np.nan))
    # (6,): compensated strut commands and their correction, m
    correction: np.ndarray = field(default_factory=lambda: np.full(6, np.nan))
    estimate: Pose | None = None  # estimated pose of the tool with compensation
    true_without: Pose | None = None  # where the tool really was, when anybody can tell
    true_with: Pose | None = None  # where the tool really was, when anybody can tell

    def seen_from(self, frame: Pose) -> PoseRecord:
        """Return the same with its poses in another frame, whose own pose is given in the present one."""
        inverse = frame.inverse()
        estimate, without, compensated = (
            None if pose is None else inverse @ pose for pose in (self.estimate, self.true_without, self.true_with)
        )
        target = inverse @ self.target
        return replace(self, target=target, estimate=estimate, true_without=without, true_with=compensated)

    def errors(self) -> tuple[tuple[float, float] | None, tuple[float, float] | None]:
        """Return (position error m, rotation error rad) without and with compensation."""
        return pose_error(self.target, self.true_without), pose_error(self.target, self.true_with)


@dataclass
class Track:
    """Where the tool really went along a path."""

    positions: np.ndarray  # (n, 3): true tool positions on the way, m
    sent: np.ndarray  # (n,) int: how many poses of the path had been sent when each was seen
    feet: np.ndarray  # (n, 3): the nearest point of the commanded path to each, m: a late tool is no contour error

    @staticmethod
    def along(path: Path, positions: np.ndarray, sent: np.ndarray) -> Track | None:
        """Return the track of true positions, shape (n, 3), m, along a path; None when there are none."""
        return Track(positions, sent, feet_on(path.positions, positions, sent)) if len(positions) else None

    @property
    def deviation(self) -> np.ndarray:
        """Distances to the path, shape (n,), m."""
        return np.linalg.norm(self.positions - self.feet, axis=1)


@dataclass
class PathRecord:
    """What happened along a path."""

    path: Path  # commanded poses, in ``base`` at first
    without: Track | None  # the two passes; None where there was none, or nobody to tell where the tool was
    compensated: Track | None  # the two passes; None where there was none, or nobody to tell where the tool was
    corrections: np.ndarray  # (N, 6): corrections sent, m

    def seen_from(self, frame: Pose) -> PathRecord:
        """Return the same in another frame, whose own pose is given in the present one."""
        inverse = frame.inverse()
        path = Path(_moved(inverse, self.path.positions), inverse.rotation @ self.path.rotations, self.path.rate)
        return self._with(path, (inverse, inverse))

    def aligned(self, datums: tuple[Pose | None, Pose | None]) -> PathRecord:
        """Return the same with each pass's true positions moved by its datum; a pass without a datum is left out."""
        return self._with(self.path, datums)

    def _with(self, path: Path, motions: tuple[Pose | None, Pose | None]) -> PathRecord:
        without, compensated = (
            None if track is None or motion is None else Track.along(path, _moved(motion, track.positions), track.sent)
            for track, motion in zip((self.without, self.compensated), motions, strict=True)
        )
        return replace(self, path=path, without=without, compensated=compensated)


@dataclass
class Answering:
    """How fast the loop answered, and what kept it waiting."""

    latencies: np.ndarray = field(default_factory=lambda: np.zeros(0))  # command to answer of the compensated pass, s
    # commands of the whole session that were answered, and those of which the answer came after the next was due
    answered: int = 0
    # commands of the whole session that were answered, and those of which the answer came after the next was due
    late: int = 0
    longest: float = 0.0  # longest time to an answer in the whole session, s
    elapsed: float = 0.0  # length of the session, s
    waited: float = 0.0  # how long its processes waited for a processor, added up, s

    @property
    def busy(self) -> bool:
        """Whether something else kept the processors: a share of the answers was late, or the processes waited long."""
        return self.late > LATE_SHARE * self.answered or self.waited > WAITED_SHARE * self.elapsed


@dataclass
class SessionResult:
    """Everything that a session has seen."""

    poses: list[PoseRecord] = field(default_factory=list)  # the single poses
    path: PathRecord | None = None  # the path
    answering: Answering = field(default_factory=Answering)  # how fast the loop answered
    sent: int = 0  # commands of the whole session
    lost: int = 0  # commands of the whole session
    refused: int = 0  # commands of the whole session
    refusals: dict[str, int] = field(default_factory=dict)  # refused commands by reason
    model: str = ""  # model that the compensator ran

    def seen_from(self, frame: Pose) -> SessionResult:
        """Return the same in another frame, whose own pose is given in the present one."""
        path = None if self.path is None else self.path.seen_from(frame)
        return replace(self, poses=[record.seen_from(frame) for record in self.poses], path=path)

    def aligned(self) -> SessionResult | None:
        """Return the same once the datum is aligned: each pass by the rigid motion that fits its poses best."""
        # A path is moved by its pass's poses, as a workpiece whose zero was set by them. None with fewer than
        # FEWEST_ALIGNED poses, with poses in a line, or when nobody told where the tool was.
        before = _datum(self.poses, [record.true_without for record in self.poses])
        after = _datum(self.poses, [record.true_with for record in self.poses])
        if after is None:
            return None
        poses = []
        for record in self.poses:
            moved = _after(before, record.true_without), _after(after, record.true_with)
            poses.append(replace(record, true_without=moved[0], true_with=moved[1]))
        path = None if self.path is None else self.path.aligned((before, after))
        return replace(self, poses=poses, path=path)


def _datum(records: Sequence[PoseRecord], actual: Sequence[Pose | None]) -> Pose | None:
    """Return the rigid motion that brings true tool positions onto commanded ones; None where there is no telling."""
    seen = [pose.position for pose in actual if pose is not None]
    if len(seen) < len(records) or len(seen) < FEWEST_ALIGNED:
        return None
    return best_motion(np.array(seen), np.array([record.target.position for record in records]))


def _after(motion: Pose | None, pose: Pose | None) -> Pose | None:
    return None if motion is None or pose is None else motion @ pose


def _moved(motion: Pose, points: np.ndarray) -> np.ndarray:
    return motion.position + points @ motion.rotation.T


def pose_error(target: Pose, actual: Pose | None) -> tuple[float, float] | None:
    """Return distance (m) and angle (rad) between two poses, None when one is unknown."""
    if actual is None:
        return None
    distance = float(np.linalg.norm(actual.position - target.position))
    return distance, rotation_angle(target.rotation.T @ actual.rotation)


# How a tool error is taken: where the machine stands, or less the one rigid motion that a new zero takes up
AS_IT_IS, ALIGNED = "as it is", "datum aligned"


@dataclass(frozen=True)
class ErrorRow:
    """The tool's error at rest or along a path, in one way of taking it."""

    what: str  # ``at rest`` or ``path``; :data:`AS_IT_IS` or :data:`ALIGNED`
    datum: str  # ``at rest`` or ``path``; :data:`AS_IT_IS` or :data:`ALIGNED`
    count: int  # poses
    # errors of the two passes, m: distances to the pose at rest, to the nearest place of the path along it
    without: np.ndarray | None
    # errors of the two passes, m: distances to the pose at rest, to the nearest place of the path along it
    compensated: np.ndarray
    promised: tuple[float, float] | None = None  # between these the RMS is expected, m, with 95 %

    @property
    def removed(self) -> float | None:
        """Share of the RMS error that compensation removes."""
        return None if self.without is None else 1.0 - rms(self.compensated) / rms(self.without)


def pose_block(title: str, record: PoseRecord) -> str:
    """Return the lines about one pose of the tool in the work frame: mm, degrees, µm, µrad."""
    lines = [
        f"{title}: tool in work",
        f"  commanded   {_pose_text(record.target)}",
        f"  struts      {_row(record.command * 1e3, '11.4f')} mm",
        f"  correction  {_row(record.correction * 1e6, '+11.2f')} µm",
    ]
    if record.estimate is not None:
        lines.append(f"  estimated   {_pose_text(record.estimate)}")
    if record.true_with is not None:
        lines.append(f"  true        {_pose_text(record.true_with)}")
    without, compensated = record.errors()
    if compensated is not None:
        before = "" if without is None else f"without {_error_text(without)}   "
        lines.append(f"  error       {before}with {_error_text(compensated)}")
    return "\n".join(lines)


def error_rows(result: SessionResult) -> list[ErrorRow]:
    """Return the tool's errors at rest and along the path, first with the datum aligned where that can be."""
    taken = ((ALIGNED, result.aligned()), (AS_IT_IS, result))
    rows = [_rest_row(datum, one.poses) for datum, one in taken if one is not None]
    rows += [_path_row(datum, one.path) for datum, one in taken if one is not None and one.path is not None]
    return [row for row in rows if row is not None]


def _rest_row(datum: str, records: Sequence[PoseRecord]) -> ErrorRow | None:
    pairs = [record.errors() for record in records]
    before, after = ([error[0] for pair in pairs if (error := pair[side]) is not None] for side in (0, 1))
    if not after:
        return None
    return ErrorRow("at rest", datum, len(records), np.array(before) if before else None, np.array(after))


def _path_row(datum: str, path: PathRecord) -> ErrorRow | None:
    def deviation(track: Track | None) -> np.ndarray | None:
        return None if track is None else track.deviation

    after = deviation(path.compensated)
    return None if after is None else ErrorRow("path", datum, len(path.path), deviation(path.without), after)


def error_table(rows: Sequence[ErrorRow]) -> str:
    """Return the table of errors: RMS without and with compensation, what that removes, the largest left; µm."""
    promises = any(row.promised for row in rows)
    header = ["tool error, µm", "without", "with", "largest", "removed", *(["promised"] if promises else [])]
    return aligned([*header, ""], [[*_cells(row, promises), _about(row)] for row in rows])


def _cells(row: ErrorRow, promises: bool) -> Iterator[str]:
    yield f"{row.what}, {row.datum}"
    yield "–" if row.without is None else number(rms(row.without) * 1e6, 2)
    yield number(rms(row.compensated) * 1e6, 3)
    yield number(float(row.compensated.max()) * 1e6, 3)
    yield "–" if row.removed is None else f"{100.0 * row.removed:.2f} %"
    if promises:
        yield "–" if row.promised is None else "…".join(number(v * 1e6, 3) for v in row.promised)


def _about(row: ErrorRow) -> str:
    return f"RMS of {row.count} poses" if row.what == "at rest" else f"RMS distance to a path of {row.count} poses"


def summary(result: SessionResult, rows: Sequence[ErrorRow]) -> str:
    """Return the closing lines: model, errors without and with it, latency, commands."""
    table = [error_table(rows)] if rows else []
    return "\n".join([f"model {result.model}", *table, *_commands(result)])


def _commands(result: SessionResult) -> Iterator[str]:
    """Yield how fast the loop answered and what became of the commands."""
    answering = result.answering
    if len(answering.latencies):
        p50, p95, worst = np.percentile(answering.latencies, [50, 95, 100]) * 1e3
        yield f"latency, command to answer: median {p50:.2f} ms, 95 % {p95:.2f} ms, longest {worst:.2f} ms"
    refused = "".join(f", {count} {reason}" for reason, count in sorted(result.refusals.items()))
    yield f"commands: {result.sent} sent, {result.lost} lost, {result.refused} refused{refused}"


def busy_text(answering: Answering) -> str:
    """Return that the computer was busy and by what one sees it; empty when it was not."""
    if not answering.busy:
        return ""
    return (
        f"the computer was busy: {answering.late} of {answering.answered} answers came after the next command was due, "
        f"the longest after {answering.longest * 1e3:.0f} ms, and its processes waited {answering.waited:.1f} s in "
        f"{answering.elapsed:.0f} s for a processor; try again with less going on"
    )


def _pose_text(pose: Pose) -> str:
    x, y, z = np.round(pose.position * 1e3, 4) + 0.0  # no minus before a zero
    alpha, beta, gamma = np.round(np.degrees(pose.angles()), 5) + 0.0
    return f"x {x:10.4f}  y {y:10.4f}  z {z:10.4f} mm   α {alpha:9.5f}  β {beta:9.5f}  γ {gamma:9.5f} °"


def _error_text(error: tuple[float, float]) -> str:
    return f"{error[0] * 1e6:8.3f} µm {error[1] * 1e6:8.3f} µrad"


def _row(values: np.ndarray, form: str) -> str:
    return " ".join(format(value, form) for value in values)


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
