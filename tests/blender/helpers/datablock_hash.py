"""Fingerprints of all that is in the running Blender: every datablock, every property, custom ones included."""

from __future__ import annotations

import hashlib

import bpy
import numpy as np

# What Blender itself keeps changing, what repeats something else at great length, or what reading would load.
SKIPPED = {"rna_type", "id_data", "original", "session_uid", "bindcode", "depsgraph", "is_evaluated", "preview"}
SKIPPED |= {"pixels", "loop_triangles", "loop_triangle_polygons", "window_managers", "windows", "screens"}
# Blender 4.5 makes these attributes of a mesh when somebody looks.
SKIPPED |= {"uv_layer_clone", "uv_layer_stencil"}
# Elements of geometry: `attributes` hold the same numbers, and give them as arrays.
ELEMENTS = {"vertices", "edges", "loops", "polygons", "points", "curves", "position_data", "color_attributes"}
ELEMENTS |= {"vertex_normals", "polygon_normals", "corner_normals", "normals", "uv_layers", "vertex_colors"}
GEOMETRY = (bpy.types.Mesh, bpy.types.Curves, bpy.types.PointCloud)
SKIPPED_COLLECTIONS = {"window_managers", "screens", "workspaces", "all_ids"}


def fingerprints() -> dict[str, str]:
    """A hexadecimal digest for each datablock, by collection and full name."""
    found = {}
    for prop in bpy.data.bl_rna.properties:
        if prop.type != "COLLECTION" or prop.identifier in SKIPPED_COLLECTIONS:
            continue
        for block in getattr(bpy.data, prop.identifier):
            found[f"{prop.identifier}/{block.name_full}"] = fingerprint(block)
    return found


def session_state() -> dict:
    """All datablocks, and what else of a session an operation could change."""
    window = bpy.context.window_manager.windows[0] if bpy.context.window_manager.windows else None
    return {
        "blocks": fingerprints(),
        "file": bpy.data.filepath,
        "dirty": bpy.data.is_dirty,
        "scene": bpy.context.scene.name_full,
        "view layer": bpy.context.view_layer.name,
        "selected": sorted(ob.name_full for ob in bpy.context.view_layer.objects.selected),
        "active": getattr(bpy.context.view_layer.objects.active, "name_full", None),
        "mode": bpy.context.mode,
        "window": None if window is None else window.scene.name_full,
        "engines": sorted(cls.__name__ for cls in bpy.types.RenderEngine.__subclasses__() if cls.is_registered),
    }


def fingerprint(block) -> str:
    """The digest of one datablock."""
    digest = hashlib.sha256()

    def note(*parts):
        digest.update(repr(parts).encode())

    _note_struct(block, note, {})
    return digest.hexdigest()


def _note_struct(struct, note, seen: dict) -> None:
    """All properties of `struct`, and of what it owns; `seen` numbers what was met already."""
    key = (struct.rna_type.identifier, struct.as_pointer())
    if key in seen:
        note("again", seen[key])
        return
    seen[key] = len(seen)
    note("struct", struct.rna_type.identifier)
    is_geometry = isinstance(struct, GEOMETRY)
    if is_geometry:
        _note_geometry(struct, note)
    for prop in sorted(struct.bl_rna.properties, key=lambda prop: prop.identifier):
        if prop.identifier not in SKIPPED and not (is_geometry and prop.identifier in ELEMENTS | {"attributes"}):
            note(prop.identifier)
            _note_property(struct, prop, note, seen)
    if isinstance(struct, bpy.types.Image) and (struct.source == "GENERATED" or struct.is_dirty):
        note("pixels", hashlib.sha256(memoryview(_pixels(struct))).hexdigest())
    _note_custom(struct, note)


def _note_geometry(block, note) -> None:
    """Attributes, and for meshes which corners are a face and which groups a vertex is in."""
    for attribute in block.attributes:
        width = {"FLOAT_VECTOR": 3, "FLOAT2": 2, "FLOAT_COLOR": 4, "BYTE_COLOR": 4, "INT32_2D": 2, "QUATERNION": 4}
        field = {"FLOAT_VECTOR": "vector", "FLOAT2": "vector", "FLOAT_COLOR": "color", "BYTE_COLOR": "color"}
        note("attribute", attribute.name, attribute.domain, attribute.data_type, len(attribute.data))
        if attribute.data_type in ("STRING", "FLOAT4X4"):
            note([repr(item.value) for item in attribute.data])
            continue
        values = np.zeros(len(attribute.data) * width.get(attribute.data_type, 1), dtype=np.float64)
        attribute.data.foreach_get(field.get(attribute.data_type, "value"), values)
        note(hashlib.sha256(values.tobytes()).hexdigest())
    if isinstance(block, bpy.types.Mesh):
        note([polygon.loop_start for polygon in block.polygons])
        note([[(member.group, member.weight) for member in vertex.groups] for vertex in block.vertices])


def _note_property(struct, prop, note, seen) -> None:
    try:
        value = getattr(struct, prop.identifier)
    except (AttributeError, RuntimeError, TypeError) as error:
        note("unreadable", type(error).__name__)
        return
    if prop.type == "COLLECTION":
        note("length", len(value))
        for item in value:
            _note_pointer(item, note, seen)
    elif prop.type == "POINTER":
        _note_pointer(value, note, seen)
    elif getattr(prop, "is_array", False):
        note(_flat(value))
    else:
        note(value)


def _note_pointer(value, note, seen) -> None:
    if value is None:
        note(None)
    elif isinstance(value, bpy.types.ID) and not value.is_embedded_data:
        # Datablocks of their own have a fingerprint of their own.
        note("id", value.rna_type.identifier, value.name_full)
    elif isinstance(value, bpy.types.bpy_struct):
        _note_struct(value, note, seen)
    else:
        note(repr(value))


def _note_custom(struct, note) -> None:
    try:
        keys = sorted(struct.keys())
    except (TypeError, AttributeError):
        return  # this type takes no custom properties
    for key in keys:
        value = struct[key]
        if isinstance(value, bpy.types.ID):
            note("custom", key, value.name_full)
        elif hasattr(value, "to_dict"):
            note("custom", key, repr(value.to_dict()))
        elif hasattr(value, "to_list"):
            note("custom", key, value.to_list())
        else:
            note("custom", key, repr(value))


def _flat(value) -> list:
    """Numbers of a vector, matrix or array."""
    return [part for item in value for part in (_flat(item) if hasattr(item, "__len__") else [item])]


def _pixels(image):
    pixels = np.empty(len(image.pixels), dtype=np.float32)
    image.pixels.foreach_get(pixels)
    return pixels
