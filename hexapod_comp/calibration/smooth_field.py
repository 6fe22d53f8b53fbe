"""A smooth six-component field as polynomials over the measured box, and its way into a :class:`GridField`."""

from __future__ import annotations

import itertools

import numpy as np
from numpy.polynomial import legendre

from ..field import GridField

COMPONENT_UNITS = (("dx", "m"), ("dy", "m"), ("dz", "m"), ("rx", "rad"), ("ry", "rad"), ("rz", "rad"))

DECAY = 0.6
"""How much smaller the prior is with every degree: a smooth field has little in its high terms."""

GRID_TOLERANCE = (10e-9, 10e-9)
"""What interpolation between a grid's lines may add to the polynomial, m and rad: far below any reading."""

MOST_NODES = 33


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
    """

    def __init__(self, box: np.ndarray, degree: int) -> None:
        flat = np.ptp(box, axis=0) <= 0.0
        self.box = np.array([box[0], np.where(flat, box[0] + 1.0, box[1])])
        sides = np.ptp(self.box, axis=0)
        cost = np.sqrt(np.where(flat, 1.0, sides).max() / sides)
        every = np.array(list(itertools.product(range(degree + 1), repeat=3)))
        total = every @ cost
        kept = (total <= degree + 1e-9) & ~(every[:, flat] > 0).any(axis=1)
        order = np.argsort(total[kept], kind="stable")
        self.powers = every[kept][order]
        self.prior = DECAY ** total[kept][order]
        self.degree = degree

    @property
    def terms(self) -> tuple[str, ...]:
        """Names of the terms: ``x2y1`` is P₂(x)·P₁(y)."""
        return tuple("".join(f"{a}{n}" for a, n in zip("xyz", p, strict=True) if n) or "1" for p in self.powers)

    def basis(self, points: np.ndarray) -> np.ndarray:
        """Return the terms' values at points (n, 3), m; held at the box; shape (n, terms)."""
        u = np.clip(2.0 * (points - self.box[0]) / (self.box[1] - self.box[0]) - 1.0, -1.0, 1.0)
        along = [legendre.legvander(u[:, a], self.degree) for a in range(3)]
        return np.prod([along[a][:, self.powers[:, a]] for a in range(3)], axis=0)

    def evaluate(self, coefficients: np.ndarray, points: np.ndarray) -> np.ndarray:
        """Return the field of coefficients (6, terms) at points (n, 3), shape (n, 6), m and rad."""
        return self.basis(points) @ coefficients.T

    def as_grid(self, coefficients: np.ndarray) -> GridField:
        """Return the field as lines along x, so many that interpolating between them adds nothing visible.

        Parameters
        ----------
        coefficients : ndarray, shape (6, terms)
            m and rad.
        """
        rng = np.random.default_rng(0)
        points = rng.uniform(self.box[0], self.box[1], (500, 3))
        wanted = self.evaluate(coefficients, points)
        nodes = 2
        while True:
            field = self._lines_along_x(coefficients, nodes)
            found = np.array([field.evaluate(p, np.zeros(3))[0] for p in points])
            error = np.abs(found - wanted).max(axis=0)
            if nodes >= MOST_NODES or (error <= np.repeat(GRID_TOLERANCE, 3)).all():
                return field
            nodes = min(MOST_NODES, 2 * nodes - 1)

    def _lines_along_x(self, coefficients: np.ndarray, nodes: int) -> GridField:
        """Return the field on nodes × nodes lines along x, the same in both directions."""
        low, high = self.box
        y, z = (np.linspace(low[a], high[a], nodes) for a in (1, 2))
        across = np.array([[(low[0], b, c) for c in z] for b in y]).reshape(-1, 3)
        u = 2.0 * (across - low) / (high - low) - 1.0
        weights = [legendre.legvander(u[:, a], self.degree)[:, self.powers[:, a]] for a in (1, 2)]
        powers = np.array([_monomials(n, self.degree) for n in self.powers[:, 0]])
        lines = np.einsum("nt,ct,tp->ncp", weights[0] * weights[1], coefficients, powers)
        family = np.tile(lines.reshape(1, nodes, nodes, 6, -1), (2, 1, 1, 1, 1))
        empty_y, empty_z = np.zeros((2, 2, nodes, 6, 0)), np.zeros((2, 2, nodes, 6, 0))
        return GridField((np.array([low[0], high[0]]), y, z), (family, empty_y, empty_z))


def _monomials(n: int, degree: int) -> np.ndarray:
    """Return P_n in powers of u, shape (degree + 1,)."""
    series = legendre.leg2poly(np.eye(degree + 1)[n])
    return np.append(series, np.zeros(degree + 1 - len(series)))
