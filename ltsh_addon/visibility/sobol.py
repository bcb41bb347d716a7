"""The Sobol sequence, scrambled by seeds of the samples: the numbers that choose the directions of rays."""

from __future__ import annotations

import numpy as np

# Bits of a coordinate of the sequence, as many as single precision holds.
BITS = 23
# Length of each sequence
MOST_POINTS = 1024


def sequence(count: int, seed: int = 1) -> np.ndarray:
    """The first `count` points (2, count) of the Sobol sequence, uint32 of 23 bits, scrambled as by Owen (1995).

    Each block of 2^k points that starts at a multiple of 2^k is stratified as well as can be. XOR with any number keeps
    this property.
    """
    number = np.arange(count, dtype=np.uint32)
    points = np.zeros((2, count), np.uint32)
    direction = np.uint32(1) << np.uint32(31)
    for bit in range(32):
        is_set = (number >> np.uint32(bit)) & np.uint32(1)
        points[0] ^= is_set << np.uint32(31 - bit)
        points[1] ^= is_set * direction
        direction ^= direction >> np.uint32(1)
    scrambled = [_nested_scramble(row, 2 * seed + axis) for axis, row in enumerate(points)]
    return np.stack(scrambled) >> np.uint32(32 - BITS)


def _nested_scramble(values, seed):
    """Scrambled uint32 values: Laine and Karras 2011, "Stratified sampling for stochastic transparency", with the
    constants of Vegdahl."""
    values = _reversed_bits(values) + np.uint32(seed * 0x9E3779B1 & 0xFFFFFFFF)
    for factor in (0x6C50B47C, 0xB82F1E52, 0xC7AFE638, 0x8D22F6E6):
        values = values ^ (values * np.uint32(factor))
    return _reversed_bits(values)


def _reversed_bits(values):
    for shift, mask in ((1, 0x55555555), (2, 0x33333333), (4, 0x0F0F0F0F), (8, 0x00FF00FF), (16, 0x0000FFFF)):
        low, step = np.uint32(mask), np.uint32(shift)
        values = ((values >> step) & low) | ((values & low) << step)
    return values


_POINTS = [sequence(MOST_POINTS, seed) for seed in (1, 2)]


def unit_points(seeds: np.ndarray, stream: int, first: int, last: int) -> list[np.ndarray]:
    """Numbers x, y (S, Q) in (0, 1): the points `first` to `last` of the sequence `stream`, 0 or 1, scrambled by the
    seeds (Q,)."""
    coordinates = []
    for axis, points in enumerate(_POINTS[stream][:, first:last]):
        scrambled = mixed_bits(seeds + np.uint32((2 * stream + axis) * 0x9E3779B1 & 0xFFFFFFFF)) >> np.uint32(32 - BITS)
        numbers = (points[:, None] ^ scrambled).astype(np.float32)
        numbers += np.float32(0.5)
        numbers *= np.float32(2.0**-BITS)
        coordinates.append(numbers)
    return coordinates


def seeds_of(position: np.ndarray) -> np.ndarray:
    """Seeds (P,) uint32 of points (P, 3). They do not depend on the place of a point in a picture or a block."""
    bits = np.ascontiguousarray(position, dtype=np.float32).view(np.uint32)
    return mixed_bits(mixed_bits(mixed_bits(bits[:, 0]) ^ bits[:, 1]) ^ bits[:, 2])


def mixed_bits(values):
    """A hash of uint32 (Wellons 2018, "lowbias32")."""
    values = (values ^ (values >> np.uint32(16))) * np.uint32(0x7FEB352D)
    values = (values ^ (values >> np.uint32(15))) * np.uint32(0x846CA68B)
    return values ^ (values >> np.uint32(16))
