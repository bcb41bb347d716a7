/* A picture as it is shown, with the light itself; or its difference from another, red too bright, blue too dark. */
uniform sampler2D picture;
uniform sampler2D other;
uniform bool is_error;
uniform float exposure; /* a factor */
uniform float error_scale; /* the difference, after exposure, of the strongest colors */
out vec4 color;

vec3 encoded(vec3 linear)
{
    linear = clamp(linear, 0.0, 1.0);
    return mix(1.055 * pow(linear, vec3(1.0 / 2.4)) - 0.055, 12.92 * linear, vec3(lessThanEqual(linear, vec3(0.0031308))));
}

vec3 error_color(float error)
{
    float position = clamp(error / error_scale, -1.0, 1.0);
@ERROR_COLORS@
}

void main()
{
    vec2 share = gl_FragCoord.xy / resolution;
    vec4 value = texelFetch(picture, ivec2(share * vec2(textureSize(picture, 0))), 0);
    vec3 ray = camera_ray();
    Surface surface;
    float distance = nearest_surface(ray, surface);
    if (is_error) {
        vec3 difference = value.rgb - texelFetch(other, ivec2(share * vec2(textureSize(other, 0))), 0).rgb;
        color = vec4(error_color(exposure * dot(difference, vec3(0.2126, 0.7152, 0.0722))), 1.0);
        if (distance < 0.0) {
            color.rgb = error_color(0.0);
        }
        return;
    }
    vec3 shown = distance < 0.0 ? vec3(0.004) : exposure * value.rgb;
    vec3 facing = cross(light_half_u, light_half_v);
    float to_light = dot(light_center - eye, facing) / dot(ray, facing);
    vec3 hit = eye + to_light * ray - light_center;
    float u = dot(hit, light_half_u) / dot(light_half_u, light_half_u);
    float v = dot(hit, light_half_v) / dot(light_half_v, light_half_v);
    if (to_light > 0.0 && (distance < 0.0 || to_light < distance) && max(abs(u), abs(v)) < 1.0) {
        shown = dot(ray, facing) < 0.0 ? vec3(1.0) : vec3(0.03);
    }
    color = vec4(encoded(shown), 1.0);
}
