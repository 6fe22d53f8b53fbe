"""What readings show that no parameter describes, how it widens the promise, and what is named as its cause.

Each misfit is put into the readings of a machine of the model's own class, so its size is known; the machine itself
takes part with a tool error of 0.3 µm after the fit, and a reading's noise is 1 µm and 1 µrad.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from calibration_helpers import BOX, FEW, SETTINGS, campaign, measured, virtual_machine
from foreign_machines import machines
from scipy.stats import multivariate_normal

from hexapod_comp.calibration.estimator import Estimation, NotSettled, influence, iterate
from hexapod_comp.calibration.evaluation import held_out
from hexapod_comp.calibration.fit import fit_model, mixed_up
from hexapod_comp.calibration.mixups import FAMILIES, SWAPPED, _Fitted, common_modes, family_of_run, in_frame
from hexapod_comp.calibration.parameters import FitSettings, ParameterSpace
from hexapod_comp.calibration.posterior import expected_error, stations_of
from hexapod_comp.calibration.promise import Scatter, Unexplained, upper_factor
from hexapod_comp.calibration.report import as_json, fit_report
from hexapod_comp.calibration.trust import stated_scale
from hexapod_comp.errors import CalibrationError, ModelError
from hexapod_comp.machine.geometry import load_geometry
from hexapod_comp.machine.kinematics import Structure, strut_lengths_batch
from hexapod_comp.machine.model import RealMachine
from hexapod_comp.machine.passes import random_passes
from hexapod_comp.machine.trial import Trial
from hexapod_comp.measurements.campaign import Campaign
from hexapod_comp.measurements.readings import BACKWARD, CHANNELS, FORWARD, KINDS, MeasurementSet, Stations
from hexapod_comp.virtual.imperfections import ImperfectionBounds, draw_model, with_length_map
from hexapod_comp.virtual.instruments import station_errors

ROTATION_X = CHANNELS.index("rotation_x")
LINEAR, STRAIGHTNESS, ROTATION = (KINDS.index(kind) for kind in ("linear", "straightness", "rotation"))


@pytest.fixture(scope="module")
def readings() -> MeasurementSet:
    """Return the readings of a machine that the model describes."""
    return measured(virtual_machine(3), campaign(), 3)


def family(readings: MeasurementSet) -> np.ndarray:
    """Return the family of each reading."""
    return family_of_run(readings)[readings.run]


def test_what_is_described_is_promised_as_before(readings):
    """The promise grows by the laser's stated scale alone, 0.5 ppm over some 0.2 m: priors hold next to nothing.

    And by how far any covariance is believed; were it without doubt, by 1.3 at most.
    """
    fit = fit_model(readings, FEW)
    beyond = fit.verdict.unexplained
    assert (beyond.factor, beyond.drift) == (1.0, 0.0)
    assert beyond.displacement == beyond.rotation == Scatter()
    assert (fit.misfit, fit.verdict.doubts) == ("", ())
    before = expected_error(fit.space, fit.solution.x, fit.covariance)
    assert beyond.prior < 1e-3
    assert fit.level.low == pytest.approx(before.low, rel=1e-4)
    assert before.high < fit.level.high < 1.3 * before.high * beyond.upper
    assert beyond.averaged < 1.1, "no block that was left out is likely to be there"
    assert beyond.upper < upper_factor(1.0, 0.0), "runs show no more than a right covariance lets them"
    assert "IN DOUBT" not in fit_report(fit)
    assert fit.level.rotation_high is None, "nothing reads the roll"
    assert "µrad RMS by the priors" in fit_report(fit)


def test_the_upper_end_holds_what_a_variance_may_be():
    """Closed forms: χ² with 2 degrees of freedom is exponential; what is believed without end is not widened."""
    tail = -2.0 * np.log(0.975)  # exceeded with 97.5 %
    assert upper_factor(1.0, 0.0, 2.0) == pytest.approx(np.sqrt(2.0 / tail))
    assert upper_factor(5.0, 1.0, 1.0) == pytest.approx(np.sqrt(6.0 / tail))
    assert upper_factor(4.0, 20.0, 1e9) == pytest.approx(1.0, abs=1e-3)
    assert upper_factor(4.0, 1e9, 12.0) == pytest.approx(2.0, rel=1e-3)


def test_an_interval_is_widened_by_each_cause_in_its_way():
    """Of draws that are all 1 µm; two places 2 m apart are 1 m from their middle."""
    one, places = np.full(9, 1e-6), np.array([[-1.0, 0.0, 0.0], [1.0, 0.0, 0.0]])
    assert Unexplained().promised(one, places) == pytest.approx((1e-6, 1e-6, 1e-6))
    assert Unexplained(factor=3.0, upper=4.0).promised(one, places) == pytest.approx((3e-6, 1e-6, 4e-6))
    priors = Unexplained(prior=0.5 * np.log(2.0)).promised(one, places)
    assert priors == pytest.approx((1e-6, 0.5e-6, 2e-6))
    scaled = Unexplained(scale=1e-6).promised(one, places)
    assert scaled == pytest.approx((np.sqrt(2.0) * 1e-6, 1e-6, np.sqrt(5.0) * 1e-6))
    drifted = Unexplained(drift=2e-6).promised(one, places)
    assert drifted == pytest.approx(scaled), "1 ppm at either end of the campaign"
    stops = Unexplained(displacement=Scatter(stops=np.sqrt(3.0) * 1e-6, most_stops=np.sqrt(8.0) * 1e-6))
    assert stops.promised(one, places) == pytest.approx((2e-6, 1e-6, 3e-6))
    assert stops.promised_rotation(one) == pytest.approx((1e-6, 1e-6, 1e-6))
    turned = Unexplained(rotation=Scatter(lack=np.sqrt(3.0) * 1e-6))
    assert turned.promised_rotation(one) == pytest.approx((2e-6, 1e-6, np.sqrt(1.0 + 2.25 * 3.0) * 1e-6))


def test_a_run_that_slips_hides_no_error_that_repeats(readings):
    """Each place has an error of its own, as above, and two thirds of one run are 15 µm off."""
    members = np.flatnonzero((readings.run == 3) & (readings.kind == LINEAR))
    spoilt = with_own_errors(readings).value.copy()
    spoilt[members[len(members) // 3 :]] += 15e-6
    fit = fit_model(readings.with_values(spoilt), FEW)
    assert fit.verdict.unexplained.displacement.lack == pytest.approx(3e-6 * np.sqrt(3.0), rel=0.2)


def with_own_errors(readings: MeasurementSet) -> MeasurementSet:
    """Return readings of a machine of which each place has an error of its own, 3 µm along each axis."""
    points = readings.points()[readings.station].round(6)
    place = np.unique(points, axis=0, return_inverse=True)[1].ravel()
    own = 3e-6 * np.random.default_rng(1).standard_normal((place.max() + 1, 3))
    return readings.with_values(readings.value + (readings.directions()[:, :3] * own[place]).sum(axis=1))


def test_an_error_that_repeats_there_and_back_is_the_machine_s(readings):
    """Each place has an error of its own, 3 µm along each axis; some of it the parameters take up."""
    fit = fit_model(with_own_errors(readings), FEW)
    assert fit.verdict.unexplained.displacement.lack == pytest.approx(3e-6 * np.sqrt(3.0), rel=0.2)
    assert fit.level.high > 3e-6 * np.sqrt(3.0)
    assert any("(discrepancy)" in note for note in fit.notes)


def test_noise_beyond_the_stated_is_promised(readings):
    """Four times the stated noise: in doubt, above three times, but written, below ten.

    Whether instrument or machine scatters so nobody can tell without repeats: it is a discrepancy, which the upper end
    has and the lower end has not.
    """
    noise = 4e-6 * np.random.default_rng(2).standard_normal(len(readings))
    fit = fit_model(readings.with_values(readings.value + noise), FEW)
    beyond = fit.verdict.unexplained
    for part in (beyond.displacement, beyond.rotation):
        assert part == Scatter(lack=pytest.approx(4e-6 * np.sqrt(3.0), rel=0.1))
    assert fit.level.low < 1e-6
    assert fit.level.high > 4e-6 * np.sqrt(3.0)
    assert fit.misfit == ""
    doubts = fit.verdict.doubts
    assert len(doubts) == 1
    assert all(f"{kind} by " in doubts[0] for kind in ("linear", "straightness", "rotation"))
    assert fit_report(fit).startswith("IN DOUBT:\n  readings are off by more than 3 times their noise")


def with_stops(cycles: int, seed: int) -> MeasurementSet:
    """Return the readings of a machine that stops within ±1 µm of where it should, along each axis."""
    return measured(virtual_machine(seed), campaign(cycles=cycles, repeatability=1e-6), seed)


@pytest.mark.parametrize(("cycles", "widest"), [(1, 1.6), (2, 1.3)])
def test_the_machine_s_repeatability_stays_in_use(cycles: int, widest: float):
    """The tool stops √3 µm off, RMS, whatever the model says; 600 readings, or as many repeats, tell that to 10 %.

    It is called repeatability where repeats show it; without repeats it may be an error that is not in the model.
    """
    fit = fit_model(with_stops(cycles, 3), FEW)
    scatter, found = fit.verdict.unexplained.displacement, pytest.approx(1e-6 * np.sqrt(3.0), rel=0.1)
    assert (scatter.lack, scatter.stops) == ((found, 0.0) if cycles == 1 else (0.0, found))
    left = held_out(virtual_machine(3), fit.model, BOX, repeatability=1e-6).aligned.rms
    assert fit.level.low < left < fit.level.high < widest * left
    assert fit.level.after == pytest.approx(left, rel=0.1)
    said = "(discrepancy)" if cycles == 1 else "the machine's own repeatability, 1."
    assert any(said in note for note in fit.notes)


def lost_motion(stations: Stations, structure: Structure) -> np.ndarray:
    """Return what friction adds to each strut's length, (N, 6), m: by the sign of its speed, and unlike along it."""
    lengths = strut_lengths_batch(structure, stations.positions, stations.rotations)
    return 4e-6 * stations.sense[:, 3:] * np.cos(2.0 * np.pi * lengths / 0.06 + np.arange(6))


