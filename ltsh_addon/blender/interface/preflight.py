"""What would go wrong with a job, told before the click. Reads the scene as it is and changes nothing."""

from __future__ import annotations

import os
from dataclasses import dataclass, field
from pathlib import Path

import bpy

from ..lights.emission_nodes import emission_behind
from ..materials.shader_graph import material_output
from ..pixels.cameras import CAMERA_KINDS, CAMERA_TYPES, picture_size
from ..texels.texel_bake import ObjectError, check_object
from .availability import missing_libraries


@dataclass(frozen=True)
class Problem:
    """One thing to know; `fix` is the operator that mends it, with its label and properties."""

    text: str
    blocks: bool = True
    fix: str = ""
    fix_label: str = ""
    fix_values: dict = field(default_factory=dict)


def problems(context, command: str) -> list[Problem]:
    """What stands in the way of "shade", "compare" or "bake" (`blocks`), and what is good to know."""
    scene, settings = context.scene, context.scene.ltsh
    found = _packages()
    if not settings.techniques:
        found.append(Problem("No technique is chosen: choose at least one"))
    if not (settings.bake_passes if command == "bake" else settings.passes):
        found.append(Problem("No pass is chosen: choose at least one"))
    needs_camera = command != "bake" or settings.bake_view == "camera"
    found += _camera(scene) if needs_camera else []
    found += _lights(scene)
    if command == "bake":
        found += bake_objects(context)[1]
    elif min(picture_of(scene)) < 4:
        found.append(Problem("The picture is smaller than 4 pixels: raise the resolution"))
    return found + _files(settings)


def blocking(context, command: str) -> str:
    """The first reason why `command` cannot run, "" where it can."""
    return next((problem.text for problem in problems(context, command) if problem.blocks), "")


def picture_of(scene) -> tuple[int, int]:
    """Width and height to shade, in pixels."""
    share = scene.ltsh.resolution_percentage / 100.0
    width, height = picture_size(scene)
    return max(1, round(width * share)), max(1, round(height * share))


def bake_objects(context) -> tuple[list, list[Problem]]:
    """Selected objects that can be baked, and what is wrong with the others."""
    selected = [ob for ob in context.selected_objects if ob.type == "MESH"]
    if not selected:
        return [], [Problem("No mesh is selected: select the objects to bake")]
    usable, found = [], []
    for ob in selected:
        problem = _object_problem(ob, context.scene.ltsh.bake_uv_map)
        if problem is None:
            usable.append(ob)
        else:
            found.append(problem)
    if usable:
        found = [Problem(p.text, False, p.fix, p.fix_label, p.fix_values) for p in found]
    return usable, found


def _object_problem(ob, uv_map: str) -> Problem | None:
    if ob.hide_render:
        text = f"Object {ob.name!r} is hidden in renders"
        return Problem(text, True, "ltsh.show_in_render", "Show", {"object_name": ob.name})
    try:
        check_object(ob)
    except ObjectError as error:
        return Problem(_sentence(str(error)))
    if not ob.data.polygons and not ob.modifiers:
        return Problem(f"Object {ob.name!r} has no faces")
    if uv_map and uv_map not in ob.data.uv_layers and ob.data.uv_layers:
        names = ", ".join(repr(layer.name) for layer in ob.data.uv_layers)
        return Problem(f"Object {ob.name!r} has no UV map {uv_map!r}, found {names}")
    if not ob.data.uv_layers and not any(modifier.type == "NODES" for modifier in ob.modifiers):
        text = f"Object {ob.name!r} has no UV map"
        return Problem(text, True, "ltsh.add_uv_map", "Unwrap", {"object_name": ob.name})
    return None


def _sentence(text: str) -> str:
    return text[:1].upper() + text[1:]


def _packages() -> list[Problem]:
    missing = missing_libraries()
    return [Problem(missing)] if missing else []


def _camera(scene) -> list[Problem]:
    camera = scene.camera
    if camera is None or camera.type != "CAMERA":
        return [Problem("The scene has no active camera", True, "ltsh.add_camera", "Add Camera")]
    if camera.data.type not in CAMERA_TYPES:
        kind = CAMERA_KINDS.get(camera.data.type, camera.data.type)
        text = f"Camera {camera.name!r} is {kind}, expected perspective or orthographic"
        return [Problem(text, True, "ltsh.make_perspective", "Make Perspective")]
    return []


def _lights(scene) -> list[Problem]:
    areas = [ob for ob in scene.objects if ob.type == "LIGHT" and ob.data.type == "AREA"]
    if any(not ob.hide_render for ob in areas) or any(glows(material) for material in materials_of(scene)):
        return []
    if areas:
        text = f"Light {areas[0].name!r} is hidden in renders, and no other area light is there"
        return [Problem(text, True, "ltsh.show_in_render", "Show", {"object_name": areas[0].name})]
    others = [ob.name for ob in scene.objects if ob.type == "LIGHT"]
    if others:
        text = f"No area light: {others[0]!r} is a light of another kind, which is not shaded"
    else:
        text = "No area light"
    return [Problem(text, True, "ltsh.add_area_light", "Add Light")]


def materials_of(scene) -> list:
    """Materials of the objects of `scene` that render, each once, in the order of their names."""
    found = {}
    for ob in scene.objects:
        if not ob.hide_render and ob.type not in ("LIGHT", "CAMERA"):
            for slot in ob.material_slots:
                if slot.material is not None:
                    found[slot.material.name_full] = slot.material
    return [found[name] for name in sorted(found)]


def glows(material) -> bool:
    """True where the surface of the material may emit light."""
    output = material_output(material.node_tree) if material.node_tree is not None else None
    return output is not None and emission_behind(material.node_tree, output.inputs["Surface"]).emits


def _files(settings) -> list[Problem]:
    found = []
    if not bpy.data.filepath:
        text = "The file is not saved: results go to the output folder of the preferences"
        found.append(Problem(text, False, "wm.save_mainfile", "Save"))
    elif (reason := _not_writable(settings.output_folder)) != "":
        found.append(Problem(reason))
    for image in bpy.data.images:
        if image.is_dirty and image.users > image.use_fake_user and "ltsh_layer" not in image:
            text = f"Image {image.name!r} has changes that are not saved, and do not count"
            found.append(Problem(text, False, "ltsh.pack_image", "Pack", {"image_name": image.name}))
    return found


def _not_writable(folder: str) -> str:
    path = Path(bpy.path.abspath(folder or "//"))
    existing = next((parent for parent in (path, *path.parents) if parent.exists()), None)
    if existing is None or not existing.is_dir() or not os.access(existing, os.W_OK):
        return f"Output folder {folder!r} cannot be written: choose another"
    return ""
