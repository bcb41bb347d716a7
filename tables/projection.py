"""Best coefficients for given warps: the linear half of the fit (variable projection, Golub and Pereyra 1973)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ltsh_addon.shading import brdf

from .fresnel_basis import COSINES, FLAT

# Relative to the normalized Gram matrix: keeps directions that hardly matter from growing.
RIDGE = 1e-6


@dataclass(frozen=True)
class Points:
    """Quadrature and target of a batch of points (roughness, theta_o) of the table."""

    cosine: np.ndarray  # (P,)
    alpha: np.ndarray  # (P,)
    directions: np.ndarray  # (P, S, 3)
    quadrature: np.ndarray  # (P, S) weights of the integral over the hemisphere
    lobes: np.ndarray  # (P, S, F) cosine-weighted BRDF times each Fresnel curve
    albedo: np.ndarray  # (P, F)

    @classmethod
    def at(cls, model, cosine, alpha, curves, *, albedo=None, counts=(28, 28)):
        """Points of a BRDF at cosine (P,) and alpha (P,) for Fresnel curves (F, C), with counts of directions."""
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
    """Basis functions (P, S, size) of the lobes with warp entries (xx, xz, yy, zz), (P,) each, at `directions`."""
    xx, xz, yy, zz = (entry[:, None] for entry in entries)
    x, y, z = (directions[..., axis] for axis in range(3))
    warped = np.stack([xx * x + xz * z, yy * y, zz * z], axis=-1)
    length = np.sqrt((warped * warped).sum(axis=-1, keepdims=True))
    return family.basis(warped / length, tilt) * ((xx * yy * zz)[..., None] / length**3)


def project(family, points, entries, tilt, curves=slice(0, 1)):
    """Coefficients (P, F, size) of least squared error whose albedo is exact, and residuals
    (P, S, F) relative to each lobe's norm."""
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
    """Relative L2 error (P,) over the upper hemisphere of lobes with values (P, S), F = 1."""
    target = points.lobes[..., 0]
    squared = (points.quadrature * (values - target) ** 2).sum(axis=1)
    return np.sqrt(squared / (points.quadrature * target**2).sum(axis=1))
