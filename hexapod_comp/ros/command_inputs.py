"""What commands a compensator: tool poses, or the nominal strut lengths of a controller that plans struts itself.

Strut setpoints become the tool pose of the machine without errors at once. What comes after, limits, stamps, journal
and replay, knows poses alone. What such a controller hears of the struts is nominal too.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from geometry_msgs.msg import PoseStamped
from sensor_msgs.msg import JointState

from ..compensation.compensator import Compensator
from ..core.batch import quaternion_of
from ..errors import HexapodError
from ..machine.kinematics import Structure, forward_error, solve_poses, strut_lengths
from ..pose import Pose
from .messages import StrutReader, read_message
from .wire import command_stamp, read_pose_bytes

POSES, STRUTS = "poses", "struts"
"""Values of the parameter ``command_input``."""


class PoseInput:
    """Tool poses on ``tool_pose_command``."""

    topic, kind = "tool_pose_command", PoseStamped

    def read(self, data: bytes) -> tuple[int, str, tuple[float, ...] | None]:
        """Return stamp (ns), frame and numbers of a command, as :func:`~hexapod_comp.ros.wire.read_pose_bytes`.

        No numbers: nothing is commanded yet.
        """
        return read_pose_bytes(data)

    def stamp(self, data: bytes) -> int:
        """Return the stamp of a command, ns; 0 where there is none to be read."""
        try:
            return self.read(data)[0]
        except HexapodError:
            return 0


class StrutInput(PoseInput):
    """Nominal strut lengths on ``strut_setpoints``, m, by name: what a machine without errors would be told.

    Parameters
    ----------
    compensator : Compensator
        Whose machine it is; its last command is where the pose is sought from.
    names : sequence of str
        The struts' joint names, in strut order.
    frame_id : str
        Name of the machine's base.
    """

    topic, kind = "strut_setpoints", JointState

    def __init__(self, compensator: Compensator, names: list[str], frame_id: str) -> None:
        self._compensator, self._frame_id = compensator, frame_id
        self._structure, self._reader = Structure.of(compensator.geometry), StrutReader(names)

    def read(self, data: bytes) -> tuple[int, str, tuple[float, ...] | None]:
        """Return stamp (ns), base frame and the tool pose's numbers; none while all lengths are NaN.

        ros2_control publishes NaN until one of its controllers is active.

        Raises
        ------
        CommandError
            As :meth:`~hexapod_comp.ros.messages.StrutReader.read`; some lengths NaN and others not.
        KinematicsError
            No pose near the last command, nor near home, has these lengths.
        """
        message = read_message(data, JointState)
        stamp = command_stamp(message.header.stamp)
        lengths = self._reader.pick(message)
        if np.isnan(lengths).all():
            return stamp, self._frame_id, None
        self._reader.keep(lengths)
        tool = self._pose(lengths) @ self._compensator.geometry.tool
        return stamp, self._frame_id, (*tool.position.tolist(), *quaternion_of(tool.rotation))

    def _pose(self, lengths: np.ndarray) -> Pose:
        """Return ``pose_platform_in_base`` of the machine without errors."""
        guesses = [self._compensator.geometry.home]
        if np.isfinite(self._compensator.nominal).all():  # else there was no command yet
            guesses.insert(0, self._compensator.platform)
        for guess in guesses:
            solved = solve_poses(self._structure, lengths[None], guess, threads=1)
            if solved.ok[0]:
                return Pose(solved.positions[0], solved.rotations[0])
        raise forward_error(int(solved.outcomes[0]), float(solved.conditions[0]), self._structure.max_condition)


def nominal_lengths(compensator: Compensator, measured: np.ndarray) -> np.ndarray:
    """Return measured struts as a controller of nominal lengths must see them: less what is corrected.

    Told the measured ones, it would hold the corrections for a way that it has yet to go, and each time that it starts
    from where the struts are they would be corrected once more.

    Parameters
    ----------
    compensator : Compensator
        Its correction counts; before its first command its model's, where it corrects.
    measured : ndarray, shape (6,)
        Strut lengths, m.

    Returns
    -------
    ndarray, shape (6,)
        m.
    """
    if np.isfinite(compensator.correction).all():
        return measured - compensator.correction
    if not compensator.enabled:
        return measured
    tool = compensator.estimate(measured)
    pose = Pose(tool[:3], tool[3:].reshape((3, 3)))
    return strut_lengths(compensator.geometry, pose @ compensator.geometry.tool.inverse())


def command_input(compensator: Compensator, options: dict[str, Any]) -> PoseInput:
    """Return the input that a node's parameters ask for."""
    if options["command_input"] == STRUTS:
        return StrutInput(compensator, options["joint_names"], options["base_frame"])
    return PoseInput()
