"""The fast path of `shade`: lights, lookups and edge sums in float32, in chunks that fit the cache.

`lobes32` has the lobes, whose frames are made once for all lights. `float64` shades what single precision cannot:
points so close to a light's plane that an edge spans half a circle, tiny lights, and sharp lobes.
"""

from dataclasses import replace
from functools import partial

import numpy as np

from ..emitters import light_profile, profile_regions, small_lights
from ..emitters.facing import AnalyticLobe, FacingDisk, mean_emission
from ..emitters.light_polygons import light_levels, local_corners, may_reach, off_plane
from ..emitters.light_tree import add_far_lights
from ..emitters.tails import LightFromPoints, TailLimits
from ..lobes import moments32
from ..lobes.lobe_integrals import FLOAT64_CHUNK, NARROWEST
from ..lobes.lookup_table import MIN_ALPHA
from ..lobes.polygon import MOSTLY_WHOLE, convex_pieces, dot, integrate_visible, normal_frames
from ..scene import PolygonLight
from . import float64, lobes32
from .lights32 import Lights

# Samples per chunk for small lights.
SMALL_CHUNK = 6144
# Points per chunk for lights with a profile.
POINT_CHUNK = 40960
# Points per chunk that see bodies as outlines.
OUTLINED_CHUNK = 4096
# In rad. Lights with a narrower cone are too bright for the absolute error of single precision.
NARROW_SPREAD = 0.35


def shade_diffuse(samples, lights, radiance, scratch):
    """Add to `radiance` (R, P, 3) what the diffuse lobes of `samples` reflect of `lights`, (light, row, corners).

    Returns the numbers (M,) of the samples that are shaded in double precision, without the `leaves` of `lights`.
    """
    lights = Lights.of(lights, "diffuse")
    lit = np.nonzero(lobes32.any_component(samples.diffuse_albedo))[0]
    bumped = np.zeros(len(lit), bool)
    if samples.diffuse_normal is not samples.smooth_normal:
        bumped = lobes32.any_component(samples.diffuse_normal != samples.smooth_normal)[lit]
    lighting = _Lighting(samples, lights, radiance, scratch, float64.shade_diffuse)
    shaped = ((samples.sheen_a != 0.0) | (samples.diffuse_roughness != 0.0))[lit]
    in_float64 = lit[shaped]
    lighting.add_in_float64(in_float64)
    lit, bumped = lit[~shaped], bumped[~shaped]
    for is_bumped, members in ((False, lit[~bumped]), (True, lit[bumped])):
        for index in _chunks(members):
            rows = normal_frames(lobes32.as_columns(samples.diffuse_normal, index))
            clip_rows, integrate, at_point = (2,), lobes32.FormFactor(scratch), small_lights.CosineAtPoint(rows)
            if is_bumped:
                smooth, bump_alpha2 = lobes32.as_columns(samples.smooth_normal, index), samples.bump_alpha2[index]
                rows, clip_rows = np.stack([*lobes32.frames_toward(rows[2], smooth)[0], smooth]), (3, 2)
                integrate = lobes32.ShadowedFormFactor(rows, bump_alpha2.astype(np.float32), scratch)
                at_point = small_lights.ShadowedCosineAtPoint(rows, bump_alpha2.astype(np.float32))
            colors = lobes32.as_columns(samples.diffuse_albedo, index)[None]
            others = (samples.bump_alpha2[index],) if is_bumped else ()
            whole = None if is_bumped else np.ones((1, len(index)), np.float32)
            lobes = lobes32.Lobes(index, rows, clip_rows, integrate, at_point, colors, 1.0, others=others, whole=whole)
            lighting.add(lobes)
    lighting.finish()
    return in_float64


