"""What blocks light in an evaluated scene (runs in the child).

As in Cycles, every object that is visible to shadow rays blocks them, holdouts and glowing objects included.
What their shapes are is in `occluder_shapes`.
"""

from collections.abc import Callable
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial

import bpy
import numpy as np
from bpy_extras.object_utils import world_to_camera_view
from mathutils import Vector

from ...cycles.texels import srgb_decode
from ...scene import FARTHEST, listed
from ...visibility.occluders import TERMINATOR_OFFSET, OccluderMesh, Occluders, Transparency, overlaps_within
from ..evaluated import SURFACE_TYPES, image_pixels, is_rendered, owner_of
from ..lights.emission import ObjectFacts, open_studio, trees_of
from ..lights.linking import MOST_BLOCKER_SETS, OTHER_LIGHTS, Blockers
from ..materials import maps, values
from ..materials.graph import ADD, CLEAR, MIX, PRINCIPLED, Source, is_displaced, live_link, source_of, surface_of
from ..render_settings import cycles_setting
from . import occluder_shapes as shapes

# NAMED: how many names of a kind a warning lists. LEAST_DOUBLED: least share of the area of an object in other faces
# that is named. TINY: radius of a light in m below which the geometry does not tell on which side of a face it is.
# LEAST_COLOR: least difference of a color of transparent surfaces from the mean of all three that is named, as COLORED.
NAMED, LEAST_DOUBLED, TINY, LEAST_COLOR = 3, 1e-3, 1e-4, 0.01
# TWO_SIDED: an object is a sheet with two sides if more of its faces lie in others; of touching solids fewer do.
TWO_SIDED = 0.9
IN_CYCLES = "Cycles is black there, tilted faces are lit at random by about half"
COLORED = "colored transparency counts by its mean, up to {} of the light off in a color, as shadows are gray"
# A light is sampled by rays toward points on the light, and by rays in directions that the surface chooses.
# SURFACE_SHIFT: the bits of a mask for the latter are this much higher, if some object blocks only one kind of ray.
SURFACE_SHIFT = 16


def collect_occluders(
    depsgraph, override, warn, left_out=frozenset(), unread: list | None = None, displaced: list | None = None
) -> Occluders:
    """What blocks shadow rays in a render of `depsgraph`, without the objects with full names in `left_out`.

    The material `override` replaces all others. `warn(text)` is called for differences from Cycles. Call this before
    materials are changed. `unread` gets each `UnreadSurface`, and `displaced` each `DisplacedSurface`; without these
    lists such surfaces block, or block where they are without displacement, which is warned of.
    """
    return _Collector(depsgraph, override, left_out, unread, displaced).collect(warn)


@dataclass(frozen=True)
class UnreadSurface:
    """Faces of an object that block until Cycles tells what they let through: a slot of `mesh`, a copy."""

    name: str
    mesh: object
    slot: int
    material: object  # the original
    matrix: np.ndarray  # (4, 4)
    facts: ObjectFacts
    number: int  # of the mesh in the occluders


@dataclass(frozen=True)
class DisplacedSurface:
    """An object whose material displaces it: a copy of its mesh without that."""

    mesh: object
    materials: tuple  # originals, by slot
    matrix: np.ndarray  # (4, 4)
    facts: ObjectFacts
    numbers: tuple[int, ...]  # of its meshes in the occluders
    split: Callable  # `shapes.split_mesh`, which makes these meshes of `mesh`


def with_displacement(occluders: Occluders, displaced: list[DisplacedSurface], scene) -> Occluders:
    """`occluders` with the `displaced` surfaces where Cycles has them. Call this before materials are changed."""
    meshes = list(occluders.meshes)
    for surface in displaced:
        with open_studio(scene) as studio:
            moved = maps.baked_displacement(surface, studio)
        for number, mesh in zip(surface.numbers, surface.split(surface.mesh, moved=moved), strict=True):
            meshes[number] = mesh
        bpy.data.meshes.remove(surface.mesh)
    return replace(occluders, meshes=tuple(meshes))


