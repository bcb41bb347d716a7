"""Builders of the scenes of `finished_scenes`: materials with textures, meshes, lamps, a camera, skies; needs bpy.

Materials are Principled BSDFs with the settings that Blender gives new ones, and so is Cycles: a scene stands as an
artist would send it.
"""

import math
from pathlib import Path

import bpy
import mathutils
import numpy as np

Vector = mathutils.Vector


def empty_scene(width: int, height: int, exposure: float = 0.0):
    """A factory-empty file for Cycles."""
    bpy.ops.wm.read_factory_settings(use_empty=True)
    scene = bpy.context.scene
    scene.render.engine = "CYCLES"
    scene.render.resolution_x, scene.render.resolution_y = width, height
    scene.view_settings.exposure = exposure
    return scene


def save_seeds(folder: Path, name: str, seeds) -> None:
    """Save the scene as FOLDER/NAME_SEED.blend for each seed of Cycles."""
    for seed in seeds:
        bpy.context.scene.cycles.seed = seed
        bpy.ops.wm.save_as_mainfile(filepath=str(folder / f"{name}_{seed}.blend"))


# Materials:


def material(name, color=(0.8, 0.8, 0.8), roughness=0.5, **inputs):
    """A Principled BSDF; underscores in names of inputs stand for spaces."""
    made = bpy.data.materials.new(name)
    if bpy.app.version < (5, 0, 0):
        made.use_nodes = True
    for key, value in {"Base_Color": (*color, 1.0), "Roughness": roughness, **inputs}.items():
        shader(made).inputs[key.replace("_", " ")].default_value = value
    return made


def shader(surface):
    """The Principled BSDF of a material."""
    return next(node for node in surface.node_tree.nodes if node.bl_idname == "ShaderNodeBsdfPrincipled")


def glowing(name, color, strength):
    """A black material that shines."""
    return material(
        name, (0, 0, 0), 1.0, Specular_IOR_Level=0.0, Emission_Color=(*color, 1.0), Emission_Strength=strength
    )


def texture(tree, kind, scale, stretch=(1, 1, 1), coordinates="Object", **inputs):
    """A texture node of `kind` (Noise, Wave, ...) over `coordinates`; properties of the node are among the inputs."""
    node = tree.nodes.new(f"ShaderNodeTex{kind}")
    mapping, source = tree.nodes.new("ShaderNodeMapping"), tree.nodes.new("ShaderNodeTexCoord")
    mapping.inputs["Scale"].default_value = stretch
    tree.links.new(source.outputs[coordinates], mapping.inputs["Vector"])
    tree.links.new(mapping.outputs["Vector"], node.inputs["Vector"])
    for key, value in {"Scale": scale, **inputs}.items():
        if hasattr(node, key):
            setattr(node, key, value)
        else:
            node.inputs[key.replace("_", " ")].default_value = value
    return node


def factor(node):
    """The output of a texture that is a number."""
    return next(socket for socket in node.outputs if socket.enabled and socket.type == "VALUE")


def drive(surface, socket, node, low, high, span=(0.0, 1.0)):
    """Let a texture take an input of the BSDF from `low` to `high`, numbers or colors, over its `span`."""
    tree, target = surface.node_tree, shader(surface).inputs[socket]
    if isinstance(low, tuple):
        middle = tree.nodes.new("ShaderNodeValToRGB")
        for element, color, position in zip(middle.color_ramp.elements, (low, high), span, strict=True):
            element.color, element.position = (*color, 1.0), position
    else:
        middle = tree.nodes.new("ShaderNodeMapRange")
        for key, value in zip(("From Min", "From Max", "To Min", "To Max"), (*span, low, high), strict=True):
            middle.inputs[key].default_value = value
    tree.links.new(factor(node), middle.inputs[0])
    tree.links.new(middle.outputs[0], target)
    return surface


def bump(surface, node, strength=0.3, distance=0.02):
    """Let a texture bump the BSDF."""
    made = surface.node_tree.nodes.new("ShaderNodeBump")
    made.inputs["Strength"].default_value, made.inputs["Distance"].default_value = strength, distance
    surface.node_tree.links.new(factor(node), made.inputs["Height"])
    surface.node_tree.links.new(made.outputs["Normal"], shader(surface).inputs["Normal"])
    return surface


def worn(name, color, roughness, scale=8.0, spread=0.12, depth=0.0, **inputs):
    """A material whose roughness varies by noise; with a `depth` the noise bumps it too."""
    surface = material(name, color, roughness, **inputs)
    noise = texture(surface.node_tree, "Noise", scale, Detail=4.0)
    drive(surface, "Roughness", noise, max(roughness - spread, 0.0), roughness + spread, (0.3, 0.7))
    return bump(surface, noise, depth) if depth else surface


def wood(name, dark=(0.2, 0.09, 0.035), light=(0.42, 0.23, 0.11), scale=3.0, stretch=(1, 8, 1)):
    """Lacquered wood with grain in its color and its bumps."""
    surface = worn(name, light, 0.35, 6.0)
    grain = texture(surface.node_tree, "Wave", scale, stretch, **{"Distortion": 4.0, "Detail": 2.0})
    return bump(drive(surface, "Base Color", grain, dark, light), grain, 0.12)


