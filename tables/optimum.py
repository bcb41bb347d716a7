"""How good a family of lobes can be: the best warp and coefficients at single points, with no table in between.

The lookup of a table cannot be better than this. Every point of a 12 x 12 grid like that of `validate` is searched by
plain L2 error, for a lobe whose albedo is exact: from several starts, then from the best warps of its neighbors.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ltsh_addon.shading.edge_integrals import ridge_matrix

from .brdfs import GGX
from .families import family_named
from .projection import FLAT, Points, project, relative_error, warped_basis
from .validate import grid
from .walk import HIGHEST, LOWEST, minimize, warp_of

COUNT = 12
# Start of a search: beta as a share of -theta_o, and the logarithms of a cos^2(beta) / (2 alpha) and c / (2 alpha).
STARTS = ((1.0, 0.0), (0.8, -0.3), (0.5, -0.6), (0.2, -1.0))
CURVES = {
    "clamped cosine (LTC)": ["ltc"],
    "spherical harmonics": ["ltsh1", "ltsh2", "ltsh3", "ltsh4", "ltsh6"],
    "two ridges, h(x) + h(z)": ["ridges3", "ridges4", "ridges6"],
    "zonal, h(z)": ["zonal2", "zonal4", "zonal6"],
    "odd in z": ["odd3", "odd4", "odd6"],
}


@dataclass(frozen=True)
class Optimum:
    """Relative L2 errors (P,) at the points of the grid."""

    name: str
    errors: np.ndarray
    edge_terms: int

    @property
    def mean(self) -> float:
        """Mean of the errors of all points."""
        return float(self.errors.mean())


def optimum(name: str, count: int = COUNT) -> Optimum:
    """The least errors found for the family called `name` at count x count points."""
    cosine, roughness = np.array(grid(count)).T
    errors, _ = best_lobes(family_named(name), cosine, roughness, (count, count))
    return Optimum(name, errors, edge_terms(name))


def best_lobes(family, cosine, roughness, shape, starts=()):
    """Least errors (P,) and the warp parameters (P, n) that have them, at cosine (P,) and roughness (P,).

    The points are a grid of `shape`, row by row; further `starts` (P, n) of the search can be given.
    """
    theta = np.arccos(cosine)
    best = np.full(len(cosine), np.inf)
    found = np.zeros((len(cosine), family.parameters))

    def search(start):
        for part in np.array_split(np.arange(len(cosine)), shape[0]):
            errors, parameters = _search(family, cosine[part], roughness[part], start[part])
            better = errors < best[part]
            found[part[better]], best[part[better]] = parameters[better], errors[better]

    for share, logarithm in STARTS:
        start = np.zeros_like(found)
        start[:, :2], start[:, 2] = logarithm, -share * theta
        search(start)
    for start in starts:
        search(start)
    for shift in ((1, 0), (-1, 0), (0, 1), (0, -1)):
        search(np.roll(found.reshape(*shape, -1), shift, axis=(0, 1)).reshape(found.shape))
    return best, found


def _search(family, cosine, roughness, start):
    """Errors (P,) and warp parameters (P, n) of the minima next to `start`."""
    points = Points.at(GGX, cosine, roughness**2, FLAT)
    start = np.clip(start, LOWEST[: family.parameters], HIGHEST[: family.parameters])
    found = minimize(family, points, start, np.zeros(start.shape, dtype=bool), penalty=0.0, iterations=40)
    entries, tilt = warp_of(family, points, found)
    coefficients = project(family, points, entries, tilt)[0][:, 0]
    lobes = np.einsum("psk,pk->ps", warped_basis(family, points.directions, entries, tilt), coefficients)
    return relative_error(points, lobes), found


def edge_terms(name: str) -> int:
    """Number of moments that an integral of the family needs: the solid angle and the sums over edges."""
    family = family_named(name)
    if family.kind == "ltc":
        return 1
    used = np.abs(family.span @ ridge_matrix(family.degree)) > 1e-9
    return int(used.any(axis=0).sum())
