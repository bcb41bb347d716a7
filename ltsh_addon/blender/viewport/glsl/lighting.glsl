#ifdef LTSH_SHADOWED
/* The four texels of the grid of visibility around a point, and their weights. Texels of the point's own surface weigh
   most. */
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

/* The specular and the diffuse share of a light that are seen; 1 without texels around the point. */
vec2 ltsh_seen(ltsh_nearby near, int light)
{
    vec2 seen = near.weights.x * texelFetch(visibility, ivec3(near.first, light), 0).xy
              + near.weights.y * texelFetch(visibility, ivec3(near.last.x, near.first.y, light), 0).xy
              + near.weights.z * texelFetch(visibility, ivec3(near.first.x, near.last.y, light), 0).xy
              + near.weights.w * texelFetch(visibility, ivec3(near.last, light), 0).xy;
    return dot(near.weights, vec4(1.0)) > 0.0 ? seen : vec2(1.0);
}
#endif

/* Sets of up to 32 lights, a bit for each, by the way in which a lobe is integrated over them. `spots`: by four spots.
   `whole`: by their edges. `cut`: by the part above horizons. `focused`: by their profile. `uneven`: not equally bright
   all over. Each way has a loop of its own, because software renderers execute both sides of a branch for every
   light. */
struct ltsh_todo { uint spots; uint whole; uint cut; uint focused; uint uneven; };

/* The same sets, reduced to the lights in `kept`. */
ltsh_todo ltsh_todo_among(ltsh_todo todo, uint kept)
{
    todo.spots &= kept;
    todo.whole &= kept;
    todo.cut &= kept;
    return todo;
}

ltsh_todo ltsh_todo_with(ltsh_todo todo, int number, bool used, ltsh_light light, bool whole, float size)
{
    uint bit = used ? 1u << uint(number) : 0u;
    bool small = whole && size < LTSH_SMALL && (light.is_round || light.first == LTSH_QUAD_FIRST);
    bool focused = (light.flags & LTSH_PROFILE_FLAG) != 0;
    todo.focused |= focused ? bit : 0u;
    bit = focused ? 0u : bit;
    todo.uneven |= (light.flags & LTSH_UNEVEN_FLAG) != 0 ? bit : 0u;
    todo.spots |= small ? bit : 0u;
    bit = small ? 0u : bit;
    todo.whole |= whole && size >= LTSH_TINY ? bit : 0u;
    todo.cut |= whole && size >= LTSH_TINY ? 0u : bit;
    return todo;
}

int ltsh_next(uint left) { return left != 0u ? findLSB(left) : 0; }

int ltsh_header(int light) { return LTSH_FIRST_LIGHT + light * LTSH_LIGHT_HEADER; }

float ltsh_area(int header, ltsh_light light)
{
    bool facing = (light.flags & LTSH_FACING_FLAG) != 0;
    return facing ? LTSH_PI * dot(light.half_u, light.half_u) : ltsh_light_texel(header + 6).z;
}

#ifdef LTSH_FACING
/* The mean factors of lights that are not equally bright all over, by their number in a draw call. */
float ltsh_factors[32];
#endif

float ltsh_factor(int number, ltsh_todo todo)
{
#ifdef LTSH_FACING
    return (todo.uneven >> uint(number) & 1u) != 0u ? ltsh_factors[number] : 1.0;
#else
    return 1.0;
#endif
}

#ifdef LTSH_SPECULAR
vec4 ltsh_limited(vec4 values, ltsh_point point, ltsh_light light, int header, vec2 profile)
{
#if !defined(LTSH_COSINE) && !defined(LTSH_BRUSHED)
    values = specular_limited(values, point, light, ltsh_area(header, light), profile);
#endif
#ifdef LTSH_BENT
    values = ltsh_bent_values(values, point, light, false);
#endif
    return values;
}
#endif

