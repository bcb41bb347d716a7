"""What the readers of values say of nodes is what Cycles makes of them; else they say that they do not know."""

import bpy
import numpy as np
import pytest
import scene_parts

from ltsh_addon.blender.materials.graph import constant_of
from ltsh_addon.blender.materials.values import Curved, Value, curved_at, limited, value_at

# Numbers pass through float32, and weights of gray differ by 4e-5 between versions of Blender; quotients enlarge both.
ROUNDED = 1e-3
NUMBERS = (-1.5, -0.5, 0.0, 0.25, 0.5, 0.8, 1.0, 1.6, 2.5)
COLUMNS = 32
# Properties of nodes, and the values that the readers may know.
CHOICES = {
    "Math": {
        "operation": ("ADD", "SUBTRACT", "MULTIPLY", "DIVIDE", "GREATER_THAN", "LESS_THAN", "MULTIPLY_ADD", "POWER",
                      "MINIMUM", "MAXIMUM", "SQRT", "ABSOLUTE"),
        "use_clamp": (False, True),
    },
    "Mix": {
        "data_type": ("RGBA", "FLOAT", "VECTOR"),
        "factor_mode": ("UNIFORM", "NON_UNIFORM"),
        "blend_type": ("MIX", "ADD", "SUBTRACT", "MULTIPLY"),
        "clamp_factor": (False, True),
        "clamp_result": (False, True),
    },
    "MixRGB": {"blend_type": ("MIX", "ADD", "SUBTRACT", "MULTIPLY"), "use_clamp": (False, True)},
    "Clamp": {"clamp_type": ("MINMAX", "RANGE")},
    "SeparateColor": {"mode": ("RGB", "HSV")},
    "CombineColor": {"mode": ("RGB", "HSL")},
    "ValToRGB": {},
    **{name: {} for name in ("SeparateXYZ", "CombineXYZ", "RGBToBW", "Invert", "Gamma", "Value", "RGB")},
}  # fmt: skip
# Nodes without a reader; what they feed must be unknown.
UNREAD = ("MapRange", "BrightContrast", "HueSaturation", "RGBCurve", "VectorMath")
RAMPS = ("LINEAR", "CONSTANT", "EASE", "B_SPLINE", "CARDINAL")
# Color, is it float, its space and its alpha mode.
IMAGES = (
    ((0.8, 0.4, 0.2, 1.0), False, "Non-Color", "STRAIGHT"),
    ((0.8, 0.6, 0.4, 0.6), False, "Non-Color", "STRAIGHT"),
    ((1.0, 0.0, 1.0, 0.2), False, "Linear Rec.709", "STRAIGHT"),
    ((0.2, 0.6, 0.4, 0.4), False, "Non-Color", "PREMUL"),
    ((2.4, -0.4, 0.6, 1.0), True, "Non-Color", "CHANNEL_PACKED"),
)


