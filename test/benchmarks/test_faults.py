"""The judge of the fault campaign, and a few of its episodes. The whole campaign: python -m benchmarks.faults.

The judge is tested with records of runs that these tests write, each with a known violation.
"""

from __future__ import annotations

import math
import os
from collections.abc import Callable
from dataclasses import replace
from types import SimpleNamespace
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest
from helpers import ALL_TESTS

pytest.importorskip("rclpy")

from benchmarks.faults.campaign import STARVED, run_episode
from benchmarks.faults.judge import judge
from benchmarks.faults.kinds import KINDS
from benchmarks.faults.record import Happened, Record, Sent, Status, Struts
from benchmarks.faults.rig import Rig, refusal_to_mount
from hexapod_comp.ros.base import log_problem

LIMITS = SimpleNamespace(stroke=np.tile([0.33, 0.88], (6, 1)), step=2e-3, correction=2e-3, speed=0.25)

PERIOD = 0.004
"""Period of the commands in these records, s."""


def quiet(seconds: float = 4.0) -> Record:
    """Return the record of a machine that moves at up to 40 mm/s and has no faults."""
    record = Record()
    record.ended = seconds
    for index in range(int(seconds / PERIOD)):
        now = index * PERIOD
        lengths = np.full(6, 0.5 + 0.01 * math.sin(4.0 * now))
        record.sent[index] = Sent(now, now + 0.001)
        record.commands.append(Struts(now, lengths))
        record.corrections.append(Struts(now + 0.001, np.full(6, 1e-4)))
        record.measured.append(Struts(now + 0.002, lengths.copy()))
        for link in record.delivered:
            record.delivered[link].append(now + 0.001)
    for second in range(int(seconds)):
        for node in ("compensator", "strut_drive"):
            record.statuses.append(Status(float(second), node, 0, "running", {}))
    record.statuses.sort(key=lambda status: status.time)
    return record


def say(record: Record, time: float, message: str, node: str = "compensator", **values: str) -> None:
    """Add a diagnostic status of a node to a record."""
    record.statuses.append(Status(time, node, 2, message, values))
    record.statuses.sort(key=lambda status: status.time)


def of_strut(n: int, value: float) -> np.ndarray:
    return np.where(np.arange(6) == n, value, 0.0)


def off(record: Record, since: int, by: float | np.ndarray) -> None:
    """Shift all strut commands from number `since` on by a length, m."""
    for struts in record.commands[since:]:
        struts.lengths[:] += by


def told(record: Record, **lengths: Any) -> None:
    """Change the lengths of message 700 of 1,000 in one of the record's lists, by the function given for that list."""
    ((name, spoilt),) = lengths.items()
    getattr(record, name)[700].lengths[:] = spoilt(getattr(record, name)[700].lengths)


def restarted(record: Record, further: float) -> None:
    """Restart the compensator at command 700 from the struts, 5 mm away; shift its first command by `further`, m."""
    off(record, 700, 5e-3)
    for struts in record.measured[680:]:
        struts.lengths[:] += 5e-3
    record.fresh_starts.append(record.commands[700].time - 1e-4)
    record.commands[700].lengths[:] += further


def hurried(record: Record, speed: float) -> None:
    """Send commands 700 to 706 at a speed, m/s; the limit is 250 mm/s, and the judge allows 5 % more."""
    start = record.commands[699].lengths
    for n, struts in enumerate(record.commands[700:]):
        record.commands[700 + n] = replace(struts, lengths=start + speed * PERIOD * min(n + 1, 7))


def bunched(record: Record) -> None:
    for n in range(700, 750):
        record.commands[n] = replace(record.commands[n], time=record.commands[750].time)


def standing(record: Record) -> None:
    record.faults = [Happened("latched_following_error", 2.0, 2.5, halts=[(2.1, 2.5)])]


