"""Fixtures of several tests that start Blender."""

import tempfile

import pytest


@pytest.fixture
def temporary_root(tmp_path, monkeypatch):
    """The folder in which temporary folders are made, to see what is left behind."""
    folder = tmp_path / "temporary"
    folder.mkdir()
    monkeypatch.setenv("TMPDIR", str(folder))
    monkeypatch.setattr(tempfile, "tempdir", None)
    return folder
