"""The pack: LTC, LTSH 2, sheen, LTSH 4 and LTSH 4c in one small array texture of half floats, for F = 1 and (1 - c)^5.

The shipped tables have 64 x 64 nodes with bilinear interpolation. The pack has 16 x 16 coefficients of cubic B-splines,
uniform over the same two axes. A spline is smooth everywhere, and so few coefficients suffice.

`python -m tables pack` fits it, starting from the splines closest to the shipped tables: Gauss-Newton on all
coefficients together, for the same sum of errors as `refine.refine`, at POINTS x POINTS points. The result is
tables/pack.dds. Channel c of a table is channel c % 4 of layer FIRST_LAYERS[name] + c // 4. `sheen.py` fits sheen.
"""

from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
from numpy.polynomial import polynomial

from ltsh_addon.lobes import lookup_table
from ltsh_addon.lobes.lookup_table import Lobe, LookupTable, warp_entries
from ltsh_addon.shading import load_table

SIZE = 16  # coefficients along each axis
CURVES = 2
POINTS = 40
STEPS = 20
FIRST_DAMPING = 0.1
NEARLY_EXACT = 1e3  # weight of the albedo in the end, as `refine.ALBEDO_WEIGHT`
PATH = Path(__file__).with_name("pack.dds")
# The first layer of each table, and how many layers the three textures have.
FIRST_LAYERS = {"ltc": 0, "ltsh2": 2, "sheen": 6, "ltsh4": 7, "ltsh4c": 16}
LAYERS = {"pack_2": 7, "pack_4": 16, "pack_4c": 26}
TABLES = [name for name in FIRST_LAYERS if name != "sheen"]
# The four pieces of the cubic B-spline on a unit interval: coefficients of 1, t, t^2, t^3 by tap.
PIECES = np.array([[1.0, -3.0, 3.0, -1.0], [4.0, 0.0, -6.0, 3.0], [1.0, 3.0, 3.0, -3.0], [0.0, 0.0, 0.0, 1.0]]) / 6.0


def taps(position: np.ndarray, size: int = SIZE) -> tuple[np.ndarray, np.ndarray]:
    """The first of four coefficients (P,) along an axis at positions (P,) in [0, 1], and the weights (P, 4)."""
    scaled = np.clip(position, 0.0, 1.0) * (size - 3)
    first = np.minimum(scaled.astype(np.intp), size - 4)
    return first, polynomial.polyval(scaled - first, PIECES.T).T


def matrix(positions: np.ndarray, size: int = SIZE) -> np.ndarray:
    """(P, size): the values of a spline at positions (P,) from its coefficients."""
    first, weights = taps(positions, size)
    rows = np.zeros((len(positions), size))
    np.put_along_axis(rows, first[:, None] + np.arange(4), weights, axis=1)
    return rows


def splines_at(cosine: np.ndarray, roughness: np.ndarray, *coefficients: np.ndarray):
    """Yields the values (..., P) of splines with coefficients (SIZE, SIZE, ...), at cosines of theta_o and roughness,
    (P,) in [0, 1]."""
    theta = 1.0 - np.sqrt(np.maximum(1.0 - np.arccos(cosine) * (2.0 / np.pi), 0.0))
    (row, down), (column, right) = taps(roughness), taps(theta)
    rows, columns = row[:, None, None] + np.arange(4)[:, None], column[:, None, None] + np.arange(4)
    for values in coefficients:
        yield np.einsum("pi,pj,pij...->...p", down, right, values[rows, columns].astype(float), optimize=True)


class SplineTable(LookupTable):
    """A table whose `warp` and `coefficients` are B-spline coefficients."""

    def albedos(self, cos_theta_o: np.ndarray, roughness: np.ndarray) -> np.ndarray:
        return self.lookup(cos_theta_o, roughness).albedo().astype(np.float32)

    def lookup(self, cos_theta_o: np.ndarray, roughness: np.ndarray, curves: int | None = None) -> Lobe:
        cosine, roughness = np.clip(cos_theta_o, 0.0, 1.0), np.clip(roughness, 0.0, 1.0)
        warp, coefficients = splines_at(cosine, roughness, self.warp, self.coefficients[:, :, :curves])
        alpha = np.maximum(roughness * roughness, lookup_table.MIN_ALPHA)
        entries = warp_entries(cosine, alpha, *warp[:3])
        return Lobe(*entries, tilt=warp[3] if len(warp) == 4 else None, coefficients=coefficients)


def with_two_curves(table: LookupTable) -> LookupTable:
    """The table for F = 1 and (1 - c)^5 alone. Dielectrics are Schlick's there."""
    normal = ((table.fresnel_ior - 1.0) / (table.fresnel_ior + 1.0)) ** 2
    names = table.metadata.get("fresnel_curve_names", [])[:CURVES]
    return replace(
        table,
        coefficients=table.coefficients[:, :, :CURVES],
        fresnel_curves=table.fresnel_curves[:CURVES],
        fresnel_weights=np.stack([normal, 1.0 - normal], axis=1),
        average_albedo=table.average_albedo[:, :CURVES],
        metadata={**table.metadata, "fresnel_curve_names": names} if names else table.metadata,
    )


@cache
def load_pack() -> dict[str, SplineTable]:
    """The tables of the pack by name; `sheen.load_sheen` has sheen."""
    return {name: _table(load_table(name), layers()[FIRST_LAYERS[name] :]) for name in TABLES}


