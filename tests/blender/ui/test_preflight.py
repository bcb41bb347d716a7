"""What stands in the way of a job is told before the click, and the buttons beside it mend it."""

import bpy
import numpy as np
import pytest
import scene_parts as parts
from job_window import room

import ltsh_addon
from ltsh_addon.blender.ui import preflight

COMMANDS = ("shade", "compare", "bake")


@pytest.fixture
def scene(tmp_path):
    """The add-on and a saved file in which everything can be done, its floor selected."""
    ltsh_addon.register()
    scene = room(tmp_path / "room.blend")
    bpy.data.objects["Floor"].select_set(True)
    yield scene
    ltsh_addon.unregister()


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


def test_nothing_is_wrong_with_a_good_scene(scene):
    for command in COMMANDS:
        assert problems(command) == [] and preflight.blocking(bpy.context, command) == ""


def no_camera(scene):
    bpy.data.objects.remove(scene.camera)


def camera_is_an_empty(scene):
    scene.camera = parts.link(bpy.data.objects.new("Target", None))


def panorama(scene):
    scene.camera.data.type = "PANO"


def light_hidden(scene):
    bpy.data.objects["Light"].hide_render = True


def no_light(scene):
    bpy.data.objects.remove(bpy.data.objects["Light"])


def point_light(scene):
    bpy.data.objects["Light"].data.type = "POINT"


def no_uv_map(scene):
    layers = bpy.data.objects["Floor"].data.uv_layers
    layers.remove(layers[0])


def hidden_in_renders(scene):
    bpy.data.objects["Floor"].hide_render = True


MENDED = {
    no_camera: (COMMANDS, "The scene has no active camera"),
    camera_is_an_empty: (COMMANDS, "The scene has no active camera"),
    panorama: (COMMANDS, "Camera 'Camera' is panoramic, expected perspective or orthographic"),
    light_hidden: (COMMANDS, "Light 'Light' is hidden in renders, and no other area light is there"),
    no_light: (COMMANDS, "No area light"),
    point_light: (COMMANDS, "No area light: 'Light' is a light of another kind, which is not shaded"),
    no_uv_map: (("bake",), "Object 'Floor' has no UV map"),
    hidden_in_renders: (("bake",), "Object 'Floor' is hidden in renders"),
}


@pytest.mark.parametrize("spoil", MENDED, ids=lambda spoil: spoil.__name__)
def test_what_can_be_mended_is_mended_by_one_click(scene, spoil):
    commands, text = MENDED[spoil]
    spoil(scene)
    for command in commands:
        (problem,) = problems(command)
        assert problem.text == text and problem.blocks and problem.fix and problem.fix_label
        with pytest.raises(RuntimeError, match="Error: " + text.split(",")[0]):
            getattr(bpy.ops.ltsh, command)()
    selected = list(bpy.context.selected_objects)
    mend(problem)
    for command in COMMANDS:
        assert problems(command) == [], command
    assert bpy.context.selected_objects == selected and bpy.context.mode == "OBJECT"


def test_unwrapping_gives_every_face_a_place_in_the_square(scene):
    no_uv_map(scene)
    sphere = parts.add_sphere(name="Ball", segments=8)
    sphere.data.uv_layers.remove(sphere.data.uv_layers[0])
    mend(next(problem for problem in problems("bake") if "'Ball'" in problem.text))
    uv = np.empty(2 * len(sphere.data.loops), np.float32)
    sphere.data.uv_layers[0].data.foreach_get("uv", uv)
    assert 0.0 <= uv.min() < 0.1 and 0.9 < uv.max() <= 1.0
    assert not bpy.data.objects["Floor"].data.uv_layers


def linked(scene, tmp_path):
    library = tmp_path / "library.blend"
    bpy.data.libraries.write(str(library), {bpy.data.objects["Floor"]})
    with bpy.data.libraries.load(str(library), link=True) as (_, wanted):
        wanted.objects = ["Floor"]
    bpy.ops.object.select_all(action="DESELECT")
    parts.link(wanted.objects[0])
    wanted.objects[0].select_set(True)


