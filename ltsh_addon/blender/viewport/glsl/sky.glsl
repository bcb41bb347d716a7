/* The light of the world, from a texture of `sky.sky_texels`. Its mean is integrated exactly. The difference from the
   mean is sampled at points of the lobe, each averaged over the part of the map that the point stands for. */

/* The mean of the map over about this solid angle around a unit direction. `dither` in [0, 1] selects the level. */
vec3 ltsh_sky_around(vec3 direction, float solid_angle, float dither)
{
    float stretch = abs(direction.x) + abs(direction.y) + abs(direction.z);
    float texel = 4.0 * stretch * stretch * stretch / float(LTSH_SKY_SIZE * LTSH_SKY_SIZE);
    float level = 0.5 * log2(max(solid_angle / texel, 1.0)) + dither;
    int number = min(int(level), LTSH_SKY_LEVELS - 1);
    int size = LTSH_SKY_SIZE >> number;
    ivec2 corner = number == 0 ? ivec2(0, 1)
                               : ivec2(LTSH_SKY_SIZE + 2, 2 * number - 1 + LTSH_SKY_SIZE - 2 * size);
    return ltsh_sky_at(direction, corner, size);
}

#ifdef LTSH_SPECULAR
/* All directions above a normal as a light: a rectangle so large that it covers practically all of them. */
ltsh_light ltsh_whole_sky(vec3 normal)
{
    vec3 tangent = ltsh_unit(cross(normal, abs(normal.x) < 0.7 ? vec3(1.0, 0.0, 0.0) : vec3(0.0, 1.0, 0.0)));
    ltsh_light light;
    light.offset = normal;
    light.half_u = 1e4 * tangent;
    light.half_v = -1e4 * cross(normal, tangent);
    light.direction = -normal;
    light.first = LTSH_QUAD_FIRST;
    light.count = 4;
    light.flags = 0;
    light.bound = 1.01;
    light.is_round = false;
    return light;
}

vec3 ltsh_sky_specular(ltsh_point point, specular_lobe lobe, specular_weights weights, vec4 mean)
{
    ltsh_light whole = ltsh_whole_sky(point.normal);
#ifdef LTSH_BRUSHED
    ltsh_set_apex(lobe, whole);
#else
    mat3 back = inverse(transpose(mat3(lobe.row_x, lobe.row_y, lobe.row_z)));
    float stretch = abs(determinant(back));
#endif
    specular_sum all_of_it = specular_of_part(lobe, specular_viewed(lobe, whole), whole, false);
    vec4 whole_values = specular_values(weights, all_of_it);
    vec3 radiance = vec3(0.0);
#ifdef LTSH_BENT
    bool bent = ltsh_is_bent(point);
    vec2 bent_sum = vec2(0.0);
    int count = mean.w > 0.0 || bent ? LTSH_SKY_POINTS : 0;
#else
    int count = mean.w > 0.0 ? LTSH_SKY_POINTS : 0;
#endif
    for (int k = 0; k < count; ++k) {
        float squared = (float(k) + jitter.x) / float(LTSH_SKY_POINTS);
        float angle = 2.3999632 * float(k) + jitter.y;
        float height = sqrt(1.0 - squared);
        vec3 warped = vec3(sqrt(squared) * vec2(cos(angle), sin(angle)), height);
        float of_lobe = LTSH_PI / (float(LTSH_SKY_POINTS) * height);
#ifdef LTSH_BRUSHED
        vec4 values = of_lobe * ltsh_lobe_at(warped);
        vec3 h = ltsh_unit(ltsh_alphas * warped);
        float cosine = max(dot(h, ltsh_own_view), 0.0);
        float solid_angle = of_lobe / ltsh_stretching(h, cosine);
        warped = 2.0 * cosine * h - ltsh_own_view;
        vec3 direction = mat3(lobe.row_x, lobe.row_y, lobe.row_z) * warped;
#else
        vec3 direction = back * warped;
        float inverse_length = inversesqrt(max(dot(direction, direction), 1e-37));
        direction *= inverse_length;
        float solid_angle = of_lobe * stretch * inverse_length * inverse_length * inverse_length;
        vec4 values = specular_values(weights, specular_with_spot(specular_empty(), warped, -of_lobe));
#endif
        bool above = all(greaterThan(specular_heights(lobe, direction, warped, 1.0), vec3(0.0)));
#ifdef LTSH_BENT
        values.w = bent ? values.x * ltsh_bent_fresnel(point, direction) : values.w;
        bent_sum += above ? values.xw : vec2(0.0);
#endif
        vec3 picture = ltsh_sky_around(direction, solid_angle, fract(0.618034 * float(k) + jitter.x));
        radiance += above ? ltsh_reflected(point, values) * (picture - mean.rgb) : vec3(0.0);
    }
#ifdef LTSH_BENT
    whole_values.w = bent ? whole_values.x * bent_sum.y / max(bent_sum.x, 1e-30) : whole_values.w;
#endif
    return max(radiance + mean.rgb * ltsh_reflected(point, whole_values), vec3(0.0));
}
#endif

