"""GLSL of the lighting pass: reads a G-buffer, lights and a table, writes reflected radiance.

What does not depend on Blender is the text of the exported headers (`table_header`): frames, cells, warps, edges.
Formulas and their sources stand in `shading`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ...shading import edge_loop
from ...shading.light_polygons import ROUND_CORNERS, ROUND_LIMITS
from ...shading.lookup_table import LookupTable
from ...shading.table_header import moment_lines, shared_text
from ...shading.table_header.literals import float_literal
from . import light_texture, specular_text
from . import lighting_text as text
from .polygon_source import integral_function
from .table_texture import IOR_STEPS

VERTEX = """\
void main()
{
    gl_Position = vec4(corner, 0.0, 1.0);
}
"""


@dataclass(frozen=True)
class Features:
    """What a shader is compiled for."""

    specular: bool
    diffuse: bool
    geometric: bool  # a horizon of its own for the specular lobe
    bumped: bool  # diffuse and smooth normals of their own


def fragment_source(table: LookupTable, features: Features) -> str:
    """The fragment shader for `table` of degree 1 to 4."""
    if table.degree > edge_loop.MAX_DEGREE:
        raise ValueError(
            f"table {table.name} has degree {table.degree}, the graphics card's path goes up to {edge_loop.MAX_DEGREE}"
        )
    lights = text.LIGHTS.replace("@ROUND_LEVELS@", _round_levels())
    parts = ["#define LTSH_GLSL 1", shared_text(), _constants(table), lights]
    if features.specular:
        is_cosine = table.family == "ltc"
        parts += [specular_text.COSINE_SUM if is_cosine else _moment_sum(table), specular_text.SPECULAR_LOBE]
        parts += [_heights("specular", "warped.z", is_cosine + features.geometric)]
        parts += [integral_function("specular", 1 + is_cosine + features.geometric)]
        parts += [_lookup(table), _specular_setup(is_cosine, features.geometric), specular_text.SPECULAR]
    if features.diffuse:
        parts += [text.DIFFUSE_LOBE, _heights("diffuse", "dot(lobe.plane_0, v)", int(features.bumped))]
        parts += [integral_function("diffuse", 1 + features.bumped)]
        parts += [text.BUMPED if features.bumped else text.PLAIN]
    return "\n".join([*parts, _main(features)])


def _constants(table) -> str:
    rows, columns, parameters = table.warp.shape
    curves, count = table.coefficients.shape[2:]
    values = {
        "ROWS": rows,
        "COLUMNS": columns,
        "PARAMETERS": parameters,
        "CURVES": curves,
        "COEFFICIENTS": count,
        "BLOCKS": -(-count // 4),
        "LIGHT_HEADER": light_texture.HEADER,
        "FIRST_LIGHT": light_texture.FIRST_LIGHT,
        "LIGHT_WIDTH": light_texture.WIDTH,
        "DIFFUSE_FLAG": light_texture.DIFFUSE,
        "SPECULAR_FLAG": light_texture.SPECULAR,
        "ROUND_FLAG": light_texture.ROUND,
        "ONE_OVER_PI": float_literal(1.0 / np.pi),
        "IOR_STEPS": float_literal(IOR_STEPS),
    }
    return "\n".join(f"#define LTSH_{name} {value}" for name, value in values.items()) + "\n"


def _heights(name, first, more) -> str:
    """Heights of v above the horizons."""
    others = [f"dot(lobe.plane_{k}, v)" if k <= more else "rest" for k in (1, 2)]
    return (
        f"vec3 {name}_heights({name}_lobe lobe, vec3 v, vec3 warped, float rest)\n"
        f"{{\n    return vec3({first}, {', '.join(others)});\n}}\n"
    )


def _moment_sum(table) -> str:
    lines = "\n".join(line[4:] for line in moment_lines(table.degree))
    return specular_text.MOMENT_SUM.replace("@MOMENT_LINES@", lines)


def _lookup(table) -> str:
    count = table.coefficients.shape[3]
    blocks = -(-count // 4)
    fetches = [f"    vec4 block_{n} = ltsh_table_at(cell, layer + {n});" for n in range(blocks)]
    values = [f"    weights.values[{k}] = block_{k // 4}.{'xyzw'[k % 4]};" for k in range(count)]
    source = specular_text.LOOKUP.replace("@FETCHES@", "\n".join(fetches)).replace("@VALUES@", "\n".join(values))
    for name, operation in (("CLEAR", "w.{v}[{k}] = 0.0;"), ("ADD", "w.{v}[{k}] += share.{c} * values.values[{k}];")):
        lines = [
            "        " + operation.format(v=vector, k=k, c=component)
            for k in range(count)
            for vector, component in zip(("plain", "schlick", "dip", "dielectric"), "xyzw", strict=True)
        ]
        source = source.replace(f"@{name}@", "\n".join(lines))
    return source


def _round_levels() -> str:
    """The list of corners that a round light takes, from how far it reaches in units of the lobe's width."""
    lines = []
    levels = zip(light_texture.CIRCLE_FIRST, ROUND_CORNERS, (*ROUND_LIMITS, np.inf), strict=True)
    for first, count, limit in reversed(list(levels)):
        condition = "true" if np.isinf(limit) else f"wide <= {float_literal(limit)}"
        lines.append(f"    first = {condition} ? {first} : first;")
        lines.append(f"    count = {condition} ? {count} : count;")
    return "\n".join(lines)


def _specular_setup(is_cosine, geometric) -> str:
    lines = ["    lobe.plane_0 = ltsh_unit(lobe.row_z);"]
    if is_cosine:
        lines.append("    lobe.plane_1 = point.normal;")
    if geometric:
        lines.append(f"    lobe.plane_{1 + is_cosine} = point.geometric;")
    tilt = specular_text.TILT if is_cosine else ""
    return specular_text.SPECULAR_SETUP.replace("@TILT@", tilt).replace("@PLANES@", "\n".join(lines))


def _main(features) -> str:
    source = text.MAIN
    pieces = {
        "READ_FRESNEL": text.READ_FRESNEL if features.specular else "",
        "READ_GEOMETRIC": "texelFetch(geometric_normals, texel, 0).xyz" if features.geometric else "point.normal",
        "SPECULAR_SETUP": text.SETUP_SPECULAR if features.specular else "",
        "DIFFUSE_SETUP": "    diffuse_lobe matte = diffuse_at(point, texel);" if features.diffuse else "",
        "SPECULAR": text.ADD_SPECULAR if features.specular else "",
        "DIFFUSE": text.ADD_DIFFUSE if features.diffuse else "",
    }
    for name, piece in pieces.items():
        source = source.replace(f"@{name}@", piece)
    return source
