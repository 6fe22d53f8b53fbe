"""A change of tool leaves the struts in place, and the next command must be where they are. How far a tool may go.

The truth is the zoo's own frames for the pose of the new tool, and for the travel the public check, pose by pose,
bisected here. Both stop within a billionth of a step; 1e-9 is far above it.
"""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from foreign_machines import Errors, Machine, rotation, with_frames

from hexapod_comp.compensation import travel as module
from hexapod_comp.compensation.checks import check
from hexapod_comp.compensation.compensator import Compensator
from hexapod_comp.compensation.travel import travel, travel_text
from hexapod_comp.core.batch import quaternion_of
from hexapod_comp.errors import FrameError, LimitError, PoseError
from hexapod_comp.machine.field import GridField
from hexapod_comp.machine.geometry import HexapodGeometry, load_geometry
from hexapod_comp.machine.model import MachineModel, RealMachine
from hexapod_comp.machine.model_file import load_model
from hexapod_comp.pose import Pose

ROUNDING = 1e-12
"""Tolerance of commands, m."""


@pytest.fixture(scope="module", params=["framed", "hanging", "mirror"])
def machine(request: pytest.FixtureRequest) -> Machine:
    return with_frames(request.param)


@pytest.fixture(scope="module")
def files(machine: Machine, tmp_path_factory: pytest.TempPathFactory) -> tuple[HexapodGeometry, MachineModel]:
    folder = tmp_path_factory.mktemp("machine")
    geometry = load_geometry(machine.write(folder / "machine.yaml"))
    return geometry, load_model(Errors.drawn(machine, 5).write(folder / "model.yaml", machine), geometry)


@pytest.fixture
def compensator(files: tuple[HexapodGeometry, MachineModel]) -> Compensator:
    return Compensator(*files)


def numbers(machine: Machine, tool: str | None, shift: float = 0.0) -> tuple[float, ...]:
    """Return the tool's pose in work, as numbers, with the platform at home, shifted along z by `shift`, m."""
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
    assert 5e-5 < np.abs(further - before).max() < 1.1e-4  # less than the tip moves, since the struts are oblique


@pytest.mark.parametrize("way", [2e-5, 4e-4, 3e-2])
def test_a_command_for_another_place_is_refused(way: float, machine: Machine, compensator: Compensator) -> None:
    """A command elsewhere is refused, even within one step: it was sent for the old tool."""
    before = compensator.step(numbers(machine, None), 1.0).copy()
    compensator.set_tool("probe")
    state = compensator.snapshot()
    for _ in range(2):
        with pytest.raises(
            LimitError, match=r"after the change to tool 'probe' the first command must not move the struts"
        ) as caught:
            compensator.step(numbers(machine, "probe", way), 1.01)
        assert caught.value.reason == "tool_changed"
    place = r"in work the tool is at x, y, z (.*), (.*), (.*) mm, alpha"
    named = re.search(rf": strut_\d would move by (\S+) mm, allowed 0\.01 mm; {place}", str(caught.value))
    assert named is not None
    moved, *place = map(float, named.groups())
    assert 0.5 * way < abs(moved) * 1e-3 < way  # less than the tip moves, since the struts are oblique
    at = 1e3 * np.array(numbers(machine, "probe")[:3])
    np.testing.assert_allclose(place, at, rtol=0.0, atol=5.1e-4)  # three decimals
    with pytest.raises(LimitError, match="after the change"):
        compensator.step(numbers(machine, None), 1.01)
    with pytest.raises(PoseError):
        compensator.step((0.0,) * 7, 1.01)
    np.testing.assert_equal(compensator.snapshot(), state)
    np.testing.assert_array_equal(compensator.command, before)
    compensator.step(numbers(machine, "probe"), 1.02)


def test_the_old_tool_may_come_back_and_a_reset_starts_anew(machine: Machine, compensator: Compensator) -> None:
    before = compensator.step(numbers(machine, None), 1.0).copy()
    compensator.set_tool("probe")
    compensator.set_tool("tool")
    np.testing.assert_array_equal(compensator.step(numbers(machine, None), 1.01), before)
    compensator.set_tool("probe")
    compensator.reset(before)
    np.testing.assert_allclose(compensator.step(numbers(machine, "probe", 5e-4), 1.02), before, rtol=0, atol=ROUNDING)


def test_estimates_and_records_are_those_of_the_tool(machine: Machine, compensator: Compensator) -> None:
    command = compensator.step(numbers(machine, None), 1.0).copy()
    for name in ("probe", "stub", "tool"):
        compensator.set_tool(name)
        tip = np.array(machine.home) + np.array(machine.using(name).tool.position)
        pose = compensator.estimate(command)
        np.testing.assert_allclose(pose[:3], tip, rtol=0.0, atol=1e-10)  # tolerance of Newton's method
        np.testing.assert_allclose(pose[3:].reshape(3, 3), machine.using(name).tool.matrix, rtol=0.0, atol=1e-10)
        used = compensator.geometry
        assert compensator.correct(used.tool_pose(compensator.platform)).tool == name


