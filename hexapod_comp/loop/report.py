"""The records of a session and their report: poses, tool errors, latency and refused commands."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from ..formats.csv import Row
from ..formats.texts import aligned, number
from ..machine.arrays import rms
from ..machine.pose_files import length_values
from ..pose import Pose, best_motion, rotation_angle

# Fewest poses for a best-fit alignment: its shift and rotation, six numbers, would hide the errors of fewer poses
FEWEST_ALIGNED = 6
LATE_SHARE = 0.02  # Share of late answers above which the computer counts as busy

# Two definitions of the tool error: names in JSON, and titles in texts and pictures
ABSOLUTE, ALIGNED = "as it is", "datum aligned"
DEFINITIONS = {ABSOLUTE: "absolute", ALIGNED: "after best-fit alignment"}


@dataclass
class PoseRecord:
    """A commanded tool pose, the compensator's answer to it, and the estimated and true poses; all are in ``work``."""

    target: Pose  # commanded pose
    command: np.ndarray = field(default_factory=lambda: np.full(6, np.nan))  # (6,): compensated strut commands, m
    correction: np.ndarray = field(default_factory=lambda: np.full(6, np.nan))  # (6,): compensated − nominal, m
    estimate: Pose | None = None  # estimated pose with compensation
    true_without: Pose | None = None  # true pose without compensation, if known
    true_with: Pose | None = None  # true pose with compensation, if known

    def errors(self) -> tuple[tuple[float, float] | None, tuple[float, float] | None]:
        """Return the pair of position error in m and rotation error in rad without compensation, and the pair with
        compensation; a pair is None if the pose was not measured.
        """

        def error(actual: Pose | None) -> tuple[float, float] | None:
            if actual is None:
                return None
            distance = float(np.linalg.norm(actual.position - self.target.position))
            return distance, rotation_angle(self.target.rotation.T @ actual.rotation)

        return error(self.true_without), error(self.true_with)


@dataclass
class SessionResult:
    """The result of a session."""

    poses: list[PoseRecord] = field(default_factory=list)
    latencies: np.ndarray = field(default_factory=lambda: np.zeros(0))  # from command to answer with compensation, s
    late: int = 0  # number of answers, without and with compensation, that came after the next command was due
    longest: float = 0.0  # longest latency without or with compensation, s
    busy: str = ""  # result of :func:`busy_text`
    sent: int = 0  # number of commands
    lost: int = 0  # number of commands that were neither answered nor refused
    refused: int = 0  # number of refused commands
    refusals: dict[str, int] = field(default_factory=dict)  # number of refused commands by reason
    model: str = ""  # name of the compensator's model

    def distances(self, aligned: bool = False) -> np.ndarray:
        """Return distances, m, of the tool from its n commanded positions: (2, n), rows without and with compensation.

        An unmeasured pose gives NaN. With `aligned`, each row is aligned by its own best fit, and all NaN if a pose is
        unmeasured, if there are fewer than :data:`FEWEST_ALIGNED` poses, or if all poses lie on a line.
        """
        targets, sides = np.array([record.target.position for record in self.poses]), []
        for name in ("true_without", "true_with"):
            poses = [getattr(record, name) for record in self.poses]
            actual = np.array([np.full(3, np.nan) if pose is None else pose.position for pose in poses])
            if aligned:
                enough = len(targets) >= FEWEST_ALIGNED and np.isfinite(actual).all()
                datum = best_motion(actual, targets) if enough else None
                actual = np.full_like(targets, np.nan) if datum is None else datum.transform(actual)
            sides.append(np.linalg.norm(actual - targets, axis=1))
        return np.array(sides)

    def errors(self) -> dict[str, np.ndarray]:
        """Return aligned and absolute :meth:`distances`; omit either if all its values with compensation are NaN."""
        both = {ALIGNED: self.distances(aligned=True), ABSOLUTE: self.distances()}
        return {datum: distances for datum, distances in both.items() if np.isfinite(distances[1]).any()}


def _size(distances: np.ndarray) -> dict[str, float] | None:
    """Return the RMS and the maximum, in µm, of the distances that are not NaN; None if all are NaN."""
    known = distances[np.isfinite(distances)] * 1e6
    return {"rms_um": rms(known), "max_um": float(known.max())} if len(known) else None


