"""The shapes of what blocks light: meshes by their transparency, and hair and points as meshes: tubes and balls with
flat faces and the mean width of round ones."""

import math
from functools import cache

import bmesh
import bpy
import numpy as np

from ...visibility.occluders import OccluderMesh, Transparency
from ..evaluated import normals_at_corners, read_values

# ONE_INSTANCE: the matrices of occluders that are not points.
ONE_INSTANCE = np.eye(4)[None]
# MOST_PIECES: hair or points with more pieces block nothing; such hair would take some 0.7 GiB.
MOST_PIECES = 1_000_000
TOO_MANY = f"{{:,}} pieces of hair or points block nothing, more than {MOST_PIECES:,}; all of their shadow is lost"
TUBES = "hair blocks as tubes of three flat sides: single hairs are up to 9 % too wide or too narrow, on average right"
TUBE_SIDES = 3
# BALL_THICKNESS: the largest distance of a ball of radius 1 from the flat faces that stand for it.
BALL_THICKNESS = 0.08
# POINT_RADIUS: in m, as in Cycles, of points without a radius.
POINT_RADIUS = 0.01


def tubes_of_curves(ob, clear, note) -> list[OccluderMesh]:
    """Tubes along hair curves."""
    curves = ob.data
    points = len(curves.points)
    if points > MOST_PIECES:
        note(TOO_MANY.format(points), ob)
        return []
    if not points:
        return []
    note(TUBES, ob)
    positions, radii = points_of(curves)
    first = read_values(curves.curves, "first_point_index", (len(curves.curves),), np.int32)
    return [_tubes(positions, radii, first, _constant_transparency(clear, ob, note))]


def hairs_of(system, is_view: bool) -> tuple[range, int]:
    """The hairs of a particle system that Cycles shows, by their numbers, and how many points each has. Children hide
    their parents, and only they have the extra points of spirals, which end a point early. Views and renders have
    points of their own; what is beyond them is the world's origin."""
    settings, parents, children = system.settings, len(system.particles), len(system.child_particles)
    steps = settings.display_step if is_view else settings.render_step
    if is_view:
        children = children * settings.display_percentage // 100
    has_children = settings.child_type != "NONE" and children > 0
    more = max(settings.kink_extra_steps, 1) if has_children and settings.kink == "SPIRAL" else 1
    return range(parents if has_children else 0, parents + children), 2**steps + more


def tubes_of_hair(ob, system, numbers, steps, clear) -> OccluderMesh:
    """Tubes along the hairs `numbers` of a particle system, with `steps` points each, in world space."""
    settings = system.settings
    positions = np.array(
        [[system.co_hair(object=ob, particle_no=number, step=step) for step in range(steps)] for number in numbers],
        np.float32,
    ).reshape(-1, steps, 3)
    positions = np.where(np.isfinite(positions), positions, np.roll(positions, 1, axis=1))  # spirals of one step
    along = np.linalg.norm(np.diff(positions, axis=1, prepend=positions[:, :1]), axis=2).cumsum(axis=1)
    along /= np.maximum(along[:, -1:], 1e-30)
    root, tip = 0.5 * settings.radius_scale * settings.root_radius, 0.5 * settings.radius_scale * settings.tip_radius
    power = 1.0 + settings.shape if settings.shape < 0.0 else 1.0 / max(1.0 - settings.shape, 1e-6)
    radii = (tip + (root - tip) * np.maximum(1.0 - along, 0.0) ** power).astype(np.float32)
    if settings.use_close_tip:
        radii[:, -1] = 0.0
    first = np.arange(len(numbers)) * steps
    return _tubes(positions.reshape(-1, 3), radii.ravel(), first, _constant_transparency(clear))


def _constant_transparency(clear, ob=None, note=None) -> Transparency | None:
    """The transparency of hair or points, from place to place of which it is not read."""
    if clear is None:
        return None
    if clear.shares:
        return Transparency(float(np.mean(clear.shares)))
    if note is not None:
        note("transparency that varies along hair or points is not read here, all of their shadow is there", ob)
    return None


def _tubes(positions, radii, first, transparency) -> OccluderMesh:
    """Tubes around curves through `positions` that begin at the points `first`, with the mean width of round tubes."""
    points, sides = len(positions), TUBE_SIDES
    starts = np.ones(points, bool)
    starts[first] = False
    ends = np.flatnonzero(starts)  # end points of the pieces; each piece begins at the point before
    along = np.zeros((points, 3))
    along[ends] += positions[ends] - positions[ends - 1]
    along[ends - 1] += positions[ends] - positions[ends - 1]
    along /= np.maximum(np.linalg.norm(along, axis=1, keepdims=True), 1e-30)
    axis = np.eye(3)[np.abs(along).argmin(axis=1)]
    x = np.cross(along, axis)
    x /= np.maximum(np.linalg.norm(x, axis=1, keepdims=True), 1e-30)
    y = np.cross(along, x)
    # The mean width of a convex outline over all directions is its length over pi.
    out = radii.astype(np.float64) * math.pi / (sides * math.sin(math.pi / sides))
    angle = 2.0 * math.pi * np.arange(sides) / sides
    ring = np.cos(angle)[:, None] * x[:, None] + np.sin(angle)[:, None] * y[:, None]
    vertices = (positions[:, None] + out[:, None, None] * ring).reshape(-1, 3)
    one, two = np.arange(sides), (np.arange(sides) + 1) % sides
    low, high = (ends - 1)[:, None] * sides, ends[:, None] * sides
    triangles = np.stack([low + one, low + two, high + two, low + one, high + two, high + one], axis=-1)
    # The shaded surface is a ribbon through the middle or a round tube, and bends where these pieces are straight.
    thickness = np.repeat(1.3 * np.maximum(out[ends], out[ends - 1]), 2 * sides)
    return OccluderMesh(vertices, triangles.reshape(-1, 3), transparency, thickness=thickness)


