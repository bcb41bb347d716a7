"""The jobs of the second Blender, and how its files become samples, lights and pictures. Imports no bpy."""

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
from ...emitters.light_polygons import has_lobe, lights_that_reach_nothing
from ...files import replacing_by_copy, temporary_folder
from ...imaging.color import identified
from ...imaging.exr import read_channels
from ...reading import check_name
from ...scene import (
    REC709,
    Border,
    ColorSpace,
    Film,
    Light,
    Progress,
    SceneError,
    SurfaceSamples,
    light_of,
    lights_of,
    listed,
)
from ...visibility import Occluders
from .blender_process import run_child


@dataclass(frozen=True)
class ExtractOptions:
    """What to extract from which file. `cycles_samples` 0 means no Cycles reference; None means as in the file."""

    scene: Path
    width: int | None = None
    height: int | None = None
    sub_samples: int = 1
    cycles_samples: int = 0
    frame: int | None = None
    camera: str | None = None
    scene_name: str | None = None
    view_layer: str | None = None
    scripts: bool = False  # run the scripts in the file
    rest: bool = False  # also the parts of the picture that are not reflected light
    indices: tuple[str, ...] = ()  # keys of index passes, such as "object_index"; see `render_settings.pass_names`
    shadows: str = "off"  # "on": also the occluders, which then block light in the Cycles reference, too
    for_finished: bool = False  # also what a finished picture leaves to Cycles; no light is needed
    edge_points: int = 0  # points of a pixel of a finished picture that has an edge
    seconds: float | None = None  # processor time for the whole picture, which limits its sub-samples
    reserve: float = 0.0  # the seconds of it that each pixel takes last, for denoising


@dataclass(frozen=True)
class LeftToCycles:
    """Where a finished picture takes direct light from Cycles, and why."""

    by_pass: dict[str, np.ndarray]  # masks (H, W)
    materials: tuple[str, ...]  # materials for which it does
    everything: tuple[str, ...]  # reasons why it does everywhere
    warnings: tuple[str, ...]  # about direct light that is shaded here


def too_small(budget: float) -> str:
    """The reason why a `budget` in seconds leaves all direct light to Cycles."""
    return f"the budget is too small for it, {budget:g} s"


TOO_THIN = "highlights are thinner than pixels almost everywhere, of which Cycles tells more in the time of the budget"

# REASONS: how many materials, or other reasons, an error names.
REASONS = 5
# SHARP_REFLECTION: surfaces of a smaller roughness show the patches of a world.
SHARP_REFLECTION = 0.2
# UNCHANGED: fields of `Extraction` that are copied from the manifest.
UNCHANGED = (
    "blender_version", "frame", "camera", "seconds", "exposure", "pixel_aspect", "pixel_filter", "light_settings",
    "has_lens",
)  # fmt: skip


@dataclass(frozen=True)
class Extraction:
    """What the child found and rendered.

    - `exposure` is the film exposure of the scene, by which all radiance of a render is multiplied.
    - `reference` maps "specular" and "diffuse" to (2, H, W, 3) float32: the halves A and B, row 0 on top, in
      W m^-2 sr^-1 times `exposure`.
    - `seconds` has "start", "samples" and "cycles".
    - `border` is None if the whole picture was rendered. Pixels are `pixel_aspect` times as wide as high.
    - Sub-samples are drawn from the scene's `pixel_filter`.
    - All colors, those of the lights included, are in `color_space`.
    - `emission` (H, W, 3) is the emission of surfaces and lights in sight. `background` (H, W, 4) is the world seen
      behind them, with the alpha of the picture. Both are without the exposure, and None if not asked for.
    - `indices` are passes (H, W) of the first sub-sample, by Cycles' names.
    - `problems` say why most of the picture is not shaded.
    - `occluders` block light; their positions are relative to `origin` (3,) in m. None without shadows.
    - `light_settings` are power, exposure, red, green and blue of light objects in Blender.
    """

    lights: tuple[Light, ...]
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
    left_to_cycles: LeftToCycles | None = None
    origin: np.ndarray = field(default_factory=lambda: np.zeros(3))
    light_settings: dict[str, list[float]] = field(default_factory=dict)
    processor_seconds: float = 0.0  # of the child
    direct_seconds: float = 0.0  # the part of them after the file was opened
    has_lens: bool = False  # depth of field: samples are seen through different points of the lens
    # The next two are for `with_points` of a finished picture.
    point: np.ndarray | None = None  # (P,) the number of each sample's point in its pixel
    weights: np.ndarray | None = None  # (N, D, D) of the points, as in `Film.shared`
    finer: gbuffer.FinerPoints | None = None  # for pixels at edges, relative to `origin`

    @property
    def rest(self) -> np.ndarray | None:
        """The part of the picture (H, W, 4) that is not reflected light: emission, lights in sight and world.

        It includes the exposure. Together with all reflected light it is Cycles' picture of the file. None if it was
        not asked for.
        """
        if self.background is None:
            return None
        light = self.exposure * (self.emission + self.background[..., :3])
        return np.concatenate([light, self.background[..., 3:]], axis=-1)