def with_baked_shares(occluders: Occluders, unread: list[UnreadSurface], scene, warn) -> Occluders:
    """`occluders` with what the `unread` surfaces let through. `warn(text)` tells what of that is approximated.

    Call this before materials are changed.
    """
    meshes, colored = list(occluders.meshes), {}
    for surface in unread:
        with open_studio(scene) as studio:
            if scene.camera is not None:
                studio.camera.matrix_world = scene.camera.matrix_world
            transparency, off = maps.baked_transparency(surface, studio)
        colored[surface.material.name] = max(colored.get(surface.material.name, 0.0), off)
        meshes[surface.number] = replace(meshes[surface.number], transparency=transparency)
        bpy.data.meshes.remove(surface.mesh)
    for material in dict.fromkeys(surface.material for surface in unread):
        problem = maps.depends_on_rays(trees_of([material]))
        if problem:
            warn(f"shadows: what material {material.name!r} lets through depends on {problem}")
    for name, off in colored.items():
        if off > LEAST_COLOR:
            warn(f"shadows: {COLORED.format(_percent(off))}: {name!r}")
    return replace(occluders, meshes=tuple(meshes))


@dataclass(frozen=True)
class _Instances:
    """Instances of one mesh."""

    mesh: int
    matrices: np.ndarray  # (N, 3, 4)
    mask: int
    terminator: float
    name: str
    owner: int  # the index in `_Collector._names`; -1: its faces are not looked for in planes of others


