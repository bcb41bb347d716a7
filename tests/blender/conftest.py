"""Fixtures of several tests that start Blender."""

import sys
import tempfile

import pytest
import scene_parts as parts

import ltsh_addon
from ltsh_addon.blender.process import blender_process
from ltsh_addon.scene import SceneError


@pytest.fixture(scope="session", autouse=True)
def shared_blender(tmp_path_factory):
    """One second Blender does the jobs of all tests but those that take `own_blender`.

    It goes on after a scene that it could not do, which saves its start.
    """
    with blender_process.shared_blender(tmp_path_factory.mktemp("blender")):
        process = blender_process._shared.get()
        end, process.end = process.end, lambda: isinstance(sys.exc_info()[1], SceneError) or end()
        yield
        process.end = end


@pytest.fixture
def own_blender():
    """Jobs start a Blender of their own, as for users; no other one runs meanwhile."""
    blender_process._shared.get().end()
    token = blender_process._shared.set(None)
    yield
    blender_process._shared.reset(token)


@pytest.fixture
def addon():
    """The add-on in a factory-empty Blender, whose scene is given."""
    scene = parts.empty_scene()
    ltsh_addon.register()
    yield scene
    ltsh_addon.unregister()


@pytest.fixture
def temporary_root(tmp_path, monkeypatch, own_blender):
    """The folder in which temporary folders are made, to see what is left behind."""
    folder = tmp_path / "temporary"
    folder.mkdir()
    monkeypatch.setenv("TMPDIR", str(folder))
    monkeypatch.setattr(tempfile, "tempdir", None)
    return folder
