"""Where a light object must be for its highlight to be at the mouse: the surface around the mouse, read by rays."""

import gc
import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property

import bpy
import numpy as np
from mathutils import Matrix, Vector

from ...cycles.horizons import end_at_horizons_of_cycles, unit, valid_specular_normal
from ...scene import SurfaceSamples
from ...shading import shade
from ...shading.highlight import BRIGHTER, QUICK, STENCIL, STRICT, THOROUGH, MovedLight, mirrored, place_for_highlight
from ..evaluated import EmitterTraits
from ..lights.area import area_light
from ..lights.linking import Receivers, linked_objects, receiver_collection
from ..lights.textures import ShownTextures
from ..materials.preview_material import COAT, FILTER, METALS, REFRACTION, PreviewMaterial, preview_of
from .light_pose import LightPose
from .lit_point import SurfaceHit, directions_around, hits_at, shipped_table, value_at_hits
from .preview import lights_of

# SPACING: pixels between the nine rays around the mouse. DISK: further rays, pixels from it, in which no highlight may
# be brighter than at the mouse: rings, denser near it.
SPACING, RINGS = 2.0, ((3.0, 12), (4.7, 14), (7.0, 16), (10.0, 20), (13.5, 24), (17.0, 28), (20.0, 36))
DISK = np.concatenate([
    radius * np.stack([np.cos(turns), np.sin(turns)], axis=-1)
    for radius, count in RINGS for turns in [2.0 * np.pi * (np.arange(count) + 0.5 * (count % 4)) / count]
])  # fmt: skip
# PIXELS: those that DISK stands for; a search by all of them takes every FEWER-th. NEAR: pixels from the mouse to a
# peak that counts as there.
NEAR, FEWER = 2.0, 2
_GRID = np.stack(np.meshgrid(np.arange(-20.0, 21.0), np.arange(-20.0, 21.0)), axis=-1).reshape(-1, 2)
PIXELS = _GRID[np.hypot(*_GRID.T) <= 20.0]
# GRID: by how many pixels, across and up, `prepare_view` looks for surfaces.
GRID = 9
# Kinds of lobes without a highlight.
DULL = ("diffuse", "sheen", "velvet", "translucent", REFRACTION, FILTER)
NO_HIGHLIGHT = "this surface has no highlight"
BEHIND = "the light does not reach this side of the surface"
BESIDE = "the surface bends: its highlight beside the mouse is brighter"


@dataclass(frozen=True)
class HitsAround:
    """What a view shows of one surface around the mouse."""

    hits: list[SurfaceHit]  # the one at the mouse first
    pixels: np.ndarray  # (P, 2) of the hits, from the mouse
    has_stencil: bool  # the first nine are those of STENCIL; False at rims

    @cached_property
    def _material(self) -> PreviewMaterial:
        material = self.hits[0].material
        return preview_of(None if material is None else material.original)

    @cached_property
    def lobe(self) -> PreviewMaterial | None:
        """The first lobe of the material that has highlights."""
        return next((lobe for lobe in self._material.lobes if lobe.kind not in DULL and not lobe.is_clear), None)

    @property
    def unread(self) -> str:
        """What of the material's normals is not read, and moves its highlights; "" without any."""
        notes = self._material.notes
        return ", ".join(note for note in notes if "normals from" in note or "anisotropy" in note)


