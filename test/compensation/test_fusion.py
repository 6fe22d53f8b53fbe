"""Drift measured by a pose instrument: the Kalman filter, and how the compensator applies its result.

The truth is the Gaussian posterior of all readings at once, by dense matrices; rigid motion of the whole machine;
finite differences of the core's forward kinematics; and a second machine that has drifted.
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
from foreign_machines import machines as zoo
from foreign_machines import with_frames
from helpers import distances
from scipy.spatial.transform import Rotation

from hexapod_comp.compensation.compensator import Compensator, drifted
from hexapod_comp.compensation.fusion import (
    DRIFT_STATES,
    DriftFilter,
    Fusion,
    FusionRules,
    PoseReading,
    checked_covariance,
    observation,
)
from hexapod_comp.errors import CommandError, ModelError
from hexapod_comp.machine.geometry import HexapodGeometry, load_geometry
from hexapod_comp.machine.model import MachineModel
from hexapod_comp.pose import Pose

CONFIG = Path(__file__).resolve().parents[2] / "config"

RULES = FusionRules()


@pytest.fixture(scope="module", params=["framed", "hanging", "example_6_6"])
def geometry(request, tmp_path_factory) -> HexapodGeometry:
    if request.param == "example_6_6":
        return load_geometry(CONFIG / "example_6_6.yaml")
    return load_geometry(zoo()[request.param].write(tmp_path_factory.mktemp("machine") / "geometry.yaml"))


@pytest.fixture(scope="module")
def paper() -> HexapodGeometry:
    return load_geometry(CONFIG / "paper.yaml")


def poses(geometry: HexapodGeometry, count: int, seed: int = 0, reach: float = 0.03) -> list[Pose]:
    """Return platform poses near home."""
    rng, home = np.random.default_rng(seed), geometry.home
    turns = Rotation.from_rotvec(0.05 * rng.standard_normal((count, 3))).as_matrix()
    shifts = reach * rng.uniform(-1.0, 1.0, (count, 3))
    return [Pose(home.position + shift, home.rotation @ turn) for shift, turn in zip(shifts, turns, strict=True)]


# ---- the filter alone ----


def test_the_filter_is_the_posterior_of_all_readings_at_once():
    """The truth is the joint Gaussian of random walk and readings, conditioned by dense matrices at once."""
    rng, count, states = np.random.default_rng(1), 12, 5
    rules = FusionRules(drift_rate=0.7, initial_deviation=1.3, limit=1e9, gate_probability=1.0 - 1e-12)
    times = np.sort(rng.uniform(0.0, 20.0, count))
    matrices = rng.standard_normal((count, 3, states))
    noises = [root @ root.T + np.eye(3) for root in rng.standard_normal((count, 3, 3))]
    readings = 3.0 * rng.standard_normal((count, 3))
    ours = DriftFilter(rules, states)
    for time, reading, matrix, noise in zip(times, readings, matrices, noises, strict=True):
        ours.predict(time)
        ours.predict(time - 1.0)  # a late reading changes neither covariance nor time
        ours.update(reading, matrix, noise)
    since = times - times[0]
    walk = np.kron(rules.initial_deviation**2 + rules.drift_rate**2 * np.minimum.outer(since, since), np.eye(states))
    big, noise = np.zeros((3 * count, states * count)), np.zeros((3 * count, 3 * count))
    for n in range(count):
        big[3 * n : 3 * n + 3, states * n : states * n + states] = matrices[n]
        noise[3 * n : 3 * n + 3, 3 * n : 3 * n + 3] = noises[n]
    gain = walk @ big.T @ np.linalg.inv(big @ walk @ big.T + noise)
    mean, covariance = gain @ readings.ravel(), walk - gain @ big @ walk
    np.testing.assert_allclose(ours.state, mean[-states:], rtol=1e-9)
    np.testing.assert_allclose(ours.covariance, covariance[-states:, -states:], rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize(
    ("size", "off"), [(np.nan, "nan mm, nan mrad"), (5e-5, r"0\.05 mm, 0\.1 mrad"), (10.0, r"1e\+04 mm, 2e\+04 mrad")]
)
def test_a_wild_reading_moves_nothing(paper, size, off):
    """The allowed chi-square of six degrees of freedom is that of a table for 99.9 %."""
    ours, matrix = DriftFilter(RULES), observation(paper, paper.home, paper.home @ paper.tool)
    ours.predict(0.0)
    for _ in range(10):
        ours.update(np.zeros(6), matrix, RULES.covariance())
    before = ours.state.copy(), ours.covariance.copy()
    text = rf"^the measured pose is {off} from the estimate: chi-square \S+, allowed 22\.5 \(probability 0\.999\)$"
    with pytest.raises(CommandError, match=text) as caught:
        ours.update(np.array([0, size, 0, 2.0 * size, 0, 0]), matrix, RULES.covariance())
    assert caught.value.reason == "wild_pose"
    np.testing.assert_array_equal(ours.state, before[0])
    np.testing.assert_array_equal(ours.covariance, before[1])


def test_a_drift_beyond_the_limit_is_held():
    """Six states that are observed directly, without noise, become the reading; the limit itself is allowed."""
    ours = DriftFilter(FusionRules(initial_deviation=1e-3, limit=5e-5), 6)
    text = r"^the drift would be 0\.3000 mm, allowed 0\.05 mm: the previous drift stays in use$"
    with pytest.raises(CommandError, match=text) as caught:
        ours.update(np.array([0, 1e-5, -3e-4, 0, 0, 0]), np.eye(6), np.zeros((6, 6)))
    assert caught.value.reason == "drift_limit"
    assert not ours.state.any()
    ours.update(np.array([0, 1e-5, -5e-5, 0, 0, 0]), np.eye(6), np.zeros((6, 6)))
    assert ours.state.tolist() == [0, 1e-5, -5e-5, 0, 0, 0]


# ---- filter and machine ----


def test_what_is_observed_is_how_the_tool_moves(geometry):
    """The truth is finite differences of the core's forward kinematics with the drift applied."""
    compensator = Compensator(geometry, MachineModel(geometry.name))
    close = 0.05 if geometry.name == "example_6_6" else 1e-3  # the observation omits the rotation of screws
    for place in poses(geometry, 3, 2):
        struts, tool = distances(geometry, place), place @ geometry.tool
        expected, step = observation(geometry, place, tool), 1e-4
        for state in range(DRIFT_STATES):
            seen = []
            for sign in (1.0, -1.0):
                compensator.set_drift(sign * step * np.eye(DRIFT_STATES)[state])
                found = compensator.estimate(struts)
                turn = Rotation.from_matrix(found[3:].reshape(3, 3) @ tool.rotation.T).as_rotvec()
                seen.append(np.concatenate([found[:3] - tool.position, turn]))
            np.testing.assert_allclose((seen[0] - seen[1]) / (2.0 * step), expected[:, state], atol=close)
    compensator.set_drift(np.zeros(DRIFT_STATES))
    undrifted = compensator.estimate(struts)
    tool = Pose(undrifted[:3].copy(), undrifted[3:].reshape(3, 3).copy())
    drift = np.array([1e-4, -2e-4, 3e-4, 1e-4, 2e-4, -1e-4, *[0.0] * 6])
    compensator.set_drift(drift)
    found = compensator.estimate(struts)
    turn = Rotation.from_rotvec(drift[3:6] / geometry.characteristic_length).as_matrix()
    about = geometry.home.position
    np.testing.assert_allclose(found[:3], about + drift[:3] + turn @ (tool.position - about), atol=2e-7)
    np.testing.assert_allclose(found[3:].reshape(3, 3), turn @ tool.rotation, atol=2e-7)


