"""Texels and pixels: a bake gives for every kind of material what shading the picture gives.

Seen by an orthographic camera, a surface whose UV map is its projection has the centers of texels in the lines of sight
of the centers of pixels. So nothing is interpolated, and each texel is held against one pixel.
"""

import bpy
import numpy as np
import pytest
import scene_parts
import sheen_measurement
from bake_scenes import baked, save
from material_scenes import Build
from scene_parts import bsdf_material, principled

from ltsh_addon import imaging
from ltsh_addon.blender import render_settings
from ltsh_addon.cycles import closures
from ltsh_addon.cycles.lobes import read_layer
from ltsh_addon.pipeline import PictureOptions
from ltsh_addon.pipeline.picture import make_picture

WIDTH, HEIGHT, SCALE = 224, 64, 7.0  # texels, and m of the picture's width
RED, BLUE = (0.8, 0.3, 0.2, 1.0), (0.2, 0.4, 0.9, 1.0)


def sheen():
    return principled("Sheen", Sheen_Weight=0.7, Sheen_Tint=BLUE, Sheen_Roughness=0.4, Roughness=0.5, Base_Color=RED)[0]


def sheen_on_coat():
    inputs = {"Sheen_Weight": 0.5, "Sheen_Roughness": 0.3, "Coat_Weight": 0.8, "Coat_Tint": BLUE, "Metallic": 0.4}
    return principled("Sheen on coat", Base_Color=RED, Roughness=0.4, **inputs)[0]


def metal():
    brushed = {"Anisotropic": 0.6, "Anisotropic_Rotation": 0.15}
    made, node = principled("Metal", Metallic=1.0, Roughness=0.4, Base_Color=RED, Specular_Tint=BLUE, **brushed)
    node.distribution = "MULTI_GGX"
    return made


def sheen_node():
    return bsdf_material("ShaderNodeBsdfSheen", "Sheen node", Color=RED, Roughness=0.6)[0]


def mix():
    """Of a varying metal and varying sheen, by a texture."""
    made = Build("Mix")
    first, second = made.shader("BsdfPrincipled"), made.shader("BsdfAnisotropic")
    first.node.distribution = second.node.distribution = "MULTI_GGX"
    noise = made.new("ShaderNodeTexNoise", Detail=0.0)
    made.link(made.new("ShaderNodeTexCoord").outputs["Object"], noise.inputs["Vector"])
    for target in (first.node.inputs["Metallic"], first.node.inputs["Sheen Weight"], second.node.inputs["Roughness"]):
        made.link(noise.outputs[0], target)
    made.link(noise.outputs["Color"], first.node.inputs["Base Color"])
    return made.show(made.mix(noise.outputs[0], first, second))


def dielectric():
    return principled("Dielectric", Roughness=0.3, Base_Color=RED, IOR=1.7, Specular_Tint=BLUE)[0]


def colors_under_alpha():
    """Of an image whose alpha is cut: Cycles shows them otherwise where the alpha feeds nothing."""
    image = bpy.data.images.new("Veil", 2, 2, alpha=True)
    image.pixels.foreach_set(np.tile(np.float32([0.8, 0.6, 0.4, 0.5]), 4))
    image.pack()
    made = Build("Veil")
    surface, shown = made.shader("BsdfPrincipled", Roughness=0.3), made.new("ShaderNodeTexImage")
    shown.image = image
    made.link(shown.outputs["Color"], surface.node.inputs["Base Color"])
    made.link(shown.outputs["Alpha"], surface.node.inputs["Alpha"])
    return made.show(surface)


KINDS = {kind.__name__: kind for kind in (sheen, sheen_on_coat, metal, sheen_node, mix, dielectric, colors_under_alpha)}
# Of the brightest pixel. Texels are sampled up to 0.0022 of a texel beside the centers of pixels, and a highlight of
# these lights takes ten of them to rise. What is diffuse the picture has from Cycles, which takes the light that a
# dielectric leaves for it from a table of 16^3 nodes; a bake integrates it.
SPECULAR, DIFFUSE = 1e-3, 4e-3


def half_sphere(name, material, x):
    """The half of a sphere at `x` that is seen from above, and its projection as UV map."""
    rings, steps = np.linspace(0.0, 0.5 * np.pi, 33), np.linspace(0.0, 2.0 * np.pi, 65)[:-1]
    places = [(np.sin(a) * np.cos(b), np.sin(a) * np.sin(b), np.cos(a)) for a in rings for b in steps]
    index = np.arange(32 * 64).reshape(32, 64)
    faces = np.stack([index, index + 64, np.roll(index, -1, axis=1) + 64, np.roll(index, -1, axis=1)], axis=-1)
    ob = scene_parts.add_mesh(name, 0.48 * np.array(places), faces.reshape(-1, 4).tolist(), location=(x, 0, 0))
    mesh = ob.data
    mesh.normals_split_custom_set_from_vertices(places)
    vertices = np.array(places)[[loop.vertex_index for loop in mesh.loops], :2] * 0.48
    uv = (vertices + (x, 0.0)) / (SCALE, SCALE * HEIGHT / WIDTH) + 0.5
    mesh.uv_layers.new(name="UVMap").uv.foreach_set("vector", uv.astype(np.float32).ravel())
    mesh.materials.append(material)


