"""A table at grazing views beside the best lobe of its family: `python -m ltsh_addon tables optimum --grazing`.

At n.v 0.04 to 0.2 lobes are long, bent and cut by the horizon, and errors are largest. How much of the error is the
family's own, and how much comes from tabulation? The lobe *solved* at a point has a warp and coefficients of its own,
by plain L2 search; a table is good where its error is not far above. Shaded errors are those of integrals over disks
of 10, 20 and 35 degrees, all over the hemisphere, relative to their root mean square. The search knows nothing of
lights and the fit of the tables does, so ratios below 1 are possible.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ltsh_addon.shading import brdf, evaluate_lobe
from ltsh_addon.shading.lookup_table import LookupTable

from .brdfs import GGX
from .families import family_named
from .optimum import best_lobes
from .projection import FLAT, Points, project, warped_basis
from .validate import disks, hemisphere_samples
from .walk import warp_of

ROUGHNESS = (0.1, 0.15, 0.2, 0.3, 0.4, 0.6, 0.8, 1.0)
COSINES = (0.04, 0.06, 0.09, 0.13, 0.2)
GOAL = 1.2


@dataclass(frozen=True)
class GrazingError:
    """Relative errors of a table and of the solved lobe at one point; `lobe` stands for the L2 error of the lobe."""

    roughness: float
    cosine: float
    table: float
    solved: float
    table_lobe: float
    solved_lobe: float

    @property
    def ratio(self) -> float:
        """Error of the table over that of the lobe solved at the point."""
        return self.table / self.solved


def grazing_errors(table: LookupTable, count: int = len(ROUGHNESS)) -> list[GrazingError]:
    """Errors at `count` of the values of ROUGHNESS, spread over them, and at all COSINES; spherical harmonics only."""
    chosen = np.unique(np.linspace(0, len(ROUGHNESS) - 1, max(count, 2)).round().astype(int))
    roughness, cosine = (grid.ravel() for grid in np.meshgrid(np.array(ROUGHNESS)[chosen], COSINES, indexing="ij"))
    family = family_named(f"ltsh{table.degree}")
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
    """Parameters (P, 3) of the warp that the table has at the points, as `walk.warp_of` reads them."""
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
