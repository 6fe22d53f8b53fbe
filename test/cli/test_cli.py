"""The command line, called in this process: what it prints and refuses, and what ``check`` finds."""

from __future__ import annotations

import contextlib
import csv
import io
import json
import os
import re
import signal
import subprocess
import sys
from argparse import ArgumentTypeError
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from foreign_machines import with_frames
from helpers import assert_equal, hexapod, table_poses
from scipy.spatial.transform import Rotation
from strategies import paper_geometry, random_model

from hexapod_comp.cli import fitting, poses, results
from hexapod_comp.cli.verbs import VERBS
from hexapod_comp.compensation.checks import check
from hexapod_comp.compensation.compensator import Compensator
from hexapod_comp.compensation.travel import travel
from hexapod_comp.errors import GeometryError, NotConvergedError
from hexapod_comp.machine.field import GridField
from hexapod_comp.machine.geometry import load_geometry
from hexapod_comp.machine.model import MachineModel, ModelOrigin, RealMachine
from hexapod_comp.machine.model_file import load_model, model_text
from hexapod_comp.machine.pose_files import read_lengths
from hexapod_comp.machine.struts import StrutErrors
from hexapod_comp.pose import Pose, angles_from_rotation

ROOT = Path(__file__).resolve().parents[2]
TABLE_1 = str(ROOT / "config" / "table1.csv")
PAPER = paper_geometry()
IDEAL = MachineModel("paper")
POSE_HEADER = "name,x_mm,y_mm,z_mm,alpha_deg,beta_deg,gamma_deg"


def parsed(text: str) -> list[dict[str, str]]:
    return list(csv.DictReader(io.StringIO(text)))


def file_of(folder: Path, rows: Sequence[Sequence[object]], header: str = POSE_HEADER) -> str:
    path = folder / "poses.csv"
    path.write_text("\n".join([header, *(",".join(map(str, row)) for row in rows)]) + "\n")
    return str(path)


def test_verbs_explain_themselves_and_rules_name_their_options() -> None:
    """Each verb's help has an example, and its rules mention only its own options."""
    for name, verb in VERBS.items():
        assert f"$ hexapod_comp {name} " in hexapod(name, "--help")[1].partition("example:\n")[2] + " "
        options = {option.name for option in verb.options}
        for rule in verb.rules:
            assert {name.split(" ")[0] for name in rule.options} <= options


def test_json_is_printed_and_out_stays_csv(tmp_path: Path) -> None:
    """--json prints JSON and leaves the CSV file of --out unchanged; --out refuses a name that ends in .json."""
    one, two = str(tmp_path / "one.csv"), str(tmp_path / "two.csv")
    for verb, given in (("ik", TABLE_1), ("check", TABLE_1), ("assess", TABLE_1)):
        hexapod(verb, given, "--out", one)
        code, out, err = hexapod(verb, given, "--out", two, "--json")
        assert (code, err) == (0, "")
        assert json.loads(out)["machine"] == "paper"
        assert Path(one).read_bytes() == Path(two).read_bytes()
        code, out, err = hexapod(verb, given, "--out", str(tmp_path / "x.json"))
        assert (code, out) == (2, "")
        assert "argument --out: must not end in .json, because this file is CSV; for JSON: --json > " in err


@pytest.mark.parametrize(
    ("typed", "offered"),
    [
        ("re", {"record", "replay"}),
        ("ik --m", {"--machine", "--model"}),
        ("ik --model ", {"ideal", "random", "paper_machine.yaml", "paper_lines_model.yaml", "mine.csv", "deep/"}),
        ("fit --scheme ", {"joint", "lines"}),
        ("demo --pictures d", {"deep/"}),
    ],
)
def test_the_shell_completes(tmp_path: Path, typed: str, offered: set[str]) -> None:
    """Completion answers by argcomplete's protocol (line, cursor, file for the answers), without loading NumPy."""
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
    """argcomplete searches the first 1,024 bytes of the files that a command imports for its mark."""
    for name in ("cli/__init__.py", "__main__.py"):
        assert "PYTHON_ARGCOMPLETE_OK" in (ROOT / "hexapod_comp" / name).read_text(encoding="utf-8")[:1024]


