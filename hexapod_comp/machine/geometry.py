"""The nominal machine: the joints' design positions, the limits, its tools, and its file."""

from __future__ import annotations

import copy
import math
import re
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from ..core import Status, Struct, batch
from ..core.batch import check_stage
from ..errors import FrameError, GeometryError, InputFileError, KinematicsError, LimitError, PoseError, shorten
from ..formats.files import read_text
from ..formats.paths import input_file
from ..formats.schema import Section, read_whole
from ..formats.texts import number
from ..formats.yaml import parse_yaml
from ..pose import Pose
from .limits import STRUT_NAMES as STRUT_NAMES
from .limits import Limits, frozen_array
from .load import NOTHING, Payload

# Frames that every machine has: its base, and the default work frame and tool
BASE, WORK, TOOL = "base", "work", "tool"
MOST = 100  # Tools, and work frames, of one machine
NAME = re.compile(r"[A-Za-z][A-Za-z0-9_]{0,63}")  # They become ``frame_id`` in messages and links of a URDF
USUAL_LEAD = 0.01  # m a turn, of ball screws for which the geometry file gives no lead
TAKEN = re.compile("base|work|platform|tool|world|(platform|strut)_.*")  # What the package calls other frames


def read_pose(parent: Section, key: str, section: Section | None = None) -> Pose:
    """Read a pose section: ``position_*`` and the paper's angles ``rotation_*`` (default zero)."""
    section = parent.section(key) if section is None else section
    position = section.quantity("position", "length", (3,))
    angles = section.quantity("rotation", "angle", (3,), np.zeros(3))
    section.finish()
    try:
        return Pose.from_angles(position, angles)
    except PoseError as error:
        raise parent.error(key, str(error)) from error


def read_tool(parent: Section, key: str, payloads: dict[str, Payload]) -> Pose:
    """Read a tool's pose, and its ``mass_*`` and ``centre_*`` in ``platform`` into the payloads."""
    section = parent.section(key)
    weighs = section.quantity_key("mass", "mass") is not None
    mass = section.quantity("mass", "mass", (), None if weighs else 0.0)
    centre = section.quantity("centre", "length", (3,), None if weighs else np.zeros(3))
    try:
        payloads[key] = Payload(float(mass), tuple(centre.tolist()))
    except GeometryError as error:
        raise section.error(error.key, error.problem, error.value) from error
    return read_pose(parent, key, section)


def read_named_poses(top: Section, key: str, read: Callable[[Section, str], Pose] = read_pose) -> dict[str, Pose]:
    """Read poses by name, as ``tools`` and ``work_frames`` give them; none where there is no such key."""
    if key not in top:
        return {}
    section = top.section(key)
    if len(section.remaining()) > MOST:  # before each is read
        raise top.error(key, f"must be no more than {MOST}", len(section.remaining()))
    for name in (BASE, WORK, TOOL):
        if name in section:
            raise section.error(name, f"is what the machine's own {name} frame is called")
    return {name: read(section, name) for name in section.remaining()}


def pose_text(pose: Pose) -> str:
    """Return a pose in mm and degrees, for people."""
    places = ", ".join(number(value * 1e3, 3) for value in pose.position)
    angles = ", ".join(number(math.degrees(value), 4) for value in pose.angles())
    return f"x, y, z {places} mm, alpha, beta, gamma {angles} deg"


def refuse_names(tools: Mapping[str, Pose], work_frames: Mapping[str, Pose]) -> None:
    """Raise if a name is invalid, belongs to another frame, or is given to both a tool and a work frame."""
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


# Factors by which joints in a wrong unit are too small, and the correct unit
JOINTS_TIMES = {25.4: "in inches", 1.0 / 25.4: "in mm, not inches", 10.0: "in cm", 1e3: "in m", 1e-3: "in mm, not m"}
GEOMETRY_FORMAT = "hexapod_comp/geometry"
GEOMETRY_VERSION = 1
COINCIDENT = 1e-6  # Joints closer than this, m, count as one
LONGEST_AXIS = 1e9  # Largest component of an axis: only its direction counts, and the square of a huge one overflows


