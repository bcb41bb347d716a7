"""Lobes of a table and their integrals over polygons: spherical harmonics expansions and tilted clamped cosines.

@prefix@ and @PREFIX@ are filled in by `header`. Formulas and their sources stand in `shading`: spherical_harmonics,
edge_integrals and lobe_integrals.
"""

from __future__ import annotations

import numpy as np

from ..edge_integrals import RIDGE_DIRECTIONS
from ..lookup_table import LookupTable
from ..spherical_harmonics import coefficient_index, hemisphere_integrals, normalization
from .literals import float_literal

_TERMS_PER_LINE = 3


def lobe_functions(table: LookupTable) -> str:
    """Moments of polygons and their weights, values and albedos of lobes, for the table's family and degree."""
    functions = _expansion_functions(table) if table.family == "ltsh" else _COSINE_FUNCTIONS
    return functions.replace("@LOBE_HEAD@\n", _LOBE_HEAD) + "\n" + _INTEGRATE


def _expansion_functions(table) -> str:
    """Functions of a spherical harmonics expansion, with its loops over l, m and the moments written out."""
    albedo = hemisphere_integrals(table.degree)
    albedo_terms = [
        f"{float_literal(value)} * coefficients.values[{k}]" for k, value in enumerate(albedo) if abs(value) > 1e-12
    ]
    replacements = {
        "@WEIGHT_LINES@": "\n".join(_weight_lines(table.ridge_weights)),
        "@MOMENT_LINES@": "\n".join(moment_lines(table.degree)),
        "@EXPANSION_LINES@": "\n".join(_expansion_lines(table.degree)),
        "@ALBEDO@": _sum(albedo_terms),
    }
    text = _EXPANSION_FUNCTIONS
    for name, value in replacements.items():
        text = text.replace(name, value)
    return text


def _sum(terms) -> str:
    lines = [" + ".join(terms[start : start + _TERMS_PER_LINE]) for start in range(0, len(terms), _TERMS_PER_LINE)]
    return "\n        + ".join(lines).replace("+ -", "- ")


def _weight_lines(ridge_weights):
    """Moment weights are coefficients @ ridge_weights, a sparse matrix."""
    for moment, column in enumerate(ridge_weights.T):
        terms = [
            f"{float_literal(value)} * coefficients.values[{k}]"
            for k, value in enumerate(column)
            if abs(value) > 1e-12 * np.abs(ridge_weights).max()
        ]
        yield f"    weights.values[{moment}] = {_sum(terms) or '0.0f'};"


def moment_lines(degree):
    """Statements that add an edge to all moments but the solid angle, rows as in `edge_integrals.moments`."""
    for k in range(degree):
        for j, (u_x, u_z) in enumerate(RIDGE_DIRECTIONS[: k + 2]):
            row = 1 + k * (k + 3) // 2 + j
            yield f"        moments.values[{row}] += ltsh_edge_moment(edge, {u_x}f, {u_z}f, {k});"


def _expansion_lines(degree):
    """The recurrences of `spherical_harmonics.evaluate`; legendre_l_m is the m-th derivative of P_l at unit.z."""
    legendre, turns = {}, {0: ("", "")}
    for m in range(degree + 1):
        if m == 1:
            turns[1] = (" * unit.x", " * unit.y")
        if m == 2:
            yield "    float turn_1 = unit.x;"
            yield "    float side_1 = unit.y;"
        if m >= 2:
            yield f"    float turn_{m} = unit.x * turn_{m - 1} - unit.y * side_{m - 1};"
            if m < degree:
                yield f"    float side_{m} = unit.x * side_{m - 1} + unit.y * turn_{m - 1};"
            turns[m] = (f" * turn_{m}", "")
        for l in range(m, degree + 1):  # noqa: E741 (the field's letter)
            value = _legendre_value(l, m, legendre)
            legendre[l, m] = f"legendre_{l}_{m}"
            yield f"    float legendre_{l}_{m} = {value};"
    terms = [
        f"{float_literal(normalization(l, m))} * {legendre[l, m]}{turns[m][0]}"
        f" * coefficients.values[{coefficient_index(l, m)}]"
        for l in range(degree + 1)  # noqa: E741
        for m in range(l + 1)
    ]
    yield "    float original = 0.0f;"
    yield from (f"    original += {term};" for term in terms)


def _legendre_value(l, m, legendre) -> str:  # noqa: E741
    if l == m:
        return float_literal(np.prod(np.arange(2 * m - 1, 0, -2, dtype=float)))
    first = f"{float_literal((2 * l - 1) / (l - m))} * unit.z * {legendre[l - 1, m]}"
    if l == m + 1:
        return first
    return f"{first} - {float_literal((l + m - 1) / (l - m))} * {legendre[l - 2, m]}"