def extract(options: ExtractOptions, *, progress: Progress | None = None) -> Extraction:
    """The lights, samples and (if asked for) the Cycles reference of a .blend.

    Raises SceneError if the scene or file cannot be used, Cancelled if `progress(stage, fraction)` returned False.
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
        left_to_cycles = _kept(manifest, bits, film, shows_patches(samples, lights)) if options.for_finished else None
        # Back to positions in the file, in double precision.
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
            left_to_cycles=left_to_cycles,
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
    """Save the example scene as the .blend `path`, completely or not at all. Raises SceneError, OSError."""
    with replacing_by_copy(Path(path).absolute()) as unfinished, temporary_folder() as folder:
        run_child({"task": "demo", "path": str(unfinished)}, folder, progress)


def with_points(extraction: Extraction, count: int) -> Extraction:
    """`extraction` with the first `count` points of each pixel of a finished picture.

    One sample stands for all points of a pixel on the same smooth surface, but not with depth of field.
    """
    samples, film = extraction.samples, extraction.film
    if count < film.sub_samples:
        is_first = extraction.point < count
        samples, film = samples.take(is_first), replace(film.take(is_first), sub_samples=count)
        if extraction.weights is not None:
            seen = np.isfinite(film.whole)
            film = film.unspread().shared(extraction.weights[:count], extraction.point[is_first], seen)
    # With depth of field the points of a pixel may be far from each other.
    if not extraction.has_lens and len(samples):
        samples, film = gbuffer.merged(samples, film)
    finer = extraction.finer
    if finer is not None and extraction.weights is not None:
        finer = replace(finer, sums=extraction.weights[:count].sum(axis=0))
    return replace(extraction, samples=samples, film=film, finer=finer, point=None, weights=None)


def ended(extraction: Extraction) -> Extraction:
    """`extraction` with samples that end at the horizons of Cycles."""
    samples, film = extraction.samples, extraction.film
    hit = np.arange(len(samples)) if film.first is None else np.cumsum(film.first)
    is_quick = extraction.left_to_cycles is not None
    samples, index = end_at_horizons_of_cycles(samples, extraction.lights, hit, is_quick=is_quick)
    first = np.diff(index, prepend=-1) > 0
    if film.first is not None:
        first &= film.first[index]
    return replace(extraction, samples=samples, film=replace(film.take(index), first=None if first.all() else first))


def _read_samples(
    manifest: dict, folder: Path, look: Callable[[dict[str, np.ndarray]], None]
) -> tuple[SurfaceSamples, Film, np.ndarray, list[str], list[str]]:
    """Samples and film of all sample renders, the number (P,) of each sample's render, warnings and problems.

    There is one problem if most of what the camera sees is not shaded. `look` is called with the channels of each
    render.
    """
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
    """Mask (H, W) of the pixels that were rendered."""
    seen, border = np.ones((manifest["height"], manifest["width"]), bool), manifest["border"]
    if border is not None and not border["cropped"]:
        rows, columns = (slice(border[a], border[a] + border[b]) for a, b in (("top", "height"), ("left", "width")))
        seen[:] = False
        seen[rows, columns] = True
    return seen


def unlit(samples: SurfaceSamples, lights: tuple[Light, ...], camera: str) -> list[str]:
    """The warning about lights that reach nothing that the camera sees; [] if there are none."""
    if not has_lobe(samples).any():
        return [f"nothing that camera {camera!r} sees reflects light: the picture is black"] if len(samples) else []
    unseen = lights_that_reach_nothing(samples, lights)
    if unseen and len(unseen) == len({light.name for light in lights}):
        return [f"no light reaches what camera {camera!r} sees: the picture is black; turn or move a light"]
    return [f"nothing that camera {camera!r} sees is lit by {listed(map(repr, unseen))}"] if unseen else []


def faceted(samples: SurfaceSamples, lights: tuple[Light, ...]) -> list[str]:
    """The warning about reflections so sharp that they show the patches of a world; [] if there are none."""
    sharp = shows_patches(samples, lights)
    if not sharp.any():
        return []
    sky = next(light for light in lights if light.is_distant and light.children and light.affects_specular)
    return [
        f"world {sky.name!r}: it is blurred by a degree or more in reflections sharper than roughness "
        f"{SHARP_REFLECTION:g}, which {100.0 * sharp.mean():.2g} % of the samples have, and in facets in reference"
    ]


def shows_patches(samples: SurfaceSamples, lights: tuple[Light, ...]) -> np.ndarray:
    """Mask (P,) of the samples whose reflections are so sharp that they show the patches of a world."""
    if not any(light.is_distant and light.children and light.affects_specular for light in lights):
        return np.zeros(len(samples), bool)
    return has_lobe(samples)[1] & (samples.roughness < SHARP_REFLECTION)


class _Mean:
    """The mean of arrays that are added one at a time."""

    def __init__(self):
        self._sum, self._count = 0.0, 0

    def add(self, values: np.ndarray) -> None:
        self._sum, self._count = self._sum + values.astype(np.float64), self._count + 1

    @property
    def value(self) -> np.ndarray:
        return self._sum / self._count


def _read_indices(keys: tuple[str, ...], manifest: dict, folder: Path) -> dict[str, np.ndarray]:
    """Index passes (H, W), by name, of the first sample render, which shows the centers of the pixels."""
    if not keys:
        return {}
    channels = _rendered(folder / manifest["samples"][0])
    names = [manifest["passes"][key] for key in keys]
    return {name: lobes.read_layer(channels, name, "X") for name in names}


def _kept(manifest: dict, bits: list[np.ndarray], film: Film, is_faceted: np.ndarray) -> LeftToCycles:
    """Where a finished picture leaves direct light to Cycles: where a point of a pixel is not shaded as in Cycles."""
    found = manifest["kept"]
    by_pass = {
        name: film.reached(sum((number & bit for number in bits), np.zeros((film.height, film.width), int)) > 0)
        for name, bit in lobes.KEPT_BITS.items()
    }
    by_pass["specular"] |= film.image(is_faceted) > 0.0
    materials = found["materials"] + ["sharp reflections of the world (specular)"] * bool(is_faceted.any())
    return LeftToCycles(by_pass, *map(tuple, (materials, found["everything"], found["warnings"])))


def read_reference(manifest: dict, folder: Path) -> dict[str, np.ndarray] | None:
    """`Extraction.reference`: each half is the mean of its chunks, weighted by their samples; None without one."""
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
    """The channels of an EXR by Blender. Raises OSError if it is incomplete, which Blender does not report."""
    try:
        return read_channels(path)
    except ValueError as error:
        raise OSError(errno.ENOSPC, "a picture was not written whole") from error


EDGE_SECONDS = 12.0  # processor seconds that a million pixels of `FinishedJob.edges` take


@dataclass(frozen=True)
class FinishedJob:
    """What Cycles should render of an unchanged scene; None means as in the file."""

    scene: Path
    frame: int | None
    camera: str | None
    scene_name: str | None
    view_layer: str | None
    width: int | None
    height: int | None
    cycles_samples: int | None
    seconds: float | None  # processor time, in place of samples
    scripts: bool = False  # run the scripts in the file
    edges: bool = True  # also render what emits in sight separately, with smooth edges


@dataclass(frozen=True)
class CyclesPicture:
    """What Cycles rendered, row 0 on top."""

    channels: dict[str, np.ndarray]  # (H, W) each, by name without that of the view layer
    guides: dict[str, np.ndarray]  # the channels for the denoiser
    names: dict[str, str]  # of passes, as in `pass_names`
    samples: int
    shining: dict[str, np.ndarray]  # (H, W, 3) what emits in sight, with smooth edges, by the key of its pass
    everything: tuple[str, ...]  # reasons why all direct light is left to Cycles
    warnings: tuple[str, ...]
    camera: str
    frame: int
    processor_seconds: float
    least_seconds: float  # the part of them that every picture of the scene takes


def render_finished(job: FinishedJob, folder: Path, *, progress: Progress | None = None) -> CyclesPicture:
    """The unchanged scene as Cycles renders it. Raises as `extract` does."""
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
    """`CyclesPicture.shining`: means over the samples of both the whole scene and EDGES; {} without the latter."""
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
    """The channels: those of light are means over all chunks, all others come from the largest chunk."""
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
    """Write `PICTURE` (H, W, 4) in `folder` as the PNG `name` beside it, through the view transform of the scene.

    `where` is (name of the scene, frame) in the file; None in it stands for the file's own.
    """
    job = {"task": "show", "scene": str(Path(scene).absolute()), "pixels": str(folder / PICTURE), "name": name}
    run_child({**job, "scene_name": where[0], "frame": where[1]}, folder, progress)


@dataclass(frozen=True)
class BakeJob:
    """What to extract from which file for a bake; None means as in the file."""

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
    finished: tuple[tuple[str, int], ...] = ()  # (object, tile) that need no maps
    look_up_images: bool = True  # False: everything that varies is a map
    following: tuple[str, ...] = ()  # objects of the same file that later jobs need
    scripts: bool = False  # run the scripts in the file
    tile: int | None = None  # the only UDIM tile to extract; None: all
    sub_samples: int = 1  # points of a texel that need maps
    shadows: str = "off"  # see `ExtractOptions`


def extract_bake(job: BakeJob, folder: Path, *, progress: Progress | None = None) -> dict:
    """Write meshes, materials, maps and Cycles' bake of a .blend as files into `folder`; returns the manifest.

    Raises as `extract` does.
    """
    scene = Path(job.scene).absolute()
    check_readable(scene)
    return run_child({"task": "bake", **asdict(job), "scene": str(scene)}, folder, progress)


# VIEW_PASSES: the pictures that are drawn of a view. VIEW_PNG: the file of the first. GRAPHICS: the stage that the
# child reports before it asks for a graphics card; on a machine without one it may crash there.
VIEW_PASSES = ("combined", "specular", "diffuse")
VIEW_PNG = "view.png"
GRAPHICS = "graphics"
NO_GRAPHICS = (
    "Blender finds no graphics card here, nor a program in its place: install OpenGL (on Linux libegl1 and "
    "libgl1-mesa-dri draw without a card), or use shade, which needs none"
)


@dataclass(frozen=True)
class ViewJob:
    """What to draw as the viewport draws it; None means as in the file."""

    scene: Path
    techniques: tuple[str, ...]  # names or absolute paths of tables
    refine: int
    width: int | None
    height: int | None
    frame: int | None
    camera: str | None
    shadows: str  # "on" or "off"
    shadow_rays: int  # per light and pixel
    scripts: bool = False  # run the scripts in the file


def draw_view(job: ViewJob, folder: Path, *, progress: Progress | None = None) -> dict:
    """Write pictures of a .blend into `folder`; returns the manifest.

    The files are `VIEW_PNG` and "<number of the technique>_<pass>.npy", RGBA with row 0 on top, times the exposure.
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

    light: np.ndarray  # (6, N, N, 3), see `cycles.environment.CUBE`; empty if it gives no light
    lights: tuple[Light, ...]  # its small, bright spots
    background: np.ndarray  # (M, M, 3), see `viewport.sky`
    warnings: list[str]


