"""The untouched scene as Cycles renders it, for finished pictures (runs in the child)."""

import math
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path

import bpy
import numpy as np

from .. import render_settings
from ..evaluated import SURFACE_TYPES
from ..lights.area import LightInventory
from ..lights.groups import regroup
from ..materials.aovs import give_default_material, objects_without_material
from ..materials.bsdfs import emits, is_emission
from ..materials.graph import cut, ensure_nodes, is_seen_through, material_output, shaders_behind, tree_in_use
from ..process.blender_process import job_start
from ..process.finished import FinishedJob, ShowJob
from ..process.pixels import EDGE_SECONDS, rendered_channels
from ..render_settings import enable_passes, render_exr
from .pixels import REST_PASSES, files_opened, manifest_of, open_scene, picture_facts, scene_named

# A given number of samples is rendered in files, so that progress can be told: the fewest samples of a file, and the
# most files of a half.
FEWEST, MOST_OF_HALF = 16, 3
# A budget is spent in files as well. PROBES: the most samples of the first ones. OTHER, the last, is of a sequence of
# its own: halves of one sequence have noise that is alike. PROBED: the share of those that fit which a probe may be;
# three samples alone seem up to a fifth too slow. SPENT: the share of the time that all files may take. FILE_SECONDS:
# the processor seconds that a file takes beside its samples, for a million pixels. SEQUENCE: the least length of their
# sequence of samples; Cycles wants one.
PROBES, PROBED, SPENT, FILE_SECONDS, SEQUENCE = (1, 3, 8, 12), 1.0 / 8.0, 0.97, 1.0, 1024
OTHER = len(PROBES) - 1
# PASSES: what a finished picture takes its parts from, and artists put together. GUIDES: what the denoiser needs.
LIGHT_PASSES = tuple(
    f"{kind}_{factor}" for kind in ("diffuse", "glossy", "transmission") for factor in ("direct", "indirect", "color")
)
PASSES = (*LIGHT_PASSES, "emit", "environment")
GUIDES = ("Denoising Albedo", "Denoising Normal")
NOT_WRITTEN = (*GUIDES, "Denoising Depth", "Denoising Specular Albedo", "Denoising Roughness")
# What shines in sight is rendered apart, into the file EDGES. EDGE_SAMPLES: the fewest and the most samples of a pixel;
# those at edges take more than the fewest, until their noise is below EDGE_LIMIT. LATEST_EDGES: the share of a budget
# after which they are left out.
EDGES, EDGE_SAMPLES, EDGE_LIMIT, LATEST_EDGES = "edges.exr", (16, 512), 0.003, 1.05
# REFLECTING: the inputs that make nodes which shine reflect as well.
REFLECTING = ("Color", "Base Color", "Metallic", "Specular IOR Level", "Transmission Weight", "Subsurface Weight")


def render_finished(job: FinishedJob, folder: Path, progress) -> dict:
    """Do the `job` and write EXRs into `folder`. Returns the manifest."""
    started, prepared = job_start(), _prepared.pop() if _prepared else None
    if job.begun is None or prepared is None or prepared.files_opened != files_opened():
        prepared = _PreparedScene(job, progress)
    scene, layer = prepared.scene, prepared.layer
    has_edges = job.edges and not (job.begins or prepared.everything or prepared.camera.data.dof.use_dof)
    shines, pixels = cache(_anything_shines), math.prod(render_settings.picture_size(scene))

    def end(first: Path) -> float:
        reserve = has_edges and shines(first)
        return started + SPENT * max(job.seconds - reserve * EDGE_SECONDS * pixels / 1e6, 0.0)

    if job.seconds is None:
        files, least, each = *_render_chunks(scene, layer, folder, job.cycles_samples, progress), 0.0
    else:
        timed = _TimedFiles(scene, layer, prepared.seed, folder, end, progress, **(job.begun or {}))
        timed.render_first()
        if not job.begins:
            timed.render_rest()
        files, least, each = timed.files, timed.least, timed.each
    if job.begins:
        _prepared.append(prepared)
    # Their time is reserved; the last file may have taken a little longer than it should.
    in_time = job.seconds is None or time.process_time() < started + LATEST_EDGES * job.seconds
    if has_edges := has_edges and in_time and shines(folder / files[0][0]):
        _render_edges(scene, layer, folder, progress)
    return {
        "frame": scene.frame_current,
        "camera": prepared.camera.name,
        "to_camera": _to_camera(prepared.camera),
        "layer": layer.name,
        "files": files,
        "each": each,
        "least": least if job.begun else least - started,
        "edges": [EDGES, EDGE_SAMPLES[1]] if has_edges else None,
        "film_transparent": scene.render.film_transparent,
        "dropped": prepared.dropped,
        "passes": render_settings.pass_names(),
        "everything": prepared.everything,
        "warnings": prepared.warnings,
        "pixels": manifest_of(scene, prepared.camera, prepared.facts, LightInventory(), []),
    }


