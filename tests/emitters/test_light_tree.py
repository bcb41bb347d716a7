"""Many lights at once, against all of them one by one in double precision and against the quadrature."""

from dataclasses import replace

import numpy as np
import pytest
from kills import all_ended
from surface_scenes import area_light, random_samples, shifted, unit

from ltsh_addon import shading
from ltsh_addon.emitters import light_nodes, light_tree
from ltsh_addon.emitters.light_tree import LightTree
from ltsh_addon.scene import EllipseLight, PolygonLight, QuadLight
from ltsh_addon.shading import float32, integrator, lights32

# What the lights of a tree may be off together; degree 4 is itself off by ten times as much.
OFF = 3e-3


def many_lights(count, seed=1, **options):
    """Rectangles and disks of 0.2 to 0.6 m in all colors, 2 to 4 m over a floor of 20 m, most of them facing it."""
    generator = np.random.default_rng(seed)
    lights = []
    for number in range(count):
        direction = unit(np.array([0.0, 0.0, -1.0]) + 0.4 * generator.normal(size=3))
        u = generator.uniform(0.1, 0.3) * unit(np.cross(direction, [0.3, 1.0, 0.0]))
        place = np.append(generator.uniform(-10.0, 10.0, 2), generator.uniform(2.0, 4.0))
        shape = "DISK" if number % 3 == 0 else "RECTANGLE"
        color = generator.uniform(0.5, 1.0, 3)
        lights.append(
            area_light("Lamp", shape, place, u, np.cross(direction, u), direction=direction, radiance=color, **options)
        )
    return lights


def floor_samples(count, lowest_roughness, seed=2):
    """Random lobes on a floor of 20 m, bent by some tenths of a radian."""
    generator = np.random.default_rng(seed)
    samples = random_samples(count, seed, lowest_roughness)
    normal = unit(np.array([0.0, 0.0, 1.0]) + 0.2 * generator.normal(size=(count, 3)))
    position = np.append(generator.uniform(-10.0, 10.0, (count, 2)), np.zeros((count, 1)), axis=1)
    view = unit(normal + unit(generator.normal(size=(count, 3))) * generator.uniform(0.2, 0.9, size=(count, 1)))
    normals = dict.fromkeys(("normal", "diffuse_normal", "geometric_normal", "smooth_normal"), normal)
    return replace(samples, position=position, view=view, **normals)


def relative_error(found, expected):
    return np.linalg.norm(found - expected) / np.linalg.norm(expected)


@pytest.mark.parametrize("name", shading.PASSES)
def test_each_color_comes_from_where_its_lights_are(name):
    """A panel of 1 m, red on one side and green on the other, 1 m over a floor of 3 m: .5 % off where the points of a
    node share one color."""
    x, y = np.meshgrid(np.linspace(-1.5, 1.5, 40), np.linspace(-1.5, 1.5, 30))
    position, up = np.stack([x.ravel(), y.ravel(), 0.0 * x.ravel()], axis=1), np.tile([0.0, 0.0, 1.0], (x.size, 1))
    normals = dict.fromkeys(("normal", "diffuse_normal", "geometric_normal", "smooth_normal"), up)
    samples = replace(
        random_samples(1200, 1, 0.5), position=position, view=unit([0.0, -3.0, 2.0] - position), **normals
    )
    samples, lights, half = replace(samples, roughness=np.full(x.size, 0.6)), [], np.eye(3) / 32.0
    for x, y in np.ndindex(16, 16):
        color, center = (
            np.array([np.exp(-x / 3.0), np.exp(x / 3.0 - 5.0), 0.0]),
            np.array([(x - 7.5) / 16.0, (y - 7.5) / 16.0, 1.0]),
        )
        lights.append(
            area_light("Lamp", "RECTANGLE", center, half[0], half[1], direction=-np.eye(3)[2], radiance=color)
        )
    found, expected = (
        getattr(shading.shade(samples, lights, "ltc", passes=[name], workers=1, dtype=dtype), name).sum(axis=0)
        for dtype in (np.float32, np.float64)
    )
    assert relative_error(found, expected) < OFF and not found[:, 2].any()


@pytest.mark.parametrize("name, lowest_roughness", [("ltsh4", 0.02), *((name, 0.3) for name in shading.SHIPPED_TABLES)])
def test_specular_light_of_many_is_closer_to_the_truth_than_that_of_each(name, lowest_roughness):
    """The tails of lobes are true where lights are points. Some lobes are sharper than single precision can tell."""
    samples, lights = floor_samples(24, lowest_roughness), many_lights(200)
    truth = shading.shade(samples, lights, shading.REFERENCE, passes=["specular"], workers=1).specular
    found = shading.shade(samples, lights, name, passes=["specular"], workers=1).specular
    each = shading.shade(samples, lights, name, passes=["specular"], workers=1, dtype=np.float64).specular
    assert relative_error(found, truth) < relative_error(each, truth) + OFF


