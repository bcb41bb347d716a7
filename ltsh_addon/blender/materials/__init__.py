"""From Blender's materials to weighted lobes: in Cycles' AOVs, in maps, as constants for the viewport."""
