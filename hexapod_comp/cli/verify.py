"""``hexapod_comp verify``: does a model still hold, by a few check readings?"""

from __future__ import annotations

import argparse
from typing import Any, NamedTuple

import numpy as np

from ..calibration.check import VALID, Verification, verify_model
from ..calibration.check_report import verification_json, verification_report
from ..calibration.follow_up import places, propose_check
from ..calibration.posterior import FittedParameters
from ..calibration.posterior_file import load_posterior
from ..errors import CommandError
from ..machine.geometry import load_geometry
from ..machine.model import MachineModel
from ..machine.model_file import load_model
from ..measurements.files import read_measurements
from ..measurements.readings import MeasurementSet
from ..measurements.tidy import write_measurements
from ..virtual.instruments import compensated
from . import common


def run(args: argparse.Namespace) -> common.Result:
    """Run the verb; 1 when the machine has changed."""
    if args.propose is not None:
        return _propose(args)
    result = checked(args, args.model).verification
    code = 0 if result.verdict == VALID else 1
    return common.Result(lambda: verification_report(result), lambda: verification_json(result), code=code)


def _propose(args: argparse.Namespace) -> common.Result:
    """Write the check readings to take."""
    _, fitted = _known(args, args.model)
    with common.stage("choosing readings"):
        wanted: dict[str, Any] = {} if args.readings is None else {"readings": args.readings}
        if args.instruments is not None:
            wanted["instruments"] = args.instruments.split(",")
        readings = propose_check(fitted, **wanted)
    write_measurements(readings, args.propose)
    runs = [(where, channels) for where, channels, _ in places(readings)]
    lines = [f"{len(readings)} check readings:", *(f"  {where}: {', '.join(read)}" for where, read in runs)]
    listed = [{"where": where, "channels": channels} for where, channels in runs]
    return common.Result(
        lambda: "\n".join([*lines, f"to be filled in: {args.propose}"]),
        lambda: {"runs": listed, "written": args.propose},
    )


class Checked(NamedTuple):
    """A model with what its fit knows, and readings that check it."""

    model: MachineModel
    fitted: FittedParameters
    measured: MeasurementSet
    verification: Verification


def checked(args: argparse.Namespace, path: str) -> Checked:
    """Return a model beside the check readings that the options name."""
    model, fitted = _known(args, path)
    geometry, probe = fitted.space.geometry, args.probe_mm
    if probe is None and not np.allclose(fitted.space.probe, geometry.tool.position, rtol=0.0, atol=1e-12):
        probe = fitted.space.probe  # as the fit was told
    with common.stage("reading measurements"):
        measured = read_measurements(args.files, geometry, args.columns, probe)
    if args.compensated:
        measured = compensated(measured, model)
    with common.stage("weighing what may have happened"):
        return Checked(model, fitted, measured, verify_model(model, fitted, measured))


def _known(args: argparse.Namespace, path: str) -> tuple[MachineModel, FittedParameters]:
    """Return a model and what its fit knows."""
    geometry = load_geometry(args.machine)
    model = load_model(path, geometry)
    fitted, unknown = load_posterior(model, geometry, path)
    if fitted is None:
        advice = "A fit of scheme joint writes MODEL.posterior.npz beside its model"
        raise CommandError("model", f"{path} cannot be checked: {unknown}. {advice}")
    return model, fitted
