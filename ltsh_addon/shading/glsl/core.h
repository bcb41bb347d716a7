/* SPDX-License-Identifier: MIT, with the notice of table.h. Copyright 2026 LTSH contributors. */
#ifndef LTSH_SHARED
#define LTSH_SHARED @VERSION@

/* Most corners of a polygon, including those from clipping. Define it before the first header if 8 are too few. */
#ifndef LTSH_MAX_CORNERS
#define LTSH_MAX_CORNERS 8
#endif

#if defined(LTSH_GLSL) || defined(LTSH_HLSL)
#define LTSH_SHADER 1
#define LTSH_FUNCTION
#define LTSH_SQRT(x) sqrt(x)
#define LTSH_SIN(x) sin(x)
#define LTSH_COS(x) cos(x)
#define LTSH_INT(x) int(x)
#define LTSH_FLOAT(x) float(x)
#ifdef LTSH_HLSL
#define LTSH_ATAN2(y, x) atan2(y, x)
#define ltsh_vec3 float3
#else
#define LTSH_ATAN2(y, x) atan(y, x)
#define ltsh_vec3 vec3
#endif
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

/* Axes of a local frame. The normal is z; the view direction has y = 0 and x >= 0. */
struct ltsh_frame { ltsh_vec3 tangent; ltsh_vec3 bitangent; ltsh_vec3 normal; };
/* A polygon with any winding. The first `count` corners are in use. */
struct ltsh_polygon { int count; ltsh_vec3 corners[LTSH_MAX_CORNERS]; };
/* Place of a lookup: the node of lower roughness and theta_o, and the weights of the next row and the next column. */
struct ltsh_cell {
    float cos_theta_o; float sin_theta_o; float roughness; int node; float row_weight; float column_weight;
};
/* Upper triangular W of the lobe D_orig(W w / |W w|) |W| / |W w|^3. The tilt in radians is 0 except for LTC. */
struct ltsh_warp { float xx; float xz; float yy; float zz; float tilt; };
/* An edge of a spherical polygon of length theta: phi = theta / sin(theta), psi = (phi - 1) / (1 - cos(theta)),
   q = 1 / (1 + cos(theta)). `total` is the sum of its ends; `normal` is the cross product start x end. */
struct ltsh_edge { ltsh_vec3 start; ltsh_vec3 total; ltsh_vec3 normal; float phi; float psi; float q; };
/* A light seen from the point: its center, half sides of the parallelogram around it, and its area times the direction
   in which it shines. */
struct ltsh_extent { ltsh_vec3 center; ltsh_vec3 half_u; ltsh_vec3 half_v; ltsh_vec3 area; };
/* Bounds of the integral for F = 1, and the least cosine between the view and the half vectors. Without bounds these
   are 0, 1e30 and 0. */
struct ltsh_limits { float least; float most; float cosine; };

