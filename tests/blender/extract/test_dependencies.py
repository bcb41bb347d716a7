"""What the bake of an object depends on: each change that changes a bake is noticed, and what changes none is not."""

from functools import partial

import bpy
import numpy as np
import pytest
import scene_parts
from bake_scenes import start
from material_scenes import Build
from scene_parts import add_plane, add_sphere, add_world, principled

from ltsh_addon import cli
from ltsh_addon.blender.evaluated import STEPS_OF_RENDERS, with_render_depsgraph
from ltsh_addon.blender.extract.dependencies import NotJudged, dependencies
from ltsh_addon.blender.process.bake import BakeFactsJob

NAMES = "Floor", "Ball"


@pytest.fixture
def room(tmp_path):
    """A floor with an image beside a ball with a pattern, a lamp and a world."""
    start()
    made = Build("Tiles")
    picture = bpy.data.images.new("Tiles", 4, 4)
    picture.filepath_raw, picture.file_format = str(tmp_path / "tiles.png"), "PNG"
    picture.save()
    picture.source = "FILE"
    picture.reload()
    image = made.new("ShaderNodeTexImage")
    image.image = picture
    tiles = made.shader("BsdfPrincipled", Roughness=0.5)
    made.link(image.outputs["Color"], tiles.node.inputs["Base Color"])
    made.show(tiles)
    add_plane(made.material, size=2.0, name="Floor")
    add_sphere(principled("Red", Roughness=0.4)[0], radius=0.3, name="Ball", location=(0.2, 0.1, 0.4), segments=12)
    bpy.data.objects.new("Empty", None)
    add_world(Color=(0.2, 0.3, 0.4, 1.0))
    return tmp_path


def digests(bounces="off", **settings):
    bpy.context.view_layer.update()
    job = BakeFactsJob(None, [None], NAMES, bounces=bounces, **settings)
    return with_render_depsgraph(bpy.context.scene, partial(dependencies, names=NAMES, job=job))


def node(material, kind="BSDF_PRINCIPLED"):
    return next(one for one in bpy.data.materials[material].node_tree.nodes if one.type == kind)


def set_pixels(path):
    image = bpy.data.images.new("other", 4, 4)
    image.pixels.foreach_set(np.full(64, 0.5, np.float32))
    image.filepath_raw, image.file_format = str(path / "tiles.png"), "PNG"
    image.save()


def link_light():
    group = bpy.data.collections.new("Lit")
    group.objects.link(bpy.data.objects["Ball"])
    bpy.data.objects["Key"].light_linking.receiver_collection = group


def add_modifier():
    bpy.data.objects["Ball"].modifiers.new("Thick", "DISPLACE").strength = 0.01


def animate():
    light = bpy.data.objects["Key"].data
    for frame, power in ((1, light.energy), (10, 3.0)):
        light.energy = power
        light.keyframe_insert("energy", frame=frame)
    bpy.context.scene.frame_set(5)


# Changes that matter to both objects, whether light bounces or not.
OF_ALL = {
    "power": lambda path: setattr(bpy.data.objects["Key"].data, "energy", 11.0),
    "size of a light": lambda path: setattr(bpy.data.objects["Key"].data, "size", 0.3),
    "specular factor": lambda path: setattr(bpy.data.objects["Key"].data, "specular_factor", 0.5),
    "place": lambda path: setattr(bpy.data.objects["Ball"].location, "x", 0.21),
    "point": lambda path: setattr(bpy.data.objects["Ball"].data.vertices[3].co, "x", 0.11),
    "smooth": lambda path: bpy.data.objects["Ball"].data.shade_flat(),
    "UV map": lambda path: setattr(bpy.data.objects["Floor"].data.uv_layers[0].uv[0].vector, "x", 0.1),
    "world": lambda path: setattr(bpy.data.worlds[0].node_tree.nodes["Background"].inputs[1], "default_value", 2.0),
    "no shadow": lambda path: setattr(bpy.data.objects["Ball"], "visible_shadow", False),
    "hidden": lambda path: setattr(bpy.data.objects["Ball"], "hide_render", True),
    "camera": lambda path: setattr(bpy.data.objects["Camera"].location, "x", 0.3),
    "bounces of Cycles": lambda path: setattr(bpy.context.scene.cycles, "max_bounces", 3),
    "linking": lambda path: link_light(),
    "modifier": lambda path: add_modifier(),
    "animation": lambda path: animate(),
    "light that goes through": lambda path: setattr(node("Red").inputs["Alpha"], "default_value", 0.5),
    "glow": lambda path: setattr(node("Red").inputs["Emission Strength"], "default_value", 1.0),
    "another object": lambda path: add_plane(name="Wall"),
    "custom property": lambda path: bpy.data.objects["Ball"].__setitem__("tint", [0.1, 0.2]),
}
# Changes of one object's material: others notice them where light bounces.
OF_FLOOR = {
    "pixels": set_pixels,
    "color space": lambda path: setattr(bpy.data.images["Tiles"].colorspace_settings, "name", "Non-Color"),
    "roughness": lambda path: setattr(node("Tiles").inputs["Roughness"], "default_value", 0.6),
    "interpolation": lambda path: setattr(node("Tiles", "TEX_IMAGE"), "interpolation", "Closest"),
}
# Changes that change no texel.
OF_NONE = {
    "selection": lambda path: bpy.data.objects["Ball"].select_set(False),
    "samples": lambda path: setattr(bpy.context.scene.cycles, "samples", 77),
    "viewport": lambda path: setattr(bpy.data.objects["Ball"], "hide_viewport", False),
    "place of a node": lambda path: setattr(node("Red"), "location", (10.0, 10.0)),
    "check mark": lambda path: setattr(bpy.data.objects["Ball"], "show_name", True),
    "material of no object": lambda path: principled("Unused"),
}


