@SUM@
/* Axes of the warped local frame, and the normals of the horizons. */
struct specular_lobe { vec3 row_x; vec3 row_y; vec3 row_z; vec3 plane_0; vec3 plane_1; vec3 plane_2; bool is_spare; };
/* Weights of the moments by Fresnel term, and the width of the lobe in radians. */
struct specular_weights {
    float plain[LTSH_COEFFICIENTS]; float schlick[LTSH_COEFFICIENTS]; float dip[LTSH_COEFFICIENTS];
    float dielectric[LTSH_COEFFICIENTS]; float width;
};

vec3 specular_warped(specular_lobe lobe, vec3 v)
{
    return vec3(dot(lobe.row_x, v), dot(lobe.row_y, v), dot(lobe.row_z, v));
}

/* Heights of v above the horizons. The geometric horizon is left out where it equals that of the shading normal. */
vec3 specular_heights(specular_lobe lobe, vec3 v, vec3 warped, float rest)
{
#if defined(LTSH_COSINE) && defined(LTSH_GEOMETRIC)
    return vec3(warped.z, dot(lobe.plane_1, v), lobe.is_spare ? rest : dot(lobe.plane_2, v));
#elif defined(LTSH_COSINE)
    return vec3(warped.z, dot(lobe.plane_1, v), rest);
#elif defined(LTSH_GEOMETRIC)
    return vec3(warped.z, lobe.is_spare ? rest : dot(lobe.plane_1, v), rest);
#else
    return vec3(warped.z, rest, rest);
#endif
}

@INTEGRAL@
vec4 ltsh_table_at(ltsh_cell cell, int layer)
{
    ivec3 node = ivec3(cell.node % LTSH_COLUMNS, cell.node / LTSH_COLUMNS, layer);
    vec4 first = texelFetch(table, node, 0);
    first += cell.column_weight * (texelFetch(table, node + ivec3(1, 0, 0), 0) - first);
    vec4 second = texelFetch(table, node + ivec3(0, 1, 0), 0);
    second += cell.column_weight * (texelFetch(table, node + ivec3(1, 1, 0), 0) - second);
    return first + cell.row_weight * (second - first);
}

specular_sum ltsh_curve_at(ltsh_cell cell, int curve)
{
    int layer = 1 + curve * LTSH_BLOCKS;
    specular_sum weights = specular_empty();
@FETCHES@
    return weights;
}

/* A texel of `light_texels.dielectric_texels`: weights of curves for a dielectric. */
vec4 ltsh_dielectric_texel(float position, int column)
{
    int last = textureSize(dielectrics, 0).y - 1;
    int row = min(int(position), last);
    vec4 near = texelFetch(dielectrics, ivec2(column, row), 0);
    vec4 far = texelFetch(dielectrics, ivec2(column, min(row + 1, last)), 0);
    return near + (position - float(row)) * (far - near);
}

specular_weights ltsh_weights(ltsh_cell cell, ltsh_point point)
{
    specular_weights w;
    for (int k = 0; k < LTSH_COEFFICIENTS; ++k) {
        w.plain[k] = 0.0;
        w.schlick[k] = 0.0;
        w.dip[k] = 0.0;
        w.dielectric[k] = 0.0;
    }
    vec3 dip = vec3(point.f0.w, point.f90.w, point.dielectric.w);
    bool dipped = any(notEqual(dip, vec3(0.0)));
    bool metal = dipped || any(notEqual(point.f0.xyz, vec3(0.0))) || any(notEqual(point.f90.xyz, vec3(0.0)));
    bool coated = any(notEqual(point.dielectric.xyz, vec3(0.0)));
    float last = float(textureSize(dielectrics, 0).y - 1);
    float position = ltsh_clamped((point.ior - 1.0) * LTSH_IOR_STEPS, last);
    vec4 first_shares = ltsh_dielectric_texel(position, 0);
    vec4 last_shares = ltsh_dielectric_texel(position, 1);
    int count = coated ? LTSH_CURVES : (metal ? (dipped ? 3 : 2) : 0);
    for (int i = 0; i < count; ++i) {
        vec4 four = i < 4 ? first_shares : last_shares;
        int component = i % 4;
        float part = component == 0 ? four.x : (component == 1 ? four.y : (component == 2 ? four.z : four.w));
        vec4 share = vec4(i == 0 ? 1.0 : 0.0, i == 1 ? 1.0 : 0.0, i == 2 ? 1.0 : 0.0, coated ? part : 0.0);
        specular_sum values = ltsh_curve_at(cell, i);
@TERMS@
    }
    w.width = max(point.roughness, LTSH_LEAST_ROUGHNESS) * max(point.roughness, LTSH_LEAST_ROUGHNESS);
    return w;
}

ltsh_cell specular_cell(ltsh_point point)
{
    ltsh_frame frame = ltsh_make_frame(point.normal, point.view);
    float cosine = ltsh_clamped(dot(point.normal, point.view), 1.0);
    float sine = ltsh_clamped(dot(frame.tangent, point.view - point.normal), 1.0);
    return ltsh_make_cell_at(cosine, sine, point.roughness, LTSH_ROWS, LTSH_COLUMNS);
}

