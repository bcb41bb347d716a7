"""Who may import what: the arrows of the design, read from the source and tried in fresh interpreters."""

import ast
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
PACKAGE = ROOT / "ltsh_addon"
BLENDER_MODULES = frozenset(
    "aud bl_operators bl_ui blf bmesh bpy bpy_extras gpu gpu_extras idprop imbuf mathutils".split()
)
CORE_PARTS = {"scene", "ownership", "shading", "imaging"}

# part -> parts of the package it may use besides itself, and distributions it may use besides the standard library.
# "top" stands for the modules beside scene.py: the command line and what it is made of.
MAY_USE_PARTS = {
    "scene": set(),
    "ownership": set(),
    "shading": {"scene"},
    "imaging": {"scene", "ownership"},
    "blender": CORE_PARTS,
    "top": CORE_PARTS | {"blender", "top"},
}
MAY_USE_DISTRIBUTIONS = {
    "scene": {"numpy"},
    "ownership": set(),
    "shading": {"numpy"},
    "imaging": {"numpy", "OpenEXR", "Imath"},  # one distribution
    "blender": {"numpy", "OpenEXR", "zstandard"} | BLENDER_MODULES,  # bpy requires zstandard
    "top": {"numpy", "OpenEXR"},
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


def part_of(target: str) -> str:
    """The part of the package a dotted name inside it belongs to."""
    names = target.split(".")
    return names[1] if len(names) > 1 and names[1] in (*CORE_PARTS, "blender") else "top"


def violations(source: str, module: str, is_package: bool = False) -> list[str]:
    """What in a module of the package breaks the rules, one line each."""
    part = part_of(module)
    problems = []
    for item in read_imports(source, module, is_package):
        head = item.target.split(".")[0]
        where = f"{module} line {item.line} imports {item.target}"
        if head == "ltsh_addon":
            other = part_of(item.target)
            if not item.relative:
                problems.append(f"{where}: expected a relative import, Blender loads the package under another name")
            if other not in MAY_USE_PARTS[part] | {part}:
                problems.append(f"{where}: {part} may use {sorted(MAY_USE_PARTS[part])}, not {other}")
            if part == "top" and other == "blender" and not item.lazy:
                problems.append(f"{where}: expected inside a function, so that the core works without Blender")
        elif head not in sys.stdlib_module_names and head not in MAY_USE_DISTRIBUTIONS[part]:
            problems.append(f"{where}: {part} may use {sorted(MAY_USE_DISTRIBUTIONS[part])}")
    return problems


def sources(folder: Path) -> list[Path]:
    return sorted(path for path in folder.rglob("*.py") if "__pycache__" not in path.parts)


def dotted(path: Path) -> str:
    names = list(path.relative_to(ROOT).with_suffix("").parts)
    return ".".join(names[:-1] if names[-1] == "__init__" else names)


@pytest.mark.parametrize(
    ("module", "source", "complaint"),
    [
        ("ltsh_addon.scene", "import scipy.optimize", "scene may use ['numpy']"),
        ("ltsh_addon.scene", "from .shading import shade", "not shading"),
        ("ltsh_addon.shading.ltc", "def f():\n    import bpy", "shading may use ['numpy']"),
        ("ltsh_addon.shading.ltc", "from ..imaging import exr", "not imaging"),
        ("ltsh_addon.shading.ltc", "from .. import imaging", "not imaging"),
        ("ltsh_addon.shading.ltc", "from ..blender.lights import x", "not blender"),
        ("ltsh_addon.shading.ltc", "from ltsh_addon.scene import AreaLight", "relative import"),
        ("ltsh_addon.imaging.exr", "from ..shading import brdf", "not shading"),
        ("ltsh_addon.imaging.exr", "from .. import cli", "not top"),
        ("ltsh_addon.blender.lights", "from ..cli import main", "not top"),
        ("ltsh_addon.blender.lights", "import scipy", "blender may use"),
        ("ltsh_addon.cli", "from .blender import child", "inside a function"),
        ("ltsh_addon.cli", "if True:\n    from . import blender", "inside a function"),
        ("ltsh_addon.cli", "import bpy", "top may use"),
    ],
)
def test_the_rules_name_a_forbidden_import(module, source, complaint):
    problems = violations(source, module)
    assert len(problems) == 1 and complaint in problems[0], problems


@pytest.mark.parametrize(
    ("module", "source", "is_package"),
    [
        ("ltsh_addon.shading.ltc", "import math\nimport numpy as np\nfrom ..scene import AreaLight", False),
        ("ltsh_addon.shading", "from .brdf import ggx\nfrom ..scene import SurfaceSamples", True),
        ("ltsh_addon", "def register():\n    from . import blender", True),
        ("ltsh_addon.cli", "def main():\n    from .blender import child\n    from .imaging import exr", False),
        ("ltsh_addon.blender.lights", "import bpy\nfrom ..shading import shade\nfrom . import materials", False),
    ],
)
def test_the_rules_let_the_allowed_imports_pass(module, source, is_package):
    assert violations(source, module, is_package) == []


def test_the_package_follows_the_arrows():
    paths = sources(PACKAGE)
    problems = [
        problem
        for path in paths
        for problem in violations(path.read_text(encoding="utf-8"), dotted(path), path.name == "__init__.py")
    ]
    assert paths and not problems, "\n".join(problems)


@pytest.mark.parametrize("folder", ["shading", "imaging"])
def test_core_tests_do_not_need_blender(folder):
    users = [
        str(path.relative_to(ROOT))
        for path in sources(ROOT / "tests" / folder)
        for item in read_imports(path.read_text(encoding="utf-8"), dotted(path))
        if item.target.split(".")[0] in BLENDER_MODULES or item.target.startswith("ltsh_addon.blender")
    ]
    assert not users, users


def test_table_scripts_use_the_core_scipy_and_matplotlib_only():
    scripts = sources(ROOT / "tables")
    allowed = {"numpy", "scipy", "matplotlib", "tables"} | {path.stem for path in scripts} | sys.stdlib_module_names
    problems = []
    for script in scripts:
        for item in read_imports(script.read_text(encoding="utf-8"), dotted(script), script.name == "__init__.py"):
            head = item.target.split(".")[0]
            inside = head == "ltsh_addon" and part_of(item.target) in ("shading", "scene")
            if not inside and head not in allowed:
                problems.append(f"{script.name} line {item.line} imports {item.target}")
    assert scripts and not problems, problems


@pytest.mark.parametrize(
    "module",
    ["scene", "shading", "imaging", "cli", "comparison.compare", "__main__", "blender.processes.child", "blender"],
)
def test_importing_loads_neither_blender_nor_scipy(module):
    forbidden = sorted(BLENDER_MODULES | {"scipy"})
    code = (
        f"import sys, ltsh_addon.{module}\n"
        f"print(','.join(name for name in {forbidden} if name in sys.modules) or 'none')"
    )
    run = subprocess.run(
        [sys.executable, "-W", "error", "-c", code], cwd=ROOT, capture_output=True, text=True, timeout=600, check=False
    )
    assert run.stdout.strip() == "none", f"importing ltsh_addon.{module} loads: {run.stdout.strip()}\n{run.stderr}"


def test_the_extension_entry_point_imports_without_its_package():
    """pytest and Blender's validation both load the file alone; a relative import at its top level would fail."""
    code = "import __init__ as entry; assert callable(entry.register) and callable(entry.unregister)"
    run = subprocess.run(
        [sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, timeout=600, check=False
    )
    assert run.returncode == 0, run.stderr
