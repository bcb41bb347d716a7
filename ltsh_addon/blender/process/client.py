"""What is asked of the second Blender, and how its files become samples, lights and pictures. Imports no bpy."""

from __future__ import annotations

import errno
import importlib.metadata
import re
import sys
from collections.abc import Callable
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path

import numpy as np

from ...cycles import gbuffer, lobes
from ...cycles.horizons import end_at_horizons_of_cycles
from ...files import replacing_by_copy, temporary_folder
from ...imaging.color import identified
from ...imaging.exr import read_channels
from ...reading import check_name
from ...scene import (
    REC709,
    AreaLight,
    Border,
    ColorSpace,
    Film,
    Progress,
    SceneError,
    SurfaceSamples,
    lights_of,
    listed,
)
from ...shading.light_polygons import has_lobe, lights_that_reach_nothing
from ...visibility import Occluders
from .blender_process import run_child


@dataclass(frozen=True)
class ExtractOptions:
    """What to take from which file. `cycles_samples` 0 means no Cycles reference; None means as in the file."""

    scene: Path
    width: int | None = None
    height: int | None = None
    sub_samples: int = 1
    cycles_samples: int = 0
    frame: int | None = None
    camera: str | None = None
    scene_name: str | None = None
    view_layer: str | None = None
    scripts: bool = False  # run those of the file
    rest: bool = False  # also the parts of the picture that are not reflected light
    indices: tuple[str, ...] = ()  # of passes as "object_index", see `render_settings.pass_names`
    shadows: str = "off"  # "on": also what stands in the way of light, which then does so in the Cycles reference
    for_finished: bool = False  # also tell what a finished picture leaves to Cycles; there need be no light
    edge_points: int = 0  # of a pixel of a finished picture that an edge runs through
    seconds: float | None = None  # of processor time for the whole picture, which limits its sub-samples


@dataclass(frozen=True)
class KeptByCycles:
    """Of a finished picture: where direct light is Cycles' own, and why."""

    by_pass: dict[str, np.ndarray]  # (H, W) bool
    materials: tuple[str, ...]
    everything: tuple[str, ...]  # why all of it is
    warnings: tuple[str, ...]  # about what is shaded in place of it


def too_small(budget: float) -> str:
    """Why a finished picture leaves everything to Cycles."""
    return f"the budget is too small for it, {budget:g} s"


TOO_THIN = "highlights are thinner than pixels almost everywhere, of which Cycles tells more in the time of the budget"

# Materials, or other reasons, that an error names.
REASONS = 5
# Smoother surfaces show the patches of a world.
SHARP_REFLECTION = 0.2
# Fields of `Extraction` that are those of the manifest.
UNCHANGED = (
    "blender_version", "frame", "camera", "seconds", "exposure", "pixel_aspect", "pixel_filter", "light_settings",
    "has_lens",
)  # fmt: skip


