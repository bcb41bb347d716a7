"""Samples lie where Cycles' camera rays end, with the normals Cycles shades with."""

import math
from contextlib import nullcontext

import bpy
import numpy as np
import pytest
import quadrature
import scene_parts
from lit_plane import add_instancer, into_collection
from scene_parts import add_bump, add_node, add_plane, add_sphere, bsdf_material, principled

from ltsh_addon.blender import render_settings
from ltsh_addon.cycles import gbuffer, horizons, lobes
from ltsh_addon.cycles.horizons import end_at_horizons_of_cycles
from ltsh_addon.shading import shade


def from_above(**light):
    """A camera that sees 6 m from above, and a light."""
    scene_parts.empty_scene()
    scene_parts.add_top_camera(width=6.0)
    scene_parts.add_area_light(**light)


def test_one_sample_per_pixel_is_at_the_center(tmp_path):
    from_above()
    add_plane(principled()[0], size=12.0)
    ((surface, pixel, _),), _ = scene_parts.sample(tmp_path, scene_parts.prepare())
    width, height = scene_parts.SIZE
    row, column = np.divmod(pixel, width)
    expected = np.stack([(column + 0.5 - width / 2.0), (height / 2.0 - row - 0.5)], axis=-1) * 6.0 / width
    # The narrowest filter moves samples by less than 1e-3 of a pixel of 0.25 m.
    assert np.abs(surface.position[:, :2] - expected).max() < 2.5e-4
    assert np.array_equal(np.sort(pixel), np.arange(width * height))
    assert np.allclose(surface.view, (0.0, 0.0, 1.0), atol=1e-6)


def test_what_is_seen_does_not_depend_on_the_light_objects(tmp_path):
    """Nothing that samples hold is light: the same bits are written without lamps, which are there afterwards."""
    from_above(location=(0.5, 0.0, 3.0))
    add_plane(principled(Roughness=0.4)[0], size=12.0)
    material, node = principled(Metallic=1.0)
    add_bump(material.node_tree, node)
    add_sphere(material, radius=0.8, location=(0.0, 0.0, 0.8))
    prepared = scene_parts.prepare()
    scene, found = prepared[0], []
    for lights in (nullcontext(), render_settings.without_lights(scene)):
        folder = tmp_path / str(len(found))
        folder.mkdir()
        with lights:
            _, channels = scene_parts.sample(folder, prepared, sub_samples=2)
        found.append([{name: own[name] for name in own if "Combined" not in name} for own in channels])
    for one, other in zip(*found, strict=True):
        assert one.keys() == other.keys() and all(np.array_equal(one[name], other[name]) for name in one)
    assert not any(ob.hide_render for ob in scene.objects)


def test_sub_samples_fill_the_pixel_evenly_and_differ(tmp_path):
    from_above()
    material, node = principled()
    coordinates = material.node_tree.nodes.new("ShaderNodeTexCoord")
    material.node_tree.links.new(coordinates.outputs["UV"], node.inputs["Base Color"])
    node.inputs["Metallic"].default_value = 1.0
    add_plane(material, size=6.0)
    bpy.context.scene.cycles.pixel_filter_type = "BOX"
    count = 6
    renders, _ = scene_parts.sample(tmp_path, scene_parts.prepare(), sub_samples=count)
    width, height = scene_parts.SIZE
    offsets = []
    for surface, pixel, unusable in renders:
        row, column = np.divmod(pixel, width)
        x = surface.position[:, 0] * width / 6.0 - (column - width / 2.0)
        y = -surface.position[:, 1] * width / 6.0 - (row - height / 2.0)
        offsets.append(np.stack([x, y], axis=-1))
        # Everything in one render belongs to the same hit.
        assert np.abs(surface.specular_f0[:, :2] - (surface.position[:, :2] / 6.0 + 0.5)).max() < 2e-6 and unusable == 0
    offsets = np.array(offsets)
    assert offsets.min() > -1e-4 and offsets.max() < 1.0 + 1e-4
    spread = np.abs(offsets[:, None] - offsets[None, :]).max(axis=(-2, -1)) + np.eye(count)
    assert spread.min() > 0.1
    joined, film = gbuffer.join([(surface, pixel) for surface, pixel, _ in renders], width, height)
    assert film.sub_samples == count and len(joined) == count * width * height and np.all(film.coverage() == 1.0)


