"""Scenes far from the origin are named with the error of their positions, in pictures, bakes and views."""

from dataclasses import replace
from types import SimpleNamespace

import bpy
import numpy as np
import pytest
import scene_parts
from bake_scenes import baked, save

from ltsh_addon.blender.process.pixels import PixelJob, extract_pixels
from ltsh_addon.blender.viewport.mirror import SceneMirror
from ltsh_addon.cycles import gbuffer
from ltsh_addon.scene import QuadLight

# Where positions are 1/128 m apart: those of the scenes below are multiples of that, so that both places are the same.
PLACE = np.array([100000.0, -70000.0, 40.0])


def build(place=(0.0, 0.0, 0.0)):
    """A plane under a light, seen by a camera."""
    scene_parts.empty_scene()
    scene_parts.add_camera()
    scene_parts.add_plane(scene_parts.principled("Surface", Roughness=0.45)[0], size=12.0)
    scene_parts.add_area_light(location=(0.25, 0.5, 1.5))
    for ob in bpy.context.scene.objects:
        ob.location = np.array(ob.location) + place
    bpy.context.view_layer.update()


def test_positions_that_are_far_are_named_with_their_effect():
    """8 mm at 1 m from a light, also where it is wide, and at 100 m; a single pixel near a light counts for nothing."""
    build()
    (light,) = scene_parts.prepare()[2].lights
    light = light.altered(center=np.array([1e5, 0.0, 0.0]))
    position = np.tile([1e5, 0.0, 1.0], (100, 1))
    wide = replace(light, half_u=1e3 * light.half_u, direction=(0.0, 0.0, -1.0))
    for other in (light, wide):
        (line,) = gbuffer.rounded_positions(position, [other])
        assert "1e+05 m" in line and "7.8 mm" in line and "'Light'" in line
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


@pytest.mark.parametrize("light_height", [1.5, 1e6])
@pytest.mark.parametrize("place", [np.zeros(3), PLACE], ids=["near", "far"])
def test_pictures_bakes_and_views_name_what_is_rounded(place, light_height, tmp_path):
    """A light that is far away from a scene at the origin loses nothing."""
    build(place)
    bpy.data.objects["Light"].location.z = place[2] + light_height
    path = save(tmp_path)
    extraction = extract_pixels(PixelJob(scene=path))
    report, _ = baked(path, tmp_path / "bake", techniques=("ltsh4",), passes=("combined",))
    mirror = SceneMirror()
    mirror.instances = [SimpleNamespace(center=np.array([*place, 1.0]))]
    mirror.read_lights(bpy.context.evaluated_depsgraph_get(), lambda instance: True)
    for lines in (extraction.warnings, report["warnings"], mirror.notes):
        lines = [line for line in lines if "from the origin" in line]
        assert len(lines) == int(place.any() and light_height < 10.0) and all("7.8 mm" in line for line in lines)
    (light,) = extraction.lights
    assert np.abs(light.center - place - (0.25, 0.5, light_height)).max() < 1e-6
