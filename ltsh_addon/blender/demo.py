"""The example scene: an arcade with plastic, metal and area lights."""

from __future__ import annotations

from pathlib import Path

import bpy
import numpy as np
from mathutils import Matrix, Vector

from . import demo_meshes
from .demo_meshes import BALL_ROUGHNESS, Part, everything
from .process.blend_file import DemoJob
from .saving import save_copy

RESOLUTION = (480, 270)
CAMERA = {"location": (0.25, -6.55, 1.12), "target": (0.0, 0.0, 0.98), "lens": 29.0}

# fmt: off
# Sizes in m, power in W. `up` is the world direction of the light's y axis.
LIGHTS = (
    {"name": "Neon", "shape": "RECTANGLE", "size": 5.2, "size_y": 0.22, "color": (1.0, 0.06, 0.62), "energy": 110.0,
     "location": (2.75, -0.6, 2.35), "target": (-0.6, -0.6, 0.3), "up": (0.0, 0.0, 1.0)},
    {"name": "Porthole", "shape": "DISK", "size": 1.5, "color": (0.05, 0.75, 1.0), "energy": 100.0,
     "location": (-2.9, -1.4, 2.3), "target": (0.6, -0.4, 0.4), "up": (0.0, 0.0, 1.0)},
    {"name": "Sunset", "shape": "ELLIPSE", "size": 1.9, "size_y": 0.8, "color": (1.0, 1.0, 1.0), "energy": 60.0,
     "temperature": 2100.0, "location": (0.0, 2.7, 1.5), "target": (0.0, -6.0, 0.6), "up": (0.0, 0.0, 1.0)},
    {"name": "Skylight", "shape": "SQUARE", "size": 2.4, "color": (0.80, 0.88, 1.0), "energy": 22.0, "exposure": 1.0,
     "location": (0.0, -3.4, 3.9), "target": (0.0, 1.4, 0.9), "up": (0.0, 1.0, 0.0)},
)
# fmt: on

# Base color (linear), metallic, roughness, index of refraction.
MATERIALS = {
    "metal trim": ((0.90, 0.88, 0.85), 1.0, 0.18, 1.5),
    "metal steel": ((0.72, 0.72, 0.74), 1.0, 0.25, 1.5),
    "metal iron": ((0.45, 0.44, 0.44), 1.0, 0.42, 1.5),
    "metal gold": ((1.00, 0.71, 0.29), 1.0, 0.22, 1.5),
    "metal copper": ((0.95, 0.60, 0.48), 1.0, 0.35, 1.5),
    "plastic black": ((0.012, 0.012, 0.016), 0.0, 0.35, 1.5),
    "plastic bezel": ((0.010, 0.010, 0.014), 0.0, 0.15, 1.5),
    "plastic violet": ((0.16, 0.03, 0.55), 0.0, 0.30, 1.5),
    "plastic cyan": ((0.01, 0.38, 0.50), 0.0, 0.22, 1.5),
    "plastic orange": ((0.80, 0.17, 0.02), 0.0, 0.40, 1.5),
    "plastic magenta": ((0.62, 0.02, 0.26), 0.0, 0.26, 1.5),
    "plastic button red": ((0.75, 0.02, 0.03), 0.0, 0.16, 1.5),
    "plastic button yellow": ((0.85, 0.55, 0.03), 0.0, 0.20, 1.5),
    "wall paint": ((0.035, 0.025, 0.08), 0.0, 0.50, 1.45),
}
METAL_BALLS = (
    (0.93, 0.92, 0.90),
    (0.95, 0.72, 0.42),
    (0.92, 0.55, 0.42),
    (0.75, 0.78, 0.85),
    (0.90, 0.88, 0.84),
    (0.85, 0.64, 0.34),
)
PLASTIC_BALLS = (
    (0.75, 0.02, 0.04),
    (0.85, 0.35, 0.01),
    (0.10, 0.55, 0.06),
    (0.01, 0.30, 0.60),
    (0.25, 0.04, 0.60),
    (0.75, 0.72, 0.68),
)


