#!/usr/bin/env python3
"""Make the two example models in config/: a virtual machine's truth, and the paper's 1-D model of it.

``paper_machine.yaml`` is the hidden truth of the shipped virtual machine, drawn from a fixed seed: the
paper's geometry with ±100 µm on every joint coordinate and strut, ±100 ppm of pitch, a 4 µm screw wave of
10 mm period, 3–5 µm of backlash and a smooth six-component field.

``paper_lines_model.yaml`` is what paper 001 would make of that machine: it is run uncompensated along the
lines of a 4-inch grid, a laser reads the displacement along each line every inch, forward and backward,
three times, and a polynomial is fitted to the mean of each line and direction. Lines along x give only dx,
along y only dy, along z only dz.

Datum. A 1-D laser reads the way from a line's first point, so each line has an unknown zero: how the
x-lines' zeros differ from each other is straightness and squareness, and no 1-D line sees it. Every line is
shifted so that it is zero, in the mean of both directions, where it passes home's coordinate along the
line (x = 0, y = 0, z = 400 mm). Backlash so stays in, half to each direction; what the three planes through
home do themselves stays unknown, and remains as error.

Run from the project's root: ``python -m tools.make_example_models [--out FOLDER]``. Two runs give identical
files.
"""

from __future__ import annotations

import argparse
import hashlib
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.polynomial import Polynomial
from scipy.spatial.transform import Rotation

from hexapod_comp.field import CROSS_AXES, GridField
from hexapod_comp.geometry import HexapodGeometry, load_geometry
from hexapod_comp.imperfections import ImperfectionBounds, draw_model
from hexapod_comp.kinematics import Structure, jacobian
from hexapod_comp.machine import MachineModel, ModelOrigin, RealMachine
from hexapod_comp.model_file import load_model, save_model
from hexapod_comp.motion import MotionState
from hexapod_comp.pose import Pose

ROOT = Path(__file__).resolve().parents[1]

SEED = 3
DATE = "2025-01-01"
"""Fixed, so that the files do not change with the day on which they are made."""

INCH = 0.0254
GRID = (
    4 * INCH * np.arange(-2, 3),
    4 * INCH * np.arange(-2, 3),
    np.round(0.350 + 4 * INCH * np.arange(3), 6),
)
"""Nodes along x, y, z, m: ±203.2 mm, ±203.2 mm, 203.2 mm upwards from 350 mm."""
BOX = np.array([[nodes[0] for nodes in GRID], [nodes[-1] for nodes in GRID]])

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

LASER_NOISE = 1e-6
"""Standard deviation of one laser reading, m."""
RUNS = 3
READINGS_PER_COEFFICIENT = 3
"""A line of 17 readings gets 5 coefficients, one of 9 gets 3: no more than the readings can carry."""

HELD_OUT_POINTS = 1000
CHECK_LINES = 20
"""Lines along each axis, away from the grid, on which the paper's own metric is taken."""

Run = Callable[[Pose, np.ndarray], Pose]
"""Takes a commanded platform pose and the direction of motion (3,); returns where the platform goes."""


def make_machine(geometry: HexapodGeometry) -> MachineModel:
    """Return the virtual machine's truth, rounded to what people can read (field: 0.1 nm, else 1 nm)."""
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
    """Return values rounded to decimals of a millionth: they then stand in a file as µm, µrad or ppm."""
    return np.round(values * 1e6, decimals) / 1e6


def senses(geometry: HexapodGeometry, pose: Pose, direction: np.ndarray) -> np.ndarray:
    """Return the directions of motion, shape (9,), of a platform that passes a pose in a direction (3,).

    Axes along which it does not move have none (0: the mean of both); the struts' come from the Jacobian.
    """
    speeds = jacobian(Structure.of(geometry), pose)[:, :3] @ direction
    return np.concatenate([np.sign(direction), np.sign(speeds)])


def uncompensated(truth: RealMachine) -> Run:
    """Return the machine as it is, told nominal strut lengths."""

    def run(target: Pose, direction: np.ndarray) -> Pose:
        return truth.nominal_error(target, senses(truth.geometry, target, direction))

    return run


