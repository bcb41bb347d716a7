"""Final gathering: the bounced diffuse light of texels from the irradiance that a first, coarse bake left on surfaces
(runs in the child).

Where a diffuse ray of a texel meets a surface whose irradiance is known, its diffuse light follows from a texture:
without the noise of lights and without further bounces (Reichert 1992; Christensen 1999, "Faster Photon Map Global
Illumination"). All else is traced as ever: specular light, surfaces without a texture, their other sides, and what is
so near that the texels of the texture would show.
"""

from contextlib import contextmanager
from dataclasses import dataclass, field

import bpy
import numpy as np

from ...cycles.closures import dielectric_albedo, specular_level_applied
from ..evaluated import objects_in_renders, with_render_depsgraph
from ..lights.emission import emission_of
from ..materials import graph
from ..materials.bsdfs import EMISSION, emission_sockets
from ..render_settings import changed_properties
from . import atlas, bake_meshes
from .bounces import shader_nodes

# MOST_OBJECTS, MOST_FACES: of the surfaces with textures. Each object takes a bake, which reads the scene again: there
# are fewer, but LEAST_OBJECTS, where their number times the faces of the scene would be more than READ_FACES.
MOST_OBJECTS, MOST_FACES, LEAST_OBJECTS, READ_FACES = 24, 100_000, 4, 4_000_000
# MOST_UV_MAPS: of such a surface. Blender has eight, this takes one, and a bake another.
MOST_UV_MAPS = 6
# SIDES: the least and the most texels a side of the texture; between them as many as are baked. They get a quarter of
# the samples: means over many texels are gathered.
SIDES = 256, 1024
# REACH: property of objects, texels of the texture on a metre: what is nearer than a texel is traced.
UV_MAP, REACH, NAME = "ltsh gather", "ltsh_reach", "ltsh gather"
SEED = 77
# COLORS: nodes whose diffuse light follows from irradiance, and the sockets of its color. UNKNOWN: sockets, and the
# values without which it does not.
COLORS = {"ShaderNodeBsdfDiffuse": "Color", graph.PRINCIPLED: "Base Color"}
UNKNOWN = {"Coat Weight": 0.0, "Sheen Weight": 0.0, "Specular Tint": (1.0, 1.0, 1.0)}


