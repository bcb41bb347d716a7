"""Mixes, sums and groups of BSDFs become lobes whose weights are those of Cycles."""

import bpy
import material_scenes
import numpy as np
import pytest
import scene_parts
from scene_parts import add_plane, new_material

from ltsh_addon.cycles import gbuffer
from ltsh_addon.cycles.lobes import MAX_LOBES

# Numbers pass through float32 nodes a few times.
EXACT = 2e-6
METAL, GLOSSY, DIFFUSE = (0.9, 0.6, 0.3, 1.0), (0.2, 0.5, 0.8, 1.0), (0.3, 0.6, 0.2, 1.0)


class Shaders:
    """A material under construction."""

    def __init__(self, name="Mix"):
        self.material, self.tree, self.output = new_material(name)

    def node(self, kind, tree=None, **inputs):
        """A node, by default in the material's tree, with GGX distribution."""
        node = (tree or self.tree).nodes.new(f"ShaderNode{kind}")
        if hasattr(node, "distribution"):
            node.distribution = "GGX"
        for name, value in inputs.items():
            node.inputs[name.replace("_", " ")].default_value = value
        return node

    def metal(self, tree=None):
        """A metal of roughness 0.35."""
        return self.node("BsdfPrincipled", tree, Base_Color=METAL, Metallic=1.0, Roughness=0.35)

    def glossy(self, tree=None):
        """A glossy lobe of roughness 0.6."""
        return self.node("BsdfAnisotropic", tree, Color=GLOSSY, Roughness=0.6)

    def diffuse(self, tree=None):
        """A diffuse lobe."""
        return self.node("BsdfDiffuse", tree, Color=DIFFUSE)

    def mix(self, first, second, factor, tree=None):
        """A mix of two shaders; the factor is a number or a socket."""
        tree = tree or self.tree
        node = tree.nodes.new("ShaderNodeMixShader")
        if isinstance(factor, float):
            node.inputs[0].default_value = factor
        else:
            tree.links.new(factor, node.inputs[0])
        for shader, socket in zip((first, second), node.inputs[1:], strict=True):
            tree.links.new(shader if isinstance(shader, bpy.types.NodeSocket) else shader.outputs[0], socket)
        return node

    def add(self, first, second):
        """The sum of two shaders."""
        node = self.tree.nodes.new("ShaderNodeAddShader")
        for shader, socket in zip((first, second), node.inputs, strict=True):
            self.tree.links.new(shader.outputs[0], socket)
        return node

    def texture_u(self):
        """A socket with u of the UV map."""
        coordinates = self.tree.nodes.new("ShaderNodeTexCoord")
        separate = self.tree.nodes.new("ShaderNodeSeparateXYZ")
        self.tree.links.new(coordinates.outputs["UV"], separate.inputs[0])
        return separate.outputs[0]

    def show(self, shader):
        """Link the shader to the output; the material."""
        self.tree.links.new(shader.outputs[0], self.output.inputs["Surface"])
        return self.material


def group_tree(name, inputs=(), outputs=("Shader",)):
    """(tree, input node, output node) of a node group; sockets are shaders, but for an input called Factor."""
    tree = bpy.data.node_groups.new(name, "ShaderNodeTree")
    for direction, names in (("INPUT", inputs), ("OUTPUT", outputs)):
        for socket in names:
            kind = "NodeSocketFloat" if socket == "Factor" else "NodeSocketShader"
            tree.interface.new_socket(socket, in_out=direction, socket_type=kind)
    return tree, tree.nodes.new("NodeGroupInput"), tree.nodes.new("NodeGroupOutput")


def group_node(tree, inner):
    """A node in `tree` that shows the group tree `inner`."""
    node = tree.nodes.new("ShaderNodeGroup")
    node.node_tree = inner
    return node


