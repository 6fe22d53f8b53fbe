"""What temperature sensors are worth: machines that warm by 1 K, compensated from noisy readings.

Machines of kind B (see :mod:`benchmarks.calibration`) of steel warm in a straight line over half an hour and then
stay warm. A sensor on each part that warms reads once a second, with noise; the compensator, whose model is
exact, gets what the filter makes of it, from the first reading on. At 1,000 held-out points, spread over each
of the two half hours and passed there and back, the figure is how far the drift has brought the tool from where it
is at 20 °C: the error in space as it is, since a drift moves the datum and no alignment may take that out.

Then expansions and time constants are fitted, and their stated deviations judged: see :mod:`benchmarks.warm_up`.

Usage: python -m benchmarks.thermal [--only stated|fitted|pulls] [--machines 20] [--points 1000] [--noise 0.05]
[--time-constant 30]

Exits 1 when a bar is missed.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from tqdm import tqdm

from benchmarks import drawn, warm_up
from benchmarks.calibration import CONFIG, LARGE
from hexapod_comp.compensation.thermal import DEFAULT_TIME_CONSTANT, TemperatureFilter
from hexapod_comp.errors import CalibrationError
from hexapod_comp.machine.geometry import STRUT_NAMES, load_geometry
from hexapod_comp.machine.model import RealMachine
from hexapod_comp.machine.passes import random_passes
from hexapod_comp.machine.temperatures import REFERENCE_TEMPERATURE, Temperatures
from hexapod_comp.measurements.campaign import load_campaign
from hexapod_comp.virtual.imperfections import draw_model

STEEL = 11.5e-6  # Expansion of struts, base and platform, 1/K

# How long the machine warms, and how long it then stays warm, s: readings of each phase, one a second
HALF_HOUR = 1800

MOMENTS = 40  # In how many groups the points of a phase are passed, evenly over it

BAR = 0.95

PHASES = ("warming", "warm")
COMPENSATIONS = ("blind", "unfiltered", "filtered")


@dataclass(frozen=True)
class Drift:
    """What warms, and how far each part goes, K."""

    name: str
    parts: tuple[str, ...]
    final: Callable[[np.random.Generator, int], np.ndarray]


def _apart(rng: np.random.Generator, count: int) -> np.ndarray:
    return rng.standard_normal(count)


DRIFTS = (
    Drift("struts together, +1 K", STRUT_NAMES, lambda _, count: np.ones(count)),
    Drift("struts apart, N(0, 1 K)", STRUT_NAMES, _apart),
    Drift("struts, base, platform apart, N(0, 1 K)", Temperatures.NAMES, _apart),
)


@dataclass(frozen=True)
class FitSettings:
    """How a machine is judged: points, standard deviation of a reading (K), time constant of the filter (s)."""

    points: int
    noise: float
    time_constant: float


def one_machine(drift: Drift, seed: int, settings: FitSettings) -> np.ndarray:
    """Return mean squares, m², of the tool's displacement by a drift, shape (phase, compensation)."""
    geometry, rng = load_geometry(CONFIG / "paper.yaml"), np.random.default_rng(seed)
    model = draw_model(geometry, LARGE, seed)
    struts = replace(model.struts, expansion=np.full(6, STEEL))
    model = replace(model, struts=struts, base_expansion=STEEL, platform_expansion=STEEL)
    box = load_campaign(CONFIG / "campaign_5d.yaml").box
    passes = random_passes(geometry, box, settings.points, 0.0, rng)
    cold = warm_up.tool_at(RealMachine(geometry, model), passes, model, None)
    true, readings = read(drift, settings, rng)
    squares = np.empty((len(PHASES), len(COMPENSATIONS)))
    for phase in range(len(PHASES)):
        moved = np.empty((len(COMPENSATIONS), *cold.shape))
        for group, second in _groups(settings.points, phase):
            at = passes.select(group)
            truth = RealMachine(geometry, model, _temperatures(drift, true[second]))
            for n, seen in enumerate((None, *readings)):
                sensed = None if seen is None else _temperatures(drift, seen[second])
                moved[n, group] = warm_up.tool_at(truth, at, model, sensed) - cold[group]
        squares[phase] = np.mean(np.sum(moved**2, axis=2), axis=1)
    return squares


