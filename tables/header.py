"""Tables for other engines: a header for C, C++, GLSL and HLSL with the code that evaluates them; WGSL; DDS.

The header is core.h of `ltsh_addon/shading/glsl`, the same for all tables, and table.h, which each table adds. This
module writes the lines that depend on a table's numbers and degree.
"""

import re
import struct
from pathlib import Path

import numpy as np

from ltsh_addon.lobes import lookup_table
from ltsh_addon.lobes.lobe_integrals import LEAST_SHARE
from ltsh_addon.lobes.lookup_table import LookupTable, TableError
from ltsh_addon.lobes.spherical_harmonics import coefficient_index, normalization
from ltsh_addon.shading.header import (
    bend_literals,
    bent_factor,
    bent_moment_lines,
    core_text,
    definitions,
    filled,
    float_literal,
    moment_lines,
    table_sizes,
)

from .pack import SplineTable
from .sheen import LEAST_A

_TERMS_PER_LINE = 3
_VALUES_PER_LINE = 8
TEMPLATE = Path(__file__).with_name("table.h")


def header_text(table: LookupTable, prefix: str, about: str) -> str:
    """The header. `prefix` begins all of its own names; `about` is the text of its first comment."""
    blocks, values = data_blocks(table), {}
    if table.family == "ltsh":
        values = {
            "WEIGHT_LINES": "\n".join(_weight_lines(table.ridge_weights)),
            "BENT_POLYGON": _bent_polygon(table),
            "MOMENT_LINES": "\n".join(f"        {line}" for line in _all_moment_lines(table)),
            "EXPANSION_LINES": "\n".join([*_expansion_lines(table.degree), *_bent_expansion_lines(table)]),
            "ALBEDO": _sum(lookup_table.basis_integrals(table.coefficients.shape[3]), 1e-12),
            "LEAST_OF_COSINE": float_literal(0.5 * LEAST_SHARE / np.pi),
        }
    kinds = {table.family, *(["spline"] if isinstance(table, SplineTable) else [])}
    return _text(kinds, prefix, about, blocks, _constants(table, blocks), values)


def sheen_text(coefficients: np.ndarray, prefix: str, about: str) -> str:
    """The header of the sheen of the pack, from its spline coefficients (R, T, 3)."""
    rows, columns, channels = coefficients.shape
    constants = {"ROWS": rows, "COLUMNS": columns, "CHANNELS": channels, "DATA_COUNT": coefficients.size}
    values = {"LEAST_A": float_literal(LEAST_A)}
    return _text({"sheen", "spline"}, prefix, about, {"NODES": coefficients.ravel()}, constants, values)


def _text(kinds, prefix, about, blocks, constants, values) -> str:
    about = about.encode("ascii", "backslashreplace").decode("ascii").replace("*/", "* /").replace("/*", "/ *")
    values = {
        "prefix": prefix,
        "PREFIX": prefix.upper(),
        "ABOUT": "\n   ".join(about.splitlines()),
        "CORE": core_text(),
        "CONSTANTS": definitions(constants, prefix.upper()),
        "VALUES": "\n".join(_data_lines(blocks)),
        "ONE_OVER_PI": float_literal(1.0 / np.pi),
        "SIXTH": float_literal(1.0 / 6.0),
        **values,
    }
    return filled(_of_kinds(TEMPLATE.read_text(encoding="ascii"), kinds), values)


# Markers: the end of what is the same for all tables in WGSL, and the end of what shaders need in a header.
_OWN = "/* What stands above is the same for all tables: leave it out of a second one. */"
_END_OF_SHADERS = "/* GLSL and HLSL may end here"


def wgsl_text(text: str, prefix: str) -> str:
    """The functions of a header `text` in WGSL, without the data."""
    text = text[: text.index(_END_OF_SHADERS)]
    core_end = text.index("#elif LTSH_SHARED")
    text = text[:core_end] + f"{_OWN}\n" + text[core_end:]
    return f"{translated_to_wgsl(text, prefix).strip()}\n"


