"""Settings of the scene, preferences of the user, presets."""

import logging
import os
from dataclasses import dataclass
from pathlib import Path

import bpy
from bl_operators.presets import AddPresetBase
from bl_ui.utils import PresetPanel
from bpy import props

from ...scene import COMPARED_TECHNIQUES, CYCLES, DEFAULT_TECHNIQUE, REFERENCE, TECHNIQUES
from ...workers.pool import CORES_VARIABLE
from .comparison import changed, mixed, redraw_editors
from .preview import active_light, lights_of, select_alone

# The name of the add-on: "bl_ext.user_default.ltsh" in Blender, "ltsh_addon" when imported from elsewhere.
ADDON = __package__.rsplit(".", 3)[0]
LOGGER = __package__.rsplit(".", 2)[0]
RESULTS = "results"
LOG_LEVELS = (
    ("ERROR", "Errors", "Only what failed"),
    ("WARNING", "Warnings", "Also what went another way than asked"),
    ("INFO", "Information", "Also what is done and how long it takes"),
    ("DEBUG", "Details", "Everything, to find the cause of a fault"),
)
_DEFAULT_LOG_LEVEL = "WARNING"


@dataclass(frozen=True)
class Preferences:
    """The values of the preferences."""

    cores: int  # 0: all
    output_folder: Path  # absolute; need not exist
    log_level: str


def preferences(context) -> Preferences:
    """The preferences of the running Blender; the defaults if the add-on is loaded without being enabled."""
    addon = context.preferences.addons.get(ADDON)
    stored = addon.preferences if addon is not None else None
    if stored is None:
        return Preferences(0, default_output_folder(), _DEFAULT_LOG_LEVEL)
    chosen = stored.output_folder.strip()
    folder = Path(bpy.path.abspath(chosen)).absolute() if chosen else default_output_folder()
    return Preferences(stored.cores, folder, stored.log_level)


def default_output_folder() -> Path:
    """The folder for files of this extension; it survives updates."""
    if ADDON.startswith("bl_ext."):
        return Path(bpy.utils.extension_path_user(ADDON, path=RESULTS))
    return Path(bpy.utils.user_resource("DATAFILES", path="ltsh")) / RESULTS


# Blender calls lambdas of properties without the names of this module.
def _apply(chosen, context) -> None:
    apply(context)


def _redraw(settings, context) -> None:
    redraw_editors("VIEW_3D")


class LTSH_AddonPreferences(bpy.types.AddonPreferences):
    bl_idname = ADDON

    cores: bpy.props.IntProperty(
        name="Processor Cores",
        description="How many cores shading, baking and the Cycles reference may use; 0 takes all of them",
        min=0, max=1024, soft_max=64, default=0, update=_apply,
    )  # fmt: skip
    output_folder: bpy.props.StringProperty(
        name="Output Folder",
        description="Where pictures, reports and baked textures are written; // is the folder of the .blend. "
        "Empty takes a folder of the extension's own, which goes when the extension is uninstalled",
        subtype="DIR_PATH", default="",
    )  # fmt: skip
    log_level: bpy.props.EnumProperty(
        name="Log", description="What the add-on writes to the console that Blender was started from",
        items=LOG_LEVELS, default=_DEFAULT_LOG_LEVEL, update=_apply,
    )  # fmt: skip

    def draw(self, context):
        from .preflight import missing_libraries

        layout = self.layout
        layout.use_property_split, layout.use_property_decorate = True, False
        missing = missing_libraries()
        if missing:
            layout.label(text=missing, icon="ERROR", translate=False)
        layout.prop(self, "cores", text="Processor Cores (0: All)")
        layout.prop(self, "output_folder", placeholder=str(default_output_folder()))
        layout.prop(self, "log_level")


_variables_before: dict[str, str | None] = {}
_log_handlers: list[logging.Handler] = []


