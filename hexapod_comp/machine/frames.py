"""Tools and work frames by name: what they may be called, and how a geometry file gives them."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping

import numpy as np

from ..errors import GeometryError, PoseError
from ..formats.schema import Section
from ..formats.texts import number
from ..pose import Pose

BASE, WORK, TOOL = "base", "work", "tool"
"""Frames that every machine has: its base, and the work frame and the tool that are used unless others are named."""

MOST = 100
"""Tools, and work frames, of one machine."""

NAME = re.compile(r"[A-Za-z][A-Za-z0-9_]{0,63}")
"""They become ``frame_id`` in messages and links of a URDF."""

TAKEN = re.compile("base|work|platform|tool|world|(platform|strut)_.*")
"""What the package calls other frames."""


def read_pose(parent: Section, key: str) -> Pose:
    """Read a pose section: ``position_*`` and the paper's angles ``rotation_*`` (default zero)."""
    section = parent.section(key)
    position = section.quantity("position", "length", (3,))
    angles = section.quantity("rotation", "angle", (3,), np.zeros(3))
    section.finish()
    try:
        return Pose.from_angles(position, angles)
    except PoseError as error:
        raise parent.error(key, str(error)) from error


def read_named_poses(top: Section, key: str) -> dict[str, Pose]:
    """Read poses by name, as ``tools`` and ``work_frames`` give them; none where there is no such key."""
    if key not in top:
        return {}
    section = top.section(key)
    if len(section.left()) > MOST:  # before each is read
        raise top.error(key, f"must be no more than {MOST}", len(section.left()))
    for name in (BASE, WORK, TOOL):
        if name in section:
            raise section.error(name, f"is what the machine's own {name} frame is called")
    return {name: read_pose(section, name) for name in section.left()}


def pose_text(pose: Pose) -> str:
    """Return a pose in mm and degrees, for people."""
    places = ", ".join(number(value * 1e3, 3) for value in pose.position)
    angles = ", ".join(number(math.degrees(value), 4) for value in pose.angles())
    return f"x, y, z {places} mm, alpha, beta, gamma {angles} deg"


def refuse_names(tools: Mapping[str, Pose], work_frames: Mapping[str, Pose]) -> None:
    """Raise where a name cannot be one, stands for something else, or is given to a tool and a work frame."""
    for key, named, usual in (("tools", tools, (TOOL,)), ("work_frames", work_frames, (BASE, WORK))):
        others = [name for name in named if name not in usual]
        if len(others) > MOST:
            raise GeometryError(key, f"must be no more than {MOST}", len(others))
        for name in others:
            if not NAME.fullmatch(name):
                problem = "a name must begin with a letter and have no more than 64 letters, digits and underscores"
                raise GeometryError(f"{key}.{name}", problem)
            if TAKEN.fullmatch(name):
                raise GeometryError(f"{key}.{name}", "is what another frame of the machine is called")
            if name in tools and name in work_frames:
                raise GeometryError(f"{key}.{name}", "is a tool and a work frame; their names must differ")
