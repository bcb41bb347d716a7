"""Light groups: the shaded group layers are what Cycles writes per group, and sum up to the whole."""

import bpy
import numpy as np
import pytest
import scene_parts
from lit_plane import add_instancer, add_lamp_plane, combined_by_group, into_collection, start

from ltsh_addon.shading import shade

GROUPS = ("Keys", "Lamps")


@pytest.fixture
def grouped_scene():
    """Area lights and an emissive mesh in a group each, one light in none; the mesh has its group from an instancer."""
    scene = start()
    for name in GROUPS:
        scene.view_layers[0].lightgroups.add(name=name)
    scene_parts.add_area_light("Key").lightgroup = "Keys"
    scene_parts.add_area_light("Second key", location=(-0.6, 0.5, 1.2), color=(0.2, 1.0, 0.3)).lightgroup = "Keys"
    scene_parts.add_area_light("Loose", location=(0.9, 0.9, 1.4), energy=40.0)
    add_instancer(into_collection("Of lamp", add_lamp_plane())).lightgroup = "Lamps"
    return scene


def test_groups_are_those_of_cycles_and_sum_up(tmp_path, grouped_scene):
    prepared = scene_parts.prepare()
    lights = prepared[2].lights
    assert {light.name: light.group for light in lights} == dict(Key="Keys", Loose="", Lamp="Lamps") | {
        "Second key": "Keys"
    }
    ((surface, pixel, _),) = scene_parts.sample(tmp_path, prepared)[0]
    found = combined_by_group(tmp_path, prepared, 512, ("", *GROUPS))
    shaded = shade(surface, lights, "reference")
    by_light = shaded.specular + shaded.diffuse
    image = {name: by_light[[light.group == name for light in lights]].sum(axis=0) for name in GROUPS}
    pairs = [(image[name], found[name][:, pixel]) for name in GROUPS] + [(shaded.combined, found[""][:, pixel])]
    for shade_image, halves in pairs:
        difference = np.sum((shade_image - halves[0]) * (shade_image - halves[1]))
        # The noise of a half is 1 %: its trace in the estimate is 2e-3. A light in the wrong group is off by 20 %.
        assert difference < (4e-3) ** 2 * np.sum(halves[0] * halves[1])


@pytest.mark.parametrize("is_instanced", [False, True])
def test_a_light_keeps_its_own_group_without_a_pass_and_inside_an_instancer_with_another(is_instanced):
    start()
    key = scene_parts.add_area_light("Key")
    key.lightgroup = "Own"
    if is_instanced:
        add_instancer(into_collection("Of key", key)).lightgroup = "Instancer's"
    assert bpy.context.view_layer.lightgroups.get("Own") is None
    assert [light.group for light in scene_parts.prepare()[2].lights] == ["Own"]


def test_of_nested_instancers_the_outermost_gives_group_and_lobes(tmp_path):
    start()
    inner = add_instancer(into_collection("Of light", scene_parts.add_area_light()), "Inner")
    inner.lightgroup, inner.visible_diffuse = "Inner", False
    outer = add_instancer(into_collection("Of inner", inner), "Outer")
    outer.lightgroup, outer.visible_glossy = "Outer", False
    prepared = scene_parts.prepare()
    (light,) = prepared[2].lights
    assert (light.group, light.affects_diffuse, light.affects_specular) == ("Outer", True, False)
    images = scene_parts.reference(tmp_path, prepared, 64)
    # Rays that sample the diffuse lobe leave a trace in the other, 0.2 % here.
    everything = shade(scene_parts.sample(tmp_path, prepared)[0][0][0], [light], "ltsh4")
    assert images["diffuse"].sum() / 2.0 == pytest.approx(everything.diffuse.sum(), rel=0.01)
    assert images["specular"].sum() < 0.01 * images["diffuse"].sum() and not everything.specular.any()
