"""Where a 6-3 machine's platform joints may be, from its strut lengths alone: an elimination of degree 16.

On a 6-3 machine struts (1, 2), (3, 4), (5, 6) share a platform joint. Two struts of given length hold their
joint T_i on a circle about the line through their base joints, at an angle φ_i; the platform is a triangle
of given sides. So three angles meet three distances, |T_i − T_j| = a_ij (doc/theory.md, own derivation):

* with t = e^{iφ} each distance condition is a quadratic a·t² + b·t + ā = 0 in either of its two angles;
* eliminating φ3 between |T1 − T3| and |T2 − T3| (resultant of two quadratics) leaves a real trigonometric
  polynomial R(φ2) of degree 2, whose coefficients depend on φ1;
* eliminating φ2 between R and |T1 − T2| leaves a real trigonometric polynomial N(φ1) of degree 8: sixteen
  roots z = e^{iφ1}, those of a machine that can be put together lie on |z| = 1.

N is sampled, not expanded: a Fourier transform gives its coefficients, a companion matrix its roots. They
only start the search (:mod:`hexapod_comp.machine.triangles`); so a root that rounding has pushed off the
circle (double roots: singular poses) is not lost. The elimination is done about each of the three joints in
turn, so that a root that is badly conditioned in one angle is found through another.

Circles are arrays of shape (3, 3, 3), m, in ``base``: rows (centre, p, q) of each, T(φ) = centre + p·cos φ +
q·sin φ, so that p and q have the circle's radius. Sides are |T1 − T2|, |T2 − T3|, |T3 − T1|, m.
"""

from __future__ import annotations

import numpy as np

SAMPLES = 32
HALF_DEGREE = 8

SECOND, THIRD = np.array([1, 2, 0]), np.array([2, 0, 1])
"""Cyclic successors of each joint: sides[i] lies between i and SECOND[i], sides[THIRD[i]] between THIRD[i] and i."""


def joint_circles(base_joints: np.ndarray, lengths: np.ndarray, allowed: float) -> np.ndarray | None:
    """Return the circles on which pairs of struts hold their platform joints; None when two cannot meet."""
    one, other = lengths[0::2], lengths[1::2]
    between = base_joints[1::2] - base_joints[0::2]
    apart = np.linalg.norm(between, axis=1)
    e = between / apart[:, None]
    spare = np.array([one + other - apart, apart + one - other, apart - one + other])
    if spare.min() < -allowed:
        return None
    # Heron's formula keeps its accuracy for flat triangles, where L² − s² would not.
    radius = np.sqrt(np.maximum(spare.prod(axis=0), 0.0) * (one + other + apart)) / (2.0 * apart)
    along = 0.5 * (apart + (one - other) * (one + other) / apart)
    thin = np.abs(e).argmin(axis=1)
    u = np.eye(3)[thin] - e[np.arange(3), thin][:, None] * e
    u /= np.linalg.norm(u, axis=1)[:, None]
    scaled = radius[:, None]
    return np.stack([base_joints[0::2] + along[:, None] * e, scaled * u, scaled * np.cross(e, u)], axis=1)


def start_angles(circles: np.ndarray, sides: np.ndarray) -> np.ndarray:
    """Return angles (φ1, φ2, φ3) near which the platform may close, shape (K, 3), rad."""
    roots = [_roots(*about_one) for about_one in zip(*_samples(circles, sides), strict=True)]
    angles, row = np.concatenate(roots), np.arange(sum(map(len, roots)))
    first = np.repeat(np.arange(3), [len(of_one) for of_one in roots])
    second, third = SECOND[first], THIRD[first]
    points = _points(circles[first], angles)
    starts = np.empty((len(row), 2, 2, 3))
    starts[row, :, :, first] = angles[:, None, None]
    starts[row, :, :, second] = _branches(points, circles[second], sides[first])[:, :, None]
    starts[row, :, :, third] = _branches(points, circles[third], sides[third])[:, None, :]
    return starts.reshape(-1, 3)


def _points(circles: np.ndarray, angles: np.ndarray) -> np.ndarray:
    """Return T(φ), (..., 3), m; circles (..., 3, 3) and angles (...) row by row."""
    c, s = np.cos(angles)[..., None], np.sin(angles)[..., None]
    return circles[..., 0, :] + c * circles[..., 1, :] + s * circles[..., 2, :]


def _branches(points: np.ndarray, circles: np.ndarray, sides: np.ndarray) -> np.ndarray:
    """Return the two angles at which a circle is `side` from its point, or nearest to being; (N, 2), rad."""
    a, b = _quadratic(points, circles, sides)
    size = 2.0 * np.abs(a)
    cosines = np.divide(-b, size, out=np.zeros(len(b)), where=size > 0.0)  # on the axis any angle will do
    opening = np.arccos(np.clip(cosines, -1.0, 1.0))
    return np.stack([opening, -opening], axis=1) - np.angle(a)[:, None]


