"""Lambert's lobe under the shadowing that Cycles puts on bump-mapped diffuse surfaces.

With the smooth normal s, z = s.omega and alpha^2 = `bump_alpha2`, the factor is (Estevez, Lecocq and Stein 2019,
doi:10.1007/978-1-4842-4427-2_12)

    g(z) = 2 / (1 + sqrt(1 + alpha^2 (1 - z^2) / z^2)).

By Stokes' theorem, the integral of (n.omega) g(z) over a polygon is the sum, over its edges, of the means of

    (n.X) Q(z) + (n.s) (s.X) D(z),   Q(z) = (integral of t g(t) from 0 to z) / z^2,   D(z) = (Q(1) - Q(z)) / (1 - z^2).

X is the edge's normal, as long as its arc. Without shadowing Q = 1 / 2 and D = 0, which is Lambert's formula. Here
Q(z) = z / (a + b z + c r), where r^2 = k + (1 - k) z^2. This makes D as simple, and stands for a g at most 0.4 %
off. The result is divided by its error in the mean direction, so that small polygons get g itself. Q and D have no
poles, so few nodes do an arc. They lie closer toward its lower end, where g is steep.
"""

from __future__ import annotations

import numpy as np

# Gauss-Legendre nodes u in [0, 1], moved to (u + u^2) / 2: their places between both ends of an arc, and weights.
_NODES, _WEIGHTS = ((0.5 * values).tolist() for values in np.polynomial.legendre.leggauss(5))
ARC_NODES = [((u + 0.5) * (u + 1.5) / 2.0, w * (1.0 + u)) for u, w in zip(_NODES, _WEIGHTS, strict=True)]
# Quartics in alpha, constant first, fitted to g for alpha^2 <= 4: k / alpha^2, a / alpha, (b + c - 2) / alpha, and c.
TERM_POLYNOMIALS = (
    (2.1783, -3.2715, 3.6047, -1.7641, 0.2940),
    (0.3047, 0.9373, -0.8150, 0.3676, -0.0900),
    (-0.1847, 0.3115, -0.4986, 0.2880, -0.0324),
    (0.8052, -0.0050, 0.0225, -0.1359, 0.0963),
)


def bump_shadowing(along, squares, bump_alpha2):
    """Bump shadowing (...) at heights (...) over the plane of the smooth normal and squared distances (...)."""
    along = np.maximum(along, np.float32(1e-15) * np.sqrt(squares) + np.float32(1e-18))
    tangent2 = np.maximum(squares / (along * along) - np.float32(1.0), np.float32(0.0))
    shadowing = np.sqrt(np.float32(1.0) + bump_alpha2.astype(np.float32) * tangent2)
    return np.float32(2.0) / (np.float32(1.0) + shadowing)


def shadowing_terms(bump_alpha2: np.ndarray) -> np.ndarray:
    """alpha^2, k, a, b and c (5, P) of the formulas above, for alpha^2 (P,) in [0, 4]."""
    alpha = np.sqrt(bump_alpha2)
    k, a, both, c = (np.polynomial.polynomial.polyval(alpha, terms) for terms in TERM_POLYNOMIALS)
    return np.stack([bump_alpha2, k * bump_alpha2, a * alpha, 2.0 + both * alpha - c, c]).astype(bump_alpha2.dtype)


def shadowed_integral(toward, heights, shifted, mean, terms):
    """Signed integrals (P,) of cosine times shadowing over polygons above both horizons.

    `toward` (2, V, P) are products of the edges' normals, whose lengths are the angles theta of the edges, with n and
    with (n.s) s; `heights` (2, V, P) those of the edges' ends with s; `shifted` (V, P) is 1 + cos theta, and
    `mean` (P,) the cosine between s and the mean direction. `terms` (5, P) are `shadowing_terms`.
    """
    alpha2, k, a, b, c = terms
    half = np.sqrt(0.5 * shifted)
    # Close ends have a straight line between them, at any small angle.
    np.minimum(half, 1.0 - 1e-6, out=half)
    middle = heights[0] + heights[1]
    middle /= 2.0 * half
    np.arccos(half, out=half)
    rise = np.abs(heights[1] - heights[0])
    rise /= 2.0 * np.sin(half)
    ck, rest = c * k, 1.0 - k
    plain = mixed = 0.0
    for place, weight in ARC_NODES:
        angle = half * (2.0 * place - 1.0)
        z = np.cos(angle)
        z *= middle
        z += np.sin(angle, out=angle) * rise
        np.maximum(z, 1e-6, out=z)
        root = np.sqrt(rest * z * z + k)
        share = weight / (a + b * z + c * root)
        plain = plain + share * z
        root += z
        z += 1.0
        mixed = mixed + share * (ck / root + a / z)
    integral = (toward[0] * plain + toward[1] * mixed / (a + b + c)).sum(axis=0)
    z = np.maximum(mean, 1e-6)
    squared = z * z
    root = np.sqrt(rest * squared + k)
    share = a + b * z + c * root
    slope = 3.0 * share - z * (b + c * rest * z / root)
    return integral * (2.0 * share * share / ((z + np.sqrt(alpha2 + (1.0 - alpha2) * squared)) * slope))