def _of_kinds(text, kinds) -> str:
    """`text` for `kinds` of tables: without the lines that `@if KIND`, `@else` and `@end` leave out."""
    lines, active = [], []
    for line in text.splitlines(keepends=True):
        word, _, kind = line.strip().partition(" ")
        if word == "@if":
            active.append(kind in kinds)
        elif word == "@else":
            active[-1] = not active[-1]
        elif word == "@end":
            active.pop()
        elif all(active):
            lines.append(line)
    return "".join(lines)


def data_blocks(table: LookupTable) -> dict[str, np.ndarray]:
    """The parts of the data array in order, flat float32, by the name of the macro that holds their offset."""
    nodes = table.warp.shape[0] * table.warp.shape[1]
    blocks = {
        "NODES": np.concatenate([table.warp.reshape(nodes, -1), table.coefficients.reshape(nodes, -1)], axis=1),
        "IOR": table.fresnel_ior,
        "WEIGHTS": table.fresnel_weights,
        "FRESNEL": table.fresnel_curves,
        "AVERAGE_ALBEDO": table.average_albedo,
    }
    return {name: np.asarray(block, dtype=np.float32).ravel() for name, block in blocks.items()}


def _constants(table, blocks) -> dict[str, int]:
    sizes = table_sizes(table)
    ends = np.cumsum([0, *(len(block) for block in blocks.values())]).tolist()
    return {
        **sizes,
        "CHANNELS": sizes["PARAMETERS"] + sizes["CURVES"] * sizes["COEFFICIENTS"],
        "IOR_COUNT": len(table.fresnel_ior),
        "COSINE_COUNT": table.fresnel_curves.shape[1],
        **{f"{name}_OFFSET": start for name, start in zip(blocks, ends, strict=False)},
        "DATA_COUNT": ends[-1],
    }


def _data_lines(blocks):
    for name, block in blocks.items():
        yield f"    /* {name} */"
        literals = [float_literal(value) for value in block]
        for start in range(0, len(literals), _VALUES_PER_LINE):
            yield f"    {', '.join(literals[start : start + _VALUES_PER_LINE])},"


def _weight_lines(ridge_weights):
    """Statements that set the moment weights: coefficients @ ridge_weights, a sparse matrix."""
    least = 1e-12 * np.abs(ridge_weights).max()
    for moment, column in enumerate(ridge_weights.T):
        yield f"    weights.values[{moment}] = {_sum(column, least)};"


def _sum(factors, least) -> str:
    """The sum of coefficients times `factors`, without factors of at most `least`."""
    terms = [
        f"{float_literal(factor)} * coefficients.values[{k}]" for k, factor in enumerate(factors) if abs(factor) > least
    ]
    lines = [" + ".join(terms[start : start + _TERMS_PER_LINE]) for start in range(0, len(terms), _TERMS_PER_LINE)]
    return "\n        + ".join(lines).replace("+ -", "- ") or "0.0f"


def _bent_polygon(table) -> str:
    if table.bend is None:
        return ""
    return f"\n    ltsh_polygon bent = ltsh_bent_polygon(unit, {bend_literals(table)});"


def _all_moment_lines(table):
    yield from moment_lines(table.degree)
    if table.bend is not None:
        yield "ltsh_edge leaning = ltsh_make_edge(bent, i);"
        yield from bent_moment_lines(table)


def _bent_expansion_lines(table):
    """Statements that add the functions of the bend themselves, see `lookup_table.bent_cosines`."""
    if table.bend is None:
        return
    count = table.coefficients.shape[3]
    both = " + ".join(f"bent.{axis} * coefficients.values[{count - 2 + n}]" for n, axis in enumerate("xz"))
    yield f"    ltsh_vec3 bent = ltsh_bent(unit, {bend_literals(table)});"
    yield "    float squares = ltsh_dot(bent, bent);"
    yield f"    original += {bent_factor(table, 1.0)} * ({both}) / (squares * squares);"


