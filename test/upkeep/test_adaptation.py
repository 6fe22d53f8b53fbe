"""The loop of ``adapt``: its results in every case, and that an interrupted run continues.

The machine is a virtual one whose hidden errors the test has drawn, knocked or bent; the error that a model leaves is
evaluated at points that no fit used (``held_out``). No ROS runs.
"""

from __future__ import annotations

import re
import shutil
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace
from unittest.mock import Mock

import calibration_helpers as small
import numpy as np
import pytest
from foreign_machines import machines
from scipy.linalg import null_space
from scipy.stats import chi2

from hexapod_comp.calibration import check
from hexapod_comp.calibration.assumptions import ASSUMED
from hexapod_comp.calibration.changes import DATUM, READING, STRUT
from hexapod_comp.calibration.design import Times
from hexapod_comp.calibration.evaluation import held_out
from hexapod_comp.calibration.parameters import FitSettings, ParameterSpace
from hexapod_comp.calibration.posterior import FittedParameters
from hexapod_comp.errors import CalibrationError, CommandError, InputFileError, TooFewReadingsError
from hexapod_comp.formats import adapt_journal as journal
from hexapod_comp.formats.adapt_journal import Journal
from hexapod_comp.loop.story import demo_place
from hexapod_comp.machine.geometry import HexapodGeometry, load_geometry
from hexapod_comp.machine.model import MachineModel, RealMachine
from hexapod_comp.machine.model_file import load_model
from hexapod_comp.measurements.campaign import Campaign
from hexapod_comp.measurements.collect import Observation
from hexapod_comp.measurements.readings import KINDS
from hexapod_comp.pose import Pose
from hexapod_comp.upkeep import loop as upkeep
from hexapod_comp.upkeep.checks import CLEAR, PLACES, RigidMotion, check_run, compare
from hexapod_comp.upkeep.loop import Adaptation, State, Task, begun_with, next_step
from hexapod_comp.virtual.imperfections import ImperfectionBounds, draw_model
from hexapod_comp.virtual.watched import Instrument, VirtualMachine

# The machine's errors, and the blocks of the fit: a fit then takes half a second
BLOCKS = ("pitch", "backlash")

RESULTS = ("in use", "proposed", "refused", "changed")  # results of runs that were not interrupted

PROMISE = 1.0  # µm; machines have some ten µm of error after best-fit alignment; a fit to 100 stops leaves 0.1 µm


BOUNDS = ImperfectionBounds(joint=50e-6, strut_offset=50e-6, pitch=50e-6, backlash=(2e-6, 4e-6))


@pytest.fixture(autouse=True)
def no_mix_ups(monkeypatch: pytest.MonkeyPatch) -> None:
    """Switch off the search for mistakes in the readings, which takes most of a check's time and has own tests."""
    monkeypatch.setattr(check, "mistakes_of_check", lambda *_: [])


@cache
def usual() -> tuple[HexapodGeometry, MachineModel, Task]:
    """Return a machine, its hidden errors, and a task with a campaign of lines and random poses."""
    geometry = load_geometry("paper")
    place = demo_place(geometry)
    side = float(np.ptp(place.box, axis=0).min())
    poses = check_run(geometry, place.box, place.attitude, 0, "poses")
    campaign = Campaign(place.box, side, side, "6-D", 4, level=place.attitude, runs=(poses,))
    task = Task(place.box, place.attitude, campaign=campaign, settings=FitSettings(blocks=BLOCKS), every=0.0)
    return geometry, draw_model(geometry, BOUNDS, 3), task


class Rig:
    """A virtual machine, a folder, and the loop between them."""

    def __init__(self, folder: Path) -> None:
        self.folder, (self.geometry, truth, self.task) = folder, usual()
        self.machine = VirtualMachine(self.geometry, truth, Instrument(), 3)
        self.reloaded: list[Path] = []
        self.said: list[str] = []

    def reload(self, path: Path) -> None:
        self.machine.reload(load_model(path, self.geometry))
        self.reloaded.append(path)

    def loop(self, may_reload: bool = True, going_on: Callable[[], bool] = lambda: True) -> Adaptation:
        reload = self.reload if may_reload else None
        return Adaptation(self.geometry, self.machine, self.task, self.folder, reload, going_on, self.said.append)

    def left(self) -> float:
        """Return the RMS tool error after best-fit alignment, µm, that the model in use leaves."""
        model, truth = load_model(self.folder / "model.yaml", self.geometry), self.machine.truth
        real = RealMachine(self.geometry, truth)
        return 1e6 * held_out(real, model, self.task.box, level=self.task.level).aligned.rms

    def names(self) -> list[str]:
        """Return the names of the journal's events and of interruptions."""
        events = Journal(self.folder / "journal.jsonl").events
        return [e["state"] if e["event"] == "ended" else e["event"] for e in events if e.get("state") not in RESULTS]


