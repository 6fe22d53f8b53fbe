"""The compensator: its commands reach the pose, refusals change nothing, changes ramp; phases and limits of speed."""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from helpers import assert_defaults, assert_equal, distances, nominal_error
from scipy.spatial.transform import Rotation
from strategies import (
    UNEVEN_GRID,
    paper_geometry,
    random_field,
    random_model,
    random_pose,
    random_struts,
    skewed_geometry,
)

from hexapod_comp.compensation.compensator import TRANSITIONS, Compensator, Phase
from hexapod_comp.core import lib
from hexapod_comp.errors import HexapodError, LimitError, ModelError, NotFiniteError, OutsideFieldError, TooEarlyError
from hexapod_comp.formats.paths import config_file
from hexapod_comp.machine.field import GridField
from hexapod_comp.machine.geometry import HexapodGeometry, Limits, load_geometry
from hexapod_comp.machine.kinematics import strut_lengths
from hexapod_comp.machine.model import MachineModel
from hexapod_comp.machine.region import Region
from hexapod_comp.machine.struts import StrutErrors
from hexapod_comp.pose import Pose
from hexapod_comp.virtual.named import find_model

PAPER = paper_geometry()
WIDE = Limits(np.tile([0.1, 2.0], (6, 1)), np.full(6, np.pi), np.full(6, np.pi), 100.0, 0.02, 1.0, 1e3)
TOOL = Pose.from_angles([0.02, -0.01, -0.15], np.deg2rad([4.0, -7.0, 25.0]))
WORK = Pose.from_angles([0.05, 0.04, 0.1], np.deg2rad([2.0, 3.0, 40.0]))
FREE = replace(PAPER, limits=WIDE)
OFFSET = replace(FREE, tool=TOOL, work=WORK)
SKEWED = replace(skewed_geometry(lead=0.005), limits=WIDE)
IDEAL = MachineModel("paper")
RATE = 250.0
RAMP = 1e-3


def model_of(geometry: HexapodGeometry, seed: int) -> MachineModel:
    """Return a model in which every block has errors."""
    return random_model(np.random.default_rng(seed), geometry.name)


def tool_poses(geometry: HexapodGeometry, count: int, seed: int) -> list[Pose]:
    """Return tool poses in the work frame whose platform poses are near home."""
    rng = np.random.default_rng(seed)
    return [geometry.work.inverse() @ random_pose(rng, geometry.home) @ geometry.tool for _ in range(count)]


def shifted(pose: Pose, *by: float) -> Pose:
    return Pose(pose.position + np.array(by), pose.rotation)


def numbers_of(pose: Pose) -> tuple[float, ...]:
    """Return a pose in the form that ``step`` takes: position, then quaternion x, y, z, w by scipy."""
    return (*pose.position.tolist(), *Rotation.from_matrix(pose.rotation).as_quat().tolist())


@pytest.mark.parametrize("geometry", [FREE, OFFSET, SKEWED], ids=["paper", "tool and work", "6-6 with lead"])
def test_the_commands_bring_the_real_machine_to_the_pose(geometry: HexapodGeometry) -> None:
    """The forward model, by Newton from home, finds the commanded pose again: to 1e-13 m and 1e-12 rad."""
    compensator = Compensator(geometry, model_of(geometry, 1))
    for n, pose in enumerate(tool_poses(geometry, 50, 2)):
        record = compensator.correct(pose, n / RATE)
        actual, model_pose = compensator.machine.pose_for(record.command, record.sense, geometry.home)
        tool = geometry.work.inverse() @ actual @ geometry.tool
        assert np.abs(tool.position - pose.position).max() <= 1e-13
        assert Rotation.from_matrix(tool.rotation @ pose.rotation.T).magnitude() <= 1e-12
        np.testing.assert_allclose(model_pose.position, record.model_pose.position, atol=1e-13)
        np.testing.assert_allclose(record.command, record.nominal + record.correction, atol=1e-16)
        assert np.abs(record.correction).max() > 50e-6  # the model has errors of this size
        estimate, work = compensator.estimate(record.command), geometry.work  # from the encoders, in base
        np.testing.assert_allclose(estimate[:3], work.position + work.rotation @ pose.position, atol=2e-13)
        np.testing.assert_allclose(estimate[3:].reshape(3, 3), work.rotation @ pose.rotation, atol=1e-12)
        assert not record.ramping


