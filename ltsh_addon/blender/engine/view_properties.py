"""What the LTSH render engine shows: `Scene.ltsh_view`, and its panel in the render properties."""

from __future__ import annotations

import bpy

ENGINE = "LTSH"
TECHNIQUES = (
    ("ltc", "LTC", "Linearly transformed cosines (Heitz et al. 2016), as in EEVEE"),
    ("ltsh2", "LTSH 2", "Linearly transformed spherical harmonics up to degree 2"),
    ("ltsh4", "LTSH 4", "Linearly transformed spherical harmonics up to degree 4, the most accurate"),
)
TECHNIQUE_LABELS = {name: label for name, label, _ in TECHNIQUES}
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
CYCLES = "cycles"
SECOND_PICTURES = (
    *TECHNIQUES,
    (CYCLES, "Cycles", "The picture that Compare with Cycles has made, where the view is through its camera"),
)
SECOND_LABELS = {name: label for name, label, _ in SECOND_PICTURES}


def _redraw(settings, context) -> None:
    """Show a changed setting at once: the viewport does not redraw for properties of add-ons."""
    for window in context.window_manager.windows:
        for area in window.screen.areas:
            if area.type == "VIEW_3D":
                area.tag_redraw()


class LTSH_ViewSettings(bpy.types.PropertyGroup):
    """Settings of the viewport and of final renders with the engine LTSH."""

    technique: bpy.props.EnumProperty(
        name="Technique", description="What shades the picture", items=TECHNIQUES, default="ltsh4", update=_redraw
    )
    shown: bpy.props.EnumProperty(
        name="Show", description="Which reflection is seen", items=SHOWN_PASSES, default="combined", update=_redraw
    )
    mode: bpy.props.EnumProperty(
        name="Mode", description="One technique or two", items=MODES, default="single", update=_redraw
    )
    second_technique: bpy.props.EnumProperty(
        name="Second",
        description="What the technique is put beside",
        items=SECOND_PICTURES,
        default="ltc",
        update=_redraw,
    )
    split_position: bpy.props.FloatProperty(
        name="Split",
        description="Where the line stands between the left edge and the right one",
        min=0.0,
        max=1.0,
        default=0.5,
        subtype="FACTOR",
        update=_redraw,
    )
    difference_scale: bpy.props.FloatProperty(
        name="Scale",
        description="Difference of radiance that gets the full color",
        min=1e-4,
        soft_max=10.0,
        default=0.25,
        precision=3,
        update=_redraw,
    )
    render_samples: bpy.props.IntProperty(
        name="Render Samples",
        description="Points per pixel of final renders, drawn from the pixel filter; 1 takes pixel centers",
        min=1,
        soft_max=64,
        default=4,
    )
    technique_passes: bpy.props.BoolProperty(
        name="Passes of All Techniques",
        description="Final renders also have a specular and a diffuse pass of every technique",
        default=False,
    )
    artist_engine: bpy.props.StringProperty(
        name="Former Engine", description="The render engine to give back after the preview", options={"HIDDEN"}
    )


def draw_view_settings(layout, scene) -> None:
    """The controls of what is seen; the same in every panel that shows them."""
    settings = scene.ltsh_view
    if settings.artist_engine:
        layout.operator("ltsh.preview", text="End Preview with LTSH", icon="LOOP_BACK")
    layout.prop(settings, "technique")
    layout.prop(settings, "shown")
    layout.prop(settings, "mode")
    if settings.mode in ("split", "difference"):
        layout.prop(settings, "second_technique")
    if settings.mode == "split":
        layout.prop(settings, "split_position", slider=True)
    if settings.mode == "difference":
        layout.prop(settings, "difference_scale")


class _View:
    bl_label = "LTSH Viewport"

    @classmethod
    def poll(cls, context):
        return context.engine == ENGINE

    def draw(self, context):
        layout = self.layout
        layout.use_property_split, layout.use_property_decorate = True, False
        draw_view_settings(layout, context.scene)


class LTSH_PT_view_sidebar(_View, bpy.types.Panel):
    """What is seen, in the sidebar of the 3D view."""

    bl_space_type = "VIEW_3D"
    bl_region_type = "UI"
    bl_category = "LTSH"


class LTSH_PT_view(_View, bpy.types.Panel):
    """The engine's panel in the render properties."""

    bl_space_type = "PROPERTIES"
    bl_region_type = "WINDOW"
    bl_context = "render"
    COMPAT_ENGINES = {ENGINE}

    def draw(self, context):
        super().draw(context)
        column = self.layout.column(heading="Final Render")
        column.prop(context.scene.ltsh_view, "render_samples", text="Samples")
        column.prop(context.scene.ltsh_view, "technique_passes")


CLASSES = (LTSH_ViewSettings, LTSH_PT_view_sidebar, LTSH_PT_view)


def register() -> None:
    """Add the settings and their panel."""
    for cls in CLASSES:
        bpy.utils.register_class(cls)
    bpy.types.Scene.ltsh_view = bpy.props.PointerProperty(type=LTSH_ViewSettings)


def unregister() -> None:
    """Remove what `register` added."""
    del bpy.types.Scene.ltsh_view
    for cls in reversed(CLASSES):
        bpy.utils.unregister_class(cls)
