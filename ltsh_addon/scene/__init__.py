"""The shared vocabulary: techniques, passes, lights, surface samples and film.

World space is Blender's: metres, right-handed, z up. Radiance is scene-referred linear RGB in W m^-2 sr^-1.
"""

import logging
from collections.abc import Callable, Iterable
from dataclasses import dataclass

from .lights import (
    FARTHEST,
    DistantLight,
    EllipseLight,
    FlatLight,
    Light,
    Pattern,
    PointLight,
    PolygonLight,
    QuadLight,
    SkyLight,
    SpotCone,
    SpotLight,
    SunLight,
    light_of,
    light_records,
    lights_of,
    round_outline,
)
from .samples import REC709, SCALAR_FIELDS, Border, ColorSpace, Film, SurfaceSamples, is_constant

VERSION = "0.1.0"  # also in blender_manifest.toml and pyproject.toml


@dataclass(frozen=True)
class Technique:
    """The texts that users see of a technique."""

    label: str  # on buttons
    title: str  # on comparison sheets and as a stage of progress
    description: str  # what it does


REFERENCE = "reference"

# Techniques by the name that they have in options, layers of files and reports. All but REFERENCE have a table.
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
# ATLAS: the UV map of an atlas, and the name of its texture among those of objects.
ATLAS = "Lightmap"


class Cancelled(Exception):
    """A long computation was stopped on request."""


class SceneError(Exception):
    """The task cannot be done with this scene, file or Blender; the message is one line."""


# progress(stage, fraction of the stage that is done); returning False stops the work. Some have methods: `expect`
# takes the seconds of stages to come, by stage, `remark` a line for the user.
Progress = Callable[[str, float], "bool | None"]


def error_line(error: BaseException) -> str:
    """The message of an error in one line of readable length; the name of its class where the message is empty."""
    return shortened(" ".join(str(error).split())) or type(error).__name__


def unexpected_error_line(error: BaseException) -> str:
    """The line of an error that is a fault of this program; where it happened goes to the log."""
    logging.getLogger(__name__).error("unexpected error", exc_info=error)
    return f"unexpected error: {type(error).__name__}: {error_line(error)}"


def shortened(text: str, most: int = 1000) -> str:
    """`text`, its middle replaced by " ... " where it is longer than `most` characters."""
    return text if len(text) <= most else f"{text[: most // 2]} ... {text[len(text) - most // 2 :]}"


def listed(texts: Iterable[str], most: int = 8, separator: str = ", ") -> str:
    """The first `most` of `texts` and the number of those left out: "a, b and 3 more"; "none" for no texts."""
    texts = list(texts)
    more = f" and {len(texts) - most} more" if len(texts) > most else ""
    return (separator.join(texts[:most]) or "none") + more
