"""The area light shaders of engines, with numpy: what each makes of textures and rectangles, for F = 1.

Written anew after the sources that `tables/layouts.py:LAYOUTS` names. Points are at the origin, their normal is z, and
the view direction is (sin theta, 0, cos theta). Rectangles (P, 4, 3) have their corners in the order of
`random_rectangles`, and their fronts face the points.
"""

import numpy as np


def random_rectangles(count=400, seed=44):
    """cos_theta_o (P,), roughness (P,) from 0.1, and rectangles (P, 4, 3) with a corner or more above the horizon. Half
    of them are near the mirrored view direction."""
    generator = np.random.default_rng(seed)
    signs = np.array([[1.0, -1.0], [-1.0, -1.0], [-1.0, 1.0], [1.0, 1.0]])
    rows = []
    while len(rows) < count:
        cosine, roughness = generator.uniform(0.03, 1.0), generator.uniform(0.1, 1.0)
        center = generator.normal(size=3)
        center /= np.linalg.norm(center)
        if len(rows) % 2 == 0:
            center = 0.5 * center + (-np.sqrt(1.0 - cosine**2), 0.0, cosine)
        first, second = generator.normal(size=(2, 3))
        first /= np.linalg.norm(first)
        second = np.cross(first, second)
        second /= np.linalg.norm(second)
        sizes = generator.uniform(0.2, 1.5, 2)
        corners = generator.uniform(1.0, 4.0) * center + signs @ (sizes[:, None] * np.stack([first, second]))
        normal = np.cross(corners[1] - corners[0], corners[3] - corners[0])
        if normal @ corners[0] > 0.0:
            corners = corners[::-1]
        if corners[:, 2].max() > 0.0:
            rows.append((cosine, roughness, corners))
    return tuple(np.array(part) for part in zip(*rows, strict=True))


def sampled(texture, u, v):
    """Bilinear lookup (P, C) of a texture (N, N, C), rows v, at positions in [0, 1] scaled to the centers of texels."""
    size = len(texture)
    texture = texture.astype(float)
    x, y = u * (size - 1), v * (size - 1)
    i, j = (np.minimum(position.astype(int), size - 2) for position in (x, y))
    right, down = (x - i)[:, None], (y - j)[:, None]
    top = texture[j, i] * (1.0 - right) + texture[j, i + 1] * right
    bottom = texture[j + 1, i] * (1.0 - right) + texture[j + 1, i + 1] * right
    return top * (1.0 - down) + bottom * down


def _transformed(matrices, rectangles):
    return np.einsum("pij,pvj->pvi", matrices, rectangles)


def _matrix(m00, m02, m11, m20, m22):
    """Matrices (P, 3, 3) from five entries (P,)."""
    matrices = np.zeros((len(m00), 3, 3))
    matrices[:, 0, 0], matrices[:, 0, 2], matrices[:, 1, 1] = m00, m02, m11
    matrices[:, 2, 0], matrices[:, 2, 2] = m20, m22
    return matrices


def _unit(vectors):
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


def _edges(corners, edge):
    """Sum (P, 3) of an edge's vector over closed polygons (P, V, 3)."""
    unit = _unit(corners)
    return sum(edge(unit[:, k], unit[:, (k + 1) % unit.shape[1]]) for k in range(unit.shape[1]))


def _rational_edge(start, end):
    """theta / sin(theta) / (2 pi) times the cross product: three.js, Babylon.js, PlayCanvas, Bevy."""
    x = (start * end).sum(axis=-1)
    y = np.abs(x)
    value = (0.8543985 + (0.4965155 + 0.0145206 * y) * y) / (3.4175940 + (4.1616724 + y) * y)
    value = np.where(x > 0.0, value, 0.5 / np.sqrt(np.maximum(1.0 - x * x, 1e-7)) - value)
    return np.cross(start, end) * value[:, None]


def _clipped_by_sphere(form_factor):
    """Three engines and Unity cut the vector form factor (P, 3) like this."""
    length = np.linalg.norm(form_factor, axis=-1)
    return np.maximum((length * length + form_factor[:, 2]) / (length + 1.0), 0.0)


def _clipped(corners):
    """Quads (P, 4, 3) cut at z = 0, as (P, 8, 3) with edges of length zero, and whether anything is left (P,)."""
    parts = []
    for k in range(4):
        start, end = corners[:, k], corners[:, (k + 1) % 4]
        drop = start[:, 2] - end[:, 2]
        share = np.clip(start[:, 2] / np.where(drop == 0.0, 1.0, drop), 0.0, 1.0)[:, None]
        crossing = start + share * (end - start)
        parts += [np.where(start[:, 2:] >= 0.0, start, crossing), np.where(end[:, 2:] >= 0.0, end, crossing)]
    polygon = np.stack(parts, axis=1)
    # A side of which both ends are below vanishes: it takes the corner before it.
    below = np.stack(
        [((corners[:, k, 2] < 0.0) & (corners[:, (k + 1) % 4, 2] < 0.0)) for k in range(4)], axis=1
    ).repeat(2, axis=1)
    for _ in range(2):
        for k in range(8):
            polygon[:, k] = np.where(below[:, k, None], polygon[:, k - 1], polygon[:, k])
    return polygon, (corners[..., 2] > 0.0).any(axis=1)


