"""Linearly transformed lobes: their values, and their integrals over polygons in closed form.

LTC is Heitz et al. 2016 (doi:10.1145/2897824.2925895), LTSH is Allmenroeder and Peters 2021. Both clip the polygon at
the horizon, transform it, and integrate the original distribution over it.
"""

from functools import partial

import numpy as np

from . import edge_integrals, moments32
from .lookup_table import Lobe, LookupTable, bent
from .polygon import (
    dot,
    edge_sums,
    integrate_visible,
    one_plus_cosine,
    project_to_sphere,
    solid_angle,
    split_at_horizon,
    split_long_edges,
)

# Edges with a smaller 1 + cos(theta), which are within 11 degrees of a half circle, get a corner in between.
LONG_EDGE = 0.02
# Polygons whose area is a smaller share of their squared length are computed in float64. In single precision the error
# is about 1e-7 of their length; at this limit that is 4e-4 of the integral (median over directions and lobes).
NARROWEST = 1e-3
# Samples per chunk in float64, so few that their arrays stay in the cache.
FLOAT64_CHUNK = 4096
# Corners per chunk in float32: a compromise between few calls of numpy and arrays that stay in the cache.
_FLOAT32_CORNERS = 49216
# Least integral for F = 1 in shading, as a share of the integral of a clamped cosine under the same warp. The tail of a
# fitted lobe may fall below zero, but the true lobe is dark only where that cosine is dark too.
LEAST_SHARE = 0.02


def evaluate_lobe(table: LookupTable, cos_theta_o, roughness, directions) -> np.ndarray:
    """The lobe D in sr^-1 (Allmenroeder and Peters 2021), about BRDF times cosine with F = 1; 0 below the horizon.

    cos_theta_o and roughness (P,) in [0, 1], unit directions (P, S, 3) in the local frame -> (P, S), float32 if the
    directions are, else float64. Raises ValueError if the shapes do not fit.
    """
    cosine, roughness, directions = _as_float(cos_theta_o, roughness, directions)
    if directions.ndim != 3 or directions.shape[2] != 3 or directions.shape[0] != cosine.shape[0]:
        raise ValueError(f"directions have shape {directions.shape}, expected ({cosine.shape[0]}, S, 3)")
    lobe = table.lookup(cosine, roughness)
    warped = lobe.to_original_domain(np.ascontiguousarray(directions.transpose(2, 1, 0)))
    length = np.sqrt((warped * warped).sum(axis=0))
    unit = warped / length
    if lobe.tilt is None:
        basis = table.basis(np.moveaxis(unit, 0, -1))
        original = (basis * lobe.coefficients[0][:, None, :]).sum(axis=0)
    else:
        toward_axis = np.sin(lobe.tilt) * unit[0] + np.cos(lobe.tilt) * unit[2]
        original = lobe.coefficients[0, 0] * np.maximum(toward_axis, 0.0) / np.pi
    values = original * (lobe.xx * lobe.yy * lobe.zz) / length**3
    return np.where(directions[..., 2] > 0.0, values.T, 0.0)


def integrate_polygon(table: LookupTable, cos_theta_o, roughness, vertices, *, signed: bool = False) -> np.ndarray:
    """Integral of `evaluate_lobe` over the part of a polygon above the horizon: reflected radiance per radiance.

    Allmenroeder and Peters 2021, eq. 1 and 2.

    cos_theta_o (P,), roughness (P,), vertices (P, V, 3) in the local frame in any length unit, either winding -> (P,),
    float32 if the vertices are, else float64. Raises ValueError if the shapes do not fit.

    The signed integral is positive for corners that run counterclockwise as seen from outside the unit sphere. With
    `signed` it is returned; without, it is multiplied by the sign of the polygon's solid angle and clamped at zero.

    Polygons need not be convex. In a self-intersecting polygon, each part counts as often as the boundary winds around
    it, with that sign, both in the solid angle and in the integral. A square traced twice has twice the integral. A
    figure of eight gives the difference of its halves, or 0 if the lobe prefers the smaller half. A polygon whose plane
    goes through the point gives the mean of the limits from both sides, or one of them.

    The absolute error is below 2e-5 in float32. Points that need float64 for that are computed in it, among them those
    with narrow polygons, see `NARROWEST`.
    """
    cosine, roughness, vertices = _as_float(cos_theta_o, roughness, vertices)
    if vertices.ndim != 3 or vertices.shape[2] != 3 or vertices.shape[1] < 3 or len(vertices) != len(cosine):
        raise ValueError(f"vertices have shape {vertices.shape}, expected ({len(cosine)}, V >= 3, 3)")
    result = np.zeros(len(cosine), dtype=vertices.dtype)
    if vertices.dtype == np.float32 and table.degree <= moments32.MAX_DEGREE:
        result, redo = _integrate_in_float32(table, cosine, roughness, vertices, signed)
    else:
        redo = np.arange(len(cosine))
    for start in range(0, len(redo), FLOAT64_CHUNK):
        index = redo[start : start + FLOAT64_CHUNK]
        arrays = (array[index].astype(np.float64, copy=False) for array in (cosine, roughness, vertices))
        result[index] = _integrate_in_float64(table, *arrays, signed)
    return result


