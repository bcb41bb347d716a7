"""The manifest and the extension's zips, tried with Blender's own extension tool."""

import hashlib
import importlib.util
import os
import posixpath
import re
import shutil
import tomllib
import zipfile
from pathlib import Path

import pytest
from fake_wheels import fake_library, fake_wheel
from markdown_text import links_of

from requirements import build_extension
from requirements.build_extension import PLATFORMS, PYTHONS, BuildError, run_tool, with_wheels

ROOT = Path(__file__).resolve().parents[2]
WHEEL_TAGS = {
    "linux-x64": "manylinux_2_28_x86_64",
    "macos-arm64": "macosx_11_0_arm64",
    "macos-x64": "macosx_10_15_x86_64",
    "windows-x64": "win_amd64",
}
# The manual and what it links to, from its folder.
MANUAL = ["docs/manual.md"] + [f"docs/{name}" for name in links_of((ROOT / "docs/manual.md").read_text("utf-8"))]
needs_tool = pytest.mark.skipif(importlib.util.find_spec("bpy") is None, reason="the tool comes with bpy")


def content(zip_path: Path) -> list[str]:
    with zipfile.ZipFile(zip_path) as archive:
        return [name for name in archive.namelist() if not name.endswith("/")]


@needs_tool
def test_blender_accepts_the_manifest():
    run = run_tool("validate", ROOT)
    assert run.returncode == 0, run.stdout + run.stderr


@needs_tool
def test_the_zip_holds_the_add_on_and_nothing_else(tmp_path):
    """On a copy with one file of every kind, so that the answer does not depend on what lies in this clone."""
    source = tmp_path / "source"
    kept = ["__init__.py", "LICENSE", "README.md", *MANUAL, "ltsh_addon/__init__.py", "ltsh_addon/blender/x.py",
            "ltsh_addon/blender/glsl/x.glsl", "ltsh_addon/shading/glsl/x.h", "tables/a.npz"]  # fmt: skip
    left = ["Makefile", "pyproject.toml", "CHANGELOG.md", "tests/test_x.py", "tables/fit.py",
            "tables/README.md", "out/demo/a.png", "requirements/py313.txt", ".venv/py313/bin/python", ".ci/run",
            "ltsh.zip", "build/wheels/a.whl", "farm/README.md", "docs/demo.png", "ltsh_addon/__pycache__/x.pyc",
            "ltsh_addon/.hidden"]  # fmt: skip
    for name in kept + left:
        (source / name).parent.mkdir(parents=True, exist_ok=True)
        (source / name).write_text("", encoding="utf-8")
    shutil.copy(ROOT / "blender_manifest.toml", source)
    run = run_tool("build", "--source-dir", source, "--output-filepath", tmp_path / "ltsh.zip")
    assert run.returncode == 0, run.stdout + run.stderr
    assert sorted(content(tmp_path / "ltsh.zip")) == sorted([*kept, "blender_manifest.toml"])


def test_manifest_and_project_tell_the_same_version_and_license():
    manifest, project = (
        tomllib.loads((ROOT / name).read_text(encoding="utf-8")) for name in ("blender_manifest.toml", "pyproject.toml")
    )
    assert manifest["version"] == project["project"]["version"]
    assert manifest["license"] == [f"SPDX:{project['project']['license']}"]


# ---- make extension


@pytest.fixture
def offline(monkeypatch):
    """pip that reaches no index, and no folder of wheels either."""
    for name in [name for name in os.environ if name.startswith("PIP_")]:
        monkeypatch.delenv(name)
    monkeypatch.setenv("PIP_CONFIG_FILE", os.devnull)
    monkeypatch.setenv("PIP_NO_INDEX", "1")


@pytest.fixture(scope="module")
def stand_ins(tmp_path_factory):
    """An output folder with stand-ins for the wheels, the only ones that the extension's pins name meanwhile."""
    output = tmp_path_factory.mktemp("extension")
    folder, pins = output / "wheels", output.with_name("wheels.txt")
    folder.mkdir()
    for python in PYTHONS:
        for tag in WHEEL_TAGS.values():
            fake_wheel(folder / f"openexr-1.0-cp{python}-cp{python}-{tag}.whl", fake_library(29, int(python)))
    hashes = [hashlib.sha256(path.read_bytes()).hexdigest() for path in folder.iterdir()]
    pins.write_text("openexr==1.0 \\\n" + " \\\n".join(f"    --hash=sha256:{item}" for item in hashes) + "\n")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(build_extension, "PINS", pins)
        yield output


@pytest.fixture(scope="module")
def zips(stand_ins):
    return build_extension.build(stand_ins)


