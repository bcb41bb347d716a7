"""The fast path of `shade`: float32 frames, lookups and edge sums in chunks that fit the cache.

The warp of the lobe (and its tilt, for "ltc") is multiplied into the local frame of a sample once for all lights. One
product then gives a light's corners. `float64` shades what single precision cannot: points so close to a light's plane
that an edge spans half a circle, tiny lights, and sharp lobes. If a block has few such pairs of a sample and a light,
they are handed back, because `shade_pairs` shades the pairs of many blocks together.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property, partial

import numpy as np

from ..emitters import light_profile, profile_regions, small_lights
from ..emitters.facing import AnalyticLobe, FacingDisk, mean_emission
from ..emitters.light_polygons import (
    interpolated,
    light_levels,
    local_corners,
    may_reach,
    off_plane,
)
from ..emitters.light_tree import FEWEST, LightTree, add_far_lights
from ..emitters.sky_map import SkyMap
from ..emitters.tails import LightFromPoints, TailLimits
from ..lobes import moments32
from ..lobes.lobe_integrals import FLOAT64_CHUNK, LEAST_SHARE, NARROWEST
from ..lobes.lookup_table import MIN_ALPHA
from ..lobes.polygon import MOSTLY_WHOLE, convex_pieces, dot, integrate_visible
from ..scene import PolygonLight
from . import float64

# If a block has more different indices of refraction, the dielectric's weights are summed up per sample.
SEPARATE_IORS = 8
# Samples per chunk. It is large because a call of numpy costs as much as some thousand elements. Its rows are not a
# multiple of a page long, because the cache would hold few of such rows.
CHUNK = 24592
# Corners per chunk.
CORNERS = 4 * CHUNK
# Samples per chunk for small lights.
SMALL_CHUNK = 6144
# Points per chunk for lights with a profile.
POINT_CHUNK = 40960
# In rad. Lights with a narrower cone are too bright for the absolute error of single precision.
NARROW_SPREAD = 0.35


def shade_diffuse(samples, lights, radiance, scratch, leftovers=None):
    """Add to `radiance` (R, P, 3) what the diffuse lobes of `samples` reflect of `lights`, (light, row, corners).

    A list `leftovers` receives the pairs that are left to `shade_pairs`, if they are fewer than FLOAT64_CHUNK: (samples
    (N,), lights (N,)), where a light's number is its position among those that affect diffuse lobes.
    """
    lights = Lights.of(lights, "diffuse")
    lit = np.nonzero(_any_component(samples.diffuse_albedo))[0]
    bumped = np.zeros(len(lit), bool)
    if samples.diffuse_normal is not samples.smooth_normal:
        bumped = _any_component(samples.diffuse_normal != samples.smooth_normal)[lit]
    lighting = _Lighting(samples, lights, radiance, scratch, float64.shade_diffuse)
    shaped = ((samples.sheen_a != 0.0) | (samples.diffuse_roughness != 0.0))[lit]
    lighting.add_in_float64(lit[shaped])
    lit, bumped = lit[~shaped], bumped[~shaped]
    for is_bumped, members in ((False, lit[~bumped]), (True, lit[bumped])):
        for index in _chunks(members):
            rows = _normal_frame(_columns(samples.diffuse_normal, index))
            clip_rows, integrate, at_point = (2,), FormFactor(scratch), small_lights.CosineAtPoint(rows)
            if is_bumped:
                smooth, bump_alpha2 = _columns(samples.smooth_normal, index), samples.bump_alpha2[index]
                rows, clip_rows = np.concatenate([rows, smooth[None]]), (3, 2)
                integrate = ShadowedFormFactor(rows, bump_alpha2.astype(np.float32), scratch)
                at_point = small_lights.ShadowedCosineAtPoint(rows, bump_alpha2.astype(np.float32))
            colors = _columns(samples.diffuse_albedo, index)[None]
            others = (samples.bump_alpha2[index],) if is_bumped else ()
            lighting.add(Lobes(index, rows, clip_rows, integrate, at_point, colors, 1.0, others=others))
    lighting.finish(leftovers)


def shade_specular(samples, lights, table, radiance, scratch, leftovers=None):
    """As `shade_diffuse`, for the specular lobes of `table`."""
    lights = Lights.of(lights, "specular")
    ridges = moments32.prepare(table)
    terms = (samples.specular_f90, samples.specular_f0, samples.specular_dip, samples.dielectric)
    reflective = np.logical_or.reduce([_any_component(term) for term in terms])
    lit = reflective & (dot(samples.normal.T, samples.view.T) > 0.0)
    sharp = lit & ((samples.roughness < moments32.SHARP_ROUGHNESS) | float64.has_bent_fresnel(samples))
    anisotropic = lit & (samples.anisotropy != 0.0)

    lighting = _Lighting(samples, lights, radiance, scratch, specular_in_float64(table))
    far = sharp & False
    if lights.skies:
        far = sharp & ~(anisotropic | float64.has_bent_fresnel(samples))
    elif lights.trees and table.family == "ltsh":
        far = sharp & ~anisotropic
    sharp = (sharp | anisotropic) & ~far
    for only_tails, chosen in ((False, lit & ~sharp & ~far), (True, far)):
        for vectors, members, colors_of in fresnel_kinds(samples, np.nonzero(chosen)[0]):
            for index in _chunks(members):
                lobes = _specular_lobes(samples, index, (table, ridges, vectors), colors_of(index), scratch)
                lighting.add(replace(lobes, only_tails=only_tails))
    lighting.add_in_float64(np.nonzero(sharp)[0])
    lighting.finish(leftovers)


def _specular_lobes(samples, index, kind, colors, scratch) -> Lobes:
    """The specular lobes of the samples `index` (Q,) with `colors` (F, 3, Q). `kind` is a table, its `RidgeTable`, and
    the Fresnel terms as `fresnel_kinds` yields them."""
    table, ridges, vectors = kind
    axes = _columns(samples.normal, index), _columns(samples.view, index)
    rows, clip_rows, weights = _lobe_rows(samples, index, axes, ridges, vectors, scratch)
    integrate, width = LobeIntegral(ridges, weights, scratch), float64.lobe_width(samples, index)
    limits = None
    if table.family == "ltsh":
        ior = None if isinstance(vectors[-1], int) else samples.ior[index]
        second = rows[clip_rows[0]] if len(clip_rows) > 1 else None
        limits = TailLimits.of(axes, samples.roughness[index], second, 1 in vectors, ior)
    at_point = small_lights.LobeAtPoint(rows, weights, table, limits)
    sharpest = small_lights.SharpestLobes(*axes, width)
    others = samples.roughness[index], samples.ior[index]
    return Lobes(index, rows, clip_rows, integrate, at_point, colors, width, limits, sharpest, others=others)


def specular_in_float64(table):
    """The argument `shade_in_float64` of `shade_pairs` for specular lobes of `table`. For diffuse lobes it is
    `float64.shade_diffuse`."""

    def shade(samples, lights, radiance):
        float64.shade_specular(samples, lights, table, radiance)

    return shade


def _chunks(members):
    return (members[part] for part in moments32.pieces(len(members), CHUNK))


@dataclass(frozen=True)
class Lobes:
    """The lobes of Q samples."""

    index: np.ndarray  # (Q,) of the samples
    rows: np.ndarray  # (C, 3, Q) axes of the coordinates that `integrate` takes
    clip_rows: tuple[int, ...]  # numbers of the coordinates that are positive above a horizon
    integrate: Callable  # integrate(columns, corners, index, smallest) -> integrals (F, Q') and mask of what to redo
    at_point: Callable  # integrals (F, Q') over small lights by columns and `small_lights.RaysToCenters`
    colors: np.ndarray  # (F, 3, Q) reflectances by which the integrals are multiplied
    width: np.ndarray | float  # rad, as for `light_levels`
    limits: TailLimits | None = None
    sharpest: small_lights.SharpestLobes | None = None  # only for specular lobes
    only_tails: bool = False  # True: single precision suffices for lights in the tails of the lobes only
    others: tuple = ()  # (Q,) arrays of what the lobes depend on besides rows and widths

    @cached_property
    def shape(self) -> np.ndarray:
        """What the lobes depend on (S, Q), each divided by the length over which the lobes change with it."""
        rows = [self.rows[row] / self.lengths[row] for row in self.clip_rows]
        if self.sharpest is not None:
            rows += [self.sharpest.mirrored / self.sharpest.width, np.log(self.sharpest.width)[None]]
        return np.concatenate([*rows, *(other[None].astype(np.float32) for other in self.others)])

    @cached_property
    def lengths(self) -> dict[int, np.ndarray]:
        """Lengths (Q,) of the rows that are clipped."""
        return {row: np.sqrt(dot(self.rows[row], self.rows[row])) for row in self.clip_rows}


@dataclass(frozen=True)
class AlikeLights:
    """L lights with equally many corners: vectors (3, L) and numbers (L,), all but `centers` in single precision."""

    centers: np.ndarray  # (2, 3, L) center and centroid
    corners: np.ndarray  # (V, 3, L) of `Light.polygon`, relative to the center
    half_u: np.ndarray
    half_v: np.ndarray
    direction: np.ndarray
    radiance: np.ndarray
    area_vector: np.ndarray
    radius: np.ndarray  # m, around the centroid
    diagonal: np.ndarray  # as in `small_lights.SmallLight`
    numbers: np.ndarray  # among all lights
    place: np.ndarray  # (N,) place here of each of the N lights; -1 for those not here or too narrow

    @classmethod
    def of(cls, lights, numbers) -> AlikeLights:
        """Those of `lights`, (light, row, corners), with these `numbers` (L,)."""
        own = [lights[number][0] for number in numbers]
        centroid, area, _, diagonal = small_lights.moments_of(own)
        center = np.array([light.center for light in own])
        corners = np.array([lights[number][2] for number in numbers])
        radius = np.sqrt(np.square(corners - centroid[:, None]).sum(axis=2).max(axis=1))
        names = ("half_u", "half_v", "direction", "radiance")
        vectors = [np.array([getattr(light, name) for light in own]) for name in names]
        longest = np.square(corners - corners[:, :1]).sum(axis=2).max(axis=1)
        is_narrow = np.sqrt(np.square(area).sum(axis=1)) < NARROWEST * longest
        place = np.full(len(lights), -1)
        place[numbers] = np.where(is_narrow, -1, np.arange(len(numbers)))
        corners = (corners - center[:, None]).transpose(1, 2, 0)
        others = (values.T.astype(np.float32, order="C") for values in (*vectors, area, radius, diagonal))
        return cls(np.stack([center.T, centroid.T]), corners.astype(np.float32, order="C"), *others, numbers, place)


class Lights(list):
    """Lights (light, row, corners) that affect one pass. Trees of many lights are built once."""

    @classmethod
    def of(cls, lights, name) -> Lights:
        """Those of `lights` that affect the pass `name`. A Lights object is returned as it is."""
        return (
            lights if isinstance(lights, Lights) else cls(one for one in lights if getattr(one[0], f"affects_{name}"))
        )

    @cached_property
    def trees(self) -> list[tuple[LightTree, list[int]]]:
        """Trees of many lights, and the positions here of their lights."""
        kinds: dict[tuple, list[int]] = {}
        for number, (light, row, _) in enumerate(self):
            is_plain = not (light.has_profile or light.is_distant or light.is_facing or light.cone is not None)
            if is_plain and (light.radiance >= 0.0).all():
                kinds.setdefault((row, light.receivers), []).append(number)
        many = [numbers for numbers in kinds.values() if len(numbers) >= FEWEST]
        return [(LightTree.of([self[number][0] for number in numbers]), numbers) for numbers in many]

    @cached_property
    def alike(self) -> list[AlikeLights]:
        """The lights in trees that are not round, grouped by their number of corners."""
        kinds: dict[int, list[int]] = {}
        for number in (number for _, numbers in self.trees for number in numbers):
            kinds.setdefault(0 if self[number][0].is_round else len(self[number][2]), []).append(number)
        return [AlikeLights.of(self, np.array(numbers)) for count, numbers in kinds.items() if count]

    @cached_property
    def alone(self) -> list[int]:
        """The positions here of the lights that are in no tree."""
        taken = {number for _, numbers in self.trees for number in numbers}
        return [number for number in range(len(self)) if number not in taken]

    @cached_property
    def skies(self) -> list[tuple[SkyMap, object, int]]:
        """Maps of the distant lights with a detail, each with one of its lights and their row."""
        kinds: dict[tuple, list] = {}
        for light, row, _ in self:
            if float64.has_patches(light):
                kinds.setdefault((row, light.receivers), []).append(light)
        return [(SkyMap.of(lights), lights[0], row) for (row, _), lights in kinds.items()]


class _Lighting:
    """Adds the light of `lights` at `samples` to `radiance` (R, P, 3). shade_in_float64(samples, lights, radiance)
    shades points that need double precision."""

    def __init__(self, samples, lights, radiance, scratch, shade_in_float64):
        self.samples, self.lights, self.radiance, self.scratch = samples, lights, radiance, scratch
        self.shade_in_float64 = shade_in_float64
        self.needs_float64 = [[] for _ in lights]  # indices of samples, per light
        self.pairs_in_float64: list[tuple] = []  # the same as pairs (K,) of a sample and a light

    def add(self, lobes: Lobes) -> None:
        """Add the light that `lobes` reflect."""
        index, colors = lobes.index, lobes.colors
        position = np.ascontiguousarray(self.samples.position[index].T)
        sums = {row: np.zeros((len(colors), 3, len(index)), np.float32) for row in {row for _, row, _ in self.lights}}
        self._add_skies(lobes, sums)
        left = self._add_far(lobes, position, sums)
        for number in sorted([*self.lights.alone, *left]):
            if not float64.has_patches(self.lights[number][0]):
                self._add_light(lobes, number, position, left.get(number), sums)
        signed = (colors < 0.0).any()
        for row, total in sums.items():
            reflected = (colors * total).sum(axis=0)
            if signed and all((light.radiance >= 0.0).all() for light, its, _ in self.lights if its == row):
                # Terms that cancel in the Fresnel factor may leave a rest below zero.
                np.maximum(reflected, np.float32(0.0), out=reflected)
            self.radiance[row, index] += reflected.T

    def _add_light(self, lobes, number, position, columns, sums) -> None:
        """Add one light to the `sums` (F, 3, Q) by row, at the `columns` (Q',), None for all."""
        (light, row, corners), index = self.lights[number], lobes.index
        allowed = light.receives(self.samples.receiver, index)
        if light.has_spread or light.cone is not None:
            near = may_reach(light, position)
            allowed = near if allowed is None else allowed & near
        rest = columns
        if not lobes.only_tails:
            if not light.has_profile:
                rest = self._add_small(lobes, light, position, (columns, allowed), sums[row])
            elif profile_regions.ProfileRegions.suit(light):
                rest = self._add_points(lobes, light, position, (columns, allowed), sums[row])
            if rest is not None and len(rest) == 0:
                return
        is_hard = light.spread < NARROW_SPREAD or _is_narrow(light, corners) or _is_in_pieces(light, corners)
        if lobes.only_tails or is_hard:
            chosen = _both(allowed, rest)
            self.needs_float64[number].append(index if chosen is None else index[chosen])
            return
        for batch in _batches(light, corners, position, lobes.width, rest):
            redo = self._add_polygons(lobes, light, position, batch, allowed, sums[row])
            if redo.any():
                self.needs_float64[number].append(index[batch[0]][redo])

    def _add_polygons(self, lobes, light, position, batch, allowed, total) -> np.ndarray:
        """Add the light, seen as polygons, to `total` (F, 3, Q) for a batch of `_batches`. Returns the mask of the
        columns that need double precision; they get nothing."""
        part, outline, effort = batch
        offset = (light.center[:, None] - light.viewpoint(position[:, part])).astype(np.float32)
        seen, factor = light, 1.0
        if light.is_facing:
            seen, factor = self._seen(light, lobes.index[part], position[:, part])
            factor = factor * seen.gain
            offset, facing = seen.offset, np.ones(offset.shape[1], bool)
        else:
            extent = np.abs(position[:, part]).sum(axis=0)
            toward = dot(offset, light.direction.astype(np.float32))
            facing = toward < -off_plane(light.center, 0.0 if light.is_distant else extent)
        if allowed is not None:
            facing &= allowed[part]
        axes, integrate = lobes.rows[:, :, part], partial(lobes.integrate, part)
        if light.has_profile:
            integrate = ProfiledIntegral(light, effort, offset, axes, integrate, len(lobes.colors))
            axes = integrate.rows
        polygons = local_corners(seen, outline, offset, axes, self.scratch)
        found, redo = integrate_visible(polygons, facing, lobes.clip_rows, len(lobes.colors), integrate)
        if lobes.limits is not None:
            own = LightFromPoints.of_disk(seen) if light.is_facing else LightFromPoints.of(light, offset, toward)
            lobes.limits.apply(found, part, own, self.scratch)
        if light.is_facing:
            found *= factor
        found[:, redo] = 0.0
        for channel in range(3):
            total[:, channel, part] += found * np.float32(light.radiance[channel])
        return redo

    def _add_skies(self, lobes, sums) -> None:
        """Add the light of skies to the `sums` (F, 3, Q) by row."""
        for sky, light, row in self.lights.skies:
            allowed = light.receives(self.samples.receiver, lobes.index)
            chosen = np.arange(len(lobes.index)) if allowed is None else np.nonzero(allowed)[0]
            if lobes.sharpest is None and len(lobes.clip_rows) == 1:
                normals = self.samples.diffuse_normal[lobes.index[chosen]]
                sums[row][0][:, chosen] += interpolated(sky.reflected, normals)
            else:
                sky.add(lobes, chosen, sums[row])

    def _add_far(self, lobes, position, sums) -> dict[int, np.ndarray]:
        """Add the light of trees to the `sums` (F, 3, Q) by row. Returns the columns (Q',) that are left to do, by
        number of the light."""
        left = {}
        for tree, numbers in self.lights.trees:
            light, row, _ = self.lights[numbers[0]]
            allowed = light.receives(self.samples.receiver, lobes.index)
            chosen = np.arange(len(lobes.index)) if allowed is None else np.nonzero(allowed)[0]
            if not len(chosen):
                continue
            columns, own = add_far_lights(tree, lobes, position, chosen, sums[row])
            pairs = columns, np.array(numbers)[own]
            if lobes.only_tails:
                self.pairs_in_float64.append((lobes.index[columns], pairs[1]))
                continue
            rest = np.ones(len(columns), bool)
            for alike in self.lights.alike:
                place = alike.place[pairs[1]]
                chosen = place >= 0
                rest &= ~chosen
                self._add_near(lobes, position, (columns[chosen], place[chosen], alike), sums[row])
            columns, number = (own[rest] for own in pairs)
            for light in np.unique(number):
                left[int(light)] = np.sort(columns[number == light])
        return left

    def _add_near(self, lobes, position, pairs, total) -> None:
        """Add to `total` (F, 3, Q) the light of `pairs`: columns (K,), numbers (K,) of lights, and the AlikeLights."""
        columns, number, lights = pairs
        extent, left = np.abs(position).sum(axis=0), [np.empty(0, np.intp)]
        for piece in moments32.pieces(len(columns), SMALL_CHUNK):
            part, own = columns[piece], number[piece]
            offset = (lights.centers[1][:, own] - position[:, part]).astype(np.float32)
            radius = lights.radius[own]
            rays = small_lights.RaysToCenters.along(offset, lights.area_vector[:, own], lights.diagonal[own])
            size = small_lights.relative_sizes(lobes, part, rays, radius)
            rays = replace(rays, slack=np.float32(small_lights.VARIATION) * size)
            small, lit = small_lights.small_and_lit(lobes, part, rays, radius, size)
            left.append(piece.start + np.nonzero(~small)[0])
            lit = np.nonzero(lit)[0]
            if len(lit):
                _scatter(lobes.at_point(part[lit], rays.take(lit)), part[lit], lights.radiance[:, own[lit]], total)
        left = np.concatenate(left)
        for piece in moments32.pieces(len(left), CORNERS // len(lights.corners)):
            part, own = columns[left[piece]], number[left[piece]]
            if not len(part):
                continue
            center, direction = lights.centers[0][:, own], lights.direction[:, own]
            offset = (center - position[:, part]).astype(np.float32)
            toward = dot(offset, direction)
            facing = toward < -off_plane(center, extent[part])
            axes, integrate = lobes.rows[:, :, part], partial(lobes.integrate, part)
            polygons = local_corners(None, lights.corners[:, :, own], offset, axes, self.scratch)
            found, redo = integrate_visible(polygons, facing, lobes.clip_rows, len(total), integrate)
            if lobes.limits is not None:
                halves = lights.half_u[:, own], lights.half_v[:, own]
                seen = LightFromPoints.of_plain(halves, lights.area_vector[:, own], offset, toward)
                lobes.limits.apply(found, part, seen, self.scratch)
            if redo.any():
                found[:, redo] = 0.0
                self.pairs_in_float64.append((lobes.index[part[redo]], lights.numbers[own[redo]]))
            _scatter(found, part, lights.radiance[:, own], total)

    def _add_small(self, lobes, light, position, among, total) -> np.ndarray | None:
        """Add the light to `total` (F, 3, Q) where it is small, and return the columns that are left, None for all.
        `among` restricts where: columns (Q',), None for all, and a mask (Q,), None for all."""
        columns, allowed = among
        seen, left = small_lights.SmallLight.of(light), []
        count = position.shape[1] if columns is None else len(columns)
        area_vector = seen.area_vector.astype(np.float32)
        origins = light.viewpoint(position)
        for piece in moments32.pieces(count, SMALL_CHUNK):
            part = piece if columns is None else columns[piece]
            offset = (seen.center[:, None] - origins[:, part]).astype(np.float32)
            rays = small_lights.RaysToCenters.along(offset, area_vector, np.float32(seen.diagonal))
            if light.is_facing:
                rays = replace(rays, flux=np.float32(np.linalg.norm(light.area_vector)) * rays.distance)
            size = small_lights.relative_sizes(lobes, part, rays, seen.radius)
            rays = replace(rays, slack=np.float32(small_lights.VARIATION) * size)
            small, lit = small_lights.small_and_lit(lobes, part, rays, seen.radius, size)
            if not small.all():
                left.append(_chosen(part, np.nonzero(~small)[0]))
            if allowed is not None:
                lit &= allowed[part]
            share = np.count_nonzero(lit)
            if share == 0:
                continue
            if share > MOSTLY_WHOLE * len(lit):
                found = lobes.at_point(part, rays)
                if share < len(lit):
                    found = np.where(lit, found, np.float32(0.0))
            else:
                chosen = np.nonzero(lit)[0]
                part = _chosen(part, chosen)
                found = lobes.at_point(part, rays.take(chosen))
            if light.is_facing:
                found = found * self._seen(light, lobes.index[part], position[:, part])[1]
            for channel in range(3):
                total[:, channel, part] += found * np.float32(light.radiance[channel])
        left = np.concatenate(left) if left else np.empty(0, np.intp)
        return None if columns is None and len(left) == count else left

    def _add_points(self, lobes, light, position, among, total) -> np.ndarray:
        """As `_add_small`, for a light with a profile: add it where few points of the light suffice."""
        columns, allowed = among
        columns = np.arange(position.shape[1]) if columns is None else columns
        columns = columns if allowed is None else columns[allowed[columns]]
        left = [columns[:0]]
        for piece in moments32.pieces(len(columns), SMALL_CHUNK):
            part = columns[piece]
            offset = (light.center[:, None] - position[:, part]).astype(np.float32)
            view = light_profile.LightView.of(light, offset, partial(_along_rows, lobes.rows[:, :, part]))
            regions = profile_regions.ProfileRegions(light, view, lobes.clip_rows)
            for count, kind, index in regions.rules():
                if count == 0:
                    left.append(part[index])
                    continue
                for some in moments32.pieces(len(index), POINT_CHUNK // (count * count)):
                    chosen = index[some]
                    s, t, weights = regions.points(count, kind, chosen)
                    found = lobes.at_point.integral(part[chosen], regions.coordinates(s, t, chosen), weights)
                    found *= view.distance[chosen]
                    if lobes.limits is not None:
                        seen = offset[:, chosen]
                        seen = LightFromPoints.of(light, seen, dot(seen, light.direction.astype(np.float32)))
                        lobes.limits.apply(found, part[chosen], seen, self.scratch)
                    for channel in range(3):
                        total[:, channel, part[chosen]] += found * np.float32(light.radiance[channel])
        return np.concatenate(left)

    def _seen(self, light, index, position) -> tuple[FacingDisk, np.ndarray | float]:
        """The FacingDisk as which the samples `index` see a light from `position` (3, Q), and its `mean_emission`."""
        offset, lobe = (light.center[:, None] - position).astype(np.float32), self._lobe(index)
        disk = FacingDisk.of(light, offset, lobe.normal)
        return disk, mean_emission(light, offset, disk, lobe)

    def _lobe(self, index) -> AnalyticLobe:
        """The lobes of the samples `index`, without their colors."""
        samples = self.samples
        if self.shade_in_float64 is float64.shade_diffuse:
            return AnalyticLobe(_columns(samples.diffuse_normal, index))
        alpha = np.maximum(samples.roughness[index].astype(np.float32) ** 2, np.float32(MIN_ALPHA))
        return AnalyticLobe(_columns(samples.normal, index), _columns(samples.view, index), alpha)

    def add_in_float64(self, members) -> None:
        """Add the light of all lights at the samples `members` (Q,)."""
        if len(members) == 0:
            return
        has_patches = any(float64.has_patches(light) for light, _, _ in self.lights)
        if not has_patches and len(members) * len(self.lights) < FLOAT64_CHUNK:
            for (light, _, _), needs_float64 in zip(self.lights, self.needs_float64, strict=True):
                allowed = light.receives(self.samples.receiver, members)
                needs_float64.append(members if allowed is None else members[allowed])
            return
        for start in range(0, len(members), FLOAT64_CHUNK):
            index = members[start : start + FLOAT64_CHUNK]
            target = np.zeros((len(self.radiance), len(index), 3))
            self.shade_in_float64(self.samples.take(index), self.lights, target)
            self.radiance[:, index] += target.astype(np.float32)

    def finish(self, leftovers) -> None:
        """Add what was left to float64, or put it into the list `leftovers`."""
        counts = [sum(map(len, parts)) for parts in self.needs_float64]
        pairs = [own for own in self.pairs_in_float64 if len(own[0])]
        if not any(counts) and not pairs:
            return
        members = [part for parts in self.needs_float64 for part in parts]
        members = np.concatenate([*members, *(own for own, _ in pairs)])
        number = np.concatenate([np.repeat(np.arange(len(counts)), counts), *(own for _, own in pairs)])
        if leftovers is not None and len(members) < FLOAT64_CHUNK:
            leftovers.append((members.astype(np.int32), number.astype(np.int32)))
            return
        row = np.array([row for _, row, _ in self.lights])
        for pairs, found in shade_pairs(self.samples, members, number, self.lights, self.shade_in_float64):
            # A sample may occur with several lights.
            np.add.at(self.radiance, (row[number[pairs]], members[pairs]), found.astype(np.float32))


def shade_pairs(samples, members, number, lights, shade_in_float64):
    """Yield (pairs (Q,), radiance (Q, 3)) of the samples `members` (N,), each under the one light `number` (N,).

    Lights with equally many corners make one batch. Round lights and lights with a profile are shaded one by one,
    because their corners depend on the sample.
    """
    batches: dict[tuple, list[int]] = {}
    for position, (light, _, corners) in enumerate(lights):
        own = (1, position) if light.has_profile or light.is_round else (0, (len(corners), light.is_distant))
        batches.setdefault(own, []).append(position)
    for (alone, _), chosen in sorted(batches.items()):
        among = np.full(len(lights), -1)
        among[chosen] = np.arange(len(chosen))
        of_batch = np.nonzero(among[number] >= 0)[0]
        for start in range(0, len(of_batch), FLOAT64_CHUNK):
            pairs = of_batch[start : start + FLOAT64_CHUNK]
            used, own = np.unique(among[number[pairs]], return_inverse=True)
            items = [lights[chosen[position]] for position in used]
            own = (items[0][0], 0, items[0][2]) if alone else _light_of_each(items, own)
            target = np.zeros((1, len(pairs), 3))
            shade_in_float64(samples.take(members[pairs]), [own], target)
            yield pairs, target[0]


def _light_of_each(items, number):
    """One (light, row, corners) that stands for several with equally many corners, so that sample i sees the light
    `number[i]`."""
    fields = {
        name: np.stack([getattr(light, name) for light, _, _ in items])[number]
        for name in ("center", "direction", "radiance", "half_u", "half_v", "area_vector")
    }
    corners = np.stack([corners for _, _, corners in items])
    distant = items[0][0].is_distant
    return float64.LightOfEachSample(**fields, is_distant=distant), 0, corners[number].transpose(1, 0, 2)


def _scatter(found, columns, radiance, total) -> None:
    """Add integrals (F, K) times radiance (3, K) to `total` (F, 3, Q), at the columns (K,), which may repeat."""
    for own, values in zip(total, found, strict=True):
        for channel in range(3):
            own[channel] += np.bincount(columns, values * radiance[channel], own.shape[1])


def _is_narrow(light, corners) -> bool:
    """True for lights so narrow that the terms of their long edges cancel beyond single precision."""
    sides = corners - corners[0]
    return np.linalg.norm(light.area_vector) < NARROWEST * (sides * sides).sum(axis=1).max()


def _is_in_pieces(light, corners) -> bool:
    """True for lights that `light_levels` cuts into pieces. Double precision must then shade all of the pieces."""
    return light.has_profile and isinstance(light, PolygonLight) and len(convex_pieces(corners)) > 1


def _chosen(part, index):
    """The columns at `index` (Q,) among the columns `part`, a slice or integers."""
    return part.start + index if isinstance(part, slice) else part[index]


def _both(allowed, rest):
    """The columns of `rest` for which the mask `allowed` is True; either may be None, for all."""
    if allowed is None or rest is None:
        return allowed if rest is None else rest
    return rest[allowed[rest]]


def _batches(light, corners, position, width, rest=None):
    """Yield (columns, corners (V, 3), effort) in batches, for the columns `rest` (Q',) of `position` (3, Q), None for
    all. The yielded columns are a slice or integers."""
    if rest is not None:
        position, width = position[:, rest], width if np.ndim(width) == 0 else width[rest]
    for outline, effort, chosen in light_levels(light, corners, position, width):
        if rest is not None:
            chosen = rest if chosen is None else rest[chosen]
        count = position.shape[1] if chosen is None else len(chosen)
        step = max(CORNERS // len(outline), 512)
        for start in range(0, count, step):
            part = slice(start, start + step)
            yield part if chosen is None else chosen[part], outline, effort


def fresnel_kinds(samples, members):
    """Yield (vectors, members, colors): the samples `members` grouped by the Fresnel terms that they need.

    `vectors` are those of `RidgeTable`; colors(index) returns the reflectances (F, 3, Q) of the terms.
    """
    dipped = _any_component(samples.specular_dip)[members]
    metal = (_any_component(samples.specular_f90) | _any_component(samples.specular_f0))[members] | dipped
    flat = ~_any_component(samples.specular_f90 != samples.specular_f0)[members] & ~dipped
    dielectric = _any_component(samples.dielectric)[members]

    def white(index):
        return _columns(samples.specular_f0, index)[None]

    def schlick(index):
        f0 = _columns(samples.specular_f0, index)
        return np.stack([f0, _columns(samples.specular_f90, index) - f0])

    def f82(index):
        return np.concatenate([schlick(index), -_columns(samples.specular_dip, index)[None]])

    def coat(index):
        color = _columns(samples.dielectric, index)
        return np.stack([np.zeros_like(color), color])

    def metal_and_coat(index, first):
        return np.concatenate([first(index), _columns(samples.dielectric, index)[None]])

    yield (0,), members[~dielectric & flat], white
    yield (0, 1), members[~dielectric & ~flat & ~dipped], schlick
    yield (0, 1, 2), members[~dielectric & dipped], f82
    for vector, with_ior in _by_ior(samples.ior, members[dielectric & ~metal]):
        yield (0, vector), with_ior, coat
    for own, chosen in (((0, 1), metal & ~dipped), ((0, 1, 2), dipped)):
        first = f82 if 2 in own else schlick
        for vector, with_ior in _by_ior(samples.ior, members[dielectric & chosen]):
            yield (*own, vector), with_ior, partial(metal_and_coat, first=first)


def _by_ior(ior, members):
    """Yield (vector, members): the dielectric's weight vector of the samples. There is one per index of refraction if
    there are few of these."""
    values = ior[members]
    if len(members) == 0:
        return
    if values.min() == values.max():
        yield ("dielectric", float(values[0])), members
        return
    distinct, number = np.unique(values, return_inverse=True)
    if len(distinct) > SEPARATE_IORS:
        yield "dielectric", members
        return
    for position, value in enumerate(distinct):
        yield ("dielectric", float(value)), members[number == position]


def _normal_frame(normal):
    """Frames (3, 3, P) around normals (3, P), with an arbitrary tangent (Duff et al. 2017)."""
    x, y, z = normal
    sign = np.copysign(np.float32(1.0), z)
    a = np.float32(-1.0) / (sign + z)
    b = x * y * a
    tangent = np.stack([np.float32(1.0) + sign * x * x * a, sign * b, -sign * x])
    return np.stack([tangent, np.stack([b, sign + y * y * a, -y]), normal])


def _lobe_rows(samples, index, axes, ridges, vectors, scratch):
    """Axes (C, 3, Q) of the warped local frames, the numbers of the coordinates to clip, and the weights (F, K, Q), for
    samples with the normals and views `axes`."""
    normal, view = axes
    cosine = dot(normal, view)
    # Differences of close vectors are exact, so nothing of this one runs along the normal.
    tangent = view - normal
    tangent -= dot(normal, tangent) * normal
    sine = np.sqrt(dot(tangent, tangent))
    straight = np.nonzero(sine < 1e-6)[0]
    if len(straight):
        # The lobe is round there, so any tangent serves.
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


def _any_component(vectors):
    """Mask (P,) of the vectors (P, 3) with an element other than 0; numpy's own reduction of short rows is slow."""
    return (vectors[:, 0] != 0) | (vectors[:, 1] != 0) | (vectors[:, 2] != 0)


def _columns(vectors, index):
    """Rows `index` of vectors (P, 3) as (3, Q) float32."""
    return np.ascontiguousarray(vectors[index].T, dtype=np.float32)


def _selected(values, part, index):
    """Values (..., Q) at the columns `index` (None: all) of the slice `part` of columns."""
    values = values[..., part]
    return values if index is None else np.take(values, index, axis=-1)


class FormFactor:
    """Form factors (1, Q) of polygons whose corners run counterclockwise as seen from the point
    (`Light.polygon`)."""

    def __init__(self, scratch):
        self.scratch = scratch

    def __call__(self, part, corners, index, smallest=moments32.SMALLEST_SAFE):
        integral, needs_float64 = moments32.cosine_integral(corners, self.scratch, smallest)
        integral *= np.float32(-1.0 / np.pi)
        return np.maximum(integral, np.float32(0.0))[None], needs_float64


class ShadowedFormFactor:
    """Form factors (1, Q) times the bump shadowing of `SurfaceSamples` in the mean direction of the polygon."""

    def __init__(self, rows, bump_alpha2, scratch):
        self.smooth = np.stack([dot(row, rows[3]) for row in rows[:3]])
        self.bump_alpha2, self.scratch = bump_alpha2, scratch

    def __call__(self, part, corners, index, smallest=moments32.SMALLEST_SAFE):
        smooth, bump_alpha2 = (_selected(values, part, index) for values in (self.smooth, self.bump_alpha2))
        integrals, needs_float64 = moments32.vector_irradiance(corners, self.scratch, smallest)
        direction = np.negative(integrals, out=integrals)
        along = np.maximum(dot(direction, smooth), np.float32(1e-15))
        tangent2 = np.maximum(dot(direction, direction) / (along * along) - np.float32(1.0), np.float32(0.0))
        shadowing = np.float32(2.0) / (np.float32(1.0) + np.sqrt(np.float32(1.0) + bump_alpha2 * tangent2))
        values = np.maximum(direction[2], np.float32(0.0)) * shadowing * np.float32(1.0 / np.pi)
        return values[None], needs_float64


class LobeIntegral:
    """Integrals (F, Q) of lobes with F weight vectors over polygons, never negative. Winding is as in `FormFactor`.

    The first integral is the one for F = 1.
    """

    def __init__(self, ridges, weights, scratch):
        self.ridges, self.weights, self.scratch = ridges, weights, scratch

    def __call__(self, part, corners, index, smallest=moments32.SMALLEST_SAFE):
        weights = _selected(self.weights, part, index)
        values, _, cosine, needs_float64 = self.ridges.integrals(corners, weights, self.scratch, smallest)
        np.negative(values, out=values)
        np.maximum(values, np.float32(0.0), out=values)
        np.maximum(values[0], np.float32(-LEAST_SHARE) * cosine, out=values[0])
        return values, needs_float64


class ProfiledIntegral:
    """Integrals (F, Q) over polygons times the profile of the light, as sums of integrals over parts of the light.

    The polygons need the coordinates along `rows`: those along `axes` (C, 3, P), then two in the light's plane.
    """

    def __init__(self, light, effort, offset, axes, integrate, count):
        self.effort, self.integrate, self.count = effort, integrate, count
        self.profile = light_profile.Profile.of(light)
        self.view = light_profile.LightView.of(light, offset, partial(_along_rows, axes))
        plane = light_profile.plane_axes(light).astype(np.float32)[:, :, None]
        self.rows = np.concatenate([axes, np.broadcast_to(plane, (2, 3, axes.shape[2]))])

    def __call__(self, corners, index):
        index = np.arange(corners.shape[2]) if index is None else index
        values = np.zeros((self.count, len(index)), np.float32)
        needs_float64 = np.zeros(len(index), bool)
        step = max(CORNERS // (corners.shape[1] * (2 * self.effort.chords + 1)), 512)
        for start in range(0, len(index), step):
            part = slice(start, start + step)
            flat, view = corners[-2:, :, part], self.view.take(index[part])
            layers = light_profile.layers(view, flat, self.profile, self.effort)
            for number, (near, weights, polygons) in enumerate(layers):
                # Small disks count little, so the rounding of their edges is lost in the sum.
                smallest = 0.0 if number < self.effort.layers - 1 else moments32.SMALLEST_SAFE
                found, redo = self.integrate(polygons, index[part][near], smallest=smallest)
                values[:, start + near] += weights * found
                needs_float64[start + near] |= redo
        return values, needs_float64


def _along_rows(axes, vector):
    """Products (C, P) of rows (C, 3, P) with a vector (3,)."""
    x, y, z = vector.astype(np.float32)
    return x * axes[:, 0] + y * axes[:, 1] + z * axes[:, 2]
