"""The render engine LTSH in background: what it registers, its final renders, the preview button."""

import bpy
import numpy as np
import pytest
import scene_parts as parts

import ltsh_addon
from ltsh_addon import shading
from ltsh_addon.blender.engine import render as render_module
from ltsh_addon.blender.engine import view
from ltsh_addon.blender.lights.textures import ShownTextures
from ltsh_addon.blender.materials import looks
from ltsh_addon.blender.process import client
from ltsh_addon.blender.viewport.mirror import view_lights
from ltsh_addon.imaging.exr import read_channels
from ltsh_addon.scene import Border


def add_content(scene):
    """A glossy plane and a matte sphere under an area light, and the engine."""
    shiny, _ = parts.principled("Shiny", Base_Color=(0.6, 0.3, 0.1, 1.0), Roughness=0.3)
    matte, _ = parts.bsdf_material("ShaderNodeBsdfDiffuse", "Matte", Color=(0.2, 0.5, 0.8, 1.0))
    plane, sphere = parts.add_plane(shiny, size=2.0), parts.add_sphere(matte, location=(0.4, 0.5, 0.6))
    parts.add_area_light()
    parts.add_camera()
    scene.render.engine = "LTSH"
    scene.ltsh_view.render_samples = 1
    return plane, sphere


def render(scene, path):
    """Channels of the picture that rendering `scene` writes."""
    settings = scene.render.image_settings
    if bpy.app.version >= (5, 0, 0):
        settings.media_type = "MULTI_LAYER_IMAGE"
    settings.file_format, settings.color_depth, settings.exr_codec = "OPEN_EXR_MULTILAYER", "32", "ZIP"
    scene.render.filepath = str(path)
    bpy.ops.render.render(write_still=True)
    return read_channels(path)


def picture(channels, layer, name, letters="RGB"):
    """Pass `name` of a view layer, (H, W, C)."""
    return np.stack([channels[f"{layer}.{name}.{letter}"] for letter in letters], axis=-1)


def test_settings_of_cycles_own_renders_stay_hidden(addon):
    shown = (
        *("CYCLES_MATERIAL_PT_surface", "CYCLES_LIGHT_PT_light", "CYCLES_WORLD_PT_surface", "WORLD_PT_context_world"),
        *("DATA_PT_lens", "DATA_PT_camera", "OBJECT_PT_transform", "OBJECT_PT_display", "MATERIAL_PT_viewport"),
        *("CYCLES_PT_context_material", "CYCLES_OBJECT_PT_visibility", "CYCLES_LIGHT_PT_beam_shape"),
        *("RENDER_PT_color_management", "RENDER_PT_format", "VIEWLAYER_PT_layer", "DATA_PT_uv_texture"),
    )
    for name in shown:
        panel = getattr(bpy.types, name)
        assert "LTSH" in getattr(panel, "COMPAT_ENGINES", {"LTSH"}), name
    for name in ("CYCLES_RENDER_PT_sampling", "CYCLES_RENDER_PT_light_paths", "CYCLES_RENDER_PT_performance"):
        assert "LTSH" not in getattr(bpy.types, name).COMPAT_ENGINES, name


def test_final_render_is_the_picture_that_shade_makes(addon, tmp_path):
    add_content(addon)
    addon.ltsh_view.technique, addon.ltsh_view.technique_passes = "ltsh2", True
    channels = render(addon, tmp_path / "final.exr")
    copy = tmp_path / "scene.blend"
    bpy.ops.wm.save_as_mainfile(filepath=str(copy), copy=True)
    extraction = client.extract(client.ExtractOptions(scene=copy))
    for prefix, technique in (("LTSH", "ltsh2"), ("LTC", "ltc"), ("LTSH 4", "ltsh4")):
        for name in shading.PASSES:
            shaded = shading.shade(extraction.samples, extraction.lights, technique, passes=(name,))
            expected = extraction.film.image(shaded.combined)
            found = picture(channels, "ViewLayer", f"{prefix} {name.capitalize()}")
            # Both take the same samples; the pictures are float32.
            np.testing.assert_allclose(found, expected, rtol=1e-6, atol=1e-7)
            assert expected.max() > 0.01
    both = picture(channels, "ViewLayer", "LTSH Specular") + picture(channels, "ViewLayer", "LTSH Diffuse")
    np.testing.assert_allclose(picture(channels, "ViewLayer", "Combined"), both, rtol=1e-6, atol=1e-7)


