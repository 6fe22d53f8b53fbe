"""Compensator and strut drive together: does the tool go where it was told? Over DDS: test_processes, test_story, zoo.

The truth is the virtual machine's true tool pose. What may remain when the model is the true one follows
from the drive alone: every motor stands on a step, so each strut is off by at most half a step δ, and the
tool by at most Σ|J⁻¹|·δ, row by row. J comes from central differences of closed-form strut lengths, not
from the package. The reversal bands, ticks and Newton steps add 1e-9 m, which is allowed on top.
"""

from __future__ import annotations

import numpy as np
import pytest
from helpers import central_difference, moved, table_poses, twist_between
from node_helpers import CONFIG, HOME, Rig, closed_form_lengths

from hexapod_comp.compensation.compensator import Compensator
from hexapod_comp.machine.geometry import HexapodGeometry, load_geometry
from hexapod_comp.machine.model import RealMachine
from hexapod_comp.machine.model_file import load_model
from hexapod_comp.machine.trajectory import move
from hexapod_comp.pose import Pose
from hexapod_comp.ros.messages import message_pose
from hexapod_comp.virtual.machine import DriveParameters, StrutDrive

STEP = ENCODER = 0.1e-6  # motor step of a fine drive, the shipped default, and encoder count, m
NOISE = 0.05e-6  # standard deviation of an encoder reading, m
REST = 1e-9  # what neither drive nor encoder explains, m and rad
RATE, FEED = 250.0, 0.1  # commands per second, Hz, and largest tool speed, m/s

TRUE_MODEL, LINES_MODEL = "paper_machine.yaml", "paper_lines_model.yaml"

# Two poses of the paper's Table 1, tilted by 5° about x and about z
TARGETS = [table_poses()[index] for index in (1, 3)]


def visit(rig: Rig, geometry: HexapodGeometry, **compensator: object) -> list[Pose]:
    """Start both nodes, go from home to each target, rest, and return where the tool really stood."""
    rig.drive(truth_file=TRUE_MODEL, step=STEP, encoder_resolution=ENCODER, encoder_noise=NOISE, max_acceleration=10.0)
    rig.compensator(feedback_timeout=10.0, **compensator)
    rig.until(lambda: rig.values().get("pose_estimated_from") == "strut_states", "feedback")
    rig.settle(HOME)
    start, found = HOME, []
    for target in TARGETS:
        path = move(geometry, start, target, RATE, FEED)
        for index in range(len(path)):
            rig.ask(path.pose(index))
            rig.step(1.0 / RATE)
        rig.step(0.3)
        found.append(message_pose(rig.seen["tool_pose_true"][-1]))
        start = target
    return found


def tool_bound(pose: Pose, strut_error: float) -> np.ndarray:
    """Return the largest tool displacement, m and rad, shape (6,), that strut errors up to a bound cause."""
    jacobian = central_difference(lambda twist: closed_form_lengths(moved(pose, twist)), np.zeros(6))
    return np.abs(np.linalg.inv(jacobian)).sum(axis=1) * strut_error + REST


def by_core(geometry: HexapodGeometry, model: str) -> list[Pose]:
    """Return where the core alone says that the tool will stand: the same commands to drives without steps."""
    machine = StrutDrive(RealMachine(geometry, load_model(CONFIG / TRUE_MODEL, geometry)), DriveParameters.ideal())
    core, start, found = Compensator(geometry, load_model(CONFIG / model, geometry)), HOME, []
    for target in TARGETS:
        path = move(geometry, start, target, RATE, FEED)
        for index in range(len(path)):
            machine.set_command(core.correct(path.pose(index)).command)
            machine.advance(1.0 / RATE)
        found.append(machine.true_tool_pose())
        start = target
    return found


@pytest.mark.parametrize(("model", "enabled"), [(TRUE_MODEL, True), (TRUE_MODEL, False), (LINES_MODEL, True)])
def test_only_quantisation_stands_between_the_model_and_the_tool(rig: Rig, model: str, enabled: bool) -> None:
    """With the true model the tool is where it was told; with the paper's lines where the core alone predicts, some
    10 µm off; without compensation more than 50 times the bound off. The estimate is the truth but for half an encoder
    count and noise, within 6σ."""
    geometry = load_geometry(CONFIG / "paper.yaml")
    found = visit(rig, geometry, model_file=model, enable_compensation=enabled)
    for target, true, predicted in zip(TARGETS, found, by_core(geometry, model), strict=True):
        bound, error = tool_bound(target, STEP / 2.0), twist_between(target, true)
        if not enabled:
            assert np.linalg.norm(error[:3]) > 50.0 * np.linalg.norm(bound[:3])
            continue
        assert (np.abs(twist_between(predicted, true)) <= bound).all()
        if model == TRUE_MODEL:
            assert (np.abs(error) <= bound).all()
        else:
            assert np.linalg.norm(error[:3]) > 10e-6, "the scheme is not the true model"
    if enabled and model == TRUE_MODEL:
        bound = tool_bound(TARGETS[-1], ENCODER / 2.0 + 6.0 * NOISE)
        for message in rig.seen["tool_pose_estimate"][-20:]:
            assert (np.abs(twist_between(found[-1], message_pose(message))) <= bound).all()
