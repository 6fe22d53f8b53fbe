"""Strut errors: every term alone by its closed form, all together undone, and the rotation of the screws."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from helpers import distances
from hypothesis import example, given
from hypothesis import strategies as st
from scipy.interpolate import make_interp_spline
from scipy.spatial.transform import Rotation
from strategies import fixed, paper_geometry, random_pose, random_struts, seeds, skewed_geometry

from hexapod_comp.calibration.blocks.length_map import LengthMap
from hexapod_comp.core.batch import screw_twists, strut_commands, strut_errors
from hexapod_comp.errors import ModelError
from hexapod_comp.machine.model import MachineModel, MotionState, RealMachine
from hexapod_comp.machine.struts import STEEPEST_ERROR, StrutErrors
from hexapod_comp.pose import Pose

PAPER = paper_geometry()
COMMANDS = np.linspace(0.35, 0.65, 62)  # steps of 4.9 mm; in steps of 5 mm, the period, all waves would be at phase 0
CLOSED = 2e-13  # m


def machine_of(struts, growth=0.0):
    """Return a machine whose screws do not turn, and whose struts have grown."""
    machine = RealMachine(PAPER, MachineModel("paper", struts=struts))
    machine.growth[:] = growth
    return machine


def lengths(struts, command, sense=0.0):
    """Return the six lengths at six equal commands, by forward kinematics of the model and distances of the joints."""
    _, pose = machine_of(struts).pose_for(np.full(6, command), np.full(9, sense))
    return distances(PAPER, pose)


def on_strut_4(value):
    """Return six values that are zero except for strut 4 (index 3)."""
    return np.where(np.arange(6) == 3, value, 0.0)


# One term at a time; the truth is the closed form beside each term. Forward kinematics closes its loops to 1e-13 m


WAVES = StrutErrors(
    cosine=on_strut_4(1.0)[:, None] * [3e-6, 0.0, 2e-6, 0.0],
    sine=on_strut_4(1.0)[:, None] * [0.0, -1e-6, 0.0, 1e-6],
    period=np.full(6, 0.005),
)


def waves(c):
    turn = 400.0 * np.pi * c
    return 1e-6 * (3.0 * np.cos(turn) - np.sin(2.0 * turn) + 2.0 * np.cos(3.0 * turn) + np.sin(4.0 * turn))


@pytest.mark.parametrize(
    ("struts", "truth"),
    [
        (StrutErrors(offset=on_strut_4(7e-6)), lambda c: 7e-6),
        (StrutErrors(pitch=on_strut_4(50e-6), reference_length=on_strut_4(0.4)), lambda c: 50e-6 * (c - 0.4)),
        (WAVES, waves),
    ],
    ids=["offset", "pitch", "waves"],
)
def test_each_term_by_its_closed_form(struts, truth):
    for command in COMMANDS:
        wanted = command + on_strut_4(truth(command))
        np.testing.assert_allclose(lengths(struts, command), wanted, rtol=0.0, atol=CLOSED)


def test_maps_are_natural_splines_and_lost_motion_lags_behind():
    """The truth is SciPy's B-splines; a nut with backlash b(c) lags half of it behind, −s·b(c)/2.

    Beyond the knots the end values hold. A fit weights the knots by the same spline.
    """
    drawn = random_struts(np.random.default_rng(11))
    knots, maps = drawn.map_knots, np.stack([drawn.map_values, drawn.map_backlash])
    struts = StrutErrors(backlash=drawn.backlash, map_knots=knots, map_values=maps[0], map_backlash=maps[1])
    splines = make_interp_spline(knots, maps, k=3, axis=2, bc_type=([(2, np.zeros((2, 6)))], [(2, np.zeros((2, 6)))]))
    weights = LengthMap(knots).weights
    for command in (*np.linspace(0.33, 0.83, 41), *knots[1:]):
        values, change = splines(np.clip(command, knots[0], knots[-1]))
        np.testing.assert_allclose(maps @ weights(np.array(command)), [values, change], rtol=0.0, atol=5e-17)
        for sense in (-1.0, 0.0, 0.5, 1.0):
            truth = command + values - 0.5 * sense * (drawn.backlash + change)
            np.testing.assert_allclose(lengths(struts, command, sense), truth, rtol=0.0, atol=CLOSED)
    np.testing.assert_allclose(struts.largest_backlash, drawn.backlash + maps[1].max(axis=1), rtol=1e-12)
    assert StrutErrors(map_knots=knots, map_values=maps[0]).map_backlash.shape == (6, 5)


# Backwards: the truth is the definition (1 + growth)·(command + error − backlash by direction / 2 − shift)


def assert_commanded(machine, strut, sense, shift, wanted):
    """Check that the commands for lengths give these lengths, to a few roundings of half a metre."""
    commands = strut_commands(machine.state, strut, sense, shift, wanted)
    errors, slopes = strut_errors(machine.state, strut, sense, commands)
    ahead, behind = (strut_errors(machine.state, strut, sense, commands + step)[0] for step in (1e-7, -1e-7))
    np.testing.assert_allclose(slopes, (ahead - behind) / 2e-7, rtol=0.0, atol=1e-6)
    play = 0.5 * sense * machine.model.struts.backlash[strut]
    found = (1.0 + machine.growth[strut]) * (commands + errors - play - shift)
    np.testing.assert_allclose(found, wanted, rtol=0.0, atol=1e-15)


@fixed
@given(seeds, st.sampled_from([-1.0, 0.0, 1.0]), st.floats(-5e-3, 5e-3))
def test_a_command_gives_the_wanted_length(seed, sense, shift):
    machine = machine_of(random_struts(np.random.default_rng(seed)), growth=3e-4)
    for strut in range(6):
        assert_commanded(machine, strut, sense, shift, np.linspace(0.25, 0.75, 50))


@fixed
@example(period=0.0005, offset=0.01, phase=0.0, at=0.5)
@given(st.floats(0.0005, 0.05), st.floats(-0.01, 0.01), st.floats(0.0, 6.283), st.floats(0.3, 0.8))
def test_commands_where_the_error_is_as_steep_as_allowed(period, offset, phase, at):
    """The steepest wave has the largest slope that StrutErrors accepts."""
    amplitude = 0.999 * STEEPEST_ERROR * period / (2.0 * np.pi)
    struts = StrutErrors(
        offset=np.full(6, offset),
        cosine=np.full(6, amplitude * np.cos(phase)),
        sine=np.full(6, amplitude * np.sin(phase)),
        period=np.full(6, period),
    )
    assert_commanded(machine_of(struts), 0, 0.0, 0.0, np.array([at]))


# Impossible struts. A natural spline through 0, h, 0 at knots 0.1 m apart is steepest at its ends: 1.5 h / 0.1 m


BUMP = {"map_knots": np.array([0.4, 0.5, 0.6]), "map_values": np.tile([0.0, 0.01, 0.0], (6, 1))}


@pytest.mark.parametrize(
    ("bad", "message"),
    [
        ({"backlash": np.array([0, -1e-6, 0, 0, 0, 0])}, "struts.backlash.*negative.*-1e-06"),
        ({"pitch": on_strut_4(0.5)}, r"struts\[3\].*0.5 m per m of command, allowed 0.2"),
        ({"sine": np.full(6, 1e-3)}, r"struts\[0\].*allowed 0.2"),
        ({"sine": np.zeros((6, 5)), "cosine": np.zeros((6, 5))}, r"n = 1…4 harmonics, not \(6, 5\)"),
        ({"sine": np.full((6, 2), [0, 1.2e-4]), "cosine": np.full((6, 2), [1.2e-4, 0])}, r"struts\[0\].*0.226.*0.2"),
        (BUMP | {"map_values": np.tile([0.0, 0.0134, 0.0], (6, 1))}, r"struts\[0\].*0.201 m per m"),
        (BUMP | {"map_backlash": np.tile([0.0, 0.0068, 0.0], (6, 1))}, r"struts\[0\].*0.201 m per m"),
        ({"map_knots": np.array([0.4, 0.4]), "map_values": np.zeros((6, 2))}, "struts.map_knots.*increasing"),
        ({"map_knots": np.array([0.4, 0.5]), "map_values": np.zeros((6, 3))}, r"struts.map_values.*\(6, 3\)"),
        (
            {"map_knots": np.array([0.4, 0.5]), "map_values": np.zeros((6, 2)), "map_backlash": np.ones((6, 3))},
            r"struts.map_backlash.*\(6, 3\)",
        ),
    ],
)
def test_refused(bad, message):
    with pytest.raises(ModelError, match=message):
        StrutErrors(**bad)
    StrutErrors(**BUMP, map_backlash=np.tile([0.0, 0.0066, 0.0], (6, 1)))  # 0.1995 m per m


# Rotation of the screws


def genhexkins_correction(lead, base_axis, platform_axis, strut, rotation):
    """Return the length that LinuxCNC adds to a strut for its screw's rotation.

    Written from StrutLengthCorrection in src/emc/kinematics/genhexkins.c of LinuxCNC/linuxcnc (read at commit
    032ef12c): with u along the strut from base to platform, nb2 = nb1 × u, nb3 = unit(u × nb2), na2 = unit(R·na0 × u),
    correction = lead·asin(nb3·na2)/2π; genhexKinematicsInverse adds it to the length.
    """
    u = strut / np.linalg.norm(strut)
    nb3 = np.cross(u, np.cross(base_axis, u))
    na2 = np.cross(rotation @ platform_axis, u)
    sine = nb3 @ na2 / (np.linalg.norm(nb3) * np.linalg.norm(na2))
    return lead * np.arcsin(sine) / (2.0 * np.pi)


def struts_at(geometry, pose):
    return pose.position + geometry.platform_joints @ pose.rotation.T - geometry.base_joints


def shifts(geometry, pose):
    """Return the shifts of the six commands of a machine whose only error is the screws' rotation, at a pose."""
    commands, _, _ = RealMachine(geometry, MachineModel(geometry.name)).commands_for(pose, MotionState())
    return commands - distances(geometry, pose)