class _Collector:
    def __init__(self, depsgraph, override, left_out, unread, displaced):
        self._depsgraph, self._override, self._left_out = depsgraph, override, left_out
        self._unread, self._displaced = unread, displaced
        objects = {
            instance.object.original.name_full: instance.object.original for instance in depsgraph.object_instances
        }
        # If some object blocks only one kind of ray, each kind has its own half of a mask.
        surfaces = (one for one in depsgraph.object_instances if one.object.type in SURFACE_TYPES)
        self._shift = SURFACE_SHIFT if any(len(set(_meets(one))) > 1 for one in surfaces) else 0
        self._most_sets = (SURFACE_SHIFT if self._shift else MOST_BLOCKER_SETS + 1) - 1
        self._blockers = Blockers(list(objects.values()), self._most_sets)
        self._meshes: list[OccluderMesh] = []
        # Key of evaluated data -> numbers of its meshes, and the matrices (N, 4, 4) of its points in the object.
        self._shapes: dict[tuple, tuple[list[int], np.ndarray]] = {}
        self._instances: list[_Instances] = []
        self._names: list[str] = []  # of objects, one for each time that instances were added
        # (size, matrix) of a mesh -> number of the first such mesh, and the name of its object.
        self._first_meshes: dict[tuple, tuple[int, str]] = {}
        self._materials: dict[str, _ClearMaterial | None] = {}
        self._images: dict[tuple, np.ndarray] = {}
        # Difference from Cycles -> names of the objects that it concerns.
        self._notes: dict[str, dict[str, None]] = {}

    def collect(self, warn) -> Occluders:
        for instance in self._depsgraph.object_instances:
            ob = instance.object
            if ob.type not in SURFACE_TYPES or ob.original.name_full in self._left_out:
                continue
            if not any(_meets(instance)):
                continue
            matrix = np.array(instance.matrix_world, dtype=np.float64)
            if not np.isfinite(matrix).all() or np.abs(matrix).max() > FARTHEST:
                continue
            if self._is_culled(ob, matrix):
                continue
            if instance.show_self and is_rendered(ob):
                self._add(instance, matrix)
            if instance.show_particles and ob.particle_systems:
                self._add_hair(instance)
        occluders = self._joined()
        self._warn_of_planes(occluders, warn)
        for kind, names in self._notes.items():
            warn(f"shadows: {kind}: {listed(map(repr, names), NAMED)}")
        if self._blockers.unnumbered:
            warn(
                f"shadows: all objects block lights {listed(map(repr, self._blockers.unnumbered), NAMED)}: more than "
                f"{self._most_sets} blocker collections are not told apart"
            )
        return occluders

    def _joined(self) -> Occluders:
        matrices = [instances.matrices for instances in self._instances]
        mesh, masks, terminators = (
            np.repeat([getattr(instances, name) for instances in self._instances], list(map(len, matrices)))
            for name in ("mesh", "mask", "terminator")
        )
        return Occluders(
            tuple(self._meshes),
            mesh.astype(np.int64),
            np.concatenate(matrices) if matrices else np.zeros((0, 3, 4)),
            masks.astype(np.uint32),
            terminators,
            int(cycles_setting(self._depsgraph.scene, "transparent_max_bounces")),
            {name: mask for name, mask in self._blockers.light_masks.items() if mask != OTHER_LIGHTS},
            self._blockers.lone_choices,
            self._shift,
        )

    def _note(self, kind: str, block) -> None:
        self._notes.setdefault(kind, {})[block.original.name if block.original else block.name] = None

    def _add_instances(self, instance, matrix, numbers, matrices=shapes.ONE_INSTANCE) -> None:
        mask, (by_light, by_surface) = self._blockers.mask_of(instance), _meets(instance)
        if self._shift:
            mask = by_light * mask | (by_surface * mask) << self._shift
        terminator = getattr(instance.object, "shadow_terminator_geometry_offset", TERMINATOR_OFFSET)
        matrices_3x4, name = (matrix @ matrices)[:, :3], instance.object.original.name
        # Hair and points are no faces, and the depsgraph lists metaballs twice.
        has_faces = instance.object.type != "META" and all(self._meshes[number].thickness is None for number in numbers)
        twins = [has_faces and self._is_twin(number, matrix, instance.object) for number in numbers]
        owner = len(self._names) if has_faces and not any(twins) else -1
        self._names.append(name)
        self._instances += [_Instances(number, matrices_3x4, mask, terminator, name, owner) for number in numbers]

    def _warn_of_planes(self, occluders, warn):
        """Name lights without depth and faces that lie in faces of other objects, up to rounding."""
        count = [len(instances.matrices) for instances in self._instances]
        instance_of = np.repeat(np.arange(len(self._instances)), count)
        in_planes = {}
        for instance in self._depsgraph.object_instances:
            if instance.object.type == "LIGHT" and instance.show_self and _is_flat(instance.object.data):
                for number in occluders.holding(*_points_of_light(instance)):
                    name = self._instances[instance_of[number]].name
                    in_planes[f"{instance.object.original.name!r} in {name!r}"] = None
        if in_planes:
            warn(
                f"shadows: lights in the plane of a face: {listed(in_planes, NAMED)}: Cycles shows at random from "
                "all to none of their light, the techniques show all; move them off by 0.1 mm"
            )
        owners = np.array([instances.owner for instances in self._instances], np.int64)[instance_of]
        pairs = sorted(occluders.overlaps(owners).items(), key=lambda pair: -pair[1])
        texts = {}
        for (first, other), share in pairs:
            names = [self._names[owner] for owner in (first, other)]
            if share > LEAST_DOUBLED and frozenset(names) not in texts:
                texts[frozenset(names)] = f"{_percent(share)} of those of {names[0]!r} in {names[1]!r}"
        if texts:
            warn(
                f"shadows: faces in one plane: {listed(texts.values(), NAMED)}: {IN_CYCLES}, here faces that "
                "face alike are lit; move one off by 0.1 mm"
            )

    def _is_twin(self, number, matrix, ob) -> bool:
        """Whether an equal mesh is already in the same place, which gets a note."""
        mesh, mesh_and_name = self._meshes[number], (number, ob.original.name)
        first = self._first_meshes.setdefault(
            (len(mesh.vertices), len(mesh.triangles), matrix.tobytes()), mesh_and_name
        )
        if first is mesh_and_name or not _is_same(mesh, self._meshes[first[0]]):
            return False
        self._note(f"in the same place as {first[1]!r}: {IN_CYCLES}, here both are lit; remove one", ob)
        return True

    # Surfaces:

    def _add(self, instance, matrix) -> None:
        ob = instance.object
        materials = [slot.material for slot in ob.material_slots] or [None]
        if self._override:
            materials = [self._override] * len(materials)
        owner = owner_of(instance)
        if (ob.visible_diffuse and owner.visible_diffuse) != _meets(instance)[1]:
            text = "diffuse and glossy rays do not both meet it: light that surfaces choose counts as glossy"
            self._note(f"{text}: its shadow in diffuse light is off, by half where a light fills half of the sky", ob)
        key = (*shapes.shape_key(ob), tuple(material.name_full if material else "" for material in materials))
        if key not in self._shapes:
            clear = [self._clear_of(material) for material in materials]
            matrices = shapes.ONE_INSTANCE
            if ob.type == "CURVES":
                meshes = shapes.tubes_of_curves(ob, clear[0], self._note)
            elif ob.type == "POINTCLOUD":
                meshes, matrices = shapes.balls(ob, clear[0], self._note)
            else:
                meshes = shapes.split_by_slot(ob, clear, self._image)
                alike, any_way = overlaps_within(meshes)
                if alike > LEAST_DOUBLED:
                    text = f"of its faces where others are: {IN_CYCLES}, here all are lit"
                    self._note(f"{_percent(alike)} {text}", ob)
                elif any_way > TWO_SIDED:
                    text = f"of its faces where others face the other way: {IN_CYCLES}, here all are dark"
                    self._note(f"{_percent(any_way)} {text}", ob)
            self._shapes[key] = self._number(meshes), matrices
            self._remember_unread(instance, matrix, materials, self._shapes[key][0])
            if any(material is not None and is_displaced(material) for material in materials):
                self._remember_displaced(instance, matrix, materials, clear, self._shapes[key][0])
        self._add_instances(instance, matrix, *self._shapes[key])

    def _number(self, meshes) -> list[int]:
        """Keep those `meshes` that have triangles; returns their numbers."""
        first = len(self._meshes)
        self._meshes += [mesh for mesh in meshes if len(mesh.triangles)]
        return list(range(first, len(self._meshes)))

    def _remember_unread(self, instance, matrix, materials, numbers) -> None:
        ob = instance.object
        for number in numbers:
            slot = getattr(self._meshes[number].transparency, "slot", None)
            if slot is not None:
                surface = ob.original.name, self._copy_of(ob), slot, materials[slot].original, matrix
                self._unread.append(UnreadSurface(*surface, ObjectFacts.of(ob, instance), number))

    def _remember_displaced(self, instance, matrix, materials, clear, numbers) -> None:
        ob = instance.object
        # Before 5.0 a setting of objects, later of modifiers.
        subdivided = getattr(ob.original, "cycles", None), *ob.modifiers
        is_diced = any(getattr(one, "use_adaptive_subdivision", False) for one in subdivided)
        if is_diced:
            text = "displacement with adaptive subdivision is not in shadows: faces are dark where it takes them inward"
            self._note(f"{text}: switch that subdivision off", ob)
        elif self._displaced is None or ob.type in ("CURVES", "POINTCLOUD"):
            self._note("displacement is not in shadows, which are off by its height: use a modifier", ob)
        elif numbers:
            mesh, originals = self._copy_of(ob), tuple(material and material.original for material in materials)
            split = partial(shapes.split_mesh, clear=clear, image_of=self._image)
            surface = mesh, originals, matrix, ObjectFacts.of(ob, instance), tuple(numbers)
            self._displaced.append(DisplacedSurface(*surface, split))

    def _copy_of(self, ob):
        """A mesh with the shape of `ob`, for objects of other scenes."""
        mesh = bpy.data.meshes.new_from_object(ob, preserve_all_data_layers=True, depsgraph=self._depsgraph)
        if ob.type == "MESH":
            mesh.use_auto_texspace, data = False, ob.original.data
            mesh.texspace_location, mesh.texspace_size = data.texspace_location, data.texspace_size
        return mesh

    def _is_culled(self, ob, matrix) -> bool:
        """Whether Cycles leaves out the object for the culling that Simplify asks for (`BlenderObjectCulling`)."""
        scene, of_scene = self._depsgraph.scene, partial(cycles_setting, self._depsgraph.scene)
        asked = [of_scene(name) and cycles_setting(ob, name) for name in ("use_camera_cull", "use_distance_cull")]
        if not (scene.render.use_simplify and scene.camera and any(asked)):
            return False
        corners = np.array([(*corner, 1.0) for corner in ob.bound_box]) @ matrix[:3].T
        shown = np.array([world_to_camera_view(scene, scene.camera, Vector(corner)) for corner in corners])
        beside = np.where(shown[:, 2:] < 0.0, 0.5 - shown[:, :2], shown[:, :2] - 0.5)
        margin, eye = of_scene("camera_cull_margin"), np.array(scene.camera.matrix_world.translation)
        away = np.linalg.norm(np.clip(eye, corners.min(axis=0), corners.max(axis=0)) - eye)
        beyond = (np.maximum(beside.min(axis=0), -beside.max(axis=0)) >= 0.5 + margin).any()
        is_out = beyond or (shown[:, 2] < -margin).all(), away > of_scene("distance_cull_margin")
        return all(out for is_asked, out in zip(asked, is_out, strict=True) if is_asked)

    def _clear_of(self, material) -> "_ClearMaterial | None":
        """The light that a material lets through; None if it blocks all."""
        if material is None:
            return None
        if material.name_full not in self._materials:
            self._materials[material.name_full] = self._read(material.original)
        return self._materials[material.name_full]

    def _read(self, material):
        surface = surface_of(material)
        if surface is None or not getattr(material, "use_transparent_shadow", True):
            return None
        output = surface.node
        if live_link(surface) is None:
            # A material with only a volume lets light through; another warning tells that volumes are not shaded.
            return None if live_link(output.inputs["Volume"]) is None else _ClearMaterial(shares=(1.0,))
        with _read_for_shadow_rays():
            value, curve = _share_at(surface), None
        if isinstance(value, values.Curved):
            value, curve = value.value, (value.places, value.numbers)
        if value is None:
            colors = _colors_by_cosine(surface)
            if colors is None:
                return self._unread_material(material)
            return self._gray(colors, material)
        if value.is_constant:
            return self._gray(np.clip(value.offset, 0.0, 1.0)[None], material)
        colors = [value] if values.is_gray(value) else [value.mapped(np.tile(row, (3, 1))) for row in np.eye(3)]
        value = value.mapped(np.full((3, 3), 1.0 / 3.0)) if len(colors) == 3 else value
        image = self._image(value)
        if image is None:
            return self._unread_material(material)
        if len(colors) == 3:
            self._gray(np.clip([self._image(color) for color in colors], 0.0, 1.0).reshape(3, -1).T, material)
        return (
            _ClearMaterial(value, curve) if np.interp(image, *curve or ((0.0, 1.0), (0.0, 1.0))).max() > 0.0 else None
        )

    def _gray(self, colors: np.ndarray, material) -> "_ClearMaterial | None":
        """What lets through the means of `colors` (A, 3), which is noted if they are colored; None if all are 0."""
        shares = colors.mean(axis=1)
        if (off := np.abs(colors - shares[:, None]).max()) > LEAST_COLOR:
            self._note(COLORED.format(_percent(off)), material)
        return _ClearMaterial(shares=tuple(shares.tolist())) if shares.max() > 0.0 else None

    def _unread_material(self, material) -> "_ClearMaterial":
        if self._unread is not None:
            return _ClearMaterial()
        share = 0.5 * _most_at(surface_of(material))
        text = f"only Cycles can tell how transparent it is; here it lets {100.0 * share:.0f} % of the light through"
        self._note(f"{text}, at most as much off", material)
        return _ClearMaterial(shares=(share,))

    def _image(self, value: values.Value) -> np.ndarray | None:
        """`value` at the pixels (H, W) of its image; None if only Cycles knows the colors."""
        use = value.image
        key = (use.image.session_uid, value.matrix[0].tobytes(), value.offset[0].tobytes())
        if key not in self._images:
            self._images[key] = _values_of_image(value)
        return self._images[key]

    # Hair of particle systems:

    def _add_hair(self, instance) -> None:
        ob = instance.object
        for modifier in ob.modifiers:
            system = modifier.particle_system if modifier.type == "PARTICLE_SYSTEM" else None
            if system is None or not modifier.show_render:
                continue
            settings = system.settings
            if settings.type != "HAIR" or settings.render_type != "PATH":
                continue
            if instance.is_instance:
                self._note("hair on instances blocks nothing, in Cycles it has its shadow; make the instances real", ob)
                continue
            numbers, steps = shapes.hairs_of(system, is_view=self._depsgraph.mode == "VIEWPORT")
            if len(numbers) * steps > shapes.MOST_PIECES:
                self._note(shapes.TOO_MANY.format(len(numbers) * steps), ob)
                continue
            self._note(shapes.TUBES, ob)
            slot = min(settings.material, len(ob.material_slots)) - 1
            material = self._override or (ob.material_slots[slot].material if slot >= 0 else None)
            meshes = [shapes.tubes_of_hair(ob, system, numbers, steps, self._clear_of(material))]
            # The positions of particles are in world space.
            self._add_instances(instance, np.eye(4), self._number(meshes))


