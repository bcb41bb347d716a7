// Only diffuse light. s: position, normal, tangent, view, roughness, anisotropy, f0, albedo.
// light, relative to the point: corners[4], center, half_u, half_v, area (times direction).
// All functions of the exported headers are there: ltc_, ltsh2_, ltsh4_, ltsh4c_, ltsh_.
vec3 shade(Surface s, Light light)
{
    ltsh_frame frame = ltsh_make_frame(s.normal, s.view);
    ltsh_polygon polygon = ltsh_empty_polygon();
    for (int i = 0; i < 4; ++i) {
        polygon = ltsh_with_corner(polygon, ltsh_to_local(frame, light.corners[i]));
    }
    return s.albedo * ltsh_form_factor(ltsh_clip_to_horizon(polygon));
}
