"""Overview of a machine: frames, joints, reach, the largest box in the reach, and doubtful entries of its file."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from ..core import Status
from ..formats.texts import aligned, number
from ..machine.doubts import doubts, largest_screw_turn
from ..machine.geometry import BASE, USUAL_LEAD, HexapodGeometry
from ..machine.kinematics import condition_number, strut_lengths
from ..pose import Pose, angles_from_rotation, rotation_from_angles
from .reach import (
    BOX_CELLS,
    Reach,
    ReachedBox,
    first_limits,
    home_orientation,
    largest_box,
    machine_box,
    orientations,
    reach,
)

MOST_TILT = np.radians(90.0)
TILT_STEPS = 361  # number of tilts tested from zero to MOST_TILT
TURN = np.radians(5.0)  # tool angle for which the warning about missing cardan axes states their effect


@dataclass(frozen=True)
class Overview:
    geometry: HexapodGeometry
    reach: Reach  # with the tool oriented as at home
    box: ReachedBox  # largest box in `reach`
    campaign: ReachedBox  # default box of campaigns, if possible with the tool parallel to the work frame
    tilts: np.ndarray  # (3, 2): largest negative and positive tilt at home about x, y and z of ``work``, rad
    doubts: tuple[str, ...]  # warnings


def overview(geometry: HexapodGeometry, cells: int = BOX_CELLS) -> Overview:
    """Return the overview of a machine with `cells` grid cells along the longest edge of its reach."""
    reached = reach(geometry, home_orientation(geometry), cells)
    box = largest_box(reached)
    level = np.array_equal(reached.rotation.round(12), np.eye(3))
    return Overview(
        geometry=geometry,
        reach=reached,
        box=box,
        campaign=box if level else machine_box(geometry, cells),
        tilts=_tilts(geometry),
        doubts=(*doubts(geometry), *_screws(geometry)),
    )


def _tilts(geometry: HexapodGeometry) -> np.ndarray:
    """Return the largest negative and positive tilts at home about x, y, z of ``work``, (3, 2), rad."""
    tip = geometry.tool_pose(geometry.home).position
    angles = np.linspace(0.0, MOST_TILT, TILT_STEPS)
    tilts = np.zeros((3, 2))
    for axis in range(3):
        for side, way in enumerate((-1.0, 1.0)):
            sets = [way * angles if a == axis else np.zeros(1) for a in range(3)]
            turned = orientations(geometry, [values.tolist() for values in sets])
            findings, _ = first_limits(geometry, np.tile(tip, (len(turned), 1)), turned)
            out = np.flatnonzero(findings != Status.OK)
            tilts[axis, side] = way * angles[out[0] - 1 if len(out) else -1]
    return tilts


def _screws(geometry: HexapodGeometry) -> tuple[str, ...]:
    """Return a warning, with the possible error of lengths, if the file states neither screw leads nor cardan axes."""
    if geometry.screw_lead.any() or geometry.base_axes is not None:
        return ()
    turned = rotation_from_angles(TURN * np.concatenate([np.eye(3), -np.eye(3)])) @ geometry.home.rotation
    share = largest_screw_turn(geometry, np.tile(geometry.home.position, (6, 1)), turned)
    return (
        "screw.lead, base.joint_axes and platform.joint_axes are missing: if cardan joints turn the screws, strut "
        f"lengths are wrong by up to about {share * USUAL_LEAD * 1e6:.0f} µm when the tool turns by "
        f"{np.degrees(TURN):g}°, with a lead of {USUAL_LEAD * 1e3:g} mm",
    )


def report(overview: Overview) -> str:
    geometry, machine = overview.geometry, overview.reach
    size = " × ".join(f"{edge * 1e3:.1f}" for edge in np.ptp(overview.box.box, axis=0))
    lines = [f"machine {geometry.name}", "", "frames, position mm and α, β, γ °:", _frames(geometry)]
    lines += ["", "joints, mm; strut lengths at home and limits, mm:", _joints(geometry)]
    condition, _ = condition_number(geometry, geometry.home)
    lines += ["", f"condition number at home {condition:.3f}, allowed {geometry.limits.condition:g}"]
    lines += ["largest tilts of the tool at home, about one axis of the work frame: " + _tilt_text(overview.tilts)]
    shares = ", ".join(f"{cause} {100.0 * share:.0f} %" for cause, share in machine.shares().items())
    lines += ["", f"reach with the tool as at home: {machine.volume * 1e3:.4g} litres, {corners(machine.box)}"]
    lines += [f"  limited by {shares}"]
    lines += [f"  in {machine.parts} pieces without a path between them"] * (machine.parts > 1)
    lines += [f"largest box in it: {size} mm, {corners(overview.box.box)}"]
    lines += [f"  {face} stops at {cause}" for face, cause in overview.box.causes.items()]
    if overview.campaign is not overview.box:
        level = np.array_equal(overview.campaign.rotation.round(12), np.eye(3))
        tool = "parallel to the work frame" if level else "as at home"
        lines += [f"box for campaigns, tool {tool}: {corners(overview.campaign.box)}"]
    lines += ["", *(f"please check: {doubt}" for doubt in overview.doubts)] if overview.doubts else []
    return "\n".join(lines)


def corners(box: np.ndarray) -> str:
    ends = [f"{axis} {low:.1f} … {high:.1f}" for axis, low, high in zip("xyz", *(box * 1e3), strict=True)]
    return f"work frame {', '.join(ends)} mm"


def _tilt_text(tilts: np.ndarray) -> str:
    """Return the tilts as text, in degrees; "or more" marks a tilt of 90°, the largest that was tested."""
    texts = []
    for axis, pair in zip("xyz", np.degrees(tilts), strict=True):
        low, high = (f"{value:+.1f}" + ("" if abs(value) < 90.0 else " or more") for value in pair)
        texts.append(f"{axis} {low} … {high}°")
    return ", ".join(texts)


def named_frames(geometry: HexapodGeometry) -> dict[str, tuple[str, Pose]]:
    """Return for each frame, by its name, the name of its reference frame and its pose in that reference frame."""
    return {
        "platform, at home": ("base", geometry.home),
        **{name: ("platform", pose) for name, pose in geometry.tools.items()},
        **{name: ("base", pose) for name, pose in geometry.work_frames.items() if name != BASE},
        "tool, at home": ("work", geometry.tool_pose(geometry.home)),
    }


def _frames(geometry: HexapodGeometry) -> str:
    rows = []
    for name, (outer, pose) in named_frames(geometry).items():
        values = [*(pose.position * 1e3), *np.degrees(angles_from_rotation(pose.rotation))]
        rows.append([name, outer, *(number(value, 3) for value in values)])
    return aligned(["frame", "in", "x", "y", "z", "α", "β", "γ"], rows)


def _joints(geometry: HexapodGeometry) -> str:
    lengths, limits, rows = strut_lengths(geometry, geometry.home), geometry.limits, []
    for n in range(6):
        places = [*geometry.base_joints[n], *geometry.platform_joints[n], lengths[n], *limits.stroke[n]]
        cones = np.degrees([limits.base_cone[n], limits.platform_cone[n]])
        rows.append([str(n + 1), *(number(value * 1e3, 3) for value in places), *(f"{cone:g}" for cone in cones)])
    head = ["strut", "base x", "y", "z", "platform x", "y", "z", "home", "shortest", "longest", "base °", "platform °"]
    return aligned(head, rows)


def as_json(overview: Overview) -> dict[str, Any]:
    """Return the overview for JSON; keys end in their unit, but poses are in mm and degrees."""
    geometry, machine = overview.geometry, overview.reach
    return {
        "machine": geometry.name,
        "frames": {name: {"in": outer, "pose": pose} for name, (outer, pose) in named_frames(geometry).items()},
        "base_joints_m": geometry.base_joints,
        "platform_joints_m": geometry.platform_joints,
        "home_lengths_m": strut_lengths(geometry, geometry.home),
        "home_condition": condition_number(geometry, geometry.home)[0],
        "home_tilts_rad": overview.tilts,
        "reach": {"volume_m3": machine.volume, "box_m": machine.box, "frame": "work", "limits": machine.shares()},
        "largest_box": _box_json(overview.box),
        "campaign_box": _box_json(overview.campaign),
        "look_again": overview.doubts,
    }


def _box_json(box: ReachedBox) -> dict[str, Any]:
    return {"box_m": box.box, "frame": "work", "rotation": box.rotation, "stops_at": box.causes}
