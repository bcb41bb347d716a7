"""Image textures that a bake looks up itself, against the maps that Cycles bakes of the same sockets."""

from dataclasses import replace

import bpy
import numpy as np
import pytest
from bake_scenes import SIZE, save, start
from scene_parts import add_group, add_plane, new_group, principled

from ltsh_addon.blender.process.bake import extract_bake
from ltsh_addon.cycles import texels as texels_module
from ltsh_addon.cycles.texels import ImageTexture
from ltsh_addon.cycles.uv import UvTriangles
from ltsh_addon.pipeline import BakeOptions, bake
from ltsh_addon.scene import light_of

# Cycles bakes 0.001 and 0.002 of a texel beside the center, where these textures change by 0.3 per texel at most.
NUDGED = 2e-3
FIELDS = ("roughness", "specular_f0", "diffuse_albedo", "dielectric")


def image(folder, name, space, floating=False, alpha=1.0, size=(7, 5)):
    """An image file of random colors, loaded."""
    width, height = size
    made = bpy.data.images.new(name, width, height, alpha=True, float_buffer=floating)
    pixels = np.random.default_rng(len(name)).random((width * height, 4)).astype(np.float32)
    pixels[:, 3] = alpha
    made.pixels.foreach_set(pixels.ravel())
    made.file_format = "OPEN_EXR" if floating else "PNG"
    made.filepath_raw = str(folder / f"{name}.{'exr' if floating else 'png'}")
    made.save()
    loaded = bpy.data.images.load(made.filepath_raw)
    bpy.data.images.remove(made)
    loaded.name, loaded.colorspace_settings.name = name, space
    return loaded


def texture(tree, pixels, extension="REPEAT", interpolation="Linear"):
    node = tree.nodes.new("ShaderNodeTexImage")
    node.image, node.extension, node.interpolation = pixels, extension, interpolation
    return node


def textured(name):
    """A plane that shows a texture several times over; (tree, Principled BSDF)."""
    material, node = principled(name, Metallic=0.5)
    number = len([ob for ob in bpy.data.objects if ob.type == "MESH"])
    ob = add_plane(material, name=name, location=(0.0, 0.0, -0.1 * number))
    ob.data.uv_layers.new(name="Tex").data.foreach_set("uv", np.float32([-0.7, -0.4, 1.9, -0.4, 1.9, 1.6, -0.7, 1.6]))
    ob.data.uv_layers.active = ob.data.uv_layers["UVMap"]
    return material.node_tree, node


def plain_scene(folder):
    """Every way to an image that is looked up."""
    start()
    tree, node = textured("Parts")
    shown, uv = texture(tree, image(folder, "color", "sRGB")), tree.nodes.new("ShaderNodeUVMap")
    separate = tree.nodes.new("ShaderNodeSeparateColor")
    uv.uv_map = "Tex"
    tree.links.new(uv.outputs[0], shown.inputs[0])
    tree.links.new(shown.outputs[0], node.inputs["Base Color"])
    tree.links.new(shown.outputs[0], node.inputs["Roughness"])
    tree.links.new(shown.outputs[0], separate.inputs[0])
    tree.links.new(separate.outputs["Green"], node.inputs["Metallic"])

    tree, node = textured("Group")
    bpy.data.objects["Group"].data.uv_layers["Tex"].active_render = True
    group, _, end = new_group({}, {"Out": "Color"})
    group.links.new(texture(group, image(folder, "data", "Non-Color"), "CLIP", "Closest").outputs[0], end.inputs[0])
    tree.links.new(add_group(tree, group).outputs[0], node.inputs["Base Color"])

    tree, node = textured("Floats")
    bpy.data.objects["Floats"].data.uv_layers["Tex"].active_render = True
    shown = texture(tree, image(folder, "float", "Linear Rec.709", True), "MIRROR")
    reroute = tree.nodes.new("NodeReroute")
    tree.links.new(tree.nodes.new("ShaderNodeTexCoord").outputs["UV"], reroute.inputs[0])
    tree.links.new(reroute.outputs[0], shown.inputs[0])
    tree.links.new(shown.outputs[0], node.inputs["Base Color"])

    tree, node = textured("Edge")
    bpy.data.objects["Edge"].data.uv_layers["Tex"].active_render = True
    shown = texture(tree, image(folder, "edge", "Linear Rec.709"), "EXTEND")
    tree.links.new(shown.outputs[0], node.inputs["Base Color"])
    tree.links.new(shown.outputs[0], node.inputs["Specular Tint"])


def samples_by_object(path, folder, look_up):
    """Samples (SurfaceSamples) of every object and whether maps were baked for it."""
    folder.mkdir()
    options = BakeOptions(scene=path, output=folder, size=(SIZE, SIZE), view="above")
    job = replace(bake._job(options), look_up_images=look_up)
    manifest = extract_bake(job, folder)
    lights = tuple(light_of(record) for record in manifest["lights"])
    found = {}
    for record in manifest["objects"]:
        assert not record["problems"]
        of_object = folder / record["folder"]
        mesh = texels_module.TexelMesh.load(of_object / "mesh.npz")
        uv_maps = {name: of_object / file for name, file in record["uv_maps"].items()}
        materials = [texels_module.BakeMaterial.of(value, folder, uv_maps) for value in record["materials"]]
        texels = UvTriangles.in_tile(mesh.uv, SIZE, SIZE).texels(0, SIZE)
        maps = np.load(of_object / "maps_1001_0_0.npy") if record["maps"] else None

        def read_map(number, maps=maps, index=texels.index):
            return maps[number].reshape(-1, 3)[index]

        view = texels_module.BakeView(**manifest["view"])
        samples, _ = texels_module.texel_samples(mesh, materials, texels, read_map, view, lights)
        found[record["name"]] = samples, record["maps"]
    return found


