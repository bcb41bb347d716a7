"""Bakes: the objects of a scene, their files and report; `bake_object` shades the texels of each."""

from __future__ import annotations

import shutil
import time
from contextlib import nullcontext
from pathlib import Path

import numpy as np

from ..files import temporary_folder
from ..reading import NUMBER, Malformed, check, file_name
from ..scene import PASSES, Progress, lights_of, listed
from ..visibility import Occluders
from . import lighting
from .bake_object import ObjectBaker, applied_layer, bakes_centers_alone, block_rows, shaded_passes
from .comparison import percent
from .lighting import check_named, prepare
from .options import BAKE_PASSES, MARGIN_TYPES, TEXTURE_SIDES, BakeOptions, child_job
from .tasks import Records, TaskResult, contents_digest, file_stems, options_digest, versions, write_reports

# NOTED_SHARE_OUTSIDE: a larger share of the UV map outside of the texture is reported. Less may come from texels along
# the border, which count by their centers.
NOTED_SHARE_OUTSIDE = 0.01


def bake_scene(options: BakeOptions, progress: Progress | None = None) -> dict:
    """Bake the objects of a scene: OUT/<object>.exr (<object>.<tile>.exr with several tiles), report.json, timing.json.

    Returns the report, with the times under "seconds". An object that cannot be baked is named in the report under
    "problems"; the others are baked all the same. Only timing.json depends on the machine's speed. Raises SceneError,
    TableError, OSError, Cancelled, ValueError.
    """
    result = bake_objects(options, progress)
    report = result.report
    if options.apply and report["objects"]:
        layer = applied_layer(options)
        report["applied"] = apply_textures(options.scene, options.output, report["objects"], layer, progress)
    return write_reports(result, options.output)


def bake_objects(
    options: BakeOptions,
    progress: Progress | None = None,
    *,
    tile: int | None = None,
    following: tuple[str, ...] = (),
) -> TaskResult:
    """Bake the objects and write their files, but no report.json; `tile` is the only UDIM tile to bake, None: all.

    Within `kept_blender` the scene stays open for the next call with the same options, for the objects named here and
    those announced as `following`. Raises as `bake_scene` does.
    """
    from ..blender.process import client

    start = time.perf_counter()
    _check(options)
    client.check_readable(options.scene)
    check_named(options.techniques, "a bake that is resumed")
    tables = prepare(options)
    finished = TileRecords(options)
    with temporary_folder() as folder:
        manifest = client.extract_bake(_job(options, finished.finished, tile, following), folder, progress=progress)
        names = [record["name"] for record in manifest["objects"]]
        stems = file_stems(names) if options.name is None else [options.name]
        records, files, seconds = [], [], {"blender": manifest["seconds"]}
        with _shadow_tracer(options, manifest, folder) as tracer:
            for record, stem in zip(manifest["objects"], stems, strict=True):
                if record["problem"] is None:
                    (options.output / stem).parent.mkdir(parents=True, exist_ok=True)
                    baker = ObjectBaker(options, tables, manifest, record, folder / record["folder"], tracer)
                    baked = baker.bake(stem, [] if tile is None else [tile], finished, progress)
                    records.append(baked.report)
                    files += baked.files
                    seconds |= baked.seconds
                    shutil.rmtree(folder / record["folder"])
    document = _report(options, manifest, records)
    seconds["total"] = time.perf_counter() - start
    return TaskResult(document, seconds, tuple(files))


def _shadow_tracer(options, manifest, folder):
    """A context with the ShadowTracer; it gives None where shadows are off."""
    if manifest["occluders"] is None:
        return nullcontext()
    occluders = Occluders.load(folder / manifest["occluders"])
    return lighting.ShadowTracer(occluders, lights_of(manifest["lights"]), np.array(manifest["origin"]))


