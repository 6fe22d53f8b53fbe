"""Virtual instruments against errors known in closed form, and the verb ``simulate`` from file to file."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from strategies import paper_geometry

from hexapod_comp import cli
from hexapod_comp.errors import HexapodError
from hexapod_comp.formats.paths import config_file
from hexapod_comp.machine.model import MachineModel, RealMachine
from hexapod_comp.machine.model_file import load_model
from hexapod_comp.machine.struts import StrutErrors
from hexapod_comp.machine.temperatures import Temperatures
from hexapod_comp.measurements.campaign import Campaign, load_campaign, template
from hexapod_comp.measurements.readings import KINDS, MeasurementSet
from hexapod_comp.measurements.tidy import read_tidy
from hexapod_comp.virtual.instruments import compensated, measure, station_errors

BOX = np.array([[-0.1, -0.1, 0.4], [0.1, 0.1, 0.55]])
QUIET = Campaign(BOX, cell=0.1, step=0.05, instrument="6-D", diagonals=4, cycles=2, poses=20, tilt=0.1,
                 noise=(0.0,) * 7, beam_slope=0.0)  # fmt: skip


def of_kind(found: MeasurementSet, kind: str) -> np.ndarray:
    return found.kind == KINDS.index(kind)


def filled(campaign: Campaign, truth: RealMachine, seed: int = 3) -> MeasurementSet:
    return measure(template(campaign, truth.geometry), campaign, truth, seed)


def test_a_perfect_machine_reads_nothing() -> None:
    """Forward kinematics of nominal lengths is the commanded pose to rounding: 1e-15 m over a metre."""
    found = filled(QUIET, RealMachine(paper_geometry(), MachineModel("paper")))
    np.testing.assert_allclose(found.value, 0.0, atol=1e-13)


def test_a_shifted_base_shows_in_absolute_positions_only() -> None:
    """All base joints moved by d: the platform moves by d, exactly. Lines are zeroed at their first reading."""
    d = np.array([20e-6, -30e-6, 50e-6])
    truth = RealMachine(paper_geometry(), MachineModel("paper", base_deviation=np.tile(d, (6, 1))))
    found = filled(QUIET, truth)
    np.testing.assert_allclose(found.value[of_kind(found, "position")].reshape(-1, 3), np.tile(d, (20, 1)), atol=1e-13)
    np.testing.assert_allclose(found.value[~of_kind(found, "position")], 0.0, atol=1e-12)


def test_a_machine_that_grows_evenly_takes_similar_poses() -> None:
    """Struts, base and platform grown by a·ΔT: every pose is the commanded one, grown. The stations' temperature
    counts, not the truth's own. Linear error: a·ΔT × way from the first point; angles and straightness: none."""
    growth, kelvin = 11.7e-6, 10.0
    model = MachineModel("paper", struts=StrutErrors(expansion=np.full(6, growth)),
                         base_expansion=growth, platform_expansion=growth)  # fmt: skip
    truth = RealMachine(paper_geometry(), model, Temperatures({"base": 35.0}))
    plan = template(replace(QUIET, poses=0), paper_geometry())
    warm = np.full_like(plan.stations.temperatures, 20.0 + kelvin)
    plan = replace(plan, stations=replace(plan.stations, temperatures=warm))
    found = measure(plan, QUIET, truth, 0)
    linear = of_kind(found, "linear")
    np.testing.assert_allclose(found.value[linear], growth * kelvin * found.along()[linear], atol=1e-12)
    np.testing.assert_allclose(found.value[~linear], 0.0, atol=1e-12)


def test_backlash_separates_the_directions() -> None:
    """Every strut lags half its backlash of 4 µm behind. On vertical lines all struts move alike: going up the
    platform is too low by 2 µm and more (struts lean), going down as much too high; second order: 1e-11."""
    struts = StrutErrors(backlash=np.full(6, 4e-6))
    truth = RealMachine(paper_geometry(), MachineModel("paper", struts=struts))
    plan = template(Campaign(BOX, 0.1, 0.05, "1-D", 0), paper_geometry())
    errors = station_errors(plan, truth)
    along_z = np.flatnonzero([run.base_axis == 2 for run in plan.runs])
    for run in along_z:
        rows = np.flatnonzero(plan.run == run)
        up, down = (rows[plan.direction[rows] == d] for d in (1, -1))
        z = errors[plan.station, 2]
        np.testing.assert_allclose(z[up], -z[down[::-1]], atol=1e-10)
        assert (z[up] < -2e-6).all()


def test_noise_is_as_the_campaign_says() -> None:
    """Standard deviations of a few hundred draws: within 15 % (four standard errors at 400)."""
    campaign = replace(QUIET, noise=(1e-6, 2e-6, 3e-6, 4e-6, 5e-6, 6e-6, 7e-6), poses=200)
    truth = RealMachine(paper_geometry(), MachineModel("paper"))
    found = filled(campaign, truth)
    for kind, sigma in zip(KINDS, campaign.noise, strict=True):
        if of_kind(found, kind).any():
            assert found.value[of_kind(found, kind)].std() == pytest.approx(sigma, rel=0.15)
            assert set(found.uncertainty[of_kind(found, kind)]) == {sigma}
    np.testing.assert_array_equal(filled(campaign, truth).value, found.value)
    assert not np.array_equal(filled(campaign, truth, seed=4).value, found.value)
    assert np.isnan(filled(QUIET, truth).uncertainty).all()  # nobody reads without noise: nothing is stated


