"""Second half of what does not depend on the table: integrals over the edges of a polygon, cells and warps.

Names that begin with @ are filled in by `edge_functions`. Formulas and their sources stand in `shading`:
edge_integrals, lobe_integrals and lookup_table.
"""

from __future__ import annotations

import re

import numpy as np

from .. import edge_integrals, lookup_table
from .literals import float_literal

_PSI_DEGREE = 9
_HALF_ARC_NODES = 16


def edge_functions() -> str:
    """Functions with the prefix ltsh_ on edges, cells and warps."""
    psi = [float_literal(value) for value in _psi_coefficients()]
    values = {
        "PSI": "\n".join(f"    psi = psi * kappa + {value};".replace("+ -", "- ") for value in psi[1:]),
        "PSI_HIGHEST": psi[0],
        "TINY_SHIFT": float_literal(np.finfo(np.float32).eps ** 2),
        "REGULARIZATION": float_literal(lookup_table.WARP_REGULARIZATION**2),
        "MIN_ALPHA": float_literal(lookup_table.MIN_ALPHA),
        "TWO_OVER_PI": float_literal(2.0 / np.pi),
        "ONE_OVER_PI": float_literal(1.0 / np.pi),
        "ARC_NODES": "\n".join(_arc_node_lines()),
    }
    return re.sub(r"@([A-Z_]+)@", lambda found: values[found[1]], _EDGES)


def _psi_coefficients() -> np.ndarray:
    """Coefficients, highest power first, of kappa * psi, a polynomial in kappa = cos(theta / 2) (see `arc_factors`)."""
    chebyshev = np.polynomial.chebyshev.Chebyshev.interpolate(
        lambda kappa: kappa * edge_integrals.arc_factors(2.0 * kappa * kappa)[1], _PSI_DEGREE, domain=[0.0, 1.0]
    )
    return chebyshev.convert(kind=np.polynomial.Polynomial).coef[::-1]


def _arc_node_lines():
    """Gauss-Legendre nodes come in pairs of opposite sign."""
    nodes, weights = np.polynomial.legendre.leggauss(_HALF_ARC_NODES)
    for node, weight in zip(nodes, weights, strict=True):
        if node > 0.0:
            share = f"{float_literal(node)} * half_angle, {float_literal(0.5 * weight)}"
            yield f"    sum += ltsh_arc_pair(k, middle, across, {share});"


