"""Files that the open .blend refers to and that are not there (runs in the child)."""

from __future__ import annotations

from pathlib import Path

import bpy


def missing_files() -> list[str]:
    """A warning for each library and each image file in use that is missing."""
    warnings = []
    for library in bpy.data.libraries:
        path = bpy.path.abspath(library.filepath)
        if not Path(path).is_file():
            warnings.append(f"library {library.name!r}: {library.filepath} is missing, and what it held with it")
    for image in bpy.data.images:
        if image.source != "FILE" or image.packed_file is not None or not image.users or not image.filepath:
            continue
        if not Path(bpy.path.abspath(image.filepath, library=image.library)).is_file():
            warnings.append(f"image {image.name!r}: {image.filepath} is missing, Cycles shows it in one false color")
    return warnings
