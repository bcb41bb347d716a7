"""Bakes of odd objects: what cannot be baked is named; bakes that were stopped leave nothing."""

import hashlib
import json

import bpy
import numpy as np
import pytest
import scene_parts
from bake_scenes import SIZE, baked, save, start
from material_scenes import Build
from scene_parts import add_geometry_nodes, add_plane, principled

from ltsh_addon import imaging
from ltsh_addon.blender.process import blender_process
from ltsh_addon.pipeline import BakeOptions, bake_scene
from ltsh_addon.pipeline.batch import RESUME, run_tasks
from ltsh_addon.pipeline.tasks import BatchJob
from ltsh_addon.scene import Cancelled


def squares(name, *uv_corners):
    """A mesh of squares above one another, of which each has the UV square (u, v, side)."""
    corners = [(x, y, 0.01 * z) for z in range(len(uv_corners)) for x, y in ((-1, -1), (1, -1), (1, 1), (-1, 1))]
    ob = scene_parts.add_mesh(name, corners, [tuple(range(4 * z, 4 * z + 4)) for z in range(len(uv_corners))])
    uv = [(u + a * s, v + b * s) for u, v, s in uv_corners for a, b in ((0, 0), (1, 0), (1, 1), (0, 1))]
    ob.data.uv_layers.new(name="UVMap").data.foreach_set("uv", np.float32(uv).ravel())
    return ob


@pytest.fixture(scope="module")
def odd(tmp_path_factory):
    """Report and layers of a bake of odd objects, and whether the library is as it was."""
    folder = tmp_path_factory.mktemp("odd")
    start()
    add_plane(principled("Shared", Metallic=1.0, Roughness=0.5)[0], name="Linked").data.name = "Linked mesh"
    path = scene_parts.save(folder / "library.blend")
    before = hashlib.sha256(path.read_bytes()).digest()
    start()
    with bpy.data.libraries.load(str(path), link=True) as (_, wanted):
        wanted.objects, wanted.meshes, wanted.materials = ["Linked"], ["Linked mesh"], ["Shared"]
    scene_parts.link(bpy.data.objects["Linked"])
    scene_parts.link(bpy.data.objects.new("Linked mesh", bpy.data.meshes["Linked mesh"]))
    add_plane(bpy.data.materials["Shared"], name="Linked material")
    squares("Third", (0.0, 0.0, 0.5), (0.25, 0.0, 0.5))
    squares("Thrice", (0.0, 0.0, 1.0), (0.0, 0.0, 1.0), (0.0, 0.0, 1.0))
    squares("Half without area", (0.0, 0.0, 0.5), (0.75, 0.75, 0.0))
    squares("Two tiles", (0.0, 0.0, 1.0), (1.0, 0.0, 1.0))
    report, files = baked(save(folder), folder / "out", passes=("diffuse", "specular"), view="above")
    assert hashlib.sha256(path.read_bytes()).digest() == before
    return report, files


@pytest.mark.parametrize(
    ("name", "share"), [("Third", "33.3 %"), ("Thrice", "100 %"), ("Half without area", None), ("Two tiles", None)]
)
def test_the_share_of_texels_that_islands_share_is_named(odd, name, share):
    (line,) = [line for line in odd[0]["warnings"] if "covered more than once" in line]
    assert line == "object 'Thrice': 100 % of its texels are covered more than once (1 more: 'Third' 33.3 %)"
    assert (repr(name) in line) == (share is not None) and (share is None or share in line)


def test_linked_objects_are_named_with_their_library_and_linked_materials_are_baked(odd):
    report, files = odd
    assert report["problems"] == [
        f"object {name!r} is linked from //library.blend: bake it there, or make it local"
        for name in ("Linked", "Linked mesh")
    ]
    layers = files["Linked material.exr"]
    assert layers["ltsh4c.specular"].max() > 0.0 and layers["coverage.hit"].all()


