"""The varying values of a material: images that are read directly, and maps that Cycles bakes (in the child).

For a bake the material emits the values of a map. A color or normal takes a map of its own; three numbers share one.
`baked_transparency` bakes what a surface lets through for shadow rays.
"""

import math
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import bpy
import numpy as np

from ...cycles.lobes import LOBE_AOVS
from ...cycles.texels import MapValue, TextureFile, TextureValue
from ...files import save_array
from ...lobes.brdf import dielectric_reflectance
from ...visibility.occluders import Transparency
from ..evaluated import image_pixels, read_values
from ..render_settings import working_space
from . import graph
from .bsdfs import EMISSION
from .preview_material import ViewFactor
from .values import IDENTITY, READERS, is_srgb, opaque_pixels

# UV_MAP: number of the map that shows the coordinates of the UV map being baked.
UV_MAP = -1
# SURFACE: outputs of the Geometry node for `cycles.texels.BakeMaterial.moved`, the last one without bumps.
SURFACE = "Position", "Normal", "True Normal", "Normal"
# SAME_SPACE: the working space is Rec.709 if its matrix to Rec.709 differs less from the identity.
SAME_SPACE = 1e-4


class SavedImages:
    """Images saved as .npy files in a folder, each once, with row 0 at the bottom."""

    def __init__(self, folder: Path):
        self.folder, self._names = folder, {}

    def file_of(self, image) -> str | None:
        """File name of the pixels (H, W, 3) of `image`, uint8 or float32; None if the image is not opaque."""
        if image.name_full not in self._names:
            self._names[image.name_full] = self._save(image)
        return self._names[image.name_full]

    def _save(self, image):
        colors = opaque_pixels(image)
        if colors is None:
            return None
        name = f"image_{len(self._names)}.npy"
        save_array(self.folder / name, colors if image.is_float else np.rint(255.0 * colors).astype(np.uint8))
        return name


def plain_texture(output, groups, kind: str) -> tuple[bpy.types.Image, TextureFile, str] | None:
    """The image, how it is read, and its component if the `output` of a node shows a texture unchanged, else None.

    `groups` are those around the node (see `graph.Source`), `kind` is the type of the socket that shows it. The
    component is "color", or the number of a channel.
    """
    source = graph.source_behind(output, groups)
    if source is None or source.node is None or not source.arrives_whole(kind):
        return None
    is_texture = source.node.bl_idname in ("ShaderNodeTexImage", "ShaderNodeSeparateColor")
    value = READERS[source.node.bl_idname](source) if is_texture else None
    if value is None or value.is_constant or value.image.mapping != IDENTITY:
        return None
    component = "color" if np.array_equal(value.matrix[:, :3], np.eye(3)) else str(value.matrix[0].argmax())
    use, srgb = value.image, _known_encoding(value.image.image)
    if srgb is None or component == "3":  # alpha
        return None
    return use.image, TextureFile(use.uv_map, use.extension, "Closest" if use.closest else "Linear", srgb), component


def _known_encoding(image) -> bool | None:
    """Whether an image from a single file has sRGB values; None if that is unknown, or for other kinds of images."""
    scene = bpy.context.scene
    if image.source != "FILE" or (scene.render.use_simplify and scene.cycles.texture_limit_render != "OFF"):
        return None
    is_other_space = np.abs(np.array(working_space()["to_rec709"]) - np.eye(3)).max() > SAME_SPACE
    return None if is_other_space else is_srgb(image)


def _alphas_in_use(tree, paths):
    """Sockets of the material's `tree` with the linked alphas of images, in the tree and in the groups of `paths`.

    They must stay linked: Cycles reads other colors from an image if its alpha feeds nothing.
    """
    places = dict.fromkeys(groups[:depth] for groups in ((), *paths) for depth in range(len(groups) + 1))
    for path in places:
        for node in (path[-1].node_tree if path else tree).nodes:
            if node.bl_idname == "ShaderNodeTexImage" and node.outputs["Alpha"].is_linked:
                socket = node.outputs["Alpha"]
                for group in reversed(path):
                    socket = graph.carry_out_of_group(group, socket)
                yield socket


