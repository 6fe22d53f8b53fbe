"""Speed side by side in one run: kinematics, batches, convergence, model blocks, the compensator beside a relay.

``python -m benchmarks.speed`` measures (six minutes), prints, and exits 1 when a bar is missed. With ``--doc`` it also
renews the tables of doc/speed.md and its picture, doc/pictures/speed.png; that takes LinuxCNC's kinematics.
"""

from __future__ import annotations

import argparse
import os
import platform
import re
import sys
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from hexapod_comp.formats.figures import WITH, WITHOUT, save
from hexapod_comp.formats.outputs import write_text

from . import c_core, cannot_run, genhexkins, judged, kinematics, loop
from .kinematics import INVERSE, NEAR, OURS, WIDE

DOC = Path(__file__).resolve().parents[1] / "doc"
PACKAGES = ("numpy", "scipy", "mujoco", "mujoco-core", "pin", "ros-jazzy-rclpy")
OTHERS = "#8d99a6"


def surroundings() -> str:
    """Return what the figures depend on."""
    lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    model = next((line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")), "unknown")
    found = [f"processor {os.cpu_count()} × {model}", f"Python {platform.python_version()}"]
    for name in PACKAGES:
        try:
            found.append(f"{name} {version(name)}")
        except PackageNotFoundError:
            continue
    return f"Measured on: {', '.join(found)}, load before the run {os.getloadavg()[0]:.1f}."


def renewed(page: str, where: str, report: str, problems: list[str]) -> str:
    """Return doc/speed.md with other figures: its tables stand there in the report's order."""
    tables = iter(re.findall(r"(?:^\|.*\n)+", report + "\n", re.MULTILINE))
    page = re.sub(r"(?:^\|.*\n)+", lambda _: next(tables), page, flags=re.MULTILINE)
    verdict = "\n".join(["Bars missed in this run:", "", *(f"- {text}" for text in problems)])
    page = re.sub(r"^Measured on: .*$", where, page, flags=re.MULTILINE)
    return re.sub(
        r"^(Bars missed.*?|All bars.*?)\n\n(?=## )",
        f"{verdict if problems else 'All bars are kept.'}\n\n",
        page,
        flags=re.MULTILINE | re.DOTALL,
    )


def picture(
    timed: list[kinematics.Result], shares: list[list[float]], costs: dict[str, np.ndarray], beside: list[loop.Row]
) -> Figure:
    """Show kinematics, convergence, cost of blocks, and latency beside the relay."""
    figure = Figure(figsize=(12, 9.5), layout="constrained")
    left, right = figure.subfigures(1, 2)
    show_times(left.subplots(1, 1), timed)
    above, middle, below = right.subplots(3, 1)
    above.set(title="Solved from 1 mm and 1 mrad away", xlabel="yaw, °", ylabel="solved, %")
    for line, colour, who, solved in zip(
        "os", (WITH, WITHOUT), (OURS, "genhexkins"), np.transpose(shares), strict=True
    ):
        above.plot(kinematics.YAWS, 100.0 * solved, f"{line}-", color=colour, label=who)
    above.legend(loc="center left")
    rows = np.arange(len(costs))
    middle.barh(rows - 0.2, [cost[0] for cost in costs.values()], 0.4, color=WITH, label="command")
    middle.barh(rows + 0.2, [cost[1] for cost in costs.values()], 0.4, color=OTHERS, label="estimate")
    middle.set_yticks(rows, [*costs], fontsize=8)
    middle.set(title="A command and a warm estimate, with one block each", xlabel="µs, in C")
    middle.invert_yaxis()
    middle.legend(loc="lower right")
    places = np.arange(len(beside))
    medians, tails = [row.median_ratio for row in beside], [row.p99_ratio for row in beside]
    shown = ((-0.15, medians, WITH, "median", loop.BAR_MEDIAN), (0.15, tails, OTHERS, "99th percentile", loop.BAR_P99))
    for shift, ratios, colour, label, bar in shown:  # with quartiles and bars
        low, mid, high = np.array(ratios).T
        below.errorbar(places + shift, mid, [mid - low, high - mid], fmt="o", color=colour, label=label, capsize=3)
        below.axhline(bar, color=colour, linestyle="--", linewidth=1.0)
    below.axhline(1.0, color="black", linewidth=0.8)
    below.set_xticks(places, [row.name if row.name == "flat out" else f"{row.name} Hz" for row in beside])
    below.set(title="Latency: compensator ÷ idle relay (dashed: bar)", ylabel="ratio")
    below.legend(loc="upper center")
    return figure


def show_times(axes: Axes, results: list[kinematics.Result]) -> None:
    """Draw time per pose, a group of dots per task and shape: bars would begin nowhere on a logarithmic axis."""
    place, places, names = 0.0, [], []
    for task, shape in [(t, s) for s in ("batch", "single") for t in (INVERSE, WIDE, NEAR)]:
        rows = [r for r in results if (r.task, r.shape) == (task, shape)]
        for r in rows:
            colour = WITH if r.name == OURS else WITHOUT if "genhexkins" in r.name else OTHERS
            axes.plot(r.us_per_pose, place, "o", color=colour, markersize=7)
            axes.text(1.25 * r.us_per_pose, place, f"{r.us_per_pose:.3g}", va="center", fontsize=7)
            places.append(place)
            names.append(r.name)
            place += 1.0
        if rows:
            at = place - len(rows) - 0.6
            title = {"transform": axes.get_yaxis_transform(), "ha": "right", "va": "bottom", "fontweight": "bold"}
            axes.text(0.99, at, f"{task}, {shape}", **title)
        place += 1.2
    axes.set_yticks(places, names, fontsize=7)
    axes.set(xscale="log", xlabel="processor time, µs a pose", title="Kinematics")
    axes.set_xlim(right=6.0 * axes.get_xlim()[1])
    axes.invert_yaxis()
    axes.grid(axis="x", which="major", alpha=0.4)


def main() -> int:
    """Measure, print, and write what was asked for; exit 1 when a bar is missed."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--doc", action="store_true", help="renew the tables of doc/speed.md, and its picture")
    parser.add_argument("--quick", action="store_true", help="a tenth of the time, for trying")
    options = parser.parse_args()
    where, rounds, bouts = surroundings(), *((3, 1) if options.quick else (25, 10))
    timed, text, problems = kinematics.times(500, 20_000, rounds)
    parts = [(text, problems), kinematics.batches(*((1_000_000, 0.4) if options.quick else ()))]
    try:
        shares, text, problems = kinematics.convergences()
        parts.append((text, problems))
    except genhexkins.NotHere as reason:
        if options.doc:
            return cannot_run(str(reason))
    costs, text, problems = c_core.times(3 if options.quick else 15)
    parts.append((text, problems))
    beside, floor = (loop.measure(max(1, n), 6, 0.4, floor) for n, floor in ((bouts, False), (bouts // 3, True)))
    parts += [(loop.report(beside), loop.problems(beside))]
    parts.append((loop.report(floor), []))
    report, problems = "\n\n".join(text for text, _ in parts), [one for _, missed in parts for one in missed]
    print(where, report, sep="\n\n")
    if options.doc:
        page = DOC / "speed.md"
        write_text(page, renewed(page.read_text(encoding="utf-8"), where, report, problems))
        save(picture(timed, shares, costs, beside), DOC / "pictures" / "speed.png")
    return judged(problems)


if __name__ == "__main__":
    sys.exit(main())
