"""Lighting baked into the texels of UV maps: a .blend in, one float EXR per object and tile out, and report.json."""

from __future__ import annotations

import shutil
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from . import compare, imaging, shading
from .imaging.exr_rows import writing_rows
from .imaging.margin import nearest_covered
from .scene import AreaLight, Cancelled, SurfaceSamples

BAKE_PASSES = ("specular", "diffuse", "diffuse_light", "combined")
SIZES = (64, 8192)
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


@dataclass
class _Result:
    """What is found out about one tile of one object."""

    covered: int = 0
    overlaps: int = 0
    seconds: float = 0.0
    files: list[str] = field(default_factory=list)


def bake_scene(options: BakeOptions, progress: Progress | None = None) -> dict:
    """Bake the objects of a scene, write OUT/<object>.exr (<object>.<tile>.exr with several tiles), return the report.

    An object that cannot be baked is named in the report under "problems"; the others are baked all the same. Raises
    SceneError, TableError, OSError, Cancelled, ValueError.
    """
    from .blender import child

    start = time.perf_counter()
    _check(options)
    tables = compare.prepare(options)
    with tempfile.TemporaryDirectory(prefix="ltsh-", ignore_cleanup_errors=True) as name:
        folder = Path(name)
        manifest = child.extract_bake(_job(options), folder, progress=progress)
        lights = tuple(AreaLight(**record) for record in manifest["lights"])
        stems = _file_stems([record["name"] for record in manifest["objects"]])
        records = []
        for record, stem in zip(manifest["objects"], stems, strict=True):
            if record["problem"] is None:
                baker = _ObjectBaker(options, tables, lights, manifest, record, folder / record["folder"])
                records.append(baker.bake(stem, progress))
                shutil.rmtree(folder / record["folder"])
    document = _report(options, manifest, records)
    document["seconds"]["total"] = time.perf_counter() - start
    imaging.write_json(options.output / "report.json", document)
    return document


def _check(options: BakeOptions) -> None:
    for side in (options.width, options.height):
        if not SIZES[0] <= side <= SIZES[1]:
            raise ValueError(f"size is {options.width}x{options.height}, expected {SIZES[0]} to {SIZES[1]} each")
    unknown = [name for name in options.passes if name not in BAKE_PASSES]
    if unknown or not options.passes:
        raise ValueError(f"passes are {list(options.passes)}, expected some of {', '.join(BAKE_PASSES)}")


