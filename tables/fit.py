"""Fits the lookup tables of GGX: `python -m ltsh_addon tables fit`, about a minute a table on one core.

For every node (roughness, theta_o) the warp minimizes the L2 error of the cosine-weighted BRDF over the upper
hemisphere, with the tail of the lobe weighted up: a light is often seen in the tail alone, and a plain L2 norm would
trade a tail that is 20 % too dark for a little at the peak. The coefficients are the linear least-squares solution for
that warp (variable projection, Golub and Pereyra 1973) under the constraint that the directional albedo is exact. The
nodes are visited along anti-diagonals, from rough to smooth and from normal to grazing incidence: each starts from what
its neighbors predict, and a small penalty on the distance to the prediction keeps the table smooth, because a lookup
interpolates it. At roughness 0 the warp is the limit of GGX, which is known: nothing is searched for.

Parameters of a node: log(a cos^2(beta) / (2 alpha)), log(c / (2 alpha)), beta, tilt, for
M = [[a, 0, tan(beta)], [0, c, 0], [0, 0, 1]]: all of them tend to simple limits as alpha -> 0.
"""

from __future__ import annotations

import io
import json
import os
import zipfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ltsh_addon.shading import brdf, spherical_harmonics
from ltsh_addon.shading.lookup_table import FORMAT_VERSION, WARP_REGULARIZATION, roughness_nodes, theta_nodes

from .fresnel_basis import COSINES, TABULATED_IOR, fresnel_basis
from .hemisphere_quadrature import polar_samples

PENALTY = 1e-3
RIDGE = 1e-6
# Weight of the squared error where the lobe is a share s of its maximum: (s + TAIL_FLOOR)^-TAIL_EMPHASIS.
TAIL_EMPHASIS = 0.5
TAIL_FLOOR = 0.01
MAX_BETA = 1.5705
# Where the lobe is cut by the horizon on the scale of alpha, free parameters would run away for no gain.
LOWEST = np.array([-2.0, -2.5, -MAX_BETA, -1.5])
HIGHEST = np.array([6.0, 2.0, 0.5, 1.5])
# Beyond 89.4 degrees smooth lobes are cut by the horizon on the scale of alpha; their fits would hide needles.
GRAZING_COSINE = 0.01


@dataclass(frozen=True)
class Family:
    """Which original distribution: "ltc" (clamped cosine, four parameters) or "ltsh" of a degree (three)."""

    name: str
    kind: str
    degree: int

    @property
    def parameters(self) -> int:
        return 4 if self.kind == "ltc" else 3

    def basis(self, unit, tilt):
        """Basis functions (K, P, S) at unit directions (P, S, 3) of the original domain; tilt (P,)."""
        if self.kind == "ltsh":
            return spherical_harmonics.evaluate(self.degree, unit)
        toward_axis = np.sin(tilt)[:, None] * unit[..., 0] + np.cos(tilt)[:, None] * unit[..., 2]
        return np.maximum(toward_axis, 0.0)[None] / np.pi

    def basis_albedo(self, tilt):
        """Integrals (P, K) of the basis functions over the upper hemisphere."""
        if self.kind == "ltsh":
            integrals = spherical_harmonics.hemisphere_integrals(self.degree)
            return np.broadcast_to(integrals, (len(tilt), len(integrals)))
        return 0.5 * (1.0 + np.cos(tilt))[:, None]


FAMILIES = {
    "ltc": Family("ltc", "ltc", 1),
    "ltsh2": Family("ltsh2", "ltsh", 2),
    "ltsh4": Family("ltsh4", "ltsh", 4),
}