def lost(record: Record, *seconds: float) -> None:
    """Leave commands at some seconds without an answer; a corrupt message lasts from 2 to 2.5 s and is reported."""
    corrupt(record)
    say(record, 2.15, "refusing commands: not_finite")
    for second in seconds:
        record.sent[int(second / PERIOD)].answered_at = math.nan


JUDGED: dict[str, tuple[Callable[[Record], object], str]] = {
    "nothing wrong": (lambda record: None, ""),
    "step": (lambda record: told(record, commands=lambda lengths: lengths + of_strut(2, 2.1e-3)), "step of 2."),
    "NaN": (lambda record: told(record, commands=lambda lengths: lengths * np.nan), "not finite"),
    "infinite": (lambda record: told(record, commands=lambda lengths: lengths + of_strut(3, np.inf)), "not finite"),
    "too long": (lambda record: told(record, commands=lambda _: 0.881), "outside the stroke"),
    "too short": (lambda record: told(record, commands=lambda _: 0.329), "outside the stroke"),
    "correction": (lambda record: told(record, corrections=lambda _: 2.1e-3), "strut_corrections of 2.1"),
    "NaN correction": (lambda record: told(record, corrections=lambda _: math.nan), "not finite"),
    "a start elsewhere, not reset": (lambda record: off(record, 700, 5e-3), "step"),
    "a fresh start": (lambda record: restarted(record, 0.0), ""),
    "a fresh start from elsewhere": (lambda record: restarted(record, 5e-3), "step"),
    "fast enough": (lambda record: hurried(record, 0.262), ""),
    "too fast": (lambda record: hurried(record, 0.264), "mm/s over 20 ms"),
    "bunched on their way": (bunched, ""),
    "moved though it must stand": (standing, "87 strut_commands though the machine must"),
    "one lost outside the fault": (lambda record: lost(record, 1.0, 2.2), "1 of"),
    "one lost inside the fault": (lambda record: lost(record, 2.2), ""),
}
"""Change of a good record, and the violation that the judge must report (empty: none)."""


@pytest.mark.parametrize("case", JUDGED)
def test_the_judge_catches_what_is_wrong_and_nothing_else(case):
    spoil, found = JUDGED[case]
    record = quiet()
    spoil(record)
    verdict = judge(record, LIMITS)
    said = verdict.breaches if "fresh" in case else verdict.misses()
    assert any(found in miss for miss in said) if found else said == []


def corrupt(record: Record) -> None:
    record.faults = [Happened("corrupt_pose", 2.0, 2.5, [2.1], "NaN, reason not_finite")]


@pytest.mark.parametrize(
    ("at", "message", "delay"),
    [
        (2.15, "refusing commands: not_finite", 0.05),
        (2.35, "refusing commands: not_finite", 0.25),
        (2.15, "refusing commands: quaternion", math.inf),
        (2.05, "running", math.inf),
        (1.95, "refusing commands: not_finite", math.inf),
    ],
    ids=["in time", "late", "of something else", "never", "before the fault"],
)
def test_how_long_a_report_took(at, message, delay):
    record = quiet()
    corrupt(record)
    say(record, at, message)
    verdict = judge(record, LIMITS)
    assert verdict.reports == [("corrupt_pose", pytest.approx(delay))]
    assert any("report" in miss or "corrupt_pose" in miss for miss in verdict.misses()) == (delay > 0.2)


@pytest.mark.parametrize(
    ("kind", "link", "node", "words"),
    [
        ("kill_compensator", "command", "strut_drive", "no new command"),
        ("stop_drive", "feedback", "compensator", "feedback lost"),
        ("drop_pose", "pose", "compensator", "no new command"),
    ],
)
def test_silence_is_visible_after_the_nodes_timeout(kind, link, node, words):
    """The last message came at 2.001 s, the timeout is 0.1 s: due at 2.101 s, the report came at 2.201 s."""
    record = quiet()
    record.delivered[link] = [t for t in record.delivered[link] if not 2.002 < t < 3.0]
    record.faults = [Happened(kind, 2.002, 3.0)]
    say(record, 2.201, words, node)
    assert judge(record, LIMITS).reports[0][1] == pytest.approx(0.1, abs=1e-6)