def test_version_is_the_packages() -> None:
    version = re.search(r"<version>(.*)</version>", (ROOT / "package.xml").read_text())
    assert version
    assert hexapod("--version") == (0, f"hexapod_comp {version.group(1)}\n", "")


def as_floats(value: Any) -> Any:
    if isinstance(value, tuple):
        return tuple(map(as_floats, value))
    return float(value) if isinstance(value, int) else value


def reader(name: str) -> Callable[[str], Any]:
    """Return the function that reads an option's text, as declared last."""
    return [o.keywords["type"] for verb in VERBS.values() for o in verb.options if o.name == name][-1]


@pytest.mark.parametrize(
    ("option", "text", "value"),
    [
        ("--pose", "1,-2,3", ((1e-3, -2e-3, 3e-3), (0, 0, 0))),
        ("--pose", "1,2,3,180,-90,0", ((1e-3, 2e-3, 3e-3), (np.pi, -np.pi / 2, 0))),
        ("--line", "1,2,3,4,5,6", ((1e-3, 2e-3, 3e-3), (4e-3, 5e-3, 6e-3), (0, 0, 0))),
        ("--line", "1,2,3,4,5,6,0,0,90", ((1e-3, 2e-3, 3e-3), (4e-3, 5e-3, 6e-3), (0, 0, np.pi / 2))),
        ("--lengths", "1,2,3,4,5,6", (1e-3, 2e-3, 3e-3, 4e-3, 5e-3, 6e-3)),
        ("--box", "-1,2,3,4,5,6", ((-1e-3, 2e-3, 3e-3), (4e-3, 5e-3, 6e-3))),
        ("--probe-mm", "1,2,3", (1e-3, 2e-3, 3e-3)),
        ("--wave-um", "3", (0, 3e-6)),
        ("--wave-um", "2,2", (2e-6, 2e-6)),
        ("--wave-um", "0", (0, 0)),
        ("--tilt-deg", "90,0,90", (0, np.pi / 2)),
        ("--time", "a=1,0,2", ("a", (60, 0, 2))),
        ("--goal-um", "1e-9", 1e-9),
        ("--allow-um", "0.5", 0.5),
        ("--every-min", "0", 0),
        ("--checks", "0", 0),
        ("--seed", "0", 0),
        ("--outside", "a_deg=1, b_mm =-2", {"a_deg": 1.0, "b_mm": -2.0}),
    ],
)
def test_texts_of_options_become_numbers_in_si(option: str, text: str, value: Any) -> None:
    assert_equal(as_floats(reader(option)(text)), as_floats(value), 1e-12)


def test_helps_state_defaults_and_ranges() -> None:
    """A default of the parser is the default in the help, and a range begins and ends as stated."""
    for option in (option for verb in VERBS.values() for option in verb.options):
        default, read = option.keywords.get("default"), option.keywords.get("type")
        if isinstance(default, int | float | tuple):
            stated = re.search(r"\bdefault (-?[\d.,]*\d)", option.help)
            assert stated, option.name
            assert read(stated[1]) == default, option.name
        if found := re.search(r" (\d+) to (\d+)", option.help):
            low, high = map(int, found.groups())
            assert [read(str(low)), read(str(high))] == [low, high]
            for number in (low - 1, high + 1):
                with pytest.raises(ArgumentTypeError, match=f"from {low} to {high}, not"):
                    read(str(number))