def _check(options: BakeOptions) -> None:
    width, height = options.size
    for side in options.size:
        if not TEXTURE_SIDES[0] <= side <= TEXTURE_SIDES[1]:
            limits = "{} to {}".format(*TEXTURE_SIDES)
            raise ValueError(f"size is {width}x{height}, expected {limits} each")
    if options.margin_type not in MARGIN_TYPES:
        raise ValueError(f"margin_type is {options.margin_type!r}, expected {' or '.join(MARGIN_TYPES)}")
    unknown = [name for name in options.passes if name not in BAKE_PASSES]
    if unknown or not options.passes:
        raise ValueError(f"passes are {list(options.passes)}, expected some of {', '.join(BAKE_PASSES)}")


def _job(options, finished, tile=None, following=()):
    from ..blender.process import client

    return child_job(
        client.BakeJob,
        options,
        width=options.size[0],
        height=options.size[1],
        block_rows=block_rows(options),
        cycles_samples=options.cycles_samples if options.error else 0,
        passes=tuple(name for name in PASSES if name in shaded_passes(options)),
        finished=tuple(finished),
        tile=tile,
        following=following,
    )


class TileRecords:
    """Records of finished tiles: reads those of the same job (with `resume`) and writes new ones.

    Where the options have a `name`, only records of that name are read.
    """

    def __init__(self, options: BakeOptions):
        self._records = Records(options.output, "tiles", _TILE_RECORD)
        self._key = options_digest("bake", options, contents_digest(options))
        names = None if options.name is None else [options.name]
        whole = self._records.all_whole(self._key, names) if options.resume else []
        self.finished = {(record["task"]["object"], record["task"]["tile"]): record for record in whole}

    def take(self, name: str, tile: int, file: str) -> dict | None:
        """The record of a finished tile of the object `name` with the `file`, else None."""
        record = self.finished.get((name, tile))
        return record if record is not None and file in record["files"] else None

    def write(self, name: str, tile: int, stem: str, files, report: dict) -> dict:
        """Write the record of a finished tile; returns it."""
        return self._records.write(f"{stem}.{tile}", self._key, {"object": name, "tile": tile}, files, report=report)


def apply_textures(scene: Path, output: Path, records: list[dict], layer: str, progress=None) -> str:
    """Save a copy of the .blend whose objects show the textures of the report's `records`; returns its file name."""
    from ..blender.process import client

    textures = []
    for record in records:
        if any("texture" not in tile for tile in record["tiles"].values()):
            raise ValueError(f"object {record['name']!r}: has no texture to show; run the job again with --apply")
        files = [
            {"path": str((output / tile["texture"]).absolute()), "tile": int(number)}
            for number, tile in record["tiles"].items()
        ]
        name = f"{record['name']} {layer}"
        textures.append({"object": record["name"], "uv": record["uv"], "name": name, "files": files})
    path = output / f"{Path(scene).stem}_baked.blend"
    client.apply_bake(scene, path, textures, progress=progress)
    return path.name


def _report(options, manifest, records) -> dict:
    problems = [record["problem"] for record in manifest["objects"] if record["problem"]]
    lines = [line for record in manifest["objects"] for line in record["warnings"]]
    warnings = list(dict.fromkeys([*manifest["warnings"], *lines]))
    if options.conservative:
        warnings += [
            f"object {record['name']!r}: texels whose centers no face covers are left out, because Cycles bakes none "
            f"of them: leave out {'--error' if options.error else '--conservative, or bake its textures to images'}"
            for record in manifest["objects"]
            if record["problem"] is None and bakes_centers_alone(options, record)
        ]
    reasons = {record["name"]: record.get("unshaded", ()) for record in manifest["objects"]}
    for record in records:
        wrong, note = _darkness(record, reasons[record["name"]])
        problems += wrong
        warnings += note
        if record["outside"] > NOTED_SHARE_OUTSIDE:
            share = f"{100 * record['outside']:.3g} %"
            warnings.append(
                f"object {record['name']!r}: {share} of UV map {record['uv']!r} lies outside of the texture, not baked"
            )
        for tile in record["tiles"].values():
            share = tile["overlapping_texels"] / max(tile["texels"], 1)
            if share > 0.0:
                share = f"{100 * share:.3g} %"
                warnings.append(f"object {record['name']!r}: {share} of its texels are covered more than once")
            if tile["unbaked_texels"]:
                share = f"{100 * tile['unbaked_texels'] / (tile['texels'] + tile['unbaked_texels']):.3g} %"
                warnings.append(
                    f"object {record['name']!r}: {share} of its texels are left out, because Cycles bakes nothing "
                    "there: apply the modifiers"
                )
    return {
        "scene": str(options.scene),
        "frame": manifest["frame"],
        "size": list(options.size),
        "sub_samples": options.sub_samples,
        "view": manifest["view"],
        "objects": records,
        "problems": problems,
        "warnings": warnings,
        "versions": versions(manifest["blender_version"]),
    }


