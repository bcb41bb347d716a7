"""A lookup table as one header that C99, C++ and GLSL 3.30 can include: constants, data, lookup, lobes, integrals.

All numbers of a table stand in one flat array: the nodes (roughness slowest, then theta_o, then channel: warp, then the
coefficients of curve 0, 1, ...), then the Fresnel curves, their weights for dielectrics and the average albedos. The
functions read it through one macro, so that a shader can take it from a buffer or a texture.
"""

from __future__ import annotations

import numpy as np

from ..lookup_table import LookupTable
from .edges import edge_functions
from .geometry import GEOMETRY
from .literals import float_literal
from .lobes import lobe_functions
from .lookup import LOOKUP

# Raise it when a shared function changes: headers of different versions refuse to be included together.
SHARED_VERSION = 3
_VALUES_PER_LINE = 8


def data_blocks(table: LookupTable) -> dict[str, np.ndarray]:
    """The parts of the data array in order, float32 (), by the name of the macro that holds their offset."""
    nodes = table.warp.shape[0] * table.warp.shape[1]
    blocks = {
        "NODES": np.concatenate([table.warp.reshape(nodes, -1), table.coefficients.reshape(nodes, -1)], axis=1),
        "IOR": table.fresnel_ior,
        "WEIGHTS": table.fresnel_weights,
        "FRESNEL": table.fresnel_curves,
        "AVERAGE_ALBEDO": table.average_albedo,
    }
    return {name: np.asarray(block, dtype=np.float32).ravel() for name, block in blocks.items()}


def header_text(table: LookupTable, prefix: str, about: str) -> str:
    """The header; `prefix` begins every name of its own, `about` are the lines of its first comment."""
    blocks = data_blocks(table)
    text = "\n".join([_TOP, shared_text(), _constants(table, blocks), LOOKUP, lobe_functions(table), _data(blocks)])
    plain = about.encode("ascii", "backslashreplace").decode("ascii").replace("*/", "* /").replace("/*", "/ *")
    text = text.replace("@ABOUT@", "\n   ".join(plain.splitlines()))
    return text.replace("@prefix@", prefix).replace("@PREFIX@", prefix.upper())


def shared_text() -> str:
    """What does not depend on the table: the language layer, types, vectors, frames, polygons, edges, cells, warps."""
    return "\n".join([GEOMETRY, edge_functions(), _SHARED_END]).replace("@VERSION@", str(SHARED_VERSION))


def _constants(table, blocks) -> str:
    rows, columns, parameters = table.warp.shape
    curves, count = table.coefficients.shape[2:]
    values = {
        "ROWS": rows,
        "COLUMNS": columns,
        "PARAMETERS": parameters,
        "CURVES": curves,
        "COEFFICIENTS": count,
        "CHANNELS": parameters + curves * count,
        "IOR_COUNT": len(table.fresnel_ior),
        "COSINE_COUNT": table.fresnel_curves.shape[1],
    }
    offset = 0
    for name, block in blocks.items():
        values[f"{name}_OFFSET"] = offset
        offset += len(block)
    values["DATA_COUNT"] = offset
    return "\n".join(f"#define @PREFIX@_{name} {value}" for name, value in values.items()) + "\n"


def _data(blocks) -> str:
    lines = []
    for name, block in blocks.items():
        lines.append(f"    /* {name} */")
        literals = [float_literal(value) for value in block]
        lines += [
            f"    {', '.join(literals[start : start + _VALUES_PER_LINE])},"
            for start in range(0, len(literals), _VALUES_PER_LINE)
        ]
    return _DATA.replace("@VALUES@", "\n".join(lines))


_TOP = """\
/* @ABOUT@ */
#ifndef @PREFIX@_TABLE
#define @PREFIX@_TABLE 1

#if !defined(LTSH_GLSL) && (defined(GL_core_profile) || defined(GL_compatibility_profile) || defined(GL_ES))
#define LTSH_GLSL 1
#endif
#if defined(LTSH_GLSL) && !defined(@PREFIX@_DATA)
#error define @PREFIX@_DATA(index), which fetches one float of the data, before this header is included
#endif
"""

_SHARED_END = """\
#elif LTSH_SHARED != @VERSION@
#error headers of different versions of ltsh tables export are included together
#endif
"""

_DATA = """\
/* A GLSL source may end here, with the #endif of the last line: what follows is for C and C++ only. */
#ifdef @PREFIX@_DATA_FOLLOWS
static const float @prefix@_data[@PREFIX@_DATA_COUNT] = {
@VALUES@
};

LTSH_FUNCTION float @prefix@_data_at(int index) { return @prefix@_data[index]; }
#endif
#endif
"""