def _integrate_in_float64(table, cosine, roughness, vertices, signed):
    lobe = table.lookup(cosine, roughness, curves=1)
    result = np.zeros(len(cosine))
    for index, polygon in split_at_horizon(np.ascontiguousarray(vertices.transpose(2, 1, 0))):
        lobes = lobe.take(index)
        integral = polygon_integrals(table, lobes, polygon, lobes.coefficients)[0]
        if not signed:
            integral = np.maximum(np.sign(integrals_on_sphere(solid_angle, polygon)) * integral, 0.0)
        result[index] = integral
    return result


def polygon_integrals(table: LookupTable, lobe: Lobe, polygon: np.ndarray, coefficients: np.ndarray) -> np.ndarray:
    """Signed integrals (F, P) over polygons (3, V, P) in z >= 0 of lobes with coefficients (F, K, P) and the same
    warp."""
    warped = lobe.to_original_domain(polygon)
    if lobe.tilt is not None:
        return coefficients[:, 0] * _tilted_cosine_integral(warped, lobe.tilt)
    moments = integrals_on_sphere(partial(edge_integrals.moments, degree=table.degree), warped)
    if table.bend is not None:
        leaning = integrals_on_sphere(edge_integrals.vector_irradiance, bent(table.bend, warped))[::2]
        moments = np.concatenate([moments, 2.0 * leaning])
    weights = table.ridge_weights.astype(moments.dtype)
    # No matrix product: with BLAS, the bits of a point may depend on how many points share its batch.
    ridge_moments = sum(column[:, None] * row for column, row in zip(weights.T, moments, strict=True))
    return np.stack([(vector * ridge_moments).sum(axis=0) for vector in coefficients])


def integrals_on_sphere(integral, vertices: np.ndarray, *others: np.ndarray) -> np.ndarray:
    """integral(unit, *others) (..., P) of polygons (3, V, P) projected to the sphere; `others` are (..., P). Edges near
    half a circle are split."""
    unit = project_to_sphere(vertices)
    result = integral(unit, *others)
    long = np.nonzero(one_plus_cosine(edge_sums(unit)).min(axis=0) < LONG_EDGE)[0]
    if len(long):
        split = project_to_sphere(split_long_edges(vertices[:, :, long]))
        result[..., long] = integral(split, *(values[..., long] for values in others))
    return result


def tilted(warped: np.ndarray, tilt: np.ndarray) -> np.ndarray:
    """Vectors (3, V, P) or (3, P), turned so that the axis (sin tilt, 0, cos tilt) becomes e_z."""
    sine, cosine = np.sin(tilt), np.cos(tilt)
    return np.stack([cosine * warped[0] - sine * warped[2], warped[1], sine * warped[0] + cosine * warped[2]])


def _tilted_cosine_integral(warped, tilt):
    """Signed integral (P,) of the unit-mass clamped cosine around (sin tilt, 0, cos tilt). The polygon is clipped again
    at the horizon of that axis."""
    result = np.zeros_like(tilt)
    for index, polygon in split_at_horizon(tilted(warped, tilt)):
        result[index] = form_factor(polygon)
    return result


def form_factor(polygon: np.ndarray) -> np.ndarray:
    """Signed form factor (P,) of polygons (3, V, P) in z >= 0: the integral of cosine / pi (Lambert 1760)."""
    return integrals_on_sphere(edge_integrals.clamped_cosine_integral, polygon) / np.pi


