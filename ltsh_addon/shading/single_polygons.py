"""`integrate_polygon` in single precision: given polygons in local frames, one lobe each."""

from __future__ import annotations

from functools import partial

import numpy as np

from . import edge_loop, ridge_table
from .light_polygons import integrate_visible

# Corners per chunk: a compromise between calls of numpy and arrays that stay in the cache.
CORNERS = 49216


def integrate(table, cosine, roughness, vertices, signed):
    """Integrals (P,) as `lobe_integrals.integrate_polygon` returns them, all arrays float32, and the indices of the
    points whose values are not accurate."""
    count, corners = vertices.shape[:2]
    ridges, scratch = ridge_table.prepare(table), edge_loop.Scratch()
    result, redo = np.zeros(count, np.float32), np.zeros(count, bool)
    step = max(CORNERS // corners, 512)
    for start in range(0, count, step):
        part = slice(start, start + step)
        mu = np.clip(cosine[part], np.float32(0.0), np.float32(1.0))
        rough = np.clip(roughness[part], np.float32(0.0), np.float32(1.0))
        sine = np.sqrt((np.float32(1.0) - mu) * (np.float32(1.0) + mu))
        warp, weights, tilt = ridges.fetch((0,), mu, sine, rough, None, scratch)
        polygons, clip_rows = _warped(vertices[part], warp, tilt, scratch)
        values, fragile = integrate_visible(
            polygons, np.ones(len(mu), bool), clip_rows, 1, partial(_integral, weights[0], ridges, signed, scratch)
        )
        result[part], redo[part] = values[0], fragile
    redo |= roughness < ridge_table.SHARP_ROUGHNESS
    return result, np.nonzero(redo)[0]


def _warped(vertices, warp, tilt, scratch):
    """Polygons (3 or 4, V, P) in the domain of the lobe's original distribution, and the coordinates to clip at 0."""
    points, count = vertices.shape[:2]
    rows = scratch("rows", (3 if tilt is None else 4, count, points))
    x, y, z = (vertices[..., axis].T for axis in range(3))
    work = scratch("one", (count, points))
    np.multiply(z, warp[1], out=work)
    np.multiply(x, warp[0], out=rows[0])
    rows[0] += work
    np.multiply(y, warp[2], out=rows[1])
    np.multiply(z, warp[3], out=rows[2])
    if tilt is None:
        return rows, (2,)
    rows[3] = rows[2]
    sine, cosine = np.sin(tilt), np.cos(tilt)
    np.multiply(rows[0], sine, out=work)
    rows[2] *= cosine
    rows[2] += work
    rows[0] *= cosine
    rows[0] -= np.multiply(rows[3], sine, out=work)
    return rows, (3, 2)


def _integral(weights, ridges, signed, scratch, corners, index):
    """Integrals (1, Q) of the lobes `index` (None: all) and the mask (Q,) of fragile points."""
    if index is not None:
        weights = np.take(weights, index, axis=1)
    if ridges.source.family == "ltc":
        values, fragile = edge_loop.cosine_integral(corners, scratch)
        values *= weights[0]
        values *= np.float32(1.0 / np.pi)
        # The clamped cosine is not negative: its integral has the sign of the solid angle.
        return (values if signed else np.abs(values, out=values))[None], fragile
    values, angle, fragile = edge_loop.weighted_moments(corners, weights[None], ridges.degree, scratch)
    if not signed:
        values *= np.sign(angle)
        np.maximum(values, np.float32(0.0), out=values)
    return values, fragile