def _expansion_lines(degree):
    """Statements of the recurrences of `spherical_harmonics.evaluate`. legendre_l_m is the m-th derivative of P_l at
    unit.z."""
    turns = ["", " * unit.x", *(f" * turn_{m}" for m in range(2, degree + 1))]
    for m in range(degree + 1):
        if m == 2:
            yield "    float turn_1 = unit.x;"
            yield "    float side_1 = unit.y;"
        if m >= 2:
            yield f"    float turn_{m} = unit.x * turn_{m - 1} - unit.y * side_{m - 1};"
            if m < degree:
                yield f"    float side_{m} = unit.x * side_{m - 1} + unit.y * turn_{m - 1};"
        for l in range(m, degree + 1):  # noqa: E741 (the field's letter)
            yield f"    float legendre_{l}_{m} = {_legendre_value(l, m)};"
    yield "    float original = 0.0f;"
    for l in range(degree + 1):  # noqa: E741
        for m in range(l + 1):
            term = f"{float_literal(normalization(l, m))} * legendre_{l}_{m}{turns[m]}"
            yield f"    original += {term} * coefficients.values[{coefficient_index(l, m)}];"


def _legendre_value(l, m) -> str:  # noqa: E741
    if l == m:
        return float_literal(np.prod(np.arange(2 * m - 1, 0, -2, dtype=float)))
    first = f"{float_literal((2 * l - 1) / (l - m))} * unit.z * legendre_{l - 1}_{m}"
    if l == m + 1:
        return first
    return f"{first} - {float_literal((l + m - 1) / (l - m))} * legendre_{l - 2}_{m}"


# DXGI_FORMAT_R32G32B32A32_FLOAT, DXGI_FORMAT_R16G16B16A16_FLOAT
_FORMATS = {np.dtype(np.float32): 2, np.dtype(np.float16): 10}


