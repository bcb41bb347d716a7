"""The viewport's copy of a scene, lights included: after a change only what it touches is read again."""

import functools
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from types import SimpleNamespace

import bpy
import numpy as np
from mathutils import Matrix

from ...cycles.gbuffer import rounded_positions
from ...cycles.patches import ERROR
from ...scene import Light, listed
from ..evaluated import (
    SURFACE_TYPES,
    EmitterTraits,
    data_pointer,
    is_seen_by_cameras,
    is_surface,
    mesh_key,
    owner_of,
    visibility,
)
from ..lights.area import area_light, half_hidden, node_light, note_unsupported, reason_to_leave_out
from ..lights.emission import emission_of, factors_of, open_studio
from ..lights.linking import Receivers
from ..lights.meshes import MOST_TRIANGLES, collect_mesh_lights, constant_mesh_lights, fewer_lights
from ..lights.textures import (
    MOST_INSTANCES,
    NodeEmission,
    NodeLight,
    ShownTextures,
    node_emission,
    state_of,
    with_pattern,
)
from ..lights.world import light_of_world
from ..materials.graph import source_of, surface_of, tree_in_use
from ..materials.preview_material import PreviewMaterial, preview_of, world_radiance
from ..materials.values import product, value_at
from .drawing import uniform_buffer
from .light_texels import ShownSky, constant_sky
from .meshes import MeshBatches, look_values, mesh_batches

# FAR_AWAY: the eye where there is no camera, outside of all closed emissive meshes.
FAR_AWAY = np.full(3, 1e6)
# FAR: in m from the origin; up to there positions are at most 0.12 mm apart, which is not looked at.
FAR = 2000.0
# MOST_LIGHTS: patches and faces included. The time of a frame grows with their number.
# One layer of the texture of visibility is that of the sky's sides; cards take 2048 layers.
MOST_LIGHTS = 2047
MOST_VALUES = 1 << 24  # of all patterns: they fill a quarter of the largest texture of lights
# Reasons why a light has no pattern.
NOT_RESOLVED = "its nodes are not resolved, it shines as without them, how far off that is only Cycles can tell"
NOT_YET = "it shines as without its nodes until Cycles has sources at them"
# Patterns: a function that returns how Cycles sees the nodes of evaluated light data, or why that is not known.
Patterns = Callable[[bpy.types.Light, NodeLight], NodeEmission | str]


def no_patterns(data, source: NodeLight) -> str:
    """The `Patterns` of views that resolve no nodes."""
    return NOT_RESOLVED


def view_lights(
    depsgraph, in_view: Callable, textures: ShownTextures, patterns: Patterns = no_patterns
) -> tuple[tuple[Light, ...], tuple[str, ...]]:
    """The lights among the instances that `in_view` accepts, and notes about what differs from Cycles.

    `textures` are those of the last call, for reuse.
    """
    notes: list[str] = []
    receivers = Receivers([ob.original for ob in depsgraph.objects])
    lights, emits = [], False
    for instance in depsgraph.object_instances:
        ob = instance.object
        if not instance.show_self or not in_view(instance):
            continue
        if ob.type in SURFACE_TYPES and not emits:
            is_small = len(getattr(ob.data, "polygons", ())) <= MOST_TRIANGLES
            emits = any(np.any(_emission(slot.material, textures, is_small, [])) for slot in ob.material_slots)
        if ob.type != "LIGHT":
            continue
        matrix = np.array(instance.matrix_world, dtype=np.float64)
        problem = reason_to_leave_out(ob, matrix)
        if problem:
            notes.append(f"{ob.original.name}: {problem}")
            continue
        plain = area_light(ob, matrix, EmitterTraits.of(instance), receivers)
        shown = _with_nodes(plain, instance, (textures, patterns), notes)
        shown = [light for light in shown if np.any(light.radiance != 0.0)]
        if shown:
            lights.extend(shown)
            note_unsupported(ob, matrix, SimpleNamespace(warn=notes.append))
    if emits:
        lights.extend(_mesh_lights(depsgraph, receivers, textures, notes))
    shown, values = list(strongest(lights, notes)), 0
    for number, light in enumerate(shown):
        values += 0 if light.pattern is None else light.pattern.values.size
        if values > MOST_VALUES and light.pattern is not None:
            off = f"{100.0 * np.abs(light.pattern.values - 1.0).mean():.0f} % off on average"
            notes.append(f"{light.name}: it shines without its pattern, {off}: those of other lights fill the texture")
            shown[number] = replace(light, pattern=None)
    return tuple(shown), tuple(dict.fromkeys(notes))


