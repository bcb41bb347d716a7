"""First half of what does not depend on the table: the language layer, types, vectors, frames, polygons.

Names that begin with @ are filled in by `header`. Formulas and their sources stand in `shading.polygon`.
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