class MaterialPlan:
    """The maps of one material, and the nodes that make the material emit them.

    `lobes` are dictionaries of `bsdfs.lobe_values`, and `paths` the groups around each (see `graph.Source`). Textures
    on the UV maps `uv_names` need no map: they are saved to `images`, unless that is None.
    """

    def __init__(self, material, lobes: tuple[dict, ...], paths: tuple, images: SavedImages | None, uv_names=()):
        self.material, self.tree = material, material.node_tree
        self.textures: list[TextureFile] = []
        self._images, self._uv_names = images, {"", *uv_names}
        # The sockets of each map in the tree of the material: one color, or up to three numbers.
        self._maps: list[list] = []
        self._colors: set[int] = set()  # numbers of the maps of one color
        self._numbers: int | None = None  # number of the map that takes the next number
        self.lobes = tuple(
            {name: self._recorded(name, value, groups) for name, value in lobe.items()}
            for lobe, groups in zip(lobes, paths, strict=True)
        )
        self._alphas = list(_alphas_in_use(self.tree, paths))
        self._geometry, self._moved = None, []
        self._output, self._surface, self._image_node, self._places = None, None, None, None
        self._emissions: dict[int, object] = {}  # number of a map -> the node that emits it

    @property
    def count(self) -> int:
        """Number of maps."""
        return len(self._maps)

    def add_surface(self) -> None:
        """Add the maps of SURFACE, for objects that materials displace, where their mesh does not tell them."""
        self._geometry = self.tree.nodes.new(GEOMETRY)
        self._method = self.material.displacement_method
        count = 3 if self._method == "BUMP" else 4
        self._moved = [self._color_map(self._geometry.outputs[name]) for name in SURFACE[:count]]

    def record(self) -> dict:
        """The record of the material for `cycles.texels.BakeMaterial.of`."""
        corrected = bool(self.material.cycles.use_bump_map_correction)
        lobes = [
            {name: vars(value) if isinstance(value, MapValue | TextureValue) else value for name, value in lobe.items()}
            for lobe in self.lobes
        ]
        textures = [vars(texture) for texture in self.textures]
        return {"corrected": corrected, "lobes": lobes, "textures": textures, "moved": self._moved}

    def _recorded(self, name, value, groups):
        if not graph.is_socket(value):
            return list(value[:3]) if isinstance(value, tuple) else value
        texture = self._looked_up(name, value, groups) if self._images is not None else None
        if texture is not None:
            return texture
        socket = value
        for group in reversed(groups):
            socket = graph.carry_out_of_group(group, socket)
        if LOBE_AOVS[name][0] == "COLOR":
            return MapValue(self._color_map(socket))
        if self._numbers is None or len(self._maps[self._numbers]) == 3:
            self._maps.append([])
            self._numbers = len(self._maps) - 1
        self._maps[self._numbers].append(socket)
        return MapValue(self._numbers, len(self._maps[self._numbers]) - 1)

    def _color_map(self, socket) -> int:
        """The number of a further map, which shows a color or a vector."""
        self._colors.add(len(self._maps))
        self._maps.append([socket])
        return len(self._maps) - 1

    def _looked_up(self, name, socket, groups):
        """The `TextureValue` of a socket that shows an image unchanged, or None."""
        is_color = LOBE_AOVS[name][0] == "COLOR"
        shown = plain_texture(socket, groups, "RGBA" if is_color else "VALUE")
        if shown is None or shown[1].uv not in self._uv_names:
            return None
        image, texture, component = shown
        if is_color and component != "color":
            return None
        file = self._images.file_of(image)
        if file is None:
            return None
        texture = replace(texture, file=file)
        if texture not in self.textures:
            self.textures.append(texture)
        return TextureValue(
            self.textures.index(texture), "gray" if component == "color" and not is_color else component
        )

    def prepare(self, uv_name: str) -> None:
        """Add the nodes that `show` and `target` need; `uv_name` is the UV map that UV_MAP shows."""
        self._output = graph.material_output(self.tree)
        if self._output is None:
            self._output = self.tree.nodes.new("ShaderNodeOutputMaterial")
        link = graph.live_link(self._output.inputs["Surface"])
        self._surface = link.from_socket if link else None
        self._emissions = {number: self._emission(number) for number in range(self.count)}
        self._places = self.tree.nodes.new("ShaderNodeUVMap")
        self._places.uv_map = uv_name
        self._emissions[UV_MAP] = self.tree.nodes.new("ShaderNodeEmission")
        self.tree.links.new(self._places.outputs["UV"], self._emissions[UV_MAP].inputs["Color"])
        self._image_node = self.tree.nodes.new("ShaderNodeTexImage")

    def _emission(self, number):
        emission, sockets = self.tree.nodes.new("ShaderNodeEmission"), self._maps[number]
        for alpha in self._alphas:
            one = graph.computed("MAXIMUM", alpha, graph.value_of(emission.inputs["Strength"]), clamp=True)
            self.tree.links.new(one, emission.inputs["Strength"])
        if number in self._colors:
            self.tree.links.new(sockets[0], emission.inputs["Color"])
            return emission
        # A number may come from a color or vector socket; a link to a number socket converts it as the shader would.
        combined = self.tree.nodes.new("ShaderNodeCombineXYZ")
        for socket, target in zip(sockets, combined.inputs, strict=False):
            self.tree.links.new(socket, target)
        self.tree.links.new(combined.outputs[0], emission.inputs["Color"])
        return emission

    def show(self, number: int | None) -> None:
        """Make the material emit map `number`, black if there is no such map; None restores its surface."""
        surface = self._output.inputs["Surface"]
        graph.cut(surface)
        if number is None:
            if self._surface is not None:
                self.tree.links.new(self._surface, surface)
        elif number in self._emissions:
            self.tree.links.new(self._emissions[number].outputs[0], surface)
        if self._moved:
            is_smooth = self._method == "BOTH" and number == self._moved[-1]
            self.material.displacement_method = "DISPLACEMENT" if is_smooth else self._method

    def target(self, image) -> None:
        """Make `image` the target of bakes."""
        self._image_node.image = image
        self.tree.nodes.active = self._image_node

    def remove(self) -> None:
        """Remove the nodes of `prepare` and restore the surface."""
        self.show(None)
        geometry = () if self._geometry is None else (self._geometry,)
        for node in (self._image_node, self._places, *self._emissions.values(), *geometry):
            self.tree.nodes.remove(node)