class Shown:
    """Planes side by side, each of a material that emits what arrives at a socket."""

    def __init__(self, seed=0):
        scene_parts.empty_scene()
        self.rng, self.targets, self.told, self.images = np.random.default_rng(seed), [], [], []
        for number, (color, is_float, space, alpha_mode) in enumerate(IMAGES):
            image = bpy.data.images.new(f"Image {number}", 2, 2, alpha=True, float_buffer=is_float)
            image.colorspace_settings.name = space
            image.pixels.foreach_set(np.tile(np.float32(color), 4))
            image.pack()
            image.alpha_mode = alpha_mode
            self.images.append(image)

    def start(self):
        """The tree of a new material."""
        self.told.append([])
        material, self.tree, self.output = scene_parts.new_material()
        return self.tree

    def show(self, socket, as_number=False):
        """Show the output `socket` of the tree."""
        emission = scene_parts.add_node(self.tree, "ShaderNodeEmission", Color=(0.2, 0.4, 0.6, 1.0))
        self.tree.links.new(emission.outputs[0], self.output.inputs["Surface"])
        target = emission.inputs["Color"]
        if as_number:
            node = scene_parts.add_node(self.tree, "ShaderNodeMath")
            node.operation = "MULTIPLY_ADD"
            for entry, value in zip(node.inputs, (0.35, 1.0, 0.0), strict=True):
                entry.default_value = value
            self.tree.links.new(node.outputs[0], target)
            target = node.inputs[0]
        self.tree.links.new(socket, target)
        self.targets.append((target, as_number))

    def rendered(self, folder):
        """What Cycles shows of each (N, 3)."""
        scene, count = bpy.context.scene, len(self.targets)
        rows = max(-(-count // COLUMNS), 4)
        corners = [(x - COLUMNS / 2, rows / 2 - y, 0.0) for y in range(rows + 1) for x in range(COLUMNS + 1)]
        step = COLUMNS + 1
        first = [y * step + x for y in range(rows) for x in range(COLUMNS)]
        ob = scene_parts.add_mesh("Planes", corners, [(n, n + step, n + step + 1, n + 1) for n in first])
        ob.data.uv_layers.new(name="UVMap")
        for target, _ in self.targets:
            material = next(one for one in bpy.data.materials if one.node_tree == target.id_data)
            ob.data.materials.append(material)
        ob.data.polygons.foreach_set("material_index", np.minimum(np.arange(rows * COLUMNS), count - 1))
        scene_parts.add_top_camera(max(COLUMNS, rows))
        scene.render.resolution_x, scene.render.resolution_y = COLUMNS, rows
        settings = {"max_bounces": 0, "sample_clamp_direct": 0.0, "pixel_filter_type": "BOX"}
        channels = scene_parts.cycles_channels(folder, **settings)
        name = next(name for name in channels if name.endswith("Combined.R"))[:-1]
        return np.stack([channels[name + color] for color in "RGB"], axis=-1).reshape(-1, 3)[:count]

    def read(self):
        """What the readers say of each."""
        return [curved_at(target) if as_number else value_at(target) for target, as_number in self.targets]

    def assert_known_ones_are_right(self, folder):
        """What the readers say, and what Cycles shows."""
        found, expected = self.read(), self.rendered(folder)
        wrong = []
        for value, shown, told in zip(found, expected, self.told, strict=True):
            if value is not None:
                number = evaluated(value)
                if not (np.abs(number - shown) <= ROUNDED * np.maximum(1.0, np.abs(shown))).all():
                    wrong.append((told, number, shown))
        wrong.sort(key=lambda entry: len(entry[0]))
        assert not wrong, f"{len(wrong)} of {len(found)} differ: nodes, what is read, what Cycles shows {wrong[:3]}"
        return found, expected

    # Random nodes:

    def number(self):
        rng = self.rng
        return float(rng.choice(NUMBERS) if rng.random() < 0.5 else np.float32(rng.uniform(-1.0, 2.0)))

    def node(self, name, depth=0, leaf=None, **settings):
        """An output of a node with random inputs, from other nodes up to `depth`, and random properties."""
        rng, told = self.rng, self.told[-1]
        node = self.tree.nodes.new("ShaderNode" + name)
        choices = {key: values[rng.integers(len(values))] for key, values in CHOICES.get(name, {}).items()}
        for key, value in {**choices, **settings}.items():
            setattr(node, key, value)
        if name == "ValToRGB":
            self._set_ramp(node.color_ramp)
        if name in ("Value", "RGB"):
            output = node.outputs[0]
            output.default_value = self.number() if name == "Value" else [*(self.number() for _ in range(3)), 1.0]
        for entry in node.inputs:
            if not entry.enabled or entry.type not in ("VALUE", "RGBA", "VECTOR"):
                continue
            if depth and rng.random() < 0.6:
                self.tree.links.new((leaf or self.any)(depth - 1), entry)
            elif entry.type == "VALUE":
                entry.default_value = self.number()
            else:
                entry.default_value = [self.number() for _ in range(3)] + [1.0] * (entry.type == "RGBA")
        told.append((name, {**choices, **settings}))
        outputs = [output for output in node.outputs if output.enabled]
        return outputs[rng.integers(len(outputs))]

    def _set_ramp(self, ramp):
        ramp.interpolation = RAMPS[self.rng.integers(len(RAMPS))]
        for element, place in zip(ramp.elements, (0.2, 0.7), strict=True):
            element.position, element.color = place, self.rng.uniform(0.0, 1.0, 4)
        self.told[-1].append(ramp.interpolation)

    def image(self, output=None):
        """An output of an image of one color."""
        node = self.tree.nodes.new("ShaderNodeTexImage")
        number = self.rng.integers(len(IMAGES))
        node.image = self.images[number]
        self.told[-1].append(("image", int(number)))
        return node.outputs[output or ("Color", "Alpha")[self.rng.integers(2)]]

    def group(self, source, *kinds):
        """`source` passed through a group with sockets of two types."""
        inner, entry, end = scene_parts.new_group(*({"Through": kind} for kind in kinds))
        inner.links.new(entry.outputs[0], end.inputs[0])
        node = scene_parts.add_group(self.tree, inner)
        if source is not None:
            self.tree.links.new(source, node.inputs[0])
        self.told[-1].append(("group", kinds))
        return node.outputs[0]

    def any(self, depth):
        """An output of random nodes, `depth` behind each other."""
        rng = self.rng
        kind = rng.random()
        if kind < 0.15:
            return self.image()
        if kind < 0.25:
            kinds = ("Float", "Color", "Vector", "Int")
            return self.group(self.any(depth - 1) if depth > 0 else None, *rng.choice(kinds, 2))
        names = (*CHOICES, "Math", "Mix", "Mix") if kind < 0.95 else UNREAD
        output = self.node(names[rng.integers(len(names))], max(depth, 0))
        output.node.mute = rng.random() < 0.05
        return output


def evaluated(value):
    """A value (3,) where its image has one color."""
    offset, curve = value.offset if isinstance(value, Value) else value.value.offset, value
    value = value.value if isinstance(value, Curved) else value
    if value.image is not None:
        color = np.array(IMAGES[int(value.image.image.name[-1])][0])
        color[:3] *= color[3] if value.image.by_alpha else 1.0
        offset = offset + value.matrix @ color
    return np.interp(offset, curve.places, curve.numbers) if isinstance(curve, Curved) else offset


@pytest.mark.parametrize("seed", range(3))
def test_what_is_read_of_random_nodes_is_what_cycles_shows(tmp_path, seed):
    shown = Shown(seed)
    for _ in range(500):
        shown.start()
        shown.show(shown.any(int(shown.rng.integers(3))), bool(shown.rng.integers(2)))
    found, _ = shown.assert_known_ones_are_right(tmp_path)
    assert sum(value is not None for value in found) > 250
    assert sum(value is not None and not value.is_constant for value in found) > 50


@pytest.mark.parametrize("seed", range(2))
def test_images_cut_and_limited_at_random_are_as_in_cycles(tmp_path, seed):
    """Numbers from images pass through up to five thresholds, limits, sums and ramps."""
    shown = Shown(seed)

    def chain(depth):
        if depth < 1:
            return shown.image()
        node = shown.node(("Math", "Math", "Math", "Clamp", "Mix", "ValToRGB")[shown.rng.integers(6)])
        node = node.node
        if node.bl_idname == "ShaderNodeMix":
            node.data_type = "FLOAT"
        entries = [entry for entry in node.inputs if entry.enabled]
        entries = entries[1:] if node.bl_idname == "ShaderNodeMix" else entries[:2]
        entries = entries[:1] if node.bl_idname in ("ShaderNodeClamp", "ShaderNodeValToRGB") else entries
        shown.tree.links.new(chain(depth - 1), entries[shown.rng.integers(len(entries))])
        return next(output for output in node.outputs if output.enabled)

    for _ in range(500):
        shown.start()
        shown.show(chain(int(shown.rng.integers(1, 6))), as_number=True)
    found, _ = shown.assert_known_ones_are_right(tmp_path)
    assert sum(isinstance(value, Curved) for value in found) > 100


def test_all_that_readers_know_of_constants_they_know_in_every_combination(tmp_path):
    shown = Shown()
    unknown = {("Mix", "VECTOR"), ("SeparateColor", "HSV"), ("CombineColor", "HSL")}
    cases = [(name, {}) for name in CHOICES]
    for name, choices in CHOICES.items():
        for key, values in choices.items():
            cases = [(one, {**setting, key: value}) if one == name else (one, setting)
                     for one, setting in cases for value in (values if one == name else (None,))]  # fmt: skip
    for name, settings in cases:
        for _ in range(1 if name == "Mix" else 4):
            shown.start()
            shown.show(shown.node(name, **settings))
    found, _ = shown.assert_known_ones_are_right(tmp_path)
    for value, told in zip(found, shown.told, strict=True):
        name, settings = told[-1]
        is_known = not any((name, choice) in unknown for choice in settings.values())
        # 0 to the power of a negative number has no value, and versions differ in powers of 0.
        assert (value is not None) == is_known or settings.get("operation") == "POWER" or name == "Gamma", told
    assert all(value.is_constant for value in found if value is not None)


def test_nodes_that_are_not_read_are_unknown():
    shown = Shown()
    for name in UNREAD:
        shown.start()
        shown.show(shown.node(name))
    assert shown.read() == [None] * len(UNREAD)


def test_limits_leave_images_alone_that_are_within_them():
    shown = Shown()
    shown.start()
    inside, beyond = (Value(np.zeros(3), np.eye(3, 4), shown.image("Color").node) for _ in range(2))
    for value, image in ((inside, shown.images[0]), (beyond, shown.images[4])):
        value.image.image = image
    assert limited(inside) is inside and limited(beyond) is None
    assert limited(inside.mapped(2.0 * np.eye(3))) is None
    gray = inside.as_number().mapped(2.0 * np.eye(3))
    assert limited(gray) == Curved(gray, (0.0, 1.0), (0.0, 1.0))
    assert limited(Curved(gray, (0.0, 1.0), (-1.0, 3.0))) == Curved(gray, (0.0, 0.25, 0.5, 1.0), (0.0, 0.0, 1.0, 1.0))


def test_a_mapping_inside_of_a_texture_makes_it_unknown():
    shown = Shown()
    shown.start()
    output = shown.image("Color")
    shown.show(output)
    assert shown.read()[0] is not None
    output.node.texture_mapping.scale[0] = 2.0
    assert shown.read() == [None]


def test_a_link_from_a_muted_node_without_input_counts_as_in_cycles(tmp_path):
    """From 5.0 on the socket has its own value; in 4.5 it has 0, which is not read."""
    shown = Shown()
    for is_rerouted in (False, True):
        for name in ("TexImage", "Invert", "MixRGB", "Value", "TexCoord"):
            shown.start()
            node = shown.tree.nodes.new(f"ShaderNode{name}")
            node.mute, output = True, node.outputs[0]
            if is_rerouted:
                reroute = shown.tree.nodes.new("NodeReroute")
                shown.tree.links.new(output, reroute.inputs[0])
                output = reroute.outputs[0]
            shown.show(output)
    found, expected = shown.assert_known_ones_are_right(tmp_path)
    if bpy.app.version >= (5, 0, 0):
        assert np.allclose(expected, (0.2, 0.4, 0.6)) and all(value is not None for value in found)
    assert all(value is not None for value, colors in zip(found, expected, strict=True) if colors[0] > 0.1)


KINDS = ("Float", "Color", "Vector", "Int", "Bool")


def test_values_are_converted_by_groups_as_in_cycles(tmp_path):
    shown = Shown()
    for source in ("RGB", "CombineXYZ", "Value", "image"):
        for first in KINDS:
            for second in KINDS:
                for as_number in (False, True):
                    shown.start()
                    output = shown.image("Color") if source == "image" else shown.node(source)
                    shown.show(shown.group(output, first, second), as_number)
    found, _ = shown.assert_known_ones_are_right(tmp_path)
    own = {"RGB": "Color", "CombineXYZ": "Vector", "Value": "Float", "image": "Color"}
    for value, told, (_, as_number) in zip(found, shown.told, shown.targets, strict=True):
        kinds = own[told[0][0]], *told[1][1]
        if len(set(kinds)) == 1 or (as_number and set(kinds[1:]) == {"Float"}):
            assert value is not None, told
    numbers = [(target, told) for (target, as_number), told in zip(shown.targets, shown.told, strict=True) if as_number]
    for target, told in numbers:
        if told[0][0] == "Value":
            assert (constant_of(target) is None) == bool({"Int", "Bool", "Color", "Vector"} & set(told[1][1])), told
