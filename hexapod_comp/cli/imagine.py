"""``hexapod_comp imagine``: the hidden errors of a virtual machine, for any geometry."""

from __future__ import annotations

import argparse
from typing import Any

import numpy as np

from ..calibration.evaluation import HeldOut, held_out
from ..errors import GeometryError
from ..formats import texts
from ..machine.geometry import HexapodGeometry, load_geometry
from ..machine.model import MachineModel, RealMachine
from ..machine.model_file import save_model
from ..virtual.imperfections import ImperfectionBounds, largest_errors
from ..virtual.named import imagine, usual_bounds
from ..workspace.reach import machine_box
from . import common

# What each option is called among the bounds, and its unit in SI
IN_SI = {
    "joints_um": ("joint", 1e-6),
    "struts_um": ("strut_offset", 1e-6),
    "pitch_ppm": ("pitch", 1e-6),
    "wave_um": ("wave", 1e-6),
    "harmonics_um": ("harmonics", 1e-6),
    "wave_period_mm": ("wave_period", 1e-3),
    "map_um": ("length_map", 1e-6),
    "backlash_um": ("backlash", 1e-6),
    "wear_um": ("wear", 1e-6),
    "strut_expansion_ppm_per_k": ("strut_expansion", 1e-6),
    "body_expansion_ppm_per_k": ("body_expansion", 1e-6),
    "field_um": ("field_displacement", 1e-6),
    "field_urad": ("field_rotation", 1e-6),
    "field_reversal_percent": ("field_reversal", 1e-2),
}


def run(args: argparse.Namespace) -> common.Result:
    """Run the verb."""
    geometry = load_geometry(args.machine)
    model = imagine(geometry, args.seed, _bounds(args, geometry), args.name or "")
    save_model(model, args.out)
    box, error_of_tool = None, None
    try:
        box, attitude, _ = machine_box(geometry)
        error_of_tool = held_out(RealMachine(geometry, model), None, box, level=attitude)
    except GeometryError as error:
        common.say_notes([f"what the tool does is not shown: {error}"])
    given = args, model, _drawn(model), box, error_of_tool
    return common.Result(lambda: _report(*given), lambda: _as_json(*given))


def _bounds(args: argparse.Namespace, geometry: HexapodGeometry) -> ImperfectionBounds:
    """Return the bounds that the options give; the usual ones where they give none."""
    given: dict[str, Any] = {"shared_platform_joints": not args.separate_joints}
    for option, (name, unit) in IN_SI.items():
        value = getattr(args, option)
        if value is not None:
            given[name] = tuple(unit * v for v in value) if isinstance(value, tuple) else unit * value
    if args.field_um or args.field_urad:
        box, attitude, _ = machine_box(geometry)
        box = box if args.box is None else np.array(args.box)
        corners = np.stack(np.meshgrid(*box.T), axis=-1).reshape(-1, 3)  # of the tool in work
        positions, _ = geometry.platform_poses(corners, np.tile(attitude, (len(corners), 1, 1)))
        given["field_box"] = np.array([positions.min(axis=0), positions.max(axis=0)])
    return usual_bounds(geometry, **given)


def _drawn(model: MachineModel) -> list[tuple[str, float, str]]:
    """Return name, largest value and unit of each error that the machine has."""
    struts, size = model.struts, np.abs
    bodies = np.array([model.base_expansion, model.platform_expansion])
    of_field = largest_errors(model.field) if any(family.size for family in model.field.lines) else np.zeros(6)
    sizes = (
        ("base joints", size(model.base_deviation).max(), "um"),
        ("platform joints", size(model.platform_deviation).max(), "um"),
        ("strut lengths", size(struts.offset).max(), "um"),
        ("pitch", size(struts.pitch).max(), "ppm"),
        ("wave", np.hypot(struts.cosine, struts.sine)[:, 0].max(), "um"),
        ("its harmonics", np.hypot(struts.cosine, struts.sine)[:, 1:].max(initial=0.0), "um"),
        ("smooth length error", size(struts.map_values).max(initial=0.0), "um"),
        ("backlash", struts.backlash.max(), "um"),
        ("wear", struts.map_backlash.max(initial=0.0), "um"),
        ("expansion of struts", size(struts.expansion).max(), "ppm_per_k"),
        ("expansion of bodies", size(bodies).max(), "ppm_per_k"),
        ("field, displacement", of_field[:3].max(), "um"),
        ("field, rotation", of_field[3:].max(), "urad"),
    )
    return [(name, float(value) * 1e6, unit) for name, value, unit in sizes if value > 0.0]


def _report(
    args: argparse.Namespace,
    model: MachineModel,
    drawn: list[tuple[str, float, str]],
    box: np.ndarray | None,
    error: HeldOut | None,
) -> str:
    """Say what was drawn, what the tool makes of it, and where it went."""

    units = {"um": "µm", "urad": "µrad", "ppm_per_k": "ppm/K"}
    lines = [f"machine {model.machine}, seed {args.seed}: model {model.name}"]
    rows = [[name, texts.number(value, 3), units.get(unit, unit)] for name, value, unit in drawn]
    lines.append(texts.aligned(["error", "largest", ""], rows) if rows else "no errors at all")
    if box is not None and error is not None:
        low, high = (", ".join(texts.number(v * 1e3, 1) for v in corner) for corner in box)
        lines.append(
            f"tool error, tool positions in ({low})…({high}) mm of work: {error.raw.rms * 1e6:.2f} µm RMS as it is, "
            f"{error.aligned.rms * 1e6:.2f} µm with the datum aligned"
        )
    return "\n".join([*lines, f"truth: {args.out}"])


def _as_json(
    args: argparse.Namespace,
    model: MachineModel,
    drawn: list[tuple[str, float, str]],
    box: np.ndarray | None,
    error: HeldOut | None,
) -> dict[str, Any]:
    """Return the same for programs."""
    largest = {f"{name.replace(', ', ' ').replace(' ', '_')}_{unit}": value for name, value, unit in drawn}
    tool = None
    if error is not None:
        tool = {"frame": "work", "box_m": box, "rms_m": error.raw.rms, "aligned_rms_m": error.aligned.rms}
    head = {"machine": model.machine, "name": model.name, "seed": args.seed}
    return {**head, "largest": largest, "tool_error": tool, "written": args.out}
