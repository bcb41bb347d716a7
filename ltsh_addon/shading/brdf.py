"""GGX microfacet reflection and Fresnel curves, in the local frame (see the package's conventions).

Anisotropic GGX, exactly, in the space of stretched half vectors.

A surface with alpha_x along a tangent and alpha_y across it is the one of alpha = 1, stretched (Heitz 2014). So is its
half vector h: with h' along (h_x / alpha_x, h_y / alpha_y, h_z) the lobe BRDF times cosine is, per solid angle of h',

    P(h') = 2 mu_i (o'.h') / (pi (mu_o S_i + mu_i S_o)),  o' = (alpha_x o_x, alpha_y o_y, o_z), S_o = |o'|,

S_i likewise, o the view and i its mirror image at h. That is a smooth function on the hemisphere, however narrow and
long the lobe is: a linear one, visible normals, times masking. The edges of a light become arcs of conics in h'.

In the frame of the view h' is along (h_x, v h_x + u h_y, a h_z) with u = k^2 cos^2(phi) + sin^2(phi) / k^2,
v = (k^2 - 1 / k^2) cos(phi) sin(phi), a = roughness^2 sqrt(u); phi is the azimuth of the view from the tangent and
k = 1 / (1 - anisotropy). It is turned so that o' has y = 0. Isotropic lobes have u = 1, v = 0.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from .lookup_table import MIN_ALPHA
from .polygon import dot, project_to_sphere

# Lights of fewer corners have their edges cut in two, and both parts again where they bend most.
MANY_EDGES, NEWTON_STEPS = 16, 2


def ggx_brdf_cosine(cos_theta_o, alpha, directions):
    """Single-scatter GGX BRDF times cosine with F = 1, in sr^-1; 0 below the horizon.

    cos_theta_o (...), alpha = roughness^2 (...), directions (..., S, 3) unit -> (..., S). Height-correlated Smith
    masking-shadowing (Heitz 2014, "Understanding the Masking-Shadowing Function", eq. 99; Walter et al. 2007, eq. 33).
    Written with S(mu) = sqrt(mu^2 + alpha^2 (1 - mu^2)), so that nothing is divided by a vanishing cosine:
    f cos = D(h) mu_i / (2 (mu_o S(mu_i) + mu_i S(mu_o))).
    """
    mu_o = np.asarray(cos_theta_o)[..., None]
    alpha = np.asarray(alpha)[..., None]
    alpha_squared = alpha * alpha
    x, y, z = directions[..., 0], directions[..., 1], directions[..., 2]
    half_x = x + np.sqrt(np.maximum(1.0 - mu_o * mu_o, 0.0))
    half_z = z + mu_o
    distribution = ggx_distribution(half_x * half_x + y * y, half_z * half_z, alpha_squared)
    mu_i = np.maximum(z, 0.0)
    return distribution * mu_i / (2.0 * np.maximum(masking(mu_o, mu_i, alpha_squared), 1e-300))


def masking(mu_o, mu_i, alpha_squared):
    """mu_o S(mu_i) + mu_i S(mu_o), see `ggx_brdf_cosine`; broadcasts."""
    return mu_o * _slope_length(mu_i, alpha_squared) + mu_i * _slope_length(mu_o, alpha_squared)


def ggx_distribution(horizontal, vertical, alpha_squared):
    """D(h) of GGX in sr^-1 for half vectors of any length (Walter et al. 2007, eq. 33); broadcasts.

    horizontal = h_x^2 + h_y^2 and vertical = h_z^2: D = alpha^2 |h|^4 / (pi (horizontal + alpha^2 vertical)^2).
    """
    ratio = (horizontal + vertical) / np.maximum(horizontal + alpha_squared * vertical, 1e-30)
    return alpha_squared / np.pi * ratio * ratio


def visible_normal_density(cos_theta_o, horizontal, vertical, alpha_squared):
    """Density in sr^-1 with which directions are chosen by reflection at visible normals: G1(o) D(h) / (4 cos theta_o).

    Heitz 2018, "Sampling the GGX Distribution of Visible Normals", eq. 17 and 18; cos_theta_o > 0, the half vectors as
    for `ggx_distribution`; broadcasts.
    """
    distribution = ggx_distribution(horizontal, vertical, alpha_squared)
    return distribution / (2.0 * (cos_theta_o + _slope_length(cos_theta_o, alpha_squared)))


def _slope_length(mu, alpha_squared):
    return np.sqrt(mu * mu + alpha_squared * (1.0 - mu * mu))


def half_angle_cosine(cos_theta_o, directions):
    """Cosine (..., S) of the angle between the half vector and either direction; arguments as `ggx_brdf_cosine`."""
    mu_o = np.asarray(cos_theta_o)[..., None]
    sin_o = np.sqrt(np.maximum(1.0 - mu_o * mu_o, 0.0))
    cosine = directions[..., 0] * sin_o + directions[..., 2] * mu_o
    return np.sqrt(np.clip(0.5 * (1.0 + cosine), 0.0, 1.0))


def schlick_curve(cosine):
    """(1 - c)^5 (Schlick 1994): the reflectance is f0 + (f90 - f0) (1 - c)^5."""
    complement = 1.0 - cosine
    squared = complement * complement
    return squared * squared * complement


def f82_reflectance(cosine, f0, f90, dip):
    """f0 + (f90 - f0) (1 - c)^5 - dip c (1 - c)^6, which may be negative; broadcasts."""
    return f0 + schlick_curve(cosine) * (f90 - f0 - dip * cosine * (1.0 - cosine))


def clipped_metals(samples):
    """Mask (P,) of the samples that are F82 metals alone, and clipped at 0 where their reflectance falls below."""
    if not samples.specular_dip.any():
        return np.zeros(len(samples), bool)
    return is_clipped(samples.specular_f0, samples.specular_f90, samples.specular_dip) & ~samples.dielectric.any(axis=1)


def is_clipped(f0, f90, dip):
    """Where (P,) the reflectance of F82 metals, each (P, 3), falls below 0 at some angle."""
    found = np.zeros(len(f0), bool)
    at = np.nonzero((dip > 0.0).any(axis=-1))[0]
    cosines = np.linspace(0.0, 1.0, 33)[:, None, None]
    if len(at):
        found[at] = f82_reflectance(cosines, f0[at], f90[at], dip[at]).min(axis=(0, 2)) < 0.0
    return found


def dielectric_reflectance(cosine, ior):
    """Exact unpolarized Fresnel reflectance of a dielectric of relative `ior`, with total reflection below 1;
    broadcasts."""
    cosine = np.asarray(cosine)
    g = np.sqrt(np.maximum(ior * ior - 1.0 + cosine * cosine, 0.0))
    # At cosine 0 without refraction (ior 1) the quotient is 0 / 0; its limit along cosine -> 0 is 0.
    perpendicular = (g - cosine) / np.maximum(g + cosine, 1e-30)
    plus, minus = cosine * (g + cosine) - 1.0, cosine * (g - cosine) + 1.0
    return 0.5 * perpendicular * perpendicular * (1.0 + (plus / minus) ** 2)


def stretch(x, y, anisotropy):
    """u and v of the module's docstring for tangents with coordinates x and y along the local frame, of any length."""
    squared = x * x + y * y
    # Without a tangent there is no direction to be stretched in.
    flat = squared <= 1e-12
    squared, share = np.where(flat, 1.0, squared), np.square(1.0 / (1.0 - anisotropy))
    across = np.where(flat, 1.0, (share * x * x + y * y / share) / squared)
    along = np.where(flat, 0.0, (1.0 / share - share) * x * y / squared)
    return across.astype(x.dtype), along.astype(x.dtype)


