"""The sky: patches chosen by the lobes give what the smallest ones do."""

from dataclasses import replace

import numpy as np
import pytest
import quadrature
from surface_scenes import random_samples, single_sample, unit

from ltsh_addon.cycles.environment import (
    CUBE,
    SkyPicture,
    bright_spots,
    fine_detail,
    sky_lights,
    spot_frame,
    without_spots,
)
from ltsh_addon.scene import SkyLight
from ltsh_addon.shading import shade

LIKE = SkyLight("Sky", [0, 0, 1], [1, 0, 0], [0, 1, 0], [0, 0, -1], np.ones(3))


def pictures(count=32, seed=1):
    """A smooth sky with bright windows."""
    rng = np.random.default_rng(seed)
    waves = rng.normal(0.0, 2.0, (3, 3))
    found = []
    for axes in CUBE:
        picture = SkyPicture(*axes, np.zeros((count, count, 3)))
        offsets = picture.offsets()
        unit = offsets / np.linalg.norm(offsets, axis=-1, keepdims=True)
        radiance = 1.0 + 0.8 * np.sin(unit @ waves)
        radiance[5:8, 9:14] *= 6.0
        found.append(SkyPicture(*axes, radiance))
    return found


@pytest.mark.parametrize(("technique", "dtype"), [("ltsh4", np.float32), ("ltc", np.float64)])
def test_patches_chosen_by_lobes_give_what_the_smallest_do(technique, dtype):
    """In single precision by a map, in double by patches; 0.5 % are what `light_polygons.SKY_PRODUCT` allows."""
    samples = random_samples(60, seed=2, lowest_roughness=0.25)
    lights, error = sky_lights(LIKE, pictures())
    assert len(lights) == 6 and error < 0.03
    leaves = [leaf for light in lights for leaf in light.leaves]
    found = shade(samples, lights, technique, dtype=dtype, workers=1)
    expected = shade(samples, leaves, technique, dtype=dtype, workers=1)
    for name, most in (("specular", 0.01), ("diffuse", 2e-3)):
        own, exact = (getattr(shading, name).sum(axis=0) for shading in (found, expected))
        assert np.linalg.norm(own - exact) < most * np.linalg.norm(exact), name


@pytest.mark.parametrize("passes", [("diffuse",), ("specular", "diffuse")])
def test_a_sky_that_is_hidden_from_a_pass_gives_it_no_light(passes):
    samples, lights = random_samples(9, seed=2), sky_lights(LIKE, pictures(8))[0]
    found = shade(samples, [replace(light, affects_diffuse=False) for light in lights], passes=passes, workers=1)
    assert not found.diffuse.any() and ("specular" not in passes or found.specular.any())


SKIES = {
    "gradient": lambda d: (0.3 + 0.5 * (1.0 + d[..., 2:])) * [0.5, 0.6, 0.9],
    "sun": lambda d: [0.25, 0.45, 0.9] + (3.0 * np.exp((d @ SUN - 1.0) / 0.03))[..., None] * [1.0, 0.9, 0.7],
    "windows": lambda d: np.where((np.abs(np.sin(3.0 * d)) > 0.9).all(axis=-1, keepdims=True), 12.0, 0.4) * np.ones(3),
    "checkers": lambda d: (0.1 + (np.floor(4.0 * d).sum(axis=-1) % 2.0))[..., None] * [1.0, 0.9, 0.8],
}
SUN = np.array([0.48, 0.36, 0.8])