def _darkness(record, reasons) -> tuple[list[str], list[str]]:
    """Problems and warnings of a dark object: most of its texels are not shaded, for `reasons`, or no light arrives."""
    tiles, name = record["tiles"].values(), f"object {record['name']!r}"
    texels, unshaded = (sum(tile[key] for tile in tiles) for key in ("texels", "unshaded_texels"))
    if 2 * unshaded > texels:
        share = f"{100.0 * unshaded / texels:.3g} %"
        return [f"{name}: {share} of its texels are not shaded: {listed(dict.fromkeys(filter(None, reasons)))}"], []
    is_dark = texels > 0 and not any(tile["is_lit"] for tile in tiles)
    return [], [f"{name}: no light reaches it, or it reflects none: its texture is black"] if is_dark else []


_ERRORS = {"unbiased_squared_error?": NUMBER | None, "unbiased_error?": NUMBER | None}
_TILE = {
    **dict.fromkeys(("texels", "unshaded_texels", "unbaked_texels", "covered_times", "overlapping_texels"), NUMBER),
    "is_lit": bool,
    "texture?": file_name,
    "errors?": {str: {"noise?": NUMBER | None, "techniques": {str: _ERRORS}}},
}
_TILE_RECORD = {"task": {"object": str, "tile": int}, "report": _TILE}


def _tiles(value, name) -> None:
    check(value, {str: {**_TILE, "file": file_name}}, name)
    if wrong := [number for number in value if not number.isdecimal()]:
        raise Malformed(f"{name} has {wrong[0]!r}, expected the number of a tile")


# What `merge` and a summary need in a report (see `reading.check`).
REPORT = {
    "objects": [{"name": str, "uv": str, "tiles": _tiles}],
    **dict.fromkeys(("problems", "warnings"), [str]),
    "versions": dict,
}


def summary(report: dict, seconds: dict) -> list[str]:
    """Lines of text about the bake of one scene, camera and frame: a line per file, and the errors if there are any."""
    lines = []
    for record in report["objects"]:
        for tile in record["tiles"].values():
            took = seconds.get(tile["file"])
            seconds_text = f"{took:>8.2f} s" if isinstance(took, NUMBER) else ""
            lines.append(f"{tile['file']:<40}{tile['texels']:>10} texels{seconds_text}")
            for pass_name, figures in tile.get("errors", {}).items():
                for name, error in figures["techniques"].items():
                    in_noise = (error.get("unbiased_squared_error") or 0.0) < 0.0
                    beside = "in noise" if in_noise else percent(error.get("unbiased_error"))
                    noise = f"(noise {percent(figures.get('noise'))})"
                    lines.append(f"  {name + '.' + pass_name:<30}{beside:>10} beside Cycles {noise}")
    return lines


def brief(report: dict) -> list[str]:
    """The lines of `summary` without times, under the name of the bake, for one of several."""
    return [f"{report['name']}:", *(f"  {line}" for line in summary(report, {}))]
