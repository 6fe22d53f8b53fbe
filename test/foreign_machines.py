"""A zoo of machines, most of them not the paper's, with kinematics of the tests' own.

Nothing here uses the package. The closures are written from the description of the geometry file and the model file (L
= command + offset + pitch · (command − reference) + lead · turns between the real joints), and solved by Newton's
method with the textbook Jacobian, rows (u, R·p × u). Lengths are m, positions (N, 3), rotations (N, 3, 3).
"""

from __future__ import annotations

import os
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import yaml
from scipy.spatial.transform import Rotation

MM, INCH = 1e-3, 0.0254
UM = 1e-6


def rotation(alpha: float, beta: float, gamma: float) -> np.ndarray:
    """Return R = Ry(β)·Rx(α)·Rz(γ), as in doc/theory.md; angles in degrees."""
    (ca, cb, cc), (sa, sb, sc) = (f(np.radians([alpha, beta, gamma])) for f in (np.cos, np.sin))
    about_y = np.array([[cb, 0.0, sb], [0.0, 1.0, 0.0], [-sb, 0.0, cb]])
    about_x = np.array([[1.0, 0.0, 0.0], [0.0, ca, -sa], [0.0, sa, ca]])
    return about_y @ about_x @ np.array([[cc, -sc, 0.0], [sc, cc, 0.0], [0.0, 0.0, 1.0]])


@dataclass(frozen=True)
class Frame:
    """A pose as in a geometry file: position, m, and α, β, γ, degrees."""

    position: tuple[float, float, float] = (0.0, 0.0, 0.0)
    angles: tuple[float, float, float] = (0.0, 0.0, 0.0)

    @property
    def matrix(self) -> np.ndarray:
        return rotation(*self.angles)


