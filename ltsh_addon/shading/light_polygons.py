"""Area lights as samples see them: their corners, what lies above the horizon, patches as fine as a lobe needs.

First what both precisions share, then the corners and parts of lights in single and in double precision, last the
patches of lights with a texture.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from ..scene import AreaLight, SurfaceSamples, round_outline
from . import facing, light_cone
from .facing import FacingDisk
from .polygon import convex_pieces, split_at_horizon

# Where at least this share of the points sees all of a light, all are computed as if they did: cheaper than gathering.
MOSTLY_WHOLE = 0.6
# Corners of a round light by how far it reaches, in units of the lobe's width where it meets the light: below 8 of them
# 32 corners are within 0.1 % of an ellipse, and so on.
ROUND_CORNERS = (32, 64, 128, 256)
ROUND_LIMITS = (8.0, 40.0, 300.0)
FOCUSED_ROUND_CORNERS = (32, 64)
# By coordinates, how far rounding takes points from the plane that they are in, some of them in front of it: a flat
# surface that shines must not light itself. Those of scenes beyond that, in m, were rounded nearer to the origin (see
# `blender.extract.origin`).
ROUNDING, FARTHEST_ROUNDED = 4e-7, 4000.0
# The product of the contrast of a patch (see `_largest_size`) and the square of its size by that length is at most
# this. Measured on random surfaces at a light's size from it, with the contrasts of a photograph: the patches that a
# sample takes then give what the smallest ones do to 0.2 % (relative L2); with 0.006, 150 on average of 1024.
PATCH_PRODUCT = 0.004
# Half the diagonal of a patch by that length, at most: also where the means of its parts are equal.
LARGEST_PATCH = 0.5
# The width of GGX lobes in rad, by alpha: where the normal distribution has a quarter of its peak.
LOBE_WIDTH = 2.0
# Lobes seen at grazing angles are narrower across the view; below this cosine they become no narrower.
LEAST_COSINE = 0.1


def light_levels(light, corners, position, width):
    """Yield (corners (V, 3), effort for its cone, chosen (Q',) of the points, None for all) as lobes need them.

    The lobes are `width` (Q,) or a number of radians wide, at points with x, y, z in `position` (3, Q), all in double
    precision, so that both paths come to the same decisions.
    """
    if light.is_profiled:
        for effort, chosen in light_cone.efforts(light, position, width):
            if light.is_round:
                corners = light.polygon(FOCUSED_ROUND_CORNERS[effort.chords > 2])
                effort = replace(effort, chords=2)
            for piece in convex_pieces(corners) if light.shape == "POLYGON" else [corners]:
                yield piece, effort, chosen
    elif light.is_round:
        for outline, chosen in round_levels(light, position, width):
            yield outline, None, chosen
    else:
        yield corners, None, None


def round_levels(light, position, width):
    """Yield (corners (V, 3), chosen (Q',), None for all) of a round light for points with x, y, z in `position`
    (3, Q), all in double precision, with lobes that are `width` (Q,) or a number of radians wide."""
    position = light.origins(position)
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
    """Corners (C, V, P) of a light: coordinates along rows (C, 3, P), float32.

    corners (V, 3) in the world; offset (3, P) from the points to the light's center, which for "POLYGON" may lie
    anywhere near. Of a FacingDisk the corners are their own number, the offset its own.
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
    if light.is_round or light.shape == "POLYGON":
        for number, corner in enumerate((corners - light.center).astype(np.float32)):
            out = _along(rows, corner, scratch("axis", (coordinates, points)), scratch)
            np.add(center, out, out=result[:, number])
        return result
    # Corners 0 and 2 are opposite, and so are 1 and 3: half diagonals from the center.
    for number in (0, 1):
        half = ((corners[number] - corners[number + 2]) * 0.5).astype(np.float32)
        out = _along(rows, half, scratch("axis", (coordinates, points)), scratch)
        np.add(center, out, out=result[:, number])
        np.subtract(center, out, out=result[:, number + 2])
    return result


def _along(rows, vector, out, scratch):
    """Products (C, P) of rows (C, 3, P) with a vector (3,) or vectors (3, P)."""
    product = scratch("product", out.shape)
    np.multiply(rows[:, 0], vector[0], out=out)
    for axis in (1, 2):
        out += np.multiply(rows[:, axis], vector[axis], out=product)
    return out


def integrate_visible(corners: np.ndarray, facing: np.ndarray, clip_rows, count: int, integrate):
    """Integrals (count, P) over what is seen of polygons (C, V, P), and the mask (P,) of points that need float64.

    A point sees the part of its polygon where all coordinates `clip_rows` are positive, if it is `facing` (P,) it.
    `integrate(polygons (C, W, Q), index)` returns (count, Q) and a mask (Q,) for the points `index` (None: all).
    """
    whole = facing.copy()
    partly = facing
    for row in clip_rows:
        whole &= np.minimum.reduce(corners[row], axis=0) > 0.0
    seen_whole = np.count_nonzero(whole)
    points = len(facing)
    if seen_whole == points:
        return integrate(corners, None)
    for row in clip_rows:
        partly = partly & (np.maximum.reduce(corners[row], axis=0) > 0.0)
    cut = np.nonzero(partly & ~whole)[0]
    values, needs_float64 = np.zeros((count, points), np.float32), np.zeros(points, bool)
    if seen_whole > MOSTLY_WHOLE * points:
        found, mask = integrate(corners, None)
        np.multiply(found, whole, out=values)
        np.logical_and(mask, whole, out=needs_float64)
    elif seen_whole:
        index = np.nonzero(whole)[0]
        values[:, index], needs_float64[index] = integrate(np.take(corners, index, axis=2), index)
    if len(cut):
        for index, polygons in _clipped(np.take(corners, cut, axis=2), clip_rows):
            values[:, cut[index]], needs_float64[cut[index]] = integrate(polygons, cut[index])
    return values, needs_float64


def _clipped(corners, clip_rows):
    """Yield (index, polygons) of the parts of polygons (C, V, P) where all coordinates `clip_rows` are positive."""
    if not clip_rows:
        yield np.arange(corners.shape[2]), corners
        return
    for outer, part in split_at_horizon(corners, clip_rows[0]):
        for inner, polygons in _clipped(part, clip_rows[1:]):
            yield outer[inner], polygons


def local_frames(normal, view):
    """Local frames (3, 3, P): rows tangent, bitangent, normal; the view has y = 0 and x >= 0."""
    # The difference of vectors that are close is exact. The length of a normal from single precision is not quite 1.
    across = view - normal
    squared = (normal * normal).sum(axis=1, keepdims=True)
    tangent = across - (across * normal).sum(axis=1, keepdims=True) / squared * normal
    length = np.sqrt((tangent * tangent).sum(axis=1, keepdims=True))
    # Where view and normal coincide any tangent serves: take the axis that the normal is farthest from.
    axis = np.eye(3)[np.argmin(np.abs(normal), axis=1)]
    other = axis - (axis * normal).sum(axis=1, keepdims=True) / squared * normal
    tangent = np.where(length > 1e-7, tangent, other)
    tangent = tangent / np.sqrt((tangent * tangent).sum(axis=1, keepdims=True))
    bitangent = np.cross(normal, tangent)
    return np.stack([tangent.T, bitangent.T, normal.T])


def in_front(samples, light, candidates):
    """Those candidate points that lie on the side to which the light shines, in its cone, and that it lights at all."""
    center, direction = (
        vector if vector.ndim == 1 else vector[candidates] for vector in (light.center, light.direction)
    )
    position = samples.position[candidates]
    ahead = np.ones(len(candidates), bool)
    if not light.is_facing:
        origins = light.origins(position)
        ahead = ((origins - center) * direction).sum(axis=1) > off_plane(center.T, np.abs(origins).sum(axis=1))
    if light.is_facing or light.is_focused:
        ahead &= may_reach(light, position.T)
    allowed = light.receives(samples.receiver, candidates)
    return candidates[ahead if allowed is None else ahead & allowed]


def off_plane(center, extent) -> np.ndarray:
    """How far in front of a light, in m, points are that surely see it; its center is (3,) or (3, Q), and `extent` (Q,)
    the sum of their coordinates, without signs."""
    return ROUNDING * np.minimum(np.abs(center).sum(axis=0) + extent, FARTHEST_ROUNDED)


def may_reach(light, position) -> np.ndarray:
    """Mask (Q,): False for points (3, Q) that no part of a light with a spread or a cone shines on."""
    if light.is_facing:
        return facing.may_reach(light, light.center[:, None] - position)
    return light_cone.may_reach(light, position)


# Samples at which lights are tried first, and pairs of samples and lights that are tried at all.
FEW_SAMPLES, MOST_PAIRS = 1024, 2 * 10**7
CHUNK = 16384


def has_lobe(samples: SurfaceSamples) -> np.ndarray:
    """Mask (2, P) of the samples that have a diffuse and a specular lobe."""
    terms = (samples.specular_f0, samples.specular_f90, samples.specular_dip, samples.dielectric)
    return np.stack([samples.diffuse_albedo.any(axis=1), np.logical_or.reduce([term.any(axis=1) for term in terms])])


def lights_that_reach_nothing(samples: SurfaceSamples, lights: tuple[AreaLight, ...]) -> list[str]:
    """Names of the `lights` of which no part is above the horizon of a lobe of any sample, in front of it.

    Lights of one name are one light. Where there are more than MOST_PAIRS left to try, the others are taken as seen.
    """
    reached = set()
    for part in (samples.take(slice(None, None, max(1, len(samples) // FEW_SAMPLES))), samples):
        lobes, pairs = has_lobe(part), 0
        ends = np.stack([part.position.min(axis=0, initial=np.inf), part.position.max(axis=0, initial=-np.inf)])
        for light in lights:
            if light.name in reached:
                continue
            # How far the box around the samples reaches in front of the light.
            ahead = ((light.origins(ends) - light.center) * light.direction).max(axis=0).sum()
            if light.is_facing or ahead > 0.0:
                pairs += len(part)
                if pairs > MOST_PAIRS or _reaches(light, part, lobes):
                    reached.add(light.name)
    return [name for name in dict.fromkeys(light.name for light in lights) if name not in reached]


def _reaches(light: AreaLight, samples: SurfaceSamples, lobes: np.ndarray) -> bool:
    """True where a corner of the light is above both horizons of one of the `lobes` (2, P)."""
    diffuse = lobes[0] & light.affects_diffuse, (samples.diffuse_normal, samples.smooth_normal)
    specular = lobes[1] & light.affects_specular, (samples.normal, samples.geometric_normal)
    corners = light.polygon()[:, None]
    for lobe, horizons in (diffuse, specular):
        candidates = np.flatnonzero(lobe)
        for start in range(0, len(candidates), CHUNK):
            index = in_front(samples, light, candidates[start : start + CHUNK])
            offset = corners - light.origins(samples.position[index])
            heights = [(offset * normal[index]).sum(axis=-1).max(axis=0) for normal in horizons]
            if light.is_facing:
                offset = light.center - samples.position[index]
                heights = [(offset * normal[index]).sum(axis=-1) + light.radius for normal in horizons]
            if (np.minimum(*heights) > 0.0).any():
                return True
    return False


def to_local(axes, vectors):
    """World vectors (3, ..., P) in local frames (3, 3, P)."""
    return np.stack([sum(row[k] * vectors[k] for k in range(3)) for row in axes])


def visible_parts(samples, frame, light, corners, candidates, second_normal=None):
    """Yield (index, polygons (3, W, Q) in local frames) of the candidate points that the light shines on.

    Polygons are clipped at the shading horizon, and before that at the horizon of `second_normal` (P, 3). Those of a
    profiled light have two more coordinates, in the light's plane with the foot of the point as the origin.
    """
    index = in_front(samples, light, candidates)
    if len(index) == 0:
        return
    if light.is_facing:
        disk = FacingDisk.of(light, (light.center - samples.position[index]).T, frame[2][:, index])
        offset = disk.corners(round_outline(len(corners)))
    else:
        corners = corners[:, None, :] if corners.ndim == 2 else corners[:, index]
        offset = (corners - light.origins(samples.position[index])).transpose(2, 0, 1)
    local = to_local(frame[:, :, index], offset)
    if light.is_profiled:
        local = np.concatenate([local, to_local(light_cone.plane_axes(light), offset)])
    parts = [(slice(None), local)]
    if second_normal is not None:
        height = (offset * second_normal[index].T[:, None, :]).sum(axis=0)
        if not (height > 0.0).all():
            with_height = np.concatenate([local, height[None]])
            parts = ((part, clipped[:-1]) for part, clipped in split_at_horizon(with_height, axis=len(local)))
    for outer, polygon in parts:
        for inner, clipped in split_at_horizon(polygon):
            yield index[outer][inner], clipped


def seen_parts(samples, frame, light, corners, candidates, width, second_normal=None):
    """As `visible_parts`, (index, polygons, effort), with what lobes of `width` (Q,) or a number need of the light."""
    position = samples.position[candidates].T
    for outline, effort, chosen in light_levels(light, corners, position, width):
        of_level = candidates if chosen is None else candidates[chosen]
        for index, polygon in visible_parts(samples, frame, light, outline, of_level, second_normal):
            yield index, polygon, effort


def light_view(samples, frame, light, index, to_lobe) -> light_cone.LightView:
    """The view of a profiled light from the points `index`; the first three coordinates are those of the lobe,
    to_lobe(vectors (3, Q)), the others local."""
    axes = frame[:, :, index]
    offset = (light.center - light.origins(samples.position[index])).T

    def along(vector):
        local = to_local(axes, np.broadcast_to(vector[:, None], offset.shape))
        return np.concatenate([to_lobe(local), local])

    return light_cone.LightView.of(light, offset, along)


def fitting_patches(light: AreaLight, samples: SurfaceSamples, specular: bool) -> Iterator[tuple]:
    """Yield (index (Q,), lights): the coarsest patches of `light` that the lobes of the samples `index` cannot resolve.

    Each sample gets all of the light. A patch has the mean radiance of its parts. What the mean loses is second order
    in the size of the patch by the length over which the rest of the integrand changes: the distance for diffuse lobes;
    for specular ones the width of the lobe, or the angle from its peak where that is larger.
    """
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
    return min(np.sqrt(PATCH_PRODUCT / max(contrast, 1e-9)), LARGEST_PATCH)


def _sizes(patch, samples, specular) -> np.ndarray:
    """Half the diagonal of `patch` (P,) by the length over which the rest of the integrand changes."""
    offset = patch.center - patch.origins(samples.position)
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
    return LOBE_WIDTH * np.square(samples.sharpest_roughness) * np.maximum(cosine, LEAST_COSINE)


def _angle_from_peak(samples, direction, size) -> np.ndarray:
    """Angle (P,) in rad between the mirrored view and what is nearest to it in a patch of half the diagonal `size`."""
    mirrored = 2.0 * (samples.normal * samples.view).sum(axis=1, keepdims=True) * samples.normal - samples.view
    chord = np.linalg.norm(direction - mirrored, axis=1)
    return np.maximum(chord - size, 0.0)
