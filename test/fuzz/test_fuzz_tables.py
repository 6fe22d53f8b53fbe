"""Mutated measurements: CSV of poses, lengths and readings, wide CSV, LinuxCNC's, tables.

Truth: for CSV and text, cells split by hand and read by Decimal (fuzzing.py).
"""

from __future__ import annotations

import csv
import io
import re
from decimal import Decimal
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fuzzing import (
    FACTORS,
    PLAIN,
    Refused,
    cases,
    document,
    edits,
    finite,
    mutated,
    number_of,
    quantity,
    reader_of,
    same,
)
from hypothesis import example, given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from strategies import paper_geometry, random_model
from test_measurement_csv import STRUTS, WIDE, WIDE_COLUMNS

from hexapod_comp.errors import HexapodError
from hexapod_comp.export.linuxcnc import (
    COMP_FILES,
    HAL_FILE,
    INI_FILE,
    make_genhexkins,
    read_genhexkins,
    table_misfit,
    write_genhexkins,
)
from hexapod_comp.export.table import make_table, read_table, write_table
from hexapod_comp.machine.model import RealMachine
from hexapod_comp.machine.pose_files import read_lengths, read_poses
from hexapod_comp.measurements.readings import MeasurementSet
from hexapod_comp.measurements.tidy import read_tidy
from hexapod_comp.measurements.wide_csv import read_wide

PAPER = paper_geometry()

POSES = (
    b"sequence,x_mm,y_mm,z_mm,alpha_deg,beta_deg,gamma_deg\n1,0,0,400,5,0,0\n2,-12.5,3,410.25,-1.5,2,0.125\n",
    b"# a comment\nname,x_in,y_in,z_m,qx,qy,qz,qw\nhome,0,0,0.4,0,0,0,1\n'tilted',1,-2,.41,0.0871557,0,0,0.9961947\n",
    b"x_um,y_um,z_um\r\n1000,2.5e3,400000\r\n",
)
LENGTHS = b"name,L1_mm,L2_mm,L3_mm,L4_mm,L5_mm,L6_mm\na,519.494,519.808,509.192,509.192,499.282,498.955\n"
TIDY = (
    "run,cycle,direction,x_mm,y_mm,z_mm,channel,value,unit,uncertainty,temperature_degC\n"
    + "".join(f"line,1,forward,{x},0,400,linear,{x * 0.03125},um,1,20\n" for x in (-60, -20, 20, 60))
    + "".join(f"line,1,backward,{x},0,400,linear,{x * 0.03},um,,21\n" for x in (60, 20, -20, -60))
    + "".join(f"line,1,forward,{x},0,400,yaw,{x * 0.25},urad,0.5,20\n" for x in (-60, -20, 20, 60))
    + "t,1,,0,0,410,position_x,0.0125,mm,,20\nt,1,,0,0,410,attitude_z,3,arcsec,,20\n"
).encode()
DIRECT = ("linear", "straightness", "rotation", "attitude", "roll", "pitch", "yaw")
"""Channels whose value is the error itself."""


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("fuzz")


def put(folder: Path, name: str, data: bytes) -> Path:
    path = folder / name
    path.write_bytes(data)
    return path


def rows_of(data: bytes) -> list[dict[str, str]]:
    """Return a CSV file's rows as a spreadsheet shows them: comments and empty lines left out, no spaces around.

    The header tells what separates columns: commas, or else semicolons, or else tabs. Where it is not commas, numbers
    with decimal commas get points.
    """
    assert b"\0" not in data
    try:
        text = data.decode("utf-16" if data[:2] in (b"\xff\xfe", b"\xfe\xff") else "utf-8-sig")
    except UnicodeDecodeError:
        text = data.decode("cp1252", "replace")
    top = next(line for line in io.StringIO(text, newline="") if re.match(r'(?!\s*"?#)\s*\S', line))
    bare = re.sub(r'"[^"]*"', "", top)
    separator = next((mark for mark in ",;\t" if mark in bare), ",")
    lines = csv.reader(io.StringIO(text, newline=""), delimiter=separator, skipinitialspace=True)
    cells = [line for line in lines if line and not line[0].startswith("#")]
    header = [name.strip() for name in cells[0]]
    named = [name for name in header if name]
    assert len(set(named)) == len(named)
    assert all(len(line) == len(header) for line in cells)
    rows = cells[1:] if separator == "," else with_points(cells[1:])
    return [dict(zip(header, line, strict=True)) for line in rows]


def with_points(rows: list[list[str]]) -> list[list[str]]:
    """Return rows whose numbers with decimal commas have points; check that a comma can only be a decimal one."""
    flat = [cell.strip() for line in rows for cell in line]
    commas = [cell for cell in flat if re.fullmatch(r"[-+]?[0-9]+,[0-9]+([eE][-+]?[0-9]+)?", cell)]
    if commas:
        assert not [cell for cell in flat if "." in cell and PLAIN.fullmatch(cell)], "points and commas"
        assert not all(re.fullmatch(r"[-+]?[1-9][0-9]{0,2},[0-9]{3}", cell) for cell in commas), "may be thousands"
    return [[cell.replace(",", ".") if cell.strip() in commas else cell for cell in line] for line in rows]


