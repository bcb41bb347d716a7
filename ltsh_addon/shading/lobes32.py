"""The lobes of samples in single precision: frames, Fresnel terms, and their integrals over polygons.

Arrays of vectors are (3, Q). The warp of a lobe (and its tilt, for "ltc") is multiplied into the frame of its sample,
so that one product takes the corners of a light into the coordinates in which the lobe is integrated.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property, partial

import numpy as np

from ..emitters import light_profile, small_lights
from ..emitters.light_polygons import interpolated
from ..emitters.sky_map import SkyMap, share_above, to_world
from ..emitters.tails import TailLimits
from ..lobes import brdf, moments32
from ..lobes.diffuse import diffuse_factor
from ..lobes.edge_integrals import bump_shadowing, shadowing_terms
from ..lobes.lobe_integrals import LEAST_SHARE
from ..lobes.lookup_table import MIN_ALPHA
from ..lobes.polygon import cross, dot, normal_frames
from . import float64

# If a block has more different indices of refraction, the dielectric's weights are summed up per sample.
SEPARATE_IORS = 8
# Samples per chunk. It is large because a call of numpy costs as much as some thousand elements. Its rows are not a
# multiple of a page long, because the cache would hold few of such rows.
CHUNK = 24592
# Directions to a sky per chunk.
SKY_NODES = 24576
# Directions of diffuse lobes to a sky have equal steps of their heights to this power.
DENSE = 0.7
# Corners per chunk.
CORNERS = 4 * CHUNK


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
    whole: np.ndarray | None = None  # (F, Q) integrals over all above the horizon, NaN for lobes with two horizons

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


def fresnel_kinds(samples, members):
    """Yield (vectors, members, colors): the samples `members` grouped by the Fresnel terms that they need.

    `vectors` are those of `RidgeTable`; colors(index) returns the reflectances (F, 3, Q) of the terms.
    """
    dipped = any_component(samples.specular_dip)[members]
    metal = (any_component(samples.specular_f90) | any_component(samples.specular_f0))[members] | dipped
    flat = ~any_component(samples.specular_f90 != samples.specular_f0)[members] & ~dipped
    dielectric = any_component(samples.dielectric)[members]

    def white(index):
        return as_columns(samples.specular_f0, index)[None]

    def schlick(index):
        f0 = as_columns(samples.specular_f0, index)
        return np.stack([f0, as_columns(samples.specular_f90, index) - f0])

    def f82(index):
        return np.concatenate([schlick(index), -as_columns(samples.specular_dip, index)[None]])

    def coat(index):
        color = as_columns(samples.dielectric, index)
        return np.stack([np.zeros_like(color), color])

    def metal_and_coat(index, first):
        return np.concatenate([first(index), as_columns(samples.dielectric, index)[None]])

    yield (0,), members[~dielectric & flat], white
    yield (0, 1), members[~dielectric & ~flat & ~dipped], schlick
    yield (0, 1, 2), members[~dielectric & dipped], f82
    for vector, with_ior in _by_ior(samples.ior, members[dielectric & ~metal]):
        yield (0, vector), with_ior, coat
    for metal_vectors, chosen in (((0, 1), metal & ~dipped), ((0, 1, 2), dipped)):
        first = f82 if 2 in metal_vectors else schlick
        for vector, with_ior in _by_ior(samples.ior, members[dielectric & chosen]):
            yield (*metal_vectors, vector), with_ior, partial(metal_and_coat, first=first)


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


def frames_toward(normal, view):
    """Frames (3, 3, Q) around normals (3, Q) with tangents toward views (3, Q), whose lengths along these are (Q,)."""
    # Differences of close vectors are exact, so nothing of this one runs along the normal.
    tangent = view - normal
    tangent -= dot(normal, tangent) * normal
    sine = np.sqrt(dot(tangent, tangent))
    straight = np.nonzero(sine < 1e-6)[0]
    if len(straight):
        # The lobe is round there, so any tangent serves.
        tangent[:, straight] = normal_frames(normal[:, straight])[0]
    tangent /= np.where(sine < 1e-6, np.float32(1.0), sine)
    return (tangent, cross(normal, tangent), normal), sine


def lobe_axes(samples, index, axes, ridges, vectors, scratch):
    """Axes (C, 3, Q) of the warped local frames, the numbers of the coordinates to clip, and the weights (F, K, Q), for
    samples with the normals and views `axes`."""
    normal, view = axes
    cosine = dot(normal, view)
    (tangent, bitangent, _), sine = frames_toward(normal, view)
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


def any_component(vectors):
    """Mask (P,) of the vectors (P, 3) with an element other than 0; numpy's own reduction of short rows is slow."""
    return (vectors[:, 0] != 0) | (vectors[:, 1] != 0) | (vectors[:, 2] != 0)


def as_columns(vectors, index):
    """Rows `index` of vectors (P, 3) as (3, Q) float32."""
    return np.ascontiguousarray(vectors[index].T, dtype=np.float32)


def _selected(values, columns, index):
    """Values (..., Q) at the columns `index` (None: all) of the slice `part` of columns."""
    values = values[..., columns]
    return values if index is None else np.take(values, index, axis=-1)


