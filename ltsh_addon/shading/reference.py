"""Reference quadrature: the true GGX lobe integrated over a polygon, with an error estimate.

The polygon is warped by W (see `lookup_table`) with A = B = C = 1, the limit of GGX for alpha -> 0, which flattens the
lobe's peak; no fitted number enters. With an apex inside the warped spherical polygon,

    int f dw = sum_edges phi (X . apex) int_0^1 [ int_0^rho f J sin(r) dr / sin^2(rho) ] dt,   X = a x b,

where t runs along the edge at constant speed, rho is the distance from the apex and J the Jacobian of the warp. Both
integrands are analytic, so Gauss-Legendre rules converge fast; their order grows until two orders agree.
"""

from __future__ import annotations

import numpy as np

from . import brdf
from .edge_integrals import arc_factors
from .lookup_table import MIN_ALPHA, WARP_REGULARIZATION, Lobe
from .polygon import project_to_sphere, solid_angle

# Gauss-Legendre orders (along an edge, along a radius), tried in turn; polygons of many corners have short edges.
_ORDERS_FEW_CORNERS = ((10, 12), (16, 18), (28, 30), (48, 50), (80, 80))
_ORDERS_MANY_CORNERS = ((3, 10), (5, 16), (8, 24), (14, 40), (24, 64))
_POINTS_AT_ONCE = 1_500_000


def lobe_integrals(polygon, cos_theta_o, alpha, ior, *, tolerance=1e-4):
    """Integrals (3, P) of the GGX BRDF times cosine over polygons (3, V, P) in z >= 0, and error estimates (P,).

    The three rows have the Fresnel factor 1, (1 - c)^5 and that of a dielectric of relative `ior` (P,); the local frame,
    cos_theta_o (P,) and alpha (P,) are those of `lookup_table`. The order grows until the first row of two successive
    orders differs by less than `tolerance` of the value plus 1e-6; the estimate is the last difference. Convex polygons.
    """
    warp = _limit_warp(cos_theta_o, np.maximum(alpha, MIN_ALPHA))
    unit = project_to_sphere(warp.to_original_domain(polygon))
    orientation = np.sign(solid_angle(unit))
    apex = _apex(unit, orientation)
    orders = _ORDERS_FEW_CORNERS if unit.shape[1] <= 12 else _ORDERS_MANY_CORNERS
    count = unit.shape[2]
    result, error = np.zeros((3, count)), np.full(count, np.inf)
    open_points = np.arange(count)
    for level, order in enumerate(orders):
        chunk = max(_POINTS_AT_ONCE // (unit.shape[1] * order[0] * order[1]), 1)
        for start in range(0, len(open_points), chunk):
            index = open_points[start : start + chunk]
            value = orientation[index] * _fixed_order(
                order, unit[:, :, index], apex[:, index], warp.take(index), cos_theta_o[index], alpha[index], ior[index]
            )
            if level > 0:
                error[index] = np.abs(value - result[:, index]).max(axis=0)
            result[:, index] = value
        open_points = open_points[error[open_points] > tolerance * np.abs(result[0, open_points]) + 1e-6]
        if len(open_points) == 0:
            break
    return np.maximum(result, 0.0), error


def _limit_warp(cosine, alpha):
    squared = cosine**2 + WARP_REGULARIZATION**2 * alpha**2
    sine = np.sqrt(np.maximum(1.0 - cosine**2, 0.0))
    return Lobe(squared, np.sqrt(squared) * sine, np.ones_like(alpha), 2.0 * alpha, None, np.empty((0, 0, len(alpha))))


def _apex(unit, orientation):
    """Unit vectors (3, P) in the polygons: the peak of the lobe, e_z, where it is inside, else the mean corner."""
    following = np.roll(unit, -1, axis=1)
    side = (unit[0] * following[1] - unit[1] * following[0]) * orientation
    inside = (side >= 0.0).all(axis=0)
    mean = project_to_sphere(unit.sum(axis=1, keepdims=True))[:, 0]
    return np.where(inside, np.array([0.0, 0.0, 1.0])[:, None], mean)


def _fixed_order(order, unit, apex, warp, cos_theta_o, alpha, ior):
    """Signed integrals (3, P) with fixed Gauss-Legendre orders."""
    along, along_weights = _unit_interval(order[0])
    radial, radial_weights = _unit_interval(order[1])
    following = np.roll(unit, -1, axis=1)
    phi, _, _ = arc_factors((unit * following).sum(axis=0))
    normal = np.cross(unit, following, axis=0)
    theta = np.arctan2(np.sqrt((normal**2).sum(axis=0)), (unit * following).sum(axis=0))
    edge_factor = phi * (normal * apex[:, None]).sum(axis=0)
    boundary = _slerp(unit[..., None], following[..., None], theta[..., None], along)  # (3, V, P, n)
    cosine = np.clip((boundary * apex[:, None, :, None]).sum(axis=0), -1.0, 1.0)
    rho = np.maximum(np.arccos(cosine), 1e-7)
    points = _slerp(apex[:, None, :, None, None], boundary[..., None], rho[..., None], radial)  # (3, V, P, n, m)
    values = _warped_integrand(points, warp, cos_theta_o, alpha, ior)  # (3, V, P, n, m)
    sine = np.sin(rho)
    weight = rho[..., None] * np.sin(rho[..., None] * radial) * radial_weights / (sine * sine)[..., None]
    weight = weight * (edge_factor[..., None] * along_weights)[..., None]
    return (values * weight).sum(axis=(1, 3, 4))


def _unit_interval(count):
    nodes, weights = np.polynomial.legendre.leggauss(count)
    return 0.5 * (nodes + 1.0), 0.5 * weights


def _slerp(start, end, angle, parameter):
    """Points at the fractions `parameter` of arcs of length `angle`; the ends coincide where the angle is zero."""
    sine = np.sin(angle)
    safe = np.where(sine > 1e-9, sine, 1.0)
    near = np.where(sine > 1e-9, np.sin((1.0 - parameter) * angle) / safe, 1.0 - parameter)
    far = np.where(sine > 1e-9, np.sin(parameter * angle) / safe, parameter)
    return near * start + far * end


def _warped_integrand(points, warp, cos_theta_o, alpha, ior):
    """BRDF times cosine times Jacobian of the warp for the three Fresnel factors, at points of the warped sphere."""
    shape = (slice(None), None, None)
    z = points[2] / warp.zz[shape]
    x = (points[0] - warp.xz[shape] * z) / warp.xx[shape]
    y = points[1] / warp.yy[shape]
    length = np.sqrt(x * x + y * y + z * z)
    directions = np.stack([x, y, z], axis=-1) / length[..., None]
    flat = np.moveaxis(directions, 1, 0).reshape(len(alpha), -1, 3)
    values = brdf.ggx_brdf_cosine(cos_theta_o, alpha, flat)
    half = brdf.half_angle_cosine(cos_theta_o, flat)
    factors = np.stack([values, values * brdf.schlick_curve(half), values * _dielectric(half, ior)])
    corners, count = points.shape[1], points.shape[2]
    factors = np.moveaxis(factors.reshape(3, count, corners, *points.shape[3:]), 1, 2)
    jacobian = 1.0 / ((warp.xx * warp.yy * warp.zz)[shape] * length**3)
    return factors * jacobian


def _dielectric(half, ior):
    return brdf.dielectric_reflectance(half, np.maximum(ior, 1.0)[:, None])