_EDGES = """\
/* The edge between two unit vectors. */
LTSH_FUNCTION ltsh_edge ltsh_edge_between(ltsh_vec3 start, ltsh_vec3 end)
{
    ltsh_edge edge;
    edge.start = start;
    edge.total = ltsh_add_scaled(start, 1.0f, end);
    /* start x end from the difference of ends that are close, which is exact, or the sum of ends nearly opposite. */
    float sign = ltsh_dot(edge.total, edge.total) > 2.0f ? -1.0f : 1.0f;
    edge.normal = ltsh_cross(start, ltsh_add_scaled(end, sign, start));
    float shifted = ltsh_larger(ltsh_one_plus_cosine(edge.total), @TINY_SHIFT@);
    float kappa = LTSH_SQRT(ltsh_clamped(0.5f * shifted, 1.0f));
    float psi = @PSI_HIGHEST@;
@PSI@
    edge.psi = psi / kappa;
    edge.phi = 1.0f + ltsh_larger(2.0f - shifted, 0.0f) * edge.psi;
    edge.q = 1.0f / shifted;
    return edge;
}

LTSH_FUNCTION ltsh_edge ltsh_make_edge(ltsh_polygon unit, int i)
{
    return ltsh_edge_between(unit.corners[i], unit.corners[i + 1 < unit.count ? i + 1 : 0]);
}

/* Signed integral of max(0, z) over a spherical polygon in z >= 0 (Lambert 1760). */
LTSH_FUNCTION float ltsh_clamped_cosine_integral(ltsh_polygon unit)
{
    float sum = 0.0f;
    for (int i = 0; i < unit.count; ++i) {
        ltsh_edge edge = ltsh_make_edge(unit, i);
        sum += edge.normal.z * edge.phi;
    }
    return 0.5f * sum;
}

/* Form factor, 0 to 1, of a polygon in z >= 0: the irradiance of unit radiance divided by pi. For diffuse surfaces. */
LTSH_FUNCTION float ltsh_form_factor(ltsh_polygon polygon)
{
    float integral = ltsh_clamped_cosine_integral(ltsh_project_to_sphere(polygon));
    return @ONE_OVER_PI@ * (integral < 0.0f ? -integral : integral);
}

/* Signed integral over a polygon in z >= 0 of the clamped cosine of mass 1 around (sin(tilt), 0, cos(tilt)). */
LTSH_FUNCTION float ltsh_tilted_cosine_integral(ltsh_polygon polygon, float tilt)
{
    float sine = LTSH_SIN(tilt);
    float cosine = LTSH_COS(tilt);
    for (int i = 0; i < polygon.count; ++i) {
        ltsh_vec3 corner = polygon.corners[i];
        polygon.corners[i].x = cosine * corner.x - sine * corner.z;
        polygon.corners[i].z = sine * corner.x + cosine * corner.z;
    }
    return @ONE_OVER_PI@ * ltsh_clamped_cosine_integral(ltsh_project_to_sphere(ltsh_clip_to_horizon(polygon)));
}

LTSH_FUNCTION float ltsh_integer_power(float value, int exponent)
{
    float power = 1.0f;
    for (int i = 0; i < exponent; ++i) {
        power *= value;
    }
    return power;
}

/* What the points of an arc at `angle` on both sides of its middle add to the mean of the k-th power. */
LTSH_FUNCTION float ltsh_arc_pair(int k, float middle, float across, float angle, float weight)
{
    float even = middle * LTSH_COS(angle);
    float odd = across * LTSH_SIN(angle);
    return weight * (ltsh_integer_power(even + odd, k) + ltsh_integer_power(even - odd, k));
}

/* Integral over the edge of the k-th power of what runs from `start` to `total - start`, divided by sin(theta). */
LTSH_FUNCTION float ltsh_arc_power(ltsh_edge edge, int k, float start, float total)
{
    float product = start * (total - start);
    if (k == 0) {
        return edge.phi;
    }
    if (k == 1) {
        return edge.q * total;
    }
    if (k == 2) {
        return 0.5f * edge.q * (1.0f + edge.psi) * total * total - edge.psi * product;
    }
    if (k == 3) {
        return edge.q * total * ((edge.q + 1.0f) * (1.0f / 3.0f) * total * total - product);
    }
    /* Degrees above 4: Gauss-Legendre quadrature of a trigonometric polynomial, exact to rounding. */
    float cos_half = LTSH_SQRT(0.5f / edge.q);
    float sin_half = LTSH_SQRT(ltsh_larger(1.0f - 0.5f / edge.q, 0.0f));
    float half_angle = LTSH_ATAN2(sin_half, cos_half);
    float middle = 0.5f * total / cos_half;
    float across = sin_half > 0.0f ? (0.5f * total - start) / sin_half : 0.0f;
    float sum = 0.0f;
@ARC_NODES@
    return edge.phi * sum;
}

/* What an edge adds to the moment of the ridge direction (u_x, 0, u_z) and the power k. */
LTSH_FUNCTION float ltsh_edge_moment(ltsh_edge edge, float u_x, float u_z, int k)
{
    float start = u_x * edge.start.x + u_z * edge.start.z;
    float total = u_x * edge.total.x + u_z * edge.total.z;
    float normal = u_x * edge.normal.x + u_z * edge.normal.z;
    return normal * ltsh_arc_power(edge, k, start, total);
}

/* As ltsh_make_cell, for who knows the sine better than it follows from a cosine close to one; both from 0 to 1. */
LTSH_FUNCTION ltsh_cell ltsh_make_cell_at(float cos_theta_o, float sin_theta_o, float roughness, int rows, int columns)
{
    ltsh_cell cell;
    cell.cos_theta_o = cos_theta_o;
    cell.sin_theta_o = sin_theta_o;
    cell.roughness = ltsh_clamped(roughness, 1.0f);
    /* 1 - theta_o / 90 deg as an elevation keeps its digits at grazing angles. */
    float elevation = @TWO_OVER_PI@ * LTSH_ATAN2(cell.cos_theta_o, sin_theta_o);
    float column_position = ltsh_clamped(1.0f - LTSH_SQRT(elevation), 1.0f) * LTSH_FLOAT(columns - 1);
    float row_position = cell.roughness * LTSH_FLOAT(rows - 1);
    int column = LTSH_INT(column_position);
    int row = LTSH_INT(row_position);
    column = column < columns - 2 ? column : columns - 2;
    row = row < rows - 2 ? row : rows - 2;
    cell.node = row * columns + column;
    cell.row_weight = row_position - LTSH_FLOAT(row);
    cell.column_weight = column_position - LTSH_FLOAT(column);
    return cell;
}

/* The cell of a table with uniform roughness and theta_o uniform in 1 - sqrt(1 - theta_o / 90 deg); clamps both. */
LTSH_FUNCTION ltsh_cell ltsh_make_cell(float cos_theta_o, float roughness, int rows, int columns)
{
    float cosine = ltsh_clamped(cos_theta_o, 1.0f);
    return ltsh_make_cell_at(cosine, LTSH_SQRT((1.0f - cosine) * (1.0f + cosine)), roughness, rows, columns);
}

/* The warp from the interpolated channels A, B, C and the tilt. */
LTSH_FUNCTION ltsh_warp ltsh_make_warp(ltsh_cell cell, float a, float b, float c, float tilt)
{
    float alpha = ltsh_larger(cell.roughness * cell.roughness, @MIN_ALPHA@);
    float cos_squared = cell.cos_theta_o * cell.cos_theta_o;
    float sin_squared = cell.sin_theta_o * cell.sin_theta_o;
    float g_squared = cos_squared + @REGULARIZATION@ * alpha * alpha * sin_squared;
    ltsh_warp warp;
    warp.xx = a * g_squared;
    warp.xz = a * b * LTSH_SQRT(g_squared * sin_squared);
    warp.yy = c;
    warp.zz = 2.0f * alpha;
    warp.tilt = tilt;
    return warp;
}

LTSH_FUNCTION ltsh_vec3 ltsh_warped(ltsh_warp warp, ltsh_vec3 v)
{
    return ltsh_make_vec3(warp.xx * v.x + warp.xz * v.z, warp.yy * v.y, warp.zz * v.z);
}

LTSH_FUNCTION ltsh_polygon ltsh_warped_polygon(ltsh_warp warp, ltsh_polygon polygon)
{
    for (int i = 0; i < polygon.count; ++i) {
        polygon.corners[i] = ltsh_warped(warp, polygon.corners[i]);
    }
    return polygon;
}
"""