@pytest.mark.parametrize("correction", [True, False])
@pytest.mark.parametrize("kind", ["bumps", "coarse sphere"])
def test_specular_normals_are_those_cycles_shades_with(tmp_path, kind, correction):
    """On a metal the Normal pass is the normal of the one closure, after Cycles has bent it.

    On a coarse sphere the smooth normal alone makes reflections enter the surface.
    """
    scene_parts.empty_scene(64, 36)
    scene_parts.add_area_light()
    material, node = principled(Metallic=1.0, Roughness=0.3)
    material.cycles.use_bump_map_correction = correction
    if kind == "bumps":
        scene_parts.add_camera()
        add_bump(material.node_tree, node, scale=5.0, distance=1.0)
        add_plane(material)
        add_sphere(material, location=(0.0, 0.0, 0.8))
    else:
        scene_parts.add_camera((0.0, -3.0, 1.0), (1.45, 0.0, 0.0))
        add_sphere(material, radius=1.0, location=(0.0, 0.0, 0.6), segments=10)
    ((surface, pixel, _),), (channels,) = scene_parts.sample(tmp_path, scene_parts.prepare(), extra_passes=("normal",))
    cycles = lobes.read_layer(channels, "Normal", "XYZ").reshape(-1, 3)[pixel]
    difference = np.abs(surface.normal - cycles).max(axis=-1)
    bent = np.abs(surface.diffuse_normal - cycles).max(axis=-1) > (1e-3 if kind == "bumps" else 1e-2)
    assert np.count_nonzero(bent) > (500 if kind == "bumps" else 20) if correction else not bent.any()
    # Cycles bends in float32, which costs up to 1e-4 where the threshold cancels.
    assert difference.max() < (3e-4 if kind == "bumps" else 1e-5) and np.quantile(difference, 0.99) < 1e-5


def test_every_ray_of_the_reference_hits_what_the_sample_hits(tmp_path):
    """A color edge runs 0.001 pixel beside a column of pixel centers."""
    from_above(location=(0.0, 0.0, 3.0), rotation=(0.0, 0.0, 0.0))
    material, node = bsdf_material("ShaderNodeBsdfDiffuse")
    tree = material.node_tree
    geometry, above = tree.nodes.new("ShaderNodeNewGeometry"), tree.nodes.new("ShaderNodeMath")
    separate = tree.nodes.new("ShaderNodeSeparateXYZ")
    tree.links.new(geometry.outputs["Position"], separate.inputs[0])
    tree.links.new(separate.outputs[0], above.inputs[0])
    above.operation = "GREATER_THAN"
    # An edge 0.001 pixel (of 0.25 m) right of a column of pixel centers.
    above.inputs[1].default_value = 0.125 + 0.25 * 0.001
    tree.links.new(above.outputs[0], node.inputs["Color"])
    add_plane(material, size=12.0)
    prepared = scene_parts.prepare()
    ((surface, _, _),), _ = scene_parts.sample(tmp_path, prepared)
    column = surface.diffuse_albedo[:, 0].reshape(16, 24)[:, 12]
    halves = scene_parts.reference(tmp_path, prepared, 512)["diffuse"]
    lit = halves[:, :, 13, 0].mean()
    assert not column.any() and lit > 0.0
    # 1 ray in 1000 strays, and to the left; with Blender's narrowest filter a third would cross the edge.
    assert halves[:, :, 12].max() < 0.01 * lit


