"""The point of a surface under the mouse: its material there, and how much each light gives it, shadows included."""

from __future__ import annotations

import functools
from dataclasses import dataclass, field

import bpy
import numpy as np
from mathutils import Matrix, Vector
from mathutils.interpolate import poly_3d_calc

from ...cycles.horizons import end_at_horizons_of_cycles
from ...cycles.lobes import LOBE_AOVS, LOBE_KINDS, SurfaceHits, samples_of_lobes
from ...cycles.texels import GRAY
from ...lobes.brdf import dielectric_reflectance
from ...lobes.lookup_table import LookupTable, load_table
from ...scene import DEFAULT_TECHNIQUE, PolygonLight, SceneError, SurfaceSamples
from ...shading import shade
from ...visibility import ShadowSampling, trace_visibility
from ..evaluated import visibility
from ..lights.linking import Receivers
from ..lights.textures import ShownTextures
from ..lights.world import light_of_world
from ..materials.preview_material import COAT, REFRACTION, PreviewMaterial, ViewFactor, preview_of, world_radiance
from ..materials.values import Value
from ..viewport.light_texels import constant_sky
from ..viewport.mirror import view_lights
from ..viewport.shadow_rays import ViewTracer, view_occluders
from .preview import view_of

# UNKNOWN: what stands for the colors of an image that only Cycles can read.
UNKNOWN = np.full(3, 0.5)
# NAMED: the most lights of a line that tells shares.
NAMED = 4


@dataclass(frozen=True)
class SurfaceHit:
    """What a ray of the view meets."""

    position: Vector
    normal: Vector  # interpolated, towards the view
    view: Vector
    material: bpy.types.Material | None
    face_normal: Vector  # towards the view
    uv: dict[str, np.ndarray]  # (2,) by UV map; "" is the one that renders
    ob: bpy.types.Object  # the original
    matrix: Matrix  # of the object, or of the instance of it
    corners: np.ndarray  # (K, 3) of its face, in the object; K = 0: not a mesh
    corner_uv: dict[str, np.ndarray]  # (K, 2)

    def uv_frame(self, uv_map: str) -> tuple[np.ndarray, np.ndarray] | None:
        """The directions (3,) in the world in which u and v grow on the face; None where they do not."""
        uv = self.corner_uv.get(uv_map)
        if uv is None:
            return None
        grows = np.linalg.lstsq(uv - uv.mean(axis=0), self.corners - self.corners.mean(axis=0), rcond=None)[0]
        along = grows @ np.array(self.matrix.to_3x3()).T
        sizes = np.linalg.norm(along, axis=-1, keepdims=True)
        return tuple(along / sizes) if sizes.all() else None

    def around(self, axis: int) -> np.ndarray:
        """The direction (3,) in the world around an axis of the object, as a Tangent node has it."""
        mesh = self.ob.data
        place = np.array(self.matrix.inverted_safe() @ self.position)
        if isinstance(mesh, bpy.types.Mesh):
            place = (place - np.array(mesh.texspace_location)) / np.maximum(mesh.texspace_size, 1e-30)
        return np.array(self.matrix.to_3x3().inverted_safe().transposed()) @ np.cross(np.eye(3)[axis], place)


def surface_hit(scene, depsgraph, start: Vector, direction: Vector, faces: dict | None = None) -> SurfaceHit | None:
    """The first surface in a unit `direction` from `start`; None where there is none. Of many rays at once, those that
    share the dictionary `faces` read each face once."""
    is_hit, position, face_normal, face, ob, matrix = scene.ray_cast(depsgraph, start, direction)
    if not is_hit:
        return None
    mesh, slots, number, uv, corner_uv = ob.evaluated_get(depsgraph).data, ob.material_slots, 0, {}, {}
    corners = np.zeros((0, 3))
    normal = face_normal = -face_normal if face_normal.dot(direction) > 0.0 else face_normal
    if isinstance(mesh, bpy.types.Mesh) and face < len(mesh.polygons):
        faces, key = {} if faces is None else faces, (ob.session_uid, face)
        if key not in faces:
            faces[key] = _face_of(mesh, face)
        number, places, corners, normals, corner_uv = faces[key]
        weights = np.array(poly_3d_calc(places, matrix.inverted_safe() @ position))
        normal = (matrix.to_3x3().inverted_safe().transposed() @ Vector(weights @ normals)).normalized()
        normal = -normal if normal.dot(direction) > 0.0 else normal
        uv = {name: weights @ values for name, values in corner_uv.items()}
    override = depsgraph.view_layer_eval.material_override
    material = override or (slots[min(number, len(slots) - 1)].material if len(slots) else None)
    return SurfaceHit(
        position, normal, -direction, material, face_normal, uv, ob.original, matrix.copy(), corners, corner_uv
    )