@dataclass(frozen=True)
class HalfVectors:
    """How directions in the local frames of P samples become stretched half vectors."""

    sine: np.ndarray  # (P,) of theta_o
    cosine: np.ndarray  # (P,)
    alpha: np.ndarray  # (P,) in the plane of incidence
    across: np.ndarray  # (P,) u, positive
    along: np.ndarray  # (P,) v

    @classmethod
    def of(cls, samples, frame, cosine) -> HalfVectors:
        """Those of SurfaceSamples (P) in local frames (3, 3, P): rows tangent, bitangent, normal."""
        x, y = (sum(row[axis] * samples.tangent[:, axis] for axis in range(3)) for row in frame[:2])
        across, along = stretch(x, y, samples.anisotropy)
        alpha = np.maximum(samples.roughness**2 * np.sqrt(across), MIN_ALPHA)
        cosine = np.clip(cosine, 0.0, 1.0)
        return cls(np.sqrt(1.0 - cosine * cosine), cosine, alpha, across, along)

    def take(self, index) -> HalfVectors:
        """Those of the samples `index`."""
        values = self.sine, self.cosine, self.alpha, self.across, self.along
        return HalfVectors(*(value[index] for value in values))

    def to_original_domain(self, vectors: np.ndarray) -> np.ndarray:
        """Stretched half vectors (3, ..., P), of any length, for vectors (3, ..., P) in local frames."""
        return self._stretched(vectors, np.sqrt(dot(vectors, vectors)))

    def along_edge(self, vectors, step):
        """As `to_original_domain` for vectors (3, ..., P), and how fast that changes with `step` (3, ..., P)."""
        length = np.sqrt(dot(vectors, vectors))
        return self._stretched(vectors, length), self._stretched(step, dot(vectors, step) / np.maximum(length, 1e-300))

    def _stretched(self, vectors, length):
        x, y, z = vectors
        x = x + length * self.sine
        return np.stack([x, self.along * x + self.across * y, self.alpha * (z + length * self.cosine)])

    def lobe(self, stretched):
        """P (...) at unit stretched half vectors [x, y, z] (..., P), the cosine (...) of the half angle, and the unit
        directions (..., 3)."""
        x, z = stretched[0], stretched[2] / self.alpha
        y = (stretched[1] - self.along * x) / self.across
        length = np.sqrt(x * x + y * y + z * z)
        x, y, z = x / length, y / length, z / length
        half = x * self.sine + z * self.cosine
        direction = np.stack([2.0 * half * x - self.sine, 2.0 * half * y, 2.0 * half * z - self.cosine], axis=-1)
        mu = np.maximum(direction[..., 2], 0.0)
        slopes = direction[..., 0] - self.along / self.across * direction[..., 1], direction[..., 1] / self.across
        masked = np.sqrt(mu * mu + self.alpha**2 * (slopes[0] ** 2 + slopes[1] ** 2))
        view = np.hypot(self.alpha * self.sine, self.cosine)
        visible = self.alpha * self.sine * stretched[0] + self.cosine * stretched[2]
        values = 2.0 / np.pi * mu * visible / np.maximum(self.cosine * masked + mu * view, 1e-300)
        return values, half, direction


