"""The verb ``classify``: ranks a machine's errors by their effect on the tool (Daake et al.)."""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Callable
from dataclasses import replace
from functools import cache, partial
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from ..errors import CommandError, HexapodError, InputFileError
from ..formats.outputs import write_text
from ..formats.paths import input_file
from ..formats.schema import file_errors
from ..machine.geometry import HexapodGeometry, load_geometry
from ..machine.model import RealMachine
from ..machine.model_file import load_model
from ..workspace import study as studies
from ..workspace.budget import load_budget
from ..workspace.ranking import ranking_rows
from ..workspace.reach import orientations, reaches
from ..workspace.shells import TRANSLATION, Layer
from ..workspace.study import COMBINED_POSES, Study, as_json, mesh_effects, random_poses, report, shells_of
from . import results
from .results import Result

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from ..workspace.shells import Shell


Meshes = tuple[np.ndarray, np.ndarray]  # Points on nested surfaces in the workspace; effect of each error there


def classify(args: argparse.Namespace) -> int | Result:
    """Rank the errors of a budget, or with --model the uncertainties of a fit, by their effect on the tool."""
    geometry = load_geometry(args.machine)
    if args.clearance_mm is not None:
        geometry = replace(geometry, limits=replace(geometry.limits, clearance=args.clearance_mm * 1e-3))
    turned = orientations(geometry, (args.tilt_deg, args.tilt_deg, (0.0,)))
    if args.model is not None:
        return _after_calibration(args, geometry, turned)
    path = input_file(args.budget, "error_budget")
    budget = load_budget(path)
    with file_errors(path):  # to refuse another machine's errors before the long computation
        budget.single_errors(geometry)
    reached = reaches(geometry, turned, args.cells)
    names = tuple(f"α {math.degrees(a):g}°, β {math.degrees(b):g}°" for a, b in product(args.tilt_deg, args.tilt_deg))
    with results.progress_bar(sum(int(one.within.sum()) for one in reached), " poses") as bar:
        study = studies.classify(
            geometry,
            budget,
            reached,
            method=args.method,
            allowed=None if args.allow_um is None else args.allow_um * 1e-6,
            workers=args.workers,
            scheduler=args.scheduler,
            seed=args.seed,
            progress=bar.update,
            shared_platform_joints=not args.separate_joints,
        )
    rows = ranking_rows(study.rows)
    bodies = cache(lambda: shells_of(reached))  # only for pictures, page and --publish
    pictures = partial(_figures, study, bodies, names)
    Result(lambda: report(study, names), lambda: as_json(study), rows, pictures).finish(args)
    if args.pictures is not None and not args.no_page:
        from ..workspace.page import page_data, page_text

        page = Path(args.pictures) / "page.html"
        try:
            write_text(page, page_text(geometry, page_data(study, bodies(), names)))
            results.print_written(args, f"page: {page}")
        except InputFileError:
            raise
        except HexapodError as error:  # plotly is not installed; the other outputs do not need it
            results.print_written(args, f"no page: {error}")
    if args.publish:
        from ..viewer.shells import TOPIC, show_shells

        meshes = mesh_effects(study, bodies()[len(names) // 2])
        worst = int(study.extremes.at_error[study.extremes.values[:, 0].argmax(), 0])
        layers, title = _layers(study, meshes, names, worst)
        print(f"publishing on {TOPIC}, frame work, until Ctrl-C", file=sys.stderr, flush=True)
        show_shells(layers, TRANSLATION, title)
    return 0


def _after_calibration(args: argparse.Namespace, geometry: HexapodGeometry, turned: np.ndarray) -> Result:
    from ..calibration.pictures import predicted_error_figure
    from ..calibration.posterior_file import load_posterior
    from ..calibration.remaining import measurement_rows, remaining, remaining_text

    model = load_model(args.model, geometry)
    fitted, unknown = load_posterior(model, geometry, args.model)
    if fitted is None:
        raise CommandError("model", f"the tool error that remains with model {args.model} is not known: {unknown}")
    reached = reaches(geometry, turned, args.cells)
    poses, machine = random_poses(reached, COMBINED_POSES, args.seed), RealMachine(geometry, model)
    name = f"workspace, α and β of {', '.join(f'{math.degrees(tilt):g}' for tilt in args.tilt_deg)}°"
    with results.stage_line() as say:
        result = remaining(machine, fitted, poses, name, say)
    return Result(
        lambda: remaining_text(result, machine),
        lambda: result,
        measurement_rows(result),
        lambda: {"predicted_error.png": predicted_error_figure(machine, fitted)},
    )


def _layers(study: Study, meshes: Meshes, names: tuple[str, ...], error: int) -> tuple[list[Layer], str]:
    """Return nested surfaces with the effect of one error (by index) at the middle orientation, and their title."""
    points, values = meshes
    kind = study.errors.kinds[study.errors.kind[error]]
    layers = [Layer(p, v) for p, v in zip(points, values[error, 0], strict=True)]
    return layers, f"{kind}, {study.errors.labels[error]}, {names[len(names) // 2]}"


def _figures(study: Study, bodies: Callable[[], tuple[Shell, ...]], names: tuple[str, ...]) -> dict[str, Figure]:
    from ..workspace.pictures import causes_figure, ranking_figure, shells_figure

    middle, machine = len(names) // 2, study.geometry.name
    body, where = bodies()[middle], names[middle]
    ranking = [(row.title, row.figures()) for row in study.rows]
    figures = {
        "ranking.png": ranking_figure(ranking, f"{machine}: errors by effect"),
        "causes.png": causes_figure(study.geometry, body.points, body.findings, f"{machine}, {where}"),
    }
    meshes = mesh_effects(study, body)
    for number, kind in enumerate(study.errors.kinds):
        layers, title = _layers(study, meshes, names, int((study.errors.kind == number).argmax()))
        name = kind.replace(" ", "_").replace("/", "")
        figures[f"shells_{name}.png"] = shells_figure(study.geometry, layers, TRANSLATION, f"{machine}: {title}")
    return figures
