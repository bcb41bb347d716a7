vec3 shade(Surface s, Light light)
{
    ltsh_frame frame = ltsh_make_frame(s.normal, s.view);
    ltsh_polygon polygon = ltsh_empty_polygon();
    for (int i = 0; i < 4; ++i) {
        polygon = ltsh_with_corner(polygon, ltsh_to_local(frame, light.corners[i]));
    }
    polygon = ltsh_clip_to_horizon(polygon);

    ltsh_cell cell = @prefix@_cell(dot(s.normal, s.view), s.roughness);
    @prefix@_moments moments = @prefix@_polygon_moments(@prefix@_lookup_warp(cell), polygon);
    @prefix@_weights plain = @prefix@_moment_weights(@prefix@_lookup_curve(cell, 0));
    @prefix@_weights schlick = @prefix@_moment_weights(@prefix@_lookup_curve(cell, 1));
    float sign = ltsh_orientation(polygon);
    float integral = @prefix@_plain_integral(plain, moments, sign);
    float grazing = max(sign * @prefix@_integral(schlick, moments), 0.0);
@LIMITS@
    vec3 specular = dot(s.normal, s.view) > 0.0 ? s.f0 * integral + (1.0 - s.f0) * grazing : vec3(0.0);
    return specular + s.albedo * ltsh_form_factor(polygon);
}
