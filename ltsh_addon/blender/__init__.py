"""All that touches Blender: the only package that imports bpy, mathutils or gpu.

The core calls `child.extract`, which opens a .blend in a child process and returns lights, surface samples and the
Cycles reference as plain arrays. `child` and `gbuffer` need no bpy; the other modules run inside the child.
"""