def apply(context) -> None:
    """Apply the limit of cores and the log level, here and for processes started from now on."""
    chosen = preferences(context)
    before = _variables_before.setdefault(CORES_VARIABLE, os.environ.get(CORES_VARIABLE))
    _set_variable(CORES_VARIABLE, str(chosen.cores) if chosen.cores else before)
    logger = logging.getLogger(LOGGER)
    logger.setLevel(chosen.log_level)
    if not _log_handlers:
        handler = logging.StreamHandler()
        handler.setFormatter(logging.Formatter("LTSH %(levelname)s: %(message)s"))
        logger.addHandler(handler)
        _log_handlers.append(handler)


def _set_variable(name: str, value: str | None) -> None:
    if value is None:
        os.environ.pop(name, None)
    else:
        os.environ[name] = value


# Members of set properties: name, label, description, bit. Files store the bits, so they must not change.
_BITS = {"ltc": 1, "ltsh2": 2, "ltsh4": 4, REFERENCE: 8, CYCLES: 16, "ltsh4c": 32}
TECHNIQUE_ITEMS = tuple(
    (name, technique.label, technique.description, _BITS[name]) for name, technique in TECHNIQUES.items()
)
PASS_ITEMS = (
    ("specular", "Specular", "Glossy reflection, surface color included", 1),
    ("diffuse", "Diffuse", "Diffuse reflection, surface color included", 2),
)
BAKE_PASS_ITEMS = (
    *PASS_ITEMS,
    ("diffuse_light", "Lightmap", "Diffuse reflection without the color of the surface", 4),
    ("combined", "Combined", "Specular and diffuse together", 8),
)
PICTURE_ITEMS = (*TECHNIQUE_ITEMS, (CYCLES, "Cycles", "The Cycles reference of the same points", _BITS[CYCLES]))
VIEWS = (
    ("camera", "Active Camera", "The specular part as the scene's camera sees it"),
    ("above", "Above Surface", "The specular part as seen along the normal of each point, independent of any camera"),
)
SIZES = tuple((str(size), f"{size} px", f"{size} x {size} texels") for size in (256, 512, 1024, 2048, 4096, 8192))
MODES = (
    ("A", "Single", "The first picture alone", "IMAGE_PLANE", 0),
    ("WIPE", "Wipe", "The first picture left of a line that can be dragged, the second right", "UV_SYNC_SELECT", 1),
    ("SIDE", "Side by Side", "Both pictures next to each other", "MOD_MIRROR", 2),
    ("ERROR", "Difference", "First minus second: red is too bright, blue too dark, white is equal", "IMAGE_ALPHA", 3),
    ("MIX", "Mix", "The picture with its lights as the Light Mixer has them", "LIGHT", 4),
)


class LTSH_PG_mixed_light(bpy.types.PropertyGroup):
    """What the light mixer makes of a light, by its name."""

    power: props.FloatProperty(
        name="Power", description="Factor of the power that the light had in the picture",
        min=0.0, soft_max=10.0, step=5, precision=3, default=1.0, update=mixed,
    )  # fmt: skip
    exposure: props.FloatProperty(
        name="Exposure", description="Each step doubles the power",
        min=-32.0, max=32.0, soft_min=-5.0, soft_max=5.0, default=0.0, update=mixed,
    )  # fmt: skip
    color: props.FloatVectorProperty(
        name="Color", description="Color in place of the light's own; its brightest channel counts as 1",
        subtype="COLOR", size=3, min=0.0, soft_max=1.0, default=(1.0, 1.0, 1.0), update=mixed,
    )  # fmt: skip
    muted: props.BoolProperty(name="Mute", description="This light is dark", update=mixed)
    solo: props.BoolProperty(
        name="Solo", description="All other lights are dark, unless they are solo too", update=mixed
    )
    applied: props.BoolProperty(description="The scene has values of the mixer", options={"HIDDEN"})
    # Settings of the light in Blender when the picture was made; the values above belong to them.
    settings: props.FloatVectorProperty(size=5, options={"HIDDEN"})


class LTSH_PG_last_result(bpy.types.PropertyGroup):
    """Where the last results of a command are, by its name."""

    folder: props.StringProperty(subtype="DIR_PATH", options={"HIDDEN", "PATH_SUPPORTS_BLEND_RELATIVE"})