@pytest.fixture(scope="module")
def pictures(tmp_path_factory):
    """Layers of the picture, and of the bake by object; the warnings of the bake."""
    folder = tmp_path_factory.mktemp("parity")
    scene_parts.empty_scene(WIDTH, HEIGHT)
    for number, (name, kind) in enumerate(KINDS.items()):
        half_sphere(name, kind(), number - 3.0)
    for x in (-2.0, 0.0, 2.0):
        scene_parts.add_area_light("Light", (x, 0.4, 1.5), size=2.0)
    scene_parts.add_top_camera(SCALE)
    path = save(folder)
    make_picture(
        PictureOptions(scene=path, output=folder / "picture", techniques=("ltsh4c",), shadows="off"), with_cycles=False
    )
    report, files = baked(path, folder / "bake", size=(WIDTH, HEIGHT))
    (picture,) = (folder / "picture").glob("*.exr")
    return imaging.read_layers(picture), files, report["warnings"]


@pytest.mark.parametrize("name", KINDS)
def test_texels_are_what_pixels_are(pictures, name):
    picture, files, _ = pictures
    layers = files[f"{name}.exr"]
    both = (layers["coverage.hit"] > 0.0) & (picture["coverage.hit"] > 0.0)
    assert both.sum() > 0.98 * (layers["coverage.hit"] > 0.0).sum() > 500
    for pass_name, tolerance in (("specular", SPECULAR), ("diffuse", DIFFUSE)):
        texels, pixels = (found[f"ltsh4c.{pass_name}"][both] for found in (layers, picture))
        if pixels.max() == 0.0:
            assert texels.max() == 0.0
            continue
        apart = np.abs(texels - pixels).max() / pixels.max()
        assert apart < tolerance, (pass_name, apart)


def test_nothing_but_a_cut_alpha_is_named(pictures):
    _, _, warnings = pictures
    assert len(warnings) == 1 and "Alpha" in warnings[0]


def test_sheen_is_that_of_this_cycles():
    cosine, roughness, (albedo, a, b) = sheen_measurement.measure(96)
    assert len(albedo) == 96**2 and albedo.max() > 0.7 and cosine.min() < 0.01 and cosine.max() > 0.99
    found = closures.sheen_lobe(cosine, roughness)
    # Half precision would leave 2e-4; the nodes were fitted to 512 x 512 pixels.
    assert np.abs(found[0] - albedo).max() < 1e-4
    # Where there is next to no sheen, its direction is not to be measured.
    seen = np.isfinite(a)
    assert seen.mean() > 0.9 and albedo[~seen].max() < 1e-3
    assert np.abs(found[1:, seen] - np.stack([a, b])[:, seen]).max() < 3e-4


@pytest.mark.parametrize("roughness", [0.3, 0.9])
def test_the_albedos_of_velvet_are_those_of_this_cycles(tmp_path, roughness):
    """A ball under a sky of radiance 1 shines as bright as its albedo. 1024 samples of a lobe that Cycles samples
    uniformly leave 1 % of noise where few of them count, at the rough end less."""
    scene_parts.empty_scene(16, 16)
    made, node = bsdf_material("ShaderNodeBsdfSheen", Color=(1.0, 1.0, 1.0, 1.0), Roughness=roughness)
    node.distribution = "ASHIKHMIN"
    scene_parts.add_sphere(made, radius=1.0, segments=128)
    scene_parts.add_top_camera(2.0)
    scene_parts.add_white_world()
    settings = {"max_bounces": 0, "pixel_filter_type": "GAUSSIAN", "filter_width": 0.01}
    passes = ("combined", "normal", "glossy_direct", "glossy_color")
    channels = scene_parts.cycles_channels(tmp_path, 1024, passes, **settings)
    names = render_settings.pass_names()
    light, color = (read_layer(channels, names[f"specular_{part}"], "RGB")[..., 0] for part in ("light", "color"))
    normal = read_layer(channels, "Normal", "XYZ")
    seen = np.linalg.norm(normal, axis=-1) > 0.9
    expected = (light * color)[seen]
    found = closures.velvet_albedo(normal[seen][:, 2], np.full(seen.sum(), roughness))
    assert expected.max() > 0.5 and np.linalg.norm(found - expected) < 0.01 * np.linalg.norm(expected)
