"""Derivatives of the cells' values by the parameters: of each cell only those that may differ from zero.

A reading along x knows nothing of the field's other five components. Cells that the same parameters move stand
together in a dense matrix, which is a third of the whole or less.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import NamedTuple, TypeVar

import numpy as np
from scipy.linalg.lapack import dpstrf

from .unknowns import Unknown

FEW = 8
"""Fewer cells of a group are kept as they are."""

FAINT = 1e-11
"""What moves cells by less than this variance, of their noise's, does not count."""


Given = TypeVar("Given")
Result = TypeVar("Result")


def at_once(work: Callable[[Given], Result], items: Iterable[Given]) -> list[Result]:
    """Return the results of independent work with matrices: NumPy lets as many threads work as there are processors."""
    with ThreadPoolExecutor(len(os.sched_getaffinity(0))) as pool:
        return list(pool.map(work, items))


class Alike(NamedTuple):
    """Cells that the same parameters move.

    Attributes
    ----------
    cells : ndarray of int, shape (n,)
        Which.
    columns : ndarray of int, shape (m,)
        These parameters, ascending.
    values : ndarray, shape (n, m)
        Derivatives.
    """

    cells: np.ndarray
    columns: np.ndarray
    values: np.ndarray


class CellRows:
    """A matrix of a row for each cell and a column for each parameter.

    Parameters
    ----------
    shape : (int, int)
        Cells and parameters.
    parts : sequence of Alike
        Each cell stands in one of them.
    """

    def __init__(self, shape: tuple[int, int], parts: Sequence[Alike]) -> None:
        self.shape, self.parts = shape, tuple(parts)
        self._part, self._place = np.zeros(shape[0], dtype=int), np.zeros(shape[0], dtype=int)
        for n, part in enumerate(self.parts):
            self._part[part.cells], self._place[part.cells] = n, np.arange(len(part.cells))

    @staticmethod
    def of(matrix: np.ndarray) -> CellRows:
        """Return a dense matrix as such rows."""
        return CellRows(matrix.shape, [Alike(np.arange(len(matrix)), np.arange(matrix.shape[1]), matrix)])

    def dense(self) -> np.ndarray:
        """Return the whole matrix."""
        result = np.zeros(self.shape)
        for part in self.parts:
            result[np.ix_(part.cells, part.columns)] = part.values
        return result

    def times(self, y: np.ndarray) -> np.ndarray:
        """Return the product with y, (size,) or (size, k)."""
        result = np.zeros((self.shape[0], *y.shape[1:]))
        for part in self.parts:
            result[part.cells] = part.values @ y[part.columns]
        return result

    def transposed_times(self, v: np.ndarray) -> np.ndarray:
        """Return the transposed matrix's product with v, (C,) or (C, k)."""
        result = np.zeros((self.shape[1], *v.shape[1:]))
        for part in self.parts:
            result[part.columns] += part.values.T @ v[part.cells]
        return result

    def normal(self) -> np.ndarray:
        """Return rowsᵀ·rows, shape (size, size)."""
        result = np.zeros((self.shape[1], self.shape[1]))
        for part in self.parts:
            result[np.ix_(part.columns, part.columns)] += part.values.T @ part.values
        return result

    def between(self, matrix: np.ndarray, first: np.ndarray, second: np.ndarray) -> np.ndarray:
        """Return aᵀ·M·b for the rows a and b of pairs of cells, shape (pairs,)."""
        result = np.empty(len(first))
        for (p, q), pairs in _alike(self._part[first], self._part[second]):
            a, b = self.parts[p], self.parts[q]
            reached = a.values[self._place[first[pairs]]] @ matrix[np.ix_(a.columns, b.columns)]
            result[pairs] = np.einsum("ci,ci->c", reached, b.values[self._place[second[pairs]]])
        return result

    def select(self, cells: np.ndarray) -> CellRows:
        """Return the rows of some cells, in their order; without copying where they stand in a row."""
        owner, parts = self._part[cells], []
        for n in np.unique(owner):
            at = np.flatnonzero(owner == n)
            part = self.parts[n]
            parts.append(Alike(at, part.columns, part.values[in_a_row(self._place[cells[at]])]))
        return CellRows((len(cells), self.shape[1]), parts)

    def using(self, used: np.ndarray, factors: np.ndarray) -> CellRows:
        """Return the rows times a factor each, (C,), with the columns of some parameters only."""
        place = np.full(self.shape[1], -1)
        place[used] = np.arange(len(used))
        parts = []
        for part in self.parts:
            kept = np.flatnonzero(place[part.columns] >= 0)
            values = factors[part.cells, None] * part.values[:, in_a_row(kept)]
            parts.append(Alike(part.cells, place[part.columns[kept]], values))
        return CellRows((self.shape[0], len(used)), parts)

    def condensed(
        self, target: np.ndarray, group: np.ndarray, draws: np.ndarray
    ) -> tuple[CellRows, np.ndarray, np.ndarray]:
        """Return fewer rows that say the same, with their targets and groups.

        Cells of a group that the same parameters move are turned, orthogonally, so that a few of them have all that
        parameters do: some twenty along a line, however densely it was read. The others are left out.

        Parameters
        ----------
        target : ndarray, shape (C,)
            What the rows explain.
        group : ndarray of int, shape (C,)
            Of each cell.
        draws : ndarray, shape (size, D)
            Parameters as they may be, over √D.
        """

        def few_of(part: Alike) -> list[np.ndarray]:
            order = np.argsort(group[part.cells], kind="stable")
            pieces = np.split(order, np.flatnonzero(np.diff(group[part.cells[order]])) + 1)
            few = np.concatenate([np.zeros(0, dtype=int), *(piece for piece in pieces if len(piece) < FEW)])
            listed = [(part.values[few], target[part.cells[few]], group[part.cells[few]])]
            for piece in (piece for piece in pieces if len(piece) >= FEW):
                cells = part.cells[piece]
                rows, along = _moved(part.values[in_a_row(piece)], target[cells], draws[part.columns])
                listed.append((rows, along, np.full(len(along), group[cells[0]])))
            return [np.concatenate(arrays) for arrays in zip(*listed, strict=True)]

        parts, of_rows, count = [], [], 0
        for part, (values, *own) in zip(self.parts, at_once(few_of, self.parts), strict=True):
            parts.append(Alike(np.arange(count, count + len(values)), part.columns, values))
            of_rows.append(own)
            count += len(values)
        targets, groups = (np.concatenate(arrays) for arrays in zip(*of_rows, strict=True))
        return CellRows((count, self.shape[1]), parts), targets, groups

    def project_out(self, unknowns: Sequence[Unknown]) -> None:
        """Take off, in place, what unknowns of instruments may explain; the cells of each stand in one part."""
        owner = np.array([self._part[unknown.members[0]] for unknown in unknowns])

        def clear(part: int) -> None:
            for n in np.flatnonzero(owner == part).tolist():
                unknowns[n].project_out(self.parts[part].values, in_a_row(self._place[unknowns[n].members]))

        at_once(clear, range(len(self.parts)))