def strongest(lights: Sequence[Light], notes: list[str], most: int = MOST_LIGHTS) -> Sequence[Light]:
    """The `most` lights with the largest power, in their order; what is missing is told in `notes`."""
    if len(lights) <= most:
        return lights
    power = np.array([np.linalg.norm(light.area_vector) * np.abs(light.radiance).sum() for light in lights])
    chosen = np.sort(np.argsort(-power, kind="stable")[:most])
    missing = 1.0 - power[chosen].sum() / power.sum()
    notes.append(
        f"Of {len(lights)} lights, faces and patches the {most} strongest are shown, {100.0 * missing:.1f} % of the "
        "power is missing"
    )
    return [lights[index] for index in chosen]


def _preview(material, textures: ShownTextures) -> PreviewMaterial:
    """The preview of a material, whose `emission` has the mean of its image."""
    look = preview_of(None if material is None else material.original)
    if look.emission_image is None:
        return look
    return replace(look, emission=look.emission + textures.mean(look.emission_image)[0])


def _split(material, light: Light, triangles, uv_maps: dict, share, textures: ShownTextures, notes):
    """Patches of a `light` that shines by an image, or None, see `constant_mesh_lights`."""
    look = None if material is None else preview_of(material)
    image = None if look is None else look.shining_image
    uv = None if image is None or image.image is None else uv_maps.get(image.image.uv_map)
    if uv is None:
        return None
    factor = image.mapped((look.glow or 1.0) * np.eye(3), look.emission)
    return textures.split_polygon(light, factor, triangles, uv, share, notes)


def _emission(material, textures: ShownTextures, is_small: bool, notes: list[str]) -> np.ndarray:
    """The mean emission (3,) of a material; that of an image that only shines is 0 on a mesh that is not small."""
    if material is None:
        return np.zeros(3)
    look = _preview(material, textures)
    image = look.shining_image
    if look.glow and not is_small:
        notes.append(f"{material.name}: more than {MOST_TRIANGLES} triangles shine by its image, they light nothing")
        return look.emission
    if image is None:
        return look.emission
    mean, spread = textures.mean(image)
    if not mean.any():
        notes.append(f"{material.name}: the image that shines is black or only Cycles can read it: it lights nothing")
    elif spread > ERROR:
        off = f"which is {100.0 * spread:.0f} % off its colors"
        notes.append(f"{material.name}: it lights as the mean of its image, {off}")
    return look.glow * mean if look.glow else look.emission


def _mesh_lights(depsgraph, receivers: Receivers, textures: ShownTextures, notes: list[str]) -> list[Light]:
    override = depsgraph.view_layer_eval.material_override
    mesh_lights = collect_mesh_lights(depsgraph, override, receivers, notes.append, copies=False)
    camera = depsgraph.scene.camera
    eye = FAR_AWAY if camera is None else np.array(camera.matrix_world.translation)
    lights = []
    for mesh_light in mesh_lights:
        count = sum(len(placement.triangles) for placement in mesh_light.placements)
        radiance_of = functools.partial(_emission, textures=textures, is_small=count <= MOST_TRIANGLES, notes=notes)
        split = functools.partial(_split, textures=textures, notes=notes)
        lights += constant_mesh_lights(mesh_light, radiance_of, split, eye)
    return fewer_lights(lights, notes.append)


