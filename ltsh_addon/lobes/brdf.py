"""GGX microfacet reflection and Fresnel curves, in the local frame (see the package's conventions).

Anisotropic GGX is exact in the space of stretched half vectors.

A surface with alpha_x along a tangent and alpha_y across it is a stretched surface of alpha = 1 (Heitz 2014). Its half
vector h is stretched in the same way: let h' be along (h_x / alpha_x, h_y / alpha_y, h_z). Then the lobe, BRDF times
cosine, per solid angle of h' is

    P(h') = 2 mu_i (o'.h') / (pi (mu_o S_i + mu_i S_o)),  o' = (alpha_x o_x, alpha_y o_y, o_z), S_o = |o'|.

S_i is defined likewise; o is the view and i its mirror image at h. P is a smooth function on the hemisphere, however
narrow and long the lobe is: a linear function (visible normals) times masking. The edges of a light become arcs of
conics in h'.

In the frame of the view, h' is along (h_x, v h_x + u h_y, a h_z), where u = k^2 cos^2(phi) + sin^2(phi) / k^2,
v = (k^2 - 1 / k^2) cos(phi) sin(phi) and a = roughness^2 sqrt(u). Here phi is the azimuth of the view from the tangent
and k = 1 / (1 - anisotropy). The frame of h' is turned so that o' has y = 0. Isotropic lobes have u = 1 and v = 0.
"""

from dataclasses import dataclass

import numpy as np

from .lookup_table import MIN_ALPHA
from .polygon import dot, project_to_sphere

# Arcs of conics are halved until they turn by at most LONGEST_ARC, in rad, but at most MOST_HALVINGS times.
LONGEST_ARC, MOST_HALVINGS = 0.8, 14


