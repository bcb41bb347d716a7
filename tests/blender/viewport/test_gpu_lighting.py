"""The lighting pass on the graphics card, or on llvmpipe in its place, against the integrator in double precision."""

from dataclasses import replace

import numpy as np
import pytest
import quadrature
import random_surfaces
from graphics_card import Canvas, with_graphics
from random_surfaces import EYE, rounded, unit
from uploaded_samples import upload_samples

from ltsh_addon import shading
from ltsh_addon.blender.viewport.lighting import LightingPass
from ltsh_addon.scene import EllipseLight, Pattern

WIDTH, HEIGHT = 32, 16
TECHNIQUES = ("ltc", "ltsh2", "ltsh4", "ltsh4c")
# What the preview promises: below the differences between techniques, and nothing the eye could see.
RELATIVE, ABSOLUTE = 1e-3, 1e-5
# Points of small lights follow bump shadowing less closely where it is steep, near the horizon.
RELATIVE_OF_BUMPS = 3e-3
# The quadrature over a profile is good to 3e-3 in both, and which one is taken may depend on rounding.
RELATIVE_OF_PROFILES = 3e-3
CONES = 5e-3
# The nodes over a disk take smooth patterns over all of a hemisphere's normals this well.
PATTERNS = 2e-2
# Of lights that are seen as caps of the sphere: the diffuse lobe has a closed form here, a polygon of 32 corners there,
# which is this much off where a horizon cuts it.
RELATIVE_OF_CAPS = 6e-3


def drawn(lighting, samples, canvas, passes, **placement):
    """Radiance (P, 3) of `samples` (P)."""
    gbuffer = upload_samples(samples, WIDTH)
    lighting.draw(gbuffer, canvas.buffer, passes, view=(*EYE, 1.0), **placement)
    return canvas.read()[..., :3].reshape(-1, 3)


def lit(technique, seed, surface="plain", lights=1, count=WIDTH * HEIGHT):
    """`count` random samples, `lights` lights over them and their pass."""
    random = np.random.default_rng(seed)
    samples = random_surfaces.samples(surface, count, random)
    lights = [random_surfaces.light("plain", number, random) for number in range(lights)]
    lighting = LightingPass(technique)
    lighting.set_lights(lights)
    return samples, lights, lighting


def excess(found, expected, relative):
    """How many times too far off (P,) the worst channel is."""
    return (np.abs(found - expected) / (ABSOLUTE + relative * np.abs(expected))).max(axis=1)


def distance(found, expected):
    """Relative L2."""
    return np.linalg.norm(found - expected) / np.linalg.norm(expected)


def integrated(samples, lights, technique, name="combined"):
    """Radiance (P, 3) of a pass by the integrator in double precision."""
    passes = shading.PASSES if name == "combined" else (name,)
    return shading.shade(samples, lights, technique, passes=passes, workers=1, dtype=np.float64).combined


def each_light(technique, kinds, name):
    """A light of each kind, with what draws a pass of samples under this light alone."""
    lighting, canvas = LightingPass(technique), Canvas(WIDTH, HEIGHT)
    for kind in kinds:
        light = random_surfaces.light(kind, 0, np.random.default_rng(len(kind)))
        lighting.set_lights([light])
        yield kind, light, lambda samples: drawn(lighting, samples, canvas, name)


