"""Mutated files are read correctly, or refused with a readable message.

The truth is the same content, rewritten in the plainest form by another parser and read again: of YAML the tree of
nodes, of CSV the cells split by hand, every number with a unit converted to SI by Decimal (fuzzing.py). Both readings
must be equal. The readers' own tests check that values get to the right place.
"""

from __future__ import annotations

import csv
import io
import json
import re
from collections.abc import Callable
from dataclasses import replace
from decimal import Decimal
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

import numpy as np
import pytest
import yaml
from fuzzing import PLAIN, UNITS, Refused, cases, check_document, edits, finite, mutated, reader_of
from helpers import assert_equal
from hypothesis import example, given
from strategies import paper_geometry, random_model
from test_measurement_csv import WIDE, WIDE_COLUMNS

from hexapod_comp.compensation.compensator import Compensator
from hexapod_comp.errors import HexapodError
from hexapod_comp.export.table import make_table, read_table, write_table
from hexapod_comp.formats.csv import Row
from hexapod_comp.machine.geometry import HexapodGeometry, load_geometry
from hexapod_comp.machine.model import MachineModel, ModelOrigin
from hexapod_comp.machine.model_file import load_model, model_text
from hexapod_comp.machine.pose_files import read_lengths, read_poses
from hexapod_comp.machine.region import Region
from hexapod_comp.measurements.campaign import load_campaign
from hexapod_comp.measurements.files import read_measurements
from hexapod_comp.measurements.readings import FileLine, MeasurementSet
from hexapod_comp.workspace.budget import load_budget

CONFIG = Path(__file__).resolve().parents[2] / "config"
PAPER = paper_geometry()
BOX = np.array([[-0.04, -0.04, 0.38], [0.04, 0.04, 0.46]])


# Files


def full_model() -> bytes:
    """Return the file of a model with all blocks."""
    rng = np.random.default_rng(6)
    full = random_model(rng, "paper")
    grid = np.array([-0.2, 0.2])
    lines = tuple(rng.uniform(-2e-5, 2e-5, (2, 2, 2, 6, 2)).round(9) for _ in range(3))
    model = MachineModel(
        "paper",
        "full",
        origin=ModelOrigin("2026-01-31", (("laser.csv", "0" * 64),), 4.2e-6, "a note"),
        field=type(full.field)((grid, grid, grid + 0.5), lines, [0.01, 0.0, -0.1]),  # type: ignore[arg-type]
        region=Region(
            np.array([[-0.2, -0.2, 0.3], [0.2, 0.2, 0.6]]), np.array([0.01, 0.0, -0.1]), np.array([0.1, 0.0, 0.2]),
            np.array([0.1, -0.2, 0.3]),
        ),
        base_expansion=11e-6,
        **{name: getattr(full, name) for name in ("base_deviation", "platform_deviation", "struts")},
    )  # fmt: skip
    return model_text(model).encode()


SEEDS = {path.name: path.read_bytes() for path in Path(__file__).with_name("seeds").iterdir()}
POSES = SEEDS["poses.csv"], SEEDS["named_poses.csv"], b"x_um,y_um,z_um\r\n1000,2.5e3,400000\r\n"
WIDE_ROWS = (WIDE + "0,0,0,0,0,0,1,0,16,0,0,0,1,25.39,0,300,x\n1,1,1,1,1,1,1,0,16.1,0,0,0,1,25,0,302,\n").encode()
GEOMETRIES = (
    (CONFIG / "paper.yaml").read_bytes(),
    (CONFIG / "positioning_unit.yaml").read_bytes(),
    (CONFIG / "example_6_6.yaml").read_bytes(),
)


# The same content in plain form


def plain_yaml(data: bytes) -> bytes:
    """Return a YAML file in flow style with all quantities in SI."""
    return _plain(check_document(data)).encode()


def _plain(node: yaml.Node, factor: str | None = None) -> str:
    if isinstance(node, yaml.MappingNode):
        assert len({key.value for key, _ in node.value}) == len(node.value)
        return "{" + ", ".join(_entry(key.value, value) for key, value in node.value) + "}"
    if isinstance(node, yaml.SequenceNode):
        return "[" + ", ".join(_plain(item, factor) for item in node.value) + "]"
    bare = node.style not in ("'", '"', "|", ">") and re.fullmatch(r"[-+.\w:]*", node.value)
    if bare and factor is not None and PLAIN.fullmatch(node.value):
        return number(node.value, factor)
    return node.value if bare else json.dumps(node.value)


