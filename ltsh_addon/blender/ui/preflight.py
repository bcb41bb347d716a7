"""Checks before a job starts: problems that block it, with buttons that fix them, and which lights and materials are
exact.

Lights and materials are read from the nodes without evaluating the scene, so it takes no time. The report of a job
also knows about instances, textures and the state of the render.
"""

import functools
import math
import os
import platform
from dataclasses import dataclass, field, replace
from pathlib import Path

import bpy
import numpy as np
from bpy.props import StringProperty

from ...pipeline.lightmap import announced
from ...pipeline.options import BakeOptions
from ...scene import ATLAS, SceneError, error_line, listed
from ..evaluated import objects_in_renders
from ..extract.apply import shows_texture
from ..extract.atlas import make_atlas
from ..extract.bake_meshes import ObjectError, check_object
from ..extract.bounces import rows_of_lights
from ..lights.area import LightInventory, node_light, reason_to_leave_out
from ..lights.area import note_unsupported as note_unsupported_light
from ..lights.emission import emission_of
from ..lights.world import may_shine
from ..materials.aovs import materials_of, notes_of_material
from ..materials.bsdfs import bsdf_of, is_emission
from ..materials.graph import shaders_behind, surface_of
from ..materials.preview_material import preview_of
from ..render_settings import CAMERA_KINDS, CAMERA_TYPES, picture_size
from . import results
from .preview import ENGINE, LTSHOperator, lights_of, view_of

EXACT, APPROXIMATED, LEFT_OUT = "exact", "approximated", "left out"
UNWRAPPED_SIDE = 128  # the least texels a side for which islands of an object keep their distance
OF_MIRRORS = "it reflects lights and the world, and is black where it would show anything else"


@functools.cache
def missing_libraries() -> str | None:
    """One line that says what is missing and what to do; None if nothing is.

    Checked once, since panels ask with every redraw. A library installed later is found when the add-on is enabled
    again.
    """
    try:
        import OpenEXR

        OpenEXR.File  # noqa: B018 - a namespace left by an incomplete removal imports too
    except (ImportError, AttributeError) as error:
        version = ".".join(platform.python_version_tuple()[:2])
        return (
            f"OpenEXR cannot be imported ({error_line(error)}): install the LTSH zip for "
            f"{platform.system()} {platform.machine()} and Python {version}; only Preview with LTSH works without"
        )
    return None


@dataclass(frozen=True)
class Problem:
    """A problem, and the operator that fixes it."""

    text: str
    blocks: bool = True  # the job cannot start; False: only a note
    fix: str = ""  # identifier of the operator; "": none
    fix_label: str = ""
    fix_values: dict = field(default_factory=dict)  # properties of the operator


def problems(context, command: str) -> list[Problem]:
    """The problems that block "shade", "compare" or "bake", and notes."""
    scene, settings = context.scene, context.scene.ltsh
    missing = missing_libraries()
    result = [Problem(missing)] if missing else []
    if command == "compare" and not settings.techniques:
        result.append(Problem("No technique is chosen: choose at least one to compare"))
    if command == "bake" and not settings.bake_passes:
        result.append(Problem("No pass is chosen: choose at least one"))
    needs_camera = command != "bake" or settings.bake_view == "camera"
    result += _camera(scene) if needs_camera else []
    result += _lights(scene, objects_in_renders(context.view_layer))
    if command == "bake":
        result += bake_objects(context)[1] + [Problem(line, False) for line in _announced(scene)]
    elif min(picture_of(scene)) < 4:
        result.append(Problem("The picture is smaller than 4 pixels: raise the resolution"))
    return result + _files(settings)


def _announced(scene) -> list[str]:
    """What the bake will take, as the command line tells it."""
    settings, side = scene.ltsh, int(scene.ltsh.bake_size)
    bounces, per_light = "on" if settings.bake_bounces else "off", settings.bake_per_light
    options = {"size": (side, side), "passes": tuple(settings.bake_passes), "bounces": bounces, "per_light": per_light}
    rows = rows_of_lights(scene) if per_light and settings.bake_bounces else 0
    return announced(BakeOptions(Path(), Path(), **options), rows)


def blocking(context, command: str) -> str:
    """The first reason why `command` cannot run; "" if it can."""
    return next((problem.text for problem in problems(context, command) if problem.blocks), "")


