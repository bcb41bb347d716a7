"""What stands in the way of a job is told before the click, and the buttons beside it mend it."""

from pathlib import Path

import bpy
import numpy as np
import pytest
import scene_parts as parts

from ltsh_addon.blender.ui import job, preflight

COMMANDS = ("shade", "compare", "bake")


@pytest.fixture
def scene(scene):
    """Everything can be done with it; its floor is selected."""
    bpy.data.objects["Floor"].select_set(True)
    return scene


def problems(command):
    return preflight.problems(bpy.context, command)


def mend(problem):
    """Click the button beside the problem."""
    module, _, name = problem.fix.partition(".")
    kind = getattr(bpy.types, f"LTSH_OT_{name}", None) if module == "ltsh" else None
    if kind is not None:
        # Undo is one step: Blender takes one after the operator, which takes none itself.
        assert {"REGISTER", "UNDO"} <= kind.bl_options, problem.fix
    assert getattr(getattr(bpy.ops, module), name)(**problem.fix_values) == {"FINISHED"}


def data_of(name):
    return bpy.data.objects[name].data


def remove(name):
    bpy.data.objects.remove(bpy.data.objects[name])


def remove_uv_map():
    data_of("Floor").uv_layers.remove(data_of("Floor").uv_layers[0])


def make_camera_an_empty():
    bpy.context.scene.camera = parts.link(bpy.data.objects.new("Target", None))


PANORAMIC = "Camera 'Camera' is panoramic, expected perspective or orthographic"
MENDED = [
    (lambda: remove("Camera"), COMMANDS, "The scene has no active camera"),
    (make_camera_an_empty, COMMANDS, "The scene has no active camera"),
    (lambda: setattr(data_of("Camera"), "type", "PANO"), COMMANDS, PANORAMIC),
    (lambda: setattr(bpy.data.objects["Light"], "hide_render", True), COMMANDS,
     "Light 'Light' is hidden in renders, and no other light is there"),
    (lambda: remove("Light"), COMMANDS, "No light"),
    (remove_uv_map, ("bake",), "Object 'Floor' has no UV map"),
    (lambda: setattr(bpy.data.objects["Floor"], "hide_render", True), ("bake",),
     "Object 'Floor' is hidden in renders"),
]  # fmt: skip


@pytest.mark.parametrize(("spoil", "commands", "text"), MENDED)
def test_what_can_be_mended_is_mended_by_one_click(scene, spoil, commands, text):
    spoil()
    for command in commands:
        (problem,) = problems(command)
        assert problem.text == text and problem.blocks and problem.fix and problem.fix_label
        with pytest.raises(RuntimeError, match="Error: " + text.split(",")[0]):
            getattr(bpy.ops.ltsh, command)()
    selected = list(bpy.context.selected_objects)
    mend(problem)
    for command in COMMANDS:
        assert problems(command) == [] and preflight.blocking(bpy.context, command) == "", command
    assert bpy.context.selected_objects == selected and bpy.context.mode == "OBJECT"


@pytest.mark.parametrize(("name", "command"), [("Floor", "bake"), ("Light", "shade")])
def test_what_stands_in_a_collection_that_renders_do_not_show_is_named(scene, name, command):
    ob, collection = bpy.data.objects[name], bpy.data.collections.new("Drafts")
    above = bpy.data.collections.new("Above")
    scene.collection.children.link(above)
    above.children.link(collection)
    for one in ob.users_collection:
        one.objects.unlink(ob)
    collection.objects.link(ob)
    ob.select_set(True)
    assert problems(command) == []
    above.hide_render = True
    (problem,) = problems(command)
    text = f"{'Light' if name == 'Light' else 'Object'} {name!r} is in a collection that renders do not show"
    assert problem.blocks and problem.text.startswith(text)


def test_what_a_large_bake_takes_is_told_before_it_starts(scene):
    settings = scene.ltsh
    settings.bake_size, settings.bake_bounces, settings.bake_per_light = "4096", True, True
    memory, lights = problems("bake")
    assert not memory.blocks and "GiB of memory" in memory.text
    assert not lights.blocks and lights.text.startswith("1 light: bounces take 1 times as long")
    settings.bake_size, settings.bake_per_light = "1024", False
    assert problems("bake") == []


def test_unwrapping_gives_every_face_a_place_in_the_square(scene):
    remove_uv_map()
    sphere = parts.add_sphere(name="Ball", segments=8)
    sphere.data.uv_layers.remove(sphere.data.uv_layers[0])
    mend(next(problem for problem in problems("bake") if "'Ball'" in problem.text))
    uv = np.empty(2 * len(sphere.data.loops), np.float32)
    sphere.data.uv_layers[0].data.foreach_get("uv", uv)
    assert 0.0 <= uv.min() < 0.1 and 0.9 < uv.max() <= 1.0
    assert not data_of("Floor").uv_layers


def select_linked():
    library = bpy.path.abspath("//library.blend")
    bpy.data.libraries.write(library, {bpy.data.objects["Floor"]})
    with bpy.data.libraries.load(library, link=True) as (_, wanted):
        wanted.objects = ["Floor"]
    bpy.ops.object.select_all(action="DESELECT")
    parts.link(wanted.objects[0]).select_set(True)


def set_output_folder_that_is_a_file():
    Path(bpy.path.abspath("//taken")).write_text("")
    bpy.context.scene.ltsh.output_folder = "//taken/"


