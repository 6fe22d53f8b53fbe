"""The virtual machine: drives, play, instruments, faults and drawn imperfections.

Truth comes from closed forms (second-order step response, play of a sine, uniform quantisation error) and
from the forward kinematics, which has its own tests.
"""

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from hexapod_comp.errors import CommandError, KinematicsError, ModelError
from hexapod_comp.kernels.drives import wanted_speed
from hexapod_comp.machine.geometry import HexapodGeometry, load_geometry
from hexapod_comp.machine.kinematics import Structure, solve_pose, strut_lengths
from hexapod_comp.machine.model import MachineModel, RealMachine
from hexapod_comp.machine.motion import MotionState
from hexapod_comp.machine.struts import StrutErrors
from hexapod_comp.pose import Pose
from hexapod_comp.virtual.imperfections import ImperfectionBounds, draw_model
from hexapod_comp.virtual.machine import DriveParameters, Faults, StrutDrive

CONFIG = Path(__file__).parents[2] / "config"
BOX = np.array([[-0.2032, -0.2032, 0.350], [0.2032, 0.2032, 0.5532]])
BACKLASH = 4e-6
QUIET = DriveParameters(step=0.0, encoder_resolution=0.0, encoder_noise=0.0)


@pytest.fixture(scope="module")
def geometry() -> HexapodGeometry:
    return load_geometry(CONFIG / "paper.yaml")


@pytest.fixture(scope="module")
def ideal(geometry) -> RealMachine:
    return RealMachine(geometry, MachineModel(geometry.name))


@pytest.fixture(scope="module")
def loose(geometry) -> RealMachine:
    """Perfect but for its backlash."""
    struts = StrutErrors(backlash=np.full(6, BACKLASH))
    return RealMachine(geometry, MachineModel(geometry.name, struts=struts))


def run(drive: StrutDrive, seconds: float, dt: float = 1e-3) -> np.ndarray:
    """Advance and return the motor positions after each step, shape (n, 6)."""
    track = []
    for _ in range(round(seconds / dt)):
        drive.advance(dt)
        track.append(drive.motor_lengths())
    return np.array(track)


