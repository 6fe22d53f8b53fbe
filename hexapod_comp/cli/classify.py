"""``hexapod_comp classify``: which error hurts most, and where (v. Daake et al.)."""

from __future__ import annotations

import argparse
import math
import sys
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from . import common

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from ..machine.geometry import HexapodGeometry
    from ..workspace.budget import Budget
    from ..workspace.shells import Shell
    from ..workspace.study import Study


OF_A_BUDGET = {
    "budget": "error_budget.yaml",
    "method": "exact",
    "separate_joints": False,
    "compare": None,
    "allow_um": None,
    "workers": 1,
    "scheduler": None,
    "no_page": False,
    "publish": False,
}
"""Options that say something of a budget, and what they are when nobody gives them."""


def run(args: argparse.Namespace) -> int:
    """Run the verb."""
    from ..machine.geometry import load_geometry
    from ..workspace.ranking import beside, ranking_rows
    from ..workspace.reach import orientations, reaches
    from ..workspace.study import as_json, classify, report, shells_of

    geometry = load_geometry(args.machine)
    if args.clearance_mm is not None:
        geometry = replace(geometry, limits=replace(geometry.limits, clearance=args.clearance_mm * 1e-3))
    if args.model is not None:
        return _after_calibration(args, geometry)
    budget = _budget(args.budget, geometry)
    turned = orientations(geometry, (args.tilt_deg, args.tilt_deg, (0.0,)))
    reached = reaches(geometry, turned, args.cells)
    names = _names(args.tilt_deg)
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
    common.show(as_json(study) if args.json else report(study, names))
    common.write_table(args, ranking_rows(study.rows, beside(geometry, study.errors)))
    if args.pictures is not None or args.publish:
        bodies = shells_of(reached)
        common.save_pictures(args, lambda: _figures(study, bodies, names))
        if args.pictures is not None and not args.no_page:
            _page(args, study, bodies, names)
        if args.publish:
            _publish(study, bodies, names)
    return 0


def _after_calibration(args: argparse.Namespace, geometry: HexapodGeometry) -> int:
    """Show what a model's calibration leaves, and which measurement would remove most of it."""
    from ..calibration.design_report import measurement_rows, remaining_json, remaining_text
    from ..calibration.follow_up import remaining
    from ..calibration.pictures import predicted_error_figure
    from ..calibration.posterior_file import load_posterior
    from ..errors import CommandError
    from ..machine.model import RealMachine
    from ..machine.model_file import load_model
    from ..workspace.reach import orientations, reaches
    from ..workspace.study import COMBINED_POSES, random_poses

    for name, unused in OF_A_BUDGET.items():
        if getattr(args, name) != unused:
            problem = f"--{name.replace('_', '-')} has no meaning with --model, which takes the place of a budget"
            raise CommandError("usage", problem)
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
    common.show(remaining_json(result) if args.json else remaining_text(result))
    common.write_table(args, measurement_rows(result))
    common.save_pictures(args, lambda: {"predicted_error.png": predicted_error_figure(machine, fitted)})
    return 0


def _budget(file: str, geometry: HexapodGeometry) -> Budget:
    """Return the budget of a file; what does not fit the machine is refused before the work starts."""
    from ..errors import InputFileError, ModelError
    from ..formats.paths import input_file
    from ..workspace.budget import load_budget

    path = input_file(file, "error_budget")
    budget = load_budget(path)
    try:
        budget.single_errors(geometry)
    except ModelError as error:
        raise InputFileError(path, error.key, error.problem, error.value) from error
    return budget


def _names(tilts: tuple[float, ...]) -> tuple[str, ...]:
    """Return the names of every combination of tilts about x and y, in their order."""
    from itertools import product

    return tuple(f"α {math.degrees(a):g}°, β {math.degrees(b):g}°" for a, b in product(tilts, tilts))


def _figures(study: Study, bodies: tuple[Shell, ...], names: tuple[str, ...]) -> dict[str, Figure]:
    """Draw the pictures: of the orientation in the middle of the list."""
    from ..workspace.pictures import RankedRow, causes_figure, ranking_figure, shells_figure
    from ..workspace.shells import TRANSLATION, Layer
    from ..workspace.study import mesh_effects

    middle = len(bodies) // 2
    body, where, machine = bodies[middle], names[middle], study.geometry.name
    figures = {
        "ranking.png": ranking_figure([_bar(row, RankedRow) for row in study.rows], f"{machine}: errors by effect"),
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
    from ..workspace.shells import TRANSLATION, Layer
    from ..workspace.study import mesh_effects

    middle = len(bodies) // 2
    points, values = mesh_effects(study, bodies[middle])
    error = int(study.extremes.at_error[study.extremes.values[:, 0].argmax(), 0])
    kind = study.errors.kinds[study.errors.kind[error]]
    layers = [Layer(p, v) for p, v in zip(points, values[error, 0], strict=True)]
    print(f"publishing on {TOPIC}, frame work, until Ctrl-C", file=sys.stderr, flush=True)
    show_shells(layers, TRANSLATION, f"{kind}, {study.errors.labels[error]}, {names[middle]}")


def _bar(row: Any, kind: Any) -> Any:
    """Return a ranked row as a bar pair."""
    figures = row.figures()
    return kind(row.title, (float(figures[1]), float(figures[0])), (float(figures[3]), float(figures[2])))


def _page(args: argparse.Namespace, study: Study, bodies: tuple[Shell, ...], names: tuple[str, ...]) -> None:
    """Write the interactive page, or say what it needs."""
    from ..errors import HexapodError, InputFileError
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
