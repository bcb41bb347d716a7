"""Fits lookup tables: `python -m ltsh_addon tables fit [TABLE ...]`.

Three steps: `walk` fits node by node, `refine` moves all nodes together to what the bilinear lookup between them needs,
and the coefficients of the other Fresnel curves follow under the same warps. At the end the directional albedo of every
node is exact. At roughness 0 the lobe of GGX is known: nothing is searched for.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ltsh_addon.shading.lookup_table import roughness_nodes, theta_nodes, warp_entries

from . import refine, walk
from .brdfs import GGX, Brdf
from .cells import Cells
from .families import Family
from .fresnel_basis import FLAT, TABULATED_IOR, fresnel_basis
from .projection import Points, directional_albedo, project, relative_error, warped_basis

# Beyond 89.4 degrees smooth lobes are cut by the horizon on the scale of alpha; their fits would hide needles.
GRAZING_COSINE = 0.01
WALK_SHARE = 0.25


@dataclass(frozen=True)
class Fitted:
    """One fitted table: the arrays of `LookupTable`, and the relative L2 error (R, T) of its nodes for F = 1."""

    family: Family
    model: Brdf
    arrays: dict[str, np.ndarray]
    node_errors: np.ndarray


def fit(family: Family, size: int = 64, *, model: Brdf = GGX, progress=None, checkpoint=None) -> Fitted:
    """Fit one table of size x size nodes.

    `progress(fraction)` is called now and then. `checkpoint` has load() -> dict of arrays (empty at first) and
    save(dict): a fit that was stopped goes on from there and gives the same numbers.
    """
    curves, weights = fresnel_basis()
    roughness, cosine = _nodes(size)
    nodes = _fitted_nodes(family, model, roughness, cosine, curves, progress or (lambda fraction: None), checkpoint)
    warp, coefficients, errors = nodes
    arrays = {
        "warp": warp.astype(np.float32),
        "coefficients": (coefficients @ family.span).astype(np.float32),
        "fresnel_curves": curves,
        "fresnel_ior": TABULATED_IOR,
        "fresnel_weights": weights,
        "average_albedo": average_albedo(model, roughness, curves),
    }
    return Fitted(family, model, arrays, errors)


def _nodes(size):
    roughness = roughness_nodes(size)
    # At roughness 0 the lobe is a delta; its limit is taken close by.
    roughness = np.concatenate([[0.25 * roughness[1]], roughness[1:]])
    return roughness, np.maximum(np.cos(theta_nodes(size)), GRAZING_COSINE)


def _fitted_nodes(family, model, roughness, cosine, curves, progress, checkpoint):
    """Warp (R, T, n), coefficients (R, T, F, size) and errors (R, T) of the nodes."""
    saved = checkpoint.load() if checkpoint else {}

    def keep(**arrays):
        if checkpoint:
            checkpoint.save(arrays)

    if "nodes" in saved:
        state = refine.State(saved["nodes"], float(saved["damping"]), int(saved["iteration"]))
    else:
        start = (saved["parameters"], int(saved["diagonal"])) if "parameters" in saved else None

        def walked(fraction, state):
            keep(parameters=state[0], diagonal=state[1])
            progress(WALK_SHARE * fraction)

        parameters = walk.walk(family, model, roughness, cosine, walked, start)
        warp = walk.stored_warp(parameters, roughness, cosine)
        coefficients = project_nodes(family, model, roughness, cosine, warp, curves)[0]
        state = refine.State(np.concatenate([warp, coefficients[:, :, 0]], axis=2))

    def refined(fraction, state):
        keep(nodes=state.nodes, damping=state.damping, iteration=state.iteration)
        progress(WALK_SHARE + (0.95 - WALK_SHARE) * fraction)

    cells = Cells.of(model, (len(roughness), len(cosine)), GRAZING_COSINE, curves)
    nodes = refine.refine(family, model, cells, state, refined)
    warp = nodes[..., : family.parameters]
    limit, albedo = project_nodes(family, model, roughness, cosine, warp, curves)
    coefficients = refine.fresnel_coefficients(family, model, cells, nodes, limit, curves)
    coefficients = refine.with_exact_albedo(family, model, cells, nodes, coefficients, albedo)
    progress(1.0)
    return warp, coefficients, node_errors(family, model, roughness, cosine, warp, coefficients)


def project_nodes(family, model, roughness, cosine, warp, curves):
    """Coefficients (R, T, F, size) solved at every node for its warp, and the albedo (R, T, F) there."""
    coefficients, albedo = [], []
    for value, channels in zip(roughness, warp, strict=True):
        points = Points.at(model, cosine, np.full_like(cosine, value**2), curves)
        coefficients.append(project(family, points, *_row(family, points, channels), slice(None))[0])
        albedo.append(points.albedo)
    coefficients = np.stack(coefficients)
    coefficients[:, 0] = np.where(family.round, coefficients[:, 0], 0.0)
    return coefficients, np.stack(albedo)


def node_errors(family, model, roughness, cosine, warp, coefficients):
    """Relative L2 error (R, T) of the nodes, F = 1."""
    errors = []
    for value, channels, row in zip(roughness, warp, coefficients, strict=True):
        points = Points.at(model, cosine, np.full_like(cosine, value**2), FLAT)
        basis = warped_basis(family, points.directions, *_row(family, points, channels))
        errors.append(relative_error(points, np.einsum("psk,pk->ps", basis, row[:, 0])))
    return np.stack(errors)


def _row(family, points, channels):
    """Warp entries and tilt of one row of nodes with channels (T, n)."""
    tilt = channels[:, 3] if family.kind == "ltc" else np.zeros(len(channels))
    return warp_entries(points.cosine, points.alpha, *channels.T[:3]), tilt


def average_albedo(model, roughness, curves, count=48):
    """Integral (R, F) of 2 mu albedo(mu) over mu in [0, 1]: Gauss-Legendre in sqrt(mu), which is dense at grazing."""
    nodes, weights = np.polynomial.legendre.leggauss(count)
    root, weights = 0.5 * (nodes + 1.0), 0.5 * weights
    mu, weights = root**2, weights * 2.0 * root
    rows = [directional_albedo(model, mu, np.full(count, value**2), curves) for value in roughness]
    return np.stack([(2.0 * mu * weights) @ row for row in rows])
