"""Area-light shading with linearly transformed spherical harmonics (LTSH), beside LTC and Cycles.

A glossy surface under an area light reflects the integral of its lobe, BRDF times cosine, over the light's polygon. A
linear transform turns the lobe into something simple and keeps polygons polygons: a clamped cosine in LTC (Heitz et al.
2016), a spherical harmonics expansion in LTSH (Allmenroeder and Peters 2021), which follows the tear shape of grazing
highlights. Either way the integral has a closed form, so the picture has no noise.

CONTRIBUTING.md has the rooms of the package, its words, and the way of a pixel through it.
"""


def register():
    """Add LTSH to the running Blender."""
    from . import cli
    from .blender import registration

    registration.register(cli.main)


def unregister():
    """Remove what `register` added."""
    from .blender import registration

    registration.unregister()