class _PreparedScene:
    """The scene of a job, opened and prepared, and what there is to say of it."""

    def __init__(self, job: FinishedJob, progress):
        self.warnings: list[str] = []
        progress("open scene", 0.0)
        open_scene(Path(job.scene), self.warnings, job.scripts)
        self.files_opened, self.scene = files_opened(), scene_named(job.scene_name)
        render_settings.go_to_frame(self.scene, job.frame)
        self.camera = render_settings.choose_camera(self.scene, job.camera)
        self.layer = render_settings.only_view_layer(self.scene, self.warnings, job.view_layer, "rendered")
        self.facts = picture_facts(self.scene, job)
        if job.own_groups is not None:
            render_settings.remove_extra_passes(self.layer)
            for name in regroup(self.scene, tuple(job.own_groups)):
                self.layer.lightgroups.add(name=name)
        self.everything = reasons_for_cycles(self.scene, self.layer)
        self.seed = self.scene.cycles.seed
        self.dropped = () if self.layer.cycles.denoising_store_passes else NOT_WRITTEN
        _prepare(self.scene, self.layer, self.warnings)


# Of the last job, if that only began a picture: the next one may go on with it.
_prepared: list[_PreparedScene] = []


def show_finished(job: ShowJob, folder: Path, progress) -> dict:
    """Do the `job`; returns an empty manifest."""
    progress("write", 0.0)
    if Path(bpy.data.filepath) != Path(job.scene):
        open_scene(Path(job.scene), [], False)
    scene = scene_named(job.scene_name)
    if job.frame not in (None, scene.frame_current):
        render_settings.go_to_frame(scene, job.frame)
    render_settings.save_png(scene, np.load(job.pixels), folder / job.name)
    return {}


def reasons_for_cycles(scene, layer) -> list[str]:
    """Why all direct light of the picture is left to Cycles."""
    world = layer.world_override or scene.world
    outputs = [] if world is None or tree_in_use(world) is None else tree_in_use(world).nodes
    rendered = [ob for ob in scene.objects if not ob.hide_render]
    reasons = {
        "motion blur": scene.render.use_motion_blur,
        "the volume of the world": any(
            node.bl_idname == "ShaderNodeOutputWorld" and node.inputs["Volume"].is_linked for node in outputs
        ),
    }
    for ob in rendered:
        reasons[f"volume {ob.name!r}"] = ob.type == "VOLUME"
        reasons[f"shadow catcher {ob.name!r}"] = ob.type in SURFACE_TYPES and ob.is_shadow_catcher
    return [reason for reason, is_there in reasons.items() if is_there]


def _to_camera(camera) -> list[list[float]]:
    """Rows of the matrix that turns directions into Cycles' camera space, whose z axis points into the scene."""
    rows = camera.matrix_world.to_3x3().normalized().transposed()
    return [list(rows[0]), list(rows[1]), list(-rows[2])]


