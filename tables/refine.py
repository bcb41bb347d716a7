"""The fit of the nodes of a table: first node by node (`walk`), then of all nodes together (`refine`).

First, for every node (roughness, theta_o), the warp minimizes the L2 error of the cosine-weighted BRDF over the upper
hemisphere; the coefficients are projected out (`projection`). The nodes are visited along anti-diagonals, from rough to
smooth and from normal to grazing incidence. Each starts from what its neighbors predict, and a small penalty on the
distance to the prediction keeps it in their basin.

The parameters of a node are log(a cos^2(beta) / (2 alpha)), log(c / (2 alpha)), beta, and tilt, for
M = [[a, 0, tan(beta)], [0, c, 0], [0, 0, 1]]. All of them tend to simple limits as alpha -> 0.

Then all nodes share the normal equations of the error between them.
The squared error of a point is a sum of four terms, all relative to the true lobe:

- the squared L2 error over the upper hemisphere; directions in which the fitted lobe is negative count
  1 + NEGATIVE_WEIGHT times;
- LIGHT_WEIGHT times the squared error of integrals over lights, which is what a renderer computes. The lights are soft
  windows of three widths, spread evenly over the hemisphere. An L2 norm alone would trade much of the tail for little
  at the peak, but a light is often seen in the tail alone;
- ALBEDO_WEIGHT times the squared error of the albedo;
- EXCESS_WEIGHT times the square of the excess of the negative mass, relative to the albedo, above NEGATIVE_SHARE.
"""

from dataclasses import dataclass

import numpy as np

from ltsh_addon.lobes.lookup_table import WARP_REGULARIZATION, warp_entries

from .projection import FLAT, Points, batches, project, warped_basis

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


# All nodes together:

# Errors below this are good enough: points count by 1 / max(error, ERROR_FLOOR).
ERROR_FLOOR = 2e-3
LIGHT_WEIGHT = 0.4
ALBEDO_WEIGHT = 9.0
NEGATIVE_WEIGHT = 2.0
NEGATIVE_SHARE = 0.008
EXCESS_WEIGHT = 50.0
WINDOWS = 40
WINDOW_WIDTHS = np.radians([8.0, 16.0, 28.0])


@dataclass(frozen=True)
class Linearization:
    """Normal equations of P points, each for the d values that are interpolated there, and their errors.

    `right` has one column per Fresnel curve. For curve 0, F = 1, it is the negative gradient; for the others, it is the
    projection of the whole target on the derivatives.
    """

    error: np.ndarray  # (P,) square root of the sum of the four terms
    matrices: np.ndarray | None  # (P, d, d)
    right: np.ndarray | None  # (P, d, F)

    @property
    def importance(self):
        """Weights (P,) that make a sum of squared errors act like the sum of the errors."""
        return 1.0 / np.maximum(self.error, ERROR_FLOOR)


def linearize(
    family, model, cells, nodes, curves=FLAT, *, derivatives=True, albedo_weight=ALBEDO_WEIGHT
) -> Linearization:
    """Linearization at `nodes` (R, T, n + size): the channels of the warp, then the coefficients for F = 1."""
    values = cells.interpolate(nodes)
    found = []
    for part in batches(len(values)):
        points = Points.at(
            model, cells.cosine[part], cells.roughness[part] ** 2, curves, albedo=cells.albedo[part, : len(curves)]
        )
        found.append(_linearize(family, points, values[part], derivatives, albedo_weight))
    return Linearization(*(None if part[0] is None else np.concatenate(part) for part in zip(*found, strict=True)))


def _linearize(family, points, values, derivatives, albedo_weight):
    warp, coefficients = values[:, : family.parameters], values[:, family.parameters :]
    basis = _basis(family, points, warp)
    lobe = np.einsum("psk,pk->ps", basis, coefficients)
    functionals, scales = _functionals(points)
    # What the lobe misses for F = 1, and the whole target of the other curves.
    targets = points.lobes.copy()
    targets[..., 0] -= lobe
    weights = points.quadrature * (1.0 + NEGATIVE_WEIGHT * (lobe < 0.0))
    weights /= (points.quadrature * points.lobes[..., 0] ** 2).sum(axis=1)[:, None]
    misses = np.matmul(functionals, targets)
    albedo_row = _albedo_row(family, points, warp, coefficients)
    albedo_misses = points.albedo / points.albedo[:, :1]
    albedo_misses[:, 0] -= np.einsum("pd,pd->p", albedo_row[:, family.parameters :], coefficients)
    squared = (weights * targets[..., 0] ** 2).sum(axis=1) + scales * (misses[..., 0] ** 2).sum(axis=1)
    excess_row = np.where(lobe < 0.0, points.quadrature, 0.0) / points.albedo[:, :1]
    excess = np.maximum(-(excess_row * lobe).sum(axis=1) - NEGATIVE_SHARE, 0.0)
    excess_row *= (excess > 0.0)[:, None]
    error = np.sqrt(squared + albedo_weight * albedo_misses[:, 0] ** 2 + EXCESS_WEIGHT * excess**2)
    if not derivatives:
        return error, None, None
    importance = 1.0 / np.maximum(error, ERROR_FLOOR)
    jacobian = np.concatenate([_warp_slopes(family, points, warp, coefficients, lobe), basis], axis=-1)
    matrices, right = _normal(jacobian, weights * importance[:, None], targets)
    scales = np.broadcast_to((scales * importance)[:, None], misses.shape[:2])
    rows = [(np.matmul(functionals, jacobian), scales, misses)]
    rows.append((albedo_row[:, None], (albedo_weight * importance)[:, None], albedo_misses[:, None]))
    if points.lobes.shape[2] == 1:
        slopes = np.matmul(excess_row[:, None], jacobian)
        rows.append((slopes, (EXCESS_WEIGHT * importance)[:, None], excess[:, None, None]))
    for row in rows:
        more = _normal(*row)
        matrices, right = matrices + more[0], right + more[1]
    return error, matrices, right


