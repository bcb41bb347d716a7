"""Settings with which samples and references are rendered: camera, size, pixel filter, view layer, neutral values."""

from contextlib import contextmanager
from pathlib import Path

import bpy
import mathutils
import numpy as np

from ..files import check_room_after
from ..scene import Border, SceneError, listed
from ..workers.pool import cores
from .evaluated import GREASE_PENCIL, SURFACE_TYPES, objects_in_views

DEFAULTS = {
    "film_exposure": 1.0,
    "filter_width": 1.5,
    "is_portal": False,
    **{"camera_cull_margin": 0.1, "distance_cull_margin": 50.0},
    "pixel_filter_type": "BLACKMAN_HARRIS",
    "transparent_max_bounces": 8,
    "use_bump_map_correction": True,
    "use_camera_cull": False,
    "use_distance_cull": False,
    "use_multiple_importance_sampling": True,
}


def cycles_setting(owner, name: str):
    """`owner.cycles.<name>`, or Cycles' default."""
    return getattr(getattr(owner, "cycles", None), name, DEFAULTS[name])


def working_space() -> dict:
    """The working space: "name" ("" before 5.0, which does not tell), and "to_rec709", the matrix to linear Rec.709."""
    columns = [mathutils.Color(axis).from_scene_linear_to_rec709_linear() for axis in ((1, 0, 0), (0, 1, 0), (0, 0, 1))]
    name = bpy.data.colorspace.working_space if bpy.app.version >= (5, 0, 0) else ""
    return {"name": name, "to_rec709": [[column[row] for column in columns] for row in range(3)]}


CAMERA_TYPES = ("PERSP", "ORTHO")
CAMERA_KINDS = {"PANO": "panoramic", "CUSTOM": "custom (Open Shading Language)"}


def go_to_frame(scene, frame: int | None) -> None:
    """Evaluate the animation at `frame`, or at the file's own frame; also activates a camera bound to a marker."""
    if frame is None:
        scene.frame_set(scene.frame_current, subframe=scene.frame_subframe)
    else:
        scene.frame_set(frame)


def choose_camera(scene, name: str | None):
    """Make the camera object `name` that of the scene and return it; None: the scene's own. Raises SceneError."""
    if name is None:
        camera = scene.camera
        if camera is None:
            raise SceneError(f"scene {scene.name!r} has no active camera: set one, or name one")
    else:
        camera = scene.objects.get(name)
        if camera is None or camera.type != "CAMERA":
            cameras = listed(repr(ob.name) for ob in scene.objects if ob.type == "CAMERA")
            raise SceneError(f"camera {name!r} is not in scene {scene.name!r}; cameras there: {cameras}")
    if camera.type != "CAMERA":
        raise SceneError(
            f"scene {scene.name!r}: its camera {camera.name!r} is a {camera.type} object, expected a camera"
        )
    if camera.data.type not in CAMERA_TYPES:
        kind = CAMERA_KINDS.get(camera.data.type, camera.data.type)
        raise SceneError(
            f"camera {camera.name!r} is {kind}, expected a perspective or orthographic one; "
            "change its type, or name another camera"
        )
    # A render would switch to the camera of the last marker, which is another one only if one is named.
    for marker in scene.timeline_markers if name is not None else ():
        marker.camera = None
    scene.camera = camera
    return camera


def picture_size(scene) -> tuple[int, int]:
    """Width and height of the whole picture in pixels, whether or not there is a border."""
    render = scene.render
    share = render.resolution_percentage
    return render.resolution_x * share // 100, render.resolution_y * share // 100


def set_resolution(scene, width: int | None, height: int | None) -> tuple[int, int]:
    """Set and return the size (width, height) of the whole picture in pixels; None keeps the aspect of the file."""
    own_width, own_height = picture_size(scene)
    if own_width < 1 or own_height < 1:
        raise SceneError(
            f"scene {scene.name!r}: {scene.render.resolution_percentage} % of {scene.render.resolution_x}x"
            f"{scene.render.resolution_y} pixels is less than one pixel; raise the percentage"
        )
    if width is None and height is None:
        return own_width, own_height
    if width is None:
        width = max(1, round(height * own_width / own_height))
    elif height is None:
        height = max(1, round(width * own_height / own_width))
    render = scene.render
    render.resolution_x, render.resolution_y, render.resolution_percentage = width, height, 100
    if (render.resolution_x, render.resolution_y) != (width, height):
        raise SceneError(
            f"resolution {width}x{height} is not possible in Blender, the nearest is "
            f"{render.resolution_x}x{render.resolution_y}"
        )
    return width, height


