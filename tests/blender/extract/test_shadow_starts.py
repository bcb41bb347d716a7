"""Where shadow rays start, against Cycles: which points of a surface its own triangles hide from a light that is nearly
a point."""

import bpy
import numpy as np
import pytest
import scene_parts
from mathutils import Vector

from ltsh_addon.blender.extract import pixels
from ltsh_addon.blender.process.blender_process import embree_libraries
from ltsh_addon.visibility import open_tracer

LIGHT = np.array([1.5, -1.0, 2.5])
KINDS = {
    "ball": (lambda: bpy.ops.mesh.primitive_ico_sphere_add(subdivisions=2, radius=1.0), 0.1),
    "ball without offset": (lambda: bpy.ops.mesh.primitive_ico_sphere_add(subdivisions=2, radius=1.0), 0.0),
    "flat ball": (lambda: bpy.ops.mesh.primitive_ico_sphere_add(subdivisions=2, radius=1.0), 0.1),
    "grid": (lambda: bpy.ops.mesh.primitive_grid_add(x_subdivisions=7, y_subdivisions=5, size=3.0), 0.1),
    "monkey": (bpy.ops.mesh.primitive_monkey_add, 0.1),
    "monkey without offset": (bpy.ops.mesh.primitive_monkey_add, 0.0),
    "monkey of great offset": (bpy.ops.mesh.primitive_monkey_add, 0.5),
    "mirrored monkey": (bpy.ops.mesh.primitive_monkey_add, 0.1),
    "instance of a monkey": (bpy.ops.mesh.primitive_monkey_add, 0.1),
}


def start():
    """A camera and a small light; a white material."""
    scene_parts.empty_scene(60, 40)
    scene_parts.add_camera((0.0, -3.2, 0.6), (1.4, 0.0, 0.0))
    toward = (-Vector(LIGHT)).to_track_quat("-Z", "Y").to_euler()
    scene_parts.add_area_light("Key", LIGHT, toward, shape="SQUARE", size=2e-3, energy=1000.0)
    return scene_parts.bsdf_material("ShaderNodeBsdfDiffuse", "White", Color=(1.0, 1.0, 1.0, 1.0))[0]


def build(name):
    add, terminator = KINDS[name]
    white = start()
    add()
    ob = bpy.context.object
    ob.data.materials.append(white)
    ob.data.polygons.foreach_set("use_smooth", ["flat" not in name] * len(ob.data.polygons))
    ob.shadow_terminator_geometry_offset = terminator
    if "mirrored" in name:
        ob.scale = (1.2, 0.7, -1.1)
    if "instance" in name:
        scene_parts.link(ob.copy(), (0.0, 60.0, 0.0))
        ob.scale = (1.2, 0.7, 1.1)


def seen_by_cycles(folder, prepared, monkeypatch):
    """Shares (H * W,) of light that reaches what the pixels see, and a mask of those with light to compare."""
    with monkeypatch.context() as patch:
        patch.setattr(pixels, "remove_occlusion", lambda scene: None)
        shadowed = scene_parts.reference(folder, prepared, 2)["diffuse"].mean(axis=0).reshape(-1, 3)[:, 0]
    free = scene_parts.reference(folder, prepared, 2)["diffuse"].mean(axis=0).reshape(-1, 3)[:, 0]
    lit = free > 1e-4 * free.max()
    return shadowed / np.where(lit, free, 1.0), lit


def shares(tracer, origins):
    offset = LIGHT - origins
    distance = np.linalg.norm(offset, axis=1)
    return tracer.transmittance(origins, offset / distance[:, None], distance)


def both(folder, monkeypatch):
    """Shares that Cycles sees of the light, that rays see, and that they see from where a surface would be, all of the
    pixels that are lit; and the starts of the rays."""
    occluders, _ = scene_parts.collected_occluders()
    prepared = scene_parts.prepare()
    ((samples, pixel, _),), _ = scene_parts.sample(folder, prepared)
    expected, lit = (values[pixel] for values in seen_by_cycles(folder, prepared, monkeypatch))
    directions = LIGHT - samples.position
    directions = (directions / np.linalg.norm(directions, axis=1)[:, None]).astype(np.float32)
    with open_tracer(occluders, embree_libraries()) as tracer:
        starts = tracer.ray_origins(samples)
        found = shares(tracer, starts.origins(np.arange(len(samples)), directions))
        plain = shares(tracer, samples.position + 1e-4 * samples.geometric_normal)
    assert lit.sum() > 300
    return expected[lit], found[lit], plain[lit], starts


@pytest.mark.parametrize("name", KINDS)
def test_a_surface_hides_itself_as_in_cycles(tmp_path, monkeypatch, name):
    build(name)
    expected, found, plain, starts = both(tmp_path, monkeypatch)
    is_smooth = "flat" not in name and "without" not in name and name != "grid"
    assert (starts.terminator > 0.0).mean() == pytest.approx(float(is_smooth), abs=0.01)
    # The light is 2 mm wide: a pixel of a monkey may be at the edge of the shadow of an ear.
    assert (np.abs(found - expected) > 0.02).sum() <= 2 * ("monkey" in name)
    if is_smooth:
        assert (np.abs(plain - expected) > 0.02).sum() > 30, "this surface shows no difference"


@pytest.mark.parametrize("data", [lambda: scene_parts.hair_curves(25), lambda: scene_parts.point_cloud(60)])
def test_hair_and_points_do_not_hide_themselves(tmp_path, monkeypatch, data):
    """Facets hide or show each other's rays near silhouettes, some 5 % of the pixels; without care all but some would
    be inside of their own tube."""
    white = start()
    ob = scene_parts.link(bpy.data.objects.new("Many", data()), (0.0, 0.0, -1.0))
    ob.data.materials.append(white)
    expected, found, plain, _ = both(tmp_path, monkeypatch)
    assert found.mean() == pytest.approx(expected.mean(), abs=0.05)
    assert (np.abs(found - expected) > 0.5).mean() < 0.08
    assert plain.mean() < expected.mean() - 0.15
