"""Compensator and strut drive together bring the tool to its command. The reports of ``run`` and ``demo``.

The truth is the virtual machine's true tool pose. With the true model only the drive's error remains: every motor is on
a step, so each strut is wrong by at most half a step δ, and the tool by at most Σ|J⁻¹|·δ, row by row. J comes from
central differences of closed-form strut lengths, not from the package. Reversal bands, ticks and Newton steps add 1e-9
m.
"""

from __future__ import annotations

import contextlib
import io
import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, ClassVar

import numpy as np
import pytest
from foreign_machines import machines
from helpers import assert_equal, beside, central_difference, long_test, moved, table_poses, twist_between
from node_helpers import CONFIG, HOME, Rig, closed_form_lengths
from strategies import paper_geometry

from hexapod_comp import cli
from hexapod_comp.compensation.checks import check
from hexapod_comp.errors import CalibrationError, HexapodError, NoAnswerError
from hexapod_comp.formats.csv import Row
from hexapod_comp.formats.figures import save
from hexapod_comp.formats.json import plain
from hexapod_comp.loop import processes, report, session, story
from hexapod_comp.loop.pictures import session_figure
from hexapod_comp.loop.report import ABSOLUTE, ALIGNED, PoseRecord, SessionResult, busy_text, error_table
from hexapod_comp.machine.arrays import rms
from hexapod_comp.machine.geometry import HexapodGeometry, load_geometry
from hexapod_comp.machine.model import MachineModel, RealMachine
from hexapod_comp.machine.model_file import load_model
from hexapod_comp.machine.trajectory import move
from hexapod_comp.pose import Pose, rotation_from_angles
from hexapod_comp.ros.messages import message_pose
from hexapod_comp.virtual.watched import Instrument
from hexapod_comp.workspace.reach import ReachedBox, machine_box

TEXTS = beside(__file__)

STEP = ENCODER = 0.1e-6  # m; motor step of a fine drive (the default) and count of an encoder
NOISE = 0.05e-6  # standard deviation of an encoder reading, m
REST = 1e-9  # m and rad; tolerance beyond drive and encoder
RATE, FEED = 250.0, 0.1  # commands per second, Hz, and largest tool speed, m/s

TRUE_MODEL = "paper_machine.yaml"

# Two poses of the paper's Table 1, tilted by 5° about x and about z
TARGETS = [table_poses()[index] for index in (1, 3)]


def visit(rig: Rig, geometry: HexapodGeometry, **compensator: object) -> list[Pose]:
    """Start both nodes, move from home to each target, rest, and return the tool's true poses."""
    rig.drive(truth_file=TRUE_MODEL, step=STEP, encoder_resolution=ENCODER, encoder_noise=NOISE, max_acceleration=10.0)
    rig.compensator(feedback_timeout=10.0, **compensator)
    rig.until(lambda: rig.values().get("pose_estimated_from") == "strut_states", "feedback")
    rig.settle(HOME)
    start, found = HOME, []
    for target in TARGETS:
        path = move(geometry, start, target, RATE, FEED)
        for index in range(len(path)):
            rig.ask(path.pose(index))
            rig.step(1.0 / RATE)
        rig.step(0.3)
        found.append(message_pose(rig.seen["tool_pose_true"][-1]))
        start = target
    return found


def tool_bound(pose: Pose, strut_error: float) -> np.ndarray:
    """Return the largest tool displacement, m and rad, (6,), for strut errors up to a bound, m."""
    jacobian = central_difference(lambda twist: closed_form_lengths(moved(pose, twist)), np.zeros(6))
    return np.abs(np.linalg.inv(jacobian)).sum(axis=1) * strut_error + REST


