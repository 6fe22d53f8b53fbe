"""Which recorded answer belongs to which recorded command, and where the journal's marks lie between them."""

from __future__ import annotations

from collections import Counter, defaultdict, deque
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from itertools import islice

import numpy as np

from .journal import Mark, Page
from .recording import Series

SAME = 1e-9
"""Nominal lengths this near, m, belong to the same pose: rounding leaves 1e-15 m, and no two commands are so near."""

LOOK_AHEAD = 200
"""Among so many commands of one stamp, or without any, the one answered is sought."""

LATEST_ANSWER = 1_000_000_000
"""A command without a stamp that was recorded so long before an answer, ns, is not what it answers."""


@dataclass(frozen=True)
class Answers:
    """What the compensator sent, in its order.

    Attributes
    ----------
    stamps, times : ndarray of int64, shape (n,)
        Stamps, and when the recorder got them, ns.
    commands, corrections : ndarray, shape (n, 6)
        m; NaN where the recording has only the other one.
    asked : ndarray of int64, shape (n,)
        Number of the command answered; −1 where the recording lacks it.
    """

    stamps: np.ndarray
    times: np.ndarray
    commands: np.ndarray
    corrections: np.ndarray
    asked: np.ndarray

    def __len__(self) -> int:
        return len(self.stamps)

    @property
    def nominal(self) -> np.ndarray:
        """Nominal lengths, shape (n, 6), m."""
        return self.commands - self.corrections


def gather(
    commands: Series, corrections: Series, asked: Series, lengths: Callable[[int], np.ndarray | None]
) -> Answers:
    """Join the two halves of each answer, and find the command that it answers.

    Parameters
    ----------
    commands, corrections : Series
        ``strut_commands`` and ``strut_corrections``; messages of either may be missing.
    asked : Series
        ``tool_pose_command``.
    lengths : callable
        Returns a command's nominal lengths, (6,), m, or None when it has none: tells apart commands of one stamp.
    """
    first, second = _keys(commands.stamps), _keys(corrections.stamps)
    order = _merged(first, second)
    halves = [{key: n for n, key in enumerate(keys)} for keys in (first, second)]
    values, times = [], np.zeros(len(order), dtype=np.int64)
    for series, numbers in zip((commands, corrections), halves, strict=True):
        found = np.full((len(order), 6), np.nan)
        for row, key in enumerate(order):
            if key in numbers:
                found[row] = series.values[numbers[key]]
                times[row] = series.times[numbers[key]]
        values.append(found)
    stamps = np.array([stamp for stamp, _ in order], dtype=np.int64)
    answers = Answers(stamps, times, values[0], values[1], np.full(len(order), -1, dtype=np.int64))
    _match(answers, asked, lengths)
    return answers


def _keys(stamps: np.ndarray) -> list[tuple[int, int]]:
    """Return each message's stamp and which of that stamp it is."""
    seen: Counter[int] = Counter()
    keys = []
    for stamp in stamps.tolist():
        keys.append((stamp, seen[stamp]))
        seen[stamp] += 1
    return keys


def _merged(first: list[tuple[int, int]], second: list[tuple[int, int]]) -> list[tuple[int, int]]:
    """Merge two lists that lack parts of one common list."""
    in_first, in_second = set(first), set(second)
    merged: list[tuple[int, int]] = []
    done = 0
    for key in first:
        if key in in_second:
            while second[done] != key:
                if second[done] not in in_first:
                    merged.append(second[done])
                done += 1
            done += 1
        merged.append(key)
    return merged + [key for key in second[done:] if key not in in_first]


def _match(answers: Answers, asked: Series, lengths: Callable[[int], np.ndarray | None]) -> None:
    """Write into ``answers.asked``."""
    by_stamp: dict[int, deque[int]] = defaultdict(deque)
    for number, stamp in enumerate(asked.stamps.tolist()):
        by_stamp[stamp].append(number)
    unstamped, nominal = by_stamp[0], answers.nominal
    for row, (stamp, time) in enumerate(zip(answers.stamps.tolist(), answers.times.tolist(), strict=True)):
        while unstamped and asked.times[unstamped[0]] < time - LATEST_ANSWER:
            unstamped.popleft()
        # A command without a stamp is answered with the time at which it came.
        candidates = by_stamp.get(stamp) or unstamped
        only = len(candidates) == 1 and candidates is not unstamped
        for number in islice(candidates, LOOK_AHEAD):
            if only or _same(lengths(number), nominal[row]):
                answers.asked[row] = number
                candidates.remove(number)
                break