NOT_HELD = -1


def _active_index(settings) -> int:
    """Index of the active light among the objects of the scene; -1 if there is none."""
    scene = settings.id_data
    ob = active_light(bpy.context) if bpy.context.scene == scene else None
    return -1 if ob is None else scene.objects.find(ob.name)


def _select(settings, index: int) -> None:
    """Select only the light at this index among the objects of the scene, and make it active."""
    objects = settings.id_data.objects
    if 0 <= index < len(objects):
        select_alone(bpy.context, objects[index])


def _hidden(ob) -> int:
    """The bits 1, if `ob` is hidden in views, and 2, if it is hidden in renders."""
    return int(ob.hide_viewport) + 2 * int(ob.hide_render)


def _hide(ob, hidden: int) -> None:
    for name, value in (("hide_viewport", bool(hidden & 1)), ("hide_render", bool(hidden & 2))):
        if getattr(ob, name) != value:
            setattr(ob, name, value)


def _follow_solo(settings, context) -> None:
    """Hide all lights except those on solo; without any, restore all lights."""
    lights = lights_of(context.scene)
    solo = any(ob.ltsh_light.solo for ob in lights)
    for ob in lights:
        if solo and not ob.ltsh_light.solo:
            if ob.ltsh_light.held == NOT_HELD:
                ob.ltsh_light.held = _hidden(ob)
            _hide(ob, 3)
        else:
            _release(ob)


def _release(ob) -> None:
    """Restore the visibility that `ob` had before others were solo."""
    if ob.ltsh_light.held != NOT_HELD:
        _hide(ob, ob.ltsh_light.held)
        ob.ltsh_light.held = NOT_HELD


def _is_muted(settings) -> bool:
    ob = settings.id_data
    return bool(_hidden(ob) if settings.held == NOT_HELD else settings.held) or ob.hide_get()


def _set_muted(settings, muted: bool) -> None:
    if not muted and settings.id_data.hide_get():
        settings.id_data.hide_set(False)
    if settings.held != NOT_HELD and any(ob.ltsh_light.solo for ob in lights_of(bpy.context.scene)):
        settings.held = 3 if muted else 0
    else:
        settings.held = NOT_HELD
        _hide(settings.id_data, 3 if muted else 0)


class LTSH_PG_light(bpy.types.PropertyGroup):
    """What the list of lights changes in an object."""

    mute: props.BoolProperty(
        name="Mute", description="Hide the light in views and renders; also closed where H hides it",
        get=_is_muted, set=_set_muted,
    )  # fmt: skip
    solo: props.BoolProperty(
        name="Solo", description="Hide all lights that are not on solo, in views and renders, until this is off again",
        update=_follow_solo,
    )  # fmt: skip
    held: props.IntProperty(default=NOT_HELD, options={"HIDDEN"})  # bits of `_hidden` to restore after a solo of others


