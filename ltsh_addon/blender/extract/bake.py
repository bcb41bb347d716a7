"""Bakes of objects: the surfaces of their texels, the lights, and Cycles' own bake (runs in the child)."""

import shutil
import tempfile
import time
from contextlib import nullcontext, suppress
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

import bpy
import numpy as np

from ...cycles.gbuffer import rounded_positions
from ...cycles.texels import NOT_BAKED, BakeView, TexelMesh
from ...cycles.uv import column_and_row, tiles_of
from ...files import save_array
from ...scene import ATLAS, SceneError, error_line, light_records
from .. import render_settings
from ..evaluated import rendered_surfaces, with_render_depsgraph
from ..lights.area import collect_lights
from ..lights.world import take_world
from ..materials import aovs
from ..materials.graph import ensure_nodes, has_displacement, has_volume
from ..materials.maps import UV_MAP, MaterialPlan, SavedImages
from ..process.bake import BakeFactsJob, BakeJob
from ..render_settings import changed_properties, working_space
from . import atlas, bake_meshes, pixels
from .bounces import bounces_of, lights_by_row, lit_by, rows_of_lights
from .dependencies import NotJudged, dependencies
from .final_gather import FinalGather
from .occluders import collect_occluders, with_baked_shares, with_displacement
from .pixels import OCCLUDERS, SEEDS, remove_occlusion

# SAMPLED_TEXELS: width of the part of a texel over which Cycles' bake spreads its samples; the whole texel since 5.2.
SAMPLED_TEXELS = 1.0 if bpy.app.version >= (5, 2, 0) else 0.5
MOST_UV_MAPS = 8
CYCLES_TYPES = {"specular": "GLOSSY", "diffuse": "DIFFUSE", "diffuse_light": "DIFFUSE", "soft": "DIFFUSE"}


@dataclass(frozen=True)
class Block:
    """A block of rows of a UDIM tile: its first row, counted from below, its rows, and the size of the whole tile."""

    tile: int
    first_row: int
    rows: int
    width: int
    height: int

    @property
    def name(self) -> str:
        return f"{self.tile}_{self.first_row}"

    def placed(self, uv: np.ndarray) -> np.ndarray:
        """`uv` (N, 2), moved and scaled so that the block fills the unit square."""
        column, row = column_and_row(self.tile)
        v = (uv[:, 1] - row) * (self.height / self.rows) - self.first_row / self.rows
        return np.stack([uv[:, 0] - column, v], axis=-1)


