"""``hexapod_comp assess``: the paper's performance assessment with machines drawn at random."""

from __future__ import annotations

import argparse
import math
from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING, Any

from ..formats import texts
from . import common

if TYPE_CHECKING:
    import numpy as np

    from ..formats.csv import Row
    from ..machine.geometry import HexapodGeometry
    from ..pose import Pose
    from ..virtual.assessment import Assessment

POSE_COLUMNS = ("alpha_deg", "beta_deg", "gamma_deg", "x_mm", "y_mm", "z_mm")
MOST_RESULTS = 10_000_000
"""Machines times poses: more results are refused, they would need gigabytes."""

PERCENTILES = (50.0, 95.0, 100.0)
NAMES = ("median", "95 %", "max")


def run(args: argparse.Namespace) -> int:
    """Run the verb."""
    from ..errors import CommandError
    from ..formats.csv import read_poses
    from ..virtual.assessment import assess
    from ..virtual.imperfections import ImperfectionBounds

    rows, poses = read_poses(args.poses)
    if args.machines * len(poses) > MOST_RESULTS:
        most = MOST_RESULTS // len(poses)
        problem = f"--machines: at most {most} at {len(poses)} poses, not {args.machines}"
        raise CommandError("usage", problem)
    geometry, _ = common.load_machine(args)
    bounds = ImperfectionBounds(
        joint=args.joint_um * 1e-6,
        strut_offset=args.strut_um * 1e-6,
        pitch=args.pitch_ppm * 1e-6,
        wave=(0.0, args.wave_um * 1e-6),
        wave_period=args.wave_period_mm * 1e-3,
        shared_platform_joints=not args.separate_platform_joints,
    )
    names = [common.where(row) for row in rows]
    with common.progress_bar(args.machines, " machines") as bar:
        result = assess(geometry, poses, bounds, args.seed, args.machines, names, bar.update)
    common.write_table(args, _records(rows, result) if args.out is not None else ())
    common.show(
        _as_json(args, geometry, rows, poses, result) if args.json else _report(args, geometry, rows, poses, result)
    )
    return 0


def _report(
    args: argparse.Namespace,
    geometry: HexapodGeometry,
    rows: list[Row],
    poses: list[Pose],
    result: Assessment,
) -> str:
    """Return the paper's tables for the first machine, and statistics over all."""
    real, changes = result.real_lengths[0], result.strut_changes[0] * 1e6
    last = f"…{result.seeds[-1]}" if len(result.seeds) > 1 else ""
    lines = [f"machine {geometry.name}, {_bounds_text(args)}; seed {result.seeds[0]}{last}"]
    commanded = _pose_rows(poses)
    lines += ["", "commanded poses of the tool in work (as Table 1):", _table(POSE_COLUMNS, rows, commanded, 6)]
    lines += ["", "strut lengths of the ideal machine (as Table 2):", _lengths(rows, result.ideal_lengths)]
    lines += ["", "strut lengths of the real machine at the same poses (as Table 4):", _lengths(rows, real)]
    header = [f"dL{i}_um" for i in range(1, 7)]
    lines += ["", "real minus ideal (Table 4 − Table 2):", _table(header, rows, changes, 3)]
    taken = _pose_rows(_taken(result))
    lines += [
        "",
        "pose of the tool in work that the real machine takes under ideal lengths:",
        _table(POSE_COLUMNS, rows, taken, 6),
    ]
    if len(result.seeds) > 1:
        lines += ["", *_statistics(rows, result)]
    lines += ["", *_conclusion(args, result)]
    return "\n".join(lines)


def _bounds_text(args: argparse.Namespace) -> str:
    parts = [f"joints ±{args.joint_um:g} µm, struts ±{args.strut_um:g} µm"]
    parts += [f"pitch ±{args.pitch_ppm:g} ppm"] * bool(args.pitch_ppm)
    parts += [f"waves up to {args.wave_um:g} µm"] * bool(args.wave_um)
    return ", ".join(parts)


def _pose_rows(poses: list[Pose]) -> list[list[float]]:
    """Return poses as rows in the paper's column order, degrees and mm."""
    from ..formats.csv import pose_values

    return [[pose_values(pose)[name] for name in POSE_COLUMNS] for pose in poses]


def _taken(result: Assessment) -> list[Pose]:
    from ..pose import Pose

    return [Pose(p, r) for p, r in zip(result.taken_positions[0], result.taken_rotations[0], strict=True)]


def _table(header: Sequence[str], rows: list[Row], values: Iterable[Sequence[float]], digits: int) -> str:
    body = [
        [row.label, *(texts.number(float(v), digits) for v in line)] for row, line in zip(rows, values, strict=True)
    ]
    return texts.aligned(["sequence", *header], body)


