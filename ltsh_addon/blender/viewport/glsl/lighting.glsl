#ifdef LTSH_SHADOWED
/* The texels of the grid of shares around a point, and how much each counts: those of its own surface, where there are
   any. */
struct ltsh_nearby { ivec2 first; ivec2 last; vec4 weights; };

ltsh_nearby ltsh_grid_at(ltsh_point point)
{
    vec4 clip = grid * vec4(point.position, 1.0);
    ivec2 size = textureSize(grid_positions, 0);
    vec2 at = (0.5 + 0.5 * clip.xy / clip.w) * vec2(size) - 0.5;
    at = clamp(at, vec2(0.0), vec2(size - 1));
    vec2 low = floor(at), share = at - low;
    ltsh_nearby near;
    near.first = ivec2(low);
    near.last = min(near.first + 1, size - 1);
    near.weights = vec4((1.0 - share.x) * (1.0 - share.y), share.x * (1.0 - share.y), (1.0 - share.x) * share.y,
                        share.x * share.y);
    for (int k = 0; k < 4; ++k) {
        ivec2 place = ivec2((k & 1) == 0 ? near.first.x : near.last.x, k < 2 ? near.first.y : near.last.y);
        vec4 other = texelFetch(grid_positions, place, 0);
        vec3 way = other.xyz - point.position;
        float off = abs(dot(way, point.geometric)) / max(0.2 * sqrt(dot(way, way)), 1e-6 * abs(clip.w));
        near.weights[k] *= other.w > 0.0 ? max(exp(-off * off), 1e-4) : 0.0;
    }
    float all = dot(near.weights, vec4(1.0));
    near.weights = all > 0.0 && clip.w > 0.0 ? near.weights / all : vec4(0.0);
    return near;
}

/* The shares of a light that are seen, specular and diffuse. */
vec2 ltsh_seen(ltsh_nearby near, int light)
{
    vec2 seen = near.weights.x * texelFetch(shares, ivec3(near.first, light), 0).xy
              + near.weights.y * texelFetch(shares, ivec3(near.last.x, near.first.y, light), 0).xy
              + near.weights.z * texelFetch(shares, ivec3(near.first.x, near.last.y, light), 0).xy
              + near.weights.w * texelFetch(shares, ivec3(near.last, light), 0).xy;
    return dot(near.weights, vec4(1.0)) > 0.0 ? seen : vec2(1.0);
}
#endif

