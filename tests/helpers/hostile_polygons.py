"""Random quadrilaterals of kinds that are hard to integrate over, and hard points of the tables."""

import numpy as np
from surface_scenes import unit

SQUARE = np.array([[-1.0, -1.0, 0.0], [1.0, -1.0, 0.0], [1.0, 1.0, 0.0], [-1.0, 1.0, 0.0]])


def oriented(generator, count, center, size):
    """Squares (P, 4, 3) of random orientation."""
    u = unit(generator.normal(size=(count, 3)))
    v = np.cross(u, unit(generator.normal(size=(count, 3))))
    return center[:, None] + size * (SQUARE[:, :1] * u[:, None] + SQUARE[:, 1:2] * v[:, None])


def spread(generator, count, low, high):
    """Log-uniform (P, 1, 1)."""
    return 10.0 ** generator.uniform(low, high, size=(count, 1, 1))


def tiny(generator, count):
    return oriented(generator, count, generator.normal(size=(count, 3)), spread(generator, count, -12, -2))


def huge(generator, count):
    return oriented(generator, count, generator.normal(size=(count, 3)), spread(generator, count, 2, 12))


def far(generator, count):
    return oriented(generator, count, generator.normal(size=(count, 3)) * spread(generator, count, 3, 15)[:, 0], 1.0)


def ceilings(generator, count):
    """Horizontal, above the point at all distances down to touching it."""
    shift = generator.uniform(-2.0, 2.0, size=(count, 1, 3)) * np.array([1.0, 1.0, 0.0])
    return SQUARE + shift + spread(generator, count, -17, 1) * np.array([0.0, 0.0, 1.0])


def edge_on(generator, count):
    """Planes that pass closely by the point, or through it."""
    polygons = oriented(generator, count, np.zeros((count, 3)), 1.0)
    u = polygons[:, 1] - polygons[:, 0]
    normal = unit(np.cross(u, polygons[:, 2] - polygons[:, 1]))[:, None]
    along = u[:, None] * generator.uniform(-2.0, 2.0, size=(count, 1, 1))
    gap = spread(generator, count, -17, -3)
    return polygons + along + np.where(gap < 1e-16, 0.0, gap) * normal


def walls(generator, count):
    """Upright, standing on the horizon, sunk into it, with a foot at all distances from the point."""
    angle = generator.random(count) * 2.0 * np.pi
    side = np.stack([-np.sin(angle), np.cos(angle), np.zeros(count)], axis=1)[:, None]
    forward = np.stack([np.cos(angle), np.sin(angle), np.zeros(count)], axis=1)[:, None]
    up = np.array([0.0, 0.0, 1.0])
    base = generator.choice([0.0, -1.0, 1e-9], size=(count, 1, 1)) * up
    polygon = SQUARE[:, :1] * side + (SQUARE[:, 1:2] + 1.0) * up
    return polygon + base + forward * spread(generator, count, -17, 1)


def at_the_point(generator, count):
    """A corner or an edge at the point itself."""
    polygons = oriented(generator, count, np.zeros((count, 3)), 1.0)
    on_edge = (np.arange(count) % 2 == 0)[:, None, None]
    return polygons - np.where(on_edge, 0.5 * (polygons[:, :1] + polygons[:, 1:2]), polygons[:, :1])


def repeated(generator, count):
    polygons = oriented(generator, count, generator.normal(size=(count, 3)), 1.0)
    choice = generator.integers(0, 4, size=(count, 4))
    return np.take_along_axis(polygons, choice[..., None], axis=1)


def collinear(generator, count):
    start, step = generator.normal(size=(2, count, 1, 3))
    return start + step * generator.normal(size=(count, 4, 1))


def lattice(generator, count):
    """Corners with coordinates of -1, 0 and 1: everything that can coincide does; not planar, not convex."""
    return generator.integers(-1, 2, size=(count, 4, 3)).astype(float)


HOSTILE = [tiny, huge, far, ceilings, edge_on, walls, at_the_point, repeated, collinear, lattice]


def setting(generator, count):
    """cos_theta_o and roughness, their limits included."""
    cosine, roughness = generator.random(count), generator.random(count)
    limits = generator.random(count)
    cosine = np.where(limits < 0.1, 0.0, np.where(limits < 0.2, 1.0, np.where(limits < 0.3, cosine * 1e-3, cosine)))
    limits = generator.random(count)
    roughness = np.where(limits < 0.1, 0.0, np.where(limits < 0.2, 1.0, roughness))
    return cosine, np.where((limits > 0.2) & (limits < 0.3), 0.05 * roughness, roughness)
