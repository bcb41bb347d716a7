"""What a render of the scene sees, collected from the render depsgraph (runs in the child).

Blender hands the depsgraph that final renders use (hide_render, render-only modifiers and instances) to render engines
and to nobody else, so a render engine that renders nothing takes the inventory.
"""

from __future__ import annotations

from collections.abc import Callable

import bpy

SURFACE_TYPES = ("MESH", "CURVE", "SURFACE", "FONT", "META", "CURVES", "POINTCLOUD")


class _InventoryEngine(bpy.types.RenderEngine):
    bl_idname = "LTSH_INVENTORY"
    bl_label = "LTSH inventory"
    visit: Callable | None = None
    outcome: list = []

    def render(self, depsgraph):
        # An exception here would be printed and swallowed by Blender: hand it over instead.
        try:
            _InventoryEngine.outcome.append((_InventoryEngine.visit(depsgraph), None))
        except Exception as error:
            _InventoryEngine.outcome.append((None, error))


def with_render_depsgraph(scene, visit: Callable):
    """The result of `visit(depsgraph)`, called with the depsgraph of a final render of `scene`."""
    engine, filepath = scene.render.engine, scene.render.filepath
    _InventoryEngine.visit, _InventoryEngine.outcome = visit, []
    bpy.utils.register_class(_InventoryEngine)
    try:
        scene.render.engine = _InventoryEngine.bl_idname
        bpy.ops.render.render(scene=scene.name)
    finally:
        scene.render.engine, scene.render.filepath = engine, filepath
        # Blender 4.5 hangs at exit when an engine is still registered.
        bpy.utils.unregister_class(_InventoryEngine)
        _InventoryEngine.visit = None
    if not _InventoryEngine.outcome:
        raise RuntimeError(f"scene {scene.name!r}: Blender did not evaluate it for rendering, expected one view layer")
    value, error = _InventoryEngine.outcome[0]
    if error is not None:
        raise error
    return value


def rendered_surfaces(depsgraph) -> list:
    """Evaluated objects with a surface, instances included, each once."""
    found = {}
    for instance in depsgraph.object_instances:
        ob = instance.object
        # Hair grows on emitters that are not shown themselves, and has their materials.
        if ob.type in SURFACE_TYPES and (instance.show_self or instance.show_particles):
            found.setdefault((ob.original.name_full, ob.data.name_full if ob.data else ""), ob)
    return list(found.values())
