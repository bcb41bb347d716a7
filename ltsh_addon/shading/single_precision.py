"""The fast path of `shade`: float32 frames, lookups and edge sums in chunks that fit the cache.

The warp and, for "ltc", the tilt of the lobe are multiplied into the local frame of a sample once, for all lights: a
light's corners come out of one product. What single precision cannot do is computed again in double precision, per
block: points so close to a light's plane that an edge spans half a circle, tiny lights, sharp lobes.
"""

from __future__ import annotations

from functools import partial

import numpy as np

from . import double_precision, edge_loop, light_cone, ridge_table
from .fresnel_kinds import any_component, columns, fresnel_kinds
from .light_polygons import integrate_visible, light_levels, local_corners
from .polygon import dot
from .single_integrals import CHUNK, CORNERS, Cosine, Focused, LobeIntegral, ShadowedCosine

DOUBLE_CHUNK = 4096
# The light of narrower cones, in rad, is too bright for the absolute error of single precision.
NARROW_SPREAD = 0.35


def shade_diffuse(samples, lights, radiance, scratch):
    """Add to radiance (G, P, 3) what the diffuse lobes of `samples` reflect of `lights`, (light, group, corners)."""
    lights = [item for item in lights if item[0].affects_diffuse]
    lit = np.nonzero(any_component(samples.diffuse_albedo))[0]
    bumped = np.zeros(len(lit), bool)
    if samples.diffuse_normal is not samples.smooth_normal:
        bumped = any_component(samples.diffuse_normal != samples.smooth_normal)[lit]
    fragile = [[] for _ in lights]
    for is_bumped, members in ((False, lit[~bumped]), (True, lit[bumped])):
        for index in _chunks(members):
            rows = _normal_frame(columns(samples.diffuse_normal, index))
            clip_rows, integrate = (2,), None
            if is_bumped:
                smooth = columns(samples.smooth_normal, index)
                rows, clip_rows = np.concatenate([rows, smooth[None]]), (3, 2)
                integrate = ShadowedCosine(rows, samples.bump_alpha2[index].astype(np.float32), scratch)
            colors = columns(samples.diffuse_albedo, index)[None]
            integrate = integrate or Cosine(scratch)
            _add_lights(samples, index, lights, rows, clip_rows, integrate, colors, 1.0, radiance, fragile, scratch)
    _add_fragile(samples, lights, fragile, radiance, double_precision.shade_diffuse)


def shade_specular(samples, lights, table, radiance, scratch):
    """As `shade_diffuse` for the specular lobes of `table`."""
    lights = [item for item in lights if item[0].affects_specular]
    ridges = ridge_table.prepare(table)
    terms = (samples.specular_f90, samples.specular_f0, samples.specular_dip, samples.dielectric)
    reflective = np.logical_or.reduce([any_component(term) for term in terms])
    lit = reflective & (dot(samples.normal.T, samples.view.T) > 0.0)
    sharp = lit & (samples.roughness < ridge_table.SHARP_ROUGHNESS)
    fragile = [[] for _ in lights]
    for vectors, members, color_rows in fresnel_kinds(samples, np.nonzero(lit & ~sharp)[0]):
        for index in _chunks(members):
            rows, clip_rows, weights = _lobe_rows(samples, index, ridges, vectors, scratch)
            integrate = LobeIntegral(ridges, weights, scratch)
            colors, width = color_rows(index), double_precision.lobe_width(samples, index)
            _add_lights(samples, index, lights, rows, clip_rows, integrate, colors, width, radiance, fragile, scratch)

    def in_double(part, items, target):
        double_precision.shade_specular(part, items, table, target)

    _add_double(samples, np.nonzero(sharp)[0], lights, radiance, in_double)
    _add_fragile(samples, lights, fragile, radiance, in_double)


def _chunks(members):
    return (members[part] for part in edge_loop.pieces(len(members), CHUNK))


def _add_double(samples, members, lights, radiance, shade):
    """Add the light of `lights` at the samples `members` (Q,) by a function of `double_precision`."""
    for start in range(0, len(members), DOUBLE_CHUNK):
        index = members[start : start + DOUBLE_CHUNK]
        target = np.zeros((len(radiance), len(index), 3))
        shade(samples.take(index), lights, target)
        radiance[:, index] += target.astype(np.float32)


def _add_fragile(samples, lights, fragile, radiance, shade):
    """Add each of `lights` at the samples of its entry of `fragile`, lists of index arrays: all plain lights with
    equally many corners in one batch, for there are few such samples."""
    found = [(item, np.concatenate(parts)) for item, parts in zip(lights, fragile, strict=True) if parts]
    for item, index in found:
        if item[0].is_focused or item[0].is_round:
            _add_double(samples, index, [item], radiance, shade)
    found = [(item, index) for item, index in found if not (item[0].is_focused or item[0].is_round)]
    for count in sorted({len(item[2]) for item, _ in found}):
        chosen = [(item, index) for item, index in found if len(item[2]) == count]
        members = np.concatenate([index for _, index in chosen])
        number = np.repeat(np.arange(len(chosen)), [len(index) for _, index in chosen])
        group = np.array([item[1] for item, _ in chosen])[number]
        corners = np.stack([item[2] for item, _ in chosen])
        fields = {
            name: np.stack([getattr(item[0], name) for item, _ in chosen])
            for name in ("center", "direction", "radiance")
        }
        for start in range(0, len(members), DOUBLE_CHUNK):
            part = slice(start, start + DOUBLE_CHUNK)
            of = number[part]
            light = double_precision.LightOfEachSample(**{name: values[of] for name, values in fields.items()})
            target = np.zeros((1, len(of), 3))
            shade(samples.take(members[part]), [(light, 0, corners[of].transpose(1, 0, 2))], target)
            # A sample may be there for several lights.
            np.add.at(radiance, (group[part], members[part]), target[0].astype(np.float32))