void main()
{
    ivec2 texel = ivec2(gl_FragCoord.xy) - place.xy;
    vec4 position = texelFetch(positions, texel, 0);
    vec4 normal = texelFetch(normals, texel, 0);
    vec4 base = texelFetch(bases, texel, 0);
    ltsh_point point;
    point.position = position.xyz;
    point.receiver = position.w - 1.0;
    point.normal = normal.xyz;
    point.roughness = normal.w;
    point.ior = base.w;
#ifdef LTSH_GEOMETRIC
    point.geometric = texelFetch(geometric_normals, texel, 0).xyz;
#else
    point.geometric = point.normal;
#endif
    bool here = position.w > 0.0;
    vec3 radiance = vec3(0.0);
#if defined(LTSH_SPECULAR) || defined(LTSH_SHEEN)
    point.view = view.w > 0.0 ? ltsh_unit(view.xyz - position.xyz) : view.xyz;
#endif
#ifdef LTSH_SPECULAR
    point.f0 = texelFetch(f0s, texel, 0);
    point.f90 = texelFetch(f90s, texel, 0);
    point.dielectric = texelFetch(dielectric_weights, texel, 0);
    ltsh_cell cell = specular_cell(point);
    specular_lobe shine = specular_at(point, cell);
    specular_weights weights = ltsh_weights(cell, point);
    bool glossy = dot(point.normal, point.view) > 0.0;
#endif
#ifdef LTSH_DIFFUSE
    diffuse_lobe matte = diffuse_at(point, texel);
#endif
#ifdef LTSH_SHADOWED
    ltsh_nearby near = ltsh_grid_at(point);
#endif
    int end = here ? place.w : 0;
    for (int i = place.z; i < end; ++i) {
        int header = LTSH_FIRST_LIGHT + i * LTSH_LIGHT_HEADER;
        int flags = int(ltsh_light_texel(header + 2).w);
        bool received = ltsh_receives(header, point);
#ifdef LTSH_FOCUSED
        bool focused = ltsh_light_texel(header + 5).x > 0.0;
#else
        bool focused = false;
#endif
        vec3 reflected = vec3(0.0);
        vec2 seen = vec2(1.0);
#ifdef LTSH_SHADOWED
        seen = ltsh_seen(near, i);
#endif
#ifdef LTSH_SPECULAR
        ltsh_light shining = ltsh_seen_light(header, point, weights.width);
        bool shines = received && glossy && (flags & LTSH_SPECULAR_FLAG) != 0;
        shining.count = shines && !focused ? shining.count : 0;
        shining.whole_count = shines && !focused ? shining.whole_count : 0;
        vec4 values = specular_values(weights, specular_integral(shine, shining));
#ifdef LTSH_FOCUSED
        shining = ltsh_seen_light(header, point, weights.width);
        values += specular_focused(shine, weights, shining, header, weights.width, shines && focused);
#endif
#ifndef LTSH_COSINE
        vec2 profile = vec2(1.0);
#ifdef LTSH_FOCUSED
        profile = focused ? ltsh_range_of_profile(shining, header) : profile;
#endif
        float area = ltsh_light_texel(header + 6).z;
        area = (flags & LTSH_FACING_FLAG) != 0 ? LTSH_PI * dot(shining.half_u, shining.half_u) : area;
        values = specular_limited(values, point, shining, area, profile);
#endif
#ifdef LTSH_FACING
        values *= shines ? ltsh_mean_emission(header, point, shining, point.normal, weights.width) : 1.0;
#endif
        reflected += seen.x * ltsh_reflected(point, values);
#endif
#ifdef LTSH_DIFFUSE
        ltsh_light lighting = ltsh_seen_light(header, point, 1.0);
        bool lights_up = received && (flags & LTSH_DIFFUSE_FLAG) != 0;
        lighting.count = lights_up && !focused ? lighting.count : 0;
        lighting.whole_count = lights_up && !focused ? lighting.whole_count : 0;
        float form_factor = diffuse_form_factor(matte, diffuse_integral(matte, lighting));
#ifdef LTSH_FOCUSED
        lighting = ltsh_seen_light(header, point, 1.0);
        form_factor += diffuse_focused(matte, lighting, header, 1.0, lights_up && focused).x;
#endif
#ifdef LTSH_FACING
        form_factor *= lights_up ? ltsh_mean_emission(header, point, lighting, matte.plane_0, -1.0) : 1.0;
#endif
        reflected += seen.y * form_factor * base.xyz;
#endif
        radiance += reflected * ltsh_light_texel(header + 4).xyz;
    }
#ifdef LTSH_SKY
    /* It comes with the first lights. */
    vec4 mean = texelFetch(sky, ivec2(0, 0), 0);
    vec4 traits = texelFetch(sky, ivec2(1, 0), 0);
    if (here && place.z == 0) {
        vec2 open = vec2(1.0);
#ifdef LTSH_SHADOWED
        open = ltsh_seen(near, textureSize(shares, 0).z - 1);
#endif
#ifdef LTSH_SPECULAR
        if (glossy && traits.x > 0.0) {
            radiance += open.x * ltsh_sky_specular(point, shine, weights, mean);
        }
#endif
#ifdef LTSH_DIFFUSE
        if (traits.y > 0.0) {
            radiance += open.y * ltsh_sky_diffuse(matte, mean) * base.xyz;
        }
#endif
    }
#endif
    color = vec4(radiance, here ? 1.0 : 0.0);
}
