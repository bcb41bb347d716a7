"""`shade`: symmetries, rows of lights, one-sided lights, blocks, cancelling, and what is refused.

In double precision, where symmetries hold to rounding; `test_single_precision` compares the other path with this one.
"""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest
import surface_scenes
import textbook
from precisions import techniques
from surface_scenes import area_light, four_lights, random_samples, single_sample, unit

from ltsh_addon import shading
from ltsh_addon.scene import Cancelled
from ltsh_addon.shading import integrator

shade = partial(shading.shade, dtype=np.float64)
# Sums of a few dozen terms of size 10 in double precision, amplified by sharp lobes
ROUNDING = 1e-9
# The quadrature stops at 1e-4 of the value: what changes its nodes changes its value by so much.
QUADRATURE = 2e-4


def tolerance(technique, values):
    return (QUADRATURE if technique == shading.REFERENCE else ROUNDING) * np.abs(values).max()


def both(shaded):
    return np.concatenate([shaded.specular, shaded.diffuse])


def small_blocks(monkeypatch, size):
    for name in ("BLOCK_LIMITS", "REFERENCE_BLOCK_LIMITS"):
        monkeypatch.setattr(integrator, name, (size, size))


@techniques
def test_light_adds_up(technique):
    samples, lights = random_samples(150, seed=1), four_lights()
    together = shade(samples, lights, technique, workers=1, rows=(0, 1, 0, 2))
    assert together.specular.shape == together.diffuse.shape == (3, 150, 3)
    apart = [shade(samples, [light], technique, workers=1) for light in lights]
    assert np.abs(sum(part.combined for part in apart) - together.combined).max() < 1e-12
    key = apart[0].specular[0] + apart[2].specular[0]
    assert np.abs(key - together.specular[0]).max() < 1e-12
    assert together.combined == pytest.approx(both(together).sum(axis=0), rel=1e-14)
    assert together.specular.max() > 0.1 and together.diffuse.max() > 0.1


@techniques
def test_moving_turning_mirroring_and_scaling_everything_changes_nothing(technique):
    samples, lights = random_samples(150, seed=2), four_lights()
    expected = both(shade(samples, lights, technique, workers=1))
    for seed, sign, scale in ((1, 1.0, 1.0), (2, -1.0, 1e-3)):
        rotation, shift = sign * surface_scenes.random_rotation(seed), (3.0, -2.0, 1.0)
        moved, turned = surface_scenes.moved(samples, lights, rotation, shift)
        sizes = ("center", "half_u", "half_v")
        scaled = [replace(light, **{name: scale * getattr(light, name) for name in sizes}) for light in turned]
        found = both(shade(replace(moved, position=scale * moved.position), scaled, technique, workers=1))
        assert np.abs(found - expected).max() < tolerance(technique, expected)


@techniques
def test_lights_and_surfaces_have_one_side(technique):
    """A light that faces away, in its own plane or below the horizon gives nothing, a view from behind no specular."""
    white = {"specular_f0": (1, 1, 1), "specular_f90": (1, 1, 1)}
    below = single_sample(**white)
    assert shade(below, [area_light()], technique).combined.min() > 0.0
    for light in (area_light(half_u=(-1, 0, 0)), area_light(center=(0, 0, 0), half_u=(0, 1, 0), half_v=(0, 0, 1))):
        assert not shade(below, [light], technique).combined.any()
    assert not shade(
        single_sample(normal=(0, 0, -1), view=(0, 0, -1), **white), [area_light()], technique
    ).combined.any()
    shaded = shade(single_sample(view=(0.1, 0, -1), **white), [area_light()], technique)
    assert not shaded.specular.any() and shaded.diffuse.min() > 0.0


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("away", [0.0, 40.0])
def test_a_flat_surface_does_not_light_itself(away, dtype):
    """Of a sheet that shines to both sides, single precision puts points before it and behind it."""
    surfaces = random_samples(500, seed=6)
    axes = np.linalg.qr(np.random.default_rng(2).normal(size=(3, 3)))[0]
    place = np.random.default_rng(3).uniform(-1.0, 1.0, size=(500, 2))
    center = np.array([0.7, -0.6, 0.4]) + away
    position = (center + place @ axes[:2]).astype(np.float32).astype(np.float64)
    sides = [area_light(center=center, half_u=way * axes[0], half_v=axes[1]) for way in (1.0, -1.0)]
    normal = np.broadcast_to(sides[0].direction, (500, 3))
    view = unit(normal + 0.8 * axes[0])
    surfaces = replace(
        surfaces,
        position=position,
        view=np.broadcast_to(view, (500, 3)),
        **dict.fromkeys(("normal", "diffuse_normal", "geometric_normal", "smooth_normal"), normal),
    )
    assert ((position - center) @ sides[0].direction > 0.0).mean() > 0.2
    assert np.abs(shading.shade(surfaces, sides, dtype=dtype).combined).max() < 1e-5