@pytest.mark.parametrize("enabled", [True, False])
def test_only_quantisation_stands_between_the_model_and_the_tool(rig: Rig, enabled: bool) -> None:
    """With the true model the tool's error is within the bound; without compensation it is over 50 times the bound. The
    estimate equals the truth to half an encoder count plus 6σ of noise."""
    geometry = load_geometry(CONFIG / "paper.yaml")
    found = visit(rig, geometry, model_file=TRUE_MODEL, enable_compensation=enabled)
    for target, true in zip(TARGETS, found, strict=True):
        bound, error = tool_bound(target, STEP / 2.0), twist_between(target, true)
        if enabled:
            assert (np.abs(error) <= bound).all()
        else:
            assert np.linalg.norm(error[:3]) > 50.0 * np.linalg.norm(bound[:3])
    if enabled:
        bound = tool_bound(TARGETS[-1], ENCODER / 2.0 + 6.0 * NOISE)
        for message in rig.seen["tool_pose_estimate"][-20:]:
            assert (np.abs(twist_between(found[-1], message_pose(message))) <= bound).all()


# ---- the report of run ----

TURNED_WORK = Pose(np.array([0.03, -0.02, 0.35]), rotation_from_angles(np.radians([4.0, -7.0, 90.0])))
TURNED_TOOL = Pose(np.array([0.01, 0.02, 0.05]), rotation_from_angles(np.radians([10.0, 5.0, -60.0])))
GIVEN = Pose(np.array([0.012, -0.034, 0.056]), rotation_from_angles(np.radians([1.0, -2.0, 3.0])))
OFF = np.array([30e-6, -40e-6, 0.0])  # in the work frame: 50 µm


def stand_in(
    monkeypatch: pytest.MonkeyPatch, run_session: Callable[..., SessionResult], sent: object = None
) -> list[str]:
    """Replace the nodes, their client and a session; return the names of the machines that must be the running one."""
    machines: list[str] = []
    client = SimpleNamespace(close=lambda: None, sent=sent, refuse_other=machines.append)
    for name, other in (("connect", lambda *_: None), ("run_session", run_session), ("loop_client", lambda _: client)):
        monkeypatch.setattr(session, name, other)
    return machines


def test_json_says_the_frame_and_gives_back_the_users_own_numbers(monkeypatch: pytest.MonkeyPatch):
    """A session with one pose in ``base``, after which the tool is 50 µm off."""
    told: list[Pose] = []

    def run_session(client: object, geometry: object, targets: list[Pose], *rest: object) -> SessionResult:
        told.extend(targets)
        true = TURNED_WORK @ Pose(GIVEN.position + OFF, GIVEN.rotation)
        return SessionResult([PoseRecord(target, np.zeros(6), np.zeros(6), target, None, true) for target in targets])

    machines = stand_in(monkeypatch, run_session)
    geometry = replace(paper_geometry(), work=TURNED_WORK, tool=TURNED_TOOL)
    result = session.run_poses(geometry, (), [GIVEN], 100.0, False)
    assert machines == ["paper"]
    in_base = TURNED_WORK.position + TURNED_WORK.rotation @ GIVEN.position
    np.testing.assert_allclose(told[0].position, in_base, rtol=0, atol=1e-15)
    content = plain(report.as_json([Row(2, "1")], result, {}))
    assert content["frame"] == "work"
    counts = ("sent", "lost", "refused", "late_answers", "longest_latency_ms", "latency_median_ms")
    assert [content[name] for name in counts] == [0, 0, 0, 0, 0, None]
    (pose,) = content["poses"]
    given = {"x_mm": 12.0, "y_mm": -34.0, "z_mm": 56.0, "alpha_deg": 1.0, "beta_deg": -2.0, "gamma_deg": 3.0}
    assert pose["commanded"] == pytest.approx(given, abs=1e-9)  # a few roundings of 1e-13 mm
    assert pose["estimated"] == pytest.approx(given, abs=1e-9)
    assert pose["true"] == pytest.approx(given | {"x_mm": 12.030, "y_mm": -34.040}, abs=1e-9)
    assert pose["error_with"]["position_um"] == pytest.approx(50.0, abs=1e-6)


