"""Bakes for engines: a .glb by Blender's exporter, with lightmaps in `extras` or unlit colors, and their textures.

glTF has no lightmaps of its own. The node of each object tells its lightmap in `extras`, see docs/lightmaps.md.
"""

from __future__ import annotations

import json
import math
import struct
from copy import deepcopy
from dataclasses import replace
from pathlib import Path

import numpy as np

from .. import imaging
from ..files import temporary_folder, write_bytes
from ..imaging.exr import layer_name, writing_rows
from .bake_files import applied_layers, bake_members
from .lighting import technique_names

LIGHT = "diffuse_light"
# The chunks of a .glb: its JSON, and its data (glTF 2.0, section 4.4).
_HEADER, _CHUNK = struct.Struct("<4sII"), struct.Struct("<I4s")
_LINEAR, _REPEAT = 9729, 10497  # glTF's numbers of GL_LINEAR and GL_REPEAT


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
                _add_lightmap(copy, facts, uv)
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


def _add_lightmap(document, facts, coordinates) -> None:
    for node in document["nodes"]:
        if node.get("name") in coordinates:
            lightmap = {**facts, "texCoord": coordinates[node["name"]]}
            node["extras"] = {**node.get("extras", {}), "lightmap": lightmap}


def _show_unlit(document, data: bytearray, png: bytes, coordinates) -> None:
    """Let the nodes of objects, by the number of their UV map, show a picture without light (KHR_materials_unlit)."""
    data += b"\0" * (-len(data) % 4)
    view = {"buffer": 0, "byteOffset": len(data), "byteLength": len(png)}
    data += png

    def added(kind, entry) -> int:
        document.setdefault(kind, []).append(entry)
        return len(document[kind]) - 1

    image = added("images", {"bufferView": added("bufferViews", view), "mimeType": "image/png"})
    sampler = added("samplers", {"magFilter": _LINEAR, "minFilter": _LINEAR, "wrapS": _REPEAT, "wrapT": _REPEAT})
    texture, materials = added("textures", {"source": image, "sampler": sampler}), {}
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
