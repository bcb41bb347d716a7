"""Fresnel curves that share one warp: 1 and (1 - c)^5 for Schlick, c (1 - c)^6 for the F82 tint, two for dielectrics.

A lobe is linear in its coefficients, so a reflectance that is a combination of the curves costs nothing beyond the fit
of the curves themselves. The F82 tint of metals is Kutz, Hasan and Edmondson 2021, "Novel Aspects of the Adobe Standard
Material". The two curves for dielectrics, on top of the fixed three, minimize the squared relative error of the exact
dielectric reflectance over index of refraction and angle: weighted low-rank approximation by alternating least squares
(Srebro and Jaakkola 2003).
"""

from __future__ import annotations

from functools import cache

import numpy as np

from ltsh_addon.shading import brdf

COSINES = np.linspace(0.0, 1.0, 257)
FLAT = np.ones((1, len(COSINES)))
# Fitted on this range; weights are tabulated on a wider one, where the error grows.
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
    """Weights (I, F) that approximate reflectance (I, C) by the curves (F, C), least squares of the relative error."""
    squared_weight = 1.0 / np.maximum(reflectance, 1e-6) ** 2
    system = np.tensordot(squared_weight, _outer(curves.T), axes=(1, 0))
    target = (squared_weight * reflectance) @ curves.T
    return np.linalg.solve(_damped(system), target[..., None])[..., 0]


def _outer(vectors):
    return vectors[:, :, None] * vectors[:, None, :]


def _damped(system):
    size = system.shape[-1]
    return system + 1e-12 * np.trace(system, axis1=1, axis2=2)[:, None, None] * np.eye(size)
