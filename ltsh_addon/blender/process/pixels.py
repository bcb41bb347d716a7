"""The job of a picture's samples: lights, surface samples and Cycles' picture of a .blend. Imports no bpy."""

import errno
import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path

import numpy as np

from ...cycles import gbuffer, lobes
from ...cycles.environment import DETAIL_ANGLE, SMOOTH_SKY
from ...cycles.horizons import end_at_horizons_of_cycles
from ...emitters.light_polygons import has_lobe, lights_that_reach_nothing
from ...files import temporary_folder
from ...imaging.color import identified
from ...imaging.exr import read_channels
from ...scene import REC709, Border, ColorSpace, Film, Light, Progress, SurfaceSamples, lights_of, listed
from ...visibility import Occluders
from .blender_process import run_scene_job

# REASONS: how many materials, or other reasons, an error names. LEAST_PERCENT: of the samples that no warning tells.
REASONS, LEAST_PERCENT = 5, 0.1
SHARP_REFLECTION = 0.2  # surfaces of a smaller roughness show the patches of a world with fine detail
# EDGE_SECONDS: processor seconds that a million pixels of `finished.FinishedJob.edges` take.
EDGE_SECONDS = 12.0
LEAST_POINTS = 2  # per pixel, with a budget: one alone leaves more error than Cycles does in that time
BEHIND = "behind"  # the folder of the renders of what is behind glass
# THROUGH_GLASS: what a picture shows behind glass, by whether that was rendered.
THROUGH_GLASS = {
    True: "what is behind it is sharp and not reflected inside it; light that it focuses is left out",
    False: "what is behind it is left out, of the Cycles reference too (see the layer coverage.glass)",
}


# Processor seconds of direct light. START_SECONDS: always, beside another look at the scene by Cycles. LIGHT_SECONDS:
# for each of up to MOST_LIGHTS. POINT_SECONDS: for a point of a pixel. Shares of the seconds that are left.
# POINTS_SHARE: at most for points. DIRECT_SHARE: at most for what is needed always.
START_SECONDS, LIGHT_SECONDS, MOST_LIGHTS, POINT_SECONDS = 1.8, 0.06, 100, 4e-6
POINTS_SHARE, DIRECT_SHARE = 0.04, 0.3


def affordable_points(seconds: float, pixels: int, lights: int, looked: float = 0.0) -> int:
    """How many points of each pixel the processor seconds that are left allow; 0: too few would remain for Cycles.

    The next look at the scene is expected to take as long as the first, `looked` seconds.
    """
    if DIRECT_SHARE * seconds < START_SECONDS + LIGHT_SECONDS * min(lights, MOST_LIGHTS) + looked:
        return 0
    return max(int(POINTS_SHARE * (seconds - looked) / (POINT_SECONDS * pixels)), 1)


def longest_look(seconds: float) -> float:
    """How long a look at the scene may take for `affordable_points` in what is left of so many `seconds` afterwards."""
    return (DIRECT_SHARE * seconds - START_SECONDS - LIGHT_SECONDS) / (1.0 + DIRECT_SHARE)


@dataclass(frozen=True)
class PixelJob:
    """What to extract from which file. `cycles_samples` 0 means no Cycles reference; None means as in the file."""

    scene: Path
    width: int | None = None
    height: int | None = None
    sub_samples: int = 1  # of finished pictures also 0
    cycles_samples: int = 0
    frame: int | None = None
    camera: str | None = None
    scene_name: str | None = None
    view_layer: str | None = None
    scripts: bool = False  # run the scripts in the file
    rest: bool = False  # also what in the picture is not reflected light
    indices: tuple[str, ...] = ()  # keys of index passes, such as "object_index"; see `render_settings.pass_names`
    shadows: str = "off"  # "on": also the occluders, which then block light in the Cycles reference, too
    for_finished: bool = False  # also what a finished picture leaves to Cycles; no light is needed
    seconds: float | None = None  # processor time that is left before denoising, which limits its sub-samples
    own_groups: tuple[str, ...] | None = None  # as in `finished.FinishedJob`


# Why all direct light is left to Cycles.
TOO_FEW_SAMPLES = "beside so few samples it takes longer than it wins (more of them change that, or --aa)"
TOO_LITTLE_TIME = "the budget is too small for it"
TOO_LITTLE_GAIN = "in the time of the budget it would not make the error less than Cycles' own samples do"


