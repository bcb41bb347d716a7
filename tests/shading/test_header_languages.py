"""Exported headers as texts: what C, C++ and GLSL take, and what tables/EXPORT.md says of them."""

import re
from pathlib import Path

import header_harness
import pytest

pytestmark = pytest.mark.skipif(header_harness.C_COMPILER is None, reason="needs a C compiler")

DOCUMENT = Path(__file__).resolve().parents[2] / "tables" / "EXPORT.md"


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
