"""Moves a scene that is far from the origin to it (in the child).

Blender and Cycles store positions in single precision: 100 km away they are 8 mm apart. All that is rendered is moved
by the same vector; if one object does not follow, everything is moved back.
"""

from __future__ import annotations

import bpy
import numpy as np

from ...scene import listed
from ..evaluated import SURFACE_TYPES, with_render_depsgraph
from ..materials.graph import tree_in_use

# FAR: in m from the origin; up to there positions are at most 0.12 mm apart.
FAR = 2000.0
# TOLERANCE: how far in m a moved object may be from its expected place, in addition to rounding.
TOLERANCE = 1e-3
# NAMED: how many objects a warning names.
NAMED = 3


def move_to_origin(scene, eye: np.ndarray, warnings: list[str]) -> np.ndarray:
    """Move `scene` so that `new_origin` comes to the origin; returns that place (3,) in m, or 0 if nothing moved.

    `eye` (3,) is the position of the camera. Nothing moves if no object is farther away than FAR.
    """
    nowhere = np.zeros(3)
    if not any(np.abs(_corners(ob)).max() > FAR for ob in scene.objects):
        return nowhere
    matrices = with_render_depsgraph(scene, _places)
    lights = [matrix[:3, 3] for (_, kind), matrix in matrices if kind == "LIGHT"] or [eye]
    origin = new_origin(np.array(lights), eye)
    if not origin.any():
        return nowhere
    apart = float(np.spacing(np.float32(np.abs(origin).max())))
    where = f"what is seen, or its nearest light, is {np.linalg.norm(origin):.3g} m from the origin"
    lost = _moved(scene, origin, matrices)
    if lost:
        warnings.append(
            f"{where}: positions there are {1000.0 * apart:.2g} mm apart, which changes light from 1 m away by some "
            f"{float(f'{min(1000.0 * apart, 100.0):.2g}'):g} %, in Cycles and in the techniques; the scene could not "
            f"be moved to the origin, for {listed(map(repr, lost), NAMED)} would not follow: move it there"
        )
        return nowhere
    warnings.append(
        f"{where}, where positions are {1000.0 * apart:.2g} mm apart: techniques and Cycles show it as if it lay at "
        "the origin; in Blender, Cycles shows it with that rounding"
    )
    return origin


def new_origin(lights: np.ndarray, eye: np.ndarray) -> np.ndarray:
    """The place (3,), in whole m, that should become the origin; 0 if it is not far from the origin.

    It is the one of `lights` (N, 3) nearest to `eye` (3,). It is the eye instead if that light is far from the origin
    and the eye is nearer to the origin than to the light.
    """
    nearest = lights[np.argmin(np.linalg.norm(lights - eye, axis=1))]
    if np.abs(nearest).max() > FAR and np.linalg.norm(nearest - eye) > np.linalg.norm(eye):
        nearest = eye
    is_far = np.abs(nearest).max() > FAR and np.isfinite(nearest).all()
    return np.round(nearest).astype(np.float32).astype(np.float64) if is_far else np.zeros(3)


def _corners(ob) -> np.ndarray:
    """Corners (N, 3) of the box around an object with a surface; the position (1, 3) of any other object."""
    matrix = np.array(ob.matrix_world, dtype=np.float64)
    corners = np.array(ob.bound_box, dtype=np.float64) if ob.type in SURFACE_TYPES else np.zeros((1, 3))
    with np.errstate(invalid="ignore"):  # an object may be nowhere
        return corners @ matrix[:3, :3].T + matrix[:3, 3]


def box_center(ob) -> np.ndarray:
    """The middle (3,) of the box around an object."""
    return _corners(ob).mean(axis=0)


def _places(depsgraph) -> list[tuple]:
    """((name, type), matrix (4, 4)) of the camera and of all that is rendered except suns, in a fixed order."""
    matrices = []
    for instance in depsgraph.object_instances:
        ob = instance.object
        if ob.type in ("LIGHT", *SURFACE_TYPES) and (ob.type != "LIGHT" or ob.data.type != "SUN"):
            matrices.append(((ob.original.name, ob.type), np.array(instance.matrix_world, dtype=np.float64)))
    camera = depsgraph.scene_eval.camera
    if camera is not None:
        matrices.append(((camera.original.name, "CAMERA"), np.array(camera.matrix_world, dtype=np.float64)))
    return matrices


def _moved(scene, origin: np.ndarray, places) -> list[str]:
    """Move the scene by -origin. If objects do not follow, undo everything and return their names, else []."""
    roots = [ob for ob in scene.objects if ob.parent is None]
    collections = {collection for ob in scene.objects for collection in ob.users_collection}
    before = {ob: tuple(ob.delta_location) for ob in roots}
    offsets = {collection: tuple(collection.instance_offset) for collection in collections}
    for ob in roots:
        ob.delta_location = np.array(ob.delta_location) - origin
    for collection in collections - {scene.collection}:
        # Otherwise instances of the collection would move twice: with its objects and with the instancer.
        collection.instance_offset = np.array(collection.instance_offset) - origin
    lost = _lost(places, with_render_depsgraph(scene, _places), origin)
    carried = [ob for ob in roots if ob.name in lost]
    if carried:
        # Their constraints may follow objects that have moved: try without moving them.
        for ob in carried:
            ob.delta_location = before[ob]
        lost = _lost(places, with_render_depsgraph(scene, _places), origin)
    if not lost:
        _keep_texture_space(origin)
        return []
    for ob, local in before.items():
        ob.delta_location = local
    for collection, local in offsets.items():
        collection.instance_offset = local
    bpy.context.view_layer.update()
    return lost


def _lost(before, after, origin) -> list[str]:
    """Names of the objects that did not move by -origin."""
    if [key for key, _ in before] != [key for key, _ in after]:
        return [name for name, _ in dict.fromkeys(key for key, _ in before)]
    lost = {}
    for ((name, _), old), (_, new) in zip(before, after, strict=True):
        # Half a last digit of the coordinate for each term of its sum.
        rounding = 4.0 * np.spacing(np.abs(old[:3, 3]).max().astype(np.float32))
        same_axes = np.allclose(old[:3, :3], new[:3, :3], rtol=1e-5, atol=1e-5 * np.abs(old[:3, :3]).max())
        if not same_axes or np.abs(old[:3, 3] - origin - new[:3, 3]).max() > TOLERANCE + rounding:
            lost[name] = None
    return list(lost)


def _keep_texture_space(origin: np.ndarray) -> None:
    """Make the Position outputs of materials and lights give the positions before the move."""
    trees = [tree_in_use(block) for block in (*bpy.data.materials, *bpy.data.lights)]
    for tree in [*filter(None, trees), *(group for group in bpy.data.node_groups if group.type == "SHADER")]:
        for node in list(tree.nodes):
            output = node.outputs.get("Position") if node.bl_idname == "ShaderNodeNewGeometry" else None
            if output is None or not output.links:
                continue
            targets = [link.to_socket for link in output.links]
            back = tree.nodes.new("ShaderNodeVectorMath")
            back.operation, back.inputs[1].default_value = "ADD", origin
            tree.links.new(output, back.inputs[0])
            for target in targets:
                tree.links.new(back.outputs[0], target)
