"""The classification of a machine's errors (Daake et al.): reach, ranking, combined errors, allocation, report."""

from __future__ import annotations

import asyncio
import os
import re
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from itertools import starmap
from multiprocessing import get_context, parent_process
from multiprocessing.process import BaseProcess
from threading import Thread
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
from .shells import ROTATION, TRANSLATION, Shell, shell

COMBINED_POSES = 500  # random poses of the workspace at which all errors together are evaluated
DRAWS = 4000  # machines of the Monte Carlo simulation
LAYERS = (0.4, 0.7, 1.0)  # scales of the nested shells; 1 is the boundary
RINGS, SECTORS = 19, 36  # numbers of rings and sectors of a shell's mesh


@dataclass(frozen=True)
class Study:
    """Classification of a machine's errors.

    Attributes
    ----------
    geometry : HexapodGeometry
        The machine.
    budget : Budget
        Sizes of the machine's errors.
    errors : SingleErrors
        All single errors of the budget.
    reaches : tuple of Reach
        Reachable workspace for each orientation of the tool.
    extremes : Extremes
        Largest and smallest effects of each error type.
    rows : tuple of RankingRow
        Ranking of the error types.
    worst_case : ndarray
        Largest effect of all errors together at random poses of the workspace, shape (2,), m and rad.
    monte_carlo : MonteCarlo
        Percentiles of the effect of all errors together, over machines with uniform errors within the budget's bounds.
    allocation : Allocation or None
        Allowed sizes of the errors; None if no allowed tool error was given.
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
        Reachable workspaces, one for each orientation; by default one at the orientation of home.
    method : str, optional
        How the effects in the ranking are computed, ``exact`` or ``linear``.
    allowed : float, optional
        Largest allowed displacement of the tool, m, for the allocation.
    seed : int
        Seed of the random poses and of the Monte Carlo simulation.
    workers, scheduler, progress, shared_platform_joints
        See :func:`~.study.survey` and :meth:`~.budget.Budget.single_errors`.

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
    vectors = vectors[np.isfinite(vectors).all(axis=(1, 2))]  # without poses at which an effect is unknown
    return Study(
        *(geometry, budget, errors, reaches, extremes),
        rows=tuple(ranked(extremes, geometry)),
        worst_case=worst_case(errors, vectors).max(axis=0),
        monte_carlo=monte_carlo(vectors, DRAWS, seed=seed),
        allocation=None if allowed is None else allocate(errors, vectors, allowed),
    )


def random_poses(reaches: tuple[Reach, ...], count: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Return platform positions, (n, 3), m, and rotations, (n, 3, 3), at up to `count` random points in `reaches`."""
    sizes = np.array([int(one.within.sum()) for one in reaches])
    first = np.cumsum([0, *sizes])
    chosen = np.random.default_rng(seed).choice(first[-1], min(count, first[-1]), replace=False)
    poses = []
    for n, one in enumerate(reaches):  # together, all poses of all reaches may need too much memory
        members = chosen[(chosen >= first[n]) & (chosen < first[n + 1])] - first[n]
        poses.append(poses_at(one.geometry, one.points()[members], one.rotation))
    positions, rotations = (np.concatenate([pose[k] for pose in poses]) for k in range(2))
    return positions, rotations


def shells_of(reaches: tuple[Reach, ...]) -> tuple[Shell, ...]:
    return tuple(shell(one, RINGS, SECTORS) for one in reaches)


def mesh_effects(study: Study, body: Shell) -> tuple[np.ndarray, np.ndarray]:
    """Return the points of a shell's S nested meshes, (S, H, A, 3), and all errors' effects there, (E, 2, S, H, A)."""
    points = np.stack([body.scaled(fraction) for fraction in LAYERS])
    poses = [body.platform_poses(fraction) for fraction in LAYERS]
    positions, rotations = (np.concatenate([pose[k] for pose in poses]) for k in range(2))
    values = effects(study.geometry, study.errors, positions, rotations, EXACT)
    return points, np.moveaxis(values.reshape(*points.shape[:3], len(study.errors), 2), (3, 4), (0, 1))


# Extremes are computed part by part: here, in several processes or on a cluster, always with equal bits

WAIT = 10  # longest wait for a cluster's answer, s
PART = 65_536  # poses per part: some seconds of work, and a few megabytes to send
Part = tuple[Any, ...]  # arguments of :func:`part_extremes`


def part_extremes(
    geometry: HexapodGeometry, errors: SingleErrors, points: np.ndarray, rotation: np.ndarray, method: str,
    threads: int | None,
) -> Extremes:  # fmt: skip
    """Return the errors' extreme effects with the tip at `points` (N, 3), m in ``work``; worker processes call it."""
    return extremes(geometry, errors, *poses_at(geometry, points, rotation), method, threads)


def survey(
    reaches: Iterable[Reach],
    errors: SingleErrors,
    method: str = EXACT,
    workers: int = 1,
    scheduler: str | None = None,
    progress: Callable[[int], object] = lambda count: None,
) -> Extremes:
    """Compute the extreme effects over all grid points in `reaches`, by `workers` processes or a Dask `scheduler`."""
    alone = workers <= 1 and scheduler is None
    parts = _parts(reaches, errors, method, None if alone else 1)
    if scheduler is not None:
        found: Iterable[Extremes] = _on_cluster(parts, scheduler)
    else:
        found = starmap(part_extremes, parts) if alone else _in_processes(parts, workers)

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


