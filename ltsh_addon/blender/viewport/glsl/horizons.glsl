/* Chooses the horizon that ends the specular lobe of a pixel, as `cycles.horizons` does for samples.

   There are three steps. BOUNDS: bounds of the light that the lights send to the pixel. EXCESS: the light that only one
   of both horizons lets through, by the directions that Cycles chooses by lobes and by lights, those of `is_quick`:
   each angle around the smooth normal has one height. CHOICE: the normal of the horizon. The first two add up over draw calls, so there may be many lights. Where `cycles.horizons` splits a
   sample in two, a picture takes the horizon of one part: of the larger one at the threshold 1/2, and over pictures
   with thresholds between 0 and 1 of each as often as its share. */

#ifndef LTSH_CHOICE
/* A light as seen from a point; its corners are center + s * half_u + t * half_v. */
struct seen_light {
    vec3 offset; vec3 half_u; vec3 half_v; vec3 direction; int first; int count; float area; float radiance;
    float radius; float end; bool faces; bool is_round; bool is_disk;
};

seen_light light_from(int number, vec3 position, vec3 normal)
{
    int header = LTSH_FIRST_LIGHT + number * LTSH_LIGHT_HEADER;
    vec4 center = ltsh_light_texel(header);
    vec4 half_u = ltsh_light_texel(header + 1);
    vec3 radiance = abs(ltsh_light_texel(header + 4).xyz);
    seen_light light;
    ltsh_placed placed = ltsh_place_light(header, position, normal);
    light.offset = placed.offset;
    light.half_u = placed.half_u;
    light.half_v = placed.half_v;
    light.direction = placed.direction;
    int flags = int(ltsh_light_texel(header + 2).w);
    light.is_round = half_u.w == 0.0;
    light.is_disk = (flags & LTSH_CAP_FLAG) != 0;
    light.area = light.is_round ? LTSH_PI * length(cross(placed.half_u, placed.half_v)) : ltsh_light_texel(header + 6).z;
    light.count = half_u.w > 0.0 ? int(half_u.w) : LTSH_ROUND_CORNERS;
    light.first = half_u.w > 0.0 ? int(center.w) : LTSH_ROUND_FIRST;
    light.radiance = radiance.x + radiance.y + radiance.z;
    vec4 traits = ltsh_light_texel(header + 5);
    float squares = dot(light.half_u, light.half_u) + dot(light.half_v, light.half_v);
    light.radius = traits.w * sqrt(squares + 2.0 * abs(dot(light.half_u, light.half_v)));
    float tangent = traits.x;
    light.end = tangent > 0.0 ? inversesqrt(1.0 + tangent * tangent) : 0.0;
    light.faces = dot(light.offset, light.direction) < 0.0;
    return light;
}

/* True if the choice of the horizon matters for the pixel. */
bool has_two_horizons(ivec2 texel)
{
    vec3 apart = abs(texelFetch(smooth_normals, texel, 0).xyz - texelFetch(geometric_normals, texel, 0).xyz);
    bool reflects = any(notEqual(texelFetch(f90s, texel, 0).xyz, vec3(0.0)))
        || any(notEqual(texelFetch(dielectric_weights, texel, 0).xyz, vec3(0.0)));
    return texelFetch(positions, texel, 0).w > 0.0 && reflects
        && max(max(apart.x, apart.y), apart.z) > LTSH_SMALLEST_ANGLE;
}
#endif

#ifndef LTSH_CHOICE
#ifdef LTSH_EXCESS
/* Solid angle in sr (Van Oosterom and Strackee 1983, eq. 8). Volumes are computed as those of pyramids, which is exact
   for small lights, too. */
