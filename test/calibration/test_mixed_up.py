"""Mix-ups in the readings, and the cause that the fit names.

The tests make each mistake in the readings of a machine that the model describes.
"""

from __future__ import annotations

import re
from dataclasses import replace
from functools import cache, partial
from itertools import product

import numpy as np
import pytest
from calibration_helpers import FEW, assert_recorded, campaign, measured, virtual_machine
from foreign_machines import machines
from helpers import long_test
from scipy.stats import multivariate_normal

from hexapod_comp.calibration.estimator import Estimation, Further, log_evidence
from hexapod_comp.calibration.fit import fit_model, mixed_up
from hexapod_comp.calibration.mistakes import Mistake, family_of_run, in_frame, mistakes_of_poses, mistakes_of_values
from hexapod_comp.calibration.mixups import SWAPPED, _Fitted, mixups, possible_common_errors
from hexapod_comp.calibration.parameters import FitSettings, ParameterSpace
from hexapod_comp.errors import CalibrationError
from hexapod_comp.formats.paths import config_file
from hexapod_comp.machine.geometry import load_geometry
from hexapod_comp.machine.model import RealMachine
from hexapod_comp.measurements.campaign import Campaign
from hexapod_comp.measurements.readings import CHANNELS, FORWARD, KINDS, MeasurementSet
from hexapod_comp.measurements.stations import station_errors
from hexapod_comp.pose import Pose, rotation_from_vector
from hexapod_comp.virtual.imperfections import ImperfectionBounds, draw_model, with_length_map

ROTATION_X = CHANNELS.index("rotation_x")
LINEAR, ROTATION = KINDS.index("linear"), KINDS.index("rotation")


@pytest.fixture(scope="module")
def readings() -> MeasurementSet:
    """Return the readings of a machine that the model describes."""
    return measured(virtual_machine(3), campaign(), 3)


def family(readings: MeasurementSet) -> np.ndarray:
    """Return the family of each reading."""
    return family_of_run(readings)[readings.run]


def reversed_where(readings: MeasurementSet, members: np.ndarray) -> MeasurementSet:
    return readings.with_values(np.where(members, -readings.value, readings.value))