def test_both_entries_give_the_same_commands() -> None:
    """``step`` with quaternions and ``correct`` with matrices give the same commands, also for a norm of 1.0009."""
    model = model_of(OFFSET, 6)
    by_pose, by_numbers, unnormalised = (Compensator(OFFSET, model) for _ in range(3))
    for n, pose in enumerate(tool_poses(OFFSET, 20, 6)):
        command = by_pose.correct(pose, n / RATE).command
        numbers = numbers_of(pose)
        np.testing.assert_allclose(by_numbers.step(numbers, n / RATE), command, atol=2e-15)
        longer = (*numbers[:3], *(1.0009 * q for q in numbers[3:]))
        np.testing.assert_allclose(unnormalised.step(longer, n / RATE), command, atol=2e-15)


@pytest.mark.parametrize("geometry", [FREE, OFFSET], ids=["paper", "tool and work"])
def test_the_predicted_error_is_right_to_first_order(geometry: HexapodGeometry) -> None:
    """The difference to the exact forward run with nominal lengths falls by four when the errors are halved."""
    rng = np.random.default_rng(8)
    deviations, offsets = rng.uniform(-1.0, 1.0, (2, 6, 3)), rng.uniform(-1.0, 1.0, 6)
    whole = random_field(np.random.default_rng(9), size=0.2)

    def difference(size: float) -> tuple[float, float]:
        lines = tuple(size * family for family in whole.lines)
        model = MachineModel(
            geometry.name,
            base_deviation=size * deviations[0],
            platform_deviation=size * deviations[1],
            struts=StrutErrors(offset=size * offsets),
            field=GridField(UNEVEN_GRID, lines),  # type: ignore[arg-type]
        )
        compensator = Compensator(geometry, model)
        record = compensator.correct(tool_poses(geometry, 1, 10)[0])
        taken = nominal_error(compensator.machine, record.platform_pose, record.sense) @ geometry.tool
        wanted = record.platform_pose @ geometry.tool
        turn = Rotation.from_matrix(taken.rotation @ wanted.rotation.T).as_rotvec()
        exact = np.concatenate([taken.position - wanted.position, turn])
        return float(np.abs(record.predicted_error - exact).max()), float(np.abs(exact).max())

    full, error = difference(1e-3)
    half, _ = difference(5e-4)
    assert error > 5e-4  # so large that its square is well above rounding
    assert 3.6 < full / half < 4.4
    assert full < 0.05 * error


def test_the_first_command_takes_the_mean_of_both_directions() -> None:
    """A strut with backlash b alone and command L is L − s·b/2 long, so the command is L + s·b/2; at first s = 0."""
    backlash = np.linspace(10e-6, 60e-6, 6)
    compensator = Compensator(FREE, MachineModel("paper", struts=StrutErrors(backlash=backlash)))
    first = compensator.correct(FREE.home)
    np.testing.assert_array_equal(first.sense, 0.0)
    np.testing.assert_allclose(first.correction, 0.0, atol=1e-16)
    for z, sign in ((1e-3, 1.0), (2e-3, 1.0), (1e-3, -1.0), (0.0, -1.0), (1e-3, 1.0)):
        record = compensator.correct(shifted(FREE.home, 0.0, 0.0, z))
        np.testing.assert_array_equal(record.sense[[2, 3, 4, 5, 6, 7, 8]], sign)
        np.testing.assert_allclose(record.correction, sign * backlash / 2.0, atol=1e-15)


