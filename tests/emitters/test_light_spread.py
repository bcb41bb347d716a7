"""Lights with a spread, against sums over patches of their surface."""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest
import quadrature
from precisions import PROMISED, techniques
from surface_scenes import all_kinds_of_samples, area_light, four_lights, random_samples, single_sample, unit

from ltsh_addon import shading
from ltsh_addon.emitters import light_profile, profile_regions

# Of a result, or of a hundredth of the largest one: what the spread of the closed forms may be off, and the reference.
CLOSED, QUADRATURE = 3e-3, 1e-3


def focused_lights(degrees):
    return [replace(light, spread=np.radians(degrees), radiance=np.ones(3)) for light in four_lights()]


def peak_factor(spread):
    """The factor straight ahead of the light, its largest value."""
    tangent, divisor = light_profile.spread_tangent(spread)
    return tangent / divisor


def cases(degrees, shape, count, seed=0, roughness=(0.2, 1.0)):
    """(sample, light): points in and around the cone, lobes on the light and beside it, lights above the horizon."""
    generator = np.random.default_rng(seed)
    found = []
    while len(found) < count:
        half, distance = np.array([0.5, 0.3]), 10.0 ** generator.uniform(-0.5, 0.5)
        reach = min(distance * np.tan(0.5 * np.radians(degrees)), 2.0)
        center = np.array([*(generator.uniform(-1.0, 1.0, 2) * (half + 0.7 * reach)), distance])
        options = {"half_u": (0.5, 0, 0), "half_v": (0, -0.3, 0), "radiance": (1, 1, 1)}
        light = area_light(shape=shape, center=center, spread=np.radians(degrees), **options)
        mirrored = unit(center + 0.3 * generator.normal(size=3) * np.array([1, 1, 0]))
        cosine = generator.uniform(0.2, 0.98)
        normal = cosine * mirrored + np.sqrt(1.0 - cosine**2) * unit(np.cross(mirrored, generator.normal(size=3)))
        view = 2.0 * (mirrored @ normal) * normal - mirrored
        if (light.polygon(64) @ normal).min() > 0.02:
            white = {"specular_f0": (1, 1, 1), "specular_f90": (1, 1, 1), "roughness": generator.uniform(*roughness)}
            found.append((single_sample(normal=normal, view=view, **white), light))
    return found


def lobe_of(table, directions, sample):
    """The table's lobe as a BRDF times cosine (1, S, 3) of one sample."""
    normal, view = sample.normal[0], sample.view[0]
    tangent = unit(view - (view @ normal) * normal)
    local = directions @ np.stack([tangent, np.cross(normal, tangent), normal]).T
    return shading.evaluate_lobe(table, [view @ normal], sample.roughness, local)[..., None] * np.ones(3)


def in_cone(sample, light):
    """The part of a rectangle around all that lights the point; other lights as they are."""
    if light.is_round:
        return light
    center, halves, offset = light.center, [], sample.position[0] - light.center
    for half in (light.half_u, light.half_v):
        size = np.linalg.norm(half)
        reach = (offset @ light.direction) * np.tan(0.5 * light.spread) / size
        low, high = np.clip(offset @ half / size**2 + np.array([-reach, reach]), -1.0, 1.0)
        center = center + 0.5 * (low + high) * half
        halves.append(0.5 * (high - low) * half)
    return replace(light, center=center, half_u=halves[0], half_v=halves[1])


def over_patches(brdf, pairs):
    """Radiances by sums over patches."""
    return [quadrature.radiance(sample, [in_cone(sample, light)], brdf, 300)[0, 0] for sample, light in pairs]


def assert_close(found, expected, tolerance, what):
    found, expected = np.array(found), np.array(expected)
    error = np.abs(found - expected) / np.maximum(expected, 0.01 * expected.max())
    assert error.max() < tolerance, (what, error.argmax(), found[error.argmax()], expected[error.argmax()])


