"""Point, spot and sun lights read from Blender shine as they do in Cycles."""

import math

import bpy
import numpy as np
import pytest
import quadrature
import scene_parts
from lit_plane import light_tree

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


def with_nodes(kind, make, **settings):
    """A light whose Emission has the strength of the output that make(tree) returns."""
    tree, emission = light_tree(add_light(kind, **settings))
    tree.links.new(make(tree), emission.inputs["Strength"])


def value(tree):
    node = tree.nodes.new("ShaderNodeValue")
    node.outputs[0].default_value = 0.4
    return node.outputs[0]


def falloff(tree):
    node = tree.nodes.new("ShaderNodeLightFalloff")
    node.inputs["Strength"].default_value, node.inputs["Smooth"].default_value = 0.5, 0.7
    return node.outputs["Linear"]


def stripes(tree):
    """Bright and dark by the direction in the frame of the light."""
    coordinates, separate, wave = (tree.nodes.new(f"ShaderNode{kind}") for kind in ("TexCoord", "SeparateXYZ", "Math"))
    wave.operation, wave.inputs[1].default_value, wave.inputs[2].default_value = "MULTIPLY_ADD", 0.9, 1.0
    tree.links.new(coordinates.outputs["Normal"], separate.inputs[0])
    tree.links.new(separate.outputs["X"], wave.inputs[0])
    return wave.outputs[0]


def lamp_of_files(tree):
    """A measured beam."""
    node = tree.nodes.new("ShaderNodeTexIES")
    node.mode, node.ies = "INTERNAL", bpy.data.texts.new("Beam")
    angles, power = np.arange(0, 181, 10), 1000.0 * np.exp(-np.square(np.arange(0, 181, 10) / 60.0))
    rows = ["IESNA:LM-63-1995", "TILT=NONE", f"1 -1 1 {len(angles)} 1 1 2 0 0 0", "1 1 100"]
    rows += [" ".join(f"{angle:g}" for angle in angles), "0", " ".join(f"{one:g}" for one in power)]
    node.ies.write("\n".join(rows))
    return node.outputs[0]


@pytest.mark.parametrize("kind", ["POINT", "SPOT", "SUN"])
@pytest.mark.parametrize("nodes", [value, falloff, stripes, lamp_of_files], ids=lambda nodes: nodes.__name__)
def test_nodes_of_points_are_those_of_cycles(tmp_path, kind, nodes):
    if kind == "SUN" and nodes is falloff:
        pytest.skip("what is infinitely far away has no falloff")
    plane_scene()
    settings = {"angle": 0.2, "energy": 3.0} if kind == "SUN" else {"shadow_soft_size": 0.2}
    with_nodes(kind, nodes, **settings)
    lights, warnings, surface, halves = rendered(tmp_path)
    # Of a sun the middle is taken, and that is said.
    assert (kind == "SUN" and nodes in (stripes, lamp_of_files)) == any(
        "'Sun': its emission" in line for line in warnings
    )
    middle = kind == "SUN" and nodes in (stripes, lamp_of_files)
    for technique, limit in (("reference", 5e-2 if middle else 6e-3), ("ltsh4", 5e-2 if middle else 1.5e-2)):
        found = shading.shade(surface, lights, technique, workers=1)
        for lobe in ("diffuse", "specular"):
            values = getattr(found, lobe)[0].astype(np.float64)
            assert quadrature.relative_l2(values, halves[lobe]) < limit, (technique, lobe)
            assert abs(quadrature.bias(values, halves[lobe])) < limit, (technique, lobe)
