"""Area-light shading with linearly transformed spherical harmonics (LTSH), beside LTC and Cycles.

A glossy surface under an area light reflects the integral of its lobe, BRDF times cosine, over the light's polygon. A
linear transform turns the lobe into something simple and keeps polygons polygons: a clamped cosine in LTC (Heitz et al.
2016), a spherical harmonics expansion in LTSH (Allmenroeder and Peters 2021), which follows the tear shape of grazing
highlights. Either way the integral has a closed form, so the picture has no noise.

These are the rooms of the package. A room imports only itself and rooms above it; of the rooms of `blender`, `ui`,
`engine` and `registration` come last.

    interruption  Ctrl-C and SIGTERM as exceptions
    scene         the shared vocabulary: lights, SurfaceSamples, Film, errors, names of techniques and passes
    reading       how files of others are read: what they may hold, what they must have
    files         how files are written, and how leftovers of dead processes are deleted
    lobes         the paper: lookup tables, spherical harmonics, polygons, integrals, BRDFs (numpy only)
    emitters      how each kind of light becomes polygons, points or factors (numpy only)
    workers       child processes that share the work
    shading       `shade`, the reference quadrature, the header for other engines (numpy only)
    cycles        how Cycles shades: BSDF formulas, normals, G-buffers, UV rasters (numpy only)
    visibility    the visibility of lights: occluders, and rays by Embree (numpy and ctypes)
    imaging       EXR, metrics, color, comparison sheet, report
    blender       .blend to lights and samples, Cycles renders, viewport, panels, render engine (all that knows bpy)
    pipeline      a .blend in, files out: pictures, bakes, tasks
    cli           the command line
    panel_job     the process that a panel starts
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
