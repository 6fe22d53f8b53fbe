"""``travel``, and --tool and --work of the verbs that take poses. Truth: the zoo's own frames and kinematics."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from foreign_machines import Machine, with_frames

from hexapod_comp.cli import main
from hexapod_comp.compensation.travel import travel
from hexapod_comp.machine.geometry import load_geometry
from hexapod_comp.machine.model import MachineModel, RealMachine
from hexapod_comp.pose import Pose, angles_from_rotation

SHOWN = 1e-9  # mm; the last digit of lengths

Printed = pytest.CaptureFixture[str]


@pytest.fixture(params=["framed", "hanging", "inches", "mirror"])
def machine(request: pytest.FixtureRequest) -> Machine:
    return with_frames(request.param)


@pytest.fixture
def file(machine: Machine, tmp_path: Path) -> str:
    return str(machine.write(tmp_path / "machine.yaml"))


def at_home(machine: Machine) -> tuple[str, Pose]:
    """Return the probe's pose in the fixture with the platform at home: as an option, and as a pose."""
    used = machine.using("probe", "fixture")
    pose = Pose(used.tips(np.array([machine.home]), np.eye(3)[None])[0], used.work.matrix.T @ used.tool.matrix)
    values = [*(pose.position * 1e3), *np.degrees(angles_from_rotation(pose.rotation))]
    return ",".join(repr(float(value)) for value in values), pose


def test_ik_fk_and_check_take_tool_and_work_frame(machine: Machine, file: str, tmp_path: Path, capsys: Printed) -> None:
    text, pose = at_home(machine)
    names = ["--machine", file, "--tool", "probe", "--work", "fixture"]
    assert main(["ik", f"--pose={text}", *names, "--json"]) == 0
    said = json.loads(capsys.readouterr().out)
    assert (said["tool"], said["frame"]) == ("probe", "fixture")
    lengths = [said["rows"][0][f"L{n}_mm"] for n in range(1, 7)]
    truth = machine.lengths(np.array([machine.home]), np.eye(3)[None])[0]
    np.testing.assert_allclose(lengths, truth * 1e3, rtol=0.0, atol=SHOWN)
    assert main(["fk", "--lengths", ",".join(map(repr, lengths)), *names, "--json"]) == 0
    row = json.loads(capsys.readouterr().out)["rows"][0]
    np.testing.assert_allclose([row[f"{axis}_mm"] for axis in "xyz"], pose.position * 1e3, rtol=0.0, atol=1e-7)
    (tmp_path / "poses.csv").write_text(f"x_mm,y_mm,z_mm,alpha_deg,beta_deg,gamma_deg\n{text}\n")
    assert main(["check", str(tmp_path / "poses.csv"), *names]) == 0
    assert "1 pose of the probe in fixture" in capsys.readouterr().out


def test_travel_from_a_pose_and_from_home(machine: Machine, file: str, capsys: Printed) -> None:
    """The same both ways, and what the function says."""
    text, pose = at_home(machine)
    frames = ["--machine", file, "--tool", "probe", "--work", "fixture"]
    assert main(["travel", f"--pose={text}", *frames, "--json"]) == 0
    said = json.loads(capsys.readouterr().out)
    geometry = load_geometry(file).using("probe", "fixture")
    ways = travel(RealMachine(geometry, MachineModel(geometry.name)), pose)
    assert (said["tool"], said["frame"]) == ("probe", "fixture")
    for row, way in zip(said["travel"], ways, strict=True):
        assert (row["way"], row["unit"]) == (way.way, way.unit)
        assert row["travel"] == pytest.approx(way.shown, abs=1e-6)
        assert row["limit"] == (way.error and way.error.reason)
    assert main(["travel", *frames]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].startswith(f"machine {machine.name}: how far the probe in fixture may go from x, y, z ")
    assert [line.split()[:3] for line in lines[2:]] == [[w.way, f"{w.shown:.3f}", w.unit] for w in ways]


@pytest.mark.parametrize(
    ("words", "complaint"),
    [
        (["--tool", "drill"], "machine framed has no tool 'drill'; it has tool, probe, stub"),
        (["--work", "table"], "machine framed has no work frame 'table'; it has base, work, fixture"),
        (["--pose=0,0,9000"], "is outside the stroke"),
        (["--pose=0,0"], "needs three or six numbers"),
        (["--model", "no_such_model.yaml"], "no_such_model.yaml"),
    ],
)
def test_what_cannot_be_is_refused(words: list[str], complaint: str, tmp_path: Path, capsys: Printed) -> None:
    file = with_frames("framed").write(tmp_path / "machine.yaml")
    try:
        code = main(["travel", "--machine", str(file), *words])
    except SystemExit as end:
        code = int(end.code or 0)
    assert code == 2
    assert complaint in capsys.readouterr().err