@pytest.mark.parametrize("cycles", [1, 3])
def test_friction_in_the_struts_is_no_repeatability(cycles: int):
    """A lost motion that is different all along the struts is in no block; passes repeat it, but for 1 µm of stops.

    The truth is the machine itself, moved through random points both ways.
    """
    truth, plan = virtual_machine(3), campaign(cycles=cycles, repeatability=1e-6)
    structure, ours = Structure.of(truth.geometry), measured(truth, plan, 3)

    def lost(stations: Stations, commands: np.ndarray) -> Stations:
        return replace(stations, commands=commands + lost_motion(stations, structure))

    rubbing = replace(ours, stations=lost(ours.stations, ours.stations.commands))
    added = (station_errors(rubbing, truth) - station_errors(ours, truth))[ours.station]
    added = (ours.directions() * added).sum(axis=1)
    group = ours.run * len(CHANNELS) + ours.channel
    first = np.unique(group, return_index=True)
    added -= added[first[1]][np.searchsorted(first[0], group)]
    fit = fit_model(ours.with_values(ours.value + added), FEW)

    passes = random_passes(truth.geometry, BOX, 300, 0.0, np.random.default_rng(5))
    trial, stations = Trial(truth, passes), stations_of(passes)
    errors = trial.errors(lost(stations, trial.commands(fit.model)).commands).aligned().displacement
    errors = errors + 1e-6 * np.random.default_rng(6).standard_normal(errors.shape)
    left, scatter = float(np.sqrt((errors**2).sum(axis=1).mean())), fit.verdict.unexplained.displacement
    assert fit.level.low < left < fit.level.high < 2.2 * left
    assert scatter.stops == (0.0 if cycles == 1 else pytest.approx(1e-6 * np.sqrt(3.0), rel=0.15))
    assert scatter.lack > 2.0 * scatter.stops


