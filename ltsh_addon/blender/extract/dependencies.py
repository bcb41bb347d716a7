"""Digests of what the bake of an object depends on: a second bake leaves out objects for which they are the same.

With bounced light an object depends on all that is rendered. Direct light depends on lights, on the shapes of all
objects, on materials that glow or let light through, and on the object's own materials.
"""

import hashlib
from collections.abc import Iterable
from pathlib import Path

import bpy
import numpy as np

from ..evaluated import SURFACE_TYPES, mesh_key, owner_of, read_values
from ..lights.emission import camera_outputs, nodes_as_text, trees_of, values_as_text
from ..lights.linking import linked_objects
from ..materials.graph import is_group
from ..process.bake import BakeFactsJob
from ..render_settings import working_space

# Settings that change no bake, by how their names start: of data in general, objects and Cycles, and of materials.
UNSEEN = (
    *("rna_type", "name_full", "session_uid", "is_evaluated", "is_runtime", "is_editable", "tag", "preview", "users"),
    *("use_fake_user", "use_extra_user", "original", "library", "override_library", "asset_data", "active_", "ltsh"),
    *("mode", "hide_", "show_", "display_", "lock_", "collision", "soft_body", "selection_sets", "bound_box"),
    *(
        "samples",
        "preview_",
        "time_limit",
        "use_denoising",
        "denoising_",
        "use_preview_",
        "seed",
        "bake_type",
        "matrix_",
    ),
)
UNSEEN_IN_MATERIALS = "texture_paint_", "paint_", "diffuse_color", "specular_", "roughness", "metallic", "line_"
# Shaders that neither glow nor let light through, as long as these inputs have these values.
OPAQUE = (
    *("ShaderNodeBsdfPrincipled", "ShaderNodeBsdfDiffuse", "ShaderNodeBsdfAnisotropic", "ShaderNodeBsdfMetallic"),
    *("ShaderNodeBsdfSheen", "ShaderNodeMixShader", "ShaderNodeAddShader"),
)
OPAQUE_INPUTS = {"Alpha": 1.0, "Transmission Weight": 0.0, "Emission Strength": 0.0}
# The values of attributes, by type: the property, and how many numbers of which kind it has.
ATTRIBUTES = {
    "FLOAT": ("value", 1, np.float32),
    **{name: ("value", 1, np.int32) for name in ("INT", "INT8")},
    "BOOLEAN": ("value", 1, bool),
    "FLOAT_VECTOR": ("vector", 3, np.float32),
    "FLOAT2": ("vector", 2, np.float32),
    "FLOAT_COLOR": ("color", 4, np.float32),
    "BYTE_COLOR": ("color", 4, np.float32),
    **{name: ("value", 2, np.int32) for name in ("INT32_2D", "INT16_2D")},
    "QUATERNION": ("value", 4, np.float32),
    "FLOAT4X4": ("value", 16, np.float32),
}
STILL = ("FILE", "GENERATED", "TILED")  # sources of images whose content is told by their files


class NotJudged(Exception):
    """It cannot be told whether something has changed. The message names it."""


def dependencies(depsgraph, names: Iterable[str], job: BakeFactsJob) -> dict[str, str]:
    """A digest, by name of the object, of what in the evaluated scene its bake depends on.

    It is the same for the same scene in any process. Raises NotJudged.
    """
    scene, layer = depsgraph.scene_eval, depsgraph.view_layer_eval
    owned, shapes, instances = {}, {}, []
    for instance in depsgraph.object_instances:
        ob, owner = instance.object, owner_of(instance)
        if ob.type not in (*SURFACE_TYPES, "LIGHT", "VOLUME") and not (ob.type == "CAMERA" and job.view == "camera"):
            continue
        key = *mesh_key(instance), owner.name_full
        if key not in shapes:
            slots = [slot.material for slot in ob.material_slots]
            slots = [layer.material_override] * bool(slots) if layer.material_override else slots
            owned.setdefault(ob.name_full, []).extend(slots)
            shapes[key] = _digest(_object(ob), _object(owner), _shape(ob), [slot and slot.name_full for slot in slots])
        matrix = np.array(instance.matrix_world, np.float32).tobytes()
        shown = instance.show_self, instance.show_particles, instance.random_id
        instances.append(_digest(owner.name_full, ob.name_full, shapes[key], matrix, shown))
    eye = scene.camera and (np.array(scene.camera.matrix_world, np.float32).tobytes(), _settings(scene.camera.data))
    eye = _digest(eye, scene.render.resolution_x, scene.render.resolution_y)
    materials = {one for slots in owned.values() for one in slots if one is not None}
    texts = {one.name_full: (_digest(_material(one), _reads_camera(one) and eye), one) for one in materials}
    shared = [text for text, one in texts.values() if job.bounces == "on" or not _is_opaque(one)]
    world = getattr(layer, "world_override", None) or scene.world
    whole = _digest(working_space(), _settings(scene.cycles), _world(world), sorted(instances), sorted(shared))
    own = {name: [texts[one.name_full][0] if one else "" for one in owned.get(name, ())] for name in names}
    return {name: _digest(whole, of_slots) for name, of_slots in own.items()}


def _digest(*parts) -> str:
    return hashlib.sha256(repr(parts).encode(errors="backslashreplace")).hexdigest()


def _settings(block) -> list[str]:
    return [text for text in values_as_text(block) if not text.startswith(UNSEEN)]


