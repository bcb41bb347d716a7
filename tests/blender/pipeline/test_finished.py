"""A finished picture is what Cycles renders: each kind of path alone, nothing twice, nothing lost."""

import itertools
import json
import re
from dataclasses import replace

import bpy
import numpy as np
import pytest
import scene_parts as parts
from material_scenes import Build

from ltsh_addon import imaging
from ltsh_addon.blender import render_settings
from ltsh_addon.blender.extract import finished as finished_module
from ltsh_addon.blender.extract import pixels as pixels_module
from ltsh_addon.blender.lights.emission import LookTooLong
from ltsh_addon.blender.process.blender_process import denoiser_libraries
from ltsh_addon.blender.process.finished import FinishedJob, render_finished
from ltsh_addon.blender.process.pixels import (
    TOO_LITTLE_GAIN,
    PixelJob,
    RenderedPixels,
    affordable_points,
    extract_pixels,
    in_pixels,
    longest_look,
    with_points,
)
from ltsh_addon.cli import main
from ltsh_addon.cycles.lobes import read_layer
from ltsh_addon.imaging import denoise
from ltsh_addon.imaging.exr import read_channels
from ltsh_addon.pipeline import PictureOptions, RenderOptions, compositing, plan, render, shade_scene
from ltsh_addon.pipeline.lighting import ShadowTracer, load_tables
from ltsh_addon.pipeline.mixer import light_pictures, moved_light
from ltsh_addon.pipeline.relight import LightChange, RelightData, relight
from ltsh_addon.scene import PASSES, light_of
from ltsh_addon.visibility import Occluders

SIZE, BLOCK = 32, 8  # pixels
SAMPLES, TRUE_SAMPLES = 64, 1024
# Relative error of the closed form in a block. Of the largest radiance: the points place an edge to 3 / POINTS of a
# pixel, and it crosses some 12 of the 64 pixels of a block.
POINTS = 33
OWN_ERROR, EDGE_ERROR = 0.015, 3.0 / POINTS * 12.0 / BLOCK**2


def floor_and_ball(material, bounces=0):
    """A ball of what `material()` gives on a gray floor under an area light."""
    scene = parts.empty_scene(SIZE, SIZE)
    scene.cycles.max_bounces = bounces
    scene.cycles.caustics_reflective = scene.cycles.caustics_refractive = False
    scene.cycles.transmission_bounces = scene.cycles.diffuse_bounces = scene.cycles.glossy_bounces = bounces
    parts.add_plane(parts.bsdf_material("ShaderNodeBsdfDiffuse", "Floor")[0])
    parts.add_sphere(material(), radius=0.7, location=(0.0, 0.0, 0.7))
    parts.add_camera((0.0, -4.5, 2.2), (1.18, 0.0, 0.0))
    parts.add_area_light(location=(0.8, -1.0, 3.0))
    return scene


def gray(**inputs):
    return lambda: parts.principled(Base_Color=(0.6, 0.5, 0.3, 1.0), Roughness=0.35, **inputs)[0]


def bsdf(kind, **inputs):
    return lambda: parts.bsdf_material(f"ShaderNode{kind}", **inputs)[0]


def fog():
    material, tree, output = parts.new_material("Fog")
    scatter = parts.add_node(tree, "ShaderNodeVolumeScatter", Density=1.5)
    tree.links.new(scatter.outputs[0], output.inputs["Volume"])
    return material


def toon_and_alpha():
    scene = floor_and_ball(gray(Alpha=0.5))
    made = Build("Toon")
    made.show(made.shader("BsdfToon"))
    scene.objects["Plane"].data.materials[0] = made.material


def volume():
    floor_and_ball(fog, 2).cycles.volume_bounces = 2


def furnace():
    scene = parts.empty_scene(SIZE, SIZE)
    scene.cycles.max_bounces = scene.cycles.diffuse_bounces = 32
    parts.add_sphere(parts.bsdf_material("ShaderNodeBsdfDiffuse", Color=(1.0, 1.0, 1.0, 1.0))[0])
    parts.add_camera((0.0, -4.0, 0.0), (np.pi / 2.0, 0.0, 0.0))
    parts.add_white_world()


def shown_lamp():
    """The light itself, a glowing ball, and a light that is left out."""
    floor_and_ball(bsdf("Emission", Strength=3.0), 1)
    bpy.data.objects["Light"].visible_camera = True
    bpy.data.objects["Sphere"].location.z = 1.0


def narrow_lamp():
    floor_and_ball(gray(), 1)
    parts.add_area_light("Beam", (-0.5, 0.0, 3.0), (0.0, 0.0, 0.0), spread=1e-4, energy=5.0)


def transparent_film():
    scene = floor_and_ball(gray(), 1)
    scene.render.film_transparent = True
    bpy.data.objects.remove(scene.objects["Plane"])


def depth_of_field():
    """The ball and the floor before it and behind it are some 20 pixels out of focus."""
    lens = floor_and_ball(gray(), 1).camera.data.dof
    lens.use_dof, lens.focus_distance, lens.aperture_fstop, lens.aperture_blades = True, 2.0, 0.15, 5


def sheared_lamp():
    """Of which Cycles' own picture is not that of its light."""
    scene = floor_and_ball(gray(), 1)
    parent = parts.link(bpy.data.objects.new("Parent", None), rotation=(0.0, 0.0, 0.5), scale=(1.0, 3.0, 0.5))
    parts.add_area_light("Sheared", (0.0, 0.0, 5.0), (0.4, 0.3, 0.7)).parent = parent
    scene.objects["Light"].data.energy = 10.0