class TestMotion:
    @pytest.mark.parametrize("dt", [2.5e-4, 1e-3, 4e-3, 0.037])
    def test_speed_and_acceleration_stay_within_their_limits(self, ideal, dt):
        """Mean speeds between samples cannot exceed the speed limit, nor their change the acceleration's.

        The commands change without regard to what the drive can follow. 1e-9 covers rounding: positions of
        0.5 m are known to 1e-16, divided by dt² ≥ 6e-8.
        """
        drive = StrutDrive(ideal, replace(QUIET, max_speed=0.1, max_acceleration=2.0))
        rng = np.random.default_rng(1)
        start, track = drive.motor_lengths(), [drive.motor_lengths()]
        for k in range(400):
            if k % 20 == 0:
                drive.set_command(start + rng.uniform(-0.1, 0.1, 6))
            drive.advance(dt)
            track.append(drive.motor_lengths())
        # Time that is no whole number of ticks is kept back, so a sample is up to one tick out of step.
        ticks = dt / drive._tick
        slack = 0.0 if ticks == round(ticks) else drive._tick / dt
        speeds = np.diff(track, axis=0) / dt
        assert np.abs(speeds).max() <= 0.1 * (1.0 + slack) + 1e-9
        if slack == 0.0:
            assert np.abs(np.diff(speeds, axis=0)).max() / dt <= 2.0 + 1e-6
        if dt * 20 > 0.05 + 0.1:  # long enough between commands to get up to speed
            assert np.abs(speeds).max() > 0.09

    @pytest.mark.parametrize("distance", [3e-7, 1e-5, 1e-3, 0.05, -0.05])
    @pytest.mark.parametrize(("lag", "acceleration"), [(0.01, 10.0), (0.002, 10.0), (0.05, 1.0)])
    def test_settles_on_the_nearest_step_and_stays(self, ideal, distance, lag, acceleration):
        """No overshoot, no limit cycle: motion is monotonic and ends bit-exactly on the nearest multiple."""
        step = 1e-6
        drive = StrutDrive(ideal, replace(QUIET, step=step, lag=lag, max_acceleration=acceleration))
        command = drive.motor_lengths() + distance
        drive.set_command(command)
        track = run(drive, 2.5, 4e-3)
        steps = np.diff(track, axis=0) * math.copysign(1.0, distance)
        assert steps.min() >= 0.0
        assert (track[-50:] == track[-1]).all()
        assert np.abs(track[-1] / step - np.rint(track[-1] / step)).max() < 1e-9
        assert np.abs(track[-1] - command).max() <= step / 2 + 1e-15

    def test_small_step_follows_the_closed_form(self, ideal):
        """Two equal poles at 2/lag: c·(1 − (1 + 2t/lag)·exp(−2t/lag)).

        The drive runs in ticks of lag/40; Euler steps of that length are off by about half a tick, at most
        0.0184·c (half a tick times the steepest slope, 0.736·c/lag, twice for the two integrations).
        """
        lag, size = 0.01, 1e-6
        drive = StrutDrive(ideal, replace(QUIET, lag=lag, max_acceleration=math.inf))
        start = drive.motor_lengths()[2]
        drive.set_command(drive.commands + size)
        track = run(drive, 0.05)[:, 2] - start
        t = 1e-3 * np.arange(1, 51)
        closed = size * (1.0 - (1.0 + 2.0 * t / lag) * np.exp(-2.0 * t / lag))
        assert np.abs(track - closed).max() < 0.0184 * size

    @pytest.mark.parametrize(("lag", "speed"), [(0.01, 0.02), (0.01, 0.05), (0.002, 0.01), (0.05, -0.1)])
    def test_steady_lag_is_the_parameter(self, ideal, lag, speed):
        """Behind a steadily moving command by lag·speed, as stated, up to max_acceleration·lag/2.

        After 20 lags the transient has died to exp(−40); 1e-9 m is far above that and below 1e-4 of the lag.
        """
        drive = StrutDrive(ideal, replace(QUIET, lag=lag))
        start, tick = drive.motor_lengths(), drive._tick
        for k in range(round(20 * lag / tick)):
            drive.set_command(start + speed * k * tick)
            drive.advance(tick)
        ramp_now = start + speed * (k + 1) * tick
        assert ramp_now - drive.motor_lengths() == pytest.approx(lag * speed, abs=1e-9)

    def test_sine_is_damped_as_two_equal_poles_damp_it(self, ideal):
        """Amplitude ratio 1/(1 + (ω·lag/2)²): that is how far inside a circle the tool runs.

        0.2 % covers ticks of lag/80 and taking the largest of 800 samples a period as the amplitude.
        """
        lag, omega, size = 0.02, 2.0 * math.pi * 5.0, 1e-3
        drive = StrutDrive(ideal, replace(QUIET, lag=lag, max_acceleration=math.inf, max_speed=math.inf))
        start, tick = drive.commands, drive._tick
        track = []
        for k in range(round(0.6 / tick)):
            drive.set_command(start + size * math.sin(omega * k * tick))
            drive.advance(tick)
            track.append(drive.motor_lengths()[0] - start[0])
        last_period = track[-round(0.2 / tick) :]
        assert max(last_period) / size == pytest.approx(1.0 / (1.0 + (omega * lag / 2.0) ** 2), rel=2e-3)

    def test_result_does_not_depend_on_how_time_is_cut(self, loose):
        ends = []
        for dt in (1e-3, 2.5e-4, 0.02):
            drive = StrutDrive(loose)
            drive.set_command(drive.commands + np.linspace(-1e-3, 1e-3, 6))
            run(drive, 0.02, dt)
            ends.append(np.concatenate([drive.motor_lengths(), drive.play(), drive.true_pose().position]))
        # Motors and nuts to the bit; the pose's Newton iteration starts from other guesses, hence rounding.
        motors, poses = np.array(ends)[:, :12], np.array(ends)[:, 12:]
        assert (motors == motors[0]).all()
        assert np.abs(poses - poses[0]).max() < 1e-14

    def test_braking_curve_is_continuous(self):
        """The straight part and the parabola meet at half the acceleration times lag²."""
        seam = 0.5 * 10.0 * 0.01**2
        below, above = (wanted_speed(seam * (1 + e), 0.01, math.inf, 10.0) for e in (-1e-9, 1e-9))
        assert below == pytest.approx(above, rel=1e-8)

    def test_ideal_drive_is_on_its_command_at_once(self, ideal):
        drive = StrutDrive(ideal, DriveParameters.ideal())
        command = drive.commands + 0.0123
        drive.set_command(command)
        drive.advance(1e-3)
        assert (drive.motor_lengths() == command).all()
        assert (drive.encoder_lengths() == command).all()

    def test_quantisation_is_at_most_half_a_step(self, ideal):
        step = 2e-6
        drive = StrutDrive(ideal, replace(DriveParameters.ideal(), step=step))
        rng = np.random.default_rng(5)
        errors = []
        for _ in range(500):
            drive.set_command(drive.commands + rng.uniform(-1e-4, 1e-4, 6))
            drive.advance(1e-3)
            errors.append(drive.motor_lengths() - drive.commands)
        assert np.abs(errors).max() <= step / 2 + 1e-15
        # Uniform over a step: variance step²/12; 3000 draws know its root to about 1 %, five sigma here.
        assert np.std(errors) == pytest.approx(step / math.sqrt(12.0), rel=0.05)


