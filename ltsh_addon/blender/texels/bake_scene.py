"""A file that is open and ready for bakes, in the child: lights, view, materials, and the meshes of objects, as files.

It is kept from one job to the next, so that the objects of a bake are taken from it one after another. What is found
for an object does not depend on the others, nor on what was asked before.
"""

from __future__ import annotations

import tempfile
from dataclasses import dataclass, field
from pathlib import Path

import bpy
import numpy as np

from ..lights.area_lights import collect_lights, seen_lights
from ..materials.material_maps import MaterialPlan
from ..materials.material_outputs import (
    MaterialLobes,
    MaterialReport,
    ensure_nodes,
    give_default_material,
    lobes_of,
    objects_without_material,
)
from ..pixels import cameras, extraction, render_settings
from ..pixels.cycles_reference import remove_occlusion
from ..pixels.inventory import rendered_surfaces, with_render_depsgraph
from .texel_bake import ObjectError, check_object, chosen_objects, read_mesh, view_of
from .texel_samples import BakeView

# What may differ between jobs that one open file serves.
_OF_ONE_JOB = ("objects", "following", "tile", "finished", "look_up_images", "watch_parent", "temporary")


@dataclass(frozen=True)
class ReadMesh:
    """Mesh and UV maps of an object, in files."""

    mesh: Path  # as TexelMesh.load reads it
    uv_name: str
    uv_names: tuple[str, ...]  # "" for the one that renders
    uv_maps: Path  # .npz, (T, 3, 2) by the number of the name

    def uv_map(self, name: str) -> np.ndarray:
        """(T, 3, 2)."""
        with np.load(self.uv_maps) as data:
            return data[str(self.uv_names.index(name))]


@dataclass
class BakeScene:
    """The open file; `meshes` or `problems` have each of the objects that were named when it was opened."""

    scene: object
    camera: str
    view: BakeView
    lights: list
    warnings: list[str]
    names: list[str]
    meshes: dict[str, ReadMesh]
    problems: dict[str, str]
    lobes: dict[str, tuple[MaterialLobes | None, list[str]]]  # with warnings, by full name of the material
    folder: tempfile.TemporaryDirectory = field(repr=False)

    def plans(self, ob, images) -> tuple[list[MaterialPlan], list[str]]:
        """The maps that the material slots of an object need, and warnings about its materials."""
        uv_names, made, warnings = set(self.meshes[ob.name].uv_names), {}, []
        for slot in ob.material_slots:
            material = slot.material
            if material.name_full not in made:
                lobes, lines = self.lobes[material.name_full]
                values = lobes.values if lobes is not None else ()
                trees = tuple(leaf.tree for leaf in lobes.leaves) if lobes is not None else ()
                made[material.name_full] = MaterialPlan(material, values, trees, images, uv_names)
                warnings += lines
        return [made[slot.material.name_full] for slot in ob.material_slots], list(dict.fromkeys(warnings))


_kept: dict[str, tuple] = {}


def opened(job: dict, progress) -> BakeScene:
    """The file of `job` (see `bake_child.BakeJob`), opened unless it is already, as it stands on the disk."""
    status = Path(job["scene"]).stat()
    key = {name: value for name, value in job.items() if name not in _OF_ONE_JOB}
    key = repr(sorted(key.items())), status.st_mtime_ns, status.st_size, extraction.files_opened()
    if _kept.get("key") == key:
        kept = _kept["scene"]
        if not isinstance(job["objects"], str) and set(job["objects"]) <= set(kept.names):
            return kept
    close()
    progress("open scene", 0.0)
    found = _open(job)
    _kept.update(key=(*key[:-1], extraction.files_opened()), scene=found)
    return found


def close() -> None:
    """Forget the open file."""
    kept = _kept.pop("scene", None)
    _kept.clear()
    if kept is not None:
        kept.folder.cleanup()


def _open(job: dict) -> BakeScene:
    warnings: list[str] = []
    extraction.open_scene(Path(job["scene"]), warnings, job["scripts"])
    scene = bpy.context.scene
    cameras.go_to_frame(scene, job["frame"])
    camera = _camera(scene, job)
    view_layer = render_settings.choose_view_layer(scene, warnings)
    names = job["objects"]
    if not isinstance(names, str):
        names = list(dict.fromkeys([*names, *job["following"]]))
    objects = chosen_objects(scene, view_layer, names)
    render_settings.neutralize(scene, view_layer, camera, warnings)
    render_settings.prepare_surfaces(warnings)
    if view_layer.material_override is not None:
        override = view_layer.material_override.name
        warnings.append(f"material override {override!r} is switched off: objects are baked with their own")
        view_layer.material_override = None
    folder = tempfile.TemporaryDirectory(prefix="ltsh-meshes-", ignore_cleanup_errors=True)
    inventory, meshes, problems, bare = _inspect(scene, objects, job["uv"], Path(folder.name))
    give_default_material(bare)
    lobes = _lobes([ob for ob in objects if ob.name in meshes], inventory.emitting_materials)
    for material in bpy.data.materials:
        if material.name_full not in inventory.emitting_materials:
            material.cycles.emission_sampling = "NONE"
    inventory.receivers.mark()
    lights = seen_lights(scene, inventory)
    warnings.extend(inventory.warnings)
    if not lights:
        raise extraction.no_light(scene, inventory.warnings)
    render_settings.leave_out_objects(scene, inventory.left_out, warnings)
    view = view_of(job["view"], camera, bent=job["cycles_samples"] > 0)
    _look_from(scene, camera, job)
    remove_occlusion(scene)
    name, names = camera.name if job["view"] == "camera" else "", [ob.name for ob in objects]
    return BakeScene(scene, name, view, lights, warnings, names, meshes, problems, lobes, folder)


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


def _inspect(scene, objects, uv_name, folder):
    """Lights, meshes of objects by name, what is wrong with the others by name, and surfaces without material."""

    def visit(depsgraph):
        meshes, problems = {}, {}
        # Asked for here, where the depsgraph is that of a render.
        rendered = {surface.original.name_full: surface for surface in rendered_surfaces(depsgraph)}
        for number, ob in enumerate(objects):
            try:
                check_object(ob)
                found = read_mesh(ob, depsgraph, uv_name)
                if ob.name_full not in rendered:
                    raise ObjectError(f"object {ob.name!r} is not rendered: its collection is excluded or hidden")
                meshes[ob.name] = _saved(*found, folder, number)
            except ObjectError as error:
                problems[ob.name] = str(error)
        bare = objects_without_material([rendered[ob.name_full] for ob in objects if ob.name in meshes])
        return collect_lights(depsgraph), meshes, problems, bare

    return with_render_depsgraph(scene, visit)


def _saved(mesh, uv_name, uv_maps, folder, number) -> ReadMesh:
    path, maps = folder / f"mesh_{number}.npz", folder / f"uv_{number}.npz"
    mesh.save(path)
    np.savez(maps, **{str(position): values for position, values in enumerate(uv_maps.values())})
    return ReadMesh(path, uv_name, tuple(uv_maps), maps)


def _lobes(objects, emitting) -> dict[str, tuple[MaterialLobes | None, list[str]]]:
    """Lobes of the materials of objects, and warnings, by full name of the material."""
    found = {}
    for material in (slot.material for ob in objects for slot in ob.material_slots):
        if material.name_full not in found:
            report = MaterialReport()
            ensure_nodes(material)
            lobes = lobes_of(material, material.name_full in emitting, report)
            found[material.name_full] = lobes, report.lines()
    return found
