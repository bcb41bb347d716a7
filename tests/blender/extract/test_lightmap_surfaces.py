"""Bakes with bounced light of surfaces that easily leak or show seams: steps at seams, and surfaces beside Cycles."""

import bpy
import numpy as np
import pytest
from bake_scenes import SIZE, baked, save, start
from material_scenes import Build
from scene_parts import add_area_light, add_mesh, add_plane, add_sphere, add_world, principled

pytestmark = pytest.mark.newest
LIGHTMAP = {"shadows": "on", "bounces": "on", "view": "above"}


def lit_floor():
    """A floor, a red wall that light leaves for, a lamp and a dim world; chalk for more objects."""
    start(camera=None)
    bpy.data.objects["Key"].data.energy = 20.0
    add_plane(principled("White", Base_Color=(0.8, 0.8, 0.8, 1.0), Roughness=1.0)[0], size=2.0, name="Floor")
    add_world(Color=(0.1, 0.12, 0.15, 1.0))
    return principled("Chalk", Base_Color=(0.7, 0.7, 0.7, 1.0), Roughness=1.0)[0]


def seam_points(ob):
    """Places (2, Q, 2) in the UV map of points of smooth seams, on the one side and on the other."""
    shares, mesh, uv, sides = np.linspace(0.1, 0.9, 9), ob.data, ob.data.uv_layers.active.uv, {}
    for face in mesh.polygons:
        loops = list(face.loop_indices)
        for a, b in zip(loops, [*loops[1:], loops[0]], strict=True):
            ends = sorted((mesh.loops[one].vertex_index, *uv[one].vector) for one in (a, b))
            sides.setdefault((ends[0][0], ends[1][0]), []).append([end[1:] for end in ends])
    pairs = np.array([two for two in sides.values() if len(two) == 2])
    pairs = pairs[np.abs(pairs[:, 0] - pairs[:, 1]).max(axis=(1, 2)) > 1e-5]
    points = pairs[:, :, :1] + shares[:, None] * (pairs[:, :, 1:] - pairs[:, :, :1])
    return points.transpose(1, 0, 2, 3).reshape(2, -1, 2)


def looked_up(image, place):
    """Bilinear values (Q, 3) of a texture (H, W, 3), row 0 on top, as a program shows it that repeats no texture."""
    height, width = image.shape[:2]
    x, y = place[:, 0] * width - 0.5, (1.0 - place[:, 1]) * height - 0.5
    column, row = np.floor(x).astype(int), np.floor(y).astype(int)
    total = 0.0
    for right in (0, 1):
        for down in (0, 1):
            weight = np.abs(1 - right - (x - column)) * np.abs(1 - down - (y - row))
            texel = image[np.clip(row + down, 0, height - 1), np.clip(column + right, 0, width - 1)]
            total = total + weight[:, None] * texel
    return total


@pytest.mark.parametrize("kind", ["torus", "torus without a sky", "sphere"])
def test_steps_at_seams_are_below_a_hundredth_of_the_light(kind, tmp_path):
    chalk = lit_floor()
    if kind == "torus without a sky":
        bpy.context.scene.world = None
    if kind != "sphere":
        bpy.ops.mesh.primitive_torus_add(
            location=(0.0, 0.0, 0.5), major_radius=0.4, minor_radius=0.15, rotation=(1.2, 0.2, 0.0)
        )
        bpy.context.object.data.polygons.foreach_set("use_smooth", [True] * len(bpy.context.object.data.polygons))
        bpy.context.object.data.materials.append(chalk)
        bpy.context.object.name = "Round"
    else:
        add_sphere(chalk, radius=0.4, name="Round", location=(0.0, 0.0, 0.5))
    options = {"passes": ("diffuse_light",), "objects": ("Round",), "size": (128, 128), "margin": 8, **LIGHTMAP}
    _, files = baked(save(tmp_path), tmp_path / "out", **options)
    light, covered = files["Round.exr"]["ltsh4c.diffuse_light"], files["Round.exr"]["coverage.hit"] > 0.0
    one, other = (looked_up(light, side) for side in seam_points(bpy.data.objects["Round"]))
    mean = light[covered.reshape(light.shape[:2])].mean()
    steps = np.abs(one - other).max(axis=-1) / mean
    # A tenth of it was seen, a quarter in the dark without a sky.
    assert len(steps) > 500 and steps.max() < 0.01


def test_a_lightmap_is_the_sum_of_its_lights_at_seams_too(tmp_path):
    """Each is fitted, and kept from swinging below black, by itself."""
    chalk = lit_floor()
    bpy.ops.mesh.primitive_monkey_add(size=0.8, location=(0.0, 0.0, 0.5))
    bpy.context.object.name = "Many islands"
    bpy.context.object.data.polygons.foreach_set("use_smooth", [True] * len(bpy.context.object.data.polygons))
    bpy.context.object.data.materials.append(chalk)
    add_area_light("Side", (1.0, -1.0, 1.0), (0.9, 0.0, 0.8), size=0.05, size_y=0.05)
    options = {"passes": ("diffuse_light",), "objects": ("Many islands",), "per_light": True, "margin": 4}
    _, files = baked(save(tmp_path), tmp_path / "out", size=(128, 128), atlas=128, **options, **LIGHTMAP)
    (layers,) = files.values()
    whole = sum(layer.astype(float) for name, layer in layers.items() if "@" in name)
    # Half floats have 11 bits.
    assert np.abs(whole - layers["ltsh4c.diffuse_light"]).max() < 1e-3 * whole.max()


