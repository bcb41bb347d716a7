"""Shading in double precision: exact polygons, any degree, and the reference quadrature.

`float32` is the fast path; it leaves the points for which it is not accurate to this module.
"""

from dataclasses import dataclass, replace
from itertools import chain

import numpy as np

from ..emitters import facing, light_profile
from ..emitters.facing import FacingDisk
from ..emitters.light_polygons import LocalFrames, PatchTree, has_lobe, light_view, to_local, visible_polygons_by_level
from ..emitters.tails import LightFromPoints, TailLimits
from ..lobes import brdf, diffuse, lobe_integrals
from ..lobes.edge_integrals import arc_factors, shadowed_integral, shadowing_terms
from ..lobes.lookup_table import MIN_ALPHA, Lobe, LookupTable
from ..lobes.polygon import dot, edge_sums, one_plus_cosine
from ..lobes.spherical_harmonics import coefficient_index
from ..scene import REFERENCE, PolygonLight
from .reference import anisotropic_integrals, reference_integrals

# Where a Fresnel curve with a step is looked up: at these shares of the way from a light's center to its corners.
POINTS_TO_CORNERS = (0.2, 0.5, 0.8)
# Least roughness in the choice of the effort for a lobe.
LEAST_ROUGHNESS = 1e-3
# Coefficient of Y_10 for z / pi
_COSINE = 2.0 / np.sqrt(3.0 * np.pi)


@dataclass(frozen=True)
class LightOfEachSample:
    """One light per sample, used instead of one `Light` for all. Its corners are (V, P, 3)."""

    center: np.ndarray  # (P, 3)
    direction: np.ndarray  # (P, 3)
    radiance: np.ndarray  # (P, 3)
    half_u: np.ndarray  # (P, 3)
    half_v: np.ndarray  # (P, 3)
    area_vector: np.ndarray  # (P, 3)
    affects_diffuse: bool = True
    affects_specular: bool = True
    has_spread: bool = False
    has_profile: bool = False
    is_round: bool = False
    is_distant: bool = False
    is_facing: bool = False
    has_falloff: bool = False
    children: tuple = ()

    def take(self, index) -> "LightOfEachSample":
        """The lights of the samples `index`."""
        names = ("center", "direction", "radiance", "half_u", "half_v", "area_vector")
        return replace(self, **{name: getattr(self, name)[index] for name in names})

    def viewpoint(self, position: np.ndarray) -> np.ndarray:
        """As `Light.viewpoint`."""
        return np.zeros_like(position) if self.is_distant else position

    def receives(self, receiver, index):
        """None, as for a light without receivers: samples that the light does not reach were left out before."""
        return None


def has_patches(light) -> bool:
    """True for a distant light with children. The paths of both precisions choose its patches themselves."""
    return light.is_distant and len(light.children) > 0


def shade_patches(samples, members, patches, tree: PatchTree, radiance, shade) -> None:
    """Add to `radiance` (P, 3) what the samples `members` (N,) reflect of one patch each. shade(samples, lights,
    radiance, members) does so for one light per sample."""
    for start in range(0, len(members), lobe_integrals.FLOAT64_CHUNK):
        index, patch = (
            members[start : start + lobe_integrals.FLOAT64_CHUNK],
            patches[start : start + lobe_integrals.FLOAT64_CHUNK],
        )
        vectors = (tree.center, tree.half_u, tree.half_v, tree.radiance)
        center, half_u, half_v, light = (values[:, patch].T.astype(np.float64) for values in vectors)
        direction = np.broadcast_to(tree.direction.astype(np.float64), center.shape)
        area = tree.area_vectors(patch).T.astype(np.float64)
        patch_of_each = LightOfEachSample(center, direction, light, half_u, half_v, area, is_distant=True)
        corners = tree.corners(patch).transpose(1, 2, 0).astype(np.float64)
        target = np.zeros((1, len(index), 3))
        shade(samples.take(index), [(patch_of_each, 0, corners)], target, index)
        np.add.at(radiance, index, target[0])


