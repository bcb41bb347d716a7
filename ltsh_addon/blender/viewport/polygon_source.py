"""GLSL of the integrals of one lobe over the part of a light above some horizons.

No polygon is stored: edges are integrated as they come. A light that is above all horizons takes the short loop. In
the long one every edge is cut to its part above all of them, and what closes the polygon comes from crossings: on each
horizon the region's boundary is an arc, of which the part inside the light adds up from where edges cross the horizon,

    sum over crossings of +- the integral along the arc from a fixed point to the crossing, moved into the arc.

Any fixed point serves, since crossings come in pairs; the first one found is taken, which for one horizon gives the
closing edges of Sutherland and Hodgman (1974). A crossing beyond another horizon moves to where both horizons meet, of
the two such directions the one from which the light can be seen. Polygons need not be convex.
"""

from __future__ import annotations

from ...shading.table_header.literals import float_literal

_AXES = "xyz"
# Half diagonals of a light, as the lobe sees it, up to which it is sampled: there both that and the rounding of edges,
# which grows with the inverse of the size, are below 2e-4 of the result.
TINY_LIGHT = 0.2


def integral_function(name: str, planes: int, seam: str | None = None) -> str:
    """GLSL of `name`_sum `name`_integral(`name`_lobe lobe, ltsh_light light) for 1 to 3 horizons.

    Expects, in GLSL, `name`_lobe with normals plane_0 .. of the horizons, `name`_sum, `name`_empty(),
    `name`_with_edge(sum, start, end), `name`_with_spot(sum, direction, solid angle), `name`_warped(lobe, v) and
    `name`_heights(lobe, v, warped v, rest), whose unused components are `rest`. `seam` is the direction in which the
    first two horizons meet, if that is known.
    """
    values = {
        "name": name,
        "TINY": float_literal(TINY_LIGHT**2),
        "SLOTS": str(planes + 1),
        "APICES": "\n".join(_apex_lines(name, planes, seam)),
        "INTERVAL": "\n".join(_interval_lines(planes)),
        "CLOSING": "\n".join(_closing_lines(planes)),
        "PINS": "\n".join(f"    vec4 pin_{k} = vec4(0.0);" for k in range(planes)),
    }
    text = _INTEGRAL
    for key, value in values.items():
        text = text.replace(f"@{key}@", value)
    return text


def _pairs(planes):
    return [(k, j) for k in range(planes) for j in range(k + 1, planes)]


def _apex_lines(name, planes, seam):
    """Directions in which two horizons meet: warped, seen from `origin`, with their heights."""
    pairs = _pairs(planes)
    if pairs:
        yield "    vec3 normal = cross(along_u, along_v);"
        yield "    float height_of_center = tiny ? dot(normal, center) : 0.0;"
    for k, j in pairs:
        # The difference of normals that are close is exact.
        meeting = seam if seam and (k, j) == (0, 1) else f"cross(lobe.plane_{k}, lobe.plane_{j} - lobe.plane_{k})"
        yield f"    vec3 meeting_{k}{j} = {meeting};"
        yield f"    meeting_{k}{j} *= dot(meeting_{k}{j}, light.direction) < 0.0 ? 1.0 : -1.0;"
        yield f"    vec3 apex_{k}{j} = ltsh_unit({name}_warped(lobe, meeting_{k}{j}));"
        yield f"    vec3 apex_height_{k}{j} = {name}_heights(lobe, meeting_{k}{j}, apex_{k}{j}, 1.0);"
        yield f"    float slope_{k}{j} = dot(normal, apex_{k}{j});"
        yield f"    slope_{k}{j} = tiny && abs(slope_{k}{j}) > 1e-37 ? height_of_center / slope_{k}{j} : 1.0;"
        yield f"    apex_{k}{j} = slope_{k}{j} * apex_{k}{j} - origin;"


def _interval_lines(planes):
    """From `enter` to `leave` an edge is above all horizons."""
    for k in range(planes):
        a = _AXES[k]
        yield f"        enter = max(enter, start_height.{a} <= 0.0 && end_height.{a} > 0.0 ? share.{a} : 0.0);"
        yield f"        leave = min(leave, start_height.{a} > 0.0 && end_height.{a} <= 0.0 ? share.{a} : 1.0);"
        yield f"        leave = start_height.{a} <= 0.0 && end_height.{a} <= 0.0 ? -1.0 : leave;"


def _closing_lines(planes):
    """The piece of horizon number slot - 1 that an edge's crossing gives.

    Of an edge that crosses two horizons, which it crosses first says where it is below the other: by the same
    comparison for both, so that rounding cannot leave the polygon open, however close together they are.
    """
    for k in range(planes):
        a = _AXES[k]
        yield f"            if (slot == {k + 1}) {{"
        yield f"                bool rises = end_height.{a} > 0.0;"
        yield f"                vec4 crossing = vec4(start + share.{a} * (end - start), 1.0);"
        yield from _moving_lines(k, [j for j in range(planes) if j != k])
        yield f"                bool crosses = (start_height.{a} > 0.0) != rises;"
        yield f"                used = crosses && pin_{k}.w > 0.0;"
        yield f"                from = rises ? pin_{k}.xyz : crossing.xyz;"
        yield f"                to = rises ? crossing.xyz : pin_{k}.xyz;"
        yield f"                pin_{k} = crosses && pin_{k}.w == 0.0 ? crossing : pin_{k};"
        yield "            }"


def _moving_lines(k, others):
    """Move a crossing of horizon k that is below another one to where both meet."""
    a = _AXES[k]
    if others:
        yield "                bool below;"
    for number, j in enumerate(others):
        b, pair = _AXES[j], f"{min(k, j)}{max(k, j)}"
        tie = f" || share.{a} == share.{b} && %srises" if k < j else ""
        falls = f"!(share.{a} < share.{b}{tie.replace('%s', '!')})"
        climbs = f"!(share.{a} > share.{b}{tie.replace('%s', '')})"
        yield f"                below = start_height.{b} > 0.0"
        yield f"                    ? end_height.{b} <= 0.0 && {falls}"
        yield f"                    : end_height.{b} <= 0.0 || {climbs};"
        for earlier in others[:number]:
            moved = f"{min(k, earlier)}{max(k, earlier)}"
            yield f"                below = moved_{moved} ? apex_height_{moved}.{b} < 0.0 : below;"
        if number + 1 < len(others):
            yield f"                bool moved_{pair} = below;"
        yield f"                crossing.xyz = below ? apex_{pair} : crossing.xyz;"


_INTEGRAL = """\
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
    bool tiny = dot(extent, extent) < @TINY@ * dot(center, center);

    @name@_sum sum = @name@_empty();
    int first_count = whole && !tiny ? light.whole_count : 0;
    vec2 place = ltsh_corner(light.whole_first + light.whole_count - 1);
    vec3 start = ltsh_unit(center + place.x * along_u + place.y * along_v);
    for (int i = 0; i < first_count; ++i) {
        place = ltsh_corner(light.whole_first + i);
        vec3 end = ltsh_unit(center + place.x * along_u + place.y * along_v);
        sum = @name@_with_edge(sum, start, end);
        start = end;
    }

    int tiny_count = whole && tiny ? light.whole_count : 0;
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
"""