def patterns_of(scene, depsgraph, known: dict[tuple, tuple]) -> dict[tuple, tuple[tuple, NodeEmission]]:
    """How Cycles sees the nodes of lights that views cannot read themselves, by the `key` of the `NodeLight`, with the
    `state_of` them; what is `known` of these states is not rendered again. `scene` is left as it was.
    """
    wanted: dict[tuple, tuple[tuple, NodeLight]] = {}

    def note(data, source: NodeLight) -> str:
        if len(wanted) < MOST_INSTANCES:
            wanted[source.key] = state_of(data, source), source
        return NOT_YET

    receivers, sources = Receivers([ob.original for ob in depsgraph.objects]), (ShownTextures(), note)
    for instance in depsgraph.object_instances:
        ob = instance.object
        if ob.type == "LIGHT" and tree_in_use(ob.data) is not None:
            matrix = np.array(instance.matrix_world, dtype=np.float64)
            if not reason_to_leave_out(ob, matrix):
                _with_nodes(area_light(ob, matrix, EmitterTraits.of(instance), receivers), instance, sources, [])
    patterns = {key: known[key] for key, (state, _) in wanted.items() if key in known and known[key][0] == state}
    if len(patterns) < len(wanted):
        with open_studio(scene) as studio:
            for key in wanted.keys() - patterns.keys():
                state, source = wanted[key]
                patterns[key] = state, node_emission(source, studio)
    return patterns


def _with_nodes(light: Light, instance, sources: tuple, notes: list[str]) -> list[Light]:
    """The lights that the node tree of a depsgraph `instance` makes of `light`; [] where it emits nothing.

    `sources` are the textures and patterns of `view_lights`.
    """
    ob, (textures, patterns) = instance.object, sources
    data = ob.data
    emission = None if tree_in_use(data) is None else emission_of(data)
    if emission is None or emission.plain:
        return [light]
    surface = surface_of(data)
    source = source_of(surface) if surface is not None else None
    if source is None or source.node is None:
        return []
    if source.node.bl_idname == "ShaderNodeEmission" and emission.falloff is not None:
        if not light.is_distant:
            light = replace(light, falloff=emission.falloff.power, smooth=emission.falloff.smooth)
        entries, _ = factors_of(source)
        factor = functools.reduce(product, [value_at(*entry) for entry in entries])
        if factor is not None and factor.is_constant:
            return [replace(light, radiance=light.radiance * factor.offset)]
        is_area = not (light.is_facing or light.is_distant)
        patches = textures.split(light, factor, notes) if factor is not None and is_area else None
        if patches is not None:
            return patches
    warnings: list[str] = []
    matrix = np.array(instance.matrix_world, dtype=np.float64)
    unseen = node_light(ob, matrix, SimpleNamespace(warn=warnings.append), instance)
    pattern = patterns(data, unseen)
    if isinstance(pattern, str):
        notes.append(f"{light.name}: {pattern}")
        return [light if light.is_distant else replace(light, falloff=0, smooth=0.0)]
    notes += warnings
    if not light.is_distant:
        light = replace(light, falloff=unseen.falloff.power, smooth=unseen.falloff.smooth)
    if light.is_facing or light.is_distant:
        return with_pattern(light, pattern, unseen, notes.append)
    return textures.split_by_nodes(light, pattern, notes)


# NOT_SHOWN: notes about types of objects that views leave out. NAMED: the most names of objects in such a note.
NOT_SHOWN = {
    "CURVES": "hair is not shown in views",
    "VOLUME": "volumes are not shown in views",
}
NAMED = 3
# HOLDOUT: the receiver number of holdouts, which hide what is behind them and show nothing themselves.
HOLDOUT = -1


@dataclass
class ShownLook:
    """A look on the graphics card."""

    look: PreviewMaterial
    uniforms: object  # its uniform buffer
    textures: dict | None = None  # by slot; made at the first draw
    further: "tuple[ShownLook, ...]" = ()  # the other lobes

    @property
    def lobes(self) -> "tuple[ShownLook, ...]":
        """This lobe and the further ones; none where the look is clear."""
        return () if self.look.is_clear else (self, *self.further)

    @property
    def is_glass(self) -> bool:
        """True if light from behind comes through a lobe; clear looks, which are not drawn, do not count."""
        return any(lobe.look.through > 0.0 for lobe in self.lobes)


