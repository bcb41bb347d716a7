"""Lights of the viewport: every light of a scene is drawn as the numpy side has it, or named."""

import bpy
import numpy as np
import pytest
import scene_parts as parts

from ltsh_addon.blender.viewport.view_lights import view_lights


def seen():
    """The lights by name, and all notes as one text."""
    bpy.context.view_layer.update()
    lights, notes = view_lights(bpy.context.evaluated_depsgraph_get(), lambda instance: True)
    return {light.name: light for light in lights}, "\n".join(notes)


@pytest.mark.parametrize("kind", ["POINT", "SPOT", "SUN"])
def test_lights_without_area_are_named(kind):
    parts.empty_scene()
    parts.add_area_light()
    parts.link(bpy.data.objects.new("Bulb", bpy.data.lights.new("Bulb", kind)))
    lights, notes = seen()
    assert set(lights) == {"Light"} and "Bulb" in notes and kind in notes


def test_area_lights_are_those_that_shading_takes():
    parts.empty_scene()
    for shape in ("SQUARE", "RECTANGLE", "DISK", "ELLIPSE"):
        parts.add_area_light(shape, shape=shape, spread=1.2 if shape == "ELLIPSE" else np.pi)
    parts.add_camera()
    lights, notes = seen()
    _, _, inventory, _ = parts.prepare()
    expected = {light.name: light for light in inventory.lights}
    assert set(lights) == set(expected) == {"SQUARE", "RECTANGLE", "DISK", "ELLIPSE"} and not notes
    for name, light in lights.items():
        for field in ("shape", "spread", "group", "receivers"):
            assert getattr(light, field) == getattr(expected[name], field), (name, field)
        for field in ("center", "half_u", "half_v", "direction", "radiance"):
            np.testing.assert_allclose(getattr(light, field), getattr(expected[name], field), rtol=1e-6, atol=1e-9)


def test_what_cycles_shows_otherwise_is_named():
    parts.empty_scene()
    parts.add_area_light("Dark", energy=-5.0)
    parent = parts.link(bpy.data.objects.new("Parent", None), scale=(1.0, 3.0, 1.0))
    sheared = parts.add_area_light("Sheared", rotation=(0.3, 0.2, 0.7))
    sheared.parent = parent
    lights, notes = seen()
    assert set(lights) == {"Dark", "Sheared"}
    assert "'Dark': negative power" in notes and "'Sheared': its transform is sheared" in notes
