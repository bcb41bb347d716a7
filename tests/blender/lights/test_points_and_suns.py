"""Point, spot and sun lights read from Blender shine as they do in Cycles."""

import math

import bpy
import numpy as np
import pytest
import quadrature
import scene_parts

from ltsh_addon import shading

SPOT = {"kind": "SPOT", "spot_size": 1.1, "spot_blend": 0.4}
SUN = {"kind": "SUN", "energy": 3.0}
CASES = {
    "point": {},
    "point, not normalized, exposure, color": {"normalize": False, "exposure": -2.0, "color": (1.0, 0.4, 0.2)},
    "point, soft falloff, temperature": {"use_soft_falloff": True, "use_temperature": True, "temperature": 3000.0},
    "point without a radius": {"shadow_soft_size": 0.0},
    "point without a radius, not normalized": {"shadow_soft_size": 0.0, "normalize": False},
    "point around the camera": {"shadow_soft_size": 30.0},
    "scaled point": {"scale": (2.0, 0.5, 3.0)},
    "spot": SPOT,
    "spot, soft falloff": {**SPOT, "use_soft_falloff": True},
    "spot without a radius": {**SPOT, "shadow_soft_size": 0.0},
    "spot without blend": {**SPOT, "spot_blend": 0.0, "shadow_soft_size": 0.05},
    "large spot": {**SPOT, "shadow_soft_size": 0.6, "spot_blend": 1.0},
    "scaled spot": {**SPOT, "scale": (1.6, 0.6, 1.2)},
    "mirrored spot": {**SPOT, "scale": (1.0, 1.0, -1.0), "rotation": (math.pi - 0.75, 0.1, 0.0)},
    "sun": {**SUN, "angle": 0.3},
    "wide sun": {**SUN, "angle": 2.5},
    "sun without an angle": {**SUN, "angle": 0.0},
    "sun, not normalized": {**SUN, "angle": 0.6, "normalize": False},
}


def add_light(kind="POINT", location=(0.2, 1.6, 1.6), rotation=(-0.75, 0.1, 0.2), scale=(1.0, 1.0, 1.0), **settings):
    """A light of 100 W with a radius of 20 cm, changed by `settings`."""
    light = bpy.data.lights.new(kind.title(), kind)
    light.energy = 100.0
    if kind != "SUN":
        light.shadow_soft_size, light.use_soft_falloff = 0.2, False
    for key, value in settings.items():
        setattr(light, key, value)
    return scene_parts.link(bpy.data.objects.new(kind.title(), light), location, rotation, scale)


def rendered(folder, samples=256):
    """A plane that is diffuse and glossy: (lights, warnings, samples, Cycles' halves (2, P, 3) by pass)."""
    prepared = scene_parts.prepare()
    ((surface, pixel, unusable),) = scene_parts.sample(folder, prepared)[0]
    assert unusable == 0
    images = scene_parts.reference(folder, prepared, samples)
    halves = {name: images[name].reshape(2, -1, 3)[:, pixel].astype(np.float64) for name in ("specular", "diffuse")}
    return prepared[2].lights, prepared[3], surface, halves


def plane_scene(roughness=0.4):
    scene_parts.empty_scene(20, 14)
    scene_parts.add_camera()
    scene_parts.add_plane(scene_parts.principled("Surface", Roughness=roughness, Metallic=0.3)[0], size=12.0)


@pytest.mark.parametrize("name", CASES)
def test_point_spot_and_sun_are_those_of_cycles(tmp_path, name):
    plane_scene()
    add_light(**CASES[name])
    # Light from everywhere is noisy.
    samples = 2048 if name in ("wide sun", "point around the camera") else 256
    lights, warnings, surface, halves = rendered(tmp_path, samples)
    assert len(lights) == 1 and warnings == []
    for technique, limit in (("reference", 3e-3), ("ltsh4", 1.5e-2)):
        found = shading.shade(surface, lights, technique, workers=1)
        for lobe in ("diffuse", "specular"):
            values = getattr(found, lobe)[0].astype(np.float64)
            assert quadrature.relative_l2(values, halves[lobe]) < limit, (technique, lobe)
            assert abs(quadrature.bias(values, halves[lobe])) < limit, (technique, lobe)
