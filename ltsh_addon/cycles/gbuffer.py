"""Turns the channels of a 1-sample Cycles render into `SurfaceSamples` and `Film`. Needs no bpy.

Cycles evaluates every texture, bump map and node group itself. The values arrive through AOVs, one hit per pixel and
file, so nothing is averaged across an edge.
"""

import math
from dataclasses import fields, replace

import numpy as np

from ..emitters.light_polygons import has_lobe
from ..scene import FARTHEST, SCALAR_FIELDS, Film, SurfaceSamples, is_constant
from .horizons import unit
from .lobes import (
    AOV_PREFIX,
    DENSITY_AOVS,
    HIT_AOVS,
    KEPT_AOV,
    SurfaceHits,
    lobe_aov,
    lobe_names,
    read_aov,
    read_layer,
    samples_of_lobes,
)

# Few enough for the arrays of one block to stay in the cache.
HITS_PER_BLOCK = 65536
# A warning is worth it if smooth and face normals differ by more than COARSE_ANGLE on the share COARSE_SHARE of
# samples. Measured on a smooth-shaded cube: diffuse light is 1.5 % off beyond 35 degrees, 0.3 % between 20 and 35.
COARSE_ANGLE, COARSE_SHARE = math.radians(35.0), 0.02
# A position counts as rounded if its rounding error exceeds the share ROUNDED of the distance to the nearest light. A
# warning is worth it if more than the share ROUNDED_SHARE of the positions are.
ROUNDED, ROUNDED_SHARE = 2e-3, 0.02
MOST_DENSITY = 11.0  # glass above lets nothing through
FEW_SAMPLES, MOST_PAIRS = 1000, 2_000_000  # about how many samples, and at most how many pairs with lights, are tested
RIBBON_TOLERANCE = 1e-6  # squared angle, for the rounding of unit vectors in float32


def surface_samples(channels: dict[str, np.ndarray], diffuse_color: str) -> tuple[SurfaceSamples, np.ndarray, int]:
    """Samples (P) of one render, the pixel (P,) of each (row by row from the top left), and the count of unusable hits.

    Each hit has one sample per lobe; these are consecutive. `diffuse_color` is the name of the pass with the diffuse
    albedo. A hit is unusable if its ray met several surfaces (transparency adds the AOVs of both), or if its values are
    not finite or too far away.
    """
    hit = read_aov(channels, "hit").ravel()
    pixel = np.flatnonzero(hit != 0.0)

    def picked(plane):
        return plane.reshape(hit.size, *plane.shape[2:])[pixel].astype(np.float64)

    values = {name: picked(read_aov(channels, name)) for name in HIT_AOVS}
    values["albedo"] = picked(read_layer(channels, diffuse_color, "RGB"))
    lobes = [
        {name: picked(read_aov(channels, lobe_aov(name, slot))) for name in names}
        for slot, names in enumerate(lobe_names(channels))
    ]
    usable = np.abs(values["hit"] - 1.0) < 1e-6
    for value in (*values.values(), *(value for lobe in lobes for value in lobe.values())):
        usable &= np.isfinite(value) if value.ndim == 1 else np.isfinite(value).all(axis=-1)
    usable &= np.linalg.norm(values["incoming"], axis=-1) > 0.5
    usable &= np.abs(values["position"]).max(axis=-1) <= FARTHEST
    pieces, index, usable = [], [], np.flatnonzero(usable)
    for start in range(0, max(len(usable), 1), HITS_PER_BLOCK):
        block = usable[start : start + HITS_PER_BLOCK]
        at = {name: value[block] for name, value in values.items()}
        hits = SurfaceHits(
            position=at["position"],
            view=unit(at["incoming"]),
            smooth_normal=unit(at["smooth_normal"]),
            true_normal=unit(at["true_normal"]),
            corrected=at["correct_normal"] > 0.5,
            receiver=np.rint(at["receiver"]).astype(np.int32),
            diffuse_albedo=at["albedo"],
        )
        samples, of_block = samples_of_lobes(
            hits, [{name: value[block] for name, value in lobe.items()} for lobe in lobes]
        )
        pieces.append(samples)
        index.append(block[of_block])
    return SurfaceSamples.joined(pieces), pixel[np.concatenate(index)], len(pixel) - len(usable)


