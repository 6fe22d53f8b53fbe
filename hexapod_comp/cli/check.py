"""``hexapod_comp check``: every limit along a list of poses, before anything moves."""

from __future__ import annotations

import argparse
import math
from typing import TYPE_CHECKING, Any

from ..formats import texts
from . import common

if TYPE_CHECKING:
    from ..compensation.checks import Breach, CheckResult
    from ..formats.csv import Row
    from ..machine.geometry import HexapodGeometry, Limits
    from ..machine.model import MachineModel

MOST_ROWS = 100
"""Rows of margins printed; --out writes all."""

MOST_BREACHES = 20
"""Broken limits printed; --json prints all."""

UNSIGNED = ("step", "speed")
"""Values of which only the size is of interest."""

LIMITS_SHOWN = {
    # limit: (column, unit, factor from SI, digits, margin or value)
    "stroke": ("stroke_margin", "mm", 1e3, 3, "margin"),
    "base_cone": ("base_cone_margin", "deg", 180.0 / math.pi, 3, "margin"),
    "platform_cone": ("platform_cone_margin", "deg", 180.0 / math.pi, 3, "margin"),
    "clearance": ("clearance_margin", "mm", 1e3, 3, "margin"),
    "condition": ("condition", "", 1.0, 3, "value"),
    "correction": ("correction", "um", 1e6, 2, "value"),
    "step": ("step", "mm", 1e3, 4, "value"),
    "speed": ("speed", "mm_s", 1e3, 2, "value"),
}


def run(args: argparse.Namespace) -> int:
    """Run the verb; 0 when all limits are kept, 1 when one is broken."""
    from ..compensation.checks import check
    from ..formats.csv import read_pose_arrays

    with common.stage(f"reading {args.poses}"):
        rows, positions, rotations = read_pose_arrays(args.poses)
    geometry, model = common.load_machine(args)
    mode = "stream" if args.stream else "moves"
    with common.progress_bar(len(rows), " poses") as bar:
        result = check(geometry, model, (positions, rotations), mode, args.rate_hz, bar.update)
    if not args.json:
        common.mention_default(args, geometry)
    common.write_table(args, (_row_values(rows[n], n, result) for n in range(len(rows))))
    common.show(_as_json(geometry, model, rows, result) if args.json else _report(args, geometry, model, rows, result))
    return 0 if result.ok else 1


def _report(
    args: argparse.Namespace,
    geometry: HexapodGeometry,
    model: MachineModel,
    rows: list[Row],
    result: CheckResult,
) -> str:
    """Return everything that a person reads."""
    ideal = args.model == "ideal"
    lines = [_title(geometry, model, rows, result)]
    if not args.out:
        lines += ["", _margin_table(rows, result, ideal)]
    if result.breaches:
        lines += ["", f"broken limits ({len(result.breaches)}):"]
        lines += [f"{_place(rows, breach)}: {breach.error}" for breach in result.breaches[:MOST_BREACHES]]
        if len(result.breaches) > MOST_BREACHES:
            lines.append(f"… and {len(result.breaches) - MOST_BREACHES} more; --json prints all")
    lines += ["", "smallest margin per limit:", _smallest_table(geometry.limits, rows, result)]
    lines += ["", *_notes(geometry, model, rows, result), _verdict(rows, result)]
    return "\n".join(lines)


def _title(geometry: HexapodGeometry, model: MachineModel, rows: list[Row], result: CheckResult) -> str:
    counted = f"{len(rows)} pose{'s' * (len(rows) != 1)} of {common.whose(geometry)}"
    what = {
        "moves": f"{counted} as targets joined by moves at {result.rate:g} Hz",
        "stream": f"{counted} as a stream at {result.rate:g} Hz",
    }[result.mode]
    return f"machine {geometry.name}, model {model.name}: {what}; {result.examined} poses examined"


def _margin_table(rows: list[Row], result: CheckResult, ideal: bool) -> str:
    """Return the table of margins; with a model, nominal and compensated stand side by side."""
    shown = range(len(rows))
    note = ""
    if len(rows) > MOST_ROWS:
        shown = range(MOST_ROWS)
        note = f"\n… and {len(rows) - MOST_ROWS} more rows; --out FILE writes all"
    header = ["row", "line"]
    for name in result.limits:
        column, unit, *_ = LIMITS_SHOWN[name]
        header.append("_".join(filter(None, (column.removesuffix("_margin"), unit))))
    body = [[rows[n].label, str(rows[n].line), *_row_cells(result, n, ideal)] for n in shown]
    kind = "" if ideal else " (nominal/compensated)"
    way = ", the worst of the move to each pose" if result.mode == "moves" else ""
    return f"margins of stroke and cones, values of the rest{kind}{way}:\n{texts.aligned(header, body)}{note}"


def _row_cells(result: CheckResult, n: int, ideal: bool) -> list[str]:
    cells = []
    for name in result.limits:
        stages = (1,) if name == "correction" else (0,) if ideal else (0, 1)
        cells.append("/".join(_cell(result, name, n, stage) for stage in stages))
    return cells


def _cell(result: CheckResult, name: str, n: int, stage: int) -> str:
    digits = LIMITS_SHOWN[name][3]
    value = _shown(result, name, n, stage)
    return texts.number(value, digits) if math.isfinite(value) else "–"


def _shown(result: CheckResult, name: str, n: int, stage: int) -> float:
    """Return margin or value, whichever is shown, in the unit shown."""
    _, _, factor, _, kind = LIMITS_SHOWN[name]
    summary = result.limits[name]
    shown = summary.margin if kind == "margin" else summary.value
    value = float(shown[n, stage]) * factor
    return abs(value) if name in UNSIGNED else value


