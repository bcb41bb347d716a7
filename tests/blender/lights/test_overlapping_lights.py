"""Area lights that overlap in one plane: Cycles loses light of one of them, which is named with its size."""

from dataclasses import replace

import bpy
import numpy as np
import pytest
import quadrature
import scene_parts
from lit_plane import add_instancer, into_collection, measured

from ltsh_addon.blender.lights.area import overlapping_pairs
from ltsh_addon.blender.viewport import still
from ltsh_addon.scene import EllipseLight, QuadLight


def two_lights(apart=0.0, **settings):
    """A scene of a shiny plane under two equal lights that stand at the same place but for their height."""
    scene_parts.empty_scene()
    scene_parts.add_camera()
    scene_parts.add_plane(scene_parts.principled("Surface", Roughness=0.2, Metallic=1.0)[0], size=12.0)
    turned = {"rotation": (0.0, 0.0, 0.4)}
    scene_parts.add_area_light("Upper", **turned)
    scene_parts.add_area_light("Lower", location=(0.3, 0.2, 1.5 - apart), **turned, **settings)


def excess(folder, prepared):
    """By what the quadrature exceeds Cycles, as a share of the quadrature."""
    _, surface, halves = measured(folder, 256, prepared)
    expected = quadrature.radiance(surface, prepared[2].lights, quadrature.ggx, 48)
    return 1.0 - halves["specular"].mean(axis=0).sum() / expected.sum()


def test_cycles_loses_light_and_the_warning_says_how_much(tmp_path):
    two_lights()
    prepared = scene_parts.prepare()
    (line,) = prepared[3]
    assert "'Upper' and 'Lower' (100 %)" in line and "up to 50 %" in line
    assert 0.05 < excess(tmp_path, prepared) < 0.5


@pytest.mark.parametrize(("apart", "count"), [(0.0, 1), (0.1, 0)])
def test_views_name_them_too(apart, count):
    two_lights(apart)
    warnings = still.overlaps_of_lights(bpy.context.evaluated_depsgraph_get())
    assert len(warnings) == count and all("'Upper' and 'Lower' (100 %)" in line for line in warnings)


def test_views_look_at_instanced_lights():
    """An object that the depsgraph makes for an instance is another one afterwards: here a mesh, which has no kind."""
    scene_parts.empty_scene()
    lamp, box = scene_parts.add_area_light("Lamp"), scene_parts.add_plane(name="Box", size=0.2)
    collection = into_collection("Lamps", lamp, box)
    for x in (0.0, 3.0, 6.0):
        add_instancer(collection, f"Lamp at {x}", location=(x, 0.0, 1.0))
    bpy.context.view_layer.update()
    assert still.overlaps_of_lights(bpy.context.evaluated_depsgraph_get()) == []


@pytest.mark.parametrize("settings", [{"apart": 1e-4}, {"energy": 0.0}], ids=["apart", "dark"])
def test_where_cycles_loses_nothing_nothing_is_said(tmp_path, settings):
    two_lights(**settings)
    prepared = scene_parts.prepare()
    assert prepared[3] == []
    # The noise of the sum at 256 samples.
    assert abs(excess(tmp_path, prepared)) < 0.03


def test_lights_that_rays_do_not_hit_are_not_named():
    two_lights()
    bpy.data.lights["Lower"].cycles.use_multiple_importance_sampling = False
    assert scene_parts.prepare()[3] == []


def light(name, x=0.0, **settings):
    plain = QuadLight(name, (x, 0.0, 1.0), (1.0, 0.0, 0.0), (0.0, 0.5, 0.0), (0.0, 0.0, -1.0), np.ones(3))
    return replace(plain, **settings)


def test_overlaps_are_those_of_the_shapes():
    def share(*lights):
        found = overlapping_pairs(list(lights))
        return round(found[0][2], 2) if found else 0.0

    whole = light("A")
    assert share(whole, light("B", 1.0)) == 0.5
    assert share(whole, light("B", 2.1)) == share(whole) == 0.0
    assert share(whole, light("B", 0.3, half_u=(0.1, 0.0, 0.0))) == 1.0
    # The corners of a rectangle are outside of the ellipse in it.
    corner = light("B", center=(0.95, 0.45, 1.0), half_u=(0.05, 0.0, 0.0), half_v=(0.0, 0.05, 0.0))
    assert share(whole, corner) == 1.0 and share(EllipseLight.like(light("A")), corner) == 0.0
    assert share(whole, light("B", direction=(0.0, 0.0, 1.0))) == 0.0
    assert share(light("A", receivers=(1,)), light("B", receivers=(2,))) == 0.0
    assert share(light("A", receivers=(1,)), light("B", receivers=(1, 2))) == 1.0


def test_of_many_lights_each_pair_is_found_once():
    lights = [light(str(number), 3.0 * (number % 400)) for number in range(800)]
    pairs = {tuple(sorted((first.name, second.name), key=int)) for first, second, _ in overlapping_pairs(lights)}
    assert len(overlapping_pairs(lights)) == 400
    assert pairs == {(str(number), str(number + 400)) for number in range(400)}
