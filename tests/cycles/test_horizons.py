"""Horizons that end lobes, and normals as Cycles bends them."""

from dataclasses import replace

import numpy as np
import pytest
from surface_scenes import shifted

from ltsh_addon import shading
from ltsh_addon.cycles import horizons
from ltsh_addon.cycles.environment import CUBE
from ltsh_addon.cycles.gbuffer import coarse_meshes
from ltsh_addon.cycles.horizons import end_at_horizons_of_cycles
from ltsh_addon.cycles.light_tree import light_bounds_at, light_selection_pmf, light_tree_rows
from ltsh_addon.scene import EllipseLight, PointLight, PolygonLight, QuadLight, SkyLight, SurfaceSamples


def samples_near_the_horizon(roughness, view=(-0.96, 0.0, 0.28), count=4):
    """Points at the origin, seen obliquely, whose geometric and smooth normals differ."""
    tilted, up = np.array([-0.1, 0.0, 1.0]) / np.hypot(0.1, 1.0), np.array([0.0, 0.0, 1.0])
    view = np.array(view)
    vectors = {"view": view, "normal": up, "diffuse_normal": up, "smooth_normal": up, "geometric_normal": tilted}
    zero = np.zeros((count, 3))
    return SurfaceSamples(
        **{name: np.tile(vector, (count, 1)) for name, vector in vectors.items()},
        position=zero,
        roughness=np.full(count, roughness),
        specular_f0=zero + 1.0,
        specular_f90=zero + 1.0,
        dielectric=zero,
        ior=np.full(count, 1.5),
        diffuse_albedo=zero,
    )


def light_at(distance, half):
    """A square light on the x axis that faces the origin, its center on the horizon."""
    axes = {"half_u": (0.0, half, 0.0), "half_v": (0.0, 0.0, half), "direction": (-1.0, 0.0, 0.0)}
    return QuadLight("Light", (distance, 0.0, 0.0), radiance=(1.0, 1.0, 1.0), **axes)


@pytest.mark.parametrize(
    "roughness, view, light, share",
    [
        (0.6, (-0.96, 0.0, 0.28), (3.0, 0.3), 1.0),
        # The mirror direction is 3 degrees above the horizon: 45 per sr for the lobe's choice, 0.2 for the light's.
        (0.15, (-0.9987, 0.0, 0.05), (0.5, 3.0), 0.0),
    ],
)
def test_rough_lobes_of_small_lights_end_at_the_smooth_horizon(roughness, view, light, share):
    samples = samples_near_the_horizon(roughness, view)
    found, index = end_at_horizons_of_cycles(samples, (light_at(*light),))
    at_smooth = (found.geometric_normal == samples.smooth_normal[index]).all(axis=1)
    assert np.abs(found.specular_f0[at_smooth].sum(axis=0) / 4.0 - share).max(initial=0.0) < 0.02


def test_samples_that_are_split_add_up():
    samples = samples_near_the_horizon(0.3, (-0.99, 0.0, 0.14))
    samples = replace(samples, diffuse_albedo=np.full((4, 3), 0.5), dielectric=np.full((4, 3), 0.7))
    found, index = end_at_horizons_of_cycles(samples, (light_at(2.0, 0.6),))
    assert index.tolist() == [0, 0, 1, 1, 2, 2, 3, 3]
    for name in ("specular_f0", "specular_f90", "dielectric", "diffuse_albedo"):
        assert np.allclose(getattr(found, name)[::2] + getattr(found, name)[1::2], getattr(samples, name), atol=1e-12)
    assert not found.diffuse_albedo[1::2].any()
    assert np.array_equal(found.geometric_normal[::2], samples.geometric_normal)
    assert np.array_equal(found.geometric_normal[1::2], samples.smooth_normal)


def test_chances_of_two_lights_are_those_of_their_irradiance_where_they_are_far_away():
    """Bounds of small lights meet: the light sends its power times both cosines by the squared distance."""
    samples = samples_near_the_horizon(0.5, count=1)
    places = [(0.6, 0.0, 0.8, 50.0), (0.0, 0.8, 0.6, 100.0)]
    lights = []
    for number, (x, y, z, distance) in enumerate(places):
        light = light_at(1.0, 0.1 * (number + 1))
        toward = np.array([x, y, z])
        side = np.cross(toward, (0.0, 1.0, 0.0) if y == 0.0 else (1.0, 0.0, 0.0))
        half = 0.1 * (number + 1)
        placed = {"center": toward * distance, "half_u": half * side, "half_v": half * np.cross(toward, side)}
        lights.append(replace(light, **placed, direction=-toward))
    expected = np.array([(number + 1) ** 2 * z / distance**2 for number, (*_, z, distance) in enumerate(places)])
    found = light_selection_pmf(samples.position, samples.smooth_normal, tuple(lights))
    # The lights reach 0.34 degrees, of which the cosines' slopes make up to 1 %.
    assert np.allclose(found[:, 0], expected / expected.sum(), rtol=0.01)


