"""The example scene: an arcade with plastic, metal and area lights."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import bpy
import numpy as np
from mathutils import Matrix, Vector

from . import demo_meshes
from .demo_meshes import SPRITES
from .saving import save_copy

BALL_ROUGHNESS = (0.10, 0.18, 0.28, 0.40, 0.55, 0.80)  # of both rows of balls, from the front to the back
FLOOR_SIZE = 9.6  # m, edge of the square floor
WALL_Y, WALL_SIZE = 3.0, (8.4, 4.2)  # m


@dataclass(frozen=True)
class Part:
    """A shape in its place, the name of its material and the width in m of its bevels (0: none)."""

    name: str
    shape: demo_meshes.Shape
    material: str
    location: tuple[float, float, float] = (0.0, 0.0, 0.0)
    rotation: np.ndarray = field(default_factory=lambda: np.eye(3))
    bevel: float = 0.0


CABINET_WIDTH = 0.72
# fmt: off
CABINET_OUTLINE = (  # y and z of the side view, counterclockwise as seen from +x; the front is at -y
    (-0.42, 0.10), (0.40, 0.10), (0.40, 1.86), (-0.26, 1.92), (-0.44, 1.86), (-0.46, 1.60), (-0.20, 1.53),
    (-0.34, 1.06), (-0.62, 0.98), (-0.62, 0.90), (-0.42, 0.82),
)


# fmt: on


def _slope(lower, upper) -> tuple[np.ndarray, np.ndarray]:
    """Rotation that lays the plane z = 0 on a face of the cabinet between two points (y, z), and the face's middle."""
    along = np.subtract(upper, lower)
    degrees = np.degrees(np.arctan2(along[1], along[0]))
    return demo_meshes.rotation("x", degrees), np.array([0.0, *(0.5 * np.add(lower, upper))])


def _controls() -> dict[str, demo_meshes.Shape]:
    """Knobs, sticks and the coin door of a cabinet, by material."""
    tilt, middle = _slope(CABINET_OUTLINE[8], CABINET_OUTLINE[7])
    button = demo_meshes.drum(0.024, 0.022, 0.010, segments=32)
    place = [(x, y) for x in (0.05, 0.12, 0.19) for y in (-0.045, 0.035)]
    knobs = [button.moved((x, y + 0.15 * x, 0.0)).moved(middle, tilt) for x, y in place]
    rod = demo_meshes.tube([(0.0, 0.0, z) for z in np.linspace(0.0, 0.11, 4)], 0.009, closed=False)
    collar = demo_meshes.drum(0.035, 0.012, 0.005, segments=32)
    knob = demo_meshes.sphere(0.036, 48)
    left = np.array([-0.15, 0.0, 0.0])
    steel = [rod.moved(left).moved(middle, tilt), collar.moved(left).moved(middle, tilt)]
    upright, door = _slope(CABINET_OUTLINE[0], CABINET_OUTLINE[10])
    return {
        "plastic button red": demo_meshes.joined(knobs[::2] + [knob.moved(left + (0, 0, 0.125)).moved(middle, tilt)]),
        "plastic button yellow": demo_meshes.joined(knobs[1::2]),
        "metal steel": demo_meshes.joined(steel),
        "metal iron": demo_meshes.box((0.34, 0.40, 0.02)).moved(door, upright),
    }


def cabinet(name: str, material: str, location, degrees: float) -> list[Part]:
    """An arcade cabinet with sides of `material`, turned by `degrees` from facing -y."""
    half = 0.5 * CABINET_WIDTH
    core = demo_meshes.extruded(CABINET_OUTLINE, CABINET_WIDTH - 0.03)
    silhouette = demo_meshes.outset(CABINET_OUTLINE, 0.035)
    side = demo_meshes.extruded(silhouette, 0.036)
    round_edge = demo_meshes.rounded_outline(silhouette, 0.03)
    edge = np.column_stack([np.zeros(len(round_edge)), round_edge])
    edging = demo_meshes.tube(edge, 0.017, closed=True)
    tilt, middle = _slope(CABINET_OUTLINE[7], CABINET_OUTLINE[6])
    sign_tilt, sign = _slope(CABINET_OUTLINE[5], CABINET_OUTLINE[4])
    up = np.array([0.0, 0.0, 1.0])
    parts = {
        material: (demo_meshes.joined([side.moved((x, 0, 0)) for x in (-half, half)]), 0.008),
        "plastic black": (
            demo_meshes.joined([core, demo_meshes.box((0.66, 0.74, 0.10)).moved((0.0, 0.0, 0.05))]),
            0.006,
        ),
        "metal trim": (demo_meshes.joined([edging.moved((x, 0, 0)) for x in (-half, half)]), 0.0),
        "plastic bezel": (demo_meshes.box((0.64, 0.47, 0.016)).moved(middle, tilt), 0.006),
        "plastic screen": (demo_meshes.plate((0.50, 0.41)).moved(middle + 0.0085 * tilt @ up, tilt), 0.0),
        "plastic marquee": (demo_meshes.plate((0.62, 0.22)).moved(sign + 0.002 * sign_tilt @ up, sign_tilt), 0.0),
    }
    parts |= {key: (shape, 0.004 if key == "metal iron" else 0.0) for key, shape in _controls().items()}
    turn = demo_meshes.rotation("z", degrees)
    return [Part(f"{name} {key}", shape, key, tuple(location), turn, bevel) for key, (shape, bevel) in parts.items()]


