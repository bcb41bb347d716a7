/* The integral of a lobe over the part of a light above some horizons.

   No polygon is stored: edges are integrated as they come. A light that is above all horizons takes the short loop. In
   the long one every edge is cut to its part above all of them, and what closes the polygon comes from crossings: on
   each horizon the region's boundary is an arc, of which the part inside the light adds up from where edges cross it,

       sum over crossings of +- the integral along the arc from a fixed point to the crossing, moved into the arc.

   Any fixed point serves, since crossings come in pairs; the first one found is taken, which for one horizon gives the
   closing edges of Sutherland and Hodgman (1974). A crossing beyond another horizon moves to where both horizons meet,
   of the two such directions the one from which the light can be seen. Polygons need not be convex. */

/* The triangle of `center` and an edge given from there, by quadrature exact for polynomials of degree 2. */
@name@_sum @name@_with_triangle(@name@_sum sum, vec3 center, vec3 start, vec3 end)
{
    vec3 both = (1.0 / 6.0) * (start + end);
    float weight = (1.0 / 6.0) * dot(center, cross(start, end));
    for (int k = 0; k < 3; ++k) {
        vec3 place = center + both + (k == 0 ? vec3(0.0) : 0.5 * (k == 1 ? start : end));
        float inverse = inversesqrt(max(dot(place, place), 1e-37));
        sum = @name@_with_spot(sum, inverse * place, weight * inverse * inverse * inverse);
    }
    return sum;
}

@name@_sum @name@_integral(@name@_lobe lobe, ltsh_light light)
{
    vec3 center = @name@_warped(lobe, light.offset);
    vec3 along_u = @name@_warped(lobe, light.half_u);
    vec3 along_v = @name@_warped(lobe, light.half_v);
    vec3 height = @name@_heights(lobe, light.offset, center, 1.0);
    vec3 height_u = @name@_heights(lobe, light.half_u, along_u, 0.0);
    vec3 height_v = @name@_heights(lobe, light.half_v, along_v, 0.0);
    vec3 reach = light.bound * (abs(height_u) + abs(height_v));
    bool whole = all(greaterThan(height, reach));
    bool dark = any(lessThanEqual(height + reach, vec3(0.0)));

    /* Of directions that lie so close together rounding leaves too little; the lobe hardly varies over them. */
    vec3 extent = light.bound * (abs(along_u) + abs(along_v));
    bool tiny = dot(extent, extent) < LTSH_TINY * dot(center, center);

    /* Of a round one that is smaller still its center stands for all of it. */
    bool is_point = whole && light.is_round && light.whole_count > 0 && dot(extent, extent) < LTSH_POINT * dot(center, center);

    @name@_sum sum = @name@_empty();
    for (int i = 0; i < (is_point ? 1 : 0); ++i) {
        float inverse = inversesqrt(max(dot(center, center), 1e-37));
        float solid_angle = LTSH_PI * dot(inverse * center, cross(inverse * along_u, inverse * along_v));
        sum = @name@_with_spot(sum, inverse * center, solid_angle);
    }
    int first_count = whole && !tiny ? light.whole_count : 0;
    vec2 place = ltsh_corner(light.whole_first + light.whole_count - 1);
    vec3 start = ltsh_unit(center + place.x * along_u + place.y * along_v);
    for (int i = 0; i < first_count; ++i) {
        place = ltsh_corner(light.whole_first + i);
        vec3 end = ltsh_unit(center + place.x * along_u + place.y * along_v);
        sum = @name@_with_edge(sum, start, end);
        start = end;
    }

    int tiny_count = whole && tiny && !is_point ? light.whole_count : 0;
    start = place.x * along_u + place.y * along_v;
    for (int i = 0; i < tiny_count; ++i) {
        place = ltsh_corner(light.whole_first + i);
        vec3 end = place.x * along_u + place.y * along_v;
        sum = @name@_with_triangle(sum, center, start, end);
        start = end;
    }

    /* Tiny lights are cut around their center, others around the point. */
    int second_count = whole || dark ? 0 : light.count;
    vec3 origin = tiny ? center : vec3(0.0);
    vec3 shift = center - origin;
    place = ltsh_corner(light.first + light.count - 1);
    start = shift + place.x * along_u + place.y * along_v;
    vec3 start_height = height + place.x * height_u + place.y * height_v;
@APICES@
@PINS@
    for (int i = 0; i < second_count; ++i) {
        place = ltsh_corner(light.first + i);
        vec3 end = shift + place.x * along_u + place.y * along_v;
        vec3 end_height = height + place.x * height_u + place.y * height_v;
        vec3 drop = start_height - end_height;
        vec3 share = start_height / mix(drop, vec3(1.0), equal(drop, vec3(0.0)));
        float enter = 0.0;
        float leave = 1.0;
@INTERVAL@
        bool crosses_any = any(notEqual(greaterThan(start_height, vec3(0.0)), greaterThan(end_height, vec3(0.0))));
        int slots = crosses_any ? @SLOTS@ : 1;
        for (int slot = 0; slot < slots; ++slot) {
            bool used = enter < leave;
            vec3 from = start + enter * (end - start);
            vec3 to = start + leave * (end - start);
@CLOSING@
            /* An arc of almost half a circle is split where it is nearest: its ends alone do not say where it runs. */
            vec3 last = ltsh_unit(to);
            vec3 before = ltsh_unit(from);
            vec3 both = before + last;
            bool far = dot(both, both) < 0.04;
            vec3 along = to - from;
            float nearest = ltsh_clamped(-dot(from, along) / max(dot(along, along), 1e-37), 1.0);
            vec3 next = far ? ltsh_unit(from + nearest * along) : last;
            int pieces = used && !tiny ? (far ? 2 : 1) : 0;
            for (int piece = 0; piece < pieces; ++piece) {
                sum = @name@_with_edge(sum, before, next);
                before = next;
                next = last;
            }
            int triangles = used && tiny ? 1 : 0;
            for (int triangle = 0; triangle < triangles; ++triangle) {
                sum = @name@_with_triangle(sum, center, from, to);
            }
        }
        start = end;
        start_height = end_height;
    }
    return sum;
}