def test_temperatures_in_closed_form() -> None:
    """Struts with command c are (1 + a·ΔT)·c long; joints move outwards by a·ΔT of their radius."""
    expansion = np.linspace(5e-6, 20e-6, 6)
    struts = StrutErrors(expansion=expansion)
    model = MachineModel("paper", struts=struts, base_expansion=11e-6, platform_expansion=23e-6)
    compensator = Compensator(FREE, model)
    readings = {"strut_1": 25.0, "strut_3": 12.0, "base": 22.0, "platform": 31.0}
    for name, value in readings.items():
        compensator.set_temperature(name, value)
    pose = tool_poses(FREE, 1, 11)[0]
    record = compensator.correct(pose)
    assert record.temperatures == readings
    joints = pose.position + (1.0 + 23e-6 * 11.0) * FREE.platform_joints @ pose.rotation.T
    lengths = np.linalg.norm(joints - (1.0 + 11e-6 * 2.0) * FREE.base_joints, axis=1)
    warmer = np.array([5.0, 0.0, -8.0, 0.0, 0.0, 0.0])
    np.testing.assert_allclose(record.command, lengths / (1.0 + expansion * warmer), atol=1e-15)


# Outside the field's box


def boxed(outside: str) -> MachineModel:
    field = random_field(np.random.default_rng(12), outside=outside)
    return MachineModel("paper", field=field, region=Region(np.array([[-0.1, -0.1, 0.35], [0.1, 0.1, 0.5]])))


def test_outside_the_field_is_held_and_said_or_refused() -> None:
    low, high = (np.array([axis[k] for axis in UNEVEN_GRID]) for k in (0, -1))
    beyond = Pose([0.0, 0.0, high[2] + 0.02], np.eye(3))
    record = Compensator(FREE, boxed("hold")).correct(beyond)
    assert record.outside_field
    assert not Compensator(FREE, boxed("hold")).correct(Pose((low + high) / 2.0, np.eye(3))).outside_field
    text = (
        "the measured point (0.000, 0.000, 570.000) mm is outside the field's box (-200, -150, 350)…(200, 200, 550) mm"
    )
    with pytest.raises(OutsideFieldError, match=f"^{re.escape(text)}, in base$"):
        Compensator(FREE, boxed("refuse")).correct(beyond)


def test_another_machines_model_is_refused() -> None:
    with pytest.raises(ModelError, match="is for machine 'other'"):
        Compensator(FREE, MachineModel("other"))
    compensator = Compensator(FREE, IDEAL)
    with pytest.raises(ModelError, match="is for machine 'other'"):
        compensator.set_model(MachineModel("other"))
    assert compensator.model is IDEAL
    assert not compensator.ramping


# A refused command changes nothing


def standing(limits: Limits = PAPER.limits, outside: str = "hold") -> Compensator:
    """Return a compensator in motion, with all blocks of a model and a ramp in progress."""
    rng = np.random.default_rng(13)
    model = replace(
        random_model(rng, "paper"),
        struts=replace(random_struts(rng), offset=rng.uniform(-1e-4, 1e-4, 6), pitch=np.zeros(6)),
        field=random_field(rng, outside=outside),
    )
    compensator = Compensator(replace(PAPER, limits=limits), model, RAMP)
    for n in range(5):
        compensator.correct(shifted(PAPER.home, 0.0, 2e-4 * n, -1e-4 * n), n / RATE)
    compensator.enable(False)
    compensator.correct(shifted(PAPER.home, 0.0, 1e-3, -5e-4), 5.0 / RATE)
    return compensator


LARGE_STEPS = replace(PAPER.limits, step=1.0)
STANDING_STILL = (0.0, 0.0, 0.4, 0.0, 0.0, 0.0)