def look_at_world(path: Path, world: str, frame: int, folder: Path, progress: Progress | None = None) -> SeenWorld:
    """The world named `world` in the .blend `path` at a frame; files go to `folder`. Raises as `extract` does."""
    found = run_child({"task": "world", "path": str(path), "world": world, "frame": frame}, folder, progress)
    light, background = (np.load(folder / f"{name}.npy") for name in ("light", "background"))
    return SeenWorld(light, tuple(light_of(one) for one in found["lights"]), background, found["warnings"])


LAMPS = "look at lights"  # a stage; its fraction is the share of the lights that have files


@dataclass(frozen=True)
class UnseenLamp:
    """A light's data block in a .blend, whose nodes Cycles should render, and fields of its `UnseenLight`."""

    path: str
    name: str
    matrix: list  # (4, 4)
    flags: dict
    facts: dict


def look_at_lamps(lamps: list[UnseenLamp], frame: int, folder: Path, take: Callable[..., bool]) -> None:
    """Let Cycles render the nodes of `lamps` at a frame, one after another.

    Calls `take(number, factor, lost)` for each, with the values of a `lights.textures.SeenNodes`, until it returns
    False. Files go to `folder`. Raises as `extract` does.
    """

    def watched(stage: str, fraction: float) -> bool | None:
        number = round(fraction * len(lamps)) - 1
        if stage != LAMPS:
            return None
        return take(number, np.load(folder / f"{number}.npy"), np.load(folder / f"{number}_lost.npy").item())

    run_child({"task": "lamps", "lamps": [asdict(lamp) for lamp in lamps], "frame": frame}, folder, watched)


