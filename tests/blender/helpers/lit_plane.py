"""A plane with a diffuse and a glossy lobe under the lights of a test: quadrature beside Cycles."""

from __future__ import annotations

import bpy
import numpy as np
import quadrature
import scene_parts

from ltsh_addon.cycles.lobes import read_layer
from ltsh_addon.imaging.exr import read_channels

BRDFS = {"diffuse": quadrature.lambert, "specular": quadrature.ggx}


def add_surface(size=12.0, **placement):
    """A Principled plane, rough enough for the oracle's patches and for few Cycles samples."""
    return scene_parts.add_plane(scene_parts.principled("Surface", Roughness=0.45)[0], size=size, **placement)


def start(width=24, height=16):
    """An empty scene with a camera and the plane; the scene."""
    scene = scene_parts.empty_scene(width, height)
    scene_parts.add_camera()
    add_surface()
    return scene


def measured(folder, samples, prepared=None):
    """The prepared scene, what its pixels see, and Cycles' halves (2, P, 3) there by lobe."""
    prepared = prepared or scene_parts.prepare()
    ((surface, pixel, unusable),) = scene_parts.sample(folder, prepared)[0]
    assert unusable == 0 and len(surface) > 0
    images = scene_parts.reference(folder, prepared, samples)
    return prepared, surface, {name: images[name].reshape(2, -1, 3)[:, pixel].astype(np.float64) for name in BRDFS}


def combined_by_group(folder, prepared, samples, groups):
    """Halves (2, P, 3) of Cycles' Combined pass of `groups` of lights ("" for all light), at all pixels."""
    # The preparation takes passes of the user's own out, these among them.
    for name in filter(None, groups):
        prepared[1].lightgroups.add(name=name)
    scene_parts.reference(folder, prepared, samples)
    halves = {name: [] for name in groups}
    for half in "AB":
        chunks = [read_channels(path) for path in sorted(folder.glob(f"cycles_{half}_*.exr"))]
        # Chunks hold 16 samples first and the rest after: weighted as `render_reference` says.
        weights = np.array([16.0] + [(samples / 2.0 - 16.0) / (len(chunks) - 1)] * (len(chunks) - 1))
        for name in groups:
            layer = f"Combined_{name}" if name else "Combined"
            images = [read_layer(chunk, layer, "RGB").reshape(-1, 3) for chunk in chunks]
            halves[name].append(np.average(np.array(images, np.float64), axis=0, weights=weights))
    return {name: np.array(images) for name, images in halves.items()}


def compare(folder, samples=256, count=16):
    """Errors of the quadrature against Cycles as {lobe: (relative L2 beyond noise, bias)}, and the prepared scene."""
    prepared, surface, halves = measured(folder, samples)
    errors = {}
    lights = [patch for light in prepared[2].lights for patch in light.leaves]
    for lobe, brdf in BRDFS.items():
        expected = quadrature.radiance(surface, lights, brdf, count=count)
        errors[lobe] = quadrature.relative_l2(expected, halves[lobe]), quadrature.bias(expected, halves[lobe])
    return errors, prepared


def assert_agrees(folder, samples=256, count=16, tolerance=3e-3):
    """The prepared scene, after quadrature and Cycles agreed within `tolerance` beyond Cycles' noise.

    At 256 samples the noise of a lamp is about 1 %, of which some 2e-3 remain in the estimate and 1e-3 in the sum; a
    wrong factor, side or place is off by per cents at least.
    """
    errors, prepared = compare(folder, samples, count)
    for lobe, (distance, bias) in errors.items():
        assert distance < tolerance and abs(bias) < tolerance, (lobe, distance, bias, prepared[3])
    return prepared


def lamp_material(name="Lamp", color=(1.0, 0.5, 0.2, 1.0), strength=20.0):
    """A material of one Emission node; (material, node)."""
    return scene_parts.bsdf_material("ShaderNodeEmission", name, Color=color, Strength=strength)


LAMP_CORNERS = [(-0.5, -0.3, 0.0), (0.5, -0.3, 0.0), (0.5, 0.3, 0.0), (-0.5, 0.3, 0.0)]