def seen_from_above(folder, material):
    """(samples, pixel, warnings) of a plane of 6 m."""
    scene_parts.add_top_camera()
    scene_parts.add_area_light()
    add_plane(material)
    prepared = scene_parts.prepare()
    ((samples, pixel, unusable),), _ = scene_parts.sample(folder, prepared)
    assert unusable == 0
    return samples, pixel, prepared[3]


@pytest.fixture(autouse=True)
def _empty_scene():
    scene_parts.empty_scene()


def plain_mix():
    s = Shaders()
    return s.show(s.mix(s.metal(), s.diffuse(), 0.3))


def textured_mix_and_sum():
    s = Shaders()
    return s.show(s.add(s.mix(s.metal(), s.diffuse(), s.texture_u()), s.mix(s.glossy(), s.diffuse(), 0.8)))


def fresnel_mix():
    s = Shaders()
    return s.show(s.mix(s.diffuse(), s.glossy(), s.node("Fresnel", IOR=1.6).outputs[0]))


def factor_beyond_one():
    s = Shaders()
    doubled = s.node("Math")
    doubled.operation = "MULTIPLY"
    s.tree.links.new(s.texture_u(), doubled.inputs[0])
    doubled.inputs[1].default_value = 2.0
    return s.show(s.mix(s.metal(), s.glossy(), doubled.outputs[0]))


def nested_groups():
    """The factor comes from outside into both levels; a shader of the outermost tree is mixed in the innermost."""
    s = Shaders()
    inner, entry, end = group_tree("Inner", ("Factor", "Shader"))
    inner.links.new(s.mix(s.glossy(inner), entry.outputs[1], entry.outputs[0], inner).outputs[0], end.inputs[0])
    outer, entry, end = group_tree("Outer", ("Factor", "Shader"))
    deep = group_node(outer, inner)
    for socket in range(2):
        outer.links.new(entry.outputs[socket], deep.inputs[socket])
    outer.links.new(s.mix(deep, s.diffuse(outer), 0.25, outer).outputs[0], end.inputs[0])
    node = group_node(s.tree, outer)
    s.tree.links.new(s.texture_u(), node.inputs[0])
    s.tree.links.new(s.metal().outputs[0], node.inputs[1])
    return s.show(s.mix(node, s.glossy(), s.texture_u()))


def bumped_parts():
    """Two diffuse lobes with different normals: the albedo that Cycles gives for both is split between them."""
    s = Shaders()
    rough, smooth = s.node("BsdfPrincipled", Base_Color=DIFFUSE, Roughness=0.5), s.diffuse()
    scene_parts.add_bump(s.tree, rough, strength=0.4)
    return s.show(s.mix(rough, smooth, 0.4))


@pytest.mark.parametrize(
    "make", [plain_mix, textured_mix_and_sum, fresnel_mix, factor_beyond_one, nested_groups, bumped_parts]
)
def test_mixes_reproduce_cycles(tmp_path, make):
    prepared = material_scenes.prepared_scene(make)
    assert prepared[3] == []
    found = material_scenes.errors(tmp_path, prepared, 512, techniques=("reference",))
    for name in ("specular", "diffuse"):
        squared = found[name, "reference"][0]
        # The estimate is free of the noise on average; what chance leaves of it at this size is 0.5 % (specular).
        assert squared is None or squared < (0.007 if name == "specular" else 0.004) ** 2, (name, squared)


def test_weights_are_products_of_factors(tmp_path):
    s = Shaders()
    both = s.add(s.mix(s.metal(), s.glossy(), s.texture_u()), s.diffuse())
    samples, pixel, warnings = seen_from_above(tmp_path, s.show(s.mix(both, s.glossy(), 0.25)))
    assert warnings == [] and np.array_equal(np.bincount(pixel), np.full(24 * 16, 4))
    u = samples.position[::4, 0] / 6.0 + 0.5
    expected = {0: 0.75 * (1.0 - u), 1: 0.75 * u, 3: np.full_like(u, 0.25)}
    colors = {0: METAL, 1: GLOSSY, 3: GLOSSY}
    for lobe, weight in expected.items():
        assert np.abs(samples.specular_f0[lobe::4] - weight[:, None] * colors[lobe][:3]).max() < EXACT
    assert np.abs(samples.specular_f90[0::4] - 0.75 * (1.0 - u)[:, None]).max() < EXACT
    assert np.abs(samples.diffuse_albedo[2::4] - 0.75 * np.array(DIFFUSE[:3])).max() < EXACT
    assert not samples.diffuse_albedo.reshape(-1, 4, 3)[:, [0, 1, 3]].any()


