"""The box in which a model was measured: it bounds the positions of the measured point, along the box's own axes."""

from __future__ import annotations

from dataclasses import MISSING, dataclass
from functools import cached_property
from typing import Any

import numpy as np

from ..errors import ModelError
from ..pose import Pose
from .geometry import HexapodGeometry
from .passes import level_attitude
from .terms import term, validate_terms

ON_THE_FACE = 1e-9  # Distance from the box, m, up to which a point counts as inside, as files round to a picometre
PARALLEL = 1e-9  # Components of a direction below this count as zero


@dataclass(frozen=True)
class Region:
    """A box that bounds the positions of the measured point, which is a point of the platform."""

    box: np.ndarray = term(
        "region", "mm", "lowest and highest position of the measured point", (2, 3), MISSING, checked=False
    )
    point: np.ndarray = term("region", "mm", "the measured point, in platform", (3,))
    position: np.ndarray = term("region", "mm", "origin of the box's axes in base", (3,))
    angles: np.ndarray = term("region", "deg", "α, β, γ of the box's axes in base", (3,), key="rotation")

    @staticmethod
    def of(box: np.ndarray, point: np.ndarray, frame: Pose) -> Region:
        """Make a region from a point, (3,), m in ``platform``, and a box of its positions, (2, 3), m in `frame`."""
        return Region(np.round(box, 9), point, frame.position, frame.angles())  # `contains` allows the rounding

    @cached_property
    def frame(self) -> Pose:
        """Pose of the box's axes in ``base``."""
        return Pose.from_angles(self.position, self.angles)

    def __post_init__(self) -> None:
        box = np.array(self.box, dtype=float)
        if box.shape != (2, 3) or not (box[0] < box[1]).all():
            raise ModelError("region.box", "must be the lowest and the highest corner of a box", box.tolist())
        validate_terms(self)

    def contains(self, positions: np.ndarray, rotations: np.ndarray, slack: float = ON_THE_FACE) -> np.ndarray:
        """Return for N platform poses whether the measured point is at most `slack`, m, outside the box."""
        places = (positions + rotations @ self.point - self.frame.position) @ self.frame.rotation
        return ((places >= self.box[0] - slack) & (places <= self.box[1] + slack)).all(axis=-1)

    def poses(self, places: np.ndarray, rotation: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the platform poses of one rotation that put the measured point at `places`, (N, 3), m in `frame`."""
        in_base = self.frame.transform(places)
        return in_base - rotation @ self.point, np.tile(rotation, (len(places), 1, 1))

    def commanded(self, geometry: HexapodGeometry) -> np.ndarray:
        """Return tool positions, a box (2, 3), m in ``work``, that keep the measured point in the region (no tilt)."""
        # Rotation of the platform with a level tool
        level = geometry.work.rotation @ level_attitude(geometry) @ geometry.tool.rotation.T
        beside = level @ (geometry.tool.position - self.point)  # from the measured point to the tool's tip, in base
        middle = self.frame.position + self.frame.rotation @ self.box.mean(axis=0)
        centre = geometry.work.rotation.T @ (middle + beside - geometry.work.position)
        half, turned = 0.5 * np.ptp(self.box, axis=0), np.abs(geometry.work.rotation.T @ self.frame.rotation)
        turned[turned < PARALLEL] = 0.0
        around = turned @ half
        inside = around * (half / (turned.T @ around)).min()
        return np.array([centre - inside, centre + inside])

    def text(self, geometry: HexapodGeometry) -> str:
        box = self.commanded(geometry)
        sides = " × ".join(f"{side:.4g}" for side in np.ptp(box.round(9) * 1e3, axis=0))
        return f"tool positions in {geometry.work_name} {box_text(box)}, sides {sides} mm"


def box_text(box: np.ndarray) -> str:
    """Return a box, given by its lowest and highest corner, (2, 3), m, as text in mm."""
    low, high = (", ".join(f"{v:g}" for v in corner) for corner in box.round(9) * 1e3)
    return f"({low})…({high}) mm"


def region_text(region: Region | None, geometry: HexapodGeometry) -> str:
    """Return the box in which a model was measured, as text; "none" if the model does not state the box."""
    return "measured box: none" if region is None else f"measured box: {region.text(geometry)}"


def region_json(region: Region | None, geometry: HexapodGeometry) -> dict[str, Any] | None:
    """Return for JSON the box in which a model was measured, in m; None if the model does not state the box."""
    if region is None:
        return None
    return {"tool_in_work_m": region.commanded(geometry), "measured_point_in_platform_m": region.point}
