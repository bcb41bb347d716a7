/* Which horizon ends the specular lobe of a pixel, as `cycles.horizons` decides for samples.

   Three steps, of which the first two add up over draw calls so that lights may be many: how bright the lights are from
   the pixel, what only one of both horizons lets through of the directions that the lobe and the lights choose, and
   which normal that gives. */

#ifndef LTSH_CHOICE
/* A light as seen from a point; its corners are center + s * half_u + t * half_v. */
struct seen_light {
    vec3 offset; vec3 half_u; vec3 half_v; vec3 direction; int first; int count; float radiance; bool faces;
};

seen_light light_from(int number, vec3 position)
{
    int header = LTSH_FIRST_LIGHT + number * LTSH_LIGHT_HEADER;
    vec4 center = ltsh_light_texel(header);
    vec4 half_u = ltsh_light_texel(header + 1);
    vec3 radiance = abs(ltsh_light_texel(header + 4).xyz);
    seen_light light;
    light.offset = center.xyz - position;
    light.half_u = half_u.xyz;
    light.half_v = ltsh_light_texel(header + 2).xyz;
    light.direction = ltsh_light_texel(header + 3).xyz;
    light.count = half_u.w > 0.0 ? int(half_u.w) : LTSH_ROUND_CORNERS;
    light.first = half_u.w > 0.0 ? int(center.w) : LTSH_ROUND_FIRST;
    light.radiance = radiance.x + radiance.y + radiance.z;
    light.faces = dot(light.offset, light.direction) < 0.0;
    return light;
}

/* Does it matter for the pixel which horizon counts? */
bool has_two_horizons(ivec2 texel)
{
    vec3 apart = abs(texelFetch(smooth_normals, texel, 0).xyz - texelFetch(geometric_normals, texel, 0).xyz);
    bool reflects = any(notEqual(texelFetch(f90s, texel, 0).xyz, vec3(0.0)))
        || any(notEqual(texelFetch(dielectric_weights, texel, 0).xyz, vec3(0.0)));
    return texelFetch(positions, texel, 0).w > 0.0 && reflects
        && max(max(apart.x, apart.y), apart.z) > LTSH_SMALLEST_ANGLE;
}
#endif

#ifdef LTSH_BRIGHTNESS
/* Van Oosterom and Strackee 1983, eq. 8; the volumes are those of a pyramid, exact for small lights, too. */
float solid_angle(seen_light light)
{
    float height = dot(light.offset, cross(light.half_u, light.half_v));
    vec2 start = ltsh_corner(light.first);
    vec3 a = light.offset + start.x * light.half_u + start.y * light.half_v;
    float far_a = length(a);
    vec2 before = ltsh_corner(light.first + 1) - start;
    float total = 0.0;
    for (int i = 2; i < light.count; ++i) {
        vec2 after = ltsh_corner(light.first + i) - start;
        vec3 b = a + before.x * light.half_u + before.y * light.half_v;
        vec3 c = a + after.x * light.half_u + after.y * light.half_v;
        float far_b = length(b);
        float far_c = length(c);
        float volume = height * (before.x * after.y - before.y * after.x);
        float below = far_a * far_b * far_c + dot(a, b) * far_c + dot(b, c) * far_a + dot(c, a) * far_b;
        total += abs(volume) > 0.0 || abs(below) > 0.0 ? 2.0 * atan(volume, below) : 0.0;
        before = after;
    }
    return light.faces ? abs(total) : 0.0;
}

void main()
{
    ivec2 texel = ivec2(gl_FragCoord.xy);
    vec3 position = texelFetch(positions, texel, 0).xyz;
    int end = has_two_horizons(texel) ? place.y : 0;
    float brightness = 0.0;
    for (int i = place.x; i < end; ++i) {
        seen_light light = light_from(i, position);
        brightness += light.radiance * solid_angle(light);
    }
    color = vec4(brightness, 0.0, 0.0, 0.0);
}
#endif

#ifdef LTSH_EXCESS
/* Whether neither horizon has all of the light on one side, or they differ about it. */
bool crosses(seen_light light, vec3 smooth_normal, vec3 true_normal)
{
    bool some = false;
    bool every = true;
    for (int i = 0; i < light.count; ++i) {
        vec2 corner = ltsh_corner(light.first + i);
        vec3 place_of_corner = light.offset + corner.x * light.half_u + corner.y * light.half_v;
        bool first = dot(smooth_normal, place_of_corner) > 0.0;
        bool second = dot(true_normal, place_of_corner) > 0.0;
        some = some || first || second;
        every = every && first && second;
    }
    return some && !every && light.faces;
}