def test_a_film_counts_hits_and_not_lobes(tmp_path):
    samples, pixel, _ = seen_from_above(tmp_path, textured_mix_and_sum())
    _, film = gbuffer.join([(samples, pixel), (samples, pixel)], 24, 16)
    assert len(samples) == 4 * 24 * 16 and np.count_nonzero(film.first) == 2 * 24 * 16
    assert np.allclose(film.coverage(), 1.0) and np.array_equal(film.first[:5], [True, False, False, False, True])


def test_lobes_without_weight_leave_one_sample(tmp_path):
    s = Shaders()
    samples, pixel, _ = seen_from_above(tmp_path, s.show(s.mix(s.metal(), s.glossy(), s.node("Value").outputs[0])))
    assert np.array_equal(pixel, np.arange(24 * 16)) and np.abs(samples.roughness - 0.35).max() < EXACT
    assert np.abs(samples.specular_f0 - METAL[:3]).max() < EXACT


def test_a_surface_without_lobes_has_one_black_sample(tmp_path):
    s = Shaders()
    samples, pixel, warnings = seen_from_above(tmp_path, s.show(s.node("Emission")))
    assert np.array_equal(pixel, np.arange(24 * 16)) and warnings == []
    assert not samples.specular_f90.any() and not samples.dielectric.any() and not samples.diffuse_albedo.any()


def test_a_shader_that_is_used_twice_is_one_lobe(tmp_path):
    s = Shaders()
    metal = s.metal()
    shader = s.mix(s.mix(metal, s.diffuse(), s.texture_u()), metal, 0.5)
    samples, pixel, _ = seen_from_above(tmp_path, s.show(shader))
    u = samples.position[::2, 0] / 6.0 + 0.5
    assert np.array_equal(np.bincount(pixel), np.full(24 * 16, 2))
    assert np.abs(samples.specular_f90[::2] - (0.5 * (1.0 - u) + 0.5)[:, None]).max() < EXACT


def test_a_group_that_is_used_twice_has_its_own_values_in_each_place(tmp_path):
    s = Shaders()
    tree, entry, end = group_tree("Twice", ("Factor",), ("Shader", "Other"))
    glossy = s.glossy(tree)
    tree.links.new(entry.outputs[0], glossy.inputs["Roughness"])
    tree.links.new(glossy.outputs[0], end.inputs[0])
    tree.links.new(s.diffuse(tree).outputs[0], end.inputs[1])
    nodes = [group_node(s.tree, tree) for _ in range(2)]
    for node, value in zip(nodes, (0.2, 0.7), strict=True):
        node.inputs[0].default_value = value
    both = s.mix(nodes[0].outputs[0], nodes[0].outputs[1], 0.5)
    samples, pixel, _ = seen_from_above(tmp_path, s.show(s.mix(both, nodes[1], s.texture_u())))
    assert np.array_equal(np.bincount(pixel), np.full(24 * 16, 3)) and len(tree.nodes) == 4
    assert np.abs(samples.roughness.reshape(-1, 3)[:, [0, 2]] - (0.2, 0.7)).max() < EXACT


