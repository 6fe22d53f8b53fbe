"""What the tests of the nodes share: the package's bench with this project's usual machine, poses and files."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import yaml
from scipy.spatial.transform import Rotation

from hexapod_comp.pose import Pose
from hexapod_comp.ros.compensator import CompensatorNode
from hexapod_comp.testing.bench import BEST_EFFORT, RELIABLE, SENT, TRANSITIONS, Answer
from hexapod_comp.testing.bench import Bench as BareBench

__all__ = ["BEST_EFFORT", "RELIABLE", "SENT", "TRANSITIONS", "Answer"]

CONFIG = Path(__file__).resolve().parents[1] / "config"

AT_ONCE = 1e-6
"""A wait that is over, s."""

HOME = Pose([0.0, 0.0, 0.4], np.eye(3))
"""Home of the paper's machine."""


class Bench(BareBench):
    """A bench whose compensators have the virtual machine's model unless another is given.

    Their machine has no feedback unless a test gives some, and need not wait for it unless a test says so.
    """

    def compensator(self, start: bool = True, **parameters: object) -> CompensatorNode:
        defaults = {"model_file": "paper_machine.yaml", "start_without_feedback_after": AT_ONCE}
        return super().compensator(start, **{**defaults, **parameters})


def closed_form_lengths(pose: Pose, a: float = 0.3, b: float = 0.572, d: float = 0.243) -> np.ndarray:
    """Return the paper machine's nominal strut lengths, m, from plane geometry, not from the package.

    The corners of an equiangular hexagon with sides b and d in turn lie on a circle of radius
    √((b² + bd + d²)/3), here with a side d across +x; the platform is an equilateral triangle of side a.
    """
    radius = np.sqrt((b * b + b * d + d * d) / 3.0)
    half = np.arcsin(d / (2.0 * radius))
    thirds = np.deg2rad([0.0, 120.0, 120.0, 240.0, 240.0, 360.0])
    corners = thirds + half * np.array([1, -1, 1, -1, 1, -1])
    tips = np.deg2rad([60.0, 60.0, 180.0, 180.0, 300.0, 300.0])
    base = radius * np.stack([np.cos(corners), np.sin(corners), 0 * corners], axis=1)
    platform = a / np.sqrt(3.0) * np.stack([np.cos(tips), np.sin(tips), 0 * tips], axis=1)
    return np.linalg.norm(pose.position + platform @ pose.rotation.T - base, axis=1)


def near(pose: Pose, shift: tuple[float, float, float] = (0.0, 0.0, 0.0), tilt_deg: float = 0.0) -> Pose:
    """Return a pose shifted by metres along the base axes and tilted about its own x axis."""
    turn = Rotation.from_euler("X", tilt_deg, degrees=True).as_matrix()
    return Pose(pose.position + shift, pose.rotation @ turn)


def geometry_file(folder: Path, limits: dict[str, object] | None = None, **sections: object) -> str:
    """Write the shipped geometry with other limits or sections into a folder and return its path."""
    data = yaml.safe_load((CONFIG / "paper.yaml").read_text(encoding="utf-8"))
    data["limits"].update(limits or {})
    data.update(sections)
    path = folder / "geometry.yaml"
    path.write_text(yaml.safe_dump(data), encoding="utf-8")
    return str(path)


def model_file(folder: Path, name: str = "model.yaml", **sections: object) -> str:
    """Write a small model of the paper's machine into a folder and return its path."""
    data = {"format": "hexapod_comp/model", "version": 1, "machine": "paper", "name": "written by a test"}
    data.update({"date": "2026-01-31", "sources": []})
    data.update(sections)
    path = folder / name
    path.write_text(yaml.safe_dump(data), encoding="utf-8")
    return str(path)