def _normal(jacobian, weights, targets):
    """J^T W J (P, d, d) and J^T W t (P, d, F) for J (P, S, d), diagonal W (P, S), t (P, S, F)."""
    transposed = np.swapaxes(jacobian * weights[..., None], 1, 2)
    return np.matmul(transposed, jacobian), np.matmul(transposed, targets)


def _tilt(family, warp):
    return warp[:, 3] if family.kind == "ltc" else np.zeros(len(warp))


def _basis(family, points, warp):
    entries = warp_entries(points.cosine, points.alpha, *warp.T[:3])
    return warped_basis(family, points.directions, entries, _tilt(family, warp))


def _warp_slopes(family, points, warp, coefficients, lobe):
    """Derivatives (P, S, n) of the lobe by the channels of the warp."""
    step = 1e-5
    moved = [_basis(family, points, warp + step * axis) for axis in np.eye(family.parameters)]
    return np.stack([(np.einsum("psk,pk->ps", basis, coefficients) - lobe) / step for basis in moved], axis=-1)


def _albedo_row(family, points, warp, coefficients):
    """Derivatives (P, n + size) of the relative albedo."""
    tilt = _tilt(family, warp)
    by_warp = np.zeros((len(warp), family.parameters))
    if family.kind == "ltc":
        by_warp[:, 3] = -0.5 * np.sin(tilt) * coefficients[:, 0]
    return np.concatenate([by_warp, family.basis_albedo(tilt)], axis=1) / points.albedo[:, :1]


def _functionals(points):
    """Rows (P, W, S) that integrate over soft lights, mirror-symmetric in y, and the scale (P,) of their squares."""
    k = np.arange(WINDOWS) + 0.5
    z, azimuth = 1.0 - k / WINDOWS, np.pi * (1.0 + np.sqrt(5.0)) * k
    radius = np.sqrt(1.0 - z * z)
    centers = np.stack([radius * np.cos(azimuth), radius * np.sin(azimuth), z], axis=-1)
    sharpness = 1.0 / np.resize(WINDOW_WIDTHS, WINDOWS)[:, None] ** 2
    mirrored = centers * np.array([1.0, -1.0, 1.0])
    directions = np.swapaxes(points.directions, 1, 2)
    # Windows in single precision suffice, because they weigh the lobe and its target alike.
    exponents = [((np.matmul(side, directions) - 1.0) * sharpness).astype(np.float32) for side in (centers, mirrored)]
    windows = (np.exp(exponents[0]) + np.exp(exponents[1])) * points.quadrature[:, None, :]
    seen = np.matmul(windows, points.lobes[..., :1])[..., 0]
    return windows, LIGHT_WEIGHT / (seen**2).sum(axis=1)


ITERATIONS = 3
FIRST_DAMPING = 1e-3
# End of conjugate gradients: SOLVED is the residual relative to the first one, MOST_STEPS the number of steps.
SOLVED, MOST_STEPS = 1e-6, 400


@dataclass(frozen=True)
class State:
    """State of the refinement, enough to resume it."""

    nodes: np.ndarray  # (R, T, n + size)
    damping: float = FIRST_DAMPING
    iteration: int = 0


def refine(family, model, cells, state: State, progress=None) -> np.ndarray:
    """Nodes (R, T, n + size), channels of the warp and coefficients, with the least mean error between them for F = 1.

    `progress(fraction, state)` is called after every iteration.
    """
    free = free_entries(family, model, cells.shape)
    here = linearize(family, model, cells, state.nodes) if state.iteration < ITERATIONS else None
    while state.iteration < ITERATIONS:
        change = damped_change(cells, here.matrices, here.right[..., 0], free, state.damping, tie_round_warp=True)
        trial = state.nodes + change
        there = linearize(family, model, cells, trial, derivatives=state.iteration + 1 < ITERATIONS)
        better = (here.importance * there.error**2).sum() < (here.importance * here.error**2).sum()
        damping = state.damping * (0.5 if better else 10.0)
        state = State(trial if better else state.nodes, damping, state.iteration + 1)
        here = there if better else here
        if progress is not None:
            progress(state.iteration / ITERATIONS, state)
    return state.nodes