def _same(lengths: np.ndarray | None, nominal: np.ndarray) -> bool:
    """Return whether nominal lengths are those of an answer, as far as the recording has them."""
    if lengths is None:
        return False
    return bool(np.isnan(nominal).any() or np.abs(lengths - nominal).max() < SAME)


def places(pages: Sequence[tuple[int, Page]], answers: Answers) -> list[list[int | None]]:
    """Return for each page where its marks lie: how many answers of the recording come before each.

    Parameters
    ----------
    pages : sequence of (int, Page)
        With the recorder's times, ns.
    answers : Answers
        All of them.

    Returns
    -------
    list of list of int or None
        For each page those of its entries, then that of its snapshot; None before the recording begins.
    """
    rows: dict[int, list[int]] = defaultdict(list)
    for row, stamp in enumerate(answers.stamps.tolist()):
        rows[stamp].append(row)
    found: list[list[int | None]] = [[] for _ in pages]
    for session in dict.fromkeys(page.session for _, page in pages):
        here = [n for n, (_, page) in enumerate(pages) if page.session == session]
        marks = [mark for n in here for mark in marks_of(pages[n][1])]
        # Nothing of a session is known by its stamps: then it begins when its first page came.
        start = int(np.searchsorted(answers.times, pages[here[0]][0])) if here[0] else 0
        lying = iter(_lying(marks, rows, start))
        for n in here:
            found[n] = [next(lying) for _ in marks_of(pages[n][1])]
    return found


def marks_of(page: Page) -> list[Mark]:
    """Return the marks of a page: its entries' and its snapshot's."""
    return [*(entry.mark for entry in page.entries), page.mark]


def _lying(marks: list[Mark], rows: dict[int, list[int]], start: int) -> list[int | None]:
    """Return where one session's marks lie, from the stamps that the recording has and from the counts."""
    found: list[int | None] = []
    last: tuple[int, int] | None = None
    for mark in marks:
        candidates = [row + 1 for row in rows.get(mark.stamp, ())]
        if candidates and last is not None:
            likely = last[0] + mark.count - last[1]
            candidates.sort(key=lambda place: abs(place - likely))
        found.append(candidates[0] if candidates else None)
        if candidates:
            last = candidates[0], mark.count
    return _filled(marks, found, start)


def _filled(marks: list[Mark], found: list[int | None], start: int) -> list[int | None]:
    """Count from the next mark whose stamp was found, else from the last, else from the session's start."""
    known: list[tuple[int, int]] = [
        (place, mark.count) for place, mark in zip(found, marks, strict=True) if place is not None
    ]
    filled: list[int | None] = []
    upcoming = iter(known)
    following = next(upcoming, None)
    last: tuple[int, int] | None = None
    for place, mark in zip(found, marks, strict=True):
        if place is not None:
            last, following = (place, mark.count), next(upcoming, None)
        else:
            base = following or last or (start, marks[0].count)
            place = base[0] + mark.count - base[1]
        filled.append(place if place >= 0 else None)
    return filled


def losses(pages: Sequence[tuple[int, Page]], lying: Iterable[list[int | None]], count: int) -> tuple[np.ndarray, int]:
    """Return between which marks the recording is incomplete, answer by answer, and how many answers it lacks.

    Returns
    -------
    doubtful : ndarray of bool, shape (count,)
        True where answers or a page are missing between the marks on either side: what follows a lost command
        need not be the same.
    lost : int
        Answers that the journal counts from the first page within the recording on, and the recording lacks.
    """
    doubtful, lost = np.zeros(count, dtype=bool), 0
    last: Page | None = None
    before: tuple[int | None, int] = None, 0
    for (_, page), row in zip(pages, lying, strict=True):
        gap = last is None or page.session != last.session or page.number != last.number + 1
        for place, mark in zip(row, marks_of(page), strict=True):
            if place is not None:
                missing = 0 if before[0] is None else mark.count - before[1] - (place - before[0])
                doubtful[before[0] or 0 : place] |= gap or before[0] is None or missing != 0
                if last is not None and page.session == last.session:
                    lost += max(0, missing)
            before = place, mark.count
        last = page
    return doubtful, lost