def add_diffuse_of_sky(sky: SkyMap, samples, index, radiance) -> None:
    """Add to `radiance` (P, 3) what the diffuse lobes of the samples `index` reflect of a sky."""
    index = index[any_component(samples.diffuse_albedo)[index]]
    bumped = any_component(samples.diffuse_normal != samples.smooth_normal)[index]
    velvet, sheen = samples.sheen_a[index] < 0.0, samples.sheen_a[index] > 0.0
    shaped = velvet | sheen | (samples.diffuse_roughness[index] != 0.0)
    plain = index[~(bumped | shaped)]
    radiance[plain] += interpolated(sky.reflected, samples.diffuse_normal[plain]).T * samples.diffuse_albedo[plain]
    # Velvet is brightest near the horizon.
    for chosen, is_shaped, more in ((bumped & ~shaped, False, 1), (shaped & ~velvet, True, 1), (velvet, True, 4)):
        (height, *turn), members = brdf.spiral(more * sky.directions[-1]), index[chosen]
        up = (np.float32(1.0) - height) ** np.float32(DENSE)
        local = [*(np.sqrt(np.float32(1.0) - up * up) * turn), up]
        angles = np.float32(2.0 * np.pi / len(height) * DENSE) * up / (np.float32(1.0) - height)
        for start in range(0, len(members), SKY_NODES // len(height)):
            chosen = members[start : start + SKY_NODES // len(height)]
            normal, smooth = (as_columns(of, chosen) for of in (samples.diffuse_normal, samples.smooth_normal))
            toward = to_world(normal_frames(normal), local)
            angle, cosine = (np.broadcast_to(values, toward.shape[1:]) for values in (angles, up))
            above = dot(smooth[:, None], toward)
            weight = share_above(cosine, above, angle) * (up * angles * np.float32(1.0 / np.pi))
            weight *= bump_shadowing(above, np.float32(1.0), samples.bump_alpha2[chosen])
            light, again = sky.means(toward, angle), 0.0
            if is_shaped:
                shape = [getattr(samples, name)[chosen] for name in ("diffuse_roughness", "sheen_a", "sheen_b")]
                setting = toward, cosine, normal, as_columns(samples.view, chosen)
                once, twice = (
                    diffuse_factor(*setting, np.stack([*shape, rebound]))
                    for rebound in np.float32([[0.0], [1.0]]).repeat(len(chosen), axis=1)
                )
                again = (light * (weight * (twice - once))).sum(axis=1).T * samples.diffuse_rebound[chosen]
                weight *= once
            radiance[chosen] += ((light * weight).sum(axis=1).T + again) * samples.diffuse_albedo[chosen]


def add_specular_of_sky(sky: SkyMap, samples, index, radiance, table) -> None:
    """Add to `radiance` (P, 3) what the specular lobes of the samples `index` reflect of a sky. These are GGX, whatever
    the `table`, of which they have the albedo if they are isotropic."""
    cosine = dot(samples.normal.T, samples.view.T).astype(np.float32)
    index = index[cosine[index] > 0.0]
    aspect = np.maximum(1.0 - samples.anisotropy, 1e-6)
    alphas = np.maximum(np.square(samples.roughness) * np.stack([1.0 / aspect, aspect]), MIN_ALPHA).astype(np.float32)
    anisotropic, bent = samples.anisotropy != 0.0, float64.has_bent_fresnel(samples)
    counts = sky.counts(np.sqrt(alphas.max(axis=0))) * (1 + anisotropic)
    kinds = [*fresnel_kinds(samples, index[~bent[index]]), ("bent", index[bent[index]], None)]
    for vectors, members, colors_of in kinds:
        for count in np.unique(counts[members]):
            alike, nodes = members[counts[members] == count], brdf.spiral(count)
            for piece in moments32.pieces(len(alike), SKY_NODES // count, 128):
                chosen = alike[piece]
                normal, view, tangent, geometric = (
                    as_columns(getattr(samples, name), chosen)
                    for name in ("normal", "view", "tangent", "geometric_normal")
                )
                frames, _ = frames_toward(normal, np.where(anisotropic[chosen], normal + tangent, view))
                local = np.stack([dot(axis, view) for axis in frames])
                directions, angle, weight, half = brdf.visible_directions(nodes, local, alphas[:, chosen])
                toward = to_world(frames, directions)
                light = sky.means(toward, angle)
                if (geometric != normal).any():
                    light *= share_above(directions[2], dot(geometric[:, None], toward), angle)
                if vectors == "bent":
                    radiance[chosen] += (light * (weight * _bent_reflectance(samples, chosen, half))).sum(axis=1).T
                    continue
                albedos = table.albedos(cosine[chosen], samples.roughness[chosen])
                albedos[:, anisotropic[chosen]] = np.nan
                reflected = np.zeros((3, len(chosen)), np.float32)
                for vector, color in zip(vectors, colors_of(chosen), strict=True):
                    if color.any():
                        curve, albedo = _fresnel_curve(vector, half, samples.ior[chosen], (table, albedos))
                        curve *= weight
                        # Without an albedo, which is NaN, the scale is 1.
                        scale = albedo / np.maximum(curve.sum(axis=0), np.float32(1e-30))
                        reflected += color * ((light * curve).sum(axis=1) * np.where(scale >= 0.0, scale, 1.0))
                if sky.reflected.min() >= 0.0:
                    # Terms that cancel in the Fresnel factor may leave a rest below zero.
                    np.maximum(reflected, np.float32(0.0), out=reflected)
                radiance[chosen] += reflected.T


def _fresnel_curve(vector, half, ior, albedos):
    """One of the `vectors` of `RidgeTable` at the cosines `half` (N, Q), and its albedo (Q,), given a table and the
    albedos (F, Q) of the table's curves."""
    table, albedos = albedos
    if isinstance(vector, int):
        curve = np.ones_like(half) if vector == 0 else brdf.schlick_curve(half)
        if vector == 2:
            curve *= half * (np.float32(1.0) - half)
        return curve, albedos[vector]
    ior = ior.astype(np.float32)
    return brdf.dielectric_reflectance(half, ior), (table.dielectric_weights(ior) * albedos).sum(axis=0).astype(
        np.float32
    )


def _bent_reflectance(samples, index, half):
    """Fresnel factors (3, N, Q) at the cosines `half` (N, Q) of samples that are `float64.has_bent_fresnel`."""
    samples = samples.take(index)
    f0, f90, dip, dielectric = (
        as_columns(getattr(samples, name), slice(None))[:, None]
        for name in ("specular_f0", "specular_f90", "specular_dip", "dielectric")
    )
    metal = brdf.f82_reflectance(half, f0, f90, dip)
    metal = np.where(brdf.clipped_metals(samples), np.maximum(metal, np.float32(0.0)), metal)
    return metal + dielectric * brdf.dielectric_reflectance(half, samples.ior.astype(np.float32))


class FormFactor:
    """Form factors (1, Q) of polygons whose corners run counterclockwise as seen from the point (`Light.polygon`)."""

    def __init__(self, scratch):
        self.scratch = scratch

    def __call__(self, columns, corners, index, smallest=moments32.SMALLEST_SAFE):
        integral, needs_float64 = moments32.cosine_integral(corners, self.scratch, smallest)
        integral *= np.float32(-1.0 / np.pi)
        return np.maximum(integral, np.float32(0.0))[None], needs_float64


class ShadowedFormFactor:
    """As `FormFactor`, under the bump shadowing of `SurfaceSamples`. The smooth normal, rows[3], has y = 0."""

    def __init__(self, rows, bump_alpha2, scratch):
        self.smooth = np.stack([dot(row, rows[3]) for row in rows[:3:2]])
        self.terms, self.scratch = shadowing_terms(bump_alpha2), scratch

    def __call__(self, columns, corners, index, smallest=moments32.SMALLEST_SAFE):
        smooth, terms = (_selected(values, columns, index) for values in (self.smooth, self.terms))
        integral, needs_float64 = moments32.shadowed_cosine_integral(corners, smooth, terms, self.scratch, smallest)
        integral *= np.float32(-1.0 / np.pi)
        return np.maximum(integral, np.float32(0.0))[None], needs_float64


class LobeIntegral:
    """Integrals (F, Q) of lobes with F weight vectors over polygons, never negative. Winding is as in `FormFactor`.

    The first integral is the one for F = 1.
    """

    def __init__(self, ridges, weights, scratch):
        self.ridges, self.weights, self.scratch = ridges, weights, scratch

    def __call__(self, columns, corners, index, smallest=moments32.SMALLEST_SAFE):
        weights = _selected(self.weights, columns, index)
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
        self.view = light_profile.LightView.of(light, offset, partial(along_axes, axes))
        plane = light_profile.plane_axes(light).astype(np.float32)[:, :, None]
        self.rows = np.concatenate([axes, np.broadcast_to(plane, (2, 3, axes.shape[2]))])

    def __call__(self, corners, index):
        index = np.arange(corners.shape[2]) if index is None else index
        values = np.zeros((self.count, len(index)), np.float32)
        needs_float64 = np.zeros(len(index), bool)
        step = max(CORNERS // (corners.shape[1] * (2 * self.effort.chords + 1)), 512)
        for start in range(0, len(index), step):
            chunk = slice(start, start + step)
            flat, view = corners[-2:, :, chunk], self.view.take(index[chunk])
            layers = light_profile.layers(view, flat, self.profile, self.effort)
            for number, (near, weights, polygons) in enumerate(layers):
                # Small disks count little, so the rounding of their edges is lost in the sum.
                smallest = 0.0 if number < self.effort.layers - 1 else moments32.SMALLEST_SAFE
                integrals, redo = self.integrate(polygons, index[chunk][near], smallest=smallest)
                values[:, start + near] += weights * integrals
                needs_float64[start + near] |= redo
        return values, needs_float64


def along_axes(axes, vector):
    """Products (C, P) of rows (C, 3, P) with a vector (3,)."""
    x, y, z = vector.astype(np.float32)
    return x * axes[:, 0] + y * axes[:, 1] + z * axes[:, 2]