def _row_values(row: Row, n: int, result: CheckResult) -> dict[str, Any]:
    """Return one row's margins and values for CSV and JSON."""
    values: dict[str, Any] = {"sequence": row.label, "line": row.line}
    for name in result.limits:
        column, unit, *_ = LIMITS_SHOWN[name]
        for stage, which in enumerate(("nominal", "compensated")):
            if name == "correction":
                if stage:
                    values[f"{column}_{unit}"] = _shown(result, name, n, stage)
                continue
            values["_".join(filter(None, (column, which, unit)))] = _shown(result, name, n, stage)
    values["move_checked"] = int(not result.unchecked_moves[n])
    return values


def _place(rows: list[Row], breach: Breach) -> str:
    where = common.where(rows[breach.row])
    return where if breach.share == 1.0 else f"{where}, on the way, {breach.share * 100:.1f} % of the move"


def _allowed(limits: Limits, name: str, strut: int, value: float) -> float:
    """Return the allowed value next to `value`, SI."""
    if name == "stroke":
        low, high = limits.stroke[strut]
        return float(low if value - low < high - value else high)
    bound = getattr(limits, name)
    return float(bound[strut]) if name.endswith("cone") else float(bound)


def _smallest(limits: Limits, rows: list[Row], result: CheckResult) -> list[dict[str, Any]]:
    """Return, for each limit, the smallest margin and where it is; units as shown."""
    listed = []
    for name, summary in result.limits.items():
        _, unit, factor, *_ = LIMITS_SHOWN[name]
        place = summary.smallest()
        if place is None:
            continue
        row, stage = place
        strut, value = int(summary.strut[place]), float(summary.value[place])
        listed.append(
            {
                "limit": name,
                "unit": unit,
                "margin": float(summary.margin[place]) * factor,
                "value": (abs(value) if name in UNSIGNED else value) * factor,
                "allowed": _allowed(limits, name, strut, value) * factor,
                "strut": strut + 1 if strut >= 0 else None,
                "stage": ("nominal", "compensated")[stage],
                "row": row + 1,
                "label": rows[row].label,
                "line": rows[row].line,
                "share_of_move": float(summary.share[place]),
            }
        )
    return listed


def _smallest_table(limits: Limits, rows: list[Row], result: CheckResult) -> str:
    header = ["limit", "margin", "value", "allowed", "unit", "strut", "stage", "row", "line", "of the move"]
    body = []
    for entry in _smallest(limits, rows, result):
        digits = LIMITS_SHOWN[entry["limit"]][3]
        numbers = [f"{entry[key]:.{digits}f}" for key in ("margin", "value", "allowed")]
        way = "at the pose" if entry["share_of_move"] == 1.0 else f"{entry['share_of_move'] * 100:.1f} %"
        strut = str(entry["strut"] or "–")
        place = [entry["stage"], entry["label"], str(entry["line"]), way]
        body.append([entry["limit"], *numbers, entry["unit"].replace("_", "/") or "–", strut, *place])
    return texts.aligned(header, body)


def _notes(geometry: HexapodGeometry, model: MachineModel, rows: list[Row], result: CheckResult) -> list[str]:
    """Return what a reader should know that is no broken limit."""
    from ..machine.region import region_text

    notes = []
    if result.unchecked_moves.any():
        skipped = int(result.unchecked_moves.sum())
        first = rows[int(result.unchecked_moves.argmax())]
        notes.append(
            f"not checked: {skipped} moves of which an end breaks a limit by itself, the first to {common.where(first)}"
        )
    for outside, problem in (
        (result.outside_box, "outside the box in which the model was measured"),
        (result.outside_field, "outside the error field, whose value at the boundary is held there"),
    ):
        if outside.any():
            first = rows[int(outside.argmax())]
            notes.append(f"note: {problem}: {int(outside.sum())} of {len(rows)}, first {common.where(first)}")
    if result.outside_box.any():
        notes.append(f"  {region_text(model.measured, geometry)}")
    return notes


def _verdict(rows: list[Row], result: CheckResult) -> str:
    if result.ok:
        return "all within limits"
    broken = len({breach.row for breach in result.breaches})
    return f"LIMITS BROKEN: {len(result.breaches)}, on {broken} of {len(rows)} poses"


def _as_json(geometry: HexapodGeometry, model: MachineModel, rows: list[Row], result: CheckResult) -> dict[str, Any]:
    from ..machine.region import region_json

    return {
        "machine": geometry.name,
        "model": model.name,
        **common.frames(geometry),
        "mode": result.mode,
        "rate_hz": result.rate,
        "within_limits": result.ok,
        "poses_examined": result.examined,
        "measured_box": region_json(model.measured, geometry),
        "broken": [_breach_json(rows, breach) for breach in result.breaches],
        "smallest_margins": _smallest(geometry.limits, rows, result),
        "rows": [_row_values(row, n, result) for n, row in enumerate(rows)],
    }


def _breach_json(rows: list[Row], breach: Breach) -> dict[str, Any]:
    error, row = breach.error, rows[breach.row]
    content: dict[str, Any] = {
        "row": breach.row + 1,
        "label": row.label,
        "line": row.line,
        "share_of_move": breach.share,
        "limit": breach.limit,
        "problem": str(error),
    }
    if breach.limit in LIMITS_SHOWN:
        _, unit, factor, *_ = LIMITS_SHOWN[breach.limit]
        content |= {"value": error.value * factor, "allowed": error.limit * factor, "unit": unit}  # type: ignore[attr-defined]
        strut = error.strut  # type: ignore[attr-defined]
        content |= {"strut": None if strut is None else strut + 1, "stage": error.stage}  # type: ignore[attr-defined]
    return content