float solid_angle(seen_light light)
{
    vec3 normal = cross(light.half_u, light.half_v);
    float height = dot(light.offset, normal);
    vec2 start = ltsh_corner(light.first);
    vec3 a = light.offset + start.x * light.half_u + start.y * light.half_v;
    float far_a = length(a);
    vec2 before = ltsh_corner(light.first + 1) - start;
    float total = 0.0;
    int end = light.is_disk ? 3 : light.count;
    int i = 2;
    do {
        vec2 after = ltsh_corner(light.first + i) - start;
        vec3 b = a + before.x * light.half_u + before.y * light.half_v;
        vec3 c = a + after.x * light.half_u + after.y * light.half_v;
        float far_b = length(b);
        float far_c = length(c);
        float volume = height * (before.x * after.y - before.y * after.x);
        float below = far_a * far_b * far_c + dot(a, b) * far_c + dot(b, c) * far_a + dot(c, a) * far_b;
        total += abs(volume) > 0.0 || abs(below) > 0.0 ? 2.0 * atan(volume, below) : 0.0;
        before = after;
    } while (++i < end);
    float squared = dot(light.offset, light.offset);
    float sine2 = dot(light.half_u, light.half_u) / (squared + dot(light.half_u, light.half_u));
    float cap = 2.0 * LTSH_PI * sine2 / (1.0 + sqrt(max(1.0 - sine2, 0.0)));
    return light.faces ? (light.is_disk ? cap : abs(total)) : 0.0;
}
#endif

/* Cosines of the sums of two angles in [0, pi], or of their differences with the sign -1, from the cosines of both. */
vec2 cosines_of_sums(vec2 first, float second, float sign)
{
    return first * second - sign * sqrt(max(1.0 - first * first, 0.0) * max(1.0 - second * second, 0.0));
}

/* The upper and the lower bound of the light that a light sends to the pixel, as `light_tree.light_bounds_at`, and whether
   it sends any. */
vec3 bounds(seen_light light, vec3 smooth_normal)
{
    float far = length(light.offset);
    vec3 axis = light.offset / max(far, 1e-30);
    float width = 1.0;
    float farthest = far;
    for (int i = 0; i < 4; ++i) {
        vec3 corner = light.offset + float(i % 2 * 2 - 1) * light.half_u + float(i / 2 * 2 - 1) * light.half_v;
        float reach = length(corner);
        width = min(width, dot(corner, axis) / max(reach, 1e-30));
        farthest = max(farthest, reach);
    }
    width = max(width, -1.0);
    vec2 cosines = vec2(dot(axis, smooth_normal), -dot(axis, light.direction));
    vec2 most = mix(cosines_of_sums(cosines, width, -1.0), vec2(1.0), greaterThanEqual(cosines, vec2(width)));
    vec2 least = cosines_of_sums(cosines, width, 1.0);
    bool seen = cosines.y > 0.0 && most.x > 0.0 && most.y > light.end;
    bool whole = seen && width > 0.0 && least.x > 0.0 && least.y > light.end;
    float power = light.radiance * light.area;
    vec2 sent = power * vec2(most.x * most.y / (far * far), least.x * least.y / (farthest * farthest));
    return vec3(seen ? sent.x : 0.0, whole ? sent.y : 0.0, seen ? 1.0 : 0.0);
}
#endif

#ifdef LTSH_BOUNDS
void main()
{
    ivec2 texel = ivec2(gl_FragCoord.xy);
    vec3 position = texelFetch(positions, texel, 0).xyz;
    int end = has_two_horizons(texel) ? draw_range.y : 0;
    vec3 smooth_normal = texelFetch(smooth_normals, texel, 0).xyz;
    vec3 total = vec3(0.0);
    for (int i = draw_range.x; i < end; ++i) {
        seen_light light = light_from(i, position, smooth_normal);
        total += bounds(light, smooth_normal);
    }
    color = vec4(total, 0.0);
}
#endif

#ifdef LTSH_EXCESS
/* True if a horizon cuts the light, or if the light is above one horizon and below the other. */
bool crosses(seen_light light, vec3 smooth_normal, vec3 true_normal)
{
    vec2 height = vec2(dot(smooth_normal, light.offset), dot(true_normal, light.offset));
    vec2 height_u = vec2(dot(smooth_normal, light.half_u), dot(true_normal, light.half_u));
    vec2 height_v = vec2(dot(smooth_normal, light.half_v), dot(true_normal, light.half_v));
    vec2 reach = sqrt(height_u * height_u + height_v * height_v);
    bool some = any(greaterThan(height + reach, vec2(0.0)));
    bool every = all(greaterThan(height - reach, vec2(0.0)));
    if (!light.is_round) {
        some = false;
        every = true;
        int i = 0;
        do {
            vec2 corner = ltsh_corner(light.first + i);
            vec2 own = height + corner.x * height_u + corner.y * height_v;
            some = some || any(greaterThan(own, vec2(0.0)));
            every = every && all(greaterThan(own, vec2(0.0)));
        } while (++i < light.count);
    }
    return some && !every && light.faces;
}