@pytest.mark.parametrize("technique", shading.SHIPPED_TABLES)
def test_specular_light_is_the_clamped_integral_of_the_lobe(technique):
    """White metals and small lights all around: where a lobe rings below zero, a fiftieth of the clamped cosine under
    its warp is reflected, which is the form factor of the warped light; in the tail the light bounds it."""
    table = shading.load_table(technique)
    generator = np.random.default_rng(11)
    cosine, roughness = generator.uniform(0.02, 1.0, size=4000), generator.uniform(0.05, 1.0, size=4000)
    center = surface_scenes.unit(generator.normal(size=(4000, 3))) * np.array([1, 1, 0.5]) + np.array([0, 0, 0.6])
    half_u = 0.1 * surface_scenes.unit(np.cross(center, generator.normal(size=(4000, 3))))
    half_v = np.cross(half_u, center)
    corners = [center - half_u - half_v, center + half_u - half_v, center + half_u + half_v, center - half_u + half_v]
    polygons = np.stack(corners, axis=1)
    signed = -shading.integrate_polygon(table, cosine, roughness, polygons, signed=True)
    clamped = shading.integrate_polygon(table, cosine, roughness, polygons)
    warped = table.lookup(cosine, roughness).to_original_domain(polygons.transpose(2, 1, 0)).transpose(2, 1, 0)
    least = 0.02 * shading.clamped_form_factor(warped) * (technique != "ltc")
    # The harmonics ring, the clamped cosine does not: else this test would show nothing.
    assert (signed.min() < -1e-6) == (technique != "ltc")
    for n in [*np.argsort(signed)[:20], *range(40)]:
        light = area_light(center=center[n], half_u=half_u[n], half_v=half_v[n], radiance=(1, 1, 1))
        white = {"specular_f0": (1, 1, 1), "specular_f90": (1, 1, 1), "roughness": roughness[n]}
        sample = single_sample(view=textbook.view_direction(cosine[n]), **white)
        found = shade(sample, [light], table, passes=["specular"], workers=1).specular[0, 0, 0]
        expected = max(signed[n], least[n])
        if technique != "ltc":
            expected = textbook.within_tail_bounds(expected, sample.view[0], roughness[n], light)
        assert found == pytest.approx(expected, abs=1e-12)
        assert clamped[n] == pytest.approx(max(signed[n], 0.0), abs=1e-12)


@techniques
def test_lights_affect_only_what_they_should(technique):
    samples = random_samples(50, seed=5)
    full = shade(samples, [area_light()], technique)
    no_diffuse = shade(samples, [area_light(affects_diffuse=False)], technique)
    no_specular = shade(samples, [area_light(affects_specular=False)], technique)
    assert np.array_equal(no_diffuse.specular, full.specular) and not no_diffuse.diffuse.any()
    assert np.array_equal(no_specular.diffuse, full.diffuse) and not no_specular.specular.any()
    # As many lights affect one pass as the other, but others.
    other = area_light(affects_specular=False, center=(-0.8, 0.3, 1.5), radiance=(1.0, 5.0, 2.0))
    both = shade(samples, [area_light(affects_diffuse=False), other], technique)
    assert np.array_equal(both.specular[0], full.specular[0]) and not both.specular[1].any()
    assert np.array_equal(both.diffuse[1], shade(samples, [other], technique).diffuse[0]) and not both.diffuse[0].any()


@pytest.mark.parametrize("height", [0.3, 1.0, 4.0])
def test_diffuse_is_albedo_times_form_factor(height):
    """A point below the corner of a parallel rectangle, and below the center of a disk."""
    albedo = np.array([0.8, 0.5, 0.1])
    sample = single_sample(diffuse_albedo=albedo)
    rectangle = area_light(center=(0.7, -0.4, height), half_u=(0.7, 0, 0), half_v=(0, -0.4, 0))
    found = shade(sample, [rectangle], passes=["diffuse"]).diffuse[0, 0]
    factor = textbook.parallel_rectangle_form_factor(1.4, 0.8, height)
    assert found == pytest.approx(albedo * rectangle.radiance * factor, rel=1e-12)
    disk = area_light(shape="DISK", center=(0, 0, height), half_u=(0.6, 0, 0), half_v=(0, -0.6, 0))
    found = shade(sample, [disk], passes=["diffuse"]).diffuse[0, 0]
    # A 32-gon of the disk's area: the solid angle agrees, the shape differs by a ripple of 0.6 % of the radius.
    expected = albedo * disk.radiance * textbook.coaxial_disk_form_factor(0.6, height)
    assert found == pytest.approx(expected, rel=1e-4)