def _block_rows(options) -> int:
    return max(1, min(options.height, BLOCK_TEXELS // options.width))


def _job(options):
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
        self.tiles, self.outside = uv_raster.tiles_of(self.mesh.uv)
        self.compared = tuple(name for name in options.passes if name in _shaded_passes(options) | {"combined"})
        if not options.cycles_samples:
            self.compared = ()
        self._sample, self._raster = texel_samples.texel_samples, uv_raster.UvTriangles

    def bake(self, stem: str, progress) -> dict:
        """Write the files of the object; its record for the report."""
        result = {"name": self.record["name"], "uv": self.record["uv"], "outside": self.outside, "tiles": {}}
        for tile in self.tiles:
            name = stem if len(self.tiles) == 1 else f"{stem}.{tile}"
            path = self.options.output / f"{name}.exr"
            result["tiles"][str(tile)] = {"file": path.name, **self._tile(tile, path, progress)}
        return result

    def _tile(self, tile, path, progress):
        options = self.options
        width, height, rows = options.width, options.height, _block_rows(options)
        triangles = self._raster.in_tile(self.mesh.uv, width, height, ((tile - 1001) % 10, (tile - 1001) // 10))
        result, start = _Result(), time.perf_counter()
        planes = _Planes(self.folder / f"planes_{tile}", self.channels(), width, height)
        firsts = range(0, height, rows)
        for number, first in enumerate(firsts):

            def report(fraction, number=number):
                whole = (number + fraction) / len(firsts)
                return None if progress is None else progress(f"shade {self.record['name']}", whole)

            if report(0.0) is False:
                raise Cancelled("the bake was stopped")
            count = min(rows, height - first)
            texels = triangles.texels(first, count, options.conservative)
            result.covered += len(texels.index)
            result.overlaps += texels.overlaps
            planes.put(first, count, texels.index, self._block(tile, first, texels, report))
        planes.write(path, options.margin, self._metadata(tile))
        return {
            "texels": result.covered,
            "overlapping_texels": result.overlaps,
            "seconds": time.perf_counter() - start,
        }

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

    def _block(self, tile, first, texels, report) -> dict[str, np.ndarray]:
        """Values (Q,) of the channels at the texels (Q) of a block."""
        maps = None
        if self.record["maps"]:
            maps = np.load(self.folder / f"maps_{tile}_{first}.npy")

        def read_map(number):
            return maps[number].reshape(-1, 3)[texels.index]

        samples, texel = self._sample(self.mesh, self.materials, texels, read_map, self.view)
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
        self._compare(tile, first, texels, values)
        return values

    def _compare(self, tile, first, texels, values) -> None:
        """Add Cycles' bake of the same texels, and what the techniques have more than it."""
        halves = {}
        for pass_name in self.compared:
            if pass_name == "combined":
                halves[pass_name] = halves["specular"] + halves["diffuse"]
                continue
            baked = np.load(self.folder / f"cycles_{pass_name}_{tile}_{first}.npy")
            halves[pass_name] = baked.reshape(2, -1, 3)[:, texels.index]
        for pass_name, (a, b) in halves.items():
            mean = 0.5 * (a + b)
            for image, pixels in (("cycles", mean), ("cycles_A", a), ("cycles_B", b)):
                _put(values, f"{image}.{pass_name}", pixels)
            for name in self.tables:
                shaded = np.stack([values[f"{name}.{pass_name}.{letter}"] for letter in "RGB"], axis=-1)
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
        seen = {"above": "above the surface", "point": f"position {view.vector}", "direction": f"from {view.vector}"}
        return {
            "ltsh:scene": Path(options.scene).name,
            "ltsh:object": self.record["name"],
            "ltsh:uv": self.record["uv"],
            "ltsh:tile": str(tile),
            "ltsh:frame": str(self.manifest["frame"]),
            "ltsh:view": seen[view.kind] + (", bent as in Cycles' bake" if view.bent else ""),
            "ltsh:camera": self.manifest["camera"],
            "ltsh:version": compare.versions(self.manifest["blender_version"])["ltsh"],
        }


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


class _Planes:
    """Channels of an image as files, so that only some rows of them need be in memory. Row 0 is below."""

    def __init__(self, folder: Path, names: list[str], width: int, height: int):
        folder.mkdir()
        self.names, self.shape = names, (height, width)
        self.coverage = np.zeros((height, width), dtype=bool)
        self._paths = {name: folder / f"{number}.bin" for number, name in enumerate(names)}
        self._files = {name: path.open("w+b") for name, path in self._paths.items()}

    def put(self, first: int, count: int, index, values) -> None:
        """Rows from `first`: `values` by channel at the texels `index`."""
        width = self.shape[1]
        self.coverage[first : first + count].reshape(-1)[index] = True
        for name, file in self._files.items():
            rows = np.zeros(count * width, np.float32)
            rows[index] = values[name]
            file.seek(4 * first * width)
            file.write(rows.tobytes())

    def _rows(self, name, first, last):
        file, width = self._files[name], self.shape[1]
        file.seek(4 * first * width)
        return np.frombuffer(file.read(4 * (last - first) * width), np.float32).reshape(-1, width)

    def write(self, path: Path, margin: int, metadata) -> None:
        """Write the EXR with the margin filled, and close the files."""
        height, width = self.shape
        rows = max(1, BLOCK_TEXELS // width)
        with writing_rows(path, [*self.names, "coverage.hit.V"], width, height, metadata) as writer:
            for top in range(height, 0, -rows):
                bottom = max(top - rows, 0)
                low, high = max(bottom - margin, 0), min(top + margin, height)
                target, source = nearest_covered(self.coverage[low:high], margin)
                inside = (target >= (bottom - low) * width) & (target < (top - low) * width)
                target, source = target[inside] - (bottom - low) * width, source[inside]
                block = {"coverage.hit.V": self.coverage[bottom:top][::-1].astype(np.float32)}
                for name in self.names:
                    around = self._rows(name, low, high)
                    plane = around[bottom - low : top - low].copy()
                    plane.reshape(-1)[target] = around.reshape(-1)[source]
                    block[name] = plane[::-1]
                writer.write(block)
        for name, file in self._files.items():
            file.close()
            self._paths[name].unlink()


def _report(options, manifest, records) -> dict:
    problems = [record["problem"] for record in manifest["objects"] if record["problem"]]
    warnings = list(manifest["warnings"])
    for record in records:
        if record["outside"] > 0.0:
            share = f"{100 * record['outside']:.2g} %"
            warnings.append(
                f"object {record['name']!r}: {share} of UV map {record['uv']!r} lies outside of the texture, not baked"
            )
        for tile in record["tiles"].values():
            share = tile["overlapping_texels"] / max(tile["texels"], 1)
            if share > 0.0:
                warnings.append(f"object {record['name']!r}: {100 * share:.2g} % of its texels are covered twice")
    return {
        "scene": str(options.scene),
        "frame": manifest["frame"],
        "size": [options.width, options.height],
        "view": manifest["view"],
        "objects": records,
        "problems": problems,
        "warnings": warnings,
        "versions": compare.versions(manifest["blender_version"]),
        "seconds": {"blender": manifest["seconds"]},
    }
