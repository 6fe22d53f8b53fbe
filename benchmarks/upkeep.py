"""Checks and repairs of models: machines are fitted, then changed, checked with few readings, and repaired.

Usage: python -m benchmarks.upkeep [--machines 100] [--foreign 5] [--drifting 20] [--workers 2] [--save FILE]

``--save`` appends the results of each machine to a file, and skips machines that are in the file; ``--machines 0
--foreign 0 --save FILE`` prints a file's results. Changes and targets: doc/benchmarks.md.
"""

from __future__ import annotations

import json
import sys
from collections import Counter
from dataclasses import replace
from functools import partial
from itertools import pairwise
from pathlib import Path

import numpy as np

from benchmarks import drawn, table
from benchmarks.calibration import LARGE, LEAD
from benchmarks.drawn import with_wavy_field
from hexapod_comp.calibration.changes import AGEING, DATUM, OTHER, STRUT, TEMPERATURE
from hexapod_comp.calibration.check import (
    NAMED,
    UNDECIDED,
    UNEXPLAINED,
    VALID,
    Verification,
    refusal,
    update_model,
    verify_model,
)
from hexapod_comp.calibration.design import propose_check
from hexapod_comp.calibration.evaluation import held_out
from hexapod_comp.calibration.fit import fit_model
from hexapod_comp.calibration.parameters import FitSettings
from hexapod_comp.machine.geometry import HexapodGeometry, load_geometry
from hexapod_comp.machine.model import MachineModel, RealMachine
from hexapod_comp.measurements.campaign import Campaign, template
from hexapod_comp.measurements.readings import AXES, CHANNELS, FORWARD, MeasurementSet
from hexapod_comp.virtual.imperfections import draw_model
from hexapod_comp.virtual.instruments import measure

# Machines of test/foreign_machines.py: 6-6 with turned frames, hanging, in inches, a telescope's mirror, turning screws
FOREIGN = ("framed", "hanging", "inches", "mirror", "left-hand")
CRASH, POINTS = 20e-6, 200  # size of a change, m; random points at which the error is computed
CHOSEN = "12 chosen"
# Sets of check readings: 12 that the package chooses; 12 and 24 at ends of diagonals and lines
SETS = (CHOSEN, "12", "24")
CHANGES = {"nothing": None, "strut": STRUT, "datum": DATUM, "temperature": TEMPERATURE, "ageing": AGEING,
           "two struts": STRUT}  # fmt: skip
# Changes that no hypothesis describes, with the right answer
UNKNOWN = dict.fromkeys(("platform joint", "base joint", "bend", "backlash"), OTHER)
# Classes of the likeliest kind's probability, for each of which the share of right answers is reported
SHARES = (0.0, 0.5, 0.7, 0.9, 0.99, 1.0)
FALSE_ALARMS, NAMED_RIGHTLY, REPAIRED, CONFIDENTLY_WRONG, RIGHT_OF_NAMED = 0.05, 0.95, 1.5, 0.10, 0.90
DRIFT, CHECK_EVERY, CHECKS = 20e-6, 0.5, 6  # growth of the struts, m/h; period of the checks, h; number of checks


def changed(truth: MachineModel, what: str, geometry: HexapodGeometry, box: np.ndarray, seed: int) -> MachineModel:
    """Return a machine after the change named `what`; `box` is in ``base``, m."""
    rng, struts = np.random.default_rng([seed, 77]), truth.struts

    def one_of(count: int, size: float = CRASH) -> np.ndarray:
        hit = np.zeros(6)
        hit[rng.choice(6, count, replace=False)] = size * rng.choice((-1.0, 1.0), count)
        return hit

    def joint_of(joints: np.ndarray) -> np.ndarray:
        direction = rng.standard_normal(3)
        hit = np.linalg.norm(joints - joints[rng.integers(6)], axis=1) < 1e-6  # coincident joints move together
        return hit[:, None] * CRASH * direction / np.linalg.norm(direction)

    if what in ("strut", "two struts"):
        return replace(truth, struts=replace(struts, offset=struts.offset + one_of(1 + (what == "two struts"))))
    if what == "backlash":
        return replace(truth, struts=replace(struts, backlash=struts.backlash + np.abs(one_of(1))))
    if what == "temperature":
        return warmer(truth, CRASH)
    if what == "datum":
        moved = CRASH * rng.standard_normal(3) + np.cross(50e-6 * rng.standard_normal(3), geometry.base_joints)
        return replace(truth, base_deviation=truth.base_deviation + moved)
    if what == "ageing":
        aged = replace(struts, offset=struts.offset + 5e-6 * rng.standard_normal(6))
        return replace(truth, base_deviation=truth.base_deviation + 5e-6 * rng.standard_normal((6, 3)), struts=aged)
    if what == "platform joint":
        return replace(truth, platform_deviation=truth.platform_deviation + joint_of(geometry.platform_joints))
    if what == "base joint":
        return replace(truth, base_deviation=truth.base_deviation + joint_of(geometry.base_joints))
    return with_wavy_field(truth, box, seed) if what == "bend" else truth


