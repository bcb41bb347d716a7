"""Lighting baked into the texels of UV maps: a .blend in, one float EXR per object and tile out, and report.json."""

from __future__ import annotations

import json
import shutil
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from . import compare, imaging, shading
from .bake_errors import ErrorPictures, ErrorSums
from .bake_planes import Planes
from .bake_resume import finished_tiles, job_key, job_metadata
from .scene import AreaLight, Cancelled, SurfaceSamples

BAKE_PASSES = ("specular", "diffuse", "diffuse_light", "combined")
SIZES = (64, 8192)
# Texels along the border of a UV map count or not by where their centers lie: less than this is no finding.
NOTED_SHARE_OUTSIDE = 0.01
# Texels that are shaded at a time.
BLOCK_TEXELS = 1 << 20

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
    from .blender import child

    start = time.perf_counter()
    _check(options)
    tables = compare.prepare(options)
    child.check_readable(options.scene)
    key = job_key(options)
    finished = finished_tiles(options.output, key) if options.resume else {}
    with tempfile.TemporaryDirectory(prefix="ltsh-", ignore_cleanup_errors=True) as name:
        folder = Path(name)
        manifest = child.extract_bake(_job(options, finished), folder, progress=progress)
        lights = tuple(AreaLight(**record) for record in manifest["lights"])
        stems = _file_stems([record["name"] for record in manifest["objects"]])
        records, seconds = [], {"blender": manifest["seconds"]}
        for record, stem in zip(manifest["objects"], stems, strict=True):
            if record["problem"] is None:
                baker = _ObjectBaker(options, tables, lights, manifest, record, folder / record["folder"])
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
    unknown = [name for name in options.passes if name not in BAKE_PASSES]
    if unknown or not options.passes:
        raise ValueError(f"passes are {list(options.passes)}, expected some of {', '.join(BAKE_PASSES)}")