def apply_bake(scene: Path, path: Path, textures: list[dict], *, progress: Progress | None = None) -> list[str]:
    """Save a copy of `scene` as the .blend `path`, in which objects show baked textures; returns warnings.

    Each of `textures` has "object", "uv", "name" and "files", a list of {"path", "tile"}. The copy appears complete or
    not at all. Raises as `extract` does.
    """
    with replacing_by_copy(Path(path).absolute()) as unfinished, temporary_folder() as folder:
        job = {"task": "apply", "scene": str(Path(scene).absolute()), "path": str(unfinished), "textures": textures}
        return run_child(job, folder, progress)["warnings"]


def scene_facts(
    scene: Path, frames, objects, uv=None, *, scripts: bool = False, progress: Progress | None = None
) -> list[dict]:
    """What there is to bake in each of `frames` (None: the file's own).

    Each entry has "frame", "camera" (name or None), "objects" (names of objects to bake) and "tiles" (the UDIM tiles
    by object, for objects with several). `objects` are names, "selected", "all", or None for none. `uv` is a UV map;
    None: the active ones. `scripts`: run those in the file. Raises as `extract` does.
    """
    scene = Path(scene).absolute()
    check_readable(scene)
    job = {"task": "facts", "scene": str(scene), "frames": list(frames), "objects": objects, "uv": uv}
    job["scripts"] = scripts
    with temporary_folder() as folder:
        return run_child(job, folder, progress)["facts"]


# The first bytes of a .blend: uncompressed, compressed by Blender since 3.0, and compressed before.
STARTS = (b"BLENDER", b"\x28\xb5\x2f\xfd", b"\x1f\x8b")
# The header: pointer size, byte order and version; since 5.0 also the size of the header and the version of the format.
_HEADER = re.compile(rb"BLENDER(?:[-_][vV](\d{3})|\d\d-\d\dv(\d{4}))")
_HEADER_BYTES = 17

Version = tuple[int, int]


def check_readable(scene: Path) -> None:
    """Raise SceneError if a look at the file is enough to tell that it cannot be opened; Blender need not start."""
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
    """Major and minor version of the Blender that saved a file with this `start`; None if it is compressed."""
    match = _HEADER.match(start)
    return divmod(int(match[1] or match[2]), 100) if match else None


def running() -> Version | None:
    """Major and minor version of the Blender that will open files; None if there is none."""
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
