"""What lights emit: read from the node tree of a light, or from a render of the light where that is not enough."""

import tempfile
import time
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

import bpy
import numpy as np
from mathutils import Color, Euler, Matrix, Vector

from ...scene import listed
from ..evaluated import image_pixels
from ..materials import graph
from ..materials.bsdfs import EMISSION, emission_sockets, emits
from ..materials.values import value_at
from ..render_settings import enable_passes

# Nodes whose outputs are constant if their inputs are.
CONSTANT_NODES = frozenset(
    "ShaderNode" + name
    for name in (
        *("Value", "RGB", "Blackbody", "Wavelength", "Math", "VectorMath", "Mix", "MixRGB", "Clamp", "MapRange"),
        *("CombineColor", "SeparateColor", "CombineXYZ", "SeparateXYZ", "ValToRGB", "HueSaturation", "Gamma"),
        *("BrightContrast", "Invert", "RGBCurve", "VectorCurve", "FloatCurve", "RGBToBW", "LightFalloff"),
    )
) | {"FunctionNodeInputColor", "FunctionNodeInputVector", "FunctionNodeInputInt", "FunctionNodeInputBool"}
# The next five tables name the outputs of nodes that depend on something; an empty tuple stands for all outputs.
# DIRECTIONAL: on the direction in which the light leaves.
DIRECTIONAL = {
    "ShaderNodeLayerWeight": (),
    "ShaderNodeFresnel": (),
    "ShaderNodeTexIES": (),  # unless its Vector is linked
    "ShaderNodeNewGeometry": ("Incoming",),
    "ShaderNodeTexCoord": ("Reflection",),
}
# OF_CAMERA: on the camera of the picture.
OF_CAMERA = {"ShaderNodeCameraData": (), "ShaderNodeTexCoord": ("Camera", "Window")}
# PLACED: on the place in the world or on the object, and not only on the place on the light.
PLACED = {
    **{f"ShaderNode{name}": () for name in ("NewGeometry", "ObjectInfo", "VectorTransform", "Attribute", "Bump")},
    **{f"ShaderNode{name}": () for name in ("CameraData", "Tangent", "NormalMap", "TexEnvironment", "TexSky")},
    "ShaderNodeTexCoord": ("Camera", "Window", "Reflection"),  # and Object, if the node names another object
}
# BY_PLACE: on the place on the light or its normal there. So do textures whose Vector is not linked, except IES.
BY_PLACE = {
    "ShaderNodeNewGeometry": ("Position", "Normal", "True Normal", "Parametric", "Tangent"),
    "ShaderNodeTexCoord": ("Generated", "Normal", "UV", "Object", "Reflection"),
    **{f"ShaderNode{name}": () for name in ("LayerWeight", "Fresnel", "UVMap", "Tangent", "Bump", "NormalMap")},
}
# BY_UV: on the UV coordinates. So do image textures whose Vector is not linked.
BY_UV = {"ShaderNodeNewGeometry": ("Parametric",), "ShaderNodeTexCoord": ("UV",), "ShaderNodeUVMap": ()}
LIGHT_PATH, CAMERA_RAY, IES = "ShaderNodeLightPath", "Is Camera Ray", "ShaderNodeTexIES"


LIGHT_FALLOFF = "ShaderNodeLightFalloff"
COMPARE_TELLS = "how far off that is, only a comparison with Cycles can tell"
NO_FACTOR = (
    "its emission is not a product of one Light Falloff and the rest; shaded as if Light Falloff nodes gave their "
    f"Strength at any distance; right at 1 m, {COMPARE_TELLS}"
)
POWERS = {"Quadratic": 0, "Linear": 1, "Constant": 2}  # output of the Light Falloff node -> power of the distance


@dataclass(frozen=True)
class Falloff:
    """How the distance scales a light: the fields `falloff` and `smooth` of a `FlatLight`."""

    power: int = 0
    smooth: float = 0.0

    def times(self, other: "Falloff") -> "Falloff | None":
        """The product of both falloffs; None where a light cannot express it."""
        power = self.power + other.power
        return None if power > 2 or (self.smooth and other.smooth) else Falloff(power, self.smooth + other.smooth)


