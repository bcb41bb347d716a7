"""Seams of UV maps: what lies beyond them, filters that see the surface go on, and lights that fit."""

import numpy as np
import pytest

from ltsh_addon.cycles.texels import NOT_BAKED
from ltsh_addon.cycles.uv import UvTriangles
from ltsh_addon.imaging.denoise import NoDenoiser
from ltsh_addon.imaging.seams import SeamFit, TexelGrid, canvas_of, islands_of
from ltsh_addon.pipeline import lightmap

SIZE = 64


def grid(corners, uv, normals=None):
    """The grid of triangles with corners (T, 3, 3) and `uv` (T, 3, 2) in texels."""
    uv, corners = np.array(uv, float), np.array(corners, float)
    texels = UvTriangles(uv, SIZE, SIZE).texels(0, SIZE)
    triangle = np.full(SIZE * SIZE, -1)
    triangle[texels.index] = texels.triangle
    if normals is None:
        sides = corners[:, 1:] - corners[:, :1]
        normals = np.cross(sides[:, 0], sides[:, 1])
        normals = np.repeat((normals / np.linalg.norm(normals, axis=1, keepdims=True))[:, None], 3, axis=1)
    return TexelGrid(triangle.reshape(SIZE, SIZE), uv, corners, normals)


def quad(points, texels):
    """Two triangles of a quad: corners and UV."""
    points, texels = np.array(points, float), np.array(texels, float)
    return points[[[0, 1, 2], [0, 2, 3]]], texels[[[0, 1, 2], [0, 2, 3]]]


def wall(second=((1, 0, 0), (2, 0, 0), (2, 1, 0), (1, 1, 0))):
    """A wall of two quads that meet at x = 1. In the texture the right one is turned and twice as fine."""
    left = quad(((0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0)), ((3.2, 4.3), (19.2, 4.3), (19.2, 20.3), (3.2, 20.3)))
    right = quad(second, ((60.4, 25.1), (60.4, 57.1), (28.4, 57.1), (28.4, 25.1)))
    return grid(*(np.concatenate(both) for both in zip(left, right, strict=True)))


def positions(made):
    """The places (H, W, 3) that texels show, by the affine map of their triangles."""
    image = np.zeros((SIZE, SIZE, 3))
    for number in range(len(made.uv)):
        y, x = np.nonzero(made.triangle == number)
        matrix = np.concatenate([made.uv[number], np.ones((3, 1))], axis=1)
        texels = np.stack([x + 0.5, y + 0.5, np.ones(len(x))], axis=1)
        image[y, x] = texels @ np.linalg.solve(matrix, made.corners[number])
    return image


def looked_up(image, place):
    """Bilinear values (Q, C) of an image (H, W, C) at places (Q, 2), written out for each one."""
    values = []
    for x, y in place - 0.5:
        column, row = int(np.floor(x)), int(np.floor(y))
        right, up = x - column, y - row
        low = (1 - right) * image[row, column] + right * image[row, column + 1]
        high = (1 - right) * image[row + 1, column] + right * image[row + 1, column + 1]
        values.append((1 - up) * low + up * high)
    return np.array(values)


def at_seam(count=40):
    """Points of both sides of the seam of `wall` in the texture."""
    share = np.linspace(0.03, 0.97, count)[:, None]
    left = (1 - share) * (19.2, 4.3) + share * (19.2, 20.3)
    return left, (1 - share) * (60.4, 25.1) + share * (28.4, 25.1)


def test_faces_that_share_an_edge_of_the_texture_are_an_island():
    made = islands_of(wall())
    assert made.number.tolist() == [0, 0, 1, 1]
    assert len(made.seams.other) == 2


def test_beyond_a_seam_the_canvas_shows_where_the_surface_goes_on():
    made = wall()
    canvas = canvas_of(islands_of(made))
    shown, mask = canvas.put(positions(made))
    # Places along x and y of the wall, wherever the canvas has them: a step between neighbors is that of one texel.
    flat, width = shown.reshape(-1, 3), canvas.shape[1]
    for step in (1, width):
        both = np.flatnonzero(mask.reshape(-1)[:-step] & mask.reshape(-1)[step:])
        moved = np.linalg.norm(flat[both + step] - flat[both], axis=1)
        # Frames of different islands may touch.
        assert np.mean(moved < 1.01 / 16.0) > 0.97
    assert len(canvas.frame) > 2 * 8 * 16  # both frames, as deep as 8 texels, along 16 and 32 texels


def test_what_is_taken_from_the_canvas_is_what_was_put():
    made, image = wall(), np.random.default_rng(1).random((SIZE, SIZE, 3))
    canvas = canvas_of(islands_of(made))
    taken = canvas.taken(canvas.put(image)[0], image)
    assert np.abs(taken - image).max() < 1e-6


