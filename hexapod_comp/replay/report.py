"""What a replay prints: is it the same, where does it part, what was refused, and the figures of the run."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from datetime import datetime, timezone
from typing import Any

import numpy as np

from ..compensation.journal import made_with
from ..errors import printable
from ..formats.texts import aligned
from ..machine.trajectory import feet_on, motion_onto
from ..pose import Pose
from .bag import Recording
from .replay import BEFORE, DIFFERENT, IDENTICAL, LOST, Event, Replay

OUTCOMES = {
    IDENTICAL: "identical",
    DIFFERENT: "different",
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
    """Everything that one replay has to tell."""

    recording: Recording  # what was read
    replayed: Replay | None  # with what was in use; None when geometry or model were not at hand
    other: Replay | None = None  # with another model or geometry
    other_name: str = ""  # what that was
    tolerance: float = 0.0  # differences up to this, m, are accepted
    # in ``base``, where the geometry is at hand: without them nobody can tell where the tool went
    work_frames: Mapping[str, Pose] | None = None

    @property
    def seconds(self) -> np.ndarray:
        """Time of each answer since the first, s, by their stamps."""
        stamps = self.recording.commands["stamp"]
        return since(stamps, stamps)

    @property
    def strut_commands(self) -> np.ndarray:
        """Recorded strut commands, shape (n, 6), m."""
        return self.recording.commands["lengths"][:, 0]

    @property
    def strut_corrections(self) -> np.ndarray:
        """Recorded corrections, shape (n, 6), m."""
        return self.recording.commands["lengths"][:, 1]

    @property
    def refused(self) -> list[Event]:
        """Refused commands that the journal names."""
        run = self.replayed or self.other
        return [] if run is None else run.refused

    @property
    def refusals(self) -> int:
        """How many commands were refused."""
        return len(self.refused) + sum(page.refused_more for _, page in self.recording.pages)

    def since_first_page(self, time: int) -> float:
        """Return a recorder's time, ns, as seconds since the recorder's first page with answers."""
        return (time - next(at for at, page in self.recording.pages if len(page.commands))) * 1e-9

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
    recording, stamps = report.recording, report.recording.commands["stamp"]
    machine, model = (printable(one["name"]) for one in (recording.first.geometry, recording.first.model))
    yield f"{recording.path}: {printable(recording.node)}, machine {machine}, model {model}"
    began = datetime.fromtimestamp(stamps[0] * 1e-9, timezone.utc)
    heard = f"; the recorder heard {recording.heard}" if recording.heard else ""
    yield (
        f"from {began:%Y-%m-%d %H:%M:%S} UTC, {report.seconds[-1]:.1f} s: {len(stamps) + report.refusals} commands "
        f"taken, {len(stamps)} answered, {report.refusals} refused{heard}"
    )


def _verdict(report: Report) -> Iterator[str]:
    replayed = report.replayed
    if replayed is None:
        yield "not replayed as it was: geometry and model that were in use are not at hand"
        return
    counts = Counter(replayed.outcome.tolist())
    compared = counts[IDENTICAL] + counts[DIFFERENT]
    word = "identical bit for bit" if not counts[DIFFERENT] else f"{counts[IDENTICAL]} identical bit for bit"
    yield f"replayed {compared} of {len(replayed.commands)} answers: {word}" + (
        f", {counts[DIFFERENT]} different" if counts[DIFFERENT] else ""
    )
    if replayed.lost:
        yield f"the recorder has lost answers that the journal counts: {replayed.lost}"
    if counts[LOST]:
        yield f"left out: {counts[LOST]} answers after lost pages of the journal, up to its next snapshot"
    if counts[BEFORE]:
        yield f"left out: {counts[BEFORE]} answers before the journal's first snapshot"
    changes = Counter(event.entry.what for event in replayed.changes)
    listed = ", ".join(f"{count} × {what}" for what, count in sorted(changes.items())) or "none"
    yield f"changes between commands: {listed}; {len(report.recording.pages)} pages of the journal"


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
    yield from _versions(report, worst)


def _first(replayed: Replay, row: int) -> str:
    """Say how the first different answer differs."""
    if row in replayed.refused_now:
        return f"the replay refuses the command ({replayed.refused_now[row]})"
    recorded, now = replayed.commands["lengths"][row], replayed.lengths[row]
    places = ((kind, n) for kind in (1, 0) for n in range(6))
    kind, n = next(place for place in places if recorded[place].tobytes() != now[place].tobytes())
    was, is_now = (float(one[kind, n]) * 1e6 for one in (recorded, now))
    return f"strut_{n + 1}, {('command', 'correction')[kind]} recorded {was!r} µm, replayed {is_now!r} µm"


def _place(report: Report, row: int) -> str:
    if row >= len(report.recording.commands):
        return "the end"
    stamp = int(report.recording.commands["stamp"][row])
    return f"answer {row + 1} (stamp {stamp // 10**9}.{stamp % 10**9:09d}, {report.seconds[row]:.3f} s)"


def _versions(report: Report, worst: float) -> Iterator[str]:
    """Say what this machine does not have in common with the one that was recorded."""
    recorded, here = report.recording.first.made_with, made_with()
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
    corrections = report.strut_corrections
    if np.isfinite(corrections).any():
        largest = int(np.nanargmax(np.abs(corrections)))
        row, strut = divmod(largest, 6)
        value = corrections[row, strut] * 1e6
        yield f"largest correction {value:.3f} µm, strut_{strut + 1}, {_place(report, row)}"
    _, error = following_error(report)
    if len(error):
        shown = " ".join(f"{_rms(column):.2f}/{np.abs(column).max() * 1e6:.2f}" for column in error.T)
        yield f"following error (measured − commanded, drives' lag included), RMS/largest µm per strut: {shown}"

    yield from (_tool_text(name, raw, aligned) for name, raw, aligned in tool_distances(report))


def _tool_text(name: str, raw: np.ndarray, left: np.ndarray | None) -> str:
    sizes = [f"as it is {_size(raw)}", *([] if left is None else [f"datum aligned {_size(left)}"])]
    return f"distance of {name} to the commanded path, RMS/largest µm: {', '.join(sizes)}"


def _size(distances: np.ndarray) -> str:
    return f"{_rms(distances):.2f}/{distances.max() * 1e6:.2f}"


def tool_distances(report: Report) -> Iterator[tuple[str, np.ndarray, np.ndarray | None]]:
    """Yield by how much the tool was off its path: a topic, distances as they are, and with the datum aligned, m.

    A late tool is not off. The second is None where the tool moved in a line or not at all.
    """
    when = report.seconds
    if report.work_frames is None or len(when) < 2:
        return
    corners = tool_positions(report.recording, report.work_frames)
    for name in ("tool_pose_estimate", "tool_pose_true"):
        poses = report.recording.topics[name]
        stamps = poses.stamps if poses.stamps.all() else poses.times
        at = since(stamps, report.recording.commands["stamp"])
        inside = (at >= when[0]) & (at <= when[-1])
        if not inside.any():
            continue
        points, sent = poses.values[inside], np.searchsorted(when, at[inside], side="right")
        raw = np.linalg.norm(points - feet_on(corners, points, sent), axis=1)
        motion, left = motion_onto(corners, points, sent), None
        if motion is not None:
            points = motion.position + points @ motion.rotation.T
            left = np.linalg.norm(points - feet_on(corners, points, sent), axis=1)
        yield name, raw, left


def _refused(report: Report) -> Iterator[str]:
    if not report.refusals:
        return
    unnamed = report.refusals - len(report.refused)
    yield f"refused commands: {report.refusals}" + (f", {unnamed} of them not named in the journal" if unnamed else "")
    rows = []
    for reason, count in Counter(event.entry.values["reason"] for event in report.refused).most_common():
        first = next(event for event in report.refused if event.entry.values["reason"] == reason)
        when = report.since_first_page(first.time)
        rows.append([printable(reason), str(count), f"{when:.2f}", printable(first.entry.values["text"])])
    yield aligned(["reason", "count", "first_s", ""], rows)


def following_error(report: Report) -> tuple[np.ndarray, np.ndarray]:
    """Return by how much the measured struts were off their commands."""
    states, when = report.recording.topics["strut_states"], report.seconds
    if len(when) < 2 or not len(states):
        return np.zeros(0), np.zeros((0, 6))
    # Drives that do not stamp are taken by the recorder's clock.
    at = since(states.stamps if states.stamps.all() else states.times, report.recording.commands["stamp"])
    after = np.clip(np.searchsorted(when, at), 1, len(when) - 1)
    inside = (at >= when[0]) & (at <= when[-1]) & (when[after] - when[after - 1] <= LONGEST_GAP)
    wanted = np.stack([np.interp(at[inside], when, column) for column in report.strut_commands.T], axis=1)
    return at[inside], states.values[inside] - wanted


def tool_positions(recording: Recording, work_frames: Mapping[str, Pose]) -> np.ndarray:
    """Return where the tool was commanded in ``base``, (n, 3), m, with the work frames seen from ``base``."""
    positions = recording.commands["pose"][:, :3].copy()
    for name, frame in work_frames.items():
        inside = recording.frames == name
        positions[inside] = frame.position + positions[inside] @ frame.rotation.T
    return positions


def rows_of(report: Report) -> list[dict[str, Any]]:
    """Return one CSV row per answer: stamps, commands (mm), corrections (µm) recorded, replayed and with the other."""
    stamps, replayed, other = report.recording.commands["stamp"], report.replayed, report.other
    rows = []
    for n, (stamp, time) in enumerate(zip(stamps.tolist(), report.seconds.tolist(), strict=True)):
        row: dict[str, Any] = {"stamp_ns": stamp, "time_s": time}
        row |= {f"L{i + 1}_mm": v * 1e3 for i, v in enumerate(report.strut_commands[n].tolist())}
        row |= _micrometres("recorded", report.strut_corrections[n])
        if replayed is not None:
            row |= _micrometres("replayed", replayed.lengths[n, 1])
            row["outcome"] = OUTCOMES[int(replayed.outcome[n])]
        if other is not None:
            row |= _micrometres("other", other.lengths[n, 1])
        rows.append(row)
    return rows


def _micrometres(name: str, corrections: np.ndarray) -> dict[str, float]:
    return {f"{name}_L{i + 1}_um": v * 1e6 for i, v in enumerate(corrections.tolist())}


def as_json(report: Report) -> dict[str, Any]:
    """Return the report as plain data; lengths in m."""
    recording, replayed, other = report.recording, report.replayed, report.other
    content: dict[str, Any] = {
        "bag": recording.path,
        "node": recording.node,
        "geometry": recording.first.geometry,
        "model": recording.first.model,
        "commands": len(recording.commands) + report.refusals,
        "commands_heard_by_recorder": recording.heard,
        "answers": len(recording.commands),
        "answers_lost": replayed.lost if replayed is not None else None,
        "same": report.same if replayed is not None else None,
        "made_with": recording.first.made_with,
        "refused": report.refusals,
        "notes": recording.notes,
        "distance_to_path": {name: _distance_json(raw, left) for name, raw, left in tool_distances(report)},
    }
    if replayed is not None:
        content |= _replay_json(replayed)
    if other is not None:
        difference = np.abs(other.difference)
        content["other"] = {
            "name": report.other_name,
            "largest_difference_m": np.nanmax(difference, axis=0, initial=0.0),
            "refused": len(other.refused_now),
        }
    return content


def _distance_json(raw: np.ndarray, left: np.ndarray | None) -> dict[str, Any]:
    def size(distances: np.ndarray | None) -> dict[str, float] | None:
        return None if distances is None else {"rms_m": _rms(distances) * 1e-6, "max_m": float(distances.max())}

    return {"as_it_is": size(raw), "datum_aligned": size(left)}


def _replay_json(replayed: Replay) -> dict[str, Any]:
    different = np.flatnonzero(replayed.outcome == DIFFERENT)
    counts = Counter(replayed.outcome.tolist())
    first = None
    if len(different):
        row = int(different[0])
        first = {
            "stamp_ns": _stamp(replayed, row),
            "recorded_correction_m": replayed.commands["lengths"][row, 1],
            "replayed_correction_m": replayed.lengths[row, 1],
            "refused_now": replayed.refused_now.get(row),
        }
    return {
        "outcomes": {name: counts[outcome] for outcome, name in OUTCOMES.items()},
        "first_difference": first,
        "largest_difference_m": np.nanmax(np.abs(replayed.difference[different]), initial=0.0),
        "states_differ": len(replayed.states_differ),
        "changes": [
            {"before_stamp_ns": _stamp(replayed, event.row), "what": event.entry.what, **event.entry.values}
            for event in replayed.changes
        ],
        "refusals": [
            {"before_stamp_ns": _stamp(replayed, event.row), "stamp_ns": values["stamp"]}
            | {key: values[key] for key in ("reason", "text")}
            for event in replayed.refused
            for values in (event.entry.values,)
        ],
    }


def _stamp(replayed: Replay, row: int) -> int | None:
    """Return the stamp of the answer that an event precedes; None after the last."""
    return int(replayed.commands["stamp"][row]) if row < len(replayed.commands) else None