@dataclass(frozen=True)
class Extraction:
    """What the child found and rendered.

    `reference` maps "specular" and "diffuse" to (2, H, W, 3) float32, the halves A and B, row 0 on top, in W m^-2
    sr^-1 times `exposure`, the film exposure of the scene, by which all radiance of a render is multiplied;
    `seconds` has "start", "samples" and "cycles". `border` is None where the whole picture was rendered; pixels are
    `pixel_aspect` times as wide as high. Sub-samples are drawn from the scene's `pixel_filter`. All colors, those
    of the lights included, are in `color_space`. `emission` (H, W, 3) is what surfaces and lights in sight emit, and
    `background` (H, W, 4) what of the world is seen behind them, with the alpha of the picture, both without the
    exposure; None where they were not asked for. `indices` (H, W) are passes of what the first sub-samples see, by
    Cycles' names. `problems` say why most of the picture is not shaded. `occluders` are what stands in the way of
    light, around `origin` (3,) in m; None without shadows. `light_settings` are power, exposure, red, green and blue
    of light objects as Blender has them.
    """

    lights: tuple[AreaLight, ...]
    samples: SurfaceSamples
    film: Film
    warnings: tuple[str, ...]
    reference: dict[str, np.ndarray] | None
    blender_version: str
    frame: int
    camera: str
    seconds: dict[str, float]
    exposure: float = 1.0
    border: Border | None = None
    pixel_aspect: float = 1.0
    pixel_filter: str = "BOX"
    color_space: ColorSpace = REC709
    emission: np.ndarray | None = None
    background: np.ndarray | None = None
    indices: dict[str, np.ndarray] = field(default_factory=dict)
    problems: tuple[str, ...] = ()
    occluders: Occluders | None = None
    kept: KeptByCycles | None = None
    origin: np.ndarray = field(default_factory=lambda: np.zeros(3))
    light_settings: dict[str, list[float]] = field(default_factory=dict)
    processor_seconds: float = 0.0  # of the child
    direct_seconds: float = 0.0  # of these what came after the file was open
    has_lens: bool = False  # depth of field: samples are seen through different points of the lens
    # Of a finished picture, for `with_points`: which point of its pixel each sample (P,) is, and of points the weights
    # (N, D, D) as of `Film.shared`.
    point: np.ndarray | None = None
    weights: np.ndarray | None = None
    finer: gbuffer.FinerPoints | None = None  # of pixels at edges, around `origin`

    @property
    def rest(self) -> np.ndarray | None:
        """The part of the picture (H, W, 4) that is not reflected light (emission, lights in sight, world), exposed.

        With all reflected light it is the picture that Cycles makes of the file. None where it was not asked for.
        """
        if self.background is None:
            return None
        light = self.exposure * (self.emission + self.background[..., :3])
        return np.concatenate([light, self.background[..., 3:]], axis=-1)


def extract(options: ExtractOptions, *, progress: Progress | None = None) -> Extraction:
    """Lights, samples and (if asked for) the Cycles reference of a .blend.

    Raises SceneError when the scene or file is not fit, Cancelled when `progress(stage, fraction)` returned False.
    """
    if options.sub_samples < 1 or options.cycles_samples < 0:
        raise ValueError(
            f"sub_samples is {options.sub_samples} and cycles_samples {options.cycles_samples}, "
            "expected at least 1 and 0"
        )
    scene = Path(options.scene).absolute()
    check_readable(scene)
    with temporary_folder() as folder:
        manifest = run_child({"task": "extract", **asdict(options), "scene": str(scene)}, folder, progress)
        bits, rest = [], _Mean()

        def look(channels: dict[str, np.ndarray]) -> None:
            if options.for_finished:
                bits.append(gbuffer.kept_by_cycles(channels))
            if options.rest:
                rest.add(gbuffer.not_reflected(channels, manifest["passes"], manifest["film_transparent"]))

        samples, film, point, warnings, problems = _read_samples(manifest, folder, look)
        lights = lights_of(manifest["lights"])
        warnings += gbuffer.rounded_positions(samples.position[has_lobe(samples).any(axis=0)], lights)
        if not problems and not options.for_finished:
            warnings += unlit(samples, lights, manifest["camera"])
            warnings += faceted(samples, lights)
        kept = _kept(manifest, bits, film, shows_patches(samples, lights)) if options.for_finished else None
        # In the file, where double precision tells positions apart.
        samples = replace(samples, position=samples.position + manifest["origin"])
        lights = tuple(light.moved(np.array(manifest["origin"])) for light in lights)
        found = Extraction(
            lights=lights,
            samples=samples,
            film=film,
            warnings=tuple(manifest["warnings"] + warnings),
            problems=tuple(problems),
            reference=read_reference(manifest, folder),
            border=None if manifest["border"] is None else Border(**manifest["border"]),
            color_space=identified(manifest["color_space"]["to_rec709"], manifest["color_space"]["name"]),
            emission=rest.value[..., :3] if options.rest else None,
            background=rest.value[..., 3:] if options.rest else None,
            indices=_read_indices(options.indices, manifest, folder),
            kept=kept,
            occluders=Occluders.load(folder / manifest["occluders"]) if manifest["occluders"] else None,
            origin=np.array(manifest["origin"]),
            finer=gbuffer.FinerPoints.of(manifest["finer"]) if manifest.get("finer") else None,
            **{name: manifest[name] for name in UNCHANGED},
            processor_seconds=manifest["processor_seconds"],
            direct_seconds=manifest["direct_seconds"],
            point=point if options.for_finished else None,
            weights=np.array(manifest["weights"]) if manifest["weights"] else None,
        )
        return found if options.for_finished else ended(found)


