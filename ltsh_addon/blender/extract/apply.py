"""Materials that show baked textures, in the open file or in a new .blend (a task of the child)."""

from pathlib import Path

import bpy
import numpy as np

from ...scene import SceneError, error_line
from ..materials.graph import cut, ensure_nodes, material_output
from ..process.bake import ApplyJob, BakedTextures, ExportJob
from ..render_settings import go_to_frame
from ..saving import save_copy
from .atlas import make_atlas
from .bake_meshes import apply_modifiers, uv_of
from .pixels import open_scene

EXPORTER = "io_scene_gltf2"
# EXPORT: what glTF takes: the selected meshes and their materials at one frame.
EXPORT = {"export_format": "GLB", "use_selection": True, "export_animations": False, "export_cameras": False}
GROUP_PREFIX = "LTSH Bake"
# Custom properties of a material that shows a texture. FORMER: the material that it replaces (0: none). FORMER_LINK:
# the link setting that the slot had.
FORMER, FORMER_LINK = "ltsh_former_material", "ltsh_former_link"


def apply_bake(job: ApplyJob, folder: Path, progress) -> dict:
    """Do the `job`: let the baked objects of the scene show their textures, and save it. Returns the manifest."""
    warnings = []
    progress("open scene", 0.0)
    open_scene(Path(job.scene), warnings)
    path = Path(job.path)
    restore_atlas(job)
    for fields in job.textures:
        entry = BakedTextures(**fields)
        show_texture(_objects(entry.objects, job), entry)
    bpy.context.preferences.filepaths.save_version = 0  # no backup of our own empty file there
    save_copy(path, relative_remap=True)
    return {"warnings": warnings}


def restore_atlas(job) -> None:
    """Make the atlas of a job in the file that is opened: the one that was baked."""
    if job.atlas is None:
        return
    go_to_frame(bpy.context.scene, job.frame)
    objects = _objects(job.atlas["objects"], job)
    apply_modifiers(bpy.context.scene, objects)
    make_atlas(**{**job.atlas, "objects": objects})


def export_objects(job: ExportJob, folder: Path, progress) -> dict:
    """Do the `job` with Blender's own exporter of glTF; returns the manifest."""
    progress("open scene", 0.0)
    open_scene(Path(job.scene), [])
    if EXPORTER not in bpy.context.preferences.addons:
        try:
            bpy.ops.preferences.addon_enable(module=EXPORTER)
        except RuntimeError as error:
            raise SceneError(
                f"this Blender has no exporter of glTF, its add-on {EXPORTER}: {error_line(error)}"
            ) from error
    restore_atlas(job)
    objects = _objects(job.uv_names, job)
    go_to_frame(bpy.context.scene, job.frame)
    apply_modifiers(bpy.context.scene, objects)
    for ob in bpy.context.view_layer.objects:
        ob.hide_viewport = ob.hide_select = False
        ob.hide_set(False)
        ob.select_set(ob in objects)
    coordinates = {}
    for ob in objects:
        layers = ob.data.uv_layers
        if len(layers) == 1 and job.atlas is not None:
            # Lightmaps are the second UV map everywhere; objects without a first one have the point that Blender takes.
            uv = uv_of(layers[0], len(ob.data.loops))
            layers[0].name = "UVMap"
            layers[0].uv.foreach_set("vector", np.zeros_like(uv).ravel())
            layers.new(name=job.uv_names[ob.name], do_init=False).uv.foreach_set("vector", uv.ravel())
        coordinates[ob.name] = layers.keys().index(job.uv_names[ob.name])
    progress("export", 0.0)
    export_scene = bpy.ops.export_scene
    gltf = export_scene.gltf
    gltf(filepath=str(job.path), **EXPORT)
    return {"coordinates": coordinates}


def _objects(names, job) -> list:
    missing = [name for name in names if name not in bpy.data.objects]
    if missing:
        raise SceneError(f"object {missing[0]!r} is gone from {job.scene}")
    return [bpy.data.objects[name] for name in names]