@needs_tool
def test_each_platform_gets_a_zip_with_its_own_wheels(stand_ins, zips):
    hidden = re.compile(r"(^|/)(\.|__pycache__/)")
    code = [path.relative_to(ROOT).as_posix() for path in ROOT.glob("ltsh_addon/**/*") if path.is_file()]
    tables = [f"tables/{path.name}" for path in ROOT.glob("tables/*.npz")]
    common = {"blender_manifest.toml", "__init__.py", "LICENSE", "README.md", *MANUAL, *tables}
    common |= {name for name in code if not hidden.search(name)}
    version = tomllib.loads((ROOT / "blender_manifest.toml").read_text(encoding="utf-8"))["version"]
    names = [f"ltsh-{version}-{name.replace('-', '_')}.zip" for name in sorted(PLATFORMS)]
    assert [path.name for path in zips] == names
    for path, platform in zip(zips, sorted(PLATFORMS), strict=True):
        build = "-1" if platform.startswith("linux") else ""
        own = [f"wheels/openexr-1.0{build}-cp{python}-cp{python}-{WHEEL_TAGS[platform]}.whl" for python in PYTHONS]
        assert set(content(path)) == common | set(own) and len(content(path)) == len(common) + len(own)
        with zipfile.ZipFile(path) as archive:
            manifest = tomllib.loads(archive.read("blender_manifest.toml").decode())
        generated = manifest["build"]["generated"]
        assert generated == {"platforms": [platform], "wheels": [f"./{name}" for name in own]}
    assert sorted(path.name for path in stand_ins.iterdir()) == [*names, "wheels"]


@needs_tool
def test_links_and_pictures_in_a_zip_are_there(zips):
    for path in zips:
        with zipfile.ZipFile(path) as archive:
            for name in ("README.md", "docs/manual.md"):
                links = {
                    posixpath.join(posixpath.dirname(name), link) for link in links_of(archive.read(name).decode())
                }
                assert links and {posixpath.normpath(link) for link in links} <= set(archive.namelist()), path.name


@needs_tool
def test_the_same_tree_gives_the_same_bytes(stand_ins, zips, tmp_path):
    """Also from wheels that were fetched at another time, into another folder."""
    shutil.copytree(stand_ins / "wheels", tmp_path / "wheels", copy_function=shutil.copyfile)
    for path in (tmp_path / "wheels").iterdir():
        os.utime(path, (1_000_000_000, 1_000_000_000))
    again = build_extension.build(tmp_path)
    assert [path.name for path in again] == [path.name for path in zips]
    assert [path.read_bytes() for path in again] == [path.read_bytes() for path in zips]


def test_a_wheel_that_is_not_the_pinned_one_is_never_taken(stand_ins, offline, tmp_path):
    wheels = shutil.copytree(stand_ins / "wheels", tmp_path / "wheels")
    assert len(build_extension.fetch_wheels(wheels)) == len(PYTHONS) * len(PLATFORMS)
    damaged = wheels / f"openexr-1.0-cp311-cp311-{WHEEL_TAGS['windows-x64']}.whl"
    damaged.write_bytes(b"something else")
    with pytest.raises(BuildError, match=r"windows-x64, Python 3\.11"):
        build_extension.fetch_wheels(wheels)


def test_without_a_network_one_message_says_what_to_do(tmp_path, offline, capsys):
    assert build_extension.main(["--output", str(tmp_path / "out")]) == 1
    message = capsys.readouterr().err
    assert message.startswith("make extension: pip could not download the wheel of OpenEXR for linux-x64, Python 3.11")
    assert "package index" in message and str(tmp_path / "out" / "wheels") in message and len(message.splitlines()) == 2
    assert list((tmp_path / "out").glob("*.zip")) == []


def test_keys_are_added_and_nothing_else_changes():
    manifest = (ROOT / "blender_manifest.toml").read_text(encoding="utf-8")
    names = ["./wheels/b.whl", "./wheels/a.whl"]
    longer = with_wheels(manifest, names)
    added = {"platforms": sorted(PLATFORMS), "wheels": sorted(names)}
    assert tomllib.loads(longer) == tomllib.loads(manifest) | added
    assert [line for line in longer.splitlines() if line in manifest.splitlines()].count("[build]") == 1
    assert tomllib.loads(with_wheels('id = "x"\n', names)) == {"id": "x"} | added
    with pytest.raises(BuildError, match="expected neither"):
        with_wheels('wheels = ["x"]\n', names)


def test_the_wheels_are_of_the_version_that_is_tested():
    pins = [(ROOT / "requirements" / name).read_text(encoding="utf-8") for name in ("wheels.txt", "py313.txt")]
    first, second = (re.search(r"^openexr==\S+ \\\n(?:    --hash=\S+(?: \\)?\n)+", text, re.M) for text in pins)
    assert first.group().rstrip(" \\\n") == second.group().rstrip(" \\\n")