@dataclass(frozen=True)
class _Nodes:
    """Quadrature and target of a batch of nodes."""

    alpha: np.ndarray
    directions: np.ndarray
    quadrature: np.ndarray  # (P, S) weights of the integral over the hemisphere
    weights: np.ndarray  # (P, S) the same with the tail weighted up
    lobes: np.ndarray  # (P, S, F) cosine-weighted BRDF times each Fresnel curve
    albedo: np.ndarray  # (P, F)

    @classmethod
    def at(cls, cosine, alpha, curves):
        directions, weights = polar_samples(cosine, alpha)
        lobes = _lobes(cosine, alpha, directions, curves)
        fine_directions, fine_weights = polar_samples(cosine, alpha, 64, 96)
        albedo = np.einsum("ps,psf->pf", fine_weights, _lobes(cosine, alpha, fine_directions, curves))
        share = lobes[..., 0] / lobes[..., 0].max(axis=1, keepdims=True)
        emphasis = (share + TAIL_FLOOR) ** -TAIL_EMPHASIS
        return cls(alpha, directions, weights, weights * emphasis, lobes, albedo)


def _lobes(cosine, alpha, directions, curves):
    half = brdf.half_angle_cosine(cosine, directions)
    factors = np.stack([np.interp(half, COSINES, curve) for curve in curves], axis=-1)
    return brdf.ggx_brdf_cosine(cosine, alpha, directions)[..., None] * factors


def _project(family, nodes, parameters, curves=slice(0, 1)):
    """Coefficients (P, F, K) and weighted residuals (P, S, F), relative to each lobe's norm, for the given warps."""
    basis = _warped_basis(family, nodes, parameters)
    root = np.sqrt(nodes.weights)[..., None]
    basis, target = basis * root, nodes.lobes[..., curves] * root
    scale = 1.0 / np.sqrt((basis * basis).sum(axis=1))
    basis = basis * scale[:, None, :]
    transposed = np.swapaxes(basis, 1, 2)
    gram = np.matmul(transposed, basis) + RIDGE * np.eye(basis.shape[2])
    albedo_row = family.basis_albedo(_tilt(family, parameters)) * scale
    right = np.concatenate([np.matmul(transposed, target), albedo_row[..., None]], axis=2)
    solution = np.linalg.solve(gram, right)
    free, direction = solution[..., :-1], solution[..., -1]
    # Lagrange multiplier of the albedo constraint
    missing = nodes.albedo[:, curves] - np.einsum("pk,pkf->pf", albedo_row, free)
    multiplier = missing / (albedo_row * direction).sum(axis=1)[:, None]
    coefficients = free + direction[..., None] * multiplier[:, None, :]
    norm = np.sqrt((target * target).sum(axis=1, keepdims=True))
    residual = (target - np.matmul(basis, coefficients)) / np.maximum(norm, 1e-30)
    return np.swapaxes(coefficients * scale[..., None], 1, 2), residual


def _relative_error(family, nodes, parameters, coefficients):
    """Relative L2 error (P,) over the upper hemisphere of the lobes with coefficients (P, K), F = 1."""
    fitted = np.einsum("psk,pk->ps", _warped_basis(family, nodes, parameters), coefficients)
    target = nodes.lobes[..., 0]
    squared = (nodes.quadrature * (fitted - target) ** 2).sum(axis=1)
    return np.sqrt(squared / (nodes.quadrature * target**2).sum(axis=1))


def _tilt(family, parameters):
    return parameters[:, 3] if family.kind == "ltc" else np.zeros(len(parameters))


def _warped_basis(family, nodes, parameters):
    a = 2.0 * nodes.alpha * np.exp(parameters[:, 0]) / np.cos(parameters[:, 2]) ** 2
    c = 2.0 * nodes.alpha * np.exp(parameters[:, 1])
    b = np.tan(parameters[:, 2])
    x, y, z = (nodes.directions[..., axis] for axis in range(3))
    warped = np.stack([(x - b[:, None] * z) / a[:, None], y / c[:, None], z], axis=-1)
    length = np.sqrt((warped * warped).sum(axis=-1))
    basis = family.basis(warped / length[..., None], _tilt(family, parameters))
    return np.moveaxis(basis / ((a * c)[:, None] * length**3), 0, 2)