def build_demo(path: Path, *, progress: Progress | None = None) -> None:
    """Build the example scene and save it as the .blend `path`, at once or not at all. Raises SceneError, OSError."""
    with replacing_by_copy(Path(path).absolute()) as unfinished, temporary_folder() as folder:
        run_child({"task": "demo", "path": str(unfinished)}, folder, progress)


def with_points(extraction: Extraction, count: int) -> Extraction:
    """The first `count` points of each pixel of a finished picture, of which one stands for all on a smooth surface."""
    samples, film = extraction.samples, extraction.film
    if count < film.sub_samples:
        kept = extraction.point < count
        samples, film = samples.take(kept), replace(film.take(kept), sub_samples=count)
        if extraction.weights is not None:
            seen = np.isfinite(film.whole)
            film = film.unspread().shared(extraction.weights[:count], extraction.point[kept], seen)
    # Points of a blurred pixel may be far from each other.
    if not extraction.has_lens and len(samples):
        samples, film = gbuffer.merged(samples, film)
    finer = extraction.finer
    if finer is not None and extraction.weights is not None:
        finer = replace(finer, sums=extraction.weights[:count].sum(axis=0))
    return replace(extraction, samples=samples, film=film, finer=finer, point=None, weights=None)


def ended(extraction: Extraction) -> Extraction:
    """The same with samples ended at the horizons of Cycles."""
    samples, film = extraction.samples, extraction.film
    hit = np.arange(len(samples)) if film.first is None else np.cumsum(film.first)
    is_quick = extraction.kept is not None
    samples, index = end_at_horizons_of_cycles(samples, extraction.lights, hit, is_quick=is_quick)
    first = np.diff(index, prepend=-1) > 0
    if film.first is not None:
        first &= film.first[index]
    return replace(extraction, samples=samples, film=replace(film.take(index), first=None if first.all() else first))


def _read_samples(
    manifest: dict, folder: Path, look: Callable[[dict[str, np.ndarray]], None]
) -> tuple[SurfaceSamples, Film, np.ndarray, list[str], list[str]]:
    """Samples and film of all sample renders, the number of the render of each sample, warnings, and the problem where
    most of what is seen is not shaded; `look` gets the channels of each render."""
    width, height = manifest["width"], manifest["height"]
    materials = manifest["unshaded"]
    renders, unusable, unnamed, unshaded = [], 0, 0, np.zeros(len(materials), dtype=int)
    for name in manifest["samples"]:
        channels = _rendered(folder / name)
        gbuffer.clear_holdouts(channels)
        samples, pixel, bad = gbuffer.surface_samples(channels, manifest["passes"]["diffuse_color"])
        renders.append((samples, pixel))
        unusable += bad
        unnamed += gbuffer.surfaces_without_sample(channels)
        unshaded += gbuffer.unshaded_hits(channels, len(materials))
        look(channels)
    samples, film = gbuffer.join(renders, width, height)
    numbers = np.repeat(np.arange(len(renders)), [len(pixel) for _, pixel in renders])
    if manifest["weights"]:
        film = film.shared(np.array(manifest["weights"]), numbers, _rendered_pixels(manifest))
    if not renders:
        return samples, film, numbers, [], []
    warnings = []
    if unusable:
        what = "transparent surfaces in front of others, or not finite, or too far away"
        warnings.append(f"{unusable} samples are not shaded: {what}")
    if unnamed:
        warnings.append(f"{unnamed} samples see a surface whose material could not be read: not shaded")
    warnings += gbuffer.coarse_meshes(samples)
    shaded = len(samples) if film.first is None else int(film.first.sum())
    seen, lost = shaded + unusable + unnamed, unusable + unnamed + int(unshaded.sum())
    if 2 * lost > seen:
        share, camera = f"{100.0 * lost / seen:.3g} %", manifest["camera"]
        reasons = [materials[number] for number in np.argsort(-unshaded, kind="stable") if unshaded[number]]
        reasons = listed([*reasons, *warnings[: (unusable > 0) + (unnamed > 0)]], REASONS, "; ")
        return samples, film, numbers, warnings, [f"{share} of what camera {camera!r} sees is not shaded: {reasons}"]
    if len(samples) == 0:
        warnings.append(f"camera {manifest['camera']!r} sees no surface that can be shaded")
    return samples, film, numbers, warnings, []