def picture_of(scene) -> tuple[int, int]:
    """Width and height to shade, in pixels."""
    share = scene.ltsh.resolution_percentage / 100.0
    width, height = picture_size(scene)
    return max(1, round(width * share)), max(1, round(height * share))


def bake_objects(context) -> tuple[list, list[Problem]]:
    """The selected objects that are checked and can be baked, and the problems of the others."""
    meshes = [ob for ob in context.selected_objects if ob.type == "MESH"]
    selected = [ob for ob in meshes if ob.ltsh_baked]
    if not meshes:
        return [], [Problem("No mesh is selected: select the objects to bake")]
    if not selected:
        return [], [Problem("No selected object is checked: check those to bake")]
    baked = [ob for ob in selected if shows_texture(ob) and not ob.hide_render]
    usable, problems, rendered = [], [], objects_in_renders(context.view_layer)
    if baked:  # one click restores them all
        which = f"Object {baked[0].name!r} shows a baked texture" if len(baked) == 1 else None
        text = f"{which or f'{len(baked)} objects show baked textures'} in place of "
        text += "its materials" if which else "their materials"
        problems.append(Problem(text, True, "ltsh.restore_materials", "Restore"))
    for ob in selected:
        if ob in baked:
            continue
        problem = _object_problem(ob, rendered, context.scene.ltsh)
        if problem is None:
            usable.append(ob)
        else:
            problems.append(problem)
    if usable:
        problems = [replace(problem, blocks=False) for problem in problems]
    if context.scene.ltsh.bake_atlas and (bare := [ob.name for ob in usable if ATLAS not in ob.data.uv_layers]):
        text = f"Not in the atlas yet: {listed(map(repr, bare))}"
        problems.append(Problem(text, True, "ltsh.make_atlas", "Make Atlas"))
    return usable, problems


def _object_problem(ob, rendered: set, settings) -> Problem | None:
    uv_map = settings.bake_uv_map
    if ob not in rendered:
        return _hidden(ob, f"Object {ob.name!r}")
    try:
        check_object(ob)
    except ObjectError as error:
        return Problem(str(error)[:1].upper() + str(error)[1:])
    if not ob.data.polygons and not ob.modifiers:
        return Problem(f"Object {ob.name!r} has no faces")
    if settings.bake_atlas:
        return None
    if uv_map and uv_map not in ob.data.uv_layers and ob.data.uv_layers:
        names = ", ".join(repr(layer.name) for layer in ob.data.uv_layers)
        return Problem(f"Object {ob.name!r} has no UV map {uv_map!r}, found {names}")
    if not ob.data.uv_layers and not any(modifier.type == "NODES" for modifier in ob.modifiers):
        text = f"Object {ob.name!r} has no UV map"
        return Problem(text, True, "ltsh.add_uv_map", "Unwrap", {"object_name": ob.name})
    return None


def _hidden(ob, name: str, more: str = "") -> Problem:
    """The problem of an object, called `name` in its text, that renders do not show."""
    if not ob.hide_render:
        return Problem(f"{name} is in a collection that renders do not show{more}")
    values = {"data_path": f"scene.objects[{ob.name!r}].hide_render", "value": False}
    return Problem(f"{name} is hidden in renders{more}", True, "wm.context_set_boolean", "Show", values)


def _camera(scene) -> list[Problem]:
    camera = scene.camera
    if camera is None or camera.type != "CAMERA":
        return [Problem("The scene has no active camera", True, "ltsh.add_camera", "Add Camera")]
    if camera.data.type not in CAMERA_TYPES:
        kind = CAMERA_KINDS.get(camera.data.type, camera.data.type)
        text = f"Camera {camera.name!r} is {kind}, expected perspective or orthographic"
        if camera.data.library is not None:
            return [Problem(f"{text}; it is linked from {camera.data.library.filepath}: make it local")]
        values = {"data_path": "scene.camera.data.type", "value": "PERSP"}
        return [Problem(text, True, "wm.context_set_enum", "Make Perspective", values)]
    return []


def _lights(scene, rendered: set) -> list[Problem]:
    lights = lights_of(scene)
    if may_shine(scene.world) or not rendered.isdisjoint(lights):
        return []
    if any(emission_of(material).emits for material in materials_of(scene)):
        return []
    if not lights:
        return [Problem("No light", True, "ltsh.add_light", "Add Light", {"selects": False})]
    return [_hidden(lights[0], f"Light {lights[0].name!r}", ", and no other light is there")]


