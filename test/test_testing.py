"""The test kit for integrators: the example of its page, run by pytest in a separate process."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

pytest.importorskip("rclpy")

ROOT = Path(__file__).resolve().parents[1]
# At home the struts of the paper's machine have equal lengths, by symmetry; at the start with the encoders' 0.1 µm
ASKED = """

def test_a_command_from_the_test(hexapod):
    from hexapod_comp import Pose

    hexapod.machine()
    lengths = hexapod.ask(Pose.from_angles([0.0, 0.0, 0.4], [0.0, 0.0, 0.0])).command.position
    assert len(lengths) == 6 and max(lengths) - min(lengths) < 1e-6
"""


def test_the_documented_example_passes_and_a_wrong_controller_fails(tmp_path: Path) -> None:
    page = (ROOT / "doc" / "testing.md").read_text(encoding="utf-8")
    (example,) = re.findall(r"```python\n(.*?)```", page, re.S)
    (tmp_path / "test_right.py").write_text(example + ASKED, encoding="utf-8")
    wrong = (
        example.partition("def test_a_stuck_strut")[0]
        .replace("0.395", "0.396", 1)
        .replace('at 395 mm")', 'at 395 mm", 1.0)')
    )
    (tmp_path / "test_wrong.py").write_text(wrong, encoding="utf-8")
    command = [sys.executable, "-m", "pytest", "-q", "-p", "hexapod_comp.testing", "-p", "no:cacheprovider"]
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    run = subprocess.run([*command, "--rootdir", tmp_path, tmp_path], env=environment, capture_output=True, text=True)
    assert "1 failed, 3 passed" in run.stdout, run.stdout
    (failed,) = re.findall(r"^FAILED .*/(\S+)", run.stdout, re.M)
    assert failed == "test_wrong.py::test_the_tool_arrives"
    assert "TimeoutError: did not happen within 1.0 s: the tool at 395 mm" in run.stdout, run.stdout
