"""What pictures show behind glass, beside Cycles, whose rays bend at it; comparisons leave it out and say so."""

import bpy
import numpy as np
import pytest
import scene_parts as parts

from ltsh_addon import imaging
from ltsh_addon.cycles.lobes import read_layer
from ltsh_addon.pipeline import PictureOptions, compare_scene, shade_scene

SIZE, POINTS, SAMPLES = (40, 24), 9, 256
COLOR = (0.5, 0.8, 0.9, 1.0)
# As deep as their height: the picture through a pane of this thickness moves by less than .1 pixels.
THIN = 0.01


def room():
    """A floor with stripes before a black world. Its light stands behind, so that no glass shadows or mirrors it."""
    scene = parts.empty_scene(*SIZE)
    scene.cycles.film_exposure = 1.3
    material, node = parts.bsdf_material("ShaderNodeBsdfDiffuse", "Floor")
    stripes = parts.add_node(material.node_tree, "ShaderNodeTexWave", Scale=0.5)
    material.node_tree.links.new(stripes.outputs["Color"], node.inputs["Color"])
    parts.add_plane(material, 8.0, "Floor")
    parts.add_area_light("Key", (0.0, 2.5, 3.0), (-0.7, 0.0, 0.0), energy=120.0, size=1.0, size_y=1.0)
    parts.add_camera((0.0, -4.0, 1.6), (1.25, 0.0, 0.0))
    return scene


def add_pane(material, thickness=THIN):
    """A wall of glass, of which the camera sees the floor behind alone."""
    sides = (0.0, thickness) if thickness else (0.0,)
    corners = [(x, y, z) for y in sides for x, z in ((-0.9, 0.3), (0.9, 0.3), (0.9, 1.2), (-0.9, 1.2))]
    faces = [(0, 1, 2, 3)]
    if thickness:
        faces += [(7, 6, 5, 4), *((one, one + 4, (one + 1) % 4 + 4, (one + 1) % 4) for one in range(4))]
    pane = parts.add_mesh("Pane", corners, faces, location=(0.0, -1.5, 0.0), rotation=(-0.2, 0.0, 0.3))
    pane.data.materials.append(material)


def glass(kind):
    """A material of glass, by the name of its node; "Mix": half of it matte, inside a group."""
    if kind == "Mix":
        material, node = parts.bsdf_material("ShaderNodeBsdfGlass", "Glass", Color=COLOR, Roughness=0.0, IOR=1.45)
        tree = material.node_tree
        matte = parts.add_node(tree, "ShaderNodeBsdfDiffuse", Color=(0.0, 0.0, 0.0, 1.0))
        mix = parts.add_node(tree, "ShaderNodeMixShader", **{"Fac": 0.25})
        output = next(one for one in tree.nodes if one.type == "OUTPUT_MATERIAL")
        for source, target in ((node, mix.inputs[1]), (matte, mix.inputs[2]), (mix, output.inputs["Surface"])):
            tree.links.new(source.outputs[0], target)
        return material
    if kind in ("Glass", "Refraction"):
        return parts.bsdf_material(f"ShaderNodeBsdf{kind}", "Glass", Color=COLOR, Roughness=0.0, IOR=1.5)[0]
    inputs = {"Base_Color": COLOR, "Roughness": 0.0, "Transmission_Weight": 0.9}
    return parts.principled("Glass", **inputs, **({"Thin_Wall": True} if kind == "Thin Wall" else {}))[0]


def rendered(folder):
    """Combined (H, W, 3) of the open scene by Cycles, in which light bounces at glass alone."""
    settings = dict.fromkeys(("max_bounces", "glossy_bounces", "transmission_bounces"), 12)
    off = ("diffuse_bounces", "caustics_reflective", "caustics_refractive", "sample_clamp_indirect")
    settings |= {**dict.fromkeys(off, 0), "pixel_filter_type": "BOX"}
    return read_layer(parts.cycles_channels(folder, SAMPLES, **settings), "Combined", "RGB").astype(float)


def shaded(folder, **options):
    """Report and layers of `shade` of the open scene."""
    bpy.context.scene.cycles.pixel_filter_type = "BOX"
    path = parts.save(folder / "room.blend")
    report = shade_scene(PictureOptions(path, output=folder, sub_samples=POINTS, **options))
    return report, imaging.read_layers(folder / "shade.exr")