def process_pool(workers: int) -> ProcessPoolExecutor:
    """Return a pool of processes that end when this process ends, even if it is killed."""
    return ProcessPoolExecutor(workers, mp_context=get_context("spawn"), initializer=_end_with_parent)


def _end_with_parent() -> None:
    def wait(parent: BaseProcess) -> None:
        parent.join()
        os._exit(1)

    Thread(target=wait, args=(parent_process(),), daemon=True).start()


def _in_processes(parts: Iterable[Part], workers: int) -> Iterator[Extremes]:
    """Yield :func:`part_extremes` of each part, in order, from local processes that end if the study is interrupted."""
    pool = process_pool(workers)
    try:
        yield from pool.map(part_extremes, *zip(*parts, strict=True))
    except BrokenProcessPool as error:
        raise HexapodError("a worker process ended (out of memory?); use fewer --workers") from error
    finally:
        pool.shutdown(wait=True, cancel_futures=True)


def _on_cluster(parts: Iterable[Part], scheduler: str) -> Iterator[Extremes]:
    """Yield :func:`part_extremes` of each part, in order, from a Dask cluster."""
    if not re.fullmatch(r"(tcp|tls)://[^/\s]+:\d{1,5}", scheduler):
        raise HexapodError(f"a scheduler's address must be like tcp://host:8786, not {scheduler!r}")
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
        for future in client.map(part_extremes, *zip(*parts, strict=True), pure=False):
            yield future.result()


# The report

EACH = ("alone", "only", "without", "equal")  # of an Allocation, by error type


def report(study: Study, names: Sequence[str]) -> str:
    """Return the report of a study; `names` are those of its tool orientations."""
    ranking = ranking_text(study.rows)
    counts = f"{len(study.errors)} single errors of {len(study.errors.kinds)} types at {study.extremes.poses} poses"
    headline = f"machine {study.geometry.name}: {counts}"
    parts = [headline, _reach_table(study, names), ranking, _combined_text(study)]
    parts += [] if study.allocation is None else [_allocation_text(study, study.allocation)]
    return "\n\n".join(parts) + "\n"


def _reach_table(study: Study, names: Sequence[str]) -> str:
    rows = []
    for name, one in zip(names, study.reaches, strict=True):
        size = " × ".join(f"{side * 1e3:.0f}" for side in np.ptp(one.box, axis=0))
        limits = ", ".join(f"{cause} {100.0 * share:.0f} %" for cause, share in one.shares().items())
        rows.append((name, number(one.volume * 1e6, 1), size, str(one.parts), limits))
    head = ("tilted from home", "volume cm³", "box in work mm", "pieces", "limited by (share of the boundary)")
    return aligned(head, rows)


def _combined_text(study: Study) -> str:
    drawn, rows = study.monte_carlo, [("worst case", *_both(study.worst_case), "")]
    for n, percentile in enumerate(drawn.percentiles):
        cells = _both(drawn.values[n])
        bounds = f"({100.0 * CONFIDENCE:.0f} %: {_both(drawn.low[n])[0]}…{_both(drawn.high[n])[0]} µm)"
        rows.append((f"{percentile:g} % of {drawn.draws} machines", *cells, bounds))
    head = ("whole budget, worst pose", "transl. µm", "rot. m°", "")
    return aligned(head, rows) + "\nmachines: drawn with uniform errors within the bounds, each at its worst pose"


def _both(values: np.ndarray) -> tuple[str, str]:
    """Return texts of a displacement and a rotation: given in m and rad, written in µm and m°."""
    return number(float(values[0]) * TRANSLATION.factor, 2), number(float(values[1]) * ROTATION.factor, 2)


def _allocation_text(study: Study, allocation: Allocation) -> str:
    head = (
        f"allowed tool error {allocation.allowed * 1e6:g} µm; worst case of the budget {allocation.combined * 1e6:.2f} "
        f"µm: the sizes of all errors may be {allocation.scale:.3g} times those of the budget.\n"
        "For each type: the tool error by this type alone and by all other types; the allowed size of this type if the "
        "others keep their sizes, and if all types cause equal shares of the tool error:"
    )
    header = ("type", "size ±", "alone µm", "others µm", "allowed, others unchanged", "allowed, equal shares", "")
    rows = []
    for n, (name, size) in enumerate(study.budget.sizes.items()):
        unit, factor = {"length": ("µm", 1e6), "ratio": ("ppm", 1e6)}[BY_NAME[name].dimension]
        now = size * factor
        sums = (number(value * 1e6, 2) for value in (allocation.only[n], allocation.without[n]))
        sizes = (_allowed_size(now, factor) for factor in (allocation.alone[n], allocation.equal[n]))
        rows.append((study.errors.kinds[n], number(now, 2), *sums, *sizes, unit))
    return head + "\n" + aligned(header, rows)


def _allowed_size(now: float, factor: float) -> str:
    """Return the allowed size, `now` × `factor`, as text; :class:`~.combined.Allocation` explains NaN and ∞."""
    return "none: others exceed it" if np.isnan(factor) else "any" if np.isinf(factor) else number(now * factor, 2)


def as_json(study: Study) -> dict[str, Any]:
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
