"""What the interface says is what is so: no state has a second copy that undo, saving or other results leave behind."""

import os

import bpy
import numpy as np
import pytest
import recorded_layout
import scene_parts as parts
from scene_parts import principled

from ltsh_addon.blender.ui import comparison, panels, preflight, results
from ltsh_addon.blender.viewport import live_cycles


def test_a_picture_is_not_compared_with_itself_after_one_that_was_alone(scene, tmp_path, show_results):
    show_results(scene, tmp_path, names=("ltsh4c",))
    show_results(scene, tmp_path, seed=2, names=("ltsh4c", "cycles"))
    for first, second in (("ltsh4c", "cycles"), ("cycles", "ltsh4c")):
        scene.ltsh.first = scene.ltsh.second = first
        choice = results.choice_of(scene.ltsh, results.result_of(scene))
        assert (choice.first, choice.second) == (first, second)


@pytest.mark.parametrize(
    ("names", "pressed"),
    [
        (("ltc", "ltsh4"), ["Wipe", "LTSH 4", "LTC", "Combined"]),
        (("ltsh4c",), ["Single", "LTSH 4c", "Combined"]),
        (("ltsh2", "cycles"), ["Wipe", "LTSH 2", "Cycles", "Combined"]),
    ],
)
def test_the_pressed_buttons_are_those_of_the_pictures_that_are_shown(scene, tmp_path, show_results, names, pressed):
    scene.ltsh.first, scene.ltsh.second, scene.ltsh.mode = "ltsh4", "cycles", "WIPE"
    show_results(scene, tmp_path, names=names, partial="Not complete: without Cycles")
    shown = recorded_layout.drawn(panels.LTSH_PT_IMAGE_results)
    assert [entry.text for entry in shown if entry.what == "ltsh.choose" and entry.pressed] == pressed
    bpy.ops.ltsh.choose(key="pass_name", value="diffuse")
    assert scene.ltsh.pass_name == "diffuse"


def test_materials_have_the_sign_of_what_the_view_says(scene):
    material, shader = principled("Rough")
    noise = material.node_tree.nodes.new("ShaderNodeTexNoise")
    material.node_tree.links.new(noise.outputs[0], shader.inputs["Roughness"])
    parts.add_plane(material, name="Rough plane")
    bpy.context.view_layer.update()
    scene.render.engine = "BLENDER_WORKBENCH"
    entry = next(one for one in preflight.overview(scene).materials if one.name == "Rough")
    assert entry.state == preflight.EXACT
    scene.render.engine = "LTSH"
    entry = next(one for one in preflight.overview(scene).materials if one.name == "Rough")
    assert entry.state == preflight.EXACT, "bounces show it as Cycles does"
    # Passes alone have no bounces, nor has a picture beside that of Cycles.
    for name, value in (("shown", "diffuse"), ("bounces", False), ("mode", "split")):
        view, before = scene.ltsh_view, getattr(scene.ltsh_view, name)
        setattr(view, name, value)
        view.second_technique = "cycles" if name == "mode" else "ltc"
        entry = next(one for one in preflight.overview(scene).materials if one.name == "Rough")
        assert entry.state == preflight.APPROXIMATED
        assert "in the view: Roughness is not resolved, 0.4 is shown" in entry.notes
        setattr(view, name, before)


@pytest.mark.parametrize(
    ("metallic", "roughness", "is_black"), [(1.0, 0.05, True), (1.0, 0.5, False), (0.0, 0.05, False)]
)
def test_materials_name_chrome_which_views_draw_black(scene, metallic, roughness, is_black):
    material, shader = principled("Chrome")
    shader.inputs["Metallic"].default_value, shader.inputs["Roughness"].default_value = metallic, roughness
    parts.add_plane(material, name="Chrome plane")
    bpy.context.view_layer.update()
    for engine, bounces in (("BLENDER_WORKBENCH", False), ("LTSH", False), ("LTSH", True)):
        scene.render.engine, scene.ltsh_view.bounces = engine, bounces
        (entry,) = [one for one in preflight.overview(scene).materials if one.name == "Chrome"]
        is_named = is_black and engine == "LTSH" and not bounces
        assert any("it reflects lights" in note for note in entry.notes) == is_named


def test_the_eye_of_a_light_is_the_one_that_h_closes(scene):
    light = bpy.data.objects["Light"]
    light.hide_set(True)
    assert light.ltsh_light.mute and not light.hide_render
    light.ltsh_light.mute = False
    assert not light.hide_get() and not light.ltsh_light.mute
    light.hide_viewport = True
    assert light.ltsh_light.mute


@pytest.mark.parametrize("elsewhere", ["saved first", "saved as"])
def test_saving_elsewhere_keeps_all_results(scene, tmp_path, show_results, elsewhere):
    if elsewhere == "saved first":
        scene.ltsh.output_folder = ""
    show_results(scene, tmp_path)
    other = tmp_path / "other"
    other.mkdir()
    bpy.ops.wm.save_as_mainfile(filepath=str(other / "renamed.blend"))
    scene = bpy.context.scene
    assert results.result_of(scene) is not None
    assert panels.operators.last_folder(scene, "compare") == results.result_of(scene).folder
    bpy.ops.wm.open_mainfile(filepath=str(other / "renamed.blend"))
    assert results.result_of(bpy.context.scene).folder.resolve() == (tmp_path / "ltsh" / "compare" / "images")


