"""The verb ``export``: writes a model for controllers that do not run this package."""

from __future__ import annotations

import argparse
import math
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from ..errors import CommandError
from ..export.trial import Comparison, ExportCheck, ExportTrial, Size
from ..formats import texts
from ..formats.outputs import write_text
from ..formats.paths import input_file
from ..formats.schema import in_unit
from ..machine.geometry import STRUT_NAMES, HexapodGeometry
from ..machine.model import MachineModel, commanded_box
from ..machine.model_file import IDEAL, model_text
from ..machine.passes import level_attitude
from ..machine.region import box_text
from ..virtual.named import is_random
from . import results
from .results import Result

ROUNDING = 10e-9  # Tool error, m, by the rounding of numbers in the written files and in LinuxCNC


class ExportMethod(NamedTuple):
    """Corrections in one exported format, and the tool errors without and with these corrections."""

    name: str
    check: ExportCheck  # tool errors without and with the corrections
    notes: list[str]  # errors that the export does not correct


def export(args: argparse.Namespace) -> Result:
    """Write a model in other formats, and report the residual errors; exit code 1: an export increases the error."""
    geometry, model = results.load_machine(args)
    missing = _not_carried(args, geometry, model)
    title, known = f"machine {model.machine}, model {model.name}", {"machine": model.machine, "model": model.name}
    if args.linuxcnc is None and args.table is None:  # the other files have the model's exact numbers
        written = _exact(args, geometry, model)
        text = "\n".join([title, f"written: {', '.join(written)}", *missing])
        if args.c_folder is not None:
            text += "\nbuild the self-test and run it on the target: see hexapod_selftest.c"
        return Result(lambda: text, lambda: {**known, "written": written, "not_carried": missing})
    if args.box is None and model.measured is None:
        raise CommandError(
            "usage", f"--box is needed: model {args.model} does not state the box in which it was measured"
        )
    box = commanded_box(geometry, model) if args.box is None else np.array(args.box)
    parallel = np.array_equal(level_attitude(geometry), np.eye(3))
    attitude = "" if parallel else "with the tool's attitude at home, "
    where = f"box of tool positions in work {box_text(box)}, {attitude}20 °C"
    dated = f" of {model.origin.date}" if model.origin.date else ""
    written, tried = list[str](), list[ExportMethod]()
    titles = [f"{title}{dated}, written by hexapod_comp export", where]
    with results.stage_line() as say:
        say("computing the tool's error without corrections")
        trial = ExportTrial(geometry, model, box, args.poses, args.seed, math.radians(args.tilt_deg))
        if args.linuxcnc is not None:
            say("writing LinuxCNC's files, and computing the remaining error")
            files, one = _linuxcnc(args, trial, box, titles)
            written += files
            tried.append(one)
        if args.table is not None:
            say("writing the table, and computing the remaining error")
            written.append(args.table)
            tried += _table(args, trial, box, titles)
    written += _exact(args, geometry, model)  # last, as the others refuse a box or a model that they cannot convert
    lines = [
        title,
        where,
        f"written: {', '.join(written)}",
        *missing,
        "",
        f"tool error of a machine with this model's errors at {args.poses} random poses, approached forward and "
        "backward, without → with the corrections of the written files:",
    ]
    checks = []
    for one in tried:
        shown, numbers = _shown(one, args.tilt_deg)
        lines += shown
        checks.append(numbers)
    worse = any(c.level.after.rms > c.level.before.rms + ROUNDING for _, c, _ in tried)
    drawn = {"poses": args.poses, "seed": args.seed, "tilt_deg": args.tilt_deg}
    content = {
        **known,
        "frame": "work",
        "box_mm": in_unit(box, "mm"),
        **drawn,
        "written": written,
        "not_carried": missing,
        "checks": checks,
    }
    return Result(lambda: "\n".join(lines), lambda: content, code=int(worse))


def _exact(args: argparse.Namespace, geometry: HexapodGeometry, model: MachineModel) -> list[str]:
    """Write the exports that need no approximation (URDF, MJCF, C, ros2_control); return the files' names."""
    from ..machine.robot_description import mjcf, urdf

    joints = args.joint_names or STRUT_NAMES
    written = [(file, form) for file, form in ((args.urdf, urdf), (args.mjcf, mjcf)) if file is not None]
    for file, form in written:
        write_text(file, form(geometry, joints))
    files = [file for file, _ in written]
    if args.c_folder is None and args.ros2_control is None:
        return files
    from ..compensation.journal import IDEAL_SOURCE, Source
    from ..export.c_code import write_c
    from ..export.control_package import write_ros2_control

    if args.model == IDEAL:
        source = IDEAL_SOURCE
    elif is_random(args.model):
        source = Source.of(args.model, model_text(model))
    else:
        source = Source.read(input_file(args.model))
    of = (geometry, model, (Source.read(input_file(args.machine)).sha256, source.sha256))
    if args.c_folder is not None:
        files += map(str, write_c(args.c_folder, *of))
    if args.ros2_control is not None:
        files += map(str, write_ros2_control(args.ros2_control, *of, args.rate, joints))
    return files


