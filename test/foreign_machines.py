"""Machines that are not the paper's, with kinematics of the tests' own.

Nothing here uses the package: closures are written out from the geometry file's and the model file's description
(L = command + offset + pitch · (command − reference) between the real joints), solved by Newton's method with the
textbook Jacobian, rows (u, R·p × u). Lengths are m, positions (N, 3), rotations (N, 3, 3).
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import yaml

MM, INCH = 1e-3, 0.0254
UM = 1e-6


def rotation(alpha: float, beta: float, gamma: float) -> np.ndarray:
    """Return R = Ry(β)·Rx(α)·Rz(γ), angles in degrees, as doc/theory.md has it."""
    (ca, cb, cc), (sa, sb, sc) = (f(np.radians([alpha, beta, gamma])) for f in (np.cos, np.sin))
    about_y = np.array([[cb, 0.0, sb], [0.0, 1.0, 0.0], [-sb, 0.0, cb]])
    about_x = np.array([[1.0, 0.0, 0.0], [0.0, ca, -sa], [0.0, sa, ca]])
    return about_y @ about_x @ np.array([[cc, -sc, 0.0], [sc, cc, 0.0], [0.0, 0.0, 1.0]])


@dataclass(frozen=True)
class Frame:
    """A pose as a geometry file has it: position, m, and α, β, γ, degrees."""

    position: tuple[float, float, float] = (0.0, 0.0, 0.0)
    angles: tuple[float, float, float] = (0.0, 0.0, 0.0)

    @property
    def matrix(self) -> np.ndarray:
        return rotation(*self.angles)


@dataclass(frozen=True)
class Machine:
    """A hexapod; `half`: half sides of the box of tool positions in work that is measured, around `middle`."""

    name: str
    base: np.ndarray
    platform: np.ndarray
    home: tuple[float, float, float]
    half: tuple[float, float, float]
    tool: Frame = field(default_factory=Frame)
    work: Frame = field(default_factory=Frame)
    stroke: tuple[float, float] = (0.25, 1.2)
    unit: str = "mm"

    def level(self) -> np.ndarray:
        """Return the platform's rotation in base when the tool is parallel to work."""
        return self.work.matrix @ self.tool.matrix.T

    def platforms(self, tips: np.ndarray) -> np.ndarray:
        """Return where the platform is for a level tool at places of work (N, 3)."""
        in_base = np.array(self.work.position) + tips @ self.work.matrix.T
        return in_base - self.level() @ np.array(self.tool.position)

    def tips(self, positions: np.ndarray, rotations: np.ndarray) -> np.ndarray:
        """Return where the tool's tip is in work for platform poses in base."""
        in_base = positions + rotations @ np.array(self.tool.position)
        return (in_base - np.array(self.work.position)) @ self.work.matrix

    @property
    def middle(self) -> np.ndarray:
        """The tip in work of a level tool with the platform at home."""
        return self.tips(np.array([self.home]), self.level()[None])[0]

    @property
    def box(self) -> np.ndarray:
        """The measured box of tips in work."""
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
            },
        }
        path.write_text(yaml.safe_dump(content))
        return path


@dataclass(frozen=True)
class Errors:
    """What a model file says of structure and struts, SI."""

    base: np.ndarray
    platform: np.ndarray
    offset: np.ndarray
    pitch: np.ndarray
    reference: np.ndarray

    @staticmethod
    def none() -> Errors:
        return Errors(np.zeros((6, 3)), np.zeros((6, 3)), np.zeros(6), np.zeros(6), np.zeros(6))

    @staticmethod
    def drawn(machine: Machine, seed: int, size: float = 50 * UM) -> Errors:
        """Draw errors; platform joints at the same place share theirs."""
        rng = np.random.default_rng(seed)
        base, platform = rng.uniform(-size, size, (2, 6, 3))
        _, first = np.unique(machine.platform.round(9), axis=0, return_inverse=True)
        offset, pitch = rng.uniform(-size, size, (2, 6))
        home = np.linalg.norm(np.array(machine.home) + machine.platform - machine.base, axis=1)
        return Errors(base, platform[first.ravel()], offset, pitch, home)

    @staticmethod
    def read(path: Path) -> Errors:
        """Read a model file that has no more than structure, offset and pitch."""
        content = yaml.safe_load(path.read_text())
        structure, struts = content.get("structure", {}), content.get("struts", {})
        assert "wave" not in struts
        assert "map" not in struts
        assert not content.get("field", {}).get("lines")
        values = [np.array(structure[f"{body}_deviation_um"]) * UM for body in ("base", "platform")]
        values += [np.full(6, struts.get(key, 0.0)) * unit for key, unit in
                   (("offset_um", UM), ("pitch_ppm", 1e-6), ("reference_length_mm", MM))]  # fmt: skip
        return Errors(*values)

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
    """Return what the struts must be told for platform poses if the machine has these errors, (N, 6), m."""
    ends = positions[:, None] + (machine.platform + errors.platform) @ np.swapaxes(rotations, 1, 2)
    lengths = np.linalg.norm(ends - machine.base - errors.base, axis=2)
    return (lengths - errors.offset + errors.pitch * errors.reference) / (1.0 + errors.pitch)


