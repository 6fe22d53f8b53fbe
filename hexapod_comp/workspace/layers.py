"""What is shown on a shell of the workspace: a mesh, its values, and what they mean."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..errors import GeometryError


@dataclass(frozen=True)
class Layer:
    """A coloured mesh."""

    points: np.ndarray  # (H, A, 3): m in the work frame
    values: np.ndarray  # (H, A): SI

    def __post_init__(self) -> None:
        if self.points.ndim != 3 or self.points.shape[2] != 3 or self.points.shape[:2] != self.values.shape:
            problem = f"must be (H, A, 3) points and (H, A) values, not {self.points.shape} and {self.values.shape}"
            raise GeometryError("layer", problem)


@dataclass(frozen=True)
class Quantity:
    """What values mean and how they are shown."""

    name: str  # Such as "translation of the tool"
    unit: str  # Shown unit
    factor: float  # Shown value per SI value

    @property
    def label(self) -> str:
        """Name and unit."""
        return f"{self.name}, {self.unit}"


TRANSLATION = Quantity("translation of the tool", "µm", 1e6)
ROTATION = Quantity("rotation of the tool, largest of three", "m°", 1e3 * 180.0 / np.pi)
