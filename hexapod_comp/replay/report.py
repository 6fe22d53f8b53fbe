"""The report of a replay: equal and different answers, the first difference, refused commands, and statistics."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from datetime import datetime, timezone
from typing import Any

import numpy as np

from ..compensation.journal import made_with
from ..errors import printable
from ..formats.texts import aligned
from ..machine.geometry import TOOL, HexapodGeometry
from ..machine.trajectory import feet_on, motion_onto
from ..pose import turned_by
from .bag import Recording
from .replay import BEFORE, DIFFERENT, IDENTICAL, LOST, Event, Replay

# Names of outcomes in CSV and JSON
OUTCOMES = {IDENTICAL: "identical", DIFFERENT: "different", LOST: "not replayed", BEFORE: "before the journal"}

ROUNDING = 1e-12  # A smaller difference of corrections, m, comes from another processor's or library's rounding

LONGEST_GAP = 0.1  # Longest time between two commands for an interpolation of the strut lengths, s

Part = tuple[list[str], dict[str, Any]]  # Part of a report: lines of text and JSON entries


@dataclass
class Report:
    """A recording, and the results of its replays."""

    recording: Recording
    replayed: Replay | None  # with the geometry and model that the compensator used; None if a file is missing
    other: Replay | None = None  # with another model or geometry, called `other_name`
    other_name: str = ""
    tolerance: float = 0.0  # largest accepted difference of a correction, m
    geometry: HexapodGeometry | None = None  # None if it is missing

    @property
    def seconds(self) -> np.ndarray:
        """Stamp of each of the n commands minus the stamp of the first command, in s."""
        return self.since(self.recording.commands["stamp"])

    def since(self, stamps: np.ndarray) -> np.ndarray:
        """Return `stamps`, ns, minus the stamp of the first command, in s."""
        return (stamps - self.recording.commands["stamp"][0]) * 1e-9

    @property
    def strut_commands(self) -> np.ndarray:
        """Recorded strut commands, (n, 6), m."""
        return self.recording.commands["lengths"][:, 0]

    @property
    def strut_corrections(self) -> np.ndarray:
        """Recorded corrections, (n, 6), m."""
        return self.recording.commands["lengths"][:, 1]

    @property
    def refused(self) -> list[Event]:
        """Entries of the journal for refused commands."""
        run = self.replayed or self.other
        return [] if run is None else run.refused

    @property
    def refusals(self) -> int:
        """Number of refused commands, including those that the journal only counts and has no entry for."""
        return len(self.refused) + sum(page.refused_more for _, page in self.recording.pages)

    @property
    def same(self) -> bool:
        """Whether the replay agrees with the recording; True if nothing was replayed.

        With a `tolerance` of 0 all bits must be equal, otherwise no correction may differ by more than `tolerance`.
        """
        replayed = self.replayed
        if replayed is None or (replayed.identical and not replayed.states_differ):
            return True
        worst = np.abs(replayed.difference[replayed.different]).max(initial=0.0)  # NaN if the replay refuses a command
        return bool(self.tolerance > 0.0 and worst <= self.tolerance)

    def shown(self) -> tuple[str, dict[str, Any]]:
        """Return the report as text, and as data for JSON with lengths in m."""
        lines, content = list[str](), dict[str, Any]()
        for text, data in (_run(self), _compared(self), _with_other(self), _figures(self), _refused(self)):
            lines += text
            content |= data
        notes = self.recording.notes
        return "\n".join([*lines, *(f"note: {note}" for note in notes)]), content | {"notes": notes}

    def place(self, row: int) -> str:
        if row >= len(self.recording.commands):
            return "the end"
        stamp = int(self.recording.commands["stamp"][row])
        return f"answer {row + 1} (stamp {stamp // 10**9}.{stamp % 10**9:09d}, {self.seconds[row]:.3f} s)"


def _run(report: Report) -> Part:
    recording, answers = report.recording, len(report.recording.commands)
    first = recording.first
    machine, model = (printable(one["name"]) for one in (first.geometry, first.model))
    began = datetime.fromtimestamp(recording.commands["stamp"][0] * 1e-9, timezone.utc)
    recorded = f"; {recording.recorded} recorded" if recording.recorded else ""
    lines = [
        f"{recording.path}: {printable(recording.node)}, machine {machine}, model {model}",
        f"from {began:%Y-%m-%d %H:%M:%S} UTC, {report.seconds[-1]:.1f} s: {answers + report.refusals} commands "
        f"handled, {answers} answered, {report.refusals} refused{recorded}",
    ]
    return lines, {
        "bag": recording.path,
        "node": recording.node,
        "geometry": first.geometry,
        "model": first.model,
        "commands": answers + report.refusals,
        "commands_recorded": recording.recorded,
        "answers": answers,
        "answers_lost": None if report.replayed is None else report.replayed.lost,
        "same": None if report.replayed is None else report.same,
        "made_with": first.made_with,
        "refused": report.refusals,
    }


def _compared(report: Report) -> Part:
    replayed = report.replayed
    if replayed is None:
        return ["not replayed: the bag lacks the geometry or the model that the compensator used"], {}
    counts, stamps = Counter(replayed.outcome.tolist()), [*replayed.commands["stamp"].tolist(), None]
    same, different = counts[IDENTICAL], counts[DIFFERENT]
    found = f"{same} identical bit for bit, {different} different" if different else "identical bit for bit"
    lines = [f"replayed {same + different} of {len(replayed.commands)} answers: {found}"]
    if replayed.lost:
        lines.append(f"lost: {replayed.lost} answers in pages of the journal that the recorder did not receive")
    if counts[LOST]:
        lines.append(f"not compared: {counts[LOST]} answers between lost pages and the journal's next snapshot")
    if counts[BEFORE]:
        lines.append(f"not compared: {counts[BEFORE]} answers before the journal's first snapshot")
    changes = Counter(event.entry.what for event in replayed.changes)
    listed = ", ".join(f"{count} × {what}" for what, count in sorted(changes.items())) or "none"
    lines.append(f"changes between commands: {listed}; {len(report.recording.pages)} pages of the journal")
    first = None
    if different:
        row = int(replayed.different[0])
        recorded, now, refusal = replayed.commands["lengths"][row], replayed.lengths[row], replayed.refused_now.get(row)
        lines += _difference(report, replayed, row)
        first = {
            "stamp_ns": stamps[row],
            "recorded_correction_m": recorded[1],
            "replayed_correction_m": now[1],
            "refused_now": refusal,
        }
    elif replayed.states_differ:
        place = report.place(replayed.states_differ[0])
        lines.append(f"all answers agree, but before {place} the replayed state first differs from the recorded state")
    return lines, {
        "outcomes": {name: counts[outcome] for outcome, name in OUTCOMES.items()},
        "first_difference": first,
        "largest_difference_m": replayed.largest_difference,
        "states_differ": len(replayed.states_differ),
        "changes": [
            {"before_stamp_ns": stamps[e.row], "what": e.entry.what, **e.entry.values} for e in replayed.changes
        ],
        "refusals": [
            {"before_stamp_ns": stamps[event.row], "stamp_ns": values["stamp"]}
            | {k: values[k] for k in ("reason", "text")}
            for event in replayed.refused
            for values in (event.entry.values,)
        ],
    }


def _difference(report: Report, replayed: Replay, row: int) -> Iterator[str]:
    """Yield lines: the first answer unlike the recorded one (`row`), the largest difference, and a possible cause."""
    worst = replayed.largest_difference
    if row in replayed.refused_now:
        how = f"the replay refuses the command ({replayed.refused_now[row]})"
    else:
        recorded, now = replayed.commands["lengths"][row], replayed.lengths[row]
        places = ((kind, n) for kind in (1, 0) for n in range(6))
        kind, n = next(place for place in places if recorded[place].tobytes() != now[place].tobytes())
        was, is_now = (float(one[kind, n]) * 1e6 for one in (recorded, now))
        how = f"strut_{n + 1}, {('command', 'correction')[kind]} recorded {was!r} µm, replayed {is_now!r} µm"
    yield f"first difference: {report.place(row)}: {how}"
    accepted = f", accepted up to {report.tolerance * 1e6:g} µm" if report.same else ""
    yield f"largest difference {worst * 1e6:.9g} µm{accepted}"
    then, here = report.recording.first.made_with, made_with()
    unlike = [f"{key} {printable(then[key])}, here {here[key]}"
              for key in here if then.get(key, here[key]) != here[key]]  # fmt: skip
    if unlike:
        yield f"{'the difference may be rounding; ' if worst < ROUNDING else ''}recorded with {'; '.join(unlike)}"


def _with_other(report: Report) -> Part:
    other = report.other
    if other is None:
        return [], {}
    difference = np.abs(other.difference)
    answered = difference[np.isfinite(difference).all(axis=1)]
    lines = [f"with {report.other_name}: {len(answered)} answers; corrections differ from the recorded ones by"]
    if len(answered):
        sizes = ((f"{_rms(column):.3f}", f"{np.nanmax(column) * 1e6:.3f}") for column in difference.T)
        lines.append(aligned(["", "RMS_um", "max_um"], [[f"strut_{n}", *size] for n, size in enumerate(sizes, 1)]))
    if other.refused_now:
        row, why = next(iter(other.refused_now.items()))
        lines.append(f"  it refuses {len(other.refused_now)} commands, first {report.place(row)}: {why}")
    largest = np.nanmax(difference, axis=0, initial=0.0)
    refused = len(other.refused_now)
    return lines, {"other": {"name": report.other_name, "largest_difference_m": largest, "refused": refused}}


def _rms(values: np.ndarray) -> float:
    """Return the RMS of lengths in m, converted to µm."""
    return float(np.sqrt(np.nanmean(np.square(values)))) * 1e6


def _figures(report: Report) -> Part:
    def size(distances: np.ndarray) -> str:
        return f"{_rms(distances):.2f}/{np.abs(distances).max() * 1e6:.2f}"

    def data(distances: np.ndarray | None) -> dict[str, float] | None:
        return None if distances is None else {"rms_m": _rms(distances) * 1e-6, "max_m": float(distances.max())}

    lines, tools, corrections = list[str](), dict[str, Any](), report.strut_corrections
    if np.isfinite(corrections).any():
        row, strut = divmod(int(np.nanargmax(np.abs(corrections))), 6)
        largest = f"{corrections[row, strut] * 1e6:.3f} µm, strut_{strut + 1}, {report.place(row)}"
        lines.append(f"largest correction {largest}")
    _, error = following_error(report)
    if len(error):
        shown = " ".join(map(size, error.T))
        lines.append(
            f"following error (measured − commanded, including the drives' lag), RMS/largest µm per strut: {shown}"
        )
    for name, raw, left in _tool_distances(report):
        shown = f"absolute {size(raw)}" + ("" if left is None else f", after best-fit alignment {size(left)}")
        lines.append(f"distance of {name} to the commanded path, RMS/largest µm: {shown}")
        tools[name] = {"as_it_is": data(raw), "datum_aligned": data(left)}
    return lines, {"distance_to_path": tools}


def _tool_distances(report: Report) -> Iterator[tuple[str, np.ndarray, np.ndarray | None]]:
    """Yield the name of each topic of tool poses, and the distances in m of its poses from the commanded path:
    absolute, and after best-fit alignment (None for too few poses). A lag along the path is no distance from the path.
    """
    when = report.seconds
    if report.geometry is None or len(when) < 2:
        return
    for name, of_tool in (("tool_pose_estimate", None), ("tool_pose_true", TOOL)):
        corners = tool_positions(report.recording, report.geometry, of_tool)
        poses = report.recording.topics[name]
        at = report.since(poses.when)
        inside = (at >= when[0]) & (at <= when[-1])
        if not inside.any():
            continue
        points, sent = poses.values[inside], np.searchsorted(when, at[inside], side="right")
        raw = np.linalg.norm(points - feet_on(corners, points, sent), axis=1)
        motion, left = motion_onto(corners, points, sent), None
        if motion is not None:
            points = motion.transform(points)
            left = np.linalg.norm(points - feet_on(corners, points, sent), axis=1)
        yield name, raw, left


def _refused(report: Report) -> Part:
    if not report.refusals:
        return [], {}
    unnamed = report.refusals - len(report.refused)
    began = next(time for time, page in report.recording.pages if len(page.commands))
    counts, rows = Counter(event.entry.values["reason"] for event in report.refused), []
    for reason, count in counts.most_common():
        first = next(event for event in report.refused if event.entry.values["reason"] == reason)
        when = f"{(first.time - began) * 1e-9:.2f}"
        rows.append([printable(reason), str(count), when, printable(first.entry.values["text"])])
    title = f"refused commands: {report.refusals}" + (f", {unnamed} without a reason in the journal" * bool(unnamed))
    return [title, aligned(["reason", "count", "first_s", ""], rows)], {}


def following_error(report: Report) -> tuple[np.ndarray, np.ndarray]:
    """Return times of measurement in s, and measured minus interpolated commanded strut lengths in m, shape (n, 6)."""
    states, when = report.recording.topics["strut_states"], report.seconds
    if len(when) < 2 or not len(states):
        return np.zeros(0), np.zeros((0, 6))
    at = report.since(states.when)
    after = np.clip(np.searchsorted(when, at), 1, len(when) - 1)
    inside = (at >= when[0]) & (at <= when[-1]) & (when[after] - when[after - 1] <= LONGEST_GAP)
    wanted = np.stack([np.interp(at[inside], when, column) for column in report.strut_commands.T], axis=1)
    return at[inside], states.values[inside] - wanted


def tool_positions(recording: Recording, geometry: HexapodGeometry, of_tool: str | None = None) -> np.ndarray:
    """Return the n commanded positions in ``base``, m, (n, 3), of the tool `of_tool`; None: of each command's tool."""
    poses = recording.commands["pose"]
    positions = poses[:, :3].copy()
    for tool in set() if of_tool is None else {*recording.tools} - {of_tool}:
        offset = (geometry.tools[tool].inverse() @ geometry.tools[str(of_tool)]).position
        rows = recording.tools == tool
        positions[rows] += turned_by(poses[rows, 3:], offset)
    for name, frame in geometry.work_frames.items():
        inside = recording.frames == name
        positions[inside] = frame.transform(positions[inside])
    return positions


def rows_of(report: Report) -> Iterator[dict[str, Any]]:
    replayed, other = report.replayed, report.other
    corrections = {"recorded": report.strut_corrections}
    if replayed is not None:
        corrections["replayed"] = replayed.lengths[:, 1]
    if other is not None:
        corrections["other"] = other.lengths[:, 1]
    stamps = report.recording.commands["stamp"].tolist()
    for n, (stamp, time) in enumerate(zip(stamps, report.seconds.tolist(), strict=True)):
        row: dict[str, Any] = {"stamp_ns": stamp, "time_s": time}
        row |= {f"L{i + 1}_mm": v * 1e3 for i, v in enumerate(report.strut_commands[n].tolist())}
        for name, values in corrections.items():
            row |= {f"{name}_L{i + 1}_um": v * 1e6 for i, v in enumerate(values[n].tolist())}
            if replayed is not None and name == "replayed":
                row["outcome"] = OUTCOMES[int(replayed.outcome[n])]
        yield row