def test_repeated_readings_tell_repeatability_from_errors_that_stay():
    """Each place has an error of its own besides, 3 µm; three passes differ by noise and stops alone."""
    scatter = fit_model(with_own_errors(with_stops(3, 3)), FEW).verdict.unexplained.displacement
    assert scatter.stops == pytest.approx(1e-6 * np.sqrt(3.0), rel=0.1)
    assert scatter.lack == pytest.approx(3e-6 * np.sqrt(3.0), rel=0.2)


def test_scatter_that_is_stated_is_the_instrument_s():
    """The same readings, nothing said of their noise, or that it is √2 µm; then no remark says that it is assumed."""
    readings = with_stops(1, 3)
    readings = replace(readings, uncertainty=np.full(len(readings), np.nan))
    assumed = [note for note in fit_model(readings, FEW).notes if "(linear 1 µm, straightness 1 µm assumed)" in note]
    assert len(assumed) == 1
    stated = np.where(readings.kind == ROTATION, 1e-6, np.sqrt(2.0) * 1e-6)
    fit = fit_model(replace(readings, uncertainty=stated), FEW)
    assert fit.verdict.unexplained.displacement == Scatter()
    assert not [note for note in fit.notes if "assumed" in note]


def test_rotation_that_is_in_no_parameter_is_promised():
    """Each place has a rotation of its own, 2 µrad about each axis, which lines read, and which the tool keeps."""
    readings = measured(virtual_machine(3), campaign("6-D"), 3)
    place = np.unique(readings.points()[readings.station].round(6), axis=0, return_inverse=True)[1].ravel()
    own = 2e-6 * np.random.default_rng(6).standard_normal((place.max() + 1, 3))
    turned = (readings.directions()[:, 3:] * own[place]).sum(axis=1)
    level = fit_model(readings.with_values(readings.value + turned), FEW).level
    assert level.rotation_high > 2e-6 * np.sqrt(3.0)
    assert level.after < 1e-6


