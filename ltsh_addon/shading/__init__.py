"""Shading by linearly transformed lobes: numpy only. The conventions of the whole package stand here.

Local frame of a surface point: z is the shading normal, the view direction is (sin theta_o, 0, cos theta_o), so it has
y = 0 and x >= 0. The BRDF is mirror-symmetric in y.
Winding: a polygon's solid angle and signed integrals are positive where its corners run counterclockwise as seen from
outside the unit sphere around the point.
Spherical harmonics: order and sign as in `spherical_harmonics`.
Roughness is Blender's: alpha = roughness^2 of GGX with height-correlated Smith masking-shadowing.
Colors are linear RGB; radiance is in W m^-2 sr^-1.
Letters: P samples, L lights, V polygon corners, K coefficients, F Fresnel curves; arrays of vectors in the public
functions have space as the last axis, kernels work on (3, V, P).
"""

from ..lobes.lobe_integrals import clamped_form_factor, evaluate_lobe, integrate_polygon
from ..lobes.lookup_table import LookupTable, TableError, load_table
from ..scene import PASSES, REFERENCE, SHIPPED_TABLES
from .integrator import OwnTechnique, Shading, is_own, shade

__all__ = [
    "PASSES",
    "REFERENCE",
    "SHIPPED_TABLES",
    "LookupTable",
    "OwnTechnique",
    "Shading",
    "TableError",
    "clamped_form_factor",
    "evaluate_lobe",
    "integrate_polygon",
    "is_own",
    "load_table",
    "shade",
]
