"""Readings of virtual instruments.

The truth is distances of known points, a square's turn as a cross product, and the stated sizes of outliers.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from hexapod_comp.errors import CommandError, ModelError
from hexapod_comp.machine.geometry import load_geometry
from hexapod_comp.machine.kinematics import solve_pose, strut_lengths
from hexapod_comp.machine.model import MachineModel, RealMachine
from hexapod_comp.machine.struts import StrutErrors
from hexapod_comp.machine.temperatures import HUMIDITY, PARTS
from hexapod_comp.measurements.campaign import Campaign, circle_run, line_run, template
from hexapod_comp.measurements.readings import CHANNELS, KINDS, MeasurementSet
from hexapod_comp.pose import Pose, rotation_vector
from hexapod_comp.virtual.instruments import LiveFlaws, LiveInstrument, measure
from hexapod_comp.virtual.machine import DriveParameters
from hexapod_comp.virtual.warm_up import WarmUp
from hexapod_comp.virtual.watched import Instrument, VirtualMachine

PAPER = load_geometry("paper")
BOX = np.array([[-0.1, -0.1, 0.4], [0.1, 0.1, 0.5]])
QUIET = Campaign(BOX, 0.1, 0.1, "1-D", 0, noise=(0.0,) * len(KINDS), beam_slope=0.0, centre_off=0.0)


def measured(campaign: Campaign, offset: np.ndarray) -> MeasurementSet:
    model = replace(MachineModel("paper"), struts=StrutErrors(offset=offset))
    return measure(template(campaign, PAPER), campaign, RealMachine(PAPER, model), seed=1)


def test_stops_do_not_depend_on_the_machine_drawn_with_the_same_seed() -> None:
    campaign = replace(QUIET, instrument=None, poses=100, repeatability=1e-6)
    found = measure(template(campaign, PAPER), campaign, RealMachine(PAPER, MachineModel("paper")), seed=5)
    stops = found.value[np.array([c.startswith("position") for c in CHANNELS])[found.channel]]
    drawn = np.random.default_rng(5).standard_normal(len(stops))
    assert abs(np.corrcoef(stops, drawn)[0, 1]) < 0.3  # 5 standard deviations of 300 independent pairs


def test_lengths_are_distances_from_the_true_centre() -> None:
    """Struts that are longer by known offsets move the tool; an uncalibrated bar starts at zero."""
    offset = 1e-5 * np.array([1.0, -2.0, 3.0, 2.0, -1.0, 0.5])
    runs = [circle_run(name, np.array([0.0, 0.0, 0.45]), 0.05, 5, np.eye(3)[:2], np.eye(3), known)
            for name, known in (("known", True), ("unknown", False))]  # fmt: skip
    found = measured(replace(QUIET, instrument=None, runs=tuple(runs)), offset)
    stations = [solve_pose(PAPER, lengths + offset, PAPER.home).position for lengths in found.stations.commands]
    errors = np.linalg.norm(np.array(stations)[found.station] - found.centre, axis=1) - 0.05
    expected = errors - np.where(found.run == 1, errors[found.run == 1][0], 0.0)
    np.testing.assert_allclose(found.value, expected, atol=1e-13)
    assert np.abs(expected).max() > 1e-5
    far = measured(replace(QUIET, instrument=None, runs=tuple(runs), centre_off=1e-3), offset)
    change = (far.value - found.value)[found.run == 0]
    np.testing.assert_allclose(change[:4:2].sum(), 0.0, atol=5e-5)  # on opposite sides of a displaced centre
    assert 1e-4 < np.abs(change).max() < 5e-3


def test_faces_of_one_square_turn_together() -> None:
    """A square that turns by ω moves its face along a by ω × a: y on the face along x by ω_z, x along y by −ω_z."""
    ends = np.array([[-0.1, 0.0, 0.45], [0.1, 0.0, 0.45]])
    faces = [replace(line_run(name, "straightness", one, 3, np.eye(3)), slope="square")
             for name, one in (("x", ends), ("y", ends[:, [1, 0, 2]]))]  # fmt: skip
    found = measured(replace(QUIET, instrument=None, runs=tuple(faces), beam_slope=1e-3), np.zeros(6))
    last = found.along() > 0.15
    slopes = {(run, CHANNELS[channel]): value / 0.2 for run, channel, value in
              zip(found.run[last], found.channel[last], found.value[last], strict=True)}  # fmt: skip
    assert slopes[0, "straightness_y"] == pytest.approx(-slopes[1, "straightness_x"], rel=1e-9)
    assert len({round(abs(slope), 9) for slope in slopes.values()}) == 3
    assert all(1e-5 < abs(slope) < 5e-3 for slope in slopes.values())
    np.testing.assert_allclose(found.value[found.along() == 0.0], 0.0, atol=1e-12)


def test_uncertainties_are_the_instruments_noise() -> None:
    noise = (0.0, 1e-12, 2e-6, 1e-6, 1e-6, 1e-6, 1e-6)
    found = measured(replace(QUIET, instrument="5-D", noise=noise), np.zeros(6))
    np.testing.assert_array_equal(found.uncertainty, np.array([np.nan, 1e-9, 2e-6])[found.kind])


def test_a_trackers_outliers_scale_and_exchanged_axes() -> None:
    """Every outlier is 1 mm; without outliers the position is twice the tool's, with x and y exchanged."""
    tool = PAPER.tool_pose(Pose(PAPER.home.position + np.array([0.01, -0.02, 0.0]), PAPER.home.rotation))
    wild = LiveFlaws(length_noise=0.0, angle_noise=0.0, wild_share=1.0)
    read = LiveInstrument(PAPER, "tracker", flaws=wild).pose(tool)
    np.testing.assert_allclose(np.abs(read.position - tool.position), 1e-3, atol=1e-15)
    turned = LiveFlaws(length_noise=0.0, angle_noise=0.0, scale=2.0, exchanged=True)
    instrument = LiveInstrument(PAPER, "tracker", flaws=turned)
    np.testing.assert_allclose(instrument.pose(tool).position, 2.0 * tool.position[[1, 0, 2]], atol=1e-15)
    assert instrument.read(tool) == {}
    for kind, components in (("theodolite", "5-D"), ("laser", "4-D")):
        with pytest.raises(
            CommandError, match="must be one of tracker, laser, ball_bar; a laser's components must be one of 1-D, 5-D"
        ):
            LiveInstrument(PAPER, kind, components)


