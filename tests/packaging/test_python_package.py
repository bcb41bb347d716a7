"""The Python package in a fresh environment, away from the checkout: tables, data files, `ltsh`, README's examples."""

import os
import re
import shutil
import subprocess
import sys
import sysconfig
import venv
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
BUILT_FROM = ("ltsh_addon", "tables", "setup.py", "pyproject.toml", "README.md", "LICENSE")


def run(*command, **options):
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    return subprocess.run(
        list(map(str, command)), capture_output=True, text=True, timeout=600, env=environment, check=False, **options
    )


@pytest.fixture(scope="module")
def wheel(tmp_path_factory):
    """The wheel, built from a copy without network: building leaves folders in the source."""
    source, output = tmp_path_factory.mktemp("source"), tmp_path_factory.mktemp("wheel")
    for name in BUILT_FROM:
        copy = shutil.copytree if (ROOT / name).is_dir() else shutil.copy
        copy(ROOT / name, source / name)
    options = ("--no-deps", "--no-build-isolation", "--no-index", "--quiet", "-w", output)
    done = run(sys.executable, "-m", "pip", "wheel", source, *options)
    assert done.returncode == 0, done.stderr
    (path,) = output.glob("ltsh-*.whl")
    return path


@pytest.fixture(scope="module")
def python(wheel, tmp_path_factory):
    """The Python of an environment with the package; numpy and OpenEXR come from the environment of the tests."""
    folder = tmp_path_factory.mktemp("environment")
    venv.create(folder, with_pip=False)
    scripts = folder / ("Scripts" if os.name == "nt" else "bin")
    site = next(folder.rglob("site-packages"))
    done = run(sys.executable, "-m", "pip", "--python", folder, "install", "--no-deps", "--no-index", "--quiet", wheel)
    assert done.returncode == 0, done.stderr
    (site / "borrowed.pth").write_text(sysconfig.get_path("purelib"))
    return scripts / "python"


def test_only_the_add_on_is_installed_with_all_its_files(wheel):
    with zipfile.ZipFile(wheel) as archive:
        inside = {name for name in archive.namelist() if ".dist-info/" not in name}
    source = [path for path in (ROOT / "ltsh_addon").rglob("*") if path.is_file() and path.suffix != ".pyc"]
    expected = {path.relative_to(ROOT).as_posix() for path in source}
    expected |= {f"ltsh_addon/tables/{path.name}" for path in (ROOT / "tables").glob("*.npz")}
    assert inside == expected


def test_the_examples_of_the_readme_run_in_any_folder(python, tmp_path):
    code = [code for code in re.findall(r"^```python\n(.*?)^```", (ROOT / "README.md").read_text("utf-8"), re.M | re.S)]
    assert len(code) == 2 and "load_table" in code[0]
    done = run(python, "-W", "error", "-c", code[0], cwd=tmp_path)
    assert done.returncode == 0 and float(done.stdout.strip(" []\n")) > 0.0, done.stderr
    imports = "\n".join(line for line in code[1].splitlines() if "import" in line)
    done = run(python, "-W", "error", "-c", f"{imports}\nimport ltsh_addon; print(ltsh_addon.__file__)", cwd=tmp_path)
    assert done.returncode == 0 and str(python.parents[1]) in done.stdout, done.stderr


def test_tables_are_the_shipped_ones_bit_for_bit(python, tmp_path):
    folder = next(python.parents[1].rglob("site-packages")) / "ltsh_addon" / "tables"
    for path in sorted((ROOT / "tables").glob("*.npz")):
        assert (folder / path.name).read_bytes() == path.read_bytes()


def test_the_console_script_is_the_command_line(python, tmp_path):
    done = run(python.with_name("ltsh"), "--version", cwd=tmp_path)
    assert done.returncode == 0 and done.stdout.startswith("ltsh "), done.stderr
    done = run(python.with_name("ltsh"), "shade", cwd=tmp_path)
    assert done.returncode == 2 and "-o" in done.stderr
