"""The text of the lighting shaders."""

from __future__ import annotations

import re
from dataclasses import dataclass

import numpy as np

from ...cycles import horizons
from ...shading import light_cone, moments32
from ...shading.header import float_literal, moment_lines, shared_text
from ...shading.light_polygons import ROUND_CORNERS
from ...shading.lookup_table import LookupTable
from . import textures
from .textures import IOR_STEPS

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


def spread_function(name: str, arguments: str, value: str, frame: str) -> str:
    """GLSL of vec4 `name`_focused(`name`_lobe lobe, `arguments` ltsh_light light, int header, float width, bool used).

    Expects `disk_parts_source.spread_text` and what `polygon_source.integral_function` expects. `value` is the vec4
    that a `name`_sum `sum` stands for, and `frame` a matrix to the coordinates in which the lobe lies around e_z, of
    vectors that `name`_warped gives.
    """
    text = _FOCUSED
    for key, piece in {"name": name, "ARGUMENTS": arguments, "VALUE": value, "FRAME": frame}.items():
        text = text.replace(f"@{key}@", piece)
    return text


_FOCUSED = """\
vec4 @name@_focused(@name@_lobe lobe, @ARGUMENTS@ltsh_light light, int header, float width, bool used)
{
    vec4 cone = ltsh_light_texel(header + 5);
    float distance = max(-dot(light.offset, light.direction), 1e-30);
    float reach = cone.x * distance;
    vec2 extent = vec2(length(light.half_u), length(light.half_v));
    vec3 axis_u = light.half_u / max(extent.x, 1e-37);
    vec3 axis_v = cross(light.direction, axis_u);
    vec2 center = vec2(dot(light.offset, axis_u), dot(light.offset, axis_v));
    vec2 flat_v = vec2(dot(light.half_v, axis_u), dot(light.half_v, axis_v));
    float beside = length(center);
    float radius_of_light = 1.02 * length(extent);
    ltsh_effort effort = ltsh_effort_of(light, width, radius_of_light, reach, beside);

    ltsh_part part;
    part.count = used && beside < reach + radius_of_light ? effort.count : 0;
    for (int i = 0; i < part.count; ++i) {
        ltsh_corners[i] = ltsh_corner(effort.first + i);
    }
    vec3 foot = -distance * @name@_warped(lobe, light.direction);
    vec3 height = @name@_heights(lobe, light.offset, @name@_warped(lobe, light.offset), 1.0);
    vec3 height_u = @name@_heights(lobe, light.half_u, @name@_warped(lobe, light.half_u), 0.0);
    vec3 height_v = @name@_heights(lobe, light.half_v, @name@_warped(lobe, light.half_v), 0.0);
    part = ltsh_above(part, height.x, height_u.x, height_v.x);
    part = ltsh_above(part, height.y, height_u.y, height_v.y);
    part = ltsh_above(part, height.z, height_u.z, height_v.z);
    for (int i = 0; i < part.count; ++i) {
        vec2 place = ltsh_corners[i];
        ltsh_corners[i] = center + place.x * vec2(extent.x, 0.0) + place.y * flat_v;
    }
    part = ltsh_measured(part);

    /* Where the lobe meets the light best, and how far it reaches there. */
    vec3 warped_u = @name@_warped(lobe, axis_u);
    vec3 warped_v = @name@_warped(lobe, axis_v);
    mat3 to_lobe = @FRAME@;
    vec3 f = to_lobe * foot;
    vec3 u = to_lobe * warped_u;
    vec3 v = to_lobe * warped_v;
    float determinant = u.x * v.y - v.x * u.y;
    bool faces = abs(determinant) > 1e-6 * sqrt(dot(u, u) * dot(v, v));
    determinant = faces ? determinant : 1.0;
    vec2 peak = vec2(v.x * f.y - v.y * f.x, u.y * f.x - u.x * f.y) / determinant;
    float peak_height = f.z + peak.x * u.z + peak.y * v.z;
    faces = faces && peak_height > 0.0;
    vec2 nearest = center + clamp(peak - center, -extent, extent);
    vec2 off = peak - nearest;
    float peak_distance = length(nearest);
    vec2 toward = peak_distance > 0.0 ? nearest / peak_distance : nearest;
    vec2 across = vec2(v.y * toward.x - u.y * toward.y, u.x * toward.y - v.x * toward.x);
    float slope = peak_height / determinant;
    float low = part.least;
    float high = min(part.largest, reach);
    float span = high - low;
    float middle = faces ? clamp(peak_distance, low, high) : low;
    float peak_width = faces ? sqrt(slope * slope * dot(across, across) + dot(off, off)) : 1e37;
    peak_width = clamp(peak_width, LTSH_LEAST_WIDTH * span, LTSH_MOST_WIDTH * span);
    float safe_width = peak_width > 0.0 ? peak_width : 1.0;
    float first = ltsh_asinh((low - middle) / safe_width);
    float half_range = 0.5 * (ltsh_asinh((high - middle) / safe_width) - first);

    vec2 pivot = part.least * part.forward;
    vec3 pivot_warped = foot + pivot.x * warped_u + pivot.y * warped_v;
    vec4 values = vec4(0.0);
    bool seen = part.count > 2 && part.least < reach;
    /* After the disks comes all of the part, where the cone contains it. */
    int layers = seen ? effort.layers + (part.largest < reach ? 1 : 0) : 0;
    for (int layer = 0; layer < layers; ++layer) {
        bool all_of_it = layer == effort.layers;
        vec2 node = ltsh_light_texel(effort.nodes + (all_of_it ? 0 : layer)).xy;
        float place = first + half_range * (1.0 + node.x);
        float grown = exp(place);
        float radius = all_of_it ? part.largest : middle + peak_width * 0.5 * (grown - 1.0 / grown);
        float weight = all_of_it ? reach - part.largest
                                 : node.y * half_range * peak_width * 0.5 * (grown + 1.0 / grown);
        float lowest = 4.0;
        float highest = -4.0;
        for (int i = 0; i < part.count; ++i) {
            ltsh_cut edge = ltsh_cut_of(part, i, radius);
            bool meets = edge.last > edge.first;
            lowest = meets ? min(lowest, min(edge.entry, edge.leave)) : lowest;
            highest = meets ? max(highest, max(edge.entry, edge.leave)) : highest;
        }
        lowest = part.encloses ? -4.0 : lowest;
        highest = part.encloses ? 4.0 : max(lowest, highest);

        vec3 reaching = sqrt(max(radius * radius - part.least * part.least, 0.0)) * (abs(warped_u) + abs(warped_v));
        bool tiny = dot(reaching, reaching) < LTSH_TINY * dot(pivot_warped, pivot_warped);
        @name@_sum sum = @name@_empty();
        vec3 before = vec3(0.0);
        int per_edge = 2 * effort.chords + 1;
        for (int i = 0; i < part.count; ++i) {
            ltsh_cut edge = ltsh_cut_of(part, i, radius);
            float size = min(length(ltsh_corners[i]), radius);
            float next_size = min(length(ltsh_corners[i + 1 < part.count ? i + 1 : 0]), radius);
            for (int k = 0; k <= per_edge; ++k) {
                bool entering = k <= effort.chords;
                vec2 corner = ltsh_arc_corner(
                    part,
                    clamp(entering ? edge.start : edge.leave, lowest, highest),
                    clamp(entering ? edge.entry : edge.end, lowest, highest),
                    entering ? size : next_size,
                    effort.chords,
                    entering ? k : k - effort.chords - 1
                );
                vec2 moved = corner - pivot;
                vec3 last = moved.x * warped_u + moved.y * warped_v;
                last = tiny ? last : ltsh_unit(pivot_warped + last);
                int edges = k == 0 ? 0 : 1;
                for (int piece = 0; piece < (tiny ? 0 : edges); ++piece) {
                    sum = @name@_with_edge(sum, before, last);
                }
                for (int piece = 0; piece < (tiny ? edges : 0); ++piece) {
                    sum = @name@_with_triangle(sum, pivot_warped, before, last);
                }
                before = last;
            }
        }
        values += weight * @VALUE@;
    }
    return values * cone.y / distance;
}
"""

