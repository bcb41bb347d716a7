"""Values behind sockets: constants, image textures, and these after simple nodes."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import bpy
import numpy as np
from mathutils import Color

from ...cycles.texels import EXTENSIONS, GRAY, INTERPOLATIONS
from ...imaging.color import blackbody
from ..evaluated import image_pixels
from .graph import Source, source_of

# How Blender converts colors and vectors to numbers.
TO_NUMBER = {"RGBA": GRAY, "VECTOR": np.full(3, 1.0 / 3.0)}
# ROUNDED: by so much the range of an image may exceed a limit: weights of `GRAY` add up to 1 so nearly.
ROUNDED = 1e-6


@dataclass(frozen=True)
class ImageUse:
    """A flat image on a UV map ("": the one active for rendering); `mapping` (2, 3) maps (u, v, 1) to the image."""

    image: Any
    uv_map: str
    mapping: tuple[tuple[float, float, float], tuple[float, float, float]]
    closest: bool
    extension: str  # one of EXTENSIONS
    by_alpha: bool = False  # Cycles multiplies its colors by alpha because the node's Alpha feeds nothing


@dataclass(frozen=True)
class Value:
    """A value: offset + matrix (R, G, B, A) of an image, or only offset without an image."""

    offset: np.ndarray  # (3,)
    matrix: np.ndarray | None = None  # (3, 4)
    image: ImageUse | None = None

    @property
    def is_constant(self) -> bool:
        return self.image is None

    def mapped(self, matrix: np.ndarray, offset=0.0) -> "Value":
        """`matrix` (3, 3) times this value, plus `offset`."""
        image_matrix = None if self.matrix is None else matrix @ self.matrix
        return Value(matrix @ self.offset + offset, image_matrix, self.image)

    def as_number(self, kind: str = "RGBA") -> "Value":
        """What a number socket makes of this color, or of this vector (`kind` VECTOR), in all three components."""
        return self if is_gray(self) else self.mapped(np.broadcast_to(TO_NUMBER[kind], (3, 3)))

    @property
    def range(self) -> tuple[np.ndarray, np.ndarray]:
        """The least and the largest value (3,) that each component may have."""
        if self.is_constant:
            return self.offset, self.offset
        if not _is_from_0_to_1(self.image.image):
            return np.full(3, -np.inf), np.full(3, np.inf)
        return tuple(self.offset + limit(self.matrix, 0.0).sum(axis=1) for limit in (np.minimum, np.maximum))


def is_gray(value: Value) -> bool:
    """True if all three components are always equal."""
    rows = value.offset[:, None] if value.matrix is None else np.column_stack([value.matrix, value.offset])
    return bool(np.all(rows == rows[:1]))


def _is_from_0_to_1(image) -> bool:
    """True if all values that Cycles reads from `image` are known to be in [0, 1]."""
    space = image.colorspace_settings
    # Cycles may divide colors by alpha if they are stored as products with it.
    return not image.is_float and space.name in BYTE_SPACES and (space.is_data or image.alpha_mode != "PREMUL")


def constant(number) -> Value:
    """The value of a number, or of the first three components of a color."""
    return Value(np.array(np.broadcast_to(np.ravel(number)[:3], (3,)), np.float64))


@dataclass(frozen=True)
class Curved:
    """A number that is a piecewise linear, monotonic function of the gray `value`: `numbers` at `places`.

    Before the first and behind the last place it stays what it is there.
    """

    value: Value
    places: tuple[float, ...]
    numbers: tuple[float, ...]

    @property
    def is_constant(self) -> bool:
        return False

    def mapped(self, factor: float, offset: float) -> "Curved":
        """`factor` times this number, plus `offset`."""
        return Curved(self.value, self.places, tuple(factor * number + offset for number in self.numbers))

    def limited(self, low: float, high: float) -> "Curved":
        """This number, limited to [low, high]."""
        places, numbers = np.array(self.places), np.array(self.numbers)
        for level in (low, high):
            # Where a piece crosses the level it gets a bend.
            off = numbers - level
            (piece,) = np.nonzero(off[:-1] * off[1:] < 0.0)
            share = off[piece] / (off[piece] - off[piece + 1])
            bends = places[piece] + share * (places[piece + 1] - places[piece])
            places, numbers = np.insert(places, piece + 1, bends), np.insert(numbers, piece + 1, level)
        return Curved(self.value, tuple(places.tolist()), tuple(np.clip(numbers, low, high).tolist()))


def limited(value: Value | Curved | None, low: float = 0.0, high: float = 1.0) -> Value | Curved | None:
    """`value` limited to [low, high], as by Clamp; None if it is unknown or cannot be expressed."""
    if value is None or isinstance(value, Curved):
        return None if value is None else value.limited(low, high)
    if value.is_constant or low > high:
        return constant(np.clip(value.offset, low, high))
    least, most = value.range
    if np.all(least >= low - ROUNDED) and np.all(most <= high + ROUNDED):
        return value
    if not is_gray(value):
        return None
    return Curved(value, (low, high), (low, high)) if low < high else constant(low)


def combined(first, second, first_share, second_share) -> Value | Curved | None:
    """first_share * first + second_share * second; None if one is unknown or the sum cannot be expressed.

    Both may be images if they are the same one. A `Curved` needs a constant beside it.
    """
    if first is None or second is None:
        return None
    if not first.is_constant and not second.is_constant:
        if isinstance(first, Curved) or isinstance(second, Curved) or first.image != second.image:
            return None
        matrix = first_share * first.matrix + second_share * second.matrix
        return Value(first_share * first.offset + second_share * second.offset, matrix, first.image)
    carrier, share, other, other_share = first, first_share, second, second_share
    if first.is_constant:
        carrier, share, other, other_share = second, second_share, first, first_share
    if isinstance(carrier, Curved):
        return carrier.mapped(float(share), float(other_share * other.offset.mean()))
    return carrier.mapped(share * np.eye(3), other_share * other.offset)


def product(first, second) -> Value | Curved | None:
    """The product; None if one is unknown or both vary."""
    if first is None or second is None:
        return None
    if not first.is_constant:
        first, second = second, first
    if not first.is_constant:
        return None
    if isinstance(second, Curved):
        return second.mapped(float(first.offset.mean()), 0.0)
    return second.mapped(np.diag(first.offset))


def value_at(socket, groups: tuple = ()) -> Value | None:
    """The value at the input `socket` inside `groups`, converted to a number for a number socket; None: unknown."""
    value = _any_value_at(socket, groups)
    return value if isinstance(value, Value) else None


def curved_at(socket, groups: tuple = ()) -> Value | Curved | None:
    """As `value_at` for a number socket, but also through limits, a threshold or a color ramp, which apply after the
    image is interpolated."""
    value, source = _any_value_at(socket, groups), source_of(socket, groups)
    is_ramp = source is not None and source.node is not None and source.node.bl_idname == "ShaderNodeValToRGB"
    return _curved_ramp(source) if value is None and is_ramp and set(source.passed) <= {"VALUE"} else value


def _any_value_at(socket, groups: tuple) -> Value | Curved | None:
    source = source_of(socket, groups)
    if source is None:
        return None
    if source.node is None:
        value = constant(source.socket.default_value) if hasattr(source.socket, "default_value") else None
    else:
        reader = READERS.get(source.node.bl_idname)
        value = None if reader is None else reader(source)
    return None if value is None else _arriving(value, source, socket.type)


def _arriving(value: Value | Curved, source: Source, kind: str) -> Value | Curved | None:
    """What arrives of the `value` of `source` at a socket of type `kind`; None if it is converted on the way."""
    if isinstance(value, Curved) or is_gray(value):
        kinds = {*source.passed, kind} - {source.socket.type}
        return value if kinds <= {"VALUE", "RGBA", "VECTOR"} else None
    if not source.arrives_whole(kind):
        return None
    return value.as_number(source.socket.type) if kind == "VALUE" else value


def input_value(source: Source, name) -> Value | None:
    """The value at the input `name` (or position) of the node of `source`."""
    return value_at(source.node.inputs[name], source.groups)


def constant_inputs(source: Source, *names) -> list[np.ndarray] | None:
    """The constants (3,) at the inputs `names` of the node of `source`; None if one of them is not constant."""
    values = [input_value(source, name) for name in names]
    return [value.offset for value in values] if all(value and value.is_constant for value in values) else None


# RAMP_STEPS: between the entries of the table into which Cycles converts a color ramp.
RAMP_STEPS = 256


def _curved_ramp(source: Source) -> Curved | None:
    """The number that a color ramp makes of an image; None if that is unknown or not monotonic."""
    value, ramp = input_value(source, 0), source.node.color_ramp
    if value is None:
        return None
    positions = np.arange(RAMP_STEPS + 1, dtype=np.float32) / np.float32(RAMP_STEPS)
    colors = np.array([ramp.evaluate(float(position)) for position in positions])
    numbers = colors[:, 3] if source.socket.name == "Alpha" else colors[:, :3] @ GRAY
    steps = np.diff(numbers)
    if not ((steps >= 0.0).all() or (steps <= 0.0).all()):
        return None
    if ramp.interpolation == "CONSTANT":
        # Between two entries Cycles takes the lower one.
        below = np.nextafter(positions[1:], np.float32(0.0))
        positions = np.append(positions[0], np.stack([below, positions[1:]], axis=1))
        numbers = np.append(numbers[0], np.stack([numbers[:-1], numbers[1:]], axis=1))
    return Curved(value, tuple(positions.tolist()), tuple(numbers.tolist()))


def _own_value(source: Source) -> Value:
    return constant(source.node.outputs[0].default_value)


def _image(source: Source) -> Value | None:
    node = source.node
    if node.image is None or node.projection != "FLAT" or node.image.source not in ("FILE", "GENERATED"):
        return None
    if node.interpolation not in INTERPOLATIONS or node.extension not in EXTENSIONS or not has_plain_mapping(node):
        return None
    uv_and_mapping = coordinates(source.input("Vector"))
    if uv_and_mapping is None:
        return None
    uv_map, mapping = uv_and_mapping
    is_straight = node.image.alpha_mode == "STRAIGHT" and not node.image.colorspace_settings.is_data
    by_alpha = is_straight and not node.outputs["Alpha"].is_linked
    use = ImageUse(node.image, uv_map, mapping, node.interpolation == "Closest", node.extension, by_alpha)
    matrix = np.zeros((3, 4))
    if source.socket.name == "Alpha":
        matrix[:, 3] = 1.0
    else:
        matrix[:, :3] = np.eye(3)
    return Value(np.zeros(3), matrix, use)


IDENTITY = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0))


def has_plain_mapping(node) -> bool:
    """True if the mapping inside a texture node, which scripts and old files have, changes nothing."""
    mapping = node.texture_mapping
    return (
        not any((*mapping.translation, *mapping.rotation))
        and tuple(mapping.scale) == (1.0, 1.0, 1.0)
        and (mapping.mapping_x, mapping.mapping_y, mapping.mapping_z) == ("X", "Y", "Z")
        and mapping.vector_type == "POINT"
        and not (mapping.use_min or mapping.use_max)
    )


def coordinates(source: Source | None):
    """(UV map, mapping) of a texture's vector, a UV map through any constant Mapping nodes; None for other vectors."""
    if source is None or not source.arrives_whole("VECTOR"):
        return None
    node = source.node
    if node is None:
        # A texture whose vector is not linked takes the UV map that is active for rendering.
        return ("", IDENTITY) if source.socket.hide_value else None
    if node.bl_idname == "ShaderNodeUVMap" and not node.from_instancer:
        return node.uv_map, IDENTITY
    if node.bl_idname == "ShaderNodeTexCoord" and source.socket.name == "UV" and not node.from_instancer:
        return "", IDENTITY
    if node.bl_idname != "ShaderNodeMapping" or node.vector_type not in ("POINT", "TEXTURE"):
        return None
    inner = coordinates(source.input("Vector"))
    parts = constant_inputs(source, "Location", "Rotation", "Scale")
    if inner is None or parts is None or np.any(parts[1][:2] != 0.0):
        return None
    return inner[0], _mapping(node.vector_type, *parts, inner[1])


