"""What `match` needs of Blender: target pictures as light, and changed lights (runs in the child)."""

import math
from pathlib import Path

import bpy
import numpy as np
from mathutils import Matrix, Vector

from ...imaging.exr import COMBINED, read_layers
from ...scene import Light, SceneError, light_of, listed
from .. import render_settings
from ..lights.groups import own_light_groups, reason_to_stay
from ..process.match import TARGET, LightsJob, TargetJob
from ..saving import save_copy
from .pixels import open_scene

# SPACES: color spaces of pictures by the view transform that made them, without look, on an sRGB display. Blender knows
# their way back to light.
SPACES = {
    "Standard": "sRGB",
    "AgX": "AgX Base sRGB",
    "Filmic": "Filmic sRGB",
    "Khronos PBR Neutral": "Khronos PBR Neutral sRGB",
}
UNREADABLE = "{}: Blender cannot read it as a picture, expected EXR, HDR, PNG, JPEG or TIFF"
# Layers of a picture as Blender and `render` call them; COMPOSITED: in place of those of its view layers.
PICTURE_LAYERS, COMPOSITED = ("Combined", COMBINED), "Composite.Combined"
# Channels of 8 bits: nearer to black or white than these, they are clipped, or rounded by more than 2 %.
CLIPPED = (8.0 / 255.0, 252.0 / 255.0)


def read_target(job: TargetJob, folder: Path, progress) -> dict:
    """Do the `job`: write the target's light and its weights as TARGET. Returns the manifest."""
    progress("target", 0.0)
    open_scene(Path(job.scene), [], job.scripts)  # the finished picture of the scene tells its warnings
    scene = bpy.context.scene
    render_settings.go_to_frame(scene, job.frame)
    target, encoded = _picture(Path(job.target), scene, job.target_view, folder)
    size, own = target.shape[1::-1], render_settings.picture_size(scene)
    if abs(size[0] * own[1] / (size[1] * own[0]) - 1.0) > 0.01:
        raise SceneError(
            f"{job.target}: is {size[0]}x{size[1]} pixels, expected the shape of the scene's picture, {own[0]}x{own[1]}"
        )
    weights = is_telling(target, encoded).astype(np.float32)
    if job.mask is not None:
        mask, _ = _picture(Path(job.mask), scene, "Standard", folder)
        if mask.shape != target.shape:
            raise SceneError(
                f"{job.mask}: is {mask.shape[1]}x{mask.shape[0]} pixels, expected the target's {size[0]}x{size[1]}"
            )
        weights *= np.clip(mask.mean(axis=-1), 0.0, 1.0)
    np.savez(folder / TARGET, target=np.where(weights[..., None] > 0.0, target, 0.0), weights=weights)
    return {"reasons": {ob.name: _reason_to_stay(ob) for ob in scene.objects if ob.type == "LIGHT"}}


def _reason_to_stay(ob) -> str:
    """Why a light object may not be moved; "" if it may."""
    parent = ob.matrix_world @ ob.matrix_basis.inverted_safe()
    lengths = [axis.length for axis in parent.to_3x3().col]
    is_uneven = max(lengths) > (1.0 + 1e-4) * min(lengths)
    return reason_to_stay(ob) or ("its parent is scaled unevenly: apply the scale of the parent" if is_uneven else "")


def _picture(path: Path, scene, view: str | None, folder: Path) -> tuple[np.ndarray, np.ndarray | None]:
    """`light_of_image` of a picture file."""
    try:
        image = bpy.data.images.load(str(path), check_existing=False)
    except RuntimeError as error:
        raise SceneError(UNREADABLE.format(path)) from error
    return light_of_image(image, scene, view, folder)


def _picture_in_layers(path: Path) -> np.ndarray:
    """The light (H, W, 3) of the picture in an EXR of several layers, the composited one first. Raises SceneError."""
    try:
        layers = read_layers(path)
    except (OSError, ValueError) as error:
        raise SceneError(UNREADABLE.format(path)) from error
    named = {name: pixels for name, pixels in layers.items() if name.rpartition(".")[2] in PICTURE_LAYERS}
    if not named:
        raise SceneError(f"{path}: has layers {listed(map(repr, layers))}, expected one called {PICTURE_LAYERS[0]!r}")
    return named.get(COMPOSITED, next(iter(named.values())))[..., :3].astype(np.float32)


