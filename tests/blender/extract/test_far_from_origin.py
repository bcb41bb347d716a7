"""Scenes far from the origin are shaded and rendered as the same scenes at the origin."""

from dataclasses import replace

import bpy
import numpy as np
import pytest
import scene_parts
from bake_scenes import baked, save
from lit_plane import add_instancer, assert_agrees, into_collection

from ltsh_addon.blender.extract import origin
from ltsh_addon.blender.process.pixels import PixelJob, extract_pixels
from ltsh_addon.cycles import gbuffer
from ltsh_addon.scene import QuadLight

# Where positions are 1/128 m apart: those of the scenes below are multiples of that, so that both places are the same.
PLACE = np.array([100000.0, -70000.0, 40.0])


def build():
    """A plane under a light, seen by a camera."""
    scene_parts.empty_scene()
    scene_parts.add_camera()
    scene_parts.add_plane(scene_parts.principled("Surface", Roughness=0.45)[0], size=12.0)
    scene_parts.add_area_light(location=(0.25, 0.5, 1.5))


def move(place=PLACE):
    """Move all of the scene by `place` (3,)."""
    for ob in bpy.context.scene.objects:
        if ob.parent is None:
            ob.location = np.array(ob.location) + place
    for collection in bpy.context.scene.collection.children:
        collection.instance_offset = np.array(collection.instance_offset) + place
    bpy.context.view_layer.update()


def add_nothing():
    pass


def add_a_child():
    child = scene_parts.add_sphere(None, 0.25, "Ball", location=(0.5, 0.0, 0.25))
    child.parent = bpy.data.objects["Plane"]


def add_instances():
    """Of a collection that is in the scene itself, and of one that is not."""
    scene = bpy.context.scene
    shown = bpy.data.collections.new("Shown")
    scene.collection.children.link(shown)
    ball = scene_parts.add_sphere(None, 0.25, "Ball", location=(0.5, 0.0, 0.25))
    scene.collection.objects.unlink(ball)
    shown.objects.link(ball)
    shown.instance_offset = (0.5, 0.0, 0.0)
    add_instancer(shown, "First", location=(-0.5, 0.0, 0.0))
    hidden = into_collection("Hidden", scene_parts.add_sphere(None, 0.25, "Other", location=(0.0, 0.5, 0.25)))
    add_instancer(hidden, "Second", location=(0.0, 0.25, 0.0))


def add_a_constraint():
    ball = scene_parts.add_sphere(None, 0.25, "Ball", location=(0.5, 0.0, 0.25))
    ball.constraints.new("COPY_LOCATION").target = bpy.data.objects["Light"]
    ball.constraints["Copy Location"].use_z = False


def add_what_is_carried():
    """A ball whose location is added to that of the light."""
    ball = scene_parts.add_sphere(None, 0.25, "Ball")
    constraint = ball.constraints.new("COPY_LOCATION")
    constraint.target, constraint.use_offset = bpy.data.objects["Light"], True


PARTS = {
    "plain": add_nothing,
    "child": add_a_child,
    "instances": add_instances,
    "constraint": add_a_constraint,
    "carried": add_what_is_carried,
}


def hits(folder, prepared):
    """Positions (P, 3) in the file, of all that the camera sees."""
    ((samples, _, unusable),) = scene_parts.sample(folder, prepared)[0]
    assert unusable == 0 and len(samples) > 0
    return samples.position + prepared[2].origin


@pytest.mark.parametrize("name", PARTS)
def test_everything_is_seen_where_it_is_at_the_origin(tmp_path, name):
    found = []
    for place in (np.zeros(3), PLACE):
        build()
        PARTS[name]()
        if name == "carried":
            bpy.data.objects["Ball"].location = np.array([0.0, 0.0, -1.0]) - place  # below the light
        move(place)
        prepared = scene_parts.prepare()
        found.append(hits(tmp_path, prepared) - place)
    assert np.linalg.norm(prepared[2].origin - PLACE) < 3.0
    assert sum("as if it lay at the origin" in line for line in prepared[3]) == 1, prepared[3]
    # Rounding of some meters in single precision, 2e-7 of them each.
    assert np.abs(found[1] - found[0]).max() < 2e-5


def test_light_is_that_of_cycles(tmp_path):
    """At its own place Cycles' positions would be 8 mm apart, and light 6 to 8 % off."""
    build()
    move()
    assert_agrees(tmp_path)


def test_textures_stay_where_they_are(tmp_path):
    build()
    move()
    material = bpy.data.materials["Surface"]
    tree = material.node_tree
    offset = tree.nodes.new("ShaderNodeVectorMath")
    offset.operation, offset.inputs[1].default_value = "SUBTRACT", PLACE
    tree.links.new(tree.nodes.new("ShaderNodeNewGeometry").outputs["Position"], offset.inputs[0])
    tree.links.new(offset.outputs[0], tree.nodes["Principled BSDF"].inputs["Base Color"])
    prepared = scene_parts.prepare()
    (((samples, *_),), _) = scene_parts.sample(tmp_path, prepared)
    place = samples.position + prepared[2].origin - PLACE
    seen = (place[:, :2] > 0.05).all(axis=1) & (place[:, :2] < 0.95).all(axis=1)
    assert seen.sum() > 3
    color = samples.diffuse_albedo[seen]
    # Positions in the file are 1/128 m apart, here at least 0.05 m.
    assert np.allclose(color[:, 0] / color[:, 1], place[seen, 0] / place[seen, 1], rtol=2.0 / 128 / 0.05)