def _entry(key: str, value: yaml.Node) -> str:
    name, si, factor = in_si(key)
    return f"{json.dumps(name + si)}: {_plain(value, factor)}"


def in_si(key: str) -> tuple[str, str, str | None]:
    """Return a key's name, its ending in SI, and the factor of its unit (None without a unit)."""
    key = re.sub("_[µμ](m|rad)$", r"_u\1", key)
    unit = max((unit for unit in UNITS if key.endswith(f"_{unit}")), key=len, default=None)
    if unit is None:
        return key, "", None
    factor, si = UNITS[unit]
    return key.removesuffix(f"_{unit}"), f"_{si}", factor


def number(text: str, factor: str) -> str:
    """Return a number times a factor, written as a float; leading zeros of a cell are ignored."""
    shown = re.sub(r"^([-+]?)0+(?=[0-9])", r"\1", text.strip())
    return f"{float(Decimal(shown) * Decimal(factor)):.17e}"


def rows_of(data: bytes) -> list[dict[str, str]]:
    """Return a CSV file's rows as a spreadsheet shows them: without comments, empty lines and surrounding spaces.

    The header shows the separator: comma, else semicolon, else tab. With other separators than commas, numbers with
    decimal commas get points.
    """
    try:
        text = data.decode("utf-16" if data[:2] in (b"\xff\xfe", b"\xfe\xff") else "utf-8-sig")
    except UnicodeDecodeError:
        text = data.decode("cp1252", "replace")
    assert "\0" not in text
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
    """Return rows with decimal points in place of decimal commas; fail if a comma may separate thousands."""
    flat = [cell.strip() for line in rows for cell in line]
    commas = [cell for cell in flat if re.fullmatch(r"[-+]?[0-9]+,[0-9]+([eE][-+]?[0-9]+)?", cell)]
    if commas:
        assert not [cell for cell in flat if "." in cell and PLAIN.fullmatch(cell)], "points and commas"
        assert not all(re.fullmatch(r"[-+]?[1-9][0-9]{0,2},[0-9]{3}", cell) for cell in commas), "may be thousands"
    return [[cell.replace(",", ".") if cell.strip() in commas else cell for cell in line] for line in rows]


