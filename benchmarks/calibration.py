"""How much error calibration removes: virtual machines measured, fitted, and judged at points not used in the fit.

Each machine is drawn from its own seed, measured by the virtual instruments of a campaign, and fitted as
``hexapod_comp fit`` does it, with every block of parameters allowed. 1,000 random points, passed there and
back in random directions, then tell what is left after one rotation and shift of the datum.

Usage: python -m benchmarks.calibration [--machines 20] [--workers 2] [--case NAME ...] [--json]

Exits 1 when a bar is missed.
"""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np

from benchmarks import drawn
from benchmarks.smooth_imperfections import with_wavy_field
from hexapod_comp.calibration.evaluation import ModelEvaluation, evaluate_model
from hexapod_comp.calibration.fit import fit_model
from hexapod_comp.calibration.lines import fit_lines
from hexapod_comp.calibration.parameters import FitSettings
from hexapod_comp.calibration.posterior import ToolError
from hexapod_comp.machine.geometry import HexapodGeometry, load_geometry
from hexapod_comp.machine.model import MachineModel, RealMachine
from hexapod_comp.measurements.campaign import Campaign, load_campaign, template
from hexapod_comp.virtual.imperfections import ImperfectionBounds, draw_model, with_length_map
from hexapod_comp.virtual.instruments import measure

CONFIG = Path(__file__).resolve().parents[1] / "config"
LEAD = 0.01

SMALL = ImperfectionBounds(
    joint=10e-6, strut_offset=10e-6, pitch=50e-6, wave=(4e-6, 4e-6), wave_period=LEAD, backlash=(3e-6, 5e-6)
)
LARGE = replace(SMALL, joint=100e-6, strut_offset=100e-6, pitch=100e-6)


@dataclass(frozen=True)
class Case:
    """One row: which campaign on which kind of machine, fitted how, and what must come out.

    A machine of kind A has ±10 µm on joints and struts, B ±100 µm; D is B with a length map of 5 µm RMS,
    G is B with a smooth pose field of 5 µm and 30 µrad RMS.
    """

    name: str
    machine: str
    campaign: Callable[[], Campaign]
    scheme: str
    bar: float
    figure: str = "position"
    largest_rms: float = np.inf
    largest: float = np.inf


def five(**changes: object) -> Campaign:
    """Return the 5-D campaign, changed."""
    return replace(load_campaign(CONFIG / "campaign_5d.yaml"), **changes)


def one(**changes: object) -> Campaign:
    """Return the 1-D campaign, changed."""
    return replace(load_campaign(CONFIG / "campaign_1d.yaml"), **changes)


CASES = (
    *(Case("1-D, lines", kind, lambda: one(diagonals=0), "lines", 0.70, "paper") for kind in "BD"),
    *(Case("1-D + 4, joint", kind, one, "joint", 0.95 if kind == "A" else 0.97) for kind in "ABD"),
    Case("5-D + 16, joint", "A", five, "joint", 0.97, largest_rms=0.3e-6, largest=0.6e-6),
    Case("5-D + 16, joint", "B", five, "joint", 0.97, largest_rms=0.3e-6),
    *(Case("5-D + 16, joint", kind, five, "joint", 0.97) for kind in "DG"),
    *(Case("6-D + 16, joint", kind, lambda: five(instrument="6-D"), "joint", 0.97, "rotation") for kind in "ABDG"),
    Case("5-D + 16, ±1 µm stops", "B", lambda: five(repeatability=1e-6), "joint", 0.93),
)


def truth_of(geometry: HexapodGeometry, kind: str, seed: int, box: np.ndarray) -> MachineModel:
    """Draw a machine of a kind."""
    model = draw_model(geometry, SMALL if kind == "A" else LARGE, seed)
    if kind == "D":
        return with_length_map(model, geometry, seed)
    return with_wavy_field(model, box, seed) if kind == "G" else model


@dataclass(frozen=True)
class Machine:
    """One machine measured, fitted and judged; `expected`: what the fit promises."""

    worth: ModelEvaluation
    seconds: float
    expected: ToolError | None


def one_machine(number: int, seed: int) -> Machine:
    """Measure, fit and judge one machine of a case."""
    case, geometry = CASES[number], load_geometry(CONFIG / "paper.yaml")
    campaign = case.campaign()
    truth = RealMachine(geometry, truth_of(geometry, case.machine, seed, campaign.box))
    measured = measure(template(campaign, geometry), campaign, truth, seed)
    began, expected = time.perf_counter(), None
    if case.scheme == "lines":
        model = fit_lines(measured).model
    else:
        fit = fit_model(measured, FitSettings(lead=LEAD))
        model, expected = fit.model, fit.level
    seconds = time.perf_counter() - began
    judged = evaluate_model(truth, model, campaign.box, seed=seed, repeatability=campaign.repeatability)
    return Machine(judged, seconds, expected)