@pytest.mark.parametrize("sky", SKIES)
@pytest.mark.parametrize("kind", ["isotropic", "anisotropic"])
def test_glossy_surfaces_reflect_the_integral_of_a_sky(sky, kind):
    """By the textbook's formulas in the middles of 6,144 pixels. The mean is within the 0.3 % that a picture may be
    off; patches are 2 % of a sky from its pixels, and 192 directions leave 1 % of windows thirty times as bright."""
    samples = random_samples(60, seed=6, lowest_roughness=0.35)
    samples = replace(samples, geometric_normal=samples.normal)
    if kind == "anisotropic":
        tangent = np.random.default_rng(7).normal(size=(60, 3))
        samples = replace(samples, anisotropy=np.linspace(-0.5, 0.47, 60), tangent=tangent)
    taken = [replace(one, radiance=SKIES[sky](unit(one.offsets()))) for one in pictures(32)]
    found = shade(samples, sky_lights(LIKE, taken)[0], passes=("specular",), workers=1).specular.sum(axis=0)
    expected = sum(
        np.einsum("psk,sk,s->pk", quadrature.ggx(unit(one.offsets()).reshape(1, -1, 3), samples),
                  one.radiance.reshape(-1, 3), one.solid_angles().ravel())
        for one in taken
    )  # fmt: skip
    assert abs(found.sum() / expected.sum() - 1.0) < 3e-3
    assert np.linalg.norm(found - expected) < 0.02 * np.linalg.norm(expected)


@pytest.mark.parametrize("field", ["sheen_a", "velvet", "diffuse_roughness", "bump"])
def test_all_diffuse_lobes_reflect_a_sky_as_its_patches_do(field):
    """In double precision each patch is integrated by closed forms. The mean is within the 0.3 % that a picture may be
    off, but for velvet, which is brightest near the horizon. 192 directions leave 1 % of windows with six times the
    rest."""
    samples = random_samples(60, seed=8)
    value = {"sheen_a": 0.8, "velvet": -0.4, "diffuse_roughness": 0.7, "bump": 0.3}[field]
    name = {"velvet": "sheen_a", "bump": "bump_alpha2"}.get(field, field)
    rebound = np.full((60, 3), 0.1 if field == "diffuse_roughness" else 0.0)
    smooth = samples.normal if field == "bump" else samples.diffuse_normal
    samples = replace(samples, **{name: np.full(60, value)}, diffuse_rebound=rebound, smooth_normal=smooth)
    samples = replace(samples, sheen_b=0.3 + 0.0 * samples.sheen_a)
    lights, _ = sky_lights(LIKE, pictures(16))
    found, expected = (
        shade(samples, lights, passes=("diffuse",), dtype=dtype, workers=1).diffuse.sum(axis=0)
        for dtype in (np.float32, np.float64)
    )
    assert np.linalg.norm(found - expected) < 0.025 * np.linalg.norm(expected)
    assert abs(found.sum() / expected.sum() - 1.0) < (5e-3 if field == "velvet" else 3e-3)


def test_sharp_reflections_show_a_smooth_sky_without_facets():
    """A mirror turns by 60 degrees: what it shows is what the picture has there, and no step of a patch."""
    taken = [
        SkyPicture(*axes, 2.0 + offsets / np.linalg.norm(offsets, axis=-1, keepdims=True))
        for axes in CUBE
        for offsets in [SkyPicture(*axes, np.zeros((64, 64, 3))).offsets()]
    ]
    lights, _ = sky_lights(LIKE, taken, 200)
    angle = np.radians(np.linspace(10.0, 40.0, 301))
    normal = np.stack([np.sin(angle), 0.3 + 0.0 * angle, np.cos(angle)], axis=1)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    white = np.ones((301, 3))
    sample = single_sample(specular_f0=(1.0,) * 3, specular_f90=(1.0,) * 3, roughness=0.05)
    samples = sample.take(np.zeros(301, int))
    normals = dict.fromkeys(("normal", "geometric_normal", "diffuse_normal", "smooth_normal"), normal)
    samples = replace(samples, view=np.array([0.0, 0.0, 1.0]) * white, **normals)
    mirrored = 2.0 * normal[:, 2:] * normal - samples.view
    found, faceted = (
        shade(samples, lights, "ltsh4", passes=["specular"], dtype=dtype, workers=1).specular.sum(axis=0)
        for dtype in (np.float32, np.float64)
    )
    # The lobe blurs by 0.005 rad; at the edges of the sides, where only one neighbor is known, the sky is flat.
    off, off_by_patches = (np.sqrt(np.square(values - 2.0 - mirrored).mean()) for values in (found, faceted))
    assert off < 0.5 * off_by_patches, (off, off_by_patches)
    bend, facets = (np.abs(np.diff(values, n=2, axis=0)).max() for values in (found, faceted))
    assert bend < 0.3 * facets, (bend, facets)