@dataclass
class Emission:
    """What the nodes of a material or light emit."""

    emits: bool = False
    plain: bool = False  # all of it is one white Emission node of strength 1
    varies: bool = False  # some node may give different values from place to place
    directional: set[str] = field(default_factory=set)  # labels of nodes
    of_camera: set[str] = field(default_factory=set)  # labels of nodes
    of_path: set[str] = field(default_factory=set)  # outputs of Light Path nodes, except CAMERA_RAY
    is_placed: bool = False  # see PLACED: it must be rendered where it stands
    by_place: bool = False  # see BY_PLACE
    by_uv: bool = False  # see BY_UV
    falloff: Falloff | None = Falloff()  # it scales all of the emission; None: no common factor does


def emission_of(data) -> Emission:
    """What the nodes of a material or light emit."""
    emission, surface, values = Emission(), graph.surface_of(data), []
    leaves = [] if surface is None else graph.shaders_behind(surface).leaves
    if len(leaves) == 1 and leaves[0].terms == ((),) and leaves[0].node.bl_idname == EMISSION:
        color, strength = (graph.value_of(socket) for socket in emission_sockets(leaves[0].node))
        emission.plain = strength == 1.0 and not graph.is_socket(color) and color[:3] == (1.0, 1.0, 1.0)
    for leaf in leaves:
        if not emits(leaf.node):
            continue
        emission.emits = True
        alpha = (leaf.node.inputs["Alpha"],) if "Alpha" in leaf.node.inputs else ()
        values += [graph.source_of(value, leaf.groups) for value in (*emission_sockets(leaf.node), *alpha)]
        values += [factor.source for term in leaf.terms for factor in term]
    for source in _sources_behind(values):
        _note_value(source, emission)
    falloffs = {_falloff_of(leaf) for leaf in leaves if emits(leaf.node)}
    if falloffs:
        emission.falloff = falloffs.pop() if len(falloffs) == 1 else None
    return emission


def _falloff_of(leaf) -> Falloff | None:
    """The falloff that scales the emission of one shader node; None where falloff is not a factor of it."""
    others = [factor.source for term in leaf.terms for factor in term]
    if "Alpha" in leaf.node.inputs:
        others.append(graph.source_of(leaf.node.inputs["Alpha"], leaf.groups))
    if any(_has_falloff(source) for source in others):
        return None
    factors = factors_of(leaf.source)
    return None if factors is None else factors[1]


def factors_of(source: graph.Source) -> tuple[list[tuple], Falloff] | None:
    """The factors of what the node of `source` emits: input sockets that do not depend on the distance, each as
    (socket, groups around it), and the falloff. None where falloff is not a factor."""
    both = [_factors(socket, source.groups) for socket in emission_sockets(source.node)]
    return _joined(both)


def _joined(products) -> tuple[list[tuple], Falloff] | None:
    if any(one is None for one in products):
        return None
    falloff = Falloff()
    for _, other in products:
        falloff = None if falloff is None else falloff.times(other)
    return None if falloff is None else ([entry for entries, _ in products for entry in entries], falloff)


def _factors(socket, groups) -> tuple[list[tuple], Falloff] | None:
    """As `factors_of` for an input socket."""
    source = graph.source_of(socket, groups)
    if not _has_falloff(source):
        return [(socket, groups)], Falloff()
    node, groups, kinds = source.node, source.groups, {socket.type, *source.passed}
    if kinds - {"VALUE", "RGBA", "VECTOR"}:
        return None  # whole numbers
    if node.bl_idname != LIGHT_FALLOFF:
        entries = _multiplied(node, "VALUE" in kinds)
        return None if entries is None else _joined([_factors(entry, groups) for entry in entries])
    smooth = value_at(node.inputs["Smooth"], groups)
    if smooth is None or not smooth.is_constant or source.socket.name not in POWERS:
        return None
    node_falloff = [], Falloff(POWERS[source.socket.name], max(float(smooth.offset[0]), 0.0))
    return _joined([node_falloff, _factors(node.inputs["Strength"], groups)])


