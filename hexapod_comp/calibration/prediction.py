"""The error that the tool would make without compensation, at any pose, and how well it is known.

Mou & King (1998): "predict the linear displacement errors of any point within designated machine workspace". Here all
six components, from any model, with the covariance that a joint fit's parameters give them.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from ..core import Status
from ..errors import CalibrationError
from ..machine.kinematics import Structure, strut_lengths_batch
from ..machine.model import RealMachine
from ..machine.motion import FOLLOWED
from ..machine.passes import Poses
from ..machine.temperatures import HUMIDITY, Temperatures
from ..measurements.readings import Stations, attitude_error
from .parameters import ParameterSpace
from .posterior import FittedParameters
from .sensitivity import Prediction, carried, derivatives

CHUNK = 256
"""Poses handled together: bounds the memory of their derivatives."""

COMPONENTS = ("x", "y", "z", "rx", "ry", "rz")
"""Displacement along, and rotation about, the axes of the work frame."""


@dataclass(frozen=True)
class PredictedError:
    """What the tool does at N poses when the struts are told nominal lengths, beside what it should do.

    Attributes
    ----------
    values : ndarray, shape (N, 6)
        Displacement of the tool's tip, m, and rotation vector, rad, actual minus commanded, along and about the axes of
        ``work``; NaN where the machine has no pose.
    covariance : ndarray, shape (N, 6, 6) or None
        How well they are known; None: nobody knows.
    """

    values: np.ndarray
    covariance: np.ndarray | None

    @property
    def deviations(self) -> np.ndarray | None:
        """Standard deviations of `values`, shape (N, 6); None where they are not known."""
        if self.covariance is None:
            return None
        return np.sqrt(np.maximum(np.diagonal(self.covariance, axis1=1, axis2=2), 0.0))


class _FirstOrder(NamedTuple):
    """Tips in ``work``, (N, 3), errors there, (N, 6), and how parameters move them, (N, 6, size); m and rad."""

    tips: np.ndarray
    values: np.ndarray
    slopes: np.ndarray

    def without(self, datum: _Datum) -> _FirstOrder:
        """Return the same with a datum aligned."""
        arms = self.tips - datum.centre
        return _FirstOrder(self.tips, self.values - datum.at(arms, 0), self.slopes - datum.at(arms, 1))

    def known(self, covariance: np.ndarray | None, moved: np.ndarray | float = 0.0) -> PredictedError:
        """Return the errors with their mean squares about the truth, by the parameters' covariance.

        `moved`, shape (N, 6): how far they were moved away from the parameters' own.
        """
        if covariance is None:
            return PredictedError(self.values, None)
        moves = np.broadcast_to(moved, self.values.shape)
        spread = self.slopes @ covariance @ np.swapaxes(self.slopes, 1, 2)
        return PredictedError(self.values, spread + moves[:, :, None] * moves[:, None, :])


class ErrorPredictor:
    """Predicts the tool's error without compensation, by a model, at any pose.

    Parameters
    ----------
    machine : RealMachine
        Geometry and model, at their temperatures.
    fitted : FittedParameters or None
        What the model's fit knows; None: no covariance is known.

    Notes
    -----
    The covariance is J·Σ·Jᵀ, J the derivatives of the error by the fit's parameters and Σ their covariance: to first
    order, and of what the fit's blocks describe. Σ has the prior of what no reading showed, so that the uncertainty of
    an error as the machine stands includes where it stands as a whole. A model whose datum is held has been moved away
    from the most probable machine by h: about what it predicts the truth then scatters by J·Σ·Jᵀ + h·hᵀ.
    """

    def __init__(self, machine: RealMachine, fitted: FittedParameters | None) -> None:
        self._machine, self._fitted = machine, fitted
        self._datum = self._find_datum()

    def predict(self, poses: Poses, senses: np.ndarray | None = None) -> tuple[PredictedError, PredictedError | None]:
        """Return the errors as the machine stands, and with the datum aligned.

        As it stands, an error includes where the machine is as a whole. Lines of a laser do not show that: the model
        then assumes that the tool is right at the held datum, and the covariance has the prior of where it really is.
        Aligned, an error loses the shift and the turn that best explain the displacements in the box for which the
        model was measured, and the mean rotation there: what a shop takes out that sets its zero and squares its work.
        None for a model that tells of no box.

        Parameters
        ----------
        poses : Poses
            ``pose_platform_in_base``, shapes (N, 3), m, and (N, 3, 3).
        senses : ndarray, shape (N, 9), optional
            Directions of motion as in :class:`~hexapod_comp.machine.motion.MotionState`; by default not known, which is
            midway between both: a backlash and a reversal of the field then add nothing.

        Raises
        ------
        NotFiniteError
            A pose is not finite.
        """
        count = len(poses[0])
        positions, rotations = poses
        senses = np.zeros((count, FOLLOWED)) if senses is None else senses
        standing: list[PredictedError] = []
        aligned: list[PredictedError] = []
        for start in range(0, max(count, 1), CHUNK):
            chosen = slice(start, start + CHUNK)
            errors = self._errors((positions[chosen], rotations[chosen]), senses[chosen])
            covariance = None if self._fitted is None else self._fitted.covariance
            standing.append(errors.known(covariance, self._given_up(errors.tips)))
            if self._datum is not None:
                aligned.append(errors.without(self._datum).known(covariance))
        return _joined(standing), _joined(aligned) if aligned else None

    def slopes(self, poses: Poses) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Return how the fit's parameters move the tool at poses, directions of motion not known.

        Returns
        -------
        tips : ndarray, shape (N, 3)
            The tool in ``work``, m.
        standing, aligned : ndarray, shape (N, 6, size)
            Derivatives of the errors as the machine stands, and with the datum aligned; NaN where the machine has no
            pose.
        given_up : ndarray, shape (N, 6)
            What holding the datum took off the errors as the machine stands, m and rad.

        Raises
        ------
        CalibrationError
            There is no fit, or its model has no box over which a datum can be aligned.
        """
        if self._fitted is None or self._datum is None:
            raise CalibrationError("model", "tells neither how well it is known, nor where it was measured")
        errors = self._errors(poses)
        return errors.tips, errors.slopes, errors.without(self._datum).slopes, self._given_up(errors.tips)

    def _errors(self, poses: Poses, senses: np.ndarray | None = None) -> _FirstOrder:
        senses = np.zeros((len(poses[0]), FOLLOWED)) if senses is None else senses
        return _first_order(self._machine, self._fitted, _stations(self._machine, poses, senses))

    def _given_up(self, tips: np.ndarray) -> np.ndarray:
        """Return the errors that the most probable machine has at tips (N, 3) in ``work`` beyond the model that holds
        the datum, shape (N, 6): a motion of the whole machine."""
        if self._fitted is None or self._fitted.held is None:
            return np.zeros((len(tips), 6))
        geometry, held = self._machine.geometry, self._fitted.held
        return held.moved(tips - geometry.tool_pose(held.pose).position, geometry.work.rotation)

    def _find_datum(self) -> _Datum | None:
        """Return the motion of the whole machine that is no error once the datum is set."""
        geometry, fitted = self._machine.geometry, self._fitted
        level = geometry.work.rotation @ geometry.tool.rotation.T if fitted is None else fitted.space.level
        region = self._machine.model.measured
        if region is None:
            return None
        places = np.stack(np.meshgrid(*(np.linspace(low, high, 3) for low, high in region.box.T)), axis=-1)
        poses = region.poses(places.reshape(-1, 3), level)
        errors = self._errors(poses)
        reached = np.isfinite(errors.values).all(axis=1)
        if reached.sum() < 3:
            return None
        return _Datum.of(_FirstOrder(*(part[reached] for part in errors)))