def _image(name: str, values: np.ndarray, *, data: bool, precise: bool = False) -> bpy.types.Image:
    """A packed image of `values` (H, W) or (H, W, 3), row 0 at the bottom; `data` images are not color managed."""
    height, width = values.shape[:2]
    image = bpy.data.images.new(name, width, height, alpha=False, float_buffer=precise, is_data=data)
    pixels = np.ones((height, width, 4), dtype=np.float32)
    pixels[..., :3] = values if values.ndim == 3 else values[..., None]
    image.pixels.foreach_set(pixels.ravel())
    image.update()
    image.pack()
    return image


def _new_material(name: str) -> tuple[bpy.types.Material, bpy.types.Node]:
    """An empty material and its output node."""
    material = bpy.data.materials.new(name)
    if bpy.app.version < (5, 0, 0):  # later versions always have nodes and warn
        material.use_nodes = True
    material.node_tree.nodes.clear()
    return material, material.node_tree.nodes.new("ShaderNodeOutputMaterial")


def _principled(name: str, color, metallic: float, roughness: float, ior: float) -> bpy.types.Node:
    """The shader node of a new material with one Principled BSDF, single scattering."""
    material, output = _new_material(name)
    shader = material.node_tree.nodes.new("ShaderNodeBsdfPrincipled")
    shader.distribution = "GGX"
    shader.inputs["Base Color"].default_value = (*color, 1.0)
    shader.inputs["Metallic"].default_value = metallic
    shader.inputs["Roughness"].default_value = roughness
    shader.inputs["IOR"].default_value = ior
    material.node_tree.links.new(shader.outputs["BSDF"], output.inputs["Surface"])
    return shader


def _link_image(shader: bpy.types.Node, socket: str, image: bpy.types.Image, *, sharp: bool = False) -> None:
    """Feed the input `socket` of `shader` from `image`; `sharp` shows its texels."""
    tree = shader.id_data
    texture = tree.nodes.new("ShaderNodeTexImage")
    texture.image = image
    texture.interpolation = "Closest" if sharp else "Linear"
    source = texture.outputs["Color"]
    if socket == "Normal":
        bump = tree.nodes.new("ShaderNodeNormalMap")
        tree.links.new(source, bump.inputs["Color"])
        source = bump.outputs["Normal"]
    tree.links.new(source, shader.inputs[socket])


def _materials() -> None:
    """Make all materials; parts refer to them by name."""
    for name, values in MATERIALS.items():
        _principled(name, *values)
    for kind, colors in (("metal", METAL_BALLS), ("plastic", PLASTIC_BALLS)):
        for roughness, color in zip(BALL_ROUGHNESS, colors, strict=True):
            _principled(f"{kind} {roughness:.2f}", color, float(kind == "metal"), roughness, 1.5)
    roughness, color = demo_meshes.floor_textures()
    floor = _principled("floor tiles", (0.02, 0.02, 0.03), 0.0, 0.25, 1.6)
    _link_image(floor, "Roughness", _image("floor roughness", roughness, data=True))
    _link_image(floor, "Base Color", _image("floor color", color, data=False))
    wall = _principled("wall quilted", (0.20, 0.02, 0.16), 0.0, 0.30, 1.5)
    normals = demo_meshes.encoded_normals(demo_meshes.quilted_normals())
    _link_image(wall, "Normal", _image("wall normal", normals, data=True, precise=True))
    screen = _principled("plastic screen", (0.1, 0.1, 0.2), 0.0, 0.12, 1.5)
    _link_image(screen, "Base Color", _image("screen", demo_meshes.screen_picture(), data=False), sharp=True)
    marquee = _principled("plastic marquee", (0.5, 0.2, 0.4), 0.0, 0.20, 1.5)
    _link_image(marquee, "Base Color", _image("marquee", demo_meshes.side_art(), data=False))
    material, output = _new_material("metal brushed")
    glossy = material.node_tree.nodes.new("ShaderNodeBsdfAnisotropic")
    glossy.distribution = "GGX"
    glossy.inputs["Color"].default_value = (0.55, 0.56, 0.60, 1.0)
    glossy.inputs["Roughness"].default_value = 0.32
    material.node_tree.links.new(glossy.outputs["BSDF"], output.inputs["Surface"])