def _rendered_pixels(manifest: dict) -> np.ndarray:
    """Mask (H, W)."""
    seen, border = np.ones((manifest["height"], manifest["width"]), bool), manifest["border"]
    if border is not None and not border["cropped"]:
        rows, columns = (slice(border[a], border[a] + border[b]) for a, b in (("top", "height"), ("left", "width")))
        seen[:] = False
        seen[rows, columns] = True
    return seen


def unlit(samples: SurfaceSamples, lights: tuple[AreaLight, ...], camera: str) -> list[str]:
    """The warning about lights that reach nothing of what the camera sees."""
    if not has_lobe(samples).any():
        return [f"nothing that camera {camera!r} sees reflects light: the picture is black"] if len(samples) else []
    unseen = lights_that_reach_nothing(samples, lights)
    if unseen and len(unseen) == len({light.name for light in lights}):
        return [f"no light reaches what camera {camera!r} sees: the picture is black; turn or move a light"]
    return [f"nothing that camera {camera!r} sees is lit by {listed(map(repr, unseen))}"] if unseen else []


def faceted(samples: SurfaceSamples, lights: tuple[AreaLight, ...]) -> list[str]:
    """The warning about reflections so sharp that they show how coarse a world is shaded."""
    sharp = shows_patches(samples, lights)
    if not sharp.any():
        return []
    sky = next(light for light in lights if light.is_distant and light.detail and light.affects_specular)
    return [
        f"world {sky.name!r}: it is blurred by a degree or more in reflections sharper than roughness "
        f"{SHARP_REFLECTION:g}, which {100.0 * sharp.mean():.2g} % of the samples have, and in facets in reference"
    ]


def shows_patches(samples: SurfaceSamples, lights: tuple[AreaLight, ...]) -> np.ndarray:
    """Mask (P,) of the samples with reflections so sharp that they show the patches of a world."""
    if not any(light.is_distant and light.detail and light.affects_specular for light in lights):
        return np.zeros(len(samples), bool)
    return has_lobe(samples)[1] & (samples.roughness < SHARP_REFLECTION)


class _Mean:
    """The mean of arrays of which one is there at a time."""

    def __init__(self):
        self._sum, self._count = 0.0, 0

    def add(self, values: np.ndarray) -> None:
        self._sum, self._count = self._sum + values.astype(np.float64), self._count + 1

    @property
    def value(self) -> np.ndarray:
        return self._sum / self._count


def _read_indices(keys: tuple[str, ...], manifest: dict, folder: Path) -> dict[str, np.ndarray]:
    """Passes (H, W) of the first sample render, which sees the centers of pixels, by their names."""
    if not keys:
        return {}
    channels = _rendered(folder / manifest["samples"][0])
    names = [manifest["passes"][key] for key in keys]
    return {name: lobes.read_layer(channels, name, "X") for name in names}


