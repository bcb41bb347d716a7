"""The highlight of a light follows the mouse: the light moves, keeps its distance and faces the surface."""

from __future__ import annotations

from dataclasses import dataclass

import bpy
import numpy as np
from bpy_extras import view3d_utils
from mathutils import Matrix, Vector
from mathutils.interpolate import poly_3d_calc

from ...scene import SurfaceSamples
from ...shading.highlight import STENCIL, mirrored, place_for_highlight
from ..evaluated import EmitterTraits
from ..lights.area import area_light
from ..lights.groups import is_animated
from ..lights.linking import Receivers
from ..materials.preview_material import COAT, METALS, PreviewMaterial, preview_of
from .preview import PASSED_ON, OnActiveLight, active_light, region_under

# SPACING: pixels between the rays around the cursor. FARTHER: the factor of the distance by a step of the wheel.
SPACING, FARTHER = 2.0, 1.1
# Kinds of lobes without a highlight.
DULL = ("diffuse", "sheen", "velvet", "translucent")
NO_PEAK = "no peak of the highlight here: the surface is seen too flat, or is too rough"
KEYS = "Drag the highlight of {}    Wheel: distance, {:.3g} m    Esc: Cancel"


@dataclass(frozen=True)
class SurfaceHit:
    """What a ray of the view meets."""

    position: Vector
    normal: Vector  # interpolated, towards the view
    view: Vector
    material: bpy.types.Material | None


def reason_to_stay(ob) -> str:
    """Why the mouse may not move a light; "" if it may."""
    if ob.library is not None or (ob.override_library is not None and ob.override_library.is_system_override):
        return "it is linked from another file"
    if active := [constraint.name for constraint in ob.constraints if constraint.enabled]:
        return f"its constraint {active[0]!r} moves it: switch it off or apply it"
    if is_animated(ob):
        return "it is animated or driven"
    if any(ob.lock_rotation) or (any(ob.lock_location) and ob.data.type != "SUN"):
        return "its location or rotation is locked: unlock it in the tab Item"
    return ""


def surface_hit(scene, depsgraph, start: Vector, direction: Vector) -> SurfaceHit | None:
    """The first surface in a unit `direction` from `start`; None where there is none."""
    is_hit, position, normal, face, ob, matrix = scene.ray_cast(depsgraph, start, direction)
    if not is_hit:
        return None
    mesh, material = ob.evaluated_get(depsgraph).data, None
    if isinstance(mesh, bpy.types.Mesh) and face < len(mesh.polygons):
        polygon = mesh.polygons[face]
        corners = [mesh.vertices[mesh.loops[index].vertex_index].co for index in polygon.loop_indices]
        weights = poly_3d_calc(corners, matrix.inverted_safe() @ position)
        normals = (mesh.corner_normals[index].vector for index in polygon.loop_indices)
        smooth = sum((weight * one for weight, one in zip(weights, normals, strict=True)), Vector())
        normal = (matrix.to_3x3().inverted_safe().transposed() @ smooth).normalized()
        slots = ob.material_slots
        material = slots[min(polygon.material_index, len(slots) - 1)].material if len(slots) else None
    if normal.dot(direction) > 0.0:
        normal = -normal
    return SurfaceHit(position, normal, -direction, material)


def glossy_lobe(material) -> PreviewMaterial | None:
    """The first lobe of a material that has highlights."""
    lobes = preview_of(None if material is None else material.original).lobes
    return next((lobe for lobe in lobes if lobe.kind not in DULL and not lobe.is_clear), None)


def samples_of(hits: list[SurfaceHit], lobe: PreviewMaterial) -> SurfaceSamples:
    """Samples at `hits` of one lobe, whose textures count as their means."""
    count, white = len(hits), np.ones((len(hits), 3))
    position, view, normal = (np.array([getattr(hit, name) for hit in hits]) for name in ("position", "view", "normal"))
    coat = lobe.coat if lobe.kind == COAT else None
    roughness = coat.roughness if coat is not None else float(np.mean(lobe.value("roughness").offset))
    is_metal = coat is None and (lobe.kind in METALS or float(np.mean(lobe.value("metallic").offset)) > 0.5)
    ior = coat.ior if coat is not None else max(float(np.mean(lobe.value("ior").offset)), 1.01)
    return SurfaceSamples(
        position=position, view=view, normal=normal, diffuse_normal=normal, roughness=np.full(count, roughness),
        specular_f0=0.8 * is_metal * white, specular_f90=float(is_metal) * white,
        dielectric=(1.0 - is_metal) * white, ior=np.full(count, ior), diffuse_albedo=0.0 * white,
    )  # fmt: skip


