"""Predictions against the machine that the compensator runs; derivatives against finite differences of them."""

from collections.abc import Callable
from dataclasses import replace

import calibration_helpers as small
import numpy as np
import pytest
from helpers import central_difference, general_machine, poses_about

from hexapod_comp.calibration.blocks.field import GRID_TOLERANCE
from hexapod_comp.calibration.parameters import FitSettings, ParameterSpace
from hexapod_comp.calibration.sensitivity import derivatives, predict
from hexapod_comp.machine.geometry import HexapodGeometry
from hexapod_comp.machine.model import RealMachine
from hexapod_comp.measurements.readings import Stations
from hexapod_comp.pose import Pose, attitude_error

PROBE = np.array([0.02, -0.03, -0.06])
COLD = FitSettings(lead=small.LEAD, field_degree=2)
WARM = replace(COLD, strut_expansion=12e-6, base_expansion=11e-6, platform_expansion=23e-6)
LATE = replace(WARM, time_constants=(500.0, 5000.0), blocks=("pitch", "backlash", "expansion", "late"))
BY_ONE = replace(LATE, thermometer="base")
SPLIT = replace(WARM, shared_platform_joints=False)
STRUTS_ONLY = replace(COLD, blocks=("pitch", "wave", "backlash", "map"))


def led() -> HexapodGeometry:
    """Return the paper's machine with cardan joints and screws of 10 mm lead that turn in their nuts."""
    across = np.tile([1.0, 0.0, 0.0], (6, 1))
    return replace(small.paper(), screw_lead=np.full(6, 0.01), base_axes=across, platform_axes=across)


def case(geometry: HexapodGeometry, settings: FitSettings) -> tuple[ParameterSpace, Stations, np.ndarray]:
    """Return a space, tilted poses with a probe and eight temperatures, and a machine as its priors expect one."""
    rng = np.random.default_rng(11)
    positions, rotations = poses_about(geometry.home, 12, seed=12, reach=0.04, tilt_deg=8.0)
    poses = [Pose(p, r) for p, r in zip(positions, rotations, strict=True)]
    temperatures = [tuple(20.0 + rng.uniform(-8.0, 8.0, 8)) for _ in poses]
    readings = small.scattered(geometry, poses, temperatures, PROBE)
    readings = replace(readings, stations=replace(readings.stations, times=np.sort(rng.uniform(0.0, 9e3, len(poses)))))
    space = ParameterSpace(readings, settings)
    x = space.physical(space.spread(space.start_tolerances()) * rng.standard_normal(space.size))
    backlash = space.block("backlash").part
    x[backlash] = np.abs(x[backlash]) + 1e-6
    return space, readings.stations, x


def differences(space: ParameterSpace, stations: Stations, x: np.ndarray, ways: np.ndarray) -> np.ndarray:
    """Return the derivatives of e in some directions (size, n) by central differences, shape (M, 6, n)."""

    def errors(steps: np.ndarray) -> np.ndarray:
        return predict(space, x + ways @ steps, stations).errors.ravel()

    # 0.5 µm (or µm/m, µrad): rounding of some 1e-15 m over it is 2e-9, the third derivative even less.
    return central_difference(errors, np.zeros(ways.shape[1]), 5e-7).reshape(len(stations), 6, -1)


def some_ways(space: ParameterSpace, part: slice) -> np.ndarray:
    """Return two random directions within a block, shape (size, 2): every parameter has a part in both."""
    ways = np.zeros((space.size, 2))
    ways[part] = np.random.default_rng(13).choice([-1.0, 1.0], ways[part].shape)
    return ways


def worst(found: np.ndarray, wanted: np.ndarray) -> float:
    """Return the largest difference, displacement and rotation each relative to its largest derivative."""
    parts = (slice(0, 3), slice(3, 6))
    return max(float(np.abs(found[:, p] - wanted[:, p]).max() / max(np.abs(wanted[:, p]).max(), 1e-9)) for p in parts)


@pytest.mark.parametrize(
    ("make", "settings", "tolerance"),
    [
        # Left out on purpose: thermal growth of the deviations, 2e-4; the slope of the field, 1e-3 at most; half
        # the rotation error, 1e-3 rad, in which rotation vectors do not add up.
        (small.paper, WARM, 2e-3),
        (small.paper, SPLIT, 2e-3),
        (general_machine, WARM, 2e-3),
        (small.paper, LATE, 2e-3),
        (general_machine, BY_ONE, 2e-3),
        # A screw that the platform's turning turns: lead/2π times 10 rad per metre of strut.
        (led, STRUTS_ONLY, 3e-2),
    ],
    ids=["shared joints", "separate joints", "twelve joints", "late parts", "one thermometer", "turning screws"],
)
def test_every_block_against_finite_differences(
    make: Callable[[], HexapodGeometry], settings: FitSettings, tolerance: float
):
    space, stations, x = case(make(), settings)
    analytic = derivatives(space, predict(space, x, stations), stations)
    for block in space.blocks:
        ways = some_ways(space, block.part)
        assert worst(analytic @ ways, differences(space, stations, x, ways)) < tolerance, block.name


def test_displacements_are_exact_without_heat_and_field():
    """Nothing is left out of them: only the rounding of the differences, some 1e-15 m / 5e-7, is in the way."""
    space, stations, x = case(small.paper(), STRUTS_ONLY)
    analytic = derivatives(space, predict(space, x, stations), stations)
    for block in space.blocks:
        ways = some_ways(space, block.part)
        numeric = differences(space, stations, x, ways)[:, :3]
        np.testing.assert_allclose((analytic @ ways)[:, :3], numeric, atol=1e-7, err_msg=block.name)


def test_negative_backlash_is_not_cut_off():
    """An estimate may go below zero by noise; a prediction that stops there lets the fit run away."""
    space, stations, x = case(small.paper(), STRUTS_ONLY)
    part = space.block("backlash").part
    x[part] = [-2e-6, 1e-6, -1e-6, 3e-6, -3e-6, 2e-6]
    ways = np.eye(space.size)[:, part]
    analytic = derivatives(space, predict(space, x, stations), stations) @ ways
    np.testing.assert_allclose(analytic[:, :3], differences(space, stations, x, ways)[:, :3], atol=1e-7)


@pytest.mark.parametrize("settings", [WARM, SPLIT, STRUTS_ONLY], ids=["warm", "separate joints", "no field"])
def test_prediction_is_the_machine_that_the_compensator_runs(settings: FitSettings):
    """Errors of the measured point of RealMachine with the whole model, field as a grid.

    The grid may differ by its tolerance; rotations of 1 mrad and 50 µrad do not commute: half their product.
    """
    space, stations, x = case(small.paper(), settings)
    model = space.model(x)
    found = predict(space, x, stations).errors
    for n in range(len(stations)):
        machine = RealMachine(space.geometry, model, stations.temperature(n))
        commanded = stations.pose(n)
        actual, _ = machine.pose_for(stations.commands[n], stations.sense[n], commanded)
        moved = actual.position + actual.rotation @ PROBE - commanded.position - commanded.rotation @ PROBE
        np.testing.assert_allclose(found[n, :3], moved, atol=2.0 * GRID_TOLERANCE)
        turned = attitude_error(actual.rotation, commanded.rotation)
        np.testing.assert_allclose(found[n, 3:], turned, atol=2.0 * GRID_TOLERANCE + 0.5 * 1e-3 * 50e-6)
