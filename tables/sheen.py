"""Sheen in the pack: the sheen of Cycles as cubic B-splines over the axes of the pack.

Sheen is a linearly transformed cosine (`cycles.closures.sheen_lobe`; Zeltner, Burley and Chiang 2022). Cycles
interpolates its albedo, a and b between 32 x 32 nodes. `fit` finds the spline coefficients with the least squared
difference of the lobes, linearized at those of Cycles: one linear system. The result is a layer of tables/pack.dds.
"""

from functools import cache

import numpy as np

from ltsh_addon.cycles.closures import sheen_lobe
from ltsh_addon.lobes.lookup_table import theta_at

from . import pack

POINTS = 48  # of the fit, along each axis
# Where sheen is weaker than the mean, its error counts less: squared norm of a lobe, as a share of the mean.
FAINT = 0.01
# Weight of second differences of the coefficients, where no lobe tells them: below roughness 0.1 head on.
SMOOTHNESS = 1e-6
LEAST_A = 1e-3


@cache
def load_sheen() -> np.ndarray:
    """Spline coefficients (SIZE, SIZE, 3) of albedo, a and b by roughness and theta_o."""
    return pack.layers()[pack.FIRST_LAYERS["sheen"], ..., :3].astype(np.float32)


def lookup(coefficients: np.ndarray, cosine: np.ndarray, roughness: np.ndarray) -> np.ndarray:
    """Albedo, a and b (3, P) for `cosine` (P,) between view and normal and `roughness` (P,), as the header looks up."""
    (values,) = pack.splines_at(cosine, roughness, coefficients)
    return np.stack([np.maximum(values[0], 0.0), np.maximum(values[1], LEAST_A), values[2]])


def lobe(sheen: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """BRDF times cosine (P, D), sr^-1, of albedo, a and b (3, P) toward unit directions (3, D) above the horizon."""
    albedo, a, b = sheen[..., None]
    x, y, z = directions
    return albedo * z / np.pi * (a / ((a * x + b * z) ** 2 + (a * y) ** 2 + z * z)) ** 2


def lobe_derivatives(sheen: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """Derivatives (3, P, D) of `lobe` by albedo, a and b."""
    albedo, a, b = sheen[..., None]
    x, y, z = directions
    across = a * x + b * z
    squared = across**2 + (a * y) ** 2 + z * z
    ratio = z / np.pi * a / squared
    by_a = 2.0 * albedo * ratio * (1.0 / squared - 2.0 * a * (x * across + a * y * y) / squared**2)
    by_b = -4.0 * albedo * ratio * a * z * across / squared**2
    return np.stack([ratio * a / squared, by_a, by_b])


def hemisphere() -> tuple[np.ndarray, np.ndarray]:
    """Directions (3, D) and weights (D,), in sr, of a quadrature over the hemisphere, for lobes even in y."""
    nodes, weights = np.polynomial.legendre.leggauss(32)
    theta, phi = np.meshgrid(0.25 * np.pi * (nodes + 1.0), np.pi * (np.arange(48) + 0.5) / 48, indexing="ij")
    directions = np.stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)])
    weights = np.pi**2 / 96 * weights[:, None] * np.sin(theta)
    return directions.reshape(3, -1), weights.ravel()


def sheen_points(count: int) -> tuple[np.ndarray, np.ndarray]:
    """Cosines and roughness (P,), P = count^2, uniform over both axes of the pack."""
    positions = (np.arange(count) + 0.5) / count
    roughness, columns = (grid.ravel() for grid in np.meshgrid(positions, positions, indexing="ij"))
    return np.cos(theta_at(columns)), roughness


def fit() -> np.ndarray:
    """Spline coefficients (SIZE, SIZE, 3) of albedo, a and b."""
    cosine, roughness = sheen_points(POINTS)
    directions, weights = hemisphere()
    target = sheen_lobe(cosine, roughness)
    squared = lobe(target, directions) ** 2 @ weights
    derivatives = lobe_derivatives(target, directions) * np.sqrt(weights)
    metric = np.einsum("ipd,jpd->ijp", derivatives, derivatives) / (squared + FAINT * squared.mean())
    axis = pack.matrix((np.arange(POINTS) + 0.5) / POINTS)
    splines = np.kron(axis, axis)
    system = np.block([[splines.T @ (weight[:, None] * splines) for weight in row] for row in metric])
    right = np.concatenate([splines.T @ (row * target).sum(axis=0) for row in metric])
    bends = np.diff(np.eye(pack.SIZE), 2, axis=0)
    bends = np.kron(np.eye(pack.SIZE), bends.T @ bends) + np.kron(bends.T @ bends, np.eye(pack.SIZE))
    smoothness = SMOOTHNESS * np.trace(system) / len(system)
    system += smoothness * np.kron(np.eye(3), bends)
    solved = np.linalg.lstsq(system, right, rcond=1e-14)[0]
    return np.moveaxis(solved.reshape(3, pack.SIZE, pack.SIZE), 0, 2)


def errors(coefficients: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Relative L2 errors (P,) of lobes beside those of Cycles where their albedo is at least .01, and the differences
    of all albedos, at count^2 points."""
    cosine, roughness = sheen_points(count)
    directions, weights = hemisphere()
    sheen, target = lookup(coefficients, cosine, roughness), sheen_lobe(cosine, roughness)
    expected = lobe(target, directions)
    error = np.sqrt((lobe(sheen, directions) - expected) ** 2 @ weights / np.maximum(expected**2 @ weights, 1e-30))
    return error[target[0] >= 0.01], np.abs(sheen[0] - target[0])
