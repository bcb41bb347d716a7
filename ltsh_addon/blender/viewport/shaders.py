"""The shaders that run once per pixel: lighting, and the choice of horizons before it.

Their text is in `glsl/`, with `core.h` of the exported headers. Constants of Python and the features that a shader is
compiled for become macros LTSH_... Python generates only lines that repeat per horizon, moment or corner.
"""

from collections.abc import Callable, Iterable, Iterator
from dataclasses import asdict, dataclass
from itertools import combinations

import numpy as np

from ...cycles import horizons
from ...emitters import facing, light_profile
from ...emitters.light_polygons import FOCUSED_ROUND_CORNERS, ROUND_CORNERS
from ...emitters.tails import NEAR_RADII
from ...lobes import moments32
from ...lobes.diffuse import ARC_NODES, albedo_slope, mean_slope_above
from ...lobes.edge_integrals import BUMP_NODES, TERM_POLYNOMIALS
from ...lobes.lobe_integrals import LEAST_SHARE
from ...lobes.lookup_table import MIN_ALPHA, LookupTable
from ...shading import header
from ...shading.float64 import LEAST_ROUGHNESS
from . import light_texels
from .drawing import PixelShader, glsl

# Limits of the half diagonal of a light, as the lobe sees it, for cheaper ways of integration.
# TINY_LIGHT: up to it lights are sampled by triangles. There the errors of that and of the rounding of edges, which
# grows with the inverse of the size, are below 2e-4 of the result.
TINY_LIGHT = 0.2
# SMALL_LIGHT: up to it four points stand for a light that no horizon cuts. POINT_LIGHT: up to it the center stands for
# a round light. The error is 5e-4 of the result.
SMALL_LIGHT = 0.12
POINT_LIGHT = 2e-4
# Anisotropic lobes. LEAST_ALPHA: the least alpha in single precision. SHORT_ARC: radians by which an arc may turn.
# MOST_ARCS: arcs of an edge. MOST_HALVINGS: how often an edge is halved for each arc.
LEAST_ALPHA, SHORT_ARC, MOST_ARCS, MOST_HALVINGS = 1e-4, 1.2, 16, 6
# SLOPE_DEGREE: of the polynomials for the albedo of rough diffuse lobes; their error is 5e-6.
SLOPE_DEGREE = 8
# NODES_ALONG: quadrature nodes along a disk on which the cone of a spot ends, see `shading.facing`.
NODES_ALONG = 20
_AXES = "xyz"


@dataclass(frozen=True)
class Features:
    """The features that a lighting shader is compiled with."""

    specular: bool
    diffuse: bool
    geometric: bool  # the specular lobe has a second horizon
    bumped: bool  # the diffuse lobe has a second horizon
    focused: bool = False  # lights with a spread or a falloff
    turned: bool = False  # the diffuse lobe has a normal of its own
    shadowed: bool = False  # the visibility of the lights is given
    facing: bool = False  # lights that face every point
    patterned: bool = False  # some of these have a pattern
    sky: bool = False  # the light of the world
    sheen: bool = False  # diffuse lobes that are sheen
    rough: bool = False  # rough diffuse lobes
    velvet: bool = False  # diffuse lobes that are velvet; only with `rough`
    bent: bool = False  # dielectrics with an index of refraction below 1
    brushing: bool = False  # there are anisotropic lobes, which take a shader of their own
    brushed: bool = False  # this is that shader; False: the shader for all other pixels

    @property
    def samplers(self) -> tuple[str, ...]:
        """The names of the textures that the shader reads."""
        names = ["positions", "normals", "bases", "lights"]
        if self.specular:
            names += ["f0s", "f90s", "dielectric_weights"]
        if self.specular and not self.brushed:
            names += ["table", "dielectrics"]
        if self.brushing:
            names.append("tangents")
        if self.geometric:
            names.append("geometric_normals")
        if self.turned or self.bumped:
            names.append("diffuse_normals")
        if self.bumped:
            names.append("smooth_normals")
        if self.rough:
            names.append("rebounds")
        if self.shadowed:
            names += ["visibility", "grid_positions"]
        if self.sky:
            names.append("sky")
        return tuple(names)

    @property
    def constants(self) -> dict[str, str]:
        """The types of the push constants that the shader reads, by name."""
        needed = {
            "draw_range": ("IVEC2", True),
            "has_sky": ("INT", self.sky),
            "view": ("VEC4", self.specular or self.sheen or self.rough),
            "grid": ("MAT4", self.shadowed),
            "jitter": ("VEC2", self.sky and (self.specular or self.rough)),
        }
        return {name: kind for name, (kind, is_read) in needed.items() if is_read}


