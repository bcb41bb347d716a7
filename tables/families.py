"""The original distributions that can be fitted: what a warp is applied to."""

from __future__ import annotations

import re
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from ltsh_addon.shading import spherical_harmonics


@dataclass(frozen=True)
class Family:
    """A space of original distributions, even in y.

    kind "ltc": the clamped cosine, whose axis may tilt (fourth parameter of the warp). kind "ltsh": the polynomials in
    x, z of a degree, which are the spherical harmonics even in y; `powers` restricts them to some monomials
    x^p z^q: their integral needs fewer terms per edge. A table stores spherical harmonics coefficients in any case.
    """

    name: str
    kind: str
    degree: int
    powers: tuple[tuple[int, int], ...] = ()

    @property
    def parameters(self) -> int:
        """Number of warp channels."""
        return 4 if self.kind == "ltc" else 3

    @property
    def size(self) -> int:
        """Number of free coefficients."""
        return len(self.span)

    @cached_property
    def span(self) -> np.ndarray:
        """Matrix (size, K): the family's basis functions as combinations of what a table stores."""
        if self.kind == "ltc":
            return np.eye(1)
        count = spherical_harmonics.coefficient_count(self.degree)
        if not self.powers:
            return np.eye(count)
        generator = np.random.default_rng(1)
        directions = generator.normal(size=(8 * count, 3))
        directions /= np.linalg.norm(directions, axis=1, keepdims=True)
        # On the hemisphere x^p z^q is taken as it stands: on the sphere it is the same polynomial.
        values = np.stack([directions[:, 0] ** p * directions[:, 2] ** q for p, q in self.powers], axis=1)
        harmonics = spherical_harmonics.evaluate(self.degree, directions).T
        return np.linalg.lstsq(harmonics, values, rcond=None)[0].T

    @cached_property
    def round(self) -> np.ndarray:
        """(size,) whether a basis function may be used at normal incidence, where the lobe is rotation-symmetric."""
        if self.kind == "ltc":
            return np.ones(1, dtype=bool)
        zonal = [m == 0 for l in range(self.degree + 1) for m in range(l + 1)]  # noqa: E741
        return np.abs(self.span[:, ~np.array(zonal)]).max(axis=1, initial=0.0) < 1e-9

    def basis(self, unit, tilt):
        """Basis functions (P, S, size) at unit directions (P, S, 3) of the original domain; tilt (P,)."""
        if self.kind == "ltc":
            toward_axis = np.sin(tilt)[:, None] * unit[..., 0] + np.cos(tilt)[:, None] * unit[..., 2]
            return np.maximum(toward_axis, 0.0)[..., None] / np.pi
        harmonics = np.moveaxis(spherical_harmonics.evaluate(self.degree, unit), 0, -1)
        return harmonics @ self.span.T if self.powers else harmonics

    def basis_albedo(self, tilt):
        """Integrals (P, size) of the basis functions over the upper hemisphere."""
        if self.kind == "ltc":
            return 0.5 * (1.0 + np.cos(tilt))[:, None]
        integrals = self.span @ spherical_harmonics.hemisphere_integrals(self.degree)
        return np.broadcast_to(integrals, (len(tilt), len(integrals)))


def two_ridges(degree: int) -> Family:
    """Polynomials h_x(x) + h_z(z): 2 degree + 1 coefficients."""
    powers = tuple((0, q) for q in range(degree + 1)) + tuple((p, 0) for p in range(1, degree + 1))
    return Family(f"ridges{degree}", "ltsh", degree, powers)


def zonal(degree: int) -> Family:
    """Polynomials h(z): degree + 1 coefficients."""
    return Family(f"zonal{degree}", "ltsh", degree, tuple((0, q) for q in range(degree + 1)))


def odd_in_z(degree: int) -> Family:
    """Polynomials odd in z: on the upper hemisphere these need no solid angle."""
    powers = tuple((n - q, q) for n in range(1, degree + 1) for q in range(1, n + 1, 2))
    return Family(f"odd{degree}", "ltsh", degree, powers)


def family_named(name: str) -> Family:
    """The family "ltc", "ltshN", "ridgesN", "zonalN" or "oddN" of degree N = 1..8. Raises ValueError."""
    if name == "ltc":
        return Family("ltc", "ltc", 1)
    makers = {"ltsh": lambda n: Family(f"ltsh{n}", "ltsh", n), "ridges": two_ridges, "zonal": zonal, "odd": odd_in_z}
    match = re.fullmatch("(ltsh|ridges|zonal|odd)([1-8])", name)
    if match is None:
        raise ValueError(f"table {name!r} is unknown, expected ltc, or ltsh, ridges, zonal or odd with a degree 1..8")
    return makers[match[1]](int(match[2]))