# Of round lights 64, and one more for each of three horizons.
MOST_CORNERS = 67


def spread_text() -> str:
    """GLSL that does not depend on the lobe; after that of the lights."""
    plain, beyond, sharp, sharpest = light_cone.EFFORTS
    layers = f"{beyond.layers}"
    if {beyond.layers, sharp.layers, sharpest.layers} != {beyond.layers}:
        raise ValueError("the efforts of light_cone have changed: all but the first had equally many layers")
    values = {
        "MOST": MOST_CORNERS,
        "TINY": float_literal(TINY_LIGHT**2),
        "FEW_LAYERS": plain.layers,
        "MANY_LAYERS": layers,
        "FEW_NODES": textures.NODES_FIRST[plain.layers],
        "MANY_NODES": textures.NODES_FIRST[beyond.layers],
        "CHORDS": plain.chords,
        "SHARP_CHORDS": sharp.chords,
        "SHARPEST_CHORDS": sharpest.chords,
        "WIDE": float_literal(light_cone.WIDE_LOBE),
        "SHARP": float_literal(light_cone.SHARP_LOBE),
        "WELL_INSIDE": float_literal(light_cone.WELL_INSIDE),
        "LEAST_WIDTH": float_literal(light_cone.WIDTH_RANGE[0]),
        "MOST_WIDTH": float_literal(light_cone.WIDTH_RANGE[1]),
        "ROUND_FIRST": textures.circle_first(32),
        "SHARP_ROUND_FIRST": textures.circle_first(64),
    }
    text = _SPREAD
    for key, value in values.items():
        text = text.replace(f"@{key}@", str(value))
    return text


