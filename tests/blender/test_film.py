"""Film, view layer and collections: what a plain render shows is shown, or is switched off with a warning."""

import bpy
import numpy as np
import pytest
import scene_parts
from scene_parts import add_plane, bsdf_material

from ltsh_addon import imaging
from ltsh_addon.blender import child, pixel_filter
from ltsh_addon.blender.child import ExtractOptions, extract
from ltsh_addon.blender.render_settings import enable_passes, render_exr
from ltsh_addon.compare import Options, compare_scene

SIZE = (26, 16)


def diffuse(name, color):
    return bsdf_material("ShaderNodeBsdfDiffuse", name, Color=(*color, 1.0))[0]


def tiles():
    """A gray floor seen from above with a red tile in its left half, which alone is in collection "Tiles"."""
    scene = scene_parts.empty_scene(*SIZE)
    scene_parts.add_top_camera(6.5)
    scene_parts.add_area_light("Key", location=(0.3, 0.2, 2.5), rotation=(0.0, 0.0, 0.0))
    add_plane(diffuse("Floor", (0.5, 0.5, 0.5)), size=12.0, name="Floor")
    tile = add_plane(diffuse("Tile", (0.8, 0.1, 0.1)), size=2.0, name="Tile", location=(-1.5, 0.0, 0.1))
    collection = bpy.data.collections.new("Tiles")
    scene.collection.children.link(collection)
    scene.collection.objects.unlink(tile)
    collection.objects.link(tile)
    # A plain render has its shadow, which is left out here.
    tile.visible_shadow = tile.visible_diffuse = tile.visible_glossy = False
    scene.cycles.pixel_filter_type = "BOX"
    return scene


def layer_collection(scene):
    return scene.view_layers[0].layer_collection.children["Tiles"]


def plain_diffuse(folder, scene, samples=256):
    """Direct diffuse radiance (H, W, 3) of a plain render of the open file through its own pixel filter."""
    scene.render.engine, scene.cycles.samples, scene.cycles.use_denoising = "CYCLES", samples, False
    scene.cycles.use_adaptive_sampling = False
    layer = next(layer for layer in scene.view_layers if layer.use)
    enable_passes(layer, ("combined", "diffuse_direct", "diffuse_color"))
    render_exr(scene, folder / "plain.exr")
    layers = imaging.read_layers(folder / "plain.exr")
    old = bpy.app.version < (5, 0, 0)
    light, color = ("DiffDir", "DiffCol") if old else ("Diffuse Direct", "Diffuse Color")
    return layers[f"{layer.name}.{light}"] * layers[f"{layer.name}.{color}"]


def compared(folder, **options):
    """Report and layers of a comparison of the open file."""
    path = folder / "scene.blend"
    bpy.ops.wm.save_as_mainfile(filepath=str(path))
    given = {"techniques": ("ltc",), "cycles_samples": 128, "passes": ("diffuse",), **options}
    report = compare_scene(Options(path, folder / "out", **given))
    return report, imaging.read_layers(folder / "out" / "compare.exr")


def check_like_plain(folder, scene, **options):
    """All agree: technique, reference, and a plain render of the file; returns the report."""
    report, layers = compared(folder, **options)
    plain = plain_diffuse(folder, scene)
    for name in ("ltc.diffuse", "cycles.diffuse"):
        # The noise of 256 samples, and the mean over a pixel against its center; edges lie between pixels.
        assert np.linalg.norm(layers[name] - plain) < 0.02 * np.linalg.norm(plain), name
    return report, layers


def test_film_exposure_is_that_of_a_render(tmp_path):
    scene = tiles()
    plain, _ = compared(tmp_path)
    scene.cycles.film_exposure = 2.5
    report, layers = check_like_plain(tmp_path, scene)
    assert report["exposure"] == 2.5 and report["warnings"] == []
    # Errors are relative and the radiance of a light is that of the scene: neither knows of the film.
    assert report["lights"] == plain["lights"]
    errors = [found["passes"]["diffuse"]["techniques"]["ltc"]["against_cycles"]["bias"] for found in (plain, report)]
    assert abs(errors[0] - errors[1]) < 1e-5
    assert "film exposure 2.5" in (tmp_path / "out" / "report.html").read_text(encoding="utf-8")