@pytest.mark.parametrize(
    ("degrees", "shape", "name"),
    [(1.0, "RECTANGLE", "ltsh2"), (4.0, "RECTANGLE", "ltsh2"), (20.0, "RECTANGLE", "ltsh4"), (60.0, "ELLIPSE", "ltsh4"),
     (120.0, "RECTANGLE", "ltsh4"), (170.0, "ELLIPSE", "ltsh4")],
)  # fmt: skip
def test_lights_with_a_spread_match_patches(degrees, shape, name):
    """The closed forms in both precisions and the quadrature; the oracle leaves 1e-4."""
    pairs, table = cases(degrees, shape, 3, seed=int(degrees)), shading.load_table(name)

    def shaded(part, technique, dtype):
        rows = [shading.shade(sample, [light], technique, passes=[part], dtype=dtype) for sample, light in pairs]
        return [row.combined[0, 0] for row in rows]

    for part, brdf in (("specular", partial(lobe_of, table)), ("diffuse", quadrature.lambert)):
        expected = over_patches(brdf, pairs)
        for dtype in (np.float32, np.float64):
            assert_close(shaded(part, table, dtype), expected, CLOSED, (part, dtype))
    found = shaded("specular", shading.REFERENCE, np.float64)
    assert_close(found, over_patches(quadrature.ggx, pairs), QUADRATURE, "true lobe")


PLACES = {
    "rectangle": {"shape": "RECTANGLE"},
    "disk": {"shape": "DISK"},
    "long ellipse": {"shape": "ELLIPSE", "half_u": (1.6, 0, 0), "half_v": (0, -0.2, 0)},
}
SHEARED = {"shape": "RECTANGLE", "half_u": (0.5, 0, 0), "half_v": (0.6, -0.4, 0)}


@pytest.mark.parametrize("place", PLACES)
@pytest.mark.parametrize("degrees", [15.0, 60.0, 120.0])
def test_few_points_of_a_light_are_as_good_as_many(place, degrees, monkeypatch):
    """Of all places 99 in 100 within 0.3 %, or of a hundredth of the largest value, and 0.2 % in L2."""
    samples = random_samples(150, seed=8, lowest_roughness=0.15)
    options = {**PLACES[place], "spread": np.radians(degrees), "radiance": (1, 1, 1)}
    lights = [area_light(center=(x, 0.4, 1.5), **options) for x in (0, 1)]
    assert all(profile_regions.ProfileRegions.suit(light) for light in lights)
    few = shading.shade(samples, lights, "ltsh4", workers=1)

    def all_dense(regions):
        lit = np.nonzero((regions.high > regions.low) & (regions.highest > regions.lowest))[0]
        yield 60, profile_regions.GRADED, lit

    monkeypatch.setattr(profile_regions.ProfileRegions, "rules", all_dense)
    many = shading.shade(samples, lights, "ltsh4", workers=1)
    for part in shading.PASSES:
        found, expected = getattr(few, part)[0, :, 0], getattr(many, part)[0, :, 0]
        error = np.abs(found - expected)
        assert np.linalg.norm(error) < 2e-3 * np.linalg.norm(expected) and expected.max() > 0.0, part
        assert np.quantile(error / np.maximum(expected, 0.01 * expected.max()), 0.99) < CLOSED, part


@pytest.mark.parametrize("place", [PLACES["long ellipse"], SHEARED], ids=["long ellipse", "sheared"])
def test_points_of_long_and_sheared_lights_are_where_those_are(place):
    """By many points of the light itself, which leave 0.1 % at its edges."""
    light = area_light(spread=np.radians(80.0), center=(0.3, 0.4, 1.5), radiance=(1, 1, 1), **place)
    samples = replace(random_samples(60, seed=4), diffuse_albedo=np.ones((60, 3)))
    samples = replace(samples, smooth_normal=samples.diffuse_normal)
    found = shading.shade(samples, [light], "ltc", passes=["diffuse"], workers=1).diffuse[0, :, 0]
    points, areas = dense_points(light, 300)
    tangent, share = light_profile.spread_tangent(light.spread)
    expected = np.empty(60)
    for row, (position, normal) in enumerate(zip(samples.position, samples.diffuse_normal, strict=True)):
        offset = points - position
        squares, ahead = (offset * offset).sum(axis=1), np.maximum(-offset @ light.direction, 1e-9)
        factor = np.maximum(tangent - np.sqrt(np.maximum(squares - ahead * ahead, 0.0)) / ahead, 0.0) / share
        expected[row] = (np.maximum(offset @ normal, 0.0) * ahead * factor / squares**2) @ areas / np.pi
    error = np.abs(found - expected) / np.maximum(expected, 0.01 * expected.max())
    assert np.quantile(error, 0.95) < CLOSED and error.max() < 3.0 * CLOSED and expected.max() > 0.0


