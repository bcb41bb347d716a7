"""Joins LTSH's direct light with Cycles' picture, each pixel by what has the least error there.

There are up to three pictures of the same light:

    1. LTSH's direct light + denoised(Combined of Cycles - its direct light where LTSH replaces it)
    2. denoised(Combined)
    3. Combined, with its noise

Their errors are measured: from half of Cycles' samples each is made anew, and compared with the other half, which has
noise of its own (Rousselle, Knaus & Zwicker 2012, Adaptive Rendering with Non-Local Means Filtering, section 4). The
first two are joined by least squares against that half; both together and the third weigh by their errors. So
light that LTSH shades differently, or with too few points or shadow rays, and detail that the denoiser would blur, are
Cycles'. In the files LTSH's light has a factor that says so, and the rest is what no light gives directly.

The Combined pass of each light group is treated in the same way. Cycles writes no direct light of a group, so its
direct light of all lights is shared out as LTSH's is. What a group bounces can then change with its lights.

With depth of field LTSH's light is noisy too, since it has few points of the lens. Then the sum is denoised as a whole.

What shines in sight, lamps and the world, has no noise, only jagged edges, which a denoiser makes worse. It stays out
of the denoiser. Cycles renders it once more by itself, with many samples at its edges.
"""

from dataclasses import dataclass, replace

import numpy as np

from .. import imaging
from ..cycles.lobes import read_layer
from ..imaging.denoise import BEST, HALVES, PLAIN, NoDenoiser, open_denoiser
from ..imaging.exr import by_group, layer_name
from ..scene import PASSES, Cancelled
from ..workers.pool import cores
from .aliasing import box_mean, factor_of_samples
from .comparison import Comparison
from .lighting import light_groups

# DIRECT: for each pass of LTSH, the keys of Cycles' light and color in `pass_names`.
DIRECT = {"specular": ("specular_light", "specular_color"), "diffuse": ("diffuse_light", "diffuse_color")}
ALBEDO, NORMAL = ("Denoising Albedo", "RGB"), ("Denoising Normal", "XYZ")
GROUP_PREFIX = "Combined_"  # of the passes of light groups
# The errors of pixels are means over those that are at most ERROR_RADIUS away, and not OCTAVES brighter or darker;
# below DARKEST of the mean brightness all are alike. Without this, squares of noise surround highlights. Noisy and
# clean pictures weigh by their squared errors to the power -ERROR_POWER, which are at least LEAST_ERROR of Cycles'
# noise.
ERROR_RADIUS, OCTAVES, DARKEST, ERROR_POWER, LEAST_ERROR = 4, 2.0, 2.0**-6, 2, 0.1
# VISIBLE_NOISE: as a share of the light. Of a firefly a denoiser leaves a faint stain, which errs more than the noise
# around it does, but the eye sees that noise first. So noise of this share counts twice, and more of it more. In eight
# scenes the pixels below the brightest err 1.5 % less by this, FLIP 0.3 % more.
VISIBLE_NOISE = 0.1
# MEAN_SHARE: the share that the mean of the denoised halves has in a denoised picture. Each is blurred in a way of its
# own: in nine scenes 0.25 takes 1 % of FLIP's error away and 1.5 % of L2's, 0.15 to 0.35 as much.
MEAN_SHARE = 0.25
BRIGHTEST = 0.002  # the share of the pixels, the brightest, that `first_errors` leaves out
MOST_FACTOR = 3.0  # direct light of the finished picture is at most this many times LTSH's


@dataclass(frozen=True)
class DirectPass:
    """One pass of LTSH, and where it may replace Cycles' direct light, which is `light` times `color`."""

    image: np.ndarray  # (H, W, 3), black elsewhere
    groups: dict[str, np.ndarray]  # the same by light group
    is_replaced: np.ndarray  # (H, W) bool
    light: np.ndarray  # (H, W, 3)
    color: np.ndarray  # (H, W, 3)
    names: tuple[str, ...] = ()  # of the channels that `light` is the sum of
    recoloring: np.ndarray | float = 1.0  # (H, W, 3) of `image`, see `aliasing`

    def by_cycles(self, half=None) -> np.ndarray:
        """Cycles' direct light (H, W, 3), or what a `CyclesHalf` shows of it."""
        light = self.light if half is None else sum(read_layer(half.channels, name, "RGB") for name in self.names)
        return np.asarray(light, np.float64) * self.color

    def replaced(self, half=None) -> np.ndarray:
        """`by_cycles` where it is replaced, 0 elsewhere."""
        return np.where(self.is_replaced[..., None], self.by_cycles(half), 0.0)

    def scaled(self, factor: np.ndarray) -> "DirectPass":
        """The same with `factor` (H, W, 3) times LTSH's light."""
        groups = {group: factor * one for group, one in self.groups.items()}
        return replace(self, image=factor * self.image, groups=groups)


