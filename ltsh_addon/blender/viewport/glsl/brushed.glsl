/* The anisotropic lobe, in place of the one of specular.glsl. It is integrated by few points in the space of stretched
   half vectors, where it is smooth; see `shading.brdf` and `shading.reference`. The frame is that of the tangent, in
   which the stretch is diagonal. */
struct specular_lobe {
    vec3 row_x; vec3 row_y; vec3 row_z; vec3 plane_0; vec3 plane_1; bool is_spare; float sharpness; float mean_sharpness;
};
/* The width of the lobe in radians. */
struct specular_weights { float width; };
/* Integrals of the plain, the Schlick, the dip and the dielectric term. */
struct specular_sum { vec4 values; };

/* Set for each point: the view, both alphas and 1, and the index of refraction. */
vec3 ltsh_own_view;
vec3 ltsh_alphas;
float ltsh_own_ior;
/* Set for each light: the stretched half vector that all of its triangles share as a corner. */
vec3 ltsh_apex;

vec3 specular_warped(specular_lobe lobe, vec3 v)
{
    return vec3(dot(lobe.row_x, v), dot(lobe.row_y, v), dot(lobe.row_z, v));
}

/* Heights of v above the horizons. The geometric horizon is left out where it equals the first. */
vec3 specular_heights(specular_lobe lobe, vec3 v, vec3 warped, float rest)
{
#ifdef LTSH_GEOMETRIC
    return vec3(warped.z, lobe.is_spare ? rest : dot(lobe.plane_1, v), rest);
#else
    return vec3(warped.z, rest, rest);
#endif
}

/* The four terms of the lobe per solid angle of unit stretched half vectors. */
vec4 ltsh_lobe_at(vec3 stretched)
{
    vec3 h = ltsh_unit(ltsh_alphas * stretched);
    float cosine = ltsh_clamped(dot(h, ltsh_own_view), 1.0);
    vec3 i = 2.0 * cosine * h - ltsh_own_view;
    float mu = max(i.z, 0.0);
    vec3 view = ltsh_alphas * ltsh_own_view;
    vec3 light = ltsh_alphas * vec3(i.xy, mu);
    float masking = ltsh_own_view.z * sqrt(dot(light, light)) + mu * sqrt(dot(view, view));
    float value = 2.0 * LTSH_ONE_OVER_PI * mu * max(dot(view, stretched), 0.0) / max(masking, 1e-30);
    float complement = 1.0 - cosine;
    float squared = complement * complement;
    float schlick = squared * squared * complement;
    float dielectric = ltsh_dielectric_reflectance(cosine, ltsh_own_ior);
    return value * vec4(1.0, schlick, schlick * cosine * complement, dielectric);
}

specular_sum specular_empty()
{
    specular_sum sum;
    sum.values = vec4(0.0);
    return sum;
}

/* The factor by which solid angles grow from directions of light, with half vector h, to stretched half vectors. */
float ltsh_stretching(vec3 h, float cosine)
{
    vec3 stretched = h / ltsh_alphas;
    float squared = dot(stretched, stretched);
    return 1.0 / max(4.0 * cosine * ltsh_alphas.x * ltsh_alphas.y * squared * sqrt(squared), 1e-30);
}

specular_sum specular_with_spot(specular_sum sum, vec3 direction, float solid_angle)
{
    vec3 h = ltsh_unit(direction + ltsh_own_view);
    float stretching = ltsh_stretching(h, dot(h, ltsh_own_view));
    sum.values += solid_angle * stretching * ltsh_lobe_at(ltsh_unit(h / ltsh_alphas));
    return sum;
}

/* The conic (1 - s)^2 first + 2 s (1 - s) middle + s^2 last; lengths do not matter, first and last are unit vectors. */
struct ltsh_conic { vec3 first; vec3 middle; vec3 last; };

/* The half vectors of a great circle form a conic, and so does their linear image. */
ltsh_conic ltsh_conic_between(vec3 start, vec3 end)
{
    vec3 both = start + end;
    float inverse = inversesqrt(max(dot(both, both), 1e-12));
    vec3 stretch = 1.0 / ltsh_alphas;
    ltsh_conic arc;
    arc.first = stretch * (start + ltsh_own_view);
    arc.middle = stretch * (inverse * both + 0.5 / inverse * ltsh_own_view);
    arc.last = stretch * (end + ltsh_own_view);
    vec2 scale = inversesqrt(max(vec2(dot(arc.first, arc.first), dot(arc.last, arc.last)), vec2(1e-30)));
    arc.first *= scale.x;
    arc.middle *= sqrt(scale.x * scale.y);
    arc.last *= scale.y;
    return arc;
}

