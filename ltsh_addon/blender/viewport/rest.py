"""The rest of a view's light: bounces, reflections, refraction, and materials that only Cycles knows.

A view shows LTSH's direct light and, of surfaces that it cannot resolve, a guess. A second Blender renders the same
view with Cycles, `render_rest`. What the view draws itself is taken out of each of its samples, so that its noise goes
with it; what remains is denoised and added to the view.

Surfaces `is_of_cycles` are Cycles' alone. An AOV tells their share m of a pixel, and the view draws the same share M:

    rest = Combined - (1 - m) (direct light + background),  picture = (1 - M) (own light + background) + rest
"""

from __future__ import annotations

from pathlib import Path

import bpy
from mathutils import Matrix

from .. import render_settings
from ..extract.finished import reasons_for_cycles
from ..extract.pixels import open_scene, scene_named
from ..materials.graph import ensure_nodes, live_link, material_output, tree_in_use
from ..materials.preview_material import preview_of
from ..process.view import REST_PICTURE, RestJob
from ..render_settings import render_exr

# MASK: the AOV with the share of a pixel that is Cycles' alone. SENSOR: the width of the camera's sensor in mm.
MASK, SENSOR = "ltsh_of_cycles", 36.0
CAMERA = "LTSH view"
PASSES = ("combined", "diffuse_direct", "diffuse_color", "glossy_direct", "glossy_color", "environment")
# Pairs of properties: what views take, and what renders take.
LEVELS = (
    ("show_viewport", "show_render"),
    ("levels", "render_levels"),
    ("resolution_u", "render_resolution_u"),
    ("resolution_v", "render_resolution_v"),
    ("resolution", "render_resolution"),
    ("show_instancer_for_viewport", "show_instancer_for_render"),
    ("simplify_subdivision", "simplify_subdivision_render"),
    ("simplify_child_particles", "simplify_child_particles_render"),
)


# In the child:


def render_rest(job: RestJob, folder: Path, progress) -> dict:
    """Do the `job`: writes REST_PICTURE into `folder`. Returns the manifest."""
    warnings: list[str] = []
    if job.scene is not None:
        progress("open scene", 0.0)
        open_scene(Path(job.scene), warnings, job.scripts)
        scene = scene_named(job.scene_name)
        render_settings.go_to_frame(scene, job.frame)
        layer = render_settings.only_view_layer(scene, warnings, job.view_layer)
        _show_as_views(scene, layer, job.hidden)
        _prepare(scene, layer)
    scene = scene_named(job.scene_name)
    layer = next(layer for layer in scene.view_layers if layer.use)
    if job.matrices is None:
        camera = render_settings.choose_camera(scene, job.camera)
        camera.data.dof.use_dof = False
        render_settings.set_resolution(scene, job.width, job.height)
    else:
        _look_through(scene, *map(Matrix, job.matrices), (job.width, job.height))
    scene.cycles.samples, scene.cycles.seed = job.samples, job.seed
    progress("bounces", 0.0)
    render_exr(scene, folder / REST_PICTURE, "NONE")
    return {
        "samples": job.samples,
        "mask": MASK,
        "passes": render_settings.pass_names(),
        "everything": _reasons_for_cycles(scene, layer),
    }


def _show_as_views(scene, layer, hidden: tuple[str, ...]) -> None:
    """Let renders show what views show, in their detail; but for the objects `hidden`."""
    shown = {ob for ob in layer.objects if ob.visible_get(view_layer=layer) and ob.name not in hidden}
    for collection in bpy.data.collections:
        collection.hide_render = False
    for ob in bpy.data.objects:
        ob.hide_render = ob not in shown if ob.name in layer.objects else ob.hide_viewport
        details = [ob, *ob.modifiers, *(() if ob.data is None else (ob.data,))]
        for owner in details:
            _take_levels(owner)
    _take_levels(scene.render)


def _take_levels(owner) -> None:
    """Let renders take the values of LEVELS that views take."""
    for name, of_renders in LEVELS:
        if hasattr(owner, name) and hasattr(owner, of_renders):
            setattr(owner, of_renders, getattr(owner, name))