def test_what_would_not_follow_is_named_and_all_stays(tmp_path):
    build()
    ball = scene_parts.add_sphere(None, 0.25, "Stubborn")
    move()
    ball.keyframe_insert("delta_location", frame=1)
    bpy.context.view_layer.update()
    before = {ob.name: np.array(ob.matrix_world) for ob in bpy.context.scene.objects}
    _, _, inventory, warnings = scene_parts.prepare()
    (line,) = [line for line in warnings if "from the origin" in line]
    assert "'Stubborn' would not follow" in line and "7.8 mm" in line and "7.8 %" in line
    assert not inventory.origin.any()
    for name, matrix in before.items():
        assert np.array_equal(np.array(bpy.data.objects[name].matrix_world), matrix), name


def test_scenes_at_the_origin_are_left_alone(monkeypatch):
    """Also where a camera or a backdrop is far: light is lost near the lights alone."""
    build()
    scene_parts.add_plane(None, 1e5, "Backdrop", location=(0.0, 0.0, -9.0))
    bpy.context.scene.camera.location = (0.0, -1e5, 5e4)
    _, _, inventory, warnings = scene_parts.prepare()
    assert not inventory.origin.any() and not any("origin" in line for line in warnings)
    build()
    monkeypatch.setattr(origin, "with_render_depsgraph", lambda *_: pytest.fail("evaluates a scene for nothing"))
    scene_parts.prepare()


def test_a_far_light_does_not_take_the_scene_away():
    build()
    bpy.data.objects["Light"].location = (0.0, 0.0, 1e6)
    bpy.context.view_layer.update()
    assert not scene_parts.prepare()[2].origin.any()


def test_positions_that_stay_far_are_named_with_their_effect():
    """8 mm at 1 m from a light, also where it is wide, and at 100 m; a single pixel near a light counts for nothing."""
    build()
    (light,) = scene_parts.prepare()[2].lights
    light = light.moved((1e5, 0.0, 0.0) - light.center)
    position = np.tile([1e5, 0.0, 1.0], (100, 1))
    wide = replace(light, half_u=1e3 * light.half_u, direction=(0.0, 0.0, -1.0))
    for other in (light, wide):
        (line,) = gbuffer.rounded_positions(position, [other])
        assert "1e+05 m" in line and "7.8 mm" in line
    far = position + [0.0, 0.0, 99.0]
    assert gbuffer.rounded_positions(far, [light]) == gbuffer.rounded_positions(position, []) == []
    far[0] = position[0]
    assert gbuffer.rounded_positions(far, [light]) == []
    # 6 m beside a square of 8 m, in its plane: no closer by its radius than 4.3 m, which is enough.
    square = QuadLight.like(light, half_u=(4.0, 0.0, 0.0), half_v=(0.0, 4.0, 0.0))
    assert gbuffer.rounded_positions(position + [10.0, 0.0, -1.0], [square]) == []
    # A surface that shines does not light itself.
    square = replace(square, direction=(0.0, 0.0, -1.0))
    position = square.center + np.linspace(-1.0, 1.0, 100)[:, None] * square.half_u
    assert gbuffer.rounded_positions(position, [square]) == []


def test_a_lamp_is_not_too_close_to_itself(tmp_path):
    build()
    material, _ = scene_parts.bsdf_material("ShaderNodeEmission", "Glow")
    scene_parts.add_sphere(material, 1.0, "Lamp", segments=128, location=(0.0, -0.5, 0.5))
    path = scene_parts.save(tmp_path / "lamp.blend")
    extraction = extract_pixels(PixelJob(scene=path))
    assert len(extraction.lights) > 20 and not [line for line in extraction.warnings if "rounded" in line]


def test_pictures_and_bakes_have_the_places_of_the_file(tmp_path):
    build()
    move()
    path = save(tmp_path)
    found = extract_pixels(PixelJob(scene=path))
    (light,) = found.lights
    assert np.abs(light.center - PLACE - (0.25, 0.5, 1.5)).max() < 1e-6
    assert np.abs(found.samples.position[:, 2] - PLACE[2]).max() < 1e-5
    view = tuple(PLACE + (1.0, 2.0, 3.0))
    report, files = baked(path, tmp_path / "far", techniques=("ltsh4",), passes=("combined",), view=view)
    build()
    _, expected = baked(
        save(tmp_path), tmp_path / "near", techniques=("ltsh4",), passes=("combined",), view=(1.0, 2.0, 3.0)
    )
    mine, theirs = (layers["Plane.exr"]["ltsh4.combined"] for layers in (files, expected))
    assert report["view"]["vector"] == list(view)
    assert np.abs(mine - theirs).max() < 1e-5 * theirs.max() and theirs.max() > 0.0
