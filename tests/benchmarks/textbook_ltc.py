"""Linearly transformed cosines as in the textbook, without anything clever: the yardstick for our own LTC.

Heitz, Dupuy, Hill and Neubelt 2016 (doi:10.1145/2897824.2925895): the corners times M^-1, one clip at the horizon of
the cosine, normalized corners, theta / sin(theta) by the arc cosine. Float32 arrays of a chunk at a time; the lookup,
the frame and the clip are those any implementation needs. There is no clip at the shading horizon, no care for
degenerate polygons, and no Fresnel factor.
"""

import numpy as np

from ltsh_addon.lobes.lookup_table import MIN_ALPHA, warp_entries
from ltsh_addon.lobes.polygon import split_at_horizon

CHUNK = 12288


class TextbookLtc:
    """The matrices M^-1 and the scale of a table of ours of the family "ltc", float32."""

    def __init__(self, table):
        rows, columns = table.warp.shape[:2]
        self.table, self.shape = table, (rows, columns)
        parts = [table.warp.reshape(rows * columns, -1).T, table.coefficients[:, :, 0].reshape(1, -1)]
        self.channels = np.concatenate(parts).astype(np.float32)

    def fetch(self, cosine, roughness):
        """M^-1 as nine rows [3][3] of (P,), and the scale (P,)."""
        rows, columns = self.shape
        coordinate = 1.0 - np.sqrt(1.0 - np.arccos(cosine) * np.float32(2.0 / np.pi))
        u, v = roughness * np.float32(rows - 1), coordinate * np.float32(columns - 1)
        i, j = np.minimum(u.astype(np.intp), rows - 2), np.minimum(v.astype(np.intp), columns - 2)
        u, v = (u - i).astype(np.float32), (v - j).astype(np.float32)
        corner = i * columns + j
        near = self.channels[:, corner] * (1 - v) + self.channels[:, corner + 1] * v
        far = self.channels[:, corner + columns] * (1 - v) + self.channels[:, corner + columns + 1] * v
        a, b, c, tilt, scale = near * (1 - u) + far * u
        alpha = np.maximum(roughness * roughness, np.float32(MIN_ALPHA))
        xx, xz, yy, zz = warp_entries(cosine, alpha, a, b, c)
        sin, cos = np.sin(tilt), np.cos(tilt)
        zero = np.zeros_like(a)
        return ((cos * xx, zero, cos * xz - sin * zz), (zero, yy, zero), (sin * xx, zero, sin * xz + cos * zz)), scale

    def integrate_polygon(self, cosine, roughness, vertices):
        """Integrals (P,) over polygons (P, V, 3)."""
        result = np.zeros(len(cosine), np.float32)
        for start in range(0, len(cosine), CHUNK):
            part = slice(start, start + CHUNK)
            matrix, scale = self.fetch(cosine[part], roughness[part])
            corners = np.ascontiguousarray(vertices[part].transpose(2, 1, 0))
            result[part] = np.abs(self.integrate(matrix, corners)) * scale
        return result

    def integrate(self, matrix, corners):
        """Signed integrals (P,) over corners (3, V, P)."""
        x, y, z = corners
        warped = np.stack([row[0] * x + row[1] * y + row[2] * z for row in matrix])
        result = np.zeros(corners.shape[2], np.float32)
        for index, polygon in split_at_horizon(warped):
            result[index] = clamped_cosine(polygon)
        return result

    def shade(self, samples, lights):
        """Radiance (P, 3) for F = 1 of `samples` under rectangular `lights`."""
        radiance = np.zeros((len(samples), 3), np.float32)
        for start in range(0, len(samples), CHUNK):
            part = slice(start, start + CHUNK)
            normal, view = (getattr(samples, name)[part].T.astype(np.float32) for name in ("normal", "view"))
            cosine = np.clip((normal * view).sum(axis=0), 0, 1)
            tangent = view - cosine * normal
            tangent /= np.sqrt((tangent * tangent).sum(axis=0))
            frame = (tangent, np.cross(normal, tangent, axis=0), normal)
            matrix, scale = self.fetch(cosine, samples.roughness[part].astype(np.float32))
            for light in lights:
                offset = (light.polygon()[:, None] - samples.position[part]).transpose(2, 0, 1).astype(np.float32)
                local = np.stack([(row[:, None] * offset).sum(axis=0) for row in frame])
                value = np.maximum(-self.integrate(matrix, local), 0) * scale
                radiance[part] += value[:, None] * light.radiance.astype(np.float32)
        return radiance


def clamped_cosine(polygon):
    """Integral (P,) of the cosine over pi over polygons (3, V, P) above the horizon (Lambert 1760)."""
    unit = polygon / np.sqrt((polygon * polygon).sum(axis=0))
    following = np.roll(unit, -1, axis=1)
    cosine = np.clip((unit * following).sum(axis=0), np.float32(-0.99999), np.float32(0.99999))
    factor = np.arccos(cosine) / np.sqrt(1 - cosine * cosine)
    normal_z = unit[0] * following[1] - unit[1] * following[0]
    return (normal_z * factor).sum(axis=0) * np.float32(0.5 / np.pi)