class ObjectBake:
    """Bakes maps of objects through Cycles, block by block. Several objects share the texture."""

    def __init__(self, scene, uv_names: dict, plans: list[MaterialPlan]):
        """`uv_names` has the UV map of each object to bake."""
        self.scene, self.uv_names, self.plans = scene, uv_names, plans
        for ob, uv_name in uv_names.items():
            if uv_name not in ob.data.uv_layers:
                raise bake_meshes.ObjectError(
                    f"object {ob.name!r}: its UV map {uv_name!r} is made by modifiers that make instances as well, "
                    "where textures cannot be baked: apply the modifiers"
                )
            if len(ob.data.uv_layers) == MOST_UV_MAPS:
                raise bake_meshes.ObjectError(
                    f"object {ob.name!r} has eight UV maps, and baking needs one more: remove one"
                )
        self.layer_name, self.images = bake_meshes.UV_LAYER, {}
        while any(self.layer_name in ob.data.attributes for ob in uv_names):
            self.layer_name += "_"
        for ob in uv_names:
            active = ob.data.uv_layers.active_index
            ob.data.uv_layers.new(name=self.layer_name, do_init=False)
            ob.data.uv_layers.active_index = active
        for plan in plans:
            plan.prepare(self.layer_name)

    def close(self) -> None:
        """Remove the UV maps, the nodes and the images."""
        for ob in self.uv_names:
            ob.data.uv_layers.remove(ob.data.uv_layers[self.layer_name])
        for plan in self.plans:
            plan.remove()
        for image in self.images.values():
            bpy.data.images.remove(image)

    def maps(self, block: Block, point: int, points: int) -> np.ndarray:
        """Maps (N, rows, W, 3) float32, row 0 at the bottom, at the given one of the `points` of each texel.

        Cycles samples these points; point 0 is the center of the texel. Map n shows map n of every material at once.
        For the other points one more map follows: their places (u, v, 0), where the block is the unit square.
        """
        maps, cycles = [], self.scene.cycles
        # With a fixed seed the bytes do not depend on what was baked before.
        cycles.seed = 0
        render_settings.take_samples(self.scene, point, 1, points)
        try:
            count = max((plan.count for plan in self.plans), default=0)
            for number in range(count) if point == 0 else (*range(count), UV_MAP):
                for plan in self.plans:
                    plan.show(number)
                with render_settings.without_scripts(self.scene):
                    maps.append(self._bake(block, "EMIT", set()))
        finally:
            cycles.use_sample_subset = False
            for plan in self.plans:
                plan.show(None)
        return np.array(maps)

    def halves(self, block: Block, kind: str, samples: int, light: set[str]) -> np.ndarray:
        """Cycles' light (2, rows, W, 3) of the passes `light`, with colors where the `kind` has them: two halves with
        different seeds."""
        light = light if kind == "diffuse_light" else {*light, "COLOR"}
        return np.array([self.radiance(block, kind, (seed, samples), light) for seed in SEEDS.values()])

    def radiance(self, block: Block, kind: str, sampling: tuple[int, int], light: set[str], how=None) -> np.ndarray:
        """Cycles' light (rows, W, 3) of the passes `light`, within the context `how`; `sampling` is a seed and a number
        of samples."""
        cycles, bake = self.scene.cycles, self.scene.render.bake
        cycles.seed, cycles.samples = sampling
        # Diffuse light is the same from everywhere. Seen from above, faces whose smooth normals turn away show that of
        # their other side.
        view = "ACTIVE_CAMERA" if CYCLES_TYPES[kind] == "DIFFUSE" and "COLOR" not in light else bake.view_from
        with how or nullcontext(), changed_properties([(bake, "view_from", view)]):
            return self._bake(block, CYCLES_TYPES[kind], light)

    def _bake(self, block: Block, kind: str, pass_filter) -> np.ndarray:
        image = self._image(block)
        image.pixels.foreach_set(np.full(block.rows * block.width * 4, NOT_BAKED, np.float32))
        self._place(block)
        for plan in self.plans:
            plan.target(image)
        options = {"pass_filter": pass_filter} if pass_filter else {}
        objects = list(self.uv_names)
        context = {"scene": self.scene, "view_layer": self.scene.view_layers[render_settings.VIEW_LAYER]}
        with bpy.context.temp_override(
            **context, active_object=objects[0], object=objects[0], selected_objects=objects
        ):
            bpy.ops.object.bake(
                type=kind, margin=0, use_clear=False, uv_layer=self.layer_name, target="IMAGE_TEXTURES",
                save_mode="INTERNAL", use_selected_to_active=False, **options,
            )  # fmt: skip
        pixels = np.empty(block.rows * block.width * 4, np.float32)
        image.pixels.foreach_get(pixels)
        return np.ascontiguousarray(pixels.reshape(block.rows, block.width, 4)[..., :3])

    def _image(self, block):
        size = block.width, block.rows
        if size not in self.images:
            self.images[size] = bpy.data.images.new("ltsh bake", *size, alpha=True, float_buffer=True, is_data=True)
        return self.images[size]

    def _place(self, block):
        for ob, uv_name in self.uv_names.items():
            layers = ob.data.uv_layers
            uv = bake_meshes.uv_of(layers[uv_name], len(ob.data.loops)).astype(np.float64)
            layers[self.layer_name].uv.foreach_set("vector", block.placed(uv).astype(np.float32).ravel())
            ob.data.update()


def view_of(wanted, camera, bent: bool) -> BakeView:
    """The view for `wanted`: "camera", "above" or a position (3,)."""
    if wanted == "above":
        return BakeView("above")
    if wanted != "camera":
        return BakeView("point", tuple(wanted), bent)
    matrix = np.array(camera.matrix_world, dtype=np.float64)
    if camera.data.type == "ORTHO":
        return BakeView("direction", tuple((matrix[:3, 2] / np.linalg.norm(matrix[:3, 2])).tolist()), bent)
    return BakeView("point", tuple(matrix[:3, 3].tolist()), bent)


