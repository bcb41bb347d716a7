"""The rest of a view's light: bounces, reflections, refraction, and materials that only Cycles knows.

A view shows LTSH's direct light and, of surfaces that it cannot resolve, a guess. A second Blender renders the same
view with Cycles, `render_rest`. What the view draws itself is taken out of each of its samples, so that its noise goes
with it; what remains is denoised and added to the view.

Surfaces `is_of_cycles` are Cycles' alone. An AOV tells whether a sample is of them, m = 1, or not, m = 0:

    rest = mean of (Combined - (1 - m) (direct light + background)),  picture = mean of ((1 - m) own light) + rest
"""

import json
import math
import threading
import time
from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import dataclass, replace
from pathlib import Path

import bpy
import numpy as np
from mathutils import Matrix

from ...files import save_array
from ...scene import SceneError, error_line
from .. import render_settings
from ..evaluated import objects_in_views
from ..extract.finished import reasons_for_cycles
from ..extract.pixels import files_opened, open_scene, scene_named
from ..materials.graph import ensure_nodes, has_volume
from ..materials.preview_material import preview_of
from ..process.blender_process import BlenderProcess
from ..process.view import REST_PICTURE, REST_RENDER, LiveRestJob, RestJob, RestSum, RestView, WholePictureError
from ..render_settings import render_exr
from ..saving import save_working_copy
from .drawing import ViewCamera, float_texture
from .pictures import ShownRest
from .second_blender import RestChanges, SecondBlender, spare

# MASK: the AOV with the share of a pixel that is Cycles' alone. SENSOR: the width of the camera's sensor in mm.
MASK, SENSOR = "ltsh_of_cycles", 36.0
CAMERA = "LTSH view"
PASSES = ("combined", "diffuse_direct", "diffuse_color", "glossy_direct", "glossy_color", "environment", "z")
# A step takes about STEP_SECONDS: so long a new state may wait for the step of an old one. SHRINKS: pixels in either
# direction that share one, in the pictures that come one after another; the first is the finest that takes one step.
# TOTALS: the samples after which a picture is shown; denoised, one of all pixels is nearer than four of a quarter of
# them. REST_SECONDS: how long a view must stay as it is before.
STEP_SECONDS, SHRINKS, TOTALS, REST_SECONDS = 0.7, (4, 2, 1), (1, 2, 4, 8, 16, 32, 64), 0.3
# FEWEST: samples of single pixels that a step takes at least: the first picture of 1000 x 640 pixels. MOST_CHANGE: how
# many times as many or as few the next one takes.
FEWEST, MOST_CHANGE = 160_000, 2.0
SINGLES = 8  # first samples in steps of their own, see `RestSum`
# Of live jobs. PICTURE: a stage; its fraction is the number of a picture, with files. STOP: a file that ends them.
PICTURE, LIVE_REST, LIVE_WHOLE, LIVE_FACTS, STOP = "picture", "rest_{}.npy", "whole_{}.npy", "live_{}.json", "stop"
# WHOLE_SAMPLES: so many of Cycles' whole picture, where it is shown at first, come before the view's own. The rest is
# denoised for the first picture, which is kept after changes, and from then on: that takes a quarter of a sample.
WHOLE_SAMPLES = 8
# Settings of a scene that change its light, beside those of Cycles.
SCENE_SETTINGS = ("use_simplify", "simplify_subdivision", "film_transparent", "hair_type")


def next_job(before: RestJob | None, view: RestView, share: float) -> RestJob:
    """The job for `view` after the job `before`, which takes about the `share` of a sample of all its pixels."""
    if before is None or before.view != view:
        fits = [shrink for shrink in SHRINKS if TOTALS[0] <= share * shrink**2]
        before, shrink = None, min(fits, default=SHRINKS[0])
    elif makes_picture(before) and before.shrink > 1:
        before, shrink = None, SHRINKS[SHRINKS.index(before.shrink) + 1]
    else:
        shrink = before.shrink
    done, first = (0, 0.0) if before is None else (before.total, before.rows[1] % 1.0)
    samples, most = 1, share * shrink**2  # most: samples in a step
    last = first + 1.0 / math.ceil(1.0 / most)
    if first == 0.0 and most >= 1.0 and (shrink > 1 or done >= SINGLES):
        samples = min(next(count for count in TOTALS if count > done) - done, int(most))
    rows = first, last if last < 0.99 else 1.0
    return RestJob(None, view, samples, done, shrink, rows, continues=before is not None)