def light_matrix(ob, point: Vector, direction: Vector, distance: float) -> Matrix:
    """The matrix of the light object `ob` in `direction` from a point, which it faces; a sun stays where it is."""
    where = ob.matrix_world.translation if ob.data.type == "SUN" else point + distance * direction
    return Matrix.LocRotScale(where, direction.to_track_quat("Z", "Y"), ob.matrix_world.to_scale())


def place_of(ob, hits: list[SurfaceHit], distance: float) -> tuple[Matrix, str]:
    """The matrix of the light object `ob` for a highlight at the middle one of the nine `hits`, or at the only one by
    its mirrored view; and what there is to say about it."""
    hit = hits[len(hits) // 2]
    lobe, receivers = glossy_lobe(hit.material), Receivers([])

    def matrix_at(direction: np.ndarray) -> Matrix:
        return light_matrix(ob, hit.position, Vector(direction), distance)

    def light_at(direction: np.ndarray):
        return area_light(ob, np.array(matrix_at(direction)), EmitterTraits("", True, True), receivers)

    if lobe is None or len(hits) < len(STENCIL):
        matrix = matrix_at(mirrored(np.array(hit.view), np.array(hit.normal)))
        return matrix, "this surface has no highlight" if lobe is None else ""
    place = place_for_highlight(samples_of(hits, lobe), light_at)
    return matrix_at(place.direction), "" if place.is_peak else NO_PEAK


class LTSH_OT_drag_highlight(OnActiveLight, bpy.types.Operator):
    """Drag the highlight of the active light over surfaces in a 3D view: the light follows, keeps its distance and
    faces them"""

    bl_idname = "ltsh.drag_highlight"
    bl_label = "Drag Highlight"
    bl_options = {"UNDO"}

    @classmethod
    def poll(cls, context):
        if not super().poll(context):
            return False
        light = active_light(context)
        if reason := reason_to_stay(light):
            cls.poll_message_set(f"{light.name}: {reason}")
        return not reason

    def invoke(self, context, event):
        self._light = active_light(context)
        self._former, self._distance = self._light.matrix_world.copy(), 0.0
        self._is_dragged, self._note = False, ""
        context.window_manager.modal_handler_add(self)
        context.window.cursor_modal_set("CROSSHAIR")
        self._tell(context)
        return {"RUNNING_MODAL"}

    def modal(self, context, event):
        if event.type in ("ESC", "RIGHTMOUSE"):
            self.cancel(context)
            return {"CANCELLED"}
        if event.type == "LEFTMOUSE":
            if event.value == "RELEASE" and self._is_dragged:
                self._end(context)
                return {"FINISHED"}
            self._is_dragged = event.value == "PRESS" and self._follow(context, event)
        elif self._is_dragged and event.type in ("WHEELUPMOUSE", "WHEELDOWNMOUSE"):
            self._distance *= FARTHER if event.type == "WHEELUPMOUSE" else 1.0 / FARTHER
            self._follow(context, event)
        elif self._is_dragged and event.type == "MOUSEMOVE":
            self._follow(context, event)
        elif event.type.startswith(PASSED_ON):
            return {"PASS_THROUGH"}
        return {"RUNNING_MODAL"}

    def cancel(self, context):
        """Put the light back; also called by Blender when the window is closed."""
        self._end(context)
        self._light.matrix_world = self._former

    def _end(self, context) -> None:
        context.workspace.status_text_set(None)
        context.window.cursor_modal_restore()

    def _tell(self, context) -> None:
        text = KEYS.format(self._light.name, self._distance)
        context.workspace.status_text_set(f"{text}    {self._note}" if self._note else text)

    def _follow(self, context, event) -> bool:
        """Move the light so that its highlight is at the mouse; False where no surface is."""
        region = region_under(context, event.mouse_x, event.mouse_y)
        if region is None:
            return False
        hits = hits_around(context, region, (event.mouse_x - region.x, event.mouse_y - region.y))
        if not hits:
            self._note = "there is no surface under the mouse"
        else:
            middle = hits[len(hits) // 2].position
            self._distance = self._distance or max((self._former.translation - middle).length, 1e-3)
            self._light.matrix_world, self._note = place_of(self._light, hits, self._distance)
        self._tell(context)
        return bool(hits)


def hits_around(context, region, pixel: tuple[float, float]) -> list[SurfaceHit]:
    """What the view of a region meets at a pixel and at those of STENCIL around it: nine, one, or none."""
    hits, depsgraph = [], context.evaluated_depsgraph_get()
    for right, up in STENCIL:
        where = pixel[0] + SPACING * right, pixel[1] + SPACING * up
        start = view3d_utils.region_2d_to_origin_3d(region, region.data, where)
        direction = view3d_utils.region_2d_to_vector_3d(region, region.data, where)
        hits.append(surface_hit(context.scene, depsgraph, start, direction))
    middle = hits[len(hits) // 2]
    if middle is None:
        return []
    is_one = all(hit is not None and hit.material == middle.material for hit in hits)
    return hits if is_one else [middle]
