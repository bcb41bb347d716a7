"""What blocks light blocks it as in Cycles, from the file to the picture: a row of bays side by side in one comparison,
and bakes."""

import math

import bake_scenes
import bpy
import numpy as np
import pytest
import scene_parts
from lit_plane import add_lamp_ball
from material_scenes import Build

from ltsh_addon import imaging
from ltsh_addon.pipeline import PictureOptions, compare_scene

BAY, PIXELS = 2.4, 24  # m, and pixels of a side
# Of the light that arrives in a bay, in each pass, beyond the noise of both sides.
MOST_BIAS = {"specular": 0.02, "diffuse": 0.005}


def cube(x, y=0.0, size=0.5, **settings):
    """A cube in the way of the light of the bay at `x`."""
    bpy.ops.mesh.primitive_cube_add(size=size, location=(x, y, 0.7), rotation=(0.3, 0.2, 0.5))
    ob = bpy.context.object
    for name, value in settings.items():
        setattr(ob, name, value)
    return ob


def pane(x, material, size=0.8):
    ob = scene_parts.add_plane(material, size=size, name="Pane", location=(x, 0.0, 0.7), rotation=(0.2, 0.1, 0.3))
    ob.visible_camera = False
    return ob


def linked(x, light):
    """Two cubes, of which the light ignores one."""
    free, collection = cube(x - 0.4), bpy.data.collections.new("Blockers")
    cube(x + 0.4)
    collection.objects.link(free)
    collection.collection_objects[-1].light_linking.link_state = "EXCLUDE"
    light.light_linking.blocker_collection = collection


def leaf(x):
    image = bpy.data.images.new("Leaf", 8, 8, alpha=True)
    pixels = np.ones((8, 8, 4), np.float32)
    pixels[..., 3] = np.random.default_rng(1).integers(0, 3, (8, 8)) / 2.0
    image.pixels.foreach_set(pixels.ravel())
    image.pack()
    made = Build("Leaf")
    inside, texture = made.shader("BsdfPrincipled"), made.new("ShaderNodeTexImage")
    texture.image = image
    made.link(texture.outputs["Alpha"], inside.node.inputs["Alpha"])
    made.show(inside)
    pane(x, made.material)


def half_clear(x):
    made = Build("Half")
    made.show(made.mix(made.value(0.5), made.leaf(0.5), made.shader("BsdfTransparent")))
    return pane(x, made.material)


def lamp(x):
    """A mesh that lights what is below and blocks what is above it, and a cube in its own light."""
    material = scene_parts.bsdf_material("ShaderNodeEmission", "Lamp", Strength=12.0)[0]
    pane(x, material, 0.5).rotation_euler = (math.pi, 0.0, 0.0)
    cube(x + 0.2, size=0.2).location.z = 0.3


def choices(x, light, shadow, met, **settings):
    """A sharp reflection of the light, and something in front of it."""
    scene_parts.add_plane(scene_parts.principled("Sharp", Roughness=0.15)[0], BAY, "Sharp", location=(x, 0.0, 0.01))
    front = pane(x, None, 0.5)
    front.location.y = -0.5
    for name, value in settings.items():
        setattr(front, name, value)
    light.data.use_shadow, light.data.cycles.use_multiple_importance_sampling = shadow, met


def other_kind(light, **settings):
    """A point, spot or sun light in the place of an area light."""
    light.data.type = settings.pop("kind")
    for name, value in settings.items():
        setattr(light.data, name, value)


BAYS = {
    "holdout": lambda x, light: cube(x, is_holdout=True),
    "seen, without a shadow": lambda x, light: cube(x, visible_shadow=False),
    "unseen, with a shadow": lambda x, light: cube(x, visible_camera=False),
    "blockers of a light": linked,
    "glass": lambda x, light: pane(x, scene_parts.bsdf_material("ShaderNodeBsdfGlass", "Glass")[0]),
    "alpha of an image": lambda x, light: leaf(x),
    "half transparent": lambda x, light: half_clear(x),
    "mesh that emits": lambda x, light: lamp(x),
    "light without a shadow": lambda x, light: choices(x, light, shadow=False, met=True),
    "light that no surface chooses": lambda x, light: choices(x, light, shadow=True, met=False),
    "point": lambda x, light: (other_kind(light, kind="POINT", shadow_soft_size=0.15), cube(x)),
    "point without a radius": lambda x, light: (other_kind(light, kind="POINT", shadow_soft_size=0.0), cube(x)),
    "spot": lambda x, light: (other_kind(light, kind="SPOT", spot_size=1.3, shadow_soft_size=0.1), cube(x, size=0.3)),
    "blocks for surfaces": lambda x, light: choices(x, light, shadow=True, met=True, visible_shadow=False),
    "blocks for lights": lambda x, light: choices(
        x, light, shadow=True, met=True, visible_diffuse=False, visible_glossy=False
    ),
    "light that is never blocked": lambda x, light: choices(x, light, shadow=False, met=False),
}
FAINT = ("diffuse", "light without a shadow"), ("diffuse", "blocks for surfaces")
UNBLOCKED = "seen, without a shadow", "light that is never blocked"