@pytest.mark.parametrize("count, loses", [(1, False), (2, False), (9, True), (30, True), (70, False)])
def test_chances_of_lights_add_up(count, loses):
    """To 1 where there is one leaf; in a tree one may go down to where no light shines on the point."""
    generator = np.random.default_rng(count)
    normal = horizons.unit(generator.normal(size=(50, 3)))
    lights = tuple(replace(light_at(2.0, 0.2), center=generator.normal(size=3) + (4.0, 0.0, 0.0)) for _ in range(count))
    sums = light_selection_pmf(np.zeros((50, 3)), normal, lights).sum(axis=0)
    assert sums.max() < 1.0 + 1e-5 and (sums > 0.0).mean() > 0.4
    assert (sums[sums > 0.0].min() > 1.0 - 1e-5) != loses


def lights_around(generator, count, **fields):
    """Square lights of 0.2 to 2 m, any way around, from 3 to 10 m away from the origin."""
    axes = np.linalg.qr(generator.normal(size=(count, 3, 3)))[0]
    center = horizons.unit(generator.normal(size=(count, 3))) * generator.uniform(3.0, 10.0, size=(count, 1))
    halves = generator.uniform(0.1, 1.0, size=count)
    return tuple(
        replace(light_at(1.0, 1.0), center=c, half_u=h * u, half_v=h * v, direction=n, radiance=(h, h, h), **fields)
        for c, h, (u, v, n) in zip(center, halves, axes, strict=True)
    )


def samples_around(generator, count):
    """Points near the origin that are seen from anywhere, smooth and true normals up to some 30 degrees apart."""
    samples = samples_near_the_horizon(0.4, count=count)
    smooth = horizons.unit(generator.normal(size=(count, 3)))
    true = horizons.unit(smooth + 0.3 * generator.normal(size=(count, 3)))
    view = horizons.unit(generator.normal(size=(count, 3)) + 1.5 * smooth)
    fields = {"smooth_normal": smooth, "geometric_normal": true, "normal": smooth, "diffuse_normal": smooth}
    return replace(samples, position=0.3 * generator.normal(size=(count, 3)), view=view, **fields)


def sides_of_the_sky(brightness=range(1, 7)):
    """The cube that the light of a world makes."""
    like = SkyLight.like(light_at(1.0, 1.0))
    return tuple(
        replace(like, center=ahead, half_u=right, half_v=up, direction=-ahead, radiance=(b, b, b))
        for (ahead, right, up), b in zip(CUBE, brightness, strict=True)
    )


@pytest.mark.parametrize("kind", ["square", "sheared", "ellipse", "polygon", "distant", "ball", "disk", "sky"])
def test_directions_between_the_horizons_meet_the_lights_that_stand_there(kind):
    """As a test of each direction with each light finds, one by one."""
    generator = np.random.default_rng(3)
    samples, lights = samples_around(generator, 12), lights_around(generator, 200)
    if kind == "distant":
        lights = tuple(SkyLight.like(light) for light in lights)
    if kind == "sheared":
        lights = tuple(QuadLight.like(light, half_v=light.half_v + 0.5 * light.half_u) for light in lights)
    if kind == "ellipse":
        lights = tuple(EllipseLight.like(light, half_v=0.5 * light.half_v) for light in lights)
    if kind == "polygon":
        lights = tuple(PolygonLight.like(light, corners=light.polygon()) for light in lights)
    if kind in ("ball", "disk"):
        lights = tuple(PointLight.like(light, shape="BALL" if kind == "ball" else "FACING_DISK") for light in lights)
    if kind == "sky":
        lights = sides_of_the_sky()[:5]
    shape = horizons._LightsOfKind.of(lights, np.arange(len(lights)), np.ones(len(lights)))
    assert shape.is_side == (kind == "sky")
    directions = horizons._HorizonDirections.of(samples)
    number, sample, ray, brightness, _ = shape.hits(*shape.crossings(samples), samples.position, directions)
    assert np.array_equal(brightness, np.array([light.radiance.sum() for light in lights])[number])
    found = set(zip(number.tolist(), sample.tolist(), ray.tolist(), strict=True))
    expected = set()
    for index, light in enumerate(lights):
        offset = (light.center - light.viewpoint(samples.position))[:, None]
        towards = directions.towards
        if light.is_facing:
            # How far from the ball's center, or from that of the disk that is turned to the point, rays pass.
            distance, along = np.linalg.norm(offset, axis=2), (towards * offset).sum(axis=2)
            aside = np.linalg.norm(np.cross(towards, offset), axis=2)
            meets = (aside < light.radius) if kind == "ball" else (aside * distance < light.radius * along)
            meets &= along > 0.0
        else:
            steepness, u1 = towards @ light.direction, horizons.unit(light.half_u)
            place = (offset @ light.direction / steepness)[..., None] * towards - offset
            v = place @ (light.half_v - (light.half_v @ u1) * u1)
            v /= light.half_v @ light.half_v - np.square(light.half_v @ u1)
            u = place @ light.half_u / (light.half_u @ light.half_u) - (0.5 * v if kind == "sheared" else 0.0)
            within = u * u + v * v < 1.0 if kind == "ellipse" else np.maximum(np.abs(u), np.abs(v)) < 1.0
            meets = within & (steepness < 0.0) & (offset @ light.direction < 0.0)
        expected |= {(index, *pair) for pair in zip(*(part.tolist() for part in np.nonzero(meets)), strict=True)}
    assert found == expected and len(found) > 100


