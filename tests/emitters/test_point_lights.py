"""Lights that are infinitely far away, and lights that face every sample."""

from dataclasses import replace

import numpy as np
import pytest
import quadrature
from surface_scenes import area_light, random_samples, unit

from ltsh_addon import shading
from ltsh_addon.emitters.facing import cone_angle, pattern_values
from ltsh_addon.scene import Pattern, SpotCone, light_of


def distant_lights():
    """One of each shape, in all directions."""
    return [
        area_light("R", "RECTANGLE", (0.3, 0.2, 3.0), is_distant=True),
        area_light("D", "DISK", (2.6, 1.0, 1.0), (0.0, 0.5, 0.0), (0.0, 0.0, -0.5), is_distant=True),
        area_light("F", "RECTANGLE", (-3.0, 0.5, 0.4), (0.0, 0.7, 0.0), (0.0, 0.0, 0.7), is_distant=True),
    ]


@pytest.mark.parametrize(
    ("technique", "dtype"), [("ltsh4", np.float32), ("ltsh4", np.float64), ("ltc", np.float32), ("reference", None)]
)
def test_every_point_sees_a_distant_light_as_the_origin_does(technique, dtype):
    """Exactly what a light nearby gives to samples that all lie at the origin."""
    samples, options = random_samples(40, lowest_roughness=0.02), {} if dtype is None else {"dtype": dtype}
    here = replace(samples, position=np.zeros_like(samples.position))
    for light in distant_lights():
        found = shading.shade(samples, [light], technique, workers=1, **options)
        expected = shading.shade(
            here, [light_of(light.record() | {"is_distant": False})], technique, workers=1, **options
        )
        assert np.array_equal(found.specular, expected.specular) and found.specular.any()
        assert np.array_equal(found.diffuse, expected.diffuse) and found.diffuse.any()


@pytest.mark.parametrize("options", [{"spread": 1.0}, {"falloff": 1}])
def test_distant_lights_have_no_profile(options):
    with pytest.raises(ValueError, match="it has (spread|falloff), expected none for a SkyLight"):
        area_light("D", "RECTANGLE", (0.0, 0.0, 3.0), is_distant=True, **options)


def facing_light(shape="BALL", radius=0.4, center=(0.3, 0.2, 2.5), **options):
    light = area_light("B", shape, center, (radius, 0.0, 0.0), (0.0, radius, 0.0), **options)
    return replace(light, radiance=light.radiance / radius**2)


def spot(**options):
    """A light whose cone points about to the origin, wider along one axis."""
    turn = rotation_to((0.0, 0.0, 1.0), (0.3, 0.2, 2.5))
    axes = np.diag([1.0, 1.4, 1.0]) @ turn.T
    cosine = np.cos(0.35)
    return facing_light(cone=SpotCone(axes, cosine, 1.0 / (0.4 * (1.0 - cosine))), **options)


def rotation_to(start, end):
    """A rotation that turns one vector into the direction of another."""
    start, end = unit(np.asarray(start)), unit(np.asarray(end))
    half = unit(start + end)
    return (2.0 * np.outer(half, half) - np.eye(3)) @ (2.0 * np.outer(start, start) - np.eye(3))