def smooth_samples(side):
    """side x side dielectric samples of even roughness on waves, 6 m wide."""
    x, y = (values.ravel() for values in np.meshgrid(*[np.linspace(-3.0, 3.0, side)] * 2))
    normal = unit(np.stack([0.05 * np.sin(0.5 * x), 0.05 * np.cos(0.5 * y), np.ones(side**2)], axis=1))
    samples = replace(random_samples(side**2, 2, 0.4), roughness=np.full(side**2, 0.4), ior=np.full(side**2, 1.5))
    position = np.stack([x, y, np.zeros(side**2)], axis=1)
    normals = dict.fromkeys(("normal", "diffuse_normal", "geometric_normal", "smooth_normal"), normal)
    return replace(samples, position=position, view=unit([0.0, -9.0, 4.0] - position), **normals)


def test_light_is_interpolated_on_smooth_surfaces(monkeypatch):
    """Of all nodes that no horizon crosses ten samples of a tile tell what the others get."""
    samples, lights = smooth_samples(60), many_lights(500)
    counts, light_of = [], light_tree._light_of

    def counting(tree, lobes, position, tile):
        counts.append((len(tile[0]), len(tile[1].node)))
        return light_of(tree, lobes, position, tile)

    monkeypatch.setattr(light_tree, "_light_of", counting)
    found = shading.shade(samples, lights, "ltsh4", workers=1)
    few = sum(nodes for columns, nodes in counts if columns == 10)
    assert few > 0.5 * sum(nodes for _, nodes in counts)
    some = np.arange(0, len(samples), 91)
    exact = shading.shade(samples.take(some), lights, "ltsh4", passes=["diffuse"], workers=1, dtype=np.float64)
    assert relative_error(found.diffuse[:, some], exact.diffuse) < OFF
    truth = shading.shade(samples.take(some), lights, shading.REFERENCE, passes=["specular"], workers=1).specular
    own = shading.shade(samples.take(some), lights, "ltsh4", passes=["specular"], workers=1, dtype=np.float64).specular
    assert relative_error(found.specular[:, some], truth) < relative_error(own, truth) + OFF


def lowered(lights, height):
    return [shifted(light, (0.0, 0.0, -height)) for light in lights]


def test_uneven_surfaces_need_few_near_lights_whole(monkeypatch):
    """Small tiles know better where their lobes point: what the sums are, how they are cut does not matter."""
    samples, lights = floor_samples(800, 0.2), lowered(many_lights(1000), 1.5)
    counts, add = [], float32.add_far_lights

    def counting(*arguments):
        found = add(*arguments)
        counts.append(len(found[0][0]))
        return found

    monkeypatch.setattr(float32, "add_far_lights", counting)
    found = shading.shade(samples, lights, "ltsh4", passes=["specular"], workers=1).specular
    few, counts[:] = sum(counts), []
    monkeypatch.setattr(light_tree, "MANY_LEAVES", len(lights))
    expected = shading.shade(samples, lights, "ltsh4", passes=["specular"], workers=1).specular
    assert few < 0.6 * sum(counts) and relative_error(found, expected) < OFF


@pytest.mark.parametrize("name", ["diffuse", "specular"])
def test_few_samples_between_many_lights_get_the_light_of_each(name, monkeypatch):
    """Tiles of 10 m hardly above which lights are: of each few samples are near, and no bound is their light."""
    samples, lights = floor_samples(300, 0.3), lowered(many_lights(600), 1.7)
    options = {"passes": [name], "workers": 1}
    found = getattr(shading.shade(samples, lights, "ltsh4", **options), name)
    # The tails of lobes are true where lights are points: specular light is compared with that of a fine tree.
    monkeypatch.setattr(*((lights32, "FEWEST", 1000) if name == "diffuse" else (light_tree, "TILE", (10, 10))))
    monkeypatch.setattr(light_tree, "ERROR", (1e-5, 1e-5))
    expected = getattr(shading.shade(samples, lights, "ltsh4", **options), name)
    assert relative_error(found, expected) < OFF


