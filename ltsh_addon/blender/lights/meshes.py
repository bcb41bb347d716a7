"""Meshes that glow, as polygon lights."""

import itertools
from contextlib import contextmanager
from dataclasses import dataclass, field, replace

import bpy
import numpy as np
from mathutils.geometry import convex_hull_2d

from ...cycles.patches import GRID, cut_into_patches, note_patches, split_light
from ...emitters import light_tree, mesh_polygons
from ...emitters.light_nodes import stand_ins
from ...emitters.mesh_polygons import FlatPolygon
from ...scene import Light, PointLight, PolygonLight, QuadLight
from ...visibility.light_cluster import sharing_key
from ..evaluated import (
    SURFACE_TYPES,
    EmitterTraits,
    RenderedSurface,
    is_rendered,
    read_values,
    surface_instancer,
    uv_maps,
)
from ..materials.graph import computed, ensure_nodes, fill_with_bsdf, is_displaced, live_link, material_output, mixed
from ..render_settings import changed_properties
from .emission import (
    PIXELS,
    Emission,
    Falloff,
    ObjectFacts,
    Studio,
    emission_of,
    emission_warnings,
    without_camera_rays,
    without_falloff,
)
from .linking import Receivers


@dataclass
class Placement:
    """One instance of an object that shines: its evaluated mesh in world space."""

    vertices: np.ndarray  # (N, 3)
    triangles: np.ndarray  # (T, 3) counterclockwise around the side that Cycles calls front
    slots: np.ndarray  # (T,) index of the material slot
    matrix: np.ndarray  # (4, 4)
    mesh: object = None  # copy of the evaluated mesh, if a texture must be rendered
    uv_maps: dict = field(default_factory=dict)  # (T, 3, 2) by name, as `uv_maps`: of few faces in views
    facts: ObjectFacts = ObjectFacts()


@dataclass
class MeshLight:
    """An object whose materials may emit; how much is not known yet."""

    ob: object  # original
    light: Light  # a stand-in with all values that its polygons share
    materials: list  # original material or None per slot
    emission: list[Emission]  # per slot
    placements: list[Placement] = field(default_factory=list)
    instancers: dict[str, RenderedSurface] = field(default_factory=dict)  # by full name
    is_dropped: bool = False  # it lights nothing because it has too many faces

    @property
    def varies(self) -> bool:
        return any(emission.varies for emission in self.emission)

    @property
    def emitting_materials(self) -> list[str]:
        """Full names of the materials that may emit."""
        pairs = zip(self.materials, self.emission, strict=True)
        return [material.name_full for material, emission in pairs if emission.emits]

    def light_of(self, slot: int) -> Light:
        """The stand-in light with the falloff of the material in `slot`."""
        falloff = self.emission[slot].falloff or Falloff()
        return replace(self.light, falloff=falloff.power, smooth=falloff.smooth)


def collect_mesh_lights(depsgraph, override, receivers: Receivers, warn, copies: bool = True) -> list[MeshLight]:
    """Objects in a render of `depsgraph` whose materials may emit; the material `override` replaces all others.

    `copies`: copy the meshes of objects with textures into new data blocks, which rendering the textures needs.
    """
    mesh_lights: dict[tuple, MeshLight | None] = {}
    known: dict[str, Emission] = {}
    for instance in depsgraph.object_instances:
        ob = instance.object
        if ob.type not in SURFACE_TYPES or not instance.show_self or not is_rendered(ob):
            continue
        traits = EmitterTraits.of(instance)
        slots = tuple(slot.material.name_full if slot.material else "" for slot in ob.material_slots)
        key = (ob.original.name_full, ob.data.name_full if ob.data else "", slots, traits)
        if key not in mesh_lights:
            mesh_lights[key] = _mesh_light(ob, traits, override, receivers, known)
            if mesh_lights[key] is not None and ob.type in ("CURVES", "POINTCLOUD"):
                warn(f"object {ob.original.name!r}: all light of its {ob.type.lower()} is lost, it lights nothing")
                mesh_lights[key] = None
        if mesh_lights[key] is not None:
            matrix = np.array(instance.matrix_world, dtype=np.float64)
            placement = _placement(ob, matrix, mesh_lights[key], depsgraph if copies else None)
            if placement is not None:
                placement.facts = ObjectFacts.of(ob, instance)
                mesh_lights[key].placements.append(placement)
                instancer = surface_instancer(instance)
                if instancer is not None:
                    mesh_lights[key].instancers[instancer.original.name_full] = instancer
    return [light for light in mesh_lights.values() if light is not None and light.placements]