def warmer(truth: MachineModel, growth: float) -> MachineModel:
    """Let the struts grow in proportion to their lengths, by `growth`, m, at home."""
    struts = truth.struts
    share = growth / float(struts.reference_length.mean())
    grown = struts.offset + share * struts.reference_length
    return replace(truth, struts=replace(struts, offset=grown, pitch=struts.pitch + share))


class Machine:
    """A machine with a fitted model and sets of check readings."""

    def __init__(self, name: str, seed: int) -> None:
        if name == "paper":
            self.geometry, self.box = load_geometry(name), drawn.BOX
        else:
            self.geometry, machine = drawn.of_zoo(name)
            self.box = machine.box
        side = float(np.ptp(self.box, axis=0).min())
        self.campaign = Campaign(self.box, side, 0.25 * side, "5-D", 4)
        self.truth = draw_model(self.geometry, LARGE, seed)
        self.seed, self.visits = seed, 1000 * seed
        laid_out = template(self.campaign, self.geometry)
        self.in_base = np.array([laid_out.points().min(axis=0), laid_out.points().max(axis=0)])
        measured = measure(laid_out, self.campaign, RealMachine(self.geometry, self.truth), seed)
        fit = fit_model(measured, FitSettings(lead=LEAD, field_degree=3))
        self.model, self.fitted = fit.model, fit.parameters
        grid = Campaign(self.box, side, side, "5-D", 4)
        self.checks = {CHOSEN: propose_check(self.fitted)}
        self.checks |= {count: self._check(template(grid, self.geometry), int(count)) for count in ("12", "24")}

    def _check(self, grid: MeasurementSet, count: int) -> MeasurementSet:
        """Return check readings at the ends of three body diagonals, and of one line (12) or of three lines (24)."""
        tips = self.geometry.tool_poses(grid.stations.positions, grid.stations.rotations)[0][grid.station]
        wanted = ["diagonal 1", "diagonal 2", "diagonal 4"]
        for axis in AXES if count == 24 else AXES[:1]:
            lines = [n for n, run in enumerate(grid.runs) if run.name.startswith(axis)]
            off = [np.abs(tips[grid.run == n].mean(axis=0)[:2] - self.box.mean(axis=0)[:2]).sum() for n in lines]
            wanted.append(grid.runs[lines[int(np.argmin(np.round(off, 6)))]].name)
        run = np.array([run.name for run in grid.runs])[grid.run]
        along, chosen = grid.along(), np.zeros(len(grid), dtype=bool)
        for name in wanted:
            ends = along[run == name]
            chosen |= (run == name) & (np.isclose(along, ends.min()) | np.isclose(along, ends.max()))
        straight = np.array([CHANNELS[c].startswith("straightness") for c in grid.channel])
        return grid.select(chosen & ~straight & (grid.direction == FORWARD))

    def read(self, truth: MachineModel, count: str) -> MeasurementSet:
        """Return a changed machine's check readings, with new noise in each call."""
        self.visits += 1
        return measure(self.checks[count], self.campaign, RealMachine(self.geometry, truth), self.visits)

    def left(self, truth: MachineModel, model: MachineModel) -> float:
        """Return the tool's RMS error with a model after best-fit alignment, µm."""
        level = self.geometry.work.rotation.T @ self.fitted.space.level @ self.geometry.tool.rotation
        machine = RealMachine(self.geometry, truth)
        return 1e6 * held_out(machine, model, self.box, POINTS, self.seed, level=level).aligned.rms