def test_animated_film_exposure_is_taken_at_the_frame(tmp_path):
    scene = tiles()
    for frame, exposure in ((1, 1.0), (11, 2.0)):
        scene.cycles.film_exposure = exposure
        scene.keyframe_insert("cycles.film_exposure", frame=frame)
    scene.frame_set(1)
    assert compared(tmp_path, frame=11)[0]["exposure"] == 2.0


@pytest.mark.parametrize("setting", ["excluded", "indirect only", "holdout", "holdout object", "material override"])
def test_the_view_layer_shows_what_a_render_shows(tmp_path, setting):
    scene = tiles()
    layer = scene.view_layers[0]
    if setting == "excluded":
        layer_collection(scene).exclude = True
    elif setting == "indirect only":
        layer_collection(scene).indirect_only = True
    elif setting == "holdout":
        layer_collection(scene).holdout = True
    elif setting == "holdout object":
        bpy.data.objects["Tile"].is_holdout = True
    else:
        layer.material_override = diffuse("Override", (0.1, 0.9, 0.2))
    report, layers = check_like_plain(tmp_path, scene)
    tile = layers["ltc.diffuse"][8, 7], layers["coverage.hit"][8, 7]
    assert report["warnings"] == []
    if "holdout" in setting:
        assert not tile[0].any() and tile[1] == 0.0 and layers["coverage.hit"].sum() < 26 * 16 - 20
    else:
        green = setting == "material override"
        assert tile[1] == 1.0 and (tile[0][1] > 5.0 * tile[0][0]) == green and layers["coverage.hit"].all()


def test_a_transparent_film_changes_nothing(tmp_path):
    scene = tiles()
    bpy.data.objects["Floor"].location.x = 6.0
    _, opaque = compared(tmp_path)
    scene.render.film_transparent = True
    report, layers = compared(tmp_path)
    assert report["warnings"] == [] and 0.0 < layers["coverage.hit"].mean() < 1.0
    assert all(np.array_equal(layers[name], image) for name, image in opaque.items())


def test_settings_of_the_layer_and_of_the_scene_that_are_replaced(tmp_path):
    scene = tiles()
    _, expected = compared(tmp_path)
    layer = scene.view_layers[0]
    layer.samples, layer.use_pass_cryptomatte_object = 1, True
    layer.lightgroups.add(name="Key")
    user = layer.aovs.add()
    user.name, user.type = "ltsh_roughness", "COLOR"
    layer.world_override = world = bpy.data.worlds.new("Sky")
    world.color = (0.0, 1.0, 0.0)
    if bpy.app.version < (5, 0, 0):
        world.use_nodes = True
    background = next((node for node in world.node_tree.nodes if node.type == "BACKGROUND"), None)
    background = background or world.node_tree.nodes.new("ShaderNodeBackground")
    background.inputs["Strength"].default_value = 3.0
    report, layers = compared(tmp_path)
    assert len(report["warnings"]) == 1 and "world 'Sky'" in report["warnings"][0]
    assert all(np.array_equal(layers[name], image) for name, image in expected.items())


@pytest.mark.parametrize("effect", ["depth of field", "motion blur"])
def test_blur_is_switched_off_on_both_sides(tmp_path, effect):
    scene = tiles()
    _, expected = compared(tmp_path)
    if effect == "depth of field":
        scene.camera.data.dof.use_dof = True
        scene.camera.data.dof.focus_distance, scene.camera.data.dof.aperture_fstop = 1.0, 0.05
    else:
        tile = bpy.data.objects["Tile"]
        for frame in (1, 3):
            tile.location.x = -1.5 + (frame - 1.0)
            tile.keyframe_insert("location", frame=frame)
        scene.render.use_motion_blur, scene.render.motion_blur_shutter = True, 1.0
        scene.frame_set(1)
    report, layers = compared(tmp_path)
    assert len(report["warnings"]) == 1 and effect in report["warnings"][0]
    # The same samples; Cycles draws other ones for the lens or the time.
    assert np.array_equal(layers["ltc.diffuse"], expected["ltc.diffuse"])
    assert np.allclose(layers["cycles.diffuse"], expected["cycles.diffuse"], rtol=0.02, atol=1e-3)


