"""The shared vocabulary: area lights as polygons, surface samples on disk, film."""

import json
from dataclasses import fields, replace

import numpy as np
import pytest
from surface_scenes import area_light, random_samples

from ltsh_addon.scene import EllipseLight, Film, PolygonLight, QuadLight, SurfaceSamples, light_records, lights_of

shapes = pytest.mark.parametrize("shape", (*QuadLight.SHAPES, *EllipseLight.SHAPES))


def vector_area(polygon):
    return 0.5 * np.cross(polygon, np.roll(polygon, -1, axis=0)).sum(axis=0)


@shapes
@pytest.mark.parametrize("mirrored", [False, True])
@pytest.mark.parametrize("seed", range(3))
def test_polygons_lie_on_the_light_have_its_area_and_wind_around_the_emitting_side(shape, mirrored, seed):
    center, half_u, half_v = np.random.default_rng(seed).normal(size=(3, 3))  # the half axes are not orthogonal
    normal = np.cross(half_u, half_v) * (-1.0 if mirrored else 1.0)
    light = area_light("Lamp", shape, center, half_u, half_v, direction=normal / np.linalg.norm(normal))
    area = vector_area(light.polygon(17))
    # Counterclockwise as seen from the lit side: the vector area points along the light's direction.
    expected = (np.pi if light.is_round else 4.0) * normal
    assert area == pytest.approx(expected, rel=1e-12)
    corners = light.polygon(24)
    assert corners.shape == ((24, 3) if light.is_round else (4, 3))
    assert np.abs((corners - center) @ normal).max() < 1e-13
    assert corners.mean(axis=0) == pytest.approx(center, abs=1e-13)


def test_round_lights_follow_the_ellipse():
    light = area_light("Lamp", "ELLIPSE", (0, 0, 0), (2.0, 0, 0), (0, 0.5, 0))
    x, y, _ = light.polygon(64).T
    # Stretched to the area of the ellipse: radius^2 = step / sin(step) = 1 + step^2 / 6
    assert (x / 2.0) ** 2 + (y / 0.5) ** 2 == pytest.approx(1.0 + (2.0 * np.pi / 64) ** 2 / 6.0, rel=1e-5)


def test_lights_refuse_what_makes_no_sense():
    with pytest.raises(ValueError, match="light 'Lamp': shape is 'POINT', expected one of SQUARE, RECTANGLE, DISK"):
        area_light("Lamp", "POINT")
    wrong = {"center": (0, 0), "half_u": (0, np.nan, 0), "radiance": (1, 2, np.inf), "direction": 1.0}
    for field, value in wrong.items():
        with pytest.raises(ValueError, match=f"light 'Lamp': {field} is .*, expected three finite numbers"):
            replace(area_light("Lamp"), **{field: value})


def test_lights_survive_their_records_many_alike_in_one():
    """In their order, bit for bit; those that differ in more than their vectors are kept apart."""
    generator = np.random.default_rng(1)
    fans = [
        PolygonLight("Lamp", *generator.normal(size=(5, 3)), group="A", corners=generator.normal(size=(count, 3)))
        for count in np.repeat([4, 3, 4], 40)
    ]
    lights = [*fans, *(area_light(center=place) for place in generator.normal(size=(30, 3))), area_light(spread=1.0)]
    lights.append(replace(area_light(), children=(area_light(),)))
    records = json.loads(json.dumps(light_records(lights)))
    assert len(records) == 6
    for light, other in zip(lights, lights_of(records), strict=True):
        assert light.record() == other.record()
        assert np.array_equal(light.area_vector, other.area_vector)
    records[0]["vectors"] = records[0]["vectors"][:-8]
    with pytest.raises(ValueError, match="size"):
        lights_of(records)


def test_altered_lights_forget_what_they_have_computed():
    light = area_light()
    assert light.area_vector.any()
    wider = light.altered(half_u=2.0 * light.half_u)
    assert np.allclose(wider.area_vector, 2.0 * light.area_vector)


@pytest.mark.parametrize("field", [field.name for field in fields(SurfaceSamples)])
def test_samples_refuse_wrong_shapes(field):
    samples = random_samples(5)
    value = getattr(samples, field)
    for wrong in (value[..., None], value[:-1] if field != "position" else value[:, :2]):
        with pytest.raises(ValueError, match="surface samples: .* has shape .*, expected"):
            replace(samples, **{field: wrong})


def test_optional_fields_default_to_a_surface_without_bumps():
    samples = random_samples(5)
    optional = ("geometric_normal", "smooth_normal", "bump_alpha2")
    own = {field.name: getattr(samples, field.name) for field in fields(samples) if field.name not in optional}
    made = SurfaceSamples(**own)
    assert np.array_equal(made.geometric_normal, samples.normal)
    assert np.array_equal(made.smooth_normal, samples.diffuse_normal)
    assert np.array_equal(made.bump_alpha2, np.zeros(5))


def test_samples_are_taken_by_index_mask_and_slice():
    samples = random_samples(6)
    mask = np.array([True, False, True, False, False, True])
    for index in (np.array([0, 2, 5]), mask):
        assert np.array_equal(samples.take(index).roughness, samples.roughness[[0, 2, 5]])
    assert len(samples.take(slice(1, 4))) == 3


@pytest.mark.parametrize("channels", [(), (1,), (3,)])
@pytest.mark.parametrize("sub_samples", [1, 4])
@pytest.mark.parametrize("count", [0, 30])
def test_images_are_means_over_the_sub_samples_with_row_0_on_top(channels, sub_samples, count):
    generator = np.random.default_rng(1)
    pixel = np.sort(generator.integers(0, 5 * 4, count))
    film = Film(5, 4, pixel, sub_samples)
    values = generator.normal(size=(count, *channels))
    image = film.image(values)
    assert image.shape == (4, 5, *channels)
    # The order of summation may differ: a few units in the last place of sums of up to 30 terms
    expected = np.zeros((4, 5, *channels))
    for place, value in zip(pixel, values, strict=True):
        expected[place // 5, place % 5] += value / sub_samples
    assert np.abs(image - expected).max() < 1e-14


def test_coverage_is_the_share_of_hits():
    film = Film(2, 1, np.array([0, 0, 0, 1]), sub_samples=4)
    assert np.array_equal(film.coverage(), [[0.75, 0.25]])
