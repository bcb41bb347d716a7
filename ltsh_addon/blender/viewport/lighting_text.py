"""GLSL pieces of lights, diffuse lobe and main function, put together by `lighting_source`.

Names between @ are filled in there.
"""

LIGHT_TEXELS = """\
vec4 ltsh_light_texel(int index)
{
    return texelFetch(lights, ivec2(index % LTSH_LIGHT_WIDTH, index / LTSH_LIGHT_WIDTH), 0);
}

vec2 ltsh_corner(int texel) { return ltsh_light_texel(texel).xy; }

/* Horizons of normals that are this close meet nowhere in single precision, and count as one. */
bool ltsh_is_same(vec3 a, vec3 b) { return all(lessThan(abs(a - b), vec3(1e-6))); }
"""

LIGHTS = """\
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
@ROUND_LEVELS@
    return light;
}

/* Whether the light shines on the side and on the receiver that the point is on. */
bool ltsh_receives(int header, ltsh_point point)
{
    vec4 direction = ltsh_light_texel(header + 3);
    bool facing = dot(ltsh_light_texel(header).xyz - point.position, direction.xyz) < 0.0;
    int count = int(ltsh_light_texel(header + 4).w);
    bool received = count < 0;
    for (int i = 0; i < count; ++i) {
        received = received || ltsh_light_texel(int(direction.w) + i).x == point.receiver;
    }
    return facing && received;
}
"""

DIFFUSE_LOBE = """\
struct diffuse_lobe { vec3 plane_0; vec3 plane_1; vec3 plane_2; bool is_spare; float bump_alpha2; };
/* Integral of the direction over a polygon, times 2. */
struct diffuse_sum { vec3 total; };

vec3 diffuse_warped(diffuse_lobe lobe, vec3 v) { return v; }

diffuse_sum diffuse_empty()
{
    diffuse_sum sum;
    sum.total = vec3(0.0);
    return sum;
}

diffuse_sum diffuse_with_edge(diffuse_sum sum, vec3 start, vec3 end)
{
    ltsh_edge edge = ltsh_edge_between(start, end);
    sum.total += edge.phi * edge.normal;
    return sum;
}

diffuse_sum diffuse_with_spot(diffuse_sum sum, vec3 direction, float solid_angle)
{
    sum.total += 2.0 * solid_angle * direction;
    return sum;
}
"""

PLAIN = """\
diffuse_lobe diffuse_at(ltsh_point point, ivec2 texel)
{
    diffuse_lobe lobe;
    lobe.plane_0 = @DIFFUSE_NORMAL@;
    lobe.plane_1 = vec3(0.0);
    lobe.plane_2 = vec3(0.0);
    lobe.is_spare = true;
    lobe.bump_alpha2 = 0.0;
    return lobe;
}

float diffuse_form_factor(diffuse_lobe lobe, diffuse_sum sum)
{
    return max(-0.5 * LTSH_ONE_OVER_PI * dot(lobe.plane_0, sum.total), 0.0);
}
"""

BUMPED = """\
diffuse_lobe diffuse_at(ltsh_point point, ivec2 texel)
{
    diffuse_lobe lobe;
    vec4 normal = texelFetch(diffuse_normals, texel, 0);
    lobe.plane_0 = normal.xyz;
    lobe.plane_1 = texelFetch(smooth_normals, texel, 0).xyz;
    lobe.plane_2 = vec3(0.0);
    lobe.is_spare = ltsh_is_same(lobe.plane_0, lobe.plane_1);
    lobe.bump_alpha2 = all(equal(lobe.plane_0, lobe.plane_1)) ? 0.0 : normal.w;
    return lobe;
}

/* With the bump shadowing of `scene.SurfaceSamples`, taken at the mean direction of the light. */
float diffuse_form_factor(diffuse_lobe lobe, diffuse_sum sum)
{
    vec3 direction = -0.5 * sum.total;
    float along = max(dot(direction, lobe.plane_1), 1e-15);
    float tangent2 = max(dot(direction, direction) / (along * along) - 1.0, 0.0);
    float shadowing = 2.0 / (1.0 + sqrt(1.0 + lobe.bump_alpha2 * tangent2));
    return max(dot(lobe.plane_0, direction), 0.0) * shadowing * LTSH_ONE_OVER_PI;
}
"""

