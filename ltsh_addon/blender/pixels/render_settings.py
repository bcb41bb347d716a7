"""Settings of the renders that take samples and references (run in the child, on the copy of the scene in memory)."""

from __future__ import annotations

import errno
from pathlib import Path

import bpy

from ...shading.workers import cores
from ..processes.child import SceneError
from ..processes.missing_names import listed
from ..processes.whole_exr import is_whole
from .cameras import hold_still
from .inventory import SURFACE_TYPES

VIEW_LAYER = "ltsh"


def choose_view_layer(scene, warnings: list[str], name: str | None = None):
    """The only view layer that is rendered from now on: the one called `name`, or the first in use."""
    if name is not None and name not in scene.view_layers:
        layers = listed((layer.name for layer in scene.view_layers), name)
        raise SceneError(f"view layer {name!r} is not in scene {scene.name!r}; view layers there: {layers}")
    used = [layer for layer in scene.view_layers if layer.use] or [scene.view_layers[0]]
    if name is not None:
        used = [scene.view_layers[name]]
    if len(used) > 1:
        warnings.append(f"scene {scene.name!r}: only view layer {used[0].name!r} of {len(used)} is shaded")
    for layer in scene.view_layers:
        layer.use = layer == used[0]
    layer = used[0]
    layer.name = VIEW_LAYER
    # Passes that nobody reads, and that could have the names of those that are read.
    for extra in (layer.aovs, layer.lightgroups):
        for item in list(extra):
            extra.remove(item)
    return layer


def neutralize(scene, view_layer, camera, warnings: list[str]) -> None:
    """Switch off all that stands between one camera ray per sample and the passes, with a warning where it shows.

    What is left on purpose: the border, holdouts, material overrides and excluded or indirect-only collections, which
    samples and reference both show as any render does.
    """
    render, cycles = scene.render, scene.cycles
    for owner, name, label in (
        (render, "use_motion_blur", "motion blur"),
        (render, "use_multiview", "stereoscopy"),
        (camera.data.dof, "use_dof", f"depth of field of camera {camera.name!r}"),
    ):
        if getattr(owner, name):
            warnings.append(f"{label} is switched off, in the Cycles reference as well")
            setattr(owner, name, False)
    warnings.extend(_steps_after_rendering(scene))
    _leave_out_world(scene, view_layer, warnings)
    scene.camera = camera
    hold_still(scene, camera)
    render.engine = "CYCLES"
    render.threads_mode, render.threads = "FIXED", cores()
    render.use_compositing = render.use_sequencer = False
    # Alpha 0 then means a holdout and nothing else; the passes are the same.
    render.film_transparent = False
    render.use_freestyle = render.use_persistent_data = False
    render.use_file_extension = render.use_overwrite = True
    cycles.device = "CPU"
    # Multiplied into the result where it is read: the limits of the property and float32 have no say then.
    cycles.film_exposure = 1.0
    cycles.use_adaptive_sampling = cycles.use_denoising = cycles.use_sample_subset = False
    cycles.use_animated_seed = False
    cycles.time_limit = 0.0
    cycles.max_bounces = 0
    cycles.sample_clamp_direct = cycles.sample_clamp_indirect = cycles.blur_glossy = 0.0
    cycles.light_sampling_threshold = 0.0
    cycles.caustics_reflective = True
    view_layer.samples = 0


def _steps_after_rendering(scene) -> list[str]:
    """Warnings about what Blender would do to the rendered picture and is switched off."""
    render, found = scene.render, []
    if render.use_freestyle:
        found.append("Freestyle")
    if bpy.app.version >= (5, 0, 0):
        tree = scene.compositing_node_group
    else:
        tree = scene.node_tree if scene.use_nodes else None
    if render.use_compositing and tree is not None:
        found.append(f"compositing by {tree.name!r}")
    editor = scene.sequence_editor
    if render.use_sequencer and editor is not None and len(editor.strips):
        found.append("the video sequencer")
    return [f"scene {scene.name!r}: {step} is switched off, the passes are as rendered" for step in found]


