"""The normals that Cycles bends, and the horizons that end its lobes where smooth normals differ from the mesh's."""

from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from ..emitters.light_nodes import stand_ins
from ..lobes import brdf, polygon
from ..scene import Cancelled, Light, PolygonLight, Progress, SurfaceSamples
from .light_tree import light_selection_pmf, light_tree_rows

SPECULAR_FIELDS = ("specular_f0", "specular_f90", "specular_dip", "dielectric")
# Cycles keeps mirrored views at least this high (as a sine) above the true surface.
MINIMUM_REFLECTION_ELEVATION = 0.01
# For flat views the limit is lower: this share of the view's own elevation.
ELEVATION_SHARE = 0.9


def unit(vectors: np.ndarray) -> np.ndarray:
    """`vectors` (..., 3) divided by their length; zero stays zero."""
    length = np.linalg.norm(vectors, axis=-1, keepdims=True)
    return np.divide(vectors, length, out=np.zeros_like(vectors), where=length > 0.0)


def valid_specular_normal(normal: np.ndarray, true_normal: np.ndarray, view: np.ndarray) -> np.ndarray:
    """Unit normals (P, 3) bent towards `true_normal` just enough that the mirrored view leaves the surface.

    Let phi be the angle of the normal from the true normal, in the plane of both, and (x, z) the view's components in
    that plane. The mirrored view's elevation is x sin 2phi + z cos 2phi = a cos(2phi - delta), where a = |(x, z)| and
    tan delta = x / z. It is z at phi = 0 and first falls to the threshold t at phi = (delta + acos(t / a)) / 2.
    Cycles bends specular normals (not diffuse ones) by this rule with t = min(0.9 z, 0.01). Inputs are unit (P, 3) with
    `view . true_normal` > 0. The result agrees with Cycles' own normals to 1e-4, and 99 % of it to 1e-5.
    """
    elevation = np.sum(view * true_normal, axis=-1)
    threshold = np.minimum(ELEVATION_SHARE * elevation, MINIMUM_REFLECTION_ELEVATION)
    mirrored = 2.0 * np.sum(normal * view, axis=-1, keepdims=True) * normal - view
    bend = np.sum(mirrored * true_normal, axis=-1) < threshold
    tangent = unit(normal - np.sum(normal * true_normal, axis=-1, keepdims=True) * true_normal)
    x = np.sum(view * tangent, axis=-1)
    span = np.hypot(x, elevation)
    ratio = np.divide(threshold, span, out=np.ones_like(span), where=span > 0.0)
    angle = 0.5 * (np.arctan2(x, elevation) + np.arccos(np.clip(ratio, -1.0, 1.0)))
    bent = np.sin(angle)[:, None] * tangent + np.cos(angle)[:, None] * true_normal
    return np.where(bend[:, None], bent, normal)


def bump_alpha2(normal: np.ndarray, smooth_normal: np.ndarray) -> np.ndarray:
    """Squared GGX roughness (P,) of the shadowing that Cycles puts on a bump-mapped diffuse lobe; 0 means none.

    The lobe is multiplied by 2 / (1 + sqrt(1 + alpha^2 tan^2 theta_i)), where theta_i is the angle between light
    direction and smooth normal, and is 0 below the smooth horizon. alpha^2 = tan^2 theta_d / 8, at most 1, where
    theta_d is the angle between both normals (Estevez, Lecocq and Stein 2019, "A Microfacet-Based Shadowing Function to
    Solve the Bump Terminator Problem", doi:10.1007/978-1-4842-4427-2_12). Agrees with Cycles 4.5.15 and 5.2.3 to 1e-4
    of the total.
    """
    cosine2 = np.square(np.sum(normal * smooth_normal, axis=-1))
    tangent2 = np.divide(1.0 - cosine2, cosine2, out=np.full_like(cosine2, np.inf), where=cosine2 > 0.0)
    return np.clip(tangent2 / 8.0, 0.0, 1.0)