def oracle(samples, light, brdf, count=160):
    """Radiance (P, 3) by midpoints of equal solid angles of the cone in which a light is seen, written out."""
    offset = light.center - samples.position
    distance = np.linalg.norm(offset, axis=1, keepdims=True)
    radius = np.linalg.norm(light.half_u)
    sine = radius / (distance if light.is_sphere else np.hypot(distance, radius))
    inside = light.is_sphere and (distance < radius).all()
    least = -1.0 if inside else np.sqrt(1.0 - sine**2)
    steps = (np.arange(count) + 0.5) / count
    cosine, angle = (grid.ravel() for grid in np.meshgrid(steps, 2.0 * np.pi * steps))
    cosine = 1.0 - (1.0 - least) * cosine
    axis = unit(offset)
    u = unit(np.cross(axis, [0.3, -0.5, 0.8]))
    v = np.cross(axis, u)
    across = np.cos(angle)[:, None] * u[:, None] + np.sin(angle)[:, None] * v[:, None]
    directions = cosine[..., None] * axis[:, None] + np.sqrt(1.0 - cosine**2)[..., None] * across
    factor = np.broadcast_to(1.0, directions.shape[:2])
    if light.cone is not None:
        x, y, z = np.moveaxis(directions @ light.cone.axes.T, -1, 0)
        share = np.clip((z / np.sqrt(x * x + y * y + z * z) - light.cone.cosine) * light.cone.sharpness, 0.0, 1.0)
        factor = factor * (3.0 * share**2 - 2.0 * share**3)
    if light.falloff or light.smooth:
        length = distance * cosine - np.sqrt(radius**2 - distance**2 * (1.0 - cosine**2))
        factor = factor * length**light.falloff * length**2 / (length**2 + light.smooth)
    whole = 2.0 * np.pi * (1.0 - least) / count**2
    values = brdf(directions, samples) * (factor * whole)[..., None]
    above = np.einsum("psk,pk->ps", directions, samples.geometric_normal) > 0.0
    return (values * above[..., None]).sum(axis=1) * light.radiance


def lit_samples(count, light, seed=0):
    """Samples that face the light, all of which is above their horizons."""
    samples = random_samples(6 * count, seed=seed, lowest_roughness=0.3)
    samples = replace(samples, diffuse_normal=samples.normal, smooth_normal=samples.normal)
    toward = unit(light.center - samples.position)
    chosen = ((samples.normal * toward).sum(axis=1) > 0.5) & ((samples.normal * samples.view).sum(axis=1) > 0.2)
    return samples.take(np.flatnonzero(chosen)[:count])


KINDS = {
    "ball": facing_light(),
    "disk": facing_light("FACING_DISK"),
    "spot": spot(),
    "spot disk": spot(shape="FACING_DISK"),
    "small": facing_light(radius=1e-3),
    "smooth": facing_light(falloff=1, smooth=0.5),
}


@pytest.mark.parametrize("kind", KINDS)
def test_the_reference_integrates_lights_that_face_every_point(kind):
    light = KINDS[kind]
    samples = lit_samples(24, light)
    found = shading.shade(samples, [light], "reference", workers=1)
    assert np.allclose(found.specular[0], oracle(samples, light, quadrature.ggx), rtol=2e-3, atol=1e-4)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("kind", KINDS)
def test_form_factors_of_lights_that_face_every_point(kind, dtype):
    light = KINDS[kind]
    samples = lit_samples(60, light)
    found = shading.shade(samples, [light], "ltsh4", passes=["diffuse"], workers=1, dtype=dtype).diffuse[0]
    expected = oracle(samples, light, quadrature.lambert)
    error = np.linalg.norm(found - expected) / np.linalg.norm(expected)
    assert expected.any() and error < 2e-3


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_within_a_ball_light_comes_from_everywhere(dtype):
    light = facing_light(radius=20.0)
    samples = random_samples(20, lowest_roughness=0.3)
    samples = replace(samples, diffuse_normal=samples.normal, smooth_normal=samples.normal)
    found = shading.shade(samples, [light], "ltsh4", workers=1, dtype=dtype)
    assert np.allclose(found.diffuse[0], samples.diffuse_albedo * light.radiance, rtol=1e-4, atol=1e-6)
    expected = oracle(samples, light, quadrature.ggx, 250)
    assert np.linalg.norm(found.specular[0] - expected) < 0.01 * np.linalg.norm(expected)


@pytest.mark.parametrize("kind", KINDS)
def test_both_precisions_agree_about_lights_that_face_every_point(kind):
    """And both with the reference as far as the table goes."""
    light = KINDS[kind]
    samples = lit_samples(200, light, seed=1)
    single, double = (
        shading.shade(samples, [light], "ltsh4", workers=1, dtype=dtype).specular[0]
        for dtype in (np.float32, np.float64)
    )
    # Small lights are shaded by their centers in single precision, see `small_lights`.
    assert np.abs(single - double).max() < (3e-3 if kind == "small" else 2e-4) * double.max()
    expected = shading.shade(samples, [light], "reference", passes=["specular"], workers=1).specular[0]
    assert np.linalg.norm(double - expected) < 0.015 * np.linalg.norm(expected)