def _meets(instance) -> tuple[bool, bool]:
    """Whether the instance blocks rays toward points on lights, and glossy rays in directions that surfaces choose."""
    ob, owner = instance.object, owner_of(instance)
    return tuple(getattr(ob, name) and getattr(owner, name) for name in ("visible_shadow", "visible_glossy"))


def _percent(share) -> str:
    return f"{float(f'{100.0 * share:.2g}'):g} %"


def _is_same(mesh, other):
    return mesh is other or all(
        np.array_equal(getattr(mesh, name), getattr(other, name)) for name in ("vertices", "triangles")
    )


# Transparency of materials:


@dataclass(frozen=True)
class _UnreadTransparency(Transparency):
    """The transparency of faces that block until `with_baked_shares` asks Cycles, and their material slot."""

    share: float = 0.0
    slot: int = 0


@dataclass(frozen=True)
class _ClearMaterial:
    """The share of light that a material lets through: `value`, or `shares` (one, or at maps.COSINES), or unknown."""

    value: values.Value | None = None
    curve: tuple | None = None  # see `Transparency.curve`
    shares: tuple[float, ...] = ()

    def transparency(self, slot: int, triangles: int, uv_of, image_of) -> Transparency:
        """The `Transparency` of so many `triangles` of a `slot`.

        `uv_of(name)` returns their corners on a UV map, and `image_of(value)` the shares at the pixels of an image.
        """
        if self.shares:
            return maps.even_transparency(self.shares, maps.COSINES, triangles)
        if self.value is None:
            return _UnreadTransparency(slot=slot)
        use = self.value.image
        mapping = np.array(use.mapping, np.float32)
        uv = uv_of(use.uv_map) @ mapping[:, :2].T + mapping[:, 2]
        return Transparency(
            image=image_of(self.value),
            uv=uv.astype(np.float32),
            extension=use.extension,
            interpolation="Closest" if use.closest else "Linear",
            outside=float(self.value.offset[0]),
            curve=self.curve,
        )


