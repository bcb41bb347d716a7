"""Fits tables and writes them, reproducibly byte by byte. Keeps the state of unfinished fits."""

import io
import json
import zipfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ltsh_addon.files import replacing
from ltsh_addon.lobes.lookup_table import FORMAT_VERSION, roughness_nodes, theta_nodes, warp_entries

from . import projection, refine
from .families import GGX, Brdf, Family
from .projection import (
    CURVE_NAMES,
    FLAT,
    TABULATED_IOR,
    Cells,
    Points,
    directional_albedo,
    fresnel_basis,
    project,
    relative_error,
    warped_basis,
)


def write_table(path: Path, fitted) -> None:
    """Write a `Fitted` with its metadata. The same arrays give the same bytes."""
    family = fitted.family
    metadata = {
        "format_version": FORMAT_VERSION,
        "name": path.stem,
        "family": family.kind,
        "degree": family.degree,
        "original_distribution": family.name,
        "brdf": fitted.model.description,
        "axes": "rows: roughness, uniform in [0, 1]; columns: theta_o, uniform in 1 - sqrt(1 - theta_o / 90 deg)",
        "fresnel_curve_names": CURVE_NAMES,
        "settings": settings(family, fitted.model, len(fitted.node_errors)),
        "node_error_mean": float(fitted.node_errors.mean()),
        "node_error_median": float(np.median(fitted.node_errors)),
        "command": f"python -m tables fit {family.name}{_options(fitted)}",
    }
    if family.bend is not None:
        metadata["bend"] = family.bend
    arrays = {**fitted.arrays, "node_errors": fitted.node_errors.astype(np.float32)}
    _write_npz(path, {**arrays, "metadata": np.array(json.dumps(metadata))})


def _options(fitted):
    size = len(fitted.node_errors)
    brdf = "" if fitted.model.name == "ggx" else f" --brdf {fitted.model.name}"
    return brdf + ("" if size == 64 else f" --size {size}")


def settings(family, model, size) -> dict:
    """The settings on which a fit depends, apart from the code."""
    return {
        "family": family.name,
        **({} if family.bend is None else {"bend": list(family.bend)}),
        "brdf": model.name,
        "size": size,
        "ridge": projection.RIDGE,
        "walk_penalty": refine.PENALTY,
        "iterations": refine.ITERATIONS,
        "albedo_weight": refine.ALBEDO_WEIGHT,
        "negative_weight": refine.NEGATIVE_WEIGHT,
        "negative_share": refine.NEGATIVE_SHARE,
        "excess_weight": refine.EXCESS_WEIGHT,
        "light_weight": refine.LIGHT_WEIGHT,
        "error_floor": refine.ERROR_FLOOR,
    }


class Checkpoint:
    """The state of one fit, in a file beside its table. A file of other settings is ignored."""

    def __init__(self, path: Path, settings: dict):
        self.path = path
        self.settings = json.dumps(settings, sort_keys=True)

    def load(self) -> dict[str, np.ndarray]:
        """The arrays saved last; {} if there is no readable file of the same settings."""
        try:
            with open(self.path, "rb") as file, np.load(file) as archive:
                arrays = {key: archive[key] for key in archive.files}
        except (OSError, ValueError, zipfile.BadZipFile, EOFError):
            return {}
        return arrays if str(arrays.pop("settings", "")) == self.settings else {}

    def save(self, arrays: dict) -> None:
        """Replace the file."""
        arrays = {key: np.asarray(value) for key, value in arrays.items()}
        _write_npz(self.path, {**arrays, "settings": np.array(self.settings)}, compress=False)

    def remove(self) -> None:
        """Remove the file, because the fit is complete."""
        self.path.unlink(missing_ok=True)


def _write_npz(path, arrays, compress=True):
    method = zipfile.ZIP_DEFLATED if compress else zipfile.ZIP_STORED
    with replacing(path) as temporary, zipfile.ZipFile(temporary, "w", method, compresslevel=9) as archive:
        for name, array in arrays.items():
            stream = io.BytesIO()
            np.lib.format.write_array(stream, np.asanyarray(array), allow_pickle=False)
            entry = zipfile.ZipInfo(f"{name}.npy", date_time=(1980, 1, 1, 0, 0, 0))
            entry.compress_type = method
            archive.writestr(entry, stream.getvalue())


# Least cosine of the nodes. Beyond 89.4 degrees the horizon cuts smooth lobes on the scale of alpha, and fits would
# hide needles.
GRAZING_COSINE = 0.01
WALK_SHARE = 0.25
ALBEDO_NODES = 48


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
    save(dict). A fit that was stopped resumes from there and gives the same numbers.
    """
    curves, weights = fresnel_basis()
    roughness, cosine = _nodes(size)
    progress = progress or (lambda fraction: None)
    warp, coefficients, errors = _fitted_nodes(family, model, (roughness, cosine), curves, progress, checkpoint)
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
    # At roughness 0 the lobe is a delta; use a point close by instead.
    roughness = np.concatenate([[0.25 * roughness[1]], roughness[1:]])
    return roughness, np.maximum(np.cos(theta_nodes(size)), GRAZING_COSINE)


def _fitted_nodes(family, model, nodes, curves, progress, checkpoint):
    """Warp (R, T, n), coefficients (R, T, F, size) and errors (R, T) of nodes at (roughness (R,), cosine (T,))."""
    roughness, cosine = nodes
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

        parameters = refine.walk(family, model, roughness, cosine, walked, start)
        warp = refine.stored_warp(parameters, roughness, cosine)
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
    """Coefficients (R, T, F, size) solved at each node for its warp, and the albedo (R, T, F) there."""
    coefficients, albedo = [], []
    for value, channels in zip(roughness, warp, strict=True):
        points = Points.at(model, cosine, np.full_like(cosine, value**2), curves)
        coefficients.append(project(family, points, *_row(family, points, channels), slice(None))[0])
        albedo.append(points.albedo)
    coefficients = np.stack(coefficients)
    coefficients[:, 0] = np.where(family.round, coefficients[:, 0], 0.0)
    return coefficients, np.stack(albedo)


def node_errors(family, model, roughness, cosine, warp, coefficients):
    """Relative L2 error (R, T) of the nodes for F = 1."""
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


def average_albedo(model, roughness, curves):
    """Integral (R, F) of 2 mu albedo(mu) over mu in [0, 1], by Gauss-Legendre in sqrt(mu), dense at grazing angles."""
    nodes, weights = np.polynomial.legendre.leggauss(ALBEDO_NODES)
    root, weights = 0.5 * (nodes + 1.0), 0.5 * weights
    mu, weights = root**2, weights * 2.0 * root
    rows = [directional_albedo(model, mu, np.full(ALBEDO_NODES, value**2), curves) for value in roughness]
    return np.stack([(2.0 * mu * weights) @ row for row in rows])