def makes_picture(job: RestJob) -> bool:
    """True if there is a picture to show after the job."""
    return job.rows[1] == 1.0 and job.total in TOTALS


@dataclass
class _RestRun:
    """A job on its way. Its pictures come while the window draws, which may keep this process busy for seconds."""

    job: LiveRestJob
    folder: Path
    picture: "_RestPicture | None" = None  # the last one
    error: str = ""
    thread: threading.Thread | None = None

    def do(self, process: BlenderProcess) -> None:
        """Do the job, in a thread of its own."""
        try:
            process.do(self.job, self.folder, self._take)
        except Exception as error:
            self.error = f"Bounces: {error_line(error)}"

    def _take(self, stage: str, fraction: float) -> None:
        if stage == PICTURE:
            number = round(fraction)
            facts = json.loads((self.folder / LIVE_FACTS.format(number)).read_text(encoding="utf-8"))
            rest, whole = (_taken(self.folder / name.format(number)) for name in (LIVE_REST, LIVE_WHOLE))
            rest = self.picture.rest if rest is None else rest
            self.picture = _RestPicture(self.job.view, rest, whole, **facts)

    def stop(self) -> None:
        """Let it end after its step."""
        (self.folder / STOP).touch()


def _taken(path: Path) -> np.ndarray | None:
    """The array in a file, which is removed; None: there is no file."""
    if not path.exists():
        return None
    values = np.load(path)
    path.unlink()
    return values


@dataclass
class _RestPicture:
    """A denoised picture of the second Blender's."""

    view: RestView
    rest: np.ndarray  # (H, W, 4), row 0 on top, as of `RestSum.picture`
    whole: np.ndarray | None  # (H, W, 3), Cycles' whole picture
    whole_errs_less: bool  # than the view's own with few points and coarse shadows
    is_everything: bool
    ambient: list[float]
    problem: str
    total: int  # samples of all pixels of the view; 0: it has fewer pixels
    seconds: float  # of a sample of a single pixel
    work: float  # samples of single pixels that a step takes
    shown: ShownRest | None = None  # on the graphics card
    light: tuple | None = None  # the mean of the direct light that belongs to it, and what it depends on

    def upload(self) -> ShownRest:
        """The picture on the graphics card; needs an active GPU context."""
        if self.shown is None:
            camera = ViewCamera.of(*map(Matrix, self.view.matrices), self.view.matrices[1][3][3] == 1.0)
            self.shown = ShownRest(float_texture(self.rest[::-1]), camera, self.is_everything, tuple(self.ambient))
            if self.whole is not None:
                whole = np.pad(self.whole[::-1], ((0, 0), (0, 0), (0, 1)), constant_values=1.0)
                self.shown = replace(self.shown, whole=float_texture(whole), whole_errs_less=self.whole_errs_less)
        return self.shown


