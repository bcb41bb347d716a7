"""Makes sheen.npy: measures in Cycles what sheen reflects, and where to (a minute, needs pip's bpy).

From the repository's root: PYTHONPATH=. python tests/blender/helpers/sheen_measurement.py
"""

from __future__ import annotations

import tempfile
from pathlib import Path

import bpy
import numpy as np
import scene_parts
from mathutils import Vector

from ltsh_addon.blender import render_settings
from ltsh_addon.cycles import closures
from ltsh_addon.cycles.lobes import read_layer
from ltsh_addon.imaging.exr import read_channels

PIXELS = 512
STRIPS = 20_000
# Relative error of what counts as found; where there is no sheen, nothing is.
FITTING = 1e-4
# Toward which suns shine, all above the horizons of all strips.
LIGHTS = [(0.0, 1.0, 1.0), (0.6, 1.0, 0.6), (0.0, 0.35, 1.0), (0.0, 1.0, 0.35), (1.0, 0.8, 0.8), (-1.5, 0.6, 0.4)]


def measure(pixels: int = PIXELS) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Cosines (P,), roughness (P,), and albedo, a and b (3, P) of white sheen on black, in a file of its own that stays
    open; see `closures.sheen_lobe`.

    The roughness grows from left to right, the cosine of the view upwards.
    """
    scene, layer = scene_parts.empty_scene(pixels, pixels), bpy.context.view_layer
    _add_surface()
    camera = scene_parts.add_top_camera(1.0)
    camera.location, camera.data.clip_end = (0.5, 0.5, 1.0), 1e3
    scene.render.engine, scene.cycles.samples = "CYCLES", 1
    scene.cycles.use_adaptive_sampling = scene.cycles.use_denoising = False
    layer.use_pass_normal = layer.use_pass_diffuse_color = layer.use_pass_diffuse_direct = True
    names, lights, found = render_settings.pass_names(), np.array(LIGHTS), []
    lights /= np.linalg.norm(lights, axis=1, keepdims=True)
    ob = scene_parts.link(scene_parts.new_light("Sun", "SUN", energy=1.0, angle=0.0))
    with tempfile.TemporaryDirectory(prefix="ltsh-") as name:
        path = Path(name) / "sheen.exr"
        for light in lights:
            ob.rotation_euler = Vector(light).to_track_quat("Z", "Y").to_euler()
            render_settings.render_exr(scene, path)
            channels = read_channels(path)
            found.append(read_layer(channels, names["diffuse_light"], "RGB")[..., 0])
    normal = read_layer(channels, "Normal", "XYZ").astype(np.float64)
    seen = np.linalg.norm(normal, axis=-1) > 0.5
    albedo = read_layer(channels, names["diffuse_color"], "RGB")[..., 0][seen]
    roughness = np.broadcast_to((np.arange(pixels) + 0.5) / pixels, (pixels, pixels))[seen]
    a, b = _shape(normal[seen], lights, np.stack(found)[:, seen])
    return normal[seen][:, 2], roughness, np.stack([albedo, a, b])


def _shape(normal, lights, values):
    """a and b (P,) from the `values` (L, P) of the lobe toward `lights` (L, 3), seen from above.

    The lobe is z / pi (a / q)^2, q = (a x + b z)^2 + (a y)^2 + z^2; from the best of many starts the steps of Gauss and
    Newton lead there.
    """
    cosine = normal[:, 2]
    sine = np.sqrt(np.maximum(1.0 - cosine**2, 1e-12))
    tangent = (np.array([0.0, 0.0, 1.0]) - cosine[:, None] * normal) / sine[:, None]
    axes = (tangent, np.cross(normal, tangent), normal)
    x, y, z = (np.einsum("lc,pc->pl", lights, axis) for axis in axes)
    ratio = np.sqrt(np.maximum(values.T, 1e-12) * np.pi / np.maximum(z, 1e-9))  # a / q
    a, b, least = np.zeros((3, len(normal)))
    least += np.inf
    for start_a in np.geomspace(0.02, 3.0, 16):
        for start_b in np.linspace(-3.0, 3.0, 25):
            q = (start_a * x + start_b * z) ** 2 + (start_a * y) ** 2 + z * z
            away = ((start_a / q - ratio) ** 2).sum(axis=1)
            is_better = away < least
            a[is_better], b[is_better], least[is_better] = start_a, start_b, away[is_better]
    for _ in range(30):
        along = a[:, None] * x + b[:, None] * z
        q = along**2 + (a[:, None] * y) ** 2 + z * z
        away = a[:, None] / q - ratio
        by_a = 1.0 / q - a[:, None] * 2.0 * (x * along + a[:, None] * y * y) / q**2
        by_b = -a[:, None] * 2.0 * z * along / q**2
        slopes = np.stack([by_a, by_b], axis=-1)
        square = np.einsum("pli,plj->pij", slopes, slopes) + 1e-12 * np.eye(2)
        step = np.linalg.solve(square, -np.einsum("pli,pl->pi", slopes, away)[..., None])[..., 0]
        a, b = np.clip(a + step[:, 0], 0.3 * a, 3.0 * a), b + np.clip(step[:, 1], -0.3, 0.3)
    fits = np.abs(away).max(axis=1) < FITTING * ratio.max(axis=1)
    return np.where(fits, a, np.nan), np.where(fits, b, np.nan)


def table_of(cosine: np.ndarray, roughness: np.ndarray, values: np.ndarray) -> np.ndarray:
    """The tables (3, NODES, NODES), by cosine and roughness, that fit the measurements (3, P) best."""
    found = np.isfinite(values).all(axis=0)
    albedo = np.maximum(_fitted(cosine, roughness, values[:1]), 0.0)
    return np.concatenate([albedo, _fitted(cosine[found], roughness[found], values[1:, found])])


def _fitted(cosine, roughness, values) -> np.ndarray:
    count = closures.SHEEN_NODES**2
    square, right = np.zeros((count, count)), np.zeros((count, len(values)))
    corners = _corners(cosine.astype(np.float64), roughness.astype(np.float64))
    for index, weight in corners:
        np.add.at(right, index, weight[:, None] * values.T)
        for other, other_weight in corners:
            np.add.at(square, (index, other), weight * other_weight)
    table = np.linalg.lstsq(square, right, rcond=1e-12)[0]
    return table.T.reshape(-1, closures.SHEEN_NODES, closures.SHEEN_NODES).astype(np.float32)


def _corners(x: np.ndarray, y: np.ndarray) -> list[tuple[np.ndarray, np.ndarray]]:
    """Bilinear interpolation at points of the unit square: numbers (P,) of four nodes in the table and weights (P,)."""
    last = closures.SHEEN_NODES - 1
    column, row = (np.minimum((last * value).astype(int), last - 1) for value in (x, y))
    return [
        (
            (column + i) * closures.SHEEN_NODES + row + j,
            np.abs(1 - i - (last * x - column)) * np.abs(1 - j - (last * y - row)),
        )
        for i in (0, 1)
        for j in (0, 1)
    ]


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