def answer(verification: Verification, what: str, truth: MachineModel, before: MachineModel) -> dict:
    """Return a check's answer, and the probability of the likeliest kind of change and whether this kind is right.

    The answer is a kind of change, ``undecided``, ``other``, ``valid`` or ``the wrong strut``.
    """
    best = verification.candidates[0]
    right = best.family == (CHANGES | UNKNOWN)[what]
    word = {NAMED: best.family, UNEXPLAINED: OTHER}.get(verification.verdict, verification.verdict)
    moved = np.abs(truth.struts.offset - before.struts.offset)
    another = best.family == STRUT and (moved > 0.0).sum() == 1 and best.name != f"strut_{moved.argmax() + 1}"
    return {
        "what": what,
        "answer": "the wrong strut" if another and verification.verdict == NAMED else word,
        "probability": verification.families[best.family],
        "right": right and not another,
    }


def one_machine(name: str, seed: int, drifting: int) -> dict:
    machine = Machine(name, seed)
    result: dict = {"machine": name, "seed": seed, "fresh": machine.left(machine.truth, machine.model), "checks": []}
    for what in CHANGES | UNKNOWN:
        truth = changed(machine.truth, what, machine.geometry, machine.in_base, seed)
        for count in SETS:
            readings = machine.read(truth, count)
            verification = verify_model(machine.model, machine.fitted, readings)
            result["checks"].append({"readings": count} | answer(verification, what, truth, machine.truth))
            if what == "strut":
                result[f"crashed, {count}"] = machine.left(truth, machine.model)
                if not refusal(verification):
                    renewed = update_model(machine.model, machine.fitted, readings, verification)
                    result[f"repaired, {count}"] = machine.left(truth, renewed.model)
    if seed <= drifting and name == "paper":
        result["drift"] = drift(machine)
    return result


def drift(machine: Machine) -> list[tuple[float, float, float]]:
    """Return hours and errors without and with checks, µm, of a machine whose struts grow steadily."""
    model, fitted, rows = machine.model, machine.fitted, []
    for check in range(1, CHECKS + 1):
        hours = check * CHECK_EVERY
        truth = warmer(machine.truth, DRIFT * hours)
        readings = machine.read(truth, "24")
        verification = verify_model(model, fitted, readings)
        if not refusal(verification):
            renewed = update_model(model, fitted, readings, verification)
            model, fitted = renewed.model, renewed.fitted
        rows.append((hours, machine.left(truth, machine.model), machine.left(truth, model)))
    return rows


def said(results: list[dict], what: str, size: str) -> Counter[str]:
    """Count the answers of the checks with one set of readings after the change `what`."""
    every = (check for result in results for check in result["checks"])
    return Counter(c["answer"] for c in every if (c["what"], c["readings"]) == (what, size))


def others(results: list[dict], what: str, size: str, *answers: str) -> float:
    """Return the share of machines with another answer than `answers`."""
    return sum(count for answer, count in said(results, what, size).items() if answer not in answers) / len(results)


def repair(results: list[dict], size: str) -> tuple[float, float, float, int]:
    """Return the error after a crash and after repair, its ratio to the error of the fit, and the number of repairs."""
    pairs = [(r[f"repaired, {size}"], r["fresh"]) for r in results if f"repaired, {size}" in r]
    after, before = np.sqrt((np.array(pairs or [(np.nan, np.nan)]) ** 2).mean(axis=0))
    crashed = np.sqrt(np.mean([r[f"crashed, {size}"] ** 2 for r in results]))
    return float(crashed), float(after), float(after / before), len(pairs)


def named(results: list[dict], size: str) -> tuple[int, float]:
    """Return the number of checks that name a change, and the share of them that name the right one."""
    checks = [c for r in results for c in r["checks"] if c["readings"] == size]
    right = [c["right"] for c in checks if c["answer"] not in (VALID, UNDECIDED, OTHER)]
    return len(right), float(np.mean(right or [1.0]))