# Keys of a job that may change while the same file stays open.
_OF_ONE_JOB = ("objects", "following", "tile", "look_up_images")


@dataclass
class BakeScene:
    """The open file. Each object that was named when it was opened is in either `meshes` or `problems`."""

    scene: object
    camera: str
    view: BakeView
    lights: list
    warnings: list[str]
    names: list[str]
    meshes: dict[str, bake_meshes.MeshFiles]
    problems: dict[str, str]
    lobes: dict[str, aovs.MaterialLobes]  # by full name of the material
    densities: dict[str, float]  # texels per metre of the objects of an atlas that was made
    bounces: list[tuple]  # what `changed_properties` sets so that Cycles bakes the indirect light as the file has it
    world: object  # of the file, or None
    settings: dict[str, list[float]]  # of light objects, by name
    folder: tempfile.TemporaryDirectory = field(repr=False)
    gather: FinalGather | None = None  # for bounced diffuse light, made when it is asked for

    @property
    def has_sun(self) -> bool:
        """True if the world shows a sun, or something else that is as small and bright."""
        name = self.world and self.world.name
        return any(one.is_distant and not one.is_side and one.name == name for one in self.lights)

    def plans(self, objects, images) -> tuple[dict[str, MaterialPlan], list[str]]:
        """The plan of each material of `objects` by its full name, and warnings about them."""
        made, warnings, uv_names, displaced = {}, [], {}, set()
        for ob in objects:
            materials = {slot.material for slot in ob.material_slots}
            displaced |= materials if any(map(has_displacement, materials)) else set()
            for slot in ob.material_slots:
                known = uv_names.setdefault(slot.material, set(self.meshes[ob.name].uv_names))
                known &= set(self.meshes[ob.name].uv_names)
        for material, names in uv_names.items():
            lobes = self.lobes[material.name_full]
            paths = tuple(leaf.groups for leaf in lobes.leaves)
            made[material.name_full] = MaterialPlan(material, lobes.values, paths, images, names)
            if material in displaced:
                made[material.name_full].add_surface()
            warnings += lobes.warnings
        return made, list(dict.fromkeys(warnings))


_cached: dict[str, tuple] = {}


def opened_scene(job: BakeJob, progress) -> BakeScene:
    """The opened file of `job`; one that is open is used again if nothing has changed."""
    status = Path(job.scene).stat()
    key = {name: value for name, value in vars(job).items() if name not in _OF_ONE_JOB}
    key = repr(sorted(key.items())), status.st_mtime_ns, status.st_size, pixels.files_opened()
    if _cached.get("key") == key:
        cached = _cached["scene"]
        if not isinstance(job.objects, str) and set(job.objects) <= set(cached.names):
            return cached
    close()
    progress("open scene", 0.0)
    scene = _open(job)
    _cached.update(key=(*key[:-1], pixels.files_opened()), scene=scene)
    return scene


def close() -> None:
    """Forget the open file."""
    cached = _cached.pop("scene", None)
    _cached.clear()
    if cached is not None:
        cached.folder.cleanup()


