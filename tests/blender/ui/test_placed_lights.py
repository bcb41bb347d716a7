"""Lights that the panel adds, duplicates, deletes and looks through, and the world's picture."""

from types import SimpleNamespace

import bpy
import numpy as np
import pytest
import scene_parts as parts
from mathutils import Matrix, Vector
from recorded_layout import Layout, buttons, drawn

from ltsh_addon.blender.ui import panels, preview

LIGHTS = panels.CLASSES[3]


def light_names():
    return sorted(ob.name for ob in bpy.context.scene.objects if ob.type == "LIGHT")


@pytest.fixture
def view(scene):
    """The first 3D view of the screen."""
    space = preview.view_of(bpy.context)
    before = [getattr(space, name) for name in ("camera", "use_local_camera", "lock_camera")]
    space.region_3d.view_perspective = "PERSP"
    yield space
    space.camera, space.use_local_camera, space.lock_camera = before
    space.region_3d.view_perspective = "PERSP"


def irradiance_below(light, point, normal, count=64):
    """Of an area light on a surface, W m^-2, by a sum over its square; it is a Lambertian emitter of its power."""
    size, matrix = light.data.size, light.matrix_world
    steps = (np.arange(count) + 0.5) / count - 0.5
    corners = [matrix @ Vector((size * x, size * y, 0.0)) - point for x in steps for y in steps]
    # The light and the surface face each other: both cosines are alike.
    return light.data.energy / np.pi * np.mean([(one.normalized().dot(normal) / one.length) ** 2 for one in corners])


@pytest.mark.parametrize("distance", [0.02, 1.0, 30.0])
def test_a_new_light_faces_the_surface_and_makes_white_as_bright_at_any_size(scene, distance):
    point, normal = Vector((0.4, -0.3, 0.2)), Vector((1.0, 2.0, -2.0)) / 3.0
    before = light_names()
    assert bpy.ops.ltsh.add_light(location=point, normal=normal, distance=distance) == {"FINISHED"}
    (name,) = set(light_names()) - set(before)
    light = bpy.context.view_layer.objects.active
    bpy.context.view_layer.update()
    assert light.name == name and bpy.context.selected_objects == [light]
    assert (light.matrix_world.translation - point - distance * normal).length < 1e-5 * distance
    assert (light.matrix_world.to_3x3() @ Vector((0.0, 0.0, -1.0)) + normal).length < 1e-5
    # Radiance of a white diffuse surface; a display's white is 1.
    assert 0.7 < irradiance_below(light, point, normal) / np.pi < 1.0


def seen_from(camera, size=(160, 90)):
    """A region that shows what `camera` sees, as Blender has it in a window alone."""
    bpy.context.view_layer.update()
    window = camera.calc_matrix_camera(bpy.context.evaluated_depsgraph_get(), x=size[0], y=size[1])
    view = camera.matrix_world.inverted()
    data = SimpleNamespace(view_matrix=view, window_matrix=window, perspective_matrix=window @ view,
                           is_perspective=camera.data.type == "PERSP", view_perspective="PERSP")  # fmt: skip
    return SimpleNamespace(width=size[0], height=size[1], data=data)


@pytest.mark.parametrize("kind", ["PERSP", "ORTHO"])
def test_a_light_is_added_over_the_surface_under_the_mouse_within_the_room(scene, kind):
    """A view straight down on the floor, then on a ceiling that is seen from below."""
    for ob in [ob for ob in scene.objects if ob.type == "MESH"]:
        bpy.data.objects.remove(ob)
    ground, camera = parts.add_plane(None, size=40.0), scene.camera
    camera.matrix_world = Matrix.Translation((1.0, 2.0, 10.0))
    camera.data.type, camera.data.ortho_scale = kind, 4.0
    width = 10.0 * camera.data.sensor_width / camera.data.lens if kind == "PERSP" else 4.0
    point, normal, distance = preview.surface_at(bpy.context, seen_from(camera), (80, 45))
    assert (point - Vector((1.0, 2.0, 0.0))).length < 1e-4 and (normal - Vector((0.0, 0.0, 1.0))).length < 1e-5
    assert distance == pytest.approx(preview.DISTANCE * width, rel=1e-4)
    # A second floor below the ceiling that the ground becomes, looked at from between.
    lower = parts.add_plane(None, size=40.0)
    lower.location.z, camera.matrix_world = -0.5, Matrix.Translation((0.0, 0.0, -0.4)) @ Matrix.Rotation(np.pi, 4, "X")
    camera.data.ortho_scale = 8.0
    point, normal, distance = preview.surface_at(bpy.context, seen_from(camera), (20, 30))
    assert abs(point.z) < 1e-5 and normal.z < -0.999
    shown = 0.04 * width if kind == "PERSP" else 8.0
    assert distance == pytest.approx(min(0.5 * preview.FREE_SHARE, preview.DISTANCE * shown), rel=1e-3)
    bpy.data.objects.remove(lower)
    bpy.data.objects.remove(ground)
    assert preview.surface_at(bpy.context, seen_from(camera), (80, 45)) is None