@pytest.fixture(scope="module")
def calibrated(tmp_path_factory: pytest.TempPathFactory) -> Rig:
    rig = Rig(tmp_path_factory.mktemp("calibrated") / "made")
    outcome = rig.loop().calibrate()
    assert outcome.state == "in use", outcome
    return rig


@pytest.fixture
def again(calibrated: Rig, tmp_path: Path) -> Rig:
    """Return the calibrated machine with a copy of its folder, in which a test may continue."""
    rig = Rig(tmp_path / "made")
    shutil.copytree(calibrated.folder, rig.folder)
    rig.reload(rig.folder / "model.yaml")
    return rig


def cut(rig: Rig, events: int, rest: bytes = b"") -> None:
    """Cut the journal after some events, and add `rest`, the beginning of a line."""
    path = rig.folder / "journal.jsonl"
    path.write_bytes(b"".join(path.read_bytes().splitlines(keepends=True)[:events]) + rest)


# ---- from an unknown machine to a model in use ----


def test_an_unknown_machine_is_calibrated_checked_and_reloaded(calibrated: Rig) -> None:
    assert calibrated.names() == ["begun", "planned", "collected", "fitted", "checked", "adopted", "reloaded"]
    state = calibrated.loop().state
    assert calibrated.left() <= state.promised_in_use * 1e6 <= PROMISE
    assert calibrated.reloaded == [calibrated.folder / "model.yaml"]
    assert calibrated.said[0].startswith("002_readings.csv: stop 1 of 156: x line at y -100.0, z 350.0, cycle 1, at [")
    first, last = "stop 1 of 16: check 4, cycle 1, at [-60.885, -85.197, 382.656] mm", "stop 16 of 16: check 4"
    checks = calibrated.said[calibrated.said.index("checking 003_model.yaml") + 1 :]
    assert (checks[0], checks[-1], len(checks)) == (f"004_check.csv: {first}", "reloading", 17)
    assert checks[-2].startswith(f"004_check.csv: {last}")


def test_between_two_checks_it_waits_and_says_for_how_long(again: Rig, monkeypatch: pytest.MonkeyPatch) -> None:
    waits: list[float] = []
    monkeypatch.setattr(upkeep, "time", SimpleNamespace(monotonic=lambda: 100.0 + sum(waits)))
    again.task = replace(again.task, every=2.25)
    loop = again.loop()
    loop._wait = waits.append
    loop._pause()
    assert waits == pytest.approx([0.2] * 11 + [0.05])
    assert again.said[::5] == ["next check in 2 s", "next check in 1 s", "next check in 0 s"]
    loop._pause, good = Mock(), {"good": True, "spoilt": False, "readings": "c.csv", "model": "model.yaml"}
    loop._check = lambda: loop._record("checked", **good)
    assert loop.guard(3).text.endswith("later checks passed: 3")
    assert loop._pause.call_count == 2, "not before the first check"


def test_without_permission_a_model_is_proposed_and_never_run(again: Rig) -> None:
    cut(again, 5)  # checked, not adopted
    again.reloaded.clear()
    outcome = again.loop(may_reload=False).calibrate()
    assert (outcome.state, outcome.good, again.reloaded) == ("proposed", True, [])
    assert outcome.model.exists()
    ideal = MachineModel(again.geometry.name)
    before = held_out(RealMachine(again.geometry, again.machine.truth), ideal, again.task.box, level=again.task.level)
    again.machine.reload(ideal)
    for result in (outcome, again.loop(may_reload=False).guard(1)):
        size = re.search(r"machine's tool error was (\S+) µm RMS: the compensator did not run this", result.text)
        assert float(size[1]) == pytest.approx(1e6 * before.aligned.rms, rel=0.4), "from fifteen places"
        assert again.loop().events[-1]["applied"] is False
    again.machine.reload(load_model(outcome.model, again.geometry))
    assert again.loop(may_reload=False).guard(1).text.endswith("later checks passed: 2"), "a person has loaded it"
    assert again.loop().calibrate().state == "in use", "and run when somebody permits it"
    assert again.reloaded == [again.folder / "model.yaml"]


# ---- stopped and killed ----


