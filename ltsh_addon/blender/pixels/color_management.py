"""The linear space that all colors of the open file are in (runs in the child)."""

from __future__ import annotations

import bpy
import mathutils


def working_space() -> dict:
    """Name of the working space ("" where Blender does not tell, before 5.0) and its matrix to linear Rec.709."""
    columns = [mathutils.Color(axis).from_scene_linear_to_rec709_linear() for axis in ((1, 0, 0), (0, 1, 0), (0, 0, 1))]
    name = bpy.data.colorspace.working_space if bpy.app.version >= (5, 0, 0) else ""
    return {"name": name, "to_rec709": [[column[row] for column in columns] for row in range(3)]}