def test_duplicates_and_deletes_the_active_light_alone(scene):
    light, floor = bpy.data.objects["Light"], bpy.data.objects["Floor"]
    preview.select_alone(bpy.context, light)
    floor.select_set(True)
    assert bpy.ops.ltsh.duplicate_light() == {"FINISHED"}
    (copy,) = set(light_names()) - {"Light"}
    copy = bpy.data.objects[copy]
    assert copy.data != light.data and copy.data.energy == light.data.energy and copy.matrix_world == light.matrix_world
    assert bpy.context.view_layer.objects.active == copy and "Floor.001" not in scene.objects
    floor.select_set(True)
    # One that is hidden can be deleted too.
    copy.hide_viewport = True
    assert bpy.ops.ltsh.delete_light() == {"FINISHED"}
    assert light_names() == ["Light"] and "Floor" in scene.objects
    bpy.context.view_layer.objects.active = floor
    assert not bpy.ops.ltsh.delete_light.poll() and not bpy.ops.ltsh.duplicate_light.poll()


def test_a_view_looks_through_a_light_and_returns(scene, view):
    region, camera, key = view.region_3d, scene.camera, bpy.data.objects["Light"]
    fill = parts.add_area_light("Fill", location=(0.0, 3.0, 1.0))
    region.view_location, region.view_distance = (0.3, 0.2, -7.0), 3.0
    before = region.view_rotation.copy()
    preview.select_alone(bpy.context, key)
    bpy.ops.ltsh.look_through_light()
    assert preview.looks_through(view) == key and view.lock_camera and scene.camera == camera
    pressed = [item.pressed for item in drawn(LIGHTS, space_data=view) if item.what == "ltsh.look_through_light"]
    assert pressed == [True]
    preview.select_alone(bpy.context, fill)
    bpy.ops.ltsh.look_through_light()
    assert preview.looks_through(view) == fill
    bpy.ops.ltsh.look_through_light()
    assert preview.looks_through(view) is None and scene.camera == camera
    assert not view.use_local_camera and not view.lock_camera and region.view_perspective == "PERSP"
    assert (*region.view_location, region.view_distance) == pytest.approx((0.3, 0.2, -7.0, 3.0))
    assert region.view_rotation == before
    # From the view of the scene's camera, and back to it although the light is gone.
    region.view_perspective = "CAMERA"
    bpy.ops.ltsh.look_through_light()
    bpy.ops.ltsh.look_through_light()
    assert region.view_perspective == "CAMERA" and view.camera == camera
    bpy.ops.ltsh.look_through_light()
    bpy.data.objects.remove(fill)
    assert preview.looks_through(view) is None


@pytest.fixture
def picture(tmp_path):
    image = bpy.data.images.new("Sky", 8, 4, float_buffer=True)
    image.filepath_raw, image.file_format = str(tmp_path / "sky.exr"), "OPEN_EXR"
    image.save()
    bpy.data.images.remove(image)
    return tmp_path / "sky.exr"


def no_world(scene):
    scene.world = None


def bare_world(scene):
    scene.world = bpy.data.worlds.new("Bare")


def empty_nodes(scene):
    bare_world(scene)
    if bpy.app.version < (5, 0, 0):
        scene.world.use_nodes = True
    scene.world.node_tree.nodes.clear()


def sky_nodes(scene):
    empty_nodes(scene)
    nodes, links = scene.world.node_tree.nodes, scene.world.node_tree.links
    background, output = nodes.new("ShaderNodeBackground"), nodes.new("ShaderNodeOutputWorld")
    background.inputs["Strength"].default_value = 0.3
    links.new(nodes.new("ShaderNodeTexSky").outputs[0], background.inputs["Color"])
    links.new(background.outputs[0], output.inputs["Surface"])