@dataclass(frozen=True)
class HalfBoundary:
    """The boundaries of polygons as stretched half vectors see them: edges from `start` in local frames."""

    halves: HalfVectors
    start: np.ndarray  # (3, E, P)
    step: np.ndarray  # (3, E, P) to the next corner

    @classmethod
    def of(cls, halves: HalfVectors, polygon: np.ndarray) -> HalfBoundary:
        """Of polygons (3, V, P) above the horizon of local frames."""
        if polygon.shape[1] < MANY_EDGES:
            polygon = _with_middles(polygon, 0.5 * (polygon + np.roll(polygon, -1, axis=1)))
            polygon = _with_middles(polygon, cls._bends(halves, polygon))
        return cls(halves, polygon, np.roll(polygon, -1, axis=1) - polygon)

    @staticmethod
    def _bends(halves, polygon) -> np.ndarray:
        """Points (3, V, P) of the edges that are, in h', as far from both ends: exact of edges that are straight there,
        then steps of Newton's."""
        step = np.roll(polygon, -1, axis=1) - polygon
        near = halves.to_original_domain(polygon)
        length = np.sqrt(dot(near, near))
        near = near / np.maximum(length, 1e-300)
        across, total = np.roll(near, -1, axis=1) - near, length + np.roll(length, -1, axis=1)
        share = length / np.maximum(total, 1e-300)
        for _ in range(NEWTON_STEPS):
            stretched, moved = halves.along_edge(polygon + share * step, step)
            slope = dot(moved, across)
            share = np.clip(share - dot(stretched, across) / np.where(slope > 0.0, slope, np.inf), 0.0, 1.0)
        return polygon + share * step

    pieces = property(lambda self: self.start.shape[1])

    def take(self, index) -> HalfBoundary:
        """Those of the points `index` (Q,)."""
        return HalfBoundary(self.halves.take(index), self.start[:, :, index], self.step[:, :, index])

    def corners(self) -> np.ndarray:
        """Unit vectors (3, E, P)."""
        return project_to_sphere(self.halves.to_original_domain(self.start))

    def nodes(self, order: int):
        """As `reference.PolygonBoundary.nodes`."""
        nodes, weights = np.polynomial.legendre.leggauss(order)
        fractions, weights = 0.5 * (nodes + 1.0)[:, None], 0.5 * weights[:, None]
        near = self.halves.to_original_domain(self.start)
        far = np.roll(near, -1, axis=1)
        normal = np.cross(near, far, axis=0)
        angle = np.arctan2(np.sqrt(dot(normal, normal)), dot(near, far))[:, None]
        near, far = (np.sqrt(dot(ends, ends))[:, None] for ends in (near, far))
        # Where an arc between both ends has gone these shares of its angle, were the edge straight in h'.
        first, last = (
            _share(part * angle, angle, part) / end for part, end in ((1.0 - fractions, near), (fractions, far))
        )
        total = first + last
        speed = 1.0 / (_sinc(angle) * near * far * total * total)
        step = self.step[:, :, None]
        stretched, moved = self.halves.along_edge(self.start[:, :, None] + (last / total) * step, step)
        squared = dot(stretched, stretched)
        measure = np.cross(stretched, moved, axis=0) * (speed * weights / squared)
        count = squared.shape[-1]
        return (stretched / np.sqrt(squared)).reshape(3, -1, count), measure.reshape(3, -1, count)


def _with_middles(polygon, middles):
    """Polygons (3, 2 V, P) of the corners (3, V, P) and the points `middles` (3, V, P) between each and the next."""
    return np.stack([polygon, middles], axis=2).reshape(3, -1, polygon.shape[2])


def _sinc(angle):
    return np.sinc(angle / np.pi)


def _share(part, angle, fraction):
    """sin(part) / sin(angle), of which part = fraction angle."""
    return fraction * _sinc(part) / _sinc(angle)
