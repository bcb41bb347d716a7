"""The shared vocabulary: techniques, passes, lights, surface samples and film.

World space is Blender's: metres, right-handed, z up. Radiance is scene-referred linear RGB in W m^-2 sr^-1.
"""

from collections.abc import Callable, Iterable

from .film import REC709, Border, ColorSpace, Film
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
from .samples import SCALAR_FIELDS, SurfaceSamples, is_constant
from .techniques import (
    BAKE_PASSES,
    COMPARED_TECHNIQUES,
    CYCLES,
    DEFAULT_TECHNIQUE,
    PASSES,
    REFERENCE,
    SHIPPED_TABLES,
    TECHNIQUES,
    Technique,
)

VERSION = "0.1.0"  # also in blender_manifest.toml and pyproject.toml


class Cancelled(Exception):
    """A long computation was stopped on request."""


class SceneError(Exception):
    """The task cannot be done with this scene, file or Blender; the message is one line."""


# progress(stage, fraction of the stage that is done); returning False stops the work. Some have a method `expect`, that
# takes the seconds of stages to come, by stage.
Progress = Callable[[str, float], "bool | None"]


def error_line(error: BaseException) -> str:
    """The message of an error in one line of readable length; the name of its class where the message is empty."""
    return shortened(" ".join(str(error).split())) or type(error).__name__


def shortened(text: str, most: int = 1000) -> str:
    """`text`, its middle replaced by " ... " where it is longer than `most` characters."""
    return text if len(text) <= most else f"{text[: most // 2]} ... {text[len(text) - most // 2 :]}"


def listed(texts: Iterable[str], most: int = 8, separator: str = ", ") -> str:
    """The first `most` of `texts` and the number of those left out: "a, b and 3 more"; "none" for no texts."""
    texts = list(texts)
    more = f" and {len(texts) - most} more" if len(texts) > most else ""
    return (separator.join(texts[:most]) or "none") + more
