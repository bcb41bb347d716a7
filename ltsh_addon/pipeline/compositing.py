"""Joins LTSH's direct light with Cycles' picture: where it replaces Cycles' own, its weight there, the denoised rest.

    combined = LTSH's direct light + rest
    rest = denoised(Combined of Cycles - its direct light where LTSH replaces it)

The Combined pass of each light group is treated in the same way. Cycles writes no direct light of a group, so its
direct light of all lights is shared out as LTSH's is. What a group bounces can then change with its lights.

With depth of field LTSH's light is noisy too, since it has few points of the lens. Then the sum is denoised as a whole.

What shines in sight, lamps and the world, has no noise, only jagged edges, which a denoiser makes worse. It stays out
of the denoiser. Cycles renders it once more by itself, with many samples at its edges.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from .. import imaging
from ..cycles.lobes import read_layer
from ..imaging.denoise import NoDenoiser, open_denoiser
from ..imaging.exr import by_group, layer_name
from ..scene import Cancelled
from ..workers.pool import cores
from .comparison import Comparison
from .lighting import Shadows, light_groups

# DIRECT: for each pass of LTSH, the keys of Cycles' light and color in `pass_names`.
DIRECT = {"specular": ("specular_light", "specular_color"), "diffuse": ("diffuse_light", "diffuse_color")}
ALBEDO, NORMAL = ("Denoising Albedo", "RGB"), ("Denoising Normal", "XYZ")
GROUP_PREFIX = "Combined_"  # of the passes of light groups
# Noisy direct light is left to Cycles and the denoiser: some of it from the relative noise MOST_NOISE on, all of it
# from twice as much on. The noise is measured among the pixels that are at most NOISE_RADIUS away.
MOST_NOISE, NOISE_RADIUS = 0.06, 4
# LTSH's few points and the samples of Cycles put an edge of diffuse light at different positions, so their mean is more
# exact than either. LEAST_CURVATURE: second difference of light from pixel to pixel, relative to the light, that counts
# as an edge. EDGE_ERROR: the error of an edge relative to it. EDGE_RADIUS: the pixels on each side that are averaged.
EDGE_ERROR, LEAST_CURVATURE, EDGE_RADIUS = 0.2, 0.1, 1
# FEW_POINTS: Cycles' own specular light stays where the variance of LTSH's points is a larger share of the difference
# to Cycles than the second number; it begins to do so at the first. SLOPE_VARIANCE: the variance within a pixel,
# relative to the squared slope from pixel to pixel; it is twice the true one, to be safe. SHARED_POINTS: points that
# pixels share are worth so many.
FEW_POINTS, SLOPE_VARIANCE, SHARED_POINTS = (0.3, 0.9), 1.0 / 6.0, 2.25
MOST_RECOLORING = 3.0  # how many times the color of LTSH's points Cycles' color of a pixel counts at most
MOST_OF_EDGE = 3.0  # Cycles' light of an edge is at most this many times LTSH's


@dataclass(frozen=True)
class DirectPass:
    """One pass of LTSH, and where it replaces Cycles' direct light, which is `light` times `color`."""

    image: np.ndarray  # (H, W, 3), black elsewhere
    groups: dict[str, np.ndarray]  # the same by light group
    is_replaced: np.ndarray  # (H, W) bool, where LTSH replaces Cycles
    clean_share: np.ndarray  # (H, W) the share of Cycles' direct light that it replaces there, smooth
    light: np.ndarray  # (H, W, 3)
    color: np.ndarray  # (H, W, 3)
    weight: np.ndarray | float = 1.0  # (H, W) of LTSH; the rest of 1 is Cycles' direct light, denoised
    recoloring: np.ndarray | float = 1.0  # (H, W, 3) of `image`, see `recoloring_of_points`

    @property
    def share(self) -> np.ndarray:
        """The share (H, W) of Cycles' direct light that is replaced, weight included."""
        return np.where(self.is_replaced, self.clean_share * self.weight, 0.0)

    @property
    def direct(self) -> np.ndarray:
        """Cycles' direct light (H, W, 3) that is replaced, or would be where `is_replaced` is false."""
        return _share_of(self.clean_share, self.light.astype(np.float64) * self.color)

    def share_of_group(self, group: str) -> np.ndarray:
        """The share (H, W, 3) of it that is light of a light group."""
        return np.divide(self.groups[group], self.image, out=np.zeros_like(self.image), where=self.image != 0.0)