@dataclass(frozen=True)
class Machine:
    """A hexapod; `half` are the half sides of the measured box of tool positions in work, around `middle`.

    With a `lead` (m, positive right-hand) cardan joints turn the screws. Their axes on base and platform are `axes`,
    each (6, 3), by default across the struts at home.
    """

    name: str
    base: np.ndarray
    platform: np.ndarray
    home: tuple[float, float, float]
    half: tuple[float, float, float]
    tool: Frame = field(default_factory=Frame)
    work: Frame = field(default_factory=Frame)
    stroke: tuple[float, float] = (0.25, 1.2)
    unit: str = "mm"
    lead: float = 0.0
    axes: tuple[np.ndarray, np.ndarray] | None = None
    limits: dict[str, float] = field(default_factory=dict)
    tools: dict[str, Frame] = field(default_factory=dict)
    work_frames: dict[str, Frame] = field(default_factory=dict)

    def using(self, tool: str | None = None, work: str | None = None) -> Machine:
        """Return the machine with a named tool and work frame; None keeps the usual one."""
        return replace(self, tool=self.tools.get(tool, self.tool), work=self.work_frames.get(work, self.work))

    def lengths(self, positions: np.ndarray, rotations: np.ndarray) -> np.ndarray:
        """Return the nominal distances between the joints of each strut, (N, 6)."""
        return np.linalg.norm(positions[:, None] + self.platform @ np.swapaxes(rotations, 1, 2) - self.base, axis=2)

    def level(self) -> np.ndarray:
        """Return the platform's rotation in base when the tool is parallel to work."""
        return self.work.matrix @ self.tool.matrix.T

    def platform_poses(self, tips: np.ndarray, tools: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return platform poses in base, (N, 3) and (N, 3, 3), for tool poses in work."""
        rotations = self.work.matrix @ tools @ self.tool.matrix.T
        in_base = np.array(self.work.position) + tips @ self.work.matrix.T
        return in_base - rotations @ np.array(self.tool.position), rotations

    def platforms(self, tips: np.ndarray) -> np.ndarray:
        """Return positions of the platform, (N, 3), in base, for a level tool at positions in work, (N, 3)."""
        return self.platform_poses(tips, np.tile(np.eye(3), (len(tips), 1, 1)))[0]

    def tips(self, positions: np.ndarray, rotations: np.ndarray) -> np.ndarray:
        """Return positions of the tool's tip in work, (N, 3), for platform poses in base."""
        in_base = positions + rotations @ np.array(self.tool.position)
        return (in_base - np.array(self.work.position)) @ self.work.matrix

    @property
    def middle(self) -> np.ndarray:
        """Tip of the level tool in work with the platform at home."""
        return self.tips(np.array([self.home]), self.level()[None])[0]

    @property
    def box(self) -> np.ndarray:
        """Measured box of tips in work."""
        return self.middle + np.array([[-1.0], [1.0]]) * np.array(self.half)

    def write(self, path: Path) -> Path:
        """Write the geometry file, in the machine's own unit."""
        scale = {"mm": MM, "in": INCH}[self.unit]

        def lengths(values: object) -> list:
            return (np.array(values) / scale).tolist()

        def pose(frame: Frame) -> dict:
            return {f"position_{self.unit}": lengths(frame.position), "rotation_deg": list(frame.angles)}

        content = {
            "format": "hexapod_comp/geometry",
            "version": 1,
            "machine": self.name,
            "base": {f"joints_{self.unit}": lengths(self.base)},
            "platform": {f"joints_{self.unit}": lengths(self.platform)},
            "home": pose(Frame(self.home)),
            "tool": pose(self.tool),
            "work": pose(self.work),
            "limits": {
                f"stroke_{self.unit}": lengths(self.stroke),
                "base_cone_deg": 70,
                "platform_cone_deg": 85,
                "condition_number": 30,
                "correction_um": 3000,
                "step_mm": 3,
                "speed_mm_s": 250,
                **self.limits,
            },
        }
        for key in ("tools", "work_frames"):
            if named := getattr(self, key):
                content[key] = {name: pose(frame) for name, frame in named.items()}
        if self.axes is not None:
            for body, axes in zip(("base", "platform"), self.axes, strict=True):
                content[body]["joint_axes"] = axes.tolist()
        if self.lead:
            content["screw"] = {f"lead_{self.unit}": lengths(self.lead)}
        path.write_text(yaml.safe_dump(content))
        return path


@dataclass(frozen=True)
class Errors:
    """Errors of structure and struts, SI, as in a model file; with a leading axis, those of one machine per pose."""

    base: np.ndarray
    platform: np.ndarray
    offset: np.ndarray
    pitch: np.ndarray
    reference: np.ndarray
    axes_turn: np.ndarray = field(default_factory=lambda: np.zeros(3))

    @staticmethod
    def none() -> Errors:
        return Errors(np.zeros((6, 3)), np.zeros((6, 3)), np.zeros(6), np.zeros(6), np.zeros(6))

    @staticmethod
    def drawn(machine: Machine, seed: int, size: float = 50 * UM) -> Errors:
        """Draw errors; platform joints at the same place have the same error."""
        rng = np.random.default_rng(seed)
        base, platform = rng.uniform(-size, size, (2, 6, 3))
        _, first = np.unique(machine.platform.round(9), axis=0, return_inverse=True)
        offset, pitch = rng.uniform(-size, size, (2, 6))
        home = np.linalg.norm(np.array(machine.home) + machine.platform - machine.base, axis=1)
        return Errors(base, platform[first.ravel()], offset, pitch, home)

    @staticmethod
    def read(path: Path) -> Errors:
        """Read a model file that has only structure, offset and pitch."""
        content = yaml.safe_load(path.read_text())
        structure, struts = content.get("structure", {}), content.get("struts", {})
        assert not np.any([struts.get("wave", {}).get(f"{part}_um", 0.0) for part in ("cosine", "sine")])
        assert "map" not in struts
        assert not content.get("field", {}).get("lines")
        values = [np.array(structure[f"{body}_deviation_um"]) * UM for body in ("base", "platform")]
        values += [np.full(6, struts.get(key, 0.0)) * unit for key, unit in
                   (("offset_um", UM), ("pitch_ppm", 1e-6), ("reference_length_mm", MM))]  # fmt: skip
        return Errors(*values, np.array(structure.get("base_axes_turn_urad", np.zeros(3))) * 1e-6)

    def write(self, path: Path, machine: Machine) -> Path:
        """Write the model file."""
        content = {
            "format": "hexapod_comp/model",
            "version": 1,
            "machine": machine.name,
            "name": "truth",
            "date": "2026-01-31",
            "sources": [],
            "structure": {
                "base_deviation_um": (self.base / UM).tolist(),
                "platform_deviation_um": (self.platform / UM).tolist(),
            },
            "struts": {
                "offset_um": (self.offset / UM).tolist(),
                "pitch_ppm": (self.pitch * 1e6).tolist(),
                "reference_length_mm": (self.reference / MM).tolist(),
            },
        }
        path.write_text(yaml.safe_dump(content))
        return path


def commands(machine: Machine, errors: Errors, positions: np.ndarray, rotations: np.ndarray) -> np.ndarray:
    """Return the commands, (N, 6), m, that bring a machine with these errors to platform poses."""
    arms = (machine.platform + errors.platform) @ np.swapaxes(rotations, 1, 2)
    struts = positions[:, None] + arms - machine.base - errors.base
    lengths = np.linalg.norm(struts, axis=2) - advance(machine, struts, rotations, errors.axes_turn)
    return (lengths - errors.offset + errors.pitch * errors.reference) / (1.0 + errors.pitch)


def advance(machine: Machine, struts: np.ndarray, rotations: np.ndarray, turn: np.ndarray | None = None) -> np.ndarray:
    """Return how much struts (N, 6, 3) have lengthened since home because their screws turned, m.

    A rotation vector `turn` turns the base's axes from the drawing; home's axes are those of the drawing. The cross of
    a cardan joint is perpendicular to its own axis and to the strut: the screw has the direction (base axis) × u, the
    nut (platform axis) × u, and the angle from screw to nut is the screw's rotation.
    """
    if not machine.lead or machine.axes is None:
        return np.zeros(struts.shape[:2])
    at_home = np.array(machine.home) + machine.platform - machine.base
    turned = _screw_angles(machine, struts, rotations, turn) - _screw_angles(machine, at_home[None], np.eye(3)[None])
    return machine.lead * np.angle(np.exp(1j * turned)) / (2.0 * np.pi)


def _screw_angles(
    machine: Machine, struts: np.ndarray, rotations: np.ndarray, turn: np.ndarray | None = None
) -> np.ndarray:
    """Return the angles about the struts from screw to nut, right-handed, rad."""
    assert machine.axes is not None
    u = struts / np.linalg.norm(struts, axis=2, keepdims=True)
    on_base = machine.axes[0] if turn is None else machine.axes[0] @ _turned(turn[None])[0].T
    screw, nut = np.cross(on_base, u), np.cross(machine.axes[1] @ np.swapaxes(rotations, 1, 2), u)
    return np.arctan2((u * np.cross(screw, nut)).sum(axis=2), (screw * nut).sum(axis=2))


def goes_to(
    machine: Machine, errors: Errors, told: np.ndarray, positions: np.ndarray, rotations: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return the pose of a machine with errors for strut commands (N, 6), by Newton from the intended poses."""
    wanted = told + errors.offset + errors.pitch * (told - errors.reference)
    positions, rotations = positions.copy(), rotations.copy()
    for _ in range(8):  # quadratic convergence from 0.1 mm: three steps suffice, more if screws turn
        arms = (machine.platform + errors.platform) @ np.swapaxes(rotations, 1, 2)
        struts = positions[:, None] + arms - machine.base - errors.base
        distances = np.linalg.norm(struts, axis=2)
        lengths = distances - advance(machine, struts, rotations, errors.axes_turn)
        u = struts / distances[:, :, None]
        missing = np.abs(wanted - lengths).max()
        step = np.linalg.solve(np.concatenate([u, np.cross(arms, u)], axis=2), (wanted - lengths)[:, :, None])[:, :, 0]
        positions += step[:, :3]
        rotations = _turned(step[:, 3:]) @ rotations
        if missing < 1e-12:
            return positions, rotations
    raise AssertionError(f"lengths are missed by {missing} m")


def _turned(vectors: np.ndarray) -> np.ndarray:
    """Return the rotation matrices of rotation vectors (N, 3), by Rodrigues' formula."""
    angle = np.linalg.norm(vectors, axis=1)[:, None, None]
    k = np.zeros((len(vectors), 3, 3))
    x, y, z = vectors.T
    k[:, 0, 1], k[:, 0, 2], k[:, 1, 2] = -z, y, -x
    k -= np.swapaxes(k, 1, 2)
    safe = np.where(angle > 0.0, angle, 1.0)
    return np.eye(3) + k * np.sin(angle) / safe + k @ k * (1.0 - np.cos(angle)) / safe**2


def tool_errors(machine: Machine, truth: Errors, believed: Errors | None, tips: np.ndarray) -> np.ndarray:
    """Return actual minus wanted tip (N, 3), m in work, of a level tool commanded with the errors `believed`.

    None: commanded with nominal lengths, also if its screws turn.
    """
    positions = machine.platforms(tips)
    rotations = np.tile(machine.level(), (len(tips), 1, 1))
    poses = positions, rotations
    told = machine.lengths(*poses) if believed is None else commands(machine, believed, *poses)
    return machine.tips(*goes_to(machine, truth, told, positions, rotations)) - tips


def aligned_rms(tips: np.ndarray, errors: np.ndarray) -> float:
    """Return the RMS length of errors after the best shift and rotation, by Kabsch's method (SciPy's).

    To first order, a rotation of 0.5 mrad alone would leave 12 nm at 0.1 m.
    """
    there = tips + errors
    onto, moved = tips - tips.mean(axis=0), there - there.mean(axis=0)
    left = Rotation.align_vectors(onto, moved)[0].apply(moved) - onto
    return float(np.sqrt((left**2).sum(axis=1).mean()))


def _paper() -> tuple[np.ndarray, np.ndarray]:
    """Return the joints of Song et al.'s machine from its dimensions (their Figure 3)."""
    a, b, d = 0.3, 0.572, 0.243
    third = np.sqrt(3.0) / 6.0
    half = [(third * (2 * b + d), d / 2), (-third * (b - d), (b + d) / 2), (-third * (b + 2 * d), b / 2)]
    base = np.array([(x, y, 0.0) for x, y in half] + [(x, -y, 0.0) for x, y in half[::-1]])
    corners = np.radians([60.0, 60.0, 180.0, 180.0, -60.0, -60.0])
    return base, a / np.sqrt(3.0) * np.stack([np.cos(corners), np.sin(corners), 0.0 * corners], axis=1)


def _ring(radius: float, angles: list[float], heights: list[float]) -> np.ndarray:
    turns = np.radians(angles)
    return np.stack([radius * np.cos(turns), radius * np.sin(turns), np.array(heights)], axis=1)


def _across(base: np.ndarray, platform: np.ndarray, home: tuple[float, float, float]) -> tuple[np.ndarray, np.ndarray]:
    """Return cardan axes on base and platform: level and across each strut at home, the platform's turned by 30°."""
    struts = np.array(home) + platform - base
    axes = np.cross([0.0, 0.0, 1.0], struts)
    axes /= np.linalg.norm(axes, axis=1)[:, None]
    return axes, axes @ rotation(0.0, 0.0, 30.0).T


def machines() -> dict[str, Machine]:
    """Return the machines by name."""
    paper = _paper()
    uneven = (
        _ring(0.42, [12.0, 52.0, 128.0, 171.0, 247.0, 290.0], [0.0, 0.012, -0.008, 0.004, 0.0, -0.01]),
        _ring(0.17, [22.0, 38.0, 143.0, 158.0, 262.0, 278.0], [0.0, 0.004, -0.003, 0.0, 0.002, -0.006]),
    )
    flipped = np.array([1.0, -1.0, -1.0])
    small = (0.1, 0.09, 0.05)
    turned = {
        "tool": Frame((0.021, -0.014, 0.095), (3.0, -4.0, 90.0)),
        "work": Frame((0.15, -0.08, 0.31), (2.0, -3.0, 72.0)),
    }
    telescope = (
        _ring(1.45, [22.0, 98.0, 142.0, 218.0, 262.0, 338.0], [0.0] * 6),
        _ring(1.1, [52.0, 68.0, 172.0, 188.0, 292.0, 308.0], [0.03] * 6),
    )
    unit = (
        _ring(0.15, [15.0, 105.0, 135.0, 225.0, 255.0, 345.0], [0.0] * 6),
        _ring(0.06, [40.0, 80.0, 160.0, 200.0, 280.0, 320.0], [0.0] * 6),
    )
    cardan = 0.9 * uneven[0], 1.1 * uneven[1]
    zoo = [
        Machine("paper", *paper, (0.0, 0.0, 0.4516), (0.15, 0.15, 0.08)),
        Machine("offset", *paper, (0.0, 0.0, 0.45), small, Frame((0.0, 0.0, 0.26))),
        Machine("framed", *uneven, (0.01, -0.02, 0.5), small, **turned),
        Machine(
            "hanging", uneven[0] * flipped, uneven[1] * flipped, (0.0, 0.01, -0.52), small,
            Frame((0.01, 0.0, -0.12)), Frame((-0.05, 0.02, -0.9), (0.0, 0.0, 25.0)),
        ),
        Machine(
            "inches", 1.2 * paper[0], 1.2 * paper[1], (0.0, 0.0, 22 * INCH), (4 * INCH, 4 * INCH, 2 * INCH),
            Frame((0.0, 0.5 * INCH, 3 * INCH), (0.0, 0.0, -90.0)), Frame((INCH, 0.0, 6 * INCH), (0.0, 0.0, -90.0)),
            unit="in",
        ),
        Machine(
            "mirror", *telescope, (0.0, 0.0, 1.6), (0.12, 0.12, 0.08), Frame((0.0, 0.0, 0.4)), stroke=(1.2, 2.4),
        ),
        Machine(
            "unit", *unit, (0.0, 0.0, 0.16), (0.012, 0.012, 0.01), Frame((0.0, 0.0, 0.025)), stroke=(0.158, 0.218),
            lead=0.002, axes=_across(*unit, (0.0, 0.0, 0.16)),
            limits={"base_cone_deg": 18, "platform_cone_deg": 25, "condition_number": 8, "correction_um": 1000,
                    "step_mm": 1, "speed_mm_s": 20},
        ),
        Machine(
            "left-hand", *cardan, (-0.01, 0.02, 0.48), small, Frame((0.03, 0.01, 0.07), (0.0, 5.0, 0.0)),
            Frame((0.0, 0.0, 0.2), (0.0, 0.0, -35.0)), lead=-0.01, axes=_across(*cardan, (-0.01, 0.02, 0.48)),
        ),
    ]  # fmt: skip
    return {machine.name: machine for machine in zoo}


def machine_names() -> list[str]:
    """Return the machines for tests of all machines: by default one in inches and one that turns its screws, or all."""
    return list(machines()) if os.environ.get("ALL_TESTS") else ["inches", "left-hand"]


def with_frames(name: str) -> Machine:
    """Return a machine of the zoo with two more tools and one more work frame, all of them turned."""
    machine = machines()[name]
    (x, y, z), (a, b, c) = machine.tool.position, machine.work.position
    longer = Frame((x + 0.013, y - 0.007, z + float(np.copysign(0.031, z))), (4.0, -3.0, 35.0))
    tools = {"probe": longer, "stub": Frame((0.004, 0.002, 0.0), (0.0, 2.0, -20.0))}
    fixture = Frame((a + 0.04, b - 0.06, c + 0.02), (-2.0, 1.5, 48.0))
    return replace(machine, tools=tools, work_frames={"fixture": fixture})
