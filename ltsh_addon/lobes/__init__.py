"""The paper: lookup tables of lobes, and integrals of lobes over polygons. Conventions: see `shading`."""