@dataclass(frozen=True)
class PictureFacts:
    """How a picture was rendered.

    - `exposure` is the film exposure of the scene, by which all radiance of a render is multiplied.
    - `border` is None if the whole picture was rendered. Pixels are `pixel_aspect` times as wide as high.
    - Sub-samples are drawn from the scene's `pixel_filter`.
    - All colors, those of the lights included, are in `color_space`.
    """

    frame: int
    camera: str
    blender_version: str
    exposure: float = 1.0
    pixel_aspect: float = 1.0
    pixel_filter: str = "BOX"
    has_lens: bool = False  # depth of field: samples are seen through different points of the lens
    border: Border | None = None
    color_space: ColorSpace = REC709

    @classmethod
    def of(cls, record: dict) -> "PictureFacts":
        """The facts that `record` describes; other keys of it are ignored."""
        fields = {name: record[name] for name in cls.__dataclass_fields__}
        border, space = record["border"], record["color_space"]
        fields["border"] = None if border is None else Border(**border)
        return cls(**{**fields, "color_space": identified(np.array(space["to_rec709"]), space["name"])})

    def record(self) -> dict:
        """For JSON and `of`."""
        border = None if self.border is None else vars(self.border)
        space = {"name": self.color_space.name, "to_rec709": np.asarray(self.color_space.to_rec709).tolist()}
        return {**vars(self), "border": border, "color_space": space}


@dataclass(frozen=True)
class CyclesPasses:
    """What Cycles rendered beside the samples; None or {} if it was not asked for.

    - `reference` maps "specular" and "diffuse" to (2, H, W, 3) float32: the halves A and B, row 0 on top, in
      W m^-2 sr^-1 times the exposure.
    - `emission` (H, W, 3) is the emission of surfaces and lights in sight. `background` (H, W, 4) is the world seen
      behind them, with the alpha of the picture. Both are without the exposure.
    - `indices` are passes (H, W) of the first sub-sample, by Cycles' names.
    """

    reference: dict[str, np.ndarray] | None = None
    emission: np.ndarray | None = None
    background: np.ndarray | None = None
    indices: dict[str, np.ndarray] = field(default_factory=dict)


@dataclass(frozen=True)
class ExtractionTimes:
    """How long an extraction took in the second Blender."""

    stages: dict[str, float] = field(default_factory=dict)  # seconds by "start", "samples" and "cycles"
    processor: float = 0.0  # processor seconds
    direct: float = 0.0  # how many of them came after the file was opened


@dataclass(frozen=True)
class LeftToCycles:
    """The pixels of a finished picture that take direct light from Cycles, and why."""

    by_pass: dict[str, np.ndarray]  # masks (H, W)
    materials: tuple[str, ...]  # materials for which it does
    everything: tuple[str, ...]  # reasons why it does everywhere
    warnings: tuple[str, ...]  # about direct light that is shaded here
    shaded: np.ndarray | None = None  # mask (H, W) of the pixels that have samples at all; None: all

    def replaced(self, pass_name: str) -> np.ndarray:
        """Mask (H, W) of the pixels whose light of this pass is LTSH's."""
        mask = ~self.by_pass[pass_name]
        return mask if self.shaded is None else mask & self.shaded


@dataclass(frozen=True)
class PixelPoints:
    """The points of the pixels of a finished picture."""

    number: np.ndarray | None = None  # (P,) of each sample's point in its pixel
    weights: np.ndarray | None = None  # (N, D, D) of the points, as in `Film.shared`


@dataclass(frozen=True)
class Extraction:
    """The lights and samples of a picture, and what Cycles rendered of it."""

    lights: tuple[Light, ...]
    samples: SurfaceSamples
    film: Film
    picture: PictureFacts
    cycles: CyclesPasses = field(default_factory=CyclesPasses)
    times: ExtractionTimes = field(default_factory=ExtractionTimes)
    warnings: tuple[str, ...] = ()
    problems: tuple[str, ...] = ()  # why most of the picture is not shaded
    occluders: Occluders | None = None  # None without shadows
    light_settings: dict[str, list[float]] = field(default_factory=dict)  # power, exposure, red, green, blue by object
    glass: np.ndarray | None = None  # (H, W) share of the points of a pixel that show glass; None: no glass in view
    behind: "Extraction | None" = None  # what is seen through the glass, tinted
    # Of finished pictures:
    left_to_cycles: LeftToCycles | None = None
    points: PixelPoints = field(default_factory=PixelPoints)

    @property
    def rest(self) -> np.ndarray | None:
        """The picture (H, W, 4) without reflected light: emission, lights in sight and world.

        It includes the exposure. Together with all reflected light it is Cycles' picture of the file. None if it was
        not asked for.
        """
        if self.cycles.background is None:
            return None
        light = self.picture.exposure * (self.cycles.emission + self.cycles.background[..., :3])
        return np.concatenate([light, self.cycles.background[..., 3:]], axis=-1)

    def by_cycles(self, *reasons: str) -> "Extraction":
        """The same of a finished picture that leaves all direct light to Cycles."""
        theirs = self.left_to_cycles
        return replace(self, left_to_cycles=replace(theirs, everything=(*theirs.everything, *reasons)))


