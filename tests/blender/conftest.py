"""Fixtures of several tests that start Blender."""

import tempfile

import pytest
import scene_parts as parts

import ltsh_addon


@pytest.fixture
def addon():
    """The add-on in a factory-empty Blender, whose scene is given."""
    scene = parts.empty_scene()
    ltsh_addon.register()
    yield scene
    ltsh_addon.unregister()


@pytest.fixture
def temporary_root(tmp_path, monkeypatch):
    """The folder in which temporary folders are made, to see what is left behind."""
    folder = tmp_path / "temporary"
    folder.mkdir()
    monkeypatch.setenv("TMPDIR", str(folder))
    monkeypatch.setattr(tempfile, "tempdir", None)
    return folder
