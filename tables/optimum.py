"""The best that a family of lobes can do: the best warp and coefficients at single points, with no table in between.

The lookup of a table cannot be better. Each point of a 12 x 12 grid, like that of `validate`, is searched for the least
plain L2 error of a lobe with exact albedo. The search starts from several warps, then from the best ones of the
point's neighbors.

At grazing views (n.v 0.04 to 0.2) lobes are long, bent and cut by the horizon, and errors are largest. There
`tables optimum --grazing` compares a table with such *solved* lobes at the same points. Shaded errors are those of
integrals over disks of 10, 20 and 35 degrees, all over the hemisphere, relative to their root mean square. Ratios below
1 are possible, because the fit of the tables takes lights into account and the search does not.
"""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from ltsh_addon.files import write_bytes
from ltsh_addon.lobes import brdf
from ltsh_addon.lobes.edge_integrals import ridge_matrix
from ltsh_addon.lobes.lookup_table import LookupTable
from ltsh_addon.shading import evaluate_lobe

from .families import GGX, family_named
from .projection import FLAT, Points, project, relative_error, warped_basis
from .refine import bounds, minimize, warp_of
from .validate import disks, grid, hemisphere_samples

COUNT = 12
# Results of `tables optimum --all` for every family of CURVES at COUNT_OF_ALL x COUNT_OF_ALL points: {family: errors}.
ALL, COUNT_OF_ALL = Path(__file__).with_name("optimum.json"), 6
# Starts of a search: beta as a share of -theta_o, and the logarithms of a cos^2(beta) / (2 alpha) and c / (2 alpha).
STARTS = ((1.0, 0.0), (0.8, -0.3), (0.5, -0.6), (0.2, -1.0))
# Starts for the warp of a second lobe; the first lobe starts from the best one on its own.
SECOND_STARTS = ((1, 0, 1), (-1, 0, -1), (-1, 0.7, 0.2), (0.5, -0.2, -0.4), (-1.5, 1, -1.5), (2, 0, 2))
# Grazing views at which tables are compared with solved lobes, and the largest ratio of errors that is good.
ROUGHNESS = (0.1, 0.15, 0.2, 0.3, 0.4, 0.6, 0.8, 1.0)
COSINES = (0.04, 0.06, 0.09, 0.13, 0.2)
GOAL = 1.2
CURVES = {
    "clamped cosine (LTC)": ["ltc"],
    "spherical harmonics": ["ltsh1", "ltsh2", "ltsh3", "ltsh4", "ltsh5", "ltsh6"],
    "the same and a bent cosine": ["ltsh1c", "ltsh2c", "ltsh3c", "ltsh4c"],
    "sum of two lobes": ["ltsh1+ltc", "ltsh2+ltc", "ltsh3+ltc", "ltsh2+ltsh2", "ltsh4+ltc"],
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
    """The least errors found for the family `name` at count x count points."""
    cosine, roughness = np.array(grid(count)).T
    errors, _ = best_lobes(family_named(name), cosine, roughness, (count, count))
    return Optimum(name, errors, edge_terms(name))


def all_families() -> list[str]:
    """The families of CURVES."""
    return list(dict.fromkeys(name for names in CURVES.values() for name in names))


def known_optima() -> dict[str, Optimum]:
    """The optima in the file ALL, by family."""
    found = json.loads(ALL.read_text(encoding="utf-8"))
    return {name: Optimum(name, np.array(errors), edge_terms(name)) for name, errors in found.items()}


def keep_optimum(found: Optimum) -> None:
    """Write an optimum found at COUNT_OF_ALL into the file ALL."""
    kept = json.loads(ALL.read_text(encoding="utf-8")) if ALL.exists() else {}
    kept[found.name] = [float(f"{error:.4g}") for error in found.errors]
    lines = ",\n".join(f"{json.dumps(name)}: {json.dumps(kept[name])}" for name in sorted(kept))
    write_bytes(ALL, f"{{\n{lines}\n}}\n".encode())


def best_lobes(family, cosine, roughness, shape, starts=()):
    """Least errors (P,) at cosine (P,) and roughness (P,), and the warp parameters (P, n) that reach them.

    The points are a grid of `shape`, row by row. The search also tries further `starts` (P, n).
    """
    theta = np.arccos(cosine)
    best = np.full(len(cosine), np.inf)
    found = np.zeros((len(cosine), family.parameters))

    def search(start):
        for part in np.array_split(np.arange(len(cosine)), shape[0]):
            errors, parameters = _search(family, cosine[part], roughness[part], start[part])
            better = errors < best[part]
            found[part[better]], best[part[better]] = parameters[better], errors[better]

    if family.second is not None:
        _, first = best_lobes(replace(family, second=None), cosine, roughness, shape)
        second = [np.broadcast_to(np.array(start, dtype=float), (len(first), 3)) for start in SECOND_STARTS]
        starts = [*(np.concatenate([first, start], axis=1) for start in second), *starts]
    for share, logarithm in STARTS if family.second is None else ():
        start = np.zeros_like(found)
        start[:, :2], start[:, 2] = logarithm, -share * theta
        search(start)
    for start in starts:
        search(start)
    for shift in ((1, 0), (-1, 0), (0, 1), (0, -1)):
        search(np.roll(found.reshape(*shape, -1), shift, axis=(0, 1)).reshape(found.shape))
    return best, found


def _search(family, cosine, roughness, start):
    """Errors (P,) and warp parameters (P, n) of the minima that the search finds from `start`."""
    points = Points.at(GGX, cosine, roughness**2, FLAT)
    start = np.clip(start, *bounds(family))
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
    if family.second is not None:
        return sum(map(edge_terms, name.split("+")))
    if family.bend is not None:
        return family.size
    used = np.abs(family.span @ ridge_matrix(family.degree)) > 1e-9
    return int(used.any(axis=0).sum())


@dataclass(frozen=True)
class GrazingError:
    """Relative errors of a table and of the solved lobe at one point. Names with `lobe` are L2 errors of the lobe."""

    roughness: float
    cosine: float
    table: float
    solved: float
    table_lobe: float
    solved_lobe: float

    @property
    def ratio(self) -> float:
        """Error of the table divided by that of the lobe solved at the point."""
        return self.table / self.solved


def grazing_errors(table: LookupTable, count: int = len(ROUGHNESS)) -> list[GrazingError]:
    """Errors at `count` values spread over ROUGHNESS and at all COSINES. For tables of spherical harmonics only."""
    chosen = np.unique(np.linspace(0, len(ROUGHNESS) - 1, max(count, 2)).round().astype(int))
    roughness, cosine = (grid.ravel() for grid in np.meshgrid(np.array(ROUGHNESS)[chosen], COSINES, indexing="ij"))
    family = family_named(f"ltsh{table.degree}" if table.bend is None else f"ltsh{table.degree}c")
    shape = (len(chosen), len(COSINES))
    _, parameters = best_lobes(family, cosine, roughness, shape, starts=[_warp_of_table(table, cosine, roughness)])
    points = Points.at(GGX, cosine, roughness**2, FLAT)
    entries, tilt = warp_of(family, points, parameters)
    coefficients = project(family, points, entries, tilt)[0][:, 0]
    found = []
    for index in range(len(cosine)):
        one = tuple(entry[index : index + 1] for entry in entries)
        solved = (family, one, tilt[index : index + 1], coefficients[index])
        found.append(_measure(table, solved, float(cosine[index]), float(roughness[index])))
    return found


def _warp_of_table(table, cosine, roughness):
    """Parameters (P, 3) of the table's warp at the points, in the form that `refine.warp_of` takes."""
    lobe = table.lookup(cosine, roughness)
    scale = 2.0 * roughness**2 / lobe.zz
    xx, xz, yy = (np.asarray(entry, dtype=np.float64) * scale for entry in (lobe.xx, lobe.xz, lobe.yy))
    angle = np.arctan2(-xz, xx)
    return np.stack([-np.log(xx / np.cos(angle) ** 2), -np.log(yy), angle], axis=-1)


def _measure(table, solved, cosine, roughness) -> GrazingError:
    directions, weights = (part[0] for part in hemisphere_samples(np.array([cosine]), np.array([roughness**2])))
    directions, weights = directions[weights > 0.0], weights[weights > 0.0]
    truth = brdf.ggx_brdf_cosine(cosine, roughness**2, directions)
    family, entries, tilt, coefficients = solved
    lobes = (
        evaluate_lobe(table, np.array([cosine]), np.array([roughness]), directions[None])[0],
        warped_basis(family, directions[None], entries, tilt)[0] @ coefficients,
    )
    lit = disks(directions) * weights
    exact = lit @ truth
    shaded = [np.linalg.norm(lit @ lobe - exact) / np.linalg.norm(exact) for lobe in lobes]
    norm = np.sqrt((weights * truth**2).sum())
    squared = [np.sqrt((weights * (lobe - truth) ** 2).sum()) / norm for lobe in lobes]
    return GrazingError(roughness, cosine, *(float(error) for error in (*shaded, *squared)))