@dataclass(frozen=True)
class Composite:
    """A finished picture: combined = rest + the images of all passes."""

    combined: np.ndarray  # (H, W, 4)
    rest: np.ndarray  # (H, W, 4)
    passes: dict[str, DirectPass]  # with the light as it is in the picture
    factor: np.ndarray  # (H, W, 3) of LTSH's light in them
    groups: dict[str, np.ndarray]  # of the rest: (H, W, 3) by light group, and (H, W, 4) as "" what is in none
    denoiser: str  # its name, "" for none
    problems: list[str]  # of the denoiser
    weight: np.ndarray  # (H, W) of the picture with LTSH's light
    errors: tuple[float, float] | None = None  # relative, of about half of the samples: the picture's; Cycles' denoised


# Where LTSH replaces Cycles:


def direct_passes(comparison: Comparison, cycles) -> dict[str, DirectPass]:
    """LTSH's direct light by pass."""
    extraction, film, passes = comparison.extraction, comparison.film, {}
    shape = film.height, film.width
    technique, result = next(iter(comparison.results.items()), (None, None))
    is_shaded = result is not None and not (cycles.everything or extraction.left_to_cycles.everything)
    for name, keys in DIRECT.items():
        light, color = (read_layer(cycles.channels, cycles.names[key], "RGB") for key in keys)
        if not is_shaded:
            passes[name] = DirectPass(np.zeros((*shape, 3)), {}, np.zeros(shape, bool), light, color)
            continue
        image, is_replaced = comparison.images[technique, name], extraction.left_to_cycles.replaced(name)
        recoloring = np.ones(color.shape)
        if name == "diffuse" and film.sub_samples < cycles.samples and not extraction.picture.has_lens:
            radiance, normal = result.shading.diffuse.sum(axis=0), read_layer(cycles.guides, *NORMAL) @ cycles.to_camera
            surfaces = color.astype(np.float64), normal, cycles.samples
            recoloring = factor_of_samples(film, extraction.samples, radiance, *surfaces)
        recoloring = np.where(is_replaced[..., None], recoloring, 0.0)
        values = extraction.picture.exposure * getattr(result.shading, name)
        images = [film.image(one) for one in values] if len(values) > 1 else [image]
        groups = {group: recoloring * one for group, one in zip(light_groups(extraction.lights), images, strict=True)}
        names = (cycles.names[keys[0]],)
        passes[name] = DirectPass(recoloring * image, groups, is_replaced, light, color, names, recoloring)
    return passes


def variance_of_points(extraction, result) -> np.ndarray:
    """The unbiased variance (H, W) of LTSH's exposed light among the points of each pixel, where it is to replace
    Cycles'; a mean over color channels. `DirectPass.recoloring` takes the variance of diffuse colors away."""
    film, points = extraction.film, extraction.film.sub_samples
    albedo, total = extraction.samples.diffuse_albedo.mean(axis=-1), 0.0
    for name in PASSES:
        radiance = extraction.picture.exposure * getattr(result.shading, name).sum(axis=0).mean(axis=-1)
        if name == "diffuse":
            hits, (radiance, color) = film.hits(radiance, albedo)
            radiance, color = radiance / np.maximum(color, 1e-6), hits.image(color)
        else:
            (hits, (radiance,)), color = film.hits(radiance), 1.0
        variance = np.maximum(hits.image(np.square(radiance)) - np.square(hits.image(radiance)), 0.0)
        total = total + np.where(extraction.left_to_cycles.by_pass[name], 0.0, variance * np.square(color))
    return total * points / max(points - 1, 1)


