"""A scene for tests of film, layers and filters, its comparison and its plain render."""

import numpy as np
import scene_parts
from lit_plane import into_collection
from scene_parts import add_plane, bsdf_material

from ltsh_addon import imaging
from ltsh_addon.blender.render_settings import pass_names
from ltsh_addon.cycles.lobes import read_layer
from ltsh_addon.pipeline import PictureOptions, compare_scene

SIZE = (26, 16)


def diffuse(name, color):
    return bsdf_material("ShaderNodeBsdfDiffuse", name, Color=(*color, 1.0))[0]


def tiles():
    """A gray floor seen from above with a red tile in its left half, which alone is in collection "Tiles"."""
    scene = scene_parts.empty_scene(*SIZE)
    scene_parts.add_top_camera(6.5)
    scene_parts.add_area_light("Key", location=(0.3, 0.2, 2.5), rotation=(0.0, 0.0, 0.0))
    add_plane(diffuse("Floor", (0.5, 0.5, 0.5)), size=12.0, name="Floor")
    tile = add_plane(diffuse("Tile", (0.8, 0.1, 0.1)), size=2.0, name="Tile", location=(-1.5, 0.0, 0.1))
    scene.collection.children.link(into_collection("Tiles", tile))
    # A plain render has its shadow, which is left out here.
    tile.visible_shadow = tile.visible_diffuse = tile.visible_glossy = False
    scene.cycles.pixel_filter_type = "BOX"
    return scene


def plain_diffuse(folder, samples=256):
    """Direct diffuse radiance and diffuse color (H, W, 3) of a plain render of the open file through its own pixel
    filter."""
    channels = scene_parts.cycles_channels(folder, samples, ("combined", "diffuse_direct", "diffuse_color"))
    light, color = (read_layer(channels, pass_names()[f"diffuse_{part}"], "RGB") for part in ("light", "color"))
    return light * color, color


def compared(folder, **options):
    """Report and layers of a comparison of the open file."""
    path = scene_parts.save(folder / "scene.blend")
    given = {"techniques": ("ltc",), "cycles_samples": 128, "passes": ("diffuse",), **options}
    report = compare_scene(PictureOptions(path, folder / "out", **given))
    return report, imaging.read_layers(folder / "out" / "compare.exr")


def check_like_plain(folder, **options):
    """All agree: technique, reference, and a plain render of the file; returns the report."""
    report, layers = compared(folder, **options)
    plain, _ = plain_diffuse(folder)
    for name in ("ltc.diffuse", "cycles.diffuse"):
        # The noise of 256 samples, and the mean over a pixel against its center; edges lie between pixels.
        assert np.linalg.norm(layers[name] - plain) < 0.02 * np.linalg.norm(plain), name
    return report, layers