#ifndef LTSH_SHADER
typedef struct ltsh_frame ltsh_frame;
typedef struct ltsh_polygon ltsh_polygon;
typedef struct ltsh_cell ltsh_cell;
typedef struct ltsh_warp ltsh_warp;
typedef struct ltsh_edge ltsh_edge;
typedef struct ltsh_extent ltsh_extent;
typedef struct ltsh_limits ltsh_limits;
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
    /* Differences of close vectors are exact, and so is the part of this one across the normal. */
    ltsh_vec3 across = ltsh_add_scaled(view, -1.0f, normal);
    across = ltsh_add_scaled(across, -ltsh_dot(normal, across), normal);
    if (ltsh_dot(across, across) < 1e-14f) {
        /* View and normal coincide, so any tangent serves. */
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

/* The polygon with one more corner. A corner that finds no room is left out. */
LTSH_FUNCTION ltsh_polygon ltsh_with_corner(ltsh_polygon polygon, ltsh_vec3 corner)
{
    if (polygon.count < LTSH_MAX_CORNERS) {
        polygon.corners[polygon.count] = corner;
        polygon.count += 1;
    }
    return polygon;
}

/* The part of a polygon where z > 0; count 0 if there is none. A convex polygon of V corners gets at most V + 1. */
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

/* Signed solid angle of a spherical polygon in z >= 0. It is positive if the corners run counterclockwise about +z as
   seen from outside the sphere. An area around which the boundary winds several times counts as often. */
LTSH_FUNCTION float ltsh_solid_angle(ltsh_polygon unit)
{
    float real = 1.0f;
    float imaginary = 0.0f;
    int turns = 0;
    for (int i = 0; i < unit.count; ++i) {
        ltsh_vec3 total = ltsh_edge_sum(unit, i);
        float edge_real = total.z + ltsh_one_plus_cosine(total);
        float edge_imaginary = unit.corners[i].x * total.y - unit.corners[i].y * total.x;
        float next_real = real * edge_real - imaginary * edge_imaginary;
        float next_imaginary = real * edge_imaginary + imaginary * edge_real;
        /* Only the argument matters, so keep the magnitude near one. */
        float magnitude = (next_real < 0.0f ? -next_real : next_real)
            + (next_imaginary < 0.0f ? -next_imaginary : next_imaginary);
        float scale = magnitude > 0.0f ? 1.0f / magnitude : 1.0f;
        /* The argument grows by at most a quarter turn, so it passes the branch cut only from a negative real part. */
        if (real < 0.0f && imaginary >= 0.0f && edge_imaginary > 0.0f && next_imaginary < 0.0f) {
            turns += 1;
        }
        if (real < 0.0f && imaginary < 0.0f && edge_imaginary < 0.0f && next_imaginary >= 0.0f) {
            turns -= 1;
        }
        real = scale * next_real;
        imaginary = scale * next_imaginary;
    }
    if (real == 0.0f && imaginary == 0.0f) {
        return 0.0f;
    }
    return 2.0f * LTSH_ATAN2(imaginary, real) + @FOUR_PI@ * LTSH_FLOAT(turns);
}

/* The sign of the solid angle of a polygon in z >= 0, in any length unit: 1, -1 or 0. */
LTSH_FUNCTION float ltsh_orientation(ltsh_polygon polygon)
{
    float solid_angle = ltsh_solid_angle(ltsh_project_to_sphere(polygon));
    return solid_angle > 0.0f ? 1.0f : (solid_angle < 0.0f ? -1.0f : 0.0f);
}

/* The edge between two unit vectors. */
LTSH_FUNCTION ltsh_edge ltsh_edge_between(ltsh_vec3 start, ltsh_vec3 end)
{
    ltsh_edge edge;
    edge.start = start;
    edge.total = ltsh_add_scaled(start, 1.0f, end);
    /* start x end, from the difference of ends if they are close, which is exact, otherwise from their sum. */
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

/* Form factor in [0, 1] of a polygon in z >= 0: the irradiance of unit radiance divided by pi. For diffuse surfaces. */
LTSH_FUNCTION float ltsh_form_factor(ltsh_polygon polygon)
{
    float integral = ltsh_clamped_cosine_integral(ltsh_project_to_sphere(polygon));
    return @ONE_OVER_PI@ * (integral < 0.0f ? -integral : integral);
}

/* Signed integral of the clamped cosine of mass 1 around (sin(tilt), 0, cos(tilt)) over a polygon in z >= 0. */
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

/* Contribution to the mean of the k-th power from the two points of an arc at `angle` on either side of its middle. */
LTSH_FUNCTION float ltsh_arc_pair(int k, float middle, float across, float angle, float weight)
{
    float even = middle * LTSH_COS(angle);
    float odd = across * LTSH_SIN(angle);
    return weight * (ltsh_integer_power(even + odd, k) + ltsh_integer_power(even - odd, k));
}

/* Integral over the edge of the k-th power of a linear function, divided by sin(theta). The function runs from `start`
   to `total - start`. */
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
    /* For degrees above 4: Gauss-Legendre quadrature of a trigonometric polynomial, exact to rounding. */
    float cos_half = LTSH_SQRT(0.5f / edge.q);
    float sin_half = LTSH_SQRT(ltsh_larger(1.0f - 0.5f / edge.q, 0.0f));
    float half_angle = LTSH_ATAN2(sin_half, cos_half);
    float middle = 0.5f * total / cos_half;
    float across = sin_half > 0.0f ? (0.5f * total - start) / sin_half : 0.0f;
    float sum = 0.0f;
@ARC_NODES@
    return edge.phi * sum;
}

/* Contribution of an edge to the moment of the ridge direction (u_x, 0, u_z) and the power k. */
LTSH_FUNCTION float ltsh_edge_moment(ltsh_edge edge, float u_x, float u_z, int k)
{
    float start = u_x * edge.start.x + u_z * edge.start.z;
    float total = u_x * edge.total.x + u_z * edge.total.z;
    float normal = u_x * edge.normal.x + u_z * edge.normal.z;
    return normal * ltsh_arc_power(edge, k, start, total);
}

/* v under the warp [[xx, 0, xz], [0, yy, 0], [0, 0, 1]]. */
LTSH_FUNCTION ltsh_vec3 ltsh_bent(ltsh_vec3 v, float xx, float xz, float yy)
{
    return ltsh_make_vec3(xx * v.x + xz * v.z, yy * v.y, v.z);
}

/* A polygon on the sphere under that warp, projected to the sphere again. */
LTSH_FUNCTION ltsh_polygon ltsh_bent_polygon(ltsh_polygon unit, float xx, float xz, float yy)
{
    for (int i = 0; i < unit.count; ++i) {
        unit.corners[i] = ltsh_unit(ltsh_bent(unit.corners[i], xx, xz, yy));
    }
    return unit;
}

/* As ltsh_make_cell, for a sine that is known better than from a cosine close to one. Both are in [0, 1]. */
LTSH_FUNCTION ltsh_cell ltsh_make_cell_at(float cos_theta_o, float sin_theta_o, float roughness, int rows, int columns)
{
    ltsh_cell cell;
    cell.cos_theta_o = cos_theta_o;
    cell.sin_theta_o = sin_theta_o;
    cell.roughness = ltsh_clamped(roughness, 1.0f);
    /* Computed as an elevation, 1 - theta_o / 90 deg keeps its digits at grazing angles. */
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

/* Exact unpolarized Fresnel reflectance of a dielectric seen from outside; ior is at least 1. */
LTSH_FUNCTION float ltsh_dielectric_reflectance(float cosine, float ior)
{
    float g = LTSH_SQRT(ltsh_larger(ior * ior - 1.0f + cosine * cosine, 0.0f));
    float perpendicular = (g - cosine) / ltsh_larger(g + cosine, 1e-30f);
    float quotient = (cosine * (g + cosine) - 1.0f) / (cosine * (g - cosine) + 1.0f);
    return 0.5f * perpendicular * perpendicular * (1.0f + quotient * quotient);
}

/* The value clamped to the range from `least` to `most`. */
LTSH_FUNCTION float ltsh_between(float value, float least, float most)
{
    return value < least ? least : (value > most ? most : value);
}

/* Limits for integrals over the light in the tail of a lobe. In the tail the mirrored view ray misses the light by far,
   and a fitted lobe may be off by more than its value. The limits are the least and the greatest GGX BRDF times both
   cosines divided by the squared distance, at the center and the corners, times the area. Points below the horizon of
   `normal` count as 0, and in the least value those below the horizon of `second` too. Where all are above, the integral
   of a cubic polynomial over the rectangle or ellipse narrows the limits. */
LTSH_FUNCTION ltsh_limits ltsh_tail_limits(
    ltsh_vec3 normal, ltsh_vec3 second, ltsh_vec3 view, float roughness, ltsh_extent light)
{
    float mu = ltsh_dot(normal, view);
    float mirrored = 2.0f * mu * ltsh_dot(normal, light.center) - ltsh_dot(view, light.center);
    ltsh_vec3 sum = ltsh_add_scaled(light.half_u, 1.0f, light.half_v);
    ltsh_vec3 difference = ltsh_add_scaled(light.half_u, -1.0f, light.half_v);
    float radius_squared = ltsh_larger(ltsh_dot(sum, sum), ltsh_dot(difference, difference));
    float beyond = ltsh_dot(light.center, light.center) - @NEAR_SQUARED@ * radius_squared;
    ltsh_limits limits;
    limits.least = 0.0f;
    limits.most = 1e30f;
    limits.cosine = 0.0f;
    float squared = mirrored < 0.0f ? 0.0f : mirrored * mirrored;
    if (squared >= beyond || beyond <= 0.0f) {
        return limits;
    }
    float alpha = ltsh_larger(roughness * roughness, @MIN_ALPHA@);
    float alpha_squared = alpha * alpha;
    float rest = 1.0f - alpha_squared;
    float slope = LTSH_SQRT(alpha_squared + rest * mu * mu);
    float factor = -0.5f * @ONE_OVER_PI@ * alpha_squared * ltsh_dot(light.center, light.area);
    float least_half = 1.0f;
    float center_value = 0.0f;
    float sum_of_values = 0.0f;
    for (int i = 0; i < 5; ++i) {
        ltsh_vec3 along = i < 3 ? sum : difference;
        float sign = i == 0 ? 0.0f : ((i == 1 || i == 3) ? 1.0f : -1.0f);
        ltsh_vec3 offset = ltsh_add_scaled(light.center, sign, along);
        float square = ltsh_dot(offset, offset);
        float away = LTSH_SQRT(square);
        float height = ltsh_dot(normal, offset);
        float halved = square + away * ltsh_dot(view, offset);
        float middle = height + mu * away;
        float ratio = halved / (halved - 0.5f * rest * middle * middle);
        height = ltsh_larger(height, 0.0f);
        float masking = mu * LTSH_SQRT(alpha_squared * square + rest * height * height) + height * slope;
        float value = factor * ratio * ratio * height / (masking * square * away);
        float seen = ltsh_dot(second, offset) > 0.0f ? value : 0.0f;
        limits.least = i == 0 || seen < limits.least ? seen : limits.least;
        limits.most = i == 0 ? value : ltsh_larger(limits.most, value);
        center_value = i == 0 ? value : center_value;
        sum_of_values += value;
        halved = 0.5f * halved / square;
        least_half = halved < least_half ? halved : least_half;
    }
    limits.cosine = LTSH_SQRT(ltsh_larger(least_half, 0.0f));
    ltsh_vec3 across = ltsh_cross(light.half_u, light.half_v);
    float fills = LTSH_SQRT(ltsh_dot(light.area, light.area) / ltsh_larger(16.0f * ltsh_dot(across, across), 1e-30f));
    float weight = fills > 0.784f && fills < 0.787f ? 0.25f : 0.0f;
    weight = fills > 0.999f && fills < 1.001f ? @ONE_THIRD@ : weight;
    if (limits.least > 0.0f && weight > 0.0f) {
        float mean = (1.0f - 1.25f * weight) * center_value + 0.25f * weight * sum_of_values;
        float contrast = (limits.most - limits.least) / (limits.most + limits.least);
        float slack = @TAIL_SLACK@ * mean * contrast * contrast * contrast * contrast;
        limits.least = ltsh_larger(limits.least, mean - slack);
        limits.most = limits.most < mean + slack ? limits.most : mean + slack;
    }
    return limits;
}

#elif LTSH_SHARED != @VERSION@
#error headers of different versions of python -m tables export are included together
#endif