def displaced():
    """A ball whose shadow rays would meet it where it is without; nothing is there that it casts a shadow on."""
    scene = floor_and_ball(moved_material)
    bpy.data.objects.remove(scene.objects["Plane"])


def moved_material():
    material, node = parts.principled("Moved", Roughness=0.6)
    tree, output = material.node_tree, node.outputs[0].links[0].to_node
    noise, move = parts.add_node(tree, "ShaderNodeTexNoise", Scale=4.0), tree.nodes.new("ShaderNodeDisplacement")
    move.inputs["Scale"].default_value = 0.4
    tree.links.new(noise.outputs[0], move.inputs["Height"])
    tree.links.new(move.outputs[0], output.inputs["Displacement"])
    material.displacement_method = "BOTH"
    return material


# What is built, and the share of the pixels on which each pass is ours.
SCENES = {
    "direct diffuse": (lambda: floor_and_ball(bsdf("BsdfDiffuse")), (1, 1)),
    "direct specular": (lambda: floor_and_ball(gray(Metallic=1.0)), (1, 1)),
    "one bounce": (lambda: floor_and_ball(gray(), 1), (1, 1)),
    "glass": (lambda: floor_and_ball(bsdf("BsdfGlass", Roughness=0.3), 4), (1, 1)),
    "subsurface": (lambda: floor_and_ball(gray(Subsurface_Weight=1.0, Subsurface_Scale=0.3), 1), (1, None)),
    "toon and alpha": (toon_and_alpha, (None, None)),
    "volume": (volume, (0, 0)),
    "white furnace": (furnace, (1, 1)),
    "lamp in sight": (shown_lamp, (1, 1)),
    "left out light": (narrow_lamp, (0, 0)),
    "transparent film": (transparent_film, (1, 1)),
    "depth of field": (depth_of_field, (1, 1)),
    "sheared light": (sheared_lamp, (0, 0)),
    "displacement": (displaced, (1, 1)),
}


def by_cycles(folder, samples=TRUE_SAMPLES):
    """What Cycles renders of the open scene, in a folder in `folder`."""
    (folder / "true").mkdir()
    job = FinishedJob(parts.save(folder / "true.blend"), *(None,) * 6, samples, None)
    return render_finished(job, folder / "true")


def finished(folder, **options):
    """The finished picture of the open scene."""
    return render.finish(RenderOptions(parts.save(folder / "scene.blend"), output=folder, **options))


