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
#ifdef LTSH_SPECULAR
    point.view = view.w > 0.0 ? ltsh_unit(view.xyz - position.xyz) : view.xyz;
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
        seen = texelFetch(shares, ivec3(texel, i), 0).xy;
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
    color = vec4(radiance, here ? 1.0 : 0.0);
}
