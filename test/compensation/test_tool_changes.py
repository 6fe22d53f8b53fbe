"""A change of tool: the struts stay, and the next command must be where they are.

Truth: the zoo's own frames say which pose of the new tool is where the struts stand.
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
from foreign_machines import Errors, Machine, with_frames

from hexapod_comp.compensation.compensator import Compensator
from hexapod_comp.core.batch import quaternion_of
from hexapod_comp.errors import FrameError, LimitError, PoseError
from hexapod_comp.machine.geometry import load_geometry
from hexapod_comp.machine.model_file import load_model

ROUNDING = 1e-12
"""m; commands are found to that."""


@pytest.fixture(params=["framed", "hanging", "inches", "mirror"])
def machine(request: pytest.FixtureRequest) -> Machine:
    return with_frames(request.param)


@pytest.fixture
def compensator(machine: Machine, tmp_path: Path) -> Compensator:
    geometry = load_geometry(machine.write(tmp_path / "machine.yaml"))
    return Compensator(geometry, load_model(Errors.drawn(machine, 5).write(tmp_path / "model.yaml", machine), geometry))


def numbers(machine: Machine, tool: str | None, shift: float = 0.0) -> tuple[float, ...]:
    """Return the numbers of the tool's pose in work with the platform at home, but for a shift along z."""
    used = machine.using(tool)
    tip = np.array(machine.home) + np.array(used.tool.position) + [0.0, 0.0, shift]
    position = used.work.matrix.T @ (tip - np.array(used.work.position))
    return (*position.tolist(), *quaternion_of(used.work.matrix.T @ used.tool.matrix))


def test_the_struts_stay_and_go_on_from_there(machine: Machine, compensator: Compensator) -> None:
    before = compensator.step(numbers(machine, None), 1.0).copy()
    compensator.set_tool("probe")
    np.testing.assert_array_equal(compensator.command, before)
    after = compensator.step(numbers(machine, "probe"), 1.01)
    np.testing.assert_allclose(after, before, rtol=0.0, atol=ROUNDING)
    assert not compensator.ramping
    further = compensator.step(numbers(machine, "probe", 1e-4), 1.02)
    assert 5e-5 < np.abs(further - before).max() < 1.1e-4  # less than the tip: the struts stand askew


@pytest.mark.parametrize("way", [2e-5, 4e-4, 3e-2])
def test_a_command_for_another_place_is_refused(way: float, machine: Machine, compensator: Compensator) -> None:
    """Also one that a single step would allow: it was on its way for the old tool."""
    before = compensator.step(numbers(machine, None), 1.0).copy()
    compensator.set_tool("probe")
    state = compensator.snapshot()
    for _ in range(2):
        with pytest.raises(
            LimitError, match=r"since the change to tool 'probe' no command was where the struts"
        ) as caught:
            compensator.step(numbers(machine, "probe", way), 1.01)
        assert caught.value.reason == "tool_changed"
    named = re.search(r"in work the tool is at x, y, z (.*), (.*), (.*) mm, alpha", str(caught.value))
    assert named is not None
    at = 1e3 * np.array(numbers(machine, "probe")[:3])
    np.testing.assert_allclose([float(part) for part in named.groups()], at, rtol=0.0, atol=5.1e-4)  # as many digits
    with pytest.raises(LimitError, match="since the change"):
        compensator.step(numbers(machine, None), 1.01)
    with pytest.raises(PoseError):
        compensator.step((0.0,) * 7, 1.01)
    np.testing.assert_equal(compensator.snapshot(), state)
    np.testing.assert_array_equal(compensator.command, before)
    compensator.step(numbers(machine, "probe"), 1.02)


def test_a_reset_starts_anew_with_the_new_tool(machine: Machine, compensator: Compensator) -> None:
    measured = compensator.step(numbers(machine, None), 1.0).copy()
    compensator.set_tool("probe")
    compensator.reset(measured)
    np.testing.assert_allclose(compensator.step(numbers(machine, "probe", 5e-4), 1.01), measured, rtol=0, atol=ROUNDING)


def test_estimates_and_records_are_those_of_the_tool(machine: Machine, compensator: Compensator) -> None:
    command = compensator.step(numbers(machine, None), 1.0).copy()
    for name in ("probe", "stub", "tool"):
        compensator.set_tool(name)
        tip = np.array(machine.home) + np.array(machine.using(name).tool.position)
        pose = compensator.estimate(command)
        np.testing.assert_allclose(pose[:3], tip, rtol=0.0, atol=1e-10)  # Newton's method ends there
        np.testing.assert_allclose(pose[3:].reshape(3, 3), machine.using(name).tool.matrix, rtol=0.0, atol=1e-10)
        used = compensator.geometry
        assert compensator.correct(used.tool_pose(compensator.platform)).tool == name


def test_a_snapshot_knows_its_tool(machine: Machine, compensator: Compensator) -> None:
    """Also that no command was where the struts are yet."""
    compensator.step(numbers(machine, None), 1.0)
    compensator.set_tool("probe")
    other = Compensator(compensator.geometry.using("tool"), compensator.model)
    other.restore(compensator.snapshot())
    np.testing.assert_equal(other.snapshot(), compensator.snapshot())
    with pytest.raises(LimitError, match="tool 'probe'"):
        other.step(numbers(machine, "probe", 1e-4), 1.01)
    np.testing.assert_array_equal(*(one.step(numbers(machine, "probe"), 1.01) for one in (other, compensator)))
    old = {name: value for name, value in compensator.snapshot().items() if name != "tool"}
    other.restore(old)
    assert other.geometry.tool_name == "tool"
    with pytest.raises(FrameError, match="no tool 'drill'; it has tool, probe, stub"):
        other.restore({**old, "tool": "drill"})


def test_an_unknown_tool_changes_nothing(machine: Machine, compensator: Compensator) -> None:
    changes: list[tuple] = []
    compensator.on_change = lambda *change: changes.append(change)
    compensator.step(numbers(machine, None), 1.0)
    state = compensator.snapshot()
    with pytest.raises(FrameError, match="has no tool 'drill'"):
        compensator.set_tool("drill")
    np.testing.assert_equal(compensator.snapshot(), state)
    compensator.set_tool("stub")
    assert changes == [("tool", "stub")]