def _moved(values: np.ndarray, target: np.ndarray, draws: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return Qᵀ·values and Qᵀ·target, with the columns of Q an orthonormal basis of what draws of parameters do.

    A pivoted Cholesky factor tells which draws are enough; all cells are kept where none are.
    """
    shown = values @ draws
    _, pivots, rank, _ = dpstrf((shown.T @ shown).T, tol=FAINT, overwrite_a=1)
    if rank >= min(shown.shape):
        return values, target
    basis = np.linalg.qr(shown[:, pivots[:rank] - 1])[0].T
    return basis @ values, basis @ target


def in_a_row(indices: np.ndarray) -> np.ndarray | slice:
    """Return indices as a slice where they follow each other: then indexing copies nothing."""
    if len(indices) and indices[-1] - indices[0] == len(indices) - 1 and (np.diff(indices) == 1).all():
        return slice(int(indices[0]), int(indices[-1]) + 1)
    return indices


def _alike(first: np.ndarray, second: np.ndarray) -> Iterator[tuple[tuple[int, int], np.ndarray]]:
    """Yield each pair of numbers that occurs, and where."""
    many = int(second.max(initial=0)) + 1
    pairs, group = np.unique(first * many + second, return_inverse=True)
    for n, pair in enumerate(pairs.tolist()):
        yield divmod(pair, many), np.flatnonzero(group == n)