def clear_holdouts(channels: dict[str, np.ndarray]) -> None:
    """Remove the hits on holdouts from the `channels` of a render with an opaque background.

    Cycles evaluates the shaders of holdouts, AOVs included, and then shows a hole. Only there is alpha 0.
    """
    read_aov(channels, "hit")[read_layer(channels, "Combined", "A") == 0.0] = 0.0


def surfaces_without_sample(channels: dict[str, np.ndarray]) -> int:
    """Number of pixels of a one-sample render with a surface (it has a normal) that wrote no AOV and is no holdout."""
    return int(np.count_nonzero(_shows_surface(channels) & (read_aov(channels, "hit") == 0.0)))


def _shows_surface(channels: dict[str, np.ndarray]) -> np.ndarray:
    """Mask (H, W) of the pixels that show a surface."""
    # Depth does not tell: it is always the depth of the first sample of a pixel.
    normal = read_layer(channels, "Normal", "XYZ")
    return normal.any(axis=-1) & (read_layer(channels, "Combined", "A") != 0.0)


def not_reflected(channels: dict[str, np.ndarray], names: dict[str, str], is_transparent: bool) -> np.ndarray:
    """Light of a one-sample render that is not reflected, (H, W, 7): emission of surfaces and visible lights (3), the
    world seen behind them (3), and the alpha of the picture. `names` are those of the passes; `is_transparent` is that
    of the film."""
    emission, background = (read_layer(channels, names[key], "RGB") for key in ("emission", "background"))
    if is_transparent:
        background, alpha = np.zeros_like(background), _shows_surface(channels)
    else:
        alpha = read_layer(channels, "Combined", "A")
    return np.concatenate([emission, background, alpha[..., None]], axis=-1)


def seen_through(channels: dict[str, np.ndarray]) -> np.ndarray | None:
    """The share (H, W, 3) of light that passes all glass of a pixel; 0 without glass. None if no material is."""
    if not any(f"{AOV_PREFIX}{DENSITY_AOVS[0]}." in key for key in channels):
        return None
    density = np.stack([read_aov(channels, name) for name in DENSITY_AOVS], axis=-1)
    return np.where((density > 0.0) & (density < MOST_DENSITY), np.exp(-density), 0.0)


def tinted(samples: SurfaceSamples, tint: np.ndarray) -> SurfaceSamples:
    """`samples` (P) that reflect `tint` (P, 3) times as much."""
    return replace(samples, **{name: getattr(samples, name) * tint for name in COLORS})


def unshaded_hits(channels: dict[str, np.ndarray], count: int) -> np.ndarray:
    """Number of hits (count,) of a one-sample render on each material that is not shaded, in the order in which
    `inject_aovs` numbers them."""
    if not count:
        return np.zeros(0, dtype=int)
    number = -np.rint(read_aov(channels, lobe_aov("kind", 0))[read_aov(channels, "hit") == 1.0]).astype(int)
    return np.bincount(number[number > 0] - 1, minlength=count)


def left_to_cycles(channels: dict[str, np.ndarray]) -> np.ndarray:
    """Sum (H, W) of KEPT_BITS: the passes that are left to Cycles, because we do not shade the surface as it does."""
    hit = read_aov(channels, "hit")
    passes = read_aov(channels, KEPT_AOV) if any(f"{AOV_PREFIX}{KEPT_AOV}." in key for key in channels) else 0.0 * hit
    passes = np.minimum(np.rint(passes), 3).astype(int)
    # The pixel shows several surfaces, or one that wrote nothing.
    passes[(hit != 0.0) & (np.abs(hit - 1.0) > 1e-6)] = 3
    passes[_shows_surface(channels) & (hit == 0.0)] = 3
    return passes


def join(renders: list[tuple[SurfaceSamples, np.ndarray]], width: int, height: int) -> tuple[SurfaceSamples, Film]:
    """All samples of `renders`, one (samples, pixel) per sub-sample, and the film they lie on."""
    if not renders:
        shapes = {item.name: (0,) if item.name in SCALAR_FIELDS else (0, 3) for item in fields(SurfaceSamples)}
        nothing = SurfaceSamples(**{name: np.zeros(shape) for name, shape in shapes.items()})
        return nothing, Film(width, height, np.zeros(0, int))
    pixel = np.concatenate([pixel for _, pixel in renders])
    # A render has one hit per pixel, whose samples are consecutive.
    of_hit = [np.concatenate([np.ones(len(pixels[:1]), bool), pixels[1:] != pixels[:-1]]) for _, pixels in renders]
    of_hit = np.concatenate(of_hit)
    first = None if of_hit.all() else of_hit
    return SurfaceSamples.joined([samples for samples, _ in renders]), Film(width, height, pixel, len(renders), first)