@dataclass(frozen=True)
class Rest:
    """What of a finished picture is not LTSH's direct light."""

    image: np.ndarray  # (H, W, 4)
    edges: np.ndarray  # (H, W, 3), what of it is Cycles' direct diffuse light at edges
    groups: dict[str, np.ndarray]  # (H, W, 3) by light group, and (H, W, 4) as "" what is in none
    denoiser: str  # its name, "" for none
    problems: list[str]  # of the denoiser


def _share_of(share: np.ndarray, image: np.ndarray) -> np.ndarray:
    """`share` (H, W) times `image` (H, W, 3); 0 where the share is 0, even if the image is not finite there."""
    return np.where(share[..., None] > 0.0, share[..., None] * image, 0.0)


# Where LTSH replaces Cycles:


def direct_passes(comparison: Comparison, cycles, is_denoised: bool) -> dict[str, DirectPass]:
    """LTSH's direct light by pass. Where Cycles' light is denoised, too noisy light of LTSH is left to it."""
    extraction, film, passes = comparison.extraction, comparison.film, {}
    shape = film.height, film.width
    technique, result = next(iter(comparison.results.items()), (None, None))
    is_shaded = result is not None and not (cycles.everything or extraction.left_to_cycles.everything)
    # With depth of field LTSH's light is denoised too, so its noise does not matter.
    leaves_noise = is_denoised and not extraction.picture.has_lens
    for name, keys in DIRECT.items():
        light, color = (read_layer(cycles.channels, cycles.names[key], "RGB") for key in keys)
        if not is_shaded:
            nothing = np.zeros((*shape, 3))
            passes[name] = DirectPass(nothing, {}, np.zeros(shape, bool), np.ones(shape), light, color)
            continue
        image, is_replaced = comparison.images[technique, name], ~extraction.left_to_cycles.by_pass[name]
        clean, weight = np.ones(shape), 1.0
        recoloring = np.ones(color.shape)
        if name == "diffuse" and film.sub_samples < cycles.samples and not extraction.picture.has_lens:
            recoloring = recoloring_of_points(film.image(extraction.samples.diffuse_albedo), color)
        image = recoloring * image
        if leaves_noise:
            clean = clean_share(comparison.shadows, name)
            if name == "specular":
                radiance = radiance_of_samples(extraction, result, name)
                clean = clean * weight_of_points(film, radiance, (light * color).mean(axis=-1))
            else:
                of_cycles = _share_of(clean, light.astype(np.float64) * color)
                weight = weight_at_edges(clean[..., None] * image, of_cycles)
                weight = np.where(film.has_more(), 1.0, weight)
        share = np.where(is_replaced, clean * weight, 0.0)
        values = extraction.picture.exposure * getattr(result.shading, name)
        of_groups = (recoloring * film.image(one) for one in values) if len(values) > 1 else (image,)
        groups = zip(light_groups(extraction.lights), of_groups, strict=True)
        groups = {group: _share_of(share, one) for group, one in groups}
        of_cycles = is_replaced, clean, light, color
        passes[name] = DirectPass(_share_of(share, image), groups, *of_cycles, weight, recoloring)
    return passes


def recoloring_of_points(own_color: np.ndarray, color: np.ndarray) -> np.ndarray:
    """Factor (H, W, 3) of LTSH's diffuse light: the `color` (H, W, 3) that Cycles' many samples find over that of
    LTSH's few points, `own_color`. So borders of objects and textures are as smooth as Cycles'."""
    factor = np.divide(color, own_color, out=np.ones_like(own_color), where=own_color > 1e-6)
    return np.minimum(factor, MOST_RECOLORING)


def clean_share(shadows: Shadows, name: str) -> np.ndarray:
    """The share (H, W) of a pass that is used in spite of the noise of its shadows, smooth over the picture."""
    light, variance = (box_mean(image) for image in (np.square(shadows.light[name]), shadows.variance[name]))
    noise = np.sqrt(np.divide(variance, light, out=np.zeros_like(light), where=light > 0.0))
    return box_mean(np.clip(2.0 - noise / MOST_NOISE, 0.0, 1.0))


