"""Area lights read from Blender shine as they do in Cycles; what is not shaded is named."""

import json
import math

import bpy
import numpy as np
import pytest
import quadrature
import scene_parts
from lit_plane import measured

from ltsh_addon.scene import EllipseLight, PolygonLight, SurfaceSamples, light_of

LAMBERT = "ShaderNodeBsdfDiffuse"
CASES = {
    "square": {"shape": "SQUARE"},
    "rectangle, exposure, color": {"shape": "RECTANGLE", "exposure": 1.5, "color": (1.0, 0.4, 0.2)},
    "disk, not normalized": {"shape": "DISK", "normalize": False},
    "ellipse, temperature": {"shape": "ELLIPSE", "use_temperature": True, "temperature": 3000.0},
    "scaled rectangle": {"scale": (2.0, 0.5, 3.0)},
    "scaled ellipse, not normalized": {"shape": "ELLIPSE", "scale": (0.6, 1.7, 1.0), "normalize": False},
    "mirrored": {"scale": (-2.0, 1.0, 1.0)},
    "mirrored twice": {"scale": (-1.0, -1.0, 1.0)},
    "turned round by a negative z scale": {"rotation": (math.pi, 0.0, 0.0), "scale": (1.0, 1.0, -1.0)},
}


def plane_under(folder, samples=128, **light):
    """A white Lambert plane under one area light: (light inventory, warnings, surface samples, halves (2, P, 3))."""
    scene_parts.empty_scene(16, 16)
    scene_parts.add_camera()
    material, _ = scene_parts.bsdf_material(LAMBERT, Color=(1.0, 1.0, 1.0, 1.0))
    scene_parts.add_plane(material, size=12.0)
    scene_parts.add_area_light(**light)
    prepared, surface, halves = measured(folder, samples)
    return prepared[2], prepared[3], surface, halves["diffuse"]


@pytest.mark.parametrize("name", CASES)
def test_radiance_shape_and_scale_are_those_of_cycles(tmp_path, name):
    inventory, _, surface, halves = plane_under(tmp_path, **CASES[name])
    assert len(inventory.lights) == 1 and len(surface) == 256 and halves.any()
    expected = quadrature.radiance(surface, inventory.lights, quadrature.lambert, count=32)
    # Monte Carlo noise of the sum at 128 samples and 256 pixels is 2e-4; a wrong factor is at least some per cent.
    assert abs(quadrature.bias(expected, halves)) < 2e-3
    assert quadrature.relative_l2(expected, halves) < 3e-3


def test_what_is_not_shaded_is_named_and_left_out(tmp_path):
    scene_parts.empty_scene(16, 16)
    scene_parts.add_camera()
    scene_parts.add_plane(scene_parts.bsdf_material(LAMBERT, Color=(1.0, 1.0, 1.0, 1.0))[0])
    scene_parts.add_area_light("Key")
    scene_parts.add_area_light("Flat", scale=(1.0, 0.0, 1.0))
    scene_parts.link(scene_parts.new_light("Torn", "SPOT"), location=(0.0, 0.0, 2.0), scale=(1.0, 0.0, 1.0))
    (_, _, inventory, warnings), surface, halves = measured(tmp_path, 128)
    text = "\n".join(warnings)
    for name in ("'Flat'", "'Torn'"):
        assert text.count(name) == 1, text
    assert [light.name for light in inventory.lights] == ["Key"]
    expected = quadrature.radiance(surface, inventory.lights, quadrature.lambert, count=32)
    assert abs(quadrature.bias(expected, halves["diffuse"])) < 2e-3


def test_a_sheared_light_is_named_and_a_narrow_one_left_out():
    scene_parts.empty_scene()
    scene_parts.add_camera()
    scene_parts.add_plane()
    scene_parts.add_area_light("Laser", spread=0.0)
    parent = scene_parts.link(bpy.data.objects.new("Parent", None), scale=(1.0, 3.0, 1.0))
    scene_parts.add_area_light("Sheared").parent = parent
    _, _, inventory, warnings = scene_parts.prepare()
    assert [light.name for light in inventory.lights] == ["Sheared"] and len(inventory.warnings) == 2
    for name, word in {"Laser": "spread is 0 degrees", "Sheared": "% off near it"}.items():
        assert any(f"light {name!r}" in line and word in line for line in warnings), warnings


