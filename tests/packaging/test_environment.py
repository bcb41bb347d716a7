"""The set-up script, tried with small stand-ins for Python and apt-get, and the lock files."""

import json
import re
import shutil
import subprocess
import sys
from importlib.metadata import version
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
LOCKS = sorted((ROOT / "requirements").glob("py*.txt"))
ADDITIONS = [ROOT / "requirements" / name for name in ("blender.txt", "wheels.txt")]


def pins(lock: Path) -> dict[str, str]:
    return dict(re.findall(r"^([a-z0-9-]+)==([^ ;\\]+)", lock.read_text(encoding="utf-8"), flags=re.MULTILINE))


# ---- lock files


@pytest.mark.parametrize("lock", LOCKS + ADDITIONS, ids=lambda path: path.name)
def test_every_pin_has_hashes_and_no_place_of_download(lock):
    text = lock.read_text(encoding="utf-8")
    requirements = re.split(r"\n(?=[a-z0-9])", text)[1:]
    assert len(requirements) == len(pins(lock)) >= (10 if lock in LOCKS else 1)
    bare = [item.splitlines()[0] for item in requirements if not re.search(r"--hash=sha256:[0-9a-f]{64}\b", item)]
    assert not bare, f"without a hash: {bare}"
    # Only names, versions, markers and hashes: an address or a path of some machine would break elsewhere.
    assert not re.search(r"://|^--|find-links|index-url|[ =]/", text, flags=re.MULTILINE)


def test_packages_of_npm_have_hashes_and_no_place_of_download():
    folder = ROOT / "requirements" / "browser"
    packages = json.loads((folder / "package-lock.json").read_text(encoding="utf-8"))["packages"]
    asked = packages.pop("")["dependencies"]
    assert asked == json.loads((folder / "package.json").read_text(encoding="utf-8"))["dependencies"]
    assert len(packages) >= len(asked) and all(item["integrity"].startswith("sha512-") for item in packages.values())
    assert not any("resolved" in item for item in packages.values())


def test_locks_pin_blender_with_the_numpy_of_its_generation_and_the_same_tools():
    older, newer = (pins(ROOT / "requirements" / f"{name}.txt") for name in ("py311", "py313"))
    assert (older["bpy"], newer["bpy"]) == ("4.5.15", "5.2.3")
    assert older["numpy"].startswith("1.26.") and newer["numpy"].startswith("2.")
    assert all(older[name] == newer[name] for name in ("openexr", "pytest", "hypothesis", "ruff"))
    # A real Blender brings its numpy along.
    added = pins(ROOT / "requirements" / "blender.txt")
    assert {"pytest", "hypothesis", "openexr", "scipy"} <= added.keys() and "numpy" not in added
    assert added == {name: older[name] for name in added}


def test_this_interpreter_runs_what_its_lock_says():
    lock = ROOT / "requirements" / f"py{sys.version_info.major}{sys.version_info.minor}.txt"
    if not lock.exists():
        pytest.skip(f"no lock for this Python: {lock.name}")
    wanted = pins(lock)
    names = ("bpy", "numpy", "openexr", "scipy", "pytest", "hypothesis")
    assert {name: version(name) for name in names} == {name: wanted[name] for name in names}


# ---- the set-up script


def write_executable(path: Path, text: str) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text, encoding="utf-8")
    path.chmod(0o755)
    return path


def stand_in(path: Path, python_version: str, able: str = "yes") -> Path:
    """An interpreter that only answers the script's question about itself."""
    return write_executable(path, f'#!/bin/sh\necho "{python_version} {able} {path}"\n')


