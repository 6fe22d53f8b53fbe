"""``hexapod_comp classify``: which error hurts most, and where (v. Daake et al.)."""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from . import common

if TYPE_CHECKING:
    from ..workspace.shells import Shell
    from ..workspace.study import Study

SUMMARY = "rank a machine's errors by what they do to the tool over the whole workspace"

TEXT = """Finds what the machine reaches (stroke, joint cones, strut clearance, condition number), and the effect of
every single error of the budget at every grid point of it, by forward kinematics of the machine with that error.
Prints the ranked table of v. Daake, Vetter, Böhm & Zirn with their figures beside it, what the budget adds up to,
and with --allow-um what each error may be. Writes into the folder of --out: report.txt, ranking.csv, ranking.json,
pictures (ranking, causes, one of shells for each error type), and with plotly installed page.html, which shows
every error from all sides.

--tilt-deg says which orientations: every combination of the tilts about x and y.

example:
  $ hexapod_comp classify --out out
  $ hexapod_comp classify --tilt-deg 0 --allow-um 50 --out out"""


def add_parser(subparsers: common.Subparsers) -> None:
    """Add the verb."""
    parser = common.add_verb(subparsers, "classify", run, SUMMARY, TEXT)
    add = parser.add_argument
    text = "geometry file, or the name of a shipped one (default positioning_unit.yaml)"
    add("--machine", metavar="FILE", default="positioning_unit.yaml", help=text)
    text = "error budget, or the name of a shipped one (default error_budget.yaml)"
    add("--budget", metavar="FILE", default="error_budget.yaml", help=text)
    add("--out", metavar="DIR", required=True, help="folder for everything; made if it is missing")
    add("--cells", type=common.count, default=30, metavar="N", help="cells along the grid's longest edge (default 30)")
    text = "smallest distance between the axes of two struts, mm; 0: not limited (default: the geometry's)"
    add("--clearance-mm", type=common.bound, metavar="MM", help=text)
    text = "tilts about x and y (default -4,0,4)"
    add("--tilt-deg", type=tilts_argument, default=tilts_argument("-4,0,4"), metavar="A,B,…", help=text)
    add("--method", choices=("exact", "linear"), default="exact", help="of the ranking (default exact)")
    add("--compare", type=common.count, metavar="N", help="compare exact, linear and the paper's iteration at N poses")
    add("--allow-um", type=above_zero, metavar="UM", help="allowed error of the tool: says what the errors may be")
    add("--workers", type=workers_argument, default=1, metavar="N", help="processes (default 1, with all threads)")
    add("--scheduler", metavar="tcp://…", help="Dask scheduler that does the work instead")
    add("--seed", type=common.seed, default=0, metavar="N", help="of random poses and draws (default 0)")
    add("--no-page", action="store_true", help="leave the interactive page out")
    add("--publish", action="store_true", help="then keep the worst type's shells on workspace/shells until Ctrl-C")


def tilts_argument(text: str) -> tuple[float, ...]:
    """Read tilts in degrees; return them in rad, rising, each once."""
    import math

    return tuple(math.radians(v) for v in sorted({common.finite(part) for part in text.split(",")}))


def workers_argument(text: str) -> int:
    """Read a number of processes; each takes some 200 MB."""
    return common.count(text, most=256)


def above_zero(text: str) -> float:
    """Read a finite number above zero."""
    number = common.finite(text)
    if number <= 0.0:
        raise argparse.ArgumentTypeError(f"must be above zero, not {text}")
    return number