def _add_lights(samples, index, lights, rows, clip_rows, integrate, colors, width, radiance, fragile, scratch):
    """Add the light of all `lights` at the samples `index` (Q,) to radiance (G, P, 3).

    rows (C, 3, Q) are the axes of the coordinates that `integrate` wants, colors (F, 3, Q) the reflectances of its
    integrals, `width` that of the lobes as for `round_levels`. Points left to double precision are appended to
    `fragile`, per light.
    """
    position = np.ascontiguousarray(samples.position[index].T)
    sums = {group: np.zeros((len(colors), 3, len(index)), np.float32) for _, group, _ in lights}
    for number, (light, group, corners) in enumerate(lights):
        allowed = light.receives(samples.receiver, index)
        if light.is_focused:
            near = light_cone.may_reach(light, position)
            allowed = near if allowed is None else allowed & near
        if light.spread < NARROW_SPREAD:
            fragile[number].append(index[allowed])
            continue
        for part, outline, effort in _batches(light, corners, position, width):
            offset = np.subtract(light.center[:, None], position[:, part]).astype(np.float32)
            facing = dot(offset, light.direction.astype(np.float32)) < 0.0
            if allowed is not None:
                facing &= allowed[part]
            axes, of_part = rows[:, :, part], partial(integrate, part)
            if light.is_focused:
                of_part = Focused(light, effort, offset, axes, of_part, len(colors))
                axes = of_part.rows
            polygons = local_corners(light, outline, offset, axes, scratch)
            found, redo = integrate_visible(polygons, facing, clip_rows, len(colors), of_part)
            if redo.any():
                found[:, redo] = 0.0
                fragile[number].append(index[part][redo])
            total = sums[group]
            for channel in range(3):
                total[:, channel, part] += found * np.float32(light.radiance[channel])
    signed = (colors < 0.0).any()
    for group, total in sums.items():
        reflected = (colors * total).sum(axis=0)
        if signed and all((light.radiance >= 0.0).all() for light, its_group, _ in lights if its_group == group):
            # Terms that cancel in the Fresnel factor may leave a rest below zero.
            np.maximum(reflected, np.float32(0.0), out=reflected)
        radiance[group, index] += reflected.T


def _batches(light, corners, position, width):
    """Yield (columns of position (3, Q): a slice or integers, corners (V, 3), effort) of all points, in batches."""
    for outline, effort, chosen in light_levels(light, corners, position, width):
        count = position.shape[1] if chosen is None else len(chosen)
        step = max(CORNERS // len(outline), 512)
        for start in range(0, count, step):
            part = slice(start, start + step)
            yield part if chosen is None else chosen[part], outline, effort


def _normal_frame(normal):
    """Frames (3, 3, P) around normals (3, P), without a preferred tangent (Duff et al. 2017)."""
    x, y, z = normal
    sign = np.copysign(np.float32(1.0), z)
    a = np.float32(-1.0) / (sign + z)
    b = x * y * a
    tangent = np.stack([np.float32(1.0) + sign * x * x * a, sign * b, -sign * x])
    return np.stack([tangent, np.stack([b, sign + y * y * a, -y]), normal])


def _lobe_rows(samples, index, ridges, vectors, scratch):
    """Axes (C, 3, Q) of the warped local frames, the coordinates that are clipped, and the weights (F, K, Q)."""
    normal, view = columns(samples.normal, index), columns(samples.view, index)
    cosine = dot(normal, view)
    # The difference of vectors that are close is exact, so that nothing of it runs along the normal.
    tangent = view - normal
    tangent -= dot(normal, tangent) * normal
    sine = np.sqrt(dot(tangent, tangent))
    straight = np.nonzero(sine < 1e-6)[0]
    if len(straight):
        # The lobe is round there: any tangent serves.
        tangent[:, straight] = _normal_frame(normal[:, straight])[0]
    tangent /= np.where(sine < 1e-6, np.float32(1.0), sine)
    bitangent = np.stack([
        normal[1] * tangent[2] - normal[2] * tangent[1],
        normal[2] * tangent[0] - normal[0] * tangent[2],
        normal[0] * tangent[1] - normal[1] * tangent[0],
    ])  # fmt: skip
    roughness = samples.roughness[index].astype(np.float32)
    angle = np.minimum(cosine, np.float32(1.0)), np.minimum(sine, np.float32(1.0))
    warp, weights, tilt = ridges.fetch(vectors, *angle, roughness, samples.ior[index], scratch)
    rows = [warp[0] * tangent + warp[1] * normal, warp[2] * bitangent, warp[3] * normal]
    clip_rows = (2,)
    if tilt is not None:
        sin_tilt, cos_tilt = np.sin(tilt), np.cos(tilt)
        rows[0], rows[2] = cos_tilt * rows[0] - sin_tilt * rows[2], sin_tilt * rows[0] + cos_tilt * rows[2]
        rows.append(normal)
        clip_rows = (3, 2)
    geometric = samples.geometric_normal[index]
    if samples.geometric_normal is not samples.normal and (geometric != samples.normal[index]).any():
        rows.append(np.ascontiguousarray(geometric.T, dtype=np.float32))
        clip_rows = (len(rows) - 1, *clip_rows)
    return np.stack(rows), clip_rows, weights
