/* A floor and three objects, their material, and the light, as seen from a point. Units are meters, z is up. */
uniform vec3 eye;
uniform mat3 camera; /* camera * vec3(x, y, 1) is the ray through a place of the picture, x and y from -1 to 1 */
uniform vec2 resolution;
uniform vec3 light_center;
uniform vec3 light_half_u;
uniform vec3 light_half_v; /* the light shines to the side of cross(light_half_u, light_half_v) */
uniform vec4 look; /* roughness, metal and anisotropy of the objects, roughness of the floor */

/* Vectors are unit, but for the position. f0 is the reflectance head on; at grazing angles it is 1. */
struct Surface {
    vec3 position; vec3 normal; vec3 tangent; vec3 view; float roughness; float anisotropy; vec3 f0; vec3 albedo;
};
/* The light, relative to a point; its corners run around. `area` is its area times the direction in which it shines. */
struct Light { vec3 corners[4]; vec3 center; vec3 half_u; vec3 half_v; vec3 area; };

vec3 camera_ray() { return normalize(camera * vec3(2.0 * gl_FragCoord.xy / resolution - 1.0, 1.0)); }

/* The nearest surface along a ray from the eye. Returns its distance, below 0 if there is none. */
float nearest_surface(vec3 ray, out Surface surface)
{
    float nearest = 1e9;
    int object = -1;
    /* Floor: */
    float distance = -eye.z / ray.z;
    vec3 at = eye + distance * ray;
    if (distance > 0.0 && dot(at.xy, at.xy) < float(@FLOOR_RADIUS@ * @FLOOR_RADIUS@)) {
        nearest = distance;
        object = 0;
        surface.normal = vec3(0.0, 0.0, 1.0);
        surface.tangent = vec3(1.0, 0.0, 0.0);
    }
    /* Sphere: */
    vec3 offset = eye - @SPHERE_CENTER@;
    float along = -dot(offset, ray);
    vec3 across = offset + along * ray;
    float under_root = @SPHERE_RADIUS@ * @SPHERE_RADIUS@ - dot(across, across);
    distance = along - sqrt(max(under_root, 0.0));
    if (under_root > 0.0 && distance > 0.0 && distance < nearest) {
        nearest = distance;
        object = 1;
        surface.normal = (offset + distance * ray) / @SPHERE_RADIUS@;
        surface.tangent = vec3(-surface.normal.y, surface.normal.x, 0.0);
    }
    /* Cylinder on the floor, its side and its top: */
    offset = eye - vec3(@CYLINDER_CENTER@, 0.0);
    float square = dot(ray.xy, ray.xy);
    along = -dot(offset.xy, ray.xy) / square;
    across = offset + along * ray;
    under_root = (@CYLINDER_RADIUS@ * @CYLINDER_RADIUS@ - dot(across.xy, across.xy)) / square;
    distance = along - sqrt(max(under_root, 0.0));
    float height = offset.z + distance * ray.z;
    if (under_root > 0.0 && distance > 0.0 && distance < nearest && height > 0.0 && height < @CYLINDER_HEIGHT@) {
        nearest = distance;
        object = 2;
        surface.normal = vec3((offset.xy + distance * ray.xy) / @CYLINDER_RADIUS@, 0.0);
        surface.tangent = vec3(-surface.normal.y, surface.normal.x, 0.0);
    }
    distance = (@CYLINDER_HEIGHT@ - offset.z) / ray.z;
    at = offset + distance * ray;
    if (distance > 0.0 && distance < nearest && ray.z < 0.0
        && dot(at.xy, at.xy) < @CYLINDER_RADIUS@ * @CYLINDER_RADIUS@) {
        nearest = distance;
        object = 2;
        surface.normal = vec3(0.0, 0.0, 1.0);
        surface.tangent = vec3(-at.y, at.x, 0.0);
    }
    /* Box, turned around z: */
    vec2 turn = @BOX_TURN@; /* cosine and sine */
    offset = eye - @BOX_CENTER@;
    offset = vec3(turn.x * offset.x + turn.y * offset.y, turn.x * offset.y - turn.y * offset.x, offset.z);
    vec3 turned = vec3(turn.x * ray.x + turn.y * ray.y, turn.x * ray.y - turn.y * ray.x, ray.z);
    vec3 enter = (-sign(turned) * @BOX_HALVES@ - offset) / turned;
    vec3 leave = (sign(turned) * @BOX_HALVES@ - offset) / turned;
    distance = max(max(enter.x, enter.y), enter.z);
    if (distance > 0.0 && distance < nearest && distance < min(min(leave.x, leave.y), leave.z)) {
        nearest = distance;
        object = 3;
        vec3 side = -sign(turned) * vec3(equal(enter, vec3(distance)));
        vec3 level = side.z != 0.0 ? vec3(1.0, 0.0, 0.0) : vec3(-side.y, side.x, 0.0);
        surface.normal = vec3(turn.x * side.x - turn.y * side.y, turn.y * side.x + turn.x * side.y, side.z);
        surface.tangent = vec3(turn.x * level.x - turn.y * level.y, turn.y * level.x + turn.x * level.y, 0.0);
    }
    surface.tangent = normalize(surface.tangent + vec3(1e-12, 0.0, 0.0));
    surface.position = eye + nearest * ray;
    surface.view = -ray;
    surface.roughness = object == 0 ? look.w : look.x;
    surface.anisotropy = object == 0 ? 0.0 : look.z;
    vec3 color = object == 0 ? @FLOOR_COLOR@ : (object == 1 ? @SPHERE_COLOR@ : (object == 2 ? @CYLINDER_COLOR@ : @BOX_COLOR@));
    float metal = object == 0 ? 0.0 : look.y;
    surface.f0 = mix(vec3(@DIELECTRIC_F0@), color, metal);
    surface.albedo = (1.0 - metal) * color;
    return object < 0 ? -1.0 : nearest;
}

Light light_from(vec3 position)
{
    Light light;
    light.center = light_center - position;
    light.half_u = light_half_u;
    light.half_v = light_half_v;
    light.corners[0] = light.center - light_half_u - light_half_v;
    light.corners[1] = light.center + light_half_u - light_half_v;
    light.corners[2] = light.center + light_half_u + light_half_v;
    light.corners[3] = light.center - light_half_u + light_half_v;
    light.area = 4.0 * cross(light_half_u, light_half_v);
    return light;
}

/* True if the point is on the side to which the light shines. */
bool is_before(Light light) { return dot(light.center, light.area) < 0.0; }
