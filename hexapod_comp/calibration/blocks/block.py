"""A block: one physical error, with its prior, its columns of the design matrix, and its parameters in the model.

e = (dx, dy, dz, rx, ry, rz) is the tool error, actual minus commanded: displacement of the measured point along, and
rotation of the platform about, the axes of base. M is the number of stations; l are the strut lengths.
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

DIGITS = 11  # decimals of m and rad in a model file: 0.01 nm


class Facts(NamedTuple):
    """Machine, region and settings, from which :meth:`Block.of` makes a block."""

    geometry: HexapodGeometry
    region: Extent
    settings: FitSettings
    home_lengths: np.ndarray  # (6,), m
    platform_groups: np.ndarray  # (6,): index of each strut's platform joint; struts may share a joint
    periods: np.ndarray  # (6,): lead of each screw, m; NaN if unknown
    smooth: SmoothField  # polynomials of the field


@dataclass
class Draft:
    """A model under construction, into which each block writes its parameters."""

    machine: dict[str, Any]  # arguments of MachineModel
    struts: dict[str, Any]  # arguments of StrutErrors
    growth: np.ndarray  # (8,): expansion of struts 1-6, base and platform, 1/K: stated, then plus fitted deviation
    field: np.ndarray  # (6, terms): coefficients of the field, mean of both directions of motion, m and rad
    reversal: np.ndarray  # (3, 6, reversal terms): field forward minus backward, for motion along x, y, z
    late: np.ndarray  # (8, time constants): delayed expansion of struts 1-6, base and platform, 1/K
    load: Load  # stated, then plus fitted deviations


class Errors(NamedTuple):
    """n scalar errors w·e, one for each row of the design matrix; e is the tool error at a station."""

    at: np.ndarray  # (n,): index of the station of each error
    directions: np.ndarray  # (n, 6): w
    components: np.ndarray  # indices of the components of e that are not zero in every w
    gains: np.ndarray  # (n, 6): ∂(w·e)/∂l


@dataclass(frozen=True)
class Prediction:
    """What a vector of parameters predicts for M stations: tool errors, platform poses and joint positions."""

    errors: np.ndarray  # (M, 6): tool error e, m and rad
    positions: np.ndarray  # (M, 3): pose_platform_in_base without the field, m
    rotations: np.ndarray  # (M, 3, 3)
    base_joints: np.ndarray  # (M, 6, 3): real joints in base at each station's temperatures, m
    platform_joints: np.ndarray  # (M, 6, 3): real joints in platform, m
    load: Load
    geometry: HexapodGeometry


class Linkage:
    """Geometry of the struts at M stations, in ``base``, m, and ∂e/∂l, derivatives of the tool error by strut lengths.

    Loop closure of strut i, from base joint b_i along u_i to platform joint t_i: u_i·(δP + δω × R·t_i + R·δt_i − δb_i)
    = δl_i. So (δP, δω) = X·(δl + u·δb − u·R·δt), with X the inverse of the matrix of rows (u_i, R·t_i × u_i).
    """

    def __init__(self, prediction: Prediction, probe: np.ndarray, stations: Stations) -> None:
        self.stations, self.rotations, self.base_joints = stations, prediction.rotations, prediction.base_joints
        self.load, self.geometry = prediction.load, prediction.geometry
        self.arms = np.einsum("nij,nkj->nki", self.rotations, prediction.platform_joints)
        struts = prediction.positions[:, None] + self.arms - self.base_joints
        self.lengths = np.linalg.norm(struts, axis=2)
        self.directions = u = struts / self.lengths[..., None]  # unit vectors, from base to platform
        lever = np.einsum("nij,j->ni", self.rotations, probe)
        self.points = prediction.positions + lever  # (M, 3): measured point
        inverse = self._inverse = np.linalg.inv(np.concatenate([u, np.cross(self.arms, u)], axis=2))
        self.per_length = inverse.copy()  # (M, 6, 6): ∂e/∂l of the measured point
        self.per_length[:, :3] += np.cross(inverse[:, 3:].transpose(0, 2, 1), lever[:, None]).transpose(0, 2, 1)

    def tensions(self, wrenches: np.ndarray) -> np.ndarray:
        """Return the struts' tensions (M, 6), N, by `wrenches`: force, N, and torque about platform's origin, N m."""
        return np.einsum("mij,mi->mj", self._inverse, wrenches)

    def errors(self, at: np.ndarray, directions: np.ndarray, components: np.ndarray) -> Errors:
        """Return n errors w·e at the stations `at`; the rows w of `directions` (n, 6) are zero outside `components`."""
        return Errors(at, directions, components, np.einsum("nc,ncs->ns", directions, self.per_length[at]))


Columns = Callable[[Errors], np.ndarray]
"""Function that returns the derivatives (n, k) of n errors by those k parameters of a block that change them."""


class Block(ABC):
    """Parameters x = root · y of one physical error; the y are independent with the prior N(0, tolerance²)."""

    name: ClassVar[str]
    unit: ClassVar[str]  # SI
    tolerance: float  # prior σ of y, first guess
    stated: ClassVar[bool] = False  # whether the fit always keeps the block and this tolerance
    extends: ClassVar[str] = ""  # name of a block that the fit keeps if it keeps this one
    labels: tuple[str, ...]  # name of each parameter
    root: np.ndarray  # (n, n): root·rootᵀ is the prior's correlation of x
    part = slice(0, 0)  # indices of the block's parameters in the parameter vector

    @classmethod
    @abstractmethod
    def of(cls, facts: Facts) -> Block | None:
        """Return the block, or None if this machine cannot have the error."""

    @classmethod
    def shown(cls, settings: FitSettings, geometry: HexapodGeometry, stations: Stations) -> bool:
        """Whether readings at the stations can show the error; some errors need a change of temperature or load."""
        return True

    @abstractmethod
    def design(self, linkage: Linkage, whitened: bool) -> Columns:
        """Return a function that computes columns of the design matrix: derivatives by x or, if `whitened`, by y."""

    @abstractmethod
    def into(self, draft: Draft, x: np.ndarray) -> None:
        """Write the block's parameters x into the draft of a model."""

    def moving(self, components: np.ndarray) -> np.ndarray:
        """Return the ascending indices of the parameters that change any of these `components` of the tool error."""
        return np.arange(len(self.labels))


