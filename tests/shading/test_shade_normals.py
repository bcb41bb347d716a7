"""`shade` where normals differ: horizons of bump-mapped surfaces, a normal for each pass."""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest
import textbook
from surface_scenes import area_light, four_lights, random_samples, single_sample, unit

from ltsh_addon import shading

shade = partial(shading.shade, dtype=np.float64)
TECHNIQUES = (*shading.SHIPPED_TABLES, shading.REFERENCE)
techniques = pytest.mark.parametrize("technique", TECHNIQUES)
# The quadrature stops at 1e-4 of the value: what changes its nodes changes its value by so much.
QUADRATURE = 2e-4


@techniques
def test_specular_light_ends_at_the_geometric_horizon(technique):
    """A light in front of the shading normal but behind the surface itself; the diffuse lobe has no such limit."""
    sample = single_sample(
        geometric_normal=(-1.0, 0.0, 0.0), specular_f0=(1, 1, 1), specular_f90=(1, 1, 1), view=(0.0, 0.3, 1.0)
    )
    behind, across = area_light(center=(2.0, 0.0, 3.0)), area_light()
    assert shade(sample, [behind], technique).specular.max() == 0.0
    assert shade(sample, [behind], technique).diffuse.min() > 0.0
    # By symmetry in x half of a centered light remains.
    open_sample = replace(sample, geometric_normal=sample.normal)
    whole = shade(open_sample, [across], technique).specular
    half = shade(sample, [across], technique).specular
    assert half == pytest.approx(0.5 * whole, rel=QUADRATURE if technique == shading.REFERENCE else 1e-10)


def test_bump_mapped_diffuse_light_is_shadowed_toward_the_smooth_horizon():
    """A light so small that its mean direction is its direction: the factor is 2 / (1 + sqrt(1 + a^2 tan^2))."""
    smooth, bumped = np.array([0.0, 0.0, 1.0]), np.array([0.6, 0.0, 0.8])
    sample = single_sample(diffuse_normal=bumped, smooth_normal=smooth, bump_alpha2=0.25)
    open_sample = replace(sample, smooth_normal=sample.diffuse_normal, bump_alpha2=np.zeros(1))
    for tangent in (0.5, 2.0, 8.0):
        light = area_light(center=(tangent, 0.0, 1.0), half_u=(1e-3, 0, 0), half_v=(0, -1e-3, 0))
        factor = shade(sample, [light]).diffuse / shade(open_sample, [light]).diffuse
        # Directions within the light differ by its size over its distance, 1e-3.
        assert factor == pytest.approx(2.0 / (1.0 + np.sqrt(1.0 + 0.25 * tangent**2)), rel=2e-3)


def test_bump_mapped_diffuse_light_ends_at_the_smooth_horizon():
    sample = single_sample(diffuse_normal=(1.0, 0.0, 0.0), smooth_normal=(0.0, 0.0, 1.0))
    open_sample = replace(sample, smooth_normal=sample.diffuse_normal)
    # Facing the point from the side; half of it lies below the smooth horizon.
    light = area_light(center=(2.0, 0.0, 0.0), half_u=(0, 1, 0), half_v=(0, 0, -1), direction=(-1.0, 0.0, 0.0))
    whole, half = (shade(point, [light]).diffuse for point in (open_sample, sample))
    assert half == pytest.approx(0.5 * whole, rel=1e-10)
    below = area_light(center=(2.0, 0.0, -1.5), half_u=(0, 1, 0), half_v=(0, 0, -1), direction=(-1.0, 0.0, 0.0))
    assert shade(sample, [below]).diffuse.max() == 0.0
    assert shade(open_sample, [below]).diffuse.min() > 0.0


def test_each_pass_has_its_own_normal():
    """The diffuse light follows `diffuse_normal`, the specular light `normal`."""
    sample = single_sample(specular_f0=(1, 1, 1), specular_f90=(1, 1, 1), view=(0.0, 0.3, 1.0))
    tilted = np.array([[0.6, 0.0, 0.8]])
    light = area_light(center=(1.0, 0.3, 2.0))
    plain = shade(sample, [light])
    bumped = shade(replace(sample, diffuse_normal=tilted), [light])
    assert np.array_equal(bumped.specular, plain.specular)
    # Turned about y, so that the tilted normal is z
    turn = np.array([[0.8, 0.0, -0.6], [0.0, 1.0, 0.0], [0.6, 0.0, 0.8]])
    factor = textbook.lambert_form_factor(light.polygon() @ turn.T)
    assert bumped.diffuse[0, 0] == pytest.approx(abs(factor) * light.radiance, rel=1e-9)
    assert not np.allclose(bumped.diffuse, plain.diffuse, rtol=0.01)


@pytest.mark.parametrize("dtype", [np.float64, np.float32])
def test_normals_from_single_precision_near_the_view_direction_shade_like_exact_ones(dtype):
    """Their length is off by 6e-8, which tilts the frame where what the view has across the normal is as small.

    Cosines are then off by as much and angles near zero by 3e-4, of which lobes as wide as these hardly notice.
    """
    generator, count = np.random.default_rng(1), 400
    samples = random_samples(count, lowest_roughness=0.1)
    offset = 10.0 ** generator.uniform(-7.5, -3.0, (count, 1)) * generator.normal(size=(count, 3))
    normal = unit(samples.view + offset).astype(np.float32).astype(np.float64)
    rounded = replace(samples, normal=normal, geometric_normal=normal)
    exact = replace(samples, normal=unit(normal), geometric_normal=unit(normal))
    expected = shade(exact, four_lights()).specular
    error = np.linalg.norm(shading.shade(rounded, four_lights(), dtype=dtype).specular - expected)
    assert error < 1e-3 * np.linalg.norm(expected)
