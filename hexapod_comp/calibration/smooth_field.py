"""What is smooth: a six-component field as polynomials over the measured box, with its way into a :class:`GridField`,
and the errors of a length map.
"""

from __future__ import annotations

import itertools

import numpy as np
from numpy.polynomial import legendre

from ..machine.field import CROSS_AXES, GridField
from ..measurements.readings import LEAST_SIDE

COMPONENT_UNITS = (("dx", "m"), ("dy", "m"), ("dz", "m"), ("rx", "rad"), ("ry", "rad"), ("rz", "rad"))

DECAY = 0.6
"""How much smaller the prior is with every degree: a smooth field has little in its high terms."""

REVERSAL_DEGREE = 2
"""Degree of what depends on the direction of motion."""

GRID_TOLERANCE = 30e-9
"""What interpolation between a grid's lines may add to the polynomial, m and rad: far below any reading."""

DIGITS = 11
"""Digits after the point of what goes into a model file, m, rad or m/m: a hundredth of a nanometre."""

CHECKED = 400
"""Random points at which that is checked."""

MOST_NODES = 17
"""Nodes along the longest axis at most: more make the model file too long to read."""

KNOT_DISTANCE = 0.017
"""Largest distance of the length map's knots, m: a wave of 60 mm has then three and a half knots."""

WEAR_KNOTS = 2
"""Wear is smoother than a length map: every second of its knots is enough."""

MAP_CORRELATION_LENGTH = 0.04
"""How far the errors of a length map are alike, m (Matérn 5/2)."""


def map_knots(low: float, high: float) -> np.ndarray:
    """Return equidistant knots over the commands seen, at most :data:`KNOT_DISTANCE` apart."""
    span = max(high - low, KNOT_DISTANCE)
    return np.linspace(low, low + span, int(np.ceil(span / KNOT_DISTANCE)) + 1)