def lighting_shader(table: LookupTable, features: Features) -> PixelShader:
    """The lighting shader for `table` of degree 1 to 4."""
    source = _lighting_source(table, features)
    return PixelShader(source, features.samplers, features.constants, is_brushed=features.brushed)


def _lighting_source(table, features) -> str:
    if table.degree > moments32.MAX_DEGREE:
        raise ValueError(
            f"table {table.name} has degree {table.degree}, the graphics card's path goes up to {moments32.MAX_DEGREE}"
        )
    is_cosine = table.family == "ltc" and not features.brushed
    chosen = {"cosine": is_cosine, **asdict(features)}
    defined = {name.upper(): 1 for name, is_chosen in chosen.items() if is_chosen}
    parts = ["#define LTSH_GLSL 1", header.core_text(), header.definitions({**defined, **_lighting_constants(table)})]
    parts += [glsl("light_texels"), header.filled(glsl("lights"), {"LEVELS": "\n".join(_level_lines())})]
    if features.focused:
        parts.append(glsl("spread"))
    if features.facing:
        parts.append(glsl("facing"))
    if features.brushed and features.specular:
        parts.append(_brushed_text(features))
    elif features.specular:
        parts.append(_specular_text(table, is_cosine, features))
    if features.bent:
        parts.append(glsl("bent"))
    if features.rough:
        parts.append(_rough_text(features))
    if features.diffuse:
        parts.append(_diffuse_text(features))
    if features.sky:
        parts += [glsl("octahedron"), glsl("sky")]
    loops = {"SPECULAR_LOOPS": "", "DIFFUSE_LOOPS": ""}
    if features.specular:
        loops["SPECULAR_LOOPS"] = "\n".join(_specular_loops(features))
    if features.diffuse:
        loops["DIFFUSE_LOOPS"] = "\n".join(_diffuse_loops(features))
    return "\n".join([*parts, header.filled(glsl("lighting"), loops)])