def test_without_a_light_none_is_to_be_clicked(scene):
    lights = [ob for ob in scene.objects if ob.type == "LIGHT"]
    panel = next(kind for kind in panels.CLASSES if kind.__name__ == "LTSH_PT_VIEW3D_lights")
    assert lights and "Click a light" in recorded_layout.texts(recorded_layout.drawn(panel))
    for light in lights:
        bpy.data.objects.remove(light)
    texts = recorded_layout.texts(recorded_layout.drawn(panel))
    assert "Click a light" not in texts and "No light in the scene" in texts


def test_files_are_saved_without_pictures(scene, tmp_path, show_results):
    show_results(scene, tmp_path)
    assert len(results.our_images(scene)) > 3
    path = parts.save(tmp_path / "copy.blend", copy=True)
    with bpy.data.libraries.load(str(path)) as (there, _):
        names = [name for name in there.images if name.startswith(results.PREFIX)]
    assert names == []
    # They are there after undo, too.
    for message in ("Before", "Something"):
        bpy.ops.ed.undo_push(message=message)
    bpy.ops.ed.undo()
    comparison.refresh(bpy.context.scene)
    assert comparison.viewer_image(bpy.context.scene).size[0] > 4


def test_views_of_one_world_look_at_it_once(monkeypatch):
    parts.empty_scene(8, 8)
    world, begun = parts.add_world()[0], []
    sky = live_cycles.ShownSky()
    monkeypatch.setattr(live_cycles, "REST_SECONDS", -1.0)
    monkeypatch.setattr(live_cycles, "_world_looks", type(live_cycles._world_looks)())
    monkeypatch.setattr(live_cycles._WorldLook, "_begin", lambda look, frame: begun.append(look) or found(look))

    def found(look):
        look.changed, look.outcome, look.sky = None, (sky, ["a note"]), sky

    first, second = live_cycles.LiveWorld(), live_cycles.LiveWorld()
    assert first.look(world) is None and second.look(world) is None
    assert first.step(1) == (sky, ["a note"]) == second.step(1) and len(begun) == 1
    assert not first.is_busy and not second.is_busy and first.step(1) is None
    late = live_cycles.LiveWorld()
    assert late.look(world) is sky and late.step(1) == (sky, ["a note"]) and len(begun) == 1
    # A change is looked at again, for all.
    first.look(world)
    assert first.step(1) == second.step(1) == (sky, ["a note"]) and len(begun) == 2
    for live in (first, second, late):
        live.stop()
    assert not live_cycles._world_looks


@pytest.mark.parametrize("change", ["nothing", "strength", "visibility", "image", "painted image", "failed"])
def test_the_next_view_of_a_world_that_has_not_changed_need_not_look_at_it(monkeypatch, tmp_path, change):
    parts.empty_scene(8, 8)
    world, begun, sky = parts.add_world()[0], [], live_cycles.ShownSky()
    texture = world.node_tree.nodes.new("ShaderNodeTexEnvironment")
    image = texture.image = bpy.data.images.new("sky", 4, 2)
    image.filepath_raw, image.file_format = str(tmp_path / "sky.png"), "PNG"
    image.save()
    image.source = "FILE"
    shine = world.node_tree.nodes["Background"]
    world.node_tree.links.new(texture.outputs["Color"], shine.inputs["Color"])
    monkeypatch.setattr(live_cycles, "REST_SECONDS", -1.0)
    monkeypatch.setattr(live_cycles, "_world_looks", {})
    monkeypatch.setattr(live_cycles._WorldLook, "_begin", lambda look, frame: begun.append(look) or found(look))

    def found(look):
        look.changed, look.outcome, look.sky = None, (sky, []), sky
        look.state = live_cycles._state_of_world(world)

    first = live_cycles.LiveWorld()
    assert first.look(world) is None and first.step(1) == (sky, []) and len(begun) == 1
    first.stop()
    if change == "strength":
        shine.inputs["Strength"].default_value = 2.0
    elif change == "visibility":
        world.cycles_visibility.glossy = False
    elif change == "image":
        os.utime(tmp_path / "sky.png", (1, 1))
    elif change == "painted image":
        image.pixels[0] = 0.5
    elif change == "failed":
        live_cycles._world_looks.clear()
        third = live_cycles.LiveWorld()
        third.look(world)
        third.step(1)
        third._look.outcome, third._look.sky = (None, ["no Blender"]), None
        third.stop()
        begun.pop()
    second = live_cycles.LiveWorld()
    assert (second.look(world) is sky) == (change == "nothing")
    assert second.step(1) == (sky, []) and len(begun) == (1 if change == "nothing" else 2)
    second.stop()


def test_a_final_render_and_other_results_leave_the_mix(scene, tmp_path, show_results):
    show_results(scene, tmp_path)
    bpy.ops.ltsh.choose(key="mode", value="SIDE")
    bpy.ops.ltsh.choose(key="mode", value="MIX")
    assert results.choice_of(scene.ltsh, results.result_of(scene)).mode == "SIDE"
    show_results(scene, tmp_path, seed=2)
    assert scene.ltsh.mode == "SIDE"
    image = comparison.viewer_image(scene)
    assert np.array(image.size).tolist() == [20, 6]