bool ltsh_is_short(vec3 first, vec3 middle, vec3 last)
{
    float toward = dot(middle, first + last);
    return toward >= LTSH_SHORT_ARC * sqrt(dot(middle, middle));
}

/* Adds the triangle of the apex and an arc, by 3 x 3 points. */
specular_sum ltsh_with_arc(specular_sum sum, ltsh_conic arc)
{
    /* Differences of close vectors are exact in floating point. */
    vec3 to_first = ltsh_apex - arc.first;
    vec3 to_last = ltsh_apex - arc.last;
    float c_first = 2.0 * dot(to_first, cross(arc.first, arc.middle - arc.first));
    float c_across = 2.0 * dot(to_first, cross(arc.first, arc.last - arc.first));
    float c_last = 2.0 * dot(to_last, cross(arc.middle - arc.last, arc.last));
    for (int k = 0; k < 9; ++k) {
        vec2 node = 0.5 + 0.38729833 * (vec2(k / 3, k % 3) - 1.0);
        float weight = (k / 3 == 1 ? 0.44444444 : 0.27777778) * (k % 3 == 1 ? 0.44444444 : 0.27777778);
        float s = node.x;
        float t = 1.0 - s;
        vec3 edge = t * t * arc.first + 2.0 * s * t * arc.middle + s * s * arc.last;
        float inverse = inversesqrt(max(dot(edge, edge), 1e-30));
        weight *= (t * t * c_first + s * t * c_across + s * s * c_last) * inverse * inverse;
        edge *= inverse;
        vec3 away = edge - ltsh_apex;
        float angle = max(2.0 * asin(min(0.5 * sqrt(dot(away, away)), 1.0)), 1e-4);
        float sine = max(sin(angle), 1e-6);
        float far = sin(node.y * angle) / sine;
        float near = sin((1.0 - node.y) * angle) / sine;
        sum.values += weight * far * angle / sine * ltsh_lobe_at(near * ltsh_apex + far * edge);
    }
    return sum;
}

specular_sum specular_with_edge(specular_sum sum, vec3 start, vec3 end)
{
    ltsh_conic rest = ltsh_conic_between(start, end);
    bool left = true;
    for (int arcs = 0; arcs < LTSH_MOST_ARCS && left; ++arcs) {
        left = arcs + 1 < LTSH_MOST_ARCS && !ltsh_is_short(rest.first, rest.middle, rest.last);
        /* Halve until the first part, from 0 to s, is short. */
        float s = left ? 0.5 : 1.0;
        vec3 to_middle;
        vec3 place;
        float size;
        for (int halvings = 0; halvings < LTSH_MOST_HALVINGS; ++halvings) {
            to_middle = mix(rest.first, rest.middle, s);
            place = mix(to_middle, mix(rest.middle, rest.last, s), s);
            size = max(dot(place, place), 1e-30);
            float inverse = inversesqrt(size);
            float root = sqrt(inverse);
            s = !left || ltsh_is_short(rest.first, to_middle, inverse * place) ? s : s * root / (1.0 + root);
        }
        to_middle = mix(rest.first, rest.middle, s);
        vec3 from_middle = mix(rest.middle, rest.last, s);
        place = mix(to_middle, from_middle, s);
        float inverse = inversesqrt(max(dot(place, place), 1e-30));
        ltsh_conic arc;
        arc.first = rest.first;
        arc.middle = sqrt(inverse) * to_middle;
        arc.last = inverse * place;
        rest.first = arc.last;
        rest.middle = sqrt(inverse) * from_middle;
        sum = ltsh_with_arc(sum, arc);
    }
    return sum;
}

/* Sets the apex for a light: the stretched half vector of the mirrored view if that direction is inside the light, else
   a mean of the light's boundary. */