@pytest.mark.parametrize("events", [2, 4])
def test_a_killed_process_goes_on_where_it_stopped(events: int, again: Rig, monkeypatch: pytest.MonkeyPatch) -> None:
    """The process is killed while it writes the next event; a step with an event is not repeated."""
    made = {path.name: path.read_bytes() for path in again.folder.glob("*readings.csv")}
    fits: list[int] = []
    fit = upkeep.fit_model
    monkeypatch.setattr(upkeep, "fit_model", lambda *a: fits.append(1) or fit(*a))
    names = again.names()
    cut(again, events, b'{"time": "2026-')
    outcome = again.loop().calibrate()
    assert outcome.state == "in use", outcome
    assert again.names() == names
    assert len(fits) == (events < 4)
    assert {name: (again.folder / name).read_bytes() for name in made} == made, "complete readings are kept"
    assert again.left() <= again.loop().state.promised_in_use * 1e6


def test_readings_of_a_lost_journal_are_not_continued(again: Rig) -> None:
    """After a power cut a journal may be empty; its readings are those of another day, and the machine has changed."""
    before, stops = (again.folder / "002_readings.csv").read_bytes(), again.machine.stops
    cut(again, 0)
    assert again.loop(going_on=lambda: again.machine.stops < stops + 3).calibrate().state == "stopped"
    assert again.machine.stops >= stops + 3, "the machine was measured"
    assert again.names() == ["begun", "planned", "stopped"]
    assert (again.folder / "002_readings.csv").read_bytes() == before


def test_a_person_stops_it_at_any_time(tmp_path: Path) -> None:
    rig = Rig(tmp_path / "made")
    for stops in (0, 7, 40):
        before = rig.machine.stops
        outcome = rig.loop(going_on=lambda before=before, stops=stops: rig.machine.stops < before + stops).calibrate()
        assert outcome.state == "stopped"
        assert rig.machine.stops <= before + stops + 1, "at the next stop, and before a further one"
    assert rig.names() == ["begun", "stopped", "planned", "stopped", "stopped"]
    assert next_step(rig.loop().state, 0, True) == "collect"


def test_a_move_or_a_fit_ends_when_a_person_stops_it(again: Rig, monkeypatch: pytest.MonkeyPatch) -> None:
    """A fit ends at its next progress message, and is repeated from the beginning when the run continues."""
    braked = CommandError("person", "stopped on the way")
    braked.reason = "person"
    monkeypatch.setattr(again.machine, "move", Mock(side_effect=braked))
    assert again.loop().guard(1).state == "stopped"
    cut(again, 3)
    going = iter([True, False])
    assert again.loop(going_on=lambda: next(going)).calibrate().state == "stopped"
    assert again.names()[-1] == "stopped"
    assert next_step(again.loop().state, 0, True) == "fit"


def test_an_instrument_that_reads_nothing_is_named_and_may_be_mended(tmp_path: Path) -> None:
    rig = Rig(tmp_path / "made")
    rig.machine.move, rig.machine.observe = Mock(), lambda: None
    with pytest.raises(InputFileError, match="the instrument read nothing"):
        rig.loop().calibrate()
    assert rig.names()[-1] == "failed"
    assert next_step(rig.loop().state, 0, True) == "collect"


def test_a_check_of_which_little_was_read_counts_for_nothing(again: Rig, monkeypatch: pytest.MonkeyPatch) -> None:
    """The beam reaches only the lower third of the box."""
    observe, (low, high) = again.machine.observe, again.task.box[:, 2]
    within = low + (high - low) / 3.0
    monkeypatch.setattr(again.machine, "observe", lambda: observe() if again.machine._at.position[2] < within else None)
    with pytest.raises(CommandError, match=r"\d of 16 readings of .*_check.csv are usable, and a check needs 8"):
        again.loop().guard(1)
    assert again.names()[-1] == "failed"
    assert next_step(again.loop().state, 1, True) == "guard"


def test_stops_without_readings_are_visited_three_times(again: Rig, monkeypatch: pytest.MonkeyPatch) -> None:
    for lost, passes in (([1, 1, 1, 0], 3), ([1, 0], 2)):
        results = [SimpleNamespace(measurements=n, missing=("a stop",) * count) for n, count in enumerate(lost)]
        rest = iter(results)
        monkeypatch.setattr(upkeep, "collect", lambda *_, rest=rest, **__: next(rest))
        found = again.loop()._measured(again.task.campaign, "new.csv")
        assert found == (passes - 1, ("a stop",) * lost[passes - 1])


# ---- models that check readings contradict ----