def ggx_brdf_cosine(cos_theta_o, alpha, directions):
    """Single-scatter GGX BRDF times cosine with F = 1, in sr^-1; 0 below the horizon.

    cos_theta_o (...), alpha = roughness^2 (...), directions (..., S, 3) unit -> (..., S). Height-correlated Smith
    masking-shadowing (Heitz 2014, "Understanding the Masking-Shadowing Function", eq. 99; Walter et al. 2007, eq. 33).
    Written with S(mu) = sqrt(mu^2 + alpha^2 (1 - mu^2)), nothing is divided by a vanishing cosine:
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
    """Density in sr^-1 of directions chosen by reflection at visible normals: G1(o) D(h) / (4 cos theta_o).

    Heitz 2018, "Sampling the GGX Distribution of Visible Normals", eq. 17 and 18. cos_theta_o > 0; half vectors are
    given as for `ggx_distribution`; broadcasts.
    """
    distribution = ggx_distribution(horizontal, vertical, alpha_squared)
    return distribution / (2.0 * (cos_theta_o + _slope_length(cos_theta_o, alpha_squared)))


def spiral(count: int) -> np.ndarray:
    """Heights, cosines and sines (3, N, 1) in single precision: points that cover (0, 1) times the circle evenly."""
    number = np.arange(count) + 0.5
    turn = np.pi * (np.sqrt(5.0) - 1.0) * number
    return np.stack([number / count, np.cos(turn), np.sin(turn)])[..., None].astype(np.float32)


def visible_directions(nodes: np.ndarray, view: np.ndarray, alphas: np.ndarray):
    """Directions [x, y, z] (N, Q) in which lobes reflect, all equally likely by visible normals; the solid angle (N, Q)
    in sr for which each stands; its weight (N, Q), so that sums over N are integrals of the lobe with F = 1; and the
    cosine (N, Q) of the half angle.

    `nodes` (3, N, 1) are a `spiral`. `view` (3, Q) is local, above the horizon, and `alphas` (2, Q) are those of GGX
    along the first two axes. Heitz 2018, doi:10.1145/3388767.3407321; Dupuy and Benyoub 2023, "Sampling Visible GGX
    Normals with Spherical Caps", doi:10.1111/cgf.14867.
    """
    height, cos_turn, sin_turn = nodes
    x, y, z = view
    along, across = alphas
    slope_x, slope_y = along * x, across * y
    length = np.sqrt(slope_x * slope_x + slope_y * slope_y + z * z)
    up = z / length
    # The view and a direction of a cap around it, added up, are the normal of the stretched surface.
    half_z = (np.float32(1.0) - height) * (np.float32(1.0) + up)
    cap = half_z - up
    cap *= cap
    np.subtract(np.float32(1.0), cap, out=cap)
    np.sqrt(np.maximum(cap, np.float32(0.0), out=cap), out=cap)
    half_x, half_y = cap * cos_turn, cap * sin_turn
    half_x += slope_x / length
    half_y += slope_y / length
    square = half_z * half_z
    ratio = half_x * half_x
    ratio += half_y * half_y
    ratio += square
    half_x *= along
    half_y *= across
    square += half_x * half_x
    square += half_y * half_y
    cosine = ratio / np.sqrt(square)
    cosine *= np.float32(0.5) * length
    ratio /= square
    angle = ratio * ratio
    angle *= np.float32(2.0 * np.pi / len(height)) * along * across * (z + length)
    ratio *= length
    for half, toward in ((half_x, x), (half_y, y), (half_z, z)):
        half *= ratio
        half -= toward
    slope = half_x * along
    slope *= slope
    square = half_y * across
    square *= square
    slope += square
    slope += half_z * half_z
    np.sqrt(slope, out=slope)
    slope *= z
    above = np.maximum(half_z, np.float32(0.0))
    slope += above * length
    weight = above
    weight *= (z + length) / np.float32(len(height))
    weight /= np.maximum(slope, np.float32(1e-30))
    return [half_x, half_y, half_z], angle, weight, cosine


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
    """f0 + (f90 - f0) (1 - c)^5 - dip c (1 - c)^6, not clipped at 0; broadcasts."""
    return f0 + schlick_curve(cosine) * (f90 - f0 - dip * cosine * (1.0 - cosine))


# Maximum of c (1 - c)^6 on [0, 1], rounded up.
MOST_OF_DIP = 0.0567


def clipped_metals(samples):
    """Mask (P,) of the samples that are F82 metals without a dielectric and whose reflectance is clipped at 0."""
    if not samples.specular_dip.any():
        return np.zeros(len(samples), bool)
    return is_clipped(samples.specular_f0, samples.specular_f90, samples.specular_dip) & ~samples.dielectric.any(axis=1)


def is_clipped(f0, f90, dip):
    """Mask (P,) of the F82 metals, each (P, 3), whose reflectance falls below 0 at some angle."""
    clipped = np.zeros(len(f0), bool)
    # The dip cannot bring other metals below 0, so their angles need not be tried.
    may_fall = np.minimum(f0, f90) < MOST_OF_DIP * np.maximum(dip, 0.0)
    at = np.nonzero((dip > 0.0).any(axis=-1) & may_fall.any(axis=-1))[0]
    cosines = np.linspace(0.0, 1.0, 33)[:, None, None]
    if len(at):
        clipped[at] = f82_reflectance(cosines, f0[at], f90[at], dip[at]).min(axis=(0, 2)) < 0.0
    return clipped


def dielectric_reflectance(cosine, ior):
    """Exact unpolarized Fresnel reflectance of a dielectric of relative `ior`. If that is below 1, there is total
    reflection. Broadcasts."""
    cosine = np.asarray(cosine)
    g = np.sqrt(np.maximum(ior * ior - 1.0 + cosine * cosine, 0.0))
    total, ratio = g + cosine, g - cosine
    plus, minus = cosine * total - 1.0, cosine * ratio + 1.0
    # At cosine 0 without refraction (ior 1) the quotient is 0 / 0; its limit along cosine -> 0 is 0.
    ratio /= np.maximum(total, 1e-30)
    plus /= minus
    ratio *= ratio
    plus *= plus
    plus += 1.0
    return 0.5 * ratio * plus


def stretch(x, y, anisotropy):
    """u and v of the module's docstring, for tangents with coordinates x and y in the local frame, of any length."""
    squared = x * x + y * y
    # Without a tangent there is no stretching.
    flat = squared <= 1e-12
    squared, share = np.where(flat, 1.0, squared), np.square(1.0 / (1.0 - anisotropy))
    across = np.where(flat, 1.0, (share * x * x + y * y / share) / squared)
    along = np.where(flat, 0.0, (1.0 / share - share) * x * y / squared)
    return across.astype(x.dtype), along.astype(x.dtype)


