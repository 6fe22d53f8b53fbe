"""The nominal machine as a geometry file describes it: design positions of the joints, limits, tools, work frames."""

from __future__ import annotations

import copy
import math
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from ..core import Status, Struct, batch
from ..core.batch import check_stage
from ..errors import FrameError, GeometryError, KinematicsError, LimitError, PoseError, shorten
from ..formats.files import read_text
from ..formats.paths import input_file
from ..formats.schema import Section, file_errors, read_whole
from ..formats.texts import number
from ..formats.yaml import parse_yaml
from ..pose import Pose
from .limits import STRUT_NAMES as STRUT_NAMES
from .limits import Limits, frozen_array
from .load import NOTHING, Payload

# Frames that every machine has: its base, and the default work frame and tool
BASE, WORK, TOOL = "base", "work", "tool"
MOST_FRAMES = 100  # Largest number of tools, and of work frames, of one machine
NAME = re.compile(r"[A-Za-z][A-Za-z0-9_]{0,63}")  # Allowed names of tools and work frames
USUAL_LEAD = 0.01  # Assumed lead of a ball screw, m per turn, if the geometry file gives none
RESERVED = re.compile("base|work|platform|tool|world|(platform|strut)_.*")  # Names of the package's frames


def read_pose(parent: Section, key: str, section: Section | None = None) -> Pose:
    """Read a pose from the section `key`: ``position_UNIT``, and ``rotation_UNIT`` with α, β, γ (by default 0)."""
    section = parent.section(key) if section is None else section
    position = section.quantity("position", "length", (3,))
    angles = section.quantity("rotation", "angle", (3,), np.zeros(3))
    section.finish()
    try:
        return Pose.from_angles(position, angles)
    except PoseError as error:
        raise parent.error(key, str(error)) from error


def read_tool(parent: Section, key: str, payloads: dict[str, Payload]) -> Pose:
    """Return a tool's pose from the section `key`; write its mass and its centre of mass into `payloads`."""
    section = parent.section(key)
    weighs = section.quantity_key("mass", "mass") is not None
    mass = section.quantity("mass", "mass", (), None if weighs else 0.0)
    centre = section.quantity("centre", "length", (3,), None if weighs else np.zeros(3))
    with file_errors(section):
        payloads[key] = Payload(float(mass), tuple(centre.tolist()))
    return read_pose(parent, key, section)


def read_named_poses(top: Section, key: str, read: Callable[[Section, str], Pose] = read_pose) -> dict[str, Pose]:
    """Return the poses in the section ``tools`` or ``work_frames``, by name; none if the file lacks the section."""
    if key not in top:
        return {}
    section = top.section(key)
    if len(section.remaining()) > MOST_FRAMES:  # checked before any entry is read
        raise top.error(key, f"must have at most {MOST_FRAMES} entries", len(section.remaining()))
    for name in (BASE, WORK, TOOL):
        if name in section:
            raise section.error(name, f"is reserved for the frame {name} of every machine: choose another name")
    return {name: read(section, name) for name in section.remaining()}


def pose_text(pose: Pose) -> str:
    places = ", ".join(number(value * 1e3, 3) for value in pose.position)
    angles = ", ".join(number(math.degrees(value), 4) for value in pose.angles())
    return f"x, y, z {places} mm, alpha, beta, gamma {angles} deg"


def refuse_names(tools: Mapping[str, Pose], work_frames: Mapping[str, Pose]) -> None:
    """Raise GeometryError if a name is invalid, reserved, or given to both a tool and a work frame."""
    for key, named, usual in (("tools", tools, (TOOL,)), ("work_frames", work_frames, (BASE, WORK))):
        others = [name for name in named if name not in usual]
        if len(others) > MOST_FRAMES:
            raise GeometryError(key, f"must have at most {MOST_FRAMES} entries", len(others))
        for name in others:
            if not NAME.fullmatch(name):
                problem = "a name must begin with a letter and have at most 64 letters, digits and underscores"
                raise GeometryError(f"{key}.{name}", problem)
            if RESERVED.fullmatch(name):
                raise GeometryError(f"{key}.{name}", "is reserved for another frame of the machine; choose a new name")
            if name in tools and name in work_frames:
                raise GeometryError(f"{key}.{name}", "names both a tool and a work frame; their names must differ")


