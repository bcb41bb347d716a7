"""Lighting baked into the texels of UV maps: a .blend in, one float EXR per object and tile out, and report.json."""

from __future__ import annotations

import shutil
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

from .. import imaging, shading
from ..comparison import compare
from ..comparison.compare import Made
from ..jobs.output_names import file_stems
from ..jobs.task_records import Records, contents_digest, options_digest
from ..scene import AreaLight
from ..shading.workers import cores
from .bake_object import ObjectBaker, applied_layer, block_rows, shaded_passes

BAKE_PASSES = ("specular", "diffuse", "diffuse_light", "combined")
SIZES = (64, 8192)
# Texels beside what is baked show the nearest texel, or the adjacent face of the mesh.
MARGIN_TYPES = ("extend", "adjacent")
# Texels along the border of a UV map count or not by where their centers lie: less than this is no finding.
NOTED_SHARE_OUTSIDE = 0.01

Progress = Callable[[str, float], "bool | None"]


@dataclass(frozen=True)
class BakeOptions:
    """What to bake and how; None means as in the file."""

    scene: Path
    output: Path
    objects: tuple[str, ...] | str = "all"  # names, "selected" or "all"
    uv: str | None = None
    width: int = 1024
    height: int = 1024
    margin: int = 16  # texels
    margin_type: str = "extend"  # one of MARGIN_TYPES
    conservative: bool = False  # also texels that a triangle touches without covering their center
    view: tuple[float, float, float] | str = "camera"  # a position in m, "camera" or "above"
    techniques: tuple[str, ...] = ("ltsh4",)
    passes: tuple[str, ...] = ("specular", "diffuse")
    frame: int | None = None
    camera: str | None = None
    cycles_samples: int = 0  # 0: no Cycles bake and no error
    resume: bool = False  # keep what the same job has finished
    scripts: bool = False  # run those of the file
    apply: bool = False  # also a texture per object, and a .blend that shows it
    memory_mib: int = 0  # a bake that needs more is refused; 0: as the environment says, else what is free


def bake_scene(options: BakeOptions, progress: Progress | None = None) -> dict:
    """Bake the objects of a scene, write OUT/<object>.exr (<object>.<tile>.exr with several tiles), report.json and
    timing.json; return the report with the times as "seconds".

    An object that cannot be baked is named in the report under "problems"; the others are baked all the same. Nothing
    but timing.json depends on the machine's speed. Raises SceneError, TableError, OSError, Cancelled, ValueError.
    """
    check_memory(options)
    made = bake_objects(options, progress)
    document = made.report
    if options.apply and document["objects"]:
        document["applied"] = apply_textures(
            options.scene, options.output, document["objects"], applied_layer(options), progress
        )
    imaging.write_json(options.output / "report.json", document)
    imaging.write_json(options.output / "timing.json", {"seconds": made.seconds})
    return {**document, "seconds": made.seconds}


def bake_objects(
    options: BakeOptions,
    progress: Progress | None = None,
    *,
    stems: dict[str, str] | None = None,
    tile: int | None = None,
    following: tuple[str, ...] = (),
) -> Made:
    """Bake the objects and write their files, but no report.json; `stems` are the names of files by object, `tile` is
    the one UDIM tile that is wanted.

    In `kept_blender` the scene stays open for the next call with the same options: for objects that are named here, or
    announced as `following`. Raises as `bake_scene` does.
    """
    from ..blender.processes import child
    from ..blender.texels import bake_child

    start = time.perf_counter()
    _check(options)
    tables = compare.prepare(options)
    child.check_readable(options.scene)
    tiles = TileRecords(options, stems)
    with child.temporary_folder() as folder:
        job = replace(_job(options, tiles.finished), tile=tile, following=following)
        manifest = bake_child.extract_bake(job, folder, progress=progress)
        lights = tuple(AreaLight(**record) for record in manifest["lights"])
        names = [record["name"] for record in manifest["objects"]]
        found = [stems[name] for name in names] if stems else file_stems(names)
        records, files, seconds = [], [], {"blender": manifest["seconds"]}
        for record, stem in zip(manifest["objects"], found, strict=True):
            if record["problem"] is None:
                (options.output / stem).parent.mkdir(parents=True, exist_ok=True)
                baker = ObjectBaker(options, tables, lights, manifest, record, folder / record["folder"], tile)
                records.append(baker.bake(stem, tiles, files, seconds, progress))
                shutil.rmtree(folder / record["folder"])
    document = _report(options, manifest, records)
    seconds["total"] = time.perf_counter() - start
    return Made(document, seconds, tuple(files))