@pytest.mark.parametrize("kind", ["Glass", "Principled", "Thin Wall", "Refraction", "Mix"])
def test_a_pane_shows_the_floor_behind_it_as_in_cycles(tmp_path, kind):
    """Its share of the light within 1 %: the noise of the truth, and edges of stripes moved by the pane's thickness.
    What a thin wall reflects is shaded as of solid glass, and adds another .5 %."""
    room()
    if kind == "Thin Wall" and "Thin Wall" not in glass("Principled").node_tree.nodes["Principled BSDF"].inputs:
        pytest.skip("this Blender has no thin walls")
    add_pane(glass(kind), 0.0 if kind == "Thin Wall" else THIN)
    report, layers = shaded(tmp_path)
    truth, is_glass = rendered(tmp_path), layers["coverage.glass"] > 0.999
    whole, transmitted = layers["ltsh4c.combined"][..., :3], layers["ltsh4c.transmitted"]
    limit = 0.015 if kind == "Thin Wall" else 0.01
    assert 0.15 < is_glass.mean() < 0.8
    np.testing.assert_allclose(whole[is_glass].mean(axis=0), truth[is_glass].mean(axis=0), rtol=limit)
    assert not transmitted[layers["coverage.glass"] == 0.0].any()
    rest = whole - layers["ltsh4c.specular"] - layers["ltsh4c.diffuse"] - transmitted
    assert np.abs(rest).max() < 1e-5 * whole.max()
    assert any("% of the picture shows glass: what is behind it is sharp" in line for line in report["warnings"])


@pytest.mark.newest
def test_a_ball_bends_what_is_behind_it_as_in_cycles(tmp_path):
    """Upside down: straight rays would be 100 % off. Left are edges of stripes, which two shapes of points place
    apart, and light that the ball reflects inside: .04 of it."""
    room()
    bpy.data.objects["Key"].visible_transmission = False
    parts.add_sphere(glass("Glass"), 0.7, segments=96, location=(0.0, -1.0, 0.9))
    _, layers = shaded(tmp_path)
    truth, is_ball = rendered(tmp_path), layers["coverage.glass"] > 0.999
    off = layers["ltsh4c.combined"][is_ball][:, :3] - truth[is_ball]
    assert is_ball.mean() > 0.15 and np.linalg.norm(off) < 0.15 * np.linalg.norm(truth[is_ball])


@pytest.mark.newest
def test_lights_and_the_world_are_seen_through_glass_as_rays_through_it_meet_them(tmp_path):
    """Lamps and worlds that hide from the camera are seen through glass if they are visible to transmission."""
    scene = room()
    world = parts.add_world(Color=(0.4, 0.2, 0.1, 1.0))[0]
    world.cycles_visibility.camera = False
    key = bpy.data.objects["Key"]
    key.visible_camera, key.location, key.rotation_euler = False, (0.0, 3.0, 0.2), (-np.pi / 2.0, 0.0, 0.0)
    add_pane(glass("Refraction"))
    scene.camera.rotation_euler[0] = 1.45
    _, layers = shaded(tmp_path, shadows="off")
    truth, is_glass = rendered(tmp_path), layers["coverage.glass"] > 0.999
    lamp = truth[..., 2] > 5.0
    assert (lamp & is_glass).sum() > 5
    np.testing.assert_allclose(
        layers["ltsh4c.combined"][..., :3][lamp].mean(axis=0), truth[lamp].mean(axis=0), rtol=0.02
    )
    dim = is_glass & (truth[..., 2] < 1.0)
    np.testing.assert_allclose(
        np.median(layers["ltsh4c.combined"][..., :3][dim], axis=0), np.median(truth[dim], axis=0), rtol=0.02
    )


@pytest.mark.newest
def test_glass_out_of_view_changes_nothing(tmp_path):
    room()
    _, plain = shaded(tmp_path, passes=("specular", "diffuse"))
    parts.add_sphere(glass("Glass"), 0.5, location=(0.0, -9.0, 9.0)).visible_shadow = False
    report, layers = shaded(tmp_path)
    assert plain.keys() == layers.keys() and not any("glass" in line for line in report["warnings"][:1])
    for name in ("ltsh4c.combined", "ltsh4c.diffuse"):
        np.testing.assert_array_equal(plain[name], layers[name])


@pytest.mark.newest
def test_a_comparison_leaves_out_light_through_glass_on_both_sides_and_marks_it(tmp_path):
    room()
    add_pane(glass("Principled"))
    path = parts.save(tmp_path / "room.blend")
    report = compare_scene(PictureOptions(path, output=tmp_path, cycles_samples=16))
    layers = imaging.read_layers(tmp_path / "compare.exr")
    is_glass = layers["coverage.glass"] == 1.0
    assert is_glass.mean() > 0.15 and "ltsh4c.transmitted" not in layers
    share = f"{100.0 * layers['coverage.glass'].mean():.3g} % of the picture shows glass: what is behind it is left out"
    assert any(line.startswith(share) for line in report["warnings"])
    for name in ("cycles", "ltsh4c"):
        assert layers[f"{name}.combined"][is_glass][:, :3].max() < 0.02 * layers[f"{name}.combined"].max()
