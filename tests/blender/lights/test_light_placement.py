"""Where lights are and whether they shine: parents, instances, animation, drivers, libraries, what is hidden."""

import math

import bpy
import numpy as np
import pytest
import scene_parts
from lit_plane import add_instancer, add_lamp_plane, assert_agrees, instance_on_points, into_collection, start

from ltsh_addon.blender.process.pixels import PixelJob, extract_pixels


@pytest.mark.parametrize("add", [scene_parts.add_area_light, add_lamp_plane], ids=["area light", "mesh light"])
def test_what_does_not_render_does_not_shine(tmp_path, add):
    start()
    scene = bpy.context.scene
    # Apart from each other: of emitters in the same place Cycles' rays find only one.
    places = iter((0.5 * k - 1.5, 1.0, 1.2 + 0.1 * k) for k in range(7))
    add(name="Shown", location=next(places))
    add(name="Not in renders", location=next(places)).hide_render = True
    add(name="Not in the viewport", location=next(places)).hide_viewport = True
    add(name="Closed eye", location=next(places)).hide_set(True)
    for name, attribute in (("Excluded", "exclude"), ("Collection off", "hide_render"), ("Indirect", "indirect_only")):
        collection = into_collection(name, add(name=name, location=next(places)))
        scene.collection.children.link(collection)
        owner = collection if attribute == "hide_render" else bpy.context.view_layer.layer_collection.children[name]
        setattr(owner, attribute, True)
    prepared = assert_agrees(tmp_path, samples=512, count=16, tolerance=0.03)
    # One light too many or too few is off by a fifth. "Indirect only" collections still light other objects directly.
    shining = {"Closed eye", "Indirect", "Not in the viewport", "Shown"}
    assert {light.name for light in prepared[2].lights} == shining


def test_only_the_view_layer_that_renders_counts():
    scene = start()
    collection = into_collection("Of layer 2", scene_parts.add_area_light("Second"))
    scene.collection.children.link(collection)
    scene_parts.add_area_light("First")
    scene.view_layers[0].layer_collection.children["Of layer 2"].exclude = True
    scene.view_layers.new("Layer 2")
    assert [light.name for light in scene_parts.prepare()[2].lights] == ["First"]


def test_parents_and_constraints_move_lights(tmp_path):
    start()
    arm = scene_parts.link(
        bpy.data.objects.new("Arm", None), location=(0.2, 0.3, 0.4), rotation=(0.0, 0.2, 0.9), scale=(1.3, 1.3, 1.3)
    )
    scene_parts.add_area_light(location=(0.1, 0.2, 0.7)).parent = arm
    lamp = add_lamp_plane(scale=(0.5, -0.5, 0.5))
    lamp.constraints.new("COPY_LOCATION").target = scene_parts.link(
        bpy.data.objects.new("Place", None), location=(-0.8, 0.7, 1.0)
    )
    prepared = assert_agrees(tmp_path, samples=512)
    centers = {light.name: light.center for light in prepared[2].lights}
    assert np.allclose(centers["Lamp"], (-0.8, 0.7, 1.0), atol=1e-6)


def test_lights_instanced_by_geometry_nodes(tmp_path):
    """Lights and lamps on the points of a visible mesh that would stand in their light."""
    start()
    for x, source in ((0.5, scene_parts.add_area_light(size=0.4)), (-0.5, add_lamp_plane(scale=(0.4, 0.4, 1)))):
        source.location, source.rotation_euler = (0.0, 0.0, 50.0), (0.0, 0.0, 0.0)
        maker = scene_parts.add_mesh("Maker", [(x, 0.4, 1.2), (x, 1.2, 1.4), (x + 0.4, 1.2, 1.5)], [(0, 1, 2)])
        maker.visible_camera = False
        instance_on_points(maker, source)
    prepared = assert_agrees(tmp_path, samples=512, count=16)
    # Three instances of the light, three of the two-sided lamp, and both originals far above.
    assert [light.name for light in prepared[2].lights].count("Light") == 4
    assert [light.name for light in prepared[2].lights].count("Lamp") == 8


def animate(owner, path, values, index=-1):
    """Keys of `path` at frames 1 and 11 with `values`, in a straight line between."""
    for frame, value in zip((1, 11), values, strict=True):
        if index >= 0:
            getattr(owner, path)[index] = value
        else:
            setattr(owner, path, value)
        owner.keyframe_insert(path, index=index, frame=frame)
    action = owner.animation_data.action
    curves = getattr(action, "fcurves", None) or action.layers[0].strips[0].channelbags[0].fcurves
    for curve in curves:
        for key in curve.keyframe_points:
            key.interpolation = "LINEAR"


def test_animated_and_driven_lights_are_those_of_the_frame(tmp_path):
    """At frame 6 everything is half way; simple driver expressions need no scripts."""
    scene = start()
    light = scene_parts.add_area_light()
    animate(light.data, "energy", (10.0, 90.0))
    animate(light.data, "color", (0.0, 1.0), index=1)
    animate(light, "location", (1.0, 2.0), index=2)
    light.data.driver_add("size").driver.expression = "frame / 4"
    scene_parts.add_camera()
    path = scene_parts.save(tmp_path / "animated.blend")
    first, middle = (extract_pixels(PixelJob(path, frame=frame)).lights[0] for frame in (1, 6))
    assert first.center[2] == pytest.approx(1.0) and middle.center[2] == pytest.approx(1.5)
    assert np.linalg.norm(middle.half_u) == pytest.approx(0.75)
    area = 4.0 * np.linalg.norm(middle.half_u) * np.linalg.norm(middle.half_v)
    assert np.allclose(middle.radiance, 50.0 / math.pi / area * np.array([1.0, 0.5, 1.0]), rtol=1e-5)
    scene.frame_set(6)
    assert_agrees(tmp_path)


def test_lights_and_collections_of_a_library(tmp_path):
    scene_parts.empty_scene()
    lights = into_collection("Rig", scene_parts.add_area_light("Library light"), add_lamp_plane(name="Library lamp"))
    lights.use_fake_user = True
    library = scene_parts.save(tmp_path / "library.blend")
    start()
    with bpy.data.libraries.load(str(library), link=True) as (source, target):
        target.collections = list(source.collections)
    add_instancer(target.collections[0], location=(0.2, 0.0, 0.1))
    bpy.context.scene.collection.children.link(target.collections[0])
    prepared = assert_agrees(tmp_path, samples=512)
    names = [light.name for light in prepared[2].lights]
    assert names.count("Library light") == 2 and names.count("Library lamp") == 4
