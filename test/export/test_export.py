"""Exports against numbers of LinuxCNC itself and closed forms; reading them back; files that are refused."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from helpers import assert_equal
from scipy.spatial.transform import Rotation
from strategies import PAPER_FILE, paper_geometry, random_model, skewed_geometry

from hexapod_comp.cli import export
from hexapod_comp.cli.app import make_parser
from hexapod_comp.errors import GeometryError, HexapodError, InputFileError, LimitError, ModelError, OutsideFieldError
from hexapod_comp.export.c_code import model_header
from hexapod_comp.export.linuxcnc import (
    COMP_FILES,
    HAL_FILE,
    INI_FILE,
    Genhexkins,
    _points,
    make_genhexkins,
    read_genhexkins,
    table_misfit,
    write_genhexkins,
)
from hexapod_comp.export.table import (
    COLUMNS,
    GridTable,
    _without_fine_waves,
    commands_by_poses,
    commands_by_struts,
    make_table,
    read_table,
    write_table,
)
from hexapod_comp.export.terms import refuse_unknown
from hexapod_comp.export.trial import Comparison, ExportCheck, ExportTrial, diagonal_passes
from hexapod_comp.machine.arrays import Size
from hexapod_comp.machine.field import GridField, no_field
from hexapod_comp.machine.geometry import HexapodGeometry
from hexapod_comp.machine.load import Load
from hexapod_comp.machine.model import MachineModel, MotionState, RealMachine
from hexapod_comp.machine.model_file import load_model, save_model
from hexapod_comp.machine.outside import OutsideTable
from hexapod_comp.machine.passes import Passes
from hexapod_comp.machine.struts import StrutErrors
from hexapod_comp.pose import Pose

MACHINE_FILE = PAPER_FILE.with_name("paper_machine.yaml")
PAPER_BOX = np.array([[-0.2032, -0.2032, 0.350], [0.2032, 0.2032, 0.5532]])
SMALL_BOX = np.array([[-0.04, -0.06, 0.38], [0.06, 0.03, 0.46]])

# Recorded in LinuxCNC 2.9.0~pre1 (Debian 12), genhexkins and motmod, with the files of ``cardanic_machine`` and the
# tables of ``hand_made_table``: XYZ (mm) and ABC (degrees) reached in G-code, joint.N.pos-cmd (mm), and motor-
# pos-cmd − motor-offset − pos-cmd (mm), approached along +X+Y+Z and along −X−Y−Z
LINUXCNC = (
    (
        (-10.6, 19.0, 407.3, 4.6, 5.9, -1.7),
        (537.934488419, 480.957401283, 518.589834097, 522.207111764, 534.034280197, 502.626817841),
        (0.01206551, 0.01992898, 0.02577668, 0.01849114, -0.00004507, 0.03951313),
        (0.02322415, -0.01744676, -0.00972082, -0.00499009, 0.01004514, -0.03046647),
    ),
    (
        (-23.4, -44.5, 442.0, -1.2, -3.9, 1.5),
        (577.550392426, 533.282392607, 555.514623917, 490.145566998, 557.688759474, 560.246170118),
        (-0.01000000, 0.01250364, -0.01766425, 0.03753735, -0.03116939, -0.03971348),
        (0.06000000, 0.01356625, 0.04458034, -0.02753744, 0.04116945, 0.04155772),
    ),
)


def cardanic_machine(lead: float = 0.008) -> HexapodGeometry:
    """Return a general 6-6 machine whose cardan axes on base and platform are parallel at home."""
    geometry = skewed_geometry(lead)
    assert geometry.base_axes is not None
    return replace(geometry, platform_axes=geometry.base_axes @ geometry.home.rotation)


def hand_made_table(i: int) -> list[str]:
    """Return the table of strut `i`, mm, that LinuxCNC had for the recording."""
    n = i + 1
    return [
        f"{400 + 2 * i} 0.0{n} -0.02",
        f"{450 + i} -0.03 0.0{n}",
        f"{500 - i} 0.05 -0.04",
        f"{560 + 3 * i} -0.0{n} 0.06",
    ]


def paper_machine() -> MachineModel:
    return load_model(MACHINE_FILE, paper_geometry())


def written(
    folder: Path, geometry: HexapodGeometry, model: MachineModel, box: np.ndarray, unit: str = "mm"
) -> tuple[Genhexkins, Genhexkins]:
    """Write an export; return it, and what is read back."""
    machine = RealMachine(geometry, model)
    told = make_genhexkins(machine, box)
    write_genhexkins(told, folder, unit, ["a test"], table_misfit(machine, told, box))
    return told, read_genhexkins(folder, unit)


# LinuxCNC


def test_reader_agrees_with_linuxcnc(tmp_path: Path) -> None:
    """The reader computes LinuxCNC's recorded joints, to their 1e-9 mm, and corrections, to 1e-7 mm.

    A joint at rest keeps the correction of the last cycle in which it moved, here 1e-5 mm away on a slope of 1e-3, and
    LinuxCNC's corrections are single-precision.
    """
    written(tmp_path, cardanic_machine(), MachineModel("skewed"), SMALL_BOX)
    for i, name in enumerate(COMP_FILES):
        table = "\n".join(hand_made_table(i))
        text = (tmp_path / name).read_text()
        (tmp_path / name).write_text(table + "\n" + text[text.index("# a test") :])
    told = read_genhexkins(tmp_path, "mm")
    for pose, joints, *corrections in LINUXCNC:
        rotation = Rotation.from_euler("xyz", pose[3:], degrees=True).as_matrix()  # roll, pitch, yaw: Rz·Ry·Rx
        position = np.array(pose[:3]) * 1e-3
        found = told.joints(position[None], rotation[None])[0]
        np.testing.assert_allclose(found * 1e3, joints, atol=1e-9, rtol=0.0)
        for sign, noted in zip((1.0, -1.0), corrections, strict=True):
            passes = Passes.of_tool(cardanic_machine(), position[None], rotation[None], np.full((1, 3), sign))
            np.testing.assert_allclose((told.commands(passes)[0] - found) * 1e3, noted, atol=1e-7, rtol=0.0)


@pytest.mark.parametrize("turned", [1.0, -1.0])
def test_screw_rotation_goes_through_genhexkins(tmp_path: Path, turned: float) -> None:
    """With genhexkins' own screw rotation, axis vectors either way, only the length map's curvature is left.

    Its five knots need a curvature of ≤ 0.06 per m. A polyline of 0.5 mm steps leaves 2 nm of it, and the tool moves by
    a few times as much.
    """
    geometry = cardanic_machine()
    assert geometry.platform_axes is not None
    geometry = replace(geometry, platform_axes=turned * geometry.platform_axes)
    model = random_model(np.random.default_rng(4), "skewed")
    struts = replace(model.struts, cosine=np.zeros(6), sine=np.zeros(6))
    model = replace(model, field=no_field(), struts=struts)
    _, back = written(tmp_path, geometry, model, SMALL_BOX)
    check = ExportTrial(geometry, model, SMALL_BOX, 100).check(back.commands)
    assert check.level.before.rms > 0.5e-3
    assert check.level.after.largest < 20e-9
    assert check.tilted is not None
    assert check.tilted.after.largest < 0.5e-6  # a tilted tool needs longer struts, with fewer points of the table


def test_table_of_offset_pitch_and_backlash_is_exact(tmp_path: Path) -> None:
    """The table equals L = c + o + p(c − c₀) ∓ b/2 solved for c by hand; it is a straight line, without a misfit."""
    o, p, c0, b = 120e-6, 80e-6, 0.5, 6e-6
    struts = StrutErrors(
        offset=np.full(6, o), pitch=np.full(6, p), reference_length=np.full(6, c0), backlash=np.full(6, b)
    )
    _, back = written(tmp_path, paper_geometry(), MachineModel("paper", struts=struts), PAPER_BOX)
    lengths = np.random.default_rng(1).uniform(0.33, 0.88, 500)
    for up, half in ((True, 0.5 * b), (False, -0.5 * b)):
        wanted = (lengths - o + p * c0 + half) / (1.0 + p) - lengths
        for table in back.tables:
            np.testing.assert_allclose(table.correction(lengths, np.full(500, up)), wanted, atol=2e-11, rtol=0.0)


def test_waves_are_followed_as_well_as_256_points_can() -> None:
    """A straight line through points h apart leaves at most h²/8·A·k² of a wave A with wavenumber k."""
    geometry, model = paper_geometry(), paper_machine()
    machine = RealMachine(geometry, model)
    told = make_genhexkins(machine, PAPER_BOX)
    nodes = np.array(np.meshgrid(*np.linspace(*PAPER_BOX, 17).T)).reshape(3, -1).T
    reach = np.linalg.norm(nodes[:, None] + geometry.platform_joints - geometry.base_joints, axis=2)
    for i, (rms, largest) in enumerate(table_misfit(machine, told, PAPER_BOX)):
        nominal = told.tables[i].nominal
        assert len(nominal) == 256
        assert (nominal[0], nominal[-1]) == pytest.approx((0.33, 0.88), abs=1e-12)
        dense = nominal[1:-1][np.abs(np.diff(nominal, 2)) > 1e-9]  # between these points; joints are 0.1 mm off
        assert dense == pytest.approx([reach[:, i].min() - 3e-3, reach[:, i].max() + 3e-3], abs=2e-4)
        bound = np.median(np.diff(nominal)) ** 2 / 8.0 * 4e-6 * (2.0 * math.pi / 0.01) ** 2
        assert largest < bound
        assert rms < 0.5 * bound


def test_points_are_dense_between_the_needed_lengths() -> None:
    """At most 12 of 256 points are outside at each end, and at least as dense as points at equal distances."""
    for (low, high), below, above in (((0.4, 0.6), 12, 12), ((0.331, 0.8785), 1, 1), ((0.3, 0.9), 0, 0)):
        points = _points(np.array([0.33, 0.88]), low, high)
        assert len(points) == 256
        assert (points[0], points[-1]) == (0.33, 0.88)
        inner = points[below : 256 - above]
        np.testing.assert_allclose(inner, np.linspace(max(low, 0.33), min(high, 0.88), 256 - below - above), rtol=1e-12)
        np.testing.assert_allclose(np.diff(points, 2)[: max(below - 1, 0)], 0.0, atol=1e-12)


def test_files_are_what_linuxcnc_reads(tmp_path: Path) -> None:
    """Pin names are those in genhexkins.so; comments follow the points, since a comment ends a table in LinuxCNC."""
    model = replace(paper_machine(), name="evil\nsetp motion.feed-hold 1")
    machine = RealMachine(paper_geometry(), model)
    told = make_genhexkins(machine, PAPER_BOX)
    misfit = table_misfit(machine, told, PAPER_BOX)
    write_genhexkins(told, tmp_path, "mm", [model.name], misfit)
    pins = [line.split()[1] for line in (tmp_path / HAL_FILE).read_text().splitlines() if line.startswith("setp")]
    joints = {f"genhexkins.{body}.{n}.{x}" for body in ("base", "platform") for n in range(6) for x in "xyz"}
    assert sorted(pins) == sorted([*joints, "genhexkins.screw-lead"])
    for name, (rms, largest) in zip(COMP_FILES, 1e6 * misfit, strict=True):
        rows = (tmp_path / name).read_text().splitlines()
        assert f"differs from the model by {rms:.3f} um RMS, {largest:.3f} um at most;" in rows[-3]
        points = [list(map(float, row.split())) for row in rows if not row.startswith("#")]
        assert len(points) <= 256
        assert rows[len(points)].startswith("#")
        assert all(len(point) == 3 for point in points)
        assert max(map(len, rows)) < 255
    ini = (tmp_path / INI_FILE).read_text()
    assert re.findall(r"^COMP_FILE = (.*)$", ini, re.MULTILINE) == list(COMP_FILES)


def test_what_genhexkins_cannot_have_is_refused() -> None:
    machine = RealMachine(skewed_geometry(0.008), MachineModel("skewed"))
    with pytest.raises(GeometryError, match=r"strut_.*differ from 90° by 5° or more"):  # cardan axes of struts 4–6
        make_genhexkins(machine, SMALL_BOX)
    uneven = replace(cardanic_machine(), screw_lead=np.array([8e-3] * 5 + [-8e-3]))
    with pytest.raises(GeometryError, match="same for all struts"):
        make_genhexkins(RealMachine(uneven, MachineModel("skewed")), SMALL_BOX)


@pytest.mark.parametrize(("angle", "refused"), [(83.0, False), (87.0, True), (93.0, True), (97.0, False)])
def test_cardan_axes_keep_five_degrees_from_a_right_angle(angle: float, refused: bool) -> None:
    """With a level platform each strut's axis on it is the axis on the base, turned about the strut by the angle."""
    geometry = cardanic_machine()
    struts = geometry.home.position + geometry.platform_joints - geometry.base_joints
    turn = Rotation.from_rotvec(np.radians(angle) * struts / np.linalg.norm(struts, axis=1)[:, None])
    turned = replace(geometry, platform_axes=turn.apply(geometry.base_axes.copy()))
    near = geometry.home.position + np.array([[-1e-3] * 3, [1e-3] * 3])
    with pytest.raises(GeometryError, match="differ from 90°") if refused else nullcontext():
        make_genhexkins(RealMachine(turned, MachineModel("skewed")), near)


