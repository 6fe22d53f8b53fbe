"""The verbs ``plan`` (plans a campaign), ``fit`` (makes or updates a model) and ``verify`` (checks a model)."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Iterator
from dataclasses import fields, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ..calibration.blocks import GROUPS
from ..calibration.evaluation import ModelEvaluation, evaluate_model, evaluation_json, evaluation_text
from ..calibration.fit import ModelFit, fit_model
from ..calibration.lines import LinesFit, fit_lines
from ..calibration.parameters import FitSettings
from ..calibration.posterior import FittedParameters
from ..calibration.posterior_file import SUFFIX, load_posterior, save_with_posterior
from ..calibration.report import as_json, fit_report, lines_json, lines_report
from ..compensation.checks import check
from ..errors import CalibrationError, CommandError
from ..formats.outputs import write_text
from ..formats.paths import input_file
from ..formats.texts import number
from ..machine.geometry import HexapodGeometry, load_geometry
from ..machine.load import Payload, check_gravity
from ..machine.model import MachineModel, RealMachine
from ..machine.model_file import load_model, read_load
from ..machine.region import region_json, region_text
from ..machine.surroundings import load_row
from ..measurements.campaign import Campaign, campaign_text, template
from ..measurements.files import read_measurements
from ..measurements.iso230 import judge, standards_json, standards_text
from ..measurements.readings import MeasurementSet, spans
from ..measurements.stations import compensated
from ..measurements.tidy import write_measurements
from ..pose import Pose
from ..virtual.named import find_model
from . import results
from .results import Result

if TYPE_CHECKING:
    from ..calibration.check import Verification

# First words of the report if the readings contradict the model: without --force, with --force
REFUSED = "NOT WRITTEN: this model is not to be trusted"
FORCED = "WRITTEN BY FORCE: this model is not to be trusted"

ADVICE = "Check units, lead, geometry and the instrument's uncertainty."

# Limits that no measured pose breaks with a correct model; a measured pose may break the stroke, for example
MODEL_LIMITS = ("correction", "assembly", "not_converged")


def fit_settings(args: argparse.Namespace) -> FitSettings:
    """Return the settings of `fit --scheme joint` from the options; raise a ModelError for an unknown block."""
    known = {one.name for one in fields(FitSettings)} & vars(args).keys()
    given: dict[str, Any] = {name: value for name in known if (value := getattr(args, name)) is not None}
    if args.blocks is not None:
        named = [name.strip() for name in args.blocks.split(",") if name.strip()]
        given["blocks"] = tuple(block for name in named for block in GROUPS.get(name, (name,)))
    if args.expansion_ppm is not None:
        given |= dict(zip(("strut_expansion", "base_expansion", "platform_expansion"), args.expansion_ppm, strict=True))
    if args.load is not None:
        given["load"] = read_load(args.load).numbers()
    if args.tolerance_um is not None:
        given["tolerances"] = (("structure", args.tolerance_um * 1e-6),)
    robust = not getattr(args, "not_robust", False)
    return FitSettings(shared_platform_joints=not args.separate_joints, robust=robust, **given)


# ---- plan ----


def plan(args: argparse.Namespace) -> Result:
    """Predict which parameters a campaign determines, or propose a campaign; exit code 1: the goal is not met."""
    from ..calibration import design
    from ..calibration.candidates import MeasuringBox

    geometry = load_geometry(args.machine)
    campaign = results.load_campaign(args, geometry)
    if args.repeatability_um is not None:
        campaign = replace(campaign, repeatability=args.repeatability_um * 1e-6)
    if args.goal_um is None:
        with results.stage_line() as say:
            say("listing the campaign's readings")
            measured = template(campaign, geometry, args.seed, args.campaign)
            say(f"predicting which parameters {len(measured)} readings determine")
            result = design.plan(measured, campaign, fit_settings(args))
        return Result(lambda: design.plan_report(result), lambda: design.plan_json(result))
    times = dict(design.TIMES)
    for name, numbers in args.time or ():
        if name not in times:
            raise CalibrationError("--time", f"must name one of {', '.join(times)}, not {name}")
        times[name] = design.Times(*numbers)
    given: dict[str, Any] = {"instruments": tuple(args.instruments.split(","))} if args.instruments is not None else {}
    given |= {"seconds": args.hours * 3600.0} if args.hours is not None else {}
    tool = geometry.payload
    loads = [load_row(Payload(mass, tool.centre)) for mass in args.tools_kg or () if mass != tool.mass]
    loads += [load_row(tool, check_gravity("--gravity", vector)) for vector in args.gravity or ()]
    given["loads"] = tuple(loads)
    goal = design.Goal(args.goal_um * 1e-6, float(np.radians(args.tilt_deg or 0.0)), times=times, **given)
    place = MeasuringBox(geometry, campaign.box, campaign.level, goal.tilt)
    with results.stage_line() as say:
        proposal = design.propose(place, goal, fit_settings(args), campaign, say)
    results.print_notes(_detours(geometry, proposal.campaign))
    if args.out is not None:
        write_text(args.out, campaign_text(proposal.campaign, design.remarks(proposal)))
    return Result(
        lambda: design.proposal_report(proposal) + (f"\ncampaign: {args.out}\n" if args.out else ""),
        lambda: {**design.proposal_json(proposal), "written": args.out},
        code=0 if proposal.met else 1,
    )


def _detours(geometry: HexapodGeometry, campaign: Campaign) -> Iterator[str]:
    """Yield a note for each pair of consecutive runs between which a straight move would break a limit."""
    ends = [
        (run, slice(None, None, max(1, len(run.positions) - 1)) if run.is_line else slice(None))
        for run in campaign.runs
    ]
    names = [run.name for run, part in ends for _ in run.positions[part]]
    positions, rotations = (
        np.concatenate([getattr(run, what)[part] for run, part in ends]) for what in ("positions", "rotations")
    )
    result = check(geometry, MachineModel(geometry.name), (positions, rotations))
    for row in sorted({breach.row for breach in result.breaches}):
        error = next(breach.error for breach in result.breaches if breach.row == row)
        yield f"no straight move from {names[max(row - 1, 0)]} to {names[row]}: move via home ({error})"


# ---- fit ----


def fit(args: argparse.Namespace) -> int | Result:
    """Fit a model to measurements and write the model; exit code 1: the readings contradict the model."""
    if args.update is not None:
        return _update(args)
    if args.details is not None:
        from ..calibration.certificate import load_details

        load_details(args.details)  # to refuse a wrong file before the long fit
    geometry = load_geometry(args.machine)
    truth = None if args.truth is None else RealMachine(geometry, find_model(args.truth, geometry))
    settings = fit_settings(args)
    with results.stage("reading measurements"):
        measured = read_measurements(args.files, geometry, args.columns, args.probe_mm)
    datum = None if args.datum is None else geometry.platform_pose(Pose.from_angles(*args.datum))
    try:
        if args.scheme == "joint":
            with results.stage_line() as say:
                result: ModelFit | LinesFit = fit_model(measured, settings, say, datum)
        else:
            result = fit_lines(measured, datum=datum)
    except CalibrationError:
        results.print_notes(measured.notes)  # which may explain the failure
        raise
    misfit = "; ".join(filter(None, (result.misfit, beyond_limits(measured, result.model))))
    if isinstance(result, ModelFit):
        text, known = fit_report(result), result.parameters
        content: Callable[[], dict[str, Any]] = partial(as_json, result)
    else:
        text, known = lines_report(result), None
        content = partial(lines_json, result)
    if misfit and not args.force:
        print("hexapod_comp: error: no model was written, see the report; --force writes it", file=sys.stderr)
        return Result(
            lambda: f"{REFUSED}: {misfit}. {ADVICE}\n\n{text}",
            lambda: {**content(), "misfit": misfit, "written": None},
            code=1,
        )
    judged, tried = judge(measured), None
    if truth is not None:
        with results.stage("evaluating the model on the virtual machine"):
            tried = _evaluated(truth, result, measured)
    parts = [text, region_text(result.model.measured, measured.geometry) + "\n"]
    parts += [standards_text(judged) + "\n"] if judged else []
    parts += [evaluation_text(tried) + "\n"] if tried else []
    text = "\n".join([f"{FORCED}: {misfit}. {ADVICE}\n", *parts] if misfit else parts)
    model = _forced(result.model if args.name is None else replace(result.model, name=args.name), misfit)
    beside = save_with_posterior(model, known, args.out)
    more = {
        "standards": standards_json(judged),
        "worth": evaluation_json(tried) if tried else None,
        "measured_box": region_json(model.measured, measured.geometry),
        "misfit": misfit,
        "written": args.out,
        "written_beside": beside,
    }
    # before certificate and pictures, whose writing may fail
    Result(lambda: f"{text}\nmodel: {args.out}\n{_covariance_text(beside)}", lambda: {**content(), **more}).finish(args)
    if args.report is not None:
        write_text(args.report, text)
    if args.certificate is not None and isinstance(result, ModelFit):
        from ..calibration.certificate import certificate_text, load_details

        with results.stage("writing the certificate"):
            details = None if args.details is None else load_details(args.details)
            page = certificate_text(result, model.name, (Path(args.out), *beside), text, details)
            write_text(args.certificate, page)
        results.print_written(args, f"certificate: {args.certificate}")
    if args.pictures is not None:
        from ..calibration.pictures import pictures_of

        results.save_pictures(args, lambda: pictures_of(result))
    return 0


def beyond_limits(measured: MeasurementSet, model: MachineModel) -> str:
    """Return a text on measured poses that a compensator with this model would refuse; empty if there are none."""
    geometry, stations = measured.geometry, measured.stations
    places = np.hstack([stations.positions, stations.rotations.reshape(-1, 9)]).round(12)
    chosen = np.unique(places, axis=0, return_index=True)[1]
    poses = geometry.tool_poses(stations.positions[chosen], stations.rotations[chosen])
    breaches = [b for b in check(geometry, model, poses, "poses").breaches if b.limit in MODEL_LIMITS]
    if not breaches:
        return ""
    at = ", ".join(number(1e3 * v, 1) for v in poses[0][breaches[0].row])
    count = len({breach.row for breach in breaches})
    problem = f"with this model the compensator would refuse {count} of the {len(chosen)} measured poses"
    return f"{problem}, first at {at} mm, tool in work: {breaches[0].error}"


def _evaluated(truth: RealMachine, result: ModelFit | LinesFit, measured: MeasurementSet) -> ModelEvaluation:
    """Return the tool error of the virtual machine, compensated with the fitted model, in the box of the readings."""
    box, geometry = measured.tool_box(), measured.geometry
    if not spans(box):
        raise CalibrationError("--truth", "the readings do not span a box, so the model cannot be evaluated")
    level = geometry.work.rotation.T @ measured.level() @ geometry.tool.rotation
    tool = result.level if isinstance(result, ModelFit) else None
    promised = None if tool is None else (tool.low, tool.high)
    return replace(evaluate_model(truth, result.model, box, level=level), promised=promised)


def _forced(model: MachineModel, reason: str) -> MachineModel:
    """Return the model; its note begins with the `reason` why it should not be written, if there is one."""
    origin = model.origin
    return replace(model, origin=replace(origin, note=f"FORCED: {reason}. {origin.note}")) if reason else model


def _covariance_text(beside: list[Path]) -> str:
    return "".join(f"covariance of the model's parameters; keep it beside the model: {path}\n" for path in beside)


def _update(args: argparse.Namespace) -> Result:
    """Update a model from a few readings and write the new model; exit code 1: the readings allow no update."""
    from ..calibration.check import refusal, update_model, update_report, verification_json, verification_report

    old, new = input_file(args.update), Path(args.out)
    if new.resolve().with_name(new.stem + SUFFIX) == old.resolve().with_name(old.stem + SUFFIX):
        raise CommandError("--out", f"{new} would replace the fit's result for {old}; write to another name")
    model, fitted, measured, verification = checked(args, args.update)
    text, content = verification_report(verification), verification_json(verification)
    reason = refusal(verification)
    if reason and not args.force:
        print(f"hexapod_comp: error: no model was written: {reason} (--force writes the model)", file=sys.stderr)
        return Result(lambda: text, lambda: {**content, "refused": reason, "written": None}, code=1)
    update = update_model(model, fitted, measured, verification)
    model = _forced(update.model, reason)
    if args.name is not None:
        model = replace(model, name=args.name)
    beside = save_with_posterior(model, update.fitted, args.out)
    text = f"{text}\n{update_report(update, args.out)}{_covariance_text(beside)}"
    if args.report is not None:
        write_text(args.report, text)
    files = {"written": args.out, "written_beside": beside}
    return Result(lambda: text, lambda: {**content, "chi_square_after": update.chi_square, **files})


# ---- verify ----


def verify(args: argparse.Namespace) -> Result:
    """Check whether a model is still valid, or propose check readings; exit code 1: the machine has changed."""
    from ..calibration.check import VALID, verification_json, verification_report

    if args.propose is None:
        *_, result = checked(args, args.model)
        code = 0 if result.verdict == VALID else 1
        return Result(lambda: verification_report(result), lambda: verification_json(result), code=code)
    from ..calibration.candidates import places
    from ..calibration.design import propose_check

    _, fitted = _load_fitted(args, args.model)
    with results.stage("choosing readings"):
        wanted: dict[str, Any] = {} if args.readings is None else {"readings": args.readings}
        if args.instruments is not None:
            wanted["instruments"] = args.instruments.split(",")
        readings = propose_check(fitted, **wanted)
    write_measurements(readings, args.propose)
    runs = [{"where": where, "channels": channels} for where, channels, _ in places(readings)]
    lines = [f"{len(readings)} check readings:", *(f"  {run['where']}: {', '.join(run['channels'])}" for run in runs)]
    return Result(
        lambda: "\n".join([*lines, f"fill in the values: {args.propose}"]),
        lambda: {"runs": runs, "written": args.propose},
    )


def checked(args: argparse.Namespace, path: str) -> tuple[MachineModel, FittedParameters, MeasurementSet, Verification]:
    """Check the model in the file `path`; return the model, its fit's result, the check readings, and the verdict."""
    from ..calibration.check import verify_model

    model, fitted = _load_fitted(args, path)
    geometry, probe = fitted.space.geometry, args.probe_mm
    if probe is None and args.columns is None and np.abs(fitted.space.probe - geometry.tool.position).max() > 1e-12:
        probe = fitted.space.probe  # the measured point of the fit; a wide file holds poses of the tool's tip
    with results.stage("reading measurements"):
        measured = read_measurements(args.files, geometry, args.columns, probe)
    if args.compensated:
        measured = compensated(measured, model)
    with results.stage("comparing possible changes"):
        return model, fitted, measured, verify_model(model, fitted, measured)


def _load_fitted(args: argparse.Namespace, path: str) -> tuple[MachineModel, FittedParameters]:
    """Return the model in the file `path` and the result of its fit; raise a CommandError if this result is missing."""
    geometry = load_geometry(args.machine)
    model = load_model(path, geometry)
    fitted, unknown = load_posterior(model, geometry, path)
    if fitted is None:
        advice = "`fit --scheme joint` writes the missing file MODEL.posterior.npz beside the model"
        raise CommandError("model", f"{path} cannot be checked: {unknown}. {advice}")
    return model, fitted