/* Does the ray from the point meet the light? */
bool hits(seen_light light, vec3 ray)
{
    float steepness = dot(ray, light.direction);
    float distance = dot(light.offset, light.direction) / (steepness < 0.0 ? steepness : -1e-30);
    vec3 met = distance * ray - light.offset;
    float long_u = length(light.half_u);
    float long_v = length(light.half_v);
    vec3 u = light.half_u / long_u;
    vec3 v = light.half_v / long_v;
    float skew = dot(u, v);
    vec2 along = vec2(dot(met, u), dot(met, v));
    vec2 spot = (along - skew * along.yx) / (1.0 - skew * skew) / vec2(long_u, long_v);
    bool inside = false;
    vec2 start = ltsh_corner(light.first + light.count - 1);
    for (int i = 0; i < light.count; ++i) {
        vec2 end = ltsh_corner(light.first + i);
        bool spans = (start.y > spot.y) != (end.y > spot.y);
        float rise = end.y - start.y;
        float edge = start.x + (spot.y - start.y) * (end.x - start.x) / (rise == 0.0 ? 1.0 : rise);
        inside = spans && spot.x < edge ? !inside : inside;
        start = end;
    }
    return inside && steepness < 0.0;
}

/* Probability per sr that the lobe chooses a direction, GGX's visible normals (Heitz 2018, eq. 17). */
float lobe_density(vec3 towards, vec3 towards_eye, vec3 normal, float roughness)
{
    vec3 middle = towards + towards_eye;
    middle /= max(length(middle), 1e-12);
    float alpha = max(roughness * roughness, LTSH_SMALLEST_ALPHA);
    float alpha2 = alpha * alpha;
    float height = dot(middle, normal);
    vec3 aside = cross(middle, normal);
    float steep = height > 0.0 ? dot(aside, aside) + alpha2 * height * height : 1.0;
    float cosine = max(dot(normal, towards_eye), 1e-3);
    float masking = 1.0 / (1.0 + 0.5 * (sqrt(1.0 + alpha2 * (1.0 / (cosine * cosine) - 1.0)) - 1.0));
    return alpha2 / (LTSH_PI * steep * steep) * masking / (4.0 * cosine);
}

void main()
{
    ivec2 texel = ivec2(gl_FragCoord.xy);
    vec3 position = texelFetch(positions, texel, 0).xyz;
    vec4 bent = texelFetch(normals, texel, 0);
    vec3 smooth_normal = texelFetch(smooth_normals, texel, 0).xyz;
    vec3 true_normal = texelFetch(geometric_normals, texel, 0).xyz;
    vec3 towards_eye = view.w > 0.0 ? normalize(view.xyz - position) : view.xyz;
    vec3 mirrored = 2.0 * dot(bent.xyz, towards_eye) * bent.xyz - towards_eye;
    vec3 along = mirrored - dot(mirrored, smooth_normal) * smooth_normal;
    along /= max(length(along), 1e-12);
    vec3 across = cross(smooth_normal, along);
    float brightness = max(texelFetch(brightnesses, texel, 0).x, 1e-30);
    int end = has_two_horizons(texel) ? place.y : 0;
    vec2 excess = vec2(0.0);
    for (int i = place.x; i < end; ++i) {
        seen_light light = light_from(i, position);
        float density = light.radiance / brightness;
        int directions = crosses(light, smooth_normal, true_normal) ? LTSH_AROUND * LTSH_HEIGHTS : 0;
        for (int k = 0; k < directions; ++k) {
            float turn = (float(k / LTSH_HEIGHTS) + 0.5) / float(LTSH_AROUND) * 2.0 - 1.0;
            float grown = exp(LTSH_CONCENTRATION * turn);
            float angle = LTSH_PI * 0.5 * (grown - 1.0 / grown) / LTSH_SINH;
            float span = LTSH_PI * LTSH_CONCENTRATION * (grown + 1.0 / grown) / (LTSH_SINH * float(LTSH_AROUND));
            vec3 around = cos(angle) * along + sin(angle) * across;
            float rise = -atan(dot(around, true_normal), dot(smooth_normal, true_normal));
            float elevation = rise * (LTSH_FIRST_HEIGHT + LTSH_HEIGHT_STEP * float(k % LTSH_HEIGHTS));
            vec3 towards = cos(elevation) * around + sin(elevation) * smooth_normal;
            float width = rise * span * cos(elevation) / float(LTSH_HEIGHTS);
            float lobe = lobe_density(towards, towards_eye, bent.xyz, bent.w);
            float amount = hits(light, towards) ? light.radiance * lobe * width : 0.0;
            float ratio = lobe / density;
            float share = 1.0 / (1.0 + ratio * ratio);
            excess += amount * vec2(1.0 - share, share);
        }
    }
    color = vec4(excess, 0.0, 0.0);
}
#endif

#ifdef LTSH_CHOICE
void main()
{
    ivec2 texel = ivec2(gl_FragCoord.xy);
    vec4 smooth_normal = texelFetch(smooth_normals, texel, 0);
    vec4 true_normal = texelFetch(geometric_normals, texel, 0);
    vec2 excess = abs(texelFetch(excesses, texel, 0).xy);
    color = excess.x <= excess.y ? smooth_normal : true_normal;
}
#endif