_SPREAD = """\
#define LTSH_MOST_CORNERS @MOST@
#define LTSH_TINY @TINY@
#define LTSH_LEAST_WIDTH @LEAST_WIDTH@
#define LTSH_MOST_WIDTH @MOST_WIDTH@

/* A part of a light in coordinates of its plane with the foot of the point as the origin, and what disks need of it.
   Its corners are a variable of their own: compilers take minutes over structures that hold arrays. */
vec2 ltsh_corners[LTSH_MOST_CORNERS];
struct ltsh_part { int count; float least; float largest; bool encloses; vec2 forward; };
/* How a light is taken apart: texels of nodes and corners, and how many there are of each. */
struct ltsh_effort { int layers; int nodes; int chords; int first; int count; };
/* Of an edge: its part inside a disk, and the angles from `forward` of its ends and of those of that part. */
struct ltsh_cut { float first; float last; float start; float entry; float leave; float end; };

float ltsh_cross2(vec2 a, vec2 b) { return a.x * b.y - a.y * b.x; }

ltsh_effort ltsh_effort_of(ltsh_light light, float width, float extent, float reach, float beside)
{
    bool inside = extent < @WELL_INSIDE@ * (reach - beside);
    bool sharpest = width < @SHARP@;
    bool sharp = width < @WIDE@ && !inside;
    ltsh_effort effort;
    effort.layers = inside && !sharpest ? @FEW_LAYERS@ : @MANY_LAYERS@;
    effort.nodes = inside && !sharpest ? @FEW_NODES@ : @MANY_NODES@;
    effort.chords = sharpest ? @SHARPEST_CHORDS@ : (sharp ? @SHARP_CHORDS@ : @CHORDS@);
    effort.first = light.first;
    effort.count = light.count;
    if (light.is_round) {
        bool many = effort.chords > 2;
        effort.first = many ? @SHARP_ROUND_FIRST@ : @ROUND_FIRST@;
        effort.count = many ? 64 : 32;
        effort.chords = 2;
    }
    return effort;
}

/* The convex part in which height + s * height_u + t * height_v is positive; corners are s, t. */
ltsh_part ltsh_above(ltsh_part part, float height, float height_u, float height_v)
{
    int kept = 0;
    vec2 previous = ltsh_corners[max(part.count - 1, 0)];
    float previous_height = height + previous.x * height_u + previous.y * height_v;
    vec2 current = ltsh_corners[0];
    for (int i = 0; i < part.count; ++i) {
        float current_height = height + current.x * height_u + current.y * height_v;
        /* Up to two corners are written: the next is read before. */
        vec2 next = ltsh_corners[min(i + 1, part.count - 1)];
        if ((previous_height > 0.0) != (current_height > 0.0)) {
            float share = previous_height / (previous_height - current_height);
            ltsh_corners[min(kept, LTSH_MOST_CORNERS - 1)] = previous + share * (current - previous);
            ++kept;
        }
        if (current_height > 0.0) {
            ltsh_corners[min(kept, LTSH_MOST_CORNERS - 1)] = current;
            ++kept;
        }
        previous = current;
        previous_height = current_height;
        current = next;
    }
    part.count = min(kept, LTSH_MOST_CORNERS);
    return part;
}

/* Nearest and farthest distance of the part from the foot, and whether that lies in it. */
ltsh_part ltsh_measured(ltsh_part part)
{
    part.largest = 0.0;
    for (int i = 0; i < part.count; ++i) {
        part.largest = max(part.largest, dot(ltsh_corners[i], ltsh_corners[i]));
    }
    bool left = true;
    bool right = true;
    bool has_sides = false;
    float least = 1e37;
    vec2 nearest = vec2(0.0);
    for (int i = 0; i < part.count; ++i) {
        vec2 start = ltsh_corners[i];
        vec2 along = ltsh_corners[i + 1 < part.count ? i + 1 : 0] - start;
        float squared = dot(along, along);
        /* An edge between corners that rounding alone tells apart has no sides. */
        bool has_side = squared > 1.2e-7 * part.largest;
        float side = ltsh_cross2(start, along);
        left = left && (side >= 0.0 || !has_side);
        right = right && (side <= 0.0 || !has_side);
        has_sides = has_sides || has_side;
        vec2 place = start + clamp(-dot(start, along) / max(squared, 1e-37), 0.0, 1.0) * along;
        bool nearer = dot(place, place) < least;
        least = nearer ? dot(place, place) : least;
        nearest = nearer ? place : nearest;
    }
    part.largest = sqrt(part.largest);
    part.encloses = has_sides && (left || right);
    float size = sqrt(least);
    part.least = part.encloses ? 0.0 : size;
    part.forward = size > 0.0 ? nearest / size : vec2(1.0, 0.0);
    return part;
}

float ltsh_angle(ltsh_part part, vec2 place)
{
    return atan(ltsh_cross2(part.forward, place), dot(part.forward, place));
}

ltsh_cut ltsh_cut_of(ltsh_part part, int i, float radius)
{
    vec2 start = ltsh_corners[i];
    vec2 end = ltsh_corners[i + 1 < part.count ? i + 1 : 0];
    vec2 along = end - start;
    float squared = dot(along, along);
    squared = squared > 0.0 ? squared : 1.0;
    float side = ltsh_cross2(start, along);
    float middle = -dot(start, along);
    float root = sqrt(max(squared * radius * radius - side * side, 0.0));
    ltsh_cut edge;
    edge.first = clamp((middle - root) / squared, 0.0, 1.0);
    edge.last = clamp((middle + root) / squared, 0.0, 1.0);
    edge.start = ltsh_angle(part, start);
    edge.entry = ltsh_angle(part, start + edge.first * along);
    edge.leave = ltsh_angle(part, start + edge.last * along);
    edge.end = ltsh_angle(part, end);
    return edge;
}

/* Corner number k of `chords` chords from angle to angle that enclose the area of the arc. */
vec2 ltsh_arc_corner(ltsh_part part, float start, float end, float size, int chords, int k)
{
    float turn = end - start;
    turn -= abs(turn) > 3.14159265 ? (turn > 0.0 ? 6.28318531 : -6.28318531) : 0.0;
    float turn_of_one = turn / float(chords);
    float sine = sin(turn_of_one);
    float more = float(chords - 2);
    float total = float(chords) * (sine == 0.0 ? 1.0 : turn_of_one / sine);
    float beyond = chords == 2 ? 0.5 * total : (sqrt(1.0 + more * total) - 1.0) / max(more, 1.0);
    float distance = k == 0 || k == chords ? size : size * beyond;
    float angle = start + float(k) * turn_of_one;
    vec2 across = vec2(-part.forward.y, part.forward.x);
    return distance * (cos(angle) * part.forward + sin(angle) * across);
}

float ltsh_asinh(float x) { return (x < 0.0 ? -1.0 : 1.0) * log(abs(x) + sqrt(x * x + 1.0)); }
"""

COSINE_SUM = """\
/* Integral of z over a polygon, times 2. */
struct specular_sum { float values[1]; };

specular_sum specular_empty()
{
    specular_sum sum;
    sum.values[0] = 0.0;
    return sum;
}

specular_sum specular_with_edge(specular_sum sum, vec3 start, vec3 end)
{
    ltsh_edge edge = ltsh_edge_between(start, end);
    sum.values[0] += edge.normal.z * edge.phi;
    return sum;
}

specular_sum specular_with_spot(specular_sum sum, vec3 direction, float solid_angle)
{
    sum.values[0] += 2.0 * solid_angle * direction.z;
    return sum;
}

specular_sum specular_finished(specular_sum sum)
{
    sum.values[0] *= 0.5 * LTSH_ONE_OVER_PI;
    return sum;
}
"""

