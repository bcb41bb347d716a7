vec4 ltsh_light_texel(int index)
{
    return texelFetch(lights, ivec2(index % LTSH_LIGHT_WIDTH, index / LTSH_LIGHT_WIDTH), 0);
}

vec2 ltsh_corner(int texel) { return ltsh_light_texel(texel).xy; }

/* True if two horizons count as one: in single precision, horizons of such close normals have no intersection. */
bool ltsh_is_same(vec3 a, vec3 b) { return all(lessThan(abs(a - b), vec3(1e-6))); }

/* A light as seen from a point: the vector to its center, its half axes, and the direction in which it shines. */
struct ltsh_placed { vec3 offset; vec3 half_u; vec3 half_v; vec3 direction; };

/* A light as seen from `position`. For lights that face every point it is the disk that is seen, as by `FacingDisk` of
   `shading.facing`; for distant ones the center is a direction. `normal` is that of the lobe. */
ltsh_placed ltsh_place_light(int header, vec3 position, vec3 normal)
{
    vec4 half_v = ltsh_light_texel(header + 2);
    ltsh_placed placed;
    placed.offset = ltsh_light_texel(header).xyz;
    placed.half_u = ltsh_light_texel(header + 1).xyz;
    placed.half_v = half_v.xyz;
    placed.direction = ltsh_light_texel(header + 3).xyz;
    int flags = int(half_v.w);
    if ((flags & LTSH_DISTANT_FLAG) == 0) {
        placed.offset -= position;
    }
    if ((flags & LTSH_FACING_FLAG) != 0) {
        float radius = length(placed.half_u);
        float squared = dot(placed.offset, placed.offset);
        bool ball = (flags & LTSH_BALL_FLAG) != 0;
        bool inside = ball ? squared <= radius * radius : squared <= 0.0;
        float shrinking = ball && !inside ? max(1.0 - radius * radius / squared, LTSH_LEAST_SHRINKING) : 1.0;
        placed.offset = inside ? LTSH_NEAR_DISK * radius * normal : shrinking * placed.offset;
        placed.direction = -placed.offset * inversesqrt(max(dot(placed.offset, placed.offset), 1e-37));
        float own = radius * sqrt(shrinking);
        /* A frame around the direction (Duff et al. 2017). */
        vec3 d = placed.direction;
        float way = d.z < 0.0 ? -1.0 : 1.0;
        float a = -1.0 / (way + d.z);
        float b = d.x * d.y * a;
        placed.half_u = own * vec3(1.0 + way * d.x * d.x * a, way * b, -way * d.x);
        placed.half_v = own * vec3(b, way + d.y * d.y * a, -d.y);
    }
    return placed;
}
