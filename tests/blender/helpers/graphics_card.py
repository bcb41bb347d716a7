"""Run a function where the graphics card may be used, and read what it drew: a script without a window has no context
before Blender 5.2, but a final render of an engine that asks for one has."""

from __future__ import annotations

import bpy
import gpu
import numpy as np
import pytest

# For tests that read a scene by operators or the depsgraph while they draw.
edits_with_graphics = pytest.mark.skipif(
    bpy.app.version < (5, 2, 0), reason="before 5.2 only renders may use graphics, and not edit scenes"
)


def with_graphics(function):
    """What `function()` returns; skips the test on a machine without OpenGL."""
    if hasattr(gpu, "init"):
        try:
            gpu.init()
        except (RuntimeError, SystemError) as error:
            pytest.skip(f"Blender finds no graphics here: {error}")
        return function()
    return _inside_render(function)


def _inside_render(function):
    outcome = {}

    class Engine(bpy.types.RenderEngine):
        bl_idname, bl_label, bl_use_gpu_context = "TEST_GRAPHICS", "Graphics", True

        def render(self, depsgraph):
            # What is raised in here would only be printed.
            try:
                outcome["value"] = function()
            except BaseException as error:
                outcome["error"] = error

    bpy.ops.wm.read_factory_settings(use_empty=True)
    scene = bpy.context.scene
    scene.camera = bpy.data.objects.new("Camera", bpy.data.cameras.new("Camera"))
    scene.collection.objects.link(scene.camera)
    scene.render.resolution_x = scene.render.resolution_y = 8
    bpy.utils.register_class(Engine)
    try:
        scene.render.engine = Engine.bl_idname
        bpy.ops.render.render()
    finally:
        # bpy 4.5 hangs at its end while such a class is registered.
        bpy.utils.unregister_class(Engine)
    if "error" in outcome:
        raise outcome["error"]
    return outcome["value"]


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