@pytest.fixture
def setup_script(tmp_path):
    """Runs a copy of the script in a world whose PATH and homes hold what the test puts there."""
    if shutil.which("bash") is None:
        pytest.skip("the set-up script needs bash")
    script, tools = tmp_path / "clone" / "requirements" / "setup.sh", tmp_path / "tools"
    for folder in (script.parent, tools):
        folder.mkdir(parents=True)
    shutil.copy(ROOT / "requirements" / "setup.sh", script)
    # `timeout` is left out on purpose, `getent` tells nothing: this machine's own Pythons stay out of sight.
    for name in "bash sh sed tr awk cut sort id dirname cat mkdir mv rm tail mktemp flock cp cksum".split():
        if found := shutil.which(name):
            (tools / name).symlink_to(found)

    def run(*arguments, path=(), **environment):
        settings = {"HOME": str(tmp_path / "home"), "PATH": ":".join([*map(str, path), str(tools)]), **environment}
        return subprocess.run(
            [shutil.which("bash"), str(script), *arguments],
            env=settings, capture_output=True, text=True, timeout=600, stdin=subprocess.DEVNULL, check=False,
        )  # fmt: skip

    run.clone = tmp_path / "clone"
    return run


@pytest.mark.parametrize("shimmed_home", [True, False], ids=["in home", "behind PATH"])
def test_a_shim_that_refuses_leads_to_the_installation_behind_it(setup_script, tmp_path, shimmed_home):
    root = tmp_path / "home" / ".pyenv" if shimmed_home else tmp_path / "elsewhere"
    shim = write_executable(root / "shims" / "python3.13", "#!/bin/sh\necho 'command not found' >&2\nexit 127\n")
    stand_in(root / "versions" / "3.13.2" / "bin" / "python3.13", "3.13")
    newest = stand_in(root / "versions" / "3.13.10" / "bin" / "python3.13", "3.13")
    run = setup_script("find", "3.13", path=[shim.parent])
    assert (run.stdout.strip(), run.returncode) == (str(newest), 0), run.stderr


def test_an_interpreter_that_can_make_environments_goes_first(setup_script, tmp_path):
    bare = stand_in(tmp_path / "bin" / "python3.13", "3.13", able="no")
    able = stand_in(tmp_path / "uv" / "cpython-3.13.1-linux" / "bin" / "python3.13", "3.13")
    run = setup_script("find", "3.13", path=[bare.parent], UV_PYTHON_INSTALL_DIR=str(tmp_path / "uv"))
    assert run.stdout.strip() == str(able), run.stderr


def test_a_named_interpreter_of_another_version_is_refused(setup_script, tmp_path):
    python = stand_in(tmp_path / "python", "3.12")
    run = setup_script("find", "3.13", LTSH_PYTHON_313=str(python))
    assert run.returncode == 1 and run.stdout == ""
    assert f"LTSH_PYTHON_313 is {python}, which answers '3.12'; expected Python 3.13" in run.stderr


def test_newest_takes_the_older_python_where_the_newer_is_absent(setup_script, tmp_path):
    python = stand_in(tmp_path / "bin" / "python3.11", "3.11")
    run = setup_script("find", "newest", path=[python.parent], LTSH_PYTHON_313="none")
    assert run.stdout.strip() == str(python), run.stderr


def test_without_any_python_the_message_says_what_to_install(setup_script):
    run = setup_script("python", "newest", LTSH_PYTHON_313="none", LTSH_PYTHON_311="none")
    assert run.returncode == 3 and run.stdout == ""
    assert "apt-get install python3 python3-venv" in run.stderr and "LTSH_PYTHON_313=" in run.stderr


# A stand-in that also makes environments: what `pip` and the import of bpy answer is said by files in its world, and
# every call that changes something is written to a log.
MAKER = """#!/bin/sh
case "$*" in
"-c"*import*bpy*)
    if [ -e "{world}/missing" ]; then
        echo "ImportError: libSM.so.6: cannot open shared object file: No such file or directory" >&2
        exit 1
    fi ;;
"-c"*) if [ -e "{world}/no-venv" ]; then able=no; else able=yes; fi; echo "3.13 $able {world}/bin/python3.13" ;;
"-m venv --clear "*) echo venv >>"{world}/log"; rm -rf "$4"; mkdir -p "$4/bin"; cp "$0" "$4/bin/python" ;;
"-m pip install "*) echo "pip $*" >>"{world}/log"; [ ! -e "{world}/offline" ] ;;
"- "*) cksum "$2" ;;
*) echo "unexpected: $*" >&2; exit 99 ;;
esac
"""


