"""Continuation over the table: a first fit, node by node.

For every node (roughness, theta_o), the warp minimizes the L2 error of the cosine-weighted BRDF over the upper
hemisphere; the coefficients are projected out (`projection`). The nodes are visited along anti-diagonals, from rough to
smooth and from normal to grazing incidence. Each starts from what its neighbors predict, and a small penalty on the
distance to the prediction keeps it in their basin.

The parameters of a node are log(a cos^2(beta) / (2 alpha)), log(c / (2 alpha)), beta, and tilt, for
M = [[a, 0, tan(beta)], [0, c, 0], [0, 0, 1]]. All of them tend to simple limits as alpha -> 0.
"""

from __future__ import annotations

import numpy as np

from ltsh_addon.lobes.lookup_table import WARP_REGULARIZATION

from .projection import FLAT, Points, project

PENALTY = 1e-3
MAX_BETA = 1.5705
# Bounds of the parameters. Where the horizon cuts the lobe on the scale of alpha, free ones would run away for no gain.
LOWEST = np.array([-2.0, -2.5, -MAX_BETA, -1.5])
HIGHEST = np.array([6.0, 2.0, 0.5, 1.5])
# The same for the warp of a second lobe, either sign.
MOST_OF_SECOND = np.array([4.0, 30.0, 4.0])


def bounds(family):
    """The least and the greatest values (n,) of the warp parameters."""
    if family.second is None:
        return LOWEST[: family.parameters], HIGHEST[: family.parameters]
    return np.concatenate([LOWEST[:3], -MOST_OF_SECOND]), np.concatenate([HIGHEST[:3], MOST_OF_SECOND])


def minimize(family, points, start, frozen, *, penalty=PENALTY, iterations=14):
    """Warp parameters (P, n) found by Levenberg-Marquardt from `start`, for all points of the batch at once.

    `penalty` times the squared distance to `start` is added to the squared relative error. Parameters that are `frozen`
    (P, n) do not change.
    """
    identity = np.eye(family.parameters)
    lowest, highest = bounds(family)

    def residuals(parameters):
        return project(family, points, *warp_of(family, points, parameters))[1][..., 0]

    def cost_of(residual, parameters):
        return (residual**2).sum(axis=1) + penalty * ((parameters - start) ** 2).sum(axis=1)

    parameters = start.copy()
    residual = residuals(parameters)
    cost = cost_of(residual, parameters)
    damping = np.full(len(parameters), 1e-2)
    step_size = 1e-4
    for _ in range(iterations):
        jacobian = np.stack([residuals(parameters + step_size * axis) - residual for axis in identity], axis=-1)
        jacobian = np.where(frozen[:, None, :], 0.0, jacobian / step_size)
        gradient = np.einsum("psn,ps->pn", jacobian, residual) + penalty * (parameters - start)
        hessian = np.matmul(np.swapaxes(jacobian, 1, 2), jacobian) + (penalty + 1e-12) * identity
        diagonal = np.einsum("pnn->pn", hessian)
        step = -np.linalg.solve(hessian + (damping[:, None] * diagonal)[:, :, None] * identity, gradient[..., None])
        step = np.where(frozen, 0.0, np.clip(step[..., 0], -0.3, 0.3))
        trial = np.clip(parameters + step, lowest, highest)
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


def warp_of(family, points, parameters):
    """Entries (xx, xz, yy, zz) of W and the tilt, (P,) each, for parameters (P, n). For sums of two lobes, the
    parameters (P, 3) of the second one replace the tilt."""
    xx = np.exp(-parameters[:, 0]) * np.cos(parameters[:, 2]) ** 2
    entries = (xx, -xx * np.tan(parameters[:, 2]), np.exp(-parameters[:, 1]), 2.0 * points.alpha)
    if family.second is not None:
        return entries, parameters[:, 3:]
    return entries, parameters[:, 3] if family.kind == "ltc" else np.zeros(len(parameters))