def test_what_a_field_lacks_in_rotation_it_lacks_in_displacement(readings):
    """Waves of 0.4 m in space, 1 µm and 20 µrad about each axis; the field's degree of 3 is too low for them.

    Rotations are read to 1 µrad, so it shows there. What displacements lack is 1/20 of it, and would not show.
    """
    waves = np.sin(2.0 * np.pi / 0.4 * readings.points()[readings.station] + np.arange(3.0))
    errors = np.hstack([1e-6 * waves[:, [1, 2, 0]], 20e-6 * waves[:, [2, 0, 1]]])
    spoilt = readings.with_values(readings.value + (readings.directions() * errors).sum(axis=1))
    fields = ("field displacement", "field rotation")
    fit = fit_model(spoilt, replace(SETTINGS, blocks=(*FEW.blocks, *fields)))
    beyond = fit.verdict.unexplained
    assert {fit.space.block(name) is None for name in fields} == {False}
    assert beyond.rotation.lack > 2e-6
    assert 0.0 < beyond.displacement.lack < beyond.rotation.lack * 0.2


def test_a_scale_that_drifts_is_measured(readings):
    """30 ppm from the first to the last reading; the standard error is some 2 ppm."""
    time = np.linspace(-0.5, 0.5, len(readings))
    growth = 30e-6 * time * readings.along() * (readings.kind == LINEAR)
    fit = fit_model(readings.with_values(readings.value + growth), FEW)
    assert fit.verdict.unexplained.drift == pytest.approx(30e-6, rel=0.3)
    assert any("scale of the linear readings" in doubt for doubt in fit.verdict.doubts)


