"""The whole classification of a machine's errors (v. Daake et al.): reach, ranking, combined budgets, meshes."""

from __future__ import annotations

import asyncio
import re
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from itertools import starmap
from multiprocessing import get_context
from typing import Any

import numpy as np

from ..errors import HexapodError, ModelError
from ..formats.texts import aligned, number
from ..machine.geometry import HexapodGeometry
from .budget import BY_NAME, Budget, SingleErrors
from .combined import CONFIDENCE, Allocation, MonteCarlo, allocate, monte_carlo, worst_case
from .effects import EXACT, LINEAR, METHODS, Extremes, effect_vectors, effects, extremes, merged
from .ranking import RankingRow, ranked, ranking_rows, ranking_text
from .reach import Reach, poses_at, reach
from .shells import Shell, shell

COMBINED_POSES = 500  # Random poses of the workspace at which budgets are combined
DRAWS = 4000  # Machines of the Monte Carlo
LAYERS = (0.4, 0.7, 1.0)  # Nested shells, as shares of the way from the centre to the boundary
RINGS, SECTORS = 19, 36  # Mesh of a shell


@dataclass(frozen=True)
class Study:
    """A machine's errors, classified.

    Attributes
    ----------
    geometry : HexapodGeometry
        The machine.
    budget : Budget
        How large its errors may be.
    errors : SingleErrors
        Every single one.
    reaches : tuple of Reach
        What it reaches, one for each orientation.
    extremes : Extremes
        Largest and smallest effects.
    rows : tuple of RankingRow
        The ranked table.
    worst_case : ndarray
        The budget as a whole, the largest effect at random poses of the workspace, shape (2,), m and rad.
    monte_carlo : MonteCarlo
        The same of machines with uniform errors within the budget's bounds.
    allocation : Allocation or None
        What the errors may be; None when no tool error is given.
    """

    geometry: HexapodGeometry
    budget: Budget
    errors: SingleErrors
    reaches: tuple[Reach, ...]
    extremes: Extremes
    rows: tuple[RankingRow, ...]
    worst_case: np.ndarray
    monte_carlo: MonteCarlo
    allocation: Allocation | None


def classify(
    geometry: HexapodGeometry,
    budget: Budget,
    reaches: tuple[Reach, ...] | None = None,
    method: str = EXACT,
    allowed: float | None = None,
    workers: int = 1,
    scheduler: str | None = None,
    seed: int = 0,
    progress: Callable[[int], object] = lambda count: None,
    shared_platform_joints: bool = True,
) -> Study:
    """Classify a machine's errors over its workspace.

    Parameters
    ----------
    geometry, budget : HexapodGeometry, Budget
        The machine and the sizes of its errors.
    reaches : tuple of Reach, optional
        By default what is reached with the tool as at home.
    method, allowed : str, float, optional
        ``exact`` or ``linear``, for the ranking; displacement of the tool to allocate tolerances for, m.
    seed : int
        Of the poses at which errors are combined, and of the Monte Carlo.
    workers, scheduler, progress, shared_platform_joints
        As for :func:`~.study.survey`, and for :meth:`~.sources.Budget.single_errors`.

    Raises
    ------
    ModelError
        The budget is another machine's, the method is unknown, or the allowed error is not above zero.
    """
    if method not in METHODS:
        raise ModelError("method", f"must be one of {', '.join(METHODS)}", method)
    errors = budget.single_errors(geometry, shared_platform_joints)
    reaches = (reach(geometry),) if reaches is None else reaches
    extremes = survey(reaches, errors, method, workers, scheduler, progress)
    vectors = effect_vectors(geometry, errors, *random_poses(reaches, COMBINED_POSES, seed), LINEAR)
    vectors = vectors[np.isfinite(vectors).all(axis=(1, 2))]  # at the poses where all effects are known
    return Study(
        *(geometry, budget, errors, reaches, extremes),
        rows=tuple(ranked(extremes, geometry)),
        worst_case=worst_case(errors, vectors).max(axis=0),
        monte_carlo=monte_carlo(vectors, DRAWS, seed=seed),
        allocation=None if allowed is None else allocate(errors, vectors, allowed),
    )


