"""Formulas as they stand in the literature, written for clarity: the oracles of the shading tests."""

import numpy as np


def ggx_distribution(cosine, alpha):
    """D(h) of GGX, Walter et al. 2007, eq. 33, without clamping: alpha^2 / (pi cos^4 (alpha^2 + tan^2)^2)."""
    tangent_squared = 1.0 / cosine**2 - 1.0
    return alpha**2 / (np.pi * cosine**4 * (alpha**2 + tangent_squared) ** 2)


def smith_lambda(cosine, alpha):
    """Lambda of GGX, Heitz 2014, eq. 72."""
    tangent_squared = 1.0 / cosine**2 - 1.0
    return 0.5 * (np.sqrt(1.0 + alpha**2 * tangent_squared) - 1.0)


def ggx_of_cosines(cosine_h, cosine_i, cosine_o, alpha):
    """D G2 / (4 cos_i cos_o) with the height-correlated G2 = 1 / (1 + Lambda_o + Lambda_i), Heitz 2014, eq. 99."""
    masking = 1.0 / (1.0 + smith_lambda(cosine_o, alpha) + smith_lambda(cosine_i, alpha))
    return ggx_distribution(cosine_h, alpha) * masking / (4.0 * cosine_i * cosine_o)


def ggx_brdf(view, light, alpha):
    """The same of unit vectors (..., 3), normal z."""
    half = view + light
    half = half / np.linalg.norm(half, axis=-1, keepdims=True)
    return ggx_of_cosines(half[..., 2], light[..., 2], view[..., 2], alpha)


def fresnel_amplitudes(cosine, ior):
    """(r_s^2, r_p^2) by Snell's law and the Fresnel equations."""
    transmitted = np.sqrt(np.maximum(1.0 - (1.0 - cosine**2) / ior**2, 0.0))
    s = (cosine - ior * transmitted) / (cosine + ior * transmitted)
    p = (ior * cosine - transmitted) / (ior * cosine + transmitted)
    return s**2, p**2


def dielectric_fresnel(cosine, ior):
    """Reflectance of unpolarized light."""
    return 0.5 * sum(fresnel_amplitudes(cosine, ior))


def lhuilier(a, b, c):
    """Area of a spherical triangle of unit corners (..., 3), by L'Huilier's theorem; never negative."""
    pairs = [(b, c), (c, a), (a, b)]
    sides = [np.arctan2(np.linalg.norm(np.cross(p, q), axis=-1), (p * q).sum(axis=-1)) for p, q in pairs]
    half = 0.5 * sum(sides)
    product = np.tan(0.5 * half)
    for side in sides:
        product = product * np.tan(0.5 * (half - side))
    return 4.0 * np.arctan(np.sqrt(np.maximum(product, 0.0)))


def lambert_form_factor(polygon):
    """Form factor of a polygon (V, 3) above z = 0: sum over edges of angle times the z of the edge's unit normal."""
    total = 0.0
    for start, end in zip(polygon, np.roll(polygon, -1, axis=0), strict=True):
        cosine = start @ end / np.linalg.norm(start) / np.linalg.norm(end)
        normal = np.cross(start, end)
        total += np.arccos(cosine) * normal[2] / np.linalg.norm(normal)
    return total / (2.0 * np.pi)


def parallel_rectangle_form_factor(width, depth, height):
    """Form factor from a point to a parallel rectangle with one corner straight above it (Howell's catalog, B-4)."""
    a, b = width / height, depth / height
    first = a / np.sqrt(1.0 + a * a) * np.arctan(b / np.sqrt(1.0 + a * a))
    second = b / np.sqrt(1.0 + b * b) * np.arctan(a / np.sqrt(1.0 + b * b))
    return (first + second) / (2.0 * np.pi)


def coaxial_disk_form_factor(radius, height):
    """Form factor from a point to a parallel disk straight above it."""
    return radius**2 / (radius**2 + height**2)


def view_direction(cos_theta_o):
    """(sin theta_o, 0, cos theta_o) as (..., 3)."""
    mu = np.asarray(cos_theta_o, dtype=float)
    return np.stack([np.sqrt(1.0 - mu * mu), np.zeros_like(mu), mu], axis=-1)


def mirror_direction(cos_theta_o):
    """The mirror image of `view_direction`."""
    return view_direction(cos_theta_o) * np.array([-1.0, 1.0, 1.0])


def tail_values(view, roughness, light):
    """The integral for F = 1 at the origin, normal z, if the integrand were everywhere as at the center, and at each
    corner, (5,); None for lights without limits."""
    signs = ((0, 0), (1, 1), (1, -1), (-1, 1), (-1, -1))
    points = [light.center + s * light.half_u + t * light.half_v for s, t in signs]
    distance, radius = np.linalg.norm(light.center), max(np.linalg.norm(p - light.center) for p in points)
    mirrored = np.array([-view[0], -view[1], view[2]])
    angle = np.arccos(np.clip(mirrored @ light.center / distance, -1.0, 1.0))
    if distance <= 2.0 * radius or angle <= np.arcsin(2.0 * radius / distance):
        return None
    area = 4.0 * np.linalg.norm(np.cross(light.half_u, light.half_v))
    values = []
    for point in points:
        length = np.linalg.norm(point)
        brdf = ggx_brdf(view, point / length, roughness**2) if point[2] > 0.0 else 0.0
        values.append(brdf * max(point[2], 0.0) * area * abs(light.direction @ point) / length**4)
    return np.array(values)


def tail_bounds(view, roughness, light):
    """(least, greatest) of `tail_values`; None for lights without limits."""
    values = tail_values(view, roughness, light)
    return None if values is None else (values.min(), values.max())


def within_tail_bounds(value, view, roughness, light):
    """`value` between the bounds, if there are any: for a rectangle above the horizon those of the rule of degree 3."""
    values = tail_values(view, roughness, light)
    if values is None:
        return value
    least, most = values.min(), values.max()
    if least > 0.0:
        mean = values @ [8, 1, 1, 1, 1] / 12.0
        slack = 0.2 * mean * ((most - least) / (most + least)) ** 4
        least, most = max(least, mean - slack), min(most, mean + slack)
    return min(max(value, least), most)
