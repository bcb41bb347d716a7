"""Values behind sockets: constants, image textures, and these after simple nodes."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from ...cycles.images import EXTENSIONS, INTERPOLATIONS
from .graph import Source, source_of

LUMA = np.array([0.2126, 0.7152, 0.0722])  # Rec.709 luminance, by which Blender converts colors to numbers


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

    def mapped(self, matrix: np.ndarray, offset=0.0) -> Value:
        """`matrix` (3, 3) times this value, plus `offset`."""
        image_matrix = None if self.matrix is None else matrix @ self.matrix
        return Value(matrix @ self.offset + offset, image_matrix, self.image)

    def as_number(self) -> Value:
        """The luminance of the color, in all three components."""
        return self.mapped(np.broadcast_to(LUMA, (3, 3)))


def is_gray(value: Value) -> bool:
    """True if all three components are always equal."""
    rows = value.offset[:, None] if value.matrix is None else np.column_stack([value.matrix, value.offset])
    return bool(np.all(rows == rows[:1]))


def constant(number) -> Value:
    """The value of a number, or of the first three components of a color."""
    return Value(np.array(np.broadcast_to(np.ravel(number)[:3], (3,)), np.float64))


def combined(first: Value | None, second: Value | None, first_share, second_share) -> Value | None:
    """first_share * first + second_share * second; None if one is unknown or they have different images."""
    if first is None or second is None:
        return None
    if not first.is_constant and not second.is_constant:
        if first.image != second.image:
            return None
        matrix = first_share * first.matrix + second_share * second.matrix
        return Value(first_share * first.offset + second_share * second.offset, matrix, first.image)
    carrier, share, other, other_share = first, first_share, second, second_share
    if first.is_constant:
        carrier, share, other, other_share = second, second_share, first, first_share
    return carrier.mapped(share * np.eye(3), other_share * other.offset)


def product(first: Value | None, second: Value | None) -> Value | None:
    """The product; None if one is unknown or both have images."""
    if first is None or second is None:
        return None
    if not first.is_constant:
        first, second = second, first
    return second.mapped(np.diag(first.offset)) if first.is_constant else None


def value_at(socket, groups: tuple = ()) -> Value | None:
    """The value at the input `socket` inside `groups`, converted to a number for a number socket; None: unknown."""
    value = value_of_source(source_of(socket, groups))
    if value is not None and socket.type == "VALUE":
        return value if is_gray(value) else value.as_number()
    return value


def value_of_source(source: Source | None) -> Value | None:
    """The value of `source`; None: unknown."""
    if source is None:
        return None
    if source.node is None:
        return constant(source.socket.default_value) if hasattr(source.socket, "default_value") else None
    reader = READERS.get(source.node.bl_idname)
    return None if reader is None else reader(source)


def input_value(source: Source, name) -> Value | None:
    """The value at the input `name` (or position) of the node of `source`."""
    return value_at(source.node.inputs[name], source.groups)


def constant_inputs(source: Source, *names) -> list[np.ndarray] | None:
    """The constants (3,) at the inputs `names` of the node of `source`; None if one of them is not constant."""
    values = [input_value(source, name) for name in names]
    return [value.offset for value in values] if all(value and value.is_constant for value in values) else None


@dataclass(frozen=True)
class Curved:
    """A number that is a piecewise linear, monotonic function of the gray `value`: `numbers` at `places`."""

    value: Value
    places: tuple[float, ...]
    numbers: tuple[float, ...]

    def mapped(self, factor: float, offset: float) -> Curved:
        """`factor` times this number, plus `offset`."""
        return Curved(self.value, self.places, tuple(factor * number + offset for number in self.numbers))


def curved_at(socket, groups: tuple = ()) -> Value | Curved | None:
    """As `value_at`, but also through a threshold or a color ramp, which applies after the image is interpolated."""
    value, source = value_at(socket, groups), source_of(socket, groups)
    if value is not None or source is None or source.node is None:
        return value
    if source.node.bl_idname == "ShaderNodeMath":
        return _curved_math(source)
    return _curved_ramp(source) if source.node.bl_idname == "ShaderNodeValToRGB" else None


def _curved_math(source: Source) -> Curved | None:
    node = source.node
    first, second = (curved_at(node.inputs[number], source.groups) for number in (0, 1))
    if not isinstance(second, Value) or not second.is_constant:
        # A constant comes first, as in 1 - x.
        if isinstance(second, Curved) and isinstance(first, Value) and first.is_constant:
            number = float(first.offset[0])
            found = {"SUBTRACT": (-1.0, number), "ADD": (1.0, number), "MULTIPLY": (number, 0.0)}.get(node.operation)
            return None if found is None else second.mapped(*found)
        return None
    number = float(second.offset[0])
    if isinstance(first, Curved):
        found = {"SUBTRACT": (1.0, -number), "ADD": (1.0, number), "MULTIPLY": (number, 0.0)}.get(node.operation)
        return None if found is None else first.mapped(*found)
    if first is None:
        return None
    number = np.float32(number)
    if node.operation == "GREATER_THAN":
        return Curved(first, (float(number), float(np.nextafter(number, np.float32(np.inf)))), (0.0, 1.0))
    if node.operation == "LESS_THAN":
        return Curved(first, (float(np.nextafter(number, np.float32(-np.inf))), float(number)), (1.0, 0.0))
    return None


# RAMP_ENTRIES: of the table into which Cycles converts a color ramp.
RAMP_ENTRIES = 256


def _curved_ramp(source: Source) -> Curved | None:
    value, ramp = input_value(source, 0), source.node.color_ramp
    if value is None:
        return None
    places = np.arange(RAMP_ENTRIES, dtype=np.float32) / np.float32(RAMP_ENTRIES - 1)
    colors = np.array([ramp.evaluate(float(place)) for place in places])
    numbers = colors[:, 3] if source.socket.name == "Alpha" else colors[:, :3] @ LUMA
    steps = np.diff(numbers)
    if not ((steps >= 0.0).all() or (steps <= 0.0).all()):
        return None
    if ramp.interpolation == "CONSTANT":
        # Between two entries Cycles takes the lower one.
        below = np.nextafter(places[1:], np.float32(0.0))
        places = np.append(places[0], np.stack([below, places[1:]], axis=1))
        numbers = np.append(numbers[0], np.stack([numbers[:-1], numbers[1:]], axis=1))
    return Curved(value, tuple(places.tolist()), tuple(numbers.tolist()))


def _own_value(source: Source) -> Value:
    return constant(source.node.outputs[0].default_value)


def _image(source: Source) -> Value | None:
    node = source.node
    if node.image is None or node.projection != "FLAT" or node.image.source not in ("FILE", "GENERATED"):
        return None
    if node.interpolation not in INTERPOLATIONS or node.extension not in EXTENSIONS:
        return None
    place = coordinates(source.input("Vector"))
    if place is None:
        return None
    uv_map, mapping = place
    by_alpha = node.image.alpha_mode == "STRAIGHT" and not node.outputs["Alpha"].is_linked
    use = ImageUse(node.image, uv_map, mapping, node.interpolation == "Closest", node.extension, by_alpha)
    matrix = np.zeros((3, 4))
    if source.socket.name == "Alpha":
        matrix[:, 3] = 1.0
    else:
        matrix[:, :3] = np.eye(3)
    return Value(np.zeros(3), matrix, use)


IDENTITY = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0))


def coordinates(source: Source | None):
    """(UV map, mapping) of a texture's vector, a UV map through any constant Mapping nodes; None for other vectors."""
    if source is None:
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
    own = np.vstack([np.column_stack([turned, location[:2]]), [0.0, 0.0, 1.0]])
    if kind == "TEXTURE":
        own = np.linalg.pinv(own)
    whole = own @ np.vstack([inner, [0.0, 0.0, 1.0]])
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
    parts = constant_inputs(source, 0, 1, 2)
    return None if parts is None else constant([part[0] for part in parts])


