"""Directions toward lights: where their points lie, and that they are spread evenly."""

import numpy as np
import pytest
from textbook import lhuilier

from ltsh_addon.visibility import ray_sampler, sampling


@pytest.mark.parametrize("power", range(1, 9))
def test_every_first_power_of_two_of_points_is_stratified(power):
    """In each of the rectangles of area 2^-power that halving the square gives lies one point, for any seed."""
    count = 2**power
    for seed in (1, 2, 3):
        for change in (0, 0x2ABCDE, 0x155555):
            x, y = sampling.sequence(1024, seed)[:, :count] ^ np.uint32(change)
            for bits in range(power + 1):
                cell = (x >> (sampling.BITS - bits)) * 2 ** (power - bits) + (y >> (sampling.BITS - power + bits))
                assert len(np.unique(cell)) == count


def test_points_of_samples_lie_in_the_unit_interval_and_differ():
    rng = np.random.default_rng(1)
    seeds = sampling.seeds_of(rng.normal(size=(2000, 3)))
    assert len(np.unique(seeds)) > 1995
    for stream in (0, 1):
        points = np.stack(sampling.unit_points(seeds, stream, 0, 64))
        assert points.min() > 0.0 and points.max() < 1.0
        # Means of 64 stratified points are within 1 / 64 of the middle; over all samples there is no bias.
        assert np.abs(points.mean(axis=1) - 0.5).max() < 1.0 / 64.0
        assert np.abs(points[:, 0].mean(axis=1) - 0.5).max() < 5.0 / np.sqrt(12.0 * 2000.0)


def seen_quads(kind, count, rng):
    """Corners (3, 4, Q) of parallelograms around points."""
    center, half_u, half_v = rng.normal(size=(3, 3, count))
    if kind == "tiny":
        half_u, half_v = 1e-4 * half_u, 1e-4 * half_v
    elif kind == "over all of the sky":
        center = 0.02 * center
    elif kind == "hair":
        half_u = 1e-3 * half_u
    return np.stack([center + s * half_u + t * half_v for s, t in ((-1, -1), (1, -1), (1, 1), (-1, 1))], axis=1)


@pytest.mark.parametrize("kind", ("plain", "tiny", "hair", "over all of the sky"))
def test_directions_are_spread_evenly_over_the_solid_angle(kind):
    corners = seen_quads(kind, 60, np.random.default_rng(4))
    quads = sampling.SphericalQuads(corners.astype(np.float32))
    unit = np.moveaxis(corners / np.linalg.norm(corners, axis=0), 0, -1)
    expected = lhuilier(*unit[:3]) + lhuilier(*unit[[0, 2, 3]])
    # Corners 1e-4 apart have three digits in single precision.
    np.testing.assert_allclose(quads.solid_angle, expected, rtol=3e-2 if kind == "tiny" else 2e-3)
    x, y = np.repeat(((np.arange(4096) + 0.5) / 4096)[:, None], 60, 1), np.empty((4096, 60))
    y[:] = ((np.arange(4096) * 0.6180339887498949) % 1.0)[:, None]
    found = quads.directions(x.astype(np.float32), y.astype(np.float32), np.empty((3, 4096, 60), np.float32))
    np.testing.assert_allclose(np.linalg.norm(found, axis=0), 1.0, atol=1e-6)
    # The mean direction times the solid angle is half the sum of the angles of the edges times their normals (Lambert).
    following = np.roll(unit, -1, axis=0)
    across = np.cross(unit, following)
    length = np.linalg.norm(across, axis=-1, keepdims=True)
    angle = np.arctan2(length, (unit * following).sum(axis=-1, keepdims=True))
    vector = 0.5 * (across / length * angle).sum(axis=0)
    vector *= np.sign((vector * unit.mean(axis=0)).sum(axis=1))[:, None]
    mean = found.mean(axis=1, dtype=np.float64).T * quads.solid_angle[:, None]
    assert (np.linalg.norm(mean - vector, axis=1) < 5e-3 * quads.solid_angle).mean() > 0.95
    # All lie inside: on the inner side of all edges.
    side = np.einsum("vqk,ksq->vsq", across / length, found)
    inside = (side > -1e-4).all(axis=0) | (side < 1e-4).all(axis=0)
    assert inside.mean() > 0.999


def test_a_warp_and_its_inverse_are_one_another():
    rng = np.random.default_rng(7)
    normal, view = rng.normal(size=(2, 3, 200))
    normal /= np.linalg.norm(normal, axis=0)
    view /= np.linalg.norm(view, axis=0)
    view *= np.sign((view * normal).sum(axis=0))
    view[:, :50] = normal[:, :50]
    normal, view = normal.astype(np.float32), view.astype(np.float32)
    cosine, sine, rows = sampling.frames(normal, view)
    np.testing.assert_allclose(
        np.einsum("ikq,jkq->qij", rows, rows), np.broadcast_to(np.eye(3), (200, 3, 3)), atol=1e-6
    )
    np.testing.assert_allclose(sine[None] * rows[0] + cosine[None] * rows[2], view, atol=2e-6)
    warps = sampling.Warps(rows, cosine, sine, rng.uniform(0.01, 1.0, 200).astype(np.float32))
    world = rng.normal(size=(3, 5, 200)).astype(np.float32)
    world /= np.linalg.norm(world, axis=0)
    local = warps.local(world)
    warped = warps.warped(local)
    expected = np.linalg.norm(warped, axis=0)
    np.testing.assert_allclose(warps.lengths(local), expected, rtol=1e-4)
    unit = warped / expected
    lengths = warps.unwarped(unit)
    np.testing.assert_allclose(lengths, expected, rtol=2e-3)
    np.testing.assert_allclose(warps.world(unit), world, atol=2e-3)


def test_densities_beyond_single_precision_are_infinite_without_a_warning():
    """Warnings are errors in tests. A ray of infinite density weighs nothing."""
    density = ray_sampler._after_warp(np.float32([1e6, 2.0]), np.float32([1e-11, 0.5]))
    assert density[0] == np.inf and density[1] == 16.0
