"""Proposed campaigns: gains against dense matrices, expected errors against ``plan``, limits of each machine."""

from dataclasses import replace
from pathlib import Path

import calibration_helpers as small
import numpy as np
import pytest
from foreign_machines import machine_names, machines

from hexapod_comp.calibration.candidates import MeasuringBox, candidates
from hexapod_comp.calibration.design import (
    TIMES,
    Goal,
    Proposal,
    RemainingError,
    Times,
    plan,
    proposal_report,
    propose,
    verdict,
)
from hexapod_comp.calibration.parameters import FitSettings
from hexapod_comp.errors import CalibrationError
from hexapod_comp.machine.geometry import load_geometry
from hexapod_comp.machine.load import Load
from hexapod_comp.measurements.campaign import Campaign, campaign_text, load_campaign, template

HOUR = 3600.0
UM = 1e-6


def proposed(
    error: float, tilt_deg: float, instruments: tuple[str, ...], hours: float, base: Campaign | None = None
) -> Proposal:
    """Return a plan in the paper's box whose fit has structure, pitch, wave and backlash."""
    tilt = float(np.radians(tilt_deg))
    place = MeasuringBox(small.paper(), small.BOX, np.eye(3), tilt)
    return propose(place, Goal(error, tilt, instruments, hours * HOUR), small.FEW, base)


def test_gains_are_those_of_the_whole_matrices() -> None:
    """Each gain equals the decrease of tr(M·C) when C is inverted again with the candidate's rows, to rounding."""
    rng = np.random.default_rng(1)
    seen = [rng.standard_normal((k, 9)) for k in (1, 3, 4, 2)]
    root = rng.standard_normal((9, 5))
    square = root @ root.T
    criterion = RemainingError(seen, square)

    def left(chosen: list[int]) -> float:
        rows = np.concatenate([np.zeros((0, 9)), *(seen[n] for n in chosen)])
        return float(np.trace(square @ np.linalg.inv(np.eye(9) + rows.T @ rows)))

    chosen: list[int] = []
    for n in (2, 0, 2):
        wanted = [left(chosen) - left([*chosen, k]) for k in range(4)]
        np.testing.assert_allclose(criterion.gains(), wanted, rtol=1e-9)
        criterion.add(n)
        chosen.append(n)
        assert (square * criterion.covariance).sum() == pytest.approx(left(chosen), rel=1e-9)
    assert (square * criterion.after_all()).sum() == pytest.approx(left([0, 1, 2, 3]), rel=1e-9)


def test_what_limits_a_goal() -> None:
    """A linear laser cannot show the error of a tilted tool beside a level one, since its zeros are unknown."""
    blind = proposed(1.0 * UM, 10.0, ("linear",), 3.0)
    assert not blind.met
    assert blind.unseen > blind.goal.error
    assert blind.needed is None
    assert "these instruments do not show" in verdict(blind)
    short = proposed(1.5 * UM, 0.0, ("linear",), 1.0)
    assert not short.met
    assert short.needed is not None
    assert short.needed > HOUR
    # The proposed runs fit into the hour, although the search went on to find the time that the goal needs.
    runs = short.campaign.runs
    spent = sum(TIMES[run.instrument].of(run, short.campaign.cycles) for run in runs) + TIMES["linear"].first
    assert spent == pytest.approx(short.seconds, abs=1e-6)
    assert spent <= HOUR
    assert proposed(1.5 * UM, 0.0, ("linear",), short.needed / HOUR + 0.01).met


def test_the_machine_s_repeatability_counts() -> None:
    """The expected error agrees with ``plan``; a goal below the scatter of the stops is out of reach."""
    loose = small.campaign(repeatability=1.0 * UM)
    result = proposed(2.2 * UM, 0.0, ("linear",), 6.0, loose)
    assert result.met
    assert 3.0**0.5 * UM < result.worst <= 2.2 * UM
    judged = plan(template(result.campaign, small.paper()), result.campaign, small.FEW).level
    assert judged is not None
    assert result.expected["level"] == pytest.approx(judged.after, rel=0.05)
    beyond = proposed(1.5 * UM, 0.0, ("linear",), 1.0, loose)
    assert not beyond.met
    assert beyond.needed is None
    assert "repeatability, 1.73 µm alone, 0.232 µm more than the goal" in verdict(beyond)