def _multiplied(node, as_number: bool):
    """The input sockets whose product `node` gives; None if it gives no product.

    `as_number`: the product goes to a number socket, which would convert a color.
    """
    kind = node.bl_idname
    if kind == "ShaderNodeMath":
        return node.inputs[:2] if node.operation == "MULTIPLY" and not node.use_clamp else None
    if as_number:
        return None
    if kind == "ShaderNodeVectorMath":
        return {"MULTIPLY": node.inputs[:2], "SCALE": [node.inputs["Vector"], node.inputs["Scale"]]}.get(node.operation)
    if kind == "ShaderNodeMix" and node.data_type == "RGBA":
        entries, is_clamped = node.inputs[6:8], node.clamp_result
    elif kind == "ShaderNodeMixRGB":
        entries, is_clamped = node.inputs[1:3], node.use_clamp
    else:
        return None
    return (
        entries if node.blend_type == "MULTIPLY" and not is_clamped and graph.value_of(node.inputs[0]) == 1.0 else None
    )


def _has_falloff(source: graph.Source | None) -> bool:
    """True if a Light Falloff node is among the nodes behind `source`."""
    return any(one.node.bl_idname == LIGHT_FALLOFF for one in _sources_behind([source]))


def _sources_behind(sources: list) -> list[graph.Source]:
    """All that the values of `sources` depend on, themselves included, each once."""
    behind, waiting = {}, list(sources)
    while waiting:
        source = waiting.pop()
        if source is None or source.node is None:
            continue
        key = source.node, source.socket.identifier, source.groups
        if key not in behind:
            behind[key] = source
            waiting += [graph.source_of(entry, source.groups) for entry in source.node.inputs]
    return list(behind.values())


@contextmanager
def without_falloff(blocks):
    """Within this context the Light Falloff nodes of materials and lights give their Strength at any distance."""
    with graph.TreeChanges() as changes:
        for node in [node for tree in trees_of(blocks) for node in tree.nodes if node.bl_idname == LIGHT_FALLOFF]:
            changes.relink(node.inputs["Smooth"])
            changes.set(node.inputs["Smooth"], "default_value", 0.0)
            for target in [link.to_socket for output in node.outputs for link in output.links]:
                changes.relink(target, node.outputs["Quadratic"])
        yield


def trees_of(blocks) -> list:
    """The node trees of materials, lights and worlds, and of the groups in them."""
    trees, waiting = [], [graph.tree_in_use(block) for block in blocks if block is not None]
    while waiting:
        tree = waiting.pop()
        if tree is not None and tree not in trees:
            trees.append(tree)
            waiting += [node.node_tree for node in tree.nodes if graph.is_group(node)]
    return trees


# PARTS: types of the settings inside a node, beside its sockets. UNSEEN: properties of nodes that change no value.
PARTS = (
    *(bpy.types.ImageUser, bpy.types.TexMapping, bpy.types.ColorMapping),
    *(bpy.types.ColorRamp, bpy.types.ColorRampElement),
    *(bpy.types.CurveMapping, bpy.types.CurveMap, bpy.types.CurveMapPoint),
)
UNSEEN = (
    *("rna_type", "inputs", "outputs", "location", "location_absolute", "width", "height", "dimensions", "select"),
    *("show_options", "show_preview", "show_texture", "hide"),
)


def nodes_as_text(data) -> str:
    """The node trees of a material or light as text, which differs wherever their values may differ."""
    lines = []
    for tree in trees_of([data]):
        for node in tree.nodes:
            sockets = [_value(getattr(socket, "default_value", None)) for socket in (*node.inputs, *node.outputs)]
            lines.append(f"{node.name!r}{sockets}{values_as_text(node, UNSEEN)}")
        for link in tree.links:
            ends = link.from_node.name, link.from_socket.identifier, link.to_node.name, link.to_socket.identifier
            lines.append(f"{ends}{link.is_muted}")
    return "\n".join(lines)


def values_as_text(block, unseen: tuple = ("rna_type",)) -> list[str]:
    """Name and value of the properties of `block`, without those of the names `unseen`."""
    names = (prop.identifier for prop in block.bl_rna.properties)
    return [f"{name}: {_value(getattr(block, name))}" for name in names if name not in unseen and name[:3] != "bl_"]


