"""Baked lighting: against quadrature written out, against Cycles' bake, through real children."""

import math

import bpy
import numpy as np
import OpenEXR
import pytest
import quadrature
import scene_parts
from bake_scenes import SIZE, baked, save, start, textured_scene
from material_scenes import Build
from scene_parts import add_plane, principled

from ltsh_addon import imaging
from ltsh_addon.cycles import lobes
from ltsh_addon.pipeline import bake
from ltsh_addon.scene import QuadLight, SurfaceSamples


def plane_samples(view, f0=0.0, f90=0.0, albedo=0.0):
    """Samples of roughness 0.4 at the texels of `scene_parts.add_plane`, row 0 on top; seen ("from", a point) or
    ("along", a direction)."""
    step = ((np.arange(SIZE) + 0.5) / SIZE - 0.5) * 6.0
    x, y = np.meshgrid(step, step[::-1])
    position = np.stack([x, y, np.zeros_like(x)], axis=-1).reshape(-1, 3)
    offset = np.array(view[1]) - (position if view[0] == "from" else 0.0)
    vectors = np.broadcast_to(offset / np.linalg.norm(offset, axis=-1, keepdims=True), position.shape)
    one, up = np.ones((len(position), 3)), np.broadcast_to((0.0, 0.0, 1.0), position.shape)
    ior, color = 1.5 * one[:, 0], one * f0
    return SurfaceSamples(position, vectors, up, up, 0.4 * one[:, 0], color, one * f90, 0.0 * one, ior, one * albedo)


KEY = QuadLight("Key", (0.3, 0.2, 1.5), (0.6, 0.0, 0.0), (0.0, 0.35, 0.0), (0.0, 0.0, -1.0),
    np.full(3, 100.0 / (1.2 * 0.7) / math.pi),
)  # fmt: skip


ABOVE = "along", (0.0, 0.0, 1.0)


@pytest.mark.parametrize(
    ("view", "direction"),
    [("camera", ("from", (0.0, -3.0, 2.0))), ("above", ABOVE), ((1.0, 2.0, 3.0), ("from", (1.0, 2.0, 3.0)))],
    ids=["camera", "above", "point"],
)
def test_a_metal_plane_is_shaded_as_the_integral_over_the_light_says(tmp_path, view, direction):
    start()
    bpy.data.objects["Key"].rotation_euler = (0.0, 0.0, 0.0)
    add_plane(principled(Metallic=1.0, Roughness=0.4, Base_Color=(0.9, 0.6, 0.3, 1.0))[0])
    bpy.data.materials["Material"].node_tree.nodes["Principled BSDF"].distribution = "GGX"
    options = {"techniques": ("reference",), "passes": ("specular",), "view": view}
    _, files = baked(save(tmp_path), tmp_path / "out", **options)
    samples = plane_samples(direction, f0=(0.9, 0.6, 0.3), f90=1.0)
    some = np.random.default_rng(0).choice(len(samples), 300, replace=False)
    expected = quadrature.radiance(samples.take(some), [KEY], quadrature.ggx)
    found = files["Plane.exr"]["reference.specular"].reshape(-1, 3)[some]
    # The patches of the oracle leave 1e-4 at this roughness, positions in texels 2e-3 of a texel.
    assert np.abs(found - expected).max() < 1e-3 * expected.max()


def test_diffuse_light_is_the_irradiance_over_pi_and_leaves_colors_out(tmp_path):
    start()
    bpy.data.objects["Key"].rotation_euler = (0.0, 0.0, 0.0)
    add_plane(scene_parts.bsdf_material("ShaderNodeBsdfDiffuse", Color=(0.8, 0.2, 0.5, 1.0))[0])
    passes = ("diffuse", "diffuse_light", "combined", "specular")
    _, files = baked(save(tmp_path), tmp_path / "out", passes=passes, view="above")
    layers = files["Plane.exr"]
    samples = plane_samples(ABOVE, albedo=1.0)
    some = np.random.default_rng(0).choice(len(samples), 300, replace=False)
    expected = quadrature.radiance(samples.take(some), [KEY], quadrature.lambert)
    light = layers["ltsh4c.diffuse_light"].reshape(-1, 3)
    assert np.abs(light[some] - expected).max() < 1e-3 * expected.max()
    color = np.float32([0.8, 0.2, 0.5])
    assert np.abs(layers["ltsh4c.diffuse"] - layers["ltsh4c.diffuse_light"] * color).max() < 1e-5 * light.max()
    assert np.array_equal(layers["ltsh4c.combined"], layers["ltsh4c.diffuse"] + layers["ltsh4c.specular"])
    assert layers["coverage.hit"].min() == 1.0