def test_lines_that_differ_from_each_other_widen_the_promise(readings):
    """Each run's laser has a scale of its own, ±30 ppm: 6 µm over a line that is read to 1 µm."""
    scale = 30e-6 * np.random.default_rng(4).standard_normal(len(readings.runs))
    spoilt = readings.value + scale[readings.run] * readings.along() * (readings.kind == LINEAR)
    fit = fit_model(readings.with_values(spoilt), FEW)
    assert fit.verdict.unexplained.factor > 1.5
    covariance = fit.covariance / fit.verdict.unexplained.factor**2
    assert fit.level.high > 1.5 * expected_error(fit.space, fit.solution.x, covariance).high
    np.testing.assert_allclose(np.sqrt(np.diag(fit.covariance)), fit.standard_errors)


def test_chi_square_is_told_by_lines_and_direction(readings):
    """Five times the noise on the y lines' straightness is a χ² of 25 there, less what the fit takes up."""
    spoilt = (family(readings) == 1) & (readings.kind == STRAIGHTNESS)
    noise = 5e-6 * np.random.default_rng(5).standard_normal(len(readings)) * spoilt
    fit = fit_model(readings.with_values(readings.value + noise), replace(FEW, robust=False))
    values = {(c.kind, c.part): c.value for c in fit.verdict.chi_squares}
    assert values["straightness", "y lines"] == pytest.approx(26.0, rel=0.25)
    assert values["straightness", "x lines"] < 2.0
    assert values["linear", "y lines"] < 2.0
    worst = fit.verdict.worst_runs[0]
    assert (worst.kind, worst.part[:6]) == ("straightness", "y line")
    assert "y lines" in fit_report(fit)
    assert len(as_json(fit)["chi_squares"]) == len(fit.verdict.chi_squares)


def test_one_run_is_held_by_the_priors(readings):
    fit = fit_model(readings.select(readings.run == 0), SETTINGS)
    assert "do not determine" in fit.misfit
    assert fit.misfit in "; ".join(fit.verdict.refusals)


def reversed_where(readings: MeasurementSet, members: np.ndarray) -> MeasurementSet:
    return readings.with_values(np.where(members, -readings.value, readings.value))


CAUSES = {
    "x lines: sign reversed": lambda m: reversed_where(m, family(m) == 0),
    "rotation: arcsec in place of µrad": lambda m: m.with_values(
        np.where(m.kind == ROTATION, m.value / np.radians(1e6 / 3600.0), m.value)
    ),
    "rotation_x of 8 of 15 runs": lambda m: reversed_where(m, (m.channel == ROTATION_X) & (m.run % 2 == 0)),
    "13 of 25 runs": lambda m: m.with_values(m.value * np.where(np.arange(len(m.runs)) % 2, 1.0, -1.0)[m.run]),
}


def test_every_second_run_that_reads_a_rotation_about_x(readings):
    """What the name of a cause below counts."""
    runs = np.unique(readings.run[readings.channel == ROTATION_X])
    assert (len(runs), int((runs % 2 == 0).sum())) == (15, 8)


@pytest.mark.parametrize("cause", CAUSES)
def test_the_cause_is_named(readings, cause):
    """The first that is named is what was done; of half the runs, which half is reversed is anybody's guess."""
    named = mixed_up(CAUSES[cause](readings), FEW)
    assert named
    assert named[0].startswith(cause) or ("of 25 runs" in cause and "12 of 25 runs" in named[0])