def shade_specular(samples, lights, table, radiance, scratch):
    """As `shade_diffuse`, for the specular lobes of `table`."""
    lights = Lights.of(lights, "specular")
    ridges = moments32.prepare(table)
    terms = (samples.specular_f90, samples.specular_f0, samples.specular_dip, samples.dielectric)
    reflective = np.logical_or.reduce([lobes32.any_component(term) for term in terms])
    lit = reflective & (dot(samples.normal.T, samples.view.T) > 0.0)
    sharp = lit & ((samples.roughness < moments32.SHARP_ROUGHNESS) | float64.has_bent_fresnel(samples))
    anisotropic = lit & (samples.anisotropy != 0.0)

    lighting = _Lighting(samples, lights, radiance, scratch, partial(float64.shade_specular, table=table))
    far = sharp & False
    if table.family == "ltsh":
        far = sharp & ~anisotropic
    sharp = (sharp | anisotropic) & ~far
    for only_tails, chosen in ((False, lit & ~sharp & ~far), (True, far)):
        for vectors, members, colors_of in lobes32.fresnel_kinds(samples, np.nonzero(chosen)[0]):
            for index in _chunks(members):
                lobes = _specular_lobes(samples, index, (table, ridges, vectors), colors_of(index), scratch)
                whole = _albedos(samples, index, table, vectors) if lights.whole_skies else None
                lighting.add(replace(lobes, only_tails=only_tails, whole=whole))
    in_float64 = np.nonzero(sharp)[0]
    by_map = anisotropic if lights.whole_skies else sharp & False
    for sky, light, row, _ in lights.whole_skies:
        allowed = light.receives(samples.receiver)
        index = np.nonzero(by_map if allowed is None else by_map & allowed)[0]
        lobes32.add_specular_of_sky(sky, samples, index, radiance[row], table)
    lighting.add_in_float64(np.nonzero(sharp & ~by_map)[0])
    lighting.add_in_float64(np.nonzero(by_map)[0], {number for *_, numbers in lights.whole_skies for number in numbers})
    lighting.finish()
    return in_float64


def _specular_lobes(samples, index, kind, colors, scratch) -> lobes32.Lobes:
    """The specular lobes of the samples `index` (Q,) with `colors` (F, 3, Q). `kind` is a table, its `RidgeTable`, and
    the Fresnel terms as `fresnel_kinds` yields them."""
    table, ridges, vectors = kind
    axes = lobes32.as_columns(samples.normal, index), lobes32.as_columns(samples.view, index)
    rows, clip_rows, weights = lobes32.lobe_axes(samples, index, axes, ridges, vectors, scratch)
    integrate, width = lobes32.LobeIntegral(ridges, weights, scratch), float64.lobe_width(samples, index)
    limits = None
    if table.family == "ltsh":
        ior = None if isinstance(vectors[-1], int) else samples.ior[index]
        second = rows[clip_rows[0]] if len(clip_rows) > 1 else None
        limits = TailLimits.of(axes, samples.roughness[index], second, 1 in vectors, ior)
    at_point = small_lights.LobeAtPoint(rows, weights, table, limits)
    sharpest = small_lights.SharpestLobes(*axes, width)
    others = samples.roughness[index], samples.ior[index]
    return lobes32.Lobes(index, rows, clip_rows, integrate, at_point, colors, width, limits, sharpest, others=others)


def _albedos(samples, index, table, vectors) -> np.ndarray:
    """`Lobes.whole` (F, Q) of the specular lobes of the samples `index` (Q,)."""
    normal, view = samples.normal[index], samples.view[index]
    albedos = table.albedos((normal * view).sum(axis=1), samples.roughness[index])
    dielectric = (table.dielectric_weights(samples.ior[index]) * albedos).sum(axis=0)
    whole = np.stack([albedos[one] if isinstance(one, int) else dielectric for one in vectors]).astype(np.float32)
    has_two = (normal != samples.geometric_normal[index]).any(axis=1)
    whole[:, has_two | float64.has_bent_fresnel(samples)[index]] = np.nan
    return whole


def _chunks(members):
    return (members[piece] for piece in moments32.pieces(len(members), lobes32.CHUNK))


def shade_skies(samples, lights, table, radiance) -> None:
    """Add to `radiance`, (R, P, 3) by pass, what `samples` reflect of `Lights.skies`; `lights` has them by pass."""
    adds = {"diffuse": lobes32.add_diffuse_of_sky, "specular": partial(lobes32.add_specular_of_sky, table=table)}
    for name, add in adds.items():
        for sky, light, row in lights[name].skies if name in radiance else ():
            allowed = light.receives(samples.receiver)
            index = np.arange(len(samples)) if allowed is None else np.nonzero(allowed)[0]
            add(sky, samples, index, radiance[name][row])