def _quadratic(points: np.ndarray, circles: np.ndarray, sides: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return a and b of |point − T(φ)|² − side² = a·t + b + ā/t with t = e^{iφ}, row by row; m²."""
    p, q = circles[..., 1, :], circles[..., 2, :]
    w = points - circles[..., 0, :]
    return -(w * (p - 1j * q)).sum(axis=-1), (w * w).sum(axis=-1) + (p * p).sum(axis=-1) - sides * sides


def _coupling(circles2: np.ndarray, circles3: np.ndarray, sides: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the Fourier coefficients over φ2, index k + 1 for k = −1, 0, 1, of quadratics in φ3.

    |T2(φ2) − T3(φ3)|² − side² = α(φ2)·t3 + β(φ2) + ᾱ(φ2)/t3; α and β have shape (N, 3), m².
    """
    centres2 = circles2[:, 0]
    m2 = circles2[:, 1] - 1j * circles2[:, 2]
    m3 = circles3[:, 1] - 1j * circles3[:, 2]
    alpha, beta = _quadratic(centres2, circles3, sides)
    outer = ((centres2 - circles3[:, 0]) * m2).sum(axis=1)
    inner = beta + (circles2[:, 1] ** 2).sum(axis=1)
    below, above = -0.5 * (m2.conj() * m3).sum(axis=1), -0.5 * (m2 * m3).sum(axis=1)
    return np.stack([below, alpha, above], axis=1), np.stack([outer.conj(), inner, outer], axis=1)


def _samples(circles: np.ndarray, sides: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return N(φ) about each joint at equal steps of φ, (3, SAMPLES), m¹⁶, and bounds of its terms, (3,)."""
    alpha, beta = _coupling(circles[SECOND], circles[THIRD], sides[SECOND])
    alpha, beta = alpha[:, None], beta[:, None]
    points = _points(circles[:, None], 2.0 * np.pi / SAMPLES * np.arange(SAMPLES))
    a2, b2 = _quadratic(points, circles[SECOND][:, None], sides[:, None])
    a3, b3 = _quadratic(points, circles[THIRD][:, None], sides[THIRD][:, None])
    values = _eliminate_second(a2, b2, _eliminate_third(a3[..., None], b3[..., None], alpha, beta))
    size2 = 2.0 * np.abs(a2) + np.abs(b2)
    size3 = np.abs(a3) * np.abs(beta).sum(axis=-1) + np.abs(b3) * np.abs(alpha).sum(axis=-1)
    return values, (size2 * size3).max(axis=1) ** 4


def _eliminate_third(a: np.ndarray, b: np.ndarray, alpha: np.ndarray, beta: np.ndarray) -> np.ndarray:
    """Return R(φ2) = |a·β − b·α|² − 4·Im(a·ᾱ)², the resultant over t3, as coefficients k = −2..2, (..., 5).

    It is the resultant of a·t² + b·t + ā and α·t² + β·t + ᾱ with b, β real.
    """
    g = a * beta - b * alpha
    h = (a * alpha[..., ::-1].conj() - a.conj() * alpha) / 2j
    return _product(g, g[..., ::-1].conj()) - 4.0 * _product(h, h)


def _product(f: np.ndarray, g: np.ndarray) -> np.ndarray:
    """Return the coefficients (..., 5) of the products of polynomials with coefficients (..., 3)."""
    product = np.zeros((*f.shape[:-1], 5), complex)
    for k in range(3):
        product[..., k : k + 3] += f[..., k : k + 1] * g
    return product


def _eliminate_second(a: np.ndarray, b: np.ndarray, r: np.ndarray) -> np.ndarray:
    """Return |a|⁴·R(t₊)·R(t₋) over the two roots of a·t² + b·t + ā, without dividing by a; like a, (...).

    With S_m = aᵐ·(t₊ᵐ + t₋ᵐ), which obeys S_m = −b·S_{m−1} − |a|²·S_{m−2}, the product is
    Σ_j r_j²·ā^{2+j}·a^{2−j} + Σ_{j<k} r_j·r_k·ā^{2+j}·a^{2−k}·S_{k−j}, j and k from −2 to 2.
    """
    powers = a[..., None] ** np.arange(5)
    left, right = r * powers.conj(), r * powers[..., ::-1]
    square = (a * a.conj()).real
    total = (left * right).sum(axis=-1).real
    before, sums = np.full(b.shape, 2.0), -b
    for apart in range(1, 5):
        total += sums * (left[..., :-apart] * right[..., apart:]).sum(axis=-1).real
        before, sums = sums, -b * sums - square * before
    return total


def _roots(values: np.ndarray, bound: float) -> np.ndarray:
    """Return the angles at which a degree-8 trigonometric polynomial may vanish, rad."""
    half = np.fft.rfft(values)[: HALF_DEGREE + 1]
    largest = np.abs(half).max()
    if not largest > 1e-12 * SAMPLES * bound:
        return 2.0 * np.pi / SAMPLES * np.arange(SAMPLES)
    # A tiny leading coefficient belongs to roots near 0 and ∞, far from any real angle; its reciprocal
    # would drown the others in rounding.
    degree = int(np.flatnonzero(np.abs(half) > 1e-9 * largest)[-1])
    roots = np.roots(np.concatenate([half[degree:0:-1], half[:1].real, half[1 : degree + 1].conj()]))
    return np.angle(roots[np.abs(roots) > 0.9])
