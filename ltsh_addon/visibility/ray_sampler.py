"""`RaySampler`: the directions of rays from samples to a light, and what the lobes reflect along each.

Half of the directions are spread evenly over the solid angle of the light's quadrilateral (light sampling), which suits
diffuse lobes. The other half are spread evenly over its solid angle after the warp that flattens the peak of GGX
(`lobes.lookup_table`), which suits specular lobes (BSDF sampling): none misses the light, however sharp the lobe. The
balance heuristic (Veach and Guibas 1995) combines both.

Everything is in single precision. Arrays are (S, Q), S directions from each of Q points, or (Q,). Vectors have their
components first.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from ..cycles.horizons import SPECULAR_FIELDS
from ..emitters.facing import FacingDisk, emission, ray_length
from ..emitters.light_polygons import LEAST_COSINE, LOBE_WIDTH, has_lobe, off_plane
from ..lobes.brdf import dielectric_reflectance, schlick_curve, stretch
from ..lobes.diffuse import diffuse_factor
from ..lobes.polygon import dot
from ..scene import FARTHEST, SurfaceSamples
from .emitter import Emitter, Sky
from .light_cluster import LightCluster, LobeBound
from .sampling import SphericalQuads, Warps, frames, seeds_of, unit_points
from .shadow_terminator import RayOrigins

# Number of probe rays of a pair. More rays come in multiples of it.
PROBES = 8
_ZERO, _ONE, _TINY = np.float32(0.0), np.float32(1.0), np.float32(1e-30)
# Corners of the square around the unit disk, for lights that face the points.
SQUARE = np.array([[-1.0, 1.0, 1.0, -1.0], [-1.0, -1.0, 1.0, 1.0]])
_FARTHEST = np.float32(FARTHEST)
# Least and greatest length of a unit vector after a warp.
_LENGTHS = np.float32(1e-11), np.float32(4.0)


@dataclass(frozen=True)
class RayBatch:
    """The rays `first` to `last` of each pair, in groups of PROBES rays. In each group, some rays are BSDF samples.

    `probes` is how many rays of the first group are light samples, `later` the same for each later group.
    """

    first: int
    last: int
    total: int
    probes: int
    later: int

    @property
    def groups(self) -> int:
        """Number of groups of PROBES rays each."""
        return (self.last - self.first) // PROBES

    @property
    def light_points(self) -> tuple[int, int]:
        """First and last number of the points that choose directions evenly over the light."""
        return tuple(self.probes + self.later * (n // PROBES - 1) if n else 0 for n in (self.first, self.last))

    @property
    def bsdf_points(self) -> tuple[int, int]:
        """First and last number of the points that choose directions by the lobe."""
        return tuple(n - even for n, even in zip((self.first, self.last), self.light_points, strict=True))

    def places(self, seeds: np.ndarray, count: int) -> np.ndarray:
        """At which of so many places (S, Q) of their sample the rays start: in turn."""
        return (np.arange(self.first, self.last)[:, None] + (seeds >> np.uint32(16))) % count

    def add_to(self, halves, weight):
        """Add weights (S, Q) to the sums (2, Q) of the first and of the second half of all rays."""
        start, stop = self.light_points
        batch_sums = np.zeros((self.groups, weight.shape[1]), np.float32)
        for rows in (weight[: stop - start], weight[stop - start :]):
            if len(rows):
                batch_sums += rows.reshape(self.groups, -1, weight.shape[1]).sum(axis=1)
        for number, batch_sum in enumerate(batch_sums, self.first // PROBES):
            halves[int(2 * number * PROBES >= self.total)] += batch_sum


class RaySampler:
    """A light seen from a block of samples: arrays (Q,) and (3, Q)."""

    def __init__(
        self,
        surface: "SampleRows",
        index: np.ndarray,
        emitter: Emitter | LightCluster,
        lobes: tuple[str, ...],
        order: np.ndarray | None = None,
    ):
        self.index, self.emitter, self.lobes = index, emitter, lobes
        light = emitter.light
        offset = light.center[:, None] - light.viewpoint(np.take(surface.position, index, axis=1))
        self.height = (-dot(light.direction, offset)).astype(np.float32)
        self.offset = offset.astype(np.float32)
        self.disk, is_quad = None, not isinstance(emitter, LightCluster)
        if light.is_facing:
            normal = surface.normal if "specular" in lobes else surface.diffuse_normal
            self.disk = FacingDisk.of(light, self.offset, np.take(normal, index, axis=1))
            corners = self.disk.corners(SQUARE)
        elif is_quad:
            corners = emitter.corners_from(self.offset, self.height)
        else:
            position = np.take(surface.position, index, axis=1)
            self.least_height = off_plane(light.center + light.radius, np.abs(position).sum(axis=0)).astype(np.float32)
        if is_quad:
            self.quads = SphericalQuads(corners)
            self.has_solid_angle, self.solid_angle = self.quads.has_solid_angle, self.quads.solid_angle
        if isinstance(emitter, Sky):
            # The solid angle of one side: `LightSelection` knows the sides one by one.
            self.solid_angle = np.full(len(index), 4.0 * np.pi / 6.0, np.float32)
        # Pairs that take one sequence in this `order` (Q,) have one seed.
        self.order, self.seeds = order, surface.seeds[index] if order is None else surface.seeds[:1]
        if "diffuse" in lobes:
            self.horizons = [np.take(normal, index, axis=1) for normal in surface.horizons("diffuse")]
            self.bump_alpha2 = surface.bump_alpha2[index]
            self.shape = None
            if surface.shapes is not None:
                axes = (surface.diffuse_normal, surface.view)
                self.shape = (*(np.take(axis, index, axis=1) for axis in axes), surface.shapes[:, index])
        if "specular" in lobes:
            normal, view = np.take(surface.normal, index, axis=1), np.take(surface.view, index, axis=1)
            self.geometric_normal = np.take(surface.geometric_normal, index, axis=1)
            self.has_own_horizon = surface.geometric_normal is not surface.normal
            self.share = None
            if surface.share is not None:
                self.share, self.horizon = surface.share[index], np.take(surface.horizon, index, axis=1)
            self.cosine, self.sine, rows = frames(normal, view)
            self.view = view
            self.alpha, self.stretch = surface.alpha[index], None
            if surface.tangent is not None:
                along = [dot(row, np.take(surface.tangent, index, axis=1)) for row in rows[:2]]
                self.stretch = stretch(*along, surface.anisotropy[index])
                self.alpha = self.alpha * np.sqrt(self.stretch[0])
            self.warps = Warps(rows, self.cosine, self.sine, self.alpha)
            if is_quad:
                self.warped_quads = SphericalQuads(self.warps.warped(self.warps.local(corners)))
                self.has_solid_angle = self.has_solid_angle & self.warped_quads.has_solid_angle
            self.f0, self.f90_minus_f0 = surface.f0[index], surface.f90_minus_f0[index]
            self.f82_term = surface.f82_term[index]
            self.dielectric, self.ior = surface.dielectric[index], surface.ior[index]

    def sample(self, batch: RayBatch):
        """Unit directions (3, S, Q) of `batch`, distances to the light (S, Q), and weights (S, Q) by lobe; `falling`
        gets the cosines (S, Q) at a light that is flat."""
        if isinstance(self.emitter, Sky):
            return self._sample_sky(batch)
        if isinstance(self.emitter, LightCluster):
            return self._sample_cluster(batch)
        light_count, bsdf_count = (last - first for first, last in (batch.light_points, batch.bsdf_points))
        shape = (light_count + bsdf_count, len(self.index))
        directions = np.empty((3, *shape), np.float32)
        if light_count:
            points = unit_points(self.seeds, 0, *batch.light_points, self.order)
            self.quads.directions(*points, out=directions[:, :light_count])
        density = np.float32(light_count / shape[0]) / self.quads.solid_angle
        if bsdf_count:
            local = np.empty((3, *shape), np.float32)
            points = unit_points(self.seeds, 1, *batch.bsdf_points, self.order)
            self.warped_quads.directions(*points, out=local[:, light_count:])
            length = self._unwarped(directions, local, light_count)
            scale = np.float32(bsdf_count / shape[0]) * self.warps.determinant / self.warped_quads.solid_angle
            scale *= self.has_solid_angle
            density = density + _after_warp(scale, length)
        light = self.emitter.light
        falling = dot(directions, -light.direction.astype(np.float32) if self.disk is None else self._axis())
        height = self.height if self.disk is None else self.disk.length
        distance = np.minimum(height / np.maximum(falling, _TINY), _FARTHEST)
        falls = falling > 0.0
        self.falling = falling if self.disk is None else np.ones_like(falling)
        falls &= self.has_solid_angle
        factor = falls / density
        if self.disk is None:
            brightness = self.emitter.brightness(directions, distance, self.offset, self.height)
        else:
            brightness, distance = self._of_disk(directions, distance)
        if brightness is not None:
            factor *= brightness
        if light.is_distant:
            distance[:] = _FARTHEST
        return directions, distance, self._weights(directions, local if bsdf_count else None, factor)

    def _unwarped(self, directions, local, light_count):
        """Complete the directions (3, S, Q) in the world and in the local frames. The first `light_count` are known in
        the world, the others in the local frames after the warp. Returns their lengths (S, Q) after the warp."""
        length = np.empty(directions.shape[1:], np.float32)
        length[light_count:] = self.warps.unwarped(local[:, light_count:])
        self.warps.world(local[:, light_count:], out=directions[:, light_count:])
        self.warps.local(directions[:, :light_count], out=local[:, :light_count])
        length[:light_count] = self.warps.lengths(local[:, :light_count])
        return np.clip(length, *_LENGTHS, out=length)

    def _weights(self, directions, local, factor):
        weights = {}
        if "specular" in self.lobes:
            weights["specular"] = self._specular(directions, local)
            weights["specular"] *= factor
        if "diffuse" in self.lobes:
            weights["diffuse"] = self._diffuse(directions)
            weights["diffuse"] *= factor
        return weights

    def _sample_sky(self, batch: RayBatch):
        """As `sample`, for a sky: by its picture and cosine, and by the cosine after the warp of the lobe."""
        light_count, bsdf_count = (last - first for first, last in (batch.light_points, batch.bsdf_points))
        shape, local = (light_count + bsdf_count, len(self.index)), None
        normal = self.horizons[0] if "diffuse" in self.lobes else self.geometric_normal
        directions = np.empty((3, *shape), np.float32)
        if light_count:
            points = unit_points(self.seeds, 0, *batch.light_points, self.order)
            directions[:, :light_count] = self.emitter.directions(*points, normal)
        if bsdf_count:
            local = np.empty((3, *shape), np.float32)
            x, y = unit_points(self.seeds, 1, *batch.bsdf_points, self.order)
            radius, angle = np.sqrt(x), np.float32(2.0 * np.pi) * y
            chosen = (radius * np.cos(angle), radius * np.sin(angle), np.sqrt(_ONE - x))
            local[:, light_count:] = chosen
            length = self._unwarped(directions, local, light_count)
        density, brightness = self.emitter.along(directions, normal)
        density *= np.float32(light_count / shape[0])
        if bsdf_count:
            cosine = np.maximum(self.warps.zz * local[2] / length, _ZERO)
            scale = np.float32(bsdf_count / shape[0] / np.pi) * self.warps.determinant
            density += _after_warp(scale * cosine, length)
        factor = brightness / np.maximum(density, _TINY)
        distance = np.full(shape, _FARTHEST, np.float32)
        return directions, distance, self._weights(directions, local, factor)

    def solid_angles(self, flat):
        """Approximate solid angles (R,): the inverse density, in sr, of the rays that the light chooses at the places
        `flat` (R,) of the flattened (S, Q)."""
        return self.solid_angle.ravel()[flat % self.solid_angle.size]

    def _sample_cluster(self, batch: RayBatch):
        """As `sample`, for a cluster: each ray goes to a leaf of its own."""
        even, sharp = (
            unit_points(self.seeds, stream, *numbers, self.order)
            for stream, numbers in enumerate((batch.light_points, batch.bsdf_points))
        )
        light_count, shape = len(even[0]), (len(even[0]) + len(sharp[0]), len(self.index))
        leaf, pmf, x = self._leaves(np.concatenate([even[0], sharp[0]]), light_count)
        y, emitter = np.concatenate([even[1], sharp[1]]), self.emitter
        corners = emitter.corners[:, :, leaf] + self.offset[:, None, None]
        quads, directions = SphericalQuads(corners), np.empty((3, *shape), np.float32)
        has_solid_angle, local = quads.has_solid_angle, None
        rows = slice(None, light_count)
        quads.take_rows(rows).directions(x[rows], y[rows], out=directions[:, rows])
        self.solid_angle = quads.solid_angle / np.maximum(pmf[0], np.float32(1e-12))
        density = np.float32(light_count / shape[0]) * pmf[0] / quads.solid_angle
        if light_count < shape[0]:
            local = np.empty((3, *shape), np.float32)
            warped = SphericalQuads(self.warps.warped(self.warps.local(corners)))
            has_solid_angle = has_solid_angle & warped.has_solid_angle
            rows = slice(light_count, None)
            warped.take_rows(rows).directions(x[rows], y[rows], out=local[:, rows])
            length = self._unwarped(directions, local, light_count)
            scale = np.float32(1.0 - light_count / shape[0]) * pmf[-1] * self.warps.determinant / warped.solid_angle
            density = density + _after_warp(scale, length)
        normal = emitter.normal[:, leaf]
        falling, height = -dot(directions, normal), np.maximum(-dot(corners[:, 0], normal), _ZERO)
        distance = np.minimum(height / np.maximum(falling, _TINY), _FARTHEST)
        self.falling = falling
        factor = has_solid_angle & (falling > 0.0) & (height > self.least_height) & (density > 0.0)
        if emitter.is_round is not None:
            factor &= self._inside_round(leaf, corners, directions * np.where(factor, distance, _ZERO))
        factor = factor * emitter.brightness[leaf] / np.maximum(density, _TINY)
        return directions, distance, self._weights(directions, local, factor)

    def _inside_round(self, leaf, corners, points):
        """Mask (S, Q): False for places (3, S, Q) outside the ellipse in the parallelogram of a round light."""
        u, v = 0.5 * (corners[:, 1] - corners[:, 0]), 0.5 * (corners[:, 3] - corners[:, 0])
        offset = points - 0.5 * (corners[:, 0] + corners[:, 2])
        uu, uv, vv, us, vs = dot(u, u), dot(u, v), dot(v, v), dot(u, offset), dot(v, offset)
        whole = np.maximum(uu * vv - uv * uv, _TINY)
        s, t = (vv * us - uv * vs) / whole, (uu * vs - uv * us) / whole
        return (s * s + t * t <= _ONE) | ~self.emitter.is_round[leaf]

    def _leaves(self, x, light_count):
        """The leaves (S, Q) that rays go to, by lobe their probabilities, and the numbers x (S, Q) rescaled for reuse.
        x chooses the leaves: the first `light_count` rays by the diffuse lobe if there is one, the others by the
        specular lobe."""
        lobes, lobe_of_row = [], np.zeros(len(x), np.intp)
        if "diffuse" in self.lobes:
            lobes.append(LobeBound(self.offset, self.horizons[0]))
        if "specular" in self.lobes:
            normal = self.warps.rows[2]
            mirrored = np.float32(2.0) * self.cosine * normal - self.view
            width = np.maximum(LOBE_WIDTH * self.alpha * np.maximum(self.cosine, LEAST_COSINE), np.float32(1e-4))
            lobes.append(LobeBound(self.offset, self.geometric_normal, mirrored, width.astype(np.float32)))
            lobe_of_row[light_count:] = len(lobes) - 1
        return self.emitter.pick(x, lobes, lobe_of_row)

    def corner_heights(self, horizons):
        """As `RatioEstimator._corner_heights`, for the corners of the leaves that the probes go to.

        Leaves that face away have height -1."""
        x = unit_points(self.seeds, 0, 0, PROBES)[0]
        leaf, pmf, _ = self._leaves(x, PROBES)
        corners = self.emitter.corners[:, :, leaf] + self.offset[:, None, None]
        is_lit = (pmf[0] > 0.0) & (dot(corners[:, 0], self.emitter.normal[:, leaf]) < -self.least_height)
        corners, is_lit = corners.reshape(3, 4 * PROBES, len(self.index)), np.tile(is_lit, (4, 1))
        heights = np.minimum.reduce([dot(corners, normal[:, None, self.index]) for normal in horizons])
        return np.where(is_lit, heights, -_ONE), corners

    def _axis(self):
        """Unit vectors (3, 1, Q) to the center of the light."""
        return (self.disk.offset / self.disk.length)[:, None]

    def _of_disk(self, directions, distance):
        """Brightness (S, Q) of a light that faces the points, and distances (S, Q) to it, along directions (3, S, Q)
        that meet its plane at `distance`."""
        disk, offset = self.disk, np.broadcast_to(self.offset[:, None], directions.shape)
        from_center = directions * distance - disk.offset[:, None]
        inside = dot(from_center, from_center) <= disk.radius * disk.radius
        length = ray_length(self.emitter.light, offset, directions)
        factor = inside * disk.gain * np.asarray(emission(self.emitter.light, offset, directions), np.float32)
        return factor, np.where(inside, length, distance).astype(np.float32)

    def _diffuse(self, directions):
        """Diffuse lobe times cosine (S, Q): a plain cosine for most surfaces, with the shadowing of a bump map where
        the smooth normal has another horizon."""
        cosine = dot(directions, self.horizons[0])
        np.maximum(cosine, _ZERO, out=cosine)
        if self.shape is not None:
            cosine *= diffuse_factor(directions, cosine, *self.shape)
        if len(self.horizons) == 1:
            return cosine
        above = dot(directions, self.horizons[1])
        np.maximum(above, _ZERO, out=above)
        squared = above * above
        slope = np.sqrt(squared + self.bump_alpha2 * (_ONE - squared))
        slope += above
        np.maximum(slope, _TINY, out=slope)
        above /= slope
        above *= np.float32(2.0)
        cosine *= above
        return cosine

    def _specular(self, directions, local):
        """GGX BRDF with its Fresnel factor times cosine times 2 pi (S, Q); see `shading.brdf.ggx_brdf_cosine`."""
        half_x, half_z = local[0] + self.sine, local[2] + self.cosine
        alpha2 = self.alpha * self.alpha
        across = None
        if self.stretch is not None:
            across = self.stretch[1] * half_x + self.stretch[0] * local[1]
        half_x *= half_x
        if across is not None:
            across *= across
            across += half_x
        half_x += local[1] * local[1]
        half_z *= half_z
        squared = half_x + half_z
        if across is not None:
            half_x = across
        half_z *= alpha2
        half_x += half_z
        ratio = np.divide(squared, half_x, out=half_x)
        mu = np.maximum(local[2], _ZERO, out=half_z)
        slope = mu * mu
        if self.stretch is None:
            slope *= _ONE - alpha2
            slope += alpha2
        else:
            beside = local[1] / self.stretch[0]
            slope += alpha2 * (np.square(local[0] - self.stretch[1] * beside) + np.square(beside))
        np.sqrt(slope, out=slope)
        slope *= self.cosine
        slope += mu * np.sqrt(self.cosine * self.cosine * (_ONE - alpha2) + alpha2)
        ratio *= ratio
        ratio *= alpha2 if self.stretch is None else alpha2 * self.stretch[0]
        ratio *= mu
        ratio /= np.maximum(slope, _TINY, out=slope)
        ratio *= self._reflectance(squared)
        if self.share is not None:
            above = (dot(directions, self.geometric_normal) > 0.0) * (_ONE - self.share)
            above += (dot(directions, self.horizon) > 0.0) * self.share
            ratio *= above
        elif self.has_own_horizon:
            ratio *= dot(directions, self.geometric_normal) > 0.0
        return ratio

    def _reflectance(self, squared):
        """Fresnel factor (S, Q) by the `squared` lengths (S, Q) of unit view plus unit light, which are overwritten."""
        cosine = np.sqrt(squared, out=squared)
        cosine *= np.float32(0.5)
        np.minimum(cosine, _ONE, out=cosine)
        result = schlick_curve(cosine)
        if self.f82_term.any():
            result *= self.f90_minus_f0 - self.f82_term * (cosine * (_ONE - cosine))
        else:
            result *= self.f90_minus_f0
        result += self.f0
        if self.dielectric.any():
            result += self.dielectric * dielectric_reflectance(cosine, self.ior)
        return np.maximum(result, _ZERO, out=result)


def _after_warp(density, length):
    """Densities of unit vectors of this `length` after the warp; beyond single precision infinite: no weight."""
    with np.errstate(over="ignore"):
        return density / (length * length * length)


_MIN_ALPHA = np.float32(1e-5)
EVEN = 0.5  # clearances from the plane of its triangle up to which a place is in it


class JoinedLobes:
    """P samples of which two in succession that are one lobe with two horizons, as `cycles.horizons` makes them, count
    as one: they share their rays.

    `samples` (Q) are the joined ones, `first` (P,) the mask of those that they begin with, `index` (P,) their numbers.
    """

    def __init__(self, samples: SurfaceSamples):
        is_second = np.zeros(len(samples), bool)
        names = ("position", "normal", "view", "tangent")
        same = [getattr(samples, name) for name in names] + [samples.roughness[:, None], samples.anisotropy[:, None]]
        is_second[1:] = np.logical_and.reduce([(rows[1:] == rows[:-1]).all(axis=1) for rows in same])
        is_second[1:] &= ~(samples.diffuse_albedo[1:].any(axis=1) | is_second[:-1])
        colors = np.concatenate([getattr(samples, name) for name in SPECULAR_FIELDS], axis=1)
        whole = np.abs(colors).sum(axis=1, keepdims=True)
        apart = np.abs(colors[1:] * whole[:-1] - colors[:-1] * whole[1:]).max(axis=1)
        is_second[1:] &= apart <= 1e-5 * (whole[1:] * whole[:-1])[:, 0]
        self.first, self.index = ~is_second, np.cumsum(~is_second) - 1
        self.samples, self.share, self.horizon = samples, None, None
        second = np.flatnonzero(is_second)
        if len(second):
            joined, weight = self.index[second], (whole[second] + whole[second - 1])[:, 0]
            samples, fields = samples.take(self.first), {}
            for number, name in enumerate(SPECULAR_FIELDS):
                fields[name] = getattr(samples, name).copy()
                fields[name][joined] += colors[second, 3 * number : 3 * number + 3]
            self.share, self.horizon = np.zeros(len(samples), np.float32), samples.geometric_normal.copy()
            self.share[joined] = whole[second, 0] / np.maximum(weight, 1e-30)
            self.horizon[joined] = self.samples.geometric_normal[second]
            self.samples = replace(samples, **fields)


class SampleRows:
    """Samples in single precision with components first: vectors are (3, P)."""

    def __init__(
        self,
        samples: SurfaceSamples,
        passes: Sequence[str],
        tracer,
        ray_origins: RayOrigins | None = None,
        lobes: JoinedLobes | None = None,
        extent: np.ndarray | None = None,
    ):
        self.tracer, self.ray_origins = tracer, tracer.ray_origins(samples) if ray_origins is None else ray_origins
        self.position = np.ascontiguousarray(samples.position.T)
        self.receiver = samples.receiver
        # (3, 1 + N, P) m: from each sample to itself, and to others for which it stands, see `Film.extent`.
        self.extent = None
        if extent is not None and extent.shape[1]:
            # Where the sample is not on its triangle by more than rounding, only places in the plane of that are exact.
            origins = self.ray_origins
            normal, clearance = origins.geometric_normal[:, None], origins.clearance[:, None, None]
            height = (extent * normal).sum(axis=-1, keepdims=True)
            is_exact = (origins.position == samples.position.astype(np.float32)).all(axis=1)
            even = np.where(np.abs(height) <= EVEN * clearance, extent - height * normal, 0.0)
            extent = np.where(is_exact[:, None, None], extent, even).astype(np.float32)
            self.extent = np.concatenate([np.zeros_like(extent[:, :1]), extent], axis=1).transpose(2, 1, 0)
        self.seeds = seeds_of(samples.position)
        self._known: list[np.ndarray] = []
        self.normal, self.view = self._rows(samples.normal), self._rows(samples.view)
        self.geometric_normal = self._rows(samples.geometric_normal)
        self.share = None if lobes is None else lobes.share
        self.horizon = None if self.share is None else self._rows(lobes.horizon)
        self.diffuse_normal, self.smooth_normal = self._rows(samples.diffuse_normal), self._rows(samples.smooth_normal)
        self.bump_alpha2 = samples.bump_alpha2.astype(np.float32)
        self.shapes = None
        if samples.sheen_a.any() or samples.diffuse_roughness.any():
            names = ("diffuse_roughness", "sheen_a", "sheen_b")
            rebound = samples.diffuse_rebound.mean(axis=1, dtype=np.float32)
            self.shapes = np.stack([*(getattr(samples, name).astype(np.float32) for name in names), rebound])
        self.alpha = np.maximum(np.square(samples.roughness.astype(np.float32)), _MIN_ALPHA)
        self.tangent, self.anisotropy = None, samples.anisotropy.astype(np.float32)
        if samples.anisotropy.any():
            self.tangent = self._rows(samples.tangent)
        names = ("specular_f0", "specular_f90", "specular_dip", "dielectric", "diffuse_albedo")
        terms = [getattr(samples, name).mean(axis=1, dtype=np.float32) for name in names]
        self.f0, f90, self.f82_term, self.dielectric, self.albedo = terms
        self.f90_minus_f0 = f90 - self.f0
        self.ior = samples.ior.astype(np.float32)
        diffuse, specular = has_lobe(samples)
        specular &= dot(self.normal, self.view) > 0.0
        self.lobes = {"specular": specular & ("specular" in passes), "diffuse": diffuse & ("diffuse" in passes)}

    def _rows(self, vectors):
        # Equal normals share one array, so that identity tells whether they differ.
        rows = np.ascontiguousarray(vectors.T, dtype=np.float32)
        equal = next((known for known in self._known if np.array_equal(known, rows)), None)
        if equal is None:
            self._known.append(rows)
        return rows if equal is None else equal

    def horizons(self, name: str) -> tuple[np.ndarray, ...]:
        """The normals (3, P) whose horizons bound the lobe of pass `name`: below any of them it is 0."""
        if name == "diffuse":
            return _different(self.diffuse_normal, self.smooth_normal)
        return _different(self.normal, self.geometric_normal if self.share is None else self.normal)


def _different(first, second):
    return (first,) if first is second else (first, second)
