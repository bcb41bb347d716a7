/* What a pixel holds with a technique: the light of shade(), which stands above, and alpha 1; alpha -1 beside surfaces. */
uniform float radiance;
out vec4 color;

void main()
{
    Surface surface;
    color = vec4(0.0, 0.0, 0.0, -1.0);
    if (nearest_surface(camera_ray(), surface) > 0.0) {
        Light light = light_from(surface.position);
        color = vec4(is_before(light) ? radiance * shade(surface, light) : vec3(0.0), 1.0);
    }
}
