/* The integral of a lobe over the part of a light above some horizons.

   No polygon is stored: edges are integrated as they come. Every edge is cut to its part above all horizons. The edges
   that close the polygon run along the horizons. On each horizon the region's boundary is an arc, and the part of the
   arc inside the light follows from the crossings of edges with the horizon:

       sum over crossings of +- the integral along the arc from a fixed point to the crossing, moved into the arc.

   Any fixed point serves, since crossings come in pairs. The first crossing is taken, which for one horizon gives the
   closing edges of Sutherland and Hodgman (1974). A crossing below another horizon is moved to the direction in which
   both horizons meet: of the two such directions the one whose ray meets the light's plane. Polygons need not be
   convex.

   Loops test their conditions at the end (do-while): with a test at the start, software renderers may execute the body
   once more. */

/* A light as the lobe sees it. `whole`: above all horizons. `dark`: below one of them. `size` and `wide`: upper bounds
   of the squared half diagonal over the distance of its center, and over that of its nearest point. */
struct @name@_view {
    vec3 center; vec3 along_u; vec3 along_v; vec3 height; vec3 height_u; vec3 height_v; bool whole; bool dark;
    float size; float wide;
};

@name@_view @name@_viewed(@name@_lobe lobe, ltsh_light light)
{
    @name@_view view;
    view.center = @name@_warped(lobe, light.offset);
    view.along_u = @name@_warped(lobe, light.half_u);
    view.along_v = @name@_warped(lobe, light.half_v);
    view.height = @name@_heights(lobe, light.offset, view.center, 1.0);
    view.height_u = @name@_heights(lobe, light.half_u, view.along_u, 0.0);
    view.height_v = @name@_heights(lobe, light.half_v, view.along_v, 0.0);
    vec3 straight = abs(view.height_u) + abs(view.height_v);
    vec3 curved = sqrt(view.height_u * view.height_u + view.height_v * view.height_v);
    vec3 reach = light.bound * (light.is_round ? curved : straight);
    view.whole = all(greaterThan(view.height, reach));
    view.dark = any(lessThanEqual(view.height + reach, vec3(0.0)));
    vec3 extent = light.bound * (abs(view.along_u) + abs(view.along_v));
    float inverse = inversesqrt(max(dot(view.center, view.center), 1e-37));
    float reach_of_all = inverse * sqrt(dot(extent, extent));
    vec3 normal = ltsh_unit(cross(inverse * view.along_u, inverse * view.along_v));
    float near = max(abs(inverse * dot(normal, view.center)), 1.0 - reach_of_all);
    view.size = reach_of_all * reach_of_all;
    view.wide = view.size / max(near * near, 1e-20);
@SIZES@    return view;
}

/* The integral over a light so small that its center stands for all of it. */
@name@_sum @name@_at_center(@name@_view view, float area)
{
    float inverse = inversesqrt(max(dot(view.center, view.center), 1e-37));
    vec3 direction = inverse * view.center;
    float solid_angle = area * dot(direction, cross(inverse * view.along_u, inverse * view.along_v));
    return @name@_with_spot(@name@_empty(), direction, solid_angle);
}

/* The integral over a small ellipse or parallelogram by four spots, exact for polynomials of degree 3 on it. */
@name@_sum @name@_in_spots(@name@_view view, bool is_round)
{
    float scale = inversesqrt(max(dot(view.center, view.center), 1e-37));
    vec3 center = scale * view.center;
    vec3 u = scale * view.along_u;
    vec3 v = scale * view.along_v;
    float weight = (is_round ? 0.25 * LTSH_PI : 1.0) * dot(center, cross(u, v));
    vec3 first = is_round ? 0.70710678 * u : 0.57735027 * (u + v);
    vec3 second = is_round ? 0.70710678 * v : 0.57735027 * (u - v);
    @name@_sum sum = @name@_empty();
    for (int k = 0; k < 4; ++k) {
        vec3 place = center + (k % 2 == 0 ? 1.0 : -1.0) * (k < 2 ? first : second);
        float inverse = inversesqrt(max(dot(place, place), 1e-37));
        sum = @name@_with_spot(sum, inverse * place, weight * inverse * inverse * inverse);
    }
    return sum;
}

