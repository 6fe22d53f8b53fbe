"""Which blocks of parameters a fit keeps: those that help on readings that it has not seen.

Where these are too few to tell, the readings' probability with and without a block decides.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from .blocks import HARMONICS
from .estimator import LinearProblem, Posterior, at_once, condense, held_out_squares, log_evidence, solve
from .parameters import ParameterSpace

FIRST_ROUNDS, ROUNDS = 10, 4
"""Rounds of estimating tolerances and noise: for all blocks, and for each set with fewer, which starts there."""

SILENT = 1e-9
"""Parameters of which readings determine a smaller share with all blocks in are left out: they move nothing."""

CLEAR = 2.0
"""The folds tell whether a block helps if its gain is so many times its standard error from zero. Otherwise it helps if
the readings are as much more probable with it as with a number that is found so many standard errors from zero."""

LEAST_GAIN = 1e-4
"""A block does not help when its gain is below this: it is rounding, which depends on the libraries, or of no use."""

RARE = (HARMONICS, ("backlash map",))
"""What not every screw has, and no general block explains: harmonics, and wear."""

EXPECTED = ("pitch", "wave", "backlash", "expansion", "moisture", "late")
"""Errors that every screw has, and growth: they stay when they help at all. Of a length map or a field nobody knows
beforehand."""


@dataclass(frozen=True)
class Decision:
    """What became of one block.

    Attributes
    ----------
    block : str
        Its name.
    kept : bool
        Whether it stays.
    gain : float
        By which share it lowers (above zero) the mean squared error of held-out readings, given the blocks
        that were in when it was decided on.
    uncertainty : float
        Standard error of the gain over the folds.
    evidence : float
        By how much the logarithm of the readings' probability is larger with it.
    """

    block: str
    kept: bool
    gain: float
    uncertainty: float
    evidence: float


class Gain(NamedTuple):
    """What blocks bring: the attributes of a :class:`Decision`."""

    share: float
    uncertainty: float
    evidence: float

    @property
    def clear(self) -> bool:
        """Whether they help clearly."""
        if abs(self.share) > CLEAR * self.uncertainty:
            return self.share > LEAST_GAIN
        return 2.0 * self.evidence > CLEAR**2


def select(
    space: ParameterSpace, problem: LinearProblem, noise: np.ndarray, progress: Callable[[str], object]
) -> tuple[list[Decision], Posterior, Posterior]:
    """Decide on each block by leaving out one line, or one scattered pose, after the other.

    Where there is only one, nothing is left to fit without it, and no block is kept.

    All blocks start in. The screw waves' harmonics go first, if all together do not help clearly, and the wear of the
    screws in the same way. Then the general block that helps least goes, until every one that is left helps clearly;
    then the harmonics that do not help clearly, and the expected ones that do not even seem to help. Taking them in one
    by one instead can let a field explain what a length map does better.

    Parameters
    ----------
    space : ParameterSpace
        All blocks that may be used.
    problem : LinearProblem
        The data, linearised near the answer.
    noise : ndarray, shape (kinds,)
        Noise factors in which errors are weighed, the same for all candidates.
    progress : callable
        Told about every candidate.

    Returns
    -------
    list of Decision, Posterior, Posterior
        One decision for each block but the structure; with all blocks in, what the data allow if nothing is out; and
        the fit with the blocks that stay.
    """
    trials = _Trials(space, problem, noise, progress)
    names = [b.name for b in space.blocks[1:]]
    kept = list(names)
    gains: dict[str, Gain] = {}
    rare = [part for every in RARE if (part := tuple(name for name in every if name in names))]
    for part in rare:
        gains |= dict.fromkeys(part, trials.gains(kept, [part])[0])
        kept = [name for name in kept if name not in part or gains[name].clear]
    trials.leave_out_the_rest(kept)
    general = [name for name in names if name not in (*EXPECTED, *gains)]
    while True:
        # A block that helps clearly beside all others helps no less when some of them have gone.
        doubtful = [name for name in general if name in kept and not (name in gains and gains[name].clear)]
        gains |= trials.single_gains(kept, doubtful)
        doubtful = [name for name in doubtful if not gains[name].clear]
        if not doubtful:
            break
        kept.remove(min(doubtful, key=lambda name: gains[name].share / max(gains[name].uncertainty, 1e-12)))
    for part in (part for part in rare if len(part) > 1):
        gains |= trials.single_gains(kept, [name for name in part if name in kept])
        kept = [name for name in kept if name not in part or gains[name].clear]
    gains |= trials.single_gains(kept, [name for name in names if name in EXPECTED])
    useful = [name for name in EXPECTED if name in kept and (gains[name].share > LEAST_GAIN or gains[name].clear)]
    kept = [name for name in kept if name not in EXPECTED or name in useful]
    decisions = [Decision(name, name in kept, *gains[name]) for name in names]
    return decisions, trials.everything, trials.fit(kept)


class _Trials:
    """Fits with sets of blocks and their held-out errors, each computed once."""

    def __init__(
        self, space: ParameterSpace, problem: LinearProblem, noise: np.ndarray, progress: Callable[[str], object]
    ) -> None:
        self._space, self._problem, self._noise, self._progress = space, problem, noise, progress
        self._fits: dict[frozenset[str], Posterior] = {}
        self._known: dict[frozenset[str], tuple[np.ndarray, float]] = {}
        self.everything = solve(space, problem, space.start_tolerances(), noise, FIRST_ROUNDS)
        self._silent = self.everything.used[self.everything.determined < SILENT]
        self._condensed = condense(problem, self.everything)

    def single_gains(self, names: Sequence[str], blocks: Sequence[str]) -> dict[str, Gain]:
        """Return what each of some blocks brings, by its name; as :meth:`gains`."""
        return dict(zip(blocks, self.gains(names, [(block,) for block in blocks]), strict=True))

    def gains(self, names: Sequence[str], parts: Sequence[tuple[str, ...]]) -> list[Gain]:
        """Return what parts of the blocks `names` bring, each alone."""
        sets = [frozenset(names), *(frozenset(names) - frozenset(part) for part in parts)]
        new = [blocks for blocks in dict.fromkeys(sets) if blocks not in self._known]
        for blocks in new:
            self._progress(f"trying {', '.join(name for name in names if name in blocks)}")
        self._known |= dict(zip(new, at_once(self._outcome, new), strict=True))
        with_it, *others = (self._known[blocks] for blocks in sets)
        return [_gain(with_it, without) for without in others]

    def leave_out_the_rest(self, names: Collection[str]) -> None:
        """Look at folds by fewer rows from here on: all that is tried are parts of the blocks `names`."""
        if len(names) < len(self._space.blocks) - 1:  # else none is left out
            self._condensed = condense(self._problem, self.fit(names))

    def fit(self, names: Collection[str]) -> Posterior:
        """Return the fit with the structure and a set of blocks."""
        key = frozenset(names)
        if key not in self._fits:
            kept = [block.name in key or n == 0 for n, block in enumerate(self._space.blocks)]
            tolerances = np.where(kept, self.everything.tolerances, 0.0)
            self._fits[key] = solve(self._space, self._problem, tolerances, self._noise, ROUNDS, self._silent)
        return self._fits[key]

    def _outcome(self, names: Collection[str]) -> tuple[np.ndarray, float]:
        """Return the summed squared errors of each fold, in fixed units, and the log evidence, of a set of blocks."""
        posterior = self.fit(names)
        of_folds = held_out_squares(self._problem, self._condensed, posterior) @ self._noise**-2
        return of_folds, log_evidence(self._problem, posterior)


def _gain(with_it: tuple[np.ndarray, float], without: tuple[np.ndarray, float]) -> Gain:
    """Return what blocks bring, by the squared errors of folds and the log evidence with and without them."""
    if len(without[0]) < 2:
        return Gain(0.0, 0.0, 0.0)
    less = (without[0] - with_it[0]) / max(without[0].sum(), np.finfo(float).tiny)
    return Gain(float(less.sum()), float(np.sqrt(len(less) * less.var())), with_it[1] - without[1])