def _object(ob) -> list:
    """The settings of an object, those of its visibility and its light linking, and its custom properties."""
    linking = ob.light_linking
    groups = [linked_objects(group) for group in (linking.receiver_collection, linking.blocker_collection) if group]
    members = [(sorted(group.included), sorted(group.excluded)) for group in groups]
    custom = [(name, _plain(value)) for name, value in ob.items() if name not in ob.bl_rna.properties]
    return [_settings(ob), _settings(ob.cycles), bool(linking.receiver_collection), members, custom]


def _plain(value):
    """The value of a custom property."""
    plain = next((getattr(value, name)() for name in ("to_dict", "to_list") if hasattr(value, name)), value)
    return plain.name_full if isinstance(plain, bpy.types.ID) else str(plain)


def _shape(ob):
    """What an object is: the settings and nodes of a light, the attributes of a mesh."""
    data = ob.data
    if ob.type == "VOLUME":
        raise NotJudged(f"object {ob.name!r} is a volume")
    if any(system.settings.render_type == "PATH" for system in ob.particle_systems):
        raise NotJudged(f"object {ob.name!r} has hair particles")
    if ob.type == "LIGHT":
        return _settings(data), _settings(data.cycles), _nodes(data)
    if ob.type == "CAMERA":
        return data.type
    if isinstance(data, bpy.types.Mesh | bpy.types.Curves | bpy.types.PointCloud):
        return _attributes(ob, data)
    mesh = ob.to_mesh()
    try:
        return mesh and _attributes(ob, mesh)
    finally:
        ob.to_mesh_clear()


def _attributes(ob, data) -> list:
    """The names and digests of the attributes of a mesh or of curves, and its settings."""
    digests = []
    for attribute in data.attributes:
        if attribute.name.startswith((".select", ".hide", ".uv_select", ".pin", ".edge_sel", ".vert_sel")):
            continue
        if attribute.data_type not in ATTRIBUTES:
            raise NotJudged(f"object {ob.name!r} has the attribute {attribute.name!r} of type {attribute.data_type}")
        name, width, kind = ATTRIBUTES[attribute.data_type]
        values = read_values(attribute.data, name, (len(attribute.data), width), kind)
        digests.append((attribute.name, attribute.domain, hashlib.sha256(values.tobytes()).hexdigest()))
    texture = [tuple(getattr(data, name, ())) for name in ("texspace_location", "texspace_size")]
    maps = getattr(data, "uv_layers", ())
    return [sorted(digests), texture, [(one.name, one.active, one.active_render) for one in maps]]


def _material(material) -> str:
    settings = [text for text in _settings(material) if not text.startswith(UNSEEN_IN_MATERIALS)]
    return _digest(material.name_full, settings, _settings(material.cycles), _nodes(material))


def _reads_camera(material) -> bool:
    """True if a node knows where the camera is."""
    return any(camera_outputs(node) for tree in trees_of([material]) for node in tree.nodes)


def _world(world) -> list | None:
    if world is None:
        return None
    blocks = world, world.cycles, world.cycles_visibility, world.light_settings
    return [*map(_settings, blocks), _nodes(world)]


def _nodes(block) -> list:
    """The nodes of a material, light or world, and the contents of the files that they name."""
    nodes = [node for tree in trees_of([block]) for node in tree.nodes]
    images = {node.image for node in nodes if getattr(node, "image", None) is not None}
    paths = {node.filepath for node in nodes if getattr(node, "filepath", "")}
    files = [_file(Path(bpy.path.abspath(path))) for path in sorted(paths)]
    return [nodes_as_text(block), sorted(map(_image, images)), files]


def _image(image) -> str:
    """The settings and the pixels of an image."""
    if image.source not in STILL or "<UVTILE>" in image.filepath:
        raise NotJudged(f"image {image.name!r} is a {image.source.lower()}, whose files may change")
    if image.packed_files:
        content = [hashlib.sha256(one.packed_file.data).hexdigest() for one in image.packed_files]
    elif image.source == "GENERATED":
        content = [tuple(image.size), image.generated_type, tuple(image.generated_color), image.use_generated_float]
    else:
        path = bpy.path.abspath(image.filepath, library=image.library)
        tiles = [str(tile.number) for tile in image.tiles] if image.source == "TILED" else [""]
        content = [_file(Path(path.replace("<UDIM>", tile))) for tile in tiles]
    tiles = [tile.number for tile in image.tiles]
    return _digest(image.name_full, image.source, image.colorspace_settings.name, image.alpha_mode, tiles, content)


def _file(path: Path) -> str:
    """The digest of a file, "" where there is none. A path that the file names may be anything: only files are read."""
    try:
        if not path.is_file():
            return ""
        with path.open("rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()
    except (OSError, ValueError):
        return ""


def _is_opaque(material) -> bool:
    """True for a material that certainly neither glows nor lets light through, nor moves its surface."""
    nodes = [node for tree in trees_of([material]) for node in tree.nodes]
    outputs = [node for node in nodes if node.bl_idname == "ShaderNodeOutputMaterial"]
    shaders = [node for node in nodes if any(socket.type == "SHADER" for socket in node.outputs)]
    return (
        bool(outputs)
        and not any(is_group(node) for node in nodes)
        and not any(node.inputs[name].is_linked for node in outputs for name in ("Volume", "Displacement"))
        and all(node.bl_idname in OPAQUE for node in shaders)
        and all(
            not socket.is_linked and socket.default_value == OPAQUE_INPUTS[socket.name]
            for node in shaders
            for socket in node.inputs
            if socket.name in OPAQUE_INPUTS
        )
    )
