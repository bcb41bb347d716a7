"""The BRDFs with their quadrature, and the families of original distributions under a warp that are fitted to them."""

import re
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.special import erf

from ltsh_addon.lobes import brdf, spherical_harmonics
from ltsh_addon.lobes.lookup_table import basis_integrals, basis_values, bent


@dataclass(frozen=True)
class Family:
    """A space of original distributions, even in y.

    kind "ltc": the clamped cosine, whose axis may tilt (fourth parameter of the warp). kind "ltsh": the polynomials in
    x and z of a degree, which are the spherical harmonics even in y. `powers` restricts them to some monomials x^p z^q,
    whose integral needs fewer terms per edge; a table stores spherical harmonics coefficients in any case. A `bend`
    adds the two functions of `lookup_table.bent_cosines` to the spherical harmonics. A `second` family adds its lobe
    under one more warp, with three parameters (log xx, xz / xx, log yy), in the original domain. There are no tables
    for such sums of two lobes.
    """

    name: str
    kind: str
    degree: int
    powers: tuple[tuple[int, int], ...] = ()
    bend: tuple[float, float, float] | None = None
    second: "Family | None" = None

    @property
    def parameters(self) -> int:
        """Number of warp channels."""
        return 4 if self.kind == "ltc" else 3 if self.second is None else 6

    @property
    def size(self) -> int:
        """Number of free coefficients."""
        return len(self.span) + (0 if self.second is None else self.second.size)

    @cached_property
    def span(self) -> np.ndarray:
        """Matrix (size, K): the family's basis functions as combinations of the functions that a table stores."""
        if self.kind == "ltc":
            return np.eye(1)
        count = spherical_harmonics.coefficient_count(self.degree)
        if not self.powers:
            return np.eye(count if self.bend is None else count + 2)
        generator = np.random.default_rng(1)
        directions = generator.normal(size=(8 * count, 3))
        directions /= np.linalg.norm(directions, axis=1, keepdims=True)
        # x^p z^q is taken without change: it is the same polynomial on the sphere as on the hemisphere.
        values = np.stack([directions[:, 0] ** p * directions[:, 2] ** q for p, q in self.powers], axis=1)
        harmonics = spherical_harmonics.evaluate(self.degree, directions).T
        return np.linalg.lstsq(harmonics, values, rcond=None)[0].T

    @cached_property
    def round(self) -> np.ndarray:
        """Mask (size,) of the basis functions allowed at normal incidence, where the lobe is rotation-symmetric."""
        if self.kind == "ltc":
            return np.ones(1, dtype=bool)
        zonal = [m == 0 for l in range(self.degree + 1) for m in range(l + 1)]  # noqa: E741
        zonal += [False] * (self.span.shape[1] - len(zonal))
        return np.abs(self.span[:, ~np.array(zonal)]).max(axis=1, initial=0.0) < 1e-9

    def basis(self, unit, tilt):
        """Basis functions (P, S, size) at unit directions (P, S, 3) of the original domain. `tilt` is (P,), or (P, 3),
        the warp of the second lobe."""
        if self.second is not None:
            xx, xz, yy = np.exp(tilt[:, 0]), np.exp(tilt[:, 0]) * tilt[:, 1], np.exp(tilt[:, 2])
            warped = np.moveaxis(bent((xx[:, None], xz[:, None], yy[:, None]), np.moveaxis(unit, -1, 0)), 0, -1)
            length = np.sqrt((warped * warped).sum(axis=-1, keepdims=True))
            second = self.second.basis(warped / length, np.zeros(len(tilt)))
            second = second * (xx * yy)[:, None, None] / length**3
            return np.concatenate([replace(self, second=None).basis(unit, tilt), second], axis=-1)
        if self.kind == "ltc":
            toward_axis = np.sin(tilt)[:, None] * unit[..., 0] + np.cos(tilt)[:, None] * unit[..., 2]
            return np.maximum(toward_axis, 0.0)[..., None] / np.pi
        values = np.moveaxis(basis_values(self.degree, self.bend, unit), 0, -1)
        return values @ self.span.T if self.powers else values

    def basis_albedo(self, tilt):
        """Integrals (P, size) of the basis functions over the upper hemisphere."""
        if self.second is not None:
            parts = [family.basis_albedo(np.zeros(len(tilt))) for family in (replace(self, second=None), self.second)]
            return np.concatenate(parts, axis=1)
        if self.kind == "ltc":
            return 0.5 * (1.0 + np.cos(tilt))[:, None]
        integrals = self.span @ basis_integrals(self.span.shape[1])
        return np.broadcast_to(integrals, (len(tilt), len(integrals)))


