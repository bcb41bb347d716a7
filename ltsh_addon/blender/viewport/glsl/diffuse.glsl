struct diffuse_lobe {
    vec3 plane_0; vec3 plane_1; vec3 plane_2; bool is_spare;
#ifdef LTSH_SHEEN
    /* The frame around the normal, with the view on the side of the first axis. a = 1 and b = 0 are Lambert's lobe. */
    ltsh_frame frame; float a; float b;
#endif
};
/* Twice the integral of the direction over a polygon, and of the shadowed cosine; and the integrals of rough.glsl. */
struct diffuse_sum {
    vec3 total;
#ifdef LTSH_BUMPED
    float shadowed;
#endif
#ifdef LTSH_ROUGH
    vec2 rough;
#endif
};

vec3 diffuse_warped(diffuse_lobe lobe, vec3 v)
{
#ifdef LTSH_SHEEN
    float x = dot(lobe.frame.tangent, v);
    float z = dot(lobe.frame.normal, v);
    float y = dot(lobe.frame.bitangent, v);
    return (lobe.a * x + lobe.b * z) * lobe.frame.tangent + lobe.a * y * lobe.frame.bitangent + z * lobe.frame.normal;
#else
    return v;
#endif
}

#ifdef LTSH_ROUGH
/* The summands of the rough or velvet lobe per solid angle; below, the form factors from their sum. */
vec2 ltsh_diffuse_spot(vec3 direction)
{
#ifdef LTSH_VELVET
    if (ltsh_velvet > 0.0) {
        return vec2(ltsh_velvet_lobe(direction), 0.0);
    }
#endif
    return ltsh_rough_spot(direction);
}

vec2 ltsh_diffuse_factors(float form_factor, vec2 sum)
{
#ifdef LTSH_VELVET
    if (ltsh_velvet > 0.0) {
        return vec2(max(-sum.x, 0.0), 0.0);
    }
#endif
    return ltsh_rough_factors(form_factor, sum);
}
#endif

diffuse_sum diffuse_empty()
{
    diffuse_sum sum;
    sum.total = vec3(0.0);
#ifdef LTSH_BUMPED
    sum.shadowed = 0.0;
#endif
#ifdef LTSH_ROUGH
    sum.rough = vec2(0.0);
#endif
    return sum;
}

diffuse_sum diffuse_with_edge(diffuse_sum sum, vec3 start, vec3 end)
{
    ltsh_edge edge = ltsh_edge_between(start, end);
    sum.total += edge.phi * edge.normal;
#ifdef LTSH_BUMPED
    sum.shadowed += ltsh_bump_edge(start, end);
#endif
#ifdef LTSH_ROUGH
    sum.rough += ltsh_rough_edge(start, end);
#endif
#ifdef LTSH_VELVET
    sum.rough.x += ltsh_velvet_edge(start, end);
#endif
    return sum;
}

diffuse_sum diffuse_with_spot(diffuse_sum sum, vec3 direction, float solid_angle)
{
    sum.total += 2.0 * solid_angle * direction;
#ifdef LTSH_BUMPED
    float height = max(dot(direction, ltsh_smooth_normal), 1e-6);
    sum.shadowed += 2.0 * solid_angle * dot(direction, ltsh_bent_normal) * ltsh_modeled_shadowing(height);
#endif
#ifdef LTSH_ROUGH
    sum.rough += solid_angle * ltsh_diffuse_spot(direction);
#endif
    return sum;
}

/* Heights of v above the horizons. The smooth horizon is left out where it equals the bent one. */
vec3 diffuse_heights(diffuse_lobe lobe, vec3 v, vec3 warped, float rest)
{
#ifdef LTSH_BUMPED
    return vec3(dot(lobe.plane_0, v), lobe.is_spare ? rest : dot(lobe.plane_1, v), rest);
#else
    return vec3(dot(lobe.plane_0, v), rest, rest);
#endif
}

