"""The render engine LTSH in background: what it registers and its final renders as Blender drives them."""

import gc
import tempfile
import threading
import time
import weakref
from types import SimpleNamespace

import bpy
import numpy as np
import pytest
import scene_parts as parts
from job_window import image_pixels
from lit_plane import into_collection

import ltsh_addon
from ltsh_addon import shading
from ltsh_addon.blender.engine import final_picture, redraws, view
from ltsh_addon.blender.engine import render as render_module
from ltsh_addon.blender.lights.textures import ShownTextures
from ltsh_addon.blender.materials import preview_material
from ltsh_addon.blender.process.pixels import PixelJob, extract_pixels
from ltsh_addon.blender.render_settings import pass_names
from ltsh_addon.blender.ui import results
from ltsh_addon.blender.ui.job import STARTING, Plan
from ltsh_addon.blender.ui.overlay import covered
from ltsh_addon.blender.viewport.mirror import view_lights
from ltsh_addon.imaging.exr import read_channels
from ltsh_addon.pipeline import PictureOptions, RenderOptions, compositing, shade_scene
from ltsh_addon.pipeline.render import finish
from ltsh_addon.scene import Cancelled

SIZE = (28, 18)
# Both take the same samples; the pictures are float32.
SAME = {"rtol": 1e-6, "atol": 1e-7}


def lit_scene():
    """A glossy plane and a matte sphere under an area light, rendered by LTSH into float EXRs; plane and sphere."""
    shiny, _ = parts.principled("Shiny", Base_Color=(0.6, 0.3, 0.1, 1.0), Roughness=0.3)
    matte, _ = parts.bsdf_material("ShaderNodeBsdfDiffuse", "Matte", Color=(0.2, 0.5, 0.8, 1.0))
    plane, sphere = parts.add_plane(shiny, size=2.0), parts.add_sphere(matte, location=(0.4, 0.5, 0.6))
    parts.add_area_light()
    parts.add_camera()
    scene = bpy.context.scene
    scene.render.engine = "LTSH"
    scene.ltsh.anti_aliasing, scene.ltsh_view.technique = 1, "ltsh2"
    scene.ltsh.shadows = scene.ltsh_view.complete = False
    settings = scene.render.image_settings
    settings.file_format, settings.color_depth = "OPEN_EXR", "32"
    return plane, sphere


@pytest.fixture
def scene(addon):
    addon.render.resolution_x, addon.render.resolution_y = SIZE
    lit_scene()
    return addon


def picture(channels, name):
    """The layer `name` (H, W, 3) of an EXR."""
    return np.stack([channels[f"{name}{letter}"] for letter in "RGB"], axis=-1)


def render(scene, path):
    """The picture (H, W, 3) that rendering `scene` writes."""
    scene.render.filepath = str(path)
    bpy.ops.render.render(write_still=True)
    return picture(read_channels(path), "")


def render_passes(scene, path):
    """Channels of the multi-layer file that rendering `scene` writes."""
    settings = scene.render.image_settings
    if bpy.app.version >= (5, 0, 0):
        settings.media_type = "MULTI_LAYER_IMAGE"
    settings.file_format, settings.exr_codec = "OPEN_EXR_MULTILAYER", "ZIP"
    scene.render.filepath = str(path)
    bpy.ops.render.render(write_still=True)
    return read_channels(path)


def extracted(tmp_path, **options):
    """Samples and lights of a copy of the open file."""
    path = parts.save(tmp_path / "scene.blend", copy=True)
    return extract_pixels(PixelJob(scene=path, **options))


def shaded(extraction, technique="ltsh2", passes=shading.PASSES):
    """What shading the samples gives, (H, W, 3)."""
    result = shading.shade(extraction.samples, extraction.lights, technique, passes=passes)
    return extraction.picture.exposure * extraction.film.image(result.combined)