@pytest.fixture
def world(setup_script, tmp_path):
    """A machine with one Python 3.13; `world.make()` asks for its environment."""

    class World:
        folder = tmp_path
        environment = setup_script.clone / ".venv" / "py313"
        lock = setup_script.clone / "requirements" / "py313.txt"

        def make(self):
            python = tmp_path / "bin" / "python3.13"
            return setup_script("python", "3.13", path=[python.parent], LTSH_PYTHON_313=str(python))

        def log(self) -> list[str]:
            path = tmp_path / "log"
            return [line.split()[0] for line in path.read_text(encoding="utf-8").splitlines()] if path.exists() else []

        def command(self, name: str, text: str) -> None:
            write_executable(tmp_path / "bin" / name, "#!/bin/sh\n" + text)

    write_executable(tmp_path / "bin" / "python3.13", MAKER.format(world=tmp_path))
    World.lock.write_text("bpy==5.2.3\n", encoding="utf-8")
    return World()


def test_an_environment_is_made_once_from_the_lock_with_hashes_and_again_from_a_changed_one(world):
    runs = [world.make(), world.make()]
    assert [run.stdout.strip() for run in runs] == [str(world.environment / "bin" / "python")] * 2, runs[0].stderr
    assert world.log() == ["venv", "pip"]
    assert f"--require-hashes -r {world.lock}" in (world.folder / "log").read_text(encoding="utf-8")
    world.lock.write_text("bpy==5.2.4\n", encoding="utf-8")
    assert world.make().returncode == 0 and world.log() == ["venv", "pip"] * 2


def test_an_interrupted_installation_is_never_taken_for_a_finished_one(world):
    (world.folder / "offline").touch()
    first = world.make()
    assert first.returncode == 1 and first.stdout == "" and "could not install requirements/py313.txt" in first.stderr
    (world.folder / "offline").unlink()
    assert world.make().returncode == 0
    assert world.log() == ["venv", "pip"] * 2


def test_missing_libraries_are_installed_where_the_user_is_root(world):
    (world.folder / "missing").touch()
    world.command("id", "echo 0")
    install = f'case "$*" in *libsm6*) rm "{world.folder}/missing" ;; esac'
    world.command("apt-get", f'echo "apt $*" >>"{world.folder}/log"\n{install}')
    run = world.make()
    assert run.returncode == 0, run.stderr
    assert world.log() == ["venv", "pip", "apt", "apt"]


@pytest.mark.parametrize(
    ("lack", "complaints"),
    [
        ("missing", ["libSM.so.6", "sudo apt-get update && sudo apt-get install -y --no-install-recommends libx11-6"]),
        ("no-venv", ["python3.13-venv"]),
    ],
)
def test_what_is_missing_stops_another_user_with_the_line_to_type(world, lack, complaints):
    (world.folder / lack).touch()
    world.command("id", "echo 1000")
    world.command("apt-get", "exit 99")
    run = world.make()
    assert (run.returncode, run.stdout) == (1, "") and all(complaint in run.stderr for complaint in complaints)
    assert not (world.environment / "ltsh-stamp").exists()


def test_without_node_the_browser_stops_with_the_line_to_type(world, setup_script):
    world.command("id", "echo 1000")
    world.command("apt-get", "exit 99")
    run = setup_script("browser", path=[world.folder / "bin"])
    assert (run.returncode, run.stdout) == (1, "")
    assert "sudo apt-get update && sudo apt-get install -y --no-install-recommends nodejs npm" in run.stderr