def test_a_small_distant_light_with_children_is_all_of_its_patches():
    """Such as a bright window in an image, of which a map would give a lobe too much or too little."""
    place = {"center": [0.1, 0.2, 1.0], "half_u": [0.05, 0, 0], "half_v": [0, 0.05, 0]}
    offsets = [(s, t) for s in (-0.5, 0.5) for t in (-0.5, 0.5)]
    whole = replace(LIKE, **place)
    children = tuple(
        replace(whole, center=whole.center + s * whole.half_u + t * whole.half_v, half_u=0.5 * whole.half_u,
                half_v=0.5 * whole.half_v, radiance=(1.0 + s, 1.0 - t, 2.0))
        for s, t in offsets
    )  # fmt: skip
    samples = random_samples(60, seed=4)
    found = shade(samples, [replace(whole, radiance=(1.0, 1.0, 2.0), children=children)], workers=1)
    expected = shade(samples, children, workers=1, rows=[0] * len(children))
    assert np.array_equal(found.combined, expected.combined) and found.combined.any()


def test_a_constant_sky_is_one_patch_a_side_and_reflects_the_albedo():
    """From above a plane half of the sky is seen: the diffuse reflection is the albedo."""
    constant = [SkyPicture(*axes, np.ones((8, 8, 3))) for axes in CUBE]
    lights, error = sky_lights(LIKE, constant)
    assert len(lights) == 6 and error < 1e-6 and not any(light.children for light in lights)
    samples = random_samples(100, seed=3)
    flat = (samples.diffuse_normal == samples.smooth_normal).all(axis=1)
    diffuse = shade(samples, lights, "ltc", passes=("diffuse",), workers=1).diffuse.sum(axis=0)
    assert flat.any()
    np.testing.assert_allclose(diffuse[flat], samples.diffuse_albedo[flat], atol=2e-5)


@pytest.mark.parametrize("technique", ["ltsh2", "ltsh4c"])
def test_coats_reflect_their_albedo_of_a_constant_sky(technique):
    """Those with one horizon by the table's albedo, which is 0.2 % from the quadrature: sums of polygons are up to 7 %
    from that. Those with two horizons share chunks with them and are what they are by themselves."""
    lights, _ = sky_lights(LIKE, [SkyPicture(*axes, np.ones((8, 8, 3))) for axes in CUBE])
    samples = random_samples(160, seed=4)
    samples = samples.take((samples.normal * samples.view).sum(axis=1) > 0.03)
    one, none = np.arange(len(samples)) % 2 == 0, np.zeros(samples.position.shape)
    samples = replace(
        samples, geometric_normal=np.where(one[:, None], samples.normal, samples.geometric_normal),
        roughness=np.linspace(0.12, 1.0, len(samples)), anisotropy=np.zeros(len(samples)), specular_f0=none,
        specular_f90=none, specular_dip=none, dielectric=none + 1.0, ior=np.full(len(samples), 1.5),
    )  # fmt: skip
    options = {"passes": ("specular",), "workers": 1, "rows": [0] * 6}
    both = shade(samples, lights, technique, **options).specular[0]
    expected = shade(samples.take(one), lights, "reference", **options).specular[0]
    np.testing.assert_allclose(both[one], expected, rtol=3e-3)
    alone = shade(samples.take(~one), lights, technique, **options).specular[0]
    np.testing.assert_allclose(both[~one], alone, rtol=1e-5, atol=1e-6)


def test_patches_have_all_of_the_light():
    """Radiance times solid angle, by sums over pixels that share no code with the trees."""
    taken = pictures()
    for light, picture in zip(sky_lights(LIKE, taken)[0], taken, strict=True):
        (lone,) = sky_lights(LIKE, [picture], 1)[0]
        weights = picture.solid_angles()
        assert weights.sum() == pytest.approx(4.0 * np.pi / 6.0, rel=1e-2)
        mean = (picture.radiance * weights[..., None]).sum(axis=(0, 1)) / weights.sum()
        np.testing.assert_allclose(lone.radiance, mean)
        np.testing.assert_allclose(light.radiance, mean)


