"""Lighting baked into the texels of UV maps: a .blend in, one float EXR per object and tile out, and report.json."""

from __future__ import annotations

import shutil
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from . import compare, imaging
from .bake_object import ObjectBaker, applied_layer, block_rows, shaded_passes
from .bake_resume import finished_tiles, job_key
from .scene import AreaLight

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
    apply: bool = False  # also a texture per object, and a .blend that shows it


def bake_scene(options: BakeOptions, progress: Progress | None = None) -> dict:
    """Bake the objects of a scene, write OUT/<object>.exr (<object>.<tile>.exr with several tiles), report.json and
    timing.json; return the report with the times as "seconds".

    An object that cannot be baked is named in the report under "problems"; the others are baked all the same. Nothing
    but timing.json depends on the machine's speed. Raises SceneError, TableError, OSError, Cancelled, ValueError.
    """
    from .blender import bake_child, child

    start = time.perf_counter()
    _check(options)
    tables = compare.prepare(options)
    child.check_readable(options.scene)
    key = job_key(options)
    finished = finished_tiles(options.output, key) if options.resume else {}
    with tempfile.TemporaryDirectory(prefix="ltsh-", ignore_cleanup_errors=True) as name:
        folder = Path(name)
        manifest = bake_child.extract_bake(_job(options, finished), folder, progress=progress)
        lights = tuple(AreaLight(**record) for record in manifest["lights"])
        stems = _file_stems([record["name"] for record in manifest["objects"]])
        records, seconds = [], {"blender": manifest["seconds"]}
        for record, stem in zip(manifest["objects"], stems, strict=True):
            if record["problem"] is None:
                baker = ObjectBaker(options, tables, lights, manifest, record, folder / record["folder"])
                records.append(baker.bake(stem, key, finished, seconds, progress))
                shutil.rmtree(folder / record["folder"])
    document = _report(options, manifest, records)
    if options.apply and records:
        document["applied"] = _apply(options, tables, records, progress)
    imaging.write_json(options.output / "report.json", document)
    seconds["total"] = time.perf_counter() - start
    imaging.write_json(options.output / "timing.json", {"seconds": seconds})
    return {**document, "seconds": seconds}


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
    from .blender import bake_child

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
        cycles_samples=options.cycles_samples,
        passes=shaded,
        finished=tuple(finished),
    )


def _file_stems(names: list[str]) -> list[str]:
    """A file name for each object: only letters that every file system takes, each once."""
    stems = []
    for name in names:
        stem = "".join(letter if letter.isalnum() or letter in " -_" else "_" for letter in name).strip() or "object"
        candidate, number = stem[:100], 1
        while candidate.casefold() in {other.casefold() for other in stems}:
            number += 1
            candidate = f"{stem[:100]}_{number}"
        stems.append(candidate)
    return stems


def _apply(options, tables, records, progress) -> str:
    """Save the .blend that shows the textures; its name."""
    from .blender import bake_child

    textures = []
    for record in records:
        files = [
            {"path": str((options.output / tile["texture"]).absolute()), "tile": int(number)}
            for number, tile in record["tiles"].items()
        ]
        name = f"{record['name']} {applied_layer(options, tables)}"
        textures.append({"object": record["name"], "uv": record["uv"], "name": name, "files": files})
    path = options.output / f"{Path(options.scene).stem}_baked.blend"
    bake_child.apply_bake(options.scene, path, textures, progress=progress)
    return path.name


def _report(options, manifest, records) -> dict:
    problems = [record["problem"] for record in manifest["objects"] if record["problem"]]
    warnings = list(manifest["warnings"])
    for record in records:
        if record["outside"] > NOTED_SHARE_OUTSIDE:
            share = f"{100 * record['outside']:.3g} %"
            warnings.append(
                f"object {record['name']!r}: {share} of UV map {record['uv']!r} lies outside of the texture, not baked"
            )
        for tile in record["tiles"].values():
            share = tile["overlapping_texels"] / max(tile["texels"], 1)
            if share > 0.0:
                warnings.append(f"object {record['name']!r}: {100 * share:.3g} % of its texels are covered twice")
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