def _value(value):
    if isinstance(value, bpy.types.bpy_prop_array | Vector | Euler | Color):
        return tuple(value)
    if isinstance(value, bpy.types.bpy_prop_collection):
        return [values_as_text(one) for one in value if isinstance(one, PARTS)]
    if isinstance(value, PARTS):
        return values_as_text(value)
    if isinstance(value, set):
        return sorted(value)
    if isinstance(value, bpy.types.Text):
        return value.as_string()
    if isinstance(value, bpy.types.Object):
        return value.name_full, *map(tuple, value.matrix_world)
    if isinstance(value, bpy.types.bpy_struct):
        return value.name_full if isinstance(value, bpy.types.ID) else ""
    return value


def _note_value(source: graph.Source, emission: Emission) -> None:
    """Note in `emission` what the value of `source` depends on by itself."""
    node, kind, output = source.node, source.node.bl_idname, source.socket.name
    vector = node.inputs.get("Vector") if kind.startswith("ShaderNodeTex") else None
    is_free = vector is not None and vector.enabled and not vector.is_linked
    if _is_among(source, DIRECTIONAL) and (kind != IES or is_free):
        emission.directional.add(node.bl_label)
    if _is_among(source, OF_CAMERA):
        emission.of_camera.add(node.bl_label)
    if kind == LIGHT_PATH and output != CAMERA_RAY:
        emission.of_path.add(output)
    emission.is_placed |= _is_among(source, PLACED) or (
        output == "Object" and getattr(node, "object", None) is not None
    )
    emission.by_place |= _is_among(source, BY_PLACE) or (is_free and kind != IES)
    emission.by_uv |= _is_among(source, BY_UV) or (is_free and kind == "ShaderNodeTexImage")
    emission.varies |= kind not in CONSTANT_NODES


def camera_outputs(node) -> set[str]:
    """The names of the linked outputs of a `node` that depend on the camera of the picture."""
    outputs = OF_CAMERA.get(node.bl_idname)
    linked = {output.name for output in node.outputs if output.is_linked}
    return set() if outputs is None else {name for name in linked if not outputs or name in outputs}


def _is_among(source: graph.Source, kinds: dict[str, tuple]) -> bool:
    outputs = kinds.get(source.node.bl_idname)
    return outputs is not None and (not outputs or source.socket.name in outputs)


def emission_warnings(emission: Emission, is_light: bool, is_flat: bool = True) -> list[str]:
    """Warnings about emission that is not shaded as in Cycles: that of a light (`is_light`) or of a material. With
    `is_flat` also about a dependence on the direction."""
    warnings, shown = [], f"shaded as from a camera right before it; {COMPARE_TELLS}"
    if is_flat and emission.directional:
        nodes = ", ".join(sorted(emission.directional))
        warnings.append(f"its emission depends on the direction ({nodes}), shaded as seen head-on; {COMPARE_TELLS}")
    if emission.of_camera:
        nodes = ", ".join(sorted(emission.of_camera))
        warnings.append(f"its emission depends on the camera ({nodes}), {shown}")
    # Cycles evaluates the nodes of lights without a ray type ("Is ..."), those of materials with several ray types.
    paths = sorted(name for name in emission.of_path if not (is_light and name.startswith("Is ")))
    if paths:
        mixture = "of which Cycles takes a mixture that hangs on how it samples"
        warnings.append(f"its emission depends on {listed(paths, 3)} of a Light Path node, {mixture}, {shown}")
    if emission.falloff is None:
        warnings.append(NO_FACTOR)
    return warnings


@dataclass(frozen=True)
class ObjectFacts:
    """What Object Info nodes say of an object, except for its location."""

    color: tuple[float, ...] = (1.0, 1.0, 1.0, 1.0)
    index: int = 0
    random: float = 0.0

    @classmethod
    def of(cls, ob, instance=None) -> "ObjectFacts":
        """The facts of an object, or of an instance of it."""
        is_made = instance is not None and instance.is_instance
        random = instance.random_id if is_made else _random_id(ob.name)
        return cls(tuple(ob.color), ob.pass_index, random / 0xFFFFFFFF)