def _kept(manifest: dict, bits: list[np.ndarray], film: Film, is_faceted: np.ndarray) -> KeptByCycles:
    """Where finished pictures leave direct light to Cycles: where some point of a pixel is not shaded as there."""
    found = manifest["kept"]
    by_pass = {
        name: film.reached(sum((number & bit for number in bits), np.zeros((film.height, film.width), int)) > 0)
        for name, bit in lobes.KEPT_BITS.items()
    }
    by_pass["specular"] |= film.image(is_faceted) > 0.0
    materials = found["materials"] + ["sharp reflections of the world (specular)"] * bool(is_faceted.any())
    return KeptByCycles(by_pass, *map(tuple, (materials, found["everything"], found["warnings"])))


def read_reference(manifest: dict, folder: Path) -> dict[str, np.ndarray] | None:
    """The two halves, each the mean of its chunks weighted by their samples, times the exposure."""
    if manifest["reference"] is None:
        return None
    passes = manifest["passes"]
    shape = (2, manifest["height"], manifest["width"], 3)
    sums = {"specular": np.zeros(shape), "diffuse": np.zeros(shape)}
    for half, chunks in enumerate(manifest["reference"]):
        total = sum(count for _, count in chunks)
        for name, count in chunks:
            channels = _rendered(folder / name)
            for lobe, image in sums.items():
                light = lobes.read_layer(channels, passes[f"{lobe}_light"], "RGB").astype(np.float64)
                image[half] += count / total * light * lobes.read_layer(channels, passes[f"{lobe}_color"], "RGB")
    return {lobe: (manifest["exposure"] * image).astype(np.float32) for lobe, image in sums.items()}


def _rendered(path: Path) -> dict[str, np.ndarray]:
    """The channels of a picture that Blender rendered. Raises OSError where it is not whole: Blender is silent then."""
    try:
        return read_channels(path)
    except ValueError as error:
        raise OSError(errno.ENOSPC, "a picture was not written whole") from error


@dataclass(frozen=True)
class FinishedJob:
    """What Cycles is to render of which file, untouched; None means as in the file."""

    scene: Path
    frame: int | None
    camera: str | None
    scene_name: str | None
    view_layer: str | None
    width: int | None
    height: int | None
    cycles_samples: int | None
    seconds: float | None  # of processor time, in place of samples
    scripts: bool = False  # run those of the file
    edges: bool = True  # what shines in sight also apart, with few jagged edges


@dataclass(frozen=True)
class CyclesPicture:
    """What Cycles has rendered, row 0 on top: channels (H, W) by name, without the name of the view layer."""

    channels: dict[str, np.ndarray]
    guides: dict[str, np.ndarray]  # for the denoiser
    names: dict[str, str]  # of passes, as `pass_names` has them
    samples: int
    shining: dict[str, np.ndarray]  # (H, W, 3) what shines in sight, by the key of its pass, with few jagged edges
    everything: tuple[str, ...]  # why all direct light is to be that of Cycles
    warnings: tuple[str, ...]
    camera: str
    frame: int
    processor_seconds: float
    least_seconds: float  # of these what no picture of the scene takes less than


def render_finished(job: FinishedJob, folder: Path, *, progress: Progress | None = None) -> CyclesPicture:
    """The scene as Cycles renders it. Raises as `extract` does."""
    scene = Path(job.scene).absolute()
    check_readable(scene)
    manifest = run_child({"task": "finished", **asdict(job), "scene": str(scene)}, folder, progress)
    channels = _mean_of_chunks(manifest, folder)
    guides = {name: plane for name, plane in channels.items() if name.startswith("Denoising ")}
    samples = sum(count for _, count in manifest["files"])
    dropped = tuple(f"{name}." for name in manifest["dropped"])
    return CyclesPicture(
        channels={name: plane for name, plane in channels.items() if not name.startswith(dropped)},
        guides=guides,
        names=manifest["passes"],
        samples=samples,
        shining=_shining(manifest, folder, channels, samples),
        everything=tuple(manifest["everything"]),
        warnings=tuple(manifest["warnings"]),
        camera=manifest["camera"],
        frame=manifest["frame"],
        processor_seconds=manifest["processor_seconds"],
        least_seconds=manifest["least_seconds"],
    )


