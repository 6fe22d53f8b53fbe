"""``hexapod_comp check``: every limit along a list of poses, before anything moves."""

from __future__ import annotations

import argparse
import math
from typing import Any, NamedTuple

from ..compensation.checks import Breach, CheckResult, check
from ..formats import texts
from ..formats.csv import Row, read_pose_arrays
from ..machine.geometry import HexapodGeometry, Limits
from ..machine.model import MachineModel
from ..machine.region import region_json, region_text
from . import common

MOST_ROWS = 100  # rows of margins printed; --out writes all
MOST_BREACHES = 20  # broken limits printed; --json prints all


class Shown(NamedTuple):
    """How a limit is shown."""

    column: str
    unit: str
    factor: float  # from SI
    digits: int  # for people
    margin: bool = False  # its margin rather than its value
    unsigned: bool = False  # only its size is of interest


LIMITS_SHOWN = {
    "stroke": Shown("stroke_margin", "mm", 1e3, 3, margin=True),
    "base_cone": Shown("base_cone_margin", "deg", 180.0 / math.pi, 3, margin=True),
    "platform_cone": Shown("platform_cone_margin", "deg", 180.0 / math.pi, 3, margin=True),
    "clearance": Shown("clearance_margin", "mm", 1e3, 3, margin=True),
    "condition": Shown("condition", "", 1.0, 3),
    "correction": Shown("correction", "um", 1e6, 2),
    "step": Shown("step", "mm", 1e3, 4, unsigned=True),
    "speed": Shown("speed", "mm_s", 1e3, 2, unsigned=True),
}
STAGES = ("nominal", "compensated")


def run(args: argparse.Namespace) -> common.Result:
    """Run the verb; 0 when all limits are kept, 1 when one is broken."""
    with common.stage(f"reading {args.poses}"):
        rows, positions, rotations = read_pose_arrays(args.poses)
    geometry, model = common.load_machine(args)
    mode = "stream" if args.stream else "moves"
    with common.progress_bar(len(rows), " poses") as bar:
        result = check(geometry, model, (positions, rotations), mode, args.rate_hz, bar.update)
    if not args.json:
        common.mention_default(args, geometry)
    return common.Result(
        lambda: _report(args, geometry, model, rows, result),
        lambda: _as_json(geometry, model, rows, result),
        (_row_values(row, n, result) for n, row in enumerate(rows)),
        code=0 if result.ok else 1,
    )


def _value(result: CheckResult, name: str, n: int, stage: int) -> float:
    """Return margin or value, whichever is shown, in the unit shown."""
    shown, summary = LIMITS_SHOWN[name], result.limits[name]
    value = float((summary.margin if shown.margin else summary.value)[n, stage]) * shown.factor
    return abs(value) if shown.unsigned else value


def _row_values(row: Row, n: int, result: CheckResult) -> dict[str, Any]:
    """Return one row's margins and values for CSV and JSON."""
    values: dict[str, Any] = {"sequence": row.label, "line": row.line}
    for name in result.limits:
        column, unit = LIMITS_SHOWN[name][:2]
        for stage, which in enumerate(STAGES):
            if name != "correction":
                values["_".join(filter(None, (column, which, unit)))] = _value(result, name, n, stage)
            elif stage:
                values[f"{column}_{unit}"] = _value(result, name, n, stage)
    values["move_checked"] = int(not result.unchecked_moves[n])
    return values


def _report(
    args: argparse.Namespace, geometry: HexapodGeometry, model: MachineModel, rows: list[Row], result: CheckResult
) -> str:
    """Return everything that a person reads."""
    counted = f"{len(rows)} pose{'s' * (len(rows) != 1)} of {common.whose(geometry)}"
    joined = "as targets joined by moves" if result.mode == "moves" else "as a stream"
    title = f"machine {geometry.name}, model {model.name}: {counted} {joined} at {result.rate:g} Hz"
    lines = [f"{title}; {result.examined} poses examined"]
    if not args.out:
        lines += ["", _margin_table(rows, result, args.model == "ideal")]
    if result.breaches:
        lines += ["", f"broken limits ({len(result.breaches)}):"]
        for breach in result.breaches[:MOST_BREACHES]:
            way = "" if breach.share == 1.0 else f", on the way, {breach.share * 100:.1f} % of the move"
            lines.append(f"{common.where(rows[breach.row])}{way}: {breach.error}")
        if len(result.breaches) > MOST_BREACHES:
            lines.append(f"… and {len(result.breaches) - MOST_BREACHES} more; --json prints all")
    lines += ["", "smallest margin per limit:", _smallest_table(geometry.limits, rows, result), ""]
    lines += _notes(geometry, model, rows, result)
    broken = len({breach.row for breach in result.breaches})
    bad = f"LIMITS BROKEN: {len(result.breaches)}, on {broken} of {len(rows)} poses"
    return "\n".join([*lines, "all within limits" if result.ok else bad])