@pytest.mark.parametrize(
    ("surface", "kinds", "techniques"),
    [
        # One surface with all techniques and one kind of lights compile all texts in each Blender.
        pytest.param(
            surface, random_surfaces.LIGHTS, TECHNIQUES, marks=[] if surface == "tilted" else pytest.mark.newest
        )
        for surface in random_surfaces.SURFACES
    ]
    # One technique each: llvmpipe takes seconds to compile one.
    + [
        pytest.param("plain", random_surfaces.PROFILED_LIGHTS, ("ltsh4",), marks=pytest.mark.newest),
        ("tilted", random_surfaces.PROFILED_LIGHTS, ("ltsh2",)),
        ("plain", random_surfaces.FACING_LIGHTS, ("ltsh4",)),
        pytest.param("tilted", random_surfaces.FACING_LIGHTS, ("ltc",), marks=pytest.mark.newest),
    ],
)
def test_radiance_is_that_of_the_integrator(surface, kinds, techniques):
    def compare():
        passes = {name: LightingPass(name) for name in techniques}
        canvas, brightest = Canvas(WIDTH, HEIGHT), dict.fromkeys(shading.PASSES, 0.0)
        for kind in kinds:
            # The same numbers for every kind of light and surface would leave most of the cases out.
            random = np.random.default_rng([len(kind), *map(ord, kind + surface)])
            samples = random_surfaces.samples(surface, WIDTH * HEIGHT, random)
            lights = [random_surfaces.light(kind, number, random) for number in range(3)]
            for technique, lighting in passes.items():
                lighting.set_lights(lights)
                for name in shading.PASSES:
                    found = drawn(lighting, samples, canvas, name)
                    shaded = integrated(samples, lights, technique, name)
                    if lights[0].cone is not None:
                        # Fewer points than there say what a cone leaves of the light where it ends.
                        assert distance(found, shaded) < CONES, (kind, technique, name)
                        continue
                    relative = RELATIVE_OF_BUMPS if (surface, name) == ("tilted", "diffuse") else RELATIVE
                    relative = RELATIVE_OF_PROFILES if lights[0].has_profile else relative
                    relative = RELATIVE_OF_CAPS if kind in random_surfaces.FACING_LIGHTS else relative
                    times = excess(found, shaded, relative)
                    brightest[name] = max(brightest[name], float(shaded.max()))
                    assert times.max() <= 1.0, f"{kind}, {technique}, {name}: {times.max():.1f} x at {times.argmax()}"
        # There is enough light that the absolute part of the tolerance is not what lets them pass.
        assert min(brightest.values()) > 1e3 * ABSOLUTE

    with_graphics(compare)


@pytest.mark.newest
def test_patterns_are_those_of_a_quadrature():
    """By the place on a ball, by the ray, and on a disk: smooth ones, as lamps of files have them. What a pattern makes
    of the light is compared: of the lobe itself the quadrature has another."""
    random = np.random.default_rng(23)
    samples = random_surfaces.samples("plain", WIDTH * HEIGHT, random)
    rows, columns = (np.arange(count) + 0.5 for count in (16, 32))
    values = 1.2 + np.cos(0.4 * rows)[:, None] * np.sin(columns * (2.0 * np.pi / 32))
    lights = []
    kinds = (("ball", False, 0.0), ("ball", True, 0.0), ("facing disk", False, 0.0), ("bulb", False, 0.0))
    for kind, by_ray, start in (*kinds, ("facing disk", True, 1.2)):
        light = random_surfaces.light(kind, len(lights), random)
        lights.append(
            replace(light, pattern=Pattern(np.linalg.qr(random.normal(size=(3, 3)))[0], values, by_ray, start))
        )
    pairs = [(light, replace(light, pattern=None)) for light in lights]

    def draw():
        lighting, canvas = LightingPass("ltsh2"), Canvas(WIDTH, HEIGHT)
        for light in (light for pair in pairs for light in pair):
            lighting.set_lights([light])
            yield {name: drawn(lighting, samples, canvas, name)[:, 1] for name in shading.PASSES}

    found = with_graphics(lambda: list(draw()))
    for number, pair in enumerate(pairs):
        for name in shading.PASSES:
            expected, plain = (
                shading.shade(samples, [light], "reference", passes=(name,), workers=1).combined[:, 1] for light in pair
            )
            patterned, without = (found[2 * number + k][name] for k in range(2))
            ratio = np.divide(patterned, without, out=np.ones_like(without), where=without > 1e-12)
            assert distance(ratio * plain, expected) < PATTERNS, (pair[0].name, name)
            assert distance(plain, expected) > 0.1


