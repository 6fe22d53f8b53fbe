"""``hexapod_comp verify``: does a model still hold, by a few check readings?"""

from __future__ import annotations

import argparse
import os
from dataclasses import dataclass
from typing import TYPE_CHECKING

from . import common

if TYPE_CHECKING:
    from ..calibration.posterior import FittedParameters
    from ..calibration.verification import Verification
    from ..machine.model import MachineModel
    from ..measurements.readings import MeasurementSet


def run(args: argparse.Namespace) -> int:
    """Run the verb; 1 when the machine has changed."""
    from ..calibration.verification import VALID
    from ..calibration.verification_report import verification_json, verification_report

    result = checked(args, args.model).verification
    common.show(verification_json(result) if args.json else verification_report(result))
    return 0 if result.verdict == VALID else 1


@dataclass(frozen=True)
class Checked:
    """A model with what its fit knows, and readings that check it."""

    model: MachineModel
    fitted: FittedParameters
    measured: MeasurementSet
    verification: Verification


def checked(args: argparse.Namespace, path: str) -> Checked:
    """Return a model beside the check readings that the options name.

    Raises
    ------
    CommandError
        It is not known how well the model's parameters are known.
    """
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # as for fit
    import numpy as np

    from ..calibration.posterior import load_posterior
    from ..calibration.verification import verify_model
    from ..errors import CommandError
    from ..machine.geometry import load_geometry
    from ..machine.model_file import load_model
    from ..measurements.files import read_measurements
    from ..virtual.instruments import compensated

    geometry = load_geometry(args.machine)
    model = load_model(path, geometry)
    fitted, unknown = load_posterior(model, geometry, path)
    if fitted is None:
        problem = (
            f"{path} cannot be checked: {unknown}. A fit of scheme joint writes MODEL.posterior.npz beside its model"
        )
        raise CommandError("model", problem)
    probe = args.probe_mm
    if probe is None and not np.allclose(fitted.space.probe, geometry.tool.position, rtol=0.0, atol=1e-12):
        probe = fitted.space.probe  # as the fit was told
    with common.stage("reading measurements"):
        measured = read_measurements(args.files, geometry, args.columns, probe)
    common.mention_compiling("model.actual_pose_one")
    if args.compensated:
        measured = compensated(measured, model)
    with common.stage("weighing what may have happened"):
        verification = verify_model(model, fitted, measured)
    return Checked(model, fitted, measured, verification)
