"""Names of techniques and passes, as options, layers of files and reports have them, and the texts that users see."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Technique:
    """The texts that users see of a technique."""

    label: str  # on buttons
    title: str  # on comparison sheets and as a stage of progress
    description: str  # what it does


# Techniques by the name that they have in options, layers of files and reports. All but REFERENCE have a table.
REFERENCE = "reference"


TECHNIQUES = {
    "ltc": Technique("LTC", "LTC", "Linearly transformed cosines, as EEVEE has them: fastest, least accurate"),
    "ltsh2": Technique(
        "LTSH 2", "LTSH N=2", "Linearly transformed spherical harmonics of degree 2: nearly as fast as LTC"
    ),
    "ltsh4": Technique(
        "LTSH 4",
        "LTSH N=4",
        "Linearly transformed spherical harmonics of degree 4: accurate, 1.5 to 2 times the time of LTC",
    ),
    "ltsh4c": Technique(
        "LTSH 4c",
        "LTSH N=4 + cosine",
        "LTSH 4 with a bent cosine for grazing views: the most accurate closed form, three fifths of LTSH 4's error",
    ),
    REFERENCE: Technique(
        "Reference",
        "Reference quadrature",
        "Quadrature of the true lobe: exact and slow, on some of the pixels of large images",
    ),
}


SHIPPED_TABLES = tuple(name for name in TECHNIQUES if name != REFERENCE)


# What shades where nothing else is chosen, and what comparisons put beside Cycles then.
DEFAULT_TECHNIQUE = "ltsh4c"
COMPARED_TECHNIQUES = ("ltc", DEFAULT_TECHNIQUE)


CYCLES = "cycles"  # the name of Cycles' pictures beside those of techniques


PASSES = ("specular", "diffuse")


BAKE_PASSES = (*PASSES, "diffuse_light", "combined")