def column(rows: list[dict[str, str]], name: str, kind: str) -> list[float] | None:
    """Return a column in SI, None when it is not there; it may be there in one unit only."""
    found = [key for key in rows[0] if key.startswith(f"{name}_") and key[len(name) + 1 :] in FACTORS[kind]]
    assert len(found) <= 1
    if not found:
        return None
    return [si(row[found[0]], FACTORS[kind][found[0][len(name) + 1 :]]) for row in rows]


def si(text: str, factor: str) -> float:
    """Return a cell in SI; spaces around it do not count, leading zeros do not either in a table."""
    text = text.strip()
    return float(number_of(re.sub(r"^([-+]?)0+(?=\d)", r"\1", text)) * Decimal(factor))


# Poses and lengths.


@pytest.mark.parametrize("seed", range(len(POSES)))
@given(changes=edits)
@example(changes=[])
@cases(60, 0.03)
def test_poses(folder: Path, seed: int, changes: list) -> None:
    data = mutated(POSES[seed], changes)
    path = put(folder, "poses.csv", data)
    try:
        with reader_of("poses", path):
            rows, poses = read_poses(path)
    except Refused:
        assert changes
        return
    expected = rows_of(data)
    assert len(poses) == len(rows) == len(expected)
    for k, axis in enumerate("xyz"):
        same([pose.position[k] for pose in poses], column(expected, axis, "length"))
    if "qx" in expected[0]:
        turns = Rotation.from_quat([[si(row[f"q{c}"], "1") for c in "xyzw"] for row in expected])
    else:
        angles = [column(expected, name, "angle") or [0.0] * len(rows) for name in ("beta", "alpha", "gamma")]
        turns = Rotation.from_euler("YXZ", np.transpose(angles))
    for pose, turn in zip(poses, turns.as_matrix(), strict=True):
        np.testing.assert_allclose(pose.rotation, turn, atol=1e-9)
    for row, wanted in zip(rows, expected, strict=True):
        label = next((wanted[name].strip() for name in ("sequence", "name") if name in wanted), row.label)
        assert label == row.label


@given(changes=edits)
@example(changes=[])
@cases(60, 0.03)
def test_lengths(folder: Path, changes: list) -> None:
    data = mutated(LENGTHS, changes)
    path = put(folder, "lengths.csv", data)
    try:
        with reader_of("lengths", path):
            rows, lengths = read_lengths(path)
    except Refused:
        assert changes
        return
    expected = rows_of(data)
    assert len(rows) == len(expected)
    for strut in range(6):
        same(lengths[:, strut], column(expected, f"L{strut + 1}", "length"))


# Readings.


def sound(found: MeasurementSet) -> None:
    """Check what every set of readings must be."""
    finite(found.value, found.stations.positions, found.stations.rotations, found.stations.commands)
    finite(found.stations.temperatures, found.points(), found.directions())
    assert len(found.sources) == len(found) > 0


@given(changes=edits)
@example(changes=[])
@cases(60, 0.06)
def test_tidy_measurements(folder: Path, changes: list) -> None:
    data = mutated(TIDY, changes)
    path = put(folder, "tidy.csv", data)
    try:
        with reader_of("tidy", path):
            found = read_tidy(path, PAPER)
    except Refused:
        assert changes
        return
    sound(found)
    expected = rows_of(data)
    angular = ("rotation", "attitude", "roll", "pitch", "yaw")
    wanted, coordinates = [], []
    for row in expected:
        kind = row["channel"].strip().partition("_")[0]
        if kind in DIRECT:
            wanted.append(si(row["value"], FACTORS["angle" if kind in angular else "length"][row["unit"].strip()]))
        elif kind == "position":
            axis = row["channel"].strip()[-1]
            commanded = column([row], axis, "length")
            assert commanded
            coordinates.append(si(row["value"], FACTORS["length"][row["unit"].strip()]) - commanded[0])
    position = (found.channel >= 7) & (found.channel < 10)
    same(found.value[~position], wanted)
    np.testing.assert_allclose(found.value[position], coordinates, atol=1e-15, rtol=1e-12)


WIDE_ROWS = (WIDE + "0,0,0,0,0,0,1,0,16,0,0,0,1,25.39,0,300,x\n1,1,1,1,1,1,1,0,16.1,0,0,0,1,25,0,302,\n").encode()
WITHOUT_COMMANDS = WIDE_COLUMNS[: WIDE_COLUMNS.index("commanded")] + WIDE_COLUMNS[WIDE_COLUMNS.index("measured") :]
WIDE_SEEDS = (WIDE_COLUMNS.encode(), (WITHOUT_COMMANDS + STRUTS).encode())


