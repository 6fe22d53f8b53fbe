"""What a replay prints: is it the same, where does it part, what was refused, and the figures of the run."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from datetime import datetime, timezone
from typing import Any

import numpy as np

from .errors import printable
from .journal import made_with
from .pose import Pose
from .recording import Recording, Series
from .replaying import BEFORE, DIFFERENT, IDENTICAL, LOST, UNCERTAIN, Replay, Timeline
from .texts import aligned

OUTCOMES = {
    IDENTICAL: "identical",
    DIFFERENT: "different",
    UNCERTAIN: "uncertain",
    LOST: "not replayed",
    BEFORE: "before the journal",
}
"""Names of outcomes in CSV and JSON."""

ROUNDING = 1e-12
"""Differences below this, m, are those of another processor's or library's rounding, not of another model."""

LONGEST_GAP = 0.1
"""Between commands further apart, s, nobody can tell what the struts should have done."""


@dataclass
class Report:
    """Everything that one replay has to tell.

    Attributes
    ----------
    recording : Recording
        What was read.
    timeline : Timeline
        The same in order.
    replayed : Replay or None
        With what was in use; None when geometry or model were not at hand.
    other : Replay or None
        With another model or geometry.
    other_name : str
        What that was.
    tolerance : float
        Differences up to this, m, are accepted.
    """

    recording: Recording
    timeline: Timeline
    replayed: Replay | None
    other: Replay | None = None
    other_name: str = ""
    tolerance: float = 0.0

    @property
    def seconds(self) -> np.ndarray:
        """Time of each answer since the first, s, by their stamps."""
        return since(self.timeline.answers.stamps, self.timeline.answers.stamps)

    @property
    def same(self) -> bool:
        """Whether the replay gives what was recorded, within the tolerance."""
        replayed = self.replayed
        if replayed is None or (replayed.identical and not replayed.states_differ):
            return True
        rows = replayed.outcome == DIFFERENT
        worst = np.abs(replayed.difference[rows]).max(initial=0.0)
        return bool(self.tolerance > 0.0 and worst <= self.tolerance and not np.isnan(worst))


def since(stamps: np.ndarray, origin: np.ndarray) -> np.ndarray:
    """Return stamps, ns, as seconds since the first of `origin`."""
    return (stamps - origin[0]) * 1e-9


def text(report: Report) -> str:
    """Return the report."""
    lines = [*_heading(report), *_verdict(report), *_difference(report), *_other(report)]
    return "\n".join([*lines, *_figures(report), *_refused(report), *(f"note: {n}" for n in report.recording.notes)])


def _heading(report: Report) -> Iterator[str]:
    recording, answers = report.recording, report.timeline.answers
    page = recording.pages[0][1]
    machine, model = printable(page.geometry["name"]), printable(page.model["name"])
    yield f"{recording.path}: {printable(recording.node)}, machine {machine}, model {model}"
    began = datetime.fromtimestamp(answers.stamps[0] * 1e-9, timezone.utc)
    duration = (answers.stamps[-1] - answers.stamps[0]) * 1e-9
    asked = len(recording.topics["tool_pose_command"])
    answered = int((answers.asked >= 0).sum())
    yield (
        f"from {began:%Y-%m-%d %H:%M:%S} UTC, {duration:.1f} s: {asked} commands, {answered} answered, "
        f"{len(report.timeline.unanswered)} not; {len(answers) - answered} answers without command"
    )


def _verdict(report: Report) -> Iterator[str]:
    replayed = report.replayed
    if replayed is None:
        yield "not replayed as it was: geometry and model that were in use are not at hand"
        return
    found = Counter(replayed.outcome.tolist())
    compared = found[IDENTICAL] + found[DIFFERENT]
    word = "identical bit for bit" if not found[DIFFERENT] else f"{found[IDENTICAL]} identical bit for bit"
    yield f"replayed {compared} of {len(replayed.answers)} answers: {word}" + (
        f", {found[DIFFERENT]} different" if found[DIFFERENT] else ""
    )
    if report.timeline.lost:
        yield f"the recorder has lost answers that the journal counts: {report.timeline.lost}"
    if found[UNCERTAIN] or found[LOST]:
        count = found[UNCERTAIN] + found[LOST]
        yield f"left out: {count} answers after lost messages, up to the next page of the journal"
    if found[BEFORE]:
        yield f"left out: {found[BEFORE]} answers before the journal's first page"
    changes = Counter(entry.what for _, entry in replayed.events)
    told = ", ".join(f"{count} × {what}" for what, count in sorted(changes.items())) or "none"
    yield f"changes between commands: {told}; {len(report.recording.pages)} pages of the journal"


def _difference(report: Report) -> Iterator[str]:
    replayed = report.replayed
    if replayed is None or not (replayed.outcome == DIFFERENT).any():
        if replayed is not None and replayed.states_differ:
            place = _place(report, replayed.states_differ[0])
            yield f"answers agree, but the compensator's state is another first before {place}"
        return
    rows = np.flatnonzero(replayed.outcome == DIFFERENT)
    row = int(rows[0])
    yield f"first difference: {_place(report, row)}: {_first(replayed, row)}"
    difference = np.abs(replayed.difference[rows])
    worst = np.nanmax(difference, initial=0.0)
    yield f"largest difference {worst * 1e6:.9g} µm" + (
        f", accepted up to {report.tolerance * 1e6:g} µm" if report.same else ""
    )
    if row >= replayed.unconfirmed:
        yield "it lies after the journal's last page: that the recorder lost a command just before cannot be excluded"
    yield from _versions(report, worst)


def _first(replayed: Replay, row: int) -> str:
    """Say how the first different answer differs."""
    if row in replayed.refused_now:
        return f"the replay refuses the command ({replayed.refused_now[row]})"
    for name, recorded, now in (
        ("correction", replayed.answers.corrections[row], replayed.corrections[row]),
        ("command", replayed.answers.commands[row], replayed.commands[row]),
    ):
        struts = [n for n in range(6) if not np.isnan(recorded[n]) and recorded[n].tobytes() != now[n].tobytes()]
        if struts:
            n = struts[0]
            return f"strut_{n + 1}, {name} recorded {recorded[n] * 1e6!r} µm, replayed {now[n] * 1e6!r} µm"
    return "the recorded numbers are not finite"


def _place(report: Report, row: int) -> str:
    if row >= len(report.timeline.answers):
        return "the end"
    stamp = int(report.timeline.answers.stamps[row])
    return f"answer {row + 1} (stamp {stamp // 10**9}.{stamp % 10**9:09d}, {report.seconds[row]:.3f} s)"


def _versions(report: Report, worst: float) -> Iterator[str]:
    """Say what this machine does not have in common with the one that was recorded."""
    recorded, here = report.recording.pages[0][1].made_with, made_with()
    differing = [
        f"{key} {printable(recorded[key])}, here {here[key]}"
        for key in here
        if key in recorded and recorded[key] != here[key]
    ]
    if differing:
        size = "it is of the size of rounding; " if worst < ROUNDING else ""
        yield f"{size}recorded with {'; '.join(differing)}"


def _other(report: Report) -> Iterator[str]:
    other = report.other
    if other is None:
        return
    difference = np.abs(other.difference)
    seen = int(np.isfinite(difference).all(axis=1).sum())
    yield f"with {report.other_name}: {seen} answers; corrections differ from the recorded ones by"
    if seen:
        # The recorded ones may ramp at their ends; what follows is what a machinist would see on the struts.
        rows = [
            [f"strut_{n + 1}", f"{_rms(column):.3f}", f"{np.nanmax(column) * 1e6:.3f}"]
            for n, column in enumerate(difference.T)
        ]
        yield aligned(["", "RMS_um", "max_um"], rows)
    if other.refused_now:
        row, why = next(iter(other.refused_now.items()))
        yield f"  it refuses {len(other.refused_now)} commands, first {_place(report, row)}: {why}"


def _rms(values: np.ndarray) -> float:
    """Return the root mean square of lengths, m, in µm."""
    return float(np.sqrt(np.nanmean(np.square(values)))) * 1e6


def _figures(report: Report) -> Iterator[str]:
    corrections = report.timeline.answers.corrections
    if np.isfinite(corrections).any():
        largest = int(np.nanargmax(np.abs(corrections)))
        row, strut = divmod(largest, 6)
        value = corrections[row, strut] * 1e6
        yield f"largest correction {value:.3f} µm, strut_{strut + 1}, {_place(report, row)}"
    _, error = following_error(report.recording, report.timeline)
    if len(error):
        shown = " ".join(f"{_rms(column):.2f}/{np.abs(column).max() * 1e6:.2f}" for column in error.T)
        yield f"following error (measured − commanded, drives' lag included), RMS/largest µm per strut: {shown}"


def _refused(report: Report) -> Iterator[str]:
    refused = report.replayed.refused if report.replayed is not None else []
    if not refused:
        return
    asked = report.recording.topics["tool_pose_command"]
    yield f"commands without answer: {len(refused)}"
    rows = []
    for reason, count in Counter(entry.reason for entry in refused).most_common():
        first = next(entry for entry in refused if entry.reason == reason)
        when = (asked.times[first.number] - asked.times[0]) * 1e-9
        source = "" if first.from_journal else "by the replay: "
        said = printable(first.text)
        rows.append([printable(reason), str(count), f"{when:.3f}", source + said])
    yield aligned(["reason", "count", "first_s", ""], rows)


def following_error(recording: Recording, timeline: Timeline) -> tuple[np.ndarray, np.ndarray]:
    """Return by how much the measured struts were off their commands.

    Returns
    -------
    seconds : ndarray, shape (m,)
        Since the first answer.
    error : ndarray, shape (m, 6)
        Measured minus commanded, m, the commands taken straight from one to the next.
    """
    states, answers = recording.topics["strut_states"], timeline.answers
    known = np.isfinite(answers.commands).all(axis=1)
    if known.sum() < 2 or not len(states):
        return np.zeros(0), np.zeros((0, 6))
    when, at = (answers.stamps, states.stamps) if states.stamps.all() else (answers.times, states.times)
    when, commands = since(when[known], when[known]), answers.commands[known]
    at = since(at, (answers.stamps if states.stamps.all() else answers.times)[known])
    after = np.clip(np.searchsorted(when, at), 1, len(when) - 1)
    inside = (at >= when[0]) & (at <= when[-1]) & (when[after] - when[after - 1] <= LONGEST_GAP)
    wanted = np.stack([np.interp(at[inside], when, column) for column in commands.T], axis=1)
    return at[inside], states.values[inside] - wanted


def tool_tracks(recording: Recording, timeline: Timeline, work: Pose) -> tuple[np.ndarray, np.ndarray, Series]:
    """Return where the tool was commanded in ``base``, and the estimates.

    Parameters
    ----------
    recording, timeline : Recording, Timeline
        What was read.
    work : Pose
        The work frame seen from ``base``.

    Returns
    -------
    rows : ndarray of int
        Answers whose commands are known.
    positions : ndarray, shape (len(rows), 3)
        m.
    estimates : Series
        As recorded, in ``base``.
    """
    asked, answers = recording.topics["tool_pose_command"], timeline.answers
    rows = np.flatnonzero(answers.asked >= 0)
    numbers = answers.asked[rows]
    positions = asked.values[numbers, :3].copy()
    frames = recording.pages[0][1].frames
    in_work = np.array([asked.frames[n] == frames["work"] for n in numbers], dtype=bool)
    positions[in_work] = work.position + positions[in_work] @ work.rotation.T
    return rows, positions, recording.topics["tool_pose_estimate"]


def rows_of(report: Report) -> list[dict[str, Any]]:
    """Return one CSV row per answer: stamps, commands (mm), corrections (µm) recorded, replayed and with the other."""
    answers, replayed, other = report.timeline.answers, report.replayed, report.other
    rows = []
    for n, (stamp, time) in enumerate(zip(answers.stamps.tolist(), report.seconds.tolist(), strict=True)):
        row: dict[str, Any] = {"stamp_ns": stamp, "time_s": time}
        row |= {f"L{i + 1}_mm": v * 1e3 for i, v in enumerate(answers.commands[n].tolist())}
        row |= _micrometres("recorded", answers.corrections[n])
        if replayed is not None:
            row |= _micrometres("replayed", replayed.corrections[n])
            row["outcome"] = OUTCOMES[int(replayed.outcome[n])]
        if other is not None:
            row |= _micrometres("other", other.corrections[n])
        rows.append(row)
    return rows


def _micrometres(name: str, corrections: np.ndarray) -> dict[str, float]:
    return {f"{name}_L{i + 1}_um": v * 1e6 for i, v in enumerate(corrections.tolist())}


def as_json(report: Report) -> dict[str, Any]:
    """Return the report as plain data; lengths in m."""
    recording, replayed, other = report.recording, report.replayed, report.other
    page = recording.pages[0][1]
    content: dict[str, Any] = {
        "bag": recording.path,
        "node": recording.node,
        "geometry": page.geometry,
        "model": page.model,
        "commands": len(recording.topics["tool_pose_command"]),
        "answers": len(report.timeline.answers),
        "answers_lost": report.timeline.lost,
        "same": report.same if replayed is not None else None,
        "made_with": page.made_with,
        "notes": recording.notes,
    }
    if replayed is not None:
        content |= _replay_json(recording, replayed)
    if other is not None:
        difference = np.abs(other.difference)
        content["other"] = {
            "name": report.other_name,
            "largest_difference_m": [float(np.nanmax(column, initial=0.0)) for column in difference.T],
            "refused": len(other.refused_now),
        }
    return content


def _replay_json(recording: Recording, replayed: Replay) -> dict[str, Any]:
    asked, different = recording.topics["tool_pose_command"], np.flatnonzero(replayed.outcome == DIFFERENT)
    found = Counter(replayed.outcome.tolist())
    first = None
    if len(different):
        row = int(different[0])
        first = {
            "stamp_ns": int(replayed.answers.stamps[row]),
            "recorded_correction_m": replayed.answers.corrections[row],
            "replayed_correction_m": replayed.corrections[row],
            "refused_now": replayed.refused_now.get(row),
        }
    return {
        "outcomes": {name: found[outcome] for outcome, name in OUTCOMES.items()},
        "first_difference": first,
        "largest_difference_m": float(np.nanmax(np.abs(replayed.difference[different]), initial=0.0)),
        "states_differ": len(replayed.states_differ),
        "changes": [
            {"before_stamp_ns": _stamp(replayed, row), "what": entry.what, **entry.values}
            for row, entry in replayed.events
        ],
        "refused": [
            {
                "stamp_ns": int(asked.stamps[entry.number]),
                "reason": entry.reason,
                "text": entry.text,
                "by": "journal" if entry.from_journal else "replay",
            }
            for entry in replayed.refused
        ],
    }


def _stamp(replayed: Replay, row: int) -> int | None:
    """Return the stamp of the answer that a change precedes; None after the last."""
    return int(replayed.answers.stamps[row]) if row < len(replayed.answers) else None