def test_a_model_that_its_check_readings_contradict_is_refused(again: Rig) -> None:
    """The machine is knocked between fit and check, so the model does not describe it any more."""
    cut(again, 4)
    (again.folder / "model.yaml").unlink()
    for path in again.folder.glob("*check*"):
        path.unlink()
    again.reloaded.clear()
    again.machine.knock(1, 100e-6)
    outcome = again.loop().calibrate()
    assert outcome.state == "refused"
    text = "two sets of check readings contradict the model, whose fit did not use them: a strut's offset has changed"
    assert outcome.text.startswith(f"{text}: strut_2 by +")
    assert again.names()[-3:] == ["checked", "checked", "refused"], "the second check has repeated it"
    assert (again.reloaded, outcome.model) == ([], None)
    assert not (again.folder / "model.yaml").exists()


def test_a_goal_that_three_campaigns_do_not_reach_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Each further campaign is planned for a smaller goal; nothing is measured here."""
    rig = Rig(tmp_path / "made")
    propose = Mock(return_value=SimpleNamespace(campaign=rig.task.campaign, worst=1e-6))
    rig.task = replace(rig.task, goal=1e-6, campaign=None)
    few = TooFewReadingsError("measurements", "are too few")
    stand_ins = {"propose": propose, "fit_model": Mock(side_effect=few)}
    stand_ins |= {"remarks": Mock(), "load_campaign": Mock(), "campaign_text": lambda *_: ""}
    for name, stand_in in stand_ins.items():
        monkeypatch.setattr(upkeep, name, stand_in)
    monkeypatch.setattr(Adaptation, "_readings", lambda *_: None)
    monkeypatch.setattr(Adaptation, "_measured", lambda *_: ((), ()))
    outcome = rig.loop().calibrate()
    assert outcome.state == "refused"
    assert outcome.text == "after 3 campaigns no model can be fitted: measurements: are too few"
    planned = [call.args[1] for call in propose.call_args_list]
    goals = [(goal.error, goal.seconds, goal.instruments, goal.times) for goal in planned]
    means = 14400.0, ("6-D",), {"6-D": Times(0.0, 0.0, 5.0)}
    assert goals == [(pytest.approx(error), *means) for error in (0.7e-6, 0.35e-6, 0.175e-6)]
    # No further campaign cures a reversed sign; the next calibration begins anew
    propose.reset_mock()
    monkeypatch.setattr(upkeep, "fit_model", Mock(side_effect=CalibrationError("direction", "sign reversed")))
    assert rig.loop().calibrate().text == "no model can be fitted: direction: sign reversed"
    assert (propose.call_count, rig.loop().state.refused) == (1, "no model can be fitted: direction: sign reversed")


def test_a_fit_that_does_not_reach_its_goal_says_why(again: Rig, monkeypatch: pytest.MonkeyPatch) -> None:
    loop, unknown = again.loop(), "; the screws' lead is not known (--lead-mm), so their periodic error is not fitted"
    for promise, misfit, lead, goal, short in (
        (None, "readings are off", None, None, f"the fit is not to be trusted: readings are off{unknown}"),
        (None, "", 0.01, 1e-6, "the fit predicts no limit of the tool error, and the goal is 1.00 µm"),
        (1.014e-6, "", None, 1e-6, f"the fit predicts up to 1.01 µm (95 %), and the goal is 1.00 µm{unknown}"),
        (1e-6, "", None, 1e-6, ""),
        (None, "", None, None, ""),
    ):
        fit = Mock(level=promise and Mock(high=promise), misfit=misfit, lead=Mock(used=lead))
        for name, result in (
            ("fit_model", fit),
            ("fit_report", ""),
            ("save_with_posterior", 0),
            ("read_measurements", fit),
        ):
            monkeypatch.setattr(upkeep, name, Mock(return_value=result))
        loop._task = replace(again.task, campaign=None, goal=goal)
        loop._fit()
        last = loop.events[-1]
        assert (last["promised_m"], last["enough"], last["short"]) == (promise, short == "", short)


def test_what_the_loop_says_of_checks_by_hand(again: Rig) -> None:
    sizes = [{"name": "offset", "value": 19.96, "standard_error": 0.512, "unit": "µm"}]
    found = ((STRUT, sizes, 0.97), (DATUM, [], 0.57), (READING, [], 0.02))
    changes = [SimpleNamespace(family=f, name="it", sizes=s, probability=p) for f, s, p in found]
    for verdict, first, text in (
        (check.VALID, 0, "no change"),
        (check.UNDECIDED, 0, "either a strut's offset has changed, or the datum has moved"),
        (check.NAMED, 0, "a strut's offset has changed: it by +19.96 ± 0.51 µm"),
        (check.NAMED, 1, "the datum has moved (most probable, 57 %: it)"),
        (check.UNEXPLAINED, 0, "a strut's offset has changed (most probable, 97 %: it by +19.96 ± 0.51 µm)"),
    ):
        assert upkeep.change_text(SimpleNamespace(verdict=verdict, candidates=changes[first:])) == text
    loop, found = again.loop(), {"found_m": 2.346e-6, "promised_m": 1e-6, "verdict": check.VALID, "text": "no change"}
    over = "the tool error is 2.35 µm RMS, and the fit predicted at most 1.00 µm (95 %)"
    twice = "two sets of check readings contradict the model, whose fit did not use them"
    for state, changed, text in (
        (State(spoilt=3), {}, "each of 3 checks in a row has a single wrong reading: check the instrument"),
        (State(candidate="m"), {}, f"{twice}: {over}"),
        (State(candidate="m"), {"verdict": check.NAMED, "text": "it has moved"}, f"{twice}: it has moved"),
        (State(candidate="m", repairs="n"), {}, over),
    ):
        loop._journal.add("checked", **{**found, **changed})
        loop.state = state
        loop._give_up()
        assert [e["reason"] for e in loop.events if "reason" in e][-1] == text
    assert [e["event"] for e in loop.events[-2:]] == ["beyond repair", "begun"]
    assert loop.events[-2]["text"] == "check readings contradict the repaired model"


def test_a_calibration_that_was_begun_with_a_campaign_is_not_continued_without(again: Rig) -> None:
    for planned, campaign, began in (("given", None, "a campaign"), ("1.yaml", again.task.campaign, "a goal")):
        loop = again.loop()
        loop.state, loop._task = State(planned=planned), replace(again.task, campaign=campaign)
        with pytest.raises(InputFileError, match=f"was begun with {began}: give {began} again, or begin anew"):
            loop._collect()


# ---- changes, named and repaired ----


def test_a_knocked_strut_is_named_and_repaired(again: Rig) -> None:
    """Without permission the model that the machine runs stays, as a restarted compensator reads its file."""
    before, path = again.left(), again.folder / "model.yaml"
    running = path.read_bytes()
    again.machine.knock(4, 20e-6)
    knocked = again.left()
    outcome = again.loop(may_reload=False).guard(1)
    assert (outcome.state, outcome.model) == ("proposed", again.folder / "proposed.yaml")
    assert path.read_bytes() == running
    outcome = again.loop().guard(0)
    text = r"tool error up to 0\.1\d µm RMS \(95 %\) after best-fit alignment; later checks passed: 1"
    assert re.fullmatch(text, outcome.text), outcome
    assert outcome.model == path
    assert not (again.folder / "proposed.yaml").exists()
    assert again.names()[-6:] == ["checked", "checked", "repaired", "checked", "adopted", "reloaded"]
    (text,) = [e["text"] for e in again.loop().events if e["event"] == "repaired"]
    assert re.fullmatch(r"a strut's offset has changed: strut_5 by \+(19|20)\.\d+ ± 0\.\d+ µm", text), text
    assert again.left() <= 1.5 * before < knocked
    assert load_model(path, again.geometry).origin.note.startswith("renewed from")
    names, after = again.names(), again.left()
    cut(again, -3, b"{")  # killed after the repair was checked
    assert again.loop().guard(0).state == "in use"
    assert (again.names(), again.left()) == (names, pytest.approx(after))


def test_a_moved_instrument_is_reported_and_no_machine_follows_it(again: Rig) -> None:
    """A tracker moved by 30 µm shifts all readings as a whole, which is no error of the machine."""
    pushed = Pose([20e-6, -10e-6, 20e-6], np.eye(3))
    observe, files = again.machine.observe, (again.folder / "model.yaml").read_bytes()

    def moved() -> Observation | None:
        seen = observe()
        return None if seen is None or seen.pose is None else seen._replace(pose=pushed @ seen.pose)

    again.machine.observe = moved
    outcome = again.loop().guard(1)
    again.machine.observe = observe
    assert outcome.state == "in use"
    said = r"all positions have shifted together, by ([\d.]+) µm: base, workpiece or instrument has moved"
    assert float(re.search(said, outcome.text)[1]) == pytest.approx(30.0, abs=0.5)
    assert (again.folder / "model.yaml").read_bytes() == files
    assert "shifted together" not in again.loop().guard(1).text


def test_a_promise_is_kept_up_to_the_limit_of_chi_square() -> None:
    """Readings of 1 µm of noise differ from the model by errors of every size, and by a shift of 30 µm along z.

    With zero parameters the errors are the residuals of a plane fit, written out here; the limit has 1 % of alarms.
    """
    grid = np.stack(np.meshgrid([-0.1, 0.1], [-0.1, 0.1], [0.38, 0.45]), axis=-1).reshape(-1, 3)
    blank = small.scattered(small.paper(), [Pose(p, np.eye(3)) for p in grid])
    blank = blank.select(blank.kind == KINDS.index("position"))
    blank = replace(blank, uncertainty=np.full(len(blank), 1e-6))
    space = ParameterSpace(blank, FitSettings(blocks=()))
    known = FittedParameters(space, np.zeros(space.size), np.zeros((space.size,) * 2), np.ones(1), np.ones(len(KINDS)))
    other = replace(known, x=np.random.default_rng(5).normal(0.0, 3e-5, space.size))
    points, size = np.repeat(grid - grid.mean(axis=0), 3, axis=0), np.linalg.norm(np.ptp(grid, axis=0)) / 2.0
    axes = np.tile(np.eye(3), (len(grid), 1))
    rigid = np.hstack([axes, np.cross(points, axes) / size])
    odd = null_space(rigid.T)[:, 0]
    for promised in (2e-6, 8e-6):
        limit = np.sqrt(chi2.isf(0.01, 18) * (promised**2 / 3.0 + 1e-12))
        for share, kept in ((0.999, True), (1.001, False)):
            readings = blank.with_values(share * limit * odd + 30e-6 * axes[:, 2])
            found, good, motion = compare(known, readings, promised)
            assert good == kept
            assert compare(other, readings, promised, as_run=True)[:2] == (found, good), "another model has no effect"
            assert compare(other, readings, promised)[0] > 2.0 * promised
            assert found == pytest.approx(np.sqrt(3.0 * ((share * limit) ** 2 / 18.0 - 1e-12)))
            np.testing.assert_allclose(motion.motion, [0.0, 0.0, 30e-6, 0.0, 0.0, 0.0], atol=1e-15)
            noise = max(1e-12, (share * limit) ** 2 / 24.0)
            assert motion.error == pytest.approx(np.sqrt(noise * np.linalg.inv(rigid.T @ rigid).diagonal().max()))
    least = ASSUMED.surely * np.sqrt(6.0) * 5e-6  # errors of 3 and 4 µm
    for size, moved in ((0.999, 0.0), (1.001, 1.001 * least)):
        now = RigidMotion(np.array([0.0, 0.0, size * least, 0.0, 0.0, 0.0]), 3e-6)
        assert now.moved(RigidMotion(np.zeros(6), 4e-6)) == pytest.approx(moved)


def test_struts_arrive_at_check_places_in_a_clear_direction(tmp_path: Path) -> None:
    """By closed-form lengths, each strut arrives at the last stop of a path away from the place where it turned."""
    for machine in machines().values():
        geometry = load_geometry(machine.write(tmp_path / "machine.yaml"))
        place = demo_place(geometry)
        run = check_run(geometry, place.box, place.attitude, 3, "check")
        for start, end in pairwise(run.positions):
            way = start + np.linspace(0.0, 1.0, 400)[:, None] * (end - start)
            lengths = machine.lengths(machine.platforms(way), np.tile(machine.level(), (400, 1, 1)))
            extreme = np.where(lengths[-1] > lengths[-2], lengths.min(axis=0), lengths.max(axis=0))
            assert np.abs(lengths[-1] - extreme).min() >= 0.99 * CLEAR


def test_a_machine_that_few_readings_cannot_repair_is_calibrated_anew_by_a_person(again: Rig) -> None:
    """A platform joint displaced by 0.2 mm has an effect that no offset, growth or payload has."""
    truth = again.machine.truth
    moved = truth.platform_deviation + np.array([[2e-4, -1e-4, 0.0]] * 2 + [[0.0] * 3] * 4)
    again.machine.become(replace(truth, platform_deviation=moved))
    outcome = again.loop(may_reload=False).guard(1)
    assert outcome.state == "changed"
    assert again.names()[-1] == "beyond repair"
    assert again.loop().guard(1).state == "changed", "it stays so until somebody calibrates"
    assert next_step(again.loop().state.after({"event": "begun"}), 0, True) == "plan"


def test_what_is_only_checked_needs_no_goal_and_the_box_that_was_calibrated(again: Rig) -> None:
    """Outside the calibrated box the model predicts nothing, and checks there would contradict it."""
    rest = begun_with(again.folder)
    np.testing.assert_allclose(rest["box_m"], again.task.box)
    np.testing.assert_allclose(rest["level"], again.task.level)
    task = again.task
    again.task = replace(task, campaign=None)
    with pytest.raises(CommandError, match="give a goal or a campaign"):
        again.loop().calibrate()
    again.task = replace(task, box=task.box * 1.01)
    for step in (lambda: again.loop().guard(1), again.loop().calibrate):
        with pytest.raises(InputFileError, match=r"box_m: is .* mm in the journal, not .* mm: give the former box"):
            step()
    assert begun_with(again.folder / "another") == {}
    with pytest.raises(CommandError, match=r"/empty has no model in use: calibrate first"):
        Adaptation(again.geometry, again.machine, task, again.folder / "empty").guard(1)


def test_a_check_that_was_stopped_begins_anew(again: Rig) -> None:
    """Half a check before a change and half after it describe no machine, and might show no change."""
    began = again.machine.stops
    assert again.loop(going_on=lambda: again.machine.stops < began + 9).guard(1).state == "stopped"
    stopped = again.machine.stops
    assert again.loop().guard(1).state == "in use"
    assert again.machine.stops == stopped + PLACES


@pytest.mark.parametrize("stops", [0, 9])
def test_a_compensator_that_was_restarted_gets_its_model_again(stops: int, again: Rig) -> None:
    """A check is valid for the model that runs, and does not notice another one, so the model is loaded before it."""
    again.task = replace(again.task, campaign=None)  # who only checks needs no campaign
    move, at, running = again.machine.move, again.machine.stops + stops, [True]

    def moved(pose: Pose) -> None:
        if again.machine.stops == at and stops:
            restart()
        move(pose)

    def restart() -> None:
        again.machine.reload(MachineModel(again.geometry.name))
        running[0] = False

    def reload(path: Path) -> None:
        again.reload(path)
        running[0] = True

    again.machine.move = moved
    if not stops:
        restart()
    loop = Adaptation(again.geometry, again.machine, again.task, again.folder, reload, runs=lambda _: running[0])
    assert loop.guard(1).state == "in use"
    renewed = ["restarted", "reloaded"]
    assert again.names()[7:] == (["checked", *renewed] if stops else [*renewed, "checked"])


# ---- journal and task ----


def test_a_journal_of_another_machine_or_with_a_broken_line_is_refused(again: Rig, tmp_path: Path) -> None:
    paper, again.geometry = again.geometry, load_geometry(machines()["hanging"].write(tmp_path / "machine.yaml"))
    with pytest.raises(InputFileError, match=r"is paper, not .*; give another folder"):
        again.loop()
    again.geometry, path = paper, again.folder / "journal.jsonl"
    path.write_bytes(path.read_bytes().replace(b"{", b"[", 1))
    with pytest.raises(InputFileError, match="line 1: is not JSON"):
        again.loop()


BEGUN = '{"time": "", "event": "begun", "machine": "paper", "goal_m": '
EVENTS = [
    ('{"time": "", "event": "planned", "number": 1}', "line 1, planned.campaign: is missing"),
    ('{"time": "", "event": "refused", "number": "9"}', r"refused.number: must be of the type int \(found '9'\)"),
    (BEGUN + "true}", r"begun.goal_m: must be of the type float \| None \(found True\)"),
    (BEGUN + 'null, "box_m": [[0, 0, 0], [1, 1]]}', r"begun.box_m: must be of the type tuple\[tuple\[float, float, fl"),
    ('{"time": "", "event": ["begun"]}', 'line 1: must be a JSON object whose "event" is one of begun, planned, coll'),
    ("3", 'line 1: must be a JSON object whose "event" is one of begun, planned, coll'),
]


@pytest.mark.parametrize(("line", "complaint"), EVENTS)
def test_a_journal_with_a_wrong_event_is_refused(line: str, complaint: str, tmp_path: Path) -> None:
    (tmp_path / "journal.jsonl").write_text(line + "\n", encoding="utf-8")
    with pytest.raises(InputFileError, match=complaint):
        begun_with(tmp_path)


def test_only_the_unfinished_line_of_a_journal_is_removed(tmp_path: Path) -> None:
    """Bytes that are no UTF-8 are read as one character of three bytes; the file must not grow by them."""
    path, line = tmp_path / "journal.jsonl", b'{"time": "", "event": "refused", "reason": "\xff"}\n'
    path.write_bytes(line + b'{"event"')
    assert [event["event"] for event in Journal(path).events] == ["refused"]
    assert path.read_bytes() == line


def test_an_event_that_a_full_disk_cuts_off_leaves_no_half_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    book = Journal(tmp_path / "journal.jsonl")
    book.add("refused", reason="one")
    with monkeypatch.context() as patch:
        patch.setattr(journal.os, "fsync", Mock(side_effect=OSError(28, "No space left on device")))
        with pytest.raises(InputFileError, match="cannot be written: No space left"):
            book.add("refused", reason="lost")
    book.add("refused", reason="two")
    assert [e["reason"] for e in Journal(book.path).events] == ["one", "two"]


def test_a_folder_has_one_user_at_a_time(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The lock belongs to the open file, so a killed process leaves the folder free."""
    monkeypatch.setattr(journal, "LEFT_WITHIN", 0.0)
    with (
        journal.sole_user(tmp_path / "new"),
        pytest.raises(InputFileError, match="another adapt works in this folder"),
        journal.sole_user(tmp_path / "new"),
    ):
        pass
    with journal.sole_user(tmp_path / "new"):
        assert Journal(tmp_path / "new" / journal.JOURNAL).events == []


