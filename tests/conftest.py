"""Settings of the whole suite; nothing here imports bpy, so that tests of the core stay free of it."""

import atexit
import os
import platform
import shutil
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
# Of tests that look at many cases by Cycles, those that older versions of Blender run: each node, kind of light or way
# of reading once. The others differ in numbers alone, and are marked `newest` as well.
CASES_OF_OLDER = {
    "test_a_material_is_shaded_as_cycles_does": {
        "dielectric, specular level and IOR", "IOR by texture", "metal, multiple scattering", "half metal, bump",
        "metallic node", "conductor", "textures", "coat over bumps", "glossy, multiple scattering",
        "anisotropic dielectric", "anisotropic metal", "diffuse", "diffuse roughness", "rough diffuse node", "sheen",
        "sheen node", "translucent",
    },
    "test_an_approximated_material_is_named_and_near": {"glass", "transmission", "subsurface", "Ashikhmin"},
    "test_a_finished_picture_is_what_cycles_renders": {
        "one bounce", "toon and alpha", "transparent film", "displacement",
    },
    "test_point_spot_and_sun_are_those_of_cycles": {
        "point, not normalized, exposure, color", "point, soft falloff, temperature", "scaled spot", "sun",
    },
    "test_nodes_of_points_are_those_of_cycles": {"falloff-POINT", "stripes-SPOT", "lamp_of_files-SUN"},
    "test_patterns_go_with_the_radius_as_in_cycles": {"by_place-0.2"},
    "test_random_scenes_with_all_kinds_of_lights_are_those_of_cycles": {"0"},
    "test_what_nodes_of_lights_read_is_what_cycles_gives_them": {"spot", "area", "mesh"},
    "test_an_image_on_a_light_is_that_of_cycles": {"mirrored ellipse", "rectangle with a spread"},
    "test_a_world_lights_as_in_cycles": {
        "equirectangular", "sky with a sun", "Hosek and Wilkie", "Preetham", "seen otherwise by the camera",
    },
    "test_what_blocks_a_world_blocks_it_as_in_cycles": {"sky with a sun"},
    "test_a_mesh_lights_as_in_cycles": {"plane, back down", "concave polygon", "mirrored and stretched ball"},
    "test_a_metal_plane_is_shaded_as_the_integral_over_the_light_says": {"point"},
    "test_points_spread_over_texels_give_the_mean_that_cycles_bakes": {"mapped tiles"},
    "test_texels_are_what_pixels_are": {"sheen_on_coat", "mix", "colors_under_alpha"},
    "test_the_picture_is_that_of_a_plain_render": {"perspective", "orthographic", "tall pixels", "cropped at 50 %"},
    "test_lobes_end_where_those_of_cycles_do": {"bumps-0.2-sides1-0.0", "coarse-0.9-sides3-0.0"},
    "test_both_horizons_of_a_crease_count_as_much_as_in_cycles": {"metal-2", "dielectric-0"},
    "test_a_surface_hides_itself_as_in_cycles": {"ball", "monkey of great offset", "instance of a monkey"},
    "test_a_pane_shows_the_floor_behind_it_as_in_cycles": {"Principled", "Mix"},
    "test_the_render_region_is_a_part_of_the_whole_picture": {"False"},
    "test_a_final_picture_is_the_sum_of_its_lights_and_the_rest": {"settings0", "settings3"},
    "test_the_session_and_the_file_stay_as_they_are": {"compare", "cancelled in Cycles", "an exception in the middle"},
    "test_scripts_in_a_file_run_only_when_asked_for": {"False-shade", "True-bake"},
}  # fmt: skip


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
            test, _, case = item.name.partition("[")
            if path in NEWEST or (test in CASES_OF_OLDER and case[:-1] not in CASES_OF_OLDER[test]):
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


@pytest.fixture(scope="session")
def chromium():
    """A running browser, see tests/helpers/browser.py. It is made where node and npm are there."""
    import browser

    if browser.missing() and not (shutil.which("node") and shutil.which("npm")):
        pytest.skip("no browser: node and npm are not there (`make test-page` installs them where it may)")
    subprocess.run(
        ["bash", TESTS.parent / "requirements" / "setup.sh", "browser"], stdout=subprocess.DEVNULL, check=True
    )
    with browser.Browser() as running:
        yield running


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