def read(
    drift: Drift, settings: FitSettings, rng: np.random.Generator
) -> tuple[np.ndarray, tuple[np.ndarray, np.ndarray]]:
    """Return true temperatures and readings, unfiltered and filtered, °C, each of shape (seconds, parts)."""
    warmth = np.minimum(np.arange(2 * HALF_HOUR + 1) / HALF_HOUR, 1.0)
    true = REFERENCE_TEMPERATURE + np.outer(warmth, drift.final(rng, len(drift.parts)))
    readings = true + settings.noise * rng.standard_normal(true.shape)
    low_pass = TemperatureFilter(settings.time_constant)
    filtered = [
        [low_pass.update(part, value, float(second)) for part, value in zip(drift.parts, row, strict=True)]
        for second, row in enumerate(readings)
    ]
    return true, (readings, np.array(filtered))


def _groups(points: int, phase: int) -> list[tuple[np.ndarray, int]]:
    """Return which passes, there and back, are made at which second of a phase, its end included."""
    seconds = np.linspace(0, HALF_HOUR, MOMENTS + 1)[1:].astype(int) + phase * HALF_HOUR
    parts = np.array_split(np.arange(points), MOMENTS)
    return [(np.concatenate([part, part + points]), int(s)) for part, s in zip(parts, seconds, strict=True)]


def _temperatures(drift: Drift, values: np.ndarray) -> Temperatures:
    return Temperatures(dict(zip(drift.parts, values, strict=True)))


COLUMNS = ["drift", "phase", "blind, µm", "unfiltered, µm", "removed", "filtered, µm", "removed", "least", "bar"]


def stated(args: argparse.Namespace) -> bool:
    """Print the rows of drifts whose expansions are stated; return whether all bars are met."""
    found, settings = drawn.Table(COLUMNS, texts=2), FitSettings(args.points, args.noise, args.time_constant)
    for drift in DRIFTS:
        seeds = tqdm(range(1, args.machines + 1), disable=None)
        squares = np.array([one_machine(drift, seed, settings) for seed in seeds])
        for n, phase in enumerate(PHASES):
            blind, unfiltered, filtered = 1e6 * np.sqrt(squares[:, n].mean(axis=0))
            least = 1.0 - np.sqrt(squares[:, n, 2] / squares[:, n, 0]).max()
            removed = 1.0 - filtered / blind
            cells = [f"{blind:.2f}", f"{unfiltered:.3f}", f"{1.0 - unfiltered / blind:.1%}", f"{filtered:.3f}"]
            met = bool(removed >= BAR)
            found.row(drift.name, phase, *cells, f"{removed:.1%}", f"{least:.1%}", drawn.verdict(BAR, met), met=met)
    return found.met


def fitted(args: argparse.Namespace) -> bool:
    """Print the rows of machines whose expansions are fitted; return whether all bars are met."""
    found = drawn.Table(warm_up.FITTED)
    for sensors in warm_up.SENSORS:
        seeds = tqdm(range(1, args.machines + 1), disable=None)
        squares = [warm_up.fitted_machine(sensors, seed, args.points, args.noise)[:2] for seed in seeds]
        warm_up.show_fitted(found, sensors, np.array(squares))
    return found.met


def pulled(args: argparse.Namespace) -> bool:
    """Print the rows of what was estimated beside its stated deviations; return whether all bars are met."""
    pulls: list[warm_up.Pull] = []
    kinds, thermometers = warm_up.PULLED, ("", "base")
    for draw in tqdm(range(args.draws), disable=None):
        kind, seed = kinds[draw % len(kinds)], 100 + draw
        try:  # kinds, machines and thermometers in turn, each with each
            pulls += warm_up.pulls_of(kind, thermometers[seed // len(kinds) % 2], seed + seed // len(kinds))
        except CalibrationError as error:
            tqdm.write(f"draw {draw}, {kind}: refused: {error}")
    found = drawn.Table(warm_up.PULLS)
    for name in (*dict.fromkeys(p.parameter for p in pulls), ""):
        warm_up.show_pulls(found, name, pulls)
    return found.met


PARTS = {"stated": stated, "fitted": fitted, "pulls": pulled}


def main() -> int:
    """Run the drifts and print the tables."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--machines", type=int, default=20, help="machines for each drift (default 20)")
    parser.add_argument("--points", type=int, default=1000, help="held-out points (default 1000)")
    parser.add_argument("--noise", type=float, default=0.05, help="standard deviation of a reading, K (default 0.05)")
    parser.add_argument("--time-constant", type=float, default=DEFAULT_TIME_CONSTANT, help="of the filter, s")
    parser.add_argument("--draws", type=int, default=48, help="machines of the zoo whose pulls are taken (default 48)")
    parser.add_argument("--only", choices=PARTS, help="one part alone (default: all)")
    args = parser.parse_args()
    met = [run(args) for name, run in PARTS.items() if args.only in (None, name)]
    return 0 if all(met) else 1


if __name__ == "__main__":
    sys.exit(main())
