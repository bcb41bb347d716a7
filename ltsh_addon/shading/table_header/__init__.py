"""A lookup table as one header for C99, C++ and GLSL 3.30 (see tables/EXPORT.md).

The text is valid in all three: vectors, polygons, lobes and edges go in and come out by value, because GLSL has no
pointers, and a struct may hold an array everywhere; a few macros cover the rest.

    header     the whole: constants, data, what is shared
    geometry   text of the language layer, types, vectors, frames, polygons
    edges      text of the integrals over edges, cells, warps
    lookup     text of a table's lookups
    lobes      text of its lobes and their integrals
"""

from .header import data_blocks, header_text, shared_text
from .lobes import moment_lines

__all__ = ["data_blocks", "header_text", "moment_lines", "shared_text"]
