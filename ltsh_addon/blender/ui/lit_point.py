"""The point of a surface under the mouse: its material there, and how much each light gives it, shadows included."""

import functools
from collections.abc import Sequence
from dataclasses import dataclass, field

import bpy
import numpy as np
from bpy_extras import view3d_utils
from mathutils import Matrix, Vector

from ...cycles.horizons import end_at_horizons_of_cycles, unit
from ...cycles.lobes import LOBE_AOVS, LOBE_KINDS, SurfaceHits, samples_of_lobes
from ...cycles.texels import GRAY
from ...lobes.brdf import dielectric_reflectance
from ...lobes.lookup_table import LookupTable, load_table
from ...scene import DEFAULT_TECHNIQUE, PolygonLight, SceneError, SurfaceSamples
from ...shading import shade
from ...visibility import ShadowSampling, trace_visibility
from ..evaluated import kind_of_normals, visibility
from ..lights.linking import Receivers
from ..lights.textures import ShownTextures
from ..lights.world import light_of_world
from ..materials.preview_material import OTHER_KINDS, PreviewMaterial, ViewFactor, preview_of, world_radiance
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
class MeshFace:
    """A face of a mesh, in its object, and the triangles in which Cycles interpolates."""

    slot: int
    is_flat: bool
    corners: list[tuple]  # (K, 3)
    normals: list[tuple]  # (K, 3)
    triangles: list[tuple]  # (T, 3) of numbers of corners
    uv: dict[str, list[tuple]]  # (K, 2) by UV map; "" is the one that renders

    @functools.cached_property
    def growth(self) -> dict[str, np.ndarray]:
        """The vectors (2, 3) in the object along which u and v grow, by UV map."""
        corners, by_name = np.array(self.corners), {name: np.array(uv) for name, uv in self.uv.items()}
        return {
            name: np.linalg.lstsq(uv - uv.mean(axis=0), corners - corners.mean(axis=0), rcond=None)[0]
            for name, uv in by_name.items()
        }


class MeshFaces:
    """Faces of an evaluated mesh, each read when it is first wanted."""

    def __init__(self, mesh):
        mesh.calc_loop_triangles()
        self._by_vertex, self._flat = kind_of_normals(mesh)
        self._mesh, self._normals = mesh, mesh.vertex_normals if self._by_vertex else mesh.corner_normals
        self._layers = {layer.name: layer.uv for layer in mesh.uv_layers}
        self._layers.update(("", layer.uv) for layer in mesh.uv_layers if layer.active_render)
        self._faces: dict[int, MeshFace] = {}

    def face(self, number: int) -> MeshFace:
        """That of a number."""
        if number not in self._faces:
            mesh, face = self._mesh, self._mesh.polygons[number]
            first, count, vertices = face.loop_start, face.loop_total, face.vertices
            loops = range(first, first + count)
            # Before a face its mesh has a triangle for each loop, but for two of each face.
            triangles = (mesh.loop_triangles[first - 2 * number + index].loops for index in range(count - 2))
            self._faces[number] = MeshFace(
                face.material_index, bool(self._flat[number]),
                [mesh.vertices[vertex].co[:] for vertex in vertices],
                [self._normals[index].vector[:] for index in (vertices if self._by_vertex else loops)],
                [tuple(loop - first for loop in triangle) for triangle in triangles],
                {name: [layer[loop].vector[:] for loop in loops] for name, layer in self._layers.items()},
            )  # fmt: skip
        return self._faces[number]

    def at(
        self, numbers: list[int], places: np.ndarray, inverse: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, dict[str, np.ndarray]]:
        """The normals (P, 3) in the world, those of the triangles and the interpolated ones, at places (P, 3) of the
        object on P faces, and the coordinates (P, 2) in each UV map; "" is the one that renders. `inverse` (3, 3) leads
        from the world into the object.

        As in Cycles, what is interpolated are unit vectors of the world.
        """
        faces = {number: self.face(number) for number in numbers}
        counts = np.array([len(face.corners) for face in faces.values()])
        triangles = np.concatenate([face.triangles for face in faces.values()])  # (T, 3), then of all corners
        triangles += np.repeat(np.cumsum(counts) - counts, counts - 2)[:, None]
        corners, normals = (
            np.array([corner for face in faces.values() for corner in getattr(face, name)])
            for name in ("corners", "normals")
        )
        # Each place in all triangles of its face: it is in the one whose least weight is largest.
        first_triangle = dict(zip(faces, (np.cumsum(counts - 2) - counts + 2).tolist(), strict=True))
        first_triangle = np.array([first_triangle[number] for number in numbers])
        lengths = np.array([len(faces[number].triangles) for number in numbers])
        ends, place = np.cumsum(lengths), np.repeat(np.arange(len(numbers)), lengths)
        triangle = triangles[np.arange(len(place)) + (first_triangle - ends + lengths)[place]]
        one, two, three = corners[triangle].transpose(1, 0, 2)
        along, across, inside = one - three, two - three, places[place] - three
        normal = np.cross(along, across)
        square = np.maximum((normal**2).sum(axis=-1), 1e-300)
        areas = np.stack([np.cross(inside, across), np.cross(along, inside)])
        weights = ((areas * normal).sum(axis=-1) / square).T
        weights = np.append(weights, 1.0 - weights.sum(axis=-1, keepdims=True), axis=-1)
        best = np.lexsort((weights.min(axis=-1), place))[ends - 1]
        weights, triangle, flat = weights[best, :, None], triangle[best], unit(normal[best] @ inverse)
        smooth = unit((weights * unit(normals[triangle] @ inverse)).sum(axis=1))
        smooth = np.where([[faces[number].is_flat] for number in numbers], flat, smooth)
        uv = {name: np.array([uv for face in faces.values() for uv in face.uv[name]]) for name in self._layers}
        return flat, smooth, {name: (weights * values[triangle]).sum(axis=1) for name, values in uv.items()}


