"""Shares of lights, by tracers whose answers are known: nothing in the way, a wall, a half-plane, a sphere."""

import dataclasses

import numpy as np
import pytest
import random_surfaces
import textbook
from known_tracers import OPEN, WALL, Tracer, floor, panel, past_spheres

from ltsh_addon import shading
from ltsh_addon.scene import PASSES, Cancelled, Film, SurfaceSamples, light_of
from ltsh_addon.visibility import estimator, ratio
from ltsh_addon.visibility.emitter import Emitter
from ltsh_addon.visibility.light_selection import LightSelection
from ltsh_addon.visibility.ray_sampler import SampleRows

KINDS = [*((surface, "plain") for surface in random_surfaces.SURFACES)] + [
    ("plain", light)
    for light in (*random_surfaces.LIGHTS[1:], *random_surfaces.PROFILED_LIGHTS, *random_surfaces.FACING_LIGHTS)
]
KINDS += [(surface, light) for surface in random_surfaces.SHAPED for light in ("plain", "horizon", "polygon", "spread")]
KINDS += [("brushed", light) for light in ("plain", "horizon", "ball")]


@pytest.mark.parametrize(("surface", "kind"), KINDS)
def test_weights_are_the_light_that_is_reflected(surface, kind):
    """Without occluders the mean of the weights is what the quadrature integrates, whatever the surface and light."""
    random = np.random.default_rng(5)
    samples = random_surfaces.samples(surface, 16, random)
    lights = [random_surfaces.light(kind, number, random) for number in range(3)]
    found = ratio.trace_visibility(samples, lights, OPEN, ratio.ShadowSampling(rays=8))
    for name in PASSES:
        assert (getattr(found, name) == 1.0).all()
    for light in lights:
        expected = shading.shade(samples, [light], "reference", dtype=np.float64, workers=1)
        pairs = with_all_rays(samples, light, OPEN)
        # `shade` takes the shadowing of bump maps at one direction.
        for name in PASSES if surface != "tilted" else ("specular",):
            radiance = pairs.unshadowed(name)
            # The rays weigh by the mean color, as far as the light's own color is the same for all of a light.
            color = light.radiance.mean() / light.radiance
            whole = (getattr(expected, name)[0] * color).mean(axis=1)
            lit = whole[pairs.index]
            outside = np.setdiff1d(np.arange(len(samples)), pairs.index)
            assert np.abs(whole[outside]).max(initial=0.0) <= 1e-9 * max(whole.max(), 1e-30)
            # 1024 points in two or three strata each; a tenth of the pairs see a sliver of the light.
            error = np.abs(radiance - lit) / np.maximum(lit, 1e-3 * max(whole.max(), 1e-30))
            bad = np.count_nonzero(error > 0.03)
            # Of lights of 10 m x 1 km, single precision loses some percent.
            assert bad <= (0.3 if kind == "huge" else 0.1) * len(error) + 1, (light.name, name, np.sort(error)[-5:])


def test_behind_a_wall_nothing_is_left():
    random = np.random.default_rng(6)
    for surface, kind in KINDS:
        samples, light = random_surfaces.samples(surface, 40, random), random_surfaces.light(kind, 0, random)
        found = ratio.trace_visibility(samples, [light], WALL)
        whole = shading.shade(samples, [light], "ltsh4", workers=1)
        for name in PASSES:
            share, radiance = getattr(found, name)[0], getattr(whole, name)[0]
            assert ((share == 0.0) | (share == 1.0)).all()
            assert (radiance[share == 1.0] <= 1e-6 * radiance.max()).all(), (surface, kind, name)