def test_runs_with_a_reversed_channel_are_named_where_screws_turn(tmp_path):
    """Nominal lengths then leave errors of their own, whose sign nobody has reversed: they must not hide the runs'."""
    machine = machines()["left-hand"]
    geometry = load_geometry(machine.write(tmp_path / "machine.yaml"))
    side = float(np.ptp(machine.box, axis=0).min())
    truth = RealMachine(geometry, draw_model(geometry, ImperfectionBounds(joint=500e-6), 3))
    m = measured(truth, Campaign(machine.box, side, 0.5 * side, "5-D", 4), 3)
    assert mixed_up(m, FitSettings()) == []
    named = mixed_up(reversed_where(m, (m.channel == ROTATION_X) & (m.run % 2 == 0)), FitSettings())
    assert named[0].startswith("rotation_x of ")
    assert " runs (" in named[0]


def test_exchanged_channels_are_named_where_the_plain_model_lacks_much(tmp_path):
    """Length maps leave rotations off by 54 times their noise: an exchange adds a quarter of that."""
    machine = machines()["framed"]
    geometry = load_geometry(machine.write(tmp_path / "machine.yaml"))
    truth = RealMachine(
        geometry, with_length_map(draw_model(geometry, ImperfectionBounds(joint=800e-6), 3), geometry, 3)
    )
    m = measured(truth, Campaign(machine.box, float(np.ptp(machine.box, axis=0).min()), 0.02, "5-D", 4), 3)
    assert mixed_up(m, FitSettings()) == []
    x, y = ROTATION_X, CHANNELS.index("rotation_y")
    both = np.isin(m.channel, (x, y))
    named = mixed_up(replace(m, channel=np.where(both, x + y - m.channel, m.channel)), FitSettings())
    assert named[0].startswith("rotation_x and rotation_y: exchanged")


@pytest.mark.parametrize(
    ("frame", "name"),
    [
        (np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]), "the work frame: turned about z by -90°"),
        (np.diag([1.0, -1.0, 1.0]), "y: mirrored"),
    ],
)
def test_another_frame_is_named(readings, frame, name):
    """What undoes a turn is the turn back, and a mirror undoes itself; none is taken for a reversed sign."""
    named = mixed_up(in_frame(readings, frame), FEW)
    assert [text.rpartition(" fits")[0] for text in named] == [name]


def test_a_backlash_that_no_reading_tells_is_promised(readings):
    """Half of it moves every strut either way, whatever the model says; the lower end is without it."""
    still = replace(readings.stations, sense=np.zeros_like(readings.stations.sense))
    fit = fit_model(replace(readings, direction=np.zeros_like(readings.direction), stations=still), FEW)
    left = held_out(virtual_machine(3), fit.model, BOX).aligned.rms
    assert fit.space.block("backlash") is None
    assert fit.level.low < left < fit.level.high


def test_nothing_is_suspected_without_a_cause(readings):
    assert mixed_up(readings, FEW) == []


def test_a_fit_that_fails_names_the_cause(readings, monkeypatch):
    """Large errors and a reversed sign end in no machine at all: whoever reads that must learn why."""

    def fail(*_):
        raise CalibrationError("fit", "did not settle")

    monkeypatch.setattr("hexapod_comp.calibration.fit._fit", fail)
    with pytest.raises(CalibrationError, match=r"did not settle\n  x lines: sign reversed fits \d+\.\d times better$"):
        fit_model(CAUSES["x lines: sign reversed"](readings), FEW)
    with pytest.raises(CalibrationError, match=r"did not settle$"):
        fit_model(readings, FEW)


def test_the_sign_of_everything_shows_in_the_backlash_alone(readings):
    """To first order the machine with all errors reversed reads so, but its screws would lead their nuts."""
    with pytest.raises(CalibrationError, match=SWAPPED):
        fit_model(readings.with_values(-readings.value), FEW)