def build():
    """All bays along x, each with a light of its own over a floor that reflects, seen from above at a slant."""
    scene_parts.empty_scene(PIXELS * len(BAYS), PIXELS)
    width = BAY * len(BAYS)
    floor = scene_parts.principled("Floor", Roughness=0.4)[0]
    scene_parts.add_plane(floor, size=2.0 * width, name="Floor")
    camera = scene_parts.add_camera((0.0, -5.0, 6.0), (0.7, 0.0, 0.0))
    camera.data.type, camera.data.ortho_scale = "ORTHO", width
    for number, add in enumerate(BAYS.values()):
        x = BAY * (number + 0.5) - 0.5 * width
        light = scene_parts.add_area_light(f"Light {number}", (x, 0.3, 1.6), (-0.2, 0.1, 0.3), size=0.4, size_y=0.3)
        light.data.energy, light.data.spread = 20.0, 2.4
        add(x, light)


def bias(found, halves):
    """Relative error beside the mean of two independent halves, without their noise, and its standard deviation."""
    products = ((found - halves[0]) * (found - halves[1])).sum(axis=-1)
    power = np.square(halves.mean(axis=0)).sum()
    squared, deviation = products.sum() / power, np.sqrt(np.square(products).sum()) / power
    return squared, deviation


@pytest.fixture(scope="module")
def comparison(tmp_path_factory):
    folder = tmp_path_factory.mktemp("bays")
    build()
    path = scene_parts.save(folder / "bays.blend")
    options = {"techniques": ("ltsh4",), "cycles_samples": 256, "shadow_rays": 1024}
    report = compare_scene(PictureOptions(scene=path, output=folder, **options))
    return report, imaging.read_layers(folder / "compare.exr")


@pytest.mark.newest
@pytest.mark.parametrize("name", BAYS)
def test_each_blocker_has_the_shadow_that_it_has_in_cycles(comparison, name):
    report, layers = comparison
    number = list(BAYS).index(name)
    bay = slice(None), slice(number * PIXELS, (number + 1) * PIXELS)
    for part, most in MOST_BIAS.items():
        halves = np.stack([layers[f"cycles_{half}.{part}"][bay] for half in "AB"])
        squared, deviation = bias(layers[f"ltsh4.{part}"][bay], halves)
        own = report["shadows"]["noise"][part]
        assert squared - 3.0 * deviation < most**2 + own**2
        unshadowed, _ = bias(layers[f"ltsh4_unshadowed.{part}"][bay], halves)
        if name not in UNBLOCKED and (part, name) not in FAINT:
            assert unshadowed > 0.1**2, "this bay has no shadow to speak of"


def test_a_lamp_of_many_faces_has_the_shadows_that_it_has_in_cycles(tmp_path):
    """Its faces share their rays; on a smooth ball some rays start elsewhere for the light than for the surface."""
    scene_parts.empty_scene(48, 32)
    scene_parts.add_camera((0.0, -3.5, 3.0), (0.85, 0.0, 0.0))
    scene_parts.add_plane(scene_parts.principled("Floor", Roughness=0.4)[0], size=6.0, name="Floor")
    scene_parts.add_sphere(scene_parts.principled("Ball", Roughness=0.4)[0], 0.5, location=(-0.8, 0.0, 0.5))
    cube(0.6, size=0.5)
    add_lamp_ball(segments=16, location=(0.0, 0.8, 1.6))
    path = scene_parts.save(tmp_path / "lamp.blend")
    options = {"techniques": ("ltsh4",), "cycles_samples": 256, "shadow_rays": 256, "sub_samples": 4}
    report = compare_scene(PictureOptions(scene=path, output=tmp_path, **options))
    layers = imaging.read_layers(tmp_path / "compare.exr")
    (lamp,) = report["lights"]
    assert lamp["patches"] > 64 and "visibility.diffuse@Lamp" in layers
    for part, most in MOST_BIAS.items():
        halves = np.stack([layers[f"cycles_{half}.{part}"] for half in "AB"])
        squared, deviation = bias(layers[f"ltsh4.{part}"], halves)
        own = report["shadows"]["noise"][part]
        assert squared - 3.0 * deviation < most**2 + own**2, part
        assert bias(layers[f"ltsh4_unshadowed.{part}"], halves)[0] > 0.05**2


