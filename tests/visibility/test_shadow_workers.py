"""Processes that trace shadow rays: the same bytes for any number, and for those that fail."""

import logging
import os

import numpy as np
import pytest
from known_tracers import floor, panel
from occluder_scenes import sphere

from ltsh_addon.blender.process.blender_process import embree_libraries
from ltsh_addon.scene import PASSES, Cancelled
from ltsh_addon.visibility import OccluderMesh, Occluders, open_tracer, ratio
from ltsh_addon.workers import pool, worker


@pytest.fixture
def scene(monkeypatch):
    """A ball above the floor in blocks of at most 200 samples, and the processes that were started."""
    monkeypatch.setattr(ratio, "BLOCK_SAMPLES", 200)
    monkeypatch.setattr(ratio, "SECONDS_WORTH_A_WORKER", -1.0)
    started, popen = [], pool.subprocess.Popen

    def counted(arguments, **options):
        process = popen(arguments, **options)
        if worker.__file__ in arguments:  # numpy's tests start programs, too
            started.append(process)
        return process

    monkeypatch.setattr(pool.subprocess, "Popen", counted)
    vertices, triangles = sphere(12)
    mesh = OccluderMesh(0.5 * vertices + [0.0, 1.0, 0.7], triangles)
    with open_tracer(Occluders((mesh,), [0], [np.eye(3, 4)]), list(embree_libraries())) as tracer:
        samples, film = floor(40)

        def shares(**options):
            return ratio.trace_visibility(
                samples, [panel()], tracer, ratio.ShadowSampling(rays=32, film=film), **options
            )

        yield shares, started, tracer


def test_any_number_of_processes_gives_the_same_bytes(scene, monkeypatch):
    shares, started, _ = scene
    alone = shares(workers=1)
    assert not started and 0.1 < alone.mixed.mean() < 0.9
    # This process leaves most to the children.
    by, finish = [], pool._Run.finish
    monkeypatch.setattr(pool._Run, "finish", lambda *arguments: (by.append(arguments[1]), finish(*arguments)))
    for workers in (2, 3):
        found = shares(workers=workers)
        for name in PASSES:
            np.testing.assert_array_equal(getattr(found, name), getattr(alone, name))
            assert found.noise(name) == alone.noise(name)
        assert found.rays == alone.rays
    assert len(started) == 3 and all(process.poll() is not None for process in started)
    # 1600 samples in squares of 14 x 14.
    assert sorted(by) == sorted(2 * list(range(9)))


def test_a_pool_that_stays_gives_the_same_bytes(scene):
    shares, started, tracer = scene
    alone = shares(workers=1)
    own = os.getpriority(os.PRIO_PROCESS, 0) if hasattr(os, "setpriority") else None
    with pool.WorkerPool(tracer, 2, background=True) as both:
        for number in range(3):
            if number == 2:
                # What has begun is not waited for, and is not taken for a result later on.
                with pytest.raises(Cancelled):
                    shares(workers=both, progress=lambda stage, share: share < 0.5)
                with pytest.raises(Cancelled):
                    ratio.trace_ray_origins(floor(40)[0], both, lambda stage, share: share < 0.5)
            # Where rays start may be known, from the same processes.
            origins = None if number == 0 else ratio.trace_ray_origins(floor(40)[0], both)
            found = shares(workers=both, ray_origins=origins)
            for name in PASSES:
                np.testing.assert_array_equal(getattr(found, name), getattr(alone, name))
            assert found.rays == alone.rays
        assert len(started) == 1 and started[0].poll() is None
        if own is not None:
            assert os.getpriority(os.PRIO_PROCESS, started[0].pid) == min(own + pool.NICENESS, 19)
        started[0].kill()
        started[0].wait()
        np.testing.assert_array_equal(shares(workers=both).diffuse, alone.diffuse)
    assert len(started) == 1


def test_what_a_child_does_not_do_is_done_here(scene, monkeypatch, caplog):
    shares, started, _ = scene
    alone = shares(workers=1)
    monkeypatch.setattr(pool, "interpreter", lambda: "/bin/false")
    with caplog.at_level(logging.WARNING):
        found = shares(workers=2)
    assert len(started) == 1 and "worker process ended early" in caplog.text
    np.testing.assert_array_equal(found.specular, alone.specular)


def test_a_stop_leaves_no_process(scene):
    shares, started, _ = scene
    with pytest.raises(Cancelled):
        shares(workers=2, progress=lambda stage, share: share < 0.2)
    assert started and all(process.poll() is not None for process in started)
