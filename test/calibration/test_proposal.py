"""Proposed campaigns: gains against dense matrices, expected errors against ``plan``, limits of each machine."""

import re
from collections import Counter
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import calibration_helpers as small
import numpy as np
import pytest
from foreign_machines import machine_names, machines
from helpers import assert_defaults

from hexapod_comp.calibration.candidates import MeasuringBox, _longest, candidates
from hexapod_comp.calibration.design import (
    TIMES,
    Goal,
    Proposal,
    RemainingError,
    Times,
    _divergence,
    plan,
    plan_json,
    plan_report,
    proposal_json,
    proposal_report,
    propose,
    remarks,
    verdict,
)
from hexapod_comp.calibration.estimator import Estimation
from hexapod_comp.calibration.lead import detect_lead
from hexapod_comp.calibration.parameters import FitSettings, ParameterSpace
from hexapod_comp.errors import CalibrationError, GeometryError
from hexapod_comp.machine.geometry import load_geometry
from hexapod_comp.machine.load import Load
from hexapod_comp.measurements.campaign import Campaign, CampaignRun, campaign_text, line_run, load_campaign, template

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
    seen = [rng.standard_normal((k, 9)) for k in (1, 3, 3, 2)]
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
        np.testing.assert_allclose(criterion.gains(np.array([1, 0, 1, 1], dtype=bool)), [wanted[0], 0.0, *wanted[2:]])
        criterion.add(n)
        chosen.append(n)
        assert (square * criterion.covariance).sum() == pytest.approx(left(chosen), rel=1e-9)
    assert (square * criterion.after_all()).sum() == pytest.approx(left([0, 1, 2, 3]), rel=1e-9)


def test_divergence_of_normal_distributions() -> None:
    """The textbook's Kullback–Leibler divergence of N(0, 2) from N(3, 5), and of two such independent numbers."""
    wanted = 0.5 * (np.log(5.0 / 2.0) + (2.0 + 9.0) / 5.0 - 1.0)
    for size in (1, 2):
        found = _divergence(np.full(size, 3.0), 2.0 * np.eye(size), 5.0 * np.eye(size))
        assert found == pytest.approx(size * wanted)


def test_what_limits_a_goal() -> None:
    """A linear laser cannot show the error of a tilted tool beside a level one, since its zeros are unknown."""
    blind = proposed(1.0 * UM, 10.0, ("linear",), 3.0)
    assert not blind.met
    assert blind.unseen > blind.goal.error
    assert blind.needed is None
    short = proposed(1.5 * UM, 0.0, ("linear",), 1.0)
    assert not short.met
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
    assert result.shares["repeatability"] == pytest.approx(3.0 * UM**2 / result.worst**2)
    assert sum(result.shares.values()) == pytest.approx(1.0)
    judged = plan(template(result.campaign, small.paper()), result.campaign, small.FEW).level
    assert result.expected["level"] == pytest.approx(judged.after, rel=0.05)
    beyond = proposed(1.5 * UM, 0.0, ("linear",), 1.0, loose)
    assert not beyond.met
    assert beyond.needed is None
    assert "repeatability (tool error 1.73 µm, 0.232 µm above the goal)" in verdict(beyond)


def test_no_time_at_all_and_tilts_beyond_the_limits(tmp_path: Path) -> None:
    """The shortest run takes 0.47 h: 20 min to set the laser up, 8 min for the run, 4 points of 4 s each."""
    with pytest.raises(CalibrationError, match=r"hours: are too few: the shortest run takes 0\.47 h"):
        proposed(1.0 * UM, 0.0, ("linear",), 0.2)
    with pytest.raises(CalibrationError, match="goal: is met without a calibration"):
        proposed(1.0, 0.0, ("linear",), 0.5)  # a metre, after a run or without any
    geometry = load_geometry(machines()["unit"].write(tmp_path / "machine.yaml"))  # its base joints tilt by at most 18°
    place = MeasuringBox(geometry, machines()["unit"].box, np.eye(3), np.radians(30.0))
    with pytest.raises(
        CalibrationError, match="a tool tilted by 30° can reach only 0 % of the box; at least 30 % are needed"
    ):
        propose(place, Goal(1.0 * UM, np.radians(30.0)), FitSettings(blocks=()))