specular_lobe specular_at(ltsh_point point, ltsh_cell cell)
{
    ltsh_frame frame = ltsh_make_frame(point.normal, point.view);
    vec4 entries = ltsh_table_at(cell, 0);
    ltsh_warp warp = ltsh_make_warp(cell, entries.x, entries.y, entries.z, 0.0);
    specular_lobe lobe;
    lobe.row_x = warp.xx * frame.tangent + warp.xz * frame.normal;
    lobe.row_y = warp.yy * frame.bitangent;
    lobe.row_z = warp.zz * frame.normal;
#ifdef LTSH_COSINE
    float sine = sin(entries.w);
    float cosine = cos(entries.w);
    vec3 toward = sine * lobe.row_x + cosine * lobe.row_z;
    lobe.row_x = cosine * lobe.row_x - sine * lobe.row_z;
    lobe.row_z = toward;
#endif
    lobe.plane_1 = vec3(0.0);
    lobe.plane_2 = vec3(0.0);
    lobe.is_spare = true;
    lobe.plane_0 = ltsh_unit(lobe.row_z);
#ifdef LTSH_COSINE
    lobe.plane_1 = point.normal;
#endif
#ifdef LTSH_GEOMETRIC
#ifdef LTSH_COSINE
    lobe.plane_2 = point.geometric;
#else
    lobe.plane_1 = point.geometric;
#endif
    lobe.is_spare = ltsh_is_same(point.geometric, point.normal);
#endif
    return lobe;
}

float ltsh_product(float weights[LTSH_COEFFICIENTS], specular_sum sum)
{
    float product = 0.0;
    for (int k = 0; k < LTSH_COEFFICIENTS; ++k) {
        product += weights[k] * sum.values[k];
    }
    /* Corners run clockwise as seen from the point. */
    return max(-product, 0.0);
}

/* Integrals of the plain, the Schlick, the dip and the dielectric term. */
vec4 specular_values(specular_weights weights, specular_sum sum)
{
    sum = specular_finished(sum);
    float plain = ltsh_product(weights.plain, sum);
#ifndef LTSH_COSINE
    /* The lower limit of `lobes.LEAST_SHARE`: the third moment is twice the integral of z. */
    plain = max(plain, -LTSH_LEAST_OF_COSINE * sum.values[2]);
#endif
    float dielectric = ltsh_product(weights.dielectric, sum);
    return vec4(plain, ltsh_product(weights.schlick, sum), ltsh_product(weights.dip, sum), dielectric);
}

#ifndef LTSH_COSINE
/* The values within their limits, as by `tails.TailLimits.apply`; `profile` is the range of the light's profile. */
vec4 specular_limited(vec4 values, ltsh_point point, ltsh_light light, float area, vec2 profile)
{
    ltsh_extent extent;
    extent.center = light.offset;
    extent.half_u = light.half_u;
    extent.half_v = light.half_v;
    extent.area = area * light.direction;
    ltsh_limits limits = ltsh_tail_limits(point.normal, point.geometric, point.view, point.roughness, extent);
    float ior = max(point.ior, 1.0);
    float complement = 1.0 - limits.cosine;
    float squared = complement * complement;
    float between = ltsh_between(values.x, profile.x * limits.least, profile.y * limits.most);
    values.x = values.x > 0.0 ? between : values.x;
    values.y = min(values.y, squared * squared * complement * values.x);
    values.w = min(values.w, ltsh_dielectric_reflectance(limits.cosine, ior) * values.x);
    values.w = max(values.w, ltsh_dielectric_reflectance(1.0, ior) * values.x);
    return values;
}
#endif

#ifndef LTSH_COSINE
/* The same for lights so small that their center stands for all of them; exact in the tail of the lobe. */
vec4 specular_true_in_tails(vec4 values, ltsh_point point, ltsh_light light, float area)
{
    float squared = dot(light.offset, light.offset);
    float away = sqrt(squared);
    float height = dot(point.normal, light.offset);
    float seen = dot(point.view, light.offset);
    float mu = dot(point.normal, point.view);
    float mirrored = max(2.0 * mu * height - seen, 0.0);
    vec3 sum = light.half_u + light.half_v;
    vec3 difference = light.half_u - light.half_v;
    float radius2 = max(dot(sum, sum), dot(difference, difference));
    bool tail = mirrored * mirrored < squared - LTSH_NEAR_SQUARED * radius2;
    float alpha = max(point.roughness * point.roughness, LTSH_MIN_ALPHA);
    float alpha2 = alpha * alpha;
    float halved = squared + away * seen;
    float middle = height + mu * away;
    float ratio = halved / (halved - 0.5 * (1.0 - alpha2) * middle * middle);
    height = max(height, 0.0);
    float masking = mu * sqrt(alpha2 * squared + (1.0 - alpha2) * height * height)
        + height * sqrt(alpha2 + (1.0 - alpha2) * mu * mu);
    float value = -0.5 * LTSH_ONE_OVER_PI * alpha2 * area * dot(light.offset, light.direction);
    value *= ratio * ratio * height / (masking * squared * away);
    float cosine = sqrt(clamp(0.5 * halved / squared, 0.0, 1.0));
    float ior = max(point.ior, 1.0);
    values.x = tail && values.x > 0.0 ? value : values.x;
    cosine = tail ? cosine : 0.0;
    float complement = 1.0 - cosine;
    float fourth = complement * complement * complement * complement;
    values.y = min(values.y, fourth * complement * values.x);
    values.w = min(values.w, ltsh_dielectric_reflectance(cosine, ior) * values.x);
    values.w = max(values.w, ltsh_dielectric_reflectance(1.0, ior) * values.x);
    return values;
}
#endif

@FOCUSED@
