"""The house: which room may import which, no circle of files, no crowd of small files; lazy imports count.

Read from the source, and tried in fresh interpreters.
"""

import ast
import subprocess
import sys
import tokenize
from dataclasses import dataclass
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
PACKAGE = ROOT / "ltsh_addon"
MOST_FILES = 193
MOST_LINES = 51975  # of the package
MOST_LINES_OF_A_FILE = 600
# Files that hold one subject and are longer: why.
LONGER = {}
# What a value has been through, not what it is.
VAGUE_NAMES = frozenset("found part own place left kept seen".split())
MOST_VAGUE_NAMES = 600
FEWEST_LINES = 50  # of a file that only one other imports
BLENDER_MODULES = frozenset(
    "aud bl_operators bl_ui blf bmesh bpy bpy_extras cycles gpu gpu_extras idprop imbuf mathutils".split()
)
# A room imports only from itself and from rooms to its left. Rooms are files and folders of the package; what no line
# names belongs to the room of its folder.
ROOMS = """
    interruption scene reading files lobes emitters workers shading cycles visibility imaging
    blender.process blender.evaluated blender.render_settings blender.saving blender.materials blender.lights
    blender.extract blender.viewport
    pipeline cli panel_job
    blender.ui blender.engine blender.registration
""".split()
TABLES_MAY_USE = ("scene", "reading", "files", "lobes", "shading", "cycles", "imaging", "pipeline")
# Room or folder of rooms -> distributions that it may use besides the standard library.
MAY_USE = {
    "blender": {"numpy", "OpenEXR"} | BLENDER_MODULES,
    "imaging": {"numpy", "OpenEXR", "Imath"},  # one distribution
    "pipeline": {"numpy", "OpenEXR"},
    "interruption": set(),
}


@dataclass(frozen=True)
class Import:
    """One imported name: `target` is dotted and absolute ("ltsh_addon.scene", "numpy.linalg")."""

    target: str
    relative: bool
    lazy: bool  # inside a function, so not executed when the module is imported
    line: int


def read_imports(source: str, module: str, is_package: bool = False) -> list[Import]:
    """All imports of a module's source; `module` is its dotted name, against which relative ones are resolved."""
    found = []

    def visit(node, lazy):
        for child in ast.iter_child_nodes(node):
            inside = lazy or isinstance(child, ast.FunctionDef | ast.AsyncFunctionDef | ast.Lambda)
            if isinstance(child, ast.Import):
                found.extend(Import(alias.name, False, lazy, child.lineno) for alias in child.names)
            elif isinstance(child, ast.ImportFrom):
                # One dot is the package the module lies in, which is the module itself for an __init__.py.
                drop = child.level - (1 if is_package else 0)
                base = module.split(".")[: len(module.split(".")) - drop] if child.level else []
                stem = base + ([child.module] if child.module else [])
                found.extend(
                    Import(".".join([*stem, alias.name]), child.level > 0, lazy, child.lineno) for alias in child.names
                )
            visit(child, inside)

    visit(ast.parse(source), False)
    return found


def room_of(target: str) -> str | None:
    """The room of a dotted name inside the package; None for the package itself and its entry points."""
    name = target.removeprefix("ltsh_addon").lstrip(".")
    return next((room for room in sorted(ROOMS, key=len, reverse=True) if f"{name}.".startswith(f"{room}.")), None)


def violations(imports: list[Import], module: str) -> list[str]:
    """Which imports of a module of the package break the rules, one line each."""
    room, problems = room_of(module), []
    top = "blender" if room and room.startswith("blender.") else room
    for item in imports:
        head = item.target.split(".")[0]
        where = f"{module} line {item.line} imports {item.target}"
        if head == "ltsh_addon":
            other = room_of(item.target)
            if not item.relative:
                problems.append(f"{where}: expected a relative import, Blender loads the package under another name")
            if room is not None and (other is None or ROOMS.index(other) > ROOMS.index(room)):
                problems.append(f"{where}: {room} stands left of {other or 'the entry points'}")
            if top != "blender" and other is not None and other.startswith("blender.") and not item.lazy:
                problems.append(f"{where}: expected inside a function, so that the core works without Blender")
        elif head not in sys.stdlib_module_names and head not in MAY_USE.get(top, {"numpy"}):
            problems.append(f"{where}: {top} may use {sorted(MAY_USE.get(top, {'numpy'}))}")
    return problems


def sources(folder: Path) -> list[Path]:
    return sorted(path for path in folder.rglob("*.py") if "__pycache__" not in path.parts)


def dotted(path: Path) -> str:
    names = list(path.relative_to(ROOT).with_suffix("").parts)
    return ".".join(names[:-1] if names[-1] == "__init__" else names)


def imports_of(path: Path) -> list[Import]:
    return read_imports(path.read_text(encoding="utf-8"), dotted(path), path.name == "__init__.py")


def arrows_of(paths) -> dict[str, set[str]]:
    """Module -> modules of these files that it imports: what it names, or the module that what it names is in."""
    modules = {dotted(path): path for path in paths}
    arrows = {}
    for name, path in modules.items():
        targets = [item.target for item in imports_of(path)]
        found = {target if target in modules else target.rpartition(".")[0] for target in targets}
        arrows[name] = found & modules.keys() - {name}
    return arrows


