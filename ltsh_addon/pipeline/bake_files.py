"""Files of a bake: planes of texels with margins, pictures of errors, the .blend and .glb that show
them."""

import json
import math
import struct
from contextlib import ExitStack
from copy import deepcopy
from dataclasses import replace
from pathlib import Path

import numpy as np

from .. import imaging
from ..files import temporary_folder, write_bytes
from ..imaging import exr
from ..imaging.exr import COMBINED, layer_name, parse_layer_name, writing_rows
from ..imaging.seams import SeamFit, nearest_covered
from ..reading import NUMBER, file_name
from ..scene import PASSES, listed
from .comparison import percent
from .lighting import technique_names

# WRITTEN_TEXELS: texels that are in memory while a file is written.
WRITTEN_TEXELS = 1 << 18
COVERAGE = "coverage.hit.V"
LARGEST_PICTURE = 2048  # the most texels of a side of an error picture
# PICTURE_SCALE: the ends of the color scale of an error picture, as a share of the radiance of Cycles' brightest
# texels, their percentile PICTURE_PERCENTILE.
PICTURE_SCALE = 0.1
PICTURE_PERCENTILE = 99.0
EMPTY_COLOR = 0.55
_ERRORS = {"unbiased_squared_error?": NUMBER | None, "unbiased_error?": NUMBER | None}
TILE = {
    **dict.fromkeys(("texels", "unshaded_texels", "unbaked_texels", "covered_times", "overlapping_texels"), NUMBER),
    "is_lit": bool,
    "member_texels?": {str: NUMBER},
    "texture?": file_name,
    "denoiser?": str,
    "dull_texels?": NUMBER,
    "errors?": {str: {"noise?": NUMBER | None, "techniques": {str: _ERRORS}}},
}


