"""A block: one physical error, with its prior, its columns of the design matrix, and its parameters in the model.

The error of the measured point is e = (dx, dy, dz, rx, ry, rz), actual minus commanded, along and about the axes of
``base``. Most physical errors change strut lengths l or joints b (base) and t (platform). A strut with direction u_i
has u_i·(δP + δω × R·t_i + R·δt_i − δb_i) = δl_i. So the platform's twist (δP, δω) is X·(δl + u·δb − u·R·δt), where X
is the inverse of the Jacobian with rows (u_i, R·t_i × u_i).
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple

import numpy as np

from ...machine.geometry import STRUT_NAMES, HexapodGeometry
from ...machine.load import Load
from ...measurements.readings import Stations

if TYPE_CHECKING:
    from ..parameters import Extent, FitSettings
    from .field import SmoothField

DIGITS = 11  # decimals of lengths, m, and angles, rad, in a model file: a hundredth of a nanometre


class Facts(NamedTuple):
    """Facts about a machine and a measurement from which :meth:`Block.of` makes a block."""

    geometry: HexapodGeometry
    region: Extent  # the measured region
    settings: FitSettings
    home_lengths: np.ndarray  # (6,), m
    platform_groups: np.ndarray  # (6,): index of each strut's ball joint on the platform
    periods: np.ndarray  # (6,): period of each screw's error (its lead), m; NaN if the lead is unknown
    smooth: SmoothField  # basis polynomials of the field over the measured box


@dataclass
class Draft:
    """A model under construction, into which each block writes its parameters."""

    machine: dict[str, Any]  # arguments of MachineModel
    struts: dict[str, Any]  # arguments of StrutErrors
    growth: np.ndarray  # (8,): expansion of struts 1-6, base and platform, 1/K
    field: np.ndarray  # (6, terms): coefficients of the field's mean over both directions of motion, m and rad
    reversal: (
        np.ndarray
    )  # (3, 6, reversal terms): coefficients of the field in forward minus backward motion along x, y, z
    late: np.ndarray  # (8, time constants): late expansion of struts 1-6, base and platform, 1/K
    load: dict[str, np.ndarray]  # name → fitted minus stated value of a load term (compliance, not stiffness), SI


class Errors(NamedTuple):
    """n scalar errors w·e, where e is the error of a station, (6,); each w·e has one row in the design matrix."""

    at: np.ndarray  # (n,): index of the station
    directions: np.ndarray  # (n, 6): w
    components: np.ndarray  # indices of the components in which some w is not zero
    gains: np.ndarray  # (n, 6): derivative of w·e by each strut's length


@dataclass(frozen=True)
class Prediction:
    """Predicted poses, joints and errors of a machine at M stations."""

    errors: np.ndarray  # (M, 6): error e of the measured point, m and rad
    positions: np.ndarray  # (M, 3): actual pose_platform_in_base without the field, m
    rotations: np.ndarray  # (M, 3, 3)
    base_joints: np.ndarray  # (M, 6, 3): real joints in base at each station's temperatures, m
    platform_joints: np.ndarray  # (M, 6, 3): real joints in platform, m
    load: Load
    geometry: HexapodGeometry


class Linkage:
    """The struts at M stations, m in ``base``, and the derivative of the measured point's error by their lengths."""

    def __init__(self, prediction: Prediction, probe: np.ndarray, stations: Stations) -> None:
        self.stations, self.rotations, self.base_joints = stations, prediction.rotations, prediction.base_joints
        self.load, self.geometry = prediction.load, prediction.geometry
        # Platform joints relative to the platform's origin, in base
        self.arms = np.einsum("nij,nkj->nki", self.rotations, prediction.platform_joints)
        struts = prediction.positions[:, None] + self.arms - self.base_joints
        self.lengths = np.linalg.norm(struts, axis=2)
        self.directions = u = struts / self.lengths[..., None]  # unit vectors from base joint to platform joint
        lever = np.einsum("nij,j->ni", self.rotations, probe)
        self.points = prediction.positions + lever  # (M, 3): the measured point
        inverse = self._inverse = np.linalg.inv(np.concatenate([u, np.cross(self.arms, u)], axis=2))
        self.per_length = inverse.copy()  # (M, 6, 6): ∂e/∂l, e of the measured point, not of the platform's origin
        self.per_length[:, :3] += np.cross(inverse[:, 3:].transpose(0, 2, 1), lever[:, None]).transpose(0, 2, 1)

    def tensions(self, wrenches: np.ndarray) -> np.ndarray:
        """Return the struts' tensions, (M, 6), N, under wrenches, (M, 6), about the platform's origin, N and N m."""
        return np.einsum("mij,mi->mj", self._inverse, wrenches)

    def errors(self, at: np.ndarray, directions: np.ndarray, components: np.ndarray) -> Errors:
        """Return n errors w·e at stations `at`, (n,), with w in `directions`, (n, 6); w is 0 outside `components`."""
        return Errors(at, directions, components, np.einsum("nc,ncs->ns", directions, self.per_length[at]))


Columns = Callable[[Errors], np.ndarray]
"""A function that returns the derivatives of n errors by those parameters of a block that change them (`moving`)."""


class Block(ABC):
    """Parameters x = root · y of one physical error; the prior of every y is N(0, tolerance²)."""

    name: ClassVar[str]
    unit: ClassVar[str]  # SI
    tolerance: float  # first guess of the prior's standard deviation; the fit estimates it
    stated: ClassVar[bool] = False  # True: the tolerance is known, not estimated, and the selection keeps the block
    extends: ClassVar[str] = ""  # name of a block that the selection keeps as long as it keeps this block
    labels: tuple[str, ...]  # names of the parameters
    root: np.ndarray  # (n, n): matrix root of the prior's correlation
    part = slice(0, 0)  # slice of the parameter vector that holds the block's parameters

    @classmethod
    @abstractmethod
    def of(cls, facts: Facts) -> Block | None:
        """Return the block for a machine, or None if this machine cannot have the error."""

    @abstractmethod
    def design(self, linkage: Linkage, whitened: bool) -> Columns:
        """Return a function that computes the columns of the design matrix: derivatives by x, or by y if `whitened`."""

    @abstractmethod
    def into(self, draft: Draft, x: np.ndarray) -> None:
        """Write the parameters `x` of this block into a model under construction."""

    def moving(self, components: np.ndarray) -> np.ndarray:
        """Return the ascending indices of the parameters that change at least one of these components of e."""
        return np.arange(len(self.labels))


class StrutBlock(Block):
    """An error of the six struts' lengths, with k parameters of its own for each strut."""

    own: np.ndarray  # (k, k): matrix root of the prior's correlation of one strut's parameters

    def __init__(self, labels: tuple[str, ...] | None = None, own: np.ndarray | None = None) -> None:
        self.labels = labels or tuple(f"{strut} {self.name}" for strut in STRUT_NAMES)
        self.own = np.eye(len(self.labels) // 6) if own is None else own
        self.root = np.kron(np.eye(6), self.own)

    @abstractmethod
    def lengthening(self, linkage: Linkage) -> np.ndarray:
        """Return the derivative of each strut's length by each of its k parameters at M stations, (M, 6, k)."""

    def design(self, linkage: Linkage, whitened: bool) -> Columns:
        """Return the columns: derivative of the error by a strut's length · derivative of this length by x or y."""
        factors = self.lengthening(linkage)
        strut = np.repeat(np.arange(6), factors.shape[2])
        flat = (factors @ self.own if whitened and len(self.own) > 1 else factors).reshape(len(factors), -1)
        return lambda errors: errors.gains[:, strut] * flat[errors.at]
