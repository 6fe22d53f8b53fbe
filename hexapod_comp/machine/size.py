"""How large errors are: root mean square and largest."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike


@dataclass(frozen=True)
class Size:
    """How large a set of vectors is."""

    rms: float  # Root mean square and largest length of the vectors
    largest: float  # Root mean square and largest length of the vectors

    @staticmethod
    def of(vectors: np.ndarray) -> Size:
        """Return the size of (N, 3) vectors."""
        lengths = np.linalg.norm(vectors, axis=1)
        return Size(rms(lengths), float(lengths.max()))


def rms(values: ArrayLike) -> float:
    """Return the root mean square."""
    return float(np.sqrt(np.mean(np.square(values))))