# Least alpha in the probabilities of directions.
SMALLEST_ALPHA = 1e-3
# Directions at which the two probabilities are compared. AROUND: angles around the smooth normal. CONCENTRATION: how
# dense these are near the highlight. HEIGHTS: elevations as shares of the gap between the two horizons.
AROUND, CONCENTRATION = 48, 6.0
HEIGHTS = (1.0 / 6.0, 0.5, 5.0 / 6.0)
# Largest difference of the components of two normals whose horizons count as equal.
SMALLEST_ANGLE = 1e-4
# A sample is split only if both parts have at least this share of the light from between the horizons.
SMALLEST_SHARE = 5e-3
# Share of the light that splitting would move and that a quick run leaves where it is.
UNSPLIT = 0.03
# Samples per block.
BLOCK = 2048
# If there are more flat lights of one spread, this many rectangles stand for them: pictures of three scenes of 939 to
# 9,799 change by .06 % (L2), their means by .005 %.
MOST_LIGHTS = 128
# Pairs of samples and lights in one chunk: MOST_PAIRS where few arrays are needed for each, PAIRS where many are.
MOST_PAIRS, PAIRS = 2**21, 2**14


def end_at_horizons_of_cycles(
    samples: SurfaceSamples,
    lights: tuple[Light, ...],
    hit: np.ndarray | None = None,
    is_baked: bool = False,
    is_quick: bool = False,
    progress: Progress | None = None,
) -> tuple[SurfaceSamples, np.ndarray]:
    """Samples (Q) whose specular lobes end where those of Cycles do, and the index (Q,) of each one's sample (P).

    The smooth normal and the mesh have different horizons. Between them, Cycles counts a direction that a light chose
    if it is above the smooth horizon, and one that the surface chose if it is above the mesh's, each with its weight of
    multiple importance sampling. Where both kinds count, a sample becomes two consecutive ones that add up to it: one
    ends at the mesh's horizon; the other ends at the smooth one and has no diffuse light.

    `hit` (P,) numbers the surface hit of each sample; without it, each sample is its own hit. With `is_baked`, Cycles
    chooses directions by the specular lobes alone. `is_quick` takes a third of the time, and leaves samples unsplit
    where splitting changes little.
    """
    index = np.arange(len(samples))
    reflects = (samples.specular_f90 != 0.0).any(axis=1) | (samples.dielectric != 0.0).any(axis=1)
    apart = np.abs(samples.geometric_normal - samples.smooth_normal).max(axis=1) > SMALLEST_ANGLE
    differ = np.flatnonzero(reflects & apart)
    if len(differ) == 0 or not lights:
        return samples, index
    chances = lobe_selection_pmf(samples, index if hit is None else hit, is_baked)
    excess = horizon_excess(samples.take(differ), lights, chances[:, differ], is_quick=is_quick, progress=progress)
    share, by_smooth = smooth_horizon_share(*excess), np.zeros(len(samples))
    by_smooth[differ] = _with_few_splits(share, sum(excess)) if is_quick else share
    by_smooth = np.where(by_smooth < SMALLEST_SHARE, 0.0, np.where(by_smooth > 1.0 - SMALLEST_SHARE, 1.0, by_smooth))
    split = np.flatnonzero((by_smooth > 0.0) & (by_smooth < 1.0))
    index = np.concatenate([index, split])
    ends_smooth = np.concatenate([by_smooth == 1.0, np.ones(len(split), dtype=bool)])
    weight = np.concatenate([np.where(by_smooth == 1.0, 1.0, 1.0 - by_smooth), by_smooth[split]])[:, None]
    diffuse = np.concatenate([np.ones(len(samples)), np.zeros(len(split))])[:, None]
    order = np.argsort(index, kind="stable")
    index, ends_smooth, weight, diffuse = index[order], ends_smooth[order], weight[order], diffuse[order]
    ended = samples.take(index)
    specular = {name: getattr(ended, name) * weight for name in SPECULAR_FIELDS}
    normal = np.where(ends_smooth[:, None], ended.smooth_normal, ended.geometric_normal)
    return replace(ended, geometric_normal=normal, diffuse_albedo=ended.diffuse_albedo * diffuse, **specular), index


def smooth_horizon_share(by_lobe: np.ndarray, by_light: np.ndarray) -> np.ndarray:
    """Share (P,) of a lobe that ends at the smooth horizon; the rest ends at the mesh's. Takes `horizon_excess`."""
    both = by_lobe + by_light
    # Where no direction meets a light, all lights are far from the highlight: the light's choice decides.
    return np.clip(np.divide(by_light, both, out=np.ones_like(both), where=both != 0.0), 0.0, 1.0)