def _files(settings) -> list[Problem]:
    problems = []
    if not bpy.data.filepath:
        text = "The file is not saved: results go to the output folder of the preferences"
        problems.append(Problem(text, False, "wm.save_mainfile", "Save"))
    elif (reason := _not_writable(settings.output_folder)) != "":
        problems.append(Problem(reason))
    for image in bpy.data.images:
        if image.is_dirty and image.users > image.use_fake_user and "ltsh_layer" not in image:
            text = f"Image {image.name!r} has changes that are not saved, and do not count"
            problems.append(Problem(text, False, "ltsh.pack_image", "Pack", {"image_name": image.name}))
    return problems


def _not_writable(folder: str) -> str:
    path = Path(bpy.path.abspath(folder or "//"))
    existing = next((parent for parent in (path, *path.parents) if parent.exists()), None)
    if existing is None or not existing.is_dir() or not os.access(existing, os.W_OK):
        return f"Output folder {folder!r} cannot be written: choose another"
    return ""


# The states of objects of a bake: text and icon.
BAKE_STATES = {
    "baking": ("Baking", "PLAY"),
    "done": ("Done", "CHECKMARK"),
    "unchanged": ("Unchanged", "CHECKMARK"),
    "failed": ("Failed", "ERROR"),
}


class LTSH_UL_baked(bpy.types.UIList):
    """The selected objects, with a check mark at those to bake"""

    def filter_items(self, context, data, name):
        """Selected meshes alone, those whose names have what is searched for."""
        wanted, selected = self.filter_name.lower(), set(context.selected_objects)
        shown = [ob.type == "MESH" and ob in selected and wanted in ob.name.lower() for ob in getattr(data, name)]
        return [self.bitflag_filter_item * is_shown for is_shown in shown], []

    def draw_item(self, context, layout, data, item, icon, active_data, active_property, index=0, flag=0):
        """The check mark and the name of an object."""
        row = layout.row(align=True)
        row.prop(item, "ltsh_baked", text="")
        row.label(text=item.name, icon="MESH_DATA", translate=False)
        scene, states = results.state["baked"]
        state = states.get(ATLAS if data.ltsh.bake_atlas else item.name)
        if scene == data.session_uid and state is not None:
            side = row.row()
            side.active, side.alignment = state in ("baking", "failed"), "RIGHT"
            side.label(text=BAKE_STATES[state][0], icon=BAKE_STATES[state][1])


class LTSH_OT_add_camera(LTSHOperator, bpy.types.Operator):
    """Add a camera that looks as the 3D viewport does, and make it the scene's active camera"""

    bl_label = "Add Camera"
    bl_options = {"REGISTER", "UNDO"}

    def execute(self, context):
        camera = bpy.data.objects.new("Camera", bpy.data.cameras.new("Camera"))
        context.collection.objects.link(camera)
        context.scene.camera = camera
        view = view_of(context)
        if view is not None:
            camera.matrix_world = view.region_3d.view_matrix.inverted()
        else:
            camera.location, camera.rotation_euler = (0.0, -6.0, 3.0), (math.radians(65.0), 0.0, 0.0)
        return {"FINISHED"}


class LTSH_OT_add_uv_map(LTSHOperator, bpy.types.Operator):
    """Unwrap the object into a new UV map (Smart UV Project)"""

    bl_label = "Unwrap"
    bl_options = {"REGISTER", "UNDO"}
    NEEDS_OBJECT_MODE = True

    object_name: StringProperty(name="Object", description="Name of the object")

    def execute(self, context):
        ob = context.view_layer.objects.get(self.object_name)
        if ob is None or ob.type != "MESH" or ob.hide_get():
            self.report({"ERROR"}, f"Object {self.object_name!r} is not a visible mesh of this view layer")
            return {"CANCELLED"}
        for problem in make_atlas([ob], UNWRAPPED_SIDE, name="UVMap")[1].values():
            self.report({"ERROR"}, problem)
            return {"CANCELLED"}
        return {"FINISHED"}