REFUSED: dict[str, tuple[Limits, Pose | tuple[float, ...]]] = {
    "stroke": (LARGE_STEPS, Pose([0.0, 0.0, 0.9], np.eye(3))),
    "base_cone": (replace(LARGE_STEPS, base_cone=np.full(6, 0.1)), Pose([0.1, 0.0, 0.4], np.eye(3))),
    "platform_cone": (
        replace(LARGE_STEPS, platform_cone=np.full(6, 0.2)),
        Pose.from_angles([0.0, 0.0, 0.4], [0.3, 0.0, 0.0]),
    ),
    "condition": (replace(LARGE_STEPS, condition=1.3), Pose([0.0, 0.0, 0.65], np.eye(3))),
    "step": (PAPER.limits, shifted(PAPER.home, 0.0, 0.0, 0.01)),
    "outside_field": (LARGE_STEPS, Pose([0.0, 0.0, 0.6], np.eye(3))),
    "not_finite": (PAPER.limits, (*STANDING_STILL, np.nan)),
    "quaternion": (PAPER.limits, (*STANDING_STILL, 1.01)),
    "bad_pose": (PAPER.limits, STANDING_STILL),
}
TEXTS = {
    "not_finite": r"^pose must be finite \(found \[0\.0, 0\.0, 0\.4, 0\.0, 0\.0, 0\.0, nan\]\)$",
    "quaternion": r"^quaternion must have norm 1 within 0\.001, not 1\.01 \(found \[0\.0, 0\.0, 0\.0, 1\.01\]\)$",
    "bad_pose": "^position and quaternion are seven numbers, not 6 ",
}


def assert_no_trace(make: Callable[[], Compensator], refuse: Callable[[Compensator], None]) -> None:
    """Compare with a compensator that did not get the refused command, also over the ramp that follows."""
    tried, twin = make(), make()
    refuse(tried)
    np.testing.assert_array_equal(tried.command, twin.command)
    np.testing.assert_array_equal(tried.predicted_error(), twin.predicted_error())
    for n in range(6, 40):
        pose = shifted(PAPER.home, 1e-4 * (n - 6), 1e-3, -5e-4)
        assert_equal(tried.correct(pose, n / RATE), twin.correct(pose, n / RATE))


@pytest.mark.parametrize("reason", REFUSED)
def test_a_refused_command_leaves_no_trace(reason: str) -> None:
    limits, pose = REFUSED[reason]

    def refuse(compensator: Compensator) -> None:
        for _ in range(3):
            with pytest.raises(HexapodError, match=TEXTS.get(reason)) as caught:
                compensator.step(numbers_of(pose) if isinstance(pose, Pose) else pose, 5.5 / RATE)
            assert caught.value.reason == reason

    assert_no_trace(lambda: standing(limits, "refuse" if reason == "outside_field" else "hold"), refuse)


# The first command after a reset


def test_the_first_command_is_at_most_a_step_from_the_measured_struts() -> None:
    lengths = distances(PAPER, PAPER.home)
    compensator = Compensator(PAPER, IDEAL)
    compensator.reset(lengths + 2.001e-3)
    with pytest.raises(LimitError, match=r"compensated length would change by -2\.0010 mm") as caught:
        compensator.correct(PAPER.home)
    assert (caught.value.reason, caught.value.stage) == ("step", "compensated")
    compensator.reset(lengths + 1.999e-3)
    compensator.correct(PAPER.home)
    compensator.reset()
    compensator.correct(shifted(PAPER.home, 0.0, 0.0, 0.1))  # without measured lengths there is no limit of the step


@pytest.mark.parametrize("measured", [np.full(6, np.nan), np.zeros(5), np.full(6, np.inf)], ids=["NaN", "five", "∞"])
def test_measured_lengths_that_are_none_are_refused(measured: np.ndarray) -> None:
    compensator = Compensator(PAPER, IDEAL)
    compensator.correct(PAPER.home)
    before = compensator.command.copy()
    with pytest.raises(NotFiniteError, match="six finite numbers"):
        compensator.reset(measured)
    np.testing.assert_array_equal(compensator.command, before)


