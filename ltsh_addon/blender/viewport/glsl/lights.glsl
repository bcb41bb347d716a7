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
ltsh_light ltsh_seen_light(int header, ltsh_point point, float width)
{
    vec4 more = ltsh_light_texel(header + 5);
    ltsh_light light;
    ltsh_placed placed = ltsh_place_light(header, point.position, point.normal);
    light.offset = placed.offset;
    light.half_u = placed.half_u;
    light.half_v = placed.half_v;
    light.direction = placed.direction;
    light.bound = more.w;
    float reach = min(more.z, max(length(light.half_u), length(light.half_v)));
    float beyond = sqrt(dot(light.offset, light.offset)) - reach;
    float wide = reach / (max(max(abs(dot(light.offset, light.direction)), beyond), 1e-12 * reach) * width);
    light.first = int(ltsh_light_texel(header).w);
    light.count = int(ltsh_light_texel(header + 1).w);
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
    int flags = int(ltsh_light_texel(header + 2).w);
    vec3 position = (flags & LTSH_DISTANT_FLAG) != 0 ? vec3(0.0) : point.position;
    /* A flat surface that shines must not light itself where its points are rounded to behind it. */
    float rounding = 4e-7 * dot(abs(center) + abs(position), vec3(1.0));
    bool facing = (flags & LTSH_FACING_FLAG) != 0 || dot(center - position, direction.xyz) < -rounding;
    int count = int(ltsh_light_texel(header + 4).w);
    bool received = count < 0;
    for (int i = 0; i < count; ++i) {
        received = received || ltsh_light_texel(int(direction.w) + i).x == point.receiver;
    }
    return facing && received;
}
