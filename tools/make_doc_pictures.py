#!/usr/bin/env python3
"""Make the pictures of doc/theory.md, all of them from the code and the files that the page is about.

Run from the project's root: ``python -m tools.make_doc_pictures [--out FOLDER]``. Two runs with the same
matplotlib give identical files.
"""

from __future__ import annotations

import argparse
import sys
from dataclasses import replace
from pathlib import Path

import matplotlib
import numpy as np
from matplotlib.figure import Figure

from hexapod_comp.geometry import HexapodGeometry, load_geometry
from hexapod_comp.plotting import direction_figure, machine_figure, weights_figure
from hexapod_comp.pose import Pose

ROOT = Path(__file__).resolve().parents[1]

EXAMPLE_TOOL = Pose.from_angles([0.0, 0.0, 0.12], np.zeros(3))
EXAMPLE_WORK = Pose.from_angles([0.15, -0.12, 0.0], np.deg2rad([0.0, 0.0, 20.0]))
"""Frames that the paper's machine does not have; drawn to show what the names mean."""


def machine_picture(geometry: HexapodGeometry) -> Figure:
    """Return the paper's machine with its three dimensions and the four frames."""
    figure = machine_figure(replace(geometry, tool=EXAMPLE_TOOL, work=EXAMPLE_WORK))
    base, platform = geometry.base_joints * 1e3, geometry.platform_joints * 1e3
    above = figure.axes[1]
    sides = ("b", base[2], base[3]), ("d", base[1], base[2]), ("a", platform[0], platform[4])
    for name, first, second in sides:
        x, y = 0.5 * (first + second)[:2]
        side = np.linalg.norm(first - second)
        box = {"facecolor": "white", "edgecolor": "none", "pad": 1.0}
        above.text(x, y, f"{name} = {side:g} mm", ha="center", va="center", bbox=box)
    return figure


def main(arguments: list[str] | None = None) -> int:
    """Make all pictures."""
    parser = argparse.ArgumentParser(description="make the pictures of doc/theory.md")
    parser.add_argument("--out", type=Path, default=ROOT / "doc" / "pictures", help="folder")
    out = parser.parse_args(arguments).out
    out.mkdir(parents=True, exist_ok=True)
    # Without these two every run writes other identifiers and another date.
    matplotlib.rcParams["svg.hashsalt"] = "hexapod_comp"
    pictures = {
        "machine.svg": machine_picture(load_geometry(ROOT / "config" / "paper.yaml")),
        "weights.svg": weights_figure(),
        "direction.svg": direction_figure(),
    }
    for name, figure in pictures.items():
        figure.savefig(out / name, metadata={"Date": None})
        print(out / name)
    return 0


if __name__ == "__main__":
    sys.exit(main())