def walk(family, model, roughness, cosine, progress=None, state=None):
    """Warp parameters (R, T, n) of a table with nodes at roughness (R,), increasing, and cosine (T,), decreasing.

    `progress(fraction, state)` is called after every anti-diagonal. A later call with this `state` resumes from there.
    """
    rows, columns = len(roughness), len(cosine)
    parameters, first = state or (np.zeros((rows, columns, family.parameters)), 0)
    for diagonal in range(first, rows + columns - 1):
        visited = [(rows - 1 - k, diagonal - k) for k in range(rows) if 0 <= diagonal - k < columns]
        i, j = np.array(visited).T
        points = Points.at(model, cosine[j], roughness[i] ** 2, FLAT)
        prediction = np.stack([_predict(parameters, *node, rows - 1) for node in visited])
        found = _search(family, points, prediction, symmetric=j == 0)
        if model.cosine_limit:
            found = np.where((i == 0)[:, None], _limit(family, cosine[j], roughness[i] ** 2), found)
        isotropic = found.copy()
        isotropic[:, :2] = found[:, :2].mean(axis=1, keepdims=True)
        parameters[i, j] = np.where((j == 0)[:, None], isotropic, found)
        if progress is not None:
            progress((diagonal + 1) / (rows + columns - 1), (parameters, diagonal + 1))
    return parameters


def _predict(parameters, i, j, last):
    """Prediction for node (i, j) from the neighbors that are already fitted; `last` is the roughest row."""
    if i == last and j == 0:
        return np.concatenate([[np.log(0.3), np.log(0.3)], np.zeros(parameters.shape[2] - 2)])
    if i == last:
        return 2.0 * parameters[i, j - 1] - parameters[i, j - 2] if j > 1 else parameters[i, 0]
    if j == 0:
        return 2.0 * parameters[i + 1, 0] - parameters[i + 2, 0] if i < last - 1 else parameters[i + 1, 0]
    return parameters[i + 1, j] + parameters[i, j - 1] - parameters[i + 1, j - 1]


def _search(family, points, prediction, symmetric):
    """Parameters (P, n) of a batch of nodes from their prediction; `symmetric` (P,) marks normal incidence."""
    prediction = prediction.copy()
    prediction[:, 2] = np.clip(prediction[:, 2], -MAX_BETA, 0.0)
    frozen = symmetric[:, None] & (np.arange(family.parameters) >= 2)
    prediction[frozen] = 0.0
    prediction = np.clip(prediction, *bounds(family))
    return minimize(family, points, prediction, frozen)


def _limit(family, cosine, alpha):
    """Parameters (P, n) of A = B = C = 1 without tilt, the limit of GGX as alpha -> 0."""
    sine = np.sqrt(1.0 - cosine**2)
    regularized = _regularized(cosine, alpha)
    parameters = np.zeros((len(alpha), family.parameters))
    parameters[:, 0] = -np.log(regularized**2 + sine**2)
    parameters[:, 2] = -np.arctan2(sine, regularized)
    return parameters


def _regularized(cosine, alpha):
    return np.sqrt(cosine**2 + WARP_REGULARIZATION**2 * alpha**2 * (1.0 - cosine**2))


def stored_warp(parameters, roughness, cosine):
    """Channels (R, T, n) A, B, C (and the tilt) of `lookup_table` for parameters (R, T, n).

    At normal incidence b = 0; there B is extrapolated as an even function of theta_o.
    """
    sine = np.sqrt(1.0 - cosine**2)
    regularized = _regularized(cosine, (roughness**2)[:, None])
    a = np.exp(-parameters[..., 0]) * np.cos(parameters[..., 2]) ** 2 / regularized**2
    b = np.empty_like(a)
    b[:, 1:] = -np.tan(parameters[:, 1:, 2]) * regularized[:, 1:] / sine[1:]
    b[:, 0] = 2.0 * b[:, 1] - b[:, 2]
    channels = [a, b, np.exp(-parameters[..., 1])]
    return np.stack(channels + [parameters[..., n] for n in range(3, parameters.shape[2])], axis=-1)