def test_settings_of_cycles_own_renders_stay_hidden(addon):
    shown = (
        *("CYCLES_MATERIAL_PT_surface", "CYCLES_LIGHT_PT_light", "CYCLES_WORLD_PT_surface", "WORLD_PT_context_world"),
        *("DATA_PT_lens", "DATA_PT_camera", "OBJECT_PT_transform", "OBJECT_PT_display", "MATERIAL_PT_viewport"),
        *("CYCLES_PT_context_material", "CYCLES_OBJECT_PT_visibility", "CYCLES_LIGHT_PT_beam_shape"),
        *("RENDER_PT_color_management", "RENDER_PT_format", "VIEWLAYER_PT_layer", "DATA_PT_uv_texture"),
    )
    for name in shown:
        assert "LTSH" in getattr(getattr(bpy.types, name), "COMPAT_ENGINES", {"LTSH"}), name
    for name in ("CYCLES_RENDER_PT_sampling", "CYCLES_RENDER_PT_light_paths", "CYCLES_RENDER_PT_performance"):
        assert "LTSH" not in getattr(bpy.types, name).COMPAT_ENGINES, name


def test_panels_of_materials_lights_and_worlds_are_there_as_with_cycles(addon):
    """Also those that ask a class of their own for the engine."""
    world, material = bpy.data.worlds.new("World"), bpy.data.materials.new("Clay")
    light, ob = bpy.data.lights.new("Key", "AREA"), bpy.data.objects.new("Ball", bpy.data.meshes.new("Ball"))
    names = ("CYCLES_MATERIAL_PT_surface", "CYCLES_MATERIAL_PT_settings",
             "CYCLES_PT_context_material", "CYCLES_LIGHT_PT_light", "CYCLES_LIGHT_PT_beam_shape",
             "CYCLES_WORLD_PT_surface", "CYCLES_WORLD_PT_settings", "CYCLES_OBJECT_PT_visibility")  # fmt: skip
    shown = {}
    for engine in ("LTSH", "CYCLES", "BLENDER_EEVEE"):
        context = SimpleNamespace(engine=engine, world=world, material=material, light=light, object=ob, mesh=ob.data,
                                  active_object=ob, scene=addon, preferences=bpy.context.preferences)  # fmt: skip
        panels = {name: getattr(bpy.types, name).poll(context) for name in (*names, "CYCLES_RENDER_PT_sampling")}
        shown[engine] = {name for name, is_shown in panels.items() if is_shown}
    assert shown["LTSH"] == set(names) == shown["CYCLES"] - {"CYCLES_RENDER_PT_sampling"}
    assert not shown["BLENDER_EEVEE"]
    ltsh_addon.unregister()
    try:
        context.engine = "LTSH"
        assert not any(getattr(bpy.types, name).poll(context) for name in names)
    finally:
        ltsh_addon.register()


def test_a_complete_render_is_the_picture_that_the_command_makes_with_the_passes_of_cycles(scene, tmp_path):
    settings, layer = scene.ltsh_view, scene.view_layers[0]
    settings.complete, scene.ltsh.cycles_samples = True, 8
    layer.use_pass_diffuse_indirect = layer.use_pass_diffuse_direct = layer.use_pass_z = layer.use_pass_uv = True
    layer.use_pass_glossy_direct = layer.use_pass_cryptomatte_object = True
    channels = render_passes(scene, tmp_path / "final.exr")
    path = parts.save(tmp_path / "scene.blend", copy=True)
    options = RenderOptions(path, output=tmp_path, techniques=("ltsh2",), sub_samples=1, cycles_samples=8)
    made = finish(options)
    np.testing.assert_allclose(picture(channels, "ViewLayer.Combined."), made.combined[..., :3], rtol=1e-4, atol=1e-5)
    for name in shading.PASSES:
        found, expected = picture(channels, f"ViewLayer.LTSH {name.capitalize()}."), made.ours[f"ltsh2.{name}"]
        np.testing.assert_allclose(found, expected, **SAME)
        assert expected.max() > 0.01
    wanted = {
        key for key in made.channels if key.startswith(("Diff", "Gloss", "Depth", "UV", "Crypto")) and "Col" not in key
    }
    wanted = {key for key in wanted if not key.startswith(("Glossy Ind", "GlossInd"))}
    for key in wanted:
        np.testing.assert_allclose(channels[f"ViewLayer.{key}"], made.channels[key], rtol=1e-4, atol=1e-5, err_msg=key)
    assert {name.split(".")[0] for name in wanted} >= {"Depth", "UV", "CryptoObject00"}


