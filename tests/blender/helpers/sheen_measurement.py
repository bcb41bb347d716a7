"""Makes sheen_albedos.npy: measures in Cycles what sheen reflects (half a minute, needs pip's bpy).

From the repository's root: PYTHONPATH=. python tests/blender/helpers/sheen_measurement.py
"""

from __future__ import annotations

import tempfile
from pathlib import Path

import bpy
import numpy as np
import scene_parts

from ltsh_addon.blender import render_settings
from ltsh_addon.cycles import closures
from ltsh_addon.cycles.lobes import read_layer
from ltsh_addon.imaging.exr import read_channels

PIXELS = 512
STRIPS = 20_000


def measure(pixels: int = PIXELS) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Cosines, roughness and albedos (pixels^2,) of white sheen on black, in a file of its own that stays open.

    The roughness grows from left to right, the cosine of the view upwards.
    """
    scene, layer = scene_parts.empty_scene(pixels, pixels), bpy.context.view_layer
    _add_surface()
    camera = scene_parts.add_top_camera(1.0)
    camera.location, camera.data.clip_end = (0.5, 0.5, 1.0), 1e3
    scene.render.engine, scene.cycles.samples = "CYCLES", 1
    scene.cycles.use_adaptive_sampling = scene.cycles.use_denoising = False
    layer.use_pass_normal = layer.use_pass_diffuse_color = True
    with tempfile.TemporaryDirectory(prefix="ltsh-") as name:
        path = Path(name) / "sheen.exr"
        render_settings.render_exr(scene, path)
        channels = read_channels(path)
    albedo = read_layer(channels, render_settings.pass_names()["diffuse_color"], "RGB")[..., 0]
    cosine = read_layer(channels, "Normal", "XYZ")[..., 2]
    roughness = np.broadcast_to((np.arange(pixels) + 0.5) / pixels, (pixels, pixels))
    seen = np.linalg.norm(read_layer(channels, "Normal", "XYZ"), axis=-1) > 0.5
    return cosine[seen], roughness[seen], albedo[seen]


def table_of(cosine: np.ndarray, roughness: np.ndarray, albedo: np.ndarray) -> np.ndarray:
    """The table (NODES, NODES), by cosine and roughness, that fits the measurements (P,) best."""
    count = closures.SHEEN_NODES**2
    square, right = np.zeros((count, count)), np.zeros(count)
    found = closures.corners(cosine.astype(np.float64), roughness.astype(np.float64))
    for index, weight in found:
        np.add.at(right, index, weight * albedo)
        for other, other_weight in found:
            np.add.at(square, (index, other), weight * other_weight)
    table = np.linalg.lstsq(square, right, rcond=1e-12)[0]
    return np.maximum(table, 0.0).reshape(closures.SHEEN_NODES, -1).astype(np.float32)


def _add_surface() -> None:
    """A ribbed sheet over the unit square, whose normals turn from sideways to upwards along y, as the cosine grows."""
    cosine = np.linspace(1e-4, 1.0, STRIPS + 1)
    slope = np.sqrt(1.0 - cosine**2) / cosine
    height = -np.concatenate([[0.0], np.cumsum(0.5 * (slope[1:] + slope[:-1]) * np.diff(cosine))])
    places = np.array([(x, y, z) for y, z in zip(cosine, height, strict=True) for x in (0.0, 1.0)])
    first = 2 * np.arange(STRIPS)[:, None]
    mesh = scene_parts.add_mesh("Sheet", places.tolist(), (first + [0, 1, 3, 2]).tolist()).data
    mesh.polygons.foreach_set("use_smooth", [True] * STRIPS)
    normals = np.stack([np.zeros_like(cosine), np.sqrt(1.0 - cosine**2), cosine], axis=-1)
    mesh.normals_split_custom_set_from_vertices(np.repeat(normals, 2, axis=0).tolist())
    white, black = (1.0, 1.0, 1.0, 1.0), (0.0, 0.0, 0.0, 1.0)
    inputs = {"Sheen_Weight": 1.0, "Specular_IOR_Level": 0.0, "Sheen_Tint": white, "Base_Color": black}
    material, node = scene_parts.principled("Sheen", **inputs)
    separate = scene_parts.add_node(material.node_tree, "ShaderNodeSeparateXYZ")
    position = scene_parts.add_node(material.node_tree, "ShaderNodeNewGeometry").outputs["Position"]
    material.node_tree.links.new(position, separate.inputs[0])
    material.node_tree.links.new(separate.outputs["X"], node.inputs["Sheen Roughness"])
    mesh.materials.append(material)


if __name__ == "__main__":
    np.save(closures.PATH, table_of(*measure()))