def test_the_report_of_a_run() -> None:
    """Errors of 200 and 100 µm without, 50 and 20 µm with compensation: RMS √25000, √1450; 100 µrad about the tool."""
    turn = rotation_from_angles(np.array([0.0, 0.0, 1e-4]))

    def off(size: float) -> Pose:
        return Pose(GIVEN.position + size * OFF / 50.0, GIVEN.rotation @ (turn if size == 50.0 else np.eye(3)))

    lengths, corrections = np.linspace(0.5, 0.55, 6), np.linspace(-1e-4, 1e-4, 6)
    estimate = Pose([-1e-9, -1e-9, 0.4], rotation_from_angles(np.full(3, -1e-9)))
    records = [
        PoseRecord(GIVEN, lengths, corrections, estimate, off(200.0), off(50.0)),
        PoseRecord(GIVEN, lengths, corrections, None, off(100.0), off(20.0)),
    ]
    counts = {"late": 2, "longest": 0.03, "sent": 100, "lost": 1, "refused": 5, "refusals": {"step": 3, "speed": 2}}
    result = SessionResult(records, np.array([1e-3, 2e-3, 4e-3]), model="mine", **counts)
    errors = result.errors()
    assert f"\n{report.pose_block('pose 1', records[0])}\n{report.summary(result, errors)}\n" == TEXTS["report of run"]
    told = plain(report.as_json([Row(2, "1"), Row(3, "2")], result, errors))
    assert_equal(told, TEXTS["json of run"], relative=1e-6, absolute=1e-5)
    half = error_table({ABSOLUTE: np.array([[np.nan], [30e-6]])})
    assert " ".join(half.splitlines()[1].split()) == "at rest, absolute – 30.000 30.000 – RMS of 1 poses"


# The datum: one rigid motion of all tool poses

DATUM = Pose(np.array([90e-6, -40e-6, 10e-6]), rotation_from_angles(np.array([2e-4, -1e-4, 3e-4])))


def shifted(count: int = 8) -> SessionResult:
    """Return true poses that differ from the targets by a datum; without compensation by 20 µm of noise as well."""
    rng = np.random.default_rng(1)
    targets = [Pose(place, np.eye(3)) for place in rng.uniform(-0.1, 0.1, (count, 3))]

    def seen(datum: Pose, pose: Pose, noise: float) -> Pose:
        there = datum @ pose
        return Pose(there.position + noise * rng.standard_normal(3), there.rotation)

    poses = [
        PoseRecord(pose, true_without=seen(DATUM, pose, 2e-5), true_with=seen(DATUM, pose, 0.0)) for pose in targets
    ]
    return SessionResult(poses)


def test_best_fit_alignment_removes_a_datum() -> None:
    """It removes a datum of 100 µm and 0.4 mrad completely; 20 µm of noise without compensation remain."""
    errors = shifted().errors()
    assert list(errors) == [ALIGNED, ABSOLUTE]
    assert rms(errors[ABSOLUTE][1]) == pytest.approx(np.linalg.norm(DATUM.position), rel=0.3)
    before, left = errors[ALIGNED]
    assert left.max() < 1e-12
    assert rms(before) == pytest.approx(2e-5 * np.sqrt(3.0 - 6.0 / 8.0), rel=0.4)  # the datum takes six of 24 numbers
    assert "after best-fit alignment" in error_table(errors).splitlines()[1]


def test_too_few_poses_are_not_aligned() -> None:
    """Five poses are fifteen numbers, of which a datum takes six: the error left would look too small."""
    assert ALIGNED in shifted(6).errors()
    few, line = shifted(5), shifted(8)
    for record in line.poses:
        record.target = Pose([record.target.position[0], 0.0, 0.0], np.eye(3))
    for result in (few, line):
        assert {*result.errors()} == {ABSOLUTE}
    assert SessionResult([PoseRecord(GIVEN)]).errors() == {}, "what nobody saw has no rows"


def test_a_busy_computer_is_named() -> None:
    """Answers after 4 ms are in time at 250 Hz; 20 of 1000 late answers are allowed."""
    latencies = np.full(1000, 4e-3)
    latencies[:20] = 0.81
    assert busy_text(latencies, 250.0) == ""
    latencies[20] = 0.0041
    said = "the computer was busy: 21 of 1000 answers came after the next command was due, the slowest after 810 ms"
    assert busy_text(latencies, 250.0) == f"{said}; close other programs and try again"