def show_texture(objects, entry: BakedTextures) -> None:
    """Give `objects` copies of their materials that show their baked textures."""
    for ob in objects:
        restore_materials(ob)
    group = _group(entry.name.rpartition(" ")[0], _image(entry), entry.uv)
    for ob in objects:
        _show(ob, group)


def shows_texture(ob) -> bool:
    """True if a material of `ob` was made by `show_texture`."""
    return any(slot.material is not None and FORMER_LINK in slot.material for slot in ob.material_slots)


def restore_materials(ob) -> bool:
    """Give `ob` back the materials that it had before `show_texture`; False if it shows no texture."""
    was_shown = False
    for slot in ob.material_slots:
        shown = slot.material
        if shown is None or FORMER_LINK not in shown:
            continue
        was_shown, former, link = True, shown.get(FORMER), shown[FORMER_LINK]
        slot.material = former if isinstance(former, bpy.types.Material) else None
        if link == "DATA":
            slot.link = "DATA"
        if shown.users == 0:
            bpy.data.materials.remove(shown)
    return was_shown


def _image(entry):
    """The texture as an image datablock, in linear colors."""
    first = entry.files[0]
    image = bpy.data.images.load(first["path"], check_existing=False)
    image.name = entry.name
    if len(entry.files) > 1:
        image.source = "TILED"
        for file in entry.files[1:]:
            image.tiles.new(tile_number=file["tile"])
        image.filepath = first["path"].replace(f".{first['tile']}.", ".<UDIM>.")
    try:
        # The path is relative to the open file; saving elsewhere adapts such paths.
        image.filepath = bpy.path.relpath(image.filepath)
    except ValueError:
        pass  # on another drive
    # The linear space of the scene has different names in different color configurations.
    for space in ("Linear Rec.709", "scene_linear"):
        try:
            image.colorspace_settings.name = space
            break
        except TypeError:
            continue
    return image


def _group(name: str, image, uv_name: str):
    """A node group that outputs the texture as a color and as emission."""
    group = bpy.data.node_groups.new(f"{GROUP_PREFIX} {name}", "ShaderNodeTree")
    group.interface.new_socket("Emission", in_out="OUTPUT", socket_type="NodeSocketShader")
    group.interface.new_socket("Color", in_out="OUTPUT", socket_type="NodeSocketColor")
    coordinates, texture = group.nodes.new("ShaderNodeUVMap"), group.nodes.new("ShaderNodeTexImage")
    emission, output = group.nodes.new("ShaderNodeEmission"), group.nodes.new("NodeGroupOutput")
    coordinates.uv_map, texture.image = uv_name, image
    group.links.new(coordinates.outputs["UV"], texture.inputs["Vector"])
    group.links.new(texture.outputs["Color"], emission.inputs["Color"])
    group.links.new(emission.outputs[0], output.inputs["Emission"])
    group.links.new(texture.outputs["Color"], output.inputs["Color"])
    for number, node in enumerate((coordinates, texture, emission, output)):
        node.location = (300.0 * number - 450.0, 0.0)
    return group


def _show(ob, group) -> None:
    """Give `ob` copies of its materials that emit the output of `group`; their other nodes stay, unlinked."""
    if len(ob.material_slots) == 0:
        ob.data.materials.append(None)
    for slot in ob.material_slots:
        shown = slot.material
        # Link the material to the object: other users of the mesh keep theirs.
        link = slot.link
        slot.link = "OBJECT"
        name = shown.name if shown is not None else ob.name
        material = shown.copy() if shown is not None else bpy.data.materials.new(name)
        material.name = f"{name} (baked {ob.name})"
        material[FORMER], material[FORMER_LINK] = shown or 0, link
        ensure_nodes(material)
        tree = material.node_tree
        output = material_output(tree) or tree.nodes.new("ShaderNodeOutputMaterial")
        node = tree.nodes.new("ShaderNodeGroup")
        node.node_tree, node.label, node.width = group, group.name, 220.0
        node.location = (output.location.x - 260.0, output.location.y + 220.0)
        cut(output.inputs["Surface"])
        tree.links.new(node.outputs["Emission"], output.inputs["Surface"])
        slot.material = material