def normal_map():
    """A chalk whose normals an image tilts, by some 30 degrees at most."""
    made = Build("Tilted")
    picture = bpy.data.images.new("Tilts", 8, 8, is_data=True, float_buffer=True)
    tilts = np.random.default_rng(3).uniform(-0.4, 0.4, (64, 2))
    normals = np.stack([*tilts.T, np.sqrt(1.0 - np.square(tilts).sum(axis=1))], axis=1)
    picture.pixels.foreach_set(
        np.concatenate([0.5 + 0.5 * normals, np.ones((64, 1))], axis=1).astype(np.float32).ravel()
    )
    picture.pack()
    image, tilt = made.new("ShaderNodeTexImage"), made.new("ShaderNodeNormalMap")
    image.image = picture
    surface = made.shader("BsdfPrincipled", Roughness=1.0)
    surface.node.inputs["Base Color"].default_value = (0.7, 0.7, 0.7, 1.0)
    made.link(image.outputs["Color"], tilt.inputs["Color"])
    made.link(tilt.outputs["Normal"], surface.node.inputs["Normal"])
    made.show(surface)
    return made.material


def test_thin_boxes_walls_instances_and_normal_maps_have_the_light_of_cycles(tmp_path):
    chalk = lit_floor()
    # The lower side of a lid of 2 mm is dark, the upper one bright.
    bpy.ops.mesh.primitive_cube_add(size=0.6, location=(0.5, 0.5, 0.25), scale=(1.0, 1.0, 0.002 / 0.6))
    bpy.context.object.name = "Lid"
    bpy.context.object.data.materials.append(chalk)
    # A wall without thickness, and three faces that meet in one edge.
    corners = [(-0.8, 0.3, 0), (0.1, 0.3, 0), (0.1, 0.3, 0.5), (-0.8, 0.3, 0.5)]
    corners += [(-0.8, 0.9, 0), (-0.8, 0.9, 0.5), (-0.8, -0.4, 0), (-0.8, -0.4, 0.5)]
    wall = add_mesh("Wall", corners, [(0, 1, 2, 3), (4, 0, 3, 5), (0, 6, 7, 3)])
    square = np.array([(0, 0), (1, 0), (1, 1), (0, 1)], np.float32) * 0.3
    places = np.concatenate([square + offset for offset in ((0.05, 0.05), (0.5, 0.05), (0.05, 0.5))])
    (wall.data.uv_layers.get("UVMap") or wall.data.uv_layers.new(name="UVMap")).uv.foreach_set("vector", places.ravel())
    wall.data.materials.append(chalk)
    add_plane(normal_map(), size=0.6, name="Tilted", location=(-0.3, -0.4, 0.1))
    # A collection of a ball, of which two instances stand before the lamp.
    ball = add_sphere(chalk, radius=0.12, name="Ball", location=(0.0, 0.0, 0.0), segments=16)
    group = bpy.data.collections.new("Balls")
    group.objects.link(ball)
    bpy.context.collection.objects.unlink(ball)
    for x in (-0.4, 0.2):
        instance = bpy.data.objects.new("Balls", None)
        instance.instance_type, instance.instance_collection = "COLLECTION", group
        instance.location = (x, -0.5, 0.5)
        bpy.context.collection.objects.link(instance)
    names = "Floor", "Lid", "Wall", "Tilted"
    options = {"passes": ("diffuse",), "error": True, "cycles_samples": 128, "sub_samples": 4, "rest_samples": 64}
    report, files = baked(save(tmp_path), tmp_path / "out", objects=names, **LIGHTMAP, **options)
    figures = {one["name"]: tile["errors"]["diffuse"] for one in report["objects"] for tile in one["tiles"].values()}
    assert set(figures) == set(names) and report["warnings"] == []
    for name, figure in figures.items():
        assert figure["techniques"]["ltsh4c"]["unbiased_error"] < 0.03, name  # .7 to 1.4 % were seen
    # No light of the upper side leaks through.
    lid = files["Lid.exr"]
    light, cycles = lid["ltsh4c.diffuse"].max(axis=-1), lid["cycles.diffuse"].max(axis=-1)
    dark = (cycles > 0.0) & (cycles < 0.4 * cycles.max())
    assert dark.sum() > 0.1 * SIZE**2 and abs(light[dark].mean() / cycles[dark].mean() - 1.0) < 0.05


def test_overlapping_and_missing_uv_maps_are_named(tmp_path):
    chalk = lit_floor()
    twice = add_mesh(
        "Twice", [(0, 0, 1), (1, 0, 1), (1, 1, 1), (0, 1, 1), (0, 2, 1), (1, 2, 1)], [(0, 1, 2, 3), (3, 2, 5, 4)]
    )
    bare = add_mesh("Bare", [(0, 0, 2), (1, 0, 2), (1, 1, 2)], [(0, 1, 2)])
    for ob in (twice, bare):
        ob.data.materials.append(chalk)
        while ob.data.uv_layers:
            ob.data.uv_layers.remove(ob.data.uv_layers[0])
    places = np.array([(0, 0), (1, 0), (1, 1), (0, 1)] * 2, np.float32)
    twice.data.uv_layers.new(name="UVMap").uv.foreach_set("vector", places.ravel())
    options = {"passes": ("diffuse_light",), "rest_samples": 8, "objects": ("Twice", "Bare")}
    report, files = baked(save(tmp_path), tmp_path / "out", **LIGHTMAP, **options)
    assert any("'Twice': 100 % of its texels are covered more than once" in line for line in report["warnings"])
    assert list(files) == ["Twice.exr"] and any("'Bare' has no UV map" in line for line in report["problems"])