@INTEGRAL@
diffuse_lobe diffuse_at(ltsh_point point, ivec2 texel)
{
    diffuse_lobe lobe;
    lobe.plane_0 = point.normal;
    lobe.plane_1 = vec3(0.0);
    lobe.plane_2 = vec3(0.0);
    lobe.is_spare = true;
#ifdef LTSH_BUMPED
    vec4 normal = texelFetch(diffuse_normals, texel, 0);
    lobe.plane_0 = normal.xyz;
    lobe.plane_1 = texelFetch(smooth_normals, texel, 0).xyz;
    lobe.is_spare = ltsh_is_same(lobe.plane_0, lobe.plane_1);
    ltsh_set_bump(lobe.plane_0, lobe.plane_1, all(equal(lobe.plane_0, lobe.plane_1)) ? 0.0 : normal.w);
#elif defined(LTSH_TURNED)
    lobe.plane_0 = texelFetch(diffuse_normals, texel, 0).xyz;
#endif
#ifdef LTSH_SHEEN
    bool fuzzy = point.ior < 0.0;
    lobe.frame = ltsh_make_frame(lobe.plane_0, point.view);
    lobe.a = fuzzy ? -point.ior : 1.0;
    lobe.b = fuzzy ? point.roughness : 0.0;
#endif
#ifdef LTSH_ROUGH
    ltsh_set_rough(lobe.plane_0, point.view, texelFetch(rebounds, texel, 0));
#endif
    return lobe;
}

/* The form factor of a sum. */
float diffuse_form_factor(diffuse_lobe lobe, diffuse_sum sum)
{
#ifdef LTSH_BUMPED
    float mean = -dot(sum.total, lobe.plane_1) * inversesqrt(max(dot(sum.total, sum.total), 1e-37));
    return max(-0.5 * LTSH_ONE_OVER_PI * sum.shadowed, 0.0) * ltsh_bump_correction(clamp(mean, 1e-6, 1.0));
#else
    return max(-0.5 * LTSH_ONE_OVER_PI * dot(lobe.plane_0, sum.total), 0.0);
#endif
}

#ifdef LTSH_ROUGH
/* The form factors of light that is scattered once, and of light that is scattered several times. */
vec2 diffuse_rough_factors(diffuse_lobe lobe, diffuse_sum sum)
{
    float plain = max(-0.5 * LTSH_ONE_OVER_PI * dot(lobe.plane_0, sum.total), 0.0);
    float shadowed = diffuse_form_factor(lobe, sum);
    return (plain > 0.0 ? shadowed / plain : 0.0) * ltsh_diffuse_factors(plain, sum.rough);
}
#endif

/* True if `diffuse_of_cap` can integrate the lobe over a cap of the sphere. */
bool diffuse_has_caps(diffuse_lobe lobe, bool whole)
{
    bool has = whole || lobe.is_spare;
#ifdef LTSH_BUMPED
    has = has && ltsh_bump_alpha2 == 0.0;
#endif
#ifdef LTSH_SHEEN
    has = has && lobe.a == 1.0 && lobe.b == 0.0;
#endif
#ifdef LTSH_ROUGH
    has = has && ltsh_rough_terms.y == 0.0;
#endif
#ifdef LTSH_VELVET
    has = has && ltsh_velvet == 0.0;
#endif
    return has;
}

/* The form factor of a light that is seen as a cap of the sphere, above the horizon or cut by it (Snyder 1996). */
float diffuse_of_cap(diffuse_lobe lobe, ltsh_light light)
{
    float squared = max(dot(light.offset, light.offset), 1e-37);
    float radius2 = dot(light.half_u, light.half_u);
    float sine2 = radius2 / (squared + radius2);
    vec3 axis = inversesqrt(squared) * light.offset;
    float whole = diffuse_form_factor(lobe, diffuse_with_spot(diffuse_empty(), axis, -LTSH_PI * sine2));
    float cosine = clamp(dot(lobe.plane_0, axis), -1.0, 1.0);
    float slope2 = squared / max(radius2, 1e-37);
    float root = sqrt(max(slope2 * (1.0 - cosine * cosine / max(sine2, 1e-37)), 0.0));
    float turn = -cosine * sqrt(slope2 / max(1.0 - cosine * cosine, 1e-37));
    float part = sine2 * (cosine * acos(clamp(turn, -1.0, 1.0)) - root) + atan(root, slope2);
    return cosine * cosine < sine2 ? max(LTSH_ONE_OVER_PI * part, 0.0) : whole;
}

#ifdef LTSH_FOCUSED
/* The matrix to coordinates around the diffuse normal. */
mat3 diffuse_frame(diffuse_lobe lobe)
{
    ltsh_frame frame = ltsh_make_frame(lobe.plane_0, lobe.plane_0);
    return transpose(mat3(frame.tangent, frame.bitangent, frame.normal));
}
@FOCUSED@
#endif
