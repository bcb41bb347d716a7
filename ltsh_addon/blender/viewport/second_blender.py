"""The second Blender of a view, one with views that follow each other, and the changes of the scene that it is told."""

import threading
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path

import bpy

from ...files import temporary_folder
from ..process.blender_process import BlenderProcess

# REPLACED: data-blocks that are handed over by themselves, and the collections of `bpy.data` that have them.
# NOT_NOTED: kinds that change nothing themselves; scenes have settings, and node trees come with their users.
NOT_NOTED = ("Scene", "Camera", "Object")
REPLACED = {bpy.types.Light: "lights", bpy.types.Material: "materials", bpy.types.World: "worlds"}


class SecondBlender:
    """A second Blender, with a folder of its own, that renders the rest for one view after another."""

    def __init__(self):
        self._stack = ExitStack()
        self.folder = self._stack.enter_context(temporary_folder())
        self.process = BlenderProcess(self.folder, background=True)
        self._stack.callback(self.process.end)
        self.step: threading.Thread | None = None  # the last one
        self.left = 0.0  # the moment at which its view was left

    @property
    def is_busy(self) -> bool:
        """True while it does a step, perhaps for a view that was left."""
        return self.step is not None and self.step.is_alive()

    def end(self) -> None:
        """End the process, whatever it is doing, and remove its files."""
        self._stack.close()


# Those of views that were left, for the next ones: undo makes all views new, and artists go to Solid and back.
spare: list[SecondBlender] = []


def end_spare() -> None:
    """End the second Blenders that no view has."""
    while spare:
        spare.pop().end()


@dataclass
class RestChanges:
    """What has changed in a scene since the second Blender has it."""

    everything: bool = True  # too much to hand it over piece by piece
    objects: set[str] = field(default_factory=set)  # names of those that were moved
    blocks: set[tuple[str, str]] = field(default_factory=set)  # names of collections of `bpy.data`, and in these

    def add(self, depsgraph, has_new_settings: bool) -> tuple[bool, bool]:
        """Add what an update of the depsgraph changes; returns whether it is any light, and anything else."""
        blocks = [(update, update.id.original) for update in depsgraph.updates]
        has_material = any(isinstance(block, bpy.types.Material) for _, block in blocks)
        has_lamp = any(isinstance(block, bpy.types.Light) for _, block in blocks)
        has_light, has_other = False, has_new_settings
        for update, block in blocks:
            kind = next((name for one, name in REPLACED.items() if isinstance(block, one)), "")
            if kind:
                self.blocks.add((kind, block.name))
                self.everything |= block.library is not None or _refers_to_objects(block)
                has_light, has_other = has_light or kind != "materials", has_other or kind == "materials"
            elif isinstance(block, bpy.types.Object) and block.type != "CAMERA":
                is_light = block.type == "LIGHT"
                has_light, has_other = has_light or is_light, has_other or not is_light
                if update.is_updated_transform:
                    self.objects.add(block.name)
                # The geometry of lights is that of their data-blocks, and materials come with their users.
                has_shape = update.is_updated_geometry and not is_light
                is_known = update.is_updated_transform or (has_lamp if is_light else has_material)
                self.everything |= has_shape or not is_known
            elif block.bl_rna.identifier in NOT_NOTED or isinstance(block, bpy.types.NodeTree):
                pass
            elif not isinstance(block, bpy.types.Mesh) or update.is_updated_geometry:
                has_other = self.everything = True
        self.everything |= has_new_settings
        return has_light, has_other

    def written(self, scene, path: Path) -> dict:
        """The record of the changes for the second Blender; data-blocks go to the .blend `path`."""
        blocks = {getattr(bpy.data, kind)[name, None] for kind, name in self.blocks}
        if blocks:
            bpy.data.libraries.write(str(path), blocks, path_remap="ABSOLUTE", fake_user=True)
        objects = {name: scene.objects[name] for name in sorted(self.objects)}
        moved = {
            name: [[*map(tuple, one)] for one in (ob.matrix_basis, ob.matrix_world)] for name, ob in objects.items()
        }
        return {"file": str(path), "blocks": sorted(self.blocks), "moved": moved}


def _refers_to_objects(block) -> bool:
    """True if nodes of the data-block, or of its groups, take coordinates or more from objects."""
    trees, names = [block.node_tree], set()
    while trees:
        tree = trees.pop()
        if tree is None or tree.name_full in names:
            continue
        names.add(tree.name_full)
        if any(getattr(node, "object", None) is not None for node in tree.nodes):
            return True
        trees += [node.node_tree for node in tree.nodes if getattr(node, "node_tree", None) is not None]
    return False
