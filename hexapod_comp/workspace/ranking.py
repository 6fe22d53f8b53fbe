"""The ranking of error types by their effect on the tool, beside Table 1 of v. Daake et al."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ..errors import KinematicsError
from ..formats.texts import aligned, number
from ..machine.geometry import HexapodGeometry, first_of_same
from ..machine.kinematics import Structure, strut_lengths
from ..pose import angles_from_rotation
from .budget import SingleErrors
from .effects import Extremes

MICRO = 1e6
MILLIDEGREE = np.pi / 180e3
# A machine with longer struts at home, m, is not of the kind that v. Daake et al. classify.
LONGEST_OF_UNIT = 0.4
# Types that v. Daake et al. put into one row, by their titles.
JOINED = {
    "base-/platform joint (x/y)": ("base joint x/y", "platform joint x/y"),
    "base-/platform joint (z)": ("base joint z", "platform joint z"),
}

QUANTITIES = ("translation_max", "translation_min", "rotation_max", "rotation_min")


@dataclass(frozen=True)
class Extreme:
    """One figure of the ranking."""

    value: float  # m or rad
    error: str  # Which single error, with its type where several share a row
    position: np.ndarray  # (3,): ``pose_tool_in_work`` where it happens: m; α, β, γ, rad
    angles: np.ndarray  # (3,): ``pose_tool_in_work`` where it happens: m; α, β, γ, rad
    pose: int  # That pose's number


@dataclass(frozen=True)
class RankingRow:
    """One error type, or several that share a row."""

    title: str  # As people read it
    translation_max: Extreme  # Largest and smallest displacement of the tool, m
    translation_min: Extreme  # Largest and smallest displacement of the tool, m
    rotation_max: Extreme  # Largest and smallest of its rotation, the largest about three axes, rad
    rotation_min: Extreme  # Largest and smallest of its rotation, the largest about three axes, rad
    failed: int  # Number of effects without a certified solution

    def figures(self) -> np.ndarray:
        """Return the four values, m, m, rad, rad."""
        return np.array([getattr(self, name).value for name in QUANTITIES])


@dataclass(frozen=True)
class PaperRow:
    """A row of v. Daake et al., Table 1, as printed; zeros where they print "≈ 0"; m and rad."""

    title: str  # As printed
    size: float  # The error's size in the text, m
    figures: np.ndarray  # (4,): translation max, min, m; rotation max, min, rad


def _paper_row(title: str, size_um: float, um: tuple[float, float], mdeg: tuple[float, float]) -> PaperRow:
    return PaperRow(title, size_um / MICRO, np.array([v / MICRO for v in um] + [v * MILLIDEGREE for v in mdeg]))


# V. Daake et al., Table 1. Their machine's geometry is not printed: another machine cannot give the same digits.
PAPER_TABLE = (
    _paper_row("screw pitch", 20.0, (34.4, 22.4), (15.41, 10.71)),
    _paper_row("base-/platform joint (x/y)", 10.0, (13.68, 0.0), (6.16, 0.0)),
    _paper_row("base-/platform joint (z)", 10.0, (11.2, 11.18), (5.36, 3.84)),
    _paper_row("quantization", 7.0, (10.85, 7.84), (4.39, 3.81)),
)

_SAME_AS_PAPER = {"quantisation": "quantization"}


def ranked(
    extremes: Extremes, geometry: HexapodGeometry, joined: dict[str, tuple[str, ...]] | None = None
) -> list[RankingRow]:
    """Return one row per error type, the largest displacement of the tool first (v. Daake et al., Table 1)."""
    rows = [_row(extremes, geometry, title, kinds) for title, kinds in _groups(extremes.errors, joined)]
    return sorted(rows, key=lambda row: -row.translation_max.value)


def _groups(errors: SingleErrors, joined: dict[str, tuple[str, ...]] | None) -> list[tuple[str, list[int]]]:
    """Return title and type numbers of each row."""
    titles = errors.kinds
    rest, groups = list(range(len(titles))), []
    for title, members in (JOINED if joined is None else joined).items():
        kinds = [k for k in rest if titles[k] in members]
        if len(kinds) > 1:
            groups.append((title, kinds))
            rest = [k for k in rest if k not in kinds]
    return groups + [(titles[k], [k]) for k in rest]


def _row(extremes: Extremes, geometry: HexapodGeometry, title: str, kinds: list[int]) -> RankingRow:
    a, b, c, d = (_extreme(extremes, geometry, title, kinds, column) for column in range(4))
    return RankingRow(title, a, b, c, d, int(extremes.failed[kinds].sum()))


def _extreme(extremes: Extremes, geometry: HexapodGeometry, title: str, kinds: list[int], column: int) -> Extreme:
    """Return one column's extreme over some types."""
    values = extremes.values[kinds, column]
    if np.isnan(values).all():
        problem = f"{title}: no pose of {extremes.poses} has a certified solution; is the workspace reachable?"
        raise KinematicsError(problem, extremes.poses)
    kind = kinds[int(np.nanargmin(values) if column % 2 else np.nanargmax(values))]
    errors, error = extremes.errors, int(extremes.at_error[kind, column])
    label = errors.labels[error]
    rotation = extremes.rotations[kind, column]
    tip = extremes.positions[kind, column] + rotation @ geometry.tool.position
    position = geometry.work.rotation.T @ (tip - geometry.work.position)
    angles = angles_from_rotation(geometry.work.rotation.T @ rotation @ geometry.tool.rotation)
    pose = int(extremes.at_pose[kind, column])
    return Extreme(float(extremes.values[kind, column]), label, position, angles, pose)


