"""What few points of a pixel miss of diffuse light, from what Cycles' many samples know of the surfaces.

Cycles' passes have the mean color and the mean normal of a pixel over hundreds of samples. LTSH's light of a pixel has
that of its few points, for which colors and normals are known as well:

    light = color by Cycles (light / color + slope . (normal by Cycles - normal)), other means are over the points

The first term is a ratio estimator, the second a regression estimator (Cochran 1977, Sampling Techniques, chapters 6
and 7). The slope of the light over the normal is found by least squares among all points around the pixel, as in local
linear regression of renderings (Moon, Carr and Yoon 2014, Adaptive Rendering Based on Weighted Local Regression).
"""

import numpy as np

from ..emitters.light_polygons import has_lobe
from ..scene import Film

MOST_RECOLORING = 3.0  # how many times the color of LTSH's points Cycles' color of a pixel counts at most
# SLOPE_RADIUS: the points of pixels that are at most so far away tell the slope. RIDGE: what is added to the variance
# of normals there, so that nearly even surfaces have none. MOST_BEND: the factors by which the slope changes light.
SLOPE_RADIUS, RIDGE, MOST_BEND = 2, 1e-3, (0.5, 2.0)
LEAST_COLOR = 1e-3  # points with darker colors tell no slope
SAME_NORMAL = 1e-3  # largest difference of the components of one normal


def factor_of_samples(film: Film, samples, radiance: np.ndarray, color: np.ndarray, normal: np.ndarray, count: int):
    """Factor (H, W, 3) of the diffuse `radiance` (P, 3) of `samples` (P) on a `film`.

    `color` and `normal` (H, W, 3) are means over `count` samples of Cycles.
    """
    own_color, first = film.image(samples.diffuse_albedo), slice(None) if film.first is None else film.first
    factor = np.divide(color, own_color, out=np.ones_like(own_color), where=own_color > 1e-6)
    factor = np.minimum(factor, MOST_RECOLORING)
    hit = slice(None) if film.first is None else np.cumsum(film.first) - 1
    own_normals = samples.diffuse_normal[first].astype(np.float64)
    # Cycles' color counts normals behind their surface, which reflect nothing. Its normal is the mean of all lobes'.
    behind = (samples.diffuse_normal * samples.smooth_normal).sum(axis=1) <= 0.0
    bent = np.abs(samples.normal - own_normals[hit]).max(axis=1) > SAME_NORMAL
    bent &= has_lobe(samples)[1]
    hits, sums = film.hits(*samples.diffuse_albedo.T, *radiance.T, behind, bent)
    albedo, light = np.stack(sums[:3], axis=1), np.stack(sums[3:6], axis=1)
    is_behind, is_bent = (box_mean(hits.image(one), SLOPE_RADIUS)[..., None] > 1e-6 for one in sums[6:])
    # What the variance among the points does not explain of the difference between both means is that Cycles' normal is
    # another one, as that of what a mirror shows. What it explains for as many samples as Cycles has is Cycles' error.
    slope, variance = _slope(hits, own_normals, light / np.maximum(albedo, LEAST_COLOR))
    apart = normal - film.take(first).image(own_normals)
    off = np.maximum(box_mean(np.square(apart).sum(axis=-1), SLOPE_RADIUS), 1e-12)
    variance = np.maximum(box_mean(variance, SLOPE_RADIUS), 0.0)
    sure = np.minimum(variance / (film.sub_samples * off), 1.0) * np.maximum(1.0 - variance / (count * off), 0.0)
    change = color * np.einsum("hwk,hwkc->hwc", np.where(is_bent, 0.0, sure[..., None] * apart), slope)
    image = factor * film.image(radiance)
    factor *= (1.0 + np.divide(change, image, out=np.zeros_like(image), where=image > 0.0)).clip(*MOST_BEND)
    return np.where(is_behind, 1.0, factor)


def _slope(film: Film, normals: np.ndarray, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The slope (H, W, 3, 3) of the `values` (P, 3) over the `normals` (P, 3) of the points around each pixel, and the
    variance (H, W) of these within it."""

    def mean(values: np.ndarray) -> np.ndarray:
        """Means over the points around each pixel."""
        return np.divide(box_mean(film.image(values), SLOPE_RADIUS), weight, out=np.zeros(shape), where=weight > 0.0)

    shape = film.height, film.width
    weight = box_mean(film.image(np.ones(len(normals))), SLOPE_RADIUS)
    normal, value = (np.stack([mean(column) for column in array.T], axis=-1) for array in (normals, values))
    square, product = RIDGE * np.ones((*shape, 1, 1)) * np.eye(3), np.empty((*shape, 3, 3))
    for i, j in np.ndindex(3, 3):
        square[..., i, j] += mean(normals[:, i] * normals[:, j]) - normal[..., i] * normal[..., j]
        product[..., i, j] = mean(normals[:, i] * values[:, j]) - normal[..., i] * value[..., j]
    within = film.image(np.square(normals).sum(axis=1)) - np.square(film.image(normals)).sum(axis=-1)
    return np.linalg.solve(square, product), np.maximum(within, 0.0)


def box_mean(image: np.ndarray, radius: int) -> np.ndarray:
    """Means (H, W) over squares with sides of 2 `radius` + 1 pixels."""
    side = 2 * radius + 1
    sums = np.pad(image, ((radius + 1, radius), (radius + 1, radius)), mode="edge").cumsum(axis=0).cumsum(axis=1)
    return (sums[side:, side:] - sums[:-side, side:] - sums[side:, :-side] + sums[:-side, :-side]) / side**2
