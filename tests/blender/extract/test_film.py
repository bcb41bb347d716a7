"""Film, view layer and collections: what a plain render shows is shown, or is switched off with a warning."""

import bpy
import numpy as np
import pytest
from film_scenes import check_like_plain, compared, diffuse, tiles


def test_film_exposure_is_that_of_a_render(tmp_path):
    scene = tiles()
    plain, _ = compared(tmp_path)
    scene.cycles.film_exposure = 2.5
    report, layers = check_like_plain(tmp_path)
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


@pytest.mark.parametrize("setting", ["exclude", "indirect_only", "holdout", "holdout object", "material override"])
def test_the_view_layer_shows_what_a_render_shows(tmp_path, setting):
    scene = tiles()
    layer = scene.view_layers[0]
    if setting == "holdout object":
        bpy.data.objects["Tile"].is_holdout = True
    elif setting == "material override":
        layer.material_override = diffuse("Override", (0.1, 0.9, 0.2))
    else:
        setattr(layer.layer_collection.children["Tiles"], setting, True)
    report, layers = check_like_plain(tmp_path)
    tile = layers["ltc.diffuse"][8, 7], layers["coverage.hit"][8, 7]
    assert report["warnings"] == []
    if "holdout" in setting:
        assert not tile[0].any() and tile[1] == 0.0 and layers["coverage.hit"].sum() < 26 * 16 - 20
    else:
        green = setting == "material override"
        assert tile[1] == 1.0 and (tile[0][1] > 5.0 * tile[0][0]) == green and layers["coverage.hit"].all()


def transparent_film(scene):
    scene.render.film_transparent = True


def settings_of_the_layer(scene):
    layer = scene.view_layers[0]
    layer.samples, layer.use_pass_cryptomatte_object = 1, True
    layer.lightgroups.add(name="Key")
    user = layer.aovs.add()
    user.name, user.type = "ltsh_roughness", "COLOR"


def shadow_catcher(scene):
    bpy.data.objects["Tile"].is_shadow_catcher = True


def steps_after_rendering(scene):
    scene.render.use_freestyle = True
    if bpy.app.version >= (5, 0, 0):
        scene.compositing_node_group = bpy.data.node_groups.new("Grade", "CompositorNodeTree")
    else:
        scene.use_nodes = True
    strips = scene.sequence_editor_create().strips
    # The argument for a strip's end changed with 5.0.
    known = strips.bl_rna.functions["new_effect"].parameters.keys()
    end = {"length": 10} if "length" in known else {"frame_end": 11}
    strips.new_effect(name="Black", type="COLOR", channel=1, frame_start=1, **end)


@pytest.mark.parametrize(
    ("change", "named"),
    [
        (transparent_film, ()),
        (settings_of_the_layer, ()),
        (shadow_catcher, ("'Tile': shadow catcher",)),
        (steps_after_rendering, ("Freestyle", "compositing", "sequencer")),
    ],
)
def test_what_is_left_out_changes_nothing_and_is_named(tmp_path, change, named):
    scene = tiles()
    bpy.data.objects["Floor"].location.x = 6.0
    _, expected = compared(tmp_path)
    change(scene)
    report, layers = compared(tmp_path)
    assert all(np.array_equal(layers[name], image) for name, image in expected.items())
    assert 0.0 < layers["coverage.hit"].mean() < 1.0 and len(report["warnings"]) == len(named)
    for word in named:
        assert sum(word in line for line in report["warnings"]) == 1, report["warnings"]


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


def test_the_first_of_several_view_layers_in_use_is_shaded(tmp_path):
    scene = tiles()
    scene.view_layers[0].use = False
    second = scene.view_layers.new("Second")
    scene.view_layers.new("Third")
    second.layer_collection.children["Tiles"].exclude = True
    report, layers = compared(tmp_path)
    assert len(report["warnings"]) == 1 and "'Second' of 2" in report["warnings"][0]
    assert layers["ltc.diffuse"][8, 7].std() < 1e-6