def test_every_view_layer_has_its_own_picture(addon, tmp_path):
    plane, sphere = add_content(addon)
    other = bpy.data.collections.new("Other")
    addon.collection.children.link(other)
    addon.collection.objects.unlink(sphere)
    other.objects.link(sphere)
    layer = addon.view_layers.new("Without sphere")
    layer.layer_collection.children["Other"].exclude = True
    addon.render.film_transparent = True
    channels = render(addon, tmp_path / "layers.exr")
    alpha = {name: channels[f"{name}.Combined.A"] for name in ("ViewLayer", "Without sphere")}
    assert set(np.unique(alpha["Without sphere"])) == {0.0, 1.0}
    # The sphere stands in part before the background.
    assert alpha["ViewLayer"].sum() > 1.1 * alpha["Without sphere"].sum()
    for name, hit in alpha.items():
        light = picture(channels, name, "LTSH Specular").sum(axis=-1)
        assert light[hit == 0.0].max() == 0.0 < light.max(), name


def test_the_world_is_seen_behind_surfaces_alone(addon, tmp_path):
    add_content(addon)
    world = addon.world = bpy.data.worlds.new("World")
    if bpy.app.version < (5, 0, 0):
        world.use_nodes = True
    background = next(node for node in world.node_tree.nodes if node.bl_idname == "ShaderNodeBackground")
    background.inputs["Color"].default_value = (0.1, 0.2, 0.4, 1.0)
    background.inputs["Strength"].default_value = 2.0
    channels = render(addon, tmp_path / "world.exr")
    combined = picture(channels, "ViewLayer", "Combined")
    np.testing.assert_allclose(combined[0, 0], (0.2, 0.4, 0.8), rtol=1e-6)
    assert (channels["ViewLayer.Combined.A"] == 1.0).all()
    seen = picture(channels, "ViewLayer", "LTSH Specular").sum(axis=-1) > 0.0
    assert seen.any() and not np.isclose(combined[seen][:, 2], 0.8, rtol=1e-3).any()


def test_what_surfaces_emit_is_in_the_picture_and_has_a_pass(addon, tmp_path):
    plane, _ = add_content(addon)
    addon.cycles.film_exposure = 2.0
    inputs = plane.data.materials[0].node_tree.nodes["Principled BSDF"].inputs
    inputs["Emission Color"].default_value, inputs["Emission Strength"].default_value = (0.1, 0.2, 0.3, 1.0), 0.5
    channels = render(addon, tmp_path / "glow.exr")
    passes = {name: picture(channels, "ViewLayer", f"LTSH {name}") for name in ("Specular", "Diffuse", "Emission")}
    shining = passes["Emission"].any(axis=-1)
    assert 0.1 < shining.mean() < 0.9
    np.testing.assert_allclose(passes["Emission"][shining], np.tile((0.1, 0.2, 0.3), (shining.sum(), 1)), rtol=1e-5)
    np.testing.assert_allclose(picture(channels, "ViewLayer", "Combined"), sum(passes.values()), rtol=1e-5, atol=1e-6)


def test_a_scene_without_lights_fails_with_its_reason(addon, tmp_path):
    parts.add_plane()
    parts.add_camera()
    addon.render.engine = "LTSH"
    with pytest.raises(RuntimeError, match="LTSH: scene 'Scene': no area light"):
        render(addon, tmp_path / "dark.exr")
    assert not render_module._copy


def test_only_the_render_region_is_handed_to_blender():
    image = np.arange(60.0).reshape(6, 10, 1)
    border = Border(left=2, top=1, width=5, height=3, full_width=10, full_height=6)
    np.testing.assert_array_equal(render_module.inside_border(image, border), image[1:4, 2:7])
    flat = render_module.blender_pixels(image)
    # Blender's rows start at the bottom.
    np.testing.assert_array_equal(flat.reshape(6, 10)[0], image[5, :, 0])


@pytest.fixture
def without_cycles():
    """Cycles' add-on is off."""
    parts.empty_scene()
    bpy.ops.preferences.addon_disable(module="cycles")
    yield bpy.context.scene
    bpy.ops.preferences.addon_enable(module="cycles")


def test_without_cycles_add_on_there_is_a_viewport_and_a_final_render(without_cycles, tmp_path):
    assert not hasattr(without_cycles, "cycles")
    ltsh_addon.register()
    try:
        plane, _ = add_content(without_cycles)
        depsgraph = bpy.context.evaluated_depsgraph_get()
        lights, notes = view_lights(depsgraph, lambda instance: True, ShownTextures())
        assert len(lights) == 1 and not notes
        assert looks.look_of(plane.active_material).corrected
        assert view._shown(without_cycles, "single", None, 1.0).exposure == 1.0
        channels = render(without_cycles, tmp_path / "final.exr")
        assert picture(channels, "ViewLayer", "LTSH Specular").max() > 0.01
    finally:
        ltsh_addon.unregister()