def test_what_fits_better_otherwise_is_not_written(readings):
    """Straightness of the x lines is small here: exchanged, it scatters by 2.5 µm, and nothing else makes that 1 µm."""
    exchanged = np.arange(len(CHANNELS))
    y, z = (CHANNELS.index(f"straightness_{axis}") for axis in "yz")
    exchanged[[y, z]] = z, y
    of_x_lines = family(readings) == 0
    fit = fit_model(replace(readings, channel=np.where(of_x_lines, exchanged[readings.channel], readings.channel)), FEW)
    assert fit.misfit.startswith("x lines, straightness_y and straightness_z: exchanged fits")


def test_a_unit_that_all_lengths_share_is_named_once(readings):
    """Straightness and distances in µinch; the angles are as they should be."""
    lengths = readings.kind != ROTATION
    named = mixed_up(readings.with_values(np.where(lengths, readings.value / 0.0254, readings.value)), FEW)
    assert named[0].startswith("all lengths: µinch in place of µm fits")


def tilted_set() -> MeasurementSet:
    """Return lines, and poses that tilt by up to 10°, read by a tracker."""
    return measured(virtual_machine(3), replace(campaign(), poses=60, tilt=np.radians(10.0)), 3)


def longer_probe(m: MeasurementSet) -> MeasurementSet:
    """Return what is read 1 mm further out along the tool."""
    out = 1e-3 * (m.stations.rotations @ m.geometry.tool.rotation)[:, :, 2]
    return m.with_values(m.value + (m.directions()[:, :3] * out[m.station]).sum(axis=1))


def half_backward(m: MeasurementSet) -> MeasurementSet:
    """Return a set in which every second place that was passed forward was passed backward, but is labelled forward."""
    there = np.where(m.direction == FORWARD, m.station, -1)
    wrong = np.unique(there[there >= 0])[::2]
    truth = virtual_machine(3)
    turned = m.stations.sense.copy()
    turned[wrong] *= -1.0
    stations = replace(m.stations, sense=turned)
    moved = station_errors(replace(m, stations=stations), truth) - station_errors(m, truth)
    return m.with_values(m.value + (m.directions() * moved[m.station]).sum(axis=1))


SHARED = {
    "": lambda m: m,
    "measured point along the tool's z: +1": longer_probe,
    "scale of all linear readings: +2": lambda m: m.with_values(m.value + 270e-6 * m.along() * (m.kind == LINEAR)),
    "direction of ": half_backward,
}


@pytest.mark.parametrize("cause", SHARED)
def test_what_all_readings_share_is_named(cause):
    """A probe 1 mm longer, 270 ppm (a laser in air that counts vacuum wavelengths), half the forward labels wrong."""
    named = mixed_up(SHARED[cause](tilted_set()), FEW)
    assert any(text.startswith(cause) for text in named) if cause else not named


def test_the_evidence_of_a_common_mode_is_that_of_a_normal_distribution(readings):
    """With K + σ²·d·dᵀ as covariance of few readings, by SciPy's density."""
    m = readings.select(np.arange(len(readings)) % 9 == 0)
    space = ParameterSpace(m, FEW)
    estimation = Estimation(m, space, alone=False)
    problem, _ = estimation.linearise(np.zeros(space.size), np.ones(len(m)))
    fitted = _Fitted(estimation, problem, [block.name for block in space.blocks])
    mode = next(mode for mode in common_modes(estimation, space) if mode.name.startswith("scale of all linear"))
    effect = estimation.free_of_nuisance(mode.effect[:, None])[:, 0]
    p = fitted.posterior
    rows = problem.rows.dense()[:, p.used] * p.spread
    plain = rows @ rows.T + np.diag(p.noise[problem.kind] ** 2)
    target = problem.target
    with_mode = multivariate_normal.logpdf(target, cov=plain + np.outer(effect, effect) * (3.0 * mode.usual) ** 2)
    gain = fitted._by_mode(effect, mode, 3.0, p).evidence - fitted.evidence
    assert gain == pytest.approx(with_mode - multivariate_normal.logpdf(target, cov=plain), rel=1e-6, abs=1e-6)