def extract_pixels(
    job: PixelJob, *, progress: Progress | None = None, look: Callable[[Extraction], None] | None = None
) -> Extraction:
    """The lights, samples and (if asked for) the Cycles reference of a .blend.

    `look` gets the extraction before its lobes end at horizons, which may take long. For finished pictures it stays so.
    Raises SceneError if the scene or file cannot be used, Cancelled if `progress(stage, fraction)` returned False.
    """
    with temporary_folder() as folder:
        extraction = RenderedPixels.of(job, folder, progress).extraction()
    if job.for_finished:
        return extraction
    if look is not None:
        look(extraction)
    return ended_at_horizons(extraction, progress)


@dataclass(frozen=True)
class RenderedPixels:
    """What a job rendered, in a `folder` that must stay while it is read."""

    job: PixelJob
    folder: Path
    manifest: dict

    @classmethod
    def of(cls, job: PixelJob, folder: Path, progress: Progress | None = None) -> "RenderedPixels":
        """Do the `job`. Raises as `extract_pixels` does."""
        fewest = 0 if job.for_finished else 1
        if job.sub_samples < fewest or job.cycles_samples < 0:
            counts = f"sub_samples is {job.sub_samples} and cycles_samples {job.cycles_samples}"
            raise ValueError(f"{counts}, expected at least {fewest} and 0")
        return cls(job, folder, run_scene_job(job, folder, progress))

    @cached_property
    def _lights(self) -> list[Light]:
        return lights_of(self.manifest["lights"])

    @cached_property
    def _occluders(self) -> Occluders | None:
        name = self.manifest["occluders"]
        return Occluders.load(self.folder / name) if name else None

    def extraction(self, points: int | None = None, where: np.ndarray | None = None) -> Extraction:
        """The extraction, by default of all `points` of each pixel.

        Of finished pictures only the pixels of the mask `where` (H, W) have samples; all others are left to Cycles.
        """
        job, manifest, folder = self.job, self.manifest, self.folder
        renders = _SampleRenders(job, manifest, where=where)
        for name in manifest["samples"][:points]:
            renders.add(rendered_channels(folder / name))
        samples, film = renders.joined()
        lights = self._lights
        warnings, problems = renders.messages(samples, film)
        warnings += gbuffer.rounded_positions(samples.position[has_lobe(samples).any(axis=0)], lights)
        left_to_cycles, of_points = None, PixelPoints()
        if job.for_finished:
            left_to_cycles = renders.left_to_cycles(film, shows_patches(samples, lights, manifest["sky_detail"]))
            of_points = renders.points()
        elif not problems:
            warnings += unlit(samples, lights, manifest["camera"]) + faceted(samples, lights, manifest["sky_detail"])
        times = (manifest[name] for name in ("seconds", "processor_seconds", "direct_seconds"))
        extraction = Extraction(
            lights=tuple(lights),
            samples=samples,
            film=film,
            picture=PictureFacts.of(manifest),
            cycles=renders.cycles_passes(folder),
            times=ExtractionTimes(*times),
            warnings=tuple(manifest["warnings"] + warnings),
            problems=tuple(problems),
            occluders=self._occluders,
            light_settings=manifest["light_settings"],
            glass=renders.glass,
            left_to_cycles=left_to_cycles,
            points=of_points,
        )
        if extraction.glass is not None and manifest["behind"]:
            extraction = replace(extraction, behind=_behind(job, manifest, folder, extraction))
        return extraction