def shade_pairs(samples, members, number, lights, shade_in_float64):
    """Yield (pairs (Q,), radiance (Q, 3)) of the samples `members` (N,), each under the one light `number` (N,).

    Lights with equally many corners make one batch. Round lights and lights with a profile are shaded one by one,
    because their corners depend on the sample.
    """
    batches: dict[tuple, list[int]] = {}
    for position, (light, _, corners) in enumerate(lights):
        kind = (1, position) if light.has_profile or light.is_round else (0, (len(corners), light.is_distant))
        batches.setdefault(kind, []).append(position)
    for (alone, _), chosen in sorted(batches.items()):
        among = np.full(len(lights), -1)
        among[chosen] = np.arange(len(chosen))
        of_batch = np.nonzero(among[number] >= 0)[0]
        for start in range(0, len(of_batch), lobe_integrals.FLOAT64_CHUNK):
            pairs = of_batch[start : start + lobe_integrals.FLOAT64_CHUNK]
            used, item_of_pair = np.unique(among[number[pairs]], return_inverse=True)
            items = [lights[chosen[position]] for position in used]
            light = (items[0][0], 0, items[0][2]) if alone else _light_of_each(items, item_of_pair)
            target = np.zeros((1, len(pairs), 3))
            shade_in_float64(samples.take(members[pairs]), [light], radiance=target)
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
    return LightOfEachSample(**fields, is_distant=distant), 0, corners[number].transpose(1, 0, 2)


def outlined_light(seen, position, radiance):
    """One (light, row, corners) that stands for the `Outlines` that samples at `position` (Q, 3) see."""
    center, direction = position + seen.offset.T, seen.direction.T.astype(np.float64)
    half_u, half_v = (half.T.astype(np.float64) for half in (seen.half_u, seen.half_v))
    area = seen.area[:, None] * direction
    light = LightOfEachSample(center, direction, np.broadcast_to(radiance, center.shape), half_u, half_v, area)
    return light, 0, seen.corners.transpose(0, 2, 1) + center


def _of(vector, index):
    """`vector` if it is (3,), the same for all samples; otherwise its rows for the samples `index`."""
    return vector if vector.ndim == 1 else vector[index]


def shade_diffuse(samples, lights, radiance):
    """Add to `radiance` (R, P, 3) what the diffuse lobes of `samples` reflect of `lights`, (light, row, corners)."""
    framed = LocalFrames.of(samples, samples.diffuse_normal)
    lit = np.nonzero(samples.diffuse_albedo.any(axis=1))[0]
    kinds = list(_diffuse_kinds(framed, lit))
    is_plain = (samples.diffuse_normal[lit] == samples.smooth_normal[lit]).all(axis=1)
    is_plain &= (samples.sheen_a[lit] == 0.0) & (samples.diffuse_roughness[lit] == 0.0)

    def shade_own(chunk, lights, target, _):
        shade_diffuse(chunk, lights, target)

    for light, row, corners in lights:
        if not light.affects_diffuse:
            continue
        if has_patches(light):
            tree, normals = PatchTree.of(light), (samples.diffuse_normal, samples.smooth_normal)
            index = _receiving(samples, light, lit[is_plain])
            reflected = tree.form_factors(samples.diffuse_normal[index]).T * samples.diffuse_albedo[index]
            radiance[row, index] += reflected
            index = _receiving(samples, light, lit[~is_plain])
            for columns, patches in tree.pairs(samples, normals, index, False):
                shade_patches(samples, index[columns], patches, tree, radiance[row], shade_own)
            continue
        for candidates, second_normal, count, integral in kinds:
            for level in visible_polygons_by_level(framed, light, corners, candidates, 1.0, second_normal):
                index, polygon, _ = level
                if light.has_profile:
                    view = light_view(framed, light, index, lambda vectors: vectors)
                    irradiance = _profiled(light, view, level, integral, count)
                else:
                    irradiance = integral(polygon, index)
                if light.is_facing:
                    lobe = facing.AnalyticLobe(framed.frame[2][:, index])
                    irradiance = irradiance * _mean_emission(light, samples, index, lobe)
                reflected = irradiance[0][:, None] * samples.diffuse_albedo[index]
                if count > 1:
                    rebound = irradiance[1][:, None] * samples.diffuse_rebound[index]
                    reflected += rebound * samples.diffuse_albedo[index]
                radiance[row, index] += reflected * _of(light.radiance, index)