@contextmanager
def _read_for_shadow_rays(cosine: float | None = None):
    """Within this context nodes are read as they are for shadow rays; with a `cosine`, for those that meet the surface
    at that (see `Transparency.cosines`). Without it what depends on that is unknown."""

    def read(source: Source) -> values.Value | None:
        number = values.constant_inputs(source, 0) if source.node.inputs else None
        number = None if number is None else float(number[0][0])
        value = maps.shown_to_shadow_ray(source.node, source.socket.name, number, cosine)
        return None if value is None else values.constant(value)

    readers = dict.fromkeys((maps.LIGHT_PATH, *maps.DIRECTIONAL), read)
    values.READERS.update(readers)
    try:
        yield
    finally:
        for kind in readers:
            del values.READERS[kind]


def _colors_by_cosine(surface) -> np.ndarray | None:
    """The shares (A, 3) at `maps.COSINES` of the shader at the input `surface`; None where not only they decide."""
    colors = []
    for cosine in maps.COSINES.tolist():
        with _read_for_shadow_rays(cosine):
            value = _share_at(surface)
        if not _is_constant(value):
            return None
        colors.append(np.clip(value.offset, 0.0, 1.0))
    return np.array(colors)


def _share_at(socket, groups: tuple = ()) -> values.Value | values.Curved | None:
    """The share of light that the shader at the input `socket` lets through for shadow rays; None: unknown."""
    source = source_of(socket, groups)
    if source is None or source.node is None:
        return values.constant(0.0)
    node, groups = source.node, source.groups
    if node.bl_idname == CLEAR:
        return values.value_at(node.inputs["Color"], groups)
    if node.bl_idname == PRINCIPLED:
        return values.combined(
            values.constant(1.0), values.limited(values.curved_at(node.inputs["Alpha"], groups)), 1.0, -1.0
        )
    if node.bl_idname not in (MIX, ADD):
        return values.constant(0.0)
    inputs = [_share_at(socket, groups) for socket in node.inputs if socket.type == "SHADER"]
    if node.bl_idname == ADD:
        return values.combined(*inputs, 1.0, 1.0)
    if all(_is_constant(value) and not value.offset.any() for value in inputs):
        return inputs[0]  # whatever the factor is
    factor = values.limited(values.curved_at(node.inputs[0], groups))
    if factor is None:
        return None
    if _is_constant(factor):
        share = float(factor.offset[0])
        # The other shader does not contribute and may be unknown.
        if share in (0.0, 1.0):
            return inputs[int(share)]
        return values.combined(*inputs, 1.0 - share, share)
    first, second = inputs
    if not (_is_constant(first) and _is_constant(second)):
        return None
    if isinstance(factor, values.Curved):
        begin, end = (float(value.offset.mean()) for value in inputs)
        return factor.mapped(end - begin, begin)
    return values.combined(first, values.product(factor, values.constant(second.offset - first.offset)), 1.0, 1.0)