def compensated(truth: RealMachine, model: MachineModel) -> Run:
    """Return the machine told what a model says."""
    believed = RealMachine(truth.geometry, model)

    def run(target: Pose, direction: np.ndarray) -> Pose:
        motion = MotionState()
        motion.sense[:] = senses(truth.geometry, target, direction)
        commands, _, _ = believed.commands_for(target, motion)
        return truth.pose_for(commands, senses(truth.geometry, target, direction), target)[0]

    return run


def line_errors(run: Run, axis: int, points: np.ndarray) -> np.ndarray:
    """Return the displacement error along a line, m, shape (2, n): forward, backward; points (n, 3)."""
    errors = np.empty((2, len(points)))
    for row, sign in enumerate((1.0, -1.0)):
        direction = sign * np.eye(3)[axis]
        for column, point in enumerate(points):
            errors[row, column] = run(Pose(point, np.eye(3)), direction).position[axis] - point[axis]
    return errors


def read_line(run: Run, axis: int, points: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Return a laser's readings on a line, means of the runs, m, shape (2, n); 0 at the first reading."""
    errors = line_errors(run, axis, points)
    readings = errors + LASER_NOISE * rng.standard_normal((RUNS, *errors.shape))
    return (readings - readings[:, :1, :1]).mean(axis=0)


def points_along(axis: int, across: tuple[float, float], coordinates: np.ndarray) -> np.ndarray:
    """Return the points of a line along an axis, shape (n, 3), at its two other coordinates."""
    points = np.empty((len(coordinates), 3))
    points[:, axis] = coordinates
    points[:, CROSS_AXES[axis]] = across
    return points


def fit_line(coordinates: np.ndarray, readings: np.ndarray, datum: float) -> np.ndarray:
    """Return the coefficients in u of both directions, shape (2, K), their mean zero at the datum."""
    degree = len(coordinates) // READINGS_PER_COEFFICIENT - 1
    domain = [coordinates[0], coordinates[-1]]
    lines = [Polynomial.fit(coordinates, row, degree, domain=domain) for row in readings]
    zero = 0.5 * (lines[0](datum) + lines[1](datum))
    return np.array([(line - zero).coef for line in lines])


def fit_family(run: Run, axis: int, datum: float, rng: np.random.Generator) -> np.ndarray:
    """Return the coefficients of all lines along an axis, as :class:`GridField` wants them."""
    first, second = (GRID[a] for a in CROSS_AXES[axis])
    count = round((GRID[axis][-1] - GRID[axis][0]) / INCH) + 1
    coordinates = np.linspace(GRID[axis][0], GRID[axis][-1], count)
    family = np.zeros((2, len(first), len(second), 6, count // READINGS_PER_COEFFICIENT))
    for i, a in enumerate(first):
        for j, b in enumerate(second):
            readings = read_line(run, axis, points_along(axis, (a, b), coordinates), rng)
            family[:, i, j, axis] = fit_line(coordinates, readings, datum)
    return tidy(family, 4)


def make_lines_model(truth: RealMachine, truth_hash: str) -> tuple[MachineModel, list[str]]:
    """Return the paper's 1-D model of a machine, and the lines of a report on what it is worth."""
    rng = np.random.default_rng(SEED)
    home = truth.geometry.home.position
    x, y, z = (fit_family(uncompensated(truth), axis, home[axis], rng) for axis in range(3))
    model = MachineModel(
        truth.geometry.name, "paper's 1-D lines", field=GridField(GRID, (x, y, z)), valid_box=BOX
    )
    before, after = uncompensated(truth), compensated(truth, model)
    (raw_before, fit_before), (raw_after, fit_after) = held_out(before), held_out(after)
    own_before, own_after = paper_metric(before, home), paper_metric(after, home)
    report = [
        f"RMS 3-D error at {HELD_OUT_POINTS} points, both directions: {gain(raw_before, raw_after)}",
        f"the same after rigid alignment of the datum: {gain(fit_before, fit_after)}",
        f"the paper's metric (mean |linear displacement error|): {gain(own_before, own_after)}",
    ]
    note = (
        "Paper 001's scheme on simulated laser lines of paper_machine.yaml (1 um noise, 3 runs), by "
        "tools/make_example_models.py. Datum: every line is zero (mean of both directions) at home's "
        f"coordinate along it. Before and after, um: 3-D RMS {micrometres(raw_before, raw_after)}; rigidly "
        f"aligned {micrometres(fit_before, fit_after)}; along lines {micrometres(own_before, own_after)}."
    )
    origin = ModelOrigin(DATE, (("paper_machine.yaml", truth_hash),), round(raw_after, 9), note)
    return replace(model, origin=origin), report


def held_out(run: Run) -> tuple[float, float]:
    """Return the RMS 3-D error at random points of the box, m: as it is, and after rigid alignment.

    The tool passes each point along the space diagonal, forward on all axes and then backward, so that
    every axis has a direction. The alignment is one rotation and shift for all points and directions.
    """
    rng = np.random.default_rng(SEED + 1)
    points = rng.uniform(BOX[0], BOX[1], (HELD_OUT_POINTS, 3))
    actual = np.array(
        [run(Pose(p, np.eye(3)), np.full(3, sign)).position for sign in (1.0, -1.0) for p in points]
    )
    wanted = np.tile(points, (2, 1))
    centre, mean = wanted.mean(axis=0), actual.mean(axis=0)
    turn, _ = Rotation.align_vectors(wanted - centre, actual - mean)
    return rms(actual - wanted), rms(turn.apply(actual - mean) + centre - wanted)


def paper_metric(run: Run, home: np.ndarray) -> float:
    """Return 001's measure, m: the mean |displacement error| along lines parallel to the grid.

    The lines run at random places between the grid's and are read half an inch off the fitted readings,
    both directions; each has its zero where the model's lines have theirs.
    """
    rng = np.random.default_rng(SEED + 2)
    errors = []
    for axis in range(3):
        low, high = BOX[:, axis]
        coordinates = np.append(np.arange(low + 0.5 * INCH, high, INCH), home[axis])
        for _ in range(CHECK_LINES):
            a, b = (rng.uniform(BOX[0, cross], BOX[1, cross]) for cross in CROSS_AXES[axis])
            line = line_errors(run, axis, points_along(axis, (a, b), coordinates))
            errors.append((line[:, :-1] - line[:, -1].mean()).ravel())
    return float(np.abs(np.concatenate(errors)).mean())


def rms(vectors: np.ndarray) -> float:
    """Return the root mean square length of (n, 3) vectors."""
    return float(np.sqrt((vectors**2).sum(axis=1).mean()))


def micrometres(before: float, after: float) -> str:
    """Return two lengths as text."""
    return f"{before * 1e6:.1f} and {after * 1e6:.1f}"


def gain(before: float, after: float) -> str:
    """Return a before-and-after comparison as text."""
    return f"{before * 1e6:.2f} um -> {after * 1e6:.2f} um ({100.0 * (1.0 - after / before):.1f} % less)"


def main(arguments: list[str] | None = None) -> int:
    """Make both files and print what the lines model is worth."""
    parser = argparse.ArgumentParser(description="make config/paper_machine.yaml and paper_lines_model.yaml")
    parser.add_argument("--out", type=Path, default=ROOT / "config", help="folder; by default the project's")
    out = parser.parse_args(arguments).out
    geometry = load_geometry(ROOT / "config" / "paper.yaml")
    machine_file = out / "paper_machine.yaml"
    save_model(make_machine(geometry), machine_file)
    # What is measured is the machine in the file, not the one in memory: they may differ by a rounding.
    truth = RealMachine(geometry, load_model(machine_file, geometry))
    digest = hashlib.sha256(machine_file.read_bytes()).hexdigest()
    model, report = make_lines_model(truth, digest)
    save_model(model, out / "paper_lines_model.yaml")
    print("\n".join(report))
    return 0


if __name__ == "__main__":
    sys.exit(main())