def test_who_is_dead_need_not_report_and_who_is_stopped_must_when_it_goes_on():
    """A stopped node must report a fault once it runs again; the successor of a killed node need not."""
    record = quiet()
    corrupt(record)
    record.outages["compensator"] = [(1.9, 2.4)]
    say(record, 2.5, "refusing commands: not_finite")
    assert judge(record, LIMITS).reports[0][1] == pytest.approx(0.1)
    record.killed["compensator"] = [(1.9, 2.4)]
    assert math.isnan(judge(record, LIMITS).reports[0][1])


@pytest.mark.parametrize(("last_bad", "recovery"), [(2.6, 0.1), (3.8, 1.3), (5.7, math.inf)])
def test_recovery_ends_with_the_last_command_that_was_not_answered(last_bad, recovery):
    record = quiet(6.0)
    record.faults = [Happened("duplicate_pose", 2.0, 2.5)]
    for index, entry in record.sent.items():
        if 2.5 <= index * PERIOD <= last_bad:
            entry.answered_at = math.nan
    if last_bad > 5.0:
        record.ended = 5.8
    found = judge(record, LIMITS)
    assert found.recovery == pytest.approx(recovery, abs=2 * PERIOD)
    assert any("recovery" in miss for miss in found.misses()) == (recovery > 1.0)


# ---- the log's disk ----


def test_a_full_log_disk_is_a_problem_and_so_is_a_folder_that_fails(monkeypatch, tmp_path):
    """The least free space is 16 blocks of 4,096 bytes. Without a log folder nodes log to no file: no problem."""
    full, broken = f"log disk full: {tmp_path}", OSError(5, "Input/output error")
    for blocks, problem in ((1000, ""), (16, ""), (15, full), (0, full)):
        monkeypatch.setattr(os, "statvfs", Mock(return_value=SimpleNamespace(f_bavail=blocks, f_frsize=4096)))
        assert log_problem(str(tmp_path)) == problem
    for error, problem in ((FileNotFoundError(), ""), (broken, "log folder lost: Input/output error")):
        monkeypatch.setattr(os, "statvfs", Mock(side_effect=error))
        assert log_problem(str(tmp_path)) == problem


# ---- episodes ----


class Chosen:
    """An episode with given faults instead of faults drawn at random."""

    number = -1

    def __init__(self, *kinds: str) -> None:
        self.faults = [(0.0, KINDS[kind](np.random.default_rng(3))) for kind in kinds]


def test_a_few_episodes(isolated_ros):
    """Episodes with two faults each, or under a stream of commands, break no limit and report each fault in time.

    An episode that reports late is repeated if its processes had to wait for a processor. One of the nine episodes runs
    by default, all with ALL_TESTS=1.
    """
    disk = () if refusal_to_mount() else ("log_disk_full",)
    kinds = [("corrupt_pose", *disk), ("encoder_nan", "drop_pose"), ("kill_compensator", "drop_feedback")]
    kinds += [("restart_under_stream",), ("reset_under_stream",), ("stop_under_stream",), ("stamps_stand",)]
    kinds += [("latched_following_error",), ("reset_in_motion", "use_sim_time_set")]
    with Rig(domain=False) as rig:
        for names in kinds if ALL_TESTS else kinds[:1]:
            for last in (False, False, True):
                outcome = run_episode(rig, Chosen(*names))
                assert outcome.verdict.breaches == []
                rig.spin(5.0, rig.running)
                assert rig.running()
                in_time = not any(delay >= 2.0 for _, delay in outcome.verdict.reports)
                if in_time:
                    break
                assert not last, outcome.line(0)
                assert outcome.starved > STARVED, outcome.line(0)
