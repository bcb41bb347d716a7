/* The true BRDF, integrated by points on the light and by directions of the lobe (visible normals, Heitz 2018), weighed
   by the balance heuristic. A draw adds `count` of each to the mean of `first` earlier ones in `sums`. Alpha is the mean
   of squared draws, which tells the noise; -1 beside surfaces. */
uniform float radiance;
uniform sampler2D sums;
uniform int first;
uniform int count;
out vec4 color;

const float PI = 3.14159265;

uint hashed(uint x)
{
    x = x * 747796405u + 2891336453u;
    x = ((x >> ((x >> 28u) + 4u)) ^ x) * 277803737u;
    return (x >> 22u) ^ x;
}

/* Point n of a sequence that fills the unit square evenly (Roberts 2018, "R2"), shifted. */
vec2 point_of(uint n, uvec2 shift)
{
    uvec2 fixed_point = shift + n * uvec2(3242174889u, 2447445414u);
    return vec2(fixed_point >> 8u) * (1.0 / 16777216.0);
}

vec2 alphas;
vec3 view;

float stretched(vec3 v) { return length(vec3(alphas * v.xy, v.z)); }

/* The distribution of normals at the half vector of the view and a direction. */
float normals_at(vec3 direction)
{
    vec3 h = normalize(view + direction);
    vec3 scaled = vec3(h.xy / alphas, h.z);
    float square = dot(scaled, scaled);
    return 1.0 / (PI * alphas.x * alphas.y * square * square);
}

vec3 sampled_direction(vec2 random)
{
    vec3 v = normalize(vec3(alphas * view.xy, view.z));
    float across = dot(v.xy, v.xy);
    vec3 t1 = across > 0.0 ? vec3(-v.y, v.x, 0.0) * inversesqrt(across) : vec3(1.0, 0.0, 0.0);
    vec3 t2 = cross(v, t1);
    float r = sqrt(random.x);
    float p1 = r * cos(2.0 * PI * random.y);
    float p2 = r * sin(2.0 * PI * random.y);
    float s = 0.5 * (1.0 + v.z);
    p2 = (1.0 - s) * sqrt(max(1.0 - p1 * p1, 0.0)) + s * p2;
    vec3 h = p1 * t1 + p2 * t2 + sqrt(max(1.0 - p1 * p1 - p2 * p2, 0.0)) * v;
    h = normalize(vec3(alphas * h.xy, max(h.z, 1e-6)));
    return reflect(-view, h);
}

/* Both integrands, for F = 1 and for (1 - c)^5, in a direction of the light, divided by the sum of both densities. */
vec2 contribution(vec3 direction, float light_density)
{
    if (direction.z <= 0.0) {
        return vec2(0.0);
    }
    float normals = normals_at(direction);
    float root = stretched(view);
    float value = 0.5 * normals * direction.z / (view.z * stretched(direction) + direction.z * root);
    float density = 0.5 * normals / (view.z + root);
    float c = dot(normalize(view + direction), view);
    return value / (density + light_density) * vec2(1.0, pow(max(1.0 - c, 0.0), 5.0));
}

void main()
{
    Surface surface;
    ivec2 texel = ivec2(gl_FragCoord.xy);
    color = vec4(0.0, 0.0, 0.0, -1.0);
    if (nearest_surface(camera_ray(), surface) < 0.0) {
        return;
    }
    Light light = light_from(surface.position);
    vec3 y = cross(surface.normal, surface.tangent);
    mat3 local = transpose(mat3(surface.tangent, y, surface.normal));
    view = local * surface.view;
    float alpha = surface.roughness * surface.roughness;
    alphas = vec2(alpha / (1.0 - surface.anisotropy), alpha * (1.0 - surface.anisotropy));
    vec3 center = local * light.center, half_u = local * light.half_u, half_v = local * light.half_v;
    vec3 area = local * light.area;
    float size = length(area);
    uint seed = hashed(uint(texel.x) + hashed(uint(texel.y)));
    uvec2 shift = uvec2(seed, hashed(seed)), other = uvec2(hashed(seed + 7u), hashed(seed + 11u));
    vec2 sum = vec2(0.0);
    for (int k = 0; k < count && view.z > 0.0; ++k) {
        uint n = uint(first + k);
        vec2 place = 2.0 * point_of(n, shift) - 1.0;
        vec3 offset = center + place.x * half_u + place.y * half_v;
        float square = dot(offset, offset);
        vec3 direction = offset * inversesqrt(square);
        sum += contribution(direction, square / max(-dot(direction, area), 1e-20));
        direction = sampled_direction(point_of(n, other));
        float distance = dot(center, area) / dot(direction, area);
        vec3 hit = distance * direction - center;
        vec2 inside = abs(vec2(dot(hit, half_u) / dot(half_u, half_u), dot(hit, half_v) / dot(half_v, half_v)));
        if (distance > 0.0 && max(inside.x, inside.y) < 1.0) {
            sum += contribution(direction, distance * distance / max(-dot(direction, area), 1e-20));
        }
    }
    sum /= float(count);
    ltsh_polygon polygon = ltsh_empty_polygon();
    for (int i = 0; i < 4; ++i) {
        polygon = ltsh_with_corner(polygon, local * light.corners[i]);
    }
    vec3 reflected = surface.f0 * sum.x + (1.0 - surface.f0) * sum.y;
    reflected += surface.albedo * ltsh_form_factor(ltsh_clip_to_horizon(polygon));
    reflected = is_before(light) ? radiance * reflected : vec3(0.0);
    float luminance = dot(reflected, vec3(0.2126, 0.7152, 0.0722));
    vec4 before = first > 0 ? texelFetch(sums, texel, 0) : vec4(0.0);
    color = mix(before, vec4(reflected, luminance * luminance), float(count) / float(first + count));
}
