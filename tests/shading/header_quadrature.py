"""Integrals over polygons by subdivision, and how close edges come to half circles: oracles for exported headers."""

import numpy as np

from ltsh_addon import shading
from ltsh_addon.shading.polygon import clip_to_horizon, edge_sums, project_to_sphere, split_at_horizon


def half_circle_gaps(table, cosine, roughness, vertices):
    """How far (P,) from a half circle the edges are, in rad, that the closed form meets after clipping and warping."""
    lobe, gap = table.lookup(cosine, roughness), np.full(len(cosine), 2.0)
    for index, polygon in split_at_horizon(vertices.transpose(2, 1, 0)):
        part = lobe.take(index)
        warped = part.to_original_domain(polygon)
        pieces = [(np.arange(len(index)), warped)]
        if part.tilt is not None:
            sine, cosine_tilt = np.sin(part.tilt), np.cos(part.tilt)
            x, y, z = warped
            turned = np.stack([cosine_tilt * x - sine * z, y, sine * x + cosine_tilt * z])
            pieces = split_at_horizon(turned)
        for inner, piece in pieces:
            shortest = np.linalg.norm(edge_sums(project_to_sphere(piece)), axis=0).min(axis=0)
            gap[index[inner]] = np.minimum(gap[index[inner]], shortest)
    return gap


def quadrature(table, cosine, roughness, polygon, levels):
    """Integral of `evaluate_lobe` over the part of one polygon (V, 3) above the horizon: a fan of flat triangles seen
    from the origin, d omega = |det| / |p|^3 du dv, quartered `levels` times, midpoints; error of order 4^-levels."""
    above = polygon[:, 2] > 0.0
    if not above.any():
        return 0.0
    if not above.all():
        polygon = clip_to_horizon(polygon.T[:, :, None])[:, :, 0].T
    unit = polygon / np.linalg.norm(polygon, axis=1, keepdims=True)
    # A fan from within: the triangles are far from half circles, at which quartering would stall.
    apex = unit.sum(axis=0) / np.linalg.norm(unit.sum(axis=0))
    fan = np.stack([np.broadcast_to(apex, unit.shape), unit, np.roll(unit, -1, axis=0)], axis=1)
    for _ in range(levels):
        a, b, c = fan[:, 0], fan[:, 1], fan[:, 2]
        ab, bc, ca = (middle / np.linalg.norm(middle, axis=1, keepdims=True) for middle in (a + b, b + c, c + a))
        parts = [(a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca)]
        fan = np.concatenate([np.stack(part, axis=1) for part in parts])
    # Three points of degree 2 in each triangle.
    nodes = np.full((3, 3), 1.0 / 6.0) + 0.5 * np.eye(3)
    directions = nodes @ fan
    length = np.linalg.norm(directions, axis=2)
    measure = np.abs(np.linalg.det(fan))[:, None] / 6.0 / length**3
    values = shading.evaluate_lobe(table, [cosine], [roughness], (directions / length[..., None]).reshape(1, -1, 3))
    return float(values[0] @ measure.ravel())