def render_border(scene) -> Border | None:
    """The part of the picture that is rendered; None for all of it.

    Raises SceneError for a border smaller than a pixel, which Blender does not render.
    """
    render, (width, height) = scene.render, picture_size(scene)
    if not render.use_border:
        return None

    def cut(share, size):
        return int(np.float32(share) * np.float32(size))

    first_column, end_column = cut(render.border_min_x, width), cut(render.border_max_x, width)
    first_row, end_row = cut(render.border_min_y, height), cut(render.border_max_y, height)
    columns, rows = max(end_column - first_column, 0), max(end_row - first_row, 0)
    if not columns or not rows:
        raise SceneError(
            f"scene {scene.name!r}: its render region is {columns}x{rows} of "
            f"{width}x{height} pixels, expected at least one; make it larger or switch it off"
        )
    return Border(
        left=first_column,
        top=height - end_row,
        width=columns,
        height=rows,
        full_width=width,
        full_height=height,
        cropped=render.use_crop_to_border,
    )


@contextmanager
def shifted_pixels(scene, offset: np.ndarray):
    """Within this context camera rays are shifted by `offset` (2,), in pixels to the right and up."""
    render, lens = scene.render, scene.camera.data
    size = picture_size(scene)
    width, height = size[0] * render.pixel_aspect_x, size[1] * render.pixel_aspect_y
    fits_width = lens.sensor_fit == "HORIZONTAL" or (lens.sensor_fit == "AUTO" and width >= height)
    unit = width if fits_width else height
    shift_x = lens.shift_x + offset[0] * render.pixel_aspect_x / unit
    shift_y = lens.shift_y + offset[1] * render.pixel_aspect_y / unit
    with changed_properties([(lens, "shift_x", shift_x), (lens, "shift_y", shift_y)]):
        yield


# CENTER_FILTER_WIDTH: in pixels, of a filter that puts all rays in the center of a pixel. The least width in Blender's
# interface, 0.01, is too wide: some reference rays then cross edges that the central sample does not (measured: 1 % of
# the pixels of a detailed picture, 6 % relative L2). Even so, 1 in 1000 rays per axis strays by up to half a pixel,
# because of the first cell of Cycles' filter table.
CENTER_FILTER_WIDTH = 1e-6
# QUANTILE_STEPS: steps in which a filter is integrated.
QUANTILE_STEPS = 8192


def filter_density(kind: str, width: float, distance: np.ndarray) -> tuple[np.ndarray, float]:
    """The weight of the filter at a `distance` in pixels along one axis, not normalized, and its half extent in pixels.

    `kind` and `width` (pixels) are `pixel_filter_type` and `filter_width` of the scene; filters are separable. BOX is
    always one pixel wide. GAUSSIAN is exp(-8 (x / width)^2), cut at 1.5 widths. BLACKMAN_HARRIS is the window of Harris
    1978 ("On the use of windows for harmonic analysis with the discrete Fourier transform") with four terms, two widths
    from end to end. Measured on an edge, Cycles 4.5.15 and 5.2.3 agree to 1e-3 of the height of the edge.
    """
    distance = np.asarray(distance, dtype=np.float64)
    if kind == "BOX":
        weight, half = np.ones_like(distance), 0.5
    elif kind == "GAUSSIAN":
        weight, half = np.exp(-8.0 * (distance / width) ** 2), 1.5 * width
    elif kind == "BLACKMAN_HARRIS":
        phase = np.pi * (distance / width + 1.0)
        terms = (0.35875, -0.48829, 0.14128, -0.01168)
        weight, half = sum(term * np.cos(order * phase) for order, term in enumerate(terms)), width
    else:
        raise ValueError(f"pixel filter is {kind!r}, expected BOX, GAUSSIAN or BLACKMAN_HARRIS")
    return np.where(np.abs(distance) <= half, weight, 0.0), half