def _block_rows(options) -> int:
    return max(1, min(options.height, BLOCK_TEXELS // options.width))


def _job(options, finished):
    from .blender import child

    shaded = tuple(name for name in ("specular", "diffuse") if name in _shaded_passes(options))
    return child.BakeJob(
        scene=options.scene,
        objects=options.objects,
        uv=options.uv,
        width=options.width,
        height=options.height,
        block_rows=_block_rows(options),
        view=options.view,
        camera=options.camera,
        frame=options.frame,
        cycles_samples=options.cycles_samples,
        passes=shaded,
        finished=tuple(finished),
    )


def _shaded_passes(options) -> set[str]:
    """Passes of `shading.shade` that the wanted ones are made of."""
    wanted = set(options.passes)
    if "combined" in wanted:
        wanted |= {"specular", "diffuse"}
    return wanted & {"specular", "diffuse"}


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


class _ObjectBaker:
    """Bakes all tiles of one object, block of rows by block of rows from the top."""

    def __init__(self, options, tables, lights, manifest, record, folder):
        from .blender import texel_samples, uv_raster

        self.options, self.tables, self.lights, self.record, self.folder = options, tables, lights, record, folder
        self.mesh = texel_samples.TexelMesh.load(folder / "mesh.npz")
        self.materials = [texel_samples.BakeMaterial.of(material) for material in record["materials"]]
        self.view = texel_samples.BakeView(**manifest["view"])
        self.manifest = manifest
        self.groups = tuple(dict.fromkeys(light.group for light in lights)) or ("",)
        self.tiles, self.area = uv_raster.tiles_of(self.mesh.uv)
        self.compared = tuple(name for name in options.passes if name in _shaded_passes(options) | {"combined"})
        if not options.cycles_samples:
            self.compared = ()
        self._sample, self._raster = texel_samples.texel_samples, uv_raster.UvTriangles

    def bake(self, stem: str, key: str, finished: dict, seconds: dict, progress) -> dict:
        """Write the files of the object that are not `finished`; its record for the report."""
        result = {"name": self.record["name"], "uv": self.record["uv"], "outside": 0.0, "tiles": {}}
        for tile in self.tiles:
            path = self.options.output / f"{stem}{self._suffix(tile)}.exr"
            start = time.perf_counter()
            record = finished.get((self.record["name"], tile)) or self._tile(tile, path, key, progress)
            seconds[path.name] = time.perf_counter() - start
            # The order of a record that was read back.
            result["tiles"][str(tile)] = {"file": path.name, **json.loads(json.dumps(record, sort_keys=True))}
            if self.area > 0.0:
                baked = (record["texels"] + record["overlapping_texels"]) / (self.options.width * self.options.height)
                result["outside"] = max(0.0, 1.0 - baked / self.area)
        return result

    def _suffix(self, tile) -> str:
        return "" if len(self.tiles) == 1 else f".{tile}"

    def _tile(self, tile, path, key, progress):
        """Write the file of one tile; its record."""
        options = self.options
        errors = ErrorSums()
        with Planes(self.folder / f"planes_{tile}", self.channels(), options.width, options.height) as planes:
            record = self._shade(tile, planes, errors, progress)
            pictures = None
            if self.compared:
                size = options.width, options.height
                pictures = ErrorPictures(*size, path, list(self.tables), list(self.compared))
                record |= {"pictures": pictures.names, "errors": errors.report()}
            texture = None
            if options.apply:
                layer = applied_layer(options, self.tables)
                record["texture"] = f"{path.stem.removesuffix(f'.{tile}')}.{layer}{self._suffix(tile)}.exr"
                texture = path.with_name(record["texture"]), layer
            metadata = self._metadata(tile) | job_metadata(key, record)
            planes.write(path, options.margin, metadata, pictures, texture)
        return record

    def _shade(self, tile, planes, errors, progress) -> dict:
        """Shade a tile block by block into `planes`; how many texels there were."""
        options, covered, overlaps = self.options, 0, 0
        rows, place = _block_rows(options), ((tile - 1001) % 10, (tile - 1001) // 10)
        triangles = self._raster.in_tile(self.mesh.uv, options.width, options.height, place)
        firsts = range(0, options.height, rows)
        for number, first in enumerate(firsts):

            def report(fraction, number=number):
                whole = (number + fraction) / len(firsts)
                return None if progress is None else progress(f"shade {self.record['name']}", whole)

            if report(0.0) is False:
                raise Cancelled("the bake was stopped")
            count = min(rows, options.height - first)
            texels = triangles.texels(first, count, options.conservative)
            covered += len(texels.index)
            overlaps += texels.overlaps
            planes.put(first, count, texels.index, self._block(tile, first, texels, errors, report))
        return {"texels": covered, "overlapping_texels": overlaps}

    def channels(self) -> list[str]:
        """Names of the channels of the EXR but for the coverage."""
        layers = [f"{name}.{pass_name}" for name in self.tables for pass_name in self.options.passes]
        if len(self.groups) > 1:
            names = [group or "ungrouped" for group in self.groups]
            layers += [f"{layer}@{group}" for layer in layers for group in names]
        for pass_name in self.compared:
            layers += [f"{image}.{pass_name}" for image in ("cycles", "cycles_A", "cycles_B")]
            layers += [f"error_{name}.{pass_name}" for name in self.tables]
        return [f"{layer}.{letter}" for layer in layers for letter in "RGB"]

    def _block(self, tile, first, texels, errors, report) -> dict[str, np.ndarray]:
        """Values (Q,) of the channels at the texels (Q) of a block."""
        maps = None
        if self.record["maps"]:
            maps = np.load(self.folder / f"maps_{tile}_{first}.npy")

        def read_map(number):
            return maps[number].reshape(-1, 3)[texels.index]

        receiver = self.record["receiver"]
        samples, texel = self._sample(self.mesh, self.materials, texels, read_map, self.view, self.lights, receiver)
        values = {}
        for order, (name, table) in enumerate(self.tables.items()):

            def progress(fraction, order=order):
                return report((order + fraction) / len(self.tables))

            for pass_name, radiance in self._passes(samples, texel, len(texels.index), table, progress).items():
                groups = [("", radiance.sum(axis=0))]
                if len(self.groups) > 1:
                    groups += [
                        (f"@{group or 'ungrouped'}", part) for group, part in zip(self.groups, radiance, strict=True)
                    ]
                for suffix, image in groups:
                    _put(values, f"{name}.{pass_name}{suffix}", image)
        self._compare(tile, first, texels, values, errors)
        return values

    def _compare(self, tile, first, texels, values, errors) -> None:
        """Add Cycles' bake of the same texels, and what the techniques have more than it."""
        halves = {}
        for pass_name in _shaded_passes(self.options) if self.compared else ():
            baked = np.load(self.folder / f"cycles_{pass_name}_{tile}_{first}.npy")
            halves[pass_name] = baked.reshape(2, -1, 3)[:, texels.index]
        if "combined" in self.compared:
            halves["combined"] = halves["specular"] + halves["diffuse"]
        for pass_name in self.compared:
            a, b = halves[pass_name]
            mean = 0.5 * (a + b)
            errors.add_halves(pass_name, a, b)
            for image, pixels in (("cycles", mean), ("cycles_A", a), ("cycles_B", b)):
                _put(values, f"{image}.{pass_name}", pixels)
            for name in self.tables:
                shaded = np.stack([values[f"{name}.{pass_name}.{letter}"] for letter in "RGB"], axis=-1)
                errors.add(name, pass_name, shaded, a, b)
                _put(values, f"error_{name}.{pass_name}", shaded - mean)

    def _passes(self, samples: SurfaceSamples, texel, count, table, progress) -> dict[str, np.ndarray]:
        """Radiance (G, Q, 3) of the wanted passes of `count` texels."""
        found = {}
        wanted = tuple(sorted(_shaded_passes(self.options), reverse=True))
        if wanted:
            shaded = shading.shade(samples, self.lights, table, passes=wanted, progress=progress)
            found = {name: _summed(getattr(shaded, name), texel, count) for name in wanted}
        if "diffuse_light" in self.options.passes:
            first = np.flatnonzero(np.concatenate([[True], texel[1:] != texel[:-1]])) if len(texel) else texel
            white = replace(samples.take(first), diffuse_albedo=np.ones((len(first), 3)))
            light = shading.shade(white, self.lights, table, passes=("diffuse",), progress=progress).diffuse
            found["diffuse_light"] = _summed(light, texel[first], count)
        if "combined" in self.options.passes:
            found["combined"] = found["specular"] + found["diffuse"]
        return {name: found[name] for name in self.options.passes}

    def _metadata(self, tile) -> dict[str, str]:
        options, view = self.options, self.view
        vector = ", ".join(f"{value:g}" for value in view.vector)
        seen = {"above": "above the surface", "point": f"position {vector}", "direction": f"from direction {vector}"}
        return {
            "ltsh:scene": Path(options.scene).name,
            "ltsh:object": self.record["name"],
            "ltsh:uv": self.record["uv"],
            "ltsh:tile": str(tile),
            "ltsh:frame": str(self.manifest["frame"]),
            "ltsh:view": seen[view.kind] + (", bent as in Cycles' bake" if view.bent else ""),
            "ltsh:camera": self.manifest["camera"],
            "ltsh:color_space": self.manifest["color_space"]["name"] or "Linear Rec.709",
            "ltsh:version": compare.versions(self.manifest["blender_version"])["ltsh"],
        }


def applied_layer(options: BakeOptions, tables) -> str:
    """The layer that `apply` puts to use: of the first technique all light where it was asked for."""
    pass_name = "combined" if "combined" in options.passes else options.passes[0]
    return f"{next(iter(tables))}.{pass_name}"


def _apply(options, tables, records, progress) -> str:
    """Save the .blend that shows the textures; its name."""
    from .blender import child

    textures = []
    for record in records:
        files = [
            {"path": str((options.output / tile["texture"]).absolute()), "tile": int(number)}
            for number, tile in record["tiles"].items()
        ]
        name = f"{record['name']} {applied_layer(options, tables)}"
        textures.append({"object": record["name"], "uv": record["uv"], "name": name, "files": files})
    path = options.output / f"{Path(options.scene).stem}_baked.blend"
    child.apply_bake(options.scene, path, textures, progress=progress)
    return path.name


def _put(values: dict, layer: str, pixels) -> None:
    """Add the channels of a layer (Q, 3)."""
    for channel, letter in enumerate("RGB"):
        values[f"{layer}.{letter}"] = pixels[:, channel]


def _summed(radiance, texel, count):
    """Radiance (G, count, 3) of texels from that of their samples (G, S, 3)."""
    if len(texel) == count:
        return radiance
    first = np.flatnonzero(np.concatenate([[True], texel[1:] != texel[:-1]])) if len(texel) else texel
    return np.add.reduceat(radiance, first, axis=1)


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