# Transparency:

LIGHT_PATH, LAYER_WEIGHT, GEOMETRY = "ShaderNodeLightPath", "ShaderNodeLayerWeight", "ShaderNodeNewGeometry"
DIRECTIONAL = "ShaderNodeFresnel", LAYER_WEIGHT, GEOMETRY
# UNKNOWN: outputs of nodes that differ from shadow ray to shadow ray by more than `Transparency.cosines`.
UNKNOWN = {"Ray Length", "Transparent Depth", "Incoming", "Reflection", "Window"}
# COSINES: those of `Transparency.cosines` for shares that do not vary, closest at grazing angles, where Fresnel is
# steepest.
_FRONT = np.square(np.linspace(1e-3, 1.0, 129))
COSINES = np.append(-_FRONT[::-1], _FRONT)
EVEN = 1e-4  # shares that differ less count as the same
# MOST_TEXELS: of a bake. MOST_SIDE: of a face. GAP: between faces. SAMPLES: of a texel.
MOST_TEXELS, MOST_SIDE, GAP, SAMPLES = 1 << 18, 512, 2, 4


def shown_to_shadow_ray(node, output: str, number: float | None, cosine: float | None) -> float | None:
    """What the `output` of a node is for a shadow ray that meets a surface at `cosine` (see `Transparency.cosines`),
    where its first input is the constant `number`; None: unknown. Bumps are left out: on average they change little."""
    kind = node.bl_idname
    if kind == LIGHT_PATH:
        return None if output in UNKNOWN else float(output in ("Is Shadow Ray", "Ray Depth"))
    if cosine is None or (kind == GEOMETRY and output != "Backfacing") or (kind != GEOMETRY and number is None):
        return None
    if kind == GEOMETRY:
        return float(cosine < 0.0)
    factor = ViewFactor.of("facing" if output == "Facing" else "fresnel", number, kind == LAYER_WEIGHT)
    if factor.kind == "facing":
        return 1.0 - abs(cosine) ** factor.parameter
    index = factor.parameter
    return float(dielectric_reflectance(abs(cosine), index if cosine >= 0.0 else 1.0 / index))


def _by_cosine(output) -> np.ndarray | None:
    """The value of the `output` of a node for shadow rays at COSINES; None: unknown."""
    number = graph.value_of(output.node.inputs[0]) if output.node.inputs else None
    if output.node.bl_idname not in (LIGHT_PATH, *DIRECTIONAL) or graph.is_socket(number):
        return None
    values = [shown_to_shadow_ray(output.node, output.name, number, cosine) for cosine in COSINES]
    return None if None in values else np.array(values)


def depends_on_rays(trees) -> str:
    """What the nodes of `trees` depend on that differs from ray to ray and is baked as one value, and which; or ""."""
    outputs = [one for tree in trees for node in tree.nodes for one in node.outputs if one.is_linked]
    names = {output.name for output in outputs if output.name in UNKNOWN and not graph.is_group(output.node)}
    of_outputs = [(output.name, _by_cosine(output)) for output in outputs]
    spreads = {name: np.abs(one - one.mean()).mean() for name, one in of_outputs if one is not None and np.ptp(one) > 0}
    off = max(spreads.values(), default=0.0)
    mean = f"the mean over directions, {100.0 * off:.0f} % off on average" if spreads else "0, or along the normal"
    names |= set(spreads)
    return f"{' and '.join(sorted(names))}, of which it is {mean}" if names else ""


