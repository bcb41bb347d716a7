"""The tables and the code that evaluates them, as a header for C, C++ and GLSL."""

from __future__ import annotations

import re

import numpy as np

from . import edge_integrals, lookup_table
from .edge_integrals import RIDGE_DIRECTIONS
from .lookup_table import LookupTable
from .spherical_harmonics import coefficient_index, hemisphere_integrals, normalization


def float_literal(value) -> str:
    """The shortest literal that is exactly `value` rounded to float32."""
    return f"{np.float32(value)!s}f"


LOOKUP = """\
struct @prefix@_coefficients { float values[@PREFIX@_COEFFICIENTS]; };
struct @prefix@_weights { float values[@PREFIX@_COEFFICIENTS]; };
struct @prefix@_moments { float values[@PREFIX@_COEFFICIENTS]; };
#ifndef LTSH_GLSL
typedef struct @prefix@_coefficients @prefix@_coefficients;
typedef struct @prefix@_weights @prefix@_weights;
typedef struct @prefix@_moments @prefix@_moments;
#ifndef @PREFIX@_DATA
LTSH_FUNCTION float @prefix@_data_at(int index);
#define @PREFIX@_DATA(index) @prefix@_data_at(index)
#define @PREFIX@_DATA_FOLLOWS 1
#endif
#endif

/* Where cos_theta_o and roughness, both clamped to 0 .. 1, fall in the table. */
LTSH_FUNCTION ltsh_cell @prefix@_cell(float cos_theta_o, float roughness)
{
    return ltsh_make_cell(cos_theta_o, roughness, @PREFIX@_ROWS, @PREFIX@_COLUMNS);
}

/* One channel, interpolated bilinearly: first the warp, then @PREFIX@_COEFFICIENTS of every curve. */
LTSH_FUNCTION float @prefix@_channel(ltsh_cell cell, int channel)
{
    int lower = cell.node * @PREFIX@_CHANNELS + channel;
    int upper = lower + @PREFIX@_COLUMNS * @PREFIX@_CHANNELS;
    float share = cell.column_weight;
    float first = @PREFIX@_DATA(lower) * (1.0f - share) + @PREFIX@_DATA(lower + @PREFIX@_CHANNELS) * share;
    float second = @PREFIX@_DATA(upper) * (1.0f - share) + @PREFIX@_DATA(upper + @PREFIX@_CHANNELS) * share;
    return first * (1.0f - cell.row_weight) + second * cell.row_weight;
}

LTSH_FUNCTION ltsh_warp @prefix@_lookup_warp(ltsh_cell cell)
{
    float a = @prefix@_channel(cell, 0);
    float b = @prefix@_channel(cell, 1);
    float c = @prefix@_channel(cell, 2);
    float tilt = @PREFIX@_PARAMETERS > 3 ? @prefix@_channel(cell, @PREFIX@_PARAMETERS - 1) : 0.0f;
    return ltsh_make_warp(cell, a, b, c, tilt);
}

/* Coefficients of Fresnel curve 0 .. @PREFIX@_CURVES - 1. */
LTSH_FUNCTION @prefix@_coefficients @prefix@_lookup_curve(ltsh_cell cell, int curve)
{
    @prefix@_coefficients coefficients;
    for (int k = 0; k < @PREFIX@_COEFFICIENTS; ++k) {
        coefficients.values[k] = @prefix@_channel(cell, @PREFIX@_PARAMETERS + curve * @PREFIX@_COEFFICIENTS + k);
    }
    return coefficients;
}

/* Linear interpolation among `count` values `stride` apart, at a position from 0 to count - 1. */
LTSH_FUNCTION float @prefix@_interpolated(int offset, int stride, int count, float position)
{
    float clamped = ltsh_clamped(position, LTSH_FLOAT(count - 1));
    int index = LTSH_INT(clamped);
    int following = index + 1 < count ? index + 1 : index;
    float share = clamped - LTSH_FLOAT(index);
    return @PREFIX@_DATA(offset + index * stride) * (1.0f - share) + @PREFIX@_DATA(offset + following * stride) * share;
}

/* Position of an index of refraction among those tabulated, clamped to their range. */
LTSH_FUNCTION float @prefix@_ior_position(float ior)
{
    int low = 0;
    int high = @PREFIX@_IOR_COUNT - 1;
    if (!(ior > @PREFIX@_DATA(@PREFIX@_IOR_OFFSET))) {
        return 0.0f;
    }
    if (ior >= @PREFIX@_DATA(@PREFIX@_IOR_OFFSET + high)) {
        return LTSH_FLOAT(high);
    }
    while (high - low > 1) {
        int middle = (low + high) / 2;
        if (ior < @PREFIX@_DATA(@PREFIX@_IOR_OFFSET + middle)) {
            high = middle;
        } else {
            low = middle;
        }
    }
    float start = @PREFIX@_DATA(@PREFIX@_IOR_OFFSET + low);
    return LTSH_FLOAT(low) + (ior - start) / (@PREFIX@_DATA(@PREFIX@_IOR_OFFSET + high) - start);
}

/* Weight of a Fresnel curve for a dielectric, at a position from @prefix@_ior_position. */
LTSH_FUNCTION float @prefix@_dielectric_weight(float ior_position, int curve)
{
    return @prefix@_interpolated(@PREFIX@_WEIGHTS_OFFSET + curve, @PREFIX@_CURVES, @PREFIX@_IOR_COUNT, ior_position);
}

/* Coefficients of a dielectric of relative index of refraction `ior`. */
LTSH_FUNCTION @prefix@_coefficients @prefix@_lookup_dielectric(ltsh_cell cell, float ior)
{
    float ior_position = @prefix@_ior_position(ior);
    @prefix@_coefficients sum;
    for (int k = 0; k < @PREFIX@_COEFFICIENTS; ++k) {
        sum.values[k] = 0.0f;
    }
    for (int curve = 0; curve < @PREFIX@_CURVES; ++curve) {
        float weight = @prefix@_dielectric_weight(ior_position, curve);
        @prefix@_coefficients coefficients = @prefix@_lookup_curve(cell, curve);
        for (int k = 0; k < @PREFIX@_COEFFICIENTS; ++k) {
            sum.values[k] += weight * coefficients.values[k];
        }
    }
    return sum;
}

/* The Fresnel curve itself at the cosine of the half angle, 0 .. 1. */
LTSH_FUNCTION float @prefix@_fresnel_curve(int curve, float cosine)
{
    int offset = @PREFIX@_FRESNEL_OFFSET + curve * @PREFIX@_COSINE_COUNT;
    float position = ltsh_clamped(cosine, 1.0f) * LTSH_FLOAT(@PREFIX@_COSINE_COUNT - 1);
    return @prefix@_interpolated(offset, 1, @PREFIX@_COSINE_COUNT, position);
}

/* Directional albedo of a curve averaged over the hemisphere: the integral of 2 mu albedo(mu) over mu in 0 .. 1. */
LTSH_FUNCTION float @prefix@_average_albedo(float roughness, int curve)
{
    float position = ltsh_clamped(roughness, 1.0f) * LTSH_FLOAT(@PREFIX@_ROWS - 1);
    return @prefix@_interpolated(@PREFIX@_AVERAGE_ALBEDO_OFFSET + curve, @PREFIX@_CURVES, @PREFIX@_ROWS, position);
}
"""

