"""The search for places of lights, against quadrature, finite differences and minima known otherwise."""

import numpy as np
import pytest

from ltsh_addon.pipeline import light_search
from ltsh_addon.pipeline.light_search import (
    LightFreedom,
    LightMove,
    LightSearch,
    TargetSamples,
    added_light,
    levenberg_marquardt,
    rotation,
    searched,
)
from ltsh_addon.scene import EllipseLight, QuadLight, SunLight, SurfaceSamples

SIDE = 12
TRUE = QuadLight(
    name="Key", center=[0.4, -0.3, 1.5], half_u=[0.4, 0.0, 0.1], half_v=[0.0, 0.25, 0.0],
    direction=np.array([0.1, 0.0, -0.4]) / np.hypot(0.1, 0.4), radiance=[8.0, 6.0, 4.0],
)  # fmt: skip


def floor() -> SurfaceSamples:
    """White Lambert points of a floor and a wall."""
    s, t = (values.ravel() for values in np.meshgrid(*2 * [np.linspace(-1.5, 1.5, SIDE)]))
    position = np.concatenate([np.stack([s, t, 0 * s], axis=-1), np.stack([s, 0 * s + 1.6, t + 1.5], axis=-1)])
    normal = np.repeat([[0.0, 0.0, 1.0], [0.0, -1.0, 0.0]], len(s), axis=0)
    zero, view = np.zeros_like(position), np.array([0.0, -4.0, 3.0]) - position
    return SurfaceSamples(
        position=position, view=view / np.linalg.norm(view, axis=-1, keepdims=True), normal=normal,
        diffuse_normal=normal, roughness=np.full(len(position), 0.5), specular_f0=zero, specular_f90=zero,
        dielectric=zero, ior=np.full(len(position), 1.5), diffuse_albedo=np.ones_like(position),
    )  # fmt: skip


def quadrature(samples: SurfaceSamples, light: QuadLight, count: int = 48) -> np.ndarray:
    """The light (P, 3) that Lambert's floor reflects, by the midpoint rule over the light."""
    steps = (np.arange(count) + 0.5) / count * 2.0 - 1.0
    s, t = (values.ravel()[:, None] for values in np.meshgrid(steps, steps))
    points = light.center + s * light.half_u + t * light.half_v
    way = points[None] - samples.position[:, None]
    distance = np.linalg.norm(way, axis=-1)
    received = np.maximum((way * samples.normal[:, None]).sum(axis=-1), 0.0) / distance
    emitted = np.maximum(-way @ light.direction, 0.0) / distance
    area = np.linalg.norm(np.cross(light.half_u, light.half_v)) * 4.0
    factor = (received * emitted / distance**2).mean(axis=-1) * area / np.pi
    return factor[:, None] * light.radiance


def search_for(target: np.ndarray, light, **options) -> LightSearch:
    """A search for one light, each sample in an area of its own."""
    samples, count = floor(), len(target)

    def seen(samples, lights):
        return {name: np.ones((len(lights), len(samples))) for name in ("specular", "diffuse")}

    places = TargetSamples(samples, np.arange(count), np.ones(count), target, np.ones(count), seen, "ltsh2")
    freedoms = (LightFreedom(light, places.distance(light), options.pop("with_size", False)),)
    nothing = np.zeros((count, 3))
    direct = places.picture(light).sum(axis=0)[None]
    return LightSearch(places, freedoms, nothing[None], np.zeros((0, count, 3)), nothing, direct, **options)


@pytest.mark.parametrize("seed", range(6))
def test_a_light_comes_back_to_where_the_quadrature_had_it(seed):
    rng = np.random.default_rng(seed)
    way, axis = rng.normal(size=(2, 3))
    start = LightMove(0.2 * way / np.linalg.norm(way), 0.17 * axis / np.linalg.norm(axis)).of(TRUE)
    search = search_for(3.0 * quadrature(floor(), TRUE), start)
    x = searched(None, search)
    found = search.freedoms[0].move(x).of(start)
    # The midpoint rule is off by 1e-4 here, and single precision by less; the place follows from it some ten times as
    # badly conditioned.
    assert np.linalg.norm(found.center - TRUE.center) < 3e-3
    np.testing.assert_allclose(found.direction, TRUE.direction, atol=5e-3)
    assert search.factors(x)[0][0] == pytest.approx(3.0, rel=5e-3)
    assert search.error(x) < 1e-3


def test_from_several_starts_a_light_comes_back_from_far():
    start = LightMove(np.array([0.4, -0.3, 0.3]), np.array([0.2, 0.25, 0.0])).of(TRUE)
    search = search_for(quadrature(floor(), TRUE), start, colors=True)
    x = searched(search, search)
    assert np.linalg.norm(search.freedoms[0].move(x).of(start).center - TRUE.center) < 3e-3