def blocks(image):
    """Means (B, B, C) of square blocks."""
    return image.reshape(SIZE // BLOCK, BLOCK, SIZE // BLOCK, BLOCK, -1).mean(axis=(1, 3))


@pytest.mark.parametrize("name", SCENES)
def test_a_finished_picture_is_what_cycles_renders(name, tmp_path):
    build, shares = SCENES[name]
    build()
    bpy.context.scene.cycles.seed = 1
    made = finished(tmp_path, sub_samples=POINTS, cycles_samples=SAMPLES, denoise="off")
    bpy.context.scene.cycles.seed = 2
    true = read_layer(by_cycles(tmp_path).channels, "Combined", "RGBA")

    for pass_name, share in zip(PASSES, shares, strict=True):
        found = made.report["finished"]["share_of_ours"][pass_name]
        assert found == share if share is not None else 0.2 < found < 0.98, pass_name
    ours, expected = blocks(made.combined)[..., :3], blocks(true)[..., :3]
    # Both pictures have noise of their own: that of a mean is an eighth of what their pixels differ by.
    noise = blocks(np.abs(made.combined - true))[..., :3] / BLOCK
    tolerance = OWN_ERROR * np.abs(expected) + EDGE_ERROR * expected.max() + 4.0 * noise
    assert noise.mean() < 0.02 * expected.mean(), "so much noise hides what is looked for"
    worst = (np.abs(ours - expected) / tolerance).max()
    assert worst < 1.0, f"{name}: {worst:.2f} times what is tolerated"
    assert np.abs(blocks(made.combined) - blocks(true))[..., 3].max() < EDGE_ERROR


def test_depth_of_field_is_that_of_cycles_where_points_are_few_and_shade_has_it_too(out, tmp_path):
    depth_of_field()
    path, few = parts.save(tmp_path / "room.blend"), {"sub_samples": 8, "cycles_samples": 2}
    report = render.finish(RenderOptions(path, output=out, **few)).report
    reason = "depth of field of camera 'Camera' with fewer than 32 points per pixel (--aa)"
    assert report["finished"]["all_by_cycles"] == [reason]
    assert not any("switched off" in line and "depth" in line for line in report["warnings"])
    kept = RenderOptions(path, output=out, sub_samples=POINTS, cycles_samples=2, keep_visibility=True)
    render.make_finished(kept)
    ours = imaging.read_layers(out / "render.exr")
    # The denoiser saw the light that is taken away now, grain and all.
    found = relight(out, [LightChange("Light", muted=True)], out / "muted")
    assert any("shows its grain" in line for line in found["warnings"])
    options = PictureOptions(path, output=out, techniques=("ltsh4c",), sub_samples=POINTS)
    assert not any("depth of field" in line for line in shade_scene(options)["warnings"])
    layers = imaging.read_layers(out / "shade.exr")
    for name in PASSES:
        found, expected = layers[f"ltsh4c.{name}"], ours[f"ltsh4c.{name}"]
        noise = blocks(np.abs(found - expected)) / BLOCK
        assert (np.abs(blocks(found) - blocks(expected)) < EDGE_ERROR * expected.max() + 4.0 * noise).all()
    # With one point a pixel is seen through the middle of the lens.
    (warning,) = [line for line in shade_scene(replace(options, sub_samples=1))["warnings"] if "depth of field" in line]
    assert warning.endswith("shade and render have it with several points per pixel (--aa)")


def test_ours_and_the_rest_are_the_whole_in_the_files_of_a_command(out, tmp_path, capsys):
    floor_and_ball(gray(), 1)
    path = parts.save(tmp_path / "room.blend")
    words = ["render", str(path), "-o", str(out), "--cycles-samples", "4", "--aa", "2", "--json", "--quiet"]
    capsys.readouterr()
    assert main(words) == 0
    report = json.loads(capsys.readouterr().out)
    assert report["cycles_samples"] == 4
    assert report["finished"]["denoiser"].startswith("Open Image Denoise")
    layers = imaging.read_layers(out / "render.exr")
    whole = layers["ltsh4c.specular"] + layers["ltsh4c.diffuse"] + layers["rest"][..., :3]
    np.testing.assert_allclose(layers["combined"][..., :3], whole, rtol=1e-6, atol=1e-6)
    direct, color, kinds = ("Dir", "Col", "Diff Gloss") if bpy.app.version < (5, 0, 0) else (
        " Direct", " Color", "Diffuse Glossy")  # fmt: skip
    for kind, name in zip(kinds.split(), ("diffuse", "specular"), strict=True):
        # What the few samples of Cycles have not seen at an edge has no color.
        seen, own = layers[kind + color] > 0.0, layers[f"ltsh4c.{name}"]
        assert seen.mean() > 0.1
        found = layers[kind + direct] * layers[kind + color]
        # Of edges of diffuse light, and of highlights of which two points tell too little, a part is Cycles' own.
        assert (found - own)[seen].min() > -1e-5
        if name == "specular":
            assert np.isclose(found[seen], own[seen], rtol=1e-5, atol=1e-6).mean() > 0.7
    assert (out / "render.png").stat().st_size > 500
    assert main([*words, "--resume"]) == 0


@pytest.mark.newest
def test_denoising_takes_the_noise_of_the_rest_and_leaves_its_mean(tmp_path):
    floor_and_ball(gray(), 2)
    rest = {
        (samples, denoise): finished(tmp_path, sub_samples=1, cycles_samples=samples, denoise=denoise).rest[..., :3]
        for samples, denoise in ((8, "on"), (8, "off"), (512, "off"))
    }
    true = rest[512, "off"]
    noisy, clean = (np.linalg.norm(rest[8, denoise] - true) for denoise in ("off", "on"))
    assert clean < 0.6 * noisy
    assert abs(rest[8, "on"].mean() / true.mean() - 1.0) < 0.05


@pytest.mark.newest
@pytest.mark.parametrize("is_transparent", [False, True])
def test_edges_of_what_shines_are_smooth_with_few_samples(is_transparent, tmp_path):
    """A glowing ball that also reflects, above a floor without a material, before a sky."""
    scene = floor_and_ball(gray(Emission_Color=(1.0, 0.8, 0.5, 1.0), Emission_Strength=20.0), 1)
    scene.render.film_transparent = is_transparent
    scene.objects["Sphere"].location.z = 1.2
    scene.objects["Plane"].data.materials.clear()
    parts.add_world(Color=(0.4, 0.6, 1.0, 1.0), Strength=2.0)
    made = finished(tmp_path, sub_samples=2, cycles_samples=8)
    scene.cycles.seed = 1
    true = read_layer(by_cycles(tmp_path).channels, "Combined", "RGB")
    light = made.cycles.names["emission"]
    share = read_layer(made.cycles.channels, light, "RGB")[..., 0] / 20.0
    edge = (share > 0.1) & (share < 0.9)
    assert edge.sum() > 10
    # 16 samples and more in place of 8, and the noise of an edge falls faster than with their root; Cycles' own are in
    # the mean. They are 512 where Cycles finds the noise.
    ours, cycles = made.combined[..., :3], read_layer(made.cycles.channels, "Combined", "RGB")
    off, noise = (np.linalg.norm((image - true)[edge]) for image in (ours, cycles))
    assert off < 0.3 * noise, f"{off / noise:.2f} of the error that Cycles has with as many samples"
    assert abs(ours.mean() / true.mean() - 1.0) < 0.02


@pytest.mark.newest
def test_noisy_shadows_are_left_to_the_denoiser(tmp_path):
    scene = floor_and_ball(gray(), 1)
    # A slit lets little of a large light through: few of its rays arrive.
    for side in (-1.0, 1.0):
        parts.add_plane(parts.bsdf_material("ShaderNodeBsdfDiffuse", "Wall")[0], 4.0, f"Wall {side}")
        scene.objects[f"Wall {side}"].location = (2.02 * side, 0.0, 2.4)
    scene.objects["Light"].data.size = 3.0
    options = {"sub_samples": 1, "cycles_samples": 512, "shadow_rays": 8}
    made = {denoise: finished(tmp_path, denoise=denoise, **options) for denoise in ("on", "off")}
    shares = {name: one.report["finished"]["share_of_ours"]["diffuse"] for name, one in made.items()}
    assert shares["off"] == 1.0 and shares["on"] < 0.9
    whole = made["on"].rest[..., :3] + sum(made["on"].ours.values())
    np.testing.assert_allclose(made["on"].combined[..., :3], whole, atol=1e-5)
    # Cycles gives what is left of its own, no more and no less; 8 rays are 10 % off.
    true = read_layer(made["off"].cycles.channels, "Combined", "RGB").mean()
    assert abs(made["on"].combined[..., :3].mean() / true - 1.0) < 0.02


def test_a_kept_finished_picture_is_the_sum_of_its_lights_and_the_rest(out, tmp_path):
    floor_and_ball(gray(Subsurface_Weight=1.0), 1)
    path = parts.save(tmp_path / "room.blend")
    options = RenderOptions(path, output=out, sub_samples=2, cycles_samples=8, keep_visibility=True)
    assert {"render.samples.npz", "render.occluders.npz"} < set(render.make_finished(options).files)
    combined = imaging.read_layers(out / "render.exr")["combined"]
    data = RelightData.load(out / "render.samples.npz")
    mixed = light_pictures(data)
    assert len(mixed.layers) == 2
    np.testing.assert_allclose(mixed.layers.sum(axis=0), combined[..., :3], rtol=1e-4, atol=1e-5)
    # Its light alone, where it was, without what Cycles tells: rays of its own, as many as of all lights together.
    mixed = light_pictures(replace(RelightData.load(out / "render.samples.npz"), edges={}))
    occluders, light = Occluders.load(out / "render.occluders.npz"), light_of(mixed.rows[0].light)
    alone = moved_light(data, occluders, light, mixed.rows[0], lambda share: True)
    assert np.linalg.norm(alone - mixed.layers[0]) < 0.02 * np.linalg.norm(alone)


@pytest.mark.newest
def test_edges_go_with_the_light_that_makes_them(out, tmp_path):
    """Of two suns without a light group one is muted: what Cycles has added to its edges goes as well."""
    scene = floor_and_ball(bsdf("BsdfDiffuse"))
    bpy.data.objects.remove(scene.objects["Light"])
    for name, angle, energy in (("Sun", 0.6, 4.0), ("Moon", -0.4, 0.5)):
        parts.link(parts.new_light(name, "SUN", energy=energy, angle=0.01), rotation=(angle, angle, 0.0))
    scene.cycles.max_bounces = 0
    options = {"sub_samples": 5, "cycles_samples": 64}
    path = parts.save(tmp_path / "room.blend")
    render.make_finished(RenderOptions(path, output=out, keep_visibility=True, **options))
    relight(out, [LightChange("Sun", muted=True)], tmp_path / "relit")
    relit = imaging.read_layers(tmp_path / "relit" / "render.exr")["combined"][..., :3]
    scene.objects["Sun"].hide_render = True
    fresh = finished(tmp_path, **options).combined[..., :3]
    off = np.linalg.norm(relit - fresh) / np.linalg.norm(fresh)
    # Which edge is whose is not told: those of the sun leave a line in the light of the moon.
    assert off < 0.1, f"{100.0 * off:.1f} %"


@pytest.mark.newest
def test_bounced_light_follows_the_lights_of_its_light_group(out, tmp_path):
    """Of a finished picture lit anew, in the mixer and in its passes: as a render of the changed scene has it."""
    scene = floor_and_ball(gray(), 3)
    parts.add_plane(gray()(), name="Wall", location=(0.0, 1.5, 1.0), rotation=(np.pi / 2.0, 0.0, 0.0))
    cold = parts.add_area_light("Cold", location=(-1.5, -0.5, 2.0), rotation=(0.0, -0.6, 0.0), color=(0.3, 0.6, 1.0))
    loose = parts.add_area_light("Loose", location=(0.0, -2.5, 3.0), energy=10.0)
    for group, ob in (("Warm", bpy.data.objects["Light"]), ("Cold", cold)):
        scene.view_layers[0].lightgroups.add(name=group)
        ob.lightgroup = group
    assert not loose.lightgroup
    options = {"sub_samples": 3, "cycles_samples": 512}
    path = parts.save(tmp_path / "room.blend")
    render.make_finished(RenderOptions(path, output=out, keep_visibility=True, **options))
    layers = imaging.read_layers(out / "render.exr")
    mixed = light_pictures(RelightData.load(out / "render.samples.npz"))
    assert [row.group for row in mixed.rows] == ["Warm", "Cold", "", ""]
    np.testing.assert_allclose(mixed.layers.sum(axis=0), layers["combined"][..., :3], rtol=1e-4, atol=1e-5)
    np.testing.assert_allclose(mixed.layers[0], layers["Combined_Warm"], rtol=1e-4, atol=1e-5)

    factors = {"Light": 0.05, "Cold": 4.0}
    changes = [LightChange(name, power=factor) for name, factor in factors.items()]
    report = relight(out, changes, tmp_path / "relit")
    assert any("but for that of light groups 'Cold', 'Warm'," in line for line in report["warnings"])
    relit = imaging.read_layers(tmp_path / "relit" / "render.exr")["combined"][..., :3]
    by_row = np.array([0.05, 4.0, 1.0, 1.0])
    np.testing.assert_allclose(np.tensordot(by_row, mixed.layers, 1), relit, rtol=1e-4, atol=1e-5)
    for name, factor in factors.items():
        bpy.data.objects[name].data.energy *= factor
    fresh = []
    for seed in range(2):
        scene.cycles.seed = seed
        fresh.append(finished(tmp_path, **options).combined[..., :3])
    direct = relit - imaging.read_layers(tmp_path / "relit" / "render.exr")["rest"][..., :3]
    left_alone = direct + layers["rest"][..., :3]
    apart, noise, unfollowed = (
        np.linalg.norm(one - fresh[0]) / np.linalg.norm(fresh[0]) for one in (relit, fresh[1], left_alone)
    )
    # Measured noise: 0.9 %. What of the light is which group's is denoised, the fresh picture as a whole.
    assert apart < 2.0 * noise + 0.005 < 0.5 * unfollowed


@pytest.mark.newest
def test_budgets_buy_points_by_what_they_cost():
    pixels = 240 * 135
    points = [affordable_points(seconds, pixels, 1) for seconds in (1.0, 8.0, 24.0, 96.0)]
    assert points[0] == 0 and 1 <= points[1] < points[2] and points[3] == pytest.approx(4 * points[2], abs=4)
    # Each light takes time, but thousands of lights are clustered.
    lit = [affordable_points(24.0, pixels, lights) for lights in (1, 60, 120)]
    assert lit[0] >= lit[1] > lit[2] == 0
    assert affordable_points(64.0, pixels, 100) == affordable_points(64.0, pixels, 9999)
    # Of large scenes each look takes long.
    looked = [affordable_points(16.0, pixels, 1, seconds) for seconds in (0.0, 1.0, 4.0)]
    assert looked[0] >= looked[1] > looked[2] == 0
    for seconds in (8.0, 16.0, 32.0):
        most = longest_look(seconds)
        after = [affordable_points(seconds - look, pixels, 1, look) for look in (0.99 * most, 1.01 * most)]
        assert after[0] >= 1 and after[1] == 0


@pytest.mark.newest
def test_a_look_at_lights_that_takes_too_long_ends_and_leaves_nothing_behind():
    scene = floor_and_ball(gray(Emission_Strength=3.0))
    data = bpy.data.scenes, bpy.data.objects, bpy.data.cameras, bpy.data.meshes
    before = [set(one.keys()) for one in data]
    with pytest.raises(LookTooLong):
        pixels_module.prepare_scene(scene, scene.view_layers[0], scene.camera, [], look_until=0.0)
    assert [set(one.keys()) for one in data] == before


@pytest.mark.newest
def test_a_budget_excludes_samples(tmp_path, capsys):
    assert main(["render", "room.blend", "-o", str(tmp_path), "--budget", "3", "--cycles-samples", "4"]) == 2
    assert "not both" in capsys.readouterr().err


@pytest.mark.newest
def test_a_budget_chooses_points_rays_and_samples(tmp_path, monkeypatch):
    floor_and_ball(gray(), 1)
    parts.add_world(Color=(0.2, 0.2, 0.2, 1.0))
    # However little LTSH's light wins beside thousands of samples.
    monkeypatch.setattr(plan, "LEAST_GAIN", -1e6)
    # The larger one leaves time for everything, however slowly Blender starts on a busy machine.
    made = {budget: finished(tmp_path, budget=budget) for budget in (0.01, 10.0)}
    small, large = (one.report for one in made.values())
    # Of what shines in sight only what stands beside our light is rendered apart.
    assert not made[0.01].cycles.smooth_emission
    assert set(made[10.0].cycles.smooth_emission) == {"emission", "background"}
    # However small it is, every part has something.
    assert small["cycles_samples"] >= 2 and small["sub_samples"] >= 1
    assert small["cycles_samples"] < large["cycles_samples"]
    assert small["sub_samples"] <= large["sub_samples"] <= 17
    # Cycles does it all where there is no time to look at the lights.
    assert small["finished"]["share_of_ours"] == {"specular": 0.0, "diffuse": 0.0}
    assert any("too small" in line for line in small["warnings"])
    # Of hundreds of samples Cycles' picture is nearly as good.
    assert large["finished"]["share_of_ours"]["diffuse"] > 0.0 and not large["finished"]["all_by_cycles"]
    (line,) = (line for line in small["warnings"] if "the budget is 0.01 s:" in line)
    least, took = (float(text.partition(" s")[0]) for text in re.split("at least|took", line)[1:])
    assert 0.0 < least <= took


@pytest.mark.newest
def test_where_direct_light_can_win_nothing_there_is_no_look_at_the_lights(tmp_path, monkeypatch):
    """Each light lights each point evenly: Cycles' direct light has next to no noise beside that of bounces."""
    scene = floor_and_ball(gray(), 4)
    bpy.data.objects["Light"].data.size = 0.001
    monkeypatch.setattr(RenderedPixels, "of", None)
    made = finished(tmp_path, budget=10.0, resolution=(96, 96))
    assert made.report["finished"]["all_by_cycles"] == [TOO_LITTLE_GAIN]
    assert made.report["resolution"] == [96, 96] and made.report["camera"] == scene.camera.name
    assert made.cycles.samples > 24 and np.any(made.combined[..., :3])


@pytest.mark.newest
def test_some_pixels_alone_have_the_light_that_all_have(tmp_path):
    """Read alone, or taken from all of the picture."""
    floor_and_ball(gray())
    job = PixelJob(parts.save(tmp_path / "ball.blend"), sub_samples=3, for_finished=True, shadows="on")
    rendered = RenderedPixels.of(job, tmp_path)
    every, first = rendered.extraction(), rendered.extraction(1)
    where = np.indices((SIZE, SIZE)).sum(axis=0) // 16 % 2 == 0
    read, taken = rendered.extraction(where=where), in_pixels(every, where)
    for field in ("position", "view", "normal", "roughness", "specular_f0", "diffuse_albedo"):
        assert np.array_equal(getattr(read.samples, field), getattr(taken.samples, field))
    assert np.array_equal(first.samples.position, every.samples.position[every.points.number == 0])
    for some in (read, taken):
        assert set(some.film.pixel.tolist()) <= set(np.flatnonzero(where).tolist())
        for name in PASSES:
            replaced = some.left_to_cycles.replaced(name)
            assert np.array_equal(replaced, where & every.left_to_cycles.replaced(name)) and replaced.any()
        # Pixels share their points with those around them, of which here only some have any.
        inside = eroded(where)
        colors = (one.film.image(one.samples.diffuse_albedo.astype(float))[inside] for one in (some, every))
        assert np.allclose(*colors, atol=1e-6) and inside.sum() > SIZE**2 / 4
        at_border = where & ~inside
        coverage = some.film.coverage()[at_border], every.film.coverage()[at_border]
        assert np.abs(coverage[0] - coverage[1])[coverage[1] > 1.0 - 1e-6].max() < 1e-5


def eroded(mask):
    """The pixels of a `mask` whose eight neighbors are in it as well, or outside of the picture."""
    grid = np.pad(mask, 1, constant_values=True)
    size = mask.shape[0]
    return np.all([grid[y : y + size, x : x + size] for y, x in itertools.product(range(3), repeat=2)], axis=0)


@pytest.mark.newest
def test_points_tell_what_highlights_they_miss_but_not_what_colors(tmp_path):
    """Two points of each pixel on a smooth and on a crumpled floor, of facets of a third of a pixel, and on a flat one
    with as fine checks, whose colors Cycles' samples tell."""

    def checked():
        material, bsdf = parts.principled(Roughness=1.0)
        tree = material.node_tree
        checks = tree.nodes.new("ShaderNodeTexChecker")
        checks.inputs["Scale"].default_value = 25.0
        checks.inputs["Color2"].default_value = (0.0, 0.0, 0.0, 1.0)
        tree.links.new(checks.outputs["Color"], bsdf.inputs["Base Color"])
        return material

    variance = {}
    squares = plan.Squares(compositing.FirstErrors(4.0, np.full((SIZE, SIZE), 2.0), np.ones((SIZE, SIZE)), True))
    for name, height in (("smooth", 0.0), ("crumpled", 0.01), ("checked", 0.0)):
        parts.empty_scene(SIZE, SIZE)
        side = np.linspace(-2.0, 2.0, 100)
        x, y = (grid.ravel() for grid in np.meshgrid(side, side))
        z = height * np.random.default_rng(2).random(len(x))
        corner = (np.arange(99)[:, None] * 100 + np.arange(99)).ravel()
        floor = parts.add_mesh(name, np.stack([x, y, z], axis=1), corner[:, None] + np.array([0, 1, 101, 100]))
        metal = parts.principled(Metallic=1.0, Roughness=0.1)[0]
        floor.data.materials.append(checked() if name == "checked" else metal)
        parts.add_camera((0.0, 0.0, 4.0), (0.0, 0.0, 0.0))
        parts.add_area_light(location=(0.5, 0.0, 3.0), size=0.2)
        path = parts.save(tmp_path / f"{name}.blend")
        job = PixelJob(path, sub_samples=2, for_finished=True, shadows="on")
        found = extract_pixels(job)
        own = PictureOptions(path, output=tmp_path, sub_samples=2, shadows="on")
        with ShadowTracer(found.occluders, found.lights) as tracer:
            shader = render.DirectLightShader(own, 9.0, load_tables(("ltsh4c",)), tracer)
            probe = shader.probe(found, 2, squares, len(squares.gain), 1.0)
            found = with_points(found, 2)
            result = next(iter(shader.shaded(found, shader.shadows(found)).results.values()))
        light = found.film.image(result.shading.diffuse.sum(axis=0) + result.shading.specular.sum(axis=0))
        # What LTSH wins is the same in all squares. Relative to the light.
        variance[name] = probe.variances.mean() / np.square(light.mean(axis=-1)).mean()
    assert 0.0 < 30.0 * variance["smooth"] < variance["crumpled"]
    assert 30.0 * variance["checked"] < variance["crumpled"]


def test_the_files_of_a_budget_share_no_noise(tmp_path):
    floor_and_ball(gray(), 1)
    job = FinishedJob(parts.save(tmp_path / "room.blend"), *(None,) * 7, 1.0, edges=False)
    samples = render_finished(job, tmp_path).samples
    files = [imaging.read_layers(path) for path in sorted(tmp_path.glob("cycles_*.exr"))]
    noise = [layers["ViewLayer.Combined"] - layers["ViewLayer.Combined"].mean() for layers in files]
    assert len(noise) >= 2 and samples > 10
    assert all(not np.array_equal(one, other) for one, other in itertools.combinations(noise, 2))


@pytest.mark.newest
def test_a_budget_renders_the_samples_that_cycles_would_render_at_once(tmp_path, monkeypatch):
    """On a clock by which a file takes a second and each sample one more."""
    scene = floor_and_ball(gray(), 1)
    scene.render.engine, clock = "CYCLES", [0.0]
    scene.cycles.use_adaptive_sampling, scene.cycles.use_denoising, scene.cycles.use_sample_subset = False, False, True

    def render_file(scene, folder, files, count):
        write_file(scene, folder, files, count)
        clock[0] += 1.0 + count

    write_file = finished_module._render_file
    monkeypatch.setattr(finished_module, "_render_file", render_file)
    monkeypatch.setattr(finished_module, "FILE_SECONDS", 1e6 / SIZE**2)
    monkeypatch.setattr(finished_module.time, "process_time", lambda: clock[0])

    def timed(until, **begun):
        layer = scene.view_layers[0]
        return finished_module._TimedFiles(scene, layer, 0, tmp_path, lambda path: until, lambda *told: None, **begun)

    first = timed(28.5)
    first.render_first()
    # Another job goes on with them.
    rest = timed(28.5, files=first.files, each=first.each, least=first.least)
    rest.render_first()
    rest.render_rest()
    rendered = rest.files
    counts = [count for _, count in rendered]
    assert counts == [1, 3, 2, 2, 7, 7] and rest.least == 2.0 and clock[0] == 28.0
    pieces = [imaging.read_layers(tmp_path / name)["ViewLayer.Combined"] for name, _ in rendered]
    for seed, numbers in ((0, [0, 1, 2, 4, 5]), (1, [3])):
        parts_of_it, weights = [pieces[number] for number in numbers], [counts[number] for number in numbers]
        cycles = scene.cycles
        cycles.seed, cycles.samples = seed, finished_module.SEQUENCE
        cycles.sample_offset, cycles.sample_subset_length = 0, sum(weights)
        render_settings.render_exr(scene, tmp_path / "whole.exr")
        whole = imaging.read_layers(tmp_path / "whole.exr")["ViewLayer.Combined"]
        # Sums in another order.
        assert np.abs(np.average(parts_of_it, axis=0, weights=weights) - whole).max() < 1e-5
        assert np.abs(pieces[5 if seed else 3] - whole).max() > 1e-2
    # However little time there is, there are two files.
    none = timed(0.0)
    none.render_first()
    none.render_rest()
    assert len(none.files) == 2


@pytest.mark.newest
@pytest.mark.parametrize("threshold", [0.1, 0.01, 0.0])
def test_halves_as_saved_take_no_more_samples_than_the_file_asks_for(threshold, tmp_path):
    """Without noise Cycles takes its least number of samples, in steps of 16. What never ends is a plane whose light
    is rare and strong."""
    scene = parts.empty_scene(SIZE, SIZE)
    parts.add_plane(parts.bsdf_material("ShaderNodeEmission")[0], size=40.0)
    noisy, node = parts.bsdf_material("ShaderNodeEmission", "Noisy", Strength=100.0)
    position, random, rare = (
        parts.add_node(noisy.node_tree, f"ShaderNode{kind}") for kind in ("NewGeometry", "TexWhiteNoise", "Gamma")
    )
    rare.inputs["Gamma"].default_value = 30.0
    for source, target in (
        (position.outputs[0], random.inputs[0]),
        (random.outputs["Color"], rare.inputs["Color"]),
        (rare.outputs[0], node.inputs["Color"]),
    ):
        noisy.node_tree.links.new(source, target)
    parts.add_plane(noisy, size=1.0, name="Noisy", location=(0.0, 0.0, 0.1))
    parts.add_camera((0.0, 0.0, 3.0), (0.0, 0.0, 0.0))
    scene.render.engine, layer = "CYCLES", scene.view_layers[0]
    scene.cycles.use_adaptive_sampling, scene.cycles.adaptive_threshold, scene.cycles.samples = True, threshold, 512
    scene.cycles.use_denoising, layer.cycles.pass_debug_sample_count = False, True

    def samples(name, most):
        return most * read_channels(tmp_path / name)["ViewLayer.Debug Sample Count.X"].min()

    render_settings.render_exr(scene, tmp_path / "whole.exr")
    whole = samples("whole.exr", 512)
    files = finished_module._render_as_saved(scene, layer, tmp_path)
    assert len(files) == 2 and 16.0 <= whole < 256.0
    assert whole - 1.0 < sum(samples(*file) for file in files) < whole + 32.0


def test_the_first_points_of_a_pixel_are_those_of_a_picture_with_fewer(tmp_path):
    floor_and_ball(gray(), 1)
    path = parts.save(tmp_path / "room.blend")
    many, few = (extract_pixels(PixelJob(path, sub_samples=count, for_finished=True)) for count in (6, 3))
    first, whole = with_points(many, 3), with_points(few, 3)
    assert len(many.samples) > len(few.samples) > len(first.samples) > 0
    np.testing.assert_array_equal(first.film.pixel, whole.film.pixel)
    np.testing.assert_allclose(first.samples.position, whole.samples.position, atol=1e-6)
    values = np.random.default_rng(3).random((len(first.samples), 3))
    np.testing.assert_allclose(first.film.image(values), whole.film.image(values), atol=1e-12)
    np.testing.assert_allclose(first.film.coverage(), whole.film.coverage(), atol=1e-12)


@pytest.mark.newest
def test_what_cycles_keeps_does_not_fade_at_its_border(tmp_path):
    """Around a ball whose diffuse light is Cycles' own, pixels show as much of the floor as those beside them."""
    floor_and_ball(gray(Subsurface_Weight=0.01, Subsurface_Scale=0.01))
    made = finished(tmp_path, cycles_samples=64, shadow_rays=256)
    kept = (made.relight_data["taken"]["diffuse"] == 0.0).all(axis=-1)
    noisy = read_layer(made.cycles.channels, "Combined", "RGB")
    # The border of what is kept, and what touches it.
    inside = kept.copy()
    inside[1:-1, 1:-1] = kept[1:-1, 1:-1] & kept[:-2, 1:-1] & kept[2:, 1:-1] & kept[1:-1, :-2] & kept[1:-1, 2:]
    border = kept & ~inside
    assert border.sum() > 20
    ratio = made.combined[border, :3].sum() / noisy[border].sum()
    assert ratio == pytest.approx(1.0, abs=0.03)


def test_a_picture_without_any_light_says_that_it_is_black(tmp_path):
    scene = floor_and_ball(gray())
    for ob in list(bpy.data.objects):
        if ob.type == "LIGHT":
            bpy.data.objects.remove(ob)
    scene.world = None
    report = finished(tmp_path, sub_samples=1, cycles_samples=2, denoise="off").report
    assert any("no light at all" in line and "'Camera'" in line for line in report["warnings"])


@pytest.mark.newest
def test_borders_of_colors_are_as_smooth_as_in_cycles(tmp_path):
    """A white ball before a checkered floor, by one point a pixel: only the color within pixels is unknown."""
    scene = floor_and_ball(bsdf("BsdfDiffuse"), 1)
    checks = bsdf("BsdfDiffuse")()
    tree = checks.node_tree
    checker = tree.nodes.new("ShaderNodeTexChecker")
    checker.inputs["Scale"].default_value = 23.0
    tree.links.new(checker.outputs["Color"], tree.nodes["Diffuse BSDF"].inputs["Color"])
    scene.objects["Plane"].data.materials[0] = checks
    scene.cycles.seed = 1
    true = by_cycles(tmp_path)
    scene.cycles.seed = 0
    light, color = (read_layer(true.channels, true.names[f"diffuse_{key}"], "RGB") for key in ("light", "color"))
    off = {}
    for samples in (1, 64):  # with no more samples than points there is nothing to learn from Cycles
        made = finished(tmp_path, sub_samples=1, cycles_samples=samples, denoise="off")
        off[samples] = np.linalg.norm(made.ours["ltsh4c.diffuse"] - light * color)
    # 64 random samples know a border twice as well as the points of about three pixels, which share one each.
    assert off[64] < 0.6 * off[1], off


def hammered(strength):
    """A material with a normal map of noise, as coarse as a pixel."""
    material, node = parts.principled("Hammered", Base_Color=(0.6, 0.5, 0.4, 1.0), Roughness=0.35)
    tree = material.node_tree
    noise, normal = parts.add_node(tree, "ShaderNodeTexNoise", Scale=12.0), tree.nodes.new("ShaderNodeNormalMap")
    normal.inputs["Strength"].default_value = strength
    tree.links.new(noise.outputs["Color"], normal.inputs["Color"])
    tree.links.new(normal.outputs[0], node.inputs["Normal"])
    return material


@pytest.mark.newest
@pytest.mark.parametrize("strength", [0.5, 1.0, 2.0])
def test_normals_that_cycles_bends_or_leaves_dark_brighten_nothing(strength, tmp_path):
    """Its mean normal is not the diffuse one where it bends the specular one; its color counts dark normals."""
    scene = floor_and_ball(gray())
    scene.objects["Plane"].data.materials[0] = hammered(strength)
    true = by_cycles(tmp_path, 256)
    light, color = (read_layer(true.channels, true.names[f"diffuse_{key}"], "RGB") for key in ("light", "color"))
    made = finished(tmp_path, sub_samples=9, cycles_samples=64, denoise="off")
    # The points' own noise: 2 % without any correction, of which the mean over 32 x 32 pixels has about a tenth.
    assert made.ours["ltsh4c.diffuse"].sum() == pytest.approx((light * color).sum(), rel=0.01)


def test_normals_of_cycles_are_those_of_the_samples(tmp_path):
    floor_and_ball(gray(), 1)
    camera = bpy.context.scene.camera
    camera.location, camera.rotation_euler, camera.scale = (2.0, -3.5, 2.5), (1.0, 0.3, 0.5), (2.0, 2.0, 2.0)
    cycles = by_cycles(tmp_path, 64)
    extraction = extract_pixels(PixelJob(parts.save(tmp_path / "room.blend"), sub_samples=16, for_finished=True))
    normal = read_layer(cycles.guides, "Denoising Normal", "XYZ") @ cycles.to_camera
    expected, shown = extraction.film.image(extraction.samples.diffuse_normal), extraction.film.coverage() > 0.99
    assert 0.5 < shown.mean()
    # At the ball's border the points, and the samples, are few.
    apart = np.linalg.norm(normal - expected, axis=-1)[shown]
    assert np.median(apart) < 0.005 and np.quantile(apart, 0.9) < 0.1


@pytest.mark.parametrize("way", [denoise.PLAIN, denoise.BEST, *denoise.HALVES])
def test_each_way_to_denoise_keeps_the_picture_in_place(way):
    """A bright spot off the middle, on a ramp with an edge, loses its noise."""
    random, (row, column) = np.random.default_rng(4), np.mgrid[:80, :112]
    true = 0.2 + 0.6 * (column > 30 + 0.3 * row) + 0.004 * row + np.exp(-((row - 20) ** 2 + (column - 85) ** 2) / 40.0)
    true, plain = np.repeat(true[..., None], 3, axis=-1), np.ones((80, 112, 3))
    noisy = true * random.gamma(4.0, 0.25, true.shape)
    with denoise.open_denoiser(denoiser_libraries(), 2) as denoiser:
        (clean,) = denoiser.all_denoised([noisy], 0.5 * plain, plain, [way])
    pictures = noisy, true[::-1], true[:, ::-1], clean
    *others, error = (np.sqrt(np.square(one - true).mean()) / true.mean() for one in pictures)
    assert error < 0.08 < 0.2 < min(others) and sum(way.values()) == pytest.approx(1.0)
    assert clean.mean() == pytest.approx(true.mean(), rel=0.02)