def _mapping(kind: str, location, rotation, scale, inner):
    """The affine map (2, 3) `inner` followed by that of a Mapping node that stays in the plane."""
    cosine, sine = math.cos(rotation[2]), math.sin(rotation[2])
    turned = [[cosine * scale[0], -sine * scale[1]], [sine * scale[0], cosine * scale[1]]]
    mapping = np.vstack([np.column_stack([turned, location[:2]]), [0.0, 0.0, 1.0]])
    if kind == "TEXTURE":
        mapping = np.linalg.pinv(mapping)
    whole = mapping @ np.vstack([inner, [0.0, 0.0, 1.0]])
    return tuple(tuple(float(number) for number in row) for row in whole[:2])


def _separate(source: Source) -> Value | None:
    if getattr(source.node, "mode", "RGB") != "RGB":
        return None
    value = input_value(source, 0)
    channel = next(index for index, socket in enumerate(source.node.outputs) if socket == source.socket)
    pick = np.zeros((3, 3))
    pick[:, channel] = 1.0
    return None if value is None else value.mapped(pick)


def _combine(source: Source) -> Value | None:
    if getattr(source.node, "mode", "RGB") != "RGB":
        return None
    components = constant_inputs(source, 0, 1, 2)
    return None if components is None else constant([component[0] for component in components])


