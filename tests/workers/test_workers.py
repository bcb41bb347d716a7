"""Worker processes of `shade`: the same bits, no orphans, and the work goes on where they fail."""

import subprocess
import sys
import threading
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from kills import all_ended, is_running
from precisions import techniques_and_types
from surface_scenes import area_light, four_lights, random_samples

from ltsh_addon import shading
from ltsh_addon.scene import Cancelled, EllipseLight, PolygonLight
from ltsh_addon.shading import float32, float64, integrator
from ltsh_addon.workers import pool

ROOT = Path(__file__).resolve().parents[2]
pytestmark = pytest.mark.usefixtures("short_tasks_for_children")


@techniques_and_types
def test_workers_do_not_change_one_bit(technique, dtype, started, children_only):
    """All blocks come from children, against all blocks from this process."""
    samples = replace(random_samples(90, seed=6), bump_alpha2=np.full(90, 0.1))
    one = shading.shade(samples, four_lights(), technique, workers=1, dtype=dtype)
    assert not started
    three = shading.shade(samples, four_lights(), technique, workers=3, dtype=dtype)
    assert len(started) == 2 and all_ended(started)
    for name in ("specular", "diffuse", "quadrature_error"):
        found, expected = getattr(three, name), getattr(one, name)
        assert (found is None) == (expected is None)
        assert found is None or (found.dtype == expected.dtype and np.array_equal(found, expected)), name


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_workers_use_the_matrix_of_this_process(dtype, started, children_only):
    """The moment weights come from LAPACK, whose last bits may differ between processes: here by much more."""
    table = replace(shading.load_table("ltsh4"))
    table.__dict__["ridge_weights"] = 1.01 * table.ridge_weights
    samples = random_samples(40, seed=9)
    one = shading.shade(samples, four_lights(), table, passes=["specular"], workers=1, dtype=dtype)
    three = shading.shade(samples, four_lights(), table, passes=["specular"], workers=3, dtype=dtype)
    assert len(started) == 2 and np.array_equal(one.specular, three.specular)
    plain = shading.shade(samples, four_lights(), "ltsh4", passes=["specular"], workers=1, dtype=dtype)
    assert not np.array_equal(one.specular, plain.specular)


def test_pairs_that_single_precision_leaves_to_double_keep_their_light(started, children_only, monkeypatch):
    """Lights of 1 m by 10 um, in two rows, of several kinds, and one not for all; some lobes are sharp. Against double
    precision for all, against children, and in chunks of few pairs."""
    generator = np.random.default_rng(5)
    samples = random_samples(300, seed=11, lowest_roughness=0.02)
    samples = replace(samples, receiver=np.arange(300) % 2, bump_alpha2=np.full(300, 0.1))
    narrow = {"half_u": (0.5, 0, 0), "half_v": (0, -5e-6, 0)}
    centers = np.append(generator.uniform(-0.5, 0.5, (4, 2)), np.full((4, 1), 1.5), axis=1)
    lights = [area_light(center=center, **narrow) for center in centers]
    lights[1] = replace(lights[1], receivers=(1,))
    lights[2] = EllipseLight.like(lights[2])
    # A polygon, for of a rectangle with a falloff single precision takes points.
    lights[3] = PolygonLight.like(lights[3], corners=lights[3].polygon(), falloff=1)
    rows, asked, original = (0, 1, 0, 0), [], float64.shade_pairs

    def counted(samples, members, *others):
        asked.append(len(members))
        return original(samples, members, *others)

    monkeypatch.setattr(float64, "shade_pairs", counted)
    one = shading.shade(samples, lights, "ltsh4", workers=1, rows=rows)
    assert sum(asked) > 200
    three = shading.shade(samples, lights, "ltsh4", workers=3, rows=rows)
    monkeypatch.setattr(float32, "FLOAT64_CHUNK", 5)
    at_once = shading.shade(samples, lights, "ltsh4", workers=1, rows=rows)
    double = shading.shade(samples, lights, "ltsh4", workers=1, dtype=np.float64, rows=rows)
    assert len(started) == 2
    for name in shading.PASSES:
        found, expected = getattr(one, name), getattr(double, name)
        assert np.abs(found - expected).max() < 1e-6 * expected.max() and (expected.max(axis=(1, 2)) > 0.0).all()
        assert np.array_equal(found, getattr(three, name))
        assert np.abs(found - getattr(at_once, name)).max() < 1e-6 * expected.max()


