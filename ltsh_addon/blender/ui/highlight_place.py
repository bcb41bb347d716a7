"""Where a light object must be for its highlight to be at the mouse: the surface around the mouse, read by rays."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
from mathutils import Matrix, Vector

from ...cycles.horizons import end_at_horizons_of_cycles, unit, valid_specular_normal
from ...scene import SurfaceSamples
from ...shading import shade
from ...shading.highlight import STENCIL, MovedLight, mirrored, place_for_highlight
from ..evaluated import EmitterTraits
from ..lights.area import area_light
from ..lights.linking import Receivers, linked_objects, receiver_collection
from ..lights.textures import ShownTextures
from ..materials.preview_material import COAT, METALS, PreviewMaterial, preview_of
from .light_pose import LightPose
from .lit_point import SurfaceHit, shipped_table, value_at_hit

# SPACING: pixels between the nine rays around the mouse. DISK: further rays, pixels from it, in which no highlight may
# be brighter than at the mouse: rings, denser near it.
SPACING, RINGS = 2.0, ((3.0, 12), (4.7, 14), (7.0, 16), (10.0, 20), (13.5, 24), (17.0, 28), (20.0, 36))
DISK = np.concatenate([
    radius * np.stack([np.cos(turns), np.sin(turns)], axis=-1)
    for radius, count in RINGS for turns in [2.0 * np.pi * (np.arange(count) + 0.5 * (count % 4)) / count]
])  # fmt: skip
# BRIGHTER: by how much a pixel around may be brighter. PIXELS: those that DISK stands for.
BRIGHTER = 0.01
_GRID = np.stack(np.meshgrid(np.arange(-20.0, 21.0), np.arange(-20.0, 21.0)), axis=-1).reshape(-1, 2)
PIXELS = _GRID[np.hypot(*_GRID.T) <= 20.0]
# Kinds of lobes without a highlight.
DULL = ("diffuse", "sheen", "velvet", "translucent")
NO_HIGHLIGHT = "this surface has no highlight"
NO_PEAK = "no peak of the highlight here: the surface is seen too flat, or is too rough"
BEHIND = "the light does not reach this side of the surface"
BESIDE = "the surface bends: its highlight beside the mouse is brighter"
AT_RIM = "the surface ends here: its highlight follows the mirrored view"


def glossy_lobe(material) -> PreviewMaterial | None:
    """The first lobe of a material that has highlights."""
    lobes = preview_of(None if material is None else material.original).lobes
    return next((lobe for lobe in lobes if lobe.kind not in DULL and not lobe.is_clear), None)


def samples_of(hits: list[SurfaceHit], lobe: PreviewMaterial, textures: ShownTextures) -> SurfaceSamples:
    """Samples at `hits` of the reflection of one lobe, with its values at the middle one of the first nine, and the
    normals of its normal map."""
    count, white, middle = len(hits), np.ones((len(hits), 3)), hits[len(STENCIL) // 2 if len(hits) > 1 else 0]
    position, view, normal, true = (
        np.array([getattr(hit, name) for hit in hits]) for name in ("position", "view", "normal", "face_normal")
    )
    smooth, coat, brush = normal, lobe.coat if lobe.kind == COAT else None, lobe.brush
    if lobe.normal is not None:
        normal = unit(np.array([_mapped_normal(hit, lobe, textures) for hit in hits]))
    bent = valid_specular_normal(normal, true, view) if lobe.corrected else normal
    anisotropy, tangent = 0.0, np.zeros((count, 3))
    if brush is not None:
        anisotropy = 1.0 - brush.aspect
        along = np.array([_brush_direction(hit, brush) for hit in hits])
        along = unit(along - (along * smooth).sum(axis=-1, keepdims=True) * smooth)
        axis = bent if lobe.kind == "glossy" else normal
        beside = (axis * along).sum(axis=-1, keepdims=True) * axis
        turn = 2.0 * math.pi * brush.rotation
        tangent = beside + math.cos(turn) * (along - beside) + math.sin(turn) * np.cross(axis, along)

    def at_middle(name: str) -> float:
        return float(np.mean(value_at_hit(lobe.value(name), middle, textures)))

    roughness = float(np.clip(coat.roughness if coat is not None else at_middle("roughness"), 0.0, 1.0))
    is_metal = coat is None and (lobe.kind in METALS or at_middle("metallic") > 0.5)
    ior = coat.ior if coat is not None else max(at_middle("ior"), 1.01)
    return SurfaceSamples(
        position=position, view=view, normal=bent, diffuse_normal=bent, geometric_normal=true,
        roughness=np.full(count, roughness), specular_f0=0.8 * is_metal * white, specular_f90=is_metal * white,
        dielectric=(1.0 - is_metal) * white, ior=np.full(count, ior), diffuse_albedo=0.0 * white,
        anisotropy=np.full(count, anisotropy), tangent=tangent,
    )  # fmt: skip


def _mapped_normal(hit: SurfaceHit, lobe: PreviewMaterial, textures: ShownTextures) -> np.ndarray:
    """The normal (3,) of a tangent space normal map."""
    normal, frame = np.array(hit.normal), hit.uv_frame(lobe.uv_map)
    if frame is None:
        return normal
    x, y, z = 2.0 * value_at_hit(lobe.normal, hit, textures) - 1.0
    tangent = unit(frame[0] - (frame[0] @ normal) * normal)
    strength = lobe.normal_strength
    z = 1.0 + min(max(strength, 0.0), 1.0) * (z - 1.0)
    bitangent = np.cross(normal, tangent)
    bitangent *= math.copysign(1.0, frame[1] @ bitangent)
    return strength * x * tangent + strength * y * bitangent + z * normal


def _brush_direction(hit: SurfaceHit, brush) -> np.ndarray:
    """The direction (3,) of an anisotropic lobe, before its rotation."""
    if not brush.direction:
        frame = hit.uv_frame(brush.uv_map)
        return np.zeros(3) if frame is None else frame[0]
    return hit.around("XYZ".index(brush.direction))


def place_of(ob, pose: LightPose, hits: list[SurfaceHit], distance: float, textures: ShownTextures) -> tuple:
    """The matrix of the light object `ob` for a highlight at the middle one of the nine first `hits`, which others of
    the same surface around follow, or at the only one by its mirrored view; and what there is to say about it."""
    hit = hits[len(STENCIL) // 2 if len(hits) > 1 else 0]
    lobe = glossy_lobe(hit.material)

    def matrix_at(direction: np.ndarray) -> Matrix:
        return pose.facing(hit.position, Vector(direction), distance)

    if lobe is None or len(hits) == 1:
        return matrix_at(mirrored(np.array(hit.view), np.array(hit.normal))), NO_HIGHLIGHT if lobe is None else AT_RIM
    light = MovedLight(lambda direction: np.array(matrix_at(direction)), lambda matrix: _light(ob, matrix))
    place = place_for_highlight(samples_of(hits, lobe, textures), light, shipped_table())
    note = (BESIDE if place.is_beside else NO_PEAK) if not place.is_peak else ""
    return matrix_at(place.direction), unlinked(ob, hit) or note or unread(hit.material)


def unlinked(ob, hit: SurfaceHit) -> str:
    """That light linking keeps the light object `ob` from the surface; "" if it does not."""
    receivers = receiver_collection(ob)
    is_lit = receivers is None or linked_objects(receivers).reach(hit.ob.name_full)
    return "" if is_lit else f"{ob.name} does not light {hit.ob.name}, by light linking"


def unread(material) -> str:
    """What of a material's normals is not read, and moves its highlights; "" without any."""
    notes = preview_of(None if material is None else material.original).notes
    return ", ".join(note for note in notes if "normals from" in note or "anisotropy" in note)