class TestStops:
    def test_stops_hold_and_are_reported(self, ideal):
        start = StrutDrive(ideal).motor_lengths()
        stops = np.stack([start - 0.003, start + 0.002], axis=1)
        drive = StrutDrive(ideal, replace(QUIET, stops=stops))
        command = start.copy()
        command[0] += 0.01
        command[4] -= 0.01
        drive.set_command(command)
        track = run(drive, 0.5)
        assert (track <= stops[:, 1]).all()
        assert (track >= stops[:, 0]).all()
        assert drive.stopped.tolist() == [True, False, False, False, True, False]
        assert drive.motor_lengths()[[0, 4]] == pytest.approx([stops[0, 1], stops[4, 0]], abs=1e-12)
        drive.set_command(start)
        run(drive, 0.5)
        assert not drive.stopped.any()
        assert drive.motor_lengths() == pytest.approx(start, abs=1e-12)

    def test_jump_into_a_stop_ends_there(self, ideal):
        drive = StrutDrive(ideal, QUIET)
        drive.faults = Faults(jump=(3, 1.0))
        drive.advance(2.5e-4)
        stop = ideal.geometry.limits.stroke[3, 1]
        # After the blow the drive pulls back, by at most acceleration · time² = 6e-7 m.
        assert stop - 6.3e-7 <= drive.motor_lengths()[3] <= stop
        assert drive.stopped.tolist() == [False, False, False, True, False, False]
        drive.advance(1e-3)
        assert not drive.stopped.any()

    def test_command_just_within_a_stop_is_not_reported(self, ideal):
        start = StrutDrive(ideal).motor_lengths()
        stops = np.stack([start - 0.003, start + 0.002], axis=1)
        drive = StrutDrive(ideal, replace(QUIET, stops=stops))
        drive.set_command(stops[:, 1])
        run(drive, 0.5)
        assert not drive.stopped.any()


class TestPlay:
    def test_nut_follows_a_sine_as_the_play_operator_says(self, loose):
        """Once the play is taken up, nut = motor − b/2 rising and motor + b/2 falling; after a turning
        point it stands still until the motor has come back by b.

        From the first crest on everything is periodic, so the formula needs no knowledge of the start.
        """
        drive = StrutDrive(loose, DriveParameters.ideal())
        start, amplitude, half = drive.commands, 1e-4, BACKLASH / 2
        angles = np.linspace(0.0, 4.5 * math.pi, 1801)
        nuts = []
        for angle in angles:
            drive.set_command(start + amplitude * math.sin(angle))
            drive.advance(1e-3)
            nuts.append(drive.motor_lengths()[1] - drive.play()[1] - start[1])
        motor = amplitude * np.sin(angles)
        falling = np.minimum(motor + half, amplitude - half)
        rising = np.maximum(motor - half, half - amplitude)
        expected = np.where(np.cos(angles) < 0.0, falling, rising)
        # Lengths near 0.5 m are subtracted: a few 1e-16 each.
        assert np.abs((np.array(nuts) - expected)[angles >= math.pi / 2]).max() < 1e-14

    def test_platform_stands_still_while_the_nuts_do(self, loose):
        drive = StrutDrive(loose, DriveParameters.ideal())
        drive.set_command(drive.commands + 1e-4)
        drive.advance(1e-3)
        before = drive.true_pose().position
        drive.set_command(drive.commands - 0.9 * BACKLASH)
        drive.advance(1e-3)
        assert np.abs(drive.true_pose().position - before).max() < 1e-12
        drive.set_command(drive.commands - 0.5 * BACKLASH)
        drive.advance(1e-3)
        assert np.abs(drive.true_pose().position - before).max() > 0.3 * BACKLASH

    def test_model_commands_undo_the_backlash(self, geometry, loose):
        """What the model's backward run commands brings the machine to the pose, in either direction."""
        drive = StrutDrive(loose, DriveParameters.ideal())
        motion = MotionState()
        loose.commands_for(geometry.home, motion)  # where the drive starts
        heights = 0.4 + 0.005 * np.sin(np.linspace(0.1, 7.0, 60))
        for z in heights:
            target = Pose(np.array([0.01, -0.02, z]), np.eye(3))
            drive.set_command(loose.commands_for(target, motion)[0])
            drive.advance(4e-3)
            assert np.abs(drive.true_pose().position - target.position).max() < 1e-12


