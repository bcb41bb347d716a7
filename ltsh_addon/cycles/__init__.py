"""How Cycles shades, in numpy: closures, normals, horizons, G-buffers, UV rasters. Nothing here knows Blender."""