@pytest.mark.parametrize("sensors", [PARTS, (*PARTS, HUMIDITY)])
def test_humidity_is_known_only_with_a_hygrometer(sensors: tuple[str, ...]) -> None:
    """Before the power is on it is 40 %; 900 s later, in the middle of a round, it has risen by 10·(1 − 1/e) %."""
    rise, constants = np.append(np.zeros(8), 0.1), np.full(9, 900.0)
    warm = WarmUp(rise, constants, 0.4, sensors, noise=(0.0, 0.0), rounds=1, every=1800)
    campaign = warm.campaign(replace(QUIET, diagonals=4))
    true, read = warm.stations(template(campaign, PAPER), 1)
    np.testing.assert_allclose(true.humidity[true.times < 0.0], 0.4, atol=1e-12)
    assert true.humidity[true.times == 900.0] == pytest.approx([0.5 - 0.1 / np.e], rel=1e-9)
    known = np.isfinite(read.humidity)
    assert known.all() if HUMIDITY in sensors else not known.any()
    np.testing.assert_allclose(read.humidity[known & (read.times < 0.0)], 0.4, atol=1e-12)
    replace(warm, every=2 * 54 * 2, pace=2).stations(template(campaign, PAPER), 1)
    with pytest.raises(ModelError, match="too long: a round of 54 stations must take at most 107 s"):
        replace(warm, every=2 * 54 * 2 - 2, pace=2).stations(template(campaign, PAPER), 1)


def test_an_observation_is_the_mean_of_25_samples_or_an_outlier_or_missing() -> None:
    """The standard deviation of 300 × 3 numbers is known to 2.4 % (1 σ), a share of 0.2 of 300 to 0.023."""
    machine = VirtualMachine(PAPER, MachineModel("paper"), Instrument(position=5e-6, rotation=1e-5))
    home = PAPER.tool_pose(PAPER.home)
    for wild, sizes in ((0.0, (1e-6, 2e-6)), (1.0, (200e-6, 200e-6))):
        machine.instrument = replace(machine.instrument, wild=wild)
        seen = [machine.observe() for _ in range(300)]
        away = [(o.pose.position - home.position, rotation_vector(o.pose.rotation @ home.rotation.T)) for o in seen]
        np.testing.assert_allclose(np.array(away).std(axis=(0, 2)), sizes, rtol=0.1)
        np.testing.assert_allclose(seen[0].uncertainty, [1e-6] * 3 + [2e-6] * 3)
    machine.instrument = replace(machine.instrument, broken=0.2)
    assert sum(machine.observe() is None for _ in range(300)) / 300 == pytest.approx(0.2, abs=0.08)
    machine.move(Pose(home.position + 0.01 * np.eye(3)[2], home.rotation))
    assert (machine.stops, machine.tool.position[2]) == (1, pytest.approx(home.position[2] + 0.01, abs=1e-6))


def test_a_machine_that_has_changed_keeps_its_drives() -> None:
    """Ideal drives stand at the struts' lengths by inverse kinematics; the usual drives stand on steps of 0.1 µm."""
    machine = VirtualMachine(PAPER, MachineModel("paper"), parameters=DriveParameters.ideal())
    machine.knock(2, 20e-6)
    machine.move(Pose(np.array([0.012345678, 0.0, 0.4]), np.eye(3)))
    wanted = strut_lengths(PAPER, Pose(np.array([0.012345678, 0.0, 0.4]), np.eye(3)) @ PAPER.tool.inverse())
    np.testing.assert_allclose(machine.observe().struts, wanted, rtol=0.0, atol=1e-12)