def filter_quantiles(kind: str, width: float, shares: np.ndarray) -> np.ndarray:
    """Signed distances from the pixel's center, in pixels, below which the filter has these `shares` of its weight."""
    half = filter_density(kind, width, np.zeros(1))[1]
    distance = np.linspace(-half, half, QUANTILE_STEPS + 1)
    weight = filter_density(kind, width, distance)[0]
    cumulative = np.concatenate([[0.0], np.cumsum(weight[1:] + weight[:-1])])
    return np.interp(shares, cumulative / cumulative[-1], distance)


def filter_points(kind: str, width: float, count: int) -> np.ndarray:
    """Offsets (count, 2) from the pixel's center, right and up, in pixels, distributed as the filter.

    They are the R2 sequence (Roberts 2018, "The Unreasonable Effectiveness of Quasirandom Sequences"), warped along
    each axis. A single point is the center.
    """
    if count == 1:
        return np.zeros((1, 2))
    steps = np.array([0.7548776662466927, 0.5698402909980532])
    return filter_quantiles(kind, width, (np.arange(count)[:, None] * steps + 0.5) % 1.0)


# MOST_AROUND: how many pixels away from its own a sample may count.
MOST_AROUND = 2


def shared_points(kind: str, width: float, count: int) -> tuple[np.ndarray, np.ndarray | None]:
    """Evenly distributed points (count, 2) of a pixel, and their weights (count, D, D) in the pixels around it.

    Points are as those of `filter_points`, weights are values of the filter, with rows from top to bottom. Each pixel
    also uses the points of its neighbors, 2.25 times as many effective ones with Cycles' default filter. Box and very
    wide filters share no points: `balanced_points` and None.
    """
    around = int(np.ceil(filter_density(kind, width, np.zeros(1))[1] - 0.5))
    if not 0 < around <= MOST_AROUND:
        return balanced_points(kind, width, count), None
    points, steps = filter_points("BOX", 1.0, count), np.arange(-around, around + 1)
    across = filter_density(kind, width, points[:, :1] - steps)[0]
    down = filter_density(kind, width, points[:, 1:] + steps)[0]
    return points, down[:, :, None] * across[:, None, :]