@dataclass(frozen=True)
class ShownInstance:
    """One placement of a mesh."""

    mesh: MeshBatches
    model: Matrix
    looks: tuple[ShownLook, ...]  # one for each slot of the mesh
    receiver: int  # or HOLDOUT
    side: float  # -1 where the transform mirrors
    center: np.ndarray  # (4,) homogeneous, of the bounding box in the world
    is_only_user: bool  # no other instance has the mesh


@dataclass
class Changes:
    """What an update of the depsgraph changes."""

    everything: bool = False
    geometry: set[int] = field(default_factory=set)  # session uids of original objects and their data
    materials: set[str] = field(default_factory=set)  # full names
    images: bool = False
    instances: bool = False
    lights: bool = False
    world: bool = False

    @property
    def surfaces(self) -> bool:
        """True if the G-buffer changes."""
        return self.everything or self.instances or self.images or bool(self.geometry or self.materials)

    @property
    def emitters(self) -> bool:
        """True if lights must be read again."""
        return self.everything or self.lights or self.images or bool(self.materials)

    @property
    def sky(self) -> bool:
        """True if the world must be read again."""
        return self.everything or self.world or self.images

    def add(self, depsgraph) -> None:
        """Add those in `depsgraph.updates`."""
        for update in depsgraph.updates:
            block = update.id.original
            if isinstance(block, bpy.types.Object):
                self._add_object(block, update)
            elif isinstance(block, bpy.types.Light | bpy.types.NodeTree):
                # Node trees of materials and worlds come with their owners, so others belong to lights.
                self.lights = True
            elif isinstance(block, bpy.types.Material):
                self.materials.add(block.name_full)
            elif isinstance(block, bpy.types.Image):
                self.images = True
            elif isinstance(block, bpy.types.World):
                self.world = True
            elif isinstance(block, bpy.types.Collection | bpy.types.Scene):
                self.instances = self.lights = self.world = True
            elif update.is_updated_geometry:
                self.geometry.add(block.session_uid)

    def _add_object(self, block, update) -> None:
        if block.type == "LIGHT":
            self.lights = True
            return
        # Other objects may be mesh lights, which look at the camera, or instance lights.
        self.lights |= update.is_updated_transform or update.is_updated_geometry
        if block.type == "CAMERA":
            return
        self.instances = True
        if update.is_updated_geometry:
            self.geometry.add(block.session_uid)


def object_notes(depsgraph, known: dict[str, str]) -> list[str]:
    """Notes about objects that renders of `depsgraph` show otherwise than views, kind by kind; `known` are those of
    some objects by name."""
    names_by_kind: dict[str, list[str]] = {}
    for ob in depsgraph.objects:
        kind = known.get(ob.name)
        if kind is None and ob.type in SURFACE_TYPES and ob.is_shadow_catcher:
            kind = "shown as any surface, not as shadow catcher"
        if kind is None and any(system.settings.type == "HAIR" for system in ob.particle_systems):
            kind = NOT_SHOWN["CURVES"]
        if kind is None and ob.type == "META" and _has_lost_balls(ob, depsgraph):
            kind = "balls smaller than the Resolution Viewport are coarse or missing in views: lower it"
        if kind is not None:
            names_by_kind.setdefault(kind, []).append(ob.name)
    return [f"{listed(names, NAMED)}: {kind}" for kind, names in names_by_kind.items()]


def _has_lost_balls(ob, depsgraph) -> bool:
    """True if a ball of the metaballs `ob` is smaller than the resolution of views, but not than that of renders."""
    # Metaballs whose names differ only in the number share the resolution of the first.
    family = [one for one in depsgraph.objects if one.type == "META" and _family(one) == _family(ob)]
    first = min(family, key=lambda one: one.name).data
    balls = [ball for ball in ob.data.elements if not (ball.hide or ball.use_negative)]
    # A ball's surface is where its field equals the threshold.
    radii = [ball.radius * max(1.0 - (first.threshold / ball.stiffness) ** (1.0 / 3.0), 0.0) ** 0.5 for ball in balls]
    return any(first.render_resolution < radius < first.resolution for radius in radii)


def _family(ob) -> str:
    return ob.name.partition(".")[0]


