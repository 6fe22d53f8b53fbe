"""The public names, the cost of importing them, and the examples that use them."""

from __future__ import annotations

import ast
import contextlib
import importlib
import importlib.util
import io
import pkgutil
import re
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
from calibration_helpers import campaign, paper, virtual_machine
from data import client

import hexapod_comp as hc
from hexapod_comp.measurements.campaign import template
from hexapod_comp.measurements.tidy import write_measurements
from hexapod_comp.virtual.instruments import measure

ROOT = Path(__file__).resolve().parents[1]
DOOR = ROOT / "hexapod_comp" / "__init__.py"


def examples() -> list[str]:
    """Return the Python blocks of the README that use the package."""
    blocks = re.findall(r"^```python\n(.*?)^```$", (ROOT / "README.md").read_text(encoding="utf-8"), re.M | re.S)
    return [block for block in blocks if "hexapod_comp" in block]


def test_type_checkers_are_told_the_same_names():
    """mypy sees the imports under TYPE_CHECKING, Python the table; both must have the same names."""
    (guarded,) = (node for node in ast.parse(DOOR.read_text(encoding="utf-8")).body if isinstance(node, ast.If))
    told = {}
    for node in guarded.body:
        if isinstance(node, ast.ImportFrom):
            (alias,) = node.names
            assert alias.asname == alias.name  # strict type checkers export only names with an alias
            told[alias.name] = node.module
    assert told == hc._HOME_OF


def test_modules_of_the_nodes_are_found_by_their_name_of_version_0_2(monkeypatch: pytest.MonkeyPatch):
    """One is imported, with the modules and the package that it imports; the others are found in the same way."""
    pytest.importorskip("rclpy")
    nodes = importlib.import_module("hexapod_comp.nodes")
    for name, module in [(name, value) for name, value in vars(nodes).items() if isinstance(value, ModuleType)]:
        monkeypatch.setattr(nodes, name, module)  # the import replaces them by modules with the other name
    assert importlib.import_module("hexapod_comp.nodes.process").run
    found = [importlib.util.find_spec(f"hexapod_comp.nodes.{one.name}") for one in pkgutil.iter_modules(nodes.__path__)]
    assert all(found)
    assert len(found) >= 10


@pytest.mark.parametrize("name", hc.__all__)
def test_every_public_name_is_there(name: str):
    value = getattr(hc, name)
    assert name == "__version__" or value.__name__ == name
    assert name == "__version__" or len(value.__doc__) > 20
    assert name in dir(hc)
    assert not (DOOR.parent / name).exists()  # a subpackage of this name would replace it once imported
    assert not (DOOR.parent / f"{name}.py").exists()


def test_the_documentation_lists_them_all():
    reference = (ROOT / "doc" / "api.md").read_text(encoding="utf-8")
    listed = re.findall(r"^ +~([\w.]+)\.(\w+)$", reference, re.MULTILINE)
    assert sorted(["__version__", *(name for _, name in listed)]) == sorted(hc.__all__)
    for home, name in listed:
        assert getattr(importlib.import_module(home), name) is getattr(hc, name)


def test_the_readmes_example_runs():
    """The example prints a correction for each strut, in µm, of a machine whose joints err by some 10 µm."""
    (example,) = examples()
    printed = io.StringIO()
    with contextlib.redirect_stdout(printed):
        exec(compile(example, "README.md", "exec"), {})
    numbers = [float(word) for word in re.findall(r"-?\d+\.?\d*(?:e[-+]\d+)?", printed.getvalue())]
    assert len(numbers) == 6
    assert 1.0 < np.abs(numbers).max() < 1000.0


def test_a_client_calibrates_and_compensates(tmp_path: Path, unsuspected: None):
    """A machine commanded by its own model reaches its pose: Newton leaves 1e-12 m, a thousandth of the tolerance."""
    coarse, measured = campaign(), tmp_path / "measured.csv"
    write_measurements(measure(template(coarse, paper(), 1, "coarse"), coarse, virtual_machine(1), 1), measured)
    report = client.calibrate("paper", [measured], tmp_path / "model.yaml")
    assert "expected tool error" in report
    poses = [hc.Pose.from_angles([x, 0.02, 0.45], np.radians([2.0, 0.0, 5.0])) for x in (-0.05, 0.0, 0.05)]
    for model in (tmp_path / "model.yaml", "paper_machine"):
        assert client.error_left("paper", model, poses) < 1e-9


def test_a_client_ranks_errors():
    """The screws' pitch comes first, as in the ranking in doc/classification.md."""
    assert client.worst_error("positioning_unit", "error_budget") == "screw pitch"
