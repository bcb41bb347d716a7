"""Lights of the evaluated scene: area lights, glowing meshes, their textures, and what they light."""