def test_rectangles_stand_for_thousands_of_lights(monkeypatch):
    """They leave as much to the smooth horizon, but for 5 % of the light between the horizons, which is little."""
    generator = np.random.default_rng(3)
    samples, lights = samples_around(generator, 100), lights_around(generator, 1500)
    chances = horizons.lobe_selection_pmf(samples, np.arange(100), False)
    found, sizes = [], []
    excess = horizons._excess
    monkeypatch.setattr(
        horizons, "_excess", lambda *args: sizes.append(sum(len(s.number) for s in args[1])) or excess(*args)
    )
    for most in (512, len(lights)):
        monkeypatch.setattr(horizons, "MOST_LIGHTS", most)
        found.append(np.array(horizons.horizon_excess(samples, lights, chances)))
    assert sizes[0] == 512 and sizes[-1] == 1500
    weight = found[1].sum(axis=0)
    few, all_of_them = (horizons.smooth_horizon_share(*own) for own in found)
    assert (weight * np.abs(few - all_of_them)).sum() < 0.05 * weight.sum() and np.ptp(all_of_them) > 0.9


def test_few_rectangles_for_thousands_of_lights_change_less_than_three_thousandths_of_the_light(monkeypatch):
    """Horizons of a ball of 48 segments are 3 degrees apart. The light between them is little, so that a coarse guess
    of who lets it through is enough."""
    generator = np.random.default_rng(3)
    samples, lights = samples_around(generator, 300), lights_around(generator, 1500)
    true = horizons.unit(samples.smooth_normal + 0.05 * generator.normal(size=(300, 3)))
    samples = replace(samples, geometric_normal=true)
    reflected = []
    for most in (horizons.MOST_LIGHTS, len(lights)):
        monkeypatch.setattr(horizons, "MOST_LIGHTS", most)
        ended, index = end_at_horizons_of_cycles(samples, lights, is_quick=True)
        light = shading.shade(ended, lights, "ltc", passes=("specular",), rows=[0] * len(lights), workers=1).specular[0]
        reflected.append(np.stack([np.bincount(index, color) for color in light.T]))
    assert 0.0 < np.linalg.norm(reflected[0] - reflected[1]) < 3e-3 * np.linalg.norm(reflected[1])


@pytest.mark.parametrize("is_quick", [False, True])
def test_a_few_directions_tell_where_lobes_end_under_a_sky(is_quick, monkeypatch):
    samples, lights = samples_around(np.random.default_rng(7), 300), sides_of_the_sky()
    chances, of = horizons.lobe_selection_pmf(samples, np.arange(300), is_baked=False), horizons._HorizonDirections.of
    few = horizons.smooth_horizon_share(*horizons.horizon_excess(samples, lights, chances, is_quick=is_quick))
    monkeypatch.setattr(horizons._HorizonDirections, "of", lambda samples, *few: of(samples))
    apart = few - horizons.smooth_horizon_share(*horizons.horizon_excess(samples, lights, chances))
    # Of what comes from between the horizons, itself a few percent of the light.
    assert np.sqrt(np.square(apart).mean()) < 0.05 and abs(apart.mean()) < 0.01, (apart.std(), apart.mean())