def brushed(name, color=(0.8, 0.78, 0.75), roughness=0.3, **inputs):
    """Anisotropic metal with noise in its roughness."""
    return worn(name, color, roughness, 14.0, 0.12, Metallic=1.0, Anisotropic=0.8, **inputs)


def tiles(name, color, grout, scale, roughness=0.15, width=0.5, height=0.25):
    """Glazed tiles in rough joints."""
    surface = material(name, color, roughness)
    bricks = {"Mortar_Size": 0.012, "Brick_Width": width, "Row_Height": height}
    brick = texture(surface.node_tree, "Brick", scale, coordinates="UV", **bricks)
    drive(surface, "Roughness", brick, roughness, 0.8)
    return bump(drive(surface, "Base Color", brick, color, grout), brick, -0.3)


def glass(name, roughness=0.0, color=(1, 1, 1)):
    """Clear glass."""
    return material(name, color, roughness, **{"Transmission_Weight": 1.0, "IOR": 1.45})


# Meshes:


def mesh(name, vertices, faces, surface, smooth=False, uv=None):
    """An object of a mesh; `uv` (N, 2) by vertex."""
    data = bpy.data.meshes.new(name)
    data.from_pydata([tuple(map(float, vertex)) for vertex in vertices], [], faces)
    data.materials.append(surface)
    data.polygons.foreach_set("use_smooth", [smooth] * len(data.polygons))
    if uv is not None:
        corners = np.array([vertex for face in faces for vertex in face])
        data.uv_layers.new(name="UVMap").data.foreach_set("uv", np.asarray(uv, np.float32)[corners].ravel())
    ob = bpy.data.objects.new(name, data)
    bpy.context.scene.collection.objects.link(ob)
    return ob


def grid(name, points, surface, smooth=True, closed=False):
    """A surface through points (U, V, 3) with UV from 0 to 1; `closed` along V."""
    rows, columns = points.shape[:2]
    index = np.arange(rows * columns).reshape(rows, columns)
    after = np.roll(index, -1, axis=1) if closed else index[:, 1:]
    index = index if closed else index[:, :-1]
    faces = np.stack([index[:-1], after[:-1], after[1:], index[1:]], axis=-1).reshape(-1, 4).tolist()
    u, v = np.meshgrid(np.linspace(0, 1, rows), np.linspace(0, 1, columns), indexing="ij")
    return mesh(name, points.reshape(-1, 3), faces, surface, smooth, np.stack([v, u], axis=-1).reshape(-1, 2))


def lathe(name, profile, surface, location=(0, 0, 0), segments=48):
    """A body of revolution about z of a profile of (radius, height)."""
    angle = np.linspace(0.0, 2.0 * np.pi, segments, endpoint=False)
    radius, height = np.asarray(profile, dtype=float).T[..., None]
    points = np.stack(np.broadcast_arrays(radius * np.cos(angle), radius * np.sin(angle), height), axis=-1)
    ob = grid(name, points + np.asarray(location), surface, closed=True)
    ob.modifiers.new("Edges", "EDGE_SPLIT").split_angle = math.radians(50)
    return ob


def panel(name, corner, u, v, surface, per_meter=1.0):
    """A rectangle from a corner along two sides, whose normal is u x v, with UV in meters times `per_meter`."""
    corner, u, v = (np.asarray(value, dtype=float) for value in (corner, u, v))
    size = per_meter * np.array([np.linalg.norm(u), np.linalg.norm(v)])
    points = [corner, corner + u, corner + u + v, corner + v]
    return mesh(name, points, [(0, 1, 2, 3)], surface, uv=size * [(0, 0), (1, 0), (1, 1), (0, 1)])


def put(kind, name, surface, location, rotation=(0, 0, 0), scale=(1, 1, 1), bevel=0.0, **settings):
    """A primitive mesh, smooth unless it is a cube or a plane; `bevel` rounds its edges (m)."""
    smooth = kind not in ("cube", "plane")
    getattr(bpy.ops.mesh, f"primitive_{kind}_add")(location=location, rotation=rotation, **settings)
    ob = bpy.context.object
    ob.name, ob.scale = name, scale
    ob.data.materials.append(surface)
    if bevel:
        ob.data.transform(mathutils.Matrix(np.diag((*scale, 1.0))))
        ob.scale = (1, 1, 1)
        rounded = ob.modifiers.new("Bevel", "BEVEL")
        rounded.width, rounded.segments, rounded.limit_method = bevel, 3, "ANGLE"
    ob.data.polygons.foreach_set("use_smooth", [smooth] * len(ob.data.polygons))
    if smooth:
        ob.modifiers.new("Edges", "EDGE_SPLIT").split_angle = math.radians(40)
    return ob


def ball(name, surface, location, radius, rotation=(0, 0, 0)):
    """A sphere, or a spheroid with three radii."""
    scale = radius if isinstance(radius, tuple) else (radius,) * 3
    ob = put("uv_sphere", name, surface, location, rotation, radius=1, segments=48, ring_count=24)
    ob.data.transform(mathutils.Matrix(np.diag((*scale, 1.0))))