@dataclass(frozen=True)
class SurfaceHit:
    """What a ray of the view meets."""

    position: Vector
    normal: Vector  # interpolated; where the surface is seen from behind, turned round
    view: Vector
    material: bpy.types.Material | None
    face_normal: Vector  # towards the view
    uv: dict[str, np.ndarray]  # (2,) by UV map; "" is the one that renders
    ob: bpy.types.Object  # the original
    matrix: Matrix  # of the object, or of the instance of it
    face: MeshFace | None  # None: not of a mesh

    def uv_frame(self, uv_map: str) -> tuple[np.ndarray, np.ndarray] | None:
        """The directions (3,) in the world in which u and v grow on the face; None where they do not."""
        growth = None if self.face is None else self.face.growth.get(uv_map)
        if growth is None:
            return None
        along = growth @ np.array(self.matrix.to_3x3()).T
        sizes = np.linalg.norm(along, axis=-1, keepdims=True)
        return tuple(along / sizes) if sizes.all() else None


def directions_around(hits: list[SurfaceHit], axis: int) -> np.ndarray:
    """The directions (P, 3) in the world around an axis of the object of P `hits`, as a Tangent node has them."""
    inverses, mesh = {hit.matrix: hit.matrix.inverted_safe() for hit in hits}, hits[0].ob.data
    places = np.array([(inverses[hit.matrix] @ hit.position)[:] for hit in hits])
    if isinstance(mesh, bpy.types.Mesh):
        places = (places - np.array(mesh.texspace_location)) / np.maximum(mesh.texspace_size, 1e-30)
    turns = {matrix: np.array(inverse.to_3x3()) for matrix, inverse in inverses.items()}
    around = np.cross(np.eye(3)[axis], places)
    return np.einsum("pi,pij->pj", around, np.array([turns[hit.matrix] for hit in hits]))


def surface_hit(scene, depsgraph, start: Vector, direction: Vector) -> SurfaceHit | None:
    """The first surface in a unit `direction` from `start`; None where there is none."""
    return surface_hits(scene, depsgraph, [(start, direction)])[0]