def test_final_render_is_the_picture_that_shade_makes(scene, tmp_path):
    scene.ltsh_view.technique_passes = True
    channels, extraction = render_passes(scene, tmp_path / "final.exr"), extracted(tmp_path)
    for prefix, technique in (("LTSH", "ltsh2"), ("LTC", "ltc"), ("LTSH 4", "ltsh4")):
        for name in shading.PASSES:
            expected = shaded(extraction, technique, (name,))
            found = picture(channels, f"ViewLayer.{prefix} {name.capitalize()}.")
            np.testing.assert_allclose(found, expected, **SAME)
            assert expected.max() > 0.01
    np.testing.assert_allclose(picture(channels, "ViewLayer.Combined."), shaded(extraction), **SAME)


def test_final_render_has_the_shadows_that_shade_makes(scene, tmp_path):
    scene.ltsh.shadows, scene.ltsh.shadow_rays = True, 16
    found = picture(render_passes(scene, tmp_path / "final.exr"), "ViewLayer.Combined.")
    path = parts.save(tmp_path / "scene.blend", copy=True)
    shade_scene(PictureOptions(path, tmp_path / "out", techniques=("ltsh2",), shadow_rays=16))
    channels = read_channels(tmp_path / "out" / "shade.exr")
    expected, bare = (
        sum(picture(channels, f"ltsh2{kind}.{name}.") for name in shading.PASSES) for kind in ("", "_unshadowed")
    )
    np.testing.assert_allclose(found, expected, **SAME)
    shadowed = expected.sum(axis=-1) < 0.5 * bare.sum(axis=-1)
    assert 0.01 < shadowed.mean() < 0.5


def test_every_view_layer_has_its_own_picture(scene, tmp_path):
    scene.collection.children.link(into_collection("Other", bpy.data.objects["Sphere"]))
    layer = scene.view_layers.new("Without sphere")
    layer.layer_collection.children["Other"].exclude = True
    scene.render.film_transparent = True
    channels = render_passes(scene, tmp_path / "layers.exr")
    alpha = {name: channels[f"{name}.Combined.A"] for name in ("ViewLayer", "Without sphere")}
    assert set(np.unique(alpha["Without sphere"])) == {0.0, 1.0}
    # The sphere stands in part before the background.
    assert alpha["ViewLayer"].sum() > 1.1 * alpha["Without sphere"].sum()
    for name, hit in alpha.items():
        light = picture(channels, f"{name}.LTSH Specular.").sum(axis=-1)
        assert light[hit == 0.0].max() == 0.0 < light.max(), name


def test_the_world_is_seen_behind_surfaces_alone(scene, tmp_path):
    parts.add_world(Color=(0.1, 0.2, 0.4, 1.0), Strength=2.0)
    channels = render_passes(scene, tmp_path / "world.exr")
    combined = picture(channels, "ViewLayer.Combined.")
    np.testing.assert_allclose(combined[0, 0], (0.2, 0.4, 0.8), rtol=1e-6)
    assert (channels["ViewLayer.Combined.A"] == 1.0).all()
    seen = picture(channels, "ViewLayer.LTSH Specular.").sum(axis=-1) > 0.0
    assert seen.any() and not np.isclose(combined[seen][:, 2], 0.8, rtol=1e-3).any()


def test_what_surfaces_emit_is_in_the_picture_and_has_a_pass(scene, tmp_path):
    scene.cycles.film_exposure = 2.0
    inputs = bpy.data.materials["Shiny"].node_tree.nodes["Principled BSDF"].inputs
    inputs["Emission Color"].default_value, inputs["Emission Strength"].default_value = (0.1, 0.2, 0.3, 1.0), 0.5
    channels = render_passes(scene, tmp_path / "glow.exr")
    passes = {name: picture(channels, f"ViewLayer.LTSH {name}.") for name in ("Specular", "Diffuse", "Emission")}
    shining = passes["Emission"].any(axis=-1)
    assert 0.1 < shining.mean() < 0.9
    np.testing.assert_allclose(passes["Emission"][shining], np.tile((0.1, 0.2, 0.3), (shining.sum(), 1)), rtol=1e-5)
    np.testing.assert_allclose(picture(channels, "ViewLayer.Combined."), sum(passes.values()), rtol=1e-5, atol=1e-6)


