"""Blender in a second process: what is asked of it, and what it runs."""
