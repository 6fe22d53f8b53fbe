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

    from ..calibration.certificate import Details
    from ..calibration.evaluation import Worth
    from ..calibration.fit import ModelFit
    from ..calibration.parameters import FitSettings
    from ..calibration.posterior import FittedParameters
    from ..machine.model import MachineModel, RealMachine
    from ..measurements.readings import MeasurementSet
    from ..pose import Pose

REFUSED = "NOT WRITTEN: this model is not to be trusted"
FORCED = "WRITTEN BY FORCE: this model is not to be trusted"
"""Top of the report where readings do not bear the model out."""

ADVICE = "Do units, lead, geometry and the instrument's uncertainty fit?"


OF_THE_MODEL = ("correction", "assembly", "not_converged")
"""Limits that a model breaks by itself; others, such as the stroke's end, a measured pose may be next to."""


def fit_settings(args: argparse.Namespace) -> FitSettings:
    """Return what the options say about a fit of scheme joint."""
    from ..calibration.parameters import TOLERANCES, FitSettings

    given: dict[str, Any] = {}
    if args.blocks is not None:
        named = [name.strip() for name in args.blocks.split(",") if name.strip()]
        given["blocks"] = tuple(b for name in named for b in _blocks_called(name))
    if args.lead_mm is not None:
        given["lead"] = args.lead_mm * 1e-3
    if args.field_degree is not None:
        given["field_degree"] = args.field_degree
    if args.expansion_ppm is not None:
        given |= dict(zip(("strut_expansion", "base_expansion", "platform_expansion"), args.expansion_ppm, strict=True))
    if args.moisture_ppm is not None:
        given["strut_moisture"] = args.moisture_ppm * 1e-4
    if args.thermometer is not None:
        given["thermometer"] = args.thermometer
    if args.time_constants_s is not None:
        given["time_constants"] = args.time_constants_s
    if args.tolerance_um is not None:
        given["tolerances"] = tuple({**TOLERANCES, "structure": args.tolerance_um * 1e-6}.items())
    for name, option, unit in (("scale", "scale_ppm", 1e-6), ("alignment", "alignment_mrad", 1e-3)):
        if getattr(args, option, None) is not None:
            given[name] = getattr(args, option) * unit
    robust = not getattr(args, "not_robust", False)
    return FitSettings(shared_platform_joints=not args.separate_joints, robust=robust, **given)


def _blocks_called(name: str) -> tuple[str, ...]:
    from ..calibration.blocks import HARMONICS

    several = {"field": ("field displacement", "field rotation", "field reversal"), "harmonics": HARMONICS}
    return several.get(name, (name,))


def run(args: argparse.Namespace) -> int:
    """Run the verb; 1 when the readings do not bear the model out."""
    # One fit's matrices are too small for the threads of NumPy's BLAS, which on busy cores wait for each other. It
    # reads this when it is loaded, and nothing has loaded it yet.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    if args.update is not None:
        from .renewal import renew

        return renew(args)
    from ..errors import CalibrationError
    from ..machine.geometry import load_geometry
    from ..machine.model import RealMachine
    from ..measurements.files import read_measurements
    from ..virtual.named import find_model

    _refuse_options_of_the_other_scheme(args)
    _details(args)  # what is wrong there is better said before a long fit
    geometry = load_geometry(args.machine)
    truth = None if args.truth is None else RealMachine(geometry, find_model(args.truth, geometry))
    settings = fit_settings(args)
    with common.stage("reading measurements"):
        measured = read_measurements(args.files, geometry, args.columns, args.probe_mm)
    try:
        result = _joint(args, measured, settings) if args.scheme == "joint" else _lines(args, measured)
    except CalibrationError:
        common.say_notes(measured.notes)  # they may say why
        raise
    if beyond := beyond_limits(measured, result.model):
        result = replace(result, misfit="; ".join(filter(None, (result.misfit, beyond))))
    if result.misfit and not args.force:
        _refuse(args, result)
        return 1
    with common.stage("trying the model on the virtual machine"):
        worth = _worth(truth, result, measured)
    _write(args, result, measured, worth)
    return 0