@pytest.mark.newest
def test_diffuse_light_of_balls_is_that_of_a_quadrature():
    """Above the horizon and cut by it, from small balls to points close to them."""
    random = np.random.default_rng(5)
    samples = random_surfaces.samples("plain", WIDTH * HEIGHT, random)
    lights = [replace(random_surfaces.light("ball", 0, random), radiance=np.ones(3)) for _ in range(3)]

    def draw():
        lighting, canvas = LightingPass("ltsh2"), Canvas(WIDTH, HEIGHT)
        lighting.set_lights(lights)
        return drawn(lighting, samples, canvas, "diffuse")

    # Rings around the axis of each ball, by Gauss and Legendre in the cosine; along them the midpoint rule.
    found, expected = with_graphics(draw), np.zeros(len(samples))
    nodes, weights = np.polynomial.legendre.leggauss(200)
    turn = (np.arange(400) + 0.5) * (2.0 * np.pi / 400)
    cuts = 0
    for light in lights:
        offset = light.center - samples.position
        away = np.linalg.norm(offset, axis=1)
        sine2 = (light.half_u @ light.half_u) / away**2
        assert sine2.max() < 1.0
        along = (offset * samples.diffuse_normal).sum(axis=1) / away
        cuts += (np.abs(along) < np.sqrt(sine2)).sum()
        half = 0.5 * sine2 / (1.0 + np.sqrt(1.0 - sine2))
        cosine = 1.0 - half[:, None] * (1.0 + nodes)
        sine = np.sqrt(1.0 - cosine**2)
        rings = along[:, None, None] * cosine[..., None]
        rings = rings + (np.sqrt(1.0 - along**2)[:, None] * sine)[..., None] * np.cos(turn)
        expected += half * (np.maximum(rings, 0.0).mean(axis=2) * weights).sum(axis=1) * 2.0
    assert cuts > 50
    # Where the horizon cuts rings the rule is good to 1e-4.
    assert excess(found, expected[:, None] * samples.diffuse_albedo, 3e-4).max() <= 1.0


def compare_diffuse(samples, plain, is_other, brdf, limits):
    """Compare with midpoints over rectangles, which take a horizon that cuts them to 3e-4, and with the integrator over
    the other kinds of light in `limits`; where not `is_other` (P,), with the lobes of `plain` samples."""
    for kind, light, draw in each_light("ltsh2", limits, "diffuse"):
        found, lambert = draw(samples), draw(plain)
        if kind in ("plain", "near"):
            expected = samples.diffuse_albedo * quadrature.reflected(samples, light, brdf)
        else:
            expected = integrated(samples, [light], "ltsh2", "diffuse")
        assert distance(found[is_other], expected[is_other]) < limits[kind], kind
        assert np.allclose(found[~is_other], lambert[~is_other], rtol=1e-5, atol=1e-9), kind
        assert distance(lambert, expected) > 0.05, kind


@pytest.mark.newest
def test_rough_diffuse_lobes_are_those_of_a_quadrature():
    samples = random_surfaces.samples("rough", WIDTH * HEIGHT, np.random.default_rng(7))
    is_rough = np.arange(len(samples)) % 4 > 0
    sigma = rounded(np.where(is_rough, samples.diffuse_roughness, 0.0))
    samples = replace(samples, diffuse_roughness=sigma, diffuse_rebound=rounded(samples.diffuse_rebound))
    plain = replace(samples, diffuse_roughness=None, diffuse_rebound=None)
    limits = dict.fromkeys(("horizon", "tiny disk", "disk", "polygon", "spread", "ball", "sun"), 2e-3)
    limits |= {"plain": 5e-4, "near": 5e-4, "spot": CONES}

    def brdf(directions, number):
        once, again = quadrature.rough(directions, samples.diffuse_normal[number], samples.view[number], sigma[number])
        return once[:, None] + again[:, None] * samples.diffuse_rebound[number]

    with_graphics(lambda: compare_diffuse(samples, plain, is_rough, brdf, limits))


@pytest.mark.newest
def test_velvet_is_that_of_a_quadrature():
    random = np.random.default_rng(9)
    plain = random_surfaces.samples("plain", WIDTH * HEIGHT, random)
    sigma = rounded(random.uniform(0.1, 1.0, len(plain)))
    sigma[::4] = 0.0
    samples = replace(plain, sheen_a=-sigma)
    # Where a horizon cuts a light that is close, the integrator is 9 % off at one point.
    limits = {**dict.fromkeys(("plain", "near", "tiny disk", "disk", "spread", "ball"), 1e-3), "horizon": 3e-2}

    def brdf(directions, number):
        return quadrature.velvet(
            directions, samples.diffuse_normal[number], samples.view[number], max(sigma[number], 0.1)
        )

    with_graphics(lambda: compare_diffuse(samples, plain, sigma > 0.0, brdf, limits))