def test_more_lobes_than_slots_keep_the_largest(tmp_path):
    s = Shaders()
    shader = s.glossy()
    for index in range(MAX_LOBES + 1):
        lobe = s.glossy()
        lobe.inputs["Roughness"].default_value = 0.05 + 0.1 * index
        shader = s.mix(shader, lobe, 0.5)
    samples, pixel, warnings = seen_from_above(tmp_path, s.show(shader))
    assert np.array_equal(np.bincount(pixel), np.full(24 * 16, MAX_LOBES))
    assert len(warnings) == 1 and "'Mix'" in warnings[0] and "'Glossy BSDF'" in warnings[0]
    # The first two shaders have the smallest share, 2^-9 each.
    total = samples.specular_f0.reshape(-1, MAX_LOBES, 3).sum(axis=1)
    assert np.abs(total / GLOSSY[:3] - (1.0 - 2.0**-8)).max() < EXACT


def test_transparency_inside_a_group_is_cut(tmp_path):
    s = Shaders("Veil")
    tree, _, end = group_tree("Clear")
    tree.links.new(s.node("BsdfTransparent", tree).outputs[0], end.inputs[0])
    shader = s.mix(group_node(s.tree, tree), s.add(s.metal(), s.node("BsdfTransparent")), s.texture_u())
    samples, pixel, warnings = seen_from_above(tmp_path, s.show(shader))
    assert np.array_equal(pixel, np.arange(24 * 16)) and np.abs(samples.specular_f90 - 1.0).max() < EXACT
    assert len(warnings) == 2 and all("'Veil'" in line and "opaque" in line for line in warnings)


def test_emission_beside_a_bsdf_is_a_light_and_never_a_lobe(tmp_path):
    s = Shaders("Lamp")
    samples, pixel, warnings = seen_from_above(tmp_path, s.show(s.add(s.node("Emission"), s.metal())))
    assert np.array_equal(pixel, np.arange(24 * 16)) and np.abs(samples.specular_f90 - 1.0).max() < EXACT
    assert warnings == [] and "Plane" in {light.name for light in scene_parts.prepare()[2].lights}


def test_a_color_as_surface_is_emission(tmp_path):
    s = Shaders("Glow")
    samples, pixel, warnings = seen_from_above(tmp_path, s.show(s.node("RGB")))
    assert np.array_equal(pixel, np.arange(24 * 16)) and len(warnings) == 1 and "emission" in warnings[0]
    assert not samples.specular_f90.any() and not samples.diffuse_albedo.any()


@pytest.mark.parametrize("front", ["no output", "nothing linked", "a mix of nothing"])
def test_what_has_no_surface_shader_is_black(tmp_path, front):
    s = Shaders("Nothing")
    if front == "no output":
        s.tree.nodes.clear()
    elif front == "a mix of nothing":
        s.show(s.node("MixShader"))
    add_plane(s.material, location=(0.0, 0.0, 0.5))
    behind = Shaders("Behind")
    samples, pixel, warnings = seen_from_above(tmp_path, behind.show(behind.metal()))
    assert warnings == [] and np.array_equal(pixel, np.arange(24 * 16)) and np.allclose(samples.position[:, 2], 0.5)
    assert not samples.specular_f90.any() and not samples.dielectric.any() and not samples.diffuse_albedo.any()


def test_groups_of_a_linked_material_are_followed(tmp_path):
    library = tmp_path / "library.blend"
    bpy.data.libraries.write(str(library), {nested_groups()}, fake_user=True)
    before = library.read_bytes()
    scene_parts.empty_scene()
    with bpy.data.libraries.load(str(library), link=True) as (_, wanted):
        wanted.materials = ["Mix"]
    samples, pixel, warnings = seen_from_above(tmp_path, bpy.data.materials["Mix"])
    assert warnings == [] and np.array_equal(np.bincount(pixel), np.full(24 * 16, 4)) and library.read_bytes() == before
    u = samples.position[::4, 0] / 6.0 + 0.5
    # In the order of the walk: the inner glossy lobe, the metal from outside, the diffuse lobe, the outer glossy one.
    assert np.abs(samples.specular_f90[1::4] - ((1.0 - u) * 0.75 * u)[:, None]).max() < EXACT
    assert np.abs(samples.specular_f0[3::4] - u[:, None] * GLOSSY[:3]).max() < EXACT
