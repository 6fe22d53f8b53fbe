"""Size of errors: root mean square and largest."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike


def changed_rows(rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return which rows of a matrix differ from the previous one, the index of the first, and the last such index of
    each row."""
    new = np.ones(len(rows), dtype=bool)
    new[1:] = (rows[1:] != rows[:-1]).any(axis=1)
    return np.flatnonzero(new), np.cumsum(new) - 1


def different_rows(rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the first index of each different row of a matrix, in sorted order, and the number of each row."""
    order = np.lexsort(rows.T[::-1])
    first, of_sorted = changed_rows(rows[order])
    number = np.empty(len(rows), dtype=int)
    number[order] = of_sorted
    return order[first], number


@dataclass(frozen=True)
class Size:
    """Size of a set of vectors."""

    rms: float  # root mean square length
    largest: float

    @staticmethod
    def of(vectors: np.ndarray) -> Size:
        """Return the size of (N, 3) vectors."""
        lengths = np.linalg.norm(vectors, axis=1)
        return Size(rms(lengths), float(lengths.max()))


def rms(values: ArrayLike) -> float:
    """Return the root mean square."""
    return float(np.sqrt(np.mean(np.square(values))))