def _open(job: BakeJob) -> BakeScene:
    warnings: list[str] = []
    pixels.open_scene(Path(job.scene), warnings, job.scripts)
    scene = bpy.context.scene
    render_settings.go_to_frame(scene, job.frame)
    camera = _camera(scene, job)
    view_layer = render_settings.choose_view_layer(scene, warnings)
    bounces, names = bounces_of(scene), job.objects
    if not isinstance(names, str):
        names = list(dict.fromkeys([*names, *job.following]))
    objects = bake_meshes.chosen_objects(scene, view_layer, names)
    for hidden in (*objects, *bpy.data.collections):
        if hidden.library is None:
            hidden.hide_viewport = False  # Cycles' bake refuses such objects, which renders show
    render_settings.neutralize(scene, view_layer, camera, warnings)
    world = take_world(scene, view_layer, warnings)
    render_settings.prepare_surfaces(warnings)
    if view_layer.material_override is not None:
        override = view_layer.material_override.name
        warnings.append(f"material override {override!r} is switched off: objects are baked with their own")
        view_layer.material_override = None
    bake_meshes.switch_off_holdouts(view_layer, objects, warnings)
    folder = tempfile.TemporaryDirectory(prefix="ltsh-meshes-", ignore_cleanup_errors=True)
    has_shadows = job.shadows == "on"
    bake_meshes.apply_modifiers(scene, objects)
    for ob in objects if job.atlas else ():
        atlas.make_single(ob)
    densities, unfit, uv_name = {}, {}, job.uv
    if job.atlas and job.uv is None:
        uv_name = ATLAS
        densities, unfit = atlas.make_atlas(objects, job.atlas, job.texels_per_metre, job.unwrap)
    usable = [ob for ob in objects if ob.name not in unfit]
    files = Path(folder.name), has_shadows
    inventory, meshes, problems, bare, lost = _inspect(scene, world, usable, uv_name, files)
    warnings += lost
    aovs.give_default_material(bare)
    lobes = _lobes([ob for ob in objects if ob.name in meshes], inventory.emitting_materials)
    for material_lobes in lobes.values() if has_shadows else ():
        aovs.let_shadow_rays_through(material_lobes.made_opaque)
    for material in bpy.data.materials:
        if material.name_full not in inventory.emitting_materials:
            material.cycles.emission_sampling = "NONE"
    inventory.receivers.mark()
    pixels.add_world(inventory, scene, world)
    warnings += inventory.warnings + rounded_positions(_points_in_boxes(objects), inventory.lights)
    if not inventory.lights:
        raise pixels.no_light(scene, inventory.warnings)
    if job.bounces == "off":
        render_settings.leave_out_objects(scene, inventory.left_out, warnings)
    if job.cycles_samples:
        scene.world = inventory.world
    view = view_of(job.view, camera, bent=job.cycles_samples > 0)
    _look_from(scene, camera, job.view)
    if not has_shadows:
        remove_occlusion(scene)
    name, names = camera.name if job.view == "camera" else "", [ob.name for ob in objects]
    if has_shadows:
        inventory.occluders.save(Path(folder.name) / OCCLUDERS)
    facts = names, meshes, problems | unfit, lobes, densities
    lights = lights_by_row(scene, world, inventory.lights) if job.per_light else inventory.lights
    return BakeScene(scene, name, view, lights, warnings, *facts, bounces, world, inventory.settings, folder)


def _points_in_boxes(objects) -> np.ndarray:
    """Points (N, 3) all over the boxes around the objects."""
    steps, points = np.linspace(0.0, 1.0, 9), []
    for ob in objects:
        box, matrix = np.array(ob.bound_box), np.array(ob.matrix_world, dtype=np.float64)
        axes = box.min(axis=0)[:, None] + np.ptp(box, axis=0)[:, None] * steps
        points.append(np.stack(np.meshgrid(*axes), axis=-1).reshape(-1, 3) @ matrix[:3, :3].T + matrix[:3, 3])
    return np.concatenate(points)


def _camera(scene, job):
    """The camera of the view; from above that of the scene, which nodes know; else a new one, as a render needs one."""
    if job.view == "camera":
        return render_settings.choose_camera(scene, job.camera)
    if job.view == "above":
        with suppress(SceneError):
            return render_settings.choose_camera(scene, None)
    camera = bpy.data.objects.new("ltsh bake", bpy.data.cameras.new("ltsh bake"))
    if job.view == "above":
        camera.data.type = "ORTHO"  # a point of a surface might be where a camera stands
    scene.collection.objects.link(camera)
    scene.camera = camera
    return camera


def _look_from(scene, camera, wanted) -> None:
    """Make Cycles' bake see the surfaces as `view_of` does."""
    scene.render.bake.view_from = "ABOVE_SURFACE" if wanted == "above" else "ACTIVE_CAMERA"
    if not isinstance(wanted, str):
        camera.location, camera.delta_location = wanted, (0.0, 0.0, 0.0)
    bpy.context.view_layer.update()


