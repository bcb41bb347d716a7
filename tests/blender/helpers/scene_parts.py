"""Small scenes for the tests, built in this process with bpy, and renders of them through the package's own steps."""

from __future__ import annotations

from pathlib import Path

import bpy
import numpy as np

from ltsh_addon.blender import render_settings
from ltsh_addon.blender.evaluated import with_render_depsgraph
from ltsh_addon.blender.extract import pixels
from ltsh_addon.blender.extract.occluders import collect_occluders, with_baked_shares
from ltsh_addon.blender.process.pixels import read_reference
from ltsh_addon.cycles import gbuffer
from ltsh_addon.imaging.exr import read_channels

SIZE = (24, 16)
_seen: list[str] = []


def empty_scene(width: int = SIZE[0], height: int = SIZE[1]):
    """A factory-empty file with a small picture and no world; the preferences become those of the factory once."""
    if _seen:
        bpy.ops.wm.read_homefile(use_empty=True, use_factory_startup=True)
    else:
        bpy.ops.wm.read_factory_settings(use_empty=True)
        _seen.append("preferences")
    scene = bpy.context.scene
    scene.render.resolution_x, scene.render.resolution_y = width, height
    scene.render.resolution_percentage = 100
    return scene


def save(path: Path, copy: bool = False) -> Path:
    """Save the open file as `path`, or a copy of it there; the path."""
    bpy.ops.wm.save_as_mainfile(filepath=str(path), copy=copy)
    return path


def link(ob, location=(0.0, 0.0, 0.0), rotation=(0.0, 0.0, 0.0), scale=(1.0, 1.0, 1.0)):
    """Put the object into the scene's collection; the object."""
    bpy.context.scene.collection.objects.link(ob)
    ob.location, ob.rotation_euler, ob.scale = location, rotation, scale
    return ob


def add_camera(location=(0.0, -3.0, 2.0), rotation=(0.96, 0.0, 0.0), name="Camera"):
    """A perspective camera, made the active one."""
    camera = link(bpy.data.objects.new(name, bpy.data.cameras.new(name)), location, rotation)
    bpy.context.scene.camera = camera
    return camera


def add_top_camera(width=6.0):
    """An orthographic camera that sees x in +-width / 2 from above."""
    camera = add_camera((0.0, 0.0, 5.0), (0.0, 0.0, 0.0))
    camera.data.type, camera.data.ortho_scale = "ORTHO", width
    return camera


def add_area_light(
    name="Light", location=(0.3, 0.2, 1.5), rotation=(0.2, -0.3, 0.4), scale=(1.0, 1.0, 1.0), **settings
):
    """An area light of 1.2 x 0.7 m and 100 W, changed by `settings`."""
    settings = {"shape": "RECTANGLE", "size": 1.2, "size_y": 0.7, "energy": 100.0, **settings}
    return link(new_light(name, "AREA", **settings), location, rotation, scale)


def new_light(name, kind, **settings):
    """An object, to be linked, with a light of a kind such as POINT that has these `settings`."""
    light = bpy.data.lights.new(name, kind)
    for key, value in settings.items():
        setattr(light, key, value)
    return bpy.data.objects.new(name, light)


def add_mesh(name, vertices, faces, **placement):
    """A mesh object."""
    mesh = bpy.data.meshes.new(name)
    mesh.from_pydata(vertices, [], faces)
    return link(bpy.data.objects.new(name, mesh), **placement)


def add_plane(material=None, size=6.0, name="Plane", **placement):
    """A square in the xy plane with a UV map."""
    half = size / 2.0
    corners = [(-half, -half, 0.0), (half, -half, 0.0), (half, half, 0.0), (-half, half, 0.0)]
    ob = add_mesh(name, corners, [(0, 1, 2, 3)], **placement)
    uv = ob.data.uv_layers.new(name="UVMap")
    uv.data.foreach_set("uv", np.array([0, 0, 1, 0, 1, 1, 0, 1], dtype=np.float32))
    if material is not None:
        ob.data.materials.append(material)
    return ob


