"""Small virtual campaigns for the calibration tests, and the tool error that a model leaves on the machine itself.

The box is the paper's, but lines are 8 inches apart and have a reading every 2 inches, so that a fit takes a second.
"""

from __future__ import annotations

import json
import os
import re
from collections.abc import Sequence
from dataclasses import fields, replace
from functools import cache
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
from helpers import assert_same_text
from matplotlib.figure import Figure

from hexapod_comp.calibration import fit
from hexapod_comp.calibration.estimator import DesignMatrix, Estimation, LinearProblem
from hexapod_comp.calibration.evaluation import held_out
from hexapod_comp.calibration.lead import ScrewLead
from hexapod_comp.calibration.parameters import FitSettings, ParameterSpace
from hexapod_comp.calibration.posterior import FittedParameters
from hexapod_comp.calibration.posterior_file import save_with_posterior
from hexapod_comp.formats.json import json_text
from hexapod_comp.formats.paths import config_file
from hexapod_comp.machine.geometry import HexapodGeometry, load_geometry
from hexapod_comp.machine.model import MachineModel, RealMachine
from hexapod_comp.measurements.campaign import Campaign, template
from hexapod_comp.measurements.readings import AXES, FROM_PREVIOUS, KINDS, FileLine, MeasurementSet, Reading, Stations
from hexapod_comp.measurements.runs import assemble
from hexapod_comp.pose import Pose
from hexapod_comp.virtual.imperfections import ImperfectionBounds, draw_model
from hexapod_comp.virtual.instruments import measure

INCH = 0.0254
BOX = np.array([[-0.2032, -0.2032, 0.35], [0.2032, 0.2032, 0.5532]])
LEAD = 0.01

# Errors of machine B of benchmarks.calibration
BOUNDS = ImperfectionBounds(joint=1e-4, strut_offset=1e-4, pitch=1e-4, wave=(4e-6, 4e-6), backlash=(3e-6, 5e-6))

SETTINGS = FitSettings(lead=LEAD, field_degree=3)  # All blocks, with a small field

FEW = replace(SETTINGS, blocks=("pitch", "wave", "backlash"))  # The blocks of machine B

NEUTRAL = (20.0,) * 8  # Temperatures without growth, °C

REPORTS = Path(__file__).parent / "calibration" / "reports"


def brief(value):
    """Return JSON with numbers of three digits, and without the fourth and further entries of lists."""
    if isinstance(value, dict):
        return {key: brief(one) for key, one in value.items()}
    if isinstance(value, list):
        return [brief(one) for one in value[:3]]
    return f"{value if abs(value) > 1e-15 else 0.0:.3g}" if isinstance(value, float) else value


def described(figure: Figure) -> str:
    """Return the words of a figure, and of each curve, histogram or map the range and the mean of its numbers."""

    def numbers(values) -> str:
        values = np.ma.masked_invalid(values).compressed()
        sums = np.array([values.min(), values.max(), values.mean()])
        least, greatest, mean = np.where(np.abs(sums) > 1e-9 * np.abs(values).max(), sums, 0.0)
        return f"{least:.4g} {greatest:.4g} {mean:.4g} of {values.size}"

    lines = [f"{figure.get_suptitle()!r} {len(figure.axes)} panels"]
    for axes in figure.axes:
        lines.append(f"{axes.get_title()!r} {axes.get_xlabel()!r} {axes.get_ylabel()!r}")
        lines += [f" line {n.get_label()}: {numbers(n.get_xdata())}; {numbers(n.get_ydata())}" for n in axes.lines]
        lines += [f" patch {n.get_label()}: {numbers(n.get_path().vertices)}" for n in axes.patches]
        lines += [f" map: {numbers(n.get_array())}" for n in axes.collections if n.get_array() is not None]
    return "\n".join(lines) + "\n"


def recorded(name: str) -> str:
    """Return an expected text that was written by hand."""
    return (REPORTS / f"{name}.txt").read_text(encoding="utf-8")