@dataclass(frozen=True)
class _Datum:
    """A small motion of the whole machine about a centre, and the mean rotation of its tool.

    Attributes
    ----------
    centre : ndarray, shape (3,)
        m in ``work``.
    motion : tuple of ndarray, shape (6,) and (6, size)
        Shift, m, and turn, rad, and how a fit's parameters move them.
    rotation : tuple of ndarray, shape (3,) and (3, size)
        The same of the tool's mean rotation.
    """

    centre: np.ndarray
    motion: tuple[np.ndarray, np.ndarray]
    rotation: tuple[np.ndarray, np.ndarray]

    @staticmethod
    def of(errors: _FirstOrder) -> _Datum:
        """Return what explains the errors at some places best, by least squares of the displacements."""
        centre = errors.tips.mean(axis=0)
        unit = np.tile(np.eye(6)[None], (len(errors.tips), 1, 1))
        explain = np.linalg.pinv(carried(unit, errors.tips - centre)[:, :3].reshape(-1, 6))
        parts = errors.values[:, :, None], errors.slopes
        motion, slopes = (explain @ part[:, :3].reshape(len(explain[0]), -1) for part in parts)
        means = errors.values[:, 3:].mean(axis=0), errors.slopes[:, 3:].mean(axis=0)
        return _Datum(centre, (motion[:, 0], slopes), means)

    def at(self, arms: np.ndarray, which: int) -> np.ndarray:
        """Return what the datum is at points beside its centre, arms (N, 3): values (N, 6), or slopes (N, 6, size)."""
        motion, rotation = self.motion[which], self.rotation[which]
        whole = carried(motion.reshape(1, 6, -1), arms)
        whole[:, 3:] = rotation.reshape(1, 3, -1)
        return whole if which else whole[:, :, 0]


