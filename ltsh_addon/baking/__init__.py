"""Lighting baked into textures: objects, texels, errors, the files of a bake."""
