"""The world in a view: its light is that of `shade`, its background what the camera sees, and windows get it too."""

import time

import bpy
import numpy as np
import pytest
import scene_parts as parts
from fake_scene import run
from graphics_card import with_graphics

from ltsh_addon import imaging
from ltsh_addon.blender.lights.world import SMOOTH, background_pictures, light_of_world, light_pictures
from ltsh_addon.blender.viewport import light_texels as sky
from ltsh_addon.blender.viewport.live_cycles import LiveWorld
from ltsh_addon.cycles.environment import CUBE, SkyPicture

SIZE = (64, 48)
UPPER, LOWER, SEEN = np.array([0.2, 0.4, 0.9]), np.array([0.8, 0.3, 0.1]), np.array([0.1, 0.5, 0.2])


def relative(picture, expected):
    return np.linalg.norm(picture - expected) / np.linalg.norm(expected)


def add_gradient():
    """From LOWER below the horizon to UPPER above, (1 + z) / 2 of it, for surfaces; cameras see SEEN."""
    world, background = parts.add_world()
    tree = world.node_tree
    coordinate, parted = (tree.nodes.new(f"ShaderNode{name}") for name in ("TexCoord", "SeparateXYZ"))
    ramp, path, mix = (tree.nodes.new(f"ShaderNode{name}") for name in ("ValToRGB", "LightPath", "MixShader"))
    share = parts.add_node(tree, "ShaderNodeMath")
    share.operation = "MULTIPLY_ADD"
    share.inputs[1].default_value = share.inputs[2].default_value = 0.5
    plain = parts.add_node(tree, "ShaderNodeBackground", Color=(*SEEN, 1.0))
    for element, color in zip(ramp.color_ramp.elements, (LOWER, UPPER), strict=True):
        element.color = (*color, 1.0)
    output = next(node for node in tree.nodes if node.bl_idname == "ShaderNodeOutputWorld")
    for start, end in (
        (coordinate.outputs["Generated"], parted.inputs[0]), (parted.outputs[2], share.inputs[0]),
        (share.outputs[0], ramp.inputs[0]), (ramp.outputs[0], background.inputs["Color"]),
        (path.outputs["Is Camera Ray"], mix.inputs[0]), (background.outputs[0], mix.inputs[1]),
        (plain.outputs[0], mix.inputs[2]), (mix.outputs[0], output.inputs["Surface"]),
    ):  # fmt: skip
        tree.links.new(start, end)
    return world


def add_constant():
    return parts.add_world(Color=(*SEEN, 1.0), Strength=2.0)[0]


def set_up_scene(add_world):
    """A rough metal ball, a wall and a floor of dust that shade each other, all lit by the world alone."""
    scene = parts.empty_scene(*SIZE)
    dust = {"Base Color": (0.7, 0.6, 0.5, 1.0), "Roughness": 0.6, "Diffuse Roughness": 1.0}
    parts.add_plane(parts.principled("floor", **dust)[0], size=4.0)
    metal = parts.bsdf_material("ShaderNodeBsdfAnisotropic", "metal", Color=(0.9, 0.7, 0.4, 1.0), Roughness=0.4)[0]
    parts.add_sphere(metal, radius=0.7, location=(-0.5, 0.2, 0.7))
    parts.add_plane(None, name="Wall", size=1.5, location=(0.9, 0.6, 0.75), rotation=(1.5, 0.0, -0.5))
    parts.add_camera((0.3, -4.0, 1.6), (1.25, 0.0, 0.05))
    scene.view_settings.view_transform = "Standard"
    add_world()
    bpy.context.view_layer.update()


@pytest.mark.parametrize(
    ("add_world", "shadows", "most", "seen"),
    [
        pytest.param(add_constant, "on", 0.05, 2.0 * SEEN, marks=pytest.mark.newest),
        (add_constant, "off", 0.012, 2.0 * SEEN),
        pytest.param(add_gradient, "off", 0.02, SEEN, marks=pytest.mark.newest),
    ],
)
def test_a_view_is_lit_by_the_world_as_pictures_are(capsys, tmp_path, add_world, shadows, most, seen):
    """Patches of pictures are 1 % off the gradient in Cycles, edges of few points 1 %; shadows have noise."""
    with_graphics(lambda: None)
    set_up_scene(add_world)
    path = parts.save(tmp_path / "sky.blend")
    common = ("--shadows", shadows, "--techniques", "ltsh4", "--quiet")
    assert run(capsys, "view", path, "-o", tmp_path / "view", "--refine", 4, *common)[0] == 0
    assert run(capsys, "shade", path, "-o", tmp_path / "shade", "--aa", 4, *common)[0] == 0
    found = imaging.read_layers(tmp_path / "view" / "view.exr")
    expected = imaging.read_layers(tmp_path / "shade" / "shade.exr")
    for layer in ("ltsh4.specular", "ltsh4.diffuse"):
        assert relative(found[layer], expected[layer]) < most, layer
    behind = found["coverage.hit"] == 0.0
    assert behind.sum() > 100
    np.testing.assert_allclose(found["ltsh4.combined"][behind], np.broadcast_to(seen, (behind.sum(), 3)), rtol=2e-3)
    assert not found["ltsh4.diffuse"][behind].any()


