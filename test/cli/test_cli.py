"""The command line in-process: what it prints, what it refuses and how, and what ``check`` finds."""

from __future__ import annotations

import contextlib
import csv
import io
import json
import os
import pty
import re
import signal
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from helpers import hexapod, table_lengths, table_poses
from scipy.spatial.transform import Rotation
from strategies import paper_geometry, random_field, random_model

from hexapod_comp.cli import poses, results
from hexapod_comp.cli.verbs import VERBS
from hexapod_comp.compensation.checks import check
from hexapod_comp.compensation.compensator import Compensator
from hexapod_comp.errors import GeometryError, HexapodError
from hexapod_comp.machine.field import GridField
from hexapod_comp.machine.geometry import load_geometry
from hexapod_comp.machine.model import MachineModel, ModelOrigin, MotionState, RealMachine
from hexapod_comp.machine.model_file import load_model, model_text
from hexapod_comp.machine.pose_files import read_lengths, read_poses
from hexapod_comp.machine.struts import StrutErrors
from hexapod_comp.pose import Pose

ROOT = Path(__file__).resolve().parents[2]
TABLE_1 = str(ROOT / "config" / "table1.csv")
PAPER = paper_geometry()
IDEAL = MachineModel("paper")
MACHINES = ("example_6_6.yaml", "jugglebot.yaml", "paper.yaml", "positioning_unit.yaml")
POSE_HEADER = "name,x_mm,y_mm,z_mm,alpha_deg,beta_deg,gamma_deg"

DEFAULT_NOTE = "hexapod_comp: note: no --machine was given: this is machine paper, the default\n"


def parsed(text: str) -> list[dict[str, str]]:
    return list(csv.DictReader(io.StringIO(text)))


def file_of(folder: Path, rows: Sequence[Sequence[object]], header: str = POSE_HEADER) -> str:
    path = folder / "poses.csv"
    path.write_text("\n".join([header, *(",".join(map(str, row)) for row in rows)]) + "\n")
    return str(path)


# The program itself.


def test_verbs_explain_themselves_and_rules_name_their_options() -> None:
    """A rule about an option that a verb has not would never be broken."""
    for name, verb in VERBS.items():
        assert f"$ hexapod_comp {name} " in hexapod(name, "--help")[1].partition("example:\n")[2] + " "
        options = {option.name for option in verb.options}
        for rule in verb.rules:
            assert {name.split(" ")[0] for name in rule.options} <= options


def test_json_is_printed_and_out_stays_csv(tmp_path: Path) -> None:
    """Both at once: the file is the one that is written without --json."""
    one, two = str(tmp_path / "one.csv"), str(tmp_path / "two.csv")
    for verb, given in (("ik", TABLE_1), ("check", TABLE_1), ("assess", TABLE_1)):
        hexapod(verb, given, "--out", one)
        code, out, err = hexapod(verb, given, "--out", two, "--json")
        assert (code, err) == (0, "")
        assert json.loads(out)["machine"] == "paper"
        assert Path(one).read_bytes() == Path(two).read_bytes()
        code, out, err = hexapod(verb, given, "--out", str(tmp_path / "x.json"))
        assert (code, out) == (2, "")
        assert "argument --out: writes CSV; for JSON: --json > " in err


@pytest.mark.parametrize(
    ("typed", "offered"),
    [
        ("", set(VERBS)),
        ("re", {"record", "replay"}),
        ("ik --m", {"--machine", "--model"}),
        ("ik --machine pap", {"paper.yaml"}),
        ("ik --machine ", {*MACHINES, "mine.csv", "deep/"}),
        ("ik --model ", {"ideal", "random", "paper_machine.yaml", "paper_lines_model.yaml", "mine.csv", "deep/"}),
        ("plan campaign_", {"campaign_1d.yaml", "campaign_5d.yaml", "campaign_full.yaml"}),
        ("classify --budget e", {"error_budget.yaml"}),
        ("check ", {"table1.csv", "table3.csv", "table5.csv", "mine.csv", "deep/"}),
        ("fit --scheme ", {"joint", "lines"}),
        ("demo --pictures d", {"deep/"}),
        ("ik --pose ", set()),
    ],
)
def test_the_shell_completes(tmp_path: Path, typed: str, offered: set[str]) -> None:
    """As bash asks, by argcomplete's protocol: a line, a cursor, a file for the answers. Nothing heavy is loaded."""
    pytest.importorskip("argcomplete")
    (tmp_path / "mine.csv").touch()
    (tmp_path / "deep").mkdir()
    line = f"hexapod_comp {typed}"
    asked = {"_ARGCOMPLETE": "1", "_ARGCOMPLETE_STDOUT_FILENAME": "answers", "_ARGCOMPLETE_IFS": "\n"}
    asked |= {"COMP_LINE": line, "COMP_POINT": str(len(line)), "COMP_TYPE": "9", "_ARGCOMPLETE_SUPPRESS_SPACE": "1"}
    path = os.pathsep.join([str(ROOT), *filter(None, sys.path)])
    code = "import sys; sys.modules['numpy'] = None; import hexapod_comp.cli as cli; cli.main()"
    subprocess.run(
        [sys.executable, "-c", code], cwd=tmp_path, env=os.environ | asked | {"PYTHONPATH": path}, timeout=20
    )
    answers = {name.strip() for name in (tmp_path / "answers").read_text().split("\n") if name.strip()}
    assert {name for name in answers if typed.endswith("--m") or not name.startswith("-")} - {"answers"} == offered


