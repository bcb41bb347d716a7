"""Refinement of a whole table: what counts is the error of the interpolated lobe, between the nodes.

All nodes move together, warp and coefficients, to minimize the sum of the errors (`linearization`) at 2 x 2 Gauss
points of every cell of the lookup: Gauss-Newton with Levenberg's damping. The normal equations couple neighboring nodes
only; they are solved by conjugate gradients with the nodes' own blocks as the preconditioner (block Jacobi; Saad 2003,
"Iterative Methods for Sparse Linear Systems", section 10.2).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from .linearization import linearize

ITERATIONS = 3
FIRST_DAMPING = 1e-3


@dataclass(frozen=True)
class State:
    """Where the refinement stands: enough to go on from there."""

    nodes: np.ndarray  # (R, T, n + size)
    damping: float = FIRST_DAMPING
    iteration: int = 0


def refine(family, model, cells, state: State, progress=None) -> np.ndarray:
    """Nodes (R, T, n + size), channels of the warp and coefficients, of least mean error between them, for F = 1.

    `progress(fraction, state)` is called after every iteration.
    """
    free = free_entries(family, model, cells.shape)
    here = linearize(family, model, cells, state.nodes) if state.iteration < ITERATIONS else None
    while state.iteration < ITERATIONS:
        change = _solve(cells, here.matrices, here.right[..., 0], free, state.damping, tie_round_warp=True)
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
    """Coefficients (R, T, F, size) for Fresnel curves (F, C), curve 0 being F = 1: the same least squares problem with
    the warps of `nodes` held. `limit` (R, T, F, size) has the rows that are fixed."""
    free = free_entries(family, model, cells.shape)[..., family.parameters :]
    here = linearize(family, model, cells, nodes, curves)
    matrices = here.matrices[:, family.parameters :, family.parameters :]
    coefficients = np.where(free[:, :, None], 0.0, limit)
    coefficients[:, :, 0] = nodes[..., family.parameters :]
    for curve in range(1, len(curves)):
        fixed = cells.interpolate(coefficients[:, :, curve])
        right = here.right[:, family.parameters :, curve] - np.matmul(matrices, fixed[..., None])[..., 0]
        coefficients[:, :, curve] += _solve(cells, matrices, right, free, 1e-6)
    return coefficients


def with_exact_albedo(family, model, cells, nodes, coefficients, albedo) -> np.ndarray:
    """Coefficients (R, T, F, size), moved as little as the error allows, so that the nodes have `albedo` (R, T, F)."""
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
    """(R, T, n + size) which entries of the nodes may move."""
    free = np.ones((*shape, family.parameters + family.size), dtype=bool)
    free[:, 0, 3 : family.parameters] = False
    free[:, 0, family.parameters :] &= family.round
    if model.cosine_limit:
        free[0] = False
    return free


def _solve(cells, matrices, right, free, damping, *, tie_round_warp=False, tolerance=1e-6, most=400):
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
    enough = tolerance**2 * size
    for _ in range(most):
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
    """The orthogonal projection of a change to those that keep fixed entries and, for the warp at normal incidence,
    A = C."""
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
