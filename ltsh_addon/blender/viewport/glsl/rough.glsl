/* The rough diffuse lobe, as `shading.diffuse` describes it, by integrals over arcs of functions without poles. Arcs
   are parametrized by the tangent of half the angle from their middle, without inverse trigonometric functions. */

/* Set for each point: the axes, z along the normal and x toward the view; cosine and sine of the view; A and B of the
   lobe, 0 for Lambert's. */
vec3 ltsh_rough_x;
vec3 ltsh_rough_y;
vec3 ltsh_rough_z;
vec2 ltsh_rough_view;
vec2 ltsh_rough_terms;
/* The part of light that is scattered several times. */
vec3 ltsh_rebound;
#ifdef LTSH_VELVET
/* Sigma of velvet; 0: no velvet. */
float ltsh_velvet;
#endif

/* Sets these values; `texel` is the G-buffer's texel of the rebound. */
void ltsh_set_rough(vec3 normal, vec3 view, vec4 texel)
{
    ltsh_frame frame = ltsh_make_frame(normal, view);
    ltsh_rough_x = frame.tangent;
    ltsh_rough_y = frame.bitangent;
    ltsh_rough_z = frame.normal;
    float cosine = clamp(dot(normal, view), 0.0, 1.0);
    ltsh_rough_view = vec2(max(cosine, 1e-3), sqrt(1.0 - cosine * cosine));
    float a = 1.0 / (LTSH_PI + texel.w * (0.5 * LTSH_PI - 0.66666667));
    ltsh_rough_terms = texel.w > 0.0 ? vec2(a, texel.w * a) : vec2(0.0);
    ltsh_rebound = texel.xyz;
#ifdef LTSH_VELVET
    ltsh_velvet = max(-texel.w, 0.0);
#endif
}

/* The integral of z G(z) from z to 1, divided by 1 - z^2; G is `rough_slope`. */
float ltsh_mean_slope_above(float z)
{
    float root = sqrt(max(1.0 - z, 0.0));
    float value = 0.0;
@MEAN_SLOPE@
    return root * value;
}

/* z t / (x sine of the view). */
float ltsh_rough_share(float x, float z) { return x > 0.0 ? z / max(z, ltsh_rough_view.x) : z; }

/* The term of a polygon that crosses the plane x = 0 at (0, y, z): added where it leaves the side of the view,
   subtracted where it comes back. It is the integral of sin^2 (z / max(z, cosine of the view) - z) over the angle from
   the normal, with the sign of y. */
float ltsh_rough_closing(float y, float z)
{
    float least = max(z, ltsh_rough_view.x);
    float sine = sqrt(max(1.0 - least * least, 0.0));
    float beyond = y * y * abs(y) - sine * sine * sine;
    float near = 0.5 * (atan(sine, least) - sine * least) - sine * sine * sine / 3.0;
    float whole = near + (z < least ? beyond * (1.0 / ltsh_rough_view.x - 1.0) / 3.0 : 0.0);
    return y < 0.0 ? -whole : whole;
}

/* The places where an arc is as high as the view, where the integrand has kinks; as tangents of half the angle from the
   middle, limited to `reach`. `middle` and `along` are the heights of the arc's middle and of the direction at a right
   angle to it. */
vec2 ltsh_rough_kinks(float middle, float along, float reach)
{
    float discriminant = along * along + middle * middle - ltsh_rough_view.x * ltsh_rough_view.x;
    float root = sqrt(max(discriminant, 0.0));
    float inverse = 1.0 / max(middle + ltsh_rough_view.x, 1e-6);
    vec2 kinks = clamp(inverse * vec2(along - root, along + root), -reach, reach);
    return discriminant > 0.0 ? kinks : vec2(reach);
}

