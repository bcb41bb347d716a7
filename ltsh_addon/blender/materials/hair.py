"""What Cycles does differently on hair (runs in the child)."""

from __future__ import annotations


def bends_normals(tree):
    """A socket of `tree` that is 1, and 0 on hair, where Cycles never bends specular normals."""
    flipped = tree.nodes.new("ShaderNodeMath")
    flipped.operation, flipped.inputs[0].default_value = "SUBTRACT", 1.0
    tree.links.new(tree.nodes.new("ShaderNodeHairInfo").outputs["Is Strand"], flipped.inputs[1])
    return flipped.outputs[0]