void main()
{
    ivec2 texel = ivec2(gl_FragCoord.xy);
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
#ifdef LTSH_BRUSHING
    vec4 tangent = texelFetch(tangents, texel, 0);
#ifdef LTSH_BRUSHED
    here = here && tangent.w != 0.0;
    /* The other pixels have been drawn by another shader. */
    if (!here) {
        discard;
    }
#else
    here = here && tangent.w == 0.0;
#endif
#endif
    vec3 radiance = vec3(0.0);
#if defined(LTSH_SPECULAR) || defined(LTSH_SHEEN) || defined(LTSH_ROUGH)
    point.view = view.w > 0.0 ? ltsh_unit(view.xyz - position.xyz) : view.xyz;
#endif
#ifdef LTSH_SPECULAR
    point.f0 = texelFetch(f0s, texel, 0);
    point.f90 = texelFetch(f90s, texel, 0);
    point.dielectric = texelFetch(dielectric_weights, texel, 0);
#ifdef LTSH_BRUSHED
    specular_lobe shine = specular_along(point, tangent);
    specular_weights weights = specular_width(point);
#else
    ltsh_cell cell = specular_cell(point);
    specular_lobe shine = specular_at(point, cell);
    specular_weights weights = ltsh_weights(cell, point);
#endif
    bool glossy = dot(point.normal, point.view) > 0.0;
#endif
#ifdef LTSH_DIFFUSE
    diffuse_lobe matte = diffuse_at(point, texel);
#endif
#ifdef LTSH_SHADOWED
    ltsh_nearby near = ltsh_grid_at(point);
#endif
    int count = here ? draw_range.y - draw_range.x : 0;
    ltsh_todo nothing = ltsh_todo(0u, 0u, 0u, 0u, 0u);
#ifdef LTSH_SPECULAR
    {
    ltsh_todo todo = nothing;
    int number = 0;
    do {
        int header = ltsh_header(draw_range.x + number);
        ltsh_light light = ltsh_seen_light(header, point);
        bool shines = number < count && glossy && (light.flags & LTSH_SPECULAR_FLAG) != 0;
        shines = shines && ltsh_receives(header, light, point);
        specular_view sight = specular_viewed(shine, light);
        bool used = shines && !sight.dark;
        bool is_point = used && light.is_round && sight.size < LTSH_POINT;
        is_point = is_point && (light.flags & (LTSH_PROFILE_FLAG | LTSH_PLACED_FLAG)) == 0;
        is_point = is_point && all(greaterThan(sight.height, 1e3 * (abs(sight.height_u) + abs(sight.height_v))));
        todo = ltsh_todo_with(todo, number, used && !is_point, light, sight.whole, sight.size);
        vec4 values = specular_values(weights, specular_at_center(sight, LTSH_PI));
#if !defined(LTSH_COSINE) && !defined(LTSH_BRUSHED)
        values = specular_true_in_tails(values, point, light, ltsh_area(header, light));
#endif
#ifdef LTSH_BENT
        values = ltsh_bent_values(values, point, light, true);
#endif
        float factor = 1.0;
#ifdef LTSH_FACING
        factor = ltsh_emission_at_center(header, point, light);
#endif
#ifdef LTSH_SHADOWED
        factor *= ltsh_seen(near, draw_range.x + number).x;
#endif
        vec3 reflected = factor * ltsh_reflected(point, values) * ltsh_light_texel(header + 4).xyz;
        radiance += is_point ? reflected : vec3(0.0);
    } while (++number < count);
    uint left;
@SPECULAR_LOOPS@
    }
#endif
#ifdef LTSH_DIFFUSE
    {
    ltsh_todo todo = nothing;
    uint caps = 0u;
    int number = 0;
    do {
        int header = ltsh_header(draw_range.x + number);
        ltsh_light light = ltsh_seen_light(header, point);
        bool lights_up = number < count && (light.flags & LTSH_DIFFUSE_FLAG) != 0;
        lights_up = lights_up && ltsh_receives(header, light, point);
        diffuse_view sight = diffuse_viewed(matte, light);
        bool used = lights_up && !sight.dark;
        bool is_cap = used && (light.flags & LTSH_CAP_FLAG) != 0 && diffuse_has_caps(matte, sight.whole);
        bool is_even = (light.flags & LTSH_UNEVEN_FLAG) == 0;
        caps |= is_cap ? 1u << uint(number) : 0u;
        todo = ltsh_todo_with(todo, number, used && !(is_cap && is_even), light, sight.whole, sight.size);
        float form_factor = diffuse_of_cap(matte, light);
#ifdef LTSH_SHADOWED
        form_factor *= ltsh_seen(near, draw_range.x + number).y;
#endif
        vec3 reflected = form_factor * base.xyz * ltsh_light_texel(header + 4).xyz;
        radiance += is_cap && is_even ? reflected : vec3(0.0);
    } while (++number < count);
    uint left;
@DIFFUSE_LOOPS@
    }
#endif
#ifdef LTSH_SKY
    /* The world's light is added in the draw call of the first lights. */
    vec4 mean = texelFetch(sky, ivec2(0, 0), 0);
    vec4 traits = texelFetch(sky, ivec2(1, 0), 0);
    if (here && has_sky != 0) {
        vec2 open = vec2(1.0);
#ifdef LTSH_SHADOWED
        open = ltsh_seen(near, textureSize(visibility, 0).z - 1);
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
    color = vec4(radiance, position.w > 0.0 ? 1.0 : 0.0);
}