def brute_force(samples, light, passed, side):
    """Shares (P,) by pass: midpoints of side^2 cells of a rectangle, formulas in double precision."""
    place = (np.arange(side) + 0.5) / side * 2.0 - 1.0
    s, t = (grid.ravel()[:, None] for grid in np.meshgrid(place, place))
    points = light.center + s * light.half_u + t * light.half_v
    shares = {name: [] for name in PASSES}
    for number in range(len(samples)):
        one = samples.take(slice(number, number + 1))
        offset = points - one.position
        distance = np.linalg.norm(offset, axis=1)
        towards = offset / distance[:, None]
        measure = np.maximum(-(towards @ light.direction), 0.0) / distance**2
        if light.is_round:
            measure *= (s * s + t * t <= 1.0)[:, 0]
        seen = passed(np.broadcast_to(one.position, towards.shape), towards, distance)
        normal, view = one.normal[0], one.view[0]
        half = random_surfaces.unit(towards + view)
        alpha, cosine, cosine_o = one.roughness[0] ** 2, np.maximum(towards @ normal, 1e-9), view @ normal
        lobe = textbook.ggx_of_cosines(half @ normal, cosine, cosine_o, alpha) * cosine
        f0, f90 = one.specular_f0.mean(), one.specular_f90.mean()
        lobe *= f0 + (f90 - f0) * (1.0 - (half * view).sum(axis=1)) ** 5
        lobe *= (towards @ normal > 0.0) & (towards @ one.geometric_normal[0] > 0.0)
        above = np.maximum(towards @ one.smooth_normal[0], 0.0)
        tangent2 = 1.0 / np.maximum(above, 1e-9) ** 2 - 1.0
        open_lobe = np.maximum(towards @ one.diffuse_normal[0], 0.0) * (above > 0.0)
        open_lobe *= 2.0 / (1.0 + np.sqrt(1.0 + one.bump_alpha2 * tangent2))
        for name, values in (("specular", lobe), ("diffuse", open_lobe)):
            whole = (values * measure).sum()
            shares[name].append((values * measure * seen).sum() / whole if whole > 0.0 else 1.0)
    return {name: np.array(values) for name, values in shares.items()}


def with_all_rays(samples, light, tracer):
    """The pairs of a light after as many rays as there can be, for each."""
    selection = LightSelection(samples, [light], is_baked=False)
    pairs = estimator.RatioEstimator(SampleRows(samples, PASSES, tracer), Emitter(light), 0, selection)
    pairs._add_rays(np.arange(len(pairs.index)), 0, estimator.MOST_RAYS, 0)
    return pairs


@pytest.mark.parametrize("roughness", (0.15, 0.5))
@pytest.mark.parametrize("shape", ("RECTANGLE", "ELLIPSE"))
def test_shares_are_those_of_a_quadrature_over_the_light(shape, roughness):
    samples, _ = floor(12, roughness)
    light, tracer = panel(shape=shape), past_spheres(((0.0, 1.0, 0.5), 0.5), ((-1.2, -0.5, 0.3), 0.3))
    expected = brute_force(samples, light, tracer.passed, 150)
    pairs = with_all_rays(samples, light, tracer)
    for name, limit in (("specular", 0.012), ("diffuse", 0.006)):
        error = pairs.visibility_ratio(name)[0] - expected[name][pairs.index]
        # Stratified, 1024 rays are off by about 1024^-0.75 = 0.6 % of one; half as many for a sharp lobe.
        assert np.sqrt(np.square(error).mean()) < limit, name
        assert abs(error.mean()) < 0.25 * limit, name


def test_bump_mapped_lobes_have_the_shares_of_a_quadrature():
    random = np.random.default_rng(8)
    samples = random_surfaces.samples("tilted", 150, random)
    light, tracer = panel(center=np.array([0.5, 1.0, 1.5])), past_spheres(((0.0, 0.0, 0.8), 0.4))
    gray = np.full((150, 3), 0.5)
    values = {"specular_f0": gray, "specular_f90": gray, "dielectric": 0.0 * gray, "specular_dip": 0.0 * gray}
    samples = dataclasses.replace(samples, **values)
    expected = brute_force(samples, light, tracer.passed, 150)
    pairs = with_all_rays(samples, light, tracer)
    for name in PASSES:
        error = np.abs(pairs.visibility_ratio(name)[0] - expected[name][pairs.index])[pairs.visible & pairs.blocked]
        assert len(error) > 30 and np.median(error) < 0.01 and np.quantile(error, 0.9) < 0.04, name


