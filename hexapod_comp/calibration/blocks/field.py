"""The field: errors that neither struts nor joints explain, six components as polynomials over the measured box.

Displacement, rotation, and the part of both that changes sign with the direction of motion (reversal) are separate
blocks.
"""

from __future__ import annotations

import itertools

import numpy as np
from numpy.polynomial import legendre

from ...machine.field import CROSS_AXES, GridField
from ...measurements.readings import AXES, LEAST_SIDE
from ..assumptions import ASSUMED
from .block import DIGITS, Block, Columns, Draft, Errors, Facts, Linkage

GRID_TOLERANCE = 30e-9  # largest error of a grid relative to its polynomial, m or rad: below readings
MOST_NODES = 17  # nodes of a field along its longest axis, so that the model file stays readable
CHECKS = 400  # random points at which a grid is checked

COMPONENTS = ("dx", "dy", "dz", "rx", "ry", "rz")


class SmoothField:
    """Products of Legendre polynomials in x, y, z over a box, the degree in proportion to its sides.

    A side of length zero has no powers; every degree along a shorter side counts for more than one along the longest,
    so that the field is equally smooth in all directions. The part that depends on the direction of motion has fewer
    terms.
    """

    def __init__(self, box: np.ndarray, degree: int) -> None:
        flat = np.ptp(box, axis=0) < LEAST_SIDE
        self.box = np.array([box[0], np.where(flat, box[0] + 1.0, box[1])])
        self._sides = np.where(flat, 0.0, np.ptp(self.box, axis=0))
        cost = np.sqrt(max(self._sides.max(), 1e-3) / np.where(flat, 1.0, self._sides))
        self.degree = degree
        self.powers, self.prior = _terms(degree, cost, flat)  # (terms, 3) along x, y, z; relative size of the priors
        self.reversal_powers, self.reversal_prior = _terms(min(degree, ASSUMED.reversal_degree), cost, flat)
        self.terms, self.reversal_terms = _names(self.powers), _names(self.reversal_powers)

    def basis(self, points: np.ndarray) -> np.ndarray:
        """Return the terms' values at points (n, 3), m; held at the box; shape (n, terms)."""
        return self._products(points, self.powers)

    def reversal_basis(self, points: np.ndarray) -> np.ndarray:
        """Return :meth:`basis` for the terms that depend on the direction of motion."""
        return self._products(points, self.reversal_powers)

    def _products(self, points: np.ndarray, powers: np.ndarray) -> np.ndarray:
        u = np.clip(2.0 * (points - self.box[0]) / (self.box[1] - self.box[0]) - 1.0, -1.0, 1.0)
        along = [legendre.legvander(u[:, a], self.degree) for a in range(3)]
        x, y, z = (values[:, power] for values, power in zip(along, powers.T, strict=True))
        return x * y * z

    def evaluate(
        self, coefficients: np.ndarray, reversal: np.ndarray, points: np.ndarray, sense: np.ndarray
    ) -> np.ndarray:
        """Return the field at points, shape (n, 6), m and rad."""
        turning = np.einsum("nt,act,na->nc", self.reversal_basis(points), reversal, 0.5 * sense)
        return self.basis(points) @ coefficients.T + turning

    def as_grid(self, coefficients: np.ndarray, reversal: np.ndarray) -> GridField:
        """Return the field as grid lines, with enough of them that interpolation adds nothing visible.

        Terms that do not depend on the direction of motion are on the lines along the axis of their highest power:
        across it their powers are small, and bilinear interpolation is exact up to 1. Terms that change sign with the
        motion along an axis are on the lines along that axis.
        """
        points = np.random.default_rng(0).uniform(self.box[0], self.box[1], (CHECKS, 3))
        sense = np.where(np.arange(CHECKS)[:, None] % 2, 1.0, -1.0) * np.ones(3)
        wanted = self.evaluate(coefficients, reversal, points, sense)
        nodes = 2
        while True:
            field = self._on_lines(coefficients, reversal, nodes)
            values = np.array([field.evaluate(p, s)[0] for p, s in zip(points, sense, strict=True)])
            if nodes >= MOST_NODES or (np.abs(values - wanted).max(axis=0) <= GRID_TOLERANCE).all():
                return field
            nodes = 2 * nodes - 1

    def _on_lines(self, coefficients: np.ndarray, reversal: np.ndarray, nodes: int) -> GridField:
        """Return the field on a grid with this number of nodes along the longest axis, and the same spacing along the
        others."""
        share = self._sides / max(self._sides.max(), 1e-3)
        counts = np.maximum(2, np.ceil(share * (nodes - 1)).astype(int) + 1)
        grid = tuple(np.linspace(self.box[0, a], self.box[1, a], n) for a, n in enumerate(counts))
        families = []
        for axis in range(3):
            half = 0.5 * self._family(grid, axis, reversal[axis], self.reversal_powers)
            members = self.powers.argmax(axis=1) == axis
            mean = self._family(grid, axis, coefficients[:, members], self.powers[members])
            wide = np.zeros((*mean.shape[:-1], max(mean.shape[-1], half.shape[-1])))
            family = np.stack([wide, wide])
            family[..., : mean.shape[-1]] += mean
            family[0, ..., : half.shape[-1]] += half
            family[1, ..., : half.shape[-1]] -= half
            families.append(family.round(DIGITS) if family.any() else family[..., :0])
        return GridField((grid[0], grid[1], grid[2]), (families[0], families[1], families[2]))

    def _family(self, grid: tuple, axis: int, coefficients: np.ndarray, powers: np.ndarray) -> np.ndarray:
        """Return the polynomials in u of the lines along an axis, shape (n, m, 6, powers)."""
        first, second = CROSS_AXES[axis]
        degree = int(powers.max(initial=0))
        if not len(powers):
            return np.zeros((len(grid[first]), len(grid[second]), 6, 1))
        across = [legendre.legvander(np.linspace(-1.0, 1.0, len(grid[a])), degree) for a in (first, second)]
        weights = np.einsum("nt,mt->nmt", across[0][:, powers[:, first]], across[1][:, powers[:, second]])
        monomials = np.zeros((degree + 1, degree + 1))  # P_n in powers of u
        for n, row in enumerate(monomials):
            row[: n + 1] = legendre.leg2poly([0.0] * n + [1.0])
        return np.einsum("nmt,ct,tp->nmcp", weights, coefficients, monomials[powers[:, axis]])