# The table


def trilinear_table() -> tuple[GridTable, Callable[[np.ndarray], np.ndarray]]:
    """Return a table whose values are a trilinear function of the position, and this function."""
    nodes = (np.array([-0.1, 0.0, 0.1]), np.array([-0.2, 0.1]), np.array([0.3, 0.35, 0.5]))

    def function(p: np.ndarray) -> np.ndarray:
        return 1e-4 * (1.0 + p[..., 0] - 2.0 * p[..., 1] + 3.0 * p[..., 2] + 7.0 * p.prod(axis=-1))

    places = np.stack(np.meshgrid(*nodes, indexing="ij"), axis=-1)
    values = function(places)[None, ..., None] * np.array([1.0, -2.0])[:, None, None, None, None] * np.arange(1.0, 7.0)
    return GridTable(nodes, values, np.abs(values), 10.0 * values), function


def test_table_file_brings_trilinear_functions_back(tmp_path: Path) -> None:
    """Trilinear interpolation returns a trilinear function; the file keeps 1e-12 m and rad."""
    table, function = trilinear_table()
    write_table(table, tmp_path / "t.csv", ["a test"])
    back = read_table(tmp_path / "t.csv")
    positions = np.random.default_rng(2).uniform([-0.1, -0.2, 0.3], [0.1, 0.1, 0.5], (200, 3))
    backward = np.arange(200) % 2 == 1
    wanted = np.where(backward, -2.0, 1.0)[:, None] * function(positions)[:, None] * np.arange(1.0, 7.0)
    np.testing.assert_allclose(back.pose_corrections(positions, backward), 10.0 * wanted, atol=2e-12, rtol=0.0)
    senses = np.tile([1.0, -1.0, 0.0, 1.0, -1.0, 0.0], (200, 1))
    corrections = back.strut_corrections(positions, backward, senses)
    np.testing.assert_allclose(corrections, wanted + 0.5 * senses * np.abs(wanted), atol=2e-12, rtol=0.0)
    with pytest.raises(ModelError, match="covers only positions within"):
        back.pose_corrections(np.array([[0.0, 0.0, 0.51]]), np.array([False]))
    rows = (tmp_path / "t.csv").read_text().splitlines()
    first = rows.index(",".join(COLUMNS))
    comments, rows = rows[:first], rows[first:]
    for changed, message in (
        (rows[:-1], "has 35 rows, its grid needs 36"),
        ([rows[0], *(row for row in rows if row.startswith("0.0"))], "at least two positions along x"),
        ([*rows, rows[4]], "position and direction are given twice"),
        ([rows[0], rows[1].replace("forward", "left"), *rows[2:]], "column direction: must be one of"),
        ([f"{rows[0]},colour", *(f"{row},1" for row in rows[1:])], "not a known column"),
    ):
        (tmp_path / "t.csv").write_text("\n".join([*comments, *changed]) + "\n")
        with pytest.raises(InputFileError, match=message):
            read_table(tmp_path / "t.csv")