# Hits of a pixel are shaded as one if their normals and positions agree. LOBE_SHARE: largest angle between normals in
# units of the lobe's width alpha. MOST_ANGLE: largest such angle in rad. OFF_PLANE: largest distance from the plane of
# the other hit, in units of their distance. LEAST_ALPHA: sharper lobes are never shaded as one.
LOBE_SHARE, MOST_ANGLE, OFF_PLANE, LEAST_ALPHA = 0.02, 0.01, 0.2, 0.01
MERGED_ROUNDS = 3  # most surfaces of a pixel that are merged
SHADOW_LOOSENESS = 40.0  # hits share their shadow rays up to this many times the angle for shading
MOST_PLACES = 8  # of a sample, from which its shadow rays start
COLORS = ("specular_f0", "specular_f90", "specular_dip", "dielectric", "diffuse_albedo", "diffuse_rebound")
SAME = ("roughness", "ior", "diffuse_roughness", "sheen_a", "sheen_b", "receiver", "anisotropy")


def merged(samples: SurfaceSamples, film: Film) -> tuple[SurfaceSamples, Film]:
    """Fewer samples: one stands for all hits of a pixel on one smooth surface, with their mean colors.

    Pixels at edges keep one sample for each surface. Everything but colors is taken from the first of the hits. On the
    example scene with 8 points, half of the samples remain; without shadows, specular light is 1 % off and diffuse
    light 0.5 %.
    """
    leaders, group = _groups(samples, film, 1.0)
    first, merged_film = samples.take(leaders), _together(samples, film, leaders, group)
    means = {}
    for name in COLORS:
        sums = [np.bincount(group, weights=column, minlength=len(first)) for column in getattr(samples, name).T]
        means[name] = np.stack(sums, axis=1) / merged_film.count[:, None]
    return replace(first, **means), merged_film


# MOST_TURN: normals that are farther apart, in rad, belong to edges. WIDENING: what is added to the squared alpha, in
# variances of normals between points. GGX has long tails: half of what a Gaussian would need is nearer to Cycles, with
# 3 points, than a quarter, or all. MOST_WIDENING: at most (Tokuyoshi and Kaplanyan 2019).
MOST_TURN, WIDENING, MOST_WIDENING = math.radians(60.0), 0.5, 0.18


def with_widened_lobes(samples: SurfaceSamples, film: Film, points: int) -> SurfaceSamples:
    """`samples` with specular lobes that take in how the normal turns between the points of a pixel, of which `points`
    will be shaded, so that highlights thinner than pixels do not fall between them (Kaplanyan, Hill, Patney and Lefohn
    2016, Filtering Distributions of Normals for Shading Antialiasing). Pixels with one sample stay as they are."""
    _, lengths, lobe = _hits(samples, film)
    keys = film.pixel, lobe, np.repeat(lengths, lengths), samples.receiver
    order = np.lexsort(keys)
    keys = [key[order] for key in keys]
    normal, position, face = (values[order] for values in (samples.normal, samples.position, samples.geometric_normal))
    total, count = np.zeros((2, len(order)))
    for step in range(1, film.sub_samples):
        one = np.flatnonzero(np.logical_and.reduce([key[step:] == key[:-step] for key in keys]))
        apart, middle = position[one] - position[one + step], face[one] + face[one + step]
        off = np.abs((apart * middle).sum(axis=1))
        turn = np.square(normal[one] - normal[one + step]).sum(axis=1)
        together = off <= OFF_PLANE * np.linalg.norm(apart, axis=1) * np.linalg.norm(middle, axis=1) + 1e-6
        together &= turn <= 2.0 - 2.0 * math.cos(MOST_TURN)
        one, turn = one[together], turn[together]
        for index in (one, one + step):  # each of them once
            total[index] += turn
            count[index] += 1.0
    variance = np.empty(len(order))
    # Half of the mean squared distance. Each of the points stands for its share of the pixel.
    variance[order] = 0.5 * total / np.maximum(count, 1.0)
    added = np.minimum(WIDENING * variance / points, MOST_WIDENING)
    alpha, across = np.square(samples.roughness), np.maximum(1.0 - samples.anisotropy, 1e-6)
    along, across = (np.sqrt(np.square(one) + added) for one in (alpha / across, alpha * across))
    is_wider = has_lobe(samples)[1] & (added > 0.0)
    roughness = np.where(is_wider, np.minimum((along * across) ** 0.25, 1.0), samples.roughness)
    anisotropy = samples.anisotropy
    if anisotropy.any():
        ratio = across / np.maximum(along, 1e-30)
        anisotropy = np.where(is_wider & (anisotropy != 0.0), 1.0 - np.sqrt(ratio), anisotropy)
    return replace(samples, roughness=roughness, anisotropy=anisotropy)