class _Around:
    """Means over all pixels that are at most ERROR_RADIUS away and about as bright, by the `picture` (H, W, 3)."""

    def __init__(self, picture: np.ndarray):
        brightness = np.clip(np.nan_to_num(picture.mean(axis=-1)), 0.0, 1e30)
        level = np.log2(brightness / max(brightness.mean(), 1e-30) + DARKEST) / OCTAVES
        steps = np.arange(np.floor(level.min()), np.ceil(level.max()) + 1.0)
        weights = [np.maximum(1.0 - np.abs(level - step), 0.0) for step in steps]
        self._weights = [(one, box_mean(one, ERROR_RADIUS)) for one in weights if one.any()]

    def mean(self, image: np.ndarray) -> np.ndarray:
        """Means (H, W) of an `image` (H, W), at least 0."""
        means = (one * box_mean(one * image, ERROR_RADIUS) / np.maximum(total, 1e-9) for one, total in self._weights)
        return np.maximum(sum(means), 0.0)


# The picture:


def composite(cycles, passes: dict[str, DirectPass], extraction, denoise: str, progress) -> Composite:
    """The finished picture, denoised if `denoise` is "on"."""
    rest, is_noisy = read_layer(cycles.channels, "Combined", "RGBA").astype(np.float64), extraction.picture.has_lens
    shining = _shining(cycles, extraction)
    replaced = np.stack([one.is_replaced for one in passes.values()], axis=-1)
    combinations, number = np.unique(replaced.reshape(-1, replaced.shape[-1]), axis=0, return_inverse=True)
    # Of `pictures`, by pixel; the first is the combination in which nothing is replaced.
    number = number.reshape(replaced.shape[:2])[..., None] + combinations[0].any()
    combinations = combinations[combinations.any(axis=1)]
    direct = 0.0 if is_noisy else sum(one.image for one in passes.values())

    def pictures(half=None) -> list[np.ndarray]:
        """Combined, and without each combination of replaced passes, on all pixels, also where they are not replaced:
        the denoiser would blur the borders."""
        whole = rest[..., :3] if half is None else read_layer(half.channels, "Combined", "RGB").astype(np.float64)
        whole = whole - shining.replaced(half)
        without = [one.by_cycles(half) - (one.image if is_noisy else 0.0) for one in passes.values()]
        return [whole, *(whole - np.compress(chosen, without, axis=0).sum(axis=0) for chosen in combinations)]

    keys = (key for key in cycles.channels if key.startswith(GROUP_PREFIX))
    names = sorted({key.rpartition(".")[0].removeprefix(GROUP_PREFIX) for key in keys})
    halves = cycles.halves if denoise == "on" else ()
    noisy = [pictures(half) for half in (None, *halves)]
    groups = [_rest_of_group(cycles, passes, name) for name in names]
    (clean, *of_halves, groups), denoiser, problems = _denoised([*noisy, groups], cycles.guides, denoise, progress)
    weights, errors = [np.ones(replaced.shape[:2]), 0.0, 0.0], None
    if denoiser and len(halves) == 2:
        counts = [half.samples for half in halves]
        others = [(many[0], np.choose(number, many) + direct) for many in of_halves]
        weights, errors = _weights([one for one, *_ in noisy[1:]], others, counts)
        means = [np.average(pair, axis=0, weights=counts) for pair in zip(*of_halves, strict=True)]
        clean = [one + MEAN_SHARE * (mean - one) for one, mean in zip(clean, means, strict=True)]
    ours = np.choose(number, clean) + direct
    plain = np.where(np.isfinite(noisy[0][0]), noisy[0][0], clean[0])
    image = sum(np.atleast_3d(weight) * one for weight, one in zip(weights, (ours, clean[0], plain), strict=True))
    bounced = ours - sum(one.image for one in passes.values())
    factor = np.ones(image.shape)
    if not is_noisy:
        factor = np.divide(image - bounced, direct, out=factor, where=direct > 0.0).clip(0.0, MOST_FACTOR)
        passes = {name: one.scaled(factor) for name, one in passes.items()}
    image = image + shining.image
    rest[..., :3] = image - sum(one.image for one in passes.values())
    combined = np.concatenate([image, rest[..., 3:]], axis=-1)
    groups = _shared_out(rest, dict(zip(names, groups, strict=True)), is_clean=bool(denoiser))
    return Composite(combined, rest, passes, factor, groups, denoiser, problems, weights[0], errors)


