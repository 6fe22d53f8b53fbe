"""What a ball bar, an R-test and a tracking interferometer are worth, where no laser line was measured.

Machines as in ``benchmarks.calibration``, each measured by virtual instruments, fitted as ``hexapod_comp fit`` does it,
and judged at 1,000 random points, level and tilted by up to 10°, after one rotation and shift of the datum.

Usage: python -m benchmarks.instruments [--machines 20] [--workers 2] [--case NAME ...]

Exits 1 when a bar is missed.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from benchmarks import drawn
from benchmarks.calibration import CONFIG, LEAD, truth_of
from hexapod_comp.calibration.evaluation import held_out
from hexapod_comp.calibration.fit import fit_model
from hexapod_comp.calibration.parameters import FitSettings
from hexapod_comp.machine.geometry import load_geometry
from hexapod_comp.machine.model import RealMachine
from hexapod_comp.measurements.campaign import PLANES, Campaign, CampaignRun, circle_run, load_campaign, template, tilts
from hexapod_comp.virtual.instruments import measure

TILT = np.radians(10.0)

CORNERS = np.array([[1, 1, 1], [-1, 1, -1], [-1, -1, 1], [1, -1, -1]])  # Four corners of a box of half sides 1


def circles(box: np.ndarray, points: int = 37) -> list[CampaignRun]:
    """Return 15 circles of 100 mm: about five places, in three planes each; level ones at five heights."""
    runs, middle = [], box.mean(axis=0)
    places = np.vstack([np.zeros(3), [1.0, 1.0, 0.0] * CORNERS])
    for n, (place, height) in enumerate(zip(places, np.linspace(-0.09, 0.09, 5), strict=True), start=1):
        for plane, axes in PLANES.items():
            centre = middle + 0.1 * place + (np.array([0.0, 0.0, height]) if plane == "xy" else 0.0)
            runs.append(
                circle_run(f"circle {n} {plane}", centre.round(9), 0.1, points, np.eye(3)[list(axes)], np.eye(3))
            )
    return runs


def calibrated_circles(box: np.ndarray) -> list[CampaignRun]:
    """Return the same circles by a bar of known length, as a calibrator of little expansion gives it."""
    return [replace(run, known_zero=True) for run in circles(box)]


def r_tests(box: np.ndarray, points: int = 41) -> list[CampaignRun]:
    """Return R-tests at four places, tilted up to 10°."""
    places = (box.mean(axis=0) + 0.3 * CORNERS * np.ptp(box, axis=0)).round(6)
    turned = tilts(points, TILT)
    return [CampaignRun(f"R-test {n}", "r_test", np.tile(p, (points, 1)), turned) for n, p in enumerate(places, 1)]


def stations(box: np.ndarray, points: int = 400) -> list[CampaignRun]:
    """Return level points of a box, seen from four stations: three around it, one above."""
    positions = np.random.default_rng(0).uniform(box[0], box[1], (points, 3)).round(6)
    places = ([0.7, 0.6, 0.1], [-0.6, 0.7, 0.2], [-0.7, -0.6, 0.3], [0.1, -0.1, 1.3])
    level = np.tile(np.eye(3), (points, 1, 1))
    return [
        CampaignRun(f"station {n}", "station", positions, level, np.tile(place, (points, 1)))
        for n, place in enumerate(places, start=1)
    ]


class Bar(NamedTuple):
    """What must come out: less error at held-out points, level and tilted; NaN where nothing is asked."""

    level: float
    tilted: float = np.nan


@dataclass(frozen=True)
class InstrumentCase:
    """Instruments on a kind of machine; `parts` name what makes their runs."""

    name: str
    machine: str
    parts: tuple[str, ...]
    bar: Bar


PARTS = {"circles": circles, "calibrated circles": calibrated_circles, "r_tests": r_tests, "stations": stations}

CASES = (
    InstrumentCase("ball bar", "A", ("circles",), Bar(0.75)),
    InstrumentCase("ball bar", "B", ("circles",), Bar(0.85)),
    InstrumentCase("ball bar and R-test", "B", ("circles", "r_tests"), Bar(0.92, 0.90)),
    InstrumentCase("calibrated ball bar and R-test", "B", ("calibrated circles", "r_tests"), Bar(0.92, 0.90)),
    InstrumentCase("stations", "A", ("stations",), Bar(0.92)),
    InstrumentCase("stations", "B", ("stations",), Bar(0.98)),
)


class Judged(NamedTuple):
    """RMS errors of one machine, m, before and after, level and tilted, and the 95 % interval of the level one."""

    level: tuple[float, float]
    tilted: tuple[float, float]
    expected: tuple[float, float]
    unseen: tuple[str, ...]


def campaign_of(case: InstrumentCase) -> Campaign:
    """Return a case's campaign, in the box of the shipped ones."""
    box = load_campaign(CONFIG / "campaign_1d.yaml")
    runs = tuple(run for part in case.parts for run in PARTS[part](box.box))
    return replace(box, instrument=None, diagonals=0, runs=runs)