def three(textures, cosine, roughness, rectangles):
    """three.js, Babylon.js and PlayCanvas. These have the second tangent negated."""
    first, second = (sampled(texture, roughness, np.sqrt(1.0 - cosine)) for texture in textures)
    inverse = _matrix(first[:, 0], first[:, 2], np.ones(len(first)), first[:, 1], first[:, 3])
    corners = _transformed(inverse, rectangles * (1.0, -1.0, 1.0))
    return second[:, 0] * _clipped_by_sphere(_edges(corners, _rational_edge))


def bevy(textures, cosine, roughness, rectangles):
    """Bevy clips exactly, and takes z alone."""
    first, second = (sampled(texture, roughness, np.sqrt(1.0 - cosine)) for texture in textures)
    inverse = _matrix(first[:, 0], first[:, 2], np.ones(len(first)), first[:, 1], first[:, 3])
    polygon, lit = _clipped(_transformed(inverse, rectangles * (1.0, -1.0, 1.0)))
    return np.where(lit, second[:, 0] * _edges(polygon, _rational_edge)[:, 2], 0.0)


def _hill_edge(start, end):
    """theta / sin(theta) times the cross product, Godot's numbers."""
    x = (start * end).sum(axis=-1)
    y = np.abs(x)
    value = (5.42031 + (3.12829 + 0.0902326 * y) * y) / (3.45068 + (4.18814 + y) * y)
    value = np.where(x < 0.0, np.pi / np.sqrt(np.maximum(1.0 - x * x, 1e-7)) - value, value)
    return np.cross(start, end) * value[:, None]


def godot(textures, cosine, roughness, rectangles):
    """Godot's axes are (a tangent, the normal, the view's tangent turned away from the eye)."""
    theta = (0.5 * np.pi - 0.156583 * cosine) * np.sqrt(1.0 - cosine)
    first, second = (sampled(part, np.maximum(roughness, 0.02), theta / (0.5 * np.pi)) for part in textures)
    a, b, c, d = first.T
    e, magnitude = second[:, 0], second[:, 1]
    scale = 1.0 / (a * e - b * d)
    inverse = np.zeros((len(a), 3, 3))
    inverse[:, 2, 0] = 1.0 / c
    inverse[:, 0, 1], inverse[:, 1, 1] = -d * scale, a * scale
    inverse[:, 0, 2], inverse[:, 1, 2] = -e * scale, b * scale
    away = np.array([-1.0, 0.0, 0.0])
    axes = np.stack([np.cross([0.0, 0.0, 1.0], away), [0.0, 0.0, 1.0], away])
    corners = _transformed(inverse, rectangles @ axes.T)
    # The horizon is y here; `_clipped` cuts z.
    polygon, lit = _clipped(corners[..., [2, 0, 1]])
    return np.where(lit, magnitude * np.abs(_edges(polygon, _hill_edge)[:, 2]) / (2.0 * np.pi), 0.0)


def _unity_edge(start, end):
    x = (start * end).sum(axis=-1)
    y, value = np.abs(x), 0.0
    for number in (-0.0270813, 0.137528, -0.326137, 0.510589, -0.649178, 0.783393, -0.99991, 0.5 * np.pi):
        value = value * y + number
    over_sine = 1.0 / np.sqrt(np.maximum(1.0 - x * x, 1e-30))
    return np.cross(start, end) * np.where(x < 0.0, over_sine * np.pi - value, value)[:, None]


def unity(textures, cosine, roughness, rectangles, albedo, *, exact_horizon=False):
    """Unity HDRP. `albedo` (P,) is that of GGX, which the engine has in a texture of its own. `exact_horizon` is how it
    computes without APPROXIMATE_POLY_LIGHT_AS_SPHERE_LIGHT."""
    first = sampled(textures[0], roughness, np.sqrt(1.0 - cosine))
    transposed = _matrix(first[:, 0], first[:, 1], first[:, 2], first[:, 3], np.ones(len(first)))
    corners = _transformed(np.swapaxes(transposed, 1, 2), rectangles[:, ::-1])
    if not exact_horizon:
        return albedo * _clipped_by_sphere(_edges(corners, _unity_edge) / (2.0 * np.pi))
    polygon, lit = _clipped(corners)
    return np.where(lit, albedo * np.maximum(_edges(polygon, _unity_edge)[:, 2], 0.0) / (2.0 * np.pi), 0.0)


SHADERS = {"three": three, "babylon": three, "playcanvas": three, "bevy": bevy, "godot": godot, "unity": unity}


def relative_errors(values, expected, rectangles):
    """Mean errors relative to the mean: of rectangles above the horizon, of those that it cuts, of all."""
    above = rectangles[..., 2].min(axis=1) > 0.0
    error = np.abs(values - expected)
    return [float(error[mask].sum() / expected[mask].sum()) for mask in (above, ~above, np.ones_like(above))]