@dataclass(frozen=True)
class HalfVectors:
    """The map from directions in the local frames of P samples to stretched half vectors."""

    sine: np.ndarray  # (P,) of theta_o
    cosine: np.ndarray  # (P,)
    alpha: np.ndarray  # (P,) in the plane of incidence
    across: np.ndarray  # (P,) u, positive
    along: np.ndarray  # (P,) v

    @classmethod
    def of(cls, samples, frame, cosine) -> "HalfVectors":
        """For SurfaceSamples (P) in local frames (3, 3, P): rows tangent, bitangent, normal."""
        x, y = (sum(row[axis] * samples.tangent[:, axis] for axis in range(3)) for row in frame[:2])
        across, along = stretch(x, y, samples.anisotropy)
        alpha = np.maximum(samples.roughness**2 * np.sqrt(across), MIN_ALPHA)
        cosine = np.clip(cosine, 0.0, 1.0)
        return cls(np.sqrt(1.0 - cosine * cosine), cosine, alpha, across, along)

    def take(self, index) -> "HalfVectors":
        """For the samples `index`."""
        values = self.sine, self.cosine, self.alpha, self.across, self.along
        return HalfVectors(*(value[index] for value in values))

    def astype(self, dtype) -> "HalfVectors":
        """The same in another precision."""
        values = self.sine, self.cosine, self.alpha, self.across, self.along
        return HalfVectors(*(value.astype(dtype) for value in values))

    def to_original_domain(self, vectors: np.ndarray, length=None) -> np.ndarray:
        """Stretched half vectors (3, ..., P), of any length, of vectors (3, ..., P) in local frames. `length` is that
        of the vectors, if it is known."""
        x, y, z = vectors
        length = np.sqrt(dot(vectors, vectors)) if length is None else length
        x = x + length * self.sine
        return np.stack([x, self.along * x + self.across * y, self.alpha * (z + length * self.cosine)])

    def lobe(self, stretched):
        """For unit stretched half vectors [x, y, z] (..., P): P (...), the cosine (...) of the half angle, and the unit
        directions [x, y, z]."""
        x, y, z = stretched
        up, turn, side = 1.0 / self.alpha, 1.0 / self.across, self.along / self.across
        half_y, half_z = turn * y - side * x, up * z
        inverse = 1.0 / np.sqrt(x * x + half_y * half_y + half_z * half_z)
        half = (self.sine * x + self.cosine * half_z) * inverse
        scale = 2.0 * half * inverse
        i_x, i_y, i_z = scale * x - self.sine, scale * half_y, scale * half_z - self.cosine
        mu = np.maximum(i_z, 0.0)
        slope_x, slope_y = i_x - side * i_y, turn * i_y
        masked = np.sqrt(mu * mu + self.alpha**2 * (slope_x * slope_x + slope_y * slope_y))
        view, peak = np.hypot(self.alpha * self.sine, self.cosine), (2.0 / np.pi) * self.alpha * self.sine
        visible = peak * x + (2.0 / np.pi) * self.cosine * z
        return mu * visible / np.maximum(self.cosine * masked + mu * view, 1e-30), half, [i_x, i_y, i_z]