class Planes:
    """Context: the channels of an image as files, so that memory holds only some rows. Row 0 is at the bottom."""

    def __init__(self, folder: Path, names: list[str], width: int, height: int):
        folder.mkdir()
        self.names, self.shape = names, (height, width)
        # One bit per texel: the only data of the whole image in memory.
        self._covered = np.zeros((height, -(-width // 8)), dtype=np.uint8)
        self._beyond_seams: np.ndarray | None = None  # as `_covered`: texels of the margin that `fit` has set
        self._paths = {name: folder / f"{number}.bin" for number, name in enumerate(names)}
        self._files = {name: path.open("w+b") for name, path in self._paths.items()}

    def __enter__(self):
        return self

    def __exit__(self, *exception):
        for name, file in self._files.items():
            file.close()
            self._paths[name].unlink()

    def put(self, first: int, count: int, texels, values) -> None:
        """Store `count` rows from `first`: `values` by channel at the `texels` (Texels), 0 elsewhere."""
        width = self.shape[1]
        covered = np.zeros((count, width), dtype=bool)
        covered.reshape(-1)[texels.index] = True
        self._covered[first : first + count] = np.packbits(covered, axis=1)
        for name, file in self._files.items():
            rows = np.zeros(count * width, np.float32)
            rows[texels.index] = values[name]
            file.seek(4 * first * width)
            file.write(rows)

    def coverage(self, first: int, last: int) -> np.ndarray:
        """Mask (last - first, W) of the texels that were put."""
        return np.unpackbits(self._covered[first:last], axis=1, count=self.shape[1]).view(bool)

    def fit(self, seams: SeamFit, *, is_sum: bool) -> None:
        """Let light, as far as it is not an error or Cycles' own, fit at smooth seams; the margin there goes on.

        `is_sum`: light of which that of each light is kept is the sum of these.
        """
        height, width = self.shape
        layers = list(dict.fromkeys(name.rpartition(".")[0] for name in self.names))
        for layer in sorted(layers, key=lambda layer: "@" not in layer):
            names = [f"{layer}.{letter}" for letter in "RGB"]
            of_lights = [one for one in layers if is_sum and one.startswith(f"{layer}@")]
            image = sum(map(self._image, of_lights)) if of_lights else self._image(layer)
            if not of_lights:
                seams.fit(image, changed=not layer.startswith((exr.ERROR, *exr.CYCLES_LAYERS)))
            for name, plane in zip(names, np.moveaxis(image, -1, 0), strict=True):
                self._files[name].seek(0)
                self._files[name].write(np.ascontiguousarray(plane))
        margin = np.zeros(height * width, bool)
        margin[seams.margin] = True
        self._beyond_seams = np.packbits(margin.reshape(height, width), axis=1)

    def _image(self, layer: str) -> np.ndarray:
        """The image (H, W, 3) of a layer."""
        return np.stack([self._rows(f"{layer}.{letter}", 0, self.shape[0]) for letter in "RGB"], axis=-1)

    def _known(self, first: int, last: int) -> np.ndarray:
        """Mask (last - first, W) of the texels that have values."""
        known = self._covered if self._beyond_seams is None else self._covered | self._beyond_seams
        return np.unpackbits(known[first:last], axis=1, count=self.shape[1]).view(bool)

    def _rows(self, name, first, last):
        file, width = self._files[name], self.shape[1]
        file.seek(4 * first * width)
        return np.frombuffer(file.read(4 * (last - first) * width), np.float32).reshape(-1, width)

    def write(self, path: Path, margin: int, header: tuple, pictures, texture=None) -> None:
        """Write the EXR with its margin filled, the ErrorPictures `pictures` (or None), and the `texture`.

        `header` is the metadata, and the names of the channels that become half floats.
        `texture` is (path, layers): an EXR with the sum of these layers. None: no texture.
        """
        (height, width), (metadata, half) = self.shape, header
        rows = max(1, WRITTEN_TEXELS // width)
        for file in self._files.values():
            file.flush()
        with ExitStack() as files:
            # The files take their names in reverse order, the large one last: with it the tile counts as finished.
            writer = files.enter_context(
                writing_rows(path, [*self.names, COVERAGE], (width, height), metadata, half=half)
            )
            small = None
            if texture is not None:
                small = files.enter_context(writing_rows(texture[0], "RGB", (width, height), metadata))
            for top in range(height, 0, -rows):
                bottom = max(top - rows, 0)
                block = self._filled(bottom, top, margin)
                writer.write(block)
                if small is not None:
                    small.write({letter: sum(block[f"{layer}.{letter}"] for layer in texture[1]) for letter in "RGB"})
                if pictures is not None:
                    pictures.add(height - top, block)
            if pictures is not None:
                pictures.write()

    def _filled(self, bottom, top, margin) -> dict[str, np.ndarray]:
        """Rows `bottom` to `top` of all channels by name, margin filled, flipped so that row 0 is on top."""
        height, width = self.shape
        low, high = max(bottom - margin, 0), min(top + margin, height)
        target, source = nearest_covered(self._known(low, high), margin)
        inside = (target >= (bottom - low) * width) & (target < (top - low) * width)
        target, source = target[inside] - (bottom - low) * width, source[inside]
        block = {COVERAGE: self.coverage(bottom, top)[::-1].astype(np.float32)}
        for name in self.names:
            around = self._rows(name, low, high)
            plane = around[bottom - low : top - low].copy()
            plane.reshape(-1)[target] = around.reshape(-1)[source]
            block[name] = plane[::-1]
        return block


class ErrorSums:
    """Sums over texels that give the figures of `imaging.metrics`."""

    def __init__(self):
        self._products: dict[tuple[str, str], np.ndarray] = {}
        self._halves: dict[str, np.ndarray] = {}

    def add_halves(self, pass_name: str, a: np.ndarray, b: np.ndarray) -> None:
        """Add two independent halves (Q, 3) of Cycles' bake."""
        a, b = a.astype(np.float64), b.astype(np.float64)
        sums = np.array([(a * b).sum(), ((a - b) ** 2).sum(), ((a + b) ** 2).sum(), 0.5 * (a + b).sum()])
        self._halves[pass_name] = self._halves.get(pass_name, 0.0) + sums

    def add(self, name: str, pass_name: str, shaded: np.ndarray, a: np.ndarray, b: np.ndarray) -> None:
        """Add the radiance `shaded` (Q, 3) of a technique at the same texels."""
        shaded, a, b = (values.astype(np.float64) for values in (shaded, a, b))
        sums = np.array([((shaded - a) * (shaded - b)).sum(), shaded.sum()])
        self._products[name, pass_name] = self._products.get((name, pass_name), 0.0) + sums

    def report(self) -> dict:
        """Per pass: the noise of Cycles, and for each technique its bias and its error without that noise."""
        report = {}
        for pass_name, (norm, difference, total, light) in self._halves.items():
            techniques = {}
            for (name, of_pass), (product, shaded) in self._products.items():
                if of_pass == pass_name:
                    squared = product / norm if norm > 0.0 else 0.0
                    techniques[name] = {
                        "unbiased_error": math.sqrt(max(squared, 0.0)) if norm > 0.0 else None,
                        "unbiased_squared_error": squared,
                        "bias": shaded / light - 1.0 if light > 0.0 else None,
                    }
            noise = math.sqrt(difference / total) if total > 0.0 else None
            report[pass_name] = {"noise": noise, "techniques": techniques}
        return report


class ErrorPictures:
    """PNGs of the errors beside the EXR `path`, of every n-th texel: red too bright, blue too dark, gray not baked."""

    def __init__(self, width: int, height: int, path: Path, techniques: list[str], passes: list[str]):
        self.folder = path.parent
        self.step = max(1, -(-max(width, height) // LARGEST_PICTURE))
        layers = [(f"error_{name}.{pass_name}", pass_name) for pass_name in passes for name in techniques]
        self._pictures = {f"{path.stem}.{layer}.png": (layer, pass_name) for layer, pass_name in layers}
        self._rows: dict[str, dict[int, np.ndarray]] = {}

    @property
    def names(self) -> list[str]:
        """Names of the files."""
        return list(self._pictures)

    def add(self, first: int, planes: dict[str, np.ndarray]) -> None:
        """Add rows (R, W) of the EXR's channels, from row `first` counted from the top."""
        picked = slice(-first % self.step, None, self.step), slice(None, None, self.step)
        for error, pass_name in self._pictures.values():
            for layer in (error, f"cycles.{pass_name}"):
                pixels = np.stack([planes[f"{layer}.{letter}"][picked] for letter in "RGB"], axis=-1)
                self._rows.setdefault(layer, {})[first] = pixels
        self._rows.setdefault("coverage", {})[first] = planes["coverage.hit.V"][picked]

    def write(self) -> None:
        """Write the files."""
        images = {layer: np.concatenate(list(rows.values())) for layer, rows in self._rows.items()}
        covered = images["coverage"] > 0.0
        for name, (layer, pass_name) in self._pictures.items():
            brightness = images[f"cycles.{pass_name}"].max(axis=-1)[covered]
            scale = PICTURE_SCALE * float(np.percentile(brightness, PICTURE_PERCENTILE)) if brightness.size else 0.0
            colors = imaging.signed_error_colors(images[layer], scale or 1.0)
            colors[~covered] = EMPTY_COLOR
            imaging.write_png(self.folder / name, np.round(255.0 * colors).astype(np.uint8))


def applied_layer(options) -> str:
    """The layer that `apply` shows: the first technique's combined light, or its first pass where only one is baked."""
    names = applied_layers(options)
    return names[0] if len(names) == 1 else layer_name(parse_layer_name(names[0])[0], COMBINED)


def applied_layers(options) -> list[str]:
    """The layers whose sum `apply` shows."""
    passes = [name for name in PASSES if name in options.passes]
    if COMBINED in options.passes or len(passes) < len(PASSES):
        passes = [COMBINED] if COMBINED in options.passes else options.passes[:1]
    return [layer_name(next(iter(technique_names(options.techniques))), pass_name) for pass_name in passes]


def bake_members(record: dict) -> list[str]:
    """The names of the objects that a record of the report is about."""
    return list(record.get("members", [record["name"]]))


def apply_textures(scene: Path, output: Path, report: dict, layer: str, progress=None) -> str:
    """Save a copy of the .blend whose objects show the textures of a bake's `report`; returns its file name."""
    from ..blender.process.bake import ApplyJob, BakedTextures, apply_bake

    textures = []
    for record in report["objects"]:
        if any("texture" not in tile for tile in record["tiles"].values()):
            raise ValueError(f"object {record['name']!r}: has no texture to show; run the job again with --apply")
        files = [
            {"path": str((output / tile["texture"]).absolute()), "tile": int(number)}
            for number, tile in record["tiles"].items()
        ]
        name = f"{record['name']} {layer}"
        textures.append(BakedTextures(bake_members(record), record["uv"], name, files))
    path = output / f"{Path(scene).stem}_baked.blend"
    atlas = report["objects"][0].get("atlas")
    apply_bake(ApplyJob(scene, path, textures, report["frame"], atlas), progress=progress)
    return path.name


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


def darkness(record, reasons) -> tuple[list[str], list[str]]:
    """Problems and warnings of a dark object: most of its texels are not shaded, for `reasons`, or no light arrives."""
    tiles, name = record["tiles"].values(), f"object {record['name']!r}"
    texels, unshaded = (sum(tile[key] for tile in tiles) for key in ("texels", "unshaded_texels"))
    if 2 * unshaded > texels:
        share = f"{100.0 * unshaded / texels:.3g} %"
        return [f"{name}: {share} of its texels are not shaded: {listed(dict.fromkeys(filter(None, reasons)))}"], []
    is_dark = texels > 0 and not any(tile["is_lit"] for tile in tiles)
    return [], [f"{name}: no light reaches it, or it reflects none: its texture is black"] if is_dark else []


# Bakes for engines, see docs/lightmaps.md: glTF has no lightmaps of its own, so `extras` of nodes name them.

LIGHT = "diffuse_light"
# The chunks of a .glb: its JSON, and its data (glTF 2.0, section 4.4).
_HEADER, _CHUNK = struct.Struct("<4sII"), struct.Struct("<I4s")


def exported_layers(options) -> dict[str, list[str]]:
    """The layers whose sum a .glb takes, by what it is: "lightmap", "unlit"; an empty list where none is baked."""
    name = next(iter(technique_names(options.techniques)))
    others = tuple(kind for kind in options.passes if kind != LIGHT)
    colors = applied_layers(replace(options, passes=others)) if others else []
    return {"lightmap": [layer_name(name, LIGHT)] if LIGHT in options.passes else [], "unlit": colors}


def export_glb(scene: Path, output: Path, report: dict, layers: dict[str, list[str]], progress=None) -> list[str]:
    """Write the baked objects as .glb, with a lightmap, with unlit colors or both; returns the names of the files.

    Raises ValueError for objects with several UDIM tiles, which glTF cannot tell apart, and as `apply_bake` does.
    """
    from ..blender.process.bake import ExportJob, export_objects

    records = report["objects"]
    if tiled := [record["name"] for record in records if len(record["tiles"]) > 1]:
        raise ValueError(
            f"object {tiled[0]!r} has several UDIM tiles, and glTF one texture each: use one tile, or --atlas"
        )
    files, names = [], {name: record["uv"] for record in records for name in bake_members(record)}
    with temporary_folder() as folder:
        job = ExportJob(Path(scene).absolute(), folder / "objects.glb", names, report["frame"], records[0].get("atlas"))
        coordinates = export_objects(job, progress=progress)
        document, data = read_glb((folder / "objects.glb").read_bytes())
    for kind, of_kind in layers.items():
        if not of_kind:
            continue
        copy, more = deepcopy(document), bytearray(data)
        for record in records:
            (tile,) = record["tiles"].values()
            pictures, stem = imaging.read_layers(output / tile["file"]), Path(tile["file"]).with_suffix("")
            pixels = sum(pictures[layer] for layer in of_kind)
            uv = {name: coordinates[name] for name in bake_members(record)}
            if kind == "lightmap":
                facts = _write_lightmap(output, stem, pixels)
                files += [facts["file"], facts["png"]]
                for node in (node for node in copy["nodes"] if node.get("name") in uv):
                    node["extras"] = {"lightmap": {**facts, "texCoord": uv[node["name"]]}}
            else:
                _show_unlit(copy, more, imaging.encode_png(imaging.to_srgb8(pixels)), uv)
        file = f"{Path(scene).stem}{'_unlit' if kind == 'unlit' else ''}.glb"
        write_bytes(output / file, write_glb(copy, bytes(more)))
        files.append(file)
    return files


def read_glb(glb: bytes) -> tuple[dict, bytes]:
    """The JSON document and the data of a .glb."""
    length, _ = _CHUNK.unpack_from(glb, _HEADER.size)
    start = _HEADER.size + _CHUNK.size
    return json.loads(glb[start : start + length]), glb[start + length + _CHUNK.size :]


def write_glb(document: dict, data: bytes) -> bytes:
    """The bytes of a .glb."""
    document["buffers"] = [{"byteLength": len(data)}]
    text = json.dumps(document).encode()
    chunks = [(b"JSON", text + b" " * (-len(text) % 4)), (b"BIN\0", data + b"\0" * (-len(data) % 4))]
    body = b"".join(_CHUNK.pack(len(chunk), kind) + chunk for kind, chunk in chunks)
    return _HEADER.pack(b"glTF", 2, _HEADER.size + len(body)) + body


def _write_lightmap(output: Path, stem: Path, pixels: np.ndarray) -> dict:
    """Write a lightmap (H, W, 3) as half EXR and as RGBM; returns its entry in `extras`."""
    exr, png = f"{stem.as_posix()}.lightmap.exr", f"{stem.as_posix()}.lightmap.png"
    with writing_rows(output / exr, "RGB", pixels.shape[1::-1], half="RGB") as writer:
        writer.write({letter: pixels[..., number] for number, letter in enumerate("RGB")})
    most = max(1.0, float(math.ceil(pixels.max())))
    write_bytes(output / png, imaging.encode_png(rgbm(pixels, most)))
    return {"file": exr, "png": png, "range": most, "intensity": math.pi, "encoding": "rgb * a * range, linear"}


def rgbm(pixels: np.ndarray, most: float) -> np.ndarray:
    """Colors (H, W, 3) up to `most` as (H, W, 4) uint8: color = rgb * a * most, with each from 0 to 1."""
    share = np.clip(pixels / most, 0.0, 1.0)
    alpha = np.clip(np.ceil(255.0 * share.max(axis=-1, keepdims=True)), 1.0, 255.0)
    return np.concatenate([np.rint(255.0 * share / (alpha / 255.0)), alpha], axis=-1).clip(0, 255).astype(np.uint8)


def _show_unlit(document, data: bytearray, png: bytes, coordinates) -> None:
    """Let the nodes of objects, by the number of their UV map, show a picture without light (KHR_materials_unlit)."""
    data += b"\0" * (-len(data) % 4)
    view = {"buffer": 0, "byteOffset": len(data), "byteLength": len(png)}
    data += png

    def added(kind, entry) -> int:
        document.setdefault(kind, []).append(entry)
        return len(document[kind]) - 1

    image = added("images", {"bufferView": added("bufferViews", view), "mimeType": "image/png"})
    texture, materials = added("textures", {"source": image}), {}
    for node in document["nodes"]:
        if node.get("name") not in coordinates or "mesh" not in node:
            continue
        number = coordinates[node["name"]]
        if number not in materials:
            color = {"baseColorTexture": {"index": texture, "texCoord": number}, "metallicFactor": 0.0}
            unlit = {"pbrMetallicRoughness": color, "extensions": {"KHR_materials_unlit": {}}, "doubleSided": True}
            materials[number] = added("materials", unlit)
        # Nodes may share a mesh, but not the texture.
        node["mesh"] = added("meshes", deepcopy(document["meshes"][node["mesh"]]))
        for primitive in document["meshes"][node["mesh"]]["primitives"]:
            primitive["material"] = materials[number]
    used = document.setdefault("extensionsUsed", [])
    document["extensionsUsed"] = sorted({*used, "KHR_materials_unlit"})