def _minimize(family, nodes, prediction, frozen, iterations=14):
    """Levenberg-Marquardt over the warp parameters (P, n), all nodes of the batch at once."""
    identity = np.eye(family.parameters)

    def residuals(parameters):
        return _project(family, nodes, parameters)[1][..., 0]

    def cost_of(residual, parameters):
        return (residual**2).sum(axis=1) + PENALTY * ((parameters - prediction) ** 2).sum(axis=1)

    parameters = prediction.copy()
    residual = residuals(parameters)
    cost = cost_of(residual, parameters)
    damping = np.full(len(parameters), 1e-2)
    step_size = 1e-4
    for _ in range(iterations):
        jacobian = np.stack([residuals(parameters + step_size * axis) - residual for axis in identity], axis=-1)
        jacobian = np.where(frozen[:, None, :], 0.0, jacobian / step_size)
        gradient = np.einsum("psn,ps->pn", jacobian, residual) + PENALTY * (parameters - prediction)
        hessian = np.matmul(np.swapaxes(jacobian, 1, 2), jacobian) + PENALTY * identity
        diagonal = np.einsum("pnn->pn", hessian)
        step = -np.linalg.solve(hessian + (damping[:, None] * diagonal)[:, :, None] * identity, gradient[..., None])
        step = np.where(frozen, 0.0, np.clip(step[..., 0], -0.3, 0.3))
        trial = parameters + step
        trial = np.clip(trial, LOWEST[: family.parameters], HIGHEST[: family.parameters])
        trial_residual = residuals(trial)
        trial_cost = cost_of(trial_residual, trial)
        better = trial_cost < cost
        parameters = np.where(better[:, None], trial, parameters)
        residual = np.where(better[:, None], trial_residual, residual)
        cost = np.where(better, trial_cost, cost)
        damping = np.where(better, 0.3 * damping, np.minimum(4.0 * damping, 1e3))
        if np.abs(step).max() < 1e-4:
            break
    return parameters


def _predict(parameters, i, j, last):
    """What the neighbors that are already fitted say about node (i, j); `last` is the roughest row."""
    if i == last and j == 0:
        return np.concatenate([[np.log(0.3), np.log(0.3)], np.zeros(parameters.shape[2] - 2)])
    if i == last:
        return 2.0 * parameters[i, j - 1] - parameters[i, j - 2] if j > 1 else parameters[i, 0]
    if j == 0:
        return 2.0 * parameters[i + 1, 0] - parameters[i + 2, 0] if i < last - 1 else parameters[i + 1, 0]
    return parameters[i + 1, j] + parameters[i, j - 1] - parameters[i + 1, j - 1]


def _search(family, nodes, prediction, symmetric):
    """Parameters (P, n) of a batch of nodes from their prediction; `symmetric` (P,) marks normal incidence."""
    prediction = prediction.copy()
    prediction[:, 2] = np.clip(prediction[:, 2], -MAX_BETA, 0.0)
    frozen = symmetric[:, None] & (np.arange(family.parameters) >= 2)
    prediction[frozen] = 0.0
    prediction = np.clip(prediction, LOWEST[: family.parameters], HIGHEST[: family.parameters])
    return _minimize(family, nodes, prediction, frozen)


def _limit_parameters(family, cosine, alpha):
    """Parameters (P, n) of A = B = C = 1 without tilt: what GGX tends to as alpha -> 0."""
    regularized = np.sqrt(cosine**2 + WARP_REGULARIZATION**2 * alpha**2)
    sine = np.sqrt(1.0 - cosine**2)
    parameters = np.zeros((len(alpha), family.parameters))
    parameters[:, 0] = -np.log(regularized**2 + sine**2)
    parameters[:, 2] = -np.arctan2(sine, regularized)
    return parameters


