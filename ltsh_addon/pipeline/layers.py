"""What an EXR of LTSH says: the names of its layers, <technique>.<pass>@<light group>, and its metadata."""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Sequence
from pathlib import Path

from ..scene import CYCLES, VERSION

# COMBINED: the pass of whole pictures. REST: the layer of a finished picture that holds what is not LTSH's.
COMBINED, REST = "combined", "rest"
# ERROR: prefix of a technique's name in the layers of its difference to Cycles. UNSHADOWED: suffix of a technique's
# name in the layers without shadows, where others have shadows.
ERROR, UNSHADOWED = "error_", "_unshadowed"
# CYCLES_LAYERS: Cycles' picture, and the two halves whose mean it is.
CYCLES_LAYERS = (CYCLES, f"{CYCLES}_A", f"{CYCLES}_B")
COVERAGE = "coverage.hit"


def layer_name(technique: str, pass_name: str, group: str = "") -> str:
    """The name of a layer; `group` is one of `group_names`, "" for all light."""
    return f"{technique}.{pass_name}@{group}" if group else f"{technique}.{pass_name}"


def parse_layer_name(name: str) -> tuple[str, str, str]:
    """The technique, pass and light group ("" for all light) of a layer."""
    technique, _, rest = name.partition(".")
    pass_name, _, group = rest.partition("@")
    return technique, pass_name, group


def unique_names(names: Iterable[str]) -> list[str]:
    """`names` made unique for layers, with _ for the dots that separate the components of a layer's name."""
    unique: list[str] = []
    for name in names:
        plain = name.replace(".", "_")
        others = (f"{plain}_{number}" for number in itertools.count(2))
        unique.append(next(other for other in itertools.chain([plain], others) if other not in unique))
    return unique


def group_names(groups: Iterable[str]) -> list[str]:
    """Names of light groups in layers. The empty group becomes "ungrouped", or a longer name that is free."""
    groups, ungrouped = list(groups), "ungrouped"
    while ungrouped in groups:
        ungrouped += "_"
    return unique_names(group or ungrouped for group in groups)


def by_group(name: str, groups: Sequence[str], values: Iterable) -> dict:
    """The `values` of light groups by the names of their layers, beside the layer `name`; {} for a single group."""
    if len(groups) < 2:
        return {}
    technique, pass_name, _ = parse_layer_name(name)
    names = [layer_name(technique, pass_name, group) for group in group_names(groups)]
    return dict(zip(names, values, strict=True))


def metadata_of(extraction, scene: Path, **more: str) -> dict[str, str]:
    """`metadata` of a picture of an `Extraction`, which has its `exposure`."""
    facts = extraction.frame, extraction.camera, extraction.color_space.name
    return metadata(scene, *facts, exposure=repr(extraction.exposure), **more)


def metadata(scene: Path, frame: int, camera: str, color_space: str, **more: str) -> dict[str, str]:
    """The metadata of an EXR; each of `more` gets the prefix "ltsh:"."""
    facts = {"scene": Path(scene).name, "frame": str(frame), "camera": camera, "color_space": color_space}
    return {f"ltsh:{name}": value for name, value in {**facts, "version": VERSION, **more}.items()}
