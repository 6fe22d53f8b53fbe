"""How much error calibration removes: virtual machines are measured, fitted and checked at points outside the fit.

Usage: python -m benchmarks.calibration [--machines 20] [--first 1] [--workers 2] [--case NAME ...] [--kind ABDG];
campaigns, kinds and targets: doc/benchmarks.md.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from benchmarks import drawn
from benchmarks.drawn import with_wavy_field
from hexapod_comp.calibration.evaluation import evaluate_model, held_out
from hexapod_comp.calibration.fit import fit_model
from hexapod_comp.calibration.lines import fit_lines
from hexapod_comp.calibration.parameters import FitSettings
from hexapod_comp.machine.geometry import HexapodGeometry, load_geometry
from hexapod_comp.machine.model import MachineModel, RealMachine
from hexapod_comp.measurements.campaign import PLANES, Campaign, CampaignRun, circle_run, load_campaign, template, tilts
from hexapod_comp.virtual.imperfections import ImperfectionBounds, draw_model, with_length_map
from hexapod_comp.virtual.instruments import measure

CONFIG = Path(__file__).resolve().parents[1] / "config"
LEAD = 0.01
TILT = np.radians(10.0)
SMALL = ImperfectionBounds(
    joint=10e-6, strut_offset=10e-6, pitch=50e-6, wave=(4e-6, 4e-6), wave_period=LEAD, backlash=(3e-6, 5e-6)
)
LARGE = replace(SMALL, joint=100e-6, strut_offset=100e-6, pitch=100e-6)


def five(**changes: object) -> Campaign:
    return replace(load_campaign(CONFIG / "campaign_5d.yaml"), **changes)


def one(**changes: object) -> Campaign:
    return replace(load_campaign(CONFIG / "campaign_1d.yaml"), **changes)


# Campaigns without laser lines

CORNERS = np.array([[1, 1, 1], [-1, 1, -1], [-1, -1, 1], [1, -1, -1]])  # four of a box's corners


def circles(box: np.ndarray, points: int = 37) -> list[CampaignRun]:
    """Return 15 circles of 100 mm radius: in three planes at about five places; level circles at five heights."""
    runs, middle = [], box.mean(axis=0)
    places = np.vstack([np.zeros(3), [1.0, 1.0, 0.0] * CORNERS])
    for n, (place, height) in enumerate(zip(places, np.linspace(-0.09, 0.09, 5), strict=True), start=1):
        for plane, axes in PLANES.items():
            centre = middle + 0.1 * place + (np.array([0.0, 0.0, height]) if plane == "xy" else 0.0)
            plane_axes = np.eye(3)[list(axes)]
            runs.append(circle_run(f"circle {n} {plane}", centre.round(9), 0.1, points, plane_axes, np.eye(3)))
    return runs


def r_tests(box: np.ndarray, points: int = 41) -> list[CampaignRun]:
    """Return R-tests at four places of a box, with tilts up to 10°."""
    places = (box.mean(axis=0) + 0.3 * CORNERS * np.ptp(box, axis=0)).round(6)
    turned = tilts(points, TILT)
    return [CampaignRun(f"R-test {n}", "r_test", np.tile(p, (points, 1)), turned) for n, p in enumerate(places, 1)]


def stations(box: np.ndarray, points: int = 400) -> list[CampaignRun]:
    """Return random level points in a box and their distances from four places: three beside the box, one above it."""
    positions = np.random.default_rng(0).uniform(box[0], box[1], (points, 3)).round(6)
    places = ([0.7, 0.6, 0.1], [-0.6, 0.7, 0.2], [-0.7, -0.6, 0.3], [0.1, -0.1, 1.3])
    level = np.tile(np.eye(3), (points, 1, 1))
    return [
        CampaignRun(f"station {n}", "station", positions, level, np.tile(place, (points, 1)))
        for n, place in enumerate(places, start=1)
    ]


def listed(*parts: Callable[[np.ndarray], list[CampaignRun]]) -> Callable[[], Campaign]:
    """Return a function that makes a campaign of the given runs in the box of the shipped campaigns."""
    return lambda: one(instrument=None, diagonals=0, runs=tuple(run for part in parts for run in part(one().box)))


@dataclass(frozen=True)
class Case:
    """A campaign on a kind of machine, and its targets."""

    name: str
    machine: str  # A, B, D or G, see truth_of
    campaign: Callable[[], Campaign]
    targets: dict[str, float]  # removed share: of position, tilted, rotation, or paper (Mou & King's measure)
    most: tuple[float, float] = (np.inf, np.inf)  # remaining position error: RMS and largest, m


CASES = (
    *(Case("1-D, lines", kind, lambda: one(diagonals=0), {"paper": 0.70}) for kind in "BD"),
    *(Case("1-D + 4, joint", kind, one, {"position": 0.95 if kind == "A" else 0.97}) for kind in "ABD"),
    Case("5-D + 16, joint", "A", five, {"position": 0.97}, (0.3e-6, 0.6e-6)),
    Case("5-D + 16, joint", "B", five, {"position": 0.97}, (0.3e-6, np.inf)),
    *(Case("5-D + 16, joint", kind, five, {"position": 0.97}) for kind in "DG"),
    *(Case("6-D + 16, joint", kind, lambda: five(instrument="6-D"), {"rotation": 0.97}) for kind in "ABDG"),
    Case("5-D + 16, ±1 µm stops", "B", lambda: five(repeatability=1e-6), {"position": 0.93}),
    Case("ball bar", "A", listed(circles), {"position": 0.75}),
    Case("ball bar", "B", listed(circles), {"position": 0.85}),
    Case("ball bar and R-test", "B", listed(circles, r_tests), {"position": 0.92, "tilted": 0.90}),
    Case(
        "calibrated ball bar and R-test",
        "B",
        listed(lambda box: [replace(run, known_zero=True) for run in circles(box)], r_tests),
        {"position": 0.92, "tilted": 0.90},
    ),
    Case("stations", "A", listed(stations), {"position": 0.92}),
    Case("stations", "B", listed(stations), {"position": 0.98}),
)


def truth_of(geometry: HexapodGeometry, kind: str, seed: int, box: np.ndarray) -> MachineModel:
    model = draw_model(geometry, SMALL if kind == "A" else LARGE, seed)
    if kind == "D":
        return with_length_map(model, geometry, seed)
    return with_wavy_field(model, box, seed) if kind == "G" else model


@dataclass(frozen=True)
class Machine:
    figures: dict[str, tuple[float, float]]  # without and with the model, m or rad
    expected: dict[str, tuple[float, float]]  # 95 % interval that the fit predicts
    largest: float  # position error with the model, m
    seconds: float  # of the fit


def one_machine(number: int, seed: int) -> Machine:
    case, geometry = CASES[number], load_geometry(CONFIG / "paper.yaml")
    campaign = case.campaign()
    truth = RealMachine(geometry, truth_of(geometry, case.machine, seed, campaign.box))
    measured = measure(template(campaign, geometry), campaign, truth, seed)
    began, expected = time.perf_counter(), {}
    if "paper" in case.targets:
        model = fit_lines(measured).model
    else:
        fit = fit_model(measured, FitSettings(lead=LEAD))
        model, level = fit.model, fit.level
        if level is not None:
            expected["position"] = level.low, level.high
            if level.rotation_low is not None and level.rotation_high is not None:
                expected["rotation"] = level.rotation_low, level.rotation_high
    seconds = time.perf_counter() - began
    judged = evaluate_model(truth, model, campaign.box, seed=seed, repeatability=campaign.repeatability)
    figures = {
        "position": (judged.before.aligned.rms, judged.after.aligned.rms),
        "rotation": (judged.before.rotation.rms, judged.after.rotation.rms),
        "paper": (judged.paper.before, judged.paper.after),
    }
    if "tilted" in case.targets:
        tilted = (held_out(truth, one, campaign.box, seed=seed, tilt=TILT) for one in (None, model))
        figures["tilted"] = tuple(found.aligned.rms for found in tilted)
    return Machine(figures, expected, judged.after.aligned.largest, seconds)


COLUMNS = ["campaign, scheme", "machine", "figure", "before", "after", "largest", "removed", "least", "target"]
COLUMNS += ["inside", "s"]


def show(found: drawn.Table, case: Case, machines: list[Machine], figure: str) -> None:
    """Print a row for one `figure` of a case: its RMS over the machines, or for the paper's measure its mean."""
    both = np.array([m.figures[figure] for m in machines])
    before, after = both.mean(axis=0) if figure == "paper" else np.sqrt((both**2).mean(axis=0))
    removed, least = 1.0 - after / before, (1.0 - both[:, 1] / both[:, 0]).min()
    largest, target = max(m.largest for m in machines), case.targets[figure]
    met = bool(removed >= target and (figure != "position" or (after <= case.most[0] and largest <= case.most[1])))
    promised = [(m.expected[figure], m.figures[figure][1]) for m in machines if figure in m.expected]
    inside = sum(low <= left <= high for (low, high), left in promised)
    unit = "µrad" if figure == "rotation" else "µm"
    cells = [case.name, case.machine, figure, f"{before * 1e6:.2f} {unit}", f"{after * 1e6:.3f} {unit}"]
    cells += [f"{largest * 1e6:.2f}", f"{removed:.1%}", f"{least:.1%}", drawn.verdict(target, met)]
    cells += [f"{inside}/{len(promised)}" if promised else "", f"{np.median([m.seconds for m in machines]):.0f}"]
    found.row(*cells, met=met)


def main() -> int:
    parser = drawn.options(__doc__, 20)
    parser.add_argument("--case", action="append", help="run only cases whose name begins so; may be repeated")
    parser.add_argument("--kind", help="run only these kinds of machine, for example AB")
    args = parser.parse_args()
    chosen = [
        n
        for n, case in enumerate(CASES)
        if (not args.case or case.name.startswith(tuple(args.case))) and case.machine in (args.kind or case.machine)
    ]
    found = drawn.Table(COLUMNS, texts=3)
    for n, done in drawn.results(one_machine, chosen, args):
        for figure in CASES[n].targets:
            show(found, CASES[n], done, figure)
    return 0 if found.met else 1


if __name__ == "__main__":
    sys.exit(main())