def test_beam_slopes_bend_straightness_only_and_one_slope_holds_for_a_run() -> None:
    found = filled(replace(QUIET, beam_slope=100e-6), RealMachine(paper_geometry(), MachineModel("paper")))
    straight = of_kind(found, "straightness")
    np.testing.assert_allclose(found.value[~straight], 0.0, atol=1e-13)
    along = found.along()
    slopes = []
    for key in set(zip(found.run[straight], found.channel[straight], strict=True)):
        rows = (found.run == key[0]) & (found.channel == key[1]) & (np.abs(along) > 1e-3)
        each = found.value[rows] / along[rows]
        np.testing.assert_allclose(each, each[0], atol=1e-11)
        slopes.append(each[0])
    assert np.std(slopes) == pytest.approx(100e-6, rel=0.4)  # 54 draws


def test_the_machine_stops_elsewhere_at_every_visit_for_all_channels_alike() -> None:
    campaign = Campaign(BOX, 0.1, 0.05, None, 0, poses=300, noise=(0.0,) * 7, repeatability=2e-6)
    found = filled(campaign, RealMachine(paper_geometry(), MachineModel("paper")))
    places = found.value[of_kind(found, "position")]
    assert places.std() == pytest.approx(2e-6, rel=0.15)
    lines = filled(replace(QUIET, repeatability=2e-6, poses=0), RealMachine(paper_geometry(), MachineModel("paper")))
    cycles = [lines.value[(lines.cycle == c) & (lines.channel == 0)] for c in (1, 2)]
    assert not np.allclose(cycles[0], cycles[1], atol=1e-9)
    np.testing.assert_allclose(lines.value[of_kind(lines, "rotation")], 0.0, atol=1e-13)


def test_the_truths_own_compensation_leaves_nothing() -> None:
    """Running the truth backwards, then forwards: rounding of lengths below a metre, 1e-15; measured 1.2e-15."""
    geometry = paper_geometry()
    model = load_model(config_file("paper_machine"), geometry)
    plan = compensated(template(QUIET, geometry), model)
    errors = station_errors(plan, RealMachine(geometry, model))
    np.testing.assert_allclose(errors, 0.0, atol=1e-13)


def test_a_pose_that_cannot_be_taken_is_named() -> None:
    geometry = paper_geometry()
    plan = template(replace(QUIET, poses=0), geometry)
    short = plan.stations.commands.copy()
    short[3] *= 0.01
    plan = replace(plan, stations=replace(plan.stations, commands=short))
    with pytest.raises(HexapodError, match=r"run x line .*reading 19, platform at \["):
        station_errors(plan, RealMachine(geometry, MachineModel("paper")))


SMALL = """format: hexapod_comp/campaign
version: 1
box_mm: [[-100, -100, 400], [100, 100, 650]]
cell_mm: 200
step_mm: 50
instrument: 5-D
diagonals: 4
poses: 5
tilt_deg: 5
noise: {linear_um: 0.5, rotation_arcsec: 0.2, straightness_um: 0}
"""


def run(*arguments: str) -> int:
    return cli.main(["simulate", *arguments])


def test_verb_writes_what_it_says(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    small = tmp_path / "small.yaml"
    small.write_text(SMALL)
    paths = [str(tmp_path / name) for name in ("one.csv", "two.csv", "other.csv")]
    for path, seed in zip(paths, ("1", "1", "2"), strict=True):
        assert run("--campaign", str(small), "--seed", seed, "--out", path) == 0
    text = capsys.readouterr().out
    one, two, other = (Path(path).read_bytes() for path in paths)
    assert one == two != other
    geometry = paper_geometry()
    campaign = load_campaign(small)
    truth = RealMachine(geometry, load_model(config_file("paper_machine"), geometry))
    expected = measure(template(campaign, geometry, 1), campaign, truth, 1)
    assert f"{len(expected)} readings of 21 runs" in text  # 16 lines, 4 diagonals, the poses
    # The file has what instruments show, a tenth of a nanometre, and states their noise, to rounding in its unit.
    found = read_tidy(paths[0], geometry)
    np.testing.assert_allclose(found.value, expected.value, rtol=0.0, atol=0.51e-10)
    np.testing.assert_allclose(found.uncertainty, expected.uncertainty, rtol=1e-15)
    stated = {kind: found.uncertainty[of_kind(found, kind)][0] for kind in ("linear", "rotation", "position")}
    assert stated == pytest.approx({"linear": 0.5e-6, "rotation": np.radians(0.2 / 3600.0), "position": 10e-6})
    assert np.isnan(found.uncertainty[of_kind(found, "straightness")]).all()