def _diffuse_kinds(framed, lit):
    """Yield (candidates (Q,), second normal, count, integral) for each kind of diffuse lobe among the samples `lit`.
    integral(polygon, index) returns (count, Q)."""

    samples = framed.samples

    def lambert(polygon, _):
        return np.abs(lobe_integrals.form_factor(polygon))[None]

    def cosine(index):
        return (samples.diffuse_normal[index] * samples.view[index]).sum(axis=1).astype(np.float64)

    def sheen(polygon, index):
        return np.abs(diffuse.sheen_form_factor(polygon, samples.sheen_a[index], samples.sheen_b[index]))[None]

    def velvet(polygon, index):
        return diffuse.velvet_integral(polygon, cosine(index), -samples.sheen_a[index])[None]

    def rough(polygon, index):
        return diffuse.rough_integrals(polygon, cosine(index), samples.diffuse_roughness[index])

    def shadowed(lobe):
        return lambda polygon, index: lobe(polygon, index) * mean_shadowing(lobe, polygon, index)

    def mean_shadowing(lobe, polygon, index):
        smooth = to_local(framed.frame[:, :, index], samples.smooth_normal[index].T)
        alpha2 = samples.bump_alpha2[index].astype(np.float64)
        if lobe is lambert:
            return _bump_shadowing(polygon, smooth, alpha2)
        shape = np.zeros((4, len(index)))
        shape[:3] = samples.diffuse_roughness[index], samples.sheen_a[index], samples.sheen_b[index]
        return diffuse.shadowed_mean(polygon, cosine(index), shape, smooth, alpha2)

    bumped = (samples.diffuse_normal[lit] != samples.smooth_normal[lit]).any(axis=1)
    shiny, soft = samples.sheen_a[lit] > 0.0, samples.sheen_a[lit] < 0.0
    coarse = (samples.diffuse_roughness[lit] != 0.0) & ~(shiny | soft)
    plain = ~(shiny | soft | coarse)
    for count, lobe, chosen in ((1, lambert, plain), (1, sheen, shiny), (1, velvet, soft), (2, rough, coarse)):
        yield lit[chosen & ~bumped], None, count, lobe
        yield lit[chosen & bumped], samples.smooth_normal, count, shadowed(lobe)


def _mean_emission(light, samples, index, lobe):
    """`facing.mean_emission` of a light as the samples `index` see it."""
    offset = (light.center - samples.position[index]).T
    disk = FacingDisk.of(light, offset, lobe.normal)
    return disk.gain * facing.mean_emission(light, offset, disk, lobe)


def _receiving(samples, light, index):
    """The samples of `index` that the light lights."""
    allowed = light.receives(samples.receiver, index)
    return index if allowed is None else index[allowed]


def lobe_width(samples, index) -> np.ndarray:
    """Approximate width (Q,) in rad of the specular lobes: alpha."""
    return np.maximum(samples.sharpest_roughness[index].astype(np.float64), LEAST_ROUGHNESS) ** 2


def _profiled(light, view, level, integral, count):
    """Integrals (count, Q) over polygons (5, W, Q) times the profile of the light. `part` is from
    `visible_polygons_by_level`; integral(polygons, index) is the integral without the profile."""
    index, polygon, effort = level
    result = np.zeros((count, len(index)))
    for near, weights, corners in light_profile.layers(view, polygon[3:], light_profile.Profile.of(light), effort):
        result[:, near] += weights * integral(corners[3:], index[near])
    return result


def _bump_shadowing(polygon, smooth, alpha2):
    """The mean (Q,) over polygons of the bump shadowing of `SurfaceSamples`, with the cosine as the weight."""
    terms = shadowing_terms(alpha2)
    shadowed, whole = lobe_integrals.integrals_on_sphere(_shadowed_and_whole, polygon, smooth, terms)
    return np.clip(np.divide(shadowed, whole, out=np.zeros_like(whole), where=whole != 0.0), 0.0, 1.0)


def _shadowed_and_whole(unit, smooth, terms):
    """Signed integrals (2, Q) of z, with and without bump shadowing, over spherical polygons (3, V, Q)."""
    total = edge_sums(unit)
    shifted = one_plus_cosine(total)
    normal = np.cross(unit, total, axis=0) * arc_factors(shifted)[0]
    heights = (unit * smooth[:, None]).sum(axis=0)
    along, total = (normal * smooth[:, None]).sum(axis=0), normal.sum(axis=1)
    mean = np.abs(along.sum(axis=0)) / np.sqrt(np.maximum(dot(total, total), 1e-300))
    toward, ends = (normal[2], smooth[2] * along), (heights, np.roll(heights, -1, axis=0))
    return np.stack([shadowed_integral(toward, ends, shifted, mean, terms), 0.5 * total[2]])