@dataclass(frozen=True)
class Row:
    """What came out of a case; lengths in µm, rotations in µrad; `inside`: of position and of rotation."""

    case: str
    machine: str
    machines: int
    figure: str
    before: float
    after: float
    largest: float
    removed: float
    mean_removed: float
    least_removed: float
    bar: float
    met: bool
    expected: float | None
    inside: tuple[int, int | None] | None
    seconds: float


def summed_up(case: Case, machines: list[Machine]) -> Row:
    """Return the row of a case: root mean square over all machines, for the paper's metric the mean."""
    before, after = (np.array([_figure(case, m, which) for m in machines]) for which in ("before", "after"))
    together = np.mean if case.figure == "paper" else lambda v: np.sqrt(np.mean(v**2))
    removed = 1.0 - together(after) / together(before)
    largest = max(m.worth.after.aligned.largest for m in machines)
    promised = [m for m in machines if m.expected is not None]
    name = "rotation_after" if case.figure == "rotation" else "after"
    expected = [getattr(m.expected, name) for m in promised]
    return Row(
        case=case.name,
        machine=case.machine,
        machines=len(machines),
        figure=case.figure,
        before=1e6 * float(together(before)),
        after=1e6 * float(together(after)),
        largest=1e6 * largest,
        removed=float(removed),
        mean_removed=float((1.0 - after / before).mean()),
        least_removed=float((1.0 - after / before).min()),
        bar=case.bar,
        met=bool(removed >= case.bar and together(after) <= case.largest_rms and largest <= case.largest),
        expected=1e6 * float(np.sqrt(np.mean(np.square(expected)))) if expected else None,
        inside=(sum(map(_position_kept, promised)), _rotations_kept(promised)) if expected else None,
        seconds=float(np.median([m.seconds for m in machines])),
    )


def _position_kept(machine: Machine) -> bool:
    promised = machine.expected
    return promised is not None and promised.low <= machine.worth.after.aligned.rms <= promised.high


def _rotations_kept(machines: list[Machine]) -> int | None:
    """Return for how many machines the rotation lies in its interval; None where one has none."""
    count = 0
    for machine in machines:
        promised, left = machine.expected, machine.worth.after.rotation.rms
        if promised is None or promised.rotation_low is None or promised.rotation_high is None:
            return None
        count += promised.rotation_low <= left <= promised.rotation_high
    return count


def _figure(case: Case, machine: Machine, which: str) -> float:
    if case.figure == "paper":
        return float(getattr(machine.worth.paper, which))
    judged = getattr(machine.worth, which)
    return float(judged.rotation.rms if case.figure == "rotation" else judged.aligned.rms)


COLUMNS = "campaign, scheme|machine|figure|before|after|largest|removed|mean|least|bar|expected|s"
HEADER = "| " + COLUMNS.replace("|", " | ") + " |"


def shown(row: Row) -> str:
    """Return a row of the table."""
    unit = "µrad" if row.figure == "rotation" else "µm"
    shares = " | ".join(f"{100.0 * share:.1f} %" for share in (row.removed, row.mean_removed, row.least_removed))
    inside = ", ".join(f"{count}/{row.machines}" for count in row.inside or () if count is not None)
    expected = "" if row.expected is None else f"{row.expected:.3f} ({inside})"
    verdict = f"{100.0 * row.bar:.0f} % {'met' if row.met else 'MISSED'}"
    return (
        f"| {row.case} | {row.machine} | {row.figure} | {row.before:.2f} {unit} | {row.after:.3f} {unit} "
        f"| {row.largest:.2f} | {shares} | {verdict} | {expected} | {row.seconds:.0f} |"
    )


def main() -> int:
    """Run the cases and print the table."""
    parser = drawn.options(__doc__, 20)
    parser.add_argument("--case", action="append", help="only cases whose name starts so; may be repeated")
    parser.add_argument("--kind", help="only these kinds of machine, such as AB")
    parser.add_argument("--json", action="store_true", help="JSON instead of a table")
    args = parser.parse_args()
    chosen = [
        n
        for n, case in enumerate(CASES)
        if (not args.case or case.name.startswith(tuple(args.case))) and case.machine in (args.kind or case.machine)
    ]
    rows = []
    if not args.json:
        print(HEADER + "\n" + "|---" * 3 + "|---:" * 9 + "|", flush=True)
    for n, done in drawn.results(one_machine, chosen, args):
        rows.append(summed_up(CASES[n], done))
        if not args.json:
            drawn.show(shown(rows[-1]))
    if args.json:
        print(json.dumps([asdict(row) for row in rows], indent=1))
    return 0 if all(row.met for row in rows) else 1


if __name__ == "__main__":
    sys.exit(main())