def circles(arrows: dict[str, set[str]]) -> list[str]:
    """One way around each circle that a walk along the arrows meets."""
    found, done = [], set()

    def walk(name, way):
        if name in way:
            found.append(" -> ".join([*way[way.index(name) :], name]))
        elif name not in done:
            for target in sorted(arrows[name]):
                walk(target, [*way, name])
            done.add(name)

    for name in sorted(arrows):
        walk(name, [])
    return found


@pytest.mark.parametrize(
    ("module", "source", "complaint"),
    [
        ("ltsh_addon.scene", "import scipy.optimize", "scene may use ['numpy']"),
        ("ltsh_addon.scene", "from .shading import shade", "scene stands left of shading"),
        ("ltsh_addon.shading.ltc", "def f():\n    import bpy", "shading may use ['numpy']"),
        ("ltsh_addon.shading.ltc", "def f():\n    from .. import cycles", "left of cycles"),
        ("ltsh_addon.cycles.uv", "from ltsh_addon.scene import Light", "relative import"),
        ("ltsh_addon.cycles.uv", "from .. import __version__", "left of the entry points"),
        ("ltsh_addon.blender.materials.aovs", "from ..lights import area", "left of blender.lights"),
        ("ltsh_addon.blender.extract.bake", "from ...pipeline import bake", "left of pipeline"),
        ("ltsh_addon.blender.lights.area", "import scipy", "blender may use"),
        ("ltsh_addon.cli.commands", "if True:\n    from ..blender import evaluated", "inside a function"),
        ("ltsh_addon.shading.ltc", "import math\nimport numpy as np\nfrom ..scene import Light", None),
        ("ltsh_addon", "def register():\n    from . import blender", None),
        ("ltsh_addon.pipeline.bake", "def f():\n    from ..blender.process import pixels\n    import OpenEXR", None),
        ("ltsh_addon.blender.engine.view", "import bpy\nfrom ...pipeline import bake\nfrom ..ui import job", None),
    ],
)
def test_the_rules_name_a_forbidden_import_and_no_other(module, source, complaint):
    problems = violations(read_imports(source, module, module == "ltsh_addon"), module)
    assert len(problems) == (complaint is not None) and (complaint or "") in "".join(problems), problems


def test_circles_are_found():
    assert circles({"a": {"b"}, "b": {"c"}, "c": {"b"}, "d": {"a"}}) == ["b -> c -> b"]
    assert circles({"a": {"b", "c"}, "b": {"c"}, "c": set()}) == []


def test_the_rooms_import_from_left_to_right():
    problems = [line for path in sources(PACKAGE) for line in violations(imports_of(path), dotted(path))]
    assert not problems, "\n".join(problems)


def test_every_file_is_in_a_room():
    entries = {"ltsh_addon", "ltsh_addon.__main__", "ltsh_addon.blender"}
    lost = [name for name in map(dotted, sources(PACKAGE)) if room_of(name) is None and name not in entries]
    assert not lost, f"no room in ROOMS for: {lost}"


@pytest.mark.parametrize("folder", ["ltsh_addon", "tables"])
def test_no_file_imports_itself_by_way_of_others(folder):
    assert circles(arrows_of(sources(ROOT / folder))) == []


def test_there_are_few_files_and_no_crumbs():
    paths = sources(PACKAGE) + sources(ROOT / "tables")
    assert len(paths) <= MOST_FILES, f"{len(paths)} files, expected at most {MOST_FILES}: which belong together?"
    importers = {dotted(path): set() for path in paths}
    for name, targets in arrows_of(paths).items():
        for target in targets:
            importers[target].add(name)
    crumbs = [
        f"{path.relative_to(ROOT)} is only imported by {next(iter(importers[dotted(path)]))}"
        for path in paths
        if path.name != "__init__.py"
        and len(importers[dotted(path)]) == 1
        and len(path.read_text(encoding="utf-8").splitlines()) < FEWEST_LINES
    ]
    assert not crumbs, f"fewer than {FEWEST_LINES} lines, belongs into its importer: {crumbs}"


def test_the_package_and_its_files_stay_small():
    lines = {dotted(path): len(path.read_text(encoding="utf-8").splitlines()) for path in sources(PACKAGE)}
    total = sum(lines.values())
    assert total <= MOST_LINES
    long = {name: count for name, count in lines.items() if count > MOST_LINES_OF_A_FILE and name not in LONGER}
    assert not long, f"files above {MOST_LINES_OF_A_FILE} lines hold several subjects, or a reason in LONGER: {long}"
    assert all(lines[name] > MOST_LINES_OF_A_FILE for name in LONGER), "these are short now"


def test_every_class_name_stands_once():
    where = {}
    for path in sources(PACKAGE):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.ClassDef):
                where.setdefault(node.name, []).append(dotted(path))
    twice = {name: modules for name, modules in where.items() if len(modules) > 1}
    assert not twice, twice