def shade_specular(samples, lights, table, radiance, error=None):
    """As `shade_diffuse`, for the specular lobes. If `table` is REFERENCE, its error estimates are added to `error`
    (P,)."""
    cosine = (samples.normal * samples.view).sum(axis=1)
    framed = LocalFrames.of(samples, samples.normal)
    lit = np.nonzero((cosine > 0.0) & has_lobe(samples)[1])[0]
    cosine = np.clip(cosine, 0.0, 1.0)
    lobe, bent = None, np.zeros(len(samples), bool)
    is_anisotropic = samples.anisotropy[lit] != 0.0
    anisotropic = lit[is_anisotropic]
    halves = brdf.HalfVectors.of(samples, framed.frame, cosine) if table != REFERENCE and len(anisotropic) else None
    if table != REFERENCE and len(lit):
        bent = has_bent_fresnel(samples)
        lobe = _fresnel_lobe(table, cosine, samples)

    def shade_own(chunk, lights, target, index):
        estimates = None if error is None else np.zeros(len(index))
        shade_specular(chunk, lights, table, target, estimates)
        if error is not None:
            np.add.at(error, index, estimates)

    for light, row, corners in lights:
        if not light.affects_specular:
            continue
        if has_patches(light):
            tree, normals = PatchTree.of(light), (samples.normal, samples.geometric_normal)
            index = _receiving(samples, light, lit)
            for columns, patches in tree.pairs(samples, normals, index, True):
                shade_patches(samples, index[columns], patches, tree, radiance[row], shade_own)
            continue
        if table == REFERENCE:
            parts = reference_integrals(framed, cosine, light, corners, lit, error)
        else:
            plain = lit[~is_anisotropic]
            width = lobe_width(samples, plain)
            visible = visible_polygons_by_level(framed, light, corners, plain, width, samples.geometric_normal)
            parts = ((level[0], _table_integrals(table, lobe, framed, light, level)) for level in visible)
            if light.has_profile and isinstance(light, PolygonLight):
                parts = _joined(parts, len(samples))
            parts = _finished(parts, table, samples, light)
            if len(anisotropic):
                others = anisotropic_integrals(framed, halves, light, corners, anisotropic)
                parts = chain(parts, others)
        for index, integrals in parts:
            plain, schlick, dip, dielectric = integrals[:4, :, None]
            f0, f90 = samples.specular_f0[index], samples.specular_f90[index]
            reflected = f0 * plain + (f90 - f0) * schlick + samples.dielectric[index] * dielectric
            reflected -= samples.specular_dip[index] * dip
            if len(integrals) > 4:
                reflected += integrals[4:].T
            if (chosen := bent[index]).any():
                mean = _bent_reflectance(framed, light, corners, index[chosen])
                reflected[chosen] = plain[chosen] * mean
            radiance[row, index] += np.maximum(reflected, 0.0) * _of(light.radiance, index)


def _finished(parts, table, samples, light):
    """Yield (index, integrals (4, Q)) of the `parts` of a light, limited in tails and times the light's emission."""
    for index, integrals in parts:
        if table.family == "ltsh":
            _limit(integrals, samples, index, light)
        if light.is_facing:
            alpha = np.maximum(samples.roughness[index].astype(np.float64) ** 2, MIN_ALPHA)
            analytic_lobe = facing.AnalyticLobe(samples.normal[index].T, samples.view[index].T, alpha)
            integrals *= _mean_emission(light, samples, index, analytic_lobe)
        yield index, integrals


def has_bent_fresnel(samples) -> np.ndarray:
    """Mask (P,) of the samples whose Fresnel factor no sum of the tables' curves follows. These are dielectrics with an
    index of refraction below 1, where total reflection makes it nearly a step, and metals that are clipped at black."""
    below = samples.ior < 1.0
    if below.any():
        below = below & samples.dielectric.any(axis=1)
    return below | brdf.clipped_metals(samples)


