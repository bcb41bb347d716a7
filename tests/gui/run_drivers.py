"""Runs the drivers of this folder in a real Blender with a window: `make test-gui RUNNER="run-gui --root ROOT"`.

    python tests/gui/run_drivers.py --runner COMMAND [--out DIR] [DRIVER ...]

What the runner must offer is in README.md. Builds the extension's zips and the example scene, runs one driver after
another, and prints what each found; the exit code is 1 where one failed.
"""

import argparse
import ast
import json
import platform
import shlex
import subprocess
import sys
from pathlib import Path

HERE = Path(__file__).resolve().parent
ROOT = HERE.parents[1]
DEFAULTS = {"SIZE": "1280x720", "SECONDS": 300, "INSTALL": True}
SYSTEMS = {"Linux": "linux", "Darwin": "macos", "Windows": "windows"}
MORE_SECONDS = 120  # for what the runner itself does before and after


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--runner", required=True, type=shlex.split, help="command, with options of its own")
    parser.add_argument("--out", type=Path, default=ROOT / "out" / "gui")
    parser.add_argument("--scene", type=Path, help=".blend to open; default: the example scene")
    parser.add_argument("drivers", nargs="*", type=Path, metavar="DRIVER", help="default: all")
    arguments = parser.parse_args()
    drivers = [path.resolve() for path in arguments.drivers] or sorted(HERE.glob("drive_*.py"))
    missing = [str(path) for path in drivers if not path.is_file()]
    if missing or not arguments.runner:
        print(f"run_drivers: {', '.join(missing) or 'no runner'}: no such file, see tests/gui/README.md")
        return 2
    arguments.out.mkdir(parents=True, exist_ok=True)
    archive = built_zip()
    fixed = ["--blend", str(arguments.scene or demo_scene(arguments.out))]
    for name in ("random_surfaces", "surface_scenes", "uploaded_samples"):
        fixed += ["--file", str(HERE.parent / "helpers" / f"{name}.py")]
    fixed += ["--file", str(HERE.parent / "blender" / "helpers" / "blender_state.py")]
    for helper in sorted(set(HERE.glob("*.py")) - set(HERE.glob("drive_*.py")) - {Path(__file__).resolve()}):
        fixed += ["--file", str(helper)]
    failed = [path.stem for path in drivers if not run(arguments.runner, path, archive, fixed, arguments.out)]
    print(f"{len(drivers) - len(failed)} of {len(drivers)} drivers passed; pictures are in {arguments.out}")
    return 1 if failed else 0


def built_zip() -> Path:
    """The zip for this platform, built from this tree."""
    sys.path.insert(0, str(ROOT))
    from requirements import build_extension

    machine = "arm64" if platform.machine().lower() in ("arm64", "aarch64") else "x64"
    ending = f"{SYSTEMS[platform.system()]}_{machine}"
    return next(path for path in build_extension.build(ROOT / "build") if path.stem.endswith(ending))


def demo_scene(folder: Path) -> Path:
    """The example scene."""
    command = [sys.executable, "-m", "ltsh_addon", "demo", "-o", str(folder / "demo"), "--quiet", "--json",
               "--resolution", "480x270", "--techniques", "ltc", "--cycles-samples", "2"]  # fmt: skip
    subprocess.run(command, cwd=ROOT, check=True, stdout=subprocess.DEVNULL)
    return folder / "demo" / "demo.blend"


def options_of(driver: Path) -> dict:
    """SIZE (of the window), SECONDS (until it is ended), INSTALL (the zip before the driver) as its top level says."""
    found = dict(DEFAULTS)
    for node in ast.parse(driver.read_text(encoding="utf-8")).body:
        if isinstance(node, ast.Assign) and getattr(node.targets[0], "id", None) in DEFAULTS:
            found[node.targets[0].id] = ast.literal_eval(node.value)
    return found


def run(runner: list[str], driver: Path, archive: Path, fixed: list[str], pictures: Path) -> bool:
    """Run one driver; True where all that it checked holds."""
    out = pictures / driver.stem
    options = options_of(driver)
    command = [*runner, "--driver", str(driver), *fixed, "--out", str(out), "--size", options["SIZE"]]
    command += ["--timeout", str(options["SECONDS"]), "--install" if options["INSTALL"] else "--file", str(archive)]
    (out / "result.json").unlink(missing_ok=True)
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=options["SECONDS"] + MORE_SECONDS)
        code, said = done.returncode, done.stderr.strip()
    except (OSError, subprocess.TimeoutExpired) as error:
        code, said = 124, str(error)
    try:
        result = json.loads((out / "result.json").read_text(encoding="utf-8"))
    except (OSError, ValueError):
        result = {"failed": [said or f"no result.json in {out}"], "error": None, "facts": {}}
    for name, value in result["facts"].items():
        print(f"  {name}: {value}")
    for line in [*result["failed"], *([result["error"]] if result["error"] else [])]:
        print(f"  FAILED {line}")
    print(f"{driver.stem}: {'passed' if code == 0 else f'exit code {code}'}", flush=True)
    return code == 0


if __name__ == "__main__":
    sys.exit(main())