@dataclass
class FinalGather:
    """The surfaces of a scene with textures of their irradiance over pi, one for each set of lights."""

    scene: bpy.types.Scene
    view_layer: bpy.types.ViewLayer
    objects: list[bpy.types.Object]
    side: int  # texels a side
    textures: dict[frozenset | None, np.ndarray] = field(default_factory=dict)  # by names of lights; None: all

    @classmethod
    def of(cls, scene, view_layer, size: int) -> "FinalGather":
        """For bakes of `size` texels a side."""
        side, candidates = int(np.clip(size, *SIDES)), _candidates(scene, view_layer)
        densities, _ = atlas.make_atlas(candidates, side, name=UV_MAP) if candidates else ({}, {})
        objects = [scene.objects[name] for name in densities]
        for ob in objects:
            ob[REACH] = densities[ob.name]
        return cls(scene, view_layer, objects, side)

    def serves(self, names: frozenset | None, samples: int) -> bool:
        """True if the light of the lights `names`, which shine, finds a texture when it bounces as the file has it; the
        texture is made."""
        cycles = self.scene.cycles
        if min(cycles.max_bounces, cycles.diffuse_bounces) < 1 or cycles.use_fast_gi or not self.objects:
            return False
        if names not in self.textures:
            try:
                self.textures[names] = self._irradiance(samples)
            except RuntimeError:  # Cycles refuses to bake one
                self.objects.clear()
        return bool(self.objects)

    @contextmanager
    def gathering(self, names: frozenset | None, has_sky: bool):
        """Within this context direct diffuse light on texels is the bounced light of the lights `names`, which `serves`
        knows; with that of the world if `has_sky`."""
        image = bpy.data.images.new(NAME, self.side, self.side, float_buffer=True, is_data=True)
        image.pixels.foreach_set(self.textures[names])
        with _Changes() as changes:
            changes.callback(bpy.data.images.remove, image)
            changes.gather(self.scene, image, has_sky)
            yield

    def _irradiance(self, samples: int) -> np.ndarray:
        """The irradiance over pi (side * side * 4,) of the surfaces, with one bounce less than texels have."""
        cycles = self.scene.cycles
        image = bpy.data.images.new(NAME, self.side, self.side, float_buffer=True, is_data=True)
        values = [("samples", max(samples // 4, 1)), ("seed", SEED)]
        values += [(name, getattr(cycles, name) - 1) for name in ("max_bounces", "diffuse_bounces")]
        view = (self.scene.render.bake, "view_from", "ACTIVE_CAMERA")  # as in `bake.ObjectBake.radiance`
        with changed_properties([*((cycles, *value) for value in values), view]), _Changes() as changes:
            changes.callback(bpy.data.images.remove, image)
            for tree in {slot.material.node_tree for ob in self.objects for slot in ob.material_slots}:
                changes.set(tree.nodes, "active", tree.nodes.active)
                node = changes.add(tree, "ShaderNodeTexImage")
                node.image, tree.nodes.active = image, node
            context = {"scene": self.scene, "view_layer": self.view_layer, "active_object": self.objects[0]}
            with bpy.context.temp_override(**context, object=self.objects[0], selected_objects=self.objects):
                bpy.ops.object.bake(
                    type="DIFFUSE", pass_filter={"DIRECT", "INDIRECT"}, margin=2, margin_type="EXTEND",
                    use_clear=True, uv_layer=UV_MAP, target="IMAGE_TEXTURES", save_mode="INTERNAL",
                    use_selected_to_active=False,
                )  # fmt: skip
            pixels = np.empty(self.side * self.side * 4, np.float32)
            image.pixels.foreach_get(pixels)
        return pixels


def _candidates(scene, view_layer) -> list:
    """The largest meshes that render; none where nodes or lamps cannot be changed."""
    lamps = [ob for ob in bpy.data.objects if ob.type == "LIGHT"]
    owners = *lamps, *bpy.data.lights, *bpy.data.materials, *bpy.data.worlds, *bpy.data.node_groups
    if any(owner.library is not None for owner in owners):
        return []
    meshes = [ob for ob in objects_in_renders(view_layer) if ob.type == "MESH" and ob.library is None]
    bake_meshes.apply_modifiers(scene, meshes)

    def visit(depsgraph):
        items = ((item.is_instance, item.object, item.parent) for item in depsgraph.object_instances)
        return {one.original for is_instance, *both in items if is_instance for one in both}

    instanced, chosen, faces = with_render_depsgraph(scene, visit), [], 0
    if instanced.intersection(lamps):
        return []
    affordable = READ_FACES // max(sum(len(ob.data.polygons) for ob in meshes), 1)
    most = min(max(affordable, LEAST_OBJECTS), MOST_OBJECTS)
    for ob in sorted(meshes, key=lambda ob: (-_size(ob), ob.name)):
        has_nodes = [slot.material is not None and graph.tree_in_use(slot.material) for slot in ob.material_slots]
        is_plain = not (ob.modifiers or ob.data.shape_keys or ob in instanced or ob.holdout_get(view_layer=view_layer))
        if is_plain and has_nodes and all(has_nodes) and len(ob.data.uv_layers) <= MOST_UV_MAPS:
            ob.hide_viewport = False
            ob.hide_set(False, view_layer=view_layer)
            if not ob.visible_get(view_layer=view_layer):  # Cycles' bake refuses it
                continue
            faces += len(ob.data.polygons)
            if faces > MOST_FACES or len(chosen) == most:
                break
            chosen.append(ob)
    return chosen


def _size(ob) -> float:
    x, y, z = ob.dimensions
    return x * y + y * z + z * x


def _left_by_specular(node) -> tuple[float, float]:
    """The share of the light that the specular layer of a Principled BSDF leaves to its diffuse one, for all
    directions on average: at roughness 0 and 1."""
    ior, level = (graph.constant_of(node.inputs[name]) for name in ("IOR", "Specular IOR Level"))
    ior, f0 = specular_level_applied(
        np.array([1.5 if ior is None else max(ior, 1e-5)]), np.array([0.5 if level is None else level])
    )
    cosine = np.sqrt((np.arange(32) + 0.5) / 32)
    f0, ior = np.full((32, 1), np.clip(f0[0], 0.0, 1.0)), np.full(32, ior[0])
    shares = [1.0 - dielectric_albedo(f0, ior, np.full(32, roughness), cosine).mean() for roughness in (0.0, 1.0)]
    return float(shares[0]), float(shares[1])


class _Changes(graph.TreeChanges):
    """The changes of nodes and lights by which irradiance is gathered."""

    def gather(self, scene, image, has_sky: bool) -> None:
        """Change surfaces and lights so that they light texels by the irradiance over pi of `image` alone."""
        nodes, rules = [node for node in shader_nodes() if not node.mute], _rules(image)
        self.callback(bpy.data.node_groups.remove, rules)
        for material in bpy.data.materials:
            if graph.tree_in_use(material) is not None and not emission_of(material).emits:
                self.set(material.cycles, "emission_sampling", "NONE")
        for node in nodes:
            if emission_sockets(node) or node.bl_idname in COLORS:
                self._limit(node, rules)
        for lamp in [ob for ob in bpy.data.objects if ob.type == "LIGHT" and ob.users_collection]:
            if not lamp.hide_render and not lamp.data.cycles.is_portal:
                self._split(lamp, rules)
        if scene.world is not None and not has_sky:
            self.set(scene.world.cycles, "sampling_method", "NONE")
            self._hide(scene.world, rules, "World")

    def _ruled(self, tree, rules):
        node = self.add(tree, "ShaderNodeGroup")
        node.node_tree = rules
        return node.outputs

    def _limit(self, node, rules) -> None:
        """Let a shader node glow at texels by what is known of its diffuse light alone."""
        given = self._ruled(node.id_data, rules)
        for strength in emission_sockets(node)[1:]:
            self.relink(strength, self._math("MULTIPLY", graph.value_of(strength), given["Later"]))
        unknown = [name for name in UNKNOWN if name in node.inputs]
        if node.bl_idname not in COLORS or any(
            not graph.is_constant(graph.value_of(node.inputs[name]), UNKNOWN[name]) for name in unknown
        ):
            return
        known, factors = given["Known"], []
        if node.bl_idname == graph.PRINCIPLED:
            # Metal and glass have no diffuse light; half of either counts as such, or as none.
            for name in ("Metallic", "Transmission Weight"):
                value = graph.value_of(node.inputs[name])
                if not graph.is_constant(value, 0.0):
                    known = self._math("MULTIPLY", known, self._math("LESS_THAN", value, 0.5, known))
                    factors.append(self._math("SUBTRACT", 1.0, value, known))
            smooth, rough = _left_by_specular(node)
            left = self._math("MULTIPLY", graph.value_of(node.inputs["Roughness"]), rough - smooth, known)
            factors += [self._math("ADD", left, smooth), graph.value_of(node.inputs["Alpha"])]
        share = known
        for factor in factors:
            share = self._math("MULTIPLY", share, factor)
        socket, output = node.inputs[COLORS[node.bl_idname]], node.outputs[0]
        color = graph.value_of(socket)
        color = color if graph.is_socket(color) else color[:3]
        emission, both = self.add(node.id_data, EMISSION), self.add(node.id_data, graph.ADD)
        graph.feed(emission.inputs["Color"], self._vector("MULTIPLY", color, given["Light"]))
        graph.feed(emission.inputs["Strength"], share)
        self.relink(socket, self._vector("SCALE", color, self._math("SUBTRACT", 1.0, known)))
        targets = [link.to_socket for link in output.links]
        node.id_data.links.new(output, both.inputs[0])
        node.id_data.links.new(emission.outputs[0], both.inputs[1])
        for target in targets:
            self.relink(target, both.outputs[0])

    def _math(self, operation, first, second, of=None):
        node = self.add(next(one for one in (first, second, of) if graph.is_socket(one)).id_data, "ShaderNodeMath")
        node.operation = operation
        for value, socket in zip((first, second), node.inputs, strict=False):
            graph.feed(socket, value)
        return node.outputs[0]

    def _vector(self, operation, first, second):
        node = self.add(second.id_data, "ShaderNodeVectorMath")
        node.operation = operation
        graph.feed(node.inputs[0], first)
        graph.feed(node.inputs["Scale" if operation == "SCALE" else 1], second)
        return node.outputs[0]

    def _split(self, lamp, rules) -> None:
        """Let a lamp light no diffuse surface, and a second one only these, but for texels.

        Nodes cannot tell a lamp that a ray of a texel hits from one that is sampled where that ray ends; the second one
        is not hit.
        """
        second, data = lamp.copy(), lamp.data.copy()
        self.callback(bpy.data.lights.remove, data)
        self.callback(bpy.data.objects.remove, second)
        second.data = data
        for collection in lamp.users_collection:
            collection.objects.link(second)
        data.cycles.use_multiple_importance_sampling = False
        second.visible_glossy = second.visible_transmission = second.visible_volume_scatter = False
        self.set(lamp, "visible_diffuse", False)
        self._hide(data, rules, "Later")

    def _hide(self, light, rules, name: str) -> None:
        """Let a light or world shine where the output `name` of the `rules` is 1."""
        is_world, has_nodes = isinstance(light, bpy.types.World), graph.tree_in_use(light) is not None
        if not has_nodes:
            self.set(light, "use_nodes", True)
        tree = graph.tree_in_use(light)
        output = graph.material_output(tree) or self.add(tree, f"ShaderNodeOutput{'World' if is_world else 'Light'}")
        link = graph.live_link(output.inputs["Surface"])
        source = link and link.from_socket
        if not has_nodes:
            node = self.add(tree, "ShaderNodeBackground" if is_world else EMISSION)
            node.inputs["Color"].default_value = (*light.color, 1.0) if is_world else (1.0, 1.0, 1.0, 1.0)
            source = node.outputs[0]
        if source is not None:
            mix = self.add(tree, graph.MIX)
            tree.links.new(self._ruled(tree, rules)[name], mix.inputs[0])
            tree.links.new(source, mix.inputs[2])
            self.relink(output.inputs["Surface"], mix.outputs[0])


def _rules(image):
    """A node group of what a ray of a texel finds.

    Known: 1 where it is the first surface that it meets, whose irradiance is known; Light: that irradiance; Later: 0
    for what surfaces and lights emit to the texel itself; World: 0 where the ray meets the world.
    """
    tree = bpy.data.node_groups.new(NAME, "ShaderNodeTree")
    for name in ("Known", "Later", "World", "Light"):
        kind = "NodeSocketColor" if name == "Light" else "NodeSocketFloat"
        tree.interface.new_socket(name, in_out="OUTPUT", socket_type=kind)
    path, reach, side, place, texture, end = (
        tree.nodes.new(kind)
        for kind in (
            "ShaderNodeLightPath", "ShaderNodeAttribute", "ShaderNodeNewGeometry", "ShaderNodeUVMap",
            "ShaderNodeTexImage", "NodeGroupOutput",
        )
    )  # fmt: skip
    reach.attribute_type, reach.attribute_name = "OBJECT", REACH
    place.uv_map, texture.image, texture.extension = UV_MAP, image, "EXTEND"
    tree.links.new(place.outputs["UV"], texture.inputs["Vector"])
    depth = path.outputs["Ray Depth"]
    far = graph.computed("GREATER_THAN", graph.product(path.outputs["Ray Length"], reach.outputs["Fac"]), 1.0)
    front = graph.computed("SUBTRACT", 1.0, side.outputs["Backfacing"])
    first = graph.product(graph.computed("COMPARE", depth, 1.0, 0.1), graph.product(far, front))
    # A ray that meets the world counts one bounce more than one that meets a surface.
    seen = graph.product(path.outputs["Is Diffuse Ray"], graph.computed("LESS_THAN", depth, 2.5))
    later, world = graph.computed("GREATER_THAN", depth, 1.5), graph.computed("SUBTRACT", 1.0, seen)
    for socket, name in ((first, "Known"), (later, "Later"), (world, "World"), (texture.outputs["Color"], "Light")):
        tree.links.new(socket, end.inputs[name])
    return tree