def add_sphere(material=None, radius=0.8, name="Sphere", smooth=True, segments=32, **placement):
    """A UV sphere of `segments` x `segments` / 2 faces."""
    bpy.ops.mesh.primitive_uv_sphere_add(segments=segments, ring_count=segments // 2, radius=radius)
    ob = bpy.context.object
    ob.name = name
    for key, value in placement.items():
        setattr(ob, {"rotation": "rotation_euler"}.get(key, key), value)
    ob.data.polygons.foreach_set("use_smooth", [smooth] * len(ob.data.polygons))
    if material is not None:
        ob.data.materials.append(material)
    return ob


def point_cloud(count):
    """Data of points from 5 to 20 cm around a box 1 m above the origin."""
    rng = np.random.default_rng(0)
    cloud = bpy.data.pointclouds.new("Points")
    if hasattr(cloud, "resize"):
        cloud.resize(count)
    else:
        bpy.data.pointclouds.remove(cloud)
        mesh = bpy.data.meshes.new("Seeds")
        mesh.from_pydata([(0.0, 0.0, 0.0)] * count, [], [])
        seeds = link(bpy.data.objects.new("Seeds", mesh))
        bpy.ops.object.select_all(action="DESELECT")
        bpy.context.view_layer.objects.active = seeds
        seeds.select_set(True)
        bpy.ops.object.convert(target="POINTCLOUD")
        cloud = bpy.context.object.data
        bpy.data.objects.remove(bpy.context.object)
    places = rng.uniform(-1, 1, (count, 3)) * [1.5, 1.0, 0.3] + [0, 0, 1]
    cloud.attributes["position"].data.foreach_set("vector", places.astype(np.float32).ravel())
    if "radius" not in cloud.attributes:
        cloud.attributes.new("radius", "FLOAT", "POINT")
    cloud.attributes["radius"].data.foreach_set("value", rng.uniform(0.05, 0.2, count).astype(np.float32))
    return cloud


def hair_curves(count, points=6):
    """Data of hair 12 cm thick around a box 1 m above the origin."""
    rng = np.random.default_rng(1)
    curves = bpy.data.hair_curves.new("Hair")
    curves.add_curves([points] * count)
    roots = rng.uniform(-1, 1, (count, 1, 3)) * [1.5, 1.0, 0.2] + [0, 0, 1]
    along = np.linspace(0, 1, points)[None, :, None]
    places = roots + along * rng.uniform(-1, 1, (count, 1, 3)) + 0.2 * along**2 * rng.uniform(-1, 1, (count, 1, 3))
    curves.attributes["position"].data.foreach_set("vector", places.astype(np.float32).ravel())
    if "radius" not in curves.attributes:
        curves.attributes.new("radius", "FLOAT", "POINT")
    curves.attributes["radius"].data.foreach_set("value", np.full(count * points, 0.06, np.float32))
    return curves


def add_white_world():
    """A sky of radiance 1."""
    add_world("World", Color=(1.0, 1.0, 1.0, 1.0), Strength=1.0)


def add_world(name="World", **inputs):
    """A sky of one Background node; (world, that node)."""
    world = bpy.context.scene.world = bpy.data.worlds.new(name)
    if bpy.app.version < (5, 0, 0):
        world.use_nodes = True
    world.node_tree.nodes.clear()
    sky = add_node(world.node_tree, "ShaderNodeBackground", **inputs)
    output = world.node_tree.nodes.new("ShaderNodeOutputWorld")
    world.node_tree.links.new(sky.outputs[0], output.inputs["Surface"])
    return world, sky


def new_material(name="Material"):
    """A material with an empty node tree but for its output; (material, tree, output)."""
    material = bpy.data.materials.new(name)
    if bpy.app.version < (5, 0, 0):
        material.use_nodes = True
    material.node_tree.nodes.clear()
    return material, material.node_tree, material.node_tree.nodes.new("ShaderNodeOutputMaterial")


def add_node(tree, node_type, **inputs):
    """A node, with GGX distribution where it has one. Underscores in input names stand for spaces."""
    node = tree.nodes.new(node_type)
    if hasattr(node, "distribution") and node_type != "ShaderNodeBsdfSheen":
        node.distribution = "GGX"
    for key, value in inputs.items():
        node.inputs[key.replace("_", " ")].default_value = value
    return node


def bsdf_material(node_type, name="Material", **inputs):
    """A material of one `add_node`; (material, node)."""
    material, tree, output = new_material(name)
    node = add_node(tree, node_type, **inputs)
    tree.links.new(node.outputs[0], output.inputs["Surface"])
    return material, node


def principled(name="Material", **inputs):
    """A material of one Principled BSDF; (material, node)."""
    return bsdf_material("ShaderNodeBsdfPrincipled", name, **inputs)


def add_bump(tree, node, strength=1.0, scale=6.0, distance=0.3):
    """Bump the Normal socket of `node` by a noise texture over object space."""
    coordinates = tree.nodes.new("ShaderNodeTexCoord")
    noise = tree.nodes.new("ShaderNodeTexNoise")
    noise.inputs["Scale"].default_value = scale
    bump = tree.nodes.new("ShaderNodeBump")
    bump.inputs["Strength"].default_value, bump.inputs["Distance"].default_value = strength, distance
    tree.links.new(coordinates.outputs["Object"], noise.inputs["Vector"])
    tree.links.new(noise.outputs[0], bump.inputs["Height"])
    tree.links.new(bump.outputs["Normal"], node.inputs["Normal"])
    return bump


def metal_room(path: Path) -> Path:
    """Save a metal plane under an area light, seen from above, as `path`; the path."""
    empty_scene()
    add_plane(principled(Metallic=1.0, Roughness=0.4)[0])
    add_area_light("Key")
    add_top_camera()
    return save(path)


def cycles_channels(folder: Path, samples=1, passes=("combined",), **settings):
    """Channels of the open scene as Cycles itself renders it, with these of its settings."""
    scene = bpy.context.scene
    scene.render.engine, scene.cycles.samples = "CYCLES", samples
    for name, value in {"use_adaptive_sampling": False, "use_denoising": False, **settings}.items():
        setattr(scene.cycles, name, value)
    render_settings.enable_passes(bpy.context.view_layer, passes)
    render_settings.render_exr(scene, folder / "cycles.exr")
    return read_channels(folder / "cycles.exr")


def prepare(with_occluders=False):
    """The scene's preparation as the child does it; (scene, view layer, light inventory, warnings)."""
    scene, warnings = bpy.context.scene, []
    camera = render_settings.choose_camera(scene, None)
    layer = render_settings.choose_view_layer(scene, warnings)
    inventory = pixels.prepare_scene(scene, layer, camera, warnings, with_occluders=with_occluders)
    return scene, layer, inventory, warnings


def collected_occluders(unread=None):
    """What blocks light in the open scene, and the warnings about it. `unread`: see `collect_occluders`."""
    warnings, override = [], bpy.context.view_layer.material_override

    def visit(depsgraph):
        return collect_occluders(depsgraph, override, warnings.append, unread=unread)

    return with_render_depsgraph(bpy.context.scene, visit), warnings


def baked_occluders():
    """As `collected_occluders`, and what Cycles bakes of their transparency."""
    unread = []
    occluders, warnings = collected_occluders(unread)
    return with_baked_shares(occluders, unread, bpy.context.scene, warnings.append), warnings


def silent(stage, fraction):
    """A progress callback that shows nothing."""


def sample(folder: Path, prepared, sub_samples=1, extra_passes=()):
    """Samples (one array per render), their pixels and the raw channels of each sample render."""
    scene, layer = prepared[:2]
    offsets = render_settings.sub_pixel_offsets(scene, sub_samples)
    files = pixels.render_pixel_samples(scene, layer, folder, offsets, silent, extra_passes)
    channels = [read_channels(folder / name) for name in files]
    for image in channels:
        gbuffer.clear_holdouts(image)
    albedo = render_settings.pass_names()["diffuse_color"]
    return [gbuffer.surface_samples(image, albedo) for image in channels], channels


def reference(folder: Path, prepared, cycles_samples, sub_samples=1):
    """The Cycles reference without shadows: {"specular", "diffuse"} -> (2, H, W, 3)."""
    scene, layer, *others = prepared
    scene.world = others[0].world if others else None
    pixels.remove_occlusion(scene)
    manifest = {
        "reference": pixels.render_reference(scene, layer, folder, cycles_samples, sub_samples, silent),
        "passes": render_settings.pass_names(),
        "width": scene.render.resolution_x,
        "height": scene.render.resolution_y,
        "exposure": 1.0,
    }
    return read_reference(manifest, folder)


def new_group(inputs, outputs, name="Inside", kind="Shader"):
    """A node group with sockets {name: type}; (tree, entry, end)."""
    tree = bpy.data.node_groups.new(name, f"{kind}NodeTree")
    for way, sockets in (("INPUT", inputs), ("OUTPUT", outputs)):
        for label, socket in sockets.items():
            tree.interface.new_socket(label, in_out=way, socket_type=f"NodeSocket{socket}")
    return tree, tree.nodes.new("NodeGroupInput"), tree.nodes.new("NodeGroupOutput")


def add_group(tree, group):
    """A node of `tree` that shows the tree `group`."""
    node = tree.nodes.new("ShaderNodeGroup")
    node.node_tree = group
    return node


def add_geometry_nodes(ob, *kinds):
    """A modifier of geometry nodes; (tree, entry, end, a node of each kind)."""
    tree, *ends = new_group({"Geometry": "Geometry"}, {"Geometry": "Geometry"}, kind="Geometry")
    ob.modifiers.new("Nodes", "NODES").node_group = tree
    return tree, *ends, *(tree.nodes.new(f"GeometryNode{kind}") for kind in kinds)


def group_with_principled(name="Group"):
    """A node group of one Principled BSDF whose roughness is an input; the group's tree."""
    tree, entry, end = new_group({"Roughness": "Float"}, {"BSDF": "Shader"}, name)
    shader = add_node(tree, "ShaderNodeBsdfPrincipled")
    tree.links.new(entry.outputs[0], shader.inputs["Roughness"])
    tree.links.new(shader.outputs[0], end.inputs[0])
    return tree
