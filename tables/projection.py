"""Fresnel curves that share one warp: 1 and (1 - c)^5 (Schlick), c (1 - c)^6 (F82 tint), and two for dielectrics.

A lobe is linear in its coefficients. So a reflectance that is a combination of the curves costs nothing beyond the fit
of the curves themselves. The F82 tint of metals is Kutz, Hasan and Edmondson 2021, "Novel Aspects of the Adobe Standard
Material". The two curves for dielectrics come on top of the three fixed ones. They minimize the squared relative error
of the exact dielectric reflectance over index of refraction and angle, by weighted low-rank approximation with
alternating least squares (Srebro and Jaakkola 2003).
"""

from dataclasses import dataclass
from functools import cache

import numpy as np

from ltsh_addon.lobes import brdf
from ltsh_addon.lobes.lookup_table import theta_at

COSINES = np.linspace(0.0, 1.0, 257)
FLAT = np.ones((1, len(COSINES)))
# The curves are fitted on FITTED_IOR. The weights are tabulated on a wider range, where the error grows.
FITTED_IOR = np.linspace(1.05, 3.0, 196)
TABULATED_IOR = np.concatenate([np.linspace(1.0, 1.05, 11), np.linspace(1.06, 1.6, 109), np.linspace(1.62, 4.0, 120)])
CURVE_NAMES = ["1", "(1-c)^5", "c(1-c)^6", "dielectric 1", "dielectric 2"]
OPTIMIZED_CURVES = 2


@cache
def fresnel_basis(sweeps: int = 800):
    """Curves (5, 257) on COSINES, and the weights (I, 5) of TABULATED_IOR."""
    fixed = np.stack([np.ones_like(COSINES), brdf.schlick_curve(COSINES), COSINES * (1.0 - COSINES) ** 6])
    count = len(fixed)
    reflectance = brdf.dielectric_reflectance(COSINES, FITTED_IOR[:, None])
    squared_weight = 1.0 / reflectance**2
    optimized = np.linalg.svd(reflectance)[2][:OPTIMIZED_CURVES]
    for _ in range(sweeps):
        curves = np.concatenate([fixed, optimized])
        weights = combine(curves, reflectance)
        residual = reflectance - weights[:, :count] @ fixed
        free = weights[:, count:]
        system = np.tensordot(squared_weight, _outer(free), axes=(0, 0))
        target = (squared_weight * residual).T @ free
        optimized = np.linalg.solve(_damped(system), target[..., None])[..., 0].T
        optimized = np.linalg.qr(optimized.T)[0].T
    curves = np.concatenate([fixed, optimized])
    return curves, combine(curves, brdf.dielectric_reflectance(COSINES, TABULATED_IOR[:, None]))


def combine(curves, reflectance):
    """Weights (I, F) with which the curves (F, C) approximate reflectance (I, C): least squares of the relative
    error."""
    squared_weight = 1.0 / np.maximum(reflectance, 1e-6) ** 2
    system = np.tensordot(squared_weight, _outer(curves.T), axes=(1, 0))
    target = (squared_weight * reflectance) @ curves.T
    return np.linalg.solve(_damped(system), target[..., None])[..., 0]


def _outer(vectors):
    return vectors[:, :, None] * vectors[:, None, :]


def _damped(system):
    size = system.shape[-1]
    return system + 1e-12 * np.trace(system, axis1=1, axis2=2)[:, None, None] * np.eye(size)


# Regularization relative to the normalized Gram matrix. It keeps directions that hardly matter from growing.
RIDGE = 1e-6


@dataclass(frozen=True)
class Points:
    """Quadrature and target of a batch of table points (roughness, theta_o)."""

    cosine: np.ndarray  # (P,)
    alpha: np.ndarray  # (P,)
    directions: np.ndarray  # (P, S, 3)
    quadrature: np.ndarray  # (P, S) weights of the integral over the hemisphere
    lobes: np.ndarray  # (P, S, F) cosine-weighted BRDF times each Fresnel curve
    albedo: np.ndarray  # (P, F)

    @classmethod
    def at(cls, model, cosine, alpha, curves, *, albedo=None, counts=(28, 28)):
        """Points of a BRDF at cosine (P,) and alpha (P,), for Fresnel curves (F, C). `counts` are those of
        directions."""
        directions, quadrature = model.samples(cosine, alpha, *counts)
        lobes = _lobes(model, cosine, alpha, directions, curves)
        if albedo is None:
            albedo = directional_albedo(model, cosine, alpha, curves)
        return cls(cosine, alpha, directions, quadrature, lobes, albedo)


def directional_albedo(model, cosine, alpha, curves, counts=(64, 96)):
    """Integrals (P, F) of the BRDF times cosine times each Fresnel curve over the hemisphere."""
    directions, weights = model.samples(cosine, alpha, *counts)
    return np.einsum("ps,psf->pf", weights, _lobes(model, cosine, alpha, directions, curves))


def _lobes(model, cosine, alpha, directions, curves):
    lobe = model.value(cosine, alpha, directions)[..., None]
    if curves is FLAT:
        return lobe
    half = brdf.half_angle_cosine(cosine, directions)
    factors = np.stack([np.interp(half, COSINES, curve) for curve in curves], axis=-1)
    return lobe * factors


def warped_basis(family, directions, entries, tilt):
    """Basis functions (P, S, size) of lobes at `directions`. The warp entries are (xx, xz, yy, zz), (P,) each."""
    xx, xz, yy, zz = (entry[:, None] for entry in entries)
    x, y, z = (directions[..., axis] for axis in range(3))
    warped = np.stack([xx * x + xz * z, yy * y, zz * z], axis=-1)
    length = np.sqrt((warped * warped).sum(axis=-1, keepdims=True))
    return family.basis(warped / length, tilt) * ((xx * yy * zz)[..., None] / length**3)


