"""The child's task: open a .blend, edit it in memory, render samples and reference, describe all in manifest.json."""

from __future__ import annotations

import time
from pathlib import Path

import bpy
import numpy as np

from ..lights.area_lights import LightInventory, collect_lights, seen_lights
from ..materials.material_outputs import (
    MaterialReport,
    give_default_material,
    inject_aovs,
    materials_in_use,
    objects_without_material,
)
from ..processes import blend_header, memory
from ..processes.child import SceneError
from ..processes.missing_files import missing_files
from ..processes.missing_names import listed
from . import cameras, render_settings
from .color_management import working_space
from .cycles_reference import render_reference
from .inventory import rendered_surfaces, with_render_depsgraph
from .pixel_filter import filter_name
from .pixel_samples import render_pixel_samples

_files_opened = 0


def files_opened() -> int:
    """How many times `open_scene` was called: what was read from a file holds until the next time."""
    return _files_opened


# So many of a kind are named in an error.
NAMED = 5


def open_scene(path: Path, warnings: list[str], scripts: bool = False) -> None:
    """Open the .blend `path` in memory; scripts in it run only if asked for."""
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
        raise SceneError(blend_header.newer(path, saved, here))
    if bpy.app.autoexec_fail:
        warnings.append(f"scripts in {path.name} do not run: {bpy.app.autoexec_fail_message}")
    warnings.extend(missing_files())


def _reason(error: RuntimeError, path: Path) -> str:
    """What Blender says is wrong with a file, without the file's name."""
    text = " ".join(str(error).split()).removeprefix("Error: ")
    for named in (f'Loading "{path}" failed: ', f"Failed to read blend file '{path}': ", f' in file "{path}"'):
        text = text.replace(named, "")
    return text


def prepare_scene(scene, view_layer, camera, warnings: list[str]) -> LightInventory:
    """Take the inventory, leave out what cannot be shaded and inject the sample outputs; the lights found."""
    render_settings.neutralize(scene, view_layer, camera, warnings)
    render_settings.prepare_surfaces(warnings)

    def visit(depsgraph):
        surfaces = rendered_surfaces(depsgraph)
        override = view_layer.material_override
        bare = [] if override else objects_without_material(surfaces)
        return collect_lights(depsgraph, override), materials_in_use(surfaces, override), bare

    inventory, materials, bare = with_render_depsgraph(scene, visit)
    default = give_default_material(bare)
    report = MaterialReport()
    inject_aovs(materials + ([default] if default else []), report, inventory.emitting_materials)
    inventory.receivers.mark()
    inventory.lights = seen_lights(scene, inventory)
    warnings.extend(inventory.warnings)
    if not inventory.lights:
        raise no_light(scene, inventory.warnings)
    warnings.extend(report.lines())
    render_settings.leave_out_objects(scene, inventory.left_out, warnings)
    return inventory


def no_light(scene, reasons: list[str]) -> SceneError:
    """The error of a scene in which no light can be shaded, with the first `reasons`."""
    found = [f"{ob.name!r} ({ob.data.type})" for ob in scene.objects if ob.type == "LIGHT"]
    text = f"found lights {_some(found, ', ')}" if found else "found no lights at all"
    if reasons:
        text += f" ({_some([line.partition('; left out')[0] for line in reasons], '; ')})"
    return SceneError(f"scene {scene.name!r}: no area light that renders, {text}; add an area light")


def _some(items: list[str], separator: str) -> str:
    more = [f"and {len(items) - NAMED} more"] if len(items) > NAMED else []
    return separator.join([*items[:NAMED], *more])


def extract(job: dict, folder: Path, progress) -> dict:
    """Do the `job` (see `child.extract`), write EXRs into `folder`; the manifest as a dictionary."""
    started, warnings, seconds = time.monotonic(), [], {}
    progress("open scene", 0.0)
    open_scene(Path(job["scene"]), warnings, job.get("scripts", False))
    scene = _scene_named(job.get("scene_name"))
    cameras.go_to_frame(scene, job["frame"])
    camera = cameras.choose_camera(scene, job["camera"])
    view_layer = render_settings.choose_view_layer(scene, warnings, job.get("view_layer"))
    picture = _picture(scene, job)
    if job.get("techniques"):
        size, compared = (picture["width"], picture["height"]), job["cycles_samples"] > 0
        memory.check(*size, job["sub_samples"], job["techniques"], compared, job["memory_mib"])
    inventory = prepare_scene(scene, view_layer, camera, warnings)
    seconds["start"] = time.monotonic() - started

    started = time.monotonic()
    extra_passes = ("emit",) if job.get("emission") else ()
    samples = render_pixel_samples(scene, view_layer, folder, job["sub_samples"], progress, extra_passes)
    seconds["samples"] = time.monotonic() - started

    started, reference = time.monotonic(), None
    if job["cycles_samples"] > 0:
        reference = render_reference(scene, view_layer, folder, job["cycles_samples"], job["sub_samples"], progress)
    seconds["cycles"] = time.monotonic() - started
    return {
        "blender_version": bpy.app.version_string,
        "frame": scene.frame_current,
        "camera": camera.name,
        **picture,
        "lights": [light_record(light) for light in inventory.lights],
        "warnings": warnings,
        "samples": samples,
        "reference": reference,
        "passes": render_settings.pass_names(),
        "seconds": seconds,
    }


def _scene_named(name: str | None):
    """The scene `name` of the open file; None: the one it was saved with."""
    if name is None:
        return bpy.context.scene
    if name not in bpy.data.scenes:
        scenes = listed((scene.name for scene in bpy.data.scenes), name)
        raise SceneError(f"scene {name!r} is not in the file; scenes there: {scenes}")
    return bpy.data.scenes[name]


def _picture(scene, job: dict) -> dict:
    """Set the size; what the manifest says about the picture."""
    width, height = cameras.set_resolution(scene, job["width"], job["height"])
    border = cameras.render_border(scene)
    cropped = border is not None and border.cropped
    return {
        "width": border.width if cropped else width,
        "height": border.height if cropped else height,
        "border": None if border is None else vars(border),
        "pixel_aspect": scene.render.pixel_aspect_x / scene.render.pixel_aspect_y,
        "pixel_filter": filter_name(scene),
        "exposure": scene.cycles.film_exposure,
        "color_space": working_space(),
    }


def light_record(light) -> dict:
    """`light` as JSON has it; AreaLight(**record) reads it back."""
    record = {name: value.tolist() if isinstance(value, np.ndarray) else value for name, value in vars(light).items()}
    return {**record, "detail": [light_record(part) for part in light.detail]}