def error_table(errors: Mapping[str, np.ndarray]) -> str:
    rows = []
    for datum, distances in errors.items():
        before, left = map(_size, distances)
        if left is not None:
            rms_before, removed = "–", "–"
            if before is not None:
                removed = f"{100.0 * (1.0 - left['rms_um'] / before['rms_um']):.2f} %"
                rms_before = number(before["rms_um"], 2)
            sizes = number(left["rms_um"], 3), number(left["max_um"], 3)
            title, count = f"at rest, {DEFINITIONS[datum]}", f"RMS of {distances.shape[1]} poses"
            rows.append([title, rms_before, *sizes, removed, count])
    return aligned(["tool error, µm", "without", "with", "largest", "removed", ""], rows)


def pose_block(title: str, record: PoseRecord) -> str:

    def pose(pose: Pose) -> str:
        x, y, z = np.round(pose.position * 1e3, 4) + 0.0  # adding 0.0 turns −0.0 into 0.0
        alpha, beta, gamma = np.round(np.degrees(pose.angles()), 5) + 0.0
        return f"x {x:10.4f}  y {y:10.4f}  z {z:10.4f} mm   α {alpha:9.5f}  β {beta:9.5f}  γ {gamma:9.5f} °"

    lines = [
        f"{title}: tool in work",
        f"  commanded   {pose(record.target)}",
        f"  struts      {' '.join(f'{v:11.4f}' for v in record.command * 1e3)} mm",
        f"  correction  {' '.join(f'{v:+11.2f}' for v in record.correction * 1e6)} µm",
    ]
    if record.estimate is not None:
        lines.append(f"  estimated   {pose(record.estimate)}")
    if record.true_with is not None:
        lines.append(f"  true        {pose(record.true_with)}")
        sides = zip(("without", "with"), record.errors(), strict=True)
        errors = (f"{name} {e[0] * 1e6:8.3f} µm {e[1] * 1e6:8.3f} µrad" for name, e in sides if e is not None)
        lines.append(f"  error       {'   '.join(errors)}")
    return "\n".join(lines)


def summary(result: SessionResult, errors: Mapping[str, np.ndarray]) -> str:
    lines = [f"model {result.model}", *([error_table(errors)] if errors else [])]
    if len(result.latencies):
        p50, p95, worst = np.percentile(result.latencies, [50, 95, 100]) * 1e3
        lines.append(f"latency, command to answer: median {p50:.2f} ms, 95 % {p95:.2f} ms, longest {worst:.2f} ms")
    refused = "".join(f", {count} {reason}" for reason, count in sorted(result.refusals.items()))
    lines.append(f"commands: {result.sent} sent, {result.lost} lost, {result.refused} refused{refused}")
    return "\n".join(lines)


def busy_text(latencies: np.ndarray, rate: float) -> str:
    """Return a warning if more than LATE_SHARE of the latencies, s, exceed 1/`rate`, the time between commands."""
    late = int((latencies > 1.0 / rate).sum())
    if late <= LATE_SHARE * len(latencies):
        return ""
    return (
        f"the computer was busy: {late} of {len(latencies)} answers came after the next command was due, the slowest "
        f"after {latencies.max() * 1e3:.0f} ms; close other programs and try again"
    )


def as_json(rows: list[Row], result: SessionResult, errors: Mapping[str, np.ndarray]) -> dict[str, object]:
    poses = list[dict[str, object]]()
    for row, record in zip(rows, result.poses, strict=True):
        without, compensated = (
            None if error is None else {"position_um": error[0] * 1e6, "rotation_urad": error[1] * 1e6}
            for error in record.errors()
        )
        poses.append({
            "pose": row.label,
            "commanded": record.target,
            "struts": length_values(record.command),
            "correction_um": record.correction * 1e6,
            "estimated": record.estimate,
            "true": record.true_with,
            "error_without": without,
            "error_with": compensated,
        })  # fmt: skip
    return {
        "frame": "work",
        "model": result.model,
        "sent": result.sent,
        "lost": result.lost,
        "refused": result.refused,
        "latency_median_ms": np.median(result.latencies) * 1e3 if len(result.latencies) else None,
        "late_answers": result.late,
        "longest_latency_ms": result.longest * 1e3,
        "errors": [
            {"what": "at rest", "datum": datum, "without": _size(without), "with": _size(compensated)}
            for datum, (without, compensated) in errors.items()
        ],
        "poses": poses,
    }