def test_a_snapshot_knows_its_tool(machine: Machine, compensator: Compensator) -> None:
    """A restored compensator has the snapshot's tool, and still needs a command where the struts are."""
    compensator.step(numbers(machine, None), 1.0)
    compensator.set_tool("probe")
    other = Compensator(compensator.geometry.using("tool"), compensator.model)
    other.restore(compensator.snapshot())
    np.testing.assert_equal(other.snapshot(), compensator.snapshot())
    with pytest.raises(LimitError, match="tool 'probe'"):
        other.step(numbers(machine, "probe", 1e-4), 1.01)
    np.testing.assert_array_equal(*(one.step(numbers(machine, "probe"), 1.01) for one in (other, compensator)))
    with pytest.raises(FrameError, match="no tool 'drill'; it has tool, probe, stub"):
        other.restore({**compensator.snapshot(), "tool": "drill"})


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


CLOSE = 1e-9
"""Tolerance of travels, m and rad."""

WAYS = [(axis, sign) for axis in range(6) for sign in (1, -1)]


def poses(start: np.ndarray, axis: int, ways: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return positions, m, and rotations after one of six coordinates (m, degrees) has changed by `ways`, SI."""
    at = np.tile(start, (len(ways), 1))
    at[:, axis] += ways if axis < 3 else np.degrees(ways)
    return at[:, :3], np.array([rotation(*angles) for angles in at[:, 3:]])


def allowed(geometry: HexapodGeometry, model: MachineModel, start: np.ndarray, ways: np.ndarray) -> np.ndarray:
    """Return which poses the check allows at distances `ways`, (12, n), SI, from a pose (m, degrees), along WAYS."""
    listed = [poses(start, axis, sign * row) for (axis, sign), row in zip(WAYS, ways, strict=True)]
    result = check(geometry, model, tuple(np.concatenate(part) for part in zip(*listed, strict=True)), "poses")
    good = np.ones(ways.size, dtype=bool)
    good[[breach.row for breach in result.breaches]] = False
    return good.reshape(ways.shape)


def by_check(geometry: HexapodGeometry, model: MachineModel, start: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the largest allowed distance and the first not allowed along each of WAYS, shape (12,), SI.

    Steps of 4 mm and 1°, up to half a turn, bracket it; bisection refines it.
    """
    step = np.array([4e-3 if axis < 3 else np.radians(1.0) for axis, _ in WAYS])
    low, ended, ahead = np.zeros(12), np.zeros(12, dtype=bool), 8
    while not ended.all():
        good = allowed(geometry, model, start, low[:, None] + step[:, None] * np.arange(1, ahead + 1))
        reached = np.where(good.all(axis=1), ahead, good.argmin(axis=1))
        low += np.where(ended, 0.0, reached * step)
        ended |= reached < ahead
    high = low + step
    while (high - low).max() > 0.01 * CLOSE:
        middle = 0.5 * (low + high)
        good = allowed(geometry, model, start, middle[:, None])[:, 0]
        low, high = np.where(good, middle, low), np.where(good, high, middle)
    return low, high


def compare(geometry: HexapodGeometry, model: MachineModel, start: np.ndarray) -> set[str]:
    """Compare each travel from a pose (m, degrees) with the check; return the limits that end the travels."""
    found = travel(RealMachine(geometry, model), Pose(start[:3], rotation(*start[3:])))
    names = ("x", "y", "z", "alpha", "beta", "gamma")
    assert [one.way for one in found] == [f"{sign}{name}" for name in names for sign in "+-"]
    low, high = by_check(geometry, model, start)
    np.testing.assert_allclose([one.distance for one in found], low, rtol=0.0, atol=CLOSE)
    for one, (axis, sign), beyond in zip(found, WAYS, high, strict=True):
        broken = check(geometry, model, poses(start, axis, sign * np.array([beyond + CLOSE])), "poses").breaches
        assert one.error is not None
        assert one.error.reason in {breach.limit for breach in broken}
    return {one.error.reason for one in found if one.error is not None}


def somewhere(machine: Machine) -> np.ndarray:
    """Return a tool pose in work, m and degrees, near home and with a turned attitude."""
    level = machine.work.matrix.T @ rotation(1.0, -2.0, 3.0) @ machine.tool.matrix
    alpha = np.arcsin(-level[1, 2])
    beta, gamma = np.arctan2(level[0, 2], level[2, 2]), np.arctan2(level[1, 0], level[1, 1])
    tip = machine.tips(np.array([machine.home]) + 0.004, rotation(1.0, -2.0, 3.0)[None])[0]
    return np.array([*tip, *np.degrees([alpha, beta, gamma])])


@pytest.mark.parametrize("name", ["framed", "hanging", "mirror", "left-hand"])
def test_every_way_ends_where_the_check_says(name: str, tmp_path: Path) -> None:
    machine = with_frames(name)
    limits = {"clearance_mm": 40} if name == "framed" else {}
    geometry = load_geometry(replace(machine, limits=limits).write(tmp_path / "machine.yaml"))
    model = load_model(Errors.drawn(machine, 5).write(tmp_path / "model.yaml", machine), geometry)
    compare(geometry.using("probe", "fixture"), model, somewhere(machine.using("probe", "fixture")))


def test_every_limit_is_met() -> None:
    """The example machine has every limit of single poses; each of them, tightened, ends some travel."""
    geometry = load_geometry("example_6_6.yaml")
    model, start = MachineModel(geometry.name), np.array([0.01, 0.02, 0.38, 1.0, 2.0, 15.0])
    met = set()
    for tight in ({}, {"base_cone": np.radians(np.full(6, 20.0))}, {"clearance": 0.128}, {"condition": 1.75}):
        limited = replace(geometry, limits=replace(geometry.limits, **tight))
        met |= compare(limited, model, start)
    assert met >= {"stroke", "base_cone", "platform_cone", "clearance", "condition", "correction"}


@pytest.mark.parametrize("outside", ["refuse", "hold"])
def test_the_end_of_a_field_counts_where_the_model_refuses_it(outside: str) -> None:
    """A field of zero error in a box of ±30 mm about home ends travels only if it refuses poses outside."""
    geometry = load_geometry("paper.yaml")
    nodes = tuple(np.array([-0.03, 0.03]) + middle for middle in geometry.home.position)
    field = GridField(nodes, tuple(np.zeros((2, 2, 2, 6, 1)) for _ in "xyz"), outside=outside)
    model = MachineModel(geometry.name, field=field)
    ways = {one.way: one for one in travel(RealMachine(geometry, model), geometry.tool_pose(geometry.home))}
    assert (ways["+x"].error.reason == "outside_field") == (outside == "refuse")
    if outside == "refuse":
        for name in ("+x", "-x", "+y", "-y", "+z", "-z"):
            assert ways[name].distance == pytest.approx(0.03, abs=CLOSE)
            assert ways[name].error.reason == "outside_field"


def test_a_turn_without_limit_ends(monkeypatch: pytest.MonkeyPatch) -> None:
    """Within 5° of home, here the longest turn, no limit of the paper's machine ends a travel."""
    monkeypatch.setattr(module, "LONGEST_TURN", np.radians(5.0))
    geometry = load_geometry("paper.yaml")
    found = travel(RealMachine(geometry, MachineModel("paper")), geometry.tool_pose(geometry.home))
    assert [(one.distance, one.error) for one in found[6:]] == [(np.radians(5.0), None)] * 6
    rows = [line.split() for line in travel_text(found).splitlines()]
    assert rows[0] == ["way", "travel", "unit"]
    assert " ".join(rows[1]) == " ".join(f"+x {found[0].distance * 1e3:.3f} mm {found[0].error}".split())
    assert rows[-1] == ["-gamma", "5.000", "deg", "no", "limit"]
    assert (found[0].key, found[-1].key, travel_text([])) == ("+x_mm", "-gamma_deg", "")


def test_with_compensation_off_the_model_does_not_count(tmp_path: Path) -> None:
    """With compensation off, travels that end at a nominal limit equal those of a machine without a model."""
    machine = with_frames("framed")
    geometry = load_geometry(machine.write(tmp_path / "machine.yaml"))
    model = load_model(Errors.drawn(machine, 5).write(tmp_path / "model.yaml", machine), geometry)
    pose = geometry.tool_pose(geometry.home)
    off = travel(RealMachine(geometry, model), pose, compensates=False)
    ideal = travel(RealMachine(geometry, MachineModel(geometry.name)), pose)
    on = travel(RealMachine(geometry, model), pose)
    differences = [abs(a.distance - b.distance) for a, b in zip(off, ideal, strict=True) if "nominal" in str(a.error)]
    assert differences
    assert max(differences) < CLOSE
    assert any(abs(a.distance - b.distance) > 1e-6 for a, b in zip(on, ideal, strict=True))


def test_a_pose_that_is_not_allowed_has_no_travel() -> None:
    geometry = load_geometry("paper.yaml")
    with pytest.raises(LimitError, match="stroke"):
        travel(RealMachine(geometry, MachineModel("paper")), Pose([0.0, 0.0, 1.2], np.eye(3)))