def test_which_mistakes_are_tried(readings):
    """The names are recorded; units are as their definitions. A frame corrected and made wrong again gives the same
    readings."""
    few = readings.select(readings.run % 8 == 0)
    names = [mistake.name for mistake in (*mistakes_of_values(few), *mistakes_of_poses(few))]
    assert_recorded("mistakes", "".join(f"{name}\n" for name in names))
    size = {"µinch": 0.0254e-6, "nm": 1e-9, "0.1 µm": 1e-7, "µm": 1e-6, "0.01 mm": 1e-5, "mm": 1e-3}
    size |= {"µrad": 1e-6, "mrad": 1e-3, "arcsec": np.radians(1.0 / 3600.0), "mdeg": np.radians(1e-3)}
    units = [(m, re.search(": (.*?) in place of ([^,]*)", m.name)) for m in mistakes_of_values(few)]
    for mistake, (is_in, stated) in [(m, found.groups()) for m, found in units if found]:
        np.testing.assert_allclose(mistake.factor[mistake.factor != 1.0], size[is_in] / size[stated])
        np.testing.assert_array_equal(mistake.corrected().value, mistake.factor[few.kind] * few.value)
    framed = [m.corrected() for m in mistakes_of_poses(few) if "mirrored" in m.name or "turned about z" in m.name]
    for other in filter(None, framed):  # frames are turned or mirrored, not stretched
        np.testing.assert_allclose(*(np.linalg.norm(m.points(), axis=1) for m in (other, few)), rtol=1e-9)
    assert sum(other is not None for other in framed) >= 5
    frame = np.array([[0.0, 0.0, -1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
    for axial in (False, True):
        back = in_frame(in_frame(few, frame, axial), frame.T, axial)
        np.testing.assert_allclose(back.value, few.value, atol=1e-15)
        np.testing.assert_allclose(back.stations.positions, few.stations.positions, atol=1e-12)
        np.testing.assert_array_equal(back.channel, few.channel)
        np.testing.assert_array_equal(back.stations.sense[:, :3], few.stations.sense[:, :3])
    tilt = rotation_from_vector(np.array([0.01, 0.02, 0.03]))
    few = replace(few, stations=replace(few.stations, rotations=few.stations.rotations @ tilt))
    turned = [in_frame(m, other).stations for m, other in ((in_frame(few, -frame), -frame), (few, frame @ frame))]
    np.testing.assert_allclose(*(stations.rotations for stations in turned), atol=1e-12)


def far_end_first(m: MeasurementSet) -> MeasurementSet:
    """Return the readings with the values of the lines along y written from the last point to the first."""
    values = m.value.copy()
    of_pass = np.column_stack([m.run, m.channel, m.direction, m.cycle])
    for one in np.unique(of_pass[family(m) == 1], axis=0):
        members = np.flatnonzero((of_pass == one).all(axis=1))
        values[members] = m.value[members[::-1]]
    return m.with_values(values)


def half_backward(m: MeasurementSet) -> MeasurementSet:
    """Return readings in which every second place labelled forward was in fact passed backward."""
    there = np.where(m.direction == FORWARD, m.station, -1)
    wrong = np.unique(there[there >= 0])[::2]
    truth = virtual_machine(3)
    turned = m.stations.sense.copy()
    turned[wrong] *= -1.0
    stations = replace(m.stations, sense=turned)
    moved = station_errors(replace(m, stations=stations), truth) - station_errors(m, truth)
    return m.with_values(m.value + (m.directions() * moved[m.station]).sum(axis=1))


CAUSES = {
    "rotations_reversed": lambda m: reversed_where(m, m.kind == ROTATION),
    "microinches": lambda m: m.with_values(np.where(m.kind == ROTATION, m.value, m.value / 0.0254)),
    "every_second_rotation": lambda m: reversed_where(m, (m.channel == ROTATION_X) & (m.run % 2 == 0)),
    "far_end_first": far_end_first,
    "every_second_run": lambda m: reversed_where(m, m.run % 2 == 0),  # 13 of 25 runs: the other 12 are named
    "half_backward": half_backward,
}


@pytest.mark.parametrize("cause", CAUSES)
def test_the_cause_is_named(readings, cause):
    assert_recorded(f"mixups/{cause}", "".join(f"{line}\n" for line in mixed_up(CAUSES[cause](readings), FEW)))


def test_exchanged_channels_are_named_where_the_plain_model_lacks_much(tmp_path):
    """Exchanged channels are named although length maps, not in the model, leave rotations far above the noise."""
    settings = FitSettings(blocks=("pitch", "map", "field displacement", "field rotation"), field_degree=3)
    machine = machines()["framed"]
    geometry = load_geometry(machine.write(tmp_path / "machine.yaml"))
    truth = RealMachine(
        geometry, with_length_map(draw_model(geometry, ImperfectionBounds(joint=800e-6), 3), geometry, 3)
    )
    m = measured(truth, Campaign(machine.box, float(np.ptp(machine.box, axis=0).min()), 0.03, "5-D", 4), 3)
    assert mixed_up(m, settings) == []
    x, y = ROTATION_X, CHANNELS.index("rotation_y")
    both = np.isin(m.channel, (x, y))
    named = mixed_up(replace(m, channel=np.where(both, x + y - m.channel, m.channel)), settings)
    assert named[0].startswith("rotation_x and rotation_y: exchanged")


def with_measured_struts(m: MeasurementSet) -> MeasurementSet:
    """Return readings of a machine whose struts stop 5 µm off, with the stops measured by the encoders."""
    off = 5e-6 * np.random.default_rng(1).standard_normal(m.stations.commands.shape)
    stopped = replace(m, stations=replace(m.stations, commands=m.stations.commands + off))
    moved = station_errors(stopped, virtual_machine(3)) - station_errors(m, virtual_machine(3))
    return stopped.with_values(m.value + (m.directions() * moved[m.station]).sum(axis=1))


def test_readings_of_a_compensated_machine_show_no_mistake(readings, monkeypatch):
    """Struts that bring the tool to its commanded poses, read with a scatter of 0.5 µm; so all values are noise."""
    m, truth, rng = readings, virtual_machine(3), np.random.default_rng(2)
    poses = (Pose(p, r) for p, r in zip(m.stations.positions, m.stations.rotations, strict=True))
    struts = np.array([truth.commands_for(pose)[0] for pose in poses])
    stations = replace(m.stations, commands=struts + rng.normal(0.0, 0.5e-6, struts.shape))
    compensated = replace(m, stations=stations).with_values(rng.normal(0.0, 0.2e-6, len(m)))
    assert mixed_up(compensated, FEW) == []
    monkeypatch.setattr(_Fitted, "_noise_alone", lambda *_: False)
    assert mixed_up(compensated, FEW) != []


def test_small_errors_left_by_a_compensation_show_no_mistake(readings, monkeypatch):
    """Struts commanded by a model whose joints are 3 µm off; no unit of the readings, right by construction, is named.

    The fit has kept a field, so mistakes are tried. Without regard to the compensation, small rotations are a
    coincidence that a larger unit makes more probable: another unit of the rotations was named for 6 of 6 seeds.
    """
    truth, rng = virtual_machine(3), np.random.default_rng(0)
    m = readings.select((readings.run % 2 == 0) & (readings.station % 3 == 0))
    off = truth.model.base_deviation + rng.normal(0.0, 3e-6, (6, 3))
    model = RealMachine(truth.geometry, replace(truth.model, base_deviation=off))
    poses = (Pose(p, r) for p, r in zip(m.stations.positions, m.stations.rotations, strict=True))
    m = replace(m, stations=replace(m.stations, commands=np.array([model.commands_for(p)[0] for p in poses])))
    left = (m.directions() * station_errors(m, truth)[m.station]).sum(axis=1)
    m = m.with_values(left + rng.normal(0.0, 1e-6, len(m)))
    blocks = ("pitch", "wave", "backlash", "field displacement", "field rotation")
    everything = Estimation(m, ParameterSpace(m, replace(FEW, blocks=blocks)), check_count=False)
    assert mixups(everything, blocks) == []
    monkeypatch.setattr(_Fitted, "compensated", False)
    assert "rotation: arcsec in place of µrad" in " ".join(mixups(everything, blocks))


@pytest.mark.parametrize(
    ("frame", "name"),
    [
        (np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]), "the work frame: turned about z by -90°"),
        pytest.param(np.diag([1.0, -1.0, 1.0]), "y: mirrored", marks=long_test),
    ],
)
def test_another_frame_is_named(readings, frame, name):
    """A wrong frame is named by the change that corrects it; measured strut lengths do not depend on the frame."""
    named = mixed_up(in_frame(with_measured_struts(readings), frame), FEW)
    assert named[0].startswith(f"{name} fits 30.5 times better" if "turned" in name else name)
    assert len(named) == 1


def test_a_fit_that_fails_names_the_cause(readings, monkeypatch):
    def fail(*_):
        raise CalibrationError("fit", "did not settle")

    def with_nonsense(m):
        yield Mistake("no numbers", partial(m.with_values, np.full(len(m), np.nan)))
        yield from mistakes_of_values(m)

    monkeypatch.setattr("hexapod_comp.calibration.fit._fit", fail)
    monkeypatch.setattr("hexapod_comp.calibration.mixups.mistakes_of_values", with_nonsense)
    for part in ("other_directions", "_mistakes_of_poses"):
        monkeypatch.setattr(_Fitted, part, fail)
    with pytest.raises(CalibrationError, match=r"did not settle\n  x lines: sign reversed fits 30\.4 times better$"):
        fit_model(reversed_where(readings, family(readings) == 0), FEW)
    with pytest.raises(CalibrationError, match=r"did not settle$"):
        fit_model(readings, FEW)


def test_the_sign_of_everything_shows_in_the_backlash_alone(readings):
    """With all signs reversed the readings fit a machine with negative backlash, which is refused."""
    with pytest.raises(CalibrationError, match=SWAPPED):
        fit_model(readings.with_values(-readings.value), FEW)


def test_the_most_probable_reversed_runs_are_those_of_all_choices():
    """The truth is the least quadratic form of all 2⁶ choices of six runs in two families, where signs interact."""
    every, found = np.array(list(product((0.0, 1.0), repeat=6))), []
    for seed in range(12):
        rows = np.random.default_rng(seed).standard_normal((7, 5))
        gram = rows @ rows.T
        further = Further(gram[1:, 1:], gram[1:, 0], np.zeros((0, 6)))
        chosen = _Fitted._most_probable(None, further, np.eye(6), np.array([0, 0, 0, 1, 1, 1]))
        values = 2.0 * every @ gram[1:, 0] + np.einsum("nk,kl,nl->n", every, gram[1:, 1:], every)
        found.append(np.array_equal(chosen, every[values.argmin()]))
    assert all(found), found


def test_what_fits_better_otherwise_is_not_written(readings):
    """Exchanged straightness of the x-lines, which adds 2.5 µm of scatter, is a reason not to write the model."""
    exchanged = np.arange(len(CHANNELS))
    y, z = (CHANNELS.index(f"straightness_{axis}") for axis in "yz")
    exchanged[[y, z]] = z, y
    of_x_lines = family(readings) == 0
    fit = fit_model(replace(readings, channel=np.where(of_x_lines, exchanged[readings.channel], readings.channel)), FEW)
    assert fit.misfit.startswith("x lines, straightness_y and straightness_z: exchanged fits")


@cache
def tilted_set() -> MeasurementSet:
    """Return lines, and poses that tilt by up to 10°, read by a tracker."""
    return measured(virtual_machine(3), campaign("1-D", poses=60, tilt=np.radians(10.0)), 3)


def longer_probe(m: MeasurementSet) -> MeasurementSet:
    """Return the readings of a measured point 1 mm further out along the tool."""
    out = 1e-3 * (m.stations.rotations @ m.geometry.tool.rotation)[:, :, 2]
    return m.with_values(m.value + (m.directions()[:, :3] * out[m.station]).sum(axis=1))


SHARED = {
    "nothing": lambda m: m,
    "longer_probe": longer_probe,
    "scale": lambda m: m.with_values(m.value + 270e-6 * m.along() * (m.kind == LINEAR)),
}


@pytest.mark.parametrize("cause", SHARED)
def test_what_all_readings_share_is_named(cause):
    """A probe 1 mm longer, and a scale of 270 ppm (vacuum wavelengths in air): each is named.

    Of the scale, either the lines or the tracker's poses may be wrong: both are named.
    """
    assert_recorded(f"mixups/{cause}", "".join(f"{line}\n" for line in mixed_up(SHARED[cause](tilted_set()), FEW)))


@pytest.mark.parametrize("axes", [np.diag([1.0, -1.0, 1.0]), np.eye(3)[[1, 0, 2]]], ids=["mirrored", "exchanged"])
def test_left_handed_coordinates_of_a_tracker_are_named(axes):
    """The other 120 readings are of lines, and right. The tracker stands 3 m away."""
    m = tilted_set()
    work, first, place = m.geometry.work, CHANNELS.index("position_x"), m.kind == KINDS.index("position")
    meant, read = (m.points() - work.position) @ work.rotation, np.zeros((len(m.stations), 3))
    read[m.station[place], m.channel[place] - first] = m.value[place]
    shown = (meant + read + [3.0, 0.0, 1.0]) @ axes.T - meant
    value = m.value.copy()
    value[place] = shown[m.station[place], m.channel[place] - first]
    (found,) = mixed_up(m.with_values(value), FEW)
    assert found.startswith("coordinates of poses: left-handed, since an axis is mirrored or two are exchanged, fits ")


def test_the_evidence_of_a_common_error_is_that_of_a_normal_distribution(readings):
    """The truth is SciPy's normal density of few readings with the covariance K + σ²·d·dᵀ."""
    m = readings.select(np.arange(len(readings)) % 9 == 0)
    space = ParameterSpace(m, FEW)
    estimation = Estimation(m, space, check_count=False)
    fitted = _Fitted(estimation)
    errors = possible_common_errors(estimation, fitted.problem)
    error = next(error for error in errors if error.name.startswith("scale of all linear"))
    effect = fitted.problem.free_of_nuisance(error.effect[:, None])[:, 0]
    p = fitted.posterior
    rows, target, noise = fitted.rows * p.spread, fitted.problem.target, p.noise[fitted.problem.kind]
    plain = rows @ rows.T + np.diag(noise**2)
    with_error = multivariate_normal.logpdf(target, cov=plain + np.outer(effect, effect) * (3.0 * error.usual) ** 2)
    gain = fitted._amplitude_fit(effect, error, 3.0, p).evidence - log_evidence(fitted.problem, p)
    assert gain == pytest.approx(with_error - multivariate_normal.logpdf(target, cov=plain), rel=1e-6, abs=1e-6)


@pytest.mark.parametrize(
    ("in_file", "named"),
    [
        ([5, 5, 5, 5, 5, -5], ("lead of all screws", 5.0)),
        ([10, 10, 10, -10, 10, -10], ("lead of strut_4", 20.0)),
        ([10, 10, 10, 10, 10, -10], None),
    ],
)
def test_a_wrong_lead_of_screws_that_joints_turn_is_named(in_file, named):
    """The machine's leads are 10 mm, one of them left-handed. The prior of a mistake draws the estimate towards 0."""
    geometry = load_geometry(config_file("example_6_6.yaml"))
    box = np.array([[-0.05, -0.05, 0.36], [0.05, 0.05, 0.42]])
    plan = Campaign(box, 0.05, 0.05, None, 0, poses=60, tilt=np.radians(8.0))
    m = measured(RealMachine(geometry, draw_model(geometry, ImperfectionBounds(joint=50e-6), 4)), plan, 4)
    wrong = replace(m, geometry=replace(geometry, screw_lead=1e-3 * np.array(in_file, dtype=float)))
    found = mixed_up(wrong, FitSettings(blocks=("pitch", "map")))
    if named is None:
        assert found == []
        return
    name, amplitude = found[0].split(" mm, ")[0].split(": ")
    assert (name, float(amplitude)) == (named[0], pytest.approx(named[1], rel=0.1))
