"""Tool errors of a virtual machine, with and without a model, at points that the model's fit did not use."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ..formats.texts import relative_change
from ..machine.arrays import Size
from ..machine.field import CROSS_AXES
from ..machine.load import FREE, Loading
from ..machine.model import MachineModel, RealMachine
from ..machine.passes import BOTH_WAYS, Passes, random_passes
from ..machine.temperatures import Temperatures
from ..machine.trial import Trial

INCH = 0.0254


@dataclass(frozen=True)
class HeldOut:
    points: int
    raw: Size  # error vector, absolute, m
    aligned: Size  # error vector after best-fit alignment, m
    rotation: Size  # rotation minus the mean rotation, rad


def held_out(
    truth: RealMachine,
    model: MachineModel | None,
    box: np.ndarray,
    points: int = 1000,
    seed: int = 0,
    repeatability: float = 0.0,
    tilt: float = 0.0,
    sensed: Temperatures | None = None,
    level: np.ndarray | None = None,
    loading: Loading = FREE,
) -> HeldOut:
    """Return tool errors at random points of `box` (2, 3), m in work; the tool passes each point in both directions.

    The strut commands are those of `model` at the temperatures `sensed` and the load `loading`, or nominal lengths if
    `model` is None.
    """
    rng = np.random.default_rng(seed)
    trial = Trial(truth, random_passes(truth.geometry, box, points, tilt, rng, level))
    errors = trial.errors(trial.commands(model, sensed, loading))
    errors = replace(errors, displacement=rng.normal(errors.displacement, repeatability))
    aligned = errors.aligned()
    return HeldOut(points, Size.of(errors.displacement), Size.of(aligned.displacement), Size.of(aligned.rotation))


@dataclass(frozen=True)
class PaperMetric:
    """The metric of Mou & King (1998), the mean absolute displacement error along lines, without and with a model."""

    before: float  # m
    after: float  # m
    lines: int
    readings: int


def paper_metric(
    truth: RealMachine,
    model: MachineModel,
    box: np.ndarray,
    step: float = INCH,
    lines: int = 20,
    seed: int = 0,
    sensed: Temperatures | None = None,
    level: np.ndarray | None = None,
) -> PaperMetric:
    """Return the metric of Mou & King on `lines` random lines along each axis of the box, a point every `step`, m."""
    rng, level, box = np.random.default_rng(seed), np.eye(3) if level is None else level, np.asarray(box, dtype=float)
    errors: list[list[np.ndarray]] = [[], []]
    for axis in range(3):
        between = np.arange(box[0, axis] + 0.5 * step, box[1, axis], step)
        along = np.concatenate([box[:1, axis], between, between[::-1]])  # the zero, then forward and backward
        across = list(CROSS_AXES[axis])
        places = np.empty((lines, len(along), 3))
        places[..., axis] = along
        places[..., across] = rng.uniform(box[0, across], box[1, across], (lines, 2))[:, None]
        ways = np.zeros_like(places)
        ways[..., axis] = np.where(np.arange(len(along)) <= len(between), *BOTH_WAYS)
        rotations = np.broadcast_to(level, (lines * len(along), 3, 3))
        passes = Passes.of_tool(truth.geometry, places.reshape(-1, 3), rotations, ways.reshape(-1, 3))
        trial = Trial(truth, passes)
        for readings, applied in zip(errors, (None, model), strict=True):
            displacement = trial.errors(trial.commands(applied, sensed)).displacement
            read = displacement.reshape(lines, -1, 3) @ passes.directions[0]
            readings.append((read[:, 1:] - read[:, :1]).ravel())
    before, after = (np.abs(np.concatenate(readings)) for readings in errors)
    return PaperMetric(float(before.mean()), float(after.mean()), 3 * lines, len(before))


@dataclass(frozen=True)
class ModelEvaluation:
    before: HeldOut  # without the model
    after: HeldOut  # with the model
    paper: PaperMetric
    promised: tuple[float, float] | None = None  # 95 % interval of `after.aligned.rms`, predicted by the fit, m

    @property
    def kept(self) -> bool | None:
        """Whether the predicted interval contains the error with the model; None if no interval was predicted."""
        return None if self.promised is None else self.promised[0] <= self.after.aligned.rms <= self.promised[1]


def evaluate_model(
    truth: RealMachine,
    model: MachineModel,
    box: np.ndarray,
    seed: int = 0,
    repeatability: float = 0.0,
    level: np.ndarray | None = None,
) -> ModelEvaluation:
    """Return tool errors of a virtual machine without and with a model; only `paper` leaves out `repeatability`, m."""
    before, after = (held_out(truth, one, box, 1000, seed, repeatability, level=level) for one in (None, model))
    return ModelEvaluation(before, after, paper_metric(truth, model, box, seed=seed, level=level))


def evaluation_text(evaluation: ModelEvaluation) -> str:
    before, after, paper = evaluation.before, evaluation.after, evaluation.paper
    first, last = before.aligned, after.aligned
    compared = {
        f"metric of Mou & King, mean |displacement error| along {paper.lines} lines": (paper.before, paper.after, "µm"),
        "error vector in space, RMS, after best-fit alignment": (first.rms, last.rms, "µm"),
        "error vector in space, largest, after best-fit alignment": (first.largest, last.largest, "µm"),
        "error vector in space, RMS, absolute": (before.raw.rms, after.raw.rms, "µm"),
        "rotation, RMS, after best-fit alignment": (before.rotation.rms, after.rotation.rms, "µrad"),
    }
    lines = [f"On the virtual machine, without → with the model, at {after.points} points in both directions:"]
    for name, (without, left, unit) in compared.items():
        removed = f" ({relative_change(without, left)})" if without > 0.0 else ""
        lines.append(f"  {name}: {without * 1e6:.2f} → {left * 1e6:.2f} {unit}{removed}")
    if evaluation.promised is not None:
        low, high = (f"{end * 1e6:.2f}" for end in evaluation.promised)
        where = "contains this error" if evaluation.kept else "DOES NOT CONTAIN this error"
        lines.insert(3, f"  the interval predicted by the fit, {low} to {high} µm (95 %), {where}")
    return "\n".join(lines)


def evaluation_json(evaluation: ModelEvaluation) -> dict[str, Any]:
    error = {
        name: {
            "points": one.points,
            "rms_m": one.raw.rms,
            "aligned_rms_m": one.aligned.rms,
            "aligned_max_m": one.aligned.largest,
            "rotation_rms_rad": one.rotation.rms,
        }
        for name, one in (("error_without", evaluation.before), ("error_with", evaluation.after))
    }
    along = {"without_m": evaluation.paper.before, "with_m": evaluation.paper.after, "lines": evaluation.paper.lines}
    promised = {"promised_m": evaluation.promised, "kept": evaluation.kept}
    return {**error, **promised, "mean_displacement_error_along_lines": along}


Worth, worth = ModelEvaluation, evaluate_model  # former names, kept for one version
