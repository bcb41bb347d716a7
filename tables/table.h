/* @ABOUT@ */
/* The numbers are in the public domain (SPDX-License-Identifier: CC0-1.0). The code (SPDX-License-Identifier: MIT):

   Copyright 2026 LTSH contributors

   Permission is hereby granted, free of charge, to any person obtaining a copy of this software and associated
   documentation files (the "Software"), to deal in the Software without restriction, including without limitation the
   rights to use, copy, modify, merge, publish, distribute, sublicense, and/or sell copies of the Software, and to permit
   persons to whom the Software is furnished to do so, subject to the following conditions:

   The above copyright notice and this permission notice shall be included in all copies or substantial portions of the
   Software.

   THE SOFTWARE IS PROVIDED "AS IS", WITHOUT WARRANTY OF ANY KIND, EXPRESS OR IMPLIED, INCLUDING BUT NOT LIMITED TO THE
   WARRANTIES OF MERCHANTABILITY, FITNESS FOR A PARTICULAR PURPOSE AND NONINFRINGEMENT. IN NO EVENT SHALL THE AUTHORS OR
   COPYRIGHT HOLDERS BE LIABLE FOR ANY CLAIM, DAMAGES OR OTHER LIABILITY, WHETHER IN AN ACTION OF CONTRACT, TORT OR
   OTHERWISE, ARISING FROM, OUT OF OR IN CONNECTION WITH THE SOFTWARE OR THE USE OR OTHER DEALINGS IN THE SOFTWARE. */
#ifndef @PREFIX@_TABLE
#define @PREFIX@_TABLE 1

#if !defined(LTSH_GLSL) && (defined(GL_core_profile) || defined(GL_compatibility_profile) || defined(GL_ES))
#define LTSH_GLSL 1
#endif
#if !defined(LTSH_HLSL) && defined(__HLSL_VERSION)
#define LTSH_HLSL 1
#endif
#if (defined(LTSH_GLSL) || defined(LTSH_HLSL)) && !defined(@PREFIX@_DATA)
#error define @PREFIX@_DATA(index), which fetches one float of the data, before this header is included
#endif

@CORE@
@CONSTANTS@
@if sheen
struct @prefix@_lobe { float albedo; float a; float b; };
#ifndef LTSH_SHADER
typedef struct @prefix@_lobe @prefix@_lobe;
@else
struct @prefix@_coefficients { float values[@PREFIX@_COEFFICIENTS]; };
struct @prefix@_weights { float values[@PREFIX@_COEFFICIENTS]; };
struct @prefix@_moments { float values[@PREFIX@_COEFFICIENTS]; };
#ifndef LTSH_SHADER
typedef struct @prefix@_coefficients @prefix@_coefficients;
typedef struct @prefix@_weights @prefix@_weights;
typedef struct @prefix@_moments @prefix@_moments;
@end
#ifndef @PREFIX@_DATA
LTSH_FUNCTION float @prefix@_data_at(int index);
#define @PREFIX@_DATA(index) @prefix@_data_at(index)
#define @PREFIX@_DATA_FOLLOWS 1
#endif
#endif

/* The cell of the table at cos_theta_o and roughness, both clamped to [0, 1]. */
LTSH_FUNCTION ltsh_cell @prefix@_cell(float cos_theta_o, float roughness)
{
@if spline
    return ltsh_make_cell(cos_theta_o, roughness, @PREFIX@_ROWS - 2, @PREFIX@_COLUMNS - 2);
}

/* Weight of coefficient `tap` = 0 .. 3 of the cubic B-spline, a share of 0 to 1 after coefficient 1. */
LTSH_FUNCTION float @prefix@_tap_weight(int tap, float share)
{
    float rest = 1.0f - share;
    float cube = tap < 2 ? rest : share;
    float other = tap < 2 ? share : rest;
    return (tap == 0 || tap == 3 ? cube * cube * cube : 1.0f + 3.0f * cube * (1.0f + cube * other)) * @SIXTH@;
}

/* One channel, of 4 x 4 coefficients. */
LTSH_FUNCTION float @prefix@_channel(ltsh_cell cell, int channel)
{
    int row = cell.node / (@PREFIX@_COLUMNS - 2);
    int corner = cell.node + 2 * row;
    float sum = 0.0f;
    for (int i = 0; i < 4; ++i) {
        float along = 0.0f;
        for (int j = 0; j < 4; ++j) {
            int at = (corner + i * @PREFIX@_COLUMNS + j) * @PREFIX@_CHANNELS + channel;
            along += @prefix@_tap_weight(j, cell.column_weight) * @PREFIX@_DATA(at);
        }
        sum += @prefix@_tap_weight(i, cell.row_weight) * along;
    }
    return sum;
}
@else
    return ltsh_make_cell(cos_theta_o, roughness, @PREFIX@_ROWS, @PREFIX@_COLUMNS);
}

