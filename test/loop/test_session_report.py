"""What ``run`` and ``demo`` say about poses: in the frame of the user's file, named, whatever tool and work frames are.

Truth: the poses that the user gave, and displacements of them by hand; the frames are turned, so that base and work
differ in every number.
"""

from __future__ import annotations

from contextlib import contextmanager
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from strategies import paper_geometry

from hexapod_comp.formats.csv import Row
from hexapod_comp.formats.json import plain
from hexapod_comp.loop import run as loop
from hexapod_comp.loop.records import PoseRecord, SessionResult
from hexapod_comp.loop.report import pose_block
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

    @contextmanager
    def no_bar():
        yield SimpleNamespace(update=None)

    client = SimpleNamespace(close=lambda: None)
    monkeypatch.setattr(loop, "session", SimpleNamespace(connect=lambda *_: None, run_session=run_session))
    monkeypatch.setattr(loop, "_client", lambda _: client)
    monkeypatch.setattr(loop, "_progress", no_bar)
    geometry = replace(paper_geometry(), work=TURNED_WORK, tool=TURNED_TOOL)
    found = loop.witnessed(geometry, (), [GIVEN], None, 100.0, False)
    in_base = TURNED_WORK.position + TURNED_WORK.rotation @ GIVEN.position
    np.testing.assert_allclose(told[0].position, in_base, rtol=0, atol=1e-15)
    return found


def test_json_says_the_frame_and_gives_back_the_users_own_numbers(result: SessionResult):
    content = plain(loop.as_json([Row(2, "1")], result))
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