def beyond_limits(measured: MeasurementSet, model: MachineModel) -> str:
    """Return which poses, of those measured, the compensator would refuse with a model; empty if none."""
    import numpy as np

    from ..compensation.checks import check
    from ..formats.texts import number

    geometry, stations = measured.geometry, measured.stations
    places = np.hstack([stations.positions, stations.rotations.reshape(-1, 9)]).round(12)
    chosen = np.unique(places, axis=0, return_index=True)[1]
    poses = geometry.tool_poses(stations.positions[chosen], stations.rotations[chosen])
    breaches = [b for b in check(geometry, model, poses, "poses").breaches if b.limit in OF_THE_MODEL]
    if not breaches:
        return ""
    at = ", ".join(number(1e3 * v, 1) for v in poses[0][breaches[0].row])
    count = len({breach.row for breach in breaches})
    problem = f"with it the compensator would refuse {count} of the {len(chosen)} poses that were measured"
    return f"{problem}, first at {at} mm, tool in work: {breaches[0].error}"


def _refuse(args: argparse.Namespace, result: _Result) -> None:
    """Show a model that is not written."""
    if args.json:
        common.show({**result.content(), "misfit": result.misfit, "written": None})
    else:
        common.show(f"{REFUSED}: {result.misfit}. {ADVICE}\n\n{result.text}")
    print("hexapod_comp: error: nothing was written; the report says why, --force writes it", file=sys.stderr)


def _write(args: argparse.Namespace, result: _Result, measured: MeasurementSet, worth: Worth | None) -> None:
    """Write the model and what else was asked for, and show it."""
    from ..calibration.lines_report import worth_json, worth_text
    from ..calibration.posterior_file import save_with_posterior
    from ..formats.outputs import write_text
    from ..machine.region import region_json
    from ..measurements.standards import judge, standards_json, standards_text

    judged = judge(measured)
    parts = [result.text, _region(result, measured) + "\n"]
    parts += [standards_text(judged) + "\n"] if judged else []
    parts += [worth_text(worth) + "\n"] if worth else []
    text = "\n".join(parts)
    if result.misfit:
        text = f"{FORCED}: {result.misfit}. {ADVICE}\n\n{text}"
    beside = save_with_posterior(result.saved, result.fitted, args.out)
    if args.json:
        more = {"standards": standards_json(judged), "worth": worth_json(worth) if worth else None}
        files = {"written": args.out, "written_beside": beside}
        more["measured_box"] = region_json(result.model.measured, measured.geometry)
        common.show({**result.content(), **more, "misfit": result.misfit, **files})
    else:
        print(f"{text}\nmodel: {args.out}")
        print("".join(f"its parameters' covariance, to be kept beside it: {path}\n" for path in beside), end="")
    if args.report is not None:
        write_text(args.report, text)
    if args.certificate is not None and result.fit is not None:
        with common.stage("writing the certificate"):
            _write_certificate(args, result, result.fit, beside, text)
        common.mention(args, f"certificate: {args.certificate}")
    common.save_pictures(args, result.pictures)


def _region(result: _Result, measured: MeasurementSet) -> str:
    """Return where the model was measured."""
    from ..machine.region import region_text

    return region_text(result.model.measured, measured.geometry)


def _details(args: argparse.Namespace) -> Details | None:
    """Return what the details file says, if there is one."""
    if args.details is None:
        return None
    from ..calibration.certificate import load_details
    from ..errors import CalibrationError

    if args.certificate is None:
        raise CalibrationError("--details", "is what a certificate says: --certificate is missing")
    return load_details(args.details)


def _write_certificate(
    args: argparse.Namespace, result: _Result, fit: ModelFit, beside: list[Path], report: str
) -> None:
    """Write the certificate of a model that has been written."""
    from ..calibration.certificate import Filed, certificate_text
    from ..formats.outputs import write_text

    filed = Filed(result.model.name, (Path(args.out), *beside), report)
    write_text(args.certificate, certificate_text(fit, filed, _details(args)))


