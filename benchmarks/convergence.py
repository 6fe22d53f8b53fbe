"""Where forward kinematics converges, ours and LinuxCNC's genhexkins, and what their answers are worth.

genhexkins takes a small rotation for a change of roll, pitch and yaw. At a yaw ψ that turns its steps by ψ, so the
error left by a step is 2·sin(ψ/2) of the one before: linear convergence, and from 60° on none, however near the guess.

Run ``python -m benchmarks.convergence``; exits 1 when ours fails at a yaw of 60–80°, or calls something solved that
is not, 2 where there is no genhexkins (see :mod:`benchmarks.genhexkins`).
"""

from __future__ import annotations

import sys
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from hexapod_comp.core import Status, batch
from hexapod_comp.machine.kinematics import Structure, solve_one, strut_lengths_batch

from . import cannot_run, judged, table
from .genhexkins import Genhexkins, NotHere, emc_poses, si_poses
from .poses import make_poses

YAWS = np.array(
    [0.0, 10.0, 20.0, 30.0, 40.0, 50.0, 55.0, 60.0, 65.0, 70.0, 75.0, 80.0, 85.0]
)  # Where convergence is looked at, degrees


@dataclass(frozen=True)
class Convergence:
    """How many of `poses` poses at one yaw were solved, from guesses 1 mm and 1 mrad away."""

    yaw_deg: float
    poses: int
    ours: int  # Solved: the pose at which the lengths were taken, to 1 nm and 1e-8 rad
    theirs: int


@dataclass(frozen=True)
class Honesty:
    """What answers to far guesses are worth; each pair is ours, then genhexkins'."""

    poses: int
    solved: tuple[int, int]  # Said to be solved
    # … of these: not finite; struts of another length than asked for, by 1 nm; another assembly mode than
    # home
    not_finite: tuple[int, int]
    open_loops: tuple[int, int]
    other_mode: tuple[int, int]


@dataclass(frozen=True)
class _Answers:
    """Answers of one of the two: who said success, and poses (m)."""

    ok: np.ndarray
    positions: np.ndarray
    rotations: np.ndarray


def _ours(structure: Structure, lengths: np.ndarray, positions: np.ndarray, rotations: np.ndarray) -> _Answers:
    """Solve with the kernel from one guess each."""
    count = len(lengths)
    positions, rotations = positions.copy(), np.ascontiguousarray(rotations)
    outcomes, iterations, conditions = np.empty(count, np.intc), np.empty(count, np.intc), np.empty(count)
    limits = structure.characteristic_length, structure.home_sign, structure.max_condition
    problem = structure.base_joints, structure.platform_joints, lengths, positions, rotations
    batch.solve_poses(*problem, *limits, outcomes, iterations, conditions)
    return _Answers(outcomes == Status.OK, positions, rotations)


def _theirs(module: Genhexkins, lengths: np.ndarray, positions: np.ndarray, rotations: np.ndarray) -> _Answers:
    """Solve with genhexkins from one guess each."""
    codes, poses = module.solved(lengths, emc_poses(positions, rotations))
    finite = np.isfinite(poses).all(axis=1)
    found, turned = si_poses(np.where(finite[:, None], poses, 0.0))
    found[~finite], turned[~finite] = np.nan, np.nan
    return _Answers(codes == 0, found, turned)


def convergence(yaws: np.ndarray, count: int = 300) -> list[Convergence]:
    """Return who solves poses turned about z, from guesses as near as a controller's last pose."""
    machine, rng = make_poses(1), np.random.default_rng(4)
    structure, home = machine.structure, machine.home
    module, rows = Genhexkins(structure), []
    for yaw in yaws:
        positions = home.position + rng.uniform(-0.01, 0.01, (count, 3))
        angles = np.column_stack([rng.uniform(-3.0, 3.0, (count, 2)), np.full(count, yaw)])
        rotations = Rotation.from_euler("xyz", angles, degrees=True).as_matrix() @ home.rotation
        lengths = strut_lengths_batch(structure, positions, rotations)
        near = positions + rng.uniform(-1e-3, 1e-3, (count, 3))
        turned = Rotation.from_rotvec(rng.uniform(-1e-3, 1e-3, (count, 3))).as_matrix() @ rotations
        answers = _ours(structure, lengths, near, turned), _theirs(module, lengths, near, turned)
        right = [_same_pose(a, positions, rotations) for a in answers]
        rows.append(Convergence(float(yaw), count, *(int(r.sum()) for r in right)))
    return rows


def _same_pose(answers: _Answers, positions: np.ndarray, rotations: np.ndarray) -> np.ndarray:
    """Return where an answer is the pose looked for."""
    off = np.abs(answers.positions - positions).max(axis=1)
    turned = np.abs(answers.rotations - rotations).max(axis=(1, 2))
    return answers.ok & (off < 1e-9) & (turned < 1e-8)


