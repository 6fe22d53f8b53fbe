"""The two shipped example models are what their tool makes, and are worth what they say."""

from pathlib import Path

import make_example_models as tool
import pytest
import yaml

from hexapod_comp.calibration.evaluation import evaluate_model
from hexapod_comp.machine.geometry import load_geometry
from hexapod_comp.machine.model import RealMachine
from hexapod_comp.machine.model_file import load_model

CONFIG = Path(__file__).parents[2] / "config"


def assert_same(found, expected, where: str) -> None:
    """Compare parsed YAML: texts and structure exactly, numbers to one last digit (1e-4 of a unit)."""
    if isinstance(expected, dict):
        assert list(found) == list(expected), where
        for key in expected:
            if key not in ("note", "sources"):
                assert_same(found[key], expected[key], f"{where}.{key}")
    elif isinstance(expected, list):
        assert len(found) == len(expected), where
        for index, (a, b) in enumerate(zip(found, expected, strict=True)):
            assert_same(a, b, f"{where}[{index}]")
    elif isinstance(expected, float):
        assert found == pytest.approx(expected, abs=1.01e-4 if "held_out" not in where else 2e-3), where
    else:
        assert found == expected, where


def test_shipped_files_are_what_the_tool_makes(tmp_path):
    """To the last digit or one beside it: another processor may round the laser lines differently."""
    tool.main(["--out", str(tmp_path)])
    for name in ("paper_machine.yaml", "paper_lines_model.yaml"):
        shipped, fresh = (yaml.safe_load((folder / name).read_text("utf-8")) for folder in (CONFIG, tmp_path))
        assert_same(fresh, shipped, name)


def test_lines_model_is_worth_what_its_file_says():
    """On the same held-out points; the paper's own figure, about 70 %, is reached on its own metric."""
    geometry = load_geometry("paper")
    truth, lines = (load_model(name, geometry) for name in ("paper_machine", "paper_lines_model"))
    found = evaluate_model(RealMachine(geometry, truth), lines, tool.BOX)
    assert lines.origin.held_out_residual == pytest.approx(found.after.raw.rms, abs=2e-9)
    assert found.after.raw.rms < found.before.raw.rms
    assert found.after.aligned.rms < 0.8 * found.before.aligned.rms
    assert found.paper.after < 0.3 * found.paper.before
