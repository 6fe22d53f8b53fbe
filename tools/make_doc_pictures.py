#!/usr/bin/env python3
"""Draw the pictures of doc/ by the code and from the files that the pages describe.

Run it in the project's root: ``python -m tools.make_doc_pictures [--out FOLDER]``; it takes a minute, for two
calibrations. Two runs with the same libraries on the same number of threads give identical files.
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
"""Example tool and work frames, drawn to explain the names; the paper's machine has neither."""

SEED, LEAD = 1, 0.01
"""The virtual instruments' seed and the screws' lead, m, of the calibrations in doc/calibration.md."""


def direction_figure() -> Figure:
    """Return the direction of motion that the code gives a noisy axis while it moves forward, rests, and moves back."""
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
    """Return a picture of the paper's machine with its three dimensions and the four frames."""
    return configuration_figure(replace(geometry, tool=EXAMPLE_TOOL, work=EXAMPLE_WORK))


def measured(geometry: HexapodGeometry, name: str) -> MeasurementSet:
    """Return the readings that ``hexapod_comp simulate --campaign NAME --seed 1`` writes."""
    campaign = load_campaign(ROOT / "config" / f"{name}.yaml")
    truth = RealMachine(geometry, load_model(ROOT / "config" / "paper_machine.yaml", geometry))
    return measure(template(campaign, geometry, SEED), campaign, truth, SEED)


def strut_error_picture(fit: ModelFit, one_d: MeasurementSet) -> Figure:
    """Return Mou & King's Figures 3 and 4 by scheme lines from 1-D and from 5-D lines, and by the joint fit."""
    models = {
        "lines, 1-D": fit_lines(one_d).model,
        "lines, 5-D": fit_lines(fit.measurements).model,
        "joint, 5-D": fit.model,
    }
    # In the middle, mirrored struts would have the same curve in the 1-D model.
    return strut_error_figure(one_d.geometry, models, y=LINE_Y)


def shells_picture() -> Figure:
    """Return shells of the workspace coloured by the effect of screw 1's pitch error (v. Daake et al., Figure 2)."""
    (figure,) = daake.shells(load_geometry(daake.MACHINE)).figures.values()
    return figure


def main(arguments: list[str] | None = None) -> int:
    """Draw and write all pictures."""
    parser = argparse.ArgumentParser(description="make the pictures of doc/")
    parser.add_argument("--out", type=Path, default=ROOT / "doc" / "pictures", help="folder")
    out = parser.parse_args(arguments).out
    out.mkdir(parents=True, exist_ok=True)
    # A fixed salt here and no date below: otherwise every run writes other identifiers and another date.
    matplotlib.rcParams["svg.hashsalt"] = "hexapod_comp"
    geometry = load_geometry(ROOT / "config" / "paper.yaml")
    fit = fit_model(measured(geometry, "campaign_5d"), FitSettings(lead=LEAD))
    pictures = {
        "machine.svg": machine_picture(geometry),
        "weights.svg": weights_figure(),
        "direction.svg": direction_figure(),
        "joint_fit.svg": fit_figure(fit),
        "strut_errors.svg": strut_error_picture(fit, measured(geometry, "campaign_1d")),
        "example_6_6.png": overview_figure(
            overview(load_geometry("example_6_6"))
        ),  # PNG: an SVG has a point for every face
        "shells_screw_pitch.png": shells_picture(),  # PNG: thousands of faces are a large SVG file
    }
    for name, figure in pictures.items():
        figure.savefig(out / name, metadata={"Date": None})
        print(out / name)
    return 0


if __name__ == "__main__":
    sys.exit(main())
