"""What is minimized between the nodes of a table, and its normal equations.

The squared error of a point is a sum of four terms, all relative to the true lobe:

- the squared L2 error over the upper hemisphere, where directions in which the fitted lobe is negative count
  1 + NEGATIVE_WEIGHT times;
- LIGHT_WEIGHT times the squared error of what a renderer computes, integrals over lights: soft windows of three widths,
  spread evenly over the hemisphere. An L2 norm alone sells the tail of the lobe for a little at the peak, but a light
  is often seen in the tail alone;
- ALBEDO_WEIGHT times the squared error of the albedo;
- EXCESS_WEIGHT times the square of what the negative mass, relative to the albedo, has above NEGATIVE_SHARE.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ltsh_addon.shading.lookup_table import warp_entries

from .cells import batches
from .fresnel_basis import FLAT
from .projection import Points, warped_basis

# An error below this one is good enough: points count by 1 / max(error, ERROR_FLOOR).
ERROR_FLOOR = 2e-3
LIGHT_WEIGHT = 0.4
ALBEDO_WEIGHT = 9.0
NEGATIVE_WEIGHT = 2.0
NEGATIVE_SHARE = 0.008
EXCESS_WEIGHT = 50.0
WINDOWS = 40
WINDOW_WIDTHS = np.radians([8.0, 16.0, 28.0])


@dataclass(frozen=True)
class Linearization:
    """Normal equations of P points, each for the d values that are interpolated there, and the errors measured.

    `right` has one column per Fresnel curve: for curve 0, F = 1, it is the negative gradient; for the others it is the
    projection of the whole target on the derivatives.
    """

    error: np.ndarray  # (P,) square root of the sum of the four terms
    matrices: np.ndarray | None  # (P, d, d)
    right: np.ndarray | None  # (P, d, F)

    @property
    def importance(self):
        """Weights (P,) that make a sum of squared errors act like the sum of the errors."""
        return 1.0 / np.maximum(self.error, ERROR_FLOOR)


def linearize(family, model, cells, nodes, curves=FLAT, *, derivatives=True) -> Linearization:
    """Linearization at `nodes` (R, T, n + size): the channels of the warp, then the coefficients for F = 1."""
    values = cells.interpolate(nodes)
    found = []
    for part in batches(len(values)):
        points = Points.at(
            model, cells.cosine[part], cells.roughness[part] ** 2, curves, albedo=cells.albedo[part, : len(curves)]
        )
        found.append(_linearize(family, points, values[part], derivatives))
    return Linearization(*(None if part[0] is None else np.concatenate(part) for part in zip(*found, strict=True)))


def _linearize(family, points, values, derivatives):
    warp, coefficients = values[:, : family.parameters], values[:, family.parameters :]
    basis = _basis(family, points, warp)
    lobe = np.einsum("psk,pk->ps", basis, coefficients)
    functionals, scales = _functionals(points)
    # Missing: of every curve for the right-hand side, of F = 1 for the error
    targets = points.lobes.copy()
    targets[..., 0] -= lobe
    weights = points.quadrature * (1.0 + NEGATIVE_WEIGHT * (lobe < 0.0))
    weights /= (points.quadrature * points.lobes[..., 0] ** 2).sum(axis=1)[:, None]
    misses = np.matmul(functionals, targets)
    albedo_row = _albedo_row(family, points, warp, coefficients)
    albedo_misses = points.albedo / points.albedo[:, :1]
    albedo_misses[:, 0] -= np.einsum("pd,pd->p", albedo_row[:, family.parameters :], coefficients)
    squared = (weights * targets[..., 0] ** 2).sum(axis=1) + scales * (misses[..., 0] ** 2).sum(axis=1)
    excess_row = np.where(lobe < 0.0, points.quadrature, 0.0) / points.albedo[:, :1]
    excess = np.maximum(-(excess_row * lobe).sum(axis=1) - NEGATIVE_SHARE, 0.0)
    excess_row *= (excess > 0.0)[:, None]
    error = np.sqrt(squared + ALBEDO_WEIGHT * albedo_misses[:, 0] ** 2 + EXCESS_WEIGHT * excess**2)
    if not derivatives:
        return error, None, None
    importance = 1.0 / np.maximum(error, ERROR_FLOOR)
    jacobian = np.concatenate([_warp_slopes(family, points, warp, coefficients, lobe), basis], axis=-1)
    matrices, right = _normal(jacobian, weights * importance[:, None], targets)
    scales = np.broadcast_to((scales * importance)[:, None], misses.shape[:2])
    rows = [(np.matmul(functionals, jacobian), scales, misses)]
    rows.append((albedo_row[:, None], (ALBEDO_WEIGHT * importance)[:, None], albedo_misses[:, None]))
    if points.lobes.shape[2] == 1:
        slopes = np.matmul(excess_row[:, None], jacobian)
        rows.append((slopes, (EXCESS_WEIGHT * importance)[:, None], excess[:, None, None]))
    for row in rows:
        more = _normal(*row)
        matrices, right = matrices + more[0], right + more[1]
    return error, matrices, right


def _normal(jacobian, weights, targets):
    """J^T W J (P, d, d) and J^T W t (P, d, F) for J (P, S, d), diagonal W (P, S), t (P, S, F)."""
    transposed = np.swapaxes(jacobian * weights[..., None], 1, 2)
    return np.matmul(transposed, jacobian), np.matmul(transposed, targets)


def _tilt(family, warp):
    return warp[:, 3] if family.kind == "ltc" else np.zeros(len(warp))


def _basis(family, points, warp):
    entries = warp_entries(points.cosine, points.alpha, *warp.T[:3])
    return warped_basis(family, points.directions, entries, _tilt(family, warp))


def _warp_slopes(family, points, warp, coefficients, lobe, step=1e-5):
    """Derivatives (P, S, n) of the lobe by the channels of the warp."""
    moved = [_basis(family, points, warp + step * axis) for axis in np.eye(family.parameters)]
    return np.stack([(np.einsum("psk,pk->ps", basis, coefficients) - lobe) / step for basis in moved], axis=-1)


def _albedo_row(family, points, warp, coefficients):
    """Derivatives (P, n + size) of the relative albedo."""
    tilt = _tilt(family, warp)
    by_warp = np.zeros((len(warp), family.parameters))
    if family.kind == "ltc":
        by_warp[:, 3] = -0.5 * np.sin(tilt) * coefficients[:, 0]
    return np.concatenate([by_warp, family.basis_albedo(tilt)], axis=1) / points.albedo[:, :1]


def _functionals(points):
    """Rows (P, W, S) that integrate over soft lights, mirror-symmetric in y, and the scale (P,) of their squares."""
    k = np.arange(WINDOWS) + 0.5
    z, azimuth = 1.0 - k / WINDOWS, np.pi * (1.0 + np.sqrt(5.0)) * k
    radius = np.sqrt(1.0 - z * z)
    centers = np.stack([radius * np.cos(azimuth), radius * np.sin(azimuth), z], axis=-1)
    sharpness = 1.0 / np.resize(WINDOW_WIDTHS, WINDOWS)[:, None] ** 2
    mirrored = centers * np.array([1.0, -1.0, 1.0])
    directions = np.swapaxes(points.directions, 1, 2)
    # Windows of single precision are as good: they weigh the lobe and what is fitted to it alike.
    exponents = [((np.matmul(side, directions) - 1.0) * sharpness).astype(np.float32) for side in (centers, mirrored)]
    windows = (np.exp(exponents[0]) + np.exp(exponents[1])) * points.quadrature[:, None, :]
    seen = np.matmul(windows, points.lobes[..., :1])[..., 0]
    return windows, LIGHT_WEIGHT / (seen**2).sum(axis=1)