def _mesh_light(ob, traits: EmitterTraits, override, receivers: Receivers, known: dict) -> MeshLight | None:
    slots = [override] * max(1, len(ob.material_slots)) if override else [slot.material for slot in ob.material_slots]
    materials = [None if material is None else material.original for material in slots]
    known |= {one.name_full: emission_of(one) for one in materials if one is not None and one.name_full not in known}
    emission = [Emission() if material is None else known[material.name_full] for material in materials]
    if not any(one.emits for one in emission) or not (traits.diffuse or traits.glossy):
        return None
    nothing = np.zeros(3)
    light = QuadLight(
        name=ob.original.name,
        center=nothing,
        half_u=nothing,
        half_v=nothing,
        direction=nothing,
        radiance=nothing,
        group=traits.group,
        affects_diffuse=traits.diffuse,
        affects_specular=traits.glossy,
        receivers=receivers.of(ob.original),
    )
    return MeshLight(ob.original, light, materials, emission)


def _placement(ob, matrix: np.ndarray, light: MeshLight, depsgraph) -> Placement | None:
    mesh = ob.to_mesh()
    try:
        if mesh is None or not np.isfinite(matrix).all():
            return None
        vertices = read_values(mesh.vertices, "co", (len(mesh.vertices), 3), np.float32)
        mesh.calc_loop_triangles()
        count = len(mesh.loop_triangles)
        triangles = read_values(mesh.loop_triangles, "vertices", (count, 3), np.int32)
        slots = read_values(mesh.loop_triangles, "material_index", (count,), np.int32)
        maps, way = {}, -1 if np.linalg.det(matrix[:3, :3]) < 0.0 else 1
        if light.varies and depsgraph is None and count <= MOST_TRIANGLES:
            corners = read_values(mesh.loop_triangles, "loops", (count, 3), np.int32)[:, ::way]
            maps = {name: uv[corners] for name, uv in uv_maps(mesh).items()}
    finally:
        ob.to_mesh_clear()
    slots = np.clip(slots, 0, len(light.materials) - 1)
    if not len(slots) or not any(light.emission[slot].emits for slot in np.unique(slots)):
        return None
    copy = None
    if light.varies and depsgraph is not None:
        copy = bpy.data.meshes.new_from_object(ob, preserve_all_data_layers=True, depsgraph=depsgraph)
    world = vertices.astype(np.float64) @ matrix[:3, :3].T + matrix[:3, 3]
    return Placement(world, triangles.astype(np.int64)[:, ::way], slots, matrix, copy, maps)


# SIDE_PROPERTY: custom property of objects that let light through in the reference: objects that shine, and surfaces
# that instance lights. Its value is 1 if only the front of the faces shines, -1 if only the back does, 0 for both.
SIDE_PROPERTY = "ltsh_emitting_side"
# MOST_POLYGONS: emitting polygons of an object in pictures and bakes, where 20,000 take about 13 s of processor time.
# MOST_SHOWN: polygons that stand for the faces of all objects in views.
MOST_POLYGONS, MOST_SHOWN = 200_000, 112
# MOST_CORNERS: of a polygon that stands for faces.
MOST_CORNERS = 6
# MOST_TRIANGLES: of objects that light by an image in views; more are mostly baked, with their light in the image.
# COPLANAR: farthest that their corners are from a plane, as a share of its polygon.
MOST_TRIANGLES, COPLANAR = 64, 1e-4
AROUND_FACES = 1.001  # radius of the light around a ball, in units of the ball's
# MOST_RENDERED_POLYGONS: up to this many textured polygons of one object are rendered one by one. Of an object with
# more, only the STAND_INS largest of each instance are rendered, and all get their mean.
MOST_RENDERED_POLYGONS = 256
STAND_INS = 32
# Fields of lights that differ from polygon to polygon.
_PLACE = ("center", "half_u", "half_v", "direction", "corners")
# FEW_POLYGONS: up to this many textured polygons are rendered with all PIXELS, more with a quarter along each side.
FEW_POLYGONS = 16