@pytest.mark.parametrize("shape", ["plane", "sphere"])
def test_bump_mapped_diffuse_lobes_are_shadowed_as_in_cycles(tmp_path, shape):
    """They end at the horizon of the smooth normal, and are shadowed by `bump_alpha2` as well."""
    scene_parts.empty_scene(24, 14)
    scene_parts.add_camera()
    scene_parts.add_area_light(location=(2.5, 0.0, 1.0), rotation=(0.0, 1.2, 0.0))
    material, node = bsdf_material("ShaderNodeBsdfDiffuse", Color=(1.0, 1.0, 1.0, 1.0))
    add_bump(material.node_tree, node, scale=4.0, distance=0.15)
    add_plane(material) if shape == "plane" else add_sphere(material, radius=1.3)
    prepared = scene_parts.prepare()
    lights = prepared[2].lights
    ((surface, pixel, _),), (channels,) = scene_parts.sample(tmp_path, prepared)
    smooth = lobes.read_aov(channels, "smooth_normal").reshape(-1, 3)[pixel].astype(np.float64)
    alpha2 = horizons.bump_alpha2(surface.diffuse_normal, smooth)[:, None]

    def shadowing(directions):
        cosine = np.einsum("psk,pk->ps", directions, smooth)
        tangent2 = 1.0 / np.maximum(cosine, 1e-6) ** 2 - 1.0
        return np.where(cosine > 0.0, 2.0 / (1.0 + np.sqrt(1.0 + alpha2 * tangent2)), 0.0)

    halves = scene_parts.reference(tmp_path, prepared, 512)["diffuse"].reshape(2, -1, 3)[:, pixel]
    shadowed = quadrature.radiance(surface, lights, quadrature.lambert, weight=shadowing)
    plain = quadrature.radiance(surface, lights, quadrature.lambert)
    ended, index = end_at_horizons_of_cycles(surface, tuple(lights))
    shaded = shade(ended, lights, "reference", passes=("diffuse",)).diffuse.sum(axis=0)[np.diff(index, prepend=-1) > 0]
    errors = [quadrature.relative_l2(image, halves) for image in (shadowed, plain, shaded)]
    # Rays of the reference wander by 0.01 pixel over the bumps; the sphere's silhouette adds the rest.
    assert errors[0] < 6e-3 < 2e-2 < errors[1] and abs(quadrature.bias(shadowed, halves)) < 3e-3
    # The shading takes the shadowing at the mean direction of the light, which removes nine tenths of the 11 % on the
    # sphere.
    assert errors[2] < 0.25 * errors[1]


BEHIND = {
    "diffuse": ("ShaderNodeBsdfDiffuse", {}, True),
    "rough": ("ShaderNodeBsdfDiffuse", {"Roughness": 0.7}, True),
    "uncorrected": ("ShaderNodeBsdfDiffuse", {}, False),
    "sheen": ("ShaderNodeBsdfSheen", {}, False),
    "principled": ("ShaderNodeBsdfPrincipled", {}, False),
}


@pytest.mark.parametrize("height", [-0.3, 0.2])
@pytest.mark.parametrize("kind", BEHIND)
def test_diffuse_lobes_whose_normals_are_behind_the_surface_are_black_as_in_cycles(tmp_path, kind, height):
    """A floor with a strong normal map was 29 % off, where normals of noise went behind it."""
    node_type, inputs, is_corrected = BEHIND[kind]
    scene_parts.empty_scene(8, 6)
    scene_parts.add_camera()
    scene_parts.add_area_light(location=(2.5, 0.0, 1.0), rotation=(0.0, 1.2, 0.0))
    material, node = bsdf_material(node_type, **inputs)
    bent = add_node(material.node_tree, "ShaderNodeCombineXYZ", X=0.9, Y=0.2, Z=height)
    material.node_tree.links.new(bent.outputs[0], node.inputs["Normal"])
    material.cycles.use_bump_map_correction = is_corrected
    add_plane(material)
    prepared = scene_parts.prepare()
    ((surface, _, _),), _ = scene_parts.sample(tmp_path, prepared)
    lit = scene_parts.reference(tmp_path, prepared, 4)["diffuse"].any()
    assert lit == surface.diffuse_albedo.any() == (height > 0.0)


def test_back_faces_show_their_normal_to_the_camera(tmp_path):
    from_above()
    add_plane(principled()[0], rotation=(math.pi, 0.0, 0.0))
    ((surface, _, _),), _ = scene_parts.sample(tmp_path, scene_parts.prepare())
    assert np.allclose(surface.normal, (0.0, 0.0, 1.0), atol=1e-6)
    assert np.allclose(surface.geometric_normal, (0.0, 0.0, 1.0), atol=1e-6)


def test_instances_are_sampled_with_their_own_materials(tmp_path):
    from_above()
    plane = add_plane(principled(Roughness=0.21)[0], size=1.5)
    collection = into_collection("Tiles", plane)
    for x in (-2.0, 2.0):
        add_instancer(collection, location=(x, 0.0, 0.5))
    prepared = scene_parts.prepare()
    ((surface, pixel, _),), _ = scene_parts.sample(tmp_path, prepared)
    assert 0 < len(surface) < 24 * 16 and np.allclose(surface.roughness, 0.21)
    assert np.allclose(np.abs(surface.position[:, 0]), 2.0, atol=0.75) and np.allclose(surface.position[:, 2], 0.5)
    halves = scene_parts.reference(tmp_path, prepared, 64)["diffuse"].reshape(2, -1, 3)
    outside = np.setdiff1d(np.arange(24 * 16), pixel)
    assert not halves[:, outside].any() and halves[:, pixel].min() > 0.0