def ball_row(kind: str, start, end, radius: float = 0.19) -> list[Part]:
    """A low shelf from `start` to `end` (x, y) m with one ball per roughness, made of `kind` (metal or plastic)."""
    start, end = np.array(start), np.array(end)
    along = end - start
    degrees = np.degrees(np.arctan2(along[1], along[0]))
    length, height = np.linalg.norm(along) + 3.0 * radius, 0.12
    middle = 0.5 * (start + end)
    shelf = demo_meshes.box((length, 2.6 * radius, height)).moved((0.0, 0.0, 0.5 * height))
    outline = [(x * length / 2, y * 1.3 * radius, height) for x, y in ((-1, -1), (1, -1), (1, 1), (-1, 1))]
    rail = demo_meshes.tube(demo_meshes.rounded_outline(outline, 0.05), 0.014, closed=True)
    turn = demo_meshes.rotation("z", degrees)
    parts = [
        Part(f"{kind} shelf", shelf, "plastic black", (*middle, 0.0), turn, bevel=0.02),
        Part(f"{kind} rail", rail, "metal trim", (*middle, 0.0), turn),
    ]
    for share, roughness in zip(np.linspace(0.0, 1.0, len(BALL_ROUGHNESS)), BALL_ROUGHNESS, strict=True):
        place = (*(start + share * along), height + radius)
        parts.append(Part(f"{kind} ball {roughness:.2f}", demo_meshes.sphere(radius), f"{kind} {roughness:.2f}", place))
    return parts


def knot(radius: float, thickness: float, points: int = 360) -> demo_meshes.Shape:
    """A trefoil: a tube that winds three times around a ring while it goes round twice."""
    t = demo_meshes.FULL_TURN * np.arange(points) / points
    ring = radius * (1.0 + 0.42 * np.cos(3.0 * t))
    path = np.stack([ring * np.cos(2.0 * t), ring * np.sin(2.0 * t), 0.55 * radius * np.sin(3.0 * t)], axis=-1)
    return demo_meshes.tube(path, thickness, closed=True, sides=40)


def sculpture(location) -> list[Part]:
    """A golden knot that stands on a brushed drum."""
    x, y = location
    upright = demo_meshes.rotation("z", 20.0) @ demo_meshes.rotation("x", 82.0)
    base = demo_meshes.drum(0.52, 0.42, 0.03, segments=128)
    ring = np.array(
        [(0.52 * np.cos(a), 0.52 * np.sin(a), 0.10) for a in np.linspace(0, demo_meshes.FULL_TURN, 97)[:-1]]
    )
    return [
        Part("pedestal", base, "metal brushed", (x, y, 0.0)),
        Part("pedestal ring", demo_meshes.tube(ring, 0.016, closed=True), "metal trim", (x, y, 0.0)),
        Part("knot", knot(0.36, 0.105), "metal gold", (x, y, 1.02), upright),
    ]


def sprite_sign(sprite: str, cell: float, location) -> list[Part]:
    """A creature of bevelled cubes with edges of `cell` m, fixed to the back wall."""
    rows = SPRITES[sprite]
    cube = demo_meshes.box((0.93 * cell, 0.93 * cell, 0.93 * cell))
    places = [
        ((j - 0.5 * (len(line) - 1)) * cell, 0.0, (0.5 * (len(rows) - 1) - i) * cell)
        for i, line in enumerate(rows)
        for j, letter in enumerate(line)
        if letter == "#"
    ]
    return [
        Part(
            f"sign {sprite}",
            demo_meshes.joined([cube.moved(p) for p in places]),
            "metal copper",
            location,
            bevel=0.09 * cell,
        )
    ]


def room() -> list[Part]:
    """Floor, padded back wall and plain side walls."""
    floor = demo_meshes.plate((FLOOR_SIZE, FLOOR_SIZE))
    wall = demo_meshes.plate(WALL_SIZE, (WALL_SIZE[0] / 0.7, WALL_SIZE[1] / 0.7))
    side = demo_meshes.plate((FLOOR_SIZE, WALL_SIZE[1]))
    stand = demo_meshes.rotation("x", 90.0)
    middle_y, height = WALL_Y - 0.5 * FLOOR_SIZE, 0.5 * WALL_SIZE[1]
    parts = [
        Part("floor", floor, "floor tiles", (0.0, middle_y, 0.0)),
        Part("back wall", wall, "wall quilted", (0.0, WALL_Y, height), stand),
    ]
    for name, sign in (("left wall", -1), ("right wall", 1)):
        turn = demo_meshes.rotation("z", -90.0 * sign) @ stand
        parts.append(Part(name, side, "wall paint", (sign * 0.45 * WALL_SIZE[0], middle_y, height), turn))
    return parts


def everything() -> list[Part]:
    """All parts of the scene."""
    parts = room() + sculpture((0.0, 0.9)) + sprite_sign("moth", 0.14, (0.0, WALL_Y - 0.1, 2.35))
    rows = (
        (-2.35, 62.0, ("plastic violet", "plastic cyan", "plastic orange", "plastic magenta")),
        (2.35, -62.0, ("plastic cyan", "plastic magenta", "plastic violet", "plastic orange")),
    )
    for x, degrees, bodies in rows:
        for index, (body, y) in enumerate(zip(bodies, (-2.3, -1.1, 0.1, 1.3), strict=True)):
            side = "left" if x < 0.0 else "right"
            parts += cabinet(f"cabinet {side} {index + 1}", body, (x, y, 0.0), degrees)
    parts += ball_row("metal", (-1.15, -3.75), (-0.95, -0.9))
    parts += ball_row("plastic", (1.15, -3.75), (0.95, -0.9))
    return parts


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
    """Write the example scene to `path`; what Blender has open is replaced by it."""
    bpy.ops.wm.read_factory_settings(use_empty=True)
    _materials()
    for part in everything():
        _add_part(part)
    for settings in LIGHTS:
        _add_light(settings)
    _set_up_view()
    save_copy(Path(path), check_existing=False)