@pytest.mark.parametrize("make", [no_world, bare_world, empty_nodes, sky_nodes])
def test_a_picture_becomes_the_environment_of_any_world(scene, picture, make):
    make(scene)
    assert "ltsh.open_environment" in buttons(drawn(LIGHTS))
    kinds = {node.bl_idname for node in scene.world.node_tree.nodes} if make is sky_nodes else set()
    assert bpy.ops.ltsh.open_environment(filepath=str(picture)) == {"FINISHED"}
    background, texture = preview.environment_of(scene.world)
    assert texture.image.filepath == str(picture) and background.outputs[0].links[0].to_node.bl_idname.endswith("World")
    assert kinds <= {node.bl_idname for node in scene.world.node_tree.nodes}
    if make is sky_nodes:
        assert background.inputs["Strength"].default_value == pytest.approx(0.3)
    count = len(scene.world.node_tree.nodes)
    assert bpy.ops.ltsh.open_environment(filepath=str(picture)) == {"FINISHED"}
    assert len(scene.world.node_tree.nodes) == count
    shown = drawn(LIGHTS)
    assert "ltsh.open_environment" not in buttons(shown) and "default_value" in [item.what for item in shown]
    with pytest.raises(RuntimeError, match="nowhere"):
        bpy.ops.ltsh.open_environment(filepath=str(picture.with_name("nowhere.exr")))


@pytest.mark.parametrize(("role", "toward", "larger", "stronger"), [
    # From the south the eye sees west on its left.
    ("KEY", (-0.5417, -0.5417, 0.6428), 1.0, 1.0), ("FILL", (0.7399, -0.6209, 0.2588), 2.0, 0.25),
    ("RIM", (0.2988, 0.6409, 0.7071), 1.0, 1.0),
])  # fmt: skip
def test_lights_by_role_stand_around_the_object_as_the_view_sees_it(scene, role, toward, larger, stronger):
    for ob in [ob for ob in scene.objects if ob.type == "MESH"]:
        bpy.data.objects.remove(ob)
    parts.add_sphere(radius=0.5, location=(0.0, 0.0, 0.5))
    scene.camera.matrix_world = Matrix.Translation((0.0, -10.0, 0.5)) @ Matrix.Rotation(np.pi / 2.0, 4, "X")
    scene.camera.data.type, scene.camera.data.ortho_scale = "ORTHO", 4.0
    point, direction, distance = preview.surface_at(bpy.context, seen_from(scene.camera), (80, 45), role)
    assert (point - Vector((0.0, -0.5, 0.5))).length < 0.01 and (direction - Vector(toward)).length < 1e-3
    # The ball itself, which the way to the rim light crosses, does not bound it.
    assert distance == pytest.approx(preview.DISTANCE * 4.0, rel=1e-3)
    wall = parts.add_plane(size=40.0, name="Wall", location=(0.0, 1.5, 0.0), rotation=(np.pi / 2.0, 0.0, 0.0))
    bpy.context.view_layer.update()
    *_, distance = preview.surface_at(bpy.context, seen_from(scene.camera), (80, 45), role)
    free = 2.0 / toward[1] if toward[1] > 0.0 else np.inf
    assert distance == pytest.approx(min(preview.DISTANCE * 4.0, preview.FREE_SHARE * free), rel=0.01)
    bpy.data.objects.remove(wall)
    bpy.ops.ltsh.add_light(location=point, normal=direction, distance=2.0, role=role)
    light = bpy.context.view_layer.objects.active
    assert light.name == preview.ROLES[role][0] and light.data.size == pytest.approx(larger * 1.2)
    assert light.data.energy == pytest.approx(stronger * 40.0)


def test_the_menu_of_lights_has_those_by_role(addon):
    menu = SimpleNamespace(layout=Layout())
    preview.add_lights_to_menu(menu, bpy.context)
    entries = [item for item in menu.layout.shown if item.what == "ltsh.add_light"]
    assert [item.values.role for item in entries] == list(preview.ROLES)
    assert [item.text for item in entries] == [
        "LTSH Facing the Surface",
        "LTSH Key Light",
        "LTSH Fill Light",
        "LTSH Rim Light",
    ]
    assert preview.add_lights_to_menu in bpy.types.VIEW3D_MT_light_add.draw._draw_funcs