@pytest.mark.newest
def test_every_frame_of_an_animation_is_its_own_picture(scene, tmp_path):
    for frame, x in ((1, -1.0), (2, 1.0)):
        bpy.data.objects["Light"].location.x = x
        bpy.data.objects["Light"].keyframe_insert("location", frame=frame)
    scene.frame_start, scene.frame_end = 1, 2
    scene.render.filepath = str(tmp_path / "frame_")
    bpy.ops.render.render(animation=True)
    pictures = [picture(read_channels(tmp_path / f"frame_000{frame}.exr"), "") for frame in (1, 2)]
    for frame, found in enumerate(pictures, 1):
        np.testing.assert_allclose(found, shaded(extracted(tmp_path, frame=frame)), **SAME)
    assert np.abs(pictures[0] - pictures[1]).max() > 0.01


def test_the_compositor_has_the_passes(scene, tmp_path):
    extraction = extracted(tmp_path)
    if bpy.app.version >= (5, 0, 0):
        tree = scene.compositing_node_group = bpy.data.node_groups.new("Compositing", "CompositorNodeTree")
        tree.interface.new_socket("Image", in_out="OUTPUT", socket_type="NodeSocketColor")
        output = tree.nodes.new("NodeGroupOutput")
    else:
        scene.use_nodes = True
        tree = scene.node_tree
        tree.nodes.clear()
        output = tree.nodes.new("CompositorNodeComposite")
    layers = tree.nodes.new("CompositorNodeRLayers")
    layers.scene = scene
    tree.links.new(layers.outputs["LTSH Specular"], output.inputs[0])
    found = render(scene, tmp_path / "composited.exr")
    np.testing.assert_allclose(found, shaded(extraction, passes=("specular",)), **SAME)
    assert found.max() > 0.01


@pytest.mark.parametrize("cropped", [True, False])
def test_the_render_region_is_a_part_of_the_whole_picture(scene, tmp_path, cropped):
    whole = render(scene, tmp_path / "whole.exr")
    settings = scene.render
    settings.use_border, settings.use_crop_to_border = True, cropped
    # Columns 7 to 21 and, counted from below, rows 3 to 12.
    settings.border_min_x, settings.border_max_x = 0.25, 0.75
    settings.border_min_y, settings.border_max_y = 3 / 18, 12 / 18
    part = render(scene, tmp_path / "part.exr")
    inside = np.s_[6:15, 7:21]
    np.testing.assert_allclose(part if cropped else part[inside], whole[inside], rtol=1e-5, atol=1e-6)
    if not cropped:
        part[inside] = 0.0
        assert (part == 0.0).all()


def test_a_stopped_render_is_no_error_and_leaves_nothing(scene, tmp_path, monkeypatch):
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    asked, failures = [], []

    def stop(stage, fraction):
        asked.append(stage)
        return False

    monkeypatch.setattr(render_module.LTSH_RenderEngine, "_progress", lambda self, *plan: stop)
    monkeypatch.setattr(render_module.LTSH_RenderEngine, "_fail", lambda self, error: failures.append(error))
    bpy.ops.render.render()
    assert asked and not failures
    assert not render_module._copy
    # The work ends, and with it its temporary folders, after the render.
    end = time.monotonic() + 60
    while any(tmp_path.glob("ltsh-*")) and time.monotonic() < end:
        time.sleep(0.05)
    assert not any(tmp_path.glob("ltsh-*"))


def final_job(scene, **options):
    return final_picture.FinalJob(scene.name, "ViewLayer", None, 2, "ltsh2", "combined", **options)


def test_progress_follows_the_plan_to_its_end_and_can_stop(scene, tmp_path):
    path, stages = parts.save(tmp_path / "scene.blend"), {}
    job = final_job(scene, other_techniques=("ltc", "ltsh4"), shadows="on", shadow_rays=8)
    plan, shares = Plan(job.steps()), []

    def progress(stage, fraction):
        stages.setdefault(stage, []).append(fraction)
        plan.report(stage, fraction)
        shares.append(plan.share())

    final_picture.final_picture(job, path, progress)
    # Nothing in the scene is bumped.
    assert [STARTING, *stages] == [step.stage for step in job.steps() if step.stage != "horizons"]
    for fractions in stages.values():
        assert fractions == sorted(fractions) and 0.0 <= fractions[0] <= fractions[-1] <= 1.0
    assert shares == sorted(shares) and plan.number == plan.count
    with pytest.raises(Cancelled):
        final_picture.final_picture(job, path, lambda stage, fraction: stage != "LTSH N=4")