class LiveRest:
    """The rest of one view. A second Blender renders it in steps while the view goes on; stale ones are not shown."""

    def __init__(self):
        self._blender: SecondBlender | None = None
        self._wanted: RestView | None = None
        self._changed = 0.0
        self._run: _RestRun | None = None  # the one on its way
        self._opened: tuple | None = None  # the scene that the second Blender has
        self._changes = RestChanges()  # since then
        self._picture: _RestPicture | None = None  # the last one
        self._version, self._surfaces, self._settings = 0, 0, None  # of the scene; of all in it but lights
        self._has_whole = False  # Cycles' whole picture is wanted, too
        self.problem = ""  # why there is no picture

    def note(self, depsgraph) -> None:
        """Take note of the changes of the scene."""
        settings, kinds = self._settings, bpy.types.Scene | bpy.types.Collection
        if settings is None or any(isinstance(update.id, kinds) for update in depsgraph.updates):
            settings = _settings_of(depsgraph)
        has_light, has_other = self._changes.add(depsgraph, settings != self._settings)
        if has_other or has_light:
            self._version, self._settings, self.problem = self._version + 1, settings, ""
            self._surfaces += has_other

    def follow(self, context, depsgraph, world: bool = True, has_whole: bool = False) -> None:
        """Want the rest of the region of `context`, with the light of the `world` or without.

        With `has_whole` also Cycles' whole picture.
        """
        self._has_whole = has_whole
        region, view, space = context.region, context.region_data, context.space_data
        hidden = ()
        if space.local_view is not None:
            objects = depsgraph.view_layer.objects
            hidden = tuple(ob.name for ob in objects if not ob.original.local_view_get(space))
        matrices = tuple(tuple(map(tuple, one)) for one in (view.view_matrix, view.window_matrix))
        names, version = (depsgraph.scene.name, depsgraph.view_layer.name), (self._version, self._surfaces)
        size = max(region.width, 1), max(region.height, 1)
        wanted = RestView(*names, version, depsgraph.scene.frame_current, hidden, world, matrices, size)
        if wanted != self._wanted:
            self._wanted, self._changed = wanted, time.monotonic()

    def pause(self) -> None:
        """Nothing is wanted at the moment."""
        self._wanted = None

    @property
    def has_news(self) -> bool:
        """True if there is a picture that is not shown yet."""
        return self._picture is not None and self._picture.shown is None

    def shown(self) -> ShownRest | None:
        """The last picture; needs an active GPU context. After changes of lights alone it follows the direct light."""
        picture = self._picture
        if picture is None or picture.view == self._wanted:
            return None if picture is None else picture.upload()
        has_same_surfaces = picture.light is not None and picture.light[0] == self._light_key
        follows = has_same_surfaces and self._wanted.version != picture.view.version
        return replace(picture.upload(), whole=None, light=picture.light[1] if follows else None)

    @property
    def _light_key(self) -> tuple:
        """What the mean direct light depends on, apart from lights."""
        return self._wanted.version[1], self._wanted.matrices, self._wanted.size

    def keep_light(self, mean: Callable[[], np.ndarray]) -> None:
        """Keep the mean (3,) of the direct light that belongs to the picture that is shown."""
        picture = self._picture
        is_current = picture is not None and picture.view.version == self._wanted.version
        if is_current and (picture.light is None or picture.light[0] != self._light_key):
            picture.light = self._light_key, mean()

    @property
    def notes(self) -> tuple[str, ...]:
        """What there is to say about the picture, or why there is none."""
        return tuple(filter(None, (self.problem or (self._picture and self._picture.problem),)))

    @property
    def is_busy(self) -> bool:
        """True while a better picture is to come."""
        is_short = self._wanted is not None and self._samples < TOTALS[-1]
        return self._run is not None or (is_short and not self.problem)

    def lacks(self, samples: int) -> bool:
        """True while a picture of this view with so many samples of all pixels is to come."""
        return self.is_busy and self._samples < samples

    @property
    def is_new(self) -> bool:
        """True while the first picture of this view is to come."""
        return self.is_busy and self._wanted not in (None, self._picture and self._picture.view)

    @property
    def _samples(self) -> int:
        """Samples in full resolution of what is wanted."""
        return self._picture.total if self._picture is not None and self._picture.view == self._wanted else 0

    @property
    def seconds(self) -> float | None:
        """About how long the last picture will still take; None: not known yet."""
        if self._wanted is None or self._picture is None:
            return None
        return self._picture.seconds * math.prod(self._wanted.size) * (TOTALS[-1] - self._samples) or None

    def step(self) -> bool:
        """Take what has come, and start what is wanted, in the main thread; True if there is a new picture."""
        run, news = self._run, False
        # A render of the artist's has the processor for itself.
        may_run = self._wanted is not None and not bpy.app.is_job_running("RENDER")
        if run is not None:
            is_over = not run.thread.is_alive()
            news = run.job.view == self._wanted and self._take(run)
            if not is_over:
                if run.job.view != self._wanted or not may_run:
                    run.stop()
                return news
            self._run = None
            if run.error:
                self._opened = None
                # What cannot be handed over piece by piece goes as a whole.
                self.problem = "" if run.job.changes is not None else run.error
            news |= bool(self.problem)
        if may_run and time.monotonic() - self._changed > REST_SECONDS and self.is_busy:
            if self._blender is None:
                self._blender, self._opened = spare.pop() if spare else SecondBlender(), None
            if self._blender.is_busy:
                return news
            try:
                self._begin()
            except (OSError, RuntimeError) as error:
                self.problem = f"Bounces: {error_line(error)}"
                news = True
        return news

    def _take(self, run: _RestRun) -> bool:
        """Take over the last picture; True if it is a new one."""
        # A run that was stopped by a render of the artist's begins anew.
        if run.picture is None or run.picture is self._picture or run.picture.total < self._samples:
            return False
        self._picture = run.picture
        return True

    def _begin(self) -> None:
        """Start to render what is wanted."""
        wanted, blender = self._wanted, self._blender
        state = wanted.scene, wanted.view_layer, wanted.frame, wanted.hidden, wanted.world
        path = changes = None
        if state != self._opened or self._changes.everything:
            path, self._opened = blender.folder / "scene.blend", state
            save_working_copy(path, keep_engine=True)
        elif self._changes.objects or self._changes.blocks:
            changes = self._changes.written(bpy.data.scenes[wanted.scene], blender.folder / "changes.blend")
        self._changes = RestChanges(everything=False)
        work = FEWEST if self._picture is None else self._picture.work
        (blender.folder / STOP).unlink(missing_ok=True)
        run = self._run = _RestRun(LiveRestJob(path, wanted, changes, work, self._has_whole), blender.folder)
        arguments = {"target": run.do, "args": (blender.process,), "name": "LTSH rest"}
        run.thread = blender.step = threading.Thread(**arguments, daemon=True)
        blender.step.start()

    def stop(self, *, keeps: bool = False) -> None:
        """Forget what was rendered, and end the second Blender; or keep it, as `spare`."""
        blender = self._blender
        if self._run is not None:
            self._run.stop()
        vars(self).update(vars(LiveRest()))
        if blender is not None and keeps:
            blender.left = time.monotonic()
            spare.append(blender)
        elif blender is not None:
            blender.end()