/* One channel, interpolated bilinearly. */
LTSH_FUNCTION float @prefix@_channel(ltsh_cell cell, int channel)
{
    int lower = cell.node * @PREFIX@_CHANNELS + channel;
    int upper = lower + @PREFIX@_COLUMNS * @PREFIX@_CHANNELS;
    float share = cell.column_weight;
    float first = @PREFIX@_DATA(lower) * (1.0f - share) + @PREFIX@_DATA(lower + @PREFIX@_CHANNELS) * share;
    float second = @PREFIX@_DATA(upper) * (1.0f - share) + @PREFIX@_DATA(upper + @PREFIX@_CHANNELS) * share;
    return first * (1.0f - cell.row_weight) + second * cell.row_weight;
}
@end

@if sheen
/* Sheen at the cosine and roughness of a cell: BRDF times cosine = albedo z / pi (a / ((a x + b z)^2 + (a y)^2 + z^2))^2. */
LTSH_FUNCTION @prefix@_lobe @prefix@_lookup(ltsh_cell cell)
{
    @prefix@_lobe lobe;
    lobe.albedo = ltsh_larger(@prefix@_channel(cell, 0), 0.0f);
    lobe.a = ltsh_larger(@prefix@_channel(cell, 1), @LEAST_A@);
    lobe.b = @prefix@_channel(cell, 2);
    return lobe;
}

/* BRDF times cosine in sr^-1 at a unit direction; 0 below the horizon. */
LTSH_FUNCTION float @prefix@_evaluate_lobe(@prefix@_lobe lobe, ltsh_vec3 direction)
{
    float x = lobe.a * direction.x + lobe.b * direction.z;
    float y = lobe.a * direction.y;
    float ratio = lobe.a / (x * x + y * y + direction.z * direction.z);
    return @ONE_OVER_PI@ * lobe.albedo * ltsh_larger(direction.z, 0.0f) * ratio * ratio;
}

/* Integral of the lobe over a polygon in z >= 0. Either winding; never negative. */
LTSH_FUNCTION float @prefix@_integral(@prefix@_lobe lobe, ltsh_polygon polygon)
{
    for (int i = 0; i < polygon.count; ++i) {
        ltsh_vec3 corner = polygon.corners[i];
        polygon.corners[i] = ltsh_make_vec3(lobe.a * corner.x + lobe.b * corner.z, lobe.a * corner.y, corner.z);
    }
    return lobe.albedo * ltsh_form_factor(polygon);
}

/* Integral over the part of a polygon above the horizon. Either winding; never negative. */
LTSH_FUNCTION float @prefix@_integrate_polygon(float cos_theta_o, float roughness, ltsh_polygon polygon)
{
    return @prefix@_integral(@prefix@_lookup(@prefix@_cell(cos_theta_o, roughness)), ltsh_clip_to_horizon(polygon));
}
@else
/* The warp. Its numbers are the first channels; @PREFIX@_COEFFICIENTS for every curve follow. */
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

/* Linear interpolation between `count` values `stride` apart, at a position from 0 to count - 1. */
LTSH_FUNCTION float @prefix@_interpolated(int offset, int stride, int count, float position)
{
    float clamped = ltsh_clamped(position, LTSH_FLOAT(count - 1));
    int index = LTSH_INT(clamped);
    int following = index + 1 < count ? index + 1 : index;
    float share = clamped - LTSH_FLOAT(index);
    return @PREFIX@_DATA(offset + index * stride) * (1.0f - share) + @PREFIX@_DATA(offset + following * stride) * share;
}

/* Position of an index of refraction among the tabulated ones, clamped to their range. */
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

/* The Fresnel curve itself, at a cosine of the half angle in [0, 1]. */
LTSH_FUNCTION float @prefix@_fresnel_curve(int curve, float cosine)
{
    int offset = @PREFIX@_FRESNEL_OFFSET + curve * @PREFIX@_COSINE_COUNT;
    float position = ltsh_clamped(cosine, 1.0f) * LTSH_FLOAT(@PREFIX@_COSINE_COUNT - 1);
    return @prefix@_interpolated(offset, 1, @PREFIX@_COSINE_COUNT, position);
}

/* Directional albedo of a curve averaged over the hemisphere: the integral of 2 mu albedo(mu) over mu in [0, 1]. */
LTSH_FUNCTION float @prefix@_average_albedo(float roughness, int curve)
{
    float position = ltsh_clamped(roughness, 1.0f) * LTSH_FLOAT(@PREFIX@_ROWS - 1);
    return @prefix@_interpolated(@PREFIX@_AVERAGE_ALBEDO_OFFSET + curve, @PREFIX@_CURVES, @PREFIX@_ROWS, position);
}

/* Weights of the moments of a polygon. Compute them once per coefficient vector, for any number of lights. */
LTSH_FUNCTION @prefix@_weights @prefix@_moment_weights(@prefix@_coefficients coefficients)
{
    @prefix@_weights weights;
@if ltsh
@WEIGHT_LINES@
@else
    weights.values[0] = coefficients.values[0];
@end
    return weights;
}