def rod(name, surface, location, size, rotation=(0, 0, 0), bevel=0.0, vertices=32):
    """A cylinder of `size` (radius, depth) along z."""
    size = {"radius": size[0], "depth": size[1], "vertices": vertices}
    return put("cylinder", name, surface, location, rotation, bevel=bevel, **size)


def box(name, low, high, surface, bevel=0.0):
    """A box with sides along the axes between two corners."""
    low, high = np.asarray(low, dtype=float), np.asarray(high, dtype=float)
    return put("cube", name, surface, (low + high) / 2, scale=tuple(high - low), bevel=bevel, size=1)


def copies(ob, locations, turns=None, sizes=None):
    """Further objects of the mesh of `ob`."""
    for number, location in enumerate(locations):
        copy = ob.copy()
        bpy.context.scene.collection.objects.link(copy)
        copy.location = location
        if turns is not None:
            copy.rotation_euler = turns[number]
        if sizes is not None:
            copy.scale = (sizes[number],) * 3


# Lamps, camera, skies:


def _toward(location, target):
    """Angles that turn the -z axis from a location to a target."""
    return (Vector(target) - Vector(location)).to_track_quat("-Z", "Y").to_euler()


def _linked(name, data, location, target):
    ob = bpy.data.objects.new(name, data)
    bpy.context.scene.collection.objects.link(ob)
    ob.location, ob.rotation_euler = location, _toward(location, target)
    return ob


def camera(location, target, lens=50.0):
    """The camera of the scene."""
    data = bpy.data.cameras.new("Camera")
    data.lens = lens
    bpy.context.scene.camera = _linked("Camera", data, location, target)


def lamp(kind, name, power, location, target=None, color=(1, 1, 1), **settings):
    """A lamp of `kind` ("AREA", "POINT", "SPOT", "SUN")."""
    data = bpy.data.lights.new(name, kind)
    data.energy, data.color = power, color
    for key, value in settings.items():
        setattr(data, key, value)
    return _linked(name, data, location, target or np.asarray(location) - (0.0, 0.0, 1.0))


def point(name, power, location, color, radius):
    """A point light."""
    return lamp("POINT", name, power, location, None, color, shadow_soft_size=radius)


def spot(name, power, location, target, color, cone):
    """A spot of a small radius with a soft edge."""
    soft = {"spot_blend": 0.5, "shadow_soft_size": 0.06}
    return lamp("SPOT", name, power, location, target, color, spot_size=cone, **soft)


def softbox(name, power, size, location, target, color=(1, 1, 1)):
    """An area light of `size` (m), or a disk if that is one number."""
    shape = {"shape": "DISK", "size": size}
    if isinstance(size, tuple):
        shape = {"shape": "RECTANGLE", "size": size[0], "size_y": size[1]}
    return lamp("AREA", name, power, location, target, color, **shape)


def world(color=(0, 0, 0), strength=1.0):
    """A sky of one color; its node tree and its Background node."""
    made = bpy.context.scene.world = bpy.data.worlds.new("World")
    if bpy.app.version < (5, 0, 0):
        made.use_nodes = True
    tree = made.node_tree
    tree.nodes.clear()
    background, output = tree.nodes.new("ShaderNodeBackground"), tree.nodes.new("ShaderNodeOutputWorld")
    background.inputs["Color"].default_value, background.inputs["Strength"].default_value = (*color, 1.0), strength
    tree.links.new(background.outputs[0], output.inputs["Surface"])
    return tree, background


def gradient_world(low, high, strength):
    """A sky from one color below to another above."""
    tree, background = world(strength=strength)
    source, apart = tree.nodes.new("ShaderNodeTexCoord"), tree.nodes.new("ShaderNodeSeparateXYZ")
    up, ramp = tree.nodes.new("ShaderNodeMapRange"), tree.nodes.new("ShaderNodeValToRGB")
    up.inputs["From Min"].default_value = -1.0
    for element, color in zip(ramp.color_ramp.elements, (low, high), strict=True):
        element.color = (*color, 1.0)
    tree.links.new(source.outputs["Generated"], apart.inputs[0])
    tree.links.new(apart.outputs["Z"], up.inputs[0])
    tree.links.new(up.outputs[0], ramp.inputs[0])
    tree.links.new(ramp.outputs[0], background.inputs["Color"])


def daylight(elevation, azimuth, sun=3.0, sky=1.0, angle=0.01):
    """A sun lamp (W/m^2) and Blender's sky without the disk of its sun, angles in degrees."""
    tree, background = world(strength=sky)
    node = tree.nodes.new("ShaderNodeTexSky")
    node.sky_type = "HOSEK_WILKIE"
    up, around = math.radians(elevation), math.radians(azimuth)
    direction = np.array([math.cos(up) * math.cos(around), math.cos(up) * math.sin(around), math.sin(up)])
    node.sun_direction = direction
    tree.links.new(node.outputs[0], background.inputs["Color"])
    lamp("SUN", "Sun", sun, direction * 20.0, (0.0, 0.0, 0.0), (1.0, 0.93, 0.82), angle=angle)
