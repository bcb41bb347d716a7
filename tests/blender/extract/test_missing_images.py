"""Missing images are named where a picture shows them, and only there; Cycles says which those are."""

import bpy
import numpy as np
import pytest
import scene_parts
from lit_plane import light_tree

from ltsh_addon.blender.evaluated import with_render_depsgraph
from ltsh_addon.blender.extract.pixels import missing_images

pytestmark = pytest.mark.newest


def lost(name, ending="png", tiled=False):
    image = bpy.data.images.new(name, 4, 4, tiled=tiled)
    image.source, image.filepath = "TILED" if tiled else "FILE", f"//nowhere/{name}.{ending}"
    return image


def texture(tree, image, target=None):
    node = tree.nodes.new("ShaderNodeTexImage")
    node.image = image
    if target is not None:
        tree.links.new(node.outputs["Color"], target)
    return node


def material(name, image):
    made, node = scene_parts.principled(name)
    texture(made.node_tree, image, node.inputs["Base Color"])
    return made


def plane(name, made, x, **settings):
    ob = scene_parts.add_plane(made, size=0.9)
    ob.name, ob.location = name, (x, 0.0, 0.1)
    for key, value in settings.items():
        setattr(ob, key, value)
    return ob


def mixed(name, image, factor, node_type="ShaderNodeMixRGB"):
    """A material whose color is a mix of white and of `image`, the second by `factor`."""
    made, node = scene_parts.principled(name)
    mix = made.node_tree.nodes.new(node_type)
    mix.inputs[0].default_value = factor
    texture(made.node_tree, image, mix.inputs[2])
    made.node_tree.links.new(mix.outputs[0], node.inputs["Base Color"])
    return made


def grouped(image):
    """A material that shows `image` by way of a group's input."""
    made, node = scene_parts.principled("Grouped")
    inner, first, last = scene_parts.new_group({"Color": "Color"}, {"Color": "Color"})
    inner.links.new(first.outputs[0], last.inputs[0])
    group = scene_parts.add_group(made.node_tree, inner)
    texture(made.node_tree, image, group.inputs[0])
    made.node_tree.links.new(group.outputs[0], node.inputs["Base Color"])
    return made


def in_the_modifiers(ob):
    """A Displace modifier and one of geometry nodes, each with an image."""
    heights = bpy.data.textures.new("Heights", "IMAGE")
    heights.image = lost("yes displace")
    ob.modifiers.new("Displace", "DISPLACE").texture = heights
    tree, start, end, move, read = scene_parts.add_geometry_nodes(ob, "SetPosition", "ImageTexture")
    read.inputs["Image"].default_value = lost("yes geometry nodes")
    tree.links.new(start.outputs[0], move.inputs["Geometry"])
    tree.links.new(read.outputs["Color"], move.inputs["Offset"])
    tree.links.new(move.outputs[0], end.inputs[0])


def gallery():
    """A scene with many missing images; the names of those that it shows begin with "yes"."""
    scene = scene_parts.empty_scene(24, 16)
    scene_parts.add_top_camera()
    light = scene_parts.add_area_light("Key")
    tree, emission = light_tree(light)
    texture(tree, lost("yes light"), emission.inputs["Color"])
    scene.world = scene.world or bpy.data.worlds.new("World")
    if bpy.app.version < (5, 0, 0):
        scene.world.use_nodes = True
    scene.world.cycles.sampling_method, scene.world.cycles.sample_map_resolution = "MANUAL", 16
    background = next(node for node in scene.world.node_tree.nodes if node.type == "BACKGROUND")
    sky = scene.world.node_tree.nodes.new("ShaderNodeTexEnvironment")
    sky.image = lost("yes world", "exr")
    scene.world.node_tree.links.new(sky.outputs[0], background.inputs[0])
    plane("Plain", material("Plain", lost("yes material")), -2.0)
    plane("Group", grouped(lost("yes group")), -1.0)
    plane("Half", mixed("Half", lost("yes half"), 0.5), 0.0)
    tiles = lost("yes tiles", "<UDIM>.png", tiled=True)
    in_the_modifiers(plane("Tiles", material("Tiles", tiles), 1.0))
    # Not shown:
    unlinked = plane("None", mixed("None", lost("no weight"), 0.0), 2.0)
    tree = unlinked.data.materials[0].node_tree
    texture(tree, lost("no link"))
    muted, target = texture(tree, lost("no, muted")), tree.nodes.new("ShaderNodeMath")
    tree.links.new(muted.outputs[0], target.inputs[0])
    unlinked.data.materials.append(material("Slot", lost("no face has the slot")))
    plane("Hidden", material("Hidden", lost("no, hidden")), 0.0, hide_render=True)
    material("Spare", lost("no user")).use_fake_user = True
    lost("no, fake user").use_fake_user = True
    empty = bpy.data.objects.new("Reference", None)
    empty.empty_display_type, empty.data = "IMAGE", lost("no, reference picture")
    scene.collection.objects.link(empty)
    background_images = scene.camera.data.background_images
    background_images.new().image = lost("no, behind the camera")
    stencil = bpy.data.textures.new("Stencil", "IMAGE")
    stencil.image = lost("no, brush")
    brushes = bpy.data.brushes
    brushes.new("Brush", mode="TEXTURE_PAINT").texture = stencil
    other = bpy.data.scenes.new("Other")
    elsewhere = plane("Elsewhere", material("Elsewhere", lost("no, other scene")), 0.0)
    scene.collection.objects.unlink(elsewhere)
    other.collection.objects.link(elsewhere)
    return scene


def named(scene):
    lines = with_render_depsgraph(scene, lambda depsgraph: missing_images(depsgraph, scene.world))
    assert all("is missing" in line for line in lines)
    return {line.split("'")[1] for line in lines}


def test_missing_images_are_named_if_and_only_if_cycles_shows_them(tmp_path):
    """With another color in place of an image, Cycles' picture is another one if it shows the image."""
    scene = gallery()
    names = named(scene)

    def picture():
        return np.stack(list(scene_parts.cycles_channels(tmp_path).values()))

    def is_other_with(images):
        before = [(image, image.source, image.filepath) for image in images]
        for image in images:
            image.source, image.generated_color = "GENERATED", (0.1, 0.7, 0.3, 1.0)
        changed = not np.array_equal(picture(), first)
        for image, source, path in before:
            image.source, image.filepath = source, path
        return changed

    first, images = picture(), [image for image in bpy.data.images if image.filepath]
    assert not is_other_with([image for image in images if not image.name.startswith("yes")])
    shown = [image for image in images if image.name.startswith("yes")]
    assert names == {image.name for image in shown} and all(is_other_with([image]) for image in shown)


def test_a_material_override_shows_its_images_alone():
    scene = gallery()
    override, layer = material("Override", lost("yes override")), scene.view_layers[0]
    lines = with_render_depsgraph(scene, lambda depsgraph: missing_images(depsgraph, None, override))
    shaping = {"yes light", "yes displace", "yes geometry nodes", "yes override"}
    assert {line.split("'")[1] for line in lines} == shaping and layer.material_override is None