class LengthBlock(Block):
    """An error of strut lengths; one parameter may change the lengths of several struts."""

    @abstractmethod
    def lengthening(self, linkage: Linkage) -> np.ndarray:
        """Return the derivatives (stations, 6, n) of each strut's length by all n parameters x."""

    def design(self, linkage: Linkage, whitened: bool) -> Columns:
        factors = self.lengthening(linkage) @ (self.root if whitened else np.eye(len(self.root)))
        return lambda errors: np.einsum("ns,nsp->np", errors.gains, factors[errors.at])


class StrutBlock(Block):
    """An error of strut lengths; each strut has k parameters of its own."""

    own: np.ndarray  # (k, k): `root` for one strut

    def __init__(self, labels: tuple[str, ...] | None = None, own: np.ndarray | None = None) -> None:
        self.labels = labels or tuple(f"{strut} {self.name}" for strut in STRUT_NAMES)
        self.own = np.eye(len(self.labels) // 6) if own is None else own
        self.root = np.kron(np.eye(6), self.own)

    @abstractmethod
    def lengthening(self, linkage: Linkage) -> np.ndarray:
        """Return the derivatives (stations, 6, k) of each strut's length by its own k parameters."""

    def design(self, linkage: Linkage, whitened: bool) -> Columns:
        factors = self.lengthening(linkage)
        strut = np.repeat(np.arange(6), factors.shape[2])
        flat = (factors @ self.own if whitened and len(self.own) > 1 else factors).reshape(len(factors), -1)
        return lambda errors: errors.gains[:, strut] * flat[errors.at]