def assert_recorded(name: str, result: object) -> None:
    """Compare a report, or in brief a result for JSON, with its file: the same words, and all numbers but for rounding.

    ``RENEW_REPORTS=1`` writes the file; ``git diff`` then shows every change.
    """
    path = REPORTS / f"{name}{'.txt' if isinstance(result, str) else '.json'}"
    if isinstance(result, str):
        text = result
    else:
        parts = brief(json.loads(json_text(result))).items()
        text = "".join(f"{key}: {json.dumps(part, ensure_ascii=False)}\n" for key, part in parts)
    if os.environ.get("RENEW_REPORTS"):
        path.write_text(text, encoding="utf-8")
    # The width of a column changes with the numbers in it
    assert_same_text(*(re.sub(" +", " ", one) for one in (text, path.read_text(encoding="utf-8"))))


@cache
def paper() -> HexapodGeometry:
    """Return the paper's machine."""
    return load_geometry(config_file("paper.yaml"))


def framed(geometry: HexapodGeometry) -> HexapodGeometry:
    """Return a machine with a displaced and turned tool, and a displaced and turned work frame."""
    tool = Pose.from_angles([0.03, -0.02, 0.08], [0.2, -0.1, 0.3])
    return replace(geometry, tool=tool, work=Pose.from_angles([0.1, 0.2, 0.0], [0.05, 0.1, -0.7]))


@cache
def campaign(instrument: str | None = "5-D", diagonals: int = 4, **options) -> Campaign:
    """Return a coarse campaign on the paper's box."""
    return Campaign(BOX, 8.0 * INCH, 2.0 * INCH, instrument, diagonals, **options)


def virtual_machine(seed: int, bounds: ImperfectionBounds = BOUNDS) -> RealMachine:
    """Return a machine whose errors are drawn within bounds."""
    return RealMachine(paper(), draw_model(paper(), bounds, seed))


BLANK: dict[int, tuple[Campaign, MeasurementSet]] = {}


def blank(plan: Campaign) -> MeasurementSet:
    """Return a plan's readings on the paper's machine, without values; each plan is laid out only once."""
    if id(plan) not in BLANK:
        BLANK[id(plan)] = plan, template(plan, paper())  # the plan is kept, so no other plan gets its id
    return BLANK[id(plan)][1]


def measured(truth: RealMachine, plan: Campaign, seed: int) -> MeasurementSet:
    """Return the readings of a plan's instruments on a machine."""
    return measure(blank(plan) if truth.geometry is paper() else template(plan, truth.geometry), plan, truth, seed)


def joined(sets: Sequence[MeasurementSet]) -> MeasurementSet:
    """Return several sets of one machine and one measured point as one set. Runs of equal names remain separate."""
    lists = {name: sum((getattr(s, name) for s in sets), ()) for name in ("runs", "sources", "files", "notes")}
    names = "cycle", "direction", "channel", "value", "uncertainty", "centre"
    arrays = {name: np.concatenate([getattr(s, name) for s in sets]) for name in names}
    before = np.cumsum([(0, 0), *((len(s.stations), len(s.runs)) for s in sets)], axis=0)
    arrays["station"] = np.concatenate([s.station + n for s, (n, _) in zip(sets, before, strict=False)])
    arrays["run"] = np.concatenate([s.run + n for s, (_, n) in zip(sets, before, strict=False)])
    columns = (np.concatenate([getattr(s.stations, column.name) for s in sets]) for column in fields(Stations))
    return replace(sets[0], stations=Stations(*columns), **lists, **arrays)


def linearised(measurements: MeasurementSet, settings: FitSettings = FEW) -> tuple[ParameterSpace, LinearProblem]:
    """Return the parameter space and linear problem of readings on the nominal machine."""
    space = ParameterSpace(measurements, settings)
    return space, Estimation(measurements, space).linearise(np.zeros(space.size), np.ones(len(measurements)))[0]


