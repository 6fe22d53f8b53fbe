"""Where a machine stands as a whole: what a model does to the tool at one pose, and how to have it do nothing there."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from ..errors import NotConvergedError
from ..pose import Pose
from .geometry import HexapodGeometry
from .kinematics import Structure, strut_lengths
from .model import MachineModel, RealMachine

ROUNDS = 10
"""Field and turning screws see a moved machine a little otherwise: each round leaves less than a thousandth."""

SETTLED = 1e-12
"""The tool is not moved when it is by less, m and rad."""


def tool_move(geometry: HexapodGeometry, model: MachineModel, pose: Pose) -> np.ndarray:
    """Return what a machine does to its tool at a pose when the struts are told nominal lengths.

    All parts are at 20 °C and directions of motion not known: midway between both ways of approach.
    """
    machine = RealMachine(geometry, model)
    actual, _ = machine.pose_for(strut_lengths(Structure.of(geometry), pose), guess=pose)
    displacement = (actual @ geometry.tool).position - (pose @ geometry.tool).position
    turn = Rotation.from_matrix(actual.rotation @ pose.rotation.T).as_rotvec()
    return np.concatenate([displacement, turn])


def with_datum_held(
    geometry: HexapodGeometry, model: MachineModel, pose: Pose, part: np.ndarray | None = None
) -> MachineModel:
    """Return a model whose whole machine is shifted and turned so that it does not move the tool at a pose.

    The base is moved, joints and cardan axes: all errors that a datum does not take up stay as they are.
    """
    part = np.eye(6) if part is None else part
    tip = (pose @ geometry.tool).position
    for _ in range(ROUNDS):
        move = tool_move(geometry, model, pose)
        taken = part @ move
        if np.abs(taken).max() <= SETTLED:
            return model
        about, back = tip + move[:3], Rotation.from_rotvec(-taken[3:])
        joints = about - taken[:3] + back.apply(geometry.base_joints + model.base_deviation - about)
        model = replace(model, base_deviation=joints - geometry.base_joints)
        if geometry.screw_lead.any():
            axes = back * Rotation.from_rotvec(model.base_axes_turn.copy())
            model = replace(model, base_axes_turn=axes.as_rotvec())
    raise NotConvergedError("the whole machine cannot be moved so that the tool stays at the datum", limit=ROUNDS)