def paper_row(title: str) -> PaperRow | None:
    """Return the row of v. Daake et al., Table 1, for an error type; None for a type that it does not have."""
    wanted = _SAME_AS_PAPER.get(title, title)
    return next((row for row in PAPER_TABLE if row.title == wanted), None)


def beside(geometry: HexapodGeometry, errors: SingleErrors) -> dict[str, PaperRow]:
    """Return the rows of v. Daake et al., Table 1, that say something about a machine, by the rows' own titles here."""
    longest = strut_lengths(Structure.of(geometry), geometry.home).max()
    if longest > LONGEST_OF_UNIT or (first_of_same(geometry.platform_joints) != np.arange(6)).any():
        return {}
    rows = {}
    for title, kinds in _groups(errors, None):
        row, members = paper_row(title), np.isin(errors.kind, kinds)
        sizes = np.linalg.norm(errors.vector[members], axis=1)
        if row is not None and np.allclose(sizes, row.size, rtol=1e-9, atol=0.0):
            rows[title] = row
    return rows


def ranking_text(rows: Sequence[RankingRow], printed: Mapping[str, PaperRow] | None = None) -> str:
    """Return the ranking as tables: Table 1's figures, those of `printed` in brackets, and where each happens."""
    head = ["error type", "transl. max µm", "transl. min µm", "rot. max m°", "rot. min m°"]
    printed = printed or {}
    lines = [[row.title, *(_cell(row, printed.get(row.title), column) for column in range(4))] for row in rows]
    parts = [aligned(head, lines)]
    if printed:
        source = "v. Daake et al., Table 1, of a machine whose geometry is not printed, so not to be met"
        parts.append(f"In brackets: {source}.")
    parts.append(aligned(["error type", "figure", "by", "tool in work: x, y, z mm", "α, β, γ °"], _places(rows)))
    failed = sum(row.failed for row in rows)
    if failed:
        parts.append(f"{failed} effects have no certified solution and were left out.")
    return "\n\n".join(parts)


def _cell(row: RankingRow, printed: PaperRow | None, column: int) -> str:
    """Return one figure with the paper's in brackets."""
    own = _shown(row.figures()[column], column)
    return own if printed is None else f"{own} ({_shown(printed.figures[column], column)})"


def _shown(value: float, column: int) -> str:
    return number(value * MICRO, 2) if column < 2 else number(value / MILLIDEGREE, 2)


def _places(rows: Sequence[RankingRow]) -> list[list[str]]:
    """Return the error and the pose of each figure."""
    lines = []
    for row in rows:
        for name in QUANTITIES:
            extreme = getattr(row, name)
            place = ", ".join(number(1e3 * v, 1) for v in extreme.position)
            tilt = ", ".join(number(float(np.rad2deg(v)), 1) for v in extreme.angles)
            lines.append([row.title, name.replace("_", " "), extreme.error, place, tilt])
    return lines


def ranking_rows(rows: Sequence[RankingRow], printed: Mapping[str, PaperRow] | None = None) -> list[dict[str, Any]]:
    """Return the ranking for CSV or JSON: a record per row, units in the keys; figures of `printed` beside, or None."""
    records = []
    for rank, row in enumerate(rows, start=1):
        paper = (printed or {}).get(row.title)
        record: dict[str, Any] = {"rank": rank, "error_type": row.title, "frame": "work"}
        for column, name in enumerate(QUANTITIES):
            extreme = getattr(row, name)
            factor, unit = (MICRO, "um") if column < 2 else (1.0 / MILLIDEGREE, "mdeg")
            record[f"{name}_{unit}"] = extreme.value * factor
            record[f"{name}_paper_{unit}"] = None if paper is None else float(paper.figures[column] * factor)
            record[f"{name}_error"] = extreme.error
            for axis, value in zip("xyz", extreme.position, strict=True):
                record[f"{name}_{axis}_mm"] = float(value * 1e3)
            for angle, value in zip(("alpha", "beta", "gamma"), extreme.angles, strict=True):
                record[f"{name}_{angle}_deg"] = float(np.rad2deg(value))
        record["failed"] = row.failed
        records.append(record)
    return records