/* True if the ray from the point meets the light. */
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
    bool is_quad = light.first == LTSH_QUAD_FIRST;
    int corners = light.is_round || is_quad ? 1 : light.count;
    int i = 0;
    do {
        vec2 end = ltsh_corner(light.first + i);
        bool spans = (start.y > spot.y) != (end.y > spot.y);
        float rise = end.y - start.y;
        float edge = start.x + (spot.y - start.y) * (end.x - start.x) / (rise == 0.0 ? 1.0 : rise);
        inside = spans && spot.x < edge ? !inside : inside;
        start = end;
    } while (++i < corners);
    inside = is_quad ? max(abs(spot.x), abs(spot.y)) < 1.0 : (light.is_round ? dot(spot, spot) < 1.0 : inside);
    return inside && steepness < 0.0;
}

/* Number of the direction at an angle around the smooth normal, between those of its neighbors. The directions of all
   turns are numbered on. */
float direction_at(float angle)
{
    float turns = floor(0.5 * angle / LTSH_PI + 0.5);
    float grown = (angle - 2.0 * LTSH_PI * turns) * LTSH_SINH / LTSH_PI;
    float turn = sign(grown) * log(abs(grown) + sqrt(grown * grown + 1.0)) / LTSH_CONCENTRATION;
    return (turns + 0.5 + 0.5 * turn) * float(LTSH_AROUND) - 0.5;
}

/* The first of the directions that may meet the light, by their angle around the smooth normal, and their count. A
   hundredth of a step more, because angles are rounded. */
ivec2 directions_around(seen_light light, vec3 along, vec3 across)
{
    vec2 flat_offset = vec2(dot(light.offset, along), dot(light.offset, across));
    float reach = asin(min(light.radius / max(length(flat_offset), 1e-30), 1.0));
    bool is_beside = light.radius < length(flat_offset);
    float middle = atan(flat_offset.y, is_beside ? flat_offset.x : 1.0);
    int first = int(ceil(direction_at(middle - reach) - 0.01));
    int last = int(floor(direction_at(middle + reach) + 0.01));
    ivec2 some = ivec2((first + LTSH_AROUND) % LTSH_AROUND, min(last - first + 1, LTSH_AROUND));
    return is_beside ? some : ivec2(0, LTSH_AROUND);
}

/* Probability per sr of a direction sampled by the lobe, with GGX's visible normals (Heitz 2018, eq. 17). */
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

/* As `horizons._visible_microfacets`. */
float seen_by_light(vec3 towards, vec3 towards_eye, vec3 normal, float roughness)
{
    float alpha = max(roughness * roughness, LTSH_SMALLEST_ALPHA);
    vec2 cosines = vec2(max(dot(normal, towards_eye), 1e-3), max(dot(normal, towards), 0.0));
    vec2 slopes = sqrt(cosines * cosines + alpha * alpha * (1.0 - cosines * cosines));
    return cosines.y * (cosines.x + slopes.x) / max(cosines.x * slopes.y + cosines.y * slopes.x, 1e-30);
}

/* Exact unpolarized reflectance of a dielectric. */
float dielectric_reflectance(float cosine, float ior)
{
    float inner = sqrt(max(ior * ior - 1.0 + cosine * cosine, 0.0));
    float straight = (cosine - inner) / max(cosine + inner, 1e-30);
    float along = (ior * ior * cosine - inner) / max(ior * ior * cosine + inner, 1e-30);
    return 0.5 * (straight * straight + along * along);
}

