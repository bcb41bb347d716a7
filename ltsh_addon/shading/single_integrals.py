"""Integrals over polygons in single precision, one polygon for each sample: form factors, lobes, cones of light.

Each class is prepared for a chunk of samples and called with polygons (C, W, Q) and the samples `index` (Q,) of the
chunk, None for all, that they belong to. It returns the integrals (F, Q) and a mask (Q,) of those for which single
precision does not suffice.
"""

from __future__ import annotations

from functools import partial

import numpy as np

from . import edge_loop, light_cone
from .polygon import dot

# Samples and corners per chunk. Large, for a call of numpy costs as much as some thousand elements; rows are not a
# multiple of a page long, where the cache would hold few of them.
CHUNK = 24592
CORNERS = 4 * CHUNK


def _selected(values, part, index):
    """Columns `index` (None: all) of the columns `part`, a slice, of values (..., Q)."""
    values = values[..., part]
    return values if index is None else np.take(values, index, axis=-1)


class Focused:
    """Integrals (F, Q) over polygons times the factor of the light's spread, by integrals over parts of the light.

    The polygons have two more coordinates than the frames `axes` (C, 3, P), along `rows`: those in the light's plane.
    """

    def __init__(self, light, effort, offset, axes, integrate, count):
        self.light, self.effort, self.integrate, self.count = light, effort, integrate, count
        self.view = light_cone.LightView.of(light, offset, partial(_along_rows, axes))
        plane = light_cone.plane_axes(light).astype(np.float32)[:, :, None]
        self.rows = np.concatenate([axes, np.broadcast_to(plane, (2, 3, axes.shape[2]))])

    def __call__(self, corners, index):
        index = np.arange(corners.shape[2]) if index is None else index
        values, fragile = np.zeros((self.count, len(index)), np.float32), np.zeros(len(index), bool)
        step = max(CORNERS // (corners.shape[1] * (2 * self.effort.chords + 1)), 512)
        for start in range(0, len(index), step):
            part = slice(start, start + step)
            flat, view = corners[-2:, :, part], self.view.take(index[part])
            layers = light_cone.layers(view, flat, self.light.spread, self.effort)
            for number, (near, weights, polygons) in enumerate(layers):
                # The small disks count little, so that the rounding of their edges is lost in the sum.
                smallest = 0.0 if number < self.effort.layers - 1 else edge_loop.SMALLEST_SAFE
                found, redo = self.integrate(polygons, index[part][near], smallest=smallest)
                values[:, start + near] += weights * found
                fragile[start + near] |= redo
        return values, fragile


def _along_rows(axes, vector):
    """Products (C, P) of rows (C, 3, P) with a vector (3,)."""
    x, y, z = vector.astype(np.float32)
    return x * axes[:, 0] + y * axes[:, 1] + z * axes[:, 2]


class Cosine:
    """Form factors (1, Q) of polygons whose corners run clockwise as seen from the point (`AreaLight.polygon`)."""

    def __init__(self, scratch):
        self.scratch = scratch

    def __call__(self, part, corners, index, smallest=edge_loop.SMALLEST_SAFE):
        integral, fragile = edge_loop.cosine_integral(corners, self.scratch, smallest)
        integral *= np.float32(-1.0 / np.pi)
        return np.maximum(integral, np.float32(0.0))[None], fragile


class ShadowedCosine:
    """Form factors (1, Q) times the bump shadowing of `SurfaceSamples`, taken at the mean direction of the polygon."""

    def __init__(self, rows, bump_alpha2, scratch):
        self.smooth = np.stack([dot(row, rows[3]) for row in rows[:3]])
        self.bump_alpha2, self.scratch = bump_alpha2, scratch

    def __call__(self, part, corners, index, smallest=edge_loop.SMALLEST_SAFE):
        smooth, bump_alpha2 = (_selected(values, part, index) for values in (self.smooth, self.bump_alpha2))
        integrals, fragile = edge_loop.vector_irradiance(corners, self.scratch, smallest)
        direction = np.negative(integrals, out=integrals)
        along = np.maximum(dot(direction, smooth), np.float32(1e-15))
        tangent2 = np.maximum(dot(direction, direction) / (along * along) - np.float32(1.0), np.float32(0.0))
        shadowing = np.float32(2.0) / (np.float32(1.0) + np.sqrt(np.float32(1.0) + bump_alpha2 * tangent2))
        values = np.maximum(direction[2], np.float32(0.0)) * shadowing * np.float32(1.0 / np.pi)
        return values[None], fragile


class LobeIntegral:
    """Integrals (F, Q) of lobes with F weight vectors over polygons, never negative; winding as in `Cosine`."""

    def __init__(self, ridges, weights, scratch):
        self.ridges, self.weights, self.scratch = ridges, weights, scratch

    def __call__(self, part, corners, index, smallest=edge_loop.SMALLEST_SAFE):
        weights = _selected(self.weights, part, index)
        if self.ridges.source.family == "ltc":
            integral, fragile = edge_loop.cosine_integral(corners, self.scratch, smallest)
            values = weights[:, 0] * integral
            values *= np.float32(-1.0 / np.pi)
        else:
            degree = self.ridges.degree
            values, _, fragile = edge_loop.weighted_moments(corners, weights, degree, self.scratch, smallest)
            np.negative(values, out=values)
        return np.maximum(values, np.float32(0.0), out=values), fragile