MAIN = """\
void main()
{
    ivec2 texel = ivec2(gl_FragCoord.xy) - place.xy;
    vec4 position = texelFetch(positions, texel, 0);
    vec4 normal = texelFetch(normals, texel, 0);
    vec4 base = texelFetch(bases, texel, 0);
    ltsh_point point;
    point.position = position.xyz;
    point.receiver = position.w - 1.0;
    point.normal = normal.xyz;
    point.roughness = normal.w;
    point.ior = base.w;
@READ_FRESNEL@
    point.geometric = @READ_GEOMETRIC@;
    bool here = position.w > 0.0;
    vec3 radiance = vec3(0.0);
@SPECULAR_SETUP@
@DIFFUSE_SETUP@
    int end = here ? place.w : 0;
    for (int i = place.z; i < end; ++i) {
        int header = LTSH_FIRST_LIGHT + i * LTSH_LIGHT_HEADER;
        int flags = int(ltsh_light_texel(header + 2).w);
        bool received = ltsh_receives(header, point);
        bool focused = @IS_FOCUSED@;
        vec3 reflected = vec3(0.0);
@SPECULAR@
@DIFFUSE@
        radiance += reflected * ltsh_light_texel(header + 4).xyz;
    }
    color = vec4(radiance, here ? 1.0 : 0.0);
}
"""

SETUP_SPECULAR = """\
    ltsh_cell cell = specular_cell(point);
    specular_lobe shine = specular_at(point, cell);
    specular_weights weights = ltsh_weights(cell, point);
    bool glossy = dot(point.normal, point.view) > 0.0;
"""

ADD_SPECULAR = """\
        ltsh_light shining = ltsh_seen_light(header, point.position, weights.width);
        bool shines = received && glossy && (flags & LTSH_SPECULAR_FLAG) != 0;
        shining.count = shines && !focused ? shining.count : 0;
        shining.whole_count = shines && !focused ? shining.whole_count : 0;
        vec4 values = specular_values(weights, specular_integral(shine, shining));
@SPECULAR_FOCUSED@
        reflected += ltsh_reflected(point, values);
"""

SPECULAR_FOCUSED = """\
        shining = ltsh_seen_light(header, point.position, weights.width);
        values += specular_focused(shine, weights, shining, header, weights.width, shines && focused);
"""

ADD_DIFFUSE = """\
        ltsh_light lighting = ltsh_seen_light(header, point.position, 1.0);
        bool lights_up = received && (flags & LTSH_DIFFUSE_FLAG) != 0;
        lighting.count = lights_up && !focused ? lighting.count : 0;
        lighting.whole_count = lights_up && !focused ? lighting.whole_count : 0;
        float form_factor = diffuse_form_factor(matte, diffuse_integral(matte, lighting));
@DIFFUSE_FOCUSED@
        reflected += form_factor * base.xyz;
"""

DIFFUSE_FOCUSED = """\
        lighting = ltsh_seen_light(header, point.position, 1.0);
        form_factor += diffuse_focused(matte, lighting, header, 1.0, lights_up && focused).x;
"""

# Coordinates around the diffuse normal.
DIFFUSE_FRAME = """\
mat3 diffuse_frame(diffuse_lobe lobe)
{
    ltsh_frame frame = ltsh_make_frame(lobe.plane_0, lobe.plane_0);
    return transpose(mat3(frame.tangent, frame.bitangent, frame.normal));
}
"""

READ_FRESNEL = """\
    point.view = view.w > 0.0 ? ltsh_unit(view.xyz - position.xyz) : view.xyz;
    point.f0 = texelFetch(f0s, texel, 0);
    point.f90 = texelFetch(f90s, texel, 0);
    point.dielectric = texelFetch(dielectric_weights, texel, 0);
"""