def pulled(readings: MeasurementSet) -> MeasurementSet:
    """Return readings of which run 3 is of another machine state: 200 ppm longer, bent by 20 µm."""
    along = readings.along() / np.abs(readings.along()).max()
    return readings.with_values(readings.value + np.where(readings.run == 3, 50e-6 * along + 20e-6 * along**2, 0.0))


@pytest.mark.parametrize("always", [False, True])
def test_a_fit_that_does_not_settle_names_the_runs_that_pull(readings, monkeypatch, always):
    """It does not settle with run 3, or whatever is left out: then it is refused, but can be forced."""

    def unsettled(estimation, *start):
        solution = iterate(estimation, *start)
        if always or (estimation.measurements.run == 3).any():
            raise NotSettled("did not settle", solution)
        return solution

    monkeypatch.setattr("hexapod_comp.calibration.fit.iterate", unsettled)
    fit = fit_model(pulled(readings), FEW)
    name = readings.runs[3].name
    if always:
        assert f"did not settle; the runs that pull most: {name}" in fit.misfit
    else:
        assert fit.verdict.doubts[0].startswith(f"with run {name} the fit does not settle: left out")
        assert 3 not in fit.measurements.run


def test_influence_is_what_leaving_a_run_out_does(readings):
    """Against normal equations without the run's rows."""
    space = ParameterSpace(readings, FEW)
    estimation = Estimation(readings, space)
    start = np.zeros(space.size), space.start_tolerances(), np.ones(len(KINDS))
    solution = iterate(estimation, *start, lambda _: None)
    run = readings.run[estimation.cells.first]
    p, scale = solution.posterior, 1.0 / solution.posterior.noise[solution.problem.kind]
    rows = scale[:, None] * solution.problem.rows.dense()[:, p.used]
    prior, target = np.diag(p.spread**-2.0), scale * solution.problem.target
    everything = rows.T @ rows + prior
    others = run != 3
    change = np.linalg.solve(rows[others].T @ rows[others] + prior, rows[others].T @ target[others])
    change -= np.linalg.solve(everything, rows.T @ target)
    assert influence(run, solution)[3] == pytest.approx(np.sqrt(change @ everything @ change), rel=1e-6)


@pytest.mark.parametrize("value", [1e308, -1e150, 2.0, np.nan])
def test_a_reading_that_no_machine_can_have_is_named(readings, value):
    """Squares of the first are no numbers any more."""
    spoilt = readings.value.copy()
    spoilt[5] = value
    with pytest.raises(CalibrationError, match=r"campaign, .*the value is"):
        fit_model(readings.with_values(spoilt), FEW)


def test_families_follow_the_lines(readings):
    names = [FAMILIES[n] for n in family_of_run(readings)]
    given = [run.name for run in readings.runs]
    assert all(name == f"{run[0]} lines" or run.startswith("diagonal") for name, run in zip(names, given, strict=True))
    assert {FORWARD, BACKWARD} == set(readings.direction.tolist())


def test_stated_scale(readings):
    """A laser: 0.5 ppm, and 0.5 mrad that shorten by half their square, 0.125 ppm; 2 ppm and 2 mrad: 2 ppm twice."""
    assert stated_scale(readings, FEW) == pytest.approx(np.hypot(0.5e-6, 0.125e-6), rel=1e-12)
    assert stated_scale(readings, replace(FEW, scale=2e-6, alignment=2e-3)) == pytest.approx(np.sqrt(8.0) * 1e-6)
    assert stated_scale(readings, replace(FEW, scale=0.0, alignment=0.0)) == 0.0
    with pytest.raises(ModelError, match="alignment"):
        FitSettings(alignment=np.nan)
    with pytest.raises(ModelError, match="scale"):
        FitSettings(scale=-1e-6)
