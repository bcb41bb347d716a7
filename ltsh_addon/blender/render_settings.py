"""Settings of the renders that take samples and references (run in the child, on the copy of the scene in memory)."""

from __future__ import annotations

from contextlib import contextmanager
from pathlib import Path

import bpy
import numpy as np

from .child import SceneError
from .inventory import SURFACE_TYPES

VIEW_LAYER = "ltsh"
CAMERA_TYPES = ("PERSP", "ORTHO")
# In pixels. The interface ends at 0.01, which is too wide: reference rays then cross edges that the central sample
# does not (measured: 1 % of the pixels of a detailed picture, 6 % relative L2). What
# remains: 1 in 1000 rays per axis strays by up to half a pixel, by the first cell of Cycles' filter table.
CENTER_FILTER_WIDTH = 1e-6


def choose_camera(scene, name: str | None):
    """The camera object to render from: by `name`, or the scene's."""
    if name is None:
        camera = scene.camera
        if camera is None:
            raise SceneError(f"scene {scene.name!r} has no active camera: set one, or name one")
    else:
        camera = scene.objects.get(name)
        if camera is None or camera.type != "CAMERA":
            cameras = ", ".join(repr(ob.name) for ob in scene.objects if ob.type == "CAMERA") or "none"
            raise SceneError(f"camera {name!r} is not in scene {scene.name!r}; cameras there: {cameras}")
    if camera.type != "CAMERA":
        raise SceneError(
            f"scene {scene.name!r}: its camera {camera.name!r} is a {camera.type} object, expected a camera"
        )
    if camera.data.type not in CAMERA_TYPES:
        raise SceneError(
            f"camera {camera.name!r} is of type {camera.data.type}, expected a perspective or orthographic one"
        )
    scene.camera = camera
    return camera


def choose_view_layer(scene, warnings: list[str]):
    """The only view layer that is rendered from now on."""
    used = [layer for layer in scene.view_layers if layer.use] or [scene.view_layers[0]]
    if len(used) > 1:
        warnings.append(f"scene {scene.name!r}: only view layer {used[0].name!r} of {len(used)} is shaded")
    for layer in scene.view_layers:
        layer.use = layer == used[0]
    used[0].name = VIEW_LAYER
    return used[0]


def set_resolution(scene, width: int | None, height: int | None) -> tuple[int, int]:
    """Set and return the size of the picture in pixels; a missing side keeps the file's aspect."""
    render = scene.render
    own_width = max(1, int(render.resolution_x * render.resolution_percentage / 100))
    own_height = max(1, int(render.resolution_y * render.resolution_percentage / 100))
    if width is None and height is None:
        width, height = own_width, own_height
    elif width is None:
        width = max(1, round(height * own_width / own_height))
    elif height is None:
        height = max(1, round(width * own_height / own_width))
    render.resolution_x, render.resolution_y, render.resolution_percentage = width, height, 100
    if (render.resolution_x, render.resolution_y) != (width, height):
        raise SceneError(
            f"resolution {width}x{height} is not possible in Blender, the nearest is "
            f"{render.resolution_x}x{render.resolution_y}"
        )
    return width, height


def neutralize(scene, view_layer, camera, warnings: list[str]) -> None:
    """Switch off all that stands between one camera ray per sample and the passes, with a warning where it shows."""
    render, cycles = scene.render, scene.cycles
    for owner, name, label in (
        (render, "use_border", "the render region"),
        (render, "use_motion_blur", "motion blur"),
        (render, "use_multiview", "stereoscopy"),
        (camera.data.dof, "use_dof", f"depth of field of camera {camera.name!r}"),
    ):
        if getattr(owner, name):
            warnings.append(f"{label} is switched off, in the Cycles reference as well")
            setattr(owner, name, False)
    _leave_out_world(scene, view_layer, warnings)
    scene.camera = camera
    _hold_lens_still(camera)
    render.engine = "CYCLES"
    render.threads_mode = "AUTO"
    render.use_compositing = render.use_sequencer = render.film_transparent = False
    render.use_freestyle = render.use_persistent_data = False
    render.use_file_extension = render.use_overwrite = True
    cycles.device = "CPU"
    cycles.film_exposure = 1.0
    cycles.use_adaptive_sampling = cycles.use_denoising = cycles.use_sample_subset = False
    cycles.use_animated_seed = False
    cycles.time_limit = 0.0
    cycles.max_bounces = 0
    cycles.sample_clamp_direct = cycles.sample_clamp_indirect = cycles.blur_glossy = 0.0
    cycles.light_sampling_threshold = 0.0
    cycles.caustics_reflective = True
    view_layer.samples = 0


