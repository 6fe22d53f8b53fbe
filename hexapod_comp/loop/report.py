"""What a witnessed run prints: one block per pose, a table of errors, how the loop answered, and what was wrong."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from ..formats.texts import aligned, number
from ..machine.arrays import rms
from ..pose import Pose
from .records import Answering, PathRecord, PoseRecord, SessionResult, Track

AS_IT_IS, ALIGNED = "as it is", "datum aligned"
"""How a tool error is taken: where the machine stands, or less the one rigid motion that a new zero takes up."""


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
