"""Mixes, sums and groups of BSDFs become lobes whose weights are those of Cycles."""

import bpy
import material_scenes
import numpy as np
import pytest
import scene_parts
from material_scenes import Build, seen_from_above
from scene_parts import add_plane

from ltsh_addon.cycles import gbuffer
from ltsh_addon.cycles.lobes import MAX_LOBES

# Numbers pass through float32 nodes a few times.
EXACT = 2e-6
METAL, GLOSSY, DIFFUSE = (0.9, 0.6, 0.3, 1.0), (0.2, 0.5, 0.8, 1.0), (0.3, 0.6, 0.2, 1.0)


class Shaders(Build):
    """A material under construction of three BSDFs."""

    def metal(self):
        return self.shader("BsdfPrincipled", Base_Color=METAL, Metallic=1.0, Roughness=0.35)

    def glossy(self, roughness=0.6):
        return self.shader("BsdfAnisotropic", Color=GLOSSY, Roughness=roughness)

    def diffuse(self):
        return self.shader("BsdfDiffuse", Color=DIFFUSE)


@pytest.fixture(autouse=True)
def _empty_scene():
    scene_parts.empty_scene()


def plain_mix():
    s = Shaders()
    return s.show(s.mix(0.3, s.metal(), s.diffuse()))


def textured_mix_and_sum():
    s = Shaders()
    return s.show(s.add(s.mix(s.texture_u(), s.metal(), s.diffuse()), s.mix(0.8, s.glossy(), s.diffuse())))


def fresnel_mix():
    s = Shaders()
    return s.show(s.mix(s.shader("Fresnel", IOR=1.6), s.diffuse(), s.glossy()))


def factor_beyond_one():
    s = Shaders()
    return s.show(s.mix(s.product(s.texture_u(), 2.0), s.metal(), s.glossy()))


def nested_groups():
    """The factor comes from outside into both levels; a shader of the outermost tree is mixed in the innermost."""
    s = Shaders()

    def outer(factor, shader):
        (deep,) = s.group(lambda factor, shader: s.mix(factor, s.glossy(), shader), [factor, shader])
        return s.mix(0.25, deep, s.diffuse())

    (both,) = s.group(outer, [s.texture_u(), s.metal()])
    return s.show(s.mix(s.texture_u(), both, s.glossy()))


def bumped_parts():
    """Two diffuse lobes with different normals: the albedo that Cycles gives for both is split between them."""
    s = Shaders()
    rough, smooth = s.shader("BsdfPrincipled", Base_Color=DIFFUSE, Roughness=0.5), s.diffuse()
    scene_parts.add_bump(s.tree, rough.node, strength=0.4)
    return s.show(s.mix(0.4, rough, smooth))


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
    both = s.add(s.mix(s.texture_u(), s.metal(), s.glossy()), s.diffuse())
    samples, pixel, warnings = seen_from_above(tmp_path, s.show(s.mix(0.25, both, s.glossy())))
    assert warnings == [] and np.array_equal(np.bincount(pixel), np.full(24 * 16, 4))
    u = samples.position[::4, 0] / 6.0 + 0.5
    for lobe, weight, color in ((0, 0.75 * (1.0 - u), METAL), (1, 0.75 * u, GLOSSY), (3, 0.25 + 0.0 * u, GLOSSY)):
        assert np.abs(samples.specular_f0[lobe::4] - weight[:, None] * color[:3]).max() < EXACT
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
    samples, pixel, _ = seen_from_above(tmp_path, s.show(s.mix(s.value(0.0), s.metal(), s.glossy())))
    assert np.array_equal(pixel, np.arange(24 * 16)) and np.abs(samples.roughness - 0.35).max() < EXACT
    assert np.abs(samples.specular_f0 - METAL[:3]).max() < EXACT


def test_a_shader_that_is_used_twice_is_one_lobe(tmp_path):
    s = Shaders()
    metal = s.metal()
    samples, pixel, _ = seen_from_above(tmp_path, s.show(s.mix(0.5, s.mix(s.texture_u(), metal, s.diffuse()), metal)))
    u = samples.position[::2, 0] / 6.0 + 0.5
    assert np.array_equal(np.bincount(pixel), np.full(24 * 16, 2))
    assert np.abs(samples.specular_f90[::2] - (0.5 * (1.0 - u) + 0.5)[:, None]).max() < EXACT


def test_more_lobes_than_slots_keep_the_largest(tmp_path):
    s = Shaders()
    shader = s.glossy()
    for index in range(MAX_LOBES + 1):
        shader = s.mix(0.5, shader, s.glossy(0.05 + 0.1 * index))
    samples, pixel, warnings = seen_from_above(tmp_path, s.show(shader))
    assert np.array_equal(np.bincount(pixel), np.full(24 * 16, MAX_LOBES))
    assert len(warnings) == 1 and "'Mix'" in warnings[0] and "'Glossy BSDF'" in warnings[0]
    # The first two shaders have the smallest share, 2^-9 each.
    total = samples.specular_f0.reshape(-1, MAX_LOBES, 3).sum(axis=1)
    assert np.abs(total / GLOSSY[:3] - (1.0 - 2.0**-8)).max() < EXACT


def test_emission_beside_a_bsdf_is_a_light_and_never_a_lobe(tmp_path):
    s = Shaders("Lamp")
    samples, pixel, warnings = seen_from_above(tmp_path, s.show(s.add(s.shader("Emission"), s.metal())))
    assert np.array_equal(pixel, np.arange(24 * 16)) and np.abs(samples.specular_f90 - 1.0).max() < EXACT
    assert warnings == [] and "Plane" in {light.name for light in scene_parts.prepare()[2].lights}


@pytest.mark.parametrize("front", ["Emission", "RGB", "MixShader", "nothing linked", "no output"])
def test_what_has_no_lobes_has_one_black_sample(tmp_path, front):
    s = Shaders("Nothing")
    if front == "no output":
        s.tree.nodes.clear()
    elif front != "nothing linked":
        s.show(s.shader(front))
    add_plane(s.material, location=(0.0, 0.0, 0.5))
    behind = Shaders("Behind")
    samples, pixel, warnings = seen_from_above(tmp_path, behind.show(behind.metal()))
    # A color as surface is emission, and said to be; the Emission node makes a light.
    expected = {"RGB": ["emission"], "Emission": []}.get(front, ["it has no surface shader"])
    assert len(warnings) == len(expected) and all(part in line for part, line in zip(expected, warnings, strict=True))
    assert np.array_equal(pixel, np.arange(24 * 16)) and np.allclose(samples.position[:, 2], 0.5)
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