def test_the_picture_is_shown_as_its_passes_come(scene, tmp_path):
    parts.add_world(Color=(0.1, 0.2, 0.3, 1.0))
    path, shown = parts.save(tmp_path / "scene.blend"), []
    job = final_job(scene)
    whole = final_picture.final_picture(job, path, lambda stage, fraction: True, shown.append)
    assert [len(picture.passes) for picture in shown] == [1, 2, 3]
    for earlier, name in zip(shown, ("LTSH Specular", "LTSH Diffuse"), strict=False):
        assert name not in earlier.passes
    left_out = whole.combined[..., :3] - shown[1].combined[..., :3]
    np.testing.assert_allclose(left_out, whole.passes["LTSH Diffuse"], **SAME)
    np.testing.assert_array_equal(shown[-1].combined, whole.combined)


def test_a_world_that_varies_is_seen_behind_the_surfaces(scene, tmp_path):
    """What cameras see of it, where surfaces see something else."""
    world, background = parts.add_world(Color=(0.9, 0.3, 0.1, 1.0))
    tree, seen = world.node_tree, np.array([0.2, 0.5, 0.4])
    plain = parts.add_node(tree, "ShaderNodeBackground", Color=(*seen, 1.0))
    mix, path = tree.nodes.new("ShaderNodeMixShader"), tree.nodes.new("ShaderNodeLightPath")
    output = background.outputs[0].links[0].to_node
    for start, end in ((path.outputs["Is Camera Ray"], mix.inputs[0]), (background.outputs[0], mix.inputs[1]),
                       (plain.outputs[0], mix.inputs[2]), (mix.outputs[0], output.inputs["Surface"])):  # fmt: skip
        tree.links.new(start, end)
    path = parts.save(tmp_path / "scene.blend")
    picture = final_picture.final_picture(final_job(scene), path, lambda *now: True)
    lit = picture.passes["LTSH Specular"] + picture.passes["LTSH Diffuse"] + picture.passes[final_picture.EMISSION]
    behind = picture.combined[..., :3] - lit
    share = behind[..., 1] / seen[1]
    assert share.min() > -1e-4 and share.max() == pytest.approx(1.0, abs=1e-3) and share.mean() < 0.9
    np.testing.assert_allclose(behind, share[..., None] * seen, atol=2e-3)
    np.testing.assert_array_equal(picture.combined[..., 3], 1.0)
    # In a render region that is not cropped, with the lights kept for the mixer.
    scene.render.use_border, scene.render.use_crop_to_border = True, False
    scene.render.border_min_x, scene.render.border_max_x = 0.0, 0.5
    path = parts.save(tmp_path / "region.blend")
    job = final_job(scene, keeps_lights=True)
    region = final_picture.final_picture(job, path, lambda *now: True)
    width = region.combined.shape[1]
    assert 0 < width < picture.combined.shape[1]
    np.testing.assert_allclose(region.combined, picture.combined[:, :width], atol=2e-3)


def test_a_complete_picture_shows_its_direct_light_before_cycles_begins(scene, tmp_path):
    path, stages, shown = parts.save(tmp_path / "scene.blend"), [], []
    # So many rays that hardly any noise is left to Cycles and the denoiser.
    job = final_job(scene, cycles_samples=2, shadow_rays=1024)

    def show(picture):
        assert "Cycles" not in stages
        shown.append(picture)

    whole = final_picture.final_picture(job, path, lambda stage, fraction: stages.append(stage), show)
    assert "Cycles" in stages
    (early,) = shown
    for name in ("LTSH Specular", "LTSH Diffuse"):
        # In the end it is what Cycles tells of it, too: little, with two samples, but where LTSH is dark.
        ours, before = (picture.passes[name][whole.passes[name] > 0.0] for picture in (whole, early))
        assert (ours <= compositing.MOST_FACTOR * before * (1.0 + 1e-6)).all()
        assert len(ours) and ours.sum() == pytest.approx(before.sum(), rel=0.05)
    both = early.passes["LTSH Specular"] + early.passes["LTSH Diffuse"]
    np.testing.assert_allclose(early.combined[..., :3], both, **SAME)


