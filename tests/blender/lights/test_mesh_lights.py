"""Objects with emissive materials light as in Cycles, whatever their transform, closed or open, among other lights."""

import math

import bpy
import numpy as np
import pytest
import scene_parts
from lit_plane import (
    LAMP_CORNERS,
    add_instancer,
    add_lamp,
    add_lamp_ball,
    add_lamp_plane,
    add_surface,
    assert_agrees,
    into_collection,
    lamp_material,
    start,
)
from material_scenes import Build

from ltsh_addon.blender.extract import pixels
from ltsh_addon.blender.lights import meshes
from ltsh_addon.scene import SceneError

L_SHAPE = [(0, 0, 0), (1, 0, 0), (1, 0.3, 0), (0.3, 0.3, 0), (0.3, 1, 0), (0, 1, 0)]


def add_l_shape():
    add_lamp(L_SHAPE, [(0, 1, 2, 3, 4, 5)], location=(-0.3, 0.5, 1.2), rotation=(-0.5, 0.2, 0.0))


def add_lamp_behind_a_wall():
    """A plain wall in front of a lamp takes nothing from its light."""
    add_lamp_plane()
    wall = scene_parts.add_plane(scene_parts.principled("Wall")[0], 2.0, "Wall", location=(0.0, 0.9, 0.8))
    wall.visible_camera = False


def add_flipped_ball():
    add_lamp_ball().data.flip_normals()


# Faces of a ball of 6 segments and 3 rings, of which only the outer side shines.
BALL = 18
CASES = {
    "plane, front down": (add_lamp_plane, 2),
    "plane, back down": (lambda: add_lamp_plane(rotation=(math.pi - 0.7, 0.0, 0.0)), 2),
    "mirrored and stretched plane": (lambda: add_lamp_plane(scale=(-1.5, 0.7, 2.0)), 2),
    "concave polygon": (add_l_shape, 2),
    "plane behind a wall": (add_lamp_behind_a_wall, 2),
    "closed ball": (add_lamp_ball, BALL),
    "mirrored and stretched ball": (lambda: add_lamp_ball(scale=(-1.2, 0.6, 1.0)), BALL),
    "ball with its normals inward": (add_flipped_ball, BALL),
}


@pytest.mark.parametrize("name", CASES)
def test_a_mesh_lights_as_in_cycles(tmp_path, name):
    start(16, 12)
    build, count = CASES[name]
    build()
    _, _, inventory, warnings = assert_agrees(tmp_path, samples=1024, count=8 if count == BALL else 16)
    assert len(inventory.lights) == count and warnings == []


def test_a_shell_around_the_camera_shines_inward(tmp_path):
    scene_parts.empty_scene(16, 12)
    scene_parts.add_camera()
    add_surface(size=4.0)
    dome = scene_parts.add_sphere(lamp_material()[0], 9.0, "Dome", smooth=False, segments=6, location=(0.0, 0.0, 7.0))
    dome.visible_camera = False
    prepared = assert_agrees(tmp_path, samples=1024, count=24)
    assert len(prepared[2].lights) == BALL
    assert all(np.dot(light.center - (0.0, 0.0, 7.0), light.direction) < 0.0 for light in prepared[2].lights)


def test_lamps_do_not_stand_in_the_light_of_others(tmp_path):
    """The ball stands between the area light and the highlight on the plane; its dark foot is part of the object."""
    start()
    scene_parts.add_area_light(location=(0.0, 1.5, 1.6), rotation=(-0.9, 0.0, 0.0))
    ball = add_lamp_ball()
    ball.data.materials.append(scene_parts.principled("Foot")[0])
    ball.data.polygons.foreach_set("material_index", [int(face.center.z < -0.1) for face in ball.data.polygons])
    prepared = assert_agrees(tmp_path, samples=512, count=16)
    assert 1 < len(prepared[2].lights) < 1 + BALL


def test_a_ball_of_thousands_of_faces_is_taken_as_it_is():
    start()
    add_lamp_ball(segments=66)
    prepared = scene_parts.prepare()
    lights = prepared[2].lights
    assert len(lights) > 2000 and not any("'Lamp'" in line for line in prepared[3])
    area = sum(np.linalg.norm(light.area_vector) for light in lights)
    # Faces of 5 degrees: their area is 0.2 % smaller.
    assert abs(area / (4.0 * np.pi * 0.3**2) - 1.0) < 5e-3
    assert all(np.dot(light.center - (0.0, 1.0, 1.2), light.direction) > 0.29 for light in lights)


def test_too_many_faces_are_refused_by_name(tmp_path, monkeypatch):
    monkeypatch.setattr(meshes, "MOST_POLYGONS", 10)
    start()
    scene_parts.add_area_light("Key")
    add_lamp_ball()
    prepared = assert_agrees(tmp_path)
    assert [light.name for light in prepared[2].lights] == ["Key"]
    assert sum("'Lamp'" in line and f"{BALL} flat faces" in line for line in prepared[3]) == 1, prepared[3]


