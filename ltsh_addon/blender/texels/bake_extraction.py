"""The child's task for a bake: lights, and for every object its mesh, materials, maps and Cycles' bake, as files."""

from __future__ import annotations

import shutil
import time
from pathlib import Path

import bpy
import numpy as np

from ..materials.material_outputs import RECEIVER_PROPERTY
from ..materials.plain_textures import SavedImages
from ..pixels import extraction
from ..pixels.color_management import working_space
from ..processes.array_files import save_array
from . import bake_scene
from .texel_bake import Block, ObjectBake, ObjectError
from .uv_raster import tiles_of


def extract_bake(job: dict, folder: Path, progress) -> dict:
    """Do the `job` (see `bake_child.extract_bake`), write .npz and .npy into `folder`; the manifest as a dictionary."""
    started = time.monotonic()
    opened = bake_scene.opened(job, progress)
    names = opened.names if isinstance(job["objects"], str) else job["objects"]
    images = SavedImages(folder) if job["look_up_images"] else None
    records = []
    for number, name in enumerate(names):
        record = {"name": name, "problem": opened.problems.get(name), "warnings": []}
        if record["problem"] is None:
            try:
                record |= _object(opened, name, images, job, folder / f"object_{number}", progress)
            except (ObjectError, RuntimeError) as error:
                record["problem"] = " ".join(str(error).split())
        records.append(record)
    return {
        "blender_version": bpy.app.version_string,
        "frame": opened.scene.frame_current,
        "lights": [extraction.light_record(light) for light in opened.lights],
        "color_space": working_space(),
        "warnings": opened.warnings,
        "view": vars(opened.view),
        "camera": opened.camera,
        "objects": records,
        "seconds": time.monotonic() - started,
    }


def _object(opened, name, images, job, folder, progress) -> dict:
    """Write what belongs to one object into `folder`; its record."""
    ob, read = bpy.context.view_layer.objects[name], opened.meshes[name]
    plans, warnings = opened.plans(ob, images)
    folder.mkdir(parents=True, exist_ok=True)
    shutil.copyfile(read.mesh, folder / "mesh.npz")
    distinct = list({id(plan): plan for plan in plans}.values())
    record = {"folder": folder.name, "uv": read.uv_name, "materials": [plan.record() for plan in plans]}
    record |= {"warnings": warnings, "receiver": int(ob.get(RECEIVER_PROPERTY, 0))}
    used = sorted({texture["uv"] for plan in plans for texture in plan.textures})
    record["uv_maps"] = {name: f"uv_{number}.npy" for number, name in enumerate(used)}
    for uv_name, file in record["uv_maps"].items():
        save_array(folder / file, read.uv_map(uv_name))
    record["maps"] = any(plan.count for plan in distinct)
    if record["maps"] or job["cycles_samples"]:
        _bake(opened.scene, ob, read, distinct, job, record["maps"], folder, progress)
    return record


def _bake(scene, ob, read, plans, job, with_maps, folder, progress) -> None:
    """Write the maps and Cycles' bake of the tiles of an object that are wanted and not finished."""
    bake = ObjectBake(scene, ob, read.uv_name, plans)
    try:
        with np.load(read.mesh) as data:
            blocks = blocks_of(data["uv"], job["width"], job["height"], job["block_rows"])
        finished = {tile for name, tile in job["finished"] if name == ob.name}
        blocks = [Block(*values) for values in blocks if values[0] not in finished]
        if job["tile"] is not None:
            blocks = [block for block in blocks if block.tile == job["tile"]]
        for number, block in enumerate(blocks):
            progress(f"bake {ob.name}", number / len(blocks))
            if with_maps:
                save_array(folder / f"maps_{block.name}.npy", bake.maps(block))
            if job["cycles_samples"]:
                for kind in job["passes"]:
                    halves = bake.radiance(block, kind, max(1, job["cycles_samples"] // 2))
                    save_array(folder / f"cycles_{kind}_{block.name}.npy", halves)
    finally:
        bake.close()


def blocks_of(uv, width: int, height: int, block_rows: int) -> list[tuple[int, int, int, int, int]]:
    """(tile, first row, rows, width, height) of every block of every UDIM tile in use."""
    return [
        (tile, first, min(block_rows, height - first), width, height)
        for tile in tiles_of(uv)[0]
        for first in range(0, height, block_rows)
    ]