@pytest.mark.parametrize("backlash", [0.0, 20e-6], ids=["none", "backlash"])
def test_a_restarted_compensator_starts_from_the_measured_struts(backlash: float) -> None:
    """At rest, the first command equals the measured lengths, and the following ones ramp to those of a fresh start.

    Before the restart a motion has left every strut at the forward side of its backlash.
    """
    model = MachineModel("paper", struts=StrutErrors(offset=np.full(6, 70e-6), backlash=np.full(6, backlash)))
    before = Compensator(PAPER, model, RAMP)
    for n in range(10):
        measured = before.correct(shifted(PAPER.home, 0.0, 0.0, 1e-4 * n), n / RATE).command + 0.3e-6
    pose = shifted(PAPER.home, 0.0, 0.0, 9e-4)
    again = Compensator(PAPER, model, RAMP)
    again.reset(measured)
    sent = [again.correct(pose, 7.0 + n / RATE).command for n in range(500)]
    np.testing.assert_allclose(sent[0], measured, rtol=0.0, atol=1e-15)
    assert (np.abs(np.diff(sent, axis=0)) <= RAMP / RATE + 1e-15).all()
    assert not again.ramping
    np.testing.assert_allclose(sent[-1], Compensator(PAPER, model).correct(pose).command, rtol=0.0, atol=1e-15)


def test_a_refused_first_command_leaves_the_start_from_the_measured_struts() -> None:
    """After impossible first commands, a valid command still starts from the measured lengths."""
    compensator = standing()
    measured = compensator.command + 5e-6
    compensator.reset(measured)
    state = compensator.snapshot()
    for bad in (shifted(PAPER.home, 0.0, 0.0, 0.05), shifted(PAPER.home, 0.0, 0.0, 5.0)):
        with pytest.raises(LimitError):
            compensator.correct(bad, 1.0)
    assert repr(compensator.snapshot()) == repr(state), "NaN differs from itself"
    np.testing.assert_allclose(compensator.correct(PAPER.home, 1.0).command, measured, rtol=0.0, atol=1e-15)


# Changes ramp


def changed_model(compensator: Compensator) -> None:
    compensator.set_model(replace(compensator.model, base_deviation=np.full((6, 3), 80e-6)))


CHANGES = {
    "disable": lambda c: c.enable(False),
    "model": changed_model,
    "warmer": lambda c: c.set_temperature("base", 45.0),
    "colder": lambda c: c.set_temperature("base", 5.0),
}
"""The new model and the cold base shorten the model's struts at once while in fact they lengthen: this jump must not
count as a reversal."""


def running(seed: int = 14) -> Compensator:
    compensator = Compensator(FREE, model_of(FREE, seed), RAMP)
    compensator.correct(shifted(FREE.home, 0.0, 0.0, -1e-3), -1.0)
    compensator.correct(FREE.home, 0.0)
    return compensator


@pytest.mark.parametrize("change", CHANGES.values(), ids=CHANGES.keys())
def test_a_change_at_rest_ramps_at_its_rate_and_arrives(change: Callable[[Compensator], None]) -> None:
    """No command moves a strut by more than rate · time, and the largest change takes its size over the rate."""
    compensator = running()
    start = compensator.command.copy()
    change(compensator)
    assert compensator.ramping
    commands = [start]
    for n in range(1, 2000):
        record = compensator.correct(FREE.home, n / RATE)
        commands.append(record.command)
        if not record.ramping:
            break
    moved = np.abs(np.diff(commands, axis=0))
    assert moved.max() <= RAMP / RATE * (1.0 + 1e-9)
    largest = np.abs(commands[-1] - start).max()
    assert largest > 20e-6
    assert len(moved) == pytest.approx(largest / (RAMP / RATE), abs=1.5)
    settled = compensator.correct(FREE.home, n / RATE + 1.0)
    np.testing.assert_array_equal(settled.command, commands[-1])
    if compensator.enabled:
        motion_free = compensator.machine.pose_for(settled.command, settled.sense, FREE.home)[0]
        np.testing.assert_allclose(motion_free.position, FREE.home.position, atol=1e-13)
    else:
        np.testing.assert_allclose(settled.command, settled.nominal, atol=1e-16)


