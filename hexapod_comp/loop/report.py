"""What a witnessed run prints: one block per pose, and a summary with a verdict."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from ..machine.size import rms
from ..pose import Pose
from .records import PathRecord, PoseRecord, SessionResult


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


def summary(result: SessionResult) -> str:
    """Return the closing lines: errors with and without, latency, commands."""
    lines = [f"model {result.model}", *_error_lines(result)]
    if len(result.latencies):
        p50, p95, worst = np.percentile(result.latencies, [50, 95, 100]) * 1e3
        lines.append(f"latency, command to answer: median {p50:.2f} ms, 95 % {p95:.2f} ms, longest {worst:.2f} ms")
    refused = "".join(f", {count} {reason}" for reason, count in sorted(result.refusals.items()))
    lines.append(f"commands: {result.sent} sent, {result.lost} lost, {result.refused} refused{refused}")
    return "\n".join(lines)


def _error_lines(result: SessionResult) -> Iterator[str]:
    pairs = [record.errors() for record in result.poses]
    if pairs and pairs[0][1] is not None:
        yield _comparison(
            f"{len(pairs)} poses, position error",
            np.array([before[0] for before, _ in pairs if before is not None]),
            np.array([after[0] for _, after in pairs if after is not None]),
        )
    path = result.path
    if path is not None and path.compensated is not None:
        before = np.zeros(0) if path.without is None else path.without.deviation
        yield _comparison(path_title(path), before, path.compensated.deviation)


def path_title(path: PathRecord) -> str:
    """Return what a path's figures are about."""
    return f"path of {len(path.path)} poses at {path.path.rate:g} Hz, distance of the tool to it"


def _comparison(title: str, before: np.ndarray, after: np.ndarray) -> str:
    text = f"{title}: with compensation RMS {rms(after) * 1e6:.3f} µm, maximum {after.max() * 1e6:.3f} µm"
    if not len(before):
        return text
    removed = 100.0 * (1.0 - rms(after) / rms(before))
    return (
        f"{text}; without RMS {rms(before) * 1e6:.2f} µm, maximum {before.max() * 1e6:.2f} µm: "
        f"{removed:.2f} % of the RMS removed"
    )


def _pose_text(pose: Pose) -> str:
    x, y, z = np.round(pose.position * 1e3, 4) + 0.0  # no minus before a zero
    alpha, beta, gamma = np.round(np.degrees(pose.angles()), 5) + 0.0
    return f"x {x:10.4f}  y {y:10.4f}  z {z:10.4f} mm   α {alpha:9.5f}  β {beta:9.5f}  γ {gamma:9.5f} °"


def _error_text(error: tuple[float, float]) -> str:
    return f"{error[0] * 1e6:8.3f} µm {error[1] * 1e6:8.3f} µrad"


def _row(values: np.ndarray, form: str) -> str:
    return " ".join(format(value, form) for value in values)
