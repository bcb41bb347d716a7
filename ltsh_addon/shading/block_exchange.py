"""How a block of samples reaches a worker process and its radiance comes back: through shared memory."""

from __future__ import annotations

from dataclasses import fields

import numpy as np

from ..scene import SCALAR_FIELDS, SurfaceSamples
from . import edge_loop, shared_block

# Fields of SurfaceSamples that only one of the passes reads: they need not travel for the other.
_ONLY_DIFFUSE = {"diffuse_normal", "smooth_normal", "bump_alpha2", "diffuse_albedo"}
_ONLY_SPECULAR = {
    "normal", "geometric_normal", "roughness", "specular_f0", "specular_f90", "specular_dip", "dielectric", "ior",
}  # fmt: skip


class ParentSide:
    """Sends blocks of `samples`, of `block_size` samples at most, to one child that works on `task`."""

    def __init__(self, task, samples: SurfaceSamples, block_size: int):
        self.samples = samples
        unread = set()
        if "diffuse" not in task.passes:
            unread |= _ONLY_DIFFUSE
        if "specular" not in task.passes:
            unread |= _ONLY_SPECULAR
        if all(light.receivers is None for light in task.lights):
            unread.add("receiver")
        self.sent, self.same, first = [], {}, {}
        for field in fields(samples):
            values = getattr(samples, field.name)
            # What is left out counts as 0 on the other side.
            if field.name in unread or _is_zero_everywhere(values):
                continue
            # A normal that stands for another is the same array: sent once.
            if id(values) in first:
                self.same[field.name] = first[id(values)]
            else:
                first[id(values)] = field.name
                self.sent.append(field.name)
        self.task = task
        self.memory = shared_block.SharedBlock(self._layouts(block_size)[2])
        self.size = self._layouts(block_size)[2]

    def _layouts(self, count):
        """Layouts of the samples sent and of the results, and the bytes of both."""
        arrays = {}
        for name in self.sent:
            values = getattr(self.samples, name)
            arrays[f"in {name}"] = ((count, *values.shape[1:]), values.dtype)
        shape = (len(self.task.groups), count, 3)
        for name in self.task.passes:
            arrays[f"out {name}"] = (shape, self.task.dtype)
        if self.task.has_error:
            arrays["error"] = ((count,), np.float64)
        layout, size = shared_block.layout_of(arrays)
        return [entry for entry in layout if entry[0].startswith("in ")], layout, size

    def put(self, block: slice) -> dict:
        """Copy a block into the shared memory; the message that tells the child."""
        inputs, layout, _ = self._layouts(block.stop - block.start)
        for name, values in self.memory.arrays(inputs).items():
            np.copyto(values, getattr(self.samples, name.removeprefix("in "))[block])
        return {"layout": layout, "same": self.same, "count": block.stop - block.start}

    def take(self, block: slice):
        """Radiance by pass and the error, views of the shared memory, once the child has answered."""
        _, layout, _ = self._layouts(block.stop - block.start)
        arrays = self.memory.arrays([entry for entry in layout if not entry[0].startswith("in ")])
        return {name: arrays[f"out {name}"] for name in self.task.passes}, arrays.get("error")

    def close(self) -> None:
        self.memory.close()


class ChildSide:
    """Shades the blocks that the parent puts into the memory."""

    def __init__(self, task, handle, size: int):
        self.task = task
        self.memory = shared_block.attach(handle, size)
        self.scratch = edge_loop.Scratch()

    def shade(self, message: dict) -> None:
        """Shade the block that `message` describes; the result goes into the memory."""
        arrays, count = shared_block.arrays_in(self.memory, message["layout"]), message["count"]
        values = {name.removeprefix("in "): array for name, array in arrays.items() if name.startswith("in ")}
        values.update({name: values[other] for name, other in message["same"].items()})
        for field in fields(SurfaceSamples):
            if field.name not in values:
                values[field.name] = np.broadcast_to(0.0, (count,) if field.name in SCALAR_FIELDS else (count, 3))
        found, estimates = self.task.shade(SurfaceSamples(**values), self.scratch)
        for name, radiance in found.items():
            arrays[f"out {name}"][:] = radiance
        if estimates is not None:
            arrays["error"][:] = estimates


def _is_zero_everywhere(values) -> bool:
    """True for one zero that stands for all elements, as `SurfaceSamples` has it for what is left out."""
    return values.size > 0 and not any(values.strides) and not values.flat[0]