def followed(
    geometry: HexapodGeometry, drift: np.ndarray, wild: float = 0.0, count: int = 300
) -> tuple[Compensator, Fusion]:
    """Return a compensator and its fusion after readings of a machine with a drift and a share of outliers."""
    compensator, rng = Compensator(geometry, MachineModel(geometry.name)), np.random.default_rng(11)
    truth = Compensator(geometry, drifted(geometry, MachineModel(geometry.name), drift))
    fusion = Fusion(compensator, FusionRules(initial_deviation=3e-5))
    rejected = 0
    for n, place in enumerate(poses(geometry, count, 4)):
        struts, at = distances(geometry, place), float(n)
        real = truth.estimate(struts)
        position = real[:3] + 1e-6 * rng.standard_normal(3)
        if rng.random() < wild:
            position = position + rng.choice([-1.0, 1.0]) * rng.uniform(3e-4, 1e-2, 3)
        fusion.add_struts(struts, at - 0.01)
        assert not fusion.add(PoseReading(Pose(position, real[3:].reshape(3, 3)), at, RULES.covariance()))
        rejected += len(fusion.add_struts(struts, at + 0.01))
        if n % 10 == 9:
            fusion.feed(compensate=True)
    assert (rejected > 0) == (wild > 0.0)
    return compensator, fusion


