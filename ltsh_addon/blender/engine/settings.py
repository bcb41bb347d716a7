"""Settings of the view and final renders, and the panels of Cycles that our engine shares."""

import bpy

from ...scene import CYCLES, DEFAULT_TECHNIQUE, SHIPPED_TABLES, TECHNIQUES
from ..ui.preview import ENGINE
from .redraws import open_views, tag_views

# Files store these numbers, so they must not change.
_NUMBERS = {"ltc": 0, "ltsh2": 1, "ltsh4": 2, CYCLES: 3, "ltsh4c": 4}
TECHNIQUE_ITEMS = tuple(
    (name, TECHNIQUES[name].label, TECHNIQUES[name].description, _NUMBERS[name]) for name in SHIPPED_TABLES
)
SHOWN_PASSES = (
    ("combined", "Both", "Specular and diffuse reflection, emission and background"),
    ("specular", "Specular", "Light that the glossy lobes reflect"),
    ("diffuse", "Diffuse", "Light that the diffuse lobes reflect"),
)
MODES = (
    ("single", "Single", "The technique alone"),
    ("split", "Split", "The technique left of a line that can be dragged, the second technique right of it"),
    ("difference", "Difference", "The technique minus the second: red is brighter, blue darker, white equal"),
)
BESIDE = "The picture that Compare with Cycles has made, where the view is through its camera"
SECOND_ITEMS = (*TECHNIQUE_ITEMS, (CYCLES, "Cycles", BESIDE, _NUMBERS[CYCLES]))


def _redraw(settings, context) -> None:
    """Show a changed setting at once: Blender does not redraw 3D views for properties of add-ons."""
    tag_views()


def _switch_bounces(settings, context) -> None:
    """Without bounces their Blender ends at once; views that still want it start another."""
    for view in () if settings.bounces else list(open_views):
        view.rest.stop()
    tag_views()


class LTSH_ViewSettings(bpy.types.PropertyGroup):
    """Settings of the viewport and of final renders with the engine LTSH."""

    technique: bpy.props.EnumProperty(
        name="Technique", description="What shades the picture",
        items=TECHNIQUE_ITEMS, default=DEFAULT_TECHNIQUE, update=_redraw,
    )  # fmt: skip
    shown: bpy.props.EnumProperty(
        name="Show", description="Which reflection is seen", items=SHOWN_PASSES, default="combined", update=_redraw
    )
    world: bpy.props.BoolProperty(
        name="World", description="The world lights what is seen; its background is there in any case",
        default=True, update=_redraw,
    )  # fmt: skip
    bounces: bpy.props.BoolProperty(
        name="Bounces", default=True, update=_switch_bounces,
        description="What is not direct light, by Cycles and denoised: bounces, reflections, refraction, materials by "
        "nodes",
    )  # fmt: skip

    @property
    def shows_bounces(self) -> bool:
        """True if views have bounces: neither passes alone, nor a picture beside that of Cycles."""
        return self.bounces and self.shown == "combined" and (self.mode == "single" or self.second_technique != CYCLES)

    mode: bpy.props.EnumProperty(
        name="Mode", description="One technique or two", items=MODES, default="single", update=_redraw
    )
    second_technique: bpy.props.EnumProperty(
        name="Second", description="What the technique is put beside", items=SECOND_ITEMS, default="ltc", update=_redraw
    )
    split_position: bpy.props.FloatProperty(
        name="Split", description="Where the line stands between the left edge and the right one",
        min=0.0, max=1.0, default=0.5, subtype="FACTOR", update=_redraw,
    )  # fmt: skip
    difference_scale: bpy.props.FloatProperty(
        name="Scale", description="Difference of radiance that gets the full color",
        min=1e-4, soft_max=10.0, default=0.25, precision=3, update=_redraw,
    )  # fmt: skip
    complete: bpy.props.BoolProperty(
        name="Complete",
        description="Final renders also have what is not direct light, by Cycles and denoised: bounces, glass, "
        "subsurface, and all its passes", default=True,
    )  # fmt: skip
    technique_passes: bpy.props.BoolProperty(
        name="Passes of All Techniques", default=False,
        description="Final renders also have a specular and a diffuse pass of every technique",
    )  # fmt: skip
    artist_engine: bpy.props.StringProperty(
        name="Former Engine", description="The render engine to give back after the preview", options={"HIDDEN"}
    )


# Tabs whose panels of Cycles are about its own renders, which mean nothing to other engines.
RENDER_TABS = ("render", "view_layer", "output")


def _is_cycles(panel) -> bool:
    """True for panels of Cycles' add-on."""
    return "cycles" in panel.__module__.split(".")


def shared_panels() -> list[type]:
    """The panels to show with our engine: all that Cycles shows, except its own render settings."""
    panels = [panel for panel in _below(bpy.types.Panel) if ENGINE not in getattr(panel, "COMPAT_ENGINES", (ENGINE,))]
    shown = [panel for panel in panels if "CYCLES" in panel.COMPAT_ENGINES]
    if not shown:
        # Cycles' add-on is off.
        return [panel for panel in panels if "BLENDER_RENDER" in panel.COMPAT_ENGINES]
    return [panel for panel in shown if not _is_cycles(panel) or _is_about_scene(panel)]


def _is_about_scene(panel) -> bool:
    """True for panels about objects, materials and lights; False for settings of Cycles' own renders."""
    tab, space = getattr(panel, "bl_context", ""), getattr(panel, "bl_space_type", "")
    return (space == "PROPERTIES" and tab not in ("", *RENDER_TABS)) or space == "NODE_EDITOR"


def _below(panel) -> list[type]:
    """All classes derived from `panel`, each once."""
    classes = {}
    for derived in panel.__subclasses__():
        classes[derived] = None
        classes.update(dict.fromkeys(_below(derived)))
    return list(classes)


class _AsCycles:
    """A context whose engine is Cycles."""

    engine = "CYCLES"

    def __init__(self, context):
        self._context = context

    def __getattr__(self, name):
        return getattr(self._context, name)


def _asked_as_cycles(poll):
    """The class method `poll` of a panel, changed to treat our engine as Cycles."""

    def poll_of_both(cls, context):
        return poll.__func__(cls, _AsCycles(context) if context.engine == ENGINE else context)

    return classmethod(poll_of_both)


# Panels that are changed to appear with our engine, with their former attributes (None: inherited).
_changed: dict[type, dict] = {}


def register() -> None:
    """Add the settings, and show the shared panels."""
    bpy.types.Scene.ltsh_view = bpy.props.PointerProperty(type=LTSH_ViewSettings)
    for panel in shared_panels():
        # Each panel gets its own set, because all panels of Cycles share one, also those of its render settings.
        shown = {"COMPAT_ENGINES": {*panel.COMPAT_ENGINES, ENGINE}}
        if _is_cycles(panel):
            # Most of them poll by their common base class, which checks the engine.
            shown["poll"] = _asked_as_cycles(panel.poll)
        _changed[panel] = {name: vars(panel).get(name) for name in shown}
        for name, value in shown.items():
            setattr(panel, name, value)


def unregister() -> None:
    """Remove what `register` added."""
    while _changed:
        panel, former = _changed.popitem()
        for name, value in former.items():
            if value is None:
                delattr(panel, name)
            else:
                setattr(panel, name, value)
    del bpy.types.Scene.ltsh_view