def weight_of_points(film, radiance: np.ndarray, direct: np.ndarray) -> np.ndarray:
    """The weight (H, W) of LTSH's specular `radiance` (P,) beside Cycles' `direct` (H, W): 0 where its samples are
    more exact.

    Highlights thinner than a pixel need many points. LTSH's variance is that of the points of a pixel, divided by
    their number, without what a slope adds to it: even few points find the mean of a slope. The variance of both
    pictures together is their squared difference.
    """
    image, (variance, mean) = film.image(radiance), point_statistics(film, radiance)
    slope = sum(np.square(one) for one in np.gradient(mean)) if min(mean.shape) > 1 else 0.0
    variance = np.maximum(variance - SLOPE_VARIANCE * slope, 0.0) / max(film.sub_samples - 1, 1)
    variance /= 1.0 if film.spread is None else SHARED_POINTS
    variance = box_mean(np.where(film.has_more(), 0.0, variance))
    both = box_mean(np.square(direct.astype(np.float64) - image))
    share = np.divide(variance, both, out=np.zeros_like(both), where=both > 0.0)
    least, most = FEW_POINTS
    return box_mean(((most - share) / (most - least)).clip(0.0, 1.0))


def weight_at_edges(image: np.ndarray, direct: np.ndarray) -> np.ndarray:
    """The weight (H, W) of LTSH's `image` (H, W, 3) beside Cycles' `direct`: 1 away from edges, down to 1/2 at edges.

    Where both differ by much more than an edge explains, the difference is noise of Cycles, and the weight is near 1.
    """
    curvature = light_curvature(image.mean(axis=-1))
    difference = box_mean(np.square((image - direct).mean(axis=-1)), EDGE_RADIUS)
    edge = box_mean(np.square(EDGE_ERROR * curvature), EDGE_RADIUS)
    share = np.divide(edge, difference, out=np.zeros_like(edge), where=difference > 0.0)
    return 1.0 - 0.5 * np.minimum(share, 1.0)


def light_curvature(light: np.ndarray) -> np.ndarray:
    """The largest second difference (H, W) of `light` (H, W) from pixel to pixel; 0 below LEAST_CURVATURE of it."""
    grid, (height, width) = np.pad(light, 1, mode="edge"), light.shape
    shifted = [grid[y : y + height, x : x + width] for y in range(3) for x in range(3)]
    # The pairs of opposite neighbors of a pixel.
    pairs = zip(shifted[:4], shifted[:4:-1], strict=True)
    curvature = np.max([np.abs(one + other - 2.0 * light) for one, other in pairs], axis=0)
    curvature[curvature < LEAST_CURVATURE * box_mean(light, EDGE_RADIUS)] = 0.0
    return curvature