def test_nodes_hold_the_models_own_corrections() -> None:
    """At a node, corrections are the model's for extending struts, minus half the backlash column."""
    geometry, model = paper_geometry(), paper_machine()
    table, left_out = make_table(geometry, model, PAPER_BOX, 0.12)
    assert "10 mm period and up to 4.00 µm" in left_out[0]
    smooth = replace(model.struts, cosine=np.zeros(6), sine=np.zeros(6))
    machine = RealMachine(geometry, replace(model, struts=smooth))
    for way, sign in enumerate((1.0, -1.0)):
        for index in ((0, 0, 0), (1, 2, 1), (4, 4, 2)):
            target = Pose([nodes[n] for nodes, n in zip(table.nodes, index, strict=True)], np.eye(3))
            motion = MotionState()
            motion.sense[:] = [sign] * 3 + [1.0] * 6
            commands, _, _ = machine.commands_for(target, motion)
            ends = target.position + geometry.platform_joints
            nominal = np.linalg.norm(ends - geometry.base_joints, axis=1)
            at_node = (way, *index)
            found = table.struts[at_node] + 0.5 * table.backlash[at_node]
            np.testing.assert_allclose(found, commands - nominal, atol=1e-13, rtol=0.0)
            change = table.poses[at_node]  # the nominal machine has the same lengths at the corrected pose
            turned = Rotation.from_rotvec(change[3:]).apply(np.array(geometry.platform_joints))
            told = np.linalg.norm(target.position + change[:3] + turned - geometry.base_joints, axis=1)
            np.testing.assert_allclose(told - nominal, table.struts[at_node], atol=1e-13, rtol=0.0)


