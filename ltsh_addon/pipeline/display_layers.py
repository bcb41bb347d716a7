"""Results as one small EXR per picture, for Blender's Image Editor, and an index of them."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from .. import imaging
from ..imaging import exr
from ..imaging.report import FILE, write_index
from ..imaging.sheet import common_error_scale
from ..scene import BAKE_PASSES, CYCLES, REFERENCE, TECHNIQUES, Progress
from .comparison import against_cycles
from .mixer import MIXER_FILE, MixerRow, baked_light_pictures, light_pictures, mixer_file
from .relight import RELIGHT_SUFFIX, RelightData

FOLDER = "images"
OF_BAKES = "frame", "camera"  # facts about the pictures of lights of a bake, in its report
LABELS = {CYCLES: "Cycles", **{name: technique.label for name, technique in TECHNIQUES.items()}}
FILES = {"shade": "shade.exr", "compare": "compare.exr"}


def write(command: str, output: Path, report: dict, partial: str = "", groups: dict | None = None) -> Path:
    """Write OUT/images/<layer>.exr and index.json for the results of `command` in `output`; returns the folder.

    `partial` says what is missing; empty: nothing. `groups` has the pictures of objects that are there already; those
    of the others are added to it.
    """
    folder = output / FOLDER
    folder.mkdir(parents=True, exist_ok=True)
    if command == "bake":
        groups = {} if groups is None else groups
        paths = (output / tile["file"] for record in report["objects"] for tile in record["tiles"].values())
        for path in (path for path in paths if path.stem not in groups):
            groups[path.stem] = _group(path, folder, f"{path.stem}.", {})
    else:
        groups = {"": _group(output / FILES[command], folder, "", report["passes"])}
    index = {"command": command, "partial": partial, "groups": groups, "report": report}
    write_index(folder, index)
    # Pictures of an earlier run would be mistaken for those of this one.
    names = {FILE} | {name for group in groups.values() for name in group["files"].values()}
    for path in folder.iterdir():
        if path.name not in names and path.suffix == ".exr":
            path.unlink()
    return folder


def write_lights(folder: Path, arguments: Sequence[str], report: dict, progress: Progress | None = None) -> None:
    """Write the files of the light mixer into the `folder` of `write`, and remove others.

    There are such where the command with these `arguments` and this `report` wrote relight data, or baked each light.
    """
    for path in folder.glob(f"*{MIXER_FILE}"):
        path.unlink()
    if "--keep-visibility" in arguments:
        samples = Path(FILES[arguments[0]]).with_suffix(RELIGHT_SUFFIX)
        light_pictures(RelightData.load(folder.parent / samples), progress).save(folder / MIXER_FILE)
    rows = [MixerRow.of(row) for row in report.get("light_rows", ())]
    tiles = (tile for record in report["objects"] for tile in record["tiles"].values()) if len(rows) > 1 else ()
    facts = {name: report.get(name) for name in OF_BAKES}
    for tile in tiles:
        path = folder.parent / tile["file"]
        baked_light_pictures(imaging.read_layers(path), rows, facts).save(folder / mixer_file(path.stem))


def _group(path: Path, folder: Path, prefix: str, report: dict) -> dict:
    """Write the pictures of one EXR, with `prefix` before their file names; returns their entry of the index."""
    layers = {name: pixels for name, pixels in imaging.read_layers(path).items() if not exr.parse_layer_name(name)[2]}
    # The files show emission and background, too. Figures and scales are those of the reflected light.
    whole = [name for name in layers if exr.parse_layer_name(name)[1] == exr.COMBINED and layers[name].shape[-1] == 4]
    shown = {name: layers.pop(name)[..., :3] for name in whole}
    names = [name for name in _techniques(layers) if not name.startswith((*exr.CYCLES_LAYERS[1:], exr.ERROR))]
    names = [name for name in names if name != exr.REST and not name.endswith(exr.UNSHADOWED)]
    passes = [name for name in BAKE_PASSES if exr.layer_name(names[0], name) in layers]
    _add_combined(layers, names, passes)
    written = {}
    for name in names:
        for pass_name in passes:
            for layer in (exr.layer_name(name, pass_name), exr.layer_name(exr.ERROR + name, pass_name)):
                if layer in layers:
                    written[layer] = f"{prefix}{layer}.exr"
                    exr.write_channels(folder / written[layer], _unnamed(shown.get(layer, layers[layer])))
    height, width = layers[exr.layer_name(names[0], passes[0])].shape[:2]
    return {
        "size": [width, height],
        "names": names,
        "labels": {name: LABELS.get(name, name) for name in names},
        "passes": passes,
        "files": written,
        "figures": _figures(layers, names, passes, report),
        "scales": {pass_name: _scale(layers, names, pass_name) for pass_name in passes},
    }


def _techniques(layers) -> list[str]:
    """Names of the layers of radiance: techniques in their usual order, then the user's tables, Cycles last."""
    names = {technique for technique, pass_name, _ in map(exr.parse_layer_name, layers) if pass_name in BAKE_PASSES}
    others = sorted(names - {*TECHNIQUES, CYCLES})
    return [name for name in (*TECHNIQUES, *others, CYCLES) if name in names]


def _add_combined(layers, names, passes) -> None:
    """Add the sums of specular and diffuse to `layers` and `passes`, where both are there and their sum is not."""
    if exr.COMBINED in passes or not {"specular", "diffuse"} <= set(passes):
        return
    for name in names:
        for layer in (name, exr.ERROR + name, f"{name}_A", f"{name}_B"):
            specular, diffuse = (exr.layer_name(layer, pass_name) for pass_name in ("specular", "diffuse"))
            if specular in layers:
                layers[exr.layer_name(layer, exr.COMBINED)] = layers[specular] + layers[diffuse]
    passes.append(exr.COMBINED)


def _unnamed(pixels: np.ndarray) -> dict:
    """Channels R, G and B without a layer's name, which any program reads."""
    return {letter: pixels[..., index] for index, letter in enumerate("RGB")}


def _scale(layers, names, pass_name) -> float:
    """The radiance of an error at the ends of its color scale."""
    picture = layers[exr.layer_name(names[-1], pass_name)]
    errors = [layers[layer] for name in names if (layer := exr.layer_name(exr.ERROR + name, pass_name)) in layers]
    if not errors:
        errors = [layers[exr.layer_name(name, pass_name)] - picture for name in names[:-1]]
    return common_error_scale(errors, picture)


def _figures(layers, names, passes, report) -> dict:
    """Errors against Cycles by pass and technique: from the `report` by pass, measured where it has none."""
    figures = {}
    for pass_name in passes if CYCLES in names else ():
        known = report.get(pass_name)
        if known is not None:
            rows = {name: row["against_cycles"] for name, row in known["techniques"].items()}
            figures[pass_name] = {"noise": known["noise"], "techniques": rows}
        else:
            figures[pass_name] = _measured(layers, names, pass_name)
    return figures


def _measured(layers, names, pass_name) -> dict:
    halves = np.stack([layers[exr.layer_name(half, pass_name)] for half in exr.CYCLES_LAYERS[1:]])
    hit, rows = layers[exr.COVERAGE] > 0.0, {}
    for name in names:
        if name != CYCLES:
            picture = layers[exr.layer_name(name, pass_name)]
            # The reference may cover some of the pixels only; the others are black.
            mask = hit & picture.any(axis=-1) if name == REFERENCE else hit
            rows[name] = against_cycles(picture, halves, mask)
    return {"noise": imaging.reference_noise(*halves, hit), "techniques": rows}