def vague_names(path: Path) -> int:
    with path.open("rb") as file:
        tokens = tokenize.tokenize(file.readline)
        return sum(token.type == tokenize.NAME and token.string in VAGUE_NAMES for token in tokens)


def test_names_say_what_a_value_is():
    counts = {dotted(path): vague_names(path) for path in sources(PACKAGE)}
    most = sorted(counts, key=counts.get, reverse=True)[:5]
    total = sum(counts.values())
    assert total <= MOST_VAGUE_NAMES, {name: counts[name] for name in most}


@pytest.mark.parametrize(
    "folder", "scene lobes emitters workers shading cycles imaging pipeline cli tables packaging farm helpers".split()
)
def test_tests_outside_tests_blender_need_none(folder):
    users = [
        str(path.relative_to(ROOT))
        for path in sources(ROOT / "tests" / folder)
        for item in imports_of(path)
        if item.target.split(".")[0] in BLENDER_MODULES
    ]
    assert not users, users


def test_table_scripts_use_the_core_scipy_and_matplotlib_only():
    scripts = sources(ROOT / "tables")
    allowed = {"numpy", "scipy", "matplotlib", "tables"} | {path.stem for path in scripts} | sys.stdlib_module_names
    problems = []
    for script in scripts:
        for item in imports_of(script):
            head = item.target.split(".")[0]
            inside = head == "ltsh_addon" and room_of(item.target) in TABLES_MAY_USE
            if not inside and head not in allowed:
                problems.append(f"{script.name} line {item.line} imports {item.target}")
    assert scripts and not problems, problems


def names_of(path: Path) -> set[str]:
    """What stands at the top level of a file, and the modules of its folder where it is a package."""
    tree = ast.parse(path.read_text(encoding="utf-8"))
    found = {part.stem for part in path.parent.iterdir()} if path.name == "__init__.py" else set()
    inner = ast.FunctionDef, ast.ClassDef, ast.AsyncFunctionDef, ast.Lambda

    def visit(node):
        for child in ast.iter_child_nodes(node):
            if isinstance(child, ast.Name) and isinstance(child.ctx, ast.Store):
                found.add(child.id)
            elif isinstance(child, ast.alias):
                found.add((child.asname or child.name).split(".")[0])
            if isinstance(child, inner):
                found.add(getattr(child, "name", ""))
            else:
                visit(child)

    visit(tree)
    return found


def missing_names(source: str, modules: dict[str, set[str]]) -> list[str]:
    """What a script asks of `modules`, names by dotted name, that they do not have."""
    known, asked = {}, []
    tree = ast.parse(source)
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            known |= {alias.asname or alias.name: alias.name for alias in node.names if alias.name in modules}
        elif isinstance(node, ast.ImportFrom) and not node.level:
            for alias in node.names:
                whole = f"{node.module}.{alias.name}"
                if whole in modules:
                    known[alias.asname or alias.name] = whole
                elif node.module in modules:
                    asked.append((node.module, alias.name, node.lineno))
    for node in ast.walk(tree):
        if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name) and node.value.id in known:
            asked.append((known[node.value.id], node.attr, node.lineno))
    return [f"line {line}: {module}.{name}" for module, name, line in asked if name not in modules[module]]


def test_missing_names_are_found():
    modules = {"a.b": {"c"}, "d": {"e"}}
    assert missing_names("from a import b\nimport d\nb.c, d.e, b.x\nfrom d import y", modules) == [
        "line 4: d.y", "line 3: a.b.x"
    ]  # fmt: skip


@pytest.mark.parametrize("folder", ["benchmarks", "soak"])
def test_long_scripts_ask_only_for_what_there_is(folder):
    """`make test` does not run them."""
    scripts = sources(ROOT / "tests" / folder)
    modules = {dotted(path): names_of(path) for path in sources(PACKAGE)}
    modules |= {path.stem: names_of(path) for path in scripts}
    problems = [f"{path.name} {line}" for path in scripts for line in missing_names(path.read_text("utf-8"), modules)]
    assert scripts and not problems, "\n".join(problems)


@pytest.mark.parametrize(
    "module",
    "scene shading cycles.texels imaging pipeline pipeline.picture cli __main__ blender.process.pixels".split(),
)
def test_importing_loads_neither_blender_nor_scipy(module):
    forbidden = sorted(BLENDER_MODULES | {"scipy"})
    code = (
        f"import sys, ltsh_addon.{module}\n"
        f"print(','.join(name for name in {forbidden} if name in sys.modules) or 'none')"
    )
    command = [sys.executable, "-W", "error", "-c", code]
    run = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=600, check=False)
    assert run.stdout.strip() == "none", f"importing ltsh_addon.{module} loads: {run.stdout.strip()}\n{run.stderr}"


def test_the_extension_entry_point_imports_without_its_package():
    """pytest and Blender's validation both load the file alone; a relative import at its top level would fail."""
    code = "import __init__ as entry; assert callable(entry.register) and callable(entry.unregister)"
    subprocess.run([sys.executable, "-c", code], cwd=ROOT, timeout=600, check=True)