def project(family, points, entries, tilt, curves=slice(0, 1)):
    """Coefficients (P, F, size) of least squared error with exact albedo, and residuals (P, S, F) relative to the norm
    of each lobe."""
    root = np.sqrt(points.quadrature)[..., None]
    basis = warped_basis(family, points.directions, entries, tilt) * root
    target = points.lobes[..., curves] * root
    scale = 1.0 / np.sqrt((basis * basis).sum(axis=1))
    basis = basis * scale[:, None, :]
    transposed = np.swapaxes(basis, 1, 2)
    gram = np.matmul(transposed, basis) + RIDGE * np.eye(basis.shape[2])
    albedo_row = family.basis_albedo(tilt) * scale
    right = np.concatenate([np.matmul(transposed, target), albedo_row[..., None]], axis=2)
    solution = np.linalg.solve(gram, right)
    free, direction = solution[..., :-1], solution[..., -1]
    # Lagrange multiplier of the albedo constraint
    missing = points.albedo[:, curves] - np.einsum("pk,pkf->pf", albedo_row, free)
    multiplier = missing / (albedo_row * direction).sum(axis=1)[:, None]
    coefficients = free + direction[..., None] * multiplier[:, None, :]
    norm = np.sqrt((target * target).sum(axis=1, keepdims=True))
    residual = (target - np.matmul(basis, coefficients)) / np.maximum(norm, 1e-30)
    return np.swapaxes(coefficients * scale[..., None], 1, 2), residual


def relative_error(points, values):
    """Relative L2 error (P,) over the upper hemisphere of lobes with values (P, S), for F = 1."""
    target = points.lobes[..., 0]
    squared = (points.quadrature * (values - target) ** 2).sum(axis=1)
    return np.sqrt(squared / (points.quadrature * target**2).sum(axis=1))


# Positions of the two Gauss points of a cell along each axis
GAUSS = np.array([0.5 - 0.5 / np.sqrt(3.0), 0.5 + 0.5 / np.sqrt(3.0)])
# Points of a batch
BATCH = 126


@dataclass(frozen=True)
class Cells:
    """The 2 x 2 Gauss points of all cells of a table of R x T nodes: arrays of P = 4 (R - 1)(T - 1)."""

    shape: tuple[int, int]
    roughness: np.ndarray  # (P,)
    cosine: np.ndarray  # (P,)
    albedo: np.ndarray  # (P, F)

    @classmethod
    def of(cls, model, shape, lowest_cosine, curves):
        """Cells of a table of `shape` for a BRDF and Fresnel curves (F, C); cosines are at least `lowest_cosine`."""
        positions = [((np.arange(count - 1)[:, None] + GAUSS) / (count - 1)).ravel() for count in shape]
        roughness, theta = (grid.ravel() for grid in np.meshgrid(positions[0], theta_at(positions[1]), indexing="ij"))
        cosine = np.maximum(np.cos(theta), lowest_cosine)
        albedo = [
            directional_albedo(model, cosine[part], roughness[part] ** 2, curves, (48, 64))
            for part in batches(len(cosine))
        ]
        return cls(shape, roughness, cosine, np.concatenate(albedo))

    def interpolate(self, nodes):
        """Values (P, d) at the Gauss points of node values (R, T, d)."""
        rows = np.stack([nodes[:-1] * (1 - t) + nodes[1:] * t for t in GAUSS], axis=1)
        rows = rows.reshape(-1, *nodes.shape[1:])
        columns = np.stack([rows[:, :-1] * (1 - t) + rows[:, 1:] * t for t in GAUSS], axis=2)
        return columns.reshape(-1, nodes.shape[2])

    def distribute(self, values):
        """The transpose of `interpolate`: (P, d) -> (R, T, d)."""
        rows, columns = self.shape
        values = values.reshape(2 * (rows - 1), columns - 1, 2, -1)
        spread = np.zeros((2 * (rows - 1), columns, values.shape[-1]))
        result = np.zeros((rows, columns, values.shape[-1]))
        for k, t in enumerate(GAUSS):
            spread[:, :-1] += values[:, :, k] * (1 - t)
            spread[:, 1:] += values[:, :, k] * t
        spread = spread.reshape(rows - 1, 2, columns, -1)
        for k, t in enumerate(GAUSS):
            result[:-1] += spread[:, k] * (1 - t)
            result[1:] += spread[:, k] * t
        return result

    def node_blocks(self, matrices):
        """Diagonal blocks (R, T, d, d) of the nodes in the normal matrix. `matrices` (P, d, d) are its blocks at the
        points."""
        rows, columns = self.shape
        size = matrices.shape[-1]
        matrices = matrices.reshape(rows - 1, 2, columns - 1, 2, size, size)
        blocks = np.zeros((rows, columns, size, size))
        for i in (0, 1):
            for j in (0, 1):
                for k, s in enumerate(GAUSS):
                    for m, t in enumerate(GAUSS):
                        weight = (s if i else 1 - s) * (t if j else 1 - t)
                        blocks[i : rows - 1 + i, j : columns - 1 + j] += weight**2 * matrices[:, k, :, m]
        return blocks


def batches(count):
    """Slices of at most BATCH of `count` points."""
    return [slice(start, start + BATCH) for start in range(0, count, BATCH)]
