"""Exported headers as texts: what C, C++ and GLSL take, and what tables/EXPORT.md says of them."""

import re
from pathlib import Path

import header_harness
import pytest

pytestmark = pytest.mark.skipif(header_harness.C_COMPILER is None, reason="needs a C compiler")

DOCUMENT = Path(__file__).resolve().parents[2] / "tables" / "EXPORT.md"
# What GLSL 3.30 has no word for, or keeps for itself: the language of C that must not be left in its branch.
NOT_GLSL = [
    r"\b(static|inline|typedef|sizeof|extern|register|unsigned|long|short|char|double|NULL|malloc|memcpy)\b",
    r"\b(near|far|half|fixed|input|output|sample|filter|common|partition|active|this|template|namespace|using)\b",
    r"\b(sqrt|sin|cos|atan2?|fabs|fmax|fmin|floor)f\b|\batan2\b",
    r"->|__|[\"'#\\]|\(\s*(int|float)\s*\)",
    r"=\s*\{|\breturn\s*\{|\}\s*\w+\s*;",
    r"(?<!&)&(?!&)|\b(int|float|vec3|ltsh\w*)\s*\*\s*\w+\s*[,)=;]|\(\s*\*",
    r"\b(goto|switch|enum|union|asm)\b",
]


def test_c_and_cplusplus_take_all_headers_together(folder, tables):
    source = "".join(f'#include "{folder / name}.h"\n' for name in (*tables, "ltsh4"))
    assert header_harness.accepts(header_harness.C_COMPILER, source, folder / "all.c", "-std=c99") == ""
    if header_harness.CXX_COMPILER is not None:
        assert header_harness.accepts(header_harness.CXX_COMPILER, source, folder / "all.cpp", "-std=c++11") == ""


def test_c_can_keep_the_data_elsewhere(folder, tables):
    source = f'extern const float *mine;\n#define LTSH4_DATA(index) mine[index]\n#include "{folder}/ltsh4.h"\n'
    assert header_harness.accepts(header_harness.C_COMPILER, source, folder / "mine.c", "-std=c99") == ""
    text = header_harness.preprocessed(folder / "ltsh4.h", "LTSH4_DATA(index)=mine[index]")
    assert "ltsh4_data" not in text and "mine[" in text


@pytest.mark.parametrize(
    ("definition", "complaint"),
    [("LTSH_SHARED 0", "different versions"), ("GL_core_profile 1", "define LTC_DATA(index)")],
)
def test_other_versions_and_glsl_without_data_are_refused(folder, tables, definition, complaint):
    source = f'#define {definition}\n#include "{folder}/ltc.h"\n'
    assert complaint in header_harness.accepts(header_harness.C_COMPILER, source, folder / "refused.c", "-std=c99")


def _glsl(path, name):
    return header_harness.preprocessed(path, "GL_core_profile=1", f"{name.upper()}_DATA(index)=fetched(index)")


@pytest.mark.parametrize("name", header_harness.NAMES)
def test_the_glsl_branch_holds_nothing_that_is_c_only(folder, tables, name):
    text = _glsl(folder / f"{name}.h", name)
    for pattern in NOT_GLSL:
        found = re.search(pattern, text)
        assert found is None, text[max(found.start() - 80, 0) : found.end() + 80]
    assert "fetched(" in text and f"{name}_data" not in text and len(text) < 60_000


def test_the_search_for_c_finds_the_c_branch(folder, tables):
    """Each kind of word that is forbidden in GLSL stands in the C branch, or is refused here by example."""
    text = header_harness.preprocessed(folder / "ltc.h")
    assert re.search(NOT_GLSL[0], text) and re.search(NOT_GLSL[2], text) and re.search(NOT_GLSL[4], text)
    samples = ["float near = 1.0f;", "(int)x", "a->b", "ltsh_vec3 v = {1.0f};", "f(&x)", "float *p)", "goto end;"]
    assert all(any(re.search(pattern, sample) for pattern in NOT_GLSL) for sample in samples)


def _functions(text, name):
    """Names of the functions that a preprocessed header defines, with <name> for its table."""
    found = set(re.findall(r"^ *(?:static inline )?\w+ (\w+)\([^;]*\)\s*\{", text, flags=re.MULTILINE))
    return {re.sub(f"^{name}_", "<name>_", function) for function in found if function.startswith(("ltsh_", name))}


def test_both_branches_define_the_same_documented_functions(folder, tables):
    documented = set(re.findall(r"`((?:ltsh|<name>)_[a-z_0-9]+)(?:\(|`)", DOCUMENT.read_text(encoding="utf-8")))
    for name in ("ltc", "ltsh2", "ltsh4", "ltsh4c"):
        functions = _functions(_glsl(folder / f"{name}.h", name), name)
        assert functions == documented - {"<name>_data"}, functions ^ documented
        assert _functions(header_harness.preprocessed(folder / f"{name}.h"), name) == functions | {"<name>_data_at"}


def test_every_offset_is_documented(folder, tables):
    text = DOCUMENT.read_text(encoding="utf-8")
    names = re.findall(r"#define LTSH4_(\w+_OFFSET|DATA_COUNT) ", (folder / "ltsh4.h").read_text(encoding="ascii"))
    assert len(names) == 6 and all(f"`<NAME>_{name}`" in text for name in names)


def test_the_documented_c_example_compiles(folder, tables):
    (example,) = re.findall(r"```c\n(.*?)```", DOCUMENT.read_text(encoding="utf-8"), flags=re.DOTALL)
    assert header_harness.accepts(header_harness.C_COMPILER, example, folder / "example.c", "-std=c99") == ""