def test_quick_horizons_are_about_those_of_all_directions_and_split_less():
    samples, lights = samples_around(np.random.default_rng(11), 500), lights_around(np.random.default_rng(12), 200)
    chances = horizons.lobe_selection_pmf(samples, np.arange(500), is_baked=False)
    excess = np.array([horizons.horizon_excess(samples, lights, chances, is_quick=quick) for quick in (False, True)])
    share, quick = (horizons.smooth_horizon_share(*own) for own in excess)
    light = np.where(excess[0, 1] > 0.0, excess[0].sum(axis=0), 0.0)
    assert (light * np.abs(share - quick)).sum() < 0.05 * light.sum() and np.ptp(share) > 0.9
    whole, _ = end_at_horizons_of_cycles(samples, lights)
    found, index = end_at_horizons_of_cycles(samples, lights, is_quick=True)
    assert len(samples) < len(found) < 0.75 * len(whole)
    # What is not split loses nothing, and most of what splitting moves is where it belongs.
    sums = [np.bincount(index, found.specular_f0[:, 0]), samples.specular_f0[:, 0]]
    assert np.allclose(*sums, atol=1e-12)
    at_smooth = (found.geometric_normal == samples.smooth_normal[index]).all(axis=1)
    ended = np.bincount(index, found.specular_f0[:, 0] * at_smooth, 500)
    moved = (light * np.minimum(share, 1.0 - share)).sum()
    assert (light * np.abs(ended - quick)).sum() < 1.5 * horizons.UNSPLIT * moved


def test_bounds_of_thousands_of_lights_are_those_of_a_few():
    """Those are in double precision; squared distances and the sines of widths lose digits in single precision."""
    generator = np.random.default_rng(5)
    samples, lights = samples_around(generator, 30), lights_around(generator, 1000)
    far = np.array([3e3, -2e3, 1e3])
    position, lights = samples.position + far, tuple(shifted(light, far) for light in lights)
    rows = light_tree_rows(lights)
    found = light_bounds_at(position, samples.smooth_normal, lights, rows)
    few = [slice(start, start + 50) for start in range(0, 1000, 50)]
    expected = [light_bounds_at(position, samples.smooth_normal, lights[part], rows[part]) for part in few]
    expected = np.concatenate(expected)
    assert found.dtype == np.float32 and expected.dtype == np.float64
    assert (expected[:, 0] >= expected[:, 1] * (1.0 - 1e-12)).all() and (expected[:, 1] > 0.0).any()
    apart = np.abs(found - expected) > 1e-3 * expected.max(axis=(0, 1))
    # The least jumps to 0 where a light turns its face away from a part of the point's horizon.
    assert apart.mean() < 1e-3


def test_without_lights_or_differences_nothing_changes():
    samples = samples_near_the_horizon(0.5)
    assert end_at_horizons_of_cycles(samples, ())[0] is samples
    flat = replace(samples, geometric_normal=samples.smooth_normal)
    found, index = end_at_horizons_of_cycles(flat, (light_at(3.0, 0.3),))
    assert found is flat and index.tolist() == [0, 1, 2, 3]


def test_coarse_meshes_are_named_where_they_fill_the_picture():
    fine = samples_near_the_horizon(0.5, count=100)
    assert coarse_meshes(fine) == []
    normal = fine.geometric_normal.copy()
    normal[:50] = (np.sin(0.7), 0.0, np.cos(0.7))
    (line,) = coarse_meshes(replace(fine, geometric_normal=normal))
    assert "50 of 100 samples" in line and "35 degrees" in line


def test_reflections_of_valid_normals_leave_the_surface():
    """Independent of Cycles: the mirrored view ends exactly at the threshold, and good normals stay."""
    generator = np.random.default_rng(7)
    true_normal, view, normal = (horizons.unit(generator.normal(size=(4000, 3))) for _ in range(3))
    facing = np.sum(view * true_normal, axis=-1) > 0.02
    true_normal, view, normal = true_normal[facing], view[facing], normal[facing]
    valid = horizons.valid_specular_normal(normal, true_normal, view)
    assert np.allclose(np.linalg.norm(valid, axis=-1), 1.0, atol=1e-12)

    def elevation(axis):
        mirrored = 2.0 * np.sum(axis * view, axis=-1, keepdims=True) * axis - view
        return np.sum(mirrored * true_normal, axis=-1)

    threshold = np.minimum(0.9 * np.sum(view * true_normal, axis=-1), 0.01)
    good = elevation(normal) >= threshold
    assert np.array_equal(valid[good], normal[good]) and good.any() and not good.all()
    assert np.abs(elevation(valid) - threshold)[~good].max() < 1e-12
    # Bent in the plane of both normals, towards the true one.
    volume = np.linalg.det(np.stack([valid, normal, true_normal], axis=-2)[~good])
    assert np.abs(volume).max() < 1e-12
    assert np.all(np.sum(valid * true_normal, axis=-1)[~good] >= np.sum(normal * true_normal, axis=-1)[~good])


def test_bump_alpha_is_an_eighth_of_the_squared_tangent():
    angle = np.radians([0.0, 30.0, 60.0, 75.0, 90.0])
    up = np.tile([0.0, 0.0, 1.0], (5, 1))
    tilted = np.stack([np.sin(angle), np.zeros(5), np.cos(angle)], axis=-1)
    expected = [0.0, 1.0 / 24.0, 3.0 / 8.0, 1.0, 1.0]
    assert np.allclose(horizons.bump_alpha2(tilted, up), expected, atol=1e-12)