def test_a_render_tells_a_line_a_second_and_shows_every_picture(scene, monkeypatch):
    told, pictures, now = [], [], [100.0]
    engine = SimpleNamespace(update_progress=told.append, update_stats=lambda first, text: told.append(text),
                             test_break=lambda: False)  # fmt: skip
    monkeypatch.setattr(render_module.time, "monotonic", lambda: now[0])
    plan = Plan(final_job(scene).steps(), now=lambda: now[0])
    progress = render_module.LTSH_RenderEngine._progress(engine, plan, lambda: pictures.append(now[0]))
    for _ in range(240):
        now[0] += 0.05
        assert progress("samples", 0.5) is True
    lines = [text for text in told if isinstance(text, str)]
    assert len(lines) in (12, 13) and len(pictures) == 240
    # Half of the samples took 12 s by now: as long again, and the shading of some pixels.
    assert lines[-1].startswith("LTSH: Sample Surfaces  ") and "left" in lines[-1] and " %" in lines[-1]


def test_depth_normal_position_and_indices_are_those_of_cycles(scene, tmp_path):
    layer = bpy.context.view_layer
    layer.use_pass_z = layer.use_pass_normal = layer.use_pass_position = True
    layer.use_pass_object_index = layer.use_pass_material_index = True
    for number, ob in enumerate(one for one in scene.objects if one.type == "MESH"):
        ob.pass_index, ob.material_slots[0].material.pass_index = 3 + 4 * number, 20 - 7 * number
    found = render_passes(scene, tmp_path / "ours.exr")
    scene.render.engine = "CYCLES"
    # Pixel centers, as one point per pixel has them.
    scene.cycles.samples, scene.cycles.pixel_filter_type, scene.cycles.filter_width = 1, "BLACKMAN_HARRIS", 0.01
    scene.cycles.use_adaptive_sampling = scene.cycles.use_denoising = False
    expected = render_passes(scene, tmp_path / "cycles.exr")

    def layer_of(channels, name):
        keys = sorted(key for key in channels if key.startswith(f"ViewLayer.{name}."))
        return np.stack([channels[key] for key in keys], axis=-1)

    hit = layer_of(expected, "Depth")[..., 0] < 1e9
    assert 0.3 < hit.mean()
    indices = [pass_names()[key] for key in ("object_index", "material_index")]
    for name, seen in zip(indices, ({0, 3, 7}, {0, 20, 13}), strict=True):
        assert set(np.unique(layer_of(found, name))) == seen
    for name in ("Depth", "Normal", "Position", *indices):
        ours, theirs = layer_of(found, name), layer_of(expected, name)
        assert ours.shape == theirs.shape
        # Of pixels that an edge crosses, rounding decides.
        off = np.abs(ours - theirs).max(axis=-1) > 1e-3 * max(1.0, np.abs(theirs[hit]).max())
        assert off.mean() < 0.02, name


@pytest.mark.parametrize(
    "settings", [{}, {"shown": "diffuse"}, {"background": np.array([0.1, 0.2, 0.3])}, {"cycles_samples": 4}]
)
def test_a_final_picture_is_the_sum_of_its_lights_and_the_rest(scene, tmp_path, settings):
    """What the light mixer gets of it."""
    values = {"shown": "combined", "keeps_lights": True, **settings}
    job = final_picture.FinalJob(scene.name, "ViewLayer", None, 2, "ltsh4", **values)
    found = final_picture.final_picture(job, parts.save(tmp_path / "scene.blend"), lambda stage, fraction: True)
    layers, combined = found.lights.layers, found.combined
    np.testing.assert_allclose(layers.sum(axis=0), combined[..., :3], rtol=1e-4, atol=1e-5 * combined.max())
    np.testing.assert_allclose(found.lights.alpha, combined[..., 3], atol=1e-6)
    assert layers[0].max() > 0.1 * combined[..., :3].max()