/* The integral over a light above all horizons, by its edges. */
@name@_sum @name@_of_whole(@name@_view view, ltsh_light light)
{
    @name@_sum sum = @name@_empty();
    vec2 place = ltsh_corner(light.first + light.count - 1);
    vec3 start = ltsh_unit(view.center + place.x * view.along_u + place.y * view.along_v);
    int i = 0;
    do {
        place = ltsh_corner(light.first + i);
        vec3 end = ltsh_unit(view.center + place.x * view.along_u + place.y * view.along_v);
        sum = @name@_with_edge(sum, start, end);
        start = end;
    } while (++i < light.count);
    return sum;
}

/* Adds a third, number `k`, of the triangle of `center` and an edge, whose ends are relative to it. All three are exact
   for polynomials of degree 2. */
@name@_sum @name@_with_third(@name@_sum sum, vec3 center, vec3 start, vec3 end, int k)
{
    float weight = (1.0 / 6.0) * dot(center, cross(start, end));
    vec3 place = center + (1.0 / 6.0) * (start + end) + (k == 0 ? vec3(0.0) : 0.5 * (k == 1 ? start : end));
    float inverse = inversesqrt(max(dot(place, place), 1e-37));
    return @name@_with_spot(sum, inverse * place, weight * inverse * inverse * inverse);
}

/* The integral over the part of any light above all horizons. `tiny` lights are integrated by triangles: their edges
   would lose too many digits to rounding, and the lobe hardly varies over them. */
@name@_sum @name@_of_part(@name@_lobe lobe, @name@_view view, ltsh_light light, bool tiny)
{
    vec3 center = view.center;
    vec3 along_u = view.along_u;
    vec3 along_v = view.along_v;
    /* Tiny lights are cut around their center, others around the point. */
    vec3 origin = tiny ? center : vec3(0.0);
    vec3 shift = center - origin;
    vec2 place = ltsh_corner(light.first + light.count - 1);
    vec3 start = shift + place.x * along_u + place.y * along_v;
    vec3 start_height = view.height + place.x * view.height_u + place.y * view.height_v;
@APICES@
@PINS@
    @name@_sum sum = @name@_empty();
    int i = 0;
    do {
        place = ltsh_corner(light.first + i);
        vec3 end = shift + place.x * along_u + place.y * along_v;
        vec3 end_height = view.height + place.x * view.height_u + place.y * view.height_v;
        vec3 drop = start_height - end_height;
        vec3 share = start_height / mix(drop, vec3(1.0), equal(drop, vec3(0.0)));
        float enter = 0.0;
        float leave = 1.0;
@INTERVAL@
        bool crosses_any = any(notEqual(greaterThan(start_height, vec3(0.0)), greaterThan(end_height, vec3(0.0))));
        int slots = crosses_any ? @SLOTS@ : 1;
        int slot = 0;
        do {
            bool used = enter < leave;
            vec3 from = start + enter * (end - start);
            vec3 to = start + leave * (end - start);
@CLOSING@
            /* An edge without a length adds nothing. */
            from = used ? from : vec3(0.0, 0.0, 1.0);
            to = used ? to : from;
            /* An arc of almost half a circle is split at its nearest point: its ends hardly tell its plane. */
            vec3 last = ltsh_unit(to);
            vec3 before = ltsh_unit(from);
            vec3 both = before + last;
            bool far = dot(both, both) < 0.04;
            vec3 along = to - from;
            float nearest = ltsh_clamped(-dot(from, along) / max(dot(along, along), 1e-37), 1.0);
            vec3 next = far ? ltsh_unit(from + nearest * along) : last;
            int pieces = tiny ? 3 : (far ? 2 : 1);
            int piece = 0;
            do {
                if (tiny) {
                    sum = @name@_with_third(sum, center, from, to, piece);
                } else {
                    sum = @name@_with_edge(sum, before, next);
                }
                before = next;
                next = last;
            } while (++piece < pieces);
        } while (++slot < slots);
        start = end;
        start_height = end_height;
    } while (++i < light.count);
    return sum;
}