def _denoised(lists: list[list[np.ndarray]], guides: dict, denoise: str, progress) -> tuple[list, str, list[str]]:
    """`lists` of pictures (H, W, 3), denoised if `denoise` is "on"; the name of the denoiser, and its problems.

    The first list is filtered best, the last plainly, two between them, of halves, in less time.
    """
    from ..blender.process.blender_process import denoiser_libraries

    if denoise != "on":
        return lists, "", []
    flat = [one for pictures in lists for one in pictures]
    try:
        with open_denoiser(denoiser_libraries(), cores()) as denoiser:
            if progress is not None and progress("denoise", 0.0) is False:
                raise Cancelled("stopped before the picture was denoised")
            images = [read_layer(guides, *guide) for guide in (ALBEDO, NORMAL)]
            of_lists = zip(lists, (BEST, *HALVES[: len(lists) - 2], PLAIN), strict=True)
            ways = [way for pictures, way in of_lists for _ in pictures]
            clean = iter(denoiser.all_denoised(flat, *images, ways))
            return [[next(clean) for _ in pictures] for pictures in lists], denoiser.name, []
    except NoDenoiser as error:
        return lists, "", [f"{error}; the picture is not denoised"]


def _weights(noisy, others, samples) -> tuple[list[np.ndarray], tuple[float, float]]:
    """The weights (H, W) of LTSH's, the denoised and the noisy picture; and `Composite.errors`.

    Of each half with so many `samples`, `noisy` has the picture (H, W, 3), and `others` the denoised picture and that
    with LTSH's light.
    """
    first, second = map(np.nan_to_num, noisy)
    number, other = samples
    variance = np.square(first - second) * (number * other / (number + other))  # of one sample
    denoised, lit = zip(*others, strict=True)
    around = _Around(0.5 * sum(denoised))

    def error(*pictures) -> np.ndarray:
        return 0.5 * sum(_squared_errors(pictures, (first, second), samples))

    def mean(products) -> np.ndarray:
        return around.mean(0.5 * sum(products).mean(axis=-1))

    noise = around.mean(0.5 * (variance / number + variance / other).mean(axis=-1))
    steps = [ours - theirs for ours, theirs in zip(lit, denoised, strict=True)]
    # The step from the denoised picture towards LTSH's that is nearest to the other half: the least squares have far
    # less noise than the difference of both errors. Where the step drowns in noise it is taken whole.
    unsure = noise / (2 * ERROR_RADIUS + 1) ** 2
    wanted = mean(step * (half - one) for step, half, one in zip(steps, (second, first), denoised, strict=True))
    share = ((wanted + unsure) / (mean(map(np.square, steps)) + unsure + 1e-20)).clip(0.0, 1.0)
    lit = [one + share[..., None] * step for one, step in zip(denoised, steps, strict=True)]
    errors = [np.maximum(around.mean(error(*pair)), LEAST_ERROR * noise) for pair in (lit, denoised)]
    visible = noise / (np.square(VISIBLE_NOISE * 0.5 * sum(denoised).mean(axis=-1)) + 1e-20)
    powers = [(one + 1e-20) ** -ERROR_POWER for one in (errors[0], noise * (1.0 + visible))]
    clean, noisy = (one / sum(powers) for one in powers)
    # A mean errs at most as much as its parts do on average.
    light = max(np.square(denoised).mean(), 1e-30)
    ours = clean * errors[0] + noisy * noise
    weights = [clean * share, clean * (1.0 - share), noisy]
    return weights, tuple(float(np.sqrt(one.mean() / light)) for one in (ours, errors[1]))


@dataclass(frozen=True)
class FirstErrors:
    """What the first samples of Cycles tell of its errors, as squares (H, W) in means around each pixel, without the
    brightest pixels. They may be below 0, since noise is taken off."""

    samples: float  # half of the first, which have these errors
    whole: np.ndarray  # of Cycles' picture
    rest: np.ndarray  # of the picture without the direct light that LTSH would replace
    is_denoised: bool