def half_layers(table: LookupTable) -> np.ndarray:
    """The channels of the nodes, (N, R, T, 4) float16, four to a layer: the warp, then each curve's coefficients.

    Raises TableError if a number is too large.
    """
    rows, columns = table.warp.shape[:2]
    channels = np.concatenate([table.warp, table.coefficients.reshape(rows, columns, -1)], axis=2)
    if not np.abs(channels).max() <= np.finfo(np.float16).max:
        raise TableError(
            f"table {table.name}: its largest number is {np.abs(channels).max():g}, expected at most 65504"
        )
    layers = -(-channels.shape[2] // 4)
    padded = np.zeros((rows, columns, 4 * layers), np.float16)
    padded[..., : channels.shape[2]] = channels
    return np.ascontiguousarray(np.moveaxis(padded.reshape(rows, columns, layers, 4), 2, 0))


def dds(layers: np.ndarray) -> bytes:
    """A DDS file of RGBA textures (N, H, W, 4), float16 or float32; an array texture if N > 1."""
    count, height, width, _ = layers.shape
    pitch = width * 4 * layers.itemsize
    # DDSCAPS_TEXTURE; DDSD_CAPS | HEIGHT | WIDTH | PITCH | PIXELFORMAT; DDPF_FOURCC
    start = struct.pack("<4s7I44x", b"DDS ", 124, 0x100F, height, width, pitch, 1, 1)
    pixel_format = struct.pack("<2I4s20x", 32, 0x4, b"DX10")
    caps = struct.pack("<I16x", 0x1000)
    # D3D10_RESOURCE_DIMENSION_TEXTURE2D
    extended = struct.pack("<5I", _FORMATS[layers.dtype], 3, 0, count, 0)
    return start + pixel_format + caps + extended + layers.astype(layers.dtype.newbyteorder("<")).tobytes()


_WGSL_TYPES = {"float": "f32", "int": "i32", "bool": "bool", "ltsh_vec3": "vec3f"}
_WGSL_NAMES = {
    "LTSH_SQRT": "sqrt", "LTSH_SIN": "sin", "LTSH_COS": "cos", "LTSH_ATAN2": "atan2", "LTSH_INT": "i32",
    "LTSH_FLOAT": "f32", "ltsh_vec3": "vec3f",
}  # fmt: skip
_TOKEN = re.compile(
    r"\s+|/\*.*?\*/|[A-Za-z_]\w*|(?:\d+\.\d*|\.\d+|\d+)(?:e[+-]?\d+)?f?|[-+*/<>=!]=|\+\+|&&|\|\||.", re.DOTALL
)
_ASSIGNMENTS = ("=", "+=", "-=", "*=", "/=")
_CLOSING = {"(": ")", "[": "]", "{": "}"}


def translated_to_wgsl(text: str, prefix: str) -> str:
    """The WGSL of a header `text` whose names begin with `prefix`. The user must define <prefix>_data(index).

    WGSL has no preprocessor, and its declarations differ. The translation understands only what the texts in `glsl/`
    use: structures, functions by value, declarations of one name, `for`, `while`, `if`, assignments and the conditional
    operator, which becomes select().
    """
    return _Translation(_TOKEN.findall(_preprocessed(text, prefix))).text()


def _preprocessed(text, prefix) -> str:
    """The output of a shader's preprocessor. Macros that are whole numbers become constants."""
    lines, active = [], [True]
    for line in text.splitlines():
        words = line.split(maxsplit=2)
        if not line.startswith("#"):
            lines += [line] if all(active) else []
        elif words[0] in ("#if", "#ifdef", "#ifndef"):
            # Only LTSH_SHADER is defined: this is not C.
            active.append(words[1] == "LTSH_SHADER" if words[0] == "#ifdef" else words[1] != "LTSH_SHADER")
            active[-1] = active[-1] and words[0] != "#if"
        elif words[0] in ("#else", "#elif"):
            active[-1] = False
        elif words[0] == "#endif":
            active.pop()
        elif words[0] == "#define" and all(active) and len(words) == 3 and re.fullmatch(r"\d+", words[2]):
            lines.append(f"const {words[1]} = {words[2]};")
    return "\n".join(lines).replace(f"{prefix.upper()}_DATA(", f"{prefix}_data(")


class _Translation:
    """Translates the tokens of a text in one pass."""

    def __init__(self, tokens: list[str]):
        self._tokens, self._at = tokens, 0
        self._types = dict(_WGSL_TYPES)

    def text(self) -> str:
        """The translation of all tokens; functions and structures are translated by the other methods."""
        parts = []
        while self._at < len(self._tokens):
            word = self._tokens[self._at]
            if word == "struct":
                parts.append(self._structure())
            elif word == "const":
                parts.append(self._until(";"))
            elif word in self._types or word == "void":
                parts.append(self._function())
            elif word == "LTSH_FUNCTION":
                self._at += 2
            else:
                parts.append(self._take())
        return "".join(parts)

    # Tokens:

    def _take(self) -> str:
        self._at += 1
        return self._tokens[self._at - 1]

    def _word(self) -> str:
        """The next token that is neither space nor comment."""
        while (token := self._take()).isspace() or token.startswith("/*"):
            pass
        return token

    def _peek(self) -> str:
        at = self._at
        token = self._word()
        self._at = at
        return token

    def _until(self, end: str) -> str:
        taken = [self._take()]
        while taken[-1] != end:
            taken.append(self._take())
        return "".join(taken)

    # Declarations:

    def _structure(self) -> str:
        self._word()
        name, _ = self._word(), self._word()
        self._types[name] = name
        members = []
        while self._peek() != "}":
            members.append(f"    {self._member(self._word(), ';')},\n")
        self._word(), self._word()
        return f"struct {name} {{\n{''.join(members)}}}"

    def _member(self, kind: str, *ends: str) -> str:
        """`name: type` of a declaration. Takes the tokens up to one of `ends`, included."""
        name, kind = self._word(), self._types[kind]
        if self._peek() == "[":
            self._word()
            kind = f"array<{kind}, {self._word()}>"
            self._word()
        end = self._word()
        if end not in ends:
            raise ValueError(f"declaration of {name}: {end!r} follows, expected {' or '.join(ends)}")
        return f"{name}: {kind}"

    def _function(self) -> str:
        result, name = self._word(), self._word()
        self._word()
        parameters = []
        while self._peek() != ")":
            kind = self._word()
            if kind not in ("void", ","):
                parameters.append((self._word(), self._types[kind]))
        self._word()
        body = self._block()
        copies = []
        for number, (parameter, kind) in enumerate(parameters):
            if re.search(rf"(?<![\w.]){parameter}[\w.\[\]]* [-+*/]?= ", body):
                parameters[number] = (f"{parameter}_given", kind)
                copies.append(f"\n    var {parameter} = {parameter}_given;")
        listed = ", ".join(f"{parameter}: {kind}" for parameter, kind in parameters)
        returned = "" if result == "void" else f" -> {self._types[result]}"
        start = body.index("{") + 1
        return f"fn {name}({listed}){returned}{body[:start]}{''.join(copies)}{body[start:]}"

    # Statements:

    def _block(self) -> str:
        """Statements up to the closing brace, with the text before the opening brace."""
        parts = [self._until("{")]
        while self._peek() != "}":
            token = self._take()
            if token.isspace() or token.startswith("/*"):
                parts.append(token)
            else:
                parts.append(self._statement(token))
        return "".join(parts) + self._until("}")

    def _statement(self, word: str) -> str:
        if word in ("if", "while"):
            self._word()
            return f"{word} ({self._expression(')')}){self._block()}"
        if word == "else":
            return f"else{f' {self._statement(self._word())}' if self._peek() == 'if' else self._block()}"
        if word == "for":
            self._until("(")
            start = self._statement(self._word())
            condition = self._expression(";")
            _, name, _ = self._word(), self._word(), self._word()
            return f"for ({start} {condition}; {name}++){self._block()}"
        if word == "return":
            return f"return {self._expression(';')};"
        if word in self._types:
            name = self._word()
            if self._word() == ";":
                return f"var {name}: {self._types[word]};"
            return f"var {name}: {self._types[word]} = {self._expression(';')};"
        target = word
        while self._peek() not in _ASSIGNMENTS:
            target += self._word()
            if target.endswith("["):
                target += f"{self._expression(']')}]"
        return f"{target} {self._word()} {self._expression(';')};"

    # Expressions:

    def _expression(self, end: str) -> str:
        """An expression up to `end`, which is taken too; several expressions if there are commas."""
        parts, choices = [""], []
        while True:
            token = self._take()
            if token == end and token not in ("(", "["):
                break
            if token in _CLOSING:
                parts[-1] += f"{token}{self._expression(_CLOSING[token])}{_CLOSING[token]}"
            elif token == ",":
                parts[-1] = _chosen(parts[-1], choices)
                parts[-1] += ", "
                parts.append("")
                choices = []
            elif token in ("?", ":"):
                choices.append((parts[-1], token))
                parts[-1] = ""
            elif token.isspace() or token.startswith("/*"):
                parts[-1] += " " if parts[-1] else ""
            else:
                parts[-1] += _WGSL_NAMES.get(token, token)
        parts[-1] = _chosen(parts[-1], choices)
        return "".join(parts)


def _chosen(last: str, choices: list[tuple[str, str]]) -> str:
    """`a ? b : c` as select(c, b, a); may be nested. `choices` has the part before each `?` or `:`, `last` the rest."""
    if not choices:
        return last.strip()
    (condition, _), (first, _), *others = choices
    return f"select({_chosen(last, others)}, {first.strip()}, {condition.strip()})"
