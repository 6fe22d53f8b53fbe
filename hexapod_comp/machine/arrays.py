"""Functions on arrays: find groups of equal rows; compute the RMS and the largest length of error vectors."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike


def changed_rows(rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Find runs of equal successive rows: return the first row's index of each run, and each row's run number."""
    new = np.ones(len(rows), dtype=bool)
    new[1:] = (rows[1:] != rows[:-1]).any(axis=1)
    return np.flatnonzero(new), np.cumsum(new) - 1


def different_rows(rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Find groups of equal rows: return the index of one row of each group, and each row's group number."""
    order = np.lexsort(rows.T[::-1])
    first, of_sorted = changed_rows(rows[order])
    number = np.empty(len(rows), dtype=int)
    number[order] = of_sorted
    return order[first], number


@dataclass(frozen=True)
class Size:
    """RMS and maximum of the lengths of error vectors, in the vectors' unit."""

    rms: float
    largest: float

    @staticmethod
    def of(vectors: np.ndarray) -> Size:
        lengths = np.linalg.norm(vectors, axis=1)
        return Size(rms(lengths), float(lengths.max()))


def rms(values: ArrayLike) -> float:
    return float(np.sqrt(np.mean(np.square(values))))