def note_by_pixels(ob, matrix: Matrix, hits: list[SurfaceHit], textures: ShownTextures) -> str:
    """Why the highlight of the light object `ob`, at `matrix` now, is not at the middle one of the nine first
    `hits`, by all of them; "" where it is."""
    lobe = glossy_lobe(hits[0].material)
    if len(hits) == 1 or lobe is None:
        return NO_HIGHLIGHT if lobe is None else AT_RIM
    if note := unlinked(ob, hits[0]):
        return note
    samples, light = samples_of(hits, lobe, textures), _light(ob, np.array(matrix))
    samples, _ = end_at_horizons_of_cycles(samples, [light], np.zeros(len(samples), int))
    radiance = shade(samples, [light], shipped_table(), passes=("specular",), workers=1).specular.sum(axis=(0, 2))
    here = radiance[len(STENCIL) // 2]
    if here <= 0.0:
        return BEHIND
    return unread(hits[0].material) if radiance.max() <= (1.0 + BRIGHTER) * here else BESIDE


def _light(ob, matrix: np.ndarray):
    # Samples have no numbers of receivers: `unlinked` tells of light linking.
    return replace(area_light(ob, matrix, EmitterTraits("", True, True), Receivers([ob])), receivers=None)


def hits_around(hit_at: Callable[[np.ndarray], SurfaceHit | None], disk: np.ndarray = DISK) -> list[SurfaceHit]:
    """What a view shows around the mouse, by `hit_at` for pixels from there: nine hits at those of STENCIL, then those
    of the same surface in the `disk` (P, 2); one or none at rims."""
    nine = [hit_at(offset) for offset in SPACING * STENCIL]
    at_mouse = nine[len(STENCIL) // 2]
    if at_mouse is None:
        return []

    def is_same(hit: SurfaceHit | None) -> bool:
        return hit is not None and hit.ob == at_mouse.ob and hit.material == at_mouse.material

    if not all(map(is_same, nine)):
        return [at_mouse]
    return [*nine, *filter(is_same, map(hit_at, disk))]