def test_rough_diffuse_lobes_beside_all_others_read_no_more_textures_than_there_are():
    random = np.random.default_rng(8)
    samples = random_surfaces.samples("tilted", WIDTH * HEIGHT, random)
    shape = {"anisotropy": 0.4 * (np.arange(len(samples)) % 2), "tangent": random.normal(size=(len(samples), 3))}
    samples = replace(samples, **shape, diffuse_roughness=np.full(len(samples), 0.5))
    light = random_surfaces.light("plain", 0, random)

    def draw():
        lighting, canvas = LightingPass("ltsh2"), Canvas(WIDTH, HEIGHT)
        lighting.set_lights([light])
        return [drawn(lighting, samples, canvas, name) for name in ("specular", "diffuse", "combined")]

    specular, diffuse, combined = with_graphics(draw)
    assert specular.any() and diffuse.any()
    assert excess(combined, specular + diffuse, 1e-6).max() <= 1.0


# As far as the technique is off: of lights that hardly change over the lobe, others, and where horizons cut them.
BENT = {"tiny disk": 1e-3, "bulb": 1e-3, "ball": 5e-3, "spot": 5e-3, "plain": 3e-2, "polygon": 3e-2, "near": 9e-2}


@pytest.mark.newest
def test_dielectrics_with_an_index_below_1_reflect_as_the_reference_has_it():
    """All that is beyond their angle of total reflection; the others are what they were."""
    random, count = np.random.default_rng(11), WIDTH * HEIGHT
    samples, bent = random_surfaces.samples("plain", count, random), np.arange(count) % 4 > 0
    samples = replace(
        samples,
        dielectric=np.where(bent[:, None], rounded(random.random((count, 3))), samples.dielectric),
        ior=np.where(bent, rounded(random.uniform(0.5, 0.95, count)), samples.ior),
    )

    def compare():
        for kind, light, draw in each_light("ltsh4", BENT, "specular"):
            found, plain = draw(samples), draw(replace(samples, ior=np.maximum(samples.ior, 1.0)))
            expected, shaded = (integrated(samples, [light], name, "specular") for name in ("reference", "ltsh4"))
            assert distance(found[bent], expected[bent]) < BENT[kind], kind
            assert distance(found[bent], shaded[bent]) < 1e-2, kind
            assert np.array_equal(found[~bent], plain[~bent])
            assert distance(plain[bent], expected[bent]) > 0.05

    with_graphics(compare)


BRUSHED = {"plain": 4e-3, "near": 1e-2, "disk": 4e-3, "spread": 4e-3, "spot": 1e-2}


@pytest.mark.parametrize(
    ("surface", "kinds"), [pytest.param("plain", BRUSHED, marks=pytest.mark.newest), ("tilted", ("plain", "near"))]
)
def test_anisotropic_lobes_are_those_of_the_reference_beside_isotropic_ones(surface, kinds):
    """Fewer points than the reference takes, in single precision; edges of half a circle take most."""

    def compare():
        lighting, canvas = LightingPass("ltsh2"), Canvas(WIDTH, HEIGHT)
        for kind in kinds:
            random = np.random.default_rng([len(kind), *map(ord, kind + surface)])
            samples = random_surfaces.samples(surface, WIDTH * HEIGHT, random)
            lights = [random_surfaces.light(kind, number, random) for number in range(2)]
            brushed = np.arange(len(samples)) % 4 > 0
            # That of a Principled BSDF with 0.8, or the other way round.
            anisotropy = np.where(brushed, random.choice([0.47, -0.89], len(samples)), 0.0)
            roughness = np.where(brushed, np.clip(samples.roughness, 0.1, 0.72), samples.roughness)
            tangent = random.normal(size=(len(samples), 3))
            samples = replace(samples, anisotropy=anisotropy, tangent=tangent, roughness=rounded(roughness))
            lighting.set_lights(lights)
            found = drawn(lighting, samples, canvas, "combined")
            assert (canvas.read()[..., 3] == 1.0).all()
            shaded = integrated(samples, lights, "reference")
            assert distance(found[brushed], shaded[brushed]) < BRUSHED[kind], kind
            plain = replace(samples, anisotropy=None, tangent=None)
            others = drawn(lighting, plain, canvas, "combined")[~brushed]
            assert np.array_equal(found[~brushed], others), kind

    with_graphics(compare)