def fit(family: Family, size: int = 64, progress=None):
    """Fit one table of size x size nodes; returns the arrays and the node errors (size, size).

    `progress(fraction)` is called after every anti-diagonal.
    """
    curves, weights = fresnel_basis()
    roughness, theta = roughness_nodes(size), theta_nodes(size)
    # At roughness 0 the lobe is a delta; its limit is taken close by.
    roughness = np.concatenate([[0.25 * roughness[1]], roughness[1:]])
    cosine = np.maximum(np.cos(theta), GRAZING_COSINE)
    parameters = np.zeros((size, size, family.parameters))
    basis_size = 1 if family.kind == "ltc" else spherical_harmonics.coefficient_count(family.degree)
    coefficients = np.zeros((size, size, len(curves), basis_size))
    errors = np.zeros((size, size))
    for diagonal in range(2 * size - 1):
        nodes_at = [(size - 1 - k, diagonal - k) for k in range(size) if 0 <= diagonal - k < size]
        i, j = np.array(nodes_at).T
        nodes = _Nodes.at(cosine[j], roughness[i] ** 2, curves)
        prediction = np.stack([_predict(parameters, *node, size - 1) for node in nodes_at])
        found = _search(family, nodes, prediction, symmetric=j == 0)
        limit = _limit_parameters(family, cosine[j], roughness[i] ** 2)
        found = np.where((i == 0)[:, None], limit, found)
        isotropic = found.copy()
        isotropic[:, :2] = found[:, :2].mean(axis=1, keepdims=True)
        parameters[i, j] = np.where((j == 0)[:, None], isotropic, found)
        coefficients[i, j] = _project(family, nodes, parameters[i, j], slice(None))[0]
        errors[i, j] = _relative_error(family, nodes, parameters[i, j], coefficients[i, j, 0])
        if progress is not None:
            progress((diagonal + 1) / (2 * size - 1))
    arrays = {
        "warp": _stored_warp(parameters, roughness, cosine).astype(np.float32),
        "coefficients": coefficients.astype(np.float32),
        "fresnel_curves": curves,
        "fresnel_ior": TABULATED_IOR,
        "fresnel_weights": weights,
    }
    return arrays, errors


def _stored_warp(parameters, roughness, cosine):
    """A, B, C (and the tilt) of `lookup_table`; at normal incidence, where b = 0, B is extrapolated (it is even)."""
    alpha = (roughness**2)[:, None]
    regularized = np.sqrt(cosine**2 + WARP_REGULARIZATION**2 * alpha**2)
    sine = np.sqrt(1.0 - cosine**2)
    a = np.exp(-parameters[..., 0]) * np.cos(parameters[..., 2]) ** 2 / regularized**2
    b = np.empty_like(a)
    b[:, 1:] = -np.tan(parameters[:, 1:, 2]) * regularized[:, 1:] / sine[1:]
    b[:, 0] = 2.0 * b[:, 1] - b[:, 2]
    channels = [a, b, np.exp(-parameters[..., 1])]
    return np.stack(channels + [parameters[..., n] for n in range(3, parameters.shape[2])], axis=-1)


def write_table(path: Path, family: Family, arrays, errors) -> None:
    """Write the table with its metadata: the same arrays give the same bytes."""
    metadata = {
        "format_version": FORMAT_VERSION,
        "name": family.name,
        "family": family.kind,
        "degree": family.degree,
        "brdf": "GGX, height-correlated Smith masking-shadowing, alpha = roughness^2, times cosine",
        "axes": "rows: roughness, uniform in [0, 1]; columns: theta_o, uniform in 1 - sqrt(1 - theta_o / 90 deg)",
        "fresnel_curves": "1, (1 - c)^5, three optimized for dielectrics; c = cosine of the half angle",
        "node_error_mean": float(errors.mean()),
        "node_error_median": float(np.median(errors)),
        "command": f"python -m ltsh_addon tables fit {family.name}",
    }
    arrays = {**arrays, "node_errors": errors.astype(np.float32), "metadata": np.array(json.dumps(metadata))}
    temporary = path.with_name(path.name + ".part")
    with zipfile.ZipFile(temporary, "w", zipfile.ZIP_DEFLATED, compresslevel=9) as archive:
        for name, array in arrays.items():
            stream = io.BytesIO()
            np.lib.format.write_array(stream, np.asanyarray(array), allow_pickle=False)
            entry = zipfile.ZipInfo(f"{name}.npy", date_time=(1980, 1, 1, 0, 0, 0))
            entry.compress_type = zipfile.ZIP_DEFLATED
            archive.writestr(entry, stream.getvalue())
    os.replace(temporary, path)
