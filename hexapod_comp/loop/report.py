"""The records of an observed run, and its report: poses, a table of errors, the loop's answers."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from ..formats.csv import Row
from ..formats.texts import aligned, number
from ..machine.arrays import rms
from ..machine.pose_files import length_values
from ..pose import Pose, best_motion, rotation_angle

FEWEST_ALIGNED = 6  # a datum removes six numbers, two poses' worth: fewer poses would hardly leave any error

# A computer counts as busy when more of its answers are late, or its processes wait for more of the time
LATE_SHARE, WAITED_SHARE = 0.02, 0.2

# Rigid motions of the commanded poses, and of the tool without and with compensation; None: not known
Motions = tuple[Pose, "Pose | None", "Pose | None"]


@dataclass
class PoseRecord:
    """Record of one commanded pose; m, rotation matrices; all poses in one frame, ``base`` at first."""

    target: Pose  # commanded pose of the tool
    command: np.ndarray = field(default_factory=lambda: np.full(6, np.nan))  # (6,): compensated strut commands, m
    correction: np.ndarray = field(default_factory=lambda: np.full(6, np.nan))  # (6,): their corrections, m
    estimate: Pose | None = None  # estimated pose of the tool with compensation
    true_without: Pose | None = None  # true pose of the tool without compensation, if known
    true_with: Pose | None = None  # and with it

    def moved(self, motions: Motions) -> PoseRecord:
        """Return the same with its poses moved."""
        target, estimate, without, compensated = (
            None if motion is None or pose is None else motion @ pose
            for motion, pose in zip(
                (motions[0], *motions), (self.target, self.estimate, self.true_without, self.true_with), strict=True
            )
        )
        target = target or self.target
        return replace(self, target=target, estimate=estimate, true_without=without, true_with=compensated)

    def errors(self) -> tuple[tuple[float, float] | None, tuple[float, float] | None]:
        """Return (position error m, rotation error rad) without and with compensation; None where it is unknown."""
        without, compensated = (
            None
            if actual is None
            else (
                float(np.linalg.norm(actual.position - self.target.position)),
                rotation_angle(self.target.rotation.T @ actual.rotation),
            )
            for actual in (self.true_without, self.true_with)
        )
        return without, compensated


@dataclass
class Answering:
    """Latency of the loop, and delays of its processes."""

    latencies: np.ndarray = field(default_factory=lambda: np.zeros(0))  # command to answer of the compensated pass, s
    answered: int = 0  # commands of the whole session that were answered
    late: int = 0  # those whose answer arrived after the next command was due
    longest: float = 0.0  # longest time to an answer in the whole session, s
    elapsed: float = 0.0  # length of the session, s
    waited: float = 0.0  # total time for which its processes waited for a processor, s

    @property
    def busy(self) -> bool:
        """Whether other programs kept the processors: a share of the answers was late, or the processes waited long."""
        return self.late > LATE_SHARE * self.answered or self.waited > WAITED_SHARE * self.elapsed


@dataclass
class SessionResult:
    """All records of a session."""

    poses: list[PoseRecord] = field(default_factory=list)  # the single poses
    answering: Answering = field(default_factory=Answering)
    sent: int = 0  # commands of the whole session
    lost: int = 0  # of these neither answered nor refused
    refused: int = 0
    refusals: dict[str, int] = field(default_factory=dict)  # refused commands by reason
    model: str = ""  # model that the compensator ran

    def _moved(self, motions: Motions) -> SessionResult:
        return replace(self, poses=[record.moved(motions) for record in self.poses])

    def seen_from(self, frame: Pose) -> SessionResult:
        """Return the same in another frame, whose own pose is given in the present one."""
        inverse = frame.inverse()
        return self._moved((inverse, inverse, inverse))

    def aligned(self) -> SessionResult | None:
        """Return the same with the datum aligned: each pass by the rigid motion that fits its poses best."""
        # None with fewer than FEWEST_ALIGNED poses, with poses in a line, or when the tool was not measured
        targets = np.array([record.target.position for record in self.poses])

        def datum(actual: list[Pose | None]) -> Pose | None:
            seen = [pose.position for pose in actual if pose is not None]
            return None if len(seen) < max(len(targets), FEWEST_ALIGNED) else best_motion(np.array(seen), targets)

        after = datum([record.true_with for record in self.poses])
        before = datum([record.true_without for record in self.poses])
        return None if after is None else self._moved((Pose.identity(), before, after))


# Definition of a tool error: as the machine stands, or minus the rigid motion that a new zero removes
AS_IT_IS, ALIGNED = "as it is", "datum aligned"


@dataclass(frozen=True)
class ErrorRow:
    """The tool's error at rest, by one definition."""

    datum: str  # :data:`AS_IT_IS` or :data:`ALIGNED`
    count: int  # poses
    without: np.ndarray | None  # errors of the pass without compensation, m: distances to the pose
    compensated: np.ndarray  # errors of the pass with it, m

    def cells(self) -> list[str]:
        """Return the row of a table as text: datum, RMS without and with, largest, removed share, poses."""
        before, left = None if self.without is None else rms(self.without), rms(self.compensated)
        return [
            f"at rest, {self.datum}",
            "–" if before is None else number(before * 1e6, 2),
            number(left * 1e6, 3),
            number(float(self.compensated.max()) * 1e6, 3),
            "–" if before is None else f"{100.0 * (1.0 - left / before):.2f} %",
            f"RMS of {self.count} poses",
        ]

    def record(self) -> dict[str, object]:
        """Return the row for programs."""
        without, compensated = (
            None if errors is None else {"rms_um": rms(errors) * 1e6, "max_um": float(errors.max()) * 1e6}
            for errors in (self.without, self.compensated)
        )
        return {"what": "at rest", "datum": self.datum, "without": without, "with": compensated}