def _settings_of(depsgraph) -> tuple:
    """The settings of a scene that change its light."""
    scene, layer = depsgraph.scene, depsgraph.view_layer
    blocks = scene.world, layer.world_override, layer.material_override
    cycles = getattr(scene, "cycles", None)
    names = [] if cycles is None else [one.identifier for one in cycles.bl_rna.properties if one.type != "POINTER"]
    return (
        scene.name,
        layer.name,
        *(None if block is None else block.name_full for block in blocks),
        *(getattr(scene.render, name) for name in SCENE_SETTINGS),
        *(str(getattr(cycles, name)) for name in names),
        *(ob.name for ob in objects_in_views(layer)),
    )


# In the child:

_sum: list[RestSum] = []
_whole_error = [WholePictureError()]  # of the open scene; until it is measured, of the one before


def render_rest(job: RestJob, folder: Path, progress) -> dict:
    """Do the `job`; returns the manifest, see `process.view.render_rest`."""
    done = 0
    while done < job.samples:
        samples = 1 if done < SINGLES else job.samples - done
        render_step(replace(job, samples=samples, done=done, continues=done > 0), folder, progress)
        job, done = replace(job, scene=None), done + samples
    save_array(folder / REST_PICTURE, _sum[0].picture())
    return _facts()


def _facts() -> dict:
    """What there is to say of the sum."""
    total = _sum[0]
    return {"is_everything": total.is_everything, "ambient": total.ambient, "problem": total.problem}


