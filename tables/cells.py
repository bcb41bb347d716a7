"""The cells of a bilinear lookup: what interpolation does between the nodes, and its transpose."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ltsh_addon.shading.lookup_table import theta_at

from .projection import directional_albedo

# Positions of the two Gauss points of a cell along each axis
GAUSS = np.array([0.5 - 0.5 / np.sqrt(3.0), 0.5 + 0.5 / np.sqrt(3.0)])
# Points that are worked on at a time
BATCH = 126


@dataclass(frozen=True)
class Cells:
    """The 2 x 2 Gauss points of all cells of a table of R x T nodes: arrays of P = 4 (R - 1)(T - 1)."""

    shape: tuple[int, int]
    roughness: np.ndarray  # (P,)
    cosine: np.ndarray  # (P,)
    albedo: np.ndarray  # (P, F)

    @classmethod
    def of(cls, model, shape, lowest_cosine, curves):
        """Cells of a table of `shape` for a BRDF and Fresnel curves (F, C); cosines are at least `lowest_cosine`."""
        positions = [((np.arange(count - 1)[:, None] + GAUSS) / (count - 1)).ravel() for count in shape]
        roughness, theta = (grid.ravel() for grid in np.meshgrid(positions[0], theta_at(positions[1]), indexing="ij"))
        cosine = np.maximum(np.cos(theta), lowest_cosine)
        albedo = [
            directional_albedo(model, cosine[part], roughness[part] ** 2, curves, (48, 64))
            for part in batches(len(cosine))
        ]
        return cls(shape, roughness, cosine, np.concatenate(albedo))

    def interpolate(self, nodes):
        """Values (P, d) at the Gauss points of node values (R, T, d)."""
        rows = np.stack([nodes[:-1] * (1 - t) + nodes[1:] * t for t in GAUSS], axis=1)
        rows = rows.reshape(-1, *nodes.shape[1:])
        columns = np.stack([rows[:, :-1] * (1 - t) + rows[:, 1:] * t for t in GAUSS], axis=2)
        return columns.reshape(-1, nodes.shape[2])

    def distribute(self, values):
        """The transpose of `interpolate`: (P, d) -> (R, T, d)."""
        rows, columns = self.shape
        values = values.reshape(2 * (rows - 1), columns - 1, 2, -1)
        spread = np.zeros((2 * (rows - 1), columns, values.shape[-1]))
        result = np.zeros((rows, columns, values.shape[-1]))
        for k, t in enumerate(GAUSS):
            spread[:, :-1] += values[:, :, k] * (1 - t)
            spread[:, 1:] += values[:, :, k] * t
        spread = spread.reshape(rows - 1, 2, columns, -1)
        for k, t in enumerate(GAUSS):
            result[:-1] += spread[:, k] * (1 - t)
            result[1:] += spread[:, k] * t
        return result

    def node_blocks(self, matrices):
        """Diagonal blocks (R, T, d, d) of the nodes in the normal matrix whose blocks at the points are (P, d, d)."""
        rows, columns = self.shape
        size = matrices.shape[-1]
        matrices = matrices.reshape(rows - 1, 2, columns - 1, 2, size, size)
        blocks = np.zeros((rows, columns, size, size))
        for i in (0, 1):
            for j in (0, 1):
                for k, s in enumerate(GAUSS):
                    for m, t in enumerate(GAUSS):
                        weight = (s if i else 1 - s) * (t if j else 1 - t)
                        blocks[i : rows - 1 + i, j : columns - 1 + j] += weight**2 * matrices[:, k, :, m]
        return blocks


def batches(count):
    """Slices of at most BATCH of `count` points."""
    return [slice(start, start + BATCH) for start in range(0, count, BATCH)]