def test_lights_fit_at_a_seam_and_change_nowhere_else():
    made = wall()
    place, is_left = positions(made), np.isin(made.triangle, (0, 1))
    # One side is 5 % brighter, as different noise leaves it.
    image = np.where(made.triangle[..., None] >= 0, 1.0 + 0.3 * place, 0.0)
    image[is_left] *= 1.05
    fitted = image.copy()
    SeamFit(islands_of(made)).fit(fitted)
    step = np.abs(np.subtract(*(looked_up(fitted, side) for side in at_seam())))
    assert np.abs(np.subtract(*(looked_up(image, side) for side in at_seam()))).max() > 0.05
    # A hundredth of the light is what an eye may see (Weber).
    assert step.max() < 0.01 * image.max()
    far = (made.triangle >= 0) & (np.abs(place[..., 0] - 1.0) > 6.0 / 16.0)
    assert np.array_equal(fitted[far], image[far])


def test_light_that_is_smooth_on_the_surface_keeps_its_texels():
    made = wall()
    image = np.where(made.triangle[..., None] >= 0, 1.0 + 0.3 * positions(made), 0.0)
    fitted = image.copy()
    SeamFit(islands_of(made)).fit(fitted)
    # Bilinear lookups have linear light exactly, except beside the ends of the seam, where the surface ends.
    covered = made.triangle >= 0
    assert np.abs(fitted - image)[covered].max() < 0.005
    inner = slice(4, -4)
    assert np.abs(np.subtract(*(looked_up(fitted, side[inner]) for side in at_seam()))).max() < 0.005


@pytest.mark.parametrize("angle", [60.0, 180.0])
def test_a_fold_has_a_light_for_each_of_its_sides(angle):
    x, z = np.cos(np.radians(angle)), np.sin(np.radians(angle))
    made = wall(((1, 0, 0), (1 + x, 0, z), (1 + x, 1, z), (1, 1, 0)))
    image = np.where(np.isin(made.triangle, (0, 1))[..., None], 1.0, np.zeros(3))
    fitted, islands = image.copy(), islands_of(made)
    SeamFit(islands).fit(fitted)
    assert np.array_equal(fitted, image)
    # At 60 degrees a filter sees the next face; a sheet's other side is none.
    assert (len(canvas_of(islands).frame) > 0) == (angle < 90.0)


def test_without_a_denoiser_light_is_smoothed_and_it_is_said(monkeypatch):
    def none(*arguments):
        raise NoDenoiser("no library")

    monkeypatch.setattr(lightmap, "open_denoiser", none)
    made = wall()
    covered = made.triangle >= 0
    noisy = np.where(covered[..., None], np.random.default_rng(2).gamma(4.0, 0.25, (SIZE, SIZE, 3)), NOT_BAKED)
    guides = np.where(covered[..., None], np.array([0.5, 0.5, 0.5, 0.0, 0.0, 1.0]), 0.0)
    done, said = lightmap.denoised_rest({("diffuse", 0): noisy.astype(np.float32)}, guides, islands_of(made), 64)
    smooth = done["diffuse", 0]
    assert "not denoised" in said and "no library" in said
    assert smooth[covered].std() < 0.5 * noisy[covered].std() and not smooth[~covered].any()


def test_light_without_color_owes_nothing_to_the_color_of_the_surface():
    made = wall()
    covered = made.triangle >= 0
    noisy = np.where(covered[..., None], np.random.default_rng(2).gamma(4.0, 0.25, (SIZE, SIZE, 3)), NOT_BAKED)
    done = []
    for color in (0.5, np.random.default_rng(3).uniform(0.1, 0.9, (SIZE, SIZE, 1))):
        guides = np.zeros((SIZE, SIZE, 6), np.float32)
        guides[..., :3], guides[..., 5] = color, 1.0
        light = {("diffuse", 0): noisy.astype(np.float32)}
        done.append(lightmap.denoised_rest(light, guides, islands_of(made), 64)[0]["diffuse", 0])
    np.testing.assert_array_equal(*done)


def test_the_sharp_edge_of_a_shadow_across_a_seam_is_not_below_black():
    made = wall()
    place = positions(made)
    for slope in (-0.4, 0.0, 0.3, 1.1):
        is_lit = (made.triangle >= 0) & (place[..., 1] > 0.45 + slope * (place[..., 0] - 1.0))
        fitted = np.repeat(is_lit[..., None], 3, axis=-1).astype(float)
        SeamFit(islands_of(made)).fit(fitted)
        assert fitted[made.triangle >= 0].min() >= 0.0
