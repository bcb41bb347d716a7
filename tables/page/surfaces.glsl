/* What shading needs of a pixel's surface, in four pictures: position and roughness (-1 for none), normal, f0, albedo. */
uniform int layer;
out vec4 color;

void main()
{
    Surface surface;
    bool is_surface = nearest_surface(camera_ray(), surface) > 0.0;
    vec4 first = is_surface ? vec4(surface.position, surface.roughness) : vec4(-1.0);
    vec3 other = layer == 1 ? surface.normal : (layer == 2 ? surface.f0 : surface.albedo);
    color = layer == 0 ? first : vec4(is_surface ? other : vec3(0.0), 0.0);
}