def test_a_table_is_for_the_attitude_at_home_if_the_tool_cannot_be_parallel_to_work() -> None:
    """The paper's machine cannot turn its tool by 90°. Described in a work frame turned by 90°, it is the same machine:
    its corrections are those of the other table at the same places, to rounding."""
    plain, model = paper_geometry(), MachineModel("paper", base_deviation=1e-4 * np.cos(np.arange(18.0)).reshape(6, 3))
    quarter = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    turned = replace(plain, work=Pose(plain.work.position, plain.work.rotation @ quarter))
    one, other = (make_table(geometry, model, PAPER_BOX, 0.12)[0] for geometry in (plain, turned))
    # x in the turned frame is y in the other one; y is −x
    np.testing.assert_allclose(other.struts, one.struts[:, ::-1].swapaxes(1, 2), rtol=0.0, atol=1e-13)


def test_table_leaves_what_its_step_leaves(tmp_path: Path) -> None:
    """Without waves, the table leaves an interpolation error that is quadratic in its step."""
    step, left = 0.0508, 0.25e-6
    geometry, model = paper_geometry(), paper_machine()
    assert _without_fine_waves(model, 2.5e-3) == (model, [])
    note = (
        "screw waves of 10 mm period and up to 4.00 µm are left out: a period must be at least 4 steps of the grid, and"
    )
    assert _without_fine_waves(model, 2.51e-3)[1] == [f"{note} a step is 2.51 mm"]
    # Sides of 40, 40 and 20 mm have two, two cells and one cell of at most 30 mm: all have 20 mm
    assert make_table(geometry, model, BOX, 0.03)[1] == [f"{note} a step is 20 mm"]
    two = [np.tile(amplitude[:, :1], (1, 2)) for amplitude in (model.struts.cosine, model.struts.sine)]
    both = replace(model.struts, cosine=two[0], sine=two[1])
    finer = _without_fine_waves(replace(model, struts=both), 2.51e-3)[1]
    assert finer[0].startswith("screw waves of 5, 10 mm period")  # two periods per turn of 10 mm
    model = replace(model, struts=replace(model.struts, cosine=np.zeros(6), sine=np.zeros(6)))
    table, left_out = make_table(geometry, model, PAPER_BOX, step)
    assert left_out == []
    write_table(table, tmp_path / "t.csv", [])
    back = read_table(tmp_path / "t.csv")
    trial = ExportTrial(geometry, model, PAPER_BOX, 200)
    by_struts = trial.check(partial(commands_by_struts, back))
    assert by_struts.level.after.rms < left
    by_poses = trial.check(partial(commands_by_poses, back))
    assert by_struts.level.after.rms < by_poses.level.after.rms < left + 5e-6  # the poses lack backlash, 3–5 µm