@pytest.mark.newest
@pytest.mark.parametrize("is_linked", [False, True], ids=["own", "linked"])
def test_windows_get_the_world_from_a_second_blender(tmp_path, is_linked):
    parts.empty_scene(*SIZE)
    world = add_gradient()
    if is_linked:
        name = world.name
        bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "library.blend"))
        parts.empty_scene(*SIZE)
        bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "room.blend"))
        with bpy.data.libraries.load(str(tmp_path / "library.blend"), link=True, relative=True) as (_, wanted):
            wanted.worlds = [name]
        (world,) = wanted.worlds
    live = LiveWorld()
    assert live.look(world) is None and live.is_busy
    end, found = time.monotonic() + 60.0, None
    while found is None and time.monotonic() < end:
        found = live.step(1)
        time.sleep(0.02)
    shown, notes = found
    assert notes == [] and live.look(world) is shown
    np.testing.assert_allclose(shown.background, np.broadcast_to(SEEN, shown.background.shape), rtol=2e-3)
    np.testing.assert_allclose(sky.mean_of(shown.light), 0.5 * (UPPER + LOWER), rtol=5e-3)
    # A world that is not there any more is forgotten.
    bpy.data.worlds.remove(world)
    live.step(1)
    assert not live.is_busy or live.step(1) is None


@pytest.mark.newest
@pytest.mark.parametrize("kind", ["gradient", "horizon", "other for cameras"])
def test_a_background_has_few_pixels_only_where_they_show_all(kind):
    scene = parts.empty_scene(*SIZE)
    world = add_gradient()
    nodes = world.node_tree.nodes
    if kind != "other for cameras":
        nodes.remove(next(node for node in nodes if node.bl_idname == "ShaderNodeLightPath"))
        mix = next(node for node in nodes if node.bl_idname == "ShaderNodeMixShader")
        mix.inputs[0].default_value = 0.0
    if kind == "horizon":
        ramp = next(node for node in nodes if node.bl_idname == "ShaderNodeValToRGB").color_ramp
        ramp.interpolation, ramp.elements[1].position = "CONSTANT", 0.5
    light, _ = light_pictures(scene, world, light_of_world(world), print)
    few, many = (background_pictures(scene, world, print, one) for one in (light, ()))
    assert [len(one[0].radiance) for one in (few, many)] == [2 * SMOOTH if kind == "gradient" else 512, 512]
    if kind == "gradient":
        found, expected = (sky.unfolded(pictures, 256) for pictures in (few, many))
        np.testing.assert_allclose(found, expected, atol=2e-3 * expected.max())


def test_pictures_of_all_directions_are_folded_without_a_seam():
    """The cosine to any axis is smooth: interpolated between texels, also over the fold, it is what it is."""
    size, axis = 16, np.array([0.3, -0.5, 0.8])
    wide = sky.with_border(np.repeat((sky.directions(size) @ axis)[..., None], 3, axis=2))[..., 0]
    steps = [np.abs(np.diff(wide, axis=number)).max() for number in (0, 1)]
    inner = [np.abs(np.diff(wide[1:-1, 1:-1], axis=number)).max() for number in (0, 1)]
    assert max(steps) < 1.2 * max(inner)
    assert sky.solid_angles(64).sum() == pytest.approx(4.0 * np.pi, rel=2e-3)


def test_irradiance_of_a_linear_sky_is_known():
    """Of 1 + a.d it is pi (1 + 2/3 a.n)."""
    axis = np.array([0.2, 0.5, -0.4])
    pictures = []
    for axes in CUBE:
        picture = SkyPicture(*axes, np.zeros((32, 32, 3)))
        offsets = picture.offsets()
        unit = offsets / np.linalg.norm(offsets, axis=-1, keepdims=True)
        pictures.append(SkyPicture(*axes, np.repeat(1.0 + (unit @ axis)[..., None], 3, axis=2)))
    taken = sky.unfolded(pictures, 64)
    normals = sky.directions(32)
    found = sky.irradiance(taken, 32)[..., 0]
    np.testing.assert_allclose(found, 1.0 + 2.0 / 3.0 * (normals @ axis), rtol=6e-3)
    np.testing.assert_allclose(sky.mean_of(sky.halved(taken)), sky.mean_of(taken), rtol=1e-6)