def mesh_area_lights(mesh_lights: list[MeshLight], studio: Studio, eye: np.ndarray, warn) -> list[Light]:
    """The area lights that stand for the objects `mesh_lights`; the camera is at `eye` (3,).

    A closed mesh emits from the side where the camera is. Objects that shine get the custom property SIDE_PROPERTY.
    """
    for mesh_light in mesh_lights:
        for material, emission in zip(mesh_light.materials, mesh_light.emission, strict=True):
            for problem in emission_warnings(emission, is_light=False) if emission.emits else ():
                warn(f"material {material.name!r}: {problem}")
            if emission.emits and is_displaced(material):
                warn(f"material {material.name!r}: it emits from where its faces are without displacement")
    materials = {material.name_full: material for light in mesh_lights for material in light.materials if material}
    # Displacement could move faces out of the camera's sight.
    undisplaced = [(material, "displacement_method", "BUMP") for material in materials.values()]
    with changed_properties(undisplaced), without_falloff(materials.values()):
        return _lights_of_all(mesh_lights, studio, eye, warn)


def _lights_of_all(mesh_lights: list[MeshLight], studio: Studio, eye: np.ndarray, warn) -> list[Light]:
    lights, known = [], {}
    for mesh_light in mesh_lights:
        studio.check_time()
        radiance = [
            _material_radiance(studio, material, known) if emission.emits and not emission.varies else np.zeros((2, 3))
            for material, emission in zip(mesh_light.materials, mesh_light.emission, strict=True)
        ]
        side = _emitting_side(mesh_light, eye)
        placed_polygons = _polygons(mesh_light, radiance)
        count = sum(len(polygons) for _, polygons in placed_polygons) * (2 if side == 0 else 1)
        if count > MOST_POLYGONS:
            warn(
                f"object {mesh_light.ob.name!r}: it emits from {count} flat faces, more than {MOST_POLYGONS}; it "
                "lights nothing, in the Cycles reference neither; give it fewer faces or light the scene by area lights"
            )
            mesh_light.is_dropped = True
            continue
        of_object = _constant_lights(mesh_light, placed_polygons, radiance, side)
        of_object += _textured_lights(mesh_light, placed_polygons, side, studio, warn)
        if of_object:
            mark_transparent(mesh_light.ob, side, mesh_light.materials)
            lights.extend(of_object)
    return lights


def constant_mesh_lights(mesh_light: MeshLight, radiance_of, split, eye: np.ndarray) -> list[Light]:
    """The lights of `mesh_light`, without falloff, for known radiances `radiance_of(material)` (3,): of what is nearly
    a sphere seen from outside one for all of its faces; for `split` see `_without_images`."""
    side = _emitting_side(mesh_light, eye)
    mesh_light, of_images = _without_images(mesh_light, side, split)
    remain = {slot for placement in mesh_light.placements for slot in np.unique(placement.slots).tolist()}
    shining = (material if slot in remain else None for slot, material in enumerate(mesh_light.materials))
    radiance = [np.tile(radiance_of(material), (2, 1)) for material in shining]
    mesh_light, of_balls = _without_balls(mesh_light, radiance, side)
    of_faces = of_images + _constant_lights(mesh_light, _polygons(mesh_light, radiance), radiance, side)
    return of_balls + [replace(light, falloff=0, smooth=0.0) for light in of_faces]


@dataclass(frozen=True)
class StandInLight(PolygonLight):
    """A polygon that shines in place of neighboring faces of a mesh. Its visibility is that of all `faces`."""

    faces: tuple[Light, ...] = ()  # those for which it and its neighbors stand


