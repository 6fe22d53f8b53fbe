"""Every limit: a value 1e-9 inside passes, a value 1e-9 outside is refused with quantity, place and excess.

Limits are evaluated in two ways, by the check that stops at the first breach and by the one that measures all; both
must agree.

The limited quantities come from NumPy alone: distances between joints, angles by arctan2, the condition number by the
inverse matrix.
"""

from __future__ import annotations

from dataclasses import replace
from itertools import combinations

import numpy as np
import pytest
from helpers import beside, segment_distance
from hypothesis import given, settings
from strategies import fixed, paper_geometry, random_model, random_pose, seeds, skewed_geometry

from hexapod_comp.compensation.checks import check
from hexapod_comp.compensation.compensator import Compensator
from hexapod_comp.core import Status
from hexapod_comp.errors import HexapodError, LimitError
from hexapod_comp.machine.assembly import mode_objections
from hexapod_comp.machine.geometry import HexapodGeometry
from hexapod_comp.machine.kinematics import Structure, strut_lengths
from hexapod_comp.machine.limits import REASONS, Limits
from hexapod_comp.machine.model import MachineModel
from hexapod_comp.machine.struts import StrutErrors
from hexapod_comp.pose import Pose
from hexapod_comp.workspace.reach import first_limits

PAPER = paper_geometry()
HOME = PAPER.home
HAIR = 1e-9
WIDE = Limits(np.tile([0.1, 2.0], (6, 1)), np.full(6, np.pi), np.full(6, np.pi), 100.0, 0.01, 1.0, 1.0)
CROSSED = Pose.from_angles([0.01, -0.02, 0.42], np.deg2rad([3.0, -2.0, 60.0]))
LOW = Pose(HOME.position - np.array([0.0, 0.0, 0.05]), HOME.rotation)
TILTED = Pose.from_angles([0.02, -0.03, 0.52], np.deg2rad([12.0, -9.0, 15.0]))


def struts(pose: Pose) -> np.ndarray:
    """Return the strut vectors in ``base``, (6, 3), m."""
    return pose.position + PAPER.platform_joints @ pose.rotation.T - PAPER.base_joints


