#!/usr/bin/env python3
"""Make the pictures of doc/, all of them from the code and the files that the pages are about.

Run from the project's root: ``python -m tools.make_doc_pictures [--out FOLDER]``; the two of calibrations take a
minute. Two runs with the same libraries on the same number of threads give identical files.
"""

from __future__ import annotations

import argparse
import sys
from dataclasses import replace
from pathlib import Path

import matplotlib
import numpy as np
from matplotlib.figure import Figure

from examples.papers import daake
from examples.papers.mou_king import LINE_Y
from examples.papers.pictures import configuration_figure, weights_figure
from hexapod_comp.calibration.fit import ModelFit, fit_model
from hexapod_comp.calibration.lines import fit_lines
from hexapod_comp.calibration.parameters import FitSettings
from hexapod_comp.calibration.pictures import fit_figure, strut_error_figure
from hexapod_comp.core.batch import follow
from hexapod_comp.formats.figures import WITH, WITHOUT
from hexapod_comp.machine.geometry import HexapodGeometry, load_geometry
from hexapod_comp.machine.model import RealMachine
from hexapod_comp.machine.model_file import load_model
from hexapod_comp.measurements.campaign import load_campaign, template
from hexapod_comp.measurements.readings import MeasurementSet
from hexapod_comp.pose import Pose
from hexapod_comp.virtual.instruments import measure
from hexapod_comp.workspace.overview import overview
from hexapod_comp.workspace.pictures import overview_figure

ROOT = Path(__file__).resolve().parents[1]

EXAMPLE_TOOL = Pose.from_angles([0.0, 0.0, 0.12], np.zeros(3))
EXAMPLE_WORK = Pose.from_angles([0.15, -0.12, 0.0], np.deg2rad([0.0, 0.0, 20.0]))
"""Frames that the paper's machine does not have; drawn to show what the names mean."""

SEED, LEAD = 1, 0.01
"""Of the calibrations shown, as doc/calibration.md has them: the virtual instruments' seed; the screws' lead, m."""


def direction_figure() -> Figure:
    """Show the direction of motion that the code gives a noisy axis: there, at rest, and back."""
    threshold = 2.0
    there = np.concatenate([np.linspace(0.0, 12.0, 60), np.full(60, 12.0), np.linspace(12.0, 3.0, 60)])
    values = there + 0.3 * np.random.default_rng(1).standard_normal(len(there))
    low, sense = follow(threshold, values)
    figure = Figure(figsize=(7, 4), layout="constrained")
    upper, lower = figure.subplots(2, 1, sharex=True, height_ratios=[3, 1])
    number, window = np.arange(len(values)), low
    upper.fill_between(number, window, window + threshold, color=WITH, alpha=0.25, label="window")
    upper.plot(values, color="black", lw=0.8, label="value, with noise")
    upper.set(ylabel="µm")
    upper.legend()
    lower.step(number, sense, where="post", color=WITHOUT)
    lower.set(xlabel="command", ylabel="direction", yticks=[-1, 0, 1])
    return figure


def machine_picture(geometry: HexapodGeometry) -> Figure:
    """Return the paper's machine with its three dimensions and the four frames."""
    return configuration_figure(replace(geometry, tool=EXAMPLE_TOOL, work=EXAMPLE_WORK))


def measured(geometry: HexapodGeometry, name: str) -> MeasurementSet:
    """Return what ``hexapod_comp simulate --campaign NAME --seed 1`` reads."""
    campaign = load_campaign(ROOT / "config" / f"{name}.yaml")
    truth = RealMachine(geometry, load_model(ROOT / "config" / "paper_machine.yaml", geometry))
    return measure(template(campaign, geometry, SEED), campaign, truth, SEED)


def strut_error_picture(fit: ModelFit, one_d: MeasurementSet) -> Figure:
    """Return Mou & King's Figures 3 and 4, from 1-D and from 5-D lines, and the same as the joint fit has it."""
    models = {
        "lines, 1-D": fit_lines(one_d).model,
        "lines, 5-D": fit_lines(fit.measurements).model,
        "joint, 5-D": fit.model,
    }
    # Off the middle, where displacements along x alone give mirrored struts the same curve.
    return strut_error_figure(one_d.geometry, models, y=LINE_Y)


def shells_picture() -> Figure:
    """Show what an error of the first screw's pitch does to the unit's tool (v. Daake et al., Figure 2)."""
    (figure,) = daake.shells(load_geometry(daake.MACHINE)).figures.values()
    return figure


def main(arguments: list[str] | None = None) -> int:
    """Make all pictures."""
    parser = argparse.ArgumentParser(description="make the pictures of doc/")
    parser.add_argument("--out", type=Path, default=ROOT / "doc" / "pictures", help="folder")
    out = parser.parse_args(arguments).out
    out.mkdir(parents=True, exist_ok=True)
    # Without these two every run writes other identifiers and another date.
    matplotlib.rcParams["svg.hashsalt"] = "hexapod_comp"
    geometry = load_geometry(ROOT / "config" / "paper.yaml")
    fit = fit_model(measured(geometry, "campaign_5d"), FitSettings(lead=LEAD))
    pictures = {
        "machine.svg": machine_picture(geometry),
        "weights.svg": weights_figure(),
        "direction.svg": direction_figure(),
        "joint_fit.svg": fit_figure(fit),
        "strut_errors.svg": strut_error_picture(fit, measured(geometry, "campaign_1d")),
        "example_6_6.png": overview_figure(overview(load_geometry("example_6_6"))),  # a point for every face
        "shells_screw_pitch.png": shells_picture(),  # thousands of faces: a large file as SVG
    }
    for name, figure in pictures.items():
        figure.savefig(out / name, metadata={"Date": None})
        print(out / name)
    return 0


if __name__ == "__main__":
    sys.exit(main())