def _shining(manifest: dict, folder: Path, channels: dict[str, np.ndarray], samples: int) -> dict[str, np.ndarray]:
    """The means of the samples of the whole scene and of those that show nothing else, {} without the latter."""
    if manifest["edges"] is None:
        return {}
    name, most = manifest["edges"]
    prefix = f"{manifest['layer']}."
    found = {key.removeprefix(prefix): plane for key, plane in _rendered(folder / name).items()}
    count = most * found["Debug Sample Count.X"][..., None]
    names = {key: manifest["passes"][key] for key in ("emission", "background")}
    if manifest["film_transparent"]:
        del names["background"]
    own, other = ({key: lobes.read_layer(one, name, "RGB") for key, name in names.items()} for one in (found, channels))
    return {key: (count * own[key] + samples * other[key]) / (count + samples) for key in names}


def _mean_of_chunks(manifest: dict, folder: Path) -> dict[str, np.ndarray]:
    """The channels: of light the mean over all chunks, of all else those of the largest one."""
    files = sorted(manifest["files"], key=lambda item: -item[1])
    total, prefix, channels = sum(count for _, count in files), f"{manifest['layer']}.", {}
    for name, count in files:
        read = {key.removeprefix(prefix): plane for key, plane in _rendered(folder / name).items()}
        if not channels:
            channels = read
            light = [key for key in read if key[-2:] in (".R", ".G", ".B", ".A") or key.startswith("Denoising ")]
            if len(files) > 1:
                channels |= {key: count / total * read[key] for key in light}
        else:
            for key in light:
                channels[key] += count / total * read[key]
    return channels


PICTURE = "picture.npy"


def show_finished(scene: Path, where: tuple, folder: Path, name: str, *, progress: Progress | None = None) -> None:
    """Write `PICTURE` of `folder` (H, W, 4) as the PNG `name` there, through the view transform of a scene of the file
    at a frame, `where` (None: those of the file)."""
    job = {"task": "show", "scene": str(Path(scene).absolute()), "pixels": str(folder / PICTURE), "name": name}
    run_child({**job, "scene_name": where[0], "frame": where[1]}, folder, progress)


@dataclass(frozen=True)
class BakeJob:
    """What to take from which file for a bake; None means as in the file."""

    scene: Path
    objects: tuple[str, ...] | str  # names, "selected" or "all"
    uv: str | None
    width: int
    height: int
    block_rows: int
    view: tuple[float, float, float] | str  # a position, "camera" or "above"
    camera: str | None
    frame: int | None
    cycles_samples: int
    passes: tuple[str, ...]  # of Cycles
    finished: tuple[tuple[str, int], ...] = ()  # (object, tile): of these no maps are needed
    look_up_images: bool = True  # False: everything that varies is a map
    following: tuple[str, ...] = ()  # objects that jobs after this one will want of the same file
    scripts: bool = False  # run those of the file
    tile: int | None = None  # the UDIM tile that is wanted, None for all
    sub_samples: int = 1  # points of a texel that the maps are wanted for
    shadows: str = "off"  # as of `ExtractOptions`


def extract_bake(job: BakeJob, folder: Path, *, progress: Progress | None = None) -> dict:
    """Meshes, materials, maps and Cycles' bake of a .blend as files in `folder`; the manifest.

    Raises as `extract` does.
    """
    scene = Path(job.scene).absolute()
    check_readable(scene)
    return run_child({"task": "bake", **asdict(job), "scene": str(scene)}, folder, progress)