MOMENT_SUM = """\
/* Moments of a polygon; to the first, the solid angle, comes twice the argument of the complex number `turn`. */
struct specular_sum { float values[LTSH_COEFFICIENTS]; vec2 turn; };

specular_sum specular_empty()
{
    specular_sum sum;
    for (int k = 0; k < LTSH_COEFFICIENTS; ++k) {
        sum.values[k] = 0.0;
    }
    sum.turn = vec2(1.0, 0.0);
    return sum;
}

specular_sum specular_with_edge(specular_sum moments, vec3 start, vec3 end)
{
    ltsh_edge edge = ltsh_edge_between(start, end);
    vec2 turn = vec2(edge.total.z + ltsh_one_plus_cosine(edge.total), edge.normal.z);
    turn = vec2(moments.turn.x * turn.x - moments.turn.y * turn.y, moments.turn.x * turn.y + moments.turn.y * turn.x);
    /* Only the argument matters: keep the magnitude near one. */
    float magnitude = abs(turn.x) + abs(turn.y);
    moments.turn = magnitude > 0.0 ? turn / magnitude : moments.turn;
@MOMENT_LINES@
    return moments;
}

/* What moments integrate: where an edge adds K_{n-1} of `edge_integrals`, (n + 1) x^n - (n - 1) |u|^2 x^(n-2). */
float ltsh_spot_moment(vec3 direction, float u_x, float u_z, int k)
{
    float x = u_x * direction.x + u_z * direction.z;
    float squared = u_x * u_x + u_z * u_z;
    return k == 0 ? 2.0 * x
        : (k == 1 ? 3.0 * x * x - squared
                  : (k == 2 ? 2.0 * x * (2.0 * x * x - squared) : x * x * (5.0 * x * x - 3.0 * squared)));
}

specular_sum specular_with_spot(specular_sum moments, vec3 direction, float solid_angle)
{
    moments.values[0] += solid_angle;
@SPOT_LINES@
    return moments;
}

specular_sum specular_finished(specular_sum sum)
{
    sum.values[0] += 2.0 * atan(sum.turn.y, sum.turn.x);
    return sum;
}
"""

SPECULAR_LOBE = """\
/* Axes of the warped local frame, and the normals of the horizons. */
struct specular_lobe { vec3 row_x; vec3 row_y; vec3 row_z; vec3 plane_0; vec3 plane_1; vec3 plane_2; bool is_spare; };
/* Weights of the moments by Fresnel term, and how wide the lobe is in radians. */
struct specular_weights {
    float plain[LTSH_COEFFICIENTS]; float schlick[LTSH_COEFFICIENTS]; float dip[LTSH_COEFFICIENTS];
    float dielectric[LTSH_COEFFICIENTS]; float width;
};

vec3 specular_warped(specular_lobe lobe, vec3 v)
{
    return vec3(dot(lobe.row_x, v), dot(lobe.row_y, v), dot(lobe.row_z, v));
}
"""

LOOKUP = """\
vec4 ltsh_table_at(ltsh_cell cell, int layer)
{
    ivec3 node = ivec3(cell.node % LTSH_COLUMNS, cell.node / LTSH_COLUMNS, layer);
    vec4 first = texelFetch(table, node, 0);
    first += cell.column_weight * (texelFetch(table, node + ivec3(1, 0, 0), 0) - first);
    vec4 second = texelFetch(table, node + ivec3(0, 1, 0), 0);
    second += cell.column_weight * (texelFetch(table, node + ivec3(1, 1, 0), 0) - second);
    return first + cell.row_weight * (second - first);
}

specular_sum ltsh_curve_at(ltsh_cell cell, int curve)
{
    int layer = 1 + curve * LTSH_BLOCKS;
    specular_sum weights = specular_empty();
@FETCHES@
@VALUES@
    return weights;
}

/* Weights of four curves for a dielectric; w of column 1 is 1 + the number of its own curve, if it has one. */
vec4 ltsh_dielectric_texel(float position, int column)
{
    int last = textureSize(dielectrics, 0).y - 1;
    int row = min(int(position), last);
    vec4 near = texelFetch(dielectrics, ivec2(column, row), 0);
    vec4 far = texelFetch(dielectrics, ivec2(column, min(row + 1, last)), 0);
    return near + (position - float(row)) * (far - near);
}

specular_weights ltsh_weights(ltsh_cell cell, ltsh_point point)
{
    specular_weights w;
    for (int k = 0; k < LTSH_COEFFICIENTS; ++k) {
        w.plain[k] = 0.0;
        w.schlick[k] = 0.0;
        w.dip[k] = 0.0;
        w.dielectric[k] = 0.0;
    }
    vec3 dip = vec3(point.f0.w, point.f90.w, point.dielectric.w);
    bool dipped = any(notEqual(dip, vec3(0.0)));
    bool metal = dipped || any(notEqual(point.f0.xyz, vec3(0.0))) || any(notEqual(point.f90.xyz, vec3(0.0)));
    bool coated = any(notEqual(point.dielectric.xyz, vec3(0.0)));
    float last = float(textureSize(dielectrics, 0).y - 1);
    float position = ltsh_clamped((point.ior - 1.0) * LTSH_IOR_STEPS, last);
    float nearest = floor(position + 0.5);
    float own = texelFetch(dielectrics, ivec2(1, int(nearest)), 0).w;
    bool known = own > 0.0 && abs(position - nearest) < 1e-3;
    vec4 first_shares = ltsh_dielectric_texel(position, 0);
    vec4 last_shares = ltsh_dielectric_texel(position, 1);
    bool summed = coated && !known;
    int count = summed ? LTSH_CURVES : (metal ? (dipped ? 3 : 2) : 0);
    int end = coated && known ? count + 1 : count;
    for (int i = 0; i < end; ++i) {
        bool is_own = i == count;
        int curve = is_own ? LTSH_CURVES + int(own) - 1 : i;
        vec4 four = i < 4 ? first_shares : last_shares;
        int component = i % 4;
        float part = component == 0 ? four.x : (component == 1 ? four.y : (component == 2 ? four.z : four.w));
        vec4 share = vec4(i == 0 ? 1.0 : 0.0, i == 1 ? 1.0 : 0.0, i == 2 ? 1.0 : 0.0, summed ? part : 0.0);
        share = is_own ? vec4(0.0, 0.0, 0.0, 1.0) : share;
        specular_sum values = ltsh_curve_at(cell, curve);
@ADD@
    }
    w.width = max(point.roughness, 1e-3) * max(point.roughness, 1e-3);
    return w;
}
"""