def random_poses(reaches: tuple[Reach, ...], count: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Return platform poses drawn from all reaches, (n, 3), m, and (n, 3, 3); all of them where there are fewer."""
    sizes = np.array([int(one.within.sum()) for one in reaches])
    first = np.cumsum([0, *sizes])
    chosen = np.random.default_rng(seed).choice(first[-1], min(count, first[-1]), replace=False)
    poses = []
    for n, one in enumerate(reaches):  # one after the other: all poses of all reaches may be too many to hold
        members = chosen[(chosen >= first[n]) & (chosen < first[n + 1])] - first[n]
        poses.append(poses_at(one.geometry, one.points()[members], one.rotation))
    positions, rotations = (np.concatenate([pose[k] for pose in poses]) for k in range(2))
    return positions, rotations


def shells_of(reaches: tuple[Reach, ...]) -> tuple[Shell, ...]:
    """Return the boundary meshes of some reaches."""
    return tuple(shell(one, RINGS, SECTORS) for one in reaches)


def mesh_effects(study: Study, body: Shell) -> tuple[np.ndarray, np.ndarray]:
    """Return nested meshes of a shell and every error's effect on them."""
    points = np.stack([body.scaled(fraction) for fraction in LAYERS])
    poses = [body.platform_poses(fraction) for fraction in LAYERS]
    positions, rotations = (np.concatenate([pose[k] for pose in poses]) for k in range(2))
    values = effects(study.geometry, study.errors, positions, rotations, EXACT)
    return points, np.moveaxis(values.reshape(*points.shape[:3], len(study.errors), 2), (3, 4), (0, 1))


# Extremes over any number of poses, part by part: the same bits in this process, in several, or on a cluster.

WAIT = 10  # For a cluster to answer, s
PART = 65_536  # Poses per part: some seconds of work, and a few megabytes to send
Part = tuple[Any, ...]  # Arguments of :func:`look_at`


def look_at(
    geometry: HexapodGeometry, errors: SingleErrors, points: np.ndarray, rotation: np.ndarray, method: str,
    threads: int | None,
) -> Extremes:  # fmt: skip
    """Return the extremes over a part, tool tips (N, 3), m, of one orientation; the function that workers run."""
    return extremes(geometry, errors, *poses_at(geometry, points, rotation), method, threads)


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
        found: Iterable[Extremes] = _on_cluster(parts, scheduler)
    else:
        found = starmap(look_at, parts) if alone else _in_processes(parts, workers)

    def counted() -> Iterator[Extremes]:
        for part in found:
            progress(part.poses)
            yield part

    return merged(counted())


def _parts(reaches: Iterable[Reach], errors: SingleErrors, method: str, threads: int | None) -> Iterator[Part]:
    for one in reaches:
        points = one.points()
        for start in range(0, len(points), PART):
            yield one.geometry, errors, points[start : start + PART], one.rotation, method, threads


def _in_processes(parts: Iterable[Part], workers: int) -> Iterator[Extremes]:
    """Yield the parts' extremes in order, from local processes; an interruption ends these."""
    pool = ProcessPoolExecutor(workers, mp_context=get_context("spawn"))
    try:
        yield from pool.map(look_at, *zip(*parts, strict=True))
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
        for future in client.map(look_at, *zip(*parts, strict=True), pure=False):
            yield future.result()


# What a classification prints.

EACH = ("alone", "only", "without", "equal")  # figures of an allocation for each type


def report(study: Study, names: Sequence[str]) -> str:
    """Return the report of a study; `names` are those of its orientations."""
    ranking = ranking_text(study.rows)
    counts = f"{len(study.errors)} single errors of {len(study.errors.kinds)} types at {study.extremes.poses} poses"
    headline = f"machine {study.geometry.name}: {counts}"
    parts = [headline, _reach_table(study, names), ranking, _combined_text(study)]
    parts += [] if study.allocation is None else [_allocation_text(study, study.allocation)]
    return "\n\n".join(parts) + "\n"


def _reach_table(study: Study, names: Sequence[str]) -> str:
    """Return volume, size and limits of the workspace at each orientation."""
    rows = []
    for name, one in zip(names, study.reaches, strict=True):
        size = " × ".join(f"{side * 1e3:.0f}" for side in np.ptp(one.box, axis=0))
        limits = ", ".join(f"{cause} {100.0 * share:.0f} %" for cause, share in one.shares().items())
        rows.append((name, number(one.volume * 1e6, 1), size, str(one.parts), limits))
    head = ("tilted from home", "volume cm³", "box in work mm", "pieces", "limited by (share of the boundary)")
    return aligned(head, rows)


def _combined_text(study: Study) -> str:
    """Return the combined errors of the whole budget."""
    drawn, rows = study.monte_carlo, [("worst case", *_both(study.worst_case), "")]
    for n, percentile in enumerate(drawn.percentiles):
        cells = _both(drawn.values[n])
        bounds = f"({_both(drawn.low[n])[0]}…{_both(drawn.high[n])[0]} µm with {100.0 * CONFIDENCE:.0f} %)"
        rows.append((f"{percentile:g} % of {drawn.draws} machines", *cells, bounds))
    head = ("whole budget, worst pose", "transl. µm", "rot. m°", "")
    return aligned(head, rows) + "\nmachines: all errors uniform within their bounds, each machine's worst pose"


def _both(values: np.ndarray) -> tuple[str, str]:
    return number(float(values[0]) * 1e6, 2), number(float(np.degrees(values[1])) * 1e3, 2)


def _allocation_text(study: Study, allocation: Allocation) -> str:
    """Return the largest size of each error."""
    head = (
        f"allowed {allocation.allowed * 1e6:g} µm, worst case: the budget adds up to "
        f"{allocation.combined * 1e6:.2f} µm; all errors may be {allocation.scale:.3g} times as large.\n"
        "For each type: its sum alone, the sum of the others, and its largest size with the others unchanged or with "
        "equal shares:"
    )
    header = ("type", "now ±", "alone µm", "the others µm", "may be, the others as now", "may be, equal parts", "")
    rows = []
    for n, (name, size) in enumerate(study.budget.sizes.items()):
        unit, factor = {"length": ("µm", 1e6), "ratio": ("ppm", 1e6)}[BY_NAME[name].dimension]
        now = size * factor
        sums = (number(value * 1e6, 2) for value in (allocation.only[n], allocation.without[n]))
        left = _may_be(now, allocation.alone[n], "nothing is left")
        rows.append((study.errors.kinds[n], number(now, 2), *sums, left, _may_be(now, allocation.equal[n]), unit))
    return head + "\n" + aligned(header, rows)


def _may_be(now: float, factor: float, none: str = "") -> str:
    """Return the allowed size, by its factor."""
    return none if np.isnan(factor) else "anything" if np.isinf(factor) else number(now * factor, 2)


def as_json(study: Study) -> dict[str, Any]:
    """Return a study as plain numbers; units are in the keys."""
    drawn, allocated = study.monte_carlo, study.allocation
    allocations = []
    if allocated is not None:
        by_type = {name: dict(zip(study.errors.kinds, getattr(allocated, name), strict=True)) for name in EACH}
        allocations.append({"method": "worst_case", **vars(allocated), **by_type})
    return {
        "machine": study.geometry.name,
        "frame": "work",
        "budget_si": study.budget.sizes,
        "poses": study.extremes.poses,
        "ranking": ranking_rows(study.rows),
        "reach": [{"volume_m3": item.volume, "box_m": item.box, "limits": item.shares()} for item in study.reaches],
        "combined_m_rad": {
            "worst_case": study.worst_case,
            "percentiles": dict(zip(drawn.percentiles, drawn.values, strict=True)),
        },
        "allocations_m": allocations,
    }