@pytest.mark.parametrize("change", [CHANGES["model"], CHANGES["colder"]], ids=["model", "colder"])
def test_a_change_in_motion_adds_no_step(change: Callable[[Compensator], None]) -> None:
    """While the pose moves, a command moves by no more than the pose's own motion plus the ramp.

    The pose's own motion is that of a compensator without the change, ± 1 % for the slope of the models' corrections
    (pitch errors are below 0.1 %, fields below that).
    """
    compensator, undisturbed = running(), running()
    last, plain_last = compensator.command.copy(), undisturbed.command.copy()
    for n in range(1, 700):
        pose = shifted(FREE.home, 2e-5 * n, 1e-5 * n, 3e-5 * n)
        if n == 5:
            change(compensator)
        plain = undisturbed.correct(pose, n / RATE).command
        command = compensator.correct(pose, n / RATE).command
        pose_part = np.abs(plain - plain_last).max()
        assert np.abs(command - last).max() <= 1.01 * pose_part + RAMP / RATE
        last, plain_last = command, plain
    assert not compensator.ramping
    for wrong in (0.0, np.inf):
        with pytest.raises(HexapodError, match="ramp_rate must be positive and finite, m/s, not"):
            compensator.set_ramp_rate(wrong)


@pytest.mark.parametrize("late", [100.0, -5.0], ids=["a long pause", "the clock runs backwards"])
def test_a_late_command_does_not_step(late: float) -> None:
    compensator = running()
    last = compensator.command.copy()
    compensator.enable(False)
    command = compensator.correct(FREE.home, late).command
    assert np.abs(command - last).max() <= RAMP * lib.LONGEST_RAMP_STEP * (1.0 + 1e-9)


STATES = Path(__file__).resolve().parents[2] / "doc" / "states.md"


@pytest.mark.parametrize("seed", range(4))
def test_the_core_keeps_to_the_table(seed):
    """Two hundred events in random order change the phase as the table has it; refused commands do not change it."""
    geometry = load_geometry(config_file("paper.yaml"))
    rng, seen = np.random.default_rng(seed), set()
    ideal, random = (find_model(name, geometry) for name in ("ideal", f"random:{seed}"))
    compensator = Compensator(geometry, random, 1e-4)
    home, now = geometry.tool_pose(geometry.home), 0.0
    at_home = strut_lengths(geometry, geometry.home)
    for _ in range(200):
        before, event = compensator.phase, ""
        draw = rng.integers(8)
        if draw < 3:
            now += rng.choice([0.004, 0.3])
            shifted = type(home)(
                home.position + rng.choice([0.0, 1e-4, 0.1]) * np.array([0.0, 0.0, 1.0]), home.rotation
            )
            try:
                compensator.correct(shifted, now)
                event = "ramped" if compensator.ramping else "command"
            except HexapodError:
                assert compensator.phase is before, "a refused command changes nothing"
                continue
        elif draw == 3:
            compensator.set_tool(geometry.tool_name)
            event = "tool"
        elif draw == 4:
            compensator.reset()
            event = "reset"
        elif draw == 5:
            compensator.reset(at_home)
            event = "reset to struts"
        elif draw == 6:
            compensator.set_temperature("strut_1", 20.0 + rng.uniform(1.0, 2.0), now)
            event = "change"
        else:
            compensator.set_model(ideal if compensator.model is random else random)
            event = "change"
        assert compensator.phase is TRANSITIONS[before][event], (before, event)
        seen.add((before, event))
    assert len(seen) >= 15