def wear_knots(knots: np.ndarray) -> np.ndarray:
    """Return those of a length map's knots that wear needs, both ends among them.

    A natural spline through them is one through all knots.
    """
    last = len(knots) - 1
    return knots[np.linspace(0, last, max(2, last // WEAR_KNOTS + 1)).round().astype(int)]


def map_root(knots: np.ndarray) -> np.ndarray:
    """Return a root of the Matérn 5/2 correlation between the knots of one strut, shape (n, n)."""
    d = np.sqrt(5.0) * np.abs(knots[:, None] - knots) / MAP_CORRELATION_LENGTH
    return np.linalg.cholesky((1.0 + d + d * d / 3.0) * np.exp(-d) + 1e-9 * np.eye(len(knots)))


class SmoothField:
    """Products of Legendre polynomials in x, y, z over a box, the degree in proportion to its sides.

    Parameters
    ----------
    box : ndarray, shape (2, 3)
        Corners of the measured points, m in ``base``; a side of no length carries no power.
    degree : int
        Highest degree along the box's longest side. Every degree along a shorter side counts for more, so
        that the field is equally smooth in all directions.

    Attributes
    ----------
    powers : ndarray of int, shape (terms, 3)
        Degrees along x, y, z of each term.
    prior : ndarray, shape (terms,)
        Relative size of the terms' priors.
    reversal_powers, reversal_prior : ndarray
        The same of what depends on the direction of motion: fewer terms.
    """

    def __init__(self, box: np.ndarray, degree: int) -> None:
        flat = np.ptp(box, axis=0) < LEAST_SIDE
        self.box = np.array([box[0], np.where(flat, box[0] + 1.0, box[1])])
        self._sides = np.where(flat, 0.0, np.ptp(self.box, axis=0))
        cost = np.sqrt(max(self._sides.max(), 1e-3) / np.where(flat, 1.0, self._sides))
        self.degree = degree
        self.powers, self.prior = _terms(degree, cost, flat)
        self.reversal_powers, self.reversal_prior = _terms(min(degree, REVERSAL_DEGREE), cost, flat)

    @property
    def terms(self) -> tuple[str, ...]:
        """Names of the terms: ``x2y1`` is P₂(x)·P₁(y)."""
        return _names(self.powers)

    @property
    def reversal_terms(self) -> tuple[str, ...]:
        """Names of the terms of what depends on the direction."""
        return _names(self.reversal_powers)

    def basis(self, points: np.ndarray) -> np.ndarray:
        """Return the terms' values at points (n, 3), m; held at the box; shape (n, terms)."""
        return self._products(points, self.powers)

    def reversal_basis(self, points: np.ndarray) -> np.ndarray:
        """Return the same of the terms of what depends on the direction."""
        return self._products(points, self.reversal_powers)

    def _products(self, points: np.ndarray, powers: np.ndarray) -> np.ndarray:
        u = np.clip(2.0 * (points - self.box[0]) / (self.box[1] - self.box[0]) - 1.0, -1.0, 1.0)
        along = [legendre.legvander(u[:, a], self.degree) for a in range(3)]
        x, y, z = (values[:, power] for values, power in zip(along, powers.T, strict=True))
        return x * y * z

    def evaluate(
        self, coefficients: np.ndarray, reversal: np.ndarray, points: np.ndarray, sense: np.ndarray
    ) -> np.ndarray:
        """Return the field at points, shape (n, 6), m and rad.

        Parameters
        ----------
        coefficients : ndarray, shape (6, terms)
            Mean of both directions, m and rad.
        reversal : ndarray, shape (3, 6, reversal terms)
            Forward minus backward along x, y, z, m and rad.
        points, sense : ndarray, shape (n, 3)
            Places, m, and directions of motion along the axes, −1…1.
        """
        turning = np.einsum("nt,act,na->nc", self.reversal_basis(points), reversal, 0.5 * sense)
        return self.basis(points) @ coefficients.T + turning

    def as_grid(self, coefficients: np.ndarray, reversal: np.ndarray) -> GridField:
        """Return the field as grid lines, so many that interpolating between them adds nothing visible.

        Terms that do not depend on the direction of motion stand on the lines along the axis of their highest
        power: across it their powers are small, and bilinear interpolation is exact up to 1. What changes sign
        with the motion along an axis stands on the lines along that axis.

        Parameters
        ----------
        coefficients : ndarray, shape (6, terms)
            Mean of both directions, m and rad.
        reversal : ndarray, shape (3, 6, reversal terms)
            Forward minus backward along x, y, z, m and rad.
        """
        points = np.random.default_rng(0).uniform(self.box[0], self.box[1], (CHECKED, 3))
        sense = np.where(np.arange(CHECKED)[:, None] % 2, 1.0, -1.0) * np.ones(3)
        wanted = self.evaluate(coefficients, reversal, points, sense)
        nodes = 2
        while True:
            field = self._on_lines(coefficients, reversal, nodes)
            values = np.array([field.evaluate(p, s)[0] for p, s in zip(points, sense, strict=True)])
            if nodes >= MOST_NODES or (np.abs(values - wanted).max(axis=0) <= GRID_TOLERANCE).all():
                return field
            nodes = 2 * nodes - 1

    def _on_lines(self, coefficients: np.ndarray, reversal: np.ndarray, nodes: int) -> GridField:
        """Return the field on a grid of so many nodes along the longest axis, as far apart along the others."""
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
        along = np.array([_monomials(n, degree) for n in powers[:, axis]])
        return np.einsum("nmt,ct,tp->nmcp", weights, coefficients, along)


def _terms(degree: int, cost: np.ndarray, flat: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the powers (n, 3) of all terms up to a degree, and the relative size of their priors (n,)."""
    every = np.array(list(itertools.product(range(degree + 1), repeat=3)))
    total = every @ cost
    bilinear = (every.max(axis=1) <= 1) & (every.sum(axis=1) <= 2)  # squareness, twist and roll are always asked for
    kept = ((total <= degree + 1e-9) | bilinear) & ~(every[:, flat] > 0).any(axis=1)
    order = np.argsort(total[kept], kind="stable")
    return every[kept][order], DECAY ** total[kept][order]


def _names(powers: np.ndarray) -> tuple[str, ...]:
    return tuple("".join(f"{a}{n}" for a, n in zip("xyz", p, strict=True) if n) or "1" for p in powers)


def _monomials(n: int, degree: int) -> np.ndarray:
    """Return P_n in powers of u, shape (degree + 1,)."""
    series = legendre.leg2poly(np.eye(degree + 1)[n])
    return np.append(series, np.zeros(degree + 1 - len(series)))