def _to_number(source: Source) -> Value | None:
    value = input_value(source, 0)
    return None if value is None else value.as_number()


def _power(base, exponent):
    # Cycles gives 0 where the power is not a real number.
    is_known = (base >= 0.0) | (exponent == np.trunc(exponent))
    with np.errstate(divide="ignore", over="ignore"):
        return np.power(np.where(is_known, base, 0.0), np.where(is_known, exponent, 1.0))


MATH: dict[str, Callable] = {
    "POWER": _power,
    "MINIMUM": np.minimum,
    "MAXIMUM": np.maximum,
    "DIVIDE": lambda a, b: np.divide(a, b, out=np.zeros(3), where=b != 0.0),
    "SQRT": lambda a, b: np.sqrt(np.maximum(a, 0.0)),
    "ABSOLUTE": lambda a, b: np.abs(a),
    "GREATER_THAN": lambda a, b: (a > b).astype(float),
    "LESS_THAN": lambda a, b: (a < b).astype(float),
}


def _math(source: Source) -> Value | Curved | None:
    node = source.node
    first, second, third = (curved_at(socket, source.groups) for socket in node.inputs)
    if node.operation == "MULTIPLY_ADD":
        result = combined(product(first, second), third, 1.0, 1.0)
    else:
        result = _math_of(node.operation, first, second)
    return limited(result) if node.use_clamp else result