@pytest.mark.parametrize("seed", range(2))
@given(columns=st.booleans(), changes=edits)
@example(columns=False, changes=[])
@cases(60, 0.03)
def test_wide_measurements(folder: Path, seed: int, columns: bool, changes: list) -> None:
    parts = [WIDE_ROWS, WIDE_SEEDS[seed]]
    parts[columns] = mutated(parts[columns], changes)
    paths = put(folder, "wide.csv", parts[0]), put(folder, "columns.yaml", parts[1])
    try:
        with reader_of("wide", *paths):
            found = read_wide(*paths, PAPER)
    except Refused:
        assert changes
        return
    sound(found)
    tree, rows = document(parts[1]), rows_of(parts[0])
    measured = wide_points(tree["measured"], rows)
    position = (found.channel >= 7) & (found.channel < 10)
    points = found.points()[found.station][position].reshape(-1, 3, 3)[:, 0]
    read = found.value[position].reshape(-1, 3) + points
    np.testing.assert_allclose(read, measured, rtol=1e-9, atol=1e-12)
    if "commanded" in tree:
        np.testing.assert_allclose(points, wide_points(tree["commanded"], rows), rtol=1e-9, atol=1e-12)


def wide_points(section: dict[str, Any], rows: list[dict[str, str]]) -> np.ndarray:
    """Return the positions that a section of a columns file names."""
    factor = FACTORS["length"][section["unit"]]
    found = np.array([[si(row[name], factor) for name in section["position"]] for row in rows])
    return found + quantity(section, "offset", "length", np.zeros(3))


# Exports read back.


@pytest.fixture(scope="module")
def exported(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Give a folder with LinuxCNC's files and a table of a machine."""
    made = tmp_path_factory.mktemp("exported")
    box = np.array([[-0.04, -0.04, 0.38], [0.04, 0.04, 0.46]])
    model = random_model(np.random.default_rng(3), "paper")
    machine = RealMachine(PAPER, model)
    told = make_genhexkins(machine, box)
    write_genhexkins(told, made, "mm", ["fuzz"], table_misfit(machine, told, box))
    write_table(make_table(PAPER, model, box, 0.08)[0], made / "table.csv", ["fuzz"])
    return made


SETP = re.compile(r"^setp\s+genhexkins\.(base|platform)\.(\d)\.([xyz])\s+(\S+)\s*$", re.MULTILINE | re.ASCII)


@given(which=st.sampled_from((HAL_FILE, INI_FILE, *COMP_FILES[:2])), changes=edits)
@example(which=HAL_FILE, changes=[])
@cases(60, 0.04)
def test_linuxcnc_files(exported: Path, which: str, changes: list) -> None:
    path = exported / which
    before = path.read_bytes()
    data = mutated(before, changes)
    try:
        path.write_bytes(data)
        with reader_of("linuxcnc", path):
            found = read_genhexkins(exported, "mm")
    except Refused:
        assert changes
        return
    finally:
        path.write_bytes(before)
    finite(found.base_joints, found.platform_joints, found.lead)
    text = data.decode("utf-8-sig")
    if which == HAL_FILE:
        for body, joint, axis, value in SETP.findall(text.replace("\r", "\n")):
            joints = found.base_joints if body == "base" else found.platform_joints
            same(joints[int(joint), "xyz".index(axis)], number_in_c(value) * 1e-3)
    for strut, table in enumerate(found.tables):
        finite(table.nominal, table.trims)
        assert (np.diff(table.nominal) > 0.0).all()
        if which == COMP_FILES[strut]:
            rows = leading_rows(text)
            same(np.column_stack([table.nominal, *table.trims]), np.array(rows) * 1e-3)


def number_in_c(word: str) -> float:
    """Return what C's strtod, and so LinuxCNC, reads: leading zeros mean nothing."""
    return float(number_of(re.sub(r"^([-+]?)0+(?=\d)", r"\1", word)))


def leading_rows(text: str) -> list[list[float]]:
    """Return what LinuxCNC reads of a compensation file: up to the first line without three numbers."""
    rows: list[list[float]] = []
    for line in re.split(r"\r\n|\r|\n", text):
        words = line.split()[:3]
        try:
            rows.append([number_in_c(word) for word in words])
        except AssertionError:
            break
        if len(words) < 3:
            rows.pop()
            break
    return rows


@given(changes=edits)
@example(changes=[])
@cases(60, 0.03)
def test_tables(exported: Path, changes: list) -> None:
    data = mutated((exported / "table.csv").read_bytes(), changes)
    path = put(exported, "mutated.csv", data)
    try:
        with reader_of("table", path):
            found = read_table(path)
    except Refused:
        assert changes
        return
    finite(*found.nodes, found.struts, found.backlash, found.poses)
    rows = rows_of(data)
    assert found.struts[..., 0].size == len(rows)
    for name, values in (("correction_L1", found.struts[..., 0]), ("dy", found.poses[..., 1])):
        wanted = column(rows, name, "length")
        assert wanted is not None
        same(np.sort(values.ravel()), np.sort(wanted))


def test_a_table_of_another_kind_is_refused(exported: Path) -> None:
    with pytest.raises(HexapodError):
        read_table(put(exported, "other.csv", TIDY))