def test_the_compensator_follows_the_drift(geometry):
    """At poses without a reading, the commands leave a tenth of the drifted machine's tool error."""
    drift = np.array([20, -15, 10, 8, -5, 12, 20, -10, 15, -20, 5, 10]) * 1e-6
    compensator, fusion = followed(geometry, drift, 0.0 if geometry.name == "example_6_6" else 0.05)
    truth = Compensator(geometry, drifted(geometry, MachineModel(geometry.name), drift))
    left, before = [], []
    compensator.set_ramp_rate(1.0)
    for place in poses(geometry, 20, 9):
        compensator.reset()
        for n in range(3):  # the first command starts from the struts, the next apply the drift
            commands = compensator.correct(geometry.tool_pose(place), 0.02 * n).command
        wanted = (place @ geometry.tool).position
        left.append(truth.estimate(commands)[:3] - wanted)
        before.append(truth.estimate(distances(geometry, place))[:3] - wanted)
    assert np.sqrt(np.mean(np.square(left))) < 0.1 * np.sqrt(np.mean(np.square(before)))
    np.testing.assert_array_equal(compensator.drift, fusion.drift)


def test_an_instrument_whose_frame_is_turned_about_the_tool_is_followed(geometry):
    """The frame's displacement at home is zero. Its rotation × characteristic length is the size of the difference.

    The truth is the frame's rigid motion of the tool's poses, at places without a reading.
    """
    compensator, rng = Compensator(geometry, MachineModel(geometry.name)), np.random.default_rng(5)
    real = Compensator(geometry, MachineModel(geometry.name))
    turn, about = Rotation.from_rotvec([1.2e-3, -0.9e-3, 2.4e-3]), (geometry.home @ geometry.tool).position
    size = turn.magnitude() * geometry.characteristic_length
    fusion = Fusion(compensator, FusionRules(initial_deviation=size, limit=5.0 * size))

    def seen(struts: np.ndarray) -> Pose:
        tool = real.estimate(struts)
        return Pose(about + turn.apply(tool[:3] - about), turn.as_matrix() @ tool[3:].reshape(3, 3))

    for n, place in enumerate(poses(geometry, 30, 4)):
        struts = distances(geometry, place)
        pose = seen(struts)
        fusion.add_struts(struts, n - 0.01)
        noisy = Pose(pose.position + 2e-6 * rng.standard_normal(3), pose.rotation)
        assert not fusion.add(PoseReading(noisy, n, RULES.covariance()))
        assert not fusion.add_struts(struts, n + 0.01)
    for place in poses(geometry, 10, 9):
        struts = distances(geometry, place)
        found = fusion.with_drift(compensator.estimate(struts))
        np.testing.assert_allclose(found[:3], seen(struts).position, atol=5e-6)


def test_the_estimate_is_the_weighted_pose_and_the_compensation_need_not_follow(paper):
    compensator, fusion = followed(paper, np.array([0, 0, 2e-5, *[0.0] * 9]))
    fusion.feed(compensate=False)
    assert not compensator.drift.any()
    struts = distances(paper, paper.home)
    seen = fusion.with_drift(compensator.estimate(struts))
    compensator.set_drift(fusion.drift)
    np.testing.assert_allclose(seen, compensator.estimate(struts), atol=1e-9)
    assert seen[2] - (paper.home @ paper.tool).position[2] == pytest.approx(2e-5, abs=1e-6)


def test_another_model_and_a_reset_begin_without_drift(paper):
    compensator, fusion = followed(paper, np.array([0, 0, 2e-5, *[0.0] * 9]), count=20)
    assert compensator.drift.any()
    compensator.set_model(MachineModel(paper.name, "new"))
    assert not compensator.drift.any()
    fusion.feed(compensate=True)
    assert (fusion.drift.any(), compensator.drift.any(), fusion.count) == (False, False, 0)


@pytest.mark.parametrize("wrong", [np.zeros(6), np.full(12, np.nan)])
def test_a_drift_that_is_none_is_refused(paper, wrong):
    compensator = Compensator(paper, MachineModel(paper.name))
    with pytest.raises(ModelError, match="12 finite numbers"):
        compensator.set_drift(wrong)
    with pytest.raises(ModelError, match="12 finite numbers"):
        compensator.restore({**compensator.snapshot(), "drift": wrong.tolist()})


