/* The value of an octahedral map (see `viewport.sky`) `size` texels wide, whose first texel is at `corner` + 1. */
vec3 ltsh_sky_at(vec3 direction, ivec2 corner, int size)
{
    vec3 unit = direction / (abs(direction.x) + abs(direction.y) + abs(direction.z));
    vec2 folded = (1.0 - abs(unit.yx)) * vec2(unit.x < 0.0 ? -1.0 : 1.0, unit.y < 0.0 ? -1.0 : 1.0);
    vec2 at = 0.5 + 0.5 * float(size) * (1.0 + (unit.z < 0.0 ? folded : unit.xy));
    at = clamp(at, vec2(0.0), vec2(float(size) + 0.999));
    vec2 share = fract(at);
    ivec2 low = corner + ivec2(at);
    vec3 below = mix(texelFetch(sky, low, 0).rgb, texelFetch(sky, low + ivec2(1, 0), 0).rgb, share.x);
    vec3 above = mix(texelFetch(sky, low + ivec2(0, 1), 0).rgb, texelFetch(sky, low + ivec2(1, 1), 0).rgb, share.x);
    return mix(below, above, share.y);
}
