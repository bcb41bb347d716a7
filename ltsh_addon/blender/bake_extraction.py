"""The child's task for a bake: lights, and for every object its mesh, materials, maps and Cycles' bake, as files."""

from __future__ import annotations

import time
from pathlib import Path

import bpy
import numpy as np

from . import cameras, extraction, render_settings
from .child import SceneError
from .color_management import working_space
from .cycles_reference import remove_occlusion
from .inventory import rendered_surfaces, with_render_depsgraph
from .lights import collect_lights, seen_lights
from .material_maps import MaterialPlan
from .materials import (
    RECEIVER_PROPERTY,
    MaterialReport,
    ensure_nodes,
    give_default_material,
    lobes_of,
    objects_without_material,
)
from .plain_textures import SavedImages
from .texel_bake import (
    Block,
    ObjectBake,
    ObjectError,
    check_object,
    chosen_objects,
    read_mesh,
    save_block,
    view_of,
)
from .uv_raster import tiles_of


def extract_bake(job: dict, folder: Path, progress) -> dict:
    """Do the `job` (see `bake_child.extract_bake`), write .npz and .npy into `folder`; the manifest as a dictionary."""
    started, warnings = time.monotonic(), []
    progress("open scene", 0.0)
    extraction.open_scene(Path(job["scene"]), warnings)
    scene = bpy.context.scene
    cameras.go_to_frame(scene, job["frame"])
    camera = _camera(scene, job)
    view_layer = render_settings.choose_view_layer(scene, warnings)
    objects = chosen_objects(scene, view_layer, job["objects"])
    render_settings.neutralize(scene, view_layer, camera, warnings)
    render_settings.prepare_surfaces(warnings)
    if view_layer.material_override is not None:
        override = view_layer.material_override.name
        warnings.append(f"material override {override!r} is switched off: objects are baked with their own")
        view_layer.material_override = None
    inventory, meshes, problems, bare = _inspect(scene, objects, job)
    images = SavedImages(folder) if job["look_up_images"] else None
    plans = _material_plans(objects, meshes, bare, inventory.emitting_materials, images, warnings)
    inventory.receivers.mark()
    lights = seen_lights(scene, inventory)
    warnings.extend(inventory.warnings)
    if not lights:
        raise SceneError(
            f"scene {scene.name!r}: no area light that renders, found {extraction.describe_lights(scene)}; "
            "add an area light"
        )
    render_settings.leave_out_objects(scene, inventory.left_out, warnings)
    view = view_of(scene, job["view"], camera, bent=job["cycles_samples"] > 0)
    _look_from(scene, camera, job)
    remove_occlusion(scene)
    records = []
    for number, ob in enumerate(objects):
        record = {"name": ob.name, "problem": problems.get(ob.name)}
        if record["problem"] is None:
            try:
                folder_of_object = folder / f"object_{number}"
                record |= _object(scene, ob, meshes[ob.name], plans[ob.name], job, folder_of_object, progress)
            except (ObjectError, RuntimeError) as error:
                record["problem"] = " ".join(str(error).split())
        records.append(record)
    return {
        "blender_version": bpy.app.version_string,
        "frame": scene.frame_current,
        "lights": [extraction.light_record(light) for light in lights],
        "color_space": working_space(),
        "warnings": warnings,
        "view": vars(view),
        "camera": camera.name if job["view"] == "camera" else "",
        "objects": records,
        "seconds": time.monotonic() - started,
    }


def _camera(scene, job):
    """The camera of the view, or one that only stands where a render needs one."""
    if job["view"] == "camera":
        return cameras.choose_camera(scene, job["camera"])
    camera = bpy.data.objects.new("ltsh bake", bpy.data.cameras.new("ltsh bake"))
    scene.collection.objects.link(camera)
    scene.camera = camera
    return camera


def _look_from(scene, camera, job) -> None:
    """Make Cycles' bake see the surfaces as `view_of` does."""
    scene.render.bake.view_from = "ABOVE_SURFACE" if job["view"] == "above" else "ACTIVE_CAMERA"
    if not isinstance(job["view"], str):
        camera.location = job["view"]
    bpy.context.view_layer.update()


