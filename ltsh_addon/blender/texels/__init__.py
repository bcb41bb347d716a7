"""Samples of a UV map's texels, and Cycles' bake of the same texels."""