class TestTruth:
    def test_true_pose_of_an_ideal_machine_is_its_forward_kinematics(self, geometry, ideal):
        drive = StrutDrive(ideal, QUIET)
        target = Pose.from_angles([0.03, -0.02, 0.45], np.deg2rad([5.0, -3.0, 8.0]))
        drive.set_command(strut_lengths(Structure.of(geometry), target))
        run(drive, 1.0, 4e-3)
        expected = solve_pose(Structure.of(geometry), drive.motor_lengths(), geometry.home)
        pose = drive.true_pose()
        assert np.abs(pose.position - expected.position).max() < 1e-13
        assert np.abs(pose.rotation - expected.rotation).max() < 1e-12
        assert np.abs(pose.position - target.position).max() < 1e-12

    def test_starts_at_home(self, geometry):
        """The default initial lengths bring the real machine home, however imperfect it is."""
        truth = RealMachine(geometry, draw_model(geometry, ImperfectionBounds(joint=1e-4), 4))
        home = StrutDrive(truth, QUIET).true_pose()
        assert np.abs(home.position - geometry.home.position).max() < 1e-12

    def test_tool_pose_goes_through_tool_and_work_offsets(self, geometry):
        tool = Pose.from_angles([0.01, 0.02, 0.1], np.deg2rad([10.0, 20.0, 30.0]))
        work = Pose.from_angles([0.1, -0.2, 0.3], np.deg2rad([-5.0, 15.0, 40.0]))
        offset = replace(geometry, tool=tool, work=work, base_axes=None, platform_axes=None)
        drive = StrutDrive(RealMachine(offset, MachineModel(offset.name)), QUIET)
        expected = work.inverse() @ drive.true_pose() @ tool
        found = drive.true_tool_pose()
        assert np.abs(found.position - expected.position).max() < 1e-15
        assert np.abs(found.rotation - expected.rotation).max() < 1e-15

    @pytest.mark.parametrize("turn", [0.0, 15.0], ids=["level", "the platform back, its point forth"])
    def test_field_direction_is_that_of_the_commanded_motion(self, geometry, turn):
        """Forward motion along x must show the forward field, backward the backward one, and both stand when
        nothing moves; the truth is the model's forward run with these senses. It is the measured point that
        counts: 0.1 m above a platform that turns about y, rad/m, it moves along x while the platform moves back.
        """
        bounds = ImperfectionBounds(0.0, 0.0, field_displacement=8e-6, field_reversal=1.0, field_box=BOX)
        model = draw_model(geometry, bounds, 11)
        arm = 0.1 if turn else 0.0
        truth = RealMachine(geometry, replace(model, field=replace(model.field, probe=np.array([0.0, 0.0, arm]))))
        drive = StrutDrive(truth, DriveParameters.ideal())
        for direction in (1.0, -1.0):
            for x in direction * np.linspace(-0.02, 0.02, 201):
                position = np.array([x * (-0.5 if turn else 1.0), 0.3 * x + 0.01, 0.45 - arm + (0.2 + 8.0 * arm) * x])
                target = Pose.from_angles(position, [0.0, turn * x, 0.0])
                drive.set_command(strut_lengths(Structure.of(geometry), target))
                drive.advance(4e-3)
            for _ in range(10):
                drive.advance(4e-3)
            sense = np.concatenate([np.full(3, direction), np.zeros(6)])
            expected = truth.pose_for(drive.motor_lengths(), sense, target)[0]
            assert np.abs(drive.true_pose().position - expected.position).max() < 1e-12

    def test_impossible_motor_positions_raise_instead_of_giving_a_pose(self, ideal):
        drive = StrutDrive(ideal, DriveParameters.ideal())
        drive.set_command([0.33, 0.88, 0.33, 0.88, 0.33, 0.88])
        drive.advance(1e-3)
        with pytest.raises(KinematicsError):
            drive.true_pose()
        drive.set_command(StrutDrive(ideal, DriveParameters.ideal()).commands)
        drive.advance(1e-3)
        assert np.abs(drive.true_pose().position - ideal.geometry.home.position).max() < 1e-12