# What a view is drawn as, the file of the first, and what the child says before it asks for a graphics card: a machine
# without one may end it.
VIEW_PASSES = ("combined", "specular", "diffuse")
VIEW_PNG = "view.png"
GRAPHICS = "graphics"
NO_GRAPHICS = (
    "Blender finds no graphics card here, nor a program in its place: install OpenGL (on Linux libegl1 and "
    "libgl1-mesa-dri draw without a card), or use shade, which needs none"
)


@dataclass(frozen=True)
class ViewJob:
    """What to draw as the viewport does; None means as in the file."""

    scene: Path
    techniques: tuple[str, ...]  # names or absolute paths of tables
    refine: int
    width: int | None
    height: int | None
    frame: int | None
    camera: str | None
    shadows: str  # "on" or "off"
    shadow_rays: int  # of a light and a pixel
    scripts: bool = False  # run those of the file


def draw_view(job: ViewJob, folder: Path, *, progress: Progress | None = None) -> dict:
    """Pictures of a .blend as files in `folder`: "<number of the technique>_<pass>.npy", RGBA with row 0 on top, times
    the exposure, and `VIEW_PNG`; the manifest.

    Raises as `extract` does.
    """
    scene, stages = Path(job.scene).absolute(), [""]
    check_readable(scene)

    def watched(stage: str, fraction: float) -> bool | None:
        stages.append(stage)
        return None if progress is None else progress(stage, fraction)

    try:
        return run_child({"task": "view", **asdict(job), "scene": str(scene)}, folder, watched)
    except SceneError as error:
        if stages[-1] == GRAPHICS:
            raise SceneError(NO_GRAPHICS) from error
        raise


@dataclass(frozen=True)
class SeenWorld:
    """A world as Cycles renders it."""

    light: np.ndarray  # (6, N, N, 3), see `cycles.environment.CUBE`; empty where it gives none
    lights: tuple[AreaLight, ...]  # what is small and bright in it
    background: np.ndarray  # (M, M, 3), see `viewport.sky`
    warnings: list[str]


def look_at_world(path: Path, world: str, frame: int, folder: Path, progress: Progress | None = None) -> SeenWorld:
    """The `world` of this name in the .blend `path`, at a frame; files go to `folder`. Raises as `extract` does."""
    found = run_child({"task": "world", "path": str(path), "world": world, "frame": frame}, folder, progress)
    light, background = (np.load(folder / f"{name}.npy") for name in ("light", "background"))
    return SeenWorld(light, tuple(AreaLight(**one) for one in found["lights"]), background, found["warnings"])


LAMPS = "look at lights"  # a stage, whose fraction says of how many there are files


@dataclass(frozen=True)
class UnseenLamp:
    """The data of a light in a .blend at whose nodes Cycles is to look, and fields of its `UnseenLight`."""

    path: str
    name: str
    matrix: list  # (4, 4)
    flags: dict
    facts: dict


def look_at_lamps(lamps: list[UnseenLamp], frame: int, folder: Path, take: Callable[..., bool]) -> None:
    """What Cycles sees of the nodes of `lamps` at a frame, as `lights.textures.SeenNodes` has it:
    `take(number, factor, lost)` one after another, until it says no. Files go to `folder`. Raises as `extract` does."""

    def watched(stage: str, fraction: float) -> bool | None:
        number = round(fraction * len(lamps)) - 1
        if stage != LAMPS:
            return None
        return take(number, np.load(folder / f"{number}.npy"), np.load(folder / f"{number}_lost.npy").item())

    run_child({"task": "lamps", "lamps": [asdict(lamp) for lamp in lamps], "frame": frame}, folder, watched)