def first_errors(cycles, by_pass: dict[str, np.ndarray], denoise: str, progress) -> FirstErrors | None:
    """The errors of the two halves of a picture that was only begun; None if it has none. `by_pass` are the masks
    (H, W) of the direct light that is left to Cycles."""
    if len(cycles.halves) < 2:
        return None
    whole, rest, passes = [], [], []
    for name, (key, color) in DIRECT.items():
        layers = (read_layer(cycles.channels, cycles.names[color], "RGB"), (cycles.names[key],))
        passes.append(DirectPass(np.zeros(()), {}, ~by_pass[name], np.zeros(()), *layers))
    for half in cycles.halves:
        shining = sum(read_layer(half.channels, cycles.names[key], "RGB").astype(np.float64) for key in cycles.shining)
        light = read_layer(half.channels, "Combined", "RGB") - shining
        whole.append(np.nan_to_num(light))
        rest.append(np.nan_to_num(light - sum(one.replaced(half) for one in passes)))
    (_, clean, _), denoiser, _ = _denoised([[], [*whole, *rest], []], cycles.guides, denoise, progress)
    brightness, counts = sum(clean[:2]).mean(axis=-1), [half.samples for half in cycles.halves]
    counts_at_all = brightness <= np.quantile(brightness, 1.0 - BRIGHTEST)
    errors = [_squared_errors(*pair, counts) for pair in ((clean[:2], whole), (clean[2:], rest))]
    maps = (box_mean(np.where(counts_at_all, 0.5 * sum(one), 0.0), ERROR_RADIUS) for one in errors)
    return FirstErrors(0.5 * sum(counts), *maps, bool(denoiser))


def _squared_errors(pictures, noisy, samples) -> list[np.ndarray]:
    """Squared errors (H, W) of the `pictures` of two halves with so many `samples`, each by the other half, `noisy`."""
    variance = np.square(noisy[0] - noisy[1]) / sum(1.0 / count for count in samples)  # of one sample
    pairs = zip(pictures, noisy[::-1], samples[::-1], strict=True)
    return [(np.square(one - half) - variance / count).mean(axis=-1) for one, half, count in pairs]


def most_denoisings(extraction) -> int:
    """How many pictures `composite` denoises at most."""
    combinations = 0
    if not extraction.left_to_cycles.everything:
        masks = [mask.ravel() for mask in extraction.left_to_cycles.by_pass.values()]
        combinations = np.unique(masks, axis=1).shape[1]
    return 3 * (1 + combinations) + len({light.group for light in extraction.lights if light.group})


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
    return DirectPass(image, {}, ~is_hidden, noisy, np.ones(3), tuple(names.values()))


def _rest_of_group(cycles, passes: dict[str, DirectPass], group: str) -> np.ndarray:
    """The light (H, W, 3) of a light group that is not LTSH's."""
    rest = read_layer(cycles.channels, f"{GROUP_PREFIX}{group}", "RGB").astype(np.float64)
    for one in passes.values():
        if group in one.groups:
            light = one.groups[group]
            share = np.divide(light, one.image, out=np.zeros_like(light), where=one.image != 0.0)
            rest -= share * one.replaced()
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


# What is written:


def relight_fields(picture: Composite) -> dict[str, dict[str, np.ndarray]]:
    """`rest`, `taken` and `edges` of the RelightData. What Cycles tells of direct light is a factor of LTSH's, so that
    it changes with the lights as LTSH's does."""
    taken = {name: one.recoloring for name, one in picture.passes.items()}
    return {"rest": picture.groups, "taken": taken, "edges": dict.fromkeys(taken, picture.factor)}


def direct_layers(comparison: Comparison, passes: dict[str, DirectPass]) -> dict[str, np.ndarray]:
    """LTSH's direct light by the names of the layers, also by light group where there are several."""
    layers = {}
    for technique in list(comparison.results)[:1]:
        for pass_name, one in passes.items():
            name = layer_name(technique, pass_name)
            layers |= {name: one.image, **by_group(name, tuple(one.groups), one.groups.values())}
    return layers


def cycles_channels(cycles, picture: Composite) -> dict[str, np.ndarray]:
    """Cycles' channels with LTSH's direct light in place of Cycles' own, without its noisy Combined."""
    channels = {name: plane for name, plane in cycles.channels.items() if not name.startswith("Combined.")}
    for name, (light, _) in DIRECT.items():
        one = picture.passes[name]
        white = np.divide(one.image, one.color, out=np.zeros_like(one.image), where=one.color > 0.0)
        for index, letter in enumerate("RGB"):
            key = f"{cycles.names[light]}.{letter}"
            channels[key] = np.where(one.is_replaced, white[..., index], channels[key])
    for group, image in picture.groups.items():
        if group:
            whole = image + sum(one.groups.get(group, 0.0) for one in picture.passes.values())
            channels |= imaging.Layer(whole).planes(f"{GROUP_PREFIX}{group}")
    return channels