def _joined(parts: list[PredictedError]) -> PredictedError:
    """Return the errors of several parts of a list of poses."""
    covariances = [part.covariance for part in parts if part.covariance is not None]
    return PredictedError(
        np.concatenate([part.values for part in parts]), np.concatenate(covariances) if covariances else None
    )


def _stations(machine: RealMachine, poses: Poses, senses: np.ndarray) -> Stations:
    """Return poses at which the struts are told nominal lengths."""
    positions, rotations = (np.ascontiguousarray(part, dtype=float) for part in poses)
    nominal = strut_lengths_batch(Structure.of(machine.geometry), positions, rotations)
    warmth = np.array([machine.temperatures.at(name) for name in Temperatures.NAMES])
    count = len(positions)
    air = np.full(count, np.nan), np.full(count, machine.temperatures.at(HUMIDITY))
    return Stations(positions, rotations, nominal, senses, np.tile(warmth, (count, 1)), *air)


def _first_order(machine: RealMachine, fitted: FittedParameters | None, stations: Stations) -> _FirstOrder:
    """Return the error at stations, and its derivatives, none without a fit; NaN where the machine has no pose."""
    geometry, count = machine.geometry, len(stations)
    modelled = stations.positions.copy(), stations.rotations.copy()
    actual = np.empty_like(modelled[0]), np.empty_like(modelled[1])
    solved = np.zeros(count, dtype=bool)
    for n in range(count):
        arrays = modelled[0][n], modelled[1][n], actual[0][n], actual[1][n]
        solved[n] = machine.forward(stations.commands[n], stations.sense[n], *arrays)[0] == Status.OK
    displacements = actual[0] - stations.positions + (actual[1] - stations.rotations) @ geometry.tool.position
    values = np.full((count, 6), np.nan)
    values[solved, :3] = displacements[solved] @ geometry.work.rotation
    values[solved, 3:] = attitude_error(actual[1][solved], stations.rotations[solved]) @ geometry.work.rotation
    slopes = np.full((count, 6, 0 if fitted is None else fitted.space.size), np.nan)
    if fitted is not None and solved.any():
        there = modelled[0][solved], modelled[1][solved]
        slopes[solved] = tool_derivatives(machine, fitted.space, stations.select(solved), there)
    return _FirstOrder(geometry.tool_poses(stations.positions, stations.rotations)[0], values, slopes)


def tool_derivatives(machine: RealMachine, space: ParameterSpace, stations: Stations, modelled: Poses) -> np.ndarray:
    """Return how a fit's parameters move the tool, along and about the axes of ``work``, shape (N, 6, size).

    Parameters
    ----------
    machine : RealMachine
        What the parameters describe.
    space : ParameterSpace
        The parameters.
    stations : Stations
        Commands, directions and temperatures.
    modelled : Poses
        The structure's ``pose_platform_in_base`` under these commands, m.
    """
    count, structure = len(stations), machine.structure
    base, platform = (np.tile(array, (count, 1, 1)) for array in (structure.base_joints, structure.platform_joints))
    rows = derivatives(space, Prediction(np.zeros((count, 6)), *modelled, base, platform), stations)
    rows = carried(rows, modelled[1] @ (machine.geometry.tool.position - space.probe))
    work = machine.geometry.work.rotation.T
    return np.concatenate([work @ rows[:, :3], work @ rows[:, 3:]], axis=1)