class _Lighting:
    """Adds the light of `lights` at `samples` to `radiance` (R, P, 3). shade_in_float64(samples, lights, radiance=)
    shades points that need double precision."""

    def __init__(self, samples, lights, radiance, scratch, shade_in_float64):
        self.samples, self.lights, self.radiance, self.scratch = samples, lights, radiance, scratch
        self.shade_in_float64 = shade_in_float64
        self.needs_float64 = [[] for _ in lights]  # indices of samples, per light
        self.pairs_in_float64: list[tuple] = []  # the same as pairs (K,) of a sample and a light
        self.outlined_in_float64: list[tuple] = []  # indices (K,) of samples, a body, and the positions of its lights

    def add(self, lobes: lobes32.Lobes) -> None:
        """Add the light that `lobes` reflect."""
        index, colors = lobes.index, lobes.colors
        position = np.ascontiguousarray(self.samples.position[index].T)
        sums = {row: np.zeros((len(colors), 3, len(index)), np.float32) for row in {row for _, row, _ in self.lights}}
        remaining = self._add_far(lobes, position, sums) | self._add_whole_skies(lobes, sums)
        for number in sorted({*self.lights.alone, *remaining}):
            if (columns := remaining.get(number)) is None or len(columns):
                self._add_light(lobes, number, position, columns, sums)
        signed = (colors < 0.0).any()
        for row, total in sums.items():
            reflected = (colors * total).sum(axis=0)
            if signed and all((light.radiance >= 0.0).all() for light, its, _ in self.lights if its == row):
                # Terms that cancel in the Fresnel factor may leave a rest below zero.
                np.maximum(reflected, np.float32(0.0), out=reflected)
            self.radiance[row, index] += reflected.T

    def _add_whole_skies(self, lobes, sums) -> dict[int, np.ndarray]:
        """Add the skies of one radiance. Returns, by light, the columns (Q',) of the lobes that have two horizons."""
        remaining: dict[int, np.ndarray] = {}
        for sky, light, row, numbers in self.lights.whole_skies if lobes.whole is not None else ():
            is_whole = np.isfinite(lobes.whole[0])
            if sky.is_constant and light.receivers is None and (is_whole.all() or not lobes.only_tails):
                whole = np.where(is_whole, lobes.whole, np.float32(0.0))
                sums[row] += whole[:, None] * light.radiance.astype(np.float32)[:, None]
                remaining |= dict.fromkeys(numbers, np.flatnonzero(~is_whole))
        return remaining

    def _add_light(self, lobes, number, position, columns, sums) -> None:
        """Add one light to the `sums` (F, 3, Q) by row, at the `columns` (Q',), None for all."""
        (light, row, corners), index = self.lights[number], lobes.index
        allowed = light.receives(self.samples.receiver, index)
        if light.has_spread or light.cone is not None:
            near = may_reach(light, position)
            allowed = near if allowed is None else allowed & near
        # Terms of the long edges of narrow lights cancel, and all pieces of a light need the same precision.
        is_narrow = np.linalg.norm(light.area_vector) < NARROWEST * np.square(corners - corners[0]).sum(axis=1).max()
        is_hard = light.spread < NARROW_SPREAD or is_narrow
        if light.has_profile and isinstance(light, PolygonLight):
            is_hard |= len(convex_pieces(corners)) > 1
        if lobes.only_tails and not (is_hard or light.has_profile):
            tail = lobes.sharpest.are_tails(light, position) & ~float64.has_bent_fresnel(self.samples)[index]
            self.needs_float64[number].append(index[~tail if allowed is None else ~tail & allowed])
            columns = np.nonzero(tail)[0]
        rest = columns
        if not (lobes.only_tails and columns is None):
            if not light.has_profile:
                rest = self._add_small(lobes, light, position, (columns, allowed), sums[row])
            elif profile_regions.ProfileRegions.suit(light):
                rest = self._add_points(lobes, light, position, (columns, allowed), sums[row])
            if rest is not None and len(rest) == 0:
                return
        if is_hard or (lobes.only_tails and columns is None):
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
        columns, outline, effort = batch
        offset = (light.center[:, None] - light.viewpoint(position[:, columns])).astype(np.float32)
        outline_light, factor = light, 1.0
        if light.is_facing:
            outline_light, factor = self._seen(light, lobes.index[columns], position[:, columns])
            factor = factor * outline_light.gain
            offset, facing = outline_light.offset, np.ones(offset.shape[1], bool)
        else:
            extent = np.abs(position[:, columns]).sum(axis=0)
            toward = dot(offset, light.direction.astype(np.float32))
            facing = toward < -off_plane(light.center, 0.0 if light.is_distant else extent)
        if allowed is not None:
            facing &= allowed[columns]
        axes, integrate = lobes.rows[:, :, columns], partial(lobes.integrate, columns)
        if light.has_profile:
            integrate = lobes32.ProfiledIntegral(light, effort, offset, axes, integrate, len(lobes.colors))
            axes = integrate.rows
        polygons = local_corners(outline_light, outline, offset, axes, self.scratch)
        integrals, redo = integrate_visible(polygons, facing, lobes.clip_rows, len(lobes.colors), integrate)
        if lobes.limits is not None:
            if light.is_facing:
                light_from_points = LightFromPoints.of_disk(outline_light)
            else:
                light_from_points = LightFromPoints.of(light, offset, toward)
            lobes.limits.apply(integrals, columns, light_from_points, self.scratch)
        if light.is_facing:
            integrals *= factor
        integrals[:, redo] = 0.0
        for channel in range(3):
            total[:, channel, columns] += integrals * np.float32(light.radiance[channel])
        return redo

    def _add_far(self, lobes, position, sums) -> dict[int, np.ndarray]:
        """Add the light of trees to the `sums` (F, 3, Q) by row. Returns the columns (Q',) that are left to do, by
        number of the light."""
        remaining = {}
        for tree, numbers in self.lights.trees:
            light, row, _ = self.lights[numbers[0]]
            allowed = light.receives(self.samples.receiver, lobes.index)
            chosen = np.arange(len(lobes.index)) if allowed is None else np.nonzero(allowed)[0]
            if not len(chosen):
                continue
            (columns, light_number), outlined = add_far_lights(tree, lobes, position, chosen, sums[row])
            pairs = [(columns, numbers[light_number])]
            for number in np.unique(outlined[1]):
                body, columns = tree.bodies[number], outlined[0][outlined[1] == number]
                if lobes.only_tails:
                    self.outlined_in_float64.append((lobes.index[columns], body, numbers[body.numbers]))
                    continue
                rest = self._add_outlines(lobes, position, (columns, body), light.radiance, sums[row])
                pairs.append(_all_pairs(rest, numbers[body.numbers]))
            pairs = tuple(np.concatenate(values) for values in zip(*pairs, strict=True))
            if lobes.only_tails:
                self.pairs_in_float64.append((lobes.index[pairs[0]], pairs[1]))
                continue
            columns = pairs[0]
            rest = np.ones(len(columns), bool)
            for alike in self.lights.alike:
                column = alike.column[pairs[1]]
                chosen = column >= 0
                rest &= ~chosen
                self._add_near(lobes, position, (columns[chosen], column[chosen], alike), sums[row])
            columns, number = (values[rest] for values in pairs)
            for light in np.unique(number):
                remaining[int(light)] = np.sort(columns[number == light])
        return remaining

    def _add_outlines(self, lobes, position, among, radiance, total) -> np.ndarray:
        """Add to `total` (F, 3, Q) the light of a body where it is seen as an outline. `among` is columns (K,) and the
        body. Returns the columns (K',) for which this does not suffice."""
        columns, body = among
        rest = [columns[:0]]
        for piece in moments32.pieces(len(columns), OUTLINED_CHUNK):
            some, is_seen = columns[piece], np.zeros(len(columns[piece]), bool)
            width = lobes.width if np.ndim(lobes.width) == 0 else lobes.width[some]
            for seen in body.outlines(position[:, some], width):
                batch, facing = some[seen.points], np.ones(len(seen.points), bool)
                axes, integrate = lobes.rows[:, :, batch], partial(lobes.integrate, batch)
                polygons = local_corners(None, seen.corners, seen.offset, axes, self.scratch)
                integrals, redo = integrate_visible(polygons, facing, lobes.clip_rows, len(total), integrate)
                if lobes.limits is not None:
                    toward, halves = dot(seen.offset, seen.direction), (seen.half_u, seen.half_v)
                    light = LightFromPoints.of_plain(halves, seen.area * seen.direction, seen.offset, toward)
                    lobes.limits.apply(integrals, batch, light, self.scratch)
                integrals[:, redo] = 0.0
                is_seen[seen.points] = ~redo
                for channel in range(3):
                    total[:, channel, batch] += integrals * np.float32(radiance[channel])
            rest.append(some[~is_seen])
        return np.concatenate(rest)

    def _add_near(self, lobes, position, pairs, total) -> None:
        """Add to `total` (F, 3, Q) the light of `pairs`: columns (K,), numbers (K,) of lights, and the AlikeLights."""
        columns, number, lights = pairs
        extent, remaining = np.abs(position).sum(axis=0), [np.empty(0, np.intp)]
        for piece in moments32.pieces(len(columns), SMALL_CHUNK):
            batch, light_column = columns[piece], number[piece]
            offset = (lights.centers[1][:, light_column] - position[:, batch]).astype(np.float32)
            radius = lights.radius[light_column]
            area_vector, diagonal = lights.area_vector[:, light_column], lights.diagonal[light_column]
            rays = small_lights.RaysToCenters.along(offset, area_vector, diagonal)
            size = small_lights.relative_sizes(lobes, batch, rays, radius)
            rays = replace(rays, slack=np.float32(small_lights.VARIATION) * size)
            small, lit = small_lights.small_and_lit(lobes, batch, rays, radius, size)
            remaining.append(piece.start + np.nonzero(~small)[0])
            lit = np.nonzero(lit)[0]
            if len(lit):
                radiance = lights.radiance[:, light_column[lit]]
                _scatter(lobes.at_point(batch[lit], rays.take(lit)), batch[lit], radiance, total)
        remaining = np.concatenate(remaining)
        for piece in moments32.pieces(len(remaining), lobes32.CORNERS // len(lights.corners)):
            batch, light_column = columns[remaining[piece]], number[remaining[piece]]
            if not len(batch):
                continue
            center, direction = lights.centers[0][:, light_column], lights.direction[:, light_column]
            offset = (center - position[:, batch]).astype(np.float32)
            toward = dot(offset, direction)
            facing = toward < -off_plane(center, extent[batch])
            axes, integrate = lobes.rows[:, :, batch], partial(lobes.integrate, batch)
            polygons = local_corners(None, lights.corners[:, :, light_column], offset, axes, self.scratch)
            integrals, redo = integrate_visible(polygons, facing, lobes.clip_rows, len(total), integrate)
            if lobes.limits is not None:
                halves = lights.half_u[:, light_column], lights.half_v[:, light_column]
                light_from_points = LightFromPoints.of_plain(
                    halves, lights.area_vector[:, light_column], offset, toward
                )
                lobes.limits.apply(integrals, batch, light_from_points, self.scratch)
            if redo.any():
                integrals[:, redo] = 0.0
                self.pairs_in_float64.append((lobes.index[batch[redo]], lights.numbers[light_column[redo]]))
            _scatter(integrals, batch, lights.radiance[:, light_column], total)

    def _add_small(self, lobes, light, position, among, total) -> np.ndarray | None:
        """Add the light to `total` (F, 3, Q) where it is small, and return the columns that are left, None for all.
        `among` restricts where: columns (Q',), None for all, and a mask (Q,), None for all."""
        columns, allowed = among
        small_light, remaining = small_lights.SmallLight.of(light), []
        count = position.shape[1] if columns is None else len(columns)
        area_vector = small_light.area_vector.astype(np.float32)
        origins = light.viewpoint(position)
        for piece in moments32.pieces(count, SMALL_CHUNK):
            batch = piece if columns is None else columns[piece]
            offset = (small_light.center[:, None] - origins[:, batch]).astype(np.float32)
            rays = small_lights.RaysToCenters.along(offset, area_vector, np.float32(small_light.diagonal))
            if light.is_facing:
                rays = replace(rays, flux=np.float32(np.linalg.norm(light.area_vector)) * rays.distance)
            size = small_lights.relative_sizes(lobes, batch, rays, small_light.radius)
            rays = replace(rays, slack=np.float32(small_lights.VARIATION) * size)
            small, lit = small_lights.small_and_lit(lobes, batch, rays, small_light.radius, size)
            if not small.all():
                remaining.append(_chosen(batch, np.nonzero(~small)[0]))
            if allowed is not None:
                lit &= allowed[batch]
            share = np.count_nonzero(lit)
            if share == 0:
                continue
            if share > MOSTLY_WHOLE * len(lit):
                integrals = lobes.at_point(batch, rays)
                if share < len(lit):
                    integrals = np.where(lit, integrals, np.float32(0.0))
            else:
                chosen = np.nonzero(lit)[0]
                batch = _chosen(batch, chosen)
                integrals = lobes.at_point(batch, rays.take(chosen))
            if light.is_facing:
                integrals = integrals * self._seen(light, lobes.index[batch], position[:, batch])[1]
            for channel in range(3):
                total[:, channel, batch] += integrals * np.float32(light.radiance[channel])
        remaining = np.concatenate(remaining) if remaining else np.empty(0, np.intp)
        return None if columns is None and len(remaining) == count else remaining

    def _add_points(self, lobes, light, position, among, total) -> np.ndarray:
        """As `_add_small`, for a light with a profile: add it where few points of the light suffice."""
        columns, allowed = among
        columns = np.arange(position.shape[1]) if columns is None else columns
        columns = columns if allowed is None else columns[allowed[columns]]
        remaining = [columns[:0]]
        for piece in moments32.pieces(len(columns), SMALL_CHUNK):
            batch = columns[piece]
            offset = (light.center[:, None] - position[:, batch]).astype(np.float32)
            view = light_profile.LightView.of(light, offset, partial(lobes32.along_axes, lobes.rows[:, :, batch]))
            regions = profile_regions.ProfileRegions(light, view, lobes.clip_rows)
            for count, kind, index in regions.rules():
                if count == 0:
                    remaining.append(batch[index])
                    continue
                for some in moments32.pieces(len(index), POINT_CHUNK // (count * count)):
                    chosen = index[some]
                    s, t, weights = regions.points(count, kind, chosen)
                    integrals = lobes.at_point.integral(batch[chosen], regions.coordinates(s, t, chosen), weights)
                    integrals *= view.distance[chosen]
                    if lobes.limits is not None:
                        toward = dot(offset[:, chosen], light.direction.astype(np.float32))
                        light_from_points = LightFromPoints.of(light, offset[:, chosen], toward)
                        lobes.limits.apply(integrals, batch[chosen], light_from_points, self.scratch)
                    for channel in range(3):
                        total[:, channel, batch[chosen]] += integrals * np.float32(light.radiance[channel])
        return np.concatenate(remaining)

    def _seen(self, light, index, position) -> tuple[FacingDisk, np.ndarray | float]:
        """The FacingDisk as which the samples `index` see a light from `position` (3, Q), and its `mean_emission`."""
        offset, lobe = (light.center[:, None] - position).astype(np.float32), self._lobe(index)
        disk = FacingDisk.of(light, offset, lobe.normal)
        return disk, mean_emission(light, offset, disk, lobe)

    def _lobe(self, index) -> AnalyticLobe:
        """The lobes of the samples `index`, without their colors."""
        samples = self.samples
        if self.shade_in_float64 is float64.shade_diffuse:
            return AnalyticLobe(lobes32.as_columns(samples.diffuse_normal, index))
        alpha = np.maximum(samples.roughness[index].astype(np.float32) ** 2, np.float32(MIN_ALPHA))
        return AnalyticLobe(lobes32.as_columns(samples.normal, index), lobes32.as_columns(samples.view, index), alpha)

    def add_in_float64(self, members, without=()) -> None:
        """Add the light of all lights but leaves, and but those `without`, at the samples `members` (Q,)."""
        if len(members) == 0:
            return
        without = {*without}
        for body, numbers in self.lights.bodies:
            light = self.lights[numbers[0]][0]
            allowed = light.receives(self.samples.receiver, members)
            self.outlined_in_float64.append((members if allowed is None else members[allowed], body, numbers))
            without.update(numbers.tolist())
        numbers = [number for number in range(len(self.lights) - self.lights.leaf_count) if number not in without]
        if len(members) * len(numbers) < FLOAT64_CHUNK:
            for number in numbers:
                allowed = self.lights[number][0].receives(self.samples.receiver, members)
                self.needs_float64[number].append(members if allowed is None else members[allowed])
            return
        lights = [self.lights[number] for number in numbers]
        for start in range(0, len(members), FLOAT64_CHUNK):
            index = members[start : start + FLOAT64_CHUNK]
            target = np.zeros((len(self.radiance), len(index), 3))
            self.shade_in_float64(self.samples.take(index), lights, radiance=target)
            self.radiance[:, index] += target.astype(np.float32)

    def finish(self) -> None:
        """Add what was left to float64."""
        for members, body, numbers in self.outlined_in_float64:
            rest = self._add_outlines_in_float64(members, body, self.lights[numbers[0]])
            self.pairs_in_float64.append(_all_pairs(rest, numbers))
        counts = [sum(map(len, parts)) for parts in self.needs_float64]
        pairs = [pair for pair in self.pairs_in_float64 if len(pair[0])]
        if not any(counts) and not pairs:
            return
        members = [indices for of_light in self.needs_float64 for indices in of_light]
        members = np.concatenate([*members, *(indices for indices, _ in pairs)])
        number = np.concatenate([np.repeat(np.arange(len(counts)), counts), *(numbers for _, numbers in pairs)])
        row = np.array([row for _, row, _ in self.lights])
        for pairs, values in float64.shade_pairs(self.samples, members, number, self.lights, self.shade_in_float64):
            # A sample may occur with several lights.
            np.add.at(self.radiance, (row[number[pairs]], members[pairs]), values.astype(np.float32))

    def _add_outlines_in_float64(self, members, body, light) -> np.ndarray:
        """Add the light of a body, of which `light` is one, at the samples `members` (K,) that see it as an outline.
        Returns the others."""
        rest = [members[:0]]
        specular = self.shade_in_float64 is not float64.shade_diffuse
        for piece in moments32.pieces(len(members), FLOAT64_CHUNK):
            chosen, is_seen = members[piece], np.zeros(len(members[piece]), bool)
            width = float64.lobe_width(self.samples, chosen) if specular else 1.0
            for seen in body.outlines(np.ascontiguousarray(self.samples.position[chosen].T), width):
                index, target = chosen[seen.points], np.zeros((1, len(seen.points), 3))
                samples = self.samples.take(index)
                outlined = float64.outlined_light(seen, samples.position, light[0].radiance)
                self.shade_in_float64(samples, [outlined], radiance=target)
                self.radiance[light[1], index] += target[0].astype(np.float32)
                is_seen[seen.points] = True
            rest.append(chosen[~is_seen])
        return np.concatenate(rest)


def _all_pairs(columns, numbers) -> tuple[np.ndarray, np.ndarray]:
    """Pairs (K,) of all columns with all numbers."""
    return np.repeat(columns, len(numbers)), np.tile(numbers, len(columns))


def _scatter(integrals, columns, radiance, total) -> None:
    """Add integrals (F, K) times radiance (3, K) to `total` (F, 3, Q), at the columns (K,), which may repeat."""
    for sums, values in zip(total, integrals, strict=True):
        for channel in range(3):
            sums[channel] += np.bincount(columns, values * radiance[channel], sums.shape[1])


def _chosen(columns, index):
    """The columns at `index` (Q,) among the columns `part`, a slice or integers."""
    return columns.start + index if isinstance(columns, slice) else columns[index]


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
        step = max(lobes32.CORNERS // len(outline), 512)
        for start in range(0, count, step):
            batch = slice(start, start + step)
            yield batch if chosen is None else chosen[batch], outline, effort
