/* A light as seen from a point, with vectors in the world. `first`: texel of the first corner. `count`: number of
   corners, 0 for round lights whose corners have not been chosen yet. */
struct ltsh_light {
    vec3 offset; vec3 half_u; vec3 half_v; vec3 direction; int flags; int first; int count; float bound; bool is_round;
};
/* The surface point of a pixel. */
struct ltsh_point {
    vec3 position; vec3 view; vec3 normal; vec3 geometric; float roughness; float ior; float receiver;
    vec4 f0; vec4 f90; vec4 dielectric;
};

ltsh_light ltsh_seen_light(int header, ltsh_point point)
{
    ltsh_light light;
    ltsh_placed placed = ltsh_place_light(header, point.position, point.normal);
    light.offset = placed.offset;
    light.half_u = placed.half_u;
    light.half_v = placed.half_v;
    light.direction = placed.direction;
    light.bound = ltsh_light_texel(header + 5).w;
    light.flags = int(ltsh_light_texel(header + 2).w);
    light.first = int(ltsh_light_texel(header).w);
    light.count = int(ltsh_light_texel(header + 1).w);
    light.is_round = light.count == 0;
    return light;
}

/* The light with its corners chosen, for a lobe that sees it so `wide` (see `specular_view`), and `whole` or cut. */
ltsh_light ltsh_with_corners(ltsh_light light, float wide, bool whole)
{
    bool round = light.is_round;
@LEVELS@
    return light;
}

/* True if the point is on the side to which the light shines, and belongs to one of its receivers. */
bool ltsh_receives(int header, ltsh_light light, ltsh_point point)
{
    vec3 center = ltsh_light_texel(header).xyz;
    vec3 position = (light.flags & LTSH_DISTANT_FLAG) != 0 ? vec3(0.0) : point.position;
    /* A flat surface that emits must not light itself where rounding moves its points behind it. */
    float rounding = 4e-7 * dot(abs(center) + abs(position), vec3(1.0));
    bool facing = (light.flags & LTSH_FACING_FLAG) != 0 || dot(light.offset, light.direction) < -rounding;
    int count = int(ltsh_light_texel(header + 4).w);
    int first = int(ltsh_light_texel(header + 3).w);
    bool received = count < 0;
    for (int i = 0; i < count; ++i) {
        received = received || ltsh_light_texel(first + i).x == point.receiver;
    }
    return facing && received;
}

/* Radiance from integrals of the plain, the Schlick, the dip and the dielectric term. */
vec3 ltsh_reflected(ltsh_point point, vec4 values)
{
    vec3 reflected = point.f0.xyz * values.x + (point.f90.xyz - point.f0.xyz) * values.y;
    reflected -= vec3(point.f0.w, point.f90.w, point.dielectric.w) * values.z;
    reflected += point.dielectric.xyz * values.w;
    return max(reflected, vec3(0.0));
}
