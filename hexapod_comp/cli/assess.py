"""``hexapod_comp assess``: the paper's performance assessment with machines drawn at random."""

from __future__ import annotations

import argparse
import math
from typing import Any

from ..errors import CommandError
from ..formats.csv import Row, length_values, pose_values, read_poses
from ..machine.geometry import HexapodGeometry
from ..pose import Pose
from ..virtual.assessment import Assessment, assess
from ..virtual.imperfections import ImperfectionBounds
from . import common
from .table import Table

POSE_COLUMNS = ("alpha_deg", "beta_deg", "gamma_deg", "x_mm", "y_mm", "z_mm")
MOST_RESULTS = 10_000_000  # machines times poses: more results are refused, they would need gigabytes

PERCENTILES = {"median": 50.0, "95 %": 95.0, "max": 100.0}
# Of what percentiles over the machines are shown: title, unit and its size
STATISTICS = {"strut_change": ("|dL|", "um", 1e6), "displacement": ("|dp|", "um", 1e6),
              "rotation": ("angle", "deg", 180.0 / math.pi)}  # fmt: skip

ERRORS = ("x_um", "y_um", "z_um", "rx_urad", "ry_urad", "rz_urad")


def run(args: argparse.Namespace) -> common.Result:
    """Run the verb."""
    rows, poses = read_poses(args.poses)
    if args.machines * len(poses) > MOST_RESULTS:
        most = MOST_RESULTS // len(poses)
        raise CommandError("usage", f"--machines: at most {most} at {len(poses)} poses, not {args.machines}")
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
    records = [_record(row, result, m, n) for m in range(len(result.seeds)) for n, row in enumerate(rows)]
    commanded = [pose_values(pose) for pose in poses]
    given = args, geometry, rows, commanded, records, result
    return common.Result(lambda: _report(*given), lambda: _as_json(*given), records)


def _record(row: Row, result: Assessment, m: int, n: int) -> dict[str, Any]:
    """Return what becomes of one machine at one pose, in units that people read."""
    record: dict[str, Any] = {"seed": result.seeds[m], "sequence": row.label}
    record |= {f"ideal_{k}": v for k, v in length_values(result.ideal_lengths[n]).items()}
    record |= {f"real_{k}": v for k, v in length_values(result.real_lengths[m, n]).items()}
    record |= {f"change_L{i + 1}_um": float(v) * 1e6 for i, v in enumerate(result.strut_changes[m, n])}
    taken = Pose(result.taken_positions[m, n], result.taken_rotations[m, n])
    record |= {f"taken_{k}": v for k, v in pose_values(taken).items()}
    record |= {f"error_{k}": float(v) * 1e6 for k, v in zip(ERRORS, result.pose_errors[m, n], strict=True)}
    trip = (result.round_trip[m, n] * 1e6).tolist()
    return record | {"round_trip_um": trip[0], "round_trip_urad": trip[1]}


def _report(
    args: argparse.Namespace,
    geometry: HexapodGeometry,
    rows: list[Row],
    commanded: list[dict[str, float]],
    records: list[dict[str, Any]],
    result: Assessment,
) -> str:
    """Return the paper's tables for the first machine, and statistics over all."""
    first = records[: len(rows)]

    def table(title: str, prefix: str, columns: tuple[str, ...], header: str = "") -> list[str]:
        names = [(header or "{}").format(column) for column in columns]
        pairs = [(name, prefix + column) for name, column in zip(names, columns, strict=True)]
        return ["", title, Table([{"sequence": r["sequence"], **{n: r[c] for n, c in pairs}} for r in first]).text()]

    lengths = tuple(f"L{i}_mm" for i in range(1, 7))
    bounds = [f"joints ±{args.joint_um:g} µm, struts ±{args.strut_um:g} µm"]
    bounds += [f"pitch ±{args.pitch_ppm:g} ppm"] * bool(args.pitch_ppm)
    bounds += [f"waves up to {args.wave_um:g} µm"] * bool(args.wave_um)
    last = f"…{result.seeds[-1]}" if len(result.seeds) > 1 else ""
    lines = [f"machine {geometry.name}, {', '.join(bounds)}; seed {result.seeds[0]}{last}"]
    poses = [{"sequence": row.label, **{c: pose[c] for c in POSE_COLUMNS}}
             for row, pose in zip(rows, commanded, strict=True)]  # fmt: skip
    lines += ["", "commanded poses of the tool in work (as Table 1):", Table(poses).text()]
    lines += table("strut lengths of the ideal machine (as Table 2):", "ideal_", lengths)
    lines += table("strut lengths of the real machine at the same poses (as Table 4):", "real_", lengths)
    lines += table("real minus ideal (Table 4 − Table 2):", "change_", tuple(f"L{i}_um" for i in range(1, 7)), "d{}")
    lines += table("pose of the tool in work that the real machine takes under ideal lengths:", "taken_", POSE_COLUMNS)
    if len(result.seeds) > 1:
        statistics = result.statistics(tuple(PERCENTILES.values()))
        body = [
            {"sequence": row.label}
            | {f"{title} {percentile} {unit}": float(statistics[name][n, k] * factor)
               for name, (title, unit, factor) in STATISTICS.items() for k, percentile in enumerate(PERCENTILES)}
            for n, row in enumerate(rows)
        ]  # fmt: skip
        digits = {name: 6 for name in body[0] if name.endswith("deg")}
        what = "largest strut change, tool displacement and rotation under ideal lengths:"
        lines += ["", f"over {len(result.seeds)} machines: {what}", Table(body).text(digits=digits)]
    text = f"largest strut change {abs(result.strut_changes).max() * 1e6:.3f} µm"
    if not (args.pitch_ppm or args.wave_um):
        bound = 2.0 * math.sqrt(3.0) * args.joint_um + args.strut_um
        text += f" (two joints in a corner of their cubes and a strut allow {bound:.3f} µm)"
    distance, angle = result.round_trip[..., 0].max(), result.round_trip[..., 1].max()
    trip = f"round trip of the real structure, pose → lengths → pose: within {distance:.1e} m and {angle:.1e} rad"
    return "\n".join([*lines, "", text, trip, "(exact to rounding; the paper's own Table 5 left up to 5 µm)"])


def _as_json(
    args: argparse.Namespace,
    geometry: HexapodGeometry,
    rows: list[Row],
    commanded: list[dict[str, float]],
    records: list[dict[str, Any]],
    result: Assessment,
) -> dict[str, Any]:
    percentiles = result.statistics(tuple(PERCENTILES.values()))
    return {
        "machine": geometry.name,
        "frame": "work",
        "bounds": {
            name: getattr(args, name) for name in ("joint_um", "strut_um", "pitch_ppm", "wave_um", "wave_period_mm")
        },
        "seeds": list(result.seeds),
        "commanded": [{name: pose[name] for name in POSE_COLUMNS} for pose in commanded],
        "percentiles": list(PERCENTILES.values()),
        "statistics": [
            {"sequence": row.label}
            | {f"{name}_{unit}": percentiles[name][n] * factor for name, (_, unit, factor) in STATISTICS.items()}
            for n, row in enumerate(rows)
        ],
        "round_trip_m": float(result.round_trip[..., 0].max()),
        "round_trip_rad": float(result.round_trip[..., 1].max()),
        "records": records,
    }
