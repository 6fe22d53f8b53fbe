"""``hexapod_comp export``: a model for controllers that do not run this package."""

from __future__ import annotations

import argparse
import math
from functools import partial
from typing import Any

import numpy as np

from ..export.worth import Comparison, ExportCheck, ExportTrial, Size
from ..formats import texts
from ..formats.outputs import write_text
from ..formats.paths import input_file
from ..machine.geometry import STRUT_NAMES, HexapodGeometry
from ..machine.model import MachineModel, commanded_box
from ..machine.model_file import IDEAL, model_text
from ..virtual.named import is_random
from . import common

# An error that grows by less than this, m, has not grown: the files' digits and LinuxCNC's floats count for more
HARMLESS = 10e-9


def run(args: argparse.Namespace) -> common.Result:
    """Run the verb."""
    geometry, model = common.load_machine(args)
    exact = _descriptions(args, geometry) + _c(args, geometry, model)
    if args.linuxcnc is None and args.table is None:
        return _show_exact(args, model, exact)
    box = commanded_box(geometry, model) if args.box is None else np.array(args.box)
    written, checks = exact, []
    with common.stage_line() as say:
        say("the tool's error as the machine is")
        trial = ExportTrial(geometry, model, box, args.poses, args.seed, math.radians(args.tilt_deg))
        if args.linuxcnc is not None:
            say("LinuxCNC's files, and what they leave")
            files, result = _linuxcnc(args, trial, box)
            written += files
            checks.append(result)
        if args.table is not None:
            say("the table, and what it leaves")
            written.append(args.table)
            checks += _table(args, trial, box)
    worse = any(c.level.after.rms > c.level.before.rms + HARMLESS for _, c, _ in checks)
    given = args, model, box, written, checks
    return common.Result(lambda: _report(*given), lambda: _as_json(*given), code=int(worse))


def _descriptions(args: argparse.Namespace, geometry: HexapodGeometry) -> list[str]:
    """Write what robot programs want to know of the machine; return the files."""
    from ..export.robot_description import mjcf, urdf

    written = [(file, form) for file, form in ((args.urdf, urdf), (args.mjcf, mjcf)) if file is not None]
    for file, form in written:
        write_text(file, form(geometry, args.joint_names or STRUT_NAMES))
    return [file for file, _ in written]


def _c(args: argparse.Namespace, geometry: HexapodGeometry, model: MachineModel) -> list[str]:
    """Write the C core with this machine's constants, alone and as a controller of ros2_control; return the files."""
    if args.c_folder is None and args.ros2_control is None:
        return []
    from ..compensation.journal import IDEAL_SOURCE, Source
    from ..export.c_code import write_c
    from ..export.control_package import write_ros2_control

    machine = Source.read(input_file(args.machine))
    if args.model == IDEAL:
        source = IDEAL_SOURCE
    elif is_random(args.model):
        source = Source.of(args.model, model_text(model))
    else:
        source = Source.read(input_file(args.model))
    of = (geometry, model, (machine.sha256, source.sha256))
    files = [] if args.c_folder is None else write_c(args.c_folder, *of)
    if args.ros2_control is not None:
        files += write_ros2_control(args.ros2_control, *of, args.rate, args.joint_names or STRUT_NAMES)
    return [str(file) for file in files]


def _show_exact(args: argparse.Namespace, model: MachineModel, written: list[str]) -> common.Result:
    """Say what was written when all of it gives the very numbers, so that nothing is to be judged."""
    text = f"machine {model.machine}, model {model.name}\nwritten: {', '.join(written)}"
    if args.c_folder is not None:
        text += "\nbuild the self-test and run it on the target: see hexapod_selftest.c"
    return common.Result(lambda: text, lambda: {"machine": model.machine, "model": model.name, "written": written})


Result = tuple[str, "ExportCheck", list[str]]  # name of a way to use an export, what it leaves, and notes


def _titles(model: MachineModel, box: np.ndarray) -> list[str]:
    dated = f" of {model.origin.date}" if model.origin.date else ""
    return [f"machine {model.machine}, model {model.name}{dated}, written by hexapod_comp export", _box_text(box)]


def _box_text(box: np.ndarray) -> str:
    low, high = (", ".join(f"{v:g}" for v in corner.round(9) * 1e3) for corner in box)
    return f"box of tool positions in work ({low})…({high}) mm, 20 °C"


def _linuxcnc(args: argparse.Namespace, trial: ExportTrial, box: np.ndarray) -> tuple[list[str], Result]:
    """Write LinuxCNC's files, read them back and drive the machine through them."""
    from ..export.linuxcnc import make_genhexkins, read_genhexkins, table_misfit, write_genhexkins

    machine = trial.machine
    genhexkins = make_genhexkins(machine, box)
    misfit = table_misfit(machine, genhexkins, box)
    files = write_genhexkins(genhexkins, args.linuxcnc, args.units, _titles(machine.model, box), misfit)
    back = read_genhexkins(args.linuxcnc, args.units)
    check = trial.check(back.commands)
    rms, largest = table_misfit(machine, back, box).max(axis=0) * 1e6
    points = max(len(table.nominal) for table in back.tables)
    notes = [
        f"what bends between the {points} points of a strut's .comp file: {rms:.3f} µm RMS, {largest:.3f} at most",
        f"the error field: moves the tool by {_size(check.field)}",
    ]
    return [str(file) for file in files], ("LinuxCNC", check, notes)