def _refuse_options_of_the_other_scheme(args: argparse.Namespace) -> None:
    """Raise on an option that the scheme would not listen to."""
    from ..errors import CalibrationError

    heat = ("expansion_ppm", "moisture_ppm", "thermometer", "time_constants_s")
    of_joint = ("lead_mm", "blocks", "tolerance_um", "field_degree", "scale_ppm", "alignment_mrad", *heat)
    if args.compensated:
        raise CalibrationError("--compensated", "is for check readings, of verify or of fit --update")
    others = (
        ("order", "every_line")
        if args.scheme == "joint"
        else (*of_joint, "separate_joints", "not_robust", "certificate")
    )
    for name in others:
        if getattr(args, name) not in (None, False):
            raise CalibrationError(f"--{name.replace('_', '-')}", f"has no meaning for scheme {args.scheme}")


@dataclass(frozen=True)
class _Result:
    """What a scheme gives: the model, its report as text and for JSON, its pictures, and what it knows how well."""

    model: MachineModel
    text: str
    content: Callable[[], dict[str, Any]]
    pictures: Callable[[], dict[str, Figure]]
    misfit: str
    fitted: FittedParameters | None = None
    fit: ModelFit | None = None

    @property
    def saved(self) -> MachineModel:
        """The model, with a remark to whoever runs it where it was forced."""
        if not self.misfit:
            return self.model
        origin = self.model.origin
        return replace(self.model, origin=replace(origin, note=f"FORCED: {self.misfit}. {origin.note}"))


def _datum(args: argparse.Namespace, measured: MeasurementSet) -> Pose | None:
    """Return the platform's pose in base at the datum, None for home."""
    from ..pose import Pose

    return None if args.datum is None else measured.geometry.platform_pose(Pose.from_angles(*args.datum))


def _joint(args: argparse.Namespace, measured: MeasurementSet, settings: FitSettings) -> _Result:
    """Fit with scheme joint."""
    from ..calibration.fit import fit_model
    from ..calibration.posterior import FittedParameters
    from ..calibration.report import as_json, fit_report
    from ..machine.model import RealMachine

    with common.stage_line() as say:
        fit = fit_model(measured, settings, say, _datum(args, measured))

    fitted = FittedParameters.of(fit)

    def pictures() -> dict[str, Figure]:
        from ..calibration.pictures import fit_figure, left_error_figure, predicted_error_figure, strut_error_figure

        made = {"fit.png": fit_figure(fit)}
        if fit.model.region is not None:
            made["left.png"] = left_error_figure(fit)
            machine = RealMachine(measured.geometry, fit.model)
            made["predicted_error.png"] = predicted_error_figure(machine, fitted)
            made["strut_errors.png"] = strut_error_figure(measured.geometry, {"scheme joint": fit.model})
        return made

    model = fit.model if args.name is None else replace(fit.model, name=args.name)
    return _Result(model, fit_report(fit), lambda: as_json(fit), pictures, fit.misfit, fitted, fit)


def _lines(args: argparse.Namespace, measured: MeasurementSet) -> _Result:
    """Fit with scheme lines."""
    from ..calibration.lines import fit_lines
    from ..calibration.lines_report import as_json, report
    from ..machine.model import RealMachine

    fit = fit_lines(measured, args.order or "adjusted-r2", name=args.name or "", datum=_datum(args, measured))

    def pictures() -> dict[str, Figure]:
        from ..calibration.pictures import fitted_lines_figure, predicted_error_figure, strut_error_figure

        of_struts = strut_error_figure(measured.geometry, {fit.model.name: fit.model})
        predicted = predicted_error_figure(RealMachine(measured.geometry, fit.model), None)
        return {"lines.png": fitted_lines_figure(fit), "strut_errors.png": of_struts, "predicted_error.png": predicted}

    text = report(fit, every_line=args.every_line)
    return _Result(fit.model, text, lambda: as_json(fit), pictures, fit.misfit)


def _worth(truth: RealMachine | None, result: _Result, measured: MeasurementSet) -> Worth | None:
    """Return what the model is worth on the virtual machine that was measured, if that is known."""
    from ..calibration.evaluation import worth
    from ..errors import CalibrationError
    from ..measurements.readings import spans

    if truth is None:
        return None
    box, geometry = measured.tool_box(), measured.geometry
    if not spans(box):
        raise CalibrationError("--truth", "the readings span no box in which the model could be judged")
    level = geometry.work.rotation.T @ measured.level() @ geometry.tool.rotation
    tool = None if result.fit is None else result.fit.level
    promised = None if tool is None else (tool.low, tool.high)
    return replace(worth(truth, result.model, box, level=level), promised=promised)