#ifdef LTSH_ROUGH
/* The difference between the light that a rough or velvet lobe reflects and that of Lambert's lobe, by points that are
   distributed as for Lambert's. */
vec3 ltsh_rough_sky(vec4 mean)
{
    vec2 terms = ltsh_rough_terms;
    vec2 all_of_it = vec2(LTSH_PI * terms.x + terms.y * rough_slope(ltsh_rough_view.x),
                          LTSH_PI * (1.0 - LTSH_PI * terms.x - 2.0 * terms.y * ltsh_mean_slope_above(0.0)));
    bool other = terms.y > 0.0;
    float lambert = 1.0;
#ifdef LTSH_VELVET
    /* For velvet the rebound is the albedo. Its lobe has no Lambertian part, so Lambert's lobe is replaced, not
       corrected. */
    other = other || ltsh_velvet > 0.0;
    lambert = ltsh_velvet > 0.0 ? 0.0 : 1.0;
    all_of_it = ltsh_velvet > 0.0 ? vec2(0.0, 1.0) : all_of_it;
#endif
    vec3 radiance = mean.rgb * (all_of_it.x + all_of_it.y * ltsh_rebound - lambert);
    int count = other && mean.w > 0.0 ? LTSH_SKY_POINTS : 0;
    for (int k = 0; k < count; ++k) {
        float squared = (float(k) + jitter.x) / float(LTSH_SKY_POINTS);
        float angle = 2.3999632 * float(k) + jitter.y;
        /* Velvet reflects most at grazing angles, so its points are uniform in height. */
        float height = lambert > 0.0 ? sqrt(1.0 - squared) : 1.0 - squared;
        vec3 local = vec3(sqrt(1.0 - height * height) * vec2(cos(angle), sin(angle)), height);
        vec3 direction = local.x * ltsh_rough_x + local.y * ltsh_rough_y + height * ltsh_rough_z;
        float solid_angle = LTSH_PI / float(LTSH_SKY_POINTS) * (lambert > 0.0 ? 1.0 / height : 2.0);
        vec2 factors = solid_angle * ltsh_diffuse_factors(height * LTSH_ONE_OVER_PI, -ltsh_diffuse_spot(direction));
        vec3 picture = ltsh_sky_around(direction, solid_angle, fract(0.618034 * float(k) + jitter.x));
        vec3 more = factors.x + factors.y * ltsh_rebound - lambert / float(LTSH_SKY_POINTS);
        radiance += more * (picture - mean.rgb);
    }
    return other ? radiance : vec3(0.0);
}
#endif

#ifdef LTSH_DIFFUSE
/* The diffuse light of the world. A second horizon takes the same share as it would from a constant world. */
vec3 ltsh_sky_diffuse(diffuse_lobe lobe, vec4 mean)
{
    diffuse_sum sum;
    sum.total = -LTSH_PI * (lobe.plane_0 + (lobe.is_spare ? lobe.plane_0 : lobe.plane_1));
#ifdef LTSH_BUMPED
    /* Both horizons are half circles around the same ends. */
    vec3 side = ltsh_make_frame(lobe.plane_0, lobe.plane_1).bitangent;
    sum.shadowed = ltsh_bump_edge(side, cross(side, lobe.plane_0)) + ltsh_bump_edge(cross(lobe.plane_1, side), side);
    sum.shadowed *= 2.0;
#endif
    vec3 light = mean.rgb;
    if (mean.w > 0.0) {
        light = ltsh_sky_at(lobe.plane_0, ivec2(0, LTSH_SKY_SIZE + 3), LTSH_IRRADIANCE_SIZE);
    }
#ifdef LTSH_ROUGH
#ifdef LTSH_VELVET
    light = ltsh_velvet > 0.0 ? vec3(0.0) : light;
#endif
    light += ltsh_rough_sky(mean);
#endif
    return light * diffuse_form_factor(lobe, sum);
}
#endif