def render_step(job: RestJob, folder: Path, progress) -> float:
    """Add what `job` asks for to the sum; returns the seconds that Cycles took."""
    view, warnings = RestView(**job.view), []
    if job.scene is not None and _state_of(job, view) != _opened[0]:
        progress("open scene", 0.0)
        _whole_error[0].is_old = True
        open_scene(Path(job.scene), warnings, job.scripts)
        scene = scene_named(view.scene)
        render_settings.go_to_frame(scene, view.frame)
        layer = render_settings.only_view_layer(scene, warnings, view.view_layer)
        render_settings.show_as_views(scene, layer, view.hidden)
        # The animation of the scene itself ends here.
        _opened[0] = None if scene.animation_data is not None else _state_of(job, view)
        _prepare(scene, layer)
    elif job.scene is not None:
        scene = scene_named(view.scene)
        render_settings.go_to_frame(scene, view.frame)
        render_settings.show_as_views(scene, next(layer for layer in scene.view_layers if layer.use), view.hidden)
        _mark_materials()
    scene = scene_named(view.scene)
    if job.changes is not None:
        _take_changes(scene, **job.changes)
    layer = next(layer for layer in scene.view_layers if layer.use)
    world = layer.world_override or scene.world
    for name in () if view.world or world is None else ("diffuse", "glossy", "transmission", "scatter"):
        setattr(world.cycles_visibility, name, False)
    if view.matrices is None:
        camera = render_settings.choose_camera(scene, job.camera)
        camera.data.dof.use_dof = False
        render_settings.set_resolution(scene, *view.size)
    else:
        size = tuple(max(side // job.shrink, 1) for side in view.size)
        _look_through(scene, *map(Matrix, view.matrices), size)
    render, (width, height) = scene.render, render_settings.picture_size(scene)
    first, last = (round(share * height) for share in job.rows)
    render.use_border = render.use_crop_to_border = last - first < height
    render.border_min_x, render.border_max_x = 0.0, 1.0
    # Blender rounds down.
    render.border_min_y, render.border_max_y = ((height - row + 0.5) / height for row in (last, first))
    # All steps are of one sequence, whose noise is spread more evenly than that of several.
    scene.cycles.seed = 0
    render_settings.take_samples(scene, job.done, job.samples, max(job.done + job.samples, TOTALS[-1]))
    progress("bounces", 0.0)
    started = time.monotonic()
    render_exr(scene, folder / REST_RENDER, "NONE")
    seconds = time.monotonic() - started
    if not job.continues:
        arrays = [np.zeros((height, width, count), np.float32) for count in (3, 3, 6, 7, 1)]
        _sum[:] = [RestSum(*arrays[:4], arrays[4][..., 0], is_everything=_is_everything(scene, layer))]
    _sum[0].add(folder / REST_RENDER, first, job, {**render_settings.pass_names(), "mask": MASK})
    return seconds


def render_live_rest(job: LiveRestJob, folder: Path, progress) -> dict:
    """Do the `job`. Each picture has a file of facts, fields of a `_RestPicture`. Returns no manifest."""
    view, work, number, before = RestView(**job.view), job.work, 0, None
    pixels, more = math.prod(view.size), {"scene": job.scene, "changes": job.changes}
    while before is None or before.total < TOTALS[-1] or before.shrink > 1:
        step = next_job(before, view, work / pixels)
        seconds = render_step(replace(step, view=job.view, **more), folder, progress)
        done = pixels / step.shrink**2 * step.samples * (step.rows[1] - step.rows[0])
        if not more["scene"]:
            wanted = done * min(max(STEP_SECONDS / seconds, 1.0 / MOST_CHANGE), MOST_CHANGE)
            work = max(wanted, FEWEST if seconds > STEP_SECONDS else work)
        before, more = step, {"scene": None, "changes": None}
        samples = step.total / step.shrink**2  # of a pixel of the view
        if makes_picture(step) and not (folder / STOP).exists():
            for name, values in _pictures(step, samples, job.has_whole, number == 0).items():
                save_array(folder / name.format(number), values)
            facts = _facts() | {"total": step.total if step.shrink == 1 else 0, "seconds": seconds / done, "work": work}
            facts["whole_errs_less"] = _whole_error[0].is_small(samples)
            (folder / LIVE_FACTS.format(number)).write_text(json.dumps(facts), encoding="utf-8")
            progress(PICTURE, float(number))
            number += 1
        if (folder / STOP).exists():
            break
    return {}


def _pictures(step: RestJob, samples: float, has_whole: bool, is_first: bool) -> dict[str, np.ndarray]:
    """The pictures of the sum by the names of their files: the rest, and Cycles' whole one where that errs less than
    the view's own, or until that is known: it is measured at first."""
    total, error, pictures = _sum[0], _whole_error[0], {}
    has_whole = has_whole and not total.is_everything
    measures, errs_less = has_whole and error.lacks(samples), has_whole and error.is_small(samples)
    if is_first or measures or step.total >= WHOLE_SAMPLES or not errs_less:
        pictures[LIVE_REST] = total.picture()
    if has_whole and not total.problem and (measures or errs_less or error.excess is None):
        whole = pictures[LIVE_WHOLE] = total.whole_picture()
        if measures:
            exposure = 2.0 ** scene_named(step.view.scene).view_settings.exposure
            error.add(samples, pictures[LIVE_REST][..., :3], whole, exposure)
    return pictures


# The state of the last job's scene, if its next frame needs no other one.
_opened: list[tuple | None] = [None]


def _state_of(job: RestJob, view: RestView) -> tuple:
    """What an open scene is of."""
    modified = Path(job.scene).stat().st_mtime_ns
    return files_opened(), job.scene, modified, job.camera, job.scripts, replace(view, frame=None)


def _take_changes(scene, file: str, blocks: list, moved: dict) -> None:
    """Take over the changes that `RestChanges.written` has recorded. Raises SceneError where that is not possible."""
    with bpy.data.libraries.load(file) if blocks else nullcontext(((), None)) as (_, wanted):
        for kind, name in blocks:
            setattr(wanted, kind, [*getattr(wanted, kind), name])
    loaded = {kind: iter(getattr(wanted, kind)) for kind, _ in blocks}
    for kind, name in blocks:
        old, new = getattr(bpy.data, kind).get((name, None)), next(loaded[kind])
        if old is None:
            raise SceneError(f"{name!r} is new")
        old.user_remap(new)
        getattr(bpy.data, kind).remove(old)
        new.name = name
        if kind == "materials":
            mark(new)
    for name, (basis, _) in moved.items():
        if name not in scene.objects:
            raise SceneError(f"object {name!r} is new")
        scene.objects[name].matrix_basis = Matrix(basis)
    for layer in scene.view_layers:
        if layer.use:
            layer.update()
    for name, (_, world) in moved.items():
        if not np.allclose(scene.objects[name].matrix_world, world, rtol=1e-5, atol=1e-5):
            raise SceneError(f"object {name!r} does not follow")


def _prepare(scene, layer) -> None:
    """Let Cycles write what the rest is made of."""
    render, cycles = scene.render, scene.cycles
    if scene.animation_data is not None:
        scene.animation_data_clear()
    render_settings.render_with_cycles(scene)
    render.use_motion_blur = render.use_border = render.use_freestyle = render.film_transparent = False
    render.use_persistent_data = True
    cycles.film_exposure, cycles.time_limit, layer.samples, cycles.use_adaptive_sampling = 1.0, 0.0, 0, False
    cycles.shading_system = False  # AOVs need it
    render_settings.remove_extra_passes(layer)
    render_settings.enable_passes(layer, PASSES)
    layer.cycles.denoising_store_passes = True
    aov = layer.aovs.add()
    aov.name, aov.type = MASK, "VALUE"
    _mark_materials()


def _mark_materials() -> None:
    for material in bpy.data.materials:
        if not material.is_grease_pencil:
            mark(material)


def mark(material) -> None:
    """Let `material` write MASK if it is Cycles' alone, and else not."""
    nodes = () if material.node_tree is None else material.node_tree.nodes
    marks = [node for node in nodes if getattr(node, "aov_name", "") == MASK]
    if preview_of(material).is_of_cycles == bool(marks):
        return
    for node in marks:
        nodes.remove(node)
    if marks:
        return
    ensure_nodes(material)
    node = material.node_tree.nodes.new("ShaderNodeOutputAOV")
    node.aov_name = MASK
    node.inputs["Value"].default_value = 1.0


def _is_everything(scene, layer) -> bool:
    """True if the whole picture is Cycles': views cannot draw what is between the eye and the surfaces."""
    shown = [ob for ob in scene.objects if not ob.hide_render]
    materials = {slot.material for ob in shown for slot in ob.material_slots} - {None}
    return bool(reasons_for_cycles(scene, layer)) or any(map(_has_hair, shown)) or any(map(has_volume, materials))


def _has_hair(ob) -> bool:
    return ob.type == "CURVES" or any(each.settings.type == "HAIR" for each in ob.particle_systems)


def _look_through(scene, view: Matrix, window: Matrix, size: tuple[int, int]) -> None:
    """Let the scene have the camera of a region with these matrices and this size."""
    camera = scene.objects.get(CAMERA)
    if camera is None:
        camera = bpy.data.objects.new(CAMERA, bpy.data.cameras.new(CAMERA))
        scene.collection.objects.link(camera)
    (width, height), lens, render = size, camera.data, scene.render
    is_parallel = window[3][3] == 1.0
    place = view.inverted()
    column, sign = (3, -1.0) if is_parallel else (2, 1.0)
    lens.sensor_fit, lens.sensor_width = "HORIZONTAL", SENSOR
    lens.shift_x = 0.5 * sign * window[0][column]
    lens.shift_y = 0.5 * sign * window[1][column] * height / width
    if is_parallel:
        lens.type, lens.ortho_scale = "ORTHO", 2.0 / window[0][0]
        near, far = ((sign - window[2][3]) / window[2][2] for sign in (-1.0, 1.0))  # along z of the view
        place = place @ Matrix.Translation((0.0, 0.0, near))
        lens.clip_start, lens.clip_end = 1e-6, near - far
    else:
        lens.type, lens.lens = "PERSP", 0.5 * SENSOR * window[0][0]
        lens.clip_start = window[2][3] / (window[2][2] - 1.0)
        lens.clip_end = window[2][3] / (window[2][2] + 1.0)
    camera.matrix_world = place
    scene.camera = camera
    render.resolution_x, render.resolution_y, render.resolution_percentage = width, height, 100
    render.pixel_aspect_x = render.pixel_aspect_y = 1.0
