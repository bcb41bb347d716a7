/* A light as seen from a point: vectors in the world, the first corner's texel and how many there are, the same for
   where no horizon cuts it. */
struct ltsh_light {
    vec3 offset; vec3 half_u; vec3 half_v; vec3 direction; int first; int count; int whole_first; int whole_count;
    float bound; bool is_round;
};
/* What is read of the surface point of a pixel. */
struct ltsh_point {
    vec3 position; vec3 view; vec3 normal; vec3 geometric; float roughness; float ior; float receiver;
    vec4 f0; vec4 f90; vec4 dielectric;
};

/* The light as lobes `width` radians wide need it: of round ones the number of corners depends on that. */
ltsh_light ltsh_seen_light(int header, vec3 position, float width)
{
    vec4 center = ltsh_light_texel(header);
    vec4 half_u = ltsh_light_texel(header + 1);
    vec4 half_v = ltsh_light_texel(header + 2);
    vec4 direction = ltsh_light_texel(header + 3);
    vec4 more = ltsh_light_texel(header + 5);
    ltsh_light light;
    light.offset = center.xyz - position;
    light.half_u = half_u.xyz;
    light.half_v = half_v.xyz;
    light.direction = direction.xyz;
    light.bound = more.w;
    float reach = more.z;
    float beyond = sqrt(dot(light.offset, light.offset)) - reach;
    float wide = reach / (max(max(abs(dot(light.offset, light.direction)), beyond), 1e-12 * reach) * width);
    light.first = int(center.w);
    light.count = int(half_u.w);
    light.is_round = light.count == 0;
    bool round = light.is_round;
@LEVELS@
    light.whole_first = light.first;
    light.whole_count = light.count;
@WHOLE_LEVELS@
    return light;
}

/* Whether the light shines on the side and on the receiver that the point is on. */
bool ltsh_receives(int header, ltsh_point point)
{
    vec4 direction = ltsh_light_texel(header + 3);
    vec3 center = ltsh_light_texel(header).xyz;
    /* A flat surface that shines must not light itself where its points are rounded to behind it. */
    float rounding = 4e-7 * dot(abs(center) + abs(point.position), vec3(1.0));
    bool facing = dot(center - point.position, direction.xyz) < -rounding;
    int count = int(ltsh_light_texel(header + 4).w);
    bool received = count < 0;
    for (int i = 0; i < count; ++i) {
        received = received || ltsh_light_texel(int(direction.w) + i).x == point.receiver;
    }
    return facing && received;
}