def fewer_lights(lights: list[Light], warn) -> list[Light]:
    """`lights` of meshes: of more than MOST_SHOWN faces, polygons stand for those of one object and radiance, if they
    are so many that they share their rays. At a tenth of its size a sign of neon tubes then lights 4 to 10 % off."""
    alike: dict[tuple, list[Light]] = {}
    for number, light in enumerate(lights):
        key = (light.name, *light.radiance.tolist(), *sharing_key(light, number))
        alike.setdefault(key, []).append(light)
    groups = [tuple(group) for group in alike.values() if len(group) >= light_tree.FEWEST]
    faces = tuple(itertools.chain.from_iterable(groups))
    if len(faces) <= MOST_SHOWN:
        return lights
    shown = [light for group in alike.values() if len(group) < light_tree.FEWEST for light in group]
    group = np.repeat(np.arange(len(groups)), [len(group) for group in groups])
    for rectangle, _, numbers in zip(*stand_ins(faces, MOST_SHOWN, group), strict=True):
        corners = np.concatenate([faces[number].polygon() for number in numbers])
        shown.append(_around(rectangle, corners, groups[group[numbers[0]]]))
    names = ", ".join(dict.fromkeys(repr(light.name) for light in faces))
    count = sum(isinstance(light, StandInLight) for light in shown)
    warn(f"{names}: {count} polygons stand for {len(faces)} flat faces that shine, in views")
    return shown


def _around(rectangle: QuadLight, corners: np.ndarray, faces: tuple[Light, ...]) -> StandInLight:
    """The light of `rectangle` from the convex outline of `corners` (V, 3): in a dome it leaves almost no gaps between
    neighbors. If they are on a line, from the rectangle."""
    axes, away = np.stack([rectangle.half_u, rectangle.half_v]), corners - rectangle.center
    flat = away @ np.linalg.pinv(axes)
    hull = np.array(convex_hull_2d(flat))
    while len(hull) > MOST_CORNERS:
        before, after = (np.roll(flat[hull], step, axis=0) - flat[hull] for step in (1, -1))
        hull = np.delete(hull, np.argmin(np.abs(before[:, 0] * after[:, 1] - before[:, 1] * after[:, 0])))
    height, flat = max((away[hull] @ rectangle.direction).mean(), 0.0), flat[hull]
    area = 0.5 * abs(np.sum(flat[:, 0] * np.roll(flat[:, 1], -1) - flat[:, 1] * np.roll(flat[:, 0], -1)))
    if area < 0.1:  # of the rectangle's 4
        height, flat, area = 0.0, np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]]), 4.0
    center, radiance = rectangle.center + height * rectangle.direction, 4.0 / area * rectangle.radiance
    return StandInLight.like(rectangle, center=center, corners=center + flat @ axes, radiance=radiance, faces=faces)


def _without_images(mesh_light: MeshLight, side: int, split) -> tuple[MeshLight, list[Light]]:
    """The light without the flat polygons that shine by an image, and these as lights. `split(material, light,
    triangles, uv_maps, share)` makes those of a `light` of radiance 1, which `triangles` (T, 3, 3) cover, with this
    share of the patches of the object; None: it cannot."""
    if not any(placement.uv_maps for placement in mesh_light.placements):
        return mesh_light, []
    placements, lights = [], []
    for placement, polygons in _polygons(mesh_light, np.zeros((len(mesh_light.materials), 3))):
        corners, remain = placement.vertices[placement.triangles], np.ones(len(placement.triangles), bool)
        for polygon in polygons:
            height = np.abs((corners - polygon.corners[0]) @ polygon.normal).max(axis=1)
            flat = (placement.slots == polygon.label) & (height < COPLANAR * np.ptp(polygon.corners, axis=0).max())
            maps = {name: uv[flat] for name, uv in placement.uv_maps.items()}
            share = 1.0 / (len(polygons) * len(_sides(side)) * len(mesh_light.placements))
            for way in _sides(side):
                light = polygon_light(mesh_light.light_of(polygon.label), polygon, way, np.ones(3))
                shown = split(mesh_light.materials[polygon.label], light, corners[flat], maps, share)
                if shown is not None:
                    lights, remain = lights + shown, remain & ~flat
        if remain.any():
            chosen = {"triangles": placement.triangles[remain], "slots": placement.slots[remain]}
            placements.append(replace(placement, **chosen))
    return replace(mesh_light, placements=placements), lights


