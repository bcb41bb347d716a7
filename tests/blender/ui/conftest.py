"""Fixtures of several tests of the interface."""

import pytest
from job_window import add_on_in_room

from ltsh_addon.blender.ui import operators


@pytest.fixture
def scene(tmp_path):
    """The add-on and a saved file that can be shaded."""
    with add_on_in_room(tmp_path / "room.blend") as found:
        yield found
        operators._running["job"] = None
