"""``hexapod_comp fit``: from measurements to a model of the machine."""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from . import common

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from numpy.typing import ArrayLike

    from ..calibration.parameters import FitSettings
    from ..machine.model import MachineModel
    from ..measurements.readings import MeasurementSet

SUMMARY = "fit a model of the machine's errors to measurements"

REFUSED = "NOT WRITTEN: this model is not to be trusted"
FORCED = "WRITTEN BY FORCE: this model is not to be trusted"
"""Top of the report where readings do not bear the model out."""

ADVICE = "Do units, lead, geometry and the instrument's uncertainty fit?"

TEXT = """Reads tidy CSV (one reading a row, what measure writes), .rtl and .rtx files of the laser software (each with
its line file NAME.rtl.yaml beside it), or with --columns the wide CSV files of other labs.

--scheme joint fits structure, struts and field to all readings at once, and keeps only what helps on readings that
the fit did not see. --scheme lines is the paper's: a polynomial per grid line, direction and channel.
--truth names the errors of the virtual machine that measure moved: the report then says what the model is worth.

example:
  $ hexapod_comp measure --campaign campaign_5d --seed 1 --out measured.csv
  $ hexapod_comp fit measured.csv --lead-mm 10 --out model.yaml --pictures out
  $ hexapod_comp demo --model model.yaml"""


def add_parser(subparsers: common.Subparsers) -> None:
    """Add the verb."""
    parser = common.add_verb(subparsers, "fit", run, SUMMARY, TEXT)
    add_reading_options(parser)
    parser.add_argument("--scheme", choices=("joint", "lines"), default="joint", help="how to fit (default joint)")
    parser.add_argument("--out", metavar="MODEL", required=True, help="model file to write")
    parser.add_argument("--name", metavar="TEXT", help="name of the model")
    parser.add_argument("--report", metavar="FILE", help="write the report to a file too")
    parser.add_argument("--json", metavar="FILE", help="write values, errors and all tables as JSON (joint)")
    parser.add_argument("--covariance", metavar="FILE.npz", help="write the parameters' covariance (joint)")
    parser.add_argument("--pictures", metavar="DIR", help="folder for pictures; made if it is missing")
    parser.add_argument("--truth", metavar="FILE", help="model of the virtual machine that was measured")
    parser.add_argument("--force", action="store_true", help="write a model that the readings do not bear out")
    add_fit_options(parser)
    parser.add_argument("--not-robust", action="store_true", help="trust readings that disagree with the rest (joint)")
    text = "what picks the polynomials' order (lines; default adjusted-r2)"
    parser.add_argument("--order", choices=("adjusted-r2", "aicc"), help=text)
    parser.add_argument("--every-line", action="store_true", help="report order, R² and residual of each line (lines)")


def add_reading_options(parser: argparse.ArgumentParser) -> None:
    """Add the files, the machine, and how the files are read."""
    parser.add_argument("files", nargs="+", metavar="FILE", help="measured files")
    common.add_machine_options(parser, with_model=False)
    parser.add_argument("--columns", metavar="FILE", help="columns file that explains wide CSV files")
    parser.add_argument(
        "--probe-mm", type=point_argument, metavar="X,Y,Z", help="measured point in platform (default: the tool's tip)"
    )


def add_fit_options(parser: argparse.ArgumentParser) -> None:
    """Add what a joint fit, or a plan for one, is told."""
    add = parser.add_argument_group("scheme joint").add_argument
    add("--lead-mm", type=common.bound, metavar="MM", help="period of the screws' errors (default: the geometry's)")
    add("--blocks", metavar="A,B,…", help="what may be fitted: pitch, wave, backlash, map, field (default all)")
    add("--separate-joints", action="store_true", help="platform joints at the same place are two joints, not one")
    text = "how well joints are built, to start from, µm (default 100)"
    add("--tolerance-um", type=common.bound, metavar="UM", help=text)
    add("--field-degree", type=common.count, metavar="N", help="degree of the field (default 6)")
    text = "thermal expansion of struts, or of struts, base and platform, ppm/K (default 0)"
    add("--expansion-ppm", type=expansion_argument, metavar="S[,B,P]", help=text)


def point_argument(text: str) -> tuple[float, ...]:
    """Read ``x,y,z`` in mm; return m."""
    position, angles = common.pose_argument(text)
    if any(angles):
        raise argparse.ArgumentTypeError(f"needs three numbers, mm, not {text}")
    return position