def test_faces_without_area_on_the_texture_leave_the_others_as_they_are(odd):
    covered = odd[1]["Half without area.exr"]["coverage.hit"]
    assert covered[SIZE // 2 :, : SIZE // 2].all() and covered.sum() == SIZE**2 / 4


def cut_cube():
    """A flat cube, left on the UV map, out of which a smooth red sphere, right on it, is cut."""
    ob = scene_parts.add_mesh("Cut", *box())
    ob.data.uv_layers.new(name="UVMap").data.foreach_set("uv", np.float32([0, 0, 0.25, 0, 0.25, 1, 0, 1] * 6))
    ob.data.materials.append(principled("Gray", Roughness=0.6)[0])
    red = principled("Red", Base_Color=(0.8, 0.1, 0.1, 1.0), Roughness=0.6)[0]
    cutter = scene_parts.add_sphere(red, radius=0.6, location=(0.0, 0.0, 0.5), segments=16)
    cutter.hide_render = True
    uv = np.empty(2 * len(cutter.data.loops), np.float32)
    cutter.data.uv_layers.active.uv.foreach_get("vector", uv)
    cutter.data.uv_layers.active.uv.foreach_set("vector", uv * np.tile(np.float32([0.5, 1.0]), len(uv) // 2) + 0.5)
    modifier = ob.modifiers.new("Boolean", "BOOLEAN")
    modifier.object, modifier.solver = cutter, "EXACT"
    modifier.material_mode = "TRANSFER"
    return ob


def box():
    """Corners and faces of a cube of side 1."""
    corners = [(x - 0.5, y - 0.5, z - 0.5) for x in (0, 1) for y in (0, 1) for z in (0, 1)]
    return corners, [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]


def warped_plane():
    """A plane whose texture shows other places than its own UV map says."""
    made = Build("Checked")
    shader, wave = made.shader("BsdfPrincipled", Roughness=0.6), made.new("ShaderNodeTexWave", Scale=0.2, Detail=0.0)
    made.link(wave.outputs["Color"], shader.node.inputs["Base Color"])
    made.show(shader)
    ob = add_plane(made.material, name="Warped")
    modifier = ob.modifiers.new("UV Warp", "UV_WARP")
    modifier.uv_layer, modifier.scale, modifier.offset = ob.data.uv_layers[0].name, (0.5, -0.7), (0.1, 0.0)
    return ob


def mapped_by_nodes():
    """A plane without a UV map, which its modifier gives it."""
    ob = add_plane(principled("Plain", Roughness=0.6)[0], name="Nodes", location=(0.0, 0.0, 0.2))
    name = ob.data.uv_layers[0].name
    ob.data.uv_layers.remove(ob.data.uv_layers[0])
    group, first, last, store, place = add_geometry_nodes(ob, "StoreNamedAttribute", "InputPosition")
    store.domain, store.data_type = "CORNER", "FLOAT2"
    store.inputs["Name"].default_value = name
    for start_, end in ((first.outputs[0], store.inputs["Geometry"]), (store.outputs[0], last.inputs[0])):
        group.links.new(start_, end)
    group.links.new(place.outputs[0], next(item for item in store.inputs if item.name == "Value" and item.enabled))
    return ob


def made_by_nodes():
    """A cube in place of the mesh of the object, with a UV map that is not the active one."""
    ob = add_plane(principled("Plain", Roughness=0.6)[0], name="Made")
    group, _, last, cube, store, dress = add_geometry_nodes(ob, "MeshCube", "StoreNamedAttribute", "SetMaterial")
    store.domain, store.data_type, store.inputs["Name"].default_value = "CORNER", "FLOAT2", "UVMap"
    dress.inputs["Material"].default_value = ob.data.materials[0]
    value = next(item for item in store.inputs if item.name == "Value" and item.enabled)
    for start_, end in (
        (cube.outputs["Mesh"], store.inputs["Geometry"]), (cube.outputs["UV Map"], value),
        (store.outputs[0], dress.inputs["Geometry"]), (dress.outputs[0], last.inputs[0]),
    ):  # fmt: skip
        group.links.new(start_, end)
    return ob


def bent_quads():
    """Flat faces of four corners that are not in a plane, which Cycles shades as two triangles."""
    corners = [(x - 1.0, y - 1.0, 0.4 * ((x + y) % 2)) for y in range(3) for x in range(3)]
    faces = [(x + y, x + y + 1, x + y + 4, x + y + 3) for y in (0, 3) for x in (0, 1)]
    ob = scene_parts.add_mesh("Bent", corners, faces)
    places = [np.array(corners[corner][:2]) * 0.5 + 0.5 for face in faces for corner in face]
    ob.data.uv_layers.new(name="UVMap").data.foreach_set("uv", np.float32(places).ravel())
    ob.data.materials.append(principled("Plain", Roughness=0.6)[0])
    return ob


@pytest.mark.parametrize("make", [cut_cube, warped_plane, mapped_by_nodes, made_by_nodes, bent_quads])
def test_uv_maps_and_materials_that_modifiers_bring_in_are_baked_as_by_cycles(make, tmp_path):
    """Gray diffuse light is exact; Cycles' noise of 512 samples of a light that is seen as a whole is below 2 %."""
    start()
    ob = make()
    uv = None if make is made_by_nodes else "UVMap"
    options = {"objects": (ob.name,), "uv": uv, "passes": ("diffuse",), "error": True, "cycles_samples": 512}
    report, files = baked(save(tmp_path), tmp_path / "out", **options, sub_samples=4)
    assert report["problems"] == [] and not [line for line in report["warnings"] if "left out" in line]
    layers = files[f"{ob.name}.exr"]
    covered = layers["coverage.hit"] > 0.0
    ours, cycles = layers["ltsh4c.diffuse"][covered], layers["cycles.diffuse"][covered]
    assert cycles.min() >= 0.0 and cycles.mean() > 0.01
    assert np.linalg.norm(ours - cycles) <= 0.02 * np.linalg.norm(cycles)


def test_light_groups_are_layers_and_each_is_the_light_of_its_own_lights(tmp_path):
    start()
    groups = bpy.context.view_layer.lightgroups
    for name, place in (("Key", (0.8, 0.0, 1.0)), ("Fill", (-0.8, 0.0, 1.0)), ("", (0.0, 0.8, 1.0))):
        light = scene_parts.add_area_light(f"{name} light", place, color=(1.0, 0.5, 0.2) if name else (1.0, 1.0, 1.0))
        if name:
            groups.add(name=name)
            light.lightgroup = name
    bpy.data.objects.remove(bpy.data.objects["Key"])
    add_plane(principled(Roughness=0.4)[0])
    _, files = baked(save(tmp_path), tmp_path / "all")
    layers = files["Plane.exr"]
    for name in ("Fill light", " light"):
        bpy.data.objects.remove(bpy.data.objects[name])
    _, files = baked(save(tmp_path), tmp_path / "alone")
    for pass_name in ("specular", "diffuse"):
        layer = f"ltsh4c.{pass_name}"
        assert {name for name in layers if name.startswith(f"{layer}@")} == {
            f"{layer}@{group}" for group in ("Key", "Fill", "ungrouped")
        }
        parts = [layers[f"{layer}@{group}"] for group in ("Key", "Fill", "ungrouped")]
        # Sums of three numbers in float32, in any order.
        assert np.abs(sum(parts) - layers[layer]).max() <= 3e-7 * layers[layer].max()
        assert np.array_equal(parts[0], files["Plane.exr"][layer]) and parts[0].max() > 0.0


def test_broken_objects_are_named_and_the_rest_is_baked(tmp_path, capsys):
    from ltsh_addon import cli

    start()
    add_plane(name="Good")
    bare = add_plane(name="No map", location=(0, 0, 0.1))
    bare.data.uv_layers.remove(bare.data.uv_layers[0])
    add_plane(name="Point map").data.uv_layers.active.data.foreach_set("uv", np.full(8, 0.5, np.float32))
    add_plane(name="Far map").data.uv_layers.active.data.foreach_set(
        "uv", np.float32([-5, -5, -4.1, -5, -4.1, -4.1, -5, -4.1])
    )
    square = [(-1, -1, 0), (1, -1, 0), (1, 1, 0), (-1, 1, 0)]
    double = scene_parts.add_mesh("Double", 2 * square, [(0, 1, 2, 3), (4, 5, 6, 7)])
    double.data.uv_layers.new(name="UVMap").data.foreach_set("uv", np.float32([0, 0, 1, 0, 1, 1, 0, 1] * 2))
    add_plane(name="Hidden").hide_render = True
    scene_parts.add_mesh("No faces", [(0, 0, 0)], []).data.uv_layers.new(name="UVMap")
    add_plane(name="Flat", scale=(1.0, 0.0, 0.0))
    path = save(tmp_path)
    names = [ob.name for ob in bpy.data.objects if ob.type == "MESH"]
    arguments = [value for name in names for value in ("--object", name)]
    capsys.readouterr()
    code = cli.main(["bake", str(path), "-o", str(tmp_path / "out"), "--size", "64", "--quiet", *arguments])
    said = capsys.readouterr().err
    assert code == 1
    assert {file.name for file in (tmp_path / "out").glob("*.exr")} == {"Good.exr", "Double.exr"}
    for text in (
        "not baked: object 'No map' has no UV map, found none",
        "not baked: object 'Point map': all faces of UV map 'UVMap' have no area",
        "not baked: object 'Far map': all of UV map 'UVMap' lies outside of the texture",
        "not baked: object 'Hidden' is hidden in renders",
        "not baked: object 'No faces' has no faces",
        "not baked: object 'Flat': its transform has no inverse",
        "warning: object 'Double': 100 % of its texels are covered more than once",
    ):
        assert text in said, text
    report = json.loads((tmp_path / "out" / "report.json").read_text())
    assert len(report["problems"]) == 6 and len(report["objects"]) == 2


def test_scenes_that_cannot_be_baked_say_why(tmp_path):
    start()
    add_plane()
    path = save(tmp_path)
    with pytest.raises(
        blender_process.SceneError, match="object 'Wall' is not in scene 'Scene'; meshes there: 'Plane'"
    ):
        baked(path, tmp_path / "out", objects=("Wall",))
    report, _ = baked(path, tmp_path / "out", uv="Lightmap")
    assert report["problems"] == [
        "object 'Plane' has no UV map 'Lightmap', found 'UVMap': unwrap it, or choose another UV map"
    ]
    with pytest.raises(ValueError, match="size is '32x8192', expected N or WIDTHxHEIGHT"):
        baked(path, tmp_path / "out", size=(32, 8192))
    start(camera=None)
    with pytest.raises(blender_process.SceneError, match="no active camera"):
        baked(save(tmp_path), tmp_path / "out")


def test_without_a_name_the_active_uv_map_is_baked_whichever_one_renders(tmp_path):
    """As in Blender's own bake."""
    start()
    layers = add_plane().data.uv_layers
    corners = np.float32([0, 0, 0.5, 0, 0.5, 0.5, 0, 0.5])
    layers.new(name="Quarter").data.foreach_set("uv", corners)
    layers.active, layers["UVMap"].active_render = layers["Quarter"], True
    path = save(tmp_path)
    for name, uv, share in ((None, "Quarter", 0.25), ("UVMap", "UVMap", 1.0)):
        report, files = baked(path, tmp_path / uv, uv=name)
        assert report["objects"][0]["uv"] == uv
        assert files["Plane.exr"]["coverage.hit"].mean() == share


def test_stopping_leaves_no_file(tmp_path):
    start()
    add_plane()

    def stop(stage, fraction):
        return not stage.startswith("shade")

    with pytest.raises(Cancelled):
        bake_scene(BakeOptions(scene=save(tmp_path), output=tmp_path / "out", size=(64, 64)), stop)
    assert list((tmp_path / "out").iterdir()) == []


def test_resume_bakes_again_what_belongs_to_another_job(tmp_path):
    start()
    add_plane(principled(Metallic=1.0, Roughness=0.5)[0])
    path = save(tmp_path)

    def specular(view):
        options = BakeOptions(scene=path, output=tmp_path / "out", size=(SIZE, SIZE), shadows="off", view=view)
        result = run_tasks(BatchJob("bake", options, (path,)), existing=RESUME)
        return result.finished_before, imaging.read_layers(tmp_path / "out" / "Plane.exr")["ltsh4c.specular"]

    (_, first), (before, second) = specular("above"), specular("camera")
    assert before == 0 and np.abs(first - second).max() > 0.0
    (tmp_path / "out" / "Plane.exr").write_bytes(b"no EXR")
    before, third = specular("camera")
    assert before == 0 and np.array_equal(second, third) and specular("camera")[0] == 1


@pytest.mark.parametrize("how", ["object", "collection", "second view layer"])
def test_objects_that_only_renders_show_are_baked_as_cycles_renders_them(how, tmp_path):
    """Cycles' bake refused them, without their names, or baked what another view layer shows."""
    start()
    ob, scene = add_plane(principled("Plain", Roughness=0.6)[0], name="Floor"), bpy.context.scene
    shade = add_plane(principled("Shade")[0], size=0.4, name="Shade", location=(0.0, 0.0, 0.7))
    collection = bpy.data.collections.new("Other")
    scene.collection.children.link(collection)
    moved = shade if how == "second view layer" else ob
    scene.collection.objects.unlink(moved)
    collection.objects.link(moved)
    ob.hide_viewport, collection.hide_viewport = how == "object", how == "collection"
    if how == "second view layer":
        scene.view_layers.new("Second").layer_collection.children["Other"].exclude = True
        scene.view_layers[0].use = False
    options = {"objects": ("Floor",), "passes": ("diffuse",), "error": True, "cycles_samples": 128, "shadows": "on"}
    report, files = baked(save(tmp_path), tmp_path / "out", **options)
    assert report["problems"] == []
    layers = files["Floor.exr"]
    ours, cycles = layers["ltsh4c.diffuse"], layers["cycles.diffuse"]
    assert np.linalg.norm(ours - cycles) <= 0.1 * np.linalg.norm(cycles)  # the noise of penumbras; a shadow is 25 %


@pytest.mark.newest
@pytest.mark.parametrize("how", ["object", "collection"])
def test_holdouts_are_named_and_baked_like_any_surface(how, tmp_path):
    """Cycles bakes them black."""
    start()
    ob, collection = add_plane(principled("Plain", Roughness=0.6)[0], name="Floor"), bpy.data.collections.new("Held")
    bpy.context.scene.collection.children.link(collection)
    bpy.context.scene.collection.objects.unlink(ob)
    collection.objects.link(ob)
    ob.is_holdout = how == "object"
    bpy.context.view_layer.layer_collection.children["Held"].holdout = how == "collection"
    report, files = baked(save(tmp_path), tmp_path / "out", passes=("diffuse",), error=True, cycles_samples=16)
    assert report["warnings"] == ["object 'Floor': holdout is switched off, it is baked like any surface"]
    layers = files["Floor.exr"]
    ours, cycles = layers["ltsh4c.diffuse"], layers["cycles.diffuse"]
    assert np.linalg.norm(ours - cycles) <= 0.1 * np.linalg.norm(cycles)


@pytest.mark.newest
@pytest.mark.parametrize("output", ["View Distance", "Window"])
def test_seen_from_above_nodes_know_the_camera_of_the_scene(output, tmp_path):
    start(camera=(0.0, -3.0, 2.0))
    material, node = scene_parts.bsdf_material("ShaderNodeBsdfDiffuse")
    source = material.node_tree.nodes.new(f"ShaderNode{'TexCoord' if output == 'Window' else 'CameraData'}")
    material.node_tree.links.new(source.outputs[output], node.inputs["Color"])
    add_plane(material, size=2.0, name="Floor")
    path, layers = save(tmp_path), {}
    for view in ("above", "camera"):
        _, files = baked(path, tmp_path / view, passes=("diffuse",), view=view)
        layers[view] = files["Floor.exr"]["ltsh4c.diffuse"]
    assert layers["camera"].max() > 0.0
    np.testing.assert_allclose(layers["above"], layers["camera"], rtol=1e-5)


@pytest.mark.newest
@pytest.mark.parametrize("surface", [True, False])
def test_volumes_between_lights_and_what_is_baked_are_named(surface, tmp_path):
    start()
    add_plane(principled("Plain")[0], name="Floor")
    material, tree, output = scene_parts.new_material("Fog")
    tree.links.new(scene_parts.add_node(tree, "ShaderNodeVolumeScatter").outputs[0], output.inputs["Volume"])
    if surface:
        tree.links.new(scene_parts.add_node(tree, "ShaderNodeBsdfTransparent").outputs[0], output.inputs["Surface"])
    add_plane(material, size=0.5, name="Cloud", location=(0.0, 0.0, 0.7))
    report, _ = baked(save(tmp_path), tmp_path / "out", objects=("Floor",), passes=("diffuse",))
    assert report["warnings"] == ["material 'Fog': its volume is not shaded, light passes it as if it were not there"]


def test_a_bake_of_one_block_tells_how_far_its_shadows_are(tmp_path):
    start()
    add_plane(principled("Gray")[0], size=2.0, name="Floor")
    told = []
    options = BakeOptions(
        save(tmp_path), tmp_path / "out", objects=("Floor",), size=(256, 256), view="above", passes=("diffuse_light",)
    )
    bake_scene(options, lambda stage, share: told.append((stage, share)))
    shares = [share for stage, share in told if stage == "shade Floor"]
    assert shares[0] == 0.0 and shares[-1] == 1.0 and shares == sorted(shares)
    assert any(0.0 < share < 1.0 for share in shares)