def _face_of(mesh, face: int) -> tuple:
    """The material slot of a face, its corners as a list of vectors and (K, 3), their normals (K, 3) and their UV
    coordinates (K, 2) by map."""
    polygon, uv = mesh.polygons[face], {}
    loops = list(polygon.loop_indices)
    places = [mesh.vertices[mesh.loops[index].vertex_index].co.copy() for index in loops]
    normals = np.array([mesh.corner_normals[index].vector for index in loops])
    for layer in mesh.uv_layers:
        uv[layer.name] = np.array([layer.uv[index].vector for index in loops])
        if layer.active_render:
            uv[""] = uv[layer.name]
    return polygon.material_index, places, np.array(places), normals, uv


@functools.cache
def shipped_table() -> LookupTable:
    """That of the default technique, read once: each move of the mouse shades."""
    return load_table(DEFAULT_TECHNIQUE)


def value_at_hit(value: Value, hit: SurfaceHit, textures: ShownTextures) -> np.ndarray:
    """The value (3,) of a quantity of a material at `hit`."""
    if value.is_constant:
        return value.offset
    color = textures.color_at(value.image, hit.uv.get(value.image.uv_map, np.zeros(2)))
    return value.offset + value.matrix @ np.append(UNKNOWN if color is None else color, 1.0)


def samples_at_hit(hit: SurfaceHit, textures: ShownTextures, receiver: int = 0) -> SurfaceSamples:
    """Samples of all lobes of the material at `hit`, without its bump maps, normal maps and anisotropy."""
    position, view, smooth, true = (
        np.array([vector], np.float64) for vector in (hit.position, hit.view, hit.normal, hit.face_normal)
    )
    look = preview_of(None if hit.material is None else hit.material.original)
    is_bent, cosine = np.array([look.corrected]), max(float(hit.normal.dot(hit.view)), 0.0)
    hits = SurfaceHits(position, view, smooth, true, is_bent, np.array([receiver]), None)
    lobes, before = [], None
    for lobe in look.lobes:
        if lobe.kind == "sheen" and before is not None and before.sheen is not None:
            fuzz = {name: lobe.value(name).offset for name in ("color", "roughness")}
            most = max(float(fuzz["color"].max()), 1e-30)
            sheen = {"weight": most, "tint": fuzz["color"] / most, "roughness": fuzz["roughness"]}
            lobes[-1] |= {f"sheen_{name}": _of_one(f"sheen_{name}", value) for name, value in sheen.items()}
            before = None
        elif lobe.kind not in (COAT, REFRACTION):
            lobes.append(_lobe_at(lobe, hit, cosine, textures))
            before = lobe
    return samples_of_lobes(hits, lobes)[0]


def _lobe_at(lobe: PreviewMaterial, hit: SurfaceHit, cosine: float, textures: ShownTextures) -> dict[str, np.ndarray]:
    values = {name: value_at_hit(value, hit, textures) for name, value in lobe.values.items() if name in LOBE_AOVS}
    values |= {"kind": LOBE_KINDS[lobe.kind], "multiple_scattering": float(lobe.scattered)}
    values["weight"] = lobe.weight * np.ravel(values.get("weight", 1.0))[0] * _factor_of(lobe.view_factor, cosine)
    if lobe.coat is not None:
        values |= {f"coat_{name}": getattr(lobe.coat, name) for name in ("weight", "roughness", "ior", "tint")}
    values = {"color": lobe.value("color").offset, "roughness": lobe.value("roughness").offset} | values
    return {name: _of_one(name, value) for name, value in values.items()}


def _factor_of(factor: ViewFactor | None, cosine: float) -> float:
    if factor is None:
        return 1.0
    is_fresnel = factor.kind == "fresnel"
    value = dielectric_reflectance(cosine, factor.parameter) if is_fresnel else 1.0 - cosine**factor.parameter
    return float(1.0 - value if factor.is_complement else value)


