"""The share of each light that each sample sees: `visible_shares`.

The ratio estimator (Heitz, Hill and McGuire 2018, "Combining analytic direct illumination and stochastic shadows",
doi:10.1145/3190834.3190852): shadowed radiance = closed form x sum(w V) / sum(w), V the transmittance of rays to the
light, w what the pass makes of the light along them, over the density of the rays. The same rays serve both passes.

A few probes go to every pair of a sample and a light. Those that all arrive, or are all blocked, settle it, unless a
neighbor in the picture found otherwise; the pairs that are left take all rays.
"""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np

from ..scene import PASSES, AreaLight, Cancelled, Film, Progress, SurfaceSamples
from ..shading.brdf import dielectric_reflectance
from ..shading.light_polygons import has_lobe, in_front
from ..shading.parallel import cores
from .directions import BITS, Emitter, SphericalQuads, Warps, dot, seeds_of, sequence

# Rays of the first look at a pair.
PROBES = 8
# Rays of a block: its arrays stay in the cache.
BLOCK_RAYS = 1 << 15
# How often neighbors of mixed pairs that turn out mixed pass that on.
ROUNDS = 4
# Rays end this share of their length before the light.
END = np.float32(1.0 - 1e-4)
_ZERO, _ONE, _TINY = np.float32(0.0), np.float32(1.0), np.float32(1e-30)


@dataclass(frozen=True)
class Visibility:
    """Shares of L lights that P samples see by pass, in [0, 1]; None for a pass that was not asked for.

    Exactly 1 where nothing is in the way, and where no light arrives anyway; exactly 0 where all is blocked.
    """

    specular: np.ndarray | None  # (L, P) float32
    diffuse: np.ndarray | None
    noise: dict[str, float]  # by pass: estimated relative L2 error of the light that all samples reflect together
    rays: int  # that were traced
    mixed: np.ndarray  # (L, P) bool: pairs of which some rays arrived and some did not


def visible_shares(
    samples: SurfaceSamples,
    lights: Sequence[AreaLight],
    tracer,
    *,
    passes: Sequence[str] = PASSES,
    rays: int = 32,
    film: Film | None = None,
    progress: Progress | None = None,
) -> Visibility:
    """At most `rays` for each pair of one of the P samples and a light, a multiple of 8.

    `film` says which samples are neighbors; left out: those before and after. The result is the same for any number of
    threads. `progress` may return False to stop: Cancelled is raised.
    """
    if rays < PROBES or rays % PROBES:
        raise ValueError(f"shadow rays are {rays}, expected a multiple of {PROBES}")
    shape = (len(lights), len(samples))
    shares = {name: np.ones(shape, np.float32) for name in passes}
    mixed = np.zeros(shape, bool)
    sums = {name: np.zeros((3, len(samples))) for name in passes}
    neighbors = Neighbors.of(film, len(samples))
    seeds, traced = seeds_of(samples.position), 0
    with ThreadPoolExecutor(cores()) as pool:
        for number, light in enumerate(lights):
            if progress is not None and progress("shadows", number / len(lights)) is False:
                raise Cancelled("shadows were stopped")
            work = _LightWork(samples, light, tracer, passes, seeds, pool)
            work.trace(rays, neighbors)
            traced += work.traced
            mixed[number, work.index] = work.mixed
            for name in passes:
                shares[name][number, work.index] = work.shares(name)
                work.add_noise(name, sums[name])
    noise = {name: float(np.sqrt(error.sum() / max(np.square(light).sum(), 1e-30))) for name, (error, light, _) in sums.items()}
    return Visibility(shares.get("specular"), shares.get("diffuse"), noise, traced, mixed)


