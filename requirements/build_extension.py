"""`make extension`: the extension's zips, one per platform, each with the wheels of OpenEXR that it needs.

    python -m requirements.build_extension [--output build]

Runs in an environment of requirements/setup.sh, whose bpy brings Blender's own extension tool. That tool builds the
plain zip from the tree as blender_manifest.toml says; its content is unpacked, wheels and platforms are added to the
manifest, and the tool builds and validates the zips. Wheels are those of wheels.txt, by hash, with one flag set in
those for Linux (symbolic_wheel.py); they stay in OUTPUT/wheels, so that only the first run needs a network. The same
tree and wheels give the same bytes.
"""

from __future__ import annotations

import argparse
import hashlib
import importlib.util
import os
import re
import shutil
import subprocess
import sys
import tempfile
import tomllib
import zipfile
from pathlib import Path

from .symbolic_wheel import write_symbolic_wheel

ROOT = Path(__file__).resolve().parent.parent
MANIFEST = "blender_manifest.toml"
PINS = Path(__file__).with_name("wheels.txt")

# Python of Blender 4.5 and 5.0, of 5.1 and later, and of Debian's Blender: an add-on is refused where no wheel fits.
PYTHONS = ("311", "313", "314")
# Blender's platform -> the oldest system that Blender runs on there, as wheels name it.
PLATFORMS = {
    "linux-x64": "manylinux_2_28_x86_64",
    "macos-arm64": "macosx_11_0_arm64",
    "macos-x64": "macosx_11_0_x86_64",
    "windows-x64": "win_amd64",
}
EARLIEST_ZIP_DATE = (1980, 1, 1, 0, 0, 0)
TOOL_SECONDS = 120
DOWNLOAD_SECONDS = 600


class BuildError(Exception):
    """The zips cannot be built; the message says why and what to do."""


def extension_tool() -> Path:
    """Blender's command that validates and builds extensions; it needs no bpy, but comes with it."""
    spec = importlib.util.find_spec("bpy")
    if spec is None or spec.origin is None:
        raise BuildError(f"{sys.executable} has no bpy, whose extension tool builds the zips: run `make extension`")
    found = sorted(Path(spec.origin).parent.glob("*/scripts/addons_core/bl_pkg/cli/blender_ext.py"))
    if not found:
        raise BuildError(f"{Path(spec.origin).parent}: no bl_pkg/cli/blender_ext.py, expected Blender 4.5 or newer")
    return found[-1]


def run_tool(*arguments) -> subprocess.CompletedProcess:
    """Blender's extension tool with these arguments, its output as text."""
    return subprocess.run(
        [sys.executable, str(extension_tool()), *map(str, arguments)],
        capture_output=True, text=True, timeout=TOOL_SECONDS, check=False,
        env=os.environ | {"PYTHONDONTWRITEBYTECODE": "1"},
    )  # fmt: skip


def build(output: Path) -> list[Path]:
    """Build the zips of all platforms into `output`; their paths. Raises BuildError."""
    output.mkdir(parents=True, exist_ok=True)
    wheels = fetch_wheels(output / "wheels")
    with tempfile.TemporaryDirectory(prefix="ltsh-extension-") as name:
        staged, built = Path(name) / "source", Path(name) / "zips"
        built.mkdir()
        _stage(staged, wheels)
        _checked("build", "--source-dir", staged, "--output-dir", built, "--split-platforms")
        paths = []
        for path in sorted(built.glob("*.zip")):
            paths.append(output / path.name)
            # Within the same folder, so that a zip appears whole or not at all; the tool knows zips by their suffix.
            unfinished = output / f".unfinished-{path.name}"
            try:
                _write_reproducibly(path, unfinished)
                _checked("validate", unfinished)
                os.replace(unfinished, paths[-1])
            finally:
                unfinished.unlink(missing_ok=True)
    if len(paths) != len(PLATFORMS):
        raise BuildError(f"Blender's tool built {len(paths)} zips, expected {len(PLATFORMS)}: {', '.join(PLATFORMS)}")
    return paths


def _checked(*arguments) -> None:
    run = run_tool(*arguments)
    if run.returncode != 0:
        raise BuildError(f"Blender's extension tool refused to {arguments[0]}:\n{run.stdout}{run.stderr}".rstrip())


def _stage(folder: Path, wheels: list[Path]) -> None:
    """Make `folder` the source of the zips: what the manifest takes from this tree, the wheels, a longer manifest."""
    plain = folder.with_name("plain.zip")
    _checked("build", "--source-dir", ROOT, "--output-filepath", plain)
    with zipfile.ZipFile(plain) as archive:
        archive.extractall(folder)
    readme = folder / "README.md"
    readme.write_text(without_dead_links(readme.read_text(encoding="utf-8"), folder), encoding="utf-8")
    (folder / "wheels").mkdir()
    for wheel in wheels:
        if "manylinux" in wheel.name:
            write_symbolic_wheel(wheel, folder / "wheels")
        else:
            shutil.copy(wheel, folder / "wheels")
    manifest = folder / MANIFEST
    names = [f"./wheels/{path.name}" for path in (folder / "wheels").iterdir()]
    manifest.write_text(with_wheels(manifest.read_text(encoding="utf-8"), names), encoding="utf-8")