def test_a_render_is_what_the_mixer_changes_until_results_are_shown(scene, monkeypatch):
    later = []
    monkeypatch.setattr(bpy.app.timers, "register", lambda function, **_: later.append(function))
    bpy.ops.render.render()
    (take,) = [one for one in later if one.__name__ == "take"]
    take()
    mixer = results.mixer_of(scene)
    assert [row.name for row in mixer.rows][-1] == "The rest" and len(scene.ltsh.mixed) == len(mixer.rows)
    scene.ltsh.mixed[0].muted = True
    assert scene.ltsh.mode == "MIX"
    found, expected = image_pixels("LTSH Comparison"), mixer.pictures.layers[1:].sum(axis=0)
    np.testing.assert_allclose(found, expected, rtol=1e-5, atol=1e-6)
    results.forget_renders()
    assert results.mixer_of(scene) is None


@pytest.mark.newest
@pytest.mark.parametrize("complete", [False, True])
def test_a_light_that_moved_since_a_render_is_shaded_where_it_is(scene, monkeypatch, complete):
    """As a render of the moved light; the others, and what is bounced, stay."""
    later = []
    monkeypatch.setattr(bpy.app.timers, "register", lambda function, **_: later.append(function))
    scene.ltsh_view.complete, scene.ltsh.cycles_samples, scene.ltsh.shadows = complete, 4, True
    scene.cycles.max_bounces = 0

    def rendered():
        bpy.ops.render.render()
        [one for one in later if one.__name__ == "take"][-1]()
        return results.mixed_pixels(scene)[..., :3].copy()

    before = rendered()
    light = next(ob for ob in scene.objects if ob.type == "LIGHT")
    light.location.x += 0.4
    bpy.context.view_layer.update()
    assert bpy.ops.ltsh.update_moved_lights() == {"FINISHED"}
    found = results.mixed_pixels(scene)[..., :3].copy()
    expected = rendered()
    scene.cycles.seed = 1
    # Noise at the edges of shadows is of other rays; of what is complete Cycles has a part there.
    limit = 0.02 * np.linalg.norm(expected) + np.linalg.norm(rendered() - expected)
    assert np.linalg.norm(found - expected) < limit < 0.2 * np.linalg.norm(before - expected)
    results.forget_renders()


def test_work_that_never_asks_is_left_at_once():
    begun, go_on, ended = threading.Event(), threading.Event(), threading.Event()

    def work(report):
        report("waiting", 0.5)
        begun.set()
        go_on.wait(60)
        if report("later", 0.6) is False:
            ended.set()

    with pytest.raises(Cancelled, match="cancelled at waiting"):
        render_module.stoppable(work, lambda stage, fraction: not begun.is_set())
    assert not ended.is_set()
    go_on.set()
    # At its next report the work learns that nobody waits.
    assert ended.wait(60)


@pytest.mark.newest
def test_faults_fail_the_render_with_their_reason(scene, monkeypatch):
    with monkeypatch.context() as patch:
        patch.setattr(render_module, "final_picture", lambda *_: 1 / 0)
        with pytest.raises(RuntimeError, match="LTSH: ZeroDivisionError: division by zero"):
            bpy.ops.render.render()
    assert bpy.ops.render.render() == {"FINISHED"}
    fur, _ = parts.bsdf_material("ShaderNodeBsdfHair", "Fur")
    parts.add_plane(fur, size=40.0, location=(0.0, 0.0, 0.5), name="Cover")
    with pytest.raises(RuntimeError, match="LTSH: .* % of what camera 'Camera' sees is not shaded: material 'Fur'"):
        bpy.ops.render.render()
    bpy.data.objects.remove(bpy.data.objects["Cover"])
    bpy.data.objects.remove(bpy.data.objects["Light"])
    with pytest.raises(RuntimeError, match="LTSH: scene 'Scene': no light"):
        bpy.ops.render.render()
    assert not render_module._copy


