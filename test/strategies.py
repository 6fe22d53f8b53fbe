"""Common parts of the model's tests: machines, random models and poses, and hypothesis settings.

All random numbers come from a seed named in the test, and hypothesis runs derandomised, so that a failure repeats
everywhere.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
from helpers import ALL_TESTS
from hypothesis import settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from hexapod_comp.machine.field import CROSS_AXES, GridField
from hexapod_comp.machine.geometry import HexapodGeometry, Limits, load_geometry
from hexapod_comp.machine.load import Load
from hexapod_comp.machine.model import MachineModel
from hexapod_comp.machine.struts import StrutErrors
from hexapod_comp.machine.temperatures import LateGrowth
from hexapod_comp.pose import Pose

PAPER_FILE = Path(__file__).resolve().parents[1] / "config" / "paper.yaml"

# Decorator of property tests: the same examples every time, and no deadline, since a busy machine is no failure
fixed = settings(derandomize=True, deadline=None, database=None, max_examples=50 if ALL_TESTS else 25)
often = settings(fixed, max_examples=50)  # for numbers of any kind, not seeds of random machines

# m; nodes differ in number and spacing between the axes, so that confusing two axes is noticed
UNEVEN_GRID = (np.array([-0.2, -0.05, 0.02, 0.2]), np.array([-0.15, 0.0, 0.2]), np.array([0.35, 0.38, 0.55]))

seeds = st.integers(0, 2**32 - 1)  # seeds for the random makers below


def paper_geometry() -> HexapodGeometry:
    """Return the paper's machine."""
    return load_geometry(PAPER_FILE)


def skewed_geometry(lead: float = 0.0) -> HexapodGeometry:
    """Return a general 6-6 machine with twelve separate joints off the planes, and a screw lead in m.

    Both cardan axes are across their strut at home: parallel on struts 1–3, 90° apart on 4–6.
    """
    rng = np.random.default_rng(66)
    paper = paper_geometry()
    base = paper.base_joints + rng.uniform(-0.02, 0.02, (6, 3))
    platform = paper.platform_joints + rng.uniform(-0.02, 0.02, (6, 3))
    home = Pose.from_angles([0.01, -0.02, 0.42], np.deg2rad([2.0, -3.0, 4.0]))
    along = home.position + platform @ home.rotation.T - base
    across = np.cross(along, [0.0, 0.0, 1.0])
    on_platform = across.copy()
    on_platform[3:] = np.cross(along, across)[3:]
    return HexapodGeometry(
        "skewed",
        base,
        platform,
        home,
        Limits(np.tile([0.2, 0.9], (6, 1)), np.full(6, 1.5), np.full(6, 1.5), 20.0, 2e-3, 2e-3, 0.25),
        base_axes=across,
        platform_axes=on_platform @ home.rotation,
        screw_lead=np.full(6, lead),
    )


def random_pose(rng: np.random.Generator, home: Pose, reach: float = 0.05, tilt: float = 15.0) -> Pose:
    """Return a pose within ±`reach` m and `tilt` degrees of home."""
    axis = rng.normal(size=3)
    turn = Rotation.from_rotvec(axis / np.linalg.norm(axis) * np.deg2rad(tilt) * rng.uniform())
    return Pose(home.position + rng.uniform(-reach, reach, 3), turn.as_matrix() @ home.rotation)


def random_field(rng: np.random.Generator, size: float = 20e-6, powers: int = 4, **other: object) -> GridField:
    """Return a field with all six components on every line, with coefficients of `size` m and rad."""
    shapes = [(2, len(UNEVEN_GRID[a]), len(UNEVEN_GRID[b]), 6, powers) for a, b in CROSS_AXES]
    lines = [rng.uniform(-size, size, shape) for shape in shapes]
    return GridField(UNEVEN_GRID, (lines[0], lines[1], lines[2]), **other)  # type: ignore[arg-type]


def random_struts(rng: np.random.Generator) -> StrutErrors:
    """Return strut errors with every term, of the size of a bad machine's errors."""
    struts = StrutErrors(
        offset=rng.uniform(-1e-3, 1e-3, 6),
        pitch=rng.uniform(-1e-3, 1e-3, 6),
        reference_length=rng.uniform(0.3, 0.6, 6),
        period=rng.uniform(2e-3, 10e-3, 6),
        backlash=rng.uniform(0.0, 50e-6, 6),
        expansion=rng.uniform(5e-6, 20e-6, 6),
        map_knots=np.array([0.3, 0.42, 0.5, 0.56, 0.7]),
        map_values=rng.uniform(-50e-6, 50e-6, (6, 5)),
    )
    harmonics = np.arange(1, rng.integers(1, 5) + 1)
    waves = rng.uniform(-20e-6, 20e-6, (2, 6, len(harmonics))) / harmonics**2  # steep enough for a screw
    worn = rng.uniform(-25e-6, 25e-6, (6, 5))
    return replace(struts, cosine=waves[0], sine=waves[1], map_backlash=worn)


def random_model(rng: np.random.Generator, machine: str) -> MachineModel:
    """Return a model with all common blocks, and a measured point 120 mm below the platform and off its axis."""
    return MachineModel(
        machine,
        "random",
        base_deviation=rng.uniform(-1e-4, 1e-4, (6, 3)),
        platform_deviation=rng.uniform(-1e-4, 1e-4, (6, 3)),
        struts=random_struts(rng),
        field=random_field(rng, probe=[0.03, -0.02, -0.12]),
        base_expansion=11e-6,
        platform_expansion=23e-6,
    )


def whole_model(rng: np.random.Generator, machine: str) -> MachineModel:
    """Return a random model with every block that the C core knows, also those that few machines need."""
    load = Load(
        *(rng.uniform(5e6, 1e8, 6), rng.uniform(-1e-5, 1e-5, 6), 5.0, 12.5, rng.uniform(-0.1, 0.1, 3)),
        *(np.array([0.0, 9.8, 0.1]), rng.uniform(0.0, 3.0, 6)),
    )
    return replace(
        random_model(rng, machine),
        base_axes_turn=rng.uniform(-1e-3, 1e-3, 3),
        late_growth=LateGrowth((600.0, 7200.0), rng.uniform(-1e-5, 1e-5, (8, 2)), "base"),
        load=load,
        reversal_threshold=rng.uniform(0.0, 1e-5),
    )