def test_sizes_come_back_too():
    large = LightMove(np.zeros(3), np.zeros(3), np.log(1.5)).of(TRUE)
    search = search_for(quadrature(floor(), TRUE), large, with_size=True)
    x = searched(None, search)
    assert np.exp(x[-1]) == pytest.approx(1.0 / 1.5, rel=0.05)


def test_derivatives_are_those_of_the_residuals(monkeypatch):
    # Where the target is met, Kaufman's derivative is the whole one. One-sided differences are off by a step times the
    # curvature, which is some ten times the slope: with steps of 0.01 by 10 %, with these by 1 %.
    step = 1e-3
    monkeypatch.setattr(light_search, "STEP", step)
    search = search_for(quadrature(floor(), TRUE), TRUE)
    x = np.zeros(search.freedoms[0].count)
    for index, slope in enumerate(search.jacobian(x).T):
        way = step * np.eye(len(x))[index]
        central = (search.residuals(x + way) - search.residuals(x - way)) / (2.0 * step)
        assert np.linalg.norm(slope - central) < 0.02 * np.linalg.norm(central)


def test_levenberg_marquardt_finds_the_minimum_of_a_bent_valley():
    # Rosenbrock 1960: the only minimum is (1, 1).
    def residuals(x):
        return np.array([10.0 * (x[1] - x[0] ** 2), 1.0 - x[0]])

    def jacobian(x):
        return np.array([[-20.0 * x[0], 10.0], [-1.0, 0.0]])

    x, squares = levenberg_marquardt(residuals, jacobian, np.array([-1.2, 1.0]), steps=100, near=1e-10)
    np.testing.assert_allclose(x, 1.0, atol=1e-8)
    assert squares < 1e-15


def test_levenberg_marquardt_is_as_good_as_trying_all():
    rng = np.random.default_rng(3)
    at, values = np.linspace(0.0, 2.0, 30), None
    values = 1.3 * np.exp(-0.8 * at) + 0.05 * rng.normal(size=30)

    def residuals(x):
        return x[0] * np.exp(-x[1] * at) - values

    def jacobian(x):
        return np.stack([np.exp(-x[1] * at), -x[0] * at * np.exp(-x[1] * at)], axis=-1)

    _, squares = levenberg_marquardt(residuals, jacobian, np.array([1.0, 0.0]))
    tried = [np.square(residuals((a, b))).sum() for a in np.linspace(0.5, 2, 151) for b in np.linspace(0, 2, 201)]
    assert squares <= min(tried) + 1e-12


def test_moves_keep_power_and_shape_and_suns_stay_far():
    disk = EllipseLight("Disk", [0, 0, 2], [0.3, 0, 0], [0, 0.3, 0], [0, 0, -1], [1, 1, 1], shape="DISK")
    move = LightMove(np.array([1.0, 2.0, 3.0]), np.array([0.3, -0.2, 0.9]), 0.7)
    moved = move.of(disk)
    flux = [np.linalg.norm(one.area_vector) * one.radiance for one in (disk, moved)]
    np.testing.assert_allclose(*flux)
    np.testing.assert_allclose(np.linalg.norm(moved.half_u), 0.3 * np.exp(0.7))
    np.testing.assert_allclose(moved.direction, rotation(move.turn) @ disk.direction)
    assert LightFreedom(disk, 1.0).count == 5 and LightFreedom(TRUE, 1.0, with_size=True).count == 7
    sun = SunLight("Sun", [0, 0, 1], [0.01, 0, 0], [0, 0.01, 0], [0, 0, -1], [1, 1, 1])
    np.testing.assert_allclose(move.of(sun).center, rotation(move.turn) @ sun.center)
    assert LightFreedom(sun, 1.0).count == 2


def test_a_new_light_is_added_where_the_target_shines_from():
    key = EllipseLight("", [0.4, -0.3, 2.2], [0.3, 0, 0], [0, 0.3, 0], [0, 0, -1], [2, 2, 2], shape="DISK")
    search = search_for(quadrature(floor(), TRUE), key)
    target, nothing = search.places.picture(key), np.zeros_like(search.fixed)
    search = search_for(target + 0.1, key)
    light = added_light(search.places, np.zeros((0, *target.shape)), nothing + 0.1)
    way, true = light.center - np.mean(floor().position, axis=0), key.center - np.mean(floor().position, axis=0)
    # Neighbors among 96 directions are some 20 degrees apart.
    assert way @ true > np.cos(np.radians(35.0)) * np.linalg.norm(way) * np.linalg.norm(true)
    with pytest.raises(ValueError, match="no further light"):
        added_light(search.places, target[None] + 0.1, nothing)