@dataclass(frozen=True)
class Neighbors:
    """Which samples are close to each other: those of a pixel and of the pixels around it."""

    pixel: np.ndarray  # (P,)
    width: int
    height: int

    @classmethod
    def of(cls, film: Film | None, count: int) -> Neighbors:
        if film is None:
            return cls(np.arange(count), count, 1)
        return cls(film.pixel, film.width, film.height)

    def of_mixed(self, index: np.ndarray, visible: np.ndarray, blocked: np.ndarray) -> np.ndarray:
        """Mask (Q,) of the samples `index` around which some light is `visible` (Q,) and some is `blocked` (Q,)."""
        found = [self._around(self.pixel[index], mask)[self.pixel[index]] for mask in (visible, blocked)]
        return found[0] & found[1]

    def _around(self, pixel, mask):
        marked = np.zeros(self.width * self.height, bool)
        marked[pixel[mask]] = True
        grid = np.pad(marked.reshape(self.height, self.width), 1)
        grid = grid[1:-1] | grid[:-2] | grid[2:]
        return (grid[:, 1:-1] | grid[:, :-2] | grid[:, 2:]).ravel()


class _LightWork:
    """All pairs of one light: which there are, and what their rays have found so far."""

    def __init__(self, samples, light, tracer, passes, seeds, pool):
        self.samples, self.tracer, self.seeds, self.pool = samples, tracer, seeds, pool
        self.emitter, self.light = Emitter(light), light
        lobes = dict(zip(("diffuse", "specular"), has_lobe(samples), strict=True))
        wanted = {
            name: lobes[name] & (name in passes) & getattr(light, f"affects_{name}") for name in ("diffuse", "specular")
        }
        index = in_front(samples, light, np.flatnonzero(wanted["diffuse"] | wanted["specular"]))
        self.index = index
        self.wanted = {name: mask[index] for name, mask in wanted.items()}
        # By pass, half of the rays, and sum of the weights or of those of the light that arrives.
        self.sums = np.zeros((2, 2, 2, len(index)), np.float32)
        self.visible, self.blocked = np.zeros(len(index), bool), np.zeros(len(index), bool)
        self.count = np.zeros(len(index), np.int32)
        self.traced = 0

    @property
    def mixed(self) -> np.ndarray:
        return self.visible & self.blocked

    def trace(self, rays: int, neighbors: Neighbors) -> None:
        """Probes for all pairs, and up to `rays` for those that need them."""
        self._add_rays(np.arange(len(self.index)), 0, PROBES)
        for _ in range(ROUNDS):
            mask = neighbors.of_mixed(self.index, self.visible, self.blocked) & (self.count < rays)
            # Nothing above the horizon was met so far.
            mask |= (self.sums[:, :, 0].sum(axis=1) == 0.0).any(axis=0) & (self.count < rays)
            if rays == PROBES or not mask.any():
                break
            self._add_rays(np.flatnonzero(mask), PROBES, rays)

    def _add_rays(self, members, first, last):
        """Rays `first` to `last` for the pairs `members` (M,)."""
        if self.light.receivers == ():
            return
        for kind in ((True, True), (True, False), (False, True)):
            chosen = members[(self.wanted["diffuse"][members] == kind[0]) & (self.wanted["specular"][members] == kind[1])]
            size = max(BLOCK_RAYS // (last - first), 1)
            blocks = [chosen[start : start + size] for start in range(0, len(chosen), size)]
            for block, found in zip(blocks, self.pool.map(lambda b: self._block(b, kind, first, last), blocks), strict=True):
                sums, visible, blocked, traced = found
                self.sums[..., block] += sums
                self.visible[block] |= visible
                self.blocked[block] |= blocked
                self.traced += traced
        self.count[members] = last

    def _block(self, members, kind, first, last):
        """Sums (2, 2, 2, Q), whether some rays arrive and some do not (Q,), and how many rays were traced."""
        index = self.index[members]
        view = _View(self.samples, index, self.emitter, kind)
        towards, weights, distance = view.rays(self.seeds[index], first, last)
        met = np.flatnonzero(np.logical_or.reduce([weight > 0.0 for weight in weights if weight is not None]))
        shape = distance.shape
        column = met % shape[1]
        origins = np.stack([np.take(row, column) for row in view.origin])
        directions = np.stack([np.take(row, met) for row in towards])
        masks = np.full(len(met), 0xFFFFFFFF, np.uint32)
        transmittance = np.zeros(shape, np.float32)
        found = self.tracer.transmittance(origins.T, directions.T, np.take(distance, met) * END, masks)
        transmittance.ravel()[met] = found
        sums = np.zeros((2, 2, 2, shape[1]), np.float32)
        for number, weight in enumerate(weights):
            if weight is not None:
                seen = weight * transmittance
                for half in range(2):
                    sums[number, half, 0] = weight[half::2].sum(axis=0)
                    sums[number, half, 1] = seen[half::2].sum(axis=0)
        visible, blocked = np.zeros(shape, bool), np.zeros(shape, bool)
        visible.ravel()[met] = found > 0.0
        blocked.ravel()[met] = found < 1.0
        return sums, visible.any(axis=0), blocked.any(axis=0), len(met)

    def shares(self, name: str) -> np.ndarray:
        """Shares (Q,) of the pairs."""
        whole, seen = self.sums[PASSES.index(name)].sum(axis=0)
        return np.divide(seen, whole, out=np.ones_like(seen), where=whole > 0.0)

    def add_noise(self, name: str, sums: np.ndarray) -> None:
        pass


class _View:
    """A light seen from the points of a block, single precision, arrays (Q,) and lists of three of them."""

    def __init__(self, samples, index, emitter, kind):
        self.samples, self.emitter = samples, emitter
        self.has_diffuse, self.has_specular = kind
        light = emitter.light
        position = samples.position[index]
        self.origin = np.ascontiguousarray(position.T, dtype=np.float32)
        offset = (light.center - position).T
        self.height = (-(light.direction @ offset)).astype(np.float32)
        self.offset = np.ascontiguousarray(offset, dtype=np.float32)
        corners = emitter.corners_from(self.offset, self.height)
        self.quads = SphericalQuads(corners)

        def vectors(name):
            return np.ascontiguousarray(getattr(samples, name)[index].T, dtype=np.float32)

        def numbers(name):
            return getattr(samples, name)[index].astype(np.float32)

        def means(name):
            return getattr(samples, name)[index].mean(axis=1, dtype=np.float32)

        if self.has_diffuse:
            self.diffuse_normal, self.smooth_normal = vectors("diffuse_normal"), vectors("smooth_normal")
            self.is_bumped = (self.diffuse_normal != self.smooth_normal).any()
            self.bump_alpha2 = numbers("bump_alpha2")
        if self.has_specular:
            normal, view = vectors("normal"), vectors("view")
            self.geometric_normal = vectors("geometric_normal")
            self.cosine, self.sine, rows = _frames(normal, view)
            self.alpha = np.maximum(np.square(numbers("roughness")), np.float32(1e-5))
            self.warps = Warps(rows, self.cosine, self.sine, self.alpha)
            warped = [self.warps.warped(self.warps.local([c[k] for c in corners])) for k in range(4)]
            self.warped_quads = SphericalQuads(np.stack([np.stack([warped[k][i] for k in range(4)]) for i in range(3)]))
            self.f0, self.rise, self.dip, self.dielectric = (
                means(name) for name in ("specular_f0", "specular_f90", "specular_dip", "dielectric")
            )
            self.rise = self.rise - self.f0
            self.ior = np.maximum(numbers("ior"), _ONE)

    def rays(self, seeds, first, last):
        """Unit vectors, three (S, Q), weights (S, Q) or None of the specular and the diffuse lobe, distances (S, Q)."""
        shares = [0.5, 0.5] if self.has_specular and self.has_diffuse else [float(self.has_diffuse), float(self.has_specular)]
        towards, local, length = [], [], []
        for number, share in enumerate(shares):
            if share == 0.0:
                continue
            x, y = unit_points(seeds, number, int(first * share), int(last * share))
            if number == 0:
                towards.append(self.quads.directions(x, y))
                if self.has_specular:
                    local.append(self.warps.local(towards[-1]))
                    length.append(np.sqrt(dot(*[self.warps.warped(local[-1])] * 2)))
            else:
                inside, size = self.warps.unwarped(self.warped_quads.directions(x, y))
                local.append(inside)
                length.append(size)
                towards.append(self.warps.world(inside))
        towards = [np.concatenate(parts) for parts in zip(*towards, strict=True)]
        light = self.emitter.light
        falling = -dot(towards, light.direction.astype(np.float32))
        distance = self.height / np.maximum(falling, _TINY)
        density = np.divide(np.float32(shares[0]), np.maximum(self.quads.solid_angle, _TINY))
        if self.has_specular:
            local = [np.concatenate(parts) for parts in zip(*local, strict=True)]
            length = np.concatenate(length)
            scale = np.float32(shares[1]) * self.warps.determinant / np.maximum(self.warped_quads.solid_angle, _TINY)
            density = density + scale / (length * length * length)
        factor = (falling > 0.0) / density
        brightness = self.emitter.brightness(towards, distance, self.offset, self.height)
        if brightness is not None:
            factor *= brightness
        specular = factor * self._specular(towards, local) if self.has_specular else None
        diffuse = factor * self._diffuse(towards) if self.has_diffuse else None
        return towards, (specular, diffuse), distance

    def _diffuse(self, towards):
        cosine = np.maximum(dot(towards, self.diffuse_normal), _ZERO)
        if not self.is_bumped:
            return cosine
        above = np.maximum(dot(towards, self.smooth_normal), _ZERO)
        squared = above * above
        # 2 / (1 + sqrt(1 + bump_alpha2 tan^2)) without a quotient by the cosine
        shadowing = 2.0 * above / np.maximum(above + np.sqrt(squared + self.bump_alpha2 * (_ONE - squared)), _TINY)
        return cosine * shadowing

    def _specular(self, towards, local):
        x, y, z = local
        half_x, half_z = x + self.sine, z + self.cosine
        horizontal, vertical = half_x * half_x + y * y, half_z * half_z
        alpha2 = self.alpha * self.alpha
        squared = horizontal + vertical
        ratio = squared / (horizontal + alpha2 * vertical)
        mu = np.maximum(z, _ZERO)
        length_o = np.sqrt(self.cosine * self.cosine * (_ONE - alpha2) + alpha2)
        length_i = np.sqrt(mu * mu * (_ONE - alpha2) + alpha2)
        value = alpha2 * ratio * ratio * mu / (self.cosine * length_i + mu * length_o)
        cosine = np.minimum(0.5 * np.sqrt(squared), _ONE)
        reflectance = self.f0 + self.rise * (_ONE - cosine) ** 5
        if self.dip.any():
            reflectance -= self.dip * cosine * (_ONE - cosine) ** 6
        if self.dielectric.any():
            reflectance += self.dielectric * dielectric_reflectance(cosine, self.ior)
        value *= np.maximum(reflectance, _ZERO)
        value *= dot(towards, self.geometric_normal) > 0.0
        return value


def _frames(normal, view):
    """Cosine and sine (Q,) of the view's angle from the normal, both (3, Q), and local frames (3, 3, Q)."""
    cosine = dot(normal, view)
    across = view - cosine * normal
    sine = np.sqrt(dot(across, across))
    axis = np.eye(3, dtype=np.float32)[np.argmin(np.abs(normal), axis=0)].T
    other = axis - dot(axis, normal) * normal
    tangent = np.where(sine > 1e-6, across, other)
    tangent = tangent / np.sqrt(dot(tangent, tangent))
    bitangent = np.cross(normal, tangent, axis=0)
    return np.clip(cosine, _ZERO, _ONE), sine, np.stack([tangent, bitangent, normal])


_SEQUENCES = {}


def unit_points(seeds, stream, first, last):
    """x, y (S, Q) in [0, 1) of the points `first` to `last` of the sequence, changed by the seeds (Q,)."""
    points = sequence(1024, stream + 1)[:, first:last] if stream not in _SEQUENCES else _SEQUENCES[stream][:, first:last]
    found = []
    for axis in range(2):
        own = _own(seeds, 2 * stream + axis)
        found.append(((points[axis][:, None] ^ own) + np.float32(0.5)) * np.float32(2.0**-BITS))
    return found


def _own(seeds, number):
    from .directions import _mixed
    return (_mixed(seeds + np.uint32(number * 0x9E3779B1 & 0xFFFFFFFF)) >> np.uint32(32 - BITS))
