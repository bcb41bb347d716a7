// LTSH 4 with a bent normal, as games do for brushed metal:
// the tables know no anisotropy, so the normal leans across the tangent.
vec3 shade(Surface s, Light light)
{
    vec3 direction = s.anisotropy >= 0.0 ? s.tangent : cross(s.normal, s.tangent);
    vec3 across = cross(cross(direction, s.view), direction);
    vec3 n = normalize(mix(s.normal, normalize(across), 0.5 * abs(s.anisotropy)));

    ltsh_frame frame = ltsh_make_frame(n, s.view), flat_frame = ltsh_make_frame(s.normal, s.view);
    ltsh_polygon polygon = ltsh_empty_polygon(), plane = ltsh_empty_polygon();
    for (int i = 0; i < 4; ++i) {
        polygon = ltsh_with_corner(polygon, ltsh_to_local(frame, light.corners[i]));
        plane = ltsh_with_corner(plane, ltsh_to_local(flat_frame, light.corners[i]));
    }
    polygon = ltsh_clip_to_horizon(polygon);
    ltsh_cell cell = ltsh4_cell(dot(n, s.view), s.roughness);
    ltsh4_moments moments = ltsh4_polygon_moments(ltsh4_lookup_warp(cell), polygon);
    float sign = ltsh_orientation(polygon);
    float plain = ltsh4_plain_integral(ltsh4_moment_weights(ltsh4_lookup_curve(cell, 0)), moments, sign);
    float grazing = max(sign * ltsh4_integral(ltsh4_moment_weights(ltsh4_lookup_curve(cell, 1)), moments), 0.0);
    vec3 specular = s.f0 * plain + (1.0 - s.f0) * grazing;
    return specular + s.albedo * ltsh_form_factor(ltsh_clip_to_horizon(plane));
}