/* The summands of an edge for the integrals of z t / (sine of the view) and of z G(z). */
vec2 ltsh_rough_edge(vec3 start, vec3 end)
{
    vec3 along = vec3(dot(ltsh_rough_x, end - start), dot(ltsh_rough_y, end - start), dot(ltsh_rough_z, end - start));
    vec3 first = vec3(dot(ltsh_rough_x, start), dot(ltsh_rough_y, start), dot(ltsh_rough_z, start));
    vec3 last = vec3(dot(ltsh_rough_x, end), dot(ltsh_rough_y, end), dot(ltsh_rough_z, end));
    float chord = sqrt(dot(along, along));
    vec3 middle = ltsh_unit(first + last);
    along = chord > 0.0 ? along / chord : vec3(0.0);
    float half_sine = min(0.5 * chord, 1.0);
    float reach = half_sine / (1.0 + sqrt(1.0 - half_sine * half_sine));
    float turn = middle.x * along.y - middle.y * along.x;
    bool crosses = (first.x > 0.0) != (last.x > 0.0);
    float root = sqrt(along.x * along.x + middle.x * middle.x);
    float cut = -middle.x / (along.x < 0.0 ? min(along.x - root, -1e-30) : max(along.x + root, 1e-30));
    cut = crosses ? clamp(cut, -reach, reach) : reach;
    vec2 sum = vec2(0.0);
    vec2 kinks = ltsh_rough_kinks(middle.z, along.z, reach);
    float from = -reach;
    bool left = ltsh_rough_terms.y > 0.0 && chord > 0.0;
    while (left) {
        /* Up to the next crossing or kink. */
        float to = cut > from ? cut : reach;
        to = kinks.x > from ? min(to, kinks.x) : to;
        to = kinks.y > from ? min(to, kinks.y) : to;
        float side = from < cut ? first.x : last.x;
        for (int k = 0; k < LTSH_ARC_NODES; ++k) {
            vec4 nodes = LTSH_ARC_PLACES;
            vec4 weights = LTSH_ARC_WEIGHTS;
            float place = k % 2 == 0 ? nodes[k / 2] : -nodes[k / 2];
            float t = 0.5 * (from + to + place * (to - from));
            float inverse = 1.0 / (1.0 + t * t);
            /* The angle changes by 2 inverse dt. */
            float weight = (to - from) * weights[k / 2] * inverse;
            vec3 node = inverse * ((1.0 - t * t) * middle + 2.0 * t * along);
            float rise = inverse * ((1.0 - t * t) * along.z - 2.0 * t * middle.z);
            float z = max(node.z, 0.0);
            sum += weight * vec2(node.y * ltsh_rough_share(side, z) * rise, turn * ltsh_mean_slope_above(z));
        }
        left = to < reach;
        from = to;
    }
    vec3 node = (1.0 - cut * cut) * middle + 2.0 * cut * along;
    float closing = ltsh_rough_closing(node.y / (1.0 + cut * cut), max(node.z, 0.0) / (1.0 + cut * cut));
    closing = first.x > 0.0 ? closing : -closing;
    sum.x += crosses && ltsh_rough_terms.y > 0.0 ? closing : 0.0;
    return sum;
}

/* The integrands for a direction, per solid angle. */
vec2 ltsh_rough_spot(vec3 direction)
{
    float x = dot(ltsh_rough_x, direction);
    float z = max(dot(ltsh_rough_z, direction), 0.0);
    return vec2(x * ltsh_rough_share(x, z), z * rough_slope(z));
}

/* The integrals of z (A + B t) and of z (1 - E(z)), from the form factor and the sum of edges or spots. */
vec2 ltsh_rough_factors(float form_factor, vec2 sum)
{
    float a = LTSH_PI * ltsh_rough_terms.x;
    float b = ltsh_rough_terms.y;
    vec2 factors = vec2(a * form_factor - b * ltsh_rough_view.y * sum.x,
                        LTSH_PI * (1.0 - a) * form_factor + b * sum.y);
    return b > 0.0 ? max(factors, vec2(0.0)) : vec2(form_factor, 0.0);
}
