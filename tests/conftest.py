"""Settings of the whole suite; nothing here imports bpy, so that tests of the core stay free of it."""

import atexit
import os
import platform
import signal
import subprocess
import sys
import threading
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

import pytest
from hypothesis import settings

settings.register_profile("ltsh", derandomize=True, deadline=None, database=None)
settings.load_profile("ltsh")

# Of llvmpipe, which draws where no graphics card is: pictures here are so small that its optimizer takes longer than
# what it saves.
os.environ.setdefault("GALLIVM_PERF", "nopt")

EXIT_STATUS = pytest.StashKey[int]()
TESTS = Path(__file__).parent
# Files that need no bpy, of what may depend on the versions of Python and numpy: `make test` runs them on both.
SMOKE = {
    "cli/test_cli_arguments.py", "imaging/test_exr.py", "packaging/test_environment.py", "pipeline/test_compare.py",
    "pipeline/test_jobs.py", "shading/test_single_precision.py", "scene/test_scene.py",
}  # fmt: skip

# Files in tests/blender of what no version of Blender changes, how processes end and what files they leave: marked
# `newest`, as are single tests of formulas that stand in one text for all versions.
NEWEST = {
    "blender/process/test_signals.py",
    "blender/ui/test_job_ends.py",
    "blender/pipeline/test_bake_disk.py",
    "blender/pipeline/test_job_runs.py",
    "blender/pipeline/test_picture_kills.py",
}


def pytest_sessionstart(session):
    """Shells start what runs in the background with Ctrl-C ignored, and children inherit that."""
    if signal.getsignal(signal.SIGINT) == signal.SIG_IGN:
        signal.signal(signal.SIGINT, signal.default_int_handler)


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items):
    """Marks by place, before `-m` looks at them."""
    for item in items:
        path = item.path.relative_to(TESTS).as_posix()
        if path.startswith("blender/"):
            item.add_marker("blender")
            if path in NEWEST:
                item.add_marker("newest")
        elif path in SMOKE:
            item.add_marker("smoke")


def pytest_report_header():
    """The line that tells two runs of `make test` apart."""
    names = []
    for name in ("bpy", "numpy", "OpenEXR", "scipy"):
        try:
            names.append(f"{name} {version(name)}")
        except PackageNotFoundError:
            names.append(f"no {name}")
    return f"LTSH: Python {platform.python_version()}, {', '.join(names)}"


def pytest_sessionfinish(session, exitstatus):
    """Keep the exit code for the end of the run."""
    session.config.stash[EXIT_STATUS] = int(exitstatus)


@pytest.hookimpl(trylast=True)
def pytest_unconfigure(config):
    """End without the C library's exit where bpy is loaded: bpy 4.5 now and then never comes back from it."""
    if "bpy" in sys.modules and EXIT_STATUS in config.stash:
        atexit._run_exitfuncs()  # pytest removes old temporary folders there
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(config.stash[EXIT_STATUS])


@pytest.fixture
def child(monkeypatch):
    """In place of the second Blender one that is none."""
    import fake_scene

    return fake_scene.FakeChild().install(monkeypatch)


@pytest.fixture
def out(tmp_path):
    """An output folder that is not there yet."""
    return tmp_path / "out"


@pytest.fixture
def room(tmp_path):
    """A file that looks like a .blend, for those who never open it."""
    path = tmp_path / "room.blend"
    path.write_bytes(b"BLENDER")
    return path


@pytest.fixture
def short_tasks_for_children(monkeypatch):
    """Children start for any task; blocks are small."""
    from ltsh_addon.shading import integrator

    monkeypatch.setattr(integrator, "SECONDS_WORTH_A_WORKER", 0.0)
    for name in ("BLOCK_LIMITS", "REFERENCE_BLOCK_LIMITS"):
        monkeypatch.setattr(integrator, name, (17, 17))


@pytest.fixture
def started(monkeypatch):
    """The child processes that were started."""
    from ltsh_addon.workers import pool

    found = []
    original = subprocess.Popen

    def popen(*arguments, **options):
        found.append(original(*arguments, **options))
        return found[-1]

    monkeypatch.setattr(pool.subprocess, "Popen", popen)
    return found


@pytest.fixture
def children_only(monkeypatch, started):
    """This process takes no block as long as a child that was started lives."""
    from ltsh_addon.workers import pool

    original = pool._Run.next

    def patient(self):
        here = threading.current_thread() is threading.main_thread()
        return None if here and any(process.poll() is None for process in started) else original(self)

    monkeypatch.setattr(pool._Run, "next", patient)