def _hold_lens_still(camera) -> None:
    """Keep the lens at its values of this frame: an animated shift would undo `shifted_pixels`."""
    if camera.data.animation_data is not None:
        camera.data.animation_data_clear()


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
        for name, label in (("is_shadow_catcher", "shadow catcher"), ("is_holdout", "holdout")):
            if getattr(ob, name):
                warnings.append(f"object {ob.name!r}: {label} is switched off")
                setattr(ob, name, False)
        if ob.shadow_terminator_shading_offset:
            warnings.append(f"object {ob.name!r}: the shading offset of its shadow terminator is switched off")
            ob.shadow_terminator_shading_offset = 0.0


def pin_pixel_filter(scene) -> None:
    """Put all camera rays of a pixel through its center; sub-samples come from shifting the camera."""
    cycles = scene.cycles
    cycles.pixel_filter_type = "GAUSSIAN"
    # Written past the property's limits, into what stores it.
    stored = cycles.bl_system_properties_get(do_create=True) if bpy.app.version >= (5, 0, 0) else cycles
    stored["filter_width"] = CENTER_FILTER_WIDTH


def sub_pixel_offsets(count: int) -> np.ndarray:
    """Offsets (count, 2) from the pixel's center, right and up, in pixels: evenly over the pixel, 0 for a single one.

    The R2 sequence (Roberts 2018, "The Unreasonable Effectiveness of Quasirandom Sequences").
    """
    if count == 1:
        return np.zeros((1, 2))
    steps = np.array([0.7548776662466927, 0.5698402909980532])
    return (np.arange(count)[:, None] * steps + 0.5) % 1.0 - 0.5


@contextmanager
def shifted_pixels(scene, offset: np.ndarray):
    """Meanwhile the rays of `scene` go through the points `offset` (2,) pixels from the pixels' centers."""
    render, lens = scene.render, scene.camera.data
    width, height = render.resolution_x * render.pixel_aspect_x, render.resolution_y * render.pixel_aspect_y
    fits_width = lens.sensor_fit == "HORIZONTAL" or (lens.sensor_fit == "AUTO" and width >= height)
    unit = width if fits_width else height
    before = lens.shift_x, lens.shift_y
    try:
        lens.shift_x += offset[0] * render.pixel_aspect_x / unit
        lens.shift_y += offset[1] * render.pixel_aspect_y / unit
        yield
    finally:
        lens.shift_x, lens.shift_y = before


def enable_passes(view_layer, names: tuple[str, ...]) -> None:
    """Switch on the passes `use_pass_<name>`, all others off."""
    for attribute in dir(view_layer):
        if attribute.startswith("use_pass_"):
            setattr(view_layer, attribute, attribute[len("use_pass_") :] in names)


def render_exr(scene, path: Path) -> None:
    """Render `scene` into the multi-layer float EXR `path`."""
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


def pass_names() -> dict[str, str]:
    """Names of the passes in the EXR, which changed with 5.0."""
    if bpy.app.version >= (5, 0, 0):
        return {
            "specular_light": "Glossy Direct",
            "specular_color": "Glossy Color",
            "diffuse_light": "Diffuse Direct",
            "diffuse_color": "Diffuse Color",
        }
    return {
        "specular_light": "GlossDir",
        "specular_color": "GlossCol",
        "diffuse_light": "DiffDir",
        "diffuse_color": "DiffCol",
    }