def test_textures_groups_and_mixes_agree_with_the_bake_of_cycles(tmp_path):
    textured_scene()
    report, files = baked(
        save(tmp_path), tmp_path / "out", techniques=("reference", "ltsh4c"), error=True, cycles_samples=128, margin=2
    )
    assert report["problems"] == [] and set(files) == {"Plane.exr", "Sphere.exr"}
    for name, layers in files.items():
        covered = layers["coverage.hit"] > 0.0
        for pass_name in ("specular", "diffuse"):
            cycles = layers[f"cycles.{pass_name}"][covered]
            if cycles.max() < 1e-6:
                continue  # a metal
            halves = [layers[f"cycles_{half}.{pass_name}"] for half in "AB"]
            found = imaging.noisy_error_statistics(layers[f"reference.{pass_name}"], *halves, covered)
            # Cycles averages over a texel, which takes most of this at so small a size: at 192 texels the plane's
            # highlight agrees within the noise. The bump's shadowing of diffuse light is taken at the mean direction.
            assert found.unbiased_relative_error < 0.012, (name, pass_name, found)
            assert abs(found.bias) < 0.004, (name, pass_name, found)
            for technique in ("reference", "ltsh4c"):
                error = layers[f"error_{technique}.{pass_name}"]
                expected = layers[f"{technique}.{pass_name}"] - layers[f"cycles.{pass_name}"]
                scale = np.abs(cycles).max()
                assert np.abs(error - expected)[covered].max() <= 2e-7 * scale
    errors = report["objects"][0]["tiles"]["1001"]["errors"]["specular"]
    assert 0.0 < errors["noise"] < 0.1 and set(errors["techniques"]) == {"reference", "ltsh4c"}
    assert {path.name for path in (tmp_path / "out").glob("*.png")} >= {"Plane.error_ltsh4c.specular.png"}