class TestInstruments:
    def test_encoder_noise_has_the_stated_sigma(self, ideal):
        """18,000 readings: the standard deviation is known to 0.53 %; five sigma are 2.7 %."""
        drive = StrutDrive(ideal, replace(QUIET, encoder_noise=0.3e-6))
        readings = []
        for _ in range(3000):
            drive.advance(1e-3)
            readings.append(drive.encoder_lengths() - drive.motor_lengths())
        assert np.std(readings) == pytest.approx(0.3e-6, rel=0.027)
        assert np.abs(np.mean(readings)) < 5 * 0.3e-6 / math.sqrt(18000)

    def test_tracker_noise_has_the_stated_sigma(self, ideal):
        drive = StrutDrive(ideal, replace(QUIET, tracker_noise=2e-6))
        truth = drive.true_tool_pose().position
        errors = np.array([drive.tracker_pose().position - truth for _ in range(3000)])
        assert np.std(errors) == pytest.approx(2e-6, rel=5 / math.sqrt(2 * 9000))

    def test_encoder_counts_are_whole(self, ideal):
        drive = StrutDrive(ideal, replace(QUIET, encoder_resolution=1e-6, encoder_noise=1e-6))
        run(drive, 0.01)
        counts = drive.encoder_lengths() / 1e-6
        assert np.abs(counts - np.rint(counts)).max() < 1e-6

    def test_speeds_are_those_of_a_steady_motion(self, ideal):
        drive = StrutDrive(ideal, QUIET)
        start = drive.commands
        for k in range(400):
            drive.set_command(start + 0.03 * k * 1e-3)
            drive.advance(1e-3)
        # The commands come in steps of 1 ms, one difference quotient apart: the ripple repeats with them.
        assert drive.encoder_speeds() == pytest.approx(np.full(6, 0.03), rel=1e-6)

    def test_same_seed_same_readings(self, loose):
        def readings(seed: int) -> np.ndarray:
            drive = StrutDrive(loose, seed=seed)
            run(drive, 0.01)
            return drive.encoder_lengths()

        noisy = replace(DriveParameters(), encoder_resolution=0.0)
        assert (readings(1) == readings(1)).all()
        first, second = (StrutDrive(loose, noisy, seed).encoder_lengths() for seed in (1, 2))
        assert (first != second).all()