GEOMETRY = """\
#ifndef LTSH_SHARED
#define LTSH_SHARED @VERSION@

/* Corners a polygon has room for, those that clipping adds included: define it before the first header if 8 are few. */
#ifndef LTSH_MAX_CORNERS
#define LTSH_MAX_CORNERS 8
#endif

#ifdef LTSH_GLSL
#define LTSH_FUNCTION
#define LTSH_SQRT(x) sqrt(x)
#define LTSH_SIN(x) sin(x)
#define LTSH_COS(x) cos(x)
#define LTSH_ATAN2(y, x) atan(y, x)
#define LTSH_INT(x) int(x)
#define LTSH_FLOAT(x) float(x)
#define ltsh_vec3 vec3
#else
#include <math.h>
#define LTSH_FUNCTION static inline
#define LTSH_SQRT(x) sqrtf(x)
#define LTSH_SIN(x) sinf(x)
#define LTSH_COS(x) cosf(x)
#define LTSH_ATAN2(y, x) atan2f(y, x)
#define LTSH_INT(x) ((int)(x))
#define LTSH_FLOAT(x) ((float)(x))
typedef struct ltsh_vec3 ltsh_vec3;
struct ltsh_vec3 { float x; float y; float z; };
#endif

/* Axes of a local frame: the normal is z, the view direction has y = 0 and x >= 0. */
struct ltsh_frame { ltsh_vec3 tangent; ltsh_vec3 bitangent; ltsh_vec3 normal; };
/* The first `count` corners are in use; any winding. */
struct ltsh_polygon { int count; ltsh_vec3 corners[LTSH_MAX_CORNERS]; };
/* Where a lookup falls: the node of lower roughness and theta_o, and how far it is to the next one of each. */
struct ltsh_cell {
    float cos_theta_o; float sin_theta_o; float roughness; int node; float row_weight; float column_weight;
};
/* W of the lobe D_orig(W w / |W w|) |W| / |W w|^3, upper triangular; tilt in radians is 0 but for LTC. */
struct ltsh_warp { float xx; float xz; float yy; float zz; float tilt; };
/* An edge of a spherical polygon of length theta: phi = theta / sin(theta), psi = (phi - 1) / (1 - cos(theta)),
   q = 1 / (1 + cos(theta)); `total` is the sum of its ends, `normal` the cross product start x end. */
struct ltsh_edge { ltsh_vec3 start; ltsh_vec3 total; ltsh_vec3 normal; float phi; float psi; float q; };

#ifndef LTSH_GLSL
typedef struct ltsh_frame ltsh_frame;
typedef struct ltsh_polygon ltsh_polygon;
typedef struct ltsh_cell ltsh_cell;
typedef struct ltsh_warp ltsh_warp;
typedef struct ltsh_edge ltsh_edge;
#endif

LTSH_FUNCTION float ltsh_larger(float a, float b) { return a > b ? a : b; }

LTSH_FUNCTION float ltsh_clamped(float value, float highest)
{
    /* NaN becomes 0. */
    return value > 0.0f ? (value < highest ? value : highest) : 0.0f;
}

LTSH_FUNCTION ltsh_vec3 ltsh_make_vec3(float x, float y, float z)
{
    ltsh_vec3 result;
    result.x = x;
    result.y = y;
    result.z = z;
    return result;
}

LTSH_FUNCTION float ltsh_dot(ltsh_vec3 a, ltsh_vec3 b) { return a.x * b.x + a.y * b.y + a.z * b.z; }

LTSH_FUNCTION ltsh_vec3 ltsh_cross(ltsh_vec3 a, ltsh_vec3 b)
{
    return ltsh_make_vec3(a.y * b.z - a.z * b.y, a.z * b.x - a.x * b.z, a.x * b.y - a.y * b.x);
}

/* a + factor * b */
LTSH_FUNCTION ltsh_vec3 ltsh_add_scaled(ltsh_vec3 a, float factor, ltsh_vec3 b)
{
    return ltsh_make_vec3(a.x + factor * b.x, a.y + factor * b.y, a.z + factor * b.z);
}

/* The unit vector along v; a zero vector stays zero. */
LTSH_FUNCTION ltsh_vec3 ltsh_unit(ltsh_vec3 v)
{
    float scale = 1.0f / LTSH_SQRT(ltsh_larger(ltsh_dot(v, v), 1e-37f));
    return ltsh_make_vec3(scale * v.x, scale * v.y, scale * v.z);
}

/* The local frame of a surface point, from unit vectors of the same space. */
LTSH_FUNCTION ltsh_frame ltsh_make_frame(ltsh_vec3 normal, ltsh_vec3 view)
{
    ltsh_frame frame;
    /* The difference of vectors that are close is exact, and so is what it has across the normal. */
    ltsh_vec3 across = ltsh_add_scaled(view, -1.0f, normal);
    across = ltsh_add_scaled(across, -ltsh_dot(normal, across), normal);
    if (ltsh_dot(across, across) < 1e-14f) {
        /* View and normal coincide: any tangent serves. */
        across = normal.x * normal.x < 0.5f ? ltsh_make_vec3(1.0f, 0.0f, 0.0f) : ltsh_make_vec3(0.0f, 1.0f, 0.0f);
        across = ltsh_add_scaled(across, -ltsh_dot(normal, across), normal);
    }
    frame.tangent = ltsh_unit(across);
    frame.bitangent = ltsh_cross(normal, frame.tangent);
    frame.normal = normal;
    return frame;
}

LTSH_FUNCTION ltsh_vec3 ltsh_to_local(ltsh_frame frame, ltsh_vec3 v)
{
    return ltsh_make_vec3(ltsh_dot(frame.tangent, v), ltsh_dot(frame.bitangent, v), ltsh_dot(frame.normal, v));
}

LTSH_FUNCTION ltsh_polygon ltsh_empty_polygon(void)
{
    ltsh_polygon polygon;
    polygon.count = 0;
    for (int i = 0; i < LTSH_MAX_CORNERS; ++i) {
        polygon.corners[i] = ltsh_make_vec3(0.0f, 0.0f, 0.0f);
    }
    return polygon;
}

/* The polygon with one corner more; one that finds no room is left out. */
LTSH_FUNCTION ltsh_polygon ltsh_with_corner(ltsh_polygon polygon, ltsh_vec3 corner)
{
    if (polygon.count < LTSH_MAX_CORNERS) {
        polygon.corners[polygon.count] = corner;
        polygon.count += 1;
    }
    return polygon;
}

/* The part of a polygon where z > 0, count 0 if there is none. One of V corners gets at most V + 1 if it is convex. */
LTSH_FUNCTION ltsh_polygon ltsh_clip_to_horizon(ltsh_polygon polygon)
{
    ltsh_polygon result = ltsh_empty_polygon();
    for (int i = 0; i < polygon.count; ++i) {
        ltsh_vec3 start = polygon.corners[i];
        ltsh_vec3 end = polygon.corners[i + 1 < polygon.count ? i + 1 : 0];
        if (start.z > 0.0f) {
            result = ltsh_with_corner(result, start);
        }
        if ((start.z > 0.0f) != (end.z > 0.0f)) {
            float share = start.z / (start.z - end.z);
            float x = start.x + share * (end.x - start.x);
            float y = start.y + share * (end.y - start.y);
            result = ltsh_with_corner(result, ltsh_make_vec3(x, y, 0.0f));
        }
    }
    return result;
}

LTSH_FUNCTION ltsh_polygon ltsh_project_to_sphere(ltsh_polygon polygon)
{
    for (int i = 0; i < polygon.count; ++i) {
        polygon.corners[i] = ltsh_unit(polygon.corners[i]);
    }
    return polygon;
}

/* 1 + cos(theta) of an edge of length theta from the sum of its ends. */
LTSH_FUNCTION float ltsh_one_plus_cosine(ltsh_vec3 total) { return 0.5f * ltsh_dot(total, total); }

LTSH_FUNCTION ltsh_vec3 ltsh_edge_sum(ltsh_polygon unit, int i)
{
    return ltsh_add_scaled(unit.corners[i], 1.0f, unit.corners[i + 1 < unit.count ? i + 1 : 0]);
}

/* Signed solid angle of a spherical polygon in z >= 0: positive where the corners run counterclockwise about +z as seen
   from outside the sphere. */
LTSH_FUNCTION float ltsh_solid_angle(ltsh_polygon unit)
{
    float real = 1.0f;
    float imaginary = 0.0f;
    float projected = 0.0f;
    for (int i = 0; i < unit.count; ++i) {
        ltsh_vec3 total = ltsh_edge_sum(unit, i);
        float edge_real = total.z + ltsh_one_plus_cosine(total);
        float edge_imaginary = unit.corners[i].x * total.y - unit.corners[i].y * total.x;
        float next_real = real * edge_real - imaginary * edge_imaginary;
        float next_imaginary = real * edge_imaginary + imaginary * edge_real;
        /* Only the argument matters: keep the magnitude near one. */
        float magnitude = (next_real < 0.0f ? -next_real : next_real)
            + (next_imaginary < 0.0f ? -next_imaginary : next_imaginary);
        float scale = magnitude > 0.0f ? 1.0f / magnitude : 1.0f;
        real = scale * next_real;
        imaginary = scale * next_imaginary;
        projected += edge_imaginary;
    }
    if (real == 0.0f && imaginary == 0.0f) {
        return 0.0f;
    }
    float solid_angle = 2.0f * LTSH_ATAN2(imaginary, real);
    /* Close to 2 pi rounding may cross the branch cut; the area projected on the horizon still has the right sign. */
    if ((solid_angle > 6.0f || solid_angle < -6.0f) && projected * solid_angle < 0.0f) {
        return -solid_angle;
    }
    return solid_angle;
}

/* 1, -1 or 0: the sign of the solid angle of a polygon in z >= 0, in any length unit. */
LTSH_FUNCTION float ltsh_orientation(ltsh_polygon polygon)
{
    float solid_angle = ltsh_solid_angle(ltsh_project_to_sphere(polygon));
    return solid_angle > 0.0f ? 1.0f : (solid_angle < 0.0f ? -1.0f : 0.0f);
}
"""

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
