"""Patches of distant lights with a detail: for many samples at once, the coarsest that their lobes cannot resolve.

Each sample gets all of the light that is above its horizons. A patch has the mean radiance of its parts. What the mean
loses is as `light_polygons.fitting_patches` says.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from ..scene import AreaLight
from .light_polygons import LEAST_COSINE, LOBE_WIDTH
from .polygon import dot

# In rad: mirrors meet patches without parts, too.
LEAST_WIDTH = 1e-7
# As of `light_polygons`. The sky is all around: what patches lose on one side of a lobe they gain on another. Measured
# on skies with and without fine detail: 0.15 and 0.3 % (relative L2) off the smallest ones, with 200 patches a lobe.
PATCH_PRODUCT, LARGEST_PATCH = 0.1, 0.6
# Normals along each side of a cube's face of which the diffuse reflection is known, directions that are added at a
# time, and how large a patch is, half its diagonal in rad, for which one of them stands.
GRID, GRID_POINTS, POINT_SIZE = 33, 512, 0.04
# Samples whose patches are chosen at a time.
CHUNK = 1024


@dataclass(frozen=True)
class PatchTree:
    """The N patches of a distant light, rectangles, in single precision; the first is all of it."""

    center: np.ndarray  # (3, N)
    half_u: np.ndarray  # (3, N)
    half_v: np.ndarray  # (3, N)
    radiance: np.ndarray  # (3, N) W m^-2 sr^-1
    direction: np.ndarray  # (3,) unit, toward the samples
    toward: np.ndarray  # (3, N) unit
    size: np.ndarray  # (N,) half the diagonal, by the distance of the center
    reach: np.ndarray  # (N,) rad, from the center
    largest: np.ndarray  # (N,) what the size may be, by the width of a lobe; infinite for patches without parts
    first: np.ndarray  # (N,) the first of the parts
    count: np.ndarray  # (N,) of the parts

    @classmethod
    def of(cls, light: AreaLight) -> PatchTree:
        """That of a distant rectangle, made once."""
        kept = vars(light)
        if "_patch_tree" not in kept:
            kept["_patch_tree"] = cls._made(light)
        return kept["_patch_tree"]

    @classmethod
    def _made(cls, light) -> PatchTree:
        patches, first = [light], []
        for patch in patches:  # which grows meanwhile
            first.append(len(patches))
            patches += patch.detail
        count = np.array([len(patch.detail) for patch in patches])
        center, half_u, half_v, radiance = (
            np.array([getattr(patch, name) for patch in patches]).T
            for name in ("center", "half_u", "half_v", "radiance")
        )
        diagonal = np.sqrt((half_u * half_u + half_v * half_v).sum(axis=0))
        distance = np.sqrt(dot(center, center))
        # Right-handed with the direction.
        half_u *= np.copysign(1.0, np.cross(half_u[:, 0], half_v[:, 0]) @ light.direction)
        first = np.array(first)
        return cls(
            *(values.astype(np.float32) for values in (center, half_u, half_v, radiance, light.direction)),
            (center / distance).astype(np.float32),
            (diagonal / distance).astype(np.float32),
            (diagonal / np.abs(light.direction @ center)).astype(np.float32),
            _largest_sizes(diagonal, radiance, first, count),
            first,
            count,
        )

    def area_vectors(self, patch) -> np.ndarray:
        """Areas (3, Q), by the square of the distance of the plane, toward the samples."""
        half_u, half_v = self.half_u[:, patch], self.half_v[:, patch]
        lengths = 4.0 * np.sqrt(dot(half_u, half_u) * dot(half_v, half_v))
        return self.direction[:, None] * lengths.astype(np.float32)

    def corners(self, patch) -> np.ndarray:
        """Corners (3, 4, Q), counterclockwise as seen from the samples."""
        center, half_u, half_v = (values[:, patch] for values in (self.center, self.half_u, self.half_v))
        ways = ((-1.0, -1.0), (1.0, -1.0), (1.0, 1.0), (-1.0, 1.0))
        return np.stack([center + np.float32(s) * half_u + np.float32(t) * half_v for s, t in ways], axis=1)

    def form_factors(self, normals: np.ndarray) -> np.ndarray:
        """Radiance (3, P) that a white diffuse surface with `normals` (P, 3) reflects of all of the light, within 0.1 %
        of the largest: interpolated between the normals of a grid on a cube."""
        size = len(self._reflected[0])
        axis = np.argmax(np.abs(normals), axis=1)
        rows = np.arange(len(normals))
        along = normals[rows, axis]
        face = 2 * axis + (along < 0.0)
        places = [
            np.clip((normals[rows, (axis + step) % 3] / np.abs(along) + 1.0) * 0.5 * (size - 1), 0.0, size - 1.0)
            for step in (1, 2)
        ]
        lows = [np.minimum(place.astype(np.intp), size - 2) for place in places]
        (s, t), (i, j) = [place - low for place, low in zip(places, lows, strict=True)], lows
        grid = self._reflected
        near = grid[face, i, j] * (1.0 - t)[:, None] + grid[face, i, j + 1] * t[:, None]
        far = grid[face, i + 1, j] * (1.0 - t)[:, None] + grid[face, i + 1, j + 1] * t[:, None]
        return (near * (1.0 - s)[:, None] + far * s[:, None]).T

    @cached_property
    def _reflected(self) -> np.ndarray:
        """Radiance (6, GRID, GRID, 3) that white diffuse surfaces reflect, by the normal: of faces +x, -x, +y ...,
        along the two axes that follow."""
        place = np.linspace(-1.0, 1.0, GRID)
        normals = np.ones((3, 2, GRID, GRID, 3))
        for axis in range(3):
            normals[axis, 1, ..., axis] = -1.0
            normals[axis, ..., (axis + 1) % 3] = place[:, None]
            normals[axis, ..., (axis + 2) % 3] = place
        normals = (normals / np.linalg.norm(normals, axis=-1, keepdims=True)).reshape(-1, 3).astype(np.float32)
        result = np.zeros((len(normals), 3))
        for toward, light in self._points():
            for start in range(0, toward.shape[1], GRID_POINTS):
                part = slice(start, start + GRID_POINTS)
                result += np.maximum(normals @ toward[:, part], np.float32(0.0)) @ light[:, part].T
        return result.reshape(6, GRID, GRID, 3)

    def _points(self):
        """Yield unit directions (3, Q) and radiance times solid angle by pi (3, Q) that stand for the leaves."""
        leaves = np.flatnonzero(self.count == 0)
        steps = np.ceil(self.size[leaves] / POINT_SIZE).astype(int)
        for count in np.unique(steps):
            patch = leaves[steps == count]
            place = (np.arange(count) + 0.5) * (2.0 / count) - 1.0
            s, t = (values.ravel() for values in np.meshgrid(place, place))
            center, half_u, half_v = (values[:, patch, None] for values in (self.center, self.half_u, self.half_v))
            points = center + half_u * s + half_v * t
            squares = dot(points, points)
            flux = -(points * self.area_vectors(patch)[..., None]).sum(axis=0) / count**2
            light = self.radiance[:, patch, None] * (flux / (np.pi * squares * np.sqrt(squares)))
            yield (
                (points / np.sqrt(squares)).reshape(3, -1).astype(np.float32),
                light.reshape(3, -1).astype(np.float32),
            )

    def pairs(self, samples, horizons, index: np.ndarray, is_specular: bool) -> Iterator[tuple[np.ndarray, np.ndarray]]:
        """Yield (columns (Q,) of `index`, patches (Q,)) of the samples `index` (M,), whose lobes end at the `horizons`,
        normals (P, 3)."""
        for start in range(0, len(index), CHUNK):
            part = index[start : start + CHUNK]
            normals = [np.ascontiguousarray(normal[part].T, np.float32) for normal in horizons]
            peak = _Peaks(samples, part) if is_specular else None
            column, patch = np.arange(len(part)), np.zeros(len(part), np.intp)
            while len(column):
                above = np.ones(len(column), bool)
                toward = self.toward[:, patch]
                for normal in normals:
                    above &= dot(np.take(normal, column, axis=1), toward) > -self.reach[patch]
                column, patch, toward = column[above], patch[above], toward[:, above]
                size = self.size[patch]
                fits = size < self.largest[patch] * (1.0 if peak is None else peak.lengths(column, toward, size))
                if fits.any():
                    yield start + column[fits], patch[fits]
                column, patch = column[~fits], patch[~fits]
                count = self.count[patch]
                ends = np.cumsum(count)
                number = np.arange(ends[-1] if len(ends) else 0) - np.repeat(ends - count, count)
                column, patch = np.repeat(column, count), np.repeat(self.first[patch], count) + number


class _Peaks:
    """Where the specular lobes of Q samples are narrowest."""

    def __init__(self, samples, index):
        normal, view = (np.ascontiguousarray(values[index].T, np.float32) for values in (samples.normal, samples.view))
        cosine = dot(normal, view)
        self.mirrored = np.float32(2.0) * cosine * normal - view
        width = np.square(samples.roughness[index].astype(np.float32)) * np.maximum(np.abs(cosine), LEAST_COSINE)
        self.width = np.maximum(LOBE_WIDTH * width, LEAST_WIDTH).astype(np.float32)

    def lengths(self, column, toward, size) -> np.ndarray:
        """The least angle (R,) in rad, at most 1, over which lobes change where they meet patches."""
        chord = np.sqrt(np.maximum(np.float32(2.0) - np.float32(2.0) * dot(self.mirrored[:, column], toward), 0.0))
        return np.minimum(np.maximum(chord - size, np.float32(0.0)) + self.width[column], np.float32(1.0))


def _largest_sizes(diagonal, radiance, first, count) -> np.ndarray:
    """What sizes may be (N,): by the contrast, which is how much the parts of a patch differ from it, by the whole."""
    area, brightness = diagonal * diagonal, np.abs(radiance[:, 0]).sum()
    owner = np.repeat(np.arange(len(count)), count)
    part = np.arange(1, len(count))
    different = area[part] * np.abs(radiance[:, part] - radiance[:, owner]).sum(axis=0)
    contrast = np.bincount(owner, different, len(count)) / np.maximum(area * brightness, 1e-30)
    largest = np.minimum(np.sqrt(PATCH_PRODUCT / np.maximum(contrast, 1e-9)), LARGEST_PATCH)
    return np.where(count == 0, np.inf, largest).astype(np.float32)