/* Moments of a polygon in z >= 0 under the warp. Compute them once per light, for any number of coefficient vectors. */
LTSH_FUNCTION @prefix@_moments @prefix@_polygon_moments(ltsh_warp warp, ltsh_polygon polygon)
{
@if ltsh
    ltsh_polygon unit = ltsh_project_to_sphere(ltsh_warped_polygon(warp, polygon));
    @prefix@_moments moments;
    for (int k = 0; k < @PREFIX@_COEFFICIENTS; ++k) {
        moments.values[k] = 0.0f;
    }
    moments.values[0] = ltsh_solid_angle(unit);@BENT_POLYGON@
    for (int i = 0; i < unit.count; ++i) {
        ltsh_edge edge = ltsh_make_edge(unit, i);
@MOMENT_LINES@
    }
@else
    @prefix@_moments moments;
    moments.values[0] = ltsh_tilted_cosine_integral(ltsh_warped_polygon(warp, polygon), warp.tilt);
@end
    return moments;
}

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
@if ltsh
@EXPANSION_LINES@
@else
    float toward_axis = LTSH_SIN(warp.tilt) * unit.x + LTSH_COS(warp.tilt) * unit.z;
    float original = coefficients.values[0] * ltsh_larger(toward_axis, 0.0f) * @ONE_OVER_PI@;
@end
    return original * (warp.xx / size) * (warp.yy / size) * (warp.zz / size);
}

/* Directional albedo of a curve: the integral of its lobe over the hemisphere. */
LTSH_FUNCTION float @prefix@_albedo(ltsh_cell cell, int curve)
{
@if ltsh
    @prefix@_coefficients coefficients = @prefix@_lookup_curve(cell, curve);
    return @ALBEDO@;
@else
    float tilt = @prefix@_channel(cell, @PREFIX@_PARAMETERS - 1);
    return @prefix@_lookup_curve(cell, curve).values[0] * (0.5f + 0.5f * LTSH_COS(tilt));
@end
}

/* Signed integral of a lobe over a polygon. It is positive if the corners run counterclockwise about +z as seen from
   outside the unit sphere. */
LTSH_FUNCTION float @prefix@_integral(@prefix@_weights weights, @prefix@_moments moments)
{
    float sum = 0.0f;
    for (int k = 0; k < @PREFIX@_COEFFICIENTS; ++k) {
        sum += weights.values[k] * moments.values[k];
    }
    return sum;
}

/* Integral of the lobe for F = 1 over the part of a polygon above the horizon. Either winding; never negative. */
LTSH_FUNCTION float @prefix@_integrate_polygon(float cos_theta_o, float roughness, ltsh_polygon polygon)
{
    ltsh_polygon visible = ltsh_clip_to_horizon(polygon);
    ltsh_cell cell = @prefix@_cell(cos_theta_o, roughness);
    @prefix@_moments moments = @prefix@_polygon_moments(@prefix@_lookup_warp(cell), visible);
    @prefix@_weights weights = @prefix@_moment_weights(@prefix@_lookup_curve(cell, 0));
    return ltsh_larger(ltsh_orientation(visible) * @prefix@_integral(weights, moments), 0.0f);
}

/* Integral for F = 1 for shading, from the weights of curve 0; `orientation` is ltsh_orientation of the polygon. It is
   at least a share of the integral of a clamped cosine, because in its tail a fit may be off by more than the lobe. */
LTSH_FUNCTION float @prefix@_plain_integral(@prefix@_weights plain, @prefix@_moments moments, float orientation)
{
    float integral = ltsh_larger(orientation * @prefix@_integral(plain, moments), 0.0f);
@if ltsh
    integral = ltsh_larger(orientation * @LEAST_OF_COSINE@ * moments.values[2], integral);
@else
@end
    return integral;
}

/* The same for a dielectric of index of refraction `ior`, from the weights of its coefficients and the integral for
   F = 1. It is bounded below because no dielectric reflects less than head on. */
LTSH_FUNCTION float @prefix@_dielectric_integral(
    @prefix@_weights dielectric, @prefix@_moments moments, float orientation, float ior, float plain_integral)
{
    float least = @PREFIX@_DATA(@PREFIX@_IOR_OFFSET);
    float most = @PREFIX@_DATA(@PREFIX@_IOR_OFFSET + @PREFIX@_IOR_COUNT - 1);
    float index = least + ltsh_clamped(ior - least, most - least);
    float root = (index - 1.0f) / (index + 1.0f);
    return ltsh_larger(orientation * @prefix@_integral(dielectric, moments), root * root * plain_integral);
}
@end

/* GLSL and HLSL may end here, with the #endif of the last line. What follows is for C and C++ only. */
#ifdef @PREFIX@_DATA_FOLLOWS
static const float @prefix@_data[@PREFIX@_DATA_COUNT] = {
@VALUES@
};

LTSH_FUNCTION float @prefix@_data_at(int index) { return @prefix@_data[index]; }
#endif
#endif