def test_the_page_shows_the_table():
    rows = re.findall(r"^\| ([A-Z_]+) \| ([^|]+) \|(.*)\|$", STATES.read_text(encoding="utf-8"), re.M)
    events = ("reset", "reset to struts", "tool", "change", "command", "ramped")
    shown = {
        Phase[name]: (text, {event: Phase[cell.strip()] for event, cell in zip(events, cells.split("|"), strict=True)})
        for name, text, cells in rows
    }
    assert shown == {phase: (phase.value, TRANSITIONS[phase]) for phase in Phase}


SPEED = 0.25
"""Limit of the paper machine's strut speed, m/s."""

UPRIGHT = (0.0, 0.0, 0.0, 1.0)
RISE = 1e-3 / 0.789
"""Rise of the tool from home, m, that lengthens struts by 1 mm; they are 507 mm long at a height of 400 mm."""


def ideal(**limits: float) -> Compensator:
    return Compensator(replace(PAPER, limits=replace(PAPER.limits, **limits)), MachineModel("paper"))


def at(rise: float) -> tuple[float, ...]:
    return (0.0, 0.0, 0.4 + rise, *UPRIGHT)


def test_a_stream_at_the_limit_passes_by_its_stamps():
    """Streams of 4 ms and 1 ms pass at 0.999 of the limit; at 1.02 they end once they are 5 ms of motion ahead."""
    for period, count in ((4e-3, 300), (1e-3, 600)):
        for share, ends in ((0.999, False), (1.02, True)):
            compensator, told = ideal(), list[float]()
            with pytest.raises(LimitError, match="by time stamps, allowed 250 mm/s") if ends else nullcontext():
                for n in range(count):
                    told.append(compensator.step(at(rise_of(share * SPEED * period * n)), period * n)[0])
            ahead = len(told) * period * 0.02
            assert (len(told) == count) != ends
            assert not ends or ahead == pytest.approx(5e-3, abs=2 * period * 0.02), "5 ms of motion"


def rise_of(lengthening: float) -> float:
    """Return the rise of the tool from home, m, for a lengthening of the struts, m (Pythagoras)."""
    start = float(np.linalg.norm(PAPER.base_joints[0] - (PAPER.platform_joints[0] + [0.0, 0.0, 0.4])))
    flat = start**2 - 0.4**2
    return math.sqrt((start + lengthening) ** 2 - flat) - 0.4


def test_a_clock_that_is_set_back_or_stands_tells_no_speed():
    """If a stamp is earlier than the last one, or missing, the time of receipt limits the speed."""
    compensator = ideal()
    compensator.step(at(0.0), 100.0, None, 7.0)
    compensator.step(at(RISE), 50.0, None, 7.01)
    compensator.step(at(2.0 * RISE), math.nan, None, 7.02)
    with pytest.raises(TooEarlyError):
        compensator.step(at(3.5 * RISE), math.nan, None, 7.021)
    compensator.step(at(3.5 * RISE), math.nan, None, 7.03)


def test_too_early_a_command_says_how_long_it_must_wait_and_nothing_has_changed():
    compensator = ideal()
    compensator.step(at(0.0), math.nan, None, 0.0)
    compensator.published(0.0)
    before = compensator.snapshot()
    with pytest.raises(TooEarlyError, match=r"strut_\d: .* ms too early for the speed limit of 250 mm/s") as caught:
        compensator.step(at(rise_of(1.5e-3)), math.nan, None, 1e-3)
    assert caught.value.wait == pytest.approx(6e-3 - 1e-3 - 8e-4, abs=1e-6), "1.5 mm take 6 ms"
    assert caught.value.reason == "speed"
    np.testing.assert_equal(compensator.snapshot(), before)
    compensator.step(at(rise_of(1.5e-3)), math.nan, None, 1e-3 + caught.value.wait + 1e-9)