def test_plain_textures_are_what_cycles_sees(tmp_path):
    plain_scene(tmp_path)
    path = save(tmp_path)
    looked_up = samples_by_object(path, tmp_path / "looked_up", True)
    baked = samples_by_object(path, tmp_path / "baked", False)
    assert set(looked_up) == {"Parts", "Group", "Floats", "Edge"}
    for name, (samples, maps) in looked_up.items():
        expected, baked_maps = baked[name]
        assert not maps and baked_maps, name
        for field in FIELDS:
            found, wanted = np.array(getattr(samples, field)), np.array(getattr(expected, field))
            apart = np.abs(found - wanted).reshape(len(samples), -1).max(axis=1)
            # Without interpolation a texel next to a border between pixels may see the other one.
            limit = 0.99 if name == "Group" else 1.0
            assert np.quantile(apart, limit) < NUDGED, (name, field, np.quantile(apart, [0.5, 0.9, 0.99, 1.0]))
        assert np.ptp(samples.diffuse_albedo, axis=0).min() > 0.1, name


def altered(kind, folder):
    """A texture that is more than plain."""
    start()
    tree, node = textured("More")
    shown = texture(tree, image(folder, "more", "sRGB", alpha=0.5 if kind == "alpha" else 1.0))
    tree.links.new(shown.outputs[0], node.inputs["Base Color"])
    if kind == "mapping node":
        mapping = tree.nodes.new("ShaderNodeMapping")
        mapping.inputs["Scale"].default_value = (2.0, 1.0, 1.0)
        tree.links.new(tree.nodes.new("ShaderNodeTexCoord").outputs["UV"], mapping.inputs[0])
        tree.links.new(mapping.outputs[0], shown.inputs[0])
    elif kind == "cubic":
        shown.interpolation = "Cubic"
    elif kind == "box":
        shown.projection = "BOX"
    elif kind == "own mapping":
        shown.texture_mapping.scale = (2.0, 1.0, 1.0)
    elif kind == "no such map":
        uv = tree.nodes.new("ShaderNodeUVMap")
        uv.uv_map = "Absent"
        tree.links.new(uv.outputs[0], shown.inputs[0])
    elif kind == "color space":
        shown.image.colorspace_settings.name = "Linear Rec.2020"
    elif kind == "math":
        tree.links.new(tree.nodes.new("ShaderNodeInvert").outputs[0], node.inputs["Base Color"])


@pytest.mark.parametrize(
    "kind", ["alpha", "mapping node", "cubic", "box", "own mapping", "no such map", "color space", "math"]
)
def test_anything_more_is_left_to_cycles(tmp_path, kind):
    from ltsh_addon.blender.materials.bsdfs import lobe_values
    from ltsh_addon.blender.materials.maps import MaterialPlan, SavedImages

    altered(kind, tmp_path)
    material = bpy.data.materials["More"]
    lobe = lobe_values(material.node_tree.nodes["Principled BSDF"])
    plan = MaterialPlan(material, (lobe,), ((),), SavedImages(tmp_path), {"UVMap", "Tex"})
    assert plan.count == 1 and plan.textures == []


def test_each_extension_continues_the_image():
    pixels = np.random.default_rng(2).random((4, 6, 3)).astype(np.float32)
    uv = np.random.default_rng(3).random((200, 2))

    def read(extension, places, interpolation="Linear"):
        return ImageTexture(pixels, extension, interpolation, False).colors(places)

    assert np.allclose(read("REPEAT", uv), read("REPEAT", uv + (3.0, -2.0)), atol=1e-9)
    assert np.allclose(read("MIRROR", uv), read("MIRROR", (2.0, 0.0) - uv * (1.0, -1.0)), atol=1e-9)
    assert np.allclose(read("EXTEND", [(0.3, -5.0)]), read("EXTEND", [(0.3, 0.0)]))
    assert not read("CLIP", uv + (1.1, 0.0)).any()
    centers = np.stack(np.meshgrid((np.arange(6) + 0.5) / 6, (np.arange(4) + 0.5) / 4), axis=-1).reshape(-1, 2)
    for extension in ("REPEAT", "EXTEND", "CLIP", "MIRROR"):
        for interpolation in ("Linear", "Closest"):
            assert np.allclose(read(extension, centers, interpolation), pixels.reshape(-1, 3), atol=1e-6)
    byte = ImageTexture(np.full((1, 1, 3), 188, np.uint8), "REPEAT", "Linear", True)
    # sRGB of linear 0.5 is 187.5 of 255.
    assert np.allclose(byte.colors(uv), 0.5, atol=2e-3 * 1.5)