def test_a_shadow_catcher_is_shaded_like_any_surface(tmp_path):
    scene = tiles()
    _, expected = compared(tmp_path)
    bpy.data.objects["Tile"].is_shadow_catcher = True
    assert scene.name
    report, layers = compared(tmp_path)
    assert len(report["warnings"]) == 1 and "'Tile': shadow catcher" in report["warnings"][0]
    assert all(np.array_equal(layers[name], image) for name, image in expected.items())


def test_steps_after_rendering_are_named(tmp_path):
    scene = tiles()
    _, expected = compared(tmp_path)
    scene.render.use_freestyle = True
    if bpy.app.version >= (5, 0, 0):
        scene.compositing_node_group = bpy.data.node_groups.new("Grade", "CompositorNodeTree")
    else:
        scene.use_nodes = True
    editor = scene.sequence_editor_create()
    editor.strips.new_effect(name="Black", type="COLOR", channel=1, frame_start=1, **_strip_end(editor, 10))
    report, layers = compared(tmp_path)
    for word in ("Freestyle", "compositing", "sequencer"):
        assert sum(word in line for line in report["warnings"]) == 1, report["warnings"]
    assert all(np.array_equal(layers[name], image) for name, image in expected.items())


def _strip_end(editor, frames):
    """The argument for a strip's end, whose name changed with 5.0."""
    known = editor.strips.bl_rna.functions["new_effect"].parameters.keys()
    return {"length": frames} if "length" in known else {"frame_end": 1 + frames}


def test_the_first_of_several_view_layers_in_use_is_shaded(tmp_path):
    scene = tiles()
    scene.view_layers[0].use = False
    second = scene.view_layers.new("Second")
    scene.view_layers.new("Third")
    second.layer_collection.children["Tiles"].exclude = True
    report, layers = compared(tmp_path)
    assert len(report["warnings"]) == 1 and "'Second' of 2" in report["warnings"][0]
    assert layers["ltc.diffuse"][8, 7].std() < 1e-6


# -- the pixel filter -------------------------------------------------------------------------------------------------

FILTERS = [("BOX", 4.0), ("GAUSSIAN", 1.0), ("BLACKMAN_HARRIS", 1.5), ("BLACKMAN_HARRIS", 3.0)]


@pytest.mark.parametrize(("kind", "width"), FILTERS)
def test_quantiles_invert_the_integral_of_the_density(kind, width):
    integrate = pytest.importorskip("scipy.integrate")
    half = pixel_filter.filter_density(kind, width, 0.0)[1]

    def density(x):
        return float(pixel_filter.filter_density(kind, width, x)[0])

    whole = integrate.quad(density, -half, half)[0]
    for share in (0.001, 0.2, 0.5, 0.77, 0.999):
        x = float(pixel_filter.filter_quantiles(kind, width, share))
        assert abs(integrate.quad(density, -half, x)[0] / whole - share) < 1e-6


def test_points_are_centers_for_one_and_have_the_spread_of_the_filter():
    assert np.array_equal(pixel_filter.filter_points("BLACKMAN_HARRIS", 1.5, 1), [[0.0, 0.0]])
    x = np.linspace(-3.0, 3.0, 6001)
    for kind, width in FILTERS:
        weight = pixel_filter.filter_density(kind, width, x)[0]
        spread = np.sqrt((weight * x**2).sum() / weight.sum())
        points = pixel_filter.filter_points(kind, width, 1024)
        assert np.abs(points.mean(axis=0)).max() < 0.01 * spread
        assert np.abs(points.std(axis=0) / spread - 1.0).max() < 0.01


def test_an_unknown_filter_is_refused():
    with pytest.raises(ValueError, match="pixel filter is 'MITCHELL'"):
        pixel_filter.filter_points("MITCHELL", 1.0, 4)


def stripes(kind, width):
    """A black floor with white bars, most edges slanted, under an even light; sees through the filter of `kind`."""
    scene = scene_parts.empty_scene(*SIZE)
    scene_parts.add_top_camera(6.5)
    scene_parts.add_area_light("Key", location=(0.0, 0.0, 6.0), rotation=(0.0, 0.0, 0.0), size=12.0, size_y=12.0)
    bpy.data.objects["Key"].visible_camera = False
    add_plane(diffuse("Black", (0.0, 0.0, 0.0)), size=20.0, name="Floor")
    for k in range(6):
        bar = add_plane(diffuse(f"White {k}", (1.0, 1.0, 1.0)), size=1.0, name=f"Bar {k}")
        bar.location, bar.rotation_euler, bar.scale = (k - 2.5, 0.0, 1e-4), (0.0, 0.0, 0.15 * k), (0.4, 3.0, 1.0)
    scene.camera.location.z = 7.0
    scene.cycles.pixel_filter_type, scene.cycles.filter_width = kind, width
    return scene