def _prepare(scene, layer, warnings: list[str]) -> None:
    """Let Cycles write all passes. Nothing here changes the light that it renders."""
    render, cycles = scene.render, scene.cycles
    warnings.extend(render_settings.steps_after_rendering(scene))
    if render.use_multiview:
        warnings.append("stereoscopy is switched off")
    if cycles.sample_clamp_direct:
        warnings.append(f"direct light by LTSH is not clamped to {cycles.sample_clamp_direct:g} as that of Cycles is")
    # A render evaluates the scene's animation again, which would undo these settings.
    if scene.animation_data is not None:
        scene.animation_data_clear()
    # Cycles keeps the scene for the second and further files.
    render.use_persistent_data = True
    if cycles.device != "CPU":
        warnings.append("Cycles renders on the processor, the file asks for a graphics card")
    # The parent denoises what remains without our light. Noise that is the same in each frame does not flicker.
    render_settings.render_with_cycles(scene)
    for name in PASSES:
        setattr(layer, f"use_pass_{name}", True)
    layer.cycles.denoising_store_passes = True


def _render_chunks(scene, layer, folder: Path, samples, progress) -> tuple[list[list], float]:
    """Render `samples` samples, or what the file says.

    Returns [file name in `folder`, samples in it] for each file, and the processor time after the first one.
    """
    cycles, files, done, first = scene.cycles, [], 0, 0.0
    if samples is None:
        if cycles.use_adaptive_sampling or cycles.time_limit:
            return _render_as_saved(scene, layer, folder), time.process_time()
        samples = layer.samples or cycles.samples
    _take_all_samples(scene, layer)
    half = -(-samples // 2)  # no file has more samples, so that there are two halves
    chunk = -(-half // max(1, min(half // FEWEST, MOST_OF_HALF)))
    while done < samples:
        progress("Cycles", done / samples)
        count = min(chunk, samples - done)
        render_settings.take_samples(scene, done, count, samples)
        _render_file(scene, folder, files, count)
        first, done = first or time.process_time(), done + count
    return files, first


def _take_all_samples(scene, layer) -> None:
    """Let Cycles render as many samples as it is told, everywhere."""
    layer.samples, scene.cycles.use_adaptive_sampling, scene.cycles.time_limit = 0, False, 0.0


@dataclass
class _TimedFiles:
    """Files as `_render_chunks` renders them, as many samples as fit until the processor time `end(first file)`.

    The first tell what a sample takes; then come two halves. All but OTHER are of one sequence, whose noise is spread
    more evenly than that of several: of 110 samples of the product shot and of the workshop 5 % less error.
    """

    scene: bpy.types.Scene
    layer: bpy.types.ViewLayer
    seed: int
    folder: Path
    end: Callable[[Path], float]
    progress: Callable
    files: list[list] = field(default_factory=list)
    each: float = 0.0  # seconds of a sample
    least: float = 0.0  # the processor time after the first file

    def __post_init__(self):
        self._of_file = FILE_SECONDS * math.prod(render_settings.picture_size(self.scene)) / 1e6
        _take_all_samples(self.scene, self.layer)

    def render_first(self) -> None:
        """Render the PROBES, unless they are there."""
        for count in PROBES[len(self.files) :]:
            # The first file takes longer, since Cycles looks at the scene.
            count = min(count, int(PROBED * self._affordable())) if self.files else count
            if count < 1 and len(self.files) > 1:
                break  # two files there are always
            self._render(max(count, 1))
            self.least = self.least or time.process_time()

    def render_rest(self) -> None:
        """Render what still fits."""
        if (count := self._affordable(2)) > 1:
            half = -(-count // 2)
            self._render(half)
            if (rest := min(self._affordable(), count - half)) > 0:
                self._render(rest)

    def _render(self, count: int) -> None:
        """Render the next samples."""
        number = len(self.files)
        done = sum(samples for _, samples in self.files[:OTHER] + self.files[OTHER + 1 :]) if number != OTHER else 0
        self.progress("Cycles", number / (2 + len(PROBES)))
        started, self.scene.cycles.seed = time.process_time(), (self.seed + (number == OTHER)) % 2**31
        render_settings.take_samples(self.scene, done, count, max(SEQUENCE, done + count))
        _render_file(self.scene, self.folder, self.files, count)
        took = time.process_time() - started
        self.each = max(took - self._of_file, 0.1 * took) / count

    def _affordable(self, files: int = 1) -> int:
        until = self.end(self.folder / self.files[0][0])
        return int((until - time.process_time() - files * self._of_file) / self.each)


def _render_file(scene, folder: Path, files: list[list], count: int) -> None:
    """Render the next of the `files`, of `count` samples."""
    files.append([f"cycles_{len(files)}.exr", count])
    render_exr(scene, folder / files[-1][0], "RLE")  # ZIP takes four times as long, for three quarters of the bytes


def _render_as_saved(scene, layer, folder: Path) -> list[list]:
    """Render with the settings of the file, in two halves with seeds of their own."""
    cycles, files = scene.cycles, []
    samples, seed = layer.samples or cycles.samples, cycles.seed
    counts = [count for count in (-(-samples // 2), samples // 2) if count]
    if len(counts) == 2:
        # Halves with sqrt(2) of the noise together have as much as the picture should have. Without a least number of
        # samples Cycles takes one by the threshold, and would take that of each half.
        threshold = cycles.adaptive_threshold or max(1.0 / samples, 0.001)
        least = cycles.adaptive_min_samples or math.ceil(16.0 / threshold**0.3)
        cycles.adaptive_threshold, cycles.adaptive_min_samples = math.sqrt(2.0) * threshold, -(-least // 2)
        cycles.time_limit *= 0.5
    layer.samples = 0
    for number, count in enumerate(counts):
        cycles.samples, cycles.seed = count, (seed + number) % 2**31
        _render_file(scene, folder, files, count)
    return files


def _anything_shines(path: Path) -> bool:
    """True if a picture has something that shines in sight."""
    names = tuple(f".{render_settings.pass_names()[key]}." for key in ("emission", "background"))
    return any(plane.any() for key, plane in rendered_channels(path).items() if any(name in key for name in names))


def _render_edges(scene, layer, folder: Path, progress) -> None:
    """Render EDGES, only what shines in sight. From now on surfaces that only reflect are black."""
    progress("edges", 0.0)
    bare = [ob for ob in bpy.data.objects if ob.type in SURFACE_TYPES and ob.data.library is None]
    give_default_material(objects_without_material(bare))
    for material in bpy.data.materials:
        if not material.is_grease_pencil:
            ensure_nodes(material)
            _only_shine(material)
    cycles = scene.cycles
    enable_passes(layer, ("combined", *REST_PASSES))
    layer.cycles.denoising_store_passes = False
    layer.cycles.pass_debug_sample_count = True
    layer.samples, cycles.max_bounces, cycles.time_limit, cycles.use_sample_subset = 0, 0, 0.0, False
    cycles.use_adaptive_sampling, cycles.adaptive_threshold = True, EDGE_LIMIT
    cycles.adaptive_min_samples, cycles.samples = EDGE_SAMPLES
    render_exr(scene, folder / EDGES)


def _only_shine(material) -> None:
    """Let the surface of a material reflect nothing."""
    output = material_output(material.node_tree)
    if output is None:
        return
    shaders = shaders_behind(output.inputs["Surface"])
    if is_seen_through(output, shaders):
        return
    nodes = [leaf.node for leaf in shaders.leaves]
    if not any(is_emission(node) or emits(node) for node in nodes):
        cut(output.inputs["Surface"])
    for socket in (node.inputs.get(name) for node in nodes if not is_emission(node) for name in REFLECTING):
        if socket is not None:
            cut(socket)
            socket.default_value = 0.0 if socket.type == "VALUE" else (0.0, 0.0, 0.0, 1.0)