@pytest.mark.parametrize(
    ("name", "instruments", "left"),
    [
        *((name, ("linear", "tracker_6d"), 0.2) for name in machine_names()),
        *(("framed", (instrument,), 0.7) for instrument in ("ball_bar", "station", "r_test")),
    ],
)
def test_machines_and_instruments(name: str, instruments: tuple[str, ...], left: float, tmp_path: Path) -> None:
    """All candidates are within the machine's limits, they lower the expected error, and the file reads back."""
    machine = machines()[name]
    geometry = load_geometry(machine.write(tmp_path / "machine.yaml"))
    tilt = float(np.radians(3.0))
    place = MeasuringBox(geometry, machine.box, np.eye(3), tilt)
    runs = candidates(place, instruments)
    assert {run.instrument for run in runs} == set(instruments)
    assert any("about" in run.name for run in runs) or instruments[0] in ("station", "r_test")
    goal = Goal(1e-9, tilt, instruments, 150.0, {n: Times(0.0, 0.0, 1.0) for n in TIMES})
    result = propose(place, goal, FitSettings(blocks=()))
    path = tmp_path / "campaign.yaml"
    path.write_text(campaign_text(result.campaign))
    after, before = (template(campaign, geometry) for campaign in (load_campaign(path), result.campaign))
    # The file has angles to 1e-9°: three angles rounded by up to half of it move a joint at 1 m by 2.6e-11 m
    np.testing.assert_allclose(after.stations.commands, before.stations.commands, rtol=0.0, atol=3e-11)
    assert len(after) == result.readings
    assert result.worst < left * max(result.before.values())


def test_all_candidates_of_a_box_that_the_machine_reaches() -> None:
    """By hand: 27 + 16 level lines, 15 + 4 in each of four tilted attitudes; 15 places of a circle or ball, 7 tilted.

    An axis has 9 level lines, and 4 edges with the centre line tilted. A linear laser reads a line in five ways.
    """
    place = MeasuringBox(small.paper(), small.BOX, np.eye(3), np.radians(5.0))
    instruments = ("linear", "straightness", "rotation", "6-D", "tracker", "ball_bar", "station", "r_test")
    runs = candidates(place, instruments)
    lines, planes = 43 + 4 * 19, 27 + 4 * 15
    counts = {"linear": 5 * lines, "6-D": 4 * lines, "straightness": planes, "rotation": planes}
    counts |= {"tracker": 25, "ball_bar": 3 * (15 + 4 * 7), "station": 4 * 25, "r_test": 15}
    assert Counter(run.instrument for run in runs) == counts
    of_each = [[run for run in runs if run.instrument == name] for name in instruments]
    shapes = [sorted({(len(run.positions), run.alternate) for run in of}) for of in of_each]
    listed = zip(of_each, shapes, strict=True)
    small.assert_recorded("candidates", "".join(f"{of[0].name} … {of[-1].name}: {s}\n" for of, s in listed))
    flat = MeasuringBox(small.paper(), small.BOX, np.eye(3), 0.0)
    counts = {"linear": 215, "ball_bar": 45}
    assert Counter(run.instrument for run in candidates(flat, ("linear", "ball_bar"))) == counts
    box = small.BOX.mean(axis=0) + np.array([[-0.1], [0.1]]) * [1, 1, 0.75]
    tiny = MeasuringBox(small.paper(), box, np.eye(3), 0.0)
    radii = {np.linalg.norm(r.positions - r.centres, axis=1).max().round(6) for r in candidates(tiny, ("ball_bar",))}
    assert radii == {0.09, 0.0675}, "45 % of the shorter side of the circle's plane, at most 0.1 m"
    with pytest.raises(GeometryError, match="limits: let the machine complete none of the candidate runs in the box"):
        candidates(flat, ("r_test",))
    assert _longest(np.array([1, 1, 0, 1, 1, 1, 1, 0, 1], dtype=bool)) == (4, 5), "a point away from the limit"
    assert _longest(np.array([1, 1, 1, 0, 1], dtype=bool)) == (0, 1)
    assert _longest(np.ones(5, dtype=bool)) == (0, 4)