def test_a_textured_light_counts_by_its_radiance():
    """A panel of which the left half is dark and the right one bright, behind a screen that ends at its middle."""
    whole = panel(radiance=np.full(3, 2.0))
    halves = [
        dataclasses.replace(whole, center=whole.center + side * 0.5 * whole.half_u, half_u=0.5 * whole.half_u,
                            radiance=np.full(3, bright))
        for side, bright in ((-1.0, 1.0), (1.0, 3.0))
    ]  # fmt: skip
    light = dataclasses.replace(whole, children=tuple(halves))
    samples, _ = floor(8)
    expected = shading.shade(samples, [light], "reference", dtype=np.float64, workers=1)
    parts = [shading.shade(samples, [half], "reference", dtype=np.float64, workers=1) for half in halves]
    tracer = Tracer(lambda origins, directions, distances: (origins + distances[:, None] * directions)[:, 0] > 0.0)
    pairs = with_all_rays(samples, light, tracer)
    for name in PASSES:
        lit = getattr(expected, name)[0, :, 0]
        np.testing.assert_allclose(pairs.unshadowed(name), lit, rtol=0.02, atol=0.01 * lit.max())
        share = getattr(parts[1], name)[0, :, 0] / sum(getattr(part, name)[0, :, 0] for part in parts)
        # The picture of the light has 128 columns.
        np.testing.assert_allclose(pairs.visibility_ratio(name)[0], share, atol=0.02)


THREE_SPHERES = past_spheres(((0.0, 1.0, 0.5), 0.5), ((-1.2, -0.5, 0.3), 0.3), ((1.0, -1.0, 0.2), 0.2))


def test_few_rays_suffice_and_the_told_noise_is_about_the_real_one():
    samples, film = floor(48)
    lights = [panel(), panel(name="Low", center=np.array([0.5, 2.0, 0.6]))]
    pairs = [with_all_rays(samples, light, THREE_SPHERES) for light in lights]
    for rays, limit in ((8, 0.12), (32, 0.06), (128, 0.025)):
        found = ratio.trace_visibility(samples, lights, THREE_SPHERES, ratio.ShadowSampling(rays=rays, film=film))
        # Most pairs are settled by the probes, or not worth all rays.
        assert found.rays < max(0.45 * rays, 8.01) * sum(len(exact.index) for exact in pairs)
        for name in PASSES:
            error, light = np.zeros(len(samples)), np.zeros(len(samples))
            for number, exact in enumerate(pairs):
                radiance, share = exact.unshadowed(name), exact.visibility_ratio(name)[0]
                error[exact.index] += (getattr(found, name)[number, exact.index] - share) * radiance
                light[exact.index] += share * radiance
            real = np.sqrt(np.square(error).sum() / np.square(light).sum())
            assert real < limit, (rays, name)
            assert 0.6 < found.noise(name) / real < 2.5, (rays, name, found.noise(name), real)


def test_samples_that_stand_for_few_points_of_their_pixel_get_fewer_rays():
    samples, film = floor(32)
    everywhere = ratio.trace_visibility(samples, [panel()], THREE_SPHERES, ratio.ShadowSampling(rays=256, film=film))
    few = dataclasses.replace(film, sub_samples=16, count=np.ones(len(samples), int))
    found = ratio.trace_visibility(samples, [panel()], THREE_SPHERES, ratio.ShadowSampling(rays=256, film=few))
    probes = 8 * len(samples)
    # A sixteenth of the light is worth an eighth of the rays (`WORTH_POWER`), at least 16 where it is half in shadow.
    assert found.rays - probes < 0.4 * (everywhere.rays - probes)
    # Stratified rays: 16 tell a share to 16^-0.75 and less.
    assert np.sqrt(np.square(found.diffuse - everywhere.diffuse).mean()) < 16**-0.75