def goes_to(
    machine: Machine, errors: Errors, told: np.ndarray, positions: np.ndarray, rotations: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return where the machine with these errors goes when told lengths (N, 6), by Newton from the poses meant."""
    wanted = told + errors.offset + errors.pitch * (told - errors.reference)
    positions, rotations = positions.copy(), rotations.copy()
    for _ in range(6):  # quadratic, from a tenth of a millimetre: two are enough
        arms = (machine.platform + errors.platform) @ np.swapaxes(rotations, 1, 2)
        struts = positions[:, None] + arms - machine.base - errors.base
        lengths = np.linalg.norm(struts, axis=2)
        u = struts / lengths[:, :, None]
        step = np.linalg.solve(np.concatenate([u, np.cross(arms, u)], axis=2), (wanted - lengths)[:, :, None])[:, :, 0]
        positions += step[:, :3]
        rotations = _turned(step[:, 3:]) @ rotations
    assert np.abs(wanted - lengths).max() < 1e-12
    return positions, rotations


def _turned(vectors: np.ndarray) -> np.ndarray:
    """Return rotation matrices of rotation vectors (N, 3), Rodrigues' formula."""
    angle = np.linalg.norm(vectors, axis=1)[:, None, None]
    k = np.zeros((len(vectors), 3, 3))
    x, y, z = vectors.T
    k[:, 0, 1], k[:, 0, 2], k[:, 1, 2] = -z, y, -x
    k -= np.swapaxes(k, 1, 2)
    safe = np.where(angle > 0.0, angle, 1.0)
    return np.eye(3) + k * np.sin(angle) / safe + k @ k * (1.0 - np.cos(angle)) / safe**2


def tool_errors(machine: Machine, truth: Errors, believed: Errors, tips: np.ndarray) -> np.ndarray:
    """Return actual minus wanted tip (N, 3), m in work, of a level tool told what `believed` makes of it."""
    positions = machine.platforms(tips)
    rotations = np.tile(machine.level(), (len(tips), 1, 1))
    told = commands(machine, believed, positions, rotations)
    return machine.tips(*goes_to(machine, truth, told, positions, rotations)) - tips


def aligned_rms(tips: np.ndarray, errors: np.ndarray) -> float:
    """Return the RMS length of errors after the best small shift and rotation, by least squares."""
    x, y, z = (tips - tips.mean(axis=0)).T
    o, i = np.zeros_like(x), np.ones_like(x)
    rows = np.stack([[i, o, o, o, z, -y], [o, i, o, -z, o, x], [o, o, i, y, -x, o]]).transpose(2, 0, 1).reshape(-1, 6)
    flat = errors.ravel()
    left = flat - rows @ np.linalg.lstsq(rows, flat, rcond=None)[0]
    return float(np.sqrt((left @ left) / len(tips)))


def _paper() -> tuple[np.ndarray, np.ndarray]:
    """Return the joints of 000's machine from its dimensions, Figure 3."""
    a, b, d = 0.3, 0.572, 0.243
    third = np.sqrt(3.0) / 6.0
    half = [(third * (2 * b + d), d / 2), (-third * (b - d), (b + d) / 2), (-third * (b + 2 * d), b / 2)]
    base = np.array([(x, y, 0.0) for x, y in half] + [(x, -y, 0.0) for x, y in half[::-1]])
    corners = np.radians([60.0, 60.0, 180.0, 180.0, -60.0, -60.0])
    return base, a / np.sqrt(3.0) * np.stack([np.cos(corners), np.sin(corners), 0.0 * corners], axis=1)


def _ring(radius: float, angles: list[float], heights: list[float]) -> np.ndarray:
    turns = np.radians(angles)
    return np.stack([radius * np.cos(turns), radius * np.sin(turns), np.array(heights)], axis=1)


def machines() -> dict[str, Machine]:
    """Return the machines by name."""
    paper = _paper()
    uneven = (
        _ring(0.42, [12.0, 52.0, 128.0, 171.0, 247.0, 290.0], [0.0, 0.012, -0.008, 0.004, 0.0, -0.01]),
        _ring(0.17, [22.0, 38.0, 143.0, 158.0, 262.0, 278.0], [0.0, 0.004, -0.003, 0.0, 0.002, -0.006]),
    )
    flipped = np.array([1.0, -1.0, -1.0])
    small = (0.1, 0.09, 0.05)
    framed = {
        "tool": Frame((0.021, -0.014, 0.095), (3.0, -4.0, 90.0)),
        "work": Frame((0.15, -0.08, 0.31), (2.0, -3.0, 72.0)),
    }
    return {
        "paper": Machine("paper", *paper, (0.0, 0.0, 0.4516), (0.15, 0.15, 0.08)),
        "tool offset": Machine("offset", *paper, (0.0, 0.0, 0.45), small, Frame((0.0, 0.0, 0.26))),
        "framed 6-6": Machine("framed", *uneven, (0.01, -0.02, 0.5), small, **framed),
        "hanging": Machine(
            "hanging", uneven[0] * flipped, uneven[1] * flipped, (0.0, 0.01, -0.52), small,
            Frame((0.01, 0.0, -0.12)), Frame((-0.05, 0.02, -0.9), (0.0, 0.0, 25.0)),
        ),
        "inches": Machine(
            "inches", 1.2 * paper[0], 1.2 * paper[1], (0.0, 0.0, 22 * INCH), (4 * INCH, 4 * INCH, 2 * INCH),
            Frame((0.0, 0.5 * INCH, 3 * INCH), (0.0, 0.0, -90.0)), Frame((INCH, 0.0, 6 * INCH), (0.0, 0.0, -90.0)),
            unit="in",
        ),
    }  # fmt: skip
