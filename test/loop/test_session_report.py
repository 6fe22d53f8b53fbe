"""What ``run`` says about poses: in the frame of the user's file, named, whatever tool and work frames are.

Truth: the poses that the user gave, and displacements of them by hand; the frames are turned, so that base and work
differ in every number.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from strategies import paper_geometry

from hexapod_comp.errors import NoAnswerError
from hexapod_comp.formats.csv import Row
from hexapod_comp.formats.figures import save
from hexapod_comp.formats.json import plain
from hexapod_comp.loop import report, session
from hexapod_comp.loop.pictures import session_figure
from hexapod_comp.loop.report import (
    ALIGNED,
    AS_IT_IS,
    PoseRecord,
    SessionResult,
    busy_text,
    error_table,
    pose_block,
)
from hexapod_comp.machine.arrays import rms
from hexapod_comp.pose import Pose, rotation_from_angles

TURNED_WORK = Pose(np.array([0.03, -0.02, 0.35]), rotation_from_angles(np.radians([4.0, -7.0, 90.0])))
TURNED_TOOL = Pose(np.array([0.01, 0.02, 0.05]), rotation_from_angles(np.radians([10.0, 5.0, -60.0])))
GIVEN = Pose(np.array([0.012, -0.034, 0.056]), rotation_from_angles(np.radians([1.0, -2.0, 3.0])))
OFF = np.array([30e-6, -40e-6, 0.0])  # in the work frame: 50 µm


@pytest.fixture
def result(monkeypatch: pytest.MonkeyPatch) -> SessionResult:
    """Return what a loop would tell of one pose: it hears and answers in ``base``, the tool ends up 50 µm off."""
    told: list[Pose] = []

    def run_session(client: object, geometry: object, targets: list[Pose], *rest: object) -> SessionResult:
        told.extend(targets)
        true = TURNED_WORK @ Pose(GIVEN.position + OFF, GIVEN.rotation)
        return SessionResult([PoseRecord(target, np.zeros(6), np.zeros(6), target, None, true) for target in targets])

    client = SimpleNamespace(close=lambda: None)
    for name, stand_in in (("connect", lambda *_: None), ("run_session", run_session)):
        monkeypatch.setattr(session, name, stand_in)
    monkeypatch.setattr(session, "loop_client", lambda _: client)
    geometry = replace(paper_geometry(), work=TURNED_WORK, tool=TURNED_TOOL)
    found = session.run_poses(geometry, (), [GIVEN], 100.0, False)
    in_base = TURNED_WORK.position + TURNED_WORK.rotation @ GIVEN.position
    np.testing.assert_allclose(told[0].position, in_base, rtol=0, atol=1e-15)
    return found


def test_json_says_the_frame_and_gives_back_the_users_own_numbers(result: SessionResult):
    content = plain(report.as_json([Row(2, "1")], result, {}))
    assert content["frame"] == "work"
    (pose,) = content["poses"]
    given = {"x_mm": 12.0, "y_mm": -34.0, "z_mm": 56.0, "alpha_deg": 1.0, "beta_deg": -2.0, "gamma_deg": 3.0}
    assert pose["commanded"] == pytest.approx(given, abs=1e-9)  # some roundings of 1e-13 mm, a thousandfold
    assert pose["estimated"] == pytest.approx(given, abs=1e-9)
    assert pose["true"] == pytest.approx(given | {"x_mm": 12.030, "y_mm": -34.040}, abs=1e-9)
    assert pose["error_with"]["position_um"] == pytest.approx(50.0, abs=1e-6)


def test_text_says_the_frame_and_gives_back_the_users_own_numbers(result: SessionResult):
    title, commanded, *rest = pose_block("pose 1", result.poses[0]).splitlines()
    assert title == "pose 1: tool in work"
    assert [float(word) for word in commanded.split()[2:7:2]] == [12.0, -34.0, 56.0]
    (true,) = (line for line in rest if line.split()[0] == "true")
    assert [float(word) for word in true.split()[2:7:2]] == [12.03, -34.04, 56.0]


# The datum: one rigid motion of everything that the tool does.

DATUM = Pose(np.array([90e-6, -40e-6, 10e-6]), rotation_from_angles(np.array([2e-4, -1e-4, 3e-4])))


def shifted(count: int = 8) -> SessionResult:
    """Return poses that a machine meets but for its datum, with compensation, and without it also 20 µm."""
    rng = np.random.default_rng(1)
    targets = [Pose(place, np.eye(3)) for place in rng.uniform(-0.1, 0.1, (count, 3))]

    def seen(datum: Pose, pose: Pose, noise: float) -> Pose:
        there = datum @ pose
        return Pose(there.position + noise * rng.standard_normal(3), there.rotation)

    poses = [
        PoseRecord(pose, true_without=seen(DATUM, pose, 2e-5), true_with=seen(DATUM, pose, 0.0)) for pose in targets
    ]
    return SessionResult(poses)


def test_a_datum_is_aligned() -> None:
    """Shifted and turned by 100 µm and 0.4 mrad alone: nothing is left; 20 µm of noise without compensation stay."""
    errors = shifted().errors()
    assert list(errors) == [ALIGNED, AS_IT_IS]
    assert rms(errors[AS_IT_IS][1]) == pytest.approx(np.linalg.norm(DATUM.position), rel=0.3)
    before, left = errors[ALIGNED]
    assert left.max() < 1e-12
    assert rms(before) == pytest.approx(2e-5 * np.sqrt(3.0 - 6.0 / 8.0), rel=0.4)  # six of 24 numbers are the datum's
    table = error_table(errors).splitlines()
    assert len(table) == 3
    assert "datum aligned" in table[1]


def test_too_few_poses_are_not_aligned() -> None:
    """Five poses are fifteen numbers, of which a datum takes six: what is left would flatter."""
    few, line = shifted(5), shifted(8)
    for record in line.poses:
        record.target = Pose([record.target.position[0], 0.0, 0.0], np.eye(3))
    for result in (few, line):
        assert {*result.errors()} == {AS_IT_IS}


def test_what_nobody_saw_has_no_rows() -> None:
    assert SessionResult([PoseRecord(GIVEN)]).errors() == {}


def test_a_busy_computer_is_named() -> None:
    latencies = np.full(1000, 1e-3)
    assert busy_text(latencies, 250.0) == ""
    latencies[:40] = 0.81
    said = busy_text(latencies, 250.0)
    assert said.startswith("the computer was busy: 40 of 1000 answers came after the next command was due, the longest")


def test_the_picture_of_a_run_needs_no_truth(tmp_path: Path) -> None:
    """What nobody saw is not drawn, and nothing breaks: an attached machine tells no true pose."""
    save(session_figure(SessionResult([PoseRecord(Pose.identity())]), "nothing seen"), tmp_path / "run.png")
    assert (tmp_path / "run.png").stat().st_size > 1_000


def test_a_busy_computer_is_named_when_an_answer_does_not_come(monkeypatch: pytest.MonkeyPatch) -> None:
    """The session ends with an error then, and there is no report."""

    def run_session(*_: object) -> SessionResult:
        raise NoAnswerError("no answer to a command within 5 s")

    sent = {n: SimpleNamespace(sent_at=0.0, answered_at=0.9 if n < 50 else 1e-3) for n in range(100)}
    for name, stand_in in (("connect", lambda *_: None), ("run_session", run_session)):
        monkeypatch.setattr(session, name, stand_in)
    monkeypatch.setattr(session, "loop_client", lambda _: SimpleNamespace(close=lambda: None, sent=sent))
    with pytest.raises(NoAnswerError, match="within 5 s; the computer was busy: 50 of 100"):
        session.run_poses(paper_geometry(), (), [GIVEN], 100.0, False)