@pytest.mark.parametrize(
    ("change", "complaint"),
    [
        ({"error": -2.0 * UM}, "goal: must be finite and above zero, not -2 µm"),
        ({"error": 0.0}, "goal"),
        ({"error": np.nan}, "goal"),
        ({"tilt": 1.0473}, "tilt: must be 0…60°, not 60.0059°"),
        ({"instruments": ("linear", "linear")}, "instruments: must be one or more of linear"),
        ({"seconds": np.inf}, "hours"),
        ({"seconds": -2.0 * HOUR}, "hours: must be finite and above zero, not -2 h"),
        ({"seconds": 0.0}, "hours"),
        ({"instruments": ()}, "each at most once, not none"),
        ({"times": {"linear": Times(1.0, -1.0, 1.0)}}, "times of linear"),
        ({"times": {"linear": Times(1.0, 1.0, 0.0)}}, "stop > 0 s"),
        ({"times": {"5-D": Times(1.0, 1.0, 1.0)}}, "times: must be given for every instrument, but linear has none"),
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
    first = [load == "" for load in many.loads]
    assert first == sorted(first, reverse=True), "the load is changed once"
    with pytest.raises(CalibrationError, match="need the stiffness of the struts"):
        propose(place, Goal(UM, loads=aside), small.FEW)


def by_hand(**changes: object) -> Proposal:
    """Return a proposal whose numbers are chosen, for two loads and two instruments."""
    ends, load = np.array([[-0.1, 0.0, 0.4], [0.1, 0.0, 0.4]]), ", tool of 20 kg"
    line = line_run("1: linear, x", "linear", ends, 5, np.eye(3))
    poses = CampaignRun(f"3: poses{load}", "tracker", np.zeros((13, 3)), np.tile(np.eye(3), (13, 1, 1)))
    runs = line, replace(line, name=f"2: linear, x{load}"), poses
    result = Proposal(
        goal=Goal(3 * UM, np.radians(10.0), ("linear", "tracker"), 2 * HOUR, loads=((20.0, 0, 0, 0, np.nan, 0, 0),)),
        campaign=Campaign(small.BOX, 0.1, 0.1, cycles=2, repeatability=1 * UM, runs=runs),
        space=SimpleNamespace(geometry=small.paper()),
        before={"level": 50 * UM, f"tilted{load}": 80 * UM},
        expected={"level": 2 * UM, f"tilted{load}": 4 * UM},
        seconds=1.5 * HOUR,
        with_all=1 * UM,
        unseen=0.5 * UM,
        shares={"structure": 0.6, "pitch": 0.1, "repeatability": 0.0999},
        needed=2.5 * HOUR,
        loads=("", load, load),
        lead="no lead is stated",
    )
    return replace(result, **changes)


def test_report_and_json_of_a_proposal() -> None:
    """Durations by hand: 20 + 8 min + 20 readings of 4 s; 30 + 0.5 min + 13 stops of 10 s, each with three readings."""
    assert proposal_report(by_hand()) == small.recorded("proposal")
    found = proposal_json(by_hand())
    assert [run.pop("takes_s") for run in found["runs"]] == [1760.0, 1760.0, 1960.0]
    small.assert_recorded("proposal", found)
    assert remarks(by_hand(goal=Goal(3 * UM, seconds=HOUR))) == [
        "Proposed for machine paper: goal 3.00 µm RMS, with linear in 1 h.",
        "Expected RMS after best-fit alignment: level 2.00 µm, tilted, tool of 20 kg 4.00 µm.",
        "79 readings in 1.5 h, in this order.",
    ]


def test_times_are_those_of_an_experienced_machinist() -> None:
    """Minutes to install an instrument and for each run, seconds for each stop; no source has them."""
    assert {name: (times.first / 60.0, times.run / 60.0, times.stop) for name, times in TIMES.items()} == {
        **dict.fromkeys(("linear", "rotation"), (20, 8, 4)), "straightness": (20, 15, 4), "5-D": (25, 10, 4),
        "6-D": (25, 10, 4), "tracker": (30, 0.5, 10), "tracker_6d": (30, 0.5, 15), "ball_bar": (15, 5, 1),
        "station": (30, 10, 5), "r_test": (20, 10, 5),
    }  # fmt: skip


def test_what_a_verdict_names_as_the_limit() -> None:
    for changes, limit in (
        ({}, "time; the goal takes 2.5 h"),
        (
            {"needed": None, "unseen": 3.01 * UM, "with_all": 4 * UM},
            "machine errors that .* in this box, 3.01 µm of tool error remain",
        ),
        (
            {"needed": None, "unseen": 3 * UM, "with_all": 3.5 * UM},
            "the instruments' noise; .*, 3.50 µm of tool error remain",
        ),
        ({"needed": None, "with_all": 3 * UM}, "time; many more runs are needed: .* 3.00 µm of tool error remain"),
    ):
        assert re.fullmatch(f"  limited by {limit}", verdict(by_hand(**changes)).splitlines()[1])
    assert verdict(by_hand(expected={"level": 3 * UM})) == "the goal is met: 3.00 µm in 1.5 h"


@pytest.mark.parametrize(("instrument", "runs", "searched"), [("5-D", 99, True), ("linear", 8, False)])
def test_a_plan_without_a_lead_tells_whether_a_fit_searches_for_it(instrument: str, runs: int, searched: bool) -> None:
    """The truth is the search in the same readings, which have waves of 4 µm. With a lead there is no note."""
    campaign, settings = small.campaign(instrument), replace(small.FEW, lead=None)
    measured = small.measured(small.virtual_machine(1), campaign, 1)
    measured = measured.select(measured.run < runs)
    estimation = Estimation(measured, ParameterSpace(measured, settings), check_count=False)
    problem, _ = estimation.linearise(np.zeros(estimation.space.size), np.ones(len(measured)))
    assert (detect_lead(estimation, problem).shown is not None) == searched
    planned = plan(measured, campaign, settings)
    text = "no lead of the screws is stated (--lead-mm): the expected error contains no waves of the screws"
    text += "; a fit searches the readings for the lead" if searched else ", and a fit does not search for the lead"
    assert f"\n\nnote: {text}" in plan_report(planned)
    assert plan_json(planned)["notes"] == planned.notes
    assert (
        plan(measured, campaign, small.FEW).notes == plan(measured, campaign, replace(settings, blocks=())).notes == ()
    )


def test_defaults():
    assert_defaults(__file__)
