"""Common parts of the kinematics tests: the paper's tables in SI, central differences, special machines."""

from __future__ import annotations

import copy
import csv
import importlib
import inspect
import io
import os
import re
from collections.abc import Callable, Iterator
from contextlib import contextmanager, redirect_stderr, redirect_stdout
from dataclasses import fields, is_dataclass
from enum import Enum
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from scipy.optimize import lsq_linear
from scipy.spatial.transform import Rotation

import hexapod_comp
from hexapod_comp.machine.geometry import HexapodGeometry, Limits
from hexapod_comp.machine.kinematics import Structure, strut_lengths
from hexapod_comp.machine.model import RealMachine
from hexapod_comp.pose import Pose

ALL_TESTS = bool(os.environ.get("ALL_TESTS"))
# Decorator for slow tests, and for all but two machines of the zoo: only `make test-all` runs them
long_test = pytest.mark.skipif(not ALL_TESTS, reason="make test-all runs it (ALL_TESTS=1)")

DATA = Path(__file__).parent / "data"

# Factor to SI of a table column by its unit, the part of its name after the last underscore
FACTORS = {"mm": 1e-3, "deg": np.pi / 180.0}


def read_table(name: str) -> dict[str, np.ndarray]:
    """Return a table of test/data (Song et al.'s tables as printed) as SI columns, by name without unit."""
    with (DATA / name).open(newline="") as file:
        rows = list(csv.DictReader(file))
    columns = {}
    for title in rows[0]:
        key, _, unit = title.rpartition("_")
        if unit in FACTORS:
            columns[key] = np.array([float(row[title]) * FACTORS[unit] for row in rows])
    return columns


def table_poses() -> list[Pose]:
    """Return the ten commanded poses of Song et al., Table 1."""
    table = read_table("table1_commanded_poses.csv")
    positions = np.stack([table[key] for key in "xyz"], axis=1)
    angles = np.stack([table[key] for key in ("alpha", "beta", "gamma")], axis=1)
    return [Pose.from_angles(p, a) for p, a in zip(positions, angles, strict=True)]


def table_lengths() -> np.ndarray:
    """Return the ideal strut lengths of Song et al., Table 2, shape (10, 6), m."""
    table = read_table("table2_strut_lengths_ideal.csv")
    return np.stack([table[f"L{i}"] for i in range(1, 7)], axis=1)


def beside(test: str) -> dict[str, Any]:
    """Return the content of the YAML file beside a test file: the test's long texts, and rows of its long tables."""
    return yaml.safe_load(Path(test).with_suffix(".yaml").read_text(encoding="utf-8"))


def assert_defaults(test: str) -> None:
    """Compare numbers and switches that are defaults in a room's public functions with defaults.txt beside its tests.

    Callers rely on a default: changing one needs a line in CHANGELOG.rst. ``RENEW_REPORTS=1`` writes the file.
    """
    record, lines = Path(test).with_name("defaults.txt"), []
    room = record.parent.name
    for module in sorted(path.stem for path in (Path(hexapod_comp.__file__).parent / room).glob("[a-z]*.py")):
        for name, one in sorted(vars(importlib.import_module(f"hexapod_comp.{room}.{module}")).items()):
            own = getattr(one, "__module__", "") == f"hexapod_comp.{room}.{module}" and name[0] != "_"
            if own and callable(one) and not (isinstance(one, type) and issubclass(one, Exception | Enum)):
                values = ((p.name, p.default) for p in inspect.signature(one).parameters.values())
                given = [f"{name} {value!r}" for name, value in values if isinstance(value, bool | int | float | tuple)]
                lines += [f"{module}.{name}: {', '.join(given)}\n"] if given else []
    if os.environ.get("RENEW_REPORTS"):
        record.write_text("".join(lines), encoding="utf-8")
    assert "".join(lines) == record.read_text(encoding="utf-8")


NUMBER = re.compile(r"\d+\.\d+(?:e[-+]\d+)?|\d+e[-+]\d+")