@pytest.mark.parametrize("shape", ["RECTANGLE", "ELLIPSE"])
@pytest.mark.parametrize("degrees", [20.0, 60.0, 150.0])
def test_spread_is_that_of_cycles(tmp_path, shape, degrees):
    inventory, warnings, surface, halves = plane_under(tmp_path, samples=512, shape=shape, spread=math.radians(degrees))
    assert inventory.lights[0].spread == pytest.approx(math.radians(degrees)) and warnings == []
    # The edge of the narrow cone needs finer patches than the light's own edge.
    expected = quadrature.radiance(surface, inventory.lights, quadrature.lambert, count=128)
    assert abs(quadrature.bias(expected, halves)) < 2e-3 and quadrature.relative_l2(expected, halves) < 3e-3


def test_light_records_survive_json():
    """Every field of a light comes back bit for bit from the child's manifest."""
    corners = np.random.default_rng(4).normal(size=(5, 3))
    placed = {"center": [0.1, 0.2, 1.0 / 3.0], "half_u": [0.5, 0, 0], "half_v": [0, 0.25, 0], "direction": [0, 0, -1.0]}
    more = {"group": "Keys", "affects_diffuse": False, "corners": corners, "receivers": (0, 3)}
    light = PolygonLight("L\u00e4mpchen", **placed, radiance=[1e-9, 2.0, 3e9], **more)
    found = light_of(json.loads(json.dumps(light.record())))
    for name, value in vars(light).items():
        assert np.array_equal(getattr(found, name), value) and type(getattr(found, name)) is type(value), name
    plain = EllipseLight("L", **placed, radiance=[1.0, 1.0, 1.0], spread=1.0 / 7.0)
    found = light_of(json.loads(json.dumps(plain.record())))
    assert found.corners is None and found.receivers is None and found.spread == 1.0 / 7.0


@pytest.mark.parametrize("rays", ["glossy", "diffuse"])
def test_visibility_is_kept_and_named(rays):
    """Cycles does not keep the lobes apart where a surface has both."""
    scene_parts.empty_scene()
    scene_parts.add_camera()
    scene_parts.add_plane()
    setattr(scene_parts.add_area_light("Key"), f"visible_{rays}", False)
    _, _, inventory, warnings = scene_parts.prepare()
    (light,) = inventory.lights
    assert sum(f"'Key': it is hidden from {rays} rays" in line for line in warnings) == 1
    assert (light.affects_diffuse, light.affects_specular) == (rays == "glossy", rays == "diffuse")


@pytest.mark.parametrize("rays", ["glossy", "diffuse"])
def test_a_world_that_some_rays_do_not_see_is_named(rays):
    """Without a word specular light of a glossy floor was 91 % off."""
    scene = scene_parts.empty_scene()
    scene_parts.add_camera()
    scene_parts.add_plane()
    scene_parts.add_white_world()
    setattr(scene.world.cycles_visibility, rays, False)
    warnings = scene_parts.prepare()[3]
    assert sum(f"it is hidden from {rays} rays" in line and "35 % of specular" in line for line in warnings) == 1


def test_the_oracle_reproduces_the_form_factor_of_a_parallel_disk():
    """A point under the center of a disk of radius r at height h receives pi r^2 / (r^2 + h^2) per unit radiance."""
    up, one = np.array([[0.0, 0.0, 1.0]]), np.ones(1)
    zero = np.zeros((1, 3))
    point = SurfaceSamples(zero, up, up, up, one, zero, zero, one, one, np.pi * np.ones((1, 3)))
    disk = EllipseLight("d", [0, 0, 2.0], [0.5, 0, 0], [0, 0.5, 0], [0, 0, -1.0], [1.0, 1.0, 1.0])
    found = quadrature.radiance(point, [disk], quadrature.lambert)[0, 0]
    assert found == pytest.approx(math.pi * 0.25 / 4.25, rel=1e-4)
