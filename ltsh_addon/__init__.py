"""Area-light shading with linearly transformed spherical harmonics (LTSH), beside LTC and Cycles.

A glossy surface under an area light reflects the integral of its lobe, BRDF times cosine, over the light's polygon. A
linear transform turns the lobe into something simple and keeps polygons polygons: a clamped cosine in LTC (Heitz et al.
2016), a spherical harmonics expansion in LTSH (Allmenroeder and Peters 2021), which follows the tear shape of grazing
highlights. Either way the integral has a closed form, so the picture has no noise.

    scene      AreaLight, SurfaceSamples, Film: the shared vocabulary
    ownership  temporary files of processes on several machines
    shading    the paper: warp, polygon, moments, lookup table, reference quadrature (numpy only)
    imaging    EXR, metrics, false color, comparison sheet, report
    blender    .blend to lights and samples, Cycles ground truth, panels, render engine (the only place that knows bpy)
    comparison the whole way from a .blend: techniques beside Cycles
    baking     the same per texel
    jobs       many pictures and bakes: tasks, shards, records of what is done
    commands   the command line's commands; cli calls them
"""

__version__ = "0.1.0"


def register():
    """Add LTSH to the running Blender."""
    from . import cli
    from .blender import registration

    registration.register(cli.main)


def unregister():
    """Remove what `register` added."""
    from .blender import registration

    registration.unregister()