def add_lamp(corners, faces, material=None, name="Lamp", location=(0.0, 1.0, 1.2), rotation=(-0.7, 0.0, 0.0), **more):
    """An emissive mesh that the camera does not see."""
    ob = scene_parts.add_mesh(name, corners, faces, location=location, rotation=rotation, **more)
    ob.data.materials.append(material or lamp_material()[0])
    ob.visible_camera = False
    return ob


def add_lamp_plane(material=None, name="Lamp", **placement):
    """A rectangle of 1 x 0.6 m with a UV map."""
    ob = add_lamp(LAMP_CORNERS, [(0, 1, 2, 3)], material, name, **placement)
    uv = ob.data.uv_layers.new(name="UVMap")
    uv.data.foreach_set("uv", np.array([0, 0, 1, 0, 1, 1, 0, 1], dtype=np.float32))
    return ob


def add_lamp_ball(material=None, name="Lamp", segments=6, **placement):
    """A faceted emissive ball that the camera does not see."""
    placement = {"location": (0.0, 1.0, 1.2), **placement}
    ob = scene_parts.add_sphere(material or lamp_material()[0], 0.3, name, smooth=False, segments=segments, **placement)
    ob.visible_camera = False
    return ob


def light_tree(light):
    """The node tree of a light object with its Emission node; (tree, node)."""
    data = light.data
    if bpy.app.version < (5, 0, 0):
        data.use_nodes = True
    return data.node_tree, next(node for node in data.node_tree.nodes if node.bl_idname == "ShaderNodeEmission")


def along_x(tree, coordinate, slope):
    """The output of nodes that give 1 + `slope` times the x of a texture coordinate."""
    coordinates, separate, line = (tree.nodes.new(f"ShaderNode{kind}") for kind in ("TexCoord", "SeparateXYZ", "Math"))
    line.operation, line.inputs[1].default_value, line.inputs[2].default_value = "MULTIPLY_ADD", slope, 1.0
    tree.links.new(coordinates.outputs[coordinate], separate.inputs[0])
    tree.links.new(separate.outputs["X"], line.inputs[0])
    return line.outputs[0]


def add_image(tree, pixels, interpolation="Closest"):
    """An Image Texture node over UV with float `pixels` (H, W, 3), row 0 at the bottom; the node."""
    height, width, _ = pixels.shape
    image = bpy.data.images.new("Picture", width, height, float_buffer=True)
    opaque = np.ones((height, width, 1), np.float32)
    image.pixels.foreach_set(np.concatenate([pixels.astype(np.float32), opaque], axis=-1).ravel())
    image.pack()
    node = tree.nodes.new("ShaderNodeTexImage")
    node.image, node.interpolation = image, interpolation
    tree.links.new(tree.nodes.new("ShaderNodeTexCoord").outputs["UV"], node.inputs["Vector"])
    return node


def into_collection(name, *objects):
    """Move `objects` into a new collection that is in no scene; the collection."""
    collection = bpy.data.collections.new(name)
    for ob in objects:
        for other in list(ob.users_collection):
            other.objects.unlink(ob)
        collection.objects.link(ob)
    return collection


def instance_on_points(maker, source):
    """Let `maker` show instances of the object `source` on its points, beside its own geometry, by geometry nodes."""
    kinds = ("InstanceOnPoints", "JoinGeometry", "ObjectInfo")
    tree, entry, leave, place, join, info = scene_parts.add_geometry_nodes(maker, *kinds)
    info.inputs["Object"].default_value, info.inputs["As Instance"].default_value = source, True
    tree.links.new(entry.outputs[0], place.inputs["Points"])
    tree.links.new(info.outputs["Geometry"], place.inputs["Instance"])
    tree.links.new(place.outputs[0], join.inputs[0])
    tree.links.new(entry.outputs[0], join.inputs[0])
    tree.links.new(join.outputs[0], leave.inputs[0])


def add_instancer(collection, name="Instancer", **placement):
    """An empty that instances `collection`."""
    empty = scene_parts.link(bpy.data.objects.new(name, None), **placement)
    empty.instance_type, empty.instance_collection = "COLLECTION", collection
    return empty