def _behind(job: PixelJob, manifest: dict, folder: Path, extraction: Extraction) -> Extraction:
    """What is seen through the glass of `extraction`."""
    renders = _SampleRenders(job, {**manifest, "film_transparent": False}, is_behind=True)
    for name in manifest["behind"]:
        renders.add(rendered_channels(folder / BEHIND / name))
    samples, film = renders.joined()
    cycles = CyclesPasses(None, *renders.not_reflected())
    return ended_at_horizons(replace(extraction, samples=samples, film=film, cycles=cycles))


class _SampleRenders:
    """The sample renders of a picture, one for each point of a pixel, as `add` takes them."""

    def __init__(self, job: PixelJob, manifest: dict, *, is_behind: bool = False, where: np.ndarray | None = None):
        self._job, self._manifest, self._is_behind, self._where = job, manifest, is_behind, where
        self._glass: np.ndarray | float = 0.0  # (H, W) number of renders that show glass
        self._renders: list[tuple[SurfaceSamples, np.ndarray]] = []  # samples and their pixels
        self._unusable = self._unnamed = 0  # samples that are not shaded
        self._unshaded = np.zeros(len(manifest["unshaded"]), dtype=int)  # samples by entry of `unshaded`
        self._left_to_cycles: list[np.ndarray] = []  # bits (H, W) of each render
        self._rest: np.ndarray | float = 0.0  # (H, W, 7) sum over the renders of emission and background

    def add(self, channels: dict[str, np.ndarray]) -> None:
        """Take the `channels` of the next render."""
        gbuffer.clear_holdouts(channels)
        passes, through, tint = self._manifest["passes"], gbuffer.seen_through(channels), 1.0
        if through is not None:
            self._glass = self._glass + through.any(axis=-1)
        if self._is_behind:
            tint = through
            lobes.read_aov(channels, "hit")[~through.any(axis=-1)] = 0.0
        if self._job.for_finished:
            self._left_to_cycles.append(gbuffer.left_to_cycles(channels))
        self._unnamed += gbuffer.surfaces_without_sample(channels)
        self._unshaded += gbuffer.unshaded_hits(channels, len(self._unshaded))
        if self._where is not None:
            lobes.read_aov(channels, "hit")[~self._where] = 0.0
        samples, pixel, unusable = gbuffer.surface_samples(channels, passes["diffuse_color"])
        if self._is_behind:
            samples = gbuffer.tinted(samples, through.reshape(-1, 3)[pixel])
        self._renders.append((samples, pixel))
        self._unusable += unusable
        if self._job.rest:
            rest = gbuffer.not_reflected(channels, passes, self._manifest["film_transparent"])
            rest[..., :3], rest[..., 3:6] = rest[..., :3] * tint, rest[..., 3:6] * tint
            self._rest = self._rest + rest.astype(np.float64)

    @property
    def glass(self) -> np.ndarray | None:
        """`Extraction.glass`."""
        return self._glass / len(self._renders) if np.any(self._glass) else None

    def not_reflected(self) -> tuple[np.ndarray, np.ndarray]:
        """The emission and the background of `CyclesPasses`."""
        rest = self._rest / len(self._renders)
        return rest[..., :3], rest[..., 3:]

    def joined(self) -> tuple[SurfaceSamples, Film]:
        """Samples and film of all renders."""
        samples, film = gbuffer.join(self._renders, self._manifest["width"], self._manifest["height"])
        if self._manifest["weights"]:
            points = self.points()
            film = film.shared(points.weights, points.number, self._rendered_pixels())
        return samples, film

    def points(self) -> PixelPoints:
        """The points of the pixels, and the number of each sample's render among them."""
        number = np.repeat(np.arange(len(self._renders)), [len(pixel) for _, pixel in self._renders])
        weights = self._manifest["weights"]
        return PixelPoints(number, np.array(weights[: len(self._renders)]) if weights else None)

    def _rendered_pixels(self) -> np.ndarray:
        """Mask (H, W) of the pixels that were rendered."""
        mask, border = np.ones((self._manifest["height"], self._manifest["width"]), bool), self._manifest["border"]
        if border is not None and not border["cropped"]:
            rows, columns = (slice(border[a], border[a] + border[b]) for a, b in (("top", "height"), ("left", "width")))
            mask[:] = False
            mask[rows, columns] = True
        return mask if self._where is None else mask & self._where

    def messages(self, samples: SurfaceSamples, film: Film) -> tuple[list[str], list[str]]:
        """Warnings and problems. There is one problem if most of what the camera sees is not shaded."""
        if not self._renders:
            return [], []
        materials, camera, warnings = self._manifest["unshaded"], self._manifest["camera"], []
        shaded = len(samples) if film.first is None else int(film.first.sum())
        total = shaded + self._unusable + self._unnamed
        if self._unusable:
            what = "transparent surfaces in front of others, or not finite, or too far away"
            warnings.append(f"{100.0 * self._unusable / total:.3g} % of the samples are not shaded: {what}")
        if self._unnamed:
            what = "see a surface whose material could not be read: not shaded"
            warnings.append(f"{100.0 * self._unnamed / total:.3g} % of the samples {what}")
        of_samples = len(warnings)
        if self.glass is not None:
            shown = THROUGH_GLASS[bool(self._manifest["behind"])]
            warnings.append(f"{100.0 * self.glass.mean():.3g} % of the picture shows glass: {shown}")
        warnings += gbuffer.coarse_meshes(samples)
        lost = self._unusable + self._unnamed + int(self._unshaded.sum())
        if 2 * lost > total:
            reasons = [materials[number] for number in np.argsort(-self._unshaded, kind="stable")]
            reasons = reasons[: np.count_nonzero(self._unshaded)] + warnings[:of_samples]
            reasons = listed(reasons, REASONS, "; ")
            share = f"{100.0 * lost / total:.3g} %"
            return warnings, [f"{share} of what camera {camera!r} sees is not shaded: {reasons}"]
        for number in () if self._job.for_finished else np.argsort(-self._unshaded, kind="stable"):
            if (percent := 100.0 * self._unshaded[number] / total) > LEAST_PERCENT:
                warnings.append(f"{percent:.3g} % of the samples are not shaded: {materials[number]}")
        if len(samples) == 0:
            warnings.append(f"camera {camera!r} sees no surface that can be shaded")
        return warnings, []

    def left_to_cycles(self, film: Film, is_faceted: np.ndarray) -> LeftToCycles:
        """The pixels that take direct light from Cycles: those with a point that is not shaded as in Cycles."""
        manifest, none = self._manifest["left_to_cycles"], np.zeros((film.height, film.width), int)
        by_pass = {
            name: film.reached(sum((bits & bit for bits in self._left_to_cycles), none) > 0)
            for name, bit in lobes.KEPT_BITS.items()
        }
        by_pass["specular"] |= film.image(is_faceted) > 0.0
        materials = manifest["materials"] + ["sharp reflections of the world (specular)"] * bool(is_faceted.any())
        reasons = materials, manifest["everything"], manifest["warnings"]
        return LeftToCycles(by_pass, *map(tuple, reasons), self._where)

    def cycles_passes(self, folder: Path) -> CyclesPasses:
        """What Cycles rendered beside the samples."""
        manifest, emission, background, indices = self._manifest, None, None, {}
        if self._job.rest:
            emission, background = self.not_reflected()
        if self._job.indices:
            # The first render shows the centers of the pixels.
            channels = rendered_channels(folder / manifest["samples"][0])
            names = [manifest["passes"][key] for key in self._job.indices]
            indices = {name: lobes.read_layer(channels, name, "X") for name in names}
        return CyclesPasses(read_reference(manifest, folder), emission, background, indices)