def _math_of(operation: str, first, second) -> Value | Curved | None:
    if operation in ("ADD", "SUBTRACT"):
        return combined(first, second, 1.0, 1.0 if operation == "ADD" else -1.0)
    if operation == "MULTIPLY":
        return product(first, second)
    if first is None or second is None or not second.is_constant:
        return None
    if operation == "DIVIDE" and np.all(second.offset != 0.0):
        return product(first, constant(1.0 / second.offset))
    if first.is_constant:
        return _if_finite(MATH[operation](first.offset, second.offset)) if operation in MATH else None
    return _cut(operation, first, float(second.offset[0])) if isinstance(first, Value) else None


def _if_finite(numbers) -> Value | None:
    return constant(numbers) if np.all(np.isfinite(numbers)) else None


def _cut(operation: str, value: Value, threshold: float) -> Curved | None:
    """The `value` of an image, above or below a threshold; None for other operations."""
    threshold = np.float32(threshold)
    if operation == "GREATER_THAN":
        return Curved(value, (float(threshold), float(np.nextafter(threshold, np.float32(np.inf)))), (0.0, 1.0))
    if operation == "LESS_THAN":
        return Curved(value, (float(np.nextafter(threshold, np.float32(-np.inf))), float(threshold)), (1.0, 0.0))
    return None