def _lighting_constants(table) -> dict:
    plain, beyond, sharp, sharpest = light_profile.DISK_LAYERS
    if {beyond.layers, sharp.layers, sharpest.layers} != {beyond.layers}:
        raise ValueError("DISK_LAYERS of light_profile have changed: all but the first had equally many layers")
    sizes = header.table_sizes(table)
    few_corners, many_corners = FOCUSED_ROUND_CORNERS
    return {
        **sizes,
        "BLOCKS": -(-sizes["COEFFICIENTS"] // 4),
        **light_texels.constants(),
        "IOR_STEPS": header.float_literal(light_texels.IOR_STEPS),
        "ONE_OVER_PI": header.float_literal(1.0 / np.pi),
        "PI": header.float_literal(np.pi),
        "LEAST_ROUGHNESS": LEAST_ROUGHNESS,
        "LEAST_ALPHA": header.float_literal(LEAST_ALPHA),
        "SHORT_ARC": header.float_literal(2.0 * np.cos(0.5 * SHORT_ARC)),
        "MOST_ARCS": MOST_ARCS,
        "MOST_HALVINGS": MOST_HALVINGS,
        "QUAD_FIRST": light_texels.QUAD_FIRST,
        "SKY_SIZE": light_texels.SKY_SIZE,
        "SKY_LEVELS": light_texels.SKY_LEVELS,
        "SKY_POINTS": light_texels.SKY_POINTS,
        "IRRADIANCE_SIZE": light_texels.IRRADIANCE_SIZE,
        "LEAST_OF_COSINE": header.float_literal(LEAST_SHARE * 0.5 / np.pi),
        "TINY": header.float_literal(TINY_LIGHT**2),
        "SMALL": header.float_literal(SMALL_LIGHT**2),
        "POINT": header.float_literal(POINT_LIGHT**2),
        "NEAR_SQUARED": header.float_literal(NEAR_RADII**2),
        "MIN_ALPHA": header.float_literal(MIN_ALPHA),
        "CHANGING": header.float_literal(facing.CHANGING),
        "NODES_ALONG": NODES_ALONG,
        # The weights of the nodes add up to 9 (NODES_ALONG + 1).
        "PEAK_WEIGHT": header.float_literal(9.0 * (NODES_ALONG + 1) * facing.PEAK_WEIGHT),
        "FEW_LAYERS": plain.layers,
        "MANY_LAYERS": beyond.layers,
        "FEW_NODES": light_texels.NODES_FIRST[plain.layers],
        "MANY_NODES": light_texels.NODES_FIRST[beyond.layers],
        "CHORDS": plain.chords,
        "SHARP_CHORDS": sharp.chords,
        "SHARPEST_CHORDS": sharpest.chords,
        "WIDE_LOBE": header.float_literal(light_profile.WIDE_LOBE),
        "SHARP_LOBE": header.float_literal(light_profile.SHARP_LOBE),
        "WELL_INSIDE": header.float_literal(light_profile.WELL_INSIDE),
        "LEAST_WIDTH": header.float_literal(light_profile.WIDTH_RANGE[0]),
        "MOST_WIDTH": header.float_literal(light_profile.WIDTH_RANGE[1]),
        "ROUND_MARGIN": light_profile.ROUND_MARGIN,
        "FEW_CORNERS": few_corners,
        "MANY_CORNERS": many_corners,
        "FEW_CORNERS_FIRST": light_texels.circle_first(few_corners),
        "MANY_CORNERS_FIRST": light_texels.circle_first(many_corners),
        # Each of three horizons may add a corner.
        "MOST_CORNERS": many_corners + 3,
    }


def _level_lines() -> Iterator[str]:
    """Statements that choose the corners of a round light by its apparent width."""
    for first, count, limit in reversed(light_texels.ROUND_LEVELS):
        condition = "round && whole" if count < ROUND_CORNERS[0] else "round"
        if not np.isinf(limit):
            condition += f" && wide <= {header.float_literal(limit)}"
        for name, value in (("first", first), ("count", count)):
            yield f"    light.{name} = {condition} ? {value} : light.{name};"


# The GLSL expression of the integral by the way in which `ltsh_todo` has a light integrated.
_WAYS = {
    "spots": "{name}_in_spots(sight, light.is_round)",
    "whole": "{name}_of_whole(sight, light)",
    "cut": "{name}_of_part({lobe}, sight, light, sight.size < LTSH_TINY)",
}


def _loop(way: str, body: Iterable[str]) -> Iterator[str]:
    """A loop over the lights that `ltsh_todo` has for a way. Without lights it runs once, with left = 0."""
    yield f"    left = todo.{way};"
    yield "    do {"
    yield "        number = ltsh_next(left);"
    yield "        int header = ltsh_header(draw_range.x + number);"
    yield "        ltsh_light light = ltsh_seen_light(header, point);"
    yield from (f"        {line}" for line in body)
    yield "        left &= left - 1u;"
    yield "    } while (left != 0u);"


def _loops(name: str, lobe: str, light: Callable, features: Features) -> Iterator[str]:
    """A loop over the lights of each way; `light(integral)` yields the statements that compute `reflected`."""
    ways = {way: integral.format(name=name, lobe=lobe) for way, integral in _WAYS.items()}
    if features.focused:
        ways["focused"] = ""

    def body(way, integral):
        if way != "focused":
            yield f"{name}_view sight = {name}_viewed({lobe}, light);"
        if way in ("whole", "cut"):
            yield "light = ltsh_with_corners(light, sight.wide, sight.whole);"
            yield "light.count = left != 0u ? light.count : 1;"
        yield from light(integral)
        factor = "factor"
        yield "float factor = ltsh_factor(number, todo);"
        if features.shadowed:
            factor += f" * ltsh_seen(near, draw_range.x + number).{'x' if name == 'specular' else 'y'}"
        yield f"reflected *= {factor} * ltsh_light_texel(header + 4).xyz;"
        yield "radiance += left != 0u ? reflected : vec3(0.0);"

    for way, integral in ways.items():
        yield from _loop(way, body(way, integral))


def _uneven_loop(normal: str, width: str, others: Iterable[str], is_done: str) -> Iterator[str]:
    """A loop that finds the factors of lights that are not equally bright all over; `others` are further statements.

    Later loops leave out the lights for which the GLSL condition `is_done` holds.
    """

    def body():
        yield f"float factor = ltsh_mean_emission(header, point, light, {normal}, {width}, left != 0u);"
        yield "ltsh_factors[number] = factor;"
        yield from others
        yield f"todo = ltsh_todo_among(todo, left != 0u && ({is_done}) ? ~(1u << uint(number)) : ~0u);"

    return _loop("uneven", body())


def _specular_loops(features) -> Iterator[str]:
    def light(integral):
        profile = "vec2(1.0)"
        if features.brushed:
            yield "ltsh_set_apex(shine, ltsh_with_corners(light, 1.0, false));"
        if integral:
            yield f"vec4 values = specular_values(weights, {integral});"
        else:
            yield "bool used = left != 0u;"
            yield "vec4 values = specular_focused(shine, weights, light, header, weights.width, used);"
            profile = "ltsh_range_of_profile(light, header)"
        yield f"vec3 reflected = ltsh_reflected(point, ltsh_limited(values, point, light, header, {profile}));"

    if features.facing:
        yield from _uneven_loop("point.normal", "weights.width", (), "factor == 0.0")
    yield from _loops("specular", "shine", light, features)


def _diffuse_loops(features) -> Iterator[str]:
    def light(integral):
        if features.velvet:
            yield "ltsh_set_velvet_apex(light);"
        if features.rough:
            factors = "diffuse_focused(matte, light, header, 1.0, left != 0u).xy"
            factors = f"diffuse_rough_factors(matte, {integral})" if integral else factors
            yield f"vec2 factors = {factors};"
            yield "vec3 reflected = (factors.x + factors.y * ltsh_rebound) * base.xyz;"
            return
        if integral:
            yield f"float form_factor = diffuse_form_factor(matte, {integral});"
        else:
            yield "float form_factor = diffuse_focused(matte, light, header, 1.0, left != 0u).x;"
        yield "vec3 reflected = form_factor * base.xyz;"

    if features.facing:
        visibility = " * ltsh_seen(near, draw_range.x + number).y" if features.shadowed else ""
        caps = [
            "bool is_cap = (caps >> uint(number) & 1u) != 0u;",
            f"float form_factor = factor * diffuse_of_cap(matte, light){visibility};",
            "vec3 reflected = form_factor * base.xyz * ltsh_light_texel(header + 4).xyz;",
            "radiance += left != 0u && is_cap ? reflected : vec3(0.0);",
        ]
        yield from _uneven_loop("matte.plane_0", "-1.0", caps, "is_cap || factor == 0.0")
    yield from _loops("diffuse", "matte", light, features)


def _specular_text(table, is_cosine, features) -> str:
    count = table.coefficients.shape[3]
    moments = [f"    {line}" for line in header.moment_lines(table.degree)]
    spots = [line.replace("ltsh_edge_moment(edge,", "solid_angle * ltsh_spot_moment(direction,") for line in moments]
    if table.bend is not None:
        moments += _bent_edge_lines(table)
        spots += _bent_spot_lines(table)
    fetches = [f"    vec4 block_{n} = ltsh_table_at(cell, layer + {n});" for n in range(-(-count // 4))]
    fetches += [f"    weights.values[{k}] = block_{k // 4}.{'xyzw'[k % 4]};" for k in range(count)]
    terms = [
        f"        w.{term}[{k}] += share.{component} * values.values[{k}];"
        for k in range(count)
        for term, component in zip(("plain", "schlick", "dip", "dielectric"), "xyzw", strict=True)
    ]
    lines = {"MOMENT_LINES": moments, "SPOT_LINES": spots, "FETCHES": fetches, "TERMS": terms}
    values = {name: "\n".join(texts) for name, texts in lines.items()}
    values["SUM"] = header.filled(glsl("cosine_sum" if is_cosine else "moment_sum"), values)
    # A tilt turns the horizon around the second axis of the frame, so both horizons meet there.
    seam = "lobe.row_y" if is_cosine else None
    values["INTEGRAL"] = _integral_text("specular", 1 + is_cosine + features.geometric, seam)
    values["FOCUSED"] = ""
    if features.focused:
        sum_value = "specular_values(weights, sum)"
        values["FOCUSED"] = _focused_text("specular", "specular_weights weights, ", sum_value, "mat3(1.0)")
    return header.filled(glsl("specular"), values)


# Statements that put sizes in units of the lobe's width, by its smaller alpha and by both.
_BRUSHED_SIZES = "    view.size *= lobe.sharpness;\n    view.wide *= lobe.mean_sharpness;\n"


def _brushed_text(features) -> str:
    frame = "ltsh_toward_mirror(weights.width)"
    values = {"INTEGRAL": _integral_text("specular", 1 + features.geometric, sizes=_BRUSHED_SIZES), "FOCUSED": ""}
    if features.focused:
        value = "specular_values(weights, sum)"
        values["FOCUSED"] = _focused_text(
            "specular", "specular_weights weights, ", value, frame, "LTSH_TINY / lobe.sharpness"
        )
    return header.filled(glsl("brushed"), values)


def _bent_edge_lines(table):
    """Statements that add the edge from `start` to `end` to the moments of the table's bend."""
    bent = [f"ltsh_unit(ltsh_bent({end}, {header.bend_literals(table)}))" for end in ("start", "end")]
    yield f"    ltsh_edge leaning = ltsh_edge_between({', '.join(bent)});"
    yield from (f"    {line}" for line in header.bent_moment_lines(table))


def _bent_spot_lines(table):
    """Statements that add a spot to these moments: 2 pi times the integrals of `lookup_table.bent_cosines`."""
    yield f"    vec3 bent = ltsh_bent(direction, {header.bend_literals(table)});"
    yield "    float squares = dot(bent, bent);"
    yield f"    float share = {header.bent_factor(table, 2.0 * np.pi)} * solid_angle / (squares * squares);"
    count = table.coefficients.shape[3]
    for row, axis in ((count - 2, "x"), (count - 1, "z")):
        yield f"    moments.values[{row}] += share * bent.{axis};"


def _diffuse_text(features) -> str:
    values = {"INTEGRAL": _integral_text("diffuse", 1 + features.bumped), "FOCUSED": ""}
    if features.focused:
        sum_value = "vec4(diffuse_form_factor(lobe, sum), 0.0, 0.0, 0.0)"
        if features.rough:
            sum_value = "vec4(diffuse_rough_factors(lobe, sum), 0.0, 0.0)"
        values["FOCUSED"] = _focused_text("diffuse", "", sum_value, "diffuse_frame(lobe)")
    return (_bumped_text() if features.bumped else "") + header.filled(glsl("diffuse"), values)


def _bumped_text() -> str:
    terms = (f"    value = value * alpha + {_vector(row)};" for row in np.transpose(TERM_POLYNOMIALS)[::-1])
    nodes = ((2.0 * place - 1.0, weight) for place, weight in BUMP_NODES)
    calls = (", ".join(map(header.float_literal, node)) for node in nodes)
    lines = (f"    sum += ltsh_bump_node(arc, toward, {call});" for call in calls)
    return header.filled(glsl("bumped"), {"TERMS": "\n".join(terms), "NODES": "\n".join(lines)})


def slope_text() -> str:
    """GLSL of float rough_slope(float cosine)."""
    return header.filled(glsl("slope"), {"SLOPE": _root_polynomial(albedo_slope)})


def _rough_text(features) -> str:
    nodes, weights = (values[ARC_NODES // 2 :] for values in np.polynomial.legendre.leggauss(ARC_NODES))
    constants = {"NODES": ARC_NODES, "PLACES": _vector(nodes), "WEIGHTS": _vector(weights)}
    text = header.filled(glsl("rough"), {"MEAN_SLOPE": _root_polynomial(mean_slope_above)})
    velvet = glsl("velvet") if features.velvet else ""
    return header.definitions(constants, "LTSH_ARC") + slope_text() + text + velvet


def _vector(values) -> str:
    return f"vec{len(values)}({', '.join(map(header.float_literal, values))})"


def _root_polynomial(function) -> str:
    """Statements for value = function(z) / root, root = sqrt(1 - z), as a polynomial in root."""
    domain = [0.01, 1.0]
    fit = np.polynomial.chebyshev.Chebyshev.interpolate(lambda u: function(1.0 - u * u) / u, SLOPE_DEGREE, domain)
    highest = fit.convert(kind=np.polynomial.Polynomial).coef[::-1]
    return "\n".join(f"    value = value * root + {header.float_literal(value)};" for value in highest)


def _focused_text(name, arguments, value, frame, tiny="LTSH_TINY") -> str:
    """GLSL of vec4 `name`_focused(`name`_lobe lobe, `arguments` ltsh_light light, int header, float width, bool used).

    Expects spread.glsl and what `_integral_text` expects. `value` is the vec4 that a `name`_sum `sum` stands for.
    `frame` is the matrix from vectors of `name`_warped to coordinates in which the lobe lies around e_z.
    """
    return header.filled(
        glsl("focused"), {"name": name, "ARGUMENTS": arguments, "VALUE": value, "FRAME": frame, "TINY": tiny}
    )


def _integral_text(name: str, planes: int, seam: str | None = None, sizes: str = "") -> str:
    """GLSL of `name`_sum `name`_integral(`name`_lobe lobe, ltsh_light light) for 1 to 3 horizons.

    Expects, in GLSL, `name`_lobe with normals plane_0 .. of the horizons, `name`_sum, `name`_empty(),
    `name`_with_edge(sum, start, end), `name`_with_spot(sum, direction, solid angle), `name`_warped(lobe, v) and
    `name`_heights(lobe, v, warped v, rest), which sets unused components to `rest`. `seam` is the direction in which
    the first two horizons meet, if known. `sizes` are statements that put the sizes of a `name`_view in units of the
    lobe's width.
    """
    values = {
        "name": name,
        "SLOTS": planes + 1,
        "SIZES": sizes,
        "APICES": "\n".join(_apex_lines(name, planes, seam)),
        "INTERVAL": "\n".join(_interval_lines(planes)),
        "CLOSING": "\n".join(_closing_lines(planes)),
        "PINS": "\n".join(f"    vec4 pin_{k} = vec4(0.0);" for k in range(planes)),
    }
    return header.filled(glsl("integral"), values)


def _apex_lines(name, planes, seam):
    """Statements for the directions in which two horizons meet, warped and seen from `origin`, and their heights."""
    if planes > 1:
        yield "    vec3 normal = cross(along_u, along_v);"
        yield "    float height_of_center = tiny ? dot(normal, center) : 0.0;"
    for k, j in combinations(range(planes), 2):
        # The difference of close normals is exact in floating point.
        meeting = seam if seam and (k, j) == (0, 1) else f"cross(lobe.plane_{k}, lobe.plane_{j} - lobe.plane_{k})"
        yield f"    vec3 meeting_{k}{j} = {meeting};"
        yield f"    meeting_{k}{j} *= dot(meeting_{k}{j}, light.direction) < 0.0 ? 1.0 : -1.0;"
        yield f"    vec3 apex_{k}{j} = ltsh_unit({name}_warped(lobe, meeting_{k}{j}));"
        yield f"    vec3 apex_height_{k}{j} = {name}_heights(lobe, meeting_{k}{j}, apex_{k}{j}, 1.0);"
        yield f"    float slope_{k}{j} = dot(normal, apex_{k}{j});"
        yield f"    slope_{k}{j} = tiny && abs(slope_{k}{j}) > 1e-37 ? height_of_center / slope_{k}{j} : 1.0;"
        yield f"    apex_{k}{j} = slope_{k}{j} * apex_{k}{j} - origin;"


def _interval_lines(planes):
    """Statements that narrow the part of an edge that is above all horizons, from `enter` to `leave`."""
    for a in _AXES[:planes]:
        yield f"        enter = max(enter, start_height.{a} <= 0.0 && end_height.{a} > 0.0 ? share.{a} : 0.0);"
        yield f"        leave = min(leave, start_height.{a} > 0.0 && end_height.{a} <= 0.0 ? share.{a} : 1.0);"
        yield f"        leave = start_height.{a} <= 0.0 && end_height.{a} <= 0.0 ? -1.0 : leave;"


def _closing_lines(planes):
    """Statements for the piece of horizon number slot - 1 that the crossing of an edge adds.

    Where an edge crosses two horizons, the order of the crossings tells where it is below the other one. Both horizons
    use the same comparison, so rounding cannot leave the polygon open, however close they are.
    """
    for k, a in enumerate(_AXES[:planes]):
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
    """Statements that move a crossing of horizon k that is below another one to where both meet."""
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


# The steps that choose horizons, and the textures that they read. The last step has no loop over lights.
BOUNDS, EXCESS, CHOICE = "bounds", "excess", "choice"
_SEEN = ("positions", "smooth_normals", "geometric_normals", "f90s", "dielectric_weights", "lights")
HORIZON_SAMPLERS = {
    BOUNDS: _SEEN,
    EXCESS: (*_SEEN, "normals", "f0s", "bases", "diffuse_normals", "light_bounds"),
    CHOICE: ("smooth_normals", "geometric_normals", "excesses"),
}
_HORIZON_CONSTANTS = {
    BOUNDS: {"draw_range": "IVEC2"},
    EXCESS: {"draw_range": "IVEC2", "view": "VEC4"},
    CHOICE: {"threshold": "FLOAT"},
}
HORIZON_CORNERS = 32  # of round lights, as in `Light.polygon`


def horizon_shader(step: str) -> PixelShader:
    """The shader of one step."""
    values = {
        step.upper(): 1,
        **light_texels.constants(),
        "QUAD_FIRST": light_texels.QUAD_FIRST,
        "ROUND_FIRST": light_texels.circle_first(HORIZON_CORNERS),
        "ROUND_CORNERS": HORIZON_CORNERS,
        "SMALLEST_ANGLE": header.float_literal(horizons.SMALLEST_ANGLE),
        "SMALLEST_ALPHA": header.float_literal(horizons.SMALLEST_ALPHA),
        "AROUND": horizons.AROUND,
        "CONCENTRATION": header.float_literal(horizons.CONCENTRATION),
        "SINH": header.float_literal(float(np.sinh(horizons.CONCENTRATION))),
        "HEIGHTS": len(horizons.HEIGHTS),
        "FIRST_HEIGHT": header.float_literal(horizons.HEIGHTS[0]),
        "HEIGHT_STEP": header.float_literal(horizons.HEIGHTS[1] - horizons.HEIGHTS[0]),
        "PI": header.float_literal(np.pi),
    }
    lights = "" if step == CHOICE else glsl("light_texels")
    return PixelShader(
        header.definitions(values) + lights + glsl("horizons"), HORIZON_SAMPLERS[step], _HORIZON_CONSTANTS[step]
    )
