"""Which patches of a light with a texture each sample takes: as large ones as its lobe cannot tell from smaller ones.

A patch has the mean radiance of its parts. What the mean loses is second order in the size of the patch by the length
over which the rest of the integrand changes: the distance for diffuse lobes; for specular ones the width of the lobe,
or the angle from its peak where that is larger.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from ..scene import AreaLight, SurfaceSamples

# The product of the contrast of a patch (see `_largest_size`) and the square of its size by that length is at most
# this. Measured on random surfaces at a light's size from it, with the contrasts of a photograph: the patches that a
# sample takes then give what the smallest ones do to 0.2 % (relative L2); with 0.006, 150 on average of 1024.
PRODUCT = 0.004
# Half the diagonal of a patch by that length, at most: also where the means of its parts are equal.
LARGEST = 0.5
# The width of GGX lobes in rad, by alpha: where the normal distribution has a quarter of its peak.
WIDTH = 2.0
# Lobes seen at grazing angles are narrower across the view; below this cosine they become no narrower.
LEAST_COSINE = 0.1


def fitting_patches(light: AreaLight, samples: SurfaceSamples, specular: bool) -> Iterator[tuple]:
    """Yield (index (Q,), lights): patches of `light`, and the samples that take them. Each sample gets all of it."""
    brightness = np.abs(light.radiance).sum()
    open_patches = [(light, np.arange(len(samples)))]
    while open_patches:
        patch, index = open_patches.pop()
        fits = _sizes(patch, samples.take(index), specular) < _largest_size(patch, brightness)
        if fits.any():
            yield index[fits], (patch,)
        index = index[~fits]
        if len(index) == 0:
            continue
        uncut = tuple(part for part in patch.detail if not part.detail)
        if uncut:
            yield index, uncut
        open_patches += [(part, index) for part in patch.detail if part.detail]


def _largest_size(patch, brightness: float) -> float:
    """What `_sizes` may be; the contrast is how much the parts of `patch` differ from it, by the whole light."""
    areas = np.array([np.linalg.norm(part.area_vector) for part in patch.detail])
    differences = np.array([np.abs(part.radiance - patch.radiance).sum() for part in patch.detail])
    contrast = (areas * differences).sum() / (np.linalg.norm(patch.area_vector) * brightness)
    # What is missing of a patch is dark.
    dark = max(1.0 - areas.sum() / np.linalg.norm(patch.area_vector), 0.0)
    contrast += dark * np.abs(patch.radiance).sum() / brightness
    return min(np.sqrt(PRODUCT / max(contrast, 1e-9)), LARGEST)


def _sizes(patch, samples, specular) -> np.ndarray:
    """Half the diagonal of `patch` (P,) by the length over which the rest of the integrand changes."""
    offset = patch.center - samples.position
    distance = np.maximum(np.linalg.norm(offset, axis=1), 1e-30)
    size = np.hypot(np.linalg.norm(patch.half_u), np.linalg.norm(patch.half_v)) / distance
    width = np.ones(len(samples))
    if specular:
        width = np.minimum(_lobe_width(samples) + _angle_from_peak(samples, offset / distance[:, None], size), 1.0)
    if patch.is_focused:
        width = np.minimum(width, np.tan(0.5 * patch.spread))
    return size / width


def _lobe_width(samples) -> np.ndarray:
    cosine = np.abs((samples.normal * samples.view).sum(axis=1))
    return WIDTH * np.square(samples.roughness) * np.maximum(cosine, LEAST_COSINE)


def _angle_from_peak(samples, direction, size) -> np.ndarray:
    """Angle (P,) in rad between the mirrored view and what is nearest to it in a patch of half the diagonal `size`."""
    mirrored = 2.0 * (samples.normal * samples.view).sum(axis=1, keepdims=True) * samples.normal - samples.view
    chord = np.linalg.norm(direction - mirrored, axis=1)
    return np.maximum(chord - size, 0.0)