@fixed
@given(seeds)
def test_sine_of_the_twist_is_genhexkins(seed):
    """The truth is genhexkins' formula for arbitrary axes; axes nearly along the strut lose digits."""
    rng = np.random.default_rng(seed)
    geometry = skewed_geometry()
    pose = random_pose(rng, geometry.home)
    axes = rng.normal(size=(2, 6, 3))
    axes /= np.linalg.norm(axes, axis=2)[:, :, None]
    for i, strut in enumerate(struts_at(geometry, pose)):
        twist = screw_twists(*geometry.kernel_joints, *axes, pose.position[None], pose.rotation[None])[0, i]
        truth = genhexkins_correction(2.0 * np.pi, axes[0, i], axes[1, i], strut, pose.rotation)
        assert np.sin(twist) == pytest.approx(np.sin(truth), abs=1e-11)


@pytest.mark.parametrize("strut", range(6))
@pytest.mark.parametrize("body", ["base_axes", "platform_axes"])
def test_an_axis_has_no_direction(body, strut):
    """Reversing the vector of an axle must not change the command."""
    geometry = skewed_geometry(0.01)
    axes = getattr(geometry, body).copy()
    axes[strut] *= -1.0
    turned = replace(geometry, **{body: axes})
    rng = np.random.default_rng(strut)
    for _ in range(5):
        pose = random_pose(rng, geometry.home, tilt=30.0)
        np.testing.assert_allclose(shifts(turned, pose), shifts(geometry, pose), atol=1e-15)


def test_correction_does_not_jump_at_the_arctangents_cut():
    """With axes 170° apart at home, a sweep of ±60° crosses 180°, and the command must be continuous.

    Each step of 0.5° turns a screw by less than 1°, so a command may step by at most lead·1/360; a jump would be the
    lead.
    """
    lead = 0.01
    geometry = skewed_geometry(lead)
    along = struts_at(geometry, geometry.home) @ geometry.home.rotation
    along /= np.linalg.norm(along, axis=1)[:, None]
    turns = Rotation.from_rotvec(np.deg2rad(170.0) * along)
    geometry = replace(geometry, platform_axes=turns.apply(geometry.platform_axes.copy()))
    sweep = [
        Pose(geometry.home.position, Rotation.from_euler("z", a, degrees=True).as_matrix())
        for a in np.arange(-60.0, 60.0, 0.5)
    ]
    steps = np.diff([shifts(geometry, pose) for pose in sweep], axis=0)
    assert np.abs(steps).max() < lead / 360.0