def test_dark_materials_are_no_lights():
    start()
    for number, settings in enumerate(({"strength": 0.0}, {"color": (0.0, 0.0, 0.0, 1.0)})):
        add_lamp_plane(lamp_material(f"Dark {number}", **settings)[0])
    hidden = add_lamp_plane()
    hidden.visible_diffuse = hidden.visible_glossy = False
    with pytest.raises(SceneError, match="no light"):
        scene_parts.prepare()


def test_visibility_to_lobes_is_kept(tmp_path):
    start()
    add_lamp_plane().visible_glossy = False
    prepared = scene_parts.prepare()
    assert {(light.affects_diffuse, light.affects_specular) for light in prepared[2].lights} == {(True, False)}
    images = scene_parts.reference(tmp_path, prepared, 64)
    # Directions that Cycles samples for the diffuse lobe also count the glossy one: a trace remains.
    assert images["specular"].sum() < 0.01 * images["diffuse"].sum()


def test_evaluated_geometry_and_all_instances_shine(tmp_path):
    """Modifiers count, text is a surface, and each instance stands where it is."""
    start()
    lamp = add_lamp_plane(scale=(0.4, 0.4, 0.4))
    array = lamp.modifiers.new("Array", "ARRAY")
    array.count, array.relative_offset_displace = 2, (1.5, 0.0, 0.0)
    collection = into_collection("Lamps", lamp)
    add_instancer(collection, "One", location=(-0.8, 0.0, 0.0))
    add_instancer(collection, "Two", location=(0.6, 0.0, 0.1), scale=(-1.0, 1.0, 1.0))
    prepared = assert_agrees(tmp_path, samples=512, count=12)
    assert len(prepared[2].lights) == 8


def text(extrude):
    data = bpy.data.curves.new("Sign", "FONT")
    data.body, data.extrude = "LI", extrude
    return data


def metaballs():
    data = bpy.data.metaballs.new("Sign")
    data.resolution = data.render_resolution = 0.3
    for x in (0.0, 0.3):
        ball = data.elements.new()
        ball.co, ball.radius = (x, 0.0, 0.0), 0.5
    return data


@pytest.mark.parametrize("make", [lambda: text(0.0), lambda: text(0.03), metaballs], ids=["flat", "thick", "metaballs"])
def test_text_and_metaballs_shine_once(tmp_path, make):
    """Blender shows renders the object and the mesh that it makes."""
    start()
    data = make()
    data.materials.append(lamp_material()[0])
    sign = scene_parts.link(
        bpy.data.objects.new("Sign", data), location=(-0.4, 1.2, 1.0), rotation=(math.pi - 0.7, 0.0, 0.0)
    )
    sign.visible_camera = False
    lights = assert_agrees(tmp_path, samples=1024, count=16, tolerance=6e-3)[2].lights
    assert {light.name for light in lights} == {"Sign"}


def test_a_sheet_of_two_layers_shines_once_to_each_side(tmp_path):
    start()
    add_lamp(2 * LAMP_CORNERS, [(0, 1, 2, 3), (7, 6, 5, 4)])
    assert len(assert_agrees(tmp_path, samples=1024, tolerance=6e-3)[2].lights) == 2


def test_a_material_override_that_emits_makes_lamps_of_all_surfaces(tmp_path):
    start()
    add_lamp_plane(scene_parts.principled("Not lit")[0])
    material, _ = scene_parts.principled("Override", Roughness=0.5, Emission_Strength=3.0)
    bpy.context.view_layer.material_override = material
    prepared = assert_agrees(tmp_path, samples=512)
    assert [light.name for light in prepared[2].lights] == ["Plane", "Plane", "Lamp", "Lamp"]


def test_transparency_over_emission_is_cut_in_both(tmp_path):
    """Half transparent lamps shine as Cycles' reference shows them, which has them opaque and says so."""
    start()
    veil = Build("Veil")
    add_lamp_plane(veil.show(veil.mix(0.5, veil.clear(), veil.shader("Emission", Strength=20.0))))
    assert_agrees(tmp_path)


def test_displacement_of_a_lamp_is_named():
    start()
    material, _ = lamp_material()
    material.displacement_method = "DISPLACEMENT"
    tree = material.node_tree
    output = tree.nodes["Material Output"]
    tree.links.new(tree.nodes.new("ShaderNodeDisplacement").outputs[0], output.inputs["Displacement"])
    add_lamp_plane(material)
    assert sum("'Lamp'" in line and "displacement" in line for line in scene_parts.prepare()[3]) == 1


def test_the_camera_sees_lamps_as_before(tmp_path):
    """Letting light through is for rays that light, not for the camera's."""
    start()
    ball = add_lamp_ball()
    ball.visible_camera = True
    ball.location = (0.0, 0.0, 0.5)
    prepared = scene_parts.prepare()
    before = scene_parts.sample(tmp_path, prepared)[0][0][0]
    pixels.remove_occlusion(prepared[0])
    after = scene_parts.sample(tmp_path, prepared)[0][0][0]
    assert np.array_equal(before.position, after.position)