def _random_id(name: str) -> int:
    """Cycles' random number for an object (32 bits): the hash lookup3 (B. Jenkins 2006) of a sum over its name."""
    mask, key = 0xFFFFFFFF, 0
    for letter in np.frombuffer(name.encode(), np.int8).tolist():
        key = (37 * key + letter) & mask
    start = 0xDEADBEEF + (2 << 2) + 13
    a, b, c = (start + key) & mask, start, start
    for bits in (14, 11, 25, 16, 4, 14, 24):
        c ^= b
        c = (c - (b << bits | b >> (32 - bits))) & mask
        a, b, c = b, c, a
    return b


@contextmanager
def without_camera_rays(blocks, random: float):
    """Within this context the nodes of materials and lights get 0 for Is Camera Ray and `random` for Object Info's
    Random."""
    values = {LIGHT_PATH: (CAMERA_RAY, 0.0), "ShaderNodeObjectInfo": ("Random", random)}
    with graph.TreeChanges() as changes:
        for tree in trees_of(blocks):
            for node in [node for node in tree.nodes if node.bl_idname in values]:
                name, value = values[node.bl_idname]
                number = changes.add(tree, "ShaderNodeValue").outputs[0]
                number.default_value = value
                for socket in [link.to_socket for link in node.outputs[name].links if not link.is_muted]:
                    changes.relink(socket, number)
        yield


# PIXELS: along each side of a picture.
PIXELS = 256
SAMPLES_PER_PIXEL = 4
# PIXEL_ASPECT: the largest ratio of the sides of a pixel (Blender's own limit is 200).
PIXEL_ASPECT = 100.0
# CLIP: how far from the plane of a rectangle things are seen, as a share of its longer side.
CLIP = 1e-3


class LookTooLong(Exception):
    """A look at the lights took so much of a budget that too little is left for direct light."""


