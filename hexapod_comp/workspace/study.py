"""The whole classification of a machine's errors (v. Daake et al.): reach, ranking, combined budgets, meshes."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from ..machine.geometry import HexapodGeometry
from .combining import RSS, WORST_CASE, Allocation, MonteCarlo, allocate, monte_carlo, root_sum_of_squares, worst_case
from .effects import EXACT, LINEAR, Extremes, effect_vectors, effects
from .ranking import RankingRow, ranked
from .reach import Reach, poses_at, reach
from .runner import survey
from .shells import Shell, shell
from .sources import LENGTH, TOOL, Budget, SingleErrors
from .tangential import tangential_effects

COMBINED_POSES = 500
"""Random poses of the workspace at which budgets are combined."""

WAYS = (RSS, WORST_CASE)
"""How errors add up where tolerances are allocated."""

DRAWS = 4000
"""Machines of the Monte Carlo."""

LAYERS = (0.4, 0.7, 1.0)
"""Nested shells, as shares of the way from the centre to the boundary."""

RINGS, SECTORS = 19, 36
"""Mesh of a shell."""


@dataclass(frozen=True)
class Combined:
    """What the whole budget does at random poses of the workspace; columns are m and rad."""

    worst_case: np.ndarray  # (2,): largest over the poses
    root_sum_of_squares: np.ndarray  # (2,): largest over the poses
    monte_carlo: MonteCarlo  # Uniform errors within the budget's bounds


@dataclass(frozen=True)
class Agreement:
    """How the three methods agree at random poses."""

    effects: int  # How many were compared
    linear: float  # Largest difference to the exact displacement, over the largest exact one of the same error type
    tangential: float  # Largest difference to the exact displacement, over the largest exact one of the same error type
    drift: float  # Largest length error of a passive leg over the travel of the active one, for legs of wrong length


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
    combined : Combined
        The budget as a whole.
    allocations : tuple of Allocation
        What the errors may be, by both methods; empty when no tool error is given.
    agreement : Agreement or None
        How exact, linear and tangential effects compare; None when not asked for.
    """

    geometry: HexapodGeometry
    budget: Budget
    errors: SingleErrors
    reaches: tuple[Reach, ...]
    extremes: Extremes
    rows: tuple[RankingRow, ...]
    combined: Combined
    allocations: tuple[Allocation, ...]
    agreement: Agreement | None


def classify(
    geometry: HexapodGeometry,
    budget: Budget,
    reaches: tuple[Reach, ...] | None = None,
    method: str = EXACT,
    allowed: float | None = None,
    compare: int = 0,
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
        From :func:`~hexapod_comp.workspace.reach.reaches`; by default what is reached with the tool as at home.
    method, allowed : str, float, optional
        ``exact``, ``linear`` or ``iteration``, for the ranking; displacement of the tool to allocate tolerances for, m.
    compare, seed : int
        Poses at which exact, linear and tangential effects are compared, 0 for none; the seed picks them.
    workers, scheduler, progress, shared_platform_joints
        As for :func:`~.runner.survey`, and for :meth:`~.sources.Budget.single_errors`.

    Raises
    ------
    ModelError
        The budget is another machine's, or the allowed error is not above zero.
    """
    errors = budget.single_errors(geometry, shared_platform_joints)
    reaches = (reach(geometry),) if reaches is None else reaches
    extremes = survey(reaches, errors, method, workers, scheduler, progress)
    vectors = _finite(effect_vectors(geometry, errors, *random_poses(reaches, COMBINED_POSES, seed), LINEAR))
    return Study(
        *(geometry, budget, errors, reaches, extremes),
        rows=tuple(ranked(extremes, geometry)),
        combined=_combined(errors, vectors, seed),
        allocations=() if allowed is None else tuple(allocate(errors, vectors, allowed, way) for way in WAYS),
        agreement=compared(geometry, errors, reaches, compare, seed) if compare else None,
    )


def _finite(vectors: np.ndarray) -> np.ndarray:
    """Return the effects at the poses where all are known."""
    return vectors[np.isfinite(vectors).all(axis=(1, 2))]


def _combined(errors: SingleErrors, vectors: np.ndarray, seed: int) -> Combined:
    """Return the worst of all errors at once over the poses of some effects."""
    return Combined(
        worst_case=worst_case(errors, vectors).max(axis=0),
        root_sum_of_squares=root_sum_of_squares(vectors).max(axis=0),
        monte_carlo=monte_carlo(vectors, DRAWS, seed=seed),
    )


def random_poses(reaches: tuple[Reach, ...], count: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Return platform poses picked from all reaches alike, (n, 3), m, and (n, 3, 3); all where there are few."""
    sizes = np.array([int(one.within.sum()) for one in reaches])
    first = np.cumsum([0, *sizes])
    chosen = np.random.default_rng(seed).choice(first[-1], min(count, first[-1]), replace=False)
    poses = []
    for n, one in enumerate(reaches):  # one after the other: all poses of all reaches may be too many to hold
        members = chosen[(chosen >= first[n]) & (chosen < first[n + 1])] - first[n]
        poses.append(poses_at(one.geometry, one.points()[members], one.rotation))
    positions, rotations = (np.concatenate([pose[k] for pose in poses]) for k in range(2))
    return positions, rotations


def compared(
    geometry: HexapodGeometry, errors: SingleErrors, reaches: tuple[Reach, ...], count: int, seed: int
) -> Agreement:
    """Compare the three methods at random poses of the workspace, all errors but the tool's."""
    moved = errors.select(errors.part != TOOL)
    positions, rotations = random_poses(reaches, count, seed)
    exact = effects(geometry, moved, positions, rotations, EXACT)[..., 0]
    linear = effects(geometry, moved, positions, rotations, LINEAR)[..., 0]
    walked, drift = np.empty_like(exact), 0.0
    for e in range(len(moved)):
        result = tangential_effects(geometry, moved, e, positions, rotations)
        walked[:, e] = np.linalg.norm(result.vectors[:, :3], axis=1)
        travelled = result.travel > 0.0
        if moved.part[e] == LENGTH and travelled.any():
            drift = max(drift, float((result.drift[travelled] / result.travel[travelled]).max()))
    largest = np.array([exact[:, moved.kind == kind].max(initial=0.0) for kind in range(len(moved.kinds))])
    scale = np.where(largest > 0.0, largest, np.inf)[moved.kind]
    return Agreement(
        effects=exact.size,
        linear=float((np.abs(linear - exact) / scale).max()),
        tangential=float((np.abs(walked - exact) / scale).max()),
        drift=drift,
    )


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
