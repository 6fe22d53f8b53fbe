"""The virtual machine's drives, encoders and faults.

The truth is the closed form of two equal real poles, the commanded lengths, and forward kinematics of known lengths.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from foreign_machines import machines

from hexapod_comp.errors import CommandError, ModelError
from hexapod_comp.machine.geometry import load_geometry
from hexapod_comp.machine.kinematics import solve_pose, strut_lengths
from hexapod_comp.machine.model import MachineModel, RealMachine
from hexapod_comp.machine.struts import StrutErrors
from hexapod_comp.virtual.machine import DriveParameters, Faults, StrutDrive, to_step

GEOMETRY = load_geometry("paper")
HOME = strut_lengths(GEOMETRY, GEOMETRY.home)
STEP = 1e-4 * np.array([1.0, -1.0, 2.0, -2.0, 3.0, -3.0])  # a move of the struts, m
SMOOTH: dict[str, Any] = {"step": 0.0, "encoder_resolution": 0.0, "encoder_noise": 0.0}


def drive_with(**parameters: Any) -> StrutDrive:
    return StrutDrive(RealMachine(GEOMETRY, MachineModel("paper")), DriveParameters(**{**SMOOTH, **parameters}))


IDEAL: dict[str, Any] = {"lag": 0.0, "max_speed": math.inf, "max_acceleration": math.inf}


def test_a_small_step_follows_two_equal_poles() -> None:
    """x(t) = c·(1 − (1 + 2t/lag)·e^(−2t/lag)); the integration step of lag/40 leaves 2 % of the step."""
    drive = drive_with(lag=0.008, max_speed=math.inf, max_acceleration=math.inf)
    drive.set_command(HOME + STEP)
    for n in range(1, 9):
        drive.advance(0.002)
        s = 2.0 * 0.002 * n / 0.008
        np.testing.assert_allclose((drive.motor_lengths() - HOME) / STEP, 1.0 - (1.0 + s) * np.exp(-s), atol=0.02)
        assert drive.time == pytest.approx(0.002 * n)
    assert not drive.stopped.any()


def test_at_constant_speed_a_motor_lags_by_lag_times_speed() -> None:
    drive = drive_with(lag=0.01)
    for n in range(1, 301):
        drive.set_command(HOME + 1e-5 * n)
        drive.advance(1e-3)
    np.testing.assert_allclose(drive.commands - drive.motor_lengths(), 0.01 * 0.01 - 0.5e-5, atol=1e-5)
    np.testing.assert_allclose(drive.encoder_speeds(), 0.01, rtol=1e-3)


def test_a_motor_ends_at_its_stop() -> None:
    drive = drive_with(stops=np.stack([HOME - 1e-3, HOME + 1e-4], axis=1))
    drive.set_command(HOME + STEP)
    drive.advance(1.0)
    np.testing.assert_allclose(drive.motor_lengths(), HOME + np.minimum(STEP, 1e-4), atol=1e-9)
    assert drive.stopped.tolist() == [False, False, True, False, True, False]


def test_faults() -> None:
    """A stuck motor stays, a lost encoder reads NaN; a strut longer than its encoder reads moves the pose."""
    drive = drive_with(**IDEAL)
    drive.faults = Faults(stuck=2, encoder_lost=4, longer=(0.0, 1e-4, 0.0, 0.0, 0.0, 0.0))
    drive.set_command(HOME + STEP)
    drive.advance(0.1)
    moved = HOME + STEP * [1, 1, 0, 1, 1, 1]
    np.testing.assert_allclose(drive.motor_lengths(), moved, atol=1e-15)
    nan = [1.0, 1.0, 1.0, 1.0, np.nan, 1.0]
    np.testing.assert_allclose(drive.encoder_lengths(), moved * nan, atol=1e-15)
    np.testing.assert_allclose(drive.encoder_speeds(), (moved - HOME) / 0.1 * nan, atol=1e-12)
    expected = solve_pose(GEOMETRY, moved + 1e-4 * np.eye(6)[1], GEOMETRY.home)
    np.testing.assert_allclose(drive.true_pose().position, expected.position, atol=1e-12)
    drive.faults = Faults()
    drive.advance(0.1)
    np.testing.assert_allclose(drive.encoder_lengths(), HOME + STEP, atol=1e-15)
    drive.advance(0.0)
    assert not drive.encoder_speeds().any()


def test_a_motor_that_jumps_is_moved_back() -> None:
    drive = drive_with()
    drive.faults = Faults(jump=(3, 1e-4))
    drive.advance(1e-3)
    off = drive.encoder_lengths() - HOME
    assert off[3] > 5e-5
    assert np.abs(np.delete(off, 3)).max() < 1e-12
    drive.advance(0.5)
    np.testing.assert_allclose(drive.encoder_lengths(), HOME, atol=1e-9)


def test_readings_arrive_late_or_never() -> None:
    drive, arrived = drive_with(**IDEAL), []
    drive.faults = Faults(feedback_delay=0.025)
    drive.set_command(HOME + STEP)
    for _ in range(4):
        drive.advance(0.01)
        arrived.append((drive.feedback_arrived, bool(np.allclose(drive.encoder_lengths(), HOME, atol=1e-12))))
    assert arrived == [(False, True)] * 3 + [(True, False)]
    drive.faults = Faults(feedback_drop=1.0)
    drive.set_command(HOME)
    drive.advance(0.01)
    drive.advance(10.0)
    assert not drive.feedback_arrived
    np.testing.assert_allclose(drive.encoder_lengths(), HOME + STEP, atol=1e-12)


def test_encoders_and_tracker_have_noise_in_counts() -> None:
    """Of 300 readings the standard deviation is known to 4 % (1 σ)."""
    drive = drive_with(encoder_noise=5e-6, encoder_resolution=1e-6, tracker_noise=3e-6)
    read, seen = [], []
    for _ in range(300):
        drive.advance(0.01)
        read.append(drive.encoder_lengths())
        seen.append(drive.tracker_pose().position)
    np.testing.assert_allclose(np.std(np.array(read) - HOME, axis=0), 5e-6, rtol=0.15)
    np.testing.assert_allclose(np.array(read) / 1e-6, np.rint(np.array(read) / 1e-6), atol=1e-6)
    np.testing.assert_allclose(np.std(seen, axis=0), 3e-6, rtol=0.15)
    np.testing.assert_allclose(np.mean(seen, axis=0), drive.true_tool_pose().position, atol=8e-7)
    assert to_step(np.array([1.4, 1.6]), 0.5).tolist() == [1.5, 1.5]
    assert to_step(np.array([1.4]), 0.0).tolist() == [1.4]


def test_the_tool_is_in_the_work_frame(tmp_path: Path) -> None:
    geometry = load_geometry(machines()["framed"].write(tmp_path / "framed.yaml"))
    drive = StrutDrive(RealMachine(geometry, MachineModel(geometry.name)), DriveParameters.ideal())
    drive.set_command(strut_lengths(geometry, geometry.home) + 1e-3)
    drive.advance(0.1)
    expected = geometry.tool_pose(drive.true_pose())
    for tool in (drive.true_tool_pose(), drive.tracker_pose()):
        np.testing.assert_allclose(tool.position, expected.position, atol=1e-12)
        np.testing.assert_allclose(tool.rotation, expected.rotation, atol=1e-12)


@pytest.mark.parametrize(
    ("made", "given", "problem"),
    [
        (drive_with, {"step": -1.0}, "drive.step: must be finite and not negative"),
        (drive_with, {"tracker_noise": math.inf}, "drive.tracker_noise: must be finite"),
        (drive_with, {"max_speed": 0.0}, "drive.max_speed: must be above zero, or inf for no limit"),
        (drive_with, {"lag": 0.9e-3}, "drive.lag: must be 0, or lie within 0.001…1 s"),
        (drive_with, {"lag": 1.1}, "drive.lag: must be 0, or lie within 0.001…1 s"),
        (drive_with, {"lag": 0.0, "max_speed": math.inf}, "drive.lag: 0 means a drive without dynamics: max_speed and"),
        (drive_with, {"stops": np.ones((5, 2))}, "drive.stops: must be finite numbers of shape (6, 2), m"),
        (drive_with, {"stops": np.tile([0.8, 0.4], (6, 1))}, "drive.stops of strut_1: must be two increasing lengths"),
        (drive_with, {"initial_lengths": [0.2, *HOME[1:]]}, "drive.initial_lengths of strut_1: must lie between the"),
        (Faults, {"stuck": 6}, "faults.stuck: must be a strut's index, 0…5, or None"),
        (Faults, {"encoder_lost": -1}, "faults.encoder_lost"),
        (Faults, {"jump": (0.5, 1e-3)}, "faults.jump: must be a strut's index"),
        (Faults, {"jump": (0, math.inf)}, "faults.jump: must be a finite distance, m"),
        (Faults, {"feedback_delay": 10.1}, "faults.feedback_delay: must lie within 0…10 s"),
        (Faults, {"feedback_drop": 1.1}, "faults.feedback_drop: must lie within 0…1"),
        (Faults, {"longer": (0.0,) * 5}, "faults.longer: must be finite numbers of shape (6,), m"),
    ],
)
def test_wrong_parameters_and_faults(made: Callable[..., object], given: dict[str, Any], problem: str) -> None:
    with pytest.raises(ModelError, match=re.escape(problem)):
        made(**given)
    Faults(stuck=0, encoder_lost=5, jump=(5, 0.0), feedback_delay=10.0, feedback_drop=1.0)
    for stops in ((HOME, HOME + 0.01), (HOME - 0.01, HOME)):
        drive_with(stops=np.stack(stops, axis=1), initial_lengths=HOME)


def test_wrong_commands_and_times() -> None:
    drive = drive_with(**IDEAL)
    with pytest.raises(CommandError, match=r"six strut lengths are needed, not shape \(5,\)"):
        drive.set_command(HOME[:5])
    with pytest.raises(CommandError, match="strut_3: length must be finite, not nan m"):
        drive.set_command(HOME * [1, 1, np.nan, 1, 1, 1])
    for dt in (-1e-9, 60.1):
        with pytest.raises(ModelError, match=r"dt: must lie within 0…60 s"):
            drive.advance(dt)
    drive.advance(60.0)
    assert drive.time == 60.0


def test_a_nut_stays_within_the_backlash() -> None:
    """After a motion by 1 mm a return by 30 µm is lost in a backlash of 40 µm; of 100 µm, 60 µm are left."""
    model = MachineModel("paper", struts=StrutErrors(backlash=np.full(6, 40e-6)))
    drive = StrutDrive(RealMachine(GEOMETRY, model), DriveParameters.ideal())
    assert drive.feedback_arrived
    lengths = []
    for back in (0.0, 30e-6, 100e-6):
        drive.set_command(HOME + 1e-3 - back)
        drive.advance(0.1)
        lengths.append(strut_lengths(GEOMETRY, drive.true_pose()))
    np.testing.assert_allclose(np.diff(lengths, axis=0), [[0.0] * 6, [-60e-6] * 6], atol=1e-10)