def error_rows(result: SessionResult) -> list[ErrorRow]:
    """Return the tool's errors, first with the datum aligned where that is possible."""
    taken = [(datum, one) for datum, one in ((ALIGNED, result.aligned()), (AS_IT_IS, result)) if one is not None]
    rows = []
    for datum, one in taken:
        pairs = [record.errors() for record in one.poses]
        before, after = (np.array([error[0] for pair in pairs if (error := pair[n]) is not None]) for n in (0, 1))
        if len(after):
            rows.append(ErrorRow(datum, len(pairs), before if len(before) else None, after))
    return rows


def error_table(rows: Sequence[ErrorRow]) -> str:
    """Return the table of errors: RMS without and with compensation, removed share, largest residual; µm."""
    header = ["tool error, µm", "without", "with", "largest", "removed", ""]
    return aligned(header, [row.cells() for row in rows])


def pose_block(title: str, record: PoseRecord) -> str:
    """Return the lines about one pose of the tool in the work frame: mm, degrees, µm, µrad."""

    def pose(pose: Pose) -> str:
        x, y, z = np.round(pose.position * 1e3, 4) + 0.0  # no minus before a zero
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


def summary(result: SessionResult, rows: Sequence[ErrorRow]) -> str:
    """Return the closing lines: model, errors without and with it, latency, commands."""
    lines = [f"model {result.model}", *([error_table(rows)] if rows else [])]
    if len(result.answering.latencies):
        p50, p95, worst = np.percentile(result.answering.latencies, [50, 95, 100]) * 1e3
        lines.append(f"latency, command to answer: median {p50:.2f} ms, 95 % {p95:.2f} ms, longest {worst:.2f} ms")
    refused = "".join(f", {count} {reason}" for reason, count in sorted(result.refusals.items()))
    lines.append(f"commands: {result.sent} sent, {result.lost} lost, {result.refused} refused{refused}")
    return "\n".join(lines)


def busy_text(answering: Answering) -> str:
    """Return whether and why the computer was busy, as text; empty if it was not."""
    if not answering.busy:
        return ""
    return (
        f"the computer was busy: {answering.late} of {answering.answered} answers came after the next command was due, "
        f"the longest after {answering.longest * 1e3:.0f} ms, and its processes waited {answering.waited:.1f} s in "
        f"{answering.elapsed:.0f} s for a processor; try again with less going on"
    )


def as_json(rows: list[Row], result: SessionResult, errors: Sequence[ErrorRow]) -> dict[str, object]:
    """Return a session for programs: tool poses in ``work``, and its :func:`~.report.error_rows`."""
    answering, poses = result.answering, list[dict[str, object]]()
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
        "latency_median_ms": np.median(answering.latencies) * 1e3 if len(answering.latencies) else None,
        "late_answers": answering.late,
        "longest_latency_ms": answering.longest * 1e3,
        "waited_for_processor_s": answering.waited,
        "errors": [row.record() for row in errors],
        "poses": poses,
    }