def _with_few_splits(share: np.ndarray, excess: np.ndarray) -> np.ndarray:
    """The shares (P,) of `smooth_horizon_share`, rounded to 0 or 1 for the samples where splitting matters least.
    Together these account for UNSPLIT of the change that splitting every sample would make."""
    changed = np.minimum(share, 1.0 - share) * excess
    order = np.argsort(changed)
    sums = np.cumsum(changed[order])
    whole = order[sums <= UNSPLIT * sums[-1]]
    rounded = share.copy()
    rounded[whole] = np.rint(share[whole])
    return rounded


def lobe_selection_pmf(samples: SurfaceSamples, hit: np.ndarray, is_baked: bool) -> np.ndarray:
    """Probabilities (2, P) with which Cycles chooses directions by the specular and by the diffuse lobe of each sample:
    approximately its albedo relative to the sum over all samples with the same `hit` (P,)."""
    specular = _reflectance(samples, np.clip((samples.normal * samples.view).sum(axis=1), 0.0, 1.0))
    diffuse = np.zeros_like(specular) if is_baked else samples.diffuse_albedo.mean(axis=1)
    _, hit = np.unique(hit, return_inverse=True)
    both = np.stack([specular, diffuse])
    return both / np.maximum(np.bincount(hit, weights=both.sum(axis=0))[hit], 1e-12)


def _reflectance(samples, cosine) -> np.ndarray:
    """Mean reflectance (P, ...) of the lobes for the cosines (P, ...) of half the angle between light and view."""
    names = ("specular_f0", "specular_f90", "dielectric")
    values = [getattr(samples, name).mean(axis=1) for name in names] + [np.maximum(samples.ior, 1.0)]
    f0, f90, weight, ior = (value.reshape(-1, *[1] * (cosine.ndim - 1)) for value in values)
    schlick = f0 + (f90 - f0) * brdf.schlick_curve(cosine)
    return np.maximum(schlick + weight * brdf.dielectric_reflectance(cosine, ior), 0.0)


