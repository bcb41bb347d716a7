"""The best that a family of lobes can do: the best warp and coefficients at single points, with no table in between.
Pictures of that and of the tables.

The lookup of a table cannot be better. Each point of a 12 x 12 grid, like that of `validate`, is searched for the least
plain L2 error of a lobe with exact albedo. The search starts from several warps, then from the best ones of the
point's neighbors.

At grazing views (n.v 0.04 to 0.2) lobes are long, bent and cut by the horizon, and errors are largest. There
`tables optimum --grazing` compares a table with such *solved* lobes at the same points. Shaded errors are those of
integrals over disks of 10, 20 and 35 degrees, all over the hemisphere, relative to their root mean square. Ratios below
1 are possible, because the fit of the tables takes lights into account and the search does not.
"""

import json
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from ltsh_addon.files import write_bytes
from ltsh_addon.lobes import brdf
from ltsh_addon.lobes.edge_integrals import ridge_matrix
from ltsh_addon.lobes.lookup_table import LookupTable
from ltsh_addon.shading import SHIPPED_TABLES, evaluate_lobe, load_table

from .families import GGX, family_named
from .projection import FLAT, Points, project, relative_error, warped_basis
from .refine import bounds, minimize, warp_of
from .validate import disks, error_map, grid, hemisphere_samples

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


# The pictures of tables/README.md, which need matplotlib:

STYLE = {"font.size": 9, "axes.spines.top": False, "axes.spines.right": False, "savefig.dpi": 110}
COLORS = {"ltc": "tab:gray", "ltsh2": "tab:blue", "ltsh4": "tab:red", "ltsh4c": "tab:green"}
# Lobes at grazing angle: (roughness, theta_o in degrees)
LOBES = [(0.25, 80.0), (0.5, 80.0), (0.5, 87.0), (0.8, 80.0)]


def draw_all(folder: Path, report) -> list[Path]:
    """Draw every figure into `folder`, and return the paths. `report(text)` says what is being drawn."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figures = {"error_maps": draw_error_maps, "lobes": draw_lobes, "error_against_cost": draw_error_against_cost}
    paths = []
    with plt.rc_context(STYLE):
        for name, draw in figures.items():
            report(f"drawing {name}")
            path = folder / f"tables_{name}.png"
            figure = draw(plt)
            # Without the program's version, the same figure has the same bytes.
            figure.savefig(path, bbox_inches="tight", metadata={"Software": None})
            plt.close(figure)
            paths.append(path)
    return paths


def draw_error_maps(plt):
    """Relative L2 error over roughness and angle, one panel per shipped table."""
    from matplotlib.colors import LogNorm

    figure, axes = plt.subplots(1, len(SHIPPED_TABLES), figsize=(13.0, 3.1), sharey=True, constrained_layout=True)
    for axis, name in zip(axes, SHIPPED_TABLES, strict=True):
        errors = error_map(load_table(name))
        image = axis.imshow(
            errors, origin="lower", extent=(0, 88, 0.1, 1.0), aspect="auto", norm=LogNorm(3e-4, 0.4), cmap="magma"
        )
        axis.set_title(f"{name}: mean {errors.mean():.4f}, median {np.median(errors):.4f}", fontsize=9)
        axis.set_xlabel("theta_o in degrees")
    axes[0].set_ylabel("roughness")
    figure.colorbar(image, ax=axes, label="relative L2 error between the nodes")
    return figure


def draw_lobes(plt):
    """The lobes and the BRDF in the plane of incidence at grazing angles, like Figure 2 of Allmenroeder and Peters
    2021. The radius is the square root of BRDF times cosine, which shows the tail."""
    figure, axes = plt.subplots(1, len(LOBES), figsize=(12.0, 2.9), constrained_layout=True)
    elevation = np.linspace(1e-4, np.pi - 1e-4, 1500)
    directions = np.stack([-np.cos(elevation), np.zeros_like(elevation), np.sin(elevation)], axis=-1)
    for axis, (roughness, theta) in zip(axes, LOBES, strict=True):
        mu = np.array([np.cos(np.radians(theta))])
        exact = np.sqrt(brdf.ggx_brdf_cosine(mu, np.array([roughness**2]), directions[None])[0])
        axis.fill(directions[:, 0] * exact, directions[:, 2] * exact, color="0.85", label="GGX")
        for name in SHIPPED_TABLES:
            lobe = evaluate_lobe(load_table(name), mu, np.array([roughness]), directions[None])[0]
            radius = np.sign(lobe) * np.sqrt(np.abs(lobe))
            axis.plot(directions[:, 0] * radius, directions[:, 2] * radius, color=COLORS[name], lw=1.0, label=name)
        axis.set_title(f"roughness {roughness}, theta_o {theta:.0f} deg", fontsize=9)
        axis.axhline(0.0, color="0.5", lw=0.6)
        axis.set_aspect("equal")
        axis.axis("off")
    figure.legend(*axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=5, frameon=False)
    return figure


def draw_error_against_cost(plt):
    """Error against cost, the number of moments of a polygon. It shows what each family can reach at a point, as found
    by `tables optimum --all`, and what the shipped tables reach between their nodes, at the same points."""
    figure, axis = plt.subplots(figsize=(6.4, 4.0), constrained_layout=True)
    known = known_optima()
    for title, names in CURVES.items():
        results = [known[name] for name in names]
        terms = [result.edge_terms for result in results]
        axis.plot(terms, [result.mean for result in results], "o-", ms=4, lw=1.0, label=title)
        for result in results:
            position = (result.edge_terms, result.mean)
            axis.annotate(result.name, position, fontsize=6, xytext=(3, 3), textcoords="offset points")
    for name in SHIPPED_TABLES:
        error = error_map(load_table(name), COUNT_OF_ALL).mean()
        label = "shipped, between the nodes" if name == SHIPPED_TABLES[0] else None
        axis.plot(edge_terms(name), error, "k*", ms=9, label=label)
    axis.set_yscale("log")
    axis.set_xlabel("sums over edges per integral (moments)")
    axis.set_ylabel("mean relative L2 error")
    axis.legend(fontsize=7, frameon=False)
    return figure