class LTSH_OT_make_atlas(LTSHOperator, bpy.types.Operator):
    """Unwrap the selected objects into one texture, on a UV map Lightmap that is added; all others stay.
    Objects that share a mesh get one each"""

    bl_label = "Make Atlas"
    bl_options = {"REGISTER", "UNDO"}
    NEEDS_OBJECT_MODE = True

    def execute(self, context):
        try:
            densities, problems = make_atlas(bake_objects(context)[0], int(context.scene.ltsh.bake_size))
        except SceneError as error:
            densities, problems = {}, {"": str(error)}
        for problem in problems.values():
            self.report({"WARNING" if densities else "ERROR"}, problem)
        if not densities:
            return {"CANCELLED"}
        self.report({"INFO"}, f"{len(densities)} objects, {min(densities.values()):.3g} texels per metre")
        return {"FINISHED"}


class LTSH_OT_pack_image(LTSHOperator, bpy.types.Operator):
    """Keep the changes of the image in the .blend"""

    bl_label = "Pack Image"
    bl_options = {"REGISTER", "UNDO"}

    image_name: StringProperty(name="Image", description="Name of the image")

    def execute(self, context):
        image = bpy.data.images.get(self.image_name)
        if image is None:
            self.report({"ERROR"}, f"Image {self.image_name!r} is not there any more")
            return {"CANCELLED"}
        image.pack()
        return {"FINISHED"}


@dataclass(frozen=True)
class Entry:
    """One light or material in the overview."""

    name: str
    kind: str  # shape of a light; "emissive" or "" for a material
    state: str  # EXACT, APPROXIMATED or LEFT_OUT
    notes: tuple[str, ...] = ()  # why it is not exact


@dataclass(frozen=True)
class Overview:
    """The lights and materials that the panels list."""

    lights: tuple[Entry, ...]
    materials: tuple[Entry, ...]


_known: dict[tuple, Overview] = {}


def overview(scene) -> Overview:
    """Lights and materials of `scene`; read again after any change of the file."""
    in_view = scene.render.engine == ENGINE
    key = scene.name, in_view, in_view and scene.ltsh_view.shows_bounces
    if key not in _known:
        _known[key] = Overview(
            tuple(_light(ob) for ob in scene.objects if ob.type == "LIGHT" and not ob.hide_render),
            tuple(_material(material, *key[1:]) for material in materials_of(scene)),
        )
    return _known[key]


def _light(ob) -> Entry:
    matrix = np.array(ob.matrix_world, dtype=np.float64)
    kind = ob.data.shape if ob.data.type == "AREA" else ob.data.type
    problem = reason_to_leave_out(ob, matrix)
    if problem:
        return Entry(ob.name, kind, LEFT_OUT, (problem,))
    inventory = LightInventory()
    unseen = node_light(ob, matrix, inventory)
    note_unsupported_light(ob, matrix, inventory)
    notes = [note.partition(": ")[2] for note in inventory.warnings]
    if unseen is not None and unseen.varies and ob.data.type == "AREA":
        notes.append("its emission varies, shaded as patches of constant radiance")
    return Entry(ob.name, kind, APPROXIMATED if notes else EXACT, tuple(notes))


def _material(material, in_view: bool, with_bounces: bool) -> Entry:
    """The entry of a material; with what the view, `with_bounces` or without, says of it, if the view is ours."""
    surface = surface_of(material)
    if surface is None:
        return Entry(material.name, "", EXACT)
    shaders = shaders_behind(surface)
    # An emissive material is a kind, not a defect: leave out the note that it does not light the scene.
    notes = tuple(dict.fromkeys(notes_of_material(surface.node, shaders, emitter=True)))
    look = preview_of(material)
    of_mirrors = [OF_MIRRORS] if look.is_mirror and not with_bounces else []
    of_view = (*look.notes_in_view(with_bounces), *of_mirrors) if in_view else ()
    notes += tuple(f"in the view: {note.removeprefix(f'{material.name}: ')}" for note in dict.fromkeys(of_view))
    shown = [bsdf_of(leaf.node) or is_emission(leaf.node) or leaf.is_transparent for leaf in shaders.leaves]
    state = LEFT_OUT if shown and not any(shown) else APPROXIMATED if notes else EXACT
    return Entry(material.name, "emissive" if emission_of(material).emits else "", state, notes)


@bpy.app.handlers.persistent
def _forget(*_):
    _known.clear()


HANDLERS = tuple((event, _forget) for event in ("depsgraph_update_post", "load_post", "undo_post", "redo_post"))


register = unregister = _known.clear
