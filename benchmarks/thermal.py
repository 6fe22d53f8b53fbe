"""Thermal compensation of machines that warm up, with noisy temperature sensors.

Usage: python -m benchmarks.thermal [--only stated|fitted|pulls|fused] [--machines 20] [--points 1000]

Drifts, parts and targets: doc/benchmarks.md. Errors are absolute: a best-fit alignment would hide the datum's drift.
Exit code 1: a target is missed.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from scipy.spatial.transform import Rotation
from tqdm import tqdm

from benchmarks import drawn
from benchmarks.calibration import LARGE, LEAD
from benchmarks.promise import KNOWN, carelessness, hidden_of, truth_of
from hexapod_comp.calibration.fit import fit_model
from hexapod_comp.calibration.parameters import FitSettings
from hexapod_comp.calibration.thermal import MEMBERS, SEEN_SHARE
from hexapod_comp.compensation.compensator import Compensator
from hexapod_comp.compensation.fusion import Fusion, FusionRules, PoseReading
from hexapod_comp.compensation.thermal import DEFAULT_TIME_CONSTANT, TemperatureFilter
from hexapod_comp.errors import CalibrationError, HexapodError
from hexapod_comp.machine.geometry import STRUT_NAMES, HexapodGeometry, load_geometry
from hexapod_comp.machine.model import MachineModel, RealMachine
from hexapod_comp.machine.passes import Passes, random_passes
from hexapod_comp.machine.temperatures import PARTS, REFERENCE_TEMPERATURE, STEEL, Temperatures
from hexapod_comp.machine.trial import Trial
from hexapod_comp.measurements.campaign import Campaign, load_campaign, template
from hexapod_comp.pose import Pose
from hexapod_comp.virtual.imperfections import draw_model
from hexapod_comp.virtual.instruments import measure
from hexapod_comp.virtual.warm_up import SENSED, WarmUp

SENSOR_NOISE = 0.05  # 1 σ of a sensor reading, K
SPREAD = 1e-6  # expansion, 1/K: 1 σ common to all struts, of base, platform (of one strut: a fifth)


def tool_at(truth: RealMachine, passes: Passes, model: MachineModel, sensed: Temperatures | None) -> np.ndarray:
    """Return the tool's real positions with a model's compensation, shape (N, 3), m in ``base``."""
    trial = Trial(truth, passes)
    errors = trial.errors(trial.commands(model, sensed))
    return errors.points + errors.displacement


def of_steel(model: MachineModel, seed: int, moisture: float = 0.0) -> MachineModel:
    """Return a machine whose parts expand like slightly different steels, and whose struts swell by `moisture`."""
    rng = np.random.default_rng([seed, 16])
    struts, base, platform = STEEL + SPREAD * rng.standard_normal(3)
    expansion = struts + 0.2 * SPREAD * rng.standard_normal(6)
    grown = replace(model.struts, expansion=expansion, moisture=np.full(6, moisture))
    return replace(model, struts=grown, base_expansion=float(base), platform_expansion=float(platform))


def removed(squares: Sequence[np.ndarray], target: float) -> tuple[list[str], bool]:
    """Return cells (removed share of the error, the worst machine's share, target), and whether the target is met.

    `squares` are the machines' mean squared errors without, then with compensation.
    """
    blind, left = map(np.asarray, squares)
    share = 1.0 - np.sqrt(left.mean() / blind.mean())
    met = bool(share >= target)
    return [f"{share:.1%}", f"{1.0 - np.sqrt(left / blind).max():.1%}", drawn.verdict(target, met)], met


def um(squares: np.ndarray) -> float:
    return 1e6 * float(np.sqrt(squares.mean()))


# ---- stated expansions ----

HALF_HOUR = 1800  # duration of the warm-up, and of the warm phase after it, s
MOMENTS = 40  # moments, evenly spaced over a phase; at each of them a group of the points is evaluated
STATED_TARGET = 0.95  # target: removed share of the drift
PHASES = ("warming", "warm")

# Parts that warm up, and a function for their final rises of temperature, K
DRIFTS: dict[str, tuple[tuple[str, ...], Callable[[np.random.Generator, int], np.ndarray]]] = {
    "struts together, +1 K": (STRUT_NAMES, lambda _, count: np.ones(count)),
    "struts apart, N(0, 1 K)": (STRUT_NAMES, lambda rng, count: rng.standard_normal(count)),
    "struts, base, platform apart, N(0, 1 K)": (Temperatures.NAMES, lambda rng, count: rng.standard_normal(count)),
}


def one_stated(drift: str, seed: int, args: argparse.Namespace) -> np.ndarray:
    """Return the mean squares, m², of the tool's drift: without compensation, with unfiltered and filtered sensors.

    The shape is (phase, compensation).
    """
    geometry, rng, (parts, final) = load_geometry("paper"), np.random.default_rng(seed), DRIFTS[drift]
    model = draw_model(geometry, LARGE, seed)
    struts = replace(model.struts, expansion=np.full(6, STEEL))
    model = replace(model, struts=struts, base_expansion=STEEL, platform_expansion=STEEL)
    passes = random_passes(geometry, load_campaign("campaign_5d.yaml").box, args.points, 0.0, rng)
    cold = tool_at(RealMachine(geometry, model), passes, model, None)
    warmth = np.minimum(np.arange(2 * HALF_HOUR + 1) / HALF_HOUR, 1.0)
    true = REFERENCE_TEMPERATURE + np.outer(warmth, final(rng, len(parts)))
    read = true + SENSOR_NOISE * rng.standard_normal(true.shape)
    low_pass = TemperatureFilter(DEFAULT_TIME_CONSTANT)
    filtered = [
        [low_pass.update(part, value, float(second)) for part, value in zip(parts, row, strict=True)]
        for second, row in enumerate(read)
    ]

    def temperatures(values: np.ndarray) -> Temperatures:
        return Temperatures(dict(zip(parts, values, strict=True)))

    squares = np.empty((len(PHASES), 3))
    for phase in range(len(PHASES)):
        moved = np.empty((3, *cold.shape))
        seconds = np.linspace(0, HALF_HOUR, MOMENTS + 1)[1:].astype(int) + phase * HALF_HOUR
        for part, second in zip(np.array_split(np.arange(args.points), MOMENTS), seconds, strict=True):
            group = np.concatenate([part, part + args.points])  # both directions of motion
            truth = RealMachine(geometry, model, temperatures(true[second]))
            for n, seen in enumerate((None, read, filtered)):
                sensed = None if seen is None else temperatures(seen[second])
                moved[n, group] = tool_at(truth, passes.select(group), model, sensed) - cold[group]
        squares[phase] = np.mean(np.sum(moved**2, axis=2), axis=1)
    return squares


def stated(args: argparse.Namespace) -> bool:
    """Run the part "stated" (known expansions): print a row per drift; return whether all targets are met."""
    columns = ["drift", "phase", "blind, µm", "unfiltered, µm", "removed", "filtered, µm", "removed", "least", "target"]
    found = drawn.Table(columns, texts=2)
    for drift, squares in drawn.results(partial(one_stated, args=args), [*DRIFTS], args):
        for phase, (blind, unfiltered, filtered) in zip(PHASES, np.transpose(squares, (1, 2, 0)), strict=True):
            cells, met = removed((blind, filtered), STATED_TARGET)
            less = 1.0 - um(unfiltered) / um(blind)
            sizes = [f"{um(blind):.2f}", f"{um(unfiltered):.3f}", f"{less:.1%}", f"{um(filtered):.3f}"]
            found.row(drift, phase, *sizes, *cells, met=met)
    return found.met


# ---- fitted expansions, evaluated on another day ----

INCH = 0.0254
RISE, TAU = np.array([3.0] * 6 + [2.0, 2.5]), np.array([1500.0] * 6 + [5400.0, 3000.0])  # struts, base, platform; K, s
APART = 0.1  # 1 σ of the relative differences of the struts' rises and time constants
SENSORS = {"a sensor on each part": ("", 0.95), "one sensor in the base": ("base", 0.85)}  # only sensor, and target
DAY, OFF, ON_DAY = 9000, (3600, 6000), 30  # evaluated day, s; power off, from … to, s; moments


def one_fitted(sensors: str, seed: int, args: argparse.Namespace) -> tuple[float, float]:
    """Measure and fit a machine; return the mean squares of its drift, m², without and with compensation."""
    geometry, rng, thermometer = load_geometry("paper"), np.random.default_rng([seed, 16]), SENSORS[sensors][0]
    model = of_steel(draw_model(geometry, LARGE, seed), seed)
    rng.standard_normal(9)  # of_steel has drawn these numbers for the expansions
    apart = 1.0 + APART * np.concatenate([rng.standard_normal((6, 2)), np.zeros((2, 2))])
    rise, time_constants = np.append(RISE * apart[:, 0], 0.0), np.append(TAU * apart[:, 1], 1.0)
    places = (thermometer,) if thermometer else PARTS
    warm_up = WarmUp(rise, time_constants, sensors=places, noise=(SENSOR_NOISE, 0.0), cold_rounds=0)
    campaign = warm_up.campaign(Campaign(drawn.BOX, 8.0 * INCH, 2.0 * INCH, "5-D", 4))
    readings = warm_up.measured(template(campaign, geometry), campaign, RealMachine(geometry, model), seed)
    fit = fit_model(readings, FitSettings(lead=LEAD, blocks=("pitch", "wave", "backlash", "expansion", "late")))

    rng, points = np.random.default_rng([seed, 18]), args.points
    passes = random_passes(geometry, drawn.BOX, points, 0.0, rng)
    true = warm_up.over_time(DAY, OFF)
    sensed, compensator = warm_up.sensed(true, rng), Compensator(geometry, fit.model)
    cold = tool_at(RealMachine(geometry, model), passes, fit.model, None)
    groups = dict(
        zip(np.linspace(0, DAY, ON_DAY + 1)[1:].astype(int), np.array_split(np.arange(points), ON_DAY), strict=True)
    )
    squares: tuple[list[np.ndarray], list[np.ndarray]] = ([], [])
    for second, row in enumerate(sensed):
        for name in warm_up.sensors:
            compensator.set_temperature(name, row[PARTS.index(name)], float(second))
        if second in groups:
            group = np.concatenate([groups[second], groups[second] + points])
            warm = Temperatures(dict(zip(PARTS, true[second, : len(PARTS)], strict=True)))
            truth = RealMachine(geometry, model, warm)
            for kept, believed in zip(squares, (None, compensator.temperatures), strict=True):
                moved = tool_at(truth, passes.select(group), fit.model, believed) - cold[group]
                kept.append((moved**2).sum(axis=1))
    blind, compensated = (float(np.concatenate(kept).mean()) for kept in squares)
    return blind, compensated


def fitted(args: argparse.Namespace) -> bool:
    """Run the part "fitted" (fitted expansions): print a row per set of sensors; return whether all targets are met."""
    found = drawn.Table(
        ["expansion fitted; another day's drift of 3 K", "blind, µm", "compensated, µm", "removed", "least", "target"]
    )
    for sensors, squares in drawn.results(partial(one_fitted, args=args), [*SENSORS], args):
        blind, left = np.transpose(squares)
        cells, met = removed((blind, left), SENSORS[sensors][1])
        found.row(sensors, f"{um(blind):.2f}", f"{um(left):.3f}", *cells, met=met)
    return found.met


# ---- pulls ----

GEOMETRIES = ("paper", "framed", "hanging", "inches", "mirror", "offset")
PULLED = ("B", "D", "G", "joints", "beams", "outliers")  # no parameter describes the errors of the last three
# Rounds during the warm-up, period of the rounds, s, steps along the longest line, and degree of the field
ROUNDS, EVERY, STEPS, DEGREE = 9, 1200, 6, 3
# Growth of the struts by humidity, m/m; humidity before and at the end; its time constant, s
DAMP, DRY_TO_DAMP, DAMP_TAU = (1e-4, 4e-4), (0.45, 0.65), 2400.0
LARGEST_PULL, FAR, LEAST_WITHIN = 1.3, 2.6, 0.95  # targets: RMS pull; share of pulls within FAR σ


@dataclass(frozen=True)
class Pull:
    """Pull of a physical parameter, or of the logarithm of a time constant."""

    parameter: str
    size: float  # (estimate − truth) / standard deviation
    determined: bool  # whether the report calls the parameter determined


def pulls_of(kind: str, thermometer: str, seed: int) -> list[Pull]:
    """Fit a foreign machine with a field of degree DEGREE, and compare its parameters with the true ones."""
    (geometry, machine), damp = drawn.of_zoo(GEOMETRIES[seed % len(GEOMETRIES)]), bool(seed // 2 % 2)
    moisture = np.random.default_rng([seed, 16])
    moisture.standard_normal(9)  # of_steel draws these numbers for the expansions
    model = truth_of(geometry, kind, machine.box, seed)
    model = of_steel(model, seed, moisture.uniform(*DAMP) if damp else 0.0)
    warm = zoo_warm_up(thermometer, damp, seed)
    sides, truth = np.ptp(machine.box, axis=0), RealMachine(geometry, model)
    plan = Campaign(machine.box, min(sides.max() / 2.0, sides.min()), sides.max() / STEPS, "5-D", 4)
    campaign, hidden = warm.campaign(plan), hidden_of(geometry, kind, np.random.default_rng([seed, 5]))
    empty = template(campaign, geometry)
    true_stations, read_stations = warm.stations(empty, seed)
    lengths = hidden.lengths((true_stations.positions, true_stations.rotations), true_stations.sense)
    true_stations = replace(true_stations, commands=true_stations.commands + lengths)
    empty, real = replace(empty, stations=read_stations), replace(empty, stations=true_stations)
    values = measure(real, campaign, truth, seed).value + carelessness(empty, real, truth, kind, seed)
    readings = empty.with_values(values)
    settings = FitSettings(blocks=KNOWN, lead=LEAD, field_degree=DEGREE, strut_moisture=0.0 if damp else None)
    seen = fit_model(readings, settings).warming
    expansion = np.array([*model.struts.expansion, model.base_expansion, model.platform_expansion])
    if thermometer:  # per kelvin of the thermometer
        expansion *= warm.rise[:-1] / warm.rise[PARTS.index(thermometer)]
    true = {name: float(expansion[members].mean()) for name, members in MEMBERS.items()}
    true["moisture"] = float(model.struts.moisture[0])
    named = [("moisture" if g.unit == "m/m" else g.part, g) for g in seen.growths if np.isfinite(g.deviation)]
    pulls = [Pull(name, (g.found - true[name]) / g.deviation, g.determined > SEEN_SHARE) for name, g in named]
    if thermometer and len(seen.time_constants) == 1:
        value, deviation = seen.time_constants[0]
        pulls.append(Pull("time constant", (np.log(value) - np.log(TAU[0])) / deviation, deviation < 1.0))
    return pulls


def zoo_warm_up(thermometer: str, damp: bool, seed: int) -> WarmUp:
    """Return a foreign machine's warm-up; its struts warm at different rates if each part has a thermometer."""
    low, high = DRY_TO_DAMP if damp else (np.nan, np.nan)
    rise, time_constants = np.append(RISE, high - low if damp else 0.0), np.append(TAU, DAMP_TAU)
    sensors = ((thermometer,) if thermometer else PARTS) + (SENSED[-1:] if damp else ())
    if thermometer:
        time_constants[PARTS.index("platform")] = TAU[0]
    warm = WarmUp(rise, time_constants, low, sensors, cold_rounds=seed % 2, rounds=ROUNDS, every=EVERY)
    return warm if thermometer else warm.with_spread(APART, seed)


def pulled(args: argparse.Namespace) -> bool:
    """Run the part "pulls": print a row of pulls per parameter; return whether all targets are met."""
    pulls: list[Pull] = []
    thermometers = ("", "base")
    for draw in tqdm(range(args.draws), disable=None):
        kind, seed = PULLED[draw % len(PULLED)], 100 + draw
        try:  # all combinations of kinds, machines and thermometers in turn
            pulls += pulls_of(kind, thermometers[seed // len(PULLED) % 2], seed + seed // len(PULLED))
        except CalibrationError as error:
            tqdm.write(f"draw {draw}, {kind}: refused: {error}")
    columns = ["stated deviations", "determined", "undetermined", "RMS pull", f"within {FAR:g} σ", "largest", "target"]
    found = drawn.Table(columns)
    for name in (*dict.fromkeys(p.parameter for p in pulls), ""):
        own = [p for p in pulls if name in ("", p.parameter)]
        sizes = np.abs([p.size for p in own if p.determined] or [0.0])
        rms, within, judged = (
            float(np.sqrt((sizes**2).mean())),
            float((sizes <= FAR).mean()),
            sum(p.determined for p in own),
        )
        met = rms <= LARGEST_PULL and within >= LEAST_WITHIN
        cells = [f"{rms:.2f}", f"{within:.0%}", f"{sizes.max():.1f}", "met" if met else "MISSED"]
        found.row(name or "all", judged, len(own) - judged, *cells, met=met)
    return found.met


# ---- a pose instrument in place of thermometers ----

FUSED = ("paper", "example_6_6", "framed", "hanging", "inches")
WARMING = 5.0 / RISE[0] * RISE  # rises of struts, base and platform, K
LASTS, DWELL, READINGS = 10800, 10, 5  # warm-up, s; time at each pose, s; readings at each pose
NOISE, TURN_NOISE = 2e-6, 1e-5  # 1 σ of a measured position, m, and rotation, rad
WILD, WILD_BY = 0.01, (5e-5, 5e-3)  # share of outliers, and range of their size, m
REACH, TURNS = 0.06, np.radians(2.0)  # largest distance from home along each axis, m; largest rotation, rad
LEFT = 0.25  # target: each machine's error with fusion over its error without


def geometry_of(name: str) -> HexapodGeometry:
    return load_geometry(name) if name == "example_6_6" else drawn.of_zoo(name)[0]


def one_fused(name: str, seed: int) -> tuple[np.ndarray, np.ndarray, int, int, int]:
    """Return squared errors at each pose, m², without and with fusion.

    The last three results are the numbers of outliers, accepted outliers and rejected good readings.
    """
    seed, geometry = 99 + seed, geometry_of(name)
    rng, model = np.random.default_rng([seed, 31]), of_steel(draw_model(geometry, LARGE, seed), seed)
    hidden, blind, fused = (Compensator(geometry, model, 1.0) for _ in range(3))
    fusion = Fusion(fused, FusionRules(position_deviation=NOISE, rotation_deviation=TURN_NOISE))
    course = WarmUp(np.append(WARMING, 0.0), np.append(TAU, 1.0)).with_spread(0.1, seed).over_time(LASTS)
    left: tuple[list[float], list[float]] = ([], [])
    counts = np.zeros(3, dtype=int)
    for second in range(DWELL, LASTS, DWELL):
        for part, value in zip(PARTS, course[second], strict=False):
            hidden.set_temperature(part, float(value))
        turn = Rotation.from_rotvec(TURNS * rng.uniform(-1.0, 1.0, 3) / np.sqrt(3.0)).as_matrix()
        place = geometry.home.position + REACH * rng.uniform(-1.0, 1.0, 3)
        platform = Pose(place, geometry.home.rotation @ turn)
        wanted = platform @ geometry.tool
        for kept, compensator in zip(left, (blind, fused), strict=True):
            compensator.reset()
            try:
                for n in range(2):  # the second command contains the ramped correction
                    commands = compensator.correct(geometry.tool_pose(platform), 0.02 * n).command
            except HexapodError:
                break
            hidden.motion.sense[:] = compensator.motion.sense
            real = hidden.estimate(commands)
            kept.append(float(np.square(real[:3] - wanted.position).sum()))
        else:
            tool = Pose(real[:3].copy(), real[3:].reshape(3, 3).copy())
            for n in range(READINGS):
                counts += _measure(fusion, tool, commands, second + 2.0 * n, rng)
            fusion.feed(compensate=True)
    return np.array(left[0]), np.array(left[1]), *counts.tolist()


def _measure(fusion: Fusion, tool: Pose, struts: np.ndarray, at: float, rng: np.random.Generator) -> tuple[int, ...]:
    """Add a reading; return whether it is an outlier, an accepted outlier, and a rejected good reading."""
    position, turn = tool.position + NOISE * rng.standard_normal(3), TURN_NOISE * rng.standard_normal(3)
    wild = rng.random() < WILD
    if wild:
        way = rng.standard_normal(3)
        position = position + np.exp(rng.uniform(*np.log(WILD_BY))) * way / np.linalg.norm(way)
    pose = Pose(position, Rotation.from_rotvec(turn).as_matrix() @ tool.rotation)
    fusion.add_struts(struts.tolist(), at - 0.01)
    fusion.add(PoseReading(pose, at, fusion.rules.covariance()))
    rejected = bool(fusion.add_struts(struts.tolist(), at + 0.01))
    return wild, wild and not rejected, rejected and not wild


def cost() -> tuple[float, float]:
    """Return the processor time of a pose estimate, s, without and with the correction for the fused drift."""
    geometry = geometry_of("paper")
    compensator = Compensator(geometry, of_steel(draw_model(geometry, LARGE, 1), 1))
    fusion, times = Fusion(compensator, FusionRules()), []
    fusion.filter.state = np.full(12, 1e-6)
    struts = tuple(compensator.correct(geometry.tool_pose(geometry.home)).command.tolist())
    for weigh in (lambda pose: pose, fusion.with_drift):
        began = time.process_time()
        for _ in range(2000):
            weigh(compensator.estimate(struts))
        times.append((time.process_time() - began) / 2000)
    return times[0], times[1]


def fused(args: argparse.Namespace) -> bool:
    """Run the part "fused": print a row per geometry; return whether all errors and outliers meet the targets."""
    columns = ["warm-up of 5 K", "machines", "blind, µm", "fused, µm", "left", "worst", "wild, counted"]
    found = drawn.Table([*columns, "true, rejected", "target"])
    some = argparse.Namespace(**{**vars(args), "machines": max(1, args.machines // len(FUSED))})
    for name, machines in drawn.results(one_fused, FUSED, some):
        before, after = (np.array([squares.mean() for squares in one]) for one in list(zip(*machines, strict=True))[:2])
        wild, passed, refused = np.sum([one[2:] for one in machines], axis=0).tolist()
        share = refused / (READINGS * sum(len(one[0]) for one in machines))
        left, worst = um(after) / um(before), np.sqrt((after / before).max())
        met = bool(worst <= LEFT and not passed)
        cells = [len(machines), f"{um(before):.2f}", f"{um(after):.2f}", f"{left:.1%}", f"{worst:.1%}"]
        found.row(name, *cells, f"{wild}, {passed}", f"{share:.2%}", drawn.verdict(LEFT, met), met=met)
    without, weighed = cost()
    print(f"\npose estimate: {1e6 * without:.1f} µs, with fusion {1e6 * weighed:.1f} µs of processor time")
    return found.met


PARTS_OF_RUN = {"stated": stated, "fitted": fitted, "pulls": pulled, "fused": fused}


def main() -> int:
    parser = drawn.options(__doc__, 20, of="drift")
    parser.add_argument("--points", type=int, default=1000, help="number of points outside the fit (default 1000)")
    parser.add_argument("--draws", type=int, default=48, help="number of machines for the pulls (default 48)")
    parser.add_argument("--only", choices=PARTS_OF_RUN, help="run this part only (default: all)")
    args = parser.parse_args()
    met = [run(args) for name, run in PARTS_OF_RUN.items() if args.only in (None, name)]
    return 0 if all(met) else 1


if __name__ == "__main__":
    sys.exit(main())