def without_dead_links(text: str, folder: Path) -> str:
    """Markdown without pictures that are not below `folder`; of other links to what is not there the text stays."""

    def kept(match: re.Match) -> str:
        shows, words, target, end = match.groups()
        if target.startswith(("https://", "#")) or (folder / target).is_file():
            return match[0]
        return "" if shows else words + end

    return re.sub(r"(!?)\[([^\]]*)\]\(([^)]*)\)(\n*)", kept, text)


def with_wheels(manifest: str, wheels: list[str]) -> str:
    """The text of a manifest with the keys `platforms` and `wheels` added before its first table."""
    keys = {"platforms": sorted(PLATFORMS), "wheels": sorted(wheels)}
    lines = "".join("{} = [\n    {},\n]\n".format(key, ",\n    ".join(f'"{item}"' for item in items))
                    for key, items in keys.items())  # fmt: skip
    text, tables = re.subn(r"^(?=\[)", lambda match: lines + "\n", manifest, count=1, flags=re.MULTILINE)
    if not tables:
        text = f"{manifest.rstrip()}\n{lines}"
    if keys.keys() & tomllib.loads(manifest).keys() or tomllib.loads(text) != tomllib.loads(manifest) | keys:
        raise BuildError(f"{MANIFEST}: `platforms` and `wheels` could not be added; expected neither to be there")
    return text


def fetch_wheels(folder: Path) -> list[Path]:
    """The pinned wheels of every platform and Python in `folder`, downloaded where they are not there yet."""
    folder.mkdir(parents=True, exist_ok=True)
    hashes = set(re.findall(r"--hash=sha256:([0-9a-f]{64})", PINS.read_text(encoding="utf-8")))
    found = []
    for platform, tag in PLATFORMS.items():
        for python in PYTHONS:
            path = _pinned(folder, platform, python, hashes)
            if path is None:
                _download(folder, platform, tag, python)
                path = _pinned(folder, platform, python, hashes)
            if path is None:
                raise BuildError(f"{folder}: no wheel for {platform}, cp{python}, is one that {PINS.name} names")
            found.append(path)
    return found


def _pinned(folder: Path, platform: str, python: str, hashes: set[str]) -> Path | None:
    """The wheel of a platform and Python in `folder`, if its content is a pinned one."""
    system, machine = platform.split("-")
    system = {"linux": "manylinux", "macos": "macosx", "windows": "win"}[system]
    machine = {"x64": "amd64" if system == "win" else "x86_64"}.get(machine, machine)
    for path in sorted(folder.glob(f"*-cp{python}-cp{python}-{system}*_{machine}.whl")):
        if hashlib.sha256(path.read_bytes()).hexdigest() in hashes:
            return path
    return None


def _download(folder: Path, platform: str, tag: str, python: str) -> None:
    command = [sys.executable, "-m", "pip", "download", "--quiet", "--no-input", "--disable-pip-version-check"]
    command += ["--retries", "1", "--timeout", "30", "--no-deps", "--only-binary", ":all:", "--require-hashes"]
    command += ["--implementation", "cp", "--python-version", python, "--abi", f"cp{python}", "--platform", tag]
    try:
        run = subprocess.run(
            [*command, "--dest", str(folder), "--requirement", str(PINS)],
            capture_output=True, text=True, timeout=DOWNLOAD_SECONDS, check=False, stdin=subprocess.DEVNULL,
        )  # fmt: skip
        failed, told = run.returncode != 0, (run.stderr or run.stdout).strip()
    except subprocess.TimeoutExpired:
        failed, told = True, f"nothing within {DOWNLOAD_SECONDS} seconds"
    if failed:
        reason = next((line for line in told.splitlines() if line.startswith("ERROR:")), told or "no message")
        raise BuildError(
            f"pip could not download the wheel of OpenEXR for {platform}, Python {python[0]}.{python[1:]}: {reason}\n"
            f"It has to reach a package index once; or put the wheels that {PINS.name} names into {folder}."
        )


def _write_reproducibly(source: Path, target: Path) -> None:
    """Copy a zip with its files in order of name, the manifest first, and without the dates and modes of this tree."""
    with zipfile.ZipFile(source) as old, zipfile.ZipFile(target, "w", compresslevel=9) as new:
        for entry in sorted(old.infolist(), key=lambda entry: (entry.filename != MANIFEST, entry.filename)):
            if entry.is_dir():
                continue
            plain = zipfile.ZipInfo(entry.filename, EARLIEST_ZIP_DATE)
            plain.create_system, plain.external_attr = 3, 0o644 << 16
            new.writestr(plain, old.read(entry), compress_type=entry.compress_type, compresslevel=9)


def main(arguments: list[str]) -> int:
    parser = argparse.ArgumentParser(prog="make extension", description="Build the extension's zips for all platforms.")
    parser.add_argument("--output", type=Path, default=ROOT / "build", metavar="FOLDER", help="default: build")
    options = parser.parse_args(arguments)
    try:
        paths = build(options.output.resolve())
    except (BuildError, OSError, ValueError) as error:
        print(f"make extension: {error}", file=sys.stderr)
        return 1
    for path in paths:
        content = path.read_bytes()
        print(f"{path}  {len(content) / 2**20:.1f} MiB  sha256 {hashlib.sha256(content).hexdigest()}")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
