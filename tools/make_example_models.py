#!/usr/bin/env python3
"""Make the two example models in config/: the true errors of a virtual machine, and Mou & King's 1-D model of it.

``paper_machine.yaml`` holds the true errors of the shipped virtual machine, drawn from a fixed seed: the paper's
geometry with ±100 µm on every joint coordinate and strut, ±100 ppm of pitch, a 4 µm screw wave of 10 mm period, 3–5 µm
of backlash and a smooth six-component field.

``paper_lines_model.yaml`` is a model of that machine by Mou & King's method: scheme ``lines`` of
:mod:`hexapod_comp.calibration.lines` on the readings of a 1-D laser, taken on the uncompensated machine along the lines
of a 4-inch grid, every inch, forward and backward, three times.

Run it in the project's root: ``python -m tools.make_example_models [--out FOLDER]``. Two runs give identical files.
"""

from __future__ import annotations

import argparse
import hashlib
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np

from hexapod_comp.calibration.evaluation import INCH, ModelEvaluation, evaluate_model, evaluation_text
from hexapod_comp.calibration.lines import fit_lines
from hexapod_comp.machine.geometry import HexapodGeometry, load_geometry
from hexapod_comp.machine.model import MachineModel, ModelOrigin, RealMachine
from hexapod_comp.machine.model_file import load_model, save_model
from hexapod_comp.measurements.campaign import Campaign, template
from hexapod_comp.virtual.imperfections import ImperfectionBounds, draw_model
from hexapod_comp.virtual.instruments import measure

ROOT = Path(__file__).resolve().parents[1]

SEED = 3
DATE = "2025-01-01"
"""Fixed, so that the files do not depend on the day of the run."""

BOX = np.array([[-8.0 * INCH, -8.0 * INCH, 0.350], [8.0 * INCH, 8.0 * INCH, 0.350 + 8.0 * INCH]]).round(6)
"""The paper's measured box: ±203.2 mm, ±203.2 mm, 203.2 mm upwards from 350 mm."""

BOUNDS = ImperfectionBounds(
    joint=100e-6,
    strut_offset=100e-6,
    pitch=100e-6,
    wave=(4e-6, 4e-6),
    wave_period=0.01,
    backlash=(3e-6, 5e-6),
    field_displacement=3e-6,
    field_rotation=5e-6,
    field_reversal=0.2,
    field_box=BOX,
)

CAMPAIGN = Campaign(BOX, cell=4 * INCH, step=INCH, instrument="1-D", diagonals=0, cycles=3)
"""The paper's lines, read by a 1-D laser with 1 µm of noise."""


def make_machine(geometry: HexapodGeometry) -> MachineModel:
    """Return the virtual machine's true errors, rounded to be readable in a file (field: 0.1 nm, all others: 1 nm)."""
    drawn = draw_model(geometry, BOUNDS, SEED, "virtual machine")
    s = drawn.struts
    struts = replace(
        s,
        offset=tidy(s.offset, 3),
        pitch=tidy(s.pitch, 3),
        reference_length=s.reference_length.round(6),
        cosine=tidy(s.cosine, 3),
        sine=tidy(s.sine, 3),
        backlash=tidy(s.backlash, 3),
    )
    x, y, z = (nodes.round(6) for nodes in drawn.field.grid)
    along_x, along_y, along_z = (tidy(family, 4) for family in drawn.field.lines)
    note = (
        f"Hidden truth of the shipped virtual machine, seed {SEED}, by tools/make_example_models.py: "
        "+-100 um joints and struts, +-100 ppm pitch, 4 um wave, 3-5 um backlash, field of 3 um and 5 urad."
    )
    return replace(
        drawn,
        base_deviation=tidy(drawn.base_deviation, 3),
        platform_deviation=tidy(drawn.platform_deviation, 3),
        struts=struts,
        field=replace(drawn.field, grid=(x, y, z), lines=(along_x, along_y, along_z)),
        origin=ModelOrigin(date=DATE, note=note),
    )


def tidy(values: np.ndarray, decimals: int) -> np.ndarray:
    """Return values rounded to some decimals of a millionth, the decimals of µm, µrad or ppm in a file."""
    return np.round(values * 1e6, decimals) / 1e6


def make_lines_model(truth: RealMachine, truth_hash: str) -> tuple[MachineModel, ModelEvaluation]:
    """Return Mou & King's 1-D model of a machine, and the error that this model leaves."""
    measured = measure(template(CAMPAIGN, truth.geometry), CAMPAIGN, truth, SEED)
    model = fit_lines(measured, date=DATE, name="paper's 1-D lines").model
    x, y, z = (tidy(family, 4) for family in model.field.lines)
    model = replace(model, field=replace(model.field, lines=(x, y, z)))
    found = evaluate_model(truth, model, BOX)
    note = (
        "The scheme of Mou & King (1998) on simulated laser lines of paper_machine.yaml (1 um noise, 3 runs), by "
        "tools/make_example_models.py. Datum: every line is zero (mean of both directions) at home's "
        "coordinate along it. Before and after, um: 3-D RMS "
        f"{micrometres(found.before.raw.rms, found.after.raw.rms)}; after best-fit alignment "
        f"{micrometres(found.before.aligned.rms, found.after.aligned.rms)}; along lines "
        f"{micrometres(found.paper.before, found.paper.after)}."
    )
    origin = ModelOrigin(DATE, (("paper_machine.yaml", truth_hash),), round(found.after.raw.rms, 9), note)
    return replace(model, origin=origin), found


def micrometres(before: float, after: float) -> str:
    """Return two lengths as text, in µm."""
    return f"{before * 1e6:.1f} and {after * 1e6:.1f}"


def main(arguments: list[str] | None = None) -> int:
    """Write both files, and print the error that the lines model leaves."""
    parser = argparse.ArgumentParser(description="make config/paper_machine.yaml and paper_lines_model.yaml")
    parser.add_argument("--out", type=Path, default=ROOT / "config", help="folder for both files (default: config/)")
    out = parser.parse_args(arguments).out
    geometry = load_geometry(ROOT / "config" / "paper.yaml")
    machine_file = out / "paper_machine.yaml"
    save_model(make_machine(geometry), machine_file)
    # Measure the machine in the file: the machine in memory may differ from it by a rounding.
    truth = RealMachine(geometry, load_model(machine_file, geometry))
    digest = hashlib.sha256(machine_file.read_bytes()).hexdigest()
    model, found = make_lines_model(truth, digest)
    save_model(model, out / "paper_lines_model.yaml")
    print(evaluation_text(found))
    return 0


if __name__ == "__main__":
    sys.exit(main())