def test_several_materials_and_none_are_baked_on_one_object(tmp_path):
    start()
    ob = scene_parts.add_mesh(
        "Strips",
        [(x, y, 0.0) for x in (-1.5, -0.5, 0.5, 1.5) for y in (-1.0, 1.0)],
        [(0, 2, 3, 1), (2, 4, 5, 3), (4, 6, 7, 5)],
    )
    uv = ob.data.uv_layers.new(name="UVMap")
    corners = [(x / 3.0, y) for face in range(3) for x, y in ((face, 0), (face + 1, 0), (face + 1, 1), (face, 1))]
    uv.data.foreach_set("uv", np.array(corners, dtype=np.float32).ravel())
    for color in ((1.0, 0.0, 0.0, 1.0), (0.0, 1.0, 0.0, 1.0)):
        ob.data.materials.append(scene_parts.bsdf_material("ShaderNodeBsdfDiffuse", Color=color)[0])
    ob.data.materials.append(None)
    ob.data.polygons.foreach_set("material_index", [0, 1, 2])
    _, files = baked(save(tmp_path), tmp_path / "out", passes=("diffuse",))
    image = files["Strips.exr"]["ltsh4c.diffuse"][SIZE // 2]
    red, green, gray = image[SIZE // 6], image[SIZE // 2], image[5 * SIZE // 6]
    assert red[0] > 0.0 == red[1] == red[2] and green[1] > 0.0 == green[0] == green[2]
    assert gray[0] == pytest.approx(gray[1]) and gray[1] == pytest.approx(gray[2]) and gray[0] > 0.0


def test_udim_tiles_become_files_and_repeating_textures_do_not(tmp_path):
    start()
    maps = {
        "Tiles": [(0.1, 0.1), (0.9, 0.1), (0.9, 0.9), (0.1, 0.9), (1.1, 1.2), (1.8, 1.2), (1.8, 1.7), (1.1, 1.7)],
        "Repeated": [(-2.0, -1.0), (3.0, -1.0), (3.0, 4.0), (-2.0, 4.0)] + 4 * [(0.0, 0.0)],
    }
    for index, (name, corners) in enumerate(maps.items()):
        z = 0.1 * index
        places = [(-1, -1, z), (0, -1, z), (0, 1, z), (-1, 1, z), (0, -1, z), (1, -1, z), (1, 1, z), (0, 1, z)]
        ob = scene_parts.add_mesh(name, places, [(0, 1, 2, 3), (4, 5, 6, 7)])
        ob.data.uv_layers.new(name="UVMap").data.foreach_set("uv", np.array(corners, dtype=np.float32).ravel())
    report, files = baked(save(tmp_path), tmp_path / "out", passes=("diffuse",), view="above")
    assert set(files) == {"Tiles.1001.exr", "Tiles.1012.exr", "Repeated.exr"}
    # 0.8 x 0.8 and 0.7 x 0.5 of the tile, to the texels of a border
    for name, share in (("Tiles.1001.exr", 0.64), ("Tiles.1012.exr", 0.35), ("Repeated.exr", 1.0)):
        assert files[name]["coverage.hit"].mean() == pytest.approx(share, abs=4.0 / SIZE), name
    assert any("'Repeated': 96 % of UV map 'UVMap' lies outside" in line for line in report["warnings"])


def test_blocks_of_rows_change_nothing(tmp_path, monkeypatch):
    textured_scene()
    path = save(tmp_path)
    _, whole = baked(path, tmp_path / "whole", margin=3)
    monkeypatch.setattr(bake, "BLOCK_TEXELS", 7 * SIZE)
    _, parts = baked(path, tmp_path / "parts", margin=3)
    for name, layers in whole.items():
        assert np.array_equal(layers["coverage.hit"], parts[name]["coverage.hit"])
        for layer, pixels in layers.items():
            # The maps of a block are baked at UV coordinates rounded differently.
            assert np.abs(pixels - parts[name][layer]).max() <= 2e-4 * np.abs(pixels).max(), (name, layer)


def test_the_margin_repeats_the_border_and_conservative_adds_texels(tmp_path):
    start()
    ob = add_plane(principled(Metallic=1.0, Roughness=0.5)[0])
    uv = np.array([0.3, 0.3, 0.7, 0.3, 0.7, 0.7, 0.3, 0.7], dtype=np.float32)
    ob.data.uv_layers.active.data.foreach_set("uv", uv)
    path = save(tmp_path)
    _, plain = baked(path, tmp_path / "plain")
    _, wide = baked(path, tmp_path / "wide", margin=5)
    _, safe = baked(path, tmp_path / "safe", conservative=True)
    layers, covered = wide["Plane.exr"], plain["Plane.exr"]["coverage.hit"] > 0.0
    image, before = layers["ltsh4c.specular"], plain["Plane.exr"]["ltsh4c.specular"]
    assert np.array_equal(layers["coverage.hit"] > 0.0, covered) and np.array_equal(image[covered], before[covered])
    rows, columns = np.nonzero(covered)
    top, left, right = rows.min(), columns.min(), columns.max()
    border = before[top : top + 1, left : right + 1]
    assert np.array_equal(image[top - 5 : top, left : right + 1], np.repeat(border, 5, axis=0))
    assert not image[top - 6].any() and np.array_equal(image[top - 3, left - 3], before[top, left])
    touched = safe["Plane.exr"]["coverage.hit"] > 0.0
    # .3 x 64 = 19.2: the texel 19 is touched, its center 19.5 is covered; .7 x 64 = 44.8: 44 and its center.
    assert touched[covered].all() and touched.sum() >= covered.sum()


@pytest.mark.parametrize("kind", ["maps", "error"])
def test_conservative_bakes_no_texel_that_cycles_leaves_out_and_says_so(tmp_path, kind):
    start()
    ob = add_plane(waves() if kind == "maps" else principled(Roughness=0.5)[0])
    uv = np.array([0.3, 0.31, 0.7, 0.33, 0.73, 0.7, 0.3, 0.71], dtype=np.float32)
    ob.data.uv_layers.active.data.foreach_set("uv", uv)
    options = {"sub_samples": 2, "error": kind == "error", "cycles_samples": 2}
    path = save(tmp_path)
    report, files = baked(path, tmp_path / "safe", conservative=True, **options)
    (warning,) = report["warnings"]
    assert "'Plane': texels whose centers no face covers are left out" in warning
    _, plain = baked(path, tmp_path / "plain", **options)
    for layer, pixels in plain["Plane.exr"].items():
        assert np.array_equal(pixels, files["Plane.exr"][layer]), layer


def test_metadata_says_what_the_file_is(tmp_path):
    start()
    add_plane(name="Bo/den: ü")
    _, files = baked(save(tmp_path), tmp_path / "out", view=(1.0, 2.0, 3.0))
    (name,) = files
    assert "/" not in name and ":" not in name
    metadata = OpenEXR.File(str(tmp_path / "out" / name), header_only=True).header()
    assert metadata["ltsh:object"] == "Bo/den: ü" and metadata["ltsh:uv"] == "UVMap"
    assert metadata["ltsh:view"] == "position 1, 2, 3" and metadata["ltsh:frame"] == "1"


@pytest.mark.parametrize(
    ("passes", "shown"),
    [
        (("specular", "diffuse"), ("specular", "diffuse")),
        (("diffuse_light", "combined"), ("combined",)),
        (("diffuse",), ("diffuse",)),
    ],
)
def test_apply_shows_all_light_that_was_baked(tmp_path, passes, shown):
    start()
    add_plane(principled(Roughness=0.5, Base_Color=(0.8, 0.4, 0.2, 1.0))[0])
    _, files = baked(save(tmp_path), tmp_path / "out", passes=passes, apply=True, margin=2)
    layers = files.pop("Plane.exr")
    ((name, texture),) = files.items()
    assert name == f"Plane.ltsh4c.{shown[0] if len(shown) == 1 else 'combined'}.exr"
    assert np.array_equal(texture[""], sum(layers[f"ltsh4c.{part}"] for part in shown))


def monkey(material):
    """Large faces with smooth normals: at 64 texels light changes from texel to texel, and most are at a side."""
    bpy.ops.mesh.primitive_monkey_add(size=1.6, location=(0.0, 0.0, 0.8))
    ob = bpy.context.object
    ob.data.polygons.foreach_set("use_smooth", [True] * len(ob.data.polygons))
    ob.data.materials.append(material)
    bpy.ops.object.mode_set(mode="EDIT")
    bpy.ops.mesh.select_all(action="SELECT")
    bpy.ops.uv.smart_project()
    bpy.ops.object.mode_set(mode="OBJECT")
    return ob


def waves():
    """A dielectric whose normals come from a texture, which a bake takes as maps."""
    made = Build("Waves")
    rough = made.shader("BsdfPrincipled", Roughness=0.4, Base_Color=(0.8, 0.4, 0.2, 1.0))
    normal, noise = made.new("ShaderNodeNormalMap", Strength=0.3), made.new("ShaderNodeTexNoise", Scale=2.0, Detail=0.0)
    made.link(made.new("ShaderNodeTexCoord").outputs["UV"], noise.inputs["Vector"])
    made.link(noise.outputs["Color"], normal.inputs["Color"])
    made.link(normal.outputs[0], rough.node.inputs["Normal"])
    return made.show(rough)


@pytest.mark.parametrize("kind", ["plain", "mapped tiles"])
def test_points_spread_over_texels_give_the_mean_that_cycles_bakes(tmp_path, kind):
    start(camera=(0.0, -4.0, 2.2))
    bpy.data.objects["Key"].location, bpy.data.objects["Key"].rotation_euler = (0.8, -1.6, 2.2), (0.9, 0.3, 0.2)
    if kind == "plain":
        monkey(principled(Roughness=0.4, Base_Color=(0.8, 0.4, 0.2, 1.0))[0])
    else:
        mesh = monkey(waves()).data
        for loop in (loop for face in mesh.polygons if face.center.x > 0.0 for loop in face.loop_indices):
            mesh.uv_layers.active.uv[loop].vector.x += 1.0
    options = {"techniques": ("ltsh4c",), "error": True, "cycles_samples": 256, "sub_samples": 16}
    report, _ = baked(save(tmp_path), tmp_path / "out", **options)
    tiles = report["objects"][0]["tiles"]
    assert list(tiles) == (["1001"] if kind == "plain" else ["1001", "1002"])
    # At centers alone .47 and .06, or .70 and .07. What is left, most of it in few texels of the highlight, falls with
    # the number of points: .05, and .02 with 48 of them. Those of maps are random ones.
    specular, diffuse = (0.12, 0.01) if kind == "plain" else (0.2, 0.01)
    for tile in tiles.values():
        for name, limit in (("specular", specular), ("diffuse", diffuse)):
            (error,) = tile["errors"][name]["techniques"].values()
            assert error["unbiased_squared_error"] < limit**2, (name, tile["errors"])


def test_apply_saves_a_file_whose_object_shows_the_texture(tmp_path):
    start()
    scene_parts.add_top_camera()
    add_plane(principled(Metallic=1.0, Roughness=0.4)[0])
    path = save(tmp_path)
    before = path.read_bytes()
    output = tmp_path / "out"
    report, files = baked(path, output, passes=("specular", "combined"), apply=True)
    assert path.read_bytes() == before and report["applied"] == "scene_baked.blend"
    assert set(files) == {"Plane.exr", "Plane.ltsh4c.combined.exr"}
    combined = files["Plane.exr"]["ltsh4c.combined"]
    assert np.array_equal(files["Plane.ltsh4c.combined.exr"][""], combined)
    bpy.ops.wm.open_mainfile(filepath=str(output / report["applied"]))
    (image,) = [image for image in bpy.data.images if image.name.startswith("Plane")]
    assert image.filepath == "//Plane.ltsh4c.combined.exr"
    assert bpy.data.objects["Plane"].material_slots[0].material.name == "Material (baked Plane)"
    # A light shines on emission in vain: the picture is the texture, texel for pixel.
    scene = bpy.context.scene
    scene.render.resolution_x = scene.render.resolution_y = SIZE
    rendered = lobes.read_layer(scene_parts.cycles_channels(tmp_path), "Combined", "RGB")
    # Cycles keeps the texture in half precision and blends neighbors by a thousandth of a texel.
    assert np.abs(rendered - combined).max() <= 5e-3 * combined.max()
