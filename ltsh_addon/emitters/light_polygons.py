"""Area lights as samples see them: corners, parts above the horizon, and patches as fine as a lobe needs.

This file starts with what both precisions share. The corners and parts of lights in single and in double precision
follow. Last come the patches of lights with children, textures near and far. Each sample gets the coarsest patches that
its lobe cannot resolve; together they are all of the light above its horizons. A patch has the mean radiance of its
children. The error of the mean is second order in the size of the patch, in units of the length over which the rest of
the integrand changes. For diffuse lobes that length is the distance. For specular lobes it is the width of the lobe, or
the angle from its peak if that is larger.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from ..lobes.polygon import convex_pieces, dot, split_at_horizon
from ..scene import Light, PolygonLight, SurfaceSamples, round_outline
from . import facing, light_profile
from .facing import FacingDisk

# Corners of the polygon for a round light up to each of ROUND_LIMITS and beyond. These limit the radius of the light in
# units of the lobe's width where it meets the light. The polygon is within 0.1 % of the ellipse.
ROUND_CORNERS = (32, 64, 128, 256)
ROUND_LIMITS = (8.0, 40.0, 300.0)
# Corners for a round light with a spread: for efforts with few chords and with many.
FOCUSED_ROUND_CORNERS = (32, 64)
# ROUNDING: how far rounding moves points off their plane, in units of their coordinates. A flat surface that shines
# must not light itself because of this.
ROUNDING = 4e-7
# Greatest product of a patch's contrast (see `_largest_sizes`) and the square of its size in units of that length.
# Measured on random surfaces at a light's size from it, with the contrasts of a photograph: the patches of a sample
# agree with the smallest ones to 0.2 % (relative L2). With 0.006, a sample takes 150 patches of 1024 on average.
PATCH_PRODUCT = 0.004
# Greatest half diagonal of a patch in units of that length, which also holds if its children are equally bright.
LARGEST_PATCH = 0.5
# The same two limits for the sky, which is all around: what patches lose on one side of a lobe they gain on the other.
# Measured on skies with and without fine detail: 0.15 % and 0.3 % (relative L2) from the smallest patches, with 200
# patches a lobe.
SKY_PRODUCT, LARGEST_OF_SKY = 0.1, 0.6
# Least width of a lobe in rad, so that mirrors take the smallest patches.
LEAST_WIDTH = 1e-7
# The diffuse reflection of a sky is tabulated by normals on a cube. GRID: normals along each side of a face.
# GRID_POINTS: directions added at a time, few enough for the cache. POINT_SIZE: largest half diagonal in rad of what
# counts as a single direction.
GRID, GRID_POINTS, POINT_SIZE = 33, 256, 0.04
# Samples whose patches are chosen at a time.
PATCH_CHUNK = 1024
# Width of GGX lobes in rad, in units of alpha: where the normal distribution has a quarter of its peak.
LOBE_WIDTH = 2.0
# Lobes get narrower across the view toward grazing angles, but not below this cosine.
LEAST_COSINE = 0.1


def light_levels(light, corners, position, width):
    """Yield (corners (V, 3), `DiskLayers` or None, chosen (Q',) of the points, None for all), as their lobes need.

    The lobes are `width` (Q,) or a number of radians wide, at points with x, y, z in `position` (3, Q). All arrays are
    in double precision, so that both paths make the same decisions.
    """
    if light.has_profile:
        for disks, chosen in light_profile.disk_layers(light, position, width):
            if light.is_round:
                corners = light.polygon(FOCUSED_ROUND_CORNERS[disks.chords > 2])
                disks = replace(disks, chords=2)
            for piece in convex_pieces(corners) if isinstance(light, PolygonLight) else [corners]:
                yield piece, disks, chosen
    elif light.is_round:
        for outline, chosen in round_levels(light, position, width):
            yield outline, None, chosen
    else:
        yield corners, None, None


def round_levels(light, position, width):
    """Yield (corners (V, 3), chosen (Q',) of the points, None for all) for a round light. Points have x, y, z in
    `position` (3, Q); their lobes are `width` (Q,) or a number of radians wide. All arrays are in double precision."""
    position = light.viewpoint(position)
    offset = [position[axis] - light.center[axis] for axis in range(3)]
    reach = np.sqrt(max((light.half_u**2).sum(), (light.half_v**2).sum()))
    beyond = np.sqrt(sum(component * component for component in offset)) - reach
    height = beyond
    if not light.is_facing:
        height = np.abs(sum(offset[axis] * light.direction[axis] for axis in range(3)))
    distance = np.maximum(np.maximum(height, beyond), 1e-12 * reach)
    level = np.searchsorted(ROUND_LIMITS, reach / (distance * width))
    for number in np.unique(level):
        corners = light.polygon(ROUND_CORNERS[number])
        chosen = np.nonzero(level == number)[0]
        yield corners, None if len(chosen) == len(level) else chosen


def local_corners(light, corners: np.ndarray, offset: np.ndarray, rows: np.ndarray, scratch) -> np.ndarray:
    """Corners (C, V, P) float32 of a light: coordinates along `rows` (C, 3, P).

    `corners` are (V, 3) in the world, or (V, 3, P) relative to the center. `offset` (3, P) goes from the points to the
    light's center, which may lie anywhere near a "POLYGON". For a FacingDisk, `corners` gives only their number, and
    `offset` is that of the disk.
    """
    coordinates, _, points = rows.shape
    center = _along(rows, offset, scratch("center", (coordinates, points)), scratch)
    result = scratch("corners", (coordinates, len(corners), points))
    if isinstance(light, FacingDisk):
        out, product = (scratch(name, (coordinates, points)) for name in ("axis", "product"))
        u, v = (_along(rows, half, np.empty_like(out), scratch) for half in (light.half_u, light.half_v))
        for number, (s, t) in enumerate(round_outline(len(corners)).T.astype(np.float32)):
            np.multiply(u, s, out=out)
            out += np.multiply(v, t, out=product)
            np.add(center, out, out=result[:, number])
        return result
    if corners.ndim == 3 or light.is_round or isinstance(light, PolygonLight):
        corners = corners if corners.ndim == 3 else (corners - light.center).astype(np.float32)
        for number, corner in enumerate(corners):
            out = _along(rows, corner, scratch("axis", (coordinates, points)), scratch)
            np.add(center, out, out=result[:, number])
        return result
    # Corners 0 and 2 are opposite, and so are 1 and 3: two half diagonals give all four.
    for number in (0, 1):
        half = ((corners[number] - corners[number + 2]) * 0.5).astype(np.float32)
        out = _along(rows, half, scratch("axis", (coordinates, points)), scratch)
        np.add(center, out, out=result[:, number])
        np.subtract(center, out, out=result[:, number + 2])
    return result


def _along(rows, vector, out, scratch):
    """Dot products (C, P) of rows (C, 3, P) with a vector (3,) or vectors (3, P)."""
    product = scratch("product", out.shape)
    np.multiply(rows[:, 0], vector[0], out=out)
    for axis in (1, 2):
        out += np.multiply(rows[:, axis], vector[axis], out=product)
    return out


def local_frames(normal, view):
    """Local frames (3, 3, P): rows tangent, bitangent, normal; the view has y = 0 and x >= 0."""
    # Differences of close vectors are exact. A single-precision normal is not quite a unit vector.
    across = view - normal
    squared = (normal * normal).sum(axis=1, keepdims=True)
    tangent = across - (across * normal).sum(axis=1, keepdims=True) / squared * normal
    length = np.sqrt((tangent * tangent).sum(axis=1, keepdims=True))
    # If view and normal coincide, any tangent serves: take the axis that is farthest from the normal.
    axis = np.eye(3)[np.argmin(np.abs(normal), axis=1)]
    other = axis - (axis * normal).sum(axis=1, keepdims=True) / squared * normal
    tangent = np.where(length > 1e-7, tangent, other)
    tangent = tangent / np.sqrt((tangent * tangent).sum(axis=1, keepdims=True))
    bitangent = np.cross(normal, tangent)
    return np.stack([tangent.T, bitangent.T, normal.T])


def in_front(samples, light, candidates):
    """The points of `candidates` on the side to which the light shines, in its cone, and among its receivers."""
    center, direction = (
        vector if vector.ndim == 1 else vector[candidates] for vector in (light.center, light.direction)
    )
    position = samples.position[candidates]
    ahead = np.ones(len(candidates), bool)
    if not light.is_facing:
        origins = light.viewpoint(position)
        ahead = ((origins - center) * direction).sum(axis=1) > off_plane(center.T, np.abs(origins).sum(axis=1))
    if light.is_facing or light.has_spread:
        ahead &= may_reach(light, position.T)
    allowed = light.receives(samples.receiver, candidates)
    return candidates[ahead if allowed is None else ahead & allowed]


def off_plane(center, extent) -> np.ndarray:
    """Distance (Q,) in m in front of a light from which on points surely see it. The light's center is (3,) or (3, Q);
    `extent` (Q,) is the sum of the absolute coordinates of the points."""
    return ROUNDING * (np.abs(center).sum(axis=0) + extent)


def may_reach(light, position) -> np.ndarray:
    """Mask (Q,): False for points (3, Q) that no part of a light with a spread or a cone shines on."""
    if light.is_facing:
        return facing.may_reach(light, light.center[:, None] - position)
    return light_profile.may_reach(light, position)


# FEW_SAMPLES: about how many samples are tried first. MOST_PAIRS: how many pairs of a sample and a light are tried.
FEW_SAMPLES, MOST_PAIRS = 1024, 2 * 10**7
CHUNK = 16384


def has_lobe(samples: SurfaceSamples) -> np.ndarray:
    """Mask (2, P) of the samples that have a diffuse and a specular lobe."""
    terms = (samples.specular_f0, samples.specular_f90, samples.specular_dip, samples.dielectric)
    return np.stack([samples.diffuse_albedo.any(axis=1), np.logical_or.reduce([term.any(axis=1) for term in terms])])


def lights_that_reach_nothing(samples: SurfaceSamples, lights: tuple[Light, ...]) -> list[str]:
    """Names of the `lights` of which no part is in front of a sample and above the horizons of one of its lobes.

    Lights of one name are one light. After MOST_PAIRS pairs, all other lights count as seen.
    """
    reached = set()
    for subset in (samples.take(slice(None, None, max(1, len(samples) // FEW_SAMPLES))), samples):
        lobes, pairs = has_lobe(subset), 0
        ends = np.stack([subset.position.min(axis=0, initial=np.inf), subset.position.max(axis=0, initial=-np.inf)])
        for light in lights:
            if light.name in reached:
                continue
            # How far the box around the samples extends in front of the light.
            ahead = ((light.viewpoint(ends) - light.center) * light.direction).max(axis=0).sum()
            if light.is_facing or ahead > 0.0:
                pairs += len(subset)
                if pairs > MOST_PAIRS or _reaches(light, subset, lobes):
                    reached.add(light.name)
    return [name for name in dict.fromkeys(light.name for light in lights) if name not in reached]


def _reaches(light: Light, samples: SurfaceSamples, lobes: np.ndarray) -> bool:
    """True if a corner of the light is above both horizons of one of the `lobes` (2, P)."""
    diffuse = lobes[0] & light.affects_diffuse, (samples.diffuse_normal, samples.smooth_normal)
    specular = lobes[1] & light.affects_specular, (samples.normal, samples.geometric_normal)
    corners = light.polygon()[:, None]
    for lobe, horizons in (diffuse, specular):
        candidates = np.flatnonzero(lobe)
        for start in range(0, len(candidates), CHUNK):
            index = in_front(samples, light, candidates[start : start + CHUNK])
            offset = corners - light.viewpoint(samples.position[index])
            heights = [(offset * normal[index]).sum(axis=-1).max(axis=0) for normal in horizons]
            if light.is_facing:
                offset = light.center - samples.position[index]
                heights = [(offset * normal[index]).sum(axis=-1) + light.radius for normal in horizons]
            if (np.minimum(*heights) > 0.0).any():
                return True
    return False


@dataclass(frozen=True)
class LocalFrames:
    """Samples (P) and their local frames (3, 3, P): rows tangent, bitangent, normal."""

    samples: SurfaceSamples
    frame: np.ndarray

    @classmethod
    def of(cls, samples: SurfaceSamples, normal: np.ndarray) -> "LocalFrames":
        """Frames around the normals (P, 3) of one of the lobes."""
        return cls(samples, local_frames(normal, samples.view))


def to_local(axes, vectors):
    """World vectors (3, ..., P) in the local frames `axes` (3, 3, P)."""
    return np.stack([sum(row[k] * vectors[k] for k in range(3)) for row in axes])


def visible_polygons(framed: LocalFrames, light, corners, candidates, second_normal=None):
    """Yield (index, polygons (3, W, Q) in local frames) for the points of `candidates` that the light shines on.

    Polygons are clipped at the horizon of `second_normal` (P, 3), if there is one, and at the shading horizon. Those of
    a profiled light have two more coordinates, in the light's plane relative to the foot of the point.
    """
    samples, frame = framed.samples, framed.frame
    index = in_front(samples, light, candidates)
    if len(index) == 0:
        return
    if light.is_facing:
        disk = FacingDisk.of(light, (light.center - samples.position[index]).T, frame[2][:, index])
        offset = disk.corners(round_outline(len(corners)))
    else:
        corners = corners[:, None, :] if corners.ndim == 2 else corners[:, index]
        offset = (corners - light.viewpoint(samples.position[index])).transpose(2, 0, 1)
    local = to_local(frame[:, :, index], offset)
    if light.has_profile:
        local = np.concatenate([local, to_local(light_profile.plane_axes(light), offset)])
    clipped_parts = [(slice(None), local)]
    if second_normal is not None:
        height = (offset * second_normal[index].T[:, None, :]).sum(axis=0)
        if not (height > 0.0).all():
            with_height = np.concatenate([local, height[None]])
            clipped_parts = (
                (chosen, clipped[:-1]) for chosen, clipped in split_at_horizon(with_height, axis=len(local))
            )
    for outer, polygon in clipped_parts:
        for inner, clipped in split_at_horizon(polygon):
            yield index[outer][inner], clipped


def visible_polygons_by_level(framed: LocalFrames, light, corners, candidates, width, second_normal=None):
    """As `visible_polygons`, but (index, polygons, disks): at the level that lobes of `width` (Q,) or a number need."""
    position = framed.samples.position[candidates].T
    for outline, disks, chosen in light_levels(light, corners, position, width):
        of_level = candidates if chosen is None else candidates[chosen]
        for index, polygon in visible_polygons(framed, light, outline, of_level, second_normal):
            yield index, polygon, disks


def light_view(framed: LocalFrames, light, index, to_lobe) -> light_profile.LightView:
    """The view of a profiled light from the points `index`. The first three coordinates are those of the lobe, from
    to_lobe(local vectors (3, Q)); the others are local."""
    axes = framed.frame[:, :, index]
    offset = (light.center - light.viewpoint(framed.samples.position[index])).T

    def along(vector):
        local = to_local(axes, np.broadcast_to(vector[:, None], offset.shape))
        return np.concatenate([to_lobe(local), local])

    return light_profile.LightView.of(light, offset, along)


@dataclass(frozen=True)
class PatchTree:
    """The N patches of a light with children; the first is the whole light. Those of distant lights are rectangles in
    single precision."""

    lights: tuple[Light, ...]  # (N,)
    center: np.ndarray  # (3, N)
    half_u: np.ndarray  # (3, N)
    half_v: np.ndarray  # (3, N)
    radiance: np.ndarray  # (3, N) W m^-2 sr^-1
    direction: np.ndarray  # (3,) unit, toward the samples
    half: np.ndarray  # (N,) half the diagonal
    reach: np.ndarray  # (N,) rad, about the angle from the center to the corners; distant lights only
    largest: np.ndarray  # (N,) largest size in units of the lobe's length; infinite for patches without children
    first: np.ndarray  # (N,) number of the first child
    count: np.ndarray  # (N,) number of children

    @classmethod
    def of(cls, light: Light) -> "PatchTree":
        """The patches of a light with children, built once."""
        return cached_on_children("_patch_tree", [light], cls._made)

    @classmethod
    def _made(cls, lights) -> "PatchTree":
        (light,), first = lights, []
        patches = [light]
        for patch in patches:  # the list grows meanwhile
            first.append(len(patches))
            patches += patch.children
        count, first = np.array([len(patch.children) for patch in patches]), np.array(first)
        center, half_u, half_v, radiance = (
            np.array([getattr(patch, name) for patch in patches]).T
            for name in ("center", "half_u", "half_v", "radiance")
        )
        diagonal = np.sqrt((half_u * half_u + half_v * half_v).sum(axis=0))
        area = np.linalg.norm([patch.area_vector for patch in patches], axis=1)
        largest = _largest_sizes(area, radiance, first, count, light.is_distant)
        reach = np.zeros(len(patches), np.float32)
        if light.is_distant:
            # Make the axes right-handed with the direction.
            half_u *= np.copysign(1.0, np.cross(half_u[:, 0], half_v[:, 0]) @ light.direction)
            reach = (diagonal / np.abs(light.direction @ center)).astype(np.float32)
            center, half_u, half_v, radiance = (v.astype(np.float32) for v in (center, half_u, half_v, radiance))
        direction = light.direction.astype(center.dtype)
        return cls(tuple(patches), center, half_u, half_v, radiance, direction, diagonal, reach, largest, first, count)

    def places(self, toward):
        """Where directions (3, ...) meet the plane: s and t (...) along the half axes of the whole light, and the mask
        (...) of those inside it."""
        whole = (self.center[:, 0], self.half_u[:, 0], self.half_v[:, 0], -self.direction)
        center, half_u, half_v, away = (vector.astype(np.float64) for vector in whole)
        ahead = np.tensordot(away, toward, 1)
        far = (away @ center) / np.where(ahead > 0.0, ahead, 1.0)
        s, t = ((np.tensordot(half, toward, 1) * far - half @ center) / (half @ half) for half in (half_u, half_v))
        return s, t, (ahead > 0.0) & (np.maximum(np.abs(s), np.abs(t)) < 1.0)

    def area_vectors(self, patch) -> np.ndarray:
        """Area vectors (3, Q) of patches, toward the samples; the unit is the square of the plane's distance."""
        half_u, half_v = self.half_u[:, patch], self.half_v[:, patch]
        lengths = 4.0 * np.sqrt(dot(half_u, half_u) * dot(half_v, half_v))
        return self.direction[:, None] * lengths.astype(np.float32)

    def corners(self, patch) -> np.ndarray:
        """Corners (3, 4, Q) of patches, counterclockwise as seen from the samples."""
        center, half_u, half_v = (values[:, patch] for values in (self.center, self.half_u, self.half_v))
        ways = ((-1.0, -1.0), (1.0, -1.0), (1.0, 1.0), (-1.0, 1.0))
        return np.stack([center + np.float32(s) * half_u + np.float32(t) * half_v for s, t in ways], axis=1)

    def form_factors(self, normals: np.ndarray) -> np.ndarray:
        """Radiance (3, P) that a white diffuse surface with `normals` (P, 3) reflects of the whole light, accurate to
        0.1 % of the largest."""
        return interpolated(self.reflected, normals)

    @cached_property
    def reflected(self) -> np.ndarray:
        """Radiance (6, GRID, GRID, 3) that white diffuse surfaces reflect, by normals as in `interpolated`."""
        coordinate = np.linspace(-1.0, 1.0, GRID)
        normals = np.ones((3, 2, GRID, GRID, 3))
        for axis in range(3):
            normals[axis, 1, ..., axis] = -1.0
            normals[axis, ..., (axis + 1) % 3] = coordinate[:, None]
            normals[axis, ..., (axis + 2) % 3] = coordinate
        normals = (normals / np.linalg.norm(normals, axis=-1, keepdims=True)).reshape(6, -1, 3).astype(np.float32)
        result = np.zeros(normals.shape)
        for toward, light in self._points():
            for start in range(0, toward.shape[1], GRID_POINTS):
                directions, weights = (rows[:, start : start + GRID_POINTS] for rows in (toward, light))
                weights = np.ascontiguousarray(weights.T)
                for side, of_side in zip(result, normals, strict=True):
                    cosine = of_side @ directions
                    side += np.maximum(cosine, np.float32(0.0), out=cosine) @ weights
        return result.reshape(6, GRID, GRID, 3)

    def _points(self):
        """Yield (unit directions (3, Q), radiance times solid angle over pi (3, Q)), which stand for the leaves."""
        leaves = np.flatnonzero(self.count == 0)
        distance = np.sqrt(dot(self.center[:, leaves], self.center[:, leaves]))
        steps = np.ceil(self.half[leaves] / distance / POINT_SIZE).astype(int)
        for count in np.unique(steps):
            patch = leaves[steps == count]
            coordinate = (np.arange(count) + 0.5) * (2.0 / count) - 1.0
            s, t = (values.ravel() for values in np.meshgrid(coordinate, coordinate))
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
        """Yield (columns (Q,) of `index`, patches (Q,)): the coarsest patches that the lobes of the samples `index`
        (M,) cannot resolve. Distant patches below any of the `horizons`, normals (P, 3), are left out."""
        light = self.lights[0]
        narrowest = np.tan(0.5 * light.spread) if light.has_spread else 1.0
        for start in range(0, len(index), PATCH_CHUNK):
            block = index[start : start + PATCH_CHUNK]
            normals = [np.ascontiguousarray(normal[block].T, np.float32) for normal in horizons]
            peak = _Peaks(samples, block) if is_specular else None
            origin = np.ascontiguousarray(light.viewpoint(samples.position[block]).T)
            column, patch = np.arange(len(block)), np.zeros(len(block), np.intp)
            while len(column):
                toward = (self.center[:, patch] - origin[:, column]).astype(np.float32)
                distance = np.maximum(np.sqrt(dot(toward, toward)), np.float32(1e-30))
                toward /= distance
                above = np.ones(len(column), bool)
                for normal in normals:
                    above &= dot(np.take(normal, column, axis=1), toward) > -self.reach[patch]
                if not above.all():
                    column, patch, toward, distance = column[above], patch[above], toward[:, above], distance[above]
                size = self.half[patch].astype(np.float32) / distance
                length = 1.0 if peak is None else peak.lengths(column, toward, size)
                fits = size < self.largest[patch] * np.minimum(length, narrowest)
                if fits.any():
                    yield start + column[fits], patch[fits]
                column, patch = column[~fits], patch[~fits]
                count = self.count[patch]
                ends = np.cumsum(count)
                number = np.arange(ends[-1] if len(ends) else 0) - np.repeat(ends - count, count)
                column, patch = np.repeat(column, count), np.repeat(self.first[patch], count) + number


def fitting_patches(light: Light, samples: SurfaceSamples, specular: bool) -> Iterator[tuple]:
    """Yield (index (Q,), lights): the coarsest patches of a near `light` that the lobes of the samples `index` cannot
    resolve. Each sample gets the whole light."""
    if len(samples) == 0:
        return
    tree = PatchTree.of(light)
    pairs = tree.pairs(samples, (), np.arange(len(samples)), specular)
    index, patch = (np.concatenate(values) for values in zip(*pairs, strict=True))
    # Leaves share a key with the other leaves of their patch, because the same samples take them.
    key, owner = np.arange(len(tree.count)), np.repeat(np.arange(len(tree.count)), tree.count)
    key[1:] = np.where(tree.count[1:] == 0, -1 - owner, key[1:])
    order = np.argsort(key[patch], kind="stable")
    for group in np.split(order, np.flatnonzero(np.diff(key[patch[order]])) + 1):
        members = np.unique(patch[group])
        yield index[group[patch[group] == members[0]]], tuple(tree.lights[number] for number in members)


class _Peaks:
    """Peaks of the specular lobes of Q samples: the mirrored views, and the least widths."""

    def __init__(self, samples, index):
        normal, view = (np.ascontiguousarray(values[index].T, np.float32) for values in (samples.normal, samples.view))
        cosine = dot(normal, view)
        self.mirrored = np.float32(2.0) * cosine * normal - view
        alpha = np.square(samples.sharpest_roughness[index].astype(np.float32))
        width = alpha * np.maximum(np.abs(cosine), LEAST_COSINE)
        self.width = np.maximum(LOBE_WIDTH * width, LEAST_WIDTH).astype(np.float32)

    def lengths(self, column, toward, size) -> np.ndarray:
        """The least angle (R,) in rad, at most 1, over which the lobe changes within a patch of this size (R,)."""
        chord = np.sqrt(np.maximum(np.float32(2.0) - np.float32(2.0) * dot(self.mirrored[:, column], toward), 0.0))
        return np.minimum(np.maximum(chord - size, np.float32(0.0)) + self.width[column], np.float32(1.0))


def _largest_sizes(area, radiance, first, count, is_distant) -> np.ndarray:
    """Largest sizes (N,) of patches by their contrast: the difference between a patch and its children, relative to the
    whole light."""
    brightness, owner = np.abs(radiance).sum(axis=0), np.repeat(np.arange(len(count)), count)
    child = np.arange(1, len(count))
    different = area[child] * np.abs(radiance[:, child] - radiance[:, owner]).sum(axis=0)
    # What the children of a patch do not cover is dark.
    dark = np.maximum(area - np.bincount(owner, area[child], len(count)), 0.0) * brightness
    contrast = (np.bincount(owner, different, len(count)) + dark) / np.maximum(area * brightness[0], 1e-30)
    product, most = (SKY_PRODUCT, LARGEST_OF_SKY) if is_distant else (PATCH_PRODUCT, LARGEST_PATCH)
    largest = np.minimum(np.sqrt(product / np.maximum(contrast, 1e-9)), most)
    return np.where(count == 0, np.inf, largest).astype(np.float32)


def cached_on_children(name, lights, made):
    """The result of made(lights). It is cached on the first child of the first light, which copies of that share."""
    key = [light.children[0] for light in lights], [(*light.center, *light.radiance) for light in lights]
    cache = vars(lights[0].children[0])
    cached = cache.get(name)
    is_same = (
        cached is not None and cached[0][1] == key[1] and all(map(lambda one, two: one is two, cached[0][0], key[0]))
    )
    if not is_same:
        cache[name] = key, made(lights)
    return cache[name][1]


def interpolated(grid: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """Values (3, P) for `normals` (P, 3), interpolated from a `grid` (6, GRID, GRID, 3) on a cube. Its sides are +x,
    -x, +y ...; its rows and columns run along the two axes that follow that of the side."""
    size = len(grid[0])
    axis = np.argmax(np.abs(normals), axis=1)
    rows = np.arange(len(normals))
    along = normals[rows, axis]
    face = 2 * axis + (along < 0.0)
    coordinates = [
        np.clip((normals[rows, (axis + step) % 3] / np.abs(along) + 1.0) * 0.5 * (size - 1), 0.0, size - 1.0)
        for step in (1, 2)
    ]
    lows = [np.minimum(coordinate.astype(np.intp), size - 2) for coordinate in coordinates]
    (s, t), (i, j) = [coordinate - low for coordinate, low in zip(coordinates, lows, strict=True)], lows
    near = grid[face, i, j] * (1.0 - t)[:, None] + grid[face, i, j + 1] * t[:, None]
    far = grid[face, i + 1, j] * (1.0 - t)[:, None] + grid[face, i + 1, j + 1] * t[:, None]
    return (near * (1.0 - s)[:, None] + far * s[:, None]).T