def honesty(count: int = 20_000) -> Honesty:
    """Return what answers are worth when the guess is far: ±200 mm and ±90° about home, and lengths of any pose."""
    machine, rng = make_poses(1), np.random.default_rng(5)
    structure, home = machine.structure, machine.home
    positions = home.position + rng.uniform(-0.1, 0.1, (count, 3))
    rotations = Rotation.from_euler("xyz", rng.uniform(-40.0, 40.0, (count, 3)), degrees=True).as_matrix()
    lengths = strut_lengths_batch(structure, positions, rotations @ home.rotation)
    guess = home.position + rng.uniform(-0.2, 0.2, (count, 3))
    turned = Rotation.from_euler("xyz", rng.uniform(-90.0, 90.0, (count, 3)), degrees=True).as_matrix()
    module = Genhexkins(structure)
    answers = _ours(structure, lengths, guess, turned), _theirs(module, lengths, guess, turned)
    ours, theirs = (_worth(structure, a, lengths) for a in answers)
    return Honesty(count, *zip(ours, theirs, strict=True))


def _worth(structure: Structure, answers: _Answers, lengths: np.ndarray) -> tuple[int, int, int, int]:
    """Return the four counts of :class:`Honesty`, by NumPy's formulas and determinant."""
    finite = np.isfinite(answers.positions).all(axis=1) & np.isfinite(answers.rotations).all(axis=(1, 2))
    told = answers.ok & finite
    arms = structure.platform_joints @ np.swapaxes(answers.rotations[told], 1, 2)
    struts = answers.positions[told][:, None] + arms - structure.base_joints
    there = np.linalg.norm(struts, axis=2)
    open_loops = np.abs(there - lengths[told]).max(axis=1) > 1e-9
    signs = np.sign(np.linalg.det(np.concatenate([struts, np.cross(arms, struts)], axis=2)))
    other = signs != structure.home_sign
    return (int(answers.ok.sum()), int((answers.ok & ~finite).sum()), int(open_loops.sum()), int(other.sum()))


@dataclass(frozen=True)
class Trap:
    """A problem without a regular answer, started where the struts are as asked for, and what both say of it."""

    title: str
    ours: str  # Outcome, and what it has done to the pose given as a guess: LinuxCNC starts its next call from that
    theirs: str


def traps() -> list[Trap]:
    """Return what both say at singular poses of the machine, and when an encoder reads NaN."""
    machine = make_poses(1)
    structure, home = machine.structure, machine.home
    module, rows = Genhexkins(structure), []
    for yaw in (90.0, -90.0):
        turned = Rotation.from_euler("z", yaw, degrees=True).as_matrix() @ home.rotation
        lengths = strut_lengths_batch(structure, home.position[None], turned[None])
        rows.append(_sprung(module, f"home turned by {yaw:g}° about z: singular", structure, lengths, turned))
    lengths = strut_lengths_batch(structure, home.position[None], home.rotation[None])
    lengths[0, 2] = np.nan
    rows.append(_sprung(module, "home, strut 3 reads NaN", structure, lengths, home.rotation))
    return rows


def _sprung(module: Genhexkins, title: str, structure: Structure, lengths: np.ndarray, rotation: np.ndarray) -> Trap:
    """Ask both, from home's position and a rotation."""
    position = make_poses(1).home.position.copy()
    codes, poses = module.solved(lengths, emc_poses(position[None], rotation[None]))
    rotation = np.ascontiguousarray(rotation)
    outcome, _ = solve_one(structure, lengths[0], position, rotation)
    kept = np.isfinite(position).all() and np.isfinite(rotation).all()
    theirs = f"returns {codes[0]}, pose {'finite' if np.isfinite(poses).all() else 'NaN'}"
    return Trap(
        title,
        f"{'solved' if outcome == Status.OK else Status(outcome).name}, pose {'finite' if kept else 'NaN'}",
        theirs,
    )


def report(rows: list[Convergence], worth: Honesty, caught: list[Trap]) -> str:
    """Return the three tables."""
    pair = ["hexapod_comp", "genhexkins"]
    shares = (
        [name, *(f"{100.0 * getattr(row, which) / row.poses:.0f} %" for row in rows)]
        for name, which in zip(pair, ("ours", "theirs"), strict=True)
    )
    counts = [
        ("reported as solved", worth.solved),
        ("… with a pose that is not finite", worth.not_finite),
        ("… with struts of other lengths", worth.open_loops),
        ("… in another assembly mode", worth.other_mode),
    ]
    return "\n\n".join(
        [
            table(["yaw", *(f"{row.yaw_deg:.0f}°" for row in rows)], shares),
            table(["", *pair], ([title, *both] for title, both in counts)),
            table(["", *pair], ([trap.title, trap.ours, trap.theirs] for trap in caught), texts=3),
        ]
    )


def problems(rows: list[Convergence], worth: Honesty) -> list[str]:
    """Return whether ours fails at 60–80°, or reports as solved what is not."""
    failed = any(r.ours < r.poses for r in rows if 60.0 <= r.yaw_deg <= 80.0)
    false = worth.not_finite[0] + worth.open_loops[0] + worth.other_mode[0]
    texts = ("forward kinematics fails at a yaw of 60–80°", "forward kinematics reports as solved what is not")
    return [text for text, missed in zip(texts, (failed, false), strict=True) if missed]


def main() -> int:
    """Print the tables; exit 1 when ours misses a bar."""
    try:
        found = convergence(YAWS), honesty(), traps()
    except NotHere as reason:
        return cannot_run(str(reason))
    print(report(*found))
    return judged(problems(*found[:2]))


if __name__ == "__main__":
    sys.exit(main())