def run(args: argparse.Namespace) -> int:
    """Run the verb."""
    from ..errors import InputFileError, ModelError
    from ..formats.paths import config_file
    from ..machine.geometry import load_geometry
    from ..workspace.reach import orientations, reaches
    from ..workspace.report import report
    from ..workspace.sources import load_budget
    from ..workspace.study import classify, shells_of

    geometry = load_geometry(args.machine)
    if args.clearance_mm is not None:
        geometry = replace(geometry, limits=replace(geometry.limits, clearance=args.clearance_mm * 1e-3))
    budget_file = config_file(args.budget)
    budget = load_budget(budget_file)
    try:
        budget.single_errors(geometry)
    except ModelError as error:  # refused before the work starts
        raise InputFileError(budget_file, error.key, error.problem, error.value) from error
    folder = _folder(args.out)
    common.mention_compiling("kinematics.solve_pose_many")
    turned = orientations(geometry, (args.tilt_deg, args.tilt_deg, (0.0,)))
    found = reaches(geometry, turned, args.cells)
    names = _names(args.tilt_deg)
    with common.progress_bar(sum(int(one.within.sum()) for one in found), " poses") as bar:
        study = classify(
            geometry,
            budget,
            found,
            method=args.method,
            allowed=None if args.allow_um is None else args.allow_um * 1e-6,
            compare=args.compare or 0,
            workers=args.workers,
            scheduler=args.scheduler,
            seed=args.seed,
            progress=bar.update,
        )
    text = report(study, names)
    print(text)
    _write(study, text, folder)
    bodies = shells_of(found)
    _draw(study, bodies, names, folder)
    if not args.no_page:
        _page(study, bodies, names, folder)
    if args.publish:
        _publish(study, bodies, names)
    return 0


def _folder(path: str) -> Path:
    """Return the folder for the results, made if it is missing.

    Raises
    ------
    InputFileError
        It cannot be made.
    """
    from ..errors import InputFileError

    try:
        Path(path).mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputFileError(path, "", f"cannot be made a folder: {error.strerror}") from error
    return Path(path)


def _names(tilts: tuple[float, ...]) -> tuple[str, ...]:
    """Return the names of every combination of tilts about x and y, in their order."""
    import math
    from itertools import product

    return tuple(f"α {math.degrees(a):g}°, β {math.degrees(b):g}°" for a, b in product(tilts, tilts))


def _write(study: Study, text: str, folder: Path) -> None:
    """Write the report and the tables."""
    from ..formats.yaml import write_text_atomically
    from ..workspace.ranking import ranking_rows
    from ..workspace.report import as_json

    write_text_atomically(folder / "report.txt", text)
    write_text_atomically(folder / "ranking.csv", common.csv_text(ranking_rows(study.rows)))
    write_text_atomically(folder / "ranking.json", common.json_text(as_json(study)))


def _draw(study: Study, bodies: tuple[Shell, ...], names: tuple[str, ...], folder: Path) -> None:
    """Draw the pictures: of the orientation in the middle of the list."""
    from ..formats.figures import save
    from ..workspace.layers import TRANSLATION, Layer
    from ..workspace.pictures import RankedRow, causes_figure, ranking_figure, shells_figure
    from ..workspace.study import mesh_effects

    middle = len(bodies) // 2
    body, where, machine = bodies[middle], names[middle], study.geometry.name
    figures: dict[str, Any] = {
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
    for name, figure in figures.items():
        save(figure, folder / name)
    print(f"pictures: {', '.join(figures)} in {folder}")


def _publish(study: Study, bodies: tuple[Shell, ...], names: tuple[str, ...]) -> None:
    """Keep shells on a latched topic, for RViz and Foxglove, until Ctrl-C."""
    from ..nodes.shell_markers import TOPIC, show_shells
    from ..workspace.layers import TRANSLATION, Layer
    from ..workspace.study import mesh_effects

    middle = len(bodies) // 2
    points, values = mesh_effects(study, bodies[middle])
    error = int(study.extremes.at_error[study.extremes.values[:, 0].argmax(), 0])
    kind = study.errors.kinds[study.errors.kind[error]]
    layers = [Layer(p, v) for p, v in zip(points, values[error, 0], strict=True)]
    print(f"publishing on {TOPIC}, frame work, until Ctrl-C", flush=True)
    show_shells(layers, TRANSLATION, f"{kind}, {study.errors.labels[error]}, {names[middle]}")


def _bar(row: Any, kind: Any) -> Any:
    """Return a ranked row as a bar pair."""
    figures = row.figures()
    return kind(row.title, (float(figures[1]), float(figures[0])), (float(figures[3]), float(figures[2])))


def _page(study: Study, bodies: tuple[Shell, ...], names: tuple[str, ...], folder: Path) -> None:
    """Write the interactive page, or say what it needs."""
    from ..errors import HexapodError, InputFileError
    from ..workspace.page import page_data, write_page

    try:
        write_page(folder / "page.html", study.geometry, page_data(study, bodies, names, "orientation"))
    except InputFileError:
        raise
    except HexapodError as error:  # plotly is an extra: the rest is there without it
        print(f"no page: {error}")
        return
    print(f"page: {folder / 'page.html'}")
