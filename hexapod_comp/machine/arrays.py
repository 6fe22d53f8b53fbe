"""Helpers on arrays: groups of equal rows, and the RMS and largest length of error vectors."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike


def changed_rows(rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the index of the first row of each run of equal rows, and for each row the number of its run."""
    new = np.ones(len(rows), dtype=bool)
    new[1:] = (rows[1:] != rows[:-1]).any(axis=1)
    return np.flatnonzero(new), np.cumsum(new) - 1


def different_rows(rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the index of one row of each group of equal rows, and for each row the number of its group."""
    order = np.lexsort(rows.T[::-1])
    first, of_sorted = changed_rows(rows[order])
    number = np.empty(len(rows), dtype=int)
    number[order] = of_sorted
    return order[first], number


@dataclass(frozen=True)
class Size:
    """RMS and largest length of a set of error vectors, in the vectors' unit."""

    rms: float
    largest: float

    @staticmethod
    def of(vectors: np.ndarray) -> Size:
        lengths = np.linalg.norm(vectors, axis=1)
        return Size(rms(lengths), float(lengths.max()))


def rms(values: ArrayLike) -> float:
    return float(np.sqrt(np.mean(np.square(values))))