@pytest.mark.parametrize("change", [*OF_ALL, *OF_FLOOR, *OF_NONE])
def test_a_change_is_noticed_by_the_objects_that_it_changes(room, change):
    before = {bounces: digests(bounces) for bounces in ("off", "on")}
    assert before == {bounces: digests(bounces) for bounces in before}
    (OF_ALL | OF_FLOOR | OF_NONE)[change](room)
    expected = {"off": {"Floor"}, "on": set(NAMES)} if change in OF_FLOOR else dict.fromkeys(before, set(NAMES))
    for bounces, digest in before.items():
        after = digests(bounces)
        changed = {name for name in NAMES if after[name] != digest[name]}
        assert changed == (set() if change in OF_NONE else expected[bounces]), bounces


def test_a_moved_camera_is_noticed_by_materials_that_read_it(room):
    """Seen from above, where the view is not the camera's."""
    tree = bpy.data.materials["Red"].node_tree
    place = tree.nodes.new("ShaderNodeTexCoord")
    tree.links.new(place.outputs["Window"], node("Red").inputs["Base Color"])
    before = digests(view="above")
    bpy.context.scene.camera.location.x += 0.1
    after = digests(view="above")
    assert after["Floor"] == before["Floor"] and after["Ball"] != before["Ball"]


def bake(path, *arguments):
    """What the command line tells, and the objects that it baked."""
    words = ["--object", "Floor", "--object", "Ball", "--view", "above", "--size", "64", "--resume", *arguments]
    assert cli.main(["bake", str(path), "-o", str(path.parent / "out"), *words]) == 0


def written(path):
    return {name: (path / "out" / f"{name}.exr").stat().st_mtime_ns for name in NAMES}


def test_a_second_bake_does_what_changed_and_tells_what_not(room, capsys):
    path = scene_parts.save(room / "scene.blend")
    bake(path)
    before = written(room)
    assert "unchanged" not in capsys.readouterr().err
    bpy.data.objects["Floor"].select_set(False)
    # Another file of the same scene, as the panel saves one for each job.
    path = scene_parts.save(room / "again.blend")
    bake(path)
    assert written(room) == before
    assert "unchanged, not baked again: Floor, Ball; without --resume all are" in capsys.readouterr().err
    node("Red").inputs["Roughness"].default_value = 0.9
    bake(scene_parts.save(path))
    assert "unchanged, not baked again: Floor;" in capsys.readouterr().err
    after = written(room)
    assert after["Floor"] == before["Floor"] and after["Ball"] != before["Ball"]
    (room / "out" / "Floor.exr").write_bytes(b"spoiled")
    bake(path)
    assert "unchanged, not baked again: Ball;" in capsys.readouterr().err


def test_what_cannot_be_judged_is_baked(room, capsys):
    bpy.data.objects["Floor"].modifiers.new("Hair", "PARTICLE_SYSTEM")
    bpy.data.particles[0].type, bpy.data.particles[0].count = "HAIR", 3
    with pytest.raises(NotJudged, match="'Floor' has hair particles"):
        digests()
    path = scene_parts.save(room / "scene.blend")
    bake(path)
    before = written(room)
    bake(path)
    assert written(room) == before  # the same file
    bake(scene_parts.save(room / "again.blend"))
    assert "'Floor' has hair particles: all objects are baked again, unless" in capsys.readouterr().err
    assert not {*written(room).values()} & {*before.values()}


def test_steps_after_a_render_do_not_run_where_a_scene_is_only_evaluated(room):
    """Freestyle that finds no lines ends Blender; a compositor may write files."""
    render = bpy.context.scene.render
    render.use_freestyle = True
    before = [getattr(render, name) for name in STEPS_OF_RENDERS]
    bake(scene_parts.save(room / "lines.blend"))
    digests()
    assert [getattr(render, name) for name in STEPS_OF_RENDERS] == before
