"""Nothing of the user's changes: not the open file, not the file on disk, whatever happens in between."""

import bpy
import datablock_hash
import pytest
import scene_parts

from ltsh_addon import cli
from ltsh_addon.blender.process import blender_process
from ltsh_addon.pipeline import PictureOptions, compare_scene, shade_scene
from ltsh_addon.scene import Cancelled


def rich_file(folder):
    """A saved file with something of many kinds, opened again as a user has it."""
    scene = scene_parts.empty_scene(32, 20)
    material, node = scene_parts.principled("Ball", Roughness=0.4, Metallic=1.0)
    scene_parts.add_bump(material.node_tree, node)
    ball = scene_parts.add_sphere(material, segments=8, name="Ball")
    ball["note"] = {"nested": [1.0, 2.0], "word": "text"}
    ball.modifiers.new("Bevel", "BEVEL").width = 0.02
    group = ball.vertex_groups.new(name="Top")
    group.add([0, 1], 0.5, "REPLACE")
    ball.shape_key_add(name="Basis")
    bpy.data.materials.new("Fake").use_fake_user = True
    catcher = scene_parts.add_plane(scene_parts.principled("Floor")[0], name="Catcher")
    catcher.is_shadow_catcher = True
    scene_parts.add_area_light("Key")
    scene_parts.link(scene_parts.new_light("Bulb", "POINT"), (1.0, 0.0, 2.0))
    camera = scene_parts.add_camera()
    camera.data.dof.use_dof = True
    camera.keyframe_insert("location", frame=1)
    camera.data.driver_add("lens").driver.expression = "40 + frame"
    collection = bpy.data.collections.new("Props")
    scene.collection.children.link(collection)
    collection.objects.link(ball)
    scene.view_layers.new("Second").layer_collection.children["Props"].holdout = True
    scene.timeline_markers.new("Cut", frame=4).camera = camera
    scene.render.use_border, scene.render.border_max_x, scene.render.use_motion_blur = True, 0.8, True
    scene.cycles.pixel_filter_type, scene.cycles.film_exposure = "GAUSSIAN", 0.7
    scene.world = bpy.data.worlds.new("Sky")
    image = bpy.data.images.new("Painted", 4, 4)
    image.pixels[5], image.use_fake_user = 0.25, True
    image.pack()
    bpy.data.texts.new("Notes").write("keep me")
    path = scene_parts.save(folder / "room.blend")
    bpy.ops.wm.open_mainfile(filepath=str(path))
    return path


def stop_at(stage):
    return lambda now, fraction: now != stage


def fail_at(stage):
    def progress(now, fraction):
        if now == stage:
            raise RuntimeError("the user interface is gone")

    return progress


def options(path, **changes):
    given = {"techniques": ("ltc",), "cycles_samples": 4, "sub_samples": 2, **changes}
    return PictureOptions(path, path.with_name("out"), **given)


def run_command(path):
    code = cli.main(["compare", "-o", str(path.with_name("out")), "--techniques", "ltc", "--cycles-samples", "4",
                     "--frame", "3", "--resolution", "20x12", "--quiet", "--json"], open_file=str(path))  # fmt: skip
    assert code == 0


OPERATIONS = {
    "shade": (lambda path: shade_scene(options(path)), None),
    "compare": (lambda path: compare_scene(options(path)), None),
    "another frame and size": (lambda path: shade_scene(options(path, frame=9, resolution=(20, 12))), None),
    "command line": (run_command, None),
    "cancelled while it samples": (lambda path: compare_scene(options(path), stop_at("samples")), Cancelled),
    "cancelled in Cycles": (lambda path: compare_scene(options(path), stop_at("Cycles B")), Cancelled),
    "cancelled while it shades": (lambda path: compare_scene(options(path), stop_at("LTC")), Cancelled),
    "cancelled before it writes": (lambda path: compare_scene(options(path), stop_at("write")), Cancelled),
    "an exception in the middle": (lambda path: compare_scene(options(path), fail_at("Cycles A")), RuntimeError),
    "an unknown camera": (lambda path: shade_scene(options(path, camera="Nobody")), blender_process.SceneError),
}


@pytest.mark.parametrize("name", OPERATIONS)
def test_the_session_and_the_file_stay_as_they_are(tmp_path, capsys, name):
    operation, error = OPERATIONS[name]
    path = rich_file(tmp_path)
    before, content, time = datablock_hash.session_state(), path.read_bytes(), path.stat().st_mtime_ns
    if error is None:
        operation(path)
    else:
        with pytest.raises(error):
            operation(path)
    capsys.readouterr()
    assert datablock_hash.session_state() == before
    assert (path.read_bytes(), path.stat().st_mtime_ns) == (content, time)
    assert {entry.name for entry in tmp_path.iterdir()} <= {path.name, "out"}