@pytest.mark.parametrize("seed", range(3))
def test_nothing_that_comes_makes_the_struts_faster_than_the_limit(seed):
    """Over 20 ms the struts never move faster than 1.05 of the limit, with commands at random times and in bunches.

    Some publications are up to 30 ms late, as with a busy processor, and resets go to measured struts.
    """
    rng = np.random.default_rng(seed)
    compensator, published = ideal(), list[tuple[float, np.ndarray]]()
    now, rise, direction = 0.0, 0.0, 1.0
    for _ in range(3000):
        now += float(rng.choice([1e-5, 2e-4, 1e-3, 5e-3, 0.1], p=[0.6, 0.2, 0.15, 0.04, 0.01]))
        if published and rng.uniform() < 0.01:
            compensator.reset(published[-1][1])
        direction = -direction if abs(rise + 0.02 * direction) > 0.05 else direction
        wanted = rise + direction * rng.uniform(-2e-4, 2e-3)
        try:
            lengths = compensator.step(at(wanted), math.nan if rng.uniform() < 0.5 else now * 3.0, None, now)
        except HexapodError:
            continue
        rise = wanted
        published.append((now + (rng.uniform(0.0, 0.03) if rng.uniform() < 0.02 else 1e-4), lengths.copy()))
        now = published[-1][0]
        compensator.published(now)
    times = np.array([at for at, _ in published])
    lengths = np.array([lengths for _, lengths in published])
    assert len(times) > 250
    begins = np.searchsorted(times, times - 0.02, side="right") - 1
    ends = np.flatnonzero(begins >= 0)
    speeds = np.abs(lengths[ends] - lengths[begins[ends]]).max(axis=1) / (times[ends] - times[begins[ends]])
    assert 0.8 * SPEED < speeds.max() <= 1.05 * SPEED


def test_a_constant_acceleration_passes_as_what_it_is():
    """With a limit of 2 m/s², 1.99 passes at 1 kHz and 250 Hz; 2.05 and a jump of the speed by 50 mm/s do not."""
    for period in (1e-3, 4e-3):
        for acceleration, ends in ((1.99, False), (2.05, True)):
            compensator = ideal(acceleration=2.0)
            with pytest.raises(LimitError, match="acceleration") if ends else nullcontext():
                for n in range(int(0.1 / period)):
                    compensator.step(at(rise_of(0.5 * acceleration * (period * n) ** 2)), period * n)
        compensator = ideal(acceleration=2.0)
        compensator.step(at(0.0), 0.0)
        compensator.step(at(0.0), period)
        with pytest.raises(LimitError, match=r"strut_\d: acceleration .* mm/s² by time stamps, allowed 2000 mm/s²"):
            compensator.step(at(rise_of(0.05 * period)), 2.0 * period)


@pytest.mark.parametrize("received", [(math.nan, math.nan), (0.0, 0.02)], ids=["no clock", "receipt"])
def test_no_acceleration_is_computed_without_stamps(received):
    """1.4 mm in one command: `correct` without times limits no speeds, and times of receipt jitter (doc/nodes.md).

    Without any time the core took 0.1 ms for the time between two commands, which makes 5e6 mm/s² of 1 mm.
    """
    compensator = ideal(acceleration=2.0)
    for rise, time in zip((0.0, 1.4e-3), received, strict=True):
        compensator.step(at(rise_of(rise)), math.nan, received=time)


def test_compensation_is_switched_on_and_a_model_is_taken_while_struts_move():
    """The struts' own acceleration does not count as one of the correction (the C core refused both changes before)."""
    compensator = ideal(acceleration=2.0)
    for n in range(40):
        compensator.step(at(rise_of(0.5 * 1.9 * (1e-3 * n) ** 2)), 1e-3 * n)
    compensator.enable(False)
    compensator.enable(True)
    compensator.set_model(compensator.model)
    assert compensator.enabled


def test_defaults():
    assert_defaults(__file__)