def _leave_out_world(scene, view_layer, warnings: list[str]) -> None:
    world = view_layer.world_override or scene.world
    if world is not None and _world_shines(world):
        warnings.append(f"world {world.name!r}: its light is not shaded; left out of the Cycles reference as well")
    view_layer.world_override = scene.world = None


def _world_shines(world) -> bool:
    tree = world.node_tree
    if bpy.app.version < (5, 0, 0) and not world.use_nodes:
        return max(world.color) > 0.0
    for node in tree.nodes if tree else ():
        if node.bl_idname == "ShaderNodeBackground":
            color, strength = node.inputs["Color"], node.inputs["Strength"]
            dark = not color.is_linked and max(color.default_value[:3]) <= 0.0
            if not dark and (strength.is_linked or strength.default_value > 0.0):
                return True
    return False


def leave_out_objects(scene, names: set[str], warnings: list[str]) -> None:
    """Take the objects `names` and all volumes out of every collection; children keep their parents."""
    for ob in bpy.data.objects:
        if ob.type == "VOLUME" and ob.name_full in {other.name_full for other in scene.objects}:
            warnings.append(f"volume {ob.name!r} is not shaded; left out of the Cycles reference as well")
        elif ob.name_full not in names:
            continue
        ob.hide_render = True
        for collection in list(ob.users_collection):
            collection.objects.unlink(ob)


def prepare_surfaces(warnings: list[str]) -> None:
    """Object settings that change how a surface itself is shaded."""
    for ob in bpy.data.objects:
        if ob.type == "LIGHT":
            ob.visible_camera = False
        if ob.type not in SURFACE_TYPES:
            continue
        if ob.is_shadow_catcher:
            warnings.append(f"object {ob.name!r}: shadow catcher is switched off, it is shaded like any surface")
            ob.is_shadow_catcher = False
        if ob.shadow_terminator_shading_offset:
            warnings.append(f"object {ob.name!r}: the shading offset of its shadow terminator is switched off")
            ob.shadow_terminator_shading_offset = 0.0


def enable_passes(view_layer, names: tuple[str, ...]) -> None:
    """Switch on the passes `use_pass_<name>`, all others off."""
    for attribute in dir(view_layer):
        if attribute.startswith("use_pass_"):
            setattr(view_layer, attribute, attribute[len("use_pass_") :] in names)


def render_exr(scene, path: Path) -> None:
    """Render `scene` into the multi-layer float EXR `path`. Raises SceneError, and OSError where the disk is full."""
    settings = scene.render.image_settings
    if bpy.app.version >= (5, 0, 0):
        settings.media_type = "MULTI_LAYER_IMAGE"
    settings.file_format = "OPEN_EXR_MULTILAYER"
    if hasattr(settings, "use_exr_interleave"):
        settings.use_exr_interleave = True
    settings.color_depth, settings.exr_codec = "32", "ZIP"
    scene.render.filepath = str(path)
    bpy.ops.render.render(write_still=True, scene=scene.name)
    if not path.is_file():
        raise SceneError(f"Blender rendered scene {scene.name!r} but wrote no {path.name}")
    if not is_whole(path):
        raise OSError(errno.ENOSPC, f"{path.name} was not written whole")


def pass_names() -> dict[str, str]:
    """Names of the passes in the EXR, which changed with 5.0."""
    if bpy.app.version >= (5, 0, 0):
        return {
            "specular_light": "Glossy Direct",
            "specular_color": "Glossy Color",
            "diffuse_light": "Diffuse Direct",
            "diffuse_color": "Diffuse Color",
            "emission": "Emission",
        }
    return {
        "specular_light": "GlossDir",
        "specular_color": "GlossCol",
        "diffuse_light": "DiffDir",
        "diffuse_color": "DiffCol",
        "emission": "Emit",
    }