def samples_of(hits: list[SurfaceHit], lobe: PreviewMaterial, textures: ShownTextures) -> SurfaceSamples:
    """Samples at `hits` of the reflection of one lobe, with its values at the first one, and the normals of its normal
    map."""
    count, white = len(hits), np.ones((len(hits), 3))
    position, view, normal, true = (
        np.array([getattr(hit, name)[:] for hit in hits]) for name in ("position", "view", "normal", "face_normal")
    )
    smooth, coat, brush = normal, lobe.coat if lobe.kind == COAT else None, lobe.brush
    if lobe.normal is not None:
        normal = _mapped_normals(hits, smooth, lobe, textures)
    bent = valid_specular_normal(normal, true, view) if lobe.corrected else normal
    anisotropy, tangent = 0.0, np.zeros((count, 3))
    if brush is not None:
        anisotropy = 1.0 - brush.aspect
        along = _brush_directions(hits, brush)
        along = unit(along - (along * smooth).sum(axis=-1, keepdims=True) * smooth)
        axis = bent if lobe.kind == "glossy" else normal
        beside = (axis * along).sum(axis=-1, keepdims=True) * axis
        turn = 2.0 * math.pi * brush.rotation
        tangent = beside + math.cos(turn) * (along - beside) + math.sin(turn) * np.cross(axis, along)

    def first(name: str) -> float:
        return float(np.mean(value_at_hits(lobe.value(name), hits[:1], textures)))

    roughness = float(np.clip(coat.roughness if coat is not None else first("roughness"), 0.0, 1.0))
    is_metal = coat is None and (lobe.kind in METALS or first("metallic") > 0.5)
    ior = coat.ior if coat is not None else max(first("ior"), 1.01)
    return SurfaceSamples(
        position=position, view=view, normal=bent, diffuse_normal=bent, geometric_normal=true,
        roughness=np.full(count, roughness), specular_f0=0.8 * is_metal * white, specular_f90=is_metal * white,
        dielectric=(1.0 - is_metal) * white, ior=np.full(count, ior), diffuse_albedo=0.0 * white,
        anisotropy=np.full(count, anisotropy), tangent=tangent,
    )  # fmt: skip


def _mapped_normals(hits: list[SurfaceHit], normals: np.ndarray, lobe: PreviewMaterial, textures) -> np.ndarray:
    """The normals (P, 3) of a tangent space normal map on surfaces with `normals` (P, 3)."""
    frames = [hit.uv_frame(lobe.uv_map) for hit in hits]
    along_u, along_v = np.array([np.zeros((2, 3)) if frame is None else frame for frame in frames]).transpose(1, 0, 2)
    x, y, z = (2.0 * value_at_hits(lobe.normal, hits, textures) - 1.0).T[..., None]
    tangent = along_u - (along_u * normals).sum(axis=-1, keepdims=True) * normals
    tangent /= np.maximum(np.linalg.norm(tangent, axis=-1, keepdims=True), 1e-30)
    bitangent = np.cross(normals, tangent)
    bitangent *= np.copysign(1.0, (along_v * bitangent).sum(axis=-1, keepdims=True))
    strength = lobe.normal_strength
    z = 1.0 + min(max(strength, 0.0), 1.0) * (z - 1.0)
    mapped = strength * x * tangent + strength * y * bitangent + z * normals
    return unit(np.where([[frame is None] for frame in frames], normals, mapped))


def _brush_directions(hits: list[SurfaceHit], brush) -> np.ndarray:
    """The directions (P, 3) of an anisotropic lobe, before its rotation."""
    if brush.direction:
        return directions_around(hits, "XYZ".index(brush.direction))
    frames = [hit.uv_frame(brush.uv_map) for hit in hits]
    return np.array([np.zeros(3) if frame is None else frame[0] for frame in frames])


def place_of(
    ob, pose: LightPose, around: HitsAround, distance: float, textures: ShownTextures, effort=QUICK
) -> tuple[Matrix, str]:
    """The matrix of the light object `ob` for a highlight at the mouse; and what there is to say about it."""
    hit, lobe = around.hits[0], around.lobe

    def matrix_at(direction: np.ndarray) -> Matrix:
        return pose.facing(hit.position, Vector(direction), distance)

    if lobe is None:
        return matrix_at(mirrored(np.array(hit.view), np.array(hit.normal))), NO_HIGHLIGHT
    light = MovedLight(lambda direction: np.array(matrix_at(direction)), lambda matrix: _light(ob, matrix))
    samples = samples_of(around.hits, lobe, textures)
    place = place_for_highlight(samples, light, shipped_table(), around.has_stencil, effort)
    note = "" if place.is_peak else BEHIND if math.isinf(place.excess) else BESIDE
    return matrix_at(place.direction), unlinked(ob, hit) or note or around.unread


def unlinked(ob, hit: SurfaceHit) -> str:
    """That light linking keeps the light object `ob` from the surface; "" if it does not."""
    receivers = receiver_collection(ob)
    is_lit = receivers is None or linked_objects(receivers).reach(hit.ob.name_full)
    return "" if is_lit else f"{ob.name} does not light {hit.ob.name}, by light linking"