def targets(results: list[dict]) -> list[tuple[str, float, float, bool]]:
    alarms = max(others(results, "nothing", size, VALID) for size in SETS)
    strut, repaired = said(results, "strut", CHOSEN)[STRUT] / len(results), repair(results, CHOSEN)[2]
    wrong = {what: others(results, what, "24", OTHER, UNDECIDED, VALID) for what in UNKNOWN}
    worst = max(wrong, key=lambda what: wrong[what])
    least = min(SETS, key=lambda size: named(results, size)[1])
    right = named(results, least)[1]
    return [
        ("false alarms", alarms, FALSE_ALARMS, alarms <= FALSE_ALARMS),
        ("a strut, 12 chosen readings, named", strut, NAMED_RIGHTLY, strut >= NAMED_RIGHTLY),
        ("repaired, times what the calibration left", repaired, REPAIRED, repaired <= REPAIRED),
        (f"{worst}, 24 readings: named wrongly", wrong[worst], CONFIDENTLY_WRONG, wrong[worst] <= CONFIDENTLY_WRONG),
        (f"share of named changes that are right, {least} readings", right, RIGHT_OF_NAMED, right >= RIGHT_OF_NAMED),
    ]


def report(title: str, results: list[dict]) -> str:
    fresh = np.sqrt(np.mean(np.square([r["fresh"] for r in results])))
    lines = [f"{title}: {len(results)} machines; calibration leaves {fresh:.3f} µm RMS", ""]
    rows = (
        [what, *(", ".join(f"{a} {n}" for a, n in said(results, what, size).items()) for size in SETS)]
        for what in CHANGES | UNKNOWN
    )
    lines += [table(["what happened", *SETS], rows, texts=4), ""]
    for size in SETS:
        crashed, after, times, count = repair(results, size)
        text = f"{crashed:.3f} → {after:.3f} µm, {times:.2f} × fresh, {count} machines"
        lines.append(
            "{} readings: repair {}; {} named, {:.1%} of them rightly".format(size, text, *named(results, size))
        )
        alarms = [c for r in results for c in r["checks"] if c["readings"] == size and c["answer"] != VALID]
        for low, high in pairwise(SHARES):
            there = [c for c in alarms if low <= c["probability"] < high or c["probability"] == high == SHARES[-1]]
            if there:
                stated, right = (np.mean([c[key] for c in there]) for key in ("probability", "right"))
                text = f"{len(there)} checks, stated {stated:.1%}, right {right:.1%}"
                lines.append(f"  likeliest kind {low:g}…{high:g}: {text}")
    drifts = np.array([r["drift"] for r in results if "drift" in r])
    for hours, without, with_checks in np.sqrt((drifts**2).mean(axis=0)) if len(drifts) else ():
        lines.append(f"drift, {hours:.1f} h: {without:.3f} µm without checks, {with_checks:.3f} µm with")
    return "\n".join(lines)


def main() -> int:
    parser = drawn.options(__doc__, 100, of="the paper's kind")
    parser.add_argument("--foreign", type=int, default=5, help="machines of each other kind (default 5)")
    parser.add_argument("--drifting", type=int, default=20, help="number of the machines that also drift (default 20)")
    parser.add_argument("--save", type=Path, metavar="FILE", help="append results; skip machines in the file")
    args = parser.parse_args()
    saved = args.save.read_text(encoding="utf-8").splitlines() if args.save and args.save.exists() else []
    of: dict[str, list[dict]] = {name: [] for name in ("paper", *FOREIGN)}
    for result in map(json.loads, saved):
        of[result["machine"]].append(result)
    tasks = [
        (n, s) for n in of for s in range(args.first, args.first + (args.machines if n == "paper" else args.foreign))
    ]
    tasks = [(name, seed) for name, seed in tasks if seed not in {result["seed"] for result in of[name]}]
    for result in drawn.each(partial(one_machine, drifting=args.drifting), tasks, args.workers):
        of[result["machine"]].append(result)
        if args.save is not None:
            with args.save.open("a", encoding="utf-8") as file:
                file.write(json.dumps(result) + "\n")
    print("\n\n".join(report(name, found) for name, found in of.items() if found))
    met = targets(of["paper"]) if of["paper"] else []
    for name, value, target, good in met:
        print(f"{name}: {value:.3f}, target {target:g}: {'met' if good else 'MISSED'}", file=sys.stderr)
    return 0 if all(target[3] for target in met) else 1


if __name__ == "__main__":
    sys.exit(main())