def balls(ob, clear, note) -> tuple[list[OccluderMesh], np.ndarray]:
    """A list of one ball, and its matrices (N, 4, 4) in a point cloud."""
    cloud = ob.data
    count = len(cloud.points)
    if count > MOST_PIECES:
        note(TOO_MANY.format(count), ob)
        count = 0
    if not count:
        return [], ONE_INSTANCE
    note("points block as balls of 80 flat faces: the outlines of their shadows are up to 4 % of the radius off", ob)
    matrices = np.zeros((count, 4, 4))
    matrices[:, :3, 3], radii = points_of(cloud)
    matrices[:, range(3), range(3)] = radii[:, None]
    matrices[:, 3, 3] = 1.0
    vertices, triangles = _ball_as_wide()
    transparency, thickness = _constant_transparency(clear, ob, note), np.full(len(triangles), BALL_THICKNESS)
    return [OccluderMesh(vertices, triangles, transparency, thickness=thickness)], matrices


def points_of(data) -> tuple[np.ndarray, np.ndarray]:
    """Positions (N, 3) and radii (N,) of the points of a point cloud or of hair curves, in m."""
    count = len(data.points)
    radii = np.full(count, POINT_RADIUS, np.float32)
    if "radius" in data.attributes:
        radii = read_values(data.attributes["radius"].data, "value", (count,), np.float32)
    return read_values(data.attributes["position"].data, "vector", (count, 3), np.float32), radii


def _ball_as_wide():
    """Vertices and triangles of a ball of 80 triangles with the same mean shadow as a sphere of radius 1."""
    vertices, triangles = ball(2)
    a, b, c = np.moveaxis(vertices[triangles], 1, 0)
    # The mean shadow of a convex body is a quarter of its surface area.
    area = 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1).sum()
    return vertices * math.sqrt(4.0 * math.pi / area), triangles


@cache
def ball(subdivisions: int) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (V, 3) of length 1 and outward triangles (T, 3) of an icosphere: 20 for 1 subdivision, 80 for 2."""
    mesh = bmesh.new()
    bmesh.ops.create_icosphere(mesh, subdivisions=subdivisions, radius=1.0)
    vertices = np.array([vertex.co for vertex in mesh.verts])
    triangles = np.array([[vertex.index for vertex in face.verts] for face in mesh.faces])
    mesh.free()
    return vertices / np.linalg.norm(vertices, axis=1, keepdims=True), triangles


def shape_key(ob) -> tuple:
    """A key of the evaluated data of an object, valid while the depsgraph does not change."""
    data = ob.data
    is_mesh = isinstance(data, bpy.types.Mesh)
    original = data.original.session_uid if data.original is not None else 0
    owner = 0 if is_mesh and not ob.modifiers else ob.original.session_uid
    return owner, original, data.as_pointer(), len(data.vertices) if is_mesh else 0


def split_by_slot(ob, clear: list, image_of) -> list[OccluderMesh]:
    """Meshes of `ob`: one of all faces that block, and one per slot of those that let light through."""
    mesh = ob.to_mesh()
    if mesh is None:
        return []
    try:
        return split_mesh(mesh, clear, image_of)
    finally:
        ob.to_mesh_clear()


def split_mesh(mesh, clear: list, image_of, moved=None) -> list[OccluderMesh]:
    """As `split_by_slot`, of a mesh, whose vertices are then changed by `moved` (V, 3)."""
    mesh.calc_loop_triangles()
    count = len(mesh.loop_triangles)
    if not count:
        return []
    loops, triangles = (read_values(mesh.loop_triangles, name, (count, 3), np.int32) for name in ("loops", "vertices"))
    slots = np.clip(read_values(mesh.loop_triangles, "material_index", (count,), np.int32), 0, len(clear) - 1)
    vertices = read_values(mesh.vertices, "co", (len(mesh.vertices), 3), np.float32)
    if moved is not None:  # which triangles faces have does not change
        vertices += moved
        mesh.vertices.foreach_set("co", vertices.ravel())
        mesh.update()
    normals = None
    if mesh.normals_domain == "POINT":
        normals = read_values(mesh.vertex_normals, "vector", (len(vertices), 3), np.float32)
    elif mesh.normals_domain == "CORNER":
        normals = normals_at_corners(mesh)[0][loops]

    def uv_of(name):
        layers = mesh.uv_layers
        layer = layers.get(name) if name else next((other for other in layers if other.active_render), None)
        if layer is None:
            return np.zeros((count, 3, 2), np.float32)
        return read_values(layer.uv, "vector", (len(mesh.loops), 2), np.float32)[loops]

    meshes = []
    blocking = np.array([transparency is None for transparency in clear])
    for slot in [None, *(np.flatnonzero(~blocking))]:
        here = blocking[slots] if slot is None else slots == slot
        if not here.any():
            continue
        transparency = None
        if slot is not None:
            transparency = clear[slot].transparency(
                int(slot), int(here.sum()), lambda name, here=here: uv_of(name)[here], image_of
            )
            if transparency.share == 1.0 and transparency.image is None:
                continue
        meshes.append(_submesh(vertices, triangles, normals, here, transparency))
    return meshes


def _submesh(vertices, triangles, normals, here, transparency) -> OccluderMesh:
    if here.all():
        return OccluderMesh(vertices, triangles, transparency, normals)
    used, named = np.unique(triangles[here], return_inverse=True)
    if normals is not None:
        normals = normals[used] if normals.ndim == 2 else normals[here]
    return OccluderMesh(vertices[used], named.reshape(-1, 3), transparency, normals)
