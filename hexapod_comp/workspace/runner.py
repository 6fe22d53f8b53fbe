"""Extremes of effects over any number of poses: part by part, in this process, in several, or on a cluster.

Parts are independent and are merged in the order of their poses, so that the numbers are the same to the last
bit wherever they come from.
"""

from __future__ import annotations

import asyncio
import re
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from multiprocessing import get_context
from typing import Any

import numpy as np

from ..errors import HexapodError
from ..machine.geometry import HexapodGeometry
from .effects import EXACT, Extremes, extremes, merged
from .reach import Reach, poses_at
from .sources import SingleErrors

WAIT = 10
"""For a cluster to answer, s."""

PART = 65_536
"""Poses per part: some seconds of work, and a few megabytes to send."""


@dataclass(frozen=True)
class Part:
    """Poses of one orientation that are looked at together."""

    geometry: HexapodGeometry  # The machine
    errors: SingleErrors  # The errors
    points: np.ndarray  # (N, 3): tool tips in the work frame, m
    rotation: np.ndarray  # (3, 3): orientation of the tool in the work frame
    method: str  # As for :func:`~hexapod_comp.workspace.effects.extremes`
    first: int  # Number of the first pose
    threads: int | None  # Threads to use


def look_at(part: Part) -> Extremes:
    """Return the extremes over a part; the function that workers run."""
    poses = poses_at(part.geometry, part.points, part.rotation)
    return extremes(part.geometry, part.errors, *poses, part.method, part.first, part.threads)


def survey(
    reaches: Iterable[Reach],
    errors: SingleErrors,
    method: str = EXACT,
    workers: int = 1,
    scheduler: str | None = None,
    progress: Callable[[int], object] = lambda count: None,
) -> Extremes:
    """Return the extremes of every error's effect over all grid points within some reaches."""
    alone = workers <= 1 and scheduler is None
    parts = _parts(reaches, errors, method, None if alone else 1)
    if scheduler is not None:
        extremes = _on_cluster(parts, scheduler)
    elif alone:
        extremes = map(look_at, parts)
    else:
        extremes = _in_processes(parts, workers)
    return merged(_counted(extremes, progress))


def _parts(reaches: Iterable[Reach], errors: SingleErrors, method: str, threads: int | None) -> Iterator[Part]:
    first = 0
    for reach in reaches:
        points = reach.points()
        for start in range(0, len(points), PART):
            chosen = points[start : start + PART]
            yield Part(reach.geometry, errors, chosen, reach.rotation, method, first, threads)
            first += len(chosen)


def _counted(extremes: Iterable[Extremes], progress: Callable[[int], object]) -> Iterator[Extremes]:
    for part in extremes:
        progress(part.poses)
        yield part


def _in_processes(parts: Iterable[Part], workers: int) -> Iterator[Extremes]:
    """Yield the parts' extremes in order, from local processes; an interruption ends these."""
    pool = ProcessPoolExecutor(workers, mp_context=get_context("spawn"))
    try:
        yield from pool.map(look_at, parts)
    except BrokenProcessPool as error:
        raise HexapodError("a worker process died (out of memory?); take fewer --workers") from error
    finally:
        pool.shutdown(wait=True, cancel_futures=True)


def _on_cluster(parts: Iterable[Part], scheduler: str) -> Iterator[Extremes]:
    """Yield the parts' extremes in order, from a Dask cluster."""
    if not re.fullmatch(r"(tcp|tls)://[^/\s]+:\d{1,5}", scheduler):
        raise HexapodError(f"a scheduler's address is like tcp://host:8786, not {scheduler!r}")
    try:
        from distributed import Client
    except ImportError as error:
        raise HexapodError("a cluster needs Dask: pip install distributed") from error
    try:
        client: Any = Client(scheduler, timeout=WAIT, set_as_default=False)
    except (OSError, ValueError) as error:
        raise HexapodError(f"no Dask scheduler answers at {scheduler!r}: {error}") from error
    with client:
        try:
            client.wait_for_workers(1, timeout=WAIT)
        except (TimeoutError, asyncio.TimeoutError) as error:
            raise HexapodError(f"the Dask scheduler at {scheduler!r} has no workers") from error
        for future in client.map(look_at, list(parts), pure=False):
            yield future.result()
