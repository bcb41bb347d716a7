"""Integrals over polygons of diffuse lobes other than Lambert's: sheen, velvet, and rough surfaces.

Sheen is a linearly transformed cosine (Zeltner, Burley and Chiang 2022). Rough surfaces follow Fujii's variant of Oren
and Nayar 1994 with multiple scattering, as in OpenPBR and in Cycles. With the normal z and the view direction
(sin theta_o, 0, cos theta_o), the lobe times cosine is

    z (A + B t + R (1 - E(z))),   t = x sin(theta_o), divided by max(z, cos(theta_o)) if positive,

where A = 1 / (pi + sigma (pi / 2 - 2 / 3)), B = sigma A, and E(z) = pi A + B G(z) is the albedo of A + B t. On the
sphere d omega = dz dphi. By Green's theorem, the integral of x h(z) is therefore that of y h(z) dz around the polygon.
The integral of h(z) is that of the normal's z times (integral of h above z) / (1 - z^2) along its arcs. Both are
integrals over arcs of functions without poles, and Gauss-Legendre nodes do them. The division in t for x > 0 requires a
cut of the polygon at x = 0.

Velvet, Ashikhmin's sheen, has no closed form. It takes Gauss-Legendre nodes in the triangles of the polygon.
"""

from functools import cache

import numpy as np

from .edge_integrals import bump_shadowing
from .lobe_integrals import form_factor
from .polygon import dot, project_to_sphere, split_at_horizon

# Nodes of an arc, or of each of its parts if it is cut at the kink of t, z = cos(theta_o).
ARC_NODES = 8
# Nodes along both sides of a triangle. MEAN_NODES: for means over polygons with corners farther from their middle than
# 0.8, 0.4 and 0.1 rad, and over smaller ones. Errors are at most 1e-4, with two nodes less five times as much.
NODES = 16
MEAN_NODES, EXTENTS = (10, 8, 6, 4), np.cos([0.8, 0.4, 0.1])
NODES_AT_A_TIME = 1 << 14  # of all polygons
_ANGLES = 2048