def test_a_task_has_a_goal_or_a_campaign_and_not_both() -> None:
    box, level = np.array([[0.0] * 3, [0.1] * 3]), np.eye(3)
    with pytest.raises(CommandError, match="and not both"):
        Task(box, level, goal=1e-6, campaign=Campaign(box, 0.1, 0.1, "6-D", 4, level=level))
    for goal in (0.0, np.inf):
        with pytest.raises(CalibrationError, match=f"goal: must be finite and above zero, m, not {goal:g}"):
            Task(box, level, goal=goal)


def test_checks_that_a_single_reading_spoils_end_with_the_instrument() -> None:
    """Three spoilt checks in a row end the run, and none of them counts against the machine."""
    state = State(in_use="model.yaml", promised_in_use=1e-6, reloaded=True)
    check = {"event": "checked", "good": False, "spoilt": True, "readings": "c.csv"}
    for _ in range(3):
        assert next_step(state, None, True) in ("guard", "check")
        state = state.after(check)
    assert (next_step(state, None, True), state.doubts) == ("give up", ())
    assert State(in_use="model.yaml", reloaded=True, spoilt=2).after({**check, "good": True}).spoilt == 0


def test_one_contradiction_that_is_not_repeated_changes_nothing() -> None:
    state = State(in_use="model.yaml", promised_in_use=1e-6, promised=1e-6, reloaded=True)
    bad = {"event": "checked", "good": False, "spoilt": False, "readings": "c.csv"}
    once = state.after(bad)
    assert (once.changed, next_step(once, 0, True)) == (False, "check"), "at once, not at the next turn"
    assert once.after({**bad, "good": True}) == replace(state, checks=1)
    assert next_step(once.after(bad), 0, True) == "repair"