def test_tasks_are_packed_by_the_thread_that_changes_them(started, children_only, monkeypatch):
    """It keeps more in them while it shades: a child's thread that packs one meanwhile may find it changed."""
    threads = []

    def state(task):
        threads.append(threading.current_thread())
        return vars(task)

    monkeypatch.setattr(integrator.Task, "__getstate__", state, raising=False)
    shading.shade(random_samples(90, seed=6), four_lights(), "ltc", workers=3)
    assert len(started) == 2 and threads == [threading.main_thread()]


def test_progress_is_reported_from_this_thread_and_reaches_one(started):
    seen, threads = [], set()

    def progress(share):
        seen.append(share)
        threads.add(threading.current_thread())

    shading.shade(random_samples(200, seed=1), four_lights(), "ltc", workers=2, progress=progress)
    assert seen == sorted(seen) and seen[-1] == 1.0 and len(seen) > 2
    assert threads == {threading.main_thread()}


def fail(_):
    raise RuntimeError("window closed")


@pytest.mark.parametrize(("progress", "error"), [(lambda _: False, Cancelled), (fail, RuntimeError)])
def test_cancelling_and_errors_end_the_children(progress, error, started, children_only, caplog):
    start = time.monotonic()
    with pytest.raises(error):
        shading.shade(random_samples(400), four_lights(), shading.REFERENCE, workers=3, progress=progress)
    assert len(started) == 2 and all_ended(started)
    assert time.monotonic() - start < 30.0 and not caplog.records


def test_a_child_that_dies_costs_nothing_but_time(started, children_only, caplog):
    """The processes are killed as soon as some blocks are done; this one takes over."""
    samples = random_samples(300, seed=2)

    def kill(share):
        if share > 0.0:
            for process in started:
                process.kill()

    expected = shading.shade(samples, four_lights(), "ltc", workers=1)
    found = shading.shade(samples, four_lights(), "ltc", workers=2, progress=kill)
    assert np.array_equal(found.combined, expected.combined)
    assert "worker process ended early" in caplog.text


@pytest.mark.parametrize("python", ["/no/such/python3", ""])
def test_without_an_interpreter_this_process_does_it_all(python, monkeypatch, caplog):
    samples = random_samples(60, seed=3)
    expected = shading.shade(samples, four_lights(), "ltc", workers=1)
    monkeypatch.setattr(sys, "executable", python)
    found = shading.shade(samples, four_lights(), "ltc", workers=2)
    assert np.array_equal(found.combined, expected.combined)
    assert ("cannot be started" in caplog.text) == bool(python)


@pytest.mark.parametrize(("path", "found"), [("/a/python3.13", True), ("/b/blender", False), ("", False)])
def test_only_a_python_runs_children(path, found, monkeypatch):
    monkeypatch.setattr(sys, "executable", path)
    assert pool.interpreter() == (path if found else None)


def test_few_samples_stay_in_this_process(monkeypatch, started):
    monkeypatch.setattr(integrator, "SECONDS_WORTH_A_WORKER", 0.5)
    shading.shade(random_samples(1000), four_lights(), "ltsh4", workers=8)
    assert not started


PARENT = """
import sys, time
sys.path[:0] = [{root!r}, {tests!r}]
from surface_scenes import area_light, four_lights, random_samples
from ltsh_addon import shading
from ltsh_addon.shading import integrator
from ltsh_addon.workers import pool
integrator.SECONDS_WORTH_A_WORKER = 0.0
integrator.REFERENCE_BLOCK_LIMITS = (8, 8)
original = pool.subprocess.Popen
def popen(*arguments, **options):
    process = original(*arguments, **options)
    print(process.pid, flush=True)
    return process
pool.subprocess.Popen = popen
shading.shade(random_samples(100000), four_lights(), "reference", workers=2)
"""