_LOBE_HEAD = """\
/* The lobe, BRDF times cosine in sr^-1, at a unit direction; 0 below the horizon. */
LTSH_FUNCTION float @prefix@_evaluate_lobe(
    ltsh_warp warp, @prefix@_coefficients coefficients, ltsh_vec3 direction)
{
    if (!(direction.z > 0.0f)) {
        return 0.0f;
    }
    ltsh_vec3 toward = ltsh_warped(warp, direction);
    float size = LTSH_SQRT(ltsh_dot(toward, toward));
    ltsh_vec3 unit = ltsh_unit(toward);
"""

_EXPANSION_FUNCTIONS = """\
/* Weights of the moments of a polygon: once per coefficient vector, for any number of lights. */
LTSH_FUNCTION @prefix@_weights @prefix@_moment_weights(@prefix@_coefficients coefficients)
{
    @prefix@_weights weights;
@WEIGHT_LINES@
    return weights;
}

/* Moments of a polygon in z >= 0 under the warp: once per light, for any number of coefficient vectors. */
LTSH_FUNCTION @prefix@_moments @prefix@_polygon_moments(ltsh_warp warp, ltsh_polygon polygon)
{
    ltsh_polygon unit = ltsh_project_to_sphere(ltsh_warped_polygon(warp, polygon));
    @prefix@_moments moments;
    for (int k = 0; k < @PREFIX@_COEFFICIENTS; ++k) {
        moments.values[k] = 0.0f;
    }
    moments.values[0] = ltsh_solid_angle(unit);
    for (int i = 0; i < unit.count; ++i) {
        ltsh_edge edge = ltsh_make_edge(unit, i);
@MOMENT_LINES@
    }
    return moments;
}

@LOBE_HEAD@
@EXPANSION_LINES@
    return original * (warp.xx / size) * (warp.yy / size) * (warp.zz / size);
}

/* Directional albedo of a curve: the integral of its lobe over the hemisphere. */
LTSH_FUNCTION float @prefix@_albedo(ltsh_cell cell, int curve)
{
    @prefix@_coefficients coefficients = @prefix@_lookup_curve(cell, curve);
    return @ALBEDO@;
}
"""

_COSINE_FUNCTIONS = """\
/* Weights of the moments of a polygon: once per coefficient vector, for any number of lights. */
LTSH_FUNCTION @prefix@_weights @prefix@_moment_weights(@prefix@_coefficients coefficients)
{
    @prefix@_weights weights;
    weights.values[0] = coefficients.values[0];
    return weights;
}

/* Moments of a polygon in z >= 0 under the warp: once per light, for any number of coefficient vectors. */
LTSH_FUNCTION @prefix@_moments @prefix@_polygon_moments(ltsh_warp warp, ltsh_polygon polygon)
{
    @prefix@_moments moments;
    moments.values[0] = ltsh_tilted_cosine_integral(ltsh_warped_polygon(warp, polygon), warp.tilt);
    return moments;
}

@LOBE_HEAD@
    float toward_axis = LTSH_SIN(warp.tilt) * unit.x + LTSH_COS(warp.tilt) * unit.z;
    float original = coefficients.values[0] * ltsh_larger(toward_axis, 0.0f) * @ONE_OVER_PI@;
    return original * (warp.xx / size) * (warp.yy / size) * (warp.zz / size);
}

/* Directional albedo of a curve: the integral of its lobe over the hemisphere. */
LTSH_FUNCTION float @prefix@_albedo(ltsh_cell cell, int curve)
{
    float tilt = @prefix@_channel(cell, @PREFIX@_PARAMETERS - 1);
    return @prefix@_lookup_curve(cell, curve).values[0] * (0.5f + 0.5f * LTSH_COS(tilt));
}
""".replace("@ONE_OVER_PI@", float_literal(1.0 / np.pi))

_INTEGRATE = """\
/* Signed integral of a lobe over a polygon: positive where the corners run counterclockwise about +z as seen from
   outside the unit sphere. */
LTSH_FUNCTION float @prefix@_integral(@prefix@_weights weights, @prefix@_moments moments)
{
    float sum = 0.0f;
    for (int k = 0; k < @PREFIX@_COEFFICIENTS; ++k) {
        sum += weights.values[k] * moments.values[k];
    }
    return sum;
}

/* Integral of the lobe for F = 1 over the part of a polygon above the horizon, either winding, never negative. */
LTSH_FUNCTION float @prefix@_integrate_polygon(float cos_theta_o, float roughness, ltsh_polygon polygon)
{
    ltsh_polygon visible = ltsh_clip_to_horizon(polygon);
    ltsh_cell cell = @prefix@_cell(cos_theta_o, roughness);
    @prefix@_moments moments = @prefix@_polygon_moments(@prefix@_lookup_warp(cell), visible);
    @prefix@_weights weights = @prefix@_moment_weights(@prefix@_lookup_curve(cell, 0));
    return ltsh_larger(ltsh_orientation(visible) * @prefix@_integral(weights, moments), 0.0f);
}
"""