def _bent_reflectance(framed, light, corners, at):
    """Mean Fresnel factor (Q, 3) of the samples `at` (Q,) over points of the light, weighted by the lobe there."""
    center = light.center if light.center.ndim == 1 else light.center[at]
    places = [center] if light.is_facing else [
        center + fraction * ((corner if corner.ndim == 1 else corner[at]) - center)
        for corner in corners for fraction in POINTS_TO_CORNERS
    ]  # fmt: skip
    samples, axes, direction = framed.samples.take(at), framed.frame[:, :, at], _of(light.direction, at)
    origin, is_clipped = light.viewpoint(samples.position), brdf.clipped_metals(samples)[:, None]
    cosine = np.clip((samples.normal * samples.view).sum(axis=1), 0.0, 1.0)
    alpha, total, lobe = np.maximum(samples.roughness**2, MIN_ALPHA), 0.0, 1e-30
    for point in places:
        offset = np.broadcast_to(point, origin.shape) - origin
        distance = np.linalg.norm(offset, axis=1)
        local = to_local(axes, (offset / distance[:, None]).T).T[:, None]
        values = brdf.ggx_brdf_cosine(cosine, alpha, local)
        if not light.is_facing:
            values = values * np.maximum(-(offset * direction).sum(axis=1), 0.0)[:, None] / distance[:, None] ** 3
        half = brdf.half_angle_cosine(cosine, local)
        metal = brdf.f82_reflectance(half, samples.specular_f0, samples.specular_f90, samples.specular_dip)
        metal = np.where(is_clipped, np.maximum(metal, 0.0), metal)
        coat = samples.dielectric * brdf.dielectric_reflectance(half, samples.ior[:, None])
        total, lobe = total + values * (metal + coat), lobe + values
    return total / lobe


def _joined(parts, count):
    """Yield (index, integrals (4, Q)) of a whole light for `count` samples, from those of its convex pieces."""
    total = np.zeros((4, count))
    for index, integrals in parts:
        total[:, index] += integrals
    index = np.nonzero(total[0] > 0.0)[0]
    yield index, total[:, index]


def _limit(integrals, samples, index, light):
    """Apply `TailLimits` to integrals (4, Q) over the light, as seen from the samples `index`."""
    light_of_each = light if light.center.ndim == 1 else light.take(index)
    axes = samples.normal[index].T, samples.view[index].T
    offset = (light_of_each.center - light_of_each.viewpoint(samples.position[index])).T
    if light.is_facing:
        light_from_points = LightFromPoints.of_disk(FacingDisk.of(light, offset, axes[0]))
    else:
        light_from_points = LightFromPoints.of(light_of_each, offset, dot(offset, light_of_each.direction.T))
    limits = TailLimits.of(axes, samples.roughness[index], samples.geometric_normal[index].T, True, samples.ior[index])
    limits.apply(integrals, slice(None), light_from_points, lambda name, shape: np.empty(shape))


def _fresnel_lobe(table: LookupTable, cosine, samples) -> Lobe:
    """Lobes with four coefficient vectors: F = 1, (1 - c)^5, c (1 - c)^6, and the dielectric of each sample's IOR."""
    if not samples.dielectric.any():
        lobe = table.lookup(cosine, samples.roughness.astype(cosine.dtype), curves=3)
        return lobe.with_coefficients(np.concatenate([lobe.coefficients, np.zeros_like(lobe.coefficients[:1])]))
    lobe = table.lookup(cosine, samples.roughness.astype(cosine.dtype))
    weights = table.dielectric_weights(samples.ior)
    dielectric = sum(weight * vector for weight, vector in zip(weights, lobe.coefficients, strict=True))
    return lobe.with_coefficients(np.stack([*lobe.coefficients[:3], dielectric]))


def _table_integrals(table, lobe, framed, light, level):
    """Integrals (4, Q), never negative, over a `part` from `visible_polygons_by_level`. Its corners run
    counterclockwise as seen from the point (`Light.polygon`)."""

    # Coefficients of z / pi, the clamped cosine of mass 1.
    cosine = np.zeros((1, lobe.coefficients.shape[1], 1))
    cosine[0, 0 if table.family == "ltc" else coefficient_index(1, 0)] = 1.0 if table.family == "ltc" else _COSINE

    def integral(polygon, index):
        lobes = lobe.take(index)
        vectors = np.concatenate([lobes.coefficients, np.broadcast_to(cosine, lobes.coefficients[:1].shape)])
        *values, plain = np.maximum(-lobe_integrals.polygon_integrals(table, lobes, polygon, vectors), 0.0)
        values[0] = np.maximum(values[0], lobe_integrals.LEAST_SHARE * plain)
        return np.stack(values)

    index, polygon, _ = level
    if not light.has_profile:
        return integral(polygon, index)
    lobes = lobe.take(index)

    def to_lobe(vectors):
        warped = lobes.to_original_domain(vectors)
        return warped if lobes.tilt is None else lobe_integrals.tilted(warped, lobes.tilt)

    view = light_view(framed, light, index, to_lobe)
    return _profiled(light, view, level, integral, 4)