def _ends(node) -> tuple[int, ...]:
    """Positions of what Mix and MixRGB mix; () for other types."""
    return (1, 2) if node.bl_idname == "ShaderNodeMixRGB" else {"FLOAT": (2, 3), "RGBA": (6, 7)}.get(node.data_type, ())


def _mix(source: Source) -> Value | Curved | None:
    """Mix and MixRGB by a constant factor."""
    node, ends = source.node, _ends(source.node)
    if not ends:
        return None
    is_number = node.inputs[ends[0]].type == "VALUE"
    first, second = ((curved_at if is_number else value_at)(node.inputs[number], source.groups) for number in ends)
    shares = constant_inputs(source, 0)
    if shares is None:
        return None
    share = float(shares[0][0])
    if getattr(node, "clamp_factor", True):
        share = min(max(share, 0.0), 1.0)
    result = _blended("MIX" if is_number else node.blend_type, first, second, share)
    is_limited = not is_number and (node.use_clamp if node.bl_idname == "ShaderNodeMixRGB" else node.clamp_result)
    return limited(result) if is_limited else result


def _blended(blend: str, first, second, share: float) -> Value | Curved | None:
    if blend == "MIX":
        return combined(first, second, 1.0 - share, share)
    if blend in ("ADD", "SUBTRACT"):
        return combined(first, second, 1.0, share if blend == "ADD" else -share)
    if blend == "MULTIPLY":
        return combined(first, product(first, second), 1.0 - share, share)
    return None


def _invert(source: Source) -> Value | None:
    shares, value = constant_inputs(source, 0), input_value(source, 1)
    if shares is None or value is None:
        return None
    factor = float(shares[0][0])
    return value.mapped((1.0 - 2.0 * factor) * np.eye(3), factor)


def _gamma(source: Source) -> Value | None:
    power, both = constant_inputs(source, 1), constant_inputs(source, 0, 1)
    if both is None:
        return input_value(source, 0) if power is not None and np.all(power[0] == 1.0) else None
    color, gamma = both[0], both[1][0]
    is_raised = color > 0.0  # Cycles leaves other components as they are
    if gamma == 0.0 and not is_raised.all():
        return None  # versions of Blender differ
    with np.errstate(over="ignore"):
        return _if_finite(np.where(is_raised, np.power(np.where(is_raised, color, 1.0), gamma), color))


def _ramp(source: Source) -> Value | None:
    factor, ramp = constant_inputs(source, 0), source.node.color_ramp
    if factor is None:
        return None
    position = min(max(float(factor[0][0]), 0.0), 1.0)
    color = np.array(ramp.evaluate(position))
    if bpy.app.version < (5, 0, 0):
        # Later versions do not take constants from the table.
        entry = int(RAMP_STEPS * position)
        share = 0.0 if ramp.interpolation == "CONSTANT" else RAMP_STEPS * position - entry
        color, after = (np.array(ramp.evaluate(min(number / RAMP_STEPS, 1.0))) for number in (entry, entry + 1))
        color = (1.0 - share) * color + share * after
    return constant(color[3]) if source.socket.name == "Alpha" else constant(color)


def _clamp(source: Source) -> Value | Curved | None:
    limits = constant_inputs(source, 1, 2)
    if limits is None:
        return None
    low, high = (float(limit[0]) for limit in limits)
    if source.node.clamp_type == "RANGE" and low > high:
        low, high = high, low
    return limited(curved_at(source.node.inputs[0], source.groups), low, high)


READERS: dict[str, Callable[[Source], Value | Curved | None]] = {
    "ShaderNodeValue": _own_value,
    "ShaderNodeRGB": _own_value,
    "ShaderNodeTexImage": _image,
    "ShaderNodeSeparateColor": _separate,
    "ShaderNodeSeparateXYZ": _separate,
    "ShaderNodeCombineColor": _combine,
    "ShaderNodeCombineXYZ": _combine,
    "ShaderNodeRGBToBW": _to_number,
    "ShaderNodeMath": _math,
    "ShaderNodeMix": _mix,
    "ShaderNodeMixRGB": _mix,
    "ShaderNodeInvert": _invert,
    "ShaderNodeGamma": _gamma,
    "ShaderNodeValToRGB": _ramp,
    "ShaderNodeClamp": _clamp,
}