def layers() -> np.ndarray:
    """The layers (N, SIZE, SIZE, 4) of the pack, float16."""
    return np.frombuffer(PATH.read_bytes(), "<f2", offset=148).reshape(-1, SIZE, SIZE, 4)


def _table(shipped, texture) -> SplineTable:
    shipped = with_two_curves(shipped)
    parameters, count = shipped.warp.shape[2], shipped.coefficients.shape[3]
    used = parameters + CURVES * count
    channels = np.moveaxis(texture, 0, 2).reshape(SIZE, SIZE, -1)[..., :used].astype(np.float32)
    nodes = np.linspace(0.0, 1.0, SIZE), np.linspace(0.0, 1.0, len(shipped.average_albedo))
    average = np.stack([np.interp(*nodes, column) for column in shipped.average_albedo.T], axis=1)
    fields = {name: getattr(shipped, name) for name in LookupTable.__dataclass_fields__}
    return SplineTable(**{
        **fields,
        "warp": channels[..., :parameters],
        "coefficients": channels[..., parameters:].reshape(SIZE, SIZE, CURVES, count),
        "average_albedo": average,
    })  # fmt: skip


def pack_layers(channels: dict[str, np.ndarray]) -> np.ndarray:
    """Layers (N, SIZE, SIZE, 4) float16 of the channels (SIZE, SIZE, C) of each table and of sheen."""
    texture = np.zeros((LAYERS["pack_4c"], SIZE, SIZE, 4), np.float16)
    for name, first in FIRST_LAYERS.items():
        for channel in range(channels[name].shape[2]):
            texture[first + channel // 4, :, :, channel % 4] = channels[name][..., channel]
    return texture


# The fit:


class SplineCells:
    """Points of the fit, P = POINTS^2, with the methods of `projection.Cells`."""

    def __init__(self, model, lowest_cosine, curves):
        from scipy.sparse import csr_matrix, kron

        from .projection import batches, directional_albedo

        positions = (np.arange(POINTS) + 0.5) / POINTS
        axis = csr_matrix(matrix(positions))
        self._matrix = csr_matrix(kron(axis, axis))
        self._transposed = csr_matrix(self._matrix.T)
        self._squared = self._transposed.power(2)
        grids = np.meshgrid(positions, lookup_table.theta_at(positions), indexing="ij")
        self.shape, (self.roughness, theta) = (SIZE, SIZE), (grid.ravel() for grid in grids)
        self.cosine = np.maximum(np.cos(theta), lowest_cosine)
        albedo = [
            directional_albedo(model, self.cosine[part], self.roughness[part] ** 2, curves, (48, 64))
            for part in batches(len(theta))
        ]
        self.albedo = np.concatenate(albedo)

    def interpolate(self, nodes):
        return self._matrix @ nodes.reshape(-1, nodes.shape[-1])

    def distribute(self, values):
        return (self._transposed @ values).reshape(*self.shape, -1)

    def node_blocks(self, matrices):
        return (self._squared @ matrices.reshape(len(matrices), -1)).reshape(*self.shape, *matrices.shape[1:])


def closest(table: LookupTable) -> np.ndarray:
    """Coefficients (SIZE, SIZE, n + K) of the splines closest to a table's nodes: its warp, then F = 1."""
    values = np.concatenate([table.warp, table.coefficients[:, :, 0]], axis=2).astype(float)
    rows, columns = (np.linalg.pinv(matrix(np.linspace(0.0, 1.0, count))) for count in values.shape[:2])
    return np.einsum("ai,bj,ijc->abc", rows, columns, values, optimize=True)


def fit_table(name: str, progress=lambda text: None) -> np.ndarray:
    """Channels (SIZE, SIZE, C) of a table of the pack: the warp, then the coefficients of each curve."""
    from . import refine
    from .families import GGX, family_named
    from .fit import GRAZING_COSINE
    from .projection import fresnel_basis

    family = family_named(name)
    cells = SplineCells(GGX, GRAZING_COSINE, fresnel_basis()[0][:CURVES])
    nodes, damping = closest(load_table(name)), FIRST_DAMPING
    free = np.ones(nodes.shape, dtype=bool)
    here = refine.linearize(family, GGX, cells, nodes)
    for step in range(STEPS):
        trial = nodes + refine.damped_change(cells, here.matrices, here.right[..., 0], free, damping)
        there = refine.linearize(family, GGX, cells, trial)
        better = (here.importance * there.error**2).sum() < (here.importance * here.error**2).sum()
        damping *= 0.4 if better else 4.0
        if better:
            nodes, here = trial, there
        progress(f"{name}: step {step + 1} of {STEPS}, mean error {here.error.mean():.5f}")
    return with_curves(family, cells, nodes)


def with_curves(family, cells, nodes) -> np.ndarray:
    """Channels of a table from the warp and the coefficients for F = 1: under this warp, the coefficients of each curve
    are solved anew, so that the albedo is nearly exact."""
    from . import refine
    from .families import GGX
    from .projection import fresnel_basis

    parameters, curves = family.parameters, fresnel_basis()[0][:CURVES]
    here = refine.linearize(family, GGX, cells, nodes, curves, albedo_weight=NEARLY_EXACT)
    matrices, right = here.matrices[:, parameters:, parameters:], here.right[:, parameters:]
    free = np.ones(nodes[..., parameters:].shape, dtype=bool)
    changes = [refine.damped_change(cells, matrices, right[..., curve], free, 1e-6) for curve in range(CURVES)]
    return np.concatenate([nodes[..., :parameters], nodes[..., parameters:] + changes[0], *changes[1:]], axis=2)