def _margin_table(rows: list[Row], result: CheckResult, ideal: bool) -> str:
    """Return the table of margins; with a model, nominal and compensated stand side by side."""

    def cell(name: str, n: int) -> str:
        stages = (1,) if name == "correction" else (0,) if ideal else (0, 1)
        values = (_value(result, name, n, stage) for stage in stages)
        return "/".join(texts.number(v, LIMITS_SHOWN[name].digits) if math.isfinite(v) else "–" for v in values)

    columns = (LIMITS_SHOWN[name] for name in result.limits)
    header = ["row", "line", *("_".join(filter(None, (c.column.removesuffix("_margin"), c.unit))) for c in columns)]
    body = [[row.label, str(row.line), *(cell(name, n) for name in result.limits)]
            for n, row in enumerate(rows[:MOST_ROWS])]  # fmt: skip
    kind = "" if ideal else " (nominal/compensated)"
    way = ", the worst of the move to each pose" if result.mode == "moves" else ""
    note = f"\n… and {len(rows) - MOST_ROWS} more rows; --out FILE writes all" if len(rows) > MOST_ROWS else ""
    return f"margins of stroke and cones, values of the rest{kind}{way}:\n{texts.aligned(header, body)}{note}"


def _smallest(limits: Limits, rows: list[Row], result: CheckResult) -> list[dict[str, Any]]:
    """Return, for each limit, the smallest margin and where it is; units as shown."""
    listed = []
    for name, summary in result.limits.items():
        shown, place = LIMITS_SHOWN[name], summary.smallest()
        if place is None:
            continue
        row, stage = place
        strut, value = int(summary.strut[place]), float(summary.value[place])
        bound = limits.stroke[strut] if name == "stroke" else getattr(limits, name)
        if name == "stroke":  # the nearer end
            bound = bound[0] if value - bound[0] < bound[1] - value else bound[1]
        allowed = float(bound[strut]) if name.endswith("cone") else float(bound)
        listed.append(
            {
                "limit": name,
                "unit": shown.unit,
                "margin": float(summary.margin[place]) * shown.factor,
                "value": (abs(value) if shown.unsigned else value) * shown.factor,
                "allowed": allowed * shown.factor,
                "strut": strut + 1 if strut >= 0 else None,
                "stage": STAGES[stage],
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
        numbers = [f"{entry[key]:.{LIMITS_SHOWN[entry['limit']].digits}f}" for key in ("margin", "value", "allowed")]
        way = "at the pose" if entry["share_of_move"] == 1.0 else f"{entry['share_of_move'] * 100:.1f} %"
        place = [str(entry["strut"] or "–"), entry["stage"], entry["label"], str(entry["line"]), way]
        body.append([entry["limit"], *numbers, entry["unit"].replace("_", "/") or "–", *place])
    return texts.aligned(header, body)


def _notes(geometry: HexapodGeometry, model: MachineModel, rows: list[Row], result: CheckResult) -> list[str]:
    """Return what a reader should know that is no broken limit."""
    notes = []
    if skipped := int(result.unchecked_moves.sum()):
        first = common.where(rows[int(result.unchecked_moves.argmax())])
        notes.append(f"not checked: {skipped} moves of which an end breaks a limit by itself, the first to {first}")
    for outside, problem in (
        (result.outside_box, "outside the box in which the model was measured"),
        (result.outside_field, "outside the error field, whose value at the boundary is held there"),
    ):
        if outside.any():
            first = common.where(rows[int(outside.argmax())])
            notes.append(f"note: {problem}: {int(outside.sum())} of {len(rows)}, first {first}")
    if result.outside_box.any():
        notes.append(f"  {region_text(model.measured, geometry)}")
    return notes


def _as_json(geometry: HexapodGeometry, model: MachineModel, rows: list[Row], result: CheckResult) -> dict[str, Any]:
    return {
        "machine": geometry.name,
        "model": model.name,
        **common.frames(geometry),
        "mode": result.mode,
        "rate_hz": result.rate,
        "within_limits": result.ok,
        "poses_examined": result.examined,
        "measured_box": region_json(model.measured, geometry),
        "broken": [_breach_json(rows[breach.row], breach) for breach in result.breaches],
        "smallest_margins": _smallest(geometry.limits, rows, result),
        "rows": [_row_values(row, n, result) for n, row in enumerate(rows)],
    }


def _breach_json(row: Row, breach: Breach) -> dict[str, Any]:
    error: Any = breach.error
    content = {"row": breach.row + 1, "label": row.label, "line": row.line, "share_of_move": breach.share}
    content |= {"limit": breach.limit, "problem": str(error)}
    if breach.limit in LIMITS_SHOWN:
        shown, strut = LIMITS_SHOWN[breach.limit], error.strut
        content |= {"value": error.value * shown.factor, "allowed": error.limit * shown.factor, "unit": shown.unit}
        content |= {"strut": None if strut is None else strut + 1, "stage": error.stage}
    return content