class TestFaults:
    def test_stuck_strut_stays_and_comes_back(self, ideal):
        drive = StrutDrive(ideal, QUIET)
        start = drive.motor_lengths()
        drive.faults = Faults(stuck=2)
        drive.set_command(start + 1e-3)
        run(drive, 0.3)
        moved = drive.motor_lengths() - start
        assert moved[2] == 0.0
        assert np.delete(moved, 2) == pytest.approx(np.full(5, 1e-3), abs=1e-12)
        drive.faults = Faults()
        run(drive, 0.3)
        assert drive.motor_lengths() == pytest.approx(start + 1e-3, abs=1e-12)

    def test_lost_encoder_reads_nan_and_the_machine_moves_on(self, ideal):
        drive = StrutDrive(ideal, QUIET)
        drive.faults = Faults(encoder_lost=5)
        drive.set_command(drive.commands + 1e-3)
        run(drive, 0.3)
        assert np.isnan(drive.encoder_lengths()).tolist() == [False] * 5 + [True]
        assert np.isnan(drive.encoder_speeds()).tolist() == [False] * 5 + [True]
        assert np.isfinite(drive.true_pose().position).all()

    def test_delayed_feedback_is_as_old_as_stated(self, ideal):
        drive = StrutDrive(ideal, QUIET)
        drive.faults = Faults(feedback_delay=0.02)
        drive.set_command(drive.commands + 5e-3)
        readings, track = [], []
        for _ in range(100):
            drive.advance(1e-3)
            readings.append(drive.encoder_lengths())
            track.append(drive.motor_lengths())
        assert (np.array(readings[20:]) == np.array(track[:-20])).all()
        assert (readings[18] == readings[0]).all()

    def test_dropped_feedback_keeps_the_last_reading(self, ideal):
        """2000 readings at 30 %: 600 ± 20.5 dropped; five sigma."""
        drive = StrutDrive(ideal, DriveParameters(), seed=3)
        drive.faults = Faults(feedback_drop=0.3)
        dropped, last = 0, drive.encoder_lengths()
        for _ in range(2000):
            drive.advance(1e-3)
            if not drive.feedback_arrived:
                dropped += 1
                assert (drive.encoder_lengths() == last).all()
            last = drive.encoder_lengths()
        assert abs(dropped - 600) < 103
        drive.faults = Faults(feedback_drop=1.0)
        drive.advance(1e-3)
        assert not drive.feedback_arrived

    def test_jump_is_seen_and_pulled_back(self, ideal):
        drive = StrutDrive(ideal, QUIET)
        start = drive.motor_lengths()
        drive.faults = Faults(jump=(1, 5e-4))
        drive.advance(2.5e-4)
        moved = drive.encoder_lengths() - start
        assert np.delete(moved, 1).tolist() == [0.0] * 5
        # In one tick the drive pulls it back by at most acceleration · tick² = 6e-7 m.
        assert moved[1] == pytest.approx(5e-4, abs=1e-6)
        run(drive, 0.3)
        assert drive.motor_lengths() == pytest.approx(start, abs=1e-12)


class TestRefusals:
    @pytest.mark.parametrize("bad", [[0.5] * 5, [0.5] * 5 + [math.nan], [math.inf] + [0.5] * 5, 0.5])
    def test_bad_command_is_refused_and_the_last_one_stands(self, ideal, bad):
        drive = StrutDrive(ideal)
        before = drive.commands
        with pytest.raises(CommandError):
            drive.set_command(bad)
        assert (drive.commands == before).all()

    @pytest.mark.parametrize("dt", [-1e-3, math.nan, math.inf, 61.0])
    def test_bad_time_is_refused(self, ideal, dt):
        with pytest.raises(ModelError, match="dt"):
            StrutDrive(ideal).advance(dt)

    @pytest.mark.parametrize(
        ("name", "value"),
        [
            ("step", -1e-6),
            ("step", math.nan),
            ("lag", 1e-4),
            ("lag", 2.0),
            ("lag", 0.0),
            ("max_speed", 0.0),
            ("max_acceleration", -1.0),
            ("max_acceleration", math.nan),
            ("encoder_noise", math.inf),
            ("tracker_noise", -1.0),
        ],
    )
    def test_bad_parameter_is_named(self, name, value):
        with pytest.raises(ModelError, match=f"drive.{name}"):
            DriveParameters(**{name: value})

    def test_parameters_that_do_not_fit_the_machine_are_named(self, ideal):
        with pytest.raises(ModelError, match=r"drive\.stops of strut_1"):
            StrutDrive(ideal, DriveParameters(stops=np.tile([0.6, 0.4], (6, 1))))
        with pytest.raises(ModelError, match=r"drive\.initial_lengths of strut_1"):
            StrutDrive(ideal, DriveParameters(initial_lengths=np.full(6, 0.1)))
        with pytest.raises(ModelError, match=r"drive\.initial_lengths"):
            StrutDrive(ideal, DriveParameters(initial_lengths=np.full(5, 0.5)))

    @pytest.mark.parametrize(
        "fault",
        [
            {"stuck": 6},
            {"encoder_lost": -1},
            {"feedback_delay": -0.1},
            {"feedback_delay": math.nan},
            {"feedback_drop": 1.1},
            {"jump": (0, math.nan)},
            {"jump": (7, 1e-3)},
        ],
    )
    def test_bad_fault_is_named(self, fault):
        with pytest.raises(ModelError, match=f"faults.{next(iter(fault))}"):
            Faults(**fault)