class LTSH_PG_scene(bpy.types.PropertyGroup):
    """What to shade, bake and look at in a scene."""

    techniques: props.EnumProperty(
        name="Compared",
        description="Techniques whose pictures are put beside that of Cycles. Shift-click to choose several",
        items=TECHNIQUE_ITEMS, options={"ENUM_FLAG"}, default=set(COMPARED_TECHNIQUES),
    )  # fmt: skip
    resolution_percentage: props.IntProperty(
        name="Resolution", description="Percentage of the scene's render resolution",
        subtype="PERCENTAGE", min=1, max=400, soft_max=100, default=100,
    )  # fmt: skip
    anti_aliasing: props.IntProperty(
        name="Anti-Aliasing",
        description="Points per pixel, drawn from the scene's pixel filter, or per texel of a bake; 1 takes centers",
        min=1, max=256, soft_max=64, default=4,
    )  # fmt: skip
    cycles_samples: props.IntProperty(
        name="Cycles Samples",
        description="Samples per pixel of Cycles: of its picture beside the techniques and of what it adds to complete "
        "renders; noise falls with their square root",
        min=2, max=1 << 20, soft_max=8192, default=256,
    )  # fmt: skip
    shadows: props.BoolProperty(
        name="Shadows",
        description="Surfaces stand in each other's light, in the Cycles reference too; without, pictures show how "
        "well a technique shades alone",
        default=True, update=_redraw,
    )  # fmt: skip
    shadow_rays: props.IntProperty(
        name="Shadow Rays",
        description="At most so many per light and pixel or texel, where a light is neither seen whole nor not at all",
        min=8, max=1024, default=256,
    )  # fmt: skip
    output_folder: props.StringProperty(
        name="Output",
        description="Folder for the results, in folders of their own for shading, comparing and baking; // is the "
        "folder of the .blend. Empty takes the one of the preferences, as does a file that is not saved yet",
        subtype="DIR_PATH", options={"PATH_SUPPORTS_BLEND_RELATIVE"}, default="//ltsh/",
    )  # fmt: skip
    bake_size: props.EnumProperty(
        name="Size", description="Texels on each side of the texture", items=SIZES, default="1024"
    )
    bake_margin: props.IntProperty(
        name="Margin", description="How far colors go on beyond the borders of UV islands, in texels",
        subtype="PIXEL", min=0, max=256, soft_max=64, default=16,
    )  # fmt: skip
    bake_view: props.EnumProperty(
        name="View From", description="From where surfaces are seen", items=VIEWS, default="camera"
    )
    bake_atlas: props.BoolProperty(
        name="Atlas", description="The selected objects share one texture, on a UV map of its own that Make Atlas adds",
    )  # fmt: skip
    bake_uv_map: props.StringProperty(
        name="UV Map",
        description="Name of the UV map to bake into; empty for the active one, highlighted in the list UV Maps",
    )
    bake_passes: props.EnumProperty(
        name="Bake Passes", description="Parts of the reflected light. Shift-click to choose several",
        items=BAKE_PASS_ITEMS, options={"ENUM_FLAG"}, default={"specular", "diffuse"},
    )  # fmt: skip
    bake_active: props.IntProperty(options={"HIDDEN"})  # the row that is marked in the list of objects
    bake_bounces: props.BoolProperty(
        name="Bounces", description="Add bounced light by Cycles, denoised, and fit light at the seams of UV maps",
    )  # fmt: skip
    bake_rest_samples: props.IntProperty(
        name="Bounce Samples", description="Samples per texel of Cycles for the bounced light",
        default=64, min=1, max=65536,
    )  # fmt: skip
    bake_per_light: props.BoolProperty(
        name="Per Light", description="Bake each light by itself too, so that the Light Mixer can change the textures",
    )  # fmt: skip
    bake_changed: props.BoolProperty(
        name="Only Changed", default=True,
        description="Keep the textures of objects that would be the same as those of the last bake; off: bake all",
    )  # fmt: skip
    bake_error: props.BoolProperty(
        name="Compare with Cycles", description="Bake the same texels with Cycles too and measure the signed error",
        default=False,
    )  # fmt: skip
    keep_lights: props.BoolProperty(
        name="Keep Lights",
        description="Keep a picture of each light, so that the Light Mixer can change them in the finished picture",
        default=True,
    )  # fmt: skip
    match_target: props.PointerProperty(
        name="Target", description="Picture of the same size that the lights should come closest to",
        type=bpy.types.Image,
    )  # fmt: skip
    match_colors: props.BoolProperty(name="Colors", description="Also change the colors of the lights", default=False)
    mixed: props.CollectionProperty(type=LTSH_PG_mixed_light, options={"HIDDEN"})
    mixed_active: props.IntProperty(name="Light", options={"HIDDEN"})
    active_light: props.IntProperty(
        name="Active Light", description="Click a light to select it", get=_active_index, set=_select,
        options={"HIDDEN"},
    )  # fmt: skip
    last_results: props.CollectionProperty(type=LTSH_PG_last_result, options={"HIDDEN"})
    result_folder: props.StringProperty(
        name="Results", description="Folder of the pictures that are shown",
        subtype="DIR_PATH", options={"HIDDEN", "PATH_SUPPORTS_BLEND_RELATIVE"},
    )  # fmt: skip
    # What the Image Editor shows of the results:

    mode: props.EnumProperty(
        name="View", description="How the two pictures are shown", items=MODES, default="WIPE", update=changed
    )
    mode_before_mix: props.StringProperty(default="WIPE", options={"HIDDEN"})
    groups: props.CollectionProperty(type=bpy.types.PropertyGroup)
    group: props.StringProperty(name="Object", description="Which baked texture is shown", update=changed)
    first: props.EnumProperty(
        name="A", description="The first picture, left of the line",
        items=PICTURE_ITEMS, default=DEFAULT_TECHNIQUE, update=changed,
    )  # fmt: skip
    second: props.EnumProperty(
        name="B", description="The second picture, right of the line",
        items=PICTURE_ITEMS, default=CYCLES, update=changed,
    )  # fmt: skip
    pass_name: props.EnumProperty(
        name="Pass", description="Which part of the light is shown", items=BAKE_PASS_ITEMS, default="combined",
        update=changed,
    )  # fmt: skip
    split: props.FloatProperty(
        name="Split", description="Where the line between the two pictures is; it can also be dragged in the image",
        subtype="FACTOR", min=0.0, max=1.0, default=0.5, update=changed,
    )  # fmt: skip
    error_scale: props.FloatProperty(
        name="Scale", description="Difference in radiance at which the colors end; 0 takes the one of the report",
        min=0.0, soft_max=10.0, precision=4, default=0.0, update=changed,
    )  # fmt: skip


