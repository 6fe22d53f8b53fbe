"""The error field: tool errors that neither struts nor joints explain, as polynomials over the measured box."""

from __future__ import annotations

import itertools

import numpy as np
from numpy.polynomial import legendre

from ...machine.field import COMPONENTS, CROSS_AXES, GridField
from ...measurements.readings import AXES, LEAST_SIDE
from ..assumptions import ASSUMED
from .block import DIGITS, Block, Columns, Draft, Errors, Facts, Linkage

GRID_TOLERANCE = 30e-9  # largest error of interpolation on the model's grid, m or rad: well below a laser's noise
MOST_NODES = 17  # largest number of grid nodes along the longest side of the box: keeps the model file readable
CHECKS = 400  # number of random points at which grid and polynomials are compared


class SmoothField:
    """The polynomials of the error field: terms, which are products of Legendre polynomials in x, y and z on a box.

    Degrees are lower along shorter sides of the box, so that the field is equally smooth along x, y and z. The field's
    reversal (forward minus backward) has at most the degree ASSUMED.reversal_degree.
    """

    def __init__(self, box: np.ndarray, degree: int) -> None:
        flat = np.ptp(box, axis=0) < LEAST_SIDE
        self.box = np.array([box[0], np.where(flat, box[0] + 1.0, box[1])])
        self._sides = np.where(flat, 0.0, np.ptp(self.box, axis=0))
        cost = np.sqrt(max(self._sides.max(), 1e-3) / np.where(flat, 1.0, self._sides))
        self.degree = degree
        # For each term: its degrees along x, y, z, (terms, 3), and its prior σ divided by the constant's, (terms,)
        self.powers, self.prior = _terms(degree, cost, flat)
        self.reversal_powers, self.reversal_prior = _terms(min(degree, ASSUMED.reversal_degree), cost, flat)
        self.terms, self.reversal_terms = _names(self.powers), _names(self.reversal_powers)

    def basis(self, points: np.ndarray) -> np.ndarray:
        """Return the terms' values (n, terms) at points (n, 3), m; outside the box, those at its nearest point."""
        return self._products(points, self.powers)

    def reversal_basis(self, points: np.ndarray) -> np.ndarray:
        return self._products(points, self.reversal_powers)

    def _products(self, points: np.ndarray, powers: np.ndarray) -> np.ndarray:
        u = np.clip(2.0 * (points - self.box[0]) / (self.box[1] - self.box[0]) - 1.0, -1.0, 1.0)
        along = [legendre.legvander(u[:, a], self.degree) for a in range(3)]
        x, y, z = (values[:, power] for values, power in zip(along, powers.T, strict=True))
        return x * y * z

    def evaluate(
        self, coefficients: np.ndarray, reversal: np.ndarray, points: np.ndarray, sense: np.ndarray
    ) -> np.ndarray:
        """Return the error field (n, 6), m, rad, at `points` (n, 3), m, for motions with the signs `sense` (n, 3)."""
        turning = np.einsum("nt,act,na->nc", self.reversal_basis(points), reversal, 0.5 * sense)
        return self.basis(points) @ coefficients.T + turning

    def as_grid(self, coefficients: np.ndarray, reversal: np.ndarray) -> GridField:
        """Return the error field as polynomials along grid lines, accurate to GRID_TOLERANCE or with MOST_NODES nodes.

        Each term is stored on lines along the axis of its highest degree: along these it is exact, and only its lower
        degrees are interpolated (bilinearly) between the lines.
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
        """Return the error field on a regular grid with `nodes` nodes along the longest side of the box."""
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
        """Return polynomials of u = −1…1 on the n × m grid lines along `axis`: coefficients (n, m, 6, powers)."""
        first, second = CROSS_AXES[axis]
        degree = int(powers.max(initial=0))
        if not len(powers):
            return np.zeros((len(grid[first]), len(grid[second]), 6, 1))
        across = [legendre.legvander(np.linspace(-1.0, 1.0, len(grid[a])), degree) for a in (first, second)]
        weights = np.einsum("nt,mt->nmt", across[0][:, powers[:, first]], across[1][:, powers[:, second]])
        monomials = np.zeros((degree + 1, degree + 1))  # row n: Legendre polynomial P_n
        for n, row in enumerate(monomials):
            row[: n + 1] = legendre.leg2poly([0.0] * n + [1.0])
        return np.einsum("nmt,ct,tp->nmcp", weights, coefficients, monomials[powers[:, axis]])


class _Field(Block):
    """A part of the error field; its parameters are the coefficients of terms in components of the tool error e."""

    owner: np.ndarray  # for each parameter: index of the component of e that it changes

    def __init__(self, smooth: SmoothField) -> None:
        self.smooth = smooth

    @classmethod
    def of(cls, facts: Facts) -> _Field:
        return cls(facts.smooth)

    def moving(self, components: np.ndarray) -> np.ndarray:
        return np.flatnonzero(np.isin(self.owner, components))


class FieldDisplacement(_Field):
    name, unit, tolerance = "field displacement", "m", 5e-6
    first = 0  # this block has the components `first`, `first` + 1 and `first` + 2 of e

    def __init__(self, smooth: SmoothField) -> None:
        super().__init__(smooth)
        self.owner = np.repeat(np.arange(self.first, self.first + 3), len(smooth.terms))
        self.labels = tuple(f"{COMPONENTS[self.first + c]} {t}" for c in range(3) for t in smooth.terms)
        self.root = np.diag(np.tile(smooth.prior, 3))

    def design(self, linkage: Linkage, whitened: bool) -> Columns:
        """Return ∂(w·e)/∂(coefficient of a term in the component c of e) = w_c · term."""
        basis = self.smooth.basis(linkage.points) * (self.smooth.prior if whitened else 1.0)

        def columns(errors: Errors) -> np.ndarray:
            own = [c for c in errors.components if self.first <= c < self.first + 3]
            moved = errors.directions[:, own, None] * basis[errors.at][:, None]
            return moved.reshape(len(errors.at), -1)

        return columns

    def into(self, draft: Draft, x: np.ndarray) -> None:
        draft.field[self.first : self.first + 3] = x.reshape(3, -1)


class FieldRotation(FieldDisplacement):
    name, unit, tolerance, first = "field rotation", "rad", 20e-6, 3


class FieldReversal(_Field):
    """Error for forward motion along x, y or z minus error for backward motion: six components for each axis."""

    name, unit, tolerance = "field reversal", "m, rad", 1e-6

    def __init__(self, smooth: SmoothField) -> None:
        super().__init__(smooth)
        self.owner = np.repeat(np.tile(np.arange(6), 3), len(smooth.reversal_terms))
        self.labels = tuple(f"{c} {t} reversal {a}" for a in AXES for c in COMPONENTS for t in smooth.reversal_terms)
        self.root = np.diag(np.tile(smooth.reversal_prior, 18))

    def design(self, linkage: Linkage, whitened: bool) -> Columns:
        """Return ∂(w·e)/∂(coefficient of a term in c, for an axis): w_c · term / 2 (backward: −w_c · term / 2)."""
        basis = self.smooth.reversal_basis(linkage.points) * (self.smooth.reversal_prior if whitened else 1.0)
        half = 0.5 * linkage.stations.sense[:, :3]

        def columns(errors: Errors) -> np.ndarray:
            weights = half[errors.at][:, :, None] * errors.directions[:, None, errors.components]
            return (weights[..., None] * basis[errors.at][:, None, None]).reshape(len(errors.at), -1)

        return columns

    def into(self, draft: Draft, x: np.ndarray) -> None:
        draft.reversal[:] = x.reshape(draft.reversal.shape)


def _terms(degree: int, cost: np.ndarray, flat: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return degrees (n, 3) along x, y, z of terms with Σ degree · `cost` ≤ `degree`, and prior σ / constant's σ."""
    every = np.array(list(itertools.product(range(degree + 1), repeat=3)))
    total = every @ cost
    bilinear = (every.max(axis=1) <= 1) & (every.sum(axis=1) <= 2)  # squareness, twist and roll are always included
    kept = ((total <= degree + 1e-9) | bilinear) & ~(every[:, flat] > 0).any(axis=1)
    order = np.argsort(total[kept], kind="stable")
    return every[kept][order], ASSUMED.field_decay ** total[kept][order]


def _names(powers: np.ndarray) -> tuple[str, ...]:
    """Return the names of terms, such as ``x2y1``; ``1`` for the constant."""
    return tuple("".join(f"{a}{n}" for a, n in zip("xyz", p, strict=True) if n) or "1" for p in powers)