def _volumes(surfaces) -> list[str]:
    """Warnings about the volumes of the materials of `surfaces`."""
    materials = {slot.material for surface in surfaces for slot in surface.material_slots if slot.material is not None}
    return [
        f"material {name!r}: its volume is not shaded, light passes it as if it were not there"
        for name in sorted(material.name for material in materials if has_volume(material))
    ]


def _inspect(scene, world, objects, uv_name, files):
    """The lights, meshes by object name, problems of the other objects by name, objects without material, warnings."""
    folder, with_occluders = files

    def visit(depsgraph):
        meshes, problems = {}, {}
        # Only the depsgraph of a render knows what is rendered.
        rendered = {surface.original.name_full: surface for surface in rendered_surfaces(depsgraph)}
        for number, ob in enumerate(objects):
            try:
                bake_meshes.check_object(ob)
                mesh = bake_meshes.read_mesh(ob, depsgraph, uv_name)
                if ob.name_full not in rendered:
                    raise bake_meshes.ObjectError(
                        f"object {ob.name!r} is not rendered: its collection is excluded or hidden"
                    )
                meshes[ob.name] = bake_meshes.save_mesh(*mesh, folder, number)
            except bake_meshes.ObjectError as error:
                problems[ob.name] = str(error)
        bare = aovs.objects_without_material([rendered[ob.name_full] for ob in objects if ob.name in meshes])
        inventory = collect_lights(depsgraph)
        if with_occluders:
            lists = unread, displaced
            inventory.occluders = collect_occluders(depsgraph, None, inventory.warn, inventory.left_out, *lists)
        lost = [*_volumes(rendered.values()), *pixels.missing_images(depsgraph, world)]
        return inventory, meshes, problems, bare, lost

    unread, displaced = [], []
    inventory, *others = with_render_depsgraph(scene, visit)
    if displaced:
        inventory.occluders = with_displacement(inventory.occluders, displaced, scene)
    if unread:
        inventory.occluders = with_baked_shares(inventory.occluders, unread, scene, inventory.warn)
    return inventory, *others


def _lobes(objects, emitting) -> dict[str, aovs.MaterialLobes]:
    """The lobes of the materials of `objects`, by full name of the material."""
    lobes = {}
    for material in (slot.material for ob in objects for slot in ob.material_slots):
        if material.name_full not in lobes:
            ensure_nodes(material)
            lobes[material.name_full] = aovs.lobes_of(material, material.name_full in emitting)
    return lobes


def extract_bake(job: BakeJob, folder: Path, progress) -> dict:
    """Do the `job` and write .npz and .npy files into `folder`; returns the manifest."""
    started = time.monotonic()
    opened = opened_scene(job, progress)
    names = opened.names if isinstance(job.objects, str) else job.objects
    images = SavedImages(folder) if job.look_up_images else None
    if job.shadows == "on":
        shutil.copyfile(Path(opened.folder.name) / OCCLUDERS, folder / OCCLUDERS)
    units = {ATLAS: opened.names} if job.atlas else {name: [name] for name in names}
    records = []
    for number, (name, members) in enumerate(units.items()):
        problems = [opened.problems[member] for member in members if member in opened.problems]
        members = [member for member in members if member not in opened.problems]
        record = {"name": name, "folder": None, "problems": problems, "warnings": []}
        if members:
            try:
                record |= _objects(opened, members, images, job, folder / f"object_{number}", progress)
            except (bake_meshes.ObjectError, RuntimeError) as error:
                problems.append(error_line(error))
        records.append(record)
    return {
        "blender_version": bpy.app.version_string,
        "frame": opened.scene.frame_current,
        "lights": light_records(opened.lights),
        "light_settings": opened.settings,
        "occluders": OCCLUDERS if job.shadows == "on" else None,
        "color_space": working_space(),
        "warnings": opened.warnings,
        "sampled_texels": SAMPLED_TEXELS,
        "view": vars(opened.view),
        "camera": opened.camera,
        "objects": records,
        "seconds": time.monotonic() - started,
    }