class _Field(Block):
    """Errors of which each of the six components has its own coefficients of a basis."""

    owner: np.ndarray  # component of each parameter

    def __init__(self, smooth: SmoothField) -> None:
        self.smooth = smooth

    @classmethod
    def of(cls, facts: Facts) -> _Field:
        """Every machine may have it."""
        return cls(facts.smooth)

    def moving(self, components: np.ndarray) -> np.ndarray:
        """Each component has its own parameters."""
        return np.flatnonzero(np.isin(self.owner, components))


class FieldDisplacement(_Field):
    """Displacement along x, y, z."""

    name, unit, tolerance = "field displacement", "m", 5e-6
    first = 0  # of its three components

    def __init__(self, smooth: SmoothField) -> None:
        super().__init__(smooth)
        self.owner = np.repeat(np.arange(self.first, self.first + 3), len(smooth.terms))
        self.labels = tuple(f"{COMPONENTS[self.first + c]} {t}" for c in range(3) for t in smooth.terms)
        self.root = np.diag(np.tile(smooth.prior, 3))

    def design(self, linkage: Linkage, whitened: bool) -> Columns:
        """The terms at the point, by each direction's share of the component."""
        basis = self.smooth.basis(linkage.points) * (self.smooth.prior if whitened else 1.0)

        def columns(errors: Errors) -> np.ndarray:
            own = [c for c in errors.components if self.first <= c < self.first + 3]
            moved = errors.directions[:, own, None] * basis[errors.at][:, None]
            return moved.reshape(len(errors.at), -1)

        return columns

    def into(self, draft: Draft, x: np.ndarray) -> None:
        """Written into its three components."""
        draft.field[self.first : self.first + 3] = x.reshape(3, -1)


class FieldRotation(FieldDisplacement):
    """Rotation about x, y, z."""

    name, unit, tolerance, first = "field rotation", "rad", 20e-6, 3


class FieldReversal(_Field):
    """Forward minus backward along x, y, z, of all six components."""

    name, unit, tolerance = "field reversal", "m, rad", 1e-6

    def __init__(self, smooth: SmoothField) -> None:
        super().__init__(smooth)
        self.owner = np.repeat(np.tile(np.arange(6), 3), len(smooth.reversal_terms))
        self.labels = tuple(f"{c} {t} reversal {a}" for a in AXES for c in COMPONENTS for t in smooth.reversal_terms)
        self.root = np.diag(np.tile(smooth.reversal_prior, 18))

    def design(self, linkage: Linkage, whitened: bool) -> Columns:
        """Half the terms, by the direction of motion along each axis."""
        basis = self.smooth.reversal_basis(linkage.points) * (self.smooth.reversal_prior if whitened else 1.0)
        half = 0.5 * linkage.stations.sense[:, :3]

        def columns(errors: Errors) -> np.ndarray:
            weights = half[errors.at][:, :, None] * errors.directions[:, None, errors.components]
            return (weights[..., None] * basis[errors.at][:, None, None]).reshape(len(errors.at), -1)

        return columns

    def into(self, draft: Draft, x: np.ndarray) -> None:
        """Written by axis of motion and component."""
        draft.reversal[:] = x.reshape(draft.reversal.shape)


def _terms(degree: int, cost: np.ndarray, flat: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the powers (n, 3) of all terms up to a degree, and the relative size of their priors (n,)."""
    every = np.array(list(itertools.product(range(degree + 1), repeat=3)))
    total = every @ cost
    bilinear = (every.max(axis=1) <= 1) & (every.sum(axis=1) <= 2)  # squareness, twist and roll are always included
    kept = ((total <= degree + 1e-9) | bilinear) & ~(every[:, flat] > 0).any(axis=1)
    order = np.argsort(total[kept], kind="stable")
    return every[kept][order], ASSUMED.field_decay ** total[kept][order]


def _names(powers: np.ndarray) -> tuple[str, ...]:
    return tuple("".join(f"{a}{n}" for a, n in zip("xyz", p, strict=True) if n) or "1" for p in powers)