void ltsh_set_apex(specular_lobe lobe, ltsh_light light)
{
    vec3 center = specular_warped(lobe, light.offset);
    vec3 along_u = specular_warped(lobe, light.half_u);
    vec3 along_v = specular_warped(lobe, light.half_v);
    vec3 mirror = vec3(-ltsh_own_view.xy, ltsh_own_view.z);
    /* Of many corners only every n-th is used. */
    int step = max(light.count / 8, 1);
    vec2 place = ltsh_corner(light.first + step * ((light.count - 1) / step));
    vec3 start = ltsh_unit(center + place.x * along_u + place.y * along_v);
    vec3 mean = vec3(0.0, 0.0, 1e-20);
    bool is_left = true;
    bool is_right = true;
    for (int i = 0; i < light.count; i += step) {
        place = ltsh_corner(light.first + i);
        vec3 end = ltsh_unit(center + place.x * along_u + place.y * along_v);
        float side = dot(mirror, cross(start, end));
        is_left = is_left && side >= 0.0;
        is_right = is_right && side <= 0.0;
        ltsh_conic arc = ltsh_conic_between(ltsh_unit(vec3(start.xy, max(start.z, 1e-4))),
                                            ltsh_unit(vec3(end.xy, max(end.z, 1e-4))));
        vec3 chord = arc.last - arc.first;
        vec3 halfway = ltsh_unit(arc.first + 2.0 * arc.middle + arc.last);
        mean += (sqrt(dot(chord, chord)) + 1e-12) * max(halfway.z, 0.0) * halfway;
        start = end;
    }
    ltsh_apex = is_left || is_right ? vec3(0.0, 0.0, 1.0) : ltsh_unit(mean);
}

/* The lobe at a point; `tangent` is a texel of the G-buffer. */
specular_lobe specular_along(ltsh_point point, vec4 tangent)
{
    vec3 flat_part = tangent.xyz - dot(tangent.xyz, point.normal) * point.normal;
    vec3 other = abs(point.normal.x) < 0.7 ? vec3(1.0, 0.0, 0.0) : vec3(0.0, 1.0, 0.0);
    bool without = dot(flat_part, flat_part) <= 1e-12 * dot(tangent.xyz, tangent.xyz) || tangent.xyz == vec3(0.0);
    specular_lobe lobe;
    lobe.row_z = point.normal;
    lobe.row_x = ltsh_unit(without ? cross(point.normal, other) : flat_part);
    lobe.row_y = cross(lobe.row_z, lobe.row_x);
    lobe.plane_0 = point.normal;
    lobe.plane_1 = vec3(0.0);
    lobe.is_spare = true;
#ifdef LTSH_GEOMETRIC
    lobe.plane_1 = point.geometric;
    lobe.is_spare = ltsh_is_same(point.geometric, point.normal);
#endif
    ltsh_own_view = specular_warped(lobe, point.view);
    ltsh_own_view.z = max(ltsh_own_view.z, 1e-6);
    float alpha = max(point.roughness * point.roughness, LTSH_LEAST_ALPHA);
    float share = without ? 1.0 : 1.0 - tangent.w;
    ltsh_alphas = vec3(max(vec2(alpha / share, alpha * share), vec2(LTSH_LEAST_ALPHA)), 1.0);
    ltsh_own_ior = point.ior;
    float width = min(ltsh_alphas.x, ltsh_alphas.y) * ltsh_own_view.z;
    lobe.sharpness = 1.0 / (width * width);
    lobe.mean_sharpness = 1.0 / (ltsh_alphas.x * ltsh_alphas.y);
    return lobe;
}

specular_weights specular_width(ltsh_point point)
{
    specular_weights weights;
    weights.width = max(point.roughness, LTSH_LEAST_ROUGHNESS) * max(point.roughness, LTSH_LEAST_ROUGHNESS);
    return weights;
}

vec4 specular_values(specular_weights weights, specular_sum sum)
{
    /* Corners run clockwise as seen from the point. */
    return max(-sum.values, vec4(0.0));
}

@INTEGRAL@
/* The matrix to coordinates in which the lobe lies around e_z and has a width of about 1. */
mat3 ltsh_toward_mirror(float width)
{
    vec3 mirror = vec3(-ltsh_own_view.xy, ltsh_own_view.z);
    vec3 side = ltsh_unit(cross(mirror, abs(mirror.x) < 0.7 ? vec3(1.0, 0.0, 0.0) : vec3(0.0, 1.0, 0.0)));
    return transpose(mat3(side / width, cross(mirror, side) / width, mirror));
}
@FOCUSED@
