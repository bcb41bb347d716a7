"""The manifest and the extension's zip, tried with Blender's own extension tool."""

import importlib.util
import os
import shutil
import subprocess
import sys
import tomllib
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent


def blender_extension_tool() -> Path:
    """Blender's own command that validates and builds extensions; it needs no bpy."""
    spec = importlib.util.find_spec("bpy")
    if spec is None or spec.origin is None:
        pytest.skip("needs the bpy distribution")
    (tool,) = Path(spec.origin).parent.glob("*/scripts/addons_core/bl_pkg/cli/blender_ext.py")
    return tool


def run_extension_tool(*arguments) -> subprocess.CompletedProcess:
    return subprocess.run(
        [sys.executable, str(blender_extension_tool()), *map(str, arguments)],
        capture_output=True, text=True, timeout=120, check=False, env=os.environ | {"PYTHONDONTWRITEBYTECODE": "1"},
    )  # fmt: skip


def test_blender_accepts_the_manifest():
    run = run_extension_tool("validate", ROOT)
    assert run.returncode == 0, run.stdout + run.stderr


def test_the_zip_holds_the_add_on_and_nothing_else(tmp_path):
    """On a copy with one file of every kind, so that the answer does not hang on what lies in this clone."""
    source = tmp_path / "source"
    kept = ["__init__.py", "LICENSE", "README.md", "ltsh_addon/__init__.py", "ltsh_addon/blender/x.py", "tables/a.npz"]
    left = ["Makefile", "pyproject.toml", "CHANGELOG.md", "tests/test_x.py", "tables/fit.py", "tables/README.md",
            "out/demo/a.png", "requirements/py313.txt", ".venv/py313/bin/python", ".ci/run", "ltsh.zip",
            "ltsh_addon/__pycache__/x.pyc", "ltsh_addon/.hidden"]  # fmt: skip
    for name in kept + left:
        (source / name).parent.mkdir(parents=True, exist_ok=True)
        (source / name).write_text("", encoding="utf-8")
    shutil.copy(ROOT / "blender_manifest.toml", source)
    run = run_extension_tool("build", "--source-dir", source, "--output-filepath", tmp_path / "ltsh.zip")
    assert run.returncode == 0, run.stdout + run.stderr
    with zipfile.ZipFile(tmp_path / "ltsh.zip") as archive:
        names = [name for name in archive.namelist() if not name.endswith("/")]
    assert sorted(names) == sorted([*kept, "blender_manifest.toml"])


def test_manifest_and_project_tell_the_same_version_and_license():
    manifest, project = (
        tomllib.loads((ROOT / name).read_text(encoding="utf-8")) for name in ("blender_manifest.toml", "pyproject.toml")
    )
    assert manifest["version"] == project["project"]["version"]
    assert manifest["license"] == [f"SPDX:{project['project']['license']}"]