def light_of_image(image, scene, view: str | None, folder: Path) -> tuple[np.ndarray, np.ndarray | None]:
    """The light (H, W, 3) of an image, and its own values if it went through the `view` transform (None: the scene's).

    Images of floats are light. `folder` is temporary. Raises SceneError where there is no way back to light.
    """
    if image.size[0] == 0:
        return _picture_in_layers(Path(image.filepath_from_user())), None
    if image.is_float:
        return _pixels(image), None
    settings = scene.view_settings
    view = view or settings.view_transform
    if view not in SPACES:
        raise SceneError(f"view transform {view!r} has no way back to light, expected one of {listed(SPACES)}")
    if settings.use_curve_mapping or settings.look != "None":
        raise SceneError(
            f"scene {scene.name!r}: its view has a look or curves, which have no way back to light; switch them off, "
            "or give an EXR as target"
        )
    encoded, path = _pixels(image), str(folder / "encoded.exr")
    floats = bpy.data.images.new("LTSH encoded", *image.size, float_buffer=True)
    floats.colorspace_settings.name = "Non-Color"
    values = np.ones((*encoded.shape[:2], 4), np.float32)
    values[..., :3] = (encoded**settings.gamma)[::-1]
    floats.pixels.foreach_set(values.ravel())
    floats.file_format, floats.filepath_raw = "OPEN_EXR", path
    floats.save()
    loaded = bpy.data.images.load(path, check_existing=False)
    loaded.colorspace_settings.name = SPACES[view]
    light = _pixels(loaded) / 2.0**settings.exposure
    for made in (floats, loaded):
        bpy.data.images.remove(made)
    return light, encoded


def is_telling(light: np.ndarray, encoded: np.ndarray | None) -> np.ndarray:
    """True (H, W) where no channel of a picture is clipped."""
    finite = np.isfinite(light).all(axis=-1)
    return finite if encoded is None else finite & ((encoded > CLIPPED[0]) & (encoded < CLIPPED[1])).all(axis=-1)


def _pixels(image) -> np.ndarray:
    """The colors (H, W, 3) of an image, row 0 on top."""
    values = np.empty(image.size[0] * image.size[1] * image.channels, np.float32)
    image.pixels.foreach_get(values)
    values = values.reshape(image.size[1], image.size[0], image.channels)[::-1]
    return values[..., :3] if image.channels > 2 else np.repeat(values[..., :1], 3, axis=-1)


def save_lights(job: LightsJob, folder: Path, progress) -> dict:
    """Do the `job`: change the lights of the scene and save a copy. Returns the manifest."""
    progress("write", 0.0)
    open_scene(Path(job.scene), [], job.scripts)
    groups, lights = own_light_groups(bpy.context.scene, tuple(job.lights)), []
    for group, factor in job.factors.items():
        objects, most = groups[group], max(factor)
        data, before = objects[0].data, [_values(ob) for ob in objects]
        data.energy = most * data.energy
        if most > 0.0:
            data.color = [value * one / most for value, one in zip(data.color, factor, strict=True)]
        if group in job.moves:
            _move(objects[0], **job.moves[group])
        for ob, old in zip(objects, before, strict=True):
            new = _values(ob)
            values = {f"{key}_{when}": one[key] for key in old for when, one in (("before", old), ("after", new))}
            lights.append({"name": ob.name, "group": group, **values, "color": list(data.color)})
    if job.added is not None:
        ob = _add(light_of(job.added))
        values = {f"{key}_{when}": value for key, value in _values(ob).items() for when in ("before", "after")}
        lights.append({"name": ob.name, "group": "", **values, "color": list(ob.data.color)})
    bpy.context.preferences.filepaths.save_version = 0  # no backup of our own empty file there
    save_copy(Path(job.path), relative_remap=True)
    return {"lights": lights}


def _values(ob) -> dict:
    """The power, place (m), rotation (degrees) and size (m) of a light."""
    data, (place, turn, _) = ob.data, ob.matrix_world.decompose()
    sizes = {"AREA": "size", "SUN": "angle"}
    return {
        "power": data.energy,
        "location": list(place),
        "rotation": [math.degrees(angle) for angle in turn.to_euler()],
        "size": getattr(data, sizes.get(data.type, "shadow_soft_size")),
    }


def _add(light: Light):
    """A new light object, a disk, like `light`, of gray radiance."""
    data, radius = bpy.data.lights.new("Match", "AREA"), float(np.linalg.norm(light.half_u))
    data.shape, data.size = "DISK", 2.0 * radius
    data.energy = float(light.radiance[0]) * math.pi * math.pi * radius**2
    ob = bpy.data.objects.new("Match", data)
    bpy.context.scene.collection.objects.link(ob)
    turn = Vector(light.direction).to_track_quat("-Z", "Y")
    ob.matrix_world = Matrix.Translation(light.center) @ turn.to_matrix().to_4x4()
    bpy.context.view_layer.update()
    return ob


def _move(ob, shift, turn, growth) -> None:
    """Move a light object by `shift` (3,), turn it by the matrix `turn` (3, 3), and make it exp(`growth`) as large."""
    matrix = ob.matrix_world.copy()
    turned = Matrix(turn) @ matrix.to_3x3()
    wanted = Matrix.Translation(matrix.translation + Vector(shift)) @ turned.to_4x4()
    ob.matrix_world = wanted
    bpy.context.view_layer.update()
    if not np.allclose(ob.matrix_world, wanted, atol=1e-4 * (1.0 + np.abs(matrix.translation).max())):
        raise SceneError(f"light {ob.name!r} cannot be put where it should be: clear its parent, keep its transform")
    data, factor = ob.data, math.exp(growth)
    if factor != 1.0:
        for name in ("size", "size_y") if data.type == "AREA" else ("shadow_soft_size",):
            setattr(data, name, factor * getattr(data, name))
        data.energy /= 1.0 if data.normalize else factor**2
