"""Draws the figures of tables/README.md: `python -m tables plot` (needs matplotlib)."""

from __future__ import annotations

from pathlib import Path

import matplotlib
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.colors import LogNorm

from ltsh_addon.lobes import brdf
from ltsh_addon.shading import SHIPPED_TABLES, evaluate_lobe, load_table

from . import optimum, validate

matplotlib.use("Agg")

STYLE = {"font.size": 9, "axes.spines.top": False, "axes.spines.right": False, "savefig.dpi": 110}
COLORS = {"ltc": "tab:gray", "ltsh2": "tab:blue", "ltsh4": "tab:red", "ltsh4c": "tab:green"}
# Lobes at grazing angle: (roughness, theta_o in degrees)
LOBES = [(0.25, 80.0), (0.5, 80.0), (0.5, 87.0), (0.8, 80.0)]


def draw_all(folder: Path, report) -> list[Path]:
    """Draw every figure into `folder`, and return the paths. `report(text)` says what is being drawn."""
    figures = {"error_maps": draw_error_maps, "lobes": draw_lobes, "error_against_cost": draw_error_against_cost}
    paths = []
    with plt.rc_context(STYLE):
        for name, draw in figures.items():
            report(f"drawing {name}")
            path = folder / f"tables_{name}.png"
            figure = draw()
            # Without the program's version, the same figure has the same bytes.
            figure.savefig(path, bbox_inches="tight", metadata={"Software": None})
            plt.close(figure)
            paths.append(path)
    return paths


def draw_error_maps():
    """Relative L2 error over roughness and angle, one panel per shipped table."""
    figure, axes = plt.subplots(1, len(SHIPPED_TABLES), figsize=(13.0, 3.1), sharey=True, constrained_layout=True)
    for axis, name in zip(axes, SHIPPED_TABLES, strict=True):
        errors = validate.error_map(load_table(name))
        image = axis.imshow(
            errors, origin="lower", extent=(0, 88, 0.1, 1.0), aspect="auto", norm=LogNorm(3e-4, 0.4), cmap="magma"
        )
        axis.set_title(f"{name}: mean {errors.mean():.4f}, median {np.median(errors):.4f}", fontsize=9)
        axis.set_xlabel("theta_o in degrees")
    axes[0].set_ylabel("roughness")
    figure.colorbar(image, ax=axes, label="relative L2 error between the nodes")
    return figure


def draw_lobes():
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


def draw_error_against_cost():
    """Error against cost, the number of moments of a polygon. It shows what each family can reach at a point, as found
    by `tables optimum --all`, and what the shipped tables reach between their nodes, at the same points."""
    figure, axis = plt.subplots(figsize=(6.4, 4.0), constrained_layout=True)
    known = optimum.known_optima()
    for title, names in optimum.CURVES.items():
        results = [known[name] for name in names]
        terms = [result.edge_terms for result in results]
        axis.plot(terms, [result.mean for result in results], "o-", ms=4, lw=1.0, label=title)
        for result in results:
            position = (result.edge_terms, result.mean)
            axis.annotate(result.name, position, fontsize=6, xytext=(3, 3), textcoords="offset points")
    for name in SHIPPED_TABLES:
        error = validate.error_map(load_table(name), optimum.COUNT_OF_ALL).mean()
        label = "shipped, between the nodes" if name == SHIPPED_TABLES[0] else None
        axis.plot(optimum.edge_terms(name), error, "k*", ms=9, label=label)
    axis.set_yscale("log")
    axis.set_xlabel("sums over edges per integral (moments)")
    axis.set_ylabel("mean relative L2 error")
    axis.legend(fontsize=7, frameon=False)
    return figure