@dataclass(frozen=True)
class HalfBoundary:
    """The boundaries of polygons as stretched half vectors see them: conics, cut into A short arcs

        (1 - s)^2 first + 2 s (1 - s) middle + s^2 last,  0 <= s <= 1,  up to the length of vectors.

    A great circle is such a conic. The half vectors of its directions form one too, and so does their linear image."""

    halves: HalfVectors  # (P,)
    first: np.ndarray  # (3, A) unit
    middle: np.ndarray  # (3, A)
    last: np.ndarray  # (3, A) unit
    owner: np.ndarray  # (A,) number of the polygon
    encloses: np.ndarray  # (P,) True if e_z, the mirrored view, is inside

    @classmethod
    def of(cls, halves: HalfVectors, polygon: np.ndarray) -> "HalfBoundary":
        """For polygons (3, V, P) above the horizon of local frames."""
        corner = project_to_sphere(polygon)
        following = np.roll(corner, -1, axis=1)
        both = corner + following
        length = np.sqrt(dot(both, both))
        near = halves.to_original_domain(corner, 1.0)
        size = np.sqrt(dot(near, near))
        near = near / size
        middle = halves.to_original_domain(both / np.maximum(length, 1e-300), 0.5 * length)
        middle = middle / np.sqrt(size * np.roll(size, -1, axis=0))
        arcs = [vectors.reshape(3, -1) for vectors in (near, middle, np.roll(near, -1, axis=1))]
        side = triple(np.stack([-halves.sine, np.zeros_like(halves.sine), halves.cosine])[:, None], corner, following)
        encloses = (side >= 0.0).all(axis=0) | (side <= 0.0).all(axis=0)
        owner = np.tile(np.arange(polygon.shape[2]), polygon.shape[1])
        return cls(halves, *_short_arcs(arcs, owner), encloses)

    def apex(self) -> np.ndarray:
        """Unit vectors (3, P) that see the whole boundary well: e_z if it is inside, otherwise a mean of the boundary
        near e_z."""
        halfway = project_to_sphere(self.first + 2.0 * self.middle + self.last)
        chord = self.last - self.first
        weight = np.sqrt(dot(chord, chord)) * np.maximum(halfway[2], 0.0) + 1e-30
        count = len(self.encloses)
        mean = np.stack([np.bincount(self.owner, weight * values, count) for values in halfway])
        return np.where(self.encloses, np.array([0.0, 0.0, 1.0])[:, None], project_to_sphere(mean))

    def nodes(self, order: int, arcs, apex, dtype):
        """Unit vectors w (3, order, A) on the chosen `arcs` (A,), and apex . (w x dw) times the quadrature weight
        (order, A). `apex` is (3, A). All are in `dtype`."""
        nodes, weights = np.polynomial.legendre.leggauss(order)
        far, weights = (0.5 * values[:, None].astype(dtype) for values in (nodes + 1.0, weights))
        near = 1.0 - far
        first, middle, last = (vectors[:, arcs] for vectors in (self.first, self.middle, self.last))
        # Differences of close vectors are exact.
        start = 2.0 * triple(apex - first, first, middle - first)
        across = 2.0 * triple(apex - first, first, last - first)
        end = 2.0 * triple(apex - last, middle - last, last)
        first, middle, last = (vectors.astype(dtype, copy=False) for vectors in (first, middle, last))
        start, across, end = (values.astype(dtype, copy=False) for values in (start, across, end))
        point = near * near * first[:, None] + 2.0 * near * far * middle[:, None] + far * far * last[:, None]
        squared = dot(point, point)
        wedge = weights * (near * near * start + near * far * across + far * far * end) / squared
        return point / np.sqrt(squared), wedge


def _short_arcs(arcs, owner):
    """The `arcs` (first, middle and last, each (3, A)), halved until none turns by more than LONGEST_ARC, and their
    owners."""
    finished = []
    for _ in range(MOST_HALVINGS):
        first, middle, last = arcs
        toward = dot(middle, first + last)
        is_long = toward < 2.0 * np.cos(0.5 * LONGEST_ARC) * np.sqrt(dot(middle, middle))
        finished.append([*(vectors[:, ~is_long] for vectors in arcs), owner[~is_long]])
        first, middle, last, owner = *(vectors[:, is_long] for vectors in arcs), owner[is_long]
        if len(owner) == 0:
            break
        halfway = 0.25 * (first + 2.0 * middle + last)
        size = np.sqrt(dot(halfway, halfway))
        halfway, scale = halfway / size, 0.5 / np.sqrt(size)
        parts = (first, halfway), (scale * (first + middle), scale * (middle + last)), (halfway, last)
        arcs, owner = [np.concatenate(halves, axis=1) for halves in parts], np.concatenate([owner, owner])
    else:
        finished.append([*arcs, owner])
    return [np.concatenate(halves, axis=-1) for halves in zip(*finished, strict=True)]


def triple(a, b, c):
    """a . (b x c) of vectors (3, ...); broadcasts."""
    x, y, z = b[1] * c[2] - b[2] * c[1], b[2] * c[0] - b[0] * c[2], b[0] * c[1] - b[1] * c[0]
    return a[0] * x + a[1] * y + a[2] * z
