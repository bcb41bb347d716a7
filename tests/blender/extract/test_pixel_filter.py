"""Points drawn from the file's pixel filter, and edges that are those of a plain render."""

import bpy
import numpy as np
import pytest
import scene_parts
from film_scenes import SIZE, compared, diffuse, plain_diffuse
from scene_parts import add_plane

from ltsh_addon.blender import render_settings
from ltsh_addon.blender.process.pixels import PixelJob, extract_pixels
from ltsh_addon.scene import Film

FILTERS = [("BOX", 4.0), ("GAUSSIAN", 1.0), ("BLACKMAN_HARRIS", 1.5), ("BLACKMAN_HARRIS", 3.0)]


@pytest.mark.parametrize(("kind", "width"), FILTERS)
def test_quantiles_invert_the_integral_of_the_density(kind, width):
    integrate = pytest.importorskip("scipy.integrate")
    half = render_settings.filter_density(kind, width, 0.0)[1]

    def density(x):
        return float(render_settings.filter_density(kind, width, x)[0])

    whole = integrate.quad(density, -half, half)[0]
    for share in (0.001, 0.2, 0.5, 0.77, 0.999):
        x = float(render_settings.filter_quantiles(kind, width, share))
        assert abs(integrate.quad(density, -half, x)[0] / whole - share) < 1e-6


def test_points_are_centers_for_one_and_have_the_spread_of_the_filter():
    assert np.array_equal(render_settings.filter_points("BLACKMAN_HARRIS", 1.5, 1), [[0.0, 0.0]])
    x = np.linspace(-3.0, 3.0, 6001)
    for kind, width in FILTERS:
        weight = render_settings.filter_density(kind, width, x)[0]
        spread = np.sqrt((weight * x**2).sum() / weight.sum())
        points = render_settings.filter_points(kind, width, 1024)
        assert np.abs(points.mean(axis=0)).max() < 0.01 * spread
        assert np.abs(points.std(axis=0) / spread - 1.0).max() < 0.01


def test_an_unknown_filter_is_refused():
    with pytest.raises(ValueError, match="pixel filter is 'MITCHELL'"):
        render_settings.filter_points("MITCHELL", 1.0, 4)


def stripes(kind, width):
    """A black floor with white bars, most edges slanted, under an even light; sees through the filter of `kind`."""
    scene = scene_parts.empty_scene(*SIZE)
    scene_parts.add_top_camera(6.5)
    scene_parts.add_area_light("Key", location=(0.0, 0.0, 6.0), rotation=(0.0, 0.0, 0.0), size=12.0, size_y=12.0)
    bpy.data.objects["Key"].visible_camera = False
    add_plane(diffuse("Black", (0.0, 0.0, 0.0)), size=20.0, name="Floor")
    for k in range(6):
        bar = add_plane(diffuse(f"White {k}", (1.0, 1.0, 1.0)), size=1.0, name=f"Bar {k}")
        bar.location, bar.rotation_euler, bar.scale = (k - 2.5, 0.0, 1e-4), (0.0, 0.0, 0.15 * k), (0.4, 3.0, 1.0)
    scene.camera.location.z = 7.0
    scene.cycles.pixel_filter_type, scene.cycles.filter_width = kind, width
    return scene


@pytest.mark.parametrize(("kind", "width"), FILTERS[:3])
def test_edges_are_those_of_a_plain_render(tmp_path, kind, width):
    scene = stripes(kind, width)
    count = 64
    path = scene_parts.save(tmp_path / "scene.blend")
    errors = {}
    for name in (kind, "other"):
        if name == "other":
            scene.cycles.pixel_filter_type, scene.cycles.filter_width = "GAUSSIAN", 3.0
        found = extract_pixels(PixelJob(path, sub_samples=count))
        white = found.film.image(found.samples.diffuse_albedo)[..., 0]
        _, plain = plain_diffuse(tmp_path, samples=1024)
        errors[name] = np.abs(white - plain[..., 0])
    assert white.min() == 0.0 and white.max() > 0.9 and ((white > 0.1) & (white < 0.9)).sum() > 60
    # The discrepancy of n points for half-planes is about n^(-3/4) (Beck 1987), and a pixel sees up to two edges. On
    # average they do three times better than random ones, whose standard deviation is 0.5 n^(-1/2).
    assert errors[kind].max() < 2.0 * count**-0.75 and errors[kind].mean() < 0.5 * count**-0.5 / 3.0
    assert errors["other"].max() > 2.0 * count**-0.75 and errors["other"].mean() > 0.5 * count**-0.5 / 3.0


