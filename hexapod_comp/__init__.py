"""Error compensation for hexapod machine tools.

>>> import numpy as np
>>> import hexapod_comp as hc
>>> geometry = hc.load_geometry("paper")
>>> compensator = hc.Compensator(geometry, hc.load_model("paper_machine", geometry))
>>> pose = hc.Pose.from_angles([0.0, 0.0, 0.4], np.radians([0.0, 0.0, 5.0]))
>>> microns = compensator.correct(pose).correction * 1e6

``__all__`` lists the public names; each is imported at its first use. All quantities are in SI units (m, rad, s), and
temperatures in °C. A pose is the tool's pose in the work frame, unless a parameter is called
``pose_platform_in_base``. Every invalid value raises a :class:`HexapodError`; an argument of a wrong type, such as a
list in place of a :class:`Pose`, raises one of Python's own errors.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from .calibration.check import Verification as Verification
    from .calibration.check import update_model as update_model
    from .calibration.check import verify_model as verify_model
    from .calibration.fit import ModelFit as ModelFit
    from .calibration.fit import fit_model as fit_model
    from .calibration.parameters import FitSettings as FitSettings
    from .calibration.posterior_file import load_posterior as load_posterior
    from .calibration.report import fit_report as fit_report
    from .compensation.checks import CheckResult as CheckResult
    from .compensation.checks import check as check
    from .compensation.compensator import Compensator as Compensator
    from .compensation.compensator import Correction as Correction
    from .errors import HexapodError as HexapodError
    from .formats.json import json_text as json_text
    from .machine.geometry import HexapodGeometry as HexapodGeometry
    from .machine.geometry import load_geometry as load_geometry
    from .machine.kinematics import jacobian as jacobian
    from .machine.kinematics import solve_pose as solve_pose
    from .machine.kinematics import strut_lengths as strut_lengths
    from .machine.limits import Limits as Limits
    from .machine.model import MachineModel as MachineModel
    from .machine.model import RealMachine as RealMachine
    from .machine.model import Temperatures as Temperatures
    from .machine.model_file import load_model as load_model
    from .machine.model_file import save_model as save_model
    from .machine.outside import OutsideTable as OutsideTable
    from .machine.outside import load_outside as load_outside
    from .machine.path import Motion as Motion
    from .machine.path import StrutRates as StrutRates
    from .machine.path import plan_motion as plan_motion
    from .machine.path import plan_program as plan_program
    from .machine.pose_files import read_poses as read_poses
    from .measurements.files import read_measurements as read_measurements
    from .measurements.readings import MeasurementSet as MeasurementSet
    from .pose import Pose as Pose
    from .replay.bag import Recording as Recording
    from .replay.bag import read_recording as read_recording
    from .replay.replay import Replay as Replay
    from .replay.replay import replay_recording as replay_recording
    from .workspace.budget import Budget as Budget
    from .workspace.budget import load_budget as load_budget
    from .workspace.study import Study as Study
    from .workspace.study import classify as classify

    __version__: str

_HOMES = {
    "calibration.fit": ("ModelFit", "fit_model"),
    "calibration.parameters": ("FitSettings",),
    "calibration.posterior_file": ("load_posterior",),
    "calibration.report": ("fit_report",),
    "calibration.check": ("Verification", "update_model", "verify_model"),
    "compensation.checks": ("CheckResult", "check"),
    "compensation.compensator": ("Compensator", "Correction"),
    "errors": ("HexapodError",),
    "formats.json": ("json_text",),
    "machine.geometry": ("HexapodGeometry", "load_geometry"),
    "machine.kinematics": ("jacobian", "solve_pose", "strut_lengths"),
    "machine.limits": ("Limits",),
    "machine.model": ("MachineModel", "RealMachine", "Temperatures"),
    "machine.model_file": ("load_model", "save_model"),
    "machine.outside": ("OutsideTable", "load_outside"),
    "machine.path": ("Motion", "StrutRates", "plan_motion", "plan_program"),
    "machine.pose_files": ("read_poses",),
    "measurements.files": ("read_measurements",),
    "measurements.readings": ("MeasurementSet",),
    "pose": ("Pose",),
    "replay.bag": ("Recording", "read_recording"),
    "replay.replay": ("Replay", "replay_recording"),
    "workspace.budget": ("Budget", "load_budget"),
    "workspace.study": ("Study", "classify"),
}
_HOME_OF = {name: home for home, names in _HOMES.items() for name in names}

__all__ = ["__version__", *sorted(_HOME_OF)]


def __getattr__(name: str) -> object:
    """Import a public name at its first use, so that ``hexapod_comp --help`` need not import NumPy."""
    if name == "__version__":
        from .formats.paths import version

        value: object = version()
    elif name in _HOME_OF:
        value = getattr(import_module(f"{__name__}.{_HOME_OF[name]}"), name)
    else:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