def _of_one(name: str, value) -> np.ndarray:
    """The quantity `name` of LOBE_AOVS as an array for one hit."""
    numbers = np.ravel(value).astype(np.float64)
    return np.resize(numbers, (1, 3)) if LOBE_AOVS[name][0] == "COLOR" else numbers[:1]


@dataclass(frozen=True)
class LightShare:
    """What one light gives a point."""

    name: str
    is_lamp: bool  # a light object; False: a glowing mesh or the world
    luminance: float  # of the reflected light, W m^-2 sr^-1


@dataclass
class SceneLights:
    """The lights of a scene as its views have them, and what stands in their way."""

    lights: tuple
    sky: tuple
    receivers: Receivers
    tracing: ViewTracer | None  # None: without shadows
    notes: tuple[str, ...]  # what differs from Cycles
    textures: ShownTextures = field(default_factory=ShownTextures)

    @classmethod
    def of(cls, context) -> SceneLights:
        """Those of the scene of `context`, with world and shadows as far as its preview has them."""
        scene, depsgraph, textures = context.scene, context.evaluated_depsgraph_get(), ShownTextures()
        lights, notes = view_lights(depsgraph, visibility(depsgraph, view_of(context)), textures)
        world, sky, notes = depsgraph.view_layer.world_override or scene.world, (), list(notes)
        if world is not None and scene.ltsh_view.world:
            radiance, is_exact = world_radiance(world)
            sky = constant_sky(light_of_world(world), radiance, radiance).sides
            notes += [] if is_exact else [f"{world.name}: its viewport color counts"]
        receivers = Receivers([ob.original for ob in depsgraph.objects])
        tracing = None
        if scene.ltsh.shadows:
            tracing = ViewTracer(view_occluders(depsgraph, notes.append), processes=1)
            try:
                _ = tracing.tracer
            except SceneError as error:
                tracing, notes = None, [*notes, f"without shadows: {error}"]
        return cls(lights, sky, receivers, tracing, tuple(notes), textures)

    def shares_at(self, hit: SurfaceHit) -> list[LightShare]:
        """What each light gives the point of `hit`, the most first."""
        lights = (*self.lights, *self.sky)
        if not lights:
            return []
        samples = samples_at_hit(hit, self.textures, self.receivers.numbers.get(hit.ob.name_full, 0))
        samples, _ = end_at_horizons_of_cycles(samples, lights, np.zeros(len(samples), int))
        shading = shade(samples, lights, shipped_table(), rows=range(len(lights)), workers=1)
        radiance = {"specular": shading.specular, "diffuse": shading.diffuse}
        if self.tracing is not None:
            traced = trace_visibility(samples, lights, self.tracing.tracer, ShadowSampling(), workers=self.tracing.pool)
            radiance = {name: values * traced.of_lights(name)[..., None] for name, values in radiance.items()}
        luminance = sum(values.sum(axis=1) @ GRAY for values in radiance.values())
        by_light: dict[tuple, float] = {}
        for number, (light, value) in enumerate(zip(lights, luminance.tolist(), strict=True)):
            key = light.name, number < len(self.lights) and not isinstance(light, PolygonLight)
            by_light[key] = by_light.get(key, 0.0) + value
        shares = (LightShare(*key, value) for key, value in by_light.items())
        return sorted(shares, key=lambda share: -share.luminance)

    def is_exact_at(self, hit: SurfaceHit) -> bool:
        """False where lights or the material at `hit` are not quite those that Cycles has."""
        look = preview_of(None if hit.material is None else hit.material.original)
        is_plain = all(lobe.normal is None and lobe.brush is None for lobe in look.lobes)
        return is_plain and not look.notes and not self.notes

    def close(self) -> None:
        """End the tracer."""
        if self.tracing is not None:
            self.tracing.close()


def share_line(shares: list[LightShare]) -> str:
    """The shares of lights at a point as one line."""
    whole = sum(share.luminance for share in shares)
    if whole <= 0.0:
        return "No light arrives here"
    shown = [share for share in shares if abs(share.luminance) > 5e-4 * whole]
    texts = [f"{share.name} {100.0 * share.luminance / whole:.3g} %" for share in shown[:NAMED]]
    if len(shown) > NAMED:
        rest = 100.0 * sum(share.luminance for share in shown[NAMED:]) / whole
        texts.append(f"{len(shown) - NAMED} others {rest:.2g} %")
    return "   ".join(texts)