@pytest.mark.newest
def test_no_input_gives_anything_but_finite_light():
    """Points on the light and in its plane, lobes without width, views along the surface and from behind it, vectors
    of no length, lights of all sizes: what a scene may hold for a moment while it is edited."""

    def draw_all():
        random = np.random.default_rng(7)
        samples = random_surfaces.samples("tilted", WIDTH * HEIGHT, random)
        lights = [random_surfaces.light(kind, 0, random) for kind in random_surfaces.LIGHTS]
        flat = replace(lights[0], center=np.zeros(3), half_u=np.eye(3)[0], half_v=np.eye(3)[1], direction=-np.eye(3)[2])
        small, far = (replace(flat, half_u=size * flat.half_u, half_v=size * flat.half_v) for size in (1e-12, 1e12))
        lights += [flat, small, far, EllipseLight.like(flat)]
        corner = np.indices((3, 3, 3)).reshape(3, -1).T - 1.0
        position = rounded(samples.position)
        position[: len(corner)] = corner
        position[100:120, 2] = 0.0
        normal = samples.normal.copy()
        normal[200:210] = 0.0
        normal[210:260] = -samples.view[210:260]
        normal[260:300] = samples.view[260:300]
        normal[300:340] = unit(np.cross(samples.view[300:340], random.normal(size=(40, 3))))
        roughness = samples.roughness.copy()
        roughness[::3] = 0.0
        samples = replace(samples, position=position, normal=normal, roughness=roughness)
        tangent = normal.copy()
        tangent[::5], tangent[1::5] = 0.0, random.normal(size=tangent[1::5].shape)
        brushed = replace(samples, tangent=tangent, anisotropy=np.where(np.arange(len(samples)) % 2, 0.9, -5.0))
        canvas = Canvas(WIDTH, HEIGHT)
        for technique in TECHNIQUES:
            lighting = LightingPass(technique)
            for light in lights:
                lighting.set_lights([light])
                drawings = [(samples, name) for name in ("specular", "diffuse", "combined")]
                for surfaces, name in [*drawings, *[(brushed, "specular")] * (technique == "ltsh4")]:
                    found = drawn(lighting, surfaces, canvas, name)
                    assert np.isfinite(found).all() and (found >= 0.0).all(), (technique, name, light.name)

    with_graphics(draw_all)


def test_a_pass_adds_to_what_is_there():
    def draw():
        samples, _, lighting = lit("ltsh2", 11)
        canvas, sum_of_both = Canvas(WIDTH, HEIGHT), Canvas(WIDTH, HEIGHT)
        each = [drawn(lighting, samples, canvas, name) for name in shading.PASSES]
        gbuffer = upload_samples(samples, WIDTH)
        lighting.draw(gbuffer, sum_of_both.buffer, "specular", view=(*EYE, 1.0))
        lighting.draw(gbuffer, sum_of_both.buffer, "diffuse", view=(*EYE, 1.0), blend="ADDITIVE")
        return each, sum_of_both.read()

    each, picture = with_graphics(draw)
    np.testing.assert_allclose(picture[..., :3].reshape(-1, 3), sum(each), rtol=1e-6)
    assert min(picture.max() for picture in each) > 0.01


@pytest.mark.newest
def test_a_thousand_lights_add_up():
    """More than one draw call takes."""

    def draw():
        samples, lights, lighting = lit("ltsh2", 17, lights=1100)
        assert len(lighting._ranges(None)) > 1
        return samples, lights, drawn(lighting, samples, Canvas(WIDTH, HEIGHT), "specular")

    samples, lights, found = with_graphics(draw)
    assert excess(found, integrated(samples, lights, "ltsh2", "specular"), RELATIVE).max() <= 1.0


def test_pixels_without_a_surface_stay_dark():
    def draw():
        samples, _, lighting = lit("ltsh4", 13, "tilted", count=40)
        canvas = Canvas(WIDTH, HEIGHT)
        pixel = np.arange(40) * 7
        pixel[-1] = WIDTH * HEIGHT - 1
        lighting.draw(upload_samples(samples, WIDTH, pixel), canvas.buffer, view=(*EYE, 1.0))
        return pixel, canvas.read().reshape(-1, 4)

    pixel, picture = with_graphics(draw)
    assert (picture[pixel, 3] == 1.0).all() and picture[pixel, :3].any(axis=1).sum() > 10
    assert not np.delete(picture, pixel, axis=0).any()