def test_the_marks_by_which_the_shell_finds_out_are_at_the_top() -> None:
    """argcomplete's global completion reads the first 1,024 bytes of what a command imports."""
    for name in ("cli/__init__.py", "__main__.py"):
        assert "PYTHON_ARGCOMPLETE_OK" in (ROOT / "hexapod_comp" / name).read_text(encoding="utf-8")[:1024]


def test_version_is_the_packages() -> None:
    version = re.search(r"<version>(.*)</version>", (ROOT / "package.xml").read_text())
    assert version
    assert hexapod("--version") == (0, f"hexapod_comp {version.group(1)}\n", "")


def test_errors_name_row_and_column(tmp_path: Path) -> None:
    path = file_of(tmp_path, [("a", 0, 0, 400, 0, 0, 0), ("b", 0, 0, "four", 0, 0, 0)])
    for verb in ("ik", "check", "assess"):
        assert hexapod(verb, path) == (
            2,
            "",
            f"hexapod_comp: error: {path}: line 3, column z_mm: must be a finite number (found 'four')\n",
        )


def test_control_c_and_a_closed_pipe(monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupted(args: object) -> int:
        raise KeyboardInterrupt

    monkeypatch.setattr(poses, "ik", interrupted)
    assert hexapod("ik", "--pose", "0,0,400") == (130, "", "")


def test_lengths_from_a_pipe_and_a_pipe_that_is_closed_are_quiet(tmp_path: Path) -> None:
    """``hexapod_comp ik long.csv | hexapod_comp fk - | head`` in real processes."""
    path = file_of(tmp_path, [(n, 0, 0, 400, 0, 10, 0) for n in range(5000)])
    program = f"{sys.executable} -m hexapod_comp"
    command = f"{program} ik {path} --machine paper | {program} fk - --machine paper | head -2"
    done = subprocess.run(["sh", "-c", command], cwd=ROOT, capture_output=True, text=True, timeout=100)
    assert parsed(done.stdout)[0]["beta_deg"] == "10.000000000"
    assert done.stderr == ""


# ik and fk.


def test_table_1_gives_table_2_at_the_printed_digits() -> None:
    """000, Tables 1 and 2."""
    code, out, err = hexapod("ik", TABLE_1)
    assert (code, err) == (0, DEFAULT_NOTE)
    rows = parsed(out)
    assert [row["sequence"] for row in rows] == [str(n) for n in range(1, 11)]
    ours = [[f"{float(row[f'L{i}_mm']):.3f}" for i in range(1, 7)] for row in rows]
    assert ours == [[f"{length * 1e3:.3f}" for length in row] for row in table_lengths()]


@pytest.mark.parametrize("model", ["ideal", "paper_machine", "paper_lines_model"])
@pytest.mark.parametrize("start", [(), ("--guess", "-5,3,390,2,-2,1"), ("--cold",)], ids=["home", "guess", "cold"])
def test_ik_then_fk_is_where_it_started(tmp_path: Path, model: str, start: tuple[str, ...]) -> None:
    """CSV carries 1e-9 mm and degrees; the pose moves by less than ten times the lengths' rounding."""
    lengths, poses = str(tmp_path / "lengths.csv"), str(tmp_path / "poses.csv")
    assert hexapod("ik", TABLE_1, "--model", model, "--out", lengths) == (0, "", DEFAULT_NOTE)
    assert hexapod("fk", lengths, "--model", model, *start, "--out", poses) == (0, "", DEFAULT_NOTE)
    rows, found = read_poses(poses)
    assert [row.label for row in rows] == [str(n) for n in range(1, 11)]
    for pose, wanted in zip(found, table_poses(), strict=True):
        np.testing.assert_allclose(pose.position, wanted.position, atol=1e-11)
        np.testing.assert_allclose(pose.rotation, wanted.rotation, atol=1e-10)
    assert len(read_lengths(lengths)[1]) == 10


def test_one_pose_as_text_and_as_json() -> None:
    """Table 2, row 2. Negative numbers need no equals sign."""
    by_list = hexapod("ik", "--pose", "0,0,400,5,0,0")
    printed = re.findall(r"strut_\d +([\d.]+)", by_list[1])
    assert [f"{float(value):.3f}" for value in printed] == [f"{length * 1e3:.3f}" for length in table_lengths()[1]]
    content = json.loads(hexapod("ik", "--pose", "0,0,400,5,0,0", "--json")[1])
    assert content["rows"][0]["L1_mm"] == pytest.approx(519.494, abs=5e-4)
    spaced = hexapod("ik", "--pose", "-5,0,400,-1,0,0")
    assert spaced == hexapod("ik", "--pose=-5,0,400,-1,0,0")


def test_ik_with_a_model_prints_commands_and_corrections() -> None:
    """command = nominal + correction, in mm and µm; the correction is the compensator's first one."""
    code, out, _ = hexapod("ik", "--pose", "1,2,410,3,4,5", "--model", "paper_machine", "--json")
    row = json.loads(out)["rows"][0]
    for i in range(1, 7):
        command, nominal = row[f"L{i}_mm"], row[f"nominal_L{i}_mm"]
        assert command - nominal == pytest.approx(row[f"correction_L{i}_um"] * 1e-3, abs=1e-10)
    table = hexapod("ik", "--pose", "1,2,410,3,4,5", "--model", "paper_machine")[1]
    assert table.splitlines()[1].split() == ["strut", "nominal_mm", "command_mm", "correction_um"]
    assert code == 0


def only_backlash(folder: Path, lost: list[float], machine: str = "paper") -> str:
    """A model with a backlash, µm, and nothing else."""
    path = folder / "backlash.yaml"
    struts, origin = StrutErrors(backlash=np.array(lost) * 1e-6), ModelOrigin("2026-01-31")
    path.write_text(model_text(MachineModel(machine, "lost motion", struts=struts, origin=origin)))
    return str(path)


def test_forward_and_backward_differ_by_the_backlash_and_midway_is_between(tmp_path: Path) -> None:
    """A backlash is what a command must go further after a reversal: forward − backward = b, by definition."""
    lost = [1.0, 2.0, 3.0, 4.0, 5.0, 8.0]
    given = ("ik", "--pose", "70,-30,420,3,-2,5", "--model", only_backlash(tmp_path, lost))
    found = {}
    for direction in ("forward", "backward", "midway"):
        told = () if direction == "midway" else ("--direction", direction)
        content = json.loads(hexapod(*given, *told, "--json")[1])
        (row,) = content["rows"]
        assert row["direction"] == direction
        found[direction] = np.array([row[f"L{i}_mm"] for i in range(1, 7)]) * 1e3
        if told:  # fk, moved the same way, finds the pose again; its text and that of ik say which way
            lengths = ",".join(repr(float(length) * 1e-3) for length in found[direction])
            back = ("fk", "--lengths", lengths, *given[3:], *told)
            (pose,) = json.loads(hexapod(*back, "--json")[1])["rows"]
            assert [pose[name] for name in POSE_HEADER.split(",")[1:]] == pytest.approx(
                [70, -30, 420, 3, -2, 5], abs=1e-9
            )
            for verb in (given, back):
                assert f"all axes and struts moved {direction}" in hexapod(*verb, *told)[1].splitlines()[0]
    assert found["forward"] - found["backward"] == pytest.approx(lost, abs=1e-6)
    assert (found["forward"] + found["backward"]) / 2 == pytest.approx(found["midway"], abs=1e-6)


@pytest.mark.parametrize("machine", ["paper", "example_6_6"])
def test_a_line_has_both_ways_of_every_strut(tmp_path: Path, machine: str) -> None:
    """Commands differ by +b where the nominal length, by finite differences, rises on the way, by −b where it falls."""
    geometry = load_geometry(f"{machine}.yaml")
    x, y, z = geometry.tool_pose(geometry.home).position * 1e3
    lost, out = [1.0, 2.0, 3.0, 4.0, 5.0, 8.0], tmp_path / "line.csv"
    model = only_backlash(tmp_path, lost, geometry.name)
    line = f"{x - 20},{y - 5},{z + 1},{x + 21},{y + 3},{z + 2},1,2,3"
    given = ("ik", "--machine", machine, "--model", model, "--line", line, "--step-mm", "4", "--out", str(out))
    assert hexapod(*given) == (0, "", "")
    rows = parsed(out.read_text())
    half = len(rows) // 2
    assert [row["direction"] for row in rows] == ["forward"] * half + ["backward"] * half
    assert half == 12  # 41.79 mm: eleven poses 4 mm apart, and the end
    places = np.array([[float(row[f"{axis}_mm"]) for axis in "xyz"] for row in rows])
    np.testing.assert_allclose(places[[0, half - 1]], np.array(line.split(",")[:6], float).reshape(2, 3), atol=1e-8)
    np.testing.assert_allclose(places[:half], places[half:], atol=0)
    np.testing.assert_allclose(np.linalg.norm(np.diff(places[:half], axis=0), axis=1)[:-1], 4.0, atol=1e-8)
    nominal, corrections = (
        np.array([[float(row[name.format(i)]) for i in range(1, 7)] for row in rows])
        for name in ("nominal_L{}_mm", "correction_L{}_um")
    )
    rates = np.diff(nominal[:half], axis=0)
    steady = np.sign(rates[1:]) == np.sign(rates[:-1])  # no turning point between a row's neighbours
    assert steady.mean() > 0.8
    assert (rates > 0.0).any()
    assert (rates < 0.0).any()
    both = (corrections[:half] - corrections[half:])[1:-1]
    np.testing.assert_allclose(both[steady], (np.sign(rates[1:]) * lost)[steady], atol=1e-5)
    assert len(read_lengths(str(out))[1]) == 2 * half  # fk reads it


def test_a_line_is_what_the_compensator_commands_on_the_way() -> None:
    """The compensator follows the motion from pose to pose; with all errors of the model, a field that reverses too."""
    line, step = ((-30.0, 20.0, 410.0), (30.0, 10.0, 415.0)), "10"
    given = ("ik", "--line", ",".join(map(str, sum(line, ()))), "--step-mm", step, "--model", "paper_machine", "--json")
    rows = json.loads(hexapod(*given)[1])["rows"]
    machine = RealMachine(PAPER, load_model("paper_machine.yaml", PAPER))
    half = len(rows) // 2
    for way in (rows[:half], rows[half:][::-1]):
        motion = MotionState()
        for n, row in enumerate(way):
            position = [row[f"{axis}_mm"] * 1e-3 for axis in "xyz"]
            target = PAPER.platform_pose(Pose(np.array(position), np.eye(3)))
            commands = machine.commands_for(target, motion)[0]
            if n:  # at the first nothing has moved yet
                assert [row[f"L{i}_mm"] for i in range(1, 7)] == pytest.approx(commands * 1e3, abs=1e-9)


def test_ik_predicts_the_error_without_compensation_in_the_work_frame(tmp_path: Path) -> None:
    """Told nominal lengths, the machine is where ``fk`` says. The shipped model carries no covariance: never a zero."""
    pose = "10,20,420,2,-3,4"
    lengths = json.loads(hexapod("ik", "--pose", pose, "--json")[1])["rows"][0]
    told = ",".join(repr(lengths[f"L{n}_mm"]) for n in range(1, 7))
    went = json.loads(hexapod("fk", "--lengths", told, "--model", "paper_machine", "--guess", pose, "--json")[1])[
        "rows"
    ][0]
    content = json.loads(hexapod("ik", "--pose", pose, "--model", "paper_machine", "--json")[1])
    assert content["error_frame"] == "work"
    assert content["error_sd_not_known"] == "model 'virtual machine' carries no covariance of a fit"
    row = content["rows"][0]
    for axis, commanded in zip("xyz", (10.0, 20.0, 420.0), strict=True):
        assert row[f"error_{axis}_um"] == pytest.approx((went[f"{axis}_mm"] - commanded) * 1e3, abs=1e-6)
    assert all(row[name] is None for name in row if "_sd_" in name)
    assert abs(row["error_aligned_x_um"]) < abs(row["error_x_um"])  # 80 µm of the datum
    text = hexapod("ik", "--pose", pose, "--model", "paper_machine")[1]
    assert text.count("not known") == 1 + 1 + 12  # the direction, the reason, six components twice
    poses, table = tmp_path / "poses.csv", tmp_path / "table.csv"
    poses.write_text(f"x_mm,y_mm,z_mm,alpha_deg,beta_deg,gamma_deg\n{pose}\n")
    assert hexapod("ik", str(poses), "--model", "paper_machine", "--out", str(table))[0] == 0
    header, values = (line.split(",") for line in table.read_text().splitlines())
    cells = dict(zip(header, values, strict=True))
    assert float(cells["error_z_um"]) == pytest.approx(row["error_z_um"], abs=1e-5)
    assert cells["error_z_sd_um"] == ""
    assert "error_z_um" not in hexapod("ik", str(poses))[1]


def test_fk_names_the_row_without_a_pose(tmp_path: Path) -> None:
    rows = [(500,) * 6, (500, 500, 500, 500, 500, 2000), (500,) * 6]
    path = file_of(tmp_path, rows, "L1_mm,L2_mm,L3_mm,L4_mm,L5_mm,L6_mm")
    code, out, err = hexapod("fk", path)
    assert (code, out) == (2, "")
    assert err.startswith("hexapod_comp: error: line 3 (row 2): no pose has these strut lengths")


# check.


def stream_pose(z: float) -> tuple[object, ...]:
    return ("", 0, 0, z, 0, 0, 0)


def test_a_terminal_shows_what_is_done() -> None:
    """What takes seconds says so on a terminal, in whole lines also where that gives no width; pipes stay clean."""
    code = "import hexapod_comp.cli as cli; cli.main(['plan', 'campaign_1d', '--blocks', 'pitch'])"
    ours, theirs = pty.openpty()
    with subprocess.Popen([sys.executable, "-c", code], cwd=ROOT, stdout=subprocess.PIPE, stderr=theirs) as process:
        out = process.communicate(timeout=60)[0]
    os.close(theirs)
    shown = os.read(ours, 10_000).decode()
    os.close(ours)
    assert "s  what 1670 readings determine\r" in shown
    assert out.startswith(b"machine paper: 1670 readings")


def test_lists_of_broken_limits_are_capped(tmp_path: Path) -> None:
    """However many targets are out of reach: twenty lines in check, ten notes of ik, and how many more there are."""
    path = file_of(tmp_path, [(n, 0, 0, 950, 0, 0, 0) for n in range(30)])
    code, out, _ = hexapod("check", path, "--stream", "--rate-hz", "1")
    broken = int(re.search(r"broken limits \((\d+)\)", out).group(1))
    assert code == 1
    assert out.count(" is outside the stroke") == 20
    assert f"… and {broken - 20} more; --json prints all" in out
    assert len(json.loads(hexapod("check", path, "--stream", "--rate-hz", "1", "--json")[1])["broken"]) == broken
    code, _, err = hexapod("ik", path)
    assert (code, err.count("note: line ")) == (0, 10)
    assert re.search(r"note: \d+ more limits are broken; see check\n$", err)


LINES = {
    # limit: options, rows, row that breaks it first, text of its line
    "stroke": ((), [stream_pose(400), stream_pose(900), stream_pose(400)], 3, "strut_1: nominal length 953."),
    "base_cone": ((), [stream_pose(400), ("", 430, 0, 250, 0, 0, 0)], 3, "base joint at"),
    "platform_cone": ((), [stream_pose(400), ("", 0, 0, 500, 0, 0, 85)], 3, "platform joint at"),
    "clearance": ((), [stream_pose(400), ("", 0, 0, 400, 0, 0, 60)], 3, "mm from the nearest other strut"),
    "condition": ((), [stream_pose(400), ("", 0, 0, 400, 0, 0, 89)], 3, "condition number"),
    "step": (("--stream", "--rate-hz", "50"), [stream_pose(400), stream_pose(403)], 3, "would change by 2.3"),
    "speed": (("--stream",), [stream_pose(400), stream_pose(401.5)], 3, "length would change at 29"),
}


@pytest.mark.parametrize("limit", LINES)
def test_check_names_row_and_limit(tmp_path: Path, limit: str) -> None:
    """Poses made to break one limit each; the machine is the paper's, opened wide but for the limit meant."""
    options, rows, line, text = LINES[limit]
    wide = {"stroke": "[200, 2000]", "base_cone": "89", "platform_cone": "120", "condition": "1000"}
    kept = {"stroke": "[330, 880]", "base_cone": "50", "platform_cone": "30", "condition": "10"}
    values = {name: kept[name] if name == limit else wide[name] for name in wide}
    machine = (ROOT / "config" / "paper.yaml").read_text()
    for key, name in (
        ("stroke_mm", "stroke"),
        ("base_cone_deg", "base_cone"),
        ("platform_cone_deg", "platform_cone"),
        ("condition_number", "condition"),
    ):
        machine = re.sub(rf"{key}: \S+( \S+\])?", f"{key}: {values[name]}", machine)
    machine = machine.replace("  step_mm", f"  clearance_mm: {220 if limit == 'clearance' else 0}\n  step_mm")
    geometry = tmp_path / "machine.yaml"
    geometry.write_text(machine)
    path = file_of(tmp_path, rows)
    code, out, err = hexapod("check", path, "--machine", str(geometry), *options)
    assert (code, err) == (1, "")
    broken = [entry for entry in out.splitlines() if entry.startswith("line ")]
    assert broken
    assert all(entry.startswith(f"line {line} (row ") for entry in broken)
    assert any(text in entry for entry in broken)
    report = json.loads(hexapod("check", path, "--machine", str(geometry), *options, "--json")[1])
    assert not report["within_limits"]
    assert {entry["limit"] for entry in report["broken"]} == {limit}
    assert all(entry["line"] == line for entry in report["broken"])
    smallest = next(entry for entry in report["smallest_margins"] if entry["limit"] == limit)
    assert smallest["margin"] < 0.0
    assert smallest["line"] == line


def test_check_names_a_correction_that_is_too_large() -> None:
    """A strut 2.5 mm short needs 2.5 mm of correction, 2 mm are allowed: at every pose, for that strut alone."""
    model = MachineModel("paper", struts=StrutErrors(offset=np.array([0.0, 0.0, 0.0, -2.5e-3, 0.0, 0.0])))
    poses = table_poses()
    result = check(PAPER, model, poses, mode="poses")
    assert {(b.limit, b.error.strut) for b in result.breaches} == {("correction", 3)}  # type: ignore[attr-defined]
    assert [b.row for b in result.breaches] == list(range(10))
    assert result.limits["correction"].margin[:, 1] == pytest.approx(-0.5e-3, abs=1e-12)


def test_check_finds_what_happens_on_the_way() -> None:
    """Both ends within the stroke of strut 1, the middle not: a straight line past its base joint's foot."""
    joint = PAPER.base_joints[0]
    there = PAPER.platform_joints[0]
    middle = np.array([joint[0] - there[0], joint[1] - there[1], 0.4])
    ends = [Pose(middle + np.array([0.0, y, 0.0]), np.eye(3)) for y in (-0.1, 0.1)]
    lengths = [np.linalg.norm(p.position + there - joint) for p in (*ends, Pose(middle, np.eye(3)))]
    assert min(lengths[:2]) > lengths[2]
    limits = replace(
        PAPER.limits,
        stroke=np.vstack([[0.5 * (lengths[0] + lengths[2]), 2.0], np.tile([0.2, 2.0], (5, 1))]),
        base_cone=np.full(6, 2.0),
        platform_cone=np.full(6, 2.0),
        condition=100.0,
    )
    geometry = replace(PAPER, limits=limits)
    assert check(geometry, IDEAL, ends, mode="poses").ok
    result = check(geometry, IDEAL, ends, mode="moves")
    assert [(b.row, b.limit, b.error.strut) for b in result.breaches] == [(1, "stroke", 0)]  # type: ignore[attr-defined]
    assert result.breaches[0].share == pytest.approx(0.5, abs=0.01)
    assert result.limits["stroke"].margin[1, 0] == pytest.approx(lengths[2] - limits.stroke[0, 0], abs=1e-6)
    assert result.examined > 100


def test_check_agrees_with_the_compensator_on_a_random_stream() -> None:
    """The compensator refuses a fresh pose exactly where check finds a limit broken, and for one of its reasons."""
    rng = np.random.default_rng(21)
    limits = replace(
        PAPER.limits,
        stroke=np.tile([0.38, 0.66], (6, 1)),
        base_cone=np.full(6, 0.4),
        platform_cone=np.full(6, 0.5),
        condition=1.3,
        correction=1.0e-3,
        step=10.0,
    )
    geometry = replace(PAPER, limits=limits)
    model = replace(random_model(rng, "paper"), field=random_field(rng, outside="refuse"))
    positions = PAPER.home.position + rng.uniform(-0.12, 0.12, (400, 3))
    rotations = Rotation.from_rotvec(rng.uniform(-0.3, 0.3, (400, 3))).as_matrix()
    result = check(geometry, model, (positions, rotations), mode="poses")
    reasons = [{b.limit for b in result.breaches if b.row == n} for n in range(400)]
    for n in range(400):
        compensator = Compensator(geometry, model)
        if reasons[n]:
            with pytest.raises(HexapodError) as caught:
                compensator.correct(Pose(positions[n], rotations[n]))
            assert caught.value.reason in reasons[n]
        else:
            record = compensator.correct(Pose(positions[n], rotations[n]))
            np.testing.assert_allclose(result.lengths[n], [record.nominal, record.command], atol=1e-15)
    found = set().union(*reasons)
    assert {"stroke", "base_cone", "platform_cone", "condition", "correction", "outside_field"} <= found
    assert 100 < sum(not r for r in reasons) < 300


def test_check_follows_a_stream_like_the_compensator() -> None:
    """Directions, backlash and steps along a stream: largest steps and corrections as the compensator makes them."""
    model = random_model(np.random.default_rng(22), "paper")
    geometry = replace(PAPER, limits=replace(PAPER.limits, correction=0.02))
    angle = np.linspace(0.0, 4.0 * np.pi, 700)
    positions = PAPER.home.position + 0.02 * np.stack([np.cos(angle), np.sin(2 * angle), 0.2 * np.sin(angle)], axis=1)
    rotations = Rotation.from_rotvec(0.05 * np.stack([np.sin(angle)] * 3, axis=1)).as_matrix()
    result = check(geometry, model, (positions, rotations), mode="stream")
    compensator = Compensator(geometry, model)
    records = [
        compensator.correct(Pose(p, r), n / 250) for n, (p, r) in enumerate(zip(positions, rotations, strict=True))
    ]
    commands = np.array([record.command for record in records])
    np.testing.assert_allclose(result.lengths[:, 1], commands, atol=1e-15)
    steps = np.abs(np.diff(commands, axis=0)).max(axis=1)
    np.testing.assert_allclose(np.abs(result.limits["step"].value[1:, 1]), steps, atol=1e-15)
    np.testing.assert_allclose(np.abs(result.limits["speed"].value[1:, 1]), steps * 250.0, atol=1e-12)
    corrections = np.array([record.correction for record in records])
    np.testing.assert_allclose(
        np.abs(result.limits["correction"].value[:, 1]), np.abs(corrections).max(axis=1), atol=1e-15
    )
    assert np.isnan(result.limits["step"].value[0]).all()


def test_check_says_where_a_field_cannot_be_undone() -> None:
    """A field whose displacement grows by 1.5 m per m has no inverse by iteration: named, once, per pose."""
    grid = tuple(np.array(axis) for axis in ([-0.2, 0.2], [-0.2, 0.2], [0.3, 0.5]))
    lines = [np.zeros((2, 2, 2, 6, 2)) for _ in range(3)]
    lines[0][:, :, :, 0, 1] = 0.3  # u runs from −1 to 1 over 0.4 m
    model = MachineModel("paper", field=GridField(grid, tuple(lines)))  # type: ignore[arg-type]
    poses = [Pose([0.03, 0.0, 0.4], np.eye(3)), Pose([0.05, 0.0, 0.4], np.eye(3))]
    result = check(PAPER, model, poses, mode="stream")
    assert [(b.row, b.limit) for b in result.breaches if b.limit == "not_converged"] == [
        (0, "not_converged"),
        (1, "not_converged"),
    ]


def test_check_long_streams_in_pieces() -> None:
    """40,000 poses take three pieces; margins are those of the same poses checked all by themselves."""
    angle = np.linspace(0.0, 200.0 * np.pi, 40_000)
    positions = np.stack([0.02 * np.cos(angle), 0.02 * np.sin(angle), np.full_like(angle, 0.4)], axis=1)
    rotations = np.tile(np.eye(3), (len(angle), 1, 1))
    done: list[int] = []
    result = check(PAPER, IDEAL, (positions, rotations), "stream", 250.0, done.append)
    assert result.ok
    assert (result.examined, sum(done)) == (40_000, 40_000)
    lengths = np.linalg.norm(positions[:, None] + PAPER.platform_joints - PAPER.base_joints, axis=2)
    np.testing.assert_allclose(result.lengths[:, 0], lengths, atol=1e-15)
    margins = np.minimum(lengths - PAPER.limits.stroke[:, 0], PAPER.limits.stroke[:, 1] - lengths).min(axis=1)
    np.testing.assert_allclose(result.limits["stroke"].margin[:, 0], margins, atol=1e-15)
    steps = np.abs(np.diff(lengths, axis=0)).max(axis=1)
    np.testing.assert_allclose(np.abs(result.limits["step"].value[1:, 0]), steps, atol=1e-15)


def test_check_writes_all_margins(tmp_path: Path) -> None:
    out = tmp_path / "margins.csv"
    code, text, err = hexapod("check", TABLE_1, "--model", "paper_machine", "--out", str(out))
    assert (code, err) == (0, DEFAULT_NOTE)
    assert text.endswith("all within limits\n")
    rows = parsed(out.read_text())
    assert len(rows) == 10
    assert rows[0]["step_nominal_mm"] == ""  # nothing to compare with
    assert float(rows[0]["stroke_margin_nominal_mm"]) == pytest.approx(509.192 - 330.0, abs=5e-4)
    assert {"base_cone_margin_compensated_deg", "condition_nominal", "correction_um", "speed_nominal_mm_s"} <= set(
        rows[0]
    )


def test_check_says_when_poses_leave_the_measured_box(tmp_path: Path) -> None:
    """The shipped field reaches to z = 553 mm; the model of lines was measured in the same box."""
    path = file_of(tmp_path, [("in", 0, 0, 400, 0, 0, 0), ("out", 0, 0, 600, 0, 0, 0)])
    _, out, _ = hexapod("check", path, "--model", "paper_machine")
    assert "boundary value is used there: 1 of 2, first line 3 (row out)\n" in out
    _, out, _ = hexapod("check", path, "--model", "paper_lines_model")
    assert "outside the box in which the model was measured: 1 of 2, first line 3 (row out)\n" in out


@pytest.mark.parametrize(("mode", "rate"), [("moves", 0.5), ("moves", np.nan), ("jumps", 250.0)])
def test_check_refuses_what_makes_no_sense(mode: str, rate: float) -> None:
    with pytest.raises(GeometryError):
        check(PAPER, IDEAL, table_poses(), mode=mode, rate=rate)


# assess.


def test_assess_prints_the_papers_tables() -> None:
    """Table 2 to the printed digits; Table 4 − Table 2 is what it says."""
    code, out, err = hexapod("assess", "--seed", "3")
    assert (code, err) == (0, "")
    blocks = out.split("\n\n")
    titles = [block.splitlines()[0] for block in blocks]
    assert titles[0] == "machine paper, joints ±10 µm, struts ±10 µm; seed 3"
    assert [title.rpartition("(")[2] for title in titles[1:4]] == ["as Table 1):", "as Table 2):", "as Table 4):"]
    ideal, real, change = (
        np.array([[float(cell) for cell in line.split()[1:]] for line in block.splitlines()[2:]])
        for block in blocks[2:5]
    )
    np.testing.assert_allclose(ideal * 1e-3, table_lengths(), atol=0.5001e-6)
    np.testing.assert_allclose((real - ideal) * 1e3, change, atol=1.6e-3)  # three roundings: 0.5 nm, 0.5 nm, 0.5 nm
    assert "round trip of the real structure" in blocks[-1]


def test_assess_statistics_follow_the_seed() -> None:
    first, again, other = (
        json.loads(hexapod("assess", "--machines", "5", "--seed", seed, "--json")[1]) for seed in ("5", "5", "6")
    )
    assert first == again
    assert first["statistics"] != other["statistics"]
    assert first["seeds"] == list(range(5, 10))
    assert first["round_trip_m"] <= 1e-13
    assert len(first["records"]) == 50
    largest = max(row["displacement_um"][2] for row in first["statistics"])
    found = max(np.linalg.norm([r[f"error_{axis}_um"] for axis in "xyz"]) for r in first["records"])
    assert largest == pytest.approx(found, rel=1e-9)


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGHUP])
def test_signals_end_a_session_in_order(number: signal.Signals) -> None:
    """What was started inside is ended, as contexts do; 128 + signal, as shells count."""
    ended = []
    before = signal.getsignal(number)

    def session() -> None:
        with results.ended_in_order(), contextlib.ExitStack() as started:
            started.callback(ended.append, True)
            os.kill(os.getpid(), number)

    with pytest.raises(SystemExit) as left:
        session()
    assert left.value.code == 128 + number
    assert ended
    assert signal.getsignal(number) == before
