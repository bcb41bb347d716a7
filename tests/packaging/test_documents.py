"""Markdown files: their links lead somewhere, the code that they name is there, the Python that they show runs."""

import ast
import re
from pathlib import Path

import pytest
from markdown_text import FENCE, anchors_of, links_of

ROOT = Path(__file__).resolve().parents[2]
SKIPPED = {"out", "build"}
DOCUMENTS = sorted(
    path
    for path in ROOT.rglob("*.md")
    if not any(part.startswith(".") or part in SKIPPED for part in path.relative_to(ROOT).parts)
)
SPAN = re.compile(r"`([^`\n]+)`")
# `folder/file.py`, `folder/`, `file.py:name`
NAMED = re.compile(r"([\w./-]+(?:\.(?:py|md|sh|js|toml)|/))(?::(\w+))?")


def read(path: Path) -> str:
    return path.read_text(encoding="utf-8")


def name_of(path: Path) -> str:
    return path.relative_to(ROOT).as_posix()


@pytest.mark.parametrize("path", DOCUMENTS, ids=name_of)
def test_links_and_pictures_are_there(path):
    dead = []
    for target in links_of(read(path)):
        file, _, anchor = target.partition("#")
        aim = path.parent / file if file else path
        if not aim.exists() or (anchor and anchor not in anchors_of(read(aim))):
            dead.append(target)
    assert not dead, f"{name_of(path)}: {dead}"


def test_dead_links_are_found():
    text = "# A title, two\n[a](x.md) ![b](y.png) [c](https://z.org)\n```\n[d](in_code.md)\n```\n"
    assert links_of(text) == ["x.md", "y.png"] and anchors_of(text) == {"a-title-two"}


@pytest.mark.parametrize("path", DOCUMENTS, ids=name_of)
def test_files_and_functions_that_are_named_are_there(path):
    lost = []
    for span in SPAN.findall(FENCE.sub("", read(path))):
        match = NAMED.fullmatch(span)
        if match is None or match[1].partition("/")[0] in SKIPPED:
            continue
        folders = [path.parent, ROOT, ROOT / "ltsh_addon"]
        found = next((folder / match[1] for folder in folders if (folder / match[1]).exists()), None)
        defined = found is not None and (
            match[2] is None or re.search(rf"^(def|class) {match[2]}\b", read(found), re.MULTILINE)
        )
        if not defined:
            lost.append(span)
    assert not lost, f"{name_of(path)}: {lost}"


@pytest.mark.parametrize("path", DOCUMENTS, ids=name_of)
def test_the_python_that_is_shown_imports(path):
    """Blocks that make all that they use run as a whole."""
    for language, code in FENCE.findall(read(path)):
        if language != "python":
            continue
        tree = ast.parse(code)
        if "np.array" in code:
            exec(code, {})
            continue
        imports = [node for node in tree.body if isinstance(node, ast.Import | ast.ImportFrom)]
        names: dict = {}
        exec(compile(ast.Module(imports, []), str(path), "exec"), names)
        for call in (node for node in ast.walk(tree) if isinstance(node, ast.Call)):
            if isinstance(call.func, ast.Name) and call.func.id.endswith("Options"):
                fields = names[call.func.id].__dataclass_fields__
                assert {keyword.arg for keyword in call.keywords} <= fields.keys(), ast.unparse(call)


def test_the_readme_takes_one_sitting():
    assert len(read(ROOT / "README.md").splitlines()) <= 120