def _inspect(scene, objects, job):
    """Lights, the mesh and UV map of every object by name, what is wrong with the others by name, and the surfaces
    without material."""

    def visit(depsgraph):
        meshes, problems = {}, {}
        for ob in objects:
            try:
                check_object(ob)
                meshes[ob.name] = read_mesh(ob, depsgraph, job["uv"])
            except ObjectError as error:
                problems[ob.name] = str(error)
        # Asked for here, where the depsgraph is that of a render.
        rendered = {surface.original.name_full: surface for surface in rendered_surfaces(depsgraph)}
        for ob in objects:
            if ob.name in meshes and ob.name_full not in rendered:
                problems[ob.name] = f"object {ob.name!r} is not rendered: its collection is excluded or hidden"
                del meshes[ob.name]
        bare = objects_without_material([rendered[ob.name_full] for ob in objects if ob.name in meshes])
        return collect_lights(depsgraph), meshes, problems, bare

    return with_render_depsgraph(scene, visit)


def _material_plans(objects, meshes, bare, emitting, images, warnings) -> dict[str, list[MaterialPlan]]:
    """For every object with a mesh by name the plans of its material slots; `bare` get a material first."""
    give_default_material(bare)
    report, made = MaterialReport(), {}
    objects = [ob for ob in objects if ob.name in meshes]

    def uv_names(material):
        users = [ob for ob in objects if any(slot.material == material for slot in ob.material_slots)]
        return set.intersection(*(set(meshes[ob.name][2]) for ob in users))

    def plan(material):
        if material.name_full not in made:
            ensure_nodes(material)
            lobes = lobes_of(material, material.name_full in emitting, report)
            values = lobes.values if lobes is not None else ()
            if any("sheen_weight" in lobe for lobe in values):
                report.warn(material.name, "its sheen is not baked")
            trees = tuple(leaf.tree for leaf in lobes.leaves) if lobes is not None else ()
            made[material.name_full] = MaterialPlan(material, values, trees, images, uv_names(material))
        return made[material.name_full]

    plans = {ob.name: [plan(slot.material) for slot in ob.material_slots] for ob in objects}
    warnings.extend(report.lines())
    for material in bpy.data.materials:
        if material.name_full not in emitting:
            material.cycles.emission_sampling = "NONE"
    return plans


def _object(scene, ob, mesh_and_uv, plans, job, folder, progress) -> dict:
    """Write what belongs to one object into `folder`; its record."""
    mesh, uv_name, uv_maps = mesh_and_uv
    folder.mkdir(parents=True, exist_ok=True)
    mesh.save(folder / "mesh.npz")
    distinct = list({id(plan): plan for plan in plans}.values())
    record = {"folder": folder.name, "uv": uv_name, "materials": [plan.record() for plan in plans], "maps": False}
    record["receiver"] = int(ob.get(RECEIVER_PROPERTY, 0))
    used = sorted({texture["uv"] for plan in plans for texture in plan.textures})
    record["uv_maps"] = {name: f"uv_{number}.npy" for number, name in enumerate(used)}
    for name, file in record["uv_maps"].items():
        np.save(folder / file, uv_maps[name])
    record["maps"] = any(plan.count for plan in distinct)
    if not record["maps"] and not job["cycles_samples"]:
        return record
    bake = ObjectBake(scene, ob, uv_name, distinct)
    try:
        blocks = [Block(*values) for values in blocks_of(mesh.uv, job["width"], job["height"], job["block_rows"])]
        finished = {tile for name, tile in job["finished"] if name == ob.name}
        blocks = [block for block in blocks if block.tile not in finished]
        for number, block in enumerate(blocks):
            progress(f"bake {ob.name}", number / len(blocks))
            if record["maps"]:
                save_block(folder / f"maps_{block.name}.npy", bake.maps(block))
            if job["cycles_samples"]:
                for kind in job["passes"]:
                    halves = bake.radiance(block, kind, max(1, job["cycles_samples"] // 2))
                    save_block(folder / f"cycles_{kind}_{block.name}.npy", halves)
    finally:
        bake.close()
    return record


def blocks_of(uv, width: int, height: int, block_rows: int) -> list[tuple[int, int, int, int, int]]:
    """(tile, first row, rows, width, height) of every block of every UDIM tile in use."""
    return [
        (tile, first, min(block_rows, height - first), width, height)
        for tile in tiles_of(uv)[0]
        for first in range(0, height, block_rows)
    ]