def plain_csv(data: bytes) -> bytes:
    """Return a CSV file with commas and points, in SI by the unit of the column or in the row's ``unit``."""
    out = io.StringIO()
    rows = [dict(plain_cell(name, cell, row) for name, cell in row.items()) for row in rows_of(data)]
    writer = csv.DictWriter(out, list(rows[0]), lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    return out.getvalue().encode()


def plain_cell(name: str, cell: str, row: dict[str, str]) -> tuple[str, str]:
    key, si, factor = in_si(name)
    of_row = name in ("value", "uncertainty") and "unit" in row
    if of_row or name == "unit":
        factor, unit = UNITS[row["unit"].strip()]
        if name == "unit":
            return name, unit
    return key + si, number(cell, factor) if factor and cell.strip() else cell.strip()


def plain_cells(data: bytes) -> bytes:
    """Return a CSV file, whose units are in another file, with commas and points."""
    out = io.StringIO()
    rows = rows_of(data)
    csv.writer(out, lineterminator="\n").writerows([list(rows[0]), *(list(row.values()) for row in rows)])
    return out.getvalue().encode()


# Checks of what was read


def works_or_refuses(geometry: HexapodGeometry, model: MachineModel) -> None:
    """Check that an accepted machine computes commands within its limits at home, or refuses them."""
    try:
        compensator = Compensator(geometry, model)
    except HexapodError:
        return
    home = geometry.tool_pose(geometry.home)
    for time in range(2):
        try:
            found = compensator.correct(home, 0.1 * time)
        except HexapodError:
            continue
        stroke = geometry.limits.stroke
        finite(found.command, found.nominal, found.correction)
        assert (found.command >= stroke[:, 0]).all()
        assert (found.command <= stroke[:, 1]).all()
        assert np.abs(found.correction).max() <= geometry.limits.correction
        home_lengths = np.linalg.norm(
            geometry.home.position + geometry.platform_joints @ geometry.home.rotation.T - geometry.base_joints, axis=1
        )
        # The transformation through work and tool rounds in proportion to their size.
        size = max(1.0, np.abs(geometry.work.position).max(), np.abs(geometry.tool.position).max())
        np.testing.assert_allclose(found.command - found.correction, home_lengths, atol=1e-14 * size + 1e-12)


def sound(found: MeasurementSet) -> None:
    """Check that a set of readings is finite and not empty."""
    finite(found.value, found.stations.positions, found.stations.rotations, found.stations.commands)
    finite(found.stations.temperatures, found.points(), found.directions())
    assert len(found.sources) == len(found) > 0


class Kind(NamedTuple):
    """One kind of file: its reader, its plain form, seed files, and the check of what was read."""

    read: Callable[[Path], Any]
    plain: Callable[[bytes], bytes]
    seeds: tuple[bytes, ...]
    judge: Callable[[Any], None] = lambda found: None


def labelled(read: tuple[list[Row], Any]) -> tuple[list[str], Any]:
    """Return the labels of rows and their values, without line numbers."""
    return [row.label for row in read[0]], read[1]


def unplaced(found: MeasurementSet) -> MeasurementSet:
    """Return readings without the lines and files from which they were read."""
    return replace(found, sources=(FileLine("", 0),) * len(found), files=(), notes=())


def wide_by(columns: str) -> Callable[[Path], MeasurementSet]:
    def read(path: Path) -> MeasurementSet:
        path.with_name("w.yaml").write_text(columns)
        return unplaced(read_measurements(path, PAPER, path.with_name("w.yaml")))

    return read


def wide_rows(path: Path) -> MeasurementSet:
    path.with_name("w.csv").write_bytes(WIDE_ROWS)
    return unplaced(read_measurements(path.with_name("w.csv"), PAPER, path))


def grid_table() -> bytes:
    with TemporaryDirectory() as folder:
        path = Path(folder, "table.csv")
        write_table(make_table(PAPER, random_model(np.random.default_rng(3), "paper"), BOX, 0.08)[0], path, ["fuzz"])
        return path.read_bytes()


KINDS = {
    "geometry": Kind(load_geometry, plain_yaml, GEOMETRIES, lambda g: works_or_refuses(g, MachineModel(g.name))),
    "model": Kind(
        lambda path: load_model(path, PAPER),
        plain_yaml,
        (full_model(), SEEDS["model.yaml"]),
        lambda m: works_or_refuses(PAPER, m),
    ),
    "campaign": Kind(load_campaign, plain_yaml, ((CONFIG / "campaign_full.yaml").read_bytes(),)),
    "budget": Kind(load_budget, plain_yaml, ((CONFIG / "error_budget.yaml").read_bytes(),)),
    "poses": Kind(lambda path: labelled(read_poses(path)), plain_csv, POSES),
    "lengths": Kind(lambda path: labelled(read_lengths(path)), plain_csv, (SEEDS["lengths.csv"],)),
    "tidy": Kind(lambda path: unplaced(read_measurements(path, PAPER)), plain_csv, (SEEDS["tidy.csv"],), sound),
    "wide": Kind(wide_by(WIDE_COLUMNS), plain_cells, (WIDE_ROWS,), sound),
    "columns": Kind(wide_rows, plain_yaml, (WIDE_COLUMNS.encode(), SEEDS["columns_of_struts.yaml"]), sound),
    "table": Kind(read_table, plain_csv, (grid_table(),)),
}


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("fuzz")


@pytest.mark.parametrize(("name", "seed"), [(name, n) for name, kind in KINDS.items() for n in range(len(kind.seeds))])
@given(changes=edits)
@example(changes=[])
@cases(20, 0.05)
def test_a_mutated_file_is_read_as_what_stands_in_it_or_refused(
    folder: Path, name: str, seed: int, changes: list
) -> None:
    kind = KINDS[name]
    data = mutated(kind.seeds[seed], changes)
    path = folder / name
    path.write_bytes(data)
    try:
        with reader_of(name, path):
            found = kind.read(path)
    except Refused:
        assert changes
        return
    kind.judge(found)
    path.write_bytes(kind.plain(data))
    assert_equal(found, kind.read(path), relative=1e-13, absolute=1e-15)