def test_a_small_highlight_that_is_half_seen_gets_more_rays_than_all_else(monkeypatch):
    """It has most of the noise of a picture, of which four times the rays leave less than a half."""
    samples, film = floor(64, roughness=0.05)
    lamp = panel(half_u=np.array([0.15, 0.0, 0.0]), half_v=0.15 * panel().half_v)
    bars = past_spheres(*(((x, 1.5, 0.7), 0.0375) for x in (-0.135, -0.045, 0.045, 0.135)))
    images, rays = {}, {}
    for name, brightest, most in (("truth", 1, 1024), ("before", 1, 32), ("now", estimator.BRIGHTEST, 32)):
        monkeypatch.setattr(estimator, "BRIGHTEST", brightest)
        found = ratio.trace_visibility(samples, [lamp], bars, ratio.ShadowSampling(rays=most, film=film))
        images[name], rays[name] = found.radiance["specular"], found.rays
    errors = {name: np.linalg.norm(images[name] - images["truth"]) for name in ("before", "now")}
    assert errors["now"] < 0.5 * errors["before"]
    assert rays["now"] < 1.1 * rays["before"]


def test_a_wire_that_probes_miss_casts_all_of_its_shadow():
    """Neighbors of pairs that found something in the way are asked again: in the mean nothing is lost."""
    samples, film = floor(64)
    wire = past_spheres(*(((0.3, 1.0, z), 0.012) for z in np.arange(0.02, 1.5, 0.02)))
    light = panel()
    found = ratio.trace_visibility(samples, [light], wire, ratio.ShadowSampling(rays=64, film=film))
    exact = with_all_rays(samples.take(slice(None, None, 3)), light, wire)
    expected = 1.0 - exact.visibility_ratio("diffuse")[0]
    lost = 1.0 - found.diffuse[0, ::3][exact.index]
    in_shadow = expected > 0.002
    assert 0.005 < expected[in_shadow].mean() < 0.1
    assert lost[in_shadow].mean() == pytest.approx(expected[in_shadow].mean(), rel=0.1)
    # What the wire does not touch is untouched.
    assert (lost[expected == 0.0] == 0.0).mean() > 0.995


def test_a_sample_does_not_depend_on_its_block():
    samples, film = floor(24)
    lights = [panel(), panel(name="Disk", shape="ELLIPSE")]
    whole = ratio.trace_visibility(samples, lights, THREE_SPHERES, ratio.ShadowSampling(rays=8, film=film))
    for part in (slice(100, 339), np.arange(575, -1, -7)):
        found = ratio.trace_visibility(
            samples.take(part), lights, THREE_SPHERES, ratio.ShadowSampling(rays=8, film=film.take(part))
        )
        for name in PASSES:
            np.testing.assert_array_equal(getattr(found, name), getattr(whole, name)[:, part])