class Studio:
    """A scene with one object and a camera that looks at it; `open_studio` makes one."""

    def __init__(self, scene, camera, base):
        self.scene, self.camera, self.base = scene, camera, base
        self.look_until = np.inf  # processor time

    def check_time(self) -> None:
        """Raises LookTooLong after `look_until`."""
        if time.process_time() > self.look_until:
            raise LookTooLong

    @contextmanager
    def show(self, ob, matrix: np.ndarray, facts: ObjectFacts):
        """Within this context `ob` stands at `matrix` (4, 4), which may be sheared; afterwards `ob` is removed.

        `ob` must not be in another scene.
        """
        self.scene.collection.objects.link(ob)
        ob.parent, ob.matrix_parent_inverse = self.base, Matrix(matrix.tolist())
        ob.color, ob.pass_index = facts.color, facts.index
        try:
            yield
        finally:
            bpy.data.objects.remove(ob)

    def look(
        self, center, half_u, half_v, direction, pixels: int = PIXELS, depth: float = CLIP
    ) -> tuple[np.ndarray, np.ndarray]:
        """Radiance (H, W, 3) that the rectangle center +- half_u +- half_v emits toward `direction`, and a mask (H, W)
        of the pixels where anything was seen.

        Things are seen up to `depth` times the longer side of the rectangle from its plane. Columns run along
        half_u. Row 0 is at +half_v if (half_u, half_v, direction) is right-handed, else at -half_v.
        """
        width, height = 2.0 * np.linalg.norm(half_u), 2.0 * np.linalg.norm(half_v)
        right = 2.0 * half_u / width
        up = np.cross(direction, right)
        distance = max(width, height)
        axes = np.eye(4)
        axes[:3, 0], axes[:3, 1], axes[:3, 2], axes[:3, 3] = right, up, direction, center + distance * direction
        self.camera.matrix_world = Matrix(axes.tolist())
        lens = self.camera.data
        lens.type, lens.ortho_scale = "ORTHO", width
        lens.clip_start, lens.clip_end = max(1.0 - depth, 1e-3) * distance, (1.0 + depth) * distance
        self._fit_pixels(width / height, pixels)
        light = self.picture()
        return light[..., :3], light[..., 3] > 0.5

    def look_around(self, center, axes, angle: float, reach: float, pixels: int) -> np.ndarray:
        """Radiance (pixels, pixels, 3) that arrives at `center` in a square field of view, `angle` rad wide.

        `axes` are (forward, right). Columns run along right; row 0 is at cross(right, forward). Things are seen at
        distances from `reach` / 1000 to `reach`, in m.
        """
        forward, right = axes
        matrix = np.eye(4)
        matrix[:3, :3], matrix[:3, 3] = np.stack([right, np.cross(right, forward), -forward], axis=-1), center
        self.camera.matrix_world = Matrix(matrix.tolist())
        lens, render = self.camera.data, self.scene.render
        lens.type, lens.angle, lens.clip_start, lens.clip_end = "PERSP", angle, 1e-3 * reach, reach
        render.resolution_x = render.resolution_y = pixels
        render.pixel_aspect_x = render.pixel_aspect_y = 1.0
        return self.picture()[..., :3]

    def picture(self) -> np.ndarray:
        """The camera's picture (H, W, 4), RGBA, row 0 on top."""
        with tempfile.TemporaryDirectory(prefix="ltsh-", ignore_cleanup_errors=True) as name:
            path = Path(name) / "look.exr"
            self.scene.render.filepath = str(path)
            bpy.ops.render.render(write_still=True, scene=self.scene.name)
            # In a child started inside Blender the package's own reader of EXR may lack its library.
            image = bpy.data.images.load(str(path))
            try:
                image.colorspace_settings.name, image.alpha_mode = "Non-Color", "CHANNEL_PACKED"
                return image_pixels(image)[::-1].astype(np.float64)
            finally:
                bpy.data.images.remove(image)

    def _fit_pixels(self, ratio: float, pixels: int) -> None:
        """Set resolution and pixel aspect for a rectangle of `ratio` width to height, with up to `pixels` squared."""
        render = self.scene.render
        columns = rows = pixels
        if ratio > PIXEL_ASPECT:
            rows = max(1, round(pixels * PIXEL_ASPECT / ratio))
        elif ratio < 1.0 / PIXEL_ASPECT:
            columns = max(1, round(pixels * PIXEL_ASPECT * ratio))
        render.resolution_x, render.resolution_y = columns, rows
        aspect = ratio * rows / columns
        render.pixel_aspect_x, render.pixel_aspect_y = max(aspect, 1.0), max(1.0 / aspect, 1.0)


@contextmanager
def open_studio(of_scene):
    """A `Studio` at the frame of `of_scene`; its data is removed afterwards."""
    scene = bpy.data.scenes.new("Look at an emitter")
    lens = bpy.data.cameras.new("Look at an emitter")
    camera = bpy.data.objects.new("Look at an emitter", lens)
    base = bpy.data.objects.new("Look at an emitter", None)
    try:
        scene.frame_set(of_scene.frame_current, subframe=of_scene.frame_subframe)
        for ob in (camera, base):
            scene.collection.objects.link(ob)
        scene.camera, scene.world = camera, None
        lens.sensor_fit = "HORIZONTAL"
        render, cycles = scene.render, scene.cycles
        render.engine, render.film_transparent, render.resolution_percentage = "CYCLES", True, 100
        render.use_file_extension = render.use_overwrite = True
        cycles.device, cycles.samples, cycles.max_bounces, cycles.seed = "CPU", SAMPLES_PER_PIXEL, 0, 0
        cycles.use_adaptive_sampling = cycles.use_denoising = False
        cycles.pixel_filter_type = "BOX"
        cycles.sample_clamp_direct = 0.0
        settings = render.image_settings
        if bpy.app.version >= (5, 0, 0):
            settings.media_type = "IMAGE"
        settings.file_format, settings.color_mode, settings.color_depth = "OPEN_EXR", "RGBA", "32"
        settings.exr_codec = "NONE"
        enable_passes(scene.view_layers[0], ("combined",))
        yield Studio(scene, camera, base)
    finally:
        bpy.data.scenes.remove(scene)
        bpy.data.objects.remove(camera)
        bpy.data.objects.remove(base)
        bpy.data.cameras.remove(lens)