@pytest.mark.parametrize("shape", ["RECTANGLE", "TRIANGLE", "HEXAGON", "narrow", "DISK"])
def test_lights_shaded_together_are_those_of_each(shape, monkeypatch):
    """Of leaves that no tile takes as points, whatever their shape."""
    lights = [EllipseLight.like(light) for light in lowered(many_lights(80), 1.7)]
    if shape in ("TRIANGLE", "HEXAGON"):
        lights = [PolygonLight.like(one, corners=one.polygon(3 if shape[0] == "T" else 6)) for one in lights]
    elif shape != "DISK":
        # The light of a narrow one is left to double precision.
        thin = 1e-5 if shape == "narrow" else 1.0
        lights = [QuadLight.like(one, half_v=thin * one.half_v, radiance=one.radiance / thin) for one in lights]
    monkeypatch.setattr(light_tree, "LEAF_SIZE", 0.0)
    samples = floor_samples(300, 0.3)
    smooth = unit(np.array([0.0, 0.0, 1.0]) + 0.1 * np.random.default_rng(5).normal(size=(300, 3)))
    samples = replace(samples, smooth_normal=smooth, geometric_normal=smooth)
    shades = [shading.shade(samples, lights, "ltsh4", workers=1)]
    monkeypatch.setattr(lights32, "FEWEST", 1000)
    shades.append(shading.shade(samples, lights, "ltsh4", workers=1))
    for name in ("specular", "diffuse"):
        assert relative_error(*(getattr(one, name) for one in shades)) < 2e-4


def test_cubics_of_two_coordinates_are_interpolated_and_nothing_else():
    generator = np.random.default_rng(1)
    u, v = generator.uniform(-1.0, 1.0, (2, 180)).astype(np.float32)
    parts = [np.arange(90), np.arange(90, 180)]
    keys = np.stack([2.0 * u + v, u - 2.0 * v, 0.0 * u])
    for shape, is_cubic in (
        (u**3 - 2.0 * u * v * v + v, True),
        (np.exp(u), False),
        (0.01 * generator.normal(size=180), False),
    ):
        cubics = light_nodes.TileCubics.of(parts, keys, shape[None].astype(np.float32))
        assert (cubics.are_smooth == is_cubic).all()
        for part, anchors, weights in zip(parts, cubics.anchors, cubics.weights, strict=True):
            exact = (u - v) ** 3 + 1.0
            assert np.allclose(weights @ exact[part][anchors], exact[part], atol=2e-5)
    # Samples in a line, and all in one place, have no two coordinates.
    for keys in (np.stack([u, u, 0.0 * u]), np.zeros((3, 180), np.float32)):
        assert not light_nodes.TileCubics.of(parts, keys, u[None]).are_smooth.any()


def test_a_ring_of_many_faces_shines_as_its_faces():
    """Faces that turn around one axis do not look along it: 2.7 % off where they count as turning all ways. Three times
    OFF: within a node, those that face a point count as no nearer to it than the others."""
    samples, (around, across) = smooth_samples(60), (np.linspace(0.0, 2.0 * np.pi, 1 + n) for n in (48, 24))
    out, around = 0.8 + 0.2 * np.cos(across), around[:, None]
    rings = np.cos(around) * out, 0.2 * np.sin(across) + 0.0 * around, np.sin(around) * out
    corners, some = np.stack(rings, axis=-1) + [0.0, 0.0, 2.0], np.arange(0, 3600, 37)
    lights = []
    for one, other in np.ndindex(48, 24):
        quad = corners[[one, one + 1, one + 1, one], [other, other, other + 1, other + 1]]
        u, v = quad[1] - quad[0], quad[3] - quad[0]
        facing = {"direction": unit(np.cross(u, v)), "corners": quad, "radiance": np.ones(3)}
        lights.append(area_light("Ring", "POLYGON", quad.mean(axis=0), unit(u), unit(v), **facing))
    options = {"passes": ["diffuse"], "workers": 1, "rows": [0] * len(lights)}
    found = shading.shade(samples, lights, "ltsh4", **options).diffuse[:, some]
    expected = shading.shade(samples.take(some), lights, "ltsh4", dtype=np.float64, **options).diffuse
    assert relative_error(found, expected) < 3.0 * OFF


