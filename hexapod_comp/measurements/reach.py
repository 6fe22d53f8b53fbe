"""Whether a machine can have stood where readings say it did, and how that may have been meant where it cannot."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import combinations

import numpy as np

from ..formats.paths import config_file
from ..machine.geometry import HexapodGeometry, load_geometry
from ..machine.kinematics import Structure, strut_lengths_batch
from ..machine.passes import Poses
from .readings import AXES

GEOMETRIES = ("paper.yaml", "example_6_6.yaml", "jugglebot.yaml", "positioning_unit.yaml")
"""Machines whose readings may have been mixed up: the shipped ones."""

ENOUGH = 10
"""Fewer poses than that are possible in many ways."""

UNITS = (("inches", 25.4), ("m", 1e3))
"""Units in which coordinates may stand that are said to be mm."""

LARGEST_CORRECTION = 0.02
"""No compensation changes a strut's length by a larger share of what the nominal machine needs."""


def impossible(geometry: HexapodGeometry, poses: Poses, commands: np.ndarray) -> Iterator[tuple[int, str]]:
    """Yield number and reason of each pose that the nominal machine cannot take, or not with the commands given."""
    lengths = strut_lengths_batch(Structure.of(geometry), *poses)
    for number, (position, rotation, needed, command) in enumerate(zip(*poses, lengths, commands, strict=True)):
        if refusal := geometry.refusal(position, rotation, needed):
            yield number, f"the commanded pose is out of the machine's reach: {refusal}"
            continue
        off = np.abs(command / needed - 1.0)
        if (off > LARGEST_CORRECTION).any():
            n = int(off.argmax())
            both = f"{command[n] * 1e3:.4f} mm was commanded, the pose needs {needed[n] * 1e3:.4f} mm"
            yield number, f"strut_{n + 1}: {both} (they may differ by {LARGEST_CORRECTION * 100.0:g} %)"


def meant(geometry: HexapodGeometry, poses: Poses, commands: np.ndarray) -> list[str]:
    """Return by name how poses may have been meant so that none is :func:`impossible`: "with x and z exchanged"."""
    if len(commands) < ENOUGH:
        return []
    others = _others(geometry, poses)
    return [how for how, machine, other in others if next(impossible(machine, other, commands), None) is None]


def exchanged(geometry: HexapodGeometry, poses: Poses, a: int, b: int) -> Poses:
    """Return the platform's poses with two coordinates of the tool in the work frame exchanged, not its attitude."""
    tips, tools = geometry.tool_poses(*poses)
    tips[:, [a, b]] = tips[:, [b, a]]
    return geometry.platform_poses(tips, tools)


def _others(geometry: HexapodGeometry, poses: Poses) -> Iterator[tuple[str, HexapodGeometry, Poses]]:
    """Yield other ways to read commanded poses: how, with which machine, and where its platform then is."""
    tips, tools = geometry.tool_poses(*poses)
    for a, b in combinations(range(3), 2):
        yield f"with {AXES[a]} and {AXES[b]} exchanged", geometry, exchanged(geometry, poses, a, b)
    for axis, sign in zip(AXES, 1.0 - 2.0 * np.eye(3), strict=True):
        yield f"with the sign of {axis} reversed", geometry, geometry.platform_poses(sign * tips, tools)
    for unit, factor in UNITS:
        yield f"with coordinates in {unit}", geometry, geometry.platform_poses(factor * tips, tools)
    yield "as poses of the platform in base", geometry, (tips, tools)
    frames = [("tool", name) for name in geometry.tools] + [("work", name) for name in geometry.work_frames]
    machines = [(f"with --{kind} {name}", geometry.using(**{kind: name})) for kind, name in frames]
    machines += [(f"with --machine {name.partition('.')[0]}", load_geometry(config_file(name))) for name in GEOMETRIES]
    for how, machine in machines:
        yield how, machine, machine.platform_poses(tips, tools)