def _to_number(source: Source) -> Value | None:
    value = input_value(source, 0)
    return None if value is None else value.as_number()


MATH: dict[str, Callable] = {
    "POWER": lambda a, b: np.power(np.maximum(a, 0.0), b),
    "MINIMUM": np.minimum,
    "MAXIMUM": np.maximum,
    "DIVIDE": lambda a, b: np.divide(a, b, out=np.zeros(3), where=b != 0.0),
    "SQRT": lambda a, b: np.sqrt(np.maximum(a, 0.0)),
    "ABSOLUTE": lambda a, b: np.abs(a),
    "GREATER_THAN": lambda a, b: (a > b).astype(float),
    "LESS_THAN": lambda a, b: (a < b).astype(float),
}


def _math(source: Source) -> Value | None:
    node, first, second = source.node, input_value(source, 0), input_value(source, 1)
    if node.operation == "MULTIPLY_ADD":
        result = combined(product(first, second), input_value(source, 2), 1.0, 1.0)
    else:
        result = _math_of(node.operation, first, second)
    return _clamped(result) if node.use_clamp else result


def _math_of(operation: str, first: Value | None, second: Value | None) -> Value | None:
    if operation in ("ADD", "SUBTRACT"):
        return combined(first, second, 1.0, 1.0 if operation == "ADD" else -1.0)
    if operation == "MULTIPLY":
        return product(first, second)
    if operation == "DIVIDE" and second is not None and second.is_constant and np.all(second.offset != 0.0):
        return product(first, constant(1.0 / second.offset))
    if operation in MATH and first is not None and second is not None and first.is_constant and second.is_constant:
        return constant(MATH[operation](first.offset, second.offset))
    return None


def _clamped(value: Value | None) -> Value | None:
    return constant(np.clip(value.offset, 0.0, 1.0)) if value is not None and value.is_constant else None


def _mix(source: Source) -> Value | None:
    """Mix and MixRGB by a constant factor."""
    node = source.node
    factor, first, second = 0, 1, 2
    if node.bl_idname == "ShaderNodeMix":
        if node.data_type == "RGBA":
            factor, first, second = 0, 6, 7
        elif node.data_type == "FLOAT":
            factor, first, second = 0, 2, 3
        else:
            return None
    blend = node.blend_type if getattr(node, "data_type", "RGBA") == "RGBA" else "MIX"
    shares, first, second = constant_inputs(source, factor), input_value(source, first), input_value(source, second)
    if shares is None:
        return None
    share = float(shares[0][0])
    if getattr(node, "clamp_factor", True):
        share = min(max(share, 0.0), 1.0)
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
    return constant(np.power(np.maximum(both[0], 0.0), both[1]))


def _ramp(source: Source) -> Value | None:
    factor = constant_inputs(source, 0)
    if factor is None:
        return None
    color = source.node.color_ramp.evaluate(float(factor[0][0]))
    return constant(color[3]) if source.socket.name == "Alpha" else constant(color)


def _clamp(source: Source) -> Value | None:
    parts = constant_inputs(source, 0, 1, 2)
    return None if parts is None else constant(np.clip(*parts))


READERS: dict[str, Callable[[Source], Value | None]] = {
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
    width, height = image.size
    pixels = np.empty(width * height * 4, np.float32)
    image.pixels.foreach_get(pixels)
    pixels = pixels.reshape(height, width, 4)
    return pixels[..., :3] if (pixels[..., 3] == 1.0).all() else None