# What spherical harmonics lack most at grazing views, found by search over 6 x 6 points: a broad lobe that leans away
# from the view and is narrow across. The error hardly changes around these numbers.
BEND = (0.4, 0.2, 1.4)


def two_ridges(degree: int) -> Family:
    """Polynomials h_x(x) + h_z(z), with 2 degree + 1 coefficients."""
    powers = tuple((0, q) for q in range(degree + 1)) + tuple((p, 0) for p in range(1, degree + 1))
    return Family(f"ridges{degree}", "ltsh", degree, powers)


def zonal(degree: int) -> Family:
    """Polynomials h(z), with degree + 1 coefficients."""
    return Family(f"zonal{degree}", "ltsh", degree, tuple((0, q) for q in range(degree + 1)))


def odd_in_z(degree: int) -> Family:
    """Polynomials odd in z. On the upper hemisphere these need no solid angle."""
    powers = tuple((n - q, q) for n in range(1, degree + 1) for q in range(1, n + 1, 2))
    return Family(f"odd{degree}", "ltsh", degree, powers)


def family_named(name: str) -> Family:
    """The family "ltc", "ltshN", "ltshNc", "ridgesN", "zonalN" or "oddN" of degree N = 1..8, or a sum of two lobes,
    "ltshN+ltshM" or "ltshN+ltc". Raises ValueError."""
    if re.fullmatch(r"ltsh[1-8]\+(ltsh[1-8]|ltc)", name):
        first, second = (family_named(part) for part in name.split("+"))
        return replace(first, name=name, second=second)
    if name == "ltc":
        return Family("ltc", "ltc", 1)
    makers = {"ltsh": lambda n: Family(f"ltsh{n}", "ltsh", n), "ridges": two_ridges, "zonal": zonal, "odd": odd_in_z}
    match = re.fullmatch("(?:(ltsh|ridges|zonal|odd)([1-8])|ltsh([1-8])c)", name)
    if match is None:
        raise ValueError(
            f"table {name!r} is unknown, expected ltc, ltsh with a degree 1..8 and perhaps a c for a bent cosine, or "
            "ridges, zonal or odd with a degree"
        )
    return Family(name, "ltsh", int(match[3]), bend=BEND) if match[3] else makers[match[1]](int(match[2]))