def _without_balls(mesh_light: MeshLight, radiance, side: int) -> tuple[MeshLight, list[PointLight]]:
    """The light without the parts that are nearly spheres, and these as lights around them with the same power."""
    placements, lights = [], []
    for placement in mesh_light.placements:
        remain = np.ones(len(placement.triangles), bool)
        shape = placement.vertices, placement.triangles, placement.slots
        for ball in mesh_polygons.balls(*shape, side) if side else ():
            remain[ball.triangles] = False
            # Rays to the light end before they meet the faces.
            radius = AROUND_FACES * ball.radius
            share = ball.area / (4.0 * np.pi * radius**2)
            glow, (x, y, z) = share * radiance[ball.label][0], np.eye(3)
            if glow.any():
                place = {"center": ball.center, "half_u": radius * x, "half_v": radius * y, "direction": -z}
                lights.append(PointLight.like(mesh_light.light, radiance=glow, **place))
        if remain.any():
            chosen = {"triangles": placement.triangles[remain], "slots": placement.slots[remain]}
            placements.append(replace(placement, **chosen))
    return replace(mesh_light, placements=placements), lights


def mark_transparent(ob, side: int, materials: list) -> None:
    """Set SIDE_PROPERTY of the original `ob` to `side`, and of its `materials` to 0, which only marks them."""
    ob[SIDE_PROPERTY] = side
    for material in materials:
        if material is not None:
            material[SIDE_PROPERTY] = 0


def _emitting_side(mesh_light: MeshLight, eye: np.ndarray) -> int:
    """The value of SIDE_PROPERTY for an object."""
    sides = set()
    for placement in mesh_light.placements:
        vertices = placement.vertices
        triangles = mesh_polygons.welded(vertices, placement.triangles)
        closed = mesh_polygons.is_closed(triangles)
        outward = mesh_polygons.outward_side(vertices, triangles) if closed else 0
        sides.add(-outward if closed and mesh_polygons.is_inside(eye, vertices, triangles) else outward)
    return sides.pop() if len(sides) == 1 else 0


def _polygons(mesh_light: MeshLight, radiance) -> list[tuple[Placement, list[FlatPolygon]]]:
    """Each placement with its emitting polygons, labeled by material slot."""
    slots = zip(mesh_light.emission, radiance, strict=True)
    shines = np.array([emission.varies or bool(np.any(value)) for emission, value in slots])
    placed_polygons = []
    for placement in mesh_light.placements:
        chosen = shines[placement.slots]
        polygons = mesh_polygons.flat_polygons(placement.vertices, placement.triangles[chosen], placement.slots[chosen])
        placed_polygons.append((placement, polygons))
    return placed_polygons


def _sides(side: int) -> tuple[int, ...]:
    return (1, -1) if side == 0 else (side,)


def _constant_lights(mesh_light: MeshLight, placed_polygons, radiance, side: int) -> list[Light]:
    polygons = [polygon for _, of_placement in placed_polygons for polygon in of_placement]
    lights: dict[tuple, Light] = {}
    kinds: dict[tuple, list[int]] = {}
    for number, polygon in enumerate(polygons):
        kinds.setdefault((polygon.label, len(polygon.corners)), []).append(number)
    for (label, _), numbers in kinds.items():
        for order, way in enumerate(_sides(side)):
            value = radiance[label][0 if way > 0 else 1]
            if np.any(value):
                same_kind = polygon_lights(
                    mesh_light.light_of(label), [polygons[number] for number in numbers], way, value
                )
                lights.update(zip(((number, order) for number in numbers), same_kind, strict=True))
    return [lights[key] for key in sorted(lights)]


def polygon_light(stand_in: Light, polygon: FlatPolygon, way: int, radiance: np.ndarray) -> Light:
    """`stand_in` with the shape of `polygon`, half_u along its longest edge, emitting along `way` (1 or -1) times its
    normal."""
    return polygon_lights(stand_in, [polygon], way, radiance)[0]