def test_the_picture_of_a_run_needs_no_truth(tmp_path: Path) -> None:
    """Without true poses, as of an attached machine, a picture is drawn without them."""
    save(session_figure(SessionResult([PoseRecord(Pose.identity())]), "nothing seen"), tmp_path / "run.png")
    assert (tmp_path / "run.png").stat().st_size > 1_000


def test_a_busy_computer_is_named_when_an_answer_does_not_come(monkeypatch: pytest.MonkeyPatch) -> None:
    """If a session ends with an error there is no report, so the error message names the busy computer."""

    def run_session(*_: object) -> SessionResult:
        raise NoAnswerError("no answer to a command within 5 s")

    sent = {n: SimpleNamespace(sent_at=0.0, answered_at=0.9 if n < 50 else 1e-3) for n in range(100)}
    stand_in(monkeypatch, run_session, sent)
    with pytest.raises(NoAnswerError, match="within 5 s; the computer was busy: 50 of 100"):
        session.run_poses(paper_geometry(), (), [GIVEN], 100.0, False)


class Node:
    """A stand-in for a node's process, which ends with a code of `codes`."""

    codes: ClassVar[dict[str, int]] = {}

    def __init__(self, name: str, parameters: dict[str, Any]) -> None:
        self.name, self.parameters = name, parameters
        self.model = load_model(parameters.get("model_file") or parameters["truth_file"], paper_geometry())

    def exit_code(self) -> int | None:
        return self.codes.get(self.name)

    def output(self) -> str:
        return "last words"

    def stop(self) -> tuple[int, str]:
        return self.codes.get(self.name, 0), f"{self.name}'s last words"