SUBFOLDER = "ltsh"
KEPT = ("techniques", "resolution_percentage", "anti_aliasing", "cycles_samples", "shadows", "shadow_rays",
        "keep_lights", "bake_size", "bake_atlas", "bake_margin", "bake_view", "bake_passes", "bake_error",
        "bake_bounces", "bake_rest_samples", "bake_per_light", "bake_changed")  # fmt: skip


class LTSH_OT_add_preset(AddPresetBase, bpy.types.Operator):
    """Add or remove a preset of these settings"""

    bl_idname = "ltsh.add_preset"
    bl_label = "Add LTSH Preset"
    preset_menu = "LTSH_PT_presets"
    preset_subdir = SUBFOLDER
    preset_defines = ["settings = bpy.context.scene.ltsh"]
    preset_values = [f"settings.{name}" for name in KEPT]


class LTSH_PT_presets(PresetPanel, bpy.types.Panel):
    """Settings by name"""

    bl_label = "LTSH Presets"
    preset_subdir = SUBFOLDER
    preset_operator = "script.execute_preset"
    preset_add_operator = "ltsh.add_preset"


# The folder in which Blender looks for a folder "presets".
PRESETS_PARENT = str(Path(__file__).parent)


def register() -> None:
    """Add settings and presets, and apply the preferences."""
    apply(bpy.context)
    bpy.types.Scene.ltsh = props.PointerProperty(type=LTSH_PG_scene, name="LTSH")
    bpy.types.Object.ltsh_light = props.PointerProperty(type=LTSH_PG_light, name="LTSH Light")
    bpy.types.Object.ltsh_baked = props.BoolProperty(
        name="Bake", description="Bake this object where it is selected", default=True
    )
    bpy.utils.register_preset_path(PRESETS_PARENT)


def unregister() -> None:
    """Remove what `register` added, and restore the environment, the log, and lights that a solo hides."""
    for ob in bpy.data.objects:
        if ob.type == "LIGHT":
            _release(ob)
            ob.ltsh_light.property_unset("solo")
    bpy.utils.unregister_preset_path(PRESETS_PARENT)
    del bpy.types.Object.ltsh_baked
    del bpy.types.Object.ltsh_light
    del bpy.types.Scene.ltsh
    logger = logging.getLogger(LOGGER)
    while _log_handlers:
        logger.removeHandler(_log_handlers.pop())
    logger.setLevel(logging.NOTSET)
    while _variables_before:
        _set_variable(*_variables_before.popitem())
