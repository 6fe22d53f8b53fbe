"""Check of tool poses against all limits of a machine before it moves.

The compensator refuses a command at the first broken limit; this check computes all limits at all poses, for all struts
and both stages (nominal and compensated strut lengths).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np

from ..core import Status
from ..core.batch import QUANTITIES, examine_poses
from ..errors import GeometryError, HexapodError, LimitError, NotConvergedError, NotFiniteError, OutsideFieldError
from ..machine.geometry import STRUT_NAMES, HexapodGeometry
from ..machine.limits import REASONS, STAGES
from ..machine.model import MachineModel, MotionState, RealMachine
from ..machine.passes import Poses
from ..machine.trajectory import moves
from ..pose import Pose, stacked

# Limits for which the check computes margins, in the order in which reports list the limits
LIMITS = ("stroke", "base_cone", "platform_cone", "clearance", "condition", "correction", "step", "speed")

OTHER_FINDINGS = ("assembly", "not_converged", "outside_field")  # Reasons for a refusal that have no margin

# A list of poses is checked as single poses, as targets that are joined by moves, or as consecutive commands
MODES = ("poses", "moves", "stream")

RATES = (1.0, 10_000.0)  # Allowed command rates, Hz
CHUNK = 16_384  # Largest number of poses per call of the core, which limits the memory for a long path


@dataclass(frozen=True)
class Breach:
    """A limit that is broken at a pose, or on the move to this pose."""

    row: int  # index of the pose
    share: float  # fraction of the move to the pose that is completed at the breach; 1.0: the breach is at the pose
    error: HexapodError  # a LimitError with value, allowed value, strut and stage, or another error of OTHER_FINDINGS

    @property
    def limit(self) -> str:
        return self.error.reason


@dataclass
class LimitSummary:
    """The smallest margins to one limit, SI: a row for each pose, a column each for nominal and compensated values."""

    margin: np.ndarray  # smallest distance to the limit; negative where it is broken; ∞ where no value was computed
    value: np.ndarray  # value that has the smallest margin; NaN where no value was computed
    strut: np.ndarray  # index of the strut that has the smallest margin; −1 for the condition number
    share: np.ndarray  # fraction of the move to the pose at which the margin is smallest; 1.0: at the pose
    # (row, strut) → (margin, value, stage, share) of the worst breach
    broken: dict[tuple[int, int], tuple[float, float, int, float]] = field(default_factory=dict, repr=False)

    @staticmethod
    def empty(count: int) -> LimitSummary:
        shape = (count, 2)
        return LimitSummary(np.full(shape, np.inf), np.full(shape, np.nan), np.full(shape, -1), np.ones(shape))

    def smallest(self) -> tuple[int, int] | None:
        """Return (row, stage) of the smallest margin; None if no value was compared with the limit."""
        index = int(self.margin.argmin())
        return None if np.isposinf(self.margin.flat[index]) else divmod(index, 2)

    def add(self, margin: np.ndarray, value: np.ndarray, owner: np.ndarray, share: np.ndarray) -> None:
        """Add n checked poses: the `value` that was compared with the limit, and its `margin`, (n, 2 stages, k struts).

        Pose i is on the move to checked pose ``owner[i]``; `owner` ascends. If the nominal and the compensated value
        break the limit by the same amount, the breach is reported for the nominal value.
        """
        margin = np.where(np.isnan(margin), -np.inf, margin)
        starts = np.flatnonzero(np.diff(owner, prepend=-1))
        rows, of_pose = owner[starts], margin.min(axis=2)
        for stage in range(2):
            first = np.lexsort((of_pose[:, stage], owner))[starts]  # the pose with the smallest margin in each row
            better = of_pose[first, stage] < self.margin[rows, stage]
            first, into = first[better], rows[better]
            strut = margin[first, stage].argmin(axis=1)
            self.margin[into, stage] = of_pose[first, stage]
            self.value[into, stage] = value[first, stage, strut]
            self.strut[into, stage] = strut if margin.shape[2] == 6 else -1
            self.share[into, stage] = share[first]
        pose, stages, strut = np.nonzero(margin < 0.0)
        order = np.lexsort((stages, margin[pose, stages, strut], strut, owner[pose]))
        pose, stages, strut = pose[order], stages[order], strut[order]
        new = np.ones(len(pose), dtype=bool)  # the worst breach of each row and strut comes first
        new[1:] = (np.diff(owner[pose]) != 0) | (np.diff(strut) != 0)
        for p, s, k in zip(pose[new], stages[new], strut[new], strict=True):
            key = int(owner[p]), int(k)
            breach = float(margin[p, s, k]), float(value[p, s, k]), int(s), float(share[p])
            if key not in self.broken or breach[0] < self.broken[key][0]:
                self.broken[key] = breach


@dataclass(frozen=True)
class CheckResult:
    """Result of :func:`check`.

    Attributes
    ----------
    mode : str
        One of :data:`MODES`.
    rate : float
        Commands per second, Hz.
    examined : int
        Number of checked poses, including the poses on the moves.
    limits : dict of str to LimitSummary
        Margins by the names in :data:`LIMITS`; ``clearance`` is missing if the machine has no clearance limit.
    breaches : list of Breach
        Broken limits in order of rows: for each row, limit and strut the worst breach.
    lengths : ndarray, shape (N, 2, 6)
        Strut lengths at the poses themselves, nominal and compensated, m.
    unchecked_moves : ndarray of bool, shape (N,)
        The move to this pose was not checked, because the pose at its start or at its end breaks a limit.
    outside_box : ndarray of bool, shape (N,)
        The pose lies outside the box in which the model was measured.
    outside_field : ndarray of bool, shape (N,)
        At the pose, or on the move to it, the error field's value is held at the boundary of the field's box.
    """

    mode: str
    rate: float
    examined: int
    limits: dict[str, LimitSummary]
    breaches: list[Breach]
    lengths: np.ndarray
    unchecked_moves: np.ndarray
    outside_box: np.ndarray
    outside_field: np.ndarray

    @property
    def ok(self) -> bool:
        """Whether no limit is broken; only moves from or to a pose that breaks a limit are left unchecked."""
        return not self.breaches


def check(
    geometry: HexapodGeometry,
    model: MachineModel,
    poses: Sequence[Pose] | tuple[np.ndarray, np.ndarray],
    mode: str = "moves",
    rate: float = 250.0,
    progress: Callable[[int], object] = lambda rows: None,
    senses: np.ndarray | None = None,
) -> CheckResult:
    """Check tool poses against all limits of a machine.

    Parameters
    ----------
    geometry : HexapodGeometry
        Nominal machine and limits.
    model : MachineModel
        Model that the compensator would use.
    poses : sequence of N Pose, or (ndarray, ndarray) of shape (N, 3) and (N, 3, 3)
        ``pose_tool_in_work``, m; as two arrays: positions and rotation matrices, for long paths.
    mode : str
        ``moves``: the poses are targets, joined by :func:`hexapod_comp.machine.trajectory.moves`, and the whole path
        is checked. ``stream``: the poses are consecutive commands, and step and speed are checked too. ``poses``:
        each pose is checked by itself, with the directions of motion `senses`.
    rate : float
        Commands per second, Hz.
    progress : callable, optional
        Called with the number of poses that have just been checked.
    senses : ndarray, shape (N, 9), optional
        Directions of motion as in :class:`~hexapod_comp.machine.model.MotionState`, for the mode ``poses``; by
        default unknown. In the modes ``moves`` and ``stream`` the directions of motion follow from the path.

    Raises
    ------
    GeometryError
        `rate` is outside :data:`RATES`, `mode` is unknown, or `senses` are given although `mode` is not ``poses``.
    ModelError
        The model belongs to another machine.
    """
    if not RATES[0] <= rate <= RATES[1]:
        raise GeometryError("--rate-hz", f"must lie in {RATES[0]:g}…{RATES[1]:g} Hz", rate)
    if mode not in MODES:
        raise GeometryError("mode", f"must be one of {', '.join(MODES)}", mode)
    if senses is not None and mode != "poses":
        raise GeometryError("senses", "may be given only in the mode 'poses'", mode)
    positions, rotations = stacked(poses)
    run = _PathCheck(geometry, model, len(positions), rate)
    if mode == "moves":
        run.check_moves(positions, rotations, progress)
    else:
        run.check_rows(positions, rotations, mode == "stream", progress, senses)
    return run.result(mode, geometry.platform_poses(positions, rotations))


class _PathCheck:
    """State of a running check: the machine, its motion along the path, and the smallest margins found so far."""

    def __init__(self, geometry: HexapodGeometry, model: MachineModel, count: int, rate: float) -> None:
        self.geometry, self.rate, self.count = geometry, rate, count
        self.machine = RealMachine(geometry, model)
        self.limits = tuple(name for name in LIMITS if name != "clearance" or geometry.limits.clearance)
        self.worst = {name: LimitSummary.empty(count) for name in (*self.limits, *OTHER_FINDINGS)}
        self.lengths = np.full((count, 2, 6), np.nan)
        self.unchecked = np.zeros(count, dtype=bool)
        self.outside_field = np.zeros(count, dtype=bool)
        self.examined = 0
        self._forget_motion()

    def _forget_motion(self) -> None:
        self.motion = MotionState()
        self.previous: np.ndarray = np.full((1, 2, 6), np.nan)

    def check_rows(
        self,
        positions: np.ndarray,
        rotations: np.ndarray,
        stream: bool,
        progress: Callable[[int], object],
        senses: np.ndarray | None = None,
    ) -> None:
        """Check the poses as consecutive commands if `stream` is True, else one by one with the directions `senses`."""
        for start in range(0, self.count, CHUNK):
            rows = np.arange(start, min(start + CHUNK, self.count))
            alike = [rows]
            if senses is not None:
                alike = np.split(rows, np.flatnonzero(np.diff(senses[rows], axis=0).any(axis=1)) + 1)
            for owner in alike:
                if senses is not None:
                    self.motion.sense[:] = senses[owner[0]]
                self.examine(positions[owner], rotations[owner], owner, np.ones(len(owner)), stream)
            progress(len(rows))

    def check_moves(self, positions: np.ndarray, rotations: np.ndarray, progress: Callable[[int], object]) -> None:
        """Check each pose, and then each move whose first and last pose break no limit."""
        self.check_rows(positions, rotations, False, lambda rows: None)
        progress(1)  # no move leads to the first row
        bad = np.zeros(self.count, dtype=bool)
        bad[[row for worst in self.worst.values() for row, _ in worst.broken]] = True
        self.unchecked[1:] = bad[1:] | bad[:-1]
        legs_at_once = max(1, int(CHUNK / self.rate))
        for start in range(0, self.count - 1, legs_at_once):
            part = np.arange(start, min(start + legs_at_once, self.count - 1) + 1)
            good = np.flatnonzero(~self.unchecked[part[1:]])
            for legs in np.split(good, np.flatnonzero(np.diff(good) > 1) + 1):
                if not len(legs):
                    continue
                rows = part[legs[0] : legs[-1] + 2]
                if rows[0] == 0 or self.unchecked[rows[0]]:
                    self._forget_motion()
                    self.examine(positions[rows[:1]], rotations[rows[:1]], rows[:1], np.ones(1), True)
                path, counts = moves(self.geometry, positions[rows], rotations[rows], self.rate)
                owner = np.repeat(rows[1:], counts)
                done = np.arange(len(owner)) - np.repeat(np.cumsum(counts) - counts, counts) + 1
                share = done / np.repeat(counts, counts)
                for first in range(0, len(owner), CHUNK):
                    cut = slice(first, first + CHUNK)
                    self.examine(path.positions[cut], path.rotations[cut], owner[cut], share[cut], True)
            progress(len(part) - 1)

    def examine(
        self, positions: np.ndarray, rotations: np.ndarray, owner: np.ndarray, share: np.ndarray, in_sequence: bool
    ) -> None:
        """Check n tool poses; pose i is at the fraction ``share[i]`` of the move to the pose of row ``owner[i]``.

        If `in_sequence` is True, the motion continues from the last pose of the previous call. A finding of
        OTHER_FINDINGS has no margin: −∞ is stored for poses with the finding, ∞ for poses without it.
        """
        poses = (np.ascontiguousarray(part) for part in self.geometry.platform_poses(positions, rotations))
        state, motion, limits = self.machine.state.at, self.motion, self.geometry.limits
        quantities, flags = examine_poses(state, *poses, not in_sequence, motion.low, motion.sense)
        unsolved = flags == Status.NOT_CONVERGED
        for name in QUANTITIES.names or ():
            quantities[name][unsolved, 1] = np.nan
        lengths, sign = quantities["lengths"], quantities["sign"][:, :, None]
        self.lengths[owner[share == 1.0]] = lengths[share == 1.0]
        self.examined += len(owner)
        self.outside_field[owner[flags == Status.OUTSIDE_FIELD]] = True
        with np.errstate(invalid="ignore", over="ignore"):
            correction = np.zeros_like(lengths)
            correction[:, 1] = lengths[:, 1] - lengths[:, 0]
            found = {**limits.margins(quantities), "correction": (limits.correction - np.abs(correction), correction)}
            for margin, _ in found.values():
                margin[unsolved, 1] = np.inf  # these poses are breaches of `not_converged`
            found["correction"][0][:, 0] = np.inf
            outside = (flags == Status.OUTSIDE_FIELD) & (self.machine.model.field.outside == "refuse")
            never = np.zeros(len(flags), dtype=bool)
            for name, is_so in (
                ("not_converged", np.stack([never, unsolved], axis=1)[:, :, None]),
                ("outside_field", np.stack([never, outside], axis=1)[:, :, None]),
                ("assembly", (sign != self.geometry.home_sign) & ~np.isnan(sign)),
            ):
                found[name] = np.where(is_so, -np.inf, np.inf), sign
            if in_sequence:
                changes = np.diff(np.concatenate([self.previous, lengths]), axis=0)
                self.previous = lengths[-1:].copy()
                found["step"] = limits.step - np.abs(changes), changes
                found["speed"] = limits.speed - np.abs(changes) * self.rate, changes * self.rate
                for name in ("step", "speed"):
                    # the first command has no previous command, so its step and speed break no limit
                    found[name][0][np.isnan(changes)] = np.inf
        for name, (margin, value) in found.items():
            self.worst[name].add(margin, value, owner, share)

    def result(self, mode: str, platforms: Poses) -> CheckResult:
        breaches = [
            Breach(row, share, self._error(name, strut, stage, value))
            for name, worst in self.worst.items()
            for (row, strut), (_, value, stage, share) in worst.broken.items()
        ]
        region = self.machine.model.measured
        outside = np.zeros(self.count, dtype=bool) if region is None else ~region.contains(*platforms)
        return CheckResult(
            mode=mode,
            rate=self.rate,
            examined=self.examined,
            limits={name: self.worst[name] for name in self.limits},
            breaches=sorted(breaches, key=lambda breach: breach.row),
            lengths=self.lengths,
            unchecked_moves=self.unchecked,
            outside_box=outside,
            outside_field=self.outside_field,
        )

    def _error(self, name: str, strut: int, stage: int, value: float) -> HexapodError:
        if name == "not_converged":
            return NotConvergedError()
        if name == "outside_field":
            return OutsideFieldError(
                "the measured point is outside the error field's box, and the field's policy `outside` is refuse"
            )
        if not np.isfinite(value) and name != "condition":
            return NotFiniteError(f"{STRUT_NAMES[strut]}: {name} cannot be computed, the pose is degenerate")
        if name == "speed":
            limit, speed = self.geometry.limits.speed, f"{abs(value) * 1e3:.3f} mm/s"
            problem = f"{STRUT_NAMES[strut]}: the {STAGES[stage]} length would change at {speed}"
            return LimitError("speed", f"{problem}, allowed {limit * 1e3:g} mm/s", value, limit, strut, STAGES[stage])
        without_strut = name in ("condition", "assembly")
        return self.geometry.limits.error(REASONS.index(name), -1 if without_strut else strut, stage, value)