def with_one_shadow(samples: SurfaceSamples, film: Film) -> tuple[SurfaceSamples, Film, np.ndarray]:
    """Fewer samples (Q), their film, and for each of `samples` the number (P,) of the one that stands for it. One
    sample stands for those of a pixel that see about the same part of each light."""
    leaders, group = _groups(samples, film, SHADOW_LOOSENESS)
    return samples.take(leaders), _together(samples, film, leaders, group), group


def _together(samples: SurfaceSamples, film: Film, leaders: np.ndarray, group: np.ndarray) -> Film:
    """The film of the `samples` with the numbers `leaders` (Q,). Each stands for those (P,) whose `group` is its
    number."""
    count = np.bincount(group, weights=film.count, minlength=len(leaders))
    count = count if film.count is not None and film.count.dtype.kind == "f" else count.astype(int)
    merged_film = replace(film.take(leaders), count=count, extent=_extent(samples, film, leaders, group))
    if film.spread is None:
        return merged_film
    columns = film.spread.reshape(len(group), -1).T
    sums = [np.bincount(group, weights=column, minlength=len(leaders)) for column in columns]
    return replace(merged_film, spread=np.stack(sums, axis=1).astype(np.float32).reshape(merged_film.spread.shape))


def _extent(samples: SurfaceSamples, film: Film, leaders: np.ndarray, group: np.ndarray) -> np.ndarray:
    """`Film.extent` of the `leaders` (Q,); of those that had one already, this."""
    order, size = np.argsort(group, kind="stable"), np.bincount(group, minlength=len(leaders))
    count = min(size.max(initial=1), MOST_PLACES) if film.extent is None else 1 + film.extent.shape[1]
    # Of groups with fewer samples some are there several times.
    others = order[(np.cumsum(size) - size)[:, None] + np.arange(1, count) % size[:, None]]
    extent = (samples.position[others] - samples.position[leaders][:, None]).astype(np.float32)
    if film.extent is None:
        return extent
    before = film.extent[leaders]
    return np.where(before.any(axis=(1, 2))[:, None, None], before, extent)