def in_pixels(extraction: Extraction, where: np.ndarray) -> Extraction:
    """`extraction` of a finished picture with samples only in the pixels of the mask `where` (H, W); all others are
    left to Cycles."""
    samples, film, points, theirs = extraction.samples, extraction.film, extraction.points, extraction.left_to_cycles
    mask = where.ravel()[film.pixel]
    film, numbers = film.take(mask), points.number[mask]
    if points.weights is not None:
        film = film.unspread().shared(points.weights, numbers, np.isfinite(film.whole) & where)
    changed = {"points": replace(points, number=numbers), "left_to_cycles": replace(theirs, shaded=where)}
    return replace(extraction, samples=samples.take(mask), film=film, **changed)


def with_points(extraction: Extraction, count: int) -> Extraction:
    """`extraction` with the first `count` points of each pixel of a finished picture.

    One sample stands for all points of a pixel on the same smooth surface, and lobes take in how normals turn between
    points, but not with depth of field.
    """
    samples, film, points = extraction.samples, extraction.film, extraction.points
    if not extraction.picture.has_lens:
        samples = gbuffer.with_widened_lobes(samples, film, count)
    if count < film.sub_samples:
        mask = points.number < count
        samples, film = samples.take(mask), replace(film.take(mask), sub_samples=count)
        if points.weights is not None:
            is_rendered = np.isfinite(film.whole)
            film = film.unspread().shared(points.weights[:count], points.number[mask], is_rendered)
    # With depth of field the points of a pixel may be far from each other.
    if not extraction.picture.has_lens and len(samples):
        samples, film = gbuffer.merged(samples, film)
    return replace(extraction, samples=samples, film=film, points=PixelPoints())