def one_machine(number: int, seed: int) -> Judged:
    """Measure, fit and judge one machine of a case."""
    case, geometry = CASES[number], load_geometry(CONFIG / "paper.yaml")
    campaign = campaign_of(case)
    truth = RealMachine(geometry, truth_of(geometry, case.machine, seed, campaign.box))
    fit = fit_model(measure(template(campaign, geometry), campaign, truth, seed), FitSettings(lead=LEAD))

    def error(model: object, tilt: float) -> float:
        return float(held_out(truth, model, campaign.box, seed=seed, tilt=tilt).aligned.rms)  # type: ignore[arg-type]

    level, tilted = ((error(None, tilt), error(fit.model, tilt)) for tilt in (0.0, TILT))
    expected = (fit.level.low, fit.level.high) if fit.level else (np.nan, np.nan)
    return Judged(level, tilted, expected, tuple(error.name for error in fit.unseen_errors))


def shown(case: InstrumentCase, machines: list[Judged]) -> tuple[str, bool]:
    """Return a row of the table, and whether the bar is met."""
    cells, met = [], True
    for which, bar in zip(("level", "tilted"), case.bar, strict=True):
        before, after = np.sqrt(np.mean([np.square(getattr(m, which)) for m in machines], axis=0))
        removed = 1.0 - after / before
        least = min(1.0 - getattr(m, which)[1] / getattr(m, which)[0] for m in machines)
        verdict = "" if np.isnan(bar) else f"{bar:.0%} {'met' if removed >= bar else 'MISSED'}"
        met &= bool(np.isnan(bar) or removed >= bar)
        cells += [f"{before * 1e6:.2f}", f"{after * 1e6:.3f}", f"{removed:.1%}", f"{least:.1%}", verdict]
    inside = sum(m.expected[0] <= m.level[1] <= m.expected[1] for m in machines)
    cells += [f"{inside}/{len(machines)}", ", ".join(machines[0].unseen)]
    return f"| {case.name} | {case.machine} | " + " | ".join(cells) + " |", met


HEADER = "instruments|kind|level before, µm|after|removed|least|bar|tilted before|after|removed|least|bar|inside|unseen"


def main() -> int:
    """Run the cases and print the table."""
    parser = drawn.options(__doc__, 20)
    parser.add_argument("--case", action="append", help="only cases whose name starts so; may be repeated")
    args = parser.parse_args()
    chosen = [n for n, case in enumerate(CASES) if not args.case or case.name.startswith(tuple(args.case))]
    print("| " + HEADER.replace("|", " | ") + " |\n" + "|---" * 14 + "|", flush=True)
    met = []
    for n, done in drawn.results(one_machine, chosen, args):
        row, good = shown(CASES[n], done)
        met.append(good)
        drawn.show(row)
    return 0 if all(met) else 1


if __name__ == "__main__":
    sys.exit(main())