def _hits(samples: SurfaceSamples, film: Film) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Of each hit its first sample (H,) and how many it has (H,); and the number (P,) of each sample in its hit."""
    starts = np.arange(len(samples)) if film.first is None else np.flatnonzero(film.first)
    lengths = np.diff(starts, append=len(samples))
    return starts, lengths, np.arange(len(samples)) - np.repeat(starts, lengths)


def _groups(samples: SurfaceSamples, film: Film, looseness: float) -> tuple[np.ndarray, np.ndarray]:
    """The samples (Q,) that stand for others of their pixel, and for each sample (P,) the number of the one that
    stands for it."""
    starts, lengths, lobe_of_sample = _hits(samples, film)
    pixel, target = film.pixel[starts], np.arange(len(starts))
    free, shines = np.ones(len(starts), bool), has_lobe(samples)[1]
    for _ in range(MERGED_ROUNDS):
        waiting = np.flatnonzero(free)
        # The first unmerged hit of each pixel leads.
        pixels, first = np.unique(pixel[waiting], return_index=True)
        leaders = waiting[first]
        free[leaders] = False
        others = np.flatnonzero(free)
        leader = leaders[np.searchsorted(pixels, pixel[others])]
        same = lengths[others] == lengths[leader]
        for lobe in range(int(lengths.max(initial=0))):
            there = np.flatnonzero(same & (lengths[others] > lobe))
            pairs = starts[others[there]] + lobe, starts[leader[there]] + lobe
            same[there] = one_shading(samples, shines, *pairs, looseness)
        target[others[same]] = leader[same]
        free[others[same]] = False
    # Go from hits to their samples.
    of_sample = np.repeat(starts[target], lengths) + lobe_of_sample
    leading = np.flatnonzero(of_sample == np.arange(len(samples)))
    return leading, np.searchsorted(leading, of_sample)


def one_shading(samples: SurfaceSamples, shines: np.ndarray, one, other, looseness: float) -> np.ndarray:
    """Mask of the pairs of samples that are shaded as one or, with a `looseness` above 1, share their shadow. `shines`
    (P,) marks samples with a specular lobe."""
    same = np.ones(len(one), bool)
    for name in SAME:
        values = getattr(samples, name)
        if not is_constant(values):
            same &= np.abs(values[one] - values[other]) <= 1e-2 * np.abs(values[other])
    alpha = np.where(shines[other], samples.roughness[other] ** 2, 1.0)
    same &= alpha >= LEAST_ALPHA
    angle = looseness * np.minimum(MOST_ANGLE, LOBE_SHARE * alpha)
    if samples.anisotropy.any():
        turned = np.linalg.norm(samples.tangent[one] - samples.tangent[other], axis=1)
        same &= (turned <= angle) | (samples.anisotropy[other] == 0.0)
    limit = np.cos(angle)
    for name in ("normal", "diffuse_normal", "geometric_normal", "smooth_normal"):
        values = getattr(samples, name)
        same &= (values[one] * values[other]).sum(axis=1) >= limit
    apart = samples.position[one] - samples.position[other]
    off = np.abs((apart * samples.geometric_normal[other]).sum(axis=1))
    return same & (off <= OFF_PLANE * np.linalg.norm(apart, axis=1) + 1e-6)


def coarse_meshes(samples: SurfaceSamples) -> list[str]:
    """The warning about smooth-shaded meshes so coarse that their light depends on how Cycles samples."""
    cosine = np.abs(np.sum(samples.smooth_normal * samples.geometric_normal, axis=-1))
    # Hair ribbons that pretend to be round have the view direction as their geometric normal.
    is_ribbon = np.abs(np.sum(samples.view * samples.geometric_normal, axis=-1)) > 1.0 - RIBBON_TOLERANCE
    count = np.count_nonzero((cosine < math.cos(COARSE_ANGLE)) & ~is_ribbon)
    if count <= COARSE_SHARE * len(samples):
        return []
    degrees = math.degrees(COARSE_ANGLE)
    return [
        f"{count} of {len(samples)} samples lie on faces whose smooth normals are more than {degrees:.0f} degrees from "
        "their own: there it depends on how Cycles samples how much light comes from between both horizons (2 %); "
        "more faces help"
    ]


def rounded_positions(position: np.ndarray, lights) -> list[str]:
    """The warning about positions (P, 3) so far from the origin that single precision rounds them noticeably."""
    lights = [light for light in lights if not light.is_distant]
    some = position[:: max(1, len(position) // FEW_SAMPLES, len(position) * len(lights) // MOST_PAIRS)]
    some = some[np.isfinite(some).all(axis=1)]  # an object may be nowhere
    if len(some) == 0 or not lights:
        return []
    apart = np.spacing(np.abs(some).max(axis=1).astype(np.float32)).astype(np.float64)
    nearest, numbers = np.empty(len(some)), np.empty(len(some), int)
    center, half_u, half_v, direction = (
        np.array([getattr(light, name) for light in lights]) for name in ("center", "half_u", "half_v", "direction")
    )
    facing = np.array([light.is_facing for light in lights])
    reach = np.hypot(np.linalg.norm(half_u, axis=1), np.where(facing, 0.0, np.linalg.norm(half_v, axis=1)))
    for row, point in enumerate(some):
        offset = point - center
        distance = np.linalg.norm(offset, axis=1) - reach
        height = np.where(facing, distance, np.abs((offset * direction).sum(axis=1)))
        # A shining surface does not light itself.
        is_own = (distance < 0.0) & (height < 2.0 * apart[row]) & ~facing
        distance = np.where(is_own, np.inf, np.maximum(distance, height))
        numbers[row] = distance.argmin()
        nearest[row] = distance[numbers[row]]
    share = apart / np.maximum(nearest, 1e-30)
    is_rounded = share > ROUNDED
    if np.mean(is_rounded) <= ROUNDED_SHARE:
        return []
    name = lights[np.bincount(numbers[is_rounded]).argmax()].name
    return [
        f"positions are up to {np.abs(some).max():.3g} m from the origin, where they are rounded to "
        f"{1000.0 * apart.max():.2g} mm, in Cycles too: for half of the samples that is over "
        f"{100.0 * min(np.median(share), 1.0):.3g} % of the distance from the nearest light, mostly {name!r}, and "
        "their light is about as uncertain, more in sharp reflections; move the scene to the origin"
    ]