def test_rows_receivers_and_black_lights_are_kept_apart():
    samples = replace(floor_samples(300, 0.3), receiver=np.arange(300) % 3)
    lights = many_lights(100, 1) + many_lights(100, 2, receivers=(1,))
    lights += [replace(light, radiance=-0.1 * light.radiance) for light in many_lights(5, 3)]
    rows = np.repeat((0, 1), (100, 105))
    found = shading.shade(samples, lights, "ltsh4", passes=["diffuse"], workers=1, rows=rows).diffuse
    expected = shading.shade(
        samples, lights, "ltsh4", passes=["diffuse"], workers=1, rows=rows, dtype=np.float64
    ).diffuse
    assert relative_error(found[0], expected[0]) < OFF and relative_error(found[1], expected[1]) < OFF
    only = shading.shade(samples, lights[100:200], "ltsh4", workers=1).combined
    assert only[samples.receiver == 1].any() and not only[samples.receiver != 1].any()


def test_workers_do_not_change_one_bit(started, children_only, monkeypatch):
    monkeypatch.setattr(integrator, "SECONDS_WORTH_A_WORKER", 0.0)
    monkeypatch.setattr(integrator, "BLOCK_LIMITS", (100, 100))
    samples, lights = floor_samples(300, 0.02), many_lights(80)
    one, two = (shading.shade(samples, lights, "ltsh4", workers=count) for count in (1, 2))
    assert len(started) == 1 and all_ended(started)
    assert np.array_equal(one.specular, two.specular) and np.array_equal(one.diffuse, two.diffuse)


def test_stand_ins_have_the_light_and_the_place_of_their_lights():
    lights = many_lights(300)
    found, share, numbers = light_nodes.stand_ins(lights, 16)
    assert sorted(np.concatenate(numbers)) == list(range(300))
    assert len(found) == 16 and (0.0 < share).all() and (share < 1.0).all()
    for own in (lights, found):
        assert all(light.direction @ light.area_vector != 0.0 for light in own)
    light, center = (
        [sum(np.linalg.norm(one.area_vector) * value(one) for one in own) for own in (lights, found)]
        for value in (lambda one: one.radiance, lambda one: one.radiance.sum() * one.center)
    )
    assert np.allclose(*light) and np.allclose(*center, atol=0.02 * light[0].sum() * 10.0)
    # One flat square in 16 x 16 parts stands for itself.
    step = (np.arange(16) + 0.5) / 8.0 - 1.0
    parts = [
        area_light("Part", "RECTANGLE", (x, y, 3.0), (1 / 16, 0, 0), (0, -1 / 16, 0), direction=(0, 0, -1))
        for x in step for y in step
    ]  # fmt: skip
    (whole,), share, _ = light_nodes.stand_ins(parts, 1)
    assert np.allclose(np.linalg.norm([whole.half_u, whole.half_v], axis=1), 1.0) and np.allclose(share, 1.0)
    assert np.allclose(whole.radiance, parts[0].radiance) and np.allclose(whole.center, (0, 0, 3))


def test_nodes_have_the_power_and_the_moments_of_their_lights():
    lights = many_lights(37)
    tree = LightTree.of(lights)
    root = [np.array([getattr(light, name) for light in lights]) for name in ("center", "area_vector", "radiance")]
    center, area, radiance = root
    area *= np.copysign(1.0, (area * np.array([light.direction for light in lights])).sum(axis=1))[:, None]
    power = radiance.mean(axis=1) * np.linalg.norm(area, axis=1)
    assert np.isclose(tree.power[0], power.sum()) and sorted(tree.number[tree.number >= 0]) == list(range(37))
    assert np.allclose(tree.center[0], power @ center / power.sum())
    assert np.allclose(tree.vector[0], radiance.mean(axis=1) @ area)
    shift = center - tree.center[0]
    own = sum(
        share * (np.outer(light.half_u, light.half_u) + np.outer(light.half_v, light.half_v)) / (3 + light.is_round)
        for share, light in zip(power, lights, strict=True)
    )
    moments = ((power[:, None] * shift).T @ shift + own) / power.sum()
    axes = tree.axes[:, :, 0]
    assert np.allclose(axes.T @ axes, moments)
    points, colors = tree.places[0][0][:4] - tree.center[0], tree.places[0][1][:, :4]
    assert np.allclose(points.mean(axis=0), 0.0) and np.allclose(points.T @ points / 4, moments)
    # Each color of the points has the power and the center of its color of the lights.
    powers = radiance * np.linalg.norm(area, axis=1)[:, None]
    assert np.allclose(colors.sum(axis=1) * power.sum(), powers.sum(axis=0))
    assert np.allclose(colors @ points / colors.sum(axis=1)[:, None], powers.T @ shift / powers.sum(axis=0)[:, None])
    assert all(
        np.linalg.norm(light.polygon() - tree.center[0], axis=1).max() < 1.001 * tree.radius[0] for light in lights
    )
    assert len(lights) < lights32.FEWEST  # so that few lights are shaded one by one
