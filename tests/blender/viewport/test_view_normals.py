"""Normals of the viewport against those of Cycles: flat, smooth and mixed faces, sharp edges, custom normals, stretched
objects, normal maps."""

import bpy
import numpy as np
import scene_parts as parts
from graphics_card import edits_with_graphics, with_graphics
from view_pictures import COLUMNS, SIZE, away_from_edges, normal_map, sampled_pictures, times_too_far, viewport_picture

from ltsh_addon.blender import evaluated
from ltsh_addon.blender.process.pixels import PixelJob, extract_pixels
from ltsh_addon.blender.viewport import meshes

# Heights of two quads side by side, neither of them plane.
HEIGHTS = (0.0, 0.1, 0.0, 0.1, 0.0, 0.15)


def two_quads(name, x, flat=(), sharp_edges=(), custom=False, marks_faces=True):
    """A mesh of two bent quads, the faces `flat` and the edges `sharp_edges` marked."""
    corners = [(0.5 * (i % 3 - 1), i // 3 - 0.5, height) for i, height in enumerate(HEIGHTS)]
    ob = parts.add_mesh(name, corners, [(0, 1, 4, 3), (1, 2, 5, 4)], location=(x, 0.0, 0.0))
    mesh = ob.data
    mesh.polygons.foreach_set("use_smooth", [number not in flat for number in range(2)])
    if not marks_faces and "sharp_face" in mesh.attributes:
        mesh.attributes.remove(mesh.attributes["sharp_face"])
    if sharp_edges:
        marks = mesh.attributes.new("sharp_edge", "BOOLEAN", "EDGE")
        marks.data.foreach_set("value", [edge in sharp_edges for edge in range(len(mesh.edges))])
    if custom:
        mesh.normals_split_custom_set([(0.2, 0.0, 1.0)] * len(mesh.loops))
    ob.data.materials.append(parts.principled(name, Roughness=0.4)[0])
    return ob


EVERY_EDGE = tuple(range(7))
KINDS = {
    "smooth": {},
    "flat": {"flat": (0, 1)},
    "mixed": {"flat": (0,)},
    "some sharp edges": {"sharp_edges": (0, 1, 2)},
    "mixed, some sharp edges": {"flat": (1,), "sharp_edges": (0, 1, 2)},
    "all edges sharp": {"sharp_edges": EVERY_EDGE},
    "all edges sharp, no marks of faces": {"sharp_edges": EVERY_EDGE, "marks_faces": False},
    "some sharp edges, no marks of faces": {"sharp_edges": (0, 1, 2), "marks_faces": False},
    "smooth, no marks of faces": {"marks_faces": False},
    "mixed, all edges sharp": {"flat": (0,), "sharp_edges": EVERY_EDGE},
    "flat, custom": {"flat": (0, 1), "custom": True},
    "mixed, custom": {"flat": (1,), "custom": True},
}


def normals_at(mesh, points):
    """Normals (P, 3) that the viewport interpolates at points (P, 2) of a mesh, seen from above; NaN beside it."""
    mesh.calc_loop_triangles()
    vertex = np.array([loop.vertex_index for loop in mesh.loops])
    triangles = np.array([triangle.loops[:] for triangle in mesh.loop_triangles])
    place = np.array([mesh.vertices[index].co[:] for index in vertex], np.float32)
    normal, flat = evaluated.interpolated_normals(mesh, vertex)
    own, its_normal = meshes.non_planar_normals(mesh, flat, triangles, place, normal)
    corner_normals = normal[triangles].astype(np.float64)
    corner_normals[own] = its_normal[:, None]
    found = np.full((len(points), 3), np.nan)
    for corners, normals in zip(place[triangles].astype(np.float64), corner_normals, strict=True):
        edges = np.stack([corners[1] - corners[0], corners[2] - corners[0]])[:, :2]
        share = (points - corners[0, :2]) @ np.linalg.inv(edges)
        weights = np.column_stack([1.0 - share.sum(axis=1), share])
        inside = (weights >= 0.0).all(axis=1)
        found[inside] = (weights @ normals)[inside]
    return found / np.linalg.norm(found, axis=1, keepdims=True)


def test_normals_are_those_that_cycles_interpolates(tmp_path):
    parts.empty_scene(30 * len(KINDS), 30)
    objects = [two_quads(name, x, **kind) for x, (name, kind) in enumerate(KINDS.items())]
    parts.add_area_light()
    camera = parts.add_top_camera(float(len(KINDS)))
    camera.location.x = 0.5 * (len(KINDS) - 1)
    path = parts.save(tmp_path / "normals.blend", copy=True)
    samples = extract_pixels(PixelJob(scene=path)).samples
    column = np.round(samples.position[:, 0]).astype(int)
    for x, ob in enumerate(objects):
        here = (column == x) & (np.abs(samples.position[:, 0] - x) < 0.47) & (np.abs(samples.position[:, 1]) < 0.47)
        expected, points = samples.normal[here], samples.position[here, :2] - (x, 0.0)
        found = normals_at(ob.data, points)
        # Pixels on the diagonals and the middle edge see one side or the other.
        certain = np.abs(points[:, 0]) > 1e-3
        difference = np.abs(found - expected)[certain].max(axis=1)
        assert len(difference) > 200 and np.isfinite(difference).all()
        assert (difference > 1e-4).mean() < 0.02, ob.name


def dome(name, material, column, row, flat=False, scale=(1.0, 1.0, 1.0), data=None):
    """A bumpy square of coarse faces in a square of the picture, which `view_pictures.sampled_pictures` numbers."""
    if data is None:
        side = np.linspace(-0.5, 0.5, 6)
        x, y = (values.ravel() for values in np.meshgrid(side, side))
        height = 0.25 * np.cos(np.pi * x) * np.cos(np.pi * y) + 0.05 * np.sin(9.0 * x + 4.0 * y)
        corners = np.column_stack([x / scale[0], y / scale[1], height / scale[2]])
        faces = [(i, i + 1, i + 7, i + 6) for i in range(30) if i % 6 < 5]
        data = bpy.data.meshes.new(name)
        data.from_pydata(corners.tolist(), [], faces)
        data.polygons.foreach_set("use_smooth", [not flat] * len(faces))
        uv = data.uv_layers.new(name="UVMap")
        index = np.array(faces).ravel()
        uv.data.foreach_set("uv", np.column_stack([x, y])[index].astype(np.float32).ravel())
        data.materials.append(material)
    return parts.link(bpy.data.objects.new(name, data), (column - 1.5, row - 0.5, 0.0), scale=scale)


@edits_with_graphics
def test_stretched_objects_shine_as_in_cycles(tmp_path):
    parts.empty_scene(*SIZE)
    metal = parts.principled("Metal", Metallic=1.0, Roughness=0.3)[0]
    long, mirrored = (0.4, 1.6, 2.5), (-0.5, 1.3, 2.0)
    flat = dome("flat", metal, 0, 0, flat=True)
    dome("smooth, stretched", metal, 1, 0, scale=long)
    dome("smooth, mirrored", metal, 2, 0, scale=mirrored)
    dome("flat, stretched", metal, 3, 0, flat=True, scale=long)
    first = dome("two users", metal, 0, 1, scale=long)
    dome("two users", metal, 1, 1, scale=long, data=first.data)
    bumpy = normal_map()
    bumpy.node_tree.nodes["Principled BSDF"].inputs["Metallic"].default_value = 1.0
    dome("normal map", bumpy, 2, 1)
    dome("normal map, stretched", bumpy, 3, 1, scale=long)
    parts.add_area_light(location=(0.5, 0.6, 1.4), size=1.5, size_y=1.0)
    camera = parts.add_camera((0.0, -2.6, 3.4), (0.65, 0.0, 0.0))
    bpy.context.view_layer.update()
    picture, notes = with_graphics(lambda: viewport_picture(camera, "specular"))
    expected, square = sampled_pictures(tmp_path / "domes.blend", ("specular",), 2)
    assert notes == [] and flat.data.normals_domain == "FACE"
    times = times_too_far(picture, expected["specular"]).max(axis=-1)
    usable = away_from_edges(square)
    worst = {number: times[usable & (square == number)].max() for number in range(2 * COLUMNS)}
    assert max(worst.values()) < 1.0, worst


def test_tangents_are_those_of_mikktspace():
    """Blender's own are for quads where there are some: the mesh is of triangles, some of them mirrored in UV."""
    parts.empty_scene()
    mesh = dome("Dome", parts.principled("Metal")[0], 0, 0).data
    triangles = [order for a, b, c, d in (face.vertices for face in mesh.polygons) for order in ((a, b, c), (a, c, d))]
    place = np.array([vertex.co for vertex in mesh.vertices])
    mesh = parts.add_mesh("Triangles", place.tolist(), triangles).data
    corner = np.array([loop.vertex_index for loop in mesh.loops])
    x, y = place[corner, :2].T
    uv = np.stack([np.abs(x - 0.1), y + 0.3 * x * x], axis=-1).astype(np.float32)
    mesh.uv_layers.new(name="UVMap").data.foreach_set("uv", uv.ravel())
    mesh.calc_tangents()
    expected = np.array([[*loop.tangent, loop.bitangent_sign] for loop in mesh.loops])
    normal = np.array([loop.normal for loop in mesh.loops], np.float32)
    triangles = np.arange(len(corner)).reshape(-1, 3)
    found = meshes.corner_tangents(place[corner].astype(np.float32), normal, uv, triangles)
    assert set(expected[:, 3]) == {-1.0, 1.0}
    np.testing.assert_allclose(found, expected, atol=1e-4)


def test_without_area_in_uv_tangents_are_those_of_nothing():
    place = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]], np.float32)
    up, uv = np.tile(np.float32([0, 0, 1]), (3, 1)), np.full((3, 2), 0.5, np.float32)
    found = meshes.corner_tangents(place, up, uv, np.array([[0, 1, 2]]))
    np.testing.assert_array_equal(found, np.tile([1.0, 0.0, 0.0, -1.0], (3, 1)))