def assert_same_text(found: str, wanted: str, small: float | None = None) -> None:
    """Compare texts: the same words, signs and whole numbers; decimals may differ by two units of their last digit.

    Numbers with an exponent may differ by `small` instead, if it is given.
    """
    assert NUMBER.sub("#", found) == NUMBER.sub("#", wanted)
    for mine, its in zip(NUMBER.findall(found), NUMBER.findall(wanted), strict=True):
        mantissa, _, exponent = its.partition("e")
        last_digit = 10.0 ** (int(exponent or 0) - len(mantissa.partition(".")[2]))
        allowed = small if exponent and small is not None else 2.0 * last_digit
        assert float(mine) == pytest.approx(float(its), rel=0.0, abs=allowed), its


def places(tree: Any, at: tuple = ()) -> Iterator[tuple]:
    """Yield the paths to all items of nested mappings and lists; of a list only the first item."""
    yield at
    items = tree.items() if isinstance(tree, dict) else enumerate(tree[:1]) if isinstance(tree, list) else ()
    for key, item in items:
        yield from places(item, (*at, key))


def put(tree: Any, at: tuple, value: Any) -> Any:
    """Return a copy of a tree with another value at a path."""
    if not at:
        return value
    tree = copy.copy(tree)
    tree[at[0]] = put(tree[at[0]], at[1:], value)
    return tree


def assert_equal(one: Any, other: Any, relative: float = 0.0, absolute: float = 0.0) -> None:
    """Compare two records by the fields of their constructors, except fields that are not compared by ==."""
    assert type(one) is type(other)
    if is_dataclass(one):
        for entry in fields(one):
            if entry.compare and entry.init:
                assert_equal(getattr(one, entry.name), getattr(other, entry.name), relative, absolute)
    elif isinstance(one, tuple | list):
        assert len(one) == len(other)
        for mine, its in zip(one, other, strict=True):
            assert_equal(mine, its, relative, absolute)
    elif isinstance(one, dict):
        assert list(one) == list(other)
        assert_equal(list(one.values()), list(other.values()), relative, absolute)
    elif isinstance(one, np.ndarray):
        assert one.shape == other.shape
        np.testing.assert_allclose(one, other, rtol=relative, atol=absolute)
    elif isinstance(one, float):
        assert one == pytest.approx(other, rel=relative, abs=absolute, nan_ok=True)
    else:
        assert one == other


def hexapod(*words: object) -> tuple[int, str, str]:
    """Run the command line in this process; return exit code, standard output and standard error."""
    from hexapod_comp import cli

    with redirect_stdout(io.StringIO()) as out, redirect_stderr(io.StringIO()) as err:
        code = cli.main([str(word) for word in words])
    return code, out.getvalue(), err.getvalue()


@contextmanager
def quick_pictures() -> Iterator[None]:
    """Draw pictures small and without a second layout pass, for tests that do not look at them."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    def savefig(figure: Figure, stream: object, **options: object) -> None:
        figure.set_layout_engine("none")
        figure.set_dpi(40)
        FigureCanvasAgg(figure).print_png(stream)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Figure, "savefig", savefig)
        yield


def distances(machine: Any, pose: Pose) -> np.ndarray:
    """Return strut lengths, shape (6,), m, by NumPy alone, of any object with base and platform joints."""
    return np.linalg.norm(pose.position + machine.platform_joints @ pose.rotation.T - machine.base_joints, axis=1)


def nominal_error(machine: RealMachine, target: Pose, sense: np.ndarray) -> Pose:
    """Return the real platform pose of a machine whose struts are commanded to the nominal lengths of `target`."""
    return machine.pose_for(strut_lengths(Structure.of(machine.geometry), target), sense, target)[0]


def segment_distance(a: np.ndarray, b: np.ndarray, c: np.ndarray, d: np.ndarray) -> float:
    """Return the distance of the segments a–b and c–d by bounded least squares, a method other than the core's."""
    shares = lsq_linear(np.stack([b - a, c - d], axis=1), c - a, (0.0, 1.0), tol=1e-14, method="bvls").x
    return float(np.linalg.norm(a + shares[0] * (b - a) - c - shares[1] * (d - c)))