def test_growth_moves_the_tool_of_an_export() -> None:
    """A machine whose struts, base and platform grow by 10 ppm has its level platform 10 ppm farther from the origin.

    1 K moves the tool as 10 % of humidity do, if struts of 10 ppm/K swell by 100 ppm."""
    geometry, commands = paper_geometry(), Passes.nominal_commands
    struts = StrutErrors(expansion=np.full(6, 1e-5), moisture=np.full(6, 1e-4))
    body = {"base_expansion": 1e-5, "platform_expansion": 1e-5}
    whole = ExportTrial(geometry, MachineModel("paper", struts=struts, **body), SMALL_BOX, 20).check(commands)
    alone = ExportTrial(geometry, MachineModel("paper", struts=struts), SMALL_BOX, 20).check(commands)
    heights = diagonal_passes(geometry, SMALL_BOX, 20, 0).positions
    assert whole.per_kelvin.largest == pytest.approx(1e-5 * np.linalg.norm(heights, axis=1).max(), rel=1e-4)
    assert alone.per_kelvin.rms == pytest.approx(alone.per_humidity.rms, rel=1e-6)


def test_what_no_table_can_hold_is_refused() -> None:
    geometry, model = paper_geometry(), paper_machine()
    with pytest.raises(ModelError, match=r"gives 8\.65715e\+06 rows, allowed 200000"):  # 2 · 205 · 205 · 103
        make_table(geometry, model, PAPER_BOX, 0.002)
    with pytest.raises(LimitError, match=r"the tool in work at x, y, z -?[\d.]+.*stroke"):
        make_table(geometry, model, np.array([[-0.2, -0.2, 0.35], [0.2, 0.2, 0.9]]), 0.1)
    field = GridField(model.field.grid, model.field.lines, outside="refuse")
    wide = np.array([[-0.25, -0.2, 0.35], [0.2, 0.2, 0.55]])
    with pytest.raises(OutsideFieldError, match="outside the field's box"):
        make_table(geometry, replace(model, field=field), wide, 0.1)
    assert "outside the field's box" in make_table(geometry, model, wide, 0.1)[1][-1]
    table, left_out = make_table(geometry, replace(model, field=field), model.field.box, 0.2)  # corners included
    assert len(left_out) == 1
    assert np.isfinite(table.struts).all()