def test_a_spot_is_found_and_taken_out_of_the_pictures():
    taken = pictures(64)
    taken[2].radiance[20:22, 30:32] = 4e4
    (spot,) = bright_spots(taken)
    expected = taken[2].offsets()[20:22, 30:32].mean(axis=(0, 1))
    np.testing.assert_allclose(spot.direction, expected / np.linalg.norm(expected), atol=2e-3)
    left = [without_spots(picture, [spot]).radiance.max() for picture in taken]
    assert max(left) <= 1.001 * spot.least and min(left) > 1.0
    ahead, right, up = spot_frame(spot)
    assert np.linalg.norm(right) == pytest.approx(np.tan(spot.radius))


def test_a_sky_that_is_nearly_constant_reflects_what_a_constant_one_does():
    """A hundredth of the radiance changes, so the map may differ from the closed form by a hundredth, also at the edges
    of sides that are constant. The rest of the tolerance is for lobes that are clamped."""
    samples = random_samples(400, seed=5)
    samples = replace(samples, geometric_normal=samples.normal)
    samples = samples.take(np.flatnonzero((samples.normal * samples.view).sum(axis=1) > 0.05))
    constant = [replace(one, radiance=np.ones_like(one.radiance)) for one in pictures(16)]
    nearly = [
        replace(one, radiance=one.radiance + (0.0 if one is constant[1] else 0.01 * np.sin(other.radiance)))
        for one, other in zip(constant, pictures(16), strict=True)
    ]
    lights = sky_lights(LIKE, nearly)[0]
    assert all(light.children for light in lights) and len(samples) > 200
    exact, found = (
        shade(samples, given, "ltsh4", passes=("specular",), workers=1).specular.sum(axis=0)
        for given in (sky_lights(LIKE, constant)[0], lights)
    )
    np.testing.assert_allclose(found, exact, rtol=0.012, atol=1e-3)


@pytest.mark.parametrize("kind", ["gradient", "steep", "window"])
def test_near_mirrors_show_a_sky_without_fine_detail(kind):
    """A lobe of roughness 0.05 is narrower than a degree; what it reflects is the radiance in its mirror direction."""
    radiance = {
        "gradient": lambda unit: 1.0 + 0.8 * unit[..., 2],
        "steep": lambda unit: 0.1 + np.exp(3.0 * unit[..., 2]),
        "window": lambda unit: 0.1 + 5.0 * ((unit[..., 0] > 0.8) & (np.abs(unit[..., 1]) < 0.3)),
    }[kind]
    sides = [SkyPicture(*axes, np.zeros((256, 256, 3))) for axes in CUBE]
    units = (side.offsets() / np.linalg.norm(side.offsets(), axis=-1, keepdims=True) for side in sides)
    sides = [replace(side, radiance=np.repeat(radiance(unit)[..., None], 3, -1))
             for side, unit in zip(sides, units, strict=True)]  # fmt: skip
    lights, _ = sky_lights(LIKE, sides)
    samples = random_samples(300, seed=5, lowest_roughness=0.25)
    white, none = np.ones((300, 3)), np.zeros((300, 3))
    samples = replace(
        samples, normal=samples.view, smooth_normal=samples.view, geometric_normal=samples.view,
        roughness=np.full(300, 0.05), specular_f0=white, specular_f90=white, dielectric=none, diffuse_albedo=none,
    )  # fmt: skip
    expected = radiance(samples.view)
    together = np.zeros(len(lights), int)
    error = np.abs(shade(samples, lights, "ltsh4", rows=together).specular[0, :, 0] - expected).mean() / expected.mean()
    is_smooth = fine_detail(sides) <= 0.01
    # The patches are within 2 % of the sky on average, and the map that is interpolated between them is nearer.
    assert is_smooth == (kind != "window") and (error < 0.01) == is_smooth, (fine_detail(sides), error)
