"""The samples, the lights and the Cycles reference of a picture (runs in the child)."""

import time
from collections.abc import Callable
from contextlib import nullcontext, suppress
from dataclasses import dataclass
from pathlib import Path

import bpy
import numpy as np

from ...scene import SceneError, error_line, light_records, listed
from .. import render_settings
from ..evaluated import SURFACE_TYPES, owner_of, read_values, rendered_surfaces, with_render_depsgraph
from ..lights.area import LightInventory, collect_lights, half_hidden, note_colors, note_overlaps, rendered_lights
from ..lights.emission import LookTooLong
from ..lights.groups import regroup
from ..lights.meshes import SIDE_PROPERTY, let_light_through
from ..lights.world import blocks_nothing, take_world, world_behind, world_lights
from ..materials import aovs
from ..materials.graph import images_behind
from ..process.blender_process import job_start, newer
from ..process.pixels import (
    BEHIND,
    EDGE_SECONDS,
    LEAST_POINTS,
    TOO_FEW_SAMPLES,
    TOO_LITTLE_TIME,
    PixelJob,
    affordable_points,
    longest_look,
)
from .occluders import collect_occluders, with_baked_shares, with_displacement

# FAST_PIXELS: up to this many samples (about 1 GB of files), files are compressed fast instead of well.
FAST_PIXELS = 10_000_000
# Transparent surfaces that a camera ray passes, the most that Blender allows.
UNLIMITED = 1024


def render_pixel_samples(
    scene, view_layer, folder: Path, offsets: np.ndarray, progress, extra_passes: tuple[str, ...] = ()
) -> list[str]:
    """Render one sample per pixel for each of the `offsets` (N, 2) from the pixel centers, in pixels.

    Returns the names of the files in `folder`, one per offset. With depth of field each file has other lens points.
    """
    aovs.declare_aovs(view_layer)
    render_settings.enable_passes(view_layer, ("combined", "diffuse_color", "normal", *extra_passes))
    scene.cycles.seed, scene.cycles.samples, scene.cycles.use_sample_subset = 0, 1, False
    files, sub_samples = [], len(offsets)
    # RLE is faster to write than ZIP; its files are 2.4 times larger on the example scene.
    codec = "RLE" if sub_samples * scene.render.resolution_x * scene.render.resolution_y <= FAST_PIXELS else "ZIP"
    with render_settings.pinned_pixel_filter(scene), render_settings.without_scripts(scene):
        for index, offset in enumerate(offsets):
            progress("samples", index / sub_samples)
            files.append(f"samples_{index:04d}.exr")
            if scene.camera.data.dof.use_dof:
                render_settings.take_samples(scene, index, 1, sub_samples)
            # Only the camera changes from file to file: Cycles keeps the scene, and the result is the same bit by bit.
            scene.render.use_persistent_data = index < sub_samples - 1
            with render_settings.shifted_pixels(scene, offset):
                render_settings.render_exr(scene, folder / files[-1], codec)
    scene.cycles.use_sample_subset = False
    aovs.remove_aovs(view_layer)
    return files


# FINISHED_LENS: fewest points per pixel for depth of field in a finished picture; with fewer Cycles has less noise.
FINISHED_LENS = 32
# REST_PASSES: passes of Cycles with the parts of the picture that are not reflected light.
REST_PASSES = ("emit", "environment")
# OCCLUDERS: the file with the occluders.
OCCLUDERS = "occluders.npz"
SEEDS = {"A": 1, "B": 7919}
# Chunks of one half of the reference. FIRST_CHUNK: samples of the first. CHUNK_SECONDS: the time that each of the
# others should take. MAX_CHUNKS: how many others there are at most.
FIRST_CHUNK = 16
CHUNK_SECONDS = 4.0
MAX_CHUNKS = 8


def remove_occlusion(scene) -> None:
    """Make every surface, instances included, invisible to all rays but those of the camera.

    Objects that shine must stay visible to the rays that find their light: rays pass through them instead.
    """
    for ob in bpy.data.objects:
        if ob.type not in SURFACE_TYPES:
            continue
        ob.visible_shadow = ob.visible_transmission = False
        if SIDE_PROPERTY not in ob:
            ob.visible_diffuse = ob.visible_glossy = False
    let_light_through(scene)