def expansion_argument(text: str) -> tuple[float, float, float]:
    """Read one or three expansions in ppm/K; return them in 1/K, for struts, base and platform."""
    numbers = [common.finite(part) * 1e-6 for part in text.split(",")]
    if len(numbers) not in (1, 3):
        raise argparse.ArgumentTypeError(f"needs one or three numbers, not {text}")
    return (numbers[0], *(numbers[1:] or (0.0, 0.0)))


def fit_settings(args: argparse.Namespace) -> FitSettings:
    """Return what the options say about a joint fit.

    Raises
    ------
    ModelError
        An unknown block.
    """
    from ..calibration.parameters import TOLERANCES, FitSettings

    said: dict[str, Any] = {}
    if args.blocks is not None:
        named = [name.strip() for name in args.blocks.split(",") if name.strip()]
        said["blocks"] = tuple(b for name in named for b in _blocks_called(name))
    if args.lead_mm is not None:
        said["lead"] = args.lead_mm * 1e-3
    if args.field_degree is not None:
        said["field_degree"] = args.field_degree
    if args.expansion_ppm is not None:
        said |= dict(zip(("strut_expansion", "base_expansion", "platform_expansion"), args.expansion_ppm, strict=True))
    if args.tolerance_um is not None:
        said["tolerances"] = tuple({**TOLERANCES, "structure": args.tolerance_um * 1e-6}.items())
    robust = not getattr(args, "not_robust", False)
    return FitSettings(shared_platform_joints=not args.separate_joints, robust=robust, **said)


def _blocks_called(name: str) -> tuple[str, ...]:
    return ("field displacement", "field rotation", "field reversal") if name == "field" else (name,)


def run(args: argparse.Namespace) -> int:
    """Run the verb."""
    # One fit's matrices are too small for the threads of NumPy's BLAS, which on busy cores wait for each other. It
    # reads this when it is loaded, and nothing has loaded it yet.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    from ..errors import CalibrationError
    from ..formats.paths import config_file
    from ..formats.yaml import write_text_atomically
    from ..machine.geometry import load_geometry
    from ..machine.model import RealMachine
    from ..machine.model_file import load_model, save_model
    from ..measurements.files import read_measurements

    _refuse_options_of_the_other_scheme(args)
    for path in (args.out, args.report, args.json, args.covariance):
        _refuse_missing_folder(path)
    geometry = load_geometry(args.machine)
    truth = None if args.truth is None else RealMachine(geometry, load_model(args.truth, geometry))
    columns = None if args.columns is None else config_file(args.columns)
    settings = fit_settings(args)
    measured = read_measurements(args.files, geometry, columns, args.probe_mm)
    common.mention_compiling("model.actual_pose_one")
    try:
        result = _joint(args, measured, settings) if args.scheme == "joint" else _lines(args, measured)
    except CalibrationError:
        common.say_notes(measured.notes)  # they may say why
        raise
    if result.misfit and not args.force:
        print(f"{REFUSED}: {result.misfit}. {ADVICE}\n\n{result.text}")
        print("hexapod_comp: error: nothing was written; the report says why, --force writes it", file=sys.stderr)
        return 1
    parts = (result.text, _iso_text(measured), _worth_text(truth, result.model, measured))
    text = "\n".join(part for part in parts if part)
    if result.misfit:
        text = f"{FORCED}: {result.misfit}. {ADVICE}\n\n{text}"
    save_model(result.saved, args.out)
    print(text)
    print(f"model: {args.out}")
    if args.report is not None:
        write_text_atomically(args.report, text)
    result.save_more()
    _save_pictures(result.pictures, args.pictures)
    return 0


def _refuse_options_of_the_other_scheme(args: argparse.Namespace) -> None:
    """Raise on an option that the scheme would not listen to."""
    from ..errors import CalibrationError

    of_joint = ("lead_mm", "blocks", "tolerance_um", "field_degree", "expansion_ppm", "json", "covariance")
    others = ("order", "every_line") if args.scheme == "joint" else (*of_joint, "separate_joints", "not_robust")
    for name in others:
        if getattr(args, name) not in (None, False):
            raise CalibrationError(f"--{name.replace('_', '-')}", f"has no meaning for scheme {args.scheme}")


def _refuse_missing_folder(path: str | None) -> None:
    """Raise before a long fit when its result could not be written."""
    from ..errors import InputFileError

    if path is not None and not Path(path).parent.is_dir():
        raise InputFileError(path, "", "cannot be written: its folder does not exist")