@pytest.mark.newest
@pytest.mark.parametrize("most", (2, 3))
def test_more_panes_than_the_bounces_of_the_file_block_as_in_cycles(most, tmp_path):
    """Three panes between a floor and its light: in pictures and bakes, Transparent Max Bounces is that of the file."""
    scene_parts.empty_scene(12, 8)
    bpy.context.scene.cycles.transparent_max_bounces = most
    floor = scene_parts.add_plane(scene_parts.principled("Floor", Roughness=0.5)[0], size=1.0, name="Floor")
    scene_parts.add_camera((0.0, -1.5, 1.5), (0.8, 0.0, 0.0))
    scene_parts.add_area_light("Light", (0.0, 0.3, 2.0), (-0.2, 0.0, 0.0), size=0.3)
    for number in range(3):
        half_clear(0.0).location.z = 0.5 + 0.2 * number
    for ob in bpy.data.objects:
        ob.scale *= 5.0 if ob.name.startswith("Pane") else 1.0
    path = scene_parts.save(tmp_path / "panes.blend")
    options = {"cycles_samples": 64, "shadow_rays": 16}
    compare_scene(PictureOptions(scene=path, output=tmp_path, techniques=("ltsh4c",), **options))
    baked = bake_scenes.baked(path, tmp_path / "bake", shadows="on", error=True, objects=(floor.name,), **options)
    for layers in (imaging.read_layers(tmp_path / "compare.exr"), baked[1]["Floor.exr"]):
        expected = np.mean([layers[f"cycles_{half}.diffuse"] for half in "AB"])
        assert layers["ltsh4c.diffuse"].mean() == pytest.approx(expected, rel=0.02)  # noise of Cycles
        assert (expected > 0.0) == (most == 3)


def test_what_a_curved_surface_chooses_starts_at_its_faces_as_in_cycles_bake(tmp_path):
    """Light that falls along a face passes a fence for rays that the light chose, which start above the curved
    surface, and is blocked for those that the surface chose."""
    scene_parts.empty_scene()
    face = scene_parts.add_plane(scene_parts.principled(Roughness=0.35, Metallic=1.0)[0], size=2.0, name="Face")
    face.data.polygons.foreach_set("use_smooth", [True])
    corners = np.array([(-1, -1, 3), (1, -1, 3), (1, 1, 3), (-1, 1, 3)]) / math.sqrt(11.0)
    face.data.normals_split_custom_set(corners.tolist())
    scene_parts.add_plane(size=1.0, name="Fence", location=(1.3, 0.0, 0.0), rotation=(0.0, math.pi / 2, 0.0))
    bpy.data.objects["Fence"].scale = (0.12, 6.0, 1.0)
    scene_parts.add_camera((-3.0, 0.0, 0.8))
    scene_parts.add_area_light(location=(3.0, 0.0, 0.2), rotation=(0.0, math.pi / 2, 0.0), size=0.3, size_y=2.0)
    path = scene_parts.save(tmp_path / "face.blend")
    options = {"shadows": "on", "shadow_rays": 256, "error": True, "cycles_samples": 256, "objects": ("Face",)}
    layers = bake_scenes.baked(path, tmp_path / "bake", **options)[1]["Face.exr"]
    halves = np.stack([layers[f"cycles_{half}.specular"] for half in "AB"])
    squared, _ = bias(layers["ltsh4c.specular"], halves)
    # Measured: 2.5 %, mostly LTSH4C's own; 42 % where all rays start above the surface.
    assert squared < 0.04**2