@pytest.mark.parametrize("film_rows", (1, 4))
def test_degenerate_input_gives_shares(film_rows):
    """Samples in and on lights, without a lobe, looked at along and from behind; lights without an area."""
    light = panel()
    place = np.array(
        [light.center, light.center + 1e-9 * light.direction, light.center + 5.0 * light.half_u, [0, 0, 0]]
    )
    view = random_surfaces.unit(np.array([[0, 0, 1], [1e-9, 0, 1], [1, 0, 0], [0, 0, -1], [0.5, 0.5, 1e-8]], float))
    index = np.indices((4, 5)).reshape(2, -1)
    count = index.shape[1]
    up, gray = np.broadcast_to(np.array([0.0, 0.0, 1.0]), (count, 3)), np.full((count, 3), 0.5)
    roughness = np.resize([0.0, 1e-4, 1.0], count)
    values = (np.full(count, 0.5), np.ones(count), np.where(np.arange(count)[:, None] % 4, gray, 0.0))
    samples = SurfaceSamples(place[index[0]], view[index[1]], up, up, roughness, gray, gray, *values)
    film = Film(count // film_rows, film_rows, np.arange(count))
    lights = [
        light, panel(half_u=np.zeros(3)), panel(half_v=1e-12 * light.half_v), panel(shape="ELLIPSE", spread=1e-3),
        panel(half_u=1e6 * light.half_u), panel(center=np.array([0.0, 0.0, 1e9])), panel(radiance=np.zeros(3)),
        panel(shape="POLYGON", corners=light.center + np.outer([0.0, 1.0, 2.0], light.half_u)),
    ]  # fmt: skip
    for tracer in (OPEN, WALL, THREE_SPHERES):
        found = ratio.trace_visibility(samples, lights, tracer, ratio.ShadowSampling(film=film))
        for name in PASSES:
            share = getattr(found, name)
            assert ((share >= 0.0) & (share <= 1.0)).all()
            assert tracer is not OPEN or (share == 1.0).all()
            assert np.isfinite(found.noise(name))


def test_pairs_without_light_are_not_traced():
    samples, _ = floor(6)
    for light in (panel(receivers=()), panel(receivers=(7,)), panel(affects_diffuse=False, affects_specular=False)):
        tracer = Tracer(WALL.passed)
        found = ratio.trace_visibility(samples, [light], tracer)
        assert tracer.rays == found.rays == 0
        assert (found.specular == 1.0).all() and (found.diffuse == 1.0).all()
    unblocked = Tracer(WALL.passed)
    unblocked.mask_of = lambda name: 0
    assert (ratio.trace_visibility(samples, [panel()], unblocked).diffuse == 1.0).all() and unblocked.rays == 0
    only = ratio.trace_visibility(
        samples, [panel(affects_specular=False)], WALL, ratio.ShadowSampling(passes=("diffuse",))
    )
    assert only.specular is None and (only.diffuse == 0.0).all()
    half = ratio.trace_visibility(samples, [panel(affects_specular=False)], WALL)
    assert (half.specular == 1.0).all() and (half.diffuse == 0.0).all()


def test_the_number_of_rays_has_limits():
    for rays in (7, 1025):
        with pytest.raises(ValueError, match=f"shadow rays are {rays}, expected 8 to 1024"):
            ratio.trace_visibility(*([floor(2)[0], [panel()]]), OPEN, ratio.ShadowSampling(rays=rays))


def test_tracing_can_be_stopped():
    with pytest.raises(Cancelled):
        ratio.trace_visibility(floor(4)[0], [panel()], OPEN, progress=lambda stage, share: False)


def test_rays_to_distant_lights_have_no_end():
    """A wall far behind where the light is written down covers what it covers of the directions, from everywhere."""
    samples, film = floor(12)
    light = panel(is_distant=True)
    half = Tracer(lambda origins, directions, distances: (directions[:, 0] > 0.0) | (distances < 1e9))
    found = ratio.trace_visibility(samples, [light], half, ratio.ShadowSampling(rays=256, film=film))
    here = dataclasses.replace(samples, position=np.zeros_like(samples.position))
    near = Tracer(lambda origins, directions, distances: directions[:, 0] > 0.0)
    expected = ratio.trace_visibility(
        here, [light_of(light.record() | {"is_distant": False})], near, ratio.ShadowSampling(rays=256)
    )
    assert found.mixed.all()
    for name in PASSES:
        # Other places, other rays: about 2 % each.
        difference = getattr(found, name) - getattr(expected, name)
        assert np.sqrt(np.square(difference).mean()) < 0.04 and abs(difference.mean()) < 0.01


@pytest.mark.parametrize(
    "kind", ["RECTANGLE", "ELLIPSE", "POLYGON", "BALL", "FACING_DISK", "cluster", "glowing cluster"]
)
@pytest.mark.parametrize("tilt", [0.0, 0.6])
def test_a_face_just_before_a_light_blocks_it_and_one_just_behind_does_not(kind, tilt):
    """By the geometry. 4 um are 8 float steps of the coordinates here; the rays' ends keep 2, rounding takes 2. Faces
    that glow block their rays too, so that these end farther away; rays to a point keep 8."""
    direction = np.array([0.0, np.sin(tilt), -np.cos(tilt)])
    half_u = np.array([0.3, 0.0, 0.0]) * (
        1e-6 if kind in ("BALL", "FACING_DISK") else 0.1 if "cluster" in kind else 1.0
    )
    half_v, center = np.cross(direction, half_u), np.array([0.0, 0.0, 3.1])
    corners = np.array([-half_u - half_v, half_u - half_v, half_u + half_v, half_v - half_u])
    is_mesh = kind in ("POLYGON", "glowing cluster")
    shape = "POLYGON" if is_mesh else "RECTANGLE" if kind == "cluster" else kind
    common, lights = {"shape": shape, "half_u": half_u, "half_v": half_v, "direction": direction}, []
    for x in range(-80, 80, 2) if "cluster" in kind else (0.0,):
        outline = {"corners": center + x * half_u + corners} if is_mesh else {}
        lights.append(panel(center=center + x * half_u, **common, **outline))
    for before in (6e-5 if is_mesh else 1e-5 if half_u[0] < 1e-5 else 4e-6, 3e-4, -4e-6):

        def passed(origins, directions, distances, before=before):
            height = (center - origins) @ direction
            first = height + (max(before, 0.0) if is_mesh else before)
            return np.where((directions @ direction) * distances < first, 0.0, 1.0)

        found = ratio.trace_visibility(floor(12)[0], lights, Tracer(passed))
        for name in PASSES:
            share = getattr(found, name)
            assert (share == (0.0 if before > 0.0 else 1.0)).all(), (before, name, share.min(), share.max())


@pytest.mark.parametrize("radius", [1.5e-4, 1e-3, 1e-2])
@pytest.mark.parametrize("height", [1.5, 0.6, 0.3, -0.4])
def test_a_face_through_a_small_ball_hides_what_is_behind_it(radius, height):
    """From the floor, 3 to 5 m away: the share of the outline that rays find before the plane, written out."""
    center, samples = np.array([0.0, 0.0, 3.1]), floor(12)[0]
    light = panel(shape="BALL", half_u=(radius, 0, 0), half_v=(0, radius, 0), direction=(0, 0, -1.0), center=center)
    plane = center[2] - height * radius

    def passed(origins, directions, distances):
        return np.where((origins + directions * distances[:, None])[:, 2] > plane, 0.0, 1.0)

    found = ratio.trace_visibility(samples, [light], Tracer(passed), ratio.ShadowSampling(rays=256))
    axis = (center - samples.position) / np.linalg.norm(center - samples.position, axis=1, keepdims=True)
    side = np.cross(axis, [1.0, 0.0, 0.0])
    side /= np.linalg.norm(side, axis=1, keepdims=True)
    x, y = np.meshgrid(*2 * [(np.arange(200) + 0.5) / 100 - 1.0])
    inside = np.hypot(x, y) < 1.0
    x, y = x[inside], y[inside]
    near = x * side[:, 2:] + y * np.cross(axis, side)[:, 2:] - np.sqrt(1.0 - x * x - y * y) * axis[:, 2:]
    expected = (near < -height).mean(axis=1)
    # 256 rays miss a share by .06 at most. The rays end 4 steps of single precision, 6 um, before the ball, and the
    # share changes by up to twice the step of the height.
    moved = 2.0 * 7e-6 / radius
    assert np.abs(found.diffuse[0] - expected).max() < 0.06 + moved
    assert found.diffuse[0].mean() == pytest.approx(expected.mean(), abs=0.01 + moved)
