/* Bump shadowing, as in `lobes.edge_integrals`. Set for each point: the bent and the smooth normal; alpha^2; and k, a, b
   and c. */
vec3 ltsh_bent_normal;
vec3 ltsh_smooth_normal;
float ltsh_bump_alpha2;
vec4 ltsh_bump_terms;

void ltsh_set_bump(vec3 bent_normal, vec3 smooth_normal, float alpha2)
{
    ltsh_bent_normal = bent_normal;
    ltsh_smooth_normal = smooth_normal;
    ltsh_bump_alpha2 = alpha2;
    float alpha = sqrt(alpha2);
    vec4 value = vec4(0.0);
@TERMS@
    ltsh_bump_terms = vec4(value.x * alpha2, value.y * alpha, 2.0 + value.z * alpha - value.w, value.w);
}

float ltsh_bump_root(float z)
{
    return sqrt(ltsh_bump_terms.x + (1.0 - ltsh_bump_terms.x) * z * z);
}

float ltsh_bump_share(float z, float root)
{
    return ltsh_bump_terms.y + ltsh_bump_terms.z * z + ltsh_bump_terms.w * root;
}

/* The factor that integrals over edges stand for. */
float ltsh_modeled_shadowing(float z)
{
    float root = ltsh_bump_root(z);
    float share = ltsh_bump_share(z, root);
    float slope = ltsh_bump_terms.z + ltsh_bump_terms.w * (1.0 - ltsh_bump_terms.x) * z / root;
    return z * (3.0 * share - z * slope) / (share * share);
}

/* The factor over the modeled one. */
float ltsh_bump_correction(float z)
{
    float factor = 2.0 * z / (z + sqrt(ltsh_bump_alpha2 + (1.0 - ltsh_bump_alpha2) * z * z));
    return factor / ltsh_modeled_shadowing(z);
}

/* Twice the integral of an edge at one node. `arc`: half its angle, and half the sum and the difference of the heights
   of its ends over the cosine and the sine of that. */
float ltsh_bump_node(vec3 arc, vec2 toward, float turn, float weight)
{
    float z = max(cos(turn * arc.x) * arc.y + sin(turn * arc.x) * arc.z, 1e-6);
    float root = ltsh_bump_root(z);
    float share = ltsh_bump_share(z, root);
    float mixed = ltsh_bump_terms.w * ltsh_bump_terms.x / (root + z) + ltsh_bump_terms.y / (1.0 + z);
    float total = ltsh_bump_terms.y + ltsh_bump_terms.z + ltsh_bump_terms.w;
    return 2.0 * weight * (toward.x * z + toward.y * mixed / total) / share;
}

float ltsh_bump_edge(vec3 start, vec3 end)
{
    ltsh_edge edge = ltsh_edge_between(start, end);
    vec3 normal = edge.phi * edge.normal;
    float cosine = dot(ltsh_bent_normal, ltsh_smooth_normal);
    vec2 toward = vec2(dot(normal, ltsh_bent_normal), cosine * dot(normal, ltsh_smooth_normal));
    float near = clamp(inversesqrt(2.0 * edge.q), 1e-6, 1.0 - 1e-6);
    vec2 ends = vec2(dot(start, ltsh_smooth_normal), dot(end, ltsh_smooth_normal));
    float half_angle = acos(near);
    vec3 arc = vec3(half_angle, 0.5 * (ends.x + ends.y) / near, 0.5 * abs(ends.y - ends.x) / sin(half_angle));
    float sum = 0.0;
@NODES@
    return sum;
}
