/* Factors of lights that face every point, by their cone, falloff and pattern: `mean_emission` of `shading.facing`. */

#ifdef LTSH_PATTERNED
float ltsh_pattern_value(int first, int number)
{
    vec4 four = ltsh_light_texel(first + number / 4);
    int part = number % 4;
    return part == 0 ? four.x : (part == 1 ? four.y : (part == 2 ? four.z : four.w));
}

/* The factor of the light's pattern along a unit direction that meets the light, 1 without a pattern: `pattern_values`
   of `shading.facing`. The light's own center is at `offset`; `beside` leads from the center of the disk seen to the
   place on it, in units of the place's distance. */
float ltsh_pattern(int header, int flags, vec3 offset, float radius, vec3 direction, vec3 beside)
{
    int first = int(ltsh_light_texel(header + 6).w);
    vec4 row_x = ltsh_light_texel(first);
    vec4 row_y = ltsh_light_texel(first + 1);
    vec4 row_z = ltsh_light_texel(first + 2);
    float distance = max(length(offset), 1e-30);
    vec3 axis = offset / distance;
    float along = dot(direction, axis);
    vec3 across = distance > radius ? beside : direction - along * axis;
    float sine = length(across);
    /* The sine of the angle at the place on the ball, by the law of sines. */
    float ratio = clamp(sine * distance / max(radius, 1e-30), 0.0, 1.0);
    float root = sqrt(1.0 - ratio * ratio) * (distance > radius ? 1.0 : -1.0);
    vec3 normal = across * ((ratio * along - root * sine) / max(sine, 1e-20)) - (root * along + ratio * sine) * axis;
    normal = (flags & LTSH_BALL_FLAG) == 0 || row_z.w > 0.0 ? -direction : normal;
    vec3 local = vec3(dot(row_x.xyz, normal), dot(row_y.xyz, normal), dot(row_z.xyz, normal));
    ivec2 size = max(ivec2(row_y.w, ltsh_light_texel(first + 3).x), ivec2(1));
    vec2 place = vec2(0.5 * atan(local.y, local.x), atan(length(local.xy), local.z)) / LTSH_PI;
    /* The rows are the last of `row_x.w` from pole to pole. */
    place = place * vec2(float(size.x), row_x.w) - vec2(0.5, row_x.w - float(size.y) + 0.5);
    vec2 low = floor(place);
    vec2 share = place - low;
    ivec2 left = ivec2(low) + ivec2(size.x, 0);
    ivec2 columns = ivec2(left.x % size.x, (left.x + 1) % size.x);
    ivec2 rows = size.x * clamp(ivec2(left.y, left.y + 1), ivec2(0), ivec2(size.y - 1));
    vec2 above = vec2(ltsh_pattern_value(first + 4, rows.x + columns.x), ltsh_pattern_value(first + 4, rows.x + columns.y));
    vec2 below = vec2(ltsh_pattern_value(first + 4, rows.y + columns.x), ltsh_pattern_value(first + 4, rows.y + columns.y));
    float value = mix(mix(above.x, above.y, share.x), mix(below.x, below.y, share.x), share.y);
    return first > 0 ? value : 1.0;
}
#endif

/* The factor along the ray to the place center + beside on the disk that is seen. The light's own center is at
   `offset`. */
float ltsh_emission(int header, int flags, vec3 offset, vec3 center, vec3 beside)
{
    vec3 place = center + beside;
    float inverse = inversesqrt(max(dot(place, place), 1e-37));
    vec3 direction = inverse * place;
    float radius = length(ltsh_light_texel(header + 1).xyz);
    vec2 falloff = ltsh_light_texel(header + 6).xy;
    float squared = dot(offset, offset);
    bool ball = (flags & LTSH_BALL_FLAG) != 0;
    float factor = 1.0;
    if ((flags & LTSH_CONE_FLAG) != 0 && !(ball && squared <= radius * radius)) {
        int first = int(ltsh_light_texel(header).w);
        vec4 u = ltsh_light_texel(first);
        vec4 v = ltsh_light_texel(first + 1);
        vec4 w = ltsh_light_texel(first + 2);
        vec3 local = vec3(dot(u.xyz, direction), dot(v.xyz, direction), dot(w.xyz, direction));
        float cosine = local.z * inversesqrt(max(dot(local, local), 1e-37));
        float share = clamp((cosine - u.w) * v.w, 0.0, 1.0);
        factor = share * share * (3.0 - 2.0 * share);
    }
    if (falloff.x > 0.0 || falloff.y > 0.0) {
        float along = dot(offset, direction);
        float least = 1e-9 * sqrt(squared) + 1e-37;
        float rest = radius * radius - squared;
        float root = sqrt(max(rest + along * along, 0.0));
        float reach = rest < 0.0 ? -rest / max(along + root, least) : along + root;
        reach = ball ? reach : squared / max(along, least);
        float power = falloff.x < 0.5 ? 1.0 : (falloff.x < 1.5 ? reach : reach * reach);
        factor *= power * reach * reach / (reach * reach + falloff.y);
    }
#ifdef LTSH_PATTERNED
    factor *= ltsh_pattern(header, flags, offset, radius, direction, inverse * beside);
#endif
    return factor;
}