def _add_object(name: str, data) -> bpy.types.Object:
    obj = bpy.data.objects.new(name, data)
    bpy.context.scene.collection.objects.link(obj)
    return obj


def _add_part(part: Part) -> None:
    mesh = bpy.data.meshes.new(part.name)
    mesh.from_pydata(part.shape.vertices.tolist(), [], part.shape.faces())
    if part.shape.uv is not None:
        mesh.uv_layers.new(name="UVMap").data.foreach_set("uv", part.shape.uv.astype(np.float32).ravel())
    mesh.shade_smooth()
    mesh.set_sharp_from_angle(angle=np.radians(32.0))
    mesh.materials.append(bpy.data.materials[part.material])
    obj = _add_object(part.name, mesh)
    obj.matrix_world = Matrix.Translation(part.location) @ Matrix(part.rotation.tolist()).to_4x4()
    if part.bevel > 0.0:
        bevel = obj.modifiers.new("Bevel", "BEVEL")
        bevel.width, bevel.segments, bevel.harden_normals = part.bevel, 4, True
        bevel.limit_method, bevel.angle_limit = "ANGLE", np.radians(30.0)


def _aimed(location, target, up) -> Matrix:
    """Matrix that places the origin at `location`, points -z at `target` and y as far as possible along `up`."""
    backward = (Vector(location) - Vector(target)).normalized()
    right = Vector(up).cross(backward).normalized()
    axes = Matrix((right, backward.cross(right), backward)).transposed()
    return Matrix.Translation(location) @ axes.to_4x4()


def _add_light(settings: dict) -> None:
    light = bpy.data.lights.new(settings["name"], "AREA")
    light.shape, light.size = settings["shape"], settings["size"]
    light.size_y = settings.get("size_y", settings["size"])
    light.color, light.energy = settings["color"], settings["energy"]
    light.exposure, light.normalize, light.spread = settings.get("exposure", 0.0), True, np.pi
    if "temperature" in settings:
        light.use_temperature, light.temperature = True, settings["temperature"]
    _add_object(settings["name"], light).matrix_world = _aimed(settings["location"], settings["target"], settings["up"])


def _set_up_view() -> None:
    """Camera, black world, render settings."""
    scene = bpy.context.scene
    camera = bpy.data.cameras.new("Camera")
    camera.lens = CAMERA["lens"]
    scene.camera = _add_object("Camera", camera)
    scene.camera.matrix_world = _aimed(CAMERA["location"], CAMERA["target"], (0.0, 0.0, 1.0))
    scene.world = bpy.data.worlds.new("Night")
    if bpy.app.version < (5, 0, 0):
        scene.world.use_nodes = True
    background = next(node for node in scene.world.node_tree.nodes if node.bl_idname == "ShaderNodeBackground")
    background.inputs["Color"].default_value = (0.0, 0.0, 0.0, 1.0)
    render = scene.render
    render.engine = "CYCLES"
    render.resolution_x, render.resolution_y = RESOLUTION
    render.resolution_percentage = 100
    scene.display_settings.display_device = "sRGB"
    scene.view_settings.view_transform, scene.view_settings.look = "Standard", "None"
    scene.view_settings.exposure, scene.view_settings.gamma = 0.0, 1.0


def build(path: Path) -> None:
    """Save the example scene as `path`; it replaces the file that is open in Blender."""
    bpy.ops.wm.read_factory_settings(use_empty=True)
    _materials()
    for part in everything():
        _add_part(part)
    for settings in LIGHTS:
        _add_light(settings)
    _set_up_view()
    save_copy(Path(path), check_existing=False)


def build_demo(job: DemoJob, folder: Path, progress) -> dict:
    """Do the `job`; returns an empty manifest."""
    progress("build scene", 0.0)
    build(Path(job.path))
    return {}