@dataclass(frozen=True)
class _Result:
    """What a scheme gives: the model, its report, its pictures, and what else to save."""

    model: MachineModel
    text: str
    pictures: Callable[[], dict[str, Figure]]
    misfit: str
    save_more: Callable[[], None] = lambda: None

    @property
    def saved(self) -> MachineModel:
        """The model, with a remark to whoever runs it where it was forced."""
        if not self.misfit:
            return self.model
        origin = self.model.origin
        return replace(self.model, origin=replace(origin, note=f"FORCED: {self.misfit}. {origin.note}"))


def _joint(args: argparse.Namespace, measured: MeasurementSet, settings: FitSettings) -> _Result:
    """Fit with scheme joint."""
    from ..calibration.fit import fit_model
    from ..calibration.report import as_json, fit_report
    from ..formats.yaml import write_text_atomically

    with common.stage_line() as say:
        fit = fit_model(measured, settings, say)

    def save_more() -> None:
        if args.json is not None:
            write_text_atomically(args.json, common.json_text(as_json(fit)))
        if args.covariance is not None:
            labels = [label for block in fit.space.blocks for label in block.labels]
            _save_arrays(args.covariance, labels=labels, values=fit.solution.x, covariance=fit.covariance)

    def pictures() -> dict[str, Figure]:
        from ..calibration.pictures import fit_figure, left_error_figure, strut_error_figure

        made = {"fit.png": fit_figure(fit)}
        if fit.model.valid_box is not None:
            made["left.png"] = left_error_figure(fit)
            made["strut_errors.png"] = strut_error_figure(measured.geometry, {"scheme joint": fit.model})
        return made

    model = fit.model if args.name is None else replace(fit.model, name=args.name)
    return _Result(model, fit_report(fit), pictures, fit.misfit, save_more)


def _lines(args: argparse.Namespace, measured: MeasurementSet) -> _Result:
    """Fit with scheme lines."""
    from ..calibration.lines import fit_lines
    from ..calibration.lines_report import report

    fit = fit_lines(measured, args.order or "adjusted-r2", name=args.name or "")

    def pictures() -> dict[str, Figure]:
        from ..calibration.pictures import fitted_lines_figure, strut_error_figure

        of_struts = strut_error_figure(measured.geometry, {fit.model.name: fit.model})
        return {"lines.png": fitted_lines_figure(fit), "strut_errors.png": of_struts}

    return _Result(fit.model, report(fit, every_line=args.every_line), pictures, fit.misfit)


def _iso_text(measured: MeasurementSet) -> str:
    """Return the figures of ISO 230-2 of the runs that have them."""
    from ..measurements.iso230 import evaluate, iso230_runs, table

    tests = {run.name: evaluate(run.targets, run.deviations) for run in iso230_runs(measured)}
    return table(tests) + "\n" if tests else ""


def _worth_text(truth: object, model: MachineModel, measured: MeasurementSet) -> str:
    """Return what the model is worth on the virtual machine that was measured."""
    from ..calibration.evaluation import worth
    from ..calibration.lines_report import worth_text
    from ..errors import CalibrationError
    from ..machine.model import RealMachine
    from ..measurements.readings import spans

    if not isinstance(truth, RealMachine):
        return ""
    box, geometry = measured.tool_box(), measured.geometry
    if not spans(box):
        raise CalibrationError("--truth", "the readings span no box in which the model could be judged")
    level = geometry.work.rotation.T @ measured.level() @ geometry.tool.rotation
    return worth_text(worth(truth, model, box, level=level)) + "\n"


def _save_arrays(path: str, **arrays: ArrayLike) -> None:
    """Write arrays, without pickles."""
    import numpy as np

    from ..errors import InputFileError
    from ..formats.outputs import refuse_replacing_input

    refuse_replacing_input(path)
    try:
        with open(path, "wb") as stream:
            np.savez_compressed(stream, allow_pickle=False, **arrays)
    except OSError as error:
        raise InputFileError(path, "", f"cannot be written: {error.strerror}") from error


def _save_pictures(pictures: Callable[[], dict[str, Figure]], folder: str | None) -> None:
    """Draw pictures and write them into a folder, if one is given, and say where they are."""
    from ..formats.figures import save

    if folder is None:
        return
    for name, figure in pictures().items():
        path = Path(folder) / name
        save(figure, path)
        print(f"picture: {path}")