def angles_between(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return the angles between rows by arctan2, which is accurate where arccos is not."""
    return np.arctan2(np.linalg.norm(np.cross(a, b), axis=1), (a * b).sum(axis=1))


def condition_by_inverse(pose: Pose) -> float:
    """Return ‖J‖·‖J⁻¹‖/6 (Frobenius), rotations in units of the RMS radius of the platform joints."""
    s = struts(pose)
    unit = s / np.linalg.norm(s, axis=1)[:, None]
    arms = PAPER.platform_joints @ pose.rotation.T
    spread = PAPER.platform_joints - PAPER.platform_joints.mean(axis=0)
    radius = np.sqrt((spread**2).sum(axis=1).mean())
    matrix = np.hstack([unit, np.cross(arms, unit) / radius])
    return float(np.linalg.norm(matrix) * np.linalg.norm(np.linalg.inv(matrix)) / 6.0)


def least_distance(pose: Pose, base: np.ndarray) -> tuple[float, int]:
    """Return the smallest distance of two struts that share no joint, m, and the index of the first of the two."""
    ends = pose.position + PAPER.platform_joints @ pose.rotation.T
    pairs = [(i, j) for i, j in combinations(range(6), 2) if i // 2 != j // 2]
    return min((segment_distance(base[i], ends[i], base[j], ends[j]), i) for i, j in pairs)


def cone_angles(pose: Pose, body: str) -> np.ndarray:
    """Return the struts' angles to their directions at home, as seen from base or platform."""
    turns = (pose.rotation, HOME.rotation) if body == "platform" else (np.eye(3), np.eye(3))
    return angles_between(struts(pose) @ turns[0], struts(HOME) @ turns[1])


def six(value: float, strut: int, others: float) -> np.ndarray:
    return np.where(np.arange(6) == strut, value, others)


SHORT = MachineModel(PAPER.name, struts=StrutErrors(offset=six(-50e-6, 2, 0.0)))
ASIDE = MachineModel(PAPER.name, base_deviation=np.outer(np.arange(6) == 3, [4e-4, 8e-4, 0.0]))
LENGTHS, MOVED = (
    np.linalg.norm(struts(TILTED), axis=1),
    angles_between(struts(TILTED) - ASIDE.base_deviation, struts(HOME)),
)
CLOSEST, NEAREST = least_distance(CROSSED, PAPER.base_joints)
HOME_LENGTHS = np.linalg.norm(struts(HOME), axis=1)
# At home all six struts lengthen almost equally along z; the small x makes strut 1 the first
STEPPED = [Pose(HOME.position + np.array([way * -1e-4, 0.0, way * 1e-3]), HOME.rotation) for way in (1.0, -1.0)]
LIMITS = [
    # limit, value at its edge, sign of the allowed side, strut, pose, model
    *(("longest", LENGTHS[i], 1.0, i, TILTED, None) for i in range(6)),
    *(("shortest", np.linalg.norm(struts(LOW)[i]), -1.0, i, LOW, None) for i in range(6)),
    *((f"{b}_cone", cone_angles(TILTED, b)[i], 1.0, i, TILTED, None) for b in ("base", "platform") for i in range(6)),
    ("clearance", CLOSEST, -1.0, NEAREST, CROSSED, None),
    *(("step", abs(np.linalg.norm(struts(p), axis=1) - HOME_LENGTHS).max(), 1.0, 0, p, None) for p in STEPPED),
    ("condition", condition_by_inverse(TILTED), 1.0, None, TILTED, None),
    ("correction", 50e-6, 1.0, 2, TILTED, SHORT),
    ("longest", LENGTHS[2] + 50e-6, 1.0, 2, TILTED, SHORT),
    ("base_cone", MOVED[3], 1.0, 3, TILTED, ASIDE),
]


@pytest.mark.parametrize(("limit", "value", "side", "strut", "pose", "model"), LIMITS)
def test_a_hair_inside_passes_and_a_hair_outside_is_refused(limit, value, side, strut, pose, model) -> None:
    """Compensated values, too: a strut 50 µm short has a longer command, and a base joint is 0.9 mm aside."""
    for inside in (True, False):
        edge = value * (1.0 + side * (HAIR if inside else -HAIR))
        changes: dict[str, object] = {limit: edge}
        if limit in ("longest", "shortest"):
            stroke = WIDE.stroke.copy()
            stroke[strut, int(limit == "longest")] = edge
            changes = {"stroke": stroke}
        elif limit.endswith("cone"):
            changes = {limit: six(edge, strut, np.pi)}
        geometry = replace(PAPER, limits=replace(WIDE, **changes))
        compensator = Compensator(geometry, model or MachineModel(PAPER.name))
        if limit == "step":
            compensator.correct(HOME)
        before = compensator.command.copy()
        if inside:
            compensator.correct(pose)
            continue
        with pytest.raises(LimitError) as caught:
            compensator.correct(pose)
        error = caught.value
        assert (error.reason, error.strut) == (next(iter(changes)), strut)
        assert error.stage == ("nominal" if model is None else "compensated")
        assert abs(error.value) == pytest.approx(value, rel=1e-9)
        assert error.limit == pytest.approx(edge, rel=1e-15)
        assert limit != "step" or (error.value > 0.0) == (pose is STEPPED[0])
        assert strut is None or f"strut_{strut + 1}" in str(error)
        np.testing.assert_array_equal(compensator.command, before)


def test_messages_state_strut_value_and_limit() -> None:
    """The paper's machine, with a clearance of 20 mm and an acceleration of 2.5 m/s²."""
    limits = replace(PAPER.limits, clearance=0.02, acceleration=2.5)
    messages = beside(__file__)["messages"]
    given = {name: limits.error(Status[name], 2, 0, value) for name, (value, _) in messages.items()}
    assert {name: str(error) for name, error in given.items()} == {name: text for name, (_, text) in messages.items()}
    assert [given[name].stage for name in ("STROKE_LONG", "SPEED")] == ["nominal", "compensated"]
    assert [given[name].limit for name in ("STROKE_SHORT", "STROKE_LONG", "SPEED")] == [0.33, 0.88, 0.25]


# --- both ways of evaluating limits ------------------------------------------------------------------------

TOOL = Pose.from_angles([0.01, -0.02, 0.08], np.deg2rad([20.0, -10.0, 40.0]))
WORK = Pose.from_angles([0.1, 0.05, 0.2], np.deg2rad([3.0, 5.0, -70.0]))
OVER = np.diag([1.0, -1.0, -1.0])  # Turns a machine upside down


def tight(geometry: HexapodGeometry, clearance: float, **frames: object) -> HexapodGeometry:
    """Return a machine whose every limit some poses near home break, and many keep."""
    lengths = strut_lengths(Structure.of(geometry), geometry.home)
    stroke = np.stack([lengths - 0.05, lengths + 0.05], axis=1)
    limits = Limits(stroke, np.full(6, 0.11), np.full(6, 0.26), 3.2, 80e-6, 1.0, 1.0, clearance)
    return replace(geometry, limits=limits, **frames)


def hanging() -> HexapodGeometry:
    home = Pose(OVER @ HOME.position, OVER @ HOME.rotation @ OVER)
    return HexapodGeometry(
        "hanging", PAPER.base_joints @ OVER, PAPER.platform_joints @ OVER, home, WIDE, work=WORK, tool=TOOL
    )


MACHINES = {
    "paper": tight(PAPER, 0.0),
    "paper with a clearance": tight(PAPER, 0.23),
    "6-6 in turned frames": tight(skewed_geometry(), 0.01, tool=TOOL, work=WORK),
    "hanging": tight(hanging(), 0.23),
}


def compensators_refusal(machine: HexapodGeometry, model: MachineModel, tool: Pose) -> tuple[str, int | None] | None:
    """Return reason and strut with which a new compensator refuses a tool pose; None if it accepts it."""
    try:
        Compensator(machine, model).correct(tool)
    except HexapodError as error:
        return error.reason, getattr(error, "strut", None)
    return None


@pytest.mark.parametrize("name", MACHINES)
@settings(fixed, max_examples=15)
@given(seed=seeds)
def test_check_reach_cold_start_and_compensator_agree(name: str, seed: int) -> None:
    """For random tool poses and models, each of the four refuses for a reason that ``check`` finds as well."""
    machine, rng = MACHINES[name], np.random.default_rng(seed)
    structure, model = Structure.of(machine), random_model(rng, machine.name)
    poses = [random_pose(rng, machine.home, 0.04, 12.0) for _ in range(4)]
    told = [machine.tool_pose(pose) for pose in poses]
    positions, rotations = np.array([p.position for p in told]), np.array([p.rotation for p in told])
    result = check(machine, model, (positions, rotations), "poses")
    reach, _ = first_limits(machine, positions, rotations)
    for row, (pose, tool) in enumerate(zip(poses, told, strict=True)):
        breaches = {(b.limit, getattr(b.error, "strut", None)) for b in result.breaches if b.row == row}
        assert compensators_refusal(machine, model, tool) in (breaches or {None})
        # Tool poses are rounded in the frames; none of the random poses is at an edge.
        nominal = machine.refusal(pose.position, pose.rotation, strut_lengths(structure, pose))
        assert REASONS[reach[row]] == ("" if nominal is None else nominal.reason)
        if nominal is None or nominal.reason != "stroke":
            assert bool(mode_objections(machine, structure, pose)) == (nominal is not None)