def check_memory(options: BakeOptions) -> None:
    """Raise SceneError where the bake of an object needs more memory than there may be."""
    from ..blender.processes import memory

    width, height = options.width, options.height
    reference = shading.REFERENCE in options.techniques
    shaded = block_rows(options) * width * (1 if reference else cores())
    written = min(block_rows(options) + 2 * options.margin, height) * width if options.margin else 0
    parts = memory.BakeParts(
        texels=min(shaded, width * height),
        channels=3 * len(options.techniques) * len(options.passes),
        margin_texels=written,
        compared=options.cycles_samples > 0,
    )
    memory.check_bake(f"{width}x{height} texels", parts, options.memory_mib)


class TileRecords:
    """Which tiles of objects the same job has finished (with `resume`), and those that follow.

    Where `stems`, names of files by object, are given, no others are looked at.
    """

    def __init__(self, options: BakeOptions, stems: dict[str, str] | None = None):
        self._records = Records(options.output, "tiles")
        self._key = options_digest("bake", options, contents_digest(options))
        names = None if stems is None else stems.values()
        whole = self._records.all_whole(self._key, names) if options.resume else []
        self.finished = {(record["task"]["object"], record["task"]["tile"]): record for record in whole}

    def take(self, name: str, tile: int, file: str) -> dict | None:
        """What was found for a finished tile of the object `name` in `file`, and its files; else None."""
        record = self.finished.get((name, tile))
        return record if record is not None and file in record["files"] else None

    def write(self, name: str, tile: int, stem: str, files, report: dict) -> dict:
        """Record that a tile is finished."""
        return self._records.write(f"{stem}.{tile}", self._key, {"object": name, "tile": tile}, files, report=report)


def _check(options: BakeOptions) -> None:
    for side in (options.width, options.height):
        if not SIZES[0] <= side <= SIZES[1]:
            raise ValueError(f"size is {options.width}x{options.height}, expected {SIZES[0]} to {SIZES[1]} each")
    if options.margin_type not in MARGIN_TYPES:
        raise ValueError(f"margin_type is {options.margin_type!r}, expected {' or '.join(MARGIN_TYPES)}")
    unknown = [name for name in options.passes if name not in BAKE_PASSES]
    if unknown or not options.passes:
        raise ValueError(f"passes are {list(options.passes)}, expected some of {', '.join(BAKE_PASSES)}")


def _job(options, finished):
    from ..blender.texels import bake_child

    shaded = tuple(name for name in ("specular", "diffuse") if name in shaded_passes(options))
    return bake_child.BakeJob(
        scene=options.scene,
        objects=options.objects,
        uv=options.uv,
        width=options.width,
        height=options.height,
        block_rows=block_rows(options),
        view=options.view,
        camera=options.camera,
        frame=options.frame,
        scripts=options.scripts,
        cycles_samples=options.cycles_samples,
        passes=shaded,
        finished=tuple(finished),
    )


def apply_textures(scene: Path, output: Path, records: list[dict], layer: str, progress=None) -> str:
    """Save the copy of the .blend whose objects show the textures of `records`, those of a report; its name."""
    from ..blender.texels import bake_child

    textures = []
    for record in records:
        files = [
            {"path": str((output / tile["texture"]).absolute()), "tile": int(number)}
            for number, tile in record["tiles"].items()
        ]
        name = f"{record['name']} {layer}"
        textures.append({"object": record["name"], "uv": record["uv"], "name": name, "files": files})
    path = output / f"{Path(scene).stem}_baked.blend"
    bake_child.apply_bake(scene, path, textures, progress=progress)
    return path.name


def _report(options, manifest, records) -> dict:
    problems = [record["problem"] for record in manifest["objects"] if record["problem"]]
    lines = [line for record in manifest["objects"] for line in record["warnings"]]
    warnings = list(dict.fromkeys([*manifest["warnings"], *lines]))
    for record in records:
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
    return {
        "scene": str(options.scene),
        "frame": manifest["frame"],
        "size": [options.width, options.height],
        "view": manifest["view"],
        "objects": records,
        "problems": problems,
        "warnings": warnings,
        "versions": compare.versions(manifest["blender_version"]),
    }