class SceneMirror:
    """The meshes, looks, instances, lights and world of one view of a scene."""

    def __init__(self, look: Callable = lambda world: None, patterns: Patterns = no_patterns):
        """`look(world)` returns the `ShownSky` of a world that is not constant; None while it is not known."""
        self._patterns = patterns
        self.instances: list[ShownInstance] = []
        self.lights: tuple[Light, ...] = ()  # with the small bright lights of the world
        self.sky = ShownSky()
        self.lights_without_world: tuple[Light, ...] = ()  # without those of the world
        self._look = look
        self.surfaces_version = 0
        self._meshes: dict[tuple, MeshBatches | None] = {}
        self._looks: dict[str, ShownLook] = {}
        self._object_notes: tuple[str, ...] = ()
        self._light_notes: tuple[str, ...] = ()
        self._light_textures = ShownTextures()
        self.has_old_lights = False  # True: there are new results about lights, which are to be read again
        self._world_note: tuple[str, ...] = ()
        self._limit_notes: list[str] = []
        self._synced = False

    @property
    def notes(self) -> list[str]:
        """Notes about what differs from Cycles, each once."""
        notes = self.material_notes, self._object_notes, self._light_notes, self._world_note, self._limit_notes
        return list(dict.fromkeys(note for kind in notes for note in kind))

    def notes_with_rest(self, is_everything: bool) -> list[str]:
        """Those of them that remain when Cycles adds the rest; `is_everything`: that is the whole picture."""
        materials = [note for shown in self._looks.values() for note in shown.look.notes_in_view(with_bounces=True)]
        objects = () if is_everything else self._object_notes
        return list(dict.fromkeys([*materials, *objects, *self._light_notes, *self._world_note, *self._limit_notes]))

    @property
    def material_notes(self) -> list[str]:
        """The notes about materials."""
        return [note for shown in self._looks.values() for note in shown.look.notes]

    @property
    def triangles(self) -> int:
        return sum(instance.mesh.triangles for instance in self.instances)

    @property
    def most_lobes(self) -> int:
        """The largest number of lobes of a material."""
        return max((len(shown.lobes) for shown in self._looks.values()), default=0)

    @property
    def has_glass(self) -> bool:
        """True if anything is seen through a surface."""
        return any(shown.is_glass for shown in self._looks.values())

    def sync(self, depsgraph, space=None, changes: Changes | None = None) -> None:
        """Take over all changes; `space` is the 3D view, for its local view. None: those in `depsgraph.updates`."""
        if changes is None:
            changes = Changes(everything=not self._synced)
            changes.add(depsgraph)
        self._drop_changed(changes)
        in_view = visibility(depsgraph, space)
        if changes.surfaces:
            self._read_instances(depsgraph, changes, in_view)
            self.surfaces_version += 1
        if changes.emitters:
            self.read_lights(depsgraph, in_view)
        if changes.sky:
            self._read_world(depsgraph.view_layer.world_override or depsgraph.scene.world)
        self._synced = True

    def read_lights(self, depsgraph, in_view: Callable) -> None:
        """Read the lights of the instances that `in_view` accepts."""
        self.lights_without_world, self._light_notes = view_lights(
            depsgraph, in_view, self._light_textures, self._patterns
        )
        self.take_sky(self.sky, *self._world_note)
        self.has_old_lights = False

    def _drop_changed(self, changes: Changes) -> None:
        if changes.everything:
            self._meshes.clear()
            self._looks.clear()
        for name in changes.materials:
            self._looks.pop(name, None)
        if changes.images:
            self._light_textures.clear()
            self._looks = {name: one for name, one in self._looks.items() if one.look.emission_image is None}
            for shown in (lobe for look in self._looks.values() for lobe in look.lobes):
                shown.textures = None

    def _read_instances(self, depsgraph, changes: Changes, in_view) -> None:
        override = depsgraph.view_layer_eval.material_override
        receivers = Receivers([ob.original for ob in depsgraph.objects])
        instances, meshes, looks, notes = [], {}, {}, {}
        users = Counter()  # instances by evaluated data, those out of view included
        for instance in depsgraph.object_instances:
            ob = instance.object
            if instance.show_self and ob.type in NOT_SHOWN:
                notes[ob.name] = NOT_SHOWN[ob.type]
            if not is_surface(instance):
                continue
            data = data_pointer(ob)
            users[data] += 1
            if not is_seen_by_cameras(instance, depsgraph.view_layer) or not in_view(instance):
                continue
            key = mesh_key(instance)
            if key not in meshes:
                known = key in self._meshes and not changes.geometry.intersection(key[:3])
                meshes[key] = self._meshes[key] if known else mesh_batches(ob)
            mesh = meshes[key]
            if mesh is None:
                continue
            materials = _materials(ob, mesh, override)
            for material in materials:
                name = _name(material)
                if name not in looks:
                    looks[name] = self._looks.get(name) or _shown_look(material, self._light_textures)
            shown = tuple(looks[_name(material)] for material in materials)
            for lobe in (lobe.look for look in shown for lobe in look.lobes):
                if lobe.has_uv_tangent:
                    mesh.add_tangents(ob, lobe.uv_map)
                if lobe.brush is not None and lobe.brush.direction and ob.type != "POINTCLOUD":
                    mesh.add_around(ob)
            receiver = _receiver(instance, receivers, depsgraph.view_layer)
            if receiver == HOLDOUT and not depsgraph.scene.render.film_transparent:
                notes[ob.name] = "the holdout shows the world in views, renders show black"
            model = instance.matrix_world.copy()
            side = -1.0 if model.determinant() < 0.0 else 1.0
            center = np.array(model) @ [*mesh.middle, 1.0]
            instances.append((data, (mesh, model, shown, receiver, side, center)))
        self.instances = [ShownInstance(*values, is_only_user=users[data] == 1) for data, values in instances]
        self._meshes, self._looks = meshes, looks
        self._object_notes = tuple(object_notes(depsgraph, notes))

    def _read_world(self, world) -> None:
        radiance, whole = world_radiance(world)
        like = None if world is None else light_of_world(world)
        if whole:
            is_seen = world is not None and world.cycles_visibility.camera
            self.take_sky(constant_sky(like, radiance, radiance * is_seen))
            return
        sky = self._look(world.original)
        if sky is None:
            note = f"{world.name}: its viewport color is shown until Cycles has looked at it"
            self.take_sky(constant_sky(like, radiance, radiance), note)
        else:
            self.take_sky(sky)

    def take_sky(self, sky: ShownSky, *notes: str) -> None:
        """Show this world from now on; `notes` tell how it differs from Cycles."""
        self.sky, self._world_note, self._limit_notes = sky, notes, []
        most = MOST_LIGHTS - len(sky.lights)
        self.lights = (*strongest(self.lights_without_world, self._limit_notes, most), *sky.lights)
        points = [shown.center[:3] for shown in self.instances] + [light.center for light in self.lights]
        points = np.array(points).reshape(-1, 3)
        self._limit_notes += rounded_positions(points[np.abs(points).max(axis=1) > FAR], self.lights)
        halves = {light.name: light for light in self.lights if light.affects_diffuse != light.affects_specular}
        self._limit_notes += map(half_hidden, halves.values())


def _shown_look(material, textures: ShownTextures) -> ShownLook:
    look = _preview(material, textures)
    further = tuple(ShownLook(lobe, uniform_buffer(look_values(lobe))) for lobe in look.further)
    return ShownLook(look, uniform_buffer(look_values(look)), further=further)


def _materials(ob, mesh: MeshBatches, override) -> list:
    """The material of every slot of `mesh`; None for empty slots."""
    slots = [slot.material for slot in ob.material_slots] or [None]
    return [override or slots[slot] for slot in mesh.slots]


def _name(material) -> str:
    return material.name_full if material else ""


def _receiver(instance, receivers: Receivers, view_layer) -> int:
    owner = owner_of(instance).original
    if owner.holdout_get(view_layer=view_layer):
        return HOLDOUT
    numbers = receivers.numbers
    of_object = numbers.get(instance.object.original.name_full, 0)
    return numbers.get(owner.name_full, of_object) if instance.is_instance else of_object