GEOMETRY_FORMAT = "hexapod_comp/geometry"
GEOMETRY_VERSION = 1
COINCIDENT = 1e-6  # Joints closer together than this, m, count as one joint
LONGEST_AXIS = 1e9  # Largest component of an axis vector in a file; the square of a larger component could overflow


@dataclass(frozen=True)
class HexapodGeometry:
    """The design of a general 6-6 hexapod.

    Parameters
    ----------
    name : str
        Machine name; a model file for this machine has the same name.
    base_joints : ndarray, shape (6, 3)
        Joint centres in ``base``, m.
    platform_joints : ndarray, shape (6, 3)
        Joint centres in ``platform``, m.
    home : Pose
        A ``pose_platform_in_base`` within all limits; the assembly mode of home is the working assembly mode.
    limits : Limits
        Limits of the machine.
    base_axes, platform_axes : ndarray, shape (6, 3), optional
        Directions of the cardan axes fixed to base and platform, each in its body's frame; needed with `screw_lead`.
    base_cone_axes, platform_cone_axes : ndarray, shape (6, 3), optional
        Neutral direction of each joint, from base to platform, in its body's frame; the default is the
        strut's direction at home.
    screw_lead : ndarray, shape (6,), optional
        Advance of each screw per turn, m; positive for a right-hand thread, zero for struts whose screw
        cannot turn with the joints.
    tool : Pose, optional
        ``pose_tool_in_platform`` of the tool in use.
    work : Pose, optional
        ``pose_work_in_base`` of the work frame in use.
    tools, work_frames : mapping of str to Pose, optional
        Tools and work frames by name, for :meth:`using`. The instance adds the tool and the work frame in use, and
        ``base`` as a work frame.
    tool_name, work_name : str, optional
        Names of the tool and the work frame in use.
    payloads : mapping of str to Payload, optional
        Mass and centre of mass of each tool, by tool name; a tool without an entry weighs nothing.

    Raises
    ------
    GeometryError
        A value is invalid, or home breaks a limit; the message names key, value and what is allowed.
    """

    name: str
    base_joints: np.ndarray
    platform_joints: np.ndarray
    home: Pose
    limits: Limits
    base_axes: np.ndarray | None = None
    platform_axes: np.ndarray | None = None
    base_cone_axes: np.ndarray | None = None
    platform_cone_axes: np.ndarray | None = None
    screw_lead: np.ndarray = field(default_factory=lambda: np.zeros(6))
    tool: Pose = field(default_factory=Pose.identity)
    work: Pose = field(default_factory=Pose.identity)
    tools: Mapping[str, Pose] = field(default_factory=dict)
    work_frames: Mapping[str, Pose] = field(default_factory=dict)
    tool_name: str = TOOL
    work_name: str = WORK
    payloads: Mapping[str, Payload] = field(default_factory=dict)
    home_sign: float = field(init=False)
    """Sign of det J at home; a pose at which det J has the other sign belongs to another assembly mode."""
    kernel_joints: tuple[np.ndarray, np.ndarray] = field(init=False, repr=False)
    """`base_joints` and `platform_joints` as a pair, in the order of the C core's arguments."""
    characteristic_length: float = field(init=False)
    """RMS radius of the platform joints about their centroid, m; makes the condition number free of units."""
    limit_numbers: Struct = field(init=False, repr=False)
    """The limits as the C struct ``hc_limits``."""

    def __post_init__(self) -> None:
        def put(name: str, value: object) -> None:
            object.__setattr__(self, name, value)

        put("base_joints", frozen_array(self.base_joints, (6, 3), "base.joints"))
        put("platform_joints", frozen_array(self.platform_joints, (6, 3), "platform.joints"))
        put("kernel_joints", (self.base_joints, self.platform_joints))
        put("screw_lead", frozen_array(self.screw_lead, (6,), "screw.lead"))
        for i, j in np.argwhere(np.tril(coincident(self.base_joints), -1)):
            problem = f"coincides with base joint {j + 1}; every strut needs a base joint of its own"
            raise GeometryError(f"base.joints[{i}]", problem, self.base_joints[i].tolist())
        put("tools", {TOOL: self.tool, **self.tools, self.tool_name: self.tool})
        frames = {BASE: Pose.identity(), WORK: self.work, **self.work_frames, self.work_name: self.work}
        put("work_frames", frames | {BASE: Pose.identity()})
        refuse_names(self.tools, self.work_frames)
        spread = self.platform_joints - self.platform_joints.mean(axis=0)
        put("characteristic_length", float(np.sqrt((spread**2).sum(axis=1).mean())))
        if self.characteristic_length < COINCIDENT:
            raise GeometryError("platform.joints", "must not all coincide", self.platform_joints.tolist())
        self._fill_axes(put)
        self._check_home(put)

    def _fill_axes(self, put: Callable[[str, object], None]) -> None:
        """Normalise cardan axes and neutral directions; a missing neutral direction is that of the strut at home."""
        at_home = self.home.transform(self.platform_joints) - self.base_joints
        cones = {"base_cone_axes": at_home, "platform_cone_axes": at_home @ self.home.rotation}
        for name in ("base_axes", "platform_axes", *cones):
            body, _, kind = name.partition("_")
            key = f"{body}.{'joint_axes' if kind == 'axes' else 'cone_axes'}"
            vectors = getattr(self, name)
            if vectors is None:
                vectors = cones.get(name)
            if vectors is not None:
                put(name, _unit_vectors(vectors, key))
            elif self.screw_lead.any():
                raise GeometryError(key, "are needed, because a screw lead is given")

    @property
    def payload(self) -> Payload:
        """Mass and centre of mass of the tool in use."""
        return self.payloads.get(self.tool_name, NOTHING)

    @property
    def kernel_axes(self) -> tuple[np.ndarray, np.ndarray]:
        """The cardan axes of base and platform, each (6, 3); zeros if the geometry has no cardan axes."""
        missing = np.zeros((6, 3))
        base, platform = self.base_axes, self.platform_axes
        return np.array(missing if base is None else base), np.array(missing if platform is None else platform)

    def _check_home(self, put: Callable[[str, object], None]) -> None:
        """Set `home_sign` and `limit_numbers`; raise GeometryError if home breaks a limit."""
        pose = (self.home.position, self.home.rotation)
        rows, lengths, judged = (pose[0][None], pose[1][None]), np.empty((1, 6)), (np.empty(1), np.empty(1))
        batch.strut_lengths(*self.kernel_joints, *rows, lengths)
        batch.conditions(*self.kernel_joints, *rows, self.characteristic_length, *judged)
        put("home_sign", float(judged[1][0]))
        cone_axes, joints = np.array([self.base_cone_axes, self.platform_cone_axes]), self.platform_joints
        # Pairs of struts whose clearance is checked: struts that share a platform joint always touch there
        apart = (~coincident(joints)).astype(float)
        given = ("stroke", "cone_cosines", "condition", "correction", "step", "clearance", "speed", "acceleration")
        values = {name: getattr(self.limits, name) for name in given}
        values |= {name: getattr(self, name) for name in ("characteristic_length", "home_sign")}
        put("limit_numbers", Struct("hc_limits", values | {"cone_axes": cone_axes, "apart": apart}))
        refusal = self.refusal(*pose, lengths[0])
        if refusal is not None:
            from .doubts import joint_doubts, unit_doubts

            platform = self.home.transform(self.platform_joints)
            doubts = [*unit_doubts(self), *joint_doubts(self.base_joints, platform)]
            raise GeometryError("home", "; ".join([f"breaks a limit: {refusal}", *doubts]))

    def refusal(
        self, position: np.ndarray, rotation: np.ndarray, lengths: np.ndarray
    ) -> LimitError | KinematicsError | None:
        """Return the error of the first limit that a platform pose or its strut lengths, (6,), m, break; else None."""
        given = *self.kernel_joints, position, rotation, lengths
        finding, strut, value = check_stage(*given, limits=self.limit_numbers)
        return None if finding == Status.OK else self.limits.error(finding, strut, 0, value)

    def using(self, tool: str | None = None, work: str | None = None) -> HexapodGeometry:
        """Return the same machine with the tool and the work frame of these names in use.

        Raises
        ------
        FrameError
            The machine has no tool or work frame of that name; the message lists the names that it has.
        """
        other = copy.copy(self)  # a new instance would compute its numbers again, with other rounding
        for kind, name, named in (("tool", tool, self.tools), ("work", work, self.work_frames)):
            if name is None:
                continue
            if name not in named:
                what = "tool" if kind == "tool" else "work frame"
                raise FrameError(f"machine {self.name} has no {what} {shorten(name)}; it has {', '.join(named)}")
            object.__setattr__(other, kind, named[name])
            object.__setattr__(other, f"{kind}_name", name)
        return other

    def carrying(self, payload: Payload) -> HexapodGeometry:
        """Return the same machine with `payload` as the mass and centre of mass of the tool in use."""
        other = copy.copy(self)
        object.__setattr__(other, "payloads", {**self.payloads, self.tool_name: payload})
        return other

    def platform_pose(self, tool_pose: Pose) -> Pose:
        """Return the ``pose_platform_in_base`` that belongs to a ``pose_tool_in_work``."""
        return self.work @ tool_pose @ self.tool.inverse()

    def tool_pose(self, platform_pose: Pose) -> Pose:
        """Return the ``pose_tool_in_work`` that belongs to a ``pose_platform_in_base``."""
        return self.work.inverse() @ platform_pose @ self.tool

    def platform_poses(self, positions: np.ndarray, rotations: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the platform poses in ``base`` that belong to N tool poses in ``work``, (N, 3), m, and (N, 3, 3)."""
        turned = self.work.rotation @ rotations @ self.tool.rotation.T
        tips = self.work.transform(positions)
        return tips - turned @ self.tool.position, turned

    def tool_poses(self, positions: np.ndarray, rotations: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the tool poses in ``work`` that belong to N platform poses in ``base``, (N, 3), m, and (N, 3, 3)."""
        tips = positions + rotations @ self.tool.position - self.work.position
        return tips @ self.work.rotation, self.work.rotation.T @ rotations @ self.tool.rotation


def paper_joints(a: float, b: float, d: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the joints of Song's machine, (6, 3), m: base hexagon of sides b and d, platform triangle of side a."""
    for key, value in (("a", a), ("b", b), ("d", d)):
        if not (np.isfinite(value) and value > 0.0):
            raise GeometryError(key, "must be finite and positive", value)
    third = np.sqrt(3.0) / 6.0
    half = np.array(
        [[third * (2 * b + d), d / 2, 0.0], [-third * (b - d), (b + d) / 2, 0.0], [-third * (b + 2 * d), b / 2, 0.0]]
    )
    mirror = np.array([1.0, -1.0, 1.0])
    base = np.vstack([half, half[::-1] * mirror])
    angles = np.deg2rad([60.0, 180.0, -60.0])
    triangle = a / np.sqrt(3.0) * np.stack([np.cos(angles), np.sin(angles), np.zeros(3)], axis=1)
    return base, np.repeat(triangle, 2, axis=0)


def load_geometry(path: str | Path) -> HexapodGeometry:
    """Read a geometry file (format ``hexapod_comp/geometry``, described in doc/own_machine.md).

    Parameters
    ----------
    path : str or Path
        YAML file, or the name of a shipped geometry such as ``paper``.

    Returns
    -------
    HexapodGeometry

    Raises
    ------
    InputFileError
        The file cannot be used; the message names file, key and value.
    """
    file = input_file(path, "geometry")
    return parse_geometry(read_text(file), file)


def parse_geometry(text: str, name: str | Path = "geometry") -> HexapodGeometry:
    """Return the machine that a geometry file's text describes; error messages call the file `name`."""
    top = parse_yaml(text, name, GEOMETRY_FORMAT, GEOMETRY_VERSION)
    machine = top.text("machine")
    base, platform, axes = _read_joints(top)
    home = read_pose(top, "home")
    limits = read_whole(Limits, top.section("limits"))
    lead = np.zeros(6)
    if "screw" in top:
        screw = top.section("screw")
        lead = screw.per_strut("lead", "length")
        screw.finish()
    payloads: dict[str, Payload] = {}
    frames: dict[str, Any] = {"tool": read_tool(top, TOOL, payloads)} if TOOL in top else {}
    if WORK in top:
        frames["work"] = read_pose(top, WORK)
    frames["tools"] = read_named_poses(top, "tools", lambda section, name: read_tool(section, name, payloads))
    frames["work_frames"] = read_named_poses(top, "work_frames")
    frames["payloads"] = {name: payload for name, payload in payloads.items() if payload.mass}
    top.finish()
    with file_errors(top):
        return HexapodGeometry(machine, base, platform, home, limits, screw_lead=lead, **frames | axes)


def _read_joints(top: Section) -> tuple[np.ndarray, np.ndarray, dict[str, np.ndarray]]:
    """Return base joints, platform joints, and cardan axes and neutral directions by field of HexapodGeometry."""
    axes: dict[str, np.ndarray] = {}
    joints = {}
    if "paper_dimensions" in top:
        section = top.section("paper_dimensions")
        a, b, d = (float(section.quantity(key, "length")) for key in "abd")
        section.finish()
        with file_errors(section):
            joints["base"], joints["platform"] = paper_joints(a, b, d)
    for body in ("base", "platform"):
        if body not in top and body in joints:
            continue
        section = top.section(body)
        if body not in joints:
            joints[body] = section.quantity("joints", "length", (6, 3))
        for key, name in (("joint_axes", f"{body}_axes"), ("cone_axes", f"{body}_cone_axes")):
            if key in section:
                axes[name] = section.array(key, (6, 3))
        section.finish()
    return joints["base"], joints["platform"], axes


def coincident(joints: np.ndarray) -> np.ndarray:
    """Return a mask, (6, 6), whose entry (i, j) is True if joints i and j, rows of (6, 3), are at the same place."""
    return np.linalg.norm(joints[:, None] - joints, axis=2) <= COINCIDENT


def first_of_same(joints: np.ndarray) -> np.ndarray:
    """Return for each of six joints, (6, 3), the index of the first joint at the same place, (6,)."""
    return coincident(joints).argmax(axis=1)


def _unit_vectors(values: object, key: str) -> np.ndarray:
    """Return six vectors normalised to length 1; raise GeometryError if a vector is zero, huge or invalid."""
    vectors = frozen_array(values, (6, 3), key)
    largest = np.abs(vectors).max(axis=1, keepdims=True)
    if largest.max() > LONGEST_AXIS:
        index = int(largest.argmax())
        raise GeometryError(f"{key}[{index}]", f"components must be at most {LONGEST_AXIS:g}", vectors[index].tolist())
    norms = np.linalg.norm(vectors, axis=1)
    if norms.min() < COINCIDENT:
        index = int(norms.argmin())
        raise GeometryError(f"{key}[{index}]", "must not be the zero vector", vectors[index].tolist())
    unit = vectors / norms[:, None]
    unit.flags.writeable = False
    return unit
