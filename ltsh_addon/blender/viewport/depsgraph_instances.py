"""What the viewport asks of the instances of a depsgraph: whose they are, who sees them, which share a mesh."""

from __future__ import annotations

import bpy

from ..pixels.inventory import SURFACE_TYPES


def is_surface(instance) -> bool:
    """True for what has surfaces that are shown."""
    return instance.object.type in SURFACE_TYPES and instance.show_self


def owner_of(instance):
    """The object that brings the instance into the scene: itself, or what instances it."""
    return instance.parent if instance.is_instance and instance.parent else instance.object


def is_seen_by_cameras(instance) -> bool:
    """False where the artist hides it from camera rays."""
    return instance.object.visible_camera and owner_of(instance).visible_camera


def data_pointer(ob) -> int:
    """What is the same for evaluated objects that share their data."""
    return ob.data.as_pointer() if ob.data is not None else 0


def mesh_key(instance) -> tuple:
    """What tells evaluated meshes apart: object, data and instancer, then the evaluated data itself.

    Blender may use the place of freed data again, but then one of the first three has changed.
    """
    ob = instance.object
    data = ob.data
    parent = instance.parent.original.session_uid if instance.is_instance and instance.parent else 0
    original = data.original.session_uid if data is not None and data.original is not None else 0
    pointer = data_pointer(ob)
    shared = isinstance(data, bpy.types.Mesh) and not ob.modifiers and not instance.is_instance
    return (0 if shared else ob.original.session_uid, original, parent, pointer)


def visibility(depsgraph, space):
    """A test of depsgraph instances: are they seen in `space`? Only its local view makes a difference."""
    if space is None or space.local_view is None:
        return lambda instance: True

    def in_local_view(instance) -> bool:
        return owner_of(instance).original.local_view_get(space)

    return in_local_view
