"""What temperature sensors are worth: machines that warm by 1 K, compensated from noisy readings.

Machines of kind B (see :mod:`benchmarks.calibration`) of steel warm in a straight line over half an hour and then
stay warm. A sensor on each part that warms reads once a second, with noise; the compensator, whose model is
exact, gets what the filter makes of it, from the first reading on. At 1,000 held-out points, spread over each
of the two half hours and passed there and back, the figure is how far the drift has brought the tool from where it
is at 20 °C: the error in space as it is, since a drift moves the datum and no alignment may take that out.

Then expansions and time constants are fitted, and their stated deviations judged: see :mod:`benchmarks.warm_up`.

Usage: python -m benchmarks.thermal [--only stated|fitted|pulls] [--machines 20] [--points 1000] [--noise 0.05]
[--time-constant 30] [--json]

Exits 1 when a bar is missed.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace

import numpy as np
from tqdm import tqdm

from benchmarks.calibration import CONFIG, LARGE
from benchmarks.warm_up import (
    FITTED_HEADER,
    PULL_HEADER,
    PULLED,
    SENSORS,
    FittedRow,
    Pull,
    PullRow,
    fitted_machine,
    fitted_row,
    fitted_shown,
    pull_row,
    pull_shown,
    pulls_of,
)
from hexapod_comp.compensation.thermal import DEFAULT_TIME_CONSTANT, TemperatureFilter
from hexapod_comp.errors import CalibrationError
from hexapod_comp.machine.geometry import STRUT_NAMES, load_geometry
from hexapod_comp.machine.model import MachineModel, RealMachine
from hexapod_comp.machine.passes import Passes, random_passes
from hexapod_comp.machine.temperatures import REFERENCE_TEMPERATURE, Temperatures
from hexapod_comp.machine.trial import Trial
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
    cold = _tool(RealMachine(geometry, model), passes, model, None)
    true, readings = warm_up(drift, settings, rng)
    squares = np.empty((len(PHASES), len(COMPENSATIONS)))
    for phase in range(len(PHASES)):
        moved = np.empty((len(COMPENSATIONS), *cold.shape))
        for group, second in _groups(settings.points, phase):
            at = passes.select(group)
            truth = RealMachine(geometry, model, _temperatures(drift, true[second]))
            for n, seen in enumerate((None, *readings)):
                sensed = None if seen is None else _temperatures(drift, seen[second])
                moved[n, group] = _tool(truth, at, model, sensed) - cold[group]
        squares[phase] = np.mean(np.sum(moved**2, axis=2), axis=1)
    return squares


def warm_up(
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


def _tool(truth: RealMachine, passes: Passes, model: MachineModel, sensed: Temperatures | None) -> np.ndarray:
    """Return where the tool goes, shape (N, 3), m in ``base``."""
    trial = Trial(truth, passes)
    errors = trial.errors(trial.commands(model, sensed))
    return errors.points + errors.displacement


@dataclass(frozen=True)
class Row:
    """RMS displacement of the tool by a drift, µm, and the shares removed."""

    drift: str
    phase: str
    machines: int
    blind: float
    unfiltered: float
    filtered: float
    unfiltered_removed: float
    removed: float
    least_removed: float
    met: bool


def summed_up(drift: Drift, phase: int, squares: np.ndarray) -> Row:
    """Return the row of a drift from mean squares, shape (machine, phase, compensation), m²."""
    blind, unfiltered, filtered = 1e6 * np.sqrt(squares[:, phase].mean(axis=0))
    least = 1.0 - np.sqrt(squares[:, phase, 2] / squares[:, phase, 0]).max()
    removed = 1.0 - filtered / blind
    return Row(
        drift=drift.name,
        phase=PHASES[phase],
        machines=len(squares),
        blind=float(blind),
        unfiltered=float(unfiltered),
        filtered=float(filtered),
        unfiltered_removed=float(1.0 - unfiltered / blind),
        removed=float(removed),
        least_removed=float(least),
        met=bool(removed >= BAR),
    )


HEADER = (
    "| drift | phase | blind, µm | unfiltered, µm | removed | filtered, µm | removed | least | bar |\n"
    "|---|---|---:|---:|---:|---:|---:|---:|---|"
)


def shown(row: Row) -> str:
    """Return a row of the table."""
    unfiltered, removed, least = (
        f"{100.0 * share:.1f} %" for share in (row.unfiltered_removed, row.removed, row.least_removed)
    )
    return (
        f"| {row.drift} | {row.phase} | {row.blind:.2f} | {row.unfiltered:.3f} | {unfiltered} "
        f"| {row.filtered:.3f} | {removed} | {least} | {100.0 * BAR:.0f} % {'met' if row.met else 'MISSED'} |"
    )


def stated(args: argparse.Namespace, settings: FitSettings) -> list[Row]:
    """Return the rows of drifts whose expansions are stated, printed as they come."""
    rows = []
    if not args.json:
        print(HEADER, flush=True)
    with tqdm(total=len(DRIFTS) * args.machines, disable=None) as bar:
        for drift in DRIFTS:
            squares = []
            for seed in range(1, args.machines + 1):
                squares.append(one_machine(drift, seed, settings))
                bar.update()
            for phase in range(len(PHASES)):
                rows.append(summed_up(drift, phase, np.array(squares)))
                if not args.json:
                    tqdm.write(shown(rows[-1]))
    return rows


def fitted(args: argparse.Namespace) -> list[FittedRow]:
    """Return the rows of machines whose expansions are fitted, printed as they come."""
    rows = []
    if not args.json:
        print("\n" + FITTED_HEADER, flush=True)
    with tqdm(total=len(SENSORS) * args.machines, disable=None) as bar:
        for sensors in SENSORS:
            squares = []
            for seed in range(1, args.machines + 1):
                squares.append(fitted_machine(sensors, seed, args.points, args.noise)[:2])
                bar.update()
            rows.append(fitted_row(sensors, np.array(squares)))
            if not args.json:
                tqdm.write(fitted_shown(rows[-1]))
    return rows


def pulled(args: argparse.Namespace) -> list[PullRow]:
    """Return the rows of what was estimated beside its stated deviations, printed as it comes."""
    pulls: list[Pull] = []
    thermometers = ("", "base")
    with tqdm(total=args.draws, disable=None) as bar:
        for draw in range(args.draws):
            kind = PULLED[draw % len(PULLED)]
            seed = 100 + draw
            try:  # kinds, machines and thermometers in turn, each with each
                pulls += pulls_of(kind, thermometers[seed // len(PULLED) % 2], seed + seed // len(PULLED))
            except CalibrationError as error:
                tqdm.write(f"draw {draw}, {kind}: refused: {error}")
            bar.update()
    names = list(dict.fromkeys(p.parameter for p in pulls))
    rows = [pull_row(name, pulls) for name in (*names, "")]
    if not args.json:
        print("\n".join(["", PULL_HEADER, *map(pull_shown, rows)]), flush=True)
    return rows


def main() -> int:
    """Run the drifts and print the table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--machines", type=int, default=20, help="machines for each drift (default 20)")
    parser.add_argument("--points", type=int, default=1000, help="held-out points (default 1000)")
    parser.add_argument("--noise", type=float, default=0.05, help="standard deviation of a reading, K (default 0.05)")
    parser.add_argument("--time-constant", type=float, default=DEFAULT_TIME_CONSTANT, help="of the filter, s")
    parser.add_argument("--draws", type=int, default=48, help="machines of the zoo whose pulls are taken (default 48)")
    parser.add_argument("--only", choices=("stated", "fitted", "pulls"), help="one part alone (default: all)")
    parser.add_argument("--json", action="store_true", help="JSON instead of a table")
    args = parser.parse_args()
    settings = FitSettings(args.points, args.noise, args.time_constant)
    rows: list[Row | FittedRow | PullRow] = []
    if args.only in (None, "stated"):
        rows += stated(args, settings)
    if args.only in (None, "fitted"):
        rows += fitted(args)
    if args.only in (None, "pulls"):
        rows += pulled(args)
    if args.json:
        print(json.dumps([asdict(row) for row in rows], indent=1))
    return 0 if all(row.met for row in rows) else 1


if __name__ == "__main__":
    sys.exit(main())