def balanced_points(kind: str, width: float, count: int) -> np.ndarray:
    """As `filter_points`, but first the center and then pairs of opposite points.

    An odd number of points has its mean in the center. The mean of 16 points of `filter_points` is 0.16 pixels off,
    which would shift the picture against that of Cycles.
    """
    half = filter_points(kind, width, 1 + count // 2)[1:] if count > 1 else np.zeros((0, 2))
    return np.concatenate([np.zeros((1, 2)), np.stack([half, -half], axis=1).reshape(-1, 2)])[:count]


def sub_pixel_offsets(scene, count: int, points=filter_points):
    """What `points` returns for `count` points of the scene's filter. Call it outside `pinned_pixel_filter`, which
    replaces that filter."""
    return points(cycles_setting(scene, "pixel_filter_type"), cycles_setting(scene, "filter_width"), count)


def filter_name(scene) -> str:
    """The scene's filter for a report: its kind, and its width in pixels if it has one."""
    kind = cycles_setting(scene, "pixel_filter_type")
    return kind if kind == "BOX" else f"{kind} {cycles_setting(scene, 'filter_width'):g} px"


@contextmanager
def pinned_pixel_filter(scene):
    """Within this context all camera rays of a pixel go through its center; `shifted_pixels` gives sub-samples."""
    cycles = scene.cycles
    before = cycles.pixel_filter_type, cycles.filter_width
    cycles.pixel_filter_type = "GAUSSIAN"
    # The stored property is written directly because of the limits of the public one.
    stored = cycles.bl_system_properties_get(do_create=True) if bpy.app.version >= (5, 0, 0) else cycles
    stored["filter_width"] = CENTER_FILTER_WIDTH
    try:
        yield
    finally:
        cycles.pixel_filter_type, cycles.filter_width = before


VIEW_LAYER = "ltsh"


def only_view_layer(scene, warnings: list[str], name: str | None = None, done: str = "shaded"):
    """Make a view layer the only one that is rendered and return it: the one called `name`, or the first in use.

    A warning says that only this one is `done`. Raises SceneError if there is no such layer.
    """
    if name is not None and name not in scene.view_layers:
        layers = listed(repr(layer.name) for layer in scene.view_layers)
        raise SceneError(f"view layer {name!r} is not in scene {scene.name!r}; view layers there: {layers}")
    used = [layer for layer in scene.view_layers if layer.use] or [scene.view_layers[0]]
    if name is not None:
        used = [scene.view_layers[name]]
    if len(used) > 1:
        warnings.append(f"scene {scene.name!r}: only view layer {used[0].name!r} of {len(used)} is {done}")
    for layer in scene.view_layers:
        layer.use = layer == used[0]
    return used[0]


def choose_view_layer(scene, warnings: list[str], name: str | None = None):
    """As `only_view_layer`; the layer also gets the name VIEW_LAYER and loses its AOVs and light groups."""
    layer = only_view_layer(scene, warnings, name)
    layer.name = VIEW_LAYER
    remove_extra_passes(layer)
    return layer


def remove_extra_passes(layer) -> None:
    """Remove AOVs and light groups: nothing reads them, and their names could clash with those of other passes."""
    for extra in (layer.aovs, layer.lightgroups):
        for item in list(extra):
            extra.remove(item)


def render_with_cycles(scene) -> None:
    """Let Cycles render `scene` on the processor, with nothing after it: no compositing, no denoiser."""
    render, cycles = scene.render, scene.cycles
    render.engine = "CYCLES"
    render.threads_mode, render.threads = "FIXED", cores()
    render.use_compositing = render.use_sequencer = render.use_multiview = False
    render.use_file_extension = render.use_overwrite = True
    cycles.device = "CPU"
    cycles.use_denoising = cycles.use_animated_seed = cycles.use_sample_subset = False


def take_samples(scene, first: int, count: int, of: int) -> None:
    """Let Cycles render `count` samples, from number `first` on, of a sequence of so many, which it spreads evenly."""
    cycles = scene.cycles
    cycles.use_sample_subset, cycles.samples = True, of
    cycles.sample_offset, cycles.sample_subset_length = first, count


def neutralize(scene, view_layer, camera, warnings: list[str]) -> None:
    """Switch off all effects that would alter the passes of single camera rays; warns if the picture changes.

    Kept on purpose are the border, holdouts, material overrides, and excluded or indirect-only collections: samples and
    reference both show them as any render does.
    """
    render, cycles = scene.render, scene.cycles
    lens = f"depth of field of camera {camera.name!r}"
    for owner, name, label, remedy in (
        (render, "use_motion_blur", "motion blur", ""),
        (render, "use_multiview", "stereoscopy", ""),
        (camera.data.dof, "use_dof", lens, "; shade and render have it with several points per pixel (--aa)"),
    ):
        if getattr(owner, name):
            warnings.append(f"{label} is switched off, in the Cycles reference as well{remedy}")
            setattr(owner, name, False)
    warnings.extend(steps_after_rendering(scene))
    scene.camera = camera
    # A render would evaluate the animation of scene and lens again, which would undo our settings.
    for owner in (scene, camera.data):
        if owner.animation_data is not None:
            owner.animation_data_clear()
    render_with_cycles(scene)
    # With an opaque film only holdouts have alpha 0; the passes do not change.
    render.film_transparent = False
    render.use_freestyle = render.use_persistent_data = False
    # AOVs need the shading system without scripts; files without scripts look the same in both.
    cycles.shading_system = cycles.shading_system and bool(script_nodes())
    # The exposure is applied after reading the rendered files, free of the property's limits.
    cycles.film_exposure = 1.0
    cycles.use_adaptive_sampling = cycles.use_fast_gi = False
    cycles.time_limit = 0.0
    cycles.max_bounces = 0
    view_layer.pass_alpha_threshold = 0.5
    cycles.sample_clamp_direct = cycles.sample_clamp_indirect = cycles.blur_glossy = 0.0
    cycles.light_sampling_threshold = 0.0
    # The probability with which Cycles chooses a light matters between two horizons; see `cycles.light_tree`.
    cycles.use_light_tree = True
    cycles.caustics_reflective = True
    view_layer.samples = 0


SCRIPT = "ShaderNodeScript"


def script_nodes() -> list:
    """The nodes of materials, lights and groups in the file that run Open Shading Language."""
    owners = (*bpy.data.materials, *bpy.data.lights)
    trees = [owner.node_tree for owner in owners if owner.node_tree is not None] + list(bpy.data.node_groups)
    return [node for tree in trees for node in tree.nodes if node.bl_idname == SCRIPT and not node.mute]


@contextmanager
def changed_properties(changes: list[tuple]):
    """Within this context properties have other values: `changes` are (owner, name, value)."""
    before = [(owner, name, getattr(owner, name)) for owner, name, _ in changes]
    try:
        for owner, name, value in changes:
            setattr(owner, name, value)
        yield
    finally:
        for owner, name, value in before:
            setattr(owner, name, value)


@contextmanager
def without_scripts(scene):
    """Within this context Cycles renders without Open Shading Language, as if the nodes that run it were not linked."""
    nodes = [(node, "mute", True) for node in script_nodes()]
    with changed_properties([(scene.cycles, "shading_system", False), *nodes]):
        yield


@contextmanager
def without_lights(scene):
    """Within this context no light object is rendered; their light would take a third of the time of one sample."""
    lights = [ob for ob in scene.objects if ob.type == "LIGHT"]
    with changed_properties([(ob, "hide_render", True) for ob in lights]):
        yield


def steps_after_rendering(scene) -> list[str]:
    """Warnings about steps after rendering that the scene asks for and that are switched off."""
    render, steps = scene.render, []
    if render.use_freestyle:
        steps.append("Freestyle")
    if bpy.app.version >= (5, 0, 0):
        tree = scene.compositing_node_group
    else:
        tree = scene.node_tree if scene.use_nodes else None
    if render.use_compositing and tree is not None:
        steps.append(f"compositing by {tree.name!r}")
    editor = scene.sequence_editor
    if render.use_sequencer and editor is not None and len(editor.strips):
        steps.append("the video sequencer")
    return [f"scene {scene.name!r}: {step} is switched off, the passes are as rendered" for step in steps]


def leave_out_objects(scene, names: set[str], warnings: list[str]) -> None:
    """Remove the objects `names` and all volumes from every collection; children keep their parents."""
    for ob in bpy.data.objects:
        if ob.type == "VOLUME" and ob.name_full in {other.name_full for other in scene.objects}:
            warnings.append(f"volume {ob.name!r} is not shaded; left out of the Cycles reference as well")
        elif ob.type in GREASE_PENCIL and ob.name_full in {other.name_full for other in scene.objects}:
            warnings.append(f"grease pencil {ob.name!r} is not shaded, nor does Cycles render it")
            continue
        elif ob.name_full not in names:
            continue
        ob.hide_render = True
        for collection in list(ob.users_collection):
            collection.objects.unlink(ob)


def prepare_surfaces(warnings: list[str]) -> None:
    """Switch off object settings that change how a surface is shaded, with warnings."""
    for ob in bpy.data.objects:
        if ob.type not in SURFACE_TYPES:
            continue
        if ob.is_shadow_catcher:
            warnings.append(f"object {ob.name!r}: shadow catcher is switched off, it is shaded like any surface")
            ob.is_shadow_catcher = False
        if ob.shadow_terminator_shading_offset:
            warnings.append(f"object {ob.name!r}: the shading offset of its shadow terminator is switched off")
            ob.shadow_terminator_shading_offset = 0.0


def enable_passes(view_layer, names: tuple[str, ...]) -> None:
    """Switch on the passes `use_pass_<name>` and switch off all others."""
    for attribute in dir(view_layer):
        if attribute.startswith("use_pass_"):
            setattr(view_layer, attribute, attribute[len("use_pass_") :] in names)


def render_exr(scene, path: Path, codec: str = "ZIP") -> None:
    """Render `scene` into the multi-layer float EXR `path`. Raises SceneError, and OSError if the disk is full."""
    settings = scene.render.image_settings
    if bpy.app.version >= (5, 0, 0):
        settings.media_type = "MULTI_LAYER_IMAGE"
    settings.file_format = "OPEN_EXR_MULTILAYER"
    if hasattr(settings, "use_exr_interleave"):
        settings.use_exr_interleave = True
    settings.color_depth, settings.exr_codec = "32", codec
    scene.render.filepath = str(path)
    bpy.ops.render.render(write_still=True, scene=scene.name)
    if not path.is_file():
        raise SceneError(f"Blender rendered scene {scene.name!r} but wrote no {path.name}")
    check_room_after(path)


def pass_names() -> dict[str, str]:
    """Our key of a pass -> its name in an EXR by this Blender; the names changed with 5.0."""
    names = ("Glossy Direct", "Glossy Color", "Diffuse Direct", "Diffuse Color", "Emission", "Environment",
             "Object Index", "Material Index")  # fmt: skip
    if bpy.app.version < (5, 0, 0):
        names = ("GlossDir", "GlossCol", "DiffDir", "DiffCol", "Emit", "Env", "IndexOB", "IndexMA")
    keys = ("specular_light", "specular_color", "diffuse_light", "diffuse_color", "emission", "background",
            "object_index", "material_index")  # fmt: skip
    return dict(zip(keys, names, strict=True))


def save_png(scene, pixels: np.ndarray, path: Path) -> None:
    """Save `pixels` (H, W, 4), row 0 on top, as a PNG through the view transform of the scene."""
    height, width = pixels.shape[:2]
    image = bpy.data.images.new("LTSH picture", width, height, alpha=True, float_buffer=True)
    if bpy.app.version >= (5, 0, 0):
        image.colorspace_settings.name = bpy.data.colorspace.working_space
    # The colors are already multiplied by alpha.
    image.alpha_mode = "PREMUL"
    image.pixels.foreach_set(np.ascontiguousarray(pixels[::-1], np.float32).ravel())
    settings = scene.render.image_settings
    if bpy.app.version >= (5, 0, 0):
        settings.media_type = "IMAGE"
    settings.file_format, settings.color_depth = "PNG", "8"
    settings.color_mode = "RGBA" if scene.render.film_transparent else "RGB"
    image.save_render(str(path), scene=scene)
    bpy.data.images.remove(image)


# Pairs of properties: what views take, and what renders take.
LEVELS = (
    ("show_viewport", "show_render"),
    ("levels", "render_levels"),
    ("resolution_u", "render_resolution_u"),
    ("resolution_v", "render_resolution_v"),
    ("resolution", "render_resolution"),
    ("show_instancer_for_viewport", "show_instancer_for_render"),
    ("simplify_subdivision", "simplify_subdivision_render"),
    ("simplify_child_particles", "simplify_child_particles_render"),
)


def show_as_views(scene, layer, hidden: tuple[str, ...]) -> None:
    """Let renders show what views show, in their detail; but for the objects `hidden` and for grease pencil."""
    shown, of_layer = {ob for ob in objects_in_views(layer) if ob.name not in hidden}, set(layer.objects)
    for collection in bpy.data.collections:
        collection.hide_render = False
    for ob in bpy.data.objects:
        is_hidden = ob not in shown if ob in of_layer else ob.hide_viewport
        ob.hide_render = is_hidden or ob.type in GREASE_PENCIL  # Blender draws that over renders and views
        details = [ob, *ob.modifiers, *(() if ob.data is None else (ob.data,))]
        for owner in details:
            _take_levels(owner)
    _take_levels(scene.render)


def _take_levels(owner) -> None:
    """Let renders take the values of LEVELS that views take."""
    for name, of_renders in LEVELS:
        if hasattr(owner, name) and hasattr(owner, of_renders):
            setattr(owner, of_renders, getattr(owner, name))
