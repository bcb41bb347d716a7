"""Where a light must be for its highlight to be at a given pixel: the peak of its specular radiance in the picture."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from ..scene import Light, SurfaceSamples
from .integrator import shade

# STENCIL: the pixels around the cursor, in steps; the fifth is the cursor. Their radiance is fitted by a quadratic.
STENCIL = np.stack(np.meshgrid([-1.0, 0.0, 1.0], [-1.0, 0.0, 1.0]), axis=-1).reshape(-1, 2)
_FIT = np.linalg.pinv(np.stack([np.ones(9), *STENCIL.T, *(0.5 * STENCIL**2).T, STENCIL.prod(axis=1)], axis=-1))
# STEPS: of Newton's method. NEAR: steps of the stencil from the cursor to the peak at which it ends.
STEPS, NEAR = 12, 0.05
# FLAT: a gradient, per step of the stencil, of a radiance that hardly varies around the cursor: large lights in smooth
# surfaces.
FLAT = 5e-4
# PROBE: the angle of the differences, relative to that of the lobe; LARGEST: of a step.
PROBE, LARGEST = 0.1, 0.8


@dataclass(frozen=True)
class HighlightPlace:
    """Where a light is for a highlight."""

    direction: np.ndarray  # (3,) unit, from the point to the light
    is_peak: bool  # False: nowhere near the mirrored view is there a peak at this pixel, and the radiance varies


def mirrored(view: np.ndarray, normal: np.ndarray) -> np.ndarray:
    """The direction (..., 3) from which a mirror with this `normal` shows light along `view`, both (..., 3), unit."""
    return 2.0 * (view * normal).sum(axis=-1, keepdims=True) * normal - view


def place_for_highlight(
    samples: SurfaceSamples, light_at: Callable[[np.ndarray], Light], technique="ltsh4c"
) -> HighlightPlace:
    """The direction for which the specular radiance of a light has its peak at the middle one of the nine `samples`.

    The samples are those of the pixels of STENCIL; `light_at(direction)` is the light in a unit direction (3,) from the
    middle one. Newton's method for the gradient of the logarithm of the radiance, which is 0 at the peak, from the
    mirrored view on: of rough and curved surfaces the peak is elsewhere.
    """
    middle = len(STENCIL) // 2
    direction = mirrored(samples.view[middle], samples.normal[middle])
    lobe = max(float(samples.sharpest_roughness[middle]) ** 2, 1e-3)
    best = None
    for _ in range(STEPS):
        first = np.cross(direction, np.eye(3)[np.argmin(np.abs(direction))])
        first /= np.linalg.norm(first)
        axes = np.stack([first, np.cross(direction, first)])
        turned = direction + np.concatenate([np.zeros((1, 3)), PROBE * lobe * axes])
        turned /= np.linalg.norm(turned, axis=-1, keepdims=True)
        gradient, curvature, is_lit = _fitted(samples, [light_at(one) for one in turned], technique)
        if not is_lit:
            break
        # How far the peak is, in steps of the stencil. Without a peak, by the size of the curvature alone.
        values, vectors = np.linalg.eigh(curvature)
        offset = float(np.linalg.norm(vectors.T @ gradient[0] / np.maximum(np.abs(values), 1e-12)))
        if best is None or offset < best[0]:
            is_flat = float(np.linalg.norm(gradient[0])) < FLAT
            best = offset, direction, is_flat or (values.max() < 0.0 and offset < 1.0)
        if offset < NEAR and values.max() < 0.0:
            break
        jacobian = (gradient[1:] - gradient[0]).T / (PROBE * lobe)
        step = np.linalg.lstsq(jacobian, -gradient[0], rcond=None)[0]
        step *= min(1.0, LARGEST * lobe / max(np.linalg.norm(step), 1e-30))
        direction = direction + step @ axes
        direction /= np.linalg.norm(direction)
    if best is None:
        return HighlightPlace(mirrored(samples.view[middle], samples.normal[middle]), False)
    _, direction, is_peak = best
    return HighlightPlace(direction, bool(is_peak))


def _fitted(samples: SurfaceSamples, lights: list[Light], technique) -> tuple[np.ndarray, np.ndarray, bool]:
    """Gradients (L, 2) of the logarithm of the specular radiance of each light, the curvature (2, 2) of the first, and
    whether it lights all samples."""
    shaded = shade(samples, lights, technique, passes=("specular",), workers=1, dtype=np.float64)
    radiance = shaded.specular.sum(axis=-1)
    if not (radiance > 0.0).all():
        return np.zeros((len(lights), 2)), np.zeros((2, 2)), False
    _, right, up, right_right, up_up, right_up = _FIT @ np.log(radiance).T
    return np.stack([right, up], axis=-1), np.array([[right_right[0], right_up[0]], [right_up[0], up_up[0]]]), True
