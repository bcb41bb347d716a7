"""The exported header in WGSL, translated from its text: WGSL has no preprocessor, and its declarations differ.

The translation understands only what the texts in `glsl/` use: structures, functions by value, declarations of one
name, `for`, `while`, `if`, assignments and the conditional operator, which becomes select().
"""

from __future__ import annotations

import re

_TYPES = {"float": "f32", "int": "i32", "bool": "bool", "ltsh_vec3": "vec3f"}
_NAMES = {
    "LTSH_SQRT": "sqrt", "LTSH_SIN": "sin", "LTSH_COS": "cos", "LTSH_ATAN2": "atan2", "LTSH_INT": "i32",
    "LTSH_FLOAT": "f32", "ltsh_vec3": "vec3f",
}  # fmt: skip
_TOKEN = re.compile(
    r"\s+|/\*.*?\*/|[A-Za-z_]\w*|(?:\d+\.\d*|\.\d+|\d+)(?:e[+-]?\d+)?f?|[-+*/<>=!]=|\+\+|&&|\|\||.", re.DOTALL
)
_ASSIGNMENTS = ("=", "+=", "-=", "*=", "/=")
_CLOSING = {"(": ")", "[": "]", "{": "}"}


def translated(text: str, prefix: str) -> str:
    """The WGSL of a header `text` whose names begin with `prefix`. The user must define <prefix>_data(index)."""
    return _Translation(_TOKEN.findall(_preprocessed(text, prefix))).text()


def _preprocessed(text, prefix) -> str:
    """The output of a shader's preprocessor. Macros that are whole numbers become constants."""
    lines, kept = [], [True]
    for line in text.splitlines():
        words = line.split(maxsplit=2)
        if not line.startswith("#"):
            lines += [line] if all(kept) else []
        elif words[0] in ("#if", "#ifdef", "#ifndef"):
            # Only LTSH_SHADER is defined: this is not C.
            kept.append(words[1] == "LTSH_SHADER" if words[0] == "#ifdef" else words[1] != "LTSH_SHADER")
            kept[-1] = kept[-1] and words[0] != "#if"
        elif words[0] in ("#else", "#elif"):
            kept[-1] = False
        elif words[0] == "#endif":
            kept.pop()
        elif words[0] == "#define" and all(kept) and len(words) == 3 and re.fullmatch(r"\d+", words[2]):
            lines.append(f"const {words[1]} = {words[2]};")
    return "\n".join(lines).replace(f"{prefix.upper()}_DATA(", f"{prefix}_data(")


class _Translation:
    """Translates the tokens of a text in one pass."""

    def __init__(self, tokens: list[str]):
        self._tokens, self._at = tokens, 0
        self._types = dict(_TYPES)

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
        found = [self._take()]
        while found[-1] != end:
            found.append(self._take())
        return "".join(found)

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
        for number, (own, kind) in enumerate(parameters):
            if re.search(rf"(?<![\w.]){own}[\w.\[\]]* [-+*/]?= ", body):
                parameters[number] = (f"{own}_given", kind)
                copies.append(f"\n    var {own} = {own}_given;")
        listed = ", ".join(f"{own}: {kind}" for own, kind in parameters)
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
                parts[-1] += _NAMES.get(token, token)
        parts[-1] = _chosen(parts[-1], choices)
        return "".join(parts)


def _chosen(last: str, choices: list[tuple[str, str]]) -> str:
    """`a ? b : c` as select(c, b, a); may be nested. `choices` has the part before each `?` or `:`, `last` the rest."""
    if not choices:
        return last.strip()
    (condition, _), (first, _), *others = choices
    return f"select({_chosen(last, others)}, {first.strip()}, {condition.strip()})"