def horizon_excess(
    samples: SurfaceSamples,
    lights: tuple[Light, ...],
    chances: np.ndarray,
    is_quick: bool = False,
    progress: Progress | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """The light (P,) that only one of the horizons lets through, split by who chose its direction: a lobe or the light.
    The smooth horizon is wrong about the first part, the mesh's horizon about the second.

    `chances` (2, P) come from `lobe_selection_pmf`. Where the horizons make no difference, the first part is 1 and the
    second 0. `is_quick` looks at a third of the directions; on the example scene the shares are then 0.4 % off,
    weighted by the light.
    """
    lights, shares = _with_stand_ins(lights)
    shapes = [_LightsOfKind.of(lights, numbers, shares[numbers]) for numbers in _kinds_of_lights(lights)]
    choose = partial(light_selection_pmf, lights=lights, rows=light_tree_rows(lights))
    step = min(max(MOST_PAIRS // len(lights), 1), BLOCK)
    excess = np.empty((2, len(samples)))
    for start in range(0, len(samples), step):
        if progress is not None and progress("horizons", start / len(samples)) is False:
            raise Cancelled("stopped at the horizons of bumped surfaces")
        block = slice(start, start + step)
        excess[:, block] = _excess(samples.take(block), shapes, chances[:, block], choose, is_quick)
    return excess[0], excess[1]


def _excess(samples, shapes, chances, choose, is_quick):
    """As `horizon_excess`, for one block of samples and lights in these `shapes`. `choose(position, normal)` returns
    the chances of the lights."""
    crossings = [(shape, *pairs) for shape in shapes if len((pairs := shape.crossings(samples))[0])]
    by_lobe, by_light = np.ones(len(samples)), np.zeros(len(samples))
    for _, _, sample in crossings:
        by_lobe[sample] = 0.0
    for is_side in (False, True):
        of_kind = [one for one in crossings if one[0].is_side == is_side]
        if not of_kind:
            continue
        there, _ = _numbered(np.concatenate([sample for _, _, sample in of_kind]), len(samples))
        some = samples.take(there)
        rays = _HorizonDirections.of(some, is_quick, is_side)
        rows = [np.searchsorted(there, sample) for _, _, sample in of_kind]
        hits = [shape.hits(one, row, some.position, rays) for (shape, one, _), row in zip(of_kind, rows, strict=True)]
        number, row, ray, brightness, solid_angle = (np.concatenate(values) for values in zip(*hits, strict=True))
        met, row = _numbered(row, len(there))
        some, chosen, towards = some.take(met), there[met], rays.towards[met]
        chance = choose(some.position, some.smooth_normal)
        lobe = lobe_density(some, towards)
        half = np.sqrt(np.maximum(0.5 + 0.5 * _dots(towards, some.view), 0.0))
        reflected = lobe * _visible_microfacets(some, towards) * _reflectance(some, half) * rays.width[met]
        diffuse = np.maximum(_dots(towards, some.diffuse_normal), 0.0) / np.pi
        chosen2 = np.square(chances[0, chosen, None] * lobe + chances[1, chosen, None] * diffuse)
        pair = row * towards.shape[1] + ray
        excess = brightness * reflected.ravel()[pair]
        light2 = np.square(chance[number, row].astype(float) / np.maximum(solid_angle, 1e-12))
        weight = light2 / np.maximum(light2 + chosen2.ravel()[pair], 1e-30)
        by_light[chosen] += np.bincount(row, excess * weight, len(met))
        by_lobe[chosen] += np.bincount(row, excess * (1.0 - weight), len(met))
    return by_lobe, by_light


def _with_stand_ins(lights) -> tuple[tuple[Light, ...], np.ndarray]:
    """Lights (L) and the share (L,) of each that shines. At most MOST_LIGHTS stand-ins replace many flat lights."""
    others, kinds = [], {}
    for light in lights:
        if light.is_facing or light.is_distant:
            others.append(light)
        elif light.area_vector.any():
            kinds.setdefault(light.spread, []).append(light)
    shares = [np.ones(len(others))]
    for group in kinds.values():
        share = np.ones(len(group))
        if len(group) > MOST_LIGHTS:
            group, share, _ = stand_ins(group, MOST_LIGHTS)
        others += group
        shares.append(share)
    return tuple(others), np.concatenate(shares)


def _dots(directions, vectors) -> np.ndarray:
    """Dot products (P, N) of directions (P, N, 3) with vectors (P, 3)."""
    return np.einsum("pni,pi->pn", directions, vectors)


def _numbered(values, count: int) -> tuple[np.ndarray, np.ndarray]:
    """The distinct `values`, sorted, which are below `count`; and the index of each value among them."""
    there = np.zeros(count, bool)
    there[values] = True
    return np.flatnonzero(there), (np.cumsum(there) - 1)[values]


def _kinds_of_lights(lights) -> list[np.ndarray]:
    """Groups of the numbers of lights that have the same kind of outline and are equally near, distant or facing."""
    kinds = {}
    for number, light in enumerate(lights):
        outline = light.shape if light.is_facing else 0 if light.is_round else len(light.polygon())
        kind = light.is_distant, isinstance(light, PolygonLight), outline, light.is_side
        kinds.setdefault(kind, []).append(number)
    return [np.array(numbers) for numbers in kinds.values()]


@dataclass(frozen=True)
class _LightsOfKind:
    """Lights of one kind, as arrays for tests of which directions meet them."""

    number: np.ndarray  # (L,)
    like: Light  # one of them
    brightness: np.ndarray  # (L,)
    center: np.ndarray  # (L, 3)
    corners: np.ndarray  # (L, V, 3)
    radius: np.ndarray  # (L,) of a ball around the light
    axes: np.ndarray  # (L, 3, 3) two unit vectors in the plane, and the reverse of the emitting direction
    scales: np.ndarray  # (L, 2, 3) turn an offset from the center into multiples of half_u and half_v
    share: np.ndarray  # (L,) of the light's area that shines
    is_side: bool  # True for sides of the cube around the world; a direction meets exactly one

    @classmethod
    def of(cls, lights, number, share) -> "_LightsOfKind":
        """The lights of these numbers, which are of one kind; the `share` (L,) of each shines."""
        alike = [lights[n] for n in number]
        center, corners = (np.array([light.center for light in alike]), np.array([light.polygon() for light in alike]))
        radius = np.linalg.norm(corners - center[:, None], axis=2).max(axis=1)
        if alike[0].is_facing:
            radius = np.array([light.radius for light in alike])
        # Two axes in the planes of the lights, and the one that they face away from.
        first = corners[:, 0] - center
        first = first / np.maximum(np.linalg.norm(first, axis=1), 1e-30)[:, None]
        direction = np.array([light.direction for light in alike])
        axes = np.stack([first, np.cross(direction, first), -direction], axis=1)
        brightness = np.array([np.abs(light.radiance).sum() for light in alike])
        scales = np.linalg.pinv(np.array([[light.half_u, light.half_v] for light in alike]).swapaxes(1, 2))
        rest = radius, axes, scales, share, alike[0].is_side
        return cls(number, alike[0], brightness, center, corners, *rest)

    def crossings(self, samples) -> tuple[np.ndarray, np.ndarray]:
        """Pairs of a light and a sample whose horizons differ on the light: part of it is above one of them, and part
        of it below one. Both are numbers, the light's among these."""
        position = 0.0 * samples.position if self.like.is_distant else samples.position
        normals = samples.smooth_normal, samples.geometric_normal
        starts = [(normal * position).sum(axis=1) for normal in normals]
        pairs, step = [np.zeros((2, 0), int)], max(PAIRS // len(position), 1)
        for start in range(0, len(self.center), step):
            center, radius = self.center[start : start + step], self.radius[start : start + step, None]
            smooth, true = (center @ normal.T - at for normal, at in zip(normals, starts, strict=True))
            # A little more, because the sums are rounded.
            reach = radius if self.like.is_facing else radius + 1e-9 * (np.abs(smooth) + np.abs(true))
            between = (np.minimum(smooth, true) <= reach) & (np.maximum(smooth, true) > -reach)
            if not self.like.is_facing:
                back = self.axes[start : start + step, 2]
                between &= (center * back).sum(axis=1)[:, None] > back @ position.T
            light, sample = np.nonzero(between)
            light += start
            if not self.like.is_facing:
                some, every = np.zeros(len(light), bool), np.ones(len(light), bool)
                for normal, at in zip(normals, starts, strict=True):
                    above = np.einsum("rvi,ri->rv", self.corners[light], normal[sample]) > at[sample, None]
                    some |= above.any(axis=1)
                    every &= above.all(axis=1)
                light, sample = light[some & ~every], sample[some & ~every]
            pairs.append(np.stack([light, sample]))
        return tuple(np.concatenate(pairs, axis=1))

    def hits(self, light, sample, position, directions) -> tuple[np.ndarray, ...]:
        """One entry for each direction that meets its light, from the pairs (R,) `light` and `sample` of `crossings`:
        number of the light, sample, number of the direction, brightness and solid angle in sr of the whole light."""
        if self.is_side:
            return self._side_hits(np.unique(sample), directions)
        chunks = [(np.zeros(0, int), np.zeros(0, int), np.zeros(0, int), np.zeros(0), np.zeros(0))]
        for start in range(0, len(light), PAIRS):
            row, point = light[start : start + PAIRS], sample[start : start + PAIRS]
            offset = self.center[row] - (0.0 if self.like.is_distant else position[point])
            pair, ray = directions.near(point, offset, self.radius[row])
            towards = directions.towards[point[pair], ray]
            is_hit = self._meets(row, offset, pair, towards)
            pair, ray = pair[is_hit], ray[is_hit]
            met, of_met = np.unique(pair, return_inverse=True)
            angle = (self.share[row[met]] * self._solid_angle(row[met], offset[met]))[of_met]
            chunks.append((self.number[row[pair]], point[pair], ray, self.brightness[row[pair]], angle))
        return tuple(np.concatenate(values) for values in zip(*chunks, strict=True))

    def _side_hits(self, sample, directions) -> tuple[np.ndarray, ...]:
        """As `hits`, for all directions of the samples (R,): each meets the side along its largest component."""
        towards = directions.towards[sample]
        size = np.abs(towards)
        longest = np.where(size[..., 0] >= np.maximum(size[..., 1], size[..., 2]), 0, 1 + (size[..., 2] > size[..., 1]))
        ahead = np.take_along_axis(towards, longest[..., None], axis=2)[..., 0] > 0.0
        side_of_face, side = np.full(6, -1), self.axes[:, 2]
        axis = np.abs(side).argmax(axis=1)
        side_of_face[2 * axis + (side[np.arange(len(axis)), axis] < 0.0)] = np.arange(len(axis))
        met = side_of_face[2 * longest + ~ahead]
        row, ray = np.nonzero(met >= 0)
        met_side = met[row, ray]
        angle = self._solid_angle(np.arange(len(self.number)), self.center)
        return self.number[met_side], sample[row], ray, self.brightness[met_side], angle[met_side]

    def _cosine(self, light, distance) -> np.ndarray:
        """Cosine (R,) of the angular radius of lights that face every point."""
        ratio = np.minimum(self.radius[light] / np.maximum(distance, 1e-30), 1.0)
        return np.sqrt(1.0 - ratio**2) if self.like.is_sphere else 1.0 / np.sqrt(1.0 + ratio**2)

    def _meets(self, light, offset, pair, towards) -> np.ndarray:
        """Mask (K,) of the rays that meet their light. The ray k goes along `towards` (K, 3) from the pair `pair[k]`
        (of R), whose light has its center at `offset` (R, 3)."""
        if self.like.is_facing:
            distance = np.linalg.norm(offset, axis=1)
            along = (towards * offset[pair]).sum(axis=1)
            return along > (self._cosine(light, distance) * distance)[pair]
        steepness = np.einsum("ki,ki->k", self.axes[light, 2][pair], towards)
        height = np.einsum("ri,ri->r", self.axes[light, 2], offset)
        distance = height[pair] / np.where(steepness > 0.0, steepness, 1e-30)
        plane = (self.axes[:, :2] if isinstance(self.like, PolygonLight) else self.scales)[light]
        x0, y0 = np.einsum("rai,ri->ar", plane, offset)
        x, y = np.einsum("kai,ki->ak", plane[pair], towards) * distance
        x, y = x - x0[pair], y - y0[pair]
        if self.like.is_round:
            return (x * x + y * y < 1.0) & (steepness > 0.0)
        if not isinstance(self.like, PolygonLight):
            return (np.maximum(np.abs(x), np.abs(y)) < 1.0) & (steepness > 0.0)
        outline = np.einsum("rvi,rai->var", self.corners[light] - self.center[light, None], plane)
        inside = np.zeros(len(x), bool)
        for start, end in zip(outline, np.roll(outline, -1, axis=0), strict=True):
            (x0, y0), (x1, y1) = start[:, pair], end[:, pair]
            slope = np.divide(x1 - x0, y1 - y0, out=np.zeros_like(x0), where=y0 != y1)
            inside ^= ((y0 > y) != (y1 > y)) & (x < x0 + (y - y0) * slope)
        return inside & (steepness > 0.0)

    def _solid_angle(self, light, offset) -> np.ndarray:
        """Solid angle (R,) in sr of lights whose center is at `offset` (R, 3); 0 as seen from behind."""
        if self.like.is_facing:
            return 2.0 * np.pi * (1.0 - self._cosine(light, np.linalg.norm(offset, axis=1)))
        corners = self.corners[light] - self.center[light, None] + offset[:, None]
        corners = np.einsum("rai,rvi->avr", self.axes[light], corners)
        whole = np.abs(polygon.solid_angle(polygon.project_to_sphere(corners)))
        return np.where(corners[2].mean(axis=0) > 0.0, whole, 0.0)


def lobe_density(samples, towards: np.ndarray) -> np.ndarray:
    """Probability (P, N) per sr with which the specular lobe chooses the unit directions (P, N, 3)."""
    half = towards + samples.view[:, None]
    vertical = np.square(np.maximum(_dots(half, samples.normal), 0.0))
    horizontal = np.maximum(np.square(half).sum(axis=2) - vertical, 0.0)
    alpha2 = np.square(np.maximum(samples.roughness**2, SMALLEST_ALPHA))[:, None]
    cosine = np.maximum((samples.normal * samples.view).sum(axis=1), 1e-3)[:, None]
    return brdf.visible_normal_density(cosine, horizontal, vertical, alpha2)


def _visible_microfacets(samples, towards) -> np.ndarray:
    """Share (P, N) of the microfacets visible from the eye that are also visible from directions `towards` (P, N, 3);
    0 below the horizon of the lobe."""
    alpha2 = np.square(np.maximum(samples.roughness**2, SMALLEST_ALPHA))[:, None]
    to_eye = np.maximum((samples.normal * samples.view).sum(axis=1), 1e-3)[:, None]
    to_light = np.maximum(_dots(towards, samples.normal), 0.0)
    slopes = [np.sqrt(cosine * cosine + alpha2 * (1.0 - cosine * cosine)) for cosine in (to_eye, to_light)]
    return to_light * (to_eye + slopes[0]) / np.maximum(to_eye * slopes[1] + to_light * slopes[0], 1e-30)


@dataclass(frozen=True)
class _HorizonDirections:
    """Unit directions (P, N, 3) between the horizons, AROUND of them for each of HEIGHTS or in total, and the solid
    angle (P, N) in sr of each; it is negative where the mesh's horizon is the lower one."""

    towards: np.ndarray
    width: np.ndarray
    flat: np.ndarray  # (P, 2, 3) axes in the plane of the smooth horizon
    angle: np.ndarray  # (AROUND,) from the first of these to the second

    @classmethod
    def of(cls, samples, is_quick: bool = False, is_side: bool = False) -> "_HorizonDirections":
        """The directions of `samples`. If any is True, each angle around the normal has only one of HEIGHTS; if both
        are, there are half as many angles. A few suffice for a light as large as a side of the sky."""
        mirrored = 2.0 * (samples.normal * samples.view).sum(axis=1, keepdims=True) * samples.normal - samples.view
        flat = mirrored - (mirrored * samples.smooth_normal).sum(axis=1, keepdims=True) * samples.smooth_normal
        flat /= np.maximum(np.linalg.norm(flat, axis=1, keepdims=True), 1e-12)
        across = np.cross(samples.smooth_normal, flat)
        count = AROUND // 2 if is_quick and is_side else AROUND
        step = (np.arange(count) + 0.5) / count * 2.0 - 1.0
        angle = np.pi * np.sinh(CONCENTRATION * step) / np.sinh(CONCENTRATION)
        span = np.pi * CONCENTRATION * np.cosh(CONCENTRATION * step) / np.sinh(CONCENTRATION) * 2.0 / count
        around = np.cos(angle)[:, None] * flat[:, None] + np.sin(angle)[:, None] * across[:, None]
        # Elevation of the mesh's horizon over the smooth one at these angles.
        gap = -np.arctan2(
            _dots(around, samples.geometric_normal),
            np.einsum("pi,pi->p", samples.smooth_normal, samples.geometric_normal)[:, None],
        )
        heights = np.resize(HEIGHTS, count)[None] if is_quick or is_side else np.array(HEIGHTS)[:, None]
        elevation = gap[:, None] * heights
        towards = np.cos(elevation)[..., None] * around[:, None]
        towards += np.sin(elevation)[..., None] * samples.smooth_normal[:, None, None]
        width = gap[:, None] * span * np.cos(elevation) / len(heights)
        count = len(samples)
        return cls(towards.reshape(count, -1, 3), width.reshape(count, -1), np.stack([flat, across], axis=1), angle)

    def near(self, sample, offset, radius) -> tuple[np.ndarray, np.ndarray]:
        """Numbers (K,) of pairs, and of the directions of each pair that may meet its ball. The balls have the `radius`
        (R,) and are at `offset` (R, 3) from the samples (R,). Only the angle around the smooth normal is tested."""
        x, y = np.einsum("rai,ri->ar", self.flat[sample], offset)
        ratio = np.minimum(radius / np.maximum(np.hypot(x, y), 1e-30), 1.0)
        reach = np.where(ratio < 1.0, np.arcsin(ratio), np.pi) + 1e-6
        turns = (self.angle + 2.0 * np.pi * np.array([-1.0, 0.0, 1.0])[:, None]).ravel()
        middle = np.arctan2(y, x)
        first = np.searchsorted(turns, middle - reach)
        count = np.minimum(np.searchsorted(turns, middle + reach) - first, len(self.angle))
        pair = np.repeat(np.arange(len(sample)), count)
        step = np.arange(len(pair)) + np.repeat(first - np.cumsum(count) + count, count)
        heights = np.arange(0, self.towards.shape[1], len(self.angle))
        return np.repeat(pair, len(heights)), ((step % len(self.angle))[:, None] + heights).ravel()