@pytest.mark.parametrize(
    ("error", "code", "text"),
    [
        (KeyboardInterrupt(), 130, ""),
        (MemoryError("3 GB"), 2, "hexapod_comp: error: not enough memory: 3 GB\n"),
        (ImportError("build it", name="hexapod_comp.core._core"), 2, "hexapod_comp: error: build it\n"),
        (ImportError("x", name="scipy"), None, ""),
    ],
)
def test_errors_of_a_verb_become_exit_codes(
    error: BaseException, code: int | None, text: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    def failing(args: object) -> int:
        raise error

    monkeypatch.setattr(poses, "ik", failing)
    with contextlib.nullcontext() if code is not None else pytest.raises(ImportError):
        assert hexapod("ik", "--pose", "0,0,400") == (code, "", text)


def test_only_verbs_with_small_matrices_use_one_thread(monkeypatch: pytest.MonkeyPatch) -> None:
    name = "OPENBLAS_NUM_THREADS"
    monkeypatch.setenv(name, "")  # restored after the test, also if it is not set now
    for verb, threads in (("ik", None), ("fit", "1")):
        monkeypatch.delenv(name, raising=False)
        assert hexapod(verb, "gone.csv", *(("--out", "m.yaml") if verb == "fit" else ()))[0] == 2
        assert os.environ.get(name) == threads


def only_backlash(folder: Path, lost: list[float], machine: str = "paper") -> str:
    """Write a model whose only error is backlash, µm; return its path."""
    path = folder / "backlash.yaml"
    struts, origin = StrutErrors(backlash=np.array(lost) * 1e-6), ModelOrigin("2026-01-31")
    path.write_text(model_text(MachineModel(machine, "lost motion", struts=struts, origin=origin)))
    return str(path)


def test_forward_and_backward_differ_by_the_backlash_and_midway_is_between(tmp_path: Path) -> None:
    """By definition of the backlash b, command forward − command backward = b for each strut."""
    lost = [1.0, 2.0, 3.0, 4.0, 5.0, 8.0]
    given = ("ik", "--pose", "70,-30,420,3,-2,5", "--model", only_backlash(tmp_path, lost))
    found = {}
    for direction in ("forward", "backward", "midway"):
        told = () if direction == "midway" else ("--direction", direction)
        content = json.loads(hexapod(*given, *told, "--json")[1])
        (row,) = content["rows"]
        assert row["direction"] == direction
        found[direction] = np.array([row[f"L{i}_mm"] for i in range(1, 7)]) * 1e3
        if told:  # fk with the same direction finds the pose again; both texts state the direction
            lengths = ",".join(repr(float(length) * 1e-3) for length in found[direction])
            back = ("fk", "--lengths", lengths, *given[3:], *told)
            answer = json.loads(hexapod(*back, "--json")[1])
            (pose,) = answer["rows"]
            assert answer["direction"] == direction
            assert [pose[name] for name in POSE_HEADER.split(",")[1:]] == pytest.approx(
                [70, -30, 420, 3, -2, 5], abs=1e-9
            )
            for verb in ((*given, *told), back):
                assert f"all axes and struts moved {direction}" in hexapod(*verb)[1].splitlines()[0]
    assert found["forward"] - found["backward"] == pytest.approx(lost, abs=1e-6)
    assert (found["forward"] + found["backward"]) / 2 == pytest.approx(found["midway"], abs=1e-6)


def test_a_line_has_both_ways_of_every_strut(tmp_path: Path) -> None:
    """Commands differ by +b where the nominal length rises along the line, by −b where it falls."""
    geometry = load_geometry("example_6_6")
    x, y, z = geometry.tool_pose(geometry.home).position * 1e3
    lost, out = [1.0, 2.0, 3.0, 4.0, 5.0, 8.0], tmp_path / "line.csv"
    model = only_backlash(tmp_path, lost, geometry.name)
    line = f"{x - 20},{y - 5},{z + 1},{x + 21},{y + 3},{z + 2},1,2,3"
    given = ("ik", "--machine", "example_6_6", "--model", model, "--line", line, "--step-mm", "4", "--out", str(out))
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
    steady = np.sign(rates[1:]) == np.sign(rates[:-1])  # no turning point between this row's neighbours
    assert steady.mean() > 0.8
    assert (rates > 0.0).any()
    assert (rates < 0.0).any()
    both = (corrections[:half] - corrections[half:])[1:-1]
    np.testing.assert_allclose(both[steady], (np.sign(rates[1:]) * lost)[steady], atol=1e-5)
    assert len(read_lengths(str(out))[1]) == 2 * half  # fk accepts the file


def test_ik_predicts_the_error_without_compensation_in_the_work_frame() -> None:
    """The predicted error is where ``fk`` finds the machine with nominal lengths; without covariance no deviations."""
    pose = "10,20,420,2,-3,4"
    lengths = json.loads(hexapod("ik", "--pose", pose, "--json")[1])["rows"][0]
    told = ",".join(repr(lengths[f"L{n}_mm"]) for n in range(1, 7))
    went = json.loads(hexapod("fk", "--lengths", told, "--model", "paper_machine", "--guess", pose, "--json")[1])[
        "rows"
    ][0]
    content = json.loads(hexapod("ik", "--pose", pose, "--model", "paper_machine", "--json")[1])
    assert content["error_frame"] == "work"
    assert content["error_sd_not_known"] == "model 'virtual machine' names no posterior file of a fit"
    row = content["rows"][0]
    for axis, commanded in zip("xyz", (10.0, 20.0, 420.0), strict=True):
        assert row[f"error_{axis}_um"] == pytest.approx((went[f"{axis}_mm"] - commanded) * 1e3, abs=1e-6)
    assert all(row[name] is None for name in row if "_sd_" in name)
    assert abs(row["error_aligned_x_um"]) < abs(row["error_x_um"])  # the datum alone is 80 µm
    text = hexapod("ik", "--pose", pose, "--model", "paper_machine")[1]
    assert text.count("not known") == 1 + 12  # reason, two times six components
    assert "error_z_um" not in hexapod("ik", "--pose", pose, "--json")[1]
    far = "ik", "--pose", "0,0,30000", "--model", "paper_machine"  # at 30 m the struts are parallel within a degree
    assert json.loads(hexapod(*far, "--json")[1])["rows"][0]["error_x_um"] is None
    assert "1 of 1 poses: a machine with the model's errors has no pose with the nominal lengths" in hexapod(*far)[2]


def test_lists_of_broken_limits_are_capped(tmp_path: Path) -> None:
    """``check`` prints 20 broken limits and 100 rows, and how many more there are."""
    path = file_of(tmp_path, [(n, 0, 0, 950, 0, 0, 0) for n in range(103)])
    code, out, _ = hexapod("check", path, "--stream", "--rate-hz", "1")
    broken = int(re.search(r"broken limits \((\d+)\)", out).group(1))
    assert code == 1
    assert out.count(" is outside the stroke") == 20
    assert f"… and {broken - 20} more; --json prints all" in out
    assert re.search(r"\n *99 +101 [^\n]*\n… and 3 more rows; --out FILE writes all\n", out)
    assert len(json.loads(hexapod("check", path, "--stream", "--rate-hz", "1", "--json")[1])["broken"]) == broken
    out = hexapod("check", path, "--stream", "--rate-hz", "1", "--model", "paper_machine")[1]
    assert re.search(r"\nnote: .*: 103 of 103, first .*\n  measured box: tool positions in work \(-203\.2, ", out)


def test_check_names_row_and_limit_in_json(tmp_path: Path) -> None:
    """Struts are 509.192 mm long at a height of 400 mm (Table 2), so their length at any height is known."""
    path = file_of(tmp_path, [("", 0, 0, 400, 0, 0, 0), ("up", 0, 0, 403, 0, 0, 0)])
    code, out, err = hexapod("check", path, "--stream", "--rate-hz", 50, "--json")
    assert (code, err) == (1, "")
    content, step = json.loads(out), np.hypot(np.sqrt(509.192**2 - 400.0**2), 403.0) - 509.192
    text = f"strut_1: the nominal length would change by {step:.4f} mm in one command, allowed 2 mm"
    first = {"row": 2, "label": "up", "line": 3, "share_of_move": 1.0, "limit": "step", "problem": text}
    first |= {"value": pytest.approx(step, rel=1e-3), "allowed": 2.0, "unit": "mm", "strut": 1, "stage": "nominal"}
    assert content["broken"][0] == first
    assert {entry["limit"] for entry in content["broken"]} == {"step"}
    smallest = next(entry for entry in content["smallest_margins"] if entry["limit"] == "speed")
    assert (smallest["value"], smallest["unit"]) == (pytest.approx(50.0 * step, rel=1e-3), "mm_s")
    assert smallest["margin"] == pytest.approx(smallest["allowed"] - smallest["value"])
    assert (content["within_limits"], content["poses_examined"], content["rate_hz"]) == (False, 2, 50.0)


def test_check_finds_what_happens_on_the_way() -> None:
    """Both ends of a move are within the stroke of strut 1, its middle, nearest to a base joint, is not."""
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
    start, end = (pose.position for pose in ends)  # a line of three positions that ends at the start of this move
    runs = [("a", True, [start - [0.0, 2e-3, 0.0], start - [0.0, 1e-3, 0.0], start]), ("b", False, [end, end])]
    campaign = SimpleNamespace(
        runs=[
            SimpleNamespace(
                name=name, is_line=line, positions=np.array(p), rotations=np.tile(np.eye(3), (len(p), 1, 1))
            )
            for name, line, p in runs
        ]
    )
    noted = f"no straight move from a to b: move via home ({result.breaches[0].error})"
    assert list(fitting._detours(geometry, campaign)) == [noted]
    step, speed = (result.limits[name].value for name in ("step", "speed"))
    np.testing.assert_allclose(speed, 250.0 * step)
    assert np.isnan(speed).tolist() == [[True, True], [False, False]], "also the way is a sequence of commands"


def test_check_follows_a_stream_like_the_compensator(monkeypatch: pytest.MonkeyPatch) -> None:
    """Over a stream of three pieces ``check`` computes the directions, backlash and steps of the compensator."""
    done: list[int] = []
    monkeypatch.setattr("hexapod_comp.compensation.checks.CHUNK", 256)
    model = random_model(np.random.default_rng(22), "paper")
    geometry = replace(PAPER, limits=replace(PAPER.limits, correction=0.02))
    angle = np.linspace(0.0, 4.0 * np.pi, 700)
    positions = PAPER.home.position + 0.02 * np.stack([np.cos(angle), np.sin(2 * angle), 0.2 * np.sin(angle)], axis=1)
    rotations = Rotation.from_rotvec(0.05 * np.stack([np.sin(angle)] * 3, axis=1)).as_matrix()
    result = check(geometry, model, (positions, rotations), mode="stream", progress=done.append)
    assert (result.examined, sum(done)) == (700, 700)
    for rate, shares in (
        (250.0, [1] * 20),
        (40.0, [1, 6, 6, 6, 1]),
    ):  # as many moves at once as fit into a piece at 1 s
        done.clear()
        check(geometry, model, (positions[:20], rotations[:20]), mode="moves", rate=rate, progress=done.append)
        assert done == shares
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


def test_check_says_where_a_field_cannot_be_undone(monkeypatch: pytest.MonkeyPatch) -> None:
    """``check`` names a field of 1.5 m per m, which iteration cannot invert, and poses outside a field that refuses."""
    grid = tuple(np.array(axis) for axis in ([-0.2, 0.2], [-0.2, 0.2], [0.3, 0.5]))
    lines = [np.zeros((2, 2, 2, 6, 2)) for _ in range(3)]
    lines[0][:, :, :, 0, 1] = 0.3  # u runs from −1 to 1 over 0.4 m
    flat = [np.zeros((2, 2, 2, 6, 0)) for _ in range(3)]
    steep, small = GridField(grid, tuple(lines)), GridField(grid, tuple(flat), outside="refuse")  # type: ignore[arg-type]
    poses = [Pose([x, 0.0, 0.4], np.eye(3)) for x in (0.03, 0.05, 0.21)]
    for field, limit, rows in ((steep, "not_converged", {0, 1}), (small, "outside_field", {2})):
        result = check(PAPER, MachineModel("paper", field=field), poses, mode="poses")
        assert {b.row for b in result.breaches if b.limit == limit} >= rows, limit
    with pytest.raises(NotConvergedError, match="the iteration that inverts the error field does not converge at this"):
        Compensator(PAPER, MachineModel("paper", field=steep)).correct(poses[0])
    monkeypatch.setattr("hexapod_comp.virtual.named.find_model", lambda *_: MachineModel("paper", field=steep))
    told = hexapod("ik", "--pose", "30,0,400", "--model", "steep")[2]
    assert told.startswith("hexapod_comp: error: the pose: the iteration that inverts the error field")
    joints = Pose(PAPER.base_joints[0] - PAPER.platform_joints[0], np.eye(3))
    told = [str(breach.error) for breach in check(PAPER, IDEAL, [joints], mode="poses").breaches]
    assert "strut_1: base_cone cannot be computed, the pose is degenerate" in told


def test_check_refuses_what_makes_no_sense() -> None:
    for mode, rate, senses, text in (
        ("moves", 0.99, None, r"--rate-hz: must lie in 1…10000 Hz \(found 0\.99\)"),
        ("moves", 10000.1, None, "must lie in"),
        ("moves", np.nan, None, "must lie in"),
        ("jumps", 250.0, None, "mode: must be one of poses, moves, stream"),
        ("moves", 1.0, np.zeros((1, 9)), "senses: may be given only in the mode 'poses'"),
    ):
        with pytest.raises(GeometryError, match=text):
            check(PAPER, IDEAL, table_poses()[:1], mode=mode, rate=rate, senses=senses)
    assert check(PAPER, IDEAL, table_poses()[:1], rate=10_000.0).ok


def test_assess_draws_machines_with_consecutive_seeds() -> None:
    told = json.loads(hexapod("assess", "--machines", 5, "--seed", 5, "--json")[1])
    assert told["seeds"] == list(range(5, 10))
    assert told["round_trip_m"] <= 1e-13
    largest = max(row["displacement_um"][2] for row in told["statistics"])
    found = [np.linalg.norm([record[f"error_{axis}_um"] for axis in "xyz"]) for record in told["records"]]
    assert (len(found), max(found)) == (50, pytest.approx(largest, rel=1e-9))
    assert max(record["round_trip_um"] for record in told["records"]) == pytest.approx(told["round_trip_m"] * 1e6)
    assert max(record["round_trip_urad"] for record in told["records"]) == pytest.approx(told["round_trip_rad"] * 1e6)
    first = [record for record in told["records"] if record["sequence"] == told["statistics"][0]["sequence"]]
    changes = np.array([[record[f"change_L{n}_um"] for n in range(1, 7)] for record in first])
    lengths = np.array([[record[f"{k}_L{n}_mm"] for n in range(1, 7)] for record in first for k in ("real", "ideal")])
    np.testing.assert_allclose(changes, 1e3 * (lengths[::2] - lengths[1::2]), atol=1e-6)
    worst = [
        [np.linalg.norm([record[f"error_r{axis}_urad"] for axis in "xyz"]) for record in first],
        abs(changes).max(axis=1),
    ]
    quantiles = [np.percentile(one, told["percentiles"]) for one in worst]
    assert told["statistics"][0]["rotation_deg"] == pytest.approx(np.degrees(1e-6 * quantiles[0]), rel=1e-6)
    assert told["statistics"][0]["strut_change_um"] == pytest.approx(quantiles[1], rel=1e-9)
    assert (told["percentiles"], told["bounds"]) == ([50.0, 95.0, 100.0], {"joint_um": 10.0, "strut_um": 10.0})


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGHUP])
def test_signals_end_a_session_in_order(number: signal.Signals) -> None:
    """A signal ends what the session has started; the exit code is 128 + the signal's number, as in shells."""
    ended = []

    def session() -> None:
        with results.exit_on_signals(), contextlib.ExitStack() as started:
            started.callback(lambda: ended.append(signal.getsignal(number)))
            os.kill(os.getpid(), number)

    before = signal.signal(number, signal.SIG_DFL)
    with pytest.raises(SystemExit) as left:
        session()
    assert left.value.code == 128 + number
    assert ended == [signal.SIG_DFL]  # a second signal ends the process at once
    signal.signal(number, signal.SIG_IGN)
    with results.exit_on_signals():
        assert signal.getsignal(number) == signal.SIG_IGN  # as nohup sets it
    signal.signal(number, before)