def render_reference(scene, view_layer, folder: Path, cycles_samples: int, sub_samples: int, progress) -> list[list]:
    """Render the reference in two halves of cycles_samples / 2 samples each.

    Returns for each half a list of [file name in `folder`, samples in it]. The camera rays are those of
    `render_pixel_samples`, so that edges agree: each sub-sample gets an equal share of the samples, at least one. A
    half is rendered in chunks of one sample sequence because Cycles reports progress only about once a minute.
    """
    render_settings.enable_passes(
        view_layer, ("combined", "diffuse_direct", "diffuse_color", "glossy_direct", "glossy_color")
    )
    samples, offsets = max(1, cycles_samples // 2), render_settings.sub_pixel_offsets(scene, sub_samples)
    share = max(1, samples // sub_samples)
    # Cycles keeps the scene, and its picture of a procedural sky, for all files.
    scene.render.use_persistent_data = True
    with render_settings.pinned_pixel_filter(scene):
        files = [_render_half(scene, folder, half, offsets, share, progress) for half in SEEDS]
    scene.render.use_persistent_data = False
    return files


def _render_half(scene, folder: Path, half: str, offsets, share: int, progress) -> list[list]:
    """Render one half: for each sub-sample a file with the next `share` samples of one sequence.

    A single sub-sample is rendered in chunks.
    """
    cycles = scene.cycles
    files, done, samples = [], 0, share * len(offsets)
    chunk = share if len(offsets) > 1 else min(FIRST_CHUNK, share)
    cycles.seed = SEEDS[half]
    while done < samples:
        progress(f"Cycles {half}", done / samples)
        started = time.monotonic()
        count = min(chunk, samples - done)
        render_settings.take_samples(scene, done, count, samples)
        files.append([f"cycles_{half}_{len(files):04d}.exr", count])
        with render_settings.shifted_pixels(scene, offsets[done // share]):
            render_settings.render_exr(scene, folder / files[-1][0])
        done += count
        if len(offsets) == 1 and len(files) == 1 and done < samples:
            seconds_left = (time.monotonic() - started) * (samples - done) / done
            chunks = min(MAX_CHUNKS, max(1, round(seconds_left / CHUNK_SECONDS)))
            chunk = -(-(samples - done) // chunks)
    cycles.use_sample_subset = False
    return files


def missing_images(depsgraph, world, override=None) -> list[str]:
    """A warning for each missing image that is shown: by a face, a light, the `world`, or what shapes an object.

    The material `override` replaces all others.
    """
    missing = [image for image in bpy.data.images if image.users and _is_lost(image)]
    user_map, objects, blocks = bpy.data.user_map() if missing else {}, set(), {world}
    for instance in depsgraph.object_instances if missing else ():
        ob = instance.object
        if ob.type == "LIGHT":
            blocks.add(ob.original.data)
        elif ob.type in SURFACE_TYPES and (instance.show_self or instance.show_particles):
            objects |= {ob.original, owner_of(instance).original}
            blocks |= {override} if override else _materials_of_faces(ob)

    def shapes(block) -> bool:
        between = "TEXTURE", "NODETREE", "PARTICLE"
        return any(user in objects or user.id_type in between and shapes(user) for user in user_map[block])

    shown = {image for block in blocks - {None} for image in images_behind(block)}
    return [
        f"image {image.name!r}: {image.filepath} is missing, Cycles and the techniques show it in pink"
        for image in missing
        if image in shown or shapes(image)
    ]


def _materials_of_faces(ob) -> set:
    """The original materials, or None, of the faces of the evaluated object `ob`; all where it has hair."""
    materials = [slot.material and slot.material.original for slot in ob.material_slots]
    if isinstance(ob.data, bpy.types.Mesh) and not ob.particle_systems and len(materials) > 1:
        index = read_values(ob.data.polygons, "material_index", (len(ob.data.polygons),), np.int32)
        return {materials[number] for number in np.unique(np.clip(index, 0, len(materials) - 1))}
    return set(materials)


def _is_lost(image) -> bool:
    """True if a file of the image is not there; a sequence is there if its folder has one of its kind."""
    if image.source not in ("FILE", "MOVIE", "SEQUENCE", "TILED") or image.packed_file or not image.filepath:
        return False
    path = Path(bpy.path.abspath(image.filepath, library=image.library))
    if image.source == "SEQUENCE":
        return not any(path.parent.glob(f"*{path.suffix}"))
    numbers = [tile.number for tile in image.tiles] if image.source == "TILED" else [1001]
    return not all(path.with_name(path.name.replace("<UDIM>", str(number))).is_file() for number in numbers)


_files_opened = 0


def files_opened() -> int:
    """How many times `open_scene` was called; data of a file is valid until the next call."""
    return _files_opened


NAMED = 5  # how many things of a kind an error names


def open_scene(path: Path, warnings: list[str], scripts: bool = False) -> None:
    """Open the .blend `path` in Blender; its `scripts` run only if True. Raises SceneError."""
    global _files_opened
    _files_opened += 1
    try:
        bpy.ops.wm.open_mainfile(filepath=str(path), load_ui=False, use_scripts=scripts)
    except RuntimeError as error:
        raise SceneError(
            f"{path}: Blender {bpy.app.version_string} cannot open it, is it whole? ({_reason(error, path)})"
        ) from None
    saved, here = tuple(bpy.data.version)[:2], bpy.app.version[:2]
    if saved > here:
        raise SceneError(newer(path, saved, here))
    if bpy.app.autoexec_fail:
        saved = "what they set stays as it was saved; --enable-autoexec runs them"
        warnings.append(f"scripts in {path.name} do not run, {saved}: {bpy.app.autoexec_fail_message}")
    for library in bpy.data.libraries:
        if not Path(bpy.path.abspath(library.filepath)).is_file():
            warnings.append(f"library {library.name!r}: {library.filepath} is missing, and what it held with it")


def _reason(error: RuntimeError, path: Path) -> str:
    """Blender's reason for an error about a file, without the name of the file."""
    text = error_line(error).removeprefix("Error: ")
    for named in (f'Loading "{path}" failed: ', f"Failed to read blend file '{path}': ", f' in file "{path}"'):
        text = text.replace(named, "")
    return text


def prepare_scene(
    scene, view_layer, camera, warnings: list[str], *, with_occluders: bool = False, look_until: float | None = None
) -> LightInventory:
    """Prepare the open scene for sample renders: returns its lights, leaves out what cannot be shaded, injects AOVs.

    For finished pictures `look_until` is the processor time until which this may take. Raises LookTooLong; and
    SceneError if no light can be shaded, except for finished pictures.
    """
    for_finished = look_until is not None
    render_settings.neutralize(scene, view_layer, camera, warnings)
    world = take_world(scene, view_layer, warnings)
    render_settings.prepare_surfaces(warnings)

    lost: list[str] = []

    def visit(depsgraph):
        surfaces = rendered_surfaces(depsgraph)
        override = view_layer.material_override
        bare = [] if override else aovs.objects_without_material(surfaces)
        inventory = collect_lights(depsgraph, override)
        inventory.look_until = np.inf if look_until is None else look_until
        if with_occluders:
            inventory.occluders = collect_occluders(
                depsgraph, override, inventory.warn, inventory.left_out, unread, displaced
            )
        lost.extend(missing_images(depsgraph, world, override))
        return inventory, aovs.materials_in_use(surfaces, override), bare

    unread, displaced = [], []
    inventory, materials, bare = with_render_depsgraph(scene, visit)
    # Camera rays pass through any number of wholly transparent surfaces, which leave no trace in the passes.
    scene.cycles.transparent_max_bounces = UNLIMITED
    if displaced:
        inventory.occluders = with_displacement(inventory.occluders, displaced, scene)
    if unread:
        inventory.occluders = with_baked_shares(inventory.occluders, unread, scene, inventory.warn)
    default = aovs.give_default_material(bare)
    materials += [default] if default else []
    reasons, glass = (inventory.left_to_cycles, None) if for_finished else (None, inventory.glass)
    of_materials = aovs.inject_aovs(
        materials, inventory.emitting_materials, inventory.unshaded, inventory.made_opaque, reasons, glass
    )
    inventory.receivers.mark()
    if with_occluders:  # before a look at the lights, which shows them to such rays
        aovs.let_shadow_rays_through(inventory.made_opaque)
    inventory.behind = world
    add_world(inventory, scene, world)
    if not inventory.lights and not for_finished:
        raise no_light(scene, inventory.warnings)
    inventory.warnings += lost
    warnings += inventory.warnings + of_materials
    render_settings.leave_out_objects(scene, inventory.left_out, warnings)
    return inventory


def add_world(inventory: LightInventory, scene, world) -> None:
    """Complete `inventory` with the emission of its lights and the light of `world`, the former world of `scene`."""
    of_world, inventory.sky_detail = world_lights(scene, world, inventory.warn)
    inventory.lights = rendered_lights(scene, inventory) + of_world
    note_overlaps(inventory)
    inventory.world = world if of_world else None
    if of_world and of_world[0].affects_diffuse != of_world[0].affects_specular:
        inventory.warn(half_hidden(of_world[0]))
    if inventory.occluders is not None:
        note_colors(inventory)
        inventory.occluders = blocks_nothing(inventory.occluders, inventory.world)


def no_light(scene, reasons: list[str]) -> SceneError:
    """The error for a scene in which no light can be shaded; it names the first of the `reasons`."""
    lights = [f"{ob.name!r} ({ob.data.type})" for ob in scene.objects if ob.type == "LIGHT"]
    text = f"found lights {listed(lights, NAMED)}" if lights else "found no lights at all"
    if reasons:
        text += f" ({listed((line.partition('; left out')[0] for line in reasons), NAMED, '; ')})"
    return SceneError(f"scene {scene.name!r}: no light that renders, {text}; add a light")


def extract_pixels(job: PixelJob, folder: Path, progress) -> dict:
    """Do the `job` and write its files into `folder`; returns the manifest.

    The budget of the job counts from `job_start` on.
    """
    times, warnings = [time.monotonic()], []
    progress("open scene", 0.0)
    open_scene(Path(job.scene), warnings, job.scripts)
    opened = time.process_time()
    scene = scene_named(job.scene_name)
    render_settings.go_to_frame(scene, job.frame)
    camera = render_settings.choose_camera(scene, job.camera)
    view_layer = render_settings.choose_view_layer(scene, warnings, job.view_layer)
    if job.own_groups is not None:
        regroup(scene, tuple(job.own_groups))
    picture = _OpenPicture(job, scene, view_layer, camera, picture_facts(scene, job), folder, progress)
    inventory, count = picture.prepared_in_time(warnings, opened)
    if inventory.occluders is not None:
        inventory.occluders.save(folder / OCCLUDERS)
    times.append(time.monotonic())
    rendered = picture.rendered_points(inventory, count)
    times.append(time.monotonic())
    reference = picture.rendered_reference(inventory) if job.cycles_samples else None
    times.append(time.monotonic())
    # A later task may save this picture as a PNG with the file's own settings.
    scene.render.film_transparent = picture.facts["film_transparent"]
    return {
        **manifest_of(scene, camera, picture.facts, inventory, warnings),
        "has_lens": picture.has_lens,
        **rendered,
        "reference": reference,
        "seconds": dict(zip(("start", "samples", "cycles"), np.diff(times).tolist(), strict=True)),
        "direct_seconds": time.process_time() - opened,
    }


def manifest_of(scene, camera, facts: dict, inventory: LightInventory, warnings: list[str]) -> dict:
    """The manifest of a picture without samples; `facts` are those of `picture_facts`."""
    return {
        "blender_version": bpy.app.version_string,
        "frame": scene.frame_current,
        "camera": camera.name,
        **facts,
        "lights": light_records(inventory.lights),
        "sky_detail": inventory.sky_detail,
        "light_settings": inventory.settings,
        "occluders": None if inventory.occluders is None else OCCLUDERS,
        "warnings": warnings,
        "unshaded": inventory.unshaded,
        "left_to_cycles": {**vars(inventory.left_to_cycles), "warnings": inventory.warnings},
        "passes": render_settings.pass_names(),
        "has_lens": False,
        "samples": [],
        "seconds": {},
        **dict.fromkeys(("processor_seconds", "direct_seconds"), 0.0),
        **dict.fromkeys(("behind", "weights", "reference")),
    }


@dataclass
class _OpenPicture:
    """A picture of a scene whose file is open."""

    job: PixelJob
    scene: bpy.types.Scene
    view_layer: bpy.types.ViewLayer
    camera: bpy.types.Object
    facts: dict  # of `picture_facts`
    folder: Path
    progress: Callable
    has_lens: bool = False  # whether the points of a pixel give the depth of field

    def prepared_in_time(self, warnings: list[str], opened: float) -> tuple[LightInventory, int]:
        """Prepare the scene, whose file was `opened` at that processor time, as far as the job's budget allows.

        Returns what shines, and the points per pixel: 0 where all direct light is left to Cycles.
        """
        job, pixels = self.job, self.facts["width"] * self.facts["height"]
        # With a reference there is no depth of field: its lens points would differ.
        lens, fewest = self.camera.data.dof, FINISHED_LENS if job.for_finished else 2
        self.has_lens = lens.use_dof and job.sub_samples >= fewest and not job.cycles_samples
        is_sharp = lens.use_dof = lens.use_dof and not self.has_lens
        inventory, count, end = LightInventory(), 0, None
        if job.seconds is not None:
            end = job_start() + job.seconds - 1e-6 * EDGE_SECONDS * pixels
        # Without points, or time for one, a look at the scene would be wasted.
        if job.sub_samples and (end is None or affordable_points(end - opened, pixels, 1)):
            look_until = np.inf if end is None or self.has_lens else opened + longest_look(end - opened)
            options = {"with_occluders": job.shadows == "on", "look_until": look_until if job.for_finished else None}
            with suppress(LookTooLong):
                inventory = prepare_scene(self.scene, self.view_layer, self.camera, warnings, **options)
                count = job.sub_samples
            if end is not None and not self.has_lens and count:
                now = time.process_time()
                affordable = affordable_points(end - now, pixels, len(inventory.lights), now - opened)
                count = 0 if affordable < min(LEAST_POINTS, count) else min(affordable, count)
        lens.use_dof = self.has_lens
        theirs = inventory.left_to_cycles.everything
        if is_sharp and job.for_finished:
            points = f"with fewer than {FINISHED_LENS} points per pixel (--aa)"
            theirs.append(f"depth of field of camera {self.camera.name!r} {points}")
        if count == 0:
            theirs.append(TOO_FEW_SAMPLES if job.seconds is None else TOO_LITTLE_TIME)
        return inventory, 0 if job.for_finished and theirs else count

    def rendered_points(self, inventory: LightInventory, count: int) -> dict:
        """Render `count` points of each pixel, and what is behind glass; entries of the manifest."""
        job, scene, weights = self.job, self.scene, None
        if job.for_finished:
            offsets, weights = render_settings.sub_pixel_offsets(scene, count, render_settings.shared_points)
        else:
            offsets = render_settings.sub_pixel_offsets(scene, count)

        def rendered(folder: Path, world, passes) -> list:
            with world_behind(scene, world):
                return render_pixel_samples(scene, self.view_layer, folder, offsets, self.progress, passes)

        shows_world = job.rest and not self.facts["film_transparent"]
        passes = (*(REST_PASSES if job.rest else ()), *job.indices)
        # Lights that the camera sees are part of the rest.
        with nullcontext() if job.rest else render_settings.without_lights(scene):
            samples = rendered(self.folder, inventory.behind if shows_world else None, passes)
        behind = None
        if inventory.glass and job.rest and not job.cycles_samples:
            _look_through_glass(scene, inventory)
            behind = rendered(self.folder / BEHIND, inventory.behind, REST_PASSES)
        weights = None if weights is None else weights[: len(samples)].tolist()
        return {"samples": samples, "behind": behind, "weights": weights}

    def rendered_reference(self, inventory: LightInventory) -> list:
        """Cycles' picture, lit as the techniques light it: with or without shadows."""
        job, scene = self.job, self.scene
        if inventory.occluders is not None:
            scene.cycles.transparent_max_bounces = inventory.occluders.transparent_surfaces
        else:
            remove_occlusion(scene)
        scene.world = inventory.world
        return render_reference(scene, self.view_layer, self.folder, job.cycles_samples, job.sub_samples, self.progress)


def _look_through_glass(scene, inventory: LightInventory) -> None:
    """Let camera rays pass through glass, and meet the lights and the world that rays through glass meet."""
    aovs.make_clear(inventory.glass)
    for ob in scene.objects:
        if ob.type == "LIGHT":
            ob.visible_camera = ob.visible_transmission
    if inventory.behind is not None:
        visibility = inventory.behind.cycles_visibility
        visibility.camera = visibility.transmission


def scene_named(name: str | None):
    """The scene `name` of the open file; None: the scene that was active when it was saved. Raises SceneError."""
    if name is None:
        return bpy.context.scene
    if name not in bpy.data.scenes:
        scenes = listed(repr(scene.name) for scene in bpy.data.scenes)
        raise SceneError(f"scene {name!r} is not in the file; scenes there: {scenes}")
    return bpy.data.scenes[name]


def picture_facts(scene, job) -> dict:
    """Set the size of the picture of a `PixelJob` or `FinishedJob`; returns its entries of the manifest."""
    width, height = render_settings.set_resolution(scene, job.width, job.height)
    border = render_settings.render_border(scene)
    cropped = border is not None and border.cropped
    return {
        "width": border.width if cropped else width,
        "height": border.height if cropped else height,
        "border": None if border is None else vars(border),
        "pixel_aspect": scene.render.pixel_aspect_x / scene.render.pixel_aspect_y,
        "pixel_filter": render_settings.filter_name(scene),
        "film_transparent": scene.render.film_transparent,
        "exposure": scene.cycles.film_exposure,
        "color_space": render_settings.working_space(),
    }
