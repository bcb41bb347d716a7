"""Smoother shares: each penumbra pair takes a mean over the pairs of nearby samples that see the light alike.

Visibility is smooth in position, not in the bumped normal. Neighbors count by their distance in the picture, by how
far they are from the sample's plane and how their geometric normals differ, for the specular share also by shading
normal and roughness; and only as far as their shares differ by no more than the noise of both.

Measured on five scenes of 256 x 192 samples (a bar in a highlight, a grille, spheres on a floor, 60 boxes, 40 wires)
with at most 128 rays: errors fall by 10 to 45 %, but one of the ten rises (specular, boxes, from .78 to .86 %) and
diffuse shares get a bias of up to .7 %; it takes as long as 30 % more rays. With 32 rays all ten errors fall. So it
is not the default.
"""

from __future__ import annotations

from functools import cached_property

import numpy as np

from ..scene import Film, SurfaceSamples

# In pixels
RADIUS, WIDTH = 2, 1.5
# Powers of the cosine between geometric normals, and of the distance from the plane by that along it.
NORMAL_POWER, PLANE_SHARE = 32, 0.25
# Differences of shares beyond the noise count by this many standard deviations.
RANGE = 1.0
# Stratified rays: the variance of a share falls with this power of their number.
VARIANCE_POWER = 1.5
# The least of share (1 - share).
_LEAST_VARIANCE = np.float32(0.02)
_TINY = np.float32(1e-30)
_SHIFTS = [(y, x) for y in range(-RADIUS, RADIUS + 1) for x in range(-RADIUS, RADIUS + 1) if (y, x) != (0, 0)]


class ShareFilter:
    """Filters shares of the P samples of a film."""

    def __init__(self, samples: SurfaceSamples, film: Film):
        self._samples, self._film = samples, film

    @cached_property
    def _neighbors(self) -> list[np.ndarray]:
        """For each of _SHIFTS the sample there (P,); the sample itself where there is none."""
        film, count = self._film, len(self._samples)
        top = int(film.pixel.min(initial=0))
        row, column = film.pixel // film.width, film.pixel % film.width
        row = row - top // film.width
        layer = _rank(film.pixel)
        height, width = int(row.max(initial=0)) + 1 + 2 * RADIUS, film.width + 2 * RADIUS
        place = (layer * height + row + RADIUS) * width + column + RADIUS
        grid = np.full((int(layer.max(initial=0)) + 1) * height * width, -1, np.int32)
        grid[place] = np.arange(count, dtype=np.int32)
        found = [grid[place + y * width + x] for y, x in _SHIFTS]
        return [np.where(there < 0, np.arange(count, dtype=np.int32), there) for there in found]

    @cached_property
    def _nearness(self) -> dict[str, list[np.ndarray]]:
        """By pass, for each of _SHIFTS the weight (P,) of the neighbor by its place and surface."""
        samples = self._samples
        position, normal = (np.asarray(v, np.float32) for v in (samples.position, samples.geometric_normal))
        shading, alpha = samples.normal.astype(np.float32), np.square(samples.roughness.astype(np.float32))
        width = 0.5 * alpha + np.float32(0.02)
        found = {"specular": [], "diffuse": []}
        own = np.arange(len(samples), dtype=np.int32)
        for (y, x), there in zip(_SHIFTS, self._neighbors, strict=True):
            offset = position[there] - position
            height = np.square((offset * normal).sum(axis=1))
            length = np.square(offset).sum(axis=1)
            weight = np.exp(-height / np.maximum(PLANE_SHARE**2 * length, _TINY))
            weight *= np.maximum((normal[there] * normal).sum(axis=1), 0.0) ** NORMAL_POWER
            weight *= np.float32(np.exp(-(x * x + y * y) / (2.0 * WIDTH**2))) * (there != own)
            found["diffuse"].append(weight.astype(np.float32))
            bend = np.square(shading[there] - shading).sum(axis=1) / np.square(width)
            bend += np.square((alpha[there] - alpha) / width)
            found["specular"].append((weight * np.exp(-0.5 * bend)).astype(np.float32))
        return found

    def filtered(self, name: str, index, shares, rays, chosen, noise):
        """Shares (Q,) of the pass `name` after the filter, and by what their noise is multiplied (Q,).

        shares, rays: (Q,) of the samples `index` (Q,), which the light may reach; those `chosen` (Q,) change. `noise`
        (Q,) are estimates of the standard deviations, of which the mean square counts.
        """
        if not chosen.any():
            return shares, np.ones_like(shares)
        count, targets = len(self._samples), index[chosen]
        everywhere, number = np.ones(count, np.float32), np.zeros(count, np.float32)
        everywhere[index], number[index] = shares, rays
        own, rays = shares[chosen], rays[chosen].astype(np.float32)
        mean = self._mean(name, targets, everywhere, number)
        spread = np.maximum(mean * (1.0 - mean), _LEAST_VARIANCE)
        # What the stratification leaves of the variance of independent rays
        power = spread / rays**VARIANCE_POWER
        factor = np.float32(np.square(noise[chosen]).mean() / power.mean())
        own_variance = factor * power
        total, weights, squares = own.copy(), np.ones_like(own), own_variance.copy()
        for there, near in zip(self._neighbors, self._nearness[name], strict=True):
            other = there[targets]
            others = number[other]
            variance = factor * spread / np.maximum(others, 1.0) ** VARIANCE_POWER
            excess = np.square(everywhere[other] - own) - own_variance - np.minimum(variance, own_variance)
            weight = np.exp(-np.maximum(excess, 0.0) / (RANGE**2 * (own_variance + variance)))
            weight *= near[targets] * (others > 0.0) * (1.3 / (variance / own_variance + 0.3))
            total += weight * everywhere[other]
            weights += weight
            squares += weight * weight * variance
        result, factors = shares.copy(), np.ones_like(shares)
        result[chosen] = np.clip(total / weights, 0.0, 1.0)
        factors[chosen] = np.sqrt(squares / own_variance) / weights
        return result, factors

    def _mean(self, name, targets, everywhere, number):
        """Means (T,) over the nearest neighbors, by their number of rays."""
        total, weights = everywhere[targets] * number[targets], number[targets].copy()
        for (y, x), there, near in zip(_SHIFTS, self._neighbors, self._nearness[name], strict=True):
            if max(abs(x), abs(y)) == 1:
                other = there[targets]
                weight = near[targets] * number[other]
                total += weight * everywhere[other]
                weights += weight
        return total / np.maximum(weights, _TINY)


def _rank(values: np.ndarray) -> np.ndarray:
    """How many of the elements (P,) before each are equal to it."""
    order = np.argsort(values, kind="stable")
    sorted_values = values[order]
    starts = np.flatnonzero(np.concatenate([[True], sorted_values[1:] != sorted_values[:-1]]))
    rank = np.empty(len(values), np.int64)
    rank[order] = np.arange(len(values)) - np.repeat(starts, np.diff(np.append(starts, len(values))))
    return rank