def sheen_form_factor(polygon: np.ndarray, a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Signed integral (P,) of z / pi (a / ((a x + b z)^2 + (a y)^2 + z^2))^2 over polygons (3, V, P) in z >= 0."""
    x, y, z = polygon
    return form_factor(np.stack([a * x + b * z, a * y, z]))


def velvet_lobe(x, z, cosine, sigma):
    """BRDF times cosine of velvet, in sr^-1, toward unit directions with the coordinates x, toward the view, and z.
    `cosine` is that of the view; all arrays broadcast.

    Ashikhmin, Premoze and Shirley 2000, "A microfacet-based BRDF generator", section 4.3, without Fresnel.
    """
    cosine = np.maximum(cosine, 1e-4)
    # Squared cosines of half the angle between both rays, and between normal and half vector.
    half = np.maximum(0.5 * (1.0 + cosine * z + np.sqrt(1.0 - np.minimum(cosine, 1.0) ** 2) * x), 1e-12)
    normal = np.clip((cosine + z) ** 2 / (4.0 * half), 0.0, 1.0 - 1e-9)
    masked = np.minimum(1.0, 2.0 * np.sqrt(normal / half) * np.minimum(cosine, z))
    density = np.exp(-normal / ((1.0 - normal) * sigma**2)) / (np.pi * (sigma * (1.0 - normal)) ** 2)
    return density * masked / (4.0 * cosine)


def velvet_integral(polygon: np.ndarray, cosine: np.ndarray, sigma: np.ndarray) -> np.ndarray:
    """Integral (P,) of `velvet_lobe` over polygons (3, V, P) in z >= 0, either way around."""
    total, corners = 0.0, project_to_sphere(polygon)
    for (x, _, z), weight in _nodes_of_triangles(corners, NODES if corners.shape[1] <= 8 else NODES // 2):
        total = total + (weight * velvet_lobe(x, z, cosine, sigma)).sum(axis=0)
    return np.abs(total)


def shadowed_mean(polygon: np.ndarray, cosine: np.ndarray, shape: np.ndarray, smooth: np.ndarray, bump_alpha2):
    """The mean (P,) of bump shadowing over polygons (3, V, P) in z >= 0, weighted by lobes with the `shape` (4, P) of
    `diffuse_factor`. `cosine` (P,) is that of the view, which has y = 0; `smooth` (3, P) is the smooth normal."""
    up, view = np.zeros((2, 3, len(cosine)), np.float32)
    up[2], view[0], view[2] = 1.0, np.sqrt(np.maximum(1.0 - cosine * cosine, 0.0)), cosine
    corners, result = project_to_sphere(polygon), np.zeros(len(cosine))
    middle = corners.sum(axis=1)
    extent = dot(corners, middle[:, None]).min(axis=0) / np.maximum(np.sqrt(dot(middle, middle)), 1e-30)
    level, shape, smooth = np.searchsorted(EXTENTS, extent), shape.astype(np.float32), smooth.astype(np.float32)
    for number in np.unique(level):
        some, total, shadowed = np.flatnonzero(level == number), 0.0, 0.0
        surfaces = up[:, some], view[:, some], shape[:, some]
        for direction, weight in _nodes_of_triangles(corners[..., some], MEAN_NODES[number], np.float32):
            lobe = weight * direction[2] * diffuse_factor(direction, direction[2], *surfaces)
            total = total + lobe.sum(axis=0)
            above = dot(smooth[:, None, some], direction)
            shadowed = shadowed + (lobe * bump_shadowing(above, np.float32(1.0), bump_alpha2[some])).sum(axis=0)
        result[some] = np.divide(shadowed, total, out=np.zeros_like(total), where=total != 0.0)
    return np.clip(result, 0.0, 1.0)


def _nodes_of_triangles(corners: np.ndarray, count: int, dtype=np.float64):
    """Unit directions (3, N, P) and signed weights in sr (N, P) of a `dtype`, in several pieces, for spherical polygons
    (3, V, P), with `count` nodes along both sides of their triangles."""
    nodes, weights = np.polynomial.legendre.leggauss(count)
    nodes = 0.5 * (nodes + 1.0)
    # Go toward the second corner, and from there toward the third.
    along, across = (values.reshape(-1, 1) for values in np.meshgrid(nodes, nodes, indexing="ij"))
    weights = along * np.outer(0.5 * weights, 0.5 * weights).reshape(-1, 1)
    along, across, weights = (values.astype(dtype) for values in (along, across, weights))
    rows = max(NODES_AT_A_TIME // max(corners.shape[2], 1), 1)
    for corner in range(1, corners.shape[1] - 1):
        first, second, third = corners[:, 0], corners[:, corner], corners[:, corner + 1]
        volume = dot(first, np.cross(second, third, axis=0)).astype(dtype)
        sides = first, second - first, third - second
        first, to_second, to_third = (side[:, None].astype(dtype) for side in sides)
        for start in range(0, count * count, rows):
            piece = slice(start, start + rows)
            place = first + along[piece] * (to_second + across[piece] * to_third)
            inverse = np.reciprocal(np.sqrt(np.maximum(dot(place, place), dtype(1e-30))))
            yield place * inverse, weights[piece] * volume * inverse**3


def rough_terms(roughness: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """A and B (P,) of a surface whose sigma is `roughness` (P,), in [0, 1]."""
    sigma = np.clip(roughness, 0.0, 1.0)
    a = 1.0 / (np.pi + sigma * (np.pi / 2.0 - 2.0 / 3.0))
    return a, sigma * a


def albedo_slope(cosine: np.ndarray) -> np.ndarray:
    """G (P,), the factor of B in the directional albedo of A + B t."""
    cosine = np.clip(cosine, 0.0, 1.0)
    sine, angle = np.sqrt(1.0 - cosine * cosine), np.arccos(cosine)
    tangent = sine / np.maximum(cosine, 1e-6)
    slope = sine * (angle - 2.0 / 3.0 - sine * cosine) + 2.0 / 3.0 * tangent * (1.0 - sine**3)
    return np.where(cosine < 1e-6, np.pi / 2.0 - 2.0 / 3.0 - cosine, slope)


def rebound(color: np.ndarray, cosine: np.ndarray, roughness: np.ndarray) -> np.ndarray:
    """R (P, 3), the factor of light that is scattered several times, for a surface of `color` (P, 3) and the `cosine`
    (P,) of the view."""
    a, b = rough_terms(roughness)
    color = np.clip(color, 0.0, 1.0)
    average = (np.pi * a + (2.0 * np.pi - 5.6) / 3.0 * b)[:, None]
    # A smooth surface does not catch again what it reflects.
    lost = np.maximum(1.0 - average, 1e-9)
    scattered = color**2 / np.pi * average / lost / (1.0 - color * lost)
    return scattered * (1.0 - np.pi * a - b * albedo_slope(cosine))[:, None]


def rough_integrals(polygon: np.ndarray, cosine: np.ndarray, roughness: np.ndarray) -> np.ndarray:
    """Integrals (2, P) of z (A + B t) and of z (1 - E(z)) over polygons (3, V, P) in z >= 0, either way around."""
    cosine = np.clip(cosine, 0.0, 1.0)
    a, b = rough_terms(roughness)
    signed = form_factor(polygon)
    sign, factor = np.sign(signed), np.pi * np.abs(signed)
    y, z, rise, turn, weights = _arcs(polygon)
    sine = np.sqrt(1.0 - cosine * cosine)
    across = (weights * y * z * rise).sum(axis=(0, 1)) * sine
    for index, half in split_at_horizon(polygon, axis=0):
        own_y, own_z, own_rise, _, own_weights = _arcs(half, cosine[index])
        more = own_z / np.maximum(np.maximum(own_z, cosine[index]), 1e-12) - own_z
        across[index] += (own_weights * own_y * more * own_rise).sum(axis=(0, 1)) * sine[index]
    scattered = (weights * turn * mean_slope_above(z)).sum(axis=(0, 1))
    single = a * factor + b * sign * across
    return np.stack([np.maximum(single, 0.0), np.maximum((1.0 - np.pi * a) * factor - b * sign * scattered, 0.0)])


def _arcs(polygon, kink=None):
    """y, z and dz / d angle (N, V, P) at nodes of the edges of polygons (3, V, P), the z of the edges' normals (V, P),
    and weights (N, V, P). If a `kink` (P,) is given, edges are cut where their z equals it."""
    start = project_to_sphere(polygon)
    end = np.roll(start, -1, axis=1)
    normal = np.cross(start, end, axis=0)
    sine, cosine = np.sqrt((normal * normal).sum(axis=0)), (start * end).sum(axis=0)
    length = np.arctan2(sine, cosine)
    normal = normal / np.maximum(sine, 1e-300)
    # Perpendicular to the start, toward the end.
    side = np.cross(normal, start, axis=0)
    nodes, weights = np.polynomial.legendre.leggauss(ARC_NODES)
    cuts = [np.zeros_like(length), length]
    if kink is not None:
        # z is `size` times the cosine of the angle from its peak.
        peak, size = np.arctan2(side[2], start[2]), np.hypot(side[2], start[2])
        apart = np.arccos(np.minimum(kink / np.maximum(size, 1e-300), 1.0))
        cuts[1:1] = (np.clip(peak + sign * apart, 0.0, length) for sign in (-1.0, 1.0))
    cuts = np.stack(cuts)[:, None]
    width = np.diff(cuts, axis=0)
    angle = (cuts[:-1] + 0.5 * (nodes[:, None, None] + 1.0) * width).reshape(-1, *length.shape)
    cos, sin = np.cos(angle), np.sin(angle)
    y, z = (start[axis] * cos + side[axis] * sin for axis in (1, 2))
    return y, z, side[2] * cos - start[2] * sin, normal[2], (0.5 * weights[:, None, None] * width).reshape(angle.shape)


def mean_slope_above(z):
    """Integral of z G(z) from z to 1, divided by 1 - z^2."""
    return np.interp(np.arccos(np.clip(z, -1.0, 1.0)), *_slope_table())


@cache
def _slope_table():
    angle = np.linspace(0.0, np.pi / 2.0, _ANGLES)
    middle = 0.5 * (angle[1:] + angle[:-1])

    def integrand(theta):
        return np.cos(theta) * np.sin(theta) * albedo_slope(np.cos(theta))

    # Simpson's rule for each piece.
    pieces = (integrand(angle[:-1]) + 4.0 * integrand(middle) + integrand(angle[1:])) * (angle[1] / 6.0)
    total = np.concatenate([[0.0], np.cumsum(pieces)])
    return angle, np.divide(total, np.sin(angle) ** 2, out=np.zeros_like(total), where=angle > 0.0)


def diffuse_factor(directions, height, normal, view, shape):
    """Lobe divided by cosine, times pi (S, Q), toward unit directions (3, S, Q) with the cosines `height` (S, Q), for Q
    samples with normals and views (3, Q). `shape` (4, Q) is sigma, a and b of sheen, and R. The factor is 1 if all of
    these are 0. Velvet has a below 0."""
    sigma, sheen_a, sheen_b, scattered = shape
    cosine = dot(normal, view)
    # The part of the view along the surface; its length is the sine.
    along = dot((view - cosine * normal)[:, None], directions)
    factor = np.ones_like(height)
    if (sigma != 0.0).any():
        a, b = rough_terms(sigma)
        t = np.where(along > 0.0, along / np.maximum(np.maximum(height, cosine), 1e-6), along)
        rough = np.pi * (a + b * t + scattered * (1.0 - np.pi * a - b * albedo_slope(height)))
        factor = np.where(sigma != 0.0, rough, factor)
    if (sheen_a != 0.0).any():
        x = along / np.sqrt(np.maximum(1.0 - cosine * cosine, 1e-12))
        squared = np.maximum(1.0 - height * height - x * x, 0.0)
        q = (sheen_a * x + sheen_b * height) ** 2 + sheen_a * sheen_a * squared + height * height
        sheen = (sheen_a / np.maximum(q, 1e-12)) ** 2
        if (sheen_a < 0.0).any():
            velvet = np.pi * velvet_lobe(x, np.maximum(height, 1e-6), cosine, np.maximum(-sheen_a, 1e-2))
            sheen = np.where(sheen_a < 0.0, velvet / np.maximum(height, 1e-6), sheen)
        factor = np.where(sheen_a != 0.0, sheen, factor)
    return factor.astype(height.dtype)