@pytest.mark.parametrize("shape", ["RECTANGLE", "DISK"])
@pytest.mark.parametrize("degrees", [3.0, 45.0, 90.0])
def test_the_spread_keeps_the_flux(degrees, shape):
    """A floor below the light receives pi times area times radiance, whatever the spread."""
    light = area_light(shape=shape, half_u=(0.4, 0, 0), half_v=(0, -0.4, 0), center=(0, 0, 1.0), radiance=(1, 1, 1))
    light = replace(light, spread=np.radians(degrees))
    reach = 0.42 + np.tan(0.5 * light.spread)
    steps = (np.arange(50) + 0.5) / 25 - 1.0
    x, y = (reach * grid.ravel() for grid in np.meshgrid(steps, steps))
    samples = repeated(single_sample(diffuse_albedo=(np.pi,) * 3), np.stack([x, y, 0 * x], axis=1))
    flux = shading.shade(samples, [light], "ltc", passes=["diffuse"]).diffuse.sum(axis=(0, 1))[0]
    area = 0.16 * (4.0 if shape == "RECTANGLE" else np.pi)
    # 50 x 50 points over the cone's footprint, and the spread's own error
    assert flux * (reach / 25) ** 2 == pytest.approx(np.pi * area, rel=2e-3)


def repeated(sample, position):
    """The one sample at each of the positions (P, 3)."""
    fields = {name: np.repeat(getattr(sample, name), len(position), axis=0) for name in sample.__dataclass_fields__}
    return type(sample)(**{**fields, "position": position})


@pytest.mark.parametrize("degrees", [2.0, 100.0])
@pytest.mark.parametrize("name", shading.SHIPPED_TABLES)
def test_single_precision_keeps_its_promise(name, degrees):
    """Horizons and all Fresnel terms; the promise is per unit of the radiance straight ahead, and 0.3 %."""
    samples, lights = all_kinds_of_samples(40, seed=5), focused_lights(degrees)
    samples = replace(samples, smooth_normal=samples.diffuse_normal)
    single = shading.shade(samples, lights, name, workers=1)
    double = shading.shade(samples, lights, name, workers=1, dtype=np.float64)
    limit = PROMISED * peak_factor(np.radians(degrees))
    for part in shading.PASSES:
        found, expected = getattr(single, part), getattr(double, part)
        assert np.isfinite(found).all() and (found >= 0.0).all() and expected.max() > 0.0
        assert (np.abs(found - expected) < limit + CLOSED * expected).all(), part


@techniques
def test_a_spread_of_pi_is_no_spread(technique):
    """Just below pi the factor differs from 1 by tan(theta) times what is missing."""
    samples = random_samples(30, seed=3)
    full, almost = (
        shading.shade(samples, focused_lights(degrees), technique, dtype=np.float64) for degrees in (180.0, 179.99)
    )
    scale = full.combined.max()
    assert np.abs(full.combined - almost.combined).max() < 1e-3 * scale
    assert not np.array_equal(full.combined, almost.combined)


@techniques
@pytest.mark.parametrize("degrees", [1.0, 60.0, 170.0])
def test_hostile_places_give_finite_radiance(technique, degrees):
    """On the light's axis, at its edge and corner, in its plane, on its surface, mirrors, grazing views."""
    places = [(0, 0, 0), (1, 0, 0), (1, 0.6, 0), (1, 0.6, 2.9999), (0.2, 0.1, 3), (4, 0, 3), (0, 0, 2.999999)]
    places.append((9, 9, 0))
    for shape in ("RECTANGLE", "DISK"):
        light = area_light(shape=shape, spread=np.radians(degrees), radiance=(1, 1, 1))
        for roughness, view in ((0.0, (0, 0, 1)), (0.3, (1, 0, 1e-7)), (1.0, (0.3, 0.2, 1))):
            white = {"specular_f0": (1, 1, 1), "specular_f90": (1, 1, 1)}
            sample = single_sample(view=view, roughness=roughness, **white)
            samples = repeated(sample, np.array(places, dtype=float))
            radiance = shading.shade(samples, [light], technique, workers=1).combined
            assert np.isfinite(radiance).all() and (radiance >= 0.0).all()
            assert radiance.max() < 3.0 * peak_factor(light.spread)
            # The last one is outside of every cone but the widest.
            assert degrees == 170.0 or not radiance[-1].any()