def apply_bake(scene: Path, path: Path, textures: list[dict], *, progress: Progress | None = None) -> list[str]:
    """Save a copy of `scene` as the .blend `path` in which objects show baked textures; the warnings.

    Each of `textures` has "object", "uv", "name" and "files", a list of {"path", "tile"}. The copy appears complete or
    not at all. Raises as `extract` does.
    """
    with replacing_by_copy(Path(path).absolute()) as unfinished, temporary_folder() as folder:
        job = {"task": "apply", "scene": str(Path(scene).absolute()), "path": str(unfinished), "textures": textures}
        return run_child(job, folder, progress)["warnings"]


def scene_facts(
    scene: Path, frames, objects, uv=None, *, scripts: bool = False, progress: Progress | None = None
) -> list[dict]:
    """For each of `frames` (None: the file's own) "frame", "camera" (name or None), names of "objects" to bake, and
    "tiles", the UDIM tiles by name of those of which each can be a task of its own.

    `objects` are names, "selected", "all", or None for none; `uv` is a UV map, None for the active ones;
    `scripts` of the file run only if asked for. Raises as `extract` does.
    """
    scene = Path(scene).absolute()
    check_readable(scene)
    job = {"task": "facts", "scene": str(scene), "frames": list(frames), "objects": objects, "uv": uv}
    job["scripts"] = scripts
    with temporary_folder() as folder:
        return run_child(job, folder, progress)["facts"]


# What a .blend starts with: as it is, or compressed by Blender since 3.0 and before.
STARTS = (b"BLENDER", b"\x28\xb5\x2f\xfd", b"\x1f\x8b")
# Pointers, byte order and version, since 5.0 with the size of the header and the version of the format before.
_HEADER = re.compile(rb"BLENDER(?:[-_][vV](\d{3})|\d\d-\d\dv(\d{4}))")
_HEADER_BYTES = 17

Version = tuple[int, int]


def check_readable(scene: Path) -> None:
    """Raise SceneError where a look at the file says enough, so that Blender need not start."""
    try:
        check_name(scene)
        if not scene.exists():
            raise SceneError(f"{scene}: no such file, expected a .blend")
        if scene.is_dir():
            raise SceneError(f"{scene}: is a folder, expected a .blend")
        if not scene.is_file():  # reading a pipe or a device might never end
            raise SceneError(f"{scene}: is a device or a pipe, expected a .blend")
        with scene.open("rb") as file:
            start = file.read(_HEADER_BYTES)
    except (OSError, ValueError) as error:  # ValueError: a name with a NUL
        reason = getattr(error, "strerror", None) or error
        raise SceneError(f"{str(scene)[:200]!r}: cannot be read: {reason}") from None
    if not start:
        raise SceneError(f"{scene}: the file is empty, expected a .blend")
    if not start.startswith(STARTS):
        raise SceneError(f"{scene}: is no .blend, it starts with {start[:7]!r}")
    saved, here = saved_with(start), running()
    if saved and here and saved > here:
        raise SceneError(newer(scene, saved, here))


def saved_with(start: bytes) -> Version | None:
    """Major and minor version of the Blender that saved a file with this start; None where it is compressed."""
    match = _HEADER.match(start)
    return divmod(int(match[1] or match[2]), 100) if match else None


def running() -> Version | None:
    """Major and minor version of the Blender that will open files; None where there is none."""
    bpy = sys.modules.get("bpy")
    if bpy is not None:
        return tuple(bpy.app.version[:2])
    try:
        found = importlib.metadata.version("bpy")
    except importlib.metadata.PackageNotFoundError:
        return None
    return tuple(int(part) for part in found.split(".")[:2])


def newer(path: Path, saved: Version, here: Version) -> str:
    """Error text for a file that was `saved` by a newer Blender than the one that is `here`."""
    saved, here = (".".join(map(str, version)) for version in (saved, here))
    return (
        f"{path}: was saved by Blender {saved}, but this is Blender {here}, which may miss parts of it: use Blender "
        f"{saved}, or save the file with {here}"
    )