def fresnel_coefficients(family, model, cells, nodes, limit, curves) -> np.ndarray:
    """Coefficients (R, T, F, size) for Fresnel curves (F, C), of which curve 0 is F = 1. They solve the same least
    squares problem with the warps of `nodes` held fixed. `limit` (R, T, F, size) has the rows that are fixed."""
    free = free_entries(family, model, cells.shape)[..., family.parameters :]
    here = linearize(family, model, cells, nodes, curves)
    matrices = here.matrices[:, family.parameters :, family.parameters :]
    coefficients = np.where(free[:, :, None], 0.0, limit)
    coefficients[:, :, 0] = nodes[..., family.parameters :]
    for curve in range(1, len(curves)):
        fixed = cells.interpolate(coefficients[:, :, curve])
        right = here.right[:, family.parameters :, curve] - np.matmul(matrices, fixed[..., None])[..., 0]
        coefficients[:, :, curve] += damped_change(cells, matrices, right, free, 1e-6)
    return coefficients


def with_exact_albedo(family, model, cells, nodes, coefficients, albedo) -> np.ndarray:
    """Coefficients (R, T, F, size) with which the nodes have `albedo` (R, T, F), changed where that costs least
    error."""
    free = free_entries(family, model, cells.shape)[..., family.parameters :]
    here = linearize(family, model, cells, nodes)
    blocks = cells.node_blocks(here.matrices[:, family.parameters :, family.parameters :])
    inverse = _inverse_of_free(blocks, 1e-6 * np.einsum("ijkk->ijk", blocks), free)
    tilt = nodes[..., 3].ravel() if family.kind == "ltc" else np.zeros(nodes[..., 0].size)
    row = family.basis_albedo(tilt).reshape(*nodes.shape[:2], -1)
    direction = np.matmul(inverse, row[..., None])[..., 0]
    scale = (row * direction).sum(axis=-1)[..., None]
    missing = albedo - (coefficients * row[:, :, None]).sum(axis=-1)
    share = np.divide(missing, scale, out=np.zeros_like(missing), where=scale > 0.0)
    return coefficients + share[..., None] * direction[:, :, None]


def free_entries(family, model, shape) -> np.ndarray:
    """Mask (R, T, n + size) of the entries of the nodes that may change."""
    free = np.ones((*shape, family.parameters + family.size), dtype=bool)
    free[:, 0, 3 : family.parameters] = False
    free[:, 0, family.parameters :] &= family.round
    if model.cosine_limit:
        free[0] = False
    return free


def damped_change(cells, matrices, right, free, damping, *, tie_round_warp=False):
    """The change (R, T, d) of the nodes that solves the damped normal equations, by conjugate gradients."""
    blocks = cells.node_blocks(matrices)
    diagonal = np.einsum("ijkk->ijk", blocks)
    shift = damping * diagonal + 1e-10 * diagonal.max(axis=2, keepdims=True)
    inverse = _inverse_of_free(blocks, shift, free)

    def precondition(values):
        return _admissible(np.matmul(inverse, values[..., None])[..., 0], free, tie_round_warp)

    residual = _admissible(cells.distribute(right), free, tie_round_warp)
    change, direction = np.zeros_like(residual), precondition(residual)
    size = (residual * direction).sum()
    enough = SOLVED**2 * size
    for _ in range(MOST_STEPS):
        if size <= enough:
            break
        bent = np.matmul(matrices, cells.interpolate(direction)[..., None])[..., 0]
        bent = _admissible(cells.distribute(bent) + shift * direction, free, tie_round_warp)
        length = size / (direction * bent).sum()
        change, residual = change + length * direction, residual - length * bent
        preconditioned = precondition(residual)
        previous, size = size, (residual * preconditioned).sum()
        direction = preconditioned + size / previous * direction
    return change


def _admissible(change, free, tie_round_warp):
    """The orthogonal projection of a change onto admissible ones. These keep fixed entries, and A = C for the warp at
    normal incidence."""
    change = np.where(free, change, 0.0)
    if tie_round_warp:
        change[:, 0, [0, 2]] = change[:, 0, [0, 2]].mean(axis=1, keepdims=True)
    return change


def _inverse_of_free(blocks, shift, free):
    """Inverses of the damped node blocks (R, T, d, d) restricted to the free entries; 0 elsewhere."""
    identity = np.eye(blocks.shape[-1])
    both = free[..., :, None] & free[..., None, :]
    damped = np.where(both, blocks + shift[..., None] * identity, identity * ~free[..., None])
    return np.linalg.inv(damped) * both
