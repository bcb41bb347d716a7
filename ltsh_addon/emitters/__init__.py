"""How each kind of light becomes polygons, points or factors that lobes are integrated with."""