def central_difference(function: Callable[[np.ndarray], np.ndarray], at: np.ndarray, step: float = 1e-5) -> np.ndarray:
    """Return the derivative of `function` at a point by central differences."""
    columns = [(function(at + h) - function(at - h)) / (2.0 * step) for h in step * np.eye(len(at))]
    return np.stack(columns, axis=1)


def moved(pose: Pose, twist: np.ndarray) -> Pose:
    """Return a pose displaced by (v, ω) in ``base``: shifted by v, turned by exp(ω) about its own origin."""
    return Pose(pose.position + twist[:3], Rotation.from_rotvec(twist[3:]).as_matrix() @ pose.rotation)


def twist_between(start: Pose, end: Pose) -> np.ndarray:
    """Return the (v, ω) by which :func:`moved` displaces one pose to another, shape (6,), m and rad."""
    turn = Rotation.from_matrix(end.rotation @ start.rotation.T)
    return np.concatenate([end.position - start.position, turn.as_rotvec()])


def poses_about(
    home: Pose, count: int, seed: int, reach: float = 0.05, tilt_deg: float = 30.0
) -> tuple[np.ndarray, np.ndarray]:
    """Return positions within ±`reach` m and rotations with each of α, β, γ within ±`tilt_deg` of home."""
    rng = np.random.default_rng(seed)
    positions = home.position + rng.uniform(-reach, reach, (count, 3))
    alpha, beta, gamma = np.deg2rad(rng.uniform(-tilt_deg, tilt_deg, (3, count)))
    turns = Rotation.from_euler("YXZ", np.stack([beta, alpha, gamma], axis=1))
    return positions, np.ascontiguousarray(turns.as_matrix() @ home.rotation)


def wide_limits(condition: float) -> Limits:
    """Return limits that only the condition number can exceed."""
    return Limits(np.tile([0.01, 5.0], (6, 1)), np.full(6, 3.0), np.full(6, 3.0), condition, 1e-2, 1.0, 1.0)


def three_two_one_machine() -> HexapodGeometry:
    """Return a 6-6 machine with three vertical, two sideways and one lengthways strut.

    No two joints coincide. The vertical struts are 1, 3, 5: parallel at home, so elimination by blocks has no pivot.
    """
    vertical = np.array([[0.2, 0.0, 0.0], [-0.1, 0.17, 0.02], [-0.12, -0.15, -0.01]])
    sideways = np.array([[0.15, 0.05, 0.03], [-0.14, 0.02, 0.05], [0.03, -0.12, 0.04]])
    directions = np.array([[0.0, 1.0, 0.0], [0.0, 1.0, 0.0], [1.0, 0.0, 0.0]])
    platform, base = np.empty((6, 3)), np.empty((6, 3))
    platform[::2], base[::2] = vertical, vertical - [0.0, 0.0, 0.5]
    platform[1::2], base[1::2] = sideways, sideways - 0.4 * directions
    home = Pose([0.0, 0.0, 0.5], np.eye(3))
    return HexapodGeometry("3-2-1", base + home.position, platform, home, wide_limits(20.0))


def general_machine() -> HexapodGeometry:
    """Return a 6-6 machine with twelve separate joints off any plane, 2.5 times the paper's size."""
    rng = np.random.default_rng(66)
    around = np.deg2rad([25.0, 95.0, 145.0, 215.0, 265.0, 335.0])
    ring = np.stack([np.cos(around), np.sin(around), np.zeros(6)], axis=1)
    above = np.deg2rad([45.0, 75.0, 165.0, 195.0, 285.0, 315.0])
    inner = np.stack([np.cos(above), np.sin(above), np.zeros(6)], axis=1)
    base = 1.1 * ring + rng.uniform(-0.06, 0.06, (6, 3))
    platform = 0.5 * inner + rng.uniform(-0.05, 0.05, (6, 3))
    home = Pose.from_angles([0.03, -0.05, 1.0], np.deg2rad([3.0, -4.0, 5.0]))
    return HexapodGeometry("general", base, platform, home, wide_limits(20.0))
