"""Spherical harmonics over polygons by zonal harmonics: the peer for the integrals.

As proposed by Wang and Ramamoorthi 2018 (doi:10.1145/3272127.3275069), written from the mathematics: every band of
degree l is spanned by 2 l + 1 rotated Legendre polynomials P_l(w . d). With z(t) = w . d = a cos t + b sin t along an
edge of length T with the normal n of its plane, Stokes' theorem gives

    int P_l dw = 1 / (l (l + 1)) sum_edges (n . d) D_l,   D_l = int_0^T P_l'(z) dt,

and integration by parts the recursions D_l = D_{l-2} + (2 l - 1) B_{l-1}, l B_l = (2 l - 1) C_{l-1} - (l - 1) B_{l-2},
(l + 1) C_l = -[z' P_l] + (a^2 + b^2 - 1) D_l + l B_{l-1} for B_l = int P_l(z) dt and C_l = int z P_l(z) dt.
"""

import numpy as np

from ltsh_addon.lobes import spherical_harmonics


def lobe_directions(degree):
    """Directions (2 degree + 1, 3) that span every band well: a spiral on the upper hemisphere."""
    count = 2 * degree + 1
    z = (np.arange(count) + 0.5) / count
    angle = np.arange(count) * np.pi * (3.0 - np.sqrt(5.0))
    radius = np.sqrt(1.0 - z * z)
    return np.stack([radius * np.cos(angle), radius * np.sin(angle), z], axis=1)


class ZonalHarmonics:
    """Integrals of expansions of `degree` over polygons above the horizon."""

    def __init__(self, degree):
        self.degree, self.directions = degree, lobe_directions(degree)
        self.matrices = [self._band(band) for band in range(1, degree + 1)]

    def _band(self, band):
        """Matrix (band + 1, 2 band + 1) from zonal integrals to those of the harmonics that are even in y."""
        generator = np.random.default_rng(band)
        points = generator.normal(size=(20 * band + 20, 3))
        points /= np.linalg.norm(points, axis=1, keepdims=True)
        zonal = np.polynomial.legendre.legval(points @ self.directions[: 2 * band + 1].T, [0] * band + [1])
        first = spherical_harmonics.coefficient_index(band, 0)
        basis = spherical_harmonics.evaluate(band, points)[first:]
        return np.linalg.lstsq(zonal, basis.T, rcond=None)[0].T.astype(np.float32)

    def integrate(self, unit, coefficients):
        """Signed integrals (P,) over unit polygons (3, V, P) for coefficients (K, P)."""
        zonal = self.zonal_integrals(unit)
        result = coefficients[0] * solid_angle(unit) * np.float32(spherical_harmonics.normalization(0, 0))
        for band, matrix in enumerate(self.matrices, 1):
            first = spherical_harmonics.coefficient_index(band, 0)
            for row, weights in enumerate(matrix):
                value = sum(weight * zonal[band][lobe] for lobe, weight in enumerate(weights))
                result += coefficients[first + row] * value
        return result

    def zonal_integrals(self, unit):
        """Integrals (lobes, P) of P_l by band l, of every lobe direction."""
        following = np.roll(unit, -1, axis=1)
        theta = np.arccos(np.clip((unit * following).sum(axis=0), -1, 1))
        normal = np.cross(unit, following, axis=0)
        normal /= np.maximum(np.sqrt((normal * normal).sum(axis=0)), np.float32(1e-20))
        across = np.cross(normal, unit, axis=0)
        sine, cosine = np.sin(theta), np.cos(theta)
        totals = [None] + [[] for _ in range(self.degree)]
        for number, (x, y, z) in enumerate(self.directions.astype(np.float32)):
            a, b, outward = (x * v[0] + y * v[1] + z * v[2] for v in (unit, across, normal))
            bands = self._edge_integrals(a, b, theta, sine, cosine)
            for band in range(1, self.degree + 1):
                if number < 2 * band + 1:
                    totals[band].append((outward * bands[band]).sum(axis=0) / (band * (band + 1)))
        return totals

    def _edge_integrals(self, a, b, theta, sine, cosine):
        """D_l (V, P) for l = 0 .. degree."""
        end, slope_start, slope_end = a * cosine + b * sine, b, b * cosine - a * sine
        excess = a * a + b * b - 1
        b_previous, b_current = theta, a * sine + b * (1 - cosine)
        p_previous, p_current = (np.ones_like(a), np.ones_like(a)), (a, end)
        d = [np.zeros_like(a), theta]
        for band in range(1, self.degree):
            c = slope_start * p_current[0] - slope_end * p_current[1] + excess * d[band] + band * b_previous
            c /= band + 1
            d.append(d[band - 1] + (2 * band + 1) * b_current)
            b_previous, b_current = b_current, ((2 * band + 1) * c - band * b_previous) / (band + 1)
            p_previous, p_current = (
                p_current,
                tuple(
                    ((2 * band + 1) * z * p - band * q) / (band + 1)
                    for z, p, q in zip((a, end), p_current, p_previous, strict=True)
                ),
            )
        return d


def solid_angle(unit):
    """Signed solid angle (P,) of polygons (3, V, P): a fan of triangles (Van Oosterom and Strackee 1983)."""
    first, total = unit[:, 0], 0
    for corner in range(1, unit.shape[1] - 1):
        b, c = unit[:, corner], unit[:, corner + 1]
        volume = (first * np.cross(b, c, axis=0)).sum(axis=0)
        sums = 1 + (first * b).sum(axis=0) + (b * c).sum(axis=0) + (c * first).sum(axis=0)
        total = total + 2 * np.arctan2(volume, sums)
    return total
