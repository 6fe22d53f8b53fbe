"""A block: one physical error, with its prior, its columns of the design matrix, and its parameters in the model.

The error of the measured point is e = (dx, dy, dz, rx, ry, rz), actual minus commanded, along and about the axes of
``base``. Nearly every error acts through the struts: from u_i·(δP + δω × R·t_i + R·δt_i − δb_i) = δl_i the platform's
twist is X·(δl + u·δb − u·R·δt), with X the inverse of the Jacobian's rows (u_i, R·t_i × u_i).
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

DIGITS = 11  # after the point in a model file: a hundredth of a nanometre


class Facts(NamedTuple):
    """Input from which blocks are made."""

    geometry: HexapodGeometry
    region: Extent  # what was measured
    settings: FitSettings
    home_lengths: np.ndarray  # (6,), m
    platform_groups: np.ndarray  # (6,): index of each strut's ball joint on the platform
    periods: np.ndarray  # (6,): of the screws' errors, m; NaN where the lead is not known
    smooth: SmoothField  # the field's polynomials over the measured box


@dataclass
class Draft:
    """A model under construction: arguments of MachineModel and StrutErrors, and the field's coefficients."""

    machine: dict[str, Any]
    struts: dict[str, Any]
    growth: np.ndarray  # (8,): expansion of struts 1-6, base and platform, 1/K
    field: np.ndarray  # (6, terms), mean of both directions, m and rad
    reversal: np.ndarray  # (3, 6, reversal terms): forward minus backward along x, y, z, m and rad
    late: np.ndarray  # (8, time constants), 1/K
    load: dict[str, np.ndarray]  # terms of the load block beyond the stated, by name, SI; compliance for stiffness


class Errors(NamedTuple):
    """Errors whose design matrix is computed: n of them, one a row."""

    at: np.ndarray  # (n,): station
    directions: np.ndarray  # (n, 6): w of each
    components: np.ndarray  # which of the six components they have
    gains: np.ndarray  # (n, 6): by what each strut's length moves them


@dataclass(frozen=True)
class Prediction:
    """The machine at some stations."""

    errors: np.ndarray  # (M, 6): e of each station, m and rad
    positions: np.ndarray  # (M, 3): actual pose_platform_in_base without the field, m
    rotations: np.ndarray  # (M, 3, 3)
    base_joints: np.ndarray  # (M, 6, 3): real joints at each station's temperatures, m
    platform_joints: np.ndarray
    load: Load
    geometry: HexapodGeometry


class Linkage:
    """The struts at some stations, and the effect of their lengths on the measured point; metres in ``base``."""

    def __init__(self, prediction: Prediction, probe: np.ndarray, stations: Stations) -> None:
        self.stations, self.rotations, self.base_joints = stations, prediction.rotations, prediction.base_joints
        self.load, self.geometry = prediction.load, prediction.geometry
        self.arms = np.einsum("nij,nkj->nki", self.rotations, prediction.platform_joints)  # from the platform's origin
        struts = prediction.positions[:, None] + self.arms - self.base_joints
        self.lengths = np.linalg.norm(struts, axis=2)
        self.directions = u = struts / self.lengths[..., None]  # from base to platform
        lever = np.einsum("nij,j->ni", self.rotations, probe)
        self.points = prediction.positions + lever  # the measured point
        inverse = self._inverse = np.linalg.inv(np.concatenate([u, np.cross(self.arms, u)], axis=2))
        # ∂e by the six lengths, (M, 6, 6): of the measured point, not of the platform's origin
        self.per_length = inverse.copy()
        self.per_length[:, :3] += np.cross(inverse[:, 3:].transpose(0, 2, 1), lever[:, None]).transpose(0, 2, 1)

    def tensions(self, wrenches: np.ndarray) -> np.ndarray:
        """Return the struts' tensions under forces and torques about platform's origin (M, 6), (M, 6), N."""
        return np.einsum("mij,mi->mj", self._inverse, wrenches)

    def errors(self, at: np.ndarray, directions: np.ndarray, components: np.ndarray) -> Errors:
        """Return errors of stations `at` along directions (n, 6), of which only the given components are not zero."""
        return Errors(at, directions, components, np.einsum("nc,ncs->ns", directions, self.per_length[at]))


Columns = Callable[[Errors], np.ndarray]
"""A function that returns a block's columns of the design matrix, (n, parameters), or only those that move the errors'
components."""


class Block(ABC):
    """A block of parameters x = root · y; the prior of every y is N(0, tolerance²)."""

    name: ClassVar[str]
    unit: ClassVar[str]  # SI
    tolerance: float  # first guess of the prior's standard deviation; the fit estimates it
    stated: ClassVar[bool] = False  # whether the tolerance is known, and the block with it in every fit
    labels: tuple[str, ...]  # names of the parameters
    root: np.ndarray  # (n, n): root of the prior's correlation
    part = slice(0, 0)  # its slice of the parameter vector

    @classmethod
    @abstractmethod
    def of(cls, facts: Facts) -> Block | None:
        """Return the block of a machine; None where it cannot have this error."""

    @abstractmethod
    def design(self, linkage: Linkage, whitened: bool) -> Columns:
        """Return this block's columns at some stations, by x or, whitened, by y."""

    @abstractmethod
    def into(self, draft: Draft, x: np.ndarray) -> None:
        """Write its parameters into a model."""

    def moving(self, components: np.ndarray) -> np.ndarray:
        """Return the indices, ascending, of the parameters that change an error of which only these components are not
        zero."""
        return np.arange(len(self.labels))


class StrutBlock(Block):
    """An error of the six struts' lengths, each strut with its own parameters."""

    own: np.ndarray  # (k, k): root of one strut's parameters

    def __init__(self, labels: tuple[str, ...] | None = None, own: np.ndarray | None = None) -> None:
        self.labels = labels or tuple(f"{strut} {self.name}" for strut in STRUT_NAMES)
        self.own = np.eye(len(self.labels) // 6) if own is None else own
        self.root = np.kron(np.eye(6), self.own)

    @abstractmethod
    def lengthening(self, linkage: Linkage) -> np.ndarray:
        """Return by how much each strut's parameters lengthen it, (M, 6, k)."""

    def design(self, linkage: Linkage, whitened: bool) -> Columns:
        """Return columns: a strut's lengthening moves the point by that strut's gain."""
        factors = self.lengthening(linkage)
        strut = np.repeat(np.arange(6), factors.shape[2])
        flat = (factors @ self.own if whitened and len(self.own) > 1 else factors).reshape(len(factors), -1)
        return lambda errors: errors.gains[:, strut] * flat[errors.at]
