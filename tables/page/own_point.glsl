// Karis 2013: the point of the light nearest to the mirrored ray
// stands for all of it, under a lobe widened by the light's size.
vec3 shade(Surface s, Light light)
{
    vec3 mirror = reflect(-s.view, s.normal);
    float along = dot(mirror, light.area);
    float way = dot(light.center, light.area) / min(along, -1e-4);
    vec3 hit = (way > 0.0 ? way : 1e4) * mirror - light.center;
    float u = clamp(dot(hit, light.half_u) / dot(light.half_u, light.half_u), -1.0, 1.0);
    float v = clamp(dot(hit, light.half_v) / dot(light.half_v, light.half_v), -1.0, 1.0);
    vec3 point = light.center + u * light.half_u + v * light.half_v;
    float square = dot(point, point);
    vec3 l = point * inversesqrt(square);

    float alpha = s.roughness * s.roughness;
    float area = length(light.area);
    float cosine = max(-dot(l, light.area) / area, 0.0);
    float solid_angle = area * cosine / (dot(light.center, light.center) + 0.5 * area);
    float wide = min(alpha + 0.3 * sqrt(solid_angle), 1.0);
    float nl = max(dot(s.normal, l), 0.0), nv = max(dot(s.normal, s.view), 1e-3);
    vec3 h = normalize(l + s.view);
    float nh = dot(s.normal, h), q = nh * nh * (alpha * alpha - 1.0) + 1.0;
    float d = alpha * alpha / (3.14159 * q * q) * pow(alpha / wide, 2.0);
    float masking = 2.0 * (nl * sqrt(alpha * alpha + (1.0 - alpha * alpha) * nv * nv)
                         + nv * sqrt(alpha * alpha + (1.0 - alpha * alpha) * nl * nl));
    vec3 f = s.f0 + (1.0 - s.f0) * pow(1.0 - dot(h, l), 5.0);
    vec3 specular = f * min(d * nl / max(masking, 1e-6) * solid_angle, 1.0);

    // Diffuse light is exact: the exported headers have it.
    ltsh_polygon polygon = ltsh_empty_polygon();
    ltsh_frame frame = ltsh_make_frame(s.normal, s.view);
    for (int i = 0; i < 4; ++i) {
        polygon = ltsh_with_corner(polygon, ltsh_to_local(frame, light.corners[i]));
    }
    return specular + s.albedo * ltsh_form_factor(ltsh_clip_to_horizon(polygon));
}