def test_shaded_edges_are_those_of_a_plain_render_and_of_the_reference(tmp_path):
    """All the way: radiance with --aa 64 in the filter that files have by default."""
    stripes("BLACKMAN_HARRIS", 1.5)
    report, layers = compared(tmp_path, sub_samples=64, cycles_samples=1024)
    assert report["pixel_filter"] == "BLACKMAN_HARRIS 1.5 px"
    plain, _ = plain_diffuse(tmp_path, samples=1024)
    peak = plain.max()
    for name in ("ltc.diffuse", "cycles.diffuse"):
        error = np.abs(layers[name] - plain) / peak
        # As above; the plain render has noise of its own, 0.5 / 1024^(1/2) where a pixel is half white.
        assert error.max() < 2.0 * 64**-0.75 + 0.016 and error.mean() < 0.5 * 64**-0.5 / 3.0
    # The very same points on both sides: what is left is noise.
    figures = report["passes"]["diffuse"]["techniques"]["ltc"]["against_cycles"]
    assert figures["unbiased_relative_error"] < 0.005
    assert np.abs(layers["ltc.diffuse"] - layers["cycles.diffuse"]).max() < 0.02 * peak


@pytest.mark.parametrize("kind", ["BOX", "GAUSSIAN", "BLACKMAN_HARRIS"])
@pytest.mark.parametrize("count", [1, 5, 17, 65])
def test_balanced_points_have_their_mean_in_the_center_and_the_spread_of_the_filter(kind, count):
    points = render_settings.balanced_points(kind, 1.5, count)
    assert points.shape == (count, 2)
    np.testing.assert_array_equal(points[0], 0.0)
    np.testing.assert_allclose(points.mean(axis=0), 0.0, atol=1e-12)
    many = render_settings.filter_points(kind, 1.5, 4096).std(axis=0)
    if count > 5:
        # The center itself is one of so many points.
        np.testing.assert_allclose(points.std(axis=0), many, rtol=2.0 / np.sqrt(count) ** 1.5 + 1.0 / count)


SIDE = 16  # pixels


def coverage_of_a_disk(disk, points, weights):
    """By the points of each pixel that are inside of the disk: left, top and radius in pixels."""
    y, x = np.mgrid[:SIDE, :SIDE].reshape(2, -1) + 0.5
    inside = [np.hypot(x + right - disk[0], y - up - disk[1]) < disk[2] for right, up in points]
    pixel = np.concatenate([np.flatnonzero(one) for one in inside])
    film = Film(SIDE, SIDE, pixel, len(points))
    if weights is not None:
        number = np.repeat(np.arange(len(points)), [one.sum() for one in inside])
        film = film.shared(weights, number, np.ones((SIDE, SIDE), bool))
    return film.coverage()


@pytest.mark.parametrize(("kind", "width"), [("BLACKMAN_HARRIS", 1.5), ("GAUSSIAN", 1.2)])
@pytest.mark.parametrize("count", [4, 8, 17])
def test_pixels_that_share_their_points_show_smoother_edges(kind, width, count):
    half = render_settings.filter_density(kind, width, np.zeros(1))[1]
    steps = (np.arange(48) + 0.5) / 24.0 * half - half
    weight = render_settings.filter_density(kind, width, steps)[0]
    weight = np.outer(weight, weight) / np.square(weight.sum())
    y, x = np.mgrid[:SIDE, :SIDE] + 0.5
    alone, shared = (
        make(kind, width, count) for make in (render_settings.balanced_points, render_settings.shared_points)
    )
    squares = np.zeros(2)
    for left, top, radius in np.random.default_rng(count).uniform(5.0, 8.0, (12, 3)):
        apart = np.hypot(x[..., None, None] + steps - left, y[..., None, None] + steps[:, None] - top)
        true = ((apart < radius) * weight).sum(axis=(2, 3))
        for number, found in enumerate(((alone, None), shared)):
            squares[number] += np.square(coverage_of_a_disk((left, top, radius), *found) - true).mean()
    # Twice as many effective points have 0.71 of the error or less, some 12 disks tell that to a tenth.
    assert np.sqrt(squares[1]) < 0.8 * np.sqrt(squares[0])


def test_shared_points_fill_the_picture_and_nothing_around_its_region():
    points, weights = render_settings.shared_points("BLACKMAN_HARRIS", 1.5, 5)
    seen = np.zeros((SIDE, SIDE), bool)
    seen[3:9, 4:] = True
    pixel, number = np.tile(np.flatnonzero(seen), len(points)), np.repeat(np.arange(len(points)), seen.sum())
    film = Film(SIDE, SIDE, pixel, len(points)).shared(weights, number, seen)
    np.testing.assert_allclose(film.coverage(), seen, atol=1e-6)
    mask = np.zeros_like(seen)
    mask[5, 6] = True
    assert film.reached(mask).sum() == 9 and film.unspread().reached(mask).sum() == 1


@pytest.mark.parametrize(("kind", "width"), [("GAUSSIAN", 4.0), ("BOX", 1.5)])
def test_very_wide_filters_and_boxes_share_no_points(kind, width):
    points, weights = render_settings.shared_points(kind, width, 5)
    assert weights is None and np.array_equal(points, render_settings.balanced_points(kind, width, 5))
