"""From an evaluated scene to samples, in the second Blender: pixels, texels."""