def _most_at(socket, groups: tuple = ()) -> float:
    """The largest share of light that the shader at the input `socket` may let through."""
    value, source = _share_at(socket, groups), source_of(socket, groups)
    if _is_constant(value):
        return float(np.clip(value.offset.mean(), 0.0, 1.0))
    node, groups = source.node, source.groups
    if node.bl_idname not in (MIX, ADD):
        return 1.0
    inputs = [_most_at(one, groups) for one in node.inputs if one.type == "SHADER"]
    if node.bl_idname == ADD:
        return min(sum(inputs), 1.0)
    factor = values.limited(values.curved_at(node.inputs[0], groups))
    return float(np.interp(factor.offset[0], (0.0, 1.0), inputs)) if _is_constant(factor) else max(inputs)


def _is_constant(value: values.Value | values.Curved | None) -> bool:
    return isinstance(value, values.Value) and value.is_constant


def _values_of_image(value: values.Value) -> np.ndarray | None:
    image = value.image.image
    colors_count = bool(np.any(value.matrix[:, :3]))
    srgb = values.is_srgb(image)
    if not all(image.size) or (colors_count and srgb is None):
        return None
    pixels = image_pixels(image)
    if image.alpha_mode == "NONE":
        pixels[..., 3] = 1.0
    if colors_count and image.alpha_mode != "CHANNEL_PACKED" and (pixels[..., 3] != 1.0).any():
        return None  # Cycles multiplies colors by alpha unless the material uses both
    if colors_count and srgb:
        pixels[..., :3] = srgb_decode(pixels[..., :3])
    return pixels @ value.matrix[0].astype(np.float32) + np.float32(value.offset[0])


def _is_flat(light) -> bool:
    """True for area lights, and for points and spots that are hardly more than a point."""
    return light.type == "AREA" or light.type in ("POINT", "SPOT") and light.shadow_soft_size < TINY


def _points_of_light(instance) -> tuple[np.ndarray, np.ndarray | None]:
    """The center of a light and, of an area light, four points near its corners (N, 3), and its unit normal (3,)."""
    light, matrix = instance.object.data, np.array(instance.matrix_world, dtype=np.float64)
    if light.type != "AREA":
        return matrix[None, :3, 3], None
    depth = light.size_y if light.shape in ("RECTANGLE", "ELLIPSE") else light.size
    places = 0.35 * np.array([[0, 0], [-1, -1], [-1, 1], [1, -1], [1, 1]]) * (light.size, depth)
    normal = np.cross(matrix[:3, 0], matrix[:3, 1])
    return places @ matrix[:3, :2].T + matrix[:3, 3], normal / max(np.linalg.norm(normal), 1e-30)
