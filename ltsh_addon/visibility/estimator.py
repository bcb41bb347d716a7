"""`RatioEstimator`: the rays from samples to one emitter, and the visibility of the emitter that they tell.

Every pair of a sample and a light gets a few probe rays. If all arrive, or all are blocked, the pair is settled, unless
a neighbor in the picture says otherwise. The other pairs get more rays, the more light they reflect.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from ..emitters.facing import FacingDisk
from ..emitters.light_polygons import may_reach, off_plane
from ..lobes.polygon import dot
from ..scene import FARTHEST, PASSES, Film, FlatLight, PointLight, PolygonLight, round_outline
from .emitter import Emitter, Sky
from .light_cluster import LightCluster
from .light_selection import LightSelection
from .occluders import GAP
from .ray_sampler import PROBES, RayBatch, RaySampler, SampleRows
from .shadow_terminator import toward

MOST_RAYS = 1024
# Rays of a block, few enough for its arrays to stay in the cache.
BLOCK_RAYS = 1 << 15
# How many of PROBES rays are spread evenly over the light; the specular lobe chooses the others. Rows: pairs with both
# lobes, with a diffuse lobe only, with a specular lobe only. Columns: both lobes count alike (always so for the
# probes), the specular lobe counts more, the diffuse lobe counts more.
LIGHT_SAMPLED = np.array([[4, 2, 6], [8, 8, 8], [2, 2, 2]])
# A pair gets rays in proportion to this power of its light relative to that of a typical sample. The reason: the square
# root of the variance of stratified rays falls with their number to the power -0.8.
WORTH_POWER = 0.75
# Rays of a pair as bright as a typical sample, as a share of the most rays of a pair.
TYPICAL_SHARE = 0.4
# Numbers of rays that a pair may get, besides the probes and the most rays.
LEVELS = (16, 32, 64, 128, 256, 512)
# The brightest pairs may get this many times the most rays of a pair: where lobes are narrow and lights half visible, a
# few pixels cause most of the noise of a picture.
BRIGHTEST, BRIGHTEST_OF_SKY = 4, 2
# A pair needs more rays only if some of them arrive, and some do not, that carry more than this share of its light.
NEGLIGIBLE = np.float32(0.01)
# Where less than the share WINDOW of a sky arrives in the mean, no pair is settled by its probes.
WINDOW = 0.05
# Rounds in which neighbors of mixed pairs get more rays. Neighbors that turn out mixed pass this on in the next round;
# where little light comes through a window, probes meet it so rarely that it takes many.
ROUNDS = 16
# Samples that share the rays to a sky or to many lights are alike: their normals differ by at most LIKE_NORMAL, they
# lie in one plane but for a slope of LIKE_NORMAL, and for the specular pass their mirrored views differ by LIKE_LOBE
# alpha, and the alphas by LIKE_ALPHA of one.
LIKE_NORMAL, LIKE_LOBE, LIKE_ALPHA = np.float32(0.1), np.float32(0.4), np.float32(0.2)
# Samples do not share rays where that would change their light by more than this share of the typical one, nor where
# all their rays are blocked: of so many rays.
MOST_BIAS, ENOUGH_RAYS = 0.01, 64
# Samples that see nothing share nothing, unless that is as likely as this by what is seen around: few rays count.
BY_CHANCE = 1e-7
# Texels have the mean share of like ones around where it is at most MOST_OFF standard deviations from their own, and by
# its curvature at most MOST_BENT of them wrong.
MOST_OFF, MOST_BENT = np.float32(3.0), np.float32(0.5)
# Pairs of opposite pixels (y, x) around a pixel that share rays. The weights of the kernel (1, 2, 2, 2, 1) x (1, 2, 2,
# 2, 1) count all places of a square of 4 x 4 pixels alike. TILE: how many pixels this is worth, as measured.
AROUND = [(y, x) for y in range(-2, 3) for x in range(-2, 3) if (y, x) > (0, 0)]
KERNEL, CENTER = np.array([(2 - abs(y) // 2) * (2 - abs(x) // 2) for y, x in AROUND], np.float32), np.float32(4.0)
TILE = np.float32(12.0)
# Numbers of AROUND two pixels away, and what the kernel adds to a picture per second difference of these: half its
# variance of 1.5 pixels over the squared distance.
ACROSS, BEND = [AROUND.index(step) for step in ((0, 2), (2, 0))], np.float32(0.75 / 4.0)
# Rays end at this share of their distance to the light, just before it; but to a light with a face as near as that, GAP
# of the coordinates before its surface, a step of single precision, or MESH_STEPS of them before a face that glows.
# FACE_STEPS: but never nearer than so many to a face that glows, which would be in its own light: far from the origin.
END, MESH_STEPS, FACE_STEPS = np.float32(1.0 - 1e-4), 16.0, 2.0
# Points along each side of a flat light from which near faces are looked for; as many squared around a point.
LOOKED_AT = 8
_ZERO, _ONE, _TINY = np.float32(0.0), np.float32(1.0), np.float32(1e-30)
# Points of the unit disk to aim at, for lights that face the points.
OUTLINE = 0.99 * round_outline(16)
_FARTHEST = np.float32(FARTHEST)


class PixelNeighbors:
    """Which samples are close to each other in a picture: those in the same pixel and in the eight pixels around it.
    Like ones up to two pixels away may share rays."""

    def __init__(self, film: Film | None, surface: SampleRows):
        """The neighbors in `film`; without one, each sample is close to those before and after it, and shares
        nothing."""
        count = surface.position.shape[1]
        self.order, self._surface = None, surface
        self.pixel, self.width, self.height = np.arange(count), count, 1
        if film is not None and count:
            y, x = np.divmod(film.pixel, film.width)
            self.order = _order_in_squares(y, x)
            # The film may hold a part of a picture.
            self._y, self._x = y - y.min(), x - x.min()
            self.width, self.height = int(self._x.max()) + 1, int(self._y.max()) + 1
            self.pixel = self._y * self.width + self._x

    @cached_property
    def _around(self) -> np.ndarray:
        """The samples (N, 2, P) in the pixels of AROUND, -1 for none. Of the samples of a pixel, the first goes with
        the first of another, and so on."""
        by_pixel = np.argsort(self.pixel, kind="stable")
        rank, pixel = np.empty_like(by_pixel), self.pixel[by_pixel]
        rank[by_pixel] = np.arange(len(pixel)) - np.searchsorted(pixel, pixel)
        grid = np.full((self.height + 4, self.width + 4, rank.max() + 1), -1, np.int32)
        y, x = self._y + 2, self._x + 2
        grid[y, x, rank] = np.arange(len(rank))
        return np.stack([[grid[y + sign * dy, x + sign * dx, rank] for sign in (1, -1)] for dy, dx in AROUND])

    @cached_property
    def _alike(self) -> dict[str, np.ndarray]:
        """Masks (N, P) by pass: the sample and those of AROUND are alike."""
        surface, around = self._surface, self._around
        alike = {name: np.zeros(around[:, 0].shape, bool) for name in PASSES}
        mirrored = np.float32(2.0) * dot(surface.normal, surface.view) * surface.normal - surface.view
        alpha = surface.alpha
        sharp = alpha if surface.tangent is None else alpha * np.maximum(_ONE - np.abs(surface.anisotropy), _ZERO)
        width = LIKE_LOBE * np.maximum(sharp, np.float32(1e-4))
        traits = [surface.receiver, *surface.lobes.values()]
        for number, both in enumerate(around):
            here = np.flatnonzero((both >= 0).all(axis=0))
            near = np.ones(len(here), bool)
            for other in both[:, here]:
                for normal in (surface.geometric_normal, surface.diffuse_normal):
                    near &= _apart(normal, here, other) < LIKE_NORMAL**2
                height = dot(np.take(surface.position, other, 1) - np.take(surface.position, here, 1),
                             np.take(surface.geometric_normal, here, 1))  # fmt: skip
                near &= height * height <= LIKE_NORMAL**2 * _apart(surface.position, here, other)
                near &= np.logical_and.reduce([trait[other] == trait[here] for trait in traits])
            alike["diffuse"][number, here] = near
            for other in both[:, here]:
                near &= _apart(mirrored, here, other) < np.square(width[here])
                near &= np.abs(alpha[other] - alpha[here]) <= LIKE_ALPHA * alpha[here]
            alike["specular"][number, here] = near
        return alike

    def sharing(self, name: str, index: np.ndarray) -> np.ndarray:
        """With how many samples, from 1 to TILE, the samples `index` (Q,) share their rays in a pass, itself
        included."""
        whole = CENTER + 2.0 * KERNEL.sum()
        return np.maximum(TILE * (CENTER + 2.0 * (KERNEL @ self._alike[name][:, index])) / whole, _ONE)

    def shared(self, name: str, index: np.ndarray, values: np.ndarray) -> np.ndarray:
        """Weighted means (..., Q) of `values` (..., Q) of the samples `index` (Q,) and of like ones around."""
        sums, total = CENTER * values, np.full(len(index), CENTER)
        for number, weight in enumerate(KERNEL):
            here, one, other = self._like_pairs(name, index, number)
            sums[..., here] += weight * (values[..., one] + values[..., other])
            total[here] += 2.0 * weight
        return sums / total

    def bend(self, name: str, index: np.ndarray, values: np.ndarray) -> np.ndarray:
        """What `shared` has changed (Q,) where its result `values` (Q,) is curved, approximately."""
        change = np.zeros(len(index), np.float32)
        for number in ACROSS:
            here, one, other = self._like_pairs(name, index, number)
            change[here] += BEND * (values[one] + values[other] - 2.0 * values[here])
        return change

    def _like_pairs(self, name, index, number):
        """Of the samples `index` (Q,), the numbers (R,) of those that are like both opposite ones of AROUND; and the
        numbers (R,) of these."""
        place = np.full(len(self.pixel), -1, np.int32)
        place[index] = np.arange(len(index), dtype=np.int32)
        here = np.flatnonzero(self._alike[name][number, index])
        one, other = place[self._around[number][:, index[here]]]
        good = (one >= 0) & (other >= 0)
        return here[good], one[good], other[good]

    def any_around(self, index: np.ndarray, mask: np.ndarray) -> np.ndarray:
        """Mask (Q,) of the samples `index` (Q,): is `mask` (Q,) true for at least one of the samples around?"""
        pixel = self.pixel[index]
        marked = np.zeros(self.width * self.height, bool)
        marked[pixel[mask]] = True
        grid = np.pad(marked.reshape(self.height, self.width), 1)
        grid = grid[1:-1] | grid[:-2] | grid[2:]
        return (grid[:, 1:-1] | grid[:, :-2] | grid[:, 2:]).ravel()[pixel]


def _apart(vectors, here, other):
    """Squared distances (R,) of the vectors (3, P) at the indices `here` and `other` (R,)."""
    step = np.take(vectors, other, axis=1) - np.take(vectors, here, axis=1)
    return dot(step, step)


def _order_in_squares(y, x):
    """Numbers (P,) uint32 of pixels square by square, in each of these square by square, and so on. They repeat every
    512 pixels."""
    number = np.zeros(len(x), np.uint32)
    for bit in range(9):
        number |= (((x >> bit & 1) << 2 * bit) | ((y >> bit & 1) << 2 * bit + 1)).astype(np.uint32)
    return number


@dataclass(frozen=True)
class RaysOfSurface:
    """Rays (R,) that meet different things depending on who chooses them: the surface or the light."""

    flat: np.ndarray  # in the flattened (S, Q) of all rays
    visibility: np.ndarray  # transmittance of the ray that the surface chooses
    index: np.ndarray  # number of the sample
    directions: np.ndarray  # (3, R)
    solid_angle: np.ndarray  # of the light, sr
    is_alone: np.ndarray  # True where the light never chooses this direction


class RatioEstimator:
    """The samples that an emitter may reach, and what their rays have found so far. `number` is the emitter's number in
    `selection`."""

    def __init__(self, surface: SampleRows, emitter: Emitter | LightCluster, number: int, selection: LightSelection):
        light = emitter.light
        self.surface, self.emitter, self.light = surface, emitter, light
        occluders = surface.tracer.occluders
        self.mask = np.uint32(occluders.mask_of(light.name))
        self.surface_mask = np.uint32(occluders.surface_mask_of(light.name))
        # The faces of a mesh light block rays to the mesh itself.
        self.is_mesh = emitter.has_mesh if isinstance(emitter, LightCluster) else isinstance(light, PolygonLight)
        self.at_surface = self.is_mesh or isinstance(emitter, LightCluster)
        self.chosen_by, self.number, self.selection = occluders.chosen_by(light.name), number, selection
        # Rays that the surface and the light choose meet the same, but for those that are lifted.
        self.meet_the_same = self.chosen_by.light and self.mask == self.surface_mask
        origins = light.viewpoint(surface.position)
        offset = (light.center[:, None] - origins).astype(np.float32)
        ahead = np.ones(offset.shape[1], bool)
        if not light.is_facing and not isinstance(emitter, LightCluster):
            ahead = dot(light.direction.astype(np.float32), offset) < -off_plane(
                light.center, np.abs(origins).sum(axis=0)
            )
        if light.has_spread or light.is_facing:
            ahead &= may_reach(light, surface.position)
        if light.receivers is not None:
            ahead &= light.receives(surface.receiver)
        radius, self.wanted, above = np.float32(1.001 * light.radius), {}, {}
        for name, lobe in surface.lobes.items():
            self.wanted[name] = lobe & ahead & getattr(light, f"affects_{name}")
            for normal in surface.horizons(name):
                if id(normal) not in above:
                    above[id(normal)] = dot(normal, offset) > -radius
                self.wanted[name] &= above[id(normal)]
        self.index = np.flatnonzero(self.wanted["specular"] | self.wanted["diffuse"])
        self.wanted = {name: wanted[self.index] for name, wanted in self.wanted.items()}
        count = len(self.index)
        # Sums of all weights, and of the weights times transmittance, by pass and half of the rays
        self.sum_w, self.sum_wv = np.zeros((2, 2, 2, count), np.float32)
        self.visible, self.blocked = np.zeros(count, bool), np.zeros(count, bool)
        self.count = np.zeros(count, np.int32)
        self.traced = 0
        # How far before the plane of the light rays end, in m, but for what follows from their length; 0: at END.
        self.margin, self.is_tiny = _ZERO, False
        self.rounding = np.float32(FACE_STEPS * GAP * np.abs(light.center).sum()) if self.is_mesh else _ZERO
        self.is_shared = np.zeros(count, bool)

    def trace(self, rays: int, neighbors: PixelNeighbors, typical: dict[str, float], importance: np.ndarray) -> None:
        """Trace the probes of all pairs, then up to `rays` rays for pairs that need them. How many depends on the light
        and the `importance` (P,) of the sample. `typical` comes from `typical_radiance`."""
        if self.mask == 0 or not self.light.area_vector.any():
            return
        if isinstance(self.light, FlatLight | PointLight) and len(self.index):
            self.margin = self._margin()
            self.at_surface |= bool(self.margin)
        shares = isinstance(self.emitter, Sky | LightCluster) and neighbors.order is not None and rays > PROBES
        self._neighbors, order = neighbors, neighbors.order if shares else None
        self._add_rays(np.arange(len(self.index)), 0, PROBES, 0, order)
        self._leave_out_unlit()
        # The probes of a cluster go to a few of its lights; those that count may be others.
        for last in LEVELS if isinstance(self.emitter, LightCluster) and rays > PROBES else ():
            unmet, first = np.flatnonzero(np.logical_or(*self._unmet())), int(self.count.max(initial=0))
            self._add_rays(unmet, first, min(last, rays), 0)
        importance = importance[self.index]
        worth = {name: importance * self.unshadowed(name) / max(typical.get(name, 0.0), 1e-30) for name in PASSES}
        choice = np.where(worth["specular"] > 2.0 * worth["diffuse"], 1, 0)
        choice[worth["diffuse"] > 2.0 * worth["specular"]] = 2
        by_pass = [self._wanted_rays(rays, worth[name], importance) for name in PASSES]
        number = alone = self._level(rays, np.maximum(*by_pass))
        if shares:
            sharing = [neighbors.sharing(name, self.index) for name in PASSES]
            each = [np.where(self.wanted[name], by_pass[k] / sharing[k], 0.0) for k, name in enumerate(PASSES)]
            number = self._level(rays, np.maximum(*each))
            self.is_shared = alone > PROBES
        for _ in range(ROUNDS):
            chosen = np.logical_and(*(neighbors.any_around(self.index, mask) for mask in self._lit_and_dark()))
            chosen |= np.logical_or(*self._unmet())
            chosen &= self.count < number
            if not chosen.any():
                break
            self._trace_more(chosen, number, choice, order)
        if shares:
            self._trace_alone(alone, choice, worth)
        self._aim_at_corners()

    def _trace_alone(self, number, choice, worth):
        """Give up sharing where that changes the light: there, trace up to `number` (Q,) rays anew."""
        self._add_unlucky()
        alone = ~self.visible
        for last in (np.minimum(number, ENOUGH_RAYS), number):
            alone &= self.is_shared & (self.count > PROBES)
            self.is_shared &= ~alone
            for sums in (self.sum_w, self.sum_wv):
                sums[:, :, alone] = 0.0
            self._add_rays(np.flatnonzero(alone), 0, PROBES, 0)
            self._trace_more(alone & (last > PROBES), last, choice, None)
            alone = np.zeros(len(self.index), bool)
            for name, sum_w, sum_wv in zip(PASSES, self.sum_w.sum(axis=1), self.sum_wv.sum(axis=1), strict=True):
                ratio = self.visibility_ratio(name)[0]
                change = np.abs(self._neighbors.bend(name, self.index, ratio))
                if isinstance(self.emitter, LightCluster):
                    # Shadows as narrow as a pixel: its rays are three standard deviations off what it shares.
                    off = np.abs(sum_wv / np.maximum(sum_w, _TINY) - ratio)
                    change = np.maximum(change, off - np.float32(3.0) * np.sqrt(ratio * (_ONE - ratio) / self.count))
                alone |= change * worth[name] ** WORTH_POWER > MOST_BIAS

    def _add_unlucky(self):
        """Let pairs that saw nothing count as `visible` where as few rays would often see nothing of what is seen
        around."""
        missed = ~self.visible
        for name, sum_w, sum_wv in zip(PASSES, self.sum_w.sum(axis=1), self.sum_wv.sum(axis=1), strict=True):
            passing, met = self._neighbors.shared(name, self.index, np.stack([sum_wv, sum_w * self.visible]))
            missed &= (_ONE - passing / np.maximum(met, _TINY)) ** self.count > BY_CHANCE
        self.visible |= missed

    def _trace_more(self, chosen, number, choice, order):
        """Trace rays of the `chosen` pairs up to the `number`, split by `choice`; each (Q,)."""
        for first, last, split in np.unique([self.count[chosen], number[chosen], choice[chosen]], axis=1).T.tolist():
            members = np.flatnonzero(chosen & (self.count == first) & (number == last) & (choice == split))
            self._add_rays(members, first, last, split, order)

    def _margin(self):
        """How far before the light's surface rays end, in m, if a face is so near that END may be behind it; else 0."""
        light, emitter = self.light, self.emitter
        offset = self.surface.position[:, self.index] - light.center[:, None]
        near = 2.0 * (1.0 - END) * (np.sqrt(np.square(offset).sum(axis=0).max()) + light.radius * light.is_facing)
        margin, length = GAP * (np.abs(light.direction) @ np.abs(light.center)) + 1e-12, 2.0 * near
        if isinstance(emitter, LightCluster):
            points, normal = light.center + emitter.corners.mean(axis=1).T, emitter.normal.T
            margin = GAP * (np.abs(light.center).max() + light.radius)
        elif light.is_facing:
            # Evenly spread over a sphere: a spiral.
            z = (np.arange(LOOKED_AT**2) + 0.5) * (2.0 / LOOKED_AT**2) - 1.0
            turn = (np.sqrt(1.0 - z * z), np.arange(len(z)) * np.pi * (3.0 - np.sqrt(5.0)))
            normal = np.column_stack([turn[0] * np.cos(turn[1]), turn[0] * np.sin(turn[1]), z])
            points, length = light.center + light.radius * normal, length + light.radius
            # The directions to a small light are uncertain; those to its center are not, which then stands for it.
            self.is_tiny = light.radius < 0.1 * near
            margin = 4.0 * GAP * (np.abs(light.center).sum() + near / (1.0 - END))
        else:
            s, t = np.meshgrid(*2 * [(np.arange(LOOKED_AT) + 0.5) * (2.0 / LOOKED_AT) - 1.0])
            points = light.center + s.reshape(-1, 1) * light.half_u + t.reshape(-1, 1) * light.half_v
            normal = np.broadcast_to(light.direction, points.shape)
        if self.is_mesh:
            margin = MESH_STEPS * GAP * (np.abs(light.center).sum() + light.radius) + 1e-12
            length = near - margin
        rays = points + near * normal, -normal, np.full(len(points), length), np.full(len(points), self.mask)
        return _ZERO if (self.surface.tracer.transmittance(*rays) == 1.0).all() else np.float32(margin)

    def _wanted_rays(self, rays, worth, importance):
        """Number of rays (Q,) that each pair is worth, by the unshadowed light that it reflects relative to a typical
        sample, times the `importance` (Q,)."""
        # A sky or a cluster stands for many lights and gets the rays of all of them.
        share = 1.0 if isinstance(self.emitter, Sky | LightCluster) else TYPICAL_SHARE
        wanted = rays * share * worth**WORTH_POWER
        if isinstance(self.emitter, Sky):
            # Points lit by the sky alone are dark beside those lit by a sun in it: do not let them go short.
            wanted = np.maximum(wanted, 0.25 * rays * importance)
        return wanted

    def _level(self, rays, wanted):
        """The number of rays (Q,) to trace where so many are `wanted`."""
        limit = rays
        if not isinstance(self.emitter, LightCluster) and rays > PROBES:
            limit = min((BRIGHTEST_OF_SKY if isinstance(self.emitter, Sky) else BRIGHTEST) * rays, MOST_RAYS)
        levels = [level for level in LEVELS if level < limit] + [limit]
        return np.take(levels, np.searchsorted(levels, np.minimum(wanted, limit)))

    def _lit_and_dark(self):
        """Masks (2, Q) of the pairs of which a lobe has a share of more than NEGLIGIBLE, and less than 1 by as much."""
        sums, passing = self.sum_w.sum(axis=1), self.sum_wv.sum(axis=1)
        # Where little of a light arrives anywhere, as through a window, little is not negligible.
        arriving = passing.sum(axis=1, keepdims=True) / np.maximum(sums.sum(axis=1, keepdims=True), _TINY)
        lit = passing > NEGLIGIBLE * arriving * sums
        if self.is_shared.any() and isinstance(self.emitter, Sky):
            lit |= (arriving > 0.0) & (arriving < WINDOW)
        return [lit.any(axis=0), (sums - passing > NEGLIGIBLE * sums).any(axis=0)]

    def _unmet(self):
        """Masks (Q,) by pass of the pairs with a lobe that no ray has met so far."""
        return [self.wanted[name] & (sums.sum(axis=0) == 0.0) for name, sums in zip(PASSES, self.sum_w, strict=True)]

    def _corner_heights(self, name, members):
        """Least height (V, M) of the light's corners over the horizons of a lobe, and the offsets (3, V, M) from the
        samples to the corners."""
        surface, index = self.surface, self.index[members]
        if isinstance(self.emitter, LightCluster):
            return RaySampler(surface, index, self.emitter, (name,)).corner_heights(surface.horizons(name))
        center = self.light.center[:, None] - self.light.viewpoint(surface.position[:, index])
        if self.light.is_facing:
            normal = surface.horizons(name)[0][:, index]
            offset = FacingDisk.of(self.light, center.astype(np.float32), normal).corners(OUTLINE)
        else:
            offset = (self.emitter.outline.T[:, :, None] + center[:, None]).astype(np.float32)
        heights = [dot(offset, normal[:, None, index]) for normal in surface.horizons(name)]
        return np.minimum.reduce(heights), offset

    def _leave_out_unlit(self):
        """Drop lobes for which the whole light is below the horizon."""
        for name, unmet in zip(PASSES, map(np.flatnonzero, self._unmet()), strict=True):
            self.wanted[name][unmet] = self._corner_heights(name, unmet)[0].max(axis=0) > 0.0

    def _aim_at_corners(self):
        """Trace one ray to the highest corner of the light for each lobe that no ray met so far: such a lobe sees only
        a corner of the light."""
        for number, (name, unmet) in enumerate(zip(PASSES, map(np.flatnonzero, self._unmet()), strict=True)):
            if len(unmet) == 0:
                continue
            heights, offset = self._corner_heights(name, unmet)
            toward = np.take_along_axis(offset, heights.argmax(axis=0)[None, None], axis=1)[:, 0]
            distance = np.sqrt(dot(toward, toward))
            toward /= np.maximum(distance, _TINY)
            if self.light.is_distant:
                distance[:] = _FARTHEST
            aimed = self.surface.ray_origins.aimed(self.index[unmet], toward[:, None], distance[None], self.at_surface)
            visibility = _ONE
            if self.chosen_by.light:
                rays = (rows[..., 0, :] for rows in aimed[:3])
                visibility = self._transmittance(self.index[unmet], self.mask, _ONE, *rays)
            # Next to nothing, so that it does not count in sums over samples.
            self.sum_w[number][:, unmet] = _TINY
            self.sum_wv[number][:, unmet] = visibility * _TINY

    def _transmittance(self, index, mask, falling, origins, directions, distances):
        """Transmittance (R,) of rays of the samples `index` (R,) with a mask, `origins` and `directions` (3, R) and
        `distances` (R,), which meet the light at angles with the cosines `falling` (R,)."""
        self.traced += len(distances)
        if self.margin and self.is_tiny:
            directions = self.light.center[:, None] - origins
            distances = np.sqrt(dot(directions, directions))
            directions /= np.maximum(distances, _TINY)
        masks, ends = np.broadcast_to(mask, distances.shape), distances * END
        if self.margin:
            margin = self.margin / np.maximum(falling, _TINY)
            ends = np.maximum(ends, distances * np.float32(1.0 - GAP) - margin)
        if self.rounding:
            ends = np.clip(distances - self.rounding / np.maximum(falling, _TINY), _ZERO, ends)
        transmittance = self.surface.tracer.transmittance(origins.T, directions.T, ends, masks)
        if (touching := self.surface.ray_origins.past_touching(index, directions, mask)) is not None:
            rays, share = touching
            transmittance[rays] *= share
        return transmittance

    def _add_rays(self, members, first, last, split, order=None):
        """Trace the rays `first` to `last` of the pairs `members` (M,). `split` is a column of EVENLY."""
        diffuse, specular = (self.wanted[name][members] for name in ("diffuse", "specular"))
        for kind, chosen in enumerate((diffuse & specular, diffuse & ~specular, ~diffuse & specular)):
            chosen = members[chosen]
            for start in range(0, len(chosen), BLOCK_RAYS // PROBES):
                block = chosen[start : start + BLOCK_RAYS // PROBES]
                lobes = tuple(name for name in PASSES if self.wanted[name][block[0]])
                numbers = None if order is None else order[self.index[block]]
                sampler = RaySampler(self.surface, self.index[block], self.emitter, lobes, numbers)
                step = BLOCK_RAYS // (PROBES * len(block)) * PROBES
                for number in range(first, last, step):
                    light_sampled = LIGHT_SAMPLED[kind, 0], LIGHT_SAMPLED[kind, split]
                    batch = RayBatch(number, min(number + step, last), max(last, 2 * PROBES), *light_sampled)
                    self._add_block(block, sampler, batch)
        self.count[members] = last

    def _add_block(self, block, sampler, batch):
        """Trace some `batch` of the pairs `block` (B,) of a view."""
        directions, distance, weights = sampler.sample(batch)
        visibility, others = np.zeros(distance.shape, np.float32), None
        met = np.logical_or.reduce([weight > 0.0 for weight in weights.values()])
        flat = np.flatnonzero(met)
        *aimed, lifted = self.surface.ray_origins.aimed(sampler.index, directions, distance, self.at_surface)
        origins, *rest = (_taken(rows, flat) for rows in aimed)
        moved = None
        if self.surface.extent is not None:
            place = batch.places(self.surface.seeds[sampler.index], self.surface.extent.shape[1]).ravel()[flat]
            moved = self.surface.extent[:, place, sampler.index[flat % visibility.shape[1]]]
            origins, rest = origins + moved, toward(*rest, moved)
        visibility.ravel()[flat] = _ONE
        if self.chosen_by.light:
            falling = sampler.falling.ravel()[flat] if self.is_mesh or self.margin else _ONE
            index = sampler.index[flat % visibility.shape[1]]
            visibility.ravel()[flat] = self._transmittance(index, self.mask, falling, origins, *rest)
        if self.chosen_by.surface:
            if self.meet_the_same:
                is_lifted = np.zeros(visibility.size, bool)
                is_lifted[lifted] = True
                lifted = is_lifted[flat]
                origins, flat = origins[:, lifted], flat[lifted]
                moved = None if moved is None else moved[:, lifted]
            others = self._chosen_by_surface(sampler, (directions, distance), flat, (origins, moved), visibility)
        least, most = visibility, visibility
        if others is not None:
            least, most = visibility.copy(), visibility.copy()
            least.ravel()[others.flat] = np.minimum(others.visibility, visibility.ravel()[others.flat])
            most.ravel()[others.flat] = np.maximum(others.visibility, visibility.ravel()[others.flat])
        self.visible[block] |= most.sum(axis=0) > 0.0
        self.blocked[block] |= least.sum(axis=0) < met.sum(axis=0)
        for name, weight in weights.items():
            number, passing = PASSES.index(name), visibility
            if others is not None:
                passing = visibility.copy()
                rays = others.index, others.directions, others.solid_angle
                share = self.selection.bsdf_share(name, self.number, *rays)
                share[others.is_alone] = 1.0
                passing.ravel()[others.flat] += share * (others.visibility - visibility.ravel()[others.flat])
            for sums in (self.sum_w[number], self.sum_wv[number]):
                halves = sums[:, block]
                batch.add_to(halves, weight)
                sums[:, block] = halves
                weight *= passing

    def _chosen_by_surface(self, sampler, rays, flat, starts, light_visibility):
        """The rays at the places `flat` (R,) that the surface would choose and that then meet something else than the
        light's rays did; None if there are none. `starts` are the origins (3, R) of the light's rays, which have
        `light_visibility` (S, Q), and how far (3, R) they are from the sample, or None."""
        ray_origins, (origins, moved) = self.surface.ray_origins, starts
        directions, distance = (_taken(rows, flat) for rows in rays)
        index = sampler.index[flat % light_visibility.shape[1]]
        start, *ray = ray_origins.from_surface(index, directions, distance)
        if moved is not None:
            start, ray = start + moved, toward(*ray, moved)
        # The light chooses directions above the smooth horizon; the surface chooses directions above the mesh's.
        smooth, flat_facing = (
            dot(np.take(normal, index, axis=0).T, directions)
            for normal in (ray_origins.smooth_normal, ray_origins.geometric_normal)
        )
        is_alone = (smooth <= 0.0) & (flat_facing > 0.0)
        chosen = (smooth <= 0.0) | (flat_facing > 0.0)
        if self.meet_the_same:
            chosen &= (start != origins).any(axis=0)
        chosen = np.flatnonzero(chosen)
        falling = sampler.falling.ravel()[flat[chosen]] if self.is_mesh or self.margin else _ONE
        rays = start[:, chosen], *(rows[..., chosen] for rows in ray)
        visibility = self._transmittance(index[chosen], self.surface_mask, falling, *rays)
        differ = np.flatnonzero(visibility != light_visibility.ravel()[flat[chosen]])
        if len(differ) == 0:
            return None
        chosen, visibility = chosen[differ], visibility[differ]
        angle = sampler.solid_angles(flat[chosen])
        return RaysOfSurface(flat[chosen], visibility, index[chosen], directions[:, chosen], angle, is_alone[chosen])

    def unshadowed(self, name: str) -> np.ndarray:
        """Approximate radiance (Q,) that a pass reflects without shadows; 0 for pairs without that lobe."""
        scale = self.surface.albedo[self.index] if name == "diffuse" else np.float32(0.5)
        scale = scale * np.float32(np.abs(self.light.radiance).mean() / np.pi) / np.maximum(self.count, 1)
        return self.sum_w[PASSES.index(name)].sum(axis=0) * scale * self.wanted[name]

    def visibility_ratio(self, name: str):
        """Shares (Q,) of a pass, and their approximate standard deviations (Q,)."""
        sum_w, sum_wv = self.sum_w[PASSES.index(name)], self.sum_wv[PASSES.index(name)]
        count = np.maximum(self.count, 1).astype(np.float32)
        if self.is_shared.any():
            # Samples that see nothing of the sky would darken those beside a step.
            sees, sums = self.visible, np.stack([sum_w, sum_wv]) / count
            sums[..., sees] = self._neighbors.shared(name, self.index[sees], sums[..., sees])
            shared = self.is_shared & (self.count > PROBES) & self.wanted[name]
            sum_w, sum_wv = np.where(shared, sums, (sum_w, sum_wv))
            count = np.where(shared, count * self._neighbors.sharing(name, self.index), count)
        total = sum_w.sum(axis=0)
        ratio = np.divide(sum_wv.sum(axis=0), total, out=np.ones_like(total), where=total > 0.0)
        halves = np.divide(sum_wv, sum_w, out=np.stack([ratio, ratio]), where=sum_w > 0.0)
        # Pairs with probes only have no second half of rays: take the deviation of independent rays.
        usual = np.sqrt(ratio * (_ONE - ratio) / count)
        return ratio, np.where((sum_w > 0.0).all(axis=0), 0.5 * np.abs(halves[0] - halves[1]), usual)

    def smoothed(self, name: str, ratio: np.ndarray, deviation: np.ndarray) -> np.ndarray:
        """The shares `ratio` (Q,) of a pass, with this standard deviation: where it is all in which they differ from
        those of like samples around, the mean of these."""
        mixed = self.wanted[name] & self.visible & self.blocked & (self.count > PROBES)
        if not mixed.any():
            return ratio
        near, index = self._neighbors, self.index
        mean, variance = near.shared(name, index, np.stack([ratio, deviation * deviation]))
        deviation = np.sqrt(variance)
        mixed &= np.abs(mean - ratio) <= MOST_OFF * deviation
        mixed &= np.abs(near.bend(name, index, mean)) <= MOST_BENT * deviation
        return np.where(mixed, mean, ratio)


def _taken(rows, flat):
    """Values (3, R) or (R,) at the places `flat` of the flattened last two axes of `rows`, (3, S, Q) or (S, Q)."""
    return np.take(rows.reshape(*rows.shape[:-2], -1), flat, axis=-1)
