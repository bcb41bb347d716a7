"""From Blender's lights and emissive meshes to `AreaLight`."""