def problem_of(rows: np.ndarray, target: np.ndarray, kind: np.ndarray, fold: np.ndarray) -> LinearProblem:
    """Return a linear problem in which every cell is one reading and nothing is projected out."""
    parts = [np.flatnonzero(kind == k) for k in range(len(KINDS))]
    return LinearProblem(
        target=target,
        rows=DesignMatrix.of(rows),
        kind=kind,
        fold=fold,
        square=np.array([target[p] @ target[p] for p in parts]),
        freedom=np.array([float(len(p)) for p in parts]),
        least_noise=np.zeros(len(KINDS)),
    )


class Fitted(NamedTuple):
    """A machine's true model, the fitted model, and the fitted parameters."""

    truth: MachineModel
    model: MachineModel
    known: FittedParameters


def search_nothing(patch: pytest.MonkeyPatch) -> None:
    """Let fits search neither for mix-ups nor for a lead that is given: both together take half of a fit's time."""
    search = fit.detect_lead

    def given(everything: Estimation, problem: LinearProblem) -> ScrewLead:
        lead = everything.space.settings.lead
        return search(everything, problem) if lead is None else ScrewLead(lead, None, np.inf, 0.0)

    patch.setattr(fit, "detect_lead", given)
    patch.setattr(fit, "mixups", lambda *_: [])


@cache
def fitted(poses: int = 0) -> Fitted:
    """Return a machine and its fit to 5-D lines, four diagonals and a number of a tracker's poses."""
    truth = virtual_machine(5)
    with pytest.MonkeyPatch.context() as patch:
        search_nothing(patch)
        found = fit.fit_model(measured(truth, campaign(poses=poses, tilt=np.radians(10.0)), 5), FEW)
    return Fitted(truth.model, found.model, found.parameters)


def tool_error(truth: RealMachine, model: MachineModel | None) -> tuple[float, float]:
    """Return the RMS tool error after best-fit alignment, m and rad, that a model leaves on the machine itself."""
    found = held_out(truth, model, BOX, 300, seed=5)
    return found.aligned.rms, found.rotation.rms


def scattered(
    geometry: HexapodGeometry,
    poses: Sequence[Pose],
    temperatures: Sequence[tuple[float, ...]] | None = None,
    probe: np.ndarray | None = None,
) -> MeasurementSet:
    """Return absolute readings, all zero, at poses that the machine took in this order."""
    temperatures = temperatures or [NEUTRAL] * len(poses)
    readings = [
        Reading("poses", 1, FROM_PREVIOUS, pose, f"{kind}_{axis}", 0.0, temperatures=warmth, source=FileLine("test", n))
        for n, (pose, warmth) in enumerate(zip(poses, temperatures, strict=True))
        for kind in ("position", "attitude")
        for axis in AXES
    ]
    return assemble(geometry, readings, probe)


def fitted_model(folder: Path, offset: float = 30e-6, probe: np.ndarray | None = None) -> Path:
    """Write a model whose struts are all too long by `offset`, m; its parameters have standard deviations of 2 µm."""
    grid = np.stack(np.meshgrid([-0.1, 0.1], [-0.1, 0.1], [0.38, 0.45]), axis=-1).reshape(-1, 3)
    readings = scattered(paper(), [Pose(p, np.eye(3)) for p in grid], probe=probe)
    space = ParameterSpace(readings, FitSettings(blocks=()))
    x = np.zeros(space.size)
    x[-6:] = offset
    model = space.model(x, "fitted")
    model = replace(model, origin=replace(model.origin, date="2026-01-31"))
    covariance = 2e-6**2 * np.eye(space.size)
    save_with_posterior(
        model, FittedParameters(space, x, covariance, np.ones(1), np.ones(len(KINDS))), folder / "fitted.yaml"
    )
    return folder / "fitted.yaml"