def polygon_lights(stand_in: Light, polygons: list[FlatPolygon], way: int, radiance) -> list[Light]:
    """As `polygon_light`, for `polygons` with equally many corners."""
    corners = np.array([polygon.corners for polygon in polygons])[:, :: 1 if way > 0 else -1]
    direction = way * np.array([polygon.normal for polygon in polygons])
    edges = np.roll(corners, -1, axis=1) - corners
    u = edges[np.arange(len(edges)), np.linalg.norm(edges, axis=-1).argmax(axis=1)]
    u = u - (u * direction).sum(axis=1, keepdims=True) * direction
    u /= np.linalg.norm(u, axis=1, keepdims=True)
    v = np.cross(direction, u)
    in_plane = np.einsum("nvi,nai->nva", corners - corners[:, :1], np.stack([u, v], axis=1))
    low, high = in_plane.min(axis=1), in_plane.max(axis=1)
    (middle_u, middle_v), (half_u, half_v) = (0.5 * (low + high)).T[..., None], (0.5 * (high - low)).T[..., None]
    center = corners[:, 0] + middle_u * u + middle_v * v
    first = PolygonLight.like(
        stand_in, center=center[0], half_u=u[0], half_v=v[0], direction=direction[0],
        radiance=radiance, corners=corners[0],
    )  # fmt: skip
    rows = zip(center, half_u * u, half_v * v, direction, corners, strict=True)
    return [first.altered(**dict(zip(_PLACE, row, strict=True))) for row in rows]


def _material_radiance(studio: Studio, material, known: dict) -> np.ndarray:
    """Radiance (2, 3) that `material`, which does not vary, emits from the front and the back of a face."""
    if material.name_full not in known:
        mesh = bpy.data.meshes.new("Look at a material")
        mesh.from_pydata([(-1, -1, 0), (1, -1, 0), (1, 1, 0), (-1, 1, 0)], [], [(0, 1, 2, 3)])
        mesh.materials.append(material)
        up, u, v = np.array([0.0, 0.0, 1.0]), np.array([0.5, 0.0, 0.0]), np.array([0.0, 0.5, 0.0])
        with _shown(studio, mesh, np.eye(4), ObjectFacts()):
            images = [studio.look(np.zeros(3), u, v, way * up, pixels=4)[0] for way in (1.0, -1.0)]
        known[material.name_full] = np.array([image.mean(axis=(0, 1)) for image in images])
    return known[material.name_full]


@contextmanager
def _shown(studio: Studio, mesh, matrix: np.ndarray, facts: ObjectFacts):
    """Within this context `mesh` stands at `matrix` in the studio and looks as it does to surfaces."""
    ob = bpy.data.objects.new("Look at a mesh", mesh)
    # Its light must not fall on itself.
    ob.visible_diffuse = ob.visible_glossy = ob.visible_transmission = ob.visible_shadow = False
    with without_camera_rays(mesh.materials, facts.random), studio.show(ob, matrix, facts):
        yield


def _textured_lights(mesh_light: MeshLight, placed_polygons, side: int, studio: Studio, warn) -> list[Light]:
    """Lights of the polygons whose material emits differently from place to place."""
    textured = [
        (placement, [polygon for polygon in polygons if mesh_light.emission[polygon.label].varies])
        for placement, polygons in placed_polygons
    ]
    count = sum(len(polygons) for _, polygons in textured)
    if count == 0:
        return []
    make = _mean_lights if count > MOST_RENDERED_POLYGONS else _patch_lights
    lights = make(mesh_light, textured, side, studio, warn)
    for label in sorted({polygon.label for _, polygons in textured for polygon in polygons} - set(lights)):
        warn(
            f"object {mesh_light.ob.name!r}: material {mesh_light.materials[label].name!r} may emit there, but "
            "a picture of its faces is black; it lights nothing"
        )
    return [light for of_label in lights.values() for light in of_label]