def _prepare(scene, layer) -> None:
    """Let Cycles write what the rest is made of."""
    render, cycles = scene.render, scene.cycles
    if scene.animation_data is not None:
        scene.animation_data_clear()
    render.engine = "CYCLES"
    render.threads_mode, render.threads = "FIXED", render_settings.cores()
    for name in ("compositing", "sequencer", "multiview", "motion_blur", "border", "freestyle"):
        setattr(render, f"use_{name}", False)
    render.use_file_extension = render.use_overwrite = render.use_persistent_data = True
    render.film_transparent = False
    cycles.device, cycles.film_exposure, cycles.time_limit, layer.samples = "CPU", 1.0, 0.0, 0
    cycles.use_denoising = cycles.use_animated_seed = cycles.use_sample_subset = cycles.use_adaptive_sampling = False
    cycles.shading_system = False  # AOVs need it
    for extra in (layer.aovs, layer.lightgroups):
        for item in list(extra):
            extra.remove(item)
    render_settings.enable_passes(layer, PASSES)
    layer.cycles.denoising_store_passes = True
    aov = layer.aovs.add()
    aov.name, aov.type = MASK, "VALUE"
    for material in bpy.data.materials:
        if not material.is_grease_pencil:
            mark(material)


def mark(material) -> None:
    """Let `material` write MASK, if it is Cycles' alone."""
    if not preview_of(material).is_of_cycles:
        return
    ensure_nodes(material)
    node = material.node_tree.nodes.new("ShaderNodeOutputAOV")
    node.aov_name = MASK
    node.inputs["Value"].default_value = 1.0


def _reasons_for_cycles(scene, layer) -> list[str]:
    """Why the whole picture is Cycles': what views cannot draw between the eye and the surfaces."""
    shown = [ob for ob in scene.objects if not ob.hide_render]
    hair = [f"hair or points of {ob.name!r}" for ob in shown if _has_hair(ob)]
    materials = {slot.material for ob in shown for slot in ob.material_slots} - {None}
    volumes = [f"the volume of material {material.name!r}" for material in materials if _has_volume(material)]
    return [*reasons_for_cycles(scene, layer), *hair, *volumes]


def _has_volume(material) -> bool:
    output = None if tree_in_use(material) is None else material_output(material.node_tree)
    return output is not None and live_link(output.inputs["Volume"]) is not None


def _has_hair(ob) -> bool:
    return ob.type in ("CURVES", "POINTCLOUD") or any(each.settings.type == "HAIR" for each in ob.particle_systems)


def _look_through(scene, view: Matrix, window: Matrix, size: tuple[int, int]) -> None:
    """Let the scene have the camera of a region with these matrices and this size."""
    camera = scene.objects.get(CAMERA)
    if camera is None:
        camera = bpy.data.objects.new(CAMERA, bpy.data.cameras.new(CAMERA))
        scene.collection.objects.link(camera)
    (width, height), lens, render = size, camera.data, scene.render
    is_parallel = window[3][3] == 1.0
    place = view.inverted()
    column, sign = (3, -1.0) if is_parallel else (2, 1.0)
    lens.sensor_fit, lens.sensor_width = "HORIZONTAL", SENSOR
    lens.shift_x = 0.5 * sign * window[0][column]
    lens.shift_y = 0.5 * sign * window[1][column] * height / width
    if is_parallel:
        lens.type, lens.ortho_scale = "ORTHO", 2.0 / window[0][0]
        near, far = ((sign - window[2][3]) / window[2][2] for sign in (-1.0, 1.0))  # along z of the view
        place = place @ Matrix.Translation((0.0, 0.0, near))
        lens.clip_start, lens.clip_end = 1e-6, near - far
    else:
        lens.type, lens.lens = "PERSP", 0.5 * SENSOR * window[0][0]
        lens.clip_start = window[2][3] / (window[2][2] - 1.0)
        lens.clip_end = window[2][3] / (window[2][2] + 1.0)
    camera.matrix_world = place
    scene.camera = camera
    render.resolution_x, render.resolution_y, render.resolution_percentage = width, height, 100
    render.pixel_aspect_x = render.pixel_aspect_y = 1.0