def setting(name, value):
    return lambda: setattr(bpy.context.scene.ltsh, name, value)


TOLD = [
    (select_linked, "bake", "Floor"),
    (lambda: bpy.ops.object.select_all(action="DESELECT"), "bake",
     "No mesh is selected: select the objects to bake"),
    (setting("bake_uv_map", "Lightmap"), "bake", "Object 'Floor' has no UV map 'Lightmap', found 'UVMap'"),
    (setting("techniques", set()), "compare", "No technique is chosen: choose at least one to compare"),
    (setting("bake_passes", set()), "bake", "No pass is chosen: choose at least one"),
    (setting("resolution_percentage", 10), "shade", "The picture is smaller than 4 pixels: raise the resolution"),
    (set_output_folder_that_is_a_file, "shade", "Output folder '//taken/' cannot be written: choose another"),
]  # fmt: skip


@pytest.mark.parametrize(("spoil", "command", "text"), TOLD)
def test_what_only_the_artist_can_decide_is_told(scene, spoil, command, text):
    spoil()
    (problem,) = problems(command)
    assert text in problem.text and problem.blocks and not problem.fix
    with pytest.raises(RuntimeError, match="Error: "):
        getattr(bpy.ops.ltsh, command)()


def test_a_file_that_is_not_saved_can_be_shaded_all_the_same(addon):
    parts.add_plane()
    parts.add_area_light()
    parts.add_camera()
    (problem,) = problems("shade")
    assert problem.text.startswith("The file is not saved") and not problem.blocks
    assert (problem.fix, problem.fix_label) == ("wm.save_mainfile", "Save")


def test_changes_of_images_that_are_not_saved_can_be_packed(scene):
    image = bpy.data.images.new("Paint", 4, 4)
    bpy.data.materials["Floor"].node_tree.nodes.new("ShaderNodeTexImage").image = image
    image.pixels[0] = 0.5
    image.update()
    (problem,) = problems("shade")
    assert problem.text.startswith("Image 'Paint' has changes") and not problem.blocks
    mend(problem)
    assert problems("shade") == [] and image.packed_file is not None


def test_one_object_that_cannot_be_baked_does_not_stop_the_others(scene):
    parts.add_mesh("Bare", [(0, 0, 1), (1, 0, 1), (0, 1, 1)], [(0, 1, 2)]).select_set(True)
    usable, found = preflight.bake_objects(bpy.context)
    assert [ob.name for ob in usable] == ["Floor"] == list(job.bake_options(bpy.context, Path("x.blend")).objects)
    assert [(problem.text, problem.blocks) for problem in found] == [("Object 'Bare' has no UV map", False)]


def test_only_checked_objects_of_the_selection_are_baked(scene):
    ball = parts.add_sphere(name="Ball", segments=8)
    for ob in (ball, bpy.data.objects["Floor"]):
        ob.select_set(True)

    def asked():
        return sorted(job.bake_options(bpy.context, Path("x.blend")).objects)

    assert asked() == ["Ball", "Floor"]
    ball.ltsh_baked = False
    assert asked() == ["Floor"] and problems("bake") == []
    bpy.data.objects["Floor"].ltsh_baked = False
    (problem,) = problems("bake")
    assert problem.blocks and problem.text == "No selected object is checked: check those to bake"
    ball.ltsh_baked = True
    ball.select_set(False)
    assert preflight.blocking(bpy.context, "bake") == problem.text


def test_asking_changes_nothing(scene):
    """Panels ask with every redraw."""
    bpy.ops.wm.save_mainfile()
    dirty = bpy.data.is_dirty
    names = {kind: len(getattr(bpy.data, kind)) for kind in ("objects", "materials", "node_groups", "images")}
    for command in COMMANDS:
        problems(command)
    assert names == {kind: len(getattr(bpy.data, kind)) for kind in names} and bpy.data.is_dirty == dirty


@pytest.mark.parametrize(
    ("operator", "values", "text"),
    [
        ("add_uv_map", {"object_name": "Light"}, "Object 'Light' is not a visible mesh of this view layer"),
        ("pack_image", {"image_name": "Gone"}, "Image 'Gone' is not there any more"),
    ],
)
def test_what_is_gone_meanwhile_is_told(scene, operator, values, text):
    with pytest.raises(RuntimeError, match=f"Error: {text}"):
        getattr(bpy.ops.ltsh, operator)(**values)


def test_an_atlas_is_made_by_a_button_and_then_baked(scene):
    scene.ltsh.bake_atlas = True
    usable, (problem,) = preflight.bake_objects(bpy.context)
    assert (problem.text, problem.blocks, problem.fix) == (
        "Not in the atlas yet: 'Floor'",
        True,
        "ltsh.make_atlas",
    )
    first = usable[0].data.uv_layers.active.name
    assert bpy.ops.ltsh.make_atlas() == {"FINISHED"}
    assert [layer.name for layer in usable[0].data.uv_layers] == [first, "Lightmap"]
    assert usable[0].data.uv_layers.active.name == first and preflight.bake_objects(bpy.context)[1] == []
    options = job.bake_options(bpy.context, Path("x.blend"))
    assert (options.uv, options.atlas, options.size) == ("Lightmap", 256, (256, 256))
    assert {"bake Lightmap", "shade Lightmap"} <= {step.stage for step in job.steps([job.Run("bake", options)])}
