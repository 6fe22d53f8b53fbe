"""``hexapod_comp verify``: does a model still hold, by a few check readings?"""

from __future__ import annotations

import argparse
import os
from dataclasses import dataclass
from typing import TYPE_CHECKING

from . import common

if TYPE_CHECKING:
    from ..calibration.check import Verification
    from ..calibration.posterior import FittedParameters
    from ..machine.model import MachineModel
    from ..measurements.readings import MeasurementSet


def run(args: argparse.Namespace) -> int:
    """Run the verb; 1 when the machine has changed."""
    from ..calibration.check import VALID
    from ..calibration.check_report import verification_json, verification_report

    _refuse_what_does_not_fit(args)
    if args.propose is not None:
        return _propose(args)
    result = checked(args, args.model).verification
    common.show(verification_json(result) if args.json else verification_report(result))
    return 0 if result.verdict == VALID else 1


def _refuse_what_does_not_fit(args: argparse.Namespace) -> None:
    """Raise on readings that are missing, or that nobody would look at, and on options without a meaning."""
    from ..errors import CommandError

    if args.propose is None and not args.files:
        raise CommandError("FILE", "check readings are missing; --propose FILE says which to take")
    if args.propose is not None and (args.files or args.compensated):
        raise CommandError("--propose", "says which readings to take: measured files and --compensated come after that")
    for name in ("readings", "instruments"):
        if getattr(args, name) is not None and args.propose is None:
            raise CommandError(f"--{name}", "needs --propose")


def _propose(args: argparse.Namespace) -> int:
    """Write the check readings to take."""
    from ..calibration.follow_up import places, propose_check
    from ..measurements.writing import write_measurements

    _, fitted = _known(args, args.model)
    with common.stage("choosing readings"):
        wanted = {} if args.readings is None else {"readings": args.readings}
        if args.instruments is not None:
            wanted["instruments"] = args.instruments.split(",")
        readings = propose_check(fitted, **wanted)
    write_measurements(readings, args.propose)
    runs = [(where, channels) for where, channels, _ in places(readings)]
    if args.json:
        common.show(
            {"runs": [{"where": where, "channels": channels} for where, channels in runs], "written": args.propose}
        )
    else:
        print(f"{len(readings)} check readings:", *(f"  {where}: {', '.join(read)}" for where, read in runs), sep="\n")
        print(f"to be filled in: {args.propose}")
    return 0


@dataclass(frozen=True)
class Checked:
    """A model with what its fit knows, and readings that check it."""

    model: MachineModel
    fitted: FittedParameters
    measured: MeasurementSet
    verification: Verification


def checked(args: argparse.Namespace, path: str) -> Checked:
    """Return a model beside the check readings that the options name."""
    import numpy as np

    from ..calibration.check import verify_model
    from ..measurements.files import read_measurements
    from ..virtual.instruments import compensated

    model, fitted = _known(args, path)
    geometry, probe = fitted.space.geometry, args.probe_mm
    if probe is None and not np.allclose(fitted.space.probe, geometry.tool.position, rtol=0.0, atol=1e-12):
        probe = fitted.space.probe  # as the fit was told
    with common.stage("reading measurements"):
        measured = read_measurements(args.files, geometry, args.columns, probe)
    if args.compensated:
        measured = compensated(measured, model)
    with common.stage("weighing what may have happened"):
        verification = verify_model(model, fitted, measured)
    return Checked(model, fitted, measured, verification)


def _known(args: argparse.Namespace, path: str) -> tuple[MachineModel, FittedParameters]:
    """Return a model and what its fit knows."""
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # as for fit
    from ..calibration.posterior_file import load_posterior
    from ..errors import CommandError
    from ..machine.geometry import load_geometry
    from ..machine.model_file import load_model

    geometry = load_geometry(args.machine)
    model = load_model(path, geometry)
    fitted, unknown = load_posterior(model, geometry, path)
    if fitted is None:
        problem = (
            f"{path} cannot be checked: {unknown}. A fit of scheme joint writes MODEL.posterior.npz beside its model"
        )
        raise CommandError("model", problem)
    return model, fitted