def _not_carried(args: argparse.Namespace, geometry: HexapodGeometry, model: MachineModel) -> list[str]:
    """Return notes on errors that exported files leave out, and on inputs that exported controllers do not receive."""
    humidity = ["humidity (50 % is assumed)"] if model.struts.moisture.any() else []
    load = ["gravity and forces (the model's gravity is assumed)"] if model.load.bends else []
    tool = [f"the weight of another tool (that of {geometry.tool_name!r} is assumed)"] if model.load.bends else []
    described = [file for file in (args.urdf, args.mjcf) if file is not None]
    notes = []
    if described and args.model != IDEAL:
        notes.append(f"{', '.join(described)}: the nominal machine, without the model's errors")
    for folder, controller, inputs in (
        (args.c_folder, "hexapod_rt.comp", humidity + tool),
        (args.ros2_control, "the controller within ros2_control", humidity + load + tool),
    ):
        if folder is not None and inputs:
            notes.append(f"{folder}: {controller} does not receive {', '.join(inputs)}")
    return notes


def _linuxcnc(
    args: argparse.Namespace, trial: ExportTrial, box: np.ndarray, titles: list[str]
) -> tuple[list[str], ExportMethod]:
    """Write LinuxCNC's files, and compute the tool error with the corrections read back from the files."""
    from ..export.linuxcnc import make_genhexkins, read_genhexkins, table_misfit, write_genhexkins

    machine = trial.machine
    genhexkins = make_genhexkins(machine, box)
    misfit = table_misfit(machine, genhexkins, box)
    files = write_genhexkins(genhexkins, args.linuxcnc, args.units, titles, misfit)
    back = read_genhexkins(args.linuxcnc, args.units)
    check = trial.check(back.commands)
    rms, largest = table_misfit(machine, back, box).max(axis=0)
    points = max(len(table.nominal) for table in back.tables)
    notes = [
        f"errors of a strut between the {points} points of its .comp file: {_size(Size(rms, largest))}",
        f"the error field, which moves the tool by {_size(check.field)}",
    ]
    return [str(file) for file in files], ExportMethod("LinuxCNC", check, notes)


def _table(args: argparse.Namespace, trial: ExportTrial, box: np.ndarray, titles: list[str]) -> list[ExportMethod]:
    """Write the table and read it back; compute the tool error with the table's strut corrections and with its pose
    corrections.
    """
    from ..export.table import commands_by_poses, commands_by_struts, make_table, read_table, write_table

    geometry, model = trial.machine.geometry, trial.machine.model
    table, left_out = make_table(geometry, model, box, args.step_mm * 1e-3)
    left_out.append(f"tilt: the table is for a level tool; the report states the error at {args.tilt_deg:g}° of tilt")
    write_table(table, args.table, [*titles, *(f"not corrected: {note}" for note in left_out)])
    back = read_table(args.table)
    lost = model.struts.largest_backlash.max() * 1e6
    backlash = [f"backlash, up to {lost:.3f} µm: its sign depends on each strut's direction of motion"] if lost else []
    return [
        ExportMethod("table, struts", trial.check(partial(commands_by_struts, back)), left_out),
        ExportMethod("table, poses", trial.check(partial(commands_by_poses, back)), [*left_out, *backlash]),
    ]


def _shown(tried: ExportMethod, tilt_deg: float) -> tuple[list[str], dict[str, Any]]:
    name, check, notes = tried
    heat, damp = check.per_kelvin, check.per_humidity
    tilted = "no pose with this tilt is within the machine's limits" if check.tilted is None else _change(check.tilted)
    if heat is None:
        growth = "thermal growth (the model has none)"
    else:
        growth = f"thermal growth: if all parts become 1 K warmer, the tool moves by {_size(heat)}"
    left_out = [*notes, growth]
    if damp is not None:
        risen = "if the relative humidity rises by 10 percentage points"
        left_out.append(f"growth by humidity: {risen}, the tool moves by {_size(damp)}")
    lines = [
        f"  {name}, level tool: {_change(check.level)}",
        f"  {name}, tool tilted by {tilt_deg:g}°: {tilted}",
        *(f"    not corrected: {note}" for note in left_out),
    ]
    return lines, {
        "export": name,
        "level": _numbers(check.level),
        "tilted": None if check.tilted is None else _numbers(check.tilted),
        **_sizes("field", check.field),
        **_sizes("per_kelvin", heat),
        **_sizes("per_10_percent_humidity", damp),
        "not_carried": notes,
    }


def _size(size: Size) -> str:
    return f"{size.rms * 1e6:.3f} µm RMS, {size.largest * 1e6:.3f} at most"


def _change(comparison: Comparison) -> str:
    (a, b), (c, d) = [(s.rms * 1e6, s.largest * 1e6) for s in (comparison.before, comparison.after)]
    text = f"{a:.3f} → {c:.3f} µm RMS"
    if comparison.before.rms > ROUNDING:
        text += f" ({texts.number(100.0 * abs(1.0 - c / a), 1)} % {'more' if c > a else 'less'})"
    turned = f"{comparison.before_rotation.rms * 1e6:.2f} → {comparison.after_rotation.rms * 1e6:.2f} µrad RMS"
    return f"{text}, {b:.3f} → {d:.3f} µm at most, {turned}"


def _sizes(name: str, size: Size | None, unit: str = "um") -> dict[str, float | None]:
    sizes = (None, None) if size is None else (size.rms * 1e6, size.largest * 1e6)
    return dict(zip((f"{name}_rms_{unit}", f"{name}_max_{unit}"), sizes, strict=True))


def _numbers(comparison: Comparison) -> dict[str, Any]:
    numbers: dict[str, Any] = {"passes": comparison.passes}
    for name in ("before", "after"):
        numbers |= _sizes(name, getattr(comparison, name))
        numbers |= _sizes(name, getattr(comparison, f"{name}_rotation"), "urad")
    return numbers