def _lengths(rows: list[Row], lengths: np.ndarray) -> str:
    return _table([f"L{i}_mm" for i in range(1, 7)], rows, lengths * 1e3, 6)


def _statistics(rows: list[Row], result: Assessment) -> list[str]:
    """Return the table of percentiles over the machines."""
    statistics = result.statistics(PERCENTILES)
    header, columns = [], []
    for name, title, unit, factor in (
        ("strut_change", "|dL|", "um", 1e6),
        ("displacement", "|dp|", "um", 1e6),
        ("rotation", "angle", "deg", 180.0 / math.pi),
    ):
        header += [f"{title} {percentile} {unit}" for percentile in NAMES]
        columns.append((statistics[name] * factor, 3 if unit == "um" else 6))
    body = []
    for n, row in enumerate(rows):
        cells = [texts.number(float(v), digits) for values, digits in columns for v in values[n]]
        body.append([row.label, *cells])
    title = (
        f"over {len(result.seeds)} machines: largest strut change, tool displacement and rotation under ideal lengths:"
    )
    return [title, texts.aligned(["sequence", *header], body)]


def _conclusion(args: argparse.Namespace, result: Assessment) -> list[str]:
    """Say how large changes are beside what geometry allows, and how exact the round trip is."""
    largest = abs(result.strut_changes).max() * 1e6
    text = f"largest strut change {largest:.3f} µm"
    if not (args.pitch_ppm or args.wave_um):
        bound = 2.0 * math.sqrt(3.0) * args.joint_um + args.strut_um
        text += f" (two joints in a corner of their cubes and a strut allow {bound:.3f} µm)"
    distance, angle = result.round_trip[..., 0].max(), result.round_trip[..., 1].max()
    return [
        text,
        f"round trip of the real structure, pose → lengths → pose: within {distance:.1e} m and {angle:.1e} rad",
        "(exact to rounding; the paper's own Table 5 left up to 5 µm)",
    ]


def _records(rows: list[Row], result: Assessment) -> list[dict[str, Any]]:
    """Return one record per machine and pose, in units that people read."""
    from ..formats.csv import length_values, pose_values
    from ..pose import Pose

    records = []
    for m, seed in enumerate(result.seeds):
        for n, row in enumerate(rows):
            record: dict[str, Any] = {"seed": seed, "sequence": row.label}
            record |= {f"ideal_{k}": v for k, v in length_values(result.ideal_lengths[n]).items()}
            record |= {f"real_{k}": v for k, v in length_values(result.real_lengths[m, n]).items()}
            record |= {f"change_L{i + 1}_um": float(v) * 1e6 for i, v in enumerate(result.strut_changes[m, n])}
            taken = Pose(result.taken_positions[m, n], result.taken_rotations[m, n])
            record |= {f"taken_{k}": v for k, v in pose_values(taken).items()}
            error = result.pose_errors[m, n] * 1e6
            record |= {f"error_{k}": float(v) for k, v in zip(_ERRORS, error, strict=True)}
            record["round_trip_um"] = float(result.round_trip[m, n, 0]) * 1e6
            record["round_trip_urad"] = float(result.round_trip[m, n, 1]) * 1e6
            records.append(record)
    return records


_ERRORS = ("x_um", "y_um", "z_um", "rx_urad", "ry_urad", "rz_urad")


def _as_json(
    args: argparse.Namespace,
    geometry: HexapodGeometry,
    rows: list[Row],
    poses: list[Pose],
    result: Assessment,
) -> dict[str, Any]:
    percentiles = result.statistics(PERCENTILES)
    statistics = [
        {
            "sequence": row.label,
            **{f"{name}_um": percentiles[name][n] * 1e6 for name in ("strut_change", "displacement")},
            "rotation_deg": percentiles["rotation"][n] * (180.0 / math.pi),
        }
        for n, row in enumerate(rows)
    ]
    return {
        "machine": geometry.name,
        "frame": "work",
        "bounds": {"joint_um": args.joint_um, "strut_um": args.strut_um, "pitch_ppm": args.pitch_ppm}
        | {"wave_um": args.wave_um, "wave_period_mm": args.wave_period_mm},
        "seeds": list(result.seeds),
        "commanded": [dict(zip(POSE_COLUMNS, line, strict=True)) for line in _pose_rows(poses)],
        "percentiles": list(PERCENTILES),
        "statistics": statistics,
        "round_trip_m": float(result.round_trip[..., 0].max()),
        "round_trip_rad": float(result.round_trip[..., 1].max()),
        "records": _records(rows, result),
    }