@techniques
def test_blocks_do_not_matter(technique, monkeypatch):
    samples, lights = random_samples(100, seed=7), four_lights()
    expected = both(shade(samples, lights, technique, workers=1))
    small_blocks(monkeypatch, 13)
    found = both(shade(samples, lights, technique, workers=1))
    assert np.abs(found - expected).max() < ROUNDING * np.abs(expected).max()


def test_progress_can_cancel_at_its_first_call(monkeypatch):
    small_blocks(monkeypatch, 10)
    calls = []
    with pytest.raises(Cancelled):
        shade(random_samples(100), four_lights(), "ltc", workers=1, progress=lambda share: calls.append(share) or False)
    assert len(calls) == 1


@techniques
def test_no_samples_and_no_lights_are_fine(technique):
    none = random_samples(4).take(slice(0, 0))
    shaded = shade(none, four_lights(), technique)
    assert shaded.specular.shape == (4, 0, 3) and shaded.combined.shape == (0, 3)
    dark = shade(random_samples(4), [], technique)
    assert dark.specular.shape == (1, 4, 3)
    assert np.array_equal(dark.combined, np.zeros((4, 3)))


def test_passes_that_were_not_asked_for_are_absent():
    only = shade(random_samples(4), four_lights(), "ltc", passes=("diffuse",))
    assert only.specular is None and np.array_equal(only.combined, only.diffuse.sum(axis=0))


@pytest.mark.parametrize("passes", [("glossy",), ("specular", "shiny"), ()])
def test_unknown_passes_are_refused(passes):
    with pytest.raises(ValueError, match="expected some of specular, diffuse"):
        shade(random_samples(4), four_lights(), passes=passes)


@pytest.mark.parametrize("technique", ["ltc", shading.REFERENCE])
def test_up_to_64_lights_have_a_row_each_and_more_have_one(technique):
    samples, lights = random_samples(4), 17 * four_lights()
    few, many = (shade(samples, lights[:count], technique, passes=["diffuse"]).diffuse for count in (64, 65))
    assert few.shape == (64, 4, 3) and many.shape == (1, 4, 3)
    again = shade(samples, lights[:65], technique, passes=["diffuse"], rows=[2] * 64 + [0]).diffuse
    assert np.allclose(again[2], few.sum(axis=0)) and np.allclose(again.sum(axis=0), many[0]) and not again[1].any()


@pytest.mark.parametrize("rows", [(0, 1, 2), (0, 1, 2, -1), (0.0, 1.0, 2.0, 3.0), 0])
def test_rows_that_do_not_fit_the_lights_are_refused(rows):
    with pytest.raises(ValueError, match="expected 4 integers from 0 on, one a light"):
        shade(random_samples(4), four_lights(), rows=rows)


@pytest.mark.parametrize("technique", ["ltsh5", "", "Reference", "no/such.npz"])
def test_unknown_techniques_are_refused(technique):
    with pytest.raises(shading.TableError, match="no such file or table; shipped are ltc, ltsh2, ltsh4, ltsh4c"):
        shade(random_samples(4), four_lights(), technique)


@pytest.mark.parametrize("shape", ["RECTANGLE", "DISK"])
@techniques
def test_a_light_without_area_gives_nothing(technique, shape):
    for half_u in ((0, 0, 0), (0, 0.5, 0)):
        light = area_light(shape=shape, half_u=half_u, half_v=(0, -0.6, 0), direction=(0, 0, -1))
        shaded = shade(random_samples(30, seed=9), [light], technique)
        assert np.abs(shaded.combined).max() < 1e-9


@techniques
def test_extreme_surfaces_give_finite_radiance(technique):
    """Roughness 0 and 1, grazing and normal view, a light touching the surface, IOR of 1, no color at all."""
    rows = []
    for roughness in (0.0, 1e-3, 1.0):
        for view in ((0, 0, 1), (1, 0, 1e-9), (0.6, 0, 0.8)):
            for ior in (1.0, 1.5, 10.0):
                fields = {"specular_f90": (1, 1, 1), "dielectric": 1.0, "ior": ior}
                rows.append(single_sample(roughness=roughness, view=view, **fields))
    samples = type(rows[0])(
        **{name: np.concatenate([getattr(row, name) for row in rows]) for name in rows[0].__dataclass_fields__}
    )
    lights = [
        area_light(center=(0, 0, 1e-7)),
        area_light(center=(0.0, 0.0, 0.3), half_u=(0, 0, 0.3), half_v=(0, 1, 0)),
        area_light(shape="DISK", center=(-1.0, 0.0, 1.0), half_u=(1, 0, 1), half_v=(0, 1, 0)),
        *four_lights(),
    ]
    for light in lights:
        radiance = shade(samples, [light], technique).combined
        assert np.isfinite(radiance).all() and (radiance >= 0.0).all(), light.name


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
