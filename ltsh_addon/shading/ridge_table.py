"""A lookup table made ready for the hot path: float32, premultiplied weights of polygon moments, few channels.

The coefficients of a spherical harmonics table are turned into weights of the moments of `edge_loop` once, at the nodes
of the table: both steps are linear, so they may change places with the interpolation. Only the Fresnel curves that a
batch of points needs are fetched, and those of a dielectric of known index of refraction are summed up beforehand.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from . import edge_loop
from .lookup_table import MIN_ALPHA, LookupTable, warp_entries

# Sharper lobes amplify the rounding of directions too much for single precision: at this roughness 2 alpha = 0.02.
SHARP_ROUGHNESS = 0.1
DIELECTRICS_KEPT = 64


@dataclass(frozen=True)
class RidgeTable:
    """One table; `fetch` interpolates chosen vectors of its weights.

    A vector is a Fresnel curve's number, ("dielectric", ior), or "dielectric", the last, for each sample's own IOR.
    """

    source: LookupTable
    parameters: np.ndarray  # (3 or 4, R * T): A, B, C and the tilt of "ltc"
    weights: np.ndarray  # (F, K, R * T): weights of the moments; of the clamped cosine for "ltc"
    _stacked: dict = field(default_factory=dict)

    @property
    def degree(self) -> int:
        """Degree of the moments; 1 for "ltc", which needs the integral of z alone."""
        return self.source.degree

    def channels(self, vectors: tuple) -> np.ndarray:
        """Float32 array (C, R * T): the warp's parameters, then the K weights of each vector."""
        stacked = self._stacked.get(vectors)
        if stacked is None:
            if len(self._stacked) >= DIELECTRICS_KEPT:
                self._stacked.clear()
            parts = [self.parameters, *(self._vector(vector) for vector in vectors)]
            stacked = self._stacked[vectors] = np.concatenate(parts).astype(np.float32)
        return stacked

    def _vector(self, vector):
        if not isinstance(vector, tuple):
            return self.weights[vector]
        _, ior = vector
        shares = self.source.dielectric_weights(np.array([ior]))[:, 0]
        return sum(share * weights for share, weights in zip(shares, self.weights, strict=True))

    def fetch(self, vectors, cosine, sine, roughness, ior, scratch) -> tuple[np.ndarray, np.ndarray, np.ndarray | None]:
        """Warp entries (4, P) xx, xz, yy, zz, weights (len(vectors), K, P), and the tilt (P,) of "ltc", else None.

        cosine and sine (P,) of theta_o and roughness (P,) in float32; ior (P,). Valid until the next call with this
        scratch.
        """
        many = vectors[-1] == "dielectric"
        curves = tuple(range(len(self.weights)))
        channels = self.channels(vectors[:-1] + curves if many else vectors)
        shape = self.source.warp.shape[:2]
        theta = np.arctan2(sine, cosine)
        coordinate = 1.0 - np.sqrt(np.maximum(1.0 - theta * np.float32(2.0 / np.pi), np.float32(0.0)))
        values = _bilinear(channels, shape, roughness, coordinate, scratch)
        alpha = np.maximum(roughness * roughness, np.float32(MIN_ALPHA))
        warp = np.stack(warp_entries(cosine, alpha, *values[:3], sine=sine))
        count = len(self.parameters)
        weights = values[count:].reshape(-1, self.weights.shape[1], len(roughness))
        if many:
            first = len(vectors) - 1
            shares = self.source.dielectric_weights(ior).astype(np.float32)
            combined = sum(share * vector for share, vector in zip(shares, weights[first:], strict=True))
            weights = np.concatenate([weights[:first], combined[None]])
        return warp, weights, values[3] if count == 4 else None


def prepare(table: LookupTable) -> RidgeTable:
    """The table for the hot path, with weights of the moments of `edge_loop`, made once per table. Degrees above
    `edge_loop.MAX_DEGREE` have none: ValueError."""
    return _kept(table, "_ridge_table", lambda: _product(table.ridge_weights, edge_loop.form_matrix(table.degree)))


def along_directions(table: LookupTable) -> RidgeTable:
    """As `prepare`, with weights of the moments of `edge_integrals`, which shaders use."""
    return _kept(table, "_direction_table", lambda: table.ridge_weights)


def _kept(table, name, matrix):
    """The table made once, weights of moments by matrix() (K, K)."""
    if table.degree > edge_loop.MAX_DEGREE:
        raise ValueError(
            f"table {table.name} has degree {table.degree}, the single precision path goes up to "
            f"{edge_loop.MAX_DEGREE}: use float64"
        )
    # Stored with the table, which is frozen but for what it caches, so that both end together.
    ridges = table.__dict__.get(name)
    if ridges is None:
        ridges = table.__dict__[name] = _build(table, matrix)
    return ridges


def _build(table, matrix):
    rows, columns, curves, count = table.coefficients.shape
    flat = table.coefficients.reshape(rows * columns, curves, count)
    if table.family == "ltsh":
        flat = _product(flat, matrix())
    return RidgeTable(table, table.warp.reshape(rows * columns, -1).T, flat.transpose(1, 2, 0))


def _product(vectors, matrix):
    """Vectors (..., K) times a matrix (K, K). Not a matrix product of numpy's: the same bits on every machine."""
    return sum(vectors[..., k, None] * row for k, row in enumerate(matrix))


def _bilinear(channels, shape, roughness, coordinate, scratch):
    """Channels (C, P) at roughness and theta coordinate (P,) in [0, 1]."""
    rows, columns = shape
    row_position = roughness * np.float32(rows - 1)
    column_position = coordinate * np.float32(columns - 1)
    row = np.minimum(row_position.astype(np.intp), rows - 2)
    column = np.minimum(column_position.astype(np.intp), columns - 2)
    row_weight = (row_position - row).astype(np.float32)
    column_weight = (column_position - column).astype(np.float32)
    corner = row * columns + column
    size = (len(channels), len(roughness))
    taps = [scratch(f"tap{number}", size) for number in range(4)]
    for tap, step in zip(taps, (0, 1, columns, columns + 1), strict=True):
        np.take(channels, corner + step, axis=1, out=tap, mode="clip")
    for near, far, weight in ((taps[0], taps[1], column_weight), (taps[2], taps[3], column_weight),
                              (taps[0], taps[2], row_weight)):  # fmt: skip
        far -= near
        far *= weight
        near += far
    return taps[0]