def _objects(opened, names, images, job, folder, progress) -> dict:
    """Write the files of objects that share a texture, or of a single one, into `folder`; returns their record."""
    objects = [opened.scene.view_layers[render_settings.VIEW_LAYER].objects[name] for name in names]
    plans, warnings = opened.plans(objects, images)
    numbers = {name: number for number, name in enumerate(plans)}
    folder.mkdir(parents=True, exist_ok=True)
    meshes = []
    for number, ob in enumerate(objects):
        of_slots = np.array([numbers[slot.material.name_full] for slot in ob.material_slots])
        mesh = TexelMesh.load(opened.meshes[ob.name].mesh)
        receiver = int(ob.get(aovs.RECEIVER_PROPERTY, 0))
        whole = (np.full(len(mesh.corners), value) for value in (mesh.mirrored, receiver, number))
        meshes.append(TexelMesh(mesh.corners, mesh.normals, mesh.uv, of_slots[mesh.material], *whole))
    joined = TexelMesh.joined(meshes)
    joined.save(folder / "mesh.npz")
    uv_name = opened.meshes[names[0]].uv_name
    record = {"folder": folder.name, "uv": uv_name, "materials": [plan.record() for plan in plans.values()]}
    record["unshaded"] = [opened.lobes[name].unshaded for name in plans]
    record |= {"warnings": warnings, "members": {name: opened.densities.get(name) for name in names}}
    made = {"side": job.atlas, "density": job.texels_per_metre, "unwrap": job.unwrap, "objects": list(opened.densities)}
    record["atlas"] = made if opened.densities else None
    used = sorted({texture.uv for plan in plans.values() for texture in plan.textures})
    record["uv_maps"] = {name: f"uv_{number}.npy" for number, name in enumerate(used)}
    for name, file in record["uv_maps"].items():
        maps = (opened.meshes[ob.name].uv_map(name, mesh) for ob, mesh in zip(objects, meshes, strict=True))
        save_array(folder / file, np.concatenate(list(maps)))
    record["maps"] = any(plan.count for plan in plans.values())
    if record["maps"] or job.cycles_samples or job.bounces == "on":
        if "diffuse" in job.rest_passes and opened.gather is None:
            view_layer = opened.scene.view_layers[render_settings.VIEW_LAYER]
            opened.gather = FinalGather.of(opened.scene, view_layer, max(job.width, job.height))
        tiles = [tile for tile in tiles_of(joined.uv)[0] if job.tile in (None, tile)]
        uv_names = {ob: opened.meshes[ob.name].uv_name for ob in objects}
        bake = ObjectBake(opened.scene, uv_names, list(plans.values()))
        _bake(bake, tiles, job, opened, (folder, progress))
    return record


