"""Run a function where the graphics card may be used, and read what it drew: a script without a window has no context
before Blender 5.2, but a final render of an engine that asks for one has."""

from __future__ import annotations

import bpy
import gpu
import numpy as np
import pytest

from ltsh_addon.blender.viewport import still
from ltsh_addon.scene import SceneError

# For tests that read a scene by operators or the depsgraph while they draw.
edits_with_graphics = pytest.mark.skipif(
    bpy.app.version < (5, 2, 0), reason="before 5.2 only renders may use graphics, and not edit scenes"
)


def with_graphics(function):
    """What `function()` returns; skips the test on a machine without OpenGL."""
    try:
        return still.with_graphics(function)
    except SceneError as error:
        if hasattr(gpu, "init"):
            pytest.skip(f"Blender finds no graphics here: {error}")
        raise


class Canvas:
    """A picture of floats to draw into."""

    def __init__(self, width: int, height: int):
        self.texture = gpu.types.GPUTexture((width, height), format="RGBA32F")
        self.buffer = gpu.types.GPUFrameBuffer(color_slots=[self.texture])

    def fill(self, value: float) -> None:
        """Give all channels this value."""
        self.texture.clear(format="FLOAT", value=(value,) * 4)

    def read(self) -> np.ndarray:
        """The picture (H, W, 4), row 0 at the bottom."""
        values = self.texture.read()
        values.dimensions = self.texture.width * self.texture.height * 4
        return np.array(values, np.float32).reshape(self.texture.height, self.texture.width, 4).astype(np.float64)