/* BRDF times cosine of a white lobe, up to constant factors: GGX, or a cosine where alpha is negative. */
float ltsh_lobe_value(vec3 normal, vec3 view, float alpha, vec3 direction)
{
    float cosine = max(dot(normal, direction), 0.0);
    if (alpha < 0.0) {
        return cosine;
    }
    vec3 half_way = view + direction;
    vec3 across = cross(normal, half_way);
    float vertical = dot(normal, half_way);
    float alpha2 = alpha * alpha;
    float horizontal = dot(across, across);
    float ratio = (horizontal + vertical * vertical) / max(horizontal + alpha2 * vertical * vertical, 1e-30);
    float facing = max(dot(normal, view), 0.0);
    float masking = facing * sqrt(cosine * cosine + alpha2 * (1.0 - cosine * cosine))
        + cosine * sqrt(facing * facing + alpha2 * (1.0 - facing * facing));
    return ratio * ratio * cosine / max(masking, 1e-30);
}

float ltsh_emission_at_center(int header, ltsh_point point, ltsh_light light)
{
    vec3 own = ltsh_light_texel(header).xyz - point.position;
    float factor = ltsh_emission(header, light.flags, own, light.offset, vec3(0.0));
    return (light.flags & LTSH_UNEVEN_FLAG) != 0 ? factor : 1.0;
}

float ltsh_mean_emission(int header, ltsh_point point, ltsh_light light, vec3 normal, float alpha, bool used)
{
    int flags = light.flags;
    vec3 own = ltsh_light_texel(header).xyz - point.position;
    /* u points toward the axis of the cone: along it the cone's factor changes most. */
    vec3 u = light.half_u;
    if ((flags & LTSH_CONE_FLAG) != 0) {
        int first = int(ltsh_light_texel(header).w);
        vec3 row_x = ltsh_light_texel(first).xyz;
        vec3 row_y = ltsh_light_texel(first + 1).xyz;
        vec3 row_z = ltsh_light_texel(first + 2).xyz;
        vec3 axis = ltsh_unit(light.offset);
        vec3 local = vec3(dot(row_x, axis), dot(row_y, axis), dot(row_z, axis));
        vec3 rise = row_z * dot(local, local) - local.z * (local.x * row_x + local.y * row_y + local.z * row_z);
        rise -= dot(rise, axis) * axis;
        u = dot(rise, rise) > 0.0 ? length(light.half_u) * ltsh_unit(rise) : u;
    }
    vec3 v = cross(light.direction, u);
    float middle = ltsh_emission(header, flags, own, light.offset, vec3(0.0));
    float least = middle;
    float most = middle;
    float rim = 0.0;
    int i = 0;
    do {
        float angle = float(i) * (LTSH_PI / 3.0);
        float value = ltsh_emission(header, flags, own, light.offset, cos(angle) * u + sin(angle) * v);
        least = min(least, value);
        most = max(most, value);
        rim += value / 6.0;
    } while (++i < 6);
    /* One more node at the point nearest to the peak of a specular lobe, which may be narrower than the gaps of the
       others. */
    float squared = max(dot(light.offset, light.offset), 1e-37);
    float inverse_size = 1.0 / max(dot(light.half_u, light.half_u), 1e-37);
    vec3 mirrored = 2.0 * dot(normal, point.view) * normal - point.view;
    float along = dot(mirrored, light.offset);
    bool ahead = alpha >= 0.0 && along > 1e-3 * sqrt(squared);
    vec3 beside = ahead ? mirrored * (squared / along) - light.offset : vec3(0.0);
    vec2 nearest = vec2(dot(beside, u), dot(beside, v)) * inverse_size;
    nearest /= max(length(nearest), 1.0);
    vec3 peak = nearest.x * u + nearest.y * v;
    float inverse_peak = inversesqrt(max(dot(light.offset + peak, light.offset + peak), 1e-37));
    bool changes = used && most - least > LTSH_CHANGING * most;
    float weights = alpha >= 0.0 ? LTSH_PEAK_WEIGHT * inverse_peak * inverse_peak * inverse_peak : 0.0;
    weights *= ltsh_lobe_value(normal, point.view, alpha, inverse_peak * (light.offset + peak));
    float total = weights * ltsh_emission(header, flags, own, light.offset, peak);
    i = 0;
    do {
        float angle = LTSH_PI * float(i + 1) / float(LTSH_NODES_ALONG + 1);
        for (int j = -1; j < 2; ++j) {
            vec3 own_place = cos(angle) * u + float(j) * 0.7745967 * sin(angle) * v;
            vec3 place = light.offset + own_place;
            float inverse = inversesqrt(dot(place, place));
            vec3 direction = inverse * place;
            float weight = sin(angle) * sin(angle) * (j == 0 ? 8.0 : 5.0) * inverse * inverse * inverse;
            weight *= ltsh_lobe_value(normal, point.view, alpha, direction);
            total += weight * ltsh_emission(header, flags, own, light.offset, own_place);
            weights += weight;
        }
    } while (++i < (changes ? LTSH_NODES_ALONG : 1));
    return changes && weights > 0.0 ? total / weights : 0.5 * (middle + rim);
}
