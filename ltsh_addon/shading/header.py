"""The shader text that the viewport and the headers for other engines share.

The text is in `glsl/`: core.h is the same for all tables. This module reads it and writes the lines that depend on a
table's numbers and degree. `tables/header.py` makes headers of it.
"""

import re
from collections.abc import Mapping
from functools import cache
from pathlib import Path

import numpy as np

from ..emitters import tails
from ..lobes import edge_integrals, lookup_table
from ..lobes.lookup_table import LookupTable

# Raise this when a function of core.h changes: headers of different versions then refuse to be included together.
CORE_VERSION = 8
_HALF_ARC_NODES = 16


@cache
def source_text(path: Path) -> str:
    """The text of a file, read once."""
    return path.read_text(encoding="ascii")


def filled(text: str, values: Mapping[str, object]) -> str:
    """`text` with each name, written @NAME@, replaced by its value. Raises KeyError if a name has no value."""
    return re.sub(r"@(\w+)@", lambda match: str(values[match[1]]), text)


def float_literal(value) -> str:
    """The shortest literal that is exactly `value` rounded to float32."""
    return f"{np.float32(value)!s}f"


def core_text() -> str:
    """The core: language layer, types, vectors, frames, polygons, edges, cells and warps. All names begin with
    ltsh_."""
    psi = [float_literal(value) for value in edge_integrals.arc_polynomial("psi", edge_integrals.SINGLE_PSI_DEGREE)]
    values = {
        "VERSION": CORE_VERSION,
        "PSI_HIGHEST": psi[0],
        "PSI": "\n".join(f"    psi = psi * kappa + {value};".replace("+ -", "- ") for value in psi[1:]),
        "TINY_SHIFT": float_literal(np.finfo(np.float32).eps ** 2),
        "REGULARIZATION": float_literal(lookup_table.WARP_REGULARIZATION**2),
        "MIN_ALPHA": float_literal(lookup_table.MIN_ALPHA),
        "TWO_OVER_PI": float_literal(2.0 / np.pi),
        "ONE_OVER_PI": float_literal(1.0 / np.pi),
        "FOUR_PI": float_literal(4.0 * np.pi),
        "NEAR_SQUARED": float_literal(tails.NEAR_RADII**2),
        "ONE_THIRD": float_literal(1.0 / 3.0),
        "TAIL_SLACK": float_literal(tails.SLACK),
        "ARC_NODES": "\n".join(_arc_node_lines()),
    }
    return filled(source_text(Path(__file__).with_name("glsl") / "core.h"), values)


def table_sizes(table: LookupTable) -> dict[str, int]:
    """The sizes of a table, by their names in C and GLSL."""
    rows, columns, parameters = table.warp.shape
    curves, count = table.coefficients.shape[2:]
    return {"ROWS": rows, "COLUMNS": columns, "PARAMETERS": parameters, "CURVES": curves, "COEFFICIENTS": count}


def definitions(values: Mapping[str, object], prefix: str = "LTSH") -> str:
    """Lines that define the macros `prefix`_name."""
    return "".join(f"#define {prefix}_{name} {value}\n" for name, value in values.items())


def _arc_node_lines():
    """Statements that add the nodes. Gauss-Legendre nodes come in pairs of opposite sign."""
    nodes, weights = np.polynomial.legendre.leggauss(_HALF_ARC_NODES)
    for node, weight in zip(nodes, weights, strict=True):
        if node > 0.0:
            share = f"{float_literal(node)} * half_angle, {float_literal(0.5 * weight)}"
            yield f"    sum += ltsh_arc_pair(k, middle, across, {share});"


def moment_lines(degree: int):
    """Statements that add an edge to all moments except the solid angle, in the order of `edge_integrals.moments`."""
    for k in range(degree):
        for j, (u_x, u_z) in enumerate(edge_integrals.RIDGE_DIRECTIONS[: k + 2]):
            row = 1 + k * (k + 3) // 2 + j
            yield f"moments.values[{row}] += ltsh_edge_moment(edge, {u_x}f, {u_z}f, {k});"


def bend_literals(table) -> str:
    """The numbers of a table's bend, as arguments of ltsh_bent."""
    return ", ".join(float_literal(entry) for entry in table.bend)


def bent_factor(table, times: float) -> str:
    """`times` the factor of a bend's functions: these are the factor times v_x and v_z over |v|^4, v = ltsh_bent(w)."""
    xx, _, yy = table.bend
    return float_literal(times * xx * yy / np.pi)


def bent_moment_lines(table):
    """Statements that add the edge `leaning` of the bent polygon to the last two moments."""
    count = table.coefficients.shape[3]
    for row, axis in ((count - 2, "x"), (count - 1, "z")):
        yield f"moments.values[{row}] += leaning.normal.{axis} * leaning.phi;"