def _bake(bake, tiles, job, opened, files) -> None:
    """Write the maps and Cycles' bake of the objects of an ObjectBake, and close it; `files`: folder, progress."""
    points, has_bounces = job.sub_samples if any(plan.count for plan in bake.plans) else 0, job.bounces == "on"
    name, (folder, progress) = ATLAS if job.atlas else next(iter(bake.uv_names)).name, files
    try:
        blocks, rest = (_blocks(job, tiles, count) for count in (job.block_rows, job.rest_rows))
        for number, block in enumerate(blocks):
            progress(f"bake {name}", number / len(blocks))
            for point in range(points):
                save_array(folder / f"maps_{block.name}_{point}.npy", bake.maps(block, point, points))
            for kind in job.passes if job.cycles_samples else ():
                with lit_by(opened) if has_bounces else nullcontext():
                    light = {"DIRECT", "INDIRECT"} if has_bounces else {"DIRECT"}
                    halves = bake.halves(block, kind, max(1, job.cycles_samples // 2), light)
                save_array(folder / f"cycles_{kind}_{block.name}.npy", halves)
        groups = list(dict.fromkeys(light.group for light in opened.lights)) if job.per_light else [""]
        rows = [{one.name for one in opened.lights if one.group == group} for group in groups] if groups[1:] else [None]
        # One light by itself has less noise, since no sample goes to others.
        samples = job.rest_samples if len(rows) == 1 else max(job.rest_samples // 2, 1)
        tasks = [(kind, row, names) for row, names in enumerate(rows) for kind in job.rest_passes]
        sides = [one for one in opened.lights if one.is_side and one.affects_diffuse and "diffuse" in job.rest_passes]
        sky = {one.name for one in sides}
        is_joined = {one.group for one in opened.lights} == {""}  # as for `pipeline.lightmap.read_rest`
        tasks += [("soft", 0, sky)] * (bool(sky) and not is_joined)
        steps = [(block, *task) for block in (rest if has_bounces else ()) for task in tasks]
        for number, (block, kind, row, names) in enumerate(steps):
            progress(f"bounces {name}", number / len(steps))
            sampling = SEEDS["A"], samples
            if kind == "diffuse":
                baked = _bounced(bake, opened, block, (names, sides if is_joined else []), sampling)
            else:
                light = {"specular": {"INDIRECT", "COLOR"}, "soft": {"DIRECT"}}[kind]
                with lit_by(opened, names):
                    baked = bake.radiance(block, kind, sampling, light)
            save_array(folder / f"rest_{kind}_{row}_{block.name}.npy", baked)
    finally:
        bake.close()


def _bounced(bake, opened, block, lights, sampling) -> np.ndarray:
    """Diffuse light of a block, without color. `lights`: names of those that bounce, and the sky, whose direct light is
    in it too."""
    names, sky = lights
    with lit_by(opened, names):
        of_lights = names and frozenset(names)
        # Where texels should not meet the sky, later bounces meet it by chance alone, and its sun never.
        has_sun = opened.has_sun and (names is None or opened.world.name in names)
        is_gathered = not has_sun and opened.gather.serves(of_lights, sampling[1])
        # Samples for the direct light of an uneven sky go to its bright parts, if they are for it alone.
        has_sky = is_gathered and bool(sky) and not any(one.children for one in sky)
        if is_gathered:
            gathering = opened.gather.gathering(of_lights, has_sky)
            light = bake.radiance(block, "diffuse", sampling, {"DIRECT", "INDIRECT"}, gathering)
        else:
            light = bake.radiance(block, "diffuse", sampling, {"INDIRECT"})
    if sky and not has_sky:
        with lit_by(opened, {one.name for one in sky}):
            direct = bake.radiance(block, "soft", sampling, {"DIRECT"})
        light = np.where(light == np.float32(NOT_BAKED), light, light + direct)
    return light


def _blocks(job: BakeJob, tiles, rows: int) -> list[Block]:
    """The blocks of so many `rows` of the UDIM `tiles`."""
    firsts = range(0, job.height, rows)
    return [Block(tile, y, min(rows, job.height - y), job.width, job.height) for tile in tiles for y in firsts]


def scene_facts(job: BakeFactsJob, folder: Path, progress) -> dict:
    """Do the `job`: returns a manifest of what there is to bake in each frame."""
    progress("open scene", 0.0)
    pixels.open_scene(Path(job.scene), [], job.scripts)
    scene, facts, tiles, digests, unknown = bpy.context.scene, [], {}, {}, ""
    view_layer = render_settings.choose_view_layer(scene, [])
    saved_frame = scene.frame_current
    for frame in job.frames:
        render_settings.go_to_frame(scene, saved_frame if frame is None else frame)
        chosen = [] if job.objects is None else bake_meshes.chosen_objects(scene, view_layer, job.objects)
        name = scene.camera.name if scene.camera is not None else None
        for ob in chosen:
            if ob.name not in tiles:
                tiles[ob.name] = bake_meshes.tiles_without_modifiers(ob, job.uv)
        record = {"frame": scene.frame_current, "camera": name, "objects": [ob.name for ob in chosen]}
        record["lights"] = rows_of_lights(scene)
        if chosen and len(job.frames) == 1:
            try:
                digests = with_render_depsgraph(scene, partial(dependencies, names=record["objects"], job=job))
            except (NotJudged, RuntimeError) as error:
                unknown = error_line(error)
        record |= {"digests": digests, "not_judged": unknown}
        facts.append({**record, "tiles": {ob.name: tiles[ob.name] for ob in chosen if len(tiles[ob.name]) > 1}})
    return {"facts": facts}
