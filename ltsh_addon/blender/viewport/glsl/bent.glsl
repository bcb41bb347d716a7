/* Dielectrics with an index of refraction below 1. Total reflection makes Fresnel's factor nearly a step; its mean is
   taken over points of the light, weighted by the lobe, as in `shading.float64`. */

bool ltsh_is_bent(ltsh_point point)
{
    return point.ior > 0.0 && point.ior < 1.0 && any(notEqual(point.dielectric.xyz, vec3(0.0)));
}

/* Fresnel's factor for light from the unit direction `toward`. */
float ltsh_bent_fresnel(ltsh_point point, vec3 toward)
{
    return ltsh_dielectric_reflectance(sqrt(clamp(0.5 + 0.5 * dot(toward, point.view), 0.0, 1.0)), point.ior);
}

/* The reflected light of a point of the light, up to a common factor: without and with Fresnel's factor. */
vec2 ltsh_bent_sample(ltsh_point point, ltsh_light light, vec3 offset)
{
    float inverse = inversesqrt(max(dot(offset, offset), 1e-37));
    vec3 toward = inverse * offset;
    vec3 h = toward + point.view;
    float alpha = max(point.roughness * point.roughness, LTSH_MIN_ALPHA);
    float up = dot(h, point.normal);
    vec3 aside = h - up * point.normal;
    float horizontal = dot(aside, aside);
    float squared = alpha * alpha;
    float ratio = squared * (horizontal + up * up) / max(horizontal + squared * up * up, 1e-30);
    float mu = max(dot(toward, point.normal), 0.0);
    float view = clamp(dot(point.view, point.normal), 0.0, 1.0);
    float masking = view * sqrt(mu * mu + squared * (1.0 - mu * mu)) + mu * sqrt(view * view + squared * (1.0 - view * view));
    float value = ratio * ratio * mu / max(masking, 1e-30);
    bool facing = (light.flags & LTSH_FACING_FLAG) != 0;
    value *= facing ? 1.0 : max(-dot(toward, light.direction), 0.0) * inverse * inverse;
    return value * vec2(1.0, ltsh_bent_fresnel(point, toward));
}

vec4 ltsh_bent_values(vec4 values, ltsh_point point, ltsh_light light, bool center)
{
    bool bent = ltsh_is_bent(point);
    bool facing = center || (light.flags & LTSH_FACING_FLAG) != 0;
    light = ltsh_with_corners(light, 1.0, false);
    int step = max(light.count / 8, 1);
    vec2 sum = facing ? ltsh_bent_sample(point, light, light.offset) : vec2(0.0);
    for (int i = 0; i < (bent && !facing ? light.count : 0); i += step) {
        vec2 place = ltsh_corner(light.first + i);
        vec3 corner = place.x * light.half_u + place.y * light.half_v;
        for (int k = 0; k < 3; ++k) {
            sum += ltsh_bent_sample(point, light, light.offset + (0.2 + 0.3 * float(k)) * corner);
        }
    }
    values.w = bent ? values.x * sum.y / max(sum.x, 1e-30) : values.w;
    return values;
}