@pytest.mark.skipif(sys.platform == "win32", reason="signals")
def test_children_of_a_killed_parent_end():
    code = PARENT.format(root=str(ROOT), tests=str(ROOT / "tests" / "helpers"))
    parent = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True)
    with parent:
        child = int(parent.stdout.readline())
        time.sleep(1.0)
        assert is_running(child)
        parent.kill()
    deadline = time.monotonic() + 20.0
    while is_running(child) and time.monotonic() < deadline:
        time.sleep(0.05)
    assert not is_running(child)


RENAMED = """
import importlib, sys, types
for name in ("bl_ext", "bl_ext.user_default", "bl_ext.user_default.ltsh"):
    sys.modules[name] = types.ModuleType(name)
    sys.modules[name].__path__ = []
sys.modules["bl_ext.user_default.ltsh"].__path__ = [{root!r}]
sys.path[:] = [entry for entry in sys.path if entry not in ("", {root!r})]
package = "bl_ext.user_default.ltsh.ltsh_addon."
shading, scene, pool, integrator = (
    importlib.import_module(package + name) for name in ("shading", "scene", "workers.pool", "shading.integrator")
)
import numpy as np
integrator.SECONDS_WORTH_A_WORKER = 0.0
integrator.BLOCK_LIMITS = (8, 8)
by_children = []
finish = pool._Run.finish
def counted(self, *arguments):
    import threading
    by_children.append(threading.current_thread() is not threading.main_thread())
    finish(self, *arguments)
pool._Run.finish = counted
up, white = np.tile([0.0, 0.0, 1.0], (64, 1)), np.ones((64, 3))
position = np.random.default_rng(1).uniform(-1.0, 1.0, (64, 3)) * [1.0, 1.0, 0.0]
samples = scene.SurfaceSamples(position, up, up, up, np.full(64, 0.4), white, white, np.zeros(64), np.ones(64), white)
light = scene.QuadLight("Lamp", (0, 0, 2), (1, 0, 0), (0, -1, 0), (0, 0, -1), (1, 1, 1))
import time
def leave_some(fraction):
    limit = time.monotonic() + 60.0
    while not any(by_children) and time.monotonic() < limit:
        time.sleep(0.01)
one = shading.shade(samples, [light], "ltsh4", workers=1).combined
by_children.clear()
two = shading.shade(samples, [light], "ltsh4", workers=2, progress=leave_some).combined
visibility, ratio, processes = (importlib.import_module(package + name) for name in (
    "visibility", "visibility.ratio", "blender.process.blender_process"))
mesh = visibility.OccluderMesh(np.array([(0, -9, 1), (9, -9, 1), (9, 9, 1)]), np.array([(0, 1, 2)]))
occluders = visibility.Occluders((mesh,), np.zeros(1, int), np.eye(4)[None, :3])
ratio.SECONDS_WORTH_A_WORKER, ratio.BLOCK_SAMPLES, shaded_by_children = -1.0, 8, any(by_children)
with visibility.open_tracer(occluders, processes.embree_libraries()) as tracer:
    single = ratio.trace_visibility(samples, [light], tracer, workers=1).diffuse
    by_children.clear()
    leave = lambda stage, fraction: leave_some(fraction)
    double = ratio.trace_visibility(samples, [light], tracer, workers=2, progress=leave).diffuse
same = np.array_equal(one, two) and np.array_equal(single, double)
print(same, shaded_by_children and any(by_children), "ltsh_addon" in sys.modules)
"""


def test_children_work_for_the_package_as_blender_loads_it():
    run = subprocess.run(
        [sys.executable, "-W", "error", "-c", RENAMED.format(root=str(ROOT))],
        capture_output=True, text=True, timeout=600, check=False, cwd=Path(__file__).parent,
    )  # fmt: skip
    assert run.stdout.split() == ["True", "True", "False"], run.stderr