def note_by_pixels(ob, matrix: Matrix, around: HitsAround, textures: ShownTextures, brighter=BRIGHTER) -> str:
    """Why the highlight of the light object `ob`, at `matrix` now, is not at the mouse, by all that is `around`; ""
    where it is. `brighter`: by how much a pixel may be brighter than the mouse."""
    hits, lobe = around.hits, around.lobe
    if lobe is None:
        return NO_HIGHLIGHT
    if note := unlinked(ob, hits[0]):
        return note
    samples, light = samples_of(hits, lobe, textures), _light(ob, np.array(matrix))
    samples, _ = end_at_horizons_of_cycles(samples, [light], np.zeros(len(samples), int))
    radiance = shade(samples, [light], shipped_table(), passes=("specular",), workers=1).specular.sum(axis=(0, 2))
    here = radiance[0]
    if here <= 0.0:
        return BEHIND
    is_there = radiance.max() <= (1.0 + brighter) * here or np.hypot(*around.pixels[np.argmax(radiance)]) <= NEAR
    return around.unread if is_there else BESIDE


def place_by_pixels(
    ob, pose: LightPose, matrix: Matrix, around: HitsAround, textures: ShownTextures, effort=THOROUGH
) -> tuple[Matrix, str]:
    """As `place_of`, by all pixels `around`, where the light object `ob` is not yet right at `matrix`: what shines
    between the samples of a move may be brighter. Takes too long for a move."""
    note = note_by_pixels(ob, matrix, around, textures, STRICT)
    if note != BESIDE:
        return matrix, note
    distance = (matrix.translation - around.hits[0].position).length
    few = [n for n in range(len(around.hits)) if n < len(STENCIL) or n % FEWER == 0]
    fewer = replace(around, hits=[around.hits[n] for n in few], pixels=around.pixels[few])
    better, _ = place_of(ob, pose, fewer, distance, textures, effort)
    for one, brighter in ((better, STRICT), (matrix, BRIGHTER), (better, BRIGHTER)):
        if (note := note_by_pixels(ob, one, around, textures, brighter)) != BESIDE:
            return one, note
    return matrix, BESIDE


def _light(ob, matrix: np.ndarray):
    # Samples have no numbers of receivers: `unlinked` tells of light linking.
    return replace(area_light(ob, matrix, EmitterTraits("", True, True), Receivers([ob])), receivers=None)


def hits_around(hits_at: Callable[[np.ndarray], list], disk: np.ndarray = DISK) -> HitsAround | None:
    """What a view shows around the mouse in the `disk` (P, 2), by `hits_at` for pixels (P, 2) from there; None without
    a surface at the mouse."""
    stencil = SPACING * STENCIL
    pixels = np.concatenate([stencil, disk])
    hits = hits_at(pixels)
    at_mouse = hits[0]
    if at_mouse is None:
        return None
    same = [n for n, hit in enumerate(hits) if hit and (hit.ob, hit.material) == (at_mouse.ob, at_mouse.material)]
    return HitsAround([hits[n] for n in same], pixels[same], same[: len(stencil)] == list(range(len(stencil))))


# By session_uid, the scenes that `warm_up` has prepared.
_warm: set[int] = set()


def warm_up(scene) -> None:
    """Soon do, once for a scene, what the first move of a drag would wait for."""
    if scene.session_uid not in _warm:
        _warm.add(scene.session_uid)
        bpy.app.timers.register(_prepare, first_interval=0.0)


def _prepare() -> None:
    """Try a move in each view: that reads the table, and Blender builds the trees in which its rays find surfaces."""
    gc.collect()  # 50 ms that would come during some move
    for window in bpy.context.window_manager.windows:
        for area in window.screen.areas:
            region = next((one for one in area.regions if one.type == "WINDOW"), None)
            if area.type == "VIEW_3D" and region is not None:
                with bpy.context.temp_override(window=window, area=area, region=region):
                    prepare_view(bpy.context, region)


def prepare_view(context, region) -> None:
    """Try a move of a light in the view of a region; nothing is changed."""
    grid = (np.indices((GRID, GRID)).reshape(2, -1).T + 0.5) / GRID * (region.width, region.height)
    shown = [pixel for pixel, hit in zip(grid, hits_at(context, region, grid), strict=True) if hit is not None]
    light = next(iter(lights_of(context.scene)), None)
    if shown and light is not None:
        around = hits_around(lambda offsets: hits_at(context, region, shown[len(shown) // 2] + offsets))
        place_of(light, LightPose.of(light), around, 1.0, ShownTextures())
