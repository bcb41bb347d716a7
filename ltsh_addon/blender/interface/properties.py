"""Settings of a scene as Blender keeps them in the file: `Scene.ltsh`."""

from __future__ import annotations

import bpy
from bpy.props import (
    BoolProperty,
    CollectionProperty,
    EnumProperty,
    FloatProperty,
    FloatVectorProperty,
    IntProperty,
    PointerProperty,
    StringProperty,
)

from .viewer import changed

TECHNIQUES = (
    ("ltc", "LTC", "Linearly transformed cosines, as EEVEE has them: fastest, least accurate", 1),
    ("ltsh2", "LTSH 2", "Linearly transformed spherical harmonics of degree 2: nearly as fast as LTC", 2),
    ("ltsh4", "LTSH 4", "Linearly transformed spherical harmonics of degree 4: the most accurate closed form", 4),
    ("reference", "Reference", "Quadrature of the true lobe: exact and slow, on some of the pixels of large images", 8),
)
PASSES = (
    ("specular", "Specular", "Glossy reflection, surface color included", 1),
    ("diffuse", "Diffuse", "Diffuse reflection, surface color included", 2),
)
BAKE_PASSES = (
    *PASSES,
    ("diffuse_light", "Lightmap", "Diffuse reflection without the color of the surface", 4),
    ("combined", "Combined", "Specular and diffuse together", 8),
)
PICTURES = (*TECHNIQUES, ("cycles", "Cycles", "The Cycles reference of the same points", 16))
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
)


class LTSH_PG_scene(bpy.types.PropertyGroup):
    """What to shade, bake and look at in a scene."""

    techniques: EnumProperty(
        name="Techniques",
        description="How the glossy lobe is integrated over the lights. Shift-click to choose several",
        items=TECHNIQUES,
        options={"ENUM_FLAG"},
        default={"ltc", "ltsh4"},
    )
    passes: EnumProperty(
        name="Passes",
        description="Parts of the reflected light. Shift-click to choose several",
        items=PASSES,
        options={"ENUM_FLAG"},
        default={"specular", "diffuse"},
    )
    resolution_percentage: IntProperty(
        name="Resolution",
        description="Percentage of the scene's render resolution",
        subtype="PERCENTAGE",
        min=1,
        max=400,
        soft_max=100,
        default=100,
    )
    anti_aliasing: IntProperty(
        name="Anti-Aliasing",
        description="Points per pixel, drawn from the scene's pixel filter; 1 takes the centers of pixels",
        min=1,
        max=256,
        soft_max=64,
        default=1,
    )
    cycles_samples: IntProperty(
        name="Cycles Samples",
        description="Samples per pixel of the Cycles reference; its noise falls with their square root",
        min=2,
        max=1 << 20,
        soft_max=8192,
        default=256,
    )
    output_folder: StringProperty(
        name="Output",
        description="Folder for the results, in folders of their own for shading, comparing and baking; // is the "
        "folder of the .blend. Empty takes the one of the preferences, as does a file that is not saved yet",
        subtype="DIR_PATH",
        options={"PATH_SUPPORTS_BLEND_RELATIVE"},
        default="//ltsh/",
    )
    bake_size: EnumProperty(name="Size", description="Texels on each side of the texture", items=SIZES, default="1024")
    bake_margin: IntProperty(
        name="Margin",
        description="How far colors go on beyond the borders of UV islands, in texels",
        subtype="PIXEL",
        min=0,
        max=256,
        soft_max=64,
        default=16,
    )
    bake_view: EnumProperty(name="View From", description="From where surfaces are seen", items=VIEWS, default="camera")
    bake_uv_map: StringProperty(
        name="UV Map",
        description="Name of the UV map to bake into; empty for the one that is active for rendering",
    )
    bake_passes: EnumProperty(
        name="Bake Passes",
        description="Parts of the reflected light. Shift-click to choose several",
        items=BAKE_PASSES,
        options={"ENUM_FLAG"},
        default={"specular", "diffuse"},
    )
    bake_error: BoolProperty(
        name="Compare with Cycles",
        description="Bake the same texels with Cycles too and measure the signed error",
        default=False,
    )
    result_folder: StringProperty(
        name="Results",
        description="Folder of the pictures that are shown",
        subtype="DIR_PATH",
        options={"HIDDEN", "PATH_SUPPORTS_BLEND_RELATIVE"},
    )
    # -- what the Image Editor shows of it ----------------------------------------------------------------------------
    mode: EnumProperty(
        name="View", description="How the two pictures are shown", items=MODES, default="WIPE", update=changed
    )
    groups: CollectionProperty(type=bpy.types.PropertyGroup)
    group: StringProperty(name="Object", description="Which baked texture is shown", update=changed)
    first: EnumProperty(
        name="A", description="The first picture, left of the line", items=PICTURES, default="ltsh4", update=changed
    )
    second: EnumProperty(
        name="B", description="The second picture, right of the line", items=PICTURES, default="cycles", update=changed
    )
    pass_name: EnumProperty(
        name="Pass", description="Which part of the light is shown", items=BAKE_PASSES, default="combined",
        update=changed,
    )  # fmt: skip
    split: FloatProperty(
        name="Split",
        description="Where the line between the two pictures is; it can also be dragged in the image",
        subtype="FACTOR",
        min=0.0,
        max=1.0,
        default=0.5,
        update=changed,
    )
    error_scale: FloatProperty(
        name="Scale",
        description="Difference in radiance at which the colors end; 0 takes the one of the report",
        min=0.0,
        soft_max=10.0,
        precision=4,
        default=0.0,
        update=changed,
    )
    probe: FloatVectorProperty(
        name="Probe",
        description="Where the pixel probe was last, from the lower left corner",
        size=2,
        default=(0.5, 0.5),
        options={"HIDDEN"},
    )


def register():
    bpy.utils.register_class(LTSH_PG_scene)
    bpy.types.Scene.ltsh = PointerProperty(type=LTSH_PG_scene, name="LTSH")


def unregister():
    del bpy.types.Scene.ltsh
    bpy.utils.unregister_class(LTSH_PG_scene)