def _patch_lights(mesh_light: MeshLight, textured, side: int, studio: Studio, warn) -> dict[int, list[Light]]:
    """By material slot, the polygons with patches of constant radiance."""
    count = sum(len(polygons) for _, polygons in textured)
    most = max(1, GRID * GRID // (count * len(_sides(side))))
    lights, errors = {}, []
    pixels = PIXELS if count <= FEW_POLYGONS else PIXELS // 4
    for polygon, _, light, image, covered in _looks(mesh_light, textured, side, studio, pixels):
        patches = cut_into_patches(image, covered, most)
        if patches.whole is not None:
            lights.setdefault(polygon.label, []).extend(split_light(light, patches))
        errors.append(patches.error)
    count = sum(len(light.leaves) for of_label in lights.values() for light in of_label)
    note_patches(f"object {mesh_light.ob.name!r}: its texture", count, max(errors), warn)
    return lights


def _looks(mesh_light: MeshLight, textured, side: int, studio: Studio, pixels: int):
    """Yield each polygon with the way that it emits, its light of radiance 1, and what `_look_at_polygon` gives."""
    for placement, polygons in textured:
        with _shown(studio, _with_materials(mesh_light, placement), placement.matrix, placement.facts):
            for polygon, way in itertools.product(polygons, _sides(side)):
                studio.check_time()
                light = polygon_light(mesh_light.light_of(polygon.label), polygon, way, np.ones(3))
                yield polygon, way, light, *_look_at_polygon(studio, light, pixels)


def _with_materials(mesh_light: MeshLight, placement: Placement):
    """The mesh of `placement` with its textured materials. All else is transparent: it may lie just before them.

    Each slot is set in its turn: `clear` would give all faces the first material.
    """
    mesh, clear = placement.mesh, bpy.data.materials.new("Lets a look through")
    ensure_nodes(clear)
    fill_with_bsdf(clear.node_tree, "ShaderNodeBsdfTransparent", (1.0, 1.0, 1.0, 1.0))
    while len(mesh.materials) > len(mesh_light.materials):
        mesh.materials.pop()
    for slot, (material, emission) in enumerate(zip(mesh_light.materials, mesh_light.emission, strict=True)):
        if slot == len(mesh.materials):
            mesh.materials.append(None)
        mesh.materials[slot] = material if emission.varies else clear
    return mesh


def _look_at_polygon(studio: Studio, light: Light, pixels: int) -> tuple[np.ndarray, np.ndarray]:
    """Radiance (H, W, 3) of the rectangle around `light`, and the mask (H, W) of the pixels inside its outline.

    Pixels at the outline count only where most of their rays met the light.
    """
    image, covered = studio.look(light.center, light.half_u, light.half_v, light.direction, pixels)
    rows, columns = covered.shape
    x, y = np.meshgrid((np.arange(columns) + 0.5) / columns * 2.0 - 1.0, 1.0 - (np.arange(rows) + 0.5) / rows * 2.0)
    offset = light.corners - light.center
    outline = np.stack([offset @ half / np.dot(half, half) for half in (light.half_u, light.half_v)], axis=-1)
    inside = _contains(outline, x, y)
    unmet = inside & ~covered  # at the outline, or transparent there
    corners = [(x[unmet] + s / columns, y[unmet] + t / rows) for s in (-1.0, 1.0) for t in (-1.0, 1.0)]
    inside[unmet] = np.all([_contains(outline, *corner) for corner in corners], axis=0)
    return image, inside if inside.any() else covered


def _contains(outline: np.ndarray, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """True where the points (x, y) are inside the polygon (V, 2): an odd number of edges to their right."""
    inside = np.zeros(x.shape, bool)
    for (x0, y0), (x1, y1) in zip(outline, np.roll(outline, -1, axis=0), strict=True):
        if y0 != y1:
            inside ^= ((y0 > y) != (y1 > y)) & (x < x0 + (y - y0) * (x1 - x0) / (y1 - y0))
    return inside


def _mean_lights(mesh_light: MeshLight, textured, side: int, studio: Studio, warn) -> dict[int, list[Light]]:
    """By material slot, one light per polygon, with the mean radiance of the largest polygons of its slot and side."""
    sums: dict[tuple[int, int], np.ndarray] = {}
    lights: dict[int, list[Light]] = {}
    largest = []
    for placement, polygons in textured:
        by_size = sorted(polygons, key=lambda polygon: (polygon.label, -np.ptp(polygon.corners, axis=0).max()))
        of_labels = itertools.groupby(by_size, key=lambda polygon: polygon.label)
        largest.append((placement, [one for _, alike in of_labels for one in list(alike)[:STAND_INS]]))
    spread = np.zeros(2)
    for polygon, way, light, image, covered in _looks(mesh_light, largest, side, studio, PIXELS // 16):
        area = 4.0 * np.linalg.norm(np.cross(light.half_u, light.half_v)) * covered.mean()
        share = np.append(area * image[covered].mean(axis=0), area) if covered.any() else np.zeros(4)
        sums[polygon.label, way] = sums.get((polygon.label, way), np.zeros(4)) + share
        if covered.any():
            mean = sums[polygon.label, way][:3] / sums[polygon.label, way][3]
            spread += area * np.abs(image[covered] - mean).mean(), area * mean.mean()
    for polygon, way in itertools.product((one for _, polygons in textured for one in polygons), _sides(side)):
        *light_sum, area = sums.get((polygon.label, way), np.zeros(4))
        if area > 0.0 and np.any(light_sum):
            light = polygon_light(mesh_light.light_of(polygon.label), polygon, way, np.array(light_sum) / area)
            lights.setdefault(polygon.label, []).append(light)
    size = f"{100.0 * spread[0] / max(spread[1], 1e-30):.0f} % off on average"
    many = f"its texture on more than {MOST_RENDERED_POLYGONS} faces is shaded as its mean"
    warn(f"object {mesh_light.ob.name!r}: {many}, {size}")
    return lights


MOST_TRANSPARENT_FACES = 1024


def let_light_through(scene) -> None:
    """Make the faces of all objects with SIDE_PROPERTY transparent to all but camera rays; they emit from the side that
    it names."""
    materials = {material.name_full: material for material in bpy.data.materials if SIDE_PROPERTY in material}
    for ob in bpy.data.objects:
        if SIDE_PROPERTY in ob:
            of_object = [slot.material for slot in ob.material_slots]
            of_object += [layer.material_override for layer in scene.view_layers]
            materials.update((material.name_full, material) for material in of_object if material is not None)
    if materials:
        scene.cycles.transparent_max_bounces = MOST_TRANSPARENT_FACES
    for material in materials.values():
        ensure_nodes(material)
        _let_through(material)


def _let_through(material) -> None:
    tree = material.node_tree
    output = material_output(tree)
    if output is None or live_link(output.inputs["Surface"]) is None:
        return
    original = live_link(output.inputs["Surface"]).from_socket
    clear = tree.nodes.new("ShaderNodeBsdfTransparent").outputs[0]
    both = tree.nodes.new("ShaderNodeAddShader")
    tree.links.new(original, both.inputs[0])
    tree.links.new(clear, both.inputs[1])
    one_sided = mixed(_is_dark_side(tree), both.outputs[0], clear)
    is_camera_ray = tree.nodes.new("ShaderNodeLightPath").outputs["Is Camera Ray"]
    tree.links.new(mixed(is_camera_ray, one_sided, original), output.inputs["Surface"])
    # The setting in the file only affects how well Cycles samples the light.
    material.cycles.emission_sampling = "FRONT_BACK"


def _is_dark_side(tree):
    """A socket that is 1 on the side that does not emit: SIDE_PROPERTY (2 backfacing - 1) > 0."""
    side = tree.nodes.new("ShaderNodeAttribute")
    side.attribute_type, side.attribute_name = "OBJECT", SIDE_PROPERTY
    back = tree.nodes.new("ShaderNodeNewGeometry").outputs["Backfacing"]
    signed = computed("MULTIPLY_ADD", back, 2.0, -1.0)
    return computed("GREATER_THAN", computed("MULTIPLY", signed, side.outputs["Fac"]), 0.0)