TILT = """\
    float sine = sin(entries.w);
    float cosine = cos(entries.w);
    vec3 toward = sine * lobe.row_x + cosine * lobe.row_z;
    lobe.row_x = cosine * lobe.row_x - sine * lobe.row_z;
    lobe.row_z = toward;
"""

SPECULAR_SETUP = """\
ltsh_cell specular_cell(ltsh_point point)
{
    ltsh_frame frame = ltsh_make_frame(point.normal, point.view);
    float cosine = ltsh_clamped(dot(point.normal, point.view), 1.0);
    float sine = ltsh_clamped(dot(frame.tangent, point.view - point.normal), 1.0);
    return ltsh_make_cell_at(cosine, sine, point.roughness, LTSH_ROWS, LTSH_COLUMNS);
}

specular_lobe specular_at(ltsh_point point, ltsh_cell cell)
{
    ltsh_frame frame = ltsh_make_frame(point.normal, point.view);
    vec4 entries = ltsh_table_at(cell, 0);
    ltsh_warp warp = ltsh_make_warp(cell, entries.x, entries.y, entries.z, 0.0);
    specular_lobe lobe;
    lobe.row_x = warp.xx * frame.tangent + warp.xz * frame.normal;
    lobe.row_y = warp.yy * frame.bitangent;
    lobe.row_z = warp.zz * frame.normal;
@TILT@
    lobe.plane_1 = vec3(0.0);
    lobe.plane_2 = vec3(0.0);
    lobe.is_spare = true;
@PLANES@
    return lobe;
}
"""

SPECULAR = """\
float ltsh_product(float weights[LTSH_COEFFICIENTS], specular_sum sum)
{
    float product = 0.0;
    for (int k = 0; k < LTSH_COEFFICIENTS; ++k) {
        product += weights[k] * sum.values[k];
    }
    /* Corners run clockwise as seen from the point. */
    return max(-product, 0.0);
}

/* Integrals of the plain, the Schlick, the dip and the dielectric term. */
vec4 specular_values(specular_weights weights, specular_sum sum)
{
    sum = specular_finished(sum);
    return vec4(
        ltsh_product(weights.plain, sum),
        ltsh_product(weights.schlick, sum),
        ltsh_product(weights.dip, sum),
        ltsh_product(weights.dielectric, sum)
    );
}

vec3 ltsh_reflected(ltsh_point point, vec4 values)
{
    vec3 reflected = point.f0.xyz * values.x + (point.f90.xyz - point.f0.xyz) * values.y;
    reflected -= vec3(point.f0.w, point.f90.w, point.dielectric.w) * values.z;
    reflected += point.dielectric.xyz * values.w;
    return max(reflected, vec3(0.0));
}
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

VERTEX = """\
void main()
{
    gl_Position = vec4(corner, 0.0, 1.0);
}
"""


@dataclass(frozen=True)
class Features:
    """What a shader is compiled for."""

    specular: bool
    diffuse: bool
    geometric: bool  # a horizon of its own for the specular lobe
    bumped: bool  # a horizon of its own for the diffuse lobe
    focused: bool = False  # lights with a spread
    turned: bool = False  # a diffuse normal of its own


def fragment_source(table: LookupTable, features: Features) -> str:
    """The fragment shader for `table` of degree 1 to 4."""
    if table.degree > moments32.MAX_DEGREE:
        raise ValueError(
            f"table {table.name} has degree {table.degree}, the graphics card's path goes up to {moments32.MAX_DEGREE}"
        )
    lights = LIGHTS.replace("@ROUND_LEVELS@", _round_levels())
    parts = ["#define LTSH_GLSL 1", shared_text(), _constants(table), LIGHT_TEXELS, lights]
    if features.focused:
        parts.append(spread_text())
    if features.specular:
        parts += _specular_parts(table, features)
    if features.diffuse:
        parts += _diffuse_parts(features)
    return "\n".join([*parts, _main(features)])


def _specular_parts(table, features) -> list[str]:
    is_cosine = table.family == "ltc"
    horizons = 1 + is_cosine + features.geometric
    # A tilt turns around the second axis of the frame, and so does the horizon.
    seam = "lobe.row_y" if is_cosine else None
    parts = [COSINE_SUM if is_cosine else _moment_sum(table), SPECULAR_LOBE]
    parts += [_heights("specular", "warped.z", int(is_cosine), features.geometric)]
    parts += [integral_function("specular", horizons, seam)]
    parts += [_lookup(table), _specular_setup(is_cosine, features.geometric), SPECULAR]
    if features.focused:
        values = "specular_values(weights, sum)"
        parts.append(spread_function("specular", "specular_weights weights, ", values, "mat3(1.0)"))
    return parts


def _diffuse_parts(features) -> list[str]:
    parts = [DIFFUSE_LOBE, _heights("diffuse", "dot(lobe.plane_0, v)", 0, features.bumped)]
    parts += [integral_function("diffuse", 1 + features.bumped), _diffuse_start(features)]
    if features.focused:
        value = "vec4(diffuse_form_factor(lobe, sum), 0.0, 0.0, 0.0)"
        parts += [DIFFUSE_FRAME, spread_function("diffuse", "", value, "diffuse_frame(lobe)")]
    return parts


def _diffuse_start(features) -> str:
    if features.bumped:
        return BUMPED
    normal = "texelFetch(diffuse_normals, texel, 0).xyz" if features.turned else "point.normal"
    return PLAIN.replace("@DIFFUSE_NORMAL@", normal)


def _constants(table) -> str:
    rows, columns, parameters = table.warp.shape
    curves, count = table.coefficients.shape[2:]
    values = {
        "ROWS": rows,
        "COLUMNS": columns,
        "PARAMETERS": parameters,
        "CURVES": curves,
        "COEFFICIENTS": count,
        "BLOCKS": -(-count // 4),
        **textures.constants(),
        "ONE_OVER_PI": float_literal(1.0 / np.pi),
        "IOR_STEPS": float_literal(IOR_STEPS),
    }
    return "\n".join(f"#define LTSH_{name} {value}" for name, value in values.items()) + "\n"


def _heights(name, first, more, own) -> str:
    """Heights of v above the horizons; `own` adds one that is left out where it is another one's."""
    others = [f"dot(lobe.plane_{k}, v)" if k <= more else "rest" for k in (1, 2)]
    if own:
        others[more] = f"lobe.is_spare ? rest : dot(lobe.plane_{more + 1}, v)"
    return (
        f"vec3 {name}_heights({name}_lobe lobe, vec3 v, vec3 warped, float rest)\n"
        f"{{\n    return vec3({first}, {', '.join(others)});\n}}\n"
    )