def test_tool_and_work_frame_of_ik_fk_check_and_travel(tmp_path: Path) -> None:
    """The truth is the zoo's frames and kinematics, for its probe in its fixture with the platform at home."""
    machine = with_frames("inches")
    used, home = machine.using("probe", "fixture"), np.array([machine.home])
    pose = Pose(used.tips(home, np.eye(3)[None])[0], used.work.matrix.T @ used.tool.matrix)
    text = ",".join(repr(float(v)) for v in (*pose.position * 1e3, *np.degrees(angles_from_rotation(pose.rotation))))
    names = ("--machine", machine.write(tmp_path / "machine.yaml"), "--tool", "probe", "--work", "fixture")
    said = json.loads(hexapod("ik", f"--pose={text}", *names, "--json")[1])
    assert (said["tool"], said["frame"]) == ("probe", "fixture")
    shown = hexapod("ik", f"--pose={text}", *names, "--model", "random")[1]
    assert "along and about the axes of fixture;" in shown
    assert ("\nin fixture " in shown, "in work" in shown) == (True, False)
    lengths = [said["rows"][0][f"L{n}_mm"] for n in range(1, 7)]
    np.testing.assert_allclose(lengths, machine.lengths(home, np.eye(3)[None])[0] * 1e3, rtol=0.0, atol=1e-9)
    row = json.loads(hexapod("fk", "--lengths", ",".join(map(repr, lengths)), *names, "--json")[1])["rows"][0]
    np.testing.assert_allclose([row[f"{axis}_mm"] for axis in "xyz"], pose.position * 1e3, rtol=0.0, atol=1e-7)
    (tmp_path / "poses.csv").write_text(f"{POSE_HEADER.removeprefix('name,')}\n{text}\n")
    assert "1 pose of the probe in fixture" in hexapod("check", tmp_path / "poses.csv", *names)[1]
    geometry = load_geometry(names[1]).using("probe", "fixture")
    ways = travel(RealMachine(geometry, MachineModel(geometry.name)), pose)
    told = json.loads(hexapod("travel", f"--pose={text}", *names, "--json")[1])["travel"]
    assert [(row["way"], row["unit"], row["limit"]) for row in told] == [
        (way.way, way.unit, way.error and way.error.reason) for way in ways
    ]
    assert [row["travel"] for row in told] == pytest.approx([way.shown for way in ways], abs=1e-6)
    lines = hexapod("travel", *names)[1].splitlines()  # starts at home
    assert lines[0].startswith(f"machine {machine.name}: travel of the probe in fixture from x, y, z ")
    assert [line.split()[:3] for line in lines[2:]] == [[w.way, f"{w.shown:.3f}", w.unit] for w in ways]


