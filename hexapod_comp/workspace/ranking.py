"""The ranking of error types by their effect on the tool (Daake et al., Table 1)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ..errors import KinematicsError
from ..formats.texts import aligned, number
from ..machine.geometry import HexapodGeometry
from ..pose import angles_from_rotation
from .effects import Extremes
from .shells import ROTATION, TRANSLATION

# Rows that combine error types, as in Daake et al.: title of the row and of its types
JOINED = {
    "base-/platform joint (x/y)": ("base joint x/y", "platform joint x/y"),
    "base-/platform joint (z)": ("base joint z", "platform joint z"),
}

FIGURES = ("translation_max", "translation_min", "rotation_max", "rotation_min")
FACTORS = (TRANSLATION.factor,) * 2 + (ROTATION.factor,) * 2  # from m and rad to µm and m°


@dataclass(frozen=True)
class Extreme:
    """An extreme effect, with the single error and the pose that cause it."""

    value: float  # m or rad
    error: str  # label of the single error
    position: np.ndarray  # (3,): of ``pose_tool_in_work``, m
    angles: np.ndarray  # (3,): α, β, γ, rad


@dataclass(frozen=True)
class RankingRow:
    """Effects of one error type, or of several combined types."""

    title: str
    extremes: tuple[Extreme, ...]  # in the order of FIGURES; rotations are about the worst axis
    failed: int  # number of effects that were left out, because forward kinematics found no certified solution

    def figures(self) -> np.ndarray:
        return np.array([extreme.value for extreme in self.extremes])


def ranked(extremes: Extremes, geometry: HexapodGeometry) -> list[RankingRow]:
    """Return the ranking; the error type with the largest displacement of the tool is first."""
    titles = extremes.errors.kinds
    rest, groups = list(range(len(titles))), []
    for title, members in JOINED.items():
        kinds = [k for k in rest if titles[k] in members]
        if len(kinds) > 1:
            groups.append((title, kinds))
            rest = [k for k in rest if k not in kinds]
    rows = []
    for title, kinds in groups + [(titles[k], [k]) for k in rest]:
        four = tuple(_extreme(extremes, geometry, title, kinds, column) for column in range(4))
        rows.append(RankingRow(title, four, int(extremes.failed[kinds].sum())))
    return sorted(rows, key=lambda row: -row.extremes[0].value)


def _extreme(extremes: Extremes, geometry: HexapodGeometry, title: str, kinds: list[int], column: int) -> Extreme:
    """Return the largest or smallest effect, as FIGURES[column] names it, of the error types with indices `kinds`."""
    values = extremes.values[kinds, column]
    if np.isnan(values).all():
        problem = f"{title}: forward kinematics found the effect at none of {extremes.poses} poses"
        raise KinematicsError(f"{problem}; are the poses reachable?", extremes.poses)
    kind = kinds[int(np.nanargmin(values) if column % 2 else np.nanargmax(values))]
    errors, error = extremes.errors, int(extremes.at_error[kind, column])
    label = errors.labels[error]
    rotation = extremes.rotations[kind, column]
    tip = extremes.positions[kind, column] + rotation @ geometry.tool.position
    position = geometry.work.rotation.T @ (tip - geometry.work.position)
    angles = angles_from_rotation(geometry.work.rotation.T @ rotation @ geometry.tool.rotation)
    return Extreme(float(extremes.values[kind, column]), label, position, angles)


def ranking_text(rows: Sequence[RankingRow]) -> str:
    """Return the ranking as two tables: the effects, and the error and pose of each effect."""
    head = ["error type", "transl. max µm", "transl. min µm", "rot. max m°", "rot. min m°"]
    lines = [[row.title, *(number(value, 2) for value in row.figures() * FACTORS)] for row in rows]
    parts, places = [aligned(head, lines)], []
    for row in rows:
        for name, extreme in zip(FIGURES, row.extremes, strict=True):
            place, tilt = 1e3 * extreme.position, np.rad2deg(extreme.angles)
            cells = (", ".join(number(float(v), 1) for v in values) for values in (place, tilt))
            places.append([row.title, name.replace("_", " "), extreme.error, *cells])
    parts.append(aligned(["error type", "figure", "by", "tool in work: x, y, z mm", "α, β, γ °"], places))
    failed = sum(row.failed for row in rows)
    note = f"{failed} effects were left out, because forward kinematics found no pose of the machine with the error."
    return "\n\n".join(parts + [note] * bool(failed))


def ranking_rows(rows: Sequence[RankingRow]) -> list[dict[str, Any]]:
    """Return the ranking for CSV or JSON, a record for each row; keys end in their unit."""
    records = []
    for rank, row in enumerate(rows, start=1):
        record: dict[str, Any] = {"rank": rank, "error_type": row.title, "frame": "work"}
        for name, factor, extreme in zip(FIGURES, FACTORS, row.extremes, strict=True):
            record[f"{name}_{'um' if name.startswith('translation') else 'mdeg'}"] = extreme.value * factor
            record[f"{name}_error"] = extreme.error
            for axis, value in zip("xyz", extreme.position, strict=True):
                record[f"{name}_{axis}_mm"] = float(value * 1e3)
            for angle, value in zip(("alpha", "beta", "gamma"), extreme.angles, strict=True):
                record[f"{name}_{angle}_deg"] = float(np.rad2deg(value))
        record["failed"] = row.failed
        records.append(record)
    return records