def surface_hits(scene, depsgraph, rays: Sequence[tuple[Vector, Vector]]) -> list[SurfaceHit | None]:
    """As `surface_hit`, of many rays: their starts and unit directions. Each face is read once."""
    met = [scene.ray_cast(depsgraph, start, direction) for start, direction in rays]
    by_object: dict[tuple, list[int]] = {}
    for ray, (is_hit, *_, ob, matrix) in enumerate(met):
        if is_hit:
            by_object.setdefault((ob.session_uid, matrix.freeze()), []).append(ray)
    hits: list[SurfaceHit | None] = [None] * len(met)
    override, all_faces = depsgraph.view_layer_eval.material_override, {}
    for (uid, matrix), numbers in by_object.items():
        ob, inverse = met[numbers[0]][4], matrix.inverted_safe()
        mesh, slots, original = ob.evaluated_get(depsgraph).data, ob.material_slots, ob.original
        materials = [slot.material for slot in slots] or [None]
        on_mesh = [n for n in numbers if isinstance(mesh, bpy.types.Mesh) and met[n][3] < len(mesh.polygons)]
        geometry = {}
        if on_mesh:
            faces = all_faces[uid] = all_faces.get(uid) or MeshFaces(mesh)
            places, indices = np.array([(inverse @ met[n][1])[:] for n in on_mesh]), [met[n][3] for n in on_mesh]
            # Blender 4.5 returns other normals of unevenly scaled objects.
            flat, smooth, uv = faces.at(indices, places, np.array(inverse.to_3x3()))
            geometry = {
                n: (Vector(flat[k]), Vector(smooth[k]), {name: values[k] for name, values in uv.items()})
                for k, n in enumerate(on_mesh)
            }
        for n in numbers:
            _, position, normal, index, _, _ = met[n]
            face, (normal, smooth, uv) = None, geometry.get(n, (normal, normal, {}))
            if n in geometry:
                face = faces.face(index)
            direction = rays[n][1]
            side = -1.0 if normal.dot(direction) > 0.0 else 1.0
            material = override or materials[min(0 if face is None else face.slot, len(materials) - 1)]
            normals = side * smooth, side * normal
            hits[n] = SurfaceHit(position, normals[0], -direction, material, normals[1], uv, original, matrix, face)
    return hits


def hit_at(context, region, pixel: np.ndarray) -> SurfaceHit | None:
    """What the view of a region meets at a pixel (2,)."""
    return hits_at(context, region, pixel[None])[0]


def hits_at(context, region, pixels: np.ndarray) -> list[SurfaceHit | None]:
    """What the view of a region meets at pixels (P, 2)."""
    rays = [
        (view3d_utils.region_2d_to_origin_3d(region, region.data, pixel),
         view3d_utils.region_2d_to_vector_3d(region, region.data, pixel))
        for pixel in pixels.tolist()
    ]  # fmt: skip
    return surface_hits(context.scene, context.evaluated_depsgraph_get(), rays)


@functools.cache
def shipped_table() -> LookupTable:
    """That of the default technique, read once: each move of the mouse shades."""
    return load_table(DEFAULT_TECHNIQUE)


def value_at_hits(value: Value, hits: list[SurfaceHit], textures: ShownTextures) -> np.ndarray:
    """The values (P, 3) of a quantity of a material at P `hits`."""
    if value.is_constant:
        return np.tile(value.offset, (len(hits), 1))
    uv = np.array([hit.uv.get(value.image.uv_map, np.zeros(2)) for hit in hits])
    colors = textures.color_at(value.image, uv)
    colors = np.tile(UNKNOWN, (len(hits), 1)) if colors is None else colors
    return value.offset + np.append(colors, np.ones((len(hits), 1)), axis=-1) @ value.matrix.T


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
        elif lobe.kind not in OTHER_KINDS:
            lobes.append(_lobe_at(lobe, hit, cosine, textures))
            before = lobe
    return samples_of_lobes(hits, lobes)[0]


def _lobe_at(lobe: PreviewMaterial, hit: SurfaceHit, cosine: float, textures: ShownTextures) -> dict[str, np.ndarray]:
    read = {name: value for name, value in lobe.values.items() if name in LOBE_AOVS}
    values = {name: value_at_hits(value, [hit], textures)[0] for name, value in read.items()}
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
    glossy: float = 0.0  # of it, specular


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
    def of(cls, context) -> "SceneLights":
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
        glossy, diffuse = (radiance[name].sum(axis=1) @ GRAY for name in ("specular", "diffuse"))
        by_light: dict[tuple, np.ndarray] = {}
        for number, (light, *values) in enumerate(zip(lights, glossy + diffuse, glossy, strict=True)):
            key = light.name, number < len(self.lights) and not isinstance(light, PolygonLight)
            by_light[key] = by_light.get(key, 0.0) + np.array(values)
        shares = (LightShare(*key, *values.tolist()) for key, values in by_light.items())
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