def test_polygons_have_no_spread():
    corners = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]])
    with pytest.raises(ValueError, match="spread is 1.0 rad, expected pi for shape POLYGON"):
        area_light(shape="POLYGON", corners=corners, spread=1.0)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_a_horizon_beyond_the_cone_changes_nothing(dtype):
    """Of a light that the horizon cuts the point sees what the part in its cone alone, a light of its own, shows it."""
    random = np.random.default_rng(5)
    reach, checked = np.tan(np.radians(2.0)), 0
    white = {"specular_f0": (1, 1, 1), "specular_f90": (1, 1, 1), "roughness": 0.6}
    for _ in range(40):
        # Turned, so that no coordinate is exact.
        axes = np.linalg.qr(random.normal(size=(3, 3)))[0]
        axes[2] *= np.linalg.det(axes)
        normal = unit(np.array([*random.uniform(-1.0, 1.0, 2), 0.6]) @ axes)
        view = unit(normal + 0.9 * unit(random.normal(size=3)))
        center = np.array([*random.uniform(-0.95, 0.95, 2), 1.0])
        whole, part = (
            area_light(
                center=place @ axes,
                half_u=size * axes[0],
                half_v=-size * axes[1],
                direction=-axes[2],
                radiance=(1, 1, 1),
                spread=np.radians(4.0),
            )
            for place, size in ((center, 1.0), (np.array([0.0, 0.0, 1.0]), 1.1 * reach))
        )
        is_cut = (whole.polygon() @ normal).min() < 0.0 and (part.polygon() @ normal).min() > 0.1
        if is_cut and view @ normal > 0.1:
            sample = single_sample(normal=normal, view=view, **white)
            found, expected = (
                shading.shade(sample, [light], "ltsh2", workers=1, dtype=dtype).specular[0, 0]
                for light in (whole, part)
            )
            np.testing.assert_allclose(found, expected, rtol=CLOSED)
            checked += 1
    assert checked > 15


def test_a_sheared_ellipse_is_the_ellipse_that_it_is():
    """By other axes of the same surface, which are not at right angles."""
    u, v, turn = np.array([0.5, 0.1, 0.0]), np.array([0.05, -0.4, 0.0]), 0.6
    sheared = replace(area_light(shape="ELLIPSE", half_u=u, half_v=v, center=(0, 0, 2.0)), spread=np.radians(70.0))
    other = {"half_u": np.cos(turn) * u + np.sin(turn) * v, "half_v": np.cos(turn) * v - np.sin(turn) * u}
    samples = random_samples(60, seed=8)
    one, two = (
        shading.shade(samples, [light], "ltsh4", workers=1).combined for light in (sheared, replace(sheared, **other))
    )
    # Each is a polygon, with the error of a spread.
    np.testing.assert_allclose(one, two, rtol=CLOSED, atol=CLOSED * one.max())
    assert one.any()


def test_bump_maps_shadow_every_part_of_a_light_with_a_spread():
    """Against dense points; double precision, which takes the mean direction, is 0.3 % off them."""
    samples, lights = all_kinds_of_samples(60, seed=5), focused_lights(100.0)
    found = shading.shade(samples, lights, "ltc", passes=["diffuse"], workers=1).diffuse.sum(axis=0)
    expected = np.zeros_like(found)
    for light in lights:
        points, areas = dense_points(light)
        offset = points[:, None] - samples.position
        distance = np.linalg.norm(offset, axis=-1)
        offset /= distance[..., None]
        height, smooth, away = (
            np.maximum((offset * axis).sum(axis=-1), 1e-9)
            for axis in (samples.diffuse_normal, samples.smooth_normal, -light.direction)
        )
        is_bumped = (samples.diffuse_normal != samples.smooth_normal).any(axis=1)
        shadowing = 2.0 / (1.0 + np.sqrt(1.0 + is_bumped * samples.bump_alpha2 * (smooth**-2 - 1.0)))
        half = np.tan(0.5 * light.spread)
        focus = np.maximum(half - np.sqrt(1.0 - np.minimum(away, 1.0) ** 2) / away, 0.0) / (half - 0.5 * light.spread)
        values = height * shadowing * away * focus / (np.pi * distance**2) * (smooth > 1e-9)
        expected += (areas * values.T).sum(axis=1)[:, None] * light.radiance * samples.diffuse_albedo
    assert np.linalg.norm(found - expected) < 1.5e-3 * np.linalg.norm(expected)


def dense_points(light, count=160):
    """Points (N, 3) of a light, and the area that each stands for."""
    place = (np.arange(count) + 0.5) / count * 2.0 - 1.0
    s, t = (grid.ravel() for grid in np.meshgrid(place, place))
    if light.is_round:
        s, t = (s[s * s + t * t < 1.0], t[s * s + t * t < 1.0])
    points = light.center + s[:, None] * light.half_u + t[:, None] * light.half_v
    return points, np.full(len(points), np.linalg.norm(light.area_vector) / len(points))
