"""GLSL of the lighting pass: reads a G-buffer, lights and a table, writes reflected radiance.

What does not depend on Blender is the text of the exported headers (`table_header`): frames, cells, warps, edges.
Formulas and their sources stand in `shading`.
"""

from __future__ import annotations

import re
from dataclasses import dataclass

import numpy as np

from ...shading import edge_loop
from ...shading.light_polygons import ROUND_CORNERS
from ...shading.lookup_table import LookupTable
from ...shading.table_header import moment_lines, shared_text
from ...shading.table_header.literals import float_literal
from . import light_texture, specular_text
from . import lighting_text as text
from .disk_parts_source import spread_text
from .polygon_source import integral_function
from .spread_source import spread_function
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
    bumped: bool  # a horizon of its own for the diffuse lobe
    focused: bool = False  # lights with a spread
    turned: bool = False  # a diffuse normal of its own


def fragment_source(table: LookupTable, features: Features) -> str:
    """The fragment shader for `table` of degree 1 to 4."""
    if table.degree > edge_loop.MAX_DEGREE:
        raise ValueError(
            f"table {table.name} has degree {table.degree}, the graphics card's path goes up to {edge_loop.MAX_DEGREE}"
        )
    lights = text.LIGHTS.replace("@ROUND_LEVELS@", _round_levels())
    parts = ["#define LTSH_GLSL 1", shared_text(), _constants(table), text.LIGHT_TEXELS, lights]
    if features.focused:
        parts.append(spread_text())
    if features.specular:
        parts += _specular_parts(table, features)
    if features.diffuse:
        parts += _diffuse_parts(features)
    return "\n".join([*parts, _main(features)])


def _specular_parts(table, features) -> list[str]:
    is_cosine = table.family == "ltc"
    horizons = 1 + is_cosine + features.geometric
    # A tilt turns around the second axis of the frame, and so does the horizon.
    seam = "lobe.row_y" if is_cosine else None
    parts = [specular_text.COSINE_SUM if is_cosine else _moment_sum(table), specular_text.SPECULAR_LOBE]
    parts += [_heights("specular", "warped.z", int(is_cosine), features.geometric)]
    parts += [integral_function("specular", horizons, seam)]
    parts += [_lookup(table), _specular_setup(is_cosine, features.geometric), specular_text.SPECULAR]
    if features.focused:
        values = "specular_values(weights, sum)"
        parts.append(spread_function("specular", "specular_weights weights, ", values, "mat3(1.0)"))
    return parts


def _diffuse_parts(features) -> list[str]:
    parts = [text.DIFFUSE_LOBE, _heights("diffuse", "dot(lobe.plane_0, v)", 0, features.bumped)]
    parts += [integral_function("diffuse", 1 + features.bumped), _diffuse_start(features)]
    if features.focused:
        value = "vec4(diffuse_form_factor(lobe, sum), 0.0, 0.0, 0.0)"
        parts += [text.DIFFUSE_FRAME, spread_function("diffuse", "", value, "diffuse_frame(lobe)")]
    return parts


def _diffuse_start(features) -> str:
    if features.bumped:
        return text.BUMPED
    normal = "texelFetch(diffuse_normals, texel, 0).xyz" if features.turned else "point.normal"
    return text.PLAIN.replace("@DIFFUSE_NORMAL@", normal)


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
        **light_texture.constants(),
        "ONE_OVER_PI": float_literal(1.0 / np.pi),
        "IOR_STEPS": float_literal(IOR_STEPS),
    }
    return "\n".join(f"#define LTSH_{name} {value}" for name, value in values.items()) + "\n"


def _heights(name, first, more, own) -> str:
    """Heights of v above the horizons; `own` adds one that is left out where it is another one's."""
    others = [f"dot(lobe.plane_{k}, v)" if k <= more else "rest" for k in (1, 2)]
    if own:
        others[more] = f"lobe.is_spare ? rest : dot(lobe.plane_{more + 1}, v)"
    return (
        f"vec3 {name}_heights({name}_lobe lobe, vec3 v, vec3 warped, float rest)\n"
        f"{{\n    return vec3({first}, {', '.join(others)});\n}}\n"
    )


def _moment_sum(table) -> str:
    lines = "\n".join(line[4:] for line in moment_lines(table.degree))
    spots = re.sub(r"ltsh_edge_moment\(edge, (.*)\);", r"solid_angle * ltsh_spot_moment(direction, \1);", lines)
    return specular_text.MOMENT_SUM.replace("@MOMENT_LINES@", lines).replace("@SPOT_LINES@", spots)


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
    for first, count, limit in reversed(light_texture.ROUND_LEVELS):
        condition = "round" if np.isinf(limit) else f"round && wide <= {float_literal(limit)}"
        whole = [f"    light.whole_first = {condition} ? {first} : light.whole_first;"]
        whole.append(f"    light.whole_count = {condition} ? {count} : light.whole_count;")
        if count < ROUND_CORNERS[0]:
            lines += whole
            continue
        lines.append(f"    light.first = {condition} ? {first} : light.first;")
        lines.append(f"    light.count = {condition} ? {count} : light.count;")
        if count == ROUND_CORNERS[0]:
            lines += ["    light.whole_first = light.first;", "    light.whole_count = light.count;"]
    return "\n".join(lines)


def _specular_setup(is_cosine, geometric) -> str:
    lines = ["    lobe.plane_0 = ltsh_unit(lobe.row_z);"]
    if is_cosine:
        lines.append("    lobe.plane_1 = point.normal;")
    if geometric:
        lines.append(f"    lobe.plane_{1 + is_cosine} = point.geometric;")
        lines.append("    lobe.is_spare = ltsh_is_same(point.geometric, point.normal);")
    tilt = specular_text.TILT if is_cosine else ""
    return specular_text.SPECULAR_SETUP.replace("@TILT@", tilt).replace("@PLANES@", "\n".join(lines))


def _main(features) -> str:
    source = text.MAIN
    pieces = {
        "IS_FOCUSED": "ltsh_light_texel(header + 5).x > 0.0" if features.focused else "false",
        "READ_FRESNEL": text.READ_FRESNEL if features.specular else "",
        "READ_GEOMETRIC": "texelFetch(geometric_normals, texel, 0).xyz" if features.geometric else "point.normal",
        "SPECULAR_SETUP": text.SETUP_SPECULAR if features.specular else "",
        "DIFFUSE_SETUP": "    diffuse_lobe matte = diffuse_at(point, texel);" if features.diffuse else "",
        "SPECULAR": text.ADD_SPECULAR if features.specular else "",
        "DIFFUSE": text.ADD_DIFFUSE if features.diffuse else "",
    }
    pieces["SPECULAR_FOCUSED"] = text.SPECULAR_FOCUSED if features.focused else ""
    pieces["DIFFUSE_FOCUSED"] = text.DIFFUSE_FOCUSED if features.focused else ""
    for name, piece in pieces.items():
        source = source.replace(f"@{name}@", piece)
    return source