# The verb


def run_verb(*arguments: str) -> int:
    args = make_parser().parse_args(["export", "--machine", str(PAPER_FILE), *arguments])
    return int(export.export(args).finish(args))


def test_verb_writes_reads_back_and_reports(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder, file = tmp_path / "cnc", tmp_path / "t.csv"
    arguments = ("--model", str(MACHINE_FILE), "--linuxcnc", str(folder), "--table", str(file), "--step-mm", "51")
    assert run_verb(*arguments) == 0
    text = capsys.readouterr().out
    assert sorted(path.name for path in folder.iterdir()) == sorted([HAL_FILE, INI_FILE, *COMP_FILES])
    found = re.search(r"LinuxCNC, level tool: ([\d.]+) → ([\d.]+) µm RMS", text)
    assert found is not None
    assert 140.0 < float(found[1]) < 150.0  # paper_lines_model.yaml has 145.4 µm at other points
    assert float(found[2]) < 2.0
    for part in (
        "the error field, which moves the tool by",
        "screw waves of 10 mm",
        "(the model has none)",
        "tilted by 5°",
        "backlash, up to 4.842 µm",  # the largest in paper_machine.yaml
    ):
        assert part in text
    assert run_verb(*arguments, "--json", "--units", "inch", "--seed", "1", "--tilt-deg", "3") == 0
    checks = json.loads(capsys.readouterr().out)["checks"]
    assert [(check["export"], check["level"]["passes"]) for check in checks] == [
        ("LinuxCNC", 2000), ("table, struts", 2000), ("table, poses", 2000)
    ]  # fmt: skip
    assert checks[0]["level"]["after_rms_um"] < 2.0


def test_verb_names_terms_and_inputs_that_exact_files_do_not_have(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    """A URDF has nominal joints. The core in C has functions for humidity and loads, but its callers in LinuxCNC and in
    ros2_control do not call each of them."""
    struts, load = StrutErrors(moisture=np.full(6, 1e-4)), Load(stiffness=np.full(6, 20e6), mass=30.0)
    model = replace(paper_machine(), struts=struts, load=load)
    save_model(model, tmp_path / "m.yaml")
    core, control, file = (str(tmp_path / name) for name in ("core", "control", "m.urdf"))
    of = ("--c", core, "--ros2-control", control, "--urdf", file, "--json", "--model")
    assert run_verb(*of, str(tmp_path / "m.yaml")) == 0
    component, controller = ((Path(core) / "hexapod_rt.comp"), (Path(control) / "compensation.cpp"))
    for path, calls in ((component, (True, False)), (controller, (False, False))):
        assert tuple(name in path.read_text() for name in ("hc_set_load", "hc_set_humidity")) == calls
    tool = "the weight of another tool (that of 'tool' is assumed)"
    assert json.loads(capsys.readouterr().out)["not_carried"] == [
        f"{file}: the nominal machine, without the model's errors",
        f"{core}: hexapod_rt.comp does not receive humidity (50 % is assumed), {tool}",
        f"{control}: the controller within ros2_control does not receive humidity (50 % is assumed), "
        f"gravity and forces (the model's gravity is assumed), {tool}",
    ]
    assert run_verb(*of, "ideal") == 0
    assert json.loads(capsys.readouterr().out)["not_carried"] == []


def test_verb_tells_when_an_export_makes_it_worse(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The verb fails if an export makes a machine worse, as with wrongly read joints; without errors it passes."""
    box = ("--box=-100,-100,350,100,100,500", "--linuxcnc", str(tmp_path / "cnc"))
    assert run_verb(*box) == 0
    for option, *more in (["--linuxcnc", "--box=-9,-9,390,9,9,410"], ["--c"], ["--ros2-control"]):
        with pytest.raises(InputFileError, match="cannot be created as a folder"):
            run_verb(option, "/proc/x/y", *more)
    with pytest.raises(HexapodError, match=r"the tool in work at .*: strut_1: nominal length"):
        run_verb("--linuxcnc", str(tmp_path / "far"), "--c", str(tmp_path / "core"), "--box=-9,-9,390,9,9,5000")
    assert not (tmp_path / "core").exists(), "nothing is written if one export refuses"
    with pytest.raises(HexapodError, match="does not state the box in which it was measured"):
        run_verb("--linuxcnc", str(tmp_path))
    read = read_genhexkins

    for shift, code in ((15e-9, 0), (30e-9, 1)):  # of three base joints; they move the tool by 8 and 17 nm RMS

        def wrong(folder: str | Path, unit: str, shift: float = shift) -> Genhexkins:
            found = read(folder, unit)
            return replace(found, base_joints=found.base_joints + shift * np.eye(6)[:, :3])

        monkeypatch.setattr("hexapod_comp.export.linuxcnc.read_genhexkins", wrong)
        assert run_verb(*box) == code


def test_an_export_and_its_check_as_text_and_json() -> None:
    """A percentage is given if the error without the export is above 10 nm, the rounding of the files."""

    def compared(before: float, after: float) -> Comparison:
        return Comparison(2, Size(before, 3e-6), Size(after, 4e-6), Size(5e-6, 6e-6), Size(7e-6, 8e-6))

    sizes = "3.000 → 4.000 µm at most, 5.00 → 7.00 µrad RMS"
    effects = Size(1e-6, 2e-6), Size(3e-6, 4e-6), Size(5e-6, 6e-6)
    check = ExportCheck(compared(2e-6, 5e-7), compared(2e-6, 2.2e-6), *effects)
    lines, content = export._shown(export.ExportMethod("table", check, ["a note"]), 2.5)
    assert lines == [
        f"  table, level tool: 2.000 → 0.500 µm RMS (75.0 % less), {sizes}",
        f"  table, tool tilted by 2.5°: 2.000 → 2.200 µm RMS (10.0 % more), {sizes}",
        "    not corrected: a note",
        "    not corrected: thermal growth: if all parts become 1 K warmer, the tool moves by 3.000 µm RMS, "
        "4.000 at most",
        "    not corrected: growth by humidity: if the relative humidity rises by 10 percentage points, the tool moves "
        "by 5.000 µm RMS, 6.000 at most",
    ]
    names = [f"{name}_{kind}" for name in ("before", "after") for kind in ("rms_um", "max_um", "rms_urad", "max_urad")]
    level = dict(zip(names, (2.0, 3.0, 5.0, 6.0, 0.5, 4.0, 7.0, 8.0), strict=True))
    record = {"export": "table", "level": {"passes": 2, **level}, "tilted": {"passes": 2, **level, "after_rms_um": 2.2}}
    parts = [
        f"{name}_um"
        for part in ("field", "per_kelvin", "per_10_percent_humidity")
        for name in (f"{part}_rms", f"{part}_max")
    ]
    record |= dict(zip(parts, (1.0, 2.0, 3.0, 4.0, 5.0, 6.0), strict=True))
    assert_equal(content, record | {"not_carried": ["a note"]}, 1e-12)
    check = ExportCheck(compared(10e-9, 2e-8), None, Size(0.0, 0.0), None, None)
    lines, content = export._shown(export.ExportMethod("table", check, []), 5.0)
    assert lines == [
        f"  table, level tool: 0.010 → 0.020 µm RMS, {sizes}",
        "  table, tool tilted by 5°: no pose with this tilt is within the machine's limits",
        "    not corrected: thermal growth (the model has none)",
    ]
    assert [content[name] for name in ("tilted", "per_kelvin_max_um", "per_10_percent_humidity_rms_um")] == [None] * 3


PAPER = paper_geometry()
BOX = np.array([[-0.02, -0.02, 0.40], [0.02, 0.02, 0.42]])


@dataclass(frozen=True)
class StrutsWithWind(StrutErrors):
    wind: np.ndarray = field(default_factory=lambda: np.zeros(6))


EXPORTS: dict[str, Callable[[MachineModel], object]] = {
    "LinuxCNC": lambda model: make_genhexkins(RealMachine(PAPER, model), BOX),
    "table": lambda model: make_table(PAPER, model, BOX, 0.02),
    "C core": lambda model: model_header(PAPER, model, ("", "")),
}


@pytest.mark.parametrize("export", EXPORTS.values(), ids=EXPORTS)
def test_an_unknown_term_is_refused_and_zero_passes(export: Callable[[MachineModel], object]):
    assert export(MachineModel("paper", struts=StrutsWithWind()))
    with pytest.raises(ModelError, match=r"^struts\.wind: .*1e-09"):
        export(MachineModel("paper", struts=StrutsWithWind(wind=np.full(6, 1e-9))))
    table = OutsideTable(("tilt",), ("deg",), (np.array([0.0, 1.0]),), np.full((2, 3), 1e-9), np.zeros((2, 3)))
    with pytest.raises(ModelError, match=r"^outside\.names: cannot be exported: "):
        export(MachineModel("paper", outside=table))
    assert export(random_model(np.random.default_rng(1), "paper"))


def test_genhexkins_has_no_term_for_a_load():
    """The table and the C core contain a model's load; genhexkins cannot, and refuses it."""
    model = MachineModel("paper", load=Load(stiffness=np.full(6, 20e6), mass=30.0))
    refuse_unknown(model, "the C core")
    with pytest.raises(ModelError, match=r"^load\.stiffness_N_per_um: cannot be exported: genhex.* as C .*20\.0\)"):
        refuse_unknown(model, "genhexkins", without=("load.",))