def test_nodes_of_a_simulated_machine_have_its_files_and_say_why_they_ended(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(session, "NodeProcess", Node)
    monkeypatch.setattr(session, "PrivateDomain", contextlib.nullcontext)
    models = MachineModel("paper", "mine"), MachineModel("paper", "true")
    with session.simulated("paper", *models) as nodes:
        told = {"following_error_limit": 0.1, "max_command_age": 5.0}
    assert [(node.name, node.model.name) for node in nodes] == [("compensator", "mine"), ("strut_drive", "true")]
    assert {key: nodes[0].parameters[key] for key in told} == told
    assert {node.parameters["geometry_file"] for node in nodes} == {str(CONFIG / "paper.yaml")}
    for error in (NoAnswerError("in vain"), ValueError("in vain")):
        with pytest.raises(type(error)) as caught, session.simulated("paper", *models):
            raise error
        logs = "compensator:\ncompensator's last words\nstrut_drive:\nstrut_drive's last words"
        output = f"; output of the nodes:\n{logs}" * isinstance(error, NoAnswerError)
        assert str(caught.value) == f"in vain{output}"
    monkeypatch.setattr(Node, "codes", {"strut_drive": 3})
    with pytest.raises(HexapodError, match=r"^strut_drive ended with code 3:"), session.simulated("paper", *models):
        pass
    client = SimpleNamespace(wait=lambda ready, *_: ready())
    with pytest.raises(HexapodError, match=r"^strut_drive ended with code 3:"):
        session.connect(client, nodes[1:])


class Client:
    """A stand-in for the client of the nodes: each move is ten commands, of which the last is answered late or lost."""

    has_true_pose = True

    def __init__(self) -> None:
        self.estimate, self.true_pose, self.sent, self.log = HOME, HOME, {}, []
        self.diagnostics = {"compensation": "on", "ramping": "false"}

    def enable(self, on: bool) -> None:
        self.log.append(on)

    def hold(self, at: Pose, rate: float, until: Any, timeout: float, what: str) -> SimpleNamespace:
        self.log.append(what)
        if what == "compensation to ramp":
            assert not until(), "the diagnostics are those from before"
            for state in ({"ramping": "true"}, {"ramping": "false"}):
                assert not until()
                compensation = "on" if self.log[-2] else "off"
                self.diagnostics = {"compensation": compensation, "model": "mine", "refused.step": "2", **state}
            assert until()
        self.true_pose = Pose(at.position + OFF, at.rotation)
        return SimpleNamespace(command=np.full(6, 0.5), correction=np.full(6, 1e-6))

    def settled(self) -> Any:
        return lambda: True

    def stream(self, path: Any, progress: Any) -> list[SimpleNamespace]:
        late = 0.03 if self.log[-1] == "compensation to ramp" else np.nan
        sent = [SimpleNamespace(sent_at=0.0, answered_at=1e-3 if n < 9 else late) for n in range(10)]
        self.sent |= {(len(self.sent), n): entry for n, entry in enumerate(sent)}
        progress(len(path))
        return sent

    def counted(self) -> tuple[int, int]:
        return 36, 2


def test_a_session_without_and_with_compensation() -> None:
    """Two passes over two poses: of 40 commands 38 are answered, 2 of them late, 2 are refused and 2 lost."""
    client, announced = Client(), list[str]()
    targets = [Pose([x, 0.0, 0.4], np.eye(3)) for x in (0.01, 0.02)]
    result = session.run_session(client, paper_geometry(), targets, 250.0, True, announce=announced.append)
    assert announced == ["pass without compensation …", "pass with compensation …"]
    rest = ["the machine to come to rest"] * 2
    assert client.log == [False, "compensation to ramp", *rest, True, "compensation to ramp", *rest]
    assert sorted(result.latencies) == [1e-3] * 18 + [0.03]
    assert (result.late, result.longest, result.sent, result.lost, result.refused) == (2, 0.03, 40, 2, 2)
    assert (result.refusals, result.model) == ({"step": 2}, "mine")
    assert result.busy.startswith("the computer was busy: 2 of 38 answers")
    for record, target in zip(result.poses, targets, strict=True):
        assert (record.target, record.estimate, record.command[0], record.correction[0]) == (target, HOME, 0.5, 1e-6)
        for true in (record.true_without, record.true_with):
            np.testing.assert_allclose(true.position, target.position + OFF)


def test_a_domain_in_use_is_not_chosen(monkeypatch: pytest.MonkeyPatch) -> None:
    """Domain d has the UDP ports 7400 + 250 · d + offset: 10 of its first participant, 5 of our reservation."""
    taken: set[int] = set()
    opened: list[SimpleNamespace] = []

    def bind(port: int) -> SimpleNamespace | None:
        if port in taken:
            return None
        found = SimpleNamespace(port=port)
        found.close = lambda: opened.remove(found)
        opened.append(found)
        return found

    monkeypatch.setattr(processes, "_bind", bind)
    for pid, ports, wanted in ((101, (), 1), (0, (7660,), 2), (0, (7655, 7910), 3), (100, (), 101), (100, (32660,), 1)):
        taken, opened = set(ports), []
        monkeypatch.setattr(processes.os, "getpid", lambda pid=pid: pid)
        domain, _ = processes.reserve_domain()
        assert (domain, [one.port for one in opened]) == (wanted, [7400 + 250 * wanted + 5])
    taken = {7400 + 250 * domain + 10 for domain in range(1, 102)}
    with pytest.raises(RuntimeError, match="all ROS domains from 1 to 101 are in use on this computer"):
        processes.reserve_domain()


# ---- the demonstration ----


def test_the_box_is_about_this_machines_home(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The box, 200 mm long, is centred at home, or as near to home as the machine's largest box allows."""
    boxes: list[np.ndarray] = []

    def largest_box(geometry: HexapodGeometry) -> ReachedBox:
        found = machine_box(geometry)
        boxes.append(found.box)
        return found

    monkeypatch.setattr(story, "machine_box", largest_box)
    for machine in machines().values():
        geometry = load_geometry(machine.write(tmp_path / "machine.yaml"))
        box = story.demo_place(geometry).box
        home = machine.tips(np.array([machine.home]), np.eye(3)[None])[0]
        largest, middle = boxes.pop(), box.mean(axis=0)
        low, high = np.abs(box - largest) < 1e-6  # faces that both boxes share
        assert (np.isclose(middle, home, atol=1e-9) | (low & (middle > home)) | (high & (middle < home))).all()
        assert ((home >= box[0]) & (home <= box[1])).all()
        wanted = np.minimum([0.2, 0.2, 0.1], 0.98 * np.ptp(largest, axis=0))
        np.testing.assert_allclose(np.ptp(box, axis=0), wanted, rtol=0.0, atol=1.1e-4)  # rounded to 0.1 mm per half


def test_a_tool_that_cannot_be_level_stays_as_at_home() -> None:
    """A tool whose frame points down keeps home's attitude, so that the box's corners are within the limits."""
    paper = load_geometry("paper")
    geometry = replace(paper, tool=Pose([0.0, 0.0, 0.1], rotation_from_angles(np.radians([180.0, 0.0, 0.0]))))
    place = story.demo_place(geometry)
    np.testing.assert_allclose(place.attitude, geometry.tool.rotation, atol=1e-12)
    assert check(geometry, MachineModel("paper"), [Pose(corner, place.attitude) for corner in place.box]).ok


def test_a_warm_machine_has_struts_longer_by_steels_growth() -> None:
    geometry = load_geometry("paper")
    warm = story.warmed(geometry, MachineModel("paper"), 5.0).struts
    home = np.linalg.norm(
        geometry.home.position + geometry.platform_joints @ geometry.home.rotation.T - geometry.base_joints, axis=1
    )
    np.testing.assert_allclose(warm.offset, 57.5e-6 * home, rtol=1e-12)
    np.testing.assert_allclose(warm.pitch, 57.5e-6)


def test_the_text_of_a_demonstration() -> None:
    """Two stops that miss by (3, 4, 0) µm at one place, which no alignment changes, and one without an error."""
    at = np.array([0.1, 0.2, 0.3])
    chapters = [
        story.Chapter("as built", [1.0, 2.0], [at, at], [at + np.array([3e-6, 4e-6, 0.0])] * 2),
        story.Chapter("calibrated", [3.0], [at], [at]),
    ]
    events = [{"event": "repaired", "text": "a temperature has changed: 5 K"}, {"event": "checked", "text": "strut_3"}]
    left = {"as built": 4e-6, "calibrated": 0.25e-6, "renewed": 0.2e-6}
    told = story.Demonstration(chapters, events, 0.2e-6, left, list(story._complaints(events, 0.2e-6, left, 2)))
    assert told.text() == TEXTS["demonstration"]
    passed = "PASSED: both changes were named and repaired; no RMS error in the box is above the promised error"
    assert replace(told, complaints=[]).text().splitlines()[-1] == passed
    content = told.as_json()
    first = content.pop("chapters")[0]
    assert content == {"promised_m": 0.2e-6, "events": events, "complaints": told.complaints}
    assert first == {"title": "as built", "stops": 2, "rms_m": pytest.approx(5e-6), "box_rms_m": 4e-6}


class Upkeep:
    """A stand-in for the adaptation: each check and each calibration is one stop, and every change is repaired."""

    good = True

    def __init__(self, geometry: HexapodGeometry, machine: story.RecordedMachine, *rest: object, say: object) -> None:
        (self.task, _, self.reload), self.machine, self.events, self.checked = rest, machine, [], machine.truth
        assert (self.task.goal, self.task.every) == (3e-6, 0.0)
        assert machine.instrument == Instrument(1e-6, 1e-6, 0.01, 0.02), "as doc/demo.md states"
        self.home = geometry.tool_pose(geometry.home)
        self.state = SimpleNamespace(promised_in_use=1e-6)

    def calibrate(self) -> SimpleNamespace:
        self.machine.move(self.home)
        self.reload(Path("model.yaml"))
        return SimpleNamespace(good=self.good, state="failed", text="too few readings")

    def guard(self, checks: int) -> None:
        assert checks == 1
        self.machine.move(self.home)
        if self.machine.truth is not self.checked:
            self.checked = self.machine.truth
            text = "a strut's offset has changed: strut_6" if self.events else "a temperature has changed"
            self.events.append({"event": "repaired", "text": text})
            self.reload(Path("model.yaml"))


def test_the_order_of_the_demonstration(monkeypatch: pytest.MonkeyPatch) -> None:
    """Each state of machine and model is a chapter, and after each repair one more check confirms it."""
    seen = []

    def held_out(real: RealMachine, model: MachineModel, box: np.ndarray, level: np.ndarray) -> SimpleNamespace:
        seen.append((real.model.struts.offset, model.name))
        return SimpleNamespace(aligned=SimpleNamespace(rms=1e-7 * len(seen)))

    monkeypatch.setattr(story, "held_out", held_out)
    monkeypatch.setattr(story, "Adaptation", Upkeep)
    monkeypatch.setattr(story, "load_model", lambda path, geometry: MachineModel("paper", path.stem))
    geometry = load_geometry("paper")
    told = story.demonstrate(geometry, MachineModel("paper"), 2)
    titles = ["as built", "calibrated", "warmer by 5 K", "renewed", "strut_6 knocked", "repaired"]
    assert [(chapter.title, len(chapter.times)) for chapter in told.chapters] == [(title, 1) for title in titles]
    assert [round(chapter.times[0] / story.STOP) for chapter in told.chapters] == [1, 2, 3, 4, 5, 6]
    assert (told.promised, told.complaints) == (1e-6, [])
    assert told.left == pytest.approx({title: 1e-7 * (n + 1) for n, title in enumerate(titles)})
    assert [name for _, name in seen] == [MachineModel("paper").name, *["model"] * 5]
    offsets = np.array([offset for offset, _ in seen])
    np.testing.assert_allclose(offsets[[4, 5]] - offsets[[3, 3]], [[0, 0, 0, 0, 0, 20e-6]] * 2, atol=1e-15)
    assert not offsets[:2].any()
    assert (offsets[2] == offsets[3]).all()
    assert offsets[2].min() > 20e-6
    monkeypatch.setattr(Upkeep, "good", False)
    with pytest.raises(CalibrationError, match="demo: failed: too few readings"):
        story.demonstrate(geometry, MachineModel("paper"), 2)


@long_test
@pytest.mark.timeout(300)
def test_the_whole_story_on_a_foreign_machine(tmp_path: Path) -> None:
    """The demonstration passes on a machine with turned frames and with every kind of error of ``random``."""
    file = machines()["framed"].write(tmp_path / "machine.yaml")
    words = ["--machine", file, "--truth", "random:5", "--seed", 2, "--pictures", tmp_path / "out"]
    with contextlib.redirect_stdout(io.StringIO()) as out:
        code = cli.main(["demo", "--json", *map(str, words)])
    told = json.loads(out.getvalue())
    assert (code, told["complaints"]) == (0, []), told["chapters"]
    left = {chapter["title"]: chapter["box_rms_m"] for chapter in told["chapters"]}
    titles = ["as built", "calibrated", "warmer by 5 K", "renewed", "strut_6 knocked", "repaired"]
    assert list(left) == titles
    assert max(left[title] for title in titles[1::2]) <= told["promised_m"] <= story.GOAL
    assert left["calibrated"] < 0.1 * left["as built"]
    assert min(left[title] for title in titles[2::2]) > 2.0 * left["calibrated"]
    assert [chapter["stops"] for chapter in told["chapters"][1:]] == [16, 48, 16, 48, 16]  # a check; with its repair
    for chapter in told["chapters"][1::2]:  # sixteen stops scatter by 10 %, and the drives' steps are 0.1 µm
        assert chapter["rms_m"] == pytest.approx(left[chapter["title"]], rel=0.4, abs=0.1e-6)
    assert (tmp_path / "out" / "demo.png").stat().st_size > 20_000
