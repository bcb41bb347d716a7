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

_AXES = "xyz"
MAX_PLANES = 3


def integral_function(name: str, planes: int) -> str:
    """GLSL of `name`_sum `name`_integral(`name`_lobe lobe, ltsh_light light) for 1 to 3 horizons.

    Expects, in GLSL, `name`_lobe with normals plane_0 .. of the horizons, `name`_sum, `name`_empty(),
    `name`_with_edge(sum, start, end), `name`_warped(lobe, v) and `name`_heights(lobe, v, warped v, rest), whose
    unused components are `rest`.
    """
    values = {
        "name": name,
        "LAST_SLOT": str(planes),
        "APICES": "\n".join(_apex_lines(name, planes)),
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


def _apex_lines(name, planes):
    """Directions in which two horizons meet: warped, with their heights; w is 0 where the horizons are the same."""
    for k, j in _pairs(planes):
        yield f"    vec3 apex = cross(lobe.plane_{k}, lobe.plane_{j});" if (k, j) == (0, 1) else (
            f"    apex = cross(lobe.plane_{k}, lobe.plane_{j});"
        )
        yield f"    float meets_{k}{j} = dot(apex, apex) > 1e-12 ? 1.0 : 0.0;"
        yield "    apex = dot(apex, light.direction) < 0.0 ? apex : -apex;"
        yield f"    vec3 apex_{k}{j} = {name}_warped(lobe, apex);"
        yield f"    vec3 apex_height_{k}{j} = {name}_heights(lobe, apex, apex_{k}{j}, 1.0);"
        yield f"    apex_height_{k}{j}.{_AXES[k]} = 0.0;"
        yield f"    apex_height_{k}{j}.{_AXES[j]} = 0.0;"


def _interval_lines(planes):
    """From `enter` to `leave` an edge is above all horizons."""
    for k in range(planes):
        a = _AXES[k]
        yield f"        enter = max(enter, start_height.{a} <= 0.0 && end_height.{a} > 0.0 ? share.{a} : 0.0);"
        yield f"        leave = min(leave, start_height.{a} > 0.0 && end_height.{a} <= 0.0 ? share.{a} : 1.0);"
        yield f"        leave = start_height.{a} <= 0.0 && end_height.{a} <= 0.0 ? -1.0 : leave;"


def _closing_lines(planes):
    """The piece of horizon number slot - 1 that an edge's crossing gives."""
    for k in range(planes):
        a = _AXES[k]
        yield f"            if (slot == {k + 1}) {{"
        yield f"                bool rises = end_height.{a} > 0.0;"
        yield f"                vec4 crossing = vec4(start + share.{a} * (end - start), 1.0);"
        others = [j for j in range(planes) if j != k]
        if others:
            yield f"                vec3 height = start_height + share.{a} * (end_height - start_height);"
        for j in others:
            pair = f"{min(k, j)}{max(k, j)}"
            yield f"                if (height.{_AXES[j]} < 0.0 && meets_{pair} > 0.0) {{"
            yield f"                    crossing.xyz = apex_{pair};"
            yield f"                    height = apex_height_{pair};"
            yield "                }"
        yield f"                bool crosses = (start_height.{a} > 0.0) != rises;"
        yield f"                used = crosses && pin_{k}.w > 0.0;"
        yield f"                from = rises ? pin_{k}.xyz : crossing.xyz;"
        yield f"                to = rises ? crossing.xyz : pin_{k}.xyz;"
        yield f"                pin_{k} = crosses && pin_{k}.w == 0.0 ? crossing : pin_{k};"
        yield "            }"


_INTEGRAL = """\
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

    @name@_sum sum = @name@_empty();
    int first_count = whole ? light.count : 0;
    vec2 place = ltsh_corner(light, light.count - 1);
    vec3 start = ltsh_unit(center + place.x * along_u + place.y * along_v);
    for (int i = 0; i < first_count; ++i) {
        place = ltsh_corner(light, i);
        vec3 end = ltsh_unit(center + place.x * along_u + place.y * along_v);
        sum = @name@_with_edge(sum, start, end);
        start = end;
    }

    int second_count = whole || dark ? 0 : light.count;
    place = ltsh_corner(light, light.count - 1);
    start = center + place.x * along_u + place.y * along_v;
    vec3 start_height = height + place.x * height_u + place.y * height_v;
@APICES@
@PINS@
    for (int i = 0; i < second_count; ++i) {
        place = ltsh_corner(light, i);
        vec3 end = center + place.x * along_u + place.y * along_v;
        vec3 end_height = height + place.x * height_u + place.y * height_v;
        vec3 drop = start_height - end_height;
        vec3 share = start_height / mix(drop, vec3(1.0), equal(drop, vec3(0.0)));
        float enter = 0.0;
        float leave = 1.0;
@INTERVAL@
        for (int slot = 0; slot <= @LAST_SLOT@; ++slot) {
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
            int pieces = used ? (far ? 2 : 1) : 0;
            for (int piece = 0; piece < pieces; ++piece) {
                sum = @name@_with_edge(sum, before, next);
                before = next;
                next = last;
            }
        }
        start = end;
        start_height = end_height;
    }
    return sum;
}
"""