@pytest.mark.parametrize(("kind", "width"), FILTERS[:3])
def test_edges_are_those_of_a_plain_render(tmp_path, kind, width):
    scene = stripes(kind, width)
    count = 64
    path = tmp_path / "scene.blend"
    bpy.ops.wm.save_as_mainfile(filepath=str(path))
    errors = {}
    for name in (kind, "other"):
        if name == "other":
            scene.cycles.pixel_filter_type, scene.cycles.filter_width = "GAUSSIAN", 3.0
        found = extract(ExtractOptions(path, sub_samples=count))
        white = found.film.image(found.samples.diffuse_albedo)[..., 0]
        plain = plain_albedo(tmp_path, scene)
        errors[name] = np.abs(white - plain)
    assert white.min() == 0.0 and white.max() > 0.9 and ((white > 0.1) & (white < 0.9)).sum() > 60
    # The discrepancy of n points for half-planes is about n^(-3/4) (Beck 1987), and a pixel sees up to two edges. On
    # average they do three times better than random ones, whose standard deviation is 0.5 n^(-1/2).
    assert errors[kind].max() < 2.0 * count**-0.75 and errors[kind].mean() < 0.5 * count**-0.5 / 3.0
    assert errors["other"].max() > 2.0 * count**-0.75 and errors["other"].mean() > 0.5 * count**-0.5 / 3.0


def plain_albedo(folder, scene):
    """Diffuse color of a plain render of 1024 samples through the scene's filter."""
    scene.render.engine, scene.cycles.samples, scene.cycles.use_denoising = "CYCLES", 1024, False
    scene.cycles.use_adaptive_sampling = False
    enable_passes(scene.view_layers[0], ("combined", "diffuse_color"))
    render_exr(scene, folder / "plain.exr")
    layers = imaging.read_layers(folder / "plain.exr")
    color = "DiffCol" if bpy.app.version < (5, 0, 0) else "Diffuse Color"
    return layers[f"{scene.view_layers[0].name}.{color}"][..., 0]


def test_shaded_edges_are_those_of_a_plain_render_and_of_the_reference(tmp_path):
    """All the way: radiance with --aa 64 in the filter that files have by default."""
    scene = stripes("BLACKMAN_HARRIS", 1.5)
    report, layers = compared(tmp_path, sub_samples=64, cycles_samples=1024)
    assert report["pixel_filter"] == "BLACKMAN_HARRIS 1.5 px"
    plain = plain_diffuse(tmp_path, scene, samples=1024)
    peak = plain.max()
    for name in ("ltc.diffuse", "cycles.diffuse"):
        error = np.abs(layers[name] - plain) / peak
        # As above; the plain render has noise of its own, 0.5 / 1024^(1/2) where a pixel is half white.
        assert error.max() < 2.0 * 64**-0.75 + 0.016 and error.mean() < 0.5 * 64**-0.5 / 3.0
    # The very same points on both sides: what is left is noise.
    figures = report["passes"]["diffuse"]["techniques"]["ltc"]["against_cycles"]
    assert figures["unbiased_relative_error"] < 0.005
    assert np.abs(layers["ltc.diffuse"] - layers["cycles.diffuse"]).max() < 0.02 * peak


def test_the_filter_of_the_file_is_put_back(tmp_path):
    scene = tiles()
    scene.cycles.pixel_filter_type, scene.cycles.filter_width = "GAUSSIAN", 1.75
    with pytest.raises(child.SceneError):
        with pixel_filter.pinned_pixel_filter(scene):
            assert 0.0 < scene.cycles.filter_width < 1e-3
            raise child.SceneError("stopped")
    assert (scene.cycles.pixel_filter_type, scene.cycles.filter_width) == ("GAUSSIAN", 1.75)