def polar_samples(cos_theta_o, alpha, radial: int = 28, angular: int = 28):
    """Directions (P, S, 3) with y > 0 and weights (P, S) for cos_theta_o (P,) and alpha (P,).

    The weighted sum of a function that is even in y is its integral over the upper hemisphere. The plane x = 0 cuts the
    hemisphere in two. Each half has its own polar coordinates, around the mirror direction and around the view
    direction. The second half matters because at grazing angles a warped lobe can wrap around to the horizon under the
    view. Near the pole, the angle r to it is dense like sinh on the scale of the lobe. Every ray ends at the horizon or
    at the plane between the halves, on either side of azimuth 90 degrees, so the integrand is smooth on it. The half of
    the view direction has a third of the S points; S is about radial * angular * 3 / 2.
    """
    mirror = _half(cos_theta_o, alpha, radial, angular // 2)
    view = _half(cos_theta_o, alpha, (2 * radial + 2) // 3, (3 * angular + 4) // 8)
    view[0][..., 0] *= -1.0
    return tuple(np.concatenate(parts, axis=1) for parts in zip(mirror, view, strict=True))


def _half(cos_theta_o, alpha, radial, angular):
    """Points of the half x < 0: `radial` on each ray, `angular` rays toward x = 0 and as many toward the horizon."""
    sin_o = np.sqrt(1.0 - cos_theta_o**2)
    zero = np.zeros_like(sin_o)
    axis = np.stack([-sin_o, zero, cos_theta_o], axis=-1)[:, None, None]
    up = np.stack([cos_theta_o, zero, sin_o], axis=-1)[:, None, None]
    quarter, quarter_weights = gauss_legendre(angular, 0.5 * np.pi)
    azimuth = np.concatenate([quarter, np.pi - quarter])
    azimuth_weights = np.concatenate([quarter_weights, quarter_weights])
    cosine, mu, sine = np.abs(np.cos(azimuth)), cos_theta_o[:, None], sin_o[:, None]
    reach = np.where(azimuth < 0.5 * np.pi, np.arctan2(sine, cosine * mu), np.arctan2(mu, cosine * sine))
    nodes, weights = gauss_legendre(radial, 1.0)
    scale = (0.3 * alpha)[:, None, None]
    stretch = np.arcsinh(reach[..., None] / scale)
    r = scale * np.sinh(stretch * nodes)
    measure = 2.0 * np.sin(r) * scale * np.cosh(stretch * nodes) * stretch * weights * azimuth_weights[:, None]
    side = np.cos(azimuth)[:, None, None] * up + np.sin(azimuth)[:, None, None] * np.array([0.0, 1.0, 0.0])
    directions = np.cos(r)[..., None] * axis + np.sin(r)[..., None] * side
    count = len(alpha)
    return directions.reshape(count, -1, 3), measure.reshape(count, -1)


def gauss_legendre(count: int, length: float = 1.0):
    """Nodes and weights (count,) of the Gauss-Legendre rule on [0, length]."""
    nodes, weights = np.polynomial.legendre.leggauss(count)
    return 0.5 * length * (nodes + 1.0), 0.5 * length * weights


@dataclass(frozen=True)
class Brdf:
    """An isotropic reflection lobe of one parameter, alpha = roughness^2, with F = 1."""

    name: str
    description: str
    # BRDF times cosine: cos_theta_o (P,), alpha (P,), unit directions (P, S, 3) -> (P, S) in sr^-1
    value: Callable
    # Quadrature: cos_theta_o (P,), alpha (P,), counts -> directions (P, S, 3) with y > 0, weights (P, S)
    samples: Callable
    # True for GGX: as alpha -> 0, BRDF times cosine becomes a warped clamped cosine with the known limit A = B = C = 1.
    cosine_limit: bool = False


def beckmann_cosine(cos_theta_o, alpha, directions):
    """Beckmann BRDF times cosine with F = 1 and height-correlated Smith masking-shadowing, as `brdf.ggx_brdf_cosine`.

    Walter et al. 2007, "Microfacet Models for Refraction through Rough Surfaces", eq. 25; the masking is Heitz 2014,
    "Understanding the Masking-Shadowing Function", eq. 72 and 99, with the error function instead of its rational fit.
    """
    mu_o, alpha = np.asarray(cos_theta_o)[..., None], np.asarray(alpha)[..., None]
    x, y, z = directions[..., 0], directions[..., 1], directions[..., 2]
    half_x, half_z = x + np.sqrt(np.maximum(1.0 - mu_o * mu_o, 0.0)), z + mu_o
    horizontal, vertical = half_x * half_x + y * y, np.maximum(half_z * half_z, 1e-300)
    slope = horizontal / (vertical * alpha * alpha)
    distribution = np.exp(-slope) * ((horizontal + vertical) / (vertical * alpha)) ** 2 / np.pi
    mu_i = np.maximum(z, 1e-12)
    masking = 1.0 / (1.0 + _beckmann_lambda(mu_i, alpha) + _beckmann_lambda(mu_o, alpha))
    return np.where(z > 0.0, distribution * masking / (4.0 * np.maximum(mu_o, 1e-12)), 0.0)


def _beckmann_lambda(mu, alpha):
    slope = mu / (alpha * np.sqrt(np.maximum(1.0 - mu * mu, 1e-30)))
    return 0.5 * (erf(slope) - 1.0) + np.exp(-slope * slope) / (2.0 * np.sqrt(np.pi) * slope)


GGX = Brdf(
    "ggx",
    "GGX, height-correlated Smith masking-shadowing, alpha = roughness^2, times cosine",
    brdf.ggx_brdf_cosine,
    polar_samples,
    cosine_limit=True,
)
BECKMANN = Brdf(
    "beckmann",
    "Beckmann, height-correlated Smith masking-shadowing, alpha = roughness^2, times cosine",
    beckmann_cosine,
    polar_samples,
)
BRDFS = {model.name: model for model in (GGX, BECKMANN)}