# A table over elevation: the tool sags by 10 µm at 0° and by 40 µm at 90°

SAG = """elevation_deg,x_um,y_um,z_um,rx_urad,ry_urad,rz_urad
0,0,0,-10,0,0,0
90,0,0,-40,0,0,0
"""


def raised_um(model: Path, *options: str) -> float:
    """Return by how much, µm, a model's command at home is higher than the nominal command."""
    row = json.loads(hexapod("ik", "--pose", "0,0,400", "--model", model, "--json", *options)[1])["rows"][0]
    lengths = np.array([row[f"L{n}_mm"] for n in range(1, 7)]) * 1e-3
    return float(RealMachine(PAPER, IDEAL).pose_for(lengths)[0].position[2] - PAPER.home.position[2]) * 1e6


def test_a_table_moves_the_tool_where_it_is_looked_up(tmp_path: Path) -> None:
    """The tool is raised by the table's error, or by minus its correction; after --calibrated-at by the difference."""
    (tmp_path / "sag.csv").write_text(SAG)
    bent = tmp_path / "bent.yaml"
    table = ("outside", tmp_path / "sag.csv", "--out", bent)
    for options, at, raised in (
        (("--holds", "errors"), "30", 20.0),
        (("--holds", "errors", "--calibrated-at", "elevation_deg=60"), "60", 0.0),
        (("--holds", "errors", "--calibrated-at", "elevation_deg=60"), "0", -20.0),
        (("--holds", "corrections", "--beyond", "refuse"), "90", -40.0),
    ):
        code, out, _ = hexapod(*table, *options)
        assert code == 0
        assert raised_um(bent, "--outside", f"elevation_deg={at}") == pytest.approx(raised, abs=1e-6)
    assert "largest error 40.00 µm and 0.00 µrad; outside the table: refuse" in out
    assert raised_um(bent) == pytest.approx(0.0, abs=1e-6)
    assert "table over elevation is not used" in hexapod("ik", "--pose", "0,0,400", "--model", bent)[2]
    for model, given, problem in (
        ("ideal", "elevation_deg=3", "the model has no table"),
        (bent, "elevation_deg=91", "elevation 91 deg: the table covers elevation 0 to 90 deg"),
        (bent, "elevation_mm=3", "outside.elevation_mm: the model's table needs elevation_deg"),
    ):
        code, _, err = hexapod("ik", "--pose", "0,0,400", "--model", model, "--outside", given)
        assert code == 2
        assert problem in err
    again = hexapod(*table[:3], tmp_path / "b.yaml", "--holds", "errors", "--model", bent)
    assert again[2] == f"hexapod_comp: note: the new table replaces the table over elevation in {bent}\n"
    export = ("export", "--c", tmp_path / "c", "--model", bent)
    assert "outside.names: cannot be exported: the C core has no such term" in hexapod(*export)[2]
    code, out, _ = hexapod(*export, "--outside", "elevation_deg=45")
    assert code == 0
    assert out.endswith("\nbuild the self-test and run it on the target: see hexapod_selftest.c\n")
    assert ".powers = {1, 0, 0}" in (tmp_path / "c" / "hexapod_model.h").read_text()


def test_a_table_leaves_what_a_fit_knows_of_a_model(tmp_path: Path) -> None:
    """The hash of a model's text is the same with a table and without, so its posterior stays valid."""
    (tmp_path / "sag.csv").write_text(SAG)
    out = ("--model", "paper_machine", "--out", tmp_path / "both.yaml")
    assert hexapod("outside", tmp_path / "sag.csv", "--holds", "errors", *out)[0] == 0
    text = (tmp_path / "both.yaml").read_text()
    (tmp_path / "plain.yaml").write_text(text[: text.index("\noutside:\n") + 1] + "end: true\n")
    plain, both = (load_model(tmp_path / name, PAPER) for name in ("plain.yaml", "both.yaml"))
    assert (both.outside.names, plain.outside.names) == (("elevation",), ())
    assert both.origin.text_sha256 == plain.origin.text_sha256 != ""