def test_the_median_of_three_looks_counts_and_a_beam_that_stays_broken_is_none(again: Rig) -> None:
    """If two of three observations are outliers, more are made until there is a majority."""
    pose, sigma = again.geometry.home, np.full(6, 2e-7)
    good = Observation(pose, sigma)
    wild, wilder = (Observation(Pose(pose.position + off, pose.rotation), sigma) for off in (1e-3, -1e-3))
    looks = [good, wild, good], [None, wild, good, good], [wild, good, wilder, good, good], [None] * 6 + [good, good]
    for three in looks:
        again.machine.observe = Mock(side_effect=three)
        found = upkeep.MedianObserver(again.machine).observe()
        assert (found is None) == (three is looks[-1])
        assert again.machine.observe.call_count == len(three)
        if found is not None:
            np.testing.assert_allclose(found.pose.position, pose.position, atol=1e-15)
            of_median = np.sqrt(np.pi / 2.0 / (len(three) - three.count(None)))
            np.testing.assert_allclose(found.uncertainty, np.maximum(of_median * sigma, 1e-7))


def test_the_stated_uncertainty_is_that_of_the_median(again: Rig) -> None:
    """The standard deviation of 2000 medians of three with σ = 4 µm is known to 2 %; √(π/2n) of it is 8 % more."""
    rng, home = np.random.default_rng(1), again.geometry.home
    found = []
    for _ in range(2000):
        places = home.position + rng.normal(0.0, 4e-6, (3, 3))
        noisy = [Observation(Pose(place, home.rotation), np.full(6, 4e-6)) for place in places]
        again.machine.observe = Mock(side_effect=noisy)
        found.append(upkeep.MedianObserver(again.machine).observe())
    scatter = np.std([o.pose.position for o in found], axis=0).mean()
    assert found[0].uncertainty[0] == pytest.approx(1.08 * scatter, rel=0.05)