class TestDrawnModels:
    BOUNDS = ImperfectionBounds(
        joint=1e-4,
        strut_offset=5e-5,
        pitch=1e-4,
        wave=(1e-6, 4e-6),
        backlash=(3e-6, 5e-6),
        field_displacement=3e-6,
        field_rotation=20e-6,
        field_box=BOX,
    )

    def test_draws_stay_within_their_bounds_and_use_them(self, geometry):
        models = [draw_model(geometry, self.BOUNDS, seed) for seed in range(40)]

        def spread(get) -> tuple[float, float]:
            values = np.array([get(model) for model in models])
            return float(values.min()), float(values.max())

        for get, low, high in (
            (lambda m: m.base_deviation, -1e-4, 1e-4),
            (lambda m: m.platform_deviation, -1e-4, 1e-4),
            (lambda m: m.struts.offset, -5e-5, 5e-5),
            (lambda m: m.struts.pitch, -1e-4, 1e-4),
            (lambda m: np.hypot(m.struts.cosine, m.struts.sine), 1e-6, 4e-6),
            (lambda m: m.struts.backlash, 3e-6, 5e-6),
        ):
            least, most = spread(get)
            # Of 240 uniform draws or more, all missing the outer 5 % has a chance below 1e-5.
            assert low <= least <= low + 0.05 * (high - low)
            assert high - 0.05 * (high - low) <= most <= high + 1e-18

    def test_drawn_field_reaches_its_bound_and_stays_within(self, geometry):
        drawn = draw_model(geometry, self.BOUNDS, 2).field
        samples = [np.linspace(*BOX[:, axis], 9) for axis in range(3)]
        points = np.stack(np.meshgrid(*samples), axis=-1).reshape(-1, 3)
        for component, bound in enumerate([3e-6] * 3 + [20e-6] * 3):
            values = [drawn.evaluate(p, np.full(3, s))[0][component] for p in points for s in (1.0, -1.0)]
            assert np.abs(values).max() == pytest.approx(bound, rel=1e-12)

    def test_directions_of_the_field_differ_by_the_stated_share(self, geometry):
        same = draw_model(geometry, replace(self.BOUNDS, field_reversal=0.0), 2).field
        for family in same.lines:
            assert (family[0] == family[1]).all()
        different = draw_model(geometry, self.BOUNDS, 2).field
        assert any((family[0] != family[1]).any() for family in different.lines)

    def test_paired_platform_joints_move_together_unless_told_otherwise(self, geometry):
        shared = draw_model(geometry, self.BOUNDS, 3).platform_deviation
        assert (shared[::2] == shared[1::2]).all()
        own = draw_model(geometry, replace(self.BOUNDS, shared_platform_joints=False), 3).platform_deviation
        assert (own[::2] != own[1::2]).all()

    def test_seed_names_one_machine(self, geometry):
        first, again, other = (draw_model(geometry, self.BOUNDS, seed) for seed in (7, 7, 8))
        assert (first.base_deviation == again.base_deviation).all()
        assert (first.field.lines[2] == again.field.lines[2]).all()
        assert (first.base_deviation != other.base_deviation).all()

    def test_one_bound_leaves_the_other_draws_alone(self, geometry):
        narrow = draw_model(geometry, ImperfectionBounds(), 7)
        wide = draw_model(geometry, replace(self.BOUNDS, joint=10e-6, strut_offset=10e-6), 7)
        assert (narrow.base_deviation == wide.base_deviation).all()
        assert (narrow.struts.offset == wide.struts.offset).all()

    @pytest.mark.parametrize(
        "bad",
        [
            {"joint": -1e-6},
            {"pitch": math.nan},
            {"wave": (2e-6, 1e-6)},
            {"backlash": (0.0, math.inf)},
            {"wave_period": 0.0},
            {"field_reversal": 2.0},
            {"field_displacement": 1e-6},
            {"field_displacement": 1e-6, "field_box": BOX[::-1]},
        ],
    )
    def test_bad_bounds_are_refused(self, bad):
        with pytest.raises(ModelError, match="bounds"):
            ImperfectionBounds(**bad)

    @pytest.mark.parametrize("seed", [-1, 1.5, True])
    def test_bad_seed_is_refused(self, geometry, seed):
        with pytest.raises(ModelError, match="seed"):
            draw_model(geometry, ImperfectionBounds(), seed)