def nothing_selected(scene, tmp_path):
    bpy.ops.object.select_all(action="DESELECT")


def another_uv_map(scene, tmp_path):
    scene.ltsh.bake_uv_map = "Lightmap"


def no_technique(scene, tmp_path):
    scene.ltsh.techniques = set()


def no_pass(scene, tmp_path):
    scene.ltsh.bake_passes = set()


def not_writable(scene, tmp_path):
    (tmp_path / "taken").write_text("")
    scene.ltsh.output_folder = "//taken/"


def test_not_writable_names_the_folder(scene, tmp_path):
    not_writable(scene, tmp_path)
    (problem,) = problems("shade")
    assert problem.text == "Output folder '//taken/' cannot be written: choose another"


TOLD = {
    linked: "Floor",
    nothing_selected: "No mesh is selected: select the objects to bake",
    another_uv_map: "Object 'Floor' has no UV map 'Lightmap', found 'UVMap'",
    no_technique: "No technique is chosen: choose at least one",
    no_pass: "No pass is chosen: choose at least one",
}


@pytest.mark.parametrize("spoil", TOLD, ids=lambda spoil: spoil.__name__)
def test_what_only_the_artist_can_decide_is_told(scene, tmp_path, spoil):
    spoil(scene, tmp_path)
    (problem,) = problems("bake")
    assert TOLD[spoil] in problem.text and problem.blocks and not problem.fix
    with pytest.raises(RuntimeError, match="Error: "):
        bpy.ops.ltsh.bake()


def test_a_tiny_picture_is_told(scene):
    scene.ltsh.resolution_percentage = 10
    assert [problem.text for problem in problems("shade")] == [
        "The picture is smaller than 4 pixels: raise the resolution"
    ]
    assert problems("bake") == []


def test_a_file_that_is_not_saved_can_be_shaded_all_the_same():
    ltsh_addon.register()
    try:
        parts.empty_scene()
        parts.add_plane()
        parts.add_area_light()
        parts.add_camera()
        (problem,) = problems("shade")
        assert problem.text.startswith("The file is not saved") and not problem.blocks
        assert (problem.fix, problem.fix_label) == ("wm.save_mainfile", "Save")
    finally:
        ltsh_addon.unregister()


def test_changes_of_images_that_are_not_saved_can_be_packed(scene):
    image = bpy.data.images.new("Paint", 4, 4)
    material = bpy.data.materials["Floor"]
    node = material.node_tree.nodes.new("ShaderNodeTexImage")
    node.image = image
    image.pixels[0] = 0.5
    image.update()
    (problem,) = problems("shade")
    assert problem.text.startswith("Image 'Paint' has changes") and not problem.blocks
    mend(problem)
    assert problems("shade") == [] and image.packed_file is not None


def test_one_object_that_cannot_be_baked_does_not_stop_the_others(scene):
    parts.add_mesh("Bare", [(0, 0, 1), (1, 0, 1), (0, 1, 1)], [(0, 1, 2)]).select_set(True)
    usable, found = preflight.bake_objects(bpy.context)
    assert [ob.name for ob in usable] == ["Floor"]
    assert [(problem.text, problem.blocks) for problem in found] == [("Object 'Bare' has no UV map", False)]


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
        ("show_in_render", {"object_name": "Gone"}, "Object 'Gone' is not in the scene any more"),
        ("add_uv_map", {"object_name": "Light"}, "Object 'Light' is not a visible mesh of this view layer"),
        ("pack_image", {"image_name": "Gone"}, "Image 'Gone' is not there any more"),
    ],
)
def test_what_is_gone_meanwhile_is_told(scene, operator, values, text):
    with pytest.raises(RuntimeError, match=f"Error: {text}"):
        getattr(bpy.ops.ltsh, operator)(**values)