def _moment_sum(table) -> str:
    lines = "\n".join(line[4:] for line in moment_lines(table.degree))
    spots = re.sub(r"ltsh_edge_moment\(edge, (.*)\);", r"solid_angle * ltsh_spot_moment(direction, \1);", lines)
    return MOMENT_SUM.replace("@MOMENT_LINES@", lines).replace("@SPOT_LINES@", spots)


def _lookup(table) -> str:
    count = table.coefficients.shape[3]
    blocks = -(-count // 4)
    fetches = [f"    vec4 block_{n} = ltsh_table_at(cell, layer + {n});" for n in range(blocks)]
    values = [f"    weights.values[{k}] = block_{k // 4}.{'xyzw'[k % 4]};" for k in range(count)]
    source = LOOKUP.replace("@FETCHES@", "\n".join(fetches)).replace("@VALUES@", "\n".join(values))
    for name, operation in (("CLEAR", "w.{v}[{k}] = 0.0;"), ("ADD", "w.{v}[{k}] += share.{c} * values.values[{k}];")):
        lines = [
            "        " + operation.format(v=vector, k=k, c=component)
            for k in range(count)
            for vector, component in zip(("plain", "schlick", "dip", "dielectric"), "xyzw", strict=True)
        ]
        source = source.replace(f"@{name}@", "\n".join(lines))
    return source


def _round_levels() -> str:
    """The list of corners that a round light takes, from how far it reaches in units of the lobe's width."""
    lines = []
    for first, count, limit in reversed(textures.ROUND_LEVELS):
        condition = "round" if np.isinf(limit) else f"round && wide <= {float_literal(limit)}"
        whole = [f"    light.whole_first = {condition} ? {first} : light.whole_first;"]
        whole.append(f"    light.whole_count = {condition} ? {count} : light.whole_count;")
        if count < ROUND_CORNERS[0]:
            lines += whole
            continue
        lines.append(f"    light.first = {condition} ? {first} : light.first;")
        lines.append(f"    light.count = {condition} ? {count} : light.count;")
        if count == ROUND_CORNERS[0]:
            lines += ["    light.whole_first = light.first;", "    light.whole_count = light.count;"]
    return "\n".join(lines)


def _specular_setup(is_cosine, geometric) -> str:
    lines = ["    lobe.plane_0 = ltsh_unit(lobe.row_z);"]
    if is_cosine:
        lines.append("    lobe.plane_1 = point.normal;")
    if geometric:
        lines.append(f"    lobe.plane_{1 + is_cosine} = point.geometric;")
        lines.append("    lobe.is_spare = ltsh_is_same(point.geometric, point.normal);")
    tilt = TILT if is_cosine else ""
    return SPECULAR_SETUP.replace("@TILT@", tilt).replace("@PLANES@", "\n".join(lines))


def _main(features) -> str:
    source = MAIN
    pieces = {
        "IS_FOCUSED": "ltsh_light_texel(header + 5).x > 0.0" if features.focused else "false",
        "READ_FRESNEL": READ_FRESNEL if features.specular else "",
        "READ_GEOMETRIC": "texelFetch(geometric_normals, texel, 0).xyz" if features.geometric else "point.normal",
        "SPECULAR_SETUP": SETUP_SPECULAR if features.specular else "",
        "DIFFUSE_SETUP": "    diffuse_lobe matte = diffuse_at(point, texel);" if features.diffuse else "",
        "SPECULAR": ADD_SPECULAR if features.specular else "",
        "DIFFUSE": ADD_DIFFUSE if features.diffuse else "",
    }
    pieces["SPECULAR_FOCUSED"] = SPECULAR_FOCUSED if features.focused else ""
    pieces["DIFFUSE_FOCUSED"] = DIFFUSE_FOCUSED if features.focused else ""
    for name, piece in pieces.items():
        source = source.replace(f"@{name}@", piece)
    return source


BRIGHTNESS, EXCESS, CHOICE = "brightness", "excess", "choice"
# Textures by step; the lights are read where there is a loop over them.
TEXTURES = {
    BRIGHTNESS: ("positions", "smooth_normals", "geometric_normals", "f90s", "dielectric_weights", "lights"),
    EXCESS: ("positions", "smooth_normals", "geometric_normals", "f90s", "dielectric_weights", "lights", "normals",
             "brightnesses"),
    CHOICE: ("smooth_normals", "geometric_normals", "excesses"),
}  # fmt: skip


def horizon_fragment_source(step: str) -> str:
    """The fragment shader of one of the three steps."""
    if step == CHOICE:
        return _defines() + _CHOICE
    main = _BRIGHTNESS if step == BRIGHTNESS else _DIRECTIONS + _EXCESS
    return _defines() + LIGHT_TEXELS + _SEEN_LIGHT + main


def _defines() -> str:
    values = {
        **{name: value for name, value in textures.constants().items() if name.startswith(("LIGHT", "FIRST"))},
        "ROUND_FIRST": textures.circle_first(HORIZON_ROUND_CORNERS),
        "ROUND_CORNERS": HORIZON_ROUND_CORNERS,
        "SMALLEST_ANGLE": float_literal(horizons.SMALLEST_ANGLE),
        "SMALLEST_ALPHA": float_literal(horizons.SMALLEST_ALPHA),
        "AROUND": horizons.AROUND,
        "CONCENTRATION": float_literal(horizons.CONCENTRATION),
        "SINH": float_literal(float(np.sinh(horizons.CONCENTRATION))),
        "HEIGHTS": len(horizons.HEIGHTS),
        "FIRST_HEIGHT": float_literal(horizons.HEIGHTS[0]),
        "HEIGHT_STEP": float_literal(horizons.HEIGHTS[1] - horizons.HEIGHTS[0]),
        "PI": float_literal(np.pi),
    }
    return "\n".join(f"#define LTSH_{name} {value}" for name, value in values.items()) + "\n"


# Those of `AreaLight.polygon`.
HORIZON_ROUND_CORNERS = 32

_SEEN_LIGHT = """\
/* A light as seen from a point; its corners are center + s * half_u + t * half_v. */
struct seen_light {
    vec3 offset; vec3 half_u; vec3 half_v; vec3 direction; int first; int count; float radiance; bool faces;
};

seen_light light_from(int number, vec3 position)
{
    int header = LTSH_FIRST_LIGHT + number * LTSH_LIGHT_HEADER;
    vec4 center = ltsh_light_texel(header);
    vec4 half_u = ltsh_light_texel(header + 1);
    vec3 radiance = abs(ltsh_light_texel(header + 4).xyz);
    seen_light light;
    light.offset = center.xyz - position;
    light.half_u = half_u.xyz;
    light.half_v = ltsh_light_texel(header + 2).xyz;
    light.direction = ltsh_light_texel(header + 3).xyz;
    light.count = half_u.w > 0.0 ? int(half_u.w) : LTSH_ROUND_CORNERS;
    light.first = half_u.w > 0.0 ? int(center.w) : LTSH_ROUND_FIRST;
    light.radiance = radiance.x + radiance.y + radiance.z;
    light.faces = dot(light.offset, light.direction) < 0.0;
    return light;
}

/* Does it matter for the pixel which horizon counts? */
bool has_two_horizons(ivec2 texel)
{
    vec3 apart = abs(texelFetch(smooth_normals, texel, 0).xyz - texelFetch(geometric_normals, texel, 0).xyz);
    bool reflects = any(notEqual(texelFetch(f90s, texel, 0).xyz, vec3(0.0)))
        || any(notEqual(texelFetch(dielectric_weights, texel, 0).xyz, vec3(0.0)));
    return texelFetch(positions, texel, 0).w > 0.0 && reflects
        && max(max(apart.x, apart.y), apart.z) > LTSH_SMALLEST_ANGLE;
}
"""

_BRIGHTNESS = """\
/* Van Oosterom and Strackee 1983, eq. 8; the volumes are those of a pyramid, exact for small lights, too. */
float solid_angle(seen_light light)
{
    float height = dot(light.offset, cross(light.half_u, light.half_v));
    vec2 start = ltsh_corner(light.first);
    vec3 a = light.offset + start.x * light.half_u + start.y * light.half_v;
    float far_a = length(a);
    vec2 before = ltsh_corner(light.first + 1) - start;
    float total = 0.0;
    for (int i = 2; i < light.count; ++i) {
        vec2 after = ltsh_corner(light.first + i) - start;
        vec3 b = a + before.x * light.half_u + before.y * light.half_v;
        vec3 c = a + after.x * light.half_u + after.y * light.half_v;
        float far_b = length(b);
        float far_c = length(c);
        float volume = height * (before.x * after.y - before.y * after.x);
        float below = far_a * far_b * far_c + dot(a, b) * far_c + dot(b, c) * far_a + dot(c, a) * far_b;
        total += abs(volume) > 0.0 || abs(below) > 0.0 ? 2.0 * atan(volume, below) : 0.0;
        before = after;
    }
    return light.faces ? abs(total) : 0.0;
}

void main()
{
    ivec2 texel = ivec2(gl_FragCoord.xy);
    vec3 position = texelFetch(positions, texel, 0).xyz;
    int end = has_two_horizons(texel) ? place.y : 0;
    float brightness = 0.0;
    for (int i = place.x; i < end; ++i) {
        seen_light light = light_from(i, position);
        brightness += light.radiance * solid_angle(light);
    }
    color = vec4(brightness, 0.0, 0.0, 0.0);
}
"""

_DIRECTIONS = """\
/* Whether neither horizon has all of the light on one side, or they differ about it. */
bool crosses(seen_light light, vec3 smooth_normal, vec3 true_normal)
{
    bool some = false;
    bool every = true;
    for (int i = 0; i < light.count; ++i) {
        vec2 corner = ltsh_corner(light.first + i);
        vec3 place_of_corner = light.offset + corner.x * light.half_u + corner.y * light.half_v;
        bool first = dot(smooth_normal, place_of_corner) > 0.0;
        bool second = dot(true_normal, place_of_corner) > 0.0;
        some = some || first || second;
        every = every && first && second;
    }
    return some && !every && light.faces;
}

/* Does the ray from the point meet the light? */
bool hits(seen_light light, vec3 ray)
{
    float steepness = dot(ray, light.direction);
    float distance = dot(light.offset, light.direction) / (steepness < 0.0 ? steepness : -1e-30);
    vec3 met = distance * ray - light.offset;
    float long_u = length(light.half_u);
    float long_v = length(light.half_v);
    vec3 u = light.half_u / long_u;
    vec3 v = light.half_v / long_v;
    float skew = dot(u, v);
    vec2 along = vec2(dot(met, u), dot(met, v));
    vec2 spot = (along - skew * along.yx) / (1.0 - skew * skew) / vec2(long_u, long_v);
    bool inside = false;
    vec2 start = ltsh_corner(light.first + light.count - 1);
    for (int i = 0; i < light.count; ++i) {
        vec2 end = ltsh_corner(light.first + i);
        bool spans = (start.y > spot.y) != (end.y > spot.y);
        float rise = end.y - start.y;
        float edge = start.x + (spot.y - start.y) * (end.x - start.x) / (rise == 0.0 ? 1.0 : rise);
        inside = spans && spot.x < edge ? !inside : inside;
        start = end;
    }
    return inside && steepness < 0.0;
}

/* Probability per sr that the lobe chooses a direction, GGX's visible normals (Heitz 2018, eq. 17). */
float lobe_density(vec3 towards, vec3 towards_eye, vec3 normal, float roughness)
{
    vec3 middle = towards + towards_eye;
    middle /= max(length(middle), 1e-12);
    float alpha = max(roughness * roughness, LTSH_SMALLEST_ALPHA);
    float alpha2 = alpha * alpha;
    float height = dot(middle, normal);
    vec3 aside = cross(middle, normal);
    float steep = height > 0.0 ? dot(aside, aside) + alpha2 * height * height : 1.0;
    float cosine = max(dot(normal, towards_eye), 1e-3);
    float masking = 1.0 / (1.0 + 0.5 * (sqrt(1.0 + alpha2 * (1.0 / (cosine * cosine) - 1.0)) - 1.0));
    return alpha2 / (LTSH_PI * steep * steep) * masking / (4.0 * cosine);
}
"""

_EXCESS = """\
void main()
{
    ivec2 texel = ivec2(gl_FragCoord.xy);
    vec3 position = texelFetch(positions, texel, 0).xyz;
    vec4 bent = texelFetch(normals, texel, 0);
    vec3 smooth_normal = texelFetch(smooth_normals, texel, 0).xyz;
    vec3 true_normal = texelFetch(geometric_normals, texel, 0).xyz;
    vec3 towards_eye = view.w > 0.0 ? normalize(view.xyz - position) : view.xyz;
    vec3 mirrored = 2.0 * dot(bent.xyz, towards_eye) * bent.xyz - towards_eye;
    vec3 along = mirrored - dot(mirrored, smooth_normal) * smooth_normal;
    along /= max(length(along), 1e-12);
    vec3 across = cross(smooth_normal, along);
    float brightness = max(texelFetch(brightnesses, texel, 0).x, 1e-30);
    int end = has_two_horizons(texel) ? place.y : 0;
    vec2 excess = vec2(0.0);
    for (int i = place.x; i < end; ++i) {
        seen_light light = light_from(i, position);
        float density = light.radiance / brightness;
        int directions = crosses(light, smooth_normal, true_normal) ? LTSH_AROUND * LTSH_HEIGHTS : 0;
        for (int k = 0; k < directions; ++k) {
            float turn = (float(k / LTSH_HEIGHTS) + 0.5) / float(LTSH_AROUND) * 2.0 - 1.0;
            float grown = exp(LTSH_CONCENTRATION * turn);
            float angle = LTSH_PI * 0.5 * (grown - 1.0 / grown) / LTSH_SINH;
            float span = LTSH_PI * LTSH_CONCENTRATION * (grown + 1.0 / grown) / (LTSH_SINH * float(LTSH_AROUND));
            vec3 around = cos(angle) * along + sin(angle) * across;
            float rise = -atan(dot(around, true_normal), dot(smooth_normal, true_normal));
            float elevation = rise * (LTSH_FIRST_HEIGHT + LTSH_HEIGHT_STEP * float(k % LTSH_HEIGHTS));
            vec3 towards = cos(elevation) * around + sin(elevation) * smooth_normal;
            float width = rise * span * cos(elevation) / float(LTSH_HEIGHTS);
            float lobe = lobe_density(towards, towards_eye, bent.xyz, bent.w);
            float amount = hits(light, towards) ? light.radiance * lobe * width : 0.0;
            float ratio = lobe / density;
            float share = 1.0 / (1.0 + ratio * ratio);
            excess += amount * vec2(1.0 - share, share);
        }
    }
    color = vec4(excess, 0.0, 0.0);
}
"""

_CHOICE = """\
void main()
{
    ivec2 texel = ivec2(gl_FragCoord.xy);
    vec4 smooth_normal = texelFetch(smooth_normals, texel, 0);
    vec4 true_normal = texelFetch(geometric_normals, texel, 0);
    vec2 excess = abs(texelFetch(excesses, texel, 0).xy);
    color = excess.x <= excess.y ? smooth_normal : true_normal;
}
"""