def test_unsaved_changes_stay_in_the_session_and_out_of_the_result(tmp_path):
    path = rich_file(tmp_path)
    bpy.data.objects["Key"].data.energy = 1234.0
    before = datablock_hash.session_state()
    report = shade_scene(options(path))
    assert datablock_hash.session_state() == before
    scale = bpy.data.objects["Key"].data.energy / 100.0
    saved = shade_scene(options(path))["lights"][0]["radiance"]
    assert report["lights"][0]["radiance"] == saved and scale > 10.0


def nodes(name):
    return bpy.data.materials[name].node_tree


CHANGES = {
    "a vertex": lambda: setattr(bpy.data.objects["Ball"].data.vertices[3].co, "x", 5.0),
    "a custom property": lambda: bpy.data.objects["Ball"]["note"].update({"word": "other"}),
    "a modifier": lambda: setattr(bpy.data.objects["Ball"].modifiers[0], "width", 0.03),
    "a vertex group": lambda: bpy.data.objects["Ball"].vertex_groups["Top"].add([2], 0.1, "REPLACE"),
    "a shape key": lambda: setattr(bpy.data.shape_keys[0].key_blocks[0].data[1].co, "z", 3.0),
    "a socket": lambda: nodes("Ball").nodes["Principled BSDF"].inputs["Roughness"].__setattr__("default_value", 0.41),
    "a link": lambda: nodes("Ball").links.remove(nodes("Ball").links[0]),
    "a node": lambda: nodes("Floor").nodes.new("ShaderNodeMath"),
    "a node's place": lambda: setattr(nodes("Floor").nodes[0], "location", (7.0, 8.0)),
    "a material slot": lambda: bpy.data.objects["Catcher"].data.materials.append(None),
    "a keyframe": lambda: setattr(bpy.data.actions[0].layers[0].strips[0].channelbags[0].fcurves[0]
                                  .keyframe_points[0].co, "y", 9.0),
    "a driver": lambda: setattr(bpy.data.cameras[0].animation_data.drivers[0].driver, "expression", "41"),
    "membership": lambda: bpy.data.collections["Props"].objects.unlink(bpy.data.objects["Ball"]),
    "an excluded collection": lambda: setattr(
        bpy.context.scene.view_layers["Second"].layer_collection.children["Props"], "exclude", True),
    "a pass": lambda: setattr(bpy.context.scene.view_layers["Second"], "use_pass_z", True),
    "a render setting": lambda: setattr(bpy.context.scene.render, "filepath", "/elsewhere"),
    "a Cycles setting": lambda: setattr(bpy.context.scene.cycles, "samples", 77),
    "a setting past its limits": lambda: _past_limits(bpy.context.scene.cycles),
    "the frame": lambda: setattr(bpy.context.scene, "frame_current", 2),
    "the camera": lambda: setattr(bpy.context.scene, "camera", None),
    "a marker": lambda: setattr(bpy.context.scene.timeline_markers[0], "camera", None),
    "a visibility": lambda: setattr(bpy.data.objects["Ball"], "visible_shadow", False),
    "a catcher": lambda: setattr(bpy.data.objects["Catcher"], "is_shadow_catcher", False),
    "a place": lambda: setattr(bpy.data.objects["Ball"].location, "y", 0.001),
    "a light": lambda: setattr(bpy.data.lights["Key"], "energy", 101.0),
    "a world": lambda: setattr(bpy.data.worlds["Sky"], "color", (0.1, 0.2, 0.3)),
    "a text": lambda: bpy.data.texts["Notes"].write("more"),
    "a picture": lambda: bpy.data.images["Painted"].pixels.__setitem__(9, 0.5),
    "a fake user": lambda: setattr(bpy.data.materials["Fake"], "use_fake_user", False),
    "a datablock more": lambda: bpy.data.materials.new("Another"),
    "a name": lambda: setattr(bpy.data.objects["Ball"], "name", "Bowl"),
    "a scene more": lambda: bpy.data.scenes.new("Second scene"),
}  # fmt: skip


def _past_limits(cycles):
    """As the pixel filter is pinned in the child."""
    stored = cycles.bl_system_properties_get(do_create=True) if bpy.app.version >= (5, 0, 0) else cycles
    stored["filter_width"] = 1e-6


def test_every_kind_of_change_shows_and_opening_again_is_none(tmp_path):
    path = rich_file(tmp_path)
    first = datablock_hash.session_state()
    assert datablock_hash.session_state() == first
    bpy.ops.wm.open_mainfile(filepath=str(path))
    assert datablock_hash.session_state() == first
    unseen = []
    for name, change in CHANGES.items():
        bpy.ops.wm.open_mainfile(filepath=str(path))
        before = datablock_hash.fingerprints()
        change()
        if datablock_hash.fingerprints() == before:
            unseen.append(name)
    assert not unseen
