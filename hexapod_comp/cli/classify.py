"""``hexapod_comp classify``: which error hurts most, and where (v. Daake et al.)."""

from __future__ import annotations

import argparse
import math
import sys
from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING

from ..errors import CommandError, HexapodError, InputFileError
from ..formats.paths import input_file
from ..formats.schema import complaints_about
from ..machine.geometry import HexapodGeometry, load_geometry
from ..machine.model import RealMachine
from ..machine.model_file import load_model
from ..workspace.budget import load_budget
from ..workspace.ranking import beside, ranking_rows
from ..workspace.reach import orientations, reaches
from ..workspace.shells import TRANSLATION, Layer, Shell
from ..workspace.study import COMBINED_POSES, Study, as_json, classify, mesh_effects, random_poses, report, shells_of
from . import common

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def run(args: argparse.Namespace) -> int | common.Result:
    """Run the verb."""
    geometry = load_geometry(args.machine)
    if args.clearance_mm is not None:
        geometry = replace(geometry, limits=replace(geometry.limits, clearance=args.clearance_mm * 1e-3))
    if args.model is not None:
        return _after_calibration(args, geometry)
    path = input_file(args.budget, "error_budget")
    budget = load_budget(path)
    with complaints_about(path):  # what does not fit the machine is refused before the work starts
        budget.single_errors(geometry)
    turned = orientations(geometry, (args.tilt_deg, args.tilt_deg, (0.0,)))
    reached = reaches(geometry, turned, args.cells)
    names = tuple(f"α {math.degrees(a):g}°, β {math.degrees(b):g}°" for a, b in product(args.tilt_deg, args.tilt_deg))
    with common.progress_bar(sum(int(one.within.sum()) for one in reached), " poses") as bar:
        study = classify(
            geometry,
            budget,
            reached,
            method=args.method,
            allowed=None if args.allow_um is None else args.allow_um * 1e-6,
            compare=args.compare or 0,
            workers=args.workers,
            scheduler=args.scheduler,
            seed=args.seed,
            progress=bar.update,
            shared_platform_joints=not args.separate_joints,
        )
    rows = ranking_rows(study.rows, beside(geometry, study.errors))
    common.Result(lambda: report(study, names), lambda: as_json(study), rows).finish(args)
    if args.pictures is not None or args.publish:
        bodies = shells_of(reached)
        if args.pictures is not None:
            common.save_pictures(args, lambda: _figures(study, bodies, names))
        if args.pictures is not None and not args.no_page:
            _page(args, study, bodies, names)
        if args.publish:
            _publish(study, bodies, names)
    return 0


def _after_calibration(args: argparse.Namespace, geometry: HexapodGeometry) -> common.Result:
    """Show what a model's calibration leaves, and which measurement would remove most of it."""
    from ..calibration.design_report import measurement_rows, remaining_json, remaining_text
    from ..calibration.follow_up import remaining
    from ..calibration.pictures import predicted_error_figure
    from ..calibration.posterior_file import load_posterior

    model = load_model(args.model, geometry)
    fitted, unknown = load_posterior(model, geometry, args.model)
    if fitted is None:
        raise CommandError("model", f"it is not known what {args.model} leaves: {unknown}")
    tilts = args.tilt_deg
    reached = reaches(geometry, orientations(geometry, (tilts, tilts, (0.0,))), args.cells)
    poses, machine = random_poses(reached, COMBINED_POSES, args.seed), RealMachine(geometry, model)
    name = f"workspace, α and β of {', '.join(f'{math.degrees(tilt):g}' for tilt in tilts)}°"
    with common.stage_line() as say:
        result = remaining(machine, fitted, poses, name, say)
    return common.Result(
        lambda: remaining_text(result),
        lambda: remaining_json(result),
        measurement_rows(result),
        lambda: {"predicted_error.png": predicted_error_figure(machine, fitted)},
    )


def _figures(study: Study, bodies: tuple[Shell, ...], names: tuple[str, ...]) -> dict[str, Figure]:
    """Draw the pictures: of the orientation in the middle of the list."""
    from ..workspace.pictures import RankedRow, causes_figure, ranking_figure, shells_figure

    middle = len(bodies) // 2
    body, where, machine = bodies[middle], names[middle], study.geometry.name
    ranked = [(row.title, [float(figure) for figure in row.figures()]) for row in study.rows]
    bars = [RankedRow(title, (f[1], f[0]), (f[3], f[2])) for title, f in ranked]
    figures = {
        "ranking.png": ranking_figure(bars, f"{machine}: errors by effect"),
        "causes.png": causes_figure(study.geometry, body.points, body.findings, f"{machine}, {where}"),
    }
    points, values = mesh_effects(study, body)
    for kind, title in enumerate(study.errors.kinds):
        error = int((study.errors.kind == kind).argmax())
        layers = [Layer(p, v) for p, v in zip(points, values[error, 0], strict=True)]
        text = f"{machine}: {title}, {study.errors.labels[error]}, {where}"
        name = title.replace(" ", "_").replace("/", "")
        figures[f"shells_{name}.png"] = shells_figure(study.geometry, layers, TRANSLATION, text)
    return figures


def _publish(study: Study, bodies: tuple[Shell, ...], names: tuple[str, ...]) -> None:
    """Keep shells on a latched topic, for RViz and Foxglove, until Ctrl-C."""
    from ..viewer.shells import TOPIC, show_shells

    middle = len(bodies) // 2
    points, values = mesh_effects(study, bodies[middle])
    error = int(study.extremes.at_error[study.extremes.values[:, 0].argmax(), 0])
    kind = study.errors.kinds[study.errors.kind[error]]
    layers = [Layer(p, v) for p, v in zip(points, values[error, 0], strict=True)]
    print(f"publishing on {TOPIC}, frame work, until Ctrl-C", file=sys.stderr, flush=True)
    show_shells(layers, TRANSLATION, f"{kind}, {study.errors.labels[error]}, {names[middle]}")


def _page(args: argparse.Namespace, study: Study, bodies: tuple[Shell, ...], names: tuple[str, ...]) -> None:
    """Write the interactive page, or say what it needs."""
    from ..workspace.page import page_data, write_page

    path = Path(args.pictures) / "page.html"
    try:
        write_page(path, study.geometry, page_data(study, bodies, names, "orientation"))
    except InputFileError:
        raise
    except HexapodError as error:  # plotly is an extra: the rest is there without it
        common.mention(args, f"no page: {error}")
        return
    common.mention(args, f"page: {path}")