def test_no_time_at_all_and_tilts_beyond_the_limits(tmp_path: Path) -> None:
    """The shortest run takes 0.47 h: 20 min to set the laser up, 8 min for the run, 4 points of 4 s each."""
    with pytest.raises(CalibrationError, match=r"hours: are too few: the shortest run takes 0\.47 h"):
        proposed(1.0 * UM, 0.0, ("linear",), 0.2)
    geometry = load_geometry(machines()["unit"].write(tmp_path / "machine.yaml"))  # its base joints tilt by at most 18°
    place = MeasuringBox(geometry, machines()["unit"].box, np.eye(3), np.radians(30.0))
    with pytest.raises(CalibrationError, match="tilt: 30° is within the limits in only 0 % of the box"):
        propose(place, Goal(1.0 * UM, np.radians(30.0)), FitSettings(blocks=()))


@pytest.mark.parametrize("name", machine_names())
def test_every_machine_of_the_zoo(name: str, tmp_path: Path) -> None:
    """On every machine of the zoo all candidates are within the limits, and the proposed file reads back."""
    machine = machines()[name]
    geometry = load_geometry(machine.write(tmp_path / "machine.yaml"))
    tilt = float(np.radians(3.0))
    place = MeasuringBox(geometry, machine.box, np.eye(3), tilt)
    runs = candidates(place, ("linear", "tracker_6d"))
    assert {run.instrument for run in runs} == {"linear", "tracker_6d"}
    assert any("about" in run.name for run in runs)
    every = {n: Times(0.0, 0.0, 1.0) for n in TIMES}
    goal = Goal(1e-9, tilt, ("linear", "tracker_6d"), 150.0, every)
    result = propose(place, goal, FitSettings(blocks=()))
    path = tmp_path / "campaign.yaml"
    path.write_text(campaign_text(result.campaign))
    readings = template(load_campaign(path), geometry)
    assert len(readings) == result.readings
    assert result.worst < 0.2 * max(result.before.values())


@pytest.mark.parametrize("instrument", ["ball_bar", "station", "r_test"])
def test_instruments_that_shops_own(instrument: str, tmp_path: Path) -> None:
    """On a 6-6 machine with turned frames each instrument lowers the expected error, and its file reads back."""
    machine = machines()["framed"]
    geometry = load_geometry(machine.write(tmp_path / "machine.yaml"))
    tilt = float(np.radians(5.0))
    goal = Goal(1e-9, tilt, (instrument,), 2.0 * HOUR)
    result = propose(MeasuringBox(geometry, machine.box, np.eye(3), tilt), goal, FitSettings(blocks=()))
    path = tmp_path / "campaign.yaml"
    path.write_text(campaign_text(result.campaign))
    after, before = (template(campaign, geometry) for campaign in (load_campaign(path), result.campaign))
    np.testing.assert_allclose(after.stations.commands, before.stations.commands, rtol=0.0, atol=1e-11)
    assert len(after) == result.readings
    assert result.worst < 0.7 * max(result.before.values())


@pytest.mark.parametrize(
    ("change", "complaint"),
    [
        ({"error": np.nan}, "goal"),
        ({"tilt": -0.1}, "tilt"),
        ({"instruments": ("linear", "linear")}, "instruments: must be one or more of linear"),
        ({"seconds": np.inf}, "hours"),
        ({"times": {"linear": Times(1.0, -1.0, 1.0)}}, "times of linear"),
    ],
)
def test_wrong_goals(change: dict, complaint: str) -> None:
    with pytest.raises(CalibrationError, match=complaint):
        Goal(**{"error": 1.0 * UM, **change})


def test_a_goal_under_other_loads_says_under_how_many_to_read() -> None:
    """The plan asks for readings under two loads only if readings under one do not reach the goal under the other.

    The struts have 5 N/µm, stated to 10 %, under 60 kg; the other load is the machine on its side. The truth for one
    load is the planner's own expectation for the easier goal.
    """
    load = Load(stiffness=np.full(6, 5e6), mass=60.0).numbers()
    settings = replace(small.FEW, blocks=("pitch", "wave", "compliance"), load=load)
    place = MeasuringBox(small.paper(), small.BOX, np.eye(3), 0.0)
    aside = ((0.0, 0.0, 0.0, 0.0, 9.80665, 0.0, 0.0),)
    few, many = (
        propose(place, Goal(error, instruments=("linear",), seconds=20 * HOUR, loads=aside), settings)
        for error in (20.0 * UM, 0.8 * UM)
    )
    names = ["level", "level, tool of 0 kg, gravity (9.80665, 0, 0) m/s²"]
    for plan_of, loads in ((few, 1), (many, 2)):
        assert list(plan_of.expected) == names
        assert plan_of.met
        assert len(set(plan_of.loads)) == loads
        assert f"loads of the readings: {loads} of 2" in proposal_report(plan_of)
    first = [load == "" for load in many.loads]
    assert first == sorted(first, reverse=True), "the load is changed once"
    with pytest.raises(CalibrationError, match="need the stiffness of the struts"):
        propose(place, Goal(UM, loads=aside), small.FEW)
