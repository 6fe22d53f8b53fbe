"""A machine measured cold and while it warms by 3 K, its expansions and time constants fitted, and another day's drift.

One power warms all parts, each through a first-order lag of its own: struts to 3 K with 25 minutes, base to 2 K with
90, platform to 2.5 K with 50; each strut differs from that by 10 % in both, so no two time constants describe them all.
Expansions are drawn around those of steel. The shop measures the machine cold, then an x, a y and a z line once more
every ten minutes for three hours from switching on, each time zeroed anew. Its sensors of 0.05 K read once a second
and are filtered as the compensator does it: one on every part, or one in the base. The fit is told no expansion.

Judged is another day: power on for an hour, off for forty minutes, and on again; how far the drift brings the tool at
held-out points from where the same model brings it at 20 °C, as it is in space, against no compensation of heat.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from benchmarks.calibration import CONFIG, LARGE, LEAD
from hexapod_comp.calibration.fit import ModelFit, fit_model
from hexapod_comp.calibration.parameters import FitSettings
from hexapod_comp.machine.geometry import HexapodGeometry, load_geometry
from hexapod_comp.machine.late import PARTS
from hexapod_comp.machine.model import MachineModel, RealMachine
from hexapod_comp.machine.passes import Passes, random_passes
from hexapod_comp.machine.temperatures import Temperatures
from hexapod_comp.measurements.campaign import Campaign, template
from hexapod_comp.measurements.readings import MeasurementSet
from hexapod_comp.virtual.imperfections import draw_model
from hexapod_comp.virtual.trial import Trial
from hexapod_comp.virtual.warm_up import WarmUp

BOX = np.array([[-0.2032, -0.2032, 0.35], [0.2032, 0.2032, 0.5532]])
INCH = 0.0254

RISE = np.array([3.0] * 6 + [2.0, 2.5])
TAU = np.array([1500.0] * 6 + [5400.0, 3000.0])
APART = 0.1
"""How much each strut differs in rise and time constant (standard deviation)."""

STEEL, SPREAD = 11.5e-6, 1e-6
"""Mean expansion, and standard deviation between struts together, base and platform, 1/K; between struts a fifth."""

SENSORS = {"a sensor on each part": ("", 0.95), "one sensor in the base": ("base", 0.85)}
"""Which thermometer stands for all, and the bar: share of the drift removed."""

DAY, OFF = 9000, (3600, 6000)
"""Length of the judged day, s, and from when to when the power is off."""

MOMENTS = 30


@dataclass(frozen=True)
class Truth:
    """A machine and how its parts warm."""

    model: MachineModel
    warm_up: WarmUp

    @staticmethod
    def drawn(geometry: HexapodGeometry, thermometer: str, noise: float, seed: int) -> Truth:
        """Return the machine of a seed, with a thermometer in one part, or in each where that is empty."""
        rng = np.random.default_rng([seed, 16])
        struts, base, platform = STEEL + SPREAD * rng.standard_normal(3)
        model = draw_model(geometry, LARGE, seed)
        expansion = struts + 0.2 * SPREAD * rng.standard_normal(6)
        model = replace(model, struts=replace(model.struts, expansion=expansion))
        apart = 1.0 + APART * np.concatenate([rng.standard_normal((6, 2)), np.zeros((2, 2))])
        rise, time_constants = np.append(RISE * apart[:, 0], 0.0), np.append(TAU * apart[:, 1], 1.0)
        sensors = (thermometer,) if thermometer else PARTS
        warm_up = WarmUp(rise, time_constants, sensors=sensors, noise=(noise, 0.0), cold_rounds=0)
        return Truth(replace(model, base_expansion=base, platform_expansion=platform), warm_up)


def readings_of(truth: Truth, geometry: HexapodGeometry, seed: int) -> MeasurementSet:
    """Return what the shop measures: cold at 20 °C before switching on, then warming."""
    campaign = truth.warm_up.campaign(Campaign(BOX, 8.0 * INCH, 2.0 * INCH, "5-D", 4))
    return truth.warm_up.measured(template(campaign, geometry), campaign, RealMachine(geometry, truth.model), seed)


def judge(truth: Truth, fit: ModelFit, points: int, seed: int) -> tuple[float, float]:
    """Return mean squares, m², of the tool's displacement by another day's drift, without and with compensation."""
    geometry, rng = fit.measurements.geometry, np.random.default_rng([seed, 18])
    passes = random_passes(geometry, BOX, points, 0.0, rng)
    true = truth.warm_up.course(DAY, OFF)
    sensed, heard = truth.warm_up.sensed(true, rng), Temperatures()
    cold = _tool(RealMachine(geometry, truth.model), passes, fit.model, None)
    moments = np.linspace(0, DAY, MOMENTS + 1)[1:].astype(int)
    groups = np.array_split(np.arange(points), MOMENTS)
    squares: list[list[np.ndarray]] = [[], []]
    at = 0
    for second, row in enumerate(sensed):
        for name in truth.warm_up.sensors:
            heard.follow(name, row[PARTS.index(name)], float(second), fit.model.late_growth.time_constants)
        if at < MOMENTS and second == moments[at]:
            group = np.concatenate([groups[at], groups[at] + points])
            warm = RealMachine(
                geometry, truth.model, Temperatures(dict(zip(PARTS, true[second, : len(PARTS)], strict=True)))
            )
            for kept, believed in zip(squares, (None, heard), strict=True):
                moved = _tool(warm, passes.select(group), fit.model, believed) - cold[group]
                kept.append((moved**2).sum(axis=1))
            at += 1
    blind, compensated = (float(np.concatenate(kept).mean()) for kept in squares)
    return blind, compensated


def _tool(truth: RealMachine, passes: Passes, model: MachineModel, sensed: Temperatures | None) -> np.ndarray:
    """Return where the tool goes, shape (N, 3), m in ``base``."""
    trial = Trial(truth, passes)
    errors = trial.errors(trial.commands(model, sensed))
    return errors.points + errors.displacement


def fitted_machine(
    sensors: str, seed: int, points: int, noise: float, say: Callable[[str], object] = lambda text: None
) -> tuple[float, float, ModelFit]:
    """Measure, fit and judge one machine; return mean squares, m², without and with compensation, and the fit."""
    geometry, (thermometer, _) = load_geometry(CONFIG / "paper.yaml"), SENSORS[sensors]
    truth = Truth.drawn(geometry, thermometer, noise, seed)
    measured = readings_of(truth, geometry, seed)
    fit = fit_model(measured, FitSettings(lead=LEAD, blocks=("pitch", "wave", "backlash", "expansion", "late")), say)
    return (*judge(truth, fit, points, seed), fit)


@dataclass(frozen=True)
class FittedRow:
    """RMS displacement of the tool by a day's drift, µm, without and with what was fitted, and the shares removed."""

    sensors: str
    machines: int
    blind: float
    compensated: float
    removed: float
    least_removed: float
    bar: float
    met: bool


FITTED_HEADER = (
    "| expansion fitted; another day's drift of 3 K | blind, µm | compensated, µm | removed | least | bar |\n"
    "|---|---:|---:|---:|---:|---|"
)


def fitted_row(sensors: str, squares: np.ndarray) -> FittedRow:
    """Return the row of mean squares, m², shape (machine, 2)."""
    blind, compensated = 1e6 * np.sqrt(squares.mean(axis=0))
    least, bar = 1.0 - np.sqrt(squares[:, 1] / squares[:, 0]).max(), SENSORS[sensors][1]
    removed = 1.0 - compensated / blind
    sizes = (float(blind), float(compensated), float(removed), float(least))
    return FittedRow(sensors, len(squares), *sizes, bar, bool(removed >= bar))


def fitted_shown(row: FittedRow) -> str:
    """Return a row of the table."""
    return (
        f"| {row.sensors} | {row.blind:.2f} | {row.compensated:.3f} | {100.0 * row.removed:.1f} % "
        f"| {100.0 * row.least_removed:.1f} % | {100.0 * row.bar:.0f} % {'met' if row.met else 'MISSED'} |"
    )