def point_statistics(film, radiance: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The variance and the mean (H, W) of the `radiance` (P,) of the points of each pixel."""
    hits = film.unspread()
    if film.first is not None:
        radiance, hits = np.bincount(np.cumsum(film.first) - 1, radiance), hits.take(film.first)
    mean = hits.image(radiance)
    return np.maximum(hits.image(np.square(radiance)) - np.square(mean), 0.0), mean


def radiance_of_samples(extraction, result, name: str) -> np.ndarray:
    """The exposed radiance (P,) of a pass: the sum over light groups, the mean over color channels."""
    return extraction.picture.exposure * getattr(result.shading, name).sum(axis=0).mean(axis=-1)


def box_mean(image: np.ndarray, radius: int = NOISE_RADIUS) -> np.ndarray:
    """Means (H, W) over squares with sides of 2 `radius` + 1 pixels."""
    side = 2 * radius + 1
    sums = np.pad(image, ((radius + 1, radius), (radius + 1, radius)), mode="edge").cumsum(axis=0).cumsum(axis=1)
    box = sums[side:, side:] - sums[:-side, side:] - sums[side:, :-side] + sums[:-side, :-side]
    return np.maximum(box, 0.0) / side**2


# The rest:


def denoised_rest(cycles, passes: dict[str, DirectPass], extraction, denoise: str, progress) -> Rest:
    """All that is not LTSH's direct light, denoised if `denoise` is "on"."""
    from ..blender.process.blender_process import denoiser_libraries

    rest, is_noisy = read_layer(cycles.channels, "Combined", "RGBA").astype(np.float64), extraction.picture.has_lens
    shining, diffuse = _shining(cycles, extraction), passes["diffuse"]
    # Once without and once with Cycles' direct diffuse light, of which edges need a share.
    replaced = np.stack([passes["specular"].is_replaced, diffuse.is_replaced, shining.is_replaced], axis=-1)
    replaced = np.stack([replaced, replaced & [True, np.ndim(diffuse.weight) == 0, True]])
    combinations, number = np.unique(replaced.reshape(-1, replaced.shape[-1]), axis=0, return_inverse=True)
    keys = (key for key in cycles.channels if key.startswith(GROUP_PREFIX))
    groups = sorted({key.rpartition(".")[0].removeprefix(GROUP_PREFIX) for key in keys})
    # Each combination of replaced passes is denoised for the whole picture: in one picture, they would bleed into each
    # other at their borders.
    pictures = [_without_replaced(rest[..., :3], [*passes.values(), shining], one, is_noisy) for one in combinations]
    pictures += [_rest_of_group(cycles, passes, group) for group in groups]
    name, problems = "", []
    if denoise == "on":
        guides = [read_layer(cycles.guides, *guide) for guide in (ALBEDO, NORMAL)]
        try:
            with open_denoiser(denoiser_libraries(), cores()) as denoiser:
                if progress is not None and progress("denoise", 0.0) is False:
                    raise Cancelled("stopped before the picture was denoised")
                pictures, name = denoiser.all_denoised(pictures, *guides), denoiser.name
        except NoDenoiser as error:
            problems = [f"{error}; the picture is not denoised"]
    count = len(combinations)
    without, within = np.choose(number.reshape(replaced.shape[:3])[..., None], pictures[:count])
    edges = (1.0 - np.broadcast_to(diffuse.weight, without.shape[:2]))[..., None] * (within - without)
    rest[..., :3] = without + edges + shining.image
    # With depth of field LTSH's light went through the denoiser too.
    rest[..., :3] -= sum(one.image for one in passes.values()) if is_noisy else 0.0
    of_groups = dict(zip(groups, pictures[count:], strict=True))
    for group in of_groups.keys() & diffuse.groups.keys():
        of_groups[group] = of_groups[group] + diffuse.share_of_group(group) * edges
    return Rest(rest, edges, _shared_out(rest, of_groups, is_clean=bool(name)), name, problems)


def most_denoisings(extraction) -> int:
    """How many pictures `denoised_rest` denoises at most: two for each combination of replaced passes, and one for each
    light group."""
    if extraction.left_to_cycles.everything:
        return 1
    combinations = np.unique([mask.ravel() for mask in extraction.left_to_cycles.by_pass.values()], axis=1)
    return 2 * combinations.shape[1] + len({light.group for light in extraction.lights if light.group})


def _shining(cycles, extraction) -> DirectPass:
    """What shines in sight, on the pixels where it can stay out of the denoiser: not behind surfaces that light passes,
    where it is noisy."""
    names = {key: cycles.names[key] for key in cycles.smooth_emission}
    noisy = sum((read_layer(cycles.channels, name, "RGB") for name in names.values()), np.zeros((1, 1, 3)))
    left_to_cycles = extraction.left_to_cycles
    is_hidden = np.logical_and.reduce([*left_to_cycles.by_pass.values()])
    if not names or extraction.picture.has_lens or cycles.everything or left_to_cycles.everything:
        is_hidden = np.ones_like(is_hidden)
    image = sum(cycles.smooth_emission.values(), np.zeros_like(noisy))
    image = np.where(is_hidden[..., None], 0.0, image)
    return DirectPass(image, {}, ~is_hidden, np.ones(is_hidden.shape), noisy, np.ones(3))


def _without_replaced(combined: np.ndarray, passes: list[DirectPass], chosen: np.ndarray, is_noisy: bool) -> np.ndarray:
    """Cycles' picture (H, W, 3) without its light of the `chosen` passes (a bool for each), on all pixels; where LTSH's
    light `is_noisy`, with that in its place."""
    rest = combined.copy()
    for one, is_chosen in zip(passes, chosen, strict=True):
        if is_chosen and is_noisy:
            rest += np.where(one.is_replaced[..., None], one.image - one.direct, 0.0)
        elif is_chosen:
            rest -= one.direct
    return rest


def _rest_of_group(cycles, passes: dict[str, DirectPass], group: str) -> np.ndarray:
    """The light (H, W, 3) of a light group that is not LTSH's."""
    rest = read_layer(cycles.channels, f"{GROUP_PREFIX}{group}", "RGB").astype(np.float64)
    for one in passes.values():
        if group in one.groups:
            rest -= one.share_of_group(group) * np.where(one.is_replaced[..., None], one.direct, 0.0)
    return rest


def _shared_out(rest: np.ndarray, groups: dict[str, np.ndarray], is_clean: bool) -> dict[str, np.ndarray]:
    """`groups` (H, W, 3), and as "" what remains of `rest` (H, W, 4); of one that `is_clean` no more than all."""
    if is_clean and groups:
        total = np.maximum(sum(groups.values()), 1e-30)
        groups = {name: one * np.clip(rest[..., :3] / total, 0.0, 1.0) for name, one in groups.items()}
    remaining = rest.copy()
    for one in groups.values():
        remaining[..., :3] -= one
    return {"": remaining, **groups}


def noise(cycles, passes: dict[str, DirectPass]) -> list[float]:
    """Mean noise of a pixel before denoising, relative to the light: of Cycles' picture without what LTSH replaces, and
    of all of it; [] if it is not known."""
    if not cycles.noise:
        return []
    whole, light = read_layer(cycles.noise, "Combined", "RGB"), read_layer(cycles.channels, "Combined", "RGB").sum()
    direct = {name: read_layer(cycles.noise, cycles.names[light], "RGB") for name, (light, _) in DIRECT.items()}
    replaced = sum(_share_of(one.share, direct[name] * one.color) for name, one in passes.items())
    return [float(np.nansum(np.abs(one)) / max(light, 1e-30)) for one in (whole - replaced, whole)]


# What is written:


def relight_fields(passes: dict[str, DirectPass], rest: Rest) -> dict[str, dict[str, np.ndarray]]:
    """`rest`, `taken` and `edges` of the RelightData. Cycles' light of an edge becomes a factor of LTSH's, so that it
    changes with the lights as LTSH's does."""
    taken = {
        name: np.where(one.is_replaced, one.clean_share, 0.0)[..., None] * one.recoloring
        for name, one in passes.items()
    }
    diffuse, groups = passes["diffuse"], rest.groups
    if np.ndim(diffuse.weight) == 0:
        return {"rest": groups, "taken": taken, "edges": {}}
    light = diffuse.image.mean(axis=-1)
    more = np.divide(rest.edges.mean(axis=-1), light, out=np.zeros_like(light), where=light > 0.0)
    more = np.clip(more, 0.0, MOST_OF_EDGE)
    # What this factor cannot express stays in the rest: light of other colors, and light where LTSH's is dark.
    of_lights, groups = more[..., None] * diffuse.image, {group: one.copy() for group, one in groups.items()}
    for group in groups.keys() & diffuse.groups.keys() - {""}:
        of_group = diffuse.share_of_group(group) * of_lights
        groups[group] -= of_group
        groups[""][..., :3] += of_group
    groups[""][..., :3] -= of_lights
    return {"rest": groups, "taken": taken, "edges": {"diffuse": diffuse.weight * (1.0 + more)}}


def direct_layers(comparison: Comparison, passes: dict[str, DirectPass]) -> dict[str, np.ndarray]:
    """LTSH's direct light by the names of the layers, also by light group where there are several."""
    layers = {}
    for technique in list(comparison.results)[:1]:
        for pass_name, one in passes.items():
            name = layer_name(technique, pass_name)
            layers |= {name: one.image, **by_group(name, tuple(one.groups), one.groups.values())}
    return layers


def cycles_channels(cycles, passes: dict[str, DirectPass], rest: Rest) -> dict[str, np.ndarray]:
    """Cycles' channels with LTSH's direct light in place of Cycles' own, without its noisy Combined."""
    channels = {name: plane for name, plane in cycles.channels.items() if not name.startswith("Combined.")}
    for name, (light, _) in DIRECT.items():
        one = passes[name]
        white = np.divide(one.image, one.color, out=np.zeros_like(one.image), where=one.color > 0.0)
        for index, letter in enumerate("RGB"):
            key = f"{cycles.names[light]}.{letter}"
            channels[key] = white[..., index] + (1.0 - one.share) * channels[key]
    for group, image in rest.groups.items():
        if group:
            whole = image + sum(one.groups.get(group, 0.0) for one in passes.values())
            channels |= imaging.Layer(whole).planes(f"{GROUP_PREFIX}{group}")
    return channels