def ended_at_horizons(extraction: Extraction, progress: Progress | None = None) -> Extraction:
    """`extraction` with lobes that end at the horizons of Cycles."""
    samples, film = extraction.samples, extraction.film
    hit = np.arange(len(samples)) if film.first is None else np.cumsum(film.first)
    samples, index = end_at_horizons_of_cycles(samples, extraction.lights, hit, is_quick=True, progress=progress)
    first = np.diff(index, prepend=-1) > 0
    if film.first is not None:
        first &= film.first[index]
    return replace(extraction, samples=samples, film=replace(film.take(index), first=None if first.all() else first))


def unlit(samples: SurfaceSamples, lights: tuple[Light, ...], camera: str) -> list[str]:
    """The warning about lights that reach nothing that the camera sees; [] if there are none."""
    if not has_lobe(samples).any():
        return [f"nothing that camera {camera!r} sees reflects light: the picture is black"] if len(samples) else []
    unseen = lights_that_reach_nothing(samples, lights)
    if unseen and len(unseen) == len({light.name for light in lights}):
        return [f"no light reaches what camera {camera!r} sees: the picture is black; turn or move a light"]
    return [f"nothing that camera {camera!r} sees is lit by {listed(map(repr, unseen))}"] if unseen else []


def faceted(samples: SurfaceSamples, lights: tuple[Light, ...], sky_detail: float) -> list[str]:
    """The warning about reflections so sharp that they show the patches of a world; [] if there are none."""
    sharp = shows_patches(samples, lights, sky_detail)
    if not sharp.any():
        return []
    sky = next(light for light in lights if light.is_distant and light.children and light.affects_specular)
    return [
        f"world {sky.name!r}: it is blurred by a degree or more in reflections sharper than roughness "
        f"{SHARP_REFLECTION:g}, which {100.0 * sharp.mean():.3g} % of the samples have, and in facets in reference; a "
        f"blur of {math.degrees(DETAIL_ANGLE):.0f} degrees changes it by {100.0 * sky_detail:.2g} % on average"
    ]


def shows_patches(samples: SurfaceSamples, lights: tuple[Light, ...], sky_detail: float) -> np.ndarray:
    """Mask (P,) of the samples whose reflections are so sharp that they show the patches of a world with detail."""
    if sky_detail <= SMOOTH_SKY or not any(
        light.is_distant and light.children and light.affects_specular for light in lights
    ):
        return np.zeros(len(samples), bool)
    return has_lobe(samples)[1] & (samples.roughness < SHARP_REFLECTION)


def read_reference(manifest: dict, folder: Path) -> dict[str, np.ndarray] | None:
    """`CyclesPasses.reference`: each half is the mean of its chunks, weighted by their samples; None without one."""
    if manifest["reference"] is None:
        return None
    passes = manifest["passes"]
    shape = (2, manifest["height"], manifest["width"], 3)
    sums = {"specular": np.zeros(shape), "diffuse": np.zeros(shape)}
    for half, chunks in enumerate(manifest["reference"]):
        total = sum(count for _, count in chunks)
        for name, count in chunks:
            channels = rendered_channels(folder / name)
            for lobe, image in sums.items():
                light = lobes.read_layer(channels, passes[f"{lobe}_light"], "RGB").astype(np.float64)
                image[half] += count / total * light * lobes.read_layer(channels, passes[f"{lobe}_color"], "RGB")
    return {lobe: (manifest["exposure"] * image).astype(np.float32) for lobe, image in sums.items()}


def rendered_channels(path: Path) -> dict[str, np.ndarray]:
    """The channels of an EXR by Blender. Raises OSError if it is incomplete, which Blender does not report."""
    try:
        return read_channels(path)
    except ValueError as error:
        raise OSError(errno.ENOSPC, "a picture was not written whole") from error
