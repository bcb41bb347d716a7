"""Materials under construction, a ball on a floor under two lights, and errors against Cycles there."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import scene_parts

from ltsh_addon.cycles import gbuffer
from ltsh_addon.imaging import unbiased_relative_error
from ltsh_addon.shading import shade

SIZE = (24, 16)
# Techniques are judged where the surface is not seen at a grazing angle.
STEEP_COSINE = 0.2


class Build:
    """A material under construction: shaders are sockets, factors are numbers or sockets."""

    def __init__(self, name="Mix", is_linked=False):
        self.material, self.tree, self.output = scene_parts.new_material(name)
        self.is_linked = is_linked  # factors come from Value nodes
        self.inside = []  # trees of groups under construction

    def new(self, kind, **inputs):
        return scene_parts.add_node(self.inside[-1] if self.inside else self.tree, kind, **inputs)

    def link(self, source, target):
        source.id_data.links.new(source, target)

    def shader(self, kind, **inputs):
        return self.new(f"ShaderNode{kind}", **inputs).outputs[0]

    def leaf(self, red, kind="BsdfDiffuse"):
        return self.shader(kind, Color=(red, 0.5, 0.5, 1.0))

    def clear(self):
        return self.shader("BsdfTransparent")

    def value(self, number):
        socket = self.new("ShaderNodeValue").outputs[0]
        socket.default_value = number
        return socket

    def texture_u(self):
        """u of the UV map."""
        separate = self.new("ShaderNodeSeparateXYZ")
        self.link(self.new("ShaderNodeTexCoord").outputs["UV"], separate.inputs[0])
        return separate.outputs[0]

    def product(self, first, second):
        """A socket times a number."""
        node = self.new("ShaderNodeMath")
        node.operation, node.inputs[1].default_value = "MULTIPLY", second
        self.link(first, node.inputs[0])
        return node.outputs[0]

    def mix(self, factor, first, second):
        node = self.new("ShaderNodeMixShader")
        if isinstance(factor, float) and self.is_linked:
            factor = self.value(factor)
        if isinstance(factor, float):
            node.inputs[0].default_value = factor
        else:
            self.link(factor, node.inputs[0])
        return self._joined(node, first, second)

    def add(self, first, second):
        return self._joined(self.new("ShaderNodeAddShader"), first, second)

    def _joined(self, node, first, second):
        for shader, target in zip((first, second), list(node.inputs)[-2:], strict=True):
            if shader is not None:
                self.link(shader, target)
        return node.outputs[0]

    def group(self, fill, inputs=(), kind="ShaderNodeGroup", times=1):
        """Outputs of group nodes whose tree `fill(inputs inside)` returns the shader of."""
        types = {"SHADER": "Shader", "VALUE": "Float"}
        sockets = {f"In {number}": types[socket.type] for number, socket in enumerate(inputs)}
        tree, entry, end = scene_parts.new_group(sockets, {"Out": "Shader"})
        self.inside.append(tree)
        self.link(fill(*list(entry.outputs)[: len(inputs)]), end.inputs[0])
        self.inside.pop()
        nodes = [self.new(kind) for _ in range(times)]
        for node in nodes:
            node.node_tree = tree
            for shader, target in zip(inputs, node.inputs, strict=False):
                self.link(shader, target)
        return [node.outputs[0] for node in nodes]

    def show(self, shader):
        """Link the shader to the output; the material."""
        self.link(shader, self.output.inputs["Surface"])
        return self.material


def build(material):
    """A floor and a ball of `material`, a large light behind them and a round one above."""
    scene_parts.add_camera((0.0, -3.2, 1.8), (1.1, 0.0, 0.0))
    scene_parts.add_area_light("Key", location=(0.2, 2.2, 1.3), rotation=(-1.2, 0.2, 0.0), size=2.0, size_y=1.2)
    scene_parts.add_area_light("Top", (-0.8, -0.4, 2.2), (0.1, -0.2, 0.0), shape="DISK", size=0.8, energy=30.0)
    scene_parts.add_plane(material, size=12.0)
    scene_parts.add_sphere(material, radius=0.6, location=(0.3, 0.2, 0.6))


def seen_from_above(folder: Path, *materials):
    """(samples, pixel, warnings) of planes of 6 m, one of each material, that fill the picture."""
    scene_parts.add_top_camera()
    scene_parts.add_area_light()
    for material in materials:
        scene_parts.add_plane(material)
    prepared = scene_parts.prepare()
    ((samples, pixel, unusable),), _ = scene_parts.sample(folder, prepared)
    assert unusable == 0 and np.array_equal(np.unique(pixel), np.arange(SIZE[0] * SIZE[1]))
    return samples, pixel, prepared[3]


def prepared_scene(make):
    """An empty scene with the material that `make()` returns, prepared as the child does it."""
    scene_parts.empty_scene(*SIZE)
    build(make())
    return scene_parts.prepare()


def errors(folder: Path, prepared, cycles_samples: int, techniques=("reference", "ltsh4", "ltc")):
    """(pass, technique) -> squared error against Cycles beyond the noise of Cycles: all pixels, and steep ones."""
    ((samples, pixel, unusable),), _ = scene_parts.sample(folder, prepared)
    assert unusable == 0
    samples, film = gbuffer.join([(samples, pixel)], *SIZE)
    halves = scene_parts.reference(folder, prepared, cycles_samples)
    cosine = np.sum(samples.view * samples.normal, axis=-1)
    grazing = film.image(cosine < STEEP_COSINE) > 0.0
    hit = film.coverage() > 0.0
    found = {}
    for technique in techniques:
        shaded = shade(samples, prepared[2].lights, technique, workers=1)
        for name in ("specular", "diffuse"):
            image = film.image(getattr(shaded, name).sum(axis=0))
            squared = [unbiased_relative_error(image, *halves[name], mask)[1] for mask in (hit, hit & ~grazing)]
            found[name, technique] = squared
    return found