# EVENLY: what a number between 0 and 1 may be of which nothing else is known, each as often.
EVENLY = np.linspace(0.0, 1.0, 17)
# TWO_COLORS: nodes of patterns with two colors. OF_FILES: textures that are not patterns.
TWO_COLORS = ("ShaderNodeTexChecker", "ShaderNodeTexBrick")
OF_FILES = ("ShaderNodeTexImage", "ShaderNodeTexEnvironment", "ShaderNodeTexSky", "ShaderNodeTexIES")


def colors_at(socket, groups: tuple = ()) -> np.ndarray | None:
    """Colors (K, 3) that a socket may have, about each as often as the others, from what its nodes mix; None: unknown.

    Patterns are taken to have all numbers from 0 to 1 equally often, and two colors half of their area each.
    """
    value, source = value_at(socket, groups), source_of(socket, groups)
    if value is not None and value.is_constant:
        return value.offset[None]
    if source is None or source.node is None:
        return None
    node = source.node
    if node.bl_idname == "ShaderNodeValToRGB":
        factors = colors_at(node.inputs[0], source.groups)
        positions = EVENLY if factors is None else factors @ GRAY
        return np.array([node.color_ramp.evaluate(float(position))[:3] for position in positions], np.float64)
    if node.bl_idname == "ShaderNodeBlackbody":
        temperatures = colors_at(node.inputs[0], source.groups)
        if temperatures is None:
            return None
        colors = [Color(blackbody(one)) for one in temperatures @ GRAY]
        return np.array([color.from_rec709_linear_to_scene_linear() for color in colors])
    if node.bl_idname in TWO_COLORS:
        both = [colors_at(node.inputs[name], source.groups) for name in ("Color1", "Color2")]
        return None if any(one is None for one in both) else _mixed(*both, np.array([0.0, 1.0]))
    ends = _ends(node) if READERS.get(node.bl_idname) is _mix and node.blend_type == "MIX" else ()
    if ends and node.inputs[ends[0]].type == "RGBA":
        both = [colors_at(node.inputs[number], source.groups) for number in ends]
        factors = colors_at(node.inputs[0], source.groups)
        factors = EVENLY if factors is None else np.clip(factors @ GRAY, 0.0, 1.0)
        return None if any(one is None for one in both) else _mixed(*both, factors)
    is_pattern = node.bl_idname.startswith("ShaderNodeTex") and hasattr(node, "texture_mapping")
    return np.outer(EVENLY, np.ones(3)) if is_pattern and node.bl_idname not in OF_FILES else None


def _mixed(first: np.ndarray, second: np.ndarray, factors: np.ndarray) -> np.ndarray:
    """Mixes of any color of the `first` (K, 3) and any of the `second` (L, 3); of many only the means are mixed."""
    if len(first) * len(second) > len(EVENLY):
        first, second = (one.mean(axis=0, keepdims=True) for one in (first, second))
    share = factors[:, None, None, None]
    return ((1.0 - share) * first[:, None] + share * second).reshape(-1, 3)


# Color space of the image -> whether its values are sRGB. Only Cycles can decode other spaces, and floats in sRGB.
BYTE_SPACES = {"sRGB": True, "Non-Color": False, "Linear Rec.709": False}
FLOAT_SPACES = {"Non-Color": False, "Linear Rec.709": False}
# MOST_PIXELS: of an image that is read; Blender returns four floats per pixel, half a gigabyte for so many.
MOST_PIXELS = 1 << 25


def is_srgb(image) -> bool | None:
    """Whether an image has sRGB values; None if it has no pixels, too many, or a space that only Cycles can decode."""
    if not 0 < image.size[0] * image.size[1] <= MOST_PIXELS:
        return None
    return (FLOAT_SPACES if image.is_float else BYTE_SPACES).get(image.colorspace_settings.name)


def opaque_pixels(image) -> np.ndarray | None:
    """Pixels (H, W, 3) float32, row 0 at the bottom; None if not all are opaque."""
    pixels = image_pixels(image)
    return pixels[..., :3] if (pixels[..., 3] == 1.0).all() else None