def even_transparency(shares: np.ndarray, cosines, triangles: int) -> Transparency:
    """The transparency of so many triangles by their `shares` (A,) at `cosines` (A,); () with a single share."""
    shares = np.clip(shares, 0.0, 1.0).astype(np.float32)
    if np.ptp(shares) <= EVEN:
        return Transparency(float(shares.mean()))
    uv = np.zeros((triangles, 3, 2), np.float32)
    return Transparency(1.0, shares[:, None, None], uv, "EXTEND", "Closest", cosines=tuple(cosines))


def baked_transparency(surface, studio) -> tuple[Transparency, float]:
    """What a `surface` (`extract.occluders.UnreadSurface`) lets through for shadow rays, as Cycles bakes it from its
    mesh, which is changed; and how far off a color may be from the mean of all three."""
    mesh, count = surface.mesh, len(surface.mesh.polygons)
    slots = read_values(mesh.polygons, "material_index", (count,), np.int32)
    is_chosen = np.clip(slots, 0, max(len(mesh.materials) - 1, 0)) == surface.slot
    uv, size = _side_by_side(mesh, np.flatnonzero(is_chosen))
    layer = mesh.uv_layers.new(name="ltsh_shares", do_init=False) or mesh.uv_layers[-1]
    layer.uv.foreach_set("vector", uv.ravel())
    image = bpy.data.images.new("ltsh shares", size, size, alpha=True, float_buffer=True, is_data=True)
    try:
        with _emitting_share(surface.material, surface.facts.random, image) as emitter:
            mesh.materials.append(emitter)
            for number in range(len(mesh.materials)):
                mesh.materials[number] = emitter  # the other faces lie outside
            ob, scene = bpy.data.objects.new("ltsh shares", mesh), studio.scene
            scene.cycles.samples = SAMPLES
            context = {"view_layer": scene.view_layers[0], "active_object": ob, "selected_objects": [ob]}
            with (
                studio.show(ob, surface.matrix, surface.facts),
                bpy.context.temp_override(scene=scene, object=ob, **context),
            ):
                margin = {"margin": GAP // 2, "margin_type": "EXTEND"}
                bpy.ops.object.bake(
                    type="EMIT", use_clear=False, uv_layer=layer.name, target="IMAGE_TEXTURES", save_mode="INTERNAL",
                    use_selected_to_active=False, **margin,
                )  # fmt: skip
        pixels = image_pixels(image)
    finally:
        bpy.data.images.remove(image)
    mesh.calc_loop_triangles()
    triangles = len(mesh.loop_triangles)
    of_faces = is_chosen[read_values(mesh.loop_triangles, "polygon_index", (triangles,), np.int32)]
    corners = read_values(mesh.loop_triangles, "loops", (triangles, 3), np.int32)[of_faces]
    colors = np.clip(np.nan_to_num(pixels[..., :3]), 0.0, 1.0)
    shares = colors.mean(axis=-1)
    return Transparency(1.0, shares, uv[corners], "EXTEND"), float(np.abs(colors - shares[..., None]).max())


def baked_displacement(surface, studio) -> np.ndarray:
    """By how much Cycles displaces the vertices (V, 3) of a `surface` (`extract.occluders.DisplacedSurface`), in the
    space of its mesh.

    Cycles bakes the positions of corners, a little inside of their faces, with and without displacement. The mean of
    the differences at all corners of a vertex is its own.
    """
    mesh = surface.mesh
    materials = [material for material in dict.fromkeys(surface.materials) if material is not None]
    for number, material in enumerate(surface.materials):
        if number < len(mesh.materials):
            mesh.materials[number] = material
        else:  # an override needs no slot
            mesh.materials.append(material)
    layer = mesh.color_attributes.new("ltsh_position", "FLOAT_COLOR", "CORNER")
    mesh.color_attributes.active_color = layer
    ob, scene, count = bpy.data.objects.new("ltsh displaced", mesh), studio.scene, len(mesh.loops)
    context = {"view_layer": scene.view_layers[0], "active_object": ob, "selected_objects": [ob]}

    def positions():
        bpy.ops.object.bake(type="POSITION", target="VERTEX_COLORS", use_selected_to_active=False)
        colors = mesh.color_attributes["ltsh_position"].data
        return read_values(colors, "color", (count, 4), np.float32)[:, :3].astype(float)

    methods = [material.displacement_method for material in materials]
    scene.cycles.samples = 1
    with studio.show(ob, surface.matrix, surface.facts), bpy.context.temp_override(scene=scene, object=ob, **context):
        moved = positions()
        try:
            for material in materials:
                material.displacement_method = "BUMP"
            moved -= positions()
        finally:
            for material, method in zip(materials, methods, strict=True):
                material.displacement_method = method
    mesh.color_attributes.remove(mesh.color_attributes["ltsh_position"])
    vertex = read_values(mesh.loops, "vertex_index", (count,), np.int32)
    number = np.maximum(np.bincount(vertex, minlength=len(mesh.vertices)), 1)
    moved = np.stack([np.bincount(vertex, column, len(mesh.vertices)) / number for column in moved.T], axis=1)
    return np.linalg.solve(surface.matrix[:3, :3], moved.T).T.astype(np.float32)


def _side_by_side(mesh, faces: np.ndarray) -> tuple[np.ndarray, int]:
    """UV coordinates (C, 2) of the corners of `mesh` that place the `faces` side by side in a square picture, and the
    texels along its side. The corners of other faces lie at one place outside."""
    count, columns = len(mesh.polygons), math.ceil(math.sqrt(len(faces)))
    side = max(min(MOST_SIDE, math.isqrt(MOST_TEXELS) // columns - GAP), 1)
    first, corners = (read_values(mesh.polygons, name, (count,), np.int32) for name in ("loop_start", "loop_total"))
    face, size = np.repeat(np.arange(count), corners), columns * (side + GAP)
    vertices = read_values(mesh.vertices, "co", (len(mesh.vertices), 3), np.float32).astype(np.float64)
    corner = vertices[read_values(mesh.loops, "vertex_index", (len(face),), np.int32)]
    along = corner[first + 1] - corner[first]
    across = np.cross(read_values(mesh.polygons, "normal", (count, 3), np.float32), along)
    places = np.stack([(corner * axis[face]).sum(axis=1) for axis in (along, across)], axis=1)
    places -= np.minimum.reduceat(places, first)[face]
    places *= (side / np.maximum(np.maximum.reduceat(places, first), 1e-30))[face]
    cells = np.full((count, 2), np.nan)
    cells[faces] = np.stack(np.divmod(np.arange(len(faces)), columns), axis=1) * (side + GAP) + 0.5 * GAP
    return np.nan_to_num((places + cells[face]) / size, nan=-1.0).astype(np.float32), size


@contextmanager
def _emitting_share(material, random: float, image):
    """Within this context: a copy of `material` that emits what it lets through for shadow rays and bakes to `image`;
    what depends on their direction has its mean over COSINES. `random` is that of Object Info."""
    material = material.copy()
    groups = graph.own_groups(material.node_tree)
    try:
        material.cycles.emission_sampling = "NONE"
        for name in ("Volume", "Displacement"):
            graph.cut(graph.material_output(material.node_tree).inputs[name])
        for tree in (material.node_tree, *groups):
            for node in list(tree.nodes):
                is_whole = not (graph.is_group(node) and node.node_tree is not None)
                if is_whole and any(socket.type == "SHADER" for socket in node.outputs):
                    _emit_share(node)
                for output in [output for output in node.outputs if output.is_linked]:
                    values = _by_cosine(output)
                    mean = None if values is None else float(values.mean())
                    if (node.bl_idname, output.name) == ("ShaderNodeObjectInfo", "Random"):
                        mean = random
                    if mean is not None:
                        graph.replaced_by_number(output, mean)
        nodes = material.node_tree.nodes
        nodes.active = nodes.new("ShaderNodeTexImage")
        nodes.active.image = image
        yield material
    finally:
        bpy.data.materials.remove(material)
        for group in groups:
            bpy.data.node_groups.remove(group)


def _emit_share(node) -> None:
    """Let a shader node emit what it lets through instead; mixes and sums of shaders stay."""
    if any(socket.type == "SHADER" for socket in node.inputs):
        return
    emission = node.id_data.nodes.new(EMISSION)
    value, target = 0.0, emission.inputs["Strength"]
    if node.bl_idname == graph.CLEAR:
        value, target = graph.value_of(node.inputs["Color"]), emission.inputs["Color"]
    elif node.bl_idname == graph.PRINCIPLED:
        alpha = graph.value_of(node.inputs["Alpha"])
        value = graph.computed("SUBTRACT", 1.0, alpha, clamp=True) if graph.is_socket(alpha) else max(1.0 - alpha, 0.0)
    graph.feed(target, value)
    for output in node.outputs:
        graph.feed_instead(output, emission.outputs[0])