def clamped_form_factor(vertices) -> np.ndarray:
    """Form factor (P,) of the part of polygons (P, V, 3) above the horizon, for either winding."""
    vertices = np.asarray(vertices)
    result = np.zeros(len(vertices), dtype=vertices.dtype)
    for index, polygon in split_at_horizon(np.ascontiguousarray(vertices.transpose(2, 1, 0))):
        result[index] = np.abs(form_factor(polygon))
    return result


def _as_float(cos_theta_o, roughness, vectors):
    vectors = np.asarray(vectors)
    dtype = np.float32 if vectors.dtype == np.float32 else np.float64
    return np.asarray(cos_theta_o, dtype=dtype), np.asarray(roughness, dtype=dtype), vectors.astype(dtype, copy=False)


def _integrate_in_float32(table, cosine, roughness, vertices, signed):
    """Integrals (P,) as in `integrate_polygon`, for float32 arrays, and the indices of the points that need float64."""
    count, corners = vertices.shape[:2]
    ridges, scratch = moments32.prepare(table), moments32.Scratch()
    result, redo = np.zeros(count, np.float32), np.zeros(count, bool)

    def integrate(corners, index):
        chosen = weights if index is None else np.take(weights, index, axis=2)
        values, angle, _, needs_float64 = ridges.integrals(corners, chosen, scratch)
        if vertices.shape[1] > 4 and tilt is None:
            # Only such polygons wind several times around a point, beyond the range of one arc tangent.
            angle = solid_angle(project_to_sphere(corners[:3]))
            needs_float64 |= np.abs(angle) > np.float32(moments32.LARGEST_SAFE_ANGLE)
        return np.stack([values[0], np.sign(angle)]), needs_float64

    step = max(_FLOAT32_CORNERS // corners, 512)
    for start in range(0, count, step):
        chunk = slice(start, start + step)
        mu = np.clip(cosine[chunk], np.float32(0.0), np.float32(1.0))
        rough = np.clip(roughness[chunk], np.float32(0.0), np.float32(1.0))
        sine = np.sqrt((np.float32(1.0) - mu) * (np.float32(1.0) + mu))
        warp, weights, tilt = ridges.fetch((0,), mu, sine, rough, None, scratch)
        polygons, clip_rows = _warped(vertices[chunk], warp, tilt, scratch)
        integrals, redo[chunk] = integrate_visible(polygons, np.ones(len(mu), bool), clip_rows, 2, integrate)
        values, orientation = integrals
        narrow, turns_back = _narrow_and_turning_back(vertices[chunk])
        redo[chunk] |= narrow
        if not signed:
            if turns_back.any():
                orientation[turns_back] = _orientations(vertices[chunk][turns_back])
            values *= orientation
            np.maximum(values, np.float32(0.0), out=values)
        result[chunk] = values
    redo |= roughness < moments32.SHARP_ROUGHNESS
    return result, np.nonzero(redo)[0]


@np.errstate(over="ignore", invalid="ignore")
def _narrow_and_turning_back(vertices):
    """Two masks (P,) of polygons (P, V, 3): those that are narrow, and those that do not fan out from their first
    corner one way around. Clipping or warping can change the sign of the solid angle of the latter only."""
    corners = np.ascontiguousarray(vertices.transpose(2, 1, 0))
    sides = corners[:, 1:] - corners[:, :1]
    longest = dot(sides, sides).max(axis=0)
    (ax, ay, az), (bx, by, bz) = sides[:, :-1], sides[:, 1:]
    triangles = ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx
    size = np.maximum.reduce([np.abs(np.add.reduce(triangle)) for triangle in triangles])
    volumes = dot(corners[:, :1], triangles)
    turns_back = (np.minimum.reduce(volumes) < 0.0) & (np.maximum.reduce(volumes) > 0.0)
    return size < np.float32(2.0 * NARROWEST) * longest, turns_back


def _orientations(vertices):
    """Signs (P,) of the solid angles of the parts above the horizon of polygons (P, V, 3)."""
    result = np.zeros(len(vertices), vertices.dtype)
    for index, polygon in split_at_horizon(np.ascontiguousarray(vertices.transpose(2, 1, 0))):
        result[index] = np.sign(integrals_on_sphere(solid_angle, polygon))
    return result


def _warped(vertices, warp, tilt, scratch):
    """Polygons (3 or 4, V, P) in the domain of the original distribution, and the numbers of the coordinates to clip at
    0."""
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