@pytest.mark.parametrize("by_ray", [False, True])
def test_patterns_are_read_by_direction_and_survive_json(by_ray):
    """A pattern 1 + v_x / 2: within a ball's outline the normals, or the rays, are what it goes by."""
    polar, around = (np.arange(64) + 0.5)[:, None] * (np.pi / 64), (np.arange(128) + 0.5) * (2.0 * np.pi / 128)
    axes = rotation_to((0.0, 0.0, 1.0), (0.2, 1.0, 0.4))
    pattern = Pattern(axes, 1.0 + 0.5 * np.sin(polar) * np.cos(around), by_ray)
    light = replace(KINDS["ball"], pattern=pattern)
    record = light_of(light.record()).pattern
    assert np.array_equal(record.values, pattern.values) and record.by_ray == by_ray
    samples = lit_samples(12, light)
    found = shading.shade(samples, [light], "reference", passes=["specular"], workers=1).specular[0]

    def weighted(directions, samples):
        offset = (light.center - samples.position)[:, None]
        squared = (offset**2).sum(axis=-1)
        along = (directions * offset).sum(axis=-1)
        length = along - np.sqrt(np.maximum(along**2 - squared + 0.16, 0.0))
        normal = -directions if by_ray else unit(length[..., None] * directions - offset)
        return quadrature.ggx(directions, samples) * (1.0 + 0.5 * normal @ axes[0])[..., None]

    expected = oracle(samples, KINDS["ball"], weighted)
    assert np.allclose(found, expected, rtol=5e-3, atol=2e-3 * expected.max())


@pytest.mark.parametrize("darkest", [0.0, 0.25])
@pytest.mark.parametrize("shape", ["BALL", "FACING_DISK"])
def test_sharp_patterns_across_a_light(shape, darkest):
    """Checks, each some 0.4 of the light wide: a point sees many edges. The mean over 512 points of a light misses by
    half of the points' distance times the length of the edges, here about 1 %; rules for smooth changes missed 4 %."""
    polar, around = np.meshgrid((np.arange(1024) + 0.5) * np.pi / 1024, np.arange(2048) * np.pi / 1024, indexing="ij")
    checks = (polar // 0.06).astype(int) + (around // 0.06).astype(int)
    pattern = Pattern(rotation_to((0.0, 0.0, 1.0), (0.2, 1.0, 0.4)), np.where(checks % 2, 1.0, darkest), True)
    light = replace(facing_light(shape), pattern=pattern)
    samples = lit_samples(40, light)
    found = shading.shade(samples, [light], "reference", passes=["diffuse"], workers=1).diffuse[0]

    def weighted(directions, samples):
        values = pattern_values(pattern, -np.moveaxis(directions, -1, 0))
        return quadrature.lambert(directions, samples) * values[..., None]

    expected = oracle(samples, facing_light(shape), weighted)
    assert np.sqrt(np.square(found - expected).sum() / np.square(expected).sum()) < 0.015


def test_no_light_of_a_sheared_cone_is_outside_of_its_angle():
    random = np.random.default_rng(0)
    turns = np.linspace(0.0, 2.0 * np.pi, 500)
    for half_angle in np.linspace(0.02, 1.57, 50):
        axes = np.eye(3) + random.uniform(-0.5, 0.5, (3, 3))
        rim = np.stack([np.cos(turns), np.sin(turns), np.full(500, 1.0 / np.tan(half_angle))])
        rim, axis = np.linalg.solve(axes, rim), np.linalg.solve(axes, [0.0, 0.0, 1.0])
        cosine = axis @ rim / np.linalg.norm(axis) / np.linalg.norm(rim, axis=0)
        # Rounding alone.
        assert cone_angle(SpotCone(axes, np.cos(half_angle), 1.0)) >= np.arccos(cosine.min()) - 1e-9