@pytest.mark.parametrize(
    ("before", "share", "text"),
    [
        (0.0, 1.0, r"does not lie between two strut readings at most 0\.1 s apart$"),
        (0.16, 1.0, "does not lie between"),
        (0.125, 0.1, "forward kinematics find no pose for the struts at the time of the measured pose: "),
    ],
    ids=["0.2 s around it", "none before it", "no pose"],
)
def test_a_reading_needs_struts_of_its_moment(paper, before, share, text):
    fusion, struts = Fusion(Compensator(paper, MachineModel(paper.name)), RULES), distances(paper, paper.home)
    fusion.add_struts(share * struts, before)
    reading = PoseReading(paper.home @ paper.tool, 0.15, RULES.covariance())
    (error,) = [*fusion.add(reading), *fusion.add_struts(share * struts, 0.2)]
    assert (error.reason, fusion.count) == ("no_estimate" if share < 1.0 else "no_struts", 0)
    assert re.search(text, str(error))


def test_a_reading_of_another_tool_is_not_used(tmp_path):
    """A reading that waits for struts while the tool is changed was measured with the old tool."""
    geometry = load_geometry(with_frames("framed").write(tmp_path / "geometry.yaml"))
    compensator, struts = Compensator(geometry, MachineModel(geometry.name)), distances(geometry, geometry.home)
    fusion = Fusion(compensator, RULES)
    for tool, count in (("tool", 1), ("probe", 1), ("probe", 2)):
        at = fusion.last + 1.0 if fusion.count else 0.0
        fusion.add_struts(struts, at - 0.01)
        fusion.add(PoseReading(geometry.home @ compensator.geometry.tool, at, RULES.covariance()))
        compensator.set_tool(tool)
        assert (fusion.add_struts(struts, at + 0.01), fusion.count) == ([], count)


def test_a_machine_that_moves_makes_its_own_reading_uncertain(paper):
    """Clocks 1 ms apart make 0.1 mm at 100 mm/s: the reading is accepted, with almost no weight."""
    fusion = Fusion(Compensator(paper, MachineModel(paper.name)), RULES)

    def moved(way: float) -> Pose:
        return Pose(paper.home.position + np.array([way, 0.0, 0.0]), np.eye(3))

    home, ahead = distances(paper, paper.home), distances(paper, moved(1e-3))
    fusion.add_struts(home, 7.0)
    fusion.add_struts(ahead, 7.01)
    late = moved(6e-4) @ paper.tool
    assert not fusion.add(PoseReading(late, 7.005, RULES.covariance()))
    # One standard deviation off; the filter's own variance adds 0.5 % to the variance of the clocks
    assert (fusion.count, fusion.filter.chi_square) == (1, pytest.approx(1.0, rel=0.01))
    assert np.abs(fusion.drift).max() < 1e-6


@pytest.mark.parametrize(
    ("changes", "valid"),
    [
        ({}, True),
        *(({n: value}, False) for n, value in ((0, np.nan), (0, -1.0), (0, 0.0), (1, 0.5), (7, np.inf))),
        *(({1: value}, value < 1e-6) for value in (0.9e-6, 1.1e-6)),  # asymmetry
        *(({1: 1.0 - e, 6: 1.0 - e}, e > 1e-9) for e in (1.5e-9, 0.5e-9)),  # correlation, with the eigenvalue e
    ],
)
def test_a_covariance_that_is_none_is_rejected(changes, valid):
    """The variances are 4 µm² and 0.04 µrad²; the changes are relative to them."""
    relative, size = np.eye(6), np.repeat([2e-6, 2e-7], 3)
    relative.flat[list(changes)] = list(changes.values())
    matrix = relative * np.outer(size, size)
    if valid:
        np.testing.assert_array_equal(checked_covariance(matrix.ravel().tolist(), RULES), matrix)
        return
    with pytest.raises(CommandError, match="symmetric and positive definite") as caught:
        checked_covariance(matrix.ravel().tolist(), RULES)
    assert caught.value.reason == "covariance"


def test_a_message_without_covariance_has_the_parameters() -> None:
    np.testing.assert_allclose(checked_covariance([0.0] * 36, RULES), np.diag([4e-12] * 3 + [1e-10] * 3), rtol=1e-15)