/* Mean reflectance for the cosine of the half angle; `means` are f0, f90, weight and index of the dielectric lobe. */
float reflectance(vec4 means, float cosine)
{
    float schlick = means.x + (means.y - means.x) * pow(1.0 - cosine, 5.0);
    return max(schlick + means.z * dielectric_reflectance(cosine, means.w), 0.0);
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
    vec3 all_bounds = texelFetch(light_bounds, texel, 0).xyz;
    vec3 diffuse_normal = texelFetch(diffuse_normals, texel, 0).xyz;
    vec4 base = texelFetch(bases, texel, 0);
    vec3 third = vec3(1.0 / 3.0);
    vec4 means = vec4(dot(texelFetch(f0s, texel, 0).xyz, third), dot(texelFetch(f90s, texel, 0).xyz, third),
        dot(texelFetch(dielectric_weights, texel, 0).xyz, third), max(base.w, 1.0));
    /* As `horizons.lobe_selection_pmf` of a single sample. */
    vec2 chances = vec2(reflectance(means, clamp(dot(bent.xyz, towards_eye), 0.0, 1.0)), dot(base.xyz, third));
    chances /= max(chances.x + chances.y, 1e-12);
    int count = has_two_horizons(texel) ? draw_range.y - draw_range.x : 0;
    /* A bit for each light that matters. Software renderers execute both sides of a branch for every light, so the
       lights that matter have a loop of their own. */
    uint left = 0u;
    int number = 0;
    do {
        seen_light light = light_from(draw_range.x + number, position, smooth_normal);
        left |= number < count && crosses(light, smooth_normal, true_normal) ? 1u << uint(number) : 0u;
    } while (++number < count);
    vec2 excess = vec2(0.0);
    do {
        seen_light light = light_from(draw_range.x + (left != 0u ? findLSB(left) : 0), position, smooth_normal);
        vec3 own = bounds(light, smooth_normal);
        float by_least = all_bounds.y > 0.0 ? own.y / all_bounds.y : own.z / max(all_bounds.z, 1.0);
        float density = 0.5 * (own.x / max(all_bounds.x, 1e-30) + by_least) / max(solid_angle(light), 1e-12);
        ivec2 around_light = directions_around(light, along, across);
        int directions = left != 0u ? around_light.y : 0;
        int i = 0;
        do {
            int k = (around_light.x + i) % LTSH_AROUND;
            float turn = (float(k) + 0.5) / float(LTSH_AROUND) * 2.0 - 1.0;
            float grown = exp(LTSH_CONCENTRATION * turn);
            float angle = LTSH_PI * 0.5 * (grown - 1.0 / grown) / LTSH_SINH;
            float span = LTSH_PI * LTSH_CONCENTRATION * (grown + 1.0 / grown) / (LTSH_SINH * float(LTSH_AROUND));
            vec3 around = cos(angle) * along + sin(angle) * across;
            float rise = -atan(dot(around, true_normal), dot(smooth_normal, true_normal));
            float elevation = rise * (LTSH_FIRST_HEIGHT + LTSH_HEIGHT_STEP * float(k % LTSH_HEIGHTS));
            vec3 towards = cos(elevation) * around + sin(elevation) * smooth_normal;
            float width = rise * span * cos(elevation);
            float lobe = lobe_density(towards, towards_eye, bent.xyz, bent.w);
            float chosen = chances.x * lobe + chances.y * max(dot(towards, diffuse_normal), 0.0) / LTSH_PI;
            float reflected = lobe * seen_by_light(towards, towards_eye, bent.xyz, bent.w)
                * reflectance(means, sqrt(max(0.5 + 0.5 * dot(towards, towards_eye), 0.0)));
            bool counts = i < directions && hits(light, towards);
            float amount = light.radiance * reflected * width;
            float share = density * density / max(density * density + chosen * chosen, 1e-30);
            excess += counts ? amount * vec2(1.0 - share, share) : vec2(0.0);
        } while (++i < directions);
        left &= left - 1u;
    } while (left != 0u);
    color = vec4(excess, 0.0, 0.0);
}
#endif

#ifdef LTSH_CHOICE
void main()
{
    ivec2 texel = ivec2(gl_FragCoord.xy);
    vec4 smooth_normal = texelFetch(smooth_normals, texel, 0);
    vec4 true_normal = texelFetch(geometric_normals, texel, 0);
    vec2 excess = texelFetch(excesses, texel, 0).xy;
    /* Smooth if the lights' choice has so much of the excess, or if there is none. */
    bool is_smooth = excess.x + excess.y == 0.0 || excess.y / (excess.x + excess.y) >= threshold;
    color = is_smooth ? smooth_normal : true_normal;
}
#endif