@dataclass(frozen=True)
class HexapodGeometry:
    """A general 6-6 hexapod as designed.

    Parameters
    ----------
    name : str
        Machine name; a model file must carry the same.
    base_joints : ndarray, shape (6, 3)
        Joint centres in ``base``, m.
    platform_joints : ndarray, shape (6, 3)
        Joint centres in ``platform``, m.
    home : Pose
        ``pose_platform_in_base`` at which the machine is known to work; it picks the assembly mode.
    limits : Limits
        What the machine may do.
    base_axes, platform_axes : ndarray, shape (6, 3), optional
        Unit vectors of the cardan axis fixed to each body, in that body's frame; needed when a lead is given.
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
        What else can be used, by name: see :meth:`using`. Afterwards with those in use; ``base`` is a work frame too.
    tool_name, work_name : str, optional
        Of those in use.
    payloads : mapping of str to Payload, optional
        What tools weigh, by their names; the others weigh nothing.

    Raises
    ------
    GeometryError
        With key, value and what is allowed.
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
    """Sign of det J at home: the other sign is another assembly mode."""
    kernel_joints: tuple[np.ndarray, np.ndarray] = field(init=False, repr=False)
    """The joints, for the core: of base and platform."""
    characteristic_length: float = field(init=False)
    """RMS radius of the platform joints about their centroid, m; makes the condition number unit-free."""
    limit_numbers: Struct = field(init=False, repr=False)
    """The limits, for the core."""

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
        """Normalise the joint axes and compute missing cone axes from the struts at home."""
        at_home = self.home.position + self.platform_joints @ self.home.rotation.T - self.base_joints
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
                raise GeometryError(key, "are needed when a screw lead is given")

    @property
    def payload(self) -> Payload:
        """Mass and centre of the tool in use."""
        return self.payloads.get(self.tool_name, NOTHING)

    @property
    def kernel_axes(self) -> tuple[np.ndarray, np.ndarray]:
        """The cardan axes of base and platform, zeros where the machine gives none."""
        missing = np.zeros((6, 3))
        base, platform = self.base_axes, self.platform_axes
        return np.array(missing if base is None else base), np.array(missing if platform is None else platform)

    def _check_home(self, put: Callable[[str, object], None]) -> None:
        """Refuse a home pose that breaks a limit of single poses."""
        pose = (self.home.position, self.home.rotation)
        rows, lengths, judged = (pose[0][None], pose[1][None]), np.empty((1, 6)), (np.empty(1), np.empty(1))
        batch.strut_lengths(*self.kernel_joints, *rows, lengths)
        batch.conditions(*self.kernel_joints, *rows, self.characteristic_length, *judged)
        put("home_sign", float(judged[1][0]))
        cone_axes, joints = np.array([self.base_cone_axes, self.platform_cone_axes]), self.platform_joints
        # The distance of struts that share a joint cannot be limited.
        apart = (~coincident(joints)).astype(float)
        given = ("stroke", "cone_cosines", "condition", "correction", "step", "clearance", "speed", "acceleration")
        values = {name: getattr(self.limits, name) for name in given}
        values |= {name: getattr(self, name) for name in ("characteristic_length", "home_sign")}
        put("limit_numbers", Struct("hc_limits", values | {"cone_axes": cone_axes, "apart": apart}))
        refusal = self.refusal(*pose, lengths[0])
        if refusal is not None:
            from .doubts import joint_doubts

            platform = self.home.position + self.platform_joints @ self.home.rotation.T
            doubts = [*self._unit_doubts(), *joint_doubts(self.base_joints, platform)]
            raise GeometryError("home", "; ".join([f"breaks a limit: {refusal}", *doubts]))

    def _unit_doubts(self) -> Iterator[str]:
        """Yield that the joints' unit may be wrong, if home would be valid with joints in another unit."""
        fitting = []
        for factor, what in JOINTS_TIMES.items():
            base, platform = (np.ascontiguousarray(joints * factor) for joints in self.kernel_joints)
            rows, lengths = (self.home.position[None], self.home.rotation[None]), np.empty((1, 6))
            conditions = np.empty(1), np.empty(1)
            batch.strut_lengths(base, platform, *rows, lengths)
            batch.conditions(base, platform, *rows, factor * self.characteristic_length, *conditions)
            low, high = self.limits.stroke.T
            if (lengths >= low).all() and (lengths <= high).all() and conditions[0][0] <= self.limits.condition:
                fitting.append(what)
        if fitting:
            yield f"do the units fit? With the joints {' or '.join(fitting)}, home is within stroke and condition"

    def refusal(
        self, position: np.ndarray, rotation: np.ndarray, lengths: np.ndarray
    ) -> LimitError | KinematicsError | None:
        """Return why the nominal machine may not be in a platform pose, by its strut lengths; None if it may."""
        outcome = check_stage(*self.kernel_joints, position, rotation, lengths, limits=self.limit_numbers)
        finding, strut, value, _, _ = outcome
        return None if finding == Status.OK else self.limits.error(finding, strut, 0, value)

    def using(self, tool: str | None = None, work: str | None = None) -> HexapodGeometry:
        """Return the same machine with another tool or work frame in use, by name.

        Raises
        ------
        FrameError
            There is none of that name; lists those that there are.
        """
        other = copy.copy(self)  # nothing else is recomputed, so that nothing else changes by a bit
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
        """Return the same machine with another payload of the tool in use."""
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
        """Return positions (N, 3), m, and rotations (N, 3, 3) of :meth:`platform_pose` for many tool poses."""
        turned = self.work.rotation @ rotations @ self.tool.rotation.T
        tips = self.work.position + positions @ self.work.rotation.T
        return tips - turned @ self.tool.position, turned

    def tool_poses(self, positions: np.ndarray, rotations: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return positions (N, 3), m, and rotations (N, 3, 3) of :meth:`tool_pose` for many platform poses."""
        tips = positions + rotations @ self.tool.position - self.work.position
        return tips @ self.work.rotation, self.work.rotation.T @ rotations @ self.tool.rotation


def paper_joints(a: float, b: float, d: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the joints of the paper's 6-3 machine from its three dimensions."""
    for key, value in (("a", a), ("b", b), ("d", d)):
        if not (np.isfinite(value) and value > 0.0):
            raise GeometryError(key, "must be finite and positive, m", value)
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
        YAML file, or the name of a shipped one: ``paper``.

    Returns
    -------
    HexapodGeometry

    Raises
    ------
    InputFileError
        Naming file, key and value.
    """
    file = input_file(path, "geometry")
    return parse_geometry(read_text(file), file)


def parse_geometry(text: str, name: str | Path = "geometry") -> HexapodGeometry:
    """Return the machine of a geometry file's text; `name` is what messages call the file."""
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
    try:
        return HexapodGeometry(machine, base, platform, home, limits, screw_lead=lead, **frames | axes)
    except GeometryError as error:
        raise InputFileError(name, error.key, error.problem, error.value) from error


def _read_joints(top: Section) -> tuple[np.ndarray, np.ndarray, dict[str, np.ndarray]]:
    """Return base joints, platform joints and the axes given by the file."""
    axes: dict[str, np.ndarray] = {}
    joints = {}
    if "paper_dimensions" in top:
        section = top.section("paper_dimensions")
        a, b, d = (float(section.quantity(key, "length")) for key in "abd")
        section.finish()
        try:
            joints["base"], joints["platform"] = paper_joints(a, b, d)
        except GeometryError as error:
            raise section.error(error.key, error.problem, error.value) from error
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
    """Return which joints (6, 3) are at the same place, each with itself too, shape (6, 6)."""
    return np.linalg.norm(joints[:, None] - joints, axis=2) <= COINCIDENT


def first_of_same(joints: np.ndarray) -> np.ndarray:
    """Return, for each joint, the index of the first one at the same place, shape (6,)."""
    return coincident(joints).argmax(axis=1)


def _unit_vectors(values: object, key: str) -> np.ndarray:
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