def _table(args: argparse.Namespace, trial: ExportTrial, box: np.ndarray) -> list[Result]:
    """Write the table, read it back, and drive the machine through its strut and through its pose corrections."""
    from ..export.table import commands_by_poses, commands_by_struts, make_table, read_table, write_table

    geometry, model = trial.machine.geometry, trial.machine.model
    table, left_out = make_table(geometry, model, box, args.step_mm * 1e-3)
    left_out.append("tilt: the table holds for a level tool; above stands what a tilted one keeps")
    write_table(table, args.table, _titles(model, box))
    back = read_table(args.table)
    by_struts = trial.check(partial(commands_by_struts, back))
    by_poses = trial.check(partial(commands_by_poses, back))
    lost = model.struts.largest_backlash.max() * 1e6
    backlash = [f"backlash of struts, up to {lost:.3f} µm: no pose correction fits six directions"] if lost else []
    return [("table, struts", by_struts, left_out), ("table, poses", by_poses, [*left_out, *backlash])]


def _size(size: Size) -> str:
    return f"{size.rms * 1e6:.3f} µm RMS, {size.largest * 1e6:.3f} at most"


def _report(
    args: argparse.Namespace, model: MachineModel, box: np.ndarray, written: list[str], checks: list[Result]
) -> str:
    """Return the report for people."""
    lines = [f"machine {model.machine}, model {model.name}", _box_text(box), f"written: {', '.join(written)}", ""]
    lines.append(
        f"tool error of that machine at {args.poses} random poses, forward and backward, before → after "
        "(files read back, the model taken for the truth):"
    )
    for name, check, notes in checks:
        lines.append(f"  {name}, level tool: {_change(check.level)}")
        tilted = "no such pose is within the machine's limits" if check.tilted is None else _change(check.tilted)
        lines.append(f"  {name}, tool tilted by {args.tilt_deg:g}°: {tilted}")
        heat, damp = check.per_kelvin, check.per_humidity
        moved = (
            "(the model has none)"
            if heat is None
            else f": 1 K on struts, base and platform moves the tool by {_size(heat)}"
        )
        left_out = [*notes, f"thermal growth{' ' * (heat is None)}{moved}"]
        left_out += [] if damp is None else [f"growth of the struts by humidity: 10 % moves the tool by {_size(damp)}"]
        lines += [f"    not carried: {note}" for note in left_out]
    return "\n".join(lines)


def _change(comparison: Comparison) -> str:
    """Return a comparison as text."""
    (a, b), (c, d) = [(s.rms * 1e6, s.largest * 1e6) for s in (comparison.before, comparison.after)]
    text = f"{a:.3f} → {c:.3f} µm RMS"
    if a > 0.0:
        text += f" ({texts.number(100.0 * abs(1.0 - c / a), 1)} % {'more' if c > a + HARMLESS * 1e6 else 'less'})"
    turned = f"{comparison.before_rotation.rms * 1e6:.2f} → {comparison.after_rotation.rms * 1e6:.2f} µrad RMS"
    return f"{text}, {b:.3f} → {d:.3f} µm at most, {turned}"


def _as_json(
    args: argparse.Namespace, model: MachineModel, box: np.ndarray, written: list[str], checks: list[Result]
) -> dict[str, Any]:
    return {
        "machine": model.machine,
        "model": model.name,
        "frame": "work",
        "box_mm": box * 1e3,
        "poses": args.poses,
        "seed": args.seed,
        "tilt_deg": args.tilt_deg,
        "written": written,
        "checks": [
            {
                "export": name,
                "level": _numbers(check.level),
                "tilted": None if check.tilted is None else _numbers(check.tilted),
                **_sizes("field", check.field),
                **_sizes("per_kelvin", check.per_kelvin),
                **_sizes("per_10_percent_humidity", check.per_humidity),
                "not_carried": notes,
            }
            for name, check, notes in checks
        ],
    }


def _sizes(name: str, size: Size | None, unit: str = "um") -> dict[str, float | None]:
    """Return RMS and largest of an error in millionths of its unit, by names that end in it."""
    sizes = (None, None) if size is None else (size.rms * 1e6, size.largest * 1e6)
    return dict(zip((f"{name}_rms_{unit}", f"{name}_max_{unit}"), sizes, strict=True))


def _numbers(comparison: Comparison) -> dict[str, Any]:
    numbers: dict[str, Any] = {"passes": comparison.passes}
    for name in ("before", "after"):
        numbers |= _sizes(name, getattr(comparison, name))
        numbers |= _sizes(name, getattr(comparison, f"{name}_rotation"), "urad")
    return numbers