def test_without_cycles_add_on_there_is_a_viewport_and_a_final_render(tmp_path):
    scene = parts.empty_scene()
    bpy.ops.preferences.addon_disable(module="cycles")
    ltsh_addon.register()
    try:
        assert not hasattr(scene, "cycles")
        plane, _ = lit_scene()
        lights, notes = view_lights(bpy.context.evaluated_depsgraph_get(), lambda instance: True, ShownTextures())
        assert len(lights) == 1 and not notes
        assert preview_material.preview_of(plane.active_material).corrected
        assert view._shown(scene, "single", None, 1.0).exposure == 1.0
        assert render(scene, tmp_path / "final.exr").max() > 0.01
    finally:
        ltsh_addon.unregister()
        bpy.ops.preferences.addon_enable(module="cycles")


def test_views_at_rest_are_drawn_again_and_what_moves_is_left_alone():
    def left(took, samples):
        """Seconds until views are drawn again, after one that `took` as long."""
        redraws.redraw_later(time.monotonic() - took, samples)
        return redraws.redraw()

    try:
        # A quick picture is refined once nothing has changed for a while; every change begins that anew.
        assert redraws.REST_SECONDS - 0.1 < left(0.01, 1) <= redraws.REST_SECONDS
        assert bpy.app.timers.is_registered(redraws.redraw)
        assert 0.5 < left(0.4, 1) <= 0.8 and left(30.0, 1) <= redraws.LONGEST_REST
        redraws.moments.update(next=0.0, refined=time.monotonic() - 10.0)
        # Then slow ones leave the window as much time as they take, and quick ones follow each other.
        assert 0.2 < left(0.4, 2)
        redraws.moments.update(next=time.monotonic() + 10.0, refined=0.0)
        assert left(0.001, 2) is None
    finally:
        redraws.stop()
    assert not bpy.app.timers.is_registered(redraws.redraw)


def test_a_view_that_is_left_is_freed_at_once_and_what_works_for_it_is_stopped(scene, monkeypatch):
    """Not when Python looks for circles the next time: it has textures, and processes that help."""
    collected = []
    monkeypatch.setattr(view, "view_occluders", lambda *arguments: collected.append(True))
    depsgraph = bpy.context.evaluated_depsgraph_get()
    gc.collect()
    gc.disable()
    try:
        seen = view.EngineView()
        seen._renderer = SimpleNamespace(shadows=None)
        seen._follow_shadows(depsgraph)
        shadows, stopped = seen._shadows, [one._stop for one in (seen._shadows, seen._shadows.of_glass)]
        seen._shadows._traced_scene.collect()
        assert seen._world.look(bpy.data.worlds.new("Any")) is None
        stopped.append(seen._world._look.stopped)
        left = [weakref.ref(part) for part in (seen, seen.mirror, shadows, shadows.of_glass)]
        del seen, shadows
        assert [one() for one in left] == [None] * 4
        assert collected and all(event.is_set() for event in stopped)
    finally:
        gc.enable()


def test_lines_keep_clear_of_all_regions_whatever_their_side():
    """Headers at either end, the toolbar at the right, and none where Blender does not let them overlap."""

    def part(kind, alignment, *place):
        return SimpleNamespace(
            type=kind, alignment=alignment, **dict(zip(("x", "y", "width", "height"), place, strict=True))
        )

    window = part("WINDOW", "NONE", 100, 50, 800, 600)
    overlapping = (part("HEADER", "BOTTOM", 100, 50, 800, 52), part("TOOL_HEADER", "TOP", 100, 598, 800, 52),
                   part("TOOLS", "RIGHT", 810, 102, 90, 496), part("HUD", "FLOAT", 120, 110, 300, 200),
                   part("UI", "LEFT", 100, 102, 1, 496))  # fmt: skip
    found = covered(SimpleNamespace(regions=(window, *overlapping)), window)
    assert found == {"LEFT": 0, "RIGHT": 90, "BOTTOM": 52, "TOP": 52, "FLOAT": 320}
    beside = part("HEADER", "TOP", 100, 650, 800, 52), part("TOOLS", "LEFT", 10, 50, 90, 600)
    assert not any(covered(SimpleNamespace(regions=(window, *beside)), window).values())


def test_material_preview_stays_that_of_eevee():
    assert render_module.LTSH_RenderEngine.bl_use_eevee_viewport
