"""The paper: lookup tables of lobes, and integrals of lobes over polygons. Conventions: see `shading`.

Allmenroeder and Peters 2021, "Linearly Transformed Spherical Harmonics", and where it stands:

    eq. 1, radiance reflected from a polygon      `lobe_integrals.integrate_polygon`, times the light's radiance
    D, the transformed distribution               `lobe_integrals.evaluate_lobe`
    M and its four parameters (section 2)         `lookup_table.warp_entries`: three of them, in a form that is smooth
    eq. 2, the polygon in the original domain     `lookup_table.Lobe.to_original_domain`
    D_orig, the expansion (section 2)             `spherical_harmonics.evaluate`, coefficients from `LookupTable.lookup`
    the polygon clipped at the horizon            `polygon.clip_to_horizon`
    integrals of the expansion over a polygon     `edge_integrals.moments`, `moments32.moments` in single precision
    the fit of M and of the coefficients          `tables/refine.py` and `tables/projection.py`
"""
