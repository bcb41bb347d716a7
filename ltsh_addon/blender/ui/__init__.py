"""Panels, operators, jobs and results inside Blender."""
